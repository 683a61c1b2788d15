"""Avatar parameters of VRChat, with the names of VRCFaceTracking's Unified Expressions.

Sources: "OSC Avatar Parameters" and "OSC DIY" (https://docs.vrchat.com/docs/osc-avatar-parameters, /osc-diy): one value
a message, of type int, float or bool, at /avatar/parameters/NAME, to port 9000; a parameter that the avatar does not
have is left alone. VRCFaceTracking's parameters (https://docs.vrcft.io/docs/tutorial-avatars/tutorial-avatars-extras/
parameters): v2/NAME, also as FT/v2/NAME, which the common avatar templates use; LipTrackingActive and
ExpressionTrackingActive switch such an avatar between tracking and its own animations.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from ... import InputError
from ..pose import PoseStatus, TrackedPose
from .addresses import Address, Argument
from .packing import PackedBundle, in_datagrams, osc_message
from .sink import StreamInfo
from .udp import UdpSender

if TYPE_CHECKING:
    from .avatar import AvatarValues

DEFAULT_DESTINATION = "127.0.0.1:9000"
UNIFIED = "unified"
"""The preset whose names are VRCFaceTracking's."""
_PARAMETER = re.compile(r"[!-~]+")
_RESERVED = re.compile(r"[#*,?\[\]{}]")

PARAMETER = Address(
    "/avatar/parameters/<name>",
    (Argument("value", "f", limits=(-1.0, 1.0)),),
    "for every name of the preset",
    "A parameter of the avatar. Names of the preset `unified` stand as v2/NAME and as FT/v2/NAME.",
)
LIP_ACTIVE = Address(
    "/avatar/parameters/LipTrackingActive",
    (Argument("active", "T"),),
    "first in every bundle",
    "True unless the pose's status is lost.",
)
EXPRESSION_ACTIVE = Address(
    "/avatar/parameters/ExpressionTrackingActive",
    (Argument("active", "T"),),
    "first in every bundle",
    "The same, by its newer name.",
)
VRCHAT_ADDRESSES = (LIP_ACTIVE, EXPRESSION_ACTIVE, PARAMETER)


def parameter_prefixes(preset: str) -> tuple[str, ...]:
    """What stands before the names of a preset: both places where avatars have VRCFaceTracking's parameters."""
    return ("v2/", "FT/v2/") if preset == UNIFIED else ("",)


class VrchatWorker:
    """A pose is one bundle, or several where there are many names. prefixes: each name is sent once with each.

    Raises InputError where a name cannot stand in an OSC address.
    """

    def __init__(self, destination: str, values: AvatarValues, prefixes: tuple[str, ...]) -> None:
        self.destination = f"vrchat {destination}"
        self._sender = UdpSender(destination)
        self._values = values
        self._copies = len(prefixes)
        for name in values.names:
            if not _PARAMETER.fullmatch(name) or _RESERVED.search(name):
                raise InputError(
                    f"preset {values.preset}: the name '{name}' cannot stand in an OSC address; expected ASCII without "
                    "spaces and # * , ? [ ] { }."
                )
        body = [
            osc_message(PARAMETER, (0.0,), PARAMETER.path.replace("<name>", prefix + name))
            for prefix in prefixes
            for name in values.names
        ]
        # Whether it is active is in the type tags, so there is a set of bundles for either.
        self._bundles = {active: _bundles(body, active) for active in (False, True)}

    def begin(self, info: StreamInfo) -> None:
        """Nothing to say: the protocol has no greeting."""

    def work(self, pose: TrackedPose) -> None:
        values = iter(self._values.values(pose).tolist() * self._copies)
        for bundle in self._bundles[pose.status != PoseStatus.LOST and pose.has_shape]:
            for message, count in enumerate(bundle.numbers):
                if count:
                    bundle.set(message, next(values))
            bundle.pack()
            self._sender.send(bundle.datagram)

    def end(self) -> None:
        self._sender.close()


def _bundles(body: list[bytes], active: bool) -> list[PackedBundle]:
    head = [osc_message(LIP_ACTIVE, (active,)), osc_message(EXPRESSION_ACTIVE, (active,))]
    return [PackedBundle(group) for group in in_datagrams(body, first=head)]
