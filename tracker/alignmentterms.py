"""The parts of the alignment's cost J that need the model, with their derivatives, compiled (see `registration`).

A measured axis is one coordinate of one coil: its index among the coordinates (3n,) of a frame of n coils.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .kernels import OPTIONS
from .pose import FloatArray

DIFFERENCE = 1e-5  # radians


class Term(NamedTuple):
    """value: of the mean frame; slope: (m,) its derivatives in the raw speaker weights; motion_slope: (4, 3) those in
    the rotation matrix, then in the translation."""

    value: float
    slope: FloatArray
    motion_slope: FloatArray


class FrameTerms(NamedTuple):
    """whole: -log Normal of coils in any pose; beside: of what no pose can follow; off: (axes,) to be added to
    coils for their deviation from what is expected; gain: (n, axes) of the pose; inverse: (axes, axes) of the
    expected covariance; directions: (n, axes) d v / d p."""

    whole: Term
    beside: Term
    off: FloatArray
    gain: FloatArray
    inverse: FloatArray
    directions: FloatArray


@njit(**OPTIONS)
def rotation_about(turn: FloatArray) -> FloatArray:
    """(3, 3) from a rotation vector (3,), radians."""
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    rotation = np.eye(3)
    if angle > 0.0:
        x, y, z = turn[0] / angle, turn[1] / angle, turn[2] / angle
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation = rotation + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return rotation


@njit(**OPTIONS)
def motion_about(centre: FloatArray, shift: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) by a rotation vector (3,), radians, about a centre (3,), then a shift (3,): with the translation
    (3,) of it as the last row, (4, 3); and (3, 4, 3) its derivatives in the rotation vector."""
    motion, slopes = np.empty((4, 3)), np.empty((3, 4, 3))
    motion[:3] = rotation_about(turn)
    motion[3] = centre - motion[:3] @ centre + shift
    for index in range(3):
        step = np.zeros(3)
        step[index] = DIFFERENCE
        slopes[index, :3] = (rotation_about(turn + step) - rotation_about(turn - step)) / (2.0 * DIFFERENCE)
        slopes[index, 3] = -slopes[index, :3] @ centre
    return motion, slopes


@njit(**OPTIONS)
def mean_frame(
    core: FloatArray, origin: FloatArray, speaker: FloatArray, pose_mean: FloatArray, pose_covariance: FloatArray,
    frames_mean: FloatArray, frames_covariance: FloatArray, rotation: FloatArray, translation: FloatArray,
    axes: NDArray[np.int64], noise_mm: float,
) -> FrameTerms:  # fmt: skip
    """The terms of the mean frame: core (m, n, a) and origin (a,) at the coils' measured axes (a,), which are
    indices into the coordinates (3n,) of frames_mean and frames_covariance, these before the motion."""
    speakers, poses, size = core.shape
    turned = np.zeros((size, frames_mean.shape[0]))
    middle = np.zeros(size)
    for row in range(size):
        coil, axis = axes[row] // 3, axes[row] % 3
        middle[row] = translation[axis]
        for other in range(3):
            turned[row, 3 * coil + other] = rotation[axis, other]
            middle[row] += rotation[axis, other] * frames_mean[3 * coil + other]
    spread = turned @ frames_covariance @ turned.T
    directions = np.zeros((poses, size))
    for weight in range(speakers):
        directions += speaker[weight] * core[weight]
    answering = pose_covariance @ directions
    expected_middle = origin + pose_mean @ directions
    off = middle - expected_middle
    inverse = np.linalg.inv(directions.T @ answering + noise_mm**2 * np.eye(size))
    pull = inverse @ off
    value = 0.5 * (np.sum(inverse * spread) + np.sum(off * pull) - np.linalg.slogdet(inverse)[1])
    narrower = inverse - inverse @ spread @ inverse - np.outer(pull, pull)
    by_direction = answering @ narrower - np.outer(pose_mean, pull)
    # The best of all poses, usual or not, leaves what is across their directions.
    following = np.linalg.pinv(directions)
    across = (np.eye(size) - following @ directions) / noise_mm**2
    left = across @ off
    beside = 0.5 * (np.sum(across * spread) + np.sum(off * left)) + np.trace(across) * noise_mm**2 * np.log(
        noise_mm
    )
    moments = spread + np.outer(off, off)
    beside_by_direction = -np.outer(pose_mean, left) - following.T @ moments @ across
    slopes = np.zeros((2, speakers))
    for weight in range(speakers):
        slopes[0, weight] = np.sum(core[weight] * by_direction)
        slopes[1, weight] = np.sum(core[weight] * beside_by_direction)
    # Both are quadratic in the coils, with these matrices.
    quadratics = np.empty((2, size, size))
    quadratics[0], quadratics[1] = inverse, across
    motion_slopes = np.zeros((2, 4, 3))
    for term in range(2):
        by_turned = quadratics[term] @ turned @ frames_covariance
        by_middle = quadratics[term] @ off
        for row in range(size):
            coil, axis = axes[row] // 3, axes[row] % 3
            motion_slopes[term, 3, axis] += by_middle[row]
            for other in range(3):
                motion_slopes[term, axis, other] += by_turned[row, 3 * coil + other]
                motion_slopes[term, axis, other] += by_middle[row] * frames_mean[3 * coil + other]
    # The most probable pose = mean + gain @ (coils - expected).
    gain = answering @ inverse
    return FrameTerms(
        Term(value, slopes[0], motion_slopes[0]), Term(beside, slopes[1], motion_slopes[1]), -expected_middle,
        gain, inverse, directions,  # type: ignore[arg-type]
    )  # fmt: skip


