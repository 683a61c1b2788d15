"""Motion transfer: what one speaker's tongue did, on another speaker's anatomy.

The pose weights say what a tongue does and the speaker weights whose it is (paper, section "Multilinear model"), so
the poses of one speaker with the speaker weights of another are the same motion in another mouth. What was measured
on the first speaker does not go with it: coils and residuals of transferred poses are missing, energies unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import InputError
from ..model.multilinear import TongueModel
from .palate import Palate
from .pose import FloatArray, TrackedPoses
from .session import Session, load_session

FARTHEST_SIGMA = 20.0
"""Nobody's anatomy is as far from the mean as that; the tracker itself goes to 5."""


@dataclass(frozen=True)
class OtherSpeaker:
    """weights: (m,) raw; palate: of that speaker, in the model's frame, where it is known; source: for people."""

    weights: FloatArray
    palate: Palate | None
    source: str


def other_speaker(text: str, model: TongueModel) -> OtherSpeaker:
    """A speaker from the command line: a session file with [speaker] weights, or the raw weights with commas between.

    Raises InputError where it is neither, or does not belong to the model.
    """
    if not text.lower().endswith(".toml"):
        return OtherSpeaker(_checked(_numbers(text), model, f"--speaker {text}"), None, "the weights given")
    session = load_session(Path(text))
    if session.speaker_weights is None:
        raise InputError(
            f"{text}: it has no [speaker] weights; write them with 'tonguetrack track RECORDING --save-session {text}'."
        )
    if session.model_fingerprint not in ("", model.fingerprint):
        raise InputError(
            f"{text}: its speaker belongs to the model [{session.model_fingerprint}], the poses to {model.name} "
            f"[{model.fingerprint}]; fit the speaker with the poses' model."
        )
    weights = _checked(session.speaker_weights, model, f"{text}: [speaker] weights")
    return OtherSpeaker(weights, session.palate, f"the speaker of {text}")


def session_of(speaker: OtherSpeaker) -> Session:
    """What is known of that speaker, for whatever draws the transferred motion."""
    return replace(Session(), speaker_weights=speaker.weights, palate=speaker.palate)


def transferred(poses: TrackedPoses, speaker: OtherSpeaker) -> TrackedPoses:
    """The same motion in the other speaker's mouth."""
    return replace(
        poses,
        speaker_weights=np.tile(speaker.weights, (poses.frame_count, 1)),
        energies=np.full(poses.frame_count, np.nan),
        residual_mm=np.full(poses.frame_count, np.nan),
        residuals_mm=np.full_like(poses.residuals_mm, np.nan),
        coils=np.full_like(poses.coils, np.nan),
        vertices=None,
        coil_states=None,
        experiment=2,
    )


def _numbers(text: str) -> FloatArray:
    try:
        return np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise InputError(
            f"--speaker {text}: expected a session file ending in .toml, or raw speaker weights with commas between "
            "them (--speaker=0.1,-0.2,...)."
        ) from None


def _checked(weights: FloatArray, model: TongueModel, where: str) -> FloatArray:
    if weights.shape != (model.speaker.size,) or not np.isfinite(weights).all():
        raise InputError(
            f"{where}: {weights.size} weights; the model {model.name} needs {model.speaker.size}, all finite."
        )
    sigmas = np.abs(model.speaker.normalised(weights))
    if sigmas.max() > FARTHEST_SIGMA:
        raise InputError(
            f"{where}: weight {int(sigmas.argmax()) + 1} is {sigmas.max():.3g} sigma from the mean, which is no tongue any "
            f"more; expected {FARTHEST_SIGMA:g} at most, and most people are within 3."
        )
    return weights
