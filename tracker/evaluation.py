"""How near the tracker comes to the truth: one speaker left out, coils on that speaker's own meshes.

The evaluation that the paper leaves to "a dedicated study" (section "Discussion" of the tracking experiments). Its
procedure, for every speaker of a sample database in turn:

1. Training: the meshes of all other speakers; of those, too, the phone that is tested is left out where asked. Cells
   that the database lacks are filled as for any model, from the training speakers alone. Model: HOSVD of these shapes,
   truncated (5 x 4 in the paper).
2. Coils: at given vertices of each true mesh of the speaker, plus independent normal noise on all three
   coordinates (0.3 mm); no projection, no head motion, correspondences and alignment are known. Filled cells are
   no truth, and are not tested.
3. Tracking: each phone is one frame. Frames are unrelated, so that coherence is off (gamma = 0) and each begins at
   the mean; alpha = 1, beta = 5 for both modes, box h = 5. Experiment 1: s and p free in each frame. Experiment 2: s
   is the mean of experiment 1's over the speaker's frames, the one tested included; p alone is free.
4. Error: mean distance between corresponding vertices, over all of the mesh, over a region, over the coils' vertices (to
   the true vertex, without noise); mean over the phones, then over the speakers.

Brackets: the mean shape (mean of all training shapes) knows nothing of the coils. The best fit knows the whole true
mesh: one s for the speaker, one p a phone, least squares over all vertices. `best fit` is its minimum in the
tracker's box. `best fit, 40 sweeps` is what 40 sweeps of alternating least squares, begun at the mean weights and
without a box, come to; they are far from done by then, but earlier figures were made so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from ..model.build import TrainingShapes, fill_missing_by_averaging, model_from_shapes
from ..model.fitting import fit_shapes
from ..model.multilinear import SurfaceMarks, TongueModel
from .anatomy import SpeakerEstimator, estimate_speaker
from .pose import FloatArray
from .posterior import posterior_from_shapes
from .session import Energy
from .solver import FixedSpeakerSolver, FreeSpeakerSolver

ENERGY = Energy(gamma_speaker=0.0, gamma_pose=0.0)
DATA_ONLY = replace(ENERGY, beta_speaker=0.0, beta_pose=0.0)
SWEEPS = 40
LEAST_POSTERIOR_NOISE_MM = (
    0.1  # what the posterior assumes of coils without noise, so that it stays determined
)
LARGEST_NOISE_MM = 100.0
WHOLE_MESH, COILS = "whole mesh", "coils"


@dataclass(frozen=True)
class Plan:
    """What to evaluate. coils: vertices; noise_mm: standard deviation per coordinate; leave_phone_out: whether the
    tested phone is kept from the training shapes, too; seed: of the noise."""

    coils: tuple[int, ...]
    noise_mm: float = 0.3
    leave_phone_out: bool = False
    speaker_modes: int = 5
    pose_modes: int = 4
    seed: int = 1

    def __post_init__(self) -> None:
        if not self.coils or len(set(self.coils)) < len(self.coils):
            raise InputError("--coils: expected at least one vertex, and each vertex once.")
        if not 0 <= self.noise_mm <= LARGEST_NOISE_MM:
            raise InputError(
                f"--noise {self.noise_mm:g}: expected millimetres from 0 to {LARGEST_NOISE_MM:g}."
            )
        if self.seed < 0:
            raise InputError(f"--seed {self.seed}: expected 0 or more.")


@dataclass(frozen=True)
class Fold:
    """What the estimators are given; mm in the model frame.

    model: of the training shapes; training: (N, k), those of them that are meshes, not averages; vertices: the coils'; coils: (T, n, 3), noisy, one frame a
    phone of the speaker left out; noise_mm: their deviation; truth: (T, k), for the brackets alone.
    """

    model: TongueModel
    training: FloatArray
    vertices: tuple[int, ...]
    coils: FloatArray
    noise_mm: float
    truth: FloatArray


@dataclass(frozen=True)
class Evaluation:
    """errors: estimator -> (speakers, prompts, parts) mean vertex distance in mm, NaN where the cell is no truth;
    parts: the whole mesh, the regions, the coils."""

    plan: Plan
    speakers: tuple[str, ...]
    prompts: tuple[str, ...]
    parts: tuple[str, ...]
    errors: Mapping[str, FloatArray]

    def per_speaker(self, estimator: str) -> FloatArray:
        """(speakers, parts) mm: means over each speaker's phones."""
        return np.asarray(np.nanmean(self.errors[estimator], axis=1))

    def per_phone(self, estimator: str) -> FloatArray:
        """(prompts, parts) mm: means over the speakers who have the phone."""
        return np.asarray(np.nanmean(self.errors[estimator], axis=0))

    def mean(self, estimator: str) -> FloatArray:
        """(parts,) mm: the mean over the speakers of `per_speaker`."""
        return np.asarray(self.per_speaker(estimator).mean(axis=0))


