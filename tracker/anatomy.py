"""One speaker for many frames, estimated jointly: the speaker weights that explain all frames at once.

    F(s, p_1 .. p_T) = sum_t [ alpha/n_t sum_i w_ti |v_i(s, p_t) - q_ti|^2 + beta_p |p_t - p_mean|^2 ]
                       + T_eff beta_s |s - s_mean|^2
    subject to |s - s_mean| <= h sigma_s and |p_t - p_mean| <= h sigma_p for every weight

over the T frames that have a coil, n_t of them in frame t (mm, raw weights; alpha, beta and h as in
`Energy`). It is the tracking energy of the paper, summed over frames that share their speaker, without
coherence. w_ti is how far a coil's sample is trusted: 1, or less for an outlier.

For a given s every p_t is a small quadratic programme in a box, solved exactly, so that F is minimised over
s alone: f(s) = min_p F(s, p). Its gradient is that of F at the best poses, and its Hessian what is left when
each p_t is eliminated (Schur complement over the weights of p_t that are not held by their box). A Newton
step on f is one more quadratic programme, over the box of s; Gauss-Newton where the exact Hessian is not
positive definite; each step is shortened until f falls. Time and memory grow with T, not with T^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from .. import InputError
from ..model.multilinear import TongueModel
from .kernels import INDEFINITE, OPTIONS, coil_grams, minimise_quadratic_in_box, quadratic_scratch
from .pose import FloatArray
from .session import Energy

RELATIVE_DECREASE = 1e-11  # a step that promises less of f than this is not taken
MAX_STEPS = 200  # each descent of ordinary speech takes 3 to 10
SHORTEST_STEP = 1e-9

REWEIGHTINGS = 3
# The distance at which a sample's weight is 1/2, in medians of all samples' distances. On real speakers left out of
# the model, 5 costs clean speech nothing measurable, and samples 50 mm astray do not tell; 3 costs a little.
OUTLIER_MEDIANS = 5.0

# With a smaller share of the coordinates left over, the poses follow the coils wherever they are.
LEAST_SPARE = 0.01

# Without a bias, weights that no coil determines still need one value: this share of the data's curvature
# draws them to their mean, which no determined weight notices.
SMALLEST_BIAS = 1e-9


def bias_frames(frames: int) -> float:
    """T_eff, for how many frames the bias of the speaker counts: for all of them.

    So data and bias stay as the energy of a single frame balances them, and the speaker depends neither on the
    frame rate nor on how long somebody spoke. Independent noise would ask for a constant, but what parts coils and
    vertices is mostly what the model cannot express, and that does not average out with time: on real speakers left
    out of the model, a constant or the square root of T made the whole mesh worse the longer they spoke (from 1 to
    3 s, three coils), while any constant share of T stayed the same. A third of T favours the region under
    the coils, and costs about as much on the rest of the mesh; neither is separated from T by more than the folds'
    scatter. That choice is the user's, by `Energy.beta_speaker`.
    """
    return float(frames)


@dataclass(frozen=True)
class SpeakerEstimate:
    """A speaker, and how well the coils determine it.

    weights: (m,) raw speaker weights.
    covariance: (m, m) of the weights: the inverse of the reduced Hessian, scaled by the variance of the residuals.
        It takes the samples' errors for independent, and knows neither of the box nor of what the biases draw the
        estimate away by. What the model cannot express is no such error: a real speaker is farther off than this.
        Infinite where too few coils are there to contradict the poses.
    sigma: (m,) the square roots of its diagonal, in units of the model's speaker sigma.
    frames: how many frames with a coil it comes from.
    residual_mm: mean distance between coils and vertices, over all samples.
    iterations: Newton steps in all; converged: whether the last descent came to rest.
    """

    weights: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    frames: int
    residual_mm: float
    iterations: int
    converged: bool


class Problem(NamedTuple):
    """What is minimised. coils (T, n, 3) mm; base (3n,), core (m, k, 3n) mm at the coils' vertices;
    speaker_box (3, m), pose_box (3, k): rows mean, low, high; terms (3,): alpha, beta_p, T_eff beta_s; flips (4, m):
    the signs of `sign_flips`."""

    coils: FloatArray
    base: FloatArray
    core: FloatArray
    speaker_box: FloatArray
    pose_box: FloatArray
    terms: FloatArray
    flips: FloatArray


class State(NamedTuple):
    """Where the search stands. speaker (m,); poses (T, k), the best for that speaker; trust (T, n), the w_ti."""

    speaker: FloatArray
    poses: FloatArray
    trust: FloatArray


class Work(NamedTuple):
    """Work space, made once. directions (k, 3n) and gram (n, k, k) belong to the current speaker; of one frame:
    residual (3n,), slopes (m, 3n) d v / d s, cross (m, k), pose_hessian (k, k), pose_linear (k,), eliminated
    (k, m + k); of the reduced system: gradient, linear, target, before (m,), hessian (m, m); ends (2, m): the
    start and the best end; distances (T, n) mm.
    """

    directions: FloatArray
    gram: FloatArray
    residual: FloatArray
    slopes: FloatArray
    cross: FloatArray
    pose_hessian: FloatArray
    pose_linear: FloatArray
    pose_quadratic: FloatArray
    eliminated: FloatArray
    gradient: FloatArray
    linear: FloatArray
    target: FloatArray
    before: FloatArray
    ends: FloatArray
    hessian: FloatArray
    speaker_quadratic: FloatArray
    distances: FloatArray


class Outcome(NamedTuple):
    """energy: F at the end; residual_mm: mean distance over all samples; frames: those with a coil; variance: of one
    coordinate's residual, in units of F, infinite where there are no more coordinates than weights; steps: of
    Newton, in all; at_rest: whether the last descent ended at a minimum."""

    energy: float
    residual_mm: float
    frames: int
    variance: float
    steps: int
    at_rest: bool


@njit(**OPTIONS)
def _present(coils: FloatArray, frame: int) -> int:
    present = 0
    for i in range(coils.shape[1]):
        if not np.isnan(coils[frame, i, 0]):
            present += 1
    return present


@njit(**OPTIONS)
def _set_pose_hessian(problem: Problem, state: State, work: Work, frame: int, share: float) -> None:
    """Half the Hessian of one frame's terms in its pose."""
    size = problem.pose_box.shape[1]
    for a in range(size):
        for b in range(size):
            work.pose_hessian[a, b] = 0.0
        work.pose_hessian[a, a] = problem.terms[1]
    for i in range(problem.coils.shape[1]):
        if np.isnan(problem.coils[frame, i, 0]):
            continue
        factor = share * state.trust[frame, i]
        for a in range(size):
            for b in range(size):
                work.pose_hessian[a, b] += factor * work.gram[i, a, b]


