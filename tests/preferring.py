"""A small preference test whose truth is known, for the tests of it and of its page: balls in scans."""

from pathlib import Path

import numpy as np

from tonguetrack.model.mesh import Mesh
from tonguetrack.model.mri.preference import Case, PreferenceTest, make_test
from tonguetrack.model.mri.scan import Scan, scan_of

SHAPE = (20, 60, 60)
SPACING_MM = 1.2
LOW_MM = np.array([10.0, -30.0, -40.0])  # the centre of the first voxel
CENTRE_MM = np.array([21.0, 4.0, -6.0])
RADIUS_MM = {"initial": 11.0, "final": 9.0}
BRIGHT_MM = 9.0
MARK_MM = np.array([21.0, -14.0, 10.0])  # a small bright spot in front of the ball and above it
SYNTHETIC = "synthetic: balls made for a test"


def scan_of_a_ball(seed: int = 0) -> Scan:
    matrix = np.diag([SPACING_MM] * 3 + [1.0])
    matrix[:3, 3] = LOW_MM
    places = np.indices(SHAPE).reshape(3, -1).T @ matrix[:3, :3].T + LOW_MM

    def ball(centre, radius):
        return np.clip(0.5 - (np.linalg.norm(places - centre, axis=1) - radius) / SPACING_MM, 0, 1)

    share = np.maximum(ball(CENTRE_MM, BRIGHT_MM), ball(MARK_MM, 2.0)).reshape(SHAPE)
    noise = np.random.default_rng(seed).normal(scale=15, size=SHAPE)
    return scan_of(100.0 + 600.0 * share + noise, matrix, f"ball {seed}").quantised()


def ball_mesh(radius: float, centre=CENTRE_MM, rows: int = 24) -> Mesh:
    """A sphere of latitudes and longitudes."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, rows), np.arange(2 * rows) * np.pi / rows, indexing="ij"
    )
    ring = 2 * rows
    unit = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    vertices = np.asarray(centre) + radius * unit.reshape(-1, 3)
    faces = []
    for row in range(rows - 1):
        for column in range(ring):
            a, b = row * ring + column, row * ring + (column + 1) % ring
            faces += [[a, a + ring, b], [b, a + ring, b + ring]]
    return Mesh(vertices, np.array(faces, dtype=np.int32))


def case(speaker: str, phone: str, seed: int = 0, off_mm: float = 0.0) -> Case:
    """off_mm: how far beside the ball the head's middle is."""
    initial, final = (ball_mesh(RADIUS_MM[method]) for method in ("initial", "final"))
    return Case(speaker, phone, scan_of_a_ball(seed), initial, final, float(CENTRE_MM[0]) + off_mm)


def cases(speakers: int, phones: str = "iasʃ"):
    """Speaker, phone and case of every cell but the last one, as of a data set in which one scan is missing."""
    cells = [(f"Speaker{number:02d}", phone) for number in range(1, speakers + 1) for phone in phones]
    return [(*cell, case(*cell, seed)) for seed, cell in enumerate(cells[:-1])]


def small_test(
    folder: Path, speakers: int = 3, partitions: int = 2, seed: int = 0, **options
) -> PreferenceTest:
    test, problems = make_test(
        cases(speakers), folder, "balls.toml", SYNTHETIC, partitions, seed=seed, **options
    )
    assert problems == ()
    return test
