"""evaluate-tracking: one speaker left out, coils on the true meshes, errors between two brackets."""

import csv
import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.model.build import (
    TrainingShapes,
    load_training_shapes,
    model_from_shapes,
    read_sample_database,
)
from tonguetrack.model.completion import training_without
from tonguetrack.model.mesh import vertex_distances
from tonguetrack.model.multilinear import SurfaceMarks
from tonguetrack.model.synthetic import PHONES, tongue_template
from tonguetrack.model.synthetic.samples import training_shapes, write_samples
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.evaluation import (
    COILS,
    ESTIMATORS,
    LOWER_BRACKET,
    UPPER_BRACKET,
    WHOLE_MESH,
    Fold,
    Plan,
    best_fit,
    evaluate,
    swept_fit,
)
from tonguetrack.tracker.evaluationreport import REPORT_FILES

TEMPLATE = tongue_template()
REGION = {"tip": TEMPLATE.regions["tip"]}
PLACES = tuple(TEMPLATE.midsagittal[index] for index in (6, 20, 34))
SEES_THE_TRUTH = (LOWER_BRACKET, "best fit, 40 sweeps", "speaker from meshes")
TRACKERS = [name for name in ESTIMATORS if name not in (*SEES_THE_TRUTH, UPPER_BRACKET)]
OF_THE_MODEL = [*(name for name in TRACKERS if name != "Gaussian posterior"), "speaker from meshes"]


@pytest.fixture(scope="module")
def shapes():
    """The synthetic training speakers, as if read from their sample database."""
    found = training_shapes()
    return TrainingShapes(
        found.reshape(*found.shape[:2], -1),
        TEMPLATE.faces,
        tuple(f"speaker {number}" for number in range(1, len(found) + 1)),
        tuple(PHONES),
        marks=SurfaceMarks(TEMPLATE.landmarks, TEMPLATE.regions, TEMPLATE.midsagittal),
        provenance={"source": "samples.yaml"},
    )


@pytest.fixture(scope="module")
def evaluation(shapes):
    return evaluate(shapes, Plan(PLACES), REGION)


@pytest.fixture()
def some(shapes):
    """Five speakers, five phones, every fifth vertex: enough for what does not depend on size."""
    tensor = shapes.tensor[:5, :5].reshape(5, 5, -1, 3)[:, :, ::5].reshape(5, 5, -1)
    return replace(
        shapes,
        tensor=tensor.copy(),
        faces=np.zeros((0, 3), np.int32),
        speakers=shapes.speakers[:5],
        prompts=shapes.prompts[:5],
        marks=SurfaceMarks(),
    )


SMALL = Plan((40, 200, 400), speaker_modes=3, pose_modes=3)


def fold_of(shapes, speaker=0, plan=SMALL, noise=0.3):
    training = training_without(shapes, speaker, None)
    truth = shapes.tensor[speaker]
    coils = truth.reshape(len(truth), -1, 3)[:, plan.coils]
    coils = coils + np.random.default_rng(3).normal(scale=noise, size=coils.shape)
    model = model_from_shapes(training, plan.speaker_modes, plan.pose_modes)
    pooled = training.tensor.reshape(-1, truth.shape[1])
    return Fold(model, pooled, plan.coils, coils, noise, truth)


# What the figures mean -------------------------------------------------------------------------------


def test_every_estimator_lies_between_the_mean_shape_and_the_best_fit(evaluation):
    whole = {name: evaluation.mean(name)[0] for name in ESTIMATORS}
    assert all(whole[name] < whole[UPPER_BRACKET] for name in ESTIMATORS if name != UPPER_BRACKET)
    assert all(whole[LOWER_BRACKET] < whole[name] for name in OF_THE_MODEL)


def test_an_estimator_is_near_the_truth_where_the_coils_are_and_farther_elsewhere(evaluation):
    assert evaluation.parts == (WHOLE_MESH, "tip", COILS)
    for name in TRACKERS:
        whole, _, coils = evaluation.mean(name)
        assert coils < whole


