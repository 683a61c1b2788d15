"""The simulated NDI device on a TCP port, a pseudo-terminal, or behind RFC 2217, as a process of its own.

A serial line has a speed: whoever talks at another one is not understood, and bytes take the time that they
need on the wire. RFC 2217 carries speed and BREAK as they are. A pseudo-terminal carries the speed; that a
BREAK was sent shows only in what clients do before it: they flush both directions at 9600 baud, then wait.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any, Protocol, Self

from ... import InputError
from .faults import FaultPlan
from .motion import SimulatedMotion
from .ndi_sim import POWER_ON_BAUD, Answer, NdiDevice

TRANSPORTS = ("tcp", "pty", "rfc2217")
TICK_S = 0.02
RECEIVE_BYTES = 4096
BITS_A_BYTE = 10  # 8 data bits, start and stop
PIECE_S = 0.004
"""Bytes leave in pieces of this duration, so that a reader sees them come as from a wire."""
BREAK_SILENCE_S = 0.08
MAX_SUBOPTION = 256
SEND_TIMEOUT_S = 2.0


@dataclass(frozen=True)
class Heard:
    """Bytes at a speed (0 = the line has none), or a BREAK."""

    data: bytes = b""
    baud: int = 0
    broken: bool = False


class Hangup(Exception):
    """The other side has gone."""


class Line(Protocol):
    """One connection to one client. `listen` and `say` raise Hangup."""

    def listen(self, timeout_s: float) -> list[Heard]: ...

    def say(self, data: bytes) -> None: ...

    def speed(self) -> int:
        """The client's, baud; 0 = the line has none."""


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
    rate_hz: float | None = None,
    volume_mm: float = 500.0,
    realistic: bool = False,
    reset_s: float | None = None,
    wire_time: bool = True,
    log: Callable[[bytes], None] | None = None,
) -> None:
    """Runs the device until SIGINT or SIGTERM, or for so many seconds.

    transport: "tcp", "pty" (host and port are not used) or "rfc2217"; port 0 takes a free one. announce gets the
    URI under which a driver reaches the device, once it listens. The device serves one client at a time and keeps
    its state when clients come and go. model, rate_hz, volume_mm, realistic, reset_s: see `NdiDevice`. wire_time:
    whether bytes on a serial line take their time. log gets the bytes of every piece that the device understood.

    Raises InputError where the port is taken or the platform has no pseudo-terminals.
    """
    if transport not in TRANSPORTS:
        raise InputError(f"'{transport}' is no transport; the transports are {', '.join(TRANSPORTS)}.")
    device = NdiDevice(
        motion, plan, model, rate_hz=rate_hz, volume_mm=volume_mm, realistic=realistic, reset_s=reset_s
    )
    stop = _Stop(seconds)
    serial = transport != "tcp"
    attendant = _Attendant(device, stop, serial, wire_time and serial, log)
    with _stopped_by_signals(stop):
        if transport == "pty":
            with PtyLine() as line:
                line.break_silence_s = BREAK_SILENCE_S + device.reset_s
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
                connection, _ = listener.accept()
                with connection:
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    connection.settimeout(SEND_TIMEOUT_S)
                    if not serial:
                        device.connected()
                    attendant.serve(TcpLine(connection) if transport == "tcp" else Rfc2217Line(connection))


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
        except (OSError, OverflowError) as reason:
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
                        self._send(line, answer)

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

    def _send(self, line: Line, answer: Answer) -> None:
        if answer.wait_s > 0:
            self._stop.sleep_until(time.perf_counter() + answer.wait_s)
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


