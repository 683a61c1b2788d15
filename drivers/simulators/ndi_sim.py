"""The simulated NDI device as a process of its own, on a TCP port, a pseudo-terminal, or behind RFC 2217.

A serial line has a speed: whoever talks at another one is not understood, and bytes take the time that they
need on the wire.
"""

from __future__ import annotations

import select
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from ... import InputError
from .faults import FaultPlan
from .motion import SimulatedMotion
from .ndi_device import Answer, NdiDevice
from .ndi_ports import Hangup, Heard, Line, PtyLine, Rfc2217Line, TcpLine

TRANSPORTS = ("tcp", "pty", "rfc2217")
TICK_S = 0.02
SEND_TIMEOUT_S = 2.0
BITS_A_BYTE = 10  # 8 data bits, start and stop
PIECE_S = 0.004
"""Bytes leave in pieces of this duration, so that a reader sees them come as from a wire."""


class _Stop:
    """Set by a signal or when the time is up; every wait looks at it."""

    def __init__(self, seconds: float | None) -> None:
        self._asked = False
        self._end_s = float("inf") if seconds is None else time.perf_counter() + seconds

    def ask(self, number: int = 0, frame: FrameType | None = None) -> None:
        self._asked = True

    @property
    def now(self) -> bool:
        return self._asked or time.perf_counter() >= self._end_s

    def sleep_until(self, due_s: float) -> None:
        while not self.now and (left_s := due_s - time.perf_counter()) > 0:
            time.sleep(min(left_s, TICK_S))


def run_ndi(
    motion: SimulatedMotion,
    plan: FaultPlan,
    *,
    transport: str,
    host: str,
    port: int,
    announce: Callable[[str], None],
    model: str = "aurora",
    seconds: float | None = None,
    volume_mm: float = 500.0,
    realistic: bool = False,
    reset_s: float | None = None,
    wire_time: bool = True,
    log: Callable[[bytes], None] | None = None,
) -> None:
    """Runs the device until SIGINT or SIGTERM, or for so many seconds.

    transport: "tcp", "pty" (host and port are not used) or "rfc2217"; port 0 takes a free one. announce gets the
    URI under which a driver reaches the device, once it listens. The device serves one client at a time and keeps
    its state when clients come and go. model, volume_mm, realistic, reset_s: see `NdiDevice`. wire_time:
    whether bytes on a serial line take their time. log gets the bytes of every piece that the device understood.

    Raises InputError where the port is taken, the platform has no pseudo-terminals, or there are too many coils.
    """
    if transport not in TRANSPORTS:
        raise InputError(f"'{transport}' is no transport; the transports are {', '.join(TRANSPORTS)}.")
    device = NdiDevice(motion, plan, model, volume_mm=volume_mm, realistic=realistic, reset_s=reset_s)
    stop = _Stop(seconds)
    serial = transport != "tcp"
    attendant = _Attendant(device, stop, serial, wire_time and serial, log)
    with _stopped_by_signals(stop):
        if transport == "pty":
            with PtyLine(device.reset_s) as line:
                announce(f"ndi://{line.name}")
                attendant.serve(line)
            return
        with _listening(host, port) as listener:
            place = f"[{host}]" if ":" in host else host
            scheme = "ndi+tcp" if transport == "tcp" else "ndi+rfc2217"
            announce(f"{scheme}://{place}:{listener.getsockname()[1]}")
            while not stop.now:
                readable, _, _ = select.select([listener], [], [], TICK_S)
                if not readable:
                    continue
                with suppress(OSError, Hangup):  # a client may be gone before it is served
                    connection, _ = listener.accept()
                    with connection:
                        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                        connection.settimeout(SEND_TIMEOUT_S)
                        if not serial:
                            device.connected()
                        attendant.serve(
                            TcpLine(connection) if transport == "tcp" else Rfc2217Line(connection)
                        )


@contextmanager
def _stopped_by_signals(stop: _Stop) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, stop.ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _listening(host: str, port: int) -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listener:
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(1)
            listener.setblocking(False)
        except (OSError, UnicodeError, OverflowError) as reason:
            raise InputError(
                f"{host}:{port}: {reason}; choose another port, or 0 for a free one."
            ) from reason
        yield listener


class _Attendant:
    """Carries bytes between a line and the device, at the pace of the wire."""

    def __init__(
        self,
        device: NdiDevice,
        stop: _Stop,
        serial: bool,
        wire_time: bool,
        log: Callable[[bytes], None] | None,
    ) -> None:
        self._device = device
        self._stop = stop
        self._serial = serial
        self._wire_time = wire_time
        self._log = log

    def serve(self, line: Line) -> None:
        """Until the client goes, is cut off, or the device is to stop."""
        device = self._device
        with suppress(Hangup):
            while not self._stop.now:
                if device.cut():
                    if not self._serial:
                        return
                    device.fail()
                for heard in line.listen(TICK_S):
                    for answer in self._answers(heard):
                        self._send(line, answer, heard.ago_s)

    def _answers(self, heard: Heard) -> list[Answer]:
        if heard.broken:
            return [self._device.reset()]
        if heard.baud and heard.baud != self._device.baud:
            return []  # at the wrong speed there are no characters, only noise
        if self._log is not None:
            self._log(heard.data)
        if self._wire_time:
            self._stop.sleep_until(time.perf_counter() + len(heard.data) * BITS_A_BYTE / self._device.baud)
        return self._device.feed(heard.data)

    def _send(self, line: Line, answer: Answer, ago_s: float) -> None:
        if answer.wait_s > ago_s:
            self._stop.sleep_until(time.perf_counter() + answer.wait_s - ago_s)
        if line.speed() not in (0, answer.baud):
            return
        if not self._wire_time:
            line.say(answer.data)
            return
        start_s, byte_s = time.perf_counter(), BITS_A_BYTE / answer.baud
        size = max(1, int(PIECE_S / byte_s))
        for place in range(0, len(answer.data), size):
            piece = answer.data[place : place + size]
            self._stop.sleep_until(start_s + (place + len(piece)) * byte_s)
            if self._stop.now:
                return
            line.say(piece)
