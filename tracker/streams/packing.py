"""The bytes of OSC 1.0 datagrams: messages by the rows of a table, bundles, and bundles whose numbers are written over.

Layout: https://opensoundcontrol.stanford.edu/spec-1_0.html. python-osc encodes, once; a frame costs one `struct` call.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder

from ... import InputError
from .addresses import MAX_DATAGRAM_BYTES, Address

MAX_NAME_LENGTH = 120
BUNDLE_HEADER_BYTES = 16
ELEMENT_HEADER_BYTES = 4
SEQUENCE_MASK = 0x7FFF_FFFF
_NUMBERS_AT_THE_END = re.compile(r"[if]*$")


def osc_message(row: Address, values: Iterable[Any] = (), path: str = "") -> bytes:
    """One OSC message for a row of a table; `path` where the row's holds a <k> or <name>."""
    builder = OscMessageBuilder(path or row.path)
    values = list(values)
    tags = [argument.tag for argument in row.arguments]
    if row.arguments and row.arguments[-1].count:
        tags[-1:] = tags[-1:] * (len(values) - len(tags) + 1)
    for value, tag in zip(values, tags, strict=True):
        # The type tag of a truth value is its value.
        builder.add_arg(value, ("T" if value else "F") if tag == "T" else tag)
    return bytes(builder.build().dgram)


def bundle_bytes(messages: Sequence[bytes]) -> int:
    """How long `osc_bundle` would be."""
    return BUNDLE_HEADER_BYTES + sum(ELEMENT_HEADER_BYTES + len(message) for message in messages)


def osc_bundle(messages: Sequence[bytes]) -> bytes:
    """One bundle with the time tag "immediately"."""
    builder = OscBundleBuilder(IMMEDIATELY)
    for message in messages:
        builder.add_content(OscMessage(message))
    return bytes(builder.build().dgram)


def in_datagrams(messages: Iterable[bytes], first: Sequence[bytes] = ()) -> list[list[bytes]]:
    """The messages, in their order, in as few bundles of at most MAX_DATAGRAM_BYTES as that takes.

    first: messages that every bundle begins with. Raises InputError where one alone is too long.
    """
    groups: list[list[bytes]] = []
    for message in messages:
        if bundle_bytes([*first, message]) > MAX_DATAGRAM_BYTES:
            path = message.split(b"\0", 1)[0].decode()
            raise InputError(
                f"the message {path} needs {len(message)} bytes, more than an OSC datagram of "
                f"{MAX_DATAGRAM_BYTES} holds; use a model or session with fewer entries."
            )
        if not groups or bundle_bytes([*groups[-1], message]) > MAX_DATAGRAM_BYTES:
            groups.append(list(first))
        groups[-1].append(message)
    return groups


def osc_text(text: str, cut_front: bool = False) -> str:
    """OSC strings are ASCII without zeros; names of people's files are cut to what a datagram bears."""
    plain = text.encode("ascii", "replace").decode().replace("\0", "?")
    if len(plain) <= MAX_NAME_LENGTH:
        return plain
    kept = MAX_NAME_LENGTH - 3
    return "..." + plain[-kept:] if cut_front else plain[:kept] + "..."


class PackedBundle:
    """A bundle whose numbers are written over: those i and f that stand at the end of each of its messages.

    datagram: the bytes to send. parts: what `pack` packs, bytes and numbers; places: for each message, where in
    `parts` its numbers begin; numbers: how many they are.
    """

    def __init__(self, messages: Sequence[bytes]) -> None:
        self.datagram = bytearray(osc_bundle(messages))
        # One format for the whole datagram: what never changes is packed as bytes, between the numbers. After the
        # pause between two frames that takes a third of the time of writing through arrays.
        layout = ">"
        self.parts: list[Any] = []
        self.places: list[int] = []
        self.numbers: list[int] = []
        at, end = 0, BUNDLE_HEADER_BYTES
        for message in messages:
            end += ELEMENT_HEADER_BYTES + len(message)
            tags = _numbers_at_the_end(message)
            numbers_at = end - 4 * len(tags)
            layout += f"{numbers_at - at}s{tags}"
            self.parts.append(bytes(self.datagram[at:numbers_at]))
            self.places.append(len(self.parts))
            self.numbers.append(len(tags))
            self.parts += struct.unpack_from(f">{tags}", self.datagram, numbers_at)
            at = end
        self._pack_into = struct.Struct(layout).pack_into

    def set(self, message: int, *numbers: float) -> None:
        """Other numbers for one message, as many as it has; `pack` writes them."""
        place = self.places[message]
        self.parts[place : place + self.numbers[message]] = numbers

    def pack(self) -> None:
        """Writes all numbers into the datagram."""
        self._pack_into(self.datagram, 0, *self.parts)


class NumbersMessage:
    """A message that ends in `count` numbers (i or f), encoded but for them."""

    def __init__(self, row: Address, count: int, path: str = "") -> None:
        message = osc_message(row, [0] * count, path)
        tags = _numbers_at_the_end(message)
        self._head = struct.pack(">i", len(message)) + message[: len(message) - 4 * len(tags)]
        self._pack = struct.Struct(f">{tags}").pack

    def element(self, *numbers: float) -> bytes:
        """With these numbers, as it stands in a bundle: its size before it."""
        return self._head + self._pack(*numbers)


BUNDLE_HEADER = b"#bundle\0" + struct.pack(">Q", 1)
"""1 is the time tag that means "immediately"."""


def bundles_of(elements: Iterable[bytes], first: bytes) -> Iterator[bytes]:
    """Bundles of at most MAX_DATAGRAM_BYTES, each beginning with the same element; none where there is no other."""
    begun = BUNDLE_HEADER + first
    parts, size = [begun], len(begun)
    for element in elements:
        if size + len(element) > MAX_DATAGRAM_BYTES and len(parts) > 1:
            yield b"".join(parts)
            parts, size = [begun], len(begun)
        parts.append(element)
        size += len(element)
    if len(parts) > 1:
        yield b"".join(parts)


def _numbers_at_the_end(message: bytes) -> str:
    comma = message.index(b",", message.index(b"\0"))
    tags = message[comma + 1 : message.index(b"\0", comma)].decode()
    found = _NUMBERS_AT_THE_END.search(tags)
    return found.group() if found else ""
