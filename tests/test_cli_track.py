"""`tonguetrack model`, `track` and `mesh` as a user runs them."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from tonguetrack.drivers import Recording, write_recording
from tonguetrack.model.files import save_model
from tonguetrack.model.mesh import read_mesh
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.posefiles import read_poses

SESSION = """
[coils]
TT = "tongue_tip"
TD = "tongue_dorsum"
TB = "tongue_blade"
[correspondences]
tongue_tip = 3
tongue_blade = 9
tongue_dorsum = 15
"""


@pytest.fixture()
def place(small_model, tmp_path, monkeypatch):
    """A working folder with model.npz, take.csv and s.toml."""
    random = np.random.default_rng(0)
    swing = np.sin(np.linspace(0, 6, 80))[:, None] * random.uniform(0.2, 0.8, 4)
    mean = small_model.speaker.mean
    shapes = [small_model.vertices(mean, small_model.pose.raw(x))[[3, 9, 15]] for x in swing]
    positions = np.array(shapes) + random.normal(scale=0.2, size=(80, 3, 3))
    take = Recording(("TT", "TB", "TD"), positions, np.arange(80) / 200, 200.0, "test")
    monkeypatch.chdir(tmp_path)
    save_model(small_model, "model.npz")
    write_recording(take, "take.csv")
    (tmp_path / "s.toml").write_text(SESSION)
    return tmp_path


def run(*arguments):
    return main([str(argument) for argument in arguments])


def test_a_recording_becomes_poses_and_meshes(place, small_model, capsys):
    assert run("track", "take.csv", "--model", "model.npz", "--session", "s.toml", "--out", "poses.csv") == 0
    told = capsys.readouterr().err
    for part in (
        "model: random test model",
        "speaker (estimated)",
        "experiment 2: 80 frames tracked",
        "written",
    ):
        assert part in told
    poses = read_poses("poses.csv")
    assert poses.frame_count == 80
    assert run("mesh", "poses.csv", "--frame", "33", "-o", "tongue.ply") == 0
    mesh = read_mesh("tongue.ply")
    expected = small_model.vertices(poses.speaker_weights[33], poses.weights[33])
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-4)
    np.testing.assert_array_equal(mesh.faces, small_model.faces)


def test_every_kth_mesh_is_numbered_by_its_frame(place):
    run("track", "take.csv", "--model", "model.npz", "--session", "s.toml", "--out", "poses.npz")
    assert run("mesh", "poses.npz", "--every", "30", "-o", "out.obj") == 0
    assert sorted(path.name for path in place.glob("out*")) == [f"out_{n:06d}.obj" for n in (0, 30, 60)]


def test_both_experiments_go_to_two_files(place):
    run("track", "take.csv", "--model", "model.npz", "--experiment", "both", "--out", "p.json")
    assert {path.name for path in place.glob("p*.json")} == {"p.experiment1.json", "p.experiment2.json"}
    frames = json.loads((place / "p.experiment1.json").read_text())
    assert len(frames) == 80
    assert len({tuple(frame["speakerWeights"]) for frame in frames}) > 1


def test_an_estimated_session_is_saved_and_gives_the_same_poses_again(place, capsys):
    run("track", "take.csv", "--model", "model.npz", "--save-session", "found.toml", "--out", "first.npz")
    run("track", "take.csv", "--model", "model.npz", "--session", "found.toml", "--out", "second.npz")
    np.testing.assert_array_equal(read_poses("first.npz").weights, read_poses("second.npz").weights)
    assert "speaker (session): mean of experiment 1" in capsys.readouterr().err


def test_the_summary_is_also_json(place, capsys):
    assert run("track", "take.csv", "--model", "model.npz", "--experiment", "both", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    figures = report["recordings"][0]["experiment_1"]
    assert figures["frames_tracked"] == 80
    assert set(figures["residual_by_coil_mm"]) == {"tongue_tip", "tongue_blade", "tongue_dorsum"}
    assert 0 <= figures["share_below_1_25_mm"] <= 1


def test_a_folder_is_searched_and_one_bad_file_does_not_stop_the_rest(place, capsys):
    folder = place / "corpus"
    folder.mkdir()
    text = (place / "take.csv").read_text()
    (folder / "a.csv").write_text(text)
    (folder / "b.csv").write_text("\n".join(text.splitlines()[:8]) + "\nnonsense,1\n" * 3)
    (folder / "c.csv").write_text(text)
    (folder / "notes.txt").write_text("nothing here")
    assert run("track", "corpus", "--model", "model.npz", "--out", "poses/{name}.csv", "--json") == 2
    captured = capsys.readouterr()
    assert sorted(path.name for path in (place / "poses").iterdir()) == ["a.csv", "c.csv"]
    assert "1 of 3 recordings could not be tracked: b.csv" in captured.err
    assert "left out: corpus/notes.txt" in captured.err
    assert [("error" in entry) for entry in json.loads(captured.out)["recordings"]] == [False, True, False]


@pytest.mark.parametrize(
    "flags", [("--out", "take.csv"), ("--out", "."), ("--out", "./{name}.csv"), ("--out", "link.csv"),
              ("--out", "model.npz"), ("--save-session", "take.csv")],
)  # fmt: skip
def test_what_is_read_is_never_written_over(place, flags, capsys):
    (place / "link.csv").symlink_to(place / "take.csv")
    before = {name: (place / name).read_bytes() for name in ("take.csv", "model.npz")}
    assert run("track", "take.csv", "--model", "model.npz", *flags) == 2
    assert "this file is read here and would be overwritten" in capsys.readouterr().err
    assert {name: (place / name).read_bytes() for name in before} == before


def test_a_folder_tracked_into_itself_keeps_its_recordings(place, capsys):
    (place / "corpus").mkdir()
    for name in ("a.csv", "b.csv"):
        (place / "corpus" / name).write_text((place / "take.csv").read_text())
    assert (
        run("track", "corpus", "--model", "model.npz", "--out", "new") == 0
    )  # several recordings need a folder
    assert sorted(path.name for path in (place / "new").iterdir()) == ["a.csv", "b.csv"]
    assert run("track", "corpus", "--model", "model.npz", "--out", "corpus") == 2
    assert "corpus/a.csv: this file is read here" in capsys.readouterr().err
    assert (place / "corpus" / "a.csv").read_text() == (place / "take.csv").read_text()


def test_a_session_may_be_written_over_with_what_was_found(place):
    assert (
        run("track", "take.csv", "--model", "model.npz", "--session", "s.toml", "--save-session", "s.toml")
        == 0
    )
    assert "[speaker]" in (place / "s.toml").read_text()


def test_a_session_that_cannot_be_saved_is_said_before_the_work(place, capsys):
    (place / "file").write_text("")
    arguments = ("track", "take.csv", "--model", "model.npz", "--out", "p.csv")
    assert run(*arguments, "--save-session", "file/s.toml") == 2
    assert "the folder file cannot be made" in capsys.readouterr().err
    assert not (place / "p.csv").exists()


def test_models_are_not_converted_onto_themselves(place, capsys):
    before = (place / "model.npz").read_bytes()
    assert run("model", "convert", "model.npz", "model.npz") == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert (place / "model.npz").read_bytes() == before


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
@pytest.mark.parametrize(
    "arguments", [("simulate", "recording", "--help"), ("model", "info", "bundled"),
                  ("model", "info", "--json", "bundled"), ("info", "\u0259.csv"), ("info", "--json", "\u0259.csv")],
)  # fmt: skip
def test_a_terminal_without_phonetic_letters_shows_their_numbers(place, encoding, arguments):
    (place / "take.csv").rename(place / "\u0259.csv")
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())", *arguments],
        env={**os.environ, "PYTHONIOENCODING": encoding}, capture_output=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\u02" in done.stdout
    if "--json" in arguments:
        json.loads(done.stdout.decode(encoding))


def test_a_corpus_with_a_folder_a_speaker_keeps_its_folders(place):
    text = (place / "take.csv").read_text()
    for name in ("s1/0001.csv", "s1/0001.txt", "s2/0001.csv", "s2/deep/0002.csv"):
        (place / "corpus" / name).parent.mkdir(parents=True, exist_ok=True)
        (place / "corpus" / name).write_text(text)
    assert run("track", "corpus", "--model", "model.npz", "--out", "out/") == 0
    written = sorted(str(path.relative_to(place / "out")) for path in (place / "out").rglob("*.csv"))
    assert written == ["s1/0001.csv.csv", "s1/0001.txt.csv", "s2/0001.csv", "s2/deep/0002.csv"]
    assert run("track", "corpus", "--model", "model.npz", "--out", "flat/{name}.csv") == 2
    assert not (place / "flat").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_are_not_utf_8_are_shown_and_kept(place, reference_data, capsys):
    odd = os.fsdecode(b"t\xff")
    (place / "take.csv").rename(place / f"{odd}.csv")
    (place / "model.npz").rename(place / f"{odd}.npz")
    assert (
        run(
            "track",
            f"{odd}.csv",
            "--model",
            f"{odd}.npz",
            "--out",
            f"{odd}p.csv",
            "--save-session",
            "s2.toml",
        )
        == 0
    )
    assert run("track", f"{odd}.csv", "--model", f"{odd}.npz", "--session", "s2.toml") == 0
    assert "t\\xff.csv" in capsys.readouterr().err
    assert run("mesh", f"{odd}p.csv", "--frame", "3", "-o", f"{odd}.ply") == 0
    samples = reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml"
    assert run("model", "build", samples, "-o", f"{odd}m.npz") == 0
    assert run("model", "info", f"{odd}m.npz") == 0
    assert "t\\xffm [" in capsys.readouterr().out


def test_every_failure_in_a_corpus_names_its_recording(place, capsys):
    text = (place / "take.csv").read_text().splitlines()
    header = next(line for line in text if line.startswith("time_s"))
    start = text[: text.index(header) + 1]
    (place / "dead.csv").write_text(
        "\n".join([*start, *(f"{k / 200}" + "," * header.count(",") for k in range(9))])
    )
    assert run("track", "dead.csv", "take.csv", "--model", "model.npz", "--json") == 2
    captured = capsys.readouterr()
    assert "tonguetrack: dead.csv: " in captured.err
    assert "could not be tracked: dead.csv" in captured.err
    assert json.loads(captured.out)["recordings"][0]["error"].startswith("dead.csv: ")


def test_recordings_of_one_name_are_not_written_over_each_other(place, capsys):
    for folder in ("x", "y"):
        (place / folder).mkdir()
        (place / folder / "take.csv").write_text((place / "take.csv").read_text())
    assert run("track", "x", "y", "--model", "model.npz", "--out", "poses/") == 2
    assert "would both be written to poses/take.csv" in capsys.readouterr().err
    assert not list(place.glob("poses/*"))


def test_coils_named_on_the_command_line_win(place, capsys):
    arguments = ["track", "take.csv", "--model", "model.npz", "--out", "p.csv"]
    assert run(*arguments, "--coils", "TT=tongue_tip,TD=tongue_dorsum") == 0
    assert read_poses("p.csv").roles == ("tongue_tip", "tongue_dorsum")
    assert run(*arguments, "--coils", "TT") == 2
    assert "expected CHANNEL=ROLE pairs" in capsys.readouterr().err


def test_a_model_is_converted_there_and_back_exactly(place, small_model, capsys):
    assert run("model", "convert", "model.npz", "m.yaml") == 0
    assert run("model", "convert", "m.yaml", "m.json") == 0
    assert run("model", "info", "m.json", "--json") == 0
    described = json.loads(capsys.readouterr().out)
    assert described["fingerprint"] == small_model.fingerprint
    assert described["speaker"]["cumulative_compactness"] is None


def test_model_info_shows_dimensions_compactness_and_provenance(place, capsys):
    assert run("model", "info", "model.npz") == 0
    told = capsys.readouterr().out
    for part in (
        "60 vertices",
        "5 weights from 11 training entries",
        "compactness",
        "measured",
        "random numbers",
    ):
        assert part in told


# To the superuser no folder of his own is read-only; the kernel's is, to everybody.
READ_ONLY = "/proc/p.csv" if os.geteuid() == 0 else "readonly/p.csv"
BAD_INPUT = [
    (["track", "absent.csv"], "absent.csv: there is no such file"),
    (["track", "empty"], "empty: the folder is empty"),
    (["track", "sound.wav"], "sound.wav: this is a WAV sound"),
    (["track", "cut.csv"], "cut.csv"),
    (["track", "cut.pos"], "cut.pos"),
    (["track", "take.csv", "--model", "absent.npz"], "absent.npz: there is no such model file"),
    (["track", "take.csv", "--model", "take.csv"], "take.csv: a model file ends in one of"),
    (["track", "take.csv", "--session", "absent.toml"], "absent.toml: there is no such session file"),
    (
        ["track", "take.csv", "--session", "other_coil.toml"],
        "names the channel 'T9', which take.csv does not have",
    ),
    (["track", "take.csv", "--session", "other_model.toml"], "it belongs to a model of other dimensions"),
    (["track", "take.csv", "--out", "poses.txt"], "poses are written as .csv, .json, .npz"),
    (["track", "take.csv", "--out", READ_ONLY], READ_ONLY),
    (["track", "take.csv", "--out", "nowhere/../sound.wav/p.csv"], "sound.wav"),
    (["track", "take.csv", "--osc", "nonsense"], "nonsense"),
    (["track", "take.csv", "--realtime"], "--realtime paces a stream"),
    (["track", "take.csv", "take.csv", "--osc", "127.0.0.1:9000"], "--osc takes one recording"),
    (["track", "take.csv", "take.csv", "--out", "one.csv"], "give a folder, or a name with {name} in it"),
    (["mesh", "take.csv", "--frame", "0", "-o", "t.ply"], "the first line should be '# tonguetrack poses 1'"),
    (["mesh", "absent.csv", "--frame", "0", "-o", "t.ply"], "there is no such poses file"),
    (["mesh", "poses.csv", "--frame", "80", "-o", "t.ply"], "poses.csv has the frames 0 to 79"),
    (["mesh", "poses.csv", "--frame", "0", "-o", "t.stl"], "meshes are written as .ply or .obj"),
    (["mesh", "poses.csv", "--every", "0", "-o", "t.ply"], "expected 1 or more"),
    (
        ["mesh", "poses.csv", "--frame", "0", "-o", "t.ply", "--model", "small.npz"],
        "name the right one with --model",
    ),
    (["model", "build", "absent.yaml", "-o", "m.npz"], "absent.yaml: there is no such sample database"),
    (["model", "build", "s.toml", "-o", "m.npz"], "s.toml"),
    (["model", "info", "take.csv"], "a model file ends in one of"),
    (["model", "convert", "model.npz", "m.txt"], "a model is saved as one of"),
]


@pytest.fixture()
def bad_place(place, small_model):
    run("track", "take.csv", "--model", "model.npz", "--session", "s.toml", "--out", "poses.csv")
    (place / "empty").mkdir()
    (place / "sound.wav").write_bytes(b"RIFF\x24\x00\x00\x00WAVEfmt ")
    (place / "cut.csv").write_bytes((place / "take.csv").read_bytes()[:150])
    (place / "cut.pos").write_bytes(b"AG50xDATA_V003\n00004096\nNumberOfChannels=16\n")
    (place / "other_coil.toml").write_text('[coils]\nT9 = "tongue_tip"\n')
    (place / "other_model.toml").write_text(SESSION + "[speaker]\nweights = [1.0, 2.0]\n")
    save_model(small_model.truncated(4, 3), place / "small.npz")
    (place / "readonly").mkdir()
    (place / "readonly").chmod(0o500)
    return place


@pytest.mark.parametrize(("arguments", "sentence"), BAD_INPUT, ids=[" ".join(a) for a, _ in BAD_INPUT])
def test_bad_input_gets_one_sentence_exit_code_2_and_no_half_written_file(
    bad_place, capsys, arguments, sentence
):
    if arguments[0] == "track" and "--model" not in arguments:
        arguments = [*arguments, "--model", "model.npz"]
    before = {path for path in bad_place.rglob("*") if path.is_file()}
    capsys.readouterr()
    assert run(*arguments) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert told[-1].startswith("tonguetrack: ")
    assert sentence in told[-1]
    assert "Traceback" not in "".join(told)
    assert {path for path in bad_place.rglob("*") if path.is_file()} == before


def test_help_and_version_answer_through_the_installed_command():
    for flag in ("--help", "--version"):
        done = subprocess.run(
            [sys.executable, "-c", f"from tonguetrack.tracker.cli import main; main(['{flag}'])"],
            capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
        assert "tonguetrack" in done.stdout
