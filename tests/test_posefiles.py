"""Poses on disk: what is written is what is read, in three formats."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers.frames import Recording
from tonguetrack.tracker.posefiles import read_poses, write_poses
from tonguetrack.tracker.session import Session
from tonguetrack.tracker.tracking import track_recording


@pytest.fixture(scope="module")
def run(small_model):
    """Two tracked experiments with a coil missing for a while and all missing for a while."""
    random = np.random.default_rng(0)
    swing = np.sin(np.linspace(0, 6, 60))[:, None] * random.uniform(0.2, 0.8, 4)
    shapes = [
        small_model.vertices(small_model.speaker.mean, small_model.pose.raw(x))[[3, 9, 15]] for x in swing
    ]
    positions = np.array(shapes) + random.normal(scale=0.2, size=(60, 3, 3))
    positions[:3] = np.nan
    positions[20:25, 1] = np.nan
    positions[40:45] = np.nan
    take = Recording(("TT", "TB", "TD"), positions, np.arange(60) / 200, 200.0, "test", source="take 1")
    vertices = {"tongue_tip": 3, "tongue_blade": 9, "tongue_dorsum": 15}
    return track_recording(take, small_model, Session(correspondences=vertices))


FIELDS = (
    "times_s", "statuses", "weights", "normalised", "speaker_weights", "energies", "residual_mm", "residuals_mm",
    "coils",
)  # fmt: skip


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("experiment", [1, 2])
def test_csv_and_npz_give_every_number_back_exactly(run, small_model, tmp_path, suffix, experiment):
    poses = run.experiment_1 if experiment == 1 else run.experiment_2
    write_poses(poses, small_model, tmp_path / f"p{suffix}")
    again = read_poses(tmp_path / f"p{suffix}")
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(again, name), getattr(poses, name), err_msg=name)
    for name in ("roles", "correspondences", "experiment", "rate_hz", "model_fingerprint", "recording"):
        assert getattr(again, name) == getattr(poses, name)


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("name", ["weights", "speaker_weights"])
def test_weights_that_are_no_numbers_are_refused_with_their_frame(run, small_model, tmp_path, suffix, name):
    weights = getattr(run.experiment_2, name).copy()
    weights[17, 1] = np.nan
    write_poses(
        dataclasses.replace(run.experiment_2, **{name: weights}), small_model, tmp_path / f"p{suffix}"
    )
    with pytest.raises(InputError, match="frame 17 has weights that are no numbers"):
        read_poses(tmp_path / f"p{suffix}")


ODD = 'a, "b"\nc\r# d: \u2028\x0c\x85 ə \udcff'


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
@pytest.mark.parametrize("name", [ODD, '"quoted"', " spaces ", "C:\\takes\\new", "a: b", ""])
def test_any_name_of_a_recording_or_model_comes_back(run, small_model, tmp_path, suffix, name):
    poses = dataclasses.replace(run.experiment_2, recording=name, model_path=name, model_name=name)
    write_poses(poses, small_model, tmp_path / f"p{suffix}")
    again = read_poses(tmp_path / f"p{suffix}")
    assert (again.recording, again.model_path, again.model_name) == (name, name, name)
    np.testing.assert_array_equal(again.coils, poses.coils)


def test_long_takes_are_written_and_read_in_parts(run, small_model, tmp_path, monkeypatch):
    write_poses(run.experiment_1, small_model, tmp_path / "whole.csv")
    monkeypatch.setattr("tonguetrack.tracker.posefiles.CHUNK_FRAMES", 7)
    write_poses(run.experiment_1, small_model, tmp_path / "parts.csv")
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    np.testing.assert_array_equal(read_poses(tmp_path / "parts.csv").coils, run.experiment_1.coils)


def test_a_failure_while_writing_leaves_the_old_file(run, small_model, tmp_path):
    (tmp_path / "p.json").write_text("old")
    broken = dataclasses.replace(run.experiment_1, times_s=np.full(60, np.nan))
    with pytest.raises(ValueError, match="JSON"):
        write_poses(broken, small_model, tmp_path / "p.json")
    assert [path.name for path in tmp_path.iterdir()] == ["p.json"]
    assert (tmp_path / "p.json").read_text() == "old"


def test_the_csv_tells_a_person_what_it_is(run, small_model, tmp_path):
    write_poses(run.experiment_2, small_model, tmp_path / "p.csv")
    lines = (tmp_path / "p.csv").read_text().splitlines()
    assert lines[0] == "# tonguetrack poses 1"
    assert "# model_name: random test model" in lines
    assert "# correspondences: tongue_tip=3 tongue_blade=9 tongue_dorsum=15" in lines
    header = next(line for line in lines if not line.startswith("#")).split(",")
    assert header[:7] == ["frame", "time_s", "status", "pose_1", "pose_2", "pose_3", "pose_4"]
    assert lines[-60].split(",")[2] == "lost"
    assert lines[-60 + 42].split(",")[2] == "held"
    assert lines[-60 + 42].split(",")[header.index("residual_mm")] == ""


def test_the_authors_json_has_the_authors_keys_and_numbers(run, small_model, tmp_path):
    poses = run.experiment_1
    write_poses(poses, small_model, tmp_path / "p.json")
    frames = json.loads((tmp_path / "p.json").read_text())
    assert len(frames) == 60
    frame = frames[30]
    assert set(frame) == {
        "energy", "error", "timeStamp", "source", "target", "speakerWeights", "speakerVariations",
        "phonemeWeights", "phonemeVariations",
    }  # fmt: skip
    assert frame["timeStamp"] == 0.15
    assert frame["phonemeWeights"] == poses.weights[30].tolist()
    variations = (poses.speaker_weights[30] - small_model.speaker.mean) * np.sqrt(11)
    np.testing.assert_allclose(frame["speakerVariations"], variations, atol=1e-12)
    distances = [
        np.linalg.norm([s[a] - t[a] for a in "xyz"])
        for s, t in zip(frame["source"], frame["target"], strict=True)
    ]
    assert np.mean(distances) == pytest.approx(frame["error"])
    assert len(frames[22]["target"]) == 2
    assert frames[42]["target"] == []
    assert frames[42]["phonemeWeights"] == poses.weights[39].tolist()


def test_the_authors_json_is_read_with_its_model(run, small_model, tmp_path):
    write_poses(run.experiment_2, small_model, tmp_path / "p.json")
    again = read_poses(tmp_path / "p.json", small_model)
    np.testing.assert_array_equal(again.weights, run.experiment_2.weights)
    np.testing.assert_array_equal(again.speaker_weights, run.experiment_2.speaker_weights)
    np.testing.assert_allclose(again.normalised, run.experiment_2.normalised, atol=1e-12)
    with pytest.raises(InputError, match="does not say which model it belongs to"):
        read_poses(tmp_path / "p.json")
    with pytest.raises(InputError, match="the model .* has 5 and 3"):
        read_poses(tmp_path / "p.json", small_model.truncated(5, 3))


@pytest.mark.parametrize("suffix", [".csv", ".json", ".npz"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_poses_file_opens_or_says_so(run, small_model, tmp_path, suffix, data):
    path = tmp_path / f"whole{suffix}"
    if not path.exists():
        write_poses(run.experiment_2, small_model, path)
    damaged = bytearray(path.read_bytes())
    del damaged[data.draw(st.integers(0, len(damaged))) :]
    for _ in range(data.draw(st.integers(0, 3))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / f"bad{suffix}").write_bytes(bytes(damaged))
    try:
        read_poses(tmp_path / f"bad{suffix}", small_model)
    except InputError as reason:
        assert "\n" not in str(reason)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.csv", "time,x\n1,2\n", "the first line should be '# tonguetrack poses 1'"),
        ("a.csv", "# tonguetrack poses 2\n", "format version 2; this tonguetrack reads 1"),
        ("a.csv", "# tonguetrack poses 1\n", "there are no frames"),
        ("a.json", "{}", "expected a list with one map a frame"),
        ("a.txt", "", "poses are written as .csv, .json, .npz"),
    ],
)
def test_what_is_not_a_poses_file_gets_one_sentence(small_model, tmp_path, name, content, sentence):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=sentence):
        read_poses(tmp_path / name, small_model)
