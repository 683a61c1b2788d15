"""From what a session states and a recording shows to everything the tracker needs, with the reasons."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from ..drivers.frames import FrameOfReference, Recording
from ..model.multilinear import TongueModel
from .coilmap import CoilMap, checked_coil_map, guess_coil_map
from .correspondences import estimate_correspondences
from .headcorrection import head_jump, head_motion
from .preparation import Preparation
from .session import NO_SESSION, Session, axis_mapping

FAR_MM = 15.0  # from its vertex; a coil in the model's frame ends much nearer, whatever the anatomy
MODEL_FRAME = FrameOfReference("left", "back", "up", "model")


@dataclass(frozen=True)
class Setup:
    """A complete set-up. channels, roles, vertices: in the order in which the coils are tracked.

    session: the session with everything that was estimated written into it (what a file would hold).
    decisions: one sentence for each thing that was estimated, defaulted or noticed.
    """

    channels: tuple[str, ...]
    roles: tuple[str, ...]
    vertices: tuple[int, ...]
    preparation: Preparation
    session: Session
    decisions: tuple[str, ...]


def complete_setup(recording: Recording, model: TongueModel, session: Session) -> Setup:
    """Checks the session against recording and model, and estimates what it leaves open.

    Raises InputError where they contradict each other: a coil that is not in the recording, a vertex
    that is not in the model, speaker weights of another model.
    """
    decisions = []
    coil_map = _coil_map(recording, session)
    if not session.coils:
        named = ", ".join(f"{channel} = {role}" for channel, role in coil_map.roles.items())
        decisions.append(f"coils ({coil_map.why}): {named}")
    channels, roles = tuple(coil_map.tongue), tuple(coil_map.tongue.values())
    preparation = preparation_of(
        recording.coils, channels, roles, replace(session, coils=coil_map.roles), recording.rate_hz
    )
    decisions.append(
        f"alignment ({'default' if session.source in (NO_SESSION, '--coils') else 'session'}): {session.alignment}"
    )
    decisions.extend(_frame_hints(recording, session))
    _check_speaker(model, session)
    decisions.extend(_speaker_warnings(model, session))
    decisions.extend(_head_warnings(recording, replace(session, coils=coil_map.roles)))

    stated = {role: session.correspondences[role] for role in roles if role in session.correspondences}
    _check_vertices(model, stated, session)
    for role in session.correspondences:
        if role not in roles:
            raise InputError(
                f"{session.source}: [correspondences] names the role '{role}', but the tracked coils are "
                f"{', '.join(roles)}."
            )
    if len(stated) == len(roles):
        vertices = tuple(stated[role] for role in roles)
    else:
        coils = preparation.all_frames(recording.positions, recording.rate_hz, recording.quaternions)
        found = estimate_correspondences(model, coils, roles, session.energy)
        vertices = tuple(stated.get(role, vertex) for role, vertex in zip(roles, found.vertices, strict=True))
        decisions.append(f"correspondences (estimated): {found}")
        if max(found.distances_mm) > FAR_MM:
            decisions.append(
                f"note: a coil stays {max(found.distances_mm):.0f} mm away from the model even at its best vertex; "
                "the recording is hardly in the model's frame, which is the session's [alignment]"
            )
        if stated:
            decisions.append(
                f"correspondences (session): {', '.join(f'{r} = vertex {v}' for r, v in stated.items())}"
            )
    if stated and _of_another_model(session, model):
        decisions.append(
            f"note: the session's vertices were chosen on the model {session.model_fingerprint}, "
            f"this one is {model.fingerprint}"
        )
    completed = replace(
        session,
        coils=dict(coil_map.roles),
        correspondences=dict(zip(roles, vertices, strict=True)),
        model_fingerprint=model.fingerprint,
    )
    return Setup(channels, roles, vertices, preparation, completed, tuple(decisions))


def preparation_of(
    available: Sequence[str], channels: Sequence[str], roles: Sequence[str], session: Session, rate_hz: float
) -> Preparation:
    """What the session says of smoothing, head and alignment, for these channels of a source.

    Raises InputError where a reference coil of [head] is none of the source's.
    """
    head, references = session.head, None
    if head is not None:
        channel_of = {role: channel for channel, role in session.coils.items()}
        for role in head.roles:
            if channel_of.get(role) not in available:
                raise InputError(
                    f"{session.source}: [head] has a rest position for {role}, but no channel of the source has that "
                    "role in [coils]; name it there, or leave the role out of [head]."
                )
        references = picked_channels(available, [channel_of[role] for role in head.roles])
    return Preparation(
        picked_channels(available, channels),
        session.alignment,
        roles,
        head,
        references,
        session.smoothing,
        rate_hz,
    )


def picked_channels(available: Sequence[str], channels: Sequence[str]) -> NDArray[np.int64]:
    """(n,) the index of each channel among those a source has."""
    return np.array([list(available).index(channel) for channel in channels], dtype=np.int64)


def _coil_map(recording: Recording, session: Session) -> CoilMap:
    if not session.coils:
        return guess_coil_map(recording.coils, recording.positions, recording.source)
    for channel in session.coils:
        if channel not in recording.coils:
            where = session.source if session.source == "--coils" else f"{session.source}: [coils]"
            raise InputError(
                f"{where} names the channel '{channel}', which {recording.source} does not have; its channels are "
                f"{', '.join(recording.coils)}; say which of them is which coil with --coils CHANNEL=ROLE,..."
            )
    return checked_coil_map(session.coils, session.source)


def _check_speaker(model: TongueModel, session: Session) -> None:
    weights = session.speaker_weights
    if weights is not None and weights.shape != (model.speaker.size,):
        raise InputError(
            f"{session.source}: [speaker] has {weights.size} weights, but the model '{model.name}' has "
            f"{model.speaker.size} speaker modes; it belongs to a model of other dimensions."
        )
    if weights is not None and _of_another_model(session, model):
        raise InputError(
            f"{session.source}: its [speaker] weights belong to the model {session.model_fingerprint}, not to "
            f"'{model.name}' [{model.fingerprint}], where they mean another anatomy; name that model with --model, or "
            "remove [speaker] and [correspondences] to have them estimated again."
        )


def _speaker_warnings(model: TongueModel, session: Session) -> list[str]:
    """Whether the session's speaker is one whom the tracker would never find itself."""
    if session.speaker_weights is None:
        return []
    away = np.abs(model.speaker.normalised(session.speaker_weights))
    if away.max() <= session.energy.box + 1e-6:
        return []
    return [
        (
            f"warning: weight {int(away.argmax()) + 1} of the session's [speaker] is {away.max():.1f} sigma from the mean, "
            f"outside the box of {session.energy.box:g}: no anatomy of this model is like that; estimate it again by removing "
            "[speaker], or with tonguetrack anatomy"
        )
    ]


