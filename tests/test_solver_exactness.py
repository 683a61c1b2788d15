"""The tracking energy and its minimisers against finite differences and a slow, tight reference solver."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import minimize

from tonguetrack.tracker import kernels
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.session import Energy
from tonguetrack.tracker.solver import FixedSpeakerSolver, FreeSpeakerSolver


@dataclass
class Case:
    """One frame: the model at the coils' vertices, the coils, the previous weights, the energy's weights."""

    model: object
    coils: np.ndarray
    previous: np.ndarray
    energy: Energy
    coherent: bool

    @property
    def mean(self):
        return np.concatenate([self.model.speaker.mean, self.model.pose.mean])

    @property
    def sigma(self):
        return np.concatenate([self.model.speaker.sigma, self.model.pose.sigma])

    @property
    def bounds(self):
        reach = self.energy.box * self.sigma
        return self.mean - reach, self.mean + reach

    def value_and_gradient(self, weights):
        """E and its gradient, written from the formula of the paper, with no code of the tracker's."""
        speakers = self.model.speaker.size
        s, p = weights[:speakers], weights[speakers:]
        present = ~np.isnan(self.coils[:, 0])
        rows = np.repeat(present, 3)
        core = self.model.core[:, :, rows]
        residual = self.model.origin[rows] + np.einsum("lkr,l,k->r", core, s, p) - self.coils[present].ravel()
        e = self.energy
        share = e.alpha / present.sum()
        beta = np.r_[np.full(speakers, e.beta_speaker), np.full(len(p), e.beta_pose)]
        gamma = np.r_[np.full(speakers, e.gamma_speaker), np.full(len(p), e.gamma_pose)] * self.coherent
        value = share * residual @ residual
        value += beta @ (weights - self.mean) ** 2 + gamma @ (weights - self.previous) ** 2
        jacobian = np.concatenate([np.einsum("lkr,k->lr", core, p), np.einsum("lkr,l->kr", core, s)])
        gradient = 2 * share * jacobian @ residual
        gradient += 2 * beta * (weights - self.mean) + 2 * gamma * (weights - self.previous)
        return value, gradient


def random_case(model, random, coils=None):
    """A frame of a random shape and noise; bounds often active, coils often missing, terms often off."""
    count = coils or int(random.integers(2, 7))
    at_coils = model.at(random.choice(model.vertex_count, size=count, replace=False))
    energy = Energy(
        alpha=float(random.choice([0.5, 1.0])),
        beta_speaker=float(random.choice([0.5, 5.0, 20.0])),
        beta_pose=float(random.choice([0.5, 5.0])),
        gamma_speaker=float(random.choice([0.0, 5.0, 50.0])),
        gamma_pose=float(random.choice([0.0, 5.0])),
        box=float(random.choice([0.5, 1.0, 2.0, 5.0])),
    )
    case = Case(at_coils, np.zeros((count, 3)), np.zeros(0), energy, bool(random.random() < 0.8))
    spread = random.choice([0.5, 1.5, 4.0])
    truth = case.mean + spread * case.sigma * random.normal(size=len(case.mean))
    s, p = truth[: model.speaker.size], truth[model.speaker.size :]
    case.coils = at_coils.vertices(s, p) + random.normal(size=(count, 3)) * random.choice([0.3, 3.0])
    case.coils[random.random(count) < 0.2] = np.nan
    if np.isnan(case.coils).all():
        case.coils[0] = at_coils.vertices(s, p)[0]
    low, high = case.bounds
    case.previous = np.clip(truth + 0.3 * case.sigma * random.normal(size=len(truth)), low, high)
    return case


def tight_minimum(case, start):
    low, high = case.bounds
    return minimize(
        case.value_and_gradient,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"ftol": 1e-16, "gtol": 1e-10, "maxiter": 5000, "maxfun": 50000, "maxcor": 20},
    )


def solved_free(case, restart=False):
    solver = FreeSpeakerSolver(case.model, case.energy)
    weights = case.previous.copy()
    kernels.solve_free_speaker(
        case.coils, solver._base, solver._core, solver._box, solver._energy, case.coherent, restart, weights,
        solver.residuals_mm, solver._scratch, solver._coil_scratch, solver.result,
    )  # fmt: skip
    return weights, solver


