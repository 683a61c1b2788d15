"""The paper's two experiments over one speaker's recordings, and the numbers that it reports (section "Experiments").

Experiment 1 solves speaker and pose in every frame, experiment 2 the pose alone, with the speaker fixed. All
recordings share coils, correspondences and the fixed speaker. This module computes; `experimentreport` words it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import InputError
from ..drivers.frames import Recording
from ..model.multilinear import TongueModel
from .anatomy import estimate_speaker
from .pose import FloatArray, TrackedPoses
from .session import NO_SESSION, Session
from .setup import Setup, complete_setup
from .tracking import track_recording

THRESHOLDS_MM = (1.25, 1.5)
"""The paper's, for experiments 1 and 2."""
WITHIN_SIGMA = (2, 3)
MOST_JOINT_FRAMES = 3000
"""Of neighbouring frames one says what the other does: more cost time and add nothing to a joint estimate."""


@dataclass(frozen=True)
class Anatomy:
    """The speaker whom experiment 2 keeps. weights: (m,) raw; source: how they were found, for people;
    sigma: (m,) how uncertain a joint estimate is, in sigma of the model; None where nothing says."""

    weights: FloatArray
    source: str
    sigma: FloatArray | None = None


@dataclass(frozen=True)
class Take:
    """One recording through both experiments. name: short and different for each recording."""

    name: str
    experiment_1: TrackedPoses
    experiment_2: TrackedPoses
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Experiments:
    """All recordings of one speaker. session: complete, with experiment 2's speaker; decisions: how it was found."""

    model: TongueModel
    session: Session
    anatomy: Anatomy
    takes: tuple[Take, ...]
    decisions: tuple[str, ...]


@dataclass(frozen=True)
class Spread:
    """Of many values: mean, deviation (of the values themselves: divided by their number), range and quartiles."""

    mean: float
    standard_deviation: float
    minimum: float
    lower_quartile: float
    median: float
    upper_quartile: float
    maximum: float


@dataclass(frozen=True)
class Statistics:
    """What the paper reports of one experiment, over the frames with at least one coil.

    error_mm: of a frame, the mean distance of the coils that are there from their vertices; coils_mm: role ->
    distance of that coil, without roles that never have a position; weights: name -> normalised weight, of those
    that the experiment solves for; share_below_mm: threshold -> share of frames with a smaller error;
    share_within_sigma: multiple -> share of frames in which all of these weights are within it.
    """

    frames: int
    frames_tracked: int
    error_mm: Spread
    coils_mm: dict[str, Spread]
    weights: dict[str, Spread]
    share_below_mm: dict[float, float]
    share_within_sigma: dict[int, float]


def run_experiments(
    recordings: Sequence[tuple[str, Recording]],
    model: TongueModel,
    session: Session,
    anatomy: str | None = None,
) -> Experiments:
    """Both experiments over all recordings of one speaker.

    recordings: with the name that each goes by. What the session leaves open (coils, correspondences) is found on
    the first one and holds for all.
    anatomy: how experiment 2's speaker is found. "mean": as in the paper, the mean of experiment 1's speaker weights
    over all tracked frames of all recordings; "joint": `anatomy.estimate_speaker`; None: the session's, where it
    states one, else the mean.
    Raises InputError, with the recording's name, where one cannot be tracked.
    """
    setups: list[Setup] = []
    free: list[TrackedPoses] = []
    for _, recording in recordings:
        setup = complete_setup(recording, model, _like_the_first(setups[0], session) if setups else session)
        run = track_recording(recording, model, experiments=(1,), setup=setup)
        assert run.experiment_1 is not None
        setups.append(setup)
        free.append(run.experiment_1)
    found = _anatomy(model, setups[0], free, anatomy)
    takes = []
    for (name, recording), setup, first in zip(recordings, setups, free, strict=True):
        fixed = replace(setup, session=_with_speaker(setup.session, found))
        second = track_recording(recording, model, experiments=(2,), setup=fixed).experiment_2
        assert second is not None
        takes.append(Take(name, first, second, recording.notes))
    complete = _with_speaker(setups[0].session, found)
    return Experiments(model, complete, found, tuple(takes), setups[0].decisions)


