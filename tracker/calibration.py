"""From recordings of one speaker to the session that places this speaker in the model, with every decision as a sentence.

Paper, section "Data selection and setup for experiments": bite plane and palate of the subject align the data to the
model. The order here: coils, smoothing, the head's motion, axes (or the bite plane), the mid-sagittal plane, the palate,
then the fit to the model (`registration`), which starts from what these say and knows how far they may be wrong. All
of it is composed into one rigid alignment. Then the recordings are tracked with the session that would be written, so the
numbers are those that its user gets.

Frames of reference: the source's own -> (head correction) the source's with the head at rest -> (base) the model's
directions -> (fit) the model's frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from .. import InputError
from ..drivers.files.common import UNITS_MM
from ..drivers.frames import FrameOfReference, Recording
from ..model.midsagittal import midsagittal_vertices
from ..model.multilinear import TongueModel
from .coilmap import LATERAL_ROLES, TONGUE_PREFIX, CoilMap, checked_coil_map, guess_coil_map
from .headcorrection import (
    HeadMotion,
    HeadReference,
    HeadStatus,
    ReferenceState,
    head_jump,
    head_motion,
    rest_reference,
)
from .occlusal import BITE_ROLES, OcclusalFrame, check_same_head, occlusal_frame
from .palate import MODEL_FRAME, Palate, check_above_tongue, read_palate
from .pose import FloatArray, TrackedPoses
from .registration import USUAL_PLACES_MM, FirstGuess, Registration, fit_alignment, handedness
from .sagittal import MidSagittalPlane, PlaneUnclear, directions, mid_sagittal_plane
from .sagittal import handedness as handedness_of_axes
from .session import Alignment, Session, parse_session, session_toml
from .setup import jump_sentence, preparation_of
from .smoothing import NO_SMOOTHING, Smoothing
from .status import MISPLACED_MM
from .tracking import TrackingRun, track_recording

HEAD_PREFIX = "head_"
PALATE_PROBE = "palate_probe"
LEAST_REFERENCES = 3
LEAST_REST_FRAMES = 10
LEAST_COILS_OF_PLANE = 2  # in the middle; the path of one shows how it moves, not where the middle is
MIDDLE_ROLES = (
    "jaw",
    "upper_lip",
    "lower_lip",
)  # sit in the mid-sagittal plane, as the tongue's middle coils do
# How far each first guess may be wrong: mm at the tongue, degrees.
BITE_PLANE_SD = (3.0, 4.0)
INCISORS_BY_CONVENTION_SD = (4.0, 5.0)
INCISOR_COIL_SD = (5.0, 8.0)
AXES_ALONE_SD = (20.0, 10.0)
INCISOR_COIL_MM = (0.0, -2.0, 4.0)  # of the coil on the gum above the upper incisors, in the model's frame
FAR_FROM_MOUTH_MM = 40.0  # a tongue so far from where it lies in a model belongs to another bite plane
PALATE_ALLOWED_MM = 1.0
NEVER_MOVED_MM = 0.05
TONGUE_LENGTH_MM = (6.0, 110.0)  # between the two coils that are farthest apart
ON_THEIR_SIDE = 0.5  # cosine: coils at the ears, from right to left, against the stated left
PALATE_ASIDE_MM = 5.0
LEAST_WITHIN_3_SIGMA = 0.8  # share of frames; with fewer, the model is bent into something that is no tongue
LITTLE_MOVEMENT_MM = 2.0  # standard deviation of tongue coils; speech has 4 and more
EXPERIMENTS = (1, 2)
# Channel names on a bite plate, lower case, separators removed.
_BITE_NAMES = {
    "bite_front": {"bitefront", "bpf", "bpfront", "os", "front"},
    "bite_left": {"biteleft", "bpl", "bpleft"},
    "bite_right": {"biteright", "bpr", "bpright"},
    "bite_back": {"biteback", "bpb", "bpback", "ms"},
}


@dataclass(frozen=True)
class Sources:
    """What there is beside the recordings, each as it was opened; None = there is none.

    rest_s: (start, end) in seconds from the first recording's beginning; rest: another recording; bite_plane: a
    recording; palate: a file (a trace states less than a recording, so it is read when its frame is known).
    """

    rest_s: tuple[float, float] | None = None
    rest: Recording | None = None
    bite_plane: Recording | None = None
    palate: Path | None = None


@dataclass(frozen=True)
class Figures:
    """What a phonetician can judge a tracked experiment by.

    frames: tracked ones; residuals in mm, over coils and frames; shares of the tracked frames from 0 to 1.
    within_3_sigma: all weights that were free. above_palate: share of the frames whose mid-sagittal contour is
    more than PALATE_ALLOWED_MM above the palate somewhere; highest_mm: 99 % of the frames stay below that. NaN without a
    palate.
    """

    frames: int
    residual_mean_mm: float
    residual_median_mm: float
    below_1_25_mm: float
    below_1_5_mm: float
    within_3_sigma: float
    by_coil_mm: Mapping[str, float]
    above_palate: float
    highest_mm: float

    def __str__(self) -> str:
        coils = ", ".join(f"{role} {value:.2f}" for role, value in self.by_coil_mm.items())
        told = (
            f"{self.frames} frames, residual mean {self.residual_mean_mm:.2f}, median {self.residual_median_mm:.2f} mm "
            f"({coils}); {100 * self.below_1_25_mm:.0f} % below 1.25 mm, {100 * self.below_1_5_mm:.0f} % below 1.5 mm; "
            f"weights within 3 sigma in {100 * self.within_3_sigma:.1f} %"
        )
        if np.isfinite(self.above_palate):
            told += (
                f"; contour more than {PALATE_ALLOWED_MM:g} mm above the palate in {100 * self.above_palate:.1f} % "
                f"(99 % stay below {self.highest_mm:+.1f} mm)"
            )
        return told


@dataclass(frozen=True)
class Calibration:
    """The session, why it is as it is, and what comes of it.

    decisions: sentences in the order of the work. base_rotation (3, 3), base_translation_mm (3,): from the source's
    frame, head at rest, to the first guess in the model's directions; guess: how far that may be wrong; registration: the fit
    from there. before, after: experiment -> figures, with the base alone (first recording) and with the session. poses: of
    each recording, experiment -> what was tracked with the session. heights: experiment -> (tracked frames of all
    recordings,) mm of the contour above the palate. coils_mm: (frames, n, 3) tongue coils of all recordings in the source's
    frame, smoothed, head at rest.
    """

    session: Session
    decisions: tuple[str, ...]
    base_rotation: FloatArray
    base_translation_mm: FloatArray
    guess: FirstGuess
    registration: Registration
    before: Mapping[int, Figures]
    after: Mapping[int, Figures]
    poses: tuple[Mapping[int, TrackedPoses], ...]
    heights: Mapping[int, FloatArray]
    coils_mm: FloatArray
    roles: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for programs."""
        fit = self.registration
        return {
            "decisions": list(self.decisions),
            "first_guess": {
                "rotation": self.base_rotation.tolist(),
                "translation_mm": self.base_translation_mm.tolist(),
                "source": self.guess.source,
            },
            "rotation": self.session.alignment.rotation.tolist(),
            "translation_mm": self.session.alignment.translation_mm.tolist(),
            "sure": fit.sure.tolist(),
            "noise_mm": fit.noise_mm,
            "correspondences": dict(self.session.correspondences),
            "before": {f"experiment_{which}": _plain(one) for which, one in self.before.items()},
            "after": {f"experiment_{which}": _plain(one) for which, one in self.after.items()},
        }


