"""The bytes of RTC3D 1.0, the real-time protocol of NDI Wave, WaveFront and First Principles, both ways.

A packet is a size (u32, counting these 8 bytes), a kind (u32) and a body. These two words are big-endian
whatever was negotiated; numbers in the body of a data frame have the negotiated order. A data frame is a
number of components, each with its size, kind, frame number, time in us and items.

Sources: NDI's sample client (rtC3Dframe, rtC3Dclient) and what public clients of it met on real devices.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from ..frames import FloatArray

PACKET_HEAD = struct.Struct(">II")
LARGEST_PACKET = 50_000  # NDI's own reader takes no more
ERROR, COMMAND, XML, DATA, NO_DATA, C3D = range(6)

BIG, LITTLE = ">", "<"
ORDER_WORDS = {BIG: "BigEndian", LITTLE: "LittleEndian"}

THREE_D, ANALOG, FORCE, SIX_D, EVENT = 1, 2, 3, 4, 5
COMPONENT_HEADS = {order: struct.Struct(order + "IIIQI") for order in ORDER_WORDS}
"""size (all of the component), kind, frame number, time in us (unaligned), number of items"""
COUNTS = {order: struct.Struct(order + "I") for order in ORDER_WORDS}
SHORTEST_COMPONENT = 20  # an unknown kind need not have items

FIELDS = {
    THREE_D: ("x", "y", "z", "reliability"),
    ANALOG: ("volts",),
    FORCE: ("fx", "fy", "fz", "mx", "my", "mz"),
    SIX_D: ("q0", "qx", "qy", "qz", "x", "y", "z", "rms"),
}
FLOATS = {order: np.dtype(order + "f4") for order in ORDER_WORDS}
EVENTS = {
    order: np.dtype(
        [("id", order + "u4"), ("time_us", order + "u8"), ("parameters", order + "u4", 3)], align=False
    )
    for order in ORDER_WORDS
}
ITEM_BYTES = {**{kind: 4 * len(names) for kind, names in FIELDS.items()}, EVENT: EVENTS[BIG].itemsize}

FARTHEST = 1e6  # mm: what is beyond, or not finite, is no measurement
UNRELIABLE = 999.0  # of a 3D item: not available

LONGEST_NAME = 64
MOST_SENSORS = LARGEST_PACKET // 16
PARAMETER_SECTIONS = ("the_6d", "the_3d")
PARAMETER_ITEMS = ("tool", "marker")
PARAMETER_LABELS = ("label", "name")


class Rtc3dError(ValueError):
    """Bytes that are not RTC3D."""


# Packets


@dataclass(frozen=True, slots=True)
class Packet:
    """kind: ERROR to C3D; body: what follows the two words of the head."""

    kind: int
    body: bytes


def encode_packet(kind: int, body: bytes) -> bytes:
    """Raises Rtc3dError where the body is too long for any reader."""
    size = PACKET_HEAD.size + len(body)
    if size > LARGEST_PACKET:
        raise Rtc3dError(f"a packet of {size} bytes is too long; at most {LARGEST_PACKET} are read")
    return PACKET_HEAD.pack(size, kind) + body


def encode_text(kind: int, text: str, nul: bool = False) -> bytes:
    """A packet of ASCII text. nul: end it in a NUL that counts, as NDI's own client does."""
    return encode_packet(kind, text.encode("ascii", "replace") + (b"\0" if nul else b""))


def text_of(body: bytes) -> str:
    """The text of an error, command or XML packet, in either dialect."""
    return body.rstrip(b"\0").decode("ascii", "replace").strip()


