"""The last seconds of a take in a file that is memory as well, so that a killed process loses none of them.

The loop stores each row by an assignment into a shared mapping of the file. What stands there belongs to the
operating system: it survives the death of the process at any instruction. It does not survive a power cut;
against that the take itself is flushed.

The file is a page with a header, then room for the latest marks (`marklog`), then a ring of slots, each a row
(`layout.row_dtype`) and a check word, the sum of the row's words. Row `sequence` stands in slot (sequence - 1)
modulo the number of slots. A slot counts only where its check word, its sequence and its place agree, so a row
that was cut short is left out, whether by a kill or, page by page, by a power cut.
"""

from __future__ import annotations

import errno
import hashlib
import mmap
import os
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from .layout import POSE, PREPARED, RAW, row_dtype
from .marklog import Mark, MarkLog, read_log

SUFFIX = ".journal"
MAGIC = b"ttkjrnl\n"
VERSION = 1
HEADER = struct.Struct("<8sIIIIIQ32s")
"""Magic, version, channels of raw, prepared and pose, slots, how many bytes at the take's beginning, their SHA-256."""
CHECKSUM = struct.Struct("<I")  # CRC-32 of HEADER
MARKS_AT = 4096
MARKS_BYTES = 1 << 18
SLOTS_AT = MARKS_AT + MARKS_BYTES
MAX_CHANNELS = 1 << 16
MAX_BYTES = 1 << 30
MAX_TAKE_HEADER_BYTES = 64 << 20

Words = NDArray[np.int64]
Rows = NDArray[Any]


def journal_path(take: str | os.PathLike[str]) -> Path:
    """Where the journal of a take lies: beside it."""
    return Path(f"{os.fspath(take)}{SUFFIX}")


def slot_dtype(row: np.dtype) -> np.dtype:
    return np.dtype([("row", row), ("check", "<i8")])


@dataclass(frozen=True)
class JournalHeader:
    """channels: of raw, prepared and pose; digest: SHA-256 of the `take_bytes` bytes that the take begins with."""

    channels: tuple[int, int, int]
    slots: int
    take_bytes: int
    digest: bytes

    @property
    def dtype(self) -> np.dtype:
        return row_dtype(*self.channels)

    @property
    def file_bytes(self) -> int:
        return SLOTS_AT + self.slots * slot_dtype(self.dtype).itemsize

    def packed(self) -> bytes:
        data = HEADER.pack(MAGIC, VERSION, *self.channels, self.slots, self.take_bytes, self.digest)
        return data + CHECKSUM.pack(zlib.crc32(data))


class Journal:
    """The writing side. One thread stores rows, another reads them out again; marks have a log of their own.

    Create with `Journal.create`. capacity: how many rows it holds.
    """

    def __init__(self, path: Path, mapped: mmap.mmap, header: JournalHeader) -> None:
        self.path = path
        self.capacity = header.slots
        self.marks = MarkLog(memoryview(mapped)[MARKS_AT:SLOTS_AT])
        self._mapped: mmap.mmap | None = mapped
        slots = np.frombuffer(mapped, slot_dtype(header.dtype), header.slots, SLOTS_AT)
        self._rows: Rows = slots["row"]
        self._words: Words = slots.view(np.int64).reshape(header.slots, -1)
        self._words[:] = 0  # touches every page: the first round of the loop finds them all in memory

    @staticmethod
    def create(path: Path, dtype: np.dtype, slots: int, take_header: bytes) -> Journal:
        """A new file with room for `slots` rows, all of it taken from the disk at once.

        A page of a mapping that the disk has no room for ends the process at the first touch; so the room is
        taken before. take_header: what the take begins with, so that no journal is laid to another take.
        Raises OSError, FileExistsError among them, and then leaves nothing behind.
        """
        channels = (dtype[RAW].shape[0], dtype[PREPARED].shape[0], dtype[POSE].shape[0])
        header = JournalHeader(channels, slots, len(take_header), hashlib.sha256(take_header).digest())
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        try:
            _take_room(handle, header.file_bytes)
            os.lseek(handle, 0, os.SEEK_SET)
            os.write(handle, header.packed())
            return Journal(path, mmap.mmap(handle, header.file_bytes), header)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        finally:
            os.close(handle)

    def store(self, sequence: int, slot: Words) -> None:
        """Copies a whole slot, check word and all, to its place. Allocates nothing, takes no lock."""
        self._words[(sequence - 1) % self.capacity] = slot

    def rows(self, first: int, last: int) -> Rows:
        """The rows `first` to `last`, or only up to the end of the ring: a view, not a copy."""
        begin = (first - 1) % self.capacity
        return self._rows[begin : begin + min(last - first + 1, self.capacity - begin)]

    def flush(self) -> None:
        """Returns when what stands here would outlive a power cut too. Raises OSError."""
        if self._mapped is not None:
            self._mapped.flush()

    def remove(self) -> None:
        """Deletes the file. A thread that is just storing a row is not disturbed."""
        self.release()
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    def release(self) -> None:
        """Lets the mapping go and leaves the file as it is. What is stored from now on goes nowhere."""
        # One row of memory in as many places: a thread on its way into `store` finds what it expects.
        width = self._words.shape[1]
        self._words = np.lib.stride_tricks.as_strided(
            np.zeros(width, np.int64), (self.capacity, width), (0, 8)
        )
        self._rows = self._rows[:0].copy()
        self.marks = MarkLog(memoryview(b""))
        self._mapped = None


