"""The preference test: what is made, in which order it is shown, that no choice is lost, and how choices are counted."""

import csv
import errno
import io
import json
import shutil
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from preferring import (
    BRIGHT_MM,
    CENTRE_MM,
    MARK_MM,
    RADIUS_MM,
    SPACING_MM,
    SYNTHETIC,
    ball_mesh,
    case,
    cases,
    scan_of_a_ball,
    small_test,
)

from tonguetrack import InputError
from tonguetrack.model.mri.preference import FINAL, INITIAL, cases_of, load_test, make_test, picture_bytes
from tonguetrack.model.mri.preferenceanswers import (
    MAX_NAME,
    SIDES,
    all_sittings,
    begun_sitting,
    choose,
    known_sitting,
    shown_to,
)
from tonguetrack.model.mri.preferencetally import (
    TALLY_FILES,
    as_json,
    as_text,
    clustered_interval,
    tally,
    wilson,
    write_tally,
)
from tonguetrack.tracker.cli import main

Image = pytest.importorskip("PIL.Image")
NOW = "2026-01-31T12:00:00Z"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three speakers, four phones, one scan missing, two partitions; not to be changed."""
    return small_test(tmp_path_factory.mktemp("preference") / "test")


@pytest.fixture
def test(made, tmp_path):
    """The same, for one's own answers."""
    shutil.copytree(made.folder, tmp_path / "test")
    return load_test(tmp_path / "test")


def judge(test, participant, choice, partition=None, count=None):
    """A participant who chooses by a rule: item -> method."""
    sitting = begun_sitting(test, participant, partition, np.random.default_rng(0))
    for place, shown in list(enumerate(sitting.shown))[:count]:
        sitting = choose(test, sitting, place, shown.side(choice(test.items[shown.item])), NOW)
    return sitting


def always(method):
    return lambda item: method


# What is made ---------------------------------------------------------------------------------------


def test_every_scan_is_in_one_partition_and_partitions_differ_by_one_at_most(made):
    assert [(item.speaker, item.phone) for item in made.items] == [cell[:2] for cell in cases(3)]
    sizes = Counter(item.partition for item in made.items)
    assert sorted(sizes) == [1, 2] and max(sizes.values()) - min(sizes.values()) <= 1
    assert sorted(made.partition(1) + made.partition(2)) == list(range(len(made.items)))


def test_the_contours_lie_on_the_picture_where_the_meshes_lie_in_the_scan(made):
    """Both are circles around the ball's centre, and the picture is bright within the ball, dark outside of it."""
    item = made.items[0]
    pixels = np.asarray(Image.open(io.BytesIO(picture_bytes(made, item)))).astype(float)
    per_mm = np.array(pixels.shape) / [item.height_mm, item.width_mm]
    outline = np.vstack(item.final)
    centre = (outline.min(axis=0) + outline.max(axis=0)) / 2
    for method in (INITIAL, FINAL):
        for line in getattr(item, method):
            away = np.linalg.norm(line - centre, axis=1)
            assert np.abs(away - RADIUS_MM[method]).max() < 0.15
    down, right = np.meshgrid(*(np.arange(n) + 0.5 for n in pixels.shape), indexing="ij")
    places = np.stack([right / per_mm[1], down / per_mm[0]], axis=-1)
    away = np.linalg.norm(places - centre, axis=2)
    assert pixels[away < BRIGHT_MM - SPACING_MM].min() > 128
    bright = pixels > 128
    mark = np.linalg.norm(places - centre - (MARK_MM - CENTRE_MM)[[1, 2]] * [1, -1], axis=2) < 3.0
    assert bright[mark].any() and not bright[(away > BRIGHT_MM + SPACING_MM) & ~mark].any()


def test_nothing_in_a_slice_tells_the_two_contours_apart_but_their_lines(made):
    """One picture and one frame for both, wide enough for either."""
    for item in made.items:
        for line in (*item.initial, *item.final):
            assert (line > 0).all() and (line < [item.width_mm, item.height_mm]).all()
    assert not any(word in item.picture for item in made.items for word in (INITIAL, FINAL))


