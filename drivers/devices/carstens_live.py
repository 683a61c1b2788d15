"""What Carstens' cs5recorder sends while it measures: binary blocks and text replies, as pure functions.

There is no public document. The layouts are those that public clients use: the real-time scripts of the
phonetics institute in Munich (AG500, and AG501 with 16 channels) and Opti-Speech 2 (AG501 with 24). One
block, little-endian:

    u32  bit 31: recording; bits 0 to 30: sample counter
    u32  number of the sweep
    f32  normalised amplitudes [channel][transmitter], twice; the second set has no known use
    40 bytes of flags; in those of the AG501: f32, u32 ampOK, u32 posOK, u32, u32[6], one bit a channel
    f32  [channel][7]: x y z (mm), phi theta (degrees), rms, spare
    f32  [channel][7]: the same, head-corrected, where the device does that

Nothing in a block tells its layout, and there is no check sum: its size alone says what it is.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from ..frames import FloatArray

WORST_RMS = 30.0
"""A fit error above this, in the device's own unit, is no measurement."""
FARTHEST_MM = 1000.0
"""No coil in the device's field is farther from its middle."""
COUNTER_MASK = 0x7FFF_FFFF
LONGEST_LINE = 512
MOST_LINES = 64

_RECORDING_BIT = 0x8000_0000
_HEAD_BYTES, _FLAG_BYTES, _ROW = 8, 40, 7
_POS_OK_AT = 8  # within the flags


@dataclass(frozen=True)
class Layout:
    """One row of the table. head_corrected: whether a second block of positions follows; it is the one used.
    pos_ok: whether the flags are known to tell which positions are good."""

    name: str
    size: int
    channels: int
    transmitters: int
    head_corrected: bool
    pos_ok: bool


LAYOUTS: tuple[Layout, ...] = (
    Layout("ag500", 960, 12, 6, head_corrected=False, pos_ok=False),
    Layout("ag501-16", 1648, 16, 9, head_corrected=False, pos_ok=True),
    Layout("ag501-16-head", 2096, 16, 9, head_corrected=True, pos_ok=True),
    Layout("ag501", 2448, 24, 9, head_corrected=False, pos_ok=True),
    Layout("ag501-head", 3120, 24, 9, head_corrected=True, pos_ok=True),
)
LARGEST_BLOCK = max(layout.size for layout in LAYOUTS)


class BadBlock(ValueError):
    """Bytes that are not one block of the layout."""


class BadReply(ValueError):
    """Text that does not answer as cs5recorder does."""


@dataclass(frozen=True, slots=True)
class Block:
    """One sample. counter: of samples, 31 bits; sweep: number of the recording, seen corrupt in the field.

    positions: (channels, 3) mm, NaN = missing; quaternions: (channels, 4) as (w, x, y, z) with z = 0, which
    turn the z axis onto the coil's; rms: (channels,) the device's fit error.
    """

    counter: int
    recording: bool
    sweep: int
    positions: FloatArray
    quaternions: FloatArray
    rms: FloatArray


def layout_named(name: str) -> Layout | None:
    return next((layout for layout in LAYOUTS if layout.name == name), None)


def layout_of_size(size: int) -> Layout | None:
    return next((layout for layout in LAYOUTS if layout.size == size), None)


def layout_words() -> str:
    """The table in one line, for people."""
    return ", ".join(f"{layout.name} ({layout.size} bytes)" for layout in LAYOUTS)


def coil_names(layout: Layout) -> tuple[str, ...]:
    """ "Ch1", "Ch2", ...: as the same channels are called in .pos recordings."""
    return tuple(f"Ch{k + 1}" for k in range(layout.channels))


# Blocks ---------------------------------------------------------------------------------------------


def parse_block(data: bytes, layout: Layout) -> Block:
    """One block. A channel is missing where its row is all zeros or not finite, its position absurd, its rms
    above `WORST_RMS`, or its posOK bit clear. Raises BadBlock where the length is another.
    """
    if len(data) != layout.size:
        raise BadBlock(f"{len(data)} bytes are no block of {layout.name}, which has {layout.size}")
    word, sweep = struct.unpack_from("<II", data)
    count = layout.channels
    with np.errstate(all="ignore"):  # arbitrary bytes can be signalling NaN
        rows = np.frombuffer(data, "<f4", count * _ROW, _positions_at(layout)[-1])
        rows = rows.reshape(count, _ROW).astype(np.float64)
        positions, phi, theta, rms = rows[:, :3], rows[:, 3], rows[:, 4], rows[:, 5]
        good = (rows[:, :6] != 0).any(axis=1) & (np.abs(positions) <= FARTHEST_MM).all(axis=1)
        good &= (rms >= 0) & (rms <= WORST_RMS)
        if layout.pos_ok:
            (bits,) = struct.unpack_from("<I", data, _flags_at(layout) + _POS_OK_AT)
            good &= (bits >> np.arange(count)) & 1 == 1
        angular = good & (np.abs(phi) <= 360.0) & (np.abs(theta) <= 90.0)
        quaternions = _quaternions(np.where(angular, phi, np.nan), np.where(angular, theta, np.nan))
    return Block(
        counter=word & COUNTER_MASK,
        recording=bool(word & _RECORDING_BIT),
        sweep=sweep,
        positions=np.where(good[:, None], positions, np.nan),
        quaternions=quaternions,
        rms=np.where(good, rms, np.nan),
    )


