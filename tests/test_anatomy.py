"""One speaker for many frames: the minimum against a slow reference, and what an estimate must be like."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from tonguetrack import InputError
from tonguetrack.tracker import anatomy
from tonguetrack.tracker.anatomy import Problem, SpeakerEstimator, State, estimate_speaker
from tonguetrack.tracker.session import Energy

NOISE_MM = 0.3


def spoken(model, vertices, frames, seed, spread=0.8, noise_mm=NOISE_MM, speaker=None):
    """A random speaker's weights, or those given, the model and noisy coils (frames, n, 3) at random poses."""
    random = np.random.default_rng(seed)
    at_coils = model.at(vertices)
    s = model.speaker.mean + spread * model.speaker.sigma * random.normal(size=model.speaker.size)
    s = s if speaker is None else speaker
    poses = model.pose.mean + spread * model.pose.sigma * random.normal(size=(frames, model.pose.size))
    coils = np.array([at_coils.vertices(s, p) for p in poses])
    return s, at_coils, coils + noise_mm * random.normal(size=coils.shape)


def joint_energy(model, energy, coils):
    """F and its gradient over (s, p_1 .. p_T) as one vector, from the formula, with no code of the tracker's."""
    frames = len(coils)
    m, k = model.speaker.size, model.pose.size
    present = ~np.isnan(coils[:, :, 0])
    counted = present.any(axis=1)
    share = np.where(counted, energy.alpha / np.maximum(present.sum(axis=1), 1), 0.0)
    rows = np.repeat(present, 3, axis=1)
    targets = np.nan_to_num(coils.reshape(frames, -1))
    bias = energy.beta_speaker * counted.sum()

    def value_and_gradient(x):
        s, poses = x[:m], x[m:].reshape(frames, k)
        residual = (model.origin + np.einsum("l,tk,lkr->tr", s, poses, model.core) - targets) * rows
        off_pose = (poses - model.pose.mean) * counted[:, None]
        value = share @ (residual**2).sum(axis=1) + bias * np.sum((s - model.speaker.mean) ** 2)
        value += energy.beta_pose * np.sum(off_pose**2)
        pull = 2 * share[:, None] * residual
        by_speaker = np.einsum("tr,tk,lkr->l", pull, poses, model.core) + 2 * bias * (s - model.speaker.mean)
        by_pose = np.einsum("tr,l,lkr->tk", pull, s, model.core) + 2 * energy.beta_pose * off_pose
        return value, np.concatenate([by_speaker, by_pose.ravel()])

    return value_and_gradient


def bounds(model, energy, frames):
    reach = [(mode.mean, energy.box * mode.sigma) for mode in (model.speaker, model.pose)]
    low, high = ([mean - h for mean, h in reach], [mean + h for mean, h in reach])
    return [np.concatenate([side[0], np.tile(side[1], frames)]) for side in (low, high)]


def tight_minimum(function, start, low, high):
    return minimize(
        function,
        np.clip(start, low, high),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"ftol": 1e-16, "gtol": 1e-9, "maxiter": 5000, "maxfun": 50000, "maxcor": 20},
    )


def test_no_reference_solver_finds_a_lower_energy_from_the_same_start(small_model):
    """Speaker and poses at their bounds, terms switched off, coils missing: never more than 1e-6 above."""
    random = np.random.default_rng(1)
    speaker_at_bound = pose_at_bound = elsewhere = 0
    cases = 100
    for _ in range(cases):
        frames, count = int(random.integers(1, 7)), int(random.integers(2, 6))
        vertices = random.choice(small_model.vertex_count, size=count, replace=False)
        spread, noise_mm = random.choice([0.5, 1.5, 3.0]), random.choice([0.3, 3.0])
        seed = int(random.integers(1 << 30))
        _, at_coils, coils = spoken(small_model, vertices, frames, seed, spread, noise_mm)
        coils[random.random((frames, count)) < 0.2] = np.nan
        coils[0, 0] = small_model.mean_vertices()[vertices[0]]
        energy = Energy(
            alpha=float(random.choice([0.5, 1.0])),
            beta_speaker=float(random.choice([0.05, 5.0])),
            beta_pose=float(random.choice([0.5, 5.0])),
            box=float(random.choice([0.5, 1.0, 2.0, 5.0])),
        )
        estimator = SpeakerEstimator(at_coils, energy, frames)
        found = estimator.estimate(coils, None, robust=False)
        assert found.converged
        ours = np.concatenate([found.weights, estimator.poses.ravel()])
        low, high = bounds(small_model, energy, frames)
        assert ((low <= ours) & (ours <= high)).all()
        function = joint_energy(at_coils, energy, coils)
        value, _ = function(ours)
        assert estimator.outcome.energy == pytest.approx(value, rel=1e-9)
        first = np.concatenate([small_model.speaker.mean, np.tile(small_model.pose.mean, frames)])
        reference = tight_minimum(function, first, low, high)
        if value > reference.fun * (1 + 1e-6) + 1e-12:
            # Only where the reference went over into another valley: in ours it finds nothing lower.
            assert tight_minimum(function, ours, low, high).fun >= value * (1 - 1e-6)
            elsewhere += 1
        at_bound = (ours == low) | (ours == high)
        speaker_at_bound += bool(at_bound[:5].any())
        pose_at_bound += bool(at_bound[5:].any())
    assert speaker_at_bound > 20
    assert pose_at_bound > 30
    assert elsewhere <= 0.02 * cases