@njit(**OPTIONS)
def _set_residual(problem: Problem, state: State, work: Work, frame: int) -> None:
    """v - q of one frame at its pose; what it holds for missing coils is of no meaning."""
    for i in range(problem.coils.shape[1]):
        for axis in range(3):
            row = 3 * i + axis
            value = problem.base[row] - problem.coils[frame, i, axis]
            for k in range(problem.pose_box.shape[1]):
                value += state.poses[frame, k] * work.directions[k, row]
            work.residual[row] = value


@njit(**OPTIONS)
def _set_directions(problem: Problem, state: State, work: Work) -> None:
    """d v / d p for the state's speaker."""
    speakers, size, rows = problem.core.shape
    for k in range(size):
        for row in range(rows):
            total = 0.0
            for l in range(speakers):
                total += state.speaker[l] * problem.core[l, k, row]
            work.directions[k, row] = total


@njit(**OPTIONS)
def solve_poses(problem: Problem, state: State, work: Work) -> float:
    """The best pose of every frame for the state's speaker, and the distances there. Returns f."""
    speakers, size, _ = problem.core.shape
    _set_directions(problem, state, work)
    coil_grams(work.directions, work.gram)
    energy = 0.0
    for l in range(speakers):
        off_mean = state.speaker[l] - problem.speaker_box[0, l]
        energy += problem.terms[2] * off_mean * off_mean
    for frame in range(problem.coils.shape[0]):
        present = _present(problem.coils, frame)
        if present == 0:
            for i in range(problem.coils.shape[1]):
                work.distances[frame, i] = np.nan
            continue
        share = problem.terms[0] / present
        _set_pose_hessian(problem, state, work, frame, share)
        for k in range(size):
            work.pose_linear[k] = problem.terms[1] * problem.pose_box[0, k]
        for i in range(problem.coils.shape[1]):
            if np.isnan(problem.coils[frame, i, 0]):
                continue
            factor = share * state.trust[frame, i]
            for axis in range(3):
                row = 3 * i + axis
                offset = factor * (problem.coils[frame, i, axis] - problem.base[row])
                for k in range(size):
                    work.pose_linear[k] += offset * work.directions[k, row]
        minimise_quadratic_in_box(
            work.pose_hessian, work.pose_linear, problem.pose_box[1], problem.pose_box[2], state.poses[frame],
            work.pose_quadratic,
        )  # fmt: skip
        _set_residual(problem, state, work, frame)
        for i in range(problem.coils.shape[1]):
            if np.isnan(problem.coils[frame, i, 0]):
                work.distances[frame, i] = np.nan
                continue
            squared = 0.0
            for row in range(3 * i, 3 * i + 3):
                squared += work.residual[row] * work.residual[row]
            work.distances[frame, i] = np.sqrt(squared)
            energy += share * state.trust[frame, i] * squared
        for k in range(size):
            off_mean = state.poses[frame, k] - problem.pose_box[0, k]
            energy += problem.terms[1] * off_mean * off_mean
    return energy


