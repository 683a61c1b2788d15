"""Practising in the wait for a frame: when it is done, and that nothing but time depends on it."""

import copy
import time

import numpy as np
import pytest

from tonguetrack.drivers import CoilFrame
from tonguetrack.drivers.devices.source import COLD_S, LONGEST_WAIT_S, PRACTICE_S, DeviceSource
from tonguetrack.drivers.frames import FrameOfReference
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.live import LiveRun, stream_info
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.preparation import Preparation
from tonguetrack.tracker.rehearsal import Rehearsal
from tonguetrack.tracker.session import Alignment, Session
from tonguetrack.tracker.setup import Setup
from tonguetrack.tracker.smoothing import smoothing_from_toml
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.streams.osc import OscSink

ROLES, VERTICES = ("tongue_tip", "tongue_blade", "tongue_dorsum"), (906, 1347, 1935)


class Punctual:
    """A device whose frames come when they are due: `period_s` apart by its own clock and by ours."""

    rate_hz = 0.0
    frame = FrameOfReference()
    coils = ROLES

    def __init__(self, positions, period_s, unasked=True):
        self.positions, self.period_s, self.unasked = positions, period_s, unasked
        self.number = 0
        self.due_s = time.perf_counter()

    def receive(self, timeout_s):
        left_s = self.due_s - time.perf_counter()
        if left_s > timeout_s:
            time.sleep(max(0.0, timeout_s))
            return None
        time.sleep(max(0.0, left_s))
        number = self.number
        self.number += 1
        self.due_s = time.perf_counter() + self.period_s
        positions = self.positions[number % len(self.positions)]
        return CoilFrame(positions, number * self.period_s, number, time.perf_counter_ns())

    def goodbye(self):
        pass


def practices(period_s, frames, unasked=True):
    """Frame numbers after which was practised."""
    device = Punctual(np.zeros((1, 3, 3)), period_s, unasked)
    source, seen = DeviceSource(lambda: device, "device"), []
    source.practise = lambda: seen.append(device.number)
    for _ in range(frames):
        next(source)
    return seen


def test_it_is_practised_once_in_each_wait_once_the_period_is_known():
    seen = practices(0.02, 30)
    assert len(set(seen)) == len(seen)
    # A busy machine may wake us too late for one or the other.
    assert len(seen) >= 15 and max(seen) < 30


@pytest.mark.parametrize("period_s", [COLD_S * 0.9, LONGEST_WAIT_S * 1.1])
def test_devices_that_are_too_fast_or_too_slow_are_not_practised_for(period_s):
    assert practices(period_s, 8) == []


def test_devices_that_are_asked_for_their_frames_are_not_practised_for():
    assert practices(0.02, 10, unasked=False) == []


def test_a_silent_device_is_practised_for_once():
    device = Punctual(np.zeros((1, 3, 3)), 0.01)
    source, seen = DeviceSource(lambda: device, "device"), []
    for _ in range(8):
        next(source)
    source.practise = lambda: seen.append(device.number)
    device.due_s = time.perf_counter() + 10.0
    next(source), next(source)  # two ticks of silence
    assert len(seen) == 1
    assert PRACTICE_S < COLD_S  # else there were no time to practise at all


# What is practised


@pytest.fixture(scope="module")
def model():
    return bundled_model()


def setup_of(model, fixed):
    smoothing = smoothing_from_toml({"live": {"all": "one-pole 80 Hz"}})
    preparation = Preparation(np.arange(3), Alignment(), ROLES, smoothing=smoothing)
    session = Session(speaker_weights=model.speaker.mean.copy() if fixed else None)
    return Setup(ROLES, ROLES, VERTICES, preparation, session, ())


def moving_coils(model):
    """(frames, 3, 3) coils of a tongue that moves, some missing."""
    random = np.random.default_rng(4)
    steps = random.normal(scale=0.4, size=(60, *(len(VERTICES), 3))).cumsum(axis=0)
    positions = model.mean_vertices()[list(VERTICES)] + steps
    positions[20:24, 1] = np.nan
    positions[40] = np.nan
    return positions


