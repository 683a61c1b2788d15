"""Flags and a progress bar of the commands that work on many things at once."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...parallel import Executor, Progress


def add_worker_flags(parser: argparse.ArgumentParser) -> None:
    """--jobs and --scheduler."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=int, metavar="N", help="so many processes (default: one for each core)")
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="work on the Dask cluster whose scheduler is here, such as tcp://192.168.0.7:8786 (extra 'cluster')",
    )


def workers(args: argparse.Namespace) -> AbstractContextManager[Executor]:
    """What --jobs and --scheduler ask for."""
    from ...parallel import executor

    return executor(args.jobs, args.scheduler)


@contextmanager
def bar(description: str) -> Iterator[Progress | None]:
    """What an Executor tells its progress to: a bar on stderr, where there is a person to see it."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True)) as shown:
        task = shown.add_task(description, total=None)
        yield lambda finished, total: shown.update(task, completed=finished, total=total)
