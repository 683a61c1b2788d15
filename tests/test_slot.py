"""A slot between the loop and a sink that may wait: the newest pose wins, every loss is counted."""

import threading
import time

import numpy as np
import pytest

from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams.sink import StreamInfo
from tonguetrack.tracker.streams.slot import SlotSink

PATIENCE_S = 20.0


def info(rate_hz=250.0):
    four = np.zeros(4)
    return StreamInfo("model", "0" * 16, 60, four, four + 1, np.zeros(5), True, ("a", "b"), rate_hz)


def pose(number):
    return TrackedPose(
        np.full(4, float(number)),
        np.full(4, -float(number)),
        np.full(5, 2.0 * number),
        np.full(2, 0.5 * number),
        residual_mm=0.1 * number,
        valid_coils=2,
        status=PoseStatus.OK,
        frame_number=number,
        coil_states=np.full(2, number),
        coils=np.full((2, 3), float(number)),
    )


class Listener:
    """A worker that keeps what it gets; `gate` closed = it hangs; `fails` = how many times it still raises."""

    destination = "listener"

    def __init__(self, fails=0, begin_fails=0):
        self.gate = threading.Event()
        self.gate.set()
        self.fails, self.begin_fails = fails, begin_fails
        self.numbers, self.kept, self.infos, self.threads = [], [], [], set()
        self.working = threading.Event()
        self.ended = False

    def begin(self, told):
        if self.begin_fails:
            self.begin_fails -= 1
            raise OSError("nobody there")
        self.infos.append(told)

    def work(self, given):
        self.threads.add(threading.current_thread())
        self.working.set()
        assert self.gate.wait(PATIENCE_S)
        if self.fails:
            self.fails -= 1
            raise OSError("no route")
        self.numbers.append(given.frame_number)
        self.kept.append(given.copy())

    def end(self):
        self.ended = True


def until(condition):
    end_s = time.perf_counter() + PATIENCE_S
    while not condition():
        assert time.perf_counter() < end_s, "it did not happen in time"
        time.sleep(0.001)


def test_every_pose_arrives_whole_and_in_order_where_the_worker_keeps_up():
    worker = Listener()
    sink = SlotSink(worker)
    sink.start(info())
    for number in range(20):
        sink.send(pose(number))
        until(lambda number=number: sink.sent == number + 1)
    sink.close()
    assert worker.numbers == list(range(20))
    assert (sink.sent, sink.dropped, worker.ended) == (20, 0, True)
    for number, kept in enumerate(worker.kept):
        expected = pose(number)
        for name in TrackedPose.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(kept, name), getattr(expected, name), err_msg=name)


def test_the_worker_runs_in_a_thread_of_its_own():
    worker = Listener()
    sink = SlotSink(worker)
    sink.start(info())
    sink.send(pose(1))
    sink.close()
    assert worker.threads and threading.current_thread() not in worker.threads


def test_a_pose_that_the_tracker_writes_over_stays_as_it_was_for_the_worker():
    worker = Listener()
    sink = SlotSink(worker)
    worker.gate.clear()
    sink.start(info())
    trackers_own = pose(1)
    sink.send(trackers_own)
    assert worker.working.wait(PATIENCE_S)
    trackers_own.take(pose(7))
    worker.gate.set()
    until(lambda: sink.sent == 1)
    sink.close()
    assert worker.kept[0].weights.tolist() == [1.0] * 4


def test_a_stalled_worker_gets_the_newest_pose_afterwards_and_the_others_are_counted():
    worker = Listener()
    worker.gate.clear()
    sink = SlotSink(worker)
    sink.start(info())
    sink.send(pose(0))
    assert worker.working.wait(PATIENCE_S)
    for number in range(1, 1001):
        sink.send(pose(number))
    assert sink.dropped == 999
    worker.gate.set()
    until(lambda: sink.sent == 2)
    sink.close()
    assert worker.numbers == [0, 1000]


def test_where_more_may_wait_a_burst_is_handed_on_whole_and_in_order():
    worker = Listener()
    worker.gate.clear()
    sink = SlotSink(worker, waiting=8)
    sink.start(info())
    sink.send(pose(0))
    assert worker.working.wait(PATIENCE_S)
    for number in range(1, 9):
        sink.send(pose(number))
    worker.gate.set()
    until(lambda: sink.sent == 9)
    sink.close()
    assert worker.numbers == list(range(9)) and sink.dropped == 0


def test_where_more_may_wait_the_oldest_give_way_to_more_than_that():
    worker = Listener()
    worker.gate.clear()
    sink = SlotSink(worker, waiting=8)
    sink.start(info())
    sink.send(pose(0))
    assert worker.working.wait(PATIENCE_S)
    for number in range(1, 101):
        sink.send(pose(number))
        assert len(sink._free) + len(sink._newest) <= 10
    assert sink.dropped == 92
    worker.gate.set()
    until(lambda: sink.sent == 9)
    sink.close()
    assert worker.numbers == [0, *range(93, 101)]


