"""The head's motion from reference coils, which no articulation moves, frame by frame.

A frame's motion is the rigid one that takes the references at rest nearest to where they are now: weighted least
squares by a unit quaternion (B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions",
1987), the largest eigenvector of a 4 x 4 matrix, which is found by squaring it again and again. All positions are in the source's own frame, mm.

Which references can be believed is told by their mutual distances, which no motion of the head changes. A distance
that differs from the one at rest by more than `TOLERANCE_MM`, or by more than `NOISE_FACTOR` times the noise of the
distances at rest where that is more, is changed. The reference with most changed distances is left out, then the next,
until those left agree; so four or more references outvote one that slipped, and of three it is the one whose two
distances changed while the distance of the two others did not. Where counting does not decide (of three references
one distance changed, of two the only one) it is one that had slipped before, else the one that is farther from where
the last motion would have it. A slip across the plane of three references changes none of their distances, and those
to a fourth but little. So where three or more are where the last full motion would have them, one that is not, by the
tolerance and what a head can do in a frame (`FASTEST_MM_S`), is left out as well. What remains unseen: a slip that is
smaller or so slow that no distance shows it, and, with three references, one across their plane.

A reference that is left out has no part in that very frame, so an outlier costs its own frame and no more. One that
was left out for more than `SLIP_S` has slipped: it counts again when all its distances to those that agree have been
right, to within `RIGHT_SHARE` of the tolerance, for `RETURN_S`, and the others' full motion has it there. Inside the tolerance a reference weighs the less, the
more its distances differ, so that one that slips slowly does not jerk the head when it is left out.

Where fewer than three references count, or those that do lie nearly on one line, a 6-D coil among them gives the
rotation. Without one, the rest goes on from the last motion: two references move and turn it as far as their two
points say, and the rotation about the axis through them stays the last one; one reference moves it and does not turn
it; without any it stands still. The status says so.

Time is counted in frames of the nominal rate, never by a clock: a recording and its replay give the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import combinations
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .. import InputError
from .kernels import FARTHEST_MM, OPTIONS
from .pose import FloatArray

IntArray = NDArray[np.int64]

TOLERANCE_MM = 3.0
"""Skin over bone and the field of an articulograph change distances by a millimetre or two."""
NOISE_FACTOR = 5.0
SLIP_S = 0.02
RETURN_S = 0.2
RIGHT_SHARE = 0.75
OFF_LINE_MM = 10.0
"""References that are all nearer to one line than this do not say how far the head is turned about it."""
FASTEST_MM_S = 500.0
"""So fast a head that turns about three of its references moves the others, at most."""
HEAD_JUMP_MM = 20.0  # between neighbouring frames; no head does that
USUAL_RATE_HZ = 250.0
LEAST_WEIGHT = 1e-3
REST_PASSES = 3
MOST_SQUARINGS = 40  # references that are just not on a line need 13


class ReferenceState(IntEnum):
    """Whether a reference counts in this frame, and if not, why."""

    OK = 0
    MISSING = 1  # the source has no position for it
    SLIPPED = 2  # its distances to the others are not those at rest, or not yet right for long enough


class HeadStatus(IntEnum):
    """How a frame's motion came about."""

    LOST = 0  # not known: the rotation was never determined yet; rotation and translation are NaN
    OK = 1  # three or more references, or a 6-D one, determine it
    HELD = 2  # no reference counts: the last motion
    TWO_LEFT = 3  # the rotation about the axis through two references is the last one
    ONE_LEFT = 4  # the whole rotation is the last one


_OK, _MISSING, _SLIPPED = (int(state) for state in ReferenceState)
_LOST, _FULL, _HELD, _TWO_LEFT, _ONE_LEFT = (int(status) for status in HeadStatus)

# Rows of the memory (rows, k): what is known of each reference, then work space of one frame.
_SLIPPING = 0  # frames left out, less those that were not
_STUCK_OUT = 1  # 1.0 while it has slipped
_RIGHT = 2  # frames since when it is right again
_AGREES = 3  # 1.0: its distances agree with the others'
_WEIGHT = 4
_OFF = 5  # distance from where the last motion would have it
_CHANGED = 6  # how many distances changed
_DIFFERENCE = 7  # sum of the differences
_APART = 8  # (k rows) difference of each distance from the one at rest
# Rows of the motion (5, 3): rotation, translation, then these.
_TRANSLATION, _KNOWN, _RESIDUAL, _STATUS = 3, (4, 0), (4, 1), (4, 2)


