"""Who may load the page: the address that it is served at, the token in it, and the questions of strangers."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass

from ..hosts import is_loopback, names_this_computer
from ..osc import parse_destination, resolve

TOKEN_BYTES = 18


@dataclass(frozen=True)
class Door:
    """Where the page is served, and to whom.

    host: as the user named it; place: the numeric address to bind; port: 0 = any; token: "" on this computer alone,
    else the first part of every path.
    """

    host: str
    place: str
    port: int
    token: str

    @property
    def prefix(self) -> str:
        """What every path begins with."""
        return f"/{self.token}/" if self.token else "/"

    def url(self, port: int) -> str:
        """What a person opens."""
        host = reachable_address(self.place)
        return f"http://{f'[{host}]' if ':' in host else host}:{port}{self.prefix}"

    def resource(self, path: str) -> str | None:
        """The resource that a request's path names, without token and query; None for one without the token."""
        path = path.partition("?")[0]
        given = path[: len(self.prefix)]
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self.prefix.encode()):
            return None
        return path[len(self.prefix) :]

    def knows_host(self, host_header: str) -> bool:
        """Whether the browser asked for this very computer. With a token, others cannot ask for anything anyway."""
        return bool(self.token) or names_this_computer(host_header, self.host)


def door_at(address: str) -> Door:
    """HOST:PORT as a door; with a token unless only this computer can reach it. Raises InputError for no address."""
    host, port = parse_destination(address, lowest_port=0)
    place = str(resolve(address, lowest_port=0)[1][0])
    return Door(host, place, port, "" if is_loopback(place) else secrets.token_urlsafe(TOKEN_BYTES))


def same_origin(origin: str | None, host_header: str) -> bool:
    """Whether a page that was loaded from here asks. Programs that are no browsers send no Origin."""
    return origin is None or origin in (f"http://{host_header}", f"https://{host_header}")


def page_headers(kind: str, length: int) -> dict[str, str]:
    """Of an answer: its page loads nothing from elsewhere, is shown in no other page, and tells nobody its address."""
    return {
        "Content-Type": kind,
        "Content-Length": str(length),
        "Cache-Control": "no-store",
        "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
    }


def reachable_address(place: str) -> str:
    """The address that others can use for one that this computer listens at."""
    if not ipaddress.ip_address(place.partition("%")[0]).is_unspecified:
        return place
    # No datagram is sent: a route is looked up, to an address that is reserved for documentation.
    family, nowhere = (socket.AF_INET6, "2001:db8::1") if ":" in place else (socket.AF_INET, "192.0.2.1")
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((nowhere, 9))
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()
