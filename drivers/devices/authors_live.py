"""The live protocol of the model's authors (ema-tracker), of which we are the server: their clients drive us.

UDP, one JSON map a datagram, at most 8192 bytes:

    {"id": "SET_MODEL_INDICES", "indices": [...]}                vertices of the points, in any order
    {"id": "SET_SETTINGS", "speakerSmoothnessTerm": b, "phonemeSmoothnessTerm": g, "priorSize": h}
    {"id": "FIT", "timeStamp": t, "points": [x1, y1, z1, ...]}   mm in the model frame, ascending vertices
    {"id": "FIX_SPEAKER"}                                        from now on the mean of all speaker estimates
    {"id": "RESET"}                                              forgets them

Only FIT is answered, to a fixed HOST:PORT, by `tracker.streams.authors`. A FIT becomes a frame, everything
else a COMMAND note:

| command | values |
|---|---|
| `set_vertices` | the vertices, ascending |
| `set_settings` | speakerSmoothnessTerm, phonemeSmoothnessTerm, priorSize; NaN = not in the request |
| `fix_speaker`, `reset` | none |

Where theirs ends for good at a malformed datagram, ours tells of it and serves the next.
"""

from __future__ import annotations

import json
import math
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

import numpy as np

from ... import InputError
from ..frames import CoilFrame, FloatArray, FrameOfReference, NoteKind, SourceNote
from ..sources import SourceAddress
from .source import TICK_S

LARGEST_DATAGRAM = 8192
LARGEST_VERTEX = 10_000_000
DEFAULT_REPLY = "127.0.0.1:1235"
MOST_WAITING = 4096
"""So many datagrams are kept for a slow reader; what comes on top waits in the system's own buffer."""
RECEIVE_BUFFER_BYTES = 1 << 22
_COUNT_LOST = 40 if sys.platform == "linux" else None
"""SO_RXQ_OVFL of <asm-generic/socket.h>: each datagram says how many the system had no room for before it."""
MODEL_FRAME = FrameOfReference("left", "back", "up", "model")
SETTINGS = ("speakerSmoothnessTerm", "phonemeSmoothnessTerm", "priorSize")


class BadRequest(ValueError):
    """A datagram that is no request of this protocol; the message says why."""


@dataclass(frozen=True)
class SetVertices:
    """vertices: ascending."""

    vertices: tuple[int, ...]


@dataclass(frozen=True)
class SetSettings:
    """values: in the order of `SETTINGS`, NaN = absent."""

    values: tuple[float, ...]


@dataclass(frozen=True)
class Fit:
    """points: (n, 3) mm, in ascending order of their vertices, NaN = missing."""

    time_s: float
    points: FloatArray


@dataclass(frozen=True)
class FixSpeaker:
    pass


@dataclass(frozen=True)
class Reset:
    pass


Request = SetVertices | SetSettings | Fit | FixSpeaker | Reset


def parse_request(datagram: bytes) -> Request:
    """One datagram. Raises BadRequest for everything that is not exactly a request; unknown keys are ignored.

    A point with a coordinate that is null or NaN is missing. Infinity is never accepted, and NaN nowhere else.
    """
    if len(datagram) > LARGEST_DATAGRAM:
        raise BadRequest(f"a datagram of more than {LARGEST_DATAGRAM} bytes")
    try:
        content = json.loads(datagram)
    except (ValueError, RecursionError) as reason:
        raise BadRequest("a datagram that is not JSON") from reason
    if not isinstance(content, dict):
        raise BadRequest("a datagram that is not a JSON map")
    match content.get("id"):
        case "FIT":
            return Fit(_number(content, "timeStamp"), _points(content.get("points")))
        case "SET_MODEL_INDICES":
            return SetVertices(_vertices(content.get("indices")))
        case "SET_SETTINGS":
            values = tuple(
                _number(content, name, low=0.0) if name in content else math.nan for name in SETTINGS
            )
            return SetSettings(values)
        case "FIX_SPEAKER":
            return FixSpeaker()
        case "RESET":
            return Reset()
        case None:
            raise BadRequest("a request without an id")
        case str(other):
            raise BadRequest(f"a request with the unknown id {other[:40]!a}")
        case _:
            raise BadRequest("a request with an id that is not text")


def _number(content: dict[str, Any], name: str, low: float = -math.inf) -> float:
    value = _finite(content.get(name))
    if value is None or value < low:
        least = f" of at least {low:g}" if math.isfinite(low) else ""
        raise BadRequest(f"{content['id']} with a {name} that is not a number{least}")
    return value


