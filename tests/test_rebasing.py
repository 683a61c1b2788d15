"""Re-based pose directions make the same meshes, with coefficients in 0..1."""

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.model.multilinear import SpeakerModel
from tonguetrack.model.rebasing import Rebased


def linear(directions, vertices=7, seed=3):
    random = np.random.default_rng(seed)
    return SpeakerModel(
        random.normal(size=3 * vertices) * 20,
        random.normal(size=(directions, 3 * vertices)) * 5,
        np.zeros((0, 3), np.int32),
        random.normal(size=directions),
        random.uniform(0.1, 1, directions),
    )


def rebuilt(rebased, speaker, weights):
    return (rebased.base(speaker) + rebased.to_unit(weights) @ rebased.directions(speaker)).reshape(-1, 3)


@pytest.mark.parametrize("directions", [1, 2, 4, 11])
def test_the_rebased_mesh_is_the_same_mesh_for_any_number_of_directions(directions):
    speaker = linear(directions)
    rebased = Rebased.of_range(speaker.mean, speaker.sigma)
    for weights in np.random.default_rng(1).normal(size=(20, directions)):
        np.testing.assert_allclose(rebuilt(rebased, speaker, weights), speaker.vertices(weights), atol=1e-12)


def test_three_sigma_below_the_mean_is_0_the_mean_one_half_and_three_above_1():
    speaker = linear(4)
    rebased = Rebased.of_range(speaker.mean, speaker.sigma)
    np.testing.assert_allclose(rebased.to_unit(speaker.mean - 3 * speaker.sigma), 0, atol=1e-12)
    np.testing.assert_allclose(rebased.to_unit(speaker.mean), 0.5)
    np.testing.assert_allclose(rebased.to_unit(speaker.mean + 3 * speaker.sigma), 1)


def test_no_frame_of_a_clip_leaves_0_to_1_and_both_ends_are_reached():
    weights = np.random.default_rng(5).normal(size=(300, 4))
    unit = Rebased.of_clip(weights).to_unit(weights)
    assert unit.min() >= 0 and unit.max() <= 1
    np.testing.assert_allclose(unit.min(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose(unit.max(axis=0), 1)


def test_raw_weights_come_back():
    rebased = Rebased.of_range([0.1, -0.2], [1.0, 3.0])
    weights = np.random.default_rng(2).normal(size=(9, 2)) * 4
    np.testing.assert_allclose(rebased.to_raw(rebased.to_unit(weights)), weights, atol=1e-12)


def test_a_direction_that_never_moves_in_a_clip_has_weight_0_and_the_mesh_is_still_exact():
    speaker = linear(3)
    weights = np.random.default_rng(5).normal(size=(20, 3))
    weights[:, 1] = 0.7
    rebased = Rebased.of_clip(weights)
    assert (rebased.to_unit(weights)[:, 1] == 0).all() and rebased.to_unit([0.0, 9.0, 0.0])[1] == 0
    assert not rebased.directions(speaker)[1].any()
    np.testing.assert_allclose(
        rebuilt(rebased, speaker, weights[4]), speaker.vertices(weights[4]), atol=1e-12
    )


def test_the_ranges_cannot_be_changed_from_outside():
    low = np.zeros(2)
    rebased = Rebased(low, np.ones(2))
    low[0] = 5
    assert rebased.low[0] == 0
    with pytest.raises(ValueError):
        rebased.low[0] = 1


@pytest.mark.parametrize(
    "low, high", [([0, 0], [1]), ([2.0], [1.0]), ([np.nan], [1.0]), ([0.0], [np.inf]), ([[0.0]], [[1.0]])]
)
def test_ranges_that_are_none_are_refused(low, high):
    with pytest.raises(InputError, match="range of weights"):
        Rebased(np.array(low), np.array(high))


@pytest.mark.parametrize("weights", [np.zeros((0, 4)), np.zeros(4)])
def test_a_clip_without_frames_has_no_range(weights):
    with pytest.raises(InputError, match="frames of weights"):
        Rebased.of_clip(weights)
