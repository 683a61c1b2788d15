"""What all live sources share: the clock that judges frames, the source that mends itself, faults, simulated motion."""

import threading
import time
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers import Recording
from tonguetrack.drivers.devices import source as source_module
from tonguetrack.drivers.devices.clock import FrameClock, Verdict
from tonguetrack.drivers.devices.link import LinkLost
from tonguetrack.drivers.devices.source import DeviceSource
from tonguetrack.drivers.frames import CoilFrame, FrameOfReference, NoteKind, SourceNote
from tonguetrack.drivers.simulators.faults import KINDS, FaultPlan, Misbehaviour, parse_faults
from tonguetrack.drivers.simulators.motion import DeviceClock, SimulatedMotion

COILS = ("tip", "mid")


# The clock


def judged(frames):
    """Verdicts on (number, time in s), and how many frames were said to be missing."""
    clock, verdicts, missing = FrameClock(), [], 0
    for number, time_s in frames:
        verdicts.append(clock.judge(number, time_s))
        missing += clock.missing
    return verdicts, missing, clock


def steady(count, step=1, period_s=0.0025, start=0):
    return [(start + k * step, (start + k * step) * period_s / step) for k in range(count)]


@pytest.mark.parametrize("step", [1, 8])
@pytest.mark.parametrize("period_s", [0.0, 0.0008, 0.0025, 0.025])
def test_the_step_is_learned_and_nothing_is_missing(step, period_s):
    verdicts, missing, clock = judged(steady(200, step, period_s))
    assert set(verdicts) == {Verdict.NEXT} and missing == 0
    assert clock.step == step
    assert clock.period_s == pytest.approx(period_s)


@pytest.mark.parametrize("step", [1, 8])
@pytest.mark.parametrize("lost", [1, 2, 40])
def test_lost_frames_are_counted_whatever_the_step(step, lost):
    frames = steady(100, step)
    verdicts, missing, clock = judged(frames[:50] + frames[50 + lost :])
    assert missing == lost
    assert Counter(verdicts)[Verdict.GAP] == 1
    assert clock.step == step


def test_a_step_that_was_first_seen_across_a_gap_is_learned_all_the_same():
    frames = steady(60, 8)
    del frames[1]
    _, _, clock = judged(frames)
    assert clock.step == 8


@pytest.mark.parametrize("jitter_s", [1e-6, 1e-5, 1e-4, 3e-4])
@pytest.mark.parametrize("counts", [True, False])
def test_a_clock_that_jitters_has_its_mean_rate_and_no_gaps(jitter_s, counts):
    jitter = np.random.default_rng(1).normal(scale=jitter_s, size=2000).tolist()
    frames = [(k * counts, k / 400 + jitter[k]) for k in range(2000)]
    _, missing, clock = judged(frames)
    assert missing <= 4  # two at the very start, while nothing is known
    assert clock.period_s == pytest.approx(0.0025, rel=0.08)


def test_numbers_that_stand_still_leave_the_judgement_to_the_time():
    frames = [(0, k * 0.01) for k in range(60)]
    verdicts, missing, clock = judged(frames[:30] + frames[33:])
    assert missing == 3
    assert clock.step == 0 and clock.period_s == pytest.approx(0.01)
    assert judged([*frames, frames[-1]])[0][-1] is Verdict.DUPLICATE
    assert judged([*frames, frames[-3]])[0][-1] is Verdict.LATE
    assert verdicts[30] is Verdict.GAP


def test_a_device_without_number_and_time_delivers_all_its_frames():
    verdicts, missing, _ = judged([(0, 0.0)] * 50)
    assert set(verdicts) == {Verdict.NEXT} and missing == 0


def test_a_device_without_time_is_judged_by_its_numbers():
    frames = [(k, 0.0) for k in range(50)]
    verdicts, missing, _ = judged(frames[:20] + frames[25:] + [frames[-1], frames[-2]])
    assert missing == 5
    assert verdicts[-2:] == [Verdict.DUPLICATE, Verdict.LATE]


