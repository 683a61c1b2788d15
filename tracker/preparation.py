"""Raw coil positions in the source's frame -> the tracked coils in the model frame.

The flow: pick the coils, (head correction, bite plane, palate: their place is here, between picking and
aligning; not built yet), align rigidly, project into the mid-sagittal plane. The same compiled function
serves one live frame and a whole recording, so both give the same bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from . import kernels
from .pose import FloatArray
from .session import Alignment


class Preparation:
    """picked: (n,) int64 indices of the tracked coils among the source's."""

    def __init__(self, picked: NDArray[np.int64], alignment: Alignment) -> None:
        self._picked = np.ascontiguousarray(picked, dtype=np.int64)
        self._rotation = np.array(alignment.rotation, dtype=np.float64, order="C")
        self._translation = np.array(alignment.translation_mm, dtype=np.float64)
        self._midsagittal = alignment.midsagittal
        self.coils: FloatArray = np.full((len(self._picked), 3), np.nan)
        # Frames are copied here first: a read-only or strided array would be another type for the compiler.
        self._raw = np.zeros((self.channels_needed, 3))

    @property
    def channels_needed(self) -> int:
        """The least number of channels that a raw frame must have."""
        return int(self._picked.max()) + 1

    def frame(self, raw: FloatArray) -> FloatArray:
        """Fills and returns `self.coils` (n, 3) from raw (all coils, 3); NaN = missing in both."""
        if len(raw) < len(self._raw):
            raise InputError(
                f"a frame has {len(raw)} coils, but channel {len(self._raw)} is to be tracked; check what the "
                "source sends."
            )
        self._raw[:] = raw[: len(self._raw)]
        kernels.prepare_frame(
            self._raw, self._picked, self._rotation, self._translation, self._midsagittal, self.coils
        )
        return self.coils

    def all_frames(self, raw: FloatArray) -> FloatArray:
        """(frames, n, 3) from raw (frames, all coils, 3)."""
        prepared = np.empty((len(raw), len(self._picked), 3))
        kernels.prepare_frames(
            # A read-only array is another type for the compiler; such a one is copied.
            np.require(raw, np.float64, ["C_CONTIGUOUS", "WRITEABLE"]),
            self._picked,
            self._rotation,
            self._translation,
            self._midsagittal,
            prepared,
        )
        return prepared
