"""A replay delivers the recording's frames, at the recording's times."""

import itertools
import threading
import time

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import Recording, ReplaySource


def recording(frames=20, rate=200.0, start=1.0):
    positions = np.arange(frames * 6, dtype=float).reshape(frames, 2, 3)
    positions[3, 1] = np.nan
    return Recording(("tip", "mid"), positions, start + np.arange(frames) / rate, rate, "made")


def test_frames_arrive_in_order_with_their_own_times():
    take = recording()
    frames = list(ReplaySource(take, speed=None))
    assert [frame.frame_number for frame in frames] == list(range(20))
    assert [frame.device_time_s for frame in frames] == take.times_s.tolist()
    np.testing.assert_array_equal([frame.positions for frame in frames], take.positions)


def test_frames_are_read_only_views_of_the_recording():
    take = recording()
    frame = next(ReplaySource(take, speed=None))
    assert np.shares_memory(frame.positions, take.positions)
    with pytest.raises(ValueError, match="read-only"):
        frame.positions[0, 0] = 1.0
    take.positions[0, 0] = 1.0  # the recording itself stays writable


def test_pacing_is_by_absolute_deadlines():
    source = ReplaySource(recording(), speed=2.0)
    arrivals = []
    for frame in source:
        arrivals.append(frame.arrival_ns)
        time.sleep(0.001)  # a reader's own work must not shift the frames that follow
    due = (np.arange(20) / 400.0 * 1e9).astype(np.int64)
    late = np.array(arrivals) - arrivals[0] - due
    assert late.min() > -200_000
    # Shifted by the reader's millisecond a frame, the last ones would be 20 ms late; a busy machine delays some.
    assert late[10:].min() < 10_000_000
    assert (source.lateness_ns >= 0).all()


def test_a_slow_reader_gets_every_frame_without_waiting():
    source = ReplaySource(recording(), speed=1.0)
    next(source)
    time.sleep(0.12)
    begun = time.perf_counter()
    assert [frame.frame_number for frame in source] == list(range(1, 20))
    assert time.perf_counter() - begun < 0.05
    assert source.lateness_ns[1] > 100_000_000


def test_a_loop_goes_on_with_times_and_numbers():
    frames = list(itertools.islice(ReplaySource(recording(), speed=None, loop=True), 50))
    assert [frame.frame_number for frame in frames] == list(range(50))
    np.testing.assert_allclose([frame.device_time_s for frame in frames], 1.0 + np.arange(50) / 200)
    np.testing.assert_array_equal(frames[41].positions, frames[1].positions)


def test_closing_ends_a_waiting_reader():
    with ReplaySource(recording(rate=0.5), speed=1.0) as source:
        threading.Timer(0.05, source.close).start()
        begun = time.perf_counter()
        assert len(list(source)) == 1
        assert time.perf_counter() - begun < 0.5
    assert list(source) == []


def test_a_speed_that_is_none_is_refused():
    for speed in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="speed"):
            ReplaySource(recording(), speed=speed)
