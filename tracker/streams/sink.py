"""What every way out of the tracker has in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from ..pose import FloatArray, TrackedPose

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel


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


@dataclass(frozen=True)
class StreamContext:
    """What a stream may know of a run beyond `StreamInfo`, to turn weights into shapes, points and distances.

    palate: (p, 3) mm in the model frame, from front to back, or None; ranges: of the speaker's avatar shapes, name ->
    lowest and highest value, empty where they were never measured; name: of the stream, for people and receivers;
    control: HOST:PORT where the run takes control messages over OSC, "" = nowhere; shown_speaker: (m,) raw weights of
    the speaker on whose anatomy meshes are made, None = of the one who is tracked; shown_palate: (p, 3) mm, of that speaker.
    """

    model: TongueModel
    palate: FloatArray | None = None
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    name: str = "tonguetrack"
    control: str = ""
    shown_speaker: FloatArray | None = None
    shown_palate: FloatArray | None = None


Pair = tuple[float | None, float | None]
"""p50 and p99, None = unknown."""


@dataclass(frozen=True)
class LiveNumbers:
    """What a live run says of itself once a second.

    device_to_host_ms: how much later than the earliest the frames arrive, by the device's clock; host_to_solved_ms:
    from a frame's arrival to its pose; solved_to_sent_ms: from there until every sink had it.
    take_path: of the take that is being written, "" = none; take_frames: in it so far; take_failure: why it is
    no longer written, "" = nothing is wrong.
    """

    device_to_host_ms: Pair = (None, None)
    host_to_solved_ms: Pair = (None, None)
    solved_to_sent_ms: Pair = (None, None)
    take_path: str = ""
    take_frames: int = 0
    take_failure: str = ""


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

    def change(self, info: StreamInfo) -> None:
        """Called in the loop's thread when the info is another one, as when the speaker was fixed. The model stays."""

    def send(self, pose: TrackedPose) -> None:
        """Called for every frame."""

    def close(self) -> None:
        """Called once, after the last frame."""
