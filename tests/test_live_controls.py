"""What users and clients may do to a run while it lasts: to the speaker, to takes, and when it ends."""

import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, FrameOfReference, NoteKind, SourceNote
from tonguetrack.tracker import kernels
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.control import Control, ControlQueue
from tonguetrack.tracker.live import LiveRun, stream_info
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.served import obey_client
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.takes.describing import take_info
from tonguetrack.tracker.takes.keeper import TakeKeeper, check_place
from tonguetrack.tracker.takes.reading import read_take
from tonguetrack.tracker.takes.retrack import retrack

RATE_HZ = 250.0
ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum", "tongue_back", "tongue_left")


class Script:
    """A source that delivers what it is given; functions among it are called in their place."""

    address = "script:"
    frame = FrameOfReference()

    def __init__(self, items, coils=(), rate_hz=RATE_HZ):
        self.coils = coils
        self.rate_hz = rate_hz
        self._items = items

    def __iter__(self):
        for item in self._items:
            if callable(item):
                item()
            else:
                yield item

    def stop(self):
        pass

    def close(self):
        pass


@dataclass(frozen=True)
class Estimate:
    weights: np.ndarray
    frames: int = 50


class Background:
    """Stands in for the thread beside the loop."""

    def __init__(self):
        self.latest = None
        self.given = []

    def add(self, coils):
        self.given.append(coils.copy())


@pytest.fixture(scope="module")
def take(small_model):
    recording, setup = made_up_recording(small_model, 400, RATE_HZ)
    session = replace(setup.session, coils=dict(zip(recording.coils, ROLES, strict=True)))
    return recording, replace(setup, session=session, roles=ROLES)


def freed(setup):
    return replace(setup, session=replace(setup.session, speaker_weights=None))


def frames_of(recording, rows, times_s=None):
    times_s = recording.times_s if times_s is None else times_s
    return [CoilFrame(recording.positions[k], float(times_s[k]), k, time.perf_counter_ns()) for k in rows]


def run(model, setup, items, tracker=None, rate_hz=RATE_HZ, **options):
    tracker = tracker or Tracker(model, setup, RATE_HZ, watchful=True)
    source = Script(items, rate_hz=rate_hz)
    live = LiveRun(source, tracker, stream_info(model, setup, RATE_HZ), LiveStatus(setup.roles), **options)
    return tracker, live.run()


# The speaker ----------------------------------------------------------------------------------------


def asked(controls, kind):
    return lambda: controls.put(Control(kind, "", time.perf_counter_ns()))


def test_who_fixes_the_speaker_keeps_the_joint_estimate_as_it_is(small_model, take):
    recording, setup = take
    controls, background = ControlQueue(), Background()
    first = Estimate(small_model.speaker.mean + 0.1 * small_model.speaker.sigma)
    later = Estimate(small_model.speaker.mean + 0.9 * small_model.speaker.sigma)
    items = [
        *frames_of(recording, range(50)),
        lambda: setattr(background, "latest", first),
        *frames_of(recording, range(50, 100)),
        asked(controls, "fix_speaker"),
        *frames_of(recording, range(100, 150)),
        lambda: setattr(background, "latest", later),
        *frames_of(recording, range(150, 200)),
    ]
    tracker, _ = run(
        small_model, freed(setup), items, controls=controls, background=background, fix_after_s=60.0
    )
    np.testing.assert_array_equal(tracker.setup.session.speaker_weights, first.weights)
    assert "not final" not in tracker.setup.session.speaker_source


def test_who_frees_the_speaker_after_the_last_joint_estimate_gets_another_one(small_model, take):
    recording, setup = take
    controls, background = ControlQueue(), Background()
    first = Estimate(small_model.speaker.mean + 0.1 * small_model.speaker.sigma)
    later = Estimate(small_model.speaker.mean + 0.9 * small_model.speaker.sigma)
    fixed = []
    items = [
        *frames_of(recording, range(50)),
        lambda: setattr(background, "latest", first),
        *frames_of(recording, range(50, 60)),
        asked(controls, "free_speaker"),
        *frames_of(recording, range(60, 70)),
        lambda: fixed.append(tracker.setup.session.speaker_weights),
        *frames_of(recording, range(70, 150)),
        lambda: setattr(background, "latest", later),
        *frames_of(recording, range(150, 200)),
    ]
    tracker = Tracker(small_model, freed(setup), RATE_HZ, watchful=True)
    run(small_model, freed(setup), items, tracker, controls=controls, background=background, fix_after_s=0.1)
    assert fixed == [None], "the estimate of before is not taken again"
    np.testing.assert_array_equal(tracker.setup.session.speaker_weights, later.weights)
    assert "not final" not in tracker.setup.session.speaker_source


