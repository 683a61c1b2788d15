"""The live loop: every frame tracked and sent in order, the truth about each, and nothing kept."""

import gc
import json
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, NoteKind, ReplaySource, SourceNote
from tonguetrack.model import save_model
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.live import run_live, stream_info, stream_recording
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.streams.monitor import decode
from tonguetrack.tracker.tracking import track_recording

RATE_HZ = 250.0


class Notes:
    """A sink that copies what it is given."""

    destination = "a list"
    dropped = 0

    def __init__(self):
        self.infos, self.weights, self.statuses, self.valid, self.numbers, self.speakers = (
            [],
            [],
            [],
            [],
            [],
            [],
        )

    @property
    def sent(self):
        return len(self.weights)

    def start(self, info):
        self.infos.append(info)

    def send(self, pose):
        self.weights.append(pose.weights.copy())
        self.speakers.append(pose.speaker_weights.copy())
        self.statuses.append(pose.status)
        self.valid.append(pose.valid_coils)
        self.numbers.append(pose.frame_number)

    def close(self):
        pass


class Frames:
    """A source of given frames."""

    rate_hz = RATE_HZ

    def __init__(self, frames):
        self._frames = iter(frames)
        self.closed = False

    def __iter__(self):
        return self

    def __next__(self):
        if self.closed:
            raise StopIteration
        return next(self._frames)

    def stop(self):
        self.closed = True

    close = stop


def numbered(recording, numbers):
    """Frames of a recording under other frame numbers."""
    return Frames(
        CoilFrame(recording.positions[k], recording.times_s[k], number, time.perf_counter_ns())
        for k, number in enumerate(numbers)
    )


def run(model, recording, setup, sinks=(), source=None, **options):
    source = source or ReplaySource(recording, speed=None)
    tracker = Tracker(model, setup)
    return run_live(source, tracker, stream_info(model, setup, RATE_HZ), sinks, **options)


@pytest.fixture(scope="module")
def take(small_model):
    return made_up_recording(small_model, 400, RATE_HZ)


def without_coils(recording, frames, coils=slice(None)):
    positions = recording.positions.copy()
    positions[frames, coils] = np.nan
    return replace(recording, positions=positions)


# The poses ------------------------------------------------------------------------------------------


def test_live_poses_are_the_poses_of_the_batch(small_model, take):
    recording, setup = take
    notes = Notes()
    run(small_model, without_coils(recording, slice(50, 60)), setup, [notes])
    batch = track_recording(
        without_coils(recording, slice(50, 60)), small_model, experiments=(2,), setup=setup
    ).experiment_2
    np.testing.assert_array_equal(np.array(notes.weights), batch.weights)
    np.testing.assert_array_equal(notes.statuses, batch.statuses)


def test_live_poses_with_a_free_speaker_are_those_of_the_batch(small_model, take):
    recording, setup = take
    free = replace(setup, session=replace(setup.session, speaker_weights=None))
    notes = Notes()
    summary = run(small_model, recording, free, [notes])
    batch = track_recording(recording, small_model, experiments=(1,), setup=free).experiment_1
    np.testing.assert_array_equal(np.array(notes.weights), batch.weights)
    np.testing.assert_array_equal(np.array(notes.speakers), batch.speaker_weights)
    assert not summary.speaker_fixed
    assert not notes.infos[0].speaker_fixed


def test_every_frame_reaches_every_sink_in_order(small_model, take):
    recording, setup = take
    first, second = Notes(), Notes()
    summary = run(small_model, recording, setup, [first, second])
    assert first.numbers == second.numbers == list(range(400))
    assert len(first.infos) == 1
    assert first.infos[0].roles == setup.roles
    assert summary.frames == summary.arrival_to_sent_ms["count"] == summary.solve_us["count"] == 400


def test_the_status_tells_the_truth_when_coils_vanish_and_come_back(small_model, take):
    recording, setup = take
    gone = without_coils(without_coils(recording, slice(0, 5)), slice(100, 120))
    notes = Notes()
    summary = run(small_model, gone, setup, [notes])
    statuses = np.array(notes.statuses)
    assert (statuses[:5] == PoseStatus.LOST).all()
    assert (statuses[100:120] == PoseStatus.HELD).all()
    assert (np.delete(statuses, [*range(5), *range(100, 120)]) == PoseStatus.OK).all()
    np.testing.assert_array_equal(notes.weights[0], small_model.pose.mean)
    for k in range(100, 120):
        np.testing.assert_array_equal(notes.weights[k], notes.weights[99])
    assert notes.valid[100:120] == [0] * 20
    assert summary.status_shares == pytest.approx(
        {"lost": 5 / 400, "ok": 375 / 400, "held": 20 / 400, "relaxing": 0}
    )
    assert summary.residual_mm["mean"] is not None


def test_a_single_missing_coil_is_counted_under_its_role(small_model, take):
    recording, setup = take
    summary = run(small_model, without_coils(recording, slice(0, 100), 1), setup)
    expected = dict.fromkeys(setup.roles, 1.0) | {setup.roles[1]: 0.75}
    assert summary.coils == pytest.approx(expected)
    assert summary.status_shares["ok"] == 1.0


