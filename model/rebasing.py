"""Pose directions re-based to coefficients in 0..1, for everything that knows no others.

With w between low and high, one for each direction, the mesh base + sum w_k T_k is the same as

    base' + sum w'_k T'_k,   base' = base + sum low_k T_k,   T'_k = (high_k - low_k) T_k,
    w'_k = (w_k - low_k) / (high_k - low_k)

and w' lies in 0..1. This is exact, for any K. Blend shapes of avatars, morph targets in Blender (which clamps them
to 0..1) and sliders all want it so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .. import InputError
from .mesh import FloatArray
from .multilinear import SpeakerModel


@dataclass(frozen=True)
class Rebased:
    """Which raw weights become 0 and which become 1: low, high (K,). Receivers need both to go back.

    Where low and high are equal the direction never moves: its T' is 0, and so is its w'.
    """

    low: FloatArray
    high: FloatArray

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise InputError(
                f"a range of weights has the shapes {self.low.shape} and {self.high.shape}; expected one low and "
                "one high for each."
            )
        if not (
            np.isfinite(self.low).all() and np.isfinite(self.high).all() and (self.low <= self.high).all()
        ):
            raise InputError(
                "a range of weights is not finite, or its low is above its high; expected low <= high."
            )

    @classmethod
    def of_range(cls, mean: ArrayLike, sigma: ArrayLike, sigmas: float = 3.0) -> Rebased:
        """mean +- sigmas sigma, (K,) each: what a model's weights can be expected to be, for a live stream."""
        middle, reach = np.asarray(mean, dtype=np.float64), sigmas * np.asarray(sigma, dtype=np.float64)
        return cls(middle - reach, middle + reach)

    @classmethod
    def of_clip(cls, weights: ArrayLike) -> Rebased:
        """The smallest and largest of each weight (frames, K) of a take: not one of them is outside 0..1."""
        rows = np.asarray(weights, dtype=np.float64)
        if rows.ndim != 2 or not len(rows):
            raise InputError(f"weights of the shape {rows.shape} have no range; expected frames of weights.")
        return cls(rows.min(axis=0), rows.max(axis=0))

    @property
    def span(self) -> FloatArray:
        """(K,) high - low."""
        return np.asarray(self.high - self.low)

    def to_unit(self, weights: ArrayLike) -> FloatArray:
        """w' (..., K) of raw weights (..., K). Not clamped: outside 0..1 the mesh is still exact."""
        still = self.span == 0
        unit = (np.asarray(weights, dtype=np.float64) - self.low) / np.where(still, 1.0, self.span)
        return np.where(still, 0.0, unit)

    def to_raw(self, unit: ArrayLike) -> FloatArray:
        """The inverse of `to_unit`, where a direction moves."""
        return np.asarray(self.low + np.asarray(unit, dtype=np.float64) * self.span)

    def base(self, speaker: SpeakerModel) -> FloatArray:
        """base' (k,) mm."""
        return np.asarray(speaker.base + self.low @ speaker.directions)

    def directions(self, speaker: SpeakerModel) -> FloatArray:
        """T' (K, k) mm."""
        return np.asarray(self.span[:, None] * speaker.directions)
