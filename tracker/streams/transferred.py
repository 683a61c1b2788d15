"""Motion transfer while it is tracked: what draws is shown the same motion on another speaker's anatomy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..pose import FloatArray, TrackedPose
from .sink import Sink, StreamInfo


class TransferredSink:
    """Hands every pose on with these speaker weights (m,), and without coils: they were measured in another mouth.

    Copies a few numbers a pose, in the loop's thread; the pose that it is given stays as it is.
    """

    def __init__(self, sink: Sink, speaker_weights: FloatArray) -> None:
        self._sink = sink
        self._speaker_weights = speaker_weights
        self._pose: TrackedPose | None = None

    @property
    def destination(self) -> str:
        return self._sink.destination

    @property
    def sent(self) -> int:
        return self._sink.sent

    @property
    def dropped(self) -> int:
        return self._sink.dropped

    def start(self, info: StreamInfo) -> None:
        self._sink.start(self._on_the_other(info))

    def change(self, info: StreamInfo) -> None:
        self._sink.change(self._on_the_other(info))

    def send(self, pose: TrackedPose) -> None:
        if self._pose is None:
            self._pose = TrackedPose(
                pose.weights.copy(), pose.normalised.copy(), self._speaker_weights, residuals_mm=np.zeros(0)
            )
        moved = self._pose
        moved.weights[:] = pose.weights
        moved.normalised[:] = pose.normalised
        moved.valid_coils, moved.status = pose.valid_coils, pose.status
        moved.device_time_s, moved.frame_number = pose.device_time_s, pose.frame_number
        moved.arrival_ns, moved.solved_ns = pose.arrival_ns, pose.solved_ns
        # What a user can ask for is to fix or free the one who is tracked.
        moved.speaker_fixed = pose.speaker_fixed
        self._sink.send(moved)

    def close(self) -> None:
        self._sink.close()

    def _on_the_other(self, info: StreamInfo) -> StreamInfo:
        return replace(info, speaker_weights=self._speaker_weights, roles=())
