"""Sources named by a URI: `rtc3d://host:3030`, `ndi:///dev/ttyUSB0?baud=921600`, `replay:take.xdf?speed=2`."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import parse_qsl, unquote

from .. import InputError
from .frames import CoilFrame, FrameOfReference, SourceNote

MAX_ADDRESS_LENGTH = 4096


class Source(Protocol):
    """Where frames come from. Iterating waits for the next item and ends when the source ends or is stopped.

    coils: names, in the order of the positions. rate_hz: nominal frames a second, 0.0 while it is unknown.
    address: what was opened, for people.
    """

    @property
    def address(self) -> str: ...

    @property
    def coils(self) -> tuple[str, ...]: ...

    @property
    def rate_hz(self) -> float: ...

    @property
    def frame(self) -> FrameOfReference: ...

    def __iter__(self) -> Iterator[CoilFrame | SourceNote]: ...

    def stop(self) -> None:
        """Ends the iteration soon. May be called from another thread or a signal handler."""

    def close(self) -> None:
        """Says goodbye to the device and lets it go."""


@dataclass(frozen=True)
class SourceKind:
    """One row of the table of sources.

    forms: how its address is written; words: what it is; port: where it listens unless told; options: what may
    follow the `?`, with a word of help each; opener: module:function below this package that takes a
    `SourceAddress` and gives a `Source`; "" = opened by the tracker. experimental: never met the real device.
    extra: the optional part of the installation that it needs.
    """

    scheme: str
    forms: str
    words: str
    options: Mapping[str, str]
    opener: str
    port: int = 0
    experimental: bool = False
    extra: str = ""


_RATE = {"rate": "frames a second, where the device does not say it"}

KINDS: tuple[SourceKind, ...] = (
    SourceKind(
        "rtc3d",
        "rtc3d://HOST[:3030]",
        "NDI Wave, WaveFront, First Principles (RTC3D over TCP)",
        {
            "order": "byte order to ask for: big (default) or little",
            "coils": "how many sensors to expect",
            **_RATE,
        },
        "devices.rtc3d_source:open_rtc3d",
        port=3030,
    ),
    SourceKind(
        "ndi",
        "ndi:///dev/ttyUSB0",
        "NDI Aurora, Polaris, Vega (combined API, serial)",
        {
            "baud": "speed to negotiate (default: 921600, or the fastest the device takes)",
            "reply": "bx (default) or tx",
            **_RATE,
        },
        "devices.ndi_source:open_ndi",
    ),
    SourceKind(
        "ndi+tcp",
        "ndi+tcp://HOST[:8765]",
        "NDI Vega (combined API over TCP)",
        {"reply": "bx (default) or tx", **_RATE},
        "devices.ndi_source:open_ndi",
        port=8765,
    ),
    SourceKind(
        "ndi+rfc2217",
        "ndi+rfc2217://HOST:PORT",
        "the same behind a serial port server (RFC 2217)",
        {"baud": "speed to negotiate", "reply": "bx (default) or tx", **_RATE},
        "devices.ndi_source:open_ndi",
    ),
    SourceKind(
        "carstens",
        "carstens://HOST[:30303]",
        "Carstens AG500, AG501 (cs5recorder over TCP)",
        {
            "layout": "ag500, ag501, ag501-head, ag501-16, ag501-16-head (default: told by the size)",
            "poll": "requests a second (default 500); twice the device's rate misses nothing",
            **_RATE,
        },
        "devices.carstens_source:open_carstens",
        port=30303,
        experimental=True,
    ),
    SourceKind(
        "udp-json",
        "udp-json://[HOST][:1234]",
        "clients of the paper's authors' live server (JSON over UDP); we are the server",
        {
            "reply": "HOST:PORT that is answered (default 127.0.0.1:1235)",
            "indices": "the points' vertices, as in 885,1912,2469, for a client that does not send them",
            **_RATE,
        },
        "devices.authors_live:open_authors_live",
        port=1234,
    ),
    SourceKind(
        "lsl",
        "lsl:NAME",
        "a Lab Streaming Layer stream with coil positions",
        {
            "timeout": "seconds to look for it (default 5)",
            "unit": "m or mm, where the stream does not say it",
        },
        "devices.lsl_source:open_lsl",
        extra="lab",
    ),
    SourceKind(
        "replay",
        "replay:FILE",
        "a recording or take, as if a device were sending it",
        {
            "speed": "1 (default), 2 for twice as fast, max for no pauses",
            "loop": "1 to begin again at the end",
            "rate": "sampling rate, where the file states none",
            "unit": "unit of positions, where the file states none",
            "layout": "as --layout",
        },
        "sources:open_replay",
    ),
    SourceKind(
        "simulate",
        "simulate:",
        "a synthetic speaker",
        {
            "coils": "ROLE,... (default tongue_tip,tongue_blade,tongue_dorsum)",
            "rate": "frames a second (default 250)",
            "noise": "mm (default 0.3)",
            "dropouts": "share of samples that are missing (default 0)",
            "head_motion": "1 to move the head",
            "speaker": "seed (default 1)",
            "seconds": "length of what is repeated (default 20)",
        },
        "",
    ),
)


@dataclass(frozen=True)
class SourceAddress:
    """A URI taken apart. port: 0 = the kind has none; path: the device file or recording; text: as it was given."""

    kind: SourceKind
    text: str
    host: str = ""
    port: int = 0
    path: str = ""
    options: Mapping[str, str] | None = None

    def option(self, name: str, default: str = "") -> str:
        return (self.options or {}).get(name, default)

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """A numeric option; raises InputError outside low..high."""
        text = self.option(name)
        if not text:
            return default
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise InputError(f"'{self.text}': {name}={text}: expected a number from {low:g} to {high:g}.")
        return value

    def choice(self, name: str, default: str, choices: tuple[str, ...]) -> str:
        """One of several words; raises InputError for another."""
        text = self.option(name, default).lower()
        if text not in choices:
            raise InputError(f"'{self.text}': {name}={text}: expected {', '.join(choices)}.")
        return text


def parse_source(text: str) -> SourceAddress:
    """Takes a source's URI apart. Raises InputError that lists the kinds, or the options of the kind."""
    if len(text) > MAX_ADDRESS_LENGTH or not text.isprintable():
        raise InputError("a source's address is one printable line of at most 4096 characters.")
    scheme, colon, rest = text.partition(":")
    kind = next((row for row in KINDS if row.scheme == scheme.lower()), None)
    if not colon or kind is None:
        if meant := _meant(text):
            raise InputError(
                f"'{text}' is not a source; did you mean {meant}? `tonguetrack devices` lists all."
            )
        forms = ", ".join(row.forms for row in KINDS)
        raise InputError(f"'{text}' is not a source; sources are {forms} (see `tonguetrack devices`).")
    place, question, query = rest.rpartition("?") if "?" in rest else (rest, "", "")
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        if name not in kind.options:
            raise InputError(
                f"'{text}': the option '{name}' is unknown; {kind.scheme} takes {', '.join(kind.options)}."
            )
    if question and query and not options:
        raise InputError(f"'{text}': '{query}' should be options, as in ?{next(iter(kind.options))}=...")
    if kind.scheme in ("replay", "lsl", "simulate"):
        if kind.scheme != "simulate" and not place:
            raise InputError(f"'{text}': a name is missing, as in {kind.forms}.")
        return SourceAddress(kind, text, path=place, options=options)
    if not place.startswith("//"):
        raise InputError(f"'{text}': expected {kind.forms}.")
    place = place[2:]
    if kind.scheme == "ndi":
        if not place:
            raise InputError(f"'{text}': the serial port is missing, as in {kind.forms} or ndi://COM3.")
        path = unquote(place)
        if not path.isprintable():
            raise InputError(f"'{text}': a serial port has no such name; expected {kind.forms}.")
        return SourceAddress(kind, text, path=path, options=options)
    host, port = _host_and_port(place.rstrip("/"), kind, text)
    return SourceAddress(kind, text, host=host, port=port, options=options)


