"""The palate as a mid-sagittal curve: from a swept probe coil, from a trace file, or from a tongue model.

It helps to place a recording in the model's frame, and no tracked contour can be above it (paper, section "Using
the model for tracking motion capture data": palate shape and bite plane of the subject).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import InputError
from ..drivers.files import open_recording
from ..drivers.files.common import UNITS_MM, decode, number_table
from ..drivers.files.recognise import read_head, read_whole
from ..drivers.frames import FrameOfReference, Recording
from ..model.midsagittal import midsagittal_vertices
from ..model.multilinear import TongueModel
from .pose import FloatArray
from .sagittal import directions

MODEL_FRAME = FrameOfReference("left", "back", "up", "model")

BIN_MM = 1.0
QUANTILE = 0.9  # of the heights in a bin: where the palate is first looked for
FEWEST_IN_BIN = 3
ON_PALATE_MM = 1.0  # samples this near to the curve were on the palate
ROUNDS = 4
LONGEST_GAP_MM = 5.0  # between two places that were swept; beyond a longer one nothing is believed
SMOOTHING_LENGTH_MM = 3.5  # bumps shorter than this are smoothed away
SHORTEST_MM, LONGEST_MM = 15.0, 120.0  # of a palate, front to back
MOST_POINTS = 10_000
PROBE_RATE_HZ = 250.0
ABOVE_MM, ABOVE_SHARE = (
    3.0,
    0.05,
)  # tongue samples above a palate by this much, in more than this share, contradict it
HIGHEST_ABOVE_TONGUE_MM = 40.0
WITHIN_SIGMA = 2.0
_TRACE_LINE = re.compile(r"\s*[-+.\deE]+([\s,;]+[-+.\deE]+){1,2}\s*")
_PROBE_NAME = re.compile(r"pal(ate)?([ _-]?(probe|trace))?|palate_probe|pa|probe", re.IGNORECASE)
STEEPEST_BACK = 1.0  # where a model's highest tongue falls more steeply than this, it has left the palate


@dataclass(frozen=True)
class Palate:
    """A palate curve, in the axes that `frame` states.

    points_mm: (n, 3) from front to back; source: where it came from, for people; lateral_mm: how far the curve
    strays sideways, from its leftmost to its rightmost point (a sweep off the middle is lower than the vault).
    """

    points_mm: FloatArray
    source: str
    frame: FrameOfReference = MODEL_FRAME
    lateral_mm: float = 0.0

    def __post_init__(self) -> None:
        points = np.array(self.points_mm, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not 2 <= len(points) <= MOST_POINTS:
            raise InputError(
                f"{self.source}: a palate of the shape {points.shape}; expected 2 to {MOST_POINTS} points of three "
                "coordinates."
            )
        if not np.isfinite(points).all():
            raise InputError(f"{self.source}: a point of the palate is not a finite number.")
        if (np.diff(points @ self._to_model[1]) <= 0).any():
            raise InputError(
                f"{self.source}: the points of the palate do not go from front to back, each once."
            )
        points.setflags(write=False)
        object.__setattr__(self, "points_mm", points)

    @cached_property
    def _to_model(self) -> FloatArray:
        return directions(self.frame, self.source)

    @cached_property
    def curve(self) -> tuple[FloatArray, FloatArray]:
        """How far back (n,), increasing, and how far up (n,) each point is, mm, whatever the axes; contiguous. In the
        model's frame these are y and z."""
        turned = self.points_mm @ self._to_model.T
        return turned[:, 1].copy(), turned[:, 2].copy()

    @property
    def line(self) -> FloatArray:
        """(n, 3) mm: `curve` in the mid-sagittal plane, in the model's axes."""
        back, up = self.curve
        return np.column_stack([np.zeros_like(back), back, up])

    @property
    def directions(self) -> FloatArray:
        """(2, 3) backwards and upwards in this palate's axes: `curve` is along them."""
        return self._to_model[1:]

    def height(self, back: FloatArray | float) -> FloatArray:
        """How far up the palate is, mm, so far back (any shape), both as in `curve`; NaN before and behind it."""
        return np.asarray(np.interp(back, *self.curve, left=np.nan, right=np.nan))

    def above(self, points: FloatArray) -> FloatArray:
        """(...) mm by which points (..., 3), in this palate's own axes, lie above the curve, straight upwards
        (negative: below); NaN where `height` is."""
        return np.asarray(points @ self._to_model[2] - self.height(points @ self._to_model[1]))

    def transformed(self, rotation: FloatArray, translation: FloatArray) -> Palate:
        """The palate in the model's axes: rotation (3, 3) @ points + translation (3,) mm, ordered front to back again.

        rotation leads from this palate's axes to the model's, as the coils' own alignment does.
        """
        return curve_palate(self.points_mm @ rotation.T + translation, self.source)

    def __str__(self) -> str:
        back = self.curve[0]
        strays = f", straying {self.lateral_mm:.1f} mm sideways" if self.lateral_mm else ""
        return f"{len(back)} points over {np.ptp(back):.0f} mm front to back{strays} ({self.source})"


