"""What pictures need from the system: EGL, a virtual display, a browser. Absent, a test is skipped with the reason.

TONGUETRACK_REQUIRE_DISPLAY=1 makes that a failure, as in continuous integration, where all of them are installed.
"""

import os
import shutil
from functools import cache

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def require_egl() -> None:
    """For tests that draw without a window."""
    if reason := egl_missing():
        absent(reason)


def require_xvfb() -> None:
    """For tests that open a window on a display of their own."""
    if shutil.which("Xvfb") is None or shutil.which("xvfb-run") is None:
        absent("Xvfb is not installed (Debian: apt install xvfb xauth)")


def require_chromium() -> str:
    """For tests in a real browser; returns its path."""
    for name in BROWSERS:
        if found := shutil.which(name):
            return found
    absent("no Chromium is installed (Debian: apt install chromium)")
    raise AssertionError


def absent(reason: str) -> None:
    if os.environ.get("TONGUETRACK_REQUIRE_DISPLAY") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


@cache
def egl_missing() -> str:
    """Why no context can be made without a window; "" = one can."""
    from tonguetrack import InputError
    from tonguetrack.tracker.viewer.offscreen import egl_context

    try:
        egl_context().release()
    except InputError as reason:
        return str(reason)
    return ""
