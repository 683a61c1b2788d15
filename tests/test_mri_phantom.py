"""The phantom: volumes like a scanner's, of tongues that keep their volume and touch what they press against,
with a truth that agrees with what the volumes show."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tonguetrack import InputError
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.model.mri.dataset import Dataset, load_dataset, read_landmarks
from tonguetrack.model.mri.phantom import making
from tonguetrack.model.mri.phantom.anatomy import Anatomy, head_of
from tonguetrack.model.mri.phantom.articulation import CONTACT_PHONES, PHONES, articulation_of
from tonguetrack.model.mri.phantom.landmarks import ALONG_MM, LARGEST, tongue_landmarks
from tonguetrack.model.mri.phantom.making import (
    MISSING_SHARE,
    PhantomScan,
    make_phantom,
    missing_cells,
    phantom_scan,
    phantom_speaker,
    truth_path,
)
from tonguetrack.model.mri.phantom.surfaces import BARE, CONTACT, palate_surface, tongue_surface
from tonguetrack.model.mri.phantom.tissue import PALATE, SEPTUM, TONGUE, WALL, label_at
from tonguetrack.model.mri.phantom.tongue import ACROSS, Tongue, tongue_of, touches_palate
from tonguetrack.model.mri.phantom.truth import read_truth, write_truth
from tonguetrack.model.mri.scan import read_scan
from tonguetrack.tracker.cli import main

SEED = 3
REFERENCE = Anatomy("reference")


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """One speaker, three phones, as written to disk and read back."""
    folder = tmp_path_factory.mktemp("phantom") / "set"
    return load_dataset(make_phantom(folder, 1, SEED, ("i", "a", "ɑ")))


@cache
def made(phone: str) -> PhantomScan:
    return phantom_scan(SEED, phantom_speaker(SEED, 1), phone)


@cache
def tongue(phone: str) -> Tongue:
    return tongue_of(REFERENCE, head_of(REFERENCE), articulation_of(phone))


# The data set ---------------------------------------------------------------------------------------


def test_the_written_data_set_is_whole_and_names_one_palate_scan(phantom):
    assert phantom.problems == () and phantom.missing() == ()
    assert phantom.phones == ("i", "a", "ɑ") and phantom.speakers == ("Speaker01",)
    marked = [key for key, entry in phantom.scans.items() if entry.palate_landmarks is not None]
    assert marked == [("Speaker01", phantom.palate_phone["Speaker01"])]
    assert "synthetic" in phantom.provenance and f"seed {SEED}" in phantom.provenance


def test_scans_have_the_papers_grid(phantom):
    scan = read_scan(phantom.scans["Speaker01", "i"].path)
    assert scan.values.shape == (100, 100, 44)
    np.testing.assert_allclose(scan.spacing_mm, [1.1875, 1.1875, 1.2], atol=1e-6)
    np.testing.assert_allclose(np.abs(scan.directions()[:, 2]), [1, 0, 0], atol=1e-6)  # sagittal slices


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_speaker(phantom, tmp_path):
    again = made("i")
    making.write_nifti(again.scan, tmp_path / "again.nii.gz")
    write_truth(again.truth, tmp_path / "again.npz")
    entry = phantom.scans["Speaker01", "i"]
    assert (tmp_path / "again.nii.gz").read_bytes() == entry.path.read_bytes()
    assert (tmp_path / "again.npz").read_bytes() == truth_path(phantom, "Speaker01", "i").read_bytes()
    assert phantom_speaker(SEED, 1).anatomy != phantom_speaker(SEED + 1, 1).anatomy


@given(seed=st.integers(0, 10**6), speakers=st.integers(1, 14))
@settings(max_examples=40, deadline=None)
def test_a_few_scans_are_missing_and_never_a_palate_scan(seed, speakers):
    people = [phantom_speaker(seed, number) for number in range(1, speakers + 1)]
    gone = missing_cells(seed, people, PHONES)
    wanted = round(MISSING_SHARE * speakers * len(PHONES))
    assert len(gone) == (wanted if speakers > 1 else 0)
    assert not any((person.number, person.palate_phone) in gone for person in people)
    for phone in PHONES:
        assert sum((person.number, phone) not in gone for person in people) >= speakers / 2


# What the volume shows ------------------------------------------------------------------------------


@pytest.mark.parametrize("phone", ["i", "a"])
def test_all_of_the_true_tongue_and_palate_is_in_the_field_of_view(phone):
    one = made(phone)
    for mesh in (one.truth.tongue, one.truth.palate):
        voxels = one.scan.voxels(mesh.vertices)
        assert (voxels > 0).all() and (voxels < np.array(one.scan.values.shape) - 1).all()


@pytest.mark.parametrize("phone", ["i", "a"])
def test_the_volume_goes_from_bright_to_dark_at_the_true_surface(phone):
    one = made(phone)
    mesh = one.truth.tongue
    normals = vertex_normals(mesh.vertices, mesh.faces)
    bare = one.truth.kind == BARE
    open_air = bare & (one.scan.at(mesh.vertices + 3.0 * normals) < 150)  # no other tissue close by
    assert open_air.sum() > 0.3 * len(bare)

    def seen(outwards_mm: float) -> float:
        return float(np.median(one.scan.at((mesh.vertices + outwards_mm * normals)[open_air])))

    inside, outside = seen(-3.0), seen(3.0)
    assert inside > 4 * outside
    half = 0.5 * (inside + outside)
    assert seen(-0.6) > half > seen(0.6)


def test_tongue_and_palate_merge_where_they_touch_and_air_parts_them_elsewhere():
    one = made("i")
    threshold = 0.5 * np.median(one.scan.at(one.truth.tongue.vertices - [0.0, 0.0, 8.0]))
    palate = one.truth.palate
    down = vertex_normals(palate.vertices, palate.faces)
    touched = one.truth.tongue.vertices[one.truth.kind == CONTACT]
    distance = cKDTree(touched).query(palate.vertices)[0]
    under = one.scan.at(palate.vertices + 0.8 * down)
    assert (distance < 1.0).sum() > 100
    assert np.mean(under[distance < 1.0] > threshold) > 0.97
    open_roof = made("a")
    clear = vertex_normals(open_roof.truth.palate.vertices, palate.faces)
    below = open_roof.scan.at(open_roof.truth.palate.vertices + 2.5 * clear)
    assert np.median(below) < 0.3 * threshold


def test_noise_is_that_of_a_magnitude_image():
    """In air, Rician noise has a mean of sqrt(pi/2) and a spread of sqrt(2 - pi/2) of its two channels'."""
    corner = made("i").scan.values[:8, :12]  # before and below the chin
    sigma = making.Imaging().noise * 900.0
    assert np.isclose(corner.std(), sigma * np.sqrt(2 - np.pi / 2), rtol=0.08)
    assert np.isclose(corner.mean(), sigma * np.sqrt(np.pi / 2), rtol=0.1)