def read_journal(path: str | os.PathLike[str], take: str | os.PathLike[str] | None = None) -> Rows:
    """All whole rows of a journal, copied, as `layout.row_dtype`, by rising `sequence`.

    They are the last rows that were handed over, those that the take has already among them. Sequences have a
    gap only where a disk had been stuck for longer than the journal lasts before the process was killed.
    take: the file that the journal should belong to; the journal of another take is refused.
    Raises InputError where a file cannot be read or the journal is none.
    """
    header, data = _read(path, take)
    data = data[MARKS_BYTES:]
    dtype = slot_dtype(header.dtype)
    slots = np.frombuffer(data, dtype, len(data) // dtype.itemsize)
    sequence = slots["row"]["sequence"]
    words = slots.view(np.int64).reshape(len(slots), dtype.itemsize // 8)
    whole = (
        (sequence > 0)
        & ((sequence - 1) % header.slots == np.arange(len(slots)))
        & (check_of(words[:, :-1]) == slots["check"])
    )
    rows = slots["row"][whole]
    return np.asarray(rows[np.argsort(rows["sequence"])])


def read_journal_marks(
    path: str | os.PathLike[str], take: str | os.PathLike[str] | None = None
) -> list[Mark]:
    """The latest marks of a journal, by rising number, those that the take has already among them.

    take, errors: as `read_journal`.
    """
    return read_log(_read(path, take)[1][:MARKS_BYTES])


def check_of(words: Words) -> Words:
    """(...,): the check word of rows as words (..., n): their sum, modulo 2^64."""
    return np.asarray(np.add.reduce(words, axis=-1, dtype=np.int64))


def _read(path: str | os.PathLike[str], take: str | os.PathLike[str] | None) -> tuple[JournalHeader, bytes]:
    """The header and all that follows its page."""
    name = os.fspath(path)
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            header = _header(file.read(HEADER.size + CHECKSUM.size), size, name)
            file.seek(MARKS_AT)
            data = file.read(
                max(0, size - MARKS_AT)
            )  # not more: room for all that is asked for is taken at once
        if take is not None:
            with open(take, "rb") as file:
                begins = file.read(min(header.take_bytes, os.fstat(file.fileno()).st_size))
                if hashlib.sha256(begins).digest() != header.digest:
                    raise InputError(f"{name}: this journal belongs to another take; move it away.")
    except OSError as reason:
        raise InputError(
            f"{reason.filename or name}: cannot be read ({reason.strerror or reason})."
        ) from reason
    return header, data


def _header(data: bytes, size: int, name: str) -> JournalHeader:
    if len(data) < HEADER.size + CHECKSUM.size or data[: len(MAGIC)] != MAGIC:
        raise InputError(f"{name}: this is not the journal of a take.")
    _, version, raw, prepared, pose, slots, take_bytes, digest = HEADER.unpack_from(data)
    if CHECKSUM.unpack_from(data, HEADER.size)[0] != zlib.crc32(data[: HEADER.size]):
        raise InputError(f"{name}: the header of this journal is damaged; nothing can be read from it.")
    if version != VERSION:
        raise InputError(f"{name}: a journal of version {version}; this program reads version {VERSION}.")
    header = JournalHeader((raw, prepared, pose), slots, take_bytes, digest)
    fits = max(header.channels) <= MAX_CHANNELS  # else numpy has no such row
    fits = fits and slots > 0 and size <= header.file_bytes <= MAX_BYTES
    if not fits or take_bytes > MAX_TAKE_HEADER_BYTES:
        raise InputError(f"{name}: {size} bytes do not fit {slots} rows of {header.channels} channels.")
    return header


def _take_room(handle: int, size: int) -> None:
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(handle, 0, size)
            return
        except OSError as reason:
            if reason.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS):
                raise
    zeros = memoryview(bytes(1 << 20))
    while size > 0:
        size -= os.write(handle, zeros[: min(size, len(zeros))])
