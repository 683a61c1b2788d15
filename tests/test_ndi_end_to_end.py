"""The NDI driver and the simulated device, each in its own process, over every kind of line; all faults."""

import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest

from tonguetrack.drivers import Recording, write_recording
from tonguetrack.drivers.devices.source import DeviceSource
from tonguetrack.drivers.frames import CoilFrame, NoteKind, SourceNote
from tonguetrack.drivers.sources import open_device, parse_source

COILS = ("tip", "blade", "dorsum")
NAMES = ("port 1", "port 1b", "port 2")
FRAMES, RATE_HZ, STEP = 500, 100.0, 8
MAIN = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"
WAIT_S = 30.0
TCP, SERIAL, PTY = (), ("--rfc2217",), ("--pty",)


def positions_of_all():
    """(FRAMES, 3, 3): every frame is different, and so tells which it is."""
    index = np.arange(FRAMES)[:, None, None]
    coil = np.arange(3)[None, :, None]
    return index / 7.0 - 30.0 + 20.0 * coil + np.array([0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    recording = Recording(COILS, positions_of_all(), np.arange(FRAMES) / RATE_HZ, RATE_HZ, "made")
    return write_recording(recording, tmp_path_factory.mktemp("ndi") / "played.npz")


@contextmanager
def simulator(played, *options):
    """The URI of a simulated device in its own process, which has to end well."""
    command = [
        sys.executable,
        "-c",
        MAIN,
        "simulate",
        "device",
        "ndi",
        "--from",
        str(played),
        "--rate",
        str(RATE_HZ),
        *options,
    ]
    if "--pty" not in options:
        command += ["--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        uri = process.stdout.readline().strip()
        if not uri:
            raise AssertionError(process.stderr.read())
        yield uri
        process.terminate()
        _, errors = process.communicate(timeout=10)
        assert process.returncode == 0, errors
        assert "Traceback" not in errors
    finally:
        process.kill()
        process.communicate()


def kept(frame):
    """A frame that stays as it is: (number, device time, positions, arrival, status)."""
    return (
        frame.frame_number,
        frame.device_time_s,
        frame.positions.copy(),
        frame.arrival_ns,
        frame.status.copy(),
    )


def collect(source, until):
    """Frames and notes, apart, until the function of both says that it is enough."""
    frames, notes = [], []
    ends_s = time.perf_counter() + WAIT_S
    for item in source:
        if isinstance(item, CoilFrame):
            frames.append(kept(item))
        elif isinstance(item, SourceNote):
            notes.append(item)
        if until(frames, notes):
            return frames, notes
        assert time.perf_counter() < ends_s, [note.text for note in notes][-5:]
    raise AssertionError("the source ended")


def after(count):
    return lambda frames, notes: len(frames) >= count


def back_again(frames, notes):
    """The source has connected anew, and the device counts from the beginning."""
    numbers = [number for number, *_ in frames]
    return NoteKind.CONNECTED in kinds(notes) and any(b < a for a, b in pairwise(numbers))


def kinds(notes):
    return [note.kind for note in notes if note.kind not in (NoteKind.SILENT, NoteKind.INFO)]


def expected(number, step=STEP):
    """(3, 3) what the device shows in the frame with that number, in single precision."""
    played_index = (number // step - 1) % FRAMES
    return positions_of_all()[played_index].astype(np.float32).astype(float)


def assert_equal_to_the_recording(frames, step=STEP):
    for number, _, positions, _, _ in frames:
        np.testing.assert_array_equal(positions, expected(number, step))


def run(played, faults, until, *options):
    with (
        simulator(played, "--faults", faults, *options) as uri,
        open_device(parse_source(uri)) as source,
    ):
        assert isinstance(source, DeviceSource)
        return (*collect(source, until), source)


# --- every kind of line -------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", [TCP, SERIAL, PTY], ids=["tcp", "rfc2217", "pty"])
def test_the_whole_way_from_reset_to_frames_equal_to_the_recording(played, line):
    if line == PTY and sys.platform != "linux":
        pytest.skip("a pseudo-terminal's packet mode, by which the simulator sees a break")
    with simulator(played, *line) as uri, open_device(parse_source(uri)) as source:
        assert source.coils == NAMES
        frames, notes = collect(source, after(60))
    assert_equal_to_the_recording(frames)
    told = [note.text for note in notes if note.kind is NoteKind.INFO]
    assert any(text.startswith("the device is: Aurora") for text in told)
    # Neither had the break to be replaced by a search, nor the fastest speed by a slower one.
    assert not any("break" in text or "baud" in text for text in told)
    numbers = [number for number, *_ in frames]
    assert all(number % STEP == 0 for number in numbers)
    assert numbers == sorted(set(numbers))


def test_text_replies_give_the_same_to_their_own_precision(played):
    with simulator(played) as uri, open_device(parse_source(f"{uri}?reply=tx")) as source:
        frames, _ = collect(source, after(40))
    for number, _, positions, _, _ in frames:
        np.testing.assert_allclose(positions, expected(number), atol=0.0051)


def test_a_polaris_counts_in_steps_of_one(played):
    with simulator(played, "--model", "polaris") as uri, open_device(parse_source(uri)) as source:
        frames, _ = collect(source, after(40))
    assert_equal_to_the_recording(frames, step=1)
    assert source.coils == ("port 1", "port 2", "port 3")


def test_a_second_connection_finds_the_device_as_the_first_did(played):
    with simulator(played) as uri:
        for _ in range(2):
            with open_device(parse_source(uri)) as source:
                frames, _ = collect(source, after(10))
            assert_equal_to_the_recording(frames)


def test_the_rate_is_learned_from_the_frames(played):
    with simulator(played) as uri, open_device(parse_source(uri)) as source:
        frames, _ = collect(source, after(200))
        assert source.rate_hz == pytest.approx(RATE_HZ, rel=0.1)
    times = np.array([time_s for _, time_s, *_ in frames])
    arrivals = np.array([arrival_ns for _, _, _, arrival_ns, _ in frames]) * 1e-9
    assert (np.diff(times) > 0).all()
    assert abs(times - arrivals).max() < 0.5


# --- every fault --------------------------------------------------------------------------------------------


def test_lost_measurements_are_told_as_gaps(played):
    frames, notes, _ = run(played, "drop=0.2", after(100))
    assert_equal_to_the_recording(frames)
    gaps = sum(note.count for note in notes if note.kind is NoteKind.GAP)
    missing = (frames[-1][0] - frames[5][0]) // STEP - (len(frames) - 6)
    assert missing > 5
    assert abs(gaps - missing) <= 5  # the first few frames only teach the step
    assert set(kinds(notes)) == {NoteKind.GAP}


def test_a_dead_coil_is_nan_and_comes_back(played):
    frames, notes, source = run(played, "dead=blade@0.3-0.6", after(90))
    dead = np.array([np.isnan(positions[1]).all() for _, _, positions, _, _ in frames])
    assert 0 < dead.sum() < len(frames)
    assert not dead[0] and not dead[-1]
    assert not any(np.isnan(positions[[0, 2]]).any() for _, _, positions, _, _ in frames)
    assert all(
        status[1] & 0x40 for (_, _, _, _, status), is_dead in zip(frames, dead, strict=True) if is_dead
    )
    assert source.reconnections == 0
    assert NoteKind.DISCONNECTED not in kinds(notes)


def test_a_noisy_coil_is_delivered_as_it_is(played):
    frames, _, _ = run(played, "noisy=tip:5", after(60))
    off = np.array([positions - expected(number) for number, _, positions, _, _ in frames])
    assert 2.0 < off[:, 0].std() < 10.0
    assert not off[:, 1:].any()


def test_damaged_replies_are_told_and_no_wrong_position_gets_through(played):
    frames, _, _ = run(
        played, "corrupt=0.1@0.1", lambda frames, notes: kinds(notes).count(NoteKind.BAD_DATA) > 10
    )
    assert len(frames) > 20
    assert_equal_to_the_recording(frames)


def test_a_device_that_stalls_goes_on_with_a_gap(played):
    frames, notes, source = run(
        played, "stall=0.7@0.4", lambda frames, notes: bool(frames) and frames[-1][0] > 140 * STEP
    )
    assert_equal_to_the_recording(frames)
    assert NoteKind.SILENT in [note.kind for note in notes]
    assert max(note.count for note in notes if note.kind is NoteKind.GAP) >= 50
    assert source.reconnections == 0


def test_a_connection_that_is_cut_is_made_again(played):
    frames, notes, source = run(
        played,
        "disconnect@0.4",
        back_again,
    )
    assert_equal_to_the_recording(frames)
    assert source.reconnections >= 1
    order = kinds(notes)
    assert order.index(NoteKind.DISCONNECTED) < order.index(NoteKind.CONNECTED)


def test_a_device_on_a_serial_line_that_starts_anew_is_reset_and_tracked_again(played):
    with (
        simulator(played, *SERIAL, "--faults", "disconnect@0.4") as uri,
        open_device(parse_source(f"{uri}?baud=115200")) as source,
    ):
        source._idle_s = 0.5  # not as patient as with a real device
        frames, notes = collect(source, back_again)
    assert_equal_to_the_recording(frames)
    assert "has sent nothing" in next(note.text for note in notes if note.kind is NoteKind.DISCONNECTED)


@pytest.mark.parametrize("jump_s", [5.0, -0.5])
def test_a_count_that_jumps_is_told_and_time_goes_on(played, jump_s):
    frames, notes, source = run(
        played,
        f"jump={jump_s}@1",
        lambda frames, notes: NoteKind.CLOCK_RESET in kinds(notes) and len(frames) > 130,
    )
    assert kinds(notes).count(NoteKind.CLOCK_RESET) == 1
    assert not [note for note in notes if note.kind is NoteKind.GAP and note.count > 50]
    steps_s = np.diff([time_s for _, time_s, *_ in frames])
    assert steps_s.min() >= 0
    assert steps_s.max() < 0.4
    assert source.reconnections == 0
