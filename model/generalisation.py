"""Generalisation: how near a model comes to the meshes of a speaker, or of a phone, that it was built without.

(Paper, section "Model analysis".) Each speaker, or phone, is left out in turn; a model is built from the meshes of the
others, for 1, 2, ... components of the mode in question, the other mode held at a fixed number; and it is fitted to
every mesh that was left out, vertex by vertex, in a box of h sigma. Measured is the mean distance of corresponding vertices.

The fit is the one by which the authors' program measures, so that figures can be compared with theirs:

    E(s, p) = 1/V sum_v |v(s, p) - q_v|^2,    |w - mean| <= h / sqrt(entries) for every weight w

descended by L-BFGS-B (5 corrections, relative decrease 1e7 machine epsilons, projected slope 1e-5) from the mean weights.
E is not convex, and this descent ends in a local minimum. `fitting.fit_shapes` looks further and comes lower, and its bounds
are the training weights' own deviations; its figures would flatter a model beside published ones.

All truncations of one model share one Gram matrix, of which each takes a block; no descent sees a vertex.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import InputError
from .build import TrainingShapes, model_from_shapes
from .completion import training_without
from .curves import Curve, Progress, run_all, silent
from .mesh import FloatArray, vertex_distances

SPEAKER, POSE = "speaker", "pose"
CORRECTIONS = 5
DECREASE = 1e7 * float(np.finfo(np.float64).eps)
SLOPE = 1e-5
MOST_EVALUATIONS = 1000


@dataclass(frozen=True)
class _LeftOut:
    """One entry of a mode, to be left out; the others as `generalisation`."""

    shapes: TrainingShapes
    mode: str
    entry: int
    held: int
    h: float


def generalisation(
    shapes: TrainingShapes,
    mode: str,
    held: int,
    h: float = 2.0,
    jobs: int = -1,
    progress: Progress = silent,
) -> Curve:
    """Over 1 .. entries - 1 components of the mode ("speaker" or "pose"), with `held` components of the other mode.

    h: the box in sigma = 1/sqrt(entries). Cells that were filled are no truth and not measured. Raises InputError where
    nothing remains to build a model from, or the other mode has fewer entries than are to be held.
    """
    axis = _axis(mode)
    entries, others = shapes.tensor.shape[axis], shapes.tensor.shape[1 - axis]
    if entries < 2:
        raise InputError(
            f"{shapes.source}: with its one {mode} left out nothing remains to build a model from; generalisation "
            "needs at least two."
        )
    if not 1 <= held <= others:
        other = (POSE, SPEAKER)[axis]
        raise InputError(
            f"generalisation of the {mode} mode holds {held} {other} components; expected 1 to {others}."
        )
    if not h > 0.0:
        raise InputError(f"the box of {h:g} sigma leaves no shape to fit; expected a number above 0.")
    tasks = [_LeftOut(shapes, mode, entry, held, h) for entry in range(entries)]
    found = run_all(_errors_without, tasks, jobs, progress, f"generalisation, {mode} mode")
    errors = np.concatenate(found, axis=1)
    return Curve(errors.mean(axis=1), errors.std(axis=1), np.full(len(errors), errors.shape[1]))


def _axis(mode: str) -> int:
    return (SPEAKER, POSE).index(mode)


def _errors_without(task: _LeftOut) -> FloatArray:
    """(components, meshes) mm: of every measured mesh of the entry that is left out."""
    shapes, axis = task.shapes, _axis(task.mode)
    entry = (task.entry, None) if axis == 0 else (None, task.entry)
    training = training_without(shapes, *entry)
    truth = np.take(shapes.tensor, task.entry, axis=axis)[np.take(shapes.measured, task.entry, axis=axis)]
    most = len(training.speakers), len(training.prompts)
    sizes = [(c, task.held) if axis == 0 else (task.held, c) for c in range(1, most[axis] + 1)]
    model = model_from_shapes(training, *sizes[-1])
    flat = model.core.reshape(-1, model.origin.size)
    gram = (flat @ flat.T / model.vertex_count).reshape(model.core.shape[:2] * 2)
    centred = truth - model.origin
    pulls = (centred @ flat.T / model.vertex_count).reshape(len(truth), *model.core.shape[:2])
    lengths = np.einsum("tk,tk->t", centred, centred) / model.vertex_count
    errors = np.empty((len(sizes), len(truth)))
    for row, (m, n) in enumerate(sizes):
        mean = np.concatenate([model.speaker.mean[:m], model.pose.mean[:n]])
        reach = task.h * np.concatenate([model.speaker.sigma[:m], model.pose.sigma[:n]])
        block = np.ascontiguousarray(gram[:m, :n, :m, :n]).reshape(m * n, m * n)
        core = model.core[:m, :n].reshape(m * n, -1)
        products = [
            _fitted(_energy(block, pull[:m, :n], length), mean, reach, m)
            for pull, length in zip(pulls, lengths, strict=True)
        ]
        errors[row] = vertex_distances(model.origin + np.array(products) @ core, truth).mean(axis=1)
    return errors


def _energy(
    gram: FloatArray, pull: FloatArray, length: float
) -> Callable[[FloatArray], tuple[float, FloatArray]]:
    """E and its slope at the flat weights (m + n,). gram: (m n, m n); pull: (m, n); length: E of no weights."""
    m, n = pull.shape

    def energy(weights: FloatArray) -> tuple[float, FloatArray]:
        speaker, pose = weights[:m], weights[m:]
        products = np.multiply.outer(speaker, pose)
        drawn = gram.dot(products.ravel()).reshape(m, n) - pull
        slope = np.empty(m + n)
        np.dot(drawn, pose, out=slope[:m])
        np.dot(speaker, drawn, out=slope[m:])
        slope *= 2.0
        return float(np.vdot(products, drawn - pull)) + length, slope

    return energy


def _fitted(
    energy: Callable[[FloatArray], tuple[float, FloatArray]], mean: FloatArray, reach: FloatArray, m: int
) -> FloatArray:
    """(m n,) the products of the speaker's and the pose's weights at which the descent from the mean ends."""
    from scipy.optimize import Bounds, minimize

    options: Any = {
        "maxcor": CORRECTIONS,
        "ftol": DECREASE,
        "gtol": SLOPE,
        "maxfun": MOST_EVALUATIONS,
        "maxiter": MOST_EVALUATIONS,
    }
    bounds = Bounds(mean - reach, mean + reach)
    found = minimize(energy, mean, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    return np.outer(found[:m], found[m:]).ravel()