@dataclass(frozen=True)
class HeadReference:
    """Where the reference coils are while the head is at rest.

    roles: (k,); positions_mm: (k, 3) in the source's frame; source: where it comes from, for people.
    orientation: (k, 4) quaternions (w, x, y, z) that turn a coil's axes into the source's, of 6-D coils; NaN = the
    coil is none; None = no coil is. noise_mm: standard deviation of the coils' mutual distances at rest.

    Raises InputError where they do not determine a motion: fewer than three and no 6-D one, or all on one line.
    """

    roles: tuple[str, ...]
    positions_mm: FloatArray
    source: str
    orientation: FloatArray | None = None
    noise_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.orientation is not None and np.isfinite(self.orientation).all(axis=1).any():
            return
        _check_count(self.roles, self.source)
        if _farthest_off_line(self.positions_mm) < OFF_LINE_MM:
            raise InputError(
                f"{self.source}: the reference coils {', '.join(self.roles)} lie on one line to within "
                f"{OFF_LINE_MM:g} mm, so they do not tell how the head turns about it; take one beside that line."
            )

    @property
    def tolerance_mm(self) -> float:
        """So much may a distance differ from the one at rest."""
        return max(TOLERANCE_MM, NOISE_FACTOR * self.noise_mm)


@dataclass(frozen=True)
class HeadMotion:
    """The head's motion over a recording: now = rotation @ rest + translation, mm in the source's frame.

    rotations: (frames, 3, 3), translations: (frames, 3), NaN where the motion is not known; states: (frames, k)
    `ReferenceState`; residuals_mm: (frames,) mean distance of the references that count from where the motion takes
    them, NaN without any; statuses: (frames,) `HeadStatus`.
    """

    rotations: FloatArray
    translations: FloatArray
    states: IntArray
    residuals_mm: FloatArray
    statuses: IntArray


class HeadCorrector:
    """What is known of the head from one frame to the next.

    rate_hz: nominal. states: (k,) `ReferenceState` of the last frame. arrays: what the compiled `follow_head` is given,
    which does one frame: its first two are the frame's references, (k, 3) mm and (k, 4), NaN = missing.
    """

    def __init__(self, reference: HeadReference, rate_hz: float = USUAL_RATE_HZ) -> None:
        count = len(reference.roles)
        self._rest = np.array(reference.positions_mm, dtype=np.float64, order="C")
        self._rest_quaternions = _quaternions_or_none(reference.orientation, (count, 4))
        tolerance_mm = reference.tolerance_mm
        jump_mm = tolerance_mm + FASTEST_MM_S / rate_hz
        self._limits = np.array(
            [tolerance_mm, max(1.0, SLIP_S * rate_hz), max(1.0, RETURN_S * rate_hz), jump_mm]
        )
        self._memory = np.zeros((_APART + count, count))
        self._work = np.zeros((12, 4))
        self._motion = np.zeros((5, 3))
        self.states: IntArray = np.full(count, _MISSING, np.int64)
        self.arrays: tuple[FloatArray | IntArray, ...] = (
            np.full((count, 3), np.nan), np.full((count, 4), np.nan), self._rest, self._rest_quaternions,
            self._limits, self._memory, self._work, self._motion, self.states,
        )  # fmt: skip

    def reset(self) -> None:
        """Forgets the last motion and what has slipped."""
        self._memory[:] = 0.0
        self._motion[:] = 0.0
        self.states[:] = _MISSING

    def _all_steps(self, references: FloatArray, quaternions: FloatArray, motion: HeadMotion) -> None:
        """The steps of a whole recording: references (frames, k, 3), quaternions (frames, k, 4)."""
        _all_steps(
            references, quaternions, self._rest, self._rest_quaternions, self._limits, self._memory, self._work,
            self._motion, motion.rotations, motion.translations, motion.states, motion.residuals_mm, motion.statuses,
        )  # fmt: skip


def head_motion(
    references: FloatArray,
    reference: HeadReference,
    rate_hz: float = USUAL_RATE_HZ,
    quaternions: FloatArray | None = None,
) -> HeadMotion:
    """The motion over a recording, with the bits that `HeadCorrector` and `follow_head` give frame by frame.

    references: (frames, k, 3) mm, NaN = missing, in the order of `reference.roles`; quaternions: (frames, k, 4).
    """
    frames, count = references.shape[:2]
    motion = HeadMotion(
        np.empty((frames, 3, 3)),
        np.empty((frames, 3)),
        np.empty((frames, count), np.int64),
        np.empty(frames),
        np.empty(frames, np.int64),
    )
    HeadCorrector(reference, rate_hz)._all_steps(
        np.array(references, dtype=np.float64, order="C"),
        _quaternions_or_none(quaternions, (frames, count, 4)),
        motion,
    )
    return motion


