"""TX and BX tracking replies of NDI's combined API: their bytes and text, both ways.

Sources as in `ndi`. Positions are mm in the device's own frame, quaternions (q0, qx, qy, qz) with q0 the real part.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum

from .ndi import Cursor, NdiDamaged, Point, crc16

Quaternion = tuple[float, float, float, float]

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
    cursor = Cursor(text)
    tools = tuple(_tool_from_text(cursor, options) for _ in range(cursor.hex(2)))
    strays = _markers_from_text(cursor) if options & PASSIVE_STRAYS else Markers()
    system_status = cursor.hex(4)
    cursor.end()
    return TrackingReply(tools, system_status, strays)


def _tool_from_text(cursor: Cursor, options: int) -> ToolState:
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


def _markers_from_text(cursor: Cursor) -> Markers:
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
BX_HEADER, BX_MARGIN = 6, 8  # start, length and CRC; these and the CRC at the end
_BX_STATES = {1: State.VALID, 2: State.MISSING, 4: State.DISABLED}
_BX_CODES = {State.VALID: 1, State.MISSING: 2, State.DISABLED: 4, State.UNOCCUPIED: 4}


def parse_bx(data: bytes, options: int) -> TrackingReply:
    """One whole binary reply to BX, header to CRC. Raises NdiDamaged for wrong CRCs, length or form."""
    length = bx_length(data)
    if length is None or len(data) != length + BX_MARGIN:
        raise NdiDamaged(f"a binary reply of {len(data)} bytes, where its header says {length} and 8")
    if int.from_bytes(data[-2:], "little") != crc16(data[BX_HEADER:-2]):
        raise NdiDamaged("a binary reply's CRC is wrong")
    body = _Bytes(data[BX_HEADER:-2])
    tools = tuple(_tool_from_bytes(body, options) for _ in range(body.byte()))
    strays = _markers_from_bytes(body) if options & PASSIVE_STRAYS else Markers()
    (system_status,) = body.read("<H")
    body.end()
    return TrackingReply(tools, system_status, strays)


def bx_length(data: bytes | bytearray) -> int | None:
    """The length that a binary reply's header says; None where it is no header or its CRC is wrong."""
    if len(data) < BX_HEADER or data[:2] != BX_START:
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