@pytest.mark.parametrize("known", [2, 3, 30])
def test_a_frame_that_comes_twice_is_a_duplicate_as_soon_as_anything_has_moved(known):
    frames = steady(known)
    assert judged([*frames, frames[-1]])[0][-1] is Verdict.DUPLICATE


def test_late_frames_change_nothing():
    frames = steady(50)
    verdicts, missing, _ = judged([*frames[:30], frames[31], frames[30], *frames[32:]])
    assert Counter(verdicts) == {Verdict.NEXT: 48, Verdict.GAP: 1, Verdict.LATE: 1}
    assert missing == 1


@pytest.mark.parametrize("by_s", [-0.9592, -3.0, 100.0, -1e5])
def test_a_jump_in_time_is_a_reset_and_the_count_goes_on_from_there(by_s):
    frames = [(0, 10.0 + k * 0.01) for k in range(40)]
    jumped = [(0, 10.0 + by_s + k * 0.01) for k in range(40, 80)]
    verdicts, missing, _ = judged(frames + jumped)
    assert [k for k, verdict in enumerate(verdicts) if verdict is not Verdict.NEXT] == [40]
    assert verdicts[40] is Verdict.RESET
    assert missing == 0


def test_a_device_that_was_restarted_begins_a_new_count():
    verdicts, missing, _ = judged(steady(100, start=5000) + steady(100))
    assert Counter(verdicts) == {Verdict.NEXT: 199, Verdict.RESET: 1}
    assert missing == 0


def test_after_a_restart_of_the_clock_any_number_may_come_and_the_step_is_still_known():
    _, _, clock = judged(steady(20, 8))
    clock.restart()
    assert clock.judge(3, 0.5) is Verdict.NEXT
    assert clock.judge(11, 0.5025) is Verdict.NEXT
    assert clock.judge(27, 0.5075) is Verdict.GAP and clock.missing == 1


def test_a_device_that_changes_its_rate_is_followed():
    fast, slow = steady(100, 1), [(100 + 4 * k, 0.25 + k * 0.01) for k in range(100)]
    verdicts, _, clock = judged(fast + slow)
    assert clock.step == 4
    assert set(verdicts[-40:]) == {Verdict.NEXT}


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.floats(0, 1e12)), max_size=60))
def test_any_numbers_and_times_are_judged(frames):
    verdicts, missing, clock = judged(frames)
    assert len(verdicts) == len(frames)
    assert missing >= 0 and clock.step >= 0 and clock.period_s >= 0


@settings(max_examples=100, deadline=None)
@given(st.sets(st.integers(1, 98), max_size=40), st.sampled_from([1, 8]))
def test_frames_and_gaps_add_up(lost, step):
    # The step must be seen before it can be believed: the first frames are all there.
    frames = steady(20, step, start=0) + [
        frame for k, frame in enumerate(steady(100, step, start=20 * step)) if k not in lost
    ]
    verdicts, missing, _ = judged(frames)
    assert missing == len(lost)
    assert len(verdicts) + missing == 120


# The source that mends itself


class Script:
    """A conversation that goes as it was written: frame numbers, notes, None (silence), exceptions."""

    rate_hz = 0.0
    frame = FrameOfReference()
    unasked = True

    def __init__(self, items, coils=COILS):
        self.coils = coils
        self.items = list(items)
        self.goodbyes = 0

    def receive(self, timeout_s):
        if not self.items:
            time.sleep(min(timeout_s, 0.01))
            return None
        item = self.items.pop(0)
        if isinstance(item, Exception):
            raise item
        if isinstance(item, int):
            return CoilFrame(np.full((2, 3), float(item)), item * 0.01, item, time.perf_counter_ns())
        return item

    def goodbye(self):
        self.goodbyes += 1


@pytest.fixture
def hurried(monkeypatch):
    """Pauses are a hundredth as long."""
    monkeypatch.setattr(source_module, "FIRST_PAUSE_S", 0.0025)
    monkeypatch.setattr(source_module, "LONGEST_PAUSE_S", 0.05)


def source_of(*conversations, **options):
    """A source whose connections are these: a Script, or an exception that connecting raises."""
    waiting = list(conversations)

    def connect():
        conversation = waiting.pop(0) if len(waiting) > 1 else waiting[0]
        if isinstance(conversation, Exception):
            raise conversation
        return conversation

    return DeviceSource(connect, "device", **options)


