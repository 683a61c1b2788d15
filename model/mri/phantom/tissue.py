"""What is where in a head that holds a phone: one label for every place, by the rules of its geometry.

All kernels take places in the head frame at reference size (mm; see `anatomy`). Order decides: skin, teeth and
bone first, then tongue, soft palate and epiglottis, then what is left of the cavities, and muscle for the rest.

All kernels of the phantom are here: numba keeps a compiled function as long as its own file is unchanged, whatever
became of a function in another file that it calls.
"""

from __future__ import annotations

from math import atan2, exp, hypot, pi, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .anatomy import (
    HEIGHT_LOW_MM,
    HINGE,
    LOWER_ARCH_BEHIND_MM,
    PALATE_END_MM,
    PLAN_FRONT_MM,
    ROOF_START_MM,
    STEP_MM,
    Head,
)

FloatArray = NDArray[np.float64]

AIR, TOOTH, BONE, MARROW, TONGUE, SEPTUM, MUCOSA, MUSCLE, FAT, CARTILAGE, FLUID = range(11)
# Signal of each label in a T1-weighted gradient echo with short times: fat bright, muscle grey, bone and air dark.
SIGNALS = np.array([0.02, 0.05, 0.07, 0.72, 0.62, 0.67, 0.68, 0.58, 0.90, 0.50, 0.42])
DARK = (AIR, TOOTH, BONE)

FREE, PALATE, VELUM, TEETH, WALL = range(5)
"""What a tongue runs into."""

DEGREE_STEP = 1.0  # of the tables around the pole line
GUM_MM = 4.5  # the upper gum's edge over the biting plane, at the molars
HINGE_Y, HINGE_Z = HINGE
LONGEST_MM = 75.0
RAY_STEP_MM = 1.5
FINER = 3  # sub-voxels a direction where a voxel may hold two tissues
SEEN = 0.12  # a smaller step in signal needs no finer look


class Pose(NamedTuple):
    """What moves. jaw: cosine and sine of its opening; pole_y, pole_z: the line (parallel to x) around which the tongue is
    described; first_degree: of the tables, which have a row every DEGREE_STEP; width: (angles,) mm half width of the
    tongue; radius: (angles, across) mm from the pole line, across = x / width from -1 to 1; base_z: floor of the mouth; epiglottis_y;
    lip_gap, lip_half: half height and half width of the lips' opening; protrusion; velum: (k, 4) y, z, radius
    and half width of the balls that the soft palate is drawn through."""

    jaw: tuple[float, float]
    pole_y: float
    pole_z: float
    first_degree: float
    width: FloatArray
    radius: FloatArray
    base_z: float
    epiglottis_y: float
    lip_gap: float
    lip_half: float
    protrusion: float
    velum: FloatArray


@njit(cache=True)
def lookup(table: FloatArray, place: float) -> float:
    """The table (n,) between its entries; its ends outside."""
    last = len(table) - 1
    if place <= 0.0:
        return table[0]
    if place >= last:
        return table[last]
    low = int(place)
    share = place - low
    return table[low] * (1.0 - share) + table[low + 1] * share


@njit(cache=True)
def lookup_2d(table: FloatArray, row: float, column: float) -> float:
    """The table (n, m), bilinear; its edges outside."""
    row = min(max(row, 0.0), table.shape[0] - 1.0)
    column = min(max(column, 0.0), table.shape[1] - 1.0)
    i = min(int(row), table.shape[0] - 2)
    j = min(int(column), table.shape[1] - 2)
    a = row - i
    b = column - j
    return (1.0 - a) * ((1.0 - b) * table[i, j] + b * table[i, j + 1]) + a * (
        (1.0 - b) * table[i + 1, j] + b * table[i + 1, j + 1]
    )


