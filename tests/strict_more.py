"""A receiver of what `send=` adds to our OSC, as docs/osc.md describes it: nothing but what stands there is let pass."""

import re

import numpy as np
from strict_osc import insist, strict_bundle

MOST_BYTES = 1400
MOST_BLOB_BYTES = 1300
NAME = r"[A-Za-z0-9_.-]{1,80}"


class Receiver:
    """What is known after the datagrams that were received.

    coils, shapes, gaps: by name, of the newest pose; unit, low, high, contact: lists; vertices: (V, 3) mm, NaN where no
    chunk has come; poses: sequence number -> (frame number, time).
    """

    def __init__(self, vertices):
        self.vertices = np.full((vertices, 3), np.nan)
        self.coils, self.shapes, self.gaps, self.poses = {}, {}, {}, {}
        self.unit = self.low = self.high = self.contact = self.newest = None
        self.chunks = set()

    def receive(self, datagram):
        messages = strict_bundle(datagram, "ifb", MOST_BYTES)
        if messages[0][0] == "/tongue/mesh":
            insist(len(messages) == 1, "a chunk of the mesh is not alone")
            self._mesh(*messages[0][1:])
            return
        address, tags, values = messages[0]
        insist((address, tags) == ("/tongue/extra", ",iif"), "a bundle does not say which pose it is of")
        number, frame, time_s = values
        if number != self.newest:
            insist(self.newest is None or number == self.newest + 1, "a pose is missing")
            self.newest, self.coils, self.shapes, self.gaps = number, {}, {}, {}
            self.contact = None
        insist(self.poses.setdefault(number, (frame, time_s)) == (frame, time_s), "one pose, two frames")
        insist(len(messages) > 1, "a bundle says nothing")
        seen = [address for address, _, _ in messages]
        insist(len(seen) == len(set(seen)), "an address stands twice in a bundle")
        for message in messages[1:]:
            self._one(*message)

    def _one(self, address, tags, values):
        count = len(values)
        insist(tags == "," + "f" * count, f"{address} has the types {tags}")
        for kind, size, place in (("coil", 3, self.coils), ("shape", 1, self.shapes), ("gap", 1, self.gaps)):
            if found := re.fullmatch(f"/tongue/{kind}/({NAME})", address):
                insist(count == size, f"{address} has {count} numbers")
                insist(found.group(1) not in place, f"{address} comes twice")
                place[found.group(1)] = values
                insist(kind != "shape" or 0.0 <= values[0] <= 1.0, f"{address} is outside 0..1")
                return
        name = address.removeprefix("/tongue/")
        insist(name in ("unit", "low", "high", "contact"), f"{address} is unknown")
        insist(name != "contact" or count == 4, "/tongue/contact has not 4 numbers")
        setattr(self, name, values)

    def _mesh(self, tags, values):
        insist(tags == ",iiiifb", f"/tongue/mesh has the types {tags}")
        _, chunk, chunks, first, step, blob = values
        insist(0 <= chunk < chunks, "a chunk beyond the last")
        insist(0 < len(blob) <= MOST_BLOB_BYTES and len(blob) % 6 == 0, f"a blob of {len(blob)} bytes")
        part = np.frombuffer(blob, ">i2").reshape(-1, 3)
        insist(0 <= first and first + len(part) <= len(self.vertices), "vertices beyond the last")
        self.vertices[first : first + len(part)] = part * float(step)
        self.chunks.add((chunk, chunks))