@njit(**OPTIONS)
def _clear_system(problem: Problem, state: State, work: Work) -> None:
    """Sets the reduced system to the speaker's bias alone."""
    for a in range(state.speaker.shape[0]):
        work.gradient[a] = problem.terms[2] * (state.speaker[a] - problem.speaker_box[0, a])
        for b in range(state.speaker.shape[0]):
            work.hessian[a, b] = 0.0
        work.hessian[a, a] = problem.terms[2]


@njit(**OPTIONS)
def _add_frame(problem: Problem, state: State, work: Work, frame: int, share: float, bilinear: float) -> None:
    """Adds half the derivatives in s of one frame's terms, its pose held, to the lower half of the reduced system,
    and sets work.cross to half the mixed ones; bilinear: the share of v's own second derivative in them."""
    speakers, size, rows = problem.core.shape
    _set_residual(problem, state, work, frame)
    for l in range(speakers):
        for row in range(rows):
            work.slopes[l, row] = 0.0
        for k in range(size):
            work.cross[l, k] = 0.0
            pose_weight = state.poses[frame, k]
            for row in range(rows):
                work.slopes[l, row] += pose_weight * problem.core[l, k, row]
    for i in range(problem.coils.shape[1]):
        if np.isnan(problem.coils[frame, i, 0]):
            continue
        factor = share * state.trust[frame, i]
        for row in range(3 * i, 3 * i + 3):
            pull = factor * work.residual[row]
            bend = bilinear * pull
            for l in range(speakers):
                slope = factor * work.slopes[l, row]
                work.gradient[l] += pull * work.slopes[l, row]
                for b in range(l + 1):
                    work.hessian[l, b] += slope * work.slopes[b, row]
                for k in range(size):
                    work.cross[l, k] += slope * work.directions[k, row] + bend * problem.core[l, k, row]


@njit(**OPTIONS)
def reduce_to_speaker(problem: Problem, state: State, work: Work, bilinear: float) -> float:
    """Half the gradient and half the Hessian of f at the state, whose poses must be solved.

    bilinear: 1.0 for the exact Hessian; 0.0 for Gauss-Newton's, which is never indefinite. Returns how many weights
    of the poses the coils determine: one each that the data hold, none each that the bias or nothing holds.
    """
    determined = 0.0
    _clear_system(problem, state, work)
    for frame in range(problem.coils.shape[0]):
        present = _present(problem.coils, frame)
        if present > 0:
            share = problem.terms[0] / present
            _set_pose_hessian(problem, state, work, frame, share)
            _add_frame(problem, state, work, frame, share, bilinear)
            determined += _eliminate_pose(problem, state, work, frame)
    _mirror_lower_half(work.hessian)
    return determined