@njit(cache=True)
def roof_height(x: float, y: float, head: Head) -> float:
    """z of the hard palate above (x, y); beyond the gum line it stays at the gum's height."""
    middle = lookup(head.roof, y / STEP_MM)
    edge = min(GUM_MM, middle - 0.5)
    half = lookup(head.arch, y / STEP_MM)
    across = min(abs(x) / half, 1.0) if half > 0.0 else 1.0
    return middle - (middle - edge) * across**head.doming + head.skew * x


@njit(cache=True)
def outside_arch(x: float, y: float, head: Head) -> float:
    """Signed distance in mm from the upper gum line, seen from above."""
    return lookup_2d(head.plan, abs(x) / STEP_MM, (y - PLAN_FRONT_MM) / STEP_MM)


@njit(cache=True)
def in_jaw_frame(y: float, z: float, jaw: tuple[float, float]) -> tuple[float, float]:
    """(y, z) of a place when the jaw is closed again."""
    dy = y - HINGE_Y
    dz = z - HINGE_Z
    return HINGE_Y + dy * jaw[0] + dz * jaw[1], HINGE_Z - dy * jaw[1] + dz * jaw[0]


@njit(cache=True)
def from_jaw_frame(y: float, z: float, jaw: tuple[float, float]) -> tuple[float, float]:
    """The inverse of `in_jaw_frame`."""
    return in_jaw_frame(y, z, (jaw[0], -jaw[1]))


@njit(cache=True)
def degrees_around(y: float, z: float, pole_y: float, pole_z: float) -> float:
    """Angle around the pole line: 0 to the front, 90 up, 180 back, from -90 to 270."""
    angle = atan2(z - pole_z, pole_y - y) * 180.0 / pi
    return angle + 360.0 if angle < -90.0 else angle


@njit(cache=True)
def below_tongue_surface(x: float, y: float, z: float, pose: Pose) -> float:
    """How many mm (along the ray from the pole line) the place is below the tongue's surface; negative outside.
    The tongue's base, below its two ends, is as far around as they are."""
    angle = degrees_around(y, z, pose.pole_y, pose.pole_z)
    place = (angle - pose.first_degree) / DEGREE_STEP
    if place < -30.0 / DEGREE_STEP or place > len(pose.width) - 1 + 40.0 / DEGREE_STEP:
        return -100.0
    half = lookup(pose.width, place)
    if abs(x) > half:
        return -100.0
    across = (x / half + 1.0) * 0.5 * (pose.radius.shape[1] - 1)
    return lookup_2d(pose.radius, place, across) - hypot(y - pose.pole_y, z - pose.pole_z)


@njit(cache=True)
def in_velum(x: float, y: float, z: float, velum: FloatArray) -> bool:
    """Inside the soft palate: a chain of discs, thinner towards its side edges."""
    for k in range(len(velum) - 1):
        y0, z0, r0, w0 = velum[k]
        y1, z1, r1, w1 = velum[k + 1]
        length = (y1 - y0) ** 2 + (z1 - z0) ** 2
        share = ((y - y0) * (y1 - y0) + (z - z0) * (z1 - z0)) / length
        share = min(max(share, 0.0), 1.0)
        across = abs(x) / (w0 + share * (w1 - w0))
        if across >= 1.0:
            continue
        radius = (r0 + share * (r1 - r0)) * (1.0 - across**4) ** 0.25
        if hypot(y - y0 - share * (y1 - y0), z - z0 - share * (z1 - z0)) < radius:
            return True
    return False


@njit(cache=True)
def upper_teeth(x: float, y: float, z: float, outside: float) -> bool:
    """Crowns and roots of the upper teeth; the incisors' backs slope towards their edge."""
    if z < 0.0 or z > 15.0 or outside < 0.0 or y > 52.0:
        return False
    front = min(max(1.0 - y / 14.0, 0.0), 1.0)
    deep = 9.5 - 3.0 * front
    if z > 6.0:  # roots, in their sockets
        taper = (z - 6.0) / 9.0
        return 1.5 + 2.0 * taper < outside < deep - 1.2 - 2.0 * taper
    sharp = max(0.0, 1.0 - z / 6.0) * front
    return 3.0 * sharp < outside < deep - 2.0 * sharp