def test_a_stalled_worker_costs_no_memory_however_long_it_stalls():
    worker = Listener()
    worker.gate.clear()
    sink = SlotSink(worker)
    sink.start(info())
    for number in range(2000):
        sink.send(pose(number))
        assert len(sink._free) + len(sink._newest) <= 3
    worker.gate.set()
    sink.close()


def test_with_a_rate_poses_in_between_are_left_out_and_are_no_loss():
    worker = Listener()
    sink = SlotSink(worker, rate_hz=50.0)
    sink.start(info())
    begin_s = time.perf_counter()
    number = 0
    while time.perf_counter() - begin_s < 0.5:
        sink.send(pose(number))
        number += 1
        time.sleep(0.002)
    sink.close()
    took_s = time.perf_counter() - begin_s
    assert 2 <= sink.sent <= 50.0 * took_s + 3
    assert worker.numbers == sorted(set(worker.numbers))
    assert worker.numbers[-1] == number - 1


def test_what_the_worker_cannot_hand_on_is_counted_told_once_and_forgotten_when_it_recovers():
    said = []
    worker = Listener(fails=3)
    sink = SlotSink(worker, said=said.append)
    sink.start(info())
    for number in range(3):
        sink.send(pose(number))
        until(lambda number=number: sink.dropped == number + 1)
    assert said == ["listener: no route"] == [sink.failure]
    sink.send(pose(3))
    until(lambda: sink.sent == 1)
    assert sink.failure == ""
    sink.close()


def test_a_worker_that_could_not_begin_is_begun_again():
    worker = Listener(begin_fails=1)
    sink = SlotSink(worker)
    sink.start(info())
    sink.send(pose(1))
    until(lambda: sink.sent == 1)
    assert len(worker.infos) == 1
    sink.close()


def test_a_change_of_the_info_reaches_the_worker_before_the_next_pose():
    worker = Listener()
    sink = SlotSink(worker)
    sink.start(info())
    sink.send(pose(1))
    until(lambda: sink.sent == 1)
    sink.change(info(400.0))
    until(lambda: len(worker.infos) == 2)
    assert worker.infos[-1].rate_hz == 400.0
    sink.close()


def test_a_change_while_a_worker_fails_to_begin_is_what_it_begins_with(monkeypatch):
    monkeypatch.setattr("tonguetrack.tracker.streams.slot.AGAIN_S", 0.01)
    worker = Listener()
    sink = SlotSink(worker)
    tried = []

    def begin(told):
        tried.append(told.rate_hz)
        if len(tried) == 1:
            sink.change(info(400.0))  # in the middle of the first try
            raise OSError("nobody there")

    worker.begin = begin
    sink.start(info())
    until(lambda: len(tried) == 2)
    sink.close()
    assert tried == [250.0, 400.0]


def test_a_change_while_a_worker_begins_is_told_as_well():
    worker = Listener()
    sink = SlotSink(worker)
    begun = worker.begin

    def begin(told):
        if not worker.infos:
            sink.change(info(400.0))
        begun(told)

    worker.begin = begin
    sink.start(info())
    until(lambda: len(worker.infos) == 2)
    sink.close()
    assert [told.rate_hz for told in worker.infos] == [250.0, 400.0]


@pytest.mark.parametrize("rate_hz", [None, 5.0])
def test_closing_hands_on_the_last_pose(rate_hz):
    worker = Listener()
    sink = SlotSink(worker, rate_hz)
    sink.start(info())
    sink.send(pose(1))
    until(lambda: sink.sent == 1)
    sink.send(pose(2))
    sink.close()
    assert worker.numbers[-1] == 2


@pytest.mark.parametrize("rate_hz", [0.01, 5e-324])
def test_closing_does_so_at_the_slowest_rate_as_well(rate_hz):
    worker = Listener()
    sink = SlotSink(worker, rate_hz)
    sink.start(info())
    until(lambda: worker.infos)
    time.sleep(0.05)  # it rests
    sink.send(pose(2))
    sink.close()
    assert worker.numbers == [2] and worker.ended


def test_a_worker_that_hangs_for_ever_does_not_keep_the_run_from_ending(monkeypatch):
    monkeypatch.setattr("tonguetrack.tracker.streams.slot.CLOSE_S", 0.05)
    worker = Listener()
    worker.gate.clear()
    sink = SlotSink(worker)
    sink.start(info())
    sink.send(pose(1))
    assert worker.working.wait(PATIENCE_S)
    sink.close()
    worker.gate.set()
