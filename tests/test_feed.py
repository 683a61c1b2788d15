"""The feed: what one process writes, others see whole, or not at all; nothing they do reaches the writer."""

import json
import mmap
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from zlib import crc32

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams.feed import SLOTS, FeedAbout, FeedNumbers, FeedReader, FeedSink
from tonguetrack.tracker.streams.sink import LiveNumbers, StreamInfo

PATIENCE_S = 20.0
K, M, N = 4, 5, 3
ABOUT = FeedAbout(
    model="bundled",
    session='model = "0123456789abcdef"\n[coils]\n"Zünge" = "tongue_tip"\n',
    roles=("tip", "blade", "dorsum"),
    correspondences=(5, 9, 30),
    coefficients=K,
    speaker_weights=M,
    control="127.0.0.1:9001",
    title="a test",
    rate_hz=250.0,
)
INFO = StreamInfo("model", "0" * 16, 60, np.zeros(K), np.ones(K), np.zeros(M), True, ABOUT.roles, 250.0)


def pose(number):
    """Every number in it follows from `number`, so that parts of two poses never look like one."""
    x = float(number)
    return TrackedPose(
        np.full(K, x), np.full(K, -x), np.full(M, x + 0.5), np.full(N, x + 0.25), x + 0.125, x + 0.75, 3, PoseStatus.OK,
        x / 250.0, number, 10 * number, 10 * number + 1, number % 2 == 0, np.full(N, number % 6), np.full((N, 3), 2 * x),
    )  # fmt: skip


@pytest.fixture
def sink(tmp_path):
    made = FeedSink(tmp_path, ABOUT)
    yield made
    made.close()


def assert_same(found, expected):
    for name in TrackedPose.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


def until(condition):
    end_s = time.perf_counter() + PATIENCE_S
    while not condition():
        assert time.perf_counter() < end_s, "it did not happen in time"
        time.sleep(0.005)


# What is read is what was written ---------------------------------------------------------------------


def test_a_reader_is_told_what_the_run_is_before_the_first_pose(sink, tmp_path):
    with FeedReader(tmp_path) as feed:
        assert feed.about == ABOUT
        assert feed.about.pid == os.getpid()
        assert feed.newest() is None
        assert feed.since(0) == []
        assert feed.numbers == FeedNumbers()
        assert not feed.over


def test_the_newest_pose_comes_back_to_the_last_bit(sink, tmp_path):
    given = pose(7)
    given.residuals_mm[1] = given.coils[1, 2] = np.nan
    given.residual_mm, given.energy, given.status = float("nan"), float("nan"), PoseStatus.HELD
    sink.send(pose(6))
    sink.send(given)
    with FeedReader(tmp_path) as feed:
        sequence, found = feed.newest()
    assert sequence == sink.sent == 2
    assert_same(found, given)
    assert found.coils.shape == (N, 3) and found.coil_states.dtype == np.int64


def test_what_a_reader_got_stays_as_it_is(sink, tmp_path):
    with FeedReader(tmp_path) as feed:
        sink.send(pose(1))
        _, kept = feed.newest()
        for number in range(2, 2 * SLOTS):
            sink.send(pose(number))
        assert_same(kept, pose(1))


def test_a_reader_gets_every_pose_since_the_last_one_it_saw(sink, tmp_path):
    with FeedReader(tmp_path) as feed:
        for number in range(1, 11):
            sink.send(pose(number))
        assert [sequence for sequence, _ in feed.since(0)] == list(range(1, 11))
        assert [found.frame_number for _, found in feed.since(7)] == [8, 9, 10]
        assert feed.since(10) == []


def test_a_slow_reader_gets_what_the_ring_still_has(sink, tmp_path):
    with FeedReader(tmp_path) as feed:
        for number in range(1, 3 * SLOTS + 6):
            sink.send(pose(number))
        found = feed.since(2)
    assert [sequence for sequence, _ in found] == list(range(2 * SLOTS + 6, 3 * SLOTS + 6))
    for sequence, each in found:
        assert_same(each, pose(sequence))


