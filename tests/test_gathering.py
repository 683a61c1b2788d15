"""The first seconds of a device: enough is heard whatever its clock does, and a mute device does not keep us."""

import itertools
from dataclasses import dataclass, field

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, FrameOfReference, NoteKind, SourceNote
from tonguetrack.tracker import gathering
from tonguetrack.tracker.gathering import gather


@dataclass
class Device:
    """A source of given items."""

    items: object
    rate_hz: float = 0.0
    address: str = "device:"
    coils: tuple[str, ...] = ("tip", "mid")
    frame: FrameOfReference = field(default_factory=FrameOfReference)

    def __iter__(self):
        return iter(self.items)

    def stop(self):
        pass

    def close(self):
        pass


def frames(times_s, arrivals_s=None):
    arrivals_s = times_s if arrivals_s is None else arrivals_s
    return [
        CoilFrame(np.full((2, 3), float(k)), float(time_s), k, int(arrival_s * 1e9))
        for k, (time_s, arrival_s) in enumerate(zip(times_s, arrivals_s, strict=True))
    ]


SILENT = SourceNote(NoteKind.SILENT, "silent", 0)
STEADY_S = np.arange(1000) / 100.0


def test_as_many_seconds_as_were_asked_for_are_read():
    found = gather(Device(frames(STEADY_S)), 3.0)
    assert found.frame_count == 301
    assert found.rate_hz == pytest.approx(100.0)
    np.testing.assert_array_equal(found.positions[:, 0, 0], np.arange(301))


@pytest.mark.parametrize("jump_s", [-2.0, -1e6, 50.0, 1e6])
def test_a_clock_that_jumps_loses_nothing_that_was_heard(jump_s):
    times = np.where(np.arange(1000) < 150, STEADY_S, STEADY_S + jump_s)
    found = gather(Device(frames(times, STEADY_S)), 3.0)
    assert found.frame_count == pytest.approx(301, abs=1)
    assert found.rate_hz == pytest.approx(100.0, rel=0.01)
    assert (np.diff(found.times_s) > 0).all()


def test_where_the_clock_stands_still_the_arrivals_tell_the_time():
    bursts = STEADY_S - STEADY_S % 0.05
    found = gather(Device(frames(np.zeros(1000), bursts)), 3.0)
    assert found.frame_count == pytest.approx(301, abs=5)
    assert found.rate_hz == pytest.approx(100.0, rel=0.02)
    assert (np.diff(found.times_s) > 0).all()


def test_a_device_that_falls_silent_is_not_waited_for_for_ever(monkeypatch):
    host_s = itertools.count(0.0, 0.1)
    monkeypatch.setattr(gathering.time, "perf_counter", lambda: next(host_s))
    found = gather(Device(itertools.chain(frames(STEADY_S[:50]), itertools.repeat(SILENT))), 3.0)
    assert found.frame_count == 50


def test_a_mute_device_is_refused_in_words(monkeypatch):
    host_s = itertools.count(0.0, 0.1)
    monkeypatch.setattr(gathering.time, "perf_counter", lambda: next(host_s))
    with pytest.raises(InputError, match="is it measuring"):
        gather(Device(itertools.repeat(SILENT)), 3.0)


def test_a_source_that_ends_before_its_first_frame_is_refused_in_words():
    with pytest.raises(InputError, match="ended before its first frame"):
        gather(Device([SILENT]), 3.0)


def test_what_the_source_says_is_passed_on_but_not_every_tick_of_its_silence():
    told = []
    lost = SourceNote(NoteKind.DISCONNECTED, "the line is cut", 0)
    gather(Device([SILENT, lost, SILENT, *frames(STEADY_S)]), 1.0, told.append)
    assert told == ["the line is cut"]
