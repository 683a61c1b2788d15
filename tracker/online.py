"""The tracker one frame at a time: in a live run it outlives bad coils, gaps and silence, and may learn the speaker.

What it gives depends on the frames alone (positions and device times) and on the changes of the set-up that
it is told of, never on the host's clock: the same frames give the same bits again (`takes.retrack`).
"""

from __future__ import annotations

import copy
import time
from dataclasses import replace

import numpy as np

from ..drivers.frames import CoilFrame
from ..model.multilinear import TongueModel
from . import kernels
from .guard import CoilGuard
from .headcorrection import ReferenceState
from .pose import CoilState, FloatArray, PoseStatus, TrackedPose
from .preparation import Preparation
from .session import Session
from .setup import Setup
from .solver import FixedSpeakerSolver, FreeSpeakerSolver
from .tracking import fixed_speaker_energy

HOLD_S = 0.5
"""So long a pose without coils is held; then it drifts back to the mean."""
RELAX_S = 0.3
"""Time constant of that drift."""
LOST_S = 3.0
"""A source that is silent for longer is lost."""
RESET_S = 0.25
"""After a gap this long the pose no longer follows from the one before it."""
RESET_PERIODS = 4.0
"""For slow devices: a gap is at least so many frames."""
DEFAULT_RATE_HZ = 250.0