def test_the_energy_is_the_formula_and_its_derivatives_are_right(small_model):
    random = np.random.default_rng(1)
    for _ in range(50):
        case = random_case(small_model, random)
        size, rows = len(case.mean), 3 * case.model.vertex_count
        e = case.energy
        beta = np.r_[np.full(5, e.beta_speaker), np.full(4, e.beta_pose)]
        gamma = np.r_[np.full(5, e.gamma_speaker), np.full(4, e.gamma_pose)]
        box = np.stack([case.mean, *case.bounds])
        jacobian, residual = np.zeros((size, rows)), np.zeros(rows)
        gradient, hessian = np.zeros(size), np.zeros((size, size))
        case.coherent = True

        def energy_at(
            weights, case=case, beta=beta, gamma=gamma, box=box, jacobian=jacobian, residual=residual
        ):
            return kernels.free_energy(
                case.coils, np.array(case.model.origin), np.array(case.model.core), box, case.energy.alpha, beta,
                gamma, case.previous, weights, jacobian, residual,
            )  # fmt: skip

        def derivatives(weights, case=case, beta=beta, gamma=gamma, box=box, jacobian=jacobian,
                        residual=residual, gradient=gradient, hessian=hessian, energy_at=energy_at):  # fmt: skip
            energy_at(weights)
            kernels.free_gradient_and_hessian(
                case.coils, np.array(case.model.core), box, case.energy.alpha, beta, gamma, case.previous, weights,
                jacobian, residual, True, gradient, hessian,
            )  # fmt: skip
            return gradient.copy(), hessian.copy()

        at = case.mean + case.sigma * random.normal(size=size)
        value, expected_gradient = case.value_and_gradient(at)
        assert energy_at(at) == pytest.approx(value, rel=1e-12)
        found_gradient, found_hessian = derivatives(at)
        np.testing.assert_allclose(found_gradient, expected_gradient, rtol=1e-10, atol=1e-8)
        step = 1e-5
        for a in range(size):
            ahead, behind = at.copy(), at.copy()
            ahead[a] += step
            behind[a] -= step
            slope = (energy_at(ahead) - energy_at(behind)) / (2 * step)
            assert slope == pytest.approx(found_gradient[a], rel=1e-5, abs=1e-4)
            column = (derivatives(ahead)[0] - derivatives(behind)[0]) / (2 * step)
            np.testing.assert_allclose(column, found_hessian[a], rtol=1e-5, atol=1e-3)


def test_the_quadratic_programme_satisfies_its_optimality_conditions():
    random = np.random.default_rng(2)
    active = 0
    for _ in range(3000):
        size = int(random.integers(1, 10))
        root = random.normal(size=(size, size + 1))
        hessian = root @ root.T + 1e-3 * np.eye(size)
        linear = 10 * random.normal(size=size)
        low = -random.random(size)
        high = random.random(size)
        x = random.normal(size=size)
        outcome = kernels.minimise_quadratic_in_box(
            hessian, linear, low, high, x, kernels.quadratic_scratch(size)
        )
        assert outcome == kernels.SOLVED
        gradient = hessian @ x - linear
        assert ((low <= x) & (x <= high)).all()
        tolerance = 1e-8 * (1 + np.abs(linear).max())
        assert (np.abs(gradient[(x > low) & (x < high)]) < tolerance).all()
        assert (gradient[x == low] > -tolerance).all()
        assert (gradient[x == high] < tolerance).all()
        active += bool(((x == low) | (x == high)).any())
    assert active > 1000


def test_an_indefinite_quadratic_is_reported_not_solved():
    x = np.zeros(2)
    for hessian in (np.diag([1.0, -1.0]), np.full((2, 2), np.nan)):
        outcome = kernels.minimise_quadratic_in_box(
            hessian, np.ones(2), -np.ones(2), np.ones(2), x, kernels.quadratic_scratch(2)
        )
        assert outcome == kernels.INDEFINITE
        assert np.isfinite(x).all()


def test_the_fixed_speaker_solution_is_the_minimum_on_thousands_of_frames(small_model):
    random = np.random.default_rng(3)
    at_bound = missing = 0
    for _ in range(2000):
        case = random_case(small_model, random)
        s = case.previous[:5]
        solver = FixedSpeakerSolver(case.model.for_speaker(s), case.energy)
        solver.weights[:] = case.previous[5:]
        solver._started = case.coherent
        assert solver.solve(case.coils) == PoseStatus.OK

        def reduced(p, case=case, s=s):
            value, gradient = case.value_and_gradient(np.r_[s, p])
            return value, gradient[5:]

        low, high = case.bounds
        reference = minimize(
            reduced, case.previous[5:], jac=True, method="L-BFGS-B", bounds=list(zip(low[5:], high[5:], strict=True)),
            options={"ftol": 1e-16, "gtol": 1e-10, "maxiter": 5000, "maxcor": 20},
        )  # fmt: skip
        ours, _ = reduced(solver.weights)
        assert ours <= reference.fun * (1 + 1e-9)
        constant = case.energy.beta_speaker * np.sum((s - case.mean[:5]) ** 2)
        assert solver.result[0] + constant == pytest.approx(ours, rel=1e-9)
        assert ((low[5:] <= solver.weights) & (solver.weights <= high[5:])).all()
        at_bound += bool(((solver.weights == low[5:]) | (solver.weights == high[5:])).any())
        missing += bool(np.isnan(case.coils).any())
    assert at_bound > 300
    assert missing > 500


