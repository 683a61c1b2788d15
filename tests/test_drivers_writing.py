"""What is written is read back bit for bit, whole or not at all."""

import io
import json
import os
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tonguetrack import InputError
from tonguetrack.atomic import write_atomically
from tonguetrack.drivers import FrameOfReference, Recording, open_recording, write_recording
from tonguetrack.drivers.files.authors import authors_bytes
from tonguetrack.drivers.files.npz import npz_bytes
from tonguetrack.drivers.files.recognise import parse
from tonguetrack.drivers.files.tabular import table_bytes

WRITERS = {"a.csv": table_bytes, "a.npz": npz_bytes}
COORDINATES = st.floats(-999, 999) | st.just(float("nan"))


@st.composite
def recordings(draw):
    frames, coils = draw(st.integers(2, 5)), draw(st.integers(1, 3))
    positions = draw(arrays(np.float64, (frames, coils, 3), elements=COORDINATES))
    positions[np.isnan(positions).any(axis=2)] = np.nan
    optional = {
        key: draw(st.none() | arrays(np.float64, (frames, coils, *width), elements=st.floats(-1, 1)))
        for key, width in {"orientations": (3,), "quaternions": (4,), "rms": ()}.items()
    }
    names = st.text(st.characters(min_codepoint=33, max_codepoint=0x24F), min_size=1, max_size=6)
    usable = names.filter(
        lambda name: "\x85" not in name and " ".join(name.split()) == name and "#" not in name
    )
    rate = draw(st.sampled_from([100.0, 145.65, 200.0, 250.0, 400.0]))
    return Recording(
        coils=tuple(draw(st.lists(usable, min_size=coils, max_size=coils, unique=True))),
        positions=positions, times_s=draw(st.floats(-5, 5)) + np.arange(frames) / rate, rate_hz=rate,
        format="made", frame=draw(st.sampled_from([FrameOfReference(), FrameOfReference("left", "back", "up", "teeth")])),
        notes=("One sentence.",), extra={"recorded": "today"}, **optional,
    )  # fmt: skip


def assert_same(left, right):
    assert left.coils == right.coils
    assert (left.rate_hz, left.frame, left.notes) == (right.rate_hz, right.frame, right.notes)
    assert dict(left.extra) == dict(right.extra)
    for field in ("positions", "times_s", "orientations", "quaternions", "rms"):
        one, other = getattr(left, field), getattr(right, field)
        assert (one is None) == (other is None), field
        if one is not None:
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", WRITERS)
def test_csv_and_npz_return_a_recording_bit_for_bit(name):
    @settings(max_examples=60, deadline=None, database=None)
    @given(recordings())
    def check(recording):
        assert_same(parse(WRITERS[name](recording), name), recording)

    check()


