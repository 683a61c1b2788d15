"""Where a speaker's hard palate is in another scan of theirs (paper, "Tongue and palate shape estimation").

The palate is bone: between scans it moves with the head alone, rigidly. Its surface is partly hidden where the tongue
touches it, so the motion is found by what lies behind it instead: from every vertex, a profile of the scan's values is
taken into the tissue and the bone, and the motion is sought for which these profiles correlate best with those of the
scan that the palate was extracted from.

The mean correlation is maximised by damped Gauss-Newton steps: for profiles brought to mean 0 and length 1, it is 1
less half of their mean squared distance. Values are taken from cubic B-splines, whose derivatives are exact and
continuous, first of strongly smoothed scans, then of less smoothed ones. At the strongest smoothing, several starts
are tried, for a head may have moved further than what a profile shows is thick.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ... import InputError
from ..mesh import FloatArray
from ..procrustes import RigidMotion
from .scan import Scan

Volume = NDArray[np.float32]

STILL = RigidMotion(np.eye(3), np.zeros(3))
LEAST_VERTICES = 50
COARSE_VERTICES = 250  # enough for all levels but the finest
FLAT = 4.0  # grey values: a profile that varies less (standard deviation) counts less
LEAST_INSIDE = 0.8  # of the profiles, in the other scan
RIVAL_MM, RIVAL_SCORE = 1.5, 0.02  # two maxima, so far apart and so much alike, tell nothing
STEPS = 40
SETTLED = 1e-3  # mm, of every profile's start: a smaller step ends the search
FIRST_DAMPING, LARGEST_DAMPING = 1e-3, 1e6
REACH_MM = 25.0  # half a palate: what a turn moves the farthest vertex by


@dataclass(frozen=True)
class ProfileSettings:
    """How profiles are taken, compared, and brought together.

    length: samples in a profile; distance_mm: between them; first: where the first one is, in such distances from the
    surface into the tissue (0 would be the surface, which a touching tongue hides). The paper does not tell its
    values. smoothing_mm: standard deviation of the scans' smoothing, level by level. shifts_mm, nods_deg: the starts
    that are tried at the first level, along each axis of the world and about the one from ear to ear; followed: how
    many of them are optimised. least_score: a lower mean correlation is called uncertain.
    """

    length: int = 15
    distance_mm: float = 1.0
    first: int = 1
    smoothing_mm: tuple[float, ...] = (2.5, 1.2, 0.3)
    shifts_mm: tuple[float, ...] = (-4.0, 0.0, 4.0)
    nods_deg: tuple[float, ...] = (-4.0, 0.0, 4.0)
    followed: int = 4
    least_score: float = 0.6


@dataclass(frozen=True)
class PalateAlignment:
    """motion: from the world of the palate's scan to the other one's, mm. score: mean correlation of the profiles
    there, 1 where they are the same; start_score: at the start. reason: why the result is uncertain, or ""."""

    motion: RigidMotion
    score: float
    start_score: float
    reason: str = ""

    @property
    def uncertain(self) -> bool:
        return bool(self.reason)


def align_palate(
    vertices: FloatArray,
    normals: FloatArray,
    scan_from: Scan,
    scan_to: Scan,
    settings: ProfileSettings | None = None,
    start: RigidMotion = STILL,
) -> PalateAlignment:
    """The motion that brings a palate from one scan into another one of the same speaker.

    vertices, normals: (n, 3), mm and unit, in the world of scan_from, normals out of the tissue (down, into the
    mouth). scan_from, scan_to: in 8-bit grey values, denoised or not. start: about where the palate is, world to world.
    Raises InputError where the palate is not inside of the first scan.
    """
    settings = settings or ProfileSettings()
    kept = _inside(scan_from, vertices, normals, settings)
    if kept.sum() < LEAST_VERTICES:
        raise InputError(
            f"{scan_from.name}: only {int(kept.sum())} of {len(vertices)} vertices of the palate have their profile "
            "inside of the scan; expected the palate of this scan, and a region of interest that holds what is above it."
        )
    vertices, normals = vertices[kept], normals[kept]
    pivot = vertices.mean(axis=0)
    some = slice(None, None, max(1, len(vertices) // COARSE_VERTICES))
    motion, doubts = start, []
    for level, smoothing_mm in enumerate(settings.smoothing_mm):
        finest = level == len(settings.smoothing_mm) - 1
        part = slice(None) if finest else some
        profiles = _Profiles.of(vertices[part], normals[part], pivot, settings)
        search = _Search(profiles, _Values.of(scan_from, smoothing_mm), _Values.of(scan_to, smoothing_mm))
        if level == 0:
            motion, rival = search.best_of(_starts(start, pivot, settings), settings.followed)
            if rival is not None:
                apart = _rms(rival.apply(vertices) - motion.apply(vertices))
                doubts.append(f"{apart:.1f} mm away, the palate fits about as well")
        else:
            motion = search.climb(motion)[0]
    score, start_score = search.score(motion), search.score(start)
    there = _inside(scan_to, motion.apply(vertices), normals @ motion.rotation.T, settings)
    if score < settings.least_score:
        doubts.append(f"the profiles correlate by {score:.2f} only")
    if there.mean() < LEAST_INSIDE:
        doubts.append(f"{100 * (1 - there.mean()):.0f} % of the profiles leave the scan")
    return PalateAlignment(motion, score, start_score, "; ".join(doubts))


def _inside(
    scan: Scan, vertices: FloatArray, normals: FloatArray, settings: ProfileSettings
) -> NDArray[np.bool_]:
    """(n,) whether a profile's first and last sample are inside of the scan."""
    ends = (settings.first, settings.first + settings.length - 1)
    size = np.array(scan.values.shape)
    inside = np.ones(len(vertices), dtype=bool)
    for end in ends:
        voxels = scan.voxels(vertices - end * settings.distance_mm * normals)
        inside &= ((voxels >= 0) & (voxels <= size - 1)).all(axis=1)
    return inside


