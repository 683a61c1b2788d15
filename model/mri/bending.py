"""A surface that bends but hardly stretches: every vertex with a rigid motion of its own, compiled.

The energy of positions x and rotations R over the rest shape r, with neighbours N(i) along the edges:

    sum_i w_i |x_i - t_i|^2  +  stiffness sum_i sum_{j in N(i)} |x_i + R_i (r_j - r_i) - x_j|^2

What stands in the second sum is the motion of vertex i, applied to its neighbour j, minus the neighbour's own. For given
x the best R_i follow vertex by vertex; for given R the best x solve a sparse linear system, the same for all three
coordinates. One after the other, neither ever raises the energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..mesh import FloatArray, IndexArray

SETTLED_MM = 1e-4  # root mean square of what a solution would still be moved by one relaxation
MOST_STEPS = 300  # of conjugate gradients
TURNS = 100  # of the search for a rotation, at most
SETTLED_RAD = 1e-6


@dataclass(frozen=True)
class Edges:
    """Who is joined to whom: the neighbours of vertex i are others[starts[i] : starts[i + 1]]."""

    starts: NDArray[np.int64]
    others: NDArray[np.int64]


def edges_of(faces: IndexArray, vertices: int) -> Edges:
    """Of faces (f, 3) over so many vertices."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    pairs = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)
    starts = np.searchsorted(pairs[:, 0], np.arange(vertices + 1))
    return Edges(starts.astype(np.int64), np.ascontiguousarray(pairs[:, 1]))


def no_rotations(vertices: int) -> FloatArray:
    """(n, 3, 3)"""
    return np.tile(np.eye(3), (vertices, 1, 1))


@njit(cache=True)
def turn(
    rotations: FloatArray,
    rest: FloatArray,
    current: FloatArray,
    starts: NDArray[np.int64],
    others: NDArray[np.int64],
) -> None:
    """Makes of rotations (n, 3, 3) those that best take every vertex's edges of rest to those of current, (n, 3) mm.

    Starting from what is there. The proper rotation of largest correlation, found by Newton's method: never a reflection,
    and defined for the flat ring of edges that a vertex has.
    """
    moved = np.empty((3, 3))  # correlation of edges, rows: current, columns: rest
    p = np.empty((3, 3))
    for i in range(len(rest)):
        moved[:] = 0.0
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            for a in range(3):
                for b in range(3):
                    moved[a, b] += (current[j, a] - current[i, a]) * (rest[j, b] - rest[i, b])
        r = rotations[i]
        for _ in range(TURNS):
            # With P = moved R', R is turned by w: tr(P) + w.t - w'(tr(S) 1 - S) w / 2 agreement, S the even part of P.
            for a in range(3):
                for b in range(3):
                    p[a, b] = moved[a, 0] * r[b, 0] + moved[a, 1] * r[b, 1] + moved[a, 2] * r[b, 2]
            t0, t1, t2 = p[2, 1] - p[1, 2], p[0, 2] - p[2, 0], p[1, 0] - p[0, 1]
            agreement = p[0, 0] + p[1, 1] + p[2, 2]
            d0, d1, d2 = agreement - p[0, 0], agreement - p[1, 1], agreement - p[2, 2]
            e01, e02, e12 = -0.5 * (p[0, 1] + p[1, 0]), -0.5 * (p[0, 2] + p[2, 0]), -0.5 * (p[1, 2] + p[2, 1])
            c00, c01, c02 = d1 * d2 - e12 * e12, e02 * e12 - e01 * d2, e01 * e12 - e02 * d1
            determinant = d0 * c00 + e01 * c01 + e02 * c02
            if d0 > 0.0 and d0 * d1 - e01 * e01 > 0.0 and determinant > 1e-12 * d0 * d1 * d2:
                c11, c12, c22 = d0 * d2 - e02 * e02, e01 * e02 - d0 * e12, d0 * d1 - e01 * e01
                x = (c00 * t0 + c01 * t1 + c02 * t2) / determinant
                y = (c01 * t0 + c11 * t1 + c12 * t2) / determinant
                z = (c02 * t0 + c12 * t1 + c22 * t2) / determinant
            else:  # far from it the curvature misleads; the torque still shows the way
                scale = 1.0 / (abs(agreement) + 1e-9)
                x, y, z = t0 * scale, t1 * scale, t2 * scale
            angle = np.sqrt(x * x + y * y + z * z)
            if angle < SETTLED_RAD:
                break
            x, y, z = x / angle, y / angle, z / angle
            angle = min(angle, 1.0)
            c, s = np.cos(angle), np.sin(angle)
            for b in range(3):
                u, v, w = r[0, b], r[1, b], r[2, b]
                along = (x * u + y * v + z * w) * (1.0 - c)
                r[0, b] = u * c + (y * w - z * v) * s + x * along
                r[1, b] = v * c + (z * u - x * w) * s + y * along
                r[2, b] = w * c + (x * v - y * u) * s + z * along