@njit(**OPTIONS)
def _mirror_lower_half(matrix: FloatArray) -> None:
    for a in range(matrix.shape[0]):
        for b in range(a):
            matrix[b, a] = matrix[a, b]


@njit(**OPTIONS)
def _eliminate_pose(problem: Problem, state: State, work: Work, frame: int) -> float:
    """Takes from the lower half of the reduced Hessian what one frame's pose gives way; as `reduce_to_speaker`.

    Weights at their bound are held there and give no way.
    """
    speakers, size, _ = problem.core.shape
    factor = work.pose_hessian  # overwritten by its own Cholesky factor, on the free weights only
    free = 0
    determined = 0.0
    for k in range(size):
        at = state.poses[frame, k]
        if not problem.pose_box[1, k] < at < problem.pose_box[2, k]:
            continue
        # Row `free` of the factor, of L^-1 cross' and of L^-1, whose columns stand behind the speaker's.
        for l in range(speakers):
            work.eliminated[free, l] = work.cross[l, k]
        for b in range(size):
            work.eliminated[free, speakers + b] = 1.0 if b == free else 0.0
        done = 0
        for j in range(k):
            if not problem.pose_box[1, j] < state.poses[frame, j] < problem.pose_box[2, j]:
                continue
            total = factor[k, j]
            for c in range(done):
                total -= factor[free, c] * factor[done, c]
            # Row `free` <= k of the matrix itself is no longer needed where c <= done is written.
            factor[free, done] = total / factor[done, done]
            done += 1
        total = factor[k, k]
        for c in range(free):
            total -= factor[free, c] * factor[free, c]
        pivot = np.sqrt(total)
        factor[free, free] = pivot
        for column in range(speakers + size):
            total = work.eliminated[free, column]
            for c in range(free):
                total -= factor[free, c] * work.eliminated[c, column]
            work.eliminated[free, column] = total / pivot
        determined += 1.0
        for b in range(free + 1):
            determined -= problem.terms[1] * work.eliminated[free, speakers + b] ** 2
        free += 1
    for a in range(speakers):
        for b in range(a + 1):
            total = 0.0
            for c in range(free):
                total += work.eliminated[c, a] * work.eliminated[c, b]
            work.hessian[a, b] -= total
    return determined


@njit(**OPTIONS)
def _set_target(problem: Problem, state: State, work: Work) -> float:
    """Sets work.target to the minimiser of the quadratic model of f in the box; returns the decrease it promises,
    below 0 where the Hessian is not positive definite."""
    speakers = state.speaker.shape[0]
    for a in range(speakers):
        total = -work.gradient[a]
        for b in range(speakers):
            total += work.hessian[a, b] * state.speaker[b]
        work.linear[a] = total
        work.target[a] = state.speaker[a]
    outcome = minimise_quadratic_in_box(
        work.hessian, work.linear, problem.speaker_box[1], problem.speaker_box[2], work.target,
        work.speaker_quadratic,
    )  # fmt: skip
    if outcome == INDEFINITE:
        return -np.inf
    promised = 0.0
    for a in range(speakers):
        step = work.target[a] - state.speaker[a]
        promised -= 2.0 * work.gradient[a] * step
        for b in range(speakers):
            promised -= step * work.hessian[a, b] * (work.target[b] - state.speaker[b])
    return promised