def test_the_reduced_derivatives_are_those_of_the_energy_with_the_best_poses(small_model):
    _, at_coils, coils = spoken(small_model, [3, 9, 15], frames=6, seed=2)
    coils[2, 1] = coils[4] = np.nan
    estimator = SpeakerEstimator(at_coils, Energy(box=8.0), len(coils))
    terms = np.array([1.0, 0.5, 2.0])
    problem = Problem(
        coils, estimator._base, estimator._core, estimator._speaker_box, estimator._pose_box, terms,
        estimator._flips,
    )  # fmt: skip
    work = estimator._work

    def at(speaker):
        state = State(np.array(speaker), np.tile(small_model.pose.mean, (6, 1)), np.ones((6, 3)))
        energy = anatomy.solve_poses(problem, state, work)
        anatomy.reduce_to_speaker(problem, state, work, 1.0)
        return energy, 2 * work.gradient, 2 * work.hessian

    centre = small_model.speaker.mean + 0.5 * small_model.speaker.sigma * np.array([1, -1, 0.5, 1, -0.5])
    _, gradient, hessian = at(centre)
    step = 1e-5
    for l in range(5):
        ahead, behind = (at(centre + sign * step * np.eye(5)[l]) for sign in (1, -1))
        assert (ahead[0] - behind[0]) / (2 * step) == pytest.approx(gradient[l], rel=1e-5)
        np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * step), hessian[l], rtol=1e-4, atol=1e-2)


def test_a_first_estimate_is_never_worse_than_one_that_is_started_at_the_mirror(small_model):
    better = 0
    for seed in range(40):
        _, at_coils, coils = spoken(small_model, [2, 30, 50], frames=3, seed=seed, spread=3.0)
        estimator = SpeakerEstimator(at_coils, Energy(beta_speaker=0.5), len(coils))
        energies = []
        for start in (None, small_model.speaker.mean, -small_model.speaker.mean):
            estimator.estimate(coils, start, robust=False)
            energies.append(estimator.outcome.energy)
        assert energies[0] <= energies[1] * (1 + 1e-8)
        better += energies[0] < min(energies[1:]) * (1 - 1e-6)
    assert better > 0


def test_a_second_of_speech_gives_the_speaker_within_the_stated_covariance(small_model):
    """Speakers are drawn from the bias, so that it is what the statistics take it for, and poses hardly know one.

    Half of all squared distances, in units of the covariance, should then be below 4.35 (five weights), were it
    not that the poses are estimated along with the speaker, which the covariance makes too little of.
    """
    frames, noise_mm, spread = 50, 0.1, 0.15
    vertices = [1, 8, 14, 30, 47]
    beta = noise_mm**2 / len(vertices) / (spread * small_model.speaker.sigma[0]) ** 2 / frames
    energy = Energy(beta_speaker=beta, beta_pose=1e-6, box=8.0)
    squared = []
    for seed in range(60):
        random = np.random.default_rng(seed)
        truth = small_model.speaker.mean + spread * small_model.speaker.sigma * random.normal(size=5)
        _, at_coils, coils = spoken(small_model, vertices, frames, seed, noise_mm=noise_mm, speaker=truth)
        found = estimate_speaker(at_coils, energy, coils, robust=False)
        off = found.weights - truth
        squared.append(off @ np.linalg.solve(found.covariance, off))
        deviations = found.sigma * small_model.speaker.sigma
        np.testing.assert_allclose(deviations, np.sqrt(np.diag(found.covariance)))
    assert 4.35 / 2 < np.median(squared) < 4.35 * 2
    assert np.quantile(squared, 0.8) < 3 * 7.29


def test_more_frames_make_a_surer_estimate(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14, 47], frames=200, seed=5)
    sure = [estimate_speaker(at_coils, Energy(), coils[:frames]).sigma for frames in (20, 200)]
    assert (sure[1] < sure[0] / 2).all()


def test_the_same_speech_at_twice_the_rate_gives_the_same_speaker(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14], frames=40, seed=6)
    once, twice = (estimate_speaker(at_coils, Energy(), np.repeat(coils, times, axis=0)) for times in (1, 2))
    np.testing.assert_allclose(twice.weights, once.weights, atol=1e-5)
    assert (once.frames, twice.frames) == (40, 80)


def test_a_coil_that_is_always_missing_is_as_good_as_none(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14, 47], frames=30, seed=7)
    coils[:, 2] = np.nan
    with_gaps = estimate_speaker(at_coils, Energy(), coils)
    without = estimate_speaker(small_model.at([1, 8, 47]), Energy(), coils[:, [0, 1, 3]])
    np.testing.assert_allclose(with_gaps.weights, without.weights, atol=1e-9)
    np.testing.assert_allclose(with_gaps.covariance, without.covariance, rtol=1e-6, atol=1e-15)


