"""The speaker, estimated from the last seconds by a thread beside the loop that tracks."""

from __future__ import annotations

import math
import threading

import numpy as np

from .. import InputError
from ..model.multilinear import TongueModel
from .anatomy import SpeakerEstimate, SpeakerEstimator, estimate_speaker
from .pose import FloatArray
from .session import Energy

SPACING_S = 0.02  # frames closer than this say the same about a speaker
PERIOD_S = 0.5
FEWEST_FRAMES = 10
MOST_FRAMES = 10_000


class BackgroundSpeaker:
    """Takes coils from the loop, and every half second estimates the speaker from the last `window_s` of them.

    model_at_coils: the multilinear model at the coils' vertices, in the coils' order (`TongueModel.at`).
    window_s: s of the source's time; rate_hz: frames a second that `add` will be called.
    latest: the newest estimate, replaced as a whole and never changed; None until FEWEST_FRAMES frames with coils
    have been kept. One thread adds, any may read `latest`. Estimates keep coming until `close`.

    Raises InputError for a window or a rate that is no positive number, or a window of more than MOST_FRAMES.
    """

    def __init__(self, model_at_coils: TongueModel, energy: Energy, window_s: float, rate_hz: float) -> None:
        for name, value in (("window", window_s), ("rate", rate_hz)):
            if not 0.0 < value < math.inf:
                raise InputError(f"the speaker's {name} is {value:g}: expected a number above 0.")
        self.every = max(1, math.ceil(SPACING_S * rate_hz - 1e-9))
        kept = max(FEWEST_FRAMES + 1, round(window_s * rate_hz / self.every))
        if kept > MOST_FRAMES:
            raise InputError(f"a window of {window_s:g} s is too long; expected at most some minutes.")
        self.latest: SpeakerEstimate | None = None
        self._model = model_at_coils
        self._energy = energy
        self._ring = np.full((kept, model_at_coils.vertex_count, 3), np.nan)
        self._snapshot = self._ring.copy()
        self._estimator = SpeakerEstimator(model_at_coils, energy, kept)
        self._added = 0  # frames that `add` was called with
        self._kept = 0  # those of them in the ring, also before they were overwritten
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tonguetrack-speaker", daemon=True)
        self._thread.start()

    def warm_up(self) -> None:
        """Compiles or loads the kernel; call it before the first frame, or the first estimate does so meanwhile."""
        estimate_speaker(self._model, self._energy, np.zeros((1, self._model.vertex_count, 3)))

    def add(self, coils: FloatArray) -> None:
        """One frame of coils (n, 3), mm in the model frame, NaN = missing; copied, if it is one that is kept."""
        if self._added % self.every == 0:
            self._ring[self._kept % len(self._ring)] = coils
            self._kept += 1
        self._added += 1

    def close(self) -> None:
        """Ends the thread; `latest` stays."""
        self._closed.set()
        self._thread.join(timeout=10.0)

    def snapshot(self) -> FloatArray:
        """(T, n, 3) the ring's frames, not in their order; for the thread alone, which owns the array.

        The loop may write while this copies: the frames it may have written meanwhile are left out.
        """
        first = self._kept
        np.copyto(self._snapshot, self._ring)
        for number in range(first, min(self._kept + 1, first + len(self._ring))):
            self._snapshot[number % len(self._ring)] = np.nan
        return self._snapshot

    def _run(self) -> None:
        seen = 0
        while not self._closed.wait(PERIOD_S):
            if self._kept == seen:
                continue
            seen = self._kept
            before = self.latest
            found = self._estimator.estimate(self.snapshot(), before.weights if before else None)
            if found is not None and found.frames >= FEWEST_FRAMES:
                self.latest = found
