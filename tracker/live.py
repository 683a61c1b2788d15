"""The loop: frame in, pose out, datagram sent, in one thread; and what can be said of a run afterwards."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from ..drivers.frames import CoilFrame, Recording
from ..drivers.replay import ReplaySource
from ..model.multilinear import TongueModel
from .latency import NS_PER_MS, NS_PER_US, latency_histogram, percentiles_text, residual_histogram
from .pose import PoseStatus, TrackedPose
from .setup import Setup
from .streams.osc import OscSink
from .streams.sink import Sink, StreamInfo
from .tracking import Tracker


class Source(Protocol):
    """Where frames come from. Iterating waits for the next frame and ends when the source is closed."""

    @property
    def rate_hz(self) -> float: ...

    def __iter__(self) -> Iterator[CoilFrame]: ...

    def close(self) -> None:
        """May be called from another thread or a signal handler."""


class LiveStatus:
    """The numbers of a run so far. The loop writes them; a slower thread may read them at any time.

    missing_frames: how many frame numbers the source left out, in `gaps` places.
    coils_missing: (n,) frames in which each coil was absent; statuses: frames of each `PoseStatus`.
    """

    def __init__(self, coils: int, sinks: Sequence[Sink] = ()) -> None:
        self.frames = 0
        self.first_arrival_ns = self.last_arrival_ns = 0
        self.first_device_s = self.last_device_s = 0.0
        self.statuses = [0] * len(PoseStatus)
        self.status: int = PoseStatus.LOST
        self.valid_coils = 0
        self.residual_mm = float("nan")
        self.gaps = 0
        self.missing_frames = 0
        self.solve_ns = latency_histogram()
        self.arrival_to_sent_ns = latency_histogram()
        self.residuals = residual_histogram()
        self.coils_missing = np.zeros(coils, np.int64)
        self.sinks = tuple(sinks)
        self._absent = np.zeros(coils, np.bool_)
        self._last_number = 0

    def add(self, pose: TrackedPose, before_ns: int, sent_ns: int) -> None:
        """Counts one frame that was handed to the solver at `before_ns` and had left at `sent_ns`."""
        if self.frames == 0:
            self.first_arrival_ns = pose.arrival_ns
            self.first_device_s = pose.device_time_s
        elif pose.frame_number != self._last_number + 1:
            self.gaps += 1
            self.missing_frames += max(0, pose.frame_number - self._last_number - 1)
        self._last_number = pose.frame_number
        self.last_arrival_ns = pose.arrival_ns
        self.last_device_s = pose.device_time_s
        self.statuses[pose.status] += 1
        self.status = pose.status
        self.valid_coils = pose.valid_coils
        self.residual_mm = pose.residual_mm
        if pose.valid_coils:
            self.residuals.add(pose.residual_mm)
        np.isnan(pose.residuals_mm, out=self._absent)
        self.coils_missing += self._absent
        self.solve_ns.add(pose.solved_ns - before_ns)
        self.arrival_to_sent_ns.add(sent_ns - pose.arrival_ns)
        self.frames += 1

    @property
    def dropped(self) -> int:
        return sum(sink.dropped for sink in self.sinks)


@dataclass(frozen=True)
class SinkSummary:
    destination: str
    sent: int
    dropped: int


Percentiles = dict[str, float | int | None]


@dataclass(frozen=True)
class Summary:
    """What a run was like. Percentiles are dicts of p50, p99, max and count; None = nothing to tell.

    duration_s, rate_hz: by this host's clock; stream_s: by the device's. solve_us: one tracker step;
    arrival_to_sent_ms: from the frame's arrival until every sink had it; lateness_ms: how late a paced
    replay handed the frames over, which is before their arrival. coils: share of frames with each coil.
    """

    model: str
    frames: int
    duration_s: float
    stream_s: float
    rate_hz: float | None
    nominal_rate_hz: float
    speaker_fixed: bool
    solve_us: Percentiles
    arrival_to_sent_ms: Percentiles
    lateness_ms: Percentiles | None
    residual_mm: dict[str, float | None]
    status_shares: dict[str, float]
    coils: dict[str, float]
    gaps: int
    missing_frames: int
    sinks: tuple[SinkSummary, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, text, lists and dicts, without NaN."""
        return {**asdict(self), "sinks": [asdict(sink) for sink in self.sinks]}

    def __str__(self) -> str:
        rate = f" ({self.rate_hz:.1f} a second)" if self.rate_hz else ""
        shares = ", ".join(
            f"{name} {100 * share:.1f} %" for name, share in self.status_shares.items() if share
        )
        coils = ", ".join(f"{role} {100 * share:.0f} %" for role, share in self.coils.items())
        mean, median = self.residual_mm["mean"], self.residual_mm["median"]
        lines = [
            f"frames           {self.frames} in {self.duration_s:.2f} s{rate}",
            f"status           {shares or 'no frame arrived'}",
            f"solve            {percentiles_text(self.solve_us, 'us')}",
            f"arrival to sent  {percentiles_text(self.arrival_to_sent_ms, 'ms')}",
        ]
        if self.lateness_ms is not None:
            lines.append(f"replay late by   {percentiles_text(self.lateness_ms, 'ms')}")
        if mean is not None and median is not None:
            lines.append(f"residual         mean {mean:.3f} mm, median {median:.3f} mm")
        lines.append(f"coils valid      {coils}")
        lines.append(f"source gaps      {self.gaps} ({self.missing_frames} frames missing)")
        for sink in self.sinks:
            lines.append(f"sent             {sink.sent} to {sink.destination}, {sink.dropped} dropped")
        return "\n".join(lines)


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
    source: Source,
    tracker: Tracker,
    info: StreamInfo,
    sinks: Sequence[Sink] = (),
    status: LiveStatus | None = None,
    seconds: float | None = None,
) -> Summary:
    """Tracks until the source ends or is closed, or has delivered `seconds` by its own clock.

    Everything is compiled, built and looked up before the first frame is asked for. From then on the
    loop takes no lock, writes no log and keeps nothing; Python's cyclic garbage collector sleeps until the
    end. The sinks stay open: they belong to the caller. To stop from elsewhere, close the source.
    """
    status = status or LiveStatus(len(info.roles), sinks)
    tracker.warm_up()
    for sink in sinks:
        sink.start(info)
    with sleeping_collector():
        _loop(source, tracker, tuple(sinks), status, float("inf") if seconds is None else seconds)
    return _summary(source, info, status)


