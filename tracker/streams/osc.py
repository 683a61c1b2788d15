"""Poses as OSC datagrams: bundles made once with python-osc, numbers written over per frame, one send."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..pose import FloatArray, TrackedPose
from .addresses import (
    COIL_STATES,
    COILS,
    FRAME,
    INFO,
    INFO_PERIOD_S,
    LATENCY,
    MAX_DATAGRAM_BYTES,
    MEAN,
    NO_LATENCY,
    NO_RESIDUAL,
    POSE,
    POSE_SCALAR,
    PROTOCOL_NAME,
    PROTOCOL_VERSION,
    QUALITY,
    SIGMA,
    SIGMA_SCALAR,
    SPEAKER,
    SPEAKER_FIXED,
    SPEAKER_FREE,
    SPREAD,
    TAKE,
)
from .packing import (
    BUNDLE_HEADER_BYTES,
    ELEMENT_HEADER_BYTES,
    SEQUENCE_MASK,
    PackedBundle,
    bundle_bytes,
    in_datagrams,
    osc_bundle,
    osc_message,
    osc_text,
)
from .sink import LiveNumbers, StreamInfo

DEFAULT_DESTINATION = "127.0.0.1:9000"


class FrameBundle:
    """The datagram of one frame, for K coefficients; `write` replaces its numbers in place.

    datagram: the bytes to send. has_scalars: whether the one-value addresses are in it.
    """

    def __init__(self, size: int) -> None:
        zeros = [0.0] * size
        head = [(FRAME.path, FRAME, [0, 0.0, 0]), (POSE.path, POSE, zeros), (SIGMA.path, SIGMA, zeros)]
        scalars = [
            (row.path.replace("<k>", str(k)), row, [0.0])
            for row in (POSE_SCALAR, SIGMA_SCALAR)
            for k in range(size)
        ]
        tail = [(QUALITY.path, QUALITY, [0.0, 0, 0.0])]
        messages = [osc_message(row, values, path) for path, row, values in head + scalars + tail]
        self.has_scalars = bundle_bytes(messages) <= MAX_DATAGRAM_BYTES
        if not self.has_scalars:
            messages = [osc_message(row, values, path) for path, row, values in head + tail]
        if bundle_bytes(messages) > MAX_DATAGRAM_BYTES:
            raise InputError(
                f"{size} coefficients need {bundle_bytes(messages)} bytes a frame, but an OSC datagram here has "
                f"at most {MAX_DATAGRAM_BYTES}; use a model with fewer pose modes."
            )
        self._packed = PackedBundle(messages)
        self.datagram = self._packed.datagram
        places = self._packed.places
        self._scalars = slice(places[3], places[3] + 4 * size, 2) if self.has_scalars else None

    def write(self, pose: TrackedPose, sequence: int, time_s: float, latency_ms: float) -> None:
        """sequence: wraps to 0 after 2^31 - 1; time_s: since the stream's start."""
        parts, places = self._packed.parts, self._packed.places
        weights, normalised = pose.weights.tolist(), pose.normalised.tolist()
        size = len(weights)
        frame, vector, sigma, quality = places[0], places[1], places[2], places[-1]
        parts[frame : frame + 3] = sequence & SEQUENCE_MASK, time_s, pose.status
        parts[vector : vector + size] = weights
        parts[sigma : sigma + size] = normalised
        if self._scalars is not None:
            parts[self._scalars] = weights + normalised
        residual = pose.residual_mm if pose.valid_coils else NO_RESIDUAL
        parts[quality : quality + 3] = residual, pose.valid_coils, latency_ms
        self._packed.pack()


def info_datagrams(info: StreamInfo) -> list[bytes]:
    """What is sent at the start and every second: bundles of at most MAX_DATAGRAM_BYTES, mostly one."""
    about = [
        PROTOCOL_NAME,
        PROTOCOL_VERSION,
        osc_text(info.model_name),
        osc_text(info.model_fingerprint),
        info.vertex_count,
        len(info.mean),
        SPEAKER_FIXED if info.speaker_fixed else SPEAKER_FREE,
        info.rate_hz,
    ]
    messages = [
        osc_message(SPEAKER, info.speaker_weights.tolist()),
        osc_message(INFO, about),
        osc_message(COILS, [osc_text(role) for role in info.roles]),
        osc_message(MEAN, info.mean.tolist()),
        osc_message(SPREAD, info.sigma.tolist()),
    ]
    return [osc_bundle(group) for group in in_datagrams(messages)]


