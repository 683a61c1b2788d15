"""Directions of a speaker's head: what a file states about its axes, and the mid-sagittal plane that its coils show.

The model's directions are x left, y back, z up. They are right-handed: left x back = up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import InputError
from ..drivers.frames import FrameOfReference
from .pose import FloatArray

MODEL_DIRECTIONS = FrameOfReference("left", "back", "up")
_OPPOSITE = {"left": "right", "right": "left", "front": "back", "back": "front", "up": "down", "down": "up"}

LARGEST_TILT_DEG = 35.0  # a plane further from the stated directions contradicts them
LEAST_EXTENT_MM = 1.5  # of the coils across their longest direction, within the plane: less is a line
CLEAR_RATIO = 1.5  # that extent over the scatter off the plane; below, any plane through the line would do
ROUNDS = 20


def directions(frame: FrameOfReference, source: str) -> FloatArray:
    """(3, 3) orthonormal rows: the model's left, back and up in the axes of a source; model = directions @ source.

    Its determinant is -1 where the source's axes are left-handed. An absent axis (2-D data, zeros) stands for the
    missing direction. Raises InputError that asks, where the frame leaves a direction open.
    """
    stated = (frame.x, frame.y, frame.z)
    spare = [axis for axis, direction in enumerate(stated) if direction == "absent"]
    matrix = np.zeros((3, 3))
    for row, wanted in enumerate((MODEL_DIRECTIONS.x, MODEL_DIRECTIONS.y, MODEL_DIRECTIONS.z)):
        found = [axis for axis, direction in enumerate(stated) if direction in (wanted, _OPPOSITE[wanted])]
        if len(found) == 1:
            matrix[row, found[0]] = 1.0 if stated[found[0]] == wanted else -1.0
        elif not found and spare:
            matrix[row, spare.pop()] = 1.0
        else:
            raise InputError(
                f"{source}: its axes are x {frame.x}, y {frame.y}, z {frame.z}, which leaves open where {wanted} is; "
                "state all three (from left, right, front, back, up, down; absent in 2-D data)."
            )
    return matrix


def handedness(rotation: FloatArray) -> str:
    """What a (3, 3) motion from a source's axes to the model's says about the source."""
    return "right-handed" if np.linalg.det(rotation) > 0 else "left-handed"


class PlaneUnclear(InputError):
    """The coils do not tell how the plane lies, as they are too few or on a line; nothing contradicts anything."""


@dataclass(frozen=True)
class MidSagittalPlane:
    """The plane in which mid-sagittal coils move, in the frame of the coils it was found from.

    normal: (3,) unit vector, to the speaker's left; point: (3,) mm, the middle of the coils in the plane.
    spread_mm: robust standard deviation of the samples off the plane; offsets_mm: (n,) median of each coil off it,
    positive to the left. tilt_deg: angle between the normal and the left that was stated. unsure_deg: the
    largest turn of the normal when one of the coils is left out; with fewer than three, what their scatter allows.
    """

    normal: FloatArray
    point: FloatArray
    spread_mm: float
    offsets_mm: FloatArray
    tilt_deg: float
    unsure_deg: float

    def levelling(self, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The motion that makes the plane x = 0: rotation (3, 3) and translation (3,) mm.

        rotation: (3, 3) from the coils' axes to the model's directions, as `directions` gives it; it is followed
        by the smallest turn that brings the normal to +x, and a shift along x alone.
        """
        levelled = _smallest_turn(rotation @ self.normal, np.array([1.0, 0.0, 0.0])) @ rotation
        return levelled, np.array([-float(levelled[0] @ self.point), 0.0, 0.0])

    def __str__(self) -> str:
        return (
            f"tilted {self.tilt_deg:.1f} degrees against the stated axes (sure to {self.unsure_deg:.1f}), coils "
            f"within {self.spread_mm:.2f} mm of it"
        )


