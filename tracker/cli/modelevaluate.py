"""`tonguetrack model evaluate`: compactness, generalisation and specificity of a model of a sample database."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from .evaluate import chosen_regions
from .names import as_text, keep_apart, prepare_folder
from .progress import with_progress

FLAGS = {
    "compactness": "compactness",
    "generalization": "generalisation",
    "specificity": "specificity",
    "phones": "phones",
}


def add_verb(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `model evaluate`."""
    evaluate = verbs.add_parser(
        "evaluate",
        help="compactness, generalisation and specificity over the numbers of components",
        description="Measures the models of a sample database as the paper does, over the number of components of each mode. "
        "Without any of the first four flags everything is measured.",
    )
    evaluate.add_argument("samples", metavar="SAMPLES.yaml", help="a sample database, as for 'model build'")
    evaluate.add_argument(
        "--compactness", action="store_true", help="the share of the variance that the components explain"
    )
    evaluate.add_argument(
        "--generalization", action="store_true",
        help="fit what the model was built without: each speaker, each phone",
    )  # fmt: skip
    evaluate.add_argument(
        "--specificity", action="store_true", help="how far random shapes are from the nearest real one"
    )
    evaluate.add_argument(
        "--phones", action="store_true", help="specificity with the pose of each single phone, in its critical region"
    )  # fmt: skip
    evaluate.add_argument(
        "--samples", dest="sample_count", type=int, default=1_000_000, metavar="N",
        help="random shapes for each number of components (default 1000000)",
    )  # fmt: skip
    evaluate.add_argument(
        "--region", metavar="NAME",
        help="where specificity is measured (default: 'combined', the speech related parts, where it is known, else 'whole "
        "mesh')",
    )  # fmt: skip
    evaluate.add_argument(
        "--region-file", action="append", default=[], metavar="NAME=PATH",
        help="a region's vertices from JSON: a list, or {\"indices\": [...]}; may be given several times",
    )  # fmt: skip
    evaluate.add_argument(
        "--box", type=float, default=2.0, metavar="H",
        help="how far a weight may be from its mean when meshes are fitted, in sigma (default 2)",
    )  # fmt: skip
    evaluate.add_argument(
        "--speaker-modes", type=int, default=5, metavar="N",
        help="speaker components while those of the pose vary (default 5)",
    )  # fmt: skip
    evaluate.add_argument(
        "--pose-modes", type=int, default=4, metavar="N",
        help="pose components while those of the speaker vary (default 4)",
    )  # fmt: skip
    evaluate.add_argument("--seed", type=int, default=1, metavar="N", help="of the random shapes (default 1)")
    evaluate.add_argument(
        "--jobs", type=int, default=-1, metavar="N", help="processes (default: one for each core)"
    )
    evaluate.add_argument(
        "-o", "--output", metavar="FOLDER", help="write the numbers (JSON, CSV, text) and pictures (PNG, SVG) there"
    )  # fmt: skip
    evaluate.set_defaults(run=run_evaluate)


def run_evaluate(args: argparse.Namespace) -> int:
    from ...model.build import load_training_shapes, read_sample_database
    from ...model.evaluation import Settings, evaluate
    from ...model.evaluationreport import (
        REPORT_FILES,
        describe,
        require_plotting,
        text_tables,
        write_report,
    )

    asked = {measure for flag, measure in FLAGS.items() if getattr(args, flag)}
    settings = Settings(
        frozenset(asked or FLAGS.values()),
        args.speaker_modes,
        args.pose_modes,
        args.box,
        args.sample_count,
        args.region,
        args.seed,
        args.jobs,
    )
    database = read_sample_database(args.samples)
    regions = chosen_regions(database.marks.regions, args.region_file, None, args.samples)
    folder = Path(args.output) if args.output is not None else None
    if folder:
        require_plotting()
        files = [folder / name for name in REPORT_FILES]
        read = [Path(stated.partition("=")[2]) for stated in args.region_file]
        keep_apart(files, [Path(args.samples), *read])
        prepare_folder(files[0])
    shapes = load_training_shapes(database)
    shapes = replace(shapes, provenance={**shapes.provenance, "source": as_text(Path(args.samples).name)})
    evaluation = evaluate(shapes, settings, regions, with_progress)
    print(describe(evaluation), file=sys.stderr)
    print(text_tables(evaluation))
    if folder:
        for file in write_report(evaluation, folder):
            print(f"  written: {file}", file=sys.stderr)
    return 0
