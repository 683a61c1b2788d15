"""The recorder of takes and its journal: nothing changed, nothing left out, nothing overwritten."""

import errno
import os
import runpy
import threading
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers.xdf import BOUNDARY_UUID, read_xdf
from tonguetrack.tracker.takes import recorder as recorder_module
from tonguetrack.tracker.takes.journal import (
    SLOTS_AT,
    Journal,
    journal_path,
    read_journal,
    read_journal_marks,
)
from tonguetrack.tracker.takes.marklog import Mark, MarkLog, read_log
from tonguetrack.tracker.takes.recorder import TakeRecorder
from tonguetrack.tracker.takes.rows import Row

MADE = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("recorder_child.py"))))
SLOW_RATE_HZ = 10.0  # gives the smallest journal
STREAMS = ("raw", "prepared", "pose")


def wait_until(condition, what: str) -> None:
    """Bounded, and long only where something is wrong."""
    end_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end_s, f"{what} did not happen"
        time.sleep(0.005)


def put_all(recorder, first: int, last: int, parts: bool = True) -> None:
    for sequence in range(first, last + 1):
        MADE.put(recorder, sequence, parts)


def put_now(recorder, first, last) -> None:
    """As `put_all`, but the frames arrive now rather than by a clock of their own."""
    for sequence in range(first, last + 1):
        frame = replace(MADE.coil_frame(sequence), arrival_ns=time.perf_counter_ns())
        recorder.put(frame, MADE.prepared_coils(sequence), MADE.tracked_pose(sequence))


def opened(path: Path, rate_hz: float = SLOW_RATE_HZ, parts: bool = True, **disk) -> TakeRecorder:
    recorder = TakeRecorder(MADE.take_info(rate_hz, parts), path, **disk)
    recorder.open()
    return recorder


def streams_of(path: Path) -> dict:
    file = read_xdf(path.read_bytes(), str(path))
    assert file.damage is None
    return {stream.name: stream for stream in file.streams}


def assert_holds(path: Path, last: int, parts: bool = True) -> None:
    """The take has the frames 1 to `last`, in order, to the last bit."""
    streams = streams_of(path)
    stamps = np.array([MADE.coil_frame(i).arrival_ns for i in range(1, last + 1)], np.int64) * 1e-9
    for name in STREAMS:
        expected = np.array([MADE.channels(i, parts)[name] for i in range(1, last + 1)])
        assert streams[name].values.tobytes() == expected.tobytes()
        assert np.array_equal(streams[name].stamps, stamps)