@njit(**OPTIONS)
def _descend(problem: Problem, state: State, work: Work) -> tuple[float, int, bool]:
    """Minimises f from the state's speaker, in place. Returns f, how many steps, whether it came to rest."""
    speakers = state.speaker.shape[0]
    energy = np.inf
    slope = 0.0
    for l in range(speakers):
        work.target[l] = state.speaker[l]
    for step in range(MAX_STEPS + 1):
        for l in range(speakers):
            work.before[l] = state.speaker[l]
        length = 1.0
        reached = np.inf
        while True:
            for l in range(speakers):
                moved = work.before[l] + length * (work.target[l] - work.before[l])
                state.speaker[l] = min(max(moved, problem.speaker_box[1, l]), problem.speaker_box[2, l])
            reached = solve_poses(problem, state, work)
            if reached <= energy + 1e-4 * length * slope or length < SHORTEST_STEP:
                break
            length *= 0.5
        if not reached < energy:  # nothing is lower by more than rounding, or the energy is not a number
            return reached, step, np.isfinite(reached)
        energy = reached
        promised = -np.inf
        for attempt in range(2):
            reduce_to_speaker(problem, state, work, 1.0 - attempt)
            promised = _set_target(problem, state, work)
            if promised >= 0.0:
                break
        if not promised > RELATIVE_DECREASE * energy:
            return energy, step, promised > -np.inf
        slope = 0.0
        for l in range(speakers):
            slope += 2.0 * work.gradient[l] * (work.target[l] - state.speaker[l])
    return energy, MAX_STEPS, False


@njit(**OPTIONS)
def _median(values: FloatArray) -> float:
    """The median of those of values (T, n) >= 0 that are numbers, to 1e-12 of the largest: by halving."""
    count = 0
    high = 0.0
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            if not np.isnan(values[row, column]):
                count += 1
                high = max(high, values[row, column])
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        below = 0
        for row in range(values.shape[0]):
            for column in range(values.shape[1]):
                if values[row, column] <= middle:
                    below += 1
        if 2 * below >= count:
            high = middle
        else:
            low = middle
    return high


@njit(**OPTIONS)
def _reweigh(state: State, work: Work) -> None:
    """Geman-McClure: w = 1 / (1 + (r/c)^2)^2; c so that it is 1/2 at OUTLIER_MEDIANS times the median distance."""
    half_at = OUTLIER_MEDIANS * _median(work.distances)
    for frame in range(state.trust.shape[0]):
        for i in range(state.trust.shape[1]):
            ratio = work.distances[frame, i] / max(half_at, 1e-9)
            falling = 1.0 + (np.sqrt(2.0) - 1.0) * ratio * ratio
            state.trust[frame, i] = 0.0 if np.isnan(ratio) else 1.0 / (falling * falling)


@njit(**OPTIONS)
def _start_from(attempt: int, problem: Problem, state: State, work: Work) -> None:
    """Sets the poses to the mean, and the speaker to the start (attempt 0), or else to the one who explains the coils
    best with the mean pose in every frame, its signs changed as the attempt's row of flips has it."""
    for frame in range(state.poses.shape[0]):
        for k in range(state.poses.shape[1]):
            state.poses[frame, k] = problem.pose_box[0, k]
    for l in range(state.speaker.shape[0]):
        low, high = problem.speaker_box[1, l], problem.speaker_box[2, l]
        state.speaker[l] = min(max(work.ends[0, l], low), high)
    if attempt > 0:
        _set_directions(problem, state, work)
        _clear_system(problem, state, work)
        for frame in range(state.poses.shape[0]):
            present = _present(problem.coils, frame)
            if present > 0:
                _add_frame(problem, state, work, frame, problem.terms[0] / present, 0.0)
        _mirror_lower_half(work.hessian)
        if _set_target(problem, state, work) > 0.0:
            for l in range(state.speaker.shape[0]):
                state.speaker[l] = problem.flips[attempt - 1, l] * work.target[l]


