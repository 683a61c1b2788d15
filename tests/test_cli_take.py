"""`tonguetrack take list | info | recover | export`, and a take among the recordings."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import open_recording
from tonguetrack.drivers.xdf import boundary, file_header, samples, stream_footer, text_samples
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.cli import build_parser, main
from tonguetrack.tracker.pose import CoilState, PoseStatus
from tonguetrack.tracker.posefiles import read_poses
from tonguetrack.tracker.session import Session, load_session, session_toml
from tonguetrack.tracker.setup import complete_setup
from tonguetrack.tracker.takes.headers import header_bytes
from tonguetrack.tracker.takes.layout import STREAM_IDS, TakeInfo
from tonguetrack.tracker.tracking import track_recording

FRAMES = 120
DEMO = Path(__file__).resolve().parents[1] / "recordings" / "demo.csv"


@pytest.fixture(scope="module")
def model():
    return bundled_model()


@pytest.fixture(scope="module")
def tracked(model):
    """The demo's first frames, tracked: what a live run would have recorded."""
    from dataclasses import replace

    whole = open_recording(DEMO)
    recording = replace(whole, positions=whole.positions[:FRAMES].copy(), times_s=whole.times_s[:FRAMES])
    return recording, track_recording(recording, model, setup=complete_setup(recording, model, Session()))


@pytest.fixture(scope="module")
def content(model, tracked):
    """The chunks of the take: header, numbers in flushes of 30 frames, markers, footers."""
    recording, run = tracked
    poses = run.experiment_2
    info = TakeInfo(
        source="rtc3d://lab:3030", coils=recording.coils, rate_hz=recording.rate_hz, frame=recording.frame,
        quaternions=False, rms=False, status=False, roles=poses.roles, vertices=poses.correspondences,
        model_name=model.name, model_fingerprint=model.fingerprint, pose_mean=model.pose.mean,
        pose_sigma=model.pose.sigma, speaker_size=model.speaker.size, session_toml=session_toml(Session()),
        started="2026-11-22T09:00:00+01:00", version="0.3.0",
    )  # fmt: skip
    at = 1000.0 + recording.times_s
    at[60:] += 2.0  # the device was away
    states = np.full((FRAMES, len(poses.roles)), float(CoilState.TRUSTED))
    states[:30, 0] = CoilState.WILD
    head = [
        poses.statuses,
        np.ones(FRAMES),
        np.full(FRAMES, 3),
        poses.energies,
        poses.residual_mm,
        np.zeros(FRAMES),
    ]
    numbers = {
        "raw": np.column_stack(
            [recording.times_s, np.arange(FRAMES), recording.positions.reshape(FRAMES, -1)]
        ),
        "prepared": poses.coils.reshape(FRAMES, -1),
        "pose": np.column_stack([*head, poses.weights, poses.speaker_weights, poses.residuals_mm, states]),
    }
    parts = [file_header({}), header_bytes(info)]
    for begin in range(0, FRAMES, 30):
        part = slice(begin, begin + 30)
        parts += [samples(STREAM_IDS[name], at[part], values[part]) for name, values in numbers.items()]
        parts.append(boundary())
    parts.append(
        text_samples(
            4, [at[10], at[60] - 0.1, at[60]],
            ["Anna, zweiter Versuch", "source: gap: 500 frames are missing", f"session: {session_toml(run.setup.session)}"],
        )
    )  # fmt: skip
    parts += [stream_footer(STREAM_IDS[name], at[0], at[-1], FRAMES) for name in numbers]
    return [*parts, stream_footer(4, at[10], at[60], 3)]


@pytest.fixture
def take(content, tmp_path):
    path = tmp_path / "take.xdf"
    path.write_bytes(b"".join(content))
    return path


@pytest.fixture
def cut_take(content, tmp_path):
    path = tmp_path / "cut" / "take.xdf"
    path.parent.mkdir()
    path.write_bytes(b"".join(content[:9])[:-5])
    return path


