"""model evaluate: what the three measures are, on shapes whose answer is known, and on the paper's meshes."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.model import synthetic
from tonguetrack.model.build import (
    TrainingShapes,
    load_training_shapes,
    model_from_shapes,
    read_sample_database,
)
from tonguetrack.model.completion import training_without
from tonguetrack.model.evaluation import (
    CRITICAL,
    MEASURES,
    WHOLE_MESH,
    Settings,
    compactness,
    evaluate,
    with_unions,
)
from tonguetrack.model.evaluationreport import REPORT_FILES
from tonguetrack.model.generalisation import _energy, generalisation
from tonguetrack.model.mesh import vertex_distances
from tonguetrack.model.multilinear import Mode
from tonguetrack.model.specificity import BATCH, PART, _draw, phone_specificity, specificity
from tonguetrack.model.synthetic.samples import training_shapes, write_samples
from tonguetrack.tracker.cli import main

COMPACTNESS = {
    "speaker": [.5424, .7734, .8361, .8863, .9177, .9416, .9609, .9751, .9853, .9931, 1],
    "pose": [.4931, .7903, .8771, .9185, .9420, .9591, .9715, .9808, .9875, .9923, .9960, .9983, 1],
}  # fmt: skip
GENERALISATION = {
    "speaker": [2.16, 2.07, 1.85, 1.50, 1.41, 1.33, 1.25, 1.18, 1.05, 1.01],
    "pose": [2.02, 1.45, 1.28, 1.14, 1.03, .965, .916, .870, .842, .816, .786, .759],
}  # fmt: skip
SPECIFICITY = {
    "speaker": [2.51, 2.61, 2.70, 2.78, 2.84, 2.97, 2.88, 2.94, 2.96, 2.95, 3.07],
    "pose": [2.28, 2.65, 2.76, 2.80, 2.92, 2.99, 2.96, 3.02, 2.94, 3.02, 2.97, 2.99, 3.05],
}  # fmt: skip
THEIR_SAMPLES = 1000
PHONES = tuple(synthetic.PHONES)
HELD = {"speaker": 4, "pose": 5}
REGION = tuple(range(0, 120, 2))


@pytest.fixture(scope="module")
def shapes():
    """Five synthetic speakers with six phones, 198 vertices of each."""
    tensor = training_shapes()[:5, :6, ::17][:, :, :198]
    return TrainingShapes(
        tensor.reshape(5, 6, -1),
        np.zeros((0, 3), np.int32),
        tuple(f"speaker {number}" for number in range(1, 6)),
        tuple(PHONES[:6]),
        provenance={"source": "a test", "data": "synthetic"},
    )


@pytest.fixture(scope="module")
def papers_shapes(reference_data):
    return load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )


def region_file(reference_data, name):
    return json.loads((reference_data / "mri-shape-framework" / f"{name}.json").read_text())["indices"]


# The paper's meshes ------------------------------------------------------------------------------------


def test_the_papers_meshes_give_the_reference_compactness(papers_shapes):
    for mode, shares in compactness(papers_shapes).items():
        np.testing.assert_allclose(shares, COMPACTNESS[mode], atol=5e-5)


@pytest.mark.parametrize("mode", ["speaker", "pose"])
def test_the_papers_meshes_give_the_reference_generalisation_within_three_percent(papers_shapes, mode):
    found = generalisation(papers_shapes, mode, HELD[mode], jobs=1)
    np.testing.assert_allclose(found.mean_mm, GENERALISATION[mode], rtol=0.03)
    assert (found.counts == 143).all()
    assert (found.deviation_mm > 0.2).all() and (found.deviation_mm < 0.65).all()


@pytest.mark.parametrize("mode", ["speaker", "pose"])
def test_the_papers_meshes_give_the_reference_specificity_within_sampling_error(
    papers_shapes, reference_data, mode
):
    region = region_file(reference_data, "combined")
    found = specificity(papers_shapes, mode, HELD[mode], region, samples=5000, jobs=1)
    chance = np.hypot(found.standard_error_mm, found.deviation_mm / np.sqrt(THEIR_SAMPLES))
    off = (found.mean_mm - SPECIFICITY[mode]) / np.hypot(chance, 0.005 / np.sqrt(3))  # two digits
    assert np.abs(off).max() < 4.0 and np.sqrt(np.mean(off**2)) < 1.6


def test_of_the_papers_phones_the_one_that_it_names_is_among_the_least_specific(
    papers_shapes, reference_data
):
    """Its "significantly bad result" is that of [ʉ]."""
    regions = {
        name: region_file(reference_data, name) for name in ("combined", "bladetip", "bladebackdorsum")
    }
    settings = Settings(frozenset({"phones"}), samples=3000, jobs=1)
    found = evaluate(papers_shapes, settings, regions)
    last = {prompt: curve.mean_mm[-1] for prompt, curve in found.phones.items()}
    assert max(last, key=last.__getitem__) == "ʉ"
    assert found.regions["s"] == found.regions["ʃ"] == "bladetip" and found.regions["i"] == "bladebackdorsum"


# Generalisation ----------------------------------------------------------------------------------------


def test_the_slope_of_the_fits_energy_is_its_derivative():
    random = np.random.default_rng(0)
    factor = random.normal(size=(40, 12))
    energy = _energy(factor.T @ factor, random.normal(size=(3, 4)), 50.0)
    for _ in range(20):
        at, step = random.normal(size=7), 1e-5
        numeric = [(energy(at + step * e)[0] - energy(at - step * e)[0]) / (2 * step) for e in np.eye(7)]
        np.testing.assert_allclose(energy(at)[1], numeric, rtol=1e-5, atol=1e-5)


def test_the_fits_energy_is_the_mean_squared_distance_of_all_vertices(shapes):
    model = model_from_shapes(shapes, 3, 4)
    flat = model.core.reshape(12, -1)
    target = shapes.tensor[2, 3] - model.origin
    share = 1.0 / model.vertex_count
    pull = (flat @ target * share).reshape(3, 4)
    energy = _energy(flat @ flat.T * share, pull, float(target @ target) * share)
    for seed in range(5):
        weights = np.random.default_rng(seed).normal(size=7)
        shape = model.vertices(weights[:3], weights[3:])
        apart = shape - shapes.tensor[2, 3].reshape(-1, 3)
        assert energy(weights)[0] == pytest.approx(np.mean(np.sum(apart**2, axis=1)))


def test_a_speaker_who_differs_as_the_others_do_is_met_when_enough_components_are_kept(shapes):
    """All speakers differ by one direction, the same in all phones: two components tell all, one does not."""
    random = np.random.default_rng(1)
    phones, direction = random.normal(scale=10, size=(1, 6, 60)), random.normal(scale=10, size=60)
    amounts = np.array([-1.0, -0.5, 0.4, 0.6, 1.1])[:, None, None]
    found = generalisation(replace(shapes, tensor=phones + amounts * direction), "speaker", held=6, jobs=1)
    assert found.mean_mm[0] > 5.0
    assert (found.mean_mm[1:] < 1e-3).all()


def test_more_components_come_nearer_and_a_narrow_box_keeps_away(shapes):
    wide, narrow = (generalisation(shapes, "pose", held=3, h=h, jobs=1) for h in (2.0, 0.2))
    assert wide.mean_mm[-1] < 0.8 * wide.mean_mm[0]
    assert (narrow.mean_mm[1:] > wide.mean_mm[1:]).all()
    assert len(wide.mean_mm) == 5 and (wide.counts == 30).all()


def test_no_fit_is_nearer_than_the_best_that_the_model_could_do_without_a_box(shapes):
    """Least squares over all products of weights is a bound from below, in squares; so is it in the mean distance, nearly."""
    found = generalisation(shapes, "speaker", held=3, jobs=1)
    errors = []
    for speaker in range(5):
        model = model_from_shapes(training_without(shapes, speaker, None), 4, 3)
        basis = np.linalg.qr(model.core.reshape(12, -1).T)[0]
        left = shapes.tensor[speaker] - model.origin
        errors.append(vertex_distances(left @ basis @ basis.T, left).mean(axis=1))
    assert found.mean_mm[-1] > 0.98 * np.mean(errors)


def test_a_filled_cell_is_no_truth_and_not_measured(shapes):
    filled = replace(shapes, tensor=shapes.tensor.copy(), filled=(("speaker 2", PHONES[3]),))
    filled.tensor[1, 3] = 1e6  # whatever was averaged there
    for mode in ("speaker", "pose"):
        found = generalisation(filled, mode, held=2, jobs=1)
        assert (found.counts == 29).all() and found.mean_mm.max() < 100.0


def test_what_is_left_out_is_not_known(shapes):
    """A speaker who is far off is far from every model of the others."""
    odd = replace(shapes, tensor=shapes.tensor.copy())
    odd.tensor[4] += 500.0
    apart = (
        generalisation(odd, "speaker", held=2, jobs=1).mean_mm
        - generalisation(shapes, "speaker", held=2, jobs=1).mean_mm
    )
    assert (apart > 50.0).all()


# Specificity -------------------------------------------------------------------------------------------


def by_hand(shapes, m, n, region, seed, count, phone=None):
    """The mean error of the first part of a row, from whole meshes in float64."""
    model = model_from_shapes(shapes, m, n)
    random = np.random.default_rng(seed)
    errors = []
    for start in range(0, count, BATCH):
        size = min(BATCH, count - start)
        weights = []
        for mode, fixed in ((model.speaker, False), (model.pose, phone is not None)):
            if fixed:
                random.standard_normal((size, 1))
                weights.append(np.tile(mode.training[phone], (size, 1)))
                continue
            values, vectors = np.linalg.eigh(np.atleast_2d(np.cov(mode.training, rowvar=False, bias=True)))
            z = random.standard_normal((size, mode.size))
            weights.append(mode.mean + z @ (vectors * np.sqrt(np.maximum(values, 0.0))).T)
        real = shapes.tensor[:, :] if phone is None else shapes.tensor[:, phone : phone + 1]
        real = real.reshape(-1, model.vertex_count, 3)[:, list(region)]
        for s, p in zip(*weights, strict=True):
            apart = np.linalg.norm(model.vertices(s, p)[list(region)] - real, axis=2)
            errors.append(apart.mean(axis=1).min())
    return np.mean(errors), np.std(errors)


def test_the_error_is_that_of_the_whole_shape_against_every_mesh(shapes):
    found = specificity(shapes, "speaker", 3, REGION, samples=300, seed=5, jobs=1)
    for m in (1, 4, 5):
        mean, deviation = by_hand(shapes, m, 3, REGION, [5, 0, m, 3, 0], 300)
        assert found.mean_mm[m - 1] == pytest.approx(mean, abs=2e-5)
        assert found.deviation_mm[m - 1] == pytest.approx(deviation, abs=1e-4)


def test_a_fixed_phone_has_its_own_pose_and_is_compared_with_its_own_meshes(shapes):
    found = phone_specificity(shapes, PHONES[2], 4, REGION, samples=200, seed=3, jobs=1)
    mean, _ = by_hand(shapes, 4, 4, REGION, [3, 4, 4, 4, 0], 200, phone=2)
    assert found.mean_mm[3] == pytest.approx(mean, abs=2e-5)
    assert len(found.mean_mm) == 5


def test_weights_are_drawn_as_the_training_weights_are_spread():
    training = np.random.default_rng(2).normal(size=(13, 4)) @ np.diag([1.0, 0.5, 0.1, 0.0]) + 3.0
    mode = Mode(training.mean(axis=0), 13, training)
    drawn = _draw(mode, 3).sample(np.random.default_rng(0), 200_000)
    np.testing.assert_allclose(drawn.mean(axis=0), training[:, :3].mean(axis=0), atol=0.01)
    np.testing.assert_allclose(
        np.cov(drawn, rowvar=False), np.cov(training[:, :3], rowvar=False, bias=True), atol=0.01
    )


def test_neither_the_processes_nor_their_number_change_the_result(shapes):
    one, two = (specificity(shapes, "pose", 2, REGION, samples=700, jobs=jobs) for jobs in (1, 2))
    np.testing.assert_array_equal(one.mean_mm, two.mean_mm)
    np.testing.assert_array_equal(one.deviation_mm, two.deviation_mm)


def test_other_samples_give_almost_the_same(shapes):
    one, other = (specificity(shapes, "pose", 2, REGION, samples=4000, seed=seed, jobs=1) for seed in (1, 2))
    off = (one.mean_mm - other.mean_mm) / np.hypot(one.standard_error_mm, other.standard_error_mm)
    assert (one.mean_mm != other.mean_mm).all() and np.abs(off).max() < 5.0


def test_samples_beyond_one_part_are_new_ones(shapes, monkeypatch):
    monkeypatch.setattr("tonguetrack.model.specificity.PART", 100)
    short, long = (specificity(shapes, "pose", 2, REGION, samples=n, jobs=1) for n in (100, 250))
    assert (short.mean_mm != long.mean_mm).all() and (long.counts == 250).all()
    assert PART % BATCH < BATCH


# The whole ---------------------------------------------------------------------------------------------


def test_unions_are_made_of_their_parts_unless_they_are_given():
    parts = {"tip": [1], "blade": [2, 3], "back": [4], "dorsum": [4, 5], "lateral": [0]}
    known = with_unions(parts)
    assert known["combined"] == [0, 1, 2, 3, 4, 5] and known["bladetip"] == [1, 2, 3]
    assert with_unions({**parts, "bladetip": [9]})["bladetip"] == [9]
    assert with_unions({"tip": [1], "back": [4]}) == {"tip": [1], "back": [4]}


def test_every_phone_of_the_paper_has_its_critical_region():
    assert set(CRITICAL) == set(PHONES)


def test_without_regions_everything_is_measured_on_the_whole_mesh(shapes):
    found = evaluate(shapes, Settings(frozenset({"phones"}), 3, 3, samples=20, jobs=1), {})
    assert set(found.regions.values()) == {WHOLE_MESH} == {found.region}
    assert not found.compactness and not found.generalisation and not found.specificity


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"region": "uvula"}, "there is no region 'uvula' in a test; known are tip, whole mesh"),
        ({"speaker_modes": 6}, "--speaker-modes 6: expected a number from 1 to 5"),
        ({"pose_modes": 0}, "--pose-modes 0: expected a number from 1 to 6"),
        ({"samples": 0}, "--samples 0: expected 1 or more"),
        ({"seed": -1}, "--seed -1: expected 0 or more"),
        ({"jobs": 0}, "0 processes cannot do anything"),
        ({"h": -1.0}, "the box of -1 sigma leaves no shape to fit"),
        ({"region": "tip"}, "the region names vertex 999; the meshes of a test have vertices 0 to 197"),
    ],
)
def test_settings_that_contradict_the_shapes_get_one_sentence(shapes, change, sentence):
    settings = replace(Settings(frozenset(MEASURES), 3, 3, samples=10, jobs=1), **change)
    with pytest.raises(InputError, match=sentence) as caught:
        evaluate(shapes, settings, {"tip": [5, 999] if change == {"region": "tip"} else [5]})
    assert "\n" not in str(caught.value)


def test_one_speaker_alone_cannot_be_left_out(shapes):
    alone = replace(shapes, tensor=shapes.tensor[:1], speakers=shapes.speakers[:1])
    with pytest.raises(InputError, match="leaves one speaker out, and there is no other"):
        evaluate(alone, Settings(frozenset({"generalisation"}), 1, 3, jobs=1), {})


# The command -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """The synthetic sample database with four speakers and five phones, one cell of them missing."""
    import yaml

    folder = tmp_path_factory.mktemp("samples")
    content = yaml.safe_load(write_samples(folder).read_text(encoding="utf-8"))
    content["meta"] = {"speakerAmount": 4, "phonemeAmount": 5}
    content["data"] = content["data"][:4]
    for speaker in content["data"]:
        speaker["phonemes"] = speaker["phonemes"][:5]
    content["data"][1]["phonemes"][2]["path"] = None
    (folder / "small.yaml").write_text(json.dumps(content), encoding="utf-8")
    return folder / "small.yaml"


MODES = ["--speaker-modes", "3", "--pose-modes", "3", "--jobs", "1"]


def run(*arguments):
    return main(["model", "evaluate", *map(str, arguments)])


def test_the_command_writes_numbers_and_pictures_that_agree(database, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert run(database, *MODES, "--samples", "300", "-o", tmp_path / "report") == 0
    shown, told = capsys.readouterr()
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == sorted(REPORT_FILES)
    for name in REPORT_FILES:
        content = (tmp_path / "report" / name).read_bytes()
        assert not name.endswith("png") or content.startswith(b"\x89PNG")
        assert not name.endswith("svg") or b"<svg" in content
    report = json.loads((tmp_path / "report" / "evaluation.json").read_text(encoding="utf-8"))
    rows = list(
        csv.DictReader((tmp_path / "report" / "evaluation.csv").read_text(encoding="utf-8").splitlines())
    )
    assert report["filled_cells"] == [[report["speakers"][1], report["prompts"][2]]]
    assert report["specificity"]["region"] == "combined"
    assert (
        len(report["compactness"]["pose"]) == 5 and len(report["generalisation"]["speaker"]["mean_mm"]) == 3
    )
    assert report["generalisation"]["pose"]["count"] == [19] * 4
    for row in rows:
        measure, of, component = row["measure"], row["of"], int(row["components"]) - 1
        if measure == "compactness":
            assert float(row["value"]) == pytest.approx(report[measure][of][component], abs=1e-6)
        else:
            assert float(row["value"]) == report[measure][of]["mean_mm"][component]
            assert float(row["deviation"]) == report[measure][of]["deviation_mm"][component]
    assert len(rows) == (5 + 4) + (4 + 3) + (5 + 4) + 5 * 4
    assert shown.strip() in (tmp_path / "report" / "evaluation.txt").read_text(encoding="utf-8")
    assert "1 cells were filled by averaging" in told and "combined: mm" in shown


def test_the_command_measures_what_it_is_asked_for(database, tmp_path, capsys):
    region = tmp_path / "front.json"
    region.write_text("[10, 11, 12]")
    flags = ["--specificity", "--samples", "50", "--region", "front", "--region-file", f"front={region}"]
    assert run(database, *MODES, *flags) == 0
    shown = capsys.readouterr().out
    assert "front" in shown and "compactness" not in shown and "generalisation" not in shown
    assert run(database, *MODES, "--compactness") == 0
    assert capsys.readouterr().out.count("share of the variance") == 2


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--region", "uvula"], "there is no region 'uvula' in small.yaml; known are tip, blade"),
        (["--speaker-modes", "9"], "--speaker-modes 9: expected a number from 1 to 4"),
        (["--region-file", "x=nowhere.json"], "nowhere.json: there is no such file"),
    ],
)
def test_a_mistake_gets_one_sentence_and_exit_code_two(database, capsys, flags, sentence):
    assert run(database, *flags) == 2
    told = capsys.readouterr().err
    assert sentence in told and "Traceback" not in told


def test_without_matplotlib_the_report_names_the_extra_before_any_work(
    database, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    assert run(database, "-o", tmp_path / "report") == 2
    assert "pip install 'tonguetrack[plot]'" in capsys.readouterr().err
    assert not (tmp_path / "report").exists()
