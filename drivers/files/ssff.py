"""SSFF, the signal files of the EMU system: one file a coil, grouped by their common stem.

The columns' names tell what they hold: `tt_posx` and `tt_orix` (TAPADM), or `TTx_raw`, `TTphi_raw`,
`TTx_filt` (made from Carstens data), or plain `PALx`. Of raw and filtered columns the raw ones are read
unless the layout "filt" is asked for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..frames import FloatArray, FrameOfReference, Recording
from .carstens import NORMPOS_FRAME, VECTOR_FRAME
from .common import (
    Options,
    axes_from_angles,
    check_rate,
    clean,
    coverage_notes,
    even_times,
    parse_count,
    parse_number,
    unit_vectors,
    without_padding,
)

TYPES = {"DOUBLE": "f8", "FLOAT": "f4", "SHORT": "i2", "LONG": "i4", "BYTE": "i1", "CHAR": "i1"}
HEADER_END = re.compile(rb"^-{10,}[ \t]*\r?\n", re.MULTILINE)
LONGEST_HEADER = 1 << 16
COLUMN = re.compile(r"(?P<coil>.*?)_?(?P<kind>pos|ori)?(?P<axis>[xyz]|phi|theta)(?:_(?P<variant>raw|filt))?")


@dataclass(frozen=True, slots=True)
class Track:
    """One SSFF file: columns (frames,) by name, rate and time of the first record."""

    name: str
    rate_hz: float
    start_s: float
    columns: Mapping[str, NDArray[np.generic]]
    frames: int


@dataclass(frozen=True, slots=True)
class _Coil:
    name: str
    positions: FloatArray  # (frames, 3)
    axes: FloatArray | None  # (frames, 3)
    style: str


def is_ssff(head: bytes) -> bool:
    return head.startswith(b"SSFF -- ")


def parse_track(data: bytes, name: str) -> Track:
    """One SSFF file, of either byte order and any column types."""
    end = HEADER_END.search(data, 0, LONGEST_HEADER)
    if end is None:
        raise InputError(
            f"{name}: the line of dashes that ends an SSFF header is missing; copy the file again."
        )
    order, rate, start = "", 0.0, 0.0
    fields: list[tuple[str, str, int]] = []
    for line in data[: end.start()].decode("latin-1").split("\n")[1:]:
        words = line.split()
        match words[:1]:
            case ["Machine"]:
                machine = " ".join(words[1:]).upper()
                order = {"IBM-PC": "<", "SPARC": ">"}.get(machine, "")
                if not order:
                    raise InputError(f"{name}: Machine is {machine[:30]!r}, expected IBM-PC or SPARC.")
            case ["Record_Freq"]:
                rate = check_rate(parse_number(" ".join(words[1:]), name, "Record_Freq"), name)
            case ["Start_Time"]:
                start = parse_number(" ".join(words[1:]), name, "Start_Time")
            case ["Column"]:
                if len(words) < 4 or words[-2] not in TYPES:
                    raise InputError(
                        f"{name}: {line.strip()[:60]!r} is not a column, expected: Column NAME TYPE NUMBER "
                        f"with one of the types {', '.join(TYPES)}."
                    )
                width = parse_count(words[-1], name, f"the width of column {words[1]}", largest=100_000)
                fields.append((" ".join(words[1:-2]), TYPES[words[-2]], width))
    if not order or not rate or not fields:
        raise InputError(
            f"{name}: the SSFF header lacks Machine, Record_Freq or Column; copy the file again."
        )
    if len({column for column, _, _ in fields}) < len(fields):
        raise InputError(f"{name}: a column name occurs twice in the SSFF header.")
    if sum(width for _, _, width in fields) > max(len(data), 1):
        raise InputError(f"{name}: the SSFF header declares records longer than the whole file.")
    record = np.dtype([(f"c{k}", order + kind, (width,)) for k, (_, kind, width) in enumerate(fields)])
    body = len(data) - end.end()
    if record.itemsize == 0 or body < record.itemsize:
        raise InputError(
            f"{name}: {body} bytes follow the SSFF header, expected records of {record.itemsize} bytes; "
            "the file is truncated, so copy it again."
        )
    frames, rest = divmod(body, record.itemsize)
    if rest:
        raise InputError(
            f"{name}: the last {rest} of {body} data bytes are not a whole record of {record.itemsize} bytes; "
            "the file is truncated, so copy it again."
        )
    records = np.frombuffer(data, record, frames, end.end())
    columns = {column: records[f"c{k}"][:, 0] for k, (column, _, width) in enumerate(fields) if width == 1}
    return Track(name, rate, start, columns, frames)


def coil_columns(track: Track, variant: str | None) -> dict[str, dict[str, str]]:
    """Coil -> {"x": column, ..., "orix": column, "phi": column, "style": ...} for coils with x, y and z."""
    found: dict[str, dict[str, str]] = {}
    variants = {m["variant"] for c in track.columns if (m := COLUMN.fullmatch(c)) and m["variant"]}
    wanted = (variant or ("raw" if "raw" in variants else "filt")) if variants else None
    for column in track.columns:
        match = COLUMN.fullmatch(column)
        if match is None or match["variant"] != wanted:
            continue
        key = ("ori" if match["kind"] == "ori" else "") + match["axis"]
        coil = found.setdefault(match["coil"], {})
        coil.setdefault(key, column)
        if match["kind"] == "pos":
            coil["style"] = "tapadm"
    return {coil: keys for coil, keys in found.items() if {"x", "y", "z"} <= set(keys)}


def holds_coils(track: Track) -> bool:
    return bool(coil_columns(track, None))


def parse_group(tracks: Mapping[str, Track], name: str, options: Options) -> Recording:
    """One recording from the SSFF files of one stem.

    tracks: file suffix (without the dot) -> its track; the first one is the file that was opened. A file
    with other columns, another rate or another number of records is left out with a note. A coil is
    called by its file's suffix, or by its columns' prefix where a file holds several.
    """
    main = next(iter(tracks.values()))
    coils: list[_Coil] = []
    notes: list[str] = []
    if not holds_coils(main):
        raise InputError(
            f"{name}: SSFF without coil positions (formants, pitch?); a coil's column names end in x, y and z."
        )
    filtered = False
    for suffix, track in sorted(tracks.items()):
        if not holds_coils(track):
            notes.append(f".{suffix} holds no coil and was left out.")
            continue
        if (track.frames, track.rate_hz, track.start_s) != (main.frames, main.rate_hz, main.start_s):
            notes.append(
                f".{suffix} has {track.frames} frames at {track.rate_hz:g} Hz from {track.start_s:g} s, not "
                f"{main.frames} at {main.rate_hz:g} from {main.start_s:g}, and was left out."
            )
            continue
        groups = coil_columns(track, options.layout)
        if not groups:
            raise InputError(f"{track.name}: there are no {options.layout} columns; leave --layout out.")
        for prefix, keys in groups.items():
            coils.append(_coil(track, suffix if len(groups) == 1 else prefix, keys))
            filtered |= keys["x"].endswith(("_raw", "_filt"))
    if filtered:
        chosen = options.layout or "raw"
        notes.append(f"The files hold raw and filtered columns; the {chosen} ones were read (--layout).")
    positions, more = clean(np.stack([coil.positions for coil in coils], axis=1))
    positions, padding = without_padding(positions)
    notes += more + padding
    axes = None
    if any(coil.axes is not None for coil in coils):
        nothing = np.full((main.frames, 3), np.nan)
        axes = np.stack([nothing if coil.axes is None else coil.axes for coil in coils], axis=1)
    styles = {coil.style for coil in coils}
    frame = {"tapadm": VECTOR_FRAME, "carstens": NORMPOS_FRAME}.get(
        styles.pop() if len(styles) == 1 else "", FrameOfReference()
    )
    if frame.x == "unknown":
        notes.append("The axes are not stated in the files.")
    else:
        notes.append(f"The axes are not stated in the files; taken from their column names: {frame}.")
    names = tuple(coil.name for coil in coils)
    return Recording(
        coils=names, positions=positions, times_s=even_times(main.frames, main.rate_hz, main.start_s),
        rate_hz=main.rate_hz, format=f"SSFF, {len(coils)} coil(s)", frame=frame, orientations=axes, source=name,
        notes=(*notes, *coverage_notes(names, positions)),
    )  # fmt: skip


def _coil(track: Track, name: str, keys: Mapping[str, str]) -> _Coil:
    def stacked(*wanted: str) -> FloatArray:
        with np.errstate(invalid="ignore"):
            return np.stack([track.columns[keys[key]].astype(np.float64) for key in wanted], axis=1)

    style = keys.get("style", "")
    axes = None
    if {"orix", "oriy", "oriz"} <= set(keys):
        axes = unit_vectors(stacked("orix", "oriy", "oriz"))
    elif {"phi", "theta"} <= set(keys):
        style = style or "carstens"
        angles = stacked("phi", "theta")
        with np.errstate(invalid="ignore"):
            axes = axes_from_angles(angles[:, 0], angles[:, 1])
    return _Coil(name, stacked("x", "y", "z"), axes, style)