def test_the_error_is_the_distance_of_vertices_meant_over_phones_then_speakers(evaluation):
    shapes = np.array([[0.0, 0, 0, 1, 1, 1]])
    np.testing.assert_allclose(
        vertex_distances(shapes, shapes + np.array([[3.0, 4, 0, 0, 0, 2]])), [[5.0, 2.0]]
    )
    errors = evaluation.errors["experiment 2"]
    assert errors.shape == (11, 13, 3)
    np.testing.assert_allclose(evaluation.mean("experiment 2"), errors.mean(axis=1).mean(axis=0))
    np.testing.assert_allclose(evaluation.per_phone("experiment 2"), errors.mean(axis=0))


def test_the_best_fit_finds_a_speaker_whom_the_model_can_express(some):
    fold = fold_of(some)
    random = np.random.default_rng(1)
    speaker = fold.model.speaker.raw(random.normal(size=3))
    poses = fold.model.pose.raw(random.normal(size=(5, 3)))
    truth = np.array([fold.model.vertices(speaker, pose).ravel() for pose in poses])
    assert vertex_distances(best_fit(replace(fold, truth=truth)), truth).max() < 1e-5


def test_forty_sweeps_come_no_nearer_than_the_best_fit(some):
    """In squares, which both minimise; the box is wide enough not to matter here."""
    for speaker in range(5):
        fold = fold_of(some, speaker)
        best, swept = (np.sum((found(fold) - fold.truth) ** 2) for found in (best_fit, swept_fit))
        assert best <= swept * (1 + 1e-6)


# What the estimators may know ------------------------------------------------------------------------


def test_the_left_out_speaker_and_phone_are_not_in_the_training_shapes(some):
    spoiled = replace(some, tensor=some.tensor.copy())
    spoiled.tensor[2] = 1e6
    spoiled.tensor[:, 3] = 1e6
    found = training_without(spoiled, 2, 3)
    assert found.speakers == tuple(name for name in some.speakers if name != some.speakers[2])
    assert found.prompts == tuple(name for name in some.prompts if name != some.prompts[3])
    np.testing.assert_array_equal(found.tensor, some.tensor[np.ix_([0, 1, 3, 4], [0, 1, 2, 4])])


def test_only_what_is_fitted_to_the_true_meshes_looks_at_them(some):
    fold = fold_of(some)
    blind = replace(fold, truth=np.full_like(fold.truth, np.nan))
    for name in (*TRACKERS, UPPER_BRACKET):
        np.testing.assert_array_equal(ESTIMATORS[name](blind), ESTIMATORS[name](fold))


def test_the_order_of_the_phones_does_not_matter(some):
    fold = fold_of(some)
    order = [3, 0, 4, 2, 1]
    turned = replace(fold, coils=fold.coils[order].copy(), truth=fold.truth[order].copy())
    for estimator in ESTIMATORS.values():
        np.testing.assert_allclose(estimator(turned), estimator(fold)[order], atol=1e-4)


def test_leaving_the_phone_out_makes_the_trackers_worse_and_tests_every_phone(shapes):
    few = replace(
        shapes, tensor=shapes.tensor[:6, :6], speakers=shapes.speakers[:6], prompts=shapes.prompts[:6]
    )
    plan = Plan(PLACES, speaker_modes=4, pose_modes=4)
    with_phone = evaluate(few, plan, {})
    without = evaluate(few, replace(plan, leave_phone_out=True), {})
    for name in ESTIMATORS:
        assert np.isfinite(without.errors[name]).all()
        assert without.mean(name)[0] > with_phone.mean(name)[0]


def test_a_filled_cell_is_no_truth_and_knows_nothing_of_the_left_out_speaker(some):
    tensor = some.tensor.copy()
    filled = replace(some, tensor=tensor, filled=((some.speakers[1], some.prompts[2]),))
    tensor[1, 2] = 1e6  # whatever was averaged there
    found = training_without(filled, 0, None)
    own = some.tensor[1, [0, 1, 3, 4]].mean(axis=0)
    others = some.tensor[[2, 3, 4], 2].mean(axis=0)
    np.testing.assert_allclose(found.tensor[0, 2], (own + others) / 2)
    assert found.filled == filled.filled
    evaluation = evaluate(filled, SMALL, {})
    for errors in evaluation.errors.values():
        cells = np.isnan(errors).any(axis=2)
        assert cells[1, 2] and cells.sum() == 1
    assert all(np.isfinite(evaluation.mean(name)).all() for name in ESTIMATORS)


