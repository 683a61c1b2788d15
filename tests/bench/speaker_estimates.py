"""How well a speaker whom the model has never seen is known after some seconds of speech, by each estimator.

    python tests/bench/speaker_estimates.py PATH/sampleDatabase.yaml [--coils 3|5] [--noise 0.3] [--outlier-mm 8]
        [--region FILE.json]

Leaves one speaker out at a time. That speaker's true meshes, moved smoothly from phone to phone, carry three
coils along the mid-sagittal plane, or two more at the sides, with noise (mm, each coordinate) at 250 Hz. From 0.25, 1
and 3 s of it the speaker is estimated, also with 2 % of the coils' samples torn away by --outlier-mm; then the speaker is
fixed and each true phone tracked from undisturbed coils. Prints the mean distance in mm between tracked and true
vertices over all folds, with its standard error over the folds, and the mean difference to the paper's estimator in
the same folds with its own: over the whole mesh, and over the vertices {"indices": [...]} of the region's file.

"oracle" is the speaker fitted to all vertices of all true meshes, tracked from the coils; "best fit" the model's best
fit to each whole true mesh for that speaker, which no coils can better.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tonguetrack.model.build import (
    TrainingShapes,
    load_training_shapes,
    model_from_shapes,
    read_sample_database,
)
from tonguetrack.model.multilinear import TongueModel
from tonguetrack.tracker.anatomy import estimate_speaker
from tonguetrack.tracker.pose import FloatArray
from tonguetrack.tracker.session import Energy
from tonguetrack.tracker.solver import FixedSpeakerSolver, FreeSpeakerSolver

MIDSAGITTAL = [2465, 1912, 1250]  # of the Ultrax meshes, front to back
BESIDE_MM = 10.0
RATE_HZ, PHONE_S, MOVING_SHARE = 250.0, 0.15, 0.7
JOINT_SPACING = 5  # frames: 20 ms, as while tracking
DURATIONS_S = (0.25, 1.0, 3.0)
OUTLIERS = 0.02
TAKES = 4  # of each duration and fold
PAPER = "mean of frames"
DEFAULT = Energy()

Estimator = Callable[[TongueModel, FloatArray], FloatArray]


def mean_speaker(at_coils: TongueModel, coils: FloatArray) -> FloatArray:
    return at_coils.speaker.mean


def mean_of_frames(at_coils: TongueModel, coils: FloatArray) -> FloatArray:
    return (
        FreeSpeakerSolver(at_coils, DEFAULT).solve_all(coils).weights[:, : at_coils.speaker.size].mean(axis=0)
    )


def joint(at_coils: TongueModel, coils: FloatArray) -> FloatArray:
    return estimate_speaker(at_coils, DEFAULT, coils[::JOINT_SPACING], robust=False).weights


def joint_robust(at_coils: TongueModel, coils: FloatArray) -> FloatArray:
    return estimate_speaker(at_coils, DEFAULT, coils[::JOINT_SPACING]).weights


ESTIMATORS: dict[str, Estimator] = {
    "mean speaker": mean_speaker,
    PAPER: mean_of_frames,
    "joint": joint,
    "joint, robust": joint_robust,
}


def folds(shapes: TrainingShapes) -> Iterator[tuple[TongueModel, FloatArray]]:
    """The model of all speakers but one, and that one's meshes (phones, V, 3)."""
    for held_out in range(len(shapes.speakers)):
        keep = [i for i in range(len(shapes.speakers)) if i != held_out]
        names = tuple(shapes.speakers[i] for i in keep)
        others = TrainingShapes(shapes.tensor[keep], shapes.faces, names, shapes.prompts)
        yield model_from_shapes(others, 5, 4), shapes.tensor[held_out].reshape(len(shapes.prompts), -1, 3)


def coil_vertices(model: TongueModel, count: int) -> list[int]:
    """The mid-sagittal vertices; for five coils also those nearest to 10 mm left and right of the middle one."""
    mean = model.mean_vertices()
    beside = [mean[MIDSAGITTAL[1]] + [side, 0.0, 0.0] for side in (-BESIDE_MM, BESIDE_MM)]
    lateral = [int(np.argmin(np.linalg.norm(mean - place, axis=1))) for place in beside]
    return MIDSAGITTAL + (lateral if count == 5 else [])


