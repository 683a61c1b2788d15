"""How far points are from a triangle mesh: exact, to the nearest place on any of its faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .mesh import FloatArray, IndexArray, Mesh

LEAF = 16  # faces in a box that is not divided any more, at most
FLAT = 1e-12  # a triangle with less of its sides' product as area, squared, is a line


@dataclass(frozen=True)
class Nearest:
    """The nearest place on a mesh to each of n points.

    distance_mm: (n,); place: (n, 3) mm; face: (n,) on which it lies; weights: (n, 3) of the face's corners, from 0 to 1
    with the sum 1.
    """

    distance_mm: FloatArray
    place: FloatArray
    face: NDArray[np.intp]
    weights: FloatArray

    def corner(self, mesh: Mesh) -> NDArray[np.intp]:
        """(n,) the vertex that has most weight in each place."""
        corners = mesh.faces[self.face]
        return np.asarray(corners[np.arange(len(corners)), np.argmax(self.weights, axis=1)], dtype=np.intp)


def nearest_on(mesh: Mesh, points: FloatArray) -> Nearest:
    """Points (n, 3) mm. The mesh needs a face.

    The faces are sorted into a tree of boxes, cut in two where they are longest; a box further away than the nearest
    face so far is not looked into.
    """
    triangles = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float64)
    order, starts, boxes = _tree(triangles)
    face = np.empty(len(points), dtype=np.int64)
    weights = np.empty((len(points), 3))
    places = np.ascontiguousarray(points, dtype=np.float64)
    _search(places, triangles[order], starts, boxes, face, weights)
    face = order[face]
    nearest = np.einsum("pk,pka->pa", weights, triangles[face])
    return Nearest(np.linalg.norm(nearest - places, axis=1), nearest, face, weights)


def boundary_edges(faces: IndexArray) -> NDArray[np.int32]:
    """(e, 2) the edges with a face on one side only, the lower vertex first."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique[counts == 1]


def beyond_the_boundary(mesh: Mesh, nearest: Nearest) -> NDArray[np.bool_]:
    """(n,): whether the nearest place is on the edge of an open mesh, so that the point may lie beside the mesh."""
    corners = mesh.faces[nearest.face]
    ends = boundary_edges(mesh.faces)
    at_end = np.zeros(len(mesh.vertices), dtype=bool)
    at_end[ends] = True
    touching = nearest.weights > 1e-9
    held = touching.sum(axis=1)
    beyond = (held == 1) & (at_end[corners] & touching).any(axis=1)
    on_edge = np.flatnonzero(held == 2)
    edges = np.sort(corners[on_edge][touching[on_edge]].reshape(-1, 2), axis=1)
    numbers = np.array([len(mesh.vertices), 1], dtype=np.int64)
    beyond[on_edge] = np.isin(edges @ numbers, ends @ numbers)
    return np.asarray(beyond)