def curve_palate(points: FloatArray, source: str, frame: FrameOfReference = MODEL_FRAME) -> Palate:
    """A palate from points (n, 3) mm on it in any order; of several at one place the highest is kept."""
    to_model = directions(frame, source)
    turned = points @ to_model.T
    turned = turned[np.lexsort((-turned[:, 2], turned[:, 1]))]
    kept = turned[np.diff(turned[:, 1], prepend=-np.inf) > 1e-9]
    return Palate(kept @ to_model, source, frame, float(np.ptp(kept[:, 0])) if len(kept) else 0.0)


# From a sweep ---------------------------------------------------------------------------------------


def palate_from_sweep(
    probe: FloatArray, frame: FrameOfReference, source: str, tongue: FloatArray | None = None
) -> Palate:
    """The palate under which a probe coil was moved along it: the upper envelope of its path.

    probe: (frames, 3) mm, head-corrected, NaN = missing; frame: its axes. tongue: (frames, n, 3) mm of tongue coils
    in the same axes, which cannot be above a palate. The probe is on the palate only part of the time: by 1 mm
    front to back, a high quantile of its height (robust against single outliers) says where the palate is, the
    median of the samples near that how high exactly; then a smoothing spline. Points in `frame`.
    Raises InputError where that is no palate: too short, axes open, or below the tongue.
    """
    to_model = directions(frame, source)
    there = probe[np.isfinite(probe).all(axis=1)] @ to_model.T
    covered = float(np.ptp(np.quantile(there[:, 1], [0.01, 0.99]))) if len(there) else 0.0
    if covered < SHORTEST_MM:
        raise InputError(
            f"{source}: the probe moves only {covered:.1f} mm front to back; a sweep along a palate covers at least "
            f"{SHORTEST_MM:.0f}, so name the channel of the probe, or sweep again."
        )
    envelope = _upper_envelope(there)
    if len(envelope) * BIN_MM < SHORTEST_MM:
        raise InputError(
            f"{source}: the probe stays long enough to be measured over only {len(envelope) * BIN_MM:.0f} mm front to "
            f"back, expected at least {SHORTEST_MM:.0f}; sweep more slowly."
        )
    palate = curve_palate(envelope @ to_model, source, frame)
    if tongue is not None:
        check_above_tongue(palate, tongue, source)
    return palate


def _upper_envelope(samples: FloatArray) -> FloatArray:
    """(n, 3) one point for each 1 mm of y, from samples (m, 3) in the model's directions; n is 0 for too few."""
    place = np.floor(samples[:, 1] / BIN_MM).astype(np.int64)
    bins, counts = np.unique(place, return_counts=True)
    bins = bins[counts >= FEWEST_IN_BIN]
    runs = np.split(bins, np.flatnonzero(np.diff(bins) * BIN_MM > LONGEST_GAP_MM) + 1)
    bins = max(runs, key=len)
    if len(bins) < 5:  # points that a smoothing spline needs
        return np.zeros((0, 3))
    y = np.asarray((bins + 0.5) * BIN_MM, dtype=np.float64)
    inside = [samples[place == number] for number in bins]
    spline = _smooth_curve(y, np.array([np.quantile(found[:, 2], QUANTILE) for found in inside]))
    # Again about that curve: on a slope, the quantile of a bin is that of its higher end.
    over = np.array([np.quantile(found[:, 2] - spline(found[:, 1]), QUANTILE) for found in inside])
    spline = _smooth_curve(y, spline(y) + over)
    # The quantile of noisy samples is above their middle: now the middle of those that are near the curve.
    lateral = np.array([np.median(found[:, 0]) for found in inside])
    for _ in range(ROUNDS):
        over = np.zeros(len(bins))
        for index, found in enumerate(inside):
            off = found[:, 2] - spline(found[:, 1])
            near = np.abs(off) <= ON_PALATE_MM
            if near.any():
                over[index], lateral[index] = np.median(off[near]), np.median(found[near, 0])
        spline = _smooth_curve(y, spline(y) + over)
    return np.column_stack([_smooth_curve(y, lateral)(y), y, spline(y)])


