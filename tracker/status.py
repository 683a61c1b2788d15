"""The numbers of a live run: while it lasts, and in the summary afterwards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..drivers.frames import NoteKind, SourceNote
from .latency import (
    NS_PER_MS,
    NS_PER_US,
    LogHistogram,
    latency_histogram,
    percentiles_text,
    residual_histogram,
)
from .pose import CoilState, PoseStatus, TrackedPose
from .streams.sink import LiveNumbers, Sink, StreamInfo

if TYPE_CHECKING:
    from .takes.keeper import KeptTake

Percentiles = dict[str, float | int | None]

MISPLACED_MM = 5.0
"""A mean residual above this has no tongue that lies where the model is."""
JUDGED_FRAMES = 50
DEVICE_DRIFT = 1e-4
"""A device's clock runs at most so much faster or slower than the host's."""


class DeviceDelay:
    """How much later than the fastest frame each frame arrived: what can be known of the way from the device.

    The two clocks have no common zero, and drift apart. The least difference between arrival and device time
    stands for the shortest way; it rises slowly, so that drift does not count as delay.
    """

    def __init__(self) -> None:
        self._least_s = float("inf")
        self._last_device_s = self._last_arrival_s = float("-inf")

    def excess_ns(self, device_s: float, arrival_ns: int) -> float | None:
        """None where the device's clock stands still or has just been set back."""
        arrival_s = arrival_ns * 1e-9
        passed_s = device_s - self._last_device_s
        waited_s = arrival_s - self._last_arrival_s
        self._last_device_s, self._last_arrival_s = device_s, arrival_s
        offset_s = arrival_s - device_s
        if not 0.0 < passed_s < 10.0:
            self._least_s = offset_s
            return None
        self._least_s = min(self._least_s + DEVICE_DRIFT * waited_s, offset_s)
        return max(0.0, offset_s - self._least_s) * 1e9


