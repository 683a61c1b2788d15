"""What drives an avatar: named numbers, made from a pose by a vocabulary."""

from __future__ import annotations

from typing import Protocol

from ..pose import FloatArray, TrackedPose


class AvatarValues(Protocol):
    """Named numbers of a pose. names: as the receiver knows them, with capitals as they are."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def values(self, pose: TrackedPose) -> FloatArray:
        """(names,) within 0..1, or -1..1 for an axis with two ends."""
