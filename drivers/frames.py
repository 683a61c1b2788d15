"""What every driver produces: a coil frame (one instant), notes between frames, a recording (a whole take)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from .. import InputError

FloatArray = NDArray[np.float64]
StatusArray = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class FrameOfReference:
    """The directions in which a file's axes grow, from the speaker's point of view.

    Each of x, y, z is one of "left", "right", "front", "back", "up", "down", "absent" (2-D data) or
    "unknown" (device axes). `origin` says where zero lies, as far as the format fixes it.
    """

    x: str = "unknown"
    y: str = "unknown"
    z: str = "unknown"
    origin: str = "unknown"

    def __str__(self) -> str:
        return f"x {self.x}, y {self.y}, z {self.z}; origin {self.origin}"


@dataclass(frozen=True, slots=True)
class CoilFrame:
    """All coils at one instant, as a source delivers them.

    positions: (coils, 3) float64, mm, in the source's own frame; NaN = missing, and only that.
    device_time_s: the device's or file's own clock, s.
    frame_number: the device's own count, or the index in the file.
    arrival_ns: the host's `time.perf_counter_ns()` when the frame was complete on this side.
    quaternions: (coils, 4) as (w, x, y, z), NaN = missing; rms: (coils,) the device's own fit error in its
    own unit; status: (coils,) the device's own word a coil, as it came. None = the device has none.

    The arrays of a live source are written over by the next frame: whoever keeps a frame copies them.
    """

    positions: FloatArray
    device_time_s: float
    frame_number: int
    arrival_ns: int
    quaternions: FloatArray | None = None
    rms: FloatArray | None = None
    status: StatusArray | None = None


class NoteKind(Enum):
    """What a source may say between two frames."""

    CONNECTED = "connected"  # the device answers (again); frames follow
    DISCONNECTED = (
        "disconnected"  # the link is lost or the device fell silent; the source tries again by itself
    )
    SILENT = "silent"  # nothing came for one tick; repeated for as long as that lasts
    GAP = "gap"  # frames are missing between the last frame and the next; `count` says how many
    CLOCK_RESET = "clock reset"  # the next frame's device time or number does not continue the last one's
    BAD_DATA = "bad data"  # bytes that could not be used were left out; `count` says how many pieces
    COMMAND = "command"  # a client that drives the source asks something of the tracker
    INFO = "info"  # for people


@dataclass(frozen=True, slots=True)
class SourceNote:
    """Something that happened at the source, in the order in which it happened.

    text: one sentence for people; arrival_ns: `time.perf_counter_ns()`; count: of what the kind counts.
    command, values: of a COMMAND, see `devices.authors_live`.
    """

    kind: NoteKind
    text: str
    arrival_ns: int
    count: int = 0
    command: str = ""
    values: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole take in arrays.

    coils: names of the coils, in the file's order.
    positions: (frames, coils, 3) float64, mm, in the file's own frame; NaN = missing.
    times_s: (frames,) float64, strictly increasing, s.
    rate_hz: nominal sampling rate of the file.
    format: which format was recognised, in words ("Carstens AG501 .pos V003").
    frame: the file's frame of reference.
    orientations: (frames, coils, 3) unit vectors of the coil axes, NaN = missing; None = not in the file.
    quaternions: (frames, coils, 4) as (w, x, y, z), NaN = missing; None = not in the file.
    rms: (frames, coils), the device's own fit error in its own unit; None = not in the file.
    source: the path that was opened.
    notes: what was decided or noticed while reading, one sentence each, for the user to see.
    extra: header fields worth keeping, as text.
    device_times_s, frame_numbers: (frames,) the device's own clock and count, where the recording kept them
    beside `times_s`; unlike those they may stand still or jump. status: (frames, coils) the device's word a coil.
    """

    coils: tuple[str, ...]
    positions: FloatArray
    times_s: FloatArray
    rate_hz: float
    format: str
    frame: FrameOfReference = FrameOfReference()
    orientations: FloatArray | None = None
    quaternions: FloatArray | None = None
    rms: FloatArray | None = None
    source: str = ""
    notes: tuple[str, ...] = ()
    extra: Mapping[str, str] = field(default_factory=dict)
    device_times_s: FloatArray | None = None
    frame_numbers: NDArray[np.int64] | None = None
    status: StatusArray | None = None

    def __post_init__(self) -> None:
        frames, coils = len(self.times_s), len(self.coils)
        expected = {
            "positions": (self.positions, (frames, coils, 3)),
            "orientations": (self.orientations, (frames, coils, 3)),
            "quaternions": (self.quaternions, (frames, coils, 4)),
            "rms": (self.rms, (frames, coils)),
            "device_times_s": (self.device_times_s, (frames,)),
            "frame_numbers": (self.frame_numbers, (frames,)),
            "status": (self.status, (frames, coils)),
        }
        for name, (array, shape) in expected.items():
            if array is not None and array.shape != shape:
                raise InputError(
                    f"{self.source or 'recording'}: {name} has shape {array.shape}, expected {shape} for "
                    f"{frames} frames of {coils} coils."
                )
        if len(set(self.coils)) != coils:
            raise InputError(f"{self.source or 'recording'}: a coil name occurs twice in {list(self.coils)}.")

    @property
    def frame_count(self) -> int:
        return len(self.times_s)

    @property
    def duration_s(self) -> float:
        """Time covered by the frames, counting the last frame's own interval."""
        return self.frame_count / self.rate_hz

    def valid(self) -> NDArray[np.bool_]:
        """(frames, coils): True where a coil has a position."""
        return np.asarray(np.isfinite(self.positions).all(axis=2))
