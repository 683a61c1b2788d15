"""Outlets of the Lab Streaming Layer: the coils as a MoCap stream, the pose beside it.

Sources: "MoCap Meta Data" of the XDF project (https://github.com/sccn/xdf/wiki/MoCap-Meta-Data) for what a MoCap stream
says of its channels: label, marker, object, type and unit, positions in metres; the documentation of liblsl
(https://labstreaminglayer.readthedocs.io) for names, rates, source ids and time stamps.
"""

from __future__ import annotations

import re
import socket
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from ... import InputError
from ..pose import TrackedPose
from .sink import StreamInfo

METRES_PER_MM = 1e-3
OBJECT = "tongue"
POSE_SUFFIX = " pose"
COILS_TYPE, POSE_TYPE = "MoCap", "Misc"
COORDINATES = "model frame: x to the speaker's left, y front to back, z up; right-handed"
MAX_NAME = 100
_NAME = re.compile(r"[^'\"\x00-\x1f]+")


@dataclass(frozen=True)
class Channel:
    """What a stream says of one channel, by the names of the XDF project; "" = nothing."""

    label: str
    type: str
    unit: str
    marker: str = ""
    object: str = ""


def coil_channels(roles: tuple[str, ...]) -> tuple[Channel, ...]:
    """Three positions in metres for each coil, NaN while it is missing."""
    return tuple(
        Channel(f"{role}_{axis.lower()}", f"Position{axis}", "meters", role, OBJECT)
        for role in roles
        for axis in "XYZ"
    )


def pose_channels(coefficients: int, speaker_weights: int) -> tuple[Channel, ...]:
    """The coefficients raw and in sigma, the speaker's weights, and how far all of it can be trusted."""
    return (
        *(Channel(f"weight_{k}", "PoseWeight", "raw") for k in range(coefficients)),
        *(Channel(f"sigma_{k}", "PoseWeight", "sigma") for k in range(coefficients)),
        *(Channel(f"speaker_{k}", "SpeakerWeight", "raw") for k in range(speaker_weights)),
        Channel("residual", "Residual", "millimeters"),
        Channel("valid_coils", "Count", "coils"),
        Channel("status", "Status", "0 lost, 1 ok, 2 held, 3 relaxing"),
    )


class LslWorker:
    """Two outlets: NAME, of type MoCap, with the coils; "NAME pose" with the coefficients.

    A sample's stamp is the frame's arrival at this computer, in LSL's clock, and so the same in both. paced: the poses
    come at another rate than the device's, so that the streams are announced as irregular; else every pose is a sample
    and the device's rate is told. The source ids stay the same from run to run, so that an inlet finds its stream again.
    Raises InputError where pylsl is not installed or the name is none.
    """

    def __init__(self, name: str, paced: bool) -> None:
        if len(name) > MAX_NAME or not _NAME.fullmatch(name):
            raise InputError(
                f"lsl:{name}: expected a name of at most {MAX_NAME} characters, without quotation marks, for the stream."
            )
        self.destination = f"lsl {name}"
        self._name = name
        self._paced = paced
        self._lsl = _pylsl()
        self._shape: tuple[tuple[str, ...], int, int, float] | None = None
        self._coils: Any = None
        self._pose: Any = None

    def begin(self, info: StreamInfo) -> None:
        """Opens the outlets. Another speaker or pace of the same model and coils changes nothing of them."""
        shape = (info.roles, len(info.mean), len(info.speaker_weights), info.rate_hz)
        if shape == self._shape:
            return
        self.end()
        self._coils = self._outlet(self._name, COILS_TYPE, coil_channels(info.roles), info)
        self._pose = self._outlet(
            self._name + POSE_SUFFIX,
            POSE_TYPE,
            pose_channels(len(info.mean), len(info.speaker_weights)),
            info,
        )
        self._shape = shape

    def work(self, pose: TrackedPose) -> None:
        age_s = (time.perf_counter_ns() - pose.arrival_ns) * 1e-9
        stamp = self._lsl.local_clock() - age_s
        if self._coils is not None:
            self._coils.push_sample((pose.coils.ravel() * METRES_PER_MM).tolist(), stamp)
        numbers = np.concatenate([pose.weights, pose.normalised, pose.speaker_weights])
        self._pose.push_sample(
            [*numbers.tolist(), pose.residual_mm, float(pose.valid_coils), float(pose.status)], stamp
        )

    def end(self) -> None:
        """An outlet is gone from the network when nothing refers to it."""
        self._coils = self._pose = self._shape = None

    def _outlet(self, name: str, kind: str, channels: tuple[Channel, ...], info: StreamInfo) -> Any:
        lsl = self._lsl
        if not channels:  # no coil is tracked
            return None
        rate_hz = lsl.IRREGULAR_RATE if self._paced else info.rate_hz
        source_id = f"tonguetrack/{socket.gethostname()}/{name}"
        about = lsl.StreamInfo(name, kind, len(channels), rate_hz, lsl.cf_double64, source_id)
        described = about.desc()
        listed = described.append_child("channels")
        for channel in channels:
            node = listed.append_child("channel")
            for key in ("label", "marker", "object", "type", "unit"):
                if value := getattr(channel, key):
                    node.append_child_value(key, value)
        acquisition = described.append_child("acquisition")
        acquisition.append_child_value("manufacturer", "tonguetrack")
        acquisition.append_child_value("model", info.model_name)
        acquisition.append_child_value("model_fingerprint", info.model_fingerprint)
        setup = described.append_child("setup")
        setup.append_child_value("name", "tongue")
        setup.append_child("objects").append_child("object").append_child_value("label", OBJECT)
        if kind == COILS_TYPE:
            setup.append_child_value("coordinate_system", COORDINATES)
            markers = setup.append_child("markers")
            for role in info.roles:
                markers.append_child("marker").append_child_value("label", role)
        return lsl.StreamOutlet(about, chunk_size=1, max_buffered=60)


def _pylsl() -> Any:
    try:
        import pylsl
    except (ImportError, OSError, RuntimeError) as reason:  # RuntimeError: without its own library
        raise InputError(
            "streams of the Lab Streaming Layer need the extra 'lab': pip install 'tonguetrack[lab]'."
        ) from reason
    return pylsl
