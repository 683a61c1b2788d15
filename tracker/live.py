"""The loop: frame in, pose out, datagram sent, in one thread."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from ..drivers.devices.clock import LONGEST_GAP_S
from ..drivers.devices.source import DeviceSource
from ..drivers.frames import CoilFrame, NoteKind, Recording, SourceNote
from ..drivers.replay import ReplaySource
from ..model.multilinear import TongueModel
from .control import Control, ControlQueue
from .headcorrection import ReferenceState
from .online import Tracker
from .pose import PoseStatus, TrackedPose
from .rehearsal import Rehearsal
from .session import session_toml
from .setup import Setup
from .status import LiveStatus, Summary, summarise
from .streams.osc import OscSink
from .streams.sink import Sink, StreamInfo
from .takes.layout import SOURCE_MARK, session_mark, user_mark

if TYPE_CHECKING:
    from .anatomy import SpeakerEstimate
    from .background import BackgroundSpeaker
    from .takes.keeper import TakeKeeper
    from .takes.recorder import TakeRecorder


class FrameSource(Protocol):
    """As much of `drivers.sources.Source` as the loop needs."""

    @property
    def rate_hz(self) -> float: ...

    def __iter__(self) -> Iterator[CoilFrame | SourceNote]: ...

    def stop(self) -> None:
        """May be called from another thread or a signal handler."""


def stream_info(model: TongueModel, setup: Setup, rate_hz: float) -> StreamInfo:
    """What the receivers are told about a run."""
    weights = setup.session.speaker_weights
    return StreamInfo(
        model_name=model.name,
        model_fingerprint=model.fingerprint,
        vertex_count=model.vertex_count,
        mean=model.pose.mean,
        sigma=model.pose.sigma,
        speaker_weights=model.speaker.mean if weights is None else weights,
        speaker_fixed=weights is not None,
        roles=setup.roles,
        rate_hz=rate_hz,
    )


def run_live(
    source: FrameSource,
    tracker: Tracker,
    info: StreamInfo,
    sinks: Sequence[Sink] = (),
    status: LiveStatus | None = None,
    seconds: float | None = None,
) -> Summary:
    """Tracks until the source ends or is stopped, or has delivered `seconds` by its own clock.

    Everything is compiled, built and looked up before the first frame is asked for. From then on the
    loop takes no lock, writes no log and keeps nothing; Python's cyclic garbage collector sleeps until the
    end. The sinks stay open: they belong to the caller. To stop from elsewhere, stop the source.
    """
    status = status or LiveStatus(info.roles, sinks)
    return LiveRun(source, tracker, info, status, sinks, seconds=seconds).run()


@dataclass
class LiveRun:
    """A run with everything that a user may do to it while it lasts.

    The sinks belong to the caller, who closes them; a take ends with the run. background: estimates the speaker beside the
    loop until `fix_after_s` of speech were tracked. said: called with what a person should read, from the
    loop's thread, at rare events only. handles: a command of a client that drives the source; gives the set-up
    to go on with, or None to end the run.
    """

    source: FrameSource
    tracker: Tracker
    info: StreamInfo
    status: LiveStatus
    sinks: Sequence[Sink] = ()
    keeper: TakeKeeper | None = None
    controls: ControlQueue = field(default_factory=ControlQueue)
    background: BackgroundSpeaker | None = None
    fix_after_s: float = float("inf")
    seconds: float | None = None
    said: Callable[[str], None] = lambda text: None
    handles: Callable[[SourceNote, Tracker], Setup | None] | None = None
    _followed: SpeakerEstimate | None = None  # the estimate that the tracker goes by already
    _listening: bool = True  # whether the background's next estimate will be followed
    _listened_s: float = 0.0  # tracked speech that the background was given

    def run(self) -> Summary:
        """As `run_live`."""
        self.tracker.warm_up()
        self.status.head_troubles = self._head_troubles
        for sink in self.sinks:
            sink.start(self.info)
        try:
            with undisturbed():
                self._loop()
        finally:
            if self.keeper is not None:
                self.keeper.close()
                self._say_refusal(self.keeper)
        takes = self.keeper.finished if self.keeper is not None else ()
        return summarise(self.info, self.status, _lateness(self.source), takes)

    def _loop(self) -> None:
        clock, tracker, status, keeper = time.perf_counter_ns, self.tracker, self.status, self.keeper
        step, add, sinks, controls = tracker.step, status.add, tuple(self.sinks), self.controls
        recorder: TakeRecorder | None = None
        changes = tracker.changes
        end = _End(self.seconds, 1.0 / self.source.rate_hz if self.source.rate_hz else tracker.period_s)
        rehearsal = Rehearsal(tracker, sinks)
        if isinstance(self.source, DeviceSource):
            self.source.practise = rehearsal
        for item in self.source:
            if keeper is not None:
                if status.frames == 0 and isinstance(item, CoilFrame):
                    keeper.first_frame(item)
                if keeper.recorder is not recorder:
                    recorder = self._take(keeper.recorder, item.arrival_ns)
            if not isinstance(item, CoilFrame):
                if not self._note(item, recorder):
                    break
                if item.kind is NoteKind.CLOCK_RESET:
                    end.begin_anew()
            else:
                if tracker.changes != changes:
                    changes = tracker.changes
                    self._pass_on(recorder, item.arrival_ns)
                rehearsal.frame = item
                before_ns = clock()
                pose = step(item)
                for sink in sinks:
                    sink.send(pose)
                sent_ns = clock()
                if recorder is not None:
                    recorder.put(item, tracker.coils, pose)
                    status.take_frames = recorder.frames
                    if recorder.failure is not None and not status.take_failure:
                        status.take_failure = recorder.failure
                        self.said(f"NOT RECORDING: {recorder.failure}")
                add(pose, before_ns, sent_ns)
                if end.reached(item.device_time_s):
                    break
                tracker.settle()
                if self.background is not None and self._listening:
                    self._follow(self.background)
            while (control := controls.take()) is not None:
                if not self._obey(control, recorder):
                    return
            if keeper is not None and keeper.refusal:
                self._say_refusal(keeper)

    def _say_refusal(self, keeper: TakeKeeper) -> None:
        refusal, keeper.refusal = keeper.refusal, ""
        if refusal:
            self.said(refusal)

    def _head_troubles(self) -> list[tuple[str, str]]:
        states = self.tracker.head_states.items()
        return [(role, state.name.lower()) for role, state in states if state != ReferenceState.OK]

    def _take(self, recorder: TakeRecorder | None, next_arrival_ns: int) -> TakeRecorder | None:
        """A take begins or has ended. It begins with a tracker that knows nothing, as its replay will."""
        status = self.status
        status.take_failure, status.take_frames = "", 0
        status.take_path = "" if recorder is None else str(recorder.path)
        if recorder is None:
            self.said("the take has ended")
        else:
            self.tracker.restart()
            now = session_toml(self.tracker.setup.session)
            if now != recorder.info.session_toml:  # it changed while the file was being made
                recorder.mark(session_mark(now, 0), next_arrival_ns)
            self.said(f"recording {recorder.path}")
        return recorder

    def _pass_on(self, recorder: TakeRecorder | None, next_arrival_ns: int) -> None:
        """The set-up has changed: whoever was told of it is told again, before the next frame."""
        model, setup = self.tracker.model, self.tracker.setup
        weights = setup.session.speaker_weights
        if recorder is not None:
            recorder.mark(session_mark(session_toml(setup.session), recorder.frames), next_arrival_ns)
        self.info = stream_info(model, setup, self.info.rate_hz)
        for sink in self.sinks:
            sink.change(self.info)
        if weights is None:
            self.said("the speaker is free again")
        else:
            shown = ", ".join(f"{weight:+.2f}" for weight in model.speaker.normalised(weights))
            self.said(f"speaker: {setup.session.speaker_source}; in sigma {shown}")

    def _note(self, note: SourceNote, recorder: TakeRecorder | None) -> bool:
        """What happens between frames; False ends the run."""
        status = self.status
        status.tell(note)
        if note.kind is NoteKind.COMMAND and self.handles is not None:
            setup = self.handles(note, self.tracker)
            if setup is None:
                return False
            if setup is not self.tracker.setup:
                self.tracker.change(setup)
        silent = note.kind in (NoteKind.SILENT, NoteKind.DISCONNECTED)
        # Clients that drive the source are answered for their frames only.
        if silent and status.frames and self.handles is None:
            status.silent_s = (note.arrival_ns - status.last_arrival_ns) * 1e-9
            self._show(self.tracker.idle(status.silent_s))
        if note.kind is not NoteKind.SILENT:
            if recorder is not None:
                recorder.mark(f"{SOURCE_MARK}: {note.kind.value}: {note.text}", note.arrival_ns)
            if note.kind not in (NoteKind.GAP, NoteKind.BAD_DATA):
                self.said(note.text)
        return True

    def _show(self, pose: TrackedPose) -> None:
        self.status.status = pose.status
        for sink in self.sinks:
            sink.send(pose)

    def _follow(self, background: BackgroundSpeaker) -> None:
        """Gives the background this frame, and goes by its newest estimate; the one after `fix_after_s` is the last."""
        tracker = self.tracker
        if tracker.pose.status == PoseStatus.OK:
            background.add(tracker.used)
            self._listened_s += tracker.period_s
        estimate = background.latest
        if estimate is None or estimate is self._followed:
            return
        self._followed = estimate
        self._go_by(estimate, self._listened_s >= self.fix_after_s)

    def _go_by(self, estimate: SpeakerEstimate, final: bool) -> None:
        source = f"joint estimate from {estimate.frames} frames of this run"
        self.tracker.fix_speaker(estimate.weights, source if final else f"{source}, not final")
        self._listening = not final

    def _obey(self, control: Control, recorder: TakeRecorder | None) -> bool:
        """What a user asked for; False ends the run."""
        keeper = self.keeper
        if control.kind == "quit":
            return False
        if control.kind == "mark":
            if recorder is not None:
                recorder.mark(user_mark(control.text), control.time_ns)
            self.said(
                f"mark: {control.text}" + ("" if recorder is not None else " (no take is being recorded)")
            )
        elif control.kind in ("take_start", "take_stop"):
            if keeper is None:
                self.said("no take: say where takes go with --record")
            elif control.kind == "take_start":
                keeper.start(control.text)
            else:
                keeper.stop()
        elif control.kind == "fix_speaker":
            self._fix_speaker()
        elif control.kind == "free_speaker":
            self.tracker.free_speaker()
            self._listening, self._listened_s = True, 0.0
        return True

    def _fix_speaker(self) -> None:
        """The speaker stays what it is now, or becomes the mean of what it was."""
        if self.tracker.setup.session.speaker_weights is None:
            if not self.tracker.fix_average():
                self.said("the speaker cannot be fixed yet: no frame was tracked")
                return
            self._listening = False
        elif self._listening and self._followed is not None:
            self._go_by(self._followed, final=True)


class _End:
    """Whether the source has delivered as many seconds, by its own clock, as were asked for.

    A frame whose time stands still, goes back or jumps counts as one period.
    """

    def __init__(self, seconds: float | None, period_s: float) -> None:
        self._left_s = float("inf") if seconds is None else seconds
        self._period_s = period_s
        self.begin_anew()

    def begin_anew(self) -> None:
        """The next frame's time does not follow from the last one's."""
        self._before_s = float("nan")

    def reached(self, device_time_s: float) -> bool:
        passed_s = device_time_s - self._before_s
        self._before_s = device_time_s
        self._left_s -= passed_s if 0.0 < passed_s <= LONGEST_GAP_S else self._period_s
        return self._left_s < 1e-6


def stream_recording(
    recording: Recording,
    model: TongueModel,
    setup: Setup,
    destination: str,
    realtime: bool = True,
    seconds: float | None = None,
    watch: Callable[[FrameSource, LiveStatus], AbstractContextManager[object]] | None = None,
) -> Summary:
    """Tracks a recording frame by frame and sends the poses over OSC, at its own pace or as fast as possible.

    destination: HOST:PORT; raises InputError where it is not one. seconds: of the recording's time, which
    begins again where it is shorter; None plays it once. watch: entered around the run with its source
    and its status, as `cli.watching.watched`, which shows a status line and ends the run at Ctrl-C.
    """
    tracker = Tracker(model, setup)
    source = ReplaySource(recording, speed=1.0 if realtime else None, loop=seconds is not None)
    sink = OscSink(destination)
    status = LiveStatus(setup.roles, [sink])
    try:
        with watch(source, status) if watch else nullcontext():
            return run_live(
                source, tracker, stream_info(model, setup, source.rate_hz), [sink], status, seconds
            )
    finally:
        source.close()
        sink.close()


SWITCH_S = 0.0005
"""So long another thread may keep the interpreter from the loop; Python's own choice is ten times as long."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """Collects once, then keeps Python's cyclic garbage collector off and other threads short; afterwards all is
    as it was."""
    was_enabled, before_s = gc.isenabled(), sys.getswitchinterval()
    sys.setswitchinterval(min(before_s, SWITCH_S))
    gc.collect()
    frozen_before = gc.get_freeze_count()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        if not frozen_before:
            gc.unfreeze()
        if was_enabled:
            gc.enable()
        sys.setswitchinterval(before_s)


def _lateness(source: FrameSource) -> Sequence[int] | None:
    if isinstance(source, ReplaySource) and source.speed is not None:
        late: list[int] = source.lateness_ns[source.lateness_ns >= 0].tolist()
        return late
    return None