class LiveStatus:
    """The numbers of a run so far. The loop writes them; a slower thread may read them at any time.

    missing_frames: how many frames the source left out, in `gaps` places, as far as it can tell.
    device_to_host_ns: what `DeviceDelay` says; host_to_solved_ns, solved_to_sent_ns, arrival_to_sent_ns: on this
    host's clock; solve_ns: one tracker step.
    coils_missing, coils_distrusted: (n,) frames in which each coil was absent, or there and did not count.
    head_troubles: asked for reference coils of the head that do not count, and why.
    coil_states: (n,) of the latest frame. silent_s: how long the source has been silent, 0.0 = it is not; away_s:
    all such silences before it together.
    """

    def __init__(self, roles: Sequence[str], sinks: Sequence[Sink] = ()) -> None:
        coils = len(roles)
        self.roles = tuple(roles)
        self.frames = 0
        self.first_arrival_ns = self.last_arrival_ns = 0
        self.first_device_s = self.last_device_s = 0.0
        self.statuses = [0] * len(PoseStatus)
        self.status: int = PoseStatus.LOST
        self.valid_coils = 0
        self.residual_mm = float("nan")
        self.gaps = 0
        self.missing_frames = 0
        self.clock_resets = 0
        self.disconnections = 0
        self.bad_data = 0
        self.silent_s = self.away_s = 0.0
        self.connected = True
        self.last_note = ""
        self.solve_ns = latency_histogram()
        self.device_to_host_ns = latency_histogram()
        self.host_to_solved_ns = latency_histogram()
        self.solved_to_sent_ns = latency_histogram()
        self.arrival_to_sent_ns = latency_histogram()
        self.residuals = residual_histogram()
        self.coils_missing = np.zeros(coils, np.int64)
        self.coils_distrusted = np.zeros(coils, np.int64)
        self.coil_states = np.full(coils, CoilState.MISSING, np.int64)
        self.head_troubles: Callable[[], list[tuple[str, str]]] = list
        self.sinks = tuple(sinks)
        self.take_path, self.take_frames, self.take_backlog, self.take_failure = "", 0, 0, ""
        self._absent = np.zeros(coils, np.bool_)
        self._distrusted = np.zeros(coils, np.bool_)
        self._delay = DeviceDelay()

    def add(self, pose: TrackedPose, before_ns: int, sent_ns: int) -> None:
        """Counts one frame that was handed to the solver at `before_ns` and had left at `sent_ns`."""
        if self.frames == 0:
            self.first_arrival_ns = pose.arrival_ns
            self.first_device_s = pose.device_time_s
        self.last_device_s = pose.device_time_s
        self.statuses[pose.status] += 1
        self.status = pose.status
        self.valid_coils = pose.valid_coils
        self.residual_mm = pose.residual_mm
        if self.silent_s > 0.0:
            self.away_s += (pose.arrival_ns - self.last_arrival_ns) * 1e-9
            self.silent_s = 0.0
        self.last_arrival_ns = pose.arrival_ns
        self.connected = True
        if pose.valid_coils:
            self.residuals.add(pose.residual_mm)
        np.isnan(pose.residuals_mm, out=self._absent)
        self.coils_missing += self._absent
        if len(pose.coil_states):
            np.greater(pose.coil_states, CoilState.MISSING, out=self._distrusted)
            self.coils_distrusted += self._distrusted
            self.coil_states[:] = pose.coil_states
        delay_ns = self._delay.excess_ns(pose.device_time_s, pose.arrival_ns)
        if delay_ns is not None:
            self.device_to_host_ns.add(delay_ns)
        self.solve_ns.add(pose.solved_ns - before_ns)
        self.host_to_solved_ns.add(pose.solved_ns - pose.arrival_ns)
        self.solved_to_sent_ns.add(sent_ns - pose.solved_ns)
        self.arrival_to_sent_ns.add(sent_ns - pose.arrival_ns)
        self.frames += 1

    def tell(self, note: SourceNote) -> None:
        """Counts what a source said."""
        if note.kind is NoteKind.GAP:
            self.gaps += 1
            self.missing_frames += note.count
        elif note.kind is NoteKind.CLOCK_RESET:
            self.clock_resets += 1
        elif note.kind is NoteKind.DISCONNECTED:
            self.disconnections += 1
            self.connected = False
        elif note.kind is NoteKind.BAD_DATA:
            self.bad_data += max(1, note.count)
        if note.kind is not NoteKind.SILENT:
            self.last_note = note.text

    @property
    def dropped(self) -> int:
        return sum(sink.dropped for sink in self.sinks)

    @property
    def numbers(self) -> LiveNumbers:
        """What the receivers of a stream are told once a second."""

        def pair(histogram: LogHistogram) -> tuple[float | None, float | None]:
            values = (histogram.percentile(50.0), histogram.percentile(99.0))
            return tuple(None if value is None else value / NS_PER_MS for value in values)  # type: ignore[return-value]

        return LiveNumbers(
            pair(self.device_to_host_ns),
            pair(self.host_to_solved_ns),
            pair(self.solved_to_sent_ns),
            self.take_path,
            self.take_frames,
            self.take_failure,
        )

    @property
    def misplaced(self) -> bool:
        """Whether the residuals are such as only data have that are not in the model's frame."""
        mean = self.residuals.mean
        return self.frames >= JUDGED_FRAMES and mean is not None and bool(mean > MISPLACED_MM)

    @property
    def troubles(self) -> list[str]:
        """What a person should know now: coils that do not count and why, a silent source, a take that fails."""
        states = [
            f"{role} {CoilState(int(state)).name.lower()}"
            for role, state in zip(self.roles, self.coil_states, strict=True)
            if state != CoilState.TRUSTED
        ]
        states += [f"{role} {word}" for role, word in self.head_troubles()]
        if self.misplaced:
            states.append(f"coils {self.residuals.mean:.0f} mm from the model: see [alignment]")
        if self.silent_s > 0.0:
            why = "silent" if self.connected else "disconnected"
            states = [f"source {why} for {self.silent_s:.0f} s"]
        if self.take_failure:
            states.insert(0, f"NOT RECORDING: {self.take_failure}")
        return states


@dataclass(frozen=True)
class SinkSummary:
    destination: str
    sent: int
    dropped: int