def test_residuals_in_the_summary_are_those_of_the_frames(small_model, take):
    recording, setup = take
    summary = run(small_model, recording, setup)
    batch = track_recording(recording, small_model, experiments=(2,), setup=setup).experiment_2
    assert summary.residual_mm["mean"] == pytest.approx(batch.residual_mm.mean())
    assert summary.residual_mm["median"] == pytest.approx(np.median(batch.residual_mm), rel=0.02)


def test_without_any_frame_there_is_still_a_summary(small_model, take):
    _, setup = take
    summary = run(small_model, None, setup, [Notes()], Frames([]))
    assert summary.frames == 0
    json.dumps(summary.as_dict(), allow_nan=False)
    assert "no frame arrived" in str(summary)


def test_a_frame_with_too_few_coils_ends_the_run_in_words(small_model, take):
    _, setup = take
    short = CoilFrame(np.zeros((2, 3)), 0.0, 0, 0)
    with pytest.raises(InputError, match="a frame has 2 coils"):
        run(small_model, None, setup, (), Frames([short]))


# Gaps and ends --------------------------------------------------------------------------------------


def test_what_the_source_says_is_counted_and_no_frame_is_lost_over_it(small_model, take):
    recording, setup = take
    notes = Notes()
    frames = list(numbered(recording, [0, 1, 10]))

    def said(kind, count=0):
        return SourceNote(kind, kind.value, time.perf_counter_ns(), count)

    source = Frames(
        [frames[0], said(NoteKind.GAP, 3), frames[1], said(NoteKind.BAD_DATA, 2), said(NoteKind.CLOCK_RESET),
         said(NoteKind.DISCONNECTED), said(NoteKind.CONNECTED), said(NoteKind.GAP, 5), frames[2]]
    )  # fmt: skip
    summary = run(small_model, recording, setup, [notes], source)
    assert [number for number, status in zip(notes.numbers, notes.statuses) if status == PoseStatus.OK] == [
        0,
        1,
        10,
    ]
    assert len(notes.numbers) == 4, "the lost connection is shown by a pose of its own"
    assert (summary.frames, summary.gaps, summary.missing_frames) == (3, 2, 8)
    assert (summary.bad_data, summary.clock_resets, summary.disconnections) == (2, 1, 1)


def test_seconds_are_those_of_the_recording(small_model, take):
    recording, setup = take
    assert run(small_model, recording, setup, seconds=0.5).frames == 125


def test_closing_the_source_from_elsewhere_ends_the_run(small_model, take):
    recording, setup = take
    with ReplaySource(recording, speed=0.01) as source:
        timer = threading.Timer(0.2, source.close)
        timer.start()
        summary = run(small_model, recording, setup, (), source)
        timer.join()
    assert summary.frames < 400


def test_a_paced_replay_says_how_late_it_was(small_model, take):
    recording, setup = take
    summary = run(small_model, recording, setup, source=ReplaySource(recording, speed=50.0))
    assert summary.lateness_ms["count"] == 400
    assert run(small_model, recording, setup).lateness_ms is None


# Nothing kept, nothing left ---------------------------------------------------------------------------


class Blocks:
    """A sink that looks at the interpreter's memory now and then."""

    destination = "nowhere"
    sent = dropped = 0

    def __init__(self):
        self.blocks = []
        self._frames = 0

    def start(self, info):
        pass

    def send(self, pose):
        self._frames += 1
        if self._frames % 5000 == 0:
            self.blocks.append(sys.getallocatedblocks())

    def close(self):
        pass


@pytest.mark.parametrize("fixed", [True, False])
def test_twenty_thousand_frames_leave_nothing_behind(small_model, fixed):
    recording, setup = made_up_recording(small_model, 20_000, RATE_HZ)
    recording = without_coils(recording, slice(9000, 9100))
    if not fixed:
        setup = replace(setup, session=replace(setup.session, speaker_weights=None))
    blocks, waste = Blocks(), []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))  # it never reads
        from tonguetrack.tracker.streams.osc import OscSink

        sink = OscSink(f"127.0.0.1:{receiver.getsockname()[1]}")
        gc.collect()
        gc.callbacks.append(lambda phase, info: waste.append(phase))
        try:
            summary = run(small_model, recording, setup, [sink, blocks])
        finally:
            gc.callbacks.pop()
            sink.close()
    assert summary.frames == sink.sent + sink.dropped == 20_000
    assert len(waste) == 2, "one collection, before the first frame"
    # Counters outgrow small integers and then stay; one block a frame would be 15,000.
    assert blocks.blocks[-1] - blocks.blocks[0] < 100


def test_the_collector_sleeps_during_the_run_and_wakes_afterwards(small_model, take):
    recording, setup = take

    class Looks(Notes):
        def send(self, pose):
            assert not gc.isenabled()
            super().send(pose)

    assert gc.isenabled()
    looks = Looks()
    run(small_model, recording, setup, [looks])
    assert looks.sent == 400
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_is_as_it_was_even_after_an_error(small_model, take, enabled):
    recording, setup = take

    class Fails(Notes):
        def send(self, pose):
            raise KeyboardInterrupt

    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(KeyboardInterrupt):
            run(small_model, recording, setup, [Fails()])
        assert gc.isenabled() == enabled
        assert gc.get_freeze_count() == 0
    finally:
        gc.enable()


