"""`tonguetrack info` and `tonguetrack convert`."""

import argparse
import json
import os

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import Recording, open_recording, write_recording
from tonguetrack.tracker.cli.files import add_commands


@pytest.fixture
def run():
    parser = argparse.ArgumentParser()
    add_commands(parser.add_subparsers(required=True))

    def run(*arguments):
        args = parser.parse_args([str(argument) for argument in arguments])
        return args.run(args)

    return run


@pytest.fixture
def take(tmp_path):
    positions = np.random.default_rng(3).normal(0, 20, (50, 3, 3))
    positions[:10, 1] = np.nan
    positions[:, 2] = np.nan
    rms = np.where(np.isnan(positions[:, :, 0]), np.nan, 2.5)
    recording = Recording(
        ("tip", "mid", "dead"), positions, np.arange(50) / 250, 250.0, "made", rms=rms, notes=("A note.",)
    )
    return write_recording(recording, tmp_path / "take.csv")


def test_info_tells_format_frames_coils_and_notes(run, take, capsys):
    assert run("info", take) == 0
    text = capsys.readouterr().out
    assert "tonguetrack CSV 1" in text
    assert "50 at 250 Hz, 0.200 s" in text
    assert "- A note." in text
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line.strip()}
    assert rows["tip"][1] == "100%" and rows["tip"][-1] == "2.50"
    assert rows["mid"][1] == "80%"
    assert rows["dead"][1:] == ["0%", "no", "data"]


def test_info_as_json_is_valid_and_complete(run, take, capsys):
    assert run("info", take, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["frames"], summary["rate_hz"], summary["duration_s"]) == (50, 250.0, 0.2)
    assert summary["frame_of_reference"]["x"] == "unknown"
    tip, mid, dead = summary["coils"]
    assert (tip["valid_share"], mid["valid_share"], dead["valid_share"]) == (1.0, 0.8, 0.0)
    assert dead["low_mm"] is None and dead["median_rms"] is None
    assert tip["median_rms"] == 2.5
    assert all(low < high for low, high in zip(tip["low_mm"], tip["high_mm"], strict=True))


def test_info_on_a_folder_lists_recordings_and_the_rest(run, take, capsys):
    (take.parent / "LICENSE").write_text("words")
    assert run("info", take.parent) == 0
    text = capsys.readouterr().out
    assert "1 recording(s), 1 other file(s)" in text
    assert "take.csv: tonguetrack CSV" in text
    assert "LICENSE: text, but not" in text
    assert run("info", take.parent, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert [item["path"] for item in summary["recordings"]] == [str(take)]
    assert len(summary["left_out"]) == 1


def test_info_passes_the_flags_on(run, tmp_path, capsys):
    path = tmp_path / "plain.csv"
    path.write_text("tt_x,tt_y,tt_z\n1,2,3\n4,5,6\n")
    with pytest.raises(InputError, match="--unit"):
        run("info", path, "--rate", 100)
    assert run("info", path, "--rate", 100, "--unit", "cm") == 0
    assert "10.0 .. 40.0" in capsys.readouterr().out


def test_info_on_a_model_points_to_the_model_command(run, tmp_path):
    np.savez(tmp_path / "model.npz", core=np.zeros(3))
    (tmp_path / "model.yaml").write_text("Dimensions:\n  TruncatedSpeakerMode: 5\nCoreTensor: !!binary x\n")
    (tmp_path / "model.json").write_text('{"Dimensions": {}, "CoreTensor": []}')
    for name in ("model.npz", "model.yaml", "model.json"):
        with pytest.raises(InputError, match="tonguetrack model info"):
            run("info", tmp_path / name)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".json"])
def test_convert_writes_what_the_suffix_says(run, take, tmp_path, suffix, capsys):
    target = tmp_path / "out" / f"take{suffix}"
    target.parent.mkdir()
    assert run("convert", take, target) == 0
    assert "50 frames of 3 coils" in capsys.readouterr().out
    np.testing.assert_array_equal(open_recording(target).positions, open_recording(take).positions)
    assert os.listdir(target.parent) == [target.name]


def test_convert_to_the_authors_json_says_what_is_lost(run, take, tmp_path, capsys):
    run("convert", take, tmp_path / "take.json")
    assert "60 missing sample(s)" in capsys.readouterr().out


def test_convert_refuses_before_it_reads_or_writes(run, take, tmp_path):
    with pytest.raises(InputError, match=r"\.csv, \.json"):
        run("convert", take, tmp_path / "take.wav")
    with pytest.raises(InputError, match="does not exist"):
        run("convert", take, tmp_path / "nowhere" / "take.csv")
    with pytest.raises(InputError, match="no such file"):
        run("convert", tmp_path / "none.pos", tmp_path / "take.csv")
    assert os.listdir(tmp_path) == ["take.csv"]


def test_convert_never_writes_over_what_it_reads(run, take, tmp_path):
    before = take.read_bytes()
    (tmp_path / "link.csv").symlink_to(take)
    for name in ("take.csv", "link.csv"):
        with pytest.raises(InputError, match="would be overwritten"):
            run("convert", take, tmp_path / name)
    assert take.read_bytes() == before


def test_real_recordings_convert_and_come_back(run, reference_data, tmp_path):
    for file in ("ag501_reidy/0021.pos", "ndi_wave_ematoblender/Example3.tsv", "emu_webapp/ssff/0020.t_tip"):
        original = open_recording(reference_data / "recordings" / file)
        for suffix in (".csv", ".npz"):
            run("convert", reference_data / "recordings" / file, tmp_path / f"a{suffix}")
            again = open_recording(tmp_path / f"a{suffix}")
            np.testing.assert_array_equal(again.positions, original.positions)
            np.testing.assert_array_equal(again.times_s, original.times_s)
            np.testing.assert_array_equal(again.orientations, original.orientations)
            assert (again.rate_hz, again.frame, again.coils) == (
                original.rate_hz,
                original.frame,
                original.coils,
            )