def speech(places: FloatArray, seconds: float, random: np.random.Generator) -> FloatArray:
    """(frames, n, 3): the coils' places (phones, n, 3) in random order, held and smoothly changed."""
    times = np.arange(round(seconds * RATE_HZ)) / RATE_HZ / PHONE_S + random.random()
    phones = [p for _ in range(int(times[-1]) // len(places) + 2) for p in random.permutation(len(places))]
    index = times.astype(int)
    moved = np.clip((times - index - (1 - MOVING_SHARE)) / MOVING_SHARE, 0.0, 1.0)
    share = (0.5 - 0.5 * np.cos(np.pi * moved))[:, None, None]
    order = np.array(phones)
    return places[order[index]] * (1 - share) + places[order[index + 1]] * share


def torn(coils: FloatArray, far_mm: float, random: np.random.Generator) -> FloatArray:
    away = random.normal(size=coils.shape)
    away *= far_mm / np.linalg.norm(away, axis=2, keepdims=True)
    return coils + away * (random.random(coils.shape[:2]) < OUTLIERS)[:, :, None]


def tracked(
    model: TongueModel, weights: FloatArray, vertices: list[int], coils: FloatArray, energy: Energy = DEFAULT
) -> FloatArray:
    """(frames, V, 3): each frame on its own."""
    speaker = model.for_speaker(weights)
    solver = FixedSpeakerSolver(speaker.at(vertices), energy)
    meshes = []
    for frame in coils:
        solver.reset()
        solver.solve(np.ascontiguousarray(frame))
        meshes.append(speaker.vertices(solver.weights))
    return np.array(meshes)


def whole_fit(model: TongueModel, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The oracle's speaker weights, and the model's meshes nearest to the true ones for it."""
    free = Energy(beta_speaker=0.0, beta_pose=0.0, box=8.0)
    weights = estimate_speaker(model, free, truth, robust=False).weights
    return weights, tracked(model, weights, list(range(model.vertex_count)), truth, free)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("database")
    parser.add_argument("--coils", type=int, choices=(3, 5), default=3)
    parser.add_argument("--noise", type=float, default=0.3)
    parser.add_argument("--outlier-mm", type=float, default=8.0)
    parser.add_argument("--region")
    args = parser.parse_args()
    region = json.loads(Path(args.region).read_text())["indices"] if args.region else None
    errors: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(
        list
    )  # a value per part in every fold
    for fold, (model, truth) in enumerate(folds(load_training_shapes(read_sample_database(args.database)))):
        for row, values in fold_errors(model, truth, args, region, fold).items():
            errors[row].append(values)
    print_table(errors, ["whole mesh", "region"] if region else ["whole mesh"])


def fold_errors(
    model: TongueModel, truth: FloatArray, args: argparse.Namespace, region: list[int] | None, seed: int
) -> dict[tuple[str, str], tuple[float, ...]]:
    """(condition, estimator) -> mean distance over the whole mesh and, if there is one, over the region."""
    random = np.random.default_rng(seed)
    vertices = coil_vertices(model, args.coils)
    at_coils = model.at(vertices)
    heard = truth[:, vertices] + random.normal(0, args.noise, (len(truth), args.coils, 3))

    def distances(meshes: FloatArray) -> tuple[float, ...]:
        apart = np.linalg.norm(meshes - truth, axis=2)
        return (apart.mean(), *([apart[:, region].mean()] if region else []))

    oracle, nearest = whole_fit(model, truth)
    errors = {
        ("", "best fit"): distances(nearest),
        ("", "oracle"): distances(tracked(model, oracle, vertices, heard)),
    }
    for seconds in DURATIONS_S:
        taken = defaultdict(list)
        for _ in range(TAKES):
            clean = speech(truth[:, vertices], seconds, random)
            clean = clean + random.normal(0, args.noise, clean.shape)
            for name, coils in (
                (f"{seconds:g} s", clean),
                (f"{seconds:g} s, outliers", torn(clean, args.outlier_mm, random)),
            ):
                for estimator, function in ESTIMATORS.items():
                    weights = function(at_coils, coils)
                    taken[name, estimator].append(distances(tracked(model, weights, vertices, heard)))
        errors.update({row: tuple(np.mean(values, axis=0)) for row, values in taken.items()})
    return errors


def print_table(errors: dict[tuple[str, str], list[tuple[float, ...]]], parts: list[str]) -> None:
    def with_error(values: FloatArray) -> str:
        return f"{values.mean():6.3f} +- {values.std(ddof=1) / np.sqrt(len(values)):.3f}"

    print(f"{'':34}" + "".join(f"{part:18}{'less the paper':20}" for part in parts))
    for (condition, estimator), listed in sorted(errors.items(), key=lambda row: row[0][0]):
        values = np.array(listed)
        paper = np.array(errors.get((condition, PAPER), np.nan * values))
        cells = [
            f"{with_error(values[:, part]):18}{with_error((values - paper)[:, part]) if condition else '':20}"
            for part in range(len(parts))
        ]
        print(f"{condition:18}{estimator:16}" + "".join(cells))


if __name__ == "__main__":
    main()
