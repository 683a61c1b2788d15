"""Distances between surfaces are exact, and a build is compared with the truth of its phantom, where it has one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from madebuild import (
    CELLS,
    COLUMNS,
    FINAL_MM,
    INITIAL_MM,
    PALATE_OFF_DEG,
    PALATE_OFF_MM,
    ROWS,
    SPEAKERS,
    TONGUE,
    Made,
    grid_mesh,
    made_build,
)
from scipy.spatial.transform import Rotation

from tonguetrack.model.mesh import Mesh
from tonguetrack.model.mri.matching import PAPER_TONGUE
from tonguetrack.model.mri.phantom.making import truth_path
from tonguetrack.model.mri.phantom.surfaces import BURIED, CONTACT
from tonguetrack.model.mri.settings import BuildSettings
from tonguetrack.model.mri.truthcomparison import (
    ablation_table,
    ablations,
    compare,
    has_truth,
    motion_error,
    surface_error,
    text_table,
)
from tonguetrack.model.surfacedistance import (
    Nearest,
    beyond_the_boundary,
    boundary_edges,
    nearest_on,
    vertex_areas,
)
from tonguetrack.parallel import local

SHARES = 24  # of an edge, where all places on all faces are tried


def places_on(mesh: Mesh) -> np.ndarray:
    """Evenly over every face."""
    weights = [(i, j, SHARES - i - j) for i in range(SHARES + 1) for j in range(SHARES + 1 - i)]
    return np.einsum("wk,fka->wfa", np.array(weights) / SHARES, mesh.vertices[mesh.faces]).reshape(-1, 3)


def place_of(mesh: Mesh, nearest: Nearest) -> np.ndarray:
    return np.einsum("pk,pka->pa", nearest.weights, mesh.vertices[mesh.faces[nearest.face]])


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    return made_build(tmp_path_factory.mktemp("made") / "set")


def comparison_of(result, dataset):
    with local(1) as executor:
        return compare(result, dataset, executor)


# Distances -----------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.floats(0.05, 20.0))
def test_no_place_on_any_face_is_nearer_and_the_nearest_is_on_the_mesh(seed, count, spread):
    """Of any triangles whatever, needles and points among them."""
    random = np.random.default_rng(seed)
    vertices = random.normal(size=(30, 3)) * [spread, 5.0, 1.0]
    faces = random.integers(0, 30, size=(count, 3)).astype(np.int32)
    mesh, points = Mesh(vertices, faces), random.normal(size=(40, 3)) * 6.0
    found = nearest_on(mesh, points)
    assert (found.weights >= 0.0).all() and np.allclose(found.weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(place_of(mesh, found), found.place, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points - found.place, axis=1), found.distance_mm, atol=1e-9)
    tried = places_on(mesh)
    best = np.linalg.norm(points[:, None] - tried, axis=2).min(axis=1)
    longest = np.linalg.norm(np.diff(vertices[faces[:, [0, 1, 2, 0]]], axis=1), axis=2).max()
    assert (found.distance_mm <= best + 1e-9).all()
    assert (found.distance_mm >= best - longest / SHARES).all()


def test_a_point_of_the_mesh_is_at_no_distance():
    found = nearest_on(TONGUE, places_on(TONGUE)[::97])
    assert found.distance_mm.max() < 1e-12


def test_a_tree_of_one_leaf_and_one_of_many_find_the_same():
    flat = grid_mesh(lambda x, y: 0.0 * x)
    points = np.random.default_rng(1).uniform([-15, 6, -9], [15, 49, 9], size=(500, 3))
    np.testing.assert_allclose(nearest_on(flat, points).distance_mm, np.abs(points[:, 2]), atol=1e-12)
    one = Mesh(flat.vertices, flat.faces[:1])
    corner = flat.vertices[flat.faces[0]].mean(axis=0)
    assert nearest_on(one, corner[None] + [0.0, 0.0, 2.0]).distance_mm[0] == pytest.approx(2.0)


def test_points_beside_an_open_mesh_are_known_to_be_beside_it():
    flat = grid_mesh(lambda x, y: 0.0 * x)
    above, beside = (
        [[0.3, 20.0, 3.0], [5.0, 30.0, -2.0]],
        [[16.4, 20.0, 1.0], [0.0, 2.0, 0.0], [-20.0, 60.0, 1.0]],
    )
    inner = flat.vertices[[COLUMNS + 1, 5 * COLUMNS + 4]] + [0.0, 0.0, 1.0]  # straight above inner vertices
    edge = 0.5 * (flat.vertices[COLUMNS + 1] + flat.vertices[2 * COLUMNS + 2])  # of two faces
    points = np.array([*above, *inner, edge, *beside])
    expected = [False] * 5 + [True] * 3
    assert beyond_the_boundary(flat, nearest_on(flat, points)).tolist() == expected


def test_the_end_of_a_grid_is_its_outer_edges():
    assert len(boundary_edges(TONGUE.faces)) == 2 * (ROWS - 1) + 2 * (COLUMNS - 1)
    closed = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], dtype=np.int32)
    assert len(boundary_edges(closed)) == 0


def test_the_areas_of_vertices_add_up_to_the_area_of_the_surface():
    flat = grid_mesh(lambda x, y: 0.5 * y)
    assert vertex_areas(flat).sum() == pytest.approx(32.0 * 45.0 * np.hypot(1.0, 0.5))


# One tongue ----------------------------------------------------------------------------------------


def flat_truth(buried_from_mm: float = 99.0):
    flat = grid_mesh(lambda x, y: 0.0 * x)
    kind = np.where(flat.vertices[:, 1] > buried_from_mm, BURIED, 0).astype(np.uint8)
    return flat, kind


@pytest.mark.parametrize("off_mm", [-0.7, 0.4])
def test_a_tongue_that_is_too_high_is_as_far_away_everywhere_and_outwards(off_mm):
    flat, kind = flat_truth()
    kind[:COLUMNS] = CONTACT
    found = surface_error(flat.vertices + [0.0, 0.0, off_mm], flat.faces, flat, kind)
    same = [found.mean, found.high, found.contact, found.back]
    np.testing.assert_allclose(same, abs(off_mm), atol=1e-12)
    assert found.outwards == pytest.approx(off_mm) and np.isnan(found.buried)


def test_what_lies_against_soft_tissue_is_counted_apart():
    flat, kind = flat_truth(buried_from_mm=30.0)
    lifted = flat.vertices + np.where(kind == BURIED, 3.0, 0.5)[:, None] * [0.0, 0.0, 1.0]
    found = surface_error(lifted, flat.faces, flat, kind)
    assert found.mean == pytest.approx(0.5) and found.back == pytest.approx(0.5, abs=1e-6)
    assert 1.5 < found.buried <= 3.0


def test_a_tongue_that_ends_too_early_is_charged_and_one_that_goes_on_is_not():
    flat, kind = flat_truth()
    short = np.flatnonzero(flat.vertices[flat.faces][:, :, 1].max(axis=1) < 30.0)
    early = surface_error(flat.vertices, flat.faces[short], flat, kind)
    assert early.mean > 2.0 and early.back == pytest.approx(0.0)
    longer = flat.vertices * [1.4, 1.4, 1.0] - [0.0, 10.0, 0.0]
    beyond = surface_error(longer, flat.faces, flat, kind)
    assert beyond.mean == pytest.approx(0.0, abs=1e-9) and beyond.back == pytest.approx(0.0, abs=1e-9)


def test_crowded_vertices_count_no_more_than_the_surface_they_have():
    flat, kind = flat_truth()
    y = flat.vertices[:, 1]
    crowded = flat.vertices.copy()
    crowded[:, 1] = 5.0 + 45.0 * ((y - 5.0) / 45.0) ** 3  # most of them in front
    tilted = crowded + np.outer(crowded[:, 1] - 5.0, [0.0, 0.0, 0.01])
    found = surface_error(tilted, flat.faces, Mesh(crowded, flat.faces), kind)
    # The mean over area of a wedge of 0.45 mm, and what 95 % of it lies below.
    assert found.mean == pytest.approx(0.225, abs=0.003) and np.mean(tilted[:, 2]) < 0.13
    assert found.high == pytest.approx(0.95 * 0.45, abs=0.03)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(1e-4, 20.0),
    st.floats(0.0, 5.0),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1),
)
def test_a_motion_is_wrong_by_what_it_was_made_wrong(angle_deg, off_mm, axis):
    points = TONGUE.vertices - TONGUE.vertices.mean(axis=0)
    true = np.eye(4)
    true[:3, :3] = Rotation.from_euler("xyz", [12.0, -5.0, 3.0], degrees=True).as_matrix()
    true[:3, 3] = [4.0, -2.0, 9.0]
    axis = np.array(axis) / np.linalg.norm(axis)
    right = points @ true[:3, :3].T
    wrong = Rotation.from_rotvec(np.radians(angle_deg) * axis).apply(right) + off_mm * axis
    apart, turned = motion_error(points, wrong + true[:3, 3], true)
    assert turned == pytest.approx(angle_deg, rel=1e-6, abs=1e-9)
    assert apart == pytest.approx(np.sqrt(np.mean(np.sum((wrong - right) ** 2, axis=1))), abs=1e-9)


# A whole build ---------------------------------------------------------------------------------------


def test_a_build_is_as_far_from_the_truth_as_it_was_made(made):
    found = comparison_of(made.result, made.dataset)
    assert set(found.scans) == set(CELLS) and not found.problems
    for cell, one in found.scans.items():
        for error, off_mm in ((one.initial, INITIAL_MM), (one.final, FINAL_MM)):
            # On a dome, straight up is a little further than to the nearest place.
            assert 0.8 * off_mm < error.mean < off_mm and 0.8 * off_mm < error.back < off_mm
            assert error.outwards == pytest.approx(error.mean, abs=0.02) and error.buried > 0.0
            assert np.isfinite(error.contact) == (cell[1] == "i")


def test_a_palate_is_judged_where_it_was_brought_not_where_it_was_found(made):
    found = comparison_of(made.result, made.dataset)
    assert found.palates == pytest.approx(dict.fromkeys(SPEAKERS, 0.0), abs=1e-4)
    for (_, phone), one in found.scans.items():
        if phone == "a":
            assert np.isnan(one.motion_mm) and np.isnan(one.turn_deg)
        else:
            assert one.motion_mm > PALATE_OFF_MM and one.motion_mm == pytest.approx(PALATE_OFF_MM, abs=0.1)
            assert one.turn_deg == pytest.approx(PALATE_OFF_DEG, abs=1e-3)


def test_the_summary_holds_the_means_the_worst_and_what_is_aimed_at(made):
    found = comparison_of(made.result, made.dataset)
    rows = {row.name: row for row in found.rows()}
    tongue = rows["true tongue to extracted"]
    finals = [one.final.mean for one in found.scans.values()]
    assert tongue.final == pytest.approx(np.mean(finals)) and tongue.worst == pytest.approx(max(finals))
    assert tongue.initial > tongue.final and tongue.most == 0.9
    assert rows["contact with the palate, [i e s ʃ]"].final == found.scans[CELLS[0]].final.contact
    assert rows["palate, turn in other scans"].final == pytest.approx(PALATE_OFF_DEG, abs=1e-3)
    assert f"{tongue.final:.2f}" in text_table(found) and "nan" not in text_table(found)


def test_a_truth_that_cannot_be_read_is_named_and_the_rest_compared(made, tmp_path):
    other = made_build(tmp_path / "set")
    truth_path(other.dataset, *CELLS[0]).write_bytes(b"no archive")
    found = comparison_of(other.result, other.dataset)
    assert set(found.scans) == set(CELLS[1:])
    (problem,) = found.problems
    assert problem.sentence.startswith("Speaker01 [i]: ") and "truth" in problem.sentence


def test_only_a_phantom_has_a_truth(made, tmp_path):
    assert has_truth(made.dataset)
    assert not has_truth(replace(made.dataset, source=tmp_path / "dataset.toml"))


# What each step brings ---------------------------------------------------------------------------------


def test_every_ablation_differs_from_the_whole_in_what_its_name_says():
    base = BuildSettings(rounds=3)
    whole, *others = ablations(base)
    assert whole.settings == base and len({one.name for one in others}) == len(others)
    by_name = {one.name: one.settings for one in others}
    assert by_name["without denoising"] == replace(base, denoise=False)
    assert by_name["without restoring contact"] == replace(base, restore_contact=False)
    assert by_name["the paper's matching"].tongue == PAPER_TONGUE
    assert all(one.settings.rounds == 3 and one.settings != base for one in others)


def test_the_table_of_ablations_has_a_line_for_each(made):
    found = comparison_of(made.result, made.dataset)
    lines = ablation_table({"everything": found, "without denoising": found}).splitlines()
    assert [line.split("  ")[0] for line in lines[1:]] == ["everything", "without denoising"]
    assert lines[1].split()[1:] == lines[2].split()[2:]