def _plain(figures: Figures) -> dict[str, Any]:
    values = {name: getattr(figures, name) for name in Figures.__dataclass_fields__}
    values["by_coil_mm"] = dict(figures.by_coil_mm)
    if np.isnan(figures.above_palate):
        values |= {"above_palate": None, "highest_mm": None}
    return values


def calibrate(
    recordings: Sequence[Recording],
    model: TongueModel,
    sources: Sources = Sources(),
    coils: Mapping[str, str] | None = None,
    frame: FrameOfReference | None = None,
    smoothing: Smoothing = NO_SMOOTHING,
) -> Calibration:
    """The session of one speaker from recordings in one placement of coils and head references.

    recordings: of one device, with the same channels and axes; the first gives the rest interval. coils: channel ->
    role, of all files (None: by the names); frame: the axes of all files, where they do not state them or state them
    wrongly. Deterministic. Raises InputError where the files contradict each other, or leave open what is needed.
    """
    first = recordings[0]
    _check_alike(recordings)
    told = list(dict.fromkeys(note for one in recordings for note in one.notes))
    coil_map, others = _coil_map(first, coils, told)
    axes = _axes(first, frame, told)
    told.append(f"smoothing: {_smoothing_words(smoothing)}")
    _check_unit(first, list(coil_map.tongue))
    session = Session(coils=coil_map.roles, smoothing=smoothing, source="calibration")
    session = replace(session, head=_head_reference(first, session, sources, told))
    for recording in recordings:
        if session.head is not None:
            told.extend(_head_sentences(recording, session, _motion(recording, session, session.head)))

    roles = tuple(coil_map.tongue.values())
    still = np.concatenate([_still(one, list(coil_map.tongue), roles, session) for one in recordings])
    if not np.isfinite(still).all(axis=(1, 2)).any():
        raise InputError(
            f"{first.source}: no frame has all tongue coils ({', '.join(coil_map.tongue)}); leave out the one without "
            "data with --coils."
        )
    moving = float(np.nanmean(np.nanstd(still, axis=0)) * np.sqrt(3.0))
    if moving < LITTLE_MOVEMENT_MM:
        told.append(
            f"note: the tongue coils move by only {moving:.1f} mm (standard deviation), so they say little about alignment "
            "and anatomy; take a recording of varied speech"
        )
    base = _base(recordings, session, axes, sources, others, still, roles, told)
    two_dimensional = axes is not None and "absent" in (axes.x, axes.y, axes.z)
    if two_dimensional:
        told.append("mid-sagittal plane: the data are two-dimensional; nothing to level")
    else:
        base = _levelled(recordings, session, base, told)
    placed = still @ base.rotation.T + base.translation_mm
    if sources.palate is not None:
        probe = next((channel for channel, role in others.items() if role == PALATE_PROBE), None)
        place = Alignment(base.rotation, base.translation_mm)
        palate = placed_palate(sources.palate, first, session, axes, place, placed, probe, told)
    else:
        palate = None
        told.append("palate: no file; nothing bounds the tongue from above")

    midsagittal = not any(role in LATERAL_ROLES for role in roles)
    here = FirstGuess(np.eye(3), np.zeros(3), base.sd[0], base.sd[1], base.source)
    told.append(f"axes: {handedness(model, placed, roles, here, session.energy)}")
    fit = fit_alignment(model, placed, roles, here, session.energy, palate, midsagittal)
    told.extend(fit.sentences)
    more = f" and {len(recordings) - 1} more" if len(recordings) > 1 else ""
    seen = f"{len(still)} frames of {first.source}{more}"
    session = _whole_session(session, model, seen, base, fit, palate, midsagittal)
    session = parse_session(session_toml(session), session.source)  # what its user will have

    poses = tuple(_tracked(one, model, session) for one in recordings)
    unfitted = replace(
        session,
        alignment=Alignment(base.rotation, base.translation_mm, midsagittal),
        correspondences={},
        speaker_weights=None,
    )
    before_fit = _tracked(first, model, unfitted)
    moved_palate = session.palate
    heights = {which: _heights([run[which] for run in poses], model, moved_palate) for which in EXPERIMENTS}
    before = {
        which: figures([before_fit[which]], model, _heights([before_fit[which]], model, palate))
        for which in EXPERIMENTS
    }
    after = {which: figures([run[which] for run in poses], model, heights[which]) for which in EXPERIMENTS}
    for which in EXPERIMENTS:
        told.append(f"experiment {which} before the fit ({base.source}; {first.source}): {before[which]}")
        told.append(f"experiment {which} with this session: {after[which]}")
    told.extend(filter(None, [_doubt(after[2])]))
    return Calibration(
        session, tuple(told), base.rotation, base.translation_mm, here, fit, before, after, poses, heights, still, roles,
    )  # fmt: skip


