"""A file that only grows: whole pieces at its end, or none; and what is said where the disk refuses."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ... import InputError

Write = Callable[[int, memoryview], int]
Sync = Callable[[int], None]


def flush_to_disk(handle: int) -> None:
    """Returns when the file's content would outlive a power cut."""
    if sys.platform == "darwin":  # there, fsync stops at the drive's own memory
        import fcntl

        fcntl.fcntl(handle, fcntl.F_FULLFSYNC)
    else:
        getattr(os, "fdatasync", os.fsync)(handle)


class AppendedFile:
    """A new file. `append` is for one thread; `flush` may wait in another one meanwhile.

    size: bytes of the whole pieces in the file.
    write, sync: how a piece is written and flushed; they raise OSError.
    """

    def __init__(self, path: Path, write: Write = os.write, sync: Sync = flush_to_disk) -> None:
        """Creates the file. Raises InputError where it exists already, OSError where it cannot be made."""
        self.path = path
        self.size = 0
        self._write = write
        self._sync = sync
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            self._handle = os.open(path, flags, 0o666)
        except FileExistsError as reason:
            raise InputError(
                f"{path}: exists already and is never overwritten; choose another name."
            ) from reason

    def append(self, piece: bytes) -> None:
        """Writes all of `piece`. Raises OSError, and then the file ends with the last whole piece again."""
        rest = memoryview(piece)
        try:
            while rest:
                written = self._write(self._handle, rest)
                if written <= 0:
                    raise OSError(errno.EIO, os.strerror(errno.EIO))
                rest = rest[written:]
        except OSError:
            self._cut()
            raise
        self.size += len(piece)

    def flush(self) -> None:
        """Returns when all that was appended before would outlive a power cut. Raises OSError.

        A file that nobody can find any more is an error too (ENOENT).
        """
        self._sync(self._handle)
        if os.fstat(self._handle).st_nlink == 0:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))

    def close(self) -> None:
        os.close(self._handle)

    def _cut(self) -> None:
        with suppress(OSError):  # readers stop at the last whole chunk by themselves
            os.ftruncate(self._handle, self.size)
            os.lseek(self._handle, self.size, os.SEEK_SET)


def flush_folder(folder: Path) -> None:
    """Makes the names of new files outlive a power cut, where the system has a way to."""
    if os.name == "nt":
        return
    with suppress(OSError):  # a folder that may not be read, or a network file system without such a thing
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def is_gone(reason: OSError) -> bool:
    """Whether nobody can find the file any more."""
    return reason.errno in (errno.ENOENT, errno.ESTALE)


def words_for(reason: OSError) -> str:
    """Why a disk takes no more, in a few words."""
    match reason.errno:
        case errno.ENOSPC:
            return "the disk is full"
        case errno.EDQUOT:
            return "your quota on this disk is used up"
        case errno.EFBIG:
            return "the file may not grow any further"
        case errno.EIO:
            return "the disk reports an error (EIO)"
        case errno.ENOENT | errno.ESTALE:
            return "the file or its folder has been removed"
        case errno.EACCES | errno.EPERM | errno.EROFS:
            return "the folder cannot be written to"
        case errno.ENOTDIR:
            return "its folder is not a folder"
        case errno.ENAMETOOLONG:
            return "the name is too long for this file system"
    return f"the disk refuses it ({reason.strerror or reason})"