def mid_sagittal_plane(positions: FloatArray, left: FloatArray, source: str) -> MidSagittalPlane:
    """The plane of mid-sagittal coils, by robust orthogonal regression over all their samples.

    positions: (frames, n, 3) mm, head-corrected, NaN = missing; coils that sit in the mid-sagittal plane. left: (3,)
    roughly the speaker's left, as `directions(...)[0]`. Every coil counts the same, and samples far off the plane
    count little. Raises PlaneUnclear where the coils lie on a line, so that any plane through it would do, and InputError
    where the plane contradicts `left`.
    """
    coils = [coil[np.isfinite(coil).all(axis=1)] for coil in np.moveaxis(positions, 1, 0)]
    there = [index for index, coil in enumerate(coils) if len(coil)]
    samples = [coils[index] for index in there]
    if sum(len(coil) for coil in samples) < 3:
        raise PlaneUnclear(
            f"{source}: fewer than three samples of its mid-sagittal coils; a plane needs more speech."
        )
    left = left / np.linalg.norm(left)
    normal, point, off, extents = _robust_plane(samples, left)
    spread = 1.4826 * float(np.median(np.abs(off)))
    if extents[1] < max(LEAST_EXTENT_MM, CLEAR_RATIO * extents[0]):
        raise PlaneUnclear(
            f"{source}: its mid-sagittal coils stay within {extents[1]:.1f} mm of a straight line and scatter "
            f"{extents[0]:.1f} mm off their plane, so they do not tell how the plane lies; take a recording with more "
            "tongue movement, or rely on the stated axes."
        )
    tilt = _angle_deg(normal, left)
    if tilt > LARGEST_TILT_DEG:
        raise InputError(
            f"{source}: the plane of its mid-sagittal coils is turned {tilt:.0f} degrees against the stated axes, more "
            f"than the {LARGEST_TILT_DEG:.0f} of a head held askew; a coil's role or the axes are wrong."
        )
    if len(samples) >= 3:
        others = [samples[:without] + samples[without + 1 :] for without in range(len(samples))]
        unsure = max(_angle_deg(_robust_plane(rest, left)[0], normal) for rest in others)
    else:
        unsure = float(np.rad2deg(np.arctan(extents[0] / extents[1])))
    offsets = np.full(positions.shape[1], np.nan)
    offsets[there] = [float(np.median((coil - point) @ normal)) for coil in samples]
    return MidSagittalPlane(normal, point, spread, offsets, tilt, unsure)


def _robust_plane(
    coils: list[FloatArray], left: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Normal (towards `left`), point, distances of all samples, and the robust extents (3,) across and along.

    Reweighted principal axes with Cauchy weights by the distance from the plane.
    """
    samples = np.concatenate(coils)
    fair = np.concatenate([np.full(len(coil), 1.0 / len(coil)) for coil in coils])
    point = np.median(samples, axis=0)
    off = (samples - point) @ left  # the first round trusts the stated direction
    for _ in range(ROUNDS):
        scale = max(1.4826 * float(np.median(np.abs(off - np.median(off)))), 0.05)
        weights = fair / (1.0 + (off / (2.0 * scale)) ** 2)
        weights /= weights.sum()
        point = weights @ samples
        centred = samples - point
        values, vectors = np.linalg.eigh((centred * weights[:, None]).T @ centred)
        normal = vectors[:, 0] * (1.0 if vectors[:, 0] @ left >= 0 else -1.0)
        moved, off = off, centred @ normal
        if np.abs(off - moved).max() < 1e-9:
            break
    return normal, point, off, np.sqrt(np.maximum(values, 0.0))


def _smallest_turn(start: FloatArray, end: FloatArray) -> FloatArray:
    """(3, 3) the rotation of least angle that takes unit vector `start` to `end`; they are not opposite."""
    axis, cosine = np.cross(start, end), float(start @ end)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cosine))


def _angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Angle between two unit vectors, exact also where they are nearly equal."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))
