"""The pose weights as feature vectors: rate, low-pass, gaps, deltas, and their files."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.archive import read_arrays
from tonguetrack.drivers.frames import Recording
from tonguetrack.tracker.features import ARRAYS, deltas, features_of, resampled, write_features
from tonguetrack.tracker.session import Session
from tonguetrack.tracker.tracking import track_recording

RATE_HZ = 250.0


def frames(count: int) -> np.ndarray:
    return np.arange(count) / RATE_HZ


def everywhere(times: np.ndarray) -> np.ndarray:
    return np.ones(len(times), dtype=bool)


# Resampling -----------------------------------------------------------------------------------------


@given(rate=st.floats(5.0, 1000.0), slope=st.floats(-5.0, 5.0), offset=st.floats(-3.0, 3.0))
@settings(deadline=None, max_examples=50)
def test_a_straight_line_stays_the_line_at_every_rate(rate, slope, offset):
    times = frames(400) + 7.0
    at, values = resampled(times, (offset + slope * times)[:, None], everywhere(times), RATE_HZ, rate)
    np.testing.assert_allclose(values[:, 0], offset + slope * at, atol=1e-9)
    assert at[0] == times[0] and times[-1] - 1.0 / rate < at[-1] <= times[-1] + 1e-6
    np.testing.assert_allclose(np.diff(at), 1.0 / rate, atol=1e-9)


def test_the_recordings_own_rate_changes_nothing():
    times = frames(100)
    values = np.random.default_rng(1).normal(size=(100, 3))
    at, same = resampled(times, values, everywhere(times), RATE_HZ, RATE_HZ)
    np.testing.assert_allclose(at, times, atol=1e-12)
    np.testing.assert_allclose(same, values, atol=1e-9)


def test_what_the_new_rate_can_carry_stays_and_what_it_cannot_is_taken_away():
    times = frames(2000)
    slow, fast = np.sin(2 * np.pi * 8.0 * times), np.sin(2 * np.pi * 60.0 * times)
    at, values = resampled(times, np.column_stack([slow, fast]), everywhere(times), RATE_HZ, 100.0)
    inside = (at > 1.0) & (at < 7.0)
    # Linear interpolation between frames cuts a corner of at most (2 pi 8 / 250)^2 / 8 = 0.005.
    np.testing.assert_allclose(values[inside, 0], np.sin(2 * np.pi * 8.0 * at[inside]), atol=0.01)
    assert np.abs(values[inside, 1]).max() < 0.002


def test_upwards_nothing_is_filtered():
    times = frames(200)
    step = (times > 0.4).astype(float)
    _, values = resampled(times, step[:, None], everywhere(times), RATE_HZ, 2 * RATE_HZ)
    assert set(np.unique(values)) <= {0.0, 0.5, 1.0}


def test_nothing_is_invented_where_nothing_was_tracked_and_its_values_reach_nobody():
    times = frames(500)
    present = everywhere(times)
    present[200:260] = False
    values = np.where(present, 1.0, 1e6)[:, None]
    at, result = resampled(times, values, present, RATE_HZ, 100.0)
    inside = (at > times[199] + 1e-6) & (at < times[260] - 1e-6)
    assert np.isnan(result[inside]).all() and inside.sum() > 20
    np.testing.assert_allclose(result[~inside], 1.0, atol=1e-9)


def test_a_gap_in_the_times_is_not_bridged_but_one_lost_frame_is():
    times = np.delete(frames(300), [50, *range(150, 180)])
    at, values = resampled(times, np.ones((len(times), 1)), everywhere(times), RATE_HZ, RATE_HZ)
    missing = np.isnan(values[:, 0])
    assert missing.sum() == 30 and not missing[50] and missing[150:180].all() and len(at) == 300


def test_one_frame_is_one_feature_vector():
    at, values = resampled(np.array([3.0]), np.array([[0.5]]), np.array([True]), RATE_HZ, 100.0)
    assert at.tolist() == [3.0] and values.tolist() == [[0.5]]


# Deltas ---------------------------------------------------------------------------------------------


def test_a_delta_is_the_regression_slope_over_two_frames_to_either_side():
    values = np.random.default_rng(2).normal(size=(30, 2))
    for t in range(2, 28):
        slope = np.polyfit(np.arange(-2, 3), values[t - 2 : t + 3], 1)[0]
        np.testing.assert_allclose(deltas(values)[t], slope, atol=1e-12)


def test_at_the_ends_the_last_frame_is_repeated():
    np.testing.assert_allclose(deltas(np.arange(6.0)[:, None])[:, 0], [0.5, 0.8, 1.0, 1.0, 0.8, 0.5])


def test_each_stretch_between_gaps_has_its_own_ends():
    whole = np.random.default_rng(3).normal(size=(20, 2))
    whole[9] = np.nan
    found = deltas(whole)
    np.testing.assert_array_equal(found[:9], deltas(whole[:9]))
    np.testing.assert_array_equal(found[10:], deltas(whole[10:]))
    assert np.isnan(found[9]).all()


# A tracked take, and files --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def poses(small_model):
    swing = np.sin(np.linspace(0, 9, 300))[:, None] * np.array([0.9, -0.4, 0.6, 0.3])
    vertices = {"tongue_tip": 3, "tongue_blade": 9, "tongue_dorsum": 15}
    mean = small_model.speaker.mean
    shapes = [small_model.vertices(mean, small_model.pose.raw(x))[list(vertices.values())] for x in swing]
    positions = np.array(shapes)
    positions[100:130] = np.nan
    take = Recording(("TT", "TB", "TD"), positions, frames(300), RATE_HZ, "test", source="take 1")
    run = track_recording(take, small_model, Session(correspondences=vertices, speaker_weights=mean))
    return run.experiment_2


def test_both_ways_of_writing_a_weight_agree(poses, small_model):
    features = features_of(poses, 100.0)
    np.testing.assert_allclose(small_model.pose.normalised(features.weights), features.normalised, atol=1e-9)
    sigma = small_model.pose.sigma
    np.testing.assert_allclose(features.weights_delta, features.normalised_delta * sigma, atol=1e-12)
    np.testing.assert_allclose(
        features.weights_delta_delta, features.normalised_delta_delta * sigma, atol=1e-12
    )
    untracked = (features.times_s > 0.397) & (features.times_s < 0.519)
    for name in ARRAYS:
        np.testing.assert_array_equal(np.isnan(getattr(features, name)).all(axis=1), untracked)


def test_the_files_hold_the_same_numbers(poses, tmp_path):
    features = features_of(poses, 100.0)
    for name in ("features.csv", "features.npz"):
        write_features(features, poses, tmp_path / name)
    stored = read_arrays((tmp_path / "features.npz").read_bytes(), 10**7)
    header = json.loads(stored.pop("header").tobytes())
    assert (header["recording"], header["rate_hz"], header["experiment"]) == ("take 1", 100.0, 2)
    comment, names, *rows = (tmp_path / "features.csv").read_text(encoding="utf-8").splitlines()
    assert json.loads(comment.removeprefix("# ")) == header
    columns = names.split(",")
    assert (
        columns[:4] == ["frame", "time_s", "pose_1", "pose_2"] and columns[-1] == "pose_4_sigma_delta_delta"
    )
    table = np.genfromtxt(rows, delimiter=",")
    expected = np.column_stack([stored["times_s"], *(stored[name] for name in ARRAYS)])
    np.testing.assert_allclose(table[:, 1:], expected, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("rate", [0.0, -5.0, float("nan"), float("inf"), 1e9])
def test_a_rate_that_nobody_means_is_refused(poses, rate):
    with pytest.raises(InputError, match="expected a frame rate of 0.1 to 10000 Hz"):
        features_of(poses, rate)


def test_a_clock_that_jumped_does_not_fill_the_memory(poses):
    from dataclasses import replace

    times = poses.times_s.copy()
    times[-1] = 1e9
    with pytest.raises(InputError, match="too many feature vectors"):
        features_of(replace(poses, times_s=times), 100.0)