def head_jump(motion: HeadMotion, reference: HeadReference) -> tuple[int, float] | None:
    """The largest jump of the head between neighbouring frames in which it is sure: the later frame, and mm.

    None where none is more than HEAD_JUMP_MM. References that lie as mirror images, as the ears do, keep their
    distances when they are exchanged; only that the head turns round from one frame to the next tells.
    """
    places = np.einsum("tab,kb->tka", motion.rotations, reference.positions_mm)
    places += motion.translations[:, None]
    jumps = np.linalg.norm(np.diff(places, axis=0), axis=2).max(axis=1, initial=0.0)
    sure = motion.statuses == HeadStatus.OK
    jumps[~(sure[1:] & sure[:-1])] = 0.0
    if jumps.max(initial=0.0) <= HEAD_JUMP_MM:
        return None
    return int(np.argmax(jumps)) + 1, float(jumps.max())


def correct(positions: FloatArray, motion: HeadMotion) -> FloatArray:
    """positions (frames, coils, 3), mm in the source's frame, with the head as at rest; NaN where that is not known."""
    still: FloatArray = np.einsum(
        "tba,tcb->tca", motion.rotations, positions - motion.translations[:, None, :]
    )
    return still


def rest_reference(
    positions: FloatArray, roles: Sequence[str], source: str, quaternions: FloatArray | None = None
) -> HeadReference:
    """The reference coils' places from an interval in which the head rests, or moves as one piece.

    positions: (frames, k, 3) mm in the source's frame, NaN = missing; quaternions: (frames, k, 4) as (w, x, y, z), NaN
    for coils that are not 6-D (of a 5-D coil one of three angles means nothing). The shape is the median over the
    frames after each was brought to a typical one; it is placed where the head was on the median.

    Raises InputError where a coil is never there, where they are never there together, where fewer than three are given
    and no 6-D one, where all lie on one line, and where they move against each other by more than the tolerance.
    """
    turning = _quaternions_or_none(quaternions, (*positions.shape[:2], 4))
    six_d: NDArray[np.bool_] = np.asarray(np.isfinite(turning).all(axis=2))
    if not six_d.any():
        _check_count(roles, source)
    there: NDArray[np.bool_] = np.asarray(np.isfinite(positions).all(axis=2))
    for coil, role in enumerate(roles):
        if not there[:, coil].any():
            raise InputError(
                f"{source}: the reference coil {role} is never there; leave it out of the references or take another "
                "interval."
            )
    wanted: NDArray[np.bool_] = np.asarray(there & (six_d | ~six_d.any(axis=0)))
    complete = np.flatnonzero(wanted.all(axis=1))
    if len(complete) == 0:
        shares = zip(roles, wanted.mean(axis=0), strict=True)
        raise InputError(
            f"{source}: the reference coils are never there together "
            f"({', '.join(f'{role} in {100 * share:.0f} %' for role, share in shares)} of the frames); leave out the "
            "one that is missing most or take another interval."
        )
    typical, noise_mm = _typical_frame(positions, complete)
    if noise_mm > TOLERANCE_MM:
        raise InputError(
            f"{source}: the reference coils {', '.join(roles)} move against each other (their distances by "
            f"{noise_mm:.1f} mm), so not all of them sit on the head; check the roles in [coils]."
        )
    orientation = turning[typical] if six_d.any() else None
    reference = HeadReference(tuple(roles), positions[typical], source, orientation, noise_mm)
    for _ in range(REST_PASSES):
        reference = _median_reference(reference, positions, turning)
    return reference


def head_toml(reference: HeadReference) -> dict[str, Any]:
    """The session's table [head]; `head_from_toml` gives the reference back unchanged."""
    table: dict[str, Any] = {"source": reference.source, "noise_mm": float(reference.noise_mm)}
    table["rest_mm"] = dict(zip(reference.roles, reference.positions_mm.tolist(), strict=True))
    if reference.orientation is not None:
        turned = zip(reference.roles, reference.orientation.tolist(), strict=True)
        table["orientation"] = {role: values for role, values in turned if np.isfinite(values).all()}
    return table


def head_from_toml(table: Mapping[str, Any]) -> HeadReference:
    """A reference from the session's table [head]. Raises InputError that names the key at fault."""
    known = ("source", "noise_mm", "rest_mm", "orientation")
    for key in table:
        if key not in known:
            raise InputError(f"[head] has the unknown key '{key}'; expected {', '.join(known)}.")
    source = table.get("source", "[head]")
    if not isinstance(source, str):
        raise InputError(f"[head] source = {source!r}: expected text in quotes.")
    noise_mm = table.get("noise_mm", 0.0)
    if (
        isinstance(noise_mm, bool)
        or not isinstance(noise_mm, (int, float))
        or not 0 <= noise_mm <= FARTHEST_MM
    ):
        raise InputError(f"[head] noise_mm = {noise_mm!r}: expected a number of millimetres, 0 or more.")
    rest = _rows(table.get("rest_mm"), "rest_mm", 3)
    turned = _rows(table["orientation"], "orientation", 4) if "orientation" in table else {}
    for role, values in turned.items():
        if role not in rest:
            raise InputError(f"[head.orientation] names {role}, which has no position in [head.rest_mm].")
        if not any(values):
            raise InputError(f"[head.orientation] {role} is zero, which is no quaternion.")
    orientation = np.array([turned.get(role, [np.nan] * 4) for role in rest]) if turned else None
    return HeadReference(tuple(rest), np.array(list(rest.values())), source, orientation, float(noise_mm))


