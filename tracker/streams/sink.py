"""What every way out of the tracker has in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ..pose import FloatArray, TrackedPose


@dataclass(frozen=True)
class StreamInfo:
    """What a receiver needs once to make sense of the coefficients that follow.

    mean, sigma: (K,) of the coefficients; speaker_weights: (m,) raw, the mean where the speaker is free.
    roles: of the tracked coils, in the order of the residuals. rate_hz: nominal frames a second.
    """

    model_name: str
    model_fingerprint: str
    vertex_count: int
    mean: FloatArray
    sigma: FloatArray
    speaker_weights: FloatArray
    speaker_fixed: bool
    roles: tuple[str, ...]
    rate_hz: float


class Sink(Protocol):
    """Where poses go. `send` is called in the loop's thread: it must neither wait nor raise for a peer.

    The pose it gets is the tracker's own, which the next frame overwrites: a sink copies what it keeps.
    A sink that needs longer takes the pose into a slot of its own and works in a thread of its own.
    """

    @property
    def destination(self) -> str:
        """Where it sends to, for people."""

    @property
    def sent(self) -> int:
        """Poses handed on so far."""

    @property
    def dropped(self) -> int:
        """Poses that could not be handed on."""

    def start(self, info: StreamInfo) -> None:
        """Called once, before the first frame: everything that takes time happens here."""

    def send(self, pose: TrackedPose) -> None:
        """Called for every frame."""

    def close(self) -> None:
        """Called once, after the last frame."""
