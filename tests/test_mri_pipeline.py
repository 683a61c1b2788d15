"""From scans to a model: what is found is the truth, what fails is named, and nothing is done twice."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from phantoms import copied, shared_phantom
from scipy.spatial import cKDTree

from tonguetrack import InputError, load_model
from tonguetrack.model.build import read_sample_database
from tonguetrack.model.mesh import read_mesh
from tonguetrack.model.mri.caching import Cache
from tonguetrack.model.mri.cloudfile import read_cloud
from tonguetrack.model.mri.dataset import Problem, load_dataset
from tonguetrack.model.mri.phantom.making import truth_path
from tonguetrack.model.mri.phantom.surfaces import BURIED
from tonguetrack.model.mri.phantom.truth import read_truth
from tonguetrack.model.mri.pipeline import STAGES, build
from tonguetrack.model.mri.results import assembled, load_result, read_index, stored_cloud, write_index
from tonguetrack.model.mri.settings import BuildSettings, settings_toml
from tonguetrack.parallel import cluster, local
from tonguetrack.tracker.cli import main, mribuild

USUAL = BuildSettings()
QUICK = replace(
    USUAL,
    rounds=1,
    denoising=replace(USUAL.denoising, steps=8),
    palate=replace(USUAL.palate, energies=12),
    tongue=replace(USUAL.tongue, energies=12),
    tongue_prior=replace(USUAL.tongue_prior, energies=4),
)
NO_ROUNDS = replace(QUICK, rounds=0)


@pytest.fixture(scope="session")
def phantom(tmp_path_factory) -> Path:
    return shared_phantom(tmp_path_factory)


@pytest.fixture(scope="module")
def work(phantom, tmp_path_factory) -> Path:
    """The work folder of a whole build with one round."""
    work = tmp_path_factory.mktemp("work")
    with local(1) as executor:
        write_index(work, build(load_dataset(phantom), QUICK, work, executor))
    return work


class Counting:
    """An executor that notes which steps are really taken: the name of each, once for every result."""

    def __init__(self) -> None:
        self.taken: list[str] = []

    def run(self, function, items, progress=None):
        (_, step) = function.args
        self.taken += [step.name] * len(items)
        with local(1) as executor:
            yield from executor.run(function, items, progress)


def built(dataset, settings, work, until="tongues"):
    """(index, the steps taken)"""
    counting = Counting()
    return build(dataset, settings, work, counting, until=until), counting.taken


# What is found --------------------------------------------------------------------------------------


def test_the_extracted_tongues_are_the_true_ones(phantom, work):
    """Far looser than what is reached, which the report of a whole set tells; but no wrong tongue would pass."""
    dataset = load_dataset(phantom)
    result = load_result(work)
    assert set(result.scans) == set(dataset.scans) and all(scan.used for scan in result.scans.values())
    for cell, scan in result.scans.items():
        truth = read_truth(truth_path(dataset, *cell))
        seen = truth.tongue.vertices[truth.kind != BURIED]
        assert cKDTree(scan.final).query(seen)[0].mean() < 1.5
        assert scan.flipped == 0


def test_palates_are_brought_to_where_the_head_is_in_each_scan(phantom, work):
    dataset, result = load_dataset(phantom), load_result(work)
    for (speaker, phone), scan in result.scans.items():
        own = dataset.palate_phone[speaker]
        here, there = (read_truth(truth_path(dataset, speaker, name)).head_to_world for name in (phone, own))
        moved = here @ np.linalg.inv(there)
        expected = result.scans[speaker, own].palate @ moved[:3, :3].T + moved[:3, 3]
        assert np.sqrt(np.mean(np.sum((scan.palate - expected) ** 2, axis=1))) < 0.5


def test_in_the_head_frame_the_palates_of_all_scans_of_a_speaker_are_one(work):
    result = load_result(work)
    for speaker in ("Speaker01", "Speaker02"):
        heads = [scan.motion.apply(scan.palate) for scan in result.scans.values() if scan.speaker == speaker]
        np.testing.assert_allclose(heads, np.broadcast_to(heads[0], np.shape(heads)), atol=1e-6)


def test_the_model_is_that_of_the_tongues_in_the_head_frame(work):
    result = load_result(work)
    assert result.model.speaker.names == ("Speaker01", "Speaker02")
    assert result.model.pose.names == ("i", "a", "ɑ")
    # Two speakers and three phones: so many weights are all there are, and the model is exact.
    for row, speaker in enumerate(result.shapes.speakers):
        for column, phone in enumerate(result.shapes.prompts):
            weights = result.model.speaker.training[row], result.model.pose.training[column]
            scan = result.scans[speaker, phone]
            np.testing.assert_allclose(
                result.model.vertices(*weights), scan.motion.apply(scan.final), atol=1e-6
            )


def test_every_scan_tells_of_its_first_matching_and_of_each_round(work):
    for scan in load_result(work).scans.values():
        assert len(scan.residual_mm) == len(scan.valid) == 1 + QUICK.rounds
        assert all(0.0 < residual < 3.0 for residual in scan.residual_mm)
        assert np.abs(scan.final - scan.initial).max() > 0.01


# Nothing twice --------------------------------------------------------------------------------------


def test_a_second_build_takes_no_step_and_finds_the_same(phantom, work):
    index, taken = built(load_dataset(phantom), QUICK, work)
    assert taken == []
    again, before = assembled(work, index), load_result(work)
    np.testing.assert_array_equal(again.shapes.tensor, before.shapes.tensor)
    assert again.model.fingerprint == before.model.fingerprint


def test_another_matching_of_the_tongue_redoes_only_what_depends_on_it(phantom, work, tmp_path):
    changed = replace(QUICK, tongue=replace(QUICK.tongue, energies=QUICK.tongue.energies - 1), rounds=0)
    _, taken = built(load_dataset(phantom), changed, work)
    assert sorted(set(taken)) == ["held out", "matched"] and taken.count("matched") == 6


def test_a_new_landmark_on_one_scan_redoes_only_that_scan(phantom, work):
    dataset = load_dataset(phantom)
    cell = "Speaker02", "i"
    entry = dataset.scans[cell]
    moved = {**entry.tongue_landmarks, "Tip": entry.tongue_landmarks["Tip"] + 0.5}
    changed = replace(dataset, scans={**dataset.scans, cell: replace(entry, tongue_landmarks=moved)})
    _, taken = built(changed, QUICK, work, until="matched")
    assert taken == ["matched"]


def test_a_renamed_scan_is_not_made_again(phantom, work, tmp_path):
    dataset = load_dataset(copied(phantom, tmp_path / "moved"))
    _, taken = built(dataset, QUICK, work)
    assert taken == []


def test_the_steps_can_be_taken_one_after_the_other(phantom, work, tmp_path):
    """Each finds what the last one left, and only adds its own."""
    index, _ = built(load_dataset(phantom), QUICK, work, until="clouds")
    assert index.clouds and not index.tongues and not index.used
    with pytest.raises(InputError, match="no build came to its end"):
        assembled(work, index)
    write_index(tmp_path, index)
    assert read_index(tmp_path).clouds == index.clouds


def test_people_can_be_asked_which_of_its_contours_they_prefer(work, tmp_path, capsys):
    """`mri preference make`: every scan with the contours before and after bootstrapping, near the true middle."""
    from tonguetrack.model.mri.preference import load_test

    arguments = ["-o", str(tmp_path / "test"), "--partitions", "2"]
    assert main(["mri", "preference", "make", str(work), *arguments]) == 0
    assert "6 slices in 2 partitions" in capsys.readouterr().err
    test, result = load_test(tmp_path / "test"), load_result(work)
    assert test.synthetic and [(item.speaker, item.phone) for item in test.items] == list(result.scans)
    for item in test.items:
        scan = result.scans[item.speaker, item.phone]
        tip = scan.final[result.tongue.landmarks["Tip"], 0]
        assert abs(item.at_mm - tip) < 4.0
        for mesh, lines in ((scan.initial, item.initial), (scan.final, item.final)):
            near = mesh[np.abs(mesh[:, 0] - item.at_mm) < 1.5]
            along = np.vstack(lines)
            assert np.ptp(along[:, 1]) == pytest.approx(np.ptp(near[:, 2]), abs=1.5)
            assert np.ptp(along[:, 0]) == pytest.approx(np.ptp(near[:, 1]), abs=1.5)


def test_workers_elsewhere_are_told_whole_paths(phantom, work, monkeypatch):
    monkeypatch.chdir(phantom.parent)
    places = []

    class Looking(Counting):
        def run(self, function, items, progress=None):
            places.append(function.args[0].folder)
            return super().run(function, items, progress)

    build(load_dataset("dataset.toml"), QUICK, os.path.relpath(work), Looking(), until="scans")
    assert [place.is_absolute() for place in places] == [True]


def test_a_cluster_makes_the_same_results_to_the_bit(phantom, work, tmp_path, monkeypatch):
    """The scans of one speaker, on two workers of Dask; the data set named as from its own folder."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(phantom.parent)
    dataset = load_dataset("dataset.toml").without([Problem("Speaker02", None, "not here")])
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=60
        ) as made,
        cluster(made.scheduler_address) as executor,
    ):
        index = build(dataset, NO_ROUNDS, os.path.relpath(tmp_path / "work"), executor, until="scans")
    before = read_index(work)
    for cell, key in index.surfaces.items():
        assert key == before.surfaces[cell]
        assert Cache(tmp_path / "work").path(key).read_bytes() == Cache(work).path(key).read_bytes()