# Estimators: a fold in, (T, k) mm out -----------------------------------------------------------------


def mean_shape(fold: Fold) -> FloatArray:
    """The mean of the training shapes, whatever the coils say."""
    return np.tile(fold.model.origin, (len(fold.coils), 1))


def experiment_1(fold: Fold) -> FloatArray:
    """The paper's first experiment: speaker and pose free in every frame."""
    return _shapes(fold.model, *_free_weights(fold))


def experiment_2(fold: Fold) -> FloatArray:
    """The paper's second experiment: the speaker is the mean of experiment 1's."""
    return _with_fixed_speaker(fold, _free_weights(fold)[0].mean(axis=0))


def joint_speaker(fold: Fold, robust: bool = False) -> FloatArray:
    """One speaker for all frames at once (`anatomy`), then the poses as in experiment 2."""
    estimate = estimate_speaker(fold.model.at(fold.vertices), ENERGY, fold.coils, robust=robust)
    return _with_fixed_speaker(fold, estimate.weights)


def robust_joint_speaker(fold: Fold) -> FloatArray:
    """The same with outlying samples weighed down: what a live run estimates."""
    return joint_speaker(fold, robust=True)


def speaker_from_meshes(fold: Fold) -> FloatArray:
    """Experiment 2 with the speaker fitted to the true meshes, as `tonguetrack anatomy --mesh` does (`fit_shapes`): what
    a scan of the speaker is worth."""
    fit = fit_shapes(fold.model, fold.truth.reshape(len(fold.truth), -1, 3), ENERGY.box)
    return _with_fixed_speaker(fold, fit.speaker)


def gaussian_posterior(fold: Fold) -> FloatArray:
    """The linear Gaussian posterior of the pooled training shapes (`posterior`); no tracking energy, no model."""
    noise_mm = max(fold.noise_mm, LEAST_POSTERIOR_NOISE_MM)
    return posterior_from_shapes(fold.training, fold.vertices, noise_mm).shapes(fold.coils)


def swept_fit(fold: Fold) -> FloatArray:
    """One speaker fitted to the whole true meshes by 40 sweeps of alternating least squares, without a box."""
    core, truth = _reduced(fold.model, fold.truth)
    speaker: FloatArray = fold.model.speaker.mean
    poses: FloatArray = np.zeros((0, 0))
    for _ in range(SWEEPS):
        poses = np.asarray(np.linalg.lstsq(np.tensordot(speaker, core, 1).T, truth.T, rcond=None)[0].T)
        slopes = np.einsum("tk,lkr->trl", poses, core).reshape(-1, len(core))
        speaker = np.asarray(np.linalg.lstsq(slopes, truth.ravel(), rcond=None)[0])
    return _shapes(fold.model, np.broadcast_to(speaker, (len(truth), len(speaker))), poses)


def best_fit(fold: Fold) -> FloatArray:
    """One speaker and the poses with the least squared distance to the whole true meshes, in the tracker's box."""
    core, truth = _reduced(fold.model, fold.truth)
    reduced = replace(
        fold.model,
        core=core,
        origin=np.zeros(core.shape[2]),
        faces=np.zeros((0, 3), np.int32),
        marks=SurfaceMarks(),
    )
    # Three coordinates of the basis make a coil: the joint estimate then is that of the whole mesh.
    estimator = SpeakerEstimator(reduced, DATA_ONLY, len(truth))
    estimate = estimator.estimate(truth.reshape(len(truth), -1, 3), robust=False)
    assert estimate is not None  # meshes are complete
    poses = estimator.poses
    return _shapes(fold.model, np.broadcast_to(estimate.weights, (len(poses), len(estimate.weights))), poses)


