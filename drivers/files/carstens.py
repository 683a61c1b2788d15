"""Carstens articulographs: AG50x .pos (V001-V003), AG500 .pos without header, and the .txt export.

Seven numbers a channel and frame: x y z (mm), phi theta (degrees), rms (the device's fit error, in its
own unit) and one spare. Orientation becomes the unit vector of the coil axis, see
`common.axes_from_angles`. A socket without a coil is all zeros in the file and all NaN here; it stays
in the recording, so that channel numbers do not shift.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ... import InputError
from ..frames import FloatArray, FrameOfReference, Recording
from .common import (
    Options,
    axes_from_angles,
    check_rate,
    clean,
    coverage_notes,
    decode,
    even_times,
    number_table,
    parse_count,
    parse_number,
    split_rows,
    unit_vectors,
)

FIELDS = ("x", "y", "z", "phi", "theta", "rms", "extra")
AG500_CHANNELS = 12
AG500_FRAME_BYTES = AG500_CHANNELS * len(FIELDS) * 4
AG500_RATE_HZ = 200.0
MOST_CHANNELS = 256

NORMPOS_FRAME = FrameOfReference("front", "left", "up", "set by the lab's reference sweep")
VECTOR_FRAME = FrameOfReference("left", "back", "up", "upper incisors, by convention")
DEVICE_FRAME = FrameOfReference()


# AG50x .pos -----------------------------------------------------------------------------------------


def is_ag50x(head: bytes) -> bool:
    return head.startswith(b"AG50xDATA_V")


def parse_ag50x(data: bytes, name: str, options: Options) -> Recording:
    """An AG501 (AG50x) .pos file, versions V001 to V003.

    Frame i is placed at i / rate seconds. A file that ends within a frame is refused.
    """
    version = data[9:14].decode("latin-1").strip()
    if version not in ("_V001", "_V002", "_V003"):
        raise InputError(
            f"{name}: the header says AG50xDATA{version[:8]!r}; versions V001, V002 and V003 are known. "
            "Export the sweep as .txt from the Carstens software instead."
        )
    size_line = data[14:40].split(b"\n", 2)
    declared = size_line[1].decode("latin-1") if len(size_line) > 2 else ""
    header_bytes = parse_count(declared, name, "the header size in line 2", largest=10**8)
    if header_bytes > len(data):
        raise InputError(
            f"{name}: the header claims {header_bytes} bytes, the file has only {len(data)}; it is "
            "truncated, so copy or record it again."
        )
    fields = _header_fields(data[:header_bytes])
    channels = parse_count(
        fields.get("NumberOfChannels", ""), name, "NumberOfChannels in the header", largest=MOST_CHANNELS
    )
    if "SamplingFrequencyHz" in fields:
        rate = parse_number(fields["SamplingFrequencyHz"], name, "SamplingFrequencyHz in the header")
    elif options.rate_hz is not None:
        rate = options.rate_hz
    else:
        raise InputError(f"{name}: the header states no SamplingFrequencyHz; pass the rate with --rate.")
    check_rate(rate, name)
    if channels == 0:
        raise InputError(f"{name}: the header declares no channels.")
    samples = _float_frames(data, header_bytes, channels, name)
    notes: list[str] = []
    corrected = [key for key in fields if key.startswith("normpos.")]
    if corrected:
        frame = NORMPOS_FRAME
        notes.insert(0, "Head movement was already taken out by normpos.")
    else:
        frame = DEVICE_FRAME
        notes.insert(0, "The header names no normpos step: the positions are probably not head-corrected.")
    coils = [f"Ch{k + 1}" for k in range(channels)]
    return _recording(
        samples, coils, even_times(len(samples), rate), rate, f"Carstens AG50x .pos {version[1:]}", frame,
        notes, name, fields,
    )  # fmt: skip


def _header_fields(header: bytes) -> dict[str, str]:
    """key -> value of the header's text lines, which end at the first NUL or Ctrl-Z."""
    text = re.split(rb"[\x00\x1a]", header, maxsplit=1)[0].decode("latin-1")
    pairs = (line.strip().partition("=") for line in text.split("\n")[2:])
    return {key.strip(): value.strip() for key, equals, value in pairs if equals}


# AG500 .pos -----------------------------------------------------------------------------------------


def is_ag500(head: bytes) -> bool:
    """Whether the bytes can only be AG500 frames: believable positions, and one of the two layouts."""
    return bool(_ag500_layout(head))


