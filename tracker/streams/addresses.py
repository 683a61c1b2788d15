"""The OSC addresses as data: the encoder, the monitor's checks and the documentation are made from it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

PROTOCOL_NAME = "tonguetrack"
PROTOCOL_VERSION = 1
MAX_DATAGRAM_BYTES = 1400
MAX_BLOB_BYTES = 1300
"""Receivers lose longer blobs, or the datagrams they come in."""
MAX_CONTROL_TEXT = 200
DEFAULT_CONTROL_PORT = 9001
INFO_PERIOD_S = 1.0
NO_RESIDUAL = -1.0
NO_LATENCY = -1.0
SPEAKER_FIXED, SPEAKER_FREE = "fixed", "free"

_VALUE_TYPES: dict[str, tuple[type, ...]] = {
    "i": (int,),
    "f": (float,),
    "s": (str,),
    "b": (bytes,),
    "T": (bool,),
}
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]")


@dataclass(frozen=True)
class Argument:
    """tag: OSC type, "i", "f", "s", "b" or "T" for true or false; count: "" for one, else the letter for how many.

    limits: the smallest and the largest value that can come, None where there is no such limit.
    """

    name: str
    tag: str
    unit: str = ""
    count: str = ""
    limits: tuple[float, float] | None = None

    def __str__(self) -> str:
        unit = f" ({self.unit})" if self.unit else ""
        if self.tag == "T":
            unit = " (type T or F)"
        return f"{self.count} x {self.name}{unit}" if self.count else f"{self.name}{unit}"


@dataclass(frozen=True)
class Address:
    """One row of a table. In the path stands `<k>` for the index of a coefficient, from 0, `<name>` for a name."""

    path: str
    arguments: tuple[Argument, ...]
    when: str
    meaning: str

    @property
    def type_tags(self) -> str:
        """As OSC writes them, with * and a letter where an argument repeats: ",f*K"."""
        repeated = (f"{a.tag}*{a.count}" if a.count else a.tag for a in self.arguments)
        return "," + "".join(repeated)

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        pattern = re.escape(self.path).replace(re.escape("<k>"), "[0-9]{1,3}")
        return re.compile(pattern.replace(re.escape("<name>"), "(?P<name>[A-Za-z0-9_./-]{1,80})"))

    def matches(self, path: str) -> bool:
        return self._pattern.fullmatch(path) is not None

    def name_in(self, path: str) -> str:
        """What stands for `<name>` in a path that matches."""
        found = self._pattern.fullmatch(path)
        assert found is not None, "matches() comes first"
        return found.group("name")

    def named(self, name: str) -> str:
        """The path for one name; what OSC reserves becomes _."""
        return self.path.replace("<name>", _UNSAFE.sub("_", name)[:80] or "_")

    def at(self, index: int) -> str:
        """The path for one coefficient."""
        return self.path.replace("<k>", str(index))

    def fits(self, values: list[object]) -> bool:
        """Whether decoded arguments have the types and the number that the row states."""
        if self.arguments and self.arguments[-1].count:
            single, repeated = self.arguments[:-1], self.arguments[-1]
        else:
            single, repeated = self.arguments, None
        if len(values) < len(single) or (repeated is None and len(values) > len(single)):
            return False
        expected = [argument.tag for argument in single]
        if repeated is not None:
            expected += [repeated.tag] * (len(values) - len(single))
        return all(type(v) in _VALUE_TYPES[tag] for v, tag in zip(values, expected, strict=True))


FRAME = Address(
    "/tongue/frame",
    (Argument("sequence number", "i"), Argument("time", "f", "s"), Argument("status", "i", limits=(0, 3))),
    "every frame",
    "The sequence number counts this stream's frames from 0, so a gap is a lost datagram. The time is the "
    "device's, since the stream's first frame. Status: see below.",
)
POSE = Address(
    "/tongue/pose",
    (Argument("weight", "f", "raw", "K"),),
    "every frame",
    "The coefficients of the pose, as the model multiplies them.",
)
SIGMA = Address(
    "/tongue/sigma",
    (Argument("weight", "f", "sigma", "K"),),
    "every frame",
    "The same in standard deviations from the mean: (weight - mean) / spread. Mostly within -3 and 3.",
)
POSE_SCALAR = Address(
    "/tongue/pose/<k>",
    (Argument("weight", "f", "raw"),),
    "every frame, where it fits",
    "Coefficient k alone, for receivers that map one address to one property.",
)
SIGMA_SCALAR = Address(
    "/tongue/sigma/<k>",
    (Argument("weight", "f", "sigma"),),
    "every frame, where it fits",
    "The same in standard deviations.",
)
QUALITY = Address(
    "/tongue/quality",
    (Argument("residual", "f", "mm"), Argument("valid coils", "i"), Argument("latency", "f", "ms")),
    "every frame",
    "Mean distance of the coils from their vertices, -1 when no coil was there; how many coils were there; "
    "time on the sending host from the frame's arrival until its bundle was written.",
)
INFO = Address(
    "/tongue/info",
    (
        Argument("protocol", "s"),
        Argument("protocol version", "i"),
        Argument("model name", "s"),
        Argument("model fingerprint", "s"),
        Argument("vertices", "i"),
        Argument("K", "i"),
        Argument("speaker", "s", "fixed or free"),
        Argument("rate", "f", "Hz"),
    ),
    "start, every second",
    "What is streamed. The bundled model, which is not anatomy, has the word synthetic in its name.",
)
COILS = Address(
    "/tongue/coils",
    (Argument("role", "s", count="n"),),
    "start, every second",
    "The roles of the coils that are tracked.",
)
SPEAKER = Address(
    "/tongue/speaker",
    (Argument("weight", "f", "raw", "m"),),
    "start, every second",
    "The speaker's weights; while the speaker is free, those of the latest frame.",
)
MEAN = Address(
    "/tongue/mean",
    (Argument("weight", "f", "raw", "K"),),
    "start, every second",
    "The mean of each coefficient.",
)
SPREAD = Address(
    "/tongue/spread",
    (Argument("weight", "f", "raw", "K"),),
    "start, every second",
    "The standard deviation of each coefficient.",
)

LATENCY = Address(
    "/tongue/latency",
    tuple(
        Argument(f"{stage} {percentile}", "f", "ms")
        for stage in ("device to host", "host to solved", "solved to sent")
        for percentile in ("p50", "p99")
    ),
    "every second, in a live run",
    "Where the time goes, since the start of the run: how much later than the earliest the frames come from the "
    "device, from a frame's arrival to its pose, from there until it was sent. -1 where it is not known.",
)
COIL_STATES = Address(
    "/tongue/coilstates",
    (Argument("state", "i", count="n", limits=(0, 5)),),
    "every second, and with the frame in which one changes",
    "What became of each coil, in the order of `/tongue/coils`: see below. Not sent where coils are not watched.",
)
TAKE = Address(
    "/tongue/take",
    (Argument("path", "s"), Argument("frames", "i"), Argument("failure", "s")),
    "every second, in a live run",
    "The take that is being written, an empty text where there is none; the frames in it; why it is no longer "
    "written, an empty text as long as nothing is wrong. Long texts are cut.",
)

EXTRA = Address(
    "/tongue/extra",
    (Argument("sequence number", "i"), Argument("frame number", "i"), Argument("time", "f", "s")),
    "first in every bundle of `send=`",
    "Which pose the rest of the bundle belongs to. The sequence number counts the poses of this stream from 0 and is "
    "the same in every datagram of one pose; the frame number is the source's own; the time is the device's, since "
    "this stream's first pose.",
)
COIL = Address(
    "/tongue/coil/<name>",
    (Argument("x", "f", "mm"), Argument("y", "f", "mm"), Argument("z", "f", "mm")),
    "`send=coils`",
    "Where the coil of this role is, in the model's frame, trusted or not. Left out while it is missing.",
)
SHAPE = Address(
    "/tongue/shape/<name>",
    (Argument("value", "f", limits=(0.0, 1.0)),),
    "`send=shapes`",
    "One of the named shapes, see shapes.md.",
)
UNIT = Address(
    "/tongue/unit",
    (Argument("weight", "f", "0 to 1", "K"),),
    "`send=unit`",
    "The coefficients re-based: (weight - low) / (high - low). Exact also outside 0..1, where a pose beyond the range "
    "lies; the shapes `pose_0`, `pose_1`, ... are the same numbers, cut to 0..1.",
)
LOW = Address(
    "/tongue/low",
    (Argument("weight", "f", "raw", "K"),),
    "`send=unit`: start, every second",
    "The raw coefficients that 0 stands for in `/tongue/unit`: mean - 3 spread, unless the session has other ranges.",
)
HIGH = Address(
    "/tongue/high",
    (Argument("weight", "f", "raw", "K"),),
    "`send=unit`: start, every second",
    "The raw coefficients that 1 stands for: mean + 3 spread, or the session's.",
)
CONTACT = Address(
    "/tongue/contact",
    (
        Argument("gap", "f", "mm"),
        Argument("x", "f", "mm"),
        Argument("y", "f", "mm"),
        Argument("z", "f", "mm"),
    ),
    "`send=contact`",
    "The smallest distance of tongue and palate in the mid-sagittal plane, below 0 where the tongue lies above the "
    "palate; the tongue's point there, in the model's frame. Needs a palate in the session. Left out where the palate "
    "reaches over no part of the tongue.",
)
GAP = Address(
    "/tongue/gap/<name>",
    (Argument("gap", "f", "mm"),),
    "`send=contact`",
    "The same for one region of the tongue's contour: tip, blade, front, body or back. Left out where the palate reaches "
    "over no part of it.",
)
MESH = Address(
    "/tongue/mesh",
    (
        Argument("sequence number", "i"),
        Argument("chunk", "i"),
        Argument("chunks", "i"),
        Argument("first vertex", "i"),
        Argument("step", "f", "mm"),
        Argument("coordinates", "b"),
    ),
    "`send=mesh`: alone in a datagram",
    "A part of the mesh: x, y, z of one vertex after the other as big-endian 16-bit integers; times step, they are mm in "
    f"the model's frame. The blob has at most {MAX_BLOB_BYTES} bytes. Each chunk can be used without the others.",
)

FRAME_ADDRESSES = (FRAME, POSE, SIGMA, POSE_SCALAR, SIGMA_SCALAR, QUALITY)
INFO_ADDRESSES = (INFO, COILS, SPEAKER, MEAN, SPREAD)
STATE_ADDRESSES = (LATENCY, COIL_STATES, TAKE)
ADDRESSES = FRAME_ADDRESSES + INFO_ADDRESSES + STATE_ADDRESSES
EXTRA_ADDRESSES = (EXTRA, COIL, SHAPE, UNIT, LOW, HIGH, CONTACT, GAP, MESH)


@dataclass(frozen=True)
class ControlForm:
    """One form of a message that a running session obeys. does: what happens then."""

    path: str
    arguments: tuple[Argument, ...]
    does: str

    @property
    def type_tags(self) -> str:
        return "," + "".join(argument.tag for argument in self.arguments)


_NAME = Argument("name", "s")
_ON = Argument("1 or 0", "i", limits=(0, 1))
_WORD = Argument("start or stop", "s")
_MARKER = Argument("text", "s")

CONTROL_TAKE = "/tongue/control/take"
CONTROL_MARKERS = ("/tongue/control/marker", "/marker")
CONTROL_SPEAKER = "/tongue/control/speaker"
CONTROL_FORMS = (
    ControlForm(CONTROL_TAKE, (_ON,), "1 starts a take, 0 ends it"),
    ControlForm(
        CONTROL_TAKE, (_ON, _NAME), "the same; the name is that of the take, letters, digits and ` _-.` only"
    ),
    ControlForm(CONTROL_TAKE, (_WORD,), "the same in words"),
    ControlForm(CONTROL_TAKE, (_WORD, _NAME), "the same in words"),
    *(ControlForm(path, (_MARKER,), "puts a marker into the take") for path in CONTROL_MARKERS),
    ControlForm(
        CONTROL_SPEAKER,
        (Argument("fix or free", "s"),),
        "fixes the speaker to the mean of what was found so far, or sets it free to be estimated anew",
    ),
)


def find_address(path: str) -> Address | None:
    """The row that a received path belongs to, None for a path of someone else's."""
    return next((address for address in ADDRESSES + EXTRA_ADDRESSES if address.matches(path)), None)


