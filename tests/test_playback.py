"""Playback as a specification: where it stands, and the pose between two frames."""

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.pose import CoilState, PoseStatus, TrackedPoses
from tonguetrack.tracker.viewer.playback import SPEEDS, Ghost, Playback, check_times, frame_at, moment_at
from tonguetrack.tracker.viewer.player import Player
from tonguetrack.tracker.viewer.scene import moments_of


def poses_at(times_s, weights, coils=None, statuses=None):
    """Poses with one coil and one weight, which is also the speaker's."""
    frames = len(times_s)
    column = np.array(weights, dtype=float)[:, None]
    places = np.zeros((frames, 1, 3)) if coils is None else np.array(coils, dtype=float)[:, None, :]
    nothing = np.zeros(frames)
    states = np.full(frames, PoseStatus.OK) if statuses is None else np.array(statuses)
    return TrackedPoses(
        np.array(times_s, dtype=float), states, column, 2 * column, 3 * column, nothing, nothing,
        np.zeros((frames, 1)), places, None, ("tongue_tip",), (0,), 1, 100.0,
    )  # fmt: skip


TIMES = [10.0, 10.01, 10.02, 10.03]


@pytest.fixture
def moments():
    return moments_of(poses_at(TIMES, [0, 1, 4, 2], [[0, 0, 0], [0, 2, 0], [0, 2, 6], [np.nan] * 3]))


def test_at_a_frames_time_the_moment_is_that_frame(moments):
    for frame, time_s in enumerate(TIMES):
        shown, kept = moment_at(moments, time_s), moments[frame]
        assert shown.weights == kept.weights and shown.time_s == time_s
        assert np.array_equal(shown.coils, kept.coils, equal_nan=True)


def test_between_two_frames_all_that_is_linear_is_interpolated(moments):
    between = moment_at(moments, 10.0125)
    assert between.weights == pytest.approx([1.75])
    assert between.normalised == pytest.approx([3.5])
    assert between.speaker_weights == pytest.approx([5.25])
    assert between.coils == pytest.approx(np.array([[0, 2, 1.5]]))
    assert between.time_s == 10.0125


def test_a_coil_that_one_of_the_frames_lacks_is_missing_between_them(moments):
    assert np.isnan(moment_at(moments, 10.025).coils).all()
    assert moment_at(moments, 10.02).coil_states == [CoilState.TRUSTED]


def test_before_the_beginning_and_after_the_end_stand_the_ends(moments):
    assert moment_at(moments, -5.0).weights == [0.0]
    assert moment_at(moments, 99.0).weights == [2.0]


def test_a_gap_is_not_bridged():
    gap = moments_of(poses_at([0.0, 0.01, 0.02, 0.32], [0, 0, 1, 5]))
    assert moment_at(gap, 0.31).weights == [1.0]
    slow = moments_of(poses_at([0.0, 0.2, 0.4], [0, 1, 2]))
    assert moment_at(slow, 0.3).weights == pytest.approx([1.5])


def test_two_frames_of_one_time_are_the_later_one():
    twice = moments_of(poses_at([0.0, 0.01, 0.01, 0.02], [0, 1, 7, 2]))
    assert moment_at(twice, 0.01).weights == [7.0]
    assert frame_at(np.array([0.0, 0.01, 0.01, 0.02]), 0.01) == 2


def test_times_that_go_back_are_refused_with_the_frame():
    check_times(np.array([0.0, 1.0, 1.0, 2.0]), "good.csv")
    with pytest.raises(InputError, match=r"bad.csv: frame 2 comes at 0.5 s, before frame 1 at 1 s"):
        check_times(np.array([0.0, 1.0, 0.5]), "bad.csv")
    with pytest.raises(InputError, match=r"bad.csv: frame 1 has no time"):
        check_times(np.array([0.0, np.nan, 0.5]), "bad.csv")


def test_it_goes_on_as_fast_as_its_speed():
    playback = Playback(np.arange(101) / 10)
    playback.advance(1.0)
    playback.faster(1)
    playback.advance(1.0)
    assert (playback.speed, playback.time_s, playback.frame) == (2.0, pytest.approx(3.0), 30)
    for _ in range(20):
        playback.faster(1)
    assert playback.speed == SPEEDS[-1]
    for _ in range(20):
        playback.faster(-1)
    assert playback.speed == SPEEDS[0]


def test_paused_it_stands_still():
    playback = Playback(np.arange(101) / 10)
    playback.toggle()
    playback.advance(3.0)
    assert playback.time_s == 0.0
    playback.toggle()
    playback.advance(3.0)
    assert playback.time_s == 3.0


def test_at_the_end_it_begins_again_or_stops():
    looping = Playback(np.array([5.0, 6.0, 7.0]))
    looping.advance(2.5)
    assert looping.playing and looping.time_s == pytest.approx(5.5)
    once = Playback(np.array([5.0, 6.0, 7.0]), looping=False)
    once.advance(2.5)
    assert not once.playing and once.time_s == 7.0 and once.share == 1.0
    once.toggle()
    assert once.playing and once.time_s == 5.0


def test_stepping_pauses_on_frames_and_stays_within_the_take():
    playback = Playback(np.array([0.0, 0.1, 0.2]))
    playback.advance(0.15)
    playback.step(1)
    assert not playback.playing and playback.time_s == 0.2
    playback.step(1)
    assert playback.time_s == 0.2
    playback.step(-5)
    assert playback.time_s == 0.0


def test_scrubbing_goes_anywhere_and_does_not_pause():
    playback = Playback(np.array([2.0, 3.0, 6.0]))
    for share, time_s in [(0.5, 4.0), (-1.0, 2.0), (7.0, 6.0)]:
        playback.seek(share)
        assert playback.time_s == time_s and playback.playing


def test_one_frame_is_a_take_too():
    playback = Playback(np.array([3.0]))
    playback.advance(1.0)
    playback.seek(0.5)
    assert playback.time_s == 3.0 and playback.share == 0.0 and playback.frame == 0
    assert Ghost(moments_of(poses_at([3.0], [4]))).at(17.0).weights == [4.0]


def test_a_ghost_of_a_take_runs_along_and_begins_again(moments):
    ghost = Ghost(moments)
    assert ghost.at(0.0).weights == [0.0]
    assert ghost.at(0.01).weights == pytest.approx([1.0])
    assert ghost.at(0.03 + 0.01).weights == pytest.approx([1.0])
    assert Ghost(moments, 10.02).at(123.0).weights == [4.0]


def test_the_keys_do_what_the_window_says(moments):
    player = Player(None, moments)
    playback = player.playback
    for key, state in [
        (" ", lambda: not playback.playing),
        (" ", lambda: playback.playing),
        ("right", lambda: playback.frame == 1 and not playback.playing),
        ("left", lambda: playback.frame == 0),
        ("up", lambda: playback.speed == 2.0),
        ("down", lambda: playback.speed == 1.0),
        ("5", lambda: playback.share == pytest.approx(0.5)),
        ("end", lambda: playback.share == 1.0),
        ("home", lambda: playback.share == 0.0),
        ("o", lambda: not playback.looping),
        ("g", lambda: player.ghost is not None and player.ghost.at(0.0).weights == [0.0]),
        ("g", lambda: player.ghost is None),
        ("?", lambda: playback.frame == 0),
        ("é", lambda: playback.frame == 0),
        ("", lambda: playback.frame == 0),
    ]:
        player.press(key)
        assert state(), key