def build_block(block: Block, layout: Layout) -> bytes:
    """The bytes of a sample, for the simulator. Coils fill the first channels; the rest, and missing ones, are
    all-zero rows with their posOK bit clear. Both position blocks hold the same; amplitudes are zero."""
    rows = np.zeros((layout.channels, _ROW), "<f4")
    used = len(block.positions)
    phi, theta = _angles(block.quaternions)
    rows[:used, :3] = block.positions
    rows[:used, 3] = np.nan_to_num(phi)
    rows[:used, 4] = np.nan_to_num(theta)
    rows[:used, 5] = np.nan_to_num(block.rms)
    missing = ~np.isfinite(rows).all(axis=1)
    rows[missing] = 0.0
    there = ~missing & (np.arange(layout.channels) < used)
    data = bytearray(layout.size)
    word = (block.counter & COUNTER_MASK) | (_RECORDING_BIT if block.recording else 0)
    struct.pack_into("<II", data, 0, word, block.sweep & 0xFFFF_FFFF)
    if layout.pos_ok:
        bits = sum(1 << int(k) for k in np.flatnonzero(there))
        struct.pack_into("<fIII", data, _flags_at(layout), 0.0, bits, bits, 0)
    for start in _positions_at(layout):
        data[start : start + rows.nbytes] = rows.tobytes()
    return bytes(data)


def _flags_at(layout: Layout) -> int:
    return _HEAD_BYTES + 2 * 4 * layout.channels * layout.transmitters


def _positions_at(layout: Layout) -> tuple[int, ...]:
    first = _flags_at(layout) + _FLAG_BYTES
    return (first, first + 4 * _ROW * layout.channels) if layout.head_corrected else (first,)


def _quaternions(phi_deg: FloatArray, theta_deg: FloatArray) -> FloatArray:
    """(n, 4) the shortest turn of the z axis onto (cos phi cos theta, sin phi cos theta, sin theta)."""
    phi, half = np.deg2rad(phi_deg), np.deg2rad((90.0 - theta_deg) / 2.0)
    sine = np.sin(half)
    return np.stack(
        [np.cos(half), -np.sin(phi) * sine, np.cos(phi) * sine, np.where(np.isnan(phi), np.nan, 0.0)], axis=1
    )


def _angles(quaternions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """phi, theta in degrees, (n,) each: where a quaternion turns the z axis. NaN stays NaN."""
    w, x, y, z = quaternions.T
    theta = np.arcsin(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))
    return np.rad2deg(np.arctan2(2.0 * (y * z - w * x), 2.0 * (x * z + w * y))), np.rad2deg(theta)


# Text -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reply:
    """A text reply. text: its lines without the code; payload: the lines that follow, without the final "."."""

    code: int
    text: tuple[str, ...]
    payload: tuple[str, ...] = ()


def parse_reply(data: bytes, payload: bool = False) -> tuple[Reply, int] | None:
    """The reply that `data` begins with, and its length in bytes; None while it is not complete.

    `NNN-text` lines are continued, `NNN text` is the last; payload: whether lines up to a lone "." follow
    it, which only the command that was given can tell. Raises BadReply for anything else, for a line above
    `LONGEST_LINE` bytes, and above `MOST_LINES` lines.
    """
    lines, ends = _lines(data)
    text: list[str] = []
    first = 0
    for index, line in enumerate(lines):
        code, mark = line[:3], line[3:4]
        if len(code) < 3 or not (code.isascii() and code.isdigit()) or mark not in ("-", " ", ""):
            raise BadReply(f"'{line[:60]}' is not a reply of cs5recorder, as in '200 Ok'")
        if text and int(code) != first:
            raise BadReply(f"the reply {first} goes on as {code}")
        first = int(code)
        text.append(line[4:])
        if mark == "-":
            continue
        if not payload:
            return Reply(first, tuple(text)), ends[index]
        if "." in lines[index + 1 :]:
            last = lines.index(".", index + 1)
            return Reply(first, tuple(text), tuple(lines[index + 1 : last])), ends[last]
        break
    if len(lines) == MOST_LINES:
        raise BadReply(f"a reply has more than {MOST_LINES} lines")
    return None


def _lines(data: bytes) -> tuple[list[str], list[int]]:
    """The whole lines that data begins with, at most `MOST_LINES`, and where each ends."""
    lines: list[str] = []
    ends: list[int] = []
    start = 0
    while len(lines) < MOST_LINES:
        end = data.find(b"\n", start, start + LONGEST_LINE)
        if end < 0:
            if len(data) - start >= LONGEST_LINE:
                raise BadReply(f"a line has more than {LONGEST_LINE} bytes")
            break
        lines.append(data[start:end].rstrip(b"\r").decode("latin-1"))
        start = end + 1
        ends.append(start)
    return lines, ends
