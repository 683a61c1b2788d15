"""`tonguetrack track --out-folder`: a corpus of several speakers, as a phonetics lab has it."""

import csv
import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from tonguetrack.drivers import Recording, write_recording
from tonguetrack.model.files import save_model
from tonguetrack.tracker import corpus
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.corpus import session_beside
from tonguetrack.tracker.posefiles import read_poses

SESSION = """
[coils]
TT = "tongue_tip"
TB = "tongue_blade"
TD = "tongue_dorsum"
[correspondences]
tongue_tip = {tip}
tongue_blade = 9
tongue_dorsum = 15
"""
TAKES = ("S1/one", "S1/two", "S2/one", "S2/deep/three")


def take(model, seed, frames=40):
    """A recording of three coils that sit on the vertices 3, 9 and 15."""
    random = np.random.default_rng(seed)
    swing = np.sin(np.linspace(0, 6, frames))[:, None] * random.uniform(0.2, 0.8, 4)
    shapes = [model.vertices(model.speaker.mean, model.pose.raw(x))[[3, 9, 15]] for x in swing]
    positions = np.array(shapes) + random.normal(scale=0.2, size=(frames, 3, 3))
    return Recording(("TT", "TB", "TD"), positions, np.arange(frames) / 200, 200.0, "test")


@pytest.fixture()
def place(small_model, tmp_path, monkeypatch):
    """A working folder with model.npz and corpus/: two speakers, each with a session, three depths, a sound file."""
    monkeypatch.chdir(tmp_path)
    save_model(small_model, "model.npz")
    for seed, name in enumerate(TAKES):
        path = tmp_path / "corpus" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_recording(take(small_model, seed), path)
    (tmp_path / "corpus/S1/session.toml").write_text(SESSION.format(tip=3))
    (tmp_path / "corpus/S2/session.toml").write_text(SESSION.format(tip=4))
    (tmp_path / "corpus/S1/one.wav").write_bytes(b"RIFF....WAVE")
    return tmp_path


def track(*flags, places=("corpus",)):
    """The exit code of tracking these places into the folder out; in this process unless the flags say otherwise."""
    where = () if "--scheduler" in flags or "--jobs" in flags else ("--jobs", "1")
    return main(["track", *places, "--model", "model.npz", "--out-folder", "out", *where, *map(str, flags)])


def summary():
    """recording -> the row of the summary."""
    with Path("out/summary.csv").open(encoding="utf-8", newline="") as file:
        return {row["recording"]: row for row in csv.DictReader(file)}


def states():
    return {
        name.removeprefix("corpus/").removesuffix(".csv"): row["state"] for name, row in summary().items()
    }


def all_but(changed, others="unchanged", state="tracked"):
    return {name: state if name in changed else others for name in TAKES}


# The poses ------------------------------------------------------------------------------------------


def same_as_the_single_command():
    for name in TAKES:
        session = f"corpus/{name[:2]}/session.toml"
        flags = ["--model", "model.npz", "--session", session, "--out", "single.csv"]
        assert main(["track", f"corpus/{name}.csv", *flags]) == 0
        assert Path(f"out/{name}.csv").read_bytes() == Path("single.csv").read_bytes(), name


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_poses_are_those_of_the_single_command_bit_for_bit(place, jobs):
    assert track("--jobs", jobs) == 0
    assert states() == all_but((), others="tracked")
    same_as_the_single_command()