def _starts(start: RigidMotion, pivot: FloatArray, settings: ProfileSettings) -> list[RigidMotion]:
    shifts = product(settings.shifts_mm, repeat=3)
    return [
        _stepped(start, pivot, np.array([np.radians(nod), 0.0, 0.0, *shift]))
        for shift, nod in product(shifts, settings.nods_deg)
    ]


def _stepped(motion: RigidMotion, pivot: FloatArray, step: FloatArray) -> RigidMotion:
    """The motion, then a turn about where the pivot is by then, and a shift. step: (6,) turn (rad), shift (mm)."""
    from scipy.spatial.transform import Rotation

    turn = np.asarray(Rotation.from_rotvec(step[:3]).as_matrix())
    here = motion.apply(pivot)
    return RigidMotion(turn, here - turn @ here + step[3:]).after(motion)


@dataclass(frozen=True)
class _Values:
    """A scan's smoothed values, and its grid. to_voxel: (3, 3), (3,): voxel = matrix @ world + offset."""

    volume: Volume
    matrix: FloatArray
    offset: FloatArray

    @classmethod
    def of(cls, scan: Scan, smoothing_mm: float) -> _Values:
        from scipy.ndimage import gaussian_filter

        volume = gaussian_filter(
            scan.values.astype(np.float32), smoothing_mm / scan.spacing_mm, mode="nearest", truncate=3.0
        )
        matrix = np.asarray(np.linalg.inv(scan.to_world[:3, :3]), dtype=np.float64)
        return cls(np.ascontiguousarray(volume), matrix, -matrix @ scan.to_world[:3, 3])


