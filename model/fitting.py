"""The model fitted to meshes or point clouds of one speaker (paper, section "Model fitting").

    E(s, p_1 .. p_T) = sum_t [ 1/|N_t| sum_{i in N_t} |v_i(s, p_t) - q_ti|^2
                               + gamma/|L_t| sum_{i in L_t} |v_i(s, p_t) - l_ti|^2 ]
    subject to |w - m| <= h d for every weight w, d its deviation

over T meshes that share their speaker s; mm, raw weights, everything in the model's frame. Of a registered mesh
N_t is every vertex and q its own; of a cloud N_t are the vertices with a valid nearest neighbour q, found anew in
each step of a series. L_t are landmarks, with gamma = 1 as in the paper.

d is the deviation of the training weights, "the standard deviation of the corresponding variation in the used mesh
collection", where the model keeps them, else its sigma. It differs from sigma = 1/sqrt(entries) for the one weight of
each mode that carries the mean of the data, and hardly varies. With sigma for its bound, the fit to a new speaker
trades the size of that weight for the poses', as far as the bound, for what the model does not express anyway.

Only what the model can express takes part: every mesh is reduced to its least-squares coordinates in the span of
the core, at most m n of them, so that nothing but the first sum ever sees a vertex. There, a damped Newton
descent over speaker and poses together, with the weights at their bounds held.

The data do not say how large the speaker's weights are: v(c s, p/c) = v(s, p). Of all c that the box allows, the
one is taken that is nearest to the training speakers and poses, in units of their measured deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from .cloud import Cloud
from .mesh import FloatArray, IndexArray, vertex_normals
from .multilinear import Mode, TongueModel
from .neighbours import NeighbourRule, SurfaceIndex

NEIGHBOUR_MM = 4.0
NEIGHBOUR_DEGREES = 60.0
SERIES = 10  # energies, each with new neighbours
CANDIDATES = 128  # nearest points among which one with a fitting normal is sought
LEAST_NEIGHBOURS = 0.25  # of the model's vertices; with fewer, mesh and model are not in one place
LANDMARK_WEIGHT = 1.0

MAX_STEPS = 200
RELATIVE_DECREASE = 1e-9
FIRST_DAMPING = 1e-4
LEAST_DAMPING, LARGEST_DAMPING = 1e-12, 1e12
ROUNDING = 1e-22  # of the squared targets: a lower energy is 0
LEAST_SPREAD = 1e-3  # of sigma: the least deviation that is taken for measured


@dataclass(frozen=True)
class Fit:
    """One speaker for all meshes.

    speaker: (m,) raw weights; poses: (T, n) raw weights, one row for each mesh.
    covariance: (m, m) of the speaker's weights, the poses eliminated. Its noise is what is left over in the span of
        the core, where a misfit counts once however many vertices share it; the training speakers' deviations are
        the prior, so that the scale, which no mesh tells, is as uncertain as they are. Misfits are taken for
        independent between meshes.
    sigma: (m,) the square roots of its diagonal, in units of the model's speaker sigma.
    residual_mm: (T,) mean distance between the model's vertices and what they were fitted to.
    used: (T,) the share of the model's vertices that had something to be fitted to; 1 for registered meshes.
    converged: whether the last descent came to rest.
    """

    speaker: FloatArray
    poses: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    residual_mm: FloatArray
    used: FloatArray
    converged: bool


def fit_shapes(model: TongueModel, vertices: FloatArray, h: float) -> Fit:
    """One speaker and a pose for each of the meshes (T, V, 3), registered to the model and in its frame, mm.

    h: the box in sigma. Raises InputError for no mesh, another number of vertices, or vertices that are no numbers.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.ndim != 3 or vertices.shape[1:] != (model.vertex_count, 3) or not len(vertices):
        raise InputError(
            f"meshes in the shape {vertices.shape} cannot be fitted vertex by vertex; expected at least one, each "
            f"with the {model.vertex_count} vertices of the model '{model.name}'."
        )
    if not np.isfinite(vertices).all():
        raise InputError("a mesh has a vertex that is not a number; registered meshes must be complete.")
    everywhere = np.full(model.vertex_count, 1.0 / model.vertex_count)
    gram = _Gram(model, everywhere)
    problem = _problem_of([gram.reduced(mesh) for mesh in vertices])
    box = _Box.of(model, h, len(vertices))
    found, at_rest = _lowest(problem, box)
    shapes = _shapes(model, found)
    return _fit(
        model, problem, box, found, at_rest, np.linalg.norm(shapes - vertices, axis=2).mean(axis=1),
        np.ones(len(vertices)),
    )  # fmt: skip