def take(source, frames=0, until=None, seconds=5.0):
    """Items as numbers and kinds, up to so many frames or the first note of a kind."""
    out, end_s = [], time.perf_counter() + seconds
    for item in source:
        out.append(item.kind if isinstance(item, SourceNote) else item.frame_number)
        numbers = sum(isinstance(what, int) for what in out)
        if (frames and numbers >= frames) or (until is not None and out[-1] is until):
            return out
        assert time.perf_counter() < end_s, out[-20:]
    return out


def test_frames_and_notes_come_in_order():
    note = SourceNote(NoteKind.INFO, "hello", 0)
    source = source_of(Script([1, 2, note, 3, 4]))
    assert take(source, 4) == [1, 2, NoteKind.INFO, 3, 4]
    assert source.coils == COILS


def test_a_gap_is_told_before_the_frame_that_follows_it():
    source = source_of(Script([1, 2, 3, 4, 5, 9, 10]))
    items = [next(source) for _ in range(8)]
    assert items[5].kind is NoteKind.GAP and items[5].count == 3
    assert items[6].frame_number == 9
    np.testing.assert_array_equal(items[6].positions, 9.0)


def test_frames_that_come_twice_or_late_are_counted_and_left_out():
    source = source_of(Script([1, 2, 3, 4, 4, 5, 3, 6]))
    assert take(source, 6) == [1, 2, 3, 4, 5, 6]
    assert (source.duplicates, source.late) == (1, 1)


def test_a_clock_that_jumps_is_told():
    assert take(source_of(Script([500, 501, 502, 503, 1, 2])), 6) == [
        500, 501, 502, 503, NoteKind.CLOCK_RESET, 1, 2,
    ]  # fmt: skip


def test_a_lost_link_is_told_and_made_again(hurried):
    first, second = Script([1, 2, LinkLost("unplugged")]), Script([100, 101])
    source = source_of(first, second)
    items = take(source, 4)
    assert [item for item in items if item is not NoteKind.SILENT] == [
        1, 2, NoteKind.DISCONNECTED, NoteKind.CONNECTED, 100, 101,
    ]  # fmt: skip
    assert first.goodbyes == 1
    assert source.reconnections == 1


def test_numbers_may_begin_anew_after_a_new_connection(hurried):
    source = source_of(Script([500, 501, LinkLost("x")]), Script([1, 2, 3]))
    assert NoteKind.CLOCK_RESET not in take(source, 5)


