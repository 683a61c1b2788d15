"""The tracking energy and its exact minimisers, compiled. Numbers in, numbers out, nothing allocated.

    E(s, p) = alpha/n sum_i |v_i(s, p) - q_i|^2
              + beta_s |s - s_mean|^2 + beta_p |p - p_mean|^2
              + gamma_s |s - s_previous|^2 + gamma_p |p - p_previous|^2
    subject to low <= (s, p) <= high

over the n coils that are present in the frame (paper, section "Using the model for tracking"; mm, raw
weights). A coil is missing when its first coordinate is NaN.

With the speaker fixed, E is a convex quadratic of the K coefficients: one box-constrained quadratic
programme, solved exactly by an active set. With the speaker free, E is bilinear inside the square:
Newton steps on the exact Hessian, each one such programme, Gauss-Newton or a shifted Hessian where the
exact one is not positive definite; along any line E is a quartic, so a step is judged without
evaluating the model again.

Arrays are C-contiguous float64 with these names everywhere:
    coils (n, 3) mm, NaN = missing
    base (3n,), directions (K, 3n), gram (n, K, K): a fixed speaker's model at the coils' vertices
    base (3n,), core (m, k, 3n): the multilinear model at the coils' vertices
    box (3, K): rows mean, low, high
    weights (K,): previous weights on entry, the minimiser on return
    scratch: work space made once by `*_scratch`
The functions are compiled lazily and cached; their argument types never change, so that nothing is
compiled while frames arrive.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# Division by zero gives inf instead of raising, which spares a test in every division. No fast mathematics: sums
# in another order would be a tenth faster, but a live frame and a recorded one would no longer give the same bits.
OPTIONS: dict[str, Any] = {"cache": True, "inline": "never", "error_model": "numpy"}

# A step is the last one when it promises to lower the energy by less than this share of it. An exact Newton
# step whose promise holds to within the share KEPT_PROMISE leaves about the square of that share, so it may
# promise more.
RELATIVE_DECREASE = 1e-12
EXACT_NEWTON_DECREASE = 1e-7
KEPT_PROMISE = 0.05
MAX_NEWTON_STEPS = 500  # ordinary frames take 3 to 5, the worst of curved valleys some hundred
MAX_ACTIVE_SET_STEPS = 200
# Gauss-Newton is cheap far from the minimum, but only linear near it where residuals are large.
GAUSS_NEWTON_STEPS = 6

# No coil is a thousand kilometres away: beyond is a damaged number, whose square would swamp every other.
FARTHEST_MM = 1e9

STATUS_LOST, STATUS_OK, STATUS_HELD = 0, 1, 2
INDEFINITE, SOLVED = 0, 1


def quadratic_scratch(size: int) -> np.ndarray:
    """Work space of `minimise_quadratic_in_box`: (size + 4, size)."""
    return np.zeros((size + 4, size))


def fixed_scratch(size: int) -> np.ndarray:
    """Work space of `solve_fixed_speaker`: Hessian, linear term, the quadratic programme's own, previous."""
    return np.zeros((2 * size + 6, size))


def free_scratch(speaker_size: int, pose_size: int, coils: int) -> tuple[np.ndarray, np.ndarray]:
    """Work space of `solve_free_speaker`: one array in weights, one in coil coordinates."""
    size = speaker_size + pose_size
    return np.zeros((2 * size + 12, size)), np.zeros((size + 3, 3 * coils))