def test_several_slices_of_one_scan_are_in_one_partition(tmp_path):
    test = small_test(tmp_path / "test", speakers=2, offsets_mm=(0.0, 5.0, -5.0))
    groups = {}
    for item in test.items:
        groups.setdefault((item.speaker, item.phone), []).append(item)
    assert len(groups) == 7 and {len(items) for items in groups.values()} == {3}
    assert all(len({item.partition for item in items}) == 1 for items in groups.values())
    assert [item.at_mm - CENTRE_MM[0] for item in test.items[:3]] == [0.0, 5.0, -5.0]
    halves = [np.ptp(np.vstack(item.final), axis=0)[0] / 2 for item in test.items[:3]]
    assert halves == pytest.approx([9.0, np.sqrt(81 - 25), np.sqrt(81 - 25)], abs=0.15)


def test_other_seeds_make_other_partitions_and_the_same_seed_the_same(tmp_path):
    one, same, other = (
        small_test(tmp_path / str(number), speakers=2, seed=seed) for number, seed in enumerate((1, 1, 2))
    )
    assert one.fingerprint == same.fingerprint
    assert [item.partition for item in one.items] != [item.partition for item in other.items]


def test_a_scan_that_cannot_be_shown_is_left_out_with_a_sentence_that_names_it(tmp_path):
    beside, unreadable = case("A", "i", off_mm=500.0), InputError("scan.nii: there is no such scan.")
    missed = replace(case("A", "u"), initial=ball_mesh(5.0, CENTRE_MM + [40.0, 0, 0]))
    mixed = [("A", "i", beside), ("A", "e", unreadable), ("A", "u", missed), *cases(1)]
    test, problems = make_test(mixed, tmp_path / "test", "set.toml", "", 3)
    assert [(problem.speaker, problem.phone) for problem in problems] == [("A", "i"), ("A", "e"), ("A", "u")]
    assert "A [i]: " in problems[0].sentence and "not in this scan" in problems[0].sentence
    assert problems[1].sentence == "A [e]: scan.nii: there is no such scan."
    assert "the initial mesh does not reach" in problems[2].sentence
    assert {item.speaker for item in test.items} == {"Speaker01"}


def test_a_folder_that_holds_something_is_not_touched(made):
    before = sorted(made.folder.rglob("*"))
    with pytest.raises(InputError, match="new or empty folder"):
        make_test(cases(1), made.folder, "set.toml", "")
    assert sorted(made.folder.rglob("*")) == before


def test_more_partitions_than_scans_are_refused_and_leave_nothing_behind(tmp_path):
    with pytest.raises(InputError, match="3 scans can be shown.* 4 partitions"):
        make_test(cases(1), tmp_path / "test", "set.toml", "", 4)
    assert not (tmp_path / "test").exists()


def built(folder, final, initial=None):
    """What `mri build` would have found in one scan of a ball."""
    from tonguetrack.model.mri.scan import write_nifti

    pytest.importorskip("nibabel")
    write_nifti(scan_of_a_ball(), folder / "ball.nii.gz")
    region = SimpleNamespace(low_mm=CENTRE_MM - 25, high_mm=CENTRE_MM + 25)
    found = SimpleNamespace(
        entry=SimpleNamespace(path=folder / "ball.nii.gz", region=region),
        initial=(initial or final).vertices,
        final=final.vertices,
        palate=np.array([[0.0, 0, 0], [CENTRE_MM[0] - 1, 0, 0], [CENTRE_MM[0] + 1, 0, 0]]),
    )
    lost = SimpleNamespace(**{**vars(found), "entry": SimpleNamespace(path=folder / "gone.nii", region=None)})
    return SimpleNamespace(
        source=folder / "set.toml",
        scans={("A", "i"): found, ("A", "e"): lost},
        tongue=SimpleNamespace(mesh=final),
        palate=SimpleNamespace(marks=SimpleNamespace(midsagittal=(1, 2))),
        shapes=SimpleNamespace(provenance={"data": SYNTHETIC}),
    )


def test_what_is_judged_of_a_build_is_cut_in_the_middle_of_the_aligned_palate(tmp_path):
    (_, _, first), (speaker, phone, second) = cases_of(built(tmp_path, ball_mesh(9.0), ball_mesh(11.0)))
    assert first.middle_mm == pytest.approx(CENTRE_MM[0]) and first.scan.values.dtype == np.uint8
    assert max(first.scan.values.shape) <= 50 / SPACING_MM + 1  # the region alone
    np.testing.assert_array_equal(first.initial.vertices, ball_mesh(11.0).vertices)
    assert (speaker, phone) == ("A", "e") and isinstance(second, InputError) and "gone.nii" in str(second)


