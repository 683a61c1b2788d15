"""What arrives at a port: datagrams taken apart with python-osc and counted, whoever sent them."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pythonosc.osc_packet import OscPacket, ParseError

from ..latency import NS_PER_MS, LogHistogram, latency_histogram, percentiles_text
from ..pose import CoilState
from .addresses import COIL_STATES, COILS, FRAME, INFO, LATENCY, QUALITY, TAKE, Address
from .protocols import known_address
from .vmc import VMC_VALUE
from .vocabularies import NamedValues, Vocabulary
from .vrchat import PARAMETER, UNIFIED, parameter_prefixes

MAX_BYTES = 8192
"""Longer datagrams are counted and not taken apart: ours have at most 1400 bytes."""
MAX_DEPTH = 4
MAX_UNKNOWN = 64
MAX_SEEN = 512
"""Addresses with a name in them are as many as a sender likes."""
MAX_SENDERS = 16
RESTART_DISTANCE = 1000
"""A sequence number this far back begins a new stream; nearer, the datagram was overtaken."""
MAX_REMEMBERED_GAPS = 4096
MAX_NOTICES = 200

Sender = tuple[str, int]


def is_well_formed(datagram: bytes, depth: int = MAX_DEPTH) -> bool:
    """Whether the sizes inside a packet lie inside it: python-osc would follow a negative one for ever."""
    if len(datagram) % 4:
        return False
    if not datagram.startswith(b"#bundle\0"):
        return datagram.startswith(b"/")
    if depth == 0 or len(datagram) < 16:
        return False
    at = 16
    while at < len(datagram):
        (size,) = struct.unpack_from(">i", datagram, at)
        at += 4
        if size <= 0 or at + size > len(datagram):
            return False
        if not is_well_formed(datagram[at : at + size], depth - 1):
            return False
        at += size
    return True


def decode(datagram: bytes) -> list[tuple[str, list[object]]] | None:
    """The addresses and arguments in a datagram, None where it is not OSC."""
    if len(datagram) > MAX_BYTES or not is_well_formed(datagram):
        return None
    try:
        return [(timed.message.address, timed.message.params) for timed in OscPacket(datagram).messages]
    except (ParseError, ValueError, IndexError, TypeError, OverflowError, struct.error):
        return None


@dataclass
class Stream:
    """The sequence numbers of one sender, and what it says of itself.

    lost: missing so far (`missing`: the newest of them); late: came after a newer one; repeated: came twice, or long after.
    said: what it said last about its coils and its take, in words, by address.
    """

    newest: int | None = None
    frames: int = 0
    lost: int = 0
    late: int = 0
    repeated: int = 0
    starts: int = 0
    info: dict[str, object] = field(default_factory=dict)
    missing: dict[int, None] = field(default_factory=dict)
    said: dict[str, str] = field(default_factory=dict)

    def add(self, number: int) -> None:
        self.frames += 1
        newest = self.newest
        if newest is None or (number == 0 and newest > 0) or newest - number >= RESTART_DISTANCE:
            self.starts += 1
            self.missing.clear()
        elif number > newest:
            self.lost += number - newest - 1
            for missing in range(max(newest + 1, number - MAX_REMEMBERED_GAPS), number):
                self.missing[missing] = None
            while len(self.missing) > MAX_REMEMBERED_GAPS:
                del self.missing[next(iter(self.missing))]
        else:
            if number in self.missing:
                del self.missing[number]
                self.lost -= 1
                self.late += 1
            else:
                self.repeated += 1
            return
        self.newest = number

    @property
    def lost_percent(self) -> float:
        expected = self.frames - self.repeated + self.lost
        return 100.0 * self.lost / expected if expected else 0.0


@dataclass
class Seen:
    """One known address. misfits: messages whose arguments are not those of the table; fitting: the newest others."""

    count: int = 0
    misfits: int = 0
    first_ns: int = 0
    newest_ns: int = 0
    last: list[object] = field(default_factory=list)
    fitting: list[Any] = field(default_factory=list)

    @property
    def rate_hz(self) -> float | None:
        span_ns = self.newest_ns - self.first_ns
        return (self.count - 1) * 1e9 / span_ns if span_ns > 0 else None


class Monitor:
    """Statistics of everything that arrived. Memory is bounded, whatever is sent.

    tell: called with one sentence when a stream starts, changes or an unknown address first appears. vocabularies:
    preset -> its names, which the names of blend shapes and avatar parameters are held against.
    """

    def __init__(
        self,
        tell: Callable[[str], object] = lambda sentence: None,
        vocabularies: Mapping[str, Vocabulary] | None = None,
    ) -> None:
        self.tell = tell
        self.named = NamedValues(vocabularies or {})
        self.datagrams = 0
        self.bytes = 0
        self.malformed = 0
        self.seen: dict[str, Seen] = {}
        self.seen_beyond = 0
        self.unknown: dict[str, int] = {}
        self.unknown_beyond = 0
        self.streams: dict[Sender, Stream] = {}
        self.senders_beyond = 0
        self.latency_ns: LogHistogram = latency_histogram()
        self._notices = 0

    def receive(self, datagram: bytes, sender: Sender, now_ns: int) -> None:
        """Counts one datagram. Never raises because of what is in it."""
        self.datagrams += 1
        self.bytes += len(datagram)
        messages = decode(datagram)
        if messages is None:
            self.malformed += 1
            if self.malformed == 1:
                self._tell(f"{_shown(sender)} sends something that is not OSC ({len(datagram)} bytes)")
            return
        for path, values in messages:
            self._message(path, values, sender, now_ns)

    def _message(self, path: str, values: list[object], sender: Sender, now_ns: int) -> None:
        row = known_address(path)
        if row is None:
            self._unknown(path, sender)
            return
        if path not in self.seen and len(self.seen) == MAX_SEEN:
            self.seen_beyond += 1
            return
        seen = self.seen.setdefault(path, Seen(first_ns=now_ns))
        seen.count += 1
        seen.newest_ns = now_ns
        seen.last = values
        if not row.fits(values):
            seen.misfits += 1
            if seen.misfits == 1:
                self._tell(f"{path} from {_shown(sender)} has other arguments than {row.type_tags}")
            return
        seen.fitting = values
        if row is FRAME:
            self._frame(values, sender)
        elif row is INFO:
            self._info(values, sender)
        elif row is QUALITY and isinstance(values[2], float) and 0.0 <= values[2] < math.inf:
            self.latency_ns.add(values[2] * NS_PER_MS)
        elif row is COIL_STATES:
            coils = self.seen.get(COILS.path, Seen()).fitting
            self._said(row, _coil_states_text(coils, values), sender)
        elif row is TAKE:
            self._said(row, _take_text(values), sender)
        elif row is VMC_VALUE:
            self._named(str(values[0]), values[1], sender)
        elif row is PARAMETER:
            self._named(row.name_in(path), values[0], sender)

    def _named(self, name: str, value: Any, sender: Sender) -> None:
        prefix = next((prefix for prefix in parameter_prefixes(UNIFIED) if name.startswith(prefix)), "")
        words = self.named.add(_printable(name.removeprefix(prefix)), value)
        if words:
            self._tell(f"{_shown(sender)}: {words}")

    def _said(self, row: Address, words: str, sender: Sender) -> None:
        """Tells what became of the coils or the take, where it is another than before."""
        stream = self._stream(sender)
        if stream is not None and words != stream.said.get(row.path):
            stream.said[row.path] = words
            self._tell(f"{_shown(sender)}: {words}")

    def _stream(self, sender: Sender) -> Stream | None:
        if sender not in self.streams and len(self.streams) == MAX_SENDERS:
            self.senders_beyond += 1
            return None
        return self.streams.setdefault(sender, Stream())

    def _frame(self, values: list[object], sender: Sender) -> None:
        stream = self._stream(sender)
        number = values[0]
        if stream is None or not isinstance(number, int):
            return
        starts = stream.starts
        stream.add(number)
        if stream.starts > starts:
            self._tell(f"a stream from {_shown(sender)} starts, at frame {number}")

    def _info(self, values: list[object], sender: Sender) -> None:
        stream = self._stream(sender)
        info = {argument.name: _plain(value) for argument, value in zip(INFO.arguments, values, strict=True)}
        if stream is not None and info != stream.info:
            stream.info = info
            self._tell(f"{_shown(sender)}: " + ", ".join(f"{name} {value}" for name, value in info.items()))

    def _tell(self, sentence: str) -> None:
        self._notices += 1
        if self._notices < MAX_NOTICES:
            self.tell(sentence)
        elif self._notices == MAX_NOTICES:
            self.tell("further notices are left out; the summary at the end counts everything")

    def _unknown(self, path: str, sender: Sender) -> None:
        name = _printable(path)
        if name in self.unknown:
            self.unknown[name] += 1
        elif len(self.unknown) < MAX_UNKNOWN:
            self.unknown[name] = 1
            self._tell(f"unknown address {name} from {_shown(sender)}")
        else:
            self.unknown_beyond += 1

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain values, without NaN."""
        return {
            "datagrams": self.datagrams,
            "bytes": self.bytes,
            "malformed": self.malformed,
            "streams": [
                {
                    "sender": _shown(sender),
                    "frames": stream.frames,
                    "lost": stream.lost,
                    "lost_percent": stream.lost_percent,
                    "late": stream.late,
                    "repeated": stream.repeated,
                    "starts": stream.starts,
                    "info": stream.info,
                }
                for sender, stream in self.streams.items()
            ],
            "messages_of_further_senders": self.senders_beyond,
            "latency_ms": self.latency_ns.as_dict(NS_PER_MS),
            "addresses": {
                path: {
                    "count": seen.count,
                    "rate_hz": seen.rate_hz,
                    "misfits": seen.misfits,
                    "last": [_plain(value) for value in seen.last],
                }
                for path, seen in sorted(self.seen.items())
            },
            "addresses_beyond": self.seen_beyond,
            "names": self.named.as_dict(),
            "unknown": dict(sorted(self.unknown.items())),
            "unknown_beyond": self.unknown_beyond,
        }

    def __str__(self) -> str:
        lines = [f"datagrams  {self.datagrams} ({self.bytes} bytes), {self.malformed} not OSC"]
        for sender, stream in self.streams.items():
            starts = f", {stream.starts} starts" if stream.starts > 1 else ""
            lines.append(
                f"stream     {_shown(sender)}: {stream.frames} frames, {stream.lost} lost "
                f"({stream.lost_percent:.2f} %), {stream.late} late, {stream.repeated} repeated{starts}"
            )
        if self.latency_ns.count:
            shown = percentiles_text(self.latency_ns.as_dict(NS_PER_MS), "ms")
            lines.append(f"latency    {shown} (arrival at the tracker until written)")
        if stages := self.seen.get(LATENCY.path, Seen()).fitting:
            lines.append(f"stages     {_stages_text(stages)}")
        for stream in self.streams.values():
            lines += [f"said       {words}" for words in stream.said.values()]
        if self.seen:
            width = max(len(path) for path in self.seen)
            lines.append(f"{'address':<{width}}    count  per s  last")
        for path, seen in sorted(self.seen.items()):
            rate = f"{seen.rate_hz:6.1f}" if seen.rate_hz else "     -"
            misfits = f"  ({seen.misfits} with other arguments)" if seen.misfits else ""
            last = " ".join(_short(value) for value in seen.last[:8]) + (" ..." if len(seen.last) > 8 else "")
            lines.append(f"{path:<{width}}  {seen.count:7d} {rate}  {last}{misfits}")
        if self.seen_beyond:
            lines.append(f"further addresses: {self.seen_beyond} messages")
        lines += self.named.lines()
        lines += [f"unknown    {name}: {count}" for name, count in sorted(self.unknown.items())]
        if self.unknown_beyond:
            lines.append(f"unknown    further addresses: {self.unknown_beyond}")
        return "\n".join(lines)