def _rows(table: Any, key: str, size: int) -> dict[str, list[float]]:
    """role -> `size` finite numbers."""
    if not isinstance(table, Mapping) or not table:
        raise InputError(f"[head] needs a table [head.{key}] of the form role = [{', '.join('...' * size)}].")
    for role, values in table.items():
        fits = isinstance(values, list) and len(values) == size
        if not fits or not all(
            isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= FARTHEST_MM for v in values
        ):
            raise InputError(f"[head.{key}] {role}: expected a list of {size} numbers.")
    return {str(role): [float(v) for v in values] for role, values in table.items()}


def _check_count(roles: Sequence[str], source: str) -> None:
    if len(roles) < 3:
        raise InputError(
            f"{source}: the head's motion needs three reference coils, or a 6-D one, but there "
            f"{'is' if len(roles) == 1 else 'are'} {len(roles)} ({', '.join(roles) or 'none'}); give more channels a "
            "role that begins with head_ in [coils]."
        )


def _quaternions_or_none(quaternions: FloatArray | None, shape: tuple[int, ...]) -> FloatArray:
    """A copy of the quaternions; all NaN where there are none."""
    if quaternions is None:
        return np.full(shape, np.nan)
    return np.array(quaternions, dtype=np.float64, order="C")


def _farthest_off_line(points: FloatArray) -> float:
    """The largest distance of points (k, 3), k >= 2, from the line through the two that are farthest apart, mm."""
    pairs = list(combinations(range(len(points)), 2))
    first, last = max(pairs, key=lambda pair: float(np.linalg.norm(points[pair[1]] - points[pair[0]])))
    line = points[last] - points[first]
    length = np.linalg.norm(line)
    if not length > 0:
        return 0.0
    return float(np.linalg.norm(np.cross(points - points[first], line / length), axis=1).max())


def _typical_frame(positions: FloatArray, complete: NDArray[np.intp]) -> tuple[int, float]:
    """Of the complete frames one whose distances and places are near the medians; and the distances' noise.

    The noise is the standard deviation of a distance over the frames (1.4826 times its median deviation), the median of
    all pairs; mm.
    """
    pairs = list(combinations(range(positions.shape[1]), 2))
    places = np.linalg.norm(positions[complete] - np.median(positions[complete], axis=0), axis=2).mean(axis=1)
    if not pairs:
        return int(complete[np.argmin(places)]), 0.0
    first, second = (list(ends) for ends in zip(*pairs, strict=True))
    distances = np.linalg.norm(positions[complete][:, first] - positions[complete][:, second], axis=2)
    deviations = np.abs(distances - np.median(distances, axis=0))
    noise_mm = float(np.median(1.4826 * np.median(deviations, axis=0)))
    # A frame in which one distance is off is none, however good the others are.
    worst = deviations.max(axis=1)
    usual = worst <= np.median(worst)
    return int(complete[usual][np.argmin(places[usual])]), noise_mm


def _median_reference(
    reference: HeadReference, positions: FloatArray, quaternions: FloatArray
) -> HeadReference:
    """The medians of the references that count, brought to `reference`, and placed where the head was on the median."""
    # One frame a second: then each frame is judged by itself, for a slip that ends needs one frame to be forgotten.
    motion = head_motion(positions, reference, 1.0, quaternions)
    counted = motion.states == _OK
    counted[motion.statuses != _FULL] = False
    shape = np.nanmedian(np.where(counted[:, :, None], correct(positions, motion), np.nan), axis=0)
    full = motion.statuses == _FULL
    # The rotation nearest to the median of all (it is all but orthonormal already).
    left, _, right = np.linalg.svd(np.median(motion.rotations[full], axis=0))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    centre = shape.mean(axis=0)
    placed = np.median(motion.rotations[full] @ centre + motion.translations[full], axis=0)
    orientation = None
    if reference.orientation is not None:
        orientation = _median_orientation(reference.orientation, motion, quaternions, turn)
    return HeadReference(
        reference.roles, (shape - centre) @ turn.T + placed, reference.source, orientation, reference.noise_mm
    )


