"""`tonguetrack export` and `mesh --speaker` as a user runs them: what is in the files is what was tracked."""

import csv
import struct
from dataclasses import replace

import numpy as np
import pytest
from strict_gltf import read_glb, to_model_frame
from test_transfer import PALATE, another, poses_of

from tonguetrack.model.files import save_model
from tonguetrack.model.mesh import read_mesh
from tonguetrack.model.midsagittal import midsagittal_vertices
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.posefiles import write_poses
from tonguetrack.tracker.session import Session, session_toml

MODEL = "random test model"


@pytest.fixture
def poses(small_model):
    """30 frames at 250 Hz, the tip's coil missing in frames 4 to 6."""
    made = replace(poses_of(small_model), model_path="model.npz", model_name=MODEL)
    made.coils[4:7, 0] = np.nan
    return made


@pytest.fixture
def place(small_model, poses, tmp_path, monkeypatch):
    """A working folder with model.npz, poses.csv of a fixed speaker, free.csv of a free one, own.toml and other.toml."""
    monkeypatch.chdir(tmp_path)
    save_model(small_model, "model.npz")
    write_poses(poses, small_model, "poses.csv")
    write_poses(free(poses), small_model, "free.csv")
    (tmp_path / "own.toml").write_text(PALATE)
    session = Session(speaker_weights=another(small_model), model_fingerprint=small_model.fingerprint)
    (tmp_path / "other.toml").write_text(session_toml(session))
    return tmp_path


def free(poses):
    """The same poses with a speaker who is another one in every frame."""
    strays = np.random.default_rng(4).normal(scale=0.1, size=poses.speaker_weights.shape)
    return replace(poses, speaker_weights=poses.speaker_weights + strays, experiment=1)


def run(*arguments):
    return main([str(argument) for argument in arguments])


def tongue_in(file):
    nodes, _ = read_glb(file.read_bytes())
    return nodes[MODEL]


def worst_mm(tongue, model, poses, frames):
    """The largest difference of any coordinate between the file's animation and the model."""
    keys = tongue.channels["weights"].times
    assert len(keys) == len(frames)
    return max(
        np.abs(
            to_model_frame(tongue.vertices(key)) - model.vertices(poses.speaker_weights[t], poses.weights[t])
        ).max()
        for key, t in zip(keys, frames, strict=True)
    )


# glTF -----------------------------------------------------------------------------------------------


def test_the_animation_is_the_tracked_motion(place, small_model, poses, capsys):
    assert run("export", "poses.csv", "-o", "tongue.glb") == 0
    assert f"written: tongue.glb ({MODEL}, 30 frames)" in capsys.readouterr().err
    tongue = tongue_in(place / "tongue.glb")
    assert len(tongue.targets) == 4
    assert 0 < worst_mm(tongue, small_model, poses, range(30)) < 1e-5


def test_a_free_speaker_moves_exactly_too_with_a_target_for_each_pair_of_weights(place, small_model, poses):
    assert run("export", "free.csv", "-o", "tongue.glb") == 0
    tongue = tongue_in(place / "tongue.glb")
    assert len(tongue.targets) == 5 * 4
    assert tongue.mesh["extras"]["targetNames"][6] == "speaker_1_pose_2"
    assert worst_mm(tongue, small_model, free(poses), range(30)) < 2e-5


def test_every_kth_frame_stays_at_its_time(place, small_model, poses):
    assert run("export", "poses.csv", "-o", "tongue.glb", "--every", "7") == 0
    tongue = tongue_in(place / "tongue.glb")
    np.testing.assert_allclose(tongue.channels["weights"].times, np.arange(0, 30, 7) / 250, atol=1e-8)
    assert worst_mm(tongue, small_model, poses, range(0, 30, 7)) < 1e-5


def test_sigmas_give_the_same_motion_a_range_that_a_live_stream_shares(place, small_model, poses):
    assert run("export", "poses.csv", "-o", "tongue.glb", "--sigmas", "5") == 0
    tongue = tongue_in(place / "tongue.glb")
    low = np.array(tongue.mesh["extras"]["weights_low"])
    np.testing.assert_allclose(low, small_model.pose.mean - 5 * small_model.pose.sigma, atol=1e-12)
    assert worst_mm(tongue, small_model, poses, range(30)) < 2e-5


