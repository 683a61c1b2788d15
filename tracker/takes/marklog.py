"""The latest marks of a take in a piece of memory: texts one after the other, each with what proves it whole."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

_HEAD = struct.Struct("<qdI")  # number, stamp, bytes of text
_CHECKSUM = struct.Struct("<I")  # CRC-32 of head and text; stands between them
_BEFORE_TEXT = _HEAD.size + _CHECKSUM.size


@dataclass(frozen=True)
class Mark:
    """number: counts the take's marks from 1: mark i is sample i of its stream. stamp_s: `time.perf_counter`."""

    number: int
    stamp_s: float
    text: str


class MarkLog:
    """Marks in `memory`, from its beginning on; not for several threads at once."""

    def __init__(self, memory: memoryview) -> None:
        self._memory = memory
        self._at = 0

    def store(self, mark: Mark, written: int) -> None:
        """Appends a mark, or begins anew where the memory ends and the file has all `written` marks before it.

        Where there is no room even so, nothing is stored.
        """
        text = mark.text.encode("utf-8", "replace")
        size = _BEFORE_TEXT + len(text)
        if self._at + size > len(self._memory):
            if written < mark.number - 1 or size > len(self._memory):
                return
            self._at = 0
        head = _HEAD.pack(mark.number, mark.stamp_s, len(text))
        checksum = _CHECKSUM.pack(zlib.crc32(text, zlib.crc32(head)))
        self._memory[self._at : self._at + size] = head + checksum + text
        self._at += size


def read_log(data: bytes) -> list[Mark]:
    """The whole marks of a log, by rising number; what was there before the log began anew is left out."""
    marks: list[Mark] = []
    at = 0
    while at + _BEFORE_TEXT <= len(data):
        number, stamp_s, length = _HEAD.unpack_from(data, at)
        (checksum,) = _CHECKSUM.unpack_from(data, at + _HEAD.size)
        text = data[at + _BEFORE_TEXT : at + _BEFORE_TEXT + length]
        if len(text) < length or zlib.crc32(text, zlib.crc32(data[at : at + _HEAD.size])) != checksum:
            break
        if number < 1 or (marks and number <= marks[-1].number):
            break
        marks.append(Mark(number, stamp_s, text.decode("utf-8", "replace")))
        at += _BEFORE_TEXT + length
    return marks