def test_a_phone_that_only_the_left_out_speaker_has_is_named(some):
    filled = tuple((speaker, some.prompts[2]) for speaker in some.speakers[1:])
    with pytest.raises(
        InputError, match=f"without the speaker 'speaker 1' no mesh of the phone '{some.prompts[2]}'"
    ):
        training_without(replace(some, filled=filled), 0, None)


def test_the_noise_comes_from_the_seed_alone(some):
    first, same = (evaluate(some, SMALL, {}) for _ in range(2))
    other = evaluate(some, replace(SMALL, seed=2), {})
    for name in ESTIMATORS:
        np.testing.assert_array_equal(first.errors[name], same.errors[name])
        silent = name in (UPPER_BRACKET, LOWER_BRACKET, "best fit, 40 sweeps")
        assert np.array_equal(first.errors[name], other.errors[name]) == silent


def test_coils_without_noise_are_allowed(some):
    quiet, noisy = (evaluate(some, replace(SMALL, noise_mm=noise), {}) for noise in (0.0, 3.0))
    for name in TRACKERS:
        assert quiet.mean(name)[-1] < noisy.mean(name)[-1]


# The command -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """The synthetic sample database, cut down to three speakers and four phones."""
    folder = tmp_path_factory.mktemp("samples")
    path = write_samples(folder)
    content = json.loads(path.read_text(encoding="utf-8"))
    content["data"] = content["data"][:3]
    for entry in content["data"]:
        entry["phonemes"] = entry["phonemes"][:4]
    content["meta"] = {"speakerAmount": 3, "phonemeAmount": 4}
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


MODES = ["--speaker-modes", "2", "--pose-modes", "3"]
COILS_FLAG = ["--coils", ",".join(map(str, PLACES))]


def run(database, *arguments):
    return main(["evaluate-tracking", str(database), *arguments])


