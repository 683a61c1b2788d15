"""What the solvers do over time: missing coils, holding, restarting, determinism, memory."""

import sys

import numpy as np
import pytest

from tonguetrack.tracker import kernels
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.preparation import Preparation
from tonguetrack.tracker.session import Alignment, Energy
from tonguetrack.tracker.solver import FixedSpeakerSolver, FreeSpeakerSolver

VERTICES = [3, 9, 15]


def moving_coils(model, frames=300, seed=0):
    """(frames, 3, 3) coils of a smooth movement of the model's own poses, with noise."""
    random = np.random.default_rng(seed)
    t = np.linspace(0, 4 * np.pi, frames)[:, None]
    swing = np.sin(t + random.uniform(0, 2 * np.pi, model.pose.size)) * random.uniform(
        0.3, 1, model.pose.size
    )
    speaker = model.for_speaker(model.speaker.mean).at(VERTICES)
    shapes = [speaker.vertices(model.pose.mean + x * model.pose.sigma) for x in swing]
    return np.array(shapes) + random.normal(scale=0.2, size=(frames, 3, 3))


@pytest.fixture(params=["fixed", "free"])
def solver(request, small_model):
    if request.param == "fixed":
        speaker = small_model.for_speaker(small_model.speaker.mean)
        return FixedSpeakerSolver(speaker.at(VERTICES), Energy())
    return FreeSpeakerSolver(small_model.at(VERTICES), Energy())


def test_one_frame_at_a_time_and_all_at_once_are_the_same_bits(solver, small_model):
    coils = moving_coils(small_model)
    coils[50:60, 1] = np.nan
    coils[100:110] = np.nan
    together = solver.solve_all(coils)
    solver.reset()
    for frame, target in enumerate(coils):
        status = solver.solve(np.ascontiguousarray(target))
        assert status == together.statuses[frame]
        np.testing.assert_array_equal(solver.weights, together.weights[frame])
        np.testing.assert_array_equal(solver.residuals_mm, together.residuals_mm[frame])


def test_the_same_take_gives_the_same_bits_twice(solver, small_model):
    coils = moving_coils(small_model)
    np.testing.assert_array_equal(solver.solve_all(coils).weights, solver.solve_all(coils).weights)


def test_a_missing_coil_drops_out_of_the_data_term(small_model):
    """Solving with a NaN coil equals solving a model that does not have that coil."""
    coils = moving_coils(small_model, frames=1)[0]
    speaker = small_model.for_speaker(small_model.speaker.mean)
    with_gap = coils.copy()
    with_gap[1] = np.nan
    first = FixedSpeakerSolver(speaker.at(VERTICES), Energy())
    second = FixedSpeakerSolver(speaker.at([VERTICES[0], VERTICES[2]]), Energy())
    first.solve(with_gap)
    second.solve(np.ascontiguousarray(coils[[0, 2]]))
    np.testing.assert_allclose(first.weights, second.weights, atol=1e-12)
    assert np.isnan(first.residuals_mm[1])
    assert first.result[0] == pytest.approx(second.result[0])


def test_without_any_coil_the_pose_is_held_and_says_so(solver, small_model):
    coils = moving_coils(small_model, frames=20)
    for target in coils[:10]:
        solver.solve(np.ascontiguousarray(target))
    before = solver.weights.copy()
    for _ in range(5):
        assert solver.solve(np.full((3, 3), np.nan)) == PoseStatus.HELD
        np.testing.assert_array_equal(solver.weights, before)
    assert solver.solve(np.ascontiguousarray(coils[10])) == PoseStatus.OK
    assert np.isfinite(solver.weights).all()


def test_before_the_first_coil_the_pose_is_lost_and_the_mean(solver, small_model):
    mean = solver.weights.copy()
    assert solver.solve(np.full((3, 3), np.nan)) == PoseStatus.LOST
    np.testing.assert_array_equal(solver.weights, mean)
    coils = moving_coils(small_model, frames=10)
    coils[:4] = np.nan
    statuses = solver.solve_all(coils).statuses
    assert list(statuses) == [PoseStatus.LOST] * 4 + [PoseStatus.OK] * 6


