"""The true surfaces as meshes: the tongue from tip to root, and the hard palate. Head frame, reference size, mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...mesh import Mesh, vertex_normals
from .anatomy import PALATE_END_MM, STEP_MM, Head
from .tissue import DARK, label_at, roof_height
from .tongue import ACROSS, Tongue, touches_palate

FloatArray = NDArray[np.float64]

BARE, CONTACT, BURIED = range(3)
"""What a place on the tongue lies against: air, teeth or bone, all dark; the hard palate; other soft tissue."""

TOP_COLUMNS = 49
SIDE_ROWS = 7  # below each edge
SIDE_MM = 10.0
LOOK_MM = (0.8, 1.6)  # outwards of the surface
PALATE_FRONT_MM = 4.5
PALATE_STEP_MM = 0.75
PALATE_COLUMNS = 49


@dataclass(frozen=True)
class TongueSurface:
    """mesh: rows from the tip to the vallecula, columns from the lower right over the top to the lower left, faces
    outward; kind: (n,) BARE, CONTACT or BURIED; middle: (rows,) vertices of the middle column, tip first."""

    mesh: Mesh
    kind: NDArray[np.uint8]
    middle: NDArray[np.intp]


def tongue_surface(tongue: Tongue, head: Head) -> TongueSurface:
    """The upper surface, tip to root, with some millimetres of the sides below its edges. The sublingual part (below
    the tip) is not in it."""
    pose = tongue.pose
    rows = np.arange(tongue.tip_row, len(tongue.angles))
    across = np.sin(0.5 * np.pi * np.linspace(-1.0, 1.0, TOP_COLUMNS))
    columns = (across + 1.0) * 0.5 * (ACROSS - 1)
    top = np.array([np.interp(columns, np.arange(ACROSS), pose.radius[row]) for row in rows])
    touching = touches_palate(tongue)[:, np.rint(columns).astype(int)][rows]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(tongue.middle[rows], axis=0), axis=1))])
    deep = np.minimum(SIDE_MM * np.clip(along / 25.0, 0.1, 1.0), top[:, [0, -1]].min(axis=1) - 6.0)
    steps = np.arange(SIDE_ROWS, 0, -1) / SIDE_ROWS
    right = top[:, :1] - deep[:, None] * steps
    left = top[:, -1:] - deep[:, None] * steps[::-1]
    radius = np.hstack([right, top, left])
    edge = np.ones(SIDE_ROWS)
    x = pose.width[rows, None] * np.concatenate([-edge, across, edge])
    turned = np.radians(tongue.angles[rows])[:, None]
    vertices = np.stack(
        [x, pose.pole_y - radius * np.cos(turned), pose.pole_z + radius * np.sin(turned)], axis=-1
    ).reshape(-1, 3)
    faces = _grid_faces(*radius.shape)
    kind = np.zeros(radius.shape, dtype=np.uint8)
    kind[:, SIDE_ROWS:-SIDE_ROWS][touching] = CONTACT
    kinds = kind.ravel()
    normals = vertex_normals(vertices, faces)
    for vertex in np.flatnonzero(kinds != CONTACT):
        looked = (vertices[vertex] + far * normals[vertex] for far in LOOK_MM)
        if not any(label_at(x, y, z, head, pose) in DARK for x, y, z in looked):
            kinds[vertex] = BURIED
    grid = np.arange(radius.size).reshape(radius.shape)
    return TongueSurface(Mesh(vertices, faces), kinds, grid[:, SIDE_ROWS + TOP_COLUMNS // 2])


def palate_surface(head: Head) -> Mesh:
    """The hard palate between the gum lines, from the incisors to the posterior nasal spine; faces look down, into
    the mouth. Rows from front to back, columns from right to left."""
    y = np.arange(PALATE_FRONT_MM, PALATE_END_MM + PALATE_STEP_MM / 2, PALATE_STEP_MM)
    half = np.interp(y / STEP_MM, np.arange(len(head.arch)), head.arch)
    across = np.sin(0.5 * np.pi * np.linspace(-1.0, 1.0, PALATE_COLUMNS))
    vertices = np.array(
        [[[u * w, v, roof_height(u * w, v, head)] for u in across] for v, w in zip(y, half, strict=True)]
    ).reshape(-1, 3)
    return Mesh(vertices, _grid_faces(len(y), PALATE_COLUMNS)[:, ::-1].copy())


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Two triangles a cell; with rows to the back and columns to the left, they look up."""
    grid = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    return np.concatenate(
        [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    )
