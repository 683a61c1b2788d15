"""Whole replies, ASCII or binary, out of a stream of NDI's bytes."""

from __future__ import annotations

import re
from dataclasses import dataclass

from .ndi import CR, NdiDamaged, crc16
from .ndi_tracking import BX_HEADER, BX_MARGIN, BX_START, bx_length


@dataclass(frozen=True, slots=True)
class Reply:
    """One whole reply with a right CRC, header and carriage return included."""

    data: bytes

    @property
    def binary(self) -> bool:
        return self.data[:2] == BX_START


@dataclass(frozen=True, slots=True)
class Damage:
    """So many bytes belong to no whole reply."""

    size: int


MAX_TEXT = 1 << 16
MAX_BUFFER = 3 * MAX_TEXT  # the longest reply, all but its last byte, and as much again from one read
_TEXT_BYTES = frozenset(range(0x20, 0x7F)) | {0x09, 0x0A}
_NOT_TEXT = re.compile(rb"[^\t\n\x20-\x7e]")
_KNOWN_STARTS = re.compile(rb"OKAY|ERROR|RESET")
_SEARCH_ALLOWANCE = 16


class ReplyReader:
    """Finds replies, ASCII or binary, in bytes that come in any pieces; nothing is believed without its CRC.

        reader.feed(data)
        while (item := reader.next()) is not None: ...   # Reply | Damage

    A binary reply is told by its first bytes. What cannot be a reply is left out up to the next one that can,
    and told as Damage. Holds at most `MAX_BUFFER` bytes and works in proportion to what it is fed.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._bad = 0
        self._bad_record = 0  # where the bad bytes began with a good header: the size that it gave
        self._ready: list[Reply] = []
        self._allowance = 0  # bytes that may still be looked through again
        self._searched = 0  # so many at the front are text without an end

    @property
    def pending(self) -> bool:
        """Whether bytes have come that `next` has not given out yet."""
        return bool(self._buffer or self._ready) or self._bad > 0

    @property
    def damaged(self) -> bool:
        """Whether the pending bytes begin with some that belong to no reply: only where they end is not known."""
        return self._bad > 0

    def clear(self) -> int:
        """Forgets everything that has come; returns how many bytes that was."""
        size = len(self._buffer) + self._bad
        self.__init__()  # type: ignore[misc]
        return size

    def feed(self, data: bytes) -> None:
        """Raises NdiDamaged, and forgets everything, where `MAX_BUFFER` bytes were not taken out by `next`."""
        if len(self._buffer) + len(data) > MAX_BUFFER:
            self.clear()
            raise NdiDamaged(f"more than {MAX_BUFFER} bytes without being read")
        self._buffer += data
        self._allowance = min(self._allowance, MAX_BUFFER) + _SEARCH_ALLOWANCE * len(data)

    def next(self) -> Reply | Damage | None:
        """The next reply or damaged piece; None while more bytes are needed."""
        while True:
            if self._ready:
                if self._bad:
                    return self._damage()
                return self._ready.pop(0)
            size = self._step()
            if size == 0:
                if not self._bad_record or self._bad + len(self._buffer) != self._bad_record:
                    return None
                # One record of the right length and a wrong CRC is all that has come: nothing else begins in it.
                self._bad += len(self._buffer)
                self._buffer.clear()
                self._searched = 0
                return self._damage()
            self._searched = 0
            if self._ready:
                del self._buffer[:size]
                continue
            self._bad += size
            ends_line = self._buffer[size - 1] == 0x0D and self._bad >= self._bad_record
            del self._buffer[:size]
            if ends_line or self._bad > MAX_TEXT:
                return self._damage()

    def _damage(self) -> Damage:
        damage, self._bad, self._bad_record = Damage(self._bad), 0, 0
        return damage

    def _step(self) -> int:
        """Bytes to take from the front: of replies, which are put into `_ready`, or bad ones; 0 = need more."""
        buffer = self._buffer
        if not buffer:
            return 0
        if buffer[0] == BX_START[0]:
            return self._binary()
        if buffer[0] in _TEXT_BYTES:
            return self._text()
        return 1

    def _binary(self) -> int:
        buffer = self._buffer
        if not BX_START.startswith(bytes(buffer[:2])):
            return 1
        if len(buffer) < BX_HEADER:
            return 0
        length = bx_length(buffer)
        if length is None:
            return 1
        size = length + BX_MARGIN
        if len(buffer) < size:
            return 0
        record = bytes(buffer[:size])
        if int.from_bytes(record[-2:], "little") == crc16(record[BX_HEADER:-2]):
            self._ready.append(Reply(record))
            return size
        # Where a byte was lost, the next reply begins inside what the header claims.
        if not self._bad:
            self._bad_record = size
        return 1 if self._may_look_again(size) else size

    def _text(self) -> int:
        buffer = self._buffer
        end = _NOT_TEXT.search(buffer, self._searched)
        if end is None:
            self._searched = len(buffer)
            return len(buffer) if len(buffer) > MAX_TEXT else 0
        stop = end.start()
        if buffer[stop] != 0x0D:
            return stop
        line = bytes(buffer[: stop + 1])
        if _good_line(line):
            self._ready.append(Reply(line))
            return stop + 1
        return self._part_of_line(line)

    def _part_of_line(self, line: bytes) -> int:
        """A line with a wrong CRC: a good reply that lost its end, or rubbish, may stand before a good one."""
        crc = 0
        for index in range(4, len(line) - 9):
            crc = crc16(line[index - 4 : index - 3], crc)
            if line[index - 3 : index + 1] == b"%04X" % crc and self._good_rest(line, index + 1):
                self._ready += [Reply(line[: index + 1] + CR), Reply(line[index + 1 :])]
                return len(line)
        for start in _KNOWN_STARTS.finditer(line, 1):
            if self._good_rest(line, start.start()):
                return start.start()
        return len(line)

    def _good_rest(self, line: bytes, begin: int) -> bool:
        return self._may_look_again(len(line) - begin) and _good_line(line[begin:])

    def _may_look_again(self, size: int) -> bool:
        """Whether the work stays in proportion to what was fed; if so, the bytes are counted."""
        if size > self._allowance:
            return False
        self._allowance -= size
        return True


def _good_line(line: bytes) -> bool:
    return len(line) > 5 and line[-5:-1] == b"%04X" % crc16(line[:-5])