@pytest.mark.parametrize("watchful", [True, False])
def test_the_background_is_given_the_coils_that_counted(small_model, take, watchful):
    recording, setup = take
    background = Background()
    tracker = Tracker(small_model, freed(setup), RATE_HZ, watchful=watchful)
    run(small_model, freed(setup), frames_of(recording, range(20)), tracker, background=background)
    np.testing.assert_array_equal(background.given, recording.positions[:20])


@pytest.mark.parametrize("begins_free", [True, False])
def test_whatever_speaker_comes_later_its_kernels_are_there_before_the_first_frame(
    small_model, take, begins_free
):
    _, setup = take
    used = (
        kernels.solve_fixed_speaker,
        kernels.solve_free_speaker,
        kernels.coil_residuals,
        kernels.free_residuals,
    )
    calls = {}
    tracker = Tracker(small_model, freed(setup) if begins_free else setup, RATE_HZ, watchful=True)
    with pytest.MonkeyPatch.context() as patch:
        for kernel in used:
            name = kernel.py_func.__name__

            def counted(*arguments, name=name, kernel=kernel):
                calls[name] = calls.get(name, 0) + 1
                return kernel(*arguments)

            patch.setattr(kernels, name, counted)
        tracker.warm_up()
    assert len(calls) == len(used)


# The end --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "clock",
    [
        lambda times: times,
        np.zeros_like,
        lambda times: np.where(times < 0.2, times, times - 1000.0),
        lambda times: np.where(times < 0.2, times, times + 1000.0),
    ],
    ids=["steady", "still", "jumps back", "jumps forth"],
)
@pytest.mark.parametrize("rate_hz", [RATE_HZ, 0.0], ids=["known rate", "unknown rate"])
def test_so_many_seconds_of_a_device_are_as_many_whatever_its_clock_does(small_model, take, clock, rate_hz):
    recording, setup = take
    items = frames_of(recording, range(400), clock(recording.times_s))
    _, summary = run(small_model, setup, items, rate_hz=rate_hz, seconds=0.5)
    assert summary.frames == 125


def test_a_jump_that_the_source_tells_of_is_no_time_that_has_passed(small_model, take):
    recording, setup = take
    times_s = np.where(recording.times_s < 0.2, recording.times_s, recording.times_s + 30.0)
    items = frames_of(recording, range(400), times_s)
    items.insert(50, SourceNote(NoteKind.CLOCK_RESET, "jumped", 0))
    assert run(small_model, setup, items, seconds=0.5)[1].frames == 125


# Takes ----------------------------------------------------------------------------------------------


def test_a_later_run_with_the_same_place_numbers_its_take(small_model, take, tmp_path):
    """As where one client of the authors' server follows another."""
    recording, setup = take
    place = tmp_path / "take.xdf"
    for _ in range(2):
        tracker = Tracker(small_model, setup, RATE_HZ, watchful=True)
        source = Script([], recording.coils)
        keeper = TakeKeeper(
            place,
            lambda frame: take_info(source, frame, small_model, tracker.setup, RATE_HZ),  # noqa: B023
        )
        run(small_model, setup, frames_of(recording, range(10)), tracker, keeper=keeper)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["take-2.xdf", "take.xdf"]


