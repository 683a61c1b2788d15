"""Models as immutable values: restriction, fixing the speaker, truncation, normalised weights."""

import dataclasses

import numpy as np
import pytest

from tonguetrack import InputError


@pytest.fixture()
def weights(small_model):
    random = np.random.default_rng(3)
    s = small_model.speaker.mean + 0.2 * random.normal(size=small_model.speaker.size)
    return s, small_model.pose.mean + 0.2 * random.normal(size=small_model.pose.size)


def test_a_shape_is_the_origin_plus_the_core_times_both_weights(small_model, weights):
    s, p = weights
    expected = small_model.origin + np.einsum("lkr,l,k->r", small_model.core, s, p)
    np.testing.assert_allclose(small_model.vertices(s, p).ravel(), expected, atol=1e-12)


def test_fixing_the_speaker_leaves_a_linear_model_with_the_same_shapes(small_model, weights):
    s, p = weights
    speaker = small_model.for_speaker(s)
    np.testing.assert_allclose(speaker.vertices(p), small_model.vertices(s, p), atol=1e-12)
    assert speaker.directions.shape == (4, small_model.origin.size)
    np.testing.assert_allclose(
        speaker.vertices(2 * p) - speaker.vertices(p),
        speaker.vertices(p) - speaker.vertices(0 * p),
        atol=1e-12,
    )


def test_restriction_keeps_the_given_order_of_vertices(small_model, weights):
    s, p = weights
    unsorted = (41, 3, 17, 3)
    np.testing.assert_array_equal(
        small_model.at(unsorted).vertices(s, p), small_model.vertices(s, p)[list(unsorted)]
    )


def test_fixing_the_speaker_and_restricting_commute(small_model, weights):
    s, p = weights
    a = small_model.at((5, 2)).for_speaker(s)
    b = small_model.for_speaker(s).at((5, 2))
    np.testing.assert_allclose(a.base, b.base, atol=0)
    np.testing.assert_allclose(a.directions, b.directions, atol=1e-12)
    np.testing.assert_allclose(a.vertices(p), b.vertices(p), atol=1e-12)


def test_training_weights_reproduce_the_sigma_that_is_measured(small_model):
    for mode in (small_model.speaker, small_model.pose):
        np.testing.assert_allclose(mode.mean, mode.training.mean(axis=0), atol=1e-15)
        np.testing.assert_allclose(mode.measured_sigma, mode.training.std(axis=0), atol=1e-15)
        np.testing.assert_allclose(mode.sigma, 1 / np.sqrt(mode.entries))
        # Columns of U have unit length: mean^2 + measured sigma^2 = 1 / entries.
        np.testing.assert_allclose(mode.mean**2 + mode.measured_sigma**2, 1 / mode.entries, atol=1e-12)


def test_normalised_weights_are_sigmas_from_the_mean_and_back(small_model):
    mode = small_model.pose
    np.testing.assert_allclose(mode.normalised(mode.mean), 0)
    np.testing.assert_allclose(mode.normalised(mode.mean + 2 * mode.sigma), 2)
    raw = np.random.default_rng(0).normal(size=(10, mode.size))
    np.testing.assert_allclose(mode.raw(mode.normalised(raw)), raw, atol=1e-12)


def test_nothing_in_a_model_can_be_written(small_model):
    with pytest.raises(ValueError, match="read-only"):
        small_model.core[0, 0, 0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        small_model.origin = None
    with pytest.raises(ValueError, match="read-only"):
        small_model.for_speaker(small_model.speaker.mean).base[0] = 1.0


def test_truncation_drops_trailing_weights_only(small_model):
    smaller = small_model.truncated(3, 2)
    np.testing.assert_array_equal(smaller.core, small_model.core[:3, :2])
    np.testing.assert_array_equal(smaller.pose.training, small_model.pose.training[:, :2])
    assert len(smaller.speaker.spectrum) == 11


def test_the_fingerprint_names_the_numbers(small_model):
    assert small_model.truncated(5, 4).fingerprint == small_model.fingerprint
    assert small_model.truncated(5, 3).fingerprint != small_model.fingerprint
    renamed = dataclasses.replace(small_model, provenance={"name": "another"})
    assert renamed.fingerprint == small_model.fingerprint


@pytest.mark.parametrize("vertex", [-1, 60])
def test_a_vertex_that_is_not_there_is_named(small_model, vertex):
    with pytest.raises(InputError, match=f"vertex {vertex} does not exist; the model has vertices 0 to 59"):
        small_model.at([0, vertex])


def test_speaker_weights_of_another_model_are_refused(small_model):
    with pytest.raises(InputError, match="3 speaker weights were given, but .* has 5"):
        small_model.for_speaker(np.zeros(3))


def test_more_modes_than_there_are_are_refused(small_model):
    with pytest.raises(InputError, match="7 speaker modes were asked for"):
        small_model.truncated(7, 4)
