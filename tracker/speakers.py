"""The speaker's anatomy in three ways, side by side: what each says, how sure it is, how well it tracks.

    mean    the paper's: the average of experiment 1's speaker weights, frame by frame free
    joint   one speaker who explains all frames at once (`anatomy`)
    mesh    the model fitted to surfaces of this very speaker (`fitting`), as from an MRI

None of the uncertainties knows of errors that all frames or meshes share: a wrong alignment, wrong vertices, the
bias towards the mean weights, what the model cannot express. They say how much the same estimate would change with
other speech of the same speaker, and are a lower bound of its error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from .. import InputError
from ..drivers.frames import Recording
from ..model.cloud import Cloud
from ..model.fitting import Fit, fit_clouds, fit_shapes
from ..model.mesh import Mesh, vertex_normals
from ..model.multilinear import TongueModel
from .anatomy import estimate_speaker
from .pose import FloatArray, PoseStatus
from .setup import FAR_MM, Setup
from .solver import FreeSpeakerSolver
from .tracking import track_recording

MEAN, JOINT, MESH = "mean", "joint", "mesh"
GOOD_MM = 1.5  # the paper's threshold of experiment 2
SURE = 2.0  # a difference counts where it is so many times its standard error
LEAST_FOR_JACKKNIFE = 3  # meshes
SPEAKING = 0.2  # of the speed that a tenth of the frames exceeds
SMOOTHED_S = 0.05


@dataclass(frozen=True)
class SpeakerResult:
    """A speaker, found in one of the ways.

    weights: (m,) raw; sigma: (m,) standard error in units of the model's speaker sigma, infinite where nothing can be
    said; samples: how many frames or meshes; residual_mm: the mean distance that the estimate itself left; sentence:
    where it came from, as a session's [speaker] source says it.
    """

    weights: FloatArray
    sigma: FloatArray
    samples: int
    residual_mm: float
    sentence: str


@dataclass(frozen=True)
class Tracked:
    """Experiment 2 over the whole recording. residual_mm: mean over the tracked frames; good: share of them below
    1.5 mm; mean_tongue: (V, 3) mm, the mean of the tracked shapes."""

    residual_mm: float
    good: float
    mean_tongue: FloatArray


@dataclass(frozen=True)
class Difference:
    """A weight (from 1) in which two ways differ by more than twice the standard error of their difference, in
    sigma."""

    one: str
    other: str
    weight: int
    difference: float
    error: float


@dataclass(frozen=True)
class Comparison:
    """results, tracked: by way; distances_mm: (way, way) -> mean vertex distance of the two mean tongues."""

    results: Mapping[str, SpeakerResult]
    tracked: Mapping[str, Tracked]
    distances_mm: Mapping[tuple[str, str], float]
    differences: tuple[Difference, ...]


def compare_speakers(
    recording: Recording,
    model: TongueModel,
    setup: Setup,
    meshes: Sequence[Mesh] = (),
    seconds: float | None = None,
) -> Comparison:
    """Every way that there are data for, from the same recording and set-up.

    meshes: of this speaker, mm, in the model's frame; seconds: the first seconds of speech that mean and joint may
    use, None = all. Tracking with each result uses the whole recording.
    Raises InputError for a recording without a tracked coil or with no speech to use, and for meshes that are not
    in the model's frame.
    """
    results = speaker_results(recording, model, setup, meshes, seconds)
    tracked = {way: _tracked(recording, model, setup, result) for way, result in results.items()}
    distances = {
        (one, other): float(
            np.linalg.norm(tracked[one].mean_tongue - tracked[other].mean_tongue, axis=1).mean()
        )
        for one, other in combinations(results, 2)
    }
    return Comparison(results, tracked, distances, differences(model, results))


def speaker_results(
    recording: Recording,
    model: TongueModel,
    setup: Setup,
    meshes: Sequence[Mesh] = (),
    seconds: float | None = None,
) -> dict[str, SpeakerResult]:
    """Way -> what it says; as `compare_speakers`."""
    coils = setup.preparation.all_frames(recording.positions, recording.rate_hz, recording.quaternions)
    where = recording.source
    if seconds is not None:
        used = first_speech(coils, recording.rate_hz, seconds)
        coils = np.ascontiguousarray(coils[used])
        where = f"{used.start / recording.rate_hz:.2f} to {used.stop / recording.rate_hz:.2f} s of {where}"
    if not np.isfinite(coils).any():
        raise InputError(
            f"{where}: none of the tracked coils ({', '.join(setup.channels)}) has a position in any frame; name others "
            "with --coils or in the session's [coils], or leave --seconds out."
        )
    results = {
        MEAN: mean_speaker(model, setup, coils, where),
        JOINT: joint_speaker(model, setup, coils, where),
    }
    if meshes:
        results[MESH] = mesh_speaker(model, meshes, setup.session.energy.box)
    return results


# The three ways ---------------------------------------------------------------------------------------


def mean_speaker(model: TongueModel, setup: Setup, coils: FloatArray, where: str) -> SpeakerResult:
    """The mean of experiment 1's speaker weights over the tracked frames of coils (T, n, 3).

    Its uncertainty is the standard error of that mean. Frames of speech are no independent samples, least of all
    after a coherence term: they count as `effective_frames`.
    """
    free = FreeSpeakerSolver(model.at(setup.vertices), setup.session.energy).solve_all(coils)
    tracked = free.statuses == PoseStatus.OK
    speakers = np.where(tracked[:, None], free.weights[:, : model.speaker.size], np.nan)
    counted = int(tracked.sum())
    effective = effective_frames(speakers)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.nanstd(speakers, axis=0) / np.sqrt(np.maximum(effective - 1.0, 0.0))
    sigma = np.where(effective > 1.0, error, np.inf) / model.speaker.sigma
    return SpeakerResult(
        np.nanmean(speakers, axis=0),
        sigma,
        counted,
        float(free.results[tracked, 1].mean()),
        f"mean of experiment 1 over {counted} frames (worth {effective.min():.0f} to {effective.max():.0f} "
        f"independent ones) of {where}",
    )


def joint_speaker(model: TongueModel, setup: Setup, coils: FloatArray, where: str) -> SpeakerResult:
    """The speaker who explains all frames of coils (T, n, 3) at once, and the deviations of its covariance."""
    found = estimate_speaker(model.at(setup.vertices), setup.session.energy, coils)
    return SpeakerResult(
        found.weights,
        found.sigma,
        found.frames,
        found.residual_mm,
        f"joint estimate over {found.frames} frames of {where}",
    )


def mesh_speaker(model: TongueModel, meshes: Sequence[Mesh], h: float) -> SpeakerResult:
    """The model fitted within h to meshes of the speaker, in the model's frame: vertex by vertex where all of them
    have the model's vertices and faces, else to the nearest points of their surfaces.

    The uncertainty is that of the fit. Of three and more registered meshes it is, where that is larger, the
    jackknife's, which leaves out each in turn, so that what the model misses in single phones counts.
    """
    registered = all(
        len(mesh.vertices) == model.vertex_count and np.array_equal(mesh.faces, model.faces)
        for mesh in meshes
    )
    if registered:
        vertices = np.array([mesh.vertices for mesh in meshes])
        fit = fit_shapes(model, vertices, h)
        sigma = fit.sigma
        if len(meshes) >= LEAST_FOR_JACKKNIFE:
            sigma = np.maximum(sigma, _jackknife(model, vertices, h))
    else:
        fit = fit_clouds(
            model, [Cloud(mesh.vertices, vertex_normals(mesh.vertices, mesh.faces)) for mesh in meshes], h
        )
        sigma = fit.sigma
    check_place(model, fit)
    kind = "registered mesh" if registered else "surface"
    plural = "" if len(meshes) == 1 else "es" if registered else "s"
    return SpeakerResult(
        fit.speaker,
        sigma,
        len(meshes),
        float(fit.residual_mm.mean()),
        f"the model fitted to {len(meshes)} {kind}{plural} of the speaker",
    )


def _jackknife(model: TongueModel, vertices: FloatArray, h: float) -> FloatArray:
    """(m,) in sigma."""
    count = len(vertices)
    left = np.array([fit_shapes(model, np.delete(vertices, one, axis=0), h).speaker for one in range(count)])
    error = np.sqrt((count - 1) * np.mean((left - left.mean(axis=0)) ** 2, axis=0))
    return np.asarray(error / model.speaker.sigma)


def check_place(model: TongueModel, fit: Fit) -> None:
    """Raises InputError where what was fitted lies somewhere else than the model."""
    if fit.residual_mm.max() > FAR_MM:
        raise InputError(
            f"mesh {int(fit.residual_mm.argmax()) + 1}: its vertices stay {fit.residual_mm.max():.0f} mm away from the "
            f"model '{model.name}' at best; bring it into the model's frame first, in mm, x left, y back, z up."
        )


# Time -------------------------------------------------------------------------------------------------


def effective_frames(series: FloatArray) -> FloatArray:
    """(m,) how many independent samples a series (T, m) is worth, NaN = no sample.

    T / (1 + 2 sum of the autocorrelations), summed as long as those of two neighbouring lags are positive together:
    farther out there is but noise (Geyer, Practical Markov Chain Monte Carlo, Statistical Science 7, 1992). At
    least 1, at most T.
    """
    frames = len(series)
    present = np.isfinite(series)
    counts = present.sum(axis=0)
    centred = np.where(present, series - np.nanmean(series, axis=0), 0.0)
    size = 2 * frames
    power, pairs = (
        np.fft.irfft(np.abs(np.fft.rfft(part, size, axis=0)) ** 2, size, axis=0)[:frames]
        for part in (centred, present.astype(np.float64))
    )
    # Divided by T, not by the pairs at that lag: less noise far out. Gaps have fewer pairs everywhere.
    share = np.maximum(pairs / np.maximum(frames - np.arange(frames), 1)[:, None], 1e-9) / (counts / frames)
    correlation = power / np.maximum(power[0], 1e-300) / share
    effective = np.empty(series.shape[1])
    for column, lags in enumerate(correlation.T):
        couples = lags[: frames // 2 * 2].reshape(-1, 2).sum(axis=1)
        ending = np.flatnonzero(couples <= 0.0)
        total = couples[: ending[0] if len(ending) else len(couples)].sum()
        effective[column] = counts[column] / max(2.0 * total - 1.0, 1.0)
    return np.maximum(effective, 1.0)


def first_speech(coils: FloatArray, rate_hz: float, seconds: float) -> slice:
    """The frames of the first seconds of speech in coils (T, n, 3): from where the coils' mean speed, over 50 ms, first
    exceeds a fifth of that which a tenth of the frames exceeds.

    Raises InputError where seconds are no time.
    """
    if not 0.0 < seconds < np.inf:
        raise InputError(f"--seconds {seconds:g}: expected a number of seconds above 0.")
    length = max(1, round(seconds * rate_hz))
    if len(coils) < 2:
        return slice(0, len(coils))
    moved = np.linalg.norm(np.diff(coils, axis=0), axis=2)
    known = np.isfinite(moved)
    counts = known.sum(axis=1)
    window = np.ones(min(max(1, round(SMOOTHED_S * rate_hz)), len(moved)))
    total = np.convolve(np.where(known, moved, 0.0).sum(axis=1), window, "same")
    number = np.convolve(counts, window, "same")
    speed = np.where(number > 0, total / np.maximum(number, 1), 0.0)
    # A recording that stands still begins with its first frame.
    speaking = np.flatnonzero(speed > SPEAKING * np.quantile(speed, 0.9))
    start = int(speaking[0]) if len(speaking) else 0
    return slice(start, min(start + length, len(coils)))


# Comparing --------------------------------------------------------------------------------------------


def differences(model: TongueModel, results: Mapping[str, SpeakerResult]) -> tuple[Difference, ...]:
    """Where two ways contradict each other, as far as their uncertainties go."""
    found: list[Difference] = []
    for one, other in combinations(results, 2):
        apart = (results[one].weights - results[other].weights) / model.speaker.sigma
        error = np.hypot(results[one].sigma, results[other].sigma)
        found.extend(
            Difference(one, other, int(weight) + 1, float(apart[weight]), float(error[weight]))
            for weight in np.flatnonzero(np.abs(apart) > SURE * error)
        )
    return tuple(found)


def _tracked(recording: Recording, model: TongueModel, setup: Setup, result: SpeakerResult) -> Tracked:
    session = replace(setup.session, speaker_weights=result.weights, speaker_source=result.sentence)
    run = track_recording(recording, model, experiments=(2,), setup=replace(setup, session=session))
    poses = run.experiment_2
    assert poses is not None
    residual = poses.residual_mm[poses.tracked]
    return Tracked(
        float(residual.mean()),
        float((residual < GOOD_MM).mean()),
        run.speaker.vertices(poses.weights[poses.tracked].mean(axis=0)),
    )
