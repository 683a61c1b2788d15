"""Phones: where the tongue, the jaw and the lips of the reference speaker are, and how speakers differ in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

PHONES = ("i", "e", "ɛ", "a", "ɑ", "ʌ", "ɔ", "o", "u", "ʉ", "ə", "s", "ʃ")
PALATE_PHONES = ("a", "ɑ")
"""Said with a low tongue: their scans show the whole palate."""


@dataclass(frozen=True)
class Articulation:
    """contour: (9, 2) y, z mm, middle of the tongue from the tip to the vallecula, head frame of the reference
    speaker; jaw_deg: its opening; flat: exponent of the cross-section (2.4 round, 4 flat with steep sides);
    brace_mm: sides pushed up against palate and teeth; groove_mm: depth of the furrow along the middle of the
    back; channel_mm: what stays open between the middle of the tongue and the roof, over channel_half_mm to
    both sides; lip_gap_mm, lip_half_mm: half height and half width of the lips' opening; protrusion_mm;
    velum_mm: the soft palate's raising."""

    contour: FloatArray
    jaw_deg: float
    flat: float = 2.6
    brace_mm: float = 0.0
    groove_mm: float = 1.0
    channel_mm: float = 2.5
    channel_half_mm: float = 6.0
    lip_gap_mm: float = 4.0
    lip_half_mm: float = 20.0
    protrusion_mm: float = 0.0
    velum_mm: float = 0.0


def _phone(points: list[tuple[float, float]], jaw_deg: float, **details: float) -> Articulation:
    return Articulation(np.array(points, dtype=np.float64), jaw_deg, **details)


# The points: tip, blade, front, two on the dorsum, its back edge, two on the root, vallecula.
_TABLE = {
    "i": _phone(
        [(4, -8), (9, -1), (16, 7), (25, 12), (34, 11.5), (44, 4.5), (50.5, -8), (52.5, -26), (52.5, -41)],
        3.0, flat=4.2, brace_mm=10.5, groove_mm=3.0, channel_mm=2.4, channel_half_mm=5.0, lip_gap_mm=3.5,
        lip_half_mm=24.0, velum_mm=1.5,
    ),
    "e": _phone(
        [(4, -9), (9, -3.5), (16, 3.5), (25, 8.5), (34, 8.5), (44, 3), (51.5, -9), (54.5, -26), (53.5, -41)],
        4.5, flat=4.2, brace_mm=12.0, groove_mm=2.5, channel_mm=3.0, channel_half_mm=5.5, lip_gap_mm=4.5,
        lip_half_mm=23.0, velum_mm=1.0,
    ),
    "ɛ": _phone(
        [(5, -12), (10, -7.5), (17, -1.5), (26, 3.5), (35, 4.5), (46, 0.5), (54.5, -10), (58, -26), (56, -41)],
        7.0, flat=2.8, brace_mm=2.0, groove_mm=1.5, lip_gap_mm=6.0, lip_half_mm=22.0, velum_mm=0.5,
    ),
    "a": _phone(
        [(7, -17), (12, -13), (20, -7.5), (29, -3.5), (38, -2), (48, -3.5), (56.5, -11), (61.5, -26), (57, -42)],
        11.0, flat=2.5, groove_mm=0.5, lip_gap_mm=9.0, lip_half_mm=22.0,
    ),
    "ɑ": _phone(
        [(10, -18), (15, -14.5), (23, -9.5), (32, -5), (41, -1.5), (52, -1.5), (60.5, -9), (64.5, -25), (58, -42)],
        11.0, flat=2.4, groove_mm=0.3, lip_gap_mm=8.5, lip_half_mm=20.0, velum_mm=-0.5,
    ),
    "ʌ": _phone(
        [(7, -14), (12, -10), (20, -5), (29, -1), (38, 1), (49, -0.5), (58, -8), (63, -25), (57.5, -41.5)],
        7.5, flat=2.5, groove_mm=0.6, lip_gap_mm=6.0, lip_half_mm=20.0,
    ),
    "ɔ": _phone(
        [(12, -16), (16.5, -11.5), (24, -6), (33, 0), (42, 4), (53, 2), (60.5, -7), (64, -24), (58, -42)],
        9.0, flat=2.4, groove_mm=0.3, lip_gap_mm=5.0, lip_half_mm=13.0, protrusion_mm=2.5,
    ),
    "o": _phone(
        [(10, -13.5), (15, -8.5), (23, -2), (32, 4), (41, 7), (51.5, 4.5), (58.5, -5), (61.5, -23), (57, -42)],
        6.0, flat=2.5, brace_mm=0.5, groove_mm=0.5, channel_mm=3.5, lip_gap_mm=3.0, lip_half_mm=10.0,
        protrusion_mm=4.0, velum_mm=0.5,
    ),
    "u": _phone(
        [(10, -11), (15, -6), (22, 1), (31, 8), (40, 10.5), (50, 7), (56, -4), (57.5, -22), (55, -42)],
        3.5, flat=2.7, brace_mm=1.5, groove_mm=1.0, channel_mm=3.0, channel_half_mm=7.0, lip_gap_mm=2.0,
        lip_half_mm=7.0, protrusion_mm=5.5, velum_mm=1.5,
    ),
    "ʉ": _phone(
        [(5, -9), (10, -4), (17, 3.5), (26, 9), (35, 9.5), (45.5, 4), (53, -8), (55.5, -25), (54.5, -41)],
        3.5, flat=3.2, brace_mm=4.0, groove_mm=2.0, channel_mm=3.0, lip_gap_mm=2.5, lip_half_mm=10.0,
        protrusion_mm=4.0, velum_mm=1.0,
    ),
    "ə": _phone(
        [(5, -10), (10, -5.5), (18, 0), (27, 4), (36, 5), (46.5, 2), (55, -8), (59.5, -25), (56.5, -41)],
        5.0, groove_mm=1.0, lip_gap_mm=4.5, lip_half_mm=20.0,
    ),
    "s": _phone(
        [(4.5, -2), (9, 3.5), (15, 5), (24, 4.5), (34, 4), (45.5, 1), (54, -9), (57.5, -25), (55.5, -41)],
        2.5, flat=4.6, brace_mm=13.0, groove_mm=2.5, channel_mm=1.6, channel_half_mm=2.6, lip_gap_mm=3.0,
        lip_half_mm=22.0, velum_mm=2.0,
    ),
    "ʃ": _phone(
        [(7, -1.5), (11, 3.5), (16, 8.5), (24, 10.5), (33, 9.5), (44, 4.5), (52, -7), (55, -25), (54, -41)],
        2.5, flat=4.2, brace_mm=9.5, groove_mm=2.0, channel_mm=2.2, channel_half_mm=3.6, lip_gap_mm=4.0,
        lip_half_mm=13.0, protrusion_mm=3.5, velum_mm=2.0,
    ),
}  # fmt: skip
CONTACT_PHONES = ("i", "e", "s", "ʃ")
"""Those whose sides always press against the hard palate; others may touch it in some speakers."""