LOWER_BRACKET = "best fit"
UPPER_BRACKET = "mean shape"
ESTIMATORS: Mapping[str, Callable[[Fold], FloatArray]] = {
    UPPER_BRACKET: mean_shape,
    "experiment 1": experiment_1,
    "experiment 2": experiment_2,
    "joint speaker": joint_speaker,
    "joint speaker, robust": robust_joint_speaker,
    "speaker from meshes": speaker_from_meshes,
    "Gaussian posterior": gaussian_posterior,
    f"best fit, {SWEEPS} sweeps": swept_fit,
    LOWER_BRACKET: best_fit,
}


def _shapes(model: TongueModel, speakers: FloatArray, poses: FloatArray) -> FloatArray:
    """(T, k) mm for raw weights (T, m) and (T, n)."""
    offsets = np.einsum("tl,tk,lkr->tr", speakers, poses, model.core, optimize=True)
    return np.asarray(model.origin + offsets)


def _free_weights(fold: Fold) -> tuple[FloatArray, FloatArray]:
    """(T, m) speaker and (T, n) pose weights of experiment 1."""
    solver = FreeSpeakerSolver(fold.model.at(fold.vertices), ENERGY)
    found = _each_frame_by_itself(solver, fold.coils)
    size = fold.model.speaker.size
    return found[:, :size], found[:, size:]


def _with_fixed_speaker(fold: Fold, weights: FloatArray) -> FloatArray:
    """(T, k) mm: experiment 2 with these speaker weights (m,)."""
    speaker = fold.model.for_speaker(weights)
    poses = _each_frame_by_itself(FixedSpeakerSolver(speaker.at(fold.vertices), ENERGY), fold.coils)
    return np.asarray(speaker.base + poses @ speaker.directions)


def _each_frame_by_itself(solver: FreeSpeakerSolver | FixedSpeakerSolver, coils: FloatArray) -> FloatArray:
    """(T, w) weights, every frame begun at the mean: what comes before a phone must not tell."""
    found = np.empty((len(coils), len(solver.weights)))
    for frame, positions in enumerate(coils):
        solver.reset()
        solver.solve(positions)
        found[frame] = solver.weights
    return found


