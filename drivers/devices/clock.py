"""What a device's frame numbers and times say about frames that were lost, doubled or out of order."""

from __future__ import annotations

from collections import Counter, deque
from enum import Enum

RESET_BACK_S = 0.2
"""A device time that goes back by more begins a new count; by less, the frame is a late one."""
RESET_BACK_FRAMES = 64
"""The same for a device without a clock."""
RESET_APART_S = 0.5
"""Number and time that go on by amounts that differ by more: the number jumped, nothing is missing."""
LONGEST_GAP_S = 60.0
LEARN_FROM = 48  # the latest differences decide what the step is
SURE_AFTER = 3
COMMON = 6  # a step that fewer than one in so many have is no common one


class Verdict(Enum):
    NEXT = "next"
    GAP = "gap"  # next, but `missing` frames were left out before it
    DUPLICATE = "duplicate"
    LATE = "late"  # older than one that was delivered already
    RESET = "reset"


class FrameClock:
    """Judges each frame by its number and its device time, learning the step of both.

    Numbers grow by 1 on some devices and by 8 on others, or stand still; times are frame counts in other
    units, stand still, or jump back where a file behind the device begins again. Whichever of the two moves
    is believed, numbers first. `missing` is the number of frames left out before the last one judged.
    """

    def __init__(self) -> None:
        self.missing = 0
        self._number_steps: deque[float] = deque(maxlen=LEARN_FROM)
        self._time_steps: deque[float] = deque(maxlen=LEARN_FROM)
        self._step = 0
        self._period_s = 0.0
        self.restart()

    def restart(self) -> None:
        """Forgets the last frame, not the steps: after a new connection any number may come."""
        self._last: tuple[int, float] | None = None
        self.missing = 0

    @property
    def step(self) -> int:
        """What the number grows by from frame to frame; 0 = not known, or it stands still."""
        return self._step

    @property
    def period_s(self) -> float:
        """What the device time grows by from frame to frame; 0.0 = not known, or it stands still."""
        return self._period_s

    def judge(self, number: int, time_s: float) -> Verdict:
        """The frame's place after the one judged before; a duplicate or late frame changes nothing."""
        self.missing = 0
        if self._last is None:
            self._last = (number, time_s)
            return Verdict.NEXT
        by, by_s = number - self._last[0], time_s - self._last[1]
        if by == 0 and by_s == 0.0:
            # A device whose two clocks both stand still sends frames all the same.
            return Verdict.DUPLICATE if self._number_steps or self._time_steps else Verdict.NEXT
        verdict = self._moved(by, by_s)
        if verdict in (Verdict.NEXT, Verdict.GAP, Verdict.RESET):
            self._last = (number, time_s)
        return verdict

    def _moved(self, by: int, by_s: float) -> Verdict:
        back = by < 0 or (by == 0 and by_s < 0)
        if back or by_s < -RESET_BACK_S:
            # Of a late frame neither goes on; a number that goes back while time goes on is a new count.
            near = -RESET_BACK_S <= by_s <= 0 and by >= -RESET_BACK_FRAMES * max(1, self._step)
            return Verdict.LATE if near else Verdict.RESET
        if by_s > LONGEST_GAP_S:
            return Verdict.RESET
        if by > 0:
            frames = round(by / self._step) if self._step else 1
            if by_s > 0 and self._period_s and frames * self._period_s - by_s > RESET_APART_S:
                return Verdict.RESET
            self._step = int(_learned(self._number_steps, by, self._step))
        elif by_s > 0:
            frames = round(by_s / self._period_s) if self._period_s else 1
        else:
            frames = 1
        if by_s > 0:
            self._period_s = _learned(self._time_steps, round(by_s, 6), self._period_s)
        self.missing = max(0, frames - 1)
        return Verdict.GAP if self.missing else Verdict.NEXT


def _learned(steps: deque[float], step: float, before: float) -> float:
    """The commonest of the latest steps, the smaller one where two are equally common; where hardly two are equal,
    as those of a clock that jitters, the one in the middle."""
    steps.append(step)
    if len(steps) < SURE_AFTER or step == before:  # one more of the commonest changes nothing
        return before
    counts = Counter(steps)
    most = max(counts.values())
    if most * COMMON < len(steps):
        return sorted(steps)[len(steps) // 2]
    return min(value for value, count in counts.items() if count == most)
