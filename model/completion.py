"""Cells that a data set lacks: a phone of a speaker without a scan, or with one that failed.

Three ways to fill them, for tensors (speakers, poses, k) in mm, an absent cell marked by NaN:

    averaging   `build.fill_missing_by_averaging`: the mean of the speaker's and the pose's mean shapes (the paper's)
    additive    grand mean + what the speaker adds + what the pose adds, least squares over the measured cells
    low rank    additive + what is left, completed to the least rank: of all tensors that agree with it in the measured
                cells the one with the least sum of the nuclear norms of the speaker and pose unfoldings (HALRTC without
                the vertex mode, which a cell lacks as a whole; Liu et al., PAMI 35, 2013, that the paper names)

The nuclear norm of the shapes themselves would pull absent cells towards the grand mean; of what the additive fit
leaves it pulls them towards the additive fit, and adds only what several speakers and poses have in common. Which of
the three is nearest to the truth depends on the data: `held_out_errors` measures it on them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from .build import TrainingShapes, fill_missing_by_averaging
from .mesh import FloatArray, vertex_distances
from .tensor import unfold

MODES = (0, 1)
SHARE = 1.0 / len(MODES)  # of each nuclear norm in the sum
PENALTY = (
    3.0  # of the descent, in units of one over a typical singular value; the result does not depend on it
)
SETTLED = 1e-6  # relative change, and disagreement of the unfoldings, at which the descent ends
MOST_STEPS = 5000
FOLDS = 10


@dataclass(frozen=True)
class Completion:
    """tensor: (speakers, poses, k) mm, complete; missing: the cells that were filled; settled: whether the descent came
    to its end within MOST_STEPS."""

    tensor: FloatArray
    missing: tuple[tuple[int, int], ...]
    settled: bool


@dataclass(frozen=True)
class HeldOut:
    """cells: (c, 2) the measured cells, each of which was absent once; errors_mm: way -> (c,) mean distance of the
    filled mesh's vertices to the measured one's."""

    cells: NDArray[np.intp]
    errors_mm: Mapping[str, FloatArray]

    @property
    def means_mm(self) -> dict[str, float]:
        """Way -> mean over the cells."""
        return {way: float(errors.mean()) for way, errors in self.errors_mm.items()}


def fill_missing_additively(tensor: FloatArray) -> FloatArray:
    """The tensor with its absent cells (NaN) filled by the additive fit. Raises InputError as `fill_missing_by_averaging`."""
    present = _present(tensor)
    return np.where(present[..., None], tensor, _additive(tensor, present))


def fill_missing_by_low_rank(tensor: FloatArray) -> Completion:
    """The tensor with its absent cells (NaN) filled by low-rank completion of what the additive fit leaves.

    Raises InputError as `fill_missing_by_averaging`.
    """
    present = _present(tensor)
    missing = tuple((int(i), int(j)) for i, j in np.argwhere(~present))
    if not missing:
        return Completion(tensor.copy(), (), True)
    additive = _additive(tensor, present)
    left = tensor[present] - additive[present]
    # Orthonormal rows that span all that is left: the norms are the same in them, and there are few.
    values, vectors = np.linalg.eigh(left @ left.T)
    kept = values > max(values[-1], 0.0) * 1e-13
    if not kept.any():
        return Completion(np.where(present[..., None], tensor, additive), missing, True)
    basis = (vectors[:, kept] / np.sqrt(values[kept])).T @ left
    reduced = np.zeros((*present.shape, int(kept.sum())))
    reduced[present] = left @ basis.T
    completed, settled = _least_rank(reduced, present)
    return Completion(np.where(present[..., None], tensor, additive + completed @ basis), missing, settled)


def held_out_errors(tensor: FloatArray, seed: int = 1) -> HeldOut:
    """How near each way comes to measured cells that it is not shown: in ten folds, a tenth of them absent in each.

    Folds are drawn so that every speaker and every pose keeps a cell. Raises InputError where that cannot be.
    """
    present = _present(tensor)
    errors: dict[str, list[FloatArray]] = {"averaging": [], "additive": [], "low rank": []}
    folds = _folds(present, np.random.default_rng(seed))
    for cells in folds:
        spoiled = tensor.copy()
        spoiled[cells[:, 0], cells[:, 1]] = np.nan
        filled = (
            fill_missing_by_averaging(spoiled)[0],
            fill_missing_additively(spoiled),
            fill_missing_by_low_rank(spoiled).tensor,
        )
        for way, found in zip(errors, filled, strict=True):
            rows = (found[cells[:, 0], cells[:, 1]], tensor[cells[:, 0], cells[:, 1]])
            errors[way].append(vertex_distances(*rows).mean(axis=1))
    return HeldOut(np.concatenate(folds), {way: np.concatenate(found) for way, found in errors.items()})


def training_without(shapes: TrainingShapes, speaker: int | None, phone: int | None) -> TrainingShapes:
    """The shapes of all other speakers and phones (None: of all), their missing cells filled anew by averaging: an
    average must know nothing of what is left out.

    Raises InputError where nothing is left to fill a cell from.
    """
    others = [i for i in range(len(shapes.speakers)) if i != speaker]
    phones = [j for j in range(len(shapes.prompts)) if j != phone]
    tensor = shapes.tensor[np.ix_(others, phones)]
    present = shapes.measured[np.ix_(others, phones)]
    speakers = tuple(shapes.speakers[i] for i in others)
    prompts = tuple(shapes.prompts[j] for j in phones)
    lacking = [f"the speaker '{speakers[i]}'" for i in range(len(speakers)) if not present[i].any()]
    lacking += [f"the phone '{prompts[j]}'" for j in range(len(prompts)) if not present[:, j].any()]
    if lacking:
        left_out = [] if speaker is None else [f"the speaker '{shapes.speakers[speaker]}'"]
        left_out += [] if phone is None else [f"the phone '{shapes.prompts[phone]}'"]
        raise InputError(
            f"{shapes.source}: without {' and '.join(left_out)} no mesh of {lacking[0]} is left; add one to the "
            "database, or remove the entry."
        )
    tensor[~present] = np.nan
    complete, missing = fill_missing_by_averaging(tensor)
    filled = tuple((speakers[i], prompts[j]) for i, j in missing)
    return replace(shapes, tensor=complete, speakers=speakers, prompts=prompts, filled=filled)


# The steps --------------------------------------------------------------------------------------------


def _present(tensor: FloatArray) -> NDArray[np.bool_]:
    """(speakers, poses). Raises InputError where a speaker or a pose has no cell at all."""
    present = np.asarray(~np.isnan(tensor).any(axis=2))
    for axis, what in ((1, "speaker"), (0, "pose")):
        if not present.any(axis=axis).all():
            empty = int(np.argmin(present.any(axis=axis)))
            raise InputError(
                f"{what} {empty} (counted from 0) has no mesh at all, so nothing tells its shapes."
            )
    return present


def _additive(tensor: FloatArray, present: NDArray[np.bool_]) -> FloatArray:
    """(speakers, poses, k): mean + speaker + pose, everywhere; of several best fits the one with the least effects."""
    speakers, poses = present.shape
    cells = np.argwhere(present)
    design = np.zeros((len(cells), speakers + poses))
    design[np.arange(len(cells)), cells[:, 0]] = 1.0
    design[np.arange(len(cells)), speakers + cells[:, 1]] = 1.0
    mean = tensor[present].mean(axis=0)
    effects = np.linalg.pinv(design) @ (tensor[present] - mean)
    return np.asarray(mean + effects[:speakers, None] + effects[None, speakers:])


def _least_rank(known: FloatArray, present: NDArray[np.bool_]) -> tuple[FloatArray, bool]:
    """The tensor (speakers, poses, r) that equals known where present, with the least sum of nuclear norms; whether it
    settled. By the alternating direction method of multipliers, each unfolding shrunk by itself."""
    penalty = PENALTY * np.sqrt(len(known)) / np.linalg.norm(known)
    here = present[..., None]
    found = known.copy()
    multipliers = [np.zeros_like(known) for _ in MODES]
    for _ in range(MOST_STEPS):
        shrunk = [_shrunk(found + multipliers[mode] / penalty, mode, SHARE / penalty) for mode in MODES]
        mean = np.mean([shrunk[mode] - multipliers[mode] / penalty for mode in MODES], axis=0)
        previous, found = found, np.where(here, known, mean)
        for mode in MODES:
            multipliers[mode] = multipliers[mode] - penalty * (shrunk[mode] - found)
        moved = [np.linalg.norm(found - previous), *(np.linalg.norm(part - found) for part in shrunk)]
        if max(moved) <= SETTLED * np.linalg.norm(found):
            return found, True
    return found, False


def _shrunk(tensor: FloatArray, mode: int, by: float) -> FloatArray:
    """The singular values of an unfolding made smaller by so much, none below 0."""
    unfolded = unfold(tensor, mode)
    squares, vectors = np.linalg.eigh(unfolded @ unfolded.T)
    values = np.sqrt(np.maximum(squares, 1e-300))
    matrix = (vectors * np.maximum(1.0 - by / values, 0.0)) @ (vectors.T @ unfolded)
    kept = np.moveaxis(tensor, mode, 0).shape
    return np.moveaxis(matrix.reshape(kept), 0, mode)


def _folds(present: NDArray[np.bool_], random: np.random.Generator) -> list[NDArray[np.intp]]:
    """The measured cells (each (cells, 2)) in FOLDS parts, none of which empties a speaker or a pose."""
    waiting = [(int(i), int(j)) for i, j in random.permutation(np.argwhere(present))]
    folds: list[list[tuple[int, int]]] = [[] for _ in range(min(FOLDS, len(waiting)))]
    rest = [present.copy() for _ in folds]
    for speaker, pose in waiting:
        for fold in sorted(range(len(folds)), key=lambda fold: len(folds[fold])):
            if rest[fold][speaker].sum() > 1 and rest[fold][:, pose].sum() > 1:
                folds[fold].append((speaker, pose))
                rest[fold][speaker, pose] = False
                break
        else:
            raise InputError(
                f"speaker {speaker} and pose {pose} (counted from 0) cannot both be kept without the cell that they "
                "share; nothing can be held out of so few meshes."
            )
    return [np.array(cells, dtype=np.intp) for cells in folds if cells]
