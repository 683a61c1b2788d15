"""EST_Track .ema, ASCII and binary, by the conventions of MOCHA-TIMIT and mngu0.

Every row is: time (s), a "present" flag (unless breaks are off), then the channels. Two-dimensional
data are laid into the house's axes: y = front-back (the file's x), z = vertical (the file's y), both in
the file's own direction, and x = 0.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ... import InputError
from ..frames import FloatArray, FrameOfReference, Recording
from .common import (
    UNITS_MM,
    Options,
    clean,
    coverage_notes,
    decode,
    frame_times,
    number_table,
    parse_count,
    plausible_unit,
    split_rows,
)

MOCHA_RATE_HZ, MNGU0_RATE_HZ = 500.0, 200.0
MOCHA_FRAME = FrameOfReference("absent", "back", "up", "upper incisors")
# The order in which MOCHA-TIMIT's AG100 wrote its two groups of five channels; **** was not connected.
_FIRST, _SECOND = ("ui", "li", "ul", "ll", "tt"), ("tb", "td", "v", "****", "bn")
MOCHA_CHANNELS = tuple(f"{coil}_{axis}" for group in (_FIRST, _SECOND) for axis in "xy" for coil in group)
HEADER_END = re.compile(rb"^EST_Header_End[ \t]*\r?\n", re.MULTILINE)
LONGEST_HEADER = 1 << 20


def is_est(head: bytes) -> bool:
    return head.startswith(b"EST_File")


def is_headerless_mocha(lines: Sequence[str]) -> bool:
    """22 numbers a line: a time that does not fall, a flag of 0 or 1, twenty values."""
    rows = [line.split() for line in lines[:50]]
    if len(rows) < 2 or any(len(row) != 22 for row in rows):
        return False
    try:
        table = number_table(rows, 22, "")
    except InputError:
        return False
    return bool(np.isin(table[:, 1], (0.0, 1.0)).all() and (np.diff(table[:, 0]) >= 0).all())


def parse_headerless_mocha(data: bytes, name: str, options: Options) -> Recording:
    """MOCHA's ASCII variant without a header; channel names and 500 Hz by MOCHA's convention."""
    rows = split_rows(decode(data), None, name)
    notes: list[str] = []
    table = number_table(rows, 22, name)
    notes.append("The file has no header: channel names and order are those of MOCHA-TIMIT.")
    words = "EST_Track, ASCII without header (MOCHA convention)"
    return _recording(table[:, 0], table[:, 1], table[:, 2:], MOCHA_CHANNELS, words, notes, name, options)


def parse_est(data: bytes, name: str, options: Options) -> Recording:
    """An EST_Track file with header.

    The unit is not in the format: 0.01 mm for MOCHA and cm or mm for mngu0 are taken only if they put
    the coils as far apart as in one head, else InputError asks for --unit.
    """
    end = HEADER_END.search(data, 0, LONGEST_HEADER)
    if end is None:
        raise InputError(
            f"{name}: the line EST_Header_End is missing; the file is truncated, so copy it again."
        )
    header, channel_names = _header(data[: end.start()].decode("latin-1"))
    body = data[end.end() :]
    most = max(len(body), 1)
    frames = parse_count(header.get("NumFrames", ""), name, "NumFrames in the header", most)
    channels = parse_count(header.get("NumChannels", ""), name, "NumChannels in the header", most)
    aux = parse_count(header.get("NumAuxChannels", "0"), name, "NumAuxChannels in the header", most)
    if frames == 0 or channels == 0:
        raise InputError(
            f"{name}: the header declares {frames} frames of {channels} channels; nothing to read."
        )
    unnamed = [k for k in range(channels) if k not in channel_names]
    if unnamed:
        raise InputError(f"{name}: Channel_{unnamed[0]} has no name in the header; {channels} are declared.")
    breaks = header.get("BreaksPresent", "false").strip().lower() in ("true", "1")
    kind = header.get("DataType", "ascii").strip().lower()
    notes: list[str] = []
    if kind == "ascii":
        table, flagged = _ascii_rows(body, frames, channels, aux, breaks, name, header_lines(data, end.end()))
    elif kind.startswith("binary"):
        table, flagged = _binary_rows(body, frames, channels, aux, breaks, header, name)
    else:
        raise InputError(f"{name}: DataType is {kind[:30]!r}, expected ascii or binary.")
    if flagged != breaks:
        notes.append(
            f"BreaksPresent says {str(breaks).lower()}, the rows have {'a' if flagged else 'no'} flag column."
        )
    flags = table[:, 1] if flagged else np.ones(frames)
    values = table[:, 1 + flagged : 1 + flagged + channels]
    names = [channel_names[k] for k in range(channels)]
    words = f"EST_Track, {'ASCII' if kind == 'ascii' else 'binary'}"
    return _recording(table[:, 0], flags, values, names, words, notes, name, options)


def header_lines(data: bytes, end: int) -> int:
    """How many lines the header has, for messages."""
    return data.count(b"\n", 0, end)


def _header(text: str) -> tuple[dict[str, str], dict[int, str]]:
    """Header fields, and channel names by number with all blanks taken out ("v_ x" is v_x)."""
    fields: dict[str, str] = {}
    channels: dict[int, str] = {}
    comment = ""
    for line in text.split("\n")[1:]:
        key, _, value = line.strip().partition(" ")
        if key == "CommentChar":
            comment = value.strip()[:1]
        elif match := re.fullmatch(r"Channel_([0-9]{1,6})", key):
            channels[int(match[1])] = "".join(value.split())
        elif key and not (comment and key.startswith(comment)):
            fields[key] = value.strip()
    return fields, channels


def _binary_rows(
    body: bytes, frames: int, channels: int, aux: int, breaks: bool, header: dict[str, str], name: str
) -> tuple[FloatArray, bool]:
    """(frames, columns) and whether column 1 is the flag: the size of the data decides."""
    order = header.get("ByteOrder", "").strip()
    if order not in ("01", "10"):
        raise InputError(
            f"{name}: ByteOrder is {order[:20]!r}, expected 01 (little-endian) or 10 (big-endian)."
        )
    likely = [channels + 1 + breaks, channels + 2 - breaks]
    for columns in [*likely, *(width + aux for width in likely)]:
        if frames * columns * 4 == len(body):
            flagged = columns in (channels + 2, channels + aux + 2) if aux != 1 else breaks
            numbers = np.frombuffer(body, "<f4" if order == "01" else ">f4")
            with np.errstate(invalid="ignore"):
                return numbers.reshape(frames, columns).astype(np.float64), flagged
    raise InputError(
        f"{name}: {len(body)} bytes follow the header, expected {frames * likely[0] * 4} for {frames} frames of "
        f"{channels} channels; the file is truncated or damaged, so copy it again."
    )


def _ascii_rows(
    body: bytes, frames: int, channels: int, aux: int, breaks: bool, name: str, lines_before: int
) -> tuple[FloatArray, bool]:
    """(frames, columns) and whether column 1 is the flag: the width of the first line decides."""
    rows = [line.split() for line in body.decode("latin-1").split("\n") if line.strip()]
    if len(rows) < frames:
        raise InputError(
            f"{name}: {len(rows)} lines follow the header, expected {frames} frames; the file is truncated, "
            "so copy it again."
        )
    likely = [channels + 1 + breaks, channels + 2 - breaks]
    for columns in likely:
        if len(rows[0]) in (columns, columns + aux):
            kept = [row[:columns] if len(row) == columns + aux else row for row in rows[:frames]]
            return number_table(kept, columns, name, lines_before + 1), columns == channels + 2
    raise InputError(
        f"{name}: line {lines_before + 1} has {len(rows[0])} columns, expected {likely[0]} for {channels} channels."
    )


def _recording(
    stamps: FloatArray,
    flags: FloatArray,
    values: FloatArray,
    names: Sequence[str],
    words: str,
    notes: list[str],
    name: str,
    options: Options,
) -> Recording:
    """Sort channels into coils, decide convention, unit and times."""
    column: dict[str, dict[str, int]] = {}
    prefixed = False
    for index, channel in enumerate(names):
        if match := re.fullmatch(r"([^*].*?)_(p?)([xyz])", channel):
            axes = column.setdefault(match[1], {})
            if match[3] in axes:
                raise InputError(f"{name}: the channel {channel!r} occurs twice in the header.")
            axes[match[3]] = index
            prefixed |= bool(match[2])
    coils = [coil for coil, axes in column.items() if set(axes) in ({"x", "y"}, {"x", "y", "z"})]
    spatial = bool(coils) and all("z" in column[coil] for coil in coils)
    if not coils or (not spatial and any("z" in column[coil] for coil in coils)):
        raise InputError(
            f"{name}: no coils in the channel names {list(names)[:8]}; expected NAME_x NAME_y (MOCHA) or "
            "NAME_px NAME_py NAME_pz (mngu0)."
        )
    others = len(names) - sum(len(column[coil]) for coil in coils)
    if others:
        notes.append(f"{others} channel(s) that are not coil positions were left out.")
    positions = np.zeros((len(values), len(coils), 3))
    for k, coil in enumerate(coils):
        for target, axis in enumerate("xyz") if spatial else ((1, "x"), (2, "y")):
            positions[:, k, target] = values[:, column[coil][axis]]
    positions[flags == 0] = np.nan
    gone = int((flags == 0).sum())
    if gone:
        notes.append(f"{gone} frame(s) are marked as breaks and are missing.")
    if not spatial:
        convention, usual_hz, candidates = "MOCHA", MOCHA_RATE_HZ, ["10um"]
    elif prefixed:
        convention, usual_hz, candidates = "mngu0", MNGU0_RATE_HZ, ["mm", "cm", "dm"]
    else:
        convention, usual_hz, candidates = "", None, []
    unit = options.unit or plausible_unit(positions, candidates)
    if unit is None:
        raise InputError(
            f"{name}: EST_Track files state no unit, and no usual one ({', '.join(candidates) or 'none known'}) "
            "puts these coils as far apart as in one head; pass it with --unit."
        )
    if options.unit is None:
        usual = "usual for MOCHA" if convention == "MOCHA" else "not verified, by the distances of the coils"
        notes.append(f"The file states no unit; {unit} was taken ({usual}); --unit overrides.")
    positions, more = clean(positions * UNITS_MM[unit])
    notes += more
    times, rate, more = frame_times(stamps, name, options.rate_hz, usual_hz)
    notes += more
    if not spatial:
        frame = MOCHA_FRAME
        notes.append("Two-dimensional data: y is the file's x (growing backwards), z the file's y, x is 0.")
    elif convention:
        frame = _mngu0_frame(coils, positions, notes)
    else:
        frame = FrameOfReference()
    return Recording(
        coils=tuple(coils), positions=positions, times_s=times, rate_hz=rate,
        format=f"{words} ({convention} convention)" if convention and "convention" not in words else words,
        frame=frame, source=name, notes=(*notes, *coverage_notes(coils, positions)),
    )  # fmt: skip


def _mngu0_frame(coils: Sequence[str], positions: FloatArray, notes: list[str]) -> FrameOfReference:
    """y lies front to back and z up in mngu0; which way y grows is read off T1 (tip) and T3 (dorsum)."""
    if "T1" not in coils or "T3" not in coils:
        return FrameOfReference("unknown", "unknown", "up")
    tip, dorsum = (positions[:, coils.index(coil), 1] for coil in ("T1", "T3"))
    both = np.isfinite(tip) & np.isfinite(dorsum)
    if not both.any():
        return FrameOfReference("unknown", "unknown", "up")
    back = bool(np.median(dorsum[both]) > np.median(tip[both]))
    notes.append(
        f"y grows to the {'back' if back else 'front'} (T3 lies behind T1); x follows as for right-handed axes."
    )
    return FrameOfReference("left" if back else "right", "back" if back else "front", "up")
