"""Some slices of a scan side by side as one picture, and the lines in which surfaces cut them, to be laid over it."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ... import InputError
from ..mesh import FloatArray, Mesh
from .contours import contour
from .reading import library
from .scan import Scan
from .slicepicture import PLANES, magnified, slice_values

PIXEL_MM = 0.33
GAP_MM = 2.0
QUALITY = 88  # of the JPEG picture
LEAST_MM = 5.0  # of a scan, along each axis, for there to be something to see
BESIDE = "its surfaces lie beside the scan, so that there is nothing to show."


@dataclass(frozen=True)
class Panel:
    """One slice. left_mm: where it begins in the sheet; lines: by surface, (k, 2) mm rightwards and downwards from the
    sheet's upper left corner."""

    title: str
    left_mm: float
    width_mm: float
    lines: Mapping[str, list[FloatArray]]


@dataclass(frozen=True)
class Sheet:
    """picture: JPEG, grey, of width_mm x height_mm."""

    picture: bytes
    width_mm: float
    height_mm: float
    panels: tuple[Panel, ...]


def sheet_of(
    scan: Scan,
    surfaces: Mapping[str, Mesh],
    low_mm: FloatArray,
    high_mm: FloatArray,
    places: Sequence[tuple[str, float]],
) -> Sheet:
    """Slices (plane, mm along the axis across it) of the box between two corners (3,) mm, in the scan's world.

    The box ends where the scan ends; slices beside it are left out. Raises InputError, without the scan's name, where
    nothing is left.
    """
    corners = scan.points(np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(scan.values.shape) - 1))
    first, last = np.maximum(low_mm, corners.min(axis=0)), np.minimum(high_mm, corners.max(axis=0))
    if not (last - first > LEAST_MM).all():
        raise InputError(BESIDE)
    pictures, panels = [], []
    left, height = 0.0, float(last[2] - first[2])
    for plane, at_mm in places:
        _, right, up = PLANES[plane]
        low, high = first[[right, up]], last[[right, up]]
        try:
            values, edges = slice_values(scan, plane, at_mm)
        except InputError:
            continue
        pictures.append(magnified(values, edges, low, high, PIXEL_MM))
        lines = {
            name: [(line - [low[0], high[1]]) * [1.0, -1.0] + [left, 0.0] for line in found]
            for name, mesh in surfaces.items()
            if (found := contour(mesh, plane, at_mm))
        }
        width = float(high[0] - low[0])
        panels.append(Panel(f"{plane}, {'xyz'[PLANES[plane][0]]} = {at_mm:.0f} mm", left, width, lines))
        left += width + GAP_MM
    if not panels:
        raise InputError(BESIDE)
    gap = np.full((len(pictures[0]), round(GAP_MM / PIXEL_MM)), 255, dtype=np.uint8)
    row = [part for picture in pictures for part in (picture, gap)][:-1]
    stream = io.BytesIO()
    library("PIL.Image").fromarray(np.hstack(row)).save(stream, format="jpeg", quality=QUALITY)
    return Sheet(stream.getvalue(), left - GAP_MM, height, tuple(panels))
