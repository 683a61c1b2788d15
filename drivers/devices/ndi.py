"""The bytes of NDI's combined API (Aurora, Polaris, Vega): commands, ASCII replies, what ports and device say.

After NDI's published API guides and the open clients of it (ndicapi of the Plus toolkit, sawNDITracker of
Johns Hopkins, IGSTK); the forms were checked against IGSTK's recordings of real devices.

A command is `NAME:ARGUMENTS` and four hex digits of CRC, or `NAME ARGUMENTS` without one; a carriage return
ends it. A reply is text and CRC with a carriage return, or the binary reply to BX (`ndi_tracking`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeVar

Point = tuple[float, float, float]
Meaning = TypeVar("Meaning")

CR = b"\r"
RESET_REPLY = "RESET"
OKAY = "OKAY"
UNOCCUPIED = "UNOCCUPIED"

BAUD_CODES = {
    9600: "0",
    14400: "1",
    19200: "2",
    38400: "3",
    57600: "4",
    115200: "5",
    921600: "6",
    1228739: "7",
    230400: "A",
}
"""First character of COMM's argument; the others are data bits, parity, stop bits and handshake."""

ERRORS = {
    0x01: "the command is unknown",
    0x02: "the command is too long",
    0x03: "the command is too short",
    0x04: "the command's CRC is wrong",
    0x05: "the command was not answered in time",
    0x06: "the communication settings are not possible",
    0x07: "a parameter is wrong",
    0x08: "the port handle is wrong",
    0x09: "the tracking priority is wrong",
    0x0A: "the LED is wrong",
    0x0B: "the LED's state is wrong",
    0x0C: "the command does not fit the mode that the device is in",
    0x0D: "no tool is plugged into the port",
    0x0E: "the port is not initialised",
    0x0F: "the port is not enabled",
    0x10: "the device is not initialised",
    0x11: "tracking could not be stopped",
    0x12: "tracking could not be started",
    0x13: "the port could not be initialised",
    0x14: "the field generator's characterisation is wrong",
    0x15: "the device could not be initialised",
    0x23: "a value is out of range",
    0x2B: "the port handle was not given out",
    0x2C: "the port handle is empty: its tool was unplugged",
}
"""What ERRORxx means."""
UNKNOWN_COMMAND, BAD_CRC, WRONG_MODE = 0x01, 0x04, 0x0C


class NdiError(ValueError):
    """The device refused a command. code: the number after ERROR."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"ERROR{code:02X}: {ERRORS.get(code, 'no meaning is known for this number')}")


class NdiDamaged(ValueError):
    """Bytes that are no command or reply: wrong CRC, length or form."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
        table.append(value)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes | bytearray, crc: int = 0) -> int:
    """CRC-16/ARC (polynomial 0x8005 reflected, start 0), as commands and replies have it."""
    table = _CRC_TABLE
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc


# --- commands -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Command:
    """name: as "PINIT"; arguments: as they came (hex digits in either case); crc_ok: True where there is none."""

    name: str
    arguments: str
    crc_ok: bool = True


_NAME = re.compile(r"[A-Z][A-Z0-9]{1,15}")


def command(name: str, arguments: str = "") -> bytes:
    """`NAME:ARGUMENTS`, CRC and carriage return."""
    text = f"{name}:{arguments}".encode("ascii")
    return text + b"%04X\r" % crc16(text)


def parse_command(line: bytes) -> Command:
    """One command with or without its carriage return, in the form with CRC (colon) or without (space).

    Raises NdiDamaged where it is neither; a wrong CRC is told in `crc_ok`.
    """
    text = _ascii(line.removesuffix(CR))
    name, sign, rest = _split_name(text)
    if not _NAME.fullmatch(name):
        raise NdiDamaged(f"{text[:32]!r} is no command")
    if sign == " ":
        return Command(name, rest)
    if len(rest) < 4 or not _is_hex(rest[-4:]):
        return Command(name, rest, crc_ok=False)
    return Command(name, rest[:-4], int(rest[-4:], 16) == crc16(text[:-4].encode("ascii")))


