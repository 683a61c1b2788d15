"""A decoder of OSC 1.0 as its specification describes it, which refuses what a lenient one would let pass.

https://opensoundcontrol.stanford.edu/spec-1_0.html: sizes are multiples of four, strings are padded with zeros, every
type tag is one that was asked for, nothing is left over.
"""

import math
import struct

IMMEDIATELY = 1
RESERVED = set(" #*,?[]{}")


class Refused(AssertionError):
    """The datagram is not what its specification says."""


def insist(holds, why):
    if not holds:
        raise Refused(why)


def strict_string(data, at, encoding="ascii"):
    end = data.find(b"\0", at)
    insist(end >= 0, "a string does not end")
    following = end + 1 + -(end + 1) % 4
    insist(following <= len(data), "the padding is missing")
    insist(set(data[end:following]) == {0}, "the padding is not zero")
    return data[at:end].decode(encoding), following


def strict_message(data, tags_allowed, encoding="ascii"):
    """(address, type tags, values) of one message whose type tags are among `tags_allowed`."""
    insist(len(data) % 4 == 0, "the size is no multiple of four")
    address, at = strict_string(data, 0)
    insist(address.startswith("/"), "the address has no slash")
    insist(not set(address) & RESERVED, "the address has reserved characters")
    tags, at = strict_string(data, at)
    insist(tags.startswith(","), "there are no type tags")
    values = []
    for tag in tags[1:]:
        insist(tag in tags_allowed, f"the type tag {tag} is unknown here")
        if tag in "TF":
            values.append(tag == "T")
        elif tag == "s":
            value, at = strict_string(data, at, encoding)
            values.append(value)
        elif tag == "b":
            (size,) = struct.unpack_from(">i", data, at)
            insist(0 <= size <= len(data) - at - 4, "a blob is longer than its message")
            padded = size + -size % 4
            insist(set(data[at + 4 + size : at + 4 + padded]) <= {0}, "a blob's padding is not zero")
            values.append(data[at + 4 : at + 4 + size])
            at += 4 + padded
        else:
            insist(at + 4 <= len(data), "a number is missing")
            (value,) = struct.unpack_from({"i": ">i", "f": ">f"}[tag], data, at)
            insist(math.isfinite(value), "a number is none")
            values.append(value)
            at += 4
    insist(at == len(data), "bytes are left over")
    return address, tags, values


def strict_bundle(data, tags_allowed, longest, encoding="ascii"):
    """[(address, type tags, values)] of a bundle without bundles in it, of at most `longest` bytes."""
    data = bytes(data)
    insist(len(data) <= longest, f"{len(data)} bytes are more than {longest}")
    insist(data[:8] == b"#bundle\0", "this is no bundle")
    insist(data[8:16] == struct.pack(">Q", IMMEDIATELY), "it is not for now")
    messages, at = [], 16
    while at < len(data):
        insist(at + 4 <= len(data), "a size is cut off")
        (size,) = struct.unpack_from(">i", data, at)
        insist(0 < size <= len(data) - at - 4, "an element is longer than its bundle")
        messages.append(strict_message(data[at + 4 : at + 4 + size], tags_allowed, encoding))
        at += 4 + size
    return messages