def articulation_of(phone: str) -> Articulation:
    """The reference speaker's articulation of one of PHONES."""
    return _TABLE[phone]


def speakers_articulation(phone: str, habits: np.random.Generator, take: np.random.Generator) -> Articulation:
    """How one speaker says a phone in one scan.

    habits: the same random state for all phones of a speaker (how far targets are reached, a resting posture);
    take: another for every scan (this phone's own deviation).
    """
    neutral = _TABLE["ə"]
    target = _TABLE[phone]
    reach = 1.0 + 0.08 * _bounded(habits)
    front, up = 1.0 * _bounded(habits), 0.7 * _bounded(habits)
    tip_up, root_back = 1.2 * _bounded(habits), 1.2 * _bounded(habits)
    brace = 1.0 + 0.2 * _bounded(habits)
    contour = neutral.contour + reach * (target.contour - neutral.contour)
    contour += [front, up]
    contour[:2, 1] += np.array([1.0, 0.5]) * tip_up
    contour[6:8, 0] += root_back
    # A take's deviation: a slow one along the contour, and a little of every point's own.
    places = np.linspace(0.0, np.pi, len(contour))
    for part in range(2):
        contour[:, part] += 0.6 * _bounded(take) * np.cos(places) + 0.6 * _bounded(take) * np.sin(places)
        contour[:, part] += 0.3 * take.normal(size=len(contour)).clip(-2, 2)
    return replace(
        target,
        contour=contour,
        jaw_deg=max(1.5, target.jaw_deg * (1.0 + 0.08 * _bounded(take))),
        brace_mm=target.brace_mm * brace,
        velum_mm=target.velum_mm + 0.5 * _bounded(take),
    )


def _bounded(random: np.random.Generator) -> float:
    return float(np.clip(random.normal(), -1.8, 1.8))
