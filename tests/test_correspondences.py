"""The search for the vertices that coils sit on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.model.build import (
    TrainingShapes,
    load_training_shapes,
    model_from_shapes,
    read_sample_database,
)
from tonguetrack.model.midsagittal import midsagittal_vertices
from tonguetrack.tracker.correspondences import estimate_correspondences, ordered_nearest, typical_frame
from tonguetrack.tracker.session import Energy

ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum")


@given(st.integers(1, 4), st.integers(4, 9), st.integers(0, 10_000))
@settings(max_examples=100, deadline=None)
def test_ordered_nearest_is_the_best_of_all_increasing_choices(coils, places, seed):
    from itertools import combinations

    random = np.random.default_rng(seed)
    contour, targets = random.normal(size=(places, 3)), random.normal(size=(coils, 3))
    found = ordered_nearest(contour, targets)
    assert (np.diff(found) > 0).all()

    def cost(choice):
        return np.linalg.norm(contour[list(choice)] - targets, axis=1).sum()

    best = min(combinations(range(places), coils), key=cost)
    assert cost(found) == pytest.approx(cost(best))


def test_coils_on_the_models_own_shapes_are_found_again(small_model):
    random = np.random.default_rng(4)
    truth = [3, 9, 15]
    s = small_model.speaker.raw(random.uniform(-0.5, 0.5, 5))
    frames = [
        small_model.vertices(s, small_model.pose.raw(random.uniform(-0.8, 0.8, 4)))[truth] for _ in range(40)
    ]
    found = estimate_correspondences(
        small_model, np.array(frames), ROLES, Energy(beta_pose=0.5, beta_speaker=0.5)
    )
    assert np.abs(np.array(found.vertices) - truth).max() <= 1
    assert found.roles == ROLES
    assert max(found.distances_mm) < 1.5


def test_the_search_is_deterministic_and_ordered_from_tip_to_root(small_model):
    coils = np.random.default_rng(5).normal(size=(30, 3, 3)) * 2 + small_model.mean_vertices()[[2, 8, 16]]
    first = estimate_correspondences(small_model, coils, ROLES, Energy())
    assert first == estimate_correspondences(small_model, coils, ROLES, Energy())
    order = list(midsagittal_vertices(small_model))
    places = [order.index(vertex) for vertex in first.vertices]
    assert places == sorted(places)


def test_the_order_of_naming_does_not_matter(small_model):
    coils = np.random.default_rng(6).normal(size=(30, 3, 3)) + small_model.mean_vertices()[[2, 8, 16]]
    found = estimate_correspondences(small_model, coils, ROLES, Energy())
    mixed = [2, 0, 1]
    again = estimate_correspondences(
        small_model, np.ascontiguousarray(coils[:, mixed]), [ROLES[i] for i in mixed], Energy()
    )
    assert [again.vertices[mixed.index(i)] for i in range(3)] == list(found.vertices)


def test_a_lateral_coil_may_leave_the_mid_sagittal_plane(small_model):
    shape = small_model.mean_vertices()
    coils = np.repeat(shape[None, [3, 29, 15]], 5, axis=0)
    roles = ("tongue_tip", "tongue_left", "tongue_dorsum")
    found = estimate_correspondences(small_model, coils, roles, Energy())
    assert shape[found.vertices[1], 0] > 4


def test_the_frame_that_is_used_is_a_typical_one_with_every_coil():
    coils = np.zeros((9, 2, 3))
    coils[:, 1, 0] = [0, 1, 2, 3, 100, 5, 6, 7, 8]
    coils[3, 0] = np.nan  # the median's nearest neighbour has a gap
    assert typical_frame(coils) == 5
    coils[:, 1] = np.nan
    with pytest.raises(InputError, match="no frame has all tongue coils"):
        typical_frame(coils)


def test_the_mid_sagittal_vertices_of_the_real_meshes_run_from_tip_to_root(reference_data):
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    model = model_from_shapes(shapes, 5, 4)
    order = midsagittal_vertices(model)
    points = model.mean_vertices()[order]
    assert (np.abs(points[:, 0]) < 2).all()
    assert points[0, 1] < 7
    assert points[-1, 1] > 58
    assert {2469, 2465, 1912, 885, 1250} <= set(order)
    assert 1935 not in order  # the front of the base, below the tip


@pytest.fixture(scope="module")
def held_out_errors(reference_data):
    """(11, 3) mm: how far from the true vertices the found ones lie, on speakers outside the model."""
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    truth = [2465, 1912, 1250]
    errors = []
    for held_out in range(11):
        keep = [i for i in range(11) if i != held_out]
        names = tuple(shapes.speakers[i] for i in keep)
        model = model_from_shapes(
            TrainingShapes(shapes.tensor[keep], shapes.faces, names, shapes.prompts), 5, 4
        )
        meshes = shapes.tensor[held_out].reshape(13, -1, 3)
        noise = np.random.default_rng(held_out).normal(0, 0.3, (13, 3, 3))
        found = estimate_correspondences(model, meshes[:, truth] + noise, ROLES, Energy())
        errors.append(np.linalg.norm(meshes[0, truth] - meshes[0, list(found.vertices)], axis=1))
    return np.array(errors)


def test_on_unseen_real_speakers_the_vertices_are_found_within_a_few_millimetres(held_out_errors):
    assert held_out_errors.mean() < 3.5