@dataclass(frozen=True)
class _Profiles:
    """firsts: (n, 3) mm, a profile's first sample, from the pivot; steps: (n, 3) mm to the next one."""

    firsts: FloatArray
    steps: FloatArray
    pivot: FloatArray
    length: int

    @classmethod
    def of(
        cls, vertices: FloatArray, normals: FloatArray, pivot: FloatArray, settings: ProfileSettings
    ) -> _Profiles:
        steps = -settings.distance_mm * normals
        return cls(vertices - pivot + settings.first * steps, steps, pivot, settings.length)


class _Search:
    """Profiles of one scan, looked for in another one."""

    def __init__(self, profiles: _Profiles, here: _Values, there: _Values) -> None:
        self._profiles, self._there = profiles, there
        self._wanted = np.zeros((len(profiles.firsts), profiles.length))
        _, _, _, self._wanted = self._compared(here, STILL)

    def _compared(
        self, values: _Values, motion: RigidMotion
    ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Sum of the correlations, its gradient (6,) and Gauss-Newton matrix (6, 6), and the profiles (n, length)."""
        profiles = self._profiles
        firsts, steps = profiles.firsts @ motion.rotation.T, profiles.steps @ motion.rotation.T
        place = values.matrix @ motion.apply(profiles.pivot) + values.offset
        return _correlated(
            values.volume, firsts @ values.matrix.T + place, steps @ values.matrix.T, firsts, steps, values.matrix,
            self._wanted,
        )  # fmt: skip

    def score(self, motion: RigidMotion) -> float:
        """The mean correlation."""
        return self._compared(self._there, motion)[0] / len(self._wanted)

    def climb(self, motion: RigidMotion) -> tuple[RigidMotion, float]:
        """The nearest maximum of the mean correlation, and that."""
        score, gradient, matrix, _ = self._compared(self._there, motion)
        damping = FIRST_DAMPING
        for _ in range(STEPS):
            damped = matrix + damping * np.diag(np.diag(matrix))
            step = np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
            further = _stepped(motion, self._profiles.pivot, step)
            there = self._compared(self._there, further)
            if there[0] > score:
                motion, (score, gradient, matrix, _) = further, there
                damping = max(damping / 5.0, 1e-9)
                if np.abs(step[3:]).max() + REACH_MM * np.abs(step[:3]).max() < SETTLED:
                    break
            else:
                damping *= 8.0
                if damping > LARGEST_DAMPING:
                    break
        return motion, score / len(self._wanted)

    def best_of(self, starts: list[RigidMotion], followed: int) -> tuple[RigidMotion, RigidMotion | None]:
        """Of the maxima next to the best `followed` starts, the highest, and another one that is hardly lower."""
        ranked = sorted(starts, key=self.score, reverse=True)
        found = sorted(
            (self.climb(start) for start in ranked[:followed]), key=lambda one: one[1], reverse=True
        )
        best, score = found[0]
        places = self._profiles.firsts + self._profiles.pivot
        for other, other_score in found[1:]:
            if (
                other_score > score - RIVAL_SCORE
                and _rms(other.apply(places) - best.apply(places)) > RIVAL_MM
            ):
                return best, other
        return best, None


def _rms(offsets: FloatArray) -> float:
    """Of the lengths of offsets (n, 3)."""
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


@njit(cache=True)
def _correlated(
    volume: Volume,
    voxels: FloatArray,
    voxel_steps: FloatArray,
    firsts: FloatArray,
    steps: FloatArray,
    to_voxel: FloatArray,
    wanted: FloatArray,
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Profiles in a volume against those wanted (n, length), which are centred and of at most length 1.

    voxels, voxel_steps: (n, 3) of the profiles' first samples and their steps; firsts, steps: the same in mm from
    the pivot that turns are about; to_voxel: (3, 3) mm -> voxels. Returns the sum of the correlations, its gradient (6,) over a turn
    (rad) and a shift (mm), the matrix (6, 6) of a Gauss-Newton step, and the profiles (n, length) themselves.

    Values are those of the cubic B-spline whose coefficients are the volume's values, and beyond its edge those at the edge.
    """
    count, length = wanted.shape
    found = np.empty((count, length))
    total = 0.0
    gradient, matrix = np.zeros(6), np.zeros((6, 6))
    jacobian = np.empty((length, 6))
    weight, slope = np.empty((3, 4)), np.empty((3, 4))
    place = np.empty((3, 4), dtype=np.int64)
    mean, along = np.empty(6), np.empty(6)
    for v in range(count):
        middle = 0.0
        mean[:] = 0.0
        for s in range(length):
            for axis in range(3):
                last = volume.shape[axis] - 1
                at = min(max(voxels[v, axis] + s * voxel_steps[v, axis], -2.0), last + 2.0)
                low = int(np.floor(at))
                t = at - low
                r = 1.0 - t
                weight[axis, 0] = r * r * r / 6.0
                weight[axis, 1] = (4.0 + t * t * (3.0 * t - 6.0)) / 6.0
                weight[axis, 2] = (4.0 + r * r * (3.0 * r - 6.0)) / 6.0
                weight[axis, 3] = t * t * t / 6.0
                slope[axis, 0] = -0.5 * r * r
                slope[axis, 1] = t * (1.5 * t - 2.0)
                slope[axis, 2] = r * (2.0 - 1.5 * r)
                slope[axis, 3] = 0.5 * t * t
                for tap in range(4):
                    place[axis, tap] = min(max(low - 1 + tap, 0), last)
            value, gi, gj, gk = 0.0, 0.0, 0.0, 0.0
            for a in range(4):
                for b in range(4):
                    line, rise = 0.0, 0.0
                    for c in range(4):
                        sample = volume[place[0, a], place[1, b], place[2, c]]
                        line += weight[2, c] * sample
                        rise += slope[2, c] * sample
                    value += weight[0, a] * weight[1, b] * line
                    gi += slope[0, a] * weight[1, b] * line
                    gj += weight[0, a] * slope[1, b] * line
                    gk += weight[0, a] * weight[1, b] * rise
            gx = to_voxel[0, 0] * gi + to_voxel[1, 0] * gj + to_voxel[2, 0] * gk
            gy = to_voxel[0, 1] * gi + to_voxel[1, 1] * gj + to_voxel[2, 1] * gk
            gz = to_voxel[0, 2] * gi + to_voxel[1, 2] * gj + to_voxel[2, 2] * gk
            x = firsts[v, 0] + s * steps[v, 0]
            y = firsts[v, 1] + s * steps[v, 1]
            z = firsts[v, 2] + s * steps[v, 2]
            jacobian[s, 0] = y * gz - z * gy
            jacobian[s, 1] = z * gx - x * gz
            jacobian[s, 2] = x * gy - y * gx
            jacobian[s, 3], jacobian[s, 4], jacobian[s, 5] = gx, gy, gz
            found[v, s] = value
            middle += value / length
            for p in range(6):
                mean[p] += jacobian[s, p] / length
        size = FLAT * FLAT * length
        for s in range(length):
            found[v, s] -= middle
            size += found[v, s] * found[v, s]
        size = np.sqrt(size)
        along[:] = 0.0
        for s in range(length):
            found[v, s] /= size
            total += found[v, s] * wanted[v, s]
            for p in range(6):
                jacobian[s, p] = (jacobian[s, p] - mean[p]) / size
                along[p] += found[v, s] * jacobian[s, p]
        for s in range(length):
            for p in range(6):
                jacobian[s, p] -= found[v, s] * along[p]
                gradient[p] += wanted[v, s] * jacobian[s, p]
            for p in range(6):
                for q in range(p + 1):
                    matrix[p, q] += jacobian[s, p] * jacobian[s, q]
    for p in range(6):
        for q in range(p):
            matrix[q, p] = matrix[p, q]
    return total, gradient, matrix, found