# What fails -----------------------------------------------------------------------------------------


@pytest.fixture
def spoiled(phantom, tmp_path) -> Path:
    return copied(phantom, tmp_path / "set")


def left_out(path, work):
    index, _ = built(load_dataset(path), NO_ROUNDS, work)
    return index, {(problem.speaker, problem.phone): problem.sentence for problem in index.dataset.problems}


def test_a_corrupt_volume_is_left_out_and_named(spoiled, work):
    scan = spoiled.parent / "scans" / "Speaker02_i.nii.gz"
    scan.write_bytes(scan.read_bytes()[:20_000])
    index, problems = left_out(spoiled, work)
    assert list(problems) == [("Speaker02", "i")]
    assert "Speaker02 [i]" in problems["Speaker02", "i"] and scan.name in problems["Speaker02", "i"]
    assert set(index.used) == set(load_dataset(spoiled).scans) - {("Speaker02", "i")}
    assert assembled(work, index).shapes.filled == (("Speaker02", "i"),)


def test_a_volume_that_shows_nothing_is_left_out(spoiled, work):
    import nibabel

    path = spoiled.parent / "scans" / "Speaker01_i.nii.gz"
    whole = nibabel.load(path)
    nibabel.Nifti1Image(np.full(whole.shape, 100, dtype=np.float32), whole.affine).to_filename(path)
    _, problems = left_out(spoiled, work)
    assert list(problems) == [("Speaker01", "i")] and "nothing to see" in problems["Speaker01", "i"]


