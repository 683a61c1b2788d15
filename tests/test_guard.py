"""Bad coils lose their say within a few frames, are named, and come back by themselves; good ones keep it."""

from dataclasses import replace

import numpy as np
import pytest

from tonguetrack.drivers import ReplaySource, open_recording
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.guard import CoilGuard
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.pose import CoilState, PoseStatus
from tonguetrack.tracker.tracking import track_recording

RATE_HZ = 250.0
BAD = 1
SECOND = int(RATE_HZ)


@pytest.fixture(scope="module")
def take(small_model):
    """Six seconds of five coils that move as a tongue does, 0.3 mm noise."""
    recording, setup = made_up_recording(small_model, 6 * SECOND, RATE_HZ)
    random = np.random.default_rng(3)
    noisy = recording.positions + random.normal(scale=0.3, size=recording.positions.shape)
    return replace(recording, positions=noisy), setup


def watched(model, recording, setup, **options):
    """states (frames, n), weights (frames, K), statuses (frames,), valid (frames,)."""
    tracker = Tracker(model, setup, RATE_HZ, watchful=True, **options)
    states, weights, statuses, valid = [], [], [], []
    for frame in ReplaySource(recording, speed=None):
        pose = tracker.step(frame)
        states.append(pose.coil_states.copy())
        weights.append(pose.weights.copy())
        statuses.append(pose.status)
        valid.append(pose.valid_coils)
    return np.array(states), np.array(weights), np.array(statuses), np.array(valid)


def spoilt(recording, change):
    positions = recording.positions.copy()
    change(positions[:, BAD])
    return replace(recording, positions=positions)


def longest_run(flags):
    best = current = 0
    for flag in flags:
        current = current + 1 if flag else 0
        best = max(best, current)
    return best


def test_good_coils_are_trusted_and_then_the_poses_are_those_of_the_batch(small_model, take):
    recording, setup = take
    states, weights, _, valid = watched(small_model, recording, setup)
    assert (states == CoilState.TRUSTED).all()
    assert (valid == len(setup.roles)).all()
    batch = track_recording(recording, small_model, experiments=(2,), setup=setup).experiment_2
    np.testing.assert_array_equal(weights, batch.weights)


def test_short_dropouts_cost_the_missing_frames_and_no_others(small_model, take):
    recording, setup = take

    def drop(coil):
        for start in range(100, 1400, 37):
            coil[start : start + 5] = np.nan

    spoilt_take = spoilt(recording, drop)
    states, *_ = watched(small_model, spoilt_take, setup)
    missing = np.isnan(spoilt_take.positions[:, BAD, 0])
    np.testing.assert_array_equal(states[:, BAD] == CoilState.MISSING, missing)
    assert (states[~missing, BAD] == CoilState.TRUSTED).all()


def test_one_outlier_costs_its_own_frame_only(small_model, take):
    recording, setup = take
    states, *_ = watched(
        small_model, spoilt(recording, lambda coil: coil.__setitem__(700, coil[700] + 40.0)), setup
    )
    assert states[700, BAD] == CoilState.WILD
    assert (np.delete(states[:, BAD], 700) == CoilState.TRUSTED).all()


def test_a_coil_that_jumps_about_is_wild_until_it_has_behaved_for_a_tenth_of_a_second(small_model, take):
    recording, setup = take
    random = np.random.default_rng(1)
    jumps = random.normal(scale=25.0, size=(2 * SECOND, 3))
    states, *_ = watched(
        small_model,
        spoilt(recording, lambda coil: coil.__setitem__(slice(500, 1000), coil[500:1000] + jumps)),
        setup,
    )
    during, after = states[503:1000, BAD], states[1000:, BAD]
    assert (during != CoilState.TRUSTED).mean() > 0.97
    assert longest_run(during == CoilState.TRUSTED) <= 2
    back = int(np.argmax(after == CoilState.TRUSTED))
    assert 0.09 * RATE_HZ <= back <= 0.15 * RATE_HZ
    assert (after[back:] == CoilState.TRUSTED).all()
    assert (np.delete(states, BAD, axis=1) == CoilState.TRUSTED).all()


