"""Content decides what a file is; a folder is sorted into recordings and the rest."""

import subprocess
import sys

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import Recording, find_recordings, open_recording, write_recording


@pytest.fixture
def take():
    return Recording(("tip",), np.ones((3, 1, 3)), np.arange(3) / 100, 100.0, "made")


def ssff_file(values, rate=200, columns=("x", "y", "z")):
    names = "".join(f"Column tt_pos{axis} FLOAT 1\n" for axis in columns)
    header = (
        f"SSFF -- (c) SHLRC\nMachine IBM-PC\nRecord_Freq {rate}\nStart_Time 0\n{names}-----------------\n"
    )
    return header.encode() + np.asarray(values, "<f4").tobytes()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file is empty"),
        (b"RIFF\x24\0\0\0WAVEfmt ", "WAV sound"),
        (b"ply\nformat ascii 1.0\n", "PLY mesh"),
        (bytes(np.random.default_rng(0).integers(0, 256, 4096, dtype=np.uint8)), "binary file of no known format"),
        (b"\0" * 336, "binary file of no known format"),
        (b"Copyright (c) somebody\n", "text, but not one of the known"),
        (b"0 0.25 sil\n0.25 0.3 a\n", "text, but not one of the known"),
        (b"3.58 -8.79\n6.62 -8.28\n", "palate"),
        (b'{"CoreTensor": [1]}', "tonguetrack model info"),
        (b'{"a": 1}', "JSON without"),
        (b"\x89HDF\r\n\x1a\n", "-v7"),
        (b"channel,notes,location\n1,,ear\n", "text, but not one of the known"),
    ],
)  # fmt: skip
def test_what_is_no_recording_is_one_sentence(tmp_path, content, words):
    path = tmp_path / "take.pos"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as raised:
        open_recording(path)
    message = str(raised.value)
    assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message


def test_a_wrong_suffix_does_not_matter_and_is_said(tmp_path, take):
    write_recording(take, tmp_path / "take.csv").rename(tmp_path / "take.pos")
    recording = open_recording(tmp_path / "take.pos")
    assert recording.format == "tonguetrack CSV 1"
    assert any("ends in .pos" in note and "content decides" in note for note in recording.notes)


def test_a_path_that_is_no_file_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        open_recording(tmp_path / "nowhere.pos")
    with pytest.raises(InputError, match="no such file"):
        find_recordings(tmp_path / "nowhere")
    with pytest.raises(InputError, match="cannot be read"):
        open_recording(tmp_path / ("a" * 300))
    with pytest.raises(InputError, match="not a regular file"):
        open_recording("/dev/null" if sys.platform != "win32" else "NUL")


def test_an_empty_folder_and_one_without_recordings_are_said(tmp_path):
    with pytest.raises(InputError, match="the folder is empty"):
        open_recording(tmp_path)
    (tmp_path / "LICENSE").write_text("words")
    with pytest.raises(InputError, match="no recording in this folder"):
        open_recording(tmp_path)
    assert [item.is_recording for item in find_recordings(tmp_path)] == [False]


def test_a_folder_with_one_recording_opens_as_that_one(tmp_path, take):
    (tmp_path / "deep").mkdir()
    write_recording(take, tmp_path / "deep/take.npz")
    assert open_recording(tmp_path).coils == ("tip",)
    write_recording(take, tmp_path / "other.csv")
    with pytest.raises(InputError, match=r"2 recordings .*take\.npz.*other\.csv.*; name one"):
        open_recording(tmp_path)


def test_hidden_files_and_folders_are_passed_over(tmp_path, take):
    (tmp_path / ".cache").mkdir()
    write_recording(take, tmp_path / ".cache/take.csv")
    write_recording(take, tmp_path / ".take.csv")
    write_recording(take, tmp_path / "take.csv")
    assert [item.path.name for item in find_recordings(tmp_path)] == ["take.csv"]


def test_ssff_files_of_one_stem_are_one_recording(tmp_path):
    for k, coil in enumerate(("tip", "mid", "back")):
        (tmp_path / f"0001.{coil}").write_bytes(ssff_file(np.full((4, 3), k + 1)))
    (tmp_path / "0002.tip").write_bytes(ssff_file(np.ones((4, 3))))
    (tmp_path / "0001.wav").write_bytes(b"RIFF\0\0\0\0WAVE")
    (tmp_path / "0001.f0").write_bytes(ssff_file(np.ones((4, 1)), columns=("q",)))
    found = [item for item in find_recordings(tmp_path) if item.is_recording]
    assert [[file.name for file in item.files] for item in found] == [
        ["0001.back", "0001.mid", "0001.tip"],
        ["0002.tip"],
    ]
    recording = open_recording(tmp_path / "0001.mid")
    assert recording.coils == ("back", "mid", "tip")
    assert recording.positions[0, :, 0].tolist() == [3, 2, 1]


def test_a_damaged_coil_file_is_not_left_out_silently(tmp_path):
    (tmp_path / "0001.tip").write_bytes(ssff_file(np.ones((4, 3))))
    (tmp_path / "0001.mid").write_bytes(ssff_file(np.ones((4, 3)))[:-5])
    with pytest.raises(InputError, match=r"0001\.mid.*truncated"):
        open_recording(tmp_path / "0001.tip")


def test_an_unreadable_file_is_one_sentence(tmp_path, take, monkeypatch):
    path = write_recording(take, tmp_path / "take.csv")

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(InputError, match="cannot be read"):
        open_recording(path)


def test_importing_the_drivers_stays_light():
    code = (
        "import sys, tonguetrack.drivers; print([m for m in ('scipy', 'numba', 'yaml') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