@settings(max_examples=60, deadline=None, database=None)
@given(recordings())
def test_the_authors_json_returns_names_positions_times_and_what_is_missing(recording):
    content = authors_bytes(recording)
    json.loads(content, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    again = parse(content, "a.json")
    assert again.coils == recording.coils
    np.testing.assert_array_equal(again.times_s, recording.times_s)
    at_zero = (recording.positions == 0).all(axis=2)
    expected = np.where(at_zero[:, :, None], np.nan, recording.positions)
    np.testing.assert_array_equal(again.positions, expected)


def test_a_missing_sample_in_the_authors_json_holds_the_last_known_position():
    positions = np.arange(12.0).reshape(4, 1, 3) + 1
    positions[[0, 2]] = np.nan
    recording = Recording(("tip",), positions, np.arange(4) / 200, 200.0, "made")
    channel = json.loads(authors_bytes(recording))["channels"]["tip"]
    assert channel["position"] == [4, 5, 6, 4, 5, 6, 4, 5, 6, 10, 11, 12]
    assert channel["RMS"] == [-1, 0, -1, 0]


def test_our_csv_states_unit_rate_and_frame_and_leaves_missing_cells_empty():
    positions = np.array([[[1.5, 2, 3]], [[np.nan] * 3]])
    frame = FrameOfReference("left", "back", "up", "incisors")
    text = table_bytes(Recording(("tip",), positions, np.array([0, 0.005]), 200.0, "made", frame)).decode()
    assert text.splitlines() == [
        "# tonguetrack recording 1",
        "# unit: mm",
        "# rate_hz: 200.0",
        "# frame: x left, y back, z up; origin incisors",
        "# from: made",
        "time_s,tip_x,tip_y,tip_z",
        "0.0,1.5,2.0,3.0",
        "0.005,,,",
    ]


def test_a_coil_name_that_no_table_can_hold_is_refused():
    recording = Recording(("a\nb",), np.zeros((1, 1, 3)), np.zeros(1), 200.0, "made")
    with pytest.raises(InputError, match="rename"):
        table_bytes(recording)


def test_a_newer_csv_is_not_half_understood():
    with pytest.raises(InputError, match="newer"):
        parse(b"# tonguetrack recording 2\n# unit: mm\ntime_s,a_x,a_y,a_z\n0,1,2,3\n", "a.csv")


def test_an_npz_with_objects_or_another_purpose_is_refused():
    out = io.BytesIO()
    np.savez(out, core=np.zeros((2, 2)), faces=np.zeros(3))
    with pytest.raises(InputError, match="tonguetrack model info"):
        parse(out.getvalue(), "a.npz")
    recording = Recording(("tip",), np.ones((2, 1, 3)), np.array([0, 0.1]), 10.0, "made")
    pickled = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(npz_bytes(recording))) as old, zipfile.ZipFile(pickled, "w") as new:
        for member in old.namelist():
            content = io.BytesIO()
            np.save(content, np.array([{}], dtype=object), allow_pickle=True)
            new.writestr(member, content.getvalue() if member == "rms.npy" else old.read(member))
        new.writestr("rms.npy", content.getvalue())
    with pytest.raises(InputError, match="plain numbers"):
        parse(pickled.getvalue(), "a.npz")


@pytest.mark.parametrize("suffix", [".csv", ".json", ".npz"])
def test_write_recording_goes_by_the_suffix(tmp_path, suffix):
    recording = Recording(("tip",), np.ones((3, 1, 3)), np.arange(3) / 100, 100.0, "made")
    path = write_recording(recording, tmp_path / f"take{suffix.upper()}")
    np.testing.assert_array_equal(open_recording(path).positions, recording.positions)
    assert os.listdir(tmp_path) == [path.name]


def test_an_unknown_suffix_names_those_that_exist(tmp_path):
    recording = Recording(("tip",), np.ones((3, 1, 3)), np.arange(3) / 100, 100.0, "made")
    with pytest.raises(InputError, match=r"\.csv, \.json .* or \.npz"):
        write_recording(recording, tmp_path / "take.pos")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "take.csv"
    write_atomically(path, b"old")

    def fail(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, fail)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["take.csv"]
    write_atomically(path, lambda file: file.write(b"new"))
    assert path.read_bytes() == b"new"


def test_places_that_cannot_be_written_are_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="does not exist"):
        write_atomically(tmp_path / "nowhere" / "a.csv", b"")
    with pytest.raises(InputError, match="is not a folder"):
        write_atomically(tmp_path / "file" / "a.csv", b"")
    with pytest.raises(InputError, match="this is a folder"):
        write_atomically(tmp_path, b"")
    with pytest.raises(InputError, match="too long"):
        write_atomically(tmp_path / ("a" * 300), b"")

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError, match="no permission to write"):
        write_atomically(tmp_path / "a.csv", b"")


def test_a_link_is_followed_and_the_usual_permissions_are_kept(tmp_path):
    target = tmp_path / "real.csv"
    target.write_bytes(b"old")
    link = tmp_path / "link.csv"
    link.symlink_to(target)
    write_atomically(link, b"new")
    assert link.is_symlink() and target.read_bytes() == b"new"
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    assert target.stat().st_mode == plain.stat().st_mode


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="nothing is write-protected here")
def test_a_write_protected_file_is_not_replaced(tmp_path):
    path = tmp_path / "kept.csv"
    path.write_text("old")
    path.chmod(0o444)
    with pytest.raises(InputError, match="write-protected"):
        write_atomically(path, b"new")
    assert path.read_text() == "old"
