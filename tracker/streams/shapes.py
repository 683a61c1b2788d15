"""Avatar shapes: the tongue's pose as named numbers in 0..1, measured on its surface.

A few vertices are landmarks: the tip, and at three places along the tongue (blade, front, body) the middle, both edges
and the points halfway; and the middle of the back. From them fifteen quantities are measured, each against the same
speaker's neutral tongue, the one of the mean pose (`AXES`). Most have a shape for either sign (`SHAPES`); a range says
which value of the quantity makes the shape 0 and which makes it 1. `pose_0` to `pose_<K-1>` are the model's own pose
directions, re-based (`model/rebasing.py`).

Model frame, mm: x lateral, left positive, y front to back, z up. Left and right are the speaker's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import atan2, degrees, sqrt

import numpy as np

from ... import InputError
from ...model.multilinear import Mode, TongueModel
from ...model.rebasing import Rebased
from ..pose import FloatArray
from .landmarks import (
    LEFT_EDGE,
    LEFT_HALF,
    MIDDLES,
    RIGHT_EDGE,
    RIGHT_HALF,
    SECTIONS,
    TIP,
    landmark_model,
)

SIGMAS = 3.0
"""Without ranges of a speaker, a shape is 1 where the model's weights reach it within mean +- 3 sigma."""
LEAST = {"mm": 2.0, "deg": 5.0}
"""No range is narrower. What a model or a speaker cannot do then stays near 0 instead of being blown up."""


@dataclass(frozen=True)
class Axis:
    """A measured quantity. unit: mm or deg; rigid: whether it stays as it is when the whole tongue is turned and
    shifted. `axes_of` says how each is measured."""

    name: str
    unit: str
    rigid: bool = False


AXES = (
    Axis("tip x", "mm"),
    Axis("tip y", "mm"),
    Axis("tip z", "mm"),
    Axis("body x", "mm"),
    Axis("body y", "mm"),
    Axis("body z", "mm"),
    Axis("lean", "deg"),
    Axis("out", "mm"),
    Axis("curl", "deg", rigid=True),
    Axis("twist", "deg", rigid=True),
    Axis("width", "mm", rigid=True),
    Axis("length", "mm", rigid=True),
    Axis("groove", "mm", rigid=True),
    Axis("dome", "mm", rigid=True),
    Axis("sides", "deg", rigid=True),
)


@dataclass(frozen=True)
class Shape:
    """A named shape: what an axis says with this sign. A range of it is (value for 0, value for 1) of sign x axis."""

    name: str
    axis: str
    sign: int
    meaning: str


SHAPES = (
    Shape("tip_forward", "tip y", 1, "the tip goes to the front"),
    Shape("tip_back", "tip y", -1, "the tip goes to the back"),
    Shape("tip_up", "tip z", 1, "the tip goes up"),
    Shape("tip_down", "tip z", -1, "the tip goes down"),
    Shape("tip_left", "tip x", 1, "the tip goes to the left"),
    Shape("tip_right", "tip x", -1, "the tip goes to the right"),
    Shape("curl_up", "curl", 1, "the part from blade to tip turns up against the part from body to blade"),
    Shape(
        "bend_down", "curl", -1, "the part from blade to tip turns down against the part from body to blade"
    ),
    Shape("body_up", "body z", 1, "the middle of front, body and back goes up"),
    Shape("body_down", "body z", -1, "the middle of front, body and back goes down"),
    Shape("body_front", "body y", 1, "the middle of front, body and back goes to the front"),
    Shape("body_back", "body y", -1, "the middle of front, body and back goes to the back"),
    Shape("body_left", "body x", 1, "the middle of front, body and back goes to the left"),
    Shape("body_right", "body x", -1, "the middle of front, body and back goes to the right"),
    Shape("wide", "width", 1, "the edges go apart"),
    Shape("narrow", "width", -1, "the edges come together"),
    Shape("long", "length", 1, "the way from tip to body along the middle gets longer"),
    Shape("short", "length", -1, "the way from tip to body along the middle gets shorter"),
    Shape("groove", "groove", 1, "the middle sinks between the points halfway to the edges"),
    Shape("ridge", "groove", -1, "the middle rises between the points halfway to the edges"),
    Shape("arched", "dome", 1, "the surface rises above the line from edge to edge"),
    Shape("flat", "dome", -1, "the surface comes down to the line from edge to edge"),
    Shape("roll", "sides", 1, "both sides turn up"),
    Shape(
        "twist_left", "twist", 1, "the blade turns against the body: its left edge down, its right edge up"
    ),
    Shape(
        "twist_right", "twist", -1, "the blade turns against the body: its right edge down, its left edge up"
    ),
    Shape("lean_left", "lean", 1, "the body turns about its length: left edge down, right edge up"),
    Shape("lean_right", "lean", -1, "the body turns about its length: right edge down, left edge up"),
    Shape("out", "out", 1, "the tip is in front of the upper incisors' edge, y = 0"),
)