def test_a_build_without_bootstrapping_has_nothing_to_compare(tmp_path):
    with pytest.raises(InputError, match="nothing to prefer"):
        list(cases_of(built(tmp_path, ball_mesh(9.0))))


@pytest.mark.parametrize(
    "damage",
    [
        lambda table: [],
        lambda table: {**table, "version": 99},
        lambda table: {**table, "items": []},
        lambda table: {**table, "partitions": 0},
        lambda table: {**table, "items": [{**table["items"][0], "picture": "../../etc/passwd"}]},
        lambda table: {**table, "items": [{**table["items"][0], "partition": 7}]},
        lambda table: {**table, "items": [{**table["items"][0], "size_mm": [float("inf"), 1]}]},
        lambda table: {**table, "items": [{**table["items"][0], "initial": [[[1, 2, 3]]]}]},
        lambda table: {**table, "items": [{**table["items"][0], "final": "abc"}]},
        lambda table: {**table, "items": [{"speaker": "A"}]},
    ],
)
def test_what_is_no_test_of_ours_is_one_sentence(test, damage):
    path = test.folder / "test.json"
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    with pytest.raises(InputError, match="not a preference test of ours"):
        load_test(test.folder)


def test_a_picture_that_is_gone_is_named(test):
    (test.folder / test.items[3].picture).unlink()
    with pytest.raises(InputError, match="0004.png.*is not there"):
        load_test(test.folder)


# The order ------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    name=st.text("abcXYZ äßé-_/.%", min_size=1, max_size=20).filter(str.strip), partition=st.integers(1, 2)
)
def test_everybody_sees_the_partition_once_each_method_as_often_on_the_left(made, name, partition):
    shown = shown_to(made, name, partition)
    assert sorted(seen.item for seen in shown) == made.partition(partition)
    left = sum(seen.left == FINAL for seen in shown)
    assert abs(2 * left - len(shown)) <= 1
    assert shown == shown_to(
        made, f"  {name.upper() if name.upper().lower() == name.lower() else name} ", partition
    )
    for seen in shown:
        assert {seen.method(side) for side in SIDES} == {INITIAL, FINAL}
        assert all(seen.method(seen.side(method)) == method for method in (INITIAL, FINAL))


def test_order_and_sides_differ_between_participants(made):
    everybody = [shown_to(made, f"P{n}", 1) for n in range(200)]
    assert len({tuple(seen.item for seen in shown) for shown in everybody}) > 100
    for item in made.partition(1):
        left = sum(seen.left == FINAL for shown in everybody for seen in shown if seen.item == item)
        assert 65 < left < 135  # of 200: five deviations
        first = sum(shown[0].item == item for shown in everybody)
        assert 10 < first < 70


def test_new_participants_get_the_partitions_evenly(test):
    random = np.random.default_rng(3)
    given_out = [begun_sitting(test, f"P{n}", None, random).partition for n in range(10)]
    assert Counter(given_out) == {1: 5, 2: 5}
    assert all(sorted(given_out[n : n + 2]) == [1, 2] for n in range(0, 10, 2))
    assert given_out[::2] != [1] * 5


def test_a_participant_keeps_the_partition_and_is_told_when_another_one_is_named(test):
    assert begun_sitting(test, "Anna", 2, np.random.default_rng(0)).partition == 2
    assert begun_sitting(test, " anna ", None, np.random.default_rng(0)).partition == 2
    with pytest.raises(InputError, match="has begun with partition 2"):
        begun_sitting(test, "ANNA", 1, np.random.default_rng(0))
    with pytest.raises(InputError, match="no partition 3; there are 1 to 2"):
        begun_sitting(test, "Bert", 3, np.random.default_rng(0))
    assert [sitting.participant for sitting in all_sittings(test)] == ["Anna"]


@pytest.mark.parametrize("name", ["", "   ", "x" * (MAX_NAME + 1), "a\nb\0", "\u202eabc"])
def test_what_is_no_name_makes_no_file(test, name):
    with pytest.raises(InputError, match="name has 1 to"):
        begun_sitting(test, name, None, np.random.default_rng(0))
    assert not list(test.folder.glob("answers/*"))


