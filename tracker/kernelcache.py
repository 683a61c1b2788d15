"""Where compiled kernels are kept when neither the installation nor the home folder can be written to."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
KERNEL_MODULES = {
    "drivers.devices.rtc3d_decode": "RTC3D",
    "model.nearest": "specificity",
    "model.neighbours": "neighbours in point clouds",
    "model.surfacedistance": "distances to the truth",
    "model.mri.bending": "template matching",
    "model.mri.diffusion": "denoising of scans",
    "model.mri.palatealignment": "alignment of palates",
    "model.mri.phantom.tissue": "phantom's anatomy and volumes",
    "tracker.alignmentterms": "calibration",
    "tracker.anatomy": "joint speaker",
    "tracker.filters": "live smoothing",
    "tracker.guard": "coil guard",
    "tracker.headcorrection": "head correction",
    "tracker.kernels": "solver",
    "tracker.preparation": "head correction of live frames",
}
"""Every module with compiled functions, and what they are for."""
_PACKAGE = Path(__file__).parent
_made: list[str] = []


def ensure_a_writable_cache() -> None:
    """Without a folder for its cache numba refuses to compile: then gives it one that lives as long as this process.

    It must be private, for numba unpickles what it finds there. Called before numba is imported.
    """
    if "numba" in sys.modules or os.environ.get(VARIABLE):
        return
    if any(_can_be_made(folder) for folder in (_PACKAGE / "__pycache__", _users_cache())):
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
    choices = (_PACKAGE / "__pycache__", _users_cache())
    return next((folder for folder in choices if _can_be_made(folder)), None)


def modules_to_compile(folder: Path) -> tuple[str, ...]:
    """Those of KERNEL_MODULES of which `cache_folder()` holds nothing that was compiled from the present source."""
    return tuple(name for name in KERNEL_MODULES if not _is_compiled(name, folder))


def compilations() -> int:
    """How many compiled functions this process did not find in the cache, so far."""
    # A function may have a name in several modules.
    modules = [sys.modules.get(f"{__package__.partition('.')[0]}.{name}") for name in KERNEL_MODULES]
    found = {id(value): value for module in modules if module is not None for value in vars(module).values()}
    statistics = [value.stats for value in found.values() if hasattr(value, "py_func")]
    return sum(sum(each.cache_misses.values()) for each in statistics)


def _is_compiled(module: str, folder: Path) -> bool:
    source = _PACKAGE.parent.joinpath(*module.split(".")).with_suffix(".py")
    # Beside each module where that can be written to, else all in one folder, by numba's rules.
    beside = folder == _PACKAGE / "__pycache__"
    places = [source.parent / "__pycache__"] if beside else folder.glob(f"{source.parent.name}_*")
    newest_ns = max(
        (index.stat().st_mtime_ns for place in places for index in place.glob(f"{source.stem}.*.nbi")),
        default=0,
    )
    return newest_ns >= source.stat().st_mtime_ns


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
