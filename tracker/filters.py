"""The mathematics of smoothing: zero-phase low-passes for whole recordings, causal ones for live frames.

Runs are arrays (frames, 3) of consecutive samples without gaps, mm. All recorded filters are symmetric in time
and leave straight lines as they are; the ends are continued by turning the run round its last sample, which
keeps a line a line. The live filters work on one frame at a time, coil by coil, and allocate nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .kernels import FARTHEST_MM, OPTIONS
from .pose import FloatArray

STOP_BAND_DB = 60.0
"""How far a FIR filter is down from its stop frequency on."""
GAUSSIAN_SIGMAS = 4.0
"""Where the Gaussian's two sides are cut off."""
SETTLED = 1e-9
"""What is left of a recursive filter's start when the first true sample comes."""
MOST_TURNS = 10
"""A run is continued by at most so many of its own lengths: its mean is zero by then, nothing slow is left in it."""

SHORTEST_STEP_S = 1e-6
"""No device is as fast: a time that is nearer to the one before is a stamp that came twice."""

UNFILTERED, ONE_POLE, ONE_EURO, FIR = 0, 1, 2, 3

# Columns of a live filter's memory (coils, columns): what is known of each coil.
_STARTED = 0  # 1.0 once a sample was there
_NEWEST = 1  # FIR: the row of `past` that was written last
_LAST_X, _SMOOTH_X, _SPEED_X = 2, 5, 8  # last raw sample, last result, smoothed velocity: three columns each
MEMORY_COLUMNS = 11


# Whole recordings -----------------------------------------------------------------------------------


def fir_taps(pass_hz: float, stop_hz: float, rate_hz: float) -> FloatArray:
    """(odd number,) a Kaiser-windowed low-pass: within 0.02 dB of 1 up to pass_hz, 60 dB down from stop_hz on."""
    from scipy.signal import firwin, kaiserord

    width = (stop_hz - pass_hz) / (rate_hz / 2.0)
    count, beta = kaiserord(STOP_BAND_DB, width)
    # An odd number: the delay is then a whole number of frames.
    return np.asarray(firwin(count | 1, (pass_hz + stop_hz) / 2.0, window=("kaiser", beta), fs=rate_hz))


def gaussian_taps(sigma_frames: float) -> FloatArray:
    """(odd number,) a Gaussian of standard deviation sigma_frames, cut off at 4 of them, of sum 1."""
    from scipy.signal.windows import gaussian

    taps = np.asarray(gaussian(2 * int(np.ceil(GAUSSIAN_SIGMAS * sigma_frames)) + 1, sigma_frames))
    return taps / taps.sum()


