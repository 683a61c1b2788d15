"""tonguetrack mri preference make, serve, tally: which of two contours people prefer in slices of scans."""

from __future__ import annotations

import argparse
import sys

from . import EXIT_LEFT_OUT

MIDDLE = "mid"
DEFAULT_PLACE = "127.0.0.1:8080"


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    family = verbs.add_parser(
        "preference",
        help="let people judge which contour follows the tongue: make a test, serve it, tally the choices",
        description="The paper's preference test. People see sagittal slices, each with the contour after the first template "
        "matching and the one after bootstrapping in random order, and choose.",
    )
    steps = family.add_subparsers(dest="step", metavar="STEP", required=True)

    make = steps.add_parser("make", help="make the slices and contours of a test from what a build found")
    make.add_argument("work", metavar="WORK", help="the work folder of 'mri build'")
    make.add_argument("-o", "--output", required=True, metavar="TEST", help="an absent or empty folder")
    make.add_argument(
        "--partitions", type=int, default=4, metavar="N",
        help="parts of about the same size; every participant judges one (default 4)",
    )  # fmt: skip
    make.add_argument(
        "--slices", default=MIDDLE, metavar="PLACES",
        help="which sagittal slices, with commas between them: 'mid', or mm to the left of it (default mid)",
    )  # fmt: skip
    make.add_argument(
        "--seed", type=int, default=0, metavar="S", help="another number, other partitions (default 0)"
    )
    make.set_defaults(run=run_make)

    serve = steps.add_parser("serve", help="show a test to people, on a page for browsers")
    serve.add_argument("test", metavar="TEST", help="a folder that 'mri preference make' made")
    serve.add_argument(
        "--partition", type=int, metavar="K", help="for everybody who is new (default: one that fewest have)"
    )
    serve.add_argument(
        "--participant", metavar="NAME", help="who judges (default: the page asks, and takes several)"
    )
    serve.add_argument(
        "--host", default=DEFAULT_PLACE, metavar="HOST:PORT", help=f"where (default {DEFAULT_PLACE})"
    )
    serve.set_defaults(run=run_serve)

    tally = steps.add_parser("tally", help="count the choices, per scan, per speaker and over all")
    tally.add_argument("test", metavar="TEST", help="a folder that 'mri preference make' made")
    tally.add_argument(
        "-o", "--output", metavar="FOLDER", help="write the numbers (JSON, CSV, text) and a picture (PNG, SVG) there"
    )  # fmt: skip
    tally.set_defaults(run=run_tally)


def run_make(args: argparse.Namespace) -> int:
    from ...model.mri.preference import cases_of, make_test
    from ...model.mri.results import load_result
    from .progress import with_progress

    offsets = _offsets(args.slices)
    if args.seed < 0:
        from ... import InputError

        raise InputError(f"--seed {args.seed}: expected 0 or more.")
    result = load_result(args.work)
    cases = with_progress(cases_of(result), "drawing", len(result.scans))
    test, problems = make_test(
        cases,
        args.output,
        result.source.name,
        result.shapes.provenance.get("data", ""),
        args.partitions,
        offsets,
        args.seed,
    )
    parts = f"{test.partitions} partition{'s' * (test.partitions > 1)}"
    print(
        f"{args.output}: {len(test.items)} slices in {parts}; show them with 'tonguetrack mri preference serve "
        f"{args.output}'",
        file=sys.stderr,
    )
    for problem in problems:
        print(f"  left out: {problem.sentence}", file=sys.stderr)
    return EXIT_LEFT_OUT if problems else 0


def run_serve(args: argparse.Namespace) -> int:
    from ...model.mri.preference import load_test
    from ..preferenceserver import PreferenceServer

    test = load_test(args.test)
    with PreferenceServer(test, args.host, args.partition, args.participant, _tell) as server:
        print(f"page: {server.url}", flush=True)
        print("Ctrl-C ends it; every choice is kept at once.", file=sys.stderr)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            pass
    return 0


def run_tally(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ...model.mri.preference import load_test
    from ...model.mri.preferencetally import TALLY_FILES, as_text, tally, write_tally
    from .names import prepare_folder

    result = tally(load_test(args.test))
    print(as_text(result))
    if args.output is not None:
        folder = Path(args.output)
        prepare_folder(folder / TALLY_FILES[0])
        for file in write_tally(result, folder):
            print(f"  written: {file}", file=sys.stderr)
    return 0


def _offsets(text: str) -> list[float]:
    """mm to the left of the mid-sagittal plane. Raises InputError for anything else."""
    import math

    from ... import InputError

    offsets = []
    for word in text.split(","):
        try:
            offset = 0.0 if word.strip() == MIDDLE else float(word)
        except ValueError:
            offset = math.nan
        if not math.isfinite(offset) or offset in offsets:
            raise InputError(
                f"--slices {text}: '{word.strip()}' should be '{MIDDLE}' or a number of mm, each place once."
            )
        offsets.append(offset)
    return offsets


def _tell(participant: str, answered: int, total: int) -> None:
    print(f"  {participant}: {answered} of {total}", file=sys.stderr, flush=True)
