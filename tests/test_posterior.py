"""The linear Gaussian posterior: coils in, whole mesh out, by one constant matrix."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.tracker.posterior import posterior_from_shapes

VERTICES = 12
COILS = (3, 7, 10)


def shapes_with(modes, count=40, seed=0):
    """(count, k) shapes that differ in so many directions."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(modes, 3 * VERTICES))
    return random.normal(size=3 * VERTICES) * 10 + random.normal(size=(count, modes)) @ directions


def at_coils(shapes, coils=COILS):
    return shapes.reshape(len(shapes), -1, 3)[:, list(coils)]


def test_it_is_the_least_squares_prediction_of_the_mesh_from_noisy_coils():
    """Ridge regression on the training shapes is another way to the same matrix."""
    shapes = shapes_with(20)
    noise = 0.5
    deviations = shapes - shapes.mean(axis=0)
    inputs = at_coils(deviations).reshape(len(shapes), -1)
    penalty = np.sqrt(len(shapes) - 1) * noise * np.eye(inputs.shape[1])
    stacked = np.vstack([inputs, penalty])
    targets = np.vstack([deviations, np.zeros((inputs.shape[1], shapes.shape[1]))])
    matrix = np.linalg.lstsq(stacked, targets, rcond=None)[0]
    np.testing.assert_allclose(
        posterior_from_shapes(shapes, COILS, noise).gain(np.arange(3)), matrix.T, atol=1e-9
    )


def test_shapes_of_fewer_directions_than_coil_coordinates_are_found_from_exact_coils():
    training, unseen = np.split(shapes_with(4, count=45), [40])
    found = posterior_from_shapes(training, COILS, 1e-5).shapes(at_coils(unseen))
    np.testing.assert_allclose(found, unseen, atol=1e-5)


def test_coils_that_are_all_noise_leave_the_mean_shape():
    shapes = shapes_with(20)
    found = posterior_from_shapes(shapes, COILS, 1e9).shapes(at_coils(shapes) + 5.0)
    np.testing.assert_allclose(found, np.tile(shapes.mean(axis=0), (len(shapes), 1)), atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.booleans(), min_size=3, max_size=3), st.integers(0, 1000))
def test_a_missing_coil_is_a_coil_that_is_not_there(present, seed):
    shapes = shapes_with(20, seed=seed)
    coils = at_coils(shapes)[:2].copy()
    coils[1, ~np.array(present)] = np.nan
    found = posterior_from_shapes(shapes, COILS, 0.3).shapes(coils)[1]
    rest = [coil for coil, there in zip(COILS, present, strict=True) if there]
    if not rest:
        np.testing.assert_array_equal(found, shapes.mean(axis=0))
    else:
        expected = posterior_from_shapes(shapes, rest, 0.3).shapes(coils[1:, np.array(present)])[0]
        np.testing.assert_allclose(found, expected, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    st.permutations(range(3)), st.lists(st.floats(-100, 100), min_size=3, max_size=3), st.integers(0, 1000)
)
def test_neither_the_order_of_the_coils_nor_the_origin_of_the_frame_matters(order, shift, seed):
    shapes = shapes_with(20, seed=seed)
    coils = at_coils(shapes)[:4] + 0.3
    expected = posterior_from_shapes(shapes, COILS, 0.3).shapes(coils)
    moved = shapes + np.tile(shift, VERTICES)
    reordered = [COILS[index] for index in order]
    found = posterior_from_shapes(moved, reordered, 0.3).shapes(coils[:, list(order)] + np.array(shift))
    np.testing.assert_allclose(found - np.tile(shift, VERTICES), expected, atol=1e-8)


@pytest.mark.parametrize("noise", [0.0, -1.0, np.nan, np.inf])
def test_noise_that_is_none_is_refused(noise):
    with pytest.raises(InputError, match="needs a number above 0"):
        posterior_from_shapes(shapes_with(5), COILS, noise)


def test_one_shape_has_no_covariance():
    with pytest.raises(InputError, match="at least two training shapes, not 1"):
        posterior_from_shapes(shapes_with(5)[:1], COILS, 0.3)
