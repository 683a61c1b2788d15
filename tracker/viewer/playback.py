"""A take's moments in time: where playback stands, and the pose between two frames. No clock and no window."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ... import InputError
from ..pose import FloatArray
from .scene import Moment, Moments

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
BRIDGED_S = 0.1
"""Poses are interpolated over at most so long, or three frames of a slower source: what was lost is not made up."""


def check_times(times_s: FloatArray, name: str) -> None:
    """Raises InputError where times (frames,) do not go forwards; name: of the file."""
    if not np.isfinite(times_s).all():
        raise InputError(f"{name}: frame {int(np.argmin(np.isfinite(times_s)))} has no time.")
    if len(back := np.flatnonzero(np.diff(times_s) < 0)):
        frame = int(back[0])
        raise InputError(
            f"{name}: frame {frame + 1} comes at {times_s[frame + 1]:g} s, before frame {frame} at {times_s[frame]:g} s."
        )


def frame_at(times_s: FloatArray, time_s: float) -> int:
    """The last frame that is not later, the first one before all of them."""
    return max(int(np.searchsorted(times_s, time_s, side="right")) - 1, 0)


def moment_at(moments: Moments, time_s: float) -> Moment:
    """The moment of any time (s, as the file counts it): between two frames everything that is linear is interpolated.

    Before the first frame and after the last one it is that frame's; across a gap, the frame's before the gap. What
    is not linear, status and coil states, is the earlier frame's. A coil that one of the two frames lacks is missing.
    """
    times = moments.times_s
    frame = frame_at(times, time_s)
    first = moments[frame]
    if frame + 1 >= len(times) or time_s <= times[frame]:
        return first
    step_s = times[frame + 1] - times[frame]
    if step_s > max(BRIDGED_S, 3 * moments.step_s):
        return first
    share = (time_s - times[frame]) / step_s
    second = moments[frame + 1]

    def between(one: FloatArray, other: FloatArray) -> FloatArray:
        return np.asarray(one + share * (other - one))

    return Moment(
        between(first.weights, second.weights),
        between(first.normalised, second.normalised),
        between(first.speaker_weights, second.speaker_weights),
        between(first.coils, second.coils),
        between(first.residuals_mm, second.residuals_mm),
        first.coil_states,
        first.status,
        first.residual_mm + share * (second.residual_mm - first.residual_mm),
        time_s,
    )


@dataclass(frozen=True)
class Ghost:
    """A tongue to compare with: one moment of a take, or all of it, again and again.

    at_s: the moment's time, as its file counts it; None = all of it.
    """

    moments: Moments
    at_s: float | None = None

    def at(self, elapsed_s: float) -> Moment:
        """elapsed_s: since what it is compared with began."""
        times = self.moments.times_s
        if self.at_s is not None:
            return moment_at(self.moments, self.at_s)
        length_s = float(times[-1] - times[0])
        return moment_at(self.moments, float(times[0]) + (elapsed_s % length_s if length_s > 0 else 0.0))


@dataclass
class Playback:
    """Where playback stands.

    times_s: (frames,) s, not falling. time_s: now, as the file counts it; speed: 1 = as it was recorded, one of
    `SPEEDS`; looping: whether the end is followed by the beginning.
    """

    times_s: FloatArray
    playing: bool = True
    looping: bool = True
    speed: float = 1.0
    time_s: float = field(init=False)

    def __post_init__(self) -> None:
        self.time_s = self.begin_s

    @property
    def begin_s(self) -> float:
        return float(self.times_s[0])

    @property
    def end_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def frame(self) -> int:
        return frame_at(self.times_s, self.time_s)

    @property
    def share(self) -> float:
        """How far it is through, 0 to 1."""
        length_s = self.end_s - self.begin_s
        return (self.time_s - self.begin_s) / length_s if length_s > 0 else 0.0

    def advance(self, seconds: float) -> None:
        """So much time has passed for the viewer. At the end it begins again or stops."""
        if not self.playing:
            return
        self.time_s += seconds * self.speed
        if self.time_s <= self.end_s:
            return
        length_s = self.end_s - self.begin_s
        if self.looping and length_s > 0:
            self.time_s = self.begin_s + (self.time_s - self.begin_s) % length_s
        else:
            self.time_s, self.playing = self.end_s, False

    def toggle(self) -> None:
        """Pauses, or goes on; from the end, from the beginning."""
        if not self.playing and self.time_s >= self.end_s:
            self.time_s = self.begin_s
        self.playing = not self.playing

    def step(self, frames: int) -> None:
        """Pauses at the frame so many after this one (negative: before), not beyond the ends."""
        self.playing = False
        last = len(self.times_s) - 1
        self.time_s = float(self.times_s[min(max(self.frame + frames, 0), last)])

    def seek(self, share: float) -> None:
        """To a place in the take, 0 = its beginning, 1 = its end; whether it plays does not change."""
        self.time_s = self.begin_s + min(max(share, 0.0), 1.0) * (self.end_s - self.begin_s)

    def faster(self, steps: int) -> None:
        """So many `SPEEDS` faster (negative: slower), not beyond the ends."""
        place = SPEEDS.index(self.speed) + steps
        self.speed = SPEEDS[min(max(place, 0), len(SPEEDS) - 1)]
