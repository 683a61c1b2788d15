"""The bytes of NDI's combined API (Aurora, Polaris, Vega): commands, ASCII replies, TX and BX tracking replies.

After NDI's published API guides and the open clients of it (ndicapi of the Plus toolkit, sawNDITracker of
Johns Hopkins, IGSTK); the forms were checked against IGSTK's recordings of real devices.

A command is `NAME:ARGUMENTS` and four hex digits of CRC, or `NAME ARGUMENTS` without one; a carriage return
ends it. A reply is text and CRC with a carriage return, or the binary reply to BX. Positions are mm in the
device's own frame, quaternions (q0, qx, qy, qz) with q0 the real part.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from enum import Enum

Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

CR = b"\r"
RESET_REPLY = "RESET"
OKAY = "OKAY"

TRANSFORMS = 0x0001
TOOL_INFORMATION = 0x0002
SINGLE_STRAY = 0x0004
TOOL_MARKERS = 0x0008
OUT_OF_VOLUME_TOO = 0x0800  # without it a tool outside the measurement volume is reported missing
PASSIVE_STRAYS = 0x1000
REPLY_OPTIONS = (
    TRANSFORMS | TOOL_INFORMATION | SINGLE_STRAY | TOOL_MARKERS | OUT_OF_VOLUME_TOO | PASSIVE_STRAYS
)
"""All reply options of TX and BX that are understood here."""

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

PORT_STATUS = {
    0x0001: "occupied",
    0x0002: "switch 1 closed",
    0x0004: "switch 2 closed",
    0x0008: "switch 3 closed",
    0x0010: "initialised",
    0x0020: "enabled",
    0x0040: "out of volume",
    0x0080: "partially out of volume",
    0x0100: "sensor broken",
    0x0200: "field disturbed",
    0x0400: "signal too small",
    0x0800: "signal too big",
    0x1000: "processing exception",
    0x2000: "port hardware failure",
}
SYSTEM_STATUS = {
    0x0001: "communication out of step",
    0x0002: "too much interference",
    0x0004: "communication CRC error",
    0x0008: "recoverable exception",
    0x0010: "hardware failure",
    0x0020: "hardware changed",
    0x0040: "a tool was plugged in",
    0x0080: "a tool was unplugged",
}


def status_words(status: int, table: dict[int, str]) -> str:
    """What the set bits of a port or system status mean, with commas between."""
    return ", ".join(words for bit, words in table.items() if status & bit)


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
    cursor = _Cursor(text)
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
    if text == State.UNOCCUPIED.name:
        return PortInformation()
    cursor = _Cursor(text)
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


# --- tracking replies ---------------------------------------------------------------------------------------

_NAN = math.nan
NO_POSITION: Point = (_NAN, _NAN, _NAN)
NO_QUATERNION: Quaternion = (_NAN, _NAN, _NAN, _NAN)


class State(Enum):
    """What the device says of a handle."""

    VALID = "valid"
    MISSING = "missing"
    DISABLED = "disabled"
    UNOCCUPIED = "unoccupied"  # TX alone says so; BX calls it disabled


@dataclass(frozen=True, slots=True)
class Markers:
    """Positions of markers, mm; out_of_volume: one bit a marker, lowest first."""

    points: tuple[Point, ...] = ()
    out_of_volume: int = 0


@dataclass(frozen=True, slots=True)
class ToolState:
    """One handle in one reply.

    quaternion (q0, qx, qy, qz), position mm, error (the device's own fit error): NaN unless VALID and asked
    for by option 0001, as are port_status and frame_number, else 0. tool_information, marker_information (20
    hex digits): option 0002. stray: option 0004, None = no stray marker. markers: option 0008.
    """

    handle: int
    state: State
    quaternion: Quaternion = NO_QUATERNION
    position: Point = NO_POSITION
    error: float = _NAN
    port_status: int = 0
    frame_number: int = 0
    tool_information: int = 0
    marker_information: bytes = bytes(10)
    stray: Point | None = None
    markers: Markers = Markers()


@dataclass(frozen=True, slots=True)
class TrackingReply:
    """All handles of one TX or BX reply. strays: option 1000."""

    tools: tuple[ToolState, ...]
    system_status: int = 0
    strays: Markers = Markers()


_WORDS = {"MISSING": State.MISSING, "DISABLED": State.DISABLED, "UNOCCUPIED": State.UNOCCUPIED}
_STRAY_MISSING = 0x02


def parse_tx(text: str, options: int) -> TrackingReply:
    """The text of a reply to TX, as `parse_reply` gives it. Raises NdiDamaged.

    DISABLED and UNOCCUPIED may have a status and frame number or not: real devices leave them out.
    Where option 0001 was not asked for, a handle that is on has no word of its own: it is MISSING here.
    """
    cursor = _Cursor(text)
    tools = tuple(_tool_from_text(cursor, options) for _ in range(cursor.hex(2)))
    strays = _markers_from_text(cursor) if options & PASSIVE_STRAYS else Markers()
    system_status = cursor.hex(4)
    cursor.end()
    return TrackingReply(tools, system_status, strays)


def _tool_from_text(cursor: _Cursor, options: int) -> ToolState:
    handle = cursor.hex(2)
    state = cursor.word(_WORDS)
    quaternion, position, error, port_status, frame_number = NO_QUATERNION, NO_POSITION, _NAN, 0, 0
    if state in (State.DISABLED, State.UNOCCUPIED):
        if not cursor.at("\n"):
            port_status, frame_number = cursor.hex(8), cursor.hex(8)
        cursor.expect("\n")
        return ToolState(handle, state, port_status=port_status, frame_number=frame_number)
    if options & TRANSFORMS:
        if state is None:
            state = State.VALID
            q0, qx, qy, qz = (cursor.signed(6) * 1e-4 for _ in range(4))
            quaternion, position = (q0, qx, qy, qz), cursor.point()
            error = cursor.signed(6) * 1e-4
        port_status, frame_number = cursor.hex(8), cursor.hex(8)
    tool_information, marker_information = 0, bytes(10)
    if options & TOOL_INFORMATION:
        tool_information = cursor.hex(2)
        marker_information = bytes(cursor.hex(2) for _ in range(10))
    stray = None
    if options & SINGLE_STRAY:
        found = cursor.hex(2)
        if found and not found & _STRAY_MISSING:
            stray = cursor.point()
    markers = _markers_from_text(cursor) if options & TOOL_MARKERS else Markers()
    cursor.expect("\n")
    return ToolState(
        handle,
        state or State.MISSING,
        quaternion,
        position,
        error,
        port_status,
        frame_number,
        tool_information,
        marker_information,
        stray,
        markers,
    )


def _markers_from_text(cursor: _Cursor) -> Markers:
    count = cursor.hex(2)
    out_of_volume = cursor.hex((count + 3) // 4) if count else 0
    return Markers(tuple(cursor.point() for _ in range(count)), out_of_volume)


def encode_tx(tracking: TrackingReply, options: int) -> str:
    """The text of a TX reply; `reply` adds the CRC. Values beyond the format are held at its limits."""
    text = f"{len(tracking.tools):02X}"
    for tool in tracking.tools:
        text += f"{tool.handle:02X}{_tool_as_text(tool, options)}\n"
    if options & PASSIVE_STRAYS:
        text += _markers_as_text(tracking.strays)
    return text + f"{tracking.system_status:04X}"


def _tool_as_text(tool: ToolState, options: int) -> str:
    if tool.state in (State.DISABLED, State.UNOCCUPIED):
        return tool.state.name
    text = ""
    if options & TRANSFORMS:
        if tool.state is State.MISSING:
            text += "MISSING"
        else:
            text += "".join(_signed(value * 1e4, 6) for value in tool.quaternion)
            text += _point_as_text(tool.position) + _signed(tool.error * 1e4, 6)
        text += f"{tool.port_status:08X}{tool.frame_number:08X}"
    if options & TOOL_INFORMATION:
        text += f"{tool.tool_information:02X}{tool.marker_information.hex().upper()}"
    if options & SINGLE_STRAY:
        text += "00" if tool.stray is None else "01" + _point_as_text(tool.stray)
    if options & TOOL_MARKERS:
        text += _markers_as_text(tool.markers)
    return text


def _markers_as_text(markers: Markers) -> str:
    count = len(markers.points)
    flags = f"{markers.out_of_volume:0{(count + 3) // 4}X}" if count else ""
    return f"{count:02X}{flags}" + "".join(_point_as_text(point) for point in markers.points)


def _point_as_text(point: Point) -> str:
    return "".join(_signed(value * 100.0, 7) for value in point)


def _signed(value: float, size: int) -> str:
    limit = 10 ** (size - 1) - 1
    return f"{max(-limit, min(limit, round(value))):+0{size}d}"


BX_START = b"\xc4\xa5"
_BX_HEADER, _BX_MARGIN = 6, 8  # start, length and CRC; these and the CRC at the end
_BX_STATES = {1: State.VALID, 2: State.MISSING, 4: State.DISABLED}
_BX_CODES = {State.VALID: 1, State.MISSING: 2, State.DISABLED: 4, State.UNOCCUPIED: 4}


def parse_bx(data: bytes, options: int) -> TrackingReply:
    """One whole binary reply to BX, header to CRC. Raises NdiDamaged for wrong CRCs, length or form."""
    length = _bx_length(data)
    if length is None or len(data) != length + _BX_MARGIN:
        raise NdiDamaged(f"a binary reply of {len(data)} bytes, where its header says {length} and 8")
    if int.from_bytes(data[-2:], "little") != crc16(data[_BX_HEADER:-2]):
        raise NdiDamaged("a binary reply's CRC is wrong")
    body = _Bytes(data[_BX_HEADER:-2])
    tools = tuple(_tool_from_bytes(body, options) for _ in range(body.byte()))
    strays = _markers_from_bytes(body) if options & PASSIVE_STRAYS else Markers()
    (system_status,) = body.read("<H")
    body.end()
    return TrackingReply(tools, system_status, strays)


def _bx_length(data: bytes | bytearray) -> int | None:
    """The length that a binary reply's header says; None where it is no header or its CRC is wrong."""
    if len(data) < _BX_HEADER or data[:2] != BX_START:
        return None
    if int.from_bytes(data[4:6], "little") != crc16(data[:4]):
        return None
    return int.from_bytes(data[2:4], "little")


def _tool_from_bytes(body: _Bytes, options: int) -> ToolState:
    handle, code = body.byte(), body.byte()
    state = _BX_STATES.get(code)
    if state is None:
        raise NdiDamaged(f"handle {handle:02X} has the unknown status {code}")
    if state is State.DISABLED:
        return ToolState(handle, state)
    quaternion, position, error, port_status, frame_number = NO_QUATERNION, NO_POSITION, _NAN, 0, 0
    if options & TRANSFORMS:
        if state is State.VALID:
            q0, qx, qy, qz, x, y, z, error = body.read("<8f")
            quaternion, position = (q0, qx, qy, qz), (x, y, z)
        port_status, frame_number = body.read("<2I")
    tool_information, marker_information = 0, bytes(10)
    if options & TOOL_INFORMATION:
        tool_information = body.byte()
        (marker_information,) = body.read("10s")
    stray = None
    if options & SINGLE_STRAY:
        found = body.byte()
        if found and not found & _STRAY_MISSING:
            stray = body.read("<3f")
    markers = _markers_from_bytes(body) if options & TOOL_MARKERS else Markers()
    return ToolState(
        handle,
        state,
        quaternion,
        position,
        error,
        port_status,
        frame_number,
        tool_information,
        marker_information,
        stray,
        markers,
    )


def _markers_from_bytes(body: _Bytes) -> Markers:
    count = body.byte()
    (flags,) = body.read(f"{(count + 7) // 8}s")
    points = tuple(body.read("<3f") for _ in range(count))
    return Markers(points, int.from_bytes(flags, "little"))


def encode_bx(tracking: TrackingReply, options: int) -> bytes:
    """A whole binary reply. Raises ValueError where it would be longer than its length field can say."""
    body = bytearray([len(tracking.tools)])
    for tool in tracking.tools:
        body += bytes([tool.handle, _BX_CODES[tool.state]])
        if tool.state in (State.DISABLED, State.UNOCCUPIED):
            continue
        if options & TRANSFORMS:
            if tool.state is State.VALID:
                body += struct.pack("<8f", *tool.quaternion, *tool.position, tool.error)
            body += struct.pack("<2I", tool.port_status, tool.frame_number)
        if options & TOOL_INFORMATION:
            body += struct.pack("<B10s", tool.tool_information, tool.marker_information)
        if options & SINGLE_STRAY:
            body += b"\x00" if tool.stray is None else struct.pack("<B3f", 1, *tool.stray)
        if options & TOOL_MARKERS:
            body += _markers_as_bytes(tool.markers)
    if options & PASSIVE_STRAYS:
        body += _markers_as_bytes(tracking.strays)
    body += struct.pack("<H", tracking.system_status)
    if len(body) > 0xFFFF:
        raise ValueError(f"a binary reply of {len(body)} bytes is longer than its length field can say")
    header = BX_START + struct.pack("<H", len(body))
    return header + struct.pack("<H", crc16(header)) + bytes(body) + struct.pack("<H", crc16(body))


def _markers_as_bytes(markers: Markers) -> bytes:
    count = len(markers.points)
    data = bytes([count]) + markers.out_of_volume.to_bytes((count + 7) // 8, "little")
    return data + b"".join(struct.pack("<3f", *point) for point in markers.points)


# --- replies out of a stream of bytes -----------------------------------------------------------------------


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
        if len(buffer) < _BX_HEADER:
            return 0
        length = _bx_length(buffer)
        if length is None:
            return 1
        size = length + _BX_MARGIN
        if len(buffer) < size:
            return 0
        record = bytes(buffer[:size])
        if int.from_bytes(record[-2:], "little") == crc16(record[_BX_HEADER:-2]):
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


# --- reading text and bytes ---------------------------------------------------------------------------------


class _Cursor:
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

    def word(self, words: dict[str, State]) -> State | None:
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


class _Bytes:
    """Fields of a binary reply's body, one after the other. Raises NdiDamaged."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def byte(self) -> int:
        (value,) = self.read("B")
        return int(value)

    def read(self, form: str) -> tuple:
        size = struct.calcsize(form)
        if self._at + size > len(self._data):
            raise NdiDamaged(f"the binary reply ends after {len(self._data)} bytes, too early")
        values = struct.unpack_from(form, self._data, self._at)
        self._at += size
        return values

    def end(self) -> None:
        if self._at != len(self._data):
            raise NdiDamaged(f"{len(self._data) - self._at} bytes too many in a binary reply")


_HEX_DIGITS = frozenset("0123456789ABCDEFabcdef")


def _is_hex(text: str) -> bool:
    return bool(text) and _HEX_DIGITS.issuperset(text)


def _ascii(data: bytes) -> str:
    try:
        return data.decode("ascii")
    except UnicodeDecodeError as reason:
        raise NdiDamaged(f"{data[:32]!r} is not ASCII text") from reason
