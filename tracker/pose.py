"""What leaves the tracker. Streams, files and viewers know this and nothing else of the tracker.

A mesh is base + K directions x K coefficients, whatever estimator made them: a `SpeakerModel` carries
the first two, a `TrackedPose` the coefficients of one instant, `TrackedPoses` those of a whole take.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class PoseStatus(IntEnum):
    """How far a pose can be trusted; the same numbers as on the wire."""

    LOST = 0  # nothing was ever tracked, or the source is gone: the pose is the mean
    OK = 1
    HELD = 2  # no coil arrived in this frame: the pose is the previous one
    RELAXING = 3  # no coil for longer, in a live run: the pose drifts back to the mean


class CoilState(IntEnum):
    """Whether a coil counts in this frame, and if not, why; the same numbers in takes."""

    TRUSTED = 0
    MISSING = 1  # the source has no position for it
    WILD = 2  # it moved faster than any tongue
    MISFIT = 3  # it lies much farther from the model than it used to
    STUCK = 4  # it repeats one position to the last bit while others move
    RETURNING = 5  # it behaves again, but not yet for long enough


@dataclass(slots=True)
class TrackedPose:
    """One frame's pose. The tracker owns one and writes over it; sinks copy what they keep.

    weights, normalised: (K,) raw, and in sigma from the mean.
    speaker_weights: (m,) raw; constant while the speaker is fixed.
    residuals_mm: (n,) distance of each coil from its vertex, NaN = missing.
    coil_states: (n,) `CoilState` of each coil; only trusted ones had a part in the pose.
    coils: (n, 3) the prepared coil positions, mm in the model frame, NaN = missing; trusted or not.
    speaker_fixed: whether the pose alone was solved.
    residual_mm: mean distance of the trusted coils, NaN without any; energy: E at the minimiser, NaN likewise.
    device_time_s, frame_number: of the source; arrival_ns, solved_ns: `time.perf_counter_ns()` on this host.
    """

    weights: FloatArray
    normalised: FloatArray
    speaker_weights: FloatArray
    residuals_mm: FloatArray
    residual_mm: float = float("nan")
    energy: float = float("nan")
    valid_coils: int = 0
    status: int = PoseStatus.LOST
    device_time_s: float = 0.0
    frame_number: int = 0
    arrival_ns: int = 0
    solved_ns: int = 0
    speaker_fixed: bool = True
    coil_states: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    coils: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def has_shape(self) -> bool:
        """Whether there is a tongue in it: whoever draws or moves something leaves out a pose whose weights are no numbers."""
        return bool(np.isfinite(self.weights).all() and np.isfinite(self.speaker_weights).all())

    def copy(self) -> TrackedPose:
        """A pose of its own, which nothing writes over."""
        return replace(
            self,
            weights=self.weights.copy(),
            normalised=self.normalised.copy(),
            speaker_weights=self.speaker_weights.copy(),
            residuals_mm=self.residuals_mm.copy(),
            coil_states=self.coil_states.copy(),
            coils=self.coils.copy(),
        )

    def take(self, other: TrackedPose) -> None:
        """Becomes what the other one is; both have the same shapes. Allocates nothing."""
        self.weights[:] = other.weights
        self.normalised[:] = other.normalised
        self.speaker_weights[:] = other.speaker_weights
        self.residuals_mm[:] = other.residuals_mm
        self.coil_states[:] = other.coil_states
        self.coils[:] = other.coils
        self.residual_mm, self.energy = other.residual_mm, other.energy
        self.valid_coils, self.status = other.valid_coils, other.status
        self.device_time_s, self.frame_number = other.device_time_s, other.frame_number
        self.arrival_ns, self.solved_ns = other.arrival_ns, other.solved_ns
        self.speaker_fixed = other.speaker_fixed


@dataclass(frozen=True)
class TrackedPoses:
    """A whole take's poses in arrays.

    times_s, statuses, energies, residual_mm: (frames,); weights, normalised: (frames, K);
    speaker_weights: (frames, m), equal rows while the speaker is fixed;
    residuals_mm: (frames, n), NaN = missing; coils: (frames, n, 3) the prepared coil positions, mm in the
    model frame; vertices: the same shape, the model's points that they were fitted to, or None where a
    file does not keep them.
    roles: the coils' roles in the order of the n axis; correspondences: their vertices, in that order.
    coil_states: (frames, n) `CoilState`, or None where they are not known: takes keep them, files of poses do not.
    experiment: 1 (speaker and pose free) or 2 (speaker fixed).
    """

    times_s: FloatArray
    statuses: NDArray[np.int64]
    weights: FloatArray
    normalised: FloatArray
    speaker_weights: FloatArray
    energies: FloatArray
    residual_mm: FloatArray
    residuals_mm: FloatArray
    coils: FloatArray
    vertices: FloatArray | None
    roles: tuple[str, ...]
    correspondences: tuple[int, ...]
    experiment: int
    rate_hz: float
    model_path: str = ""
    model_fingerprint: str = ""
    model_name: str = ""
    recording: str = ""
    coil_states: NDArray[np.int64] | None = None

    @property
    def frame_count(self) -> int:
        return len(self.times_s)

    @property
    def have_shape(self) -> NDArray[np.bool_]:
        """(frames,): whether all weights are numbers, so that there is a tongue."""
        return np.asarray(
            np.isfinite(self.weights).all(axis=1) & np.isfinite(self.speaker_weights).all(axis=1)
        )

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """(frames,): True where at least one coil was there."""
        return np.asarray(self.statuses == PoseStatus.OK)