def test_frames_without_coils_change_nothing(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14], frames=30, seed=8)
    padded = np.full((50, 3, 3), np.nan)
    padded[5:35] = coils
    plain, holed = estimate_speaker(at_coils, Energy(), coils), estimate_speaker(at_coils, Energy(), padded)
    np.testing.assert_array_equal(plain.weights, holed.weights)
    np.testing.assert_array_equal(plain.covariance, holed.covariance)
    assert holed.frames == 30


def test_with_one_coil_there_is_an_estimate_but_no_certainty(small_model):
    """Four weights of every pose follow three coordinates: nothing is left over to judge by."""
    _, at_coils, coils = spoken(small_model, [1, 8, 14], frames=30, seed=9)
    assert np.isfinite(estimate_speaker(at_coils, Energy(), coils).covariance).all()
    coils[:, 1:] = np.nan
    found = estimate_speaker(at_coils, Energy(beta_speaker=0.0, beta_pose=0.0), coils)
    assert np.isfinite(found.weights).all() and found.residual_mm < 1e-3
    assert np.isinf(found.covariance).all() and np.isinf(found.sigma).all()


def test_samples_far_astray_hardly_move_a_robust_estimate(small_model):
    random = np.random.default_rng(10)
    _, at_coils, clean = spoken(small_model, [1, 8, 14, 47], frames=100, seed=10)
    torn = random.random(clean.shape[:2]) < 0.03
    coils = clean + 40.0 * torn[:, :, None] * random.normal(size=clean.shape)
    estimator = SpeakerEstimator(at_coils, Energy(), len(coils))
    moved = {}
    for robust in (False, True):
        before = estimate_speaker(at_coils, Energy(), clean, robust=robust).weights
        moved[robust] = np.linalg.norm(estimator.estimate(coils, None, robust).weights - before)
    assert moved[True] < 0.1 * moved[False]
    far = np.linalg.norm(coils - clean, axis=2) > 20.0
    assert far.sum() > 5
    assert estimator.trust[far].max() < 0.1
    assert np.median(estimator.trust[~torn]) > 0.7


def test_a_damaged_number_among_thousands_does_no_harm(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14, 47], frames=50, seed=11)
    clean = estimate_speaker(at_coils, Energy(), coils).weights
    coils[20, 1] = 1e9
    found = estimate_speaker(at_coils, Energy(), coils)
    np.testing.assert_allclose(found.weights, clean, atol=0.05 * small_model.speaker.sigma[0])


def test_an_estimate_is_the_same_to_the_bit_every_time_and_leaves_its_input_alone(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14], frames=60, seed=12)
    coils[3, 1] = np.nan
    kept = coils.copy()
    first = estimate_speaker(at_coils, Energy(), coils)
    estimator = SpeakerEstimator(at_coils, Energy(), 100)
    estimator.estimate(coils[::-1].copy())
    again = estimator.estimate(coils)
    np.testing.assert_array_equal(first.weights, again.weights)
    np.testing.assert_array_equal(first.covariance, again.covariance)
    np.testing.assert_array_equal(coils, kept)


def test_an_estimate_does_not_depend_on_where_it_starts_nearby(small_model):
    _, at_coils, coils = spoken(small_model, [1, 8, 14], frames=60, seed=13)
    cold = estimate_speaker(at_coils, Energy(), coils)
    warm = estimate_speaker(at_coils, Energy(), coils, start=cold.weights)
    np.testing.assert_allclose(warm.weights, cold.weights, atol=1e-5)
    assert warm.iterations <= cold.iterations


def test_lateral_coordinates_that_were_projected_away_do_not_count_as_measured(small_model):
    """Mid-sagittal coils hold exact zeros across: with or without that row, the estimate is as sure."""
    _, flat_model, coils = spoken(small_model, [1, 8, 14], frames=60, seed=14)
    core, origin = np.array(flat_model.core), np.array(flat_model.origin)
    core[:, :, 0::3] = 0.0
    origin[0::3] = 0.0
    flat_model = replace(flat_model, core=core, origin=origin)
    flat = coils.copy()
    flat[:, :, 0] = 0.0
    measured = coils.copy()
    measured[:, :, 0] = 1e-12  # nearly the same numbers, but counted as measurements that agree
    sure, too_sure = (estimate_speaker(flat_model, Energy(), c, robust=False).sigma for c in (flat, measured))
    assert (sure > 1.05 * too_sure).all()


def test_no_coil_at_all_is_refused(small_model):
    with pytest.raises(InputError, match="none of the frames has a coil"):
        estimate_speaker(small_model.at([1, 2]), Energy(), np.full((5, 2, 3), np.nan))


def test_the_kernel_is_compiled_for_one_signature_only(small_model):
    for vertices in ([1, 2, 3], [4, 5]):
        _, at_coils, coils = spoken(small_model, vertices, frames=5, seed=15)
        coils.setflags(write=False)
        estimate_speaker(at_coils, Energy(), coils[::2], robust=False)
        estimate_speaker(at_coils, Energy(), coils, start=small_model.speaker.mean)
    assert len(anatomy.estimate.signatures) == 1