@njit(**OPTIONS)
def minimise_quadratic_in_box(hessian, linear, low, high, x, scratch):
    """Minimises 1/2 x'Hx - linear'x over the box, from x, in place.

    Returns SOLVED when x is the minimiser; INDEFINITE when H is not positive definite on a face of the
    box that had to be minimised, or holds what is not a number: x is then the best point reached, possibly
    the start. After MAX_ACTIVE_SET_STEPS faces, far more than random programmes ever need, it returns the
    best point reached as SOLVED.

    Primal active set: a Newton step on the free coordinates up to the first bound in the way, which is
    then held; at a face's minimum the held bound that pulls inwards most is let go. Bounds that hold
    already at the start stay held, so that H need only be positive definite where x can move.
    """
    size = x.shape[0]
    factor = scratch[:size]
    step = scratch[size]
    gradient = scratch[size + 1]
    held = scratch[size + 2]  # -1 at the lower bound, +1 at the upper, 0 free
    index = scratch[size + 3]  # the free coordinates, as floats
    for i in range(size):
        if x[i] < low[i]:
            x[i] = low[i]
        elif x[i] > high[i]:
            x[i] = high[i]
    for visit in range(MAX_ACTIVE_SET_STEPS):
        for i in range(size):
            total = -linear[i]
            for j in range(size):
                total += hessian[i, j] * x[j]
            gradient[i] = total
        if visit == 0:
            for i in range(size):
                held[i] = 0.0
                if x[i] == low[i] and gradient[i] >= 0.0:
                    held[i] = -1.0
                elif x[i] == high[i] and gradient[i] <= 0.0:
                    held[i] = 1.0
        free = 0
        for i in range(size):
            if held[i] == 0.0:
                index[free] = i
                free += 1
        if free > 0:
            # Cholesky of the free block, then the Newton step on it.
            for a in range(free):
                i = int(index[a])
                for b in range(a + 1):
                    j = int(index[b])
                    total = hessian[i, j]
                    for c in range(b):
                        total -= factor[a, c] * factor[b, c]
                    if a == b:
                        if not total > 1e-14 * abs(hessian[i, i]):  # also where it is not a number
                            return INDEFINITE
                        factor[a, a] = np.sqrt(total)
                    else:
                        factor[a, b] = total / factor[b, b]
            for a in range(free):
                total = -gradient[int(index[a])]
                for c in range(a):
                    total -= factor[a, c] * step[c]
                step[a] = total / factor[a, a]
            for a in range(free - 1, -1, -1):
                total = step[a]
                for c in range(a + 1, free):
                    total -= factor[c, a] * step[c]
                step[a] = total / factor[a, a]
            # The largest share of the step that stays inside.
            share = 1.0
            blocking = -1
            for a in range(free):
                i = int(index[a])
                if step[a] > 0.0:
                    room = high[i] - x[i]
                elif step[a] < 0.0:
                    room = low[i] - x[i]
                else:
                    continue
                if abs(step[a]) * share > abs(room):
                    share = room / step[a]
                    blocking = a
            for a in range(free):
                i = int(index[a])
                x[i] = min(max(x[i] + share * step[a], low[i]), high[i])
            if blocking >= 0:
                i = int(index[blocking])
                if step[blocking] > 0.0:
                    x[i] = high[i]
                    held[i] = 1.0
                else:
                    x[i] = low[i]
                    held[i] = -1.0
                continue
            for i in range(size):
                if held[i] != 0.0:
                    total = -linear[i]
                    for j in range(size):
                        total += hessian[i, j] * x[j]
                    gradient[i] = total
        worst = 0.0
        release = -1
        for i in range(size):
            if held[i] != 0.0 and low[i] < high[i]:
                # At the upper bound the gradient must be <= 0, at the lower >= 0.
                pull = held[i] * gradient[i]
                if pull > worst + 1e-13 * (abs(linear[i]) + 1e-300):
                    worst = pull
                    release = i
        if release < 0:
            return SOLVED
        held[release] = 0.0
    return SOLVED


@njit(**OPTIONS)
def _present(coils):
    """How many of the coils (n, 3) are there."""
    present = 0
    for i in range(coils.shape[0]):
        if not np.isnan(coils[i, 0]):
            present += 1
    return present


@njit(**OPTIONS)
def coil_residuals(coils, base, directions, weights, residuals):
    """residuals (n,): distance in mm of each coil from its vertex, NaN where the coil is missing.
    Returns their mean over the present coils (NaN without any)."""
    size = weights.shape[0]
    total = 0.0
    present = 0
    for i in range(coils.shape[0]):
        if np.isnan(coils[i, 0]):
            residuals[i] = np.nan
            continue
        squared = 0.0
        for axis in range(3):
            row = 3 * i + axis
            value = base[row] - coils[i, axis]
            for k in range(size):
                value += directions[k, row] * weights[k]
            squared += value * value
        residuals[i] = np.sqrt(squared)
        total += residuals[i]
        present += 1
    return total / present if present > 0 else np.nan


