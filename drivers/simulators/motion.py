"""What a simulated device measures: a recording, over and over, in the device's own count and time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..frames import FloatArray, Recording

QUARTER_TURN = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)


@dataclass(slots=True)
class DeviceFrame:
    """One measurement. number: counted from 1 by the device; time_us: number x period, as real devices stamp.

    positions (coils, 3) mm, NaN = missing; quaternions (coils, 4) as (w, x, y, z), NaN = missing together
    with the position; with z = 0 where the recording has none, as coils with five degrees of freedom give
    them. The arrays belong to the frame.
    """

    number: int
    time_us: int
    positions: FloatArray
    quaternions: FloatArray


class SimulatedMotion:
    """Frames of a recording at `rate_hz`, resampled by the nearest frame; it begins again at its end."""

    def __init__(self, recording: Recording, rate_hz: float | None = None) -> None:
        self.coils = recording.coils
        self.rate_hz = rate_hz or recording.rate_hz
        self.period_us = round(1e6 / self.rate_hz)
        self._positions = recording.positions
        self._quaternions = recording.quaternions
        self._step = recording.rate_hz / self.rate_hz

    def frame(self, number: int) -> DeviceFrame:
        """The device's frame `number`, from 1."""
        index = round((number - 1) * self._step) % len(self._positions)
        positions = np.array(self._positions[index])
        quaternions = np.tile(QUARTER_TURN, (len(positions), 1))
        if self._quaternions is not None:
            known = np.isfinite(self._quaternions[index]).all(axis=1)
            quaternions[known] = self._quaternions[index][known]
        quaternions[np.isnan(positions[:, 0])] = np.nan
        return DeviceFrame(number, number * self.period_us, positions, quaternions)


class DeviceClock:
    """The device's own pace: frame `number` is due at start + (number - 1) x period, never drifting."""

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.start_s = time.perf_counter()

    def restart(self) -> None:
        self.start_s = time.perf_counter()

    @property
    def elapsed_s(self) -> float:
        return time.perf_counter() - self.start_s

    def due_s(self, number: int) -> float:
        """When frame `number` is measured, on `time.perf_counter`."""
        return self.start_s + (number - 1) / self.rate_hz

    def latest(self) -> int:
        """The number of the newest frame that has been measured by now; 1 at the start."""
        return 1 + max(0, int(self.elapsed_s * self.rate_hz))

    def numbers(self) -> Iterator[int]:
        """1, 2, 3, ... each when it is due; without skipping where the reader was late."""
        number = 1
        while True:
            wait_s = self.due_s(number) - time.perf_counter()
            if wait_s > 0:
                time.sleep(wait_s)
            yield number
            number += 1
