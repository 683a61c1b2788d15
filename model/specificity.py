"""Specificity: how far random shapes of a model are from real ones (paper, section "Model analysis").

Weights of both modes are drawn from the normal distribution that the training weights have (their mean and covariance
over the training entries); the shape that they make is compared with every training mesh on a region of its vertices; the
error is the mean distance of corresponding vertices to the nearest mesh. For 1, 2, ... components of one mode, the other
held at a fixed number. For one fixed phone the pose is that phone's, and only its meshes are compared with.

Only the region's vertices are ever made, in batches: products of the weights times the core, which is a matrix product,
then `nearest`. Each part of the samples has a generator of its own, seeded by what it is, so that the result depends on
neither the number of processes nor their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import InputError
from .build import TrainingShapes, model_from_shapes
from .curves import Curve, Progress, run_all, silent
from .generalisation import POSE, SPEAKER
from .mesh import FloatArray
from .multilinear import Mode, TongueModel
from .nearest import Float32Array, NearestMesh

SAMPLES = 1_000_000  # a row, as in the paper
PART = 50_000  # samples of one task
BATCH = 256  # samples of one matrix product: what it makes stays in the processor's cache


@dataclass(frozen=True)
class Draw:
    """A normal distribution of weights. mean: (w,); factor: (w, w), its product with its transpose is the covariance."""

    mean: FloatArray
    factor: FloatArray

    def sample(self, random: np.random.Generator, count: int) -> FloatArray:
        """(count, w)"""
        return np.asarray(self.mean + random.standard_normal((count, len(self.mean))) @ self.factor.T)


@dataclass(frozen=True)
class Row:
    """Everything that one row of samples needs.

    draws: of the speaker's and the pose's weights, m and n; core: (m n, 3 V) float32 mm, x of all vertices of the region,
    then y, then z, relative to the mean shape; group_core: (m n, 3 g), the same for the means over groups of vertices;
    nearest: the meshes to compare with, relative to the mean shape, too; seed: what tells this row from all others.
    """

    draws: tuple[Draw, Draw]
    core: Float32Array
    group_core: Float32Array
    nearest: NearestMesh
    seed: tuple[int, ...]

    def errors(self, random: np.random.Generator, count: int) -> Float32Array:
        """(count,) mm, of so many samples."""
        return self.nearest.errors(*self.shapes(random, count))

    def shapes(self, random: np.random.Generator, count: int) -> tuple[Float32Array, Float32Array]:
        """(count, 3, V) and (count, 3, g) mm: so many samples, and their means over the groups."""
        speaker, pose = (draw.sample(random, count) for draw in self.draws)
        products = (speaker[:, :, None] * pose[:, None, :]).reshape(count, -1).astype(np.float32)
        shapes = (products @ self.core).reshape(count, 3, -1)
        return shapes, (products @ self.group_core).reshape(count, 3, -1)


def specificity(
    shapes: TrainingShapes,
    mode: str,
    held: int,
    region: Sequence[int],
    samples: int = SAMPLES,
    seed: int = 1,
    jobs: int = -1,
    progress: Progress = silent,
) -> Curve:
    """Over 1 .. entries components of the mode ("speaker" or "pose"), `held` of the other; samples: for each of them.

    region: the vertices. Cells that were filled are no real meshes and not compared with. Raises InputError for a region
    without vertices or with others than the meshes', for no samples, and where the mode that is held has fewer entries.
    """
    rows = specificity_rows(shapes, mode, held, region, seed)
    return _sampled(rows, samples, jobs, progress, f"specificity, {mode} mode")


def specificity_rows(
    shapes: TrainingShapes, mode: str, held: int, region: Sequence[int], seed: int = 1
) -> list[Row]:
    """What `specificity` draws from, a row for each number of components."""
    model = _whole_model(shapes, region, held, (POSE, SPEAKER)[mode == POSE])
    meshes = _at(shapes.tensor[shapes.measured] - model.origin, region)
    nearest = NearestMesh.among(meshes, _at(model.origin, region))
    sizes: list[tuple[int, int]] = (
        [(m, held) for m in range(1, model.speaker.size + 1)]
        if mode == SPEAKER
        else [(held, n) for n in range(1, model.pose.size + 1)]
    )
    rows = []
    for m, n in sizes:
        draws = _draw(model.speaker, m), _draw(model.pose, n)
        rows.append(_row(draws, _at(model.core[:m, :n], region), nearest, (seed, int(mode == POSE), m, n)))
    return rows


def phone_specificity(
    shapes: TrainingShapes,
    prompt: str,
    held: int,
    region: Sequence[int],
    samples: int = SAMPLES,
    seed: int = 1,
    jobs: int = -1,
    progress: Progress = silent,
) -> Curve:
    """With the pose of this phone, for 1 .. speakers components of the speaker mode, `held` of the pose mode.

    Raises InputError as `specificity`, and for a phone that the shapes lack.
    """
    if prompt not in shapes.prompts:
        raise InputError(f"there is no phone '{prompt}'; {shapes.source} has {', '.join(shapes.prompts)}.")
    phone = shapes.prompts.index(prompt)
    model = _whole_model(shapes, region, held, POSE)
    meshes = _at(shapes.tensor[shapes.measured[:, phone], phone] - model.origin, region)
    nearest = NearestMesh.among(meshes, _at(model.origin, region))
    assert model.pose.training is not None
    pose = model.pose.training[phone, :held]
    core = np.einsum("n,mnva->mva", pose, _at(model.core[:, :held], region))[:, None]
    always = Draw(np.ones(1), np.zeros((1, 1)))
    rows = [
        _row((_draw(model.speaker, m), always), core[:m], nearest, (seed, 2 + phone, m, held))
        for m in range(1, model.speaker.size + 1)
    ]
    return _sampled(rows, samples, jobs, progress, f"specificity of [{prompt}]")


def check_region(shapes: TrainingShapes, region: Sequence[int]) -> None:
    """Raises InputError for a region without vertices, or with others than the meshes'."""
    count = shapes.tensor.shape[2] // 3
    if not region:
        raise InputError("specificity needs a region with at least one vertex.")
    for vertex in region:
        if not 0 <= vertex < count:
            raise InputError(
                f"the region names vertex {vertex}; the meshes of {shapes.source} have vertices 0 to {count - 1}."
            )


