"""A small phantom data set for the whole session: made once, whichever test worker is first."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest

SEED = 3
SPEAKERS = 2
PHONES = ("i", "a", "ɑ")
PATIENCE_S = 180.0


def shared_phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """dataset.toml of two speakers who hold three phones, [i] with contact; nobody may change what it names."""
    from tonguetrack.model.mri.phantom.making import make_phantom

    base = tmp_path_factory.getbasetemp()
    # pytest-xdist gives each worker a folder below one that they share.
    shared = base.parent if base.name.startswith("popen-") else base
    place = shared / f"phantom-{SPEAKERS}-{SEED}"
    lock = place.with_suffix(".lock")
    try:
        lock.touch(exist_ok=False)
    except FileExistsError:
        end = time.monotonic() + PATIENCE_S
        while not place.is_dir():
            assert time.monotonic() < end, f"{place} was not made by the worker that took {lock}"
            time.sleep(0.2)
        return place / "dataset.toml"
    made = make_phantom(place.with_suffix(".part"), SPEAKERS, SEED, PHONES)
    made.parent.rename(place)
    return place / "dataset.toml"


def copied(dataset: Path, folder: Path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(dataset.parent, folder)
    return folder / dataset.name
