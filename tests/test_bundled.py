"""What ships in the package: made by the commands that lie beside it, and synthetic wherever it is named."""

import json
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from tonguetrack.drivers import open_recording
from tonguetrack.model.files import load_model
from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.calibration import contours
from tonguetrack.tracker.session import load_session
from tonguetrack.tracker.tracking import track_recording

ROOT = Path(__file__).resolve().parents[1]


def run_script(script, folder):
    """Runs a shell script with this very installation's `tonguetrack` first on the path."""
    wrapper = folder / "bin" / "tonguetrack"
    wrapper.parent.mkdir()
    wrapper.write_text(
        f'#!/bin/sh\nexec "{sys.executable}" -c "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())" "$@"\n'
    )
    wrapper.chmod(0o755)
    work = folder / "work"
    work.mkdir()
    subprocess.run(
        ["sh", str(script)], cwd=work, check=True, timeout=300, capture_output=True,
        env={"PATH": f"{wrapper.parent}:/usr/bin:/bin", "HOME": str(folder), "LANG": "C.UTF-8"},
    )  # fmt: skip
    return work


def test_the_bundled_model_is_what_its_script_makes(tmp_path):
    made = load_model(run_script(ROOT / "model" / "data" / "make_default.sh", tmp_path) / "default.npz")
    shipped = bundled_model()
    # Another linear algebra library may round the last digits differently.
    np.testing.assert_allclose(made.origin, shipped.origin, atol=1e-6)
    np.testing.assert_allclose(made.core, shipped.core, atol=1e-4)
    np.testing.assert_allclose(made.pose.training, shipped.pose.training, atol=1e-6)
    np.testing.assert_array_equal(made.faces, shipped.faces)
    assert made.marks == shipped.marks
    assert {**made.provenance, "builder": ""} == {**shipped.provenance, "builder": ""}


def test_the_sample_recordings_are_what_their_script_makes(tmp_path):
    made = run_script(ROOT / "recordings" / "make_recordings.sh", tmp_path)
    for name in ("demo.csv", "dropouts.csv", "head-motion.csv"):
        new, shipped = open_recording(made / name), open_recording(ROOT / "recordings" / name)
        assert new.coils == shipped.coils
        np.testing.assert_allclose(new.positions, shipped.positions, atol=2e-3)
    new, shipped = (
        load_session(folder / "demo.session.toml").palate for folder in (made, ROOT / "recordings")
    )
    assert (made / "demo.palate.csv").read_text() == (ROOT / "recordings" / "demo.palate.csv").read_text()
    np.testing.assert_array_equal(new.points_mm, shipped.points_mm)


def test_the_bundled_model_says_that_it_is_synthetic():
    model = bundled_model()
    assert "synthetic" in model.name
    assert "not measured from anybody" in model.provenance["data"]
    assert (model.speaker.size, model.pose.size) == (5, 4)
    assert {"tip", "blade", "back", "dorsum", "lateral"} <= set(model.marks.regions)
    assert len(model.marks.midsagittal) > 40


def test_the_demo_has_a_complete_session():
    recording, session = bundled_recording()
    model = bundled_model()
    assert session.model_fingerprint == model.fingerprint
    assert session.speaker_weights is not None
    assert set(session.correspondences) == {"tongue_tip", "tongue_blade", "tongue_dorsum"}
    assert recording.rate_hz == 250
    assert "Synthetic" in recording.notes[0]


def test_the_demos_palate_bounds_its_tongue_and_is_nearly_touched_where_speech_does():
    recording, session = bundled_recording()
    model = bundled_model()
    poses = track_recording(recording, model, session, (2,)).experiment_2
    with np.load(ROOT / "recordings" / "demo.truth.npz") as truth:
        starts = truth["phone_times_s"]
        phones = json.loads(truth["words"].tobytes())["phones"]
    highest = np.nanmax(session.palate.above(contours(poses, model)), axis=1)
    assert highest.max() < 1.0
    for phone, low, high in (("s", -3.5, 0.5), ("i", -3.5, 0.5), ("a", -25.0, -12.0)):
        held = [start + 0.18 for start, one in zip(starts, phones, strict=False) if one == phone]
        frames = [round(t * recording.rate_hz) for t in held if t < recording.duration_s]
        assert frames and low < highest[frames].min() and highest[frames].max() < high


@pytest.mark.parametrize("name", ["default.npz"])
def test_the_data_lie_in_the_installed_package(name):
    assert (files("tonguetrack.model.data") / name).is_file()
    assert (files("tonguetrack.recordings") / "demo.csv").is_file()
