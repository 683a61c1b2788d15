"""Which vertex of the model each coil sits on (paper, section "Data selection and setup for experiments").

The paper's search, on one typical frame: random shapes of the model, each coil's nearest vertex on the
mid-sagittal upper surface, refit, nearest again, until nothing changes. The box is one sigma, so that the
shape cannot be bent to suit a wrong set. The paper keeps the set with the smallest mean distance on that
frame; one frame of three coils leaves several sets nearly equal, so the sets are compared over frames
spread through the recording, with one anatomy for all of them, and the best one is slid along the contour
while that helps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from ..model.midsagittal import midsagittal_vertices, upper_surface_vertices
from ..model.multilinear import TongueModel
from .coilmap import LATERAL_ROLES, TONGUE_ROLES
from .pose import FloatArray
from .session import Energy
from .solver import FixedSpeakerSolver, FreeSpeakerSolver

Places = tuple[int, ...]  # one candidate for each coil: an index into the contour, then the upper surface

TIP_TO_ROOT = TONGUE_ROLES[4]
BOX_WHILE_SEARCHING = 1.0
RANDOM_SHAPES = 60
MAX_REFITS = 20
COMPARED_FRAMES = 20
LONGEST_SLIDE = 8  # contour places
SEED = 20180901  # the search is random, its result must not be


@dataclass(frozen=True)
class Correspondences:
    """vertices (n,), in the coils' order; distances_mm (n,): mean distance of each coil from its vertex
    over the compared frames, fitted with one anatomy within one sigma."""

    roles: tuple[str, ...]
    vertices: tuple[int, ...]
    distances_mm: tuple[float, ...]

    def __str__(self) -> str:
        found = zip(self.roles, self.vertices, self.distances_mm, strict=True)
        return ", ".join(f"{role} = vertex {vertex} ({distance:.2f} mm)" for role, vertex, distance in found)


def typical_frame(coils: FloatArray) -> int:
    """Of the frames of coils (frames, n, 3) with every coil present, the one nearest to their median.

    Raises InputError where no frame has them all.
    """
    complete = complete_frames(coils)
    shapes = coils[complete].reshape(len(complete), -1)
    return int(complete[np.argmin(np.sum((shapes - np.median(shapes, axis=0)) ** 2, axis=1))])


def estimate_correspondences(
    model: TongueModel, coils: FloatArray, roles: Sequence[str], energy: Energy
) -> Correspondences:
    """Correspondences from prepared coils (frames, n, 3), mm in the model frame; roles in the same order.

    Mid-sagittal coils keep the order of their roles along the contour, tip to root (roles of one's own
    naming: the order given); a lateral coil may sit anywhere on the upper surface. Deterministic.
    """
    contour = midsagittal_vertices(model)
    lateral = [index for index, role in enumerate(roles) if role in LATERAL_ROLES]
    middle = [index for index in range(len(roles)) if index not in lateral]
    if all(roles[index] in TIP_TO_ROOT for index in middle):
        middle.sort(key=lambda index: TIP_TO_ROOT.index(roles[index]))
    if len(contour) < len(middle):
        raise InputError(
            f"the model '{model.name}' has {len(contour)} vertices of its upper surface near the plane x = 0, too "
            f"few for {len(middle)} coils; state the vertices in the session's [correspondences]."
        )
    surface = upper_surface_vertices(model) if lateral else np.zeros(0, dtype=np.intp)
    places = np.concatenate([contour, surface])
    search = _Search(model.at([int(vertex) for vertex in places]), replace(energy, box=BOX_WHILE_SEARCHING))

    def nearest(shape: FloatArray, target: FloatArray) -> Places:
        chosen = np.zeros(len(roles), dtype=np.intp)
        if middle:
            chosen[middle] = ordered_nearest(shape[: len(contour)], target[middle])
        for index in lateral:
            apart = np.linalg.norm(shape[len(contour) :] - target[index], axis=1)
            chosen[index] = len(contour) + int(np.argmin(apart))
        return tuple(int(place) for place in chosen)

    target = coils[typical_frame(coils)]
    complete = complete_frames(coils)
    spread = np.unique(np.linspace(0, len(complete) - 1, COMPARED_FRAMES).astype(int))
    frames = np.ascontiguousarray(coils[complete[spread]])
    best = min(
        (search.settled(start, target, nearest) for start in search.random_starts()),
        key=lambda chosen: search.mean_distances(chosen, frames).mean(),
    )
    best = slid_along_contour(
        best, middle, len(contour), lambda c: float(search.mean_distances(c, frames).mean())
    )
    return Correspondences(
        tuple(roles),
        tuple(int(places[place]) for place in best),
        tuple(float(distance) for distance in search.mean_distances(best, frames)),
    )


class _Search:
    """Fits of the model, seen only at the candidate places, remembered by the set of places."""

    def __init__(self, candidates: TongueModel, energy: Energy) -> None:
        self._candidates = candidates
        self._energy = energy
        self._distances: dict[Places, FloatArray] = {}

    def random_starts(self) -> FloatArray:
        """(RANDOM_SHAPES, m + n) weights, uniform within one sigma of the mean."""
        model = self._candidates
        mean = np.concatenate([model.speaker.mean, model.pose.mean])
        sigma = np.concatenate([model.speaker.sigma, model.pose.sigma])
        random = np.random.default_rng(SEED)
        return np.asarray(mean + sigma * random.uniform(-1.0, 1.0, (RANDOM_SHAPES, len(mean))))

    def settled(
        self, weights: FloatArray, target: FloatArray, nearest: Callable[[FloatArray, FloatArray], Places]
    ) -> Places:
        """The set of places at which choosing the nearest and refitting come to rest."""
        model = self._candidates
        chosen: Places = ()
        for _ in range(MAX_REFITS):
            shape = model.vertices(weights[: model.speaker.size], weights[model.speaker.size :])
            found = nearest(shape, target)
            if found == chosen:
                break
            chosen = found
            solver = FreeSpeakerSolver(model.at(chosen), self._energy)
            solver.solve(target)
            weights = solver.weights
        return chosen

    def mean_distances(self, chosen: Places, frames: FloatArray) -> FloatArray:
        """(n,) mean distance of each coil over the frames, all fitted with the anatomy that they agree on."""
        if chosen not in self._distances:
            at_coils = self._candidates.at(chosen)
            free = FreeSpeakerSolver(at_coils, self._energy)
            speakers = []
            for frame in frames:
                free.reset()
                free.solve(frame)
                speakers.append(free.speaker_weights.copy())
            fixed = FixedSpeakerSolver(at_coils.for_speaker(np.mean(speakers, axis=0)), self._energy)
            residuals = []
            for frame in frames:
                fixed.reset()
                fixed.solve(frame)
                residuals.append(fixed.residuals_mm.copy())
            self._distances[chosen] = np.mean(residuals, axis=0)
        return self._distances[chosen]


def slid_along_contour(
    best: Places, middle: Sequence[int], contour_length: int, cost: Callable[[Places], float]
) -> Places:
    """Moves one coil at a time along the contour, in halving strides, while the cost falls."""
    stride = LONGEST_SLIDE
    while stride:
        improved = False
        for index in middle:
            for move in (-stride, stride):
                trial = list(best)
                trial[index] += move
                order = [trial[i] for i in middle]
                inside = 0 <= trial[index] < contour_length
                if (
                    inside
                    and all(a < b for a, b in pairwise(order))
                    and cost(tuple(trial)) < cost(best) - 1e-9
                ):
                    best = tuple(trial)
                    improved = True
        if not improved:
            stride //= 2
    return best


def complete_frames(coils: FloatArray) -> NDArray[np.intp]:
    """Indices of the frames of coils (frames, n, 3) that have every coil. InputError where none has."""
    complete = np.flatnonzero(np.isfinite(coils).all(axis=(1, 2)))
    if len(complete) == 0:
        raise InputError(
            "no frame has all tongue coils, so correspondences cannot be estimated; state them in the session's "
            "[correspondences] or leave the dead coil out of [coils]."
        )
    return complete


def ordered_nearest(contour: FloatArray, coils: FloatArray) -> NDArray[np.intp]:
    """For coils (n, 3), ordered from tip to root, the indices into contour (c, 3), strictly increasing,
    with the smallest sum of distances (dynamic programming)."""
    distances = np.linalg.norm(contour[None, :, :] - coils[:, None, :], axis=2)  # (n, c)
    count, places = distances.shape
    total = distances[0].copy()
    came_from = np.zeros((count, places), dtype=np.intp)
    for coil in range(1, count):
        best_before = np.minimum.accumulate(total)
        where = np.maximum.accumulate(np.where(total <= best_before, np.arange(places), 0))
        total = np.full(places, np.inf)
        total[1:] = best_before[:-1] + distances[coil, 1:]
        came_from[coil, 1:] = where[:-1]
    path = np.zeros(count, dtype=np.intp)
    path[-1] = int(np.argmin(total))
    for coil in range(count - 1, 0, -1):
        path[coil - 1] = came_from[coil, path[coil]]
    return path
