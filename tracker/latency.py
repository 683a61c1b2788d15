"""Histograms with a fixed number of bins, so that hours of frames cost no more memory than one."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from math import exp, log

import numpy as np
from numpy.typing import NDArray

BIN_RATIO = 1.02
"""Each bin is 2 % wider than the one below it; a percentile is therefore right to 1 %."""


class LogHistogram:
    """Counts positive values in bins of equal ratio between `low` and `high`, in any unit.

    Values outside go to the first or the last bin; `count`, `total`, `smallest` and `largest` are exact.
    One thread adds; another may read at the same time and sees counts that are at most one value apart.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low = low
        self.high = high
        self._scale = 1.0 / log(BIN_RATIO)
        self._last = int(log(high / low) * self._scale)
        self._bins = array("q", bytes(8 * (self._last + 1)))
        self.count = 0
        self.total: float = 0
        self.smallest = float("inf")
        self.largest: float = 0

    def add(self, value: float) -> None:
        """Counts one value. Cheap: no array is made, no lock is taken."""
        if value <= self.low:
            self._bins[0] += 1
        elif value >= self.high:
            self._bins[self._last] += 1
        else:
            self._bins[int(log(value / self.low) * self._scale)] += 1
        self.largest = max(self.largest, value)
        self.smallest = min(self.smallest, value)
        self.total += value
        self.count += 1

    def merge(self, other: LogHistogram) -> None:
        """Adds another histogram's counts; both must have the same bins."""
        if (self.low, self.high) != (other.low, other.high):
            raise ValueError(f"bins from {other.low} to {other.high} do not fit {self.low} to {self.high}")
        np.frombuffer(self._bins, np.int64)[:] += np.frombuffer(other._bins, np.int64)
        self.count += other.count
        self.total += other.total
        self.smallest = min(self.smallest, other.smallest)
        self.largest = max(self.largest, other.largest)

    def percentile(self, percent: float) -> float | None:
        """The value that `percent` % of the values do not exceed (1 % accurate); None without values."""
        cumulative = np.cumsum(self.counts())
        if not cumulative[-1]:
            return None
        index = int(np.searchsorted(cumulative, max(1.0, percent / 100.0 * cumulative[-1])))
        middle = self.low * exp((index + 0.5) / self._scale)
        return float(min(max(middle, self.smallest), self.largest))

    @property
    def mean(self) -> float | None:
        """None without values."""
        return self.total / self.count if self.count else None

    @property
    def maximum(self) -> float | None:
        """None without values."""
        return float(self.largest) if self.count else None

    def counts(self) -> NDArray[np.int64]:
        """(bins,) int64, a copy."""
        return np.frombuffer(self._bins, np.int64).copy()

    def as_dict(self, unit: float = 1.0) -> dict[str, float | int | None]:
        """p50, p99, max in multiples of `unit`, and count."""
        values = {"p50": self.percentile(50.0), "p99": self.percentile(99.0), "max": self.maximum}
        return {
            **{name: None if value is None else value / unit for name, value in values.items()},
            "count": self.count,
        }


def percentiles_text(values: Mapping[str, float | int | None], unit: str) -> str:
    """What `as_dict` gave, for people: three digits, and no powers of ten for a slow first frame."""
    if not values["count"]:
        return "-"
    shown = {name: values[name] or 0.0 for name in ("p50", "p99", "max")}
    return "  ".join(
        f"{name} {value:.0f} {unit}" if value >= 100 else f"{name} {value:.3g} {unit}"
        for name, value in shown.items()
    )


NS_PER_US = 1e3
NS_PER_MS = 1e6


def latency_histogram() -> LogHistogram:
    """For times in ns, from 0.1 us to 10 s."""
    return LogHistogram(1e2, 1e10)


def residual_histogram() -> LogHistogram:
    """For distances in mm, from 1 um to 1 m."""
    return LogHistogram(1e-3, 1e3)