def _finite(value: object) -> float | None:
    """The number itself; None where it is none, or not finite."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _points(value: object) -> FloatArray:
    if not isinstance(value, list) or not value or len(value) % 3:
        raise BadRequest("FIT with points that are not a list of 3 numbers for each")
    numbers = []
    for item in value:
        missing = item is None or (isinstance(item, float) and math.isnan(item))
        number = math.nan if missing else _finite(item)
        if number is None:
            raise BadRequest("FIT with a coordinate that is neither a number nor null")
        numbers.append(number)
    points = np.array(numbers).reshape(-1, 3)
    points[np.isnan(points).any(axis=1)] = np.nan
    return points


def _vertices(value: object) -> tuple[int, ...]:
    if not isinstance(value, list) or not value:
        raise BadRequest("SET_MODEL_INDICES with indices that are not a list of numbers")
    for item in value:
        if isinstance(item, bool) or not isinstance(item, int) or not 0 <= item <= LARGEST_VERTEX:
            raise BadRequest("SET_MODEL_INDICES with an index that is not a whole number from 0")
    if len(set(value)) != len(value):
        raise BadRequest("SET_MODEL_INDICES with an index that occurs twice")
    return tuple(sorted(value))


class AuthorsLive:
    """Their clients as a source. Every FIT that arrives is delivered, in order; none is overwritten, and where
    the system had no room for one, a GAP note says so (on Linux, which alone counts them).

        source = open_authors_live(address)
        if source.wait_until_ready(tick): ...   # then `coils` and `vertices` are known
        for item in source: ...

    vertices, coils: change with each `set_vertices` note, from that note on. reply: HOST:PORT for the
    answers. rate_hz: as the user states, else 0.0. frame_number counts the FITs; device_time_s is their
    `timeStamp`, and a CLOCK_RESET note tells when it goes back.
    """

    def __init__(
        self, bound: socket.socket, reply: str, vertices: tuple[int, ...] = (), rate_hz: float = 0.0
    ) -> None:
        host, port = bound.getsockname()[:2]
        self.address = f"udp-json://[{host}]:{port}" if ":" in host else f"udp-json://{host}:{port}"
        self.reply = reply
        self.rate_hz = rate_hz
        self.frame = MODEL_FRAME
        self._socket = bound
        self._vertices = vertices
        self._stopped = False
        self._waiting: deque[tuple[bytes, int, int]] = deque()  # datagram, arrival, lost by the system so far
        self._lost = 0
        self._said: deque[CoilFrame | SourceNote] = deque(maxlen=MOST_WAITING)  # comes before what waits
        self._fits = 0
        self._last_time_s = -math.inf
        bound.setblocking(False)

    @property
    def ready(self) -> bool:
        """Whether a client has said, or the address, which vertices the points are."""
        return bool(self._vertices)

    @property
    def vertices(self) -> tuple[int, ...]:
        """Of the points, ascending. Raises InputError until they are known."""
        if not self._vertices:
            raise InputError(
                f"{self.address}: no client has sent SET_MODEL_INDICES yet; start the client, or state "
                "the vertices with ?indices=..."
            )
        return self._vertices

    @property
    def coils(self) -> tuple[str, ...]:
        """ "point 1", "point 2", ... in ascending order of the vertices. Raises InputError until they are known."""
        return tuple(f"point {k + 1}" for k in range(len(self.vertices)))

    def wait_until_ready(
        self, tick: Callable[[], None] | None = None, timeout_s: float | None = None
    ) -> bool:
        """Waits for SET_MODEL_INDICES. False when `stop` was called or `timeout_s` passed before it came.

        tick: called every 0.1 s or oftener. What else arrives meanwhile is kept, and told by the iteration;
        the request that was waited for is not.
        """
        end_s = math.inf if timeout_s is None else time.perf_counter() + timeout_s
        while not self.ready and not self._stopped and (left_s := end_s - time.perf_counter()) > 0:
            if tick is not None:
                tick()
            item = self._next_item(min(TICK_S, left_s))
            if isinstance(item, SourceNote) and not self.ready:
                self._keep(item)
        return self.ready and not self._stopped

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> CoilFrame | SourceNote:
        if self._stopped:
            raise StopIteration
        if self._said:
            return self._said.popleft()
        item = self._next_item(TICK_S)
        if self._stopped:
            raise StopIteration
        return item or self._note(NoteKind.SILENT, "no request came", time.perf_counter_ns())

    def stop(self) -> None:
        """Ends the iteration, or the waiting, within a tick. May be called from a signal handler."""
        self._stopped = True

    def close(self) -> None:
        self._stopped = True
        self._socket.close()

    def _keep(self, note: SourceNote) -> None:
        """For the iteration; a client that sends FITs in vain makes one note of them all."""
        last = self._said[-1] if self._said else None
        if isinstance(last, SourceNote) and (last.kind, last.text) == (NoteKind.BAD_DATA, note.text):
            self._said[-1] = replace(last, count=last.count + 1)
        else:
            self._said.append(note)

    def _next_item(self, timeout_s: float) -> CoilFrame | SourceNote | None:
        """What the next datagram says; None when none came in time."""
        if not self._waiting:
            try:
                select.select([self._socket], [], [], timeout_s)
            except (OSError, ValueError):  # closed meanwhile
                self._stopped = True
                return None
        self._drain()
        if not self._waiting:
            return None
        datagram, arrival_ns, lost = self._waiting[0]
        if lost > self._lost:
            count, self._lost = lost - self._lost, lost
            text = f"{count} requests were lost: they came faster than they were read"
            return self._note(NoteKind.GAP, text, arrival_ns, count)
        self._waiting.popleft()
        try:
            return self._obeyed(parse_request(datagram), arrival_ns)
        except BadRequest as reason:
            return self._note(NoteKind.BAD_DATA, f"left out: {reason}", arrival_ns, 1)

    def _drain(self) -> None:
        """Takes what has arrived out of the system's buffer, whose size nobody can rely on."""
        lost = self._lost
        try:
            while len(self._waiting) < MOST_WAITING:
                if _COUNT_LOST is None:
                    datagram = self._socket.recv(LARGEST_DATAGRAM + 1)
                else:
                    datagram, extra, _, _ = self._socket.recvmsg(LARGEST_DATAGRAM + 1, socket.CMSG_SPACE(4))
                    lost = next((int.from_bytes(data, sys.byteorder) for _, kind, data in extra), lost)
                self._waiting.append((datagram, time.perf_counter_ns(), lost))
        except OSError:  # nothing more; or an earlier answer was refused, which is not our business here
            pass

    def _obeyed(self, request: Request, arrival_ns: int) -> CoilFrame | SourceNote:
        match request:
            case Fit():
                return self._fit(request, arrival_ns)
            case SetVertices(vertices):
                self._vertices = vertices
                text = f"the points are the vertices {', '.join(map(str, vertices))}"
                return self._command("set_vertices", text, arrival_ns, tuple(map(float, vertices)))
            case SetSettings(values):
                given = [f"{n} {v:g}" for n, v in zip(SETTINGS, values, strict=True) if not math.isnan(v)]
                return self._command("set_settings", f"settings: {', '.join(given)}", arrival_ns, values)
            case FixSpeaker():
                return self._command("fix_speaker", "the speaker is to be fixed", arrival_ns)
            case Reset():
                return self._command("reset", "begin anew", arrival_ns)

    def _fit(self, fit: Fit, arrival_ns: int) -> CoilFrame | SourceNote:
        if not self._vertices:
            raise BadRequest("FIT before SET_MODEL_INDICES")
        if len(fit.points) != len(self._vertices):
            raise BadRequest(f"FIT with {len(fit.points)} points for {len(self._vertices)} vertices")
        self._fits += 1
        frame = CoilFrame(fit.points, fit.time_s, self._fits, arrival_ns)
        back, self._last_time_s = fit.time_s < self._last_time_s, fit.time_s
        if not back:
            return frame
        self._said.appendleft(frame)
        return self._note(NoteKind.CLOCK_RESET, "the client's time stamps went back", arrival_ns)

    def _command(
        self, command: str, text: str, arrival_ns: int, values: tuple[float, ...] = ()
    ) -> SourceNote:
        return SourceNote(NoteKind.COMMAND, text, arrival_ns, command=command, values=values)

    def _note(self, kind: NoteKind, text: str, arrival_ns: int, count: int = 0) -> SourceNote:
        return SourceNote(kind, text, arrival_ns, count)