@njit(**OPTIONS)
def finish_pose(weights, mean, sigma, states, normalised):
    """Fills normalised (K,) from weights (K,); how many of states (n,) int64 are 0, the coils that counted.

    Compiled, because after the pause between two frames five calls into numpy cost more than the solve.
    """
    for k in range(len(weights)):
        normalised[k] = (weights[k] - mean[k]) / sigma[k]
    counted = 0
    for state in states:
        counted += state == 0
    return counted


@njit(**OPTIONS)
def free_residuals(coils, base, core, weights, residuals):
    """`coil_residuals` for the multilinear model; weights (m + n,) = speaker weights, then pose weights."""
    speakers, poses, _ = core.shape
    for i in range(coils.shape[0]):
        if np.isnan(coils[i, 0]):
            residuals[i] = np.nan
            continue
        squared = 0.0
        for axis in range(3):
            row = 3 * i + axis
            value = base[row] - coils[i, axis]
            for l in range(speakers):
                for k in range(poses):
                    value += weights[l] * weights[speakers + k] * core[l, k, row]
            squared += value * value
        residuals[i] = np.sqrt(squared)


@njit(**OPTIONS)
def coil_grams(directions, gram):
    """gram (n, K, K): the products of the directions at each coil, constant for a fixed speaker."""
    size = directions.shape[0]
    for i in range(gram.shape[0]):
        for a in range(size):
            for b in range(size):
                total = 0.0
                for row in range(3 * i, 3 * i + 3):
                    total += directions[a, row] * directions[b, row]
                gram[i, a, b] = total


@njit(**OPTIONS)
def solve_fixed_speaker(
    coils, base, directions, gram, box, energy, coherent, weights, residuals, scratch, result
):
    """One frame with the speaker fixed. energy: (alpha, beta, gamma); coherent: False drops gamma.

    result (2,): energy, mean residual in mm. Returns the status; with no coil present the weights stay.
    """
    size = weights.shape[0]
    alpha = energy[0]
    beta = energy[1]
    gamma = energy[2] if coherent else 0.0
    hessian = scratch[:size]
    linear = scratch[size]
    present = _present(coils)
    if present == 0:
        result[0] = np.nan
        result[1] = coil_residuals(coils, base, directions, weights, residuals)
        return STATUS_HELD
    share = 2.0 * alpha / present
    for a in range(size):
        for b in range(size):
            hessian[a, b] = 0.0
        hessian[a, a] = 2.0 * (beta + gamma)
        linear[a] = 2.0 * (beta * box[0, a] + gamma * weights[a])
    for i in range(coils.shape[0]):
        if np.isnan(coils[i, 0]):
            continue
        for a in range(size):
            for b in range(size):
                hessian[a, b] += share * gram[i, a, b]
            total = 0.0
            for axis in range(3):
                row = 3 * i + axis
                total += directions[a, row] * (coils[i, axis] - base[row])
            linear[a] += share * total
    previous = scratch[2 * size + 5]
    for a in range(size):
        previous[a] = weights[a]
    ridge = 0.0
    while SOLVED != minimise_quadratic_in_box(
        hessian, linear, box[1], box[2], weights, scratch[size + 1 : 2 * size + 5]
    ):
        # Without bias and coherence too few coils leave directions undetermined: the smallest ridge
        # that float64 can factorise picks the solution next to the previous weights.
        trace = 0.0
        for a in range(size):
            weights[a] = previous[a]
            trace += abs(hessian[a, a])
        if not np.isfinite(trace):
            break
        added = max(1e-10 * trace, 1e-12) if ridge == 0.0 else 9.0 * ridge
        ridge += added
        for a in range(size):
            hessian[a, a] += added
            linear[a] += added * previous[a]
    mean_residual = coil_residuals(coils, base, directions, weights, residuals)
    total = 0.0
    for i in range(coils.shape[0]):
        if not np.isnan(residuals[i]):
            total += residuals[i] * residuals[i]
    total *= alpha / present
    for a in range(size):
        off_mean = weights[a] - box[0, a]
        off_previous = weights[a] - previous[a]
        total += beta * off_mean * off_mean + gamma * off_previous * off_previous
    result[0] = total
    result[1] = mean_residual
    return STATUS_OK