def _median_orientation(
    usual: FloatArray, motion: HeadMotion, quaternions: FloatArray, turn: FloatArray
) -> FloatArray:
    """(k, 4) medians of the orientations, the head's motion taken out, turned by `turn`; NaN = not 6-D."""
    from scipy.spatial.transform import Rotation

    orientation = np.full_like(usual, np.nan)
    for coil in np.flatnonzero(np.isfinite(usual).all(axis=1)):
        frames = (motion.statuses == _FULL) & np.isfinite(quaternions[:, coil]).all(axis=1)
        coils = Rotation.from_quat(quaternions[frames, coil][:, [1, 2, 3, 0]])
        still = (Rotation.from_matrix(motion.rotations[frames]).inv() * coils).as_quat()
        nearest = Rotation.from_quat(usual[coil][[1, 2, 3, 0]]).as_quat()
        still *= np.where(still @ nearest < 0.0, -1.0, 1.0)[:, None]  # q and -q are the same orientation
        turned = Rotation.from_matrix(turn) * Rotation.from_quat(np.median(still, axis=0))
        orientation[coil] = turned.as_quat()[[3, 0, 1, 2]]
    return orientation


@njit(**OPTIONS)
def _all_steps(
    references: FloatArray,
    quaternions: FloatArray,
    rest: FloatArray,
    rest_quaternions: FloatArray,
    limits: FloatArray,
    memory: FloatArray,
    work: FloatArray,
    motion: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
    states: IntArray,
    residuals: FloatArray,
    statuses: IntArray,
) -> None:
    for frame in range(references.shape[0]):
        statuses[frame] = follow_head(
            references[frame], quaternions[frame], rest, rest_quaternions, limits, memory, work, motion,
            states[frame],
        )  # fmt: skip
        rotations[frame] = motion[:_TRANSLATION]
        translations[frame] = motion[_TRANSLATION]
        residuals[frame] = motion[_RESIDUAL]


@njit(**OPTIONS)
def follow_head(
    now: FloatArray,
    quaternions: FloatArray,
    rest: FloatArray,
    rest_quaternions: FloatArray,
    limits: FloatArray,
    memory: FloatArray,
    work: FloatArray,
    motion: FloatArray,
    states: IntArray,
) -> int:
    """One frame: judges the references, then finds the motion; the `HeadStatus`.

    now: (k, 3) mm in the source's frame, quaternions: (k, 4) of 6-D references, NaN = missing; limits: tolerance in mm,
    frames to slip, frames to return, jump in mm; motion: (5, 3) the last one, then this one: its rows are the rotation,
    the translation, then whether it is known, the mean residual in mm, the status.
    """
    _judge(now, rest, limits, memory, motion, states)
    counting = _weigh(limits[0], memory, states)
    last = motion[_KNOWN] > 0.0
    status = _LOST
    if counting >= 3 and _off_line(rest, states, work) >= OFF_LINE_MM:
        _fit(now, rest, memory[_WEIGHT], states, work, motion)
        status = _FULL
    elif _turn_by_quaternion(quaternions, rest_quaternions, states, work, motion):
        _place(now, rest, memory[_WEIGHT], states, work, motion)
        status = _FULL
    elif last and counting >= 2:
        _off_line(rest, states, work)  # finds the two that are farthest apart
        _turn_axis(now, rest, work, motion)
        _place(now, rest, memory[_WEIGHT], states, work, motion)
        status = _TWO_LEFT
    elif last and counting == 1:
        _place(now, rest, memory[_WEIGHT], states, work, motion)
        status = _ONE_LEFT
    elif last:
        status = _HELD
    if status == _LOST:
        motion[:4] = np.nan
    else:
        motion[_KNOWN] = 1.0
    motion[_STATUS] = status
    _measure(now, rest, motion, states)
    return status


@njit(**OPTIONS)
def _off_by_last_motion(now: FloatArray, rest: FloatArray, motion: FloatArray, i: int) -> float:
    squared = 0.0
    for axis in range(3):
        moved = motion[_TRANSLATION, axis] - now[i, axis]
        for row in range(3):
            moved += motion[axis, row] * rest[i, row]
        squared += moved * moved
    return float(np.sqrt(squared))


@njit(**OPTIONS)
def _measure(now: FloatArray, rest: FloatArray, motion: FloatArray, states: IntArray) -> None:
    """The mean distance of the references that count from where the motion takes them."""
    total = 0.0
    counting = 0
    for i in range(now.shape[0]):
        if states[i] == _OK:
            total += _off_by_last_motion(now, rest, motion, i)
            counting += 1
    motion[_RESIDUAL] = total / counting if counting > 0 else np.nan