# Tongues --------------------------------------------------------------------------------------------


def test_all_phones_keep_the_tongues_volume():
    volumes = np.array([tongue(phone).volume_mm3 for phone in PHONES])
    assert np.ptp(volumes) < 0.02 * volumes.mean()
    assert 30e3 < volumes.mean() < 90e3


@pytest.mark.parametrize("phone", PHONES)
def test_no_tongue_goes_through_the_roof_or_closes_the_airway_in_the_middle(phone):
    it = tongue(phone)
    assert (it.gap >= -1e-9).all()
    middle = slice(ACROSS // 2 - 1, ACROSS // 2 + 2)
    for wall in (PALATE, WALL):
        there = it.stop[it.tip_row :, middle] == wall
        assert (it.gap[it.tip_row :, middle][there] > 1.0).all()


def test_contact_phones_touch_the_palate_on_both_sides_and_open_ones_do_not():
    for phone in CONTACT_PHONES:
        touching = touches_palate(tongue(phone))
        assert touching[:, : ACROSS // 3].any() and touching[:, -ACROSS // 3 :].any(), phone
        assert not touching[:, ACROSS // 2].any(), phone
    for phone in ("a", "ɑ", "ʌ", "ɔ"):
        assert not touches_palate(tongue(phone)).any(), phone


def test_a_true_contact_lies_on_the_palate():
    surface = tongue_surface(tongue("i"), head_of(REFERENCE))
    touched = surface.mesh.vertices[surface.kind == CONTACT]
    assert len(touched) > 200
    distance = cKDTree(palate_surface(head_of(REFERENCE)).vertices).query(touched)[0]
    assert np.quantile(distance, 0.9) < 0.8


@pytest.mark.parametrize("phone", ["i", "u", "ɑ", "s"])
def test_just_below_the_true_surface_is_tongue_and_just_above_is_none(phone):
    it = tongue(phone)
    head = head_of(REFERENCE)
    surface = tongue_surface(it, head)
    vertices = surface.mesh.vertices
    normals = vertex_normals(vertices, surface.mesh.faces)
    inner = [label_at(*place, head, it.pose) for place in (vertices - 0.3 * normals)[::7]]
    outer = [label_at(*place, head, it.pose) for place in (vertices + 0.3 * normals)[::7]]
    assert np.mean(np.isin(inner, (TONGUE, SEPTUM))) > 0.99
    assert np.mean(np.isin(outer, (TONGUE, SEPTUM))) < 0.01


def test_phones_are_where_phoneticians_say_they_are():
    top = {phone: tongue(phone).middle[np.argmax(tongue(phone).middle[:, 1])] for phone in PHONES}
    root = {phone: tongue(phone).middle[tongue(phone).middle[:, 1] < -15][-15:, 0].max() for phone in PHONES}
    tip = {phone: tongue(phone).middle[tongue(phone).tip_row] for phone in PHONES}
    assert top["i"][1] > top["e"][1] > top["ɛ"][1] > top["a"][1]  # close to open
    assert top["u"][1] > top["o"][1] > top["ɔ"][1] > top["ɑ"][1]
    for front, back in (("i", "u"), ("e", "o"), ("ɛ", "ɔ"), ("i", "ʉ"), ("ʉ", "u")):
        assert top[front][0] < top[back][0]
        assert root[front] < root[back] + 0.5
    assert root["ɑ"] > root["ə"] > root["i"]
    assert tip["s"][1] > tip["ə"][1] > tip["a"][1]


def test_speakers_differ_in_anatomy():
    people = [phantom_speaker(SEED, number).anatomy for number in range(1, 12)]
    spread = np.ptp(
        [[p.size, p.palate_mm, p.palate_width, p.tongue_mm, p.jaw, p.wall_mm] for p in people], axis=0
    )
    assert (spread > [0.06, 2.0, 0.05, 1.0, 0.15, 1.0]).all()


# The truth beside the scans -------------------------------------------------------------------------


def test_between_scans_the_palate_moves_rigidly_and_by_the_stated_motion():
    first, second = made("i").truth, made("a").truth
    motion = second.head_to_world @ np.linalg.inv(first.head_to_world)
    np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    carried = first.palate.vertices @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(carried, second.palate.vertices, atol=1e-9)
    moved = np.linalg.norm(carried - first.palate.vertices, axis=1)
    assert 0.2 < moved.mean() < 10.0


def test_landmarks_are_on_voxels_and_a_few_millimetres_off(phantom):
    scan = read_scan(phantom.scans["Speaker01", "i"].path)
    clicked = phantom.scans["Speaker01", "i"].tongue_landmarks
    voxels = scan.voxels(np.array(list(clicked.values())))
    np.testing.assert_allclose(voxels, np.rint(voxels), atol=0.02)
    errors = []
    for seed in range(6):
        speaker = phantom_speaker(seed, 1)
        surface = tongue_surface(tongue("i"), head_of(REFERENCE))
        true = tongue_landmarks(surface, tongue("i").base)
        grid = making._grid(seed, speaker.number)
        placed = making.placed(true, grid, np.random.default_rng(seed))
        errors += [np.linalg.norm(placed[name] - true[name][0]) for name in true]
    assert ALONG_MM < np.mean(errors) < 2 * ALONG_MM
    assert np.max(errors) < 2 * LARGEST * ALONG_MM


def test_the_truth_survives_its_file(phantom):
    read = read_truth(truth_path(phantom, "Speaker01", "i"))
    true = made("i").truth
    np.testing.assert_allclose(read.tongue.vertices, true.tongue.vertices, atol=1e-4)
    np.testing.assert_array_equal(read.kind, true.kind)
    np.testing.assert_array_equal(read.palate.faces, true.palate.faces)
    np.testing.assert_array_equal(read.head_to_world, true.head_to_world)


def test_a_truth_that_is_none_is_refused_with_its_name(tmp_path):
    with pytest.raises(InputError, match=r"absent\.npz: there is no such truth"):
        read_truth(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(InputError, match=r"text\.npz: .*damaged"):
        read_truth(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", tongue_vertices=np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"other\.npz: expected the array 'tongue_vertices'"):
        read_truth(tmp_path / "other.npz")


# The command ----------------------------------------------------------------------------------------


def test_the_command_hands_on_what_was_asked_for_and_says_what_comes_next(tmp_path, monkeypatch, capsys):
    asked = []

    def instead(folder, speakers, seed, progress):
        asked.append((folder, speakers, seed, list(progress(["a scan"]))))
        return Path(folder) / "dataset.toml"

    monkeypatch.setattr(making, "make_phantom", instead)
    assert main(["mri", "phantom", str(tmp_path / "out"), "--speakers", "4", "--seed", "9"]) == 0
    assert asked == [(str(tmp_path / "out"), 4, 9, ["a scan"])]
    assert "tonguetrack mri build" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--speakers", "0"], ["--seed", "-1"]])
def test_impossible_numbers_are_refused_in_one_sentence(tmp_path, capsys, arguments):
    assert main(["mri", "phantom", str(tmp_path / "out"), *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_into_a_folder_that_holds_something(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["mri", "phantom", str(tmp_path)]) == 2
    assert "empty folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_landmark_files_hold_what_the_person_clicked(phantom):
    folder = phantom.source.parent / "landmarks"
    clicked = read_landmarks(folder / "Speaker01_i.csv")
    for name, place in made("i").tongue_landmarks.items():
        np.testing.assert_allclose(clicked[name], place, atol=0.006)