@dataclass(frozen=True)
class Summary:
    """What a run was like. Percentiles are dicts of p50, p99, max and count; None = nothing to tell.

    duration_s, rate_hz: by this host's clock; stream_s: by the device's. solve_us: one tracker step;
    arrival_to_sent_ms: from the frame's arrival until every sink had it, of which host_to_solved_ms and
    solved_to_sent_ms are the parts; device_to_host_ms: how much later than the fastest frame the others arrived;
    lateness_ms: how late a paced replay handed the frames over, which is before their arrival.
    away_s: how long the source was silent in all; misplaced: whether the coils are not in the model's frame.
    coils: share of frames with each coil; distrusted: share of frames in which it was there but did not count.
    """

    model: str
    frames: int
    duration_s: float
    stream_s: float
    rate_hz: float | None
    nominal_rate_hz: float
    speaker_fixed: bool
    solve_us: Percentiles
    device_to_host_ms: Percentiles
    host_to_solved_ms: Percentiles
    solved_to_sent_ms: Percentiles
    arrival_to_sent_ms: Percentiles
    lateness_ms: Percentiles | None
    residual_mm: dict[str, float | None]
    status_shares: dict[str, float]
    coils: dict[str, float]
    distrusted: dict[str, float]
    gaps: int
    missing_frames: int
    clock_resets: int
    disconnections: int
    away_s: float
    bad_data: int
    misplaced: bool
    sinks: tuple[SinkSummary, ...]
    takes: tuple[KeptTake, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, text, lists and dicts, without NaN."""
        return {
            **asdict(self),
            "sinks": [asdict(sink) for sink in self.sinks],
            "takes": [asdict(take) for take in self.takes],
        }

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
            f"  until solved   {percentiles_text(self.host_to_solved_ms, 'ms')}",
            f"  from there     {percentiles_text(self.solved_to_sent_ms, 'ms')}",
        ]
        if self.lateness_ms is not None:
            lines.append(f"replay late by   {percentiles_text(self.lateness_ms, 'ms')}")
        elif self.device_to_host_ms["count"]:
            late = percentiles_text(self.device_to_host_ms, "ms")
            lines.append(f"device to host   {late} (more than the fastest frame)")
        if mean is not None and median is not None:
            lines.append(f"residual         mean {mean:.3f} mm, median {median:.3f} mm")
        lines.append(f"coils valid      {coils}")
        if any(self.distrusted.values()):
            named = ", ".join(
                f"{role} {100 * share:.1f} %" for role, share in self.distrusted.items() if share
            )
            lines.append(f"not trusted      {named}")
        lines.append(f"source gaps      {self.gaps} ({self.missing_frames} frames missing)")
        troubles = {
            "clock resets": self.clock_resets,
            "disconnections": self.disconnections,
            "damaged pieces": self.bad_data,
        }
        told = [f"{n} {what}" for what, n in troubles.items() if n]
        if self.away_s > 0.0:
            told.append(f"{self.away_s:.1f} s without frames")
        if told:
            lines.append(f"source troubles  {', '.join(told)}")
        if self.misplaced:
            lines.append(
                "warning          residuals of this size mean that the coils are not in the model's frame; see "
                "[alignment] in docs/session.md"
            )
        for sink in self.sinks:
            lines.append(f"sent             {sink.sent} to {sink.destination}, {sink.dropped} dropped")
        for take in self.takes:
            lines.append(f"recorded         {take.frames} frames in {take.path}")
            if take.failure:
                lines.append(f"NOT RECORDED     {take.not_recorded} frames: {take.failure}")
        return "\n".join(lines)


def summarise(
    info: StreamInfo,
    status: LiveStatus,
    lateness_ns: Sequence[int] | None = None,
    takes: Sequence[KeptTake] = (),
) -> Summary:
    """The summary of a run. lateness_ns: of a paced replay, None where there is none."""
    frames = status.frames
    duration_s = (status.last_arrival_ns - status.first_arrival_ns) * 1e-9
    late: Percentiles | None = None
    if lateness_ns is not None:
        histogram = latency_histogram()
        for value in lateness_ns:
            histogram.add(value)
        late = histogram.as_dict(NS_PER_MS)

    def share(counts: np.ndarray) -> dict[str, float]:
        return {
            role: int(count) / frames if frames else 0.0
            for role, count in zip(info.roles, counts, strict=True)
        }

    return Summary(
        model=info.model_name,
        frames=frames,
        duration_s=duration_s,
        stream_s=status.last_device_s - status.first_device_s,
        rate_hz=(frames - 1) / duration_s if frames > 1 and duration_s > 0 else None,
        nominal_rate_hz=info.rate_hz,
        speaker_fixed=info.speaker_fixed,
        solve_us=status.solve_ns.as_dict(NS_PER_US),
        device_to_host_ms=status.device_to_host_ns.as_dict(NS_PER_MS),
        host_to_solved_ms=status.host_to_solved_ns.as_dict(NS_PER_MS),
        solved_to_sent_ms=status.solved_to_sent_ns.as_dict(NS_PER_MS),
        arrival_to_sent_ms=status.arrival_to_sent_ns.as_dict(NS_PER_MS),
        lateness_ms=late,
        residual_mm={"mean": status.residuals.mean, "median": status.residuals.percentile(50.0)},
        status_shares={
            state.name.lower(): status.statuses[state] / frames if frames else 0.0 for state in PoseStatus
        },
        coils=share(frames - status.coils_missing),
        distrusted=share(status.coils_distrusted),
        gaps=status.gaps,
        missing_frames=status.missing_frames,
        clock_resets=status.clock_resets,
        disconnections=status.disconnections,
        away_s=status.away_s + status.silent_s,
        bad_data=status.bad_data,
        misplaced=status.misplaced,
        sinks=tuple(SinkSummary(sink.destination, sink.sent, sink.dropped) for sink in status.sinks),
        takes=tuple(takes),
    )
