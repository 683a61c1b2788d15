"""The EMA JSON of the authors of the multilinear tongue model.

    {"channels": {NAME: {"position": [x, y, z, x, y, z, ...], "RMS": [...]}},
     "timestamps": [s, ...], "samplingFrequency": Hz}

JSON has no NaN, and the authors' programs expect a number everywhere. A missing sample is therefore
written as the coil's last known position (before the first, its first; for a coil without any, zeros)
with an RMS of -1, which no fit error can be; reading turns a negative RMS, null, or a position of exactly
(0, 0, 0) into NaN. Where a
recording has no fit error RMS is 0 throughout, and is read as "not in the file". The format states no
axes; orientations, notes and the frame of reference do not fit into it.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from ... import InputError
from ..frames import FloatArray, Recording
from .common import Options, check_rate, clean, coverage_notes, frame_times, without_padding

MISSING_RMS = -1.0


def is_authors(head: str) -> bool:
    words = ('"channels"', '"timestamps"', '"samplingFrequency"')
    return head.lstrip().startswith("{") and any(word in head for word in words)


def parse_authors(data: bytes, name: str, options: Options) -> Recording:
    """The authors' EMA JSON; positions in mm."""
    try:
        content: Any = json.loads(data)
    except (ValueError, RecursionError) as error:
        where = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise InputError(
            f"{name}: this is not valid JSON{where}; the file is damaged or cut short."
        ) from error
    if (
        not isinstance(content, dict)
        or not isinstance(content.get("channels"), dict)
        or not content["channels"]
    ):
        raise InputError(f'{name}: the JSON has no "channels" with coils; expected the authors\' EMA format.')
    stamps = _numbers(content.get("timestamps"), name, "timestamps")
    frames = len(stamps)
    if frames == 0:
        raise InputError(f"{name}: timestamps are empty; there is nothing to read.")
    coils, positions, rms = [], [], []
    for coil, channel in content["channels"].items():
        channel = channel if isinstance(channel, dict) else {}
        position = _numbers(channel.get("position"), name, f"the position of {coil!r}")
        if len(position) != 3 * frames:
            raise InputError(
                f"{name}: the position of {coil!r} has {len(position)} numbers, expected {3 * frames} "
                f"(3 for each of {frames} timestamps)."
            )
        error_of = (
            _numbers(channel["RMS"], name, f"the RMS of {coil!r}") if "RMS" in channel else np.zeros(frames)
        )
        if len(error_of) != frames:
            raise InputError(f"{name}: the RMS of {coil!r} has {len(error_of)} numbers, expected {frames}.")
        coils.append(coil)
        positions.append(position.reshape(frames, 3))
        rms.append(error_of)
    fit = np.stack(rms, axis=1)
    points = np.stack(positions, axis=1)
    points[fit < 0] = np.nan
    fit = np.where(fit < 0, np.nan, fit)
    points, notes = clean(points)
    points, padding = without_padding(points)
    notes += padding
    stated = content.get("samplingFrequency")
    if isinstance(stated, int | float) and not isinstance(stated, bool):
        stated = check_rate(stated if abs(stated) < 1e9 else 0.0, name)
    elif stated is not None:
        raise InputError(f"{name}: samplingFrequency is {str(stated)[:30]!r}, expected a number of Hz.")
    times, rate, more = frame_times(stamps, name, options.rate_hz or stated, stated)
    if stated and abs(stated - rate) > 1e-3 * stated:
        more.append(
            f"samplingFrequency is {stated:g} Hz, the timestamps give {rate:g} Hz; the first was kept."
        )
    notes += more
    notes.append("The format states no axes.")
    return Recording(
        coils=tuple(coils), positions=points, times_s=times, rate_hz=stated or rate, format="authors' EMA JSON",
        rms=fit if np.nansum(np.abs(fit)) > 0 else None, source=name,
        notes=(*notes, *coverage_notes(coils, points)),
    )  # fmt: skip


def _numbers(value: object, name: str, what: str) -> FloatArray:
    """A flat list of numbers (null = NaN) as float64."""
    if not isinstance(value, list) or not all(
        item is None or (isinstance(item, int | float) and not isinstance(item, bool)) for item in value
    ):
        raise InputError(f"{name}: {what} must be a list of numbers.")
    try:
        return np.array([np.nan if item is None else item for item in value], dtype=np.float64)
    except OverflowError:
        raise InputError(f"{name}: {what} holds a number too large to be one.") from None


def authors_bytes(recording: Recording) -> bytes:
    """The recording in the authors' format; coordinates as they are, in mm."""
    channels = {}
    valid = recording.valid()
    for k, coil in enumerate(recording.coils):
        position = _held(recording.positions[:, k], valid[:, k])
        fit = np.zeros(recording.frame_count) if recording.rms is None else np.nan_to_num(recording.rms[:, k])
        fit = np.where(valid[:, k], np.maximum(fit, 0.0), MISSING_RMS)
        channels[coil] = {"position": position.ravel().tolist(), "RMS": fit.tolist()}
    content = {
        "channels": channels,
        "timestamps": recording.times_s.tolist(),
        "samplingFrequency": recording.rate_hz,
    }
    return json.dumps(content, allow_nan=False).encode()


def _held(points: FloatArray, valid: np.ndarray[Any, Any]) -> FloatArray:
    """(frames, 3) with missing samples replaced by the last known one, or the first, or zero."""
    if not valid.any():
        return np.zeros_like(points)
    last = np.maximum.accumulate(np.where(valid, np.arange(len(points)), -1))
    return points[np.where(last < 0, int(np.argmax(valid)), last)]