def test_once_a_second_the_run_says_how_it_is(sink, tmp_path):
    live = LiveNumbers((1.5, None), (0.25, 0.5), (0.0, 2.0), "takes/a_001.xdf", 17, "")
    told = FeedNumbers(live, ("tip missing", "source silent for 3 s"), "250 Hz ok  0.50 mm")
    sink.numbers = lambda: told
    with FeedReader(tmp_path) as feed:
        sink.start(INFO)
        until(lambda: feed.numbers == told)
        told = replace(told, troubles=())
        until(lambda: feed.numbers == told)


def test_endless_texts_are_cut_and_odd_names_are_no_obstacle(sink, tmp_path):
    live = LiveNumbers(take_path="x" * 10**5 + "/\udcff\U0001f445.xdf", take_failure="\0" * 10**5)
    sink.numbers = lambda: FeedNumbers(live, ("\1" * 10**5,) * 1000, "\x7f" * 10**6)
    with FeedReader(tmp_path) as feed:
        sink.start(INFO)
        until(lambda: feed.numbers.text)
        numbers = feed.numbers
    assert numbers.live.take_path.endswith("/?\U0001f445.xdf")
    assert len(numbers.live.take_path) == len(numbers.live.take_failure) == len(numbers.text) == 500
    assert len(numbers.troubles) == 20


def test_a_feed_without_coils_or_speaker_is_a_feed(tmp_path):
    sink = FeedSink(tmp_path, replace(ABOUT, roles=(), correspondences=(), speaker_weights=0))
    one = TrackedPose(np.arange(4.0), np.ones(4), np.zeros(0), np.zeros(0))
    sink.send(one)
    with FeedReader(tmp_path) as feed:
        assert_same(feed.newest()[1], one)
    sink.close()


def test_a_run_of_another_shape_is_refused_before_it_begins(sink):
    with pytest.raises(ValueError, match="was started with"):
        sink.start(replace(INFO, roles=("tip",)))


# The end ----------------------------------------------------------------------------------------------


def test_when_the_writer_closes_it_is_over_and_the_last_pose_stays(sink, tmp_path):
    with FeedReader(tmp_path) as feed:
        sink.send(pose(3))
        sink.close()
        assert feed.over
        assert feed.newest()[1].frame_number == 3


WRITER = """
import sys, time
from pathlib import Path
import numpy as np
from tonguetrack.tracker.pose import TrackedPose
from tonguetrack.tracker.streams.feed import FeedAbout, FeedSink
sink = FeedSink(Path(sys.argv[1]), FeedAbout("bundled", "", ("a", "b"), (1, 2), 4, 5))
pose = TrackedPose(np.zeros(4), np.zeros(4), np.zeros(5), np.zeros(2), coil_states=np.zeros(2, np.int64),
                   coils=np.zeros((2, 3)))
print("there", flush=True)
number = 0
while True:
    number += 1
    for array in (pose.weights, pose.normalised, pose.speaker_weights, pose.residuals_mm, pose.coils, pose.coil_states):
        array[...] = number
    pose.frame_number, pose.device_time_s = number, float(number)
    sink.send(pose)
"""