class Kept:
    """A sink that keeps what it was sent, and does more work with it than the others."""

    destination, sent, dropped = "here", 0, 0

    def __init__(self):
        self.poses = []

    def start(self, info):
        pass

    def change(self, info):
        pass

    def send(self, pose):
        self.poses.append(
            (pose.weights.copy(), pose.speaker_weights.copy(), pose.status, pose.coil_states.copy())
        )

    def close(self):
        pass


def run(model, fixed, practised):
    """Poses of 60 frames of a punctual device, the speaker fixed after 30 of them, and how often was practised."""
    setup = setup_of(model, fixed)
    tracker = Tracker(model, setup, 100.0, watchful=True, fix_after_s=0.3)
    source = DeviceSource(lambda: Punctual(moving_coils(model), 0.01), "device")
    kept, osc = Kept(), OscSink("127.0.0.1:9")
    info = stream_info(model, setup, 100.0)
    live = LiveRun(source, tracker, info, LiveStatus(ROLES, [kept, osc]), [osc, kept], seconds=0.6)
    count = [0]

    class Source:  # between the loop and the device: says how often was practised, or prevents it
        rate_hz = 100.0

        def __iter__(self):
            whole = source.practise
            assert whole is None, "the loop sets it on device sources alone"
            return iter(source)

        def stop(self):
            source.stop()

    if not practised:
        live.source = Source()
    else:
        original = Rehearsal.__call__

        def counted(self):
            count[0] += 1
            original(self)

        Rehearsal.__call__ = counted
    try:
        live.run()
    finally:
        osc.close()
        if practised:
            Rehearsal.__call__ = original
    return kept.poses, count[0]


@pytest.mark.parametrize("fixed", [True, False])
def test_poses_are_the_same_bits_with_and_without_practice(model, fixed):
    without, none = run(model, fixed, practised=False)
    with_it, count = run(model, fixed, practised=True)
    assert none == 0 and count > 20
    assert len(without) == len(with_it) == 60
    for one, other in zip(without, with_it, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
        assert one[2] == other[2]
        np.testing.assert_array_equal(one[3], other[3])


def test_a_twin_knows_nothing_of_its_tracker_and_changes_nothing_in_it(model):
    coils = moving_coils(model)
    frames = [CoilFrame(row, k * 0.01, k, 0) for k, row in enumerate(coils)]
    alone = Tracker(model, setup_of(model, True), 100.0, watchful=True)
    watched = Tracker(model, setup_of(model, True), 100.0, watchful=True)
    twin = watched.twin()
    for frame in frames:
        expected = copy.deepcopy(alone.step(frame))
        found = watched.step(frame)
        before = found.weights.copy()
        twin.step(CoilFrame(frame.positions + 5.0, frame.device_time_s, frame.frame_number, 0))
        np.testing.assert_array_equal(found.weights, before)
        np.testing.assert_array_equal(found.weights, expected.weights)


def test_a_rehearsed_datagram_is_not_sent_and_the_next_one_is_as_ever(model):
    setup = setup_of(model, True)
    tracker = Tracker(model, setup, 100.0)
    frame = CoilFrame(moving_coils(model)[0], 0.0, 7, time.perf_counter_ns())

    class Caught:
        def __init__(self):
            self.datagrams = []

        def sendto(self, data, peer):
            self.datagrams.append(bytes(data))

        def close(self):
            pass

    sink, caught = OscSink("127.0.0.1:9"), Caught()
    sink.close()
    sink._socket = caught
    sink.start(stream_info(model, setup, 100.0))
    pose = tracker.step(frame)
    told = len(caught.datagrams)
    sink.rehearse(pose)
    assert len(caught.datagrams) == told and sink.sent == 0
    sink.send(pose)
    sink.rehearse(pose)
    sink.send(pose)
    frames = [data for data in caught.datagrams[told:] if data[20:33] == b"/tongue/frame"]
    numbers = [int.from_bytes(data[44:48], "big") for data in frames]
    assert numbers == [0, 1]
