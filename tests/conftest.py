"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest

NOWHERE = "the reference data are not there: set TONGUETRACK_REFERENCE_DATA to their folder"


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """The folder of real recordings and meshes, which are never part of the project.

    It is the one named in TONGUETRACK_REFERENCE_DATA, else `shared/data` beside the checkout. Without it the
    test is skipped, or fails if TONGUETRACK_REQUIRE_REFERENCE_DATA is 1.
    """
    named = os.environ.get("TONGUETRACK_REFERENCE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        if os.environ.get("TONGUETRACK_REQUIRE_REFERENCE_DATA") == "1":
            pytest.fail(f"{NOWHERE} (looked in {folder})")
        pytest.skip(f"{NOWHERE} (looked in {folder})")
    return folder
