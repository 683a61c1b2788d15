"""Whatever happens in a run, each of its takes gives the same bits again: random scripts of frames and troubles."""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tonguetrack.drivers import CoilFrame, FrameOfReference, NoteKind, SourceNote
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.control import Control, ControlQueue
from tonguetrack.tracker.live import LiveRun, stream_info
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.served import obey_client, setup_for_points
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.takes.describing import take_info
from tonguetrack.tracker.takes.keeper import TakeKeeper
from tonguetrack.tracker.takes.reading import read_take
from tonguetrack.tracker.takes.retrack import retrack

ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum", "tongue_back", "tongue_left")
RATES_HZ = (40.0, 99.9, 250.0, 399.99768, 1250.0)
FRAMES = 2000
SECOND_NS = 10**9


@dataclass(frozen=True)
class Frames:
    """`count` frames. together: how many arrive with one stamp; wrong: which coils, and in which way."""

    count: int
    together: int = 1
    wrong: str = ""
    coils: tuple[int, ...] = ()


@dataclass(frozen=True)
class Jump:
    """The device's clock goes on by so much more."""

    by_s: float


@dataclass(frozen=True)
class Estimate:
    """The thread beside the loop has a new speaker."""

    sigma: float


@dataclass(frozen=True)
class Command:
    """What a client of the authors' server asks for, where one drives the run."""

    name: str
    values: tuple[float, ...] = ()


WAYS = ("missing", "wild", "off", "still", "huge", "outlier")
COILS = st.lists(st.integers(0, 4), min_size=1, max_size=5, unique=True).map(tuple)
COUNTS = st.integers(1, 90)
TOGETHER = st.integers(1, 12)
STEPS = st.one_of(
    st.builds(Frames, COUNTS, TOGETHER),
    st.builds(Frames, COUNTS, TOGETHER, st.sampled_from(WAYS), COILS),
    st.builds(Jump, st.sampled_from([-3600.0, -1.0, -0.004, 0.0, 0.01, 0.2, 0.3, 5.0, 90.0])),
    st.builds(Estimate, st.floats(-3.0, 3.0)),
    st.sampled_from([kind for kind in NoteKind if kind is not NoteKind.COMMAND]),
    st.builds(
        Control,
        st.sampled_from(["fix_speaker", "free_speaker", "take_start", "take_stop"]),
    ),
    st.builds(Control, st.just("mark"), st.sampled_from(["vowels", "session: no", "source: mine", "ə\n"])),
    st.sampled_from([Command("fix_speaker"), Command("reset"), Command("unheard of")]),
    st.builds(
        Command,
        st.just("set_settings"),
        st.tuples(*[st.sampled_from([math.nan, -1.0, 0.0, 0.3, 1.0, 40.0, math.inf])] * 3),
    ),
    st.just("wait"),
)
SCRIPTS = st.lists(STEPS, min_size=1, max_size=14)


class Played:
    """A source that plays a script; `estimate` is what the thread beside the loop would have."""

    address = "script:"
    frame = FrameOfReference()

    def __init__(self, recording, steps, rate_hz, controls, wait, seed, estimates):
        self.coils = recording.coils
        self.rate_hz = rate_hz
        self.delivered = 0
        self._positions = recording.positions
        self._steps = steps
        self._controls = controls
        self._wait = wait
        self._random = np.random.default_rng(seed)
        self._estimates = estimates
        self._device_s = 0.0
        self._arrival_ns = time.perf_counter_ns()

    def __iter__(self):
        for step in self._steps:
            if isinstance(step, Frames):
                yield from self._frames(step)
            elif isinstance(step, Jump):
                self._device_s += step.by_s
            elif isinstance(step, Estimate):
                self._estimates.give(step.sigma)
            elif isinstance(step, NoteKind):
                yield SourceNote(step, step.value, self._arrival_ns, 1)
            elif isinstance(step, Command):
                yield SourceNote(
                    NoteKind.COMMAND, "", self._arrival_ns, command=step.name, values=step.values
                )
            elif isinstance(step, Control):
                self._controls.put(replace(step, time_ns=self._arrival_ns))
            else:
                self._wait()

    def _frames(self, step):
        coils = list(step.coils)
        for k in range(step.count):
            positions = self._positions[self.delivered % FRAMES].copy()
            if step.wrong == "missing":
                positions[coils] = np.nan
            elif step.wrong == "wild":
                positions[coils] += self._random.normal(scale=30.0, size=(len(coils), 3))
            elif step.wrong == "off":
                positions[coils] += [0.0, 12.0, 25.0]
            elif step.wrong == "still":
                positions[coils] = 1.25
            elif step.wrong == "huge":
                positions[coils] = 1e30
            elif step.wrong == "outlier" and k % 17 == 5:
                positions[coils] += 60.0
            self._device_s += 1.0 / self.rate_hz
            if k % step.together == 0:
                self._arrival_ns += round(step.together * SECOND_NS / self.rate_hz)
            self.delivered += 1
            yield CoilFrame(positions, self._device_s, self.delivered, self._arrival_ns)

    def stop(self):
        pass

    def close(self):
        pass