@njit(**OPTIONS)
def _judge(
    now: FloatArray,
    rest: FloatArray,
    limits: FloatArray,
    memory: FloatArray,
    motion: FloatArray,
    states: IntArray,
) -> None:
    """Each reference's state, from those whose distances agree and from what was found in earlier frames."""
    followed = motion[_STATUS] == _FULL  # the last motion says where each reference has to be
    _compare(now, rest, motion, memory, states)
    if followed:
        _leave_out_jumps(limits[0], limits[3], memory, states)
    _leave_out_the_worst(limits[0], memory)
    for i in range(now.shape[0]):
        if states[i] == _MISSING:
            memory[_RIGHT, i] = 0.0
        elif memory[_AGREES, i] == 0.0:
            states[i] = _SLIPPED
            memory[_RIGHT, i] = 0.0
            memory[_SLIPPING, i] += 1.0
            if memory[_SLIPPING, i] > limits[1]:
                memory[_STUCK_OUT, i] = 1.0
                memory[_SLIPPING, i] = 0.0
        else:
            memory[_SLIPPING, i] = max(0.0, memory[_SLIPPING, i] - 1.0)
            if memory[_STUCK_OUT, i] > 0.0:
                right = _is_right(memory, limits[0], i) and not (followed and memory[_OFF, i] > limits[3])
                memory[_RIGHT, i] = memory[_RIGHT, i] + 1.0 if right else 0.0
                if memory[_RIGHT, i] >= limits[2]:
                    memory[_STUCK_OUT, i] = 0.0
                    memory[_RIGHT, i] = 0.0
                else:
                    states[i] = _SLIPPED


@njit(**OPTIONS)
def _compare(
    now: FloatArray, rest: FloatArray, motion: FloatArray, memory: FloatArray, states: IntArray
) -> None:
    """Which are there, by how much their distances differ, and how far each is from where the last motion has it."""
    for i in range(now.shape[0]):
        states[i] = _OK
        for axis in range(3):
            if not abs(now[i, axis]) <= FARTHEST_MM:
                states[i] = _MISSING
        memory[_AGREES, i] = 1.0 if states[i] == _OK else 0.0
        known = states[i] == _OK and motion[_KNOWN] > 0.0
        memory[_OFF, i] = _off_by_last_motion(now, rest, motion, i) if known else 0.0
        for j in range(i):
            apart = apart_at_rest = 0.0
            for axis in range(3):
                apart += (now[i, axis] - now[j, axis]) ** 2
                apart_at_rest += (rest[i, axis] - rest[j, axis]) ** 2
            difference = abs(np.sqrt(apart) - np.sqrt(apart_at_rest))
            memory[_APART + i, j] = difference
            memory[_APART + j, i] = difference


@njit(**OPTIONS)
def _leave_out_jumps(tolerance: float, jump: float, memory: FloatArray, states: IntArray) -> None:
    """Where three or more are where the last motion has them, those that are not do not agree."""
    in_place = 0
    for i in range(states.shape[0]):
        if states[i] == _OK and memory[_STUCK_OUT, i] == 0.0 and memory[_OFF, i] <= tolerance:
            in_place += 1
    if in_place >= 3:
        for i in range(states.shape[0]):
            # One that was just left out has to be nearer than one that was in place.
            if memory[_OFF, i] > (jump if memory[_SLIPPING, i] == 0.0 else tolerance):
                memory[_AGREES, i] = 0.0


@njit(**OPTIONS)
def _leave_out_the_worst(tolerance: float, memory: FloatArray) -> None:
    """Again and again, until the distances of all that are left are those at rest."""
    count = memory.shape[1]
    for _ in range(count):
        worst = -1
        for i in range(count):
            if memory[_AGREES, i] == 0.0:
                continue
            changed = difference = 0.0
            for j in range(count):
                if j != i and memory[_AGREES, j] > 0.0:
                    difference += memory[_APART + i, j]
                    if memory[_APART + i, j] > tolerance:
                        changed += 1.0
            memory[_CHANGED, i] = changed
            memory[_DIFFERENCE, i] = difference
            if changed > 0.0 and (worst < 0 or _is_worse(memory, i, worst)):
                worst = i
        if worst < 0:
            break
        memory[_AGREES, worst] = 0.0


@njit(**OPTIONS)
def _is_worse(memory: FloatArray, i: int, than: int) -> bool:
    """By the number of changed distances, having slipped before, the last motion, the sum of all differences."""
    for row in (_CHANGED, _STUCK_OUT, _OFF, _DIFFERENCE):
        if memory[row, i] != memory[row, than]:
            return bool(memory[row, i] > memory[row, than])
    return False


@njit(**OPTIONS)
def _is_right(memory: FloatArray, tolerance: float, i: int) -> bool:
    """Whether all distances to those that agree, one at least, are well inside the tolerance."""
    compared = 0
    for j in range(memory.shape[1]):
        if j != i and memory[_AGREES, j] > 0.0:
            compared += 1
            if memory[_APART + i, j] > RIGHT_SHARE * tolerance:
                return False
    return compared > 0


