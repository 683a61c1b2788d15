"""The template: which vertices there are, how they are joined, and which of them have names.

The surface is a grid: rows run around the tongue's mid-sagittal contour, from the floor of the mouth below
the tip, over tip, blade and dorsum, down to the root; columns run from the speaker's right to the left.
A place along the contour is its arc length s (mm) on the neutral contour of the reference speaker; a place
across it is the angle theta (degrees), 0 in the mid-sagittal plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]

# Neutral contour of the reference speaker, as control points (y, z) in mm of a clamped cubic B-spline.
CONTROL_POINTS = np.array(
    [
        [15.0, -31.0],  # floor of the mouth, behind the lower incisors
        [12.5, -25.5],
        [10.0, -19.5],  # frenulum
        [5.0, -16.5],  # underside of the blade
        [2.0, -11.5],  # tip
        [9.0, -6.0],  # blade
        [19.0, 0.5],
        [31.0, 4.5],  # dorsum
        [43.0, 3.0],
        [53.0, -4.5],
        [59.5, -15.0],  # back
        [62.0, -26.0],
        [62.5, -34.0],  # root, above the epiglottis
        [62.5, -42.0],
    ]
)
ROWS = 69
COLUMNS = 49
# Columns stand at equal arc lengths of this cross-section: half width and depth in mm, flatness.
REFERENCE_SECTION = (23.0, 34.0, 1.65)
TIP_REACH_MM = 5.0
BLADE_REACH_MM = 18.0
BACK_REACH_MM = 48.0
DORSUM_REACH_MM = 78.0
SIDE_ANGLE = 50.0
LOWEST_SIDE_ANGLE = 78.0


@dataclass(frozen=True)
class TongueTemplate:
    """vertices are numbered row by row. s: (rows,) mm; theta: (columns,) degrees; faces: (f, 3), outward.

    landmarks: name -> vertex; regions: name -> vertices; midsagittal: the upper surface's vertices with
    x = 0, tip to root; mirror: (n,) the vertex on the other side; tip_s: the arc length of the tip.
    """

    s: FloatArray
    theta: FloatArray
    basis: FloatArray
    faces: IndexArray
    landmarks: dict[str, int]
    regions: dict[str, tuple[int, ...]]
    midsagittal: tuple[int, ...]
    mirror: NDArray[np.intp]
    tip_s: float

    @property
    def vertex_count(self) -> int:
        return len(self.s) * len(self.theta)


@cache
def tongue_template() -> TongueTemplate:
    """The one template that all synthetic meshes share."""
    basis, s = _rows_evenly_spaced()
    contour = basis @ CONTROL_POINTS
    tip_row = int(np.argmin(contour[:, 0]))
    theta = _columns_evenly_spaced()
    middle = COLUMNS // 2
    grid = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    beyond_tip = s - s[tip_row]
    regions = _regions(grid, beyond_tip, theta)

    def at(distance_mm: float, column: int = middle) -> int:
        return int(grid[int(np.argmin(np.abs(beyond_tip - distance_mm))), column])

    quarter = int(np.argmin(np.abs(theta - 60.0)))
    landmarks = {
        "Tip": int(grid[tip_row, middle]),
        "SurfaceCenter": at(33.0),
        "BackCenter": at(62.0),
        "Airway": int(grid[-4, middle]),
        "FrontBaseCenter": int(grid[0, middle]),
        "LeftLateral": at(33.0, quarter),
        "RightLateral": at(33.0, COLUMNS - 1 - quarter),
    }
    return TongueTemplate(
        s,
        theta,
        basis,
        _faces(grid),
        landmarks,
        regions,
        tuple(int(vertex) for vertex in grid[tip_row:, middle]),
        grid[:, ::-1].ravel().astype(np.intp),
        float(s[tip_row]),
    )


def _rows_evenly_spaced() -> tuple[FloatArray, FloatArray]:
    """(rows, control points) basis whose rows lie at equal arc lengths on the reference contour, and those."""
    from scipy.interpolate import BSpline

    count = len(CONTROL_POINTS)
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
    dense = np.linspace(0, 1, 4001)
    dense_basis = BSpline.design_matrix(dense[:-1], knots, 3).toarray()
    last = np.zeros(count)
    last[-1] = 1.0
    dense_basis = np.vstack([dense_basis, last])
    contour = dense_basis @ CONTROL_POINTS
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(contour, axis=0), axis=1))])
    s = np.linspace(0.0, length[-1], ROWS)
    rows = np.array([np.interp(s, length, dense_basis[:, column]) for column in range(count)]).T
    return rows, s


def _columns_evenly_spaced() -> FloatArray:
    """(columns,) degrees from -90 to 90, symmetric, at equal arc lengths of the reference section."""
    half_width, depth, flatness = REFERENCE_SECTION
    dense = np.radians(np.linspace(0.0, 90.0, 2001))
    section = np.column_stack([half_width * np.sin(dense), depth * (1.0 - np.cos(dense)) ** flatness])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(section, axis=0), axis=1))])
    half = np.degrees(np.interp(np.linspace(0.0, length[-1], COLUMNS // 2 + 1), length, dense))
    return np.concatenate([-half[:0:-1], half])


def _faces(grid: NDArray[np.intp]) -> IndexArray:
    """Two triangles a cell, their diagonals mirrored in the mid-sagittal plane, outward by the right hand."""
    faces = []
    rows, columns = grid.shape
    for row in range(rows - 1):
        for column in range(columns - 1):
            a, b = grid[row, column], grid[row, column + 1]
            c, d = grid[row + 1, column + 1], grid[row + 1, column]
            if column < columns // 2:
                faces += [[a, b, c], [a, c, d]]
            else:
                faces += [[a, b, d], [b, c, d]]
    return np.array(faces, dtype=np.int32)


def _regions(grid: NDArray[np.intp], beyond_tip: FloatArray, theta: FloatArray) -> dict[str, tuple[int, ...]]:
    """The speech-related regions on the upper surface, by distance from the tip and by angle.

    The order is that of the published meshes' lists: tip, blade, back, and the dorsum behind it.
    """
    upper = np.abs(theta) <= SIDE_ANGLE
    side = (np.abs(theta) > SIDE_ANGLE) & (np.abs(theta) <= LOWEST_SIDE_ANGLE)

    def pick(low: float, high: float, columns: NDArray[np.bool_]) -> tuple[int, ...]:
        rows = (beyond_tip >= low) & (beyond_tip < high)
        return tuple(int(vertex) for vertex in np.sort(grid[np.ix_(rows, columns)].ravel()))

    regions = {
        "tip": pick(-TIP_REACH_MM, TIP_REACH_MM, upper),
        "blade": pick(TIP_REACH_MM, BLADE_REACH_MM, upper),
        "back": pick(BLADE_REACH_MM, BACK_REACH_MM, upper),
        "dorsum": pick(BACK_REACH_MM, DORSUM_REACH_MM, upper),
        "lateral": pick(TIP_REACH_MM, BACK_REACH_MM, side),
    }
    regions["combined"] = tuple(sorted(set().union(*regions.values())))
    return regions