def _head_warnings(recording: Recording, session: Session) -> list[str]:
    """Whether the head jumps, which the distances between references alone do not tell."""
    if session.head is None:
        return []
    channels = {role: channel for channel, role in session.coils.items()}
    references = [channels.get(role, "") for role in session.head.roles]
    if not set(references) <= set(recording.coils):
        return []  # `preparation_of` refuses it
    picked = picked_channels(recording.coils, references)
    turned = None if recording.quaternions is None else recording.quaternions[:, picked]
    motion = head_motion(recording.positions[:, picked], session.head, recording.rate_hz, turned)
    jump = head_jump(motion, session.head)
    if jump is None:
        return []
    return [jump_sentence(recording, *jump)]


def jump_sentence(recording: Recording, frame: int, jump_mm: float) -> str:
    """What `head_jump` found, for people."""
    time_s = recording.times_s[frame] - recording.times_s[0]
    return (
        f"note: the head of {recording.source} jumps by {jump_mm:.0f} mm at {time_s:.2f} s, which no head does; look "
        "whether reference coils were exchanged, or frames are missing there"
    )


def _of_another_model(session: Session, model: TongueModel) -> bool:
    return session.model_fingerprint not in ("", model.fingerprint)


def _check_vertices(model: TongueModel, stated: dict[str, int], session: Session) -> None:
    for role, vertex in stated.items():
        if not 0 <= vertex < model.vertex_count:
            raise InputError(
                f"{session.source}: [correspondences] {role} = {vertex}, but the model '{model.name}' has vertices "
                f"0 to {model.vertex_count - 1}; it belongs to a model of other dimensions."
            )


def _frame_hints(recording: Recording, session: Session) -> list[str]:
    """Says what the file's own frame would need, without doing it unasked."""
    known = [recording.frame.x, recording.frame.y, recording.frame.z]
    if session.alignment.moves:
        return []
    axes = suggested_axes(recording.frame)
    if axes is None:
        unknown = (
            f"note: how the axes of {recording.source} lie to the model's is not known ({recording.frame}); unless "
            "they agree, the session needs an [alignment]"
        )
        return [unknown] if "unknown" in known else []
    if np.array_equal(axis_mapping(axes), np.eye(3)):
        return []
    hint = (
        f"note: the file's frame is {recording.frame}, the model's is {MODEL_FRAME}; "
        f"unless the file was rotated already, [alignment] needs axes = {json.dumps(axes)}"
    )
    return [hint]


def suggested_axes(frame: FrameOfReference) -> tuple[str, str, str] | None:
    """The [alignment] axes that turn a known frame's directions into the model's; None where unknown.

    An axis that is absent (2-D data, filled with zeros) stands in for the missing direction.
    """
    opposite = {
        "left": "right",
        "right": "left",
        "front": "back",
        "back": "front",
        "up": "down",
        "down": "up",
    }
    directions = {"x": frame.x, "y": frame.y, "z": frame.z}
    absent = [axis for axis, direction in directions.items() if direction == "absent"]
    chosen = []
    for wanted in (MODEL_FRAME.x, MODEL_FRAME.y, MODEL_FRAME.z):
        same = [axis for axis, direction in directions.items() if direction == wanted]
        turned = [axis for axis, direction in directions.items() if direction == opposite[wanted]]
        if same:
            chosen.append(same[0])
        elif turned:
            chosen.append(f"-{turned[0]}")
        elif absent:
            chosen.append(absent.pop())
        else:
            return None
    return chosen[0], chosen[1], chosen[2]
