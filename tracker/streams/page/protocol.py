"""What the page and its server say to each other, as bytes and text. docs/page.md describes it for others.

Server to page, text: JSON objects with "type": "hello" once, "state" every second, "model" when there is another
`model.glb`, "told" after a wish was passed on, "refused" when it was not, "over" at the end of the run.

Server to page, binary: one pose, little-endian (`PoseMessages`):

    0   magic "TTPG"; uint8 version, pose status (`PoseStatus`), flags, 0
    8   uint16 K coefficients, n coils; uint32 number of this message, sequence of the pose in its run, number of the
        model, vertices in this message (0, or all)
    28  float32 mm of one step of the vertices
    32  float64 device time, time of solving on the server's clock (s)
    48  float32 arrival to solved, arrival to sending (ms), residual (mm, NaN = none), 0
    64  float32 weights (K, raw), coils (n, 3, mm, model frame, NaN = missing), residuals (n, mm, NaN = missing);
        uint8 coil states (n), then zeros to a multiple of 4; int16 vertices (V, 3, in steps, model frame)

Flag 1: the speaker is fixed. Vertices come while the speaker is another one than the model's in `model.glb`; where
there are some, they are the tongue, else the weights and `model.glb` are.

Page to server, text of at most `MAX_WISH_BYTES`: {"seen": number} of the last pose message, at least every
`SEEN_EVERY` messages, for the server does not run further ahead than `WINDOW`; and the wishes of `wish_of`.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...control import Control, ControlKind
from ...pose import FloatArray, TrackedPose
from ..addresses import MAX_CONTROL_TEXT
from ..control_osc import control_message
from ..feed import FeedNumbers
from ..sink import Pair

NAME, VERSION = "tonguetrack page", 1
MAGIC = b"TTPG"
MAX_WISH_BYTES = 1024
WINDOW = 60
"""So many pose messages may be on their way to a page: one second's."""
SEEN_EVERY = 15
FLAG_FIXED = 1
_HEAD = struct.Struct("<4s4B2H4If2d4f")
_NUMBER_MASK = 0xFFFF_FFFF
_STEPS = 32767


def pose_message(
    pose: TrackedPose,
    number: int,
    sequence: int,
    model_number: int,
    now_ns: int,
    vertices: FloatArray | None = None,
) -> bytes:
    """One pose for all pages. now_ns: `time.perf_counter_ns()` at sending; vertices: (V, 3) mm or None."""
    k, n = len(pose.weights), len(pose.residuals_mm)
    step = 0.0
    mesh = b""
    if vertices is not None:
        step = max(float(np.abs(vertices).max()), 1.0) / _STEPS
        mesh = np.rint(vertices / step).astype("<i2").tobytes()
    head = _HEAD.pack(
        MAGIC, VERSION, pose.status, FLAG_FIXED if pose.speaker_fixed else 0, 0,
        k, n, number & _NUMBER_MASK, sequence & _NUMBER_MASK, model_number & _NUMBER_MASK,
        0 if vertices is None else len(vertices), step,
        pose.device_time_s, pose.solved_ns * 1e-9,
        (pose.solved_ns - pose.arrival_ns) * 1e-6, (now_ns - pose.arrival_ns) * 1e-6, pose.residual_mm, 0.0,
    )  # fmt: skip
    floats = np.concatenate([pose.weights, pose.coils.ravel(), pose.residuals_mm]).astype("<f4")
    states = pose.coil_states.astype(np.uint8).tobytes()
    return b"".join((head, floats.tobytes(), states, bytes(-len(states) % 4), mesh))