@njit(nogil=True, **OPTIONS)
def estimate(problem: Problem, state: State, work: Work, first: bool, reweightings: int) -> Outcome:
    """From the state's speaker to the best one, in place, without the interpreter's lock.

    F has several minima, because signs can change in pairs (`sign_flips`). It descends from the start and from the
    speaker of the mean pose (`_start_from`), where no sign has changed; the first time from its flips too. The
    lowest end is kept, and compared once more when the trust was taken for the first time.
    reweightings: how often the trust is taken anew from the distances, and f minimised again. Leaves half the
    Gauss-Newton Hessian of f in work.hessian.
    """
    speakers = state.speaker.shape[0]
    for frame in range(state.trust.shape[0]):
        for i in range(state.trust.shape[1]):
            state.trust[frame, i] = 1.0
    attempts = 1 + (problem.flips.shape[0] if first else 1)
    lowest = np.inf
    energy = np.inf
    steps = 0
    at_rest = False
    for turn in range(1 + reweightings):
        if turn > 0:
            _reweigh(state, work)
        for l in range(speakers):
            work.ends[0, l] = state.speaker[l]
        starts = attempts if turn < 2 else 0  # outliers may have had a say in which end was lowest
        for attempt in range(starts + 1):
            if attempt < starts:
                _start_from(attempt, problem, state, work)
            elif starts > 0:
                for l in range(speakers):
                    state.speaker[l] = work.ends[1, l]
            energy, more, at_rest = _descend(problem, state, work)
            steps += more
            if attempt == 0 or (attempt < starts and energy < lowest * (1.0 - 1e-9)):
                lowest = energy
                for l in range(speakers):
                    work.ends[1, l] = state.speaker[l]
    determined = reduce_to_speaker(problem, state, work, 0.0) + speakers
    frames = 0
    samples = 0
    distance = 0.0
    squared = 0.0
    coordinates = 0.0
    for frame in range(problem.coils.shape[0]):
        present = _present(problem.coils, frame)
        frames += present > 0
        for i in range(problem.coils.shape[1]):
            if np.isnan(problem.coils[frame, i, 0]):
                continue
            samples += 1
            distance += work.distances[frame, i]
            trust = state.trust[frame, i]
            squared += problem.terms[0] / present * trust * work.distances[frame, i] ** 2
            # Coils projected into the mid-sagittal plane measure nothing across it.
            coordinates += trust * (2.0 if problem.coils[frame, i, 0] == 0.0 else 3.0)
    spare = coordinates - determined
    variance = squared / spare if spare >= LEAST_SPARE * coordinates else np.inf
    return Outcome(energy, distance / samples, frames, variance, steps, at_rest)


def sign_flips(model: TongueModel) -> FloatArray:
    """(4, m) signs of speaker weights that nearly the same shapes are found behind: none changed, all, those of the
    weights that carry the mean, those of the others.

    v(s, p) = v(-s, -p) exactly. And of both modes about one weight is far from 0 in everybody, as it carries the mean
    of the data; with its sign and those of the others in the other mode changed, or the reverse, all that
    distinguishes is how speaker and pose interact.
    """
    carries = np.where(np.abs(model.speaker.mean) > 0.5 * model.speaker.sigma, -1.0, 1.0)
    same = np.ones(model.speaker.size)
    return np.stack([same, -same, carries, -carries])


