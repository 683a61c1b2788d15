"""One frame as a row of words, filled in place by the loop's thread."""

from __future__ import annotations

import struct

import numpy as np

from ...drivers.frames import CoilFrame
from ..pose import FloatArray, TrackedPose
from .journal import slot_dtype
from .layout import POSE_HEAD, TakeInfo

_RAW_HEAD = struct.Struct("<qdd")  # arrival_ns, device time, frame number
_POSE_HEAD = struct.Struct(f"<{len(POSE_HEAD)}d")
_NS = 1e-9


class Row:
    """Room for one row, its views made beforehand. `slot` is what `journal.Journal.store` takes.

    slot: (words,) int64, the memory of `journal.slot_dtype`.
    """

    def __init__(self, info: TakeInfo) -> None:
        dtype = slot_dtype(info.row_dtype())
        self.slot = np.zeros(dtype.itemsize // 8, np.int64)
        self._memory = self.slot.data.cast("B")
        self._content = self.slot[:-1]
        self._check = self.slot[-1:].reshape(())
        numbers = self.slot.view(np.float64)
        coils, roles = len(info.coils), len(info.roles)
        at = 3  # arrival_ns, device_time_s, frame_number

        def block(*shape: int) -> FloatArray:
            nonlocal at
            begin, at = at, at + int(np.prod(shape))
            return numbers[begin:at].reshape(shape)

        self._positions = block(coils, 3)
        self._quaternions = block(coils, 4) if info.quaternions else None
        self._rms = block(coils) if info.rms else None
        self._status = block(coils) if info.status else None
        self._prepared = block(roles, 3)
        self._pose_at = 8 * at
        at += len(POSE_HEAD)
        self._weights = block(len(info.pose_mean))
        self._speaker = block(info.speaker_size)
        self._residuals = block(roles)
        self._states = block(roles)

    def fill(self, sequence: int, frame: CoilFrame, coils: FloatArray, pose: TrackedPose) -> None:
        """Writes everything of one frame, and last the check word. Makes no array.

        What the device should have and this frame has not becomes NaN.
        """
        memory = self._memory
        _RAW_HEAD.pack_into(memory, 0, frame.arrival_ns, frame.device_time_s, frame.frame_number)
        self._positions[...] = frame.positions
        if self._quaternions is not None:
            self._quaternions[...] = np.nan if frame.quaternions is None else frame.quaternions
        if self._rms is not None:
            self._rms[...] = np.nan if frame.rms is None else frame.rms
        if self._status is not None:
            self._status[...] = np.nan if frame.status is None else frame.status
        self._prepared[...] = coils
        _POSE_HEAD.pack_into(
            memory,
            self._pose_at,
            pose.status,
            pose.speaker_fixed,
            pose.valid_coils,
            pose.energy,
            pose.residual_mm,
            (pose.solved_ns - pose.arrival_ns) * _NS,
        )
        self._weights[...] = pose.weights
        self._speaker[...] = pose.speaker_weights
        self._residuals[...] = pose.residuals_mm
        self._states[...] = pose.coil_states
        self.slot[-2] = sequence
        np.add.reduce(self._content, out=self._check)  # the same as `journal.check_of`