@pytest.fixture
def writer(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "there\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_pose_is_seen_whole_or_not_at_all_however_fast_another_process_writes(writer, tmp_path):
    """Written without a pause the whole ring is new every few milliseconds: far faster than any device."""
    seen, end_s = 0, time.perf_counter() + 1.5
    with FeedReader(tmp_path) as feed:
        until(feed.newest)
        while time.perf_counter() < end_s:
            poses, newest = feed.since(seen)[:50], feed.newest()
            for sequence, found in [*poses, newest] if newest else poses:
                values = np.concatenate(
                    [found.weights, found.normalised, found.speaker_weights, found.residuals_mm, found.coils.ravel()]
                )  # fmt: skip
                assert (values == sequence).all() and (found.coil_states == sequence).all()
                assert found.frame_number == sequence == found.device_time_s
                assert sequence >= seen
                seen = sequence
    assert seen > 2 * SLOTS


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_writer_that_was_killed_is_over(writer, tmp_path):
    with FeedReader(tmp_path) as feed:
        until(lambda: feed.newest())
        assert not feed.over
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        assert feed.over


READER = """
import sys, time
from tonguetrack.tracker.streams.feed import FeedReader
with FeedReader(sys.argv[1]) as feed:
    print("reading", flush=True)
    while not feed.over:
        time.sleep(0.02)
    print("over", flush=True)
"""

# Starts its own reader, as the tracker starts the window and the page; the reader keeps our stdout.
PARENT = f"""
import subprocess
subprocess.Popen([sys.executable, "-c", {READER!r}, sys.argv[1]])
time.sleep(60)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there, nobody gets another parent")
def test_a_child_of_a_writer_that_was_killed_and_is_waited_for_by_nobody_is_not_left_behind(tmp_path):
    """Its number is still taken then: by what is left of it, or by another process."""
    source = WRITER.split("number = 0")[0] + PARENT
    writer = subprocess.Popen(
        [sys.executable, "-c", source, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert [writer.stdout.readline() for _ in range(2)] == ["there\n", "reading\n"]
        writer.kill()
        os.waitid(os.P_PID, writer.pid, os.WEXITED | os.WNOWAIT)  # dead, and not waited for
        said = []
        told = threading.Thread(target=lambda: said.append(writer.stdout.readline()), daemon=True)
        told.start()
        told.join(PATIENCE_S)
        assert said == ["over\n"]
    finally:
        writer.kill()
        writer.wait()
        writer.stdout.close()


# Readers and the writer ---------------------------------------------------------------------------------


def test_a_reader_cannot_write(sink, tmp_path):
    with FeedReader(tmp_path) as feed, pytest.raises(TypeError):
        feed._map[200] = 1
    assert (tmp_path / "feed").stat().st_mode & 0o777 == 0o400


def test_readers_that_come_and_go_and_crash_change_nothing_for_the_writer(sink, tmp_path):
    over = threading.Event()
    opened = []

    def read():
        while not over.is_set():
            feed = FeedReader(tmp_path)
            feed.since(0)
            opened.append(feed if len(opened) < 50 else feed.close())  # never closed: as good as a crash

    threads = [threading.Thread(target=read) for _ in range(3)]
    for thread in threads:
        thread.start()
    until(lambda: len(opened) > 5)
    for number in range(1, 3000):
        sink.send(pose(number))
    over.set()
    for thread in threads:
        thread.join()
    assert (sink.sent, sink.dropped) == (2999, 0)
    with FeedReader(tmp_path) as feed:
        assert_same(feed.newest()[1], pose(2999))


# Foreign and damaged files -------------------------------------------------------------------------------


def golden(number):
    """One slot as the module's description has it, put together by hand."""
    given = pose(number)
    body = struct.pack("<Qddd", 1, given.device_time_s, given.residual_mm, given.energy)
    body += struct.pack("<qqqiiii", number, 10 * number, 10 * number + 1, 1, 3, number % 2 == 0, 0)
    for values in (
        given.weights,
        given.normalised,
        given.speaker_weights,
        given.residuals_mm,
        given.coils.ravel(),
    ):
        body += struct.pack(f"<{len(values)}d", *values)
    body += struct.pack("<3q", *[number % 6] * 3)
    return body + struct.pack("<II", crc32(body), 0)


def test_the_file_is_as_its_description_says(sink, tmp_path):
    sink.send(pose(7))
    content = (tmp_path / "feed").read_bytes()
    slot = golden(7)
    assert content[:36] == b"TTFEED\0\0" + struct.pack("<7I", 1, K, M, N, 512, len(slot), 65536)
    assert content[64:80] == struct.pack("<QQ", 1, 0)
    first = 128 + 65536
    assert content[first + len(slot) : first + 2 * len(slot)] == slot
    assert len(content) == first + 512 * len(slot)
    about = json.loads((tmp_path / "about.json").read_text())
    assert (about["format"], about["version"], about["roles"]) == ("tonguetrack feed", 1, list(ABOUT.roles))


@contextmanager
def scribbled_on(folder):
    (folder / "feed").chmod(0o600)
    with open(folder / "feed", "r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        yield content


def test_a_pose_whose_bytes_were_damaged_is_not_believed(sink, tmp_path):
    sink.send(pose(7))
    with scribbled_on(tmp_path) as content, FeedReader(tmp_path) as feed:
        place = content.find(struct.pack("<d", 7.5))  # a speaker weight
        content[place] ^= 1
        assert feed.newest() is None
        content[place] ^= 1
        assert feed.newest()[0] == 1


@pytest.mark.parametrize("wrong", [2**63, 2**64 - 1, 513, 2])
def test_a_newest_pose_that_cannot_be_is_none(sink, tmp_path, wrong):
    sink.send(pose(7))
    with scribbled_on(tmp_path) as content, FeedReader(tmp_path) as feed:
        content[64:72] = struct.pack("<Q", wrong)
        assert feed.newest() is None
        assert [sequence for sequence, _ in feed.since(0)] in ([], [1])


def test_numbers_that_were_damaged_are_not_believed(sink, tmp_path):
    with scribbled_on(tmp_path) as content, FeedReader(tmp_path) as feed:
        content[128:144] = struct.pack("<QII", 1, 2**32 - 1, 0)
        assert feed.numbers == FeedNumbers()
        content[128:144] = struct.pack("<QII", 1, 10, 12345)
        assert feed.numbers == FeedNumbers()


def _about(change):
    def damage(folder):
        path = folder / "about.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return damage


def _feed(change):
    def damage(folder):
        content = bytearray((folder / "feed").read_bytes())
        (folder / "feed").write_bytes(change(content))

    return damage


DAMAGES = {
    "no folder": lambda folder: [file.unlink() for file in folder.iterdir()],
    "no feed": lambda folder: (folder / "feed").unlink(),
    "an empty feed": _feed(lambda content: b""),
    "a short feed": _feed(lambda content: content[:-1]),
    "a long feed": _feed(lambda content: content + b"\0"),
    "another magic": _feed(lambda content: b"TTFOOD" + content[6:]),
    "another version of the feed": _feed(lambda content: content[:8] + b"\2" + content[9:]),
    "other slots": _feed(lambda content: content[:24] + b"\1" + content[25:]),
    "about: no JSON": lambda folder: (folder / "about.json").write_bytes(b"\xff{"),
    "about: nested endlessly": lambda folder: (folder / "about.json").write_bytes(b"[" * 10**5),
    "about: another JSON": lambda folder: (folder / "about.json").write_text("[1, 2]"),
    "about: too long": lambda folder: (folder / "about.json").write_bytes(b" " * (5 * 2**20)),
    "about: another format": _about(lambda content: content.update(format="soup")),
    "about: another version": _about(lambda content: content.update(version=2)),
    "about: a key is missing": _about(lambda content: content.pop("session")),
    "about: roles are no list": _about(lambda content: content.update(roles="tip")),
    "about: roles of numbers": _about(lambda content: content.update(roles=[1, 2, 3])),
    "about: a vertex is true": _about(lambda content: content.update(correspondences=[True, 1, 2])),
    "about: another K": _about(lambda content: content.update(coefficients=5)),
    "about: a huge K": _about(lambda content: content.update(coefficients=10**12)),
    "about: a negative K": _about(lambda content: content.update(coefficients=-1)),
    "about: a fraction of weights": _about(lambda content: content.update(speaker_weights=5.0)),
    "about: a rate as text": _about(lambda content: content.update(rate_hz="fast")),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_foreign_or_damaged_feed_is_refused_in_one_sentence(sink, tmp_path, damage):
    copied = tmp_path / "copy"
    copied.mkdir()
    for name in ("about.json", "feed"):  # the writer's own cannot be made shorter under its hands
        (copied / name).write_bytes((tmp_path / name).read_bytes())
    damage(copied)
    with pytest.raises(InputError) as refusal:
        FeedReader(copied)
    assert str(copied) in str(refusal.value)
    assert str(refusal.value).endswith(".") and "\n" not in str(refusal.value)


def test_a_feed_is_not_made_where_one_is_already(sink, tmp_path):
    with pytest.raises(InputError, match="the feed cannot be made"):
        FeedSink(tmp_path, ABOUT)
