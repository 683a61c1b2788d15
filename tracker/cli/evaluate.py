"""`tonguetrack evaluate-tracking`: how near every estimator comes to meshes that it has not seen."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ... import InputError

MAX_REGION_BYTES = 16 * 1024 * 1024


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `evaluate-tracking`."""
    evaluate = commands.add_parser(
        "evaluate-tracking",
        help="leave each speaker of a sample database out, track coils on the true meshes, measure the error",
        description="Leaves one speaker out at a time, places coils on that speaker's true meshes, tracks them with a "
        "model of the others, and reports the distance to the truth for every estimator, between two brackets: the "
        "mean shape, and the best fit to the whole true mesh.",
    )
    evaluate.add_argument(
        "samples", metavar="SAMPLES.yaml", help="a sample database, as for 'tonguetrack model build'"
    )
    evaluate.add_argument(
        "--coils", required=True, metavar="VERTEX,...", help="the vertices that the coils sit on"
    )
    evaluate.add_argument(
        "--noise",
        type=float,
        default=0.3,
        metavar="MM",
        help="standard deviation of each coordinate (default 0.3)",
    )
    evaluate.add_argument(
        "--leave-phone-out", action="store_true", help="keep the tested phone from the training meshes, too"
    )
    evaluate.add_argument(
        "--regions",
        metavar="NAME,...",
        help="the regions to report (default: all that the database and files name)",
    )
    evaluate.add_argument(
        "--region-file", action="append", default=[], metavar="NAME=PATH",
        help="a region's vertices from JSON: a list, or {\"indices\": [...]}; may be given several times",
    )  # fmt: skip
    evaluate.add_argument("--seed", type=int, default=1, metavar="N", help="of the noise (default 1)")
    evaluate.add_argument(
        "--speaker-modes", type=int, default=5, metavar="N", help="speaker weights of each model (default 5)"
    )
    evaluate.add_argument(
        "--pose-modes", type=int, default=4, metavar="N", help="pose weights of each model (default 4)"
    )
    evaluate.add_argument(
        "-o",
        "--output",
        metavar="FOLDER",
        help="write the numbers (JSON, CSV, text) and pictures (PNG, SVG) there",
    )
    evaluate.set_defaults(run=run_evaluate)


def run_evaluate(args: argparse.Namespace) -> int:
    from ...model.build import load_training_shapes, read_sample_database
    from ..evaluation import Plan, evaluate
    from .names import as_text, keep_apart, prepare_folder

    plan = Plan(
        parse_vertices(args.coils),
        args.noise,
        args.leave_phone_out,
        args.speaker_modes,
        args.pose_modes,
        args.seed,
    )
    database = read_sample_database(args.samples)
    regions = chosen_regions(database.marks.regions, args.region_file, args.regions, args.samples)
    if args.output is not None:
        from ..evaluationreport import REPORT_FILES, require_plotting

        require_plotting()
        files = [Path(args.output) / name for name in REPORT_FILES]
        read = [stated.partition("=")[2] for stated in args.region_file]
        keep_apart(files, map(Path, [args.samples, *read]))
        prepare_folder(files[0])
    evaluation = evaluate(load_training_shapes(database), plan, regions, _with_progress)

    from ..evaluationreport import describe_plan, text_table, write_report

    source = as_text(Path(args.samples).name)
    print(describe_plan(evaluation, source), file=sys.stderr)
    print(text_table(evaluation))
    if args.output is not None:
        for file in write_report(evaluation, source, Path(args.output)):
            print(f"  written: {file}", file=sys.stderr)
    return 0


def parse_vertices(text: str) -> tuple[int, ...]:
    """VERTEX,... as numbers."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            f"--coils {text}: expected the numbers of vertices with commas between, as in 2465,1912,1250."
        ) from None


def chosen_regions(
    of_database: Mapping[str, Sequence[int]], files: Sequence[str], names: str | None, source: str
) -> dict[str, Sequence[int]]:
    """The regions of the database and of --region-file NAME=PATH (which has the last word), or those of --regions."""
    from ..evaluation import COILS, WHOLE_MESH

    known = dict(of_database)
    for stated in files:
        name, equals, path = stated.partition("=")
        if not (name and equals and path):
            raise InputError(f"--region-file {stated}: expected NAME=PATH, as in combined=combined.json.")
        known[name] = read_region(Path(path))
    chosen = known if names is None else dict.fromkeys(names.split(","))
    for name in chosen:
        if name not in known:
            others = f"known are {', '.join(known)}" if known else "none is known"
            raise InputError(
                f"--regions: there is no region '{name}' in {source}; {others}; name a list of vertices with "
                f"--region-file {name or 'NAME'}=PATH."
            )
        if name in (WHOLE_MESH, COILS):
            raise InputError(f"a region cannot be called '{name}', which the report has anyway; rename it.")
        if not known[name]:
            raise InputError(f"the region '{name}' has no vertices; leave it out with --regions.")
    return {name: known[name] for name in chosen}


def read_region(path: Path) -> tuple[int, ...]:
    """Vertices from JSON: a list of numbers, or a map with the list under `indices`, as the authors publish them."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file of a region's vertices.")
    if path.stat().st_size > MAX_REGION_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a region's vertices.")
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        content = None
    vertices = content.get("indices") if isinstance(content, dict) else content
    if not isinstance(vertices, list) or not all(type(vertex) is int for vertex in vertices):
        raise InputError(
            f'{path}: expected JSON with a list of vertices, [630, 631, ...] or {{"indices": [630, 631, ...]}}.'
        )
    return tuple(dict.fromkeys(vertices))


def _with_progress(speakers: Sequence[int]) -> Iterable[int]:
    """The speakers one after the other, with a progress bar where there is a person to see it."""
    if not sys.stderr.isatty():
        return speakers
    from rich.console import Console
    from rich.progress import track as progress

    return progress(speakers, description="evaluating", console=Console(stderr=True))
