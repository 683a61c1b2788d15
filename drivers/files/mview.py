"""Haskins MVIEW .mat: one structure array with an element a channel (NAME, SRATE, SIGNAL, ...).

SIGNAL is frames x 3 or more (x y z in mm; further columns are undocumented and left out), or frames x 2,
which are laid into the house's axes: y = front-back (the file's x), z = vertical (the file's y), x = 0.
Channels with one column (AUDIO) are not coils.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ... import InputError
from ..frames import FrameOfReference, Recording
from .common import Options, check_rate, clean, coverage_notes, even_times
from .matlab import Value, read_variables

FRAME_3D = FrameOfReference("front", "left", "up", "upper incisors")
FRAME_2D = FrameOfReference("absent", "front", "up", "upper incisors")
NEEDED = {"NAME", "SRATE", "SIGNAL"}


def parse_mview(data: bytes, name: str, options: Options) -> Recording:
    """An MVIEW file (HPRC, USC-TIMIT and others)."""
    channels = _channels(read_variables(data, name), name)
    notes: list[str] = []
    coils: list[str] = []
    signals: list[np.ndarray[Any, Any]] = []
    rates: list[float] = []
    skipped: list[str] = []
    for channel in channels:
        label, signal, rate = channel["NAME"], channel["SIGNAL"], channel["SRATE"]
        if (
            not isinstance(label, str)
            or not isinstance(signal, np.ndarray)
            or not isinstance(rate, np.ndarray)
        ):
            raise InputError(f"{name}: a channel's NAME, SIGNAL or SRATE is not what MVIEW writes.")
        if signal.ndim != 2 or signal.shape[1] < 2 or signal.shape[0] == 0 or rate.size != 1:
            skipped.append(label)
        elif signals and (signal.shape != signals[0].shape or float(rate.flat[0]) != rates[0]):
            skipped.append(f"{label} (another length, width or rate)")
        else:
            coils.append(label.strip())
            signals.append(signal)
            rates.append(float(rate.flat[0]))
    if not signals:
        raise InputError(
            f"{name}: no channel has a SIGNAL of frames x 2 or more; this is not a record of coils."
        )
    rate = check_rate(rates[0], name)
    if skipped:
        notes.append(f"Channels that are not coils were left out: {', '.join(skipped)}.")
    frames, width = signals[0].shape
    positions = np.zeros((frames, len(coils), 3))
    columns = slice(1, 3) if width == 2 else slice(0, 3)
    with np.errstate(invalid="ignore"):
        for k, signal in enumerate(signals):
            positions[:, k, columns] = signal[:, : min(width, 3)]
    if width > 3:
        notes.append(f"Columns 4 to {width} of every coil are undocumented and were left out.")
    if width == 2:
        notes.append(
            "Two-dimensional data: y is the file's x (taken to grow to the front), z the file's y, x is 0."
        )
    else:
        notes.append("The axes are not stated in the file; those of the HPRC corpus are assumed.")
    positions, more = clean(positions)
    return Recording(
        coils=tuple(coils), positions=positions, times_s=even_times(frames, rate), rate_hz=rate,
        format="Haskins MVIEW .mat", frame=FRAME_2D if width == 2 else FRAME_3D, source=name,
        notes=(*notes, *more, *coverage_notes(coils, positions)), extra=_texts(channels),
    )  # fmt: skip


def _channels(variables: Mapping[str, Value], name: str) -> list[dict[str, Value]]:
    for value in variables.values():
        if isinstance(value, list) and value and all(isinstance(v, dict) and NEEDED <= set(v) for v in value):
            return value
    raise InputError(
        f"{name}: no MVIEW structure with the fields NAME, SRATE and SIGNAL among the variables "
        f"{list(variables)[:6]}; a palate trace or another MATLAB file is not a recording."
    )


def _texts(channels: list[dict[str, Value]]) -> dict[str, str]:
    """What was said, and where the audio came from, if the file has it."""
    found = {}
    for field in ("SENTENCE", "SOURCE"):
        text = next((c[field] for c in channels if isinstance(c.get(field), str) and c[field].strip()), None)
        if text:
            found[field] = text.strip()
    return found
