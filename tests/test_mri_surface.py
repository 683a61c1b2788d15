"""Otsu's threshold, and surface points with normals, against surfaces that are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mri.cloudfile import cloud_bytes, read_cloud
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.scan import Scan, scan_of
from tonguetrack.model.mri.surface import otsu, surface_points, voxel_surface

SPACING = np.array([1.1875, 1.1875, 1.2])
OBLIQUE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
CENTRE = np.array([2.3, 41.1, -6.4])
Signed = Callable[[np.ndarray], np.ndarray]


def ball(radius_mm: float) -> tuple[Signed, Signed]:
    """Signed distance, and normals outwards, of a ball about CENTRE."""

    def direction(points: np.ndarray) -> np.ndarray:
        return (points - CENTRE) / np.linalg.norm(points - CENTRE, axis=-1, keepdims=True)

    return lambda points: np.linalg.norm(points - CENTRE, axis=-1) - radius_mm, direction


def half_space(normal: tuple[float, float, float]) -> tuple[Signed, Signed]:
    unit = np.array(normal) / np.linalg.norm(normal)
    return (
        lambda points: (points - CENTRE) @ unit - 0.37,
        lambda points: np.broadcast_to(unit, points.shape),
    )


def imaged(signed: Signed, turn: np.ndarray, spacing: np.ndarray, noise: float = 0.0) -> Scan:
    """Tissue of 160 in air of 20, each voxel the mean of 27 places in it, Rician noise."""
    shape = tuple((38 / spacing).astype(int))
    matrix = np.eye(4)
    matrix[:3, :3] = turn * spacing
    matrix[:3, 3] = CENTRE + [0.3, -0.2, 0.4] - matrix[:3, :3] @ ((np.array(shape) - 1) / 2)
    voxels = np.indices(shape).reshape(3, -1).T
    share = np.zeros(len(voxels))
    for part in (np.indices((3, 3, 3)).reshape(3, -1).T - 1.0) / 3:
        away = signed((voxels + part) @ matrix[:3, :3].T + matrix[:3, 3])
        share += np.clip(0.5 - away / 0.4, 0, 1)
    values = (20 + 140 * share / 27).reshape(shape)
    if noise:
        random = np.random.default_rng(8)
        values = np.hypot(values + noise * random.normal(size=shape), noise * random.normal(size=shape))
    return scan_of(np.clip(values, 0, 255), matrix, "made")


def errors(cloud: Cloud, scan: Scan, signed: Signed, direction: Signed) -> tuple[float, float, float]:
    """Mean distance to the truth and bias, mm, and mean angle of the normals, degrees; not at the scan's border."""
    voxels = scan.voxels(cloud.points)
    inner = ((voxels > 4) & (voxels < np.array(scan.values.shape) - 5)).all(axis=1)
    assert inner.sum() > 100 and cloud.normals is not None
    points, normals = cloud.points[inner], cloud.normals[inner]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    cosines = np.clip((normals * direction(points)).sum(axis=1), -1, 1)
    distances = signed(points)
    return (
        float(np.abs(distances).mean()),
        float(distances.mean()),
        float(np.degrees(np.arccos(cosines)).mean()),
    )


# Where the surface is -------------------------------------------------------------------------------

CASES = {
    "a small ball": ball(6.0),
    "a ball": ball(15.0),
    "a plane": half_space((0.3, 0.5, 0.81)),
    "a plane along the grid": half_space((1.0, 0.0, 0.0)),
}
GRIDS = {
    "as the paper's": (np.eye(3), SPACING),
    "oblique": (OBLIQUE, SPACING),
    "mirrored": (np.array([[0.0, 0, -1], [1, 0, 0], [0, 1, 0]]), SPACING),
    "anisotropic": (OBLIQUE, np.array([0.9, 1.1, 2.0])),
}


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("case", CASES)
def test_crossings_are_within_a_tenth_of_a_millimetre_and_normals_within_two_degrees(case, grid):
    signed, direction = CASES[case]
    scan = imaged(signed, *GRIDS[grid])
    distance, bias, angle = errors(surface_points(scan, 90.0), scan, signed, direction)
    assert distance < 0.08 and abs(bias) < 0.075 and angle < 1.5


@pytest.mark.parametrize("case", CASES)
def test_after_noise_and_denoising_crossings_are_better_than_the_papers_voxels(case):
    signed, direction = CASES[case]
    scan = imaged(signed, *GRIDS["as the paper's"], noise=12.0)
    smooth = scan.holding(denoise(scan.values, scan.spacing_mm))
    crossing = errors(surface_points(smooth), smooth, signed, direction)
    voxel = errors(voxel_surface(smooth), smooth, signed, direction)
    assert crossing[0] < 0.2 and crossing[2] < 2.0
    assert crossing[0] < 0.6 * voxel[0] and crossing[2] < max(voxel[2], 1.0)
    # Whole voxels lie inside by up to one of them.
    assert voxel[1] < -0.2 and voxel[0] < 1.2 and voxel[2] < 5.0


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_the_papers_points_are_the_tissue_voxels_with_a_neighbour_that_is_none(seed):
    values = np.random.default_rng(seed).integers(0, 2, size=(4, 5, 6)).astype(np.float32)
    expected = set()
    for place in zip(*np.nonzero(values), strict=True):
        for axis in range(3):
            for step in (-1, 1):
                other = list(place)
                other[axis] += step
                if 0 <= other[axis] < values.shape[axis] and not values[tuple(other)]:
                    expected.add(tuple(map(float, place)))
    found = voxel_surface(scan_of(values, np.eye(4), "made"), 0.5).points
    # Where the smoothed partition has no direction at all, there is no normal, and no point.
    assert set(map(tuple, found)) <= expected and len(found) >= 0.9 * len(expected)


