"""The hard palate: its surface in one scan, where it is in the others, and what all palates have in common."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mesh import mesh_bytes, read_mesh, vertex_normals
from tonguetrack.model.mri import palatealignment
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.matching import PALATE, match
from tonguetrack.model.mri.palatealignment import STILL, ProfileSettings, align_palate
from tonguetrack.model.mri.palates import (
    PalatePriorSettings,
    first_match,
    palate_model,
    palate_surface,
    start_of,
)
from tonguetrack.model.mri.phantom.making import PhantomScan, phantom_scan, phantom_speaker
from tonguetrack.model.mri.scan import Scan, write_nifti
from tonguetrack.model.mri.surface import surface_points
from tonguetrack.model.mri.templates import palate
from tonguetrack.model.neighbours import NeighbourRule, SurfaceIndex
from tonguetrack.model.pca import fit_pca, pca_of
from tonguetrack.model.procrustes import RigidMotion, rigid_motion
from tonguetrack.tracker.cli import main

SEED = 0  # its first speaker has a palate of which the usual threshold misses the middle
RULE = NeighbourRule()


@cache
def made(phone: str) -> PhantomScan:
    return phantom_scan(SEED, phantom_speaker(SEED, 1), phone)


@cache
def smooth(phone: str) -> Scan:
    scan = made(phone).scan.quantised()
    return scan.holding(denoise(scan.values, scan.spacing_mm))


@cache
def extracted() -> np.ndarray:
    """(n, 3) the palate as the pipeline extracts it, before bootstrapping."""
    one = made("a")
    cloud = palate_surface(smooth("a"), one.palate_landmarks, palate())
    return first_match(SurfaceIndex(cloud), one.palate_landmarks, palate(), PALATE).vertices


def head_motion(before: PhantomScan, after: PhantomScan) -> RigidMotion:
    moved = after.truth.head_to_world @ np.linalg.inv(before.truth.head_to_world)
    return RigidMotion(moved[:3, :3], moved[:3, 3])


def errors(found: RigidMotion, true: RigidMotion, places: np.ndarray) -> tuple[float, float]:
    """mm (root of the mean square, at the places) and degrees."""
    apart = found.apply(places) - true.apply(places)
    turn = Rotation.from_matrix(found.rotation @ true.rotation.T).magnitude()
    return float(np.sqrt((apart**2).sum(axis=1).mean())), float(np.degrees(turn))


def motion_of(turn_deg: list[float], shift: list[float], about: np.ndarray) -> RigidMotion:
    turn = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    return RigidMotion(turn, about - turn @ about + np.array(shift))


def normals(vertices: np.ndarray) -> np.ndarray:
    return vertex_normals(vertices, palate().mesh.faces)


# Alignment ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phone", ["i", "ʃ", "u"])
def test_the_extracted_palate_is_found_in_other_scans_within_half_a_millimetre_and_half_a_degree(phone):
    before, after = made("a"), made(phone)
    found = align_palate(extracted(), normals(extracted()), before.scan.quantised(), after.scan.quantised())
    mm, degrees = errors(found.motion, head_motion(before, after), extracted())
    assert mm < 0.5
    assert degrees < 0.5
    assert found.score > found.start_score
    assert not found.uncertain


def test_a_palate_is_where_it_was_in_its_own_scan():
    scan = made("a").scan.quantised()
    found = align_palate(extracted(), normals(extracted()), scan, scan)
    mm, degrees = errors(found.motion, STILL, extracted())
    assert mm < 0.02
    assert degrees < 0.05
    assert found.score == pytest.approx(found.start_score, abs=1e-4)


@settings(max_examples=5, deadline=None)
@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3), st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_a_head_that_moved_by_millimetres_and_degrees_is_found(turn_deg, shift):
    """The grid of a scan is moved with the head: the values are the same, the answer is known exactly."""
    scan = made("a").scan.quantised()
    motion = motion_of(turn_deg, shift, extracted().mean(axis=0))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = motion.rotation, motion.shift
    moved = replace(scan, to_world=matrix @ scan.to_world)
    found = align_palate(extracted(), normals(extracted()), scan, moved)
    mm, degrees = errors(found.motion, motion, extracted())
    assert mm < 0.02
    assert degrees < 0.02


def test_brightness_and_contrast_do_not_matter():
    before, after = made("a").scan.quantised(), made("u").scan.quantised()
    darker = after.holding((30.0 + 0.6 * after.values).astype(np.float32))
    args = extracted(), normals(extracted()), before
    mm, degrees = errors(align_palate(*args, darker).motion, align_palate(*args, after).motion, extracted())
    assert mm < 0.05
    assert degrees < 0.1


def test_an_unrelated_scan_is_called_uncertain():
    scan = made("a").scan.quantised()
    noise = np.random.default_rng(1).integers(0, 255, scan.values.shape).astype(np.uint8)
    found = align_palate(extracted(), normals(extracted()), scan, scan.holding(noise))
    assert found.uncertain
    assert "correlate" in found.reason


def test_a_scan_that_ends_below_the_palate_is_called_uncertain():
    scan = made("a").scan.quantised()
    top = extracted()[:, 2].max() + 3.0
    low, high = scan.points([[0, 0, 0]])[0], scan.points([np.array(scan.values.shape) - 1])[0]
    low, high = np.minimum(low, high), np.maximum(low, high)
    high[2] = top
    found = align_palate(extracted(), normals(extracted()), scan, scan.cropped(low, high))
    assert "leave the scan" in found.reason


def test_a_palate_outside_of_its_scan_is_refused():
    scan = made("a").scan.quantised()
    with pytest.raises(InputError, match="of 1[0-9]{3} vertices of the palate have their profile"):
        align_palate(extracted() + 200.0, normals(extracted()), scan, scan)


def test_the_gradient_of_the_correlation_is_that_of_finite_differences():
    before, after = made("a").scan.quantised(), made("u").scan.quantised()
    vertices = extracted()[::17]
    pivot = vertices.mean(axis=0)
    profiles = palatealignment._Profiles.of(vertices, normals(extracted())[::17], pivot, ProfileSettings())
    here, there = (palatealignment._Values.of(scan, 0.3) for scan in (before, after))
    search = palatealignment._Search(profiles, here, there)
    motion = motion_of([1.0, -2.0, 0.5], [0.3, 1.0, -0.7], pivot)
    _, gradient, matrix, _ = search._compared(there, motion)
    step = 1e-5
    for direction in range(6):
        moved = np.zeros(6)
        moved[direction] = step
        more = search._compared(there, palatealignment._stepped(motion, pivot, moved))[0]
        less = search._compared(there, palatealignment._stepped(motion, pivot, -moved))[0]
        # Gray values are kept in single precision: that much the sums may be off.
        assert (more - less) / (2 * step) == pytest.approx(gradient[direction], rel=1e-3, abs=1e-3)
    assert np.linalg.eigvalsh(matrix).min() > 0.0


# The surface ----------------------------------------------------------------------------------------


def test_the_palate_s_own_threshold_shows_more_of_it_than_the_usual_one():
    one = made("a")
    true = one.truth.palate.vertices
    own = palate_surface(smooth("a"), one.palate_landmarks, palate())
    usual = surface_points(smooth("a"))
    near_own, near_usual = (cKDTree(cloud.points).query(true)[0] for cloud in (own, usual))
    assert near_own.mean() < 0.8
    assert near_own.mean() < 0.6 * near_usual.mean()


def test_the_extracted_palate_is_near_the_true_one():
    apart = cKDTree(extracted()).query(made("a").truth.palate.vertices)[0]
    assert apart.mean() < 1.0  # of vertices 1.4 mm apart
    assert np.mean(normals(extracted())[:, 2] < 0.0) > 0.8  # down, into the mouth


def test_landmarks_outside_of_the_scan_are_a_sentence_that_names_it():
    away = {name: place + 500.0 for name, place in made("a").palate_landmarks.items()}
    with pytest.raises(InputError, match="Speaker01.*landmarks of the palate are outside"):
        palate_surface(smooth("a"), away, palate())


# The model of all palates -----------------------------------------------------------------------------


def family(count: int = 6, seed: int = 0) -> np.ndarray:
    """(count, n, 3) palates that differ in height and width."""
    random = np.random.default_rng(seed)
    vertices = palate().mesh.vertices
    return np.array(
        [vertices * [1.0 + 0.05 * a, 1.0, 1.0 + 0.1 * b] for a, b in random.normal(size=(count, 2))]
    )


def test_a_model_has_the_mean_and_gives_every_training_shape_back():
    shapes = family()
    model = pca_of(shapes)
    assert np.allclose(model.mean, shapes.mean(axis=0))
    assert len(model.sigma) == 2  # two ways to differ, whatever the number of shapes
    flat = model.components.reshape(2, -1)
    assert np.allclose(flat @ flat.T, np.eye(2))
    weights = (shapes - model.mean).reshape(len(shapes), -1) @ flat.T
    assert np.allclose(weights.std(axis=0, ddof=1), model.sigma)
    assert all(np.allclose(model.shape(w), shape) for w, shape in zip(weights, shapes, strict=True))


def test_one_shape_alone_is_no_model():
    with pytest.raises(InputError, match="two or more"):
        pca_of(family(1))


def test_a_fit_finds_a_shape_of_the_model_wherever_it_lies():
    model = pca_of(family())
    true = model.shape(0.8 * model.sigma * [1, -1])
    motion = motion_of([3.0, -2.0, 4.0], [1.5, -1.0, 2.0], true.mean(axis=0))
    target = motion.apply(true)
    cloud = Cloud(target, normals(target))
    marks = {vertex: target[vertex] for vertex in palate().landmarks.values()}
    found = fit_pca(model, palate().mesh.faces, SurfaceIndex(cloud), marks, 1.0, RULE, STILL, 20)
    assert np.abs(found.vertices - target).max() < 0.1
    assert np.allclose(found.weights / model.sigma, [0.8, -0.8], atol=0.05)
    assert found.valid > 0.95


def test_weights_stay_within_their_box():
    model = pca_of(family())
    target = model.shape(3.0 * model.sigma)
    marks = {vertex: target[vertex] for vertex in palate().landmarks.values()}
    index = SurfaceIndex(Cloud(target, normals(target)))
    found = fit_pca(model, palate().mesh.faces, index, marks, 1.0, RULE, STILL)
    assert (np.abs(found.weights) <= model.sigma * (1.0 + 1e-9)).all()


def test_a_cloud_of_another_place_is_refused():
    model = pca_of(family())
    index = SurfaceIndex(Cloud(model.mean + 100.0, normals(model.mean)))
    with pytest.raises(InputError, match="0 % of the vertices"):
        fit_pca(model, palate().mesh.faces, index, {}, 1.0, RULE, STILL)


def test_a_palate_matched_again_from_the_model_is_as_near_to_the_truth_as_before():
    one = made("a")
    index = SurfaceIndex(palate_surface(smooth("a"), one.palate_landmarks, palate()))
    there = rigid_motion(palate().mesh.vertices, extracted())
    others = {str(k): there.apply(shape) for k, shape in enumerate(family(4))}
    model = palate_model({**others, "own": extracted()}, palate())
    start = start_of(model, extracted(), index, one.palate_landmarks, palate(), RULE, PalatePriorSettings())
    again = match(start, palate(), index, one.palate_landmarks, PALATE).vertices
    before, after = (
        cKDTree(shape).query(one.truth.palate.vertices)[0].mean() for shape in (extracted(), again)
    )
    assert after < before + 0.1


# The commands -----------------------------------------------------------------------------------------


def test_align_moves_a_palate_to_another_scan(tmp_path, capsys):
    for phone in ("a", "i"):
        write_nifti(made(phone).scan, tmp_path / f"{phone}.nii.gz")
    mesh = replace(palate().mesh, vertices=extracted())
    (tmp_path / "palate.ply").write_bytes(mesh_bytes(mesh, ".ply"))
    names = {name: str(tmp_path / name) for name in ("palate.ply", "a.nii.gz", "i.nii.gz", "moved.ply")}
    command = ["mri", "align", names["palate.ply"], "--from", names["a.nii.gz"], "--to", names["i.nii.gz"]]
    assert main([*command, "-o", names["moved.ply"]]) == 0
    moved = read_mesh(names["moved.ply"]).vertices
    wanted = head_motion(made("a"), made("i")).apply(extracted())
    assert np.sqrt(((moved - wanted) ** 2).sum(axis=1).mean()) < 0.5
    assert "the profiles correlate by 0.9" in capsys.readouterr().err
    assert main([*command, "-o", names["palate.ply"]]) == 2  # never over its own input
    assert main([*command, "-o", str(tmp_path / "moved.stl")]) == 2
    assert "end the name in one" in capsys.readouterr().err