def _doubt(found: Figures) -> str:
    """What in experiment 2 says that the session is not to be believed; empty where nothing does."""
    if found.residual_mean_mm > MISPLACED_MM:
        return (
            f"warning: the coils stay {found.residual_mean_mm:.1f} mm away from the model: the axes, the unit or the "
            "coils' roles are wrong, and the session is of no use"
        )
    if found.within_3_sigma < LEAST_WITHIN_3_SIGMA:
        return (
            f"warning: in {100 * (1.0 - found.within_3_sigma):.0f} % of the frames a weight is beyond 3 sigma: the model "
            "is bent to reach the coils; check the axes and the coils' roles before the session is used"
        )
    return ""


# Files and coils ------------------------------------------------------------------------------------


def _check_alike(recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for one in recordings[1:]:
        same_axes = (one.frame.x, one.frame.y, one.frame.z) == (first.frame.x, first.frame.y, first.frame.z)
        if one.coils != first.coils or not same_axes:
            raise InputError(
                f"{one.source}: its channels or axes are not those of {first.source}; recordings that are calibrated "
                "together come from one session with one device."
            )


def _coil_map(
    recording: Recording, coils: Mapping[str, str] | None, told: list[str]
) -> tuple[CoilMap, dict[str, str]]:
    """The recording's coil map, and the roles of channels that only other files have to have."""
    if coils is None:
        coil_map = guess_coil_map(recording.coils, recording.positions, recording.source)
        elsewhere: dict[str, str] = {}
    else:
        elsewhere = {channel: role for channel, role in coils.items() if role in (*BITE_ROLES, PALATE_PROBE)}
        here = {channel: role for channel, role in coils.items() if channel not in elsewhere}
        for channel in here:
            if channel not in recording.coils:
                raise InputError(
                    f"--coils names the channel '{channel}', which {recording.source} does not have; its channels are "
                    f"{', '.join(recording.coils)}."
                )
        coil_map = checked_coil_map(here, "--coils")
    named = ", ".join(f"{channel} = {role}" for channel, role in {**coil_map.roles, **elsewhere}.items())
    told.append(f"coils ({coil_map.why}): {named}")
    return coil_map, elsewhere


def _check_unit(recording: Recording, channels: Sequence[str]) -> None:
    """Whether the tongue coils are as far apart as on a tongue."""
    paths = [recording.positions[:, recording.coils.index(channel)] for channel in channels]
    apart = {}
    for one, other in combinations(range(len(channels)), 2):
        distances = np.linalg.norm(paths[one] - paths[other], axis=1)
        if np.isfinite(distances).any():
            apart[one, other] = float(np.nanmedian(distances))
    if not apart:
        return
    one, other = max(apart, key=lambda pair: apart[pair])
    longest = apart[one, other]
    if not TONGUE_LENGTH_MM[0] <= longest <= TONGUE_LENGTH_MM[1]:
        raise InputError(
            f"{recording.source}: the tongue coils {channels[one]} and {channels[other]} are {longest:.1f} mm apart, which "
            f"on one tongue is between {TONGUE_LENGTH_MM[0]:.0f} and {TONGUE_LENGTH_MM[1]:.0f}; check the unit (--unit) and "
            "the roles."
        )


def _axes(recording: Recording, frame: FrameOfReference | None, told: list[str]) -> FrameOfReference | None:
    """The axes of the files; None where nobody states them."""
    stated = recording.frame
    known = "unknown" not in (stated.x, stated.y, stated.z)
    if frame is None:
        if not known:
            return None
        told.append(f"axes (the file's): {stated}, {_handedness_words(stated, recording.source)}")
        return stated
    # A stated origin stays one however the axes are named.
    axes = replace(frame, origin=stated.origin)
    against = ""
    if known and (stated.x, stated.y, stated.z) != (frame.x, frame.y, frame.z):
        against = f"; the file says {stated}, which is not used"
    told.append(
        f"axes (--frame): x {frame.x}, y {frame.y}, z {frame.z}, "
        f"{_handedness_words(frame, '--frame')}{against}"
    )
    return axes


def _handedness_words(frame: FrameOfReference, source: str) -> str:
    if "absent" in (frame.x, frame.y, frame.z):
        return "two-dimensional, so neither right- nor left-handed"
    return handedness_of_axes(directions(frame, source))


def _smoothing_words(smoothing: Smoothing) -> str:
    if smoothing == NO_SMOOTHING:
        return "none (--smoothing names a preset; the raw data are kept anyway)"
    filters = ", ".join(f"{role} {chosen}" for role, chosen in smoothing.recorded.items())
    return f"{smoothing.preset} ({filters})"


def _still(
    recording: Recording, channels: Sequence[str], roles: Sequence[str], session: Session
) -> FloatArray:
    """(frames, n, 3) of these channels, smoothed and with the head at rest, in the source's frame.

    NaN where fewer than three references say where the head is: what is carried on there is good enough to track, but
    not to place a speaker by. Raises InputError where that is every frame.
    """
    preparation = preparation_of(recording.coils, channels, roles, session, recording.rate_hz)
    still = preparation.all_frames(recording.positions, recording.rate_hz, recording.quaternions)
    if session.head is not None:
        known = _motion(recording, session, session.head).statuses == HeadStatus.OK
        if not known.any():
            raise InputError(
                f"{recording.source}: in no frame three of the reference coils ({', '.join(session.head.roles)}) are where "
                f"{session.head.source} has them to each other, so it is not known where the head is; leave out the "
                "coil that failed with --coils, or take another recording."
            )
        still[~known] = np.nan
    return still


# The head -------------------------------------------------------------------------------------------


def _head_reference(
    recording: Recording, session: Session, sources: Sources, told: list[str]
) -> HeadReference | None:
    channels = _references(session)
    asked = sources.rest_s is not None or sources.rest is not None
    if len(channels) < LEAST_REFERENCES:
        named = ", ".join(channels.values()) or "none"
        if asked:
            raise InputError(
                f"{recording.source}: a rest interval is given, but only {len(channels)} of at least {LEAST_REFERENCES} "
                f"reference coils ({named}); give head_nose, head_left and head_right to channels "
                "with --coils, or leave the interval out."
            )
        told.append(
            f"head: fewer than {LEAST_REFERENCES} reference coils ({named}); the recording is taken as corrected already"
        )
        return None
    unsmoothed_head = replace(session, head=None)
    if sources.rest is not None:
        _check_has(sources.rest, channels, recording)
        positions = _still(sources.rest, list(channels), list(channels.values()), unsmoothed_head)
        source = sources.rest.source
    else:
        positions = _still(recording, list(channels), list(channels.values()), unsmoothed_head)
        source = f"the whole of {recording.source}"
        if sources.rest_s is not None:
            start, end = sources.rest_s
            if not 0.0 <= start < end <= recording.duration_s + 1e-9:
                raise InputError(
                    f"--rest {start:g}:{end:g}: {recording.source} goes from 0 to {recording.duration_s:g} s; the interval "
                    "is outside it, or ends before it starts."
                )
            times = recording.times_s - recording.times_s[0]
            positions = positions[(times >= start) & (times < end)]
            source = f"{start:g} to {end:g} s of {recording.source}"
            if len(positions) < LEAST_REST_FRAMES:
                raise InputError(
                    f"--rest {start:g}:{end:g}: these are {len(positions)} frames of {recording.source}; at least "
                    f"{LEAST_REST_FRAMES} are needed to say where the head rests, so make the interval longer."
                )
    reference = rest_reference(positions, tuple(channels.values()), source)
    if sources.rest is not None:
        moving = {
            role: recording.positions[:, recording.coils.index(channel)] for channel, role in channels.items()
        }
        at_rest = dict(zip(reference.roles, reference.positions_mm, strict=True))
        check_same_head(moving, at_rest, recording.source, source)
    told.append(
        f"head (reference {', '.join(reference.roles)} at rest: {source}): distances between them are steady to "
        f"{reference.noise_mm:.2f} mm"
    )
    return reference


def _references(session: Session) -> dict[str, str]:
    return {channel: role for channel, role in session.coils.items() if role.startswith(HEAD_PREFIX)}


def _check_has(other: Recording, channels: Mapping[str, str], recording: Recording) -> None:
    for channel, role in channels.items():
        if channel not in other.coils:
            raise InputError(
                f"{other.source}: it lacks the channel '{channel}', which is the reference coil {role} of "
                f"{recording.source}, so its head's place is not known; its channels are {', '.join(other.coils)}."
            )


def _motion(recording: Recording, session: Session, reference: HeadReference) -> HeadMotion:
    channels = _references(session)
    positions = _still(recording, list(channels), list(channels.values()), replace(session, head=None))
    return head_motion(positions, reference, recording.rate_hz)


def _head_sentences(recording: Recording, session: Session, motion: HeadMotion) -> list[str]:
    known = np.isfinite(motion.translations).all(axis=1)
    if not known.any():
        return []  # `_still` refuses such a recording
    assert session.head is not None
    centre = session.head.positions_mm.mean(axis=0)
    moved = motion.rotations[known] @ centre + motion.translations[known] - centre
    traces = np.trace(motion.rotations[known], axis1=1, axis2=2)
    turned = np.degrees(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))
    way = float(np.quantile(np.linalg.norm(moved, axis=1), 0.99))
    still = "; it was corrected already" if way < NEVER_MOVED_MM else ""
    rigid = float(np.nanmean(motion.residuals_mm))
    words = (
        f"head of {recording.source}: up to {way:.1f} mm and {float(np.quantile(turned, 0.99)):.1f} degrees from rest (99 %), "
        f"references {rigid:.2f} mm from a rigid head{still}"
    )
    told = [words]
    times = recording.times_s - recording.times_s[0]
    sure = motion.statuses == HeadStatus.OK
    if not sure.all():
        told.append(
            f"head of {recording.source}: in {100 * np.mean(~sure):.1f} % of the frames fewer than three references count; "
            "these are left out of the calibration"
        )
    jump = head_jump(motion, session.head)
    if jump is not None:
        told.append(jump_sentence(recording, *jump))
    for index, role in enumerate(session.head.roles):
        states = motion.states[:, index]
        slipped = np.flatnonzero(states == ReferenceState.SLIPPED)
        if len(slipped):
            told.append(
                f"note: reference {role} slipped in {recording.source}, first at {times[slipped[0]]:.2f} s and last at "
                f"{times[slipped[-1]]:.2f} s, {100 * len(slipped) / len(states):.1f} % of the frames; it was left out there"
            )
        missing = float(np.mean(states == ReferenceState.MISSING))
        if missing > 0.0:
            told.append(
                f"reference {role} is missing in {100 * missing:.1f} % of the frames of {recording.source}"
            )
    return told


