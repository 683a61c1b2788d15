"""tonguetrack mri build: all steps from a data set of scans to a model, cached, resumed, and reported."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from . import EXIT_LEFT_OUT
from .workers import add_worker_flags, bar, workers

if TYPE_CHECKING:
    from ...model.mri.dataset import Dataset
    from ...model.mri.results import BuildResult, Index
    from ...model.mri.settings import BuildSettings
    from ...model.mri.truthcomparison import TruthComparison
    from ...parallel import Executor

STAGES = ("scans", "palates", "aligned", "clouds", "matched", "tongues")
SUSPICIOUS = 5  # scans that are named in the end, at most; the report has all


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    build = verbs.add_parser(
        "build",
        help="all steps: from a data set of scans to a model",
        description="Extracts the tongue from every scan of a data set and builds a model of them. What is kept in the work "
        "folder is not made again. Exit code 3: something was left out, and said.",
    )
    build.add_argument("dataset", nargs="?", metavar="DATASET", help="the TOML file that lists the scans")
    build.add_argument("-o", "--output", metavar="MODEL", help="where to save the model (.npz, .yaml, .json)")
    build.add_argument(
        "--settings",
        metavar="FILE.toml",
        help="settings that differ (default: the data set's, else the usual ones)",
    )
    build.add_argument(
        "--print-settings",
        action="store_true",
        help="print all settings with what they mean, and build nothing",
    )
    build.add_argument(
        "--speaker-modes", type=int, metavar="N", help="speaker weights of the model (default 5)"
    )
    build.add_argument("--pose-modes", type=int, metavar="N", help="pose weights of the model (default 4)")
    build.add_argument(
        "--name", help="what the model is called wherever it is named (default: the file's name)"
    )
    build.add_argument(
        "--work", metavar="DIR", help="where intermediate results are kept (default: MODEL's name with .work)"
    )
    build.add_argument(
        "--report", metavar="DIR", help="write a report for people here, scans that look wrong first"
    )
    build.add_argument(
        "--export", metavar="DIR", help="write points and meshes here (.ply), and samples.yaml to evaluate"
    )
    build.add_argument(
        "--until", choices=STAGES, default=STAGES[-1], help="stop after this stage, before there is a model"
    )
    build.add_argument(
        "--ablations",
        action="store_true",
        help="also build without denoising, without the palate in contact, with the paper's settings, and compare each "
        "with the truth, for a phantom's data set",
    )
    add_worker_flags(build)
    build.set_defaults(run=run_build)


def run_build(args: argparse.Namespace) -> int:
    from ... import InputError
    from ...model.mri.exporting import export
    from ...model.mri.pipeline import build
    from ...model.mri.settings import settings_toml

    dataset, settings = _input(args)
    if args.print_settings:
        print(settings_toml(settings), end="")
        return 0
    if dataset is None:
        raise InputError("name the data set to build from: the TOML file that lists the scans.")
    whole = args.until == STAGES[-1]
    if whole != (args.output is not None):
        raise InputError(
            "name the model to write: -o model.npz."
            if whole
            else f"--until {args.until} ends before there is a model; leave out -o, or --until."
        )
    if not whole and (args.report is not None or args.ablations):
        raise InputError(f"--until {args.until} ends before there is anything to report.")
    work = _prepared(args, dataset)
    with workers(args) as executor:
        index = build(dataset, settings, work, executor, bar, args.until)
        if args.export is not None:
            export(work, index, args.export)
        if whole:
            result = _written(args, index, work)
            _report(args, result, index, work, executor)
    for problem in index.dataset.problems:
        print(f"left out: {problem.sentence}", file=sys.stderr)
    return EXIT_LEFT_OUT if index.dataset.problems else 0


def _input(args: argparse.Namespace) -> tuple[Dataset | None, BuildSettings]:
    """The data set, and the settings: the usual ones, changed by it, by --settings, and by the flags."""
    from ...model.mri.dataset import load_dataset
    from ...model.mri.settings import BuildSettings, load_settings, settings_of

    dataset, settings = None, BuildSettings()
    if args.dataset is not None:
        dataset = load_dataset(args.dataset)
        settings = settings_of(dataset.settings, f"{args.dataset}, [settings]")
    if args.settings is not None:
        settings = load_settings(args.settings, settings)
    flags = {"speaker_modes": args.speaker_modes, "pose_modes": args.pose_modes}
    given = {name: value for name, value in flags.items() if value is not None}
    return dataset, settings_of({"model": given}, "the command line", settings)


def _prepared(args: argparse.Namespace, dataset: Dataset) -> Path:
    """The work folder; looks at all that will be needed and written, before the work is done."""
    from ... import InputError
    from ...model.files import check_model_suffix
    from ...model.mri.qualityreport import require_drawing
    from ...model.mri.truthcomparison import has_truth
    from .names import keep_apart, prepare_folder

    read = [Path(name) for name in (args.dataset, args.settings) if name is not None]
    named = Path(args.output or args.dataset)
    if args.output is not None:
        check_model_suffix(args.output)
        prepare_folder(named)
        keep_apart([named], read)
    work = named.with_suffix(".work") if args.work is None else Path(args.work)
    if args.report is not None:
        require_drawing()
    if args.ablations and not has_truth(dataset):
        raise InputError(
            f"{args.dataset}: ablations are judged by the truth, which only the data set of 'tonguetrack mri phantom' has."
        )
    for folder in (work, args.report, args.export):
        if folder is not None:
            prepare_folder(Path(folder) / "any")
    return work


def _written(args: argparse.Namespace, index: Index, work: Path) -> BuildResult:
    """The result, after its index and the model are written; says what was found."""
    from dataclasses import replace

    from ...model.files import save_model
    from ...model.mri.results import assembled, write_index
    from .names import as_text

    write_index(work, index)
    result = assembled(work, index)
    name = args.name or as_text(Path(args.output).stem)
    save_model(replace(result.model, provenance={"name": name, **result.model.provenance}), args.output)
    print(f"{args.output}: {_described(result)}", file=sys.stderr)
    for scan in result.suspicious_first()[:SUSPICIOUS]:
        if scan.suspicion > 0.0:
            print(f"look at {scan.speaker} [{scan.phone}]: {' '.join(scan.notes)}", file=sys.stderr)
    return result


def _report(
    args: argparse.Namespace, result: BuildResult, index: Index, work: Path, executor: Executor
) -> None:
    """What --report and --ablations ask for. Compared with the truth where there is one."""
    from ...model.mri.truthcomparison import ablation_table, compare, has_truth, text_table

    if args.report is None and not args.ablations:
        return
    comparison, others = None, {}
    if has_truth(index.dataset):
        with bar("compared with the truth") as progress:
            comparison = compare(result, index.dataset, executor, progress)
        print(text_table(comparison))
    if args.ablations:
        others = _ablations(index, work, executor)
        print(ablation_table(others))
    if args.report is not None:
        from ...model.mri.qualityreport import write_report

        with bar("pictures for the report") as progress:
            page = write_report(args.report, result, executor, comparison, others, progress)
        print(f"{page}: scans that look wrong first", file=sys.stderr)


def _ablations(index: Index, work: Path, executor: Executor) -> dict[str, TruthComparison]:
    """What was done differently -> how near the result is to the truth. Shares the work folder with the build."""
    from ...model.mri.pipeline import build
    from ...model.mri.results import assembled
    from ...model.mri.truthcomparison import ablations, compare

    found = {}
    for other in ablations(index.settings):
        print(f"{other.name} ...", file=sys.stderr)
        result = assembled(work, build(index.dataset, other.settings, work, executor, bar))
        with bar("compared with the truth") as progress:
            found[other.name] = compare(result, index.dataset, executor, progress)
    return found


def _described(result: BuildResult) -> str:
    model = result.model
    cells = f"{len(result.shapes.speakers)} speakers x {len(result.shapes.prompts)} phones"
    filled = len(result.shapes.filled)
    text = f"{cells}, {filled} of them filled by {result.settings.completion}" if filled else cells
    text += (
        f"; {model.speaker.size} speaker and {model.pose.size} pose weights, {model.vertex_count} vertices"
    )
    return f"{text}; {sum(result.seconds.values()):.0f} s"