def test_pauses_between_attempts_grow_up_to_a_longest_and_the_reason_is_told(monkeypatch):
    monkeypatch.setattr(source_module, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(source_module, "LONGEST_PAUSE_S", 0.08)
    attempts = []
    script = Script([1, LinkLost("unplugged")])

    def connect():
        attempts.append(time.perf_counter())
        if len(attempts) == 1:
            return script
        if len(attempts) < 7:
            raise LinkLost("nobody answers")
        return Script([2])

    source = DeviceSource(connect, "device")
    texts = []
    while NoteKind.CONNECTED.value not in texts:
        item = next(source)
        if isinstance(item, SourceNote):
            texts += [item.text, item.kind.value]
    pauses = np.diff(attempts)[1:]
    assert len(attempts) == 7
    assert "nobody answers" in texts
    for pause, least in zip(pauses, (0.02, 0.04, 0.08, 0.08, 0.08), strict=True):
        assert pause >= least


def test_the_pause_is_short_again_after_frames_came(hurried):
    scripts = [Script([k, LinkLost("again")]) for k in range(6)] + [Script([6])]
    source = source_of(*scripts)
    items = take(source, 7)
    assert [item for item in items if isinstance(item, int)] == list(range(7))
    assert source._pause_s == source_module.FIRST_PAUSE_S


def test_a_device_that_sends_nothing_is_connected_to_anew(hurried):
    silent, better = Script([1]), Script([2])
    items = take(source_of(silent, better, idle_s=0.05), 2)
    assert items[0] == 1 and items[-1] == 2
    assert NoteKind.SILENT in items
    assert items.index(NoteKind.DISCONNECTED) < items.index(NoteKind.CONNECTED)
    assert silent.goodbyes == 1


def test_silence_is_told_every_tick():
    source = source_of(Script([1]))
    assert take(source, 1) == [1]
    assert [next(source).kind for _ in range(3)] == [NoteKind.SILENT] * 3


def test_other_coils_after_a_new_connection_are_refused_in_a_sentence(hurried):
    other = Script([], coils=("tip", "jaw"))
    source = source_of(Script([1, LinkLost("x")]), other, Script([2]))
    texts = [item.text for item in (next(source) for _ in range(6)) if isinstance(item, SourceNote)]
    assert any("tip, jaw instead of tip, mid" in text for text in texts)
    assert other.goodbyes == 1


def test_a_first_connection_that_fails_is_bad_input():
    with pytest.raises(InputError, match="nobody answers; is the device on, and is device its address"):
        source_of(LinkLost("nobody answers"))
    with pytest.raises(InputError, match="wrong option"):
        source_of(InputError("wrong option"))


def test_while_a_device_does_not_answer_its_silence_is_told_all_the_same(hurried):
    answered = threading.Event()
    scripts = [Script([1, LinkLost("gone")]), Script([2])]

    def connect():
        if len(scripts) == 1:
            assert answered.wait(10.0)
        return scripts.pop(0)

    with DeviceSource(connect, "test:") as source:
        silent = 0
        for item in source:
            if isinstance(item, SourceNote) and item.text == "test: is being connected":
                silent += 1
                if silent == 3:
                    answered.set()
            if isinstance(item, CoilFrame) and item.frame_number == 2:
                break
    assert silent >= 3


@pytest.mark.parametrize("answers_first", [True, False])
def test_a_device_that_answers_when_nobody_wants_it_any_more_is_let_go(hurried, answers_first):
    answered, second = threading.Event(), Script([])
    scripts = [Script([1, LinkLost("gone")]), second]

    def connect():
        if len(scripts) == 1:
            assert answered.wait(10.0)
        return scripts.pop(0)

    source = DeviceSource(connect, "test:")
    next(item for item in source if isinstance(item, SourceNote) and "being connected" in item.text)
    if answers_first:
        answered.set()
        source._attempt.done.wait(10.0)
    else:
        threading.Timer(0.05, answered.set).start()
    source.close()
    assert second.goodbyes == 1


def test_an_input_error_while_reconnecting_is_told_and_tried_again(hurried):
    source = source_of(Script([1, LinkLost("x")]), InputError("the name is not known"), Script([2]))
    assert take(source, 2)[-1] == 2


@pytest.mark.parametrize("state", ["silent", "disconnected"])
def test_stopping_from_another_thread_ends_the_iteration(state):
    source = source_of(Script([1] if state == "silent" else [1, LinkLost("x")]), LinkLost("gone"))
    ended = threading.Event()

    def iterate():
        for _ in source:
            pass
        ended.set()

    threading.Thread(target=iterate, daemon=True).start()
    time.sleep(0.05)
    source.stop()
    assert ended.wait(3.0)


def test_closing_says_goodbye_once():
    script = Script([1, 2])
    with source_of(script) as source:
        next(source)
    source.close()
    assert script.goodbyes == 1
    assert list(source) == []


def test_the_rate_is_the_stated_one_else_what_the_device_says_else_learned():
    script = Script(range(1, 20))
    source = source_of(script)
    assert source.rate_hz == 0.0
    take(source, 19)
    assert source.rate_hz == pytest.approx(100.0)
    stating = Script([])
    stating.rate_hz = 400.0
    assert source_of(stating).rate_hz == 400.0
    assert source_of(stating, rate_hz=250.0).rate_hz == 250.0


# Faults


def motion(frames=50, rate_hz=100.0, quaternions=None):
    positions = np.zeros((frames, 2, 3))
    positions[:, 0, 0] = np.arange(frames)
    positions[3, 1] = np.nan
    return SimulatedMotion(
        Recording(COILS, positions, np.arange(frames) / rate_hz, rate_hz, "made", quaternions=quaternions)
    )


def misbehave(text, count=2000, period_s=0.01):
    """Frames 1, 2, ... as they are sent under these faults."""
    faults, made = Misbehaviour(parse_faults(text, COILS)), motion()
    return [frame for k in range(1, count + 1) for frame in faults.frames(made.frame(k), (k - 1) * period_s)]


def numbers(frames):
    return [frame.number for frame in frames]


def test_without_faults_everything_is_sent_as_it_is():
    assert numbers(misbehave("")) == list(range(1, 2001))
    faults = Misbehaviour(FaultPlan())
    assert faults.packet(b"bytes", 0.0) == b"bytes"
    assert not faults.stalled(1.0) and not faults.cut(1.0)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_share_of_the_frames_is_dropped(share):
    got = numbers(misbehave(f"drop={share}"))
    assert len(got) == pytest.approx(2000 * (1 - share), abs=60)
    assert got == sorted(set(got))


def test_a_share_of_the_frames_is_sent_twice():
    got = Counter(numbers(misbehave("duplicate=0.1")))
    assert set(got) == set(range(1, 2001)) and set(got.values()) == {1, 2}
    assert sum(got.values()) == pytest.approx(2200, abs=60)


def test_a_share_of_the_frames_changes_places_with_the_next():
    got = numbers(misbehave("reorder=0.1"))
    assert sorted(got) == list(range(1, len(got) + 1)) and len(got) >= 1999
    steps = Counter(np.diff(got).tolist())
    assert steps[-1] == pytest.approx(190, abs=60)
    assert set(steps) <= {-1, 1, 2, 3}


def test_a_share_of_the_packets_has_one_other_byte():
    faults = Misbehaviour(parse_faults("corrupt=0.5", COILS))
    data = bytes(range(100))
    differing = Counter(
        sum(a != b for a, b in zip(data, faults.packet(data, 0.0), strict=True)) for _ in range(400)
    )
    assert set(differing) == {0, 1}
    assert differing[1] == pytest.approx(200, abs=50)
    assert faults.packet(b"", 0.0) == b""


def test_a_stall_lasts_as_long_as_it_was_asked_for():
    faults = Misbehaviour(parse_faults("stall=0.5@2", COILS))
    assert [faults.stalled(t) for t in (0.0, 1.99, 2.0, 2.49, 2.5, 9.0)] == [
        False,
        False,
        True,
        True,
        False,
        False,
    ]


def test_each_cut_happens_once():
    faults = Misbehaviour(parse_faults("disconnect@1,disconnect@3", COILS))
    assert [faults.cut(t) for t in (0.5, 1.2, 2.9, 3.0, 4.0)] == [False, True, False, True, False]


def test_the_devices_time_jumps_and_its_numbers_do_not():
    got = misbehave("jump=5@1-2", 300)
    off = {frame.number: frame.time_us - frame.number * 10_000 for frame in got}
    assert {k for k, by in off.items() if by} == set(range(101, 201))
    assert set(off.values()) == {0, 5_000_000}
    assert min(frame.time_us for frame in misbehave("jump=-100@0", 10)) == 0


def test_a_coil_is_dead_while_it_is_and_the_others_are_not():
    got = misbehave("dead=tip@1-2", 300)
    dead = {frame.number for frame in got if np.isnan(frame.positions[0]).all()}
    assert dead == set(range(101, 201))
    assert all(np.isnan(frame.quaternions[0]).all() for frame in got if frame.number in dead)
    assert all(np.isfinite(frame.positions[1]).all() for frame in got if frame.number % 50 != 4)


def test_a_coil_is_noisy_by_so_many_millimetres():
    got = np.array([frame.positions for frame in misbehave("noisy=mid:2")])
    assert np.nanstd(got[:, 1], axis=0) == pytest.approx([2, 2, 2], rel=0.1)
    assert (np.isnan(got[:, 0]).sum(), np.ptp(got[:, 0, 1])) == (0, 0)


def test_faults_are_the_same_each_time_and_others_with_another_seed():
    text = "drop=0.1,duplicate=0.1,reorder=0.1,noisy=tip:1"

    def first(seed):
        return [(f.number, f.positions.tolist()) for f in misbehave(f"{text},seed={seed}", 200) if f.number % 50 != 4]  # fmt: skip

    assert first(1) == first(1)
    assert first(1) != first(2)
    assert parse_faults("seed=7", COILS) == FaultPlan((), 7)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("explode", "the faults are drop"),
        ("drop", "'' should be a number from 0 to 1"),
        ("drop=2", "'2' should be a number from 0 to 1"),
        ("drop=nan", "'nan' should be"),
        ("drop=0.1@x", "'x' should be"),
        ("drop=0.1@5-3", "'3' should be a number from 5"),
        ("stall=1", "say when, in seconds, as in stall=1@5"),
        ("disconnect", "say when, in seconds, as in disconnect@5"),
        ("jump=1", "say when"),
        ("dead=nose", "the coils are tip, mid"),
        ("dead", "there is no coil ''"),
        ("noisy=tip", "'tip' should be a number"),
        ("noisy=tip:x", "'x' should be"),
        ("seed=-1", "'-1' should be"),
    ],
)
def test_a_fault_that_is_not_understood_is_named(text, words):
    with pytest.raises(InputError, match="--faults") as error:
        parse_faults(text, COILS)
    assert words in str(error.value)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from([*KINDS, "=", "@", "-", ":", ",", "0.5", "3", "tip", "x", " ", "1e9"])))
