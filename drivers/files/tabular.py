"""Plain CSV: our own, which states everything, and other people's tables with coil columns.

Ours begins with comment lines (`# tonguetrack recording 1`, `# unit: mm`, `# rate_hz: ...`, `# frame: ...`),
then a header (`time_s`, and for every coil NAME_x NAME_y NAME_z, with NAME_ox.. for the axis, NAME_qw.. for the
quaternion and NAME_rms where there are any) and one line a frame; an empty cell is a missing value.
A foreign table needs such a header too, and states its unit in the column names (`TT_x[mm]`) or through
--unit, its rate through a time column or --rate.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ... import InputError
from ..frames import FloatArray, FrameOfReference, Recording
from .common import (
    UNITS_MM,
    Options,
    check_rate,
    clean,
    coverage_notes,
    decode,
    even_times,
    frame_times,
    number_table,
    parse_number,
)

MAGIC = "# tonguetrack recording 1"
DIRECTIONS = ("left", "right", "front", "back", "up", "down", "absent", "unknown")
_COLUMN = re.compile(
    r"(?P<coil>.*\S)[ _.:-](?P<field>x|y|z|ox|oy|oz|qw|qx|qy|qz|rms)"
    r"(?:[ _]?[\[(]?(?P<unit>m|dm|cm|mm|um)[\])]?)?",
    re.IGNORECASE,
)
_TIME = re.compile(
    r"(?:time|timestamp|t|wav ?time|audiotime)(?:[ _]?[\[(]?(?P<unit>s|sec|ms|us)[\])]?)?", re.IGNORECASE
)
UNSTATED = FrameOfReference()
_SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6}


@dataclass(frozen=True, slots=True)
class _Stated:
    """What the comment lines of a table of ours say; nothing, for a foreign one."""

    unit: str | None = None
    rate_hz: float | None = None
    frame: FrameOfReference = UNSTATED
    notes: tuple[str, ...] = ()
    extra: Mapping[str, str] = field(default_factory=dict)


def is_ours(head: str) -> bool:
    return head.startswith("# tonguetrack recording")


def is_foreign_table(lines: Sequence[str]) -> bool:
    """Whether the first line that is not a comment names the coordinates of at least one coil."""
    header = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    fields: dict[str, set[str]] = {}
    for cell in header.split(_delimiter(header)):
        if match := _COLUMN.fullmatch(cell.strip().strip('"')):
            fields.setdefault(match["coil"], set()).add(match["field"].lower())
    return any({"x", "y"} <= found or {"y", "z"} <= found for found in fields.values())


def _delimiter(header: str) -> str:
    return max(",;\t", key=header.count)


def parse_table(data: bytes, name: str, options: Options) -> Recording:
    """A CSV recording, ours or with coil columns of its own."""
    text = decode(data)
    ours = is_ours(text)
    if ours and text.split("\n", 1)[0].strip() != MAGIC:
        raise InputError(f"{name}: line 1 is not {MAGIC!r}; this file needs a newer tonguetrack.")
    lines = text.splitlines(keepends=True)
    comments = 0
    while comments < len(lines) and (lines[comments].startswith("#") or not lines[comments].strip()):
        comments += 1
    stated = _stated(lines[:comments], name) if ours else _Stated()
    if comments == len(lines):
        raise InputError(f"{name}: no header line with column names was found; the file is cut short.")
    try:
        rows = list(csv.reader(lines[comments:], delimiter=_delimiter(lines[comments])))
    except csv.Error as error:
        raise InputError(f"{name}: the table cannot be read ({error}); repair or export it again.") from error
    header, body = [cell.strip() for cell in rows[0]], [row for row in rows[1:] if row]
    if not body:
        raise InputError(f"{name}: no frame follows the column names.")
    table = number_table(body, len(header), name, comments + 2)
    fields, column_unit, time_column = _sort_columns(header, name)
    notes = list(stated.notes)
    coils = tuple(coil for coil, found in fields.items() if {"y", "z"} <= set(found))
    flat = [coil for coil, found in fields.items() if {"x", "y"} == set(found) & {"x", "y", "z"}]
    if flat or not coils:
        raise InputError(
            f"{name}: coil {', '.join(flat[:4]) or '(none)'} has no z column; two-dimensional tables must name their "
            "columns NAME_y (front-back) and NAME_z (vertical)."
        )
    depth = ["x" in fields[coil] for coil in coils]
    if any(depth) != all(depth):
        raise InputError(f"{name}: some coils have an x column and some have none; complete the table.")
    positions = np.zeros((len(table), len(coils), 3))
    for k, coil in enumerate(coils):
        for axis in range(0 if depth[0] else 1, 3):
            positions[:, k, axis] = table[:, fields[coil]["xyz"[axis]]]
    unit = stated.unit or options.unit or column_unit
    if unit not in UNITS_MM:
        raise InputError(f"{name}: the table states no unit; pass it with --unit ({', '.join(UNITS_MM)}).")
    positions, more = clean(positions * UNITS_MM[unit] if unit != "mm" else positions)
    notes += more
    times, rate, more = _times(table, time_column, stated, name, options)
    notes += more
    frame = stated.frame
    if not ours:
        notes.append("The table states no axes.")
        if not depth[0]:
            frame = FrameOfReference(x="absent")
        notes += coverage_notes(coils, positions)
    return Recording(
        coils=coils, positions=positions, times_s=times, rate_hz=rate,
        format="tonguetrack CSV 1" if ours else "CSV table", frame=frame,
        orientations=_block(table, fields, coils, ("ox", "oy", "oz")),
        quaternions=_block(table, fields, coils, ("qw", "qx", "qy", "qz")),
        rms=_single(_block(table, fields, coils, ("rms",))), source=name, notes=tuple(notes),
        extra=stated.extra,
    )  # fmt: skip


def _sort_columns(
    header: Sequence[str], name: str
) -> tuple[dict[str, dict[str, int]], str | None, tuple[int, str | None] | None]:
    """Coil -> field -> column; the unit in the column names; the time column and its unit."""
    fields: dict[str, dict[str, int]] = {}
    units: set[str] = set()
    time_column: tuple[int, str | None] | None = None
    for index, cell in enumerate(header):
        if match := _TIME.fullmatch(cell):
            time_column = time_column or (index, match["unit"] and match["unit"].lower())
        elif match := _COLUMN.fullmatch(cell):
            found = fields.setdefault(match["coil"], {})
            if match["field"].lower() in found:
                raise InputError(f"{name}: the column {cell!r} occurs twice.")
            found[match["field"].lower()] = index
            if match["unit"] and match["field"].lower() in "xyz":
                units.add(match["unit"].lower())
    if len(units) > 1:
        raise InputError(f"{name}: the column names mix the units {', '.join(sorted(units))}; use one.")
    return fields, (units.pop() if units else None), time_column


def _times(
    table: FloatArray,
    column: tuple[int, str | None] | None,
    stated: _Stated,
    name: str,
    options: Options,
) -> tuple[FloatArray, float, list[str]]:
    if stated.rate_hz is not None and column is not None:
        times, _, notes = frame_times(table[:, column[0]], name, stated.rate_hz)
        return times, stated.rate_hz, [note for note in notes if "gap" not in note]
    if column is not None:
        seconds = _SECONDS[column[1]] if column[1] else 1.0
        times, rate, notes = frame_times(table[:, column[0]] * seconds, name, options.rate_hz)
        if column[1] is None:
            if rate < 20 and options.rate_hz is None:
                raise InputError(
                    f"{name}: the time column states no unit, and as seconds it gives {rate:g} Hz; "
                    "pass the sampling rate with --rate."
                )
            notes.append(f"The time column states no unit; seconds were taken ({rate:g} Hz).")
        return times, rate, notes
    if options.rate_hz is None:
        raise InputError(f"{name}: the table has no time column; pass the sampling rate with --rate.")
    rate = check_rate(options.rate_hz, name)
    return even_times(len(table), rate), rate, []


def _block(
    table: FloatArray, fields: dict[str, dict[str, int]], coils: Sequence[str], wanted: Sequence[str]
) -> FloatArray | None:
    """(frames, coils, fields) of columns that some coils have, NaN for those without; None if none has."""
    having = [coil for coil in coils if set(wanted) <= set(fields[coil])]
    if not having:
        return None
    block = np.full((len(table), len(coils), len(wanted)), np.nan)
    for coil in having:
        block[:, coils.index(coil)] = table[:, [fields[coil][field] for field in wanted]]
    return block


def _single(block: FloatArray | None) -> FloatArray | None:
    return None if block is None else np.ascontiguousarray(block[:, :, 0])


# Ours -----------------------------------------------------------------------------------------------


def _stated(lines: Sequence[str], name: str) -> _Stated:
    """What the comment lines of our own files say."""
    unit, rate, frame = None, None, UNSTATED
    notes: list[str] = []
    extra: dict[str, str] = {}
    for line in lines:
        key, _, value = line[1:].strip().partition(": ")
        if key == "unit":
            unit = value
        elif key == "rate_hz":
            rate = check_rate(parse_number(value, name, "rate_hz in the comments"), name)
        elif key == "frame":
            frame = frame_from_text(value, name)
        elif key == "note":
            notes.append(value)
        elif key.startswith("extra "):
            extra[key[6:]] = value
    return _Stated(unit, rate, frame, tuple(notes), extra)


def frame_from_text(text: str, name: str) -> FrameOfReference:
    """The inverse of str(FrameOfReference)."""
    match = re.fullmatch(r"x (\w+), y (\w+), z (\w+); origin (.*)", text)
    if match is None or not set(match.groups()[:3]) <= set(DIRECTIONS):
        raise InputError(
            f"{name}: the frame {text[:60]!r} is not of the form 'x left, y back, z up; origin ...'."
        )
    return FrameOfReference(match[1], match[2], match[3], match[4])


def table_bytes(recording: Recording) -> bytes:
    """The recording as our CSV; numbers are written so that reading returns them bit for bit."""
    out = io.StringIO()
    print(MAGIC, file=out)
    print("# unit: mm", file=out)
    print(f"# rate_hz: {recording.rate_hz!r}", file=out)
    print(f"# frame: {_one_line(str(recording.frame))}", file=out)
    print(f"# from: {_one_line(recording.format)}", file=out)
    for note in recording.notes:
        print(f"# note: {_one_line(note)}", file=out)
    for key, value in recording.extra.items():
        print(f"# extra {_one_line(key)}: {_one_line(value)}", file=out)
    blocks: list[tuple[str, FloatArray | None]] = [
        ("x y z", recording.positions),
        ("ox oy oz", recording.orientations),
        ("qw qx qy qz", recording.quaternions),
        ("rms", None if recording.rms is None else recording.rms[:, :, None]),
    ]
    present = [(names.split(), block) for names, block in blocks if block is not None]
    header = ["time_s"]
    for coil in recording.coils:
        if _one_line(coil) != coil or coil != coil.strip() or not coil:
            raise InputError(f"the coil name {json.dumps(coil)} cannot be a column name; rename it first.")
        header += [f"{coil}_{field}" for names, _ in present for field in names]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    values = np.concatenate([block for _, block in present], axis=2).reshape(recording.frame_count, -1)
    for time, row in zip(recording.times_s.tolist(), values.tolist(), strict=True):
        writer.writerow([repr(time), *("" if math.isnan(value) else repr(value) for value in row)])
    return out.getvalue().encode()


def _one_line(text: str) -> str:
    return " ".join(text.split())