@njit(cache=True)
def lower_teeth(y: float, z: float, outside: float) -> bool:
    """Crowns of the lower teeth, in the jaw's frame; outside: distance from their gum line."""
    front = min(max(1.0 - (y - LOWER_ARCH_BEHIND_MM) / 14.0, 0.0), 1.0)
    top = 1.5 * front
    if z > top or z < -7.0 or outside < 0.0 or y > 54.0:
        return False
    sharp = min(max((z + 6.0) / 7.5, 0.0), 1.0) * front
    return 2.0 * sharp < outside < 9.0 - 3.5 * front - 2.0 * sharp


@njit(cache=True)
def mandible(x: float, y: float, z: float, outside: float, head: Head) -> int:
    """BONE or MARROW inside the lower jaw's bone (jaw's frame), AIR elsewhere."""
    if z > -5.5 or y > 62.0:
        return AIR
    back = min(max((y - 8.0) / 45.0, 0.0), 1.0)
    low = -head.jaw_depth_mm + 5.0 * back
    inner = 1.2
    outer = 11.5
    if y < 30.0:  # the chin's bone is thicker below, and slopes back above its protuberance
        inner -= 1.5 * min(max((-z - 14.0) / 14.0, 0.0), 1.0)
    depth = min(min(outside - inner, outer - outside), z - low)
    if z > -9.0:
        depth = min(depth, -5.5 - z + 1.0)
    if depth < 0.0:
        return AIR
    if depth < 2.2 or z > -10.0:
        return BONE
    return MARROW


@njit(cache=True)
def what_stops_the_tongue(x: float, y: float, z: float, head: Head, pose: Pose) -> int:
    """PALATE, VELUM, TEETH (with the lower gum) or WALL where there is one, else FREE."""
    outside = outside_arch(x, y, head)
    if ROOF_START_MM - 6.0 < y < PALATE_END_MM + 2.0:
        if outside < 0.0 and z > roof_height(x, y, head):
            return PALATE
        if outside >= 0.0 and z > GUM_MM:
            return PALATE
        if upper_teeth(x, y, z, outside):
            return TEETH
    if in_velum(x, y, z, pose.velum):
        return VELUM
    jaw_y, jaw_z = in_jaw_frame(y, z, pose.jaw)
    lower = outside_arch(x, jaw_y - LOWER_ARCH_BEHIND_MM, head)
    if jaw_z < -6.0 and -0.2 < lower < 14.0 and jaw_y < 56.0:
        return TEETH
    if lower_teeth(jaw_y, jaw_z, lower):
        return TEETH
    if y > lookup(head.wall, (z - HEIGHT_LOW_MM) / STEP_MM):
        return WALL
    return FREE