class CoilStatesDatagram:
    """The datagram with the state of every coil; `write` replaces the numbers in place and says whether one changed."""

    def __init__(self, coils: int) -> None:
        datagram = bytearray(osc_bundle([osc_message(COIL_STATES, [0] * coils)]))
        if len(datagram) > MAX_DATAGRAM_BYTES:
            raise InputError(
                f"the states of {coils} coils need {len(datagram)} bytes, more than an OSC datagram of "
                f"{MAX_DATAGRAM_BYTES} holds; track fewer coils."
            )
        self.datagram = datagram
        self.coils = coils
        self._words = np.frombuffer(datagram, ">i4")[len(datagram) // 4 - coils :]
        self._written = b""

    def write(self, states: NDArray[np.int64]) -> bool:
        """states: (coils,). The first call changes them all."""
        # As bytes: a tenth of the time of an element-wise comparison, and no array is made.
        current = states.tobytes()
        if current == self._written:
            return False
        self._written = current
        self._words[:] = states
        return True


def numbers_datagram(numbers: LiveNumbers) -> bytes:
    """What a live run says of itself, as one bundle."""
    pairs = (numbers.device_to_host_ms, numbers.host_to_solved_ms, numbers.solved_to_sent_ms)
    latencies = [NO_LATENCY if value is None else value for pair in pairs for value in pair]
    take = [
        osc_text(numbers.take_path, cut_front=True),
        min(numbers.take_frames, SEQUENCE_MASK),
        osc_text(numbers.take_failure),
    ]
    return osc_bundle([osc_message(LATENCY, latencies), osc_message(TAKE, take)])


class OscSink:
    """Sends every pose to one UDP destination, without ever waiting for it.

    The socket is not connected and does not block: whatever the network answers, a frame is either handed
    to the operating system or counted in `dropped`. The destination's name is looked up once, here.
    numbers: asked once a second, in the thread that sends, for what a live run says of itself; None = nothing.
    """

    def __init__(self, destination: str = DEFAULT_DESTINATION) -> None:
        self.destination = f"osc {destination}"
        self.sent = 0
        self.dropped = 0
        self.numbers: Callable[[], LiveNumbers] | None = None
        family, self._peer = resolve(destination)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if family == socket.AF_INET:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._bundle: FrameBundle | None = None
        self._info: list[bytearray] = []
        self._speaker_words: FloatArray | None = None
        self._states: CoilStatesDatagram | None = None
        self._sequence = 0
        self._start_s: float | None = None
        self._next_info_ns = 0

    def start(self, info: StreamInfo) -> None:
        """Builds the datagrams and sends the info for the first time."""
        self._bundle = FrameBundle(len(info.mean))
        self._states = CoilStatesDatagram(len(info.roles))
        self._sequence = 0
        self._start_s = None
        self.change(info)

    def change(self, info: StreamInfo) -> None:
        """Another info for the stream that runs, whose sequence numbers and time go on. Sends it at once.

        The model must be the same one.
        """
        self._info = [bytearray(datagram) for datagram in info_datagrams(info)]
        count = len(info.speaker_weights)
        self._speaker_words = None
        if count and not info.speaker_fixed:
            # The speaker's message is the first: its weights end where its element ends.
            element = int.from_bytes(self._info[0][BUNDLE_HEADER_BYTES:][:ELEMENT_HEADER_BYTES], "big")
            end = BUNDLE_HEADER_BYTES + ELEMENT_HEADER_BYTES + element
            self._speaker_words = np.frombuffer(self._info[0], ">f4")[end // 4 - count : end // 4]
        self._send_info()

    def send(self, pose: TrackedPose) -> None:
        """Writes and sends one frame; afterwards the info, when a second has passed."""
        bundle, states = self._bundle, self._states
        assert bundle is not None and states is not None, "start() comes before send()"
        if self._start_s is None:
            self._start_s = pose.device_time_s
        now_ns = time.perf_counter_ns()
        bundle.write(
            pose, self._sequence, pose.device_time_s - self._start_s, (now_ns - pose.arrival_ns) * 1e-6
        )
        self._sequence += 1
        try:
            self._socket.sendto(bundle.datagram, self._peer)
            self.sent += 1
        except OSError:  # buffer full, nobody there, network gone: the next frame is newer anyway
            self.dropped += 1
        states_known = len(pose.coil_states) == states.coils > 0
        states_changed = states_known and states.write(pose.coil_states)
        second_is_over = now_ns >= self._next_info_ns
        if states_changed or (states_known and second_is_over):
            self._send_aside(states.datagram)
        if second_is_over:
            if self._speaker_words is not None:
                self._speaker_words[:] = pose.speaker_weights
            self._send_info()
            if self.numbers is not None:
                self._send_aside(numbers_datagram(self.numbers()))

    def rehearse(self, pose: TrackedPose) -> None:
        """Writes a frame as `send` does, and sends nothing; the next frame is written over it."""
        bundle = self._bundle
        assert bundle is not None, "start() comes before rehearse()"
        start_s = pose.device_time_s if self._start_s is None else self._start_s
        now_ns = time.perf_counter_ns()
        bundle.write(pose, self._sequence, pose.device_time_s - start_s, (now_ns - pose.arrival_ns) * 1e-6)

    def close(self) -> None:
        self._socket.close()

    def _send_info(self) -> None:
        self._next_info_ns = time.perf_counter_ns() + int(INFO_PERIOD_S * 1e9)
        for datagram in self._info:
            self._send_aside(datagram)

    def _send_aside(self, datagram: bytes | bytearray) -> None:
        try:
            self._socket.sendto(datagram, self._peer)
        except OSError:  # it is sent again in a second
            pass


def parse_destination(text: str, lowest_port: int = 1) -> tuple[str, int]:
    """ "127.0.0.1:9000", "name:9000" or "[::1]:9000" as host and port."""
    host, colon, port = text.strip().rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise InputError(f"'{text}': an IPv6 address stands in brackets, as in [::1]:9000.")
    if not colon or not host or any(c.isspace() or c in "/[]" for c in host):
        raise InputError(f"'{text}': expected HOST:PORT, as in {DEFAULT_DESTINATION}.")
    if not (port.isascii() and port.isdigit() and lowest_port <= int(port) <= 65535):
        raise InputError(f"'{text}': the port '{port}' should be a number from {lowest_port} to 65535.")
    return host, int(port)


def resolve(text: str, lowest_port: int = 1) -> tuple[socket.AddressFamily, tuple[object, ...]]:
    """HOST:PORT as the address family and the numeric address that sockets take; IPv4 where there is a choice,
    because that is where receivers listen when someone says localhost."""
    host, port = parse_destination(text, lowest_port)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as reason:
        raise InputError(f"'{text}': the host '{host}' is not known here; check its name.") from reason
    family, _, _, _, address = min(found, key=lambda entry: entry[0] != socket.AF_INET)
    return family, address


def listening_socket(address: str, option: str) -> socket.socket:
    """A bound UDP socket; port 0 is any that is free. option: where else a user may name another address.

    Raises InputError where the address is not this machine's or the port is taken.
    """
    family, place = resolve(address, lowest_port=0)
    receiver = socket.socket(family, socket.SOCK_DGRAM)
    try:
        receiver.bind(place)
    except OSError as reason:
        receiver.close()
        if reason.errno == errno.EADDRINUSE:
            raise InputError(
                f"{address}: the port is in use by another program; end that one or give another {option}."
            ) from reason
        raise InputError(
            f"{address}: cannot listen there ({reason.strerror}); give another {option}."
        ) from reason
    return receiver
