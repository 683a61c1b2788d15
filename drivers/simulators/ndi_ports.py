"""The lines that a simulated serial device is reached by: a TCP port, a pseudo-terminal, RFC 2217.

A serial line has a speed: whoever talks at another one is not understood, and bytes take the time that they
need on the wire. RFC 2217 carries speed and BREAK as they are. A pseudo-terminal carries the speed; that a
BREAK was sent shows only in what clients do before it: they flush both directions at 9600 baud, then wait.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol, Self

from ... import InputError

FIRST_BAUD = 9600
RECEIVE_BYTES = 4096
BREAK_SILENCE_S = 0.08
MAX_SUBOPTION = 256


@dataclass(frozen=True)
class Heard:
    """Bytes at a speed (0 = the line has none), or a BREAK. ago_s: how long ago the BREAK was."""

    data: bytes = b""
    baud: int = 0
    broken: bool = False
    ago_s: float = 0.0


class Hangup(Exception):
    """The other side has gone."""


class Line(Protocol):
    """One connection to one client. `listen` and `say` raise Hangup."""

    def listen(self, timeout_s: float) -> list[Heard]: ...

    def say(self, data: bytes) -> None: ...

    def speed(self) -> int:
        """The client's, baud; 0 = the line has none."""


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
        self.baudrate = FIRST_BAUD
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
        library: Any = serial.rfc2217  # its stubs want a real port; it asks for no more than ours has
        self._manager = library.PortManager(self._port, self)

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

    Its packet mode tells when a client flushes. Both directions flushed at 9600 baud and then silence is a BREAK:
    for as long as the device takes to start anew, so that a client which merely opened the port goes undisturbed.
    The client's end stays open here, so that clients may come and go.
    """

    def __init__(self, reset_s: float) -> None:
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
        self._break_silence_s = BREAK_SILENCE_S + reset_s
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
        if self._flushed == self._both and self.speed() == FIRST_BAUD and silence_s > self._break_silence_s:
            self._flushed = 0
            return [Heard(broken=True, ago_s=silence_s)]
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
