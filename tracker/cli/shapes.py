"""`tonguetrack shapes`: what one speaker's tongue does, as ranges for the shapes that avatars are driven with."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from .names import poses_and_model

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel
    from ..pose import FloatArray


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `shapes`."""
    shapes = commands.add_parser(
        "shapes",
        help="a speaker's ranges of the avatar shapes, from tracked poses, into the session",
        description="Measures every avatar shape on a speaker's tracked poses and prints what makes it 0 and 1: the "
        "median, and what 98 %% of the frames stay below; beside it, what the model alone would say. With --session "
        "the ranges are written into the session's [shapes], and every stream of that session uses them.",
    )
    shapes.add_argument("poses", metavar="POSES", nargs="+", help="what 'track --out' wrote, of one speaker")
    shapes.add_argument("--session", metavar="FILE", help="the speaker's session file (TOML), to write the ranges into")  # fmt: skip
    shapes.add_argument("--model", help="the model, where it is not where the poses say")
    shapes.add_argument("--json", action="store_true", help="the ranges as JSON on stdout")
    shapes.set_defaults(run=run_shapes)


def run_shapes(args: argparse.Namespace) -> int:
    from ..session import load_session
    from ..streams.shapes import speaker_ranges

    session = load_session(args.session) if args.session else None  # its mistakes before the work
    model, speaker_weights, weights = _tracked(args.poses, args.model)
    if session and session.model_fingerprint not in ("", model.fingerprint):
        raise InputError(
            f"{args.session}: it belongs to the model [{session.model_fingerprint}], the poses to {model.name} "
            f"[{model.fingerprint}]; track them with that session first."
        )
    ranges = speaker_ranges(model, speaker_weights, weights)
    if args.json:
        report = {"model_fingerprint": model.fingerprint, "frames": len(weights), "ranges": ranges}
        print(json.dumps(report))
    else:
        print("\n".join(_lines(model, ranges)))
    if args.session:
        _save(Path(args.session), ranges)
    return 0


def _tracked(paths: list[str], model_name: str | None) -> tuple[TongueModel, FloatArray, FloatArray]:
    """The model, and the raw weights of all frames of all files in which a coil was there."""
    import numpy as np

    read = [poses_and_model(path, model_name) for path in paths]
    model = read[0][1]
    for path, (_, other) in zip(paths, read, strict=True):
        if other.fingerprint != model.fingerprint:
            raise InputError(
                f"{path}: its model is {other.name} [{other.fingerprint}], that of {paths[0]} is {model.name} "
                f"[{model.fingerprint}]; give poses of one model."
            )
    speaker_weights = np.concatenate([poses.speaker_weights[poses.tracked] for poses, _ in read])
    weights = np.concatenate([poses.weights[poses.tracked] for poses, _ in read])
    print(f"{len(weights)} tracked frames; model: {model.name} [{model.fingerprint}]", file=sys.stderr)
    return model, speaker_weights, weights


def _lines(model: TongueModel, ranges: dict[str, tuple[float, float]]) -> list[str]:
    from ..streams.shapes import SHAPES, ShapeMeter

    meter = ShapeMeter(model)
    meanings = {shape.name: shape.meaning for shape in SHAPES}
    lines = [f"{'shape':12} {'':4} {'0 at':>8} {'1 at':>8} {'model: 0':>9} {'1':>7}"]
    for name, unit in zip(meter.names, meter.units, strict=True):
        own, default = ranges[name], meter.ranges[name]
        numbers = f"{own[0]:8.2f} {own[1]:8.2f} {default[0]:9.2f} {default[1]:7.2f}"
        meaning = meanings.get(name, "a direction of the model's pose weights")
        lines.append(f"{name:12} {unit:4} {numbers}  {meaning}")
    return lines


def _save(path: Path, ranges: dict[str, tuple[float, float]]) -> None:
    from ...atomic import write_atomically
    from ..session import with_shape_ranges

    write_atomically(path, with_shape_ranges(path.read_bytes().decode(), ranges).encode())
    print(f"written: [shapes] of {path}", file=sys.stderr)