def test_names_that_look_alike_in_plain_letters_are_kept_apart(test):
    names = ["ä", "ö", "a/../b", "a b", "..", "CON", "ʃ" * MAX_NAME]
    for name in names:
        judge(test, name, always(FINAL), count=1)
    files = list((test.folder / "answers").iterdir())
    assert len(files) == len(names) and {path.parent for path in files} == {test.folder / "answers"}
    assert {sitting.participant for sitting in all_sittings(test)} == set(names)


# Nothing is lost ------------------------------------------------------------------------------------


def test_choices_are_there_again_and_the_last_one_about_a_slice_counts(test):
    sitting = judge(test, "Anna", always(FINAL), count=3)
    sitting = choose(test, sitting, 1, sitting.shown[1].side(INITIAL), NOW)
    assert sitting.chosen == {0: FINAL, 1: INITIAL, 2: FINAL}
    assert known_sitting(test, "Anna") == sitting
    assert known_sitting(test, "Bert") is None


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_wherever_a_file_is_cut_off_the_choices_before_are_kept_and_it_goes_on(made, tmp_path_factory, data):
    test = replace(made, folder=tmp_path_factory.mktemp("cut"))
    judge(test, "Anna", always(FINAL), 1, count=4)
    (path,) = (test.folder / "answers").iterdir()
    whole = path.read_bytes()
    cut = data.draw(st.integers(0, len(whole)))
    path.write_bytes(whole[:cut])
    complete = whole[:cut].count(b"\n")
    # The last line without its end is as good as whole.
    ends = [n for n, letter in enumerate(whole) if letter == ord("\n")]
    complete += cut in ends
    kept = known_sitting(test, "Anna")
    assert (0 if kept is None else len(kept.chosen)) == max(complete - 1, 0)
    sitting = begun_sitting(test, "Anna", 1, np.random.default_rng(0))
    sitting = choose(test, sitting, 4, "left", NOW)
    again = known_sitting(test, "Anna")
    assert (
        again.chosen == sitting.chosen and 4 in again.chosen and len(again.chosen) == max(complete - 1, 0) + 1
    )
    assert again.damaged <= 1


def test_every_choice_is_on_the_disk_before_the_next_one(test, monkeypatch):
    (test.folder / "answers").mkdir()
    synced = []

    def fsync(handle):
        synced.append(sum(path.read_bytes().count(b"\n") for path in (test.folder / "answers").iterdir()))

    monkeypatch.setattr("os.fsync", fsync)
    judge(test, "Anna", always(FINAL), count=3)
    assert synced == [1, 2, 3, 4]  # the name and three choices, each written whole when it is synced


def test_a_choice_that_the_disk_does_not_take_is_one_sentence(test, monkeypatch):
    sitting = judge(test, "Anna", always(FINAL), count=1)

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match="answer cannot be kept .No space left"):
        choose(test, sitting, 1, "left", NOW)


def test_a_line_that_nobody_can_read_is_counted_and_costs_no_other(test):
    judge(test, "Anna", always(FINAL), count=3)
    (path,) = (test.folder / "answers").iterdir()
    lines = path.read_bytes().splitlines()
    lines[2] = b'{"item": 99999, "chosen": "final"}'
    path.write_bytes(
        b"\n".join([*lines, b"\xff\xfe", b"[1]", b'{"item": [], "chosen": "final", "test": "x"}', b""])
    )
    sitting = known_sitting(test, "Anna")
    assert len(sitting.chosen) == 2 and sitting.damaged == 4


def test_answers_of_another_test_are_refused(test, tmp_path):
    judge(test, "Anna", always(FINAL), count=1)
    other = small_test(tmp_path / "other", seed=5)
    shutil.copytree(test.folder / "answers", other.folder / "answers")
    with pytest.raises(InputError, match="belong to another test"):
        tally(other)


# Counting -------------------------------------------------------------------------------------------