def test_every_crossing_has_tissue_on_one_side_and_the_threshold_in_it():
    random = np.random.default_rng(9)
    scan = scan_of(random.uniform(0, 255, size=(7, 8, 9)), np.diag([1.0, -2.0, 0.5, 1.0]), "made")
    cloud = surface_points(scan, 100.0)
    np.testing.assert_allclose(scan.at(cloud.points), 100.0, atol=1e-3)


def test_the_border_of_the_scan_is_no_surface():
    values = np.full((8, 8, 8), 200.0)
    values[:4] = 10.0
    scan = scan_of(values, np.eye(4), "made")
    for cloud in (surface_points(scan), voxel_surface(scan)):
        assert len(cloud.points) == 64
        np.testing.assert_allclose(cloud.normals, np.tile([-1.0, 0, 0], (64, 1)), atol=1e-6)


def test_a_scan_without_a_surface_is_said():
    dark = scan_of(np.random.default_rng(1).uniform(0, 9, size=(4, 4, 4)), np.eye(4), "night.nii")
    for surface in (surface_points, voxel_surface):
        with pytest.raises(InputError, match=r"night\.nii: no surface between tissue and air"):
            surface(dark, 100.0)
        with pytest.raises(InputError, match=r"night\.nii: all voxels have the same value"):
            surface(dark.holding(np.full((4, 4, 4), 3.0, np.float32)))


# Otsu -----------------------------------------------------------------------------------------------


def between_class_variance(values: np.ndarray, threshold: float) -> float:
    bright = values > threshold
    if bright.all() or not bright.any():
        return 0.0
    share = bright.mean()
    return float(share * (1 - share) * (values[bright].mean() - values[~bright].mean()) ** 2)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95), st.floats(5, 80))
@settings(max_examples=30, deadline=None)
def test_no_threshold_parts_two_classes_better_than_otsus(seed, share, spread):
    random = np.random.default_rng(seed)
    values = np.where(random.uniform(size=4000) < share, 60.0, 170.0) + random.normal(scale=spread, size=4000)
    best = max(
        between_class_variance(values, level) for level in np.linspace(values.min(), values.max(), 200)
    )
    assert between_class_variance(values, otsu(values)) > 0.998 * best


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_otsus_threshold_is_scikit_images_to_two_bins(seed):
    filters = pytest.importorskip("skimage.filters")
    random = np.random.default_rng(seed)
    values = np.concatenate([random.normal(40, 15, 3000), random.normal(150, 25, 2000)])
    assert otsu(values) == pytest.approx(filters.threshold_otsu(values), abs=2 * np.ptp(values) / 256)


def test_between_two_values_the_threshold_is_in_the_middle():
    assert otsu(np.array([20.0] * 900 + [160.0] * 100)) == pytest.approx(90.0, abs=1.0)


# Files ----------------------------------------------------------------------------------------------


def some_cloud() -> Cloud:
    return surface_points(imaged(ball(6.0)[0], np.eye(3), SPACING), 90.0)


def test_a_cloud_is_read_back_as_it_was_written(tmp_path):
    cloud = some_cloud()
    for given_cloud in (cloud, Cloud(cloud.points)):
        (tmp_path / "cloud.ply").write_bytes(cloud_bytes(given_cloud))
        back = read_cloud(tmp_path / "cloud.ply")
        np.testing.assert_allclose(back.points, cloud.points, atol=1e-5)
        assert (back.normals is None) == (given_cloud.normals is None)
        if back.normals is not None:
            np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-6)


def test_a_cloud_opens_in_another_program(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "cloud.ply").write_bytes(cloud_bytes(some_cloud()))
    np.testing.assert_allclose(trimesh.load(tmp_path / "cloud.ply").vertices, some_cloud().points, atol=1e-5)


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_a_cloud_of_text_or_of_a_mesh_is_read_too(tmp_path, line_end):
    lines = ["ply", "format ascii 1.0", "element vertex 2", "property float x", "property uchar red"]
    lines += [
        "property float y",
        "property float z",
        "element face 1",
        "property list uchar int vertex_indices",
    ]
    lines += ["end_header", "1 255 2 3", "4 0 5 6", "3 0 1 1", ""]
    (tmp_path / "cloud.ply").write_bytes(line_end.join(lines).encode())
    cloud = read_cloud(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert cloud.normals is None


def test_a_damaged_cloud_is_refused_with_one_sentence(tmp_path):
    file = tmp_path / "cloud.ply"
    sound = cloud_bytes(some_cloud())
    file.write_bytes(sound)
    with pytest.raises(InputError, match=r"nowhere\.ply: there is no such point cloud"):
        read_cloud(tmp_path / "nowhere.ply")
    for length in [0, 3, 40, 150, 180, 200, len(sound) - 1]:
        file.write_bytes(sound[:length])
        with pytest.raises(InputError, match=r"cloud\.ply: "):
            read_cloud(file)
    for old, new in [
        (b"element vertex", b"element corner"),
        (b"property float z", b"property float q"),
        (b"property float z", b"property list z"),
        (b"property float z", b"property float x"),
        (b"vertex ", b"vertex 999999"),
    ]:
        file.write_bytes(sound.replace(old, new, 1))
        with pytest.raises(InputError, match=r"cloud\.ply: "):
            read_cloud(file)
    not_numbers = some_cloud().points.copy()
    not_numbers[3, 1] = np.nan
    file.write_bytes(cloud_bytes(Cloud(not_numbers)))
    with pytest.raises(InputError, match="a point or a normal is not a number"):
        read_cloud(file)
