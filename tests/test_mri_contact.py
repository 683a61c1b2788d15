"""The palate in a cloud: put in where a tongue touches it, nothing left behind it, everything else as it was."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tonguetrack import InputError
from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mesh import mesh_bytes, vertex_normals
from tonguetrack.model.mri.cloudfile import cloud_bytes, read_cloud
from tonguetrack.model.mri.contact import ContactSettings, restore_contact
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.phantom.making import PhantomScan, phantom_scan, phantom_speaker
from tonguetrack.model.mri.phantom.surfaces import CONTACT
from tonguetrack.model.mri.surface import surface_points
from tonguetrack.model.mri.templates import palate
from tonguetrack.tracker.cli import main

SEED = 0


@cache
def made(phone: str) -> PhantomScan:
    return phantom_scan(SEED, phantom_speaker(SEED, 2), phone)


@cache
def cloud(phone: str) -> Cloud:
    scan = made(phone).scan.quantised()
    return surface_points(scan.holding(denoise(scan.values, scan.spacing_mm)))


def rows(cloud: Cloud) -> set[tuple[float, ...]]:
    return {tuple(row) for row in np.round(np.hstack([cloud.points, cloud.normals]), 6)}


def sheet(height_mm: float, up: float) -> Cloud:
    """Points below or above the palate template, a sheet like it; up: 1 for normals upwards, -1 for downwards."""
    vertices = palate().mesh.vertices
    down = vertex_normals(vertices, palate().mesh.faces)
    return Cloud(vertices - height_mm * down, -up * down)


def joined(*clouds: Cloud) -> Cloud:
    return Cloud(np.vstack([c.points for c in clouds]), np.vstack([c.normals for c in clouds]))


def test_where_a_tongue_touches_the_palate_its_surface_is_restored():
    truth = made("i").truth
    touching = truth.tongue.vertices[truth.kind == CONTACT]
    assert len(touching) > 100
    found = restore_contact(cloud("i"), truth.palate)
    before, after = (cKDTree(c.points).query(touching)[0] for c in (cloud("i"), found))
    assert before.mean() > 1.5
    assert after.mean() < 0.7


def test_what_is_put_in_looks_up_as_a_tongue_does():
    found = restore_contact(cloud("i"), made("i").truth.palate)
    new = np.array(sorted(rows(found) - rows(cloud("i"))))
    assert len(new) > 100
    assert (new[:, 5] > 0.0).mean() > 0.95


def test_what_lies_behind_the_palate_is_taken_out_and_nothing_else():
    seen, bone, tongue = sheet(0.0, -1.0), sheet(2.5, 1.0), sheet(-6.0, 1.0)
    found = restore_contact(joined(seen, bone, tongue), palate().mesh)
    assert rows(found) == rows(joined(seen, tongue))


def test_a_palate_that_a_scan_shows_is_not_put_in_again():
    seen = joined(sheet(0.3, -1.0), sheet(-5.0, 1.0))
    assert rows(restore_contact(seen, palate().mesh)) == rows(seen)


def test_a_palate_that_a_scan_does_not_show_is_put_in_whole():
    below = sheet(-8.0, 1.0)
    found = restore_contact(below, palate().mesh)
    assert len(found.points) == len(below.points) + len(palate().mesh.vertices) + len(palate().mesh.faces)


def test_everywhere_puts_all_of_it_in_as_in_the_paper():
    seen = joined(sheet(0.3, -1.0), sheet(-5.0, 1.0))
    found = restore_contact(seen, palate().mesh, ContactSettings(everywhere=True))
    assert len(found.points) == len(seen.points) + len(palate().mesh.vertices) + len(palate().mesh.faces)


def test_points_in_front_of_the_palate_and_in_the_cheek_below_it_stay():
    beside = Cloud(np.array([[40.0, 25.0, -20.0], [0.0, -30.0, 5.0]]), np.array([[0.0, 0.0, 1.0]] * 2))
    both = joined(sheet(0.0, -1.0), beside)
    assert rows(restore_contact(both, palate().mesh)) == rows(both)


def test_landmarks_stay():
    marked = Cloud(sheet(0.0, -1.0).points, sheet(0.0, -1.0).normals, {3: np.zeros(3)})
    assert restore_contact(marked, palate().mesh).landmarks == marked.landmarks


def test_a_cloud_without_normals_or_of_another_place_is_refused():
    with pytest.raises(InputError, match="no normals"):
        restore_contact(Cloud(sheet(0.0, 1.0).points), palate().mesh)
    far = Cloud(sheet(0.0, 1.0).points + 300.0, sheet(0.0, 1.0).normals)
    with pytest.raises(InputError, match="bring the palate into its scan first"):
        restore_contact(far, palate().mesh)


def test_restore_writes_the_same_cloud_as_the_function(tmp_path, capsys):
    truth = made("i").truth
    (tmp_path / "cloud.ply").write_bytes(cloud_bytes(cloud("i")))
    (tmp_path / "palate.ply").write_bytes(mesh_bytes(truth.palate, ".ply"))
    command = ["mri", "restore", str(tmp_path / "cloud.ply"), "--palate", str(tmp_path / "palate.ply")]
    assert main([*command, "-o", str(tmp_path / "out.ply")]) == 0
    wanted = restore_contact(read_cloud(tmp_path / "cloud.ply"), truth.palate)
    written = read_cloud(tmp_path / "out.ply")
    assert np.allclose(written.points, wanted.points, atol=1e-4)
    assert main([*command, "-o", str(tmp_path / "all.ply"), "--everywhere"]) == 0
    assert len(read_cloud(tmp_path / "all.ply").points) > len(written.points)
    (tmp_path / "bare.ply").write_bytes(cloud_bytes(Cloud(cloud("i").points)))
    bare = ["mri", "restore", str(tmp_path / "bare.ply"), "--palate", str(tmp_path / "palate.ply")]
    assert main([*bare, "-o", str(tmp_path / "out.ply")]) == 2
    assert "bare.ply: the point cloud has no normals" in capsys.readouterr().err
