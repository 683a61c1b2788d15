"""The vertices that the tongue's shapes are measured at, found on a model's mean shape.

Model frame, mm: x lateral, left positive, y front to back, z up. Left and right are the speaker's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ...model.mesh import vertex_normals
from ...model.midsagittal import midsagittal_vertices
from ...model.multilinear import TongueModel
from ..pose import FloatArray

STATIONS = {"blade": 0.12, "front": 0.25, "body": 0.40, "back": 0.55}
"""Where along the mid-sagittal contour of the mean shape, as parts of its length from tip to root."""
SECTIONS = 3  # the first of the stations have edges
HALFWAY, EDGE = 0.45, 0.85  # of the half width of the surface that faces up
SLICE_MM = 2.0  # a section is looked for so far before and behind its station
NARROWEST_MM = 3.0  # a surface that reaches less far to the side has no edge
FACING_UP = 0.5  # cosine of the normal's angle to the section's own up

# Rows of the landmark model: the tip, the middles, then left and right of each section.
TIP = 0
MIDDLES = slice(1, 1 + len(STATIONS))
LEFT_HALF, RIGHT_HALF, LEFT_EDGE, RIGHT_EDGE = (
    slice(1 + len(STATIONS) + i * SECTIONS, 1 + len(STATIONS) + (i + 1) * SECTIONS) for i in range(4)
)


def contour_with_parts(model: TongueModel) -> tuple[NDArray[np.intp], FloatArray]:
    """(c,) the mid-sagittal vertices from tip to root, and (c,) the part of the contour's length, 0..1, at which each
    lies on the mean shape. InputError where there are too few to tell regions apart."""
    contour = midsagittal_vertices(model)
    if len(contour) < 2 * len(STATIONS):
        raise InputError(
            f"the model '{model.name}' has {len(contour)} mid-sagittal vertices: too few to tell the tongue's parts."
        )
    steps = np.diff(model.mean_vertices()[contour, 1:], axis=0)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    return contour, along / along[-1]


def landmark_model(model: TongueModel) -> TongueModel:
    """The model at its landmarks alone (`landmark_vertices`)."""
    return model.at(landmark_vertices(model).tolist())


def landmark_vertices(model: TongueModel) -> NDArray[np.intp]:
    """(17,) vertices: tip; middle of blade, front, body, back; left halfway, right halfway, left edge, right edge of
    blade, front and body. Found on the mean shape, from the model's mid-sagittal vertices and its landmark `Tip` where
    it names them. A right landmark is the vertex nearest to the left one's mirror image.

    Raises InputError where there is no surface beside the contour.
    """
    vertices = model.mean_vertices()
    contour, parts = contour_with_parts(model)
    sagittal = vertices[contour, 1:]
    tip = model.marks.landmarks.get("Tip", int(contour[np.argmin(sagittal[:, 0])]))
    places = [int(np.argmin(np.abs(parts - part))) for part in STATIONS.values()]
    middles = [int(contour[place]) for place in places]
    normals = vertex_normals(vertices, model.faces)
    sides = []
    for place in places[:SECTIONS]:
        before, behind = sagittal[max(place - 3, 0)], sagittal[min(place + 3, len(sagittal) - 1)]
        sides.append(_section(vertices, normals, int(contour[place]), behind - before, model.name))
    halves, edges = zip(*sides)
    mirrored = [
        [int(np.argmin(np.linalg.norm(vertices - vertices[left] * [-1, 1, 1], axis=1))) for left in row]
        for row in (halves, edges)
    ]
    return np.array([tip, *middles, *halves, *mirrored[0], *edges, *mirrored[1]], dtype=np.intp)


def _section(
    vertices: FloatArray, normals: FloatArray, middle: int, backwards: FloatArray, name: str
) -> tuple[int, int]:
    """The vertices halfway to the left edge and at it, in the section through a contour vertex; backwards (2,): the
    contour's direction there, y and z."""
    back = np.array([0.0, *backwards]) / np.linalg.norm(backwards)
    up = np.array([0.0, -back[2], back[1]])
    from_middle = vertices - vertices[middle]
    near = (np.abs(from_middle @ back) <= SLICE_MM) & (from_middle[:, 0] >= NARROWEST_MM)
    facing = near & (normals @ up >= FACING_UP)
    found = np.flatnonzero(facing if facing.any() else near)
    if not len(found):
        raise InputError(
            f"the model '{name}' has no surface to the left of its vertex {middle}: avatar shapes need the whole tongue."
        )
    lateral = vertices[found, 0]
    half, edge = (int(found[np.argmin(np.abs(lateral - part * lateral.max()))]) for part in (HALFWAY, EDGE))
    return half, edge
