"""What ships in the package: made by the commands that lie beside it, and synthetic wherever it is named."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from tonguetrack.drivers import open_recording
from tonguetrack.model.files import load_model
from tonguetrack.model.mri.phantom.making import PROVENANCE, phantom_speaker
from tonguetrack.model.mri.phantom.unseen import SEED, SHIPPED, computed_speaker, unseen_speaker
from tonguetrack.model.mri.settings import BuildSettings, settings_digest
from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.calibration import contours
from tonguetrack.tracker.session import load_session
from tonguetrack.tracker.tracking import track_recording

ROOT = Path(__file__).resolve().parents[1]
MAKE_DEFAULT = ROOT / "model" / "data" / "make_default.sh"
NIGHTLY = os.environ.get("TONGUETRACK_FUZZ") == "nightly"
SPEAKERS = 11


def run_script(script, folder, timeout_s=300):
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
        ["sh", str(script)], cwd=work, check=True, timeout=timeout_s, capture_output=True,
        env={"PATH": f"{wrapper.parent}:/usr/bin:/bin", "HOME": str(folder), "LANG": "C.UTF-8"},
    )  # fmt: skip
    return work


@pytest.mark.skipif(not NIGHTLY, reason="a quarter of an hour: runs with TONGUETRACK_FUZZ=nightly")
def test_the_bundled_model_is_what_its_script_makes(tmp_path):
    pytest.importorskip("nibabel")
    made = load_model(run_script(MAKE_DEFAULT, tmp_path, timeout_s=3 * 3600) / "default.npz")
    shipped = bundled_model()
    np.testing.assert_array_equal(made.faces, shipped.faces)
    assert made.marks == shipped.marks
    assert {**made.provenance, "builder": ""} == {**shipped.provenance, "builder": ""}
    # Another linear algebra library may round the last digits differently, and steps of the pipeline go on from there.
    for speaker in range(made.speaker.entries):
        for pose in range(made.pose.entries):
            one, other = (
                model.vertices(model.speaker.training[speaker], model.pose.training[pose])
                for model in (made, shipped)
            )
            apart = np.linalg.norm(one - other, axis=1)
            assert apart.mean() < 0.05 and apart.max() < 1.0


def test_the_bundled_models_provenance_names_its_recipe():
    script = MAKE_DEFAULT.read_text(encoding="utf-8")
    phantom = re.search(r"^tonguetrack mri phantom (\w+) --seed (\d+)$", script, re.MULTILINE)
    build = re.search(
        r'^tonguetrack mri build (\w+)/(\S+) -o default.npz --name "([^"]+)"$', script, re.MULTILINE
    )
    assert phantom and build and phantom[1] == build[1]
    told = bundled_model().provenance
    version = r"tonguetrack \d+\.\d+\.\d+\S*"
    assert re.fullmatch(version, told["builder"])
    assert told["source"] == build[2]
    assert told["name"] == build[3]
    data, _, seed = told["data"].rpartition(", seed ")
    assert seed == phantom[2]
    assert data.startswith(f"{PROVENANCE}; ") and re.fullmatch(version, data.removeprefix(f"{PROVENANCE}; "))
    assert told["settings"] == settings_digest(BuildSettings())


@pytest.mark.parametrize("phone", ["s", "ɑ"])
def test_the_speakers_that_ship_are_what_their_script_makes(phone):
    shipped, made = unseen_speaker(SHIPPED[-1]), computed_speaker(SHIPPED[-1], [phone])
    assert shipped.anatomy == made.anatomy
    assert shipped.rest_mm == pytest.approx(made.rest_mm, abs=1e-6)
    np.testing.assert_allclose(shipped.surfaces[phone], made.surfaces[phone], atol=1e-3)


def test_no_speaker_that_is_simulated_is_in_the_bundled_models_training_set():
    seed = int(bundled_model().provenance["data"].rpartition(", seed ")[2])
    training = {replace(phantom_speaker(seed, number).anatomy, name="") for number in range(1, SPEAKERS + 1)}
    assert bundled_model().speaker.names == tuple(
        phantom_speaker(seed, number).anatomy.name for number in range(1, SPEAKERS + 1)
    )
    assert seed != SEED
    for number in range(200):
        assert replace(phantom_speaker(SEED, number).anatomy, name="") not in training


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
    assert model.provenance["data"].startswith("synthetic")
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
    assert poses.residual_mm.mean() < 1.0
    assert np.abs(poses.normalised).max() < 3.0
    highest = np.nanmax(session.palate.above(contours(poses, model)), axis=1)
    assert highest.max() < 1.0
    for phone, low, high in (("s", -5.5, 0.5), ("i", -5.5, 0.5), ("a", -25.0, -11.0)):
        held = [start + 0.18 for start, one in zip(starts, phones, strict=False) if one == phone]
        frames = [round(t * recording.rate_hz) for t in held if t < recording.duration_s]
        assert frames and low < highest[frames].min() and highest[frames].max() < high


@pytest.mark.parametrize("name", ["default.npz", "unseen.npz"])
def test_the_data_lie_in_the_installed_package(name):
    assert (files("tonguetrack.model.data") / name).is_file()
    assert (files("tonguetrack.recordings") / "demo.csv").is_file()