def _with_speaker(session: Session, anatomy: Anatomy) -> Session:
    return replace(session, speaker_weights=anatomy.weights, speaker_source=anatomy.source)


def _like_the_first(setup: Setup, session: Session) -> Session:
    """The session for the other recordings: coils and vertices as on the first."""
    stated = session.source != NO_SESSION
    return replace(setup.session, source=session.source if stated else "the first recording's set-up")


def _anatomy(model: TongueModel, setup: Setup, free: Sequence[TrackedPoses], method: str | None) -> Anatomy:
    session = setup.session
    if method is None and session.speaker_weights is not None:
        return Anatomy(session.speaker_weights, f"session: {session.speaker_source or session.source}")
    frames = sum(int(poses.tracked.sum()) for poses in free)
    of = f"of {len(free)} recordings" if len(free) > 1 else f"of {free[0].recording}"
    if method != "joint":
        speakers = np.concatenate([poses.speaker_weights[poses.tracked] for poses in free])
        return Anatomy(speakers.mean(axis=0), f"mean of experiment 1 over {frames} frames {of}")
    coils = np.concatenate([poses.coils[poses.tracked] for poses in free])
    sample = np.unique(np.linspace(0, frames - 1, min(frames, MOST_JOINT_FRAMES)).round().astype(int))
    estimate = estimate_speaker(model.at(setup.vertices), session.energy, coils[sample])
    if not estimate.converged:
        raise InputError(
            "--anatomy joint: the estimate of one speaker for all frames does not come to rest; check the alignment, "
            "or use --anatomy mean."
        )
    source = f"joint estimate over {len(sample)} frames {of}"
    return Anatomy(estimate.weights, source, estimate.sigma)


# Numbers --------------------------------------------------------------------------------------------


def spread_of(values: FloatArray) -> Spread:
    """Of values (n,), n >= 1, without NaN."""
    low, middle, high = (float(q) for q in np.percentile(values, [25, 50, 75]))
    return Spread(
        float(values.mean()), float(values.std()), float(values.min()), low, middle, high, float(values.max())
    )


def frame_errors(takes: Sequence[TrackedPoses]) -> FloatArray:
    """(frames with a coil of all takes,) mm: each frame's mean distance of coils and vertices."""
    return np.concatenate([poses.residual_mm[poses.tracked] for poses in takes])


def solved_weights(takes: Sequence[TrackedPoses], model: TongueModel) -> dict[str, FloatArray]:
    """Name -> (frames with a coil of all takes,): the normalised weights that the experiment solves for."""
    columns = {}
    if takes[0].experiment == 1:
        speakers = np.concatenate([poses.speaker_weights[poses.tracked] for poses in takes])
        columns.update(_named("speaker", model.speaker.normalised(speakers)))
    columns.update(_named("pose", np.concatenate([poses.normalised[poses.tracked] for poses in takes])))
    return columns


def _named(mode: str, weights: FloatArray) -> dict[str, FloatArray]:
    return {f"{mode}_{index + 1}": column for index, column in enumerate(weights.T)}


def statistics_of(takes: Sequence[TrackedPoses], model: TongueModel) -> Statistics:
    """Of takes of the same experiment and coils, all frames together."""
    errors = frame_errors(takes)
    weights = solved_weights(takes, model)
    largest = np.abs(np.column_stack(list(weights.values()))).max(axis=1)
    coils = {}
    for index, role in enumerate(takes[0].roles):
        distances = np.concatenate([poses.residuals_mm[:, index] for poses in takes])
        present = distances[~np.isnan(distances)]
        if len(present):
            coils[role] = spread_of(present)
    return Statistics(
        frames=sum(poses.frame_count for poses in takes),
        frames_tracked=len(errors),
        error_mm=spread_of(errors),
        coils_mm=coils,
        weights={name: spread_of(column) for name, column in weights.items()},
        share_below_mm={limit: float((errors < limit).mean()) for limit in THRESHOLDS_MM},
        share_within_sigma={limit: float((largest <= limit).mean()) for limit in WITHIN_SIGMA},
    )


def pooled(experiments: Experiments) -> tuple[list[TrackedPoses], list[TrackedPoses]]:
    """All takes of experiment 1, and all of experiment 2."""
    takes = experiments.takes
    return [take.experiment_1 for take in takes], [take.experiment_2 for take in takes]