def _coil_states_text(roles: list[Any], states: list[Any]) -> str:
    """ "coils 2 of 3 trusted, tongue_tip missing"; coils are numbered where their roles have not arrived yet."""
    names = roles if len(roles) == len(states) else range(1, len(states) + 1)
    known = {int(state): state.name.lower() for state in CoilState}
    out = [
        f"{_printable(str(name))} {known.get(state, state)}"
        for name, state in zip(names, states, strict=True)
        if state != CoilState.TRUSTED
    ]
    return ", ".join([f"coils {len(states) - len(out)} of {len(states)} trusted", *out])


def _take_text(values: list[Any]) -> str:
    path, _, failure = values
    said = f"take {_printable(path)}" if path else "no take"
    return f"{said}, FAILED: {_printable(failure)}" if failure else said


def _stages_text(values: list[Any]) -> str:
    """Pairs of p50 and p99, - where unknown."""
    numbers = [f"{value:.2f}" if 0.0 <= value < math.inf else "-" for value in values]
    stages = ("device to host", "host to solved", "solved to sent")
    pairs = zip(stages, numbers[::2], numbers[1::2], strict=True)
    return ", ".join(f"{stage} {p50}/{p99}" for stage, p50, p99 in pairs) + " ms (p50/p99, by the sender)"


def _shown(sender: Sender) -> str:
    return f"[{sender[0]}]:{sender[1]}" if ":" in sender[0] else f"{sender[0]}:{sender[1]}"


def _printable(text: str) -> str:
    """Foreign text without anything that a terminal would obey, cut to a line's length."""
    plain = "".join(c if c.isascii() and c.isprintable() else "?" for c in text[:80])
    return plain + ("..." if len(text) > 80 else "")


def _plain(value: object) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return value if isinstance(value, int) else _printable(str(value))


def _short(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else _printable(str(_plain(value)))
