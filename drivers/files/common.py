"""What every reader needs: options, text tables, time stamps, units, directions, notes."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ... import InputError
from ..frames import FloatArray

UNITS_MM = {"m": 1000.0, "dm": 100.0, "cm": 10.0, "mm": 1.0, "10um": 0.01, "um": 0.001}
MISSING_WORDS = frozenset({"", "NA", "NaN", "nan", "NAN", "-nan", "N/A"})
LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 1.0, 20_000.0
LARGEST_POSITION_MM = 1e6


@dataclass(frozen=True, slots=True)
class Options:
    """What the user said about a file that the file does not say itself; None = nothing said.

    rate_hz: frames per second. unit: one of UNITS_MM. layout: a word that the format's reader knows.
    """

    rate_hz: float | None = None
    unit: str | None = None
    layout: str | None = None


def check_rate(rate_hz: float, name: str) -> float:
    """The rate itself, or InputError if no articulograph runs at it."""
    if not LOWEST_RATE_HZ <= rate_hz <= HIGHEST_RATE_HZ:
        raise InputError(
            f"{name}: a sampling rate of {rate_hz:g} Hz is not possible (expected {LOWEST_RATE_HZ:g} to "
            f"{HIGHEST_RATE_HZ:g}); pass the right one with --rate."
        )
    return float(rate_hz)


def parse_number(text: str, name: str, what: str) -> float:
    """A finite number from a header; InputError naming `what` otherwise."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{name}: {what} is {text.strip()[:40]!r}, expected a number.")
    return value


def parse_count(text: str, name: str, what: str, largest: int) -> int:
    """A whole number 0..largest from a header; InputError naming `what` otherwise."""
    digits = text.strip()
    if not re.fullmatch(r"[0-9]{1,12}", digits) or int(digits) > largest:
        raise InputError(f"{name}: {what} is {digits[:40]!r}, expected a whole number up to {largest}.")
    return int(digits)


def decode(data: bytes) -> str:
    """Text of a file: UTF-8 (with or without a byte order mark), else Latin-1, which never fails."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def split_rows(text: str, delimiter: str | None, name: str) -> list[list[str]]:
    """Cells of every non-blank line (delimiter None = runs of blanks).

    A last line without a line end and with fewer cells than the line before it is what a recorder or a
    copy that died leaves behind: InputError says how to keep the rest, rather than losing it unasked.
    """
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    unfinished = bool(lines[-1].strip())
    rows = [line.split(delimiter) for line in lines if line.strip()]
    if unfinished and len(rows) > 2 and len(rows[-1]) < len(rows[-2]):
        raise InputError(
            f"{name}: the last line (line {len(lines)}) stops after {len(rows[-1])} of {len(rows[-2])} columns; the "
            "file is truncated, so copy it again, or remove that line to read the rest."
        )
    return rows


def number_table(rows: Sequence[Sequence[str]], columns: int, name: str, first_line: int = 1) -> FloatArray:
    """(rows, columns) float64 from cells; blank, NA and NaN are NaN.

    Blank cells beyond `columns` are ignored (trailing delimiters). InputError names line and column.
    """
    table = np.empty((len(rows), columns))
    for index, row in enumerate(rows):
        if len(row) < columns or (len(row) > columns and any(cell.strip() for cell in row[columns:])):
            raise InputError(
                f"{name}: line {first_line + index} has {len(row)} columns, expected {columns}; "
                "repair or remove that line."
            )
        try:
            table[index] = row[:columns]
        except ValueError:
            table[index] = [
                _number(cell, name, first_line + index, k) for k, cell in enumerate(row[:columns])
            ]
    return table


def _number(cell: str, name: str, line: int, column: int) -> float:
    word = cell.strip()
    if word in MISSING_WORDS:
        return float("nan")
    try:
        return float(word)
    except ValueError:
        raise InputError(
            f"{name}: line {line}, column {column + 1} holds {word[:30]!r}, expected a number "
            "(with a decimal point) or NA."
        ) from None


def even_times(count: int, rate_hz: float, start_s: float = 0.0) -> FloatArray:
    """(count,) seconds: start + i / rate."""
    return start_s + np.arange(count) / rate_hz


def frame_times(
    stamps_s: FloatArray, name: str, asked_hz: float | None, usual_hz: float | None = None
) -> tuple[FloatArray, float, list[str]]:
    """Times, nominal rate and notes from a file's own time stamps, which may be too coarse or absent.

    stamps_s: (frames,). asked_hz: the user's --rate. usual_hz: what the format's convention says.
    Stamps that increase strictly are kept, and the rate is one over their median step (taken as the
    whole number it is within 0.05 % of). Otherwise the times are counted from the rate, and a note
    says so. Raises InputError asking for --rate when neither the stamps nor the convention tell it.
    """
    count = len(stamps_s)
    steps = np.diff(stamps_s)
    stated = asked_hz or usual_hz
    if count > 1 and bool(np.isfinite(stamps_s).all()) and bool((steps > 0).all()):
        median = float(np.median(steps))
        rate = 1.0 / median
        if abs(rate - round(rate)) < 5e-4 * rate:
            rate = float(round(rate))
        if LOWEST_RATE_HZ <= rate <= HIGHEST_RATE_HZ:
            notes = []
            gaps = steps > 1.5 * median
            if gaps.any():
                notes.append(
                    f"The time stamps have {int(gaps.sum())} gap(s), the longest {float(steps.max()):.3f} s."
                )
            return stamps_s.astype(np.float64), rate, notes
        problem = f"give {rate:.4g} Hz if they are seconds"
    elif count > 1:
        problem = "do not increase from frame to frame"
    else:
        problem = "are fewer than two"
    if stated is None:
        raise InputError(f"{name}: the time stamps {problem}; pass the sampling rate with --rate.")
    check_rate(stated, name)
    start = float(stamps_s[0]) if count and np.isfinite(stamps_s[0]) and abs(stamps_s[0]) < 1e9 else 0.0
    whence = "--rate" if asked_hz else "the format's convention"
    note = f"The time stamps {problem}; times were counted from {stated:g} Hz ({whence})."
    return even_times(count, stated, start), stated, [note]


def axes_from_angles(phi_deg: FloatArray, theta_deg: FloatArray) -> FloatArray:
    """(..., 3) unit vectors from Carstens angles in degrees, (...) each.

    phi is the azimuth in the x-y plane from +x towards +y, theta the elevation from that plane
    towards +z: (cos phi cos theta, sin phi cos theta, sin theta). NaN stays NaN.
    """
    phi, theta = np.deg2rad(phi_deg), np.deg2rad(theta_deg)
    return np.stack([np.cos(phi) * np.cos(theta), np.sin(phi) * np.cos(theta), np.sin(theta)], axis=-1)


def axes_from_quaternions(quaternions: FloatArray) -> FloatArray:
    """(..., 3) unit vectors: where each quaternion (w, x, y, z) turns the sensor's own z axis.

    That is the coil axis of NDI sensors: a 5-degree-of-freedom sensor has z = 0 in its quaternion,
    for the turn about its own axis cannot be measured. NaN or zero quaternions give NaN.
    """
    with np.errstate(all="ignore"):
        unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
        w, x, y, z = np.moveaxis(unit, -1, 0)
        axes = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    return np.where(np.isfinite(axes), axes, np.nan)


def unit_vectors(vectors: FloatArray) -> FloatArray:
    """(..., 3) scaled to length 1 where they are within 5 % of it; other rows become NaN."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        return np.where(np.abs(length - 1.0) < 0.05, vectors / length, np.nan)