# From the source's frame to the model's directions --------------------------------------------------


@dataclass(frozen=True)
class _Base:
    """model's directions = rotation @ source + translation_mm; sd: how far it may be wrong, mm and degrees."""

    rotation: FloatArray
    translation_mm: FloatArray
    sd: tuple[float, float]
    source: str


def _base(
    recordings: Sequence[Recording],
    session: Session,
    axes: FrameOfReference | None,
    sources: Sources,
    others: Mapping[str, str],
    still: FloatArray,
    roles: Sequence[str],
    told: list[str],
) -> _Base:
    first = recordings[0]
    middle = np.nanmedian(still, axis=(0, 1))
    usual = _usual_middle(roles)
    if sources.bite_plane is not None:
        occlusal = _occlusal(sources.bite_plane, first, session, axes, others, told)
        away = float(np.linalg.norm((occlusal.rotation @ middle + occlusal.translation - usual)[1:]))
        if away > FAR_FROM_MOUTH_MM:
            raise InputError(
                f"{sources.bite_plane.source}: the tongue coils of {first.source} lie {away:.0f} mm from where a tongue is "
                "behind and below the upper incisors of this bite plane; the two files are of different speakers, or the "
                "head's motion is still in one of them."
            )
        return _Base(occlusal.rotation, occlusal.translation, BITE_PLANE_SD, f"bite plane {occlusal.source}")
    if axes is None:
        raise InputError(
            f"{first.source}: it does not state how its axes lie to the head; say where x, y and z grow, as in "
            '--frame "front left up", or give a bite plane with --bite-plane.'
        )
    rotation = directions(axes, first.source)
    if "absent" not in (axes.x, axes.y, axes.z):
        _check_sides(first, session, axes, rotation)
    if "upper incisors" in axes.origin:
        told.append(f"origin: {axes.origin} (the file's)")
        return _Base(rotation, np.zeros(3), INCISORS_BY_CONVENTION_SD, f"axes and origin of {first.source}")
    channels = {role: channel for channel, role in session.coils.items()}
    if "head_upper_incisor" in channels:
        incisor = _still(first, [channels["head_upper_incisor"]], ["head_upper_incisor"], session)[:, 0]
        if np.isfinite(incisor).all(axis=1).any():
            translation = np.array(INCISOR_COIL_MM) - rotation @ np.nanmedian(incisor, axis=0)
            told.append(
                f"origin: from the coil head_upper_incisor of {first.source}, taken to be {INCISOR_COIL_MM[2]:g} mm above "
                "the edge of the upper incisors"
            )
            return _Base(rotation, translation, INCISOR_COIL_SD, "axes and the upper incisor's coil")
    told.append(
        "origin: not known; the tongue coils are put where such coils usually are, and the fit decides (a bite plane, or a "
        "coil with the role head_upper_incisor, says more)"
    )
    return _Base(rotation, usual - rotation @ middle, AXES_ALONE_SD, f"axes of {first.source} alone")