class TcpLine:
    """A TCP connection: no speed, no BREAK."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection

    def listen(self, timeout_s: float) -> list[Heard]:
        data = receive(self._socket, timeout_s)
        return [Heard(data)] if data else []

    def say(self, data: bytes) -> None:
        send(self._socket, data)

    def speed(self) -> int:
        return 0


def receive(connection: socket.socket, timeout_s: float) -> bytes:
    """What has come, b"" where nothing did. Raises Hangup."""
    try:
        readable, _, _ = select.select([connection], [], [], timeout_s)
        if not readable:
            return b""
        data = connection.recv(RECEIVE_BYTES)
    except OSError as reason:
        raise Hangup from reason
    if not data:
        raise Hangup
    return data


def send(connection: socket.socket, data: bytes) -> None:
    try:
        connection.sendall(data)
    except OSError as reason:  # also where the client does not read for long
        raise Hangup from reason


class _VirtualPort:
    """The serial port that an RFC 2217 client believes to set up: its speed counts, and BREAK."""

    def __init__(self) -> None:
        self.baudrate = POWER_ON_BAUD
        self.bytesize, self.parity, self.stopbits = 8, "N", 1
        self.rtscts = self.dsrdtr = self.xonxoff = False
        self.rts = self.dtr = self.cts = self.dsr = True
        self.ri = self.cd = False
        self.breaks = 0
        self._break = False

    @property
    def break_condition(self) -> bool:
        return self._break

    @break_condition.setter
    def break_condition(self, on: bool) -> None:
        if self._break and not on:
            self.breaks += 1
        self._break = on

    def reset_input_buffer(self) -> None:
        """Nothing waits here."""

    def reset_output_buffer(self) -> None:
        """Nothing waits here."""


class Rfc2217Line:
    """A TCP connection that carries a serial line with its speed and BREAK (RFC 2217, by pyserial)."""

    def __init__(self, connection: socket.socket) -> None:
        import serial.rfc2217

        self._socket = connection
        self._port = _VirtualPort()
        self._manager: Any = serial.rfc2217.PortManager(self._port, self)

    def write(self, data: bytes) -> None:
        """What the manager has to say to the client."""
        send(self._socket, data)

    def listen(self, timeout_s: float) -> list[Heard]:
        heard: list[Heard] = []
        piece, baud, breaks = bytearray(), self._port.baudrate, self._port.breaks
        data = receive(self._socket, timeout_s)
        try:
            for byte in self._manager.filter(data):
                if self._port.baudrate != baud or self._port.breaks != breaks:
                    heard += self._piece(piece, baud, breaks)
                    piece, baud, breaks = bytearray(), self._port.baudrate, self._port.breaks
                piece += byte
        except (ValueError, TypeError, KeyError, IndexError, struct.error) as reason:
            raise Hangup from reason  # what the manager raises when the negotiation makes no sense
        if self._manager.suboption is not None and len(self._manager.suboption) > MAX_SUBOPTION:
            raise Hangup
        return heard + self._piece(piece, baud, breaks)

    def _piece(self, data: bytearray, baud: int, breaks: int) -> list[Heard]:
        heard = [Heard(bytes(data), baud)] if data else []
        return [*heard, Heard(broken=True)] if self._port.breaks != breaks else heard

    def say(self, data: bytes) -> None:
        send(self._socket, b"".join(self._manager.escape(data)))

    def speed(self) -> int:
        return self._port.baudrate


class PtyLine:
    """A pseudo-terminal; `name` is the device file that clients open.

    Its packet mode tells when a client flushes. Both directions flushed at 9600 baud and then silence is a BREAK.
    The client's end stays open here, so that clients may come and go.
    """

    break_silence_s = BREAK_SILENCE_S

    def __init__(self) -> None:
        try:
            import fcntl
            import termios
            import tty

            packets = termios.TIOCPKT
        except (ImportError, AttributeError) as reason:
            raise InputError("this platform has no pseudo-terminals; use TCP or RFC 2217.") from reason
        self._termios = termios
        self._speeds = {
            value: int(name[1:])
            for name, value in vars(termios).items()
            if name[0] == "B" and name[1:].isdigit()
        }
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        fcntl.ioctl(self._master, packets, struct.pack("i", 1))
        os.set_blocking(self._master, False)
        self.name = os.ttyname(self._slave)
        self._flushed = 0
        self._flushed_at_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *problem: object) -> None:
        os.close(self._master)
        os.close(self._slave)

    def listen(self, timeout_s: float) -> list[Heard]:
        readable, _, _ = select.select([self._master], [], [], timeout_s)
        if readable:
            return self._packet()
        silence_s = time.perf_counter() - self._flushed_at_s
        if self._flushed == self._both and self.speed() == POWER_ON_BAUD and silence_s > self.break_silence_s:
            self._flushed = 0
            return [Heard(broken=True)]
        return []

    def _packet(self) -> list[Heard]:
        try:
            packet = os.read(self._master, RECEIVE_BYTES)
        except OSError as reason:
            raise Hangup from reason
        if packet[:1] == b"\0":
            self._flushed = 0
            return [Heard(packet[1:], self.speed())] if len(packet) > 1 else []
        if packet and packet[0] & self._both:
            self._flushed |= packet[0] & self._both
            self._flushed_at_s = time.perf_counter()
        return []

    @property
    def _both(self) -> int:
        return self._termios.TIOCPKT_FLUSHREAD | self._termios.TIOCPKT_FLUSHWRITE

    def say(self, data: bytes) -> None:
        with suppress(BlockingIOError):  # where nobody reads, the line loses bytes
            os.write(self._master, data)

    def speed(self) -> int:
        """The client's speed; -1 where it is none that this system knows by name."""
        value = self._termios.tcgetattr(self._master)[4]
        return self._speeds.get(value, -1)