_AXIS_NAMES = [axis.name for axis in AXES]
_OUT = _AXIS_NAMES.index("out")
_AXIS_OF_SHAPE = np.array([_AXIS_NAMES.index(shape.axis) for shape in SHAPES])
_SIGN_OF_SHAPE = np.array([float(shape.sign) for shape in SHAPES])
_UNIT_OF_SHAPE = tuple(AXES[axis].unit for axis in _AXIS_OF_SHAPE)


class ShapeMeter:
    """Measures the shapes of one model's poses.

    ranges: shape -> (value for 0, value for 1), in the shape's own unit, of a session's [shapes] or any part of them;
    the rest is `default_ranges`. Raises InputError for unknown names and for ranges that are none.
    names: (shapes,) of everything that `measure` returns. Not for several threads at once: it remembers the speaker.
    """

    def __init__(self, model: TongueModel, ranges: Mapping[str, tuple[float, float]] | None = None) -> None:
        self._landmarks = landmark_model(model)
        self.names = shape_names(model.pose.size)
        self.units = (*_UNIT_OF_SHAPE, *("raw" for _ in range(model.pose.size)))
        merged = default_ranges(model) | checked_ranges(ranges or {}, self.names)
        self.ranges = {name: merged[name] for name in self.names}
        self._low = np.array([low for low, _ in self.ranges.values()])
        self._span = np.array([high - low for low, high in self.ranges.values()])
        self._speaker: FloatArray | None = None
        self._directions = np.zeros(0)
        self._neutral = np.zeros(0)

    @property
    def rebased(self) -> Rebased:
        """The ranges of `pose_0` to `pose_<K-1>`, as everything that re-bases wants them."""
        return rebased_pose(self._landmarks.pose, self.ranges)

    def raw(self, speaker_weights: FloatArray, weights: FloatArray) -> FloatArray:
        """(shapes,) what each shape is made of: mm, degrees, or the raw weight."""
        if self._speaker is None or not np.array_equal(self._speaker, speaker_weights):
            self._speaker = np.array(speaker_weights, dtype=np.float64)
            self._directions = np.tensordot(self._speaker, self._landmarks.core, axes=1)
            self._neutral = _neutral_axes(self._points(self._landmarks.pose.mean))
        axes = axes_of(self._points(weights)) - self._neutral
        return np.concatenate([_SIGN_OF_SHAPE * axes[_AXIS_OF_SHAPE], weights])

    def measure(self, speaker_weights: FloatArray, weights: FloatArray) -> FloatArray:
        """(shapes,) in 0..1, for raw weights (m,) of the speaker and (K,) of the pose."""
        unit = (self.raw(speaker_weights, weights) - self._low) / self._span
        return np.minimum(np.maximum(unit, 0.0), 1.0)

    def _points(self, weights: FloatArray) -> list[list[float]]:
        points: list[list[float]] = (
            (self._landmarks.origin + weights @ self._directions).reshape(-1, 3).tolist()
        )
        return points


def rebased_pose(mode: Mode, ranges: Mapping[str, tuple[float, float]]) -> Rebased:
    """Which raw pose weights become 0 and 1: the ranges of `pose_0` ... where there are any, else +- 3 sigma."""
    usual = _named(Rebased.of_range(mode.mean, mode.sigma, SIGMAS))
    low, high = zip(*(ranges.get(name, pair) for name, pair in usual.items()), strict=True)
    return Rebased(np.array(low), np.array(high))