def test_a_dask_cluster_that_works_elsewhere_gives_the_same_poses(
    place, tmp_path_factory, monkeypatch, capsys
):
    """Its workers start in another folder, as those on other machines do."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=60
    ) as cluster:
        monkeypatch.chdir(place)
        (place / "corpus/S1/two.csv").write_text("TT_x,TT_y\nnonsense\n")
        assert track("--scheduler", cluster.scheduler_address) == 3
        assert "on 2 workers of the cluster" in (told := capsys.readouterr().err)
        assert "tonguetrack: corpus/S1/two.csv: " in told
        assert states() == all_but(("S1/two",), others="tracked", state="failed")
        shutil.copy(place / "corpus/S1/one.csv", place / "corpus/S1/two.csv")
        assert track("--scheduler", cluster.scheduler_address) == 0
    assert states() == all_but(("S1/two",))
    same_as_the_single_command()


def test_both_experiments_are_two_files(place):
    assert track("--experiment", "both") == 0
    for name in TAKES:
        assert [read_poses(f"out/{name}.experiment{n}.csv").experiment for n in (1, 2)] == [1, 2]


# The summary ----------------------------------------------------------------------------------------


def test_the_summary_says_what_a_person_judges_a_recording_by(place):
    track()
    for name, row in summary().items():
        poses = read_poses(Path("out", row["poses"]))
        assert row["poses"] == name.removeprefix("corpus/")
        assert (int(row["frames"]), float(row["seconds"])) == (40, 0.2)
        assert float(row["median_residual_mm"]) == pytest.approx(np.median(poses.residual_mm), abs=1e-4)
        assert float(row["real_time_factor"]) > 0
        assert row["problems"] == ""


def test_a_coil_that_is_often_missing_and_frames_without_any_are_problems(place, small_model, capsys):
    recording = take(small_model, 9)
    recording.positions[10:, 0] = np.nan
    recording.positions[20:22] = np.nan
    write_recording(recording, "corpus/S1/one.csv")
    assert track() == 0
    expected = "2 of 40 frames without any coil; tongue_tip is missing in 75 % of the frames"
    assert summary()["corpus/S1/one.csv"]["problems"] == expected
    assert "corpus/S1/one.csv: tongue_tip is missing in 75 % of the frames" in capsys.readouterr().err


def test_coils_that_lie_elsewhere_are_a_problem(place, small_model):
    recording = take(small_model, 9)
    recording.positions[:, 1] += 60.0
    write_recording(recording, "corpus/S1/one.csv")
    track()
    assert "the coils do not lie where the model's tongue is" in summary()["corpus/S1/one.csv"]["problems"]


def test_the_summary_is_also_json(place, capsys):
    track("--json")
    report = json.loads(capsys.readouterr().out)
    assert [row["state"] for row in report["recordings"]] == ["tracked"] * 4


def test_what_is_no_recording_is_listed_with_its_reason_and_a_damaged_one_is_named(place, capsys):
    (place / "corpus/S1/empty.csv").touch()
    assert track() == 0
    listed = Path("out/left_out.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in listed] == ["file", "corpus/S1/empty.csv", "corpus/S1/one.wav"]
    told = capsys.readouterr().err
    assert "left out: corpus/S1/empty.csv: the file is empty." in told
    assert "left out: 1 other files (.wav 1); left_out.csv says why" in told


# A recording that cannot be read --------------------------------------------------------------------


def test_a_recording_that_cannot_be_read_gets_its_sentence_and_the_rest_goes_on(place, capsys):
    text = (place / "corpus/S1/two.csv").read_text()
    (place / "corpus/S1/two.csv").write_text(text + "1,2,3\n")
    assert track() == 3
    assert states() == all_but(("S1/two",), others="tracked", state="failed")
    told = capsys.readouterr().err
    sentence = summary()["corpus/S1/two.csv"]["problems"]
    assert f"tonguetrack: {sentence}\n" in told
    assert sentence.startswith("corpus/S1/two.csv: line ")
    assert "4 recordings: 3 tracked, 1 failed" in told


def test_a_recording_that_failed_is_tried_again(place, small_model):
    good = (place / "corpus/S2/one.csv").read_bytes()
    (place / "corpus/S2/one.csv").write_bytes(good + b"1,2,3\n")
    assert track() == 3
    (place / "corpus/S2/one.csv").write_bytes(good)
    assert track() == 0
    assert states() == all_but(("S2/one",))


# What is there already ------------------------------------------------------------------------------


def test_what_is_unchanged_is_not_tracked_again_and_keeps_its_row(place):
    track()
    rows, made = summary(), {path: path.stat().st_mtime_ns for path in Path("out").rglob("*.csv")}
    assert track() == 0
    assert states() == all_but(())
    for name, row in summary().items():
        assert row == {**rows[name], "state": "unchanged"}
        assert Path("out", row["poses"]).stat().st_mtime_ns == made[Path("out", row["poses"])]


def test_only_what_depends_on_a_change_is_tracked_again(place, small_model):
    track()
    write_recording(take(small_model, 12), "corpus/S1/one.csv")
    track()
    assert states() == all_but(("S1/one",))
    (place / "corpus/S2/session.toml").write_text(SESSION.format(tip=5))
    track()
    assert states() == all_but(("S2/one", "S2/deep/three"))
    (place / "corpus/S2/session.toml").write_text("# a comment changes nothing\n" + SESSION.format(tip=5))
    track()
    assert states() == all_but(())
    track("--experiment", "1")
    assert states() == all_but((), others="tracked")


@pytest.mark.parametrize("damage", ["taken away", "edited", "its stamp is damaged"])
def test_poses_that_are_not_as_they_were_written_are_made_again(place, damage):
    track()
    poses = Path("out/S1/two.csv")
    before = poses.read_bytes()
    if damage == "taken away":
        poses.unlink()
    elif damage == "edited":
        poses.write_bytes(before[:-100])
    else:
        Path("out/.corpus/S1/two.csv.json").write_text('{"recording": 3, "key"')
    track()
    assert states() == all_but(("S1/two",))
    assert poses.read_bytes() == before


def test_again_means_all(place):
    track()
    assert track("--again") == 0
    assert states() == all_but((), others="tracked")


def test_a_run_that_was_broken_off_goes_on_where_it_stopped(place, monkeypatch, capsys):
    real, tracked = corpus.track_recording, []

    def stopped_at_the_third(recording, *arguments):
        tracked.append(recording.source)
        if len(tracked) == 3:
            raise KeyboardInterrupt
        return real(recording, *arguments)

    monkeypatch.setattr(corpus, "track_recording", stopped_at_the_third)
    assert track() == 130
    assert not Path("out/summary.csv").exists()
    assert track() == 0
    done = [name.removeprefix("corpus/").removesuffix(".csv") for name in tracked[2:]]
    assert states() == all_but(done)
    assert len(done) == 3  # the one that was begun, once more, and the last


def test_a_copy_of_the_corpus_elsewhere_is_known_by_its_content(place):
    track()
    (place / "corpus").rename("moved")
    assert track(places=("moved",)) == 0
    assert {row["state"] for row in summary().values()} == {"unchanged"}


def test_every_file_of_a_recording_counts(place, small_model, capsys):
    """SSFF keeps a file for each coil, and any of them opens all."""
    (place / "emu").mkdir()
    recording = take(small_model, 3)
    for index, ending in enumerate(("tt", "tb", "td")):
        columns = "".join(f"Column {axis} FLOAT 1\n" for axis in "xyz")
        header = (
            f"SSFF -- (c) SHLRC\nMachine IBM-PC\nRecord_Freq 200\nStart_Time 0\n{columns}-----------------\n"
        )
        values = recording.positions[:, index].astype("<f4").tobytes()
        (place / f"emu/take.{ending}").write_bytes(header.encode() + values)
    flags = (
        "--session",
        "corpus/S1/session.toml",
        "--coils",
        "tt=tongue_tip,tb=tongue_blade,td=tongue_dorsum",
    )
    for expected in ("tracked", "unchanged"):
        assert track(*flags, places=("emu",)) == 0
        assert [row["state"] for row in summary().values()] == [expected]
    last = place / "emu/take.td"
    last.write_bytes(last.read_bytes()[:-4] + struct.pack("<f", 1.0))
    assert track(*flags, places=("emu",)) == 0
    assert [row["state"] for row in summary().values()] == ["tracked"]


# Sessions -------------------------------------------------------------------------------------------


def test_a_recordings_own_session_goes_before_its_folders_and_that_before_the_one_above(tmp_path):
    recording = tmp_path / "corpus/S1/day2/a.csv"
    recording.parent.mkdir(parents=True)
    assert session_beside(recording, tmp_path / "corpus") is None
    for name in (
        "session.toml",
        "corpus/session.toml",
        "corpus/S1/session.toml",
        "corpus/S1/day2/session.toml",
    ):
        (tmp_path / name).touch()
        expected = (
            None if name == "session.toml" else tmp_path / name
        )  # never above the folder that was named
        assert session_beside(recording, tmp_path / "corpus") == expected
    (tmp_path / "corpus/S1/day2/a.session.toml").touch()
    assert session_beside(recording, tmp_path / "corpus") == recording.with_name("a.session.toml")
    assert session_beside(recording.with_name("b.csv"), tmp_path / "corpus") == recording.with_name(
        "session.toml"
    )


def test_it_is_said_which_session_applies_to_how_many_recordings(place, small_model, capsys):
    write_recording(take(small_model, 5), "corpus/alone.csv")
    track("--coils", "TT=tongue_tip,TB=tongue_blade,TD=tongue_dorsum")
    told = capsys.readouterr().err
    assert "session corpus/S1/session.toml: 2 recordings" in told
    assert "session corpus/S2/session.toml: 2 recordings" in told
    assert "no session: 1 recordings" in told
    assert summary()["corpus/S2/deep/three.csv"]["session"] == "corpus/S2/session.toml"
    assert summary()["corpus/alone.csv"]["session"] == ""
    tips = {
        name[7:9]: read_poses(Path("out", name[7:])).correspondences[0] for name in summary() if "S" in name
    }
    assert tips == {"S1": 3, "S2": 4}


def test_the_session_that_is_named_holds_for_all(place, capsys):
    Path("all.toml").write_text(SESSION.format(tip=2))
    track("--session", "all.toml")
    assert "session all.toml: 4 recordings" in capsys.readouterr().err
    assert {read_poses(Path("out", row["poses"])).correspondences[0] for row in summary().values()} == {2}


def test_a_session_that_cannot_be_read_stops_the_run_before_anything_is_tracked(place, capsys):
    (place / "corpus/S2/session.toml").write_text("[coils\n")
    assert track() == 2
    assert "corpus/S2/session.toml: this is not readable TOML" in capsys.readouterr().err
    assert not Path("out").exists()


# Places ---------------------------------------------------------------------------------------------


def test_the_folder_may_lie_in_the_corpus_and_is_not_searched(place):
    for expected in ("tracked", "unchanged"):
        assert track("--out-folder", "corpus/poses") == 0
        with Path("corpus/poses/summary.csv").open(newline="") as file:
            assert [row["state"] for row in csv.DictReader(file)] == [expected] * 4
        assert "poses" not in Path("corpus/poses/left_out.csv").read_text()


def test_the_folder_may_be_above_the_corpus(place):
    assert track("--out-folder", ".") == 0
    assert Path("S2/deep/three.csv").is_file()


def test_poses_of_another_recording_that_is_still_there_are_not_replaced(place, capsys):
    track(places=("corpus/S1",))
    before = Path("out/one.csv").read_bytes()
    assert track(places=("corpus/S2",)) == 3
    assert "its poses would replace those of" in summary()["corpus/S2/one.csv"]["problems"]
    assert Path("out/one.csv").read_bytes() == before


def test_what_is_read_is_never_written_over(place, capsys):
    before = Path("corpus/S1/one.csv").read_bytes()
    assert track("--out-folder", "corpus") == 2
    assert "this file is read here and would be overwritten" in capsys.readouterr().err
    assert Path("corpus/S1/one.csv").read_bytes() == before


@pytest.mark.parametrize(
    "flags", [("--out", "x.csv"), ("--osc", "127.0.0.1:9"), ("--view",), ("--save-session", "x.toml")]
)  # fmt: skip
def test_what_belongs_to_single_recordings_is_refused(place, flags, capsys):
    assert track(*flags) == 2
    assert f"{flags[0]} belongs to single recordings" in capsys.readouterr().err


def test_corpus_flags_without_the_folder_are_refused(place, capsys):
    assert main(["track", "corpus", "--jobs", "2"]) == 2
    assert "say where to with --out-folder DIR" in capsys.readouterr().err