def clean(positions: FloatArray) -> tuple[FloatArray, list[str]]:
    """Positions with every unusable sample NaN in all three axes, and a note if one was not NaN before.

    Unusable: an infinity, or a coil more than a kilometre away (damaged numbers). A sample of which
    one axis is missing is missing.
    """
    with np.errstate(invalid="ignore"):
        impossible = np.abs(positions) > LARGEST_POSITION_MM  # an infinity included
    bad = np.any(impossible | np.isnan(positions), axis=2, keepdims=True)
    cleaned = np.where(bad, np.nan, positions)
    number = int(np.any(impossible, axis=2).sum())
    notes = [f"{number} sample(s) hold impossible numbers and were taken as missing."] if number else []
    return cleaned, notes


def without_padding(positions: FloatArray) -> tuple[FloatArray, list[str]]:
    """Positions with every sample at exactly (0, 0, 0) missing, and a note if there are any.

    Converters fill the frames that a coil lacks with zeros; a measured coil is never exactly there.
    """
    zero = np.asarray((positions == 0).all(axis=2))
    if not zero.any():
        return positions, []
    note = f"{int(zero.sum())} sample(s) at exactly 0 0 0 are padding and were taken as missing."
    return np.where(zero[:, :, None], np.nan, positions), [note]


def coverage_notes(coils: Sequence[str], positions: FloatArray) -> list[str]:
    """Which coils have data, which never have, and which have gaps; (frames, coils, 3)."""
    share = np.isfinite(positions).all(axis=2).mean(axis=0) if len(positions) else np.zeros(len(coils))
    live = [coil for coil, part in zip(coils, share, strict=True) if part > 0]
    dead = [coil for coil, part in zip(coils, share, strict=True) if part == 0]
    gaps = [f"{c} {100 * (1 - s):.1f} %" for c, s in zip(coils, share, strict=True) if 0 < s < 1]
    notes = []
    if dead:
        having = ", ".join(live) if live else "none"
        notes.append(f"Coils with data: {having}; never any data: {', '.join(dead)}.")
    if gaps:
        notes.append(f"Samples missing: {', '.join(gaps)}.")
    return notes


def plausible_unit(positions: FloatArray, candidates: Sequence[str]) -> str | None:
    """The one unit of `candidates` in which the coils lie as far apart as in one head, else None.

    The distance judged is the largest extent, over the axes, of the coils' median positions:
    between 25 and 400 mm with reference coils, hardly less than 25 mm from lips to tongue back.
    """
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        middle = np.nanmedian(positions, axis=0)
        extent = float(np.nanmax(np.nanmax(middle, axis=0) - np.nanmin(middle, axis=0)))
    fitting = [unit for unit in candidates if 25.0 <= extent * UNITS_MM[unit] < 400.0]
    return fitting[0] if len(fitting) == 1 else None