def open_authors_live(address: SourceAddress) -> AuthorsLive:
    """`udp-json://[HOST][:1234]?reply=HOST:PORT&indices=...`: listens, on this machine alone unless HOST says else.

    Raises InputError where the port is taken or an option makes no sense. Does not wait for a client.
    """
    vertices: tuple[int, ...] = ()
    if text := address.option("indices"):
        words = text.split(",")
        try:
            if not all(word.strip().isdecimal() and word.isascii() for word in words):
                raise BadRequest("no numbers")
            vertices = _vertices([int(word) for word in words])
        except ValueError as reason:
            raise InputError(
                f"'{address.text}': indices={text}: expected vertices, each once, as in 885,1912,2469."
            ) from reason
    rate_hz = address.number("rate", 0.0, 1.0, 20_000.0)
    host = address.host or "127.0.0.1"
    try:
        family = socket.getaddrinfo(host, address.port, type=socket.SOCK_DGRAM)[0][0]
        bound = socket.socket(family, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as reason:
        raise InputError(f"'{address.text}': '{host}' is not a host that is known here.") from reason
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if _COUNT_LOST is not None:
            bound.setsockopt(socket.SOL_SOCKET, _COUNT_LOST, 1)
        bound.bind((host, address.port))
    except OSError as reason:
        bound.close()
        raise InputError(
            f"'{address.text}': the port {address.port} on {host} cannot be listened on "
            f"({reason.strerror}); end the other program, or choose another port."
        ) from reason
    return AuthorsLive(bound, address.option("reply", DEFAULT_REPLY), vertices, rate_hz)
