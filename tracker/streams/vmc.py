"""The VMC protocol: blend shapes for avatar programs, sent as an Assistant.

Source: "VMC Protocol specification" (https://protocol.vmc.info/specification, /marionette-spec, /performer-spec). An
Assistant adds a part of the face and sends to a Performer, by default at port 39540, which passes it on to what draws
(the Marionette, 39539). Names are case sensitive; a receiver leaves alone what it does not know.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..pose import PoseStatus, TrackedPose
from .addresses import Address, Argument
from .packing import PackedBundle, in_datagrams, osc_message
from .sink import StreamInfo
from .udp import UdpSender

if TYPE_CHECKING:
    from .avatar import AvatarValues

DEFAULT_DESTINATION = "127.0.0.1:39540"
LOADED, CALIBRATED, NORMAL_MODE = 1, 3, 0
TRACKING_OK, TRACKING_BAD = 1, 0

VMC_OK = Address(
    "/VMC/Ext/OK",
    (
        Argument("loaded", "i", limits=(0, 1)),
        Argument("calibration state", "i", limits=(0, 3)),
        Argument("calibration mode", "i", limits=(0, 2)),
        Argument("tracking status", "i", limits=(0, 1)),
    ),
    "first in every bundle",
    f"Always loaded, calibrated ({CALIBRATED}) and in normal mode; the tracking status is 1 while the pose's status is ok, "
    "else 0. The form of version 2.7.",
)
VMC_TIME = Address(
    "/VMC/Ext/T",
    (Argument("time", "f", "s"),),
    "second in every bundle",
    "The device's, since this stream's first pose.",
)
VMC_VALUE = Address(
    "/VMC/Ext/Blend/Val",
    (Argument("name", "s"), Argument("value", "f", limits=(0.0, 1.0))),
    "for every name of the preset",
    "A blend shape. Axes with two ends are left out: blend shapes are 0 to 1, and both ends have names of their own.",
)
VMC_APPLY = Address(
    "/VMC/Ext/Blend/Apply", (), "last", "The values since the last one belong together and are to be shown."
)
VMC_ADDRESSES = (VMC_OK, VMC_TIME, VMC_VALUE, VMC_APPLY)


class VmcWorker:
    """A pose is one bundle; where the names of a preset are too many for one, several, and the last one applies.

    Every bundle is at most MAX_DATAGRAM_BYTES long, below the protocol's 1500. values: without signed ones.
    """

    def __init__(self, destination: str, values: AvatarValues) -> None:
        self.destination = f"vmc {destination}"
        self._sender = UdpSender(destination)
        self._values = values
        head = [
            osc_message(VMC_OK, (LOADED, CALIBRATED, NORMAL_MODE, TRACKING_BAD)),
            osc_message(VMC_TIME, (0.0,)),
        ]
        body = [osc_message(VMC_VALUE, (name, 0.0)) for name in values.names]
        groups = in_datagrams([*body, osc_message(VMC_APPLY)], first=head)
        self._bundles = [PackedBundle(group) for group in groups]
        self._start_s: float | None = None

    def begin(self, info: StreamInfo) -> None:
        """Nothing to say: the protocol has no greeting."""

    def work(self, pose: TrackedPose) -> None:
        if self._start_s is None:
            self._start_s = pose.device_time_s
        status = TRACKING_OK if pose.status == PoseStatus.OK and pose.has_shape else TRACKING_BAD
        values = iter(self._values.values(pose).tolist())
        for bundle in self._bundles:
            bundle.set(0, LOADED, CALIBRATED, NORMAL_MODE, status)
            bundle.set(1, pose.device_time_s - self._start_s)
            for message in range(2, len(bundle.places)):
                if bundle.numbers[message]:  # all but the one that applies
                    bundle.set(message, next(values))
            bundle.pack()
            self._sender.send(bundle.datagram)

    def end(self) -> None:
        self._sender.close()
