"""The file that lists the scans: what it holds, what is left out with a sentence, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.model.mri.dataset import (
    Dataset,
    Problem,
    Region,
    ScanEntry,
    dataset_toml,
    landmarks_csv,
    load_dataset,
    read_landmarks,
)

TIP = {"Tip": np.array([1.25, -2.5, 3.0])}
APEX = {"Apex": np.array([0.0, 20.0, 15.0])}


def write_dataset(folder: Path) -> Path:
    """Two speakers, [i] and [a], the palate seen in [a]; the second speaker has no [i]."""
    for name in ("scans", "landmarks"):
        (folder / name).mkdir()
    scans = {}
    files: dict[tuple[str, str], tuple[str, str | None]] = {}
    for speaker, phone in (("S1", "i"), ("S1", "a"), ("S2", "a")):
        path = folder / "scans" / f"{speaker}_{phone}.nii.gz"
        path.write_bytes(b"a volume")
        files[speaker, phone] = (f"landmarks/{speaker}_{phone}.csv", None)
        (folder / files[speaker, phone][0]).write_text(landmarks_csv(TIP))
        palate = None
        if phone == "a":
            palate = APEX
            files[speaker, phone] = (files[speaker, phone][0], f"landmarks/{speaker}_palate.csv")
            (folder / f"landmarks/{speaker}_palate.csv").write_text(landmarks_csv(APEX))
        region = Region(np.array([-20.0, -10.0, -60.0]), np.array([20.0, 80.0, 30.0]))
        scans[speaker, phone] = ScanEntry(path, TIP, palate, region if phone == "i" else None)
    source = folder / "dataset.toml"
    dataset = Dataset(
        source, "made for a test", ("S1", "S2"), ("i", "a"), scans, {"S1": "a", "S2": "a"}, {"beta": 10}
    )
    source.write_text(dataset_toml(dataset, files))
    return source


def edited(source: Path, old: str, new: str) -> Path:
    text = source.read_text()
    assert old in text
    source.write_text(text.replace(old, new, 1))
    return source


def test_what_was_written_is_read_back(tmp_path):
    dataset = load_dataset(write_dataset(tmp_path))
    assert dataset.speakers == ("S1", "S2") and dataset.phones == ("i", "a")
    assert dataset.settings == {"beta": 10} and dataset.provenance == "made for a test"
    assert set(dataset.scans) == {("S1", "i"), ("S1", "a"), ("S2", "a")}
    entry = dataset.scans["S1", "i"]
    assert entry.path == tmp_path / "scans/S1_i.nii.gz" and entry.palate_landmarks is None
    np.testing.assert_array_equal(entry.tongue_landmarks["Tip"], TIP["Tip"])
    assert entry.region is not None and entry.region.high_mm.tolist() == [20, 80, 30]
    palate = dataset.scans["S2", "a"].palate_landmarks
    assert palate is not None and palate["Apex"].tolist() == [0, 20, 15]
    assert dataset.problems == ()


def test_a_phone_that_was_not_scanned_is_missing_and_no_problem(tmp_path):
    dataset = load_dataset(write_dataset(tmp_path))
    assert dataset.missing() == (("S2", "i"),)


@pytest.mark.parametrize("harm", ["no volume", "no landmarks", "broken landmarks"])
def test_a_fault_of_one_scan_leaves_that_scan_out_and_names_it(tmp_path, harm):
    source = write_dataset(tmp_path)
    if harm == "no volume":
        (tmp_path / "scans/S1_i.nii.gz").unlink()
    elif harm == "no landmarks":
        (tmp_path / "landmarks/S1_i.csv").unlink()
    else:
        (tmp_path / "landmarks/S1_i.csv").write_text("name,x_mm,y_mm,z_mm\nTip,1,2\n")
    dataset = load_dataset(source)
    assert set(dataset.scans) == {("S1", "a"), ("S2", "a")}
    assert [(problem.speaker, problem.phone) for problem in dataset.problems] == [("S1", "i")]
    assert "S1" in dataset.problems[0].sentence and "[i]" in dataset.problems[0].sentence


@pytest.mark.parametrize("harm", ["no entry", "no landmarks named", "no file", "landmark file gone"])
def test_a_speaker_without_a_palate_scan_is_left_out_with_a_sentence_and_the_rest_stays(tmp_path, harm):
    source = write_dataset(tmp_path)
    if harm == "no entry":
        edited(source, 'palate = "a"\n', "")
    elif harm == "no landmarks named":
        edited(source, 'palate_landmarks = "landmarks/S1_palate.csv"\n', "")
    elif harm == "no file":
        (tmp_path / "scans/S1_a.nii.gz").unlink()
    else:
        (tmp_path / "landmarks/S1_palate.csv").unlink()
    dataset = load_dataset(source)
    assert dataset.speakers == ("S2",) and set(dataset.scans) == {("S2", "a")}
    told = [problem.sentence for problem in dataset.problems if problem.phone is None]
    assert len(told) == 1 and told[0].startswith("S1: there is no usable scan with a visible palate")


def test_a_scan_found_bad_later_goes_alone_unless_it_is_the_palate_scan(tmp_path):
    dataset = load_dataset(write_dataset(tmp_path))
    less = dataset.without([Problem("S1", "i", "S1 [i]: corrupt.")])
    assert less.speakers == ("S1", "S2") and ("S1", "i") not in less.scans and len(less.problems) == 1
    fewer = dataset.without([Problem("S1", "a", "S1 [a]: corrupt.")])
    assert fewer.speakers == ("S2",) and set(fewer.scans) == {("S2", "a")}
    assert [problem.phone for problem in fewer.problems] == ["a", None]


def test_a_scan_without_a_needed_landmark_is_left_out_and_the_landmark_named(tmp_path):
    source = write_dataset(tmp_path)
    (tmp_path / "landmarks/S1_i.csv").write_text("name,x_mm,y_mm,z_mm\nOther,1,2,3\n")
    dataset = load_dataset(source).requiring_landmarks(("Tip",), ("Apex",))
    assert set(dataset.scans) == {("S1", "a"), ("S2", "a")}
    assert "S1_i.nii.gz" in dataset.problems[0].sentence and "Tip" in dataset.problems[0].sentence
    assert load_dataset(source).requiring_landmarks((), ("Apex", "Papilla")).speakers == ()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("phones", "phone", "'phone' is not known"),
        ('phone = "i"', 'phone = "x"', "'phones' lists i, a"),
        ('phone = "i"', 'phone = "a"', "twice"),
        ('name = "S2"', 'name = "S1"', "listed twice"),
        ('name = "S2"', "name = 2", "expected a text"),
        ("[[-20.0, -10.0, -60.0]", "[[-20.0, -10.0]", "two corners"),
        ("[[-20.0, -10.0, -60.0]", "[[30.0, -10.0, -60.0]", "two corners"),
        ('phones = ["i", "a"]', 'phones = ["i", "a"', "not a readable TOML"),
        ('phones = ["i", "a"]', 'phones = ["i", "i"]', "each once"),
        ('file = "scans/S1_i.nii.gz"', "", "'file'"),
    ],
)
def test_a_file_that_cannot_be_understood_is_refused_in_one_sentence(tmp_path, old, new, told):
    source = edited(write_dataset(tmp_path), old, new)
    with pytest.raises(InputError) as refused:
        load_dataset(source)
    assert str(source) in str(refused.value) and told in str(refused.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match="there is no such data set"):
        load_dataset(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "first line"),
        ("a,b,c,d\n", "first line"),
        ("name,x_mm,y_mm,z_mm\nTip,1,2,three\n", "line 2"),
        ("name,x_mm,y_mm,z_mm\nTip,1,2,nan\n", "line 2"),
        ("name,x_mm,y_mm,z_mm\nTip,1,2,3\nTip,1,2,3\n", "line 3"),
    ],
)
def test_landmarks_that_cannot_be_read_are_told_with_their_line(tmp_path, text, told):
    path = tmp_path / "marks.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=told):
        read_landmarks(path)


@given(
    st.dictionaries(
        st.from_regex(r"[A-Z][A-Za-z]{0,12}", fullmatch=True),
        st.tuples(*[st.floats(-500, 500, width=32)] * 3),
        max_size=6,
    )
)
def test_landmarks_survive_their_file_to_a_hundredth_of_a_millimetre(tmp_path_factory, marks):
    path = tmp_path_factory.mktemp("marks") / "marks.csv"
    path.write_text(landmarks_csv({name: np.array(place) for name, place in marks.items()}))
    back = read_landmarks(path)
    assert set(back) == set(marks)
    for name, place in marks.items():
        np.testing.assert_allclose(back[name], place, atol=0.00501)
