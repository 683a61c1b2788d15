"""What a take holds: four XDF streams, and the row in which the loop hands over one frame.

| stream | type | channels |
|---|---|---|
| `raw` | MoCap | the device's frame as it came: time, number, every coil's position, and what else it has |
| `prepared` | MoCap | the tracked coils in the model frame, before any was distrusted |
| `pose` | TonguePose | what the tracker made of it |
| `markers` | Markers | text: marks by the user, what the source said, every change of the set-up |

All numbers are double64, so that a replay gives the same bits. A sample's time stamp is its arrival on
this host, `time.perf_counter`, in s; the three number streams have one sample a frame, with equal stamps.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ...drivers.frames import FrameOfReference
from ..pose import FloatArray

RAW, PREPARED, POSE, MARKERS = "raw", "prepared", "pose", "markers"
STREAM_IDS = {RAW: 1, PREPARED: 2, POSE: 3, MARKERS: 4}
STREAM_TYPES = {RAW: "MoCap", PREPARED: "MoCap", POSE: "TonguePose", MARKERS: "Markers"}

# Markers that the program writes begin with one of these words and a colon; all others are the user's.
SESSION_MARK = "session"  # then the session as TOML, see `session_mark`
SOURCE_MARK = "source"  # then what the source said
MARKER_WORDS = (SESSION_MARK, SOURCE_MARK)
_FROM_FRAME = re.compile(r"# from frame (\d{1,15}) on\n")


def session_mark(session_toml: str, frame: int) -> str:
    """The mark of a set-up that holds from the take's frame `frame` on, counted from 0.

    The frame is named because its time does not tell: frames that arrived in one piece have the same.
    """
    return f"{SESSION_MARK}: # from frame {frame} on\n{session_toml}"


def session_frame(content: str, default: int) -> int:
    """The frame that such a mark's content names, `default` where it names none."""
    found = _FROM_FRAME.match(content)
    return int(found[1]) if found else default


def user_mark(text: str) -> str:
    """A user's text as a mark that is not taken for one of the program's."""
    word, colon, _ = text.partition(":")
    return f"mark: {text}" if colon and word in MARKER_WORDS else text


POSE_HEAD = ("status", "speaker_fixed", "valid_coils", "energy", "residual_mm", "solved_after_s")


@dataclass(frozen=True)
class TakeInfo:
    """Everything about a take that does not change while it lasts.

    source: the address of the device; coils: its coils; rate_hz: nominal, 0.0 = unknown; frame: its frame
    of reference. quaternions, rms, status: whether the device's frames have them.
    roles, vertices: of the tracked coils; pose_mean, pose_sigma: (K,); speaker_size: m.
    session_toml: the session as a file would hold it. started: ISO 8601 with the zone.
    """

    source: str
    coils: tuple[str, ...]
    rate_hz: float
    frame: FrameOfReference
    quaternions: bool
    rms: bool
    status: bool
    roles: tuple[str, ...]
    vertices: tuple[int, ...]
    model_name: str
    model_fingerprint: str
    pose_mean: FloatArray
    pose_sigma: FloatArray
    speaker_size: int
    session_toml: str
    started: str
    version: str

    @property
    def raw_labels(self) -> tuple[str, ...]:
        """Channels of `raw`: time, number, all positions, then all of what else the device has."""
        labels = ["device_time_s", "frame_number"]
        labels += [f"{coil}_{axis}" for coil in self.coils for axis in "xyz"]
        if self.quaternions:
            labels += [f"{coil}_q{part}" for coil in self.coils for part in "wxyz"]
        if self.rms:
            labels += [f"{coil}_rms" for coil in self.coils]
        if self.status:
            labels += [f"{coil}_status" for coil in self.coils]
        return tuple(labels)

    @property
    def prepared_labels(self) -> tuple[str, ...]:
        return tuple(f"{role}_{axis}" for role in self.roles for axis in "xyz")

    @property
    def pose_labels(self) -> tuple[str, ...]:
        """Channels of `pose`; weights are raw, states are `CoilState` numbers."""
        labels = list(POSE_HEAD)
        labels += [f"pose_{k + 1}" for k in range(len(self.pose_mean))]
        labels += [f"speaker_{k + 1}" for k in range(self.speaker_size)]
        labels += [f"{role}_residual_mm" for role in self.roles]
        labels += [f"{role}_state" for role in self.roles]
        return tuple(labels)

    def row_dtype(self) -> np.dtype:
        return row_dtype(len(self.raw_labels), len(self.prepared_labels), len(self.pose_labels))


def row_dtype(raw: int, prepared: int, pose: int) -> np.dtype:
    """One frame as the loop hands it over, for so many channels a stream.

    Every column is made of words of 8 bytes. `sequence` counts the take's frames from 1: frame i is sample i of
    the three number streams.
    """
    return np.dtype(
        [
            ("arrival_ns", "<i8"),
            (RAW, "<f8", (raw,)),
            (PREPARED, "<f8", (prepared,)),
            (POSE, "<f8", (pose,)),
            ("sequence", "<i8"),
        ]
    )
