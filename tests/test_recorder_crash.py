"""What is left of a take when its process is killed, and when its disk is full."""

import json
import os
import random
import runpy
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers.xdf import read_xdf
from tonguetrack.tracker.takes.journal import journal_path, read_journal, read_journal_marks
from tonguetrack.tracker.takes.recorder import TakeRecorder

pytestmark = pytest.mark.skipif(os.name == "nt", reason="needs fork, FIFOs and SIGKILL")

CHILD = Path(__file__).with_name("recorder_child.py")
MADE = SimpleNamespace(**runpy.run_path(str(CHILD)))
STREAMS = ("raw", "prepared", "pose")


# Killed ---------------------------------------------------------------------------------------------


@dataclass
class Running:
    """A process that records. report: the reading end of its FIFO; last: the latest frame it had handed over."""

    take: Path
    report: int
    kill_at_s: float
    pid: int = 0
    last: int = 0
    rest: bytes = b""
    killed: bool = False


@contextmanager
def nursery() -> Iterator[subprocess.Popen]:
    """One prepared process whose children record."""
    process = subprocess.Popen([sys.executable, str(CHILD)], stdin=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.stdin.close()
        process.wait(20)


def start(process: subprocess.Popen, take: Path, rate_hz: float, disk: str) -> Running:
    fifo = take.with_suffix(".fifo")
    os.mkfifo(fifo)
    report = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    process.stdin.write(f"{take}\t{fifo}\t{rate_hz}\t{disk}\n")
    process.stdin.flush()
    return Running(take, report, float("inf"))


def kill_each(running: list[Running], delays_s: list[float]) -> None:
    """Kills every process that long after its first frame; returns when all are dead and their reports read."""
    end_s = time.monotonic() + 60.0
    open_reports = {child.report: (child, delay_s) for child, delay_s in zip(running, delays_s, strict=True)}
    while open_reports:
        assert time.monotonic() < end_s, "a process did not record or did not die"
        wake_s = min(child.kill_at_s for child, _ in open_reports.values()) - time.monotonic()
        readable, _, _ = select.select(list(open_reports), [], [], min(0.05, max(0.0, wake_s)))
        for child, _ in open_reports.values():
            if not child.killed and time.monotonic() >= child.kill_at_s:
                os.kill(child.pid, signal.SIGKILL)
                child.killed = True
        for report in readable:
            child, delay_s = open_reports[report]
            data = os.read(report, 1 << 16)
            if not data and child.killed:
                os.close(report)
                del open_reports[report]
                continue
            data = child.rest + data
            whole = len(data) // 8 * 8
            child.rest = data[whole:]
            said = struct.unpack(f"<{whole // 8}q", data[:whole])
            if said and child.pid == 0:
                child.pid, said = said[0], said[1:]
            if said and child.kill_at_s == float("inf"):
                child.kill_at_s = time.monotonic() + delay_s
            child.last = said[-1] if said else child.last


def assert_kept(
    take: Path, last: int, random_: random.Random, whole: bool = False, marks: bool = False
) -> int:
    """The take and its journal hold every frame up to `last`; returns how many the take has by itself.

    whole: the take ends with a whole chunk. marks: it has those that `recorder_child` sets.
    """
    file = read_xdf(take.read_bytes(), str(take))
    assert file.damage is None or (not whole and "cut off" in file.damage)
    streams = {stream.name: stream for stream in file.streams}
    journal = read_journal(journal_path(take), take)
    some = {1, last, *(random_.randint(1, last) for _ in range(30))}
    for name in STREAMS:
        count = streams[name].count
        rest = journal[journal["sequence"] > count]
        sequences = np.arange(1, max(last, count) + 1)
        assert np.array_equal(rest["sequence"], np.arange(count + 1, count + 1 + len(rest)))
        assert count + len(rest) >= last
        kept = np.concatenate([streams[name].values, rest[name]])
        stamps = np.concatenate([streams[name].stamps, rest["arrival_ns"] * 1e-9])
        assert np.array_equal(
            stamps[: len(sequences)], (1_000_000 * sequences + sequences % 977).astype(np.int64) * 1e-9
        )
        if name == "raw":
            assert np.array_equal(kept[: len(sequences), 1], 8.0 * sequences)
        for sequence in some:
            assert kept[sequence - 1].tobytes() == MADE.channels(sequence)[name].tobytes()
    if marks:
        texts = [text for (text,) in streams["markers"].texts]
        texts += [
            mark.text for mark in read_journal_marks(journal_path(take), take) if mark.number > len(texts)
        ]
        expected = [f"before {sequence}" for sequence in range(MADE.MARK_EVERY, last + 1, MADE.MARK_EVERY)]
        assert texts[: len(expected)] == expected
    return streams["raw"].count


def test_a_take_killed_at_any_of_fifty_moments_has_every_frame_that_was_handed_over(tmp_path):
    random_ = random.Random(11)
    by_itself, in_all = 0, 0
    with nursery() as process:
        for batch in range(25):
            takes = [tmp_path / f"{batch}-{i}.xdf" for i in range(2)]
            rates_hz = (2000.0, 0.0 if batch % 3 == 0 else 2000.0)
            running = [
                start(process, take, rate_hz, "good") for take, rate_hz in zip(takes, rates_hz, strict=True)
            ]
            kill_each(running, [random_.uniform(0.05, 0.5) for _ in running])
            for child in running:
                by_itself += assert_kept(child.take, child.last, random_, marks=True)
                in_all += child.last
                journal_path(child.take).unlink()
    assert 0 < by_itself < in_all  # both have been of use: the take and the journal


@pytest.mark.parametrize("disk", ["stuck", "slow"])
def test_a_process_killed_while_its_disk_hangs_loses_nothing_either(tmp_path, disk):
    random_ = random.Random(5)
    with nursery() as process:
        running = [start(process, tmp_path / f"{i}.xdf", 1000.0, disk) for i in range(2)]
        kill_each(running, [0.3, 0.7])
        for child in running:
            assert child.last > 10
            by_itself = assert_kept(child.take, child.last, random_, marks=True)
            assert by_itself == 0 or disk == "slow"


# Full -----------------------------------------------------------------------------------------------

LIMITED = """
import json, resource, runpy, sys, time
made = runpy.run_path(sys.argv[1])
recorder = made["TakeRecorder"](made["take_info"](), sys.argv[2])
recorder.open()
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))  # bytes; a write beyond them fails with EFBIG
sequence, end_s = 0, time.monotonic() + 20.0
while recorder.failure is None and time.monotonic() < end_s:
    sequence += 1
    made["put"](recorder, sequence)
    time.sleep(0.0005)
put_until = sequence
for sequence in range(put_until + 1, put_until + 101):
    made["put"](recorder, sequence)
summary = recorder.close()
print(json.dumps([summary.failure, summary.frames, summary.not_recorded, sequence]))
"""


def test_a_file_that_may_not_grow_ends_the_take_but_not_the_process(tmp_path):
    take = tmp_path / "take.xdf"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(CHILD), str(take)],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    failure, frames, not_recorded, put = json.loads(done.stdout)
    assert "may not grow" in failure
    assert not_recorded >= 100
    assert frames + not_recorded == put
    assert take.stat().st_size <= 300_000
    by_itself = assert_kept(take, frames, random.Random(1), whole=True)
    assert 0 < by_itself < frames


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A file system in memory with room for `size`."""
    mount, umount = shutil.which("mount"), shutil.which("umount")
    if not sys.platform.startswith("linux") or os.geteuid() != 0 or mount is None or umount is None:
        pytest.skip("a small disk can only be mounted by root on Linux")
    folder.mkdir()
    mounted = subprocess.run(
        [mount, "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)],
        check=False,
        capture_output=True,
        timeout=20,
    )
    if mounted.returncode != 0:
        pytest.skip("this system lets nobody mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run([umount, str(folder)], check=True, timeout=20)


def record_until_failure(recorder: TakeRecorder) -> int:
    sequence, end_s = 0, time.monotonic() + 20.0
    while recorder.failure is None:
        assert time.monotonic() < end_s, "the disk did not get full"
        sequence += 1
        MADE.put(recorder, sequence)
        time.sleep(0.0003)
    return sequence


def test_a_disk_that_fills_up_ends_the_take_at_once_and_keeps_what_is_on_it(tmp_path):
    with small_disk(tmp_path / "disk", "3m") as folder:
        take = folder / "take.xdf"
        recorder = TakeRecorder(MADE.take_info(10.0), take)
        recorder.open()
        put = record_until_failure(recorder)
        MADE.put(recorder, put + 1)
        assert "the disk is full" in recorder.failure
        summary = recorder.close()
        assert summary.frames + summary.not_recorded == put + 1
        assert summary.journal == journal_path(take)
        by_itself = assert_kept(take, summary.frames, random.Random(2), whole=True)
        assert by_itself > 100


def test_a_disk_that_others_fill_up_kills_nobody(tmp_path):
    """The journal has all its room from the beginning: a page without room would end the process by SIGBUS."""
    with small_disk(tmp_path / "disk", "3m") as folder:
        recorder = TakeRecorder(MADE.take_info(10.0), folder / "take.xdf")
        recorder.open()
        with pytest.raises(OSError), (folder / "others").open("wb", buffering=0) as others:
            while True:
                others.write(bytes(4096))
        put = record_until_failure(recorder)
        summary = recorder.close()
        assert summary.frames + summary.not_recorded == put
        assert_kept(folder / "take.xdf", summary.frames, random.Random(3), whole=True)


def test_a_disk_without_room_for_the_journal_is_refused_and_left_empty(tmp_path):
    with small_disk(tmp_path / "disk", "500k") as folder:
        with pytest.raises(InputError, match="the disk is full"):
            TakeRecorder(MADE.take_info(10.0), folder / "take.xdf").open()
        assert os.listdir(folder) == []
