"""How near the tongue is to the palate, along its mid-sagittal contour.

In the model's frame, mm, in the sagittal plane: y front to back, z up; how far the palate's trace strays sideways does
not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...model.multilinear import TongueModel
from ..pose import FloatArray
from .landmarks import contour_with_parts

REGIONS = {"tip": 0.06, "blade": 0.18, "front": 0.33, "body": 0.48, "back": 0.65}
"""Region of the contour -> the part of its length, from the tip, where it ends. Behind the last, the tongue faces the
throat."""
STEP_MM = 1.0
"""Points of the palate's trace that are closer than this to the one before are left out: sweeps have thousands."""


@dataclass(frozen=True)
class Contact:
    """One instant. gap_mm: the smallest distance of tongue and palate, negative where the tongue lies above the
    palate (no real tongue does: the estimate or the palate is off by as much); point: (3,) mm, the tongue's vertex
    there; regions: (5,) mm, the same for each of `REGIONS`. NaN where the palate reaches over no part of it.
    """

    gap_mm: float
    point: FloatArray
    regions: FloatArray


class ContactMeter:
    """Measures one model's poses against one palate (p, 3) mm, two points or more, from front to back.

    regions: the names, in the order of `Contact.regions`. Not for several threads at once: it remembers the speaker.
    """

    def __init__(self, model: TongueModel, palate: FloatArray) -> None:
        contour, parts = contour_with_parts(model)
        ends = np.array(list(REGIONS.values()))
        kept = parts <= ends[-1]
        self._model = model.at(contour[kept].tolist())
        self._in_region = np.searchsorted(ends, parts[kept]) == np.arange(len(ends))[:, None]  # (regions, c)
        self._segments = segments_of(palate)
        self._speaker = self._model.for_speaker(model.speaker.mean)
        self.regions = tuple(REGIONS)

    def measure(self, speaker_weights: FloatArray, weights: FloatArray) -> Contact:
        """Of raw weights (m,) of the speaker and (K,) of the pose."""
        if not np.array_equal(self._speaker.speaker_weights, speaker_weights):
            self._speaker = self._model.for_speaker(speaker_weights)
        points = self._speaker.vertices(weights)
        gaps = gaps_below(points[:, 1:], self._segments)
        comparable = np.where(np.isnan(gaps), np.inf, gaps)
        nearest = int(np.argmin(comparable))
        by_region = np.where(self._in_region, comparable, np.inf).min(axis=1)
        found = bool(np.isfinite(comparable[nearest]))
        return Contact(
            float(gaps[nearest]) if found else float("nan"),
            points[nearest] if found else np.full(3, np.nan),
            np.where(np.isfinite(by_region), by_region, np.nan),
        )


class Segments(NamedTuple):
    """A curve in the sagittal plane, from front to back. start, step: (s, 2) mm; lengths2: (s,) mm^2; back, up: (s + 1,)
    its points' y and z."""

    start: FloatArray
    step: FloatArray
    lengths2: FloatArray
    back: FloatArray
    up: FloatArray


def segments_of(palate: FloatArray) -> Segments:
    """The trace (p, 3) as a curve, thinned to STEP_MM; both ends stay."""
    curve = np.asarray(palate, dtype=np.float64)[:, 1:]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    kept = np.flatnonzero(np.diff(np.floor(along / STEP_MM), prepend=-1.0))
    kept = np.union1d(kept, [len(curve) - 1])
    curve = curve[kept]
    step = np.diff(curve, axis=0)
    return Segments(curve[:-1], step, np.maximum((step**2).sum(axis=1), 1e-12), curve[:, 0], curve[:, 1])


def gaps_below(points: FloatArray, palate: Segments) -> FloatArray:
    """(c,) mm: distance of points (c, 2), y and z, from the curve; negative above it; NaN for a point whose nearest one
    is the curve's front or back end: what is beyond was not traced."""
    offset_y = points[:, :1] - palate.start[:, 0]  # (c, s)
    offset_z = points[:, 1:] - palate.start[:, 1]
    step_y, step_z = palate.step[:, 0], palate.step[:, 1]
    part = np.minimum(np.maximum((offset_y * step_y + offset_z * step_z) / palate.lengths2, 0.0), 1.0)
    distances2 = (offset_y - part * step_y) ** 2 + (offset_z - part * step_z) ** 2
    nearest = distances2.argmin(axis=1)
    rows = np.arange(len(points))
    at = part[rows, nearest]
    beyond = ((nearest == 0) & (at == 0.0)) | ((nearest == len(palate.start) - 1) & (at == 1.0))
    above = points[:, 1] > np.interp(points[:, 0], palate.back, palate.up)
    gaps = np.sqrt(distances2[rows, nearest])
    return np.where(beyond, np.nan, np.where(above, -gaps, gaps))
