"""tonguetrack model ...: build, look at, convert, fit and evaluate tongue models."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

from . import modelevaluate, modelfit

if TYPE_CHECKING:
    from ...model.multilinear import Mode, TongueModel


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    family = commands.add_parser("model", help="build, look at, convert, fit and evaluate tongue models")
    verbs = family.add_subparsers(dest="verb", metavar="VERB", required=True)

    build = verbs.add_parser("build", help="a model from a sample database of registered meshes")
    build.add_argument(
        "samples", metavar="SAMPLES.yaml", help="the sample database; mesh paths are relative to it"
    )
    build.add_argument(
        "-o", "--output", required=True, metavar="MODEL", help="where to save (.npz, .yaml, .json)"
    )
    build.add_argument(
        "--speaker-modes", type=int, default=5, metavar="N", help="speaker weights to keep (default 5)"
    )
    build.add_argument(
        "--pose-modes", type=int, default=4, metavar="N", help="pose weights to keep (default 4)"
    )
    build.add_argument(
        "--name", help="what the model is called wherever it is named (default: the file's name)"
    )
    build.set_defaults(run=run_build)

    info = verbs.add_parser("info", help="dimensions, compactness and provenance of a model")
    info.add_argument("model", metavar="MODEL", help="a model file, or 'bundled'")
    info.add_argument("--json", action="store_true", help="as one JSON object")
    info.set_defaults(run=run_info)

    convert = verbs.add_parser("convert", help="between our .npz and the published .yaml and .json")
    convert.add_argument("source", metavar="MODEL", help="a model file, or 'bundled'")
    convert.add_argument("target", metavar="OUT", help="the file to write: .npz, .yaml or .json")
    convert.set_defaults(run=run_convert)

    synthetic = verbs.add_parser(
        "synthetic", help="write the meshes of our synthetic speakers as a sample database"
    )
    synthetic.add_argument("folder", metavar="FOLDER", help="an absent or empty folder")
    synthetic.set_defaults(run=run_synthetic)

    modelfit.add_verb(verbs)
    modelevaluate.add_verb(verbs)


def run_build(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ...model.build import load_training_shapes, model_from_shapes, read_sample_database
    from ...model.files import check_model_suffix, save_model
    from ...model.tensor import cumulative_compactness
    from .names import as_text, prepare_folder

    check_model_suffix(args.output)
    prepare_folder(Path(args.output))
    database = read_sample_database(args.samples)
    cells = sum(len(phones) for phones in database.paths.values())
    print(
        f"reading {cells} meshes of {len(database.speakers)} speakers x {len(database.prompts)} prompts",
        file=sys.stderr,
    )
    shapes = load_training_shapes(database)
    provenance = {
        "name": args.name or as_text(Path(args.output).stem),
        "source": as_text(Path(args.samples).name),
        "speaker modes": str(args.speaker_modes),
        "pose modes": str(args.pose_modes),
    }
    model = model_from_shapes(shapes, args.speaker_modes, args.pose_modes, provenance)
    save_model(model, args.output)
    for speaker, prompt in shapes.filled:
        print(f"missing cell filled by averaging: {speaker} {prompt}", file=sys.stderr)
    assert model.speaker.spectrum is not None and model.pose.spectrum is not None
    kept = [
        f"{mode.size} of {mode.entries} {name} modes ({100 * cumulative_compactness(mode.spectrum)[mode.size - 1]:.1f} %)"
        for mode, name in ((model.speaker, "speaker"), (model.pose, "pose"))
        if mode.spectrum is not None
    ]
    size = Path(args.output).stat().st_size
    print(
        f"{args.output}: {model.vertex_count} vertices, {', '.join(kept)}, {size / 1e6:.1f} MB",
        file=sys.stderr,
    )
    return 0


def run_info(args: argparse.Namespace) -> int:
    from .names import named_model

    description = describe_model(named_model(args.model), args.model)
    if args.json:
        print(json.dumps(description))
    else:
        _print_description(description)
    return 0


def run_convert(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ...model.files import check_model_suffix, save_model
    from .names import keep_apart, named_model

    check_model_suffix(args.target)
    keep_apart([Path(args.target)], [Path(args.source)])
    model = named_model(args.source)
    save_model(model, args.target)
    if Path(args.source).suffix.lower() == ".npz" and Path(args.target).suffix.lower() != ".npz":
        print(
            f"{args.target}: the published format keeps no training weights, compactness, names, marks or provenance.",
            file=sys.stderr,
        )
    return 0


def run_synthetic(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ... import InputError
    from ...model.synthetic.samples import write_samples

    folder = Path(args.folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected an absent or empty folder, so that nothing is overwritten.")
    database = write_samples(folder)
    print(
        f"{database}: synthetic speakers; build with 'tonguetrack model build {database} -o model.npz'",
        file=sys.stderr,
    )
    return 0


def describe_model(model: TongueModel, path: str) -> dict[str, Any]:
    """Everything `model info` shows, as plain values."""
    return {
        "path": path,
        "name": model.name,
        "fingerprint": model.fingerprint,
        "vertices": model.vertex_count,
        "faces": len(model.faces),
        "speaker": _describe_mode(model.speaker),
        "pose": _describe_mode(model.pose),
        "landmarks": dict(model.marks.landmarks),
        "regions": {name: len(vertices) for name, vertices in model.marks.regions.items()},
        "midsagittal_vertices": len(model.marks.midsagittal),
        "provenance": dict(model.provenance),
    }


def _describe_mode(mode: Mode) -> dict[str, Any]:
    from ...model.tensor import cumulative_compactness

    measured = mode.measured_sigma
    compactness = None if mode.spectrum is None else cumulative_compactness(mode.spectrum)
    return {
        "weights": mode.size,
        "training_entries": mode.entries,
        "names": list(mode.names),
        "mean": mode.mean.tolist(),
        "sigma": mode.sigma.tolist(),
        "measured_sigma": None if measured is None else measured.tolist(),
        "cumulative_compactness": None if compactness is None else compactness.tolist(),
    }


def _print_description(description: dict[str, Any]) -> None:
    print(f"{description['path']}: {description['name']} [{description['fingerprint']}]")
    print(f"  {description['vertices']} vertices, {description['faces']} faces")
    for name in ("speaker", "pose"):
        mode = description[name]
        print(f"  {name} mode: {mode['weights']} weights from {mode['training_entries']} training entries")
        if mode["names"]:
            print(f"    entries      {' '.join(mode['names'])}")
        print(f"    mean         {_row(mode['mean'])}")
        print(f"    sigma        {_row(mode['sigma'])}  (published: 1/sqrt(entries))")
        measured = mode["measured_sigma"]
        print(f"    measured     {_row(measured) if measured else 'not kept in this format'}")
        compactness = mode["cumulative_compactness"]
        print(f"    compactness  {_row(compactness) if compactness else 'not kept in this format'}")
    marks = [
        f"{len(description['landmarks'])} landmarks",
        f"{description['midsagittal_vertices']} mid-sagittal",
    ]
    marks += [f"{name} {count}" for name, count in description["regions"].items()]
    print(f"  marked vertices: {', '.join(marks)}")
    for key, value in description["provenance"].items():
        print(f"  {key}: {value}")


def _row(values: list[float]) -> str:
    return " ".join(f"{value:.4f}" for value in values)