@njit(**OPTIONS)
def palate_bound(
    contour_core: FloatArray, contour_origin: FloatArray, core: FloatArray, speaker: FloatArray,
    pose_mean: FloatArray, pose_covariance: FloatArray, frame: FrameTerms, coils: FloatArray,
    rotation: FloatArray, translation: FloatArray, axes: NDArray[np.int64], noise_mm: float,
    palate_axes: FloatArray, palate_curve: FloatArray, worst: int, sd_mm: float,
) -> Term:  # fmt: skip
    """(mean height above the palate)^2 / (2 sd^2) of the frames that rise highest, as many as `worst`.

    contour_core (m, n, 3c), contour_origin (3c,): the model along the contour; core (m, n, a): at the coils' measured
    axes (a,); frame: of `mean_frame` at the same place; coils (T, 3n): before the motion. palate_axes (2, 3): backwards
    and upwards in the coils' frame; palate_curve (2, k): how far back, increasing, and how far up the palate is along
    these. The poses are the most probable ones, which follow speaker and motion, and so do their derivatives.
    """
    speakers, poses, size = core.shape
    points = contour_origin.shape[0] // 3
    directions = np.zeros((poses, 3 * points))
    for weight in range(speakers):
        directions += speaker[weight] * contour_core[weight]
    measured = np.empty((coils.shape[0], size))
    for row in range(size):
        coil, axis = axes[row] // 3, axes[row] % 3
        for index in range(coils.shape[0]):
            measured[index, row] = translation[axis]
            for other in range(3):
                measured[index, row] += rotation[axis, other] * coils[index, 3 * coil + other]
    offs = measured + frame.off
    found = pose_mean + offs @ frame.gain.T
    contours = contour_origin + found @ directions

    backwards, upwards = rotation @ palate_axes[0], rotation @ palate_axes[1]
    heights = np.full(len(coils), -np.inf)
    highest = np.zeros(len(coils), dtype=np.int64)
    rises = np.zeros(len(coils))  # of the palate there
    behind = translation @ backwards
    below = translation @ upwards
    size_of_curve = palate_curve.shape[1]
    for index in range(len(coils)):
        after = 1
        for point in range(points):
            back, up = -behind, -below
            for axis in range(3):
                coordinate = contours[index, 3 * point + axis]
                back += coordinate * backwards[axis]
                up += coordinate * upwards[axis]
            if back < palate_curve[0, 0] or back > palate_curve[0, -1]:
                continue
            # Neighbouring points are below neighbouring places of the palate.
            while after < size_of_curve - 1 and palate_curve[0, after] < back:
                after += 1
            while after > 1 and palate_curve[0, after - 1] > back:
                after -= 1
            rise = (palate_curve[1, after] - palate_curve[1, after - 1]) / (
                palate_curve[0, after] - palate_curve[0, after - 1]
            )
            height = up - palate_curve[1, after - 1] - rise * (back - palate_curve[0, after - 1])
            if height > heights[index]:
                heights[index], highest[index], rises[index] = height, point, rise

    slope, motion_slope = np.zeros(speakers), np.zeros((4, 3))
    chosen = np.argsort(heights)[-worst:]
    mean = np.sum(np.maximum(heights[chosen], 0.0)) / worst
    each = mean / (worst * sd_mm**2)
    unsure = pose_covariance - frame.gain @ frame.directions.T @ pose_covariance
    for index in chosen:
        if heights[index] <= 0.0:
            continue
        first = 3 * highest[index]
        away = palate_axes[1] - rises[index] * palate_axes[0]  # from the palate, in the coils' frame
        by_point = rotation @ away
        there = contours[index, first : first + 3] - translation
        by_pose = np.zeros(poses)
        for axis in range(3):
            by_pose += directions[:, first + axis] * by_point[axis]
        by_coils = frame.gain.T @ by_pose
        pose = found[index]
        left = offs[index] - (pose - pose_mean) @ frame.directions
        answering = unsure @ by_pose
        for weight in range(speakers):
            for axis in range(3):
                moved = np.sum(pose * contour_core[weight, :, first + axis])
                slope[weight] += each * moved * by_point[axis]
            slope[weight] += each * np.sum(answering * (core[weight] @ left)) / noise_mm**2
            slope[weight] -= each * np.sum(by_coils * (pose @ core[weight]))
        for axis in range(3):
            motion_slope[3, axis] -= each * by_point[axis]
            for other in range(3):
                motion_slope[axis, other] += each * there[axis] * away[other]
        for row in range(size):
            coil, axis = axes[row] // 3, axes[row] % 3
            motion_slope[3, axis] += each * by_coils[row]
            for other in range(3):
                motion_slope[axis, other] += each * by_coils[row] * coils[index, 3 * coil + other]
    return Term(0.5 * (mean / sd_mm) ** 2, slope, motion_slope)