def run(*arguments):
    args = build_parser().parse_args([str(argument) for argument in arguments])
    return args.run(args)


def test_list_tells_every_take_below_a_folder_and_what_is_none(take, cut_take, tmp_path, capsys):
    (tmp_path / "eeg.XDF").write_bytes(file_header({}))
    (tmp_path / "notes.txt").write_text("not listed")
    assert run("take", "list", tmp_path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("2 take(s)")
    cut, whole, none = lines[1:]
    assert (
        str(take) in whole
        and "120 frames" in whole
        and "3 of 3 coils" in whole
        and whole.endswith("complete")
    )
    assert str(cut_take) in cut and "60 frames" in cut and cut.endswith("unfinished")
    assert "not a take" in none and "eeg.XDF" in none and "notes" not in none


def test_list_as_json_has_the_same(take, cut_take, tmp_path, capsys):
    assert run("take", "list", tmp_path, "--json") == 0
    rows = {row["file"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows[str(take)]["state"] == "complete" and rows[str(take)]["damage"] is None
    assert rows[str(take)]["duration_s"] == pytest.approx(2.0 + 119 / 250)
    assert rows[str(cut_take)]["frames"] == 60 and "cut off" in rows[str(cut_take)]["damage"]


def test_a_folder_without_takes_or_without_existence_is_told_plainly(tmp_path, capsys):
    assert run("take", "list", tmp_path) == 0
    assert capsys.readouterr().out.strip().endswith("0 take(s)")
    with pytest.raises(InputError, match="no such folder"):
        run("take", "list", tmp_path / "nowhere")


def test_info_tells_streams_gaps_statuses_and_markers(take, capsys):
    assert run("take", "info", take) == 0
    text = capsys.readouterr().out
    assert "state     complete" in text
    assert "120 at 250 Hz" in text
    assert "gaps      1, the longest 2.004 s" in text
    assert "poses     ok 100.0 %" in text
    first_role = next(line for line in text.splitlines() if "(vertex" in line)
    assert first_role.endswith("trusted 75.0 %, wild 25.0 %")
    assert "raw: 120 samples of 11 channels" in text and "markers: 3 samples of 1 channels" in text
    assert "0.040 s  Anna, zweiter Versuch" in text and "source: gap: 500 frames" in text


def test_info_as_json_has_everything(take, model, capsys):
    assert run("take", "info", take, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == FRAMES and summary["rate_hz"] == 250.0
    assert summary["statuses"] == {PoseStatus.OK.name.lower(): 1.0}
    assert summary["gaps"]["count"] == 1
    assert [stream["samples"] for stream in summary["streams"]] == [120, 120, 120, 3]
    assert [mark["kind"] for mark in summary["markers"]] == ["user", "source", "session"]
    assert summary["model_fingerprint"] == model.fingerprint


def test_a_cut_take_is_recovered_into_a_new_file(cut_take, tmp_path, capsys):
    new = tmp_path / "new" / "take.xdf"
    assert run("take", "recover", cut_take, "-o", new) == 0
    said = capsys.readouterr().out
    assert "60 frames" in said and "cut off at byte" in said and "no journal" in said
    assert run("take", "info", new) == 0
    assert "state     complete" in capsys.readouterr().out
    with pytest.raises(InputError, match="never overwritten"):
        run("take", "recover", cut_take, "-o", new)
    with pytest.raises(InputError, match="nothing to recover"):
        run("take", "recover", new, "-o", tmp_path / "again.xdf")


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".json"])
def test_the_recording_in_a_take_goes_into_every_format_for_recordings(take, tracked, suffix, tmp_path):
    assert run("take", "export", take, "-o", tmp_path / f"out{suffix}") == 0
    again = open_recording(tmp_path / f"out{suffix}")
    np.testing.assert_array_equal(again.positions, tracked[0].positions)
    assert again.coils == tracked[0].coils


def test_prepared_coils_are_a_recording_in_the_models_frame(take, tracked, tmp_path):
    assert run("take", "export", take, "-o", tmp_path / "p.csv", "--what", "prepared") == 0
    again = open_recording(tmp_path / "p.csv")
    poses = tracked[1].experiment_2
    assert again.coils == poses.roles and again.frame.origin == "model"
    np.testing.assert_array_equal(again.positions, poses.coils)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".json"])