class PacketReader:
    """Bytes in as they come, whole packets out: feed, then take packets until there is none, then feed again."""

    def __init__(self) -> None:
        self._held = bytearray()
        self._start = 0

    @property
    def held_bytes(self) -> int:
        """Bytes that wait here; below LARGEST_PACKET whenever `next` had none to give."""
        return len(self._held) - self._start

    def feed(self, data: bytes) -> None:
        """Raises Rtc3dError while whole packets pile up unread: nothing is held but one packet and one read."""
        if self.held_bytes > LARGEST_PACKET:
            raise Rtc3dError("packets are waiting; take them before more bytes are read")
        del self._held[: self._start]
        self._start = 0
        self._held += data

    def next(self) -> Packet | None:
        """The next whole packet. Raises Rtc3dError where no packet can begin; nothing after that makes sense."""
        start, held = self._start, self.held_bytes
        if held < PACKET_HEAD.size:
            return None
        size, kind = PACKET_HEAD.unpack_from(self._held, start)
        if not PACKET_HEAD.size <= size <= LARGEST_PACKET:
            raise Rtc3dError(
                f"a packet of {size} bytes; expected {PACKET_HEAD.size} to {LARGEST_PACKET}, so this is no packet"
            )
        if kind > C3D:
            raise Rtc3dError(f"a packet of the unknown kind {kind}; expected 0 to {C3D}")
        if held < size:
            return None
        self._start = start + size
        return Packet(kind, bytes(self._held[start + PACKET_HEAD.size : start + size]))


# Data frames


@dataclass(frozen=True, slots=True)
class ComponentHead:
    """Where a component lies in a body, and what it says of itself. offset: of its first item."""

    kind: int
    number: int
    time_us: int
    count: int
    offset: int


@dataclass(frozen=True, eq=False, slots=True)
class Component:
    """One component as it came, missing items and all.

    items: (count, fields) float32 in the order of FIELDS[kind]; of events (count,) records of EVENTS.
    number: u32; time_us: u64, since the device began.
    """

    kind: int
    number: int
    time_us: int
    items: NDArray[Any]


def component_heads(body: bytes, order: str) -> Iterator[ComponentHead]:
    """All components of a data frame, checked; those of unknown kinds are left out.

    Raises Rtc3dError where sizes and counts do not fit the body: in the other byte order they never do.
    """
    if len(body) < 4:
        raise Rtc3dError(f"a data frame of {len(body)} bytes; expected 4 at least")
    (components,) = COUNTS[order].unpack_from(body)
    if components * SHORTEST_COMPONENT > len(body) - 4:
        raise Rtc3dError(f"{components} components in {len(body)} bytes")
    head = COMPONENT_HEADS[order]
    at = 4
    for _ in range(components):
        room = len(body) - at
        if room < SHORTEST_COMPONENT:
            raise Rtc3dError(f"the data frame ends within a component, at byte {at}")
        size, kind = struct.unpack_from(order + "II", body, at)
        if not SHORTEST_COMPONENT <= size <= room:
            raise Rtc3dError(f"a component of {size} bytes, where {room} are left")
        if kind in ITEM_BYTES:
            if size < head.size:
                raise Rtc3dError(f"a component of {size} bytes; expected {head.size} at least")
            _, _, number, time_us, count = head.unpack_from(body, at)
            if head.size + count * ITEM_BYTES[kind] > size:
                raise Rtc3dError(f"{count} items of kind {kind} in a component of {size} bytes")
            yield ComponentHead(kind, number, time_us, count, at + head.size)
        at += size
    if any(body[at:]):
        raise Rtc3dError(f"{len(body) - at} bytes follow the last component")


def order_of(body: bytes, expected: str = BIG) -> str | None:
    """The byte order in which a data frame makes sense, `expected` first; None where there is none."""
    for order in (expected, LITTLE if expected == BIG else BIG):
        try:
            if list(component_heads(body, order)):
                return order
        except Rtc3dError:
            continue
    return None


def decode_frame(body: bytes, order: str) -> tuple[Component, ...]:
    """Every component of a data frame. Raises Rtc3dError."""
    out = []
    for head in component_heads(body, order):
        if head.kind == EVENT:
            items: NDArray[Any] = np.frombuffer(body, EVENTS[order], head.count, head.offset)
        else:
            items = _floats(body, order, head).astype(np.float32)
        out.append(Component(head.kind, head.number, head.time_us, items))
    return tuple(out)


def six_d_items(
    positions: FloatArray, quaternions: FloatArray, rms: FloatArray | None = None, zeros: bool = False
) -> NDArray[np.float32]:
    """(coils, 8) float32 items of a 6D component; rms 0 where none is given.

    A missing coil (NaN in its position) is FF throughout as from a real device, or `zeros`.
    """
    items = np.zeros((len(positions), 8), np.float32)
    items[:, :4] = quaternions
    items[:, 4:7] = positions
    if rms is not None:
        items[:, 7] = rms
    missing = np.isnan(positions).any(axis=1)
    items.view(np.uint32)[missing] = 0 if zeros else 0xFFFFFFFF
    return items


