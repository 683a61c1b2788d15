"""The two templates: what a tongue and a hard palate look like before a scan is looked at (paper, "Template matching").

Frame of both: mm, x left, y back, z up, the mid-sagittal plane x = 0, the upper incisors' edge about the origin.
Both are mirror images of themselves in that plane. Faces look out of the tissue, as the normals of a scan's points do:
the tongue's outwards, into the oral cavity and the pharynx; the palate's downwards, into the oral cavity, for bone and
mucosa lie above it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..mesh import FloatArray, IndexArray, Mesh
from ..multilinear import SurfaceMarks
from ..procrustes import rigid_motion
from ..synthetic import Anatomy, tongue_surface, tongue_template
from ..synthetic.articulation import PHONES

LEAST_LANDMARKS = 3

EDGE_MM = 1.4  # of the palate's faces
PALATE_FRONT_MM, PALATE_BACK_MM = 4.5, 48.0  # from the gum behind the incisors to the posterior nasal spine
# The palate's middle and its half width, gum line to gum line, at places behind the incisors' edge, mm.
PALATE_PLACES = np.array([4.5, 7.0, 10.0, 14.0, 20.0, 28.0, 38.0, 48.0])
PALATE_HEIGHTS = np.array([2.8, 4.0, 5.8, 8.8, 12.6, 15.0, 15.2, 14.4])
PALATE_HALF_WIDTHS = np.array([5.0, 8.6, 11.6, 14.0, 16.2, 18.2, 19.8, 20.8])
GUM_LINE_MM = 1.5  # its height
DOMING = 2.2  # exponent of the vault across


@dataclass(frozen=True)
class Template:
    """name: "tongue" or "palate"; landmarks: name -> vertex; marks: what else is known about single vertices, as a
    model keeps it; mirror: (n,) the vertex on the other side."""

    name: str
    mesh: Mesh
    landmarks: Mapping[str, int]
    marks: SurfaceMarks
    mirror: NDArray[np.intp]


def template_named(name: str) -> Template:
    """ "tongue" or "palate". Raises InputError for anything else."""
    if name not in TEMPLATES:
        raise InputError(f"there is no template '{name}'; there are {', '.join(TEMPLATES)}.")
    return TEMPLATES[name]()


@cache
def tongue() -> Template:
    """The tongue of the synthetic reference speaker in a schwa: upper surface, root, sides, underside of the tip."""
    known = tongue_template()
    vertices = tongue_surface(Anatomy("reference"), PHONES["ə"])
    vertices = 0.5 * (vertices + _mirrored(vertices)[known.mirror])  # alike on both sides to the last bit
    return Template(
        "tongue",
        Mesh(vertices, known.faces),
        known.landmarks,
        SurfaceMarks(known.landmarks, known.regions, known.midsagittal),
        known.mirror,
    )


@cache
def palate() -> Template:
    """A hard palate between the gum lines, from behind the incisors to the posterior nasal spine, edges of 1.4 mm.

    Rows run across, the first one in front; how many vertices one has follows its length. midsagittal: the middle of
    every row, front to back.
    """
    rows = [_palate_row(y) for y in _palate_places()]
    starts = np.cumsum([0, *(len(row) for row in rows)])
    vertices = np.concatenate(rows)
    faces = []
    for start, row, behind in zip(starts, rows, rows[1:], strict=False):
        faces += _strip(row, behind, int(start), int(start) + len(row))
    middles = [int(start) + len(row) // 2 for start, row in zip(starts, rows, strict=False)]

    def at(share: float, side: int) -> int:
        """A share of the way from front to back; on the gum line of a side, or in the middle (0)."""
        row = round(share * (len(rows) - 1))
        return middles[row] + side * (len(rows[row]) // 2)

    landmarks = {
        "IncisorCenter": at(0.0, 0),
        "RidgeCenter": at(0.14, 0),
        "VaultCenter": at(0.56, 0),
        "BackCenter": at(1.0, 0),
        "LeftFront": at(0.22, 1),
        "RightFront": at(0.22, -1),
        "LeftMolar": at(0.62, 1),
        "RightMolar": at(0.62, -1),
        "LeftBack": at(1.0, 1),
        "RightBack": at(1.0, -1),
    }
    mirror = np.concatenate([np.arange(end, start, -1) - 1 for start, end in pairwise(starts)])
    marks = SurfaceMarks(landmarks, {}, tuple(middles))
    mesh = Mesh(vertices, np.array(faces, dtype=np.int32))
    return Template("palate", mesh, landmarks, marks, mirror.astype(np.intp))


TEMPLATES = {"tongue": tongue, "palate": palate}


def placed(template: Template, landmarks: Mapping[str, FloatArray]) -> FloatArray:
    """(n, 3) mm: the template's vertices moved, turned and scaled as a whole so that its landmarks come nearest to the
    given ones (name -> (3,) mm), by least squares.

    Raises InputError for a name that the template lacks, for fewer than three, and where they lie on one line.
    """
    vertices = landmark_vertices(template, landmarks)
    if len(vertices) < LEAST_LANDMARKS:
        raise InputError(
            f"the {template.name} needs {LEAST_LANDMARKS} landmarks or more to be placed, found {len(vertices)}; "
            f"it knows {', '.join(template.landmarks)}."
        )
    source = template.mesh.vertices[list(vertices)]
    target = np.array(list(vertices.values()), dtype=np.float64)
    rotation = rigid_motion(source, target).rotation
    centre, goal = source.mean(axis=0), target.mean(axis=0)
    turned = (source - centre) @ rotation.T
    scale = float(np.sum(turned * (target - goal)) / np.sum(turned**2))
    return np.asarray(scale * (template.mesh.vertices - centre) @ rotation.T + goal)


def landmark_vertices(template: Template, landmarks: Mapping[str, FloatArray]) -> dict[int, FloatArray]:
    """Vertex -> (3,) mm, of landmarks by name. Raises InputError for a name that the template lacks."""
    for name, place in landmarks.items():
        if name not in template.landmarks:
            raise InputError(
                f"the {template.name} has no landmark '{name}'; it knows {', '.join(template.landmarks)}."
            )
        if np.shape(place) != (3,) or not np.isfinite(place).all():
            raise InputError(f"the landmark '{name}' needs three coordinates, all of them numbers.")
    return {template.landmarks[name]: np.asarray(place) for name, place in landmarks.items()}


def _mirrored(vertices: FloatArray) -> FloatArray:
    return vertices * [-1.0, 1.0, 1.0]


def _palate_places() -> FloatArray:
    """(rows,) y mm, at equal distances along the middle."""
    y = np.linspace(PALATE_FRONT_MM, PALATE_BACK_MM, 2001)
    height = _along(PALATE_HEIGHTS, y)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(y), np.diff(height)))])
    rows = round(length[-1] / EDGE_MM) + 1
    return np.interp(np.linspace(0.0, length[-1], rows), length, y)


def _palate_row(y: float) -> FloatArray:
    """(odd, 3) mm from right to left, at equal distances along the vault."""
    half, top = float(_along(PALATE_HALF_WIDTHS, y)), float(_along(PALATE_HEIGHTS, y))
    share = np.linspace(0.0, 1.0, 1001)
    drop = (top - GUM_LINE_MM) * share**DOMING
    length = np.concatenate([[0.0], np.cumsum(np.hypot(half * np.diff(share), np.diff(drop)))])
    columns = max(round(length[-1] / EDGE_MM), 1)
    places = np.linspace(0.0, length[-1], columns + 1)
    x = half * np.interp(places, length, share)
    z = top - np.interp(places, length, drop)
    left = np.column_stack([x, np.full(len(x), y), z])
    return np.vstack([_mirrored(left[:0:-1]), left])


def _along(values: FloatArray, y: FloatArray | float) -> FloatArray:
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(PALATE_PLACES, values)(y))


def _strip(row: FloatArray, behind: FloatArray, start: int, start_behind: int) -> list[IndexArray]:
    """Faces between two rows, looking down: each joins to what is nearest across, both halves alike."""
    middle, middle_behind = len(row) // 2, len(behind) // 2
    faces = []
    i, j = 0, 0  # vertices left of the middle
    while i < middle or j < middle_behind:
        along_front = j == middle_behind or (
            i < middle
            and np.linalg.norm(row[middle + i + 1] - behind[middle_behind + j])
            < np.linalg.norm(row[middle + i] - behind[middle_behind + j + 1])
        )
        for side in (1, -1):
            here, there = start + middle + side * i, start_behind + middle_behind + side * j
            third = here + side if along_front else there + side
            face = [here, there, third] if side == 1 else [there, here, third]
            faces.append(np.array(face, dtype=np.int32))
        i, j = (i + 1, j) if along_front else (i, j + 1)
    return faces