def test_a_scan_without_a_landmark_is_left_out_and_the_landmark_named(spoiled, work):
    marks = spoiled.parent / "landmarks" / "Speaker01_i.csv"
    lines = marks.read_text().splitlines(keepends=True)
    marks.write_text("".join(line for line in lines if not line.startswith("Airway")))
    _, problems = left_out(spoiled, work)
    assert list(problems) == [("Speaker01", "i")] and "Airway" in problems["Speaker01", "i"]


def test_exchanged_landmarks_are_noticed(spoiled, work):
    marks = spoiled.parent / "landmarks" / "Speaker01_i.csv"
    text = marks.read_text().replace("LeftLateral", "?").replace("RightLateral", "LeftLateral")
    marks.write_text(text.replace("?", "RightLateral"))
    _, problems = left_out(spoiled, work)
    assert list(problems) == [("Speaker01", "i")]
    assert "exchanged" in problems["Speaker01", "i"] and "RightLateral" in problems["Speaker01", "i"]


def test_without_the_palate_scan_a_speaker_is_left_out_and_the_others_are_not(spoiled, work):
    dataset = load_dataset(spoiled)
    dataset.scans["Speaker01", dataset.palate_phone["Speaker01"]].path.unlink()
    index, problems = left_out(spoiled, work)
    assert set(problems) == {("Speaker01", dataset.palate_phone["Speaker01"]), ("Speaker01", None)}
    assert index.dataset.speakers == ("Speaker02",)
    assert assembled(work, index).model.speaker.names == ("Speaker02",)


def test_a_mesh_with_faces_turned_over_is_no_part_of_the_model_and_shown_first(phantom, work, tmp_path):
    index, _ = built(load_dataset(phantom), NO_ROUNDS, work)
    cell = "Speaker02", "i"
    cache, key = Cache(work), index.tongues[cell][-1]
    whole = cache.load(key)
    cache.store(key, {**whole, "flipped": np.array(500)})  # as if the matching had found so
    try:
        index, _ = built(load_dataset(phantom), NO_ROUNDS, work)
        result = assembled(work, index)
    finally:
        cache.store(key, whole)
    (problem,) = index.dataset.problems
    assert (problem.speaker, problem.phone) == cell and "Speaker02 [i]" in problem.sentence
    assert not result.scans[cell].used and result.shapes.filled == (cell,)
    assert (result.suspicious_first()[0].speaker, result.suspicious_first()[0].phone) == cell


