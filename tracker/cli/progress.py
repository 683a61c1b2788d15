"""A progress bar, where there is a person to see it."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TypeVar

Item = TypeVar("Item")


def with_progress(items: Iterable[Item], description: str, total: int | None = None) -> Iterable[Item]:
    """The items one after the other; on a terminal, with a bar on stderr. total: how many, where they do not tell."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track as progress

    return progress(items, description=description, total=total, console=Console(stderr=True))