def test_the_tally_counts_what_was_chosen_per_scan_per_speaker_and_over_all(test):
    """Two judge everything the same way; the third changes one scan of Speaker01 to the first matching."""
    for partition in (1, 2):
        judge(test, f"A{partition}", lambda item: INITIAL if item.phone == "s" else FINAL, partition)
        judge(test, f"B{partition}", lambda item: INITIAL if item.phone in "si" else FINAL, partition)
        judge(test, f"C{partition}", always(FINAL), partition)
    result = tally(test)
    scans = {(scan.speaker, scan.phone): scan.share for scan in result.scans}
    assert len(scans) == 11 and all(share.count == 3 for share in scans.values())
    expected = {"s": 1, "i": 2, "a": 3, "ʃ": 3}
    assert all(share.final == expected[phone] for (_, phone), share in scans.items())
    assert [(scan.speaker, scan.phone) for scan in result.initial_won] == [
        (f"Speaker0{n}", "s") for n in (1, 2, 3)
    ]
    assert result.overall.count == 33 and result.overall.final == 3 * (1 + 2 + 3) + 2 * 3
    speakers = dict(result.speakers)
    assert speakers["Speaker01"].share == pytest.approx(9 / 12) and speakers["Speaker03"].count == 9
    assert {who.name: who.share.share for who in result.participants if who.name[0] == "C"} == {
        "C1": 1.0,
        "C2": 1.0,
    }
    for who in result.participants:
        assert who.answered == who.total and who.left == sum(
            a.left == a.chosen for a in result.answers if a.participant == who.name
        )


def test_half_of_the_answers_for_the_first_matching_are_enough_to_be_listed(test):
    judge(test, "Anna", always(FINAL), 1)
    judge(test, "Bert", always(INITIAL), 1)
    result = tally(test)
    assert {test.items[n].phone for n in test.partition(1)} == {scan.phone for scan in result.initial_won}
    assert len(result.initial_won) == len(test.partition(1)) and result.overall.share == 0.5


def test_a_test_that_nobody_has_judged_is_one_sentence(test):
    with pytest.raises(InputError, match="nobody has answered yet"):
        tally(test)


def test_wilsons_interval_is_that_of_the_textbooks():
    assert wilson(0.8, 10, 1.959964) == pytest.approx((0.490162, 0.943318), abs=1e-5)
    assert wilson(1.0, 10, 1.959964) == pytest.approx((0.722467, 1.0), abs=1e-5)
    assert wilson(0.0, 10, 1.959964) == pytest.approx((0.0, 0.277533), abs=1e-5)


def test_without_groups_the_interval_is_wilsons_and_mirrors_with_the_votes():
    votes = np.array([1, 1, 1, 0, 1, 0, 1, 1, 1, 1], float)
    low, high = clustered_interval(votes, [np.arange(10), np.zeros(10, int)])
    assert (low, high) == pytest.approx((0.490162, 0.943318), abs=1e-5)
    assert clustered_interval(1 - votes, []) == pytest.approx((1 - high, 1 - low))


def test_participants_who_each_always_choose_the_same_count_as_one_answer_each():
    """Ten people, thirty slices: as uncertain as ten answers, up to the quantile for so few."""
    votes = np.repeat([1, 1, 1, 1, 1, 1, 1, 0, 0, 0], 30).astype(float)
    people, slices = np.repeat(np.arange(10), 30), np.tile(np.arange(30), 10)
    low, high = clustered_interval(votes, [people, slices])
    ten = wilson(0.7, 9.0, 2.262157)  # n (n - 1) / n = 9 as variances are estimated
    assert (low, high) == pytest.approx(ten, abs=1e-5)


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
    """People and scans that differ: 15 people, each a quarter of 120 scans. Plain Wilson would hold it far less often."""
    random = np.random.default_rng(5)
    covered = plain = 0
    runs = 300
    scans = np.arange(120)
    people = np.arange(15)
    for _ in range(runs):
        leaning, ease = random.normal(0, 0.13, 15), random.normal(0, 0.13, 120)
        who = np.repeat(people, 30)
        what = np.concatenate([random.choice(scans, 30, replace=False) for _ in people])
        chance = np.clip(0.7 + leaning[who] + ease[what], 0, 1)
        votes = (random.random(len(who)) < chance).astype(float)
        low, high = clustered_interval(votes, [who, what])
        covered += low <= 0.7 <= high
        low, high = wilson(votes.mean(), len(votes), 1.959964)
        plain += low <= 0.7 <= high
    assert covered / runs > 0.91 > plain / runs