@njit(**OPTIONS)
def _weigh(tolerance: float, memory: FloatArray, states: IntArray) -> int:
    """The weights by Tukey's rule from the mean difference of each one's distances; how many count."""
    counting = 0
    for i in range(states.shape[0]):
        if states[i] == _OK:
            counting += 1
    for i in range(states.shape[0]):
        if states[i] != _OK:
            memory[_WEIGHT, i] = 0.0
            continue
        mean = 0.0
        for j in range(states.shape[0]):
            if j != i and states[j] == _OK:
                mean += memory[_APART + i, j] / (counting - 1)
        inside = 1.0 - (mean / tolerance) ** 2
        memory[_WEIGHT, i] = max(LEAST_WEIGHT, inside * inside)
    return counting


@njit(**OPTIONS)
def _off_line(rest: FloatArray, states: IntArray, work: FloatArray) -> float:
    """How far those that count (two at least) lie off the line through the two of them farthest apart, at rest.

    work[0, :2]: which two these are.
    """
    longest = -1.0
    first = last = 0
    for i in range(rest.shape[0]):
        for j in range(i):
            if states[i] == _OK and states[j] == _OK:
                length = 0.0
                for axis in range(3):
                    length += (rest[i, axis] - rest[j, axis]) ** 2
                if length > longest:
                    longest = length
                    first, last = j, i
    work[0, 0], work[0, 1] = first, last
    farthest = 0.0
    for i in range(rest.shape[0]):
        if states[i] == _OK and i != first and i != last:
            squared = along = 0.0
            for axis in range(3):
                way = rest[i, axis] - rest[first, axis]
                squared += way * way
                along += way * (rest[last, axis] - rest[first, axis])
            farthest = max(farthest, squared - along * along / longest)
    return float(np.sqrt(farthest))


@njit(**OPTIONS)
def _centres(
    now: FloatArray, rest: FloatArray, weights: FloatArray, states: IntArray, work: FloatArray
) -> None:
    """The weighted means of those that count: work[6, :3] now, work[7, :3] at rest."""
    work[6:8] = 0.0
    total = 0.0
    for i in range(now.shape[0]):
        if states[i] == _OK:
            total += weights[i]
    for i in range(now.shape[0]):
        if states[i] == _OK:
            for axis in range(3):
                work[6, axis] += weights[i] / total * now[i, axis]
                work[7, axis] += weights[i] / total * rest[i, axis]


@njit(**OPTIONS)
def _place(
    now: FloatArray,
    rest: FloatArray,
    weights: FloatArray,
    states: IntArray,
    work: FloatArray,
    motion: FloatArray,
) -> None:
    """The translation that goes with the motion's rotation."""
    _centres(now, rest, weights, states, work)
    for axis in range(3):
        motion[_TRANSLATION, axis] = work[6, axis]
        for row in range(3):
            motion[_TRANSLATION, axis] -= motion[axis, row] * work[7, row]


@njit(**OPTIONS)
def _fit(
    now: FloatArray,
    rest: FloatArray,
    weights: FloatArray,
    states: IntArray,
    work: FloatArray,
    motion: FloatArray,
) -> None:
    """The weighted rigid motion of those that count, three or more that are not on one line."""
    _centres(now, rest, weights, states, work)
    products = motion  # its first rows are free until the rotation is there: sum of w rest now'
    for row in range(3):
        for column in range(3):
            total = 0.0
            for i in range(now.shape[0]):
                if states[i] == _OK:
                    total += weights[i] * (rest[i, row] - work[7, row]) * (now[i, column] - work[6, column])
            products[row, column] = total
    xx, xy, xz = products[0, 0], products[0, 1], products[0, 2]
    yx, yy, yz = products[1, 0], products[1, 1], products[1, 2]
    zx, zy, zz = products[2, 0], products[2, 1], products[2, 2]
    matrix = work[:4]
    matrix[0, 0], matrix[1, 1] = xx + yy + zz, xx - yy - zz
    matrix[2, 2], matrix[3, 3] = yy - xx - zz, zz - xx - yy
    matrix[0, 1], matrix[0, 2], matrix[0, 3] = yz - zy, zx - xz, xy - yx
    matrix[1, 2], matrix[1, 3], matrix[2, 3] = xy + yx, zx + xz, yz + zy
    _largest_eigenvector(work)
    _rotation_of(work[4], motion)
    _place(now, rest, weights, states, work, motion)


