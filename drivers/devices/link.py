"""Bytes to and from a device: TCP and serial, every wait with an end, nothing unbounded."""

from __future__ import annotations

import errno
import select
import socket
import time
from contextlib import suppress
from typing import Any, Protocol

from ... import InputError

CONNECT_TIMEOUT_S = 3.0
SEND_TIMEOUT_S = 2.0
SERIAL_WAIT_S = 0.01
RECEIVE_BYTES = 1 << 16


class LinkLost(Exception):
    """The connection is gone or its bytes make no sense any more; the device has to be connected to anew."""


class Link(Protocol):
    """A connection that carries bytes both ways. Not for several threads at once."""

    @property
    def address(self) -> str:
        """What it leads to, for people."""

    def send(self, data: bytes) -> None:
        """Hands all bytes on. Raises LinkLost."""

    def receive(self, timeout_s: float) -> bytes:
        """What has arrived, up to `RECEIVE_BYTES`; b"" when nothing came in time. Raises LinkLost."""

    def close(self) -> None:
        """Never raises."""


class TcpLink:
    """A TCP connection. Raises InputError from `connect_tcp` alone; afterwards LinkLost."""

    def __init__(self, connected: socket.socket, address: str) -> None:
        self._socket = connected
        self.address = address
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setblocking(False)

    def send(self, data: bytes) -> None:
        deadline = time.perf_counter() + SEND_TIMEOUT_S
        rest = memoryview(data)
        try:
            while rest:
                _, writable, _ = select.select(
                    [], [self._socket], [], max(0.0, deadline - time.perf_counter())
                )
                if not writable:
                    raise LinkLost(f"{self.address} takes no more bytes")
                rest = rest[self._socket.send(rest) :]
        except (OSError, ValueError) as reason:
            raise LinkLost(f"{self.address}: {_words(reason)}") from reason

    def receive(self, timeout_s: float) -> bytes:
        try:
            readable, _, _ = select.select([self._socket], [], [], max(0.0, timeout_s))
            if not readable:
                return b""
            data = self._socket.recv(RECEIVE_BYTES)
        except (BlockingIOError, InterruptedError):
            return b""
        except (OSError, ValueError) as reason:
            raise LinkLost(f"{self.address}: {_words(reason)}") from reason
        if not data:
            raise LinkLost(f"{self.address} closed the connection")
        return data

    def close(self) -> None:
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self._socket.close()


def connect_tcp(host: str, port: int, timeout_s: float = CONNECT_TIMEOUT_S) -> TcpLink:
    """Raises LinkLost where nobody answers, InputError where the name means nothing."""
    address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    try:
        return TcpLink(socket.create_connection((host, port), timeout_s), address)
    except (socket.gaierror, UnicodeError) as reason:
        raise InputError(f"'{host}' is not a host that is known here; check its name.") from reason
    except OSError as reason:
        raise LinkLost(f"{address}: {_words(reason)}") from reason


class SerialLink:
    """A serial port, or what pyserial can open in its place (rfc2217://, socket://)."""

    def __init__(self, port: Any, address: str) -> None:
        self.port = port  # a serial.SerialBase: for what only serial lines have, speed and break
        self.address = address

    def send(self, data: bytes) -> None:
        try:
            self.port.write(data)
        except (OSError, ValueError) as reason:  # SerialException is an OSError
            raise LinkLost(f"{self.address}: {_words(reason)}") from reason

    def receive(self, timeout_s: float) -> bytes:
        # The port's own timeout never changes: over RFC 2217 each change negotiates every setting anew.
        deadline = time.perf_counter() + timeout_s
        try:
            while True:
                waiting = min(self.port.in_waiting, RECEIVE_BYTES)
                if waiting:
                    return bytes(self.port.read(waiting))
                if time.perf_counter() >= deadline:
                    return b""
                first = bytes(self.port.read(1))  # SERIAL_WAIT_S at most
                if first:
                    waiting = min(self.port.in_waiting, RECEIVE_BYTES)
                    return first + bytes(self.port.read(waiting)) if waiting else first
        except (OSError, ValueError, TypeError) as reason:
            # pyserial raises TypeError on a port that was closed meanwhile
            raise LinkLost(f"{self.address}: {_words(reason)}") from reason

    def close(self) -> None:
        with suppress(OSError, ValueError, TypeError):  # what an unplugged adapter makes the library raise
            self.port.close()


def open_serial(path: str, baud: int = 9600) -> SerialLink:
    """path: a device file or port name, or a URL of pyserial's (rfc2217://HOST:PORT, socket://HOST:PORT).

    The port is taken for this program alone. Raises LinkLost where it cannot be opened.
    """
    import serial

    try:
        # Only ports of this host can be locked, or give up writing: a network's own end does that elsewhere.
        options: dict[str, Any] = (
            {} if "://" in path else {"exclusive": True, "write_timeout": SEND_TIMEOUT_S}
        )
        port = serial.serial_for_url(path, baudrate=baud, timeout=SERIAL_WAIT_S, **options)
    except (OSError, ValueError) as reason:
        raise LinkLost(f"{path}: {_why_not_opened(reason)}") from reason
    try:
        port.set_low_latency_mode(True)
    except (AttributeError, NotImplementedError, OSError, ValueError):
        pass  # only some adapters on Linux have it
    return SerialLink(port, path)


def _why_not_opened(reason: OSError | ValueError) -> str:
    """In words of ours where it is known; the library's own repeat the port's name and quote numbers."""
    text = _words(reason)
    if "RFC2217" in text:
        return "what answers there is no serial port server (RFC 2217)"
    if "configure port" in text or getattr(reason, "errno", None) in (errno.EISDIR, errno.ENOTTY):
        return "this is no serial port; `tonguetrack devices` lists those of this machine"
    if "exclusively lock" in text:
        return "another program has this port open"
    if getattr(reason, "errno", None) in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return "there is no such serial port; `tonguetrack devices` lists those of this machine"
    if getattr(reason, "errno", None) in (errno.EACCES, errno.EPERM):
        return "no permission to open this port; `tonguetrack doctor` says how to get it"
    return text


def _words(reason: BaseException) -> str:
    return str(getattr(reason, "strerror", None) or reason or type(reason).__name__)