class Estimates:
    """Stands in for `BackgroundSpeaker`: an estimate comes when the script says so."""

    latest = None

    def __init__(self, speaker):
        self._speaker = speaker

    def give(self, sigma):
        @dataclass(frozen=True)
        class Estimated:
            weights: np.ndarray
            frames: int = 10

        self.latest = Estimated(self._speaker.mean + sigma * self._speaker.sigma)

    def add(self, coils):
        pass


@pytest.fixture(scope="module")
def recordings(small_model):
    found = {}
    for rate_hz in RATES_HZ:
        recording, setup = made_up_recording(small_model, FRAMES, rate_hz)
        noise = np.random.default_rng(1).normal(scale=0.3, size=recording.positions.shape)
        session = replace(setup.session, coils=dict(zip(recording.coils, ROLES, strict=True)))
        found[rate_hz] = (
            replace(recording, positions=recording.positions + noise),
            replace(setup, session=session, roles=ROLES),
        )
    return found


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    steps=SCRIPTS,
    rate_hz=st.sampled_from(RATES_HZ),
    free=st.booleans(),
    joint=st.booleans(),
    fix_after_s=st.sampled_from([None, 0.05, 0.3]),
    whole=st.booleans(),
    served=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_take_of_any_run_comes_again_bit_for_bit(
    small_model, recordings, tmp_path_factory, steps, rate_hz, free, joint, fix_after_s, whole, served, seed
):
    recording, setup = recordings[rate_hz]
    if served:
        setup = setup_for_points(small_model, recording.coils, setup.vertices, setup.session)
    if free:
        setup = replace(setup, session=replace(setup.session, speaker_weights=None))
    folder = tmp_path_factory.mktemp("takes")
    tracker = Tracker(small_model, setup, rate_hz, watchful=not served, fix_after_s=fix_after_s)
    controls, estimates = ControlQueue(), Estimates(small_model.speaker)
    source = Played(recording, steps, rate_hz, controls, lambda: keeper.wait(), seed, estimates)
    keeper = TakeKeeper(
        folder / "take.xdf" if whole else folder / "takes",
        lambda frame: take_info(source, frame, small_model, tracker.setup, rate_hz),
    )
    summary = LiveRun(
        source,
        tracker,
        stream_info(small_model, setup, rate_hz),
        LiveStatus(setup.roles),
        keeper=keeper,
        controls=controls,
        background=estimates if joint else None,
        fix_after_s=fix_after_s or 0.2,
        handles=obey_client if served else None,
    ).run()
    assert summary.frames == source.delivered
    for kept in summary.takes:
        take = read_take(kept.path)
        assert take.complete and not kept.failure
        assert take.frame_count == kept.frames
        if kept.frames:
            assert not np.isinf(take.pose).any()
            poses = take.poses()
            assert np.isfinite(poses.weights).all() and np.isfinite(poses.speaker_weights).all()
            again = retrack(take, small_model)
            assert again.same, (kept.path, again.differing[:5], take.sessions)
    if whole and source.delivered and not any(isinstance(step, Control) for step in steps):
        assert [kept.frames for kept in summary.takes] == [source.delivered]
