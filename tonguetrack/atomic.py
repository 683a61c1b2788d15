"""Writing a file so that nobody ever sees half of it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from . import InputError


def write_atomically(path: str | Path, content: bytes) -> None:
    """Writes to a temporary name beside the target, then renames: the old file or the new one, never half.

    Raises InputError where the place cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: this is a folder; name a file in it to write to.")
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    except OSError as reason:
        raise InputError(f"{path}: cannot write here ({reason.strerror}); choose another place.") from reason
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as reason:
        Path(temporary).unlink(missing_ok=True)
        raise InputError(f"{path}: writing failed ({reason.strerror}); nothing was left behind.") from reason
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