def vertex_areas(mesh: Mesh) -> FloatArray:
    """(n,) mm^2: a third of the faces around each vertex."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    thirds = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
    counted = np.bincount(mesh.faces.ravel(), np.repeat(thirds, 3), minlength=len(mesh.vertices))
    return counted.astype(np.float64)


def _tree(triangles: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.int64], FloatArray]:
    """(f,) the faces in the leaves' order; (leaves + 1,) where each leaf begins; (2 leaves, 2, 3) the lowest and the
    highest corner of every box, of which 1 is the root, and 2 b and 2 b + 1 are the parts of b."""
    depth = max(0, int(np.ceil(np.log2(len(triangles) / LEAF))))
    centres = triangles.mean(axis=1)
    parts = [np.arange(len(triangles), dtype=np.intp)]
    for _ in range(depth):
        halves = []
        for part in parts:
            axis = int(np.argmax(np.ptp(centres[part], axis=0)))
            sorted_ = part[np.argsort(centres[part, axis], kind="stable")]
            halves += [sorted_[: len(part) // 2], sorted_[len(part) // 2 :]]
        parts = halves
    order = np.concatenate(parts)
    starts = np.cumsum([0, *(len(part) for part in parts)])
    boxes = np.empty((2 * len(parts), 2, 3))
    boxes[len(parts) :, 0] = np.minimum.reduceat(triangles[order].min(axis=1), starts[:-1])
    boxes[len(parts) :, 1] = np.maximum.reduceat(triangles[order].max(axis=1), starts[:-1])
    for box in range(len(parts) - 1, 0, -1):
        boxes[box, 0] = np.minimum(boxes[2 * box, 0], boxes[2 * box + 1, 0])
        boxes[box, 1] = np.maximum(boxes[2 * box, 1], boxes[2 * box + 1, 1])
    return order, starts.astype(np.int64), boxes


@njit(cache=True)
def _search(
    points: FloatArray,
    triangles: FloatArray,
    starts: NDArray[np.int64],
    boxes: FloatArray,
    face: NDArray[np.int64],
    weights: FloatArray,
) -> None:
    """face (n,), weights (n, 3): as `Nearest`, among the sorted triangles."""
    leaves = len(starts) - 1
    stack = np.empty(128, dtype=np.int64)  # twice as deep as a tree can be
    for p in range(len(points)):
        point = points[p]
        best = np.inf
        stack[0] = 1
        waiting = 1
        while waiting > 0:
            waiting -= 1
            box = stack[waiting]
            if _to_box(point, boxes[box]) >= best:
                continue
            if box < leaves:
                near, far = 2 * box, 2 * box + 1
                if _to_box(point, boxes[far]) < _to_box(point, boxes[near]):
                    near, far = far, near
                stack[waiting], stack[waiting + 1] = far, near
                waiting += 2
                continue
            for f in range(starts[box - leaves], starts[box - leaves + 1]):
                a, b, c = _nearest_weights(triangles[f], point)
                squared = 0.0
                for axis in range(3):
                    place = a * triangles[f, 0, axis] + b * triangles[f, 1, axis] + c * triangles[f, 2, axis]
                    squared += (place - point[axis]) ** 2
                if squared < best:
                    best = squared
                    face[p] = f
                    weights[p, 0], weights[p, 1], weights[p, 2] = a, b, c


@njit(cache=True)
def _to_box(point: FloatArray, box: FloatArray) -> float:
    """mm^2."""
    squared = 0.0
    for axis in range(3):
        out = max(box[0, axis] - point[axis], point[axis] - box[1, axis], 0.0)
        squared += out * out
    return squared


@njit(cache=True)
def _nearest_weights(triangle: FloatArray, point: FloatArray) -> tuple[float, float, float]:
    """The weights of the corners in the place of a triangle (3, 3) that is nearest to a point (3,).

    In the plane of the triangle where that place is inside of it; else on the nearest of its three sides.
    """
    square = mixed = other = first = second = 0.0
    for axis in range(3):
        along = triangle[1, axis] - triangle[0, axis]
        across = triangle[2, axis] - triangle[0, axis]
        out = point[axis] - triangle[0, axis]
        square += along * along
        mixed += along * across
        other += across * across
        first += along * out
        second += across * out
    scale = square * other - mixed * mixed
    if scale > FLAT * square * other:
        v = (other * first - mixed * second) / scale
        w = (square * second - mixed * first) / scale
        if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
            return 1.0 - v - w, v, w
    best, side, place = np.inf, 0, 0.0
    for start in range(3):
        end = (start + 1) % 3
        length = out_along = 0.0
        for axis in range(3):
            step = triangle[end, axis] - triangle[start, axis]
            length += step * step
            out_along += step * (point[axis] - triangle[start, axis])
        share = min(max(out_along / length, 0.0), 1.0) if length > 0.0 else 0.0
        squared = 0.0
        for axis in range(3):
            step = triangle[end, axis] - triangle[start, axis]
            squared += (triangle[start, axis] + share * step - point[axis]) ** 2
        if squared < best:
            best, side, place = squared, start, share
    if side == 0:
        return 1.0 - place, place, 0.0
    if side == 1:
        return 0.0, 1.0 - place, place
    return place, 0.0, 1.0 - place
