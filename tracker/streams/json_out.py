"""Every pose in the JSON of the authors' live server, to whoever listens: nobody has to ask with a FIT first.

The server (ema-tracker of the paper's authors) answers on UDP 1235 with one map a datagram; its clients, such as
their Blender front end, need nothing else. Described in `authors`, which answers clients that do ask.
"""

from __future__ import annotations

from ..pose import TrackedPose
from .authors import answer
from .sink import StreamInfo
from .udp import UdpSender


class JsonWorker:
    """One datagram a pose; the time stamp is the device's, in s. A number that JSON does not have is an OSError."""

    def __init__(self, destination: str) -> None:
        self.destination = f"json {destination}"
        self._sender = UdpSender(destination)

    def begin(self, info: StreamInfo) -> None:
        """Nothing to prepare: their protocol has no greeting, and every datagram holds the speaker's weights."""

    def work(self, pose: TrackedPose) -> None:
        try:
            datagram = answer(pose)
        except ValueError as reason:
            raise OSError(str(reason)) from reason
        self._sender.send(datagram)

    def end(self) -> None:
        self._sender.close()