def _split_name(text: str) -> tuple[str, str, str]:
    for index, character in enumerate(text[:17]):
        if character in ": ":
            return text[:index], character, text[index + 1 :]
    raise NdiDamaged(f"{text[:32]!r} has neither a colon nor a space after a command's name")


def comm_arguments(baud: int) -> str:
    """COMM's argument for 8 data bits, no parity, 1 stop bit, no handshake. Raises KeyError for another speed."""
    return BAUD_CODES[baud] + "0000"


# --- ASCII replies ------------------------------------------------------------------------------------------


def reply(text: str) -> bytes:
    """A reply's text with CRC and carriage return."""
    data = text.encode("ascii")
    return data + b"%04X\r" % crc16(data)


def error_reply(code: int) -> bytes:
    return reply(f"ERROR{code:02X}")


def parse_reply(data: bytes) -> str:
    """The text of one ASCII reply with its CRC and carriage return.

    Raises NdiDamaged where form or CRC is wrong, NdiError where the device says ERRORxx.
    """
    text = _ascii(data)
    if len(text) < 5 or text[-1] != "\r" or not _is_hex(text[-5:-1]):
        raise NdiDamaged(f"{text[:32]!r} is no reply: CRC and carriage return are missing")
    if int(text[-5:-1], 16) != crc16(data[:-5]):
        raise NdiDamaged(f"the reply {text[:32]!r} has a wrong CRC")
    text = text[:-5]
    if text.startswith("ERROR") and len(text) >= 7 and _is_hex(text[5:7]):
        raise NdiError(int(text[5:7], 16))
    return text


@dataclass(frozen=True)
class PortHandle:
    """handle: 0..255; status: the port status, its lower 12 bits."""

    handle: int
    status: int


def parse_phsr(text: str) -> tuple[PortHandle, ...]:
    """The reply to PHSR: a count, then handle and status of each. Raises NdiDamaged."""
    cursor = Cursor(text)
    handles = tuple(PortHandle(cursor.hex(2), cursor.hex(3)) for _ in range(cursor.hex(2)))
    cursor.end()
    return handles


def encode_phsr(handles: tuple[PortHandle, ...]) -> str:
    return f"{len(handles):02X}" + "".join(f"{h.handle:02X}{h.status & 0xFFF:03X}" for h in handles)


@dataclass(frozen=True)
class ToolInformation:
    """PHINF option 0001. tool_type: main type, 0x03 a button box; the rest as the tool's memory has it."""

    tool_type: int
    manufacturer: str
    revision: str
    serial: str
    port_status: int


@dataclass(frozen=True)
class PortLocation:
    """PHINF option 0020. port, channel: as the device writes them; channel "01" is a tool's second sensor."""

    device: str
    system: str
    tool: str
    port: str
    channel: str


@dataclass(frozen=True)
class PortInformation:
    """What PHINF told; None or "" where it was not asked."""

    tool: ToolInformation | None = None
    part_number: str = ""
    location: PortLocation | None = None


BUTTON_BOX = 0x03
PHINF_TOOL, PHINF_PART_NUMBER, PHINF_LOCATION, PHINF_GPIO = 0x0001, 0x0004, 0x0020, 0x0040
_PHINF_SIZES = {0x0001: 33, 0x0002: 8, 0x0004: 20, 0x0008: 2, 0x0010: 2, 0x0020: 14, 0x0040: 2}


def parse_phinf(text: str, options: int) -> PortInformation:
    """The reply to PHINF: the fields that were asked for, lowest option first; none for an empty port.

    Raises NdiDamaged.
    """
    if text == UNOCCUPIED:
        return PortInformation()
    cursor = Cursor(text)
    tool, part_number, location = None, "", None
    for option, size in _PHINF_SIZES.items():
        if not options & option:
            continue
        if option == PHINF_GPIO and cursor.at_end:
            break  # devices older than this field leave it out
        if option == PHINF_TOOL:
            tool_type = cursor.hex(2)
            cursor.take(6)
            manufacturer, revision, serial = cursor.take(12).strip(), cursor.take(3), cursor.take(8)
            tool = ToolInformation(tool_type, manufacturer, revision, serial, cursor.hex(2))
        elif option == PHINF_PART_NUMBER:
            part_number = cursor.take(size).strip()
        elif option == PHINF_LOCATION:
            location = PortLocation(
                cursor.take(8), cursor.take(1), cursor.take(1), cursor.take(2), cursor.take(2)
            )
        else:
            cursor.take(size)
    cursor.end()
    return PortInformation(tool, part_number, location)


