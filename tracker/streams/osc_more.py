"""More over OSC, where asked for: coil positions, named shapes, re-based weights, distances to the palate, the mesh.

Everything is in `addresses.EXTRA_ADDRESSES`. It comes from a worker's own socket, so that the loop's own datagrams
neither wait for it nor grow.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Collection, Iterator
from math import isfinite

import numpy as np

from ... import InputError
from ...model.multilinear import SpeakerModel
from ..pose import FloatArray, TrackedPose
from .addresses import (
    COIL,
    CONTACT,
    EXTRA,
    GAP,
    HIGH,
    INFO_PERIOD_S,
    LOW,
    MAX_BLOB_BYTES,
    MESH,
    SHAPE,
    UNIT,
)
from .contact import ContactMeter
from .packing import BUNDLE_HEADER, SEQUENCE_MASK, NumbersMessage, bundles_of, osc_message
from .shapes import ShapeMeter, rebased_pose
from .sink import StreamContext, StreamInfo
from .udp import UdpSender

WORDS = ("coils", "shapes", "unit", "contact", "mesh")
"""The words of `send=`."""
FINEST_STEP_MM = 0.0025
"""16 bits reach +-81.9 mm with it. A mesh that is farther from the origin has a coarser step."""
VERTICES_A_CHUNK = MAX_BLOB_BYTES // 6
_LARGEST = 32767
_MESH_NUMBERS = struct.Struct(">iiiifi")  # the last is the blob's length
_MESH_HEAD = osc_message(MESH, (0, 0, 0, 0, 0.0, bytes(4)))[: -_MESH_NUMBERS.size - 4]


class MoreDatagrams:
    """The datagrams of what `send` names, some of `WORDS`, for one pose after the other.

    Small things come in one bundle, or in several that all begin with `/tongue/extra`; the mesh in chunks, each in a
    datagram of its own. Raises InputError for an unknown word, and for `contact` where there is no palate.
    """

    def __init__(self, context: StreamContext, send: Collection[str]) -> None:
        for word in send:
            if word not in WORDS:
                raise InputError(f"send={word}: this cannot be sent; expected some of {', '.join(WORDS)}.")
        self._extra = NumbersMessage(EXTRA, 3)
        self._coils: list[NumbersMessage] = []
        self._send_coils = "coils" in send
        self._shapes = (
            _Shapes(context, "shapes" in send, "unit" in send) if {"shapes", "unit"} & {*send} else None
        )
        self._contact = _Contact(context) if "contact" in send else None
        self._mesh = _Mesh(context) if "mesh" in send else None
        self._sequence = 0
        self._start_s: float | None = None
        self._next_ranges_s = 0.0

    def begin(self, info: StreamInfo) -> None:
        if self._send_coils:
            self._coils = [NumbersMessage(COIL, 3, COIL.named(role)) for role in info.roles]
        self._next_ranges_s = 0.0

    def of(self, pose: TrackedPose) -> Iterator[bytes]:
        if self._start_s is None:
            self._start_s = pose.device_time_s
        sequence, self._sequence = self._sequence, (self._sequence + 1) & SEQUENCE_MASK
        first = self._extra.element(
            sequence, pose.frame_number & SEQUENCE_MASK, pose.device_time_s - self._start_s
        )
        yield from bundles_of(self._elements(pose), first)
        if self._mesh is not None and pose.has_shape:
            yield from self._mesh.datagrams(pose, sequence)

    def _elements(self, pose: TrackedPose) -> Iterator[bytes]:
        for message, place in zip(self._coils, pose.coils.tolist(), strict=False):
            if all(map(isfinite, place)):
                yield message.element(*place)
        if self._shapes is not None:
            if pose.has_shape:
                yield from self._shapes.elements(pose)
            now_s = time.perf_counter()
            if now_s >= self._next_ranges_s:
                self._next_ranges_s = now_s + INFO_PERIOD_S
                yield from self._shapes.ranges()
        if self._contact is not None and pose.has_shape:
            yield from self._contact.elements(pose)


class OscMoreWorker:
    """Sends the `MoreDatagrams` of every pose it gets; raises InputError as they do."""

    def __init__(self, destination: str, context: StreamContext, send: Collection[str]) -> None:
        self.destination = f"osc {destination} ({', '.join(send)})"
        self._datagrams = MoreDatagrams(context, send)
        self._sender = UdpSender(destination)

    def begin(self, info: StreamInfo) -> None:
        self._datagrams.begin(info)

    def work(self, pose: TrackedPose) -> None:
        for datagram in self._datagrams.of(pose):
            self._sender.send(datagram)

    def end(self) -> None:
        self._sender.close()


class _Shapes:
    """The messages of `send=shapes` and of `send=unit`."""

    def __init__(self, context: StreamContext, shapes: bool, unit: bool) -> None:
        size = context.model.pose.size
        self._meter = ShapeMeter(context.model, context.ranges) if shapes else None
        names = self._meter.names if self._meter is not None else ()
        self._messages = [NumbersMessage(SHAPE, 1, SHAPE.named(name)) for name in names]
        self._rebased = rebased_pose(context.model.pose, context.ranges)
        self._unit = NumbersMessage(UNIT, size) if unit else None
        self._limits = [
            (NumbersMessage(LOW, size), self._rebased.low),
            (NumbersMessage(HIGH, size), self._rebased.high),
        ]

    def elements(self, pose: TrackedPose) -> Iterator[bytes]:
        if self._meter is not None:
            values = self._meter.measure(pose.speaker_weights, pose.weights).tolist()
            yield from (message.element(value) for message, value in zip(self._messages, values, strict=True))
        if self._unit is not None:
            yield self._unit.element(*self._rebased.to_unit(pose.weights).tolist())

    def ranges(self) -> Iterator[bytes]:
        """What is said every second."""
        if self._unit is not None:
            yield from (message.element(*values.tolist()) for message, values in self._limits)


class _Contact:
    """The messages of `send=contact`."""

    def __init__(self, context: StreamContext) -> None:
        if context.palate is None:
            raise InputError(
                "send=contact: there is no palate to be near to; put one into the session, see docs/session.md."
            )
        self._meter = ContactMeter(context.model, context.palate)
        self._whole = NumbersMessage(CONTACT, 4)
        self._regions = [NumbersMessage(GAP, 1, GAP.named(name)) for name in self._meter.regions]

    def elements(self, pose: TrackedPose) -> Iterator[bytes]:
        found = self._meter.measure(pose.speaker_weights, pose.weights)
        if isfinite(found.gap_mm):
            yield self._whole.element(found.gap_mm, *found.point.tolist())
        for message, gap_mm in zip(self._regions, found.regions.tolist(), strict=True):
            if isfinite(gap_mm):
                yield message.element(gap_mm)


class _Mesh:
    """The datagrams of `send=mesh`, on the anatomy that the context shows."""

    def __init__(self, context: StreamContext) -> None:
        self._model = context.model
        self._shown = context.shown_speaker
        self._speaker: SpeakerModel | None = None

    def datagrams(self, pose: TrackedPose, sequence: int) -> Iterator[bytes]:
        weights = pose.speaker_weights if self._shown is None else self._shown
        if self._speaker is None or not np.array_equal(self._speaker.speaker_weights, weights):
            self._speaker = self._model.for_speaker(weights)
        yield from mesh_datagrams(self._speaker.vertices(pose.weights), sequence)


def mesh_datagrams(vertices: FloatArray, sequence: int) -> Iterator[bytes]:
    """One datagram for each chunk of at most VERTICES_A_CHUNK of the vertices (V, 3), mm."""
    step_mm = max(FINEST_STEP_MM, float(np.abs(vertices).max(initial=0.0)) / _LARGEST)
    step_mm = float(np.nextafter(np.float32(step_mm), np.float32(np.inf)))  # as it arrives, and not too fine
    steps = np.rint(vertices / step_mm).astype(">i2")
    chunks = -(-len(vertices) // VERTICES_A_CHUNK)
    for chunk in range(chunks):
        first = chunk * VERTICES_A_CHUNK
        blob = steps[first : first + VERTICES_A_CHUNK].tobytes()
        numbers = _MESH_NUMBERS.pack(sequence, chunk, chunks, first, step_mm, len(blob))
        message = _MESH_HEAD + numbers + blob + bytes(-len(blob) % 4)
        yield BUNDLE_HEADER + len(message).to_bytes(4, "big") + message