SIGNATURES = """
import sys
from dataclasses import replace
from tonguetrack.model import load_model
from tonguetrack.tracker import kernels
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.live import stream_recording

model = load_model(sys.argv[1])
recording, setup = made_up_recording(model, 50, 250.0)
free = replace(setup, session=replace(setup.session, speaker_weights=None))
for each in (setup, free):
    stream_recording(recording, model, each, "127.0.0.1:9", realtime=False)
for name, kernel in vars(kernels).items():
    if hasattr(kernel, "signatures"):
        print(name, len(kernel.signatures))
"""


def test_nothing_is_compiled_while_frames_arrive(small_model, tmp_path):
    save_model(small_model, tmp_path / "model.npz")
    command = [sys.executable, "-c", SIGNATURES, str(tmp_path / "model.npz")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    counts = {name: int(count) for name, count in map(str.split, printed.splitlines())}
    used = ("prepare_frame", "solve_fixed_speaker", "solve_free_speaker")
    assert [counts[name] for name in used] == [1, 1, 1]
    assert max(counts.values()) == 1


# A recording as a stream ------------------------------------------------------------------------------


def test_a_recording_is_streamed_with_one_call(small_model, take):
    recording, setup = take
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**20)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        destination = f"127.0.0.1:{receiver.getsockname()[1]}"
        summary = stream_recording(recording, small_model, setup, destination, realtime=False, seconds=0.2)
        datagrams = [dict(decode(receiver.recv(2048)))]
        while datagrams[-1].get("/tongue/frame", [0])[0] < 49:
            datagrams.append(dict(decode(receiver.recv(2048))))
    assert datagrams[0]["/tongue/info"][2:4] == ["random test model", small_model.fingerprint]
    frames = [datagram["/tongue/frame"][0] for datagram in datagrams if "/tongue/frame" in datagram]
    assert frames == list(range(50))
    assert [sink.destination for sink in summary.sinks] == [f"osc {destination}"]
    assert (summary.sinks[0].sent, summary.sinks[0].dropped) == (50, 0)


def test_a_recording_shorter_than_the_seconds_begins_again(small_model, take):
    recording, setup = take
    summary = stream_recording(recording, small_model, setup, "127.0.0.1:9", realtime=False, seconds=4.0)
    assert (summary.frames, summary.gaps) == (1000, 0)


def test_whoever_watches_sees_the_source_and_the_status(small_model, take):
    recording, setup = take
    seen = []

    @contextmanager
    def watch(source, status):
        seen.append((source.rate_hz, status.frames))
        yield
        seen.append((source.rate_hz, status.frames))

    stream_recording(recording, small_model, setup, "127.0.0.1:9", realtime=False, watch=watch)
    assert seen == [(250.0, 0), (250.0, 400)]


def test_a_wrong_destination_is_refused_before_anything_is_sent(small_model, take):
    recording, setup = take
    with pytest.raises(InputError, match="'nonsense': expected HOST:PORT"):
        stream_recording(recording, small_model, setup, "nonsense")


def test_the_summary_is_plain_json_without_nan(small_model, take):
    recording, setup = take
    gone = without_coils(recording, slice(None))
    for each in (recording, gone):
        summary = stream_recording(each, small_model, setup, "127.0.0.1:9", realtime=False)
        again = json.loads(json.dumps(summary.as_dict(), allow_nan=False))
        assert again["frames"] == 400
        assert str(summary)


def test_a_status_line_begins_with_what_matters_and_is_cut_between_its_parts(small_model, take):
    from tonguetrack.tracker.cli.watching import status_text, whole_parts

    recording, setup = take
    status = LiveStatus(setup.roles)
    run(small_model, recording, setup, status=status)
    status.take_path, status.take_frames = "take.xdf", 400
    line = status_text(status, 250.0)
    assert line.startswith("rec 400  250 Hz ok  ")
    for width in range(20, len(line) + 2):
        cut = whole_parts(line, width)
        assert len(cut) <= width and (line + "  ").startswith(cut + "  ")
    assert whole_parts(line, len(line)) == line
    assert whole_parts("[one long trouble]", 8) == "[one lon"
    status.take_failure = "the disk is full"
    assert status_text(status, 250.0).startswith("[NOT RECORDING: the disk is full] 250 Hz ok")


def test_the_status_can_be_read_while_it_is_written(small_model, take):
    from tonguetrack.tracker.cli.watching import status_text

    recording, setup = take
    status = LiveStatus(setup.roles)
    assert "- us" in status_text(status, 0.0)
    over = threading.Event()
    texts = []

    def read():
        while not over.is_set():
            texts.append(status_text(status, 250.0))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        run(small_model, recording, setup, status=status)
    finally:
        over.set()
        reader.join()
    assert status.frames == 400
    assert "ok" in status_text(status, 250.0)
    assert texts