@dataclass(frozen=True)
class Hello:
    """What a page must know before the first pose.

    run: names this run, so that a page that has reconnected knows whether it is another one; model_number: of
    `model.glb`; mean, sigma, low, high: (K,) of the raw weights; low and high are 0 and 1 in `model.glb`; contour:
    vertices of the mid-sagittal line, tip to root; palate: (p, 3) mm in the model frame, or None; correspondences: the
    coils' vertices; control: whether wishes are passed on.
    """

    run: str
    title: str
    model_name: str
    model_number: int
    vertex_count: int
    mean: FloatArray
    sigma: FloatArray
    low: FloatArray
    high: FloatArray
    contour: tuple[int, ...]
    palate: FloatArray | None
    roles: tuple[str, ...]
    correspondences: tuple[int, ...]
    rate_hz: float
    control: bool

    def text(self) -> str:
        return _text(
            "hello",
            protocol=NAME,
            version=VERSION,
            seen_every=SEEN_EVERY,
            run=self.run,
            title=self.title,
            model={"name": self.model_name, "number": self.model_number, "vertices": self.vertex_count},
            coefficients={name: getattr(self, name).tolist() for name in ("mean", "sigma", "low", "high")},
            contour=list(self.contour),
            palate=None if self.palate is None else self.palate.tolist(),
            coils=[
                {"role": role, "vertex": vertex}
                for role, vertex in zip(self.roles, self.correspondences, strict=True)
            ],
            rate_hz=_number(self.rate_hz),
            control=self.control,
        )


def state_text(numbers: FeedNumbers, pages: int, missed: int, round_trip_ms: float | None) -> str:
    """What the run says of itself, and how this page is served. Of the take only the name of its file is told."""
    live = numbers.live
    return _text(
        "state",
        latency={
            "device_to_host": _pair(live.device_to_host_ms),
            "host_to_solved": _pair(live.host_to_solved_ms),
            "solved_to_sent": _pair(live.solved_to_sent_ms),
        },
        take={
            "name": live.take_path.replace("\\", "/").rpartition("/")[2],
            "frames": live.take_frames,
            "failure": live.take_failure,
        },
        troubles=list(numbers.troubles),
        text=numbers.text,
        pages=pages,
        missed=missed,
        round_trip_ms=None if round_trip_ms is None else _number(round_trip_ms),
    )


def model_text(number: int) -> str:
    """There is another `model.glb`."""
    return _text("model", number=number)


def told_text(wish: Wish) -> str:
    return _text("told", what=wish.what)


def refused_text(why: str) -> str:
    return _text("refused", why=why)


def over_text() -> str:
    return _text("over")


# From the page --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Seen:
    """The page has this pose message."""

    number: int


@dataclass(frozen=True)
class Wish:
    """What a user wants of the run. what: "take", "mark" or "speaker"; datagram: the OSC message that says so."""

    what: str
    datagram: bytes


class NotUnderstood(Exception):
    """A page sent what no page of ours sends."""


def from_page(text: str) -> Seen | Wish:
    """What a page said.

        {"seen": 17}                                     the last pose message that it has
        {"do": "take", "on": true, "name": "aka 3"}      starts a take, with or without a name, or ends it
        {"do": "mark", "text": "here"}                   puts a marker into the take
        {"do": "speaker", "fix": true}                   fixes the speaker, or sets it free

    Raises NotUnderstood where it is anything else, has other keys, or a text that the run would not take.
    """
    if len(text.encode("utf-8", "replace")) > MAX_WISH_BYTES:
        raise NotUnderstood("too long")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as reason:
        raise NotUnderstood("no JSON") from reason
    match content:
        case {"seen": int(number), **rest} if (
            not rest and type(number) is int and 0 <= number <= _NUMBER_MASK
        ):
            return Seen(number)
        case {"do": "take", "on": bool(on), **rest} if set(rest) <= {"name"}:
            match rest.get("name", ""):
                case str(name):
                    return _wish("take", "take_start", name) if on else _wish("take", "take_stop")
        case {"do": "mark", "text": str(mark), **rest} if not rest:
            return _wish("mark", "mark", mark)
        case {"do": "speaker", "fix": bool(fix), **rest} if not rest:
            return _wish("speaker", "fix_speaker" if fix else "free_speaker")
    raise NotUnderstood("not a message of the page")


def _wish(what: str, kind: ControlKind, text: str = "") -> Wish:
    try:
        return Wish(what, control_message(Control(kind, text)))
    except ValueError as reason:
        raise NotUnderstood(
            f"a {what} takes at most {MAX_CONTROL_TEXT} printable characters, and a take's name letters, digits, "
            "spaces and _-. only"
        ) from reason


def _text(kind: str, **content: Any) -> str:
    return json.dumps({"type": kind, **content}, allow_nan=False)


def _pair(pair: Pair) -> list[float | None]:
    return [None if value is None else _number(value) for value in pair]


def _number(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
