"""Template matching: a template bent onto the points of a scan that belong to it (paper, "Template matching")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from ... import InputError
from ..mesh import FloatArray, IndexArray, vertex_normals
from ..neighbours import NeighbourRule, SurfaceIndex
from . import bending
from .templates import Template, landmark_vertices, template_named


@dataclass(frozen=True)
class MatchSettings:
    smoothness: float = 10.0
    least_smoothness: float = 6.0
    landmarks: float = 10.0
    least_landmarks: float = 0.0
    energies: int = 40
    rule: NeighbourRule = field(default_factory=NeighbourRule)
    smooth_afterwards: bool = True
    turns: int = 1


TONGUE = MatchSettings()
PALATE = MatchSettings(least_landmarks=10.0)


@dataclass(frozen=True)
class Match:
    """vertices: (n, 3) mm; residual_mm: mean distance of the vertices that have a neighbour to it; valid: their share;
    energies: each energy of the series at its minimum, mm^2; flipped: how many faces look against their neighbours."""

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
    rest = np.array(start, dtype=np.float64)
    if rest.shape != template.mesh.vertices.shape or not np.isfinite(rest).all():
        raise InputError(
            f"a start of the shape {rest.shape} cannot be matched as a {template.name}; expected the "
            f"{len(template.mesh.vertices)} vertices of its template, all of them numbers."
        )
    marked = landmark_vertices(template, landmarks)
    vertices = list(marked)
    places = np.array(list(marked.values())).reshape(-1, 3)
    edges = _edges_of(template.name)
    current, rotations = rest.copy(), bending.no_rotations(len(rest))
    joined = (rest, edges.starts, edges.others)
    energies = []
    for smoothness, pull in zip(
        np.linspace(settings.smoothness, settings.least_smoothness, settings.energies),
        np.linspace(settings.landmarks, settings.least_landmarks, settings.energies),
        strict=True,
    ):
        targets, valid = index.targets(current, vertex_normals(current, faces), settings.rule)
        valid[vertices] = False
        weights = valid / max(int(valid.sum()), 1)
        if marked:
            weights[vertices] = pull / len(marked)
            targets[vertices] = places
        if not weights.any():
            raise InputError(f"no point of the cloud is near the {template.name}, and no landmark holds it.")
        stiffness = smoothness / len(rest)
        for _ in range(settings.turns):
            bending.turn(rotations, rest, current, edges.starts, edges.others)
            bending.move(current, rotations, *joined, weights * 1.0, targets, stiffness)
        energies.append(
            float(weights @ np.sum((current - targets) ** 2, axis=1))
            + stiffness * bending.stretch(current, rotations, *joined)
        )
    if settings.smooth_afterwards:
        bending.turn(rotations, rest, current, edges.starts, edges.others)
        current = bending.averaged(current, rotations, *joined)
    points, valid = index.neighbours(current, vertex_normals(current, faces), settings.rule)
    apart = np.linalg.norm(points - current, axis=1)[valid]
    residual = float(apart.mean()) if valid.any() else float("nan")
    return Match(current, residual, float(valid.mean()), tuple(energies), flipped_faces(current, faces))


def flipped_faces(vertices: FloatArray, faces: IndexArray) -> int:
    """How many faces look against the mean normal of their corners: folds."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    around = vertex_normals(vertices, faces)[faces].mean(axis=1)
    return int(np.sum(np.einsum("fa,fa->f", np.cross(b - a, c - a), around) < 0.0))


@cache
def _edges_of(template: str) -> bending.Edges:
    mesh = template_named(template).mesh
    return bending.edges_of(mesh.faces, len(mesh.vertices))
