"""An avatar in VRChat that has VRCFaceTracking's tongue parameters, as their documentations describe them.

https://docs.vrchat.com/docs/osc-avatar-parameters and /osc-diy: one value a message; int, float and bool only; floats
within -1..1; names with their capitals. https://docs.vrcft.io (parameters): v2/ before every name, and as FT/v2/.
"""

from strict_osc import insist, strict_bundle

MOST_BYTES = 4096  # the buffer that VRCFaceTracking sends from
TONGUE = (
    "TongueOut", "TongueUp", "TongueDown", "TongueRight", "TongueLeft", "TongueRoll", "TongueBendDown",
    "TongueCurlUp", "TongueSquish", "TongueFlat", "TongueTwistRight", "TongueTwistLeft",
    "TongueX", "TongueY", "TongueArchY", "TongueShape",
)  # fmt: skip
SIGNED = ("TongueX", "TongueY", "TongueArchY", "TongueShape")
STATES = ("LipTrackingActive", "ExpressionTrackingActive")
ROOT = "/avatar/parameters/"


class Avatar:
    """floats and states: what was received last, by parameter."""

    def __init__(self, names=tuple(f"{prefix}{name}" for prefix in ("v2/", "FT/v2/") for name in TONGUE)):
        self.names = set(names)
        self.floats, self.states = {}, {}

    def receive(self, datagram):
        for address, tags, values in strict_bundle(datagram, "ifTF", MOST_BYTES):
            insist(address.startswith(ROOT), f"{address} is no parameter")
            insist(len(values) == 1, f"{address} has {len(values)} values")
            name = address.removeprefix(ROOT)
            if name in STATES:
                insist(tags in (",T", ",F"), f"{name} is a bool")
                self.states[name] = values[0]
                continue
            insist(name in self.names, f"the avatar has no parameter {name}")
            insist(tags == ",f", f"{name} is a float")
            lowest = -1.0 if name.rpartition("/")[2] in SIGNED else 0.0
            insist(lowest <= values[0] <= 1.0, f"{name} = {values[0]} is outside its range")
            self.floats[name] = values[0]
