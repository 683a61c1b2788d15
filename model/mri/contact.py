"""The tongue's surface where it touches the hard palate (paper, "Tongue and palate shape estimation").

Tongue and palate are both bright: where they touch, a scan shows no edge between them, and its cloud of surface points
has a hole. The speaker's palate, seen in another scan and brought here, tells where the tongue must end. What the cloud
has behind the palate (the edge of the bone, the floor of the nose) would draw a tongue upwards and is taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..cloud import Cloud
from ..mesh import FloatArray, Mesh, vertex_normals
from ..neighbours import NeighbourRule, SurfaceIndex

NEAR_MM = 10.0  # a cloud without a point so near to the palate is of another place
LEAST_COSINE = 0.5  # of the way from the palate's edge to a point behind it, with the normal there


@dataclass(frozen=True)
class ContactSettings:
    """margin_mm: points further behind the palate are taken out. everywhere: all of the palate is put in, as in the
    paper; otherwise only where the cloud does not show it, by a point that is its neighbour after the rule `seen`:
    where it does, there is air below, and the tongue has points of its own."""

    margin_mm: float = 0.5
    everywhere: bool = False
    seen: NeighbourRule = field(default_factory=lambda: NeighbourRule(2.0, 60.0))


def restore_contact(cloud: Cloud, palate: Mesh, settings: ContactSettings | None = None) -> Cloud:
    """A scan's cloud with nothing behind the palate, and the palate in place of what a touching tongue hides.

    cloud: with normals, which point out of the tissue; palate: where it is in the same scan, mm, faces out of the
    tissue as well (down, into the mouth). What is put in are its vertices and the middles of its faces, with normals as
    a tongue has them there: upwards. Raises InputError where the cloud has no normals, or lies elsewhere.
    """
    from scipy.spatial import cKDTree

    settings = settings or ContactSettings()
    if cloud.normals is None:
        raise InputError("the point cloud has no normals; without them, nothing tells tongue from palate.")
    places, normals, edge = _samples(palate)
    found = cKDTree(places).query(cloud.points)
    apart_mm, nearest = np.asarray(found[0]), np.asarray(found[1])
    if apart_mm.min() > NEAR_MM:
        raise InputError(
            f"the point cloud is {apart_mm.min():.0f} mm away from the palate; bring the palate into its scan first."
        )
    height = np.einsum("na,na->n", places[nearest] - cloud.points, normals[nearest])
    behind = (height > settings.margin_mm) & (~edge[nearest] | (height > LEAST_COSINE * apart_mm))
    left = Cloud(cloud.points[~behind], cloud.normals[~behind])
    wanted = np.ones(len(places), dtype=bool)
    if not settings.everywhere:
        wanted = ~SurfaceIndex(left).nearest(places, normals, settings.seen)[1]
    return Cloud(
        np.vstack([left.points, places[wanted]]),
        np.vstack([cloud.normals[~behind], -normals[wanted]]),
        cloud.landmarks,
    )


def _samples(palate: Mesh) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """(m, 3) vertices and middles of faces, mm, their normals (m, 3), and (m,) whether they are on the palate's edge."""
    corners = palate.vertices[palate.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    sides = np.sort(palate.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, owner, shared = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    single = shared == 1
    edge = np.zeros(len(palate.vertices), dtype=bool)
    edge[pairs[single]] = True
    return (
        np.vstack([palate.vertices, corners.mean(axis=1)]),
        np.vstack(
            [vertex_normals(palate.vertices, palate.faces), across / np.where(length > 0.0, length, 1.0)]
        ),
        np.concatenate([edge, single[owner].reshape(-1, 3).any(axis=1)]),
    )
