"""The speaker estimated beside the loop: what is kept, what comes of it, how it ends."""

import sys
import time

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker import background
from tonguetrack.tracker.anatomy import estimate_speaker
from tonguetrack.tracker.background import FEWEST_FRAMES, BackgroundSpeaker
from tonguetrack.tracker.session import Energy

VERTICES = [1, 8, 14, 47]


@pytest.fixture
def often(monkeypatch):
    """Estimates come as fast as they can, for nobody wants to wait for them here."""
    monkeypatch.setattr(background, "PERIOD_S", 0.01)


@pytest.fixture
def at_coils(small_model):
    return small_model.at(VERTICES)


def speech(model, at_coils, frames, seed):
    random = np.random.default_rng(seed)
    s = model.speaker.mean + 0.5 * model.speaker.sigma * random.normal(size=model.speaker.size)
    poses = model.pose.mean + 0.5 * model.pose.sigma * random.normal(size=(frames, model.pose.size))
    coils = np.array([at_coils.vertices(s, p) for p in poses])
    return coils + 0.3 * random.normal(size=coils.shape)


def wait_for(speaker, condition):
    end = time.monotonic() + 30.0
    while not (speaker.latest and condition(speaker.latest)):
        assert time.monotonic() < end, f"nothing came that was waited for; the latest is {speaker.latest}"
        time.sleep(0.005)
    return speaker.latest


def test_the_estimate_is_that_of_the_frames_that_were_kept(small_model, at_coils, often):
    coils = speech(small_model, at_coils, 200, seed=1)
    speaker = BackgroundSpeaker(at_coils, Energy(), window_s=10.0, rate_hz=200.0)
    try:
        speaker.warm_up()
        for frame in coils:
            speaker.add(frame)
        found = wait_for(speaker, lambda latest: latest.frames == 50)  # every fourth: 20 ms
    finally:
        speaker.close()
    expected = estimate_speaker(at_coils, Energy(), coils[::4])
    np.testing.assert_allclose(found.weights, expected.weights, atol=1e-5)
    assert found.residual_mm == pytest.approx(expected.residual_mm, rel=1e-3)


def test_the_window_moves_on_and_the_estimate_with_it(small_model, at_coils, often):
    """Two people in a row: in the end the first one has been forgotten."""
    first, second = (speech(small_model, at_coils, 100, seed) for seed in (2, 3))
    apart = (
        estimate_speaker(at_coils, Energy(), first).weights
        - estimate_speaker(at_coils, Energy(), second).weights
    )
    speaker = BackgroundSpeaker(at_coils, Energy(), window_s=2.0, rate_hz=50.0)
    try:
        for frame in first:
            speaker.add(frame)
        wait_for(speaker, lambda latest: latest.frames >= 90)
        for frame in second:
            speaker.add(frame)
        goal = estimate_speaker(at_coils, Energy(), second).weights
        wait_for(speaker, lambda latest: np.linalg.norm(latest.weights - goal) < 0.05 * np.linalg.norm(apart))
    finally:
        speaker.close()


@pytest.fixture
def idle(at_coils, monkeypatch):
    """Makes one whose thread never wakes, to look at what it would see."""
    monkeypatch.setattr(background, "PERIOD_S", 60.0)
    made = []

    def make(window_s, rate_hz):
        made.append(BackgroundSpeaker(at_coils, Energy(), window_s, rate_hz))
        return made[-1]

    yield make
    for speaker in made:
        speaker.close()


def numbered(n):
    return np.full((len(VERTICES), 3), float(n))


def kept_numbers(speaker):
    return sorted(n for n in speaker.snapshot()[:, 0, 0] if not np.isnan(n))


