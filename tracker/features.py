"""The pose weights as feature vectors, as speech synthesis takes them: at a frame rate of one's own, with deltas.

Every stretch of tracked frames is taken by itself. Where the rate goes down, a low-pass that shifts nothing in time
comes first, flat up to 80 % of the new rate's Nyquist frequency and 60 dB down from there on: what lies above
would come back as a slow motion that nobody made. Then the weights are interpolated linearly on the frames' times.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from ..atomic import write_atomically
from .filters import fir_taps, runs_of, zero_phase_taps
from .pose import FloatArray, TrackedPoses

FORMAT_NAME = "tonguetrack features"
FORMAT_VERSION = 1
PASS_SHARE = 0.8  # of the new Nyquist frequency, up to which nothing is taken away
LONGEST_STEP_FRAMES = 2.5  # between neighbours: one frame that never came is bridged, more is a gap
REACH = 2  # frames to either side in the regression of the deltas, as HTK and HTS have it
MOST_FRAMES = 20_000_000  # of one recording; more is a mistyped rate, or a clock that jumped
LOWEST_HZ, HIGHEST_HZ = 0.1, 10_000.0
CHUNK_FRAMES = 4096  # are turned into text at a time


@dataclass(frozen=True)
class Features:
    """Feature vectors of one recording; NaN where nothing was tracked.

    times_s: (frames,) on the recording's clock, from its first frame on, 1 / rate_hz apart.
    weights, normalised: (frames, K) raw pose weights, and in sigma from the mean; *_delta and *_delta_delta: their
    first and second derivatives by regression, per frame of this rate.
    """

    times_s: FloatArray
    weights: FloatArray
    weights_delta: FloatArray
    weights_delta_delta: FloatArray
    normalised: FloatArray
    normalised_delta: FloatArray
    normalised_delta_delta: FloatArray
    rate_hz: float

    @property
    def frame_count(self) -> int:
        return len(self.times_s)


ARRAYS = (
    *("weights", "weights_delta", "weights_delta_delta"),
    *("normalised", "normalised_delta", "normalised_delta_delta"),
)
_COLUMNS = dict(
    zip(ARRAYS, ("", "_delta", "_delta_delta", "_sigma", "_sigma_delta", "_sigma_delta_delta"), strict=True)
)
"""What the columns pose_1, pose_2, ... of the CSV have behind their names."""


def check_rate(rate_hz: float) -> None:
    """Raises InputError for a frame rate that nobody means."""
    if not LOWEST_HZ <= rate_hz <= HIGHEST_HZ:
        raise InputError(
            f"--features {rate_hz:g}: expected a frame rate of {LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz, as in 200."
        )


def features_of(poses: TrackedPoses, rate_hz: float) -> Features:
    """The pose weights of a tracked recording at `rate_hz`, with their deltas.

    Raises InputError for a rate that nobody means, and where the features would be too many.
    """
    check_rate(rate_hz)
    length_s = float(poses.times_s[-1] - poses.times_s[0])
    if length_s * rate_hz > MOST_FRAMES:
        raise InputError(
            f"{poses.recording}: {length_s:g} s at {rate_hz:g} Hz are too many feature vectors (at most "
            f"{MOST_FRAMES}); choose a lower rate, or cut the recording."
        )
    size = poses.weights.shape[1]
    both = np.column_stack([poses.weights, poses.normalised])
    times, static = resampled(poses.times_s, both, poses.tracked, poses.rate_hz, rate_hz)
    first = deltas(static)
    second = deltas(first)
    return Features(
        times_s=times,
        weights=static[:, :size],
        weights_delta=first[:, :size],
        weights_delta_delta=second[:, :size],
        normalised=static[:, size:],
        normalised_delta=first[:, size:],
        normalised_delta_delta=second[:, size:],
        rate_hz=rate_hz,
    )


def resampled(
    times_s: FloatArray,
    values: FloatArray,
    present: NDArray[np.bool_],
    source_hz: float,
    rate_hz: float,
) -> tuple[FloatArray, FloatArray]:
    """Times (g,) `1 / rate_hz` apart from the first frame's on, and the values (g, c) there.

    times_s: (f,) increasing; values: (f, c); present: (f,), False = values that do not count; source_hz: the frames'
    nominal rate. NaN between frames of which one does not count, or that are too far apart.
    """
    count = int(np.floor((times_s[-1] - times_s[0]) * rate_hz + 1e-6)) + 1
    wanted = times_s[0] + np.arange(count) / rate_hz
    result = np.full((count, values.shape[1]), np.nan)
    taps = None
    if rate_hz < source_hz:
        taps = fir_taps(PASS_SHARE * rate_hz / 2.0, rate_hz / 2.0, source_hz)
    for run in _runs(times_s, present, source_hz):
        known = values[run] if taps is None else zero_phase_taps(values[run], taps)
        # A time that rounding puts just outside the run is meant to be its end.
        slack = 1e-6 / rate_hz
        begin, end = np.searchsorted(wanted, [times_s[run][0] - slack, times_s[run][-1] + slack])
        for column in range(values.shape[1]):
            result[begin:end, column] = np.interp(wanted[begin:end], times_s[run], known[:, column])
    return wanted, result


def _runs(times_s: FloatArray, present: NDArray[np.bool_], source_hz: float) -> Iterator[slice]:
    """The stretches of frames that count and follow each other closely."""
    breaks = np.flatnonzero(np.diff(times_s) * source_hz > LONGEST_STEP_FRAMES) + 1
    for run in runs_of(present):
        inside = breaks[(breaks > run.start) & (breaks < run.stop)].tolist()
        for first, end in zip([run.start, *inside], [*inside, run.stop], strict=True):
            yield slice(first, end)


def deltas(values: FloatArray) -> FloatArray:
    """The slope of each column of values (frames, c) per frame, by regression over REACH frames to either side.

    d_t = sum_n n (c_{t+n} - c_{t-n}) / (2 sum_n n^2), n = 1 .. REACH. Before the first and behind the last frame of
    each stretch without NaN, that frame is repeated.
    """
    result = np.full_like(values, np.nan)
    scale = 2.0 * sum(n * n for n in range(1, REACH + 1))
    for run in runs_of(np.asarray(~np.isnan(values).any(axis=1))):
        length = run.stop - run.start
        wide = np.pad(values[run], ((REACH, REACH), (0, 0)), mode="edge")
        later = (wide[REACH + n : REACH + n + length] for n in range(1, REACH + 1))
        earlier = (wide[REACH - n : REACH - n + length] for n in range(1, REACH + 1))
        pairs = enumerate(zip(later, earlier, strict=True), 1)
        result[run] = sum(n * (after - before) for n, (after, before) in pairs) / scale
    return result


# Files ----------------------------------------------------------------------------------------------


def write_features(features: Features, poses: TrackedPoses, path: Path) -> None:
    """Writes .csv or .npz, by the suffix. poses: what the features were made of; their model and take are named."""
    header = {
        "format": FORMAT_NAME,
        "version": FORMAT_VERSION,
        "model_name": poses.model_name,
        "model_fingerprint": poses.model_fingerprint,
        "recording": poses.recording,
        "recording_rate_hz": poses.rate_hz,
        "experiment": poses.experiment,
        "rate_hz": features.rate_hz,
    }

    def write_npz(file: BinaryIO) -> None:
        coded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        arrays = {name: getattr(features, name) for name in ARRAYS}
        np.savez_compressed(file, header=coded, times_s=features.times_s, **arrays)

    def write_csv(file: BinaryIO) -> None:
        file.writelines(text.encode() for text in _csv_parts(features, header))

    write_atomically(path, write_npz if path.suffix == ".npz" else write_csv)


def _csv_parts(features: Features, header: dict[str, object]) -> Iterator[str]:
    """One comment line with what belongs to the whole take, then one row a frame; an empty cell is NaN."""
    yield f"# {json.dumps(header)}\n"
    size = features.weights.shape[1]
    names = [f"pose_{k + 1}{suffix}" for suffix in _COLUMNS.values() for k in range(size)]
    yield ",".join(["frame", "time_s", *names]) + "\n"
    table = np.column_stack([features.times_s, *(getattr(features, name) for name in _COLUMNS)])
    for begin in range(0, features.frame_count, CHUNK_FRAMES):
        rows = enumerate(table[begin : begin + CHUNK_FRAMES].tolist(), begin)
        text = "".join(f"{t},{','.join(f'{value:.9g}' for value in row)}\n" for t, row in rows)
        yield text.replace(",nan", ",")