class SpeakerEstimator:
    """The arrays of an estimate, made once, for up to `capacity` frames.

    model_at_coils: the multilinear model at the coils' vertices, in the coils' order (`TongueModel.at`).
    poses (capacity, k), trust (capacity, n): of the last estimate's frames, in their order; outcome: its numbers.
    """

    def __init__(self, model_at_coils: TongueModel, energy: Energy, capacity: int) -> None:
        model = model_at_coils
        coils, speakers, size = model.vertex_count, model.speaker.size, model.pose.size
        self._model = model
        self._base = np.array(model.origin)
        self._core = np.array(model.core)
        self._speaker_box, self._pose_box = (
            np.stack([mode.mean, mode.mean - energy.box * mode.sigma, mode.mean + energy.box * mode.sigma])
            for mode in (model.speaker, model.pose)
        )
        self._flips = sign_flips(model)
        self._energy = energy
        self._smallest_bias = SMALLEST_BIAS * energy.alpha * float(np.mean(model.core**2)) + 1e-300
        self._speaker = np.array(model.speaker.mean)
        self.poses: FloatArray = np.zeros((capacity, size))
        self.trust: FloatArray = np.ones((capacity, coils))
        self._distances = np.zeros((capacity, coils))
        self._work = Work(
            directions=np.zeros((size, 3 * coils)),
            gram=np.zeros((coils, size, size)),
            residual=np.zeros(3 * coils),
            slopes=np.zeros((speakers, 3 * coils)),
            cross=np.zeros((speakers, size)),
            pose_hessian=np.zeros((size, size)),
            pose_linear=np.zeros(size),
            pose_quadratic=quadratic_scratch(size),
            eliminated=np.zeros((size, speakers + size)),
            gradient=np.zeros(speakers),
            linear=np.zeros(speakers),
            target=np.zeros(speakers),
            before=np.zeros(speakers),
            ends=np.zeros((2, speakers)),
            hessian=np.zeros((speakers, speakers)),
            speaker_quadratic=quadratic_scratch(speakers),
            distances=self._distances,
        )
        self.outcome = Outcome(np.nan, np.nan, 0, np.nan, 0, False)

    def estimate(
        self, coils: FloatArray, start: FloatArray | None = None, robust: bool = True
    ) -> SpeakerEstimate | None:
        """As `estimate_speaker`, for C-contiguous float64 coils of at most `capacity` frames; None where no frame
        has a coil."""
        frames = len(coils)
        tracked = int(np.count_nonzero(~np.isnan(coils[:, :, 0]).all(axis=1)))
        if not tracked:
            return None
        self._speaker[:] = self._model.speaker.mean if start is None else start
        bias_speaker, bias_pose = (
            max(bias, self._smallest_bias) for bias in (self._energy.beta_speaker, self._energy.beta_pose)
        )
        terms = np.array([self._energy.alpha, bias_pose, bias_frames(tracked) * bias_speaker])
        self.outcome = estimate(
            Problem(coils, self._base, self._core, self._speaker_box, self._pose_box, terms, self._flips),
            State(self._speaker, self.poses[:frames], self.trust[:frames]),
            self._work._replace(distances=self._distances[:frames]),
            start is None,
            REWEIGHTINGS if robust else 0,
        )
        covariance = np.full(self._work.hessian.shape, np.inf)
        if math.isfinite(self.outcome.variance):
            covariance = self.outcome.variance * np.linalg.inv(self._work.hessian)
        return SpeakerEstimate(
            weights=self._speaker.copy(),
            covariance=covariance,
            sigma=np.sqrt(np.diag(covariance)) / self._model.speaker.sigma,
            frames=self.outcome.frames,
            residual_mm=self.outcome.residual_mm,
            iterations=self.outcome.steps,
            converged=bool(self.outcome.at_rest),
        )


def estimate_speaker(
    model_at_coils: TongueModel,
    energy: Energy,
    coils: FloatArray,
    start: FloatArray | None = None,
    robust: bool = True,
) -> SpeakerEstimate:
    """The speaker weights that explain all frames of coils (T, n, 3) at once: the minimiser of F of the module's
    docstring, over the speaker and every frame's pose.

    model_at_coils: the multilinear model at the coils' vertices, in the coils' order (`TongueModel.at`).
    energy: alpha, beta_speaker (counted once a frame: `bias_frames`), beta_pose and box; gamma plays no part.
    coils: mm in the model frame, NaN = missing. Frames without any coil count for nothing.
    start: (m,) raw speaker weights to begin at, as those of an earlier estimate; None begins at the mean.
    robust: REWEIGHTINGS times, samples far outside the others' distances lose their weight (Geman-McClure) and F
    is minimised again; False weighs all alike.

    Raises InputError where no frame has a coil.
    """
    coils = np.require(coils, np.float64, ["C_CONTIGUOUS", "WRITEABLE"])
    found = SpeakerEstimator(model_at_coils, energy, len(coils)).estimate(coils, start, robust)
    if found is None:
        raise InputError("no speaker can be estimated: none of the frames has a coil with a position.")
    return found
