"""Writing recordings: the suffix of the name chooses the format."""

from __future__ import annotations

import os
from pathlib import Path

from ... import InputError
from ...atomic import write_atomically
from ..frames import Recording
from .authors import authors_bytes
from .npz import npz_bytes
from .tabular import table_bytes

WRITERS = {".csv": table_bytes, ".json": authors_bytes, ".npz": npz_bytes}


def check_target(path: str | os.PathLike[str]) -> None:
    """InputError unless the suffix is one that can be written."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise InputError(
            f"{path}: recordings are written as .csv, .json (the authors' EMA format) or .npz, not as "
            f"{suffix or 'a name without suffix'}; choose one of them."
        )


def write_recording(recording: Recording, path: str | os.PathLike[str]) -> Path:
    """Write a recording as .csv, .json (the authors' EMA format) or .npz; whole or not at all.

    CSV and .npz keep everything bit for bit. The authors' JSON keeps names, positions, fit errors and
    times (missing samples as described in `authors`). Positions stay in the recording's own axes.
    """
    check_target(path)
    return write_atomically(path, WRITERS[Path(path).suffix.lower()](recording))
