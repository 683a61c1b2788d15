"""Hard random frames against a tight reference solver, for as long as asked.

    python tests/bench/solver_stress.py [--model FILE] [--seed N] [--seconds N]

One to eight coils, some of them on the same vertex or far away, gaps, heavy-tailed noise, weights at the box
from the start, all terms of the energy varied. Prints, for the fixed speaker, the largest relative excess of
our energy over scipy's L-BFGS-B with tight tolerances; for the free speaker, how often that solver, started
from our result, still went lower by more than 1e-9 (so that ours was no minimum), and how often it ended in
another, lower valley when started where we did.
"""

import argparse
import time

import numpy as np
from scipy.optimize import minimize

from tonguetrack import load_model
from tonguetrack.model import TongueModel
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.session import Energy
from tonguetrack.tracker.solver import FixedSpeakerSolver, FreeSpeakerSolver

TIGHT = {"ftol": 1e-16, "gtol": 1e-10, "maxiter": 5000, "maxfun": 50000, "maxcor": 20}


def random_energy(random: np.random.Generator) -> Energy:
    def pick(*values: float) -> float:
        return float(random.choice(values))

    betas, gammas = (
        (pick(0.05, 0.5, 5, 50), pick(0.05, 0.5, 5, 50)),
        (pick(0, 0.5, 5, 50), pick(0, 0.5, 5, 50)),
    )
    return Energy(pick(0.1, 0.5, 1, 2, 10), *betas, *gammas, box=pick(0.2, 1, 2, 5, 8))


def random_coils(shape: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """The model's own points, disturbed in one of several ways; never without any coil."""
    disturbances = (
        lambda: random.normal(scale=0.3, size=shape.shape),
        lambda: random.standard_cauchy(shape.shape),
        lambda: shape[:1] - shape,  # all at one place
        lambda: random.normal(scale=50.0, size=3),
        lambda: random.normal(scale=1e6, size=3),
        lambda: 0.0,
    )
    coils = shape + disturbances[random.integers(len(disturbances))]()
    gone = random.random(len(coils)) < 0.25
    gone[0] = False
    coils[gone] = np.nan
    return np.ascontiguousarray(coils)


def excess_over(reference: float, ours: float) -> float:
    """Relative, but never to an energy so small (mm^2) that only rounding is left of it."""
    return (ours - reference) / max(reference, 1e-6)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--model")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    args = parser.parse_args()
    model: TongueModel = load_model(args.model) if args.model else bundled_model()
    random = np.random.default_rng(args.seed)
    m = model.speaker.size
    mean = np.concatenate([model.speaker.mean, model.pose.mean])
    sigma = np.concatenate([model.speaker.sigma, model.pose.sigma])
    frames = not_minimal = other_valley = 0
    worst_fixed = worst_free = 0.0
    end = time.monotonic() + args.seconds
    while time.monotonic() < end:
        frames += 1
        energy = random_energy(random)
        at_coils = model.at(random.integers(0, model.vertex_count, size=random.integers(1, 9)).tolist())
        truth = mean + random.choice([0.0, 0.3, 1.0, 3.0]) * sigma * random.standard_t(3, size=len(mean))
        coils = random_coils(at_coils.vertices(truth[:m], truth[m:]), random)
        low, high = mean - energy.box * sigma, mean + energy.box * sigma
        at_box = np.where(random.random(len(mean)) < 0.5, low, high)
        start = [np.clip(truth, low, high), at_box, random.uniform(low, high)][random.integers(3)]
        rows = np.repeat(~np.isnan(coils[:, 0]), 3)
        core, origin, target = at_coils.core[:, :, rows], at_coils.origin[rows], coils.ravel()[rows]
        beta = np.repeat([energy.beta_speaker, energy.beta_pose], [m, len(mean) - m])
        gamma = np.repeat([energy.gamma_speaker, energy.gamma_pose], [m, len(mean) - m])

        def value(
            x, core=core, origin=origin, target=target, start=start, beta=beta, gamma=gamma, energy=energy
        ):
            js, jp = np.tensordot(x[m:], core, axes=(0, 1)), np.tensordot(x[:m], core, axes=1)
            residual = origin + x[m:] @ jp - target
            share = 3.0 * energy.alpha / len(target)
            total = share * residual @ residual + beta @ (x - mean) ** 2 + gamma @ (x - start) ** 2
            slope = 2.0 * share * np.concatenate([js @ residual, jp @ residual])
            return total, slope + 2.0 * beta * (x - mean) + 2.0 * gamma * (x - start)

        def fixed_value(pose, value=value, start=start):
            total, slope = value(np.concatenate([start[:m], pose]))
            return total, slope[m:]

        bounds = np.column_stack([low, high])
        fixed = FixedSpeakerSolver(at_coils.for_speaker(start[:m]), energy)
        fixed.weights[:] = start[m:]
        fixed._started = True
        fixed.solve(coils)
        found = minimize(
            fixed_value, start[m:], jac=True, method="L-BFGS-B", bounds=bounds[m:], options=TIGHT
        )
        worst_fixed = max(worst_fixed, excess_over(found.fun, fixed_value(fixed.weights)[0]))

        free = FreeSpeakerSolver(at_coils, energy)
        free.weights[:] = start
        free._started, free._status = True, 1
        free.solve(coils)
        ours = value(free.weights)[0]
        lower = minimize(value, free.weights, jac=True, method="L-BFGS-B", bounds=bounds, options=TIGHT)
        excess = excess_over(lower.fun, ours)
        worst_free = max(worst_free, excess)
        not_minimal += excess > 1e-9
        again = minimize(value, start, jac=True, method="L-BFGS-B", bounds=bounds, options=TIGHT)
        other_valley += again.fun < ours * (1.0 - 1e-9)
    print(f"{model.name}, seed {args.seed}: {frames} frames")
    print(f"fixed speaker: largest excess {worst_fixed:.1e}")
    print(
        f"free speaker: {not_minimal} not minimal (largest excess {worst_free:.1e}), {other_valley} in a higher valley"
    )


if __name__ == "__main__":
    main()
