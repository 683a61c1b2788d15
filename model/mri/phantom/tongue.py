"""A tongue in a head: from an articulation to a surface that keeps its volume and goes through no wall.

The surface is a radius around a pole line (parallel to x, inside the tongue's body): radius(angle, across), angle
from the floor of the mouth below the tip over the dorsum to the vallecula, across from -1 (right) to 1 (left).
All at reference size in the head frame (`anatomy`), mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .anatomy import STEP_MM, Anatomy, Head, head_of
from .articulation import Articulation, articulation_of
from .tissue import (
    DEGREE_STEP,
    PALATE,
    TEETH,
    VELUM,
    WALL,
    Pose,
    degrees_around,
    from_jaw_frame,
    in_jaw_frame,
    lookup,
    ray_limits,
)

FloatArray = NDArray[np.float64]

REFERENCE = Anatomy("reference")
ACROSS = 73  # columns of the radius table
POLE = (34.0, -28.0)
FLOOR = (11.0, -19.0)  # where the tongue meets the floor of the mouth behind the incisors, jaw closed
# From the tip along the middle, mm: half width of the tongue, and how deep its rounded top is.
PLACES = np.array([-20.0, -10.0, 0.0, 6.0, 12.0, 20.0, 32.0, 45.0, 58.0, 72.0, 90.0, 105.0])
HALF_WIDTHS = np.array([14.0, 12.0, 11.0, 12.8, 15.0, 17.6, 19.6, 20.6, 20.6, 18.8, 16.8, 15.5])
TOP_DEPTHS = np.array([8.0, 9.0, 12.0, 13.0, 13.0, 13.0, 13.5, 14.0, 13.5, 12.0, 10.0, 8.0])
MARGIN_MM = 0.3  # between the tongue's sides and the lower gum
WALL_CLEARANCE_MM = 3.5
LARGEST_SWELLING_MM = 4.0
CONTACT_MM = 0.3


@dataclass(frozen=True)
class Tongue:
    """pose: what the kernels need; angles (rows,) degrees and tip_row of its radius table; middle: (rows, 2) y, z
    of the surface's middle; gap: (rows, ACROSS) mm left along the ray to what would stop it, `stop` (same
    shape) says what that is; volume_mm3 (reference size); base: (2,) y, z of the floor below the tip."""

    pose: Pose
    angles: FloatArray
    tip_row: int
    middle: FloatArray
    gap: FloatArray
    stop: NDArray[np.int8]
    volume_mm3: float
    base: FloatArray


def tongue_of(anatomy: Anatomy, head: Head, articulation: Articulation) -> Tongue:
    """The tongue of a speaker in an articulation, its volume that of the speaker's neutral tongue."""
    wanted = neutral_volume(anatomy)
    low, high = -LARGEST_SWELLING_MM, LARGEST_SWELLING_MM
    parts = _prepared(anatomy, head, articulation)
    for _ in range(12):
        swelling = 0.5 * (low + high)
        if _pressed(parts, articulation, swelling).volume_mm3 < wanted:
            low = swelling
        else:
            high = swelling
    return _pressed(parts, articulation, 0.5 * (low + high))


@lru_cache(maxsize=4)
def neutral_volume(anatomy: Anatomy) -> float:
    """mm^3 at reference size, which a speaker's tongue has in every articulation."""
    return shaped(anatomy, head_of(anatomy), articulation_of("ə"), anatomy.tongue_mm).volume_mm3


def shaped(anatomy: Anatomy, head: Head, articulation: Articulation, swelling_mm: float) -> Tongue:
    """The tongue with its surface moved outwards by a given length, whatever the volume."""
    return _pressed(_prepared(anatomy, head, articulation), articulation, swelling_mm)


@dataclass(frozen=True)
class _Parts:
    """What does not depend on the swelling; rows are angles. radius: (rows,) of the middle; beyond_tip: (rows,)
    mm along the middle; limit, stop: (rows, ACROSS) where the ray ends and at what."""

    pose: Pose
    angles: FloatArray
    radius: FloatArray
    beyond_tip: FloatArray
    top_depth: FloatArray
    limit: FloatArray
    stop: NDArray[np.int8]
    base: FloatArray


