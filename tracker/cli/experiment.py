"""`tonguetrack experiment`: the paper's two tracking experiments over one speaker's recordings, with a report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from .names import (
    BUNDLED,
    add_recording_flags,
    as_text,
    each_once,
    keep_apart,
    named_model,
    prepare_folder,
)
from .showing import with_progress

if TYPE_CHECKING:
    from ..experiments import Experiments


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `experiment`."""
    experiment = commands.add_parser(
        "experiment",
        help="the paper's two tracking experiments: errors, weights, statistics, pictures",
        description="Tracks all recordings of one speaker twice, as in the paper: anatomy and pose free (experiment "
        "1), and with one anatomy for all frames (experiment 2). Writes the statistics, the pictures and a page that "
        "shows them to a folder.",
    )
    experiment.add_argument(
        "recordings",
        nargs="+",
        metavar="RECORDING",
        help="files, or folders that are searched; all of one speaker",
    )
    experiment.add_argument(
        "--model", default=BUNDLED, help="the tongue model (default: the bundled synthetic one)"
    )
    experiment.add_argument("--session", metavar="FILE", help="the speaker's session file (TOML)")
    experiment.add_argument("-o", "--output", required=True, metavar="FOLDER", help="where the report goes")
    experiment.add_argument(
        "--anatomy", choices=("mean", "joint"),
        help="experiment 2's anatomy: mean of experiment 1 as in the paper, or one joint estimate over all frames "
        "(default: the session's, where it states one, else mean)",
    )  # fmt: skip
    experiment.add_argument(
        "--features", type=float, metavar="HZ",
        help="also write experiment 2's pose weights at this frame rate, with deltas, as CSV and NPZ",
    )  # fmt: skip
    experiment.add_argument(
        "--films", action="store_true",
        help="also film every recording in both experiments (extras 'viewer' and 'video')",
    )  # fmt: skip
    experiment.add_argument(
        "--coils", metavar="CHANNEL=ROLE,...", help="which channel is which coil, where names do not tell"
    )
    experiment.add_argument("--json", action="store_true", help="the statistics as JSON on stdout")
    add_recording_flags(experiment)
    experiment.set_defaults(run=run_experiment)


def run_experiment(args: argparse.Namespace) -> int:
    from ...atomic import write_atomically
    from ...drivers import open_recording
    from ..experimentplots import PICTURE_FILES, pictures, require_plotting
    from ..experimentreport import (
        TABLE_FILES,
        all_statistics,
        as_csv,
        describe_anatomy,
        describe_model,
        json_text,
        report_page,
        text_table,
        warnings,
    )
    from ..experiments import run_experiments
    from ..features import check_rate, features_of, write_features
    from .track import plan_jobs, read_session

    require_plotting()
    if args.features is not None:
        check_rate(args.features)
    if args.films:
        require_films()
    jobs, left_out = plan_jobs(args.recordings, None, ())
    paths = [job.path for job in jobs]
    names = short_names(paths)
    folder = Path(args.output)
    features = (
        [f"features_{name}.{kind}" for name in names for kind in ("csv", "npz")] if args.features else []
    )
    films = (
        [f"film_{name}_experiment_{number}.mp4" for name in names for number in (1, 2)] if args.films else []
    )
    outputs = [folder / name for name in (*TABLE_FILES, *PICTURE_FILES, *features, *films)]
    keep_apart(outputs, map(Path, [*paths, args.model, *([args.session] if args.session else [])]))
    model = named_model(args.model)
    session = read_session(args)
    prepare_folder(outputs[0])
    for path, reason in left_out:
        print(f"left out: {path}: {reason}", file=sys.stderr)
    print(f"model: {describe_model(model)}", file=sys.stderr)

    recordings = [
        (name, open_recording(path, rate_hz=args.rate, unit=args.unit, layout=args.layout))
        for name, path in zip(names, paths, strict=True)
    ]
    done = run_experiments(recordings, model, session, args.anatomy)
    for sentence in (*(note for take in done.takes for note in take.notes), *done.decisions):
        print(f"  {sentence}", file=sys.stderr)
    print(f"  anatomy of experiment 2: {describe_anatomy(done.anatomy, model)}", file=sys.stderr)

    statistics = all_statistics(done)
    for warning in warnings(done, statistics):
        print(f"  {warning}", file=sys.stderr)
    numbers = json_text(done, statistics)
    page = report_page(done, statistics, features, films)
    tables = (numbers.encode(), as_csv(statistics).encode(), page.encode())
    for name, content in (*zip(TABLE_FILES, tables, strict=True), *pictures(done)):
        write_atomically(folder / name, content)
    if args.features is not None:
        for take in done.takes:
            vectors = features_of(take.experiment_2, args.features)
            for kind in ("csv", "npz"):
                write_features(vectors, take.experiment_2, folder / f"features_{take.name}.{kind}")
    if args.films:
        write_films(done, [folder / name for name in films])
    if args.json:
        print(numbers, end="")
    else:
        print(text_table(statistics))
    print(f"  written: {len(outputs)} files in {folder}; begin with {folder / 'report.md'}", file=sys.stderr)
    return 0


def require_films() -> None:
    """Raises InputError, before the work, where films cannot be made here."""
    from ..viewer.film import NO_VIDEO, can_film
    from ..viewer.offscreen import egl_context

    egl_context().release()
    if not can_film():
        raise InputError(NO_VIDEO)


def write_films(done: Experiments, targets: Sequence[Path]) -> None:
    """Two films a take, experiment 1 and 2, under these names (paper, section "Experiments": its supplement)."""
    from ..viewer.film import Shot, write_film
    from ..viewer.scene import moments_of, scene_of

    runs = [
        (f"{take.name}, experiment {number}", poses)
        for take in done.takes
        for number, poses in ((1, take.experiment_1), (2, take.experiment_2))
    ]
    for (title, poses), target in zip(runs, targets, strict=True):
        scene = scene_of(done.model, done.session, poses.roles, poses.correspondences, title)
        shot = Shot(scene, moments_of(poses))
        write_film(with_progress(shot, title), target, shot.fps, shot.begin_s, shot.size)


def short_names(paths: Sequence[Path]) -> list[str]:
    """A name for each recording: its file's without the ending; where that is not enough, more of its path.

    Raises InputError where a recording is named twice, and would count twice.
    """
    from ..experimentreport import ALL

    each_once(paths)
    resolved = [path.resolve() for path in paths]
    names = [as_text(path.stem) for path in paths]
    depth = 1
    while len({*names, ALL}) <= len(names):
        names = ["_".join(as_text(part) for part in path.parts[-depth:] if part != "/") for path in resolved]
        depth += 1
    return names
