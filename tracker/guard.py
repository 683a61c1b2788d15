"""Which coils count in a frame: one that dies, jumps, drifts off or freezes loses its say, and gets it back.

Judged by the source's own clock alone, so that a replay decides the same. What is compared:

- the way since the last position: faster than any tongue is wild. A single outlier costs its own frame; one
  that jumps again and again has to behave for `RETURN_S` before it counts again.
- the distance from the model, smoothed over `SMOOTH_S`: far above the coil's own long-term distance is a
  misfit. Distrusted coils are compared too, with a pose that they had no part in, and so they come back.
- bits: a position that repeats itself exactly for `STUCK_S`, while other coils move, is stuck.

At least two coils are left to the solver by the misfit rule; a coil cannot be judged by a pose that it makes alone.
Where misfits outnumber the others for `OUTVOTED_S`, because those failed or all have moved, nobody can tell who is
right: they are forgiven, and all usual distances learnt anew.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .kernels import OPTIONS
from .pose import CoilState, FloatArray

FASTEST_MM_S = 2000.0
"""Tongue tips reach some hundred mm/s in speech."""
SLACK_MM = 3.0
"""What noise and quantisation may add to any step."""
SHORTEST_STEP_S, LONGEST_STEP_S = 0.0025, 0.025
"""Below, the room for a step shrinks no further: noise does not either. Beyond, it grows no further: a tongue turns round."""
STRIKE_DECAY_S = 0.2
MAX_STRIKES = 2.0
RETURN_S = 0.1
SMOOTH_S = 0.02
TYPICAL_S = 2.0
LEARN_S = 0.5
MISFIT_FACTOR, MISFIT_MM = 3.0, 3.0
FIT_FACTOR, FIT_MM = 2.0, 2.0
STUCK_S = 0.25
OUTVOTED_S = 0.5

_TRUSTED, _MISSING, _WILD, _MISFIT, _STUCK, _RETURNING = (int(state) for state in CoilState)

# Rows of the memory (rows, n): what is known of each coil.
_LAST_X, _LAST_Z = 0, 3  # last position that was there (three rows)
_KEPT_X, _KEPT_Z = 3, 6  # last position that counted
_LAST_S, _KEPT_S = 6, 7  # when
_SINCE_S = 8  # since when its steps have been possible ones
_STRIKES = 9  # impossible steps, forgotten within STRIKE_DECAY_S
_SMOOTH_MM, _TYPICAL_MM, _LEARNT_S = 10, 11, 12  # distance from the model: now, usually, for how long known
_MISFITS = 13  # 1.0 while it is one
_FIT_SINCE_S = 14  # since when a misfit fits again; NaN = it does not
_MOVED_S = 15  # when its position last differed from the one before
_OUTVOTED_S = 16  # since when misfits outnumber the others; NaN = they do not; in the first column alone
_ROWS = 17


class CoilGuard:
    """The memory of n coils.

    states: (n,) `CoilState`; used: (n, 3) the coils that count, NaN otherwise; all_counted: whether every coil
    that was there had a part in the pose.
    """

    def __init__(self, coils: int) -> None:
        self.states: NDArray[np.int64] = np.full(coils, _MISSING, np.int64)
        self.used: FloatArray = np.full((coils, 3), np.nan)
        self.all_counted = True
        self._memory = np.zeros((_ROWS, coils))
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self._memory[:] = 0.0
        self.resume()

    def resume(self) -> None:
        """Forgets positions and times, as after a jump of the clock; not how far each coil usually is."""
        self._memory[_LAST_X : _STRIKES + 1] = np.nan
        self._memory[_STRIKES] = 0.0
        self._memory[_MOVED_S] = np.nan
        self._memory[_FIT_SINCE_S] = np.nan
        self._memory[_OUTVOTED_S] = np.nan

    def admit(self, coils: FloatArray, time_s: float) -> FloatArray:
        """Judges coils (n, 3), mm, NaN = missing, of the moment `time_s`; returns `used`. Nothing is allocated."""
        self.all_counted = _admit(coils, time_s, self._memory, self.states, self.used)
        return self.used

    def learn(self, residuals_mm: FloatArray, time_s: float, step_s: float) -> None:
        """residuals_mm (n,): distances of all coils that are there, trusted or not, from the pose of this frame.

        step_s: time since the frame before. Misfits found here lose their say from the next frame on.
        """
        _learn(residuals_mm, time_s, step_s, self._memory, self.states)


@njit(**OPTIONS)
def _step_is_possible(
    coils: FloatArray, i: int, memory: FloatArray, first: int, then_s: float, time_s: float
) -> bool:
    """Whether coil i can have come from the position in memory rows first.. within the time since then."""
    if np.isnan(memory[first, i]):
        return True
    squared = 0.0
    for axis in range(3):
        way = coils[i, axis] - memory[first + axis, i]
        squared += way * way
    room = SLACK_MM + FASTEST_MM_S * min(max(time_s - then_s, SHORTEST_STEP_S), LONGEST_STEP_S)
    return bool(squared <= room * room)


@njit(**OPTIONS)
def _admit(
    coils: FloatArray, time_s: float, memory: FloatArray, states: NDArray[np.int64], used: FloatArray
) -> bool:
    """Whether all coils that are there count."""
    n = coils.shape[0]
    all_counted = True
    trusted = misfits = 0
    for i in range(n):
        if np.isnan(coils[i, 0]):
            states[i] = _MISSING
            memory[_MOVED_S, i] = np.nan  # where it comes back, it has not been standing there
            for axis in range(3):
                used[i, axis] = np.nan
            continue
        same = True
        for axis in range(3):
            same = same and coils[i, axis] == memory[_LAST_X + axis, i]
        if not same or np.isnan(memory[_MOVED_S, i]):
            memory[_MOVED_S, i] = time_s
        since_s = time_s - memory[_LAST_S, i]
        if since_s > 0.0:
            memory[_STRIKES, i] *= np.exp(-since_s / STRIKE_DECAY_S)
        if np.isnan(memory[_LAST_X, i]):
            memory[_SINCE_S, i] = time_s - RETURN_S
        elif not _step_is_possible(coils, i, memory, _LAST_X, memory[_LAST_S, i], time_s):
            memory[_SINCE_S, i] = time_s
            memory[_STRIKES, i] += 1.0
        near = _step_is_possible(coils, i, memory, _KEPT_X, memory[_KEPT_S, i], time_s)
        if (near and memory[_STRIKES, i] < MAX_STRIKES) or time_s - memory[_SINCE_S, i] >= RETURN_S:
            states[i] = _TRUSTED
        elif memory[_SINCE_S, i] == time_s or not near:
            states[i] = _WILD
        else:
            states[i] = _RETURNING
        if memory[_MISFITS, i] > 0.0 and states[i] == _TRUSTED:
            states[i] = _MISFIT if np.isnan(memory[_FIT_SINCE_S, i]) else _RETURNING
            misfits += 1
        for axis in range(3):
            memory[_LAST_X + axis, i] = coils[i, axis]
        memory[_LAST_S, i] = time_s
    for i in range(n):
        if states[i] == _MISSING:
            continue
        if time_s - memory[_MOVED_S, i] >= STUCK_S:
            for other in range(n):
                # Others have to have moved lately: a device that repeats a whole frame is another matter.
                if (
                    other != i
                    and states[other] != _MISSING
                    and time_s - memory[_MOVED_S, other] < 0.5 * STUCK_S
                ):
                    states[i] = _STUCK
        counts = states[i] == _TRUSTED
        for axis in range(3):
            used[i, axis] = coils[i, axis] if counts else np.nan
            if counts:
                memory[_KEPT_X + axis, i] = coils[i, axis]
        if counts:
            memory[_KEPT_S, i] = time_s
            trusted += 1
        else:
            all_counted = False
    if misfits <= trusted:
        memory[_OUTVOTED_S, 0] = np.nan
    elif np.isnan(memory[_OUTVOTED_S, 0]):
        memory[_OUTVOTED_S, 0] = time_s
    elif time_s - memory[_OUTVOTED_S, 0] >= OUTVOTED_S:  # from the next frame on
        memory[_MISFITS, :] = 0.0
        memory[_LEARNT_S, :] = 0.0
    return all_counted


@njit(**OPTIONS)
def _learn(
    residuals: FloatArray, time_s: float, step_s: float, memory: FloatArray, states: NDArray[np.int64]
) -> None:
    n = residuals.shape[0]
    trusted = 0
    worst = -1
    worst_excess = 0.0
    smooth = step_s / SMOOTH_S if step_s < 0.5 * SMOOTH_S else 0.5
    typical = step_s / TYPICAL_S if step_s < TYPICAL_S else 1.0
    for i in range(n):
        if states[i] == _TRUSTED:
            trusted += 1
        residual = residuals[i]
        if np.isnan(residual) or states[i] == _WILD:
            continue
        if memory[_LEARNT_S, i] == 0.0:
            memory[_SMOOTH_MM, i] = residual
            memory[_TYPICAL_MM, i] = residual
        memory[_SMOOTH_MM, i] += smooth * (residual - memory[_SMOOTH_MM, i])
        usual = memory[_TYPICAL_MM, i]
        if states[i] == _TRUSTED:
            # At the start the plain mean of what was seen, later a slow average.
            share = max(typical, step_s / (memory[_LEARNT_S, i] + step_s) if step_s > 0.0 else 0.0)
            memory[_TYPICAL_MM, i] += share * (residual - usual)
            memory[_LEARNT_S, i] += step_s
            excess = memory[_SMOOTH_MM, i] - MISFIT_FACTOR * usual - MISFIT_MM
            if memory[_LEARNT_S, i] >= LEARN_S and excess > worst_excess:
                worst = i
                worst_excess = excess
        elif memory[_MISFITS, i] > 0.0:
            if memory[_SMOOTH_MM, i] <= FIT_FACTOR * usual + FIT_MM:
                if np.isnan(memory[_FIT_SINCE_S, i]):
                    memory[_FIT_SINCE_S, i] = time_s
                elif time_s - memory[_FIT_SINCE_S, i] >= RETURN_S:
                    memory[_MISFITS, i] = 0.0
                    memory[_FIT_SINCE_S, i] = np.nan
            else:
                memory[_FIT_SINCE_S, i] = np.nan
    if worst >= 0 and trusted > 2:
        memory[_MISFITS, worst] = 1.0
        memory[_FIT_SINCE_S, worst] = np.nan