@njit(**OPTIONS)
def _jacobian_and_residual(coils, base, core, weights, jacobian, residual):
    """jacobian (m + n, 3n): d v / d weight; residual (3n,): v - q. Rows of missing coils are zero."""
    speakers, poses, rows = core.shape
    for a in range(speakers + poses):
        for row in range(rows):
            jacobian[a, row] = 0.0
    for l in range(speakers):
        speaker_weight = weights[l]
        for k in range(poses):
            pose_weight = weights[speakers + k]
            for row in range(rows):
                value = core[l, k, row]
                jacobian[l, row] += pose_weight * value
                jacobian[speakers + k, row] += speaker_weight * value
    for i in range(coils.shape[0]):
        for axis in range(3):
            residual[3 * i + axis] = base[3 * i + axis] - coils[i, axis]
    for l in range(speakers):
        for row in range(rows):
            residual[row] += weights[l] * jacobian[l, row]
    for i in range(coils.shape[0]):
        if np.isnan(coils[i, 0]):
            for row in range(3 * i, 3 * i + 3):
                residual[row] = 0.0
                for a in range(speakers + poses):
                    jacobian[a, row] = 0.0


@njit(**OPTIONS)
def free_energy(coils, base, core, box, alpha, beta, gamma, previous, weights, jacobian, residual):
    """E at `weights`; leaves the Jacobian and the residual of that point behind. beta, gamma: (m + n,)."""
    _jacobian_and_residual(coils, base, core, weights, jacobian, residual)
    present = _present(coils)
    total = 0.0
    for row in range(residual.shape[0]):
        total += residual[row] * residual[row]
    total *= alpha / present
    for a in range(weights.shape[0]):
        off_mean = weights[a] - box[0, a]
        off_previous = weights[a] - previous[a]
        total += beta[a] * off_mean * off_mean + gamma[a] * off_previous * off_previous
    return total


@njit(**OPTIONS)
def free_gradient_and_hessian(
    coils, core, box, alpha, beta, gamma, previous, weights, jacobian, residual, exact, gradient, hessian
):
    """Derivatives of `free_energy` from the Jacobian and residual it left. exact: with the bilinear term
    of the Hessian; else Gauss-Newton's, which is never indefinite."""
    speakers, poses, rows = core.shape
    present = _present(coils)
    share = 2.0 * alpha / present
    for a in range(weights.shape[0]):
        total = 0.0
        for row in range(rows):
            total += jacobian[a, row] * residual[row]
        gradient[a] = share * total + 2.0 * (
            beta[a] * (weights[a] - box[0, a]) + gamma[a] * (weights[a] - previous[a])
        )
        for b in range(a + 1):
            total = 0.0
            for row in range(rows):
                total += jacobian[a, row] * jacobian[b, row]
            hessian[a, b] = share * total
    if exact:
        for l in range(speakers):
            for k in range(poses):
                total = 0.0
                for row in range(rows):
                    total += residual[row] * core[l, k, row]
                hessian[speakers + k, l] += share * total
    for a in range(weights.shape[0]):
        hessian[a, a] += 2.0 * (beta[a] + gamma[a])
        for b in range(a):
            hessian[b, a] = hessian[a, b]