class Disk:
    """Stands between the recorder and the file. Whatever is done is kept in `events`.

    After `start_failing`, half of a piece is written and then the error raised, as when a disk fills up.
    """

    def __init__(self) -> None:
        self.events: list[str] = []
        self.error = 0
        self.most_bytes = 1 << 30
        self.writing, self.flushing = threading.Event(), threading.Event()
        self.writing.set()
        self.flushing.set()

    def write(self, handle: int, data: memoryview) -> int:
        assert self.writing.wait(20.0)
        if self.error == 1:
            raise RuntimeError("a mistake of ours")
        if self.error and self.events and self.events[-1] == "half":
            raise OSError(self.error, os.strerror(self.error))
        self.events.append("half" if self.error else "write")
        return os.write(handle, data[: len(data) // 2 if self.error else self.most_bytes])

    def sync(self, handle: int) -> None:
        assert self.flushing.wait(20.0)
        os.fsync(handle)
        self.events.append("flush")


def test_a_take_holds_every_frame_to_the_last_bit_with_equal_stamps_in_all_streams(tmp_path):
    recorder = opened(tmp_path / "take.xdf")
    put_all(recorder, 1, 700)
    summary = recorder.close()
    assert (summary.frames, summary.not_recorded, summary.failure, summary.journal) == (700, 0, None, None)
    assert summary.bytes_written == (tmp_path / "take.xdf").stat().st_size
    assert_holds(tmp_path / "take.xdf", 700)


def test_the_footers_tell_first_and_last_stamp_and_the_number_of_samples(tmp_path):
    recorder = opened(tmp_path / "take.xdf")
    put_all(recorder, 1, 300)
    recorder.mark("one", 5_000_000_000)
    recorder.mark("two", 6_000_000_000)
    recorder.close()
    streams = streams_of(tmp_path / "take.xdf")
    for name in STREAMS:
        footer = streams[name].footer
        assert (footer.count, footer.first, footer.last) == (
            300,
            streams[name].stamps[0],
            streams[name].stamps[-1],
        )
    footer = streams["markers"].footer
    assert (footer.count, footer.first, footer.last) == (2, 5.0, 6.0)


def test_pyxdf_reads_the_same_numbers_and_marks(tmp_path):
    pyxdf = pytest.importorskip("pyxdf")
    recorder = opened(tmp_path / "take.xdf")
    put_all(recorder, 1, 300)
    recorder.mark("swallow, then 'ä' & <b>", 123_456_789_000)
    recorder.close()
    streams, _ = pyxdf.load_xdf(
        str(tmp_path / "take.xdf"), synchronize_clocks=False, dejitter_timestamps=False
    )
    by_name = {stream["info"]["name"][0]: stream for stream in streams}
    stamps = np.array([MADE.coil_frame(i).arrival_ns for i in range(1, 301)], np.int64) * 1e-9
    for name in STREAMS:
        expected = np.array([MADE.channels(i)[name] for i in range(1, 301)])
        assert by_name[name]["time_series"].tobytes() == expected.tobytes()
        assert np.array_equal(by_name[name]["time_stamps"], stamps)
    assert by_name["markers"]["time_series"] == [["swallow, then 'ä' & <b>"]]
    assert by_name["markers"]["time_stamps"][0] == 123_456_789_000 * 1e-9


def test_a_device_without_quaternions_errors_and_status_has_no_channels_for_them(tmp_path):
    recorder = opened(tmp_path / "take.xdf", parts=False)
    put_all(recorder, 1, 40, parts=False)
    recorder.close()
    assert_holds(tmp_path / "take.xdf", 40, parts=False)


def test_what_a_frame_should_have_and_has_not_is_missing_in_the_take(tmp_path):
    recorder = opened(tmp_path / "take.xdf", parts=True)
    put_all(recorder, 1, 1, parts=True)
    put_all(recorder, 2, 2, parts=False)
    recorder.close()
    raw = streams_of(tmp_path / "take.xdf")["raw"].values
    without = MADE.channels(2, parts=False)["raw"]
    assert raw[1, : len(without)].tobytes() == without.tobytes()
    assert np.isnan(raw[1, len(without) :]).all()


def test_a_take_without_frames_is_whole(tmp_path):
    summary = opened(tmp_path / "take.xdf").close()
    assert (summary.frames, summary.failure) == (0, None)
    assert {name: stream.count for name, stream in streams_of(tmp_path / "take.xdf").items()} == {
        "raw": 0, "prepared": 0, "pose": 0, "markers": 0
    }  # fmt: skip


def test_marks_of_several_threads_are_all_there_each_threads_in_order(tmp_path):
    recorder = opened(tmp_path / "take.xdf")

    def mark(who: int) -> None:
        for i in range(50):
            recorder.mark(f"{who}:{i}", 1_000_000 * i)

    threads = [threading.Thread(target=mark, args=(who,)) for who in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert recorder.close().marks == 200
    texts = [text for (text,) in streams_of(tmp_path / "take.xdf")["markers"].texts]
    for who in range(4):
        assert [text for text in texts if text.startswith(f"{who}:")] == [f"{who}:{i}" for i in range(50)]


def test_a_mark_is_in_the_file_before_the_take_ends_even_without_frames(tmp_path):
    path = tmp_path / "take.xdf"
    recorder = opened(path)
    recorder.mark("now", 1)
    wait_until(lambda: b"now" in path.read_bytes()[-40:], "the mark's writing")
    recorder.close()


def test_marks_stand_in_the_journal_before_the_disk_has_taken_them(tmp_path):
    disk = Disk()
    path = tmp_path / "take.xdf"
    recorder = opened(path, write=disk.write)
    disk.writing.clear()
    recorder.mark("first", 1_000_000_000)
    recorder.mark("second \u00e4", 2_000_000_000)
    marks = read_journal_marks(journal_path(path), path)
    assert marks == [Mark(1, 1.0, "first"), Mark(2, 2.0, "second \u00e4")]
    disk.writing.set()
    recorder.close()
    assert streams_of(path)["markers"].texts == [("first",), ("second \u00e4",)]


def test_an_existing_file_is_refused_and_left_as_it_is(tmp_path):
    path = tmp_path / "take.xdf"
    path.write_bytes(b"precious")
    with pytest.raises(InputError, match="never overwritten"):
        opened(path)
    assert path.read_bytes() == b"precious"
    assert os.listdir(tmp_path) == ["take.xdf"]


def test_a_journal_that_is_still_there_is_refused_and_left_as_it_is(tmp_path):
    left = journal_path(tmp_path / "take.xdf")
    left.write_bytes(b"precious")
    with pytest.raises(InputError, match="journal of an earlier take"):
        opened(tmp_path / "take.xdf")
    assert os.listdir(tmp_path) == [left.name]
    assert left.read_bytes() == b"precious"


def test_a_folder_that_does_not_exist_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        opened(tmp_path / "nowhere" / "take.xdf")


def test_closing_again_changes_nothing_and_later_frames_are_counted(tmp_path):
    recorder = opened(tmp_path / "take.xdf")
    put_all(recorder, 1, 10)
    first = recorder.close()
    content = (tmp_path / "take.xdf").read_bytes()
    put_all(recorder, 11, 13)
    recorder.mark("too late", 0)
    second = recorder.close()
    assert (second.frames, second.not_recorded) == (10, 3)
    assert first.bytes_written == second.bytes_written
    assert (tmp_path / "take.xdf").read_bytes() == content
    assert os.listdir(tmp_path) == ["take.xdf"]


def test_a_frame_that_is_on_its_way_when_the_take_ends_is_still_in_it(tmp_path):
    recorder = opened(tmp_path / "take.xdf")
    frame = MADE.coil_frame(1)

    class Slow:
        def __array__(self, dtype=None, copy=None) -> np.ndarray:
            wait_until(lambda: recorder._closing, "the end")
            return frame.positions

    put = threading.Thread(
        target=recorder.put,
        args=(replace(frame, positions=Slow()), MADE.prepared_coils(1), MADE.tracked_pose(1)),
    )
    put.start()
    wait_until(lambda: recorder._putting, "the frame")
    assert (recorder.close().frames, recorder.not_recorded) == (1, 0)
    put.join()
    assert_holds(tmp_path / "take.xdf", 1)


def test_a_recorder_that_was_never_opened_closes_without_a_file(tmp_path):
    recorder = TakeRecorder(MADE.take_info(), tmp_path / "take.xdf")
    MADE.put(recorder, 1)
    assert (recorder.close().frames, recorder.not_recorded) == (0, 1)
    assert os.listdir(tmp_path) == []


def test_the_journal_lies_beside_the_take_until_the_take_is_whole(tmp_path):
    disk = Disk()
    recorder = opened(tmp_path / "take.xdf", write=disk.write, sync=disk.sync)
    put_all(recorder, 1, 20)
    rows = read_journal(journal_path(tmp_path / "take.xdf"), tmp_path / "take.xdf")
    assert rows["sequence"].tolist() == list(range(1, 21))
    recorder.close()
    assert disk.events[-1] == "flush"
    assert os.listdir(tmp_path) == ["take.xdf"]


def test_frames_that_the_journal_has_no_room_for_wait_in_memory_and_keep_their_order(tmp_path):
    disk = Disk()
    recorder = opened(tmp_path / "take.xdf", write=disk.write)
    disk.writing.clear()
    put_all(recorder, 1, 2600)  # the journal holds 1024
    assert (recorder.frames, recorder.backlog) == (2600, 2600)
    disk.writing.set()
    put_all(recorder, 2601, 3000)
    assert recorder.close().frames == 3000
    assert recorder.backlog == 0
    assert_holds(tmp_path / "take.xdf", 3000)


def test_a_flush_that_hangs_holds_up_neither_the_loop_nor_the_writer(tmp_path):
    disk = Disk()
    path = tmp_path / "take.xdf"
    recorder = opened(path, sync=disk.sync)
    disk.flushing.clear()
    put_now(recorder, 1, 500)
    wait_until(lambda: recorder.backlog == 0, "writing")
    behind_s = recorder.seconds_behind
    put_now(recorder, 501, 900)
    wait_until(lambda: recorder.backlog == 0, "writing")
    assert {streams_of(path)[name].count for name in STREAMS} == {900}
    assert recorder.seconds_behind > behind_s > 0.0
    disk.flushing.set()
    wait_until(lambda: recorder.seconds_behind == 0.0, "the flush")
    recorder.close()


def test_what_was_written_is_flushed_once_and_without_being_asked(tmp_path):
    disk = Disk()
    recorder = opened(tmp_path / "take.xdf", write=disk.write, sync=disk.sync)
    for first in (1, 101, 201):
        put_now(recorder, first, first + 99)
        wait_until(lambda: recorder.seconds_behind == 0.0, "the flush")
    before_close = list(disk.events)
    recorder.close()
    assert before_close[-1] == "flush"
    assert before_close.count("flush") >= 4  # the headers, and each of the three
    assert before_close.count("flush") <= 2 * before_close.count("write")  # none without something to flush
    assert recorder_module.WRITE_EVERY_S + recorder_module.FLUSH_EVERY_S <= 0.35


def test_a_disk_that_takes_a_few_bytes_at_a_time_gets_the_same_file(tmp_path):
    disk = Disk()
    disk.most_bytes = 1000
    recorder = opened(tmp_path / "take.xdf", write=disk.write)
    put_all(recorder, 1, 200)
    recorder.close()
    assert_holds(tmp_path / "take.xdf", 200)


@pytest.mark.parametrize(
    "error, words",
    [
        (errno.ENOSPC, "the disk is full"),
        (errno.EDQUOT, "quota"),
        (errno.EIO, "EIO"),
        (errno.EFBIG, "may not grow"),
        (errno.EBADMSG, "refuses"),
    ],
)
def test_a_disk_that_fails_is_told_at_once_and_what_was_written_stays_readable(tmp_path, error, words):
    disk = Disk()
    path = tmp_path / "take.xdf"
    recorder = opened(path, write=disk.write)
    put_all(recorder, 1, 150)
    wait_until(lambda: recorder.backlog == 0, "writing")
    disk.error = error
    put_all(recorder, 151, 160)
    wait_until(lambda: recorder.failure is not None, "the failure")
    put_all(recorder, 161, 180)
    assert words in recorder.failure
    assert str(path) in recorder.failure
    assert recorder.failure.count(". ") == 0
    summary = recorder.close()
    assert (summary.frames, summary.not_recorded, summary.failure) == (160, 20, recorder.failure)
    assert_holds(path, 150)  # the half chunk was cut off again
    assert summary.journal == journal_path(path)
    rows = read_journal(summary.journal, path)
    assert rows["sequence"].tolist() == list(range(1, 161))
    assert rows["raw"][-1].tobytes() == MADE.channels(160)["raw"].tobytes()


def test_frames_that_only_memory_held_when_the_disk_failed_count_as_not_recorded(tmp_path):
    disk = Disk()
    recorder = opened(tmp_path / "take.xdf", write=disk.write)
    disk.error = errno.ENOSPC
    disk.writing.clear()
    put_all(recorder, 1, 1100)
    disk.writing.set()
    wait_until(lambda: recorder.failure is not None, "the failure")
    put_all(recorder, 1101, 1105)
    summary = recorder.close()
    assert (summary.frames, summary.not_recorded) == (1024, 81)
    assert (recorder.frames, recorder.backlog) == (1024, 1024)
    assert read_journal(summary.journal)["sequence"].tolist() == list(range(1, 1025))


def test_a_flush_that_fails_ends_the_recording_with_a_sentence(tmp_path):
    disk = Disk()
    failing = threading.Event()

    def sync(handle: int) -> None:
        if failing.is_set():
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    recorder = opened(tmp_path / "take.xdf", write=disk.write, sync=sync)
    failing.set()
    put_all(recorder, 1, 10)
    wait_until(lambda: recorder.failure is not None, "the failure")
    assert "EIO" in recorder.failure
    assert recorder.close().journal is not None
    assert_holds(tmp_path / "take.xdf", 10)


def test_closing_gives_up_a_disk_that_takes_nothing_any_more(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "CLOSE_PATIENCE_S", 0.1)
    disk = Disk()
    path = tmp_path / "take.xdf"
    recorder = opened(path, write=disk.write)
    disk.writing.clear()
    put_all(recorder, 1, 30)
    summary = recorder.close()
    assert "has not answered" in summary.failure
    assert (summary.frames, summary.journal) == (30, journal_path(path))
    assert read_journal(summary.journal, path)["sequence"].tolist() == list(range(1, 31))
    disk.writing.set()
    recorder._writer.join(20.0)
    assert not recorder._writer.is_alive()


@pytest.mark.skipif(os.name == "nt", reason="an open file cannot be removed there")
def test_a_take_that_somebody_removes_while_it_is_recorded_is_told(tmp_path):
    recorder = opened(tmp_path / "take.xdf")
    (tmp_path / "take.xdf").unlink()
    put_all(recorder, 1, 10)
    wait_until(lambda: recorder.failure is not None, "the failure")
    assert "has been removed" in recorder.failure
    assert "readable" not in recorder.failure
    recorder.close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_even_a_mistake_of_ours_in_the_writers_thread_is_told(tmp_path):
    disk = Disk()
    recorder = opened(tmp_path / "take.xdf", write=disk.write)
    disk.error = 1
    put_all(recorder, 1, 10)
    wait_until(lambda: recorder.failure is not None, "the failure")
    put_all(recorder, 11, 12)
    summary = recorder.close()
    assert (summary.frames, summary.not_recorded) == (10, 2)
    assert len(read_journal(summary.journal)) == 10


def test_boundaries_stand_between_chunks_and_readers_pass_over_them(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "BOUNDARY_EVERY_S", 0.0)
    recorder = opened(tmp_path / "take.xdf")
    put_all(recorder, 1, 600)
    recorder.close()
    assert (tmp_path / "take.xdf").read_bytes().count(BOUNDARY_UUID) >= 3
    assert_holds(tmp_path / "take.xdf", 600)


def test_handing_over_a_frame_makes_no_array(tmp_path):
    """Python's own numbers and numpy's small views come and go; one copy of the row would be larger."""
    info = MADE.take_info()
    row = Row(info)
    journal = Journal.create(tmp_path / "journal", info.row_dtype(), 1024, b"")
    frame, coils, pose = MADE.coil_frame(1), MADE.prepared_coils(1), MADE.tracked_pose(1)
    tracemalloc.start()
    try:
        for sequence in range(1, 1001):
            if sequence == 500:
                tracemalloc.reset_peak()
                before = tracemalloc.get_traced_memory()[0]
            row.fill(sequence, frame, coils, pose)
            journal.store(sequence, row.slot)
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 200
    assert peak - before < row.slot.nbytes
    journal.remove()


# The journal ----------------------------------------------------------------------------------------


def journal_of(path: Path, last: int, slots: int = 8) -> Path:
    info = MADE.take_info()
    row = Row(info)
    journal = Journal.create(path, info.row_dtype(), slots, b"XDF: of a take")
    for sequence in range(1, last + 1):
        row.fill(
            sequence, MADE.coil_frame(sequence), MADE.prepared_coils(sequence), MADE.tracked_pose(sequence)
        )
        journal.store(sequence, row.slot)
    journal.release()
    return path


@pytest.mark.parametrize("last", [0, 1, 7, 8, 9, 20])
def test_a_journal_gives_its_latest_rows_in_order_and_to_the_last_bit(tmp_path, last):
    rows = read_journal(journal_of(tmp_path / "journal", last))
    assert rows["sequence"].tolist() == list(range(max(1, last - 7), last + 1))
    for row in rows:
        sequence = int(row["sequence"])
        assert row["arrival_ns"] == MADE.coil_frame(sequence).arrival_ns
        for name, expected in MADE.channels(sequence).items():
            assert row[name].tobytes() == expected.tobytes()


def test_a_journal_takes_all_its_room_from_the_disk_at_once(tmp_path):
    state = journal_of(tmp_path / "journal", 0, slots=1000).stat()
    assert state.st_size > 1_000_000
    assert getattr(state, "st_blocks", state.st_size) * 512 >= state.st_size


def test_a_system_that_cannot_take_room_beforehand_gets_zeros_written(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    path = journal_of(tmp_path / "journal", 3, slots=1000)
    assert read_journal(path)["sequence"].tolist() == [1, 2, 3]
    assert getattr(path.stat(), "st_blocks", path.stat().st_size) * 512 >= path.stat().st_size


def test_what_is_stored_in_a_released_journal_does_not_reach_the_file(tmp_path):
    info = MADE.take_info()
    journal = Journal.create(tmp_path / "journal", info.row_dtype(), 8, b"")
    row = Row(info)
    row.fill(5, MADE.coil_frame(5), MADE.prepared_coils(5), MADE.tracked_pose(5))
    journal.release()
    for sequence in range(1, 20):
        journal.store(sequence, row.slot)
    assert len(read_journal(tmp_path / "journal")) == 0


@given(data=st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_row_that_is_damaged_anywhere_is_left_out_and_the_others_stay(tmp_path, data):
    path = tmp_path / "journal"
    path.unlink(missing_ok=True)
    content = bytearray(journal_of(path, 12).read_bytes())
    size = (len(content) - SLOTS_AT) // 8
    slot, at = data.draw(st.integers(0, 7)), data.draw(st.integers(0, size - 1))
    content[SLOTS_AT + slot * size + at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    kept = [5 + (slot + 4) % 8]
    assert read_journal(path)["sequence"].tolist() == [i for i in range(5, 13) if i not in kept]


def test_rows_that_were_cut_short_by_the_next_ones_beginning_are_left_out(tmp_path):
    old = journal_of(tmp_path / "old", 12).read_bytes()
    new = journal_of(tmp_path / "new", 13).read_bytes()
    begin, size = SLOTS_AT + 4 * (len(old) - SLOTS_AT) // 8, (len(old) - SLOTS_AT) // 8
    for words in range(1, size // 8):
        cut = begin + 8 * words
        (tmp_path / "cut").write_bytes(old[:begin] + new[begin:cut] + old[cut:])
        assert 5 not in read_journal(tmp_path / "cut")["sequence"]
        assert 13 not in read_journal(tmp_path / "cut")["sequence"]


def test_a_journal_that_is_cut_off_gives_its_whole_rows(tmp_path):
    content = journal_of(tmp_path / "whole", 8).read_bytes()
    size = (len(content) - SLOTS_AT) // 8
    for end in (SLOTS_AT - 1, SLOTS_AT, SLOTS_AT + size - 1, SLOTS_AT + 3 * size, len(content) - 1):
        (tmp_path / "cut").write_bytes(content[:end])
        expected = max(0, end - SLOTS_AT) // size
        assert read_journal(tmp_path / "cut")["sequence"].tolist() == list(range(1, expected + 1))


def test_a_journal_is_believed_only_beside_its_own_take(tmp_path):
    journal = journal_of(tmp_path / "journal", 3)
    (tmp_path / "own.xdf").write_bytes(b"XDF: of a take and all that followed")
    (tmp_path / "other.xdf").write_bytes(b"XDF: of b take and all that followed")
    assert len(read_journal(journal, tmp_path / "own.xdf")) == 3
    with pytest.raises(InputError, match="another take"):
        read_journal(journal, tmp_path / "other.xdf")
    with pytest.raises(InputError, match="cannot be read"):
        read_journal(journal, tmp_path / "nowhere.xdf")
    with pytest.raises(InputError, match="cannot be read"):
        read_journal(tmp_path / "nothing")


@pytest.mark.parametrize("content", [b"", b"XDF:", b"ttkjrnl\n", b"\0" * 5000])
def test_a_foreign_file_is_no_journal(tmp_path, content):
    (tmp_path / "foreign").write_bytes(content)
    with pytest.raises(InputError, match="not the journal"):
        read_journal(tmp_path / "foreign")


@given(at=st.integers(0, 71), change=st.integers(1, 255))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_header_is_refused(tmp_path, at, change):
    path = tmp_path / "journal"
    path.unlink(missing_ok=True)
    content = bytearray(journal_of(path, 3).read_bytes())
    content[at] ^= change
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_journal(path)


def test_frames_keep_their_row_when_the_sources_arrays_are_written_over(tmp_path):
    recorder = opened(tmp_path / "take.xdf")
    frame = MADE.coil_frame(1)
    positions = frame.positions.copy()
    recorder.put(replace(frame, positions=positions), MADE.prepared_coils(1), MADE.tracked_pose(1))
    positions[:] = -1.0
    recorder.close()
    assert_holds(tmp_path / "take.xdf", 1)


# Its marks ------------------------------------------------------------------------------------------


def log_of(memory: bytearray, marks: list[Mark], written: int = 0) -> list[Mark]:
    log = MarkLog(memoryview(memory))
    for mark in marks:
        log.store(mark, written)
    return read_log(bytes(memory))


@given(texts=st.lists(st.text(max_size=40), max_size=30))
@settings(max_examples=200, deadline=None)
def test_a_log_gives_back_every_mark_in_order(texts):
    marks = [Mark(i + 1, i / 3.0, text) for i, text in enumerate(texts)]
    assert log_of(bytearray(10_000), marks) == marks


def test_a_log_that_is_full_begins_anew_once_the_file_has_all_its_marks():
    marks = [Mark(i, 0.0, "x" * 76) for i in range(1, 13)]  # 100 bytes each
    memory = bytearray(1000)
    assert log_of(memory, marks) == marks[:10]
    log = MarkLog(memoryview(memory))
    for mark in marks[:10]:
        log.store(mark, written=0)
    log.store(marks[10], written=9)
    assert read_log(bytes(memory)) == marks[:10]
    log.store(marks[10], written=10)
    log.store(marks[11], written=10)
    assert read_log(bytes(memory)) == marks[10:]


def test_a_mark_that_is_longer_than_the_log_is_left_to_the_file():
    marks = [Mark(1, 0.0, "a"), Mark(2, 0.0, "b" * 1000), Mark(3, 0.0, "c")]
    assert log_of(bytearray(1000), marks, written=2) == [marks[0], marks[2]]


@given(at=st.integers(0, 299), change=st.integers(1, 255))
@settings(max_examples=200, deadline=None)
def test_a_damaged_mark_ends_the_log_before_it(at, change):
    marks = [Mark(i, 0.0, "x" * 76) for i in (1, 2, 3)]
    memory = bytearray(1000)
    log_of(memory, marks)
    memory[at] ^= change
    assert read_log(bytes(memory)) == marks[: at // 100]


@given(data=st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_read_as_a_log_without_an_error(data):
    assert len(read_log(data)) <= len(data) // 24
