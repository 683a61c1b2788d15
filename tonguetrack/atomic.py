"""Writing a file whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from . import InputError


def write_atomically(path: str | os.PathLike[str], content: bytes | Callable[[BinaryIO], object]) -> Path:
    """Write `content` beside `path` under a temporary name, then put it in place in one step.

    content: the bytes, or a function that writes them to the open binary file it is given.
    Whoever reads `path` sees the old file or the new one, never a part. A symbolic link is followed.
    Returns the path written. Raises InputError, in one sentence, where the place cannot be written;
    an exception raised by `content` passes through and leaves nothing behind.
    """
    target = Path(os.path.realpath(path))
    if os.path.isdir(target):  # unlike Path.is_dir, quiet about impossible names
        raise InputError(f"{path}: this is a folder; give the name of a file to write.")
    if os.path.exists(target) and not os.access(target, os.W_OK):
        raise InputError(f"{path}: this file is write-protected; choose another name.")
    temporary = target.with_name(f".{target.name[:80]}.{secrets.token_hex(4)}.part")
    try:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        with os.fdopen(handle, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise _cannot_write(path, error) from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return Path(path)


def _cannot_write(path: str | os.PathLike[str], error: OSError) -> InputError:
    folder = Path(path).parent
    match error.errno:
        case errno.ENOENT if not folder.is_dir():
            return InputError(f"{path}: the folder {folder} does not exist; create it or choose another.")
        case errno.ENOTDIR:
            return InputError(f"{path}: {folder} is not a folder; choose another place.")
        case errno.EACCES | errno.EPERM | errno.EROFS:
            return InputError(f"{path}: no permission to write in {folder}; choose another place.")
        case errno.ENAMETOOLONG:
            return InputError(f"{path}: the name is too long for this file system; choose a shorter one.")
        case errno.ENOSPC:
            return InputError(f"{path}: no space is left on the device; free some or choose another place.")
    return InputError(f"{path}: cannot be written ({error.strerror or error}).")