def test_a_coil_that_drifts_off_its_place_is_a_misfit_and_comes_back(small_model, take):
    recording, setup = take
    way = np.concatenate([np.linspace(0, 30, 100), np.full(300, 30.0), np.linspace(30, 0, 100)])

    def drift(coil):
        coil[500:1000, 2] += way

    states, weights, *_ = watched(small_model, spoilt(recording, drift), setup)
    honest = track_recording(recording, small_model, experiments=(2,), setup=setup).experiment_2.weights
    believed = track_recording(
        spoilt(recording, drift), small_model, experiments=(2,), setup=setup
    ).experiment_2.weights
    assert (states[610:895, BAD] == CoilState.MISFIT).all()
    assert (states[1050:, BAD] == CoilState.TRUSTED).all()
    others = np.delete(states, BAD, axis=1)
    assert (others == CoilState.TRUSTED).mean() > 0.98
    wrong = np.linalg.norm(weights[620:880] - honest[620:880], axis=1).mean()
    assert wrong < 0.2 * np.linalg.norm(believed[620:880] - honest[620:880], axis=1).mean()


def test_a_coil_that_freezes_while_others_move_is_stuck(small_model, take):
    recording, setup = take
    states, *_ = watched(
        small_model, spoilt(recording, lambda coil: coil.__setitem__(slice(600, 1000), coil[600])), setup
    )
    assert (states[600 + SECOND // 3 : 1000, BAD] != CoilState.TRUSTED).all()
    assert CoilState.STUCK in states[600:1000, BAD]
    assert (states[1000 + SECOND // 4 :, BAD] == CoilState.TRUSTED).all()


def test_a_coil_that_comes_back_with_the_bits_it_went_with_is_not_stuck(small_model, take):
    recording, setup = take

    def blink(coil):
        coil[600:900] = np.nan
        coil[900:905] = coil[599]

    states, *_ = watched(small_model, spoilt(recording, blink), setup)
    assert (states[900:, BAD] == CoilState.TRUSTED).all()


def test_a_misfit_whose_judges_are_gone_is_believed_again(small_model, take):
    recording, setup = take
    positions = recording.positions.copy()
    positions[:, 3:] = np.nan
    positions[500:700, BAD] += [0.0, 12.0, 25.0]
    positions[650:, [0, 2]] = np.nan
    states, _, statuses, _ = watched(small_model, replace(recording, positions=positions), setup)
    assert (states[530:650, BAD] == CoilState.MISFIT).all()
    assert (states[650 + SECOND :, BAD] == CoilState.TRUSTED).all()
    assert (statuses[650 + SECOND :] == PoseStatus.OK).all()


def test_where_all_coils_have_moved_none_is_left_out_for_good(small_model, take):
    recording, setup = take
    positions = recording.positions.copy()
    positions[500:] += 100.0
    states, *_ = watched(small_model, replace(recording, positions=positions), setup)
    assert (states[500:520] == CoilState.WILD).all()
    assert (states[500 + 2 * SECOND :] == CoilState.TRUSTED).all()


@pytest.mark.parametrize("noise_mm", [0.1, 1.0])
@pytest.mark.parametrize("rate_hz", [40.0, 100.0, 250.0, 400.0, 1250.0])
def test_noise_and_fast_movements_are_not_wild(rate_hz, noise_mm):
    """Five coils that swing at up to 1 m/s."""
    random = np.random.default_rng(2)
    times_s = np.arange(int(8 * rate_hz)) / rate_hz
    directions = random.normal(size=(5, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    swing = 1000.0 / (8 * np.pi) * np.sin(8 * np.pi * times_s[:, None] + np.arange(5))
    positions = swing[:, :, None] * directions + random.normal(scale=noise_mm, size=(len(times_s), 5, 3))
    guard = CoilGuard(5)
    distrusted = 0
    for time_s, coils in zip(times_s.tolist(), positions, strict=True):
        guard.admit(coils, time_s)
        distrusted += int((guard.states != CoilState.TRUSTED).sum())
    assert distrusted < 0.001 * positions.shape[0] * 5


def test_a_device_that_repeats_whole_frames_has_no_stuck_coils(small_model, take):
    recording, setup = take
    positions = recording.positions.copy()
    positions[600:1000] = positions[600]
    states, *_ = watched(small_model, replace(recording, positions=positions), setup)
    assert (states[600:1000] == CoilState.TRUSTED).all()


def test_two_coils_at_least_are_left_to_the_solver(small_model, take):
    recording, setup = take
    positions = recording.positions.copy()
    for coil in range(4):
        positions[600 + 50 * coil :, coil] += np.linspace(0, 40, len(positions) - 600 - 50 * coil)[
            :, None
        ] * [0, 1, 1]
    _, _, statuses, valid = watched(small_model, replace(recording, positions=positions), setup)
    assert valid.min() >= 2
    assert (statuses == PoseStatus.OK).all()


def test_without_coils_the_pose_is_held_for_half_a_second_and_then_drifts_to_the_mean(small_model, take):
    recording, setup = take
    positions = recording.positions.copy()
    positions[500:1200] = np.nan
    _, weights, statuses, _ = watched(small_model, replace(recording, positions=positions), setup)
    held = slice(500, 500 + SECOND // 2)
    assert (statuses[held] == PoseStatus.HELD).all()
    np.testing.assert_array_equal(weights[held], np.broadcast_to(weights[499], weights[held].shape))
    assert (statuses[500 + SECOND // 2 + 1 : 1200] == PoseStatus.RELAXING).all()
    away = np.linalg.norm(weights[630:1200] - small_model.pose.mean, axis=1)
    assert (np.diff(away) <= 0).all()
    assert away[-1] < 0.01 * away[0]
    assert statuses[1200] == PoseStatus.OK


def test_what_is_decided_depends_on_the_devices_clock_alone(small_model, take):
    """Twice the same frames, at other host times, give the same bits."""
    recording, setup = take
    random = np.random.default_rng(5)
    positions = recording.positions + (random.random((len(recording.positions), 5, 1)) < 0.02) * 30.0
    positions[random.random((len(positions), 5)) < 0.05] = np.nan
    first = watched(small_model, replace(recording, positions=positions), setup)
    second = watched(small_model, replace(recording, positions=positions), setup)
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_jump_of_the_clock_starts_the_pose_anew(small_model, take):
    recording, setup = take
    tracker = Tracker(small_model, setup, RATE_HZ, watchful=True)
    fresh = Tracker(small_model, setup, RATE_HZ, watchful=True)
    frames = list(ReplaySource(recording, speed=None))
    for frame in frames[:200]:
        tracker.step(frame)
    jumped = replace(frames[900], device_time_s=frames[199].device_time_s - 5.0)
    np.testing.assert_array_equal(tracker.step(jumped).weights, fresh.step(frames[900]).weights)


@pytest.mark.parametrize("name", ["emu_webapp", "hprc", "ag501_reidy", "tardis/ema_ssff", "mocha"])
def test_ordinary_coils_of_real_recordings_keep_their_say(reference_data, small_model, name):
    """Judged by their movement alone: no model fits these recordings unaligned."""
    from tonguetrack.drivers import find_recordings

    place = reference_data / "recordings" / name
    if place.is_dir():
        place = next(found.path for found in find_recordings(place) if found.is_recording)
    recording = open_recording(place)
    guard = CoilGuard(len(recording.coils))
    distrusted = np.zeros(len(recording.coils))
    present = np.maximum(1, recording.valid().sum(axis=0))
    for time_s, coils in zip(recording.times_s, recording.positions, strict=True):
        guard.admit(np.ascontiguousarray(coils), float(time_s))
        distrusted += guard.states > CoilState.MISSING
    assert (distrusted / present < 0.005).all(), dict(zip(recording.coils, distrusted / present, strict=True))