@njit(cache=True)
def label_at(x: float, y: float, z: float, head: Head, pose: Pose) -> int:
    """The label of a place."""
    jaw_y, jaw_z = in_jaw_frame(y, z, pose.jaw)
    # Between the lips, measured from the height where they meet.
    lower_lip_z = -1.0 - 0.9 * (jaw_z - z)
    lips_z = 0.5 * (-2.0 + lower_lip_z)
    pout = 0.0
    if abs(z - lips_z) < 27.0:
        pout = pose.protrusion * exp(-(((z - lips_z) / 9.0) ** 2) - (x / 17.0) ** 2)
    round_off = x * x / 45.0
    if z > lips_z:
        skin = lookup(head.face, (z - HEIGHT_LOW_MM) / STEP_MM)
        if z > 12.0:  # a nose is narrow
            skin += 10.0 * min(abs(x) / 14.0, 1.0) * min((z - 12.0) / 8.0, 1.0)
    else:
        skin = lookup(head.chin, (jaw_z - HEIGHT_LOW_MM) / STEP_MM)
        skin += y - jaw_y
    if y < skin + round_off - pout:
        return AIR
    deep_below_skin = y - (skin + round_off - pout)

    outside = outside_arch(x, y, head)
    if upper_teeth(x, y, z, outside):
        return TOOTH
    lower = outside_arch(x, jaw_y - LOWER_ARCH_BEHIND_MM, head)
    if lower_teeth(jaw_y, jaw_z, lower):
        return TOOTH
    bone = mandible(x, jaw_y, jaw_z, lower, head)
    if bone != AIR:
        return bone
    wall_y = lookup(head.wall, (z - HEIGHT_LOW_MM) / STEP_MM)
    if y > wall_y + 5.5:
        return _spine(x, y - wall_y - 5.5, z)
    hyoid = hypot((y - 43.0 - x * x / 30.0) / 3.2, (z - pose.pole_z + 21.0) / 4.2)
    if hyoid < 1.0 and abs(x) < 20.0:
        return BONE

    below = below_tongue_surface(x, y, z, pose)
    if below >= 0.0:
        if abs(x) < 0.8 and below > 9.0:
            return SEPTUM
        return TONGUE
    if in_velum(x, y, z, pose.velum):
        return MUCOSA
    if _in_epiglottis(x, y, z, pose.epiglottis_y):
        return CARTILAGE

    if y < PALATE_END_MM + 2.0 and z > 0.0:
        if outside >= 0.0:
            return _upper_jaw_side(z, outside, y, deep_below_skin)
        roof = roof_height(x, y, head)
        if z > roof:
            return _above_palate(x, y, z, z - roof, head)
    if _in_mouth(x, y, z, outside, jaw_z, lower, lips_z, pose):
        return AIR
    if _in_throat(x, y, z, wall_y):
        return AIR
    return _soft_rest(x, y, z, jaw_y, jaw_z, deep_below_skin, wall_y, head)


@njit(cache=True)
def _spine(x: float, behind: float, z: float) -> int:
    """Vertebrae with cortical shells, discs between them, and the canal behind."""
    if behind > 16.0:
        return FLUID if behind < 27.0 and abs(x) < 9.0 else MUSCLE
    if abs(x) > 11.0:
        return MUSCLE
    level = (z + 100.0) % 17.0
    if level < 4.5:
        return CARTILAGE
    if level < 5.7 or level > 15.8 or behind < 1.2 or behind > 14.8 or abs(x) > 9.8:
        return BONE
    return MARROW


@njit(cache=True)
def _in_epiglottis(x: float, y: float, z: float, top_y: float) -> bool:
    """A thin leaf behind the tongue's root, bent around it."""
    share = (z + 50.0) / 20.0
    if share < 0.0 or share > 1.0 or abs(x) > 9.0 * sqrt(max(0.0, 1.0 - (share - 0.45) ** 2 / 0.35)):
        return False
    middle = 57.5 + (top_y - 57.5) * share - x * x / 45.0
    return abs(y - middle) < 1.6


@njit(cache=True)
def _upper_jaw_side(z: float, outside: float, y: float, deep_below_skin: float) -> int:
    """Gum, the bone that holds the teeth, and cheek or lip beside them."""
    deep = 9.5 - 3.0 * min(max(1.0 - y / 14.0, 0.0), 1.0)
    if outside < deep - 0.3 and GUM_MM < z < 19.0:
        return MUCOSA if outside < 1.5 else BONE
    return FAT if 2.0 < deep_below_skin < 6.0 else MUSCLE


