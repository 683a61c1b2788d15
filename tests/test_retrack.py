"""A take gives the same bits again: with bad coils, gaps, a speaker that becomes known, a clock that jumps."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, FrameOfReference, NoteKind, SourceNote
from tonguetrack.model import save_model
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.control import Control, ControlQueue
from tonguetrack.tracker.live import LiveRun, stream_info
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.pose import CoilState, PoseStatus
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.takes.describing import take_info
from tonguetrack.tracker.takes.keeper import TakeKeeper
from tonguetrack.tracker.takes.reading import read_take
from tonguetrack.tracker.takes.retrack import retrack

RATE_HZ = 250.0
ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum", "tongue_back", "tongue_left")


class Script:
    """A source that delivers what it is given; functions among it are called in their place."""

    address = "script:"
    frame = FrameOfReference()
    rate_hz = RATE_HZ

    def __init__(self, coils, items):
        self.coils = coils
        self._items = items
        self._stopped = False

    def __iter__(self):
        for item in self._items:
            if self._stopped:
                return
            if callable(item):
                item()
            else:
                yield item

    def stop(self):
        self._stopped = True

    def close(self):
        pass


@pytest.fixture(scope="module")
def take(small_model):
    recording, setup = made_up_recording(small_model, 1500, RATE_HZ)
    random = np.random.default_rng(11)
    positions = recording.positions + random.normal(scale=0.3, size=recording.positions.shape)
    positions[random.random(positions.shape[:2]) < 0.05] = np.nan
    positions[300:420, 2] += random.normal(scale=20.0, size=(120, 3))
    positions[450:650] = np.nan
    positions[1000:1200, 1] += [0.0, 0.0, 25.0]
    session = replace(setup.session, coils=dict(zip(recording.coils, ROLES, strict=True)))
    return replace(recording, positions=positions), replace(setup, session=session, roles=ROLES)


def frames_of(recording, rows, shift_s=0.0):
    return [
        CoilFrame(recording.positions[k], recording.times_s[k] + shift_s, k, time.perf_counter_ns() + k)
        for k in rows
    ]


def recorded(model, setup, items, coils, folder, **options):
    """Runs the loop over the items and records all of it; the take."""
    tracker = Tracker(model, setup, RATE_HZ, watchful=True, fix_after_s=options.pop("fix_after_s", None))
    source = Script(coils, items)
    path = folder / "take.xdf"
    keeper = TakeKeeper(path, lambda frame: take_info(source, frame, model, tracker.setup, RATE_HZ))
    info = stream_info(model, setup, RATE_HZ)
    LiveRun(source, tracker, info, LiveStatus(setup.roles), keeper=keeper, **options).run()
    return read_take(path)


def test_every_bit_of_a_troubled_take_comes_again(small_model, take, tmp_path):
    recording, setup = take
    items = frames_of(recording, range(700))
    items += [SourceNote(NoteKind.DISCONNECTED, "gone", time.perf_counter_ns())]
    items += frames_of(recording, range(700, 1100), shift_s=-1.5)  # the clock jumps back
    items += frames_of(recording, range(1100, 1500), shift_s=4.0)  # and forth
    found = recorded(small_model, setup, items, recording.coils, tmp_path)
    assert found.frame_count == 1500
    again = retrack(found, small_model)
    assert again.same
    states = found.coil_states()
    assert {CoilState.WILD, CoilState.MISSING, CoilState.MISFIT} <= set(np.unique(states).astype(int))
    assert set(found.poses().statuses) >= {PoseStatus.OK, PoseStatus.HELD, PoseStatus.RELAXING}
    np.testing.assert_array_equal(
        found.recording().device_times_s,
        [frame.device_time_s for frame in items if isinstance(frame, CoilFrame)],
    )


def test_a_speaker_that_becomes_known_on_the_way_is_part_of_the_take(small_model, take, tmp_path):
    recording, setup = take
    free = replace(setup, session=replace(setup.session, speaker_weights=None))
    found = recorded(
        small_model, free, frames_of(recording, range(1500)), recording.coils, tmp_path, fix_after_s=2.0
    )
    fixed = found.pose[:, found.info.pose_labels.index("speaker_fixed")]
    assert fixed[0] == 0.0 and fixed[-1] == 1.0 and (np.diff(fixed) != 0).sum() == 1
    speaker = found.poses().speaker_weights
    row = int(np.argmax(fixed))
    tracked = found.poses().statuses[:row] == PoseStatus.OK
    np.testing.assert_allclose(speaker[-1], speaker[:row][tracked].mean(axis=0), rtol=1e-12)
    assert [row_of for row_of, _ in found.sessions] == [0, row]
    assert retrack(found, small_model).same


def test_a_user_fixes_and_frees_the_speaker_in_the_middle_of_a_take(small_model, take, tmp_path):
    recording, setup = take
    free = replace(setup, session=replace(setup.session, speaker_weights=None))
    controls = ControlQueue()
    items = [
        *frames_of(recording, range(200)),
        lambda: controls.put(Control("fix_speaker", "", time.perf_counter_ns())),
        *frames_of(recording, range(200, 400)),
        lambda: controls.put(Control("free_speaker", "", time.perf_counter_ns())),
        *frames_of(recording, range(400, 600)),
    ]
    found = recorded(small_model, free, items, recording.coils, tmp_path, controls=controls)
    fixed = found.pose[:, found.info.pose_labels.index("speaker_fixed")]
    assert (fixed[:201] == 0).all() and (fixed[201:401] == 1).all() and (fixed[401:] == 0).all()
    assert retrack(found, small_model).same


def test_a_take_that_begins_in_the_middle_of_a_run_gives_the_same_bits_too(small_model, take, tmp_path):
    recording, setup = take
    controls = ControlQueue()
    keepers = []

    def wait_for(state):
        for _ in range(500):
            if (keepers[0].recorder is not None) == state:
                return
            time.sleep(0.01)
        raise AssertionError("the take neither began nor ended")

    items = [
        *frames_of(recording, range(100)),
        lambda: controls.put(Control("take_start", "one", time.perf_counter_ns())),
        *frames_of(recording, range(100, 102)),
        lambda: wait_for(True),
        *frames_of(recording, range(102, 500)),
        lambda: controls.put(Control("mark", "vowels begin", items[-1].arrival_ns)),
        *frames_of(recording, range(500, 502)),
        lambda: controls.put(Control("take_stop", "", time.perf_counter_ns())),
        *frames_of(recording, range(502, 504)),
        lambda: wait_for(False),
        *frames_of(recording, range(504, 600)),
    ]
    tracker = Tracker(small_model, setup, RATE_HZ, watchful=True)
    source = Script(recording.coils, items)
    keeper = TakeKeeper(
        tmp_path / "takes", lambda frame: take_info(source, frame, small_model, tracker.setup, RATE_HZ)
    )
    keepers.append(keeper)
    info = stream_info(small_model, setup, RATE_HZ)
    summary = LiveRun(source, tracker, info, LiveStatus(setup.roles), keeper=keeper, controls=controls).run()
    assert [kept.path for kept in summary.takes] == [str(tmp_path / "takes" / "one.xdf")]
    found = read_take(tmp_path / "takes" / "one.xdf")
    numbers = found.recording().frame_numbers
    assert numbers[0] == 102
    assert set(range(102, 502)) <= set(numbers.tolist()) <= set(range(102, 504))
    assert [mark.text for mark in found.markers] == ["vowels begin"]
    assert retrack(found, small_model).same


def test_a_speaker_that_becomes_known_between_frames_of_one_packet_is_in_its_place(
    small_model, take, tmp_path
):
    recording, setup = take
    free = replace(setup, session=replace(setup.session, speaker_weights=None))
    items = frames_of(recording, range(200))
    items = [replace(frame, arrival_ns=items[k - k % 8].arrival_ns) for k, frame in enumerate(items)]
    found = recorded(small_model, free, items, recording.coils, tmp_path, fix_after_s=0.4)
    row = int(np.argmax(found.pose[:, found.info.pose_labels.index("speaker_fixed")]))
    assert row % 8 != 0
    assert [row_of for row_of, _ in found.sessions] == [0, row]
    assert retrack(found, small_model).same


def test_a_speaker_that_becomes_known_while_the_takes_file_is_made_is_part_of_the_take(
    small_model, take, tmp_path
):
    recording, setup = take
    free = replace(setup, session=replace(setup.session, speaker_weights=None))
    tracker = Tracker(small_model, free, RATE_HZ, watchful=True)
    described, go_on = threading.Event(), threading.Event()

    def describe(frame):
        info = take_info(source, frame, small_model, tracker.setup, RATE_HZ)
        described.set()
        assert go_on.wait(10.0)
        return info

    def the_file_is_there():
        go_on.set()
        keeper.wait()

    controls = ControlQueue()
    items = [
        *frames_of(recording, range(50)),
        lambda: controls.put(Control("take_start", "late", time.perf_counter_ns())),
        *frames_of(recording, range(50, 51)),
        lambda: described.wait(10.0),
        lambda: controls.put(Control("fix_speaker", "", time.perf_counter_ns())),
        *frames_of(recording, range(51, 60)),
        the_file_is_there,
        *frames_of(recording, range(60, 120)),
    ]
    source = Script(recording.coils, items)
    keeper = TakeKeeper(tmp_path, describe)
    info = stream_info(small_model, free, RATE_HZ)
    LiveRun(source, tracker, info, LiveStatus(setup.roles), keeper=keeper, controls=controls).run()
    found = read_take(tmp_path / "late.xdf")
    assert found.frame_count == 60
    assert retrack(found, small_model).same


def test_a_users_mark_that_looks_like_a_set_up_is_none(small_model, take, tmp_path):
    recording, setup = take
    controls = ControlQueue()
    items = [
        *frames_of(recording, range(20)),
        lambda: controls.put(Control("mark", "session: two", time.perf_counter_ns())),
        *frames_of(recording, range(20, 40)),
    ]
    found = recorded(small_model, setup, items, recording.coils, tmp_path, controls=controls)
    assert [mark.text for mark in found.markers] == ["mark: session: two"]
    assert retrack(found, small_model).same


def test_another_model_is_refused_by_name(small_model, take, tmp_path):
    recording, setup = take
    found = recorded(small_model, setup, frames_of(recording, range(20)), recording.coils, tmp_path)
    with pytest.raises(InputError, match="recorded with the model 'random test model'"):
        retrack(found, small_model.truncated(4, 3))


def test_a_changed_bit_is_found(small_model, take, tmp_path):
    recording, setup = take
    found = recorded(small_model, setup, frames_of(recording, range(50)), recording.coils, tmp_path)
    data = bytearray((tmp_path / "take.xdf").read_bytes())
    weight = found.pose[30, found.info.pose_labels.index("pose_1")]
    place = data.index(weight.tobytes())
    data[place] ^= 1
    (tmp_path / "changed.xdf").write_bytes(data)
    assert retrack(read_take(tmp_path / "changed.xdf"), small_model).differing.tolist() == [30]


def test_the_command_says_whether_a_take_reproduces(small_model, take, tmp_path, capsys):
    recording, setup = take
    save_model(small_model, tmp_path / "model.npz")
    recorded(small_model, setup, frames_of(recording, range(100)), recording.coils, tmp_path)
    command = ["take", "info", str(tmp_path / "take.xdf"), "--check", "--model", str(tmp_path / "model.npz")]
    assert main(command) == 0
    assert "all 100 poses come out the same, bit for bit" in capsys.readouterr().out