@pytest.mark.parametrize(
    ("rate_hz", "every"), [(10.0, 1), (50.0, 1), (51.0, 2), (100.0, 2), (250.0, 5), (400.0, 8), (1250.0, 25)]
)
def test_frames_are_kept_at_least_20_ms_apart(idle, rate_hz, every):
    speaker = idle(window_s=60.0, rate_hz=rate_hz)
    for n in range(4 * every):
        speaker.add(numbered(n))
    assert kept_numbers(speaker) == [0, every, 2 * every, 3 * every]


def test_the_ring_holds_the_newest_frames_of_the_window_but_the_one_that_may_be_written(idle):
    speaker = idle(window_s=1.0, rate_hz=50.0)
    for n in range(173):
        speaker.add(numbered(n))
    assert kept_numbers(speaker) == list(range(173 - 49, 173))


def test_frames_that_are_written_while_the_ring_is_copied_are_left_out(idle, monkeypatch):
    speaker = idle(window_s=1.0, rate_hz=50.0)
    for n in range(100):
        speaker.add(numbered(n))
    copy = np.copyto

    def interrupted(destination, source):
        copy(destination, source)
        for n in (100, 101, 102):
            speaker.add(numbered(n))

    monkeypatch.setattr(background.np, "copyto", interrupted)
    assert kept_numbers(speaker) == list(range(54, 100))
    monkeypatch.undo()
    assert kept_numbers(speaker) == list(range(54, 103))


def test_what_is_added_is_copied(idle):
    speaker = idle(window_s=1.0, rate_hz=50.0)
    coils = numbered(1)
    speaker.add(coils)
    coils[:] = 2
    assert kept_numbers(speaker) == [1]


def test_adding_frames_keeps_no_memory(idle):
    speaker = idle(window_s=1.0, rate_hz=50.0)
    coils = numbered(1)
    for _ in range(1000):
        speaker.add(coils)
    before = sys.getallocatedblocks()
    for _ in range(20_000):
        speaker.add(coils)
    assert sys.getallocatedblocks() - before < 100


def test_nothing_is_said_from_too_few_frames_or_from_none_with_coils(small_model, at_coils, often):
    coils = speech(small_model, at_coils, FEWEST_FRAMES, seed=4)
    speaker = BackgroundSpeaker(at_coils, Energy(), window_s=2.0, rate_hz=50.0)
    try:
        speaker.warm_up()
        for frame in coils[:-1]:
            speaker.add(frame)
        for _ in range(20):
            speaker.add(np.full((4, 3), np.nan))
        time.sleep(0.1)
        assert speaker.latest is None
        speaker.add(coils[-1])
        assert wait_for(speaker, lambda latest: True).frames == FEWEST_FRAMES
    finally:
        speaker.close()


def test_the_latest_estimate_stays_when_the_coils_are_gone(small_model, at_coils, often):
    speaker = BackgroundSpeaker(at_coils, Energy(), window_s=1.0, rate_hz=50.0)
    try:
        for frame in speech(small_model, at_coils, 49, seed=5):
            speaker.add(frame)
        wait_for(speaker, lambda latest: latest.frames >= 48)
        for _ in range(60):
            speaker.add(np.full((4, 3), np.nan))
        time.sleep(0.1)
        assert speaker.latest.frames >= FEWEST_FRAMES
    finally:
        speaker.close()


def test_closing_ends_the_thread_at_once_and_may_be_repeated(at_coils):
    speaker = BackgroundSpeaker(at_coils, Energy(), window_s=1.0, rate_hz=50.0)
    speaker.close()
    speaker.close()
    assert not speaker._thread.is_alive()


@pytest.mark.parametrize(
    ("window_s", "rate_hz", "message"),
    [(0.0, 250.0, "window is 0"), (float("nan"), 250.0, "window is nan"), (5.0, -1.0, "rate is -1"),
     (1e6, 250.0, "too long")],
)  # fmt: skip
def test_windows_and_rates_that_cannot_be_are_refused(at_coils, window_s, rate_hz, message):
    with pytest.raises(InputError, match=message):
        BackgroundSpeaker(at_coils, Energy(), window_s, rate_hz)