def _check_sides(
    recording: Recording, session: Session, axes: FrameOfReference, rotation: FloatArray
) -> None:
    """Whether the head's references are where their names and the axes say (a bite plane has its own check)."""
    places = {role: rotation @ place for role, place in _rest_places(recording, session).items()}
    wrong = ""
    if {"head_left", "head_right"} <= set(places):
        across = places["head_left"] - places["head_right"]
        middle = 0.5 * (places["head_left"] + places["head_right"])
        if across[0] < ON_THEIR_SIDE * np.linalg.norm(across):
            wrong = "head_left is not to the left of head_right"
        elif "head_nose" in places and places["head_nose"][1] > middle[1]:
            wrong = "head_nose is behind head_left and head_right"
    middle_coils = {"head_nose", "head_upper_incisor"} <= set(places)
    if middle_coils and places["head_nose"][2] < places["head_upper_incisor"][2]:
        wrong = wrong or "head_nose is below head_upper_incisor"
    if wrong:
        raise InputError(
            f"{recording.source}: with its axes (x {axes.x}, y {axes.y}, z {axes.z}), {wrong}; the axes are others, which "
            "--frame can state, or two coils have each other's role."
        )


def _usual_middle(roles: Sequence[str]) -> FloatArray:
    """(3,) where the middle of such coils is, mm in the model's frame: behind the incisors, below the palate."""
    places = [USUAL_PLACES_MM[role] for role in roles if role in USUAL_PLACES_MM]
    return np.array([0.0, float(np.mean(places)) if places else 30.0, -5.0])


