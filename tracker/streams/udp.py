"""Datagrams to one UDP destination, for workers behind a slot."""

from __future__ import annotations

import socket

from .osc import resolve


class UdpSender:
    """A socket that is not connected and does not block: a datagram is handed to the system, or `send` raises OSError.

    What a receiver does or does not do never shows here. destination: HOST:PORT; raises InputError where it is not
    one, or its host is unknown.
    """

    def __init__(self, destination: str) -> None:
        family, self._peer = resolve(destination)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if family == socket.AF_INET:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def send(self, datagram: bytes | bytearray) -> None:
        self._socket.sendto(datagram, self._peer)

    def close(self) -> None:
        self._socket.close()
