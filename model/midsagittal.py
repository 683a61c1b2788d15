"""Which vertices of a tongue mesh a mid-sagittal coil can sit on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .mesh import FloatArray, IndexArray, vertex_normals
from .multilinear import TongueModel


def midsagittal_vertices(model: TongueModel) -> NDArray[np.intp]:
    """Vertices of the upper surface near the plane x = 0, ordered from tip to root.

    Taken from the model's own marks where it has them; else found on the mean shape: within one
    median edge length of the plane, not facing down or front-down (underside and base), and in one
    piece with the highest of them (a base's rim below the tip may be turned up).
    """
    if model.marks.midsagittal:
        return np.asarray(model.marks.midsagittal, dtype=np.intp)
    vertices = model.mean_vertices()
    normals = vertex_normals(vertices, model.faces)
    near = np.abs(vertices[:, 0]) <= _median_edge(vertices, model)
    upper = (normals[:, 2] > 0) | ((normals[:, 1] > 0) & (normals[:, 2] > -0.5))
    found = _in_one_piece(np.flatnonzero(near & upper), vertices, model.faces)
    return np.asarray(found[np.argsort(_angle_from_front(vertices[found]))], dtype=np.intp)


def upper_surface_vertices(model: TongueModel) -> NDArray[np.intp]:
    """Vertices of the mean shape that face up or back: where a lateral coil can sit."""
    normals = vertex_normals(model.mean_vertices(), model.faces)
    return np.flatnonzero((normals[:, 2] > 0) | ((normals[:, 1] > 0) & (normals[:, 2] > -0.5)))


def _median_edge(vertices: FloatArray, model: TongueModel) -> float:
    edges = np.concatenate([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]])
    return float(np.median(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)))


def _in_one_piece(chosen: NDArray[np.intp], vertices: FloatArray, faces: IndexArray) -> NDArray[np.intp]:
    """Those of the chosen vertices (n,) that edges between chosen ones join to the highest."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[np.isin(edges, chosen).all(axis=1)]
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(vertices), len(vertices)))
    piece = connected_components(graph, directed=False)[1]
    return chosen[piece[chosen] == piece[chosen[np.argmax(vertices[chosen, 2])]]] if len(chosen) else chosen


def _angle_from_front(points: FloatArray) -> FloatArray:
    """Angle in the sagittal plane, growing from the tip over the dorsum to the root."""
    centre_y = 0.5 * (points[:, 1].min() + points[:, 1].max())
    centre_z = 0.5 * (points[:, 2].min() + points[:, 2].max())
    from_front = np.arctan2(points[:, 2] - centre_z, centre_y - points[:, 1])
    # The root hangs below the centre at the back; its angle continues past half a turn. The tip may
    # hang a little below the centre at the front and stays negative.
    behind_below = (points[:, 1] > centre_y) & (points[:, 2] < centre_z)
    return np.where(behind_below, from_front + 2 * np.pi * (from_front < 0), from_front)
