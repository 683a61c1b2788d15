"""Where compiled kernels are kept when neither the installation nor the home folder can be written to."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
_made: list[str] = []


def ensure_a_writable_cache() -> None:
    """Without a folder for its cache numba refuses to compile: then gives it one that lives as long as this process.

    It must be private, for numba unpickles what it finds there. Called before numba is imported.
    """
    if "numba" in sys.modules or os.environ.get(VARIABLE):
        return
    package = Path(__file__).parent
    if any(_can_be_made(folder) for folder in (package / "__pycache__", _users_cache())):
        return
    folder = tempfile.mkdtemp(prefix="tonguetrack-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = folder
    _made.append(folder)


def cache_lasts() -> bool:
    """Whether the next start finds what this one compiled."""
    return not _made


def cache_folder() -> Path | None:
    """Where numba keeps what it compiles, or will, by its rules; None where it can keep nothing."""
    if named := os.environ.get(VARIABLE):
        return Path(named)
    choices = (Path(__file__).parent / "__pycache__", _users_cache())
    return next((folder for folder in choices if _can_be_made(folder)), None)


def has_compiled_kernels(folder: Path) -> bool:
    """Whether a folder of the cache holds kernels that were compiled from the present source."""
    source_ns = Path(__file__).with_name("kernels.py").stat().st_mtime_ns
    found = [*folder.glob("kernels.*.nbi"), *folder.glob("*/kernels.*.nbi")]
    return any(index.stat().st_mtime_ns >= source_ns for index in found)


def _users_cache() -> Path:
    """numba's own choice, by its rules."""
    if sys.platform == "win32":
        named = os.environ.get("LOCALAPPDATA") or os.environ.get("APPDATA")
        return Path(named) if named else Path(os.path.expanduser("~"))
    if sys.platform == "darwin":
        return Path(os.path.expanduser("~/Library/Caches/numba"))
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "numba")


def _can_be_made(folder: Path) -> bool:
    """Whether the folder can be written to, or made in the nearest one above it that exists."""
    for place in (folder, *folder.parents):
        if os.path.isdir(place):
            return os.access(place, os.W_OK | os.X_OK)
        if os.path.lexists(place):
            return False
    return False
