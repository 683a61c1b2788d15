"""A time for every frame of a device that has a frame counter and no clock."""

from __future__ import annotations

from collections import deque

LEARN_S = 0.5
LEARN_FRAMES = 4
"""Until so much has been seen, a frame's time is that of its arrival."""
SECTION_S = 1.0
"""The pace is held for so long, then corrected: within a section equal counts take equal times."""
CATCH_UP_S = 4.0
"""An offset is worked off in about this time ..."""
PACE_LIMIT = 0.01
"""... but never by running faster or slower than by this share."""
EARLY_S, LATE_S = 0.1, 0.25
"""A frame that arrives earlier than its number allows by more belongs to a counter that jumped ahead; a whole
section that arrives later by more, to one that fell back."""
BASELINE_SECTIONS = 64


class NumberClock:
    """Predicts each frame's time from its number; the host's arrival times only steer, slowly.

    Times are on the host's `time.perf_counter`, in s, and never go back. A frame can be late by any delay but
    never early: so the line through the earliest arrivals is the one that is followed, and it converges to
    the time of the measurement plus the shortest delay on the way. The rate is told by the earliest arrivals
    of the latest 64 s: it is as exact as their scatter, divided by that time.

    A counter that goes back, or ahead of what the host's time allows, is taken up anew where the host is.
    """

    def __init__(self) -> None:
        self._slope_s = 0.0  # s a count; 0.0 = not known
        self._learning: list[tuple[int, float]] = []
        self._earliest: deque[tuple[int, float]] = deque(maxlen=BASELINE_SECTIONS)
        self._last: tuple[int, float] | None = None
        self._base = (0, 0.0)
        self._pace_s = 0.0
        self._section_from_s = 0.0
        self._best: tuple[float, int, float] | None = None

    @property
    def counts_per_s(self) -> float:
        """0.0 while it is not known."""
        return 1.0 / self._slope_s if self._slope_s else 0.0

    def time_s(self, number: int, arrival_ns: int) -> float:
        """The time of the frame with this number, which arrived at that `time.perf_counter_ns()`."""
        arrival_s = arrival_ns * 1e-9
        if self._last is None or number < self._last[0]:
            time_s = self._anchor(number, arrival_s)
        elif number == self._last[0]:
            return self._last[1]
        elif not self._slope_s:
            time_s = self._learn(number, arrival_s)
        else:
            time_s = self._follow(number, arrival_s)
        self._last = (number, time_s)
        return time_s

    def _anchor(self, number: int, arrival_s: float) -> float:
        """Takes the count up here and now; a known rate is kept."""
        time_s = arrival_s if self._last is None else max(arrival_s, self._last[1])
        self._base, self._pace_s = (number, time_s), self._slope_s
        self._learning = [(number, arrival_s)]
        self._earliest.clear()
        self._section_from_s, self._best = arrival_s, None
        return time_s

    def _learn(self, number: int, arrival_s: float) -> float:
        time_s = arrival_s if self._last is None else max(arrival_s, self._last[1])
        self._learning.append((number, arrival_s))
        first_number, first_s = self._learning[0]
        if arrival_s - first_s >= LEARN_S and len(self._learning) >= LEARN_FRAMES:
            self._slope_s = (arrival_s - first_s) / (number - first_number)
            self._pace_s = self._slope_s
            self._base = (number, time_s)
            self._earliest.append(min(self._learning, key=lambda seen: seen[1] - seen[0] * self._slope_s))
            self._learning.clear()
            self._section_from_s = arrival_s
        return time_s

    def _follow(self, number: int, arrival_s: float) -> float:
        time_s = self._base[1] + (number - self._base[0]) * self._pace_s
        late_s = arrival_s - time_s
        if late_s < -EARLY_S:
            return self._anchor(number, arrival_s)
        if self._best is None or late_s < self._best[0]:
            self._best = (late_s, number, arrival_s)
        if arrival_s - self._section_from_s >= SECTION_S:
            if self._best[0] > LATE_S:  # not one frame of the section fits: the count itself fell back
                return self._anchor(number, arrival_s)
            self._end_section(self._best, number, time_s, arrival_s)
        return time_s

    def _end_section(
        self, best: tuple[float, int, float], number: int, time_s: float, arrival_s: float
    ) -> None:
        late_s, best_number, best_s = best
        self._earliest.append((best_number, best_s))
        first_number, first_s = self._earliest[0]
        if best_number > first_number and best_s > first_s:
            self._slope_s = (best_s - first_s) / (best_number - first_number)
        correction = max(-PACE_LIMIT, min(PACE_LIMIT, late_s / CATCH_UP_S))
        self._pace_s = self._slope_s * (1.0 + correction)
        self._base = (number, time_s)
        self._section_from_s, self._best = arrival_s, None