def _occlusal(
    bite: Recording,
    recording: Recording,
    session: Session,
    axes: FrameOfReference | None,
    others: Mapping[str, str],
    told: list[str],
) -> OcclusalFrame:
    _check_axes(bite, recording)
    plate = {channel: role for channel, role in others.items() if role in BITE_ROLES}
    if not plate:
        simple = {channel: re.sub(r"[^a-z0-9]", "", channel.lower()) for channel in bite.coils}
        plate = {
            channel: role
            for role, names in _BITE_NAMES.items()
            for channel in bite.coils
            if simple[channel] in names
        }
    for channel in plate:
        if channel not in bite.coils:
            raise InputError(
                f"{bite.source}: it lacks the channel '{channel}', which is {plate[channel]}; its channels are "
                f"{', '.join(bite.coils)}."
            )
    if not plate:
        raise InputError(
            f"{bite.source}: no channel's name says that it is on the bite plate ({', '.join(bite.coils)}); name them "
            "with --coils CHANNEL=bite_front,CHANNEL=bite_left,CHANNEL=bite_right, beside the recording's own."
        )
    references = _references(session)
    if session.head is not None:
        _check_has(bite, references, recording)
    there = {channel: role for channel, role in references.items() if channel in bite.coils}
    raw = {
        role: bite.positions[:, bite.coils.index(channel)]
        for channel, role in there.items()
        if np.isfinite(bite.positions[:, bite.coils.index(channel)]).any()
    }
    rest = _rest_places(recording, session)
    differ = check_same_head(raw, rest, bite.source, recording.source)
    still = _still(bite, [*plate, *there], [*plate.values(), *there.values()], session)
    paths = dict(zip([*plate.values(), *there.values()], np.moveaxis(still, 1, 0), strict=True))
    occlusal = occlusal_frame(
        {role: paths[role] for role in plate.values()},
        axes if axes is not None else FrameOfReference(),
        bite.source,
        {role: paths[role] for role in raw},
        directions(axes, recording.source)[0] if axes is not None else None,
    )
    told.append(f"bite plane: {occlusal}")
    told.extend(f"bite plane: {note}" for note in occlusal.notes)
    if len(raw) > 1:
        told.append(
            f"bite plane: the distances between references differ from those of {recording.source} by {differ:.1f} mm "
            "at most, so it is the same head"
        )
    return occlusal


def _rest_places(recording: Recording, session: Session) -> dict[str, FloatArray]:
    """role -> (3,) mm of the references: those at rest, else their medians, whose distances are nearly the same."""
    if session.head is not None:
        return dict(zip(session.head.roles, session.head.positions_mm, strict=True))
    found = {}
    for channel, role in _references(session).items():
        path = recording.positions[:, recording.coils.index(channel)]
        if np.isfinite(path).all(axis=1).any():
            found[role] = np.asarray(np.nanmedian(path, axis=0))
    return found


def _check_axes(other: Recording, recording: Recording) -> None:
    """Two files of one session have the same axes, as far as they state any."""
    here, there = ((one.frame.x, one.frame.y, one.frame.z) for one in (recording, other))
    if here != there and "unknown" not in (*here, *there):
        raise InputError(
            f"{other.source}: its axes are x {there[0]}, y {there[1]}, z {there[2]}, but those of {recording.source} are "
            f"x {here[0]}, y {here[1]}, z {here[2]}; files of one session have the same axes."
        )


