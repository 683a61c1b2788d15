"""Which point of a volumetric cloud a vertex belongs to (paper, "Template matching": the modified nearest neighbour).

A cloud out of a scan holds everything that borders on air or bone, not only the surface that is sought. Candidates of
a vertex are the points within a radius whose normals differ little from its own; the nearest of those that lie below
the current surface is taken, and only where there is none, the nearest above it. "Below" is behind the plane through
the vertex across its normal. A surface that starts out too high thus sinks down to its own points, past unrelated ones
above it; one that starts too low rises, for then nothing is below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .. import InputError
from .cloud import Cloud
from .mesh import FloatArray

CELL_MM = 2.0  # half the usual radius: few cells to look into, and little in them that is too far
MOST_CELLS = 4_000_000  # of a cloud that is spread widely, cells get larger


@dataclass(frozen=True)
class NeighbourRule:
    """radius_mm: how far away a neighbour may be; angle_deg: how far its normal may turn away from the vertex's."""

    radius_mm: float = 4.0
    angle_deg: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_mm <= 1000.0 or not 0.0 < self.angle_deg <= 180.0:
            raise InputError(
                f"neighbours within {self.radius_mm:g} mm and {self.angle_deg:g} degrees cannot be sought; expected "
                "above 0 and at most 1000 mm and 180 degrees."
            )


class SurfaceIndex:
    """A cloud with normals, sorted into cubic cells so that neighbours are found fast.

    points, normals: (n, 3), as in the cloud. Raises InputError where the cloud is empty, is not made of numbers, or
    has no normals.
    """

    def __init__(self, cloud: Cloud) -> None:
        points = np.ascontiguousarray(cloud.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
            raise InputError("a point cloud needs points with three coordinates each, all of them numbers.")
        if cloud.normals is None:
            raise InputError("the point cloud has no normals; without them, no neighbours can be told apart.")
        normals = np.ascontiguousarray(cloud.normals, dtype=np.float64)
        if normals.shape != points.shape or not np.isfinite(normals).all():
            raise InputError(f"{len(points)} points have {len(normals)} normals; expected one for each.")
        self.points, self.normals = points, normals
        self._low = points.min(axis=0)
        extent = np.ptp(points, axis=0)
        self._cell = CELL_MM
        while np.prod(np.floor(extent / self._cell) + 1.0) > MOST_CELLS:
            self._cell *= 2.0
        self._counts = (np.floor(extent / self._cell) + 1.0).astype(np.int64)
        place = ((points - self._low) / self._cell).astype(np.int64)
        cell = (place[:, 0] * self._counts[1] + place[:, 1]) * self._counts[2] + place[:, 2]
        self._order = np.argsort(cell, kind="stable")
        starts = np.searchsorted(cell[self._order], np.arange(int(self._counts.prod()) + 1))
        self._starts = starts.astype(np.int64)
        self._sorted_points = points[self._order]
        self._sorted_normals = normals[self._order]

    def nearest(
        self, vertices: FloatArray, normals: FloatArray, rule: NeighbourRule
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """(n,) the index of the point of each of the vertices (n, 3), mm, with unit normals (n, 3), outwards; and
        (n,) whether it has one (the index is 0 where not)."""
        found = _nearest(
            np.ascontiguousarray(vertices, dtype=np.float64),
            np.ascontiguousarray(normals, dtype=np.float64),
            self._sorted_points,
            self._sorted_normals,
            self._starts,
            self._low,
            self._cell,
            self._counts,
            rule.radius_mm,
            float(np.cos(np.radians(rule.angle_deg))),
        )
        valid = found >= 0
        return np.asarray(self._order[np.where(valid, found, 0)], dtype=np.intp) * valid, valid

    def neighbours(
        self, vertices: FloatArray, normals: FloatArray, rule: NeighbourRule
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(n, 3) the points themselves, mm, and (n,) whether there is one; as `nearest`."""
        index, valid = self.nearest(vertices, normals, rule)
        return self.points[index], valid

    def targets(
        self, vertices: FloatArray, normals: FloatArray, rule: NeighbourRule
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(n, 3) where each vertex comes to lie when it is moved straight onto the plane that touches the surface at
        its neighbour, mm, and (n,) whether there is one; as `nearest`.

        A cloud's points are a voxel apart, and the nearest one below may lie more to the side than below; what it
        says about the surface is where that is, not which place on it the vertex belongs to.
        """
        index, valid = self.nearest(vertices, normals, rule)
        across = self.normals[index]
        apart = np.einsum("va,va->v", across, self.points[index] - vertices)
        return vertices + across * apart[:, None], valid


@njit(cache=True)
def _nearest(
    vertices: FloatArray,
    vertex_normals: FloatArray,
    points: FloatArray,
    normals: FloatArray,
    starts: NDArray[np.int64],
    low: FloatArray,
    cell: float,
    counts: NDArray[np.int64],
    radius: float,
    least_cosine: float,
) -> NDArray[np.int64]:
    """(n,) index among the sorted points, or -1."""
    found = np.full(len(vertices), -1, dtype=np.int64)
    first, last = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for v in range(len(vertices)):
        x, y, z = vertices[v]
        a, b, c = vertex_normals[v]
        for axis in range(3):
            place = vertices[v, axis] - low[axis]
            # Bounded before they become whole numbers: a vertex may be anywhere.
            first[axis] = int(min(max((place - radius) / cell, 0.0), float(counts[axis])))
            last[axis] = int(min(max((place + radius) / cell + 1.0, 0.0), float(counts[axis])))
        below, above = radius * radius, radius * radius
        best_below, best_above = -1, -1
        for i in range(first[0], last[0]):
            for j in range(first[1], last[1]):
                row = (i * counts[1] + j) * counts[2]
                # Cells along the last axis follow each other.
                for p in range(starts[row + first[2]], starts[row + last[2]]):
                    dx, dy, dz = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared > max(below, above):
                        continue
                    if a * normals[p, 0] + b * normals[p, 1] + c * normals[p, 2] < least_cosine:
                        continue
                    if a * dx + b * dy + c * dz <= 0.0:
                        if squared <= below:
                            below, best_below = squared, p
                    elif squared <= above:
                        above, best_above = squared, p
        found[v] = best_below if best_below >= 0 else best_above
    return found
