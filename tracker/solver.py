"""The two exact solvers as objects: arrays made once, previous weights kept, one compiled call a frame."""

from __future__ import annotations

import numpy as np

from ..model.multilinear import SpeakerModel, TongueModel
from . import kernels
from .pose import FloatArray, PoseStatus
from .session import Energy


class FreeSpeakerSolver:
    """Experiment 1: speaker and pose weights of every frame.

    model: the multilinear model at the coils' vertices, in the coils' order (`TongueModel.at`).
    weights (m + n,): speaker weights, then pose weights, of the last frame; the mean at the start.
    residuals_mm (n,); result (2,): energy, mean residual in mm.
    """

    def __init__(self, model: TongueModel, energy: Energy) -> None:
        self._speaker_size = model.speaker.size
        self._base = _writable(model.origin)
        self._core = _writable(model.core)
        self._mean = np.concatenate([model.speaker.mean, model.pose.mean])
        sigma = np.concatenate([model.speaker.sigma, model.pose.sigma])
        self._box = np.stack([self._mean, self._mean - energy.box * sigma, self._mean + energy.box * sigma])
        self._energy = np.array(
            [energy.alpha, energy.beta_speaker, energy.beta_pose, energy.gamma_speaker, energy.gamma_pose]
        )
        self._scratch, self._coil_scratch = kernels.free_scratch(
            model.speaker.size, model.pose.size, model.vertex_count
        )
        self.weights: FloatArray = self._mean.copy()
        self.residuals_mm: FloatArray = np.full(model.vertex_count, np.nan)
        self.result: FloatArray = np.full(2, np.nan)
        self._status: int = PoseStatus.LOST
        self._started = False

    @property
    def speaker_weights(self) -> FloatArray:
        """(m,) a view of the current speaker weights."""
        return self.weights[: self._speaker_size]

    @property
    def pose_weights(self) -> FloatArray:
        """(n,) a view of the current pose weights."""
        return self.weights[self._speaker_size :]

    def reset(self) -> None:
        """Forgets the previous frame: the next one starts at the mean, without coherence, sign flips tried."""
        self.weights[:] = self._mean
        self._status = PoseStatus.LOST
        self._started = False

    def solve(self, coils: FloatArray) -> int:
        """One frame of coils (n, 3), mm in the model frame, C-contiguous float64, NaN = missing."""
        self._status = kernels.solve_free_speaker(
            coils, self._base, self._core, self._box, self._energy, self._started, self._status != PoseStatus.OK,
            self.weights, self.residuals_mm, self._scratch, self._coil_scratch, self.result,
        )  # fmt: skip
        if self._status == PoseStatus.OK:
            self._started = True
        elif not self._started:
            return PoseStatus.LOST
        return self._status

    def distances(self, coils: FloatArray, distances_mm: FloatArray) -> None:
        """Fills distances_mm (n,) for any coils (n, 3), whether they were solved for or not."""
        kernels.free_residuals(coils, self._base, self._core, self.weights, distances_mm)

    def solve_all(self, coils: FloatArray) -> SolvedFrames:
        """A whole take of coils (frames, n, 3) from a fresh start, in one compiled loop."""
        self.reset()
        coils = _compilable(coils)
        solved = SolvedFrames.empty(len(coils), len(self.weights), len(self.residuals_mm))
        kernels.track_free_speaker(
            coils, self._base, self._core, self._box, self._energy, False, self.weights, solved.residuals_mm,
            self._scratch, self._coil_scratch, solved.results, solved.weights, solved.statuses,
        )  # fmt: skip
        solved.mark_lost_start()
        return solved