def _levelled(recordings: Sequence[Recording], session: Session, base: _Base, told: list[str]) -> _Base:
    """The base, turned so that the mid-sagittal coils move in x = 0, where their plane is surely another."""
    middle = {
        channel: role
        for channel, role in session.coils.items()
        if role in MIDDLE_ROLES or (role.startswith("tongue_") and role not in LATERAL_ROLES)
    }
    paths = np.concatenate([_still(one, list(middle), list(middle.values()), session) for one in recordings])
    source = recordings[0].source
    if len(middle) < LEAST_COILS_OF_PLANE:
        told.append(
            f"mid-sagittal plane: as the axes have it ({', '.join(middle.values()) or 'no coil'} alone in the middle says "
            f"nothing of how the plane lies; at least {LEAST_COILS_OF_PLANE} coils do)"
        )
        return base
    try:
        plane: MidSagittalPlane = mid_sagittal_plane(paths, base.rotation[0], source)
    except PlaneUnclear as reason:
        told.append(f"mid-sagittal plane: as the axes have it ({reason})")
        return base
    offsets = ", ".join(
        f"{role} {value:+.1f}" for role, value in zip(middle.values(), plane.offsets_mm, strict=True)
    )
    what = f"mid-sagittal plane of {', '.join(middle.values())}: {plane}; to the left of it, mm: {offsets}"
    if plane.tilt_deg <= plane.unsure_deg:
        told.append(f"{what}; not surely another than the axes have it, which are kept")
        return base
    rotation, across = plane.levelling(base.rotation)
    translation = rotation @ base.rotation.T @ base.translation_mm
    told.append(f"{what}; levelled")
    return replace(
        base, rotation=rotation, translation_mm=np.array([across[0], *translation[1:]]),
        source=f"{base.source}, levelled by {plane.tilt_deg:.1f} degrees",
    )  # fmt: skip


# The palate -----------------------------------------------------------------------------------------


def palate_of_session(path: Path, recording: Recording, run: TrackingRun) -> tuple[Session, list[str]]:
    """The session of a tracked recording with the palate of this file in it, and what is to be told about it.

    The palate, in the recording's axes, is brought along by the session's alignment. Raises InputError where these axes
    are not known, where the alignment turns them otherwise, and where palate and tongue contradict each other.
    """
    session = run.setup.session
    frame, place = recording.frame, session.alignment
    if "unknown" in (frame.x, frame.y, frame.z):
        raise InputError(
            f"{path}: a palate has the axes of its recording, and {recording.source} does not state them; "
            "'tonguetrack calibrate' takes them with --frame, and the palate with --palate."
        )
    turned = place.rotation @ directions(frame, recording.source).T
    if turned[1, 1] <= 0 or turned[2, 2] <= 0:
        raise InputError(
            f"{path}: {recording.source} says that its axes are x {frame.x}, y {frame.y}, z {frame.z}, which the "
            f"[alignment] of {session.source} does not turn into the model's; correct it (axes = ...), or calibrate."
        )
    poses = run.experiment_2 or run.experiment_1
    assert poses is not None
    probe = next((channel for channel, role in session.coils.items() if role == PALATE_PROBE), None)
    told: list[str] = []
    still = replace(session, alignment=Alignment())
    palate = placed_palate(path, recording, still, frame, place, poses.coils, probe, told)
    return replace(session, palate=palate), told


def placed_palate(
    path: Path,
    recording: Recording,
    session: Session,
    axes: FrameOfReference | None,
    place: Alignment,
    tongue_mm: FloatArray,
    probe: str | None,
    told: list[str],
) -> Palate:
    """The palate of a file, moved by `place` as the coils of its recording are, with the head as at rest there.

    session: what it says of coils, head and smoothing, without an alignment; axes: of the recording; tongue_mm:
    (frames, n, 3) the recording's tongue coils where `place` puts them; probe: the channel of a sweep, where it is known;
    told: gets what there is to say. Raises InputError where the file is no palate, or none above this tongue.
    """
    palate = _read_in_place(path, recording, session, axes, place, probe, told)
    highest = check_above_tongue(palate, tongue_mm, recording.source)
    told.append(f"palate: {palate}; 99 % of the tongue samples stay below {highest:+.1f} mm from it")
    aside = float(np.median(palate.points_mm[:, 0]) - np.nanmedian(tongue_mm[:, :, 0]))
    if abs(aside) > PALATE_ASIDE_MM:
        told.append(
            f"note: the palate was drawn {abs(aside):.0f} mm to the {'left' if aside > 0 else 'right'} of the tongue "
            "coils, where it is lower than above them; it bounds the tongue too tightly"
        )
    return palate


def _read_in_place(
    path: Path,
    recording: Recording,
    session: Session,
    axes: FrameOfReference | None,
    place: Alignment,
    probe: str | None,
    told: list[str],
) -> Palate:

    def prepared(sweep: Recording) -> Recording:
        _check_axes(sweep, recording)
        references = _references(session)
        if session.head is not None:
            _check_has(sweep, references, recording)
            raw = {
                role: sweep.positions[:, sweep.coils.index(channel)] for channel, role in references.items()
            }
            check_same_head(raw, _rest_places(recording, session), sweep.source, recording.source)
        roles = [session.coils.get(channel, PALATE_PROBE) for channel in sweep.coils]
        still = _still(sweep, sweep.coils, roles, session) @ place.rotation.T + place.translation_mm
        return replace(sweep, positions=still, frame=MODEL_FRAME)

    tongue = [channel for channel, role in session.coils.items() if role.startswith(TONGUE_PREFIX)]

    def read(unit: str | None) -> Palate:
        return read_palate(path, axes, unit, probe, tongue, prepared)

    try:
        palate = read(None)
    except InputError as reason:
        if "states neither unit" not in str(reason):
            raise
        palate = _trace_in_its_unit(read, told)
    if palate.frame != MODEL_FRAME:
        palate = palate.transformed(place.rotation, place.translation_mm)
    return palate


