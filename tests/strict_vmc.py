"""A receiver of the VMC protocol, as its specification describes a Performer's input (V2.7 and later).

https://protocol.vmc.info/specification, /marionette-spec, /performer-spec: bundles within 1500 bytes, strings in
UTF-8, right types only, values stored up until Apply. Unknown addresses would be left alone by a real receiver;
here they are refused, for none should come. Names are compared with their capitals.
"""

from strict_osc import insist, strict_bundle

MOST_BYTES = 1500
FORMS = {
    "/VMC/Ext/OK": (",i", ",iii", ",iiii"),
    "/VMC/Ext/T": (",f",),
    "/VMC/Ext/Blend/Val": (",sf",),
    "/VMC/Ext/Blend/Apply": (",",),
}


class Performer:
    """What a face looks like after the datagrams that were received: `shown`, by name."""

    def __init__(self, names):
        self.names = set(names)
        self.stored, self.shown = {}, {}
        self.loaded = self.calibration = self.tracking = self.time_s = None
        self.applied = 0

    def receive(self, datagram):
        for address, tags, values in strict_bundle(datagram, "ifs", MOST_BYTES, "utf-8"):
            insist(address in FORMS, f"{address} is unknown")
            insist(tags in FORMS[address], f"{address} has the types {tags}")
            if address == "/VMC/Ext/OK":
                insist(values[0] in (0, 1) and values[1] in (0, 1, 2, 3), "a state that does not exist")
                insist(values[2] in (0, 1, 2) and values[3] in (0, 1), "a state that does not exist")
                self.loaded, self.calibration, _, self.tracking = values
            elif address == "/VMC/Ext/T":
                (self.time_s,) = values
            elif address == "/VMC/Ext/Blend/Val":
                name, value = values
                insist(name in self.names, f"the avatar has no blend shape {name}")
                insist(0.0 <= value <= 1.0, f"{name} = {value} is outside 0..1")
                self.stored[name] = value
            else:
                self.shown, self.stored = dict(self.stored), {}
                self.applied += 1
