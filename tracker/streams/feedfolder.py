"""The folder that a feed is in: private, there for one run, and cleared away after a run that was killed."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ... import InputError
from .feed import FeedReader

MEMORY_FOLDER = Path("/dev/shm")
PREFIX = "tonguetrack-"


@contextmanager
def feed_folder() -> Iterator[Path]:
    """A folder for this user alone, gone afterwards; those that killed runs have left are removed, too.

    In memory where the system offers that: a mapped file on a disk makes its writer wait now and then, while the
    system writes its pages.
    """
    in_memory = MEMORY_FOLDER.is_dir() and os.access(MEMORY_FOLDER, os.W_OK | os.X_OK)
    place = MEMORY_FOLDER if in_memory else Path(tempfile.gettempdir())
    _clear_away_leftovers(place)
    folder = tempfile.mkdtemp(prefix=PREFIX, dir=place)
    try:
        yield Path(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _clear_away_leftovers(place: Path) -> None:
    """Removes this user's feeds that nobody writes any more. Links, and what is somebody else's, are left alone."""
    for folder in place.glob(f"{PREFIX}*"):
        with suppress(OSError, InputError):  # gone meanwhile, or no feed
            found = folder.lstat()
            ours = not hasattr(os, "getuid") or found.st_uid == os.getuid()
            if not stat.S_ISDIR(found.st_mode) or not ours:
                continue
            with FeedReader(folder) as feed:
                over = feed.over
            if over:
                shutil.rmtree(folder, ignore_errors=True)
