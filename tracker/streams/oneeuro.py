"""The one-euro filter (Casiez, Roussel and Vogel, CHI 2012): calm when slow, prompt when fast.

For what is shown or drives an avatar. Recordings are never filtered.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ... import InputError
from ..pose import FloatArray

LONGEST_STEP_S = 1.0
"""After a longer pause the filter starts anew: what came before says nothing of what comes now."""


class OneEuro:
    """Filters each number of a vector by itself: a low pass whose cut-off is min_cutoff_hz + beta |speed|.

    min_cutoff_hz: above 0; lower = calmer at rest; infinity = off, what goes in comes out. beta: 0 or more, in Hz for a
    speed of one unit a second; higher = less lag in fast movements. d_cutoff_hz: above 0, of the low pass that the
    speed goes through. Every value counts at once: no dead zone, no threshold. Raises InputError for other settings.
    """

    def __init__(self, min_cutoff_hz: float = math.inf, beta: float = 0.0, d_cutoff_hz: float = 1.0) -> None:
        if not min_cutoff_hz > 0:
            raise InputError(f"one-euro filter: a lowest cut-off of {min_cutoff_hz:g} Hz; expected above 0.")
        if not 0 <= beta < math.inf:
            raise InputError(f"one-euro filter: beta = {beta:g}; expected a finite number, 0 or more.")
        if not 0 < d_cutoff_hz < math.inf:
            raise InputError(f"one-euro filter: a speed cut-off of {d_cutoff_hz:g} Hz; expected above 0.")
        self.min_cutoff_hz = min_cutoff_hz
        self.beta = beta
        self.d_cutoff_hz = d_cutoff_hz
        self.forget()

    @property
    def off(self) -> bool:
        return math.isinf(self.min_cutoff_hz)

    def forget(self) -> None:
        """The next vector is taken for the first."""
        self._time_s = math.nan
        self._raw = np.zeros(0)
        self._speed = np.zeros(0)
        self._smooth = np.zeros(0)

    def __call__(self, values: ArrayLike, time_s: float) -> FloatArray:
        """The filtered values (n,) at a time, s, on any clock; a new array.

        The first vector comes out as it went in, and so does one after a pause of more than a second, after time ran
        backwards, or of another length. At the time of the vector before, the answer is the one before. A number that
        is not finite is passed on, and its own filter starts anew behind it.
        """
        raw = np.array(values, dtype=np.float64)
        step_s = time_s - self._time_s
        if self.off:
            return raw
        if raw.shape != self._raw.shape or not 0 <= step_s <= LONGEST_STEP_S:
            self._time_s, self._raw, self._smooth = time_s, raw, raw.copy()
            self._speed = np.zeros_like(raw)
            return raw.copy()
        if step_s == 0:
            return self._smooth.copy()
        known = np.isfinite(raw) & np.isfinite(self._smooth)
        with np.errstate(invalid="ignore"):
            speed = self._speed + _share(self.d_cutoff_hz, step_s) * (
                (raw - self._raw) / step_s - self._speed
            )
            cutoff_hz = self.min_cutoff_hz + self.beta * np.abs(speed)
            smooth = self._smooth + _share(cutoff_hz, step_s) * (raw - self._smooth)
        self._speed = np.where(known, speed, 0.0)
        self._smooth = np.where(known, smooth, raw)
        self._time_s, self._raw = time_s, raw
        return self._smooth.copy()


def _share(cutoff_hz: FloatArray | float, step_s: float) -> FloatArray | float:
    """How much of the newest value counts (equations 1 and 2 of the paper)."""
    turned = 2.0 * math.pi * step_s * cutoff_hz
    return turned / (turned + 1.0)