def shape_names(directions: int) -> tuple[str, ...]:
    """The names of all shapes of a model with so many pose directions, K."""
    return (*(shape.name for shape in SHAPES), *(f"pose_{k}" for k in range(directions)))


def checked_ranges(
    ranges: Mapping[str, tuple[float, float]], names: tuple[str, ...]
) -> dict[str, tuple[float, float]]:
    """The ranges as they are. Raises InputError for a name that is not among these, or low >= high."""
    for name, (low, high) in ranges.items():
        if name not in names:
            raise InputError(f"[shapes] {name}: there is no such shape; expected some of {', '.join(names)}.")
        if not (np.isfinite([low, high]).all() and low < high):
            raise InputError(
                f"[shapes] {name} = [{low:g}, {high:g}]: expected the value for 0 and a larger one for 1."
            )
    return dict(ranges)


# The measurements -------------------------------------------------------------------------------------

# In plain numbers, not in arrays: for three sections of five points NumPy takes five times as long.
Point = Sequence[float]


def axes_of(points: Sequence[Point]) -> FloatArray:
    """(15,) the quantities of `AXES`, of landmarks (17, 3) mm; lengths and places in mm, angles in degrees.

    A section's `lateral` is the direction from its right edge to its left one; its `up` is at right angles to that and
    to the line from the landmark behind it to the one before it. Heights are along `up`, above the line between the
    edges. Width, groove (halfway points above the middle), dome (mean height of middle and halfway points) and sides
    (how far the way from a halfway point to its edge turns up) are means of blade, front and body.
    """
    tip = points[TIP]
    middles, chain = points[MIDDLES], [tip, *points[MIDDLES]]
    width = groove = dome = sides = length = 0.0
    across = []
    for i in range(SECTIONS):
        left, right = points[LEFT_EDGE][i], points[RIGHT_EDGE][i]
        left_half, right_half = points[LEFT_HALF][i], points[RIGHT_HALF][i]
        chord = _minus(left, right)
        lateral = _unit(chord)
        up = _unit(
            _cross(_minus(chain[i], chain[i + 2]), lateral)
        )  # from the line along the tongue, forwards
        level = 0.5 * (_dot(left, up) + _dot(right, up))
        middle_height = _dot(middles[i], up) - level
        half_height = 0.5 * (_dot(left_half, up) + _dot(right_half, up)) - level
        left_out, right_out = _minus(left, left_half), _minus(right, right_half)
        across.append(lateral)
        width += _dot(chord, lateral)
        groove += half_height - middle_height
        dome += 0.5 * (middle_height + half_height)
        sides += 0.5 * atan2(_dot(left_out, up), _dot(left_out, lateral))
        sides += 0.5 * atan2(_dot(right_out, up), -_dot(right_out, lateral))
        length += _norm(_minus(chain[i], chain[i + 1]))
    blade, body = middles[0], middles[SECTIONS - 1]
    blade_across, body_across = across[0], across[-1]
    hind, fore = _minus(blade, body), _minus(tip, blade)
    curl = atan2(-_dot(_cross(hind, fore), body_across), _dot(hind, fore))
    along = _unit(_minus(tip, body))
    twist = atan2(-_dot(_cross(body_across, blade_across), along), _dot(body_across, blade_across))
    lean = atan2(-body_across[2], body_across[0])
    behind = [sum(axis) / (len(middles) - 1) for axis in zip(*middles[1:])]
    return np.array(
        [
            *(tip[0], -tip[1], tip[2]),
            *(behind[0], -behind[1], behind[2]),
            *(degrees(lean), -tip[1]),
            *(degrees(curl), degrees(twist)),
            *(width / SECTIONS, length),
            *(groove / SECTIONS, dome / SECTIONS, degrees(sides / SECTIONS)),
        ]
    )


def _minus(one: Point, other: Point) -> Point:
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def _dot(one: Point, other: Point) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Point, other: Point) -> Point:
    (a, b, c), (d, e, f) = one, other
    return b * f - c * e, c * d - a * f, a * e - b * d


def _norm(vector: Point) -> float:
    return sqrt(_dot(vector, vector))