def stream_recording(
    recording: Recording,
    model: TongueModel,
    setup: Setup,
    destination: str,
    realtime: bool = True,
    seconds: float | None = None,
    watch: Callable[[Source, LiveStatus], AbstractContextManager[object]] | None = None,
) -> Summary:
    """Tracks a recording frame by frame and sends the poses over OSC, at its own pace or as fast as possible.

    destination: HOST:PORT; raises InputError where it is not one. seconds: of the recording's time, which
    begins again where it is shorter; None plays it once. watch: entered around the run with its source
    and its status, as `cli.watching.watched`, which shows a status line and ends the run at Ctrl-C.
    """
    tracker = Tracker(model, setup)
    source = ReplaySource(recording, speed=1.0 if realtime else None, loop=seconds is not None)
    sink = OscSink(destination)
    status = LiveStatus(len(setup.roles), [sink])
    try:
        with watch(source, status) if watch else nullcontext():
            return run_live(
                source, tracker, stream_info(model, setup, source.rate_hz), [sink], status, seconds
            )
    finally:
        source.close()
        sink.close()


@contextmanager
def sleeping_collector() -> Iterator[None]:
    """Collects once, then keeps Python's cyclic garbage collector off; afterwards it is as it was."""
    was_enabled = gc.isenabled()
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


def _loop(
    source: Source, tracker: Tracker, sinks: tuple[Sink, ...], status: LiveStatus, seconds: float
) -> None:
    clock, step, add = time.perf_counter_ns, tracker.step, status.add
    last_s: float | None = None  # device time from which no further frame is wanted
    for frame in source:
        before_ns = clock()
        pose = step(frame)
        for sink in sinks:
            sink.send(pose)
        add(pose, before_ns, clock())
        if last_s is None:
            last_s = frame.device_time_s + seconds - 1.0 / source.rate_hz - 1e-6
        if frame.device_time_s >= last_s:
            break


def _summary(source: Source, info: StreamInfo, status: LiveStatus) -> Summary:
    frames = status.frames
    duration_s = (status.last_arrival_ns - status.first_arrival_ns) * 1e-9
    late: Percentiles | None = None
    if isinstance(source, ReplaySource) and source.speed is not None:
        histogram = latency_histogram()
        for lateness_ns in source.lateness_ns[source.lateness_ns >= 0].tolist():
            histogram.add(lateness_ns)
        late = histogram.as_dict(NS_PER_MS)
    return Summary(
        model=info.model_name,
        frames=frames,
        duration_s=duration_s,
        stream_s=status.last_device_s - status.first_device_s,
        rate_hz=(frames - 1) / duration_s if frames > 1 and duration_s > 0 else None,
        nominal_rate_hz=info.rate_hz,
        speaker_fixed=info.speaker_fixed,
        solve_us=status.solve_ns.as_dict(NS_PER_US),
        arrival_to_sent_ms=status.arrival_to_sent_ns.as_dict(NS_PER_MS),
        lateness_ms=late,
        residual_mm={"mean": status.residuals.mean, "median": status.residuals.percentile(50.0)},
        status_shares={
            state.name.lower(): status.statuses[state] / frames if frames else 0.0 for state in PoseStatus
        },
        coils={
            role: 1.0 - int(missing) / frames if frames else 0.0
            for role, missing in zip(info.roles, status.coils_missing, strict=True)
        },
        gaps=status.gaps,
        missing_frames=status.missing_frames,
        sinks=tuple(SinkSummary(sink.destination, sink.sent, sink.dropped) for sink in status.sinks),
    )