@njit(cache=True)
def _above_palate(x: float, y: float, z: float, over: float, head: Head) -> int:
    """Upwards from the palate's surface: mucosa, bone (marrow-filled in front), then the nose."""
    slope = lookup(head.roof, y / STEP_MM + 1.0) - lookup(head.roof, y / STEP_MM - 1.0)
    depth = over / sqrt(1.0 + slope * slope)
    mucosa = 3.4 - 1.2 * min(max((y - 9.0) / 12.0, 0.0), 1.0)
    floor = head.vault_mm + 5.5 - 0.06 * (y - 29.0)
    if depth < mucosa:
        return MUCOSA
    if z < floor - 1.6:
        inner = min(depth - mucosa, floor - 1.6 - z)
        return MARROW if inner > 1.5 else BONE
    if y < 9.0:
        return MUSCLE
    if z < floor:
        return MUCOSA
    if abs(x) < 1.4:
        return MUCOSA  # the septum
    if abs(x) > 17.0:
        return AIR if abs(x) < 30.0 and z > floor + 5.0 and y > 18.0 else MARROW
    if abs(x) > 14.0:
        return BONE
    if hypot((abs(x) - 9.0) / 3.0, (z - floor - 9.0) / 5.5) < 1.0 and 14.0 < y < PALATE_END_MM:
        return MUCOSA  # the lower turbinate
    if hypot((abs(x) - 7.0) / 2.4, (z - floor - 22.0) / 5.0) < 1.0 and 20.0 < y < PALATE_END_MM:
        return MUCOSA
    return AIR


@njit(cache=True)
def _in_mouth(
    x: float, y: float, z: float, outside: float, jaw_z: float, lower: float, lips_z: float, pose: Pose
) -> bool:
    """The oral cavity, as far as nothing fills it, and the opening between the lips."""
    gap = pose.lip_gap * (1.0 - (x / pose.lip_half) ** 2)  # negative beside the mouth
    if y < 8.0 and outside > 1.0 and abs(z - lips_z) < gap:
        return True
    if y > PALATE_END_MM + 14.0:
        return False
    if z > 0.0:
        return outside < 0.0  # what lies above the roof was told before
    floor = pose.base_z + (4.5 if abs(x) > 6.0 else 0.0)
    if z < floor or (z < pose.pole_z + 2.0 and y > pose.pole_y - 14.0):
        return False  # below the tongue's own base there is its root, never air
    if jaw_z > 0.0:  # between the rows of teeth, where the cheek leans in
        return outside < (3.5 if y > 14.0 else 6.0)
    return lower < 0.0


@njit(cache=True)
def _in_throat(x: float, y: float, z: float, wall_y: float) -> bool:
    """Behind mouth and nose, from the nasal cavity down to the larynx."""
    if z > 32.0 or z < -64.0 or y > wall_y:
        return False
    front = PALATE_END_MM - 4.0
    half = 17.5
    if z < -12.0:
        half = 17.5 - 3.5 * min((-12.0 - z) / 20.0, 1.0)
    if z > 8.0:
        half = 13.5
        front = PALATE_END_MM
    if z < -40.0:
        front = 52.0 + 0.45 * (-40.0 - z)
        half = 14.0 - 0.3 * (-40.0 - z)
    if y < front:
        return False
    behind = max(0.0, (y - (wall_y - 8.0)) / 8.0)
    return (abs(x) / half) ** 3 + behind**3 < 1.0


@njit(cache=True)
def _soft_rest(
    x: float,
    y: float,
    z: float,
    jaw_y: float,
    jaw_z: float,
    deep_below_skin: float,
    wall_y: float,
    head: Head,
) -> int:
    """Lips, cheeks, floor of the mouth, throat."""
    if y < 14.0 and z > -head.jaw_depth_mm - 20.0:
        # Lips and chin: skin, a layer of fat, muscle; the chin has a pad.
        if 2.0 < deep_below_skin < (5.0 if jaw_z > -14.0 else 9.0):
            return FAT
        return MUSCLE
    if jaw_z < -head.jaw_depth_mm - 4.0 and deep_below_skin < 12.0:
        return FAT if deep_below_skin > 1.5 else MUSCLE
    if z < -44.0 and 46.0 < y < 56.0 and abs(x) < 12.0:
        return FAT  # before the epiglottis
    if abs(x) > 22.0 and -40.0 < z < 0.0:
        return FAT
    return MUSCLE


