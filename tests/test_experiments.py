"""The paper's two experiments as a command: its numbers, its pictures, its words, its refusals."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from displays import require_egl

from tonguetrack import InputError
from tonguetrack.drivers import write_recording
from tonguetrack.drivers.frames import FrameOfReference, Recording
from tonguetrack.model.files import save_model
from tonguetrack.tracker.anatomy import estimate_speaker
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.cli.experiment import short_names
from tonguetrack.tracker.experimentplots import PICTURE_FILES, draw_errors, draw_weights, pictures
from tonguetrack.tracker.experimentreport import (
    ALL,
    TABLE_FILES,
    all_statistics,
    as_csv,
    json_text,
    report_page,
    text_table,
)
from tonguetrack.tracker.experiments import run_experiments, spread_of, statistics_of
from tonguetrack.tracker.session import Session
from tonguetrack.tracker.tracking import track_recording

VERTICES = {"tongue_tip": 3, "tongue_blade": 9, "tongue_dorsum": 15}
CHANNELS = ("TT", "TB", "TD")
FRAME = FrameOfReference("left", "back", "up", "model")


def recording(model, source: str, frames: int, seed: int, noise_mm: float = 0.2) -> Recording:
    """Coils of one synthetic speaker, the same in every recording; the third is lost for a while."""
    random = np.random.default_rng(seed)
    swing = np.sin(np.linspace(0, 9 + seed, frames))[:, None] * random.uniform(0.3, 1, 4)
    speaker = model.speaker.raw([0.4, -0.3, 0.2, 0.5, -0.1])
    shapes = [model.vertices(speaker, model.pose.raw(x))[list(VERTICES.values())] for x in swing]
    positions = np.array(shapes) + random.normal(scale=noise_mm, size=(frames, 3, 3))
    positions[20:30, 2] = np.nan
    positions[40:44] = np.nan
    return Recording(CHANNELS, positions, np.arange(frames) / 250, 250.0, "test", FRAME, source=source)


@pytest.fixture(scope="module")
def takes(small_model):
    return [(name, recording(small_model, f"{name}.csv", n, n)) for name, n in (("one", 150), ("two", 90))]


@pytest.fixture(scope="module")
def done(small_model, takes):
    return run_experiments(takes, small_model, Session(correspondences=VERTICES))


# Numbers --------------------------------------------------------------------------------------------


def test_a_frames_error_is_the_mean_over_the_coils_that_are_there(done, small_model):
    statistics = statistics_of([done.takes[0].experiment_2], small_model)
    poses = done.takes[0].experiment_2
    expected = []
    for t in range(poses.frame_count):
        shape = small_model.vertices(poses.speaker_weights[t], poses.weights[t])[list(poses.correspondences)]
        distances = np.linalg.norm(shape - poses.coils[t], axis=1)
        if not np.isnan(distances).all():
            expected.append(np.nanmean(distances))
    assert (statistics.frames, statistics.frames_tracked) == (150, 146)
    assert statistics.error_mm.mean == pytest.approx(np.mean(expected))
    assert statistics.share_below_mm == {
        limit: pytest.approx(np.mean(np.array(expected) < limit)) for limit in (1.25, 1.5)
    }


def test_experiment_1_reports_nine_weights_and_experiment_2_the_four_it_solves(done, small_model):
    first, second = all_statistics(done)["one"]
    assert list(first.weights) == [f"speaker_{k}" for k in range(1, 6)] + [f"pose_{k}" for k in range(1, 5)]
    assert list(second.weights) == [f"pose_{k}" for k in range(1, 5)]
    poses = done.takes[0].experiment_1
    third = small_model.speaker.normalised(poses.speaker_weights[poses.tracked])[:, 2]
    assert first.weights["speaker_3"] == spread_of(third)


def test_a_frame_is_within_two_sigma_when_all_its_weights_are(done, small_model):
    (first, _) = all_statistics(done)["one"]
    poses = done.takes[0].experiment_1
    speakers = small_model.speaker.normalised(poses.speaker_weights)
    both = np.abs(np.column_stack([speakers, poses.normalised]))[poses.tracked]
    assert first.share_within_sigma == {k: (both <= k).all(axis=1).mean() for k in (2, 3)}


def test_a_spread_is_the_tables_and_the_violins_numbers():
    spread = spread_of(np.array([4.0, 1.0, 3.0, 2.0, 5.0]))
    assert (spread.mean, spread.minimum, spread.maximum, spread.median) == (3.0, 1.0, 5.0, 3.0)
    assert (spread.lower_quartile, spread.upper_quartile) == (2.0, 4.0)
    assert spread.standard_deviation == pytest.approx(np.sqrt(2.0))


def test_pooled_numbers_count_every_frame_of_every_recording_once(done):
    statistics = all_statistics(done)
    assert list(statistics) == ["one", "two", ALL]
    for number in (0, 1):
        one, two, both = (statistics[name][number] for name in ("one", "two", ALL))
        assert both.frames_tracked == one.frames_tracked + two.frames_tracked
        sums = [part.error_mm.mean * part.frames_tracked for part in (one, two)]
        assert both.error_mm.mean == pytest.approx(sum(sums) / both.frames_tracked)
        assert both.weights["pose_1"].maximum == max(part.weights["pose_1"].maximum for part in (one, two))


def test_a_coil_that_is_missing_in_one_recording_counts_where_it_is_there(small_model, takes):
    lost = recording(small_model, "lost.csv", 60, 5)
    lost.positions[:, 2] = np.nan
    done = run_experiments([*takes, ("lost", lost)], small_model, Session(correspondences=VERTICES))
    statistics = all_statistics(done)
    assert "tongue_dorsum" not in statistics["lost"][0].coils_mm
    assert "tongue_dorsum" in statistics[ALL][0].coils_mm
    json.loads(json_text(done, statistics))
    assert "| tongue_dorsum |" in report_page(done, statistics, [])


# One speaker ----------------------------------------------------------------------------------------


def test_the_papers_anatomy_is_the_mean_of_experiment_1_over_all_tracked_frames(done, small_model, takes):
    alone = [
        track_recording(take, small_model, Session(correspondences=VERTICES), (1,)).experiment_1
        for _, take in takes
    ]
    speakers = np.concatenate([poses.speaker_weights[poses.tracked] for poses in alone])
    np.testing.assert_allclose(done.anatomy.weights, speakers.mean(axis=0), atol=1e-12)
    for take in done.takes:
        np.testing.assert_array_equal(take.experiment_2.speaker_weights[5], done.anatomy.weights)
    assert done.anatomy.source == "mean of experiment 1 over 232 frames of 2 recordings"


def test_the_joint_anatomy_is_the_estimators_over_all_frames(small_model, takes):
    session = Session(correspondences=VERTICES)
    done = run_experiments(takes, small_model, session, "joint")
    coils = np.concatenate([take.positions for _, take in takes])
    coils = coils[~np.isnan(coils[:, :, 0]).all(axis=1)]
    expected = estimate_speaker(small_model.at(list(VERTICES.values())), session.energy, coils)
    np.testing.assert_allclose(done.anatomy.weights, expected.weights, atol=1e-9)
    assert done.anatomy.source.startswith("joint estimate over 232 frames")
    assert "joint estimate" in report_page(done, all_statistics(done), []) and "+-" in report_page(
        done, all_statistics(done), []
    )


def test_the_sessions_anatomy_is_kept_unless_another_is_asked_for(small_model, takes, done):
    stated = small_model.speaker.raw([0.1, 0.2, 0.3, 0.4, 0.5])
    session = Session(correspondences=VERTICES, speaker_weights=stated, speaker_source="an MRI scan")
    kept = run_experiments(takes, small_model, session)
    np.testing.assert_array_equal(kept.anatomy.weights, stated)
    assert kept.anatomy.source == "session: an MRI scan"
    asked = run_experiments(takes, small_model, session, "mean")
    np.testing.assert_allclose(asked.anatomy.weights, done.anatomy.weights, atol=1e-12)


def test_vertices_found_on_the_first_recording_hold_for_all(small_model, takes):
    done = run_experiments(takes, small_model, Session())
    (vertices,) = {take.experiment_2.correspondences for take in done.takes}
    assert dict(zip(VERTICES, vertices, strict=True)) == done.session.correspondences
    alone = run_experiments(takes[:1], small_model, Session())
    assert alone.session.correspondences == done.session.correspondences


def test_a_recording_without_the_first_ones_coils_is_refused_by_name(small_model, takes):
    from dataclasses import replace

    foreign = replace(takes[1][1], coils=("TT", "TB", "TX"), source="foreign.csv")
    with pytest.raises(InputError, match="names the channel 'TD', which foreign.csv does not have"):
        run_experiments([takes[0], ("foreign", foreign)], small_model, Session())


# Words and pictures ---------------------------------------------------------------------------------


def test_the_csv_and_the_json_hold_the_same_numbers(done):
    statistics = all_statistics(done)
    content = json.loads(json_text(done, statistics))
    rows = {tuple(row[:4]): float(row[4]) for row in list(csv.reader(as_csv(statistics).splitlines()))[1:]}
    assert len(rows) == len(as_csv(statistics).splitlines()) - 1
    for place in [*content["recordings"], {"name": ALL, **content["pooled"]}]:
        for number in ("1", "2"):
            figures, key = place[f"experiment_{number}"], (place["name"], number)
            assert rows[*key, "error", "share_below_1.25_mm"] == pytest.approx(
                figures["share_below_mm"]["1.25"]
            )
            for group in ("coils_mm", "weights"):
                for name, spread in figures[group].items():
                    for statistic, value in spread.items():
                        assert rows[*key, name, statistic] == pytest.approx(value, rel=1e-8)


def test_the_text_table_has_one_row_a_recording_and_experiment(done):
    head, *rows = text_table(all_statistics(done)).splitlines()
    assert [row.split()[:2] for row in rows] == [[n, e] for n in ("one", "two", ALL) for e in ("1", "2")]
    assert {len(line) for line in rows} == {len(head)}


def test_the_cumulative_curve_passes_the_share_below_each_threshold(done):
    pytest.importorskip("matplotlib")
    (axes,) = draw_errors(done).axes
    curves = {line.get_label(): line.get_data() for line in axes.lines if line.get_linewidth() == 2.0}
    for number, figures in enumerate(all_statistics(done)[ALL], 1):
        errors, shares = curves[f"experiment {number}"]
        for limit, share in figures.share_below_mm.items():
            assert shares[np.searchsorted(errors, limit) - 1] == pytest.approx(share)


def test_the_violins_mark_mean_and_quartiles_of_each_weight(done):
    pytest.importorskip("matplotlib")
    panels = draw_weights(done).axes
    first, second = all_statistics(done)[ALL]
    for panel, figures, mode in (
        (panels[0], first, "speaker"),
        (panels[1], first, "pose"),
        (panels[3], second, "pose"),
    ):
        spreads = [spread for name, spread in figures.weights.items() if name.startswith(mode)]
        drawn = sorted(
            float(segment[0, 1])
            for lines in panel.collections
            if hasattr(lines, "get_segments")
            for segment in lines.get_segments()
        )
        marks = [(s.mean, s.lower_quartile, s.upper_quartile) for s in spreads]
        np.testing.assert_allclose(drawn, sorted(np.ravel(marks)), atol=1e-12)


def test_even_a_single_frame_has_its_pictures(small_model):
    pytest.importorskip("matplotlib")
    short = recording(small_model, "short.csv", 1, 3)
    done = run_experiments([("short", short)], small_model, Session(correspondences=VERTICES))
    assert [name for name, content in pictures(done) if len(content) > 1000] == list(PICTURE_FILES)


# The command ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(small_model, takes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiment")
    save_model(small_model, folder / "model.npz")
    for name, take in takes:
        write_recording(take, folder / f"{name}.csv")
    return folder


def run(place: Path, out: Path, *more: str) -> int:
    files = [str(place / "one.csv"), str(place / "two.csv")]
    return main(["experiment", *files, "--model", str(place / "model.npz"), "-o", str(out), *more])


def test_the_command_writes_the_whole_folder(place, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert run(place, tmp_path / "report", "--features", "100") == 0
    features = [f"features_{name}.{kind}" for name in ("one", "two") for kind in ("csv", "npz")]
    written = {path.name for path in (tmp_path / "report").iterdir()}
    assert written == {*TABLE_FILES, *PICTURE_FILES, *features}
    page = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    for expected in ("random test model", "(errors.png)", "(weights.png)", "| pose 4 |", *features):
        assert expected in page
    out = capsys.readouterr().out.splitlines()
    assert len(out) == 7


def test_films_show_every_recording_in_both_experiments(place, tmp_path):
    pytest.importorskip("matplotlib")
    av = pytest.importorskip("av")
    require_egl()
    assert run(place, tmp_path, "--films") == 0
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    for name, number in ((name, number) for name in ("one", "two") for number in (1, 2)):
        film = f"film_{name}_experiment_{number}.mp4"
        assert f"({film})" in page
        with av.open(tmp_path / film) as opened:
            frames = [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]
        assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50  # it moves


def test_films_that_cannot_be_made_are_refused_before_the_work(place, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    require_egl()
    monkeypatch.setitem(sys.modules, "av", None)
    assert run(place, tmp_path / "report", "--films") == 2
    assert "the extra 'video'" in capsys.readouterr().err
    assert not (tmp_path / "report").exists()


def test_json_alone_is_on_stdout_when_asked_for(place, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert run(place, tmp_path, "--json", "--anatomy", "joint") == 0
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((tmp_path / "statistics.json").read_text(encoding="utf-8"))
    assert content["anatomy"]["source"].startswith("joint") and len(content["recordings"]) == 2


def test_the_report_says_synthetic_where_the_model_is(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    demo = Path(__file__).resolve().parents[1] / "recordings" / "dropouts.csv"
    assert main(["experiment", str(demo), "-o", str(tmp_path)]) == 0
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    (line,) = [line for line in page.splitlines() if line.startswith("- Model:")]
    assert "synthetic: phantom" in line and "synthetic" in capsys.readouterr().err


REFUSED = {
    "a rate that nobody means": (["--features", "0"], "expected a frame rate of 0.1 to 10000 Hz"),
    "a session that is not there": (["--session", "nowhere.toml"], "there is no such session file"),
    "a recording named twice": (["{place}/one.csv"], "this recording is named twice"),
    "a recording that is not there": (["{place}/three.csv"], "three.csv"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_bad_input_is_one_sentence_and_leaves_no_file(case, place, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    more, sentence = REFUSED[case]
    more = [part.format(place=place) for part in more]
    files = [part for part in more if part.endswith(".csv")]
    flags = [part for part in more if part not in files]
    arguments = [str(place / "one.csv"), *files, "--model", str(place / "model.npz"), "-o", str(tmp_path)]
    assert main(["experiment", *arguments, *flags]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("tonguetrack: ") and sentence in error
    assert not list(tmp_path.iterdir())


def test_without_matplotlib_the_extra_is_named_before_anything_is_done(place, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run(place, tmp_path / "report") == 2
    assert "pip install 'tonguetrack[plot]'" in capsys.readouterr().err
    assert not (tmp_path / "report").exists()


def test_the_report_never_replaces_what_it_reads(place, small_model, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    write_recording(recording(small_model, "", 60, 1), tmp_path / "statistics.csv")
    before = (tmp_path / "statistics.csv").read_bytes()
    arguments = [str(tmp_path / "statistics.csv"), "--model", str(place / "model.npz")]
    assert main(["experiment", *arguments, "-o", str(tmp_path)]) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert (tmp_path / "statistics.csv").read_bytes() == before


def test_names_are_short_and_different(tmp_path):
    assert short_names([tmp_path / "a" / "1.pos", tmp_path / "a" / "2.pos"]) == ["1", "2"]
    assert short_names([tmp_path / "a" / "1.pos", tmp_path / "b" / "1.pos"]) == ["a_1.pos", "b_1.pos"]
    assert short_names([tmp_path / "1.pos", tmp_path / "1.txt"]) == ["1.pos", "1.txt"]


def test_a_recording_cannot_take_the_name_of_all_together(tmp_path):
    assert short_names([tmp_path / "all.pos", tmp_path / "b.pos"]) == ["all.pos", "b.pos"]


def test_an_anatomy_that_nobody_has_is_called_so_though_the_poses_make_up_for_it(
    place, small_model, tmp_path, capsys
):
    pytest.importorskip("matplotlib")
    weights = small_model.speaker.raw([9.0, 0.0, 0.0, 0.0, 0.0]).tolist()
    (tmp_path / "other.toml").write_text(f"[speaker]\nweights = {weights}\n", encoding="utf-8")
    assert run(place, tmp_path / "report", "--session", str(tmp_path / "other.toml")) == 0
    said = capsys.readouterr().err
    assert "lies 9 sigma from the mean, beyond the box of 5" in said and "leave [speaker] out" in said
    assert "it is not in the model's frame" not in said


def test_a_recording_that_is_not_in_the_models_frame_is_called_so(place, small_model, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    astray = recording(small_model, "", 60, 1)
    astray.positions[:, :, 2] += 80.0
    write_recording(astray, tmp_path / "astray.csv")
    arguments = [str(tmp_path / "astray.csv"), "--model", str(place / "model.npz")]
    assert main(["experiment", *arguments, "-o", str(tmp_path / "report")]) == 0
    assert "warning: astray is on average" in capsys.readouterr().err
    page = (tmp_path / "report" / "report.md").read_text(encoding="utf-8")
    assert "it is not in the model's frame" in page
