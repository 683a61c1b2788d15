"""Speakers of the phantom: what does not move in a head, as numbers and as tables that kernels look up.

Head frame, mm: the origin is the edge of the upper incisors in the mid-sagittal plane; x to the left, y back,
z up, the biting plane at z = 0. A speaker's geometry is written for a reference size and scaled as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

STEP_MM = 0.5  # of all tables
ROOF_START_MM = 3.5  # the roof and the arch begin at the gum behind the upper incisors
PALATE_END_MM = 48.0  # the posterior nasal spine; the soft palate begins
TABLE_END_MM = 100.0
PLAN_FRONT_MM = -30.0
PLAN_SIDE_MM = 45.0
HEIGHT_LOW_MM = -85.0
HEIGHT_HIGH_MM = 65.0
HINGE = (82.0, 20.0)  # (y, z): a jaw turning here opens as a real one does that also slides forward
LOWER_ARCH_BEHIND_MM = 2.5


@dataclass(frozen=True)
class Anatomy:
    """One speaker.

    size: everything, 1 = the reference adult; mouth, pharynx: lengths of the oral and the pharyngeal part of the
    tongue, ratios; tongue_mm: the tongue's surface outwards of the reference (its volume); tongue_width: ratio;
    palate_mm: height of the hard palate's vault over the biting plane; palate_apex_mm: its distance behind the
    incisors; palate_width: of the dental arch, ratio; doming: exponent of the vault across (1.5 = steep gable,
    3.5 = flat roof with steep sides); ridge_mm: prominence of the alveolar ridge; skew: slant of the roof, mm
    a mm; wall_mm: the pharyngeal wall behind the incisors; lordosis_mm: its curvature; jaw: ratio of the jaw's
    opening; chin_mm: height of the chin; velum_mm: thickness of the soft palate.
    """

    name: str
    size: float = 1.0
    mouth: float = 1.0
    pharynx: float = 1.0
    tongue_mm: float = 0.0
    tongue_width: float = 1.0
    palate_mm: float = 15.0
    palate_apex_mm: float = 29.0
    palate_width: float = 1.0
    doming: float = 2.2
    ridge_mm: float = 0.0
    skew: float = 0.0
    wall_mm: float = 71.0
    lordosis_mm: float = 2.0
    jaw: float = 1.0
    chin_mm: float = 31.0
    velum_mm: float = 7.5


class Head(NamedTuple):
    """An anatomy in tables, reference size. On y = 0, 0.5, ... mm: roof (z of the hard palate's middle), arch (half
    width of the upper gum line). plan: (x, y) signed distance from that line seen from above, positive outside.
    On z from HEIGHT_LOW_MM: wall (y of the pharyngeal wall), face, chin (y of the skin, the latter in the
    jaw's frame)."""

    size: float
    roof: FloatArray
    arch: FloatArray
    plan: FloatArray
    wall: FloatArray
    face: FloatArray
    chin: FloatArray
    doming: float
    skew: float
    vault_mm: float
    jaw_depth_mm: float
    velum_mm: float


def random_anatomy(name: str, random: np.random.Generator) -> Anatomy:
    """A speaker of a population of adults: women smaller, with shorter pharynx, in seven of eleven draws."""
    male = random.random() < 4 / 11

    def around(middle: float, spread: float) -> float:
        return round(float(middle + spread * np.clip(random.normal(), -1.8, 1.8)), 3)

    return Anatomy(
        name,
        size=around(1.02 if male else 0.94, 0.025),
        mouth=around(1.0, 0.03),
        pharynx=around(1.06 if male else 0.94, 0.05),
        tongue_mm=around(0.0, 1.0),
        tongue_width=around(1.0, 0.04),
        palate_mm=around(15.0, 1.6),
        palate_apex_mm=around(29.0, 1.8),
        palate_width=around(1.0, 0.045),
        doming=around(2.2, 0.35),
        ridge_mm=around(0.0, 0.7),
        skew=around(0.0, 0.012),
        wall_mm=around(71.0, 1.2),
        lordosis_mm=around(2.0, 1.0),
        jaw=around(1.0, 0.12),
        chin_mm=around(31.0, 2.0),
        velum_mm=around(7.5, 0.8),
    )


@lru_cache(maxsize=4)
def head_of(anatomy: Anatomy) -> Head:
    """The tables of a speaker."""
    along = _along()
    up = np.arange(HEIGHT_LOW_MM, HEIGHT_HIGH_MM + STEP_MM / 2, STEP_MM)
    arch = _arch(anatomy, along)
    # Lordosis: the neck's curve bulges towards the mouth at the height of the chin.
    wall = (
        anatomy.wall_mm
        + anatomy.lordosis_mm * (((up + 28.0) / 28.0) ** 2 - 1.0).clip(-1.0, 1.2)
        - 0.55 * (up - 14.0).clip(0.0, None)
    )
    face = _curve([-90, -10, -3, 3, 9, 13, 22, 32, 70], [-9, -10, -12.5, -12, -10.5, -13, -20, -17, -6], up)
    low = -anatomy.chin_mm
    chin = _curve(
        [low - 60, low - 26, low - 12, low - 5, low + 4, -16, -8, -2, 4, 40],
        [78, 42, 8, -6, -10.5, -6.5, -9.5, -11, -9, -8],
        up,
    )
    return Head(
        anatomy.size,
        roof_of(anatomy),
        arch,
        _plan(along, arch),
        wall,
        face,
        chin,
        anatomy.doming,
        anatomy.skew,
        anatomy.palate_mm,
        anatomy.chin_mm,
        anatomy.velum_mm,
    )


def roof_of(anatomy: Anatomy) -> FloatArray:
    """z of the hard palate's middle on y = 0, STEP_MM, ...: gum, alveolar ridge, vault, posterior nasal spine."""
    top = anatomy.palate_mm
    apex = anatomy.palate_apex_mm
    ridge = anatomy.ridge_mm
    return _curve(
        [0, 3.5, 6.5, 10.5, 14.0, 20.0, apex, 38.0, PALATE_END_MM, 60, 101],
        [1.0, 2.2, 4.0 - 0.4 * ridge, 5.6 - ridge, 0.6 * top - 0.5 * ridge, 0.86 * top, top, top - 0.5]
        + [top - 2.6, top - 5.0, top - 8.0],
        _along(),
    )


def _along() -> FloatArray:
    return np.arange(0.0, TABLE_END_MM + STEP_MM / 2, STEP_MM)


def _arch(anatomy: Anatomy, along: FloatArray) -> FloatArray:
    half = _curve(
        [3.5, 5.0, 8.0, 14.0, 22.0, 32.0, 42.0, 52.0, 101.0],
        [0.0, 6.8, 10.4, 13.8, 16.2, 18.2, 19.6, 20.3, 20.6],
        along,
    )
    return np.where(along < ROOF_START_MM, 0.0, half * anatomy.palate_width)


def _plan(along: FloatArray, arch: FloatArray) -> FloatArray:
    """Signed distance from the gum line in the biting plane, on x = 0 ..., y = PLAN_FRONT_MM ...."""
    from scipy.spatial import cKDTree

    dense = np.linspace(ROOF_START_MM, TABLE_END_MM, 6000)
    half = np.interp(dense, along, arch)
    line = np.vstack([np.column_stack([half, dense]), np.column_stack([-half, dense])])
    x = np.arange(0.0, PLAN_SIDE_MM + STEP_MM / 2, STEP_MM)
    y = np.arange(PLAN_FRONT_MM, TABLE_END_MM + STEP_MM / 2, STEP_MM)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    distance = np.asarray(cKDTree(line).query(places.reshape(-1, 2))[0]).reshape(len(x), len(y))
    inside = (places[..., 1] > ROOF_START_MM) & (places[..., 0] < np.interp(places[..., 1], along, arch))
    return np.where(inside, -distance, distance)


def _curve(places: list[float], values: list[float], at: FloatArray) -> FloatArray:
    """A curve through the points that never overshoots them."""
    from scipy.interpolate import PchipInterpolator

    clipped = np.clip(at, places[0], places[-1])
    return np.asarray(PchipInterpolator(places, values)(clipped), dtype=np.float64)
