"""X-ray microbeam .txy: time in microseconds, then x and y of eight pellets in micrometres.

Two-dimensional data are laid into the house's axes: y = front-back (the file's x, growing to the front),
z = vertical (the file's y), x = 0. The value 1000000 marks a pellet that was not tracked.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ... import InputError
from ..frames import FrameOfReference, Recording
from .common import Options, clean, coverage_notes, decode, frame_times, number_table, split_rows

PELLETS = ("UL", "LL", "T1", "T2", "T3", "T4", "MNI", "MNM")
COLUMNS = 1 + 2 * len(PELLETS)
LOST = 1_000_000.0
FRAME = FrameOfReference("absent", "front", "up", "upper incisors")


def is_txy(lines: Sequence[str]) -> bool:
    """17 numbers a line, the first counting thousands of microseconds, the rest within 300 mm or lost."""
    rows = [line.split() for line in lines[:50]]
    if len(rows) < 2 or any(len(row) != COLUMNS for row in rows):
        return False
    try:
        table = number_table(rows, COLUMNS, "")
    except InputError:
        return False
    steps, values = np.diff(table[:, 0]), np.abs(table[:, 1:])
    return bool((steps > 100).all() and (values > 200).any() and ((values < 3e5) | (values == LOST)).all())


def parse_txy(data: bytes, name: str, options: Options) -> Recording:
    """An X-ray microbeam record; T1 is the tongue tip."""
    rows = split_rows(decode(data), None, name)
    notes: list[str] = []
    table = number_table(rows, COLUMNS, name)
    values = table[:, 1:].reshape(len(table), len(PELLETS), 2)
    lost = (values == LOST).any(axis=2)
    positions = np.zeros((len(table), len(PELLETS), 3))
    positions[:, :, 1:] = values / 1000.0
    positions[lost] = np.nan
    positions, more = clean(positions)
    times, rate, gaps = frame_times(table[:, 0] / 1e6, name, options.rate_hz)
    notes += more + gaps
    notes.append("The file names no pellets; UL LL T1 T2 T3 T4 MNI MNM are assumed, T1 the tongue tip.")
    notes.append("Two-dimensional data: y is the file's x (growing to the front), z the file's y, x is 0.")
    return Recording(
        coils=PELLETS, positions=positions, times_s=times, rate_hz=rate, format="X-ray microbeam .txy",
        frame=FRAME, source=name, notes=(*notes, *coverage_notes(PELLETS, positions)),
    )  # fmt: skip