def test_the_command_prints_a_table_and_writes_the_same_numbers(database, tmp_path, capsys):
    report = tmp_path / "new" / "report"
    assert run(database, *COILS_FLAG, *MODES, "--regions", "tip,combined", "-o", str(report)) == 0
    table = capsys.readouterr().out
    assert {path.name for path in report.iterdir()} == set(REPORT_FILES)
    assert table.strip() in (report / "evaluation.txt").read_text(encoding="utf-8")
    content = json.loads((report / "evaluation.json").read_text(encoding="utf-8"))
    assert content["plan"]["coils"] == list(PLACES)
    rows = list(csv.DictReader((report / "evaluation.csv").open(encoding="utf-8")))
    assert len(rows) == len(ESTIMATORS) * 3 * 4 * 4
    for name in ESTIMATORS:
        parts = content["estimators"][name]["mean"]
        assert list(parts) == [WHOLE_MESH, "tip", "combined", COILS]
        line = next(line for line in table.splitlines() if line.startswith(name + "  "))
        for part, mean in parts.items():
            cells = [
                float(row["error_mm"]) for row in rows if (row["estimator"], row["part"]) == (name, part)
            ]
            assert np.mean(cells) == pytest.approx(mean, abs=1e-5)
            assert f"{mean:.2f} +- " in line
    assert (report / "estimators.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (report / "phones.svg").read_bytes()


def test_the_report_never_replaces_the_database(database, tmp_path, capsys):
    samples = tmp_path / "evaluation.json"
    samples.write_bytes(database.read_bytes())
    assert run(samples, *COILS_FLAG, *MODES, "-o", str(tmp_path)) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert samples.read_bytes() == database.read_bytes()


def test_a_report_without_matplotlib_is_refused_before_the_work(database, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert run(database, *COILS_FLAG, *MODES, "-o", str(tmp_path / "report")) == 2
    assert "pip install 'tonguetrack[plot]'" in capsys.readouterr().err
    assert not (tmp_path / "report").exists()
    assert run(database, *COILS_FLAG, *MODES) == 0


@pytest.mark.parametrize("content", ['{"name": "front", "indices": [5, 6, 7, 6]}', "[5, 6, 7]"])
def test_a_region_may_come_from_a_file(database, tmp_path, capsys, content):
    (tmp_path / "front.json").write_text(content, encoding="utf-8")
    arguments = ["--region-file", f"front={tmp_path / 'front.json'}", "--regions", "front"]
    assert run(database, *COILS_FLAG, *MODES, *arguments) == 0
    assert capsys.readouterr().out.split("\n")[0].split() == ["estimator", "whole", "mesh", "front", "coils"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--coils", "1,99999"], "--coils names vertex 99999; the meshes of .* have vertices 0 to"),
        (["--coils", "1,-1"], "--coils names vertex -1"),
        (["--coils", "1,tip"], "--coils 1,tip: expected the numbers of vertices"),
        (["--coils", "1,2,1"], "each vertex once"),
        (["--coils", "1", "--noise", "-0.1"], "--noise -0.1: expected millimetres from 0"),
        (["--coils", "1", "--noise", "nan"], "--noise nan: expected millimetres"),
        (["--coils", "1", "--seed", "-1"], "--seed -1: expected 0 or more"),
        (["--coils", "1", "--regions", "uvula"], "there is no region 'uvula' in .*; known are tip, blade"),
        (["--coils", "1", "--region-file", "front"], "--region-file front: expected NAME=PATH"),
        (["--coils", "1", "--region-file", "front=nowhere.json"], "nowhere.json: there is no such file"),
        (["--coils", "1"], "--speaker-modes 5: expected a number from 1 to 2"),
        (["--coils", "1", "--speaker-modes", "2", "--pose-modes", "4", "--leave-phone-out"], "--pose-modes 4: .* 1 to 3"),
    ],
)  # fmt: skip
def test_bad_input_gets_one_sentence(database, capsys, arguments, sentence):
    assert run(database, *arguments) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    with pytest.raises(InputError, match=sentence):
        raise InputError(said)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('{"vertices": [1]}', "expected JSON with a list of vertices"),
        ("[1.5]", "expected JSON with a list of vertices"),
        ("[true]", "expected JSON with a list of vertices"),
        ("[" * 100_000, "expected JSON with a list of vertices"),
        ("[]", "the region 'front' has no vertices"),
        ("[99999]", "region 'front' names vertex 99999"),
    ],
)
def test_a_region_file_that_is_none_gets_one_sentence(database, tmp_path, capsys, content, sentence):
    (tmp_path / "front.json").write_text(content, encoding="utf-8")
    assert run(database, *COILS_FLAG, *MODES, "--region-file", f"front={tmp_path / 'front.json'}") == 2
    assert sentence in capsys.readouterr().err


def test_one_speaker_alone_cannot_be_left_out(database, tmp_path, capsys):
    content = json.loads(database.read_text(encoding="utf-8"))
    content["data"] = content["data"][:1]
    content["meta"]["speakerAmount"] = 1
    alone = database.with_name("alone.yaml")
    alone.write_text(json.dumps(content), encoding="utf-8")
    assert run(alone, "--coils", "1") == 2
    assert "expected at least two speakers" in capsys.readouterr().err


# The paper's own meshes --------------------------------------------------------------------------------


def test_the_papers_meshes_give_the_known_figures(reference_data):
    """Whole mesh, combined speech region, coils, in mm, of an evaluation made before this program."""
    known = {
        "mean shape": (8.14, 8.80, 8.84),
        "experiment 2": (2.64, 1.90, 1.40),
        "Gaussian posterior": (2.30, 1.20, 0.44),
        "best fit, 40 sweeps": (1.68, 1.69, 1.88),
    }
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    combined = json.loads((reference_data / "mri-shape-framework" / "combined.json").read_text())["indices"]
    evaluation = evaluate(shapes, Plan((2465, 1912, 1250)), {"combined": combined})
    for name, figures in known.items():
        np.testing.assert_allclose(evaluation.mean(name), figures, atol=0.1, err_msg=name)
    # The sweeps stop short of the minimum, which is still lower.
    assert (evaluation.mean(LOWER_BRACKET) < evaluation.mean("best fit, 40 sweeps")).all()