def fit_points(
    model: TongueModel,
    points: FloatArray,
    normals: FloatArray | None = None,
    landmarks: Mapping[int, FloatArray] | None = None,
    h: float = 2.0,
    iterations: int = SERIES,
) -> Fit:
    """`fit_clouds` for the one cloud of points (n, 3), mm, in the model's frame."""
    return fit_clouds(model, [Cloud(points, normals, landmarks or {})], h, iterations)


def fit_clouds(
    model: TongueModel,
    clouds: Sequence[Cloud],
    h: float,
    iterations: int = SERIES,
    rule: NeighbourRule | None = None,
    start: Fit | None = None,
) -> Fit:
    """One speaker and a pose for each cloud, by a series of nearest neighbours and fits to them.

    A neighbour is the nearest point within 4 mm whose normal turns at most 60 degrees away from the vertex's (any
    point where the cloud has no normals). There is no rigid alignment: the clouds have to be in the model's frame.
    rule: for the volumetric cloud of a scan, with points of much else: the paper's neighbours, which prefer what lies
    below the surface (`SurfaceIndex.targets`); the clouds need normals then. Without it the nearest is taken, as a
    mesh's surface has no inside.

    h: the box in sigma; iterations: fits in the series; start: a fit to as many clouds from whose weights the series
    begins (their mean by default). Raises InputError where a cloud is empty, is not made of numbers, names a vertex
    that the model lacks, is not where the model is, or lacks the normals that a rule needs.
    """
    if not clouds or iterations < 1:
        raise InputError("nothing can be fitted: expected at least one cloud and at least one step.")
    for number, cloud in enumerate(clouds, 1):
        _check_cloud(model, cloud, f"cloud {number}")
    surfaces = [_PlainSurface(cloud) if rule is None else _RuledSurface(cloud, rule) for cloud in clouds]
    box = _Box.of(model, h, len(clouds))
    found = _Weights(model.speaker.mean, np.tile(model.pose.mean, (len(clouds), 1)))
    if start is not None:
        if start.poses.shape != found.poses.shape or start.speaker.shape != found.speaker.shape:
            raise InputError(
                f"a fit of {len(start.poses)} meshes by another model cannot be the start for {len(clouds)} clouds."
            )
        found = found.like(np.clip(_Weights(start.speaker, start.poses).flat, box.low, box.high))
    reach_mm = NEIGHBOUR_MM if rule is None else rule.radius_mm
    at_rest, used = False, np.zeros(len(clouds))
    for step in range(iterations):
        reduced = []
        for index, (shape, cloud, surface) in enumerate(
            zip(_shapes(model, found), clouds, surfaces, strict=True)
        ):
            neighbours, valid = surface.targets(shape, model.faces)
            used[index] = valid.mean()
            if used[index] < LEAST_NEIGHBOURS:
                raise InputError(
                    f"mesh {index + 1}: only {100 * used[index]:.0f} % of the model's vertices have a point of it "
                    f"within {reach_mm:g} mm that faces the same way; bring it into the model's frame first, in "
                    "mm, x left, y back, z up."
                )
            weights, targets = _with_landmarks(cloud, valid, neighbours)
            reduced.append(_Gram(model, weights).reduced(targets))
        problem = _problem_of(reduced)
        # The first fit may look for the lowest of several minima; the later ones follow it.
        found, at_rest = _lowest(problem, box) if step == 0 else _descend(problem, box, found)
    residual_mm = np.zeros(len(clouds))
    for index, (shape, surface) in enumerate(zip(_shapes(model, found), surfaces, strict=True)):
        neighbours, valid = surface.targets(shape, model.faces)
        used[index] = valid.mean()
        apart = np.linalg.norm(shape - neighbours, axis=1)[valid]
        residual_mm[index] = apart.mean() if valid.any() else np.nan
    return _fit(model, problem, box, found, at_rest, residual_mm, used)


