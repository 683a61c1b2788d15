"""Landmarks as a person would place them on the scans: near the right place, on a voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...mesh import Mesh, vertex_normals
from .surfaces import PALATE_COLUMNS, SIDE_ROWS, TOP_COLUMNS, TongueSurface

FloatArray = NDArray[np.float64]

ALONG_MM = 1.8  # standard deviation of the error along the surface, in each direction
ACROSS_MM = 0.7  # and across it, where the eye sees an edge
LARGEST = 2.5  # standard deviations
# On the middle of the tongue, share of the way from tip to vallecula.
ON_THE_MIDDLE = {"Tip": 0.0, "SurfaceCenter": 0.31, "BackCenter": 0.6, "Airway": 0.94}
# On the palate: share of the way from front to back, column as a share from right to left.
ON_THE_PALATE = {
    "IncisorCenter": (0.0, 0.5),
    "RidgeCenter": (0.14, 0.5),
    "VaultCenter": (0.56, 0.5),
    "BackCenter": (1.0, 0.5),
    "LeftFront": (0.22, 1.0),
    "RightFront": (0.22, 0.0),
    "LeftMolar": (0.62, 1.0),
    "RightMolar": (0.62, 0.0),
    "LeftBack": (1.0, 1.0),
    "RightBack": (1.0, 0.0),
}


def tongue_landmarks(surface: TongueSurface, base: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Name -> true place (3,) and the surface's normal (3,) there. base: (2,) y, z of the floor below the tip."""
    vertices = surface.mesh.vertices
    normals = vertex_normals(vertices, surface.mesh.faces)
    line = vertices[surface.middle]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    found = {}
    rows = {}
    for name, share in ON_THE_MIDDLE.items():
        rows[name] = int(np.argmin(np.abs(way - share * way[-1])))
        vertex = surface.middle[rows[name]]
        found[name] = (vertices[vertex], normals[vertex])
    found["FrontBaseCenter"] = (np.array([0.0, *base]), np.array([0.0, -1.0, 0.0]))
    start = surface.middle[rows["SurfaceCenter"]] - TOP_COLUMNS // 2 - SIDE_ROWS
    edge = TOP_COLUMNS // 9  # in from the edge, where the top begins to turn down
    for name, column in (("LeftLateral", TOP_COLUMNS - 1 - edge), ("RightLateral", edge)):
        vertex = start + SIDE_ROWS + column
        found[name] = (vertices[vertex], normals[vertex])
    return found


def palate_landmarks(palate: Mesh) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Name -> true place (3,) and the surface's normal (3,) there."""
    normals = vertex_normals(palate.vertices, palate.faces)
    rows = len(palate.vertices) // PALATE_COLUMNS
    found = {}
    for name, (back, left) in ON_THE_PALATE.items():
        vertex = round(back * (rows - 1)) * PALATE_COLUMNS + round(left * (PALATE_COLUMNS - 1))
        found[name] = (palate.vertices[vertex], normals[vertex])
    return found


def placed(
    true: dict[str, tuple[FloatArray, FloatArray]], to_world: FloatArray, hand: np.random.Generator
) -> dict[str, FloatArray]:
    """Where a person clicked: the true places with an error, each at the centre of a voxel. World, mm.

    true: in the world; to_world: (4, 4) of the scan's grid.
    """
    to_voxel = np.linalg.inv(to_world)
    clicked = {}
    for name, (place, normal) in true.items():
        error = ALONG_MM * hand.normal(size=3).clip(-LARGEST, LARGEST)
        off = ACROSS_MM * float(np.clip(hand.normal(), -LARGEST, LARGEST))
        meant = place + error + (off - error @ normal) * normal
        voxel = np.rint(to_voxel[:3, :3] @ meant + to_voxel[:3, 3])
        clicked[name] = to_world[:3, :3] @ voxel + to_world[:3, 3]
    return clicked