def _reduced(model: TongueModel, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The core (m, n, r) and the truth (T, r) in an orthonormal basis of what the model can express, r a multiple of 3.

    What is orthogonal to it no weights change, so that least squares over r coordinates are those over the mesh.
    """
    m, n, k = model.core.shape
    basis = np.linalg.qr(model.core.reshape(m * n, k).T)[0]
    basis = np.pad(basis, ((0, 0), (0, -basis.shape[1] % 3)))
    return model.core @ basis, np.ascontiguousarray((truth - model.origin) @ basis)


# Folds ------------------------------------------------------------------------------------------------


def evaluate(
    shapes: TrainingShapes,
    plan: Plan,
    regions: Mapping[str, Sequence[int]],
    progress: Callable[[Sequence[int]], Iterable[int]] = lambda speakers: speakers,
) -> Evaluation:
    """Every estimator on every speaker left out, by the procedure of the module's docstring. Deterministic.

    regions: name -> vertices; progress: hands the speakers' numbers on, and may show where it stands.
    Raises InputError where plan, regions and shapes contradict each other.
    """
    _check(shapes, plan, regions)
    measured = _measured(shapes)
    areas: dict[str, Sequence[int]] = {WHOLE_MESH: range(shapes.tensor.shape[2] // 3), **regions}
    areas[COILS] = plan.coils
    errors = {name: np.full((*measured.shape, len(areas)), np.nan) for name in ESTIMATORS}
    for speaker in progress(range(len(shapes.speakers))):
        phones = np.flatnonzero(measured[speaker])
        truth = shapes.tensor[speaker, phones]
        random = np.random.default_rng([plan.seed, speaker])
        places = truth.reshape(len(phones), -1, 3)[:, plan.coils]
        noisy = places + random.normal(scale=plan.noise_mm, size=places.shape)
        coils = np.array(noisy, order="C")  # as the kernels are compiled for
        groups: list[tuple[int | None, list[int]]] = [(None, list(range(len(phones))))]
        if plan.leave_phone_out:
            groups = [(int(phone), [row]) for row, phone in enumerate(phones)]
        for left_out, rows in groups:
            training = training_without(shapes, speaker, left_out)
            model = model_from_shapes(training, plan.speaker_modes, plan.pose_modes)
            pooled = training.tensor[_measured(training)]
            fold = Fold(model, pooled, plan.coils, coils, plan.noise_mm, truth)
            for name, estimator in ESTIMATORS.items():
                distances = vertex_distances(estimator(fold)[rows], truth[rows])
                for part, vertices in enumerate(areas.values()):
                    errors[name][speaker, phones[rows], part] = distances[:, list(vertices)].mean(axis=1)
    return Evaluation(plan, shapes.speakers, shapes.prompts, tuple(areas), errors)


def training_without(shapes: TrainingShapes, speaker: int, phone: int | None) -> TrainingShapes:
    """The shapes of all other speakers (and, unless None, of all other phones), their missing cells filled anew: an
    average must know nothing of what is left out.

    Raises InputError where nothing is left to fill a cell from.
    """
    others = [i for i in range(len(shapes.speakers)) if i != speaker]
    phones = [j for j in range(len(shapes.prompts)) if j != phone]
    tensor = shapes.tensor[np.ix_(others, phones)]
    present = _measured(shapes)[np.ix_(others, phones)]
    speakers = tuple(shapes.speakers[i] for i in others)
    prompts = tuple(shapes.prompts[j] for j in phones)
    lacking = [f"the speaker '{speakers[i]}'" for i in range(len(speakers)) if not present[i].any()]
    lacking += [f"the phone '{prompts[j]}'" for j in range(len(prompts)) if not present[:, j].any()]
    if lacking:
        left_out = f"the speaker '{shapes.speakers[speaker]}'"
        left_out += "" if phone is None else f" and the phone '{shapes.prompts[phone]}'"
        raise InputError(
            f"{_source(shapes)}: without {left_out} no mesh of {lacking[0]} is left; add one to the database, "
            "or remove the entry."
        )
    tensor[~present] = np.nan
    complete, missing = fill_missing_by_averaging(tensor)
    filled = tuple((speakers[i], prompts[j]) for i, j in missing)
    return replace(shapes, tensor=complete, speakers=speakers, prompts=prompts, filled=filled)


def vertex_distances(shapes: FloatArray, truth: FloatArray) -> FloatArray:
    """(T, V) mm between the corresponding vertices of shapes and truth, both (T, k)."""
    return np.asarray(np.linalg.norm((shapes - truth).reshape(len(shapes), -1, 3), axis=2))


def _measured(shapes: TrainingShapes) -> NDArray[np.bool_]:
    """(speakers, prompts): which cells are meshes, not averages."""
    measured = np.ones(shapes.tensor.shape[:2], dtype=bool)
    for speaker, prompt in shapes.filled:
        measured[shapes.speakers.index(speaker), shapes.prompts.index(prompt)] = False
    return measured


def _source(shapes: TrainingShapes) -> str:
    return shapes.provenance.get("source", "the training shapes")


def _check(shapes: TrainingShapes, plan: Plan, regions: Mapping[str, Sequence[int]]) -> None:
    count = shapes.tensor.shape[2] // 3
    for where, vertices in {
        "--coils": plan.coils,
        **{f"region '{r}'": v for r, v in regions.items()},
    }.items():
        for vertex in vertices:
            if not 0 <= vertex < count:
                raise InputError(
                    f"{where} names vertex {vertex}; the meshes of {_source(shapes)} have vertices 0 to {count - 1}."
                )
    left = {"speaker": len(shapes.speakers) - 1, "phone": len(shapes.prompts) - plan.leave_phone_out}
    for what, rest in left.items():
        if rest < 1:
            raise InputError(
                f"{_source(shapes)}: with one {what} left out nothing remains to build a model from; "
                f"expected at least two {what}s."
            )
    for flag, wanted, what in (
        ("--speaker-modes", plan.speaker_modes, "speaker"),
        ("--pose-modes", plan.pose_modes, "phone"),
    ):
        if not 1 <= wanted <= left[what]:
            raise InputError(
                f"{flag} {wanted}: expected a number from 1 to {left[what]}, the {what}s that each model is built from."
            )