def _prepared(anatomy: Anatomy, head: Head, articulation: Articulation) -> _Parts:
    jaw = _turn(articulation.jaw_deg * anatomy.jaw)
    contour = _fitted_to(anatomy, head, articulation.contour)
    rest = _turn(articulation_of("ə").jaw_deg * anatomy.jaw)
    pole_place = np.array([POLE[0] * anatomy.mouth, -9.0 + (POLE[1] + 9.0) * anatomy.pharynx])
    # The pole goes half of the way with the jaw: the hyoid follows it.
    closed_y, closed_z = in_jaw_frame(pole_place[0], pole_place[1], rest)
    moved = np.array(from_jaw_frame(closed_y, closed_z, jaw))
    pole = 0.5 * (pole_place + moved)
    base = np.array(from_jaw_frame(*FLOOR, jaw))
    under = 0.45 * base + 0.55 * contour[0] + [1.2, -1.0]
    angles, radius, beyond_tip = _around_pole(np.vstack([base, under, contour]), pole)

    top_depth = np.interp(beyond_tip, PLACES, TOP_DEPTHS)
    width = np.interp(beyond_tip, PLACES, HALF_WIDTHS) * anatomy.tongue_width
    rim_y = pole[0] - (radius - top_depth) * np.cos(np.radians(angles))
    rim_z = pole[1] + (radius - top_depth) * np.sin(np.radians(angles))
    for row, (y, z) in enumerate(zip(rim_y, rim_z, strict=True)):
        if y < 52.0:
            jaw_y = in_jaw_frame(y, z, jaw)[0] - 2.5
            width[row] = min(width[row], lookup(head.arch, jaw_y / STEP_MM) - MARGIN_MM)
    width = _smoothed(width, 6)

    root_y = float(np.interp(200.0, angles, pole[0] - radius * np.cos(np.radians(angles))))
    pose = Pose(
        jaw,
        float(pole[0]),
        float(pole[1]),
        float(angles[0]),
        width,
        np.zeros((len(angles), ACROSS)),
        float(base[1]),
        root_y + 5.5,
        articulation.lip_gap_mm,
        articulation.lip_half_mm,
        articulation.protrusion_mm,
        _velum(anatomy, head, articulation),
    )
    limit, stop = ray_limits(angles, head, pose)
    return _Parts(pose, angles, radius, beyond_tip, top_depth, limit, stop, base)


