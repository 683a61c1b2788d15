"""Where poses are streamed to, as a user names it: `vmc://192.168.0.7:39540?rate=30&preset=arkit`, `lsl:tongue`, ..."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote

from ... import InputError
from ..pose import TrackedPose
from .filtered import FilteredWorker
from .oneeuro import OneEuro
from .osc import OscSink, parse_destination, resolve
from .sink import LiveNumbers, Sink, StreamContext, StreamInfo
from .slot import SlotSink, Worker

MAX_TARGET_LENGTH = 1000
AVATAR_RATE_HZ = 60.0
"""What avatar programs draw and expect; unless `rate` says otherwise."""
LOOK_UP_RATE_HZ = 20.0
"""How often a value that somebody may ask for is renewed."""
HIGHEST_RATE_HZ = 1000.0
RECORDED, WAITING = ("lsl", "json"), 64
"""At every frame, these kinds are for what keeps it: frames that come in a burst wait there, a quarter of a second at
250 Hz, and are not lost to newer ones."""

_RATE = {"rate": "poses a second at most, 0 = every frame"}
_CALM = {**_RATE, "filter": "MINCUTOFF,BETA of a one-euro filter: Hz, and Hz for one sigma a second"}
_AVATAR = {**_CALM, "preset": "the receiver's names: a preset, or a file of one that ends in .toml"}


@dataclass(frozen=True)
class TargetKind:
    """One row of the table of targets.

    form: how it is written; words: what it is; port: where its receivers listen unless told, 0 = it has a name and no
    address; rate_hz: unless told, None = every frame; preset: unless told; options: what may follow the `?`, with a word
    of help each; extra: the optional part of the installation that it needs.
    """

    scheme: str
    form: str
    words: str
    port: int
    rate_hz: float | None
    options: Mapping[str, str]
    preset: str = ""
    extra: str = ""


KINDS: tuple[TargetKind, ...] = (
    TargetKind(
        "osc",
        "osc://HOST:PORT",
        "our own OSC",
        9000,
        None,
        {**_CALM, "send": "what else goes there, as in coils,shapes,contact,mesh"},
    ),
    TargetKind(
        "vmc",
        "vmc://HOST[:39540]",
        "avatar programs that speak the VMC protocol, as an Assistant",
        39540,
        AVATAR_RATE_HZ,
        _AVATAR,
        "arkit",
    ),
    TargetKind(
        "vrchat",
        "vrchat://HOST[:9000]",
        "VRChat, with the parameters of VRCFaceTracking",
        9000,
        AVATAR_RATE_HZ,
        _AVATAR,
        "unified",
    ),
    TargetKind(
        "json",
        "json://HOST[:1235]",
        "the JSON of the paper's authors' live server, over UDP",
        1235,
        None,
        _CALM,
    ),
    TargetKind("lsl", "lsl:NAME", "Lab Streaming Layer, two outlets", 0, None, _RATE, extra="lab"),
    TargetKind(
        "oscquery",
        "oscquery://HOST[:9002]",
        "listens there, and tells OSCQuery clients of every OSC address and its value",
        9002,
        LOOK_UP_RATE_HZ,
        {},
    ),
)


@dataclass(frozen=True)
class Target:
    """A target as it was named, checked. host, port: of kinds with an address; name: of the others; rate_hz: None = every
    frame; one_euro: lowest cut-off (Hz) and beta, None = no filter; preset: "" where the kind has none; send: of `osc_more.WORDS`.
    """

    kind: TargetKind
    host: str = ""
    port: int = 0
    name: str = ""
    rate_hz: float | None = None
    one_euro: tuple[float, float] | None = None
    preset: str = ""
    send: tuple[str, ...] = ()

    @property
    def destination(self) -> str:
        """HOST:PORT."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


def parse_target(text: str) -> Target:
    """Reads a target. Raises InputError that names what is wrong and what is possible instead; also where its host is
    unknown."""
    scheme, colon, rest = text.strip().partition(":")
    kind = next((kind for kind in KINDS if kind.scheme == scheme.lower()), None)
    if kind is None or not colon or len(text) > MAX_TARGET_LENGTH or not text.isprintable():
        forms = ", ".join(kind.form for kind in KINDS)
        raise InputError(f"{text[:80]!r}: this is no target; expected one of {forms}.")
    place, _, query = rest.partition("?")
    options = _options(text, kind, query)
    host, port, name = _place(text, kind, place)
    return Target(
        kind,
        host,
        port,
        name,
        _rate(text, options["rate"]) if "rate" in options else kind.rate_hz,
        _one_euro(text, options["filter"]) if "filter" in options else None,
        _preset(text, options.get("preset", kind.preset)),
        _send(text, options.get("send", "")),
    )


