"""A recording played as if a device were sending it."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

import numpy as np

from .. import InputError
from .frames import CoilFrame, FrameOfReference, Recording

_NAP_S = 0.1  # close() from another thread ends a long wait within this time


class ReplaySource:
    """Coil frames of a recording, paced by the recording's own times or as fast as they are taken.

        with ReplaySource(recording, speed=1.0) as source:
            for frame in source:
                ...

    speed: 1.0 is real time, 2.0 twice as fast; None delivers without waiting.
    loop: begin again after the last frame, until closed. Times and frame numbers go on increasing: one
    pass is as long as the recording plus one sampling interval.
    A take's own device times and frame numbers are delivered as they were recorded, jumps and all, unless
    it loops; the pace is that of its `times_s`.

    The first frame is due at once and sets the clock: frame i is due (times_s[i] - times_s[0]) / speed
    after it, so that a slow reader or a late wake-up never shifts the rest. A reader that falls behind
    gets the frames that are due without waiting; none is left out.
    Positions of a frame are a read-only view of the recording. `arrival_ns` is `time.perf_counter_ns()`
    at the hand-over; how late that was is in `lateness_ns`.
    """

    def __init__(
        self, recording: Recording, speed: float | None = 1.0, loop: bool = False, address: str = ""
    ) -> None:
        if speed is not None and not 0 < speed < float("inf"):
            raise InputError(
                f"speed {speed!r} is not possible; pass a factor above 0, or None for no pacing."
            )
        if recording.frame_count == 0:
            raise InputError(f"{recording.source or 'recording'}: no frames to play.")
        self.recording = recording
        self.address = address or f"replay:{recording.source}"
        self.speed = speed
        self.loop = loop
        self.lateness_ns = np.full(recording.frame_count, -1, np.int64)
        """(frames,) how long after its due time each frame was handed over in its latest pass; -1 = never."""
        self._positions = recording.positions.view()
        self._positions.flags.writeable = False
        self._times: list[float] = recording.times_s.tolist()
        self._device_times = _list(recording.device_times_s) if not loop else None
        self._numbers = _list(recording.frame_numbers) if not loop else None
        self._pass_s = self._times[-1] - self._times[0] + 1.0 / recording.rate_hz
        self._next = 0
        self._passes = 0
        self._start_ns = 0
        self._closed = False

    @property
    def coils(self) -> tuple[str, ...]:
        return self.recording.coils

    @property
    def rate_hz(self) -> float:
        return self.recording.rate_hz * (self.speed or 1.0)

    @property
    def frame(self) -> FrameOfReference:
        return self.recording.frame

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def stop(self) -> None:
        """End the replay; a reader that waits for a frame stops within 0.1 s. May be called from a signal handler."""
        self._closed = True

    def close(self) -> None:
        """As `stop`: there is nothing to take leave of."""
        self._closed = True

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> CoilFrame:
        if self._next == len(self._times):
            if not self.loop:
                raise StopIteration
            self._next = 0
            self._passes += 1
        index = self._next
        since_start_s = self._passes * self._pass_s
        due_ns = 0
        if self.speed is not None:
            if self._start_ns == 0:
                self._start_ns = time.perf_counter_ns()
            offset_s = (since_start_s + self._times[index] - self._times[0]) / self.speed
            due_ns = self._start_ns + int(offset_s * 1e9)
            self._wait_until(due_ns)
        if self._closed:
            raise StopIteration
        self._next = index + 1
        number = self._passes * len(self._times) + index
        device_time_s = since_start_s + self._times[index]
        if self._device_times is not None:
            device_time_s = self._device_times[index]
        if self._numbers is not None:
            number = self._numbers[index]
        recording = self.recording
        arrival_ns = time.perf_counter_ns()
        self.lateness_ns[index] = arrival_ns - due_ns if self.speed is not None else 0
        return CoilFrame(
            self._positions[index],
            device_time_s,
            number,
            arrival_ns,
            None if recording.quaternions is None else recording.quaternions[index],
            None if recording.rms is None else recording.rms[index],
            None if recording.status is None else recording.status[index],
        )

    def _wait_until(self, due_ns: int) -> None:
        while not self._closed and (left_ns := due_ns - time.perf_counter_ns()) > 0:
            time.sleep(min(left_ns * 1e-9, _NAP_S))


def _list(values: np.ndarray | None) -> list[Any] | None:
    return None if values is None else values.tolist()