def _unit(vector: Point) -> Point:
    """Of length 1; zeros stay zeros, so that points on top of each other make no NaN."""
    norm = _norm(vector) or 1.0
    return vector[0] / norm, vector[1] / norm, vector[2] / norm


# Ranges -----------------------------------------------------------------------------------------------

FEWEST_FRAMES = 50
STRONGEST = 0.98
"""The quantile of a speaker's poses at which a shape is 1: a few wrong frames do not set the scale."""


def _neutral_axes(points: Sequence[Point]) -> FloatArray:
    """What the axes are measured against: those of the neutral tongue, but 0, the incisors, for `out`."""
    axes = axes_of(points)
    axes[_OUT] = 0.0
    return axes


def default_ranges(model: TongueModel) -> dict[str, tuple[float, float]]:
    """The ranges of a speaker of whom nothing is known: 0 at the neutral tongue, 1 where the shape is strongest among
    poses with all weights within mean +- 3 sigma, for the model's mean speaker. `out` is 0 at the incisors; `pose_<k>`
    is 0 at mean - 3 sigma.

    That pose is the corner of the box to which the quantity's slope at the neutral tongue points; exact for places,
    which are linear in the weights.
    """
    speaker = landmark_model(model).for_speaker(model.speaker.mean)
    reach = SIGMAS * speaker.sigma

    def axes_at(weights: FloatArray) -> FloatArray:
        return axes_of(speaker.vertices(weights).tolist())

    neutral = _neutral_axes(speaker.vertices(speaker.mean).tolist())
    little = 0.01 * np.diag(reach)
    slopes = np.array(
        [axes_at(speaker.mean + row) - axes_at(speaker.mean - row) for row in little]
    )  # (K, axes)
    ranges = {}
    for shape, axis in zip(SHAPES, _AXIS_OF_SHAPE, strict=True):
        corner = speaker.mean + reach * np.sign(shape.sign * slopes[:, axis])
        strongest = shape.sign * (axes_at(corner) - neutral)[axis]
        ranges[shape.name] = (0.0, max(float(strongest), LEAST[AXES[axis].unit]))
    return ranges | _named(Rebased.of_range(speaker.mean, speaker.sigma, SIGMAS))


def _named(rebased: Rebased) -> dict[str, tuple[float, float]]:
    pairs = zip(rebased.low.tolist(), rebased.high.tolist(), strict=True)
    return {f"pose_{k}": pair for k, pair in enumerate(pairs)}


def speaker_ranges(
    model: TongueModel, speaker_weights: FloatArray, weights: FloatArray
) -> dict[str, tuple[float, float]]:
    """The ranges of one speaker, from tracked poses: raw weights (frames, m) and (frames, K).

    A shape is 0 at the median and 1 at the 98th percentile of what was measured, so both shapes of an axis are 0 in
    the middle of what this speaker does, to a thousandth; no range is narrower than `LEAST`. `out` is 0 at the incisors
    all the same, and keeps its default as long as the tongue stayed behind them. `pose_<k>` goes from the smallest to
    the largest weight, so that not one of these poses is cut off; a weight that never moved keeps its default. Raises
    InputError for fewer than 50 frames.
    """
    if len(weights) < FEWEST_FRAMES:
        raise InputError(
            f"{len(weights)} tracked frames are too few for a speaker's ranges; expected {FEWEST_FRAMES} or more, of "
            "varied speech."
        )
    meter = ShapeMeter(model)
    raw = np.array([meter.raw(*frame) for frame in zip(speaker_weights, weights, strict=True)])
    middles = np.median(raw, axis=0).tolist()
    tops = np.quantile(raw, STRONGEST, axis=0).tolist()
    ranges = dict(meter.ranges)
    for shape, axis, middle, top in zip(SHAPES, _AXIS_OF_SHAPE, middles, tops):
        least = LEAST[AXES[axis].unit]
        if axis != _OUT:
            ranges[shape.name] = (round(middle, 3), round(max(top, middle + least), 3))
        elif top >= least:
            ranges[shape.name] = (0.0, round(top, 3))
    moved = {name: pair for name, pair in _named(Rebased.of_clip(weights)).items() if pair[0] < pair[1]}
    return ranges | moved