@njit(cache=True)
def move(
    current: FloatArray,
    rotations: FloatArray,
    rest: FloatArray,
    starts: NDArray[np.int64],
    others: NDArray[np.int64],
    weights: FloatArray,
    targets: FloatArray,
    stiffness: float,
) -> None:
    """Makes of current (n, 3) mm the positions of least energy for these rotations (n, 3, 3), starting from there.

    weights: (n,), targets: (n, 3) mm. By conjugate gradients, scaled by the diagonal. At least one weight must be above
    0, or nothing says where the surface is.
    """
    n = len(rest)
    diagonal = np.empty(n)
    residual = np.empty((n, 3))
    for i in range(n):
        degree = starts[i + 1] - starts[i]
        diagonal[i] = weights[i] + 2.0 * stiffness * degree + 1e-12
        for a in range(3):
            residual[i, a] = weights[i] * (targets[i, a] - current[i, a])
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            for a in range(3):
                bent = 0.0
                for b in range(3):
                    bent += (rotations[i, a, b] + rotations[j, a, b]) * (rest[i, b] - rest[j, b])
                residual[i, a] += stiffness * (bent - 2.0 * (current[i, a] - current[j, a]))
    direction = np.empty((n, 3))
    product = np.empty((n, 3))
    power, gain = np.zeros(3), np.zeros(3)
    for i in range(n):
        for a in range(3):
            direction[i, a] = residual[i, a] / diagonal[i]
            power[a] += residual[i, a] * direction[i, a]
    for _ in range(MOST_STEPS):
        gain[:] = 0.0
        for i in range(n):
            degree = starts[i + 1] - starts[i]
            own = weights[i] + 2.0 * stiffness * degree
            x, y, z = own * direction[i, 0], own * direction[i, 1], own * direction[i, 2]
            for e in range(starts[i], starts[i + 1]):
                j = others[e]
                x -= 2.0 * stiffness * direction[j, 0]
                y -= 2.0 * stiffness * direction[j, 1]
                z -= 2.0 * stiffness * direction[j, 2]
            product[i, 0], product[i, 1], product[i, 2] = x, y, z
            gain[0] += x * direction[i, 0]
            gain[1] += y * direction[i, 1]
            gain[2] += z * direction[i, 2]
        for a in range(3):
            gain[a] = power[a] / gain[a] if gain[a] > 0.0 else 0.0
        before = power.copy()
        power[:] = 0.0
        left = 0.0
        for i in range(n):
            for a in range(3):
                current[i, a] += gain[a] * direction[i, a]
                residual[i, a] -= gain[a] * product[i, a]
                scaled = residual[i, a] / diagonal[i]
                power[a] += residual[i, a] * scaled
                left += scaled * scaled
        if left <= n * SETTLED_MM * SETTLED_MM:
            return
        for a in range(3):
            gain[a] = power[a] / before[a] if before[a] > 0.0 else 0.0
        for i in range(n):
            for a in range(3):
                direction[i, a] = residual[i, a] / diagonal[i] + gain[a] * direction[i, a]


@njit(cache=True)
def bent(
    current: FloatArray,
    rotations: FloatArray,
    rest: FloatArray,
    starts: NDArray[np.int64],
    others: NDArray[np.int64],
) -> float:
    """mm^2: the second sum of the energy, without the stiffness."""
    total = 0.0
    for i in range(len(rest)):
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            for a in range(3):
                apart = current[i, a] - current[j, a]
                for b in range(3):
                    apart += rotations[i, a, b] * (rest[j, b] - rest[i, b])
                total += apart * apart
    return total


@njit(cache=True)
def averaged(
    current: FloatArray,
    rotations: FloatArray,
    rest: FloatArray,
    starts: NDArray[np.int64],
    others: NDArray[np.int64],
) -> FloatArray:
    """(n, 3) mm: every vertex where the motions of its neighbours, on average, would take it."""
    smooth = np.zeros_like(current)
    for i in range(len(rest)):
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            for a in range(3):
                place = current[j, a]
                for b in range(3):
                    place += rotations[j, a, b] * (rest[i, b] - rest[j, b])
                smooth[i, a] += place / (starts[i + 1] - starts[i])
    return smooth
