"""`simulate recording --palate` and `track --palate`, as a user runs them: a palate beside a recording, into a session."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tonguetrack.drivers import FrameOfReference, Recording, open_recording, write_recording
from tonguetrack.model.mri.phantom.anatomy import head_of
from tonguetrack.model.mri.phantom.tissue import roof_height
from tonguetrack.model.mri.phantom.unseen import unseen_speaker
from tonguetrack.tracker.bundled import bundled_recording
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.palate import read_palate
from tonguetrack.tracker.session import load_session, session_toml

DEVICE_AXES = FrameOfReference("front", "left", "up", "upper incisors")
TO_DEVICE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # from left, back, up
SHIFT_MM = np.array([10.0, -4.0, 25.0])


def run(*arguments):
    return main([str(argument) for argument in arguments])


@pytest.fixture()
def place(tmp_path, monkeypatch):
    """A folder with one second of the demo in a device's axes, the session that places it, and the palate in those axes.

    take.csv, s.toml (no palate), palate.csv (cm); returns the true palate (n, 3) mm in the model's frame.
    """
    recording, session = bundled_recording()
    assert session.palate is not None
    monkeypatch.chdir(tmp_path)
    part = slice(250, 500)
    moved = recording.positions[part] @ TO_DEVICE.T + SHIFT_MM
    take = replace(recording, positions=moved, times_s=recording.times_s[part], frame=DEVICE_AXES)
    write_recording(take, "take.csv")
    back = replace(session.alignment, rotation=TO_DEVICE.T, translation_mm=-TO_DEVICE.T @ SHIFT_MM)
    (tmp_path / "s.toml").write_text(session_toml(replace(session, palate=None, alignment=back)))
    np.savetxt("palate.csv", (session.palate.points_mm @ TO_DEVICE.T + SHIFT_MM) / 10.0, "%.4f", ",")
    return session.palate.points_mm


def track(*more, take="take.csv", session="s.toml", palate="palate.csv"):
    return run("track", take, "--session", session, "--palate", palate, *more)


def saved():
    palate = load_session("new.toml").palate
    assert palate is not None
    return palate.points_mm


def refused(capsys, *arguments, **files):
    """Exit code 2, nothing written; the sentence, on one line."""
    capsys.readouterr()
    assert track("--save-session", "new.toml", "--out", "poses.csv", *arguments, **files) == 2
    assert not Path("new.toml").exists() and not Path("poses.csv").exists()
    return " ".join(capsys.readouterr().err.split("tonguetrack:")[-1].split())


# simulate -------------------------------------------------------------------------------------------


def test_the_trace_beside_a_recording_is_that_speakers_palate_above_that_speakers_tongue(tmp_path, capsys):
    out = tmp_path / "take.csv"
    palate_file = tmp_path / "traces" / "palate.csv"
    assert run("simulate", "recording", out, "--speaker", 3, "--seconds", 3, "--palate", palate_file) == 0
    assert "points of this speaker's palate" in capsys.readouterr().err
    palate = read_palate(palate_file, open_recording(out).frame, "mm")
    points = palate.points_mm
    head = head_of(unseen_speaker(3).anatomy)
    roof = [head.size * roof_height(0.0, y / head.size, head) for y in points[:, 1]]
    np.testing.assert_allclose(points[:, 2], roof, atol=6e-4)
    assert (points[:, 0] == 0).all() and 40 < np.ptp(points[:, 1]) < 60
    with np.load(tmp_path / "take.truth.npz") as truth:
        contours = truth["contours"].astype(np.float64)
        np.testing.assert_allclose(truth["palate"], points, atol=6e-4)
    highest = np.nanmax(palate.above(contours))
    assert -4.0 < highest <= 0.0


def test_a_recording_is_the_same_with_and_without_the_trace(tmp_path):
    with_it, without = tmp_path / "a.csv", tmp_path / "b.csv"
    assert run("simulate", "recording", with_it, "--seconds", 1, "--palate", tmp_path / "palate.csv") == 0
    assert run("simulate", "recording", without, "--seconds", 1) == 0
    assert with_it.read_bytes() == without.read_bytes()
    assert with_it.with_name("a.truth.npz").read_bytes() == without.with_name("b.truth.npz").read_bytes()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--palate", "palate.csv", "--head-motion"), "the mouth moves in the recording's axes"),
        (("--palate", "take.csv"), "the recording or its truth goes there"),
        (("--palate", "./take.truth.npz"), "the recording or its truth goes there"),
    ],
)
def test_a_trace_that_would_mean_nothing_or_overwrite_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, capsys, flags, words
):
    monkeypatch.chdir(tmp_path)
    assert run("simulate", "recording", "take.csv", "--seconds", 1, *flags) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# track ----------------------------------------------------------------------------------------------


def test_a_trace_in_the_recordings_axes_comes_into_the_session_as_the_coils_come_into_the_model(
    place, capsys
):
    assert track("--save-session", "new.toml") == 0
    np.testing.assert_allclose(saved(), place, atol=2e-3)
    told = capsys.readouterr().err
    assert "only in cm it is as long as a palate" in told
    assert (
        "palate: 47 points over 46 mm front to back (palate.csv); 99 % of the tongue samples stay below"
        in told
    )


def test_everything_else_in_the_saved_session_is_as_without_a_palate(place):
    assert track("--save-session", "new.toml") == 0
    assert run("track", "take.csv", "--session", "s.toml", "--save-session", "plain.toml") == 0
    with_it, plain = load_session("new.toml"), load_session("plain.toml")
    assert session_toml(replace(with_it, palate=None)) == session_toml(plain)


def test_a_palate_that_the_session_has_already_is_replaced(place):
    assert track("--save-session", "new.toml") == 0
    trace = np.loadtxt("palate.csv", delimiter=",")
    np.savetxt("higher.csv", trace + [0.0, 0.0, 0.3], "%.4f", ",")
    assert track("--save-session", "new.toml", session="new.toml", palate="higher.csv") == 0
    np.testing.assert_allclose(saved(), place + [0.0, 0.0, 3.0], atol=2e-3)


def test_a_recording_of_a_swept_probe_does_as_well(place):
    there_and_back = np.concatenate([place, place[::-1]]) @ TO_DEVICE.T + SHIFT_MM
    probe = np.repeat(there_and_back, 20, axis=0)[:, None]
    probe += np.random.default_rng(1).normal(scale=0.1, size=probe.shape)
    write_recording(
        Recording(("palate_probe",), probe, np.arange(len(probe)) / 250, 250.0, "test", DEVICE_AXES),
        "sweep.csv",
    )
    assert track("--save-session", "new.toml", palate="sweep.csv") == 0
    y, z = saved()[:, 1], saved()[:, 2]
    inside = (y > place[5, 1]) & (y < place[-3, 1])
    assert inside.sum() > 35
    assert np.abs(z - np.interp(y, place[:, 1], place[:, 2]))[inside].max() < 0.5


def test_a_palate_below_the_tongue_is_refused(place, capsys):
    trace = np.loadtxt("palate.csv", delimiter=",")
    np.savetxt("low.csv", trace - [0.0, 0.0, 1.8], "%.4f", ",")
    said = refused(capsys, palate="low.csv")
    assert said.startswith("low.csv: this palate is below the tongue") and "take.csv" in said


def test_a_palate_of_a_recording_that_does_not_state_its_axes_is_refused(place, capsys):
    take = open_recording("take.csv")
    write_recording(replace(take, frame=FrameOfReference("unknown", "unknown", "unknown")), "open.csv")
    said = refused(capsys, take="open.csv")
    assert "open.csv does not state them" in said and "--frame" in said


def test_an_alignment_that_turns_the_stated_axes_elsewhere_is_named(place, capsys):
    take = open_recording("take.csv")
    write_recording(replace(take, frame=FrameOfReference("left", "front", "up")), "turned.csv")
    said = refused(capsys, take="turned.csv")
    assert (
        "turned.csv says that its axes are x left, y front, z up" in said and "[alignment] of s.toml" in said
    )


def test_a_palate_that_would_go_nowhere_is_refused(place, capsys):
    assert track("--out", "poses.csv") == 2
    assert "--save-session FILE" in capsys.readouterr().err


def test_the_trace_is_never_written_over(place, capsys):
    before = Path("palate.csv").read_text()
    assert track("--save-session", "palate.csv") == 2
    assert "read here and would be overwritten" in capsys.readouterr().err
    assert Path("palate.csv").read_text() == before