def test_any_list_of_faults_is_read_or_refused_in_a_sentence(parts):
    try:
        plan = parse_faults("".join(parts), COILS)
    except InputError:
        return
    faults, made = Misbehaviour(plan), motion()
    for number in range(1, 6):
        assert len(faults.frames(made.frame(number), number * 0.01)) <= 3


# Simulated motion


def test_a_recording_is_played_over_and_over_with_numbers_and_times_that_go_on():
    made = motion()
    frames = [made.frame(k) for k in (1, 2, 50, 51, 151)]
    assert [frame.positions[0, 0] for frame in frames] == [0, 1, 49, 0, 0]
    assert [frame.time_us for frame in frames] == [10_000 * k for k in (1, 2, 50, 51, 151)]


def test_another_rate_takes_the_nearest_frames():
    recording = Recording(
        ("a",), np.arange(10.0)[:, None, None] * np.ones((1, 1, 3)), np.arange(10) / 100, 100.0, "x"
    )
    twice = SimulatedMotion(recording, 200.0)
    assert twice.period_us == 5000
    assert [twice.frame(k).positions[0, 0] for k in (1, 3, 5, 19, 21)] == [0, 1, 2, 9, 0]


def test_frames_belong_to_whoever_takes_them():
    made = motion()
    made.frame(1).positions[:] = 99.0
    made.frame(1).quaternions[:] = 99.0
    assert made.frame(1).positions[0, 0] == 0.0
    assert np.linalg.norm(made.frame(1).quaternions[0]) == pytest.approx(1.0)