def _smooth_curve(y: FloatArray, values: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """A smoothing spline through values at y, both (n,); a value far off its neighbours counts little."""
    from scipy.interpolate import make_smoothing_spline

    stiffness = (SMOOTHING_LENGTH_MM / (2.0 * np.pi)) ** 4  # halves a ripple of that length, at 1 mm spacing
    weights = np.ones(len(y))
    for _ in range(ROUNDS):
        spline = make_smoothing_spline(y, values, w=weights, lam=stiffness)
        off = np.abs(values - spline(y))
        scale = max(1.4826 * float(np.median(off)), 0.1)
        weights = 1.0 / (1.0 + (off / (2.0 * scale)) ** 2)
    return spline


def check_above_tongue(palate: Palate, tongue: FloatArray, source: str) -> float:
    """How far, in mm, the tongue's highest samples (99 %) lie above the palate; negative: below it, as it should be.

    tongue: (frames, n, 3) mm of tongue coils, NaN = missing, in the palate's own axes and origin.
    Raises InputError naming `source`, the tongue's recording, where the two contradict each other: no coil below the
    palate at all, the palate below the tongue, or far above it.
    """
    above = palate.above(tongue)
    above = above[np.isfinite(above)]
    if len(above) == 0:
        raise InputError(
            f"{palate.source}: no tongue coil of {source} is ever below this palate, front to back; the two do not "
            "belong together, or are in different axes."
        )
    highest = float(np.quantile(above, 0.99))
    share = float(np.mean(above > ABOVE_MM))
    if share > ABOVE_SHARE:
        raise InputError(
            f"{palate.source}: this palate is below the tongue: {100 * share:.0f} % of the tongue samples of {source} lie "
            f"more than {ABOVE_MM:.0f} mm above it (up to {highest:.1f} mm), where no tongue can be; it is another "
            "speaker's, in other axes, or its probe was never on the palate."
        )
    if highest < -HIGHEST_ABOVE_TONGUE_MM:
        raise InputError(
            f"{palate.source}: the tongue coils of {source} never come within {-highest:.0f} mm of this palate; the two do "
            "not belong together, or are in different axes or units."
        )
    return highest


# From a file ----------------------------------------------------------------------------------------


def read_palate(
    path: str | Path,
    frame: FrameOfReference | None = None,
    unit: str | None = None,
    channel: str | None = None,
    tongue: Sequence[str] = (),
    prepare: Callable[[Recording], Recording] | None = None,
) -> Palate:
    """A palate from a file: a trace (text of 2 or 3 columns), or any recording of a swept probe coil.

    frame: the axes, those of the recording that the palate belongs to; needed for a trace, and for a recording that
    does not state them. Two columns stand for its two axes that are not absent. unit: of a trace (mm, cm, um, ...),
    needed there. channel: the probe, else the one channel that is named as one, else the one that moves, apart from
    the tongue's. tongue: channels of tongue coils; those that the file has must be below the palate. prepare: what is done
    with a recording before anything else, as to take the head's motion out and turn it; the palate is then in the frame
    that it gives back.
    Raises InputError that asks for what the file leaves open, and where the numbers are no palate.
    """
    path = Path(path)
    table = _trace_table(path)
    if table is not None:
        return _palate_from_trace(table, frame, unit, str(path))
    # The rate plays no part in where the probe was; some exports do not state it.
    recording = open_recording(path, rate_hz=PROBE_RATE_HZ, unit=unit)
    if prepare is not None:
        recording = prepare(recording)
    stated = recording.frame
    if "unknown" in (stated.x, stated.y, stated.z):
        if frame is None:
            raise InputError(
                f"{path}: the file does not state its axes; say which recording's axes they are, or state them "
                '(for example "left back up").'
            )
        stated = frame
    probe = _probe_channel(recording, stated, channel, tongue)
    others = [index for index, name in enumerate(recording.coils) if name in tongue and index != probe]
    below = recording.positions[:, others]
    return palate_from_sweep(
        recording.positions[:, probe],
        stated,
        f"{path}, channel {recording.coils[probe]}",
        below if np.isfinite(below).any() else None,
    )


def axes_from_words(text: str) -> FrameOfReference:
    """A frame from two or three words, "left back up" or, in 2-D, "back up"; InputError for anything else."""
    words = re.split(r"[\s,]+", text.strip())
    if len(words) == 2:
        words = ["absent", *words]
    if len(words) != 3:
        raise InputError(
            f'axes {text!r}: expected where x, y and z grow, as in "left back up", or "back up" in 2-D.'
        )
    frame = FrameOfReference(words[0], words[1], words[2], "stated")
    directions(frame, f"axes {text!r}")
    if "absent" in words and {"left", "right"} & set(words):
        raise InputError(
            f"axes {text!r}: two-dimensional data lie in the mid-sagittal plane, so their axes grow to the front or back "
            'and up or down, as in "back up".'
        )
    return frame


def _trace_table(path: Path) -> FloatArray | None:
    """(n, 2) or (n, 3) numbers of a text that holds nothing else; None where the file is something else."""
    head = read_head(path)
    rows = [line for line in head.lines if line.strip()]
    if not rows or not all(_TRACE_LINE.fullmatch(line) for line in rows):
        return None
    lines = [line for line in decode(read_whole(path)).splitlines() if line.strip()]
    cells = [re.split(r"[\s,;]+", line.strip()) for line in lines]
    return number_table(cells, len(cells[0]), str(path))


def _palate_from_trace(
    table: FloatArray, frame: FrameOfReference | None, unit: str | None, source: str
) -> Palate:
    columns = table.shape[1]
    if unit is None or frame is None:
        lacking = " and ".join([*(["unit"] if unit is None else []), *(["axes"] if frame is None else [])])
        raise InputError(
            f"{source}: a trace of {columns} columns states neither unit nor axes; pass its {lacking} (a unit of "
            f'{", ".join(UNITS_MM)}; axes as "left back up", or "back up" for two columns).'
        )
    if unit not in UNITS_MM:
        raise InputError(f"{source}: the unit {unit!r} is not known; choose from {', '.join(UNITS_MM)}.")
    filled = [axis for axis, grows in enumerate((frame.x, frame.y, frame.z)) if grows != "absent"]
    if len(filled) != columns:
        raise InputError(
            f"{source}: the trace has {columns} columns, but the axes ({frame}) are {len(filled)}; a trace "
            f"has the recording's axes, so write it with {len(filled)} columns."
        )
    points = np.zeros((len(table), 3))
    points[:, filled] = table * UNITS_MM[unit]
    extent = float(np.ptp(points @ directions(frame, source)[1])) if np.isfinite(points).all() else np.nan
    if not SHORTEST_MM <= extent <= LONGEST_MM:
        raise InputError(
            f"{source}: in {unit} the trace extends {extent:.4g} mm front to back, a palate {SHORTEST_MM:.0f} to "
            f"{LONGEST_MM:.0f} mm; check the unit and the axes."
        )
    if len(points) > FEWEST_IN_BIN * extent / BIN_MM:  # the samples of a probe rather than a drawn curve
        return palate_from_sweep(points, frame, source)
    return curve_palate(points, source, frame)


def _probe_channel(
    recording: Recording, frame: FrameOfReference, channel: str | None, tongue: Sequence[str]
) -> int:
    """Index of the swept coil: the one named so, else the only one that moves as far as a palate is long."""
    source, coils = recording.source, recording.coils
    if channel is not None:
        if channel not in coils:
            raise InputError(
                f"{source}: there is no channel '{channel}' for the palate probe; there are {', '.join(coils)}."
            )
        return coils.index(channel)
    named = [index for index, name in enumerate(coils) if _PROBE_NAME.fullmatch(name)]
    if len(named) == 1:
        return named[0]
    along = recording.positions @ directions(frame, source)[1]
    moving = []
    for index in [index for index, name in enumerate(coils) if name not in tongue]:
        there = along[np.isfinite(along[:, index]), index]
        if len(there) and np.ptp(np.quantile(there, [0.01, 0.99])) >= SHORTEST_MM:
            moving.append(index)
    if len(moving) != 1:
        names = ", ".join(coils[index] for index in moving)
        what = f"several coils move along it ({names})" if moving else "no coil moves as far"
        raise InputError(
            f"{source}: a sweep along a palate covers at least {SHORTEST_MM:.0f} mm front to back, and {what}; name the "
            "channel of the palate probe."
        )
    return moving[0]


# From a model ---------------------------------------------------------------------------------------


def model_palate(model: TongueModel) -> Palate:
    """Where the palate of the model's average speaker must be at the least, in the model frame.

    Tongues reach the palate in some of their poses: the highest z, by 1 mm front to back, of the mid-sagittal
    contours over the model's training poses (as far as they are within two sigma), for the mean anatomy. For use
    where there is no palate trace; a real palate is some millimetres higher, for poses are averaged and no tongue fills
    it everywhere.
    """
    contour = [int(vertex) for vertex in midsagittal_vertices(model)]
    speaker = model.at(contour).for_speaker(model.speaker.mean)
    if model.pose.training is not None:
        reach = WITHIN_SIGMA * model.pose.sigma
        poses = np.clip(model.pose.training, model.pose.mean - reach, model.pose.mean + reach)
    else:  # a model file that keeps no training poses: each weight alone to both ends
        ends = np.diag(WITHIN_SIGMA * model.pose.sigma)
        poses = model.pose.mean + np.concatenate([ends, -ends])
    contours = np.stack([speaker.vertices(pose) for pose in poses])
    y = np.arange(np.floor(contours[..., 1].min()), np.ceil(contours[..., 1].max()) + BIN_MM, BIN_MM)
    highest = np.fmax.reduce([_contour_height(contour, y) for contour in contours])
    y, highest = y[np.isfinite(highest)], highest[np.isfinite(highest)]
    end = _end_of_palate(highest)
    if end * BIN_MM < SHORTEST_MM:
        raise InputError(
            f"the model '{model.name}' has an upper surface of only {end * BIN_MM:.0f} mm front to back below a palate; a "
            f"tongue's has at least {SHORTEST_MM:.0f}, so this is no model of a tongue in mm."
        )
    points = np.column_stack([np.zeros(end), y[:end], _smooth_curve(y[:end], highest[:end])(y[:end])])
    return Palate(points, f"the highest tongue of the model '{model.name}'")


def _end_of_palate(highest: FloatArray) -> int:
    """How many of the heights (n,), 1 mm apart front to back, come before the steep fall behind the highest."""
    if len(highest) == 0:
        return 0
    apex = int(np.argmax(highest))
    falling = np.flatnonzero(np.diff(highest[apex:]) < -STEEPEST_BACK * BIN_MM)
    return apex + int(falling[0]) + 1 if len(falling) else len(highest)


def _contour_height(contour: FloatArray, y: FloatArray) -> FloatArray:
    """(n,) highest z of the polyline (c, 3) at each y (n,); NaN where it never is."""
    start, end = contour[:-1, None], contour[1:, None]  # (c - 1, 1, 3)
    run = end[..., 1] - start[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (y - start[..., 1]) / run
        z = start[..., 2] + share * (end[..., 2] - start[..., 2])
    return np.asarray(np.fmax.reduce(np.where((share >= 0) & (share <= 1), z, np.nan)))


# In a session ---------------------------------------------------------------------------------------


def palate_toml(palate: Palate) -> dict[str, Any]:
    """The content of a session's [palate]; the palate must be in the model's frame."""
    if not np.array_equal(directions(palate.frame, palate.source), np.eye(3)):
        raise InputError(
            f"{palate.source}: this palate is in the axes {palate.frame}; move it into the model's frame first."
        )
    return {"source": palate.source, "points_mm": palate.points_mm.tolist()}


def palate_from_toml(table: Mapping[str, Any]) -> Palate:
    """A palate in the model's frame from a session's [palate]. Raises InputError that names the key at fault."""
    for key in table:
        if key not in ("source", "points_mm"):
            raise InputError(f"[palate] has the unknown key '{key}'; expected points_mm, source.")
    source = table.get("source", "")
    if not isinstance(source, str):
        raise InputError(f"[palate] source = {source!r}: expected text in quotes.")
    rows = table.get("points_mm")
    numbers = isinstance(rows, list) and all(
        isinstance(row, list) and len(row) == 3 and all(type(cell) in (int, float) for cell in row)
        for row in rows
    )
    if not numbers:
        raise InputError(
            "[palate] points_mm: expected a list of points [x, y, z], in mm, from front to back."
        )
    try:
        return Palate(np.array(rows, dtype=np.float64).reshape(-1, 3), source)
    except (OverflowError, InputError) as reason:
        raise InputError(f"[palate] points_mm: {reason}") from reason
