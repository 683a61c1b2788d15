"""NDI Wave .tsv, both layouts: v1 (`AudioTime[s] MeasId WavId`, 9 columns a sensor) and v2
(`Wav Time`, 10 columns a sensor, the quaternion before the position).

Header names repeat from sensor to sensor, so columns are found by their place, never by name. A blank
is a missing sample whatever the status says. Quaternions are (w, x, y, z); `orientations` is the
sensor's own z axis, see `common.axes_from_quaternions`. The axes are those of the field generator.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ... import InputError
from ..frames import FloatArray, FrameOfReference, Recording
from .common import (
    Options,
    axes_from_quaternions,
    clean,
    coverage_notes,
    decode,
    frame_times,
    number_table,
    split_rows,
)

DEVICE_FRAME = FrameOfReference(origin="the field generator, or the reference sensor if one was active")
OK, BAD_STATUS = 55.0, {119.0: "processing error", 183.0: "out of volume"}
STATE_WORD = re.compile(r"OK|OUT.?OF.?VOL|BAD.?FIT|PROCESSING|MISSING|DISABLED|PARTIALLY", re.IGNORECASE)


def is_v1(lines: Sequence[str]) -> bool:
    return bool(lines) and lines[0].startswith("AudioTime[s]\tMeasId\tWavId")


def is_v2(lines: Sequence[str]) -> bool:
    if not lines or "\t" not in lines[0]:
        return False
    cells = lines[0].split("\t")
    if cells[0].strip().lower() == "wav time":
        return True
    states = [cells[k].strip() for k in range(3, len(cells) - 7)]
    return len(cells) >= 11 and _is_float(cells[0]) and any(STATE_WORD.fullmatch(s) for s in states)


def _is_float(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def parse_v1(data: bytes, name: str, options: Options) -> Recording:
    """A Wave v1 table. Samples that are blank, or whose status is 119 or 183, are NaN."""
    rows = split_rows(decode(data), "\t", name)
    notes: list[str] = []
    header, body = [cell.strip() for cell in rows[0]], rows[1:]
    while header and not header[-1]:
        header.pop()
    sensors, rest = divmod(len(header) - 3, 9)
    expected = ["Id", "Status", "X[mm]", "Y[mm]", "Z[mm]", "Q0", "Qx", "Qy", "Qz"]
    coils = []
    for k in range(sensors):
        group = header[3 + 9 * k : 12 + 9 * k]
        if [group[0].rpartition(" ")[2], group[1].rpartition(" ")[2], *group[2:]] != expected:
            raise InputError(
                f"{name}: columns {4 + 9 * k} to {12 + 9 * k} are named {group}, expected a sensor's Id, Status, "
                "position in mm and quaternion; export the table again."
            )
        coils.append(group[0].rpartition(" ")[0] or f"Sensor {k + 1}")
    if sensors < 1 or rest:
        raise InputError(f"{name}: line 1 has {len(header)} columns, expected 3 and then 9 for every sensor.")
    _require_frames(body, name)
    padded, short = _pad(body, len(header))
    notes += short
    table = number_table(padded, len(header), name, first_line=2)
    samples = table[:, 3:].reshape(len(table), sensors, 9)
    status, positions, quaternions = samples[:, :, 1], samples[:, :, 2:5], samples[:, :, 5:9]
    for code, meaning in BAD_STATUS.items():
        ignored = (status == code) & np.isfinite(positions).all(axis=2)
        if ignored.any():
            notes.append(f"{int(ignored.sum())} sample(s) with status {code:.0f} ({meaning}) were left out.")
        positions[ignored] = np.nan
    strange = (status != OK) & ~np.isin(status, list(BAD_STATUS)) & np.isfinite(positions).all(axis=2)
    if strange.any():
        codes = sorted({f"{code:g}" for code in status[strange]})
        notes.append(f"Samples with the unknown status {', '.join(codes)} were kept.")
    blank = (status == OK) & np.isnan(positions).any(axis=2)
    if blank.any():
        notes.append(f"{int(blank.sum())} sample(s) have status 55 (OK) but no values; they are missing.")
    return _recording(
        table[:, 0], positions, quaternions, coils, "NDI Wave .tsv v1", notes, name, options.rate_hz
    )


def parse_v2(data: bytes, name: str, options: Options) -> Recording:
    """A Wave v2 table, with or without header. Samples whose state is not OK are NaN.

    Columns whose cell in the first line is a single space separate sensors and are skipped.
    """
    rows = split_rows(decode(data), "\t", name)
    notes: list[str] = []
    first = rows[0]
    has_header = not _is_float(first[0])
    kept = [k for k, cell in enumerate(first) if cell != " "]
    while kept and not first[kept[-1]].strip() and (len(kept) - 1) % 10:
        kept.pop()
    sensors, rest = divmod(len(kept) - 1, 10)
    if sensors < 1 or rest:
        raise InputError(
            f"{name}: line 1 has {len(kept)} columns, expected the time and then 10 for every sensor."
        )
    body = rows[1:] if has_header else rows
    _require_frames(body, name)
    padded, short = _pad(body, len(first))
    notes += short
    if has_header:
        for k in range(sensors):
            group = [first[i].strip().lower()[:2] for i in kept[4 + 10 * k : 11 + 10 * k]]
            if group != ["q0", "qx", "qy", "qz", "tx", "ty", "tz"]:
                raise InputError(
                    f"{name}: the columns of sensor {k + 1} are {group}, expected Q0 Qx Qy Qz Tx Ty Tz after "
                    "its name, frame and state; export the table again."
                )
    else:
        notes.append("The table has no header: name, frame, state, Q0 Qx Qy Qz, Tx Ty Tz are assumed.")
    cells = [[row[i] for i in kept] for row in padded]
    line = 2 if has_header else 1
    numeric = [0] + [1 + 10 * k + field for k in range(sensors) for field in range(3, 10)]
    table = number_table([[row[i] for i in numeric] for row in cells], len(numeric), name, line)
    samples = table[:, 1:].reshape(len(table), sensors, 7)
    states = np.array([[row[1 + 10 * k + 2].strip().upper() for k in range(sensors)] for row in cells])
    bad = (states != "OK") & (states != "")
    for state in sorted(set(states[bad])):
        notes.append(f"{int((states == state).sum())} sample(s) with state {str(state)[:30]} were left out.")
    samples[states != "OK"] = np.nan
    coils = [_sensor_name(cells, k) for k in range(sensors)]
    if len(set(coils)) < sensors:
        coils = [f"Sensor {k + 1}" for k in range(sensors)]
    return _recording(
        table[:, 0], samples[:, :, 4:7], samples[:, :, :4], coils, "NDI Wave .tsv v2", notes, name, options.rate_hz
    )  # fmt: skip


def _sensor_name(cells: Sequence[Sequence[str]], k: int) -> str:
    """What the sensor's own first column calls it; `Sensor n` for a bare number or nothing."""
    word = next((row[1 + 10 * k].strip() for row in cells if row[1 + 10 * k].strip()), "")
    if not word:
        return f"Sensor {k + 1}"
    if _is_float(word):
        return f"Sensor {float(word):g}"
    return word