def zero_phase_taps(run: FloatArray, taps: FloatArray) -> FloatArray:
    """The run (frames, 3) under symmetric taps of an odd number."""
    from scipy.signal import convolve

    if len(run) < 3:
        return run.copy()
    line = _chord(run)
    return line + convolve(_continued(run - line, len(taps) // 2), taps[:, None], "valid")


def butterworth(cutoff_hz: float, order: int, rate_hz: float) -> tuple[FloatArray, int]:
    """Sections (k, 6) of a low-pass, and after how many frames its start is forgotten.

    Forwards and backwards it halves the amplitude at cutoff_hz (-6 dB) and falls twice as fast as one way.
    """
    from scipy.signal import butter

    slowest = np.abs(butter(order, cutoff_hz, output="zpk", fs=rate_hz)[1]).max()
    settled = int(np.ceil(np.log(SETTLED) / np.log(slowest))) if slowest > 0.0 else 1
    return np.asarray(butter(order, cutoff_hz, output="sos", fs=rate_hz)), settled


def zero_phase_sections(run: FloatArray, sections: FloatArray, settled: int) -> FloatArray:
    """The run (frames, 3) forwards and backwards through a `butterworth`."""
    from scipy.signal import sosfiltfilt

    if len(run) < 3:
        return run.copy()
    padding = min(settled, MOST_TURNS * len(run))
    line = _chord(run)
    smooth = sosfiltfilt(sections, _continued(run - line, padding), axis=0, padtype=None, padlen=0)
    return line + smooth[padding : padding + len(run)]


def running_median(run: FloatArray, frames: int) -> FloatArray:
    """The run (frames, 3) with each coordinate replaced by the median over an odd number of frames."""
    from scipy.signal import medfilt

    if len(run) < 3:
        return run.copy()
    half = frames // 2
    return np.asarray(medfilt(_continued(run, half), (frames, 1)))[half : half + len(run)]


def runs_of(present: NDArray[np.bool_]) -> list[slice]:
    """The stretches of consecutive True in present (frames,)."""
    edges = np.flatnonzero(np.diff(present, prepend=False, append=False))
    return [slice(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def _chord(run: FloatArray) -> FloatArray:
    """(frames, 3) the straight line from the run's first sample to its last.

    A linear filter of gain 1 leaves it as it is; taking it out first leaves a run that begins and ends at 0, so that
    constants and lines come through to the last bit and a short run cannot drift when it is continued.
    """
    return run[0] + np.linspace(0.0, 1.0, len(run))[:, None] * (run[-1] - run[0])


def _continued(run: FloatArray, padding: int) -> FloatArray:
    """(frames + 2 padding, 3): turned round its first and last sample, again and again where it is short."""
    return np.pad(run, ((padding, padding), (0, 0)), mode="reflect", reflect_type="odd")


# Live frames ----------------------------------------------------------------------------------------


def one_pole_delay_s(cutoff_hz: float, rate_hz: float) -> float:
    """How late slow motion comes out of the one-pole filter."""
    return float(1.0 / (rate_hz * np.expm1(2.0 * np.pi * cutoff_hz / rate_hz)))


def one_euro_delay_s(cutoff_hz: float) -> float:
    """How late slow motion comes out of the one-euro filter: its longest delay, fast motion comes earlier."""
    return float(1.0 / (2.0 * np.pi * cutoff_hz))


@njit(**OPTIONS)
def _weight_of_newest(cutoff_hz: float, step_s: float) -> float:
    """The one-euro filter's own discretisation (Casiez et al. 2012, equations 1 and 2)."""
    return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff_hz * step_s))


@njit(**OPTIONS)
def smooth_frame(
    raw: FloatArray,
    step_s: float,
    kinds: NDArray[np.int64],
    settings: FloatArray,
    taps: FloatArray,
    lengths: NDArray[np.int64],
    memory: FloatArray,
    past: FloatArray,
    out: FloatArray,
) -> None:
    """One frame raw (n, 3), mm, into out (n, 3), which may be raw itself.

    step_s: since the frame before, at least SHORTEST_STEP_S. kinds (n,): UNFILTERED, ONE_POLE, ONE_EURO or FIR;
    settings (n, 3): the cut-off, Hz; for ONE_EURO then beta, 1/mm, and the cut-off of its velocity, Hz. taps (n,
    longest), lengths (n,): of FIR. memory (n, MEMORY_COLUMNS), zeros at the start; past (n, longest, 3): the last raw
    samples of FIR, in a ring. A coil with a coordinate that is not a number, or beyond FARTHEST_MM, is passed on as
    it is and forgotten.
    """
    for i in range(raw.shape[0]):
        kind = kinds[i]
        usable = True
        for axis in range(3):
            usable = usable and abs(raw[i, axis]) <= FARTHEST_MM
        if not usable or kind == UNFILTERED:
            memory[i, _STARTED] = 0.0
            for axis in range(3):
                out[i, axis] = raw[i, axis]
            continue
        if memory[i, _STARTED] == 0.0:
            # As if the coil had always stood where it is first seen.
            memory[i, _STARTED] = 1.0
            memory[i, _NEWEST] = 0.0
            for axis in range(3):
                memory[i, _LAST_X + axis] = raw[i, axis]
                memory[i, _SMOOTH_X + axis] = raw[i, axis]
                memory[i, _SPEED_X + axis] = 0.0
                if kind == FIR:
                    for row in range(lengths[i]):
                        past[i, row, axis] = raw[i, axis]
                out[i, axis] = raw[i, axis]
            continue
        if kind == FIR:
            newest = int(memory[i, _NEWEST]) + 1
            if newest == lengths[i]:
                newest = 0
            memory[i, _NEWEST] = newest
            for axis in range(3):
                past[i, newest, axis] = raw[i, axis]
            x = y = z = 0.0
            row = newest
            for tap in range(lengths[i]):
                x += taps[i, tap] * past[i, row, 0]
                y += taps[i, tap] * past[i, row, 1]
                z += taps[i, tap] * past[i, row, 2]
                row = row - 1 if row > 0 else lengths[i] - 1
            out[i, 0] = x
            out[i, 1] = y
            out[i, 2] = z
            continue
        if kind == ONE_POLE:
            weight = -np.expm1(-2.0 * np.pi * settings[i, 0] * step_s)
        else:
            weight = _weight_of_newest(settings[i, 2], step_s)
            squared = 0.0
            for axis in range(3):
                speed = (raw[i, axis] - memory[i, _LAST_X + axis]) / step_s
                memory[i, _LAST_X + axis] = raw[i, axis]
                memory[i, _SPEED_X + axis] += weight * (speed - memory[i, _SPEED_X + axis])
                squared += memory[i, _SPEED_X + axis] ** 2
            weight = _weight_of_newest(settings[i, 0] + settings[i, 1] * np.sqrt(squared), step_s)
        for axis in range(3):
            memory[i, _SMOOTH_X + axis] += weight * (raw[i, axis] - memory[i, _SMOOTH_X + axis])
            out[i, axis] = memory[i, _SMOOTH_X + axis]