def three_d_items(positions: FloatArray, zeros: bool = False) -> NDArray[np.float32]:
    """(coils, 4) float32 items of a 3D component, reliability 0.

    A missing marker is FF in x, y, z, while its reliability says 999; or `zeros`.
    """
    items = np.zeros((len(positions), 4), np.float32)
    items[:, :3] = positions
    missing = np.isnan(positions).any(axis=1)
    items.view(np.uint32)[missing] = 0 if zeros else 0xFFFFFFFF
    if not zeros:
        items[missing, 3] = UNRELIABLE
    return items


def encode_frame(components: Sequence[Component], order: str) -> bytes:
    """The body of a data frame."""
    parts = [COUNTS[order].pack(len(components))]
    head = COMPONENT_HEADS[order]
    for component in components:
        target = EVENTS[order] if component.kind == EVENT else FLOATS[order]
        items = component.items.astype(target).tobytes()
        parts.append(
            head.pack(
                head.size + len(items),
                component.kind,
                component.number & 0xFFFFFFFF,
                component.time_us & 0xFFFFFFFFFFFFFFFF,
                len(component.items),
            )
        )
        parts.append(items)
    return b"".join(parts)


def _floats(body: bytes, order: str, head: ComponentHead) -> NDArray[np.float32]:
    fields = len(FIELDS[head.kind])
    values = np.frombuffer(body, FLOATS[order], head.count * fields, head.offset)
    return values.reshape(head.count, fields)


# Parameters


@dataclass(frozen=True)
class Parameters:
    """What the device says of itself. rate_hz: 0.0 = it does not say.

    names: one for each tool, or marker where there are no tools; "" = it has none.
    """

    rate_hz: float = 0.0
    names: tuple[str, ...] = ()


def parameters_xml(rate_hz: float, names: Sequence[str]) -> str:
    """The parameters of a device with these tools, in the shape in which an emulator of the Wave states them."""
    tools = "".join(
        f"<Tool id='{k + 1}'><Label>{escape(name)}</Label></Tool>" for k, name in enumerate(names)
    )
    return (
        "<?xml version='1.0' encoding='US-ASCII'?><RT_Parameters Ver='1.00'><The_6D>"
        f"<Frequency>{rate_hz:g}</Frequency><Unit>mm</Unit><Tools>{tools}</Tools></The_6D></RT_Parameters>"
    )


def parse_parameters(body: bytes) -> Parameters:
    """Whatever of rate and names can be made out; everything may be absent, for no device's own is published.

    Raises Rtc3dError where the text is no XML, or declares anything: a declaration could make it grow.
    """
    if len(body) > LARGEST_PACKET:
        raise Rtc3dError(f"parameters of {len(body)} bytes; expected at most {LARGEST_PACKET}")
    text = text_of(body)
    if text.count("<!") > text.count("<!--"):
        raise Rtc3dError("parameters with declarations are not read")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as reason:
        raise Rtc3dError(f"parameters that are no XML ({reason})") from reason
    found = {_plain(element.tag): element for element in root}
    section = next((found[name] for name in PARAMETER_SECTIONS if name in found), root)
    rate_hz = next((_rate(e.text) for e in section.iter() if _plain(e.tag) == "frequency"), 0.0)
    for item in PARAMETER_ITEMS:
        items = [element for element in section.iter() if _plain(element.tag) == item]
        if items:
            return Parameters(rate_hz, tuple(_label(element) for element in items))
    return Parameters(rate_hz)


def _plain(tag: object) -> str:
    """A tag without namespace, in lower case; comments and the like have none."""
    return tag.rpartition("}")[2].lower() if isinstance(tag, str) else ""


def _rate(text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        return 0.0
    return value if 0.1 <= value <= 1e5 else 0.0


def _label(element: ElementTree.Element) -> str:
    text = next((child.text for child in element if _plain(child.tag) in PARAMETER_LABELS), None) or ""
    return "".join(letter for letter in text.strip() if letter.isprintable())[:LONGEST_NAME]