def test_a_take_that_leaves_the_sigmas_is_still_exact_but_said_to_be_wrong_where_weights_are_clamped(
    place, small_model, poses, capsys
):
    outside = int((np.abs(poses.normalised) > 1).any(axis=1).sum())
    assert 0 < outside < 30
    assert run("export", "poses.csv", "-o", "tongue.glb", "--sigmas", "1") == 0
    told = capsys.readouterr().err
    assert f"note: {outside} of 30 frames leave the 1 sigma that 0 and 1 stand for" in told
    assert worst_mm(tongue_in(place / "tongue.glb"), small_model, poses, range(30)) < 1e-5
    assert run("export", "poses.csv", "-o", "tongue.glb", "--sigmas", "5") == 0
    assert "note" not in capsys.readouterr().err


def test_palate_and_coils_stand_beside_the_tongue_where_asked_for(place, poses):
    assert run("export", "poses.csv", "-o", "plain.glb") == 0
    assert set(read_glb((place / "plain.glb").read_bytes())[0]) == {MODEL}
    assert run("export", "poses.csv", "-o", "all.glb", "--coils", "--session", "own.toml") == 0
    nodes, _ = read_glb((place / "all.glb").read_bytes())
    assert set(nodes) == {MODEL, "palate", "tongue_tip", "tongue_blade"}
    np.testing.assert_allclose(to_model_frame(nodes["palate"].positions)[1], [0, 8, 9.1], atol=1e-5)
    tip = nodes["tongue_tip"]
    np.testing.assert_allclose(to_model_frame(tip.place(3 / 250)), poses.coils[3, 0], atol=1e-4)
    assert [tip.size(t / 250)[0] for t in (3, 4, 6, 7)] == [1, 0, 0, 1]


# Other formats --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_meshes_are_numbered_by_their_frames(place, small_model, poses, suffix, capsys):
    assert run("export", "poses.csv", "-o", f"meshes/t{suffix}", "--every", "10") == 0
    assert "written: 3 meshes beside meshes" in capsys.readouterr().err
    assert sorted(file.name for file in (place / "meshes").iterdir()) == [
        f"t_{frame:06d}{suffix}" for frame in (0, 10, 20)
    ]
    found = read_mesh(place / "meshes" / f"t_000020{suffix}")
    expected = small_model.vertices(poses.speaker_weights[20], poses.weights[20])
    np.testing.assert_allclose(found.vertices, expected, atol=1e-5)
    np.testing.assert_array_equal(found.faces, small_model.faces)