@njit(cache=True)
def ray_limits(angles: FloatArray, head: Head, pose: Pose) -> tuple[FloatArray, NDArray[np.int8]]:
    """Where rays from the pole line run into something, and into what: (rows, across) mm and code, for every angle
    (rows,) in degrees and every column of the pose's tables, of which only the width is read."""
    rows, columns = len(angles), pose.radius.shape[1]
    limit = np.full((rows, columns), LONGEST_MM)
    stop = np.zeros((rows, columns), dtype=np.int8)
    for row in range(rows):
        turned = np.radians(angles[row])
        front, up = -np.cos(turned), np.sin(turned)
        for column in range(columns):
            x = pose.width[row] * (2.0 * column / (columns - 1) - 1.0)
            radius = 12.0
            while radius < LONGEST_MM:
                found = what_stops_the_tongue(
                    x, pose.pole_y + radius * front, pose.pole_z + radius * up, head, pose
                )
                if found != FREE:
                    free, blocked = radius - RAY_STEP_MM, radius
                    for _ in range(8):
                        half = 0.5 * (free + blocked)
                        there = what_stops_the_tongue(
                            x, pose.pole_y + half * front, pose.pole_z + half * up, head, pose
                        )
                        if there == FREE:
                            free = half
                        else:
                            blocked = half
                            found = there
                    limit[row, column] = free
                    stop[row, column] = found
                    break
                radius += RAY_STEP_MM
    return limit, stop


@njit(cache=True)
def label_grid(shape: tuple[int, int, int], to_head: FloatArray, head: Head, pose: Pose) -> NDArray[np.uint8]:
    """The label at every voxel's centre. to_head: (3, 4) voxel index -> place."""
    labels = np.empty(shape, dtype=np.uint8)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                labels[i, j, k] = _label_there(i, j, k, to_head, head, pose)
    return labels


@njit(cache=True)
def _label_there(i: float, j: float, k: float, to_head: FloatArray, head: Head, pose: Pose) -> int:
    x = to_head[0, 0] * i + to_head[0, 1] * j + to_head[0, 2] * k + to_head[0, 3]
    y = to_head[1, 0] * i + to_head[1, 1] * j + to_head[1, 2] * k + to_head[1, 3]
    z = to_head[2, 0] * i + to_head[2, 1] * j + to_head[2, 2] * k + to_head[2, 3]
    return label_at(x, y, z, head, pose)


@njit(cache=True)
def mean_signal(
    labels: NDArray[np.uint8], to_head: FloatArray, head: Head, pose: Pose, signals: FloatArray
) -> FloatArray:
    """The mean signal over every voxel, of labels at their centres; signals: of each label. Only voxels with a neighbour of clearly another signal are looked at more finely."""
    n, m, o = labels.shape
    signal = np.empty(labels.shape)
    for i in range(n):
        for j in range(m):
            for k in range(o):
                own = labels[i, j, k]
                mixed = False
                for a, b, c in ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)):
                    other = labels[
                        min(max(i + a, 0), n - 1), min(max(j + b, 0), m - 1), min(max(k + c, 0), o - 1)
                    ]
                    if abs(signals[other] - signals[own]) > SEEN:
                        mixed = True
                if not mixed:
                    signal[i, j, k] = signals[own]
                    continue
                total = 0.0
                for a in range(FINER):
                    for b in range(FINER):
                        for c in range(FINER):
                            label = _label_there(
                                i + (a + 0.5) / FINER - 0.5,
                                j + (b + 0.5) / FINER - 0.5,
                                k + (c + 0.5) / FINER - 0.5,
                                to_head,
                                head,
                                pose,
                            )
                            total += signals[label]
                signal[i, j, k] = total / FINER**3
    return signal