def test_a_take_that_begins_while_the_device_is_gone_has_the_marks_of_that_time(small_model, take, tmp_path):
    recording, setup = take
    controls = ControlQueue()
    tracker = Tracker(small_model, setup, RATE_HZ, watchful=True)
    gone = SourceNote(NoteKind.DISCONNECTED, "the line is cut", time.perf_counter_ns())
    silent = SourceNote(NoteKind.SILENT, "not connected", time.perf_counter_ns())
    items = [
        *frames_of(recording, range(10)),
        gone,
        asked(controls, "take_start"),
        silent,
        lambda: keeper.wait(),
        silent,
        lambda: controls.put(Control("mark", "while it was gone", time.perf_counter_ns())),
        silent,
        *frames_of(recording, range(10, 30)),
    ]
    source = Script(items, recording.coils)
    keeper = TakeKeeper(tmp_path, lambda frame: take_info(source, frame, small_model, tracker.setup, RATE_HZ))
    run(small_model, setup, items, tracker, keeper=keeper, controls=controls)
    found = read_take(tmp_path / "take-001.xdf")
    assert found.frame_count == 20
    assert [mark.text for mark in found.markers] == ["while it was gone"]
    assert retrack(found, small_model).same


def test_a_take_that_was_refused_at_the_very_end_is_told(small_model, take, tmp_path):
    recording, setup = take
    controls, told = ControlQueue(), []

    def describe(frame):
        raise InputError("no take today.")

    items = [*frames_of(recording, range(10)), asked(controls, "take_start"), *frames_of(recording, [10])]
    keeper = TakeKeeper(tmp_path, describe)
    _, summary = run(small_model, setup, items, keeper=keeper, controls=controls, said=told.append)
    assert told == ["no take today."]
    assert summary.frames == 11 and summary.takes == ()


def test_places_that_cannot_be_are_refused_before_anything_is_opened(tmp_path):
    (tmp_path / "there.xdf").write_bytes(b"")
    (tmp_path / "file").write_bytes(b"")
    check_place(tmp_path / "new.xdf")
    check_place(tmp_path / "folder")
    check_place(tmp_path)
    with pytest.raises(InputError, match="never overwritten"):
        check_place(tmp_path / "there.xdf")
    with pytest.raises(InputError, match="this is a file"):
        check_place(tmp_path / "file")
    with pytest.raises(InputError, match="ends in .xdf"):
        check_place(tmp_path / "take.csv")
    check_place(tmp_path / "2026-11.22")


# Clients --------------------------------------------------------------------------------------------


def command(name, *values):
    return SourceNote(NoteKind.COMMAND, name, 0, command=name, values=values)


@pytest.mark.parametrize("value", [float("inf"), -1.0, 1e300, float("-inf")])
def test_a_clients_impossible_settings_change_nothing(small_model, take, value):
    _, setup = take
    tracker = Tracker(small_model, setup, RATE_HZ)
    assert obey_client(command("set_settings", value, 1.0, 1.0), tracker) is setup


def test_a_clients_settings_hold_where_it_states_them(small_model, take):
    _, setup = take
    tracker = Tracker(small_model, setup, RATE_HZ)
    energy = obey_client(command("set_settings", float("nan"), 3.0, 2.0), tracker).session.energy
    assert (energy.gamma_speaker, energy.gamma_pose, energy.box) == (
        setup.session.energy.gamma_speaker,
        3.0,
        2.0,
    )


def test_other_vertices_need_another_run_and_the_same_ones_do_not(small_model, take):
    _, setup = take
    tracker = Tracker(small_model, setup, RATE_HZ)
    same = tuple(float(vertex) for vertex in setup.vertices)
    assert obey_client(command("set_vertices", *same), tracker) is setup
    assert obey_client(command("set_vertices", *same[1:]), tracker) is None


def test_without_coils_after_a_gap_no_number_on_the_stream_is_missing(small_model, take):
    recording, setup = take
    positions = recording.positions.copy()
    positions[100:200] = np.nan
    times_s = np.where(np.arange(400) < 100, recording.times_s, recording.times_s + 3.0)
    tracker = Tracker(small_model, setup, RATE_HZ, watchful=True)
    for frame in frames_of(replace(recording, positions=positions), range(400), times_s):
        pose = tracker.step(frame)
        assert np.isfinite(pose.weights).all() and np.isfinite(pose.normalised).all()
        assert pose.status == (PoseStatus.LOST if 100 <= frame.frame_number < 200 else PoseStatus.OK)


def test_a_line_that_nobody_reads_ends_no_run(monkeypatch):
    from tonguetrack.tracker.cli.watching import say_above

    class Closed:
        def isatty(self):
            return False

        def write(self, text):
            raise BrokenPipeError

        flush = None

    monkeypatch.setattr("sys.stderr", Closed())
    say_above("nobody hears this")