def open_target(
    target: Target,
    context: StreamContext,
    numbers: Callable[[], LiveNumbers] | None = None,
    said: Callable[[str], None] = lambda text: None,
) -> list[Sink]:
    """The ways to a target, mostly one; the caller closes them. numbers: what a live run says of itself, for receivers
    that are told; said: called once for each new failure, in a stream's thread.

    Raises InputError where a stream cannot be opened, for want of an extra or because the model has no such shapes.
    """

    def slot(worker: Worker) -> SlotSink:
        if target.one_euro is not None:
            worker = FilteredWorker(worker, OneEuro(*target.one_euro))
        every_frame = target.rate_hz is None and target.kind.scheme in RECORDED
        return SlotSink(worker, target.rate_hz, said, WAITING if every_frame else 1)

    if target.kind.scheme != "osc":
        return [slot(_worker(target, context, numbers, said))]
    osc = OscSink(target.destination)
    osc.numbers = numbers
    # For every frame, it costs less to send than to hand on to a thread.
    plain = target.rate_hz is None and target.one_euro is None
    sinks: list[Sink] = [osc if plain else slot(OscWorker(osc))]
    if target.send:
        from .osc_more import OscMoreWorker

        sinks.append(slot(OscMoreWorker(target.destination, context, target.send)))
    return sinks


class OscWorker:
    """The OSC stream behind a slot: at a rate of its own."""

    def __init__(self, sink: OscSink) -> None:
        self.destination = sink.destination
        self._sink = sink
        self._begun = False

    def begin(self, info: StreamInfo) -> None:
        (self._sink.change if self._begun else self._sink.start)(info)
        self._begun = True

    def work(self, pose: TrackedPose) -> None:
        dropped = self._sink.dropped
        self._sink.send(pose)
        if self._sink.dropped > dropped:
            raise OSError("the network did not take it")

    def end(self) -> None:
        self._sink.close()


def _worker(
    target: Target,
    context: StreamContext,
    numbers: Callable[[], LiveNumbers] | None,
    said: Callable[[str], None],
) -> Worker:
    match target.kind.scheme:
        case "vmc":
            from .avatar import avatar_values
            from .vmc import VmcWorker

            return VmcWorker(target.destination, avatar_values(target.preset, context, signed=False))
        case "vrchat":
            from .avatar import avatar_values
            from .vrchat import VrchatWorker, parameter_prefixes

            values = avatar_values(target.preset, context, signed=True)
            return VrchatWorker(target.destination, values, parameter_prefixes(target.preset))
        case "json":
            from .json_out import JsonWorker

            return JsonWorker(target.destination)
        case "oscquery":
            from .oscquery import OscQueryWorker

            return OscQueryWorker(target.destination, context, numbers, said)
        case _:
            from .lsl import LslWorker

            return LslWorker(target.name, paced=target.rate_hz is not None)


def _place(text: str, kind: TargetKind, place: str) -> tuple[str, int, str]:
    """Host, port and name, as far as the kind has them."""
    if not kind.port:
        name = unquote(place.removeprefix("//").rstrip("/")).strip()
        if not name.isprintable() or not 0 < len(name) <= 100:
            raise InputError(f"'{text}': expected a name for the stream, as in {kind.scheme}:tongue.")
        return "", 0, name
    if place and not place.startswith("//"):
        raise InputError(f"'{text}': expected {kind.form}.")
    address = place.removeprefix("//").rstrip("/") or "127.0.0.1"
    if address.endswith("]") or ":" not in address:
        address = f"{address}:{kind.port}"
    host, port = parse_destination(address)
    resolve(address)
    return host, port, ""


def _options(text: str, kind: TargetKind, query: str) -> dict[str, str]:
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query), max_num_fields=20)
    except ValueError:
        raise InputError(f"'{text}': after the ? stand options, as in ?rate=30&preset=arkit.") from None
    options = dict(pairs)
    if len(options) < len(pairs):
        raise InputError(f"'{text}': an option stands there twice.")
    for name in options:
        if name not in kind.options:
            known = f"expected {', '.join(kind.options)}" if kind.options else "it has none"
            raise InputError(f"'{text}': {kind.scheme} has no option '{name}'; {known}.")
    return options


def _rate(text: str, value: str) -> float | None:
    rate_hz = _number(value)
    if not 0 <= rate_hz <= HIGHEST_RATE_HZ:
        raise InputError(
            f"'{text}': rate={value} should be a number of Hz up to {HIGHEST_RATE_HZ:g}, 0 = every frame."
        )
    return rate_hz or None


def _one_euro(text: str, value: str) -> tuple[float, float]:
    numbers = [_number(part) for part in value.split(",")]
    try:
        if len(numbers) != 2:
            raise InputError("expected two numbers with a comma between them, as in filter=1.5,0.5.")
        OneEuro(*numbers)
    except InputError as reason:
        raise InputError(f"'{text}': filter={value}: {reason}") from reason
    return numbers[0], numbers[1]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _preset(text: str, name: str) -> str:
    if name:
        from .presets import load_preset

        try:
            load_preset(name)
        except InputError as reason:
            raise InputError(f"'{text}': {reason}") from reason
    return name


def _send(text: str, value: str) -> tuple[str, ...]:
    chosen = tuple(dict.fromkeys(part.strip() for part in value.split(",") if part.strip()))
    if chosen:
        from .osc_more import WORDS

        for part in chosen:
            if part not in WORDS:
                raise InputError(f"'{text}': send={part} is not known; expected some of {', '.join(WORDS)}.")
    return chosen
