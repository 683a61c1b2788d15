"""The paper's two experiments over a whole recording."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .. import InputError
from ..drivers.frames import Recording
from ..model.multilinear import SpeakerModel, TongueModel
from .pose import FloatArray, PoseStatus, TrackedPoses
from .session import Session
from .setup import Setup, complete_setup
from .solver import FixedSpeakerSolver, FreeSpeakerSolver, SolvedFrames


@dataclass(frozen=True)
class TrackingRun:
    """What tracking a recording gave. An experiment that was not asked for is None.

    setup: with the speaker's weights, so that `setup.session` reproduces experiment 2.
    """

    setup: Setup
    speaker: SpeakerModel
    experiment_1: TrackedPoses | None
    experiment_2: TrackedPoses | None


def track_recording(
    recording: Recording,
    model: TongueModel,
    session: Session | None = None,
    experiments: tuple[int, ...] = (1, 2),
    setup: Setup | None = None,
) -> TrackingRun:
    """Tracks a whole recording in compiled loops.

    Experiment 1 solves speaker and pose in every frame; the speaker is then the mean of its speaker
    weights over the tracked frames, unless the session states one; experiment 2 solves the pose alone.
    (Paper, section "Experiments".) `setup` is given where `complete_setup` was already called.
    """
    if recording.frame_count == 0:
        raise InputError(f"{recording.source}: the recording has no frames.")
    setup = setup or complete_setup(recording, model, session or Session())
    energy = setup.session.energy
    coils = setup.preparation.all_frames(recording.positions, recording.rate_hz, recording.quaternions)
    at_coils = model.at(setup.vertices)
    if np.isnan(coils[:, :, 0]).all():
        raise InputError(
            f"{recording.source}: none of the tracked coils ({', '.join(setup.channels)}) has a position in any "
            "frame; name channels that have, with --coils or in the session's [coils]."
        )
    free: SolvedFrames | None = None
    if 1 in experiments or setup.session.speaker_weights is None:
        free = FreeSpeakerSolver(at_coils, energy).solve_all(coils)
    setup = with_speaker(setup, model, free, recording)
    weights = setup.session.speaker_weights
    assert weights is not None
    speaker = model.for_speaker(weights)
    fixed = (
        FixedSpeakerSolver(speaker.at(setup.vertices), energy).solve_all(coils) if 2 in experiments else None
    )

    def poses(experiment: int, solved: SolvedFrames, speakers: FloatArray, pose: FloatArray) -> TrackedPoses:
        frames = len(coils)
        constant = fixed_speaker_energy(model, setup) if experiment == 2 else 0.0
        fitted = at_coils.origin + np.einsum("tl,tk,lkr->tr", speakers, pose, at_coils.core, optimize=True)
        return TrackedPoses(
            times_s=recording.times_s,
            statuses=solved.statuses,
            weights=pose,
            normalised=model.pose.normalised(pose),
            speaker_weights=speakers,
            energies=solved.results[:, 0] + constant,
            residual_mm=solved.results[:, 1],
            residuals_mm=solved.residuals_mm,
            coils=coils,
            vertices=fitted.reshape(frames, -1, 3),
            roles=setup.roles,
            correspondences=setup.vertices,
            experiment=experiment,
            rate_hz=recording.rate_hz,
            model_fingerprint=model.fingerprint,
            model_name=model.name,
            recording=recording.source,
        )

    speaker_size = model.speaker.size
    first = second = None
    if free is not None and 1 in experiments:
        first = poses(
            1, free, free.weights[:, :speaker_size], np.ascontiguousarray(free.weights[:, speaker_size:])
        )
    if fixed is not None:
        second = poses(2, fixed, np.broadcast_to(weights, (len(coils), speaker_size)), fixed.weights)
    return TrackingRun(setup, speaker, first, second)


def with_speaker(setup: Setup, model: TongueModel, free: SolvedFrames | None, recording: Recording) -> Setup:
    """The set-up with the session's speaker, or else the mean over experiment 1's tracked frames."""
    if setup.session.speaker_weights is not None:
        source = setup.session.speaker_source or setup.session.source
        return replace(setup, decisions=(*setup.decisions, f"speaker (session): {source}"))
    assert free is not None
    tracked = free.statuses == PoseStatus.OK
    weights = free.weights[tracked, : model.speaker.size].mean(axis=0)
    source = f"mean of experiment 1 over {int(tracked.sum())} frames of {recording.source}"
    session = replace(setup.session, speaker_weights=weights, speaker_source=source)
    shown = ", ".join(f"{value:+.2f}" for value in model.speaker.normalised(weights))
    return replace(
        setup,
        session=session,
        decisions=(*setup.decisions, f"speaker (estimated): {source}; in sigma {shown}"),
    )


def fixed_speaker_energy(model: TongueModel, setup: Setup) -> float:
    """The bias of the speaker's weights: the part of E that stays while they are fixed; 0 while they are free.

    The fixed speaker's solver leaves it out, as it knows the pose alone.
    """
    weights = setup.session.speaker_weights
    if weights is None:
        return 0.0
    return setup.session.energy.beta_speaker * float(np.sum((weights - model.speaker.mean) ** 2))
