"""Template matching: a template bent onto the points of a scan that belong to it (paper, "Template matching").

Every vertex has a rigid motion A_i of its own. A series of energies is minimised, t = 1 .. T,

    1/|V^L| sum_{i in V^L} |A_i(v_i) - q_i|^2  +  beta_t/|V| sum_i sum_{j in N(i)} |A_i(v_j) - A_j(v_j)|^2
                                               +  gamma_t/|L| sum_{i in L} |A_i(v_i) - l_i|^2

each from where the one before has led, with beta_t and gamma_t on straight lines from their first to their last values.
V^L are the vertices without a landmark that have a neighbour in the cloud, L those with one. Three things are not the
paper's:

The motions of two neighbours are compared where they act, at the neighbour, in mm. The paper's |A_i - A_j|^2 has to
weigh angles against lengths. With this measure the motions need no general minimiser: the best rotations follow from the
positions, and the positions from the rotations by a sparse linear system (`bending`), one step of each in every energy.

A vertex is drawn onto the plane that touches the surface at its neighbour, not to the neighbour itself, so that it may
slide along the surface (`SurfaceIndex.targets`).

The series begins stiffer and ends softer than the paper's, while the neighbour rule tightens from 4 mm and 60 degrees to
1.5 mm and 30 degrees. The first energies bring the whole into place; in the last ones nothing far away pulls any more,
so that the parts for which there is no data, as the sides deep between tongue and jaw, are left to go along with the
rest instead of being bent towards the jaw's own surface.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from ... import InputError
from ..mesh import FloatArray, IndexArray, vertex_normals
from ..neighbours import NeighbourRule, SurfaceIndex
from . import bending
from .templates import Template, landmark_vertices, template_named

WIDE = NeighbourRule(4.0, 60.0)
TIGHT = NeighbourRule(1.5, 30.0)


@dataclass(frozen=True)
class MatchSettings:
    """smoothness, least_smoothness: beta of the first and of the last energy; landmarks, least_landmarks: gamma
    likewise; energies: T; rule, last_rule: which neighbours count in the first and in the last energy, in between
    what lies between; smooth_afterwards: whether at the end each motion becomes the average of its neighbours'."""

    smoothness: float
    least_smoothness: float
    landmarks: float = 10.0
    least_landmarks: float = 0.0
    energies: int = 40
    rule: NeighbourRule = WIDE
    last_rule: NeighbourRule = TIGHT
    smooth_afterwards: bool = True


TONGUE = MatchSettings(50.0, 0.5)
PALATE = MatchSettings(50.0, 2.0)
PAPER_TONGUE = MatchSettings(10.0, 6.0, last_rule=WIDE)
PAPER_PALATE = MatchSettings(10.0, 6.0, least_landmarks=10.0, last_rule=WIDE)
"""The paper's values, in the measure above: neighbours within 4 mm and 60 degrees to the end."""


@dataclass(frozen=True)
class Match:
    """vertices: (n, 3) mm. valid: the share of them that have a neighbour by the first rule; residual_mm: how far
    these are from the plane that touches the surface there, on average, nan where there are none; energies: each
    energy of the series where it was left, mm^2; flipped: how many faces look against those around them."""

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
    """The template's surface in a cloud, from a start: (n, 3) mm, where its vertices are thought to be.

    The start's shape is what bending is measured from: the template as `templates.placed` puts it, or the fit of a
    statistical model. landmarks: name -> (3,) mm; start, cloud and landmarks in the world of the scan. Raises
    InputError for a start of another size, for a landmark that the template lacks, and where neither a neighbour nor
    a landmark says where the surface is.
    """
    rest = np.array(start, dtype=np.float64, order="C")
    if rest.shape != template.mesh.vertices.shape or not np.isfinite(rest).all():
        raise InputError(
            f"a start of the shape {rest.shape} cannot be matched as a {template.name}; expected the "
            f"{len(template.mesh.vertices)} vertices of its template, all of them numbers."
        )
    if settings.energies < 1:
        raise InputError("a template is matched by a series of one energy or more.")
    marked = landmark_vertices(template, landmarks)
    vertices, places = list(marked), np.array(list(marked.values())).reshape(-1, 3)
    faces, edges = template.mesh.faces, _edges_of(template.name)
    current, rotations = rest.copy(), bending.no_rotations(len(rest))
    energies = []
    for t in range(settings.energies):
        smoothness, pull, rule = _at(settings, t / max(settings.energies - 1, 1))
        targets, valid = index.targets(current, vertex_normals(current, faces), rule)
        valid[vertices] = False
        weights = valid / max(int(valid.sum()), 1)
        weights[vertices] = pull / max(len(vertices), 1)
        targets[vertices] = places
        if not weights.any():
            raise InputError(
                f"no point of the cloud lies within {rule.radius_mm:g} mm of the {template.name} and faces the same "
                "way; its landmarks, or the start, are somewhere else."
            )
        stiffness = smoothness / len(rest)
        bending.turn(rotations, rest, current, edges.starts, edges.others)
        bending.move(current, rotations, rest, edges.starts, edges.others, weights, targets, stiffness)
        bent = bending.bent(current, rotations, rest, edges.starts, edges.others)
        energies.append(float(weights @ np.sum((current - targets) ** 2, axis=1)) + stiffness * bent)
    if settings.smooth_afterwards:
        bending.turn(rotations, rest, current, edges.starts, edges.others)
        current = bending.averaged(current, rotations, rest, edges.starts, edges.others)
    targets, valid = index.targets(current, vertex_normals(current, faces), settings.rule)
    apart = np.linalg.norm(targets - current, axis=1)[valid]
    residual_mm = float(apart.mean()) if valid.any() else float("nan")
    return Match(current, residual_mm, float(valid.mean()), tuple(energies), flipped_faces(current, faces))


def flipped_faces(vertices: FloatArray, faces: IndexArray) -> int:
    """How many faces (f, 3) look against the mean normal of their corners (n, 3): where the surface is folded."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    around = vertex_normals(vertices, faces)[faces].mean(axis=1)
    return int(np.sum(np.einsum("fa,fa->f", np.cross(b - a, c - a), around) < 0.0))


def _at(settings: MatchSettings, share: float) -> tuple[float, float, NeighbourRule]:
    """Smoothness, weight of the landmarks and neighbours, a share of the way from the first energy to the last."""

    def between(first: float, last: float) -> float:
        return first + share * (last - first)

    first, last = settings.rule, settings.last_rule
    return (
        between(settings.smoothness, settings.least_smoothness),
        between(settings.landmarks, settings.least_landmarks),
        NeighbourRule(between(first.radius_mm, last.radius_mm), between(first.angle_deg, last.angle_deg)),
    )


@cache
def _edges_of(template: str) -> bending.Edges:
    mesh = template_named(template).mesh
    return bending.edges_of(mesh.faces, len(mesh.vertices))