def _trace_in_its_unit(read: Any, told: list[str]) -> Palate:
    """A trace is of one unit only as long as a palate is."""
    refusal = InputError("")
    for unit in UNITS_MM:
        try:
            palate: Palate = read(unit)
        except InputError as reason:
            if unit == "mm":
                refusal = reason
            continue
        told.append(f"palate: the trace states no unit; only in {unit} it is as long as a palate")
        return palate
    raise refusal


# The session and what comes of it -------------------------------------------------------------------


def _whole_session(
    session: Session,
    model: TongueModel,
    seen: str,
    base: _Base,
    fit: Registration,
    palate: Palate | None,
    midsagittal: bool,
) -> Session:
    """The session as it is written; seen: the frames that it was found on, in words."""
    rotation = _orthonormal(fit.rotation @ base.rotation)
    translation = fit.rotation @ base.translation_mm + fit.translation_mm
    bounded = f", below {palate.source}" if palate is not None else ""
    return replace(
        session,
        alignment=Alignment(
            rotation, translation, midsagittal,
            f"{base.source}, then fitted to the model over {seen}{bounded}",
        ),
        palate=palate.transformed(fit.rotation, fit.translation_mm) if palate is not None else None,
        correspondences=dict(zip(fit.correspondences.roles, fit.vertices, strict=True)),
        speaker_weights=fit.speaker_weights,
        speaker_source=f"joint estimate with the alignment over {seen}",
        model_fingerprint=model.fingerprint,
    )  # fmt: skip


def _orthonormal(rotation: FloatArray) -> FloatArray:
    """The nearest orthonormal matrix: products drift by rounding."""
    left, _, right = np.linalg.svd(rotation)
    return np.asarray(left @ right)


def _tracked(recording: Recording, model: TongueModel, session: Session) -> dict[int, TrackedPoses]:
    run = track_recording(recording, model, session, EXPERIMENTS)
    assert run.experiment_1 is not None and run.experiment_2 is not None
    return {1: run.experiment_1, 2: run.experiment_2}


def contours(poses: TrackedPoses, model: TongueModel) -> FloatArray:
    """(tracked frames, c, 3) mm: the mid-sagittal contour from tip to root, in the model's frame."""
    at = model.at([int(vertex) for vertex in midsagittal_vertices(model)])
    tracked = poses.tracked
    flat = at.origin + np.einsum(
        "tl,tk,lkr->tr", poses.speaker_weights[tracked], poses.weights[tracked], at.core, optimize=True
    )
    return np.asarray(flat.reshape(len(flat), -1, 3))


def _heights(poses: Sequence[TrackedPoses], model: TongueModel, palate: Palate | None) -> FloatArray:
    """(tracked frames,) mm by which the contour rises above the palate at the most; empty without a palate."""
    if palate is None:
        return np.zeros(0)
    above = np.concatenate([palate.above(contours(one, model)) for one in poses])
    return np.asarray(np.where(np.isnan(above), -np.inf, above).max(axis=1))


def figures(poses: Sequence[TrackedPoses], model: TongueModel, heights: FloatArray) -> Figures:
    """Of one experiment over several recordings; heights: of `_heights`. Raises InputError where none was tracked."""
    tracked = [one.tracked for one in poses]
    residual = np.concatenate([one.residual_mm[good] for one, good in zip(poses, tracked, strict=True)])
    if len(residual) == 0:
        raise InputError(f"{poses[0].recording}: no frame could be tracked.")
    weights = [one.normalised[good] for one, good in zip(poses, tracked, strict=True)]
    if poses[0].experiment == 1:
        weights = [
            np.column_stack([model.speaker.normalised(one.speaker_weights[good]), found])
            for one, good, found in zip(poses, tracked, weights, strict=True)
        ]
    each = np.concatenate([one.residuals_mm[good] for one, good in zip(poses, tracked, strict=True)])
    by_coil = {role: float(np.nanmean(each[:, index])) for index, role in enumerate(poses[0].roles)}
    return Figures(
        frames=len(residual),
        residual_mean_mm=float(residual.mean()),
        residual_median_mm=float(np.median(residual)),
        below_1_25_mm=float(np.mean(residual < 1.25)),
        below_1_5_mm=float(np.mean(residual < 1.5)),
        within_3_sigma=float(np.mean((np.abs(np.concatenate(weights)) <= 3.0).all(axis=1))),
        by_coil_mm=by_coil,
        above_palate=float(np.mean(heights > PALATE_ALLOWED_MM)) if len(heights) else np.nan,
        highest_mm=float(np.quantile(heights, 0.99)) if len(heights) else np.nan,
    )