def test_the_free_speaker_solution_is_a_minimum_on_thousands_of_frames(small_model):
    random = np.random.default_rng(4)
    at_bound = missing = elsewhere = 0
    frames = 2000
    for _ in range(frames):
        case = random_case(small_model, random)
        weights, solver = solved_free(case)
        ours, _ = case.value_and_gradient(weights)
        assert solver.result[0] == pytest.approx(ours, rel=1e-9)
        low, high = case.bounds
        assert ((low <= weights) & (weights <= high)).all()
        reference = tight_minimum(case, case.previous)
        if ours > reference.fun * (1 + 1e-9):
            # Only allowed where the reference fell into another valley: from our solution it finds nothing lower.
            assert tight_minimum(case, weights).fun >= ours * (1 - 1e-9)
            elsewhere += 1
        at_bound += bool(((weights == low) | (weights == high)).any())
        missing += bool(np.isnan(case.coils).any())
    assert at_bound > 300
    assert missing > 500
    assert elsewhere < 0.02 * frames


def test_the_floor_of_a_long_curved_valley_is_reached(small_model):
    """Strong data and hardly any bias: along (c s, p / c) the energy is almost level, and bends."""
    random = np.random.default_rng(11)
    for _ in range(60):
        case = random_case(small_model, random, coils=int(random.integers(1, 4)))
        case.energy = Energy(alpha=100.0, beta_speaker=0.05, beta_pose=0.05, gamma_pose=0.0, box=8.0)
        low, high = case.bounds
        case.previous = np.where(random.random(len(low)) < 0.5, low, high)
        weights, _ = solved_free(case)
        ours, _ = case.value_and_gradient(weights)
        assert ours <= tight_minimum(case, weights).fun * (1 + 1e-8) + 1e-12


def test_a_restart_tries_the_mirrored_weights_and_keeps_the_best(small_model):
    random = np.random.default_rng(5)
    better = 0
    for _ in range(300):
        case = random_case(small_model, random, coils=3)
        case.coherent = False
        case.energy = Energy(box=5.0)
        _, once = solved_free(case)
        weights, tried = solved_free(case, restart=True)
        assert tried.result[0] <= once.result[0] * (1 + 1e-12)
        better += tried.result[0] < once.result[0] * (1 - 1e-6)
        assert case.value_and_gradient(weights)[0] == pytest.approx(tried.result[0], rel=1e-9)
    assert better > 0


def test_without_bias_and_coherence_the_data_still_decide_what_they_can(small_model):
    """Fewer coordinates than weights: the minimum is a valley, and its floor must be reached."""
    energy = Energy(beta_speaker=0, beta_pose=0, gamma_speaker=0, gamma_pose=0, box=2)
    speaker = small_model.for_speaker(small_model.speaker.mean).at([3])
    truth = small_model.pose.mean + 0.5 * small_model.pose.sigma
    for solver in (FixedSpeakerSolver(speaker, energy), FreeSpeakerSolver(small_model.at([3]), energy)):
        solver.solve(np.ascontiguousarray(speaker.vertices(truth)))
        assert np.isfinite(solver.weights).all()
        assert solver.result[1] < 1e-3


def test_coils_keep_the_order_in_which_they_are_named(small_model):
    """A list of vertices that is not ascending must not be sorted behind the caller's back."""
    order = [41, 3, 17]
    s = small_model.speaker.mean
    p = small_model.pose.mean + 0.8 * small_model.pose.sigma
    coils = np.ascontiguousarray(small_model.at(order).vertices(s, p))
    solver = FixedSpeakerSolver(small_model.for_speaker(s).at(order), Energy(beta_pose=1e-9))
    solver.solve(coils)
    np.testing.assert_allclose(solver.weights, p, atol=1e-5)
    swapped = FixedSpeakerSolver(small_model.for_speaker(s).at(sorted(order)), Energy(beta_pose=1e-9))
    swapped.solve(coils)
    assert swapped.result[1] > 1.0