def _ag500_layout(data: bytes) -> str:
    """ "vector", "angles", or "" when neither fits the frames that are whole in `data`."""
    count = min(len(data) // AG500_FRAME_BYTES, 200)
    if count == 0:
        return ""
    with np.errstate(invalid="ignore"):  # arbitrary bytes can be signalling NaN
        numbers = np.frombuffer(data, "<f4", count * AG500_CHANNELS * 7).reshape(-1, 7).astype(np.float64)
    live = numbers[(numbers != 0).any(axis=1)]
    if len(live) == 0 or not np.isfinite(live).all():
        return ""
    near = (np.abs(live[:, :3]) < 1000).all(axis=1) & (np.abs(live[:, :3]).max(axis=1) > 1e-3)
    if near.mean() < 0.9:
        return ""
    if (np.abs(np.linalg.norm(live[:, 3:6], axis=1) - 1.0) < 1e-2).mean() > 0.95 and (live[:, 6] >= 0).all():
        return "vector"
    phi, theta, rms = live[:, 3], live[:, 4], live[:, 5]
    angular = (np.abs(phi) <= 360.01) & (np.abs(theta) <= 90.01) & (rms >= 0)
    return "angles" if angular.mean() > 0.95 and (np.abs(live[:, 3:6]).max(axis=0) > 1.0).any() else ""


def parse_ag500(data: bytes, name: str, options: Options) -> Recording:
    """An AG500 .pos file: no header, 12 channels of 7 little-endian floats, 200 Hz by convention.

    layout: "angles" (x y z phi theta rms extra) or "vector" (x y z, unit vector, rms); told from the
    numbers unless given.
    """
    layout = options.layout or _ag500_layout(data)
    if not layout:
        raise InputError(
            f"{name}: headerless .pos data of unclear layout; pass --layout vector (unit vectors in columns "
            "4 to 6) or --layout angles (phi and theta in degrees)."
        )
    samples = _float_frames(data, 0, AG500_CHANNELS, name)
    notes: list[str] = []
    rate = check_rate(options.rate_hz or AG500_RATE_HZ, name)
    if options.rate_hz is None:
        notes.insert(0, "The file has no header: 12 channels at 200 Hz are assumed, as the AG500 records.")
    else:
        notes.insert(0, "The file has no header: 12 channels are assumed, as the AG500 records.")
    coils = [f"Ch{k + 1}" for k in range(AG500_CHANNELS)]
    times = even_times(len(samples), rate)
    if layout == "angles":
        notes.append("Columns 4 to 7 were taken as phi, theta, rms and a spare; the axes are not stated.")
        return _recording(
            samples, coils, times, rate, "Carstens AG500 .pos, angles", DEVICE_FRAME, notes, name, {}
        )
    notes.append(
        "Columns 4 to 6 are unit vectors, as TAPADM writes them; its axes (x left, y back, z up) are assumed."
    )
    missing = (samples == 0).all(axis=2)
    samples[missing] = np.nan
    positions, more = clean(samples[:, :, :3])
    return Recording(
        coils=tuple(coils), positions=positions, times_s=times, rate_hz=rate,
        format="Carstens AG500 .pos, unit vectors", frame=VECTOR_FRAME,
        orientations=unit_vectors(samples[:, :, 3:6]), rms=np.ascontiguousarray(samples[:, :, 6]), source=name,
        notes=(*notes, *more, *coverage_notes(coils, positions)),
    )  # fmt: skip


# .txt export ----------------------------------------------------------------------------------------


def _delimiter(line: str) -> str | None:
    return next((mark for mark in "\t;," if mark in line), None)


def _channel_names(cells: Sequence[str]) -> list[str] | None:
    """Coil names of a header in groups `NAME_X NAME_Y NAME_Z NAME_phi NAME_theta NAME_RMS NAME_Extra`."""
    cells = [cell.strip().strip('"') for cell in cells]
    while cells and not cells[-1]:
        cells.pop()
    if not cells or len(cells) % 7:
        return None
    names = []
    for start in range(0, len(cells), 7):
        group = [cell.rpartition("_") for cell in cells[start : start + 7]]
        if [suffix.lower() for _, _, suffix in group] != list(FIELDS) or len({p for p, _, _ in group}) != 1:
            return None
        names.append(group[0][0])
    return names


def is_text_with_header(lines: Sequence[str]) -> bool:
    return bool(lines) and _channel_names(lines[0].split(_delimiter(lines[0]))) is not None


def is_text_without_header(lines: Sequence[str]) -> bool:
    """Whether the first lines hold 7 columns a channel with believable angles, fit error and spare."""
    if not lines or _delimiter(lines[0]) is None:
        return False
    rows = split_rows("\n".join(lines[:50]) + "\n", _delimiter(lines[0]), "")
    width = _width(rows[0]) if rows else 0
    if width == 0 or width % 7:
        return False
    try:
        table = number_table(rows, width, "").reshape(-1, 7)
    except InputError:
        return False
    table = table[np.isfinite(table).all(axis=1)]
    return bool(
        len(table)
        and (table != 0).any()
        and (np.abs(table[:, 3]) <= 360.01).all()
        and (np.abs(table[:, 4]) <= 90.01).all()
        and (table[:, 5] >= 0).all()
        and (table[:, 6] == 0).all()
    )


def _width(row: Sequence[str]) -> int:
    width = len(row)
    while width and not row[width - 1].strip():
        width -= 1
    return width


def parse_text(data: bytes, name: str, options: Options) -> Recording:
    """A Carstens .txt export, with or without the `Ch1_X ...` line; NA and blanks are missing.

    The export states no sampling rate: InputError asks for --rate when options do not give it.
    """
    text = decode(data)
    rows = split_rows(text, _delimiter(text.split("\n", 1)[0]), name)
    notes: list[str] = []
    coils = _channel_names(rows[0]) if rows else None
    first_line = 1
    if coils is not None:
        rows, first_line = rows[1:], 2
        words = "Carstens .txt export with header"
    else:
        width = _width(rows[0]) if rows else 0
        if width == 0 or width % 7:
            raise InputError(f"{name}: line 1 has {width} columns, expected 7 for every channel.")
        coils = [f"Ch{k + 1}" for k in range(width // 7)]
        words = "Carstens .txt export without header"
        notes.append("The columns have no names: x y z phi theta rms extra for every channel are assumed.")
    if not rows:
        raise InputError(f"{name}: no frame follows the header; export the sweep again.")
    if options.rate_hz is None:
        raise InputError(
            f"{name}: a Carstens .txt export states no sampling rate; pass it with --rate (an AG501 mostly "
            "records at 250, an AG500 at 200)."
        )
    rate = check_rate(options.rate_hz, name)
    samples = number_table(rows, 7 * len(coils), name, first_line).reshape(len(rows), len(coils), 7)
    notes.append("The axes are not stated in the export; those of head-corrected AG501 data are assumed.")
    notes.append("Positions are rounded to 0.01 mm in this format.")
    return _recording(
        samples, coils, even_times(len(samples), rate), rate, words, NORMPOS_FRAME, notes, name, {}
    )


# Shared ---------------------------------------------------------------------------------------------


def _float_frames(data: bytes, start: int, channels: int, name: str) -> FloatArray:
    """(frames, channels, 7) float64 from `start` on; a file that ends within a frame is refused."""
    frame_bytes = channels * 28
    count, rest = divmod(len(data) - start, frame_bytes)
    if count == 0:
        raise InputError(
            f"{name}: {len(data) - start} bytes after the header are less than one frame of {channels} channels "
            f"({frame_bytes} bytes); the file is truncated, so copy or record it again."
        )
    if rest:
        raise InputError(
            f"{name}: after {count} whole frames the file ends within a frame ({rest} of {frame_bytes} bytes); it is "
            f"truncated, so copy it again, or cut it to {len(data) - rest} bytes to read the whole frames."
        )
    numbers = np.frombuffer(data, "<f4", count * channels * 7, start)
    with np.errstate(invalid="ignore"):  # damaged bytes can be signalling NaN
        return numbers.reshape(count, channels, 7).astype(np.float64)


def _recording(
    samples: FloatArray,
    coils: list[str],
    times: FloatArray,
    rate: float,
    words: str,
    frame: FrameOfReference,
    notes: list[str],
    name: str,
    extra: dict[str, str],
) -> Recording:
    """From (frames, channels, 7) in the angle layout; all-zero samples become NaN."""
    samples[(samples[:, :, :6] == 0).all(axis=2)] = np.nan
    positions, more = clean(samples[:, :, :3])
    with np.errstate(invalid="ignore"):
        axes = axes_from_angles(samples[:, :, 3], samples[:, :, 4])
    return Recording(
        coils=tuple(coils), positions=positions, times_s=times, rate_hz=rate, format=words, frame=frame,
        orientations=axes, rms=np.ascontiguousarray(samples[:, :, 5]), source=name,
        notes=(*notes, *more, *coverage_notes(coils, positions)), extra=extra,
    )  # fmt: skip