class FixedSpeakerSolver:
    """Experiment 2: the K coefficients of one speaker's linear model.

    model: the speaker's model at the coils' vertices, in the coils' order (`SpeakerModel.at`).
    Fields as in `FreeSpeakerSolver`; weights (K,).
    """

    def __init__(self, model: SpeakerModel, energy: Energy) -> None:
        size = len(model.mean)
        self._base = _writable(model.base)
        self._directions = _writable(model.directions)
        self._gram = np.zeros((model.vertex_count, size, size))
        kernels.coil_grams(self._directions, self._gram)
        self._mean = model.mean.copy()
        self._box = np.stack(
            [self._mean, self._mean - energy.box * model.sigma, self._mean + energy.box * model.sigma]
        )
        self._energy = np.array([energy.alpha, energy.beta_pose, energy.gamma_pose])
        self._scratch = kernels.fixed_scratch(size)
        self.weights: FloatArray = self._mean.copy()
        self.residuals_mm: FloatArray = np.full(model.vertex_count, np.nan)
        self.result: FloatArray = np.full(2, np.nan)
        self._started = False
        self.speaker_weights: FloatArray = model.speaker_weights.copy()

    @property
    def pose_weights(self) -> FloatArray:
        """(K,) the current coefficients."""
        return self.weights

    def reset(self) -> None:
        """Forgets the previous frame: the next one starts at the mean, without coherence."""
        self.weights[:] = self._mean
        self._started = False

    def solve(self, coils: FloatArray) -> int:
        """One frame of coils (n, 3), mm in the model frame, C-contiguous float64, NaN = missing."""
        status: int = kernels.solve_fixed_speaker(
            coils, self._base, self._directions, self._gram, self._box, self._energy, self._started,
            self.weights, self.residuals_mm, self._scratch, self.result,
        )  # fmt: skip
        if status == PoseStatus.OK:
            self._started = True
        elif not self._started:
            return PoseStatus.LOST
        return status

    def continue_from(self, pose_weights: FloatArray) -> None:
        """The next frame follows this pose (K,), which another solver found."""
        self.weights[:] = pose_weights
        self._started = True

    def distances(self, coils: FloatArray, distances_mm: FloatArray) -> None:
        """Fills distances_mm (n,) for any coils (n, 3), whether they were solved for or not."""
        kernels.coil_residuals(coils, self._base, self._directions, self.weights, distances_mm)

    def solve_all(self, coils: FloatArray) -> SolvedFrames:
        """A whole take of coils (frames, n, 3) from a fresh start, in one compiled loop."""
        self.reset()
        coils = _compilable(coils)
        solved = SolvedFrames.empty(len(coils), len(self.weights), len(self.residuals_mm))
        kernels.track_fixed_speaker(
            coils, self._base, self._directions, self._gram, self._box, self._energy, False, self.weights,
            solved.residuals_mm, self._scratch, solved.results, solved.weights, solved.statuses,
        )  # fmt: skip
        solved.mark_lost_start()
        return solved


class SolvedFrames:
    """weights (frames, w), residuals_mm (frames, n), results (frames, 2): energy and mean residual,
    statuses (frames,)."""

    def __init__(
        self, weights: FloatArray, residuals_mm: FloatArray, results: FloatArray, statuses: np.ndarray
    ) -> None:
        self.weights = weights
        self.residuals_mm = residuals_mm
        self.results = results
        self.statuses = statuses

    @classmethod
    def empty(cls, frames: int, size: int, coils: int) -> SolvedFrames:
        return cls(
            np.empty((frames, size)),
            np.empty((frames, coils)),
            np.empty((frames, 2)),
            np.empty(frames, np.int64),
        )

    def mark_lost_start(self) -> None:
        """Frames before the first coil arrived hold nothing: they are lost, not held."""
        tracked = np.flatnonzero(self.statuses == PoseStatus.OK)
        self.statuses[: tracked[0] if len(tracked) else len(self.statuses)] = PoseStatus.LOST


def _compilable(frames: FloatArray) -> FloatArray:
    """The same array where it already has the type that the kernels are compiled for, else a copy."""
    return np.require(frames, np.float64, ["C_CONTIGUOUS", "WRITEABLE"])


def _writable(array: FloatArray) -> FloatArray:
    """A contiguous copy: read-only arrays have another type for the compiler and would compile twice."""
    return np.array(array, dtype=np.float64, order="C")