class Tracker:
    """Frame in, pose out: prepares and solves one frame in compiled code, allocating nothing.

    It owns one `TrackedPose` and writes over it at every step. With `setup.session.speaker_weights` the
    speaker is fixed and only the pose is solved; without, both are.

    watchful: for live sources. Bad coils lose their say (`guard.CoilGuard`), a pose without coils drifts back
    to the mean, after a gap the tracker starts anew. Otherwise every coil is believed and every frame follows
    the last one: the poses are those of `track_recording`, bit for bit.
    rate_hz: nominal, 0.0 = unknown: then that of most devices. fix_after_s: with a free speaker, so much tracked
    speech is averaged and the speaker then fixed (paper, section "Experiments"); None = never by itself.
    period_s: the nominal time between frames. changes: grows with every change of the set-up, for those who have
    to pass it on.
    """

    def __init__(
        self,
        model: TongueModel,
        setup: Setup,
        rate_hz: float = 0.0,
        watchful: bool = False,
        fix_after_s: float | None = None,
    ) -> None:
        self.model = model
        self._watchful = watchful
        self.rate_hz = rate_hz if rate_hz > 0 else DEFAULT_RATE_HZ
        self.period_s = 1.0 / self.rate_hz
        self._reset_s = max(RESET_S, RESET_PERIODS * self.period_s)
        self._fix_after_s = fix_after_s
        self.changes = -1
        # Copies: the model's own are read-only, which is another type for the compiler.
        self._mean, self._sigma = model.pose.mean.copy(), model.pose.sigma.copy()
        self._preparation = setup.preparation
        self._guard = CoilGuard(len(setup.vertices))
        self._distances = np.full(len(setup.vertices), np.nan)
        self._solver: FixedSpeakerSolver | FreeSpeakerSolver
        self._build(setup)
        self.restart()

    @property
    def coils(self) -> FloatArray:
        """(n, 3) the last frame's prepared coils, mm in the model frame, NaN = missing; whether they counted or not."""
        return self._preparation.coils

    @property
    def used(self) -> FloatArray:
        """(n, 3) those of them that counted."""
        return self._guard.used if self._watchful else self._preparation.coils

    @property
    def head_states(self) -> dict[str, ReferenceState]:
        """What became of each reference coil of the head in the last frame; empty without head correction."""
        return self._preparation.head_states

    def warm_up(self) -> None:
        """Compiles or loads every kernel that a frame may need, also those of a speaker that is fixed later.

        In a live run, where a user may free it, also those of a speaker that is free later.
        """
        missing = np.full_like(self._preparation.coils, np.nan)
        self._preparation.frame(np.full((self._preparation.channels_needed, 3), np.nan))
        solvers = [self._solver]
        vertices, energy = self.setup.vertices, self.setup.session.energy
        if isinstance(self._solver, FreeSpeakerSolver):
            speaker = self.model.for_speaker(self.model.speaker.mean).at(vertices)
            solvers.append(FixedSpeakerSolver(speaker, energy))
        elif self._watchful:
            solvers.append(FreeSpeakerSolver(self.model.at(vertices), energy))
        for solver in solvers:
            solver.solve(missing)
            solver.distances(missing, self._distances)
        self._guard.admit(missing, 0.0)
        self._guard.learn(self._distances, 0.0, 0.0)
        self._finish(self.pose)
        self.restart()

    def restart(self) -> None:
        """As if no frame had ever come; the set-up stays."""
        self._solver.reset()
        self._guard.reset()
        self._preparation.reset()
        self._time_s = 0.0
        self._last_device_s: float | None = None
        self._without_s = 0.0
        self.pose.status = PoseStatus.LOST
        self._forget_average()

    def twin(self) -> Tracker:
        """Another tracker of the same kind and set-up, with a state of its own, that knows of no frame yet."""
        setup = replace(self.setup, preparation=copy.deepcopy(self._preparation))
        return Tracker(self.model, setup, self.rate_hz, self._watchful)

    def change(self, setup: Setup) -> None:
        """Goes on with another set-up: the speaker became known, or a client changed the energy.

        Where the speaker is fixed, the next pose still follows the last one; with a free one it starts at the mean.
        Coils and vertices stay; for others there is another tracker.
        """
        pose, status = self.pose.weights.copy(), self.pose.status
        self._build(setup)
        self.pose.status = status
        if status != PoseStatus.LOST and isinstance(self._solver, FixedSpeakerSolver):
            self._solver.continue_from(pose)
        self._forget_average()

    def fix_speaker(self, weights: FloatArray, source: str) -> None:
        """From the next frame on only the pose is solved, with these speaker weights (m,), raw."""
        session = replace(self.setup.session, speaker_weights=np.array(weights), speaker_source=source)
        self.change(replace(self.setup, session=session))

    def free_speaker(self) -> None:
        """From the next frame on the speaker is solved too, and averaged anew."""
        session = replace(self.setup.session, speaker_weights=None, speaker_source="")
        self.change(replace(self.setup, session=session))

    @property
    def speaker_average(self) -> FloatArray | None:
        """(m,) the mean of the free speaker's weights over the tracked frames since the start; None without any."""
        return self._speaker_sum / self._speaker_frames if self._speaker_frames else None

    def fix_average(self) -> bool:
        """Fixes the speaker to that mean; False where there is none."""
        weights = self.speaker_average
        if weights is None:
            return False
        self.fix_speaker(weights, f"mean over {self._speaker_frames} frames of this run")
        return True

    def step(self, frame: CoilFrame) -> TrackedPose:
        """Tracks one frame of the source's raw positions (coils, 3), mm."""
        pose, solver = self.pose, self._solver
        step_s = self.period_s
        if self._watchful:
            step_s = self._advance(frame.device_time_s)
            status = self._watch(frame, step_s)
        else:
            coils = self._preparation.frame(frame.positions, step_s, frame.quaternions)
            status = solver.solve(coils)
            np.isnan(coils[:, 0], out=self._guard.states, casting="unsafe")  # MISSING = 1, TRUSTED = 0
        if self._averages and status == PoseStatus.OK:
            self._average(solver.speaker_weights, step_s)
        pose.status = status
        pose.valid_coils = self._finish(pose)
        energy, pose.residual_mm = solver.result.tolist()
        pose.energy = energy + self._constant_energy
        pose.device_time_s = frame.device_time_s
        pose.frame_number = frame.frame_number
        pose.arrival_ns = frame.arrival_ns
        pose.solved_ns = time.perf_counter_ns()
        return pose

    def _finish(self, pose: TrackedPose) -> int:
        counted: int = kernels.finish_pose(
            pose.weights, self._mean, self._sigma, pose.coil_states, pose.normalised
        )
        return counted

    def _watch(self, frame: CoilFrame, step_s: float) -> int:
        """Solves with the coils that can be trusted; the status."""
        solver, guard = self._solver, self._guard
        coils = self._preparation.frame(frame.positions, step_s, frame.quaternions)
        status = solver.solve(guard.admit(coils, self._time_s))
        residuals = solver.residuals_mm
        if not guard.all_counted:
            residuals = self._distances
            solver.distances(coils, residuals)
        self.pose.residuals_mm = residuals
        if status == PoseStatus.OK:
            guard.learn(residuals, self._time_s, step_s)
            self._without_s = 0.0
        elif status == PoseStatus.HELD:
            self._without_s += step_s
            if self._without_s > HOLD_S:
                self._relax(step_s)
                return PoseStatus.RELAXING
        return status

    def idle(self, silent_s: float) -> TrackedPose:
        """What to show while the source is silent for silent_s: the last pose, drifting to the mean, then lost.

        A pose of its own: the tracker itself goes on from its last frame, whatever was shown meanwhile.
        """
        shown, last = self._shown, self.pose
        drift = float(np.exp(-max(0.0, silent_s - HOLD_S) / RELAX_S))
        shown.weights[:] = self._mean + drift * (last.weights - self._mean)
        shown.normalised[:] = (shown.weights - self._mean) / self._sigma
        shown.speaker_weights = last.speaker_weights
        shown.speaker_fixed = last.speaker_fixed
        shown.residuals_mm[:] = np.nan
        shown.device_time_s = last.device_time_s + silent_s
        shown.frame_number = last.frame_number
        shown.arrival_ns = shown.solved_ns = time.perf_counter_ns()
        shown.status = PoseStatus.HELD if silent_s <= HOLD_S else PoseStatus.RELAXING
        if silent_s > LOST_S or last.status == PoseStatus.LOST:
            shown.status = PoseStatus.LOST
        return shown

    def _advance(self, device_time_s: float) -> float:
        """Moves this tracker's own clock on; after a jump or a long gap it starts anew from this frame."""
        last_s, self._last_device_s = self._last_device_s, device_time_s
        step_s = 0.0 if last_s is None else device_time_s - last_s
        if step_s < 0.0 or step_s > self._reset_s:
            self._solver.reset()
            self._guard.resume()
            self._preparation.reset()
            self._without_s = 0.0
        if not 0.0 < step_s <= self._reset_s:
            step_s = self.period_s  # also where the device has no clock
        self._time_s += step_s
        return step_s

    def _average(self, speaker_weights: FloatArray, step_s: float) -> None:
        self._speaker_sum += speaker_weights
        self._speaker_frames += 1
        self._speech_s += step_s
        if self._fix_after_s is not None and self._speech_s >= self._fix_after_s:
            self._due = True  # `settle` does it, once this frame's pose is with the sinks

    def settle(self) -> bool:
        """Called between frames: fixes the speaker once enough speech was averaged. True when it did."""
        if not self._due:
            return False
        self._due = False
        return self.fix_average()

    def _forget_average(self) -> None:
        self._speaker_sum = np.zeros(self.model.speaker.size)
        self._speaker_frames = 0
        self._speech_s = 0.0
        self._due = False

    def _relax(self, step_s: float) -> None:
        weights = self.pose.weights
        weights -= self._mean
        weights *= np.exp(-step_s / RELAX_S)
        weights += self._mean

    def _build(self, setup: Setup) -> None:
        model, energy, weights = self.model, setup.session.energy, setup.session.speaker_weights
        self.setup = setup
        if weights is None:
            self._solver = FreeSpeakerSolver(model.at(setup.vertices), energy)
        else:
            self._solver = FixedSpeakerSolver(model.for_speaker(weights).at(setup.vertices), energy)
        self._averages = weights is None
        self._constant_energy = fixed_speaker_energy(model, setup)
        self.pose = TrackedPose(
            weights=self._solver.pose_weights,
            normalised=model.pose.normalised(self._solver.pose_weights),
            speaker_weights=self._solver.speaker_weights,
            residuals_mm=self._solver.residuals_mm,
            speaker_fixed=weights is not None,
            coil_states=self._guard.states,
            coils=self._preparation.coils,
        )
        self._shown = replace(
            self.pose,
            weights=self.pose.weights.copy(),
            normalised=self.pose.normalised.copy(),
            residuals_mm=np.full(len(setup.vertices), np.nan),
            coil_states=np.full(len(setup.vertices), CoilState.MISSING, np.int64),
            coils=np.full((len(setup.vertices), 3), np.nan),
        )
        self.changes += 1


def compile_kernels(model: TongueModel) -> None:
    """Compiles or loads what frames will need, on three vertices of the model, before anything waits for them."""
    names, session = ("a", "b", "c"), Session()
    setup = Setup(names, names, (0, 1, 2), Preparation(np.arange(3), session.alignment), session, ())
    Tracker(model, setup, watchful=True).warm_up()
