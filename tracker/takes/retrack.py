"""A take through the tracker once more: the same frames, the same set-up, the same bits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ...drivers.frames import CoilFrame
from ...model.multilinear import TongueModel
from ..online import Tracker
from ..pose import FloatArray
from ..session import Session, parse_session
from ..setup import Setup, preparation_of
from .layout import POSE_HEAD
from .reading import Take

_SOLVED_AFTER = POSE_HEAD.index("solved_after_s")  # depends on the host's clock, as nothing else does


@dataclass(frozen=True)
class Retracked:
    """pose: (frames, channels) in the order of `TakeInfo.pose_labels`, without the time that solving took (NaN).

    differing: (d,) rows in which a bit of the pose or of the prepared coils is not as recorded.
    """

    pose: FloatArray
    differing: NDArray[np.int64]

    @property
    def same(self) -> bool:
        return len(self.differing) == 0


def retrack(take: Take, model: TongueModel) -> Retracked:
    """Tracks the take's raw frames as the run did: from a fresh tracker, with every change of the set-up in its place.

    Raises InputError where the model is another one, or the take has no frames.
    """
    info = take.info
    if model.fingerprint != info.model_fingerprint:
        raise InputError(
            f"{take.path}: recorded with the model '{info.model_name}' [{info.model_fingerprint}], not with "
            f"'{model.name}' [{model.fingerprint}]; name that one with --model."
        )
    changes = [
        (row, parse_session(text, f"{take.path}, session of row {row}")) for row, text in take.sessions
    ]
    setup = _setup(take, changes[0][1])
    # Points that a client of the authors' server sends have no coil map, and every one is believed.
    tracker = Tracker(model, setup, info.rate_hz, watchful=bool(changes[0][1].coils))
    pose = np.full((take.frame_count, len(info.pose_labels)), np.nan)
    prepared = np.full((take.frame_count, len(info.prepared_labels)), np.nan)
    later = changes[1:]
    for row, frame in enumerate(take.frames()):
        while later and later[0][0] <= row:
            tracker.change(replace(setup, session=later.pop(0)[1]))
        _step(tracker, frame, pose[row])
        prepared[row] = tracker.coils.ravel()
    recorded = take.pose.copy()
    recorded[:, _SOLVED_AFTER] = np.nan
    differs = (_bits(pose) != _bits(recorded)).any(axis=1)
    differs |= (_bits(prepared) != _bits(take.prepared)).any(axis=1)
    differs &= ~np.isnan(recorded).all(axis=1)  # what a damaged take has lost cannot differ
    return Retracked(pose, np.flatnonzero(differs))


def _setup(take: Take, session: Session) -> Setup:
    info = take.info
    channel_of = {role: channel for channel, role in session.coils.items()}
    # Points of the authors' clients have no coil map: they are tracked in their own order.
    channels = [channel_of.get(role, coil) for role, coil in zip(info.roles, info.coils, strict=False)]
    preparation = preparation_of(info.coils, channels, info.roles, session, info.rate_hz)
    return Setup(tuple(channels), info.roles, info.vertices, preparation, session, ())


def _step(tracker: Tracker, frame: CoilFrame, row: FloatArray) -> None:
    pose = tracker.step(frame)
    head = (pose.status, pose.speaker_fixed, pose.valid_coils, pose.energy, pose.residual_mm, np.nan)
    parts = (head, pose.weights, pose.speaker_weights, pose.residuals_mm, pose.coil_states)
    at = 0
    for part in parts:
        row[at : at + len(part)] = part
        at += len(part)


def _bits(values: FloatArray) -> NDArray[np.int64]:
    """As integers, every NaN the same."""
    values = np.array(values, dtype=np.float64)
    values[np.isnan(values)] = np.nan
    return values.view(np.int64)
