"""Generalised Procrustes alignment of palates, carried over to tongues (paper, "Preparing the training mesh collection").

The hard palate moves with the head alone. Aligning the palates of all speakers, by rotation and translation but not by
size, removes where their heads were; the tongues follow their palates, so that what they do in the mouth stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from .mesh import FloatArray

ITERATIONS = 40
SETTLED_MM = 1e-9
LEAST_SPREAD = 1e-6  # of the largest extent, that of a shape's second direction: less is a line


@dataclass(frozen=True)
class RigidMotion:
    """x -> rotation x + shift. rotation: (3, 3), proper; shift: (3,) mm."""

    rotation: FloatArray
    shift: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) mm, moved."""
        return np.asarray(points @ self.rotation.T + self.shift)

    def after(self, first: RigidMotion) -> RigidMotion:
        """The one motion that does `first`, then this."""
        return RigidMotion(self.rotation @ first.rotation, self.apply(first.shift))


@dataclass(frozen=True)
class Alignment:
    """mean: (n, 3) mm; shapes: (s, n, 3) mm, aligned; motions: what brought each shape there."""

    mean: FloatArray
    shapes: FloatArray
    motions: tuple[RigidMotion, ...]


def rigid_motion(source: FloatArray, target: FloatArray) -> RigidMotion:
    """The motion with the least squared distances from source to target, both (n, 3) mm with corresponding rows.

    Never a reflection (Kabsch). Raises InputError for different shapes, no numbers, or points on one line, about
    which they could turn.
    """
    for points, name in ((source, "source"), (target, "target")):
        _check(np.asarray(points)[None], name)
    if source.shape != target.shape:
        raise InputError(
            f"a rigid motion needs corresponding points; the source has {len(source)}, the target {len(target)}."
        )
    centre, goal = source.mean(axis=0), target.mean(axis=0)
    left, _, right = np.linalg.svd((source - centre).T @ (target - goal))
    proper = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    rotation = np.asarray((left @ proper @ right).T)
    return RigidMotion(rotation, goal - rotation @ centre)


def upright(shape: FloatArray, mirror: NDArray[np.intp]) -> RigidMotion:
    """What lays a shape (n, 3) mm evenly about the plane x = 0: half of the motion onto its own mirror image.

    mirror: (n,) the vertex on the other side. Raises InputError as `rigid_motion`.
    """
    from scipy.spatial.transform import Rotation

    whole = rigid_motion(shape, shape[mirror] * (-1.0, 1.0, 1.0))
    half = Rotation.from_rotvec(0.5 * Rotation.from_matrix(whole.rotation).as_rotvec()).as_matrix()
    centre = shape.mean(axis=0)
    return RigidMotion(half, 0.5 * (centre + whole.apply(centre)) - half @ centre)


def procrustes(shapes: FloatArray, frame: FloatArray, iterations: int = ITERATIONS) -> Alignment:
    """Shapes (s, n, 3) mm brought to their common mean by rotations and translations, until nothing moves any more.

    frame: (n, 3) mm, where the mean is put as a whole, for the shapes do not tell: the palate template in the frame
    of the model. iterations: at most so many. Raises InputError as `rigid_motion`.
    """
    shapes = np.asarray(shapes, dtype=np.float64)
    _check(shapes, "shape")
    if frame.shape != shapes.shape[1:]:
        raise InputError(
            f"the frame has {len(frame)} points, the shapes have {shapes.shape[1]}; they must correspond."
        )
    # The first is one of them: with the template to begin with, the mean would keep a trace of it.
    mean = rigid_motion(shapes[0], frame).apply(shapes[0])
    for _ in range(iterations):
        moved = np.array([rigid_motion(shape, mean).apply(shape) for shape in shapes])
        previous, mean = mean, moved.mean(axis=0)
        if np.abs(mean - previous).max() < SETTLED_MM:
            break
    mean = rigid_motion(mean, frame).apply(mean)
    motions = tuple(rigid_motion(shape, mean) for shape in shapes)
    aligned = np.array([motion.apply(shape) for motion, shape in zip(motions, shapes, strict=True)])
    return Alignment(mean, aligned, motions)


def carried_over(
    palates: FloatArray, speakers: Sequence[int], aligned: FloatArray
) -> tuple[RigidMotion, ...]:
    """What moves the tongue of each scan along with its palate.

    palates: (c, n, 3) mm, in each scan the palate of its speaker, brought there rigidly; speakers: (c,) whose it is, as
    a row of aligned: (s, n, 3) mm, the palates after `procrustes`.
    """
    return tuple(
        rigid_motion(palate, aligned[speaker]) for palate, speaker in zip(palates, speakers, strict=True)
    )


def _check(shapes: NDArray[np.float64], name: str) -> None:
    """Raises InputError unless shapes (s, n, 3) each say how they are turned."""
    if shapes.ndim != 3 or shapes.shape[2] != 3 or not len(shapes):
        raise InputError(
            f"a {name} of the size {shapes.shape[1:]} cannot be aligned; expected points (n, 3)."
        )
    for number, shape in enumerate(shapes, 1):
        if not np.isfinite(shape).all():
            raise InputError(f"{name} {number} has points that are not numbers; it cannot be aligned.")
        extents = np.linalg.svd(shape - shape.mean(axis=0), compute_uv=False)
        if len(extents) < 2 or extents[1] <= LEAST_SPREAD * max(extents[0], 1e-12):
            raise InputError(f"{name} {number} is a point or a line, which does not tell how it is turned.")