def test_the_report_says_the_same_in_every_form(test, tmp_path):
    for partition in (1, 2):
        judge(test, f"Anna {partition}", lambda item: INITIAL if item.phone == "s" else FINAL, partition)
    judge(test, "Zoë", always(FINAL), 1, count=2)
    result = tally(test)
    written = write_tally(result, tmp_path)
    assert [path.name for path in written] == list(TALLY_FILES)
    content = json.loads((tmp_path / "tally.json").read_text())
    assert content == as_json(result) and content["overall"]["answers"] == 13
    assert content["provenance"] == SYNTHETIC and "synthetic" in as_text(result)
    rows = list(csv.DictReader((tmp_path / "scans.csv").open()))
    assert [(row["speaker"], row["phone"]) for row in rows] == [cell[:2] for cell in cases(3)]
    assert sum(int(row["final"]) for row in rows) == content["overall"]["final"]
    won = [[row["speaker"], row["phone"]] for row in rows if row["initial_won"] == "1"]
    assert sorted(won) == sorted(content["initial_won"]) and len(won) == 3
    answers = list(csv.DictReader((tmp_path / "answers.csv").open()))
    assert len(answers) == 13 and {row["side"] for row in answers} == set(SIDES)
    assert sum(row["chosen"] == "final" for row in answers) == content["overall"]["final"]
    text = (tmp_path / "tally.txt").read_text()
    assert "Speaker03 [s]: 1 of 1" in text and "Zoë" in text and "2/" in text
    assert Image.open(tmp_path / "preference.png").size[0] > 400
    svg = (tmp_path / "preference.svg").read_text()
    assert svg.count("<svg") == 1 and "no scan" in svg


def test_a_scan_that_nobody_has_judged_is_told_apart_from_one_that_lost(test):
    judge(test, "Anna", always(INITIAL), 1)
    result = tally(test)
    unjudged = [scan for scan in result.scans if not scan.share.count]
    assert len(unjudged) == len(test.partition(2)) and not any(scan.initial_won for scan in unjudged)
    assert f"Scans that nobody has judged: {len(unjudged)}" in as_text(result)
    assert {row["share"] for row in as_json(result)["scans"]} == {0.0, None}


# The commands ---------------------------------------------------------------------------------------


def run(*arguments):
    return main(["mri", "preference", *map(str, arguments)])


def test_a_build_of_which_a_scan_has_gone_gives_the_rest_a_sentence_and_exit_code_3(
    tmp_path, monkeypatch, capsys
):
    found = built(tmp_path, ball_mesh(9.0), ball_mesh(11.0))
    monkeypatch.setattr("tonguetrack.model.mri.results.load_result", lambda work: found)
    assert run("make", "work", "-o", tmp_path / "test", "--partitions", 1, "--slices", "mid,-4") == 3
    said = capsys.readouterr().err
    assert "2 slices in 1 partition;" in said and "left out: A [e]: " in said and "gone.nii" in said
    test = load_test(tmp_path / "test")
    assert [item.at_mm for item in test.items] == pytest.approx([CENTRE_MM[0], CENTRE_MM[0] - 4])
    assert test.source == "set.toml" and test.synthetic


def test_the_tally_command_prints_and_writes(test, tmp_path, capsys):
    judge(test, "Anna", always(FINAL))
    assert run("tally", test.folder, "-o", tmp_path / "report") == 0
    said = capsys.readouterr()
    assert "Bootstrapping was preferred in 100.0 %" in said.out and "preference.svg" in said.err
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == sorted(TALLY_FILES)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["tally", "nowhere"], "there is no preference test"),
        (["serve", "nowhere"], "there is no preference test"),
        (["make", "nowhere", "-o", "test", "--slices", "mid,x"], "'x' should be 'mid' or a number of mm"),
        (["make", "nowhere", "-o", "test", "--slices", "mid,0"], "each place once"),
        (["make", "nowhere", "-o", "test", "--seed", "-1"], "expected 0 or more"),
        (["make", "nowhere", "-o", "test"], "nowhere"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1
    assert not (tmp_path / "test").exists()


def test_a_partition_that_is_not_there_is_refused_before_anything_is_served(test, capsys):
    assert run("serve", test.folder, "--partition", 3, "--host", "127.0.0.1:0") == 2
    assert "no partition 3" in capsys.readouterr().err
