"""Raw coil positions in the source's frame -> the tracked coils in the model frame.

The flow: smooth, take the head's motion out, align rigidly, project into the mid-sagittal plane. One frame at a
time and over a whole recording it is the same compiled code; only smoothing differs, which may look ahead in a
recording and must not in a live run.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .. import InputError
from . import kernels
from .headcorrection import HeadCorrector, HeadReference, IntArray, ReferenceState, follow_head, head_motion
from .pose import FloatArray
from .session import Alignment
from .smoothing import NO_SMOOTHING, CausalSmoother, Filter, Smoothing, smooth


class Preparation:
    """picked: (n,) int64 indices of the tracked coils among the source's, roles their roles.

    head: the reference coils at rest; references: (k,) int64 indices of these coils among the source's.
    rate_hz: of a live source, for its smoothing.
    """

    def __init__(
        self,
        picked: NDArray[np.int64],
        alignment: Alignment,
        roles: Sequence[str] = (),
        head: HeadReference | None = None,
        references: NDArray[np.int64] | None = None,
        smoothing: Smoothing = NO_SMOOTHING,
        rate_hz: float = 250.0,
    ) -> None:
        self._picked = np.ascontiguousarray(picked, dtype=np.int64)
        self._rotation = np.array(alignment.rotation, dtype=np.float64, order="C")
        self._translation = np.array(alignment.translation_mm, dtype=np.float64)
        self._midsagittal = alignment.midsagittal
        self._head = head
        self._references = np.zeros(0, np.int64) if references is None else np.ascontiguousarray(references)
        self._corrector = HeadCorrector(head, rate_hz) if head is not None else None
        self._smoothing = smoothing
        # Channels in the order in which a frame is copied, with the role that says how each is smoothed.
        head_roles = head.roles if head is not None else ()
        self._role_of = dict(zip(self._picked.tolist(), roles, strict=False))
        self._role_of |= dict(zip(self._references.tolist(), head_roles, strict=True))
        self.coils: FloatArray = np.full((len(self._picked), 3), np.nan)
        # Frames are copied here first: a read-only or strided array would be another type for the compiler.
        self._raw = np.zeros((self.channels_needed, 3))
        self._quaternions = np.full((self.channels_needed, 4), np.nan)
        live = [self._filter_of(channel, live=True) for channel in range(self.channels_needed)]
        self._smoother = CausalSmoother(live, rate_hz) if any(live) else None
        # What the compiled calls are given: gathering it anew would cost as much as they do.
        self._place = (self._picked, self._rotation, self._translation, self._midsagittal)
        self._on_head = () if self._corrector is None else (self._references, *self._corrector.arrays)

    def _filter_of(self, channel: int, live: bool) -> Filter | None:
        role = self._role_of.get(channel)
        return None if role is None else self._smoothing.of(role, live)

    @property
    def channels_needed(self) -> int:
        """The least number of channels that a raw frame must have."""
        return int(max(self._picked.max(), self._references.max(initial=-1))) + 1

    def reset(self) -> None:
        """Forgets what was smoothed and where the head was, as after a jump in time."""
        if self._smoother is not None:
            self._smoother.reset()
        if self._corrector is not None:
            self._corrector.reset()

    @property
    def head_states(self) -> dict[str, ReferenceState]:
        """What became of each reference coil in the last frame; empty without head correction."""
        if self._corrector is None or self._head is None:
            return {}
        states = self._corrector.states.tolist()
        return {role: ReferenceState(state) for role, state in zip(self._head.roles, states, strict=True)}

    def frame(
        self, raw: FloatArray, step_s: float = 0.0, quaternions: FloatArray | None = None
    ) -> FloatArray:
        """Fills and returns `self.coils` (n, 3) from raw (all coils, 3); NaN = missing in both.

        step_s: time since the frame before, for smoothing; quaternions: (all coils, 4), for a reference with
        six degrees of freedom.
        """
        needed = len(self._raw)
        if len(raw) < needed:
            raise InputError(
                f"a frame has {len(raw)} coils, but channel {needed} is to be tracked; check what the source sends."
            )
        self._raw[...] = raw[:needed]
        if self._smoother is not None:
            self._smoother.step(self._raw, step_s, self._raw)
        if self._corrector is None:
            kernels.prepare_frame(self._raw, *self._place, self.coils)
            return self.coils
        if quaternions is not None:
            self._quaternions[...] = quaternions[:needed]
        _prepare_on_head(
            self._raw, self._quaternions, quaternions is not None, *self._on_head, *self._place, self.coils
        )
        return self.coils

    def all_frames(
        self, raw: FloatArray, rate_hz: float = 250.0, quaternions: FloatArray | None = None
    ) -> FloatArray:
        """(frames, n, 3) from raw (frames, all coils, 3) and quaternions (frames, all coils, 4) of a recording."""
        # A read-only array is another type for the compiler; such a one is copied.
        raw = np.require(raw, np.float64, ["C_CONTIGUOUS", "WRITEABLE"])
        filters = [self._filter_of(channel, live=False) for channel in range(self.channels_needed)]
        if any(filters):
            raw = np.ascontiguousarray(smooth(raw[:, : self.channels_needed], rate_hz, filters))
        prepared = np.empty((len(raw), len(self._picked), 3))
        if self._head is None:
            kernels.prepare_frames(raw, *self._place, prepared)
            return prepared
        turned = None if quaternions is None else quaternions[:, self._references]
        motion = head_motion(raw[:, self._references], self._head, rate_hz, turned)
        kernels.prepare_frames_on_moving_head(
            raw, motion.rotations, motion.translations, *self._place, prepared
        )
        return prepared


@njit(**kernels.OPTIONS)
def _prepare_on_head(
    raw: FloatArray,
    quaternions: FloatArray,
    turned: bool,
    references: IntArray,
    now: FloatArray,
    now_turned: FloatArray,
    rest: FloatArray,
    rest_turned: FloatArray,
    limits: FloatArray,
    memory: FloatArray,
    work: FloatArray,
    motion: FloatArray,
    states: IntArray,
    picked: IntArray,
    rotation: FloatArray,
    translation: FloatArray,
    midsagittal: bool,
    coils: FloatArray,
) -> None:
    """One frame raw (channels, 3) from the references to the coils (n, 3) in the model frame.

    turned: whether quaternions (channels, 4) are this frame's; now to states: `HeadCorrector.arrays`.
    """
    for i in range(references.shape[0]):
        for axis in range(3):
            now[i, axis] = raw[references[i], axis]
        for part in range(4):
            now_turned[i, part] = quaternions[references[i], part] if turned else np.nan
    follow_head(now, now_turned, rest, rest_turned, limits, memory, work, motion, states)
    kernels.prepare_on_moving_head(
        raw, motion[:3], motion[3], picked, rotation, translation, midsagittal, coils
    )