def _require_frames(body: Sequence[Sequence[str]], name: str) -> None:
    if not body:
        raise InputError(f"{name}: no frame follows the header; export the table again.")


def _pad(rows: Sequence[list[str]], width: int) -> tuple[list[list[str]], list[str]]:
    """Rows filled up with blanks: NDI's writer drops the empty columns of trailing sensors."""
    short = sum(len(row) < width for row in rows)
    notes = [f"{short} line(s) end early; the columns they lack are missing."] if short else []
    return [row + [""] * (width - len(row)) for row in rows], notes


def _recording(
    stamps: FloatArray,
    positions: FloatArray,
    quaternions: FloatArray,
    coils: list[str],
    words: str,
    notes: list[str],
    name: str,
    asked_hz: float | None,
) -> Recording:
    times, rate, more = frame_times(stamps, name, asked_hz)
    notes += more
    positions, more = clean(positions)
    notes += more
    no_turn = (quaternions == 0).all(axis=2) | ~np.isfinite(quaternions).all(axis=2)
    no_turn |= np.isnan(positions).any(axis=2)
    quaternions = np.where(no_turn[:, :, None], np.nan, quaternions)
    known = np.isfinite(quaternions[:, :, 3])
    five = [
        c for k, c in enumerate(coils) if known[:, k].any() and (quaternions[known[:, k], k, 3] == 0).all()
    ]
    if five:
        notes.append(f"Five degrees of freedom (no turn about the coil's own axis): {', '.join(five)}.")
    notes.append("The axes are the device's own; align them to the head before use.")
    return Recording(
        coils=tuple(coils), positions=positions, times_s=times, rate_hz=rate, format=words,
        frame=DEVICE_FRAME, orientations=axes_from_quaternions(quaternions), quaternions=quaternions,
        source=name, notes=(*notes, *coverage_notes(coils, positions)),
    )  # fmt: skip
