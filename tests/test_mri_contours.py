"""Where a slice cuts a surface."""

import numpy as np
import pytest
from preferring import ball_mesh

from tonguetrack.model.mesh import Mesh
from tonguetrack.model.mri.contours import contour
from tonguetrack.model.mri.slicepicture import PLANES

CENTRE = np.array([3.0, 40.0, -5.0])


@pytest.mark.parametrize("plane", list(PLANES))
@pytest.mark.parametrize("off_mm", [0.0, 0.123, -6.0])
def test_a_ball_is_cut_in_one_closed_circle(plane, off_mm):
    across, right, up = PLANES[plane]
    (line,) = contour(ball_mesh(10.0, CENTRE, rows=60), plane, CENTRE[across] + off_mm)
    np.testing.assert_allclose(line[0], line[-1])
    away = np.linalg.norm(line - CENTRE[[right, up]], axis=1)
    np.testing.assert_allclose(away, np.sqrt(100 - off_mm**2), atol=0.03)
    steps = np.diff(line, axis=0)
    length = np.linalg.norm(steps, axis=1).sum()
    assert length == pytest.approx(
        2 * np.pi * np.sqrt(100 - off_mm**2), rel=2e-3
    )  # once around, nothing twice


def sheet(height) -> Mesh:
    """A sheet over x from -2 to 2 and y from 0 to 9, as high as a function of y says."""
    x, y = np.meshgrid(np.arange(-2.0, 3.0), np.arange(0.0, 10.0), indexing="ij")
    vertices = np.stack([x, y, height(y)], axis=-1).reshape(-1, 3)
    quads = [
        (i * 10 + j, i * 10 + j + 1, i * 10 + j + 10, i * 10 + j + 11) for i in range(4) for j in range(9)
    ]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (b, d, c))]
    return Mesh(vertices, np.array(faces, dtype=np.int32))


@pytest.mark.parametrize("at_mm", [0.4, 0.0, -1.0])
def test_an_open_surface_is_cut_in_one_line_from_edge_to_edge_even_through_its_vertices(at_mm):
    (line,) = contour(sheet(np.sin), "sagittal", at_mm)
    ordered = line if line[0, 0] < line[-1, 0] else line[::-1]
    assert ordered[0, 0] == 0.0 and ordered[-1, 0] == 9.0 and (np.diff(ordered[:, 0]) >= 0).all()
    np.testing.assert_allclose(
        np.interp(np.arange(10.0), ordered[:, 0], ordered[:, 1]), np.sin(np.arange(10.0)), atol=1e-12
    )


def test_several_pieces_are_several_lines_and_none_is_an_empty_list():
    waves = sheet(lambda y: np.cos(np.pi * y))
    lines = contour(waves, "axial", 0.0)
    assert len(lines) == 9 and all(len(line) > 4 for line in lines)
    assert contour(waves, "axial", 1.5) == contour(waves, "sagittal", 7.0) == []