@njit(**OPTIONS)
def _largest_eigenvector(work: FloatArray) -> None:
    """Of the symmetric matrix of trace 0 whose upper triangle is work[:4], into work[4].

    Shifted, so that no eigenvalue is negative, and brought to trace 1, the matrix is squared until the largest
    eigenvalue has outgrown the others: its columns then are multiples of the eigenvector. The error is that of the
    first squarings, about the rounding over the gap to the next eigenvalue, as with any other method.
    """
    matrix, square = work[:4], work[8:12]
    size = 0.0
    for i in range(4):
        for j in range(i):
            matrix[i, j] = matrix[j, i]
            size += 2.0 * matrix[i, j] ** 2
        size += matrix[i, i] ** 2
    shift = np.sqrt(0.75 * size)  # of four eigenvalues whose sum is 0 none is larger
    scale = 0.25 / shift if shift > 0.0 else 0.0
    for i in range(4):
        for j in range(4):
            matrix[i, j] *= scale
        matrix[i, i] += 0.25
    for _ in range(MOST_SQUARINGS):
        trace = 0.0
        for i in range(4):
            for j in range(i + 1):
                total = 0.0
                for inner in range(4):
                    total += matrix[i, inner] * matrix[j, inner]
                square[i, j] = total
            trace += square[i, i]
        for i in range(4):
            for j in range(i + 1):
                matrix[i, j] = square[i, j] / trace
                matrix[j, i] = matrix[i, j]
        if trace > 1.0 - 1e-10:  # 1 less twice the share of the others, which this squaring has squared
            break
    largest = 0
    for i in range(1, 4):
        if matrix[i, i] > matrix[largest, largest]:
            largest = i
    work[4] = matrix[largest]


@njit(**OPTIONS)
def _rotation_of(quaternion: FloatArray, motion: FloatArray) -> bool:
    """motion[:3] the rotation of a quaternion (w, x, y, z) of any length; False where it has none."""
    length = 0.0
    for i in range(4):
        length += quaternion[i] ** 2
    if not 0.0 < length < np.inf:
        return False
    scale = 2.0 / length
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    motion[0, 0] = 1.0 - scale * (y * y + z * z)
    motion[0, 1] = scale * (x * y - w * z)
    motion[0, 2] = scale * (x * z + w * y)
    motion[1, 0] = scale * (x * y + w * z)
    motion[1, 1] = 1.0 - scale * (x * x + z * z)
    motion[1, 2] = scale * (y * z - w * x)
    motion[2, 0] = scale * (x * z - w * y)
    motion[2, 1] = scale * (y * z + w * x)
    motion[2, 2] = 1.0 - scale * (x * x + y * y)
    return True


@njit(**OPTIONS)
def _turn_by_quaternion(
    quaternions: FloatArray,
    rest_quaternions: FloatArray,
    states: IntArray,
    work: FloatArray,
    motion: FloatArray,
) -> bool:
    """The motion's rotation from the first 6-D coil that counts; False without one."""
    for i in range(states.shape[0]):
        w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        a, b = rest_quaternions[i, 0], -rest_quaternions[i, 1]
        c, d = -rest_quaternions[i, 2], -rest_quaternions[i, 3]
        work[4, 0] = w * a - x * b - y * c - z * d
        work[4, 1] = w * b + x * a + y * d - z * c
        work[4, 2] = w * c - x * d + y * a + z * b
        work[4, 3] = w * d + x * c - y * b + z * a
        if states[i] == _OK and _rotation_of(work[4], motion):
            return True
    return False


@njit(**OPTIONS)
def _turn_axis(now: FloatArray, rest: FloatArray, work: FloatArray, motion: FloatArray) -> None:
    """Turns the motion by the least that brings the axis through the two of work[0, :2] to where it is now."""
    first, last = int(work[0, 0]), int(work[0, 1])
    ahead = aside = 0.0
    for axis in range(3):
        work[1, axis] = now[last, axis] - now[first, axis]
        work[2, axis] = 0.0
        for row in range(3):
            work[2, axis] += motion[axis, row] * (rest[last, row] - rest[first, row])
        ahead += work[1, axis] ** 2
        aside += work[2, axis] ** 2
    along = 0.0
    for axis in range(3):
        work[1, axis] /= np.sqrt(ahead)
        work[2, axis] /= np.sqrt(aside)
        along += work[1, axis] * work[2, axis]
    # The quaternion halfway from the old direction to the new one; opposite directions leave the axis as it is.
    work[4, 0] = 1.0 + along
    work[4, 1] = work[2, 1] * work[1, 2] - work[2, 2] * work[1, 1]
    work[4, 2] = work[2, 2] * work[1, 0] - work[2, 0] * work[1, 2]
    work[4, 3] = work[2, 0] * work[1, 1] - work[2, 1] * work[1, 0]
    for row in range(3):
        for column in range(3):
            work[8 + row, column] = motion[row, column]
    if _rotation_of(work[4], motion):
        for row in range(3):
            for column in range(3):
                work[5, column] = 0.0
                for inner in range(3):
                    work[5, column] += motion[row, inner] * work[8 + inner, column]
            for column in range(3):
                motion[row, column] = work[5, column]