def test_a_coil_has_a_direction_exactly_while_it_has_a_place():
    turns = np.full((50, 2, 4), np.nan)
    turns[:, 0] = [0.0, 1.0, 0.0, 0.0]
    for made in (motion(), motion(quaternions=turns)):
        missing, there = made.frame(4), made.frame(5)
        assert np.isnan(missing.positions[1]).all() and np.isnan(missing.quaternions[1]).all()
        np.testing.assert_allclose(np.linalg.norm(there.quaternions, axis=1), 1.0)
    np.testing.assert_array_equal(there.quaternions[0], [0, 1, 0, 0])


def test_the_devices_clock_never_drifts():
    clock = DeviceClock(1000.0)
    assert clock.due_s(1) == clock.start_s
    assert clock.due_s(1_000_001) - clock.start_s == pytest.approx(1000.0)
    seen = []
    for number in clock.numbers():
        seen.append((number, time.perf_counter() - clock.due_s(number)))
        if number == 5:
            time.sleep(0.02)  # whoever is late gets the rest without waiting, and none is skipped
        if number == 40:
            break
    assert [number for number, _ in seen] == list(range(1, 41))
    assert all(late_s >= 0 for _, late_s in seen)
    clock.restart()
    assert clock.latest() in (1, 2, 3, 4, 5)