def encode_phinf(information: PortInformation, options: int) -> str:
    """The reply for options 0001, 0004 and 0020 in any combination; other fields are zeros."""
    text = ""
    for option, size in _PHINF_SIZES.items():
        if not options & option:
            continue
        if option == PHINF_TOOL and information.tool is not None:
            tool = information.tool
            text += f"{tool.tool_type:02X}000000{tool.manufacturer:12.12}{tool.revision:3.3}{tool.serial:8.8}"
            text += f"{tool.port_status & 0xFF:02X}"
        elif option == PHINF_PART_NUMBER:
            text += f"{information.part_number:20.20}"
        elif option == PHINF_LOCATION and information.location is not None:
            place = information.location
            text += f"{place.device:8.8}{place.system:1.1}{place.tool:1.1}{place.port:2.2}{place.channel:2.2}"
        else:
            text += "0" * size
    return text


def parse_ver(text: str) -> dict[str, str]:
    """The reply to VER: its `Name: value` lines; the first line, which names the firmware, under ""."""
    first, *lines = text.split("\n")
    values = {"": first.strip()}
    for line in lines:
        name, colon, value = line.partition(":")
        if colon:
            values[name.strip()] = value.strip()
    return values


def parse_get(text: str) -> dict[str, str]:
    """The reply to GET: its `name=value` lines. Raises NdiDamaged for another line."""
    values = {}
    for line in text.split("\n"):
        if not line:
            continue
        name, equals, value = line.partition("=")
        if not equals:
            raise NdiDamaged(f"{line[:32]!r} is no parameter: a '=' is missing")
        values[name] = value
    return values


# --- reading text and bytes ---------------------------------------------------------------------------------


class Cursor:
    """Fixed-width fields of a reply's text, one after the other. Raises NdiDamaged."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0

    def take(self, size: int) -> str:
        piece = self._text[self._at : self._at + size]
        if len(piece) != size:
            raise NdiDamaged(f"the reply ends after {len(self._text)} characters, too early")
        self._at += size
        return piece

    def hex(self, size: int) -> int:
        piece = self.take(size)
        if not _is_hex(piece):
            raise NdiDamaged(f"{piece!r} at {self._at - size} is no hexadecimal number")
        return int(piece, 16)

    def signed(self, size: int) -> int:
        piece = self.take(size)
        if piece[0] not in "+-" or not (piece[1:].isascii() and piece[1:].isdigit()):
            raise NdiDamaged(f"{piece!r} at {self._at - size} is no signed number")
        return int(piece)

    def point(self) -> Point:
        return self.signed(7) * 0.01, self.signed(7) * 0.01, self.signed(7) * 0.01

    def word(self, words: dict[str, Meaning]) -> Meaning | None:
        for word, meaning in words.items():
            if self.at(word):
                self._at += len(word)
                return meaning
        return None

    def at(self, text: str) -> bool:
        return self._text.startswith(text, self._at)

    def expect(self, text: str) -> None:
        if self.take(len(text)) != text:
            raise NdiDamaged(f"{text!r} is missing at {self._at - len(text)}")

    @property
    def at_end(self) -> bool:
        return self._at == len(self._text)

    def end(self) -> None:
        if not self.at_end:
            raise NdiDamaged(f"{len(self._text) - self._at} characters too many")


_HEX_DIGITS = frozenset("0123456789ABCDEFabcdef")


def _is_hex(text: str) -> bool:
    return bool(text) and _HEX_DIGITS.issuperset(text)


def _ascii(data: bytes) -> str:
    try:
        return data.decode("ascii")
    except UnicodeDecodeError as reason:
        raise NdiDamaged(f"{data[:32]!r} is not ASCII text") from reason