@njit(**OPTIONS)
def _quartic_along_step(
    coils, core, share, beta, gamma, weights, target, jacobian, residual, first_order, second_order
):
    """The coefficients of t^2, t^3, t^4 of E(weights + t (target - weights)) - E(weights); that of t is the slope.

    The residual along the step is residual + t first_order + t^2 second_order, exactly: v is bilinear.
    """
    speakers, poses, rows = core.shape
    for row in range(rows):
        first_order[row] = 0.0
        second_order[row] = 0.0
    second = 0.0
    for a in range(weights.shape[0]):
        delta = target[a] - weights[a]
        second += (beta[a] + gamma[a]) * delta * delta
        for row in range(rows):
            first_order[row] += delta * jacobian[a, row]
    for l in range(speakers):
        for k in range(poses):
            delta = (target[l] - weights[l]) * (target[speakers + k] - weights[speakers + k])
            for row in range(rows):
                second_order[row] += delta * core[l, k, row]
    third = 0.0
    fourth = 0.0
    for i in range(coils.shape[0]):
        if np.isnan(coils[i, 0]):
            continue
        for row in range(3 * i, 3 * i + 3):
            first, bend = first_order[row], second_order[row]
            second += share * (first * first + 2.0 * residual[row] * bend)
            third += share * 2.0 * first * bend
            fourth += share * bend * bend
    return second, third, fourth


@njit(**OPTIONS)
def _descend(coils, base, core, box, alpha, beta, gamma, previous, weights, scratch, coil_scratch):
    """Minimises E over the box from `weights`, in place. Returns E at the minimiser."""
    size = weights.shape[0]
    hessian = scratch[:size]
    gradient = scratch[size]
    linear = scratch[size + 1]
    target = scratch[size + 2]
    quadratic = scratch[size + 3 : 2 * size + 7]
    jacobian = coil_scratch[:size]
    residual = coil_scratch[size]
    first_order = coil_scratch[size + 1]
    second_order = coil_scratch[size + 2]
    for a in range(size):
        weights[a] = min(max(weights[a], box[1, a]), box[2, a])
    present = _present(coils)
    share = alpha / present
    gauss_newton_steps = GAUSS_NEWTON_STEPS  # the first resort where the Hessian is not positive definite
    last_shift = 0.0  # the next one begins lower: in a curved valley a large shift means tiny steps
    for _ in range(MAX_NEWTON_STEPS):
        energy = free_energy(
            coils, base, core, box, alpha, beta, gamma, previous, weights, jacobian, residual
        )
        shift = 0.0
        exact = True
        free_gradient_and_hessian(
            coils, core, box, alpha, beta, gamma, previous, weights, jacobian, residual, exact, gradient,
            hessian,
        )  # fmt: skip
        while True:
            for a in range(size):
                total = -gradient[a]
                for b in range(size):
                    total += hessian[a, b] * weights[b]
                linear[a] = total
                target[a] = weights[a]
            outcome = minimise_quadratic_in_box(hessian, linear, box[1], box[2], target, quadratic)
            slope = 0.0
            curvature = 0.0
            for a in range(size):
                step = target[a] - weights[a]
                slope += gradient[a] * step
                for b in range(size):
                    curvature += step * hessian[a, b] * (target[b] - weights[b])
            promised = -(slope + 0.5 * curvature)
            if outcome == SOLVED and slope <= 0.0:
                stationary_if_small = True
                break
            # The minimum of a smaller face is a step too, if it leads down noticeably.
            if slope < 0.0 and promised > 1e-6 * energy:
                stationary_if_small = False
                break
            if gauss_newton_steps > 0 and exact:
                exact = False
                gauss_newton_steps -= 1
                free_gradient_and_hessian(
                    coils, core, box, alpha, beta, gamma, previous, weights, jacobian, residual, exact, gradient,
                    hessian,
                )  # fmt: skip
                continue
            before = shift
            if shift == 0.0:
                if not exact:
                    exact = True
                    free_gradient_and_hessian(
                        coils, core, box, alpha, beta, gamma, previous, weights, jacobian, residual, exact, gradient,
                        hessian,
                    )  # fmt: skip
                for a in range(size):
                    shift += abs(hessian[a, a])
                shift = max(1e-3 * shift / size if last_shift == 0.0 else last_shift / 16.0, 1e-12)
            else:
                shift *= 8.0
            for a in range(size):
                hessian[a, a] += shift - before
            if shift > 1e30:
                return energy
        second, third, fourth = _quartic_along_step(
            coils, core, share, beta, gamma, weights, target, jacobian, residual, first_order, second_order
        )
        length = 1.0
        change = slope + second + third + fourth
        while change > 1e-4 * length * slope and length > 1e-12:
            length *= 0.5
            change = length * (slope + length * (second + length * (third + length * fourth)))
        if shift > 0.0 and length == 1.0:
            # A shifted step is a cautious one: go on while that lowers the energy, up to the box.
            while True:
                longer = 2.0 * length
                for a in range(size):
                    moved = weights[a] + longer * (target[a] - weights[a])
                    if moved < box[1, a] or moved > box[2, a]:
                        longer = 0.0
                        break
                further = longer * (slope + longer * (second + longer * (third + longer * fourth)))
                if further >= change:  # also at the box, where `further` is 0
                    break
                length = longer
                change = further
        if change > 0.0:
            return energy
        if shift > 0.0:
            last_shift = shift if length >= 1.0 else 16.0 * shift
        for a in range(size):
            moved = target[a] if length == 1.0 else weights[a] + length * (target[a] - weights[a])
            weights[a] = min(max(moved, box[1, a]), box[2, a])
        kept = exact and shift == 0.0 and abs(change + promised) <= KEPT_PROMISE * promised
        enough = EXACT_NEWTON_DECREASE if kept else RELATIVE_DECREASE
        if stationary_if_small and promised <= enough * energy + 1e-24:
            return energy + change
        if not exact and -change < 0.25 * promised:
            gauss_newton_steps = 0
    return free_energy(coils, base, core, box, alpha, beta, gamma, previous, weights, jacobian, residual)