def _pressed(parts: _Parts, articulation: Articulation, swelling_mm: float) -> Tongue:
    across = np.linspace(-1.0, 1.0, ACROSS)
    x = parts.pose.width[:, None] * across
    s = parts.beyond_tip[:, None]
    # The blade is held where it is; what it takes comes from the body and the root.
    ends = np.clip(s / 40.0, 0.0, 1.0) * np.clip((110.0 - s) / 15.0, 0.0, 1.0)
    middle = parts.radius[:, None] + swelling_mm * ends
    low = middle - parts.top_depth[:, None]
    brace = articulation.brace_mm * np.clip((s - 2.0) / 8.0, 0.0, 1.0) * np.clip((58.0 - s) / 16.0, 0.0, 1.0)
    furrow = articulation.groove_mm * np.exp(-((x / 5.5) ** 2) - ((s - 62.0) / 16.0) ** 2)
    furrow += 0.4 * articulation.groove_mm * np.exp(-((x / 4.5) ** 2) - ((s - 24.0) / 14.0) ** 2)
    high = middle + brace * across**2 - furrow
    wish = low + (high - low) * np.sqrt(1.0 - np.abs(across) ** articulation.flat)
    overhead = np.isin(parts.stop, (PALATE, VELUM))
    channel = np.where(
        overhead, articulation.channel_mm * np.exp(-((x / articulation.channel_half_mm) ** 4)), 0.0
    )
    channel = np.where(parts.stop == WALL, WALL_CLEARANCE_MM * np.exp(-((x / 11.0) ** 4)), channel)
    radius = np.minimum(wish, parts.limit - channel)
    volume = 0.5 * np.radians(DEGREE_STEP) * (2.0 / (ACROSS - 1))
    volume *= float((radius**2 * parts.pose.width[:, None]).sum())
    centre = radius[:, ACROSS // 2]
    turned = np.radians(parts.angles)
    line = np.column_stack(
        [parts.pose.pole_y - centre * np.cos(turned), parts.pose.pole_z + centre * np.sin(turned)]
    )
    return Tongue(
        parts.pose._replace(radius=np.ascontiguousarray(radius)),
        parts.angles,
        int(np.argmin(line[: len(line) // 2, 0])),
        line,
        parts.limit - radius,
        parts.stop,
        volume,
        parts.base,
    )


def _turn(degrees: float) -> tuple[float, float]:
    return float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))


def _fitted_to(anatomy: Anatomy, head: Head, contour: FloatArray) -> FloatArray:
    """The reference speaker's contour in this speaker's mouth: longer or shorter, and as far from the roof."""
    y, z = contour.T
    reference = _roof_over(head_of(REFERENCE), y)
    there = y * anatomy.mouth
    near_roof = np.clip((z - reference + 16.0) / 14.0, 0.0, 1.0) * (y < 58.0)
    up = np.where(z < -9.0, -9.0 + (z + 9.0) * anatomy.pharynx, z)
    up = up + near_roof * (_roof_over(head, there) - reference)
    behind = np.clip((y - 45.0) / 15.0, 0.0, 1.0)
    there = there + behind * (anatomy.wall_mm - 71.0 - (anatomy.mouth - 1.0) * y)
    return np.column_stack([there, up])


def _roof_over(head: Head, y: FloatArray) -> FloatArray:
    return np.interp(y / STEP_MM, np.arange(len(head.roof)), head.roof)


def _around_pole(points: FloatArray, pole: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A smooth contour through (n, 2) points as (rows,) angles in degrees, radii, and mm from the tip (point 2)."""
    from scipy.interpolate import CubicSpline

    chord = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1)))])
    dense = CubicSpline(chord, points)(np.linspace(0.0, chord[-1], 1500))
    angle = np.array([degrees_around(y, z, pole[0], pole[1]) for y, z in dense])
    radius = np.linalg.norm(dense - pole, axis=1)
    keep = np.concatenate([[True], angle[1:] > np.maximum.accumulate(angle)[:-1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    angles = np.arange(angle[0], angle[-1], DEGREE_STEP)
    along = np.interp(angles, angle[keep], length[keep])
    tip = length[int(np.argmin(dense[: len(dense) // 2, 0]))]
    return angles, _smoothed(np.interp(angles, angle[keep], radius[keep]), 2), along - tip


def _velum(anatomy: Anatomy, head: Head, articulation: Articulation) -> FloatArray:
    """(5, 4) y, z, radius, half width: raised against the pharyngeal wall, as in all oral sounds."""
    half = 0.5 * anatomy.velum_mm
    start = float(_roof_over(head, np.array([47.0]))[0])
    lift = articulation.velum_mm
    shift = anatomy.wall_mm - 71.0
    return np.array(
        [
            [46.5, start + 0.8 * half, 0.8 * half, 18.0],
            [55.0 + 0.5 * shift, start + 1.5 + 0.7 * lift, half, 17.0],
            [62.0 + shift, start - 1.5 + lift, half, 15.0],
            [66.0 + shift, start - 8.0 + 0.7 * lift, 0.8 * half, 8.0],
            [66.0 + shift, start - 15.0 + 0.5 * lift, 0.55 * half, 3.5],
        ]
    )


def _smoothed(values: FloatArray, width: int) -> FloatArray:
    """A running mean over 2 width + 1 entries, the ends repeated."""
    padded = np.pad(values, width, mode="edge")
    return np.convolve(padded, np.full(2 * width + 1, 1.0 / (2 * width + 1)), mode="valid")


def touches_teeth(tongue: Tongue) -> NDArray[np.bool_]:
    """(rows, ACROSS): where the surface lies at teeth or the lower gum."""
    return (tongue.stop == TEETH) & (tongue.gap < CONTACT_MM)


def touches_palate(tongue: Tongue) -> NDArray[np.bool_]:
    """(rows, ACROSS): where the surface lies at the hard palate."""
    return (tongue.stop == PALATE) & (tongue.gap < CONTACT_MM)
