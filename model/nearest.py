"""The nearest of some meshes to a sample, by the mean distance of corresponding vertices; exact, and compiled.

    error(x) = min over meshes t of  1/V sum_v |x_v - t_v|

Most meshes are ruled out without looking at their vertices. With the vertices in groups, the triangle inequality gives

    sum_v |x_v - t_v|  >=  sum_g  n_g |mean of x in g - mean of t in g|

and because tongues differ smoothly, few groups already come within some percent of the truth. The meshes are then
visited by growing bound, until a bound exceeds the best that was found. float32, in mm relative to some middle: errors
are good to about 1e-5 mm. Bounds are lowered by as much, so that rounding never rules out the nearest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .mesh import FloatArray

Float32Array = NDArray[np.float32]

GROUPS = 16
ROUNDING_MM = 1e-4  # of a bound; well above what float32 does to a mean of such distances
_FAST = {"reassoc", "nsz", "contract", "arcp"}  # sums may be reordered, so that they use vector instructions


@dataclass(frozen=True)
class NearestMesh:
    """Meshes to look among, prepared. Coordinates are relative to a middle of the caller's choice.

    meshes: (t, 3, V) float32 mm; group_means: (t, 3, g) float32, of the same; weights: (g,) float32, the share of the
    vertices in each group; grouping: (V, g), what takes the mean over each group.
    """

    meshes: Float32Array
    group_means: Float32Array
    weights: Float32Array
    grouping: FloatArray

    @classmethod
    def among(cls, meshes: FloatArray, places: FloatArray, groups: int = GROUPS) -> NearestMesh:
        """meshes: (t, V, 3) mm; places: (V, 3) mm, of the vertices in a typical mesh, by which they are grouped."""
        members = vertex_groups(places, groups)
        grouping = np.zeros((len(places), len(members)))
        for group, vertices in enumerate(members):
            grouping[vertices, group] = 1.0 / len(vertices)
        weights = np.array([len(vertices) for vertices in members]) / len(places)
        apart = meshes.transpose(0, 2, 1)
        return cls(_single(apart), _single(apart @ grouping), _single(weights), grouping)

    def errors(self, samples: Float32Array, group_means: Float32Array) -> Float32Array:
        """(b,) mm: of samples (b, 3, V), whose means over the groups are group_means (b, 3, g)."""
        found = np.empty(len(samples), dtype=np.float32)
        _nearest(samples, group_means, self.meshes, self.group_means, self.weights, found)
        return found


def vertex_groups(places: FloatArray, groups: int) -> list[NDArray[np.intp]]:
    """The vertices (V, 3) in at most so many compact groups of almost one size: cut in two where they are longest."""
    groups = min(groups, len(places))
    parts = [np.arange(len(places), dtype=np.intp)]
    while len(parts) < groups:
        parts.sort(key=len)
        largest = parts.pop()
        extent = np.ptp(places[largest], axis=0)
        ordered = largest[np.argsort(places[largest, int(np.argmax(extent))], kind="stable")]
        parts += [ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]]
    return parts


def _single(values: FloatArray) -> Float32Array:
    return np.ascontiguousarray(values, dtype=np.float32)


@njit(cache=True, fastmath=_FAST)
def _mean_distance(one: Float32Array, other: Float32Array) -> np.floating:
    """Of points (3, n) each."""
    total = np.float32(0.0)
    for vertex in range(one.shape[1]):
        x = one[0, vertex] - other[0, vertex]
        y = one[1, vertex] - other[1, vertex]
        z = one[2, vertex] - other[2, vertex]
        total += np.sqrt(x * x + y * y + z * z)
    return total / np.float32(one.shape[1])


@njit(cache=True, fastmath=_FAST)
def _weighted_distance(one: Float32Array, other: Float32Array, weights: Float32Array) -> np.floating:
    """Of points (3, g) each; weights (g,) with the sum 1."""
    total = np.float32(0.0)
    for group in range(one.shape[1]):
        x = one[0, group] - other[0, group]
        y = one[1, group] - other[1, group]
        z = one[2, group] - other[2, group]
        total += weights[group] * np.sqrt(x * x + y * y + z * z)
    return total


@njit(cache=True)
def _nearest(
    samples: Float32Array,
    sample_means: Float32Array,
    meshes: Float32Array,
    mesh_means: Float32Array,
    weights: Float32Array,
    found: Float32Array,
) -> None:
    """found (b,): as `NearestMesh.errors`."""
    count = len(meshes)
    bounds = np.empty(count, dtype=np.float32)
    for sample in range(len(samples)):
        for mesh in range(count):
            bounds[mesh] = _weighted_distance(sample_means[sample], mesh_means[mesh], weights)
        best: np.floating = np.float32(np.inf)
        for _ in range(count):
            nearest = np.argmin(bounds)
            if bounds[nearest] - np.float32(ROUNDING_MM) >= best:
                break
            distance = _mean_distance(samples[sample], meshes[nearest])
            best = min(best, distance)
            bounds[nearest] = np.inf
        found[sample] = best