def test_a_phone_that_nobody_is_left_to_hold_is_not_in_the_model(spoiled, work):
    for speaker in ("Speaker01", "Speaker02"):
        (spoiled.parent / "landmarks" / f"{speaker}_i.csv").write_text("name,x_mm,y_mm,z_mm\n")
    index, problems = left_out(spoiled, work)
    assert set(problems) == {("Speaker01", "i"), ("Speaker02", "i"), ("", "i")}
    assert assembled(work, index).model.pose.names == ("a", "ɑ")


def test_a_data_set_of_which_nothing_is_left_is_an_error_that_says_why(spoiled, work):
    for marks in (spoiled.parent / "landmarks").glob("*.csv"):
        marks.write_text("name,x_mm,y_mm,z_mm\n")
    with pytest.raises(InputError, match="no scan is left.*landmark"):
        built(load_dataset(spoiled), NO_ROUNDS, work)


# The index ------------------------------------------------------------------------------------------


def test_the_index_is_read_back_as_it_was(phantom, work, tmp_path):
    index = read_index(work)
    write_index(tmp_path, index)
    again = read_index(tmp_path)
    assert (tmp_path / "results.json").read_bytes() == (work / "results.json").read_bytes()
    assert again.tongues == index.tongues and again.settings == QUICK


@pytest.mark.parametrize(
    "spoil",
    [
        lambda table: "not JSON",
        lambda table: "[]",
        lambda table: json.dumps({**table, "format": "another"}),
        lambda table: json.dumps({**table, "scans": [{**table["scans"][0], "cloud": "../../etc/passwd"}]}),
        lambda table: json.dumps({**table, "settings": {"rounds": -1}}),
        lambda table: json.dumps({**table, "speakers": [1]}),
        lambda table: json.dumps({name: part for name, part in table.items() if name != "palates"}),
    ],
)
def test_an_index_that_is_none_is_refused_in_a_sentence(work, tmp_path, spoil):
    table = json.loads((work / "results.json").read_bytes())
    (tmp_path / "results.json").write_text(spoil(table))
    with pytest.raises(InputError, match=r"results\.json"):
        load_result(tmp_path)


def test_an_index_whose_results_are_gone_is_refused(work, tmp_path):
    (tmp_path / "results.json").write_bytes((work / "results.json").read_bytes())
    with pytest.raises(InputError, match="absent or damaged"):
        load_result(tmp_path)


# The command ----------------------------------------------------------------------------------------


@pytest.fixture
def listed(phantom, tmp_path) -> Path:
    """The data set's file elsewhere."""
    text = phantom.read_text(encoding="utf-8")
    for folder in ("scans", "landmarks"):
        text = text.replace(f'"{folder}/', f'"{(phantom.parent / folder).as_posix()}/')
    path = tmp_path / "listed.toml"
    path.write_text(
        text.replace("[[speakers]]", "[settings]\nrounds = 1\n\n[[speakers]]", 1), encoding="utf-8"
    )
    return path


@pytest.fixture
def options(work, tmp_path) -> list[str]:
    """The work folder and the settings of the tests, for the command."""
    path = tmp_path / "quick.toml"
    path.write_text(settings_toml(QUICK), encoding="utf-8")
    return ["--work", str(work), "--settings", str(path), "--jobs", "1"]


def test_the_command_writes_a_model_and_what_it_consists_of(listed, work, options, tmp_path, capsys):
    exported = tmp_path / "out"
    command = ["mri", "build", str(listed), "-o", str(tmp_path / "m.npz"), *options]
    assert main([*command, "--speaker-modes", "1", "--export", str(exported)]) == 0
    assert "2 speakers x 3 phones" in capsys.readouterr().err
    model = load_model(tmp_path / "m.npz")
    assert model.name == "m" and (model.speaker.size, model.pose.size) == (1, 3)
    assert "synthetic" in model.provenance["data"] and str(tmp_path) not in str(model.provenance)
    result = load_result(work)
    scan = result.scans["Speaker01", "ɑ"]
    mesh = read_mesh(exported / "Speaker01_back-a.tongue.ply")
    np.testing.assert_allclose(mesh.vertices, scan.final, atol=1e-4)
    np.testing.assert_allclose(
        read_cloud(exported / "Speaker01_back-a.points.ply").points,
        stored_cloud(work, scan).points,
        atol=1e-4,
    )
    samples = read_sample_database(exported / "samples.yaml")
    assert samples.speakers == ("Speaker01", "Speaker02") and samples.prompts == ("i", "a", "ɑ")
    head = read_mesh(samples.paths["Speaker01"]["ɑ"])
    np.testing.assert_allclose(head.vertices, scan.motion.apply(scan.final), atol=1e-4)


