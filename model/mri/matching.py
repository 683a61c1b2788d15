"""Template matching: a template bent onto the points of a scan that belong to it (paper, "Template matching")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..mesh import FloatArray, IndexArray, vertex_normals
from ..neighbours import NeighbourRule, SurfaceIndex
from .templates import Template, landmark_vertices


@dataclass(frozen=True)
class MatchSettings:
    smoothness: float = 10.0
    least_smoothness: float = 6.0
    bending: float = 0.0
    least_bending: float = 0.0
    landmarks: float = 10.0
    least_landmarks: float = 0.0
    energies: int = 40
    rule: NeighbourRule = field(default_factory=NeighbourRule)
    rotations: bool = True
    smooth_afterwards: bool = True


TONGUE = MatchSettings()
PALATE = MatchSettings(least_landmarks=10.0)


@dataclass(frozen=True)
class Match:
    """vertices: (n, 3) mm; residual_mm: mean distance of the vertices that have a neighbour to it; valid: their share;
    energies: what is left of the data and the landmark term
    after each energy of the series, mm^2; flipped: how many faces look against their
    neighbours."""

    vertices: FloatArray
    residual_mm: float
    valid: float
    energies: tuple[float, ...]
    flipped: int


def match(
    start: FloatArray,
    template: Template,
    index: SurfaceIndex,
    landmarks: Mapping[str, FloatArray],
    settings: MatchSettings,
) -> Match:
    faces = template.mesh.faces
    rest = np.asarray(start, dtype=np.float64)
    if rest.shape != template.mesh.vertices.shape or not np.isfinite(rest).all():
        raise InputError(
            f"a start of the shape {rest.shape} cannot be matched as a {template.name}; expected the "
            f"{len(template.mesh.vertices)} vertices of its template, all of them numbers."
        )
    marked = landmark_vertices(template, landmarks)
    graph = _graph_of(template)
    current = rest.copy()
    energies = []
    marked_vertices = np.array(list(marked), dtype=np.intp)
    marked_places = np.array(list(marked.values())).reshape(-1, 3)
    n = len(rest)
    for t in range(settings.energies):
        share = t / max(settings.energies - 1, 1)
        beta = settings.smoothness + share * (settings.least_smoothness - settings.smoothness)
        bend = settings.bending + share * (settings.least_bending - settings.bending)
        gamma = settings.landmarks + share * (settings.least_landmarks - settings.landmarks)
        normals = vertex_normals(current, faces)
        found, valid = index.nearest(current, normals, settings.rule)
        valid[marked_vertices] = False
        across = index.normals[found]
        apart = np.einsum("va,va->v", across, index.points[found] - current)
        target = current + across * apart[:, None]
        weight = valid / max(int(valid.sum()), 1)
        weight[marked_vertices] = gamma / max(len(marked_vertices), 1)
        target[marked_vertices] = marked_places
        rotations = _rotations(rest, current, graph) if settings.rotations else None
        current = _solved(rest, target, weight * n, beta, bend, rotations, graph)
        energies.append(float(np.sum(weight * np.sum((current - target) ** 2, axis=1))))
    if settings.smooth_afterwards:
        current = _averaged(rest, current, graph)
    normals = vertex_normals(current, faces)
    points, valid = index.neighbours(current, normals, settings.rule)
    apart = np.linalg.norm(points - current, axis=1)[valid]
    residual = float(apart.mean()) if valid.any() else float("nan")
    return Match(current, residual, float(valid.mean()), tuple(energies), flipped_faces(current, faces))


def flipped_faces(vertices: FloatArray, faces: IndexArray) -> int:
    """How many faces look against the mean normal of their corners: folds."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    around = vertex_normals(vertices, faces)[faces].mean(axis=1)
    return int(np.sum(np.einsum("fa,fa->f", np.cross(b - a, c - a), around) < 0.0))


@dataclass(frozen=True)
class _Graph:
    order: NDArray[np.intp]
    bandwidth: int
    first: NDArray[np.intp]
    second: NDArray[np.intp]
    laplacian: object
    bilaplacian: object
    degree: FloatArray


_GRAPHS = {}


def _graph_of(template):
    if template.name not in _GRAPHS:
        _GRAPHS[template.name] = _graph(template.mesh.faces, len(template.mesh.vertices))
    return _GRAPHS[template.name]


def _graph(faces, n):
    from scipy.sparse import coo_array, csr_array, diags_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0
    )
    first = np.concatenate([edges[:, 0], edges[:, 1]]).astype(np.intp)
    second = np.concatenate([edges[:, 1], edges[:, 0]]).astype(np.intp)
    adjacency = csr_array(coo_array((np.ones(len(first)), (first, second)), shape=(n, n)))
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    laplacian = csr_array(diags_array(degree) - adjacency)
    norm = csr_array(diags_array(1.0 / degree) @ laplacian)
    bil = csr_array(norm.T @ norm)
    order = reverse_cuthill_mckee(csr_array(bil), symmetric_mode=True)
    return _Graph(order, 0, first, second, laplacian, (norm, bil), degree)


def _rotations(rest, current, graph):
    n = len(rest)
    a = rest[graph.second] - rest[graph.first]
    b = current[graph.second] - current[graph.first]
    outer = (b[:, :, None] * a[:, None, :]).reshape(-1, 9)
    cov = np.zeros((n, 9))
    for k in range(9):
        cov[:, k] = np.bincount(graph.first, outer[:, k], n)
    cov = cov.reshape(n, 3, 3)
    u, _, vt = np.linalg.svd(cov)
    det = np.linalg.det(u @ vt)
    u[:, :, 2] *= det[:, None]
    return u @ vt


def _solved(rest, target, weight, beta, bend, rotations, graph):
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    n = len(rest)
    lap = graph.laplacian
    nrm, bil = graph.bilaplacian
    system = diags_array(weight + 1e-9) + 2 * beta * lap + bend * bil
    rhs = weight[:, None] * target
    if rotations is None:
        rhs = rhs + 2 * beta * (lap @ rest) + bend * (bil @ rest)
    else:
        e = rest[graph.first] - rest[graph.second]
        mean_rotation = rotations[graph.first] + rotations[graph.second]
        turned = np.einsum("eab,eb->ea", mean_rotation, e)
        r = np.zeros((n, 3))
        for k in range(3):
            r[:, k] = np.bincount(graph.first, turned[:, k], n)
        rhs = rhs + beta * r
        if bend:
            delta = np.einsum("vab,vb->va", rotations, nrm @ rest)
            rhs = rhs + bend * (nrm.T @ delta)
    lu = splu(
        csc_array(system), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0
    )
    return lu.solve(rhs)


def _averaged(rest, current, graph):
    n = len(rest)
    rotations = _rotations(rest, current, graph)
    moved = (
        np.einsum("eab,eb->ea", rotations[graph.second], rest[graph.first] - rest[graph.second])
        + current[graph.second]
    )
    r = np.zeros((n, 3))
    for k in range(3):
        r[:, k] = np.bincount(graph.first, moved[:, k], n)
    return r / graph.degree[:, None]
