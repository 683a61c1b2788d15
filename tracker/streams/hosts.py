"""Whom a browser asked for: the Host header, as servers for this computer alone look at it."""

from __future__ import annotations

import ipaddress
import re

_HEADER = re.compile(r"(?:\[(?P<v6>[0-9a-fA-F:.]+)\]|(?P<name>[\w.-]+))(?::\d+)?")


def names_this_computer(header: str, *also: str) -> bool:
    """Whether a Host header is a name that only this computer has for itself, or one of these.

    A page of somebody else's could otherwise reach a server through a name of its own that leads to 127.0.0.1 (DNS
    rebinding).
    """
    named = _HEADER.fullmatch(header)
    name = (named["v6"] or named["name"]).lower().rstrip(".") if named else ""
    return name in ("localhost", *(other.lower().rstrip(".") for other in also)) or is_loopback(name)


def is_loopback(address: str) -> bool:
    """Whether it is a numeric address that only this computer can reach."""
    try:
        return ipaddress.ip_address(address.partition("%")[0]).is_loopback
    except ValueError:
        return False
