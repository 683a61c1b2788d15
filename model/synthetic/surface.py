"""The tongue's surface from a speaker and an articulation."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .anatomy import Anatomy
from .articulation import Articulation
from .template import CONTROL_POINTS, TongueTemplate, tongue_template

FloatArray = NDArray[np.float64]

HINGE = np.array([88.0, 42.0])  # (y, z) mm of the jaw's axis, reference speaker
REST_JAW_DEG = 4.0  # the neutral contour holds the jaw of a schwa
# Cross-section at places along the contour (mm from the tip): half width in mm, and how flat its top is.
# Narrow and flat at the tip, wide and rounder at the dorsum.
PLACES = np.array([-30.0, -22.0, -12.0, -6.0, 0.0, 5.0, 12.0, 24.0, 38.0, 52.0, 66.0, 80.0, 110.0])
HALF_WIDTHS = np.array([5.0, 6.5, 8.5, 10.0, 12.0, 14.0, 17.5, 22.0, 24.5, 24.0, 21.0, 19.0, 18.0])
FLATNESSES = np.array([1.7, 1.8, 1.9, 1.9, 1.9, 1.9, 1.9, 1.8, 1.65, 1.6, 1.6, 1.5, 1.4])
# The open base: a straight line from behind the first row to before the last, in the sagittal plane.
BASE_BEHIND_FRONT_MM = np.array([5.0, -2.0])
BASE_BEFORE_ROOT_MM = np.array([-11.0, -2.0])
TEETH_BEHIND_EDGE_MM = 2.0  # inner side of the incisors, behind their edge
AIR_CHANNEL_MM = 1.2  # the phones are vowels and sibilants: air passes along the middle
CONTACT_SOFTNESS_MM = 0.5  # how near a wall its pressure is felt


def tongue_surface(anatomy: Anatomy, articulation: Articulation) -> FloatArray:
    """(n, 3) mm: the vertices of `tongue_template()` for this speaker in this articulation.

    The contour is moved by muscles and jaw, swept across by a width and a depth that keep the volume, and
    pressed against teeth, palate and pharyngeal wall without crossing them.
    """
    template = tongue_template()
    groove = np.repeat(_groove_depth(anatomy, articulation, template), len(template.theta))
    return _pressed_against_walls(_swept(anatomy, articulation, template), anatomy, groove)


def enclosed_volume(vertices: FloatArray) -> float:
    """mm^3 between the surface and a fan that closes its open base, seen from the fan's centre."""
    template = tongue_template()
    grid = np.arange(len(vertices)).reshape(len(template.s), len(template.theta))
    rim = np.concatenate([grid[0], grid[1:, -1], grid[-1, -2::-1], grid[-2:0:-1, 0]])
    # Seen from the rim's centre, the closing fan has no volume of its own.
    a, b, c = (vertices[template.faces[:, corner]] - vertices[rim].mean(axis=0) for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _neutral_contour(anatomy: Anatomy, template: TongueTemplate) -> FloatArray:
    """(rows, 2) y, z mm of the speaker at rest."""
    points = CONTROL_POINTS.copy()
    points[:, 1] += 8.0  # heights above the blade's level, so that thickness stretches downwards
    below = points[:, 1] < 0.0
    points[below, 1] *= anatomy.thickness
    back = points[:, 0] > 45.0
    points[back & below, 1] *= anatomy.pharynx / anatomy.thickness
    points[:, 1] -= 8.0
    points[:, 0] *= anatomy.mouth
    tip = slice(3, 6)
    points[tip, 0] -= 8.0 * (anatomy.blade - 1.0)
    return np.asarray(template.basis @ points * anatomy.size)


def _contour(anatomy: Anatomy, articulation: Articulation, template: TongueTemplate) -> FloatArray:
    """(rows, 2) y, z mm of the mid-sagittal contour, before contact."""
    a = articulation
    size = anatomy.size
    s = template.s - template.tip_s  # mm along the reference contour from the tip, underside negative
    contour = _neutral_contour(anatomy, template)
    normal = _normals(contour)

    body = _plateau(s, 6.0, 66.0, 9.0)
    followers = 0.6 * body + 0.4 * _plateau(s, -80.0, 66.0, 9.0)  # the tip and the floor follow in part
    contour[:, 0] -= size * a.body_front_mm * followers
    contour[:, 1] += size * a.body_up_mm * _plateau(s, 10.0, 62.0, 9.0)
    contour[:, 0] -= size * a.root_front_mm * _plateau(s, 66.0, 140.0, 8.0)

    place = 14.0 + 52.0 * a.arch_place
    contour += size * a.arch_mm * _bell(s, place, 12.5)[:, None] * normal

    at_tip = _plateau(s, -9.0, 5.0, 4.5)
    front = 0.3 * _plateau(s, -14.0, 9.0, 7.0) + 0.7 * _plateau(s, -80.0, 9.0, 7.0)
    contour[:, 0] -= size * a.tip_front_mm * front
    contour[:, 1] += size * a.tip_up_mm * at_tip
    contour[:, 1] += size * a.blade_up_mm * _bell(s, 11.0, 8.0)

    share = 1.0 - 0.72 * _plateau(s, 58.0, 200.0, 14.0)  # the root hardly follows the jaw
    angle = np.radians(a.jaw_deg - REST_JAW_DEG) * share
    hinge = HINGE * size * np.array([anatomy.mouth, 1.0])
    rest = contour - hinge
    cos, sin = np.cos(angle), np.sin(angle)
    rotated = np.column_stack(
        [hinge[0] + cos * rest[:, 0] - sin * rest[:, 1], hinge[1] + sin * rest[:, 0] + cos * rest[:, 1]]
    )
    return _stopped(rotated, anatomy, s)


def _stopped(contour: FloatArray, anatomy: Anatomy, s: FloatArray) -> FloatArray:
    """The contour with its tip held back by the incisors, and held down where it would enter the palate.

    Flesh beside and below a contact is moved along with it: pressing alone would squeeze the tip flat.
    """
    stopped = contour.copy()
    too_far = float(_soft_positive(TEETH_BEHIND_EDGE_MM * anatomy.size - contour[:, 0].min()))
    stopped[:, 0] += too_far * _plateau(s, -80.0, 12.0, 7.0)
    palate = anatomy.palate_z(np.zeros(len(s)), stopped[:, 0])
    upper = (s > -4.0) & (s < 60.0)
    too_high = np.where(upper, _soft_positive(stopped[:, 1] - palate + AIR_CHANNEL_MM * anatomy.size), 0.0)
    nearness = np.exp(-0.5 * ((s[:, None] - s[None, :]) / 8.0) ** 2)
    stopped[:, 1] -= _smooth((nearness * too_high[None, :]).max(axis=1))
    return stopped


def _swept(anatomy: Anatomy, articulation: Articulation, template: TongueTemplate) -> FloatArray:
    """(n, 3) mm before contact: every row starts at the contour and bends down on both sides.

    The tongue is incompressible: what the profile loses it gains in width, within limits.
    """
    swept = _swept_unscaled(anatomy, articulation, template)
    swept[:, 0] *= float(np.clip(_rest_volume(anatomy) / enclosed_volume(swept), 0.80, 1.25))
    return swept


@lru_cache(maxsize=64)
def _rest_volume(anatomy: Anatomy) -> float:
    return enclosed_volume(_swept_unscaled(anatomy, Articulation(jaw_deg=REST_JAW_DEG), tongue_template()))


def _swept_unscaled(anatomy: Anatomy, articulation: Articulation, template: TongueTemplate) -> FloatArray:
    a = articulation
    size = anatomy.size
    s = template.s - template.tip_s
    theta = np.radians(template.theta)
    contour = _contour(anatomy, a, template)
    sine = np.sin(theta)[None, :]
    half_width = size * anatomy.width * _smooth(np.interp(s, PLACES, HALF_WIDTHS))
    # Between the teeth a whole row gets narrower; only what is left of the excess is pressed flat later.
    excess = half_width - 0.85 * anatomy.arch_half_width(contour[:, 0])
    half_width -= _smooth(_soft_positive(excess) * _between_teeth(contour[:, 0], contour[:, 1], size))
    x = half_width[:, None] * sine
    # In the sagittal plane every row runs straight from the contour to its place on the base.
    start, end = contour[0] + size * BASE_BEHIND_FRONT_MM, contour[-1] + size * BASE_BEFORE_ROOT_MM
    share = _base_share(s)
    to_base = start + share[:, None] * (end - start) - contour
    length = np.linalg.norm(to_base, axis=1)
    to_base /= length[:, None]
    flatness = _smooth(np.interp(s, PLACES, FLATNESSES)) + 0.8 * a.flat * _plateau(s, 10.0, 60.0, 8.0)
    drop = length[:, None] * (1.0 - np.cos(theta))[None, :] ** flatness[:, None]
    pressed_side = np.exp(-0.5 * ((np.abs(template.theta) - 50.0) / 14.0) ** 2)[None, :]
    drop -= size * a.brace_mm * _plateau(s, 14.0, 56.0, 7.0)[:, None] * pressed_side
    groove = _groove_depth(anatomy, a, template)
    drop += groove[:, None] * np.exp(-0.5 * (x / (4.2 * size)) ** 2)
    drop -= size * a.tilt_mm * _plateau(s, -10.0, 60.0, 10.0)[:, None] * sine * np.cos(theta)[None, :]
    y = contour[:, 0, None] + drop * to_base[:, 0, None]
    z = contour[:, 1, None] + drop * to_base[:, 1, None]
    return np.stack([x, y, z], axis=2).reshape(-1, 3)


def _base_share(s: FloatArray) -> FloatArray:
    """(rows,) 0 .. 1 along the base: the underside and the tip keep to its front, the root to its end."""
    places = np.array([-30.0, -22.0, 0.0, 12.0, 24.0, 40.0, 56.0, 72.0, 90.0, 110.0])
    shares = np.array([0.0, 0.02, 0.09, 0.16, 0.26, 0.42, 0.61, 0.78, 0.92, 1.0])
    share = _smooth(np.interp(s, places, shares))
    return np.asarray((share - share[0]) / (share[-1] - share[0]))


def _groove_depth(anatomy: Anatomy, articulation: Articulation, template: TongueTemplate) -> FloatArray:
    """(rows,) mm: depth of the midline groove along the contour."""
    s = template.s - template.tip_s
    deepest = 6.0 + 60.0 * articulation.groove_place
    groove = articulation.groove_mm * _bell(s, deepest, 11.0) + 0.3 * _plateau(s, 8.0, 60.0, 8.0)
    return np.asarray(anatomy.size * groove * _plateau(s, 8.0, 200.0, 3.0))  # the tip is too thin for one


def _pressed_against_walls(vertices: FloatArray, anatomy: Anatomy, groove: FloatArray) -> FloatArray:
    """The surface inside teeth, palate and pharyngeal wall, following them where it would cross.

    Teeth stand beside the tongue only above the edge of the palate. Along the middle the palate is kept at
    a distance, more so where the tongue is grooved, or pressing would iron the groove out. groove: (n,) mm.
    """
    pressed = vertices.copy()
    between_teeth = _between_teeth(vertices[:, 1], vertices[:, 2], anatomy.size)
    beside = 0.97 * anatomy.arch_half_width(vertices[:, 1]) - np.abs(vertices[:, 0])
    pressed[:, 0] -= np.sign(vertices[:, 0]) * (_soft_positive(beside) - beside) * between_teeth
    channel = (AIR_CHANNEL_MM + groove) * np.exp(-0.5 * (vertices[:, 0] / (4.2 * anatomy.size)) ** 2)
    room = anatomy.palate_z(pressed[:, 0], vertices[:, 1]) - channel - vertices[:, 2]
    under_palate = _plateau(vertices[:, 1], -7.0, 72.0 * anatomy.size * anatomy.mouth, 2.5)
    pressed[:, 2] -= (_soft_positive(room) - room) * under_palate
    wall = anatomy.wall_mm * anatomy.size - 12.0 - vertices[:, 1]
    pressed[:, 1] -= _soft_positive(wall) - wall
    return pressed


def _between_teeth(y: FloatArray, z: FloatArray, size: float) -> FloatArray:
    """About 1 where the upper teeth stand beside the tongue, 0 below and behind them."""
    return _plateau(z, -7.0 * size, 60.0, 3.0) * _plateau(y, -3.0, 50.0, 4.0)


def _soft_positive(room: FloatArray | float) -> FloatArray:
    """A smooth function above max(room, 0), near it a millimetre away on either side.

    Its slope dies out slowly, so that what is pressed flat is thinned, and no triangle vanishes.
    """
    room = np.asarray(room)
    return np.asarray(0.5 * (room + np.sqrt(room**2 + 4.0 * CONTACT_SOFTNESS_MM**2)))


def _normals(contour: FloatArray) -> FloatArray:
    """(rows, 2) unit normals out of the tongue, smoothed along the contour."""
    tangent = np.gradient(contour, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal = np.column_stack([_smooth(normal[:, 0]), _smooth(normal[:, 1])])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _smooth(values: FloatArray) -> FloatArray:
    """Three passes of a (1, 2, 1) average along the contour, ends kept."""
    for _ in range(3):
        padded = np.concatenate([values[:1], values, values[-1:]])
        values = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    return values


def _bell(s: FloatArray, place: float, width: float) -> FloatArray:
    return np.asarray(np.exp(-0.5 * ((s - place) / width) ** 2))


def _plateau(s: FloatArray, start: float, end: float, ramp: float) -> FloatArray:
    """About 1 between start and end, 0 outside, with smooth ramps."""
    return np.asarray(0.25 * (1.0 + np.tanh((s - start) / ramp)) * (1.0 + np.tanh((end - s) / ramp)))
