"""Poses for clients of the authors' live server (ema-tracker): one JSON map a datagram, weights and no mesh.

    {"phonemeWeights": [...], "speakerWeights": [...], "timeStamp": t}

and a line end; raw weights, and the time stamp of the FIT that asked, see `drivers.devices.authors_live`.
"""

from __future__ import annotations

import json
import socket

from ..pose import TrackedPose
from .osc import resolve
from .sink import StreamInfo

DEFAULT_DESTINATION = "127.0.0.1:1235"


class AuthorsSink:
    """Answers every pose with one datagram, without ever waiting for the receiver.

    The socket is not connected and does not block: an answer is either handed to the operating system or
    counted in `dropped`. Raises InputError where the destination is not HOST:PORT or its host is unknown.
    """

    def __init__(self, destination: str = DEFAULT_DESTINATION) -> None:
        self.destination = f"udp-json {destination}"
        self.sent = 0
        self.dropped = 0
        family, self._peer = resolve(destination)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def start(self, info: StreamInfo) -> None:
        """Nothing to prepare: their protocol has no greeting."""

    def change(self, info: StreamInfo) -> None:
        """Nothing to tell: every answer holds the speaker's weights."""

    def send(self, pose: TrackedPose) -> None:
        try:
            self._socket.sendto(answer(pose), self._peer)
            self.sent += 1
        except (OSError, ValueError):  # buffer full, nobody there; or a number that JSON does not have
            self.dropped += 1

    def close(self) -> None:
        self._socket.close()


def answer(pose: TrackedPose) -> bytes:
    """The datagram for one pose. Raises ValueError where a number is not finite."""
    content = {
        "phonemeWeights": pose.weights.tolist(),
        "speakerWeights": pose.speaker_weights.tolist(),
        "timeStamp": pose.device_time_s,
    }
    return json.dumps(content, allow_nan=False).encode() + b"\n"
