"""Fixtures for all tests."""

import os
import signal
import sys
from pathlib import Path

# What stands beside the tests and is none: decoders, fixtures.
sys.path.append(str(Path(__file__).parent))

# Several workers on few cores: the linear algebra library's own threads only get in each other's way.
for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

# A suite that a script runs in the background may have been told to ignore these, and every program that a test
# starts would inherit it; but Ctrl-C is among what is tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGQUIT") and signal.getsignal(signal.SIGQUIT) is signal.SIG_IGN:
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)

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


@pytest.fixture(scope="session")
def small_model():
    """A small random model with the statistics of a real one: 60 vertices, 5 speaker and 4 pose weights.

    The vertices lie on a half circle in the mid-sagittal plane, tip to root, with a strip on either side.
    """
    import numpy as np

    from tonguetrack.model.build import TrainingShapes, model_from_shapes
    from tonguetrack.model.multilinear import SurfaceMarks

    random = np.random.default_rng(7)
    angle = np.linspace(0.1, np.pi * 0.9, 20)
    contour = np.column_stack([np.zeros(20), 30 - 25 * np.cos(angle), 22 * np.sin(angle) - 15])
    strips = [contour + [offset, 0, -abs(offset) / 4] for offset in (0.0, 8.0, -8.0)]
    base = np.concatenate(strips).ravel()
    speakers = random.normal(size=(11, 6)) @ random.normal(size=(6, len(base))) * 0.8
    poses = random.normal(size=(13, 5)) @ random.normal(size=(5, len(base))) * 1.2
    mixed = np.einsum("ia,jb,abk->ijk", random.normal(size=(11, 3)), random.normal(size=(13, 3)),
                      random.normal(size=(3, 3, len(base)))) * 0.3  # fmt: skip
    faces = [[i, i + 1, 20 + i] for i in range(19)] + [[i, 40 + i, i + 1] for i in range(19)]
    shapes = TrainingShapes(
        base + speakers[:, None] + poses[None] + mixed,
        np.array(faces, dtype=np.int32),
        tuple(f"Speaker{i:02d}" for i in range(1, 12)),
        tuple("abcdefghijklm"),
        marks=SurfaceMarks({"Tip": 0}, {"tip": (0, 1)}, tuple(range(20))),
        provenance={"data": "random numbers for a test"},
    )
    return model_from_shapes(shapes, 5, 4, {"name": "random test model"})
