"""The preference test as a page for browsers: what it shows, and where the choices go.

Plain HTTP, one request a connection. Everything that a page is told is the participant's own: "left" and "right",
never which method is which.

    GET   (nothing)                            the page; page.css, page.js
    GET   about                                {"participant": the only one, or null, "synthetic"}
    POST  begin    {"participant"}             {"participant", "partition", "choices": ["left", null, ...]}
    GET   item?participant=NAME&place=N        {"width_mm", "height_mm", "left": [[[x, y], ...], ...], "right": ...}
    GET   picture?participant=NAME&place=N     the plain slice, PNG
    POST  choose   {"participant", "place", "side"}      {"answered"}
"""

from __future__ import annotations

import errno
import json
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from importlib.resources import files
from socketserver import ThreadingTCPServer
from typing import Any
from urllib.parse import parse_qs

import numpy as np

from .. import InputError
from ..model.mri.preference import PreferenceTest, picture_bytes
from ..model.mri.preferenceanswers import (
    SIDES,
    Sitting,
    begun_sitting,
    choose,
    known_sitting,
    same_name,
)
from .streams.page.visitors import door_at, page_headers, same_origin

MAX_BODY_BYTES = 2048
MAX_CONNECTIONS = 32
"""At once; a further one pushes out the oldest, for an honest one takes some milliseconds."""
STALL_S = 10.0
LINGER_S, LINGER_READS = 1.0, 8
JSON, TEXT = "application/json", "text/plain; charset=utf-8"
PAGE_FILES = {
    "": ("index.html", "text/html; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
}


class NotServed(Exception):
    """A request that gets this status and sentence instead of what it asked for."""

    def __init__(self, status: HTTPStatus, sentence: str = "") -> None:
        super().__init__(sentence or status.phrase)
        self.status = status


class PreferenceServer(ThreadingTCPServer):
    """Serves one test at HOST:PORT.

        with PreferenceServer(test, "127.0.0.1:8080") as server:
            print(server.url)
            server.serve_forever()

    partition: the one that new participants get, None = one of those that fewest have. participant: the only one, who
    is not asked for a name. answered: called with participant, answers so far and slices after every choice. Raises
    InputError where the address cannot be listened at, and for a partition that is not there.
    """

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    request_queue_size = 64

    def __init__(
        self,
        test: PreferenceTest,
        address: str,
        partition: int | None = None,
        participant: str | None = None,
        answered: Callable[[str, int, int], None] = lambda *_: None,
    ) -> None:
        if partition is not None:
            test.partition(partition)
        self.test = test
        self.door = door_at(address)
        self.participant = participant
        self._partition = partition
        self._answered = answered
        self._random = np.random.default_rng()
        self._writing = threading.Lock()
        self._counting = threading.Lock()
        self._connections: dict[Any, None] = {}  # the oldest first
        folder = files(__package__) / "preferencepage"
        self.page = {path: (kind, (folder / name).read_bytes()) for path, (name, kind) in PAGE_FILES.items()}
        if participant is not None:
            self.begin(participant)
        self.address_family = socket.AF_INET6 if ":" in self.door.place else socket.AF_INET
        try:
            super().__init__((self.door.place, self.door.port), Visit)
        except OSError as reason:
            if reason.errno == errno.EADDRINUSE:
                why = "the port is in use by another program; end that one or give another --host"
            else:
                why = f"the page cannot be served there ({reason.strerror}); give another --host"
            raise InputError(f"{address}: {why}.") from reason

    @property
    def url(self) -> str:
        """What a participant opens."""
        return self.door.url(self.server_address[1])

    # What is asked for ------------------------------------------------------------------------------

    def about(self) -> dict[str, Any]:
        """Whom the page is for, and whether it shows people."""
        return {"participant": self.participant, "synthetic": self.test.synthetic}

    def begin(self, participant: str) -> dict[str, Any]:
        """Where the participant stopped, or the beginning. Raises InputError for what cannot be a name."""
        self._admit(participant)
        with self._writing:
            sitting = begun_sitting(self.test, participant, self._partition, self._random)
        choices = [
            shown.side(sitting.chosen[place]) if place in sitting.chosen else None
            for place, shown in enumerate(sitting.shown)
        ]
        return {"participant": sitting.participant, "partition": sitting.partition, "choices": choices}

    def item(self, participant: str, place: int) -> dict[str, Any]:
        """What to draw at a place of the participant's order."""
        shown = self._sitting(participant, place).shown[place]
        item = self.test.items[shown.item]
        lines = {side: [line.tolist() for line in getattr(item, shown.method(side))] for side in SIDES}
        return {"width_mm": item.width_mm, "height_mm": item.height_mm, **lines}

    def picture(self, participant: str, place: int) -> bytes:
        """The plain slice at a place of the participant's order."""
        return picture_bytes(self.test, self.test.items[self._sitting(participant, place).shown[place].item])

    def choose(self, participant: str, place: int, side: str) -> dict[str, Any]:
        """Keeps a choice; it is on the disk when this returns."""
        with self._writing:
            sitting = self._sitting(participant, place)
            now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
            sitting = choose(self.test, sitting, place, side, now)
        self._answered(sitting.participant, len(sitting.chosen), len(sitting.shown))
        return {"answered": len(sitting.chosen)}

    def _sitting(self, participant: str, place: int) -> Sitting:
        self._admit(participant)
        sitting = known_sitting(self.test, participant)
        if sitting is None or not 0 <= place < len(sitting.shown):
            raise NotServed(HTTPStatus.NOT_FOUND)
        return sitting

    def _admit(self, participant: str) -> None:
        if self.participant is not None and same_name(participant) != same_name(self.participant):
            raise NotServed(HTTPStatus.FORBIDDEN, f"This page is for {self.participant} alone.")

    # Connections ------------------------------------------------------------------------------------

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._counting:
            self._connections[request] = None
            oldest = next(iter(self._connections)) if len(self._connections) > MAX_CONNECTIONS else None
            if oldest is not None:
                del self._connections[oldest]
        if oldest is not None:
            with suppress(OSError):  # its thread finds it closed, and ends
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._counting:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Whoever hangs up or dawdles is none of the terminal's business; a fault of ours is."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class Visit(BaseHTTPRequestHandler):
    """One connection, one request."""

    server: PreferenceServer
    timeout = STALL_S
    server_version, sys_version = "tonguetrack", ""

    def do_GET(self) -> None:
        self._answer(self._got)

    def do_POST(self) -> None:
        self._answer(self._posted)

    def log_message(self, *_: Any) -> None:
        """What is asked for is nobody's business."""

    def _answer(self, work: Callable[[str], tuple[str, bytes]]) -> None:
        status = HTTPStatus.OK
        try:
            kind, body = work(self._resource())
        except NotServed as reason:
            status, kind, body = reason.status, TEXT, f"{reason}\n".encode()
        except InputError as reason:
            status, kind, body = HTTPStatus.CONFLICT, TEXT, f"{reason}\n".encode()
        self.send_response(status)
        for name, value in page_headers(kind, len(body)).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
        if status != HTTPStatus.OK:
            self._pass_over_the_rest()

    def _pass_over_the_rest(self) -> None:
        """A connection that is closed while something of the question is unread takes the answer with it."""
        with suppress(OSError):
            self.connection.settimeout(LINGER_S)
            self.connection.shutdown(socket.SHUT_WR)
            for _ in range(LINGER_READS):
                if not self.connection.recv(65536):
                    break

    def _resource(self) -> str:
        """What is asked for, by somebody who may. Raises NotServed for anybody else."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        if len(hosts) != 1 or len(origins) > 1:
            raise NotServed(HTTPStatus.BAD_REQUEST)
        door = self.server.door
        resource = door.resource(self.path)
        if resource is None or not door.knows_host(hosts[0]):
            raise NotServed(HTTPStatus.FORBIDDEN)
        if not same_origin(origins[0] if origins else None, hosts[0]):
            raise NotServed(HTTPStatus.FORBIDDEN)
        return resource

    def _got(self, resource: str) -> tuple[str, bytes]:
        if resource in self.server.page:
            return self.server.page[resource]
        if resource == "about":
            return _json(self.server.about())
        if resource == "item":
            return _json(self.server.item(*self._wanted()))
        if resource == "picture":
            return "image/png", self.server.picture(*self._wanted())
        raise NotServed(HTTPStatus.NOT_FOUND)

    def _wanted(self) -> tuple[str, int]:
        """Participant and place of the query."""
        try:
            query = parse_qs(self.path.partition("?")[2], max_num_fields=4)
        except ValueError as reason:
            raise NotServed(HTTPStatus.BAD_REQUEST) from reason
        participant, place = (query.get(name, [""])[0] for name in ("participant", "place"))
        if not (place.isascii() and place.isdigit() and len(place) < 6):
            raise NotServed(HTTPStatus.BAD_REQUEST)
        return participant, int(place)

    def _posted(self, resource: str) -> tuple[str, bytes]:
        if resource not in ("begin", "choose"):
            raise NotServed(HTTPStatus.NOT_FOUND)
        said = self._said()
        participant, place, side = (said.get(name) for name in ("participant", "place", "side"))
        if not isinstance(participant, str):
            raise NotServed(HTTPStatus.BAD_REQUEST)
        if resource == "begin":
            return _json(self.server.begin(participant))
        if type(place) is not int or side not in SIDES:
            raise NotServed(HTTPStatus.BAD_REQUEST)
        return _json(self.server.choose(participant, place, side))

    def _said(self) -> dict[str, Any]:
        """The body. That it has to be called JSON keeps forms of other pages out, which cannot say so."""
        if self.headers.get_content_type() != JSON:
            raise NotServed(HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise NotServed(HTTPStatus.LENGTH_REQUIRED)
        if len(length) > 6 or int(length) > MAX_BODY_BYTES:
            raise NotServed(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            said = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            said = None
        if not isinstance(said, dict):
            raise NotServed(HTTPStatus.BAD_REQUEST)
        return said


def _json(content: dict[str, Any]) -> tuple[str, bytes]:
    return JSON, json.dumps(content, ensure_ascii=False).encode()