def _meant(text: str) -> str:
    """The address of a port or a file that was named without its kind; "" where it looks like neither."""
    if re.fullmatch(r"COM\d+|/dev/[\w./-]+", text, re.ASCII | re.IGNORECASE):
        return f"ndi://{text}"
    if re.match(r"[A-Za-z]:[\\/]", text) or os.path.exists(text):
        return f"replay:{text}"
    return ""


def open_device(address: SourceAddress) -> Source:
    """Opens what `parse_source` gave, apart from `simulate:`, which the tracker opens.

    Connects, and raises InputError where nobody answers.
    """
    module, _, function = address.kind.opener.partition(":")
    opened: Source = getattr(importlib.import_module(f".{module}", __package__), function)(address)
    return opened


def open_replay(address: SourceAddress) -> Source:
    """`replay:FILE`."""
    from .files import open_recording
    from .replay import ReplaySource

    speed: float | None = None
    if address.option("speed") != "max":
        speed = address.number("speed", 1.0, 1e-3, 1e3)
    loop = address.choice("loop", "0", ("0", "1")) == "1"
    try:
        recording = open_recording(
            address.path,
            rate_hz=address.number("rate", 0.0, 1e-3, 1e6) or None,
            unit=address.option("unit") or None,
            layout=address.option("layout") or None,
        )
    except InputError as reason:
        flag = re.search(r"--(rate|unit|layout)\b", str(reason))
        if flag is None:
            raise
        raise InputError(f"{reason} In a source's address this is ?{flag[1]}=...") from reason
    return ReplaySource(recording, speed, loop)


def _host_and_port(place: str, kind: SourceKind, text: str) -> tuple[str, int]:
    host, colon, port = place.rpartition(":")
    if not colon or place.endswith("]"):  # no port, perhaps an IPv6 address in brackets
        host, port = place, str(kind.port or "")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        raise InputError(f"'{text}': an IPv6 address stands in brackets, as in {kind.scheme}://[::1]:3030.")
    if not host and kind.scheme != "udp-json":
        raise InputError(f"'{text}': the host is missing, as in {kind.forms}.")
    if any(c.isspace() or c in "/[]@" for c in host):
        raise InputError(f"'{text}': '{host}' is not a host; expected {kind.forms}.")
    if not port:
        raise InputError(f"'{text}': the port is missing, as in {kind.forms}.")
    if not (port.isascii() and port.isdigit() and 1 <= int(port) <= 65535):
        raise InputError(f"'{text}': the port '{port}' should be a number from 1 to 65535.")
    return host, int(port)
