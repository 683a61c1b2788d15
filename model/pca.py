"""A linear model of how one shape varies, and its fit to a point cloud (paper, "Model fitting").

The paper has one of the hard palate, and fits it as it fits its multilinear model: in a box around the mean, by a
series of energies with new neighbours each, with landmarks. A head may lie anywhere in its scan, so a rigid motion is
sought together with the weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .. import InputError
from .mesh import FloatArray, IndexArray, vertex_normals
from .neighbours import NeighbourRule, SurfaceIndex
from .procrustes import RigidMotion

LANDMARK_WEIGHT = 1.0  # of all landmarks together, against that of all vertices with neighbours
STEPS = 3  # a fit: turns are not linear
LEAST_SIGMA = 1e-9  # of the first component's: less is rounding
LEAST_NEIGHBOURS = 0.1  # of the vertices; with fewer, the cloud is of another place


@dataclass(frozen=True)
class PcaModel:
    """mean: (n, 3) mm; components: (k, n, 3), each of length 1; sigma: (k,) mm, the standard deviation of the
    training shapes' weights, largest first."""

    mean: FloatArray
    components: FloatArray
    sigma: FloatArray

    def shape(self, weights: FloatArray) -> FloatArray:
        """(n, 3) mm. weights: (k,) mm."""
        return np.asarray(self.mean + np.tensordot(weights, self.components, 1))


@dataclass(frozen=True)
class PcaFit:
    """vertices: (n, 3) mm, where the cloud is; weights: (k,) mm; motion: from the model's frame to the cloud's;
    residual_mm: mean distance to the neighbours of the vertices that have one; valid: their share."""

    vertices: FloatArray
    weights: FloatArray
    motion: RigidMotion
    residual_mm: float
    valid: float


def pca_of(shapes: FloatArray) -> PcaModel:
    """The model of shapes (s, n, 3) mm, already aligned, with as many components as they have independent directions.

    Raises InputError for fewer than two shapes.
    """
    if shapes.ndim != 3 or shapes.shape[2] != 3 or len(shapes) < 2:
        raise InputError(f"a model of how shapes vary needs two or more of them, not {len(shapes)}.")
    mean = shapes.mean(axis=0)
    rows = (shapes - mean).reshape(len(shapes), -1)
    _, lengths, directions = np.linalg.svd(rows, full_matrices=False)
    kept = lengths > LEAST_SIGMA * max(lengths[0], LEAST_SIGMA)
    kept[-1] = False  # shapes around their own mean: one direction fewer
    return PcaModel(mean, directions[kept].reshape(-1, *mean.shape), lengths[kept] / np.sqrt(len(shapes) - 1))


def fit_pca(
    model: PcaModel,
    faces: IndexArray,
    index: SurfaceIndex,
    landmarks: Mapping[int, FloatArray],
    h: float,
    rule: NeighbourRule,
    start: RigidMotion,
    series: int = 10,
) -> PcaFit:
    """The model fitted to a cloud, by weights within h sigma of the mean and a rigid motion.

    faces: (f, 3) of the model's vertices; landmarks: vertex -> (3,) mm in the cloud's frame; start: about where the
    model is there; series: energies, each with new neighbours. Raises InputError where hardly a vertex has a
    neighbour.
    """
    weights, motion = np.zeros(len(model.sigma)), start
    marked = list(landmarks)
    for _ in range(series):
        current = motion.apply(model.shape(weights))
        targets, valid = index.targets(current, vertex_normals(current, faces), rule)
        valid[marked] = False
        if valid.mean() < LEAST_NEIGHBOURS:
            raise InputError(
                f"only {100 * valid.mean():.0f} % of the vertices have a point of the cloud within "
                f"{rule.radius_mm:g} mm that faces the same way; are the landmarks those of this scan?"
            )
        importance = valid / valid.sum()
        for vertex, place in landmarks.items():
            importance[vertex], targets[vertex] = LANDMARK_WEIGHT / len(marked), place
        for _ in range(STEPS):
            weights, motion = _nearer(model, weights, motion, targets, importance, h)
    vertices = motion.apply(model.shape(weights))
    points, valid = index.neighbours(vertices, vertex_normals(vertices, faces), rule)
    apart = np.linalg.norm(points - vertices, axis=1)[valid]
    residual_mm = float(apart.mean()) if valid.any() else float("nan")
    return PcaFit(vertices, weights, motion, residual_mm, float(valid.mean()))


def _nearer(
    model: PcaModel,
    weights: FloatArray,
    motion: RigidMotion,
    targets: FloatArray,
    importance: FloatArray,
    h: float,
) -> tuple[FloatArray, RigidMotion]:
    """Weights and motion with less squared distance to the targets (n, 3), each as important as (n,) says."""
    from scipy.optimize import lsq_linear
    from scipy.spatial.transform import Rotation

    used = importance > 0.0
    root = np.sqrt(importance[used])[:, None]
    shape = motion.apply(model.shape(weights))[used]
    centre = shape.mean(axis=0)
    arms = shape - centre
    reach_mm = float(np.sqrt((arms**2).sum(axis=1).mean()))  # of a turn: all unknowns are mm
    columns = [np.cross(axis, arms) / reach_mm for axis in np.eye(3)]
    columns += [np.tile(axis, (len(shape), 1)) for axis in np.eye(3)]
    columns += list(model.components[:, used] @ motion.rotation.T)
    basis, reduced = np.linalg.qr(np.stack([(root * column).ravel() for column in columns], axis=1))
    left = basis.T @ (root * (targets[used] - shape)).ravel()
    free = np.full(6, np.inf)
    bound = h * model.sigma
    low, high = np.concatenate([-free, -bound - weights]), np.concatenate([free, bound - weights])
    step = lsq_linear(reduced, left, (low, high)).x
    turn = np.asarray(Rotation.from_rotvec(step[:3] / reach_mm).as_matrix())
    moved = RigidMotion(turn, centre - turn @ centre + step[3:6]).after(motion)
    return np.clip(weights + step[6:], -bound, bound), moved
