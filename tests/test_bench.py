"""The bench compares like with like. How fast anything is, no test says."""

import json

import numpy as np
import pytest

from tonguetrack.model import save_model
from tonguetrack.tracker import bench as module
from tonguetrack.tracker.bench import bench, made_up_recording, report, solve_comparison
from tonguetrack.tracker.session import Energy


@pytest.mark.parametrize("fixed", [True, False])
def test_scipys_objective_is_the_trackers_energy_with_its_gradient(small_model, fixed):
    recording, setup = made_up_recording(small_model, 3, 250.0)
    solver, objective, bounds = module._problem(small_model, setup, Energy(), fixed)
    solver.solve(recording.positions[0])
    previous = solver.weights.copy()
    q = recording.positions[1].ravel()
    solver.solve(recording.positions[1])
    if fixed:  # the solver leaves out what the fixed speaker costs; so does the objective
        assert len(bounds) == small_model.pose.size
    value, _ = objective(solver.weights, q, previous)
    assert value == pytest.approx(solver.result[0], rel=1e-12)
    random = np.random.default_rng(4)
    x = solver.weights + 0.1 * random.normal(size=len(solver.weights))
    _, gradient = objective(x, q, previous)
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-5
        slope = (objective(x + step, q, previous)[0] - objective(x - step, q, previous)[0]) / 2e-5
        assert gradient[k] == pytest.approx(slope, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("fixed", [True, False])
def test_our_energy_is_never_above_scipys(small_model, fixed):
    compared = solve_comparison(small_model, fixed, 60)
    for name in ("scipy_default", "scipy_tight"):
        assert compared[f"energy_difference_to_{name}"]["largest"] < 1e-9
        assert compared[f"ratio_to_{name}"] > 0
    assert compared["frames"] == 60


def test_the_made_up_recording_is_near_the_model_and_the_same_every_time(small_model):
    recording, setup = made_up_recording(small_model, 100, 400.0)
    again, _ = made_up_recording(small_model, 100, 400.0)
    np.testing.assert_array_equal(recording.positions, again.positions)
    assert recording.rate_hz == 400.0
    assert len(set(setup.vertices)) == len(setup.roles) == module.COILS
    mean = small_model.mean_vertices()[list(setup.vertices)]
    assert np.abs(recording.positions - mean).max() < 60.0


def test_all_of_it_runs_and_reads_as_json_and_as_tables(small_model, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "RATES_HZ", (250.0, 1250.0))
    path = tmp_path / "model.npz"
    save_model(small_model, path)
    result = json.loads(json.dumps(bench(small_model, path, 30, 0.2, 500), allow_nan=False))
    assert [loop["rate_hz"] for loop in result["loop"]] == [250.0, 1250.0]
    for loop in result["loop"]:
        assert loop["arrival_to_sent_ms"]["count"] == loop["frames"] == 0.2 * loop["rate_hz"]
        assert loop["received"] <= loop["frames"]
    assert result["machine"]["cpus"] >= 1
    assert set(result["start"]) == {"cold", "warm"}
    for steps in result["start"].values():
        assert steps["total"] >= steps["imports"] + steps["solver"]
    text = report(result)
    for line in ("fixed speaker, 4 weights, 5 coils", "free speaker, 9 weights", "250 Hz", "cold cache"):
        assert line in text