@njit(**OPTIONS)
def solve_free_speaker(
    coils, base, core, box, energy, coherent, restart, weights, residuals, scratch, coil_scratch, result
):
    """One frame with speaker and pose free; weights (m + n,) = speaker weights, then pose weights.

    energy: (alpha, beta_s, beta_p, gamma_s, gamma_p); coherent: False drops gamma.
    restart: also descend from the other sign flips of the starting weights and keep the best, because
    v(s, p) = v(-s, -p) puts mirror minima inside a wide box. A flip that ends elsewhere must be lower
    by more than rounding to be taken. result (2,): energy, mean residual in mm. Returns the status.
    """
    size = weights.shape[0]
    speakers = core.shape[0]
    present = _present(coils)
    beta = scratch[2 * size + 7]
    gamma = scratch[2 * size + 8]
    previous = scratch[2 * size + 9]
    start = scratch[2 * size + 10]
    candidate = scratch[2 * size + 11]
    for a in range(size):
        beta[a] = energy[1] if a < speakers else energy[2]
        gamma[a] = (energy[3] if a < speakers else energy[4]) if coherent else 0.0
        previous[a] = weights[a]
        start[a] = weights[a]
    if present > 0:
        best = _descend(
            coils, base, core, box, energy[0], beta, gamma, previous, weights, scratch, coil_scratch
        )
        if restart:
            for flip in range(1, 4):
                for a in range(size):
                    negate = flip & 1 if a < speakers else flip & 2
                    candidate[a] = -start[a] if negate else start[a]
                value = _descend(
                    coils, base, core, box, energy[0], beta, gamma, previous, candidate, scratch, coil_scratch
                )
                if value < best * (1.0 - 1e-9):
                    best = value
                    for a in range(size):
                        weights[a] = candidate[a]
        result[0] = best
    else:
        result[0] = np.nan
    directions = coil_scratch[:size]
    residual = coil_scratch[size]
    _jacobian_and_residual(coils, base, core, weights, directions, residual)
    total = 0.0
    for i in range(coils.shape[0]):
        if np.isnan(coils[i, 0]):
            residuals[i] = np.nan
            continue
        squared = 0.0
        for row in range(3 * i, 3 * i + 3):
            squared += residual[row] * residual[row]
        residuals[i] = np.sqrt(squared)
        total += residuals[i]
    result[1] = total / present if present > 0 else np.nan
    return STATUS_OK if present > 0 else STATUS_HELD