def test_the_commands_stages_are_the_pipelines():
    assert list(mribuild.STAGES) == list(STAGES)


def test_the_command_reports_and_compares_a_phantom_with_its_truth(phantom, options, tmp_path, capsys):
    report = tmp_path / "report"
    command = ["mri", "build", str(phantom), "-o", str(tmp_path / "m.npz"), *options]
    assert main([*command, "--report", str(report)]) == 0
    said = capsys.readouterr()
    assert "true tongue to extracted" in said.out and str(report / "index.html") in said.err
    numbers = json.loads((report / "report.json").read_bytes())
    assert "Speaker01" in json.dumps(numbers)


def test_ablations_need_a_truth(listed, options, tmp_path, capsys):
    assert main(["mri", "build", str(listed), "-o", str(tmp_path / "m.npz"), *options, "--ablations"]) == 2
    assert "truth" in capsys.readouterr().err


def test_the_exit_code_says_that_something_was_left_out(spoiled, options, tmp_path, capsys):
    (spoiled.parent / "scans" / "Speaker02_i.nii.gz").write_bytes(b"nothing")
    Path(options[options.index("--settings") + 1]).write_text(settings_toml(NO_ROUNDS), encoding="utf-8")
    assert main(["mri", "build", str(spoiled), "-o", str(tmp_path / "m.npz"), *options]) == 3
    said = capsys.readouterr().err
    assert "left out: Speaker02 [i]" in said and "Speaker02_i.nii.gz" in said
    assert load_model(tmp_path / "m.npz").provenance["filled"] == "Speaker02 i"


def test_stopping_after_a_stage_leaves_what_it_made(listed, options, tmp_path):
    exported = tmp_path / "out"
    assert main(["mri", "build", str(listed), *options, "--until", "clouds", "--export", str(exported)]) == 0
    kinds = {path.name.split(".", 1)[1] for path in exported.iterdir()}
    assert kinds == {"points.ply", "palate.ply"}


@pytest.mark.parametrize(
    "flags, said",
    [
        ([], "name the model"),
        (["-o", "model.txt"], "model.txt"),
        (["-o", "m.npz", "--until", "clouds"], "before there is a model"),
        (["-o", "m.npz", "--settings", "absent.toml"], "absent.toml"),
        (["-o", "m.npz", "--speaker-modes", "0"], "speaker_modes"),
        (["-o", "m.npz", "--jobs", "0"], "0 jobs"),
    ],
)
def test_flags_that_make_no_sense_are_refused_before_anything_is_done(
    phantom, tmp_path, monkeypatch, capsys, flags, said
):
    monkeypatch.chdir(tmp_path)
    assert main(["mri", "build", str(phantom), *flags]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "m.npz").exists()


def test_the_docs_program_runs_with_what_a_build_has_left(work, tmp_path):
    page = Path(__file__).resolve().parents[1] / "docs" / "mri-build.md"
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "heads.work").symlink_to(work)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Speaker02" in done.stdout


def test_a_build_that_was_killed_goes_on_where_it_was(listed, options, tmp_path):
    """kill -9 in the middle of the scans: what was made by then is whole, and is not made again."""
    work = tmp_path / "work"
    program = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "mri", "build", str(listed), "--until", "scans", *options]
    command[command.index("--work") + 1] = str(work)
    with subprocess.Popen(command) as child:
        end = time.monotonic() + 120.0
        while len(list(work.glob("cache/*/*.npz"))) < 2:
            assert child.poll() is None and time.monotonic() < end
            time.sleep(0.02)
        child.send_signal(signal.SIGKILL)
    kept = set(work.glob("cache/*/*.npz"))
    assert 2 <= len(kept) < 6
    _, taken = built(load_dataset(listed), QUICK, work, until="scans")
    assert taken == ["surface"] * (6 - len(kept))
