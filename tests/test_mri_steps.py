"""tonguetrack mri denoise, segment, cloud, slice: from a scan to its surface points, each step by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tonguetrack.model.mri.cloudfile import read_cloud
from tonguetrack.model.mri.scan import read_scan, scan_of, write_nifti
from tonguetrack.tracker.cli import main

pytest.importorskip("nibabel")

RADIUS_MM = 9.0
CENTRE = np.array([3.0, 40.0, -5.0])
SHAPE = (24, 26, 28)


@pytest.fixture
def scan(tmp_path) -> Path:
    """A bright ball in a noisy scan whose axes run to the right, down and back."""
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[2, 1], matrix[1, 2], matrix[3, 3] = -1.2, -1.1875, 1.1875, 1.0
    matrix[:3, 3] = CENTRE - matrix[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    places = np.indices(SHAPE).reshape(3, -1).T @ matrix[:3, :3].T + matrix[:3, 3]
    share = np.clip(0.5 - (np.linalg.norm(places - CENTRE, axis=1) - RADIUS_MM), 0, 1).reshape(SHAPE)
    values = 300.0 + 900.0 * share + np.random.default_rng(1).normal(scale=60, size=SHAPE)
    write_nifti(scan_of(values, matrix, "made"), tmp_path / "scan.nii.gz")
    return tmp_path / "scan.nii.gz"


def run(*arguments: object) -> int:
    return main(["mri", *map(str, arguments)])


def test_the_steps_one_after_the_other_find_the_surface(scan, tmp_path, capsys):
    smooth, parts, cloud = (tmp_path / name for name in ("smooth.nii.gz", "parts.nii", "cloud.ply"))
    assert run("denoise", scan, "-o", smooth) == 0
    assert "24 x 26 x 28 voxels of 1.2 x 1.188 x 1.188 mm, 20 steps" in capsys.readouterr().err
    before, after = read_scan(scan).quantised().values, read_scan(smooth).values
    corner = np.s_[:5, :5, :5]
    assert after[corner].std() < 0.2 * before[corner].std()

    assert run("segment", smooth, "-o", parts) == 0
    said = capsys.readouterr().err
    tissue = read_scan(parts).values
    volume = 4 / 3 * np.pi * RADIUS_MM**3
    assert set(np.unique(tissue)) == {0, 1}
    assert tissue.sum() * 1.2 * 1.1875**2 == pytest.approx(volume, rel=0.04)
    assert f"{100 * tissue.mean():.1f} % of" in said

    assert run("cloud", smooth, "-o", cloud) == 0
    found = read_cloud(cloud)
    assert f"{len(found.points)} points" in capsys.readouterr().err
    away = np.linalg.norm(found.points - CENTRE, axis=1)
    assert np.abs(away - RADIUS_MM).mean() < 0.25
    assert found.normals is not None
    assert ((found.normals * (found.points - CENTRE)).sum(axis=1) > 0.95 * away).all()


def test_the_papers_rule_and_a_threshold_can_be_asked_for(scan, tmp_path):
    for name, options in (("a", []), ("b", ["--voxels"]), ("c", ["--threshold", "1100"])):
        assert run("cloud", scan, "-o", tmp_path / f"{name}.ply", *options) == 0
    away = {
        name: np.median(np.linalg.norm(read_cloud(tmp_path / f"{name}.ply").points - CENTRE, axis=1))
        for name in "abc"
    }
    assert away["b"] < away["a"] and away["c"] < away["a"]


def test_a_region_in_mm_or_in_voxels_is_all_that_is_kept(scan, tmp_path):
    whole = read_scan(scan)
    assert (
        run("denoise", scan, "-o", tmp_path / "mm.nii", "--steps", 1, "--region", -5, 35, -12, 10, 45, 2) == 0
    )
    part = read_scan(tmp_path / "mm.nii")
    places = part.points(np.indices(part.values.shape).reshape(3, -1).T)
    assert (places.min(axis=0) >= [-5, 35, -12]).all() and (places.max(axis=0) <= [10, 45, 2]).all()
    assert (
        run("denoise", scan, "-o", tmp_path / "ijk.nii", "--steps", 1, "--voxels", 1, 2, 3, 11, 12, 13) == 0
    )
    part = read_scan(tmp_path / "ijk.nii")
    assert part.values.shape == (10, 10, 10)
    np.testing.assert_allclose(part.points([[0, 0, 0]]), whole.points([[1, 2, 3]]), atol=1e-4)


def test_a_slice_shows_what_is_where(scan, tmp_path):
    image = pytest.importorskip("matplotlib.image")
    from tonguetrack.model.mri.slicepicture import slice_values

    assert run("cloud", scan, "-o", tmp_path / "cloud.ply") == 0
    pictures = []
    for plane in ("sagittal", "coronal", "axial"):
        file = tmp_path / f"{plane}.png"
        assert run("slice", scan, "-o", file, "--plane", plane, "--cloud", tmp_path / "cloud.ply") == 0
        pictures.append(image.imread(file))
        assert pictures[-1].shape[0] > 300
        red, blue = pictures[-1][..., 0], pictures[-1][..., 2]
        assert (red - blue > 0.4).sum() > 200  # points and normals
    assert run("slice", scan, "-o", tmp_path / "bare.png", "--at", CENTRE[0] + 12) == 0
    bare = image.imread(tmp_path / "bare.png")
    assert (bare[..., 0] - bare[..., 2] > 0.4).sum() == 0

    values, (left, right, low, high) = slice_values(read_scan(scan), "sagittal", CENTRE[0])
    rows, columns = np.nonzero(values > 750)
    height, width = values.shape
    assert left + (columns.mean() + 0.5) / width * (right - left) == pytest.approx(CENTRE[1], abs=0.3)
    assert low + (rows.mean() + 0.5) / height * (high - low) == pytest.approx(CENTRE[2], abs=0.3)
    assert np.nanmax(slice_values(read_scan(scan), "sagittal", CENTRE[0] + 12)[0]) < 750


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["denoise", "gone.nii", "-o", "out.nii"], "gone.nii: there is no such scan"),
        (["denoise", "SCAN", "-o", "out.txt"], "out.txt: scans are written as .nii or .nii.gz"),
        (["denoise", "SCAN", "-o", "out.nii", "--contrast", "0"], "a contrast of 0.0 is out of range"),
        (["denoise", "SCAN", "-o", "out.nii", "--region", *"000111"], "the region of interest"),
        (["denoise", "SCAN", "-o", "SCAN"], "is read here and would be overwritten"),
        (["cloud", "SCAN", "-o", "out.ply", "--threshold", "1e9"], "no surface between tissue and air"),
        (["slice", "SCAN", "-o", "out.png", "--at", "500"], "a sagittal slice at 500 mm is not in this scan"),
        (["slice", "SCAN", "-o", "out.png", "--cloud", "gone.ply"], "gone.ply: there is no such point cloud"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_no_file(
    scan, tmp_path, monkeypatch, capsys, arguments, sentence
):
    monkeypatch.chdir(tmp_path)
    assert run(*[scan.name if word == "SCAN" else word for word in arguments]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and sentence in said[0]
    assert [file.name for file in tmp_path.iterdir()] == [scan.name]