# Rows -------------------------------------------------------------------------------------------------


def _whole_model(shapes: TrainingShapes, region: Sequence[int], held: int, held_mode: str) -> TongueModel:
    check_region(shapes, region)
    most = dict(zip((SPEAKER, POSE), shapes.tensor.shape, strict=False))[held_mode]
    if not 1 <= held <= most:
        raise InputError(f"specificity holds {held} {held_mode} components; expected 1 to {most}.")
    return model_from_shapes(shapes, *shapes.tensor.shape[:2])


def _at(coordinates: FloatArray, region: Sequence[int]) -> FloatArray:
    """(..., k) as (..., V, 3), of the region's vertices."""
    return np.asarray(coordinates.reshape(*coordinates.shape[:-1], -1, 3)[..., list(region), :])


def _draw(mode: Mode, size: int) -> Draw:
    """Of the first so many weights of the training entries."""
    assert mode.training is not None
    training = mode.training[:, :size]
    values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(training, rowvar=False, bias=True)))
    return Draw(training.mean(axis=0), vectors * np.sqrt(np.maximum(values, 0.0)))


def _row(draws: tuple[Draw, Draw], core: FloatArray, nearest: NearestMesh, seed: tuple[int, ...]) -> Row:
    """core: (m, n, V, 3) mm."""
    apart = np.moveaxis(core, -1, -2).reshape(-1, 3, core.shape[-2])
    flat, grouped = (
        np.ascontiguousarray(part.reshape(len(apart), -1), dtype=np.float32)
        for part in (apart, apart @ nearest.grouping)
    )
    return Row(draws, flat, grouped, nearest, seed)


# Samples ----------------------------------------------------------------------------------------------


def _sampled(rows: Sequence[Row], samples: int, jobs: int, progress: Progress, heading: str) -> Curve:
    if samples < 1:
        raise InputError(f"specificity of {samples} samples says nothing; expected 1 or more.")
    parts = [min(PART, samples - start) for start in range(0, samples, PART)]
    tasks = [(row, number, count) for row in rows for number, count in enumerate(parts)]
    _compile(rows[0])
    sums = np.array(run_all(_moments, tasks, jobs, progress, heading)).reshape(len(rows), len(parts), 2)
    first, second = sums.sum(axis=1).T / samples
    deviation = np.sqrt(np.maximum(second - first**2, 0.0))
    return Curve(first, deviation, np.full(len(rows), samples))


def _moments(task: tuple[Row, int, int]) -> tuple[float, float]:
    """The sums of the errors and of their squares, of one part of a row's samples."""
    row, number, count = task
    random = np.random.default_rng([*row.seed, number])
    first = second = 0.0
    for start in range(0, count, BATCH):
        errors = row.errors(random, min(BATCH, count - start)).astype(np.float64)
        first += float(errors.sum())
        second += float(errors @ errors)
    return first, second


def _compile(row: Row) -> None:
    """Once, here, so that the processes find it in the cache and do not all compile."""
    row.errors(np.random.default_rng(0), 1)