@pytest.mark.parametrize("source", ["poses", "free"])
def test_the_table_has_weights_points_under_the_coils_and_the_contour(place, small_model, poses, source):
    tracked = poses if source == "poses" else free(poses)
    assert run("export", f"{source}.csv", "-o", "table.csv", "--every", "3") == 0
    with open("table.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(0, 30, 3))
    contour = midsagittal_vertices(small_model)
    for row in rows:
        frame = int(row["frame"])
        shape = small_model.vertices(tracked.speaker_weights[frame], tracked.weights[frame])
        assert row["status"] == "ok" and float(row["time_s"]) == tracked.times_s[frame]
        assert [float(row[f"pose_{k}"]) for k in (1, 2, 3, 4)] == tracked.weights[frame].tolist()
        assert [float(row[f"pose_{k}_sigma"]) for k in (1, 2, 3, 4)] == tracked.normalised[frame].tolist()
        under = [float(row[f"tongue_blade_surface_{axis}_mm"]) for axis in "xyz"]
        np.testing.assert_allclose(under, shape[9], atol=1e-5)
        line = [[float(row[f"contour_{i + 1}_{axis}_mm"]) for axis in "yz"] for i in range(len(contour))]
        np.testing.assert_allclose(line, shape[contour][:, 1:], atol=1e-5)


@pytest.mark.parametrize("source", ["poses", "free"])
def test_the_arrays_hold_every_vertex_of_every_frame_and_need_no_pickle(place, small_model, poses, source):
    tracked = poses if source == "poses" else free(poses)
    assert run("export", f"{source}.csv", "-o", "motion.npz", "--every", "2") == 0
    with np.load("motion.npz", allow_pickle=False) as found:
        assert found["vertices"].shape == (15, 60, 3) and found["vertices"].dtype == np.float32
        for row, frame in enumerate(found["frames"]):
            expected = small_model.vertices(tracked.speaker_weights[frame], tracked.weights[frame])
            np.testing.assert_allclose(found["vertices"][row], expected, atol=1e-5)
        np.testing.assert_array_equal(found["faces"], small_model.faces)
        np.testing.assert_array_equal(found["contour"], midsagittal_vertices(small_model))
        np.testing.assert_array_equal(found["times_s"], tracked.times_s[::2])
        np.testing.assert_array_equal(found["weights"], tracked.weights[::2])
        assert found["roles"].tolist() == ["tongue_tip", "tongue_blade"]
        assert found["correspondences"].tolist() == [3, 9]


def test_more_frames_than_one_piece_holds_are_written_whole(small_model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_model(small_model, "model.npz")
    poses = replace(poses_of(small_model, frames=150), model_path="model.npz", model_name=MODEL)
    write_poses(poses, small_model, "long.npz")
    assert run("export", "long.npz", "-o", "motion.npz") == 0
    with np.load("motion.npz", allow_pickle=False) as found:
        expected = [
            small_model.vertices(s, p) for s, p in zip(poses.speaker_weights, poses.weights, strict=True)
        ]
        np.testing.assert_allclose(found["vertices"], expected, atol=1e-5)


def test_a_take_of_a_live_run_is_exported_and_made_into_meshes_like_poses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("live", "simulate:", "--seconds", "1", "--record", "take.xdf", "--osc", "127.0.0.1:9") == 0
    assert run("take", "export", "take.xdf", "--what", "poses", "-o", "poses.npz") == 0
    for source in ("take.xdf", "poses.npz"):
        assert run("export", source, "-o", f"{source}.npz") == 0
        assert run("export", source, "-o", f"{source}.glb", "--coils") == 0
        assert run("mesh", source, "--frame", "100", "-o", f"{source}.ply") == 0
    with np.load("take.xdf.npz") as taken, np.load("poses.npz.npz") as tracked:
        assert len(taken["times_s"]) > 200
        for name in ("vertices", "weights", "coils"):
            np.testing.assert_array_equal(taken[name], tracked[name])
    assert (tmp_path / "take.xdf.glb").read_bytes() == (tmp_path / "poses.npz.glb").read_bytes()
    assert (tmp_path / "take.xdf.ply").read_bytes() == (tmp_path / "poses.npz.ply").read_bytes()


# On another speaker ---------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["session", "weights"])
def test_every_export_can_be_on_another_speakers_anatomy(place, small_model, poses, how, capsys):
    weights = another(small_model)
    speaker = "other.toml" if how == "session" else ",".join(map(repr, weights.tolist()))
    for target in ("t.glb", "t.ply", "t.csv", "t.npz"):
        assert run("export", "poses.csv", "-o", target, f"--speaker={speaker}") == 0
    assert "on the speaker of other.toml" in capsys.readouterr().err or how == "weights"
    moved = replace(poses, speaker_weights=np.tile(weights, (30, 1)))
    expected = small_model.vertices(weights, poses.weights[12])
    assert worst_mm(tongue_in(place / "t.glb"), small_model, moved, range(30)) < 1e-5
    np.testing.assert_allclose(read_mesh("t_000012.ply").vertices, expected, atol=1e-5)
    with np.load("t.npz") as found:
        np.testing.assert_allclose(found["vertices"][12], expected, atol=1e-5)
    with open("t.csv", encoding="utf-8", newline="") as file:
        row = list(csv.DictReader(file))[12]
    assert float(row["tongue_tip_surface_y_mm"]) == pytest.approx(expected[3, 1], abs=1e-5)


def test_a_mesh_can_be_on_another_speakers_anatomy(place, small_model, poses):
    assert run("mesh", "poses.csv", "--frame", "5", "-o", "other.ply", "--speaker", "other.toml") == 0
    expected = small_model.vertices(another(small_model), poses.weights[5])
    np.testing.assert_allclose(read_mesh("other.ply").vertices, expected, atol=1e-5)


def test_the_palate_that_is_shown_is_the_other_speakers_own(place):
    (place / "with.toml").write_text((place / "other.toml").read_text() + PALATE.replace("9.1", "7.7"))
    assert run("export", "poses.csv", "-o", "t.glb", "--speaker", "with.toml") == 0
    nodes, _ = read_glb((place / "t.glb").read_bytes())
    np.testing.assert_allclose(to_model_frame(nodes["palate"].positions)[1], [0, 8, 7.7], atol=1e-5)


# Mistakes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["poses.csv", "-o", "t.fbx"], "t.fbx: poses are exported as .glb, .ply, .obj, .csv, .npz"),
        (["poses.csv", "-o", "t"], "t: poses are exported as"),
        (["absent.csv", "-o", "t.glb"], "absent.csv: there is no such poses file"),
        (["own.toml", "-o", "t.glb"], "poses are written as"),
        (["poses.csv", "-o", "poses.csv"], "this file is read here and would be overwritten"),
        (["poses.csv", "-o", "model.npz"], "model.npz: this file is read here and would be overwritten"),
        (["poses.csv", "-o", "t.glb", "--every", "0"], "--every 0: expected 1 or more"),
        (["poses.csv", "-o", "t.glb", "--sigmas", "0"], "--sigmas 0: expected a number above 0"),
        (["poses.csv", "-o", "t.glb", "--sigmas", "nan"], "--sigmas nan: expected a number above 0"),
        (["poses.csv", "-o", "t.csv", "--coils"], "--coils belongs to a .glb file"),
        (["poses.csv", "-o", "t.npz", "--session", "own.toml"], "--session belongs to a .glb file"),
        (["poses.csv", "-o", "t.glb", "--session", "other.toml"], "other.toml: it has no [palate]"),
        (["poses.csv", "-o", "t.glb", "--speaker", "own.toml"], "own.toml: it has no [speaker] weights"),
        (["poses.csv", "-o", "t.glb", "--speaker", "1,2"], "--speaker 1,2: 2 weights"),
        (["poses.csv", "-o", "t.glb", "--speaker", "other.toml", "--coils"], "measured on the speaker"),
        (
            ["poses.csv", "-o", "t.glb", "--speaker", "other.toml", "--session", "own.toml"],
            "the palate comes from that speaker's session",
        ),
        (["poses.csv", "-o", "own.toml/t.glb"], "cannot be made"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(place, arguments, sentence, capsys):
    assert run("export", *arguments) == 2
    told = capsys.readouterr().err
    assert sentence in told and told.count("\n") == 1 and "Traceback" not in told


def test_coils_where_there_is_none_are_refused(place, small_model, poses, capsys):
    poses.coils[:] = np.nan
    write_poses(poses, small_model, "bare.npz")
    assert run("export", "bare.npz", "-o", "t.glb", "--coils") == 2
    assert "there is no coil in any of these poses" in capsys.readouterr().err


def test_a_clip_whose_times_stand_still_is_refused(place, small_model, poses, capsys):
    poses.times_s[8] = poses.times_s[7]
    write_poses(poses, small_model, "still.npz")
    assert run("export", "still.npz", "-o", "t.glb") == 2
    assert "frame 8 at 0.028000 s does not come after" in capsys.readouterr().err
    assert not (place / "t.glb").exists()


def test_an_old_file_stays_when_the_export_fails(place, small_model, poses):
    poses.times_s[8] = poses.times_s[7]
    write_poses(poses, small_model, "still.npz")
    assert run("export", "poses.csv", "-o", "t.glb") == 0
    before = (place / "t.glb").read_bytes()
    assert struct.unpack_from("<4s", before) == (b"glTF",)
    assert run("export", "still.npz", "-o", "t.glb") == 2
    assert (place / "t.glb").read_bytes() == before