def address_table(rows: Iterable[Address]) -> str:
    """A table in Markdown."""
    lines = ["| address | types | arguments | sent | meaning |", "|---|---|---|---|---|"]
    for row in rows:
        arguments = ", ".join(map(str, row.arguments))
        lines.append(f"| `{row.path}` | `{row.type_tags}` | {arguments} | {row.when} | {row.meaning} |")
    return "\n".join(lines)


def control_table() -> str:
    """The messages that a session obeys, in Markdown."""
    lines = ["| address | types | arguments | what it does |", "|---|---|---|---|"]
    for form in CONTROL_FORMS:
        arguments = ", ".join(map(str, form.arguments))
        lines.append(f"| `{form.path}` | `{form.type_tags}` | {arguments} | {form.does} |")
    return "\n".join(lines)


def protocol_page() -> str:
    """The whole of docs/osc.md."""
    return f"""# The OSC stream

This page is made by `tonguetrack monitor --addresses > docs/osc.md`; change it in
`tracker/streams/addresses.py`.

`tonguetrack live`, `tonguetrack demo` and `tonguetrack track --osc HOST:PORT` send OSC 1.0 over UDP, by default
to 127.0.0.1:9000. What else can be sent, and to whom: [streams.md](streams.md); all protocols in detail:
[protocols.md](protocols.md).
Every frame is one bundle, every bundle one datagram of at most {MAX_DATAGRAM_BYTES} bytes. All time tags are
"immediately"; when a frame was captured is an argument. Nothing is expected back: a receiver that is absent,
late or slow changes nothing for the sender.

The stream carries coefficients, not a mesh. With the model that `/tongue/info` names, a tongue is

    vertices = base + pose[0] * direction[0] + ... + pose[K-1] * direction[K-1]

and in Python `load_model(path).for_speaker(speaker).vertices(pose)`, in mm. K is whatever the model has: take it
from the number of arguments. Ignore addresses that you do not know, and arguments beyond those listed; later
versions may add both. `tonguetrack monitor` shows what arrives, and names what it does not know.

{address_table(ADDRESSES)}

K: coefficients of the pose; m: weights of the speaker; n: coils; m and n may be 0. `<k>` counts from 0. The
one-value addresses are left out when a frame would not fit otherwise (K above 18).

| status | meaning |
|---|---|
| 0 | lost: no coil has arrived yet; the pose is the model's mean |
| 1 | ok |
| 2 | held: no coil in this frame; the pose is the previous one |
| 3 | relaxing: no coil for longer; the pose drifts back to the mean |

| coil state | meaning |
|---|---|
| 0 | trusted: it has its part in the pose |
| 1 | missing: the source has no position for it |
| 2 | wild: it moved faster than any tongue |
| 3 | misfit: it lies much farther from the model than it used to |
| 4 | stuck: it repeats one position while others move |
| 5 | returning: it behaves again, but not yet for long enough |

Coils in a state above 0 have no part in the pose. They come back by themselves.

No argument is ever NaN or infinite. The time is a 32-bit float: exact to 0.25 ms within the first hour, to
4 ms within the first day; the sequence number is exact and begins again at 0 after 2^31 frames.
A sequence number of 0 is the start of a stream.

## More, where asked for

A target with `send=` gets more than that, in datagrams of its own from a port of its own:
`--to 'osc://127.0.0.1:9000?send=coils,shapes,unit,contact,mesh'`, or as many of these words as wanted.
[streams.md](streams.md) shows how targets are written.

{address_table(EXTRA_ADDRESSES)}

A name in an address has letters, digits and `_.-` only; anything else in the name of a coil or shape becomes `_`.
Model frame: x to the speaker's left, y from front to back, z up.

## A receiver

In Python, with python-osc:

```python
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer

dispatcher = Dispatcher()
dispatcher.map("/tongue/pose", lambda address, *weights: print(weights))
BlockingOSCUDPServer(("127.0.0.1", 9000), dispatcher).serve_forever()
```

## Control

`tonguetrack live` also listens for OSC over UDP, at 127.0.0.1:{DEFAULT_CONTROL_PORT} unless told otherwise.

{control_table()}

Messages may come alone or in bundles, whose time tags are ignored, in datagrams of at most {MAX_DATAGRAM_BYTES} bytes.
Texts have at most {MAX_CONTROL_TEXT} printable characters. There is no answer. What is not in the table, has other arguments or is
not OSC is ignored; where one of these addresses is used otherwise, `tonguetrack live` says so on its terminal. Whether a
take runs is in `/tongue/take`.

It listens on this computer only. OSC knows no passwords: opened to a network, it lets anyone there start and
stop takes. Give it the address of one network interface of this computer only where you trust everyone in that
network, or let the firewall pass the one machine that is to control it, and never open it to the internet.
"""