def test_no_pattern_of_missing_coils_makes_a_weight_nan(solver, small_model):
    coils = moving_coils(small_model)
    coils[np.random.default_rng(1).random((300, 3)) < 0.6] = np.nan
    solved = solver.solve_all(coils)
    assert np.isfinite(solved.weights).all()
    assert set(solved.statuses) <= {PoseStatus.LOST, PoseStatus.OK, PoseStatus.HELD}


def test_coherence_starts_with_the_second_frame(small_model):
    """The first frame does not pull towards the start: any gamma gives the same first pose."""
    coils = moving_coils(small_model, frames=2)
    speaker = small_model.for_speaker(small_model.speaker.mean).at(VERTICES)
    weak = FixedSpeakerSolver(speaker, Energy(gamma_pose=0)).solve_all(coils).weights
    strong = FixedSpeakerSolver(speaker, Energy(gamma_pose=1000)).solve_all(coils).weights
    np.testing.assert_array_equal(weak[0], strong[0])
    assert np.linalg.norm(strong[1] - strong[0]) < np.linalg.norm(weak[1] - weak[0])


def test_frames_cost_no_memory(solver, small_model):
    coils = np.ascontiguousarray(moving_coils(small_model))
    for target in coils:
        solver.solve(target)
    before = sys.getallocatedblocks()
    for _ in range(30):
        for target in coils:
            solver.solve(target)
    assert sys.getallocatedblocks() - before < 50


def test_no_kernel_is_compiled_twice(small_model):
    """Whatever kind of array the frames come in."""
    speaker = small_model.for_speaker(small_model.speaker.mean)

    def track(coils):
        FixedSpeakerSolver(speaker.at(VERTICES), Energy()).solve_all(coils)
        FreeSpeakerSolver(small_model.at(VERTICES), Energy()).solve_all(coils)
        preparation = Preparation(np.arange(3), Alignment())
        preparation.all_frames(coils)
        preparation.frame(coils[0])
        preparation.frame(coils[0].astype(np.float32))
        return {
            name: len(kernel.signatures)
            for name, kernel in vars(kernels).items()
            if hasattr(kernel, "signatures")
        }

    coils = moving_coils(small_model)
    before = track(coils)
    assert len(before) > 10
    coils.setflags(write=False)
    for unusual in (coils, coils[::2], np.asfortranarray(coils)):
        assert track(unusual) == before


@pytest.mark.parametrize("experiment", ["fixed", "free"])
@pytest.mark.parametrize("alpha", [1e-9, 1.0, 1e12])
@pytest.mark.parametrize("bias", [0.0, 5.0])
@pytest.mark.parametrize("box", [1e-12, 5.0])
def test_no_coordinates_and_no_energy_make_a_weight_nan(small_model, experiment, alpha, bias, box):
    energy = Energy(alpha, bias, bias, bias, bias, box)
    vertices = [3, 3, 9, 15]
    speaker = small_model.for_speaker(small_model.speaker.mean)
    solver = (
        FixedSpeakerSolver(speaker.at(vertices), energy)
        if experiment == "fixed"
        else FreeSpeakerSolver(small_model.at(vertices), energy)
    )
    shape = small_model.mean_vertices()[vertices]
    raw = np.stack(
        [np.full((4, 3), x) for x in (np.nan, 0.0, -0.0, 5e-324, 1e6, 1e9, 1e150, 1e300, np.inf, -np.inf)]
        + [shape, np.repeat(shape[:1], 4, axis=0), shape + 1e6, shape * [1, np.nan, 1]]
    )
    solved = solver.solve_all(Preparation(np.arange(4), Alignment()).all_frames(raw))
    assert np.isfinite(solved.weights).all()
    assert list(solved.statuses) == [0] + [1] * 5 + [2] * 4 + [1] * 3 + [2]
    assert (np.isfinite(solved.results[:, 0]) == (solved.statuses == PoseStatus.OK)).all()