# Neighbours -------------------------------------------------------------------------------------------


def _check_cloud(model: TongueModel, cloud: Cloud, name: str) -> None:
    points = np.asarray(cloud.points)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise InputError(f"{name}: expected points with three coordinates each, all of them numbers.")
    if cloud.normals is not None and np.shape(cloud.normals) != points.shape:
        raise InputError(
            f"{name}: {len(points)} points have {len(cloud.normals)} normals; expected one each."
        )
    for vertex in cloud.landmarks:
        if not 0 <= vertex < model.vertex_count:
            raise InputError(
                f"{name}: a landmark names vertex {vertex}; the model '{model.name}' has vertices 0 to "
                f"{model.vertex_count - 1}."
            )


class _PlainSurface:
    """The nearest point that faces the same way; any, where the cloud has no normals."""

    def __init__(self, cloud: Cloud) -> None:
        from scipy.spatial import cKDTree

        self._cloud, self._tree = cloud, cKDTree(cloud.points)

    def targets(self, shape: FloatArray, faces: IndexArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """(V, 3) mm the neighbour of each vertex, (V,) whether it has a valid one."""
        count = min(CANDIDATES, len(self._cloud.points))
        distances, indices = self._tree.query(shape, k=count, distance_upper_bound=NEIGHBOUR_MM)
        distances = np.asarray(distances).reshape(len(shape), -1)
        indices = np.asarray(indices).reshape(len(shape), -1)
        valid = np.isfinite(distances)
        indices = np.where(valid, indices, 0)
        normals = self._cloud.normals
        if normals is not None:
            facing = np.einsum("va,vca->vc", vertex_normals(shape, faces), normals[indices])
            valid &= facing >= np.cos(np.radians(NEIGHBOUR_DEGREES))
        first = np.argmax(valid, axis=1)
        rows = np.arange(len(shape))
        return self._cloud.points[indices[rows, first]], valid[rows, first]


class _RuledSurface:
    """Where the paper's rule sends each vertex."""

    def __init__(self, cloud: Cloud, rule: NeighbourRule) -> None:
        self._index, self._rule = SurfaceIndex(cloud), rule

    def targets(self, shape: FloatArray, faces: IndexArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """As `_PlainSurface.targets`."""
        return self._index.targets(shape, vertex_normals(shape, faces), self._rule)


def _with_landmarks(
    cloud: Cloud, valid: NDArray[np.bool_], neighbours: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(V,) the weight of each vertex in the energy, and (V, 3) where it should be. Landmarks have no neighbours."""
    near = valid.copy()
    near[list(cloud.landmarks)] = False
    weights = near / max(int(near.sum()), 1)
    targets = neighbours.copy()
    for vertex, place in cloud.landmarks.items():
        weights[vertex] = LANDMARK_WEIGHT / len(cloud.landmarks)
        targets[vertex] = place
    return weights, targets


# The reduced problem ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Reduced:
    """One mesh in the span of the core: E_t = |s x p . core - target|^2 + a constant.

    core: (m, n, r), target: (r,).
    """

    core: FloatArray
    target: FloatArray


class _Gram:
    """The core's weighted Gram matrix and its root; weights: (V,) of the vertices."""

    def __init__(self, model: TongueModel, weights: FloatArray) -> None:
        m, n, k = model.core.shape
        self._rows = weights.repeat(3)
        self._flat = model.core.reshape(m * n, k)
        self._origin = model.origin
        values, vectors = np.linalg.eigh((self._flat * self._rows) @ self._flat.T)
        kept = values > values[-1] * 1e-13
        self._root = np.sqrt(values[kept])
        self._vectors = vectors[:, kept]
        self._core = (self._vectors * self._root).reshape(m, n, -1)

    def reduced(self, targets: FloatArray) -> _Reduced:
        """targets: (V, 3) mm."""
        pull = self._flat @ (self._rows * (targets.ravel() - self._origin))
        return _Reduced(self._core, (self._vectors.T @ pull) / self._root)


@dataclass(frozen=True)
class _Problem:
    """core: (T, m, n, r), target: (T, r); r is that of the widest mesh, the others padded with zeros; coordinates:
    how many of the T r say something."""

    core: FloatArray
    target: FloatArray
    coordinates: int


@dataclass(frozen=True)
class _Weights:
    """speaker (m,), poses (T, n), raw."""

    speaker: FloatArray
    poses: FloatArray

    @property
    def flat(self) -> FloatArray:
        return np.concatenate([self.speaker, self.poses.ravel()])

    def like(self, flat: FloatArray) -> _Weights:
        m = len(self.speaker)
        return _Weights(flat[:m], flat[m:].reshape(self.poses.shape))


@dataclass(frozen=True)
class _Box:
    """Of the flat weights of so many meshes (m + T n,): the mean, the deviation, the bounds."""

    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, model: TongueModel, h: float, meshes: int) -> _Box:
        if not h > 0.0:
            raise InputError(f"the box of {h:g} sigma leaves no shape to fit; expected a number above 0.")
        mean = np.concatenate([model.speaker.mean, np.tile(model.pose.mean, meshes)])
        spread = np.concatenate([_spread(model.speaker), np.tile(_spread(model.pose), meshes)])
        return cls(mean, spread, mean - h * spread, mean + h * spread)


def allowed_reach(mode: Mode, h: float) -> FloatArray:
    """(w,) how far each weight may be from its mean in a box of h."""
    return h * _spread(mode)


def _spread(mode: Mode) -> FloatArray:
    """(w,) the deviation of the training weights, or sigma where the model does not keep them."""
    measured = mode.measured_sigma
    return mode.sigma if measured is None else np.maximum(measured, LEAST_SPREAD * mode.sigma)


def _problem_of(reduced: Sequence[_Reduced]) -> _Problem:
    widths = [len(one.target) for one in reduced]
    core = np.zeros((len(reduced), *reduced[0].core.shape[:2], max(widths)))
    target = np.zeros((len(reduced), max(widths)))
    for index, (one, width) in enumerate(zip(reduced, widths, strict=True)):
        core[index, :, :, :width] = one.core
        target[index, :width] = one.target
    return _Problem(core, target, sum(widths))


def _shapes(model: TongueModel, found: _Weights) -> FloatArray:
    """(T, V, 3) mm."""
    shapes = model.origin + found.poses @ np.tensordot(found.speaker, model.core, axes=1)
    return np.asarray(shapes.reshape(len(shapes), -1, 3))


def _residual(problem: _Problem, weights: _Weights) -> tuple[FloatArray, FloatArray]:
    """(T, r) and the directions (T, n, r) of the poses for this speaker."""
    directions = np.einsum("l,tlkr->tkr", weights.speaker, problem.core)
    return np.einsum("tk,tkr->tr", weights.poses, directions) - problem.target, directions


def _jacobian(problem: _Problem, weights: _Weights, directions: FloatArray) -> FloatArray:
    """(T r, m + T n)"""
    meshes, m, n, r = problem.core.shape
    jacobian = np.zeros((meshes, r, m + meshes * n))
    jacobian[:, :, :m] = np.einsum("tk,tlkr->trl", weights.poses, problem.core)
    for index in range(meshes):
        jacobian[index, :, m + index * n : m + (index + 1) * n] = directions[index].T
    return jacobian.reshape(meshes * r, -1)


# The descent ------------------------------------------------------------------------------------------


def _lowest(problem: _Problem, box: _Box) -> tuple[_Weights, bool]:
    """The lower of the ends of two descents: from the mean weights, and from `_separated`."""
    meshes, m, n, _ = problem.core.shape
    mean = _Weights(box.mean[:m], box.mean[m:].reshape(meshes, n))
    ends = [_descend(problem, box, start) for start in (mean, _separated(problem, box))]
    return min(ends, key=lambda end: _energy(problem, end[0]))


def _separated(problem: _Problem, box: _Box) -> _Weights:
    """Every product of a speaker's and a pose's weight solved for by itself, and the matrix of all products, speaker
    by poses of all meshes, taken for one of rank one. For meshes that the model expresses it is one."""
    meshes, m, n, r = problem.core.shape
    cells = problem.core.reshape(meshes, m * n, r)
    products = np.array(
        [
            np.linalg.lstsq(cell.T, target, rcond=None)[0]
            for cell, target in zip(cells, problem.target, strict=True)
        ]
    )
    left, values, right = np.linalg.svd(products.reshape(meshes, m, n).transpose(1, 0, 2).reshape(m, -1))
    speaker, mean, spread = left[:, 0], box.mean[:m], box.spread[:m]
    # Sign and scale as near to the training speakers as they get.
    scale = float(speaker @ (mean / spread**2) / (speaker @ (speaker / spread**2)))
    scale = np.copysign(max(abs(scale), LEAST_SPREAD * float(np.linalg.norm(mean))), scale)
    return _Weights(scale * speaker, (values[0] / scale * right[0]).reshape(meshes, n))


def _energy(problem: _Problem, weights: _Weights) -> float:
    return float(np.sum(_residual(problem, weights)[0] ** 2))


def _descend(problem: _Problem, box: _Box, start: _Weights) -> tuple[_Weights, bool]:
    """Damped Newton from the start, the weights that press against their bounds held; and whether it came to rest."""
    low, high = box.low, box.high
    weights = start.like(np.clip(start.flat, low, high))
    damping = FIRST_DAMPING
    rounding = ROUNDING * float(np.sum(problem.target**2))
    for _ in range(MAX_STEPS):
        residual, directions = _residual(problem, weights)
        energy = float(np.sum(residual**2))
        jacobian = _jacobian(problem, weights, directions)
        slope = jacobian.T @ residual.ravel()
        hessian = jacobian.T @ jacobian
        scale = np.diag(hessian) + 1e-12 * np.trace(hessian) + 1e-300
        _add_bilinear(hessian, problem, residual)
        x = weights.flat
        free = ~(((x <= low) & (slope > 0.0)) | ((x >= high) & (slope < 0.0)))
        if not free.any() or energy <= rounding:
            return _nearest_scale(box, weights), True
        system, pull = hessian[np.ix_(free, free)], slope[free]
        reached = np.inf
        while reached >= energy and damping < LARGEST_DAMPING:
            step = _downhill(system + damping * np.diag(scale[free]), pull)
            if step is not None:
                moved = x.copy()
                moved[free] += step
                trial = weights.like(np.clip(moved, low, high))
                reached = _energy(problem, trial)
            damping *= 8.0 if reached >= energy else 1.0
        if reached >= energy:
            return _nearest_scale(box, weights), True
        damping = max(damping / 8.0, LEAST_DAMPING)
        # The scale costs nothing; bringing it home frees weights that pressed against their bounds for nothing.
        weights = _nearest_scale(box, trial)
        if energy - reached <= RELATIVE_DECREASE * energy:
            return weights, True
    return weights, False


def _downhill(system: FloatArray, pull: FloatArray) -> FloatArray | None:
    """The Newton step, or None where the system is not positive definite."""
    from scipy.linalg.lapack import (
        dposv,
    )  # half the time of a step would go into the checks of anything higher

    _, step, not_definite = dposv(system, pull)
    return None if not_definite else np.asarray(-step)


def _add_bilinear(hessian: FloatArray, problem: _Problem, residual: FloatArray) -> None:
    """Adds what Gauss-Newton leaves out: speaker and pose multiply each other."""
    meshes, m, n, _ = problem.core.shape
    mixed = np.einsum("tr,tlkr->ltk", residual, problem.core).reshape(m, meshes * n)
    hessian[:m, m:] += mixed
    hessian[m:, :m] += mixed.T


def _nearest_scale(box: _Box, weights: _Weights) -> _Weights:
    """The same shapes by the weights nearest to the training weights: (c s, p/c) in the box, c > 0."""
    m, mean, spread = len(weights.speaker), box.mean, box.spread
    x = weights.flat
    speaker, pose = x[:m] / spread[:m], x[m:] / spread[m:]
    # Where the derivative of |(c s - mean)/spread|^2 + |(p/c - mean)/spread|^2, times c^3, is 0.
    quartic = np.array(
        [
            float(term)
            for term in (
                speaker @ speaker,
                -speaker @ (mean / spread)[:m],
                0.0,
                pose @ (mean / spread)[m:],
                -pose @ pose,
            )
        ]
    )
    turning = [
        root.real for root in np.roots(quartic) if abs(root.imag) < 1e-9 * abs(root) and root.real > 0.0
    ]
    scales = np.array([1.0, *np.clip(turning, *_allowed_scales(x, box, m))])
    scaled = np.column_stack([scales[:, None] * x[:m], x[m:] / scales[:, None]])
    best = int(np.argmin(np.sum(((scaled - mean) / spread) ** 2, axis=1)))
    return weights.like(np.clip(scaled[best], box.low, box.high))


def _allowed_scales(x: FloatArray, box: _Box, m: int) -> tuple[float, float]:
    """The c around 1 with c s and p/c in the box."""
    factors = []
    for part in (slice(0, m), slice(m, None)):
        values, least, most = x[part], box.low[part], box.high[part]
        moving = np.abs(values) > 1e-12
        ends = np.stack([least[moving] / values[moving], most[moving] / values[moving]])
        smallest = max(float(ends.min(axis=0).max(initial=0.0)), 1e-6)
        factors.append((min(smallest, 1.0), max(float(ends.max(axis=0).min(initial=1e6)), 1.0)))
    (s_low, s_high), (p_low, p_high) = factors
    return max(s_low, 1.0 / p_high), min(s_high, 1.0 / p_low)


def _fit(
    model: TongueModel,
    problem: _Problem,
    box: _Box,
    found: _Weights,
    at_rest: bool,
    residual_mm: FloatArray,
    used: FloatArray,
) -> Fit:
    residual, directions = _residual(problem, found)
    jacobian = _jacobian(problem, found, directions)
    meshes, m, n, _ = problem.core.shape
    prior = np.diag(box.spread**-2)
    spare = problem.coordinates - (m + meshes * n - 1)  # the scale is one weight less
    precision = prior
    if spare > 0:
        # The rounding of float32 files, at least: nothing is known without any error.
        variance = max(float(np.sum(residual**2)) / spare, 1e-12)
        precision = prior + jacobian.T @ jacobian / variance
    covariance = np.linalg.inv(precision)[:m, :m]
    return Fit(
        found.speaker,
        found.poses,
        np.asarray(covariance, dtype=np.float64),
        np.sqrt(np.diag(covariance)) / model.speaker.sigma,
        residual_mm,
        used,
        at_rest,
    )
