"""A progress bar, where there is a person to see it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

Item = TypeVar("Item")


def with_progress(items: Sequence[Item], description: str) -> Iterable[Item]:
    """The items one after the other; on a terminal, with a bar on stderr."""
    if not sys.stderr.isatty():
        return items
    from rich.console import Console
    from rich.progress import track as progress

    return progress(items, description=description, console=Console(stderr=True))