def test_exported_poses_are_poses_to_every_other_command(take, tracked, model, suffix, tmp_path):
    out = tmp_path / f"poses{suffix}"
    assert run("take", "export", take, "-o", out, "--what", "poses") == 0
    again = read_poses(out, model)
    expected = tracked[1].experiment_2
    np.testing.assert_array_equal(again.weights, expected.weights)
    np.testing.assert_array_equal(again.coils, expected.coils)
    named = ["--model", "bundled"] if suffix == ".json" else []
    assert run("mesh", out, "--frame", 7, "-o", tmp_path / "tongue.ply", *named) == 0
    if suffix == ".npz":
        np.testing.assert_allclose(again.vertices, expected.vertices, atol=1e-9)


def test_poses_of_another_model_are_written_without_its_place_and_not_as_json(content, model, tmp_path):
    path = tmp_path / "take.xdf"
    path.write_bytes(b"".join(content).replace(model.fingerprint.encode(), b"f" * len(model.fingerprint)))
    assert run("take", "export", path, "-o", tmp_path / "p.csv", "--what", "poses") == 0
    assert read_poses(tmp_path / "p.csv").model_path == ""
    with pytest.raises(InputError, match="name that one with --model"):
        run("take", "export", path, "-o", tmp_path / "p.json", "--what", "poses")


def test_the_exported_session_is_the_last_one_and_track_takes_it(take, tracked, tmp_path, capsys):
    out = tmp_path / "s.toml"
    assert run("take", "export", take, "-o", out, "--what", "session") == 0
    assert "from frame 60 on" in capsys.readouterr().out
    session, expected = load_session(out), tracked[1].setup.session
    np.testing.assert_array_equal(session.speaker_weights, expected.speaker_weights)
    assert session.correspondences == expected.correspondences
    assert run("track", take, "--session", out, "--out", tmp_path / "poses.npz") == 0
    np.testing.assert_array_equal(read_poses(tmp_path / "poses.npz").weights, tracked[1].experiment_2.weights)


def test_exported_markers_are_a_table(take, tmp_path):
    assert run("take", "export", take, "-o", tmp_path / "m.csv", "--what", "markers") == 0
    rows = list(csv.DictReader((tmp_path / "m.csv").open(encoding="utf-8", newline="")))
    assert [row["kind"] for row in rows] == ["user", "source", "session"]
    assert rows[0]["text"] == "Anna, zweiter Versuch" and rows[0]["frame"] == "10"
    assert float(rows[0]["time_s"]) == pytest.approx(0.04)


def test_a_name_that_does_not_fit_or_the_take_itself_is_refused_before_anything_is_read(take, tmp_path):
    with pytest.raises(InputError, match=r"session of a take can be written as \.toml"):
        run("take", "export", take, "-o", tmp_path / "s.csv", "--what", "session")
    with pytest.raises(InputError, match="written as"):
        run("take", "export", take, "-o", take)


def test_commands_for_recordings_take_a_take(take, tmp_path, capsys):
    assert run("info", take) == 0
    assert "tonguetrack take 1 (XDF)" in capsys.readouterr().out
    assert run("convert", take, tmp_path / "out.csv") == 0
    assert open_recording(tmp_path / "out.csv").frame_count == FRAMES


def test_what_is_not_a_take_is_one_sentence_and_exit_code_2(tmp_path, capsys):
    (tmp_path / "a.xdf").write_bytes(b"XDF:")
    assert main(["take", "info", str(tmp_path / "a.xdf")]) == 2
    assert "not a take" in capsys.readouterr().err