@njit(**OPTIONS)
def _place(x, y, z, rotation, translation, project, coil):
    """coil (3,) in the model frame = rotation (3, 3) (x, y, z) + translation (3,), mm.

    project: set the lateral coordinate to the mid-sagittal plane's 0. With any coordinate that is not a number, or
    beyond FARTHEST_MM, before or after, the coil becomes all NaN.
    """
    usable = abs(x) <= FARTHEST_MM and abs(y) <= FARTHEST_MM and abs(z) <= FARTHEST_MM
    for axis in range(3):
        coil[axis] = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z + translation[axis]
        usable = usable and abs(coil[axis]) <= FARTHEST_MM
    if not usable:
        for axis in range(3):
            coil[axis] = np.nan
    elif project:
        coil[0] = 0.0


@njit(**OPTIONS)
def prepare_frame(raw, picked, rotation, translation, project, coils):
    """coils (n, 3) in the model frame from a source's raw (all coils, 3); picked (n,): indices into raw."""
    for i in range(picked.shape[0]):
        x, y, z = raw[picked[i], 0], raw[picked[i], 1], raw[picked[i], 2]
        _place(x, y, z, rotation, translation, project, coils[i])


@njit(**OPTIONS)
def prepare_on_moving_head(
    raw, head_rotation, head_translation, picked, rotation, translation, project, coils
):
    """`prepare_frame` after the head's motion was taken out: rest = head_rotation' (raw - head_translation).

    A frame whose motion is not known (NaN) has no coils.
    """
    for i in range(picked.shape[0]):
        x = y = z = 0.0
        for row in range(3):
            off = raw[picked[i], row] - head_translation[row]
            x += head_rotation[row, 0] * off
            y += head_rotation[row, 1] * off
            z += head_rotation[row, 2] * off
        _place(x, y, z, rotation, translation, project, coils[i])


@njit(**OPTIONS)
def prepare_frames(raw, picked, rotation, translation, project, coils):
    """`prepare_frame` for raw (frames, all coils, 3) into coils (frames, n, 3)."""
    for frame in range(raw.shape[0]):
        prepare_frame(raw[frame], picked, rotation, translation, project, coils[frame])


@njit(**OPTIONS)
def prepare_frames_on_moving_head(
    raw, head_rotations, head_translations, picked, rotation, translation, project, coils
):
    """`prepare_on_moving_head` for raw (frames, all coils, 3) into coils (frames, n, 3)."""
    for frame in range(raw.shape[0]):
        prepare_on_moving_head(
            raw[frame], head_rotations[frame], head_translations[frame], picked, rotation, translation, project,
            coils[frame],
        )  # fmt: skip


@njit(**OPTIONS)
def track_fixed_speaker(
    coils,
    base,
    directions,
    gram,
    box,
    energy,
    coherent,
    weights,
    residuals,
    scratch,
    results,
    tracked,
    statuses,
):
    """`solve_fixed_speaker` over coils (frames, n, 3), each frame from the one before.

    coherent: whether the first frame already has a previous one. tracked (frames, K), residuals
    (frames, n), results (frames, 2), statuses (frames,) are filled.
    """
    for frame in range(coils.shape[0]):
        status = solve_fixed_speaker(
            coils[frame], base, directions, gram, box, energy, coherent, weights, residuals[frame], scratch,
            results[frame],
        )  # fmt: skip
        coherent = coherent or status == STATUS_OK
        statuses[frame] = status
        for a in range(weights.shape[0]):
            tracked[frame, a] = weights[a]


@njit(**OPTIONS)
def track_free_speaker(
    coils,
    base,
    core,
    box,
    energy,
    coherent,
    weights,
    residuals,
    scratch,
    coil_scratch,
    results,
    tracked,
    statuses,
):
    """`solve_free_speaker` over coils (frames, n, 3); restarts where nothing was tracked before."""
    restart = not coherent
    for frame in range(coils.shape[0]):
        status = solve_free_speaker(
            coils[frame], base, core, box, energy, coherent, restart, weights, residuals[frame], scratch,
            coil_scratch, results[frame],
        )  # fmt: skip
        coherent = coherent or status == STATUS_OK
        restart = status != STATUS_OK
        statuses[frame] = status
        for a in range(weights.shape[0]):
            tracked[frame, a] = weights[a]
