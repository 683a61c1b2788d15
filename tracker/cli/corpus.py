"""tonguetrack track --out-folder: a whole corpus, on all cores or on a cluster."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from . import EXIT_LEFT_OUT
from .names import BUNDLED, keep_apart, named_model, parsed_coils, prepare_folder
from .workers import bar, workers

if TYPE_CHECKING:
    from ..corpus import Row, Task
    from ..session import Session
    from .track import Job

OTHER_OUTPUTS = ("out", "osc", "view", "palate", "save_session", "realtime")


def run_corpus(
    args: argparse.Namespace,
    jobs: Sequence[Job],
    left_out: Sequence[tuple[Path, str]],
    experiments: tuple[int, ...],
) -> int:
    """Tracks the recordings of these jobs, whose outputs are below the folder."""
    from ...parallel import Failed
    from .. import corpus

    for name in OTHER_OUTPUTS:
        if getattr(args, name):
            raise InputError(
                f"--{name.replace('_', '-')} belongs to single recordings; with --out-folder the poses are written, "
                "and nothing else."
            )
    folder = Path(os.path.abspath(args.out_folder))
    model = named_model(args.model)
    print(f"model: {model.name} [{model.fingerprint}]", file=sys.stderr)
    tasks = _tasks(args, jobs, folder)
    outputs = [folder / name for task in tasks for name in task.poses.values()]
    outputs += [corpus.stamp_of(folder, task) for task in tasks]
    outputs += [folder / corpus.SUMMARY, folder / corpus.LEFT_OUT]
    sessions = {task.session_file for task in tasks if task.session_file}
    keep_apart(outputs, [*(task.path for task in tasks), Path(args.model), *map(Path, sessions)])
    prepare_folder(folder / corpus.SUMMARY)
    _print_sessions(tasks)
    left_out = [(path, reason) for path, reason in left_out if str(path) not in sessions]
    _print_left_out(left_out, tasks)
    way = corpus.Way(
        start=Path.cwd(),
        folder=folder,
        model=BUNDLED if args.model == BUNDLED else str(Path(args.model).resolve()),
        fingerprint=model.fingerprint,
        experiments=experiments,
        rate_hz=args.rate,
        unit=args.unit,
        layout=args.layout,
        again=args.again,
    )
    rows: list[Row] = []
    with workers(args) as executor, bar("tracking") as progress:
        print(f"tracking {len(tasks)} recordings {executor.where}", file=sys.stderr)
        outcomes = executor.run(partial(corpus.track_task, way), tasks, progress)
        for task, outcome in zip(tasks, outcomes, strict=True):
            row = corpus.failed(task, outcome.reason) if isinstance(outcome, Failed) else outcome
            for problem in row.problems:
                named = problem if row.state == corpus.FAILED else f"{row.recording}: {problem}"
                print(f"tonguetrack: {named}", file=sys.stderr)
            rows.append(row)
    summary = corpus.write_summary(rows, folder)
    corpus.write_left_out(left_out, folder)
    if args.json:
        report = {"model": model.name, "model_fingerprint": model.fingerprint}
        print(json.dumps({**report, "recordings": [asdict(row) for row in rows]}))
    states = Counter(row.state for row in rows)
    told = ", ".join(
        f"{states[s]} {s}" for s in (corpus.TRACKED, corpus.UNCHANGED, corpus.FAILED) if states[s]
    )
    print(f"{len(rows)} recordings: {told}; written: {summary}", file=sys.stderr)
    return EXIT_LEFT_OUT if states[corpus.FAILED] else 0


def _tasks(args: argparse.Namespace, jobs: Sequence[Job], folder: Path) -> list[Task]:
    """Every recording with its session: the one of --session, else the one that lies beside or above it."""
    from ..corpus import Task, session_beside
    from ..session import Session, load_session

    places = [Path(place) for place in args.recordings if Path(place).is_dir()]
    loaded: dict[str, Session] = {"": Session()}
    tasks = []
    for job in jobs:
        if args.session:
            file = args.session
        else:
            root = next((place for place in places if place in job.path.parents), job.path.parent)
            file = str(session_beside(job.path, root) or "")
        if file not in loaded:
            loaded[file] = load_session(file)
        session = loaded[file]
        if args.coils:
            coils = parsed_coils(args.coils)
            session = replace(session, coils=coils, source=session.source if file else "--coils")
        poses = {
            experiment: Path(os.path.abspath(name)).relative_to(folder)
            for experiment, name in job.outputs.items()
        }
        tasks.append(Task(job.path, poses, session, file))
    return tasks


def _print_sessions(tasks: Sequence[Task]) -> None:
    for file, count in sorted(Counter(task.session_file for task in tasks).items()):
        if file:
            print(f"session {file}: {count} recordings", file=sys.stderr)
        else:
            print(
                f"no session: {count} recordings; coils by name, vertices and anatomy estimated from each alone",
                file=sys.stderr,
            )


def _print_left_out(left_out: Sequence[tuple[Path, str]], tasks: Sequence[Task]) -> None:
    """By name where it looks like the recordings, else counted: a corpus holds as much sound and text."""
    from ..corpus import LEFT_OUT

    endings = {task.path.suffix.lower() for task in tasks}
    for path, reason in left_out:
        if path.suffix.lower() in endings:
            print(f"left out: {path}: {reason}", file=sys.stderr)
    others = Counter(path.suffix or "no ending" for path, _ in left_out if path.suffix.lower() not in endings)
    if others:
        counted = ", ".join(f"{ending} {count}" for ending, count in sorted(others.items()))
        print(f"left out: {others.total()} other files ({counted}); {LEFT_OUT} says why", file=sys.stderr)
