"""HTTP and WebSocket for the page. One thread; no page can hold up another, nor the server, nor the tracker."""

from __future__ import annotations

import asyncio
import errno
import logging
import secrets
import signal
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from importlib.resources import files
from typing import Any

import numpy as np
from websockets.asyncio.server import Server, ServerConnection
from websockets.asyncio.server import serve as serve_websockets
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from .... import InputError
from ...pose import TrackedPose
from ..feed import FeedReader
from ..osc import resolve
from .anatomy import Anatomy
from .protocol import (
    MAX_WISH_BYTES,
    WINDOW,
    Hello,
    NotUnderstood,
    Seen,
    Wish,
    from_page,
    model_text,
    over_text,
    pose_message,
    refused_text,
    state_text,
    told_text,
)
from .visitors import Door, door_at, page_headers, same_origin

RATE_HZ = 60.0
MAX_PAGES = 32
MAX_WAITING = 32
"""Connections that are no WebSocket yet; a further one pushes out the oldest."""
STALL_S = 10.0
"""A page that says nothing, or takes nothing, for so long is closed."""
MESSAGES_A_SECOND = 240
"""From a page that acknowledges every pose, and some more; beyond, it is closed."""
SETTLED_S = 0.5
"""A speaker that has stayed the same for so long gets a `model.glb`."""
OVERLAP_S = 1.0
"""So long vertices are still sent after a new `model.glb`: pages have to fetch it."""
STATE_PERIOD_S = 1.0
OVER_PERIOD_S = 0.25
FAREWELL_S = 0.1
"""So long the pages have to be told of the end."""
SEND_BUFFER_BYTES = 65536

_STATIC = {
    "": ("index.html", "text/html; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
    **{name: (name, "text/javascript; charset=utf-8") for name in
       ("page.js", "stream.js", "tongue.js", "solid.js", "section.js", "three.bundle.js")},
    "three.license.txt": ("three.license.txt", "text/plain; charset=utf-8"),
}  # fmt: skip
_MODEL, _SOCKET = "model.glb", "socket"


class Page:
    """One browser that looks on. What it is sent waits in one place for each kind; the newest wins."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.missed = 0
        self.heard_s = time.monotonic()
        self._texts: dict[str, str] = {}
        self._pose: tuple[int, bytes] | None = None
        self._on_the_way: deque[tuple[int, float]] = deque()
        self._round_trips_ms: deque[float] = deque(maxlen=WINDOW)
        self._sending_since_s: float | None = None
        self._wake = asyncio.Event()

    def say(self, kind: str, text: str) -> None:
        """Sends a text soon; one of the same kind that has not been sent is replaced."""
        self._texts[kind] = text
        self._wake.set()

    def show(self, number: int, message: bytes) -> None:
        """Sends a pose soon, unless a newer one comes first."""
        if self._pose is not None:
            self.missed += 1
        self._pose = number, message
        if self._may_send:
            self._wake.set()

    def has_seen(self, number: int) -> None:
        """The page has everything up to this message. That nothing new has arrived is no sign of life."""
        now_s = time.monotonic()
        if not self._on_the_way or number >= self._on_the_way[0][0]:
            self.heard_s = now_s
        while self._on_the_way and self._on_the_way[0][0] <= number:
            at, sent_s = self._on_the_way.popleft()
            if at == number:
                self._round_trips_ms.append((now_s - sent_s) * 1e3)
        self._wake.set()

    @property
    def round_trip_ms(self) -> float | None:
        """The shortest of the last ones."""
        return min(self._round_trips_ms, default=None)

    def stalled(self, now_s: float) -> bool:
        since = self._sending_since_s
        return now_s - self.heard_s > STALL_S or (since is not None and now_s - since > STALL_S)

    @property
    def _may_send(self) -> bool:
        return len(self._on_the_way) < WINDOW

    async def send_for_ever(self) -> None:
        """Ends by being cancelled, or when the connection is closed."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._texts:
                kind = next(iter(self._texts))
                await self._send(self._texts.pop(kind))
            if self._pose is not None and self._may_send:
                (number, message), self._pose = self._pose, None
                self._on_the_way.append((number, time.monotonic()))
                await self._send(message)

    async def _send(self, message: str | bytes) -> None:
        self._sending_since_s = time.monotonic()
        await self.connection.send(message)
        self._sending_since_s = None


class Waiting:
    """The connections that are no WebSocket yet. At most `MAX_WAITING`: whoever dawdles makes way for others."""

    def __init__(self) -> None:
        self._connections: dict[ServerConnection, asyncio.Transport] = {}

    def add(self, connection: ServerConnection, transport: asyncio.Transport) -> None:
        self._connections[connection] = transport
        if len(self._connections) > MAX_WAITING:
            oldest = next(iter(self._connections))
            self._connections.pop(oldest).abort()

    def end(self) -> None:
        """Waits for nobody any more."""
        while self._connections:
            self._connections.popitem()[1].abort()

    def remove(self, connection: ServerConnection) -> None:
        self._connections.pop(connection, None)


def counted(waiting: Waiting) -> type[ServerConnection]:
    """Connections that wait there from their first to their last moment, unless they are taken out before."""

    class Counted(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            assert isinstance(transport, asyncio.Transport)
            waiting.add(self, transport)

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            waiting.remove(self)

    return Counted


class PageServer:
    """Serves one feed at HOST:PORT until its run is over.

        asyncio.run(PageServer(feed, anatomy, "127.0.0.1:8080").run(print))

    Raises InputError where the address cannot be listened at.
    """

    def __init__(self, feed: FeedReader, anatomy: Anatomy, address: str) -> None:
        self._feed = feed
        self._anatomy = anatomy
        self._address = address
        self._door: Door = door_at(address)
        self._run_name = secrets.token_hex(8)
        self._pages: set[Page] = set()
        self._waiting = Waiting()
        self._static = _read_static()
        self._number = 0
        self._sequence = 0
        self._speaker: np.ndarray | None = None  # of the newest pose
        self._speaker_since_s = 0.0
        self._overlap_until_s = 0.0
        self._making: asyncio.Task[None] | None = None
        self._over = asyncio.Event()
        self._control: tuple[Any, ...] | None = None
        self._control_socket: socket.socket | None = None
        if feed.about.control:
            family, self._control = resolve(feed.about.control)
            self._control_socket = socket.socket(family, socket.SOCK_DGRAM)
            self._control_socket.setblocking(False)

    async def run(self, listening: Callable[[str], None]) -> None:
        """listening: called with the page's address once it can be opened."""
        # Whatever strangers send is none of the terminal's business.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL + 1)
        loop = asyncio.get_running_loop()
        for wanted in (signal.SIGTERM, signal.SIGINT):
            signal.signal(wanted, lambda *_: loop.call_soon_threadsafe(self._over.set))
        async with await self._listen() as server:
            listening(self._door.url(server.sockets[0].getsockname()[1]))
            beats = [asyncio.create_task(beat) for beat in (self._show(), self._tell(), self._watch())]
            await asyncio.wait(
                [asyncio.create_task(self._over.wait()), *beats], return_when=asyncio.FIRST_COMPLETED
            )
            for beat in beats:
                if beat.done():
                    beat.result()  # raises what ended it
                beat.cancel()
            for page in self._pages:
                page.say("over", over_text())
            await asyncio.sleep(FAREWELL_S)
            self._waiting.end()
        if self._control_socket is not None:
            self._control_socket.close()

    async def _listen(self) -> Server:
        try:
            return await serve_websockets(
                self._serve_page,
                self._door.place,
                self._door.port,
                process_request=self._answer,
                create_connection=counted(self._waiting),
                compression=None,
                max_size=MAX_WISH_BYTES,
                max_queue=4,
                ping_interval=None,
                open_timeout=STALL_S,
                close_timeout=1.0,
                server_header=None,
            )
        except OSError as reason:
            if reason.errno == errno.EADDRINUSE:
                why = "the port is in use by another program; end that one or give another --web"
            else:
                why = f"the page cannot be served there ({reason.strerror}); give another --web"
            raise InputError(f"{self._address}: {why}.") from reason

    # HTTP -------------------------------------------------------------------------------------------

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """None = a page's WebSocket may be opened."""
        try:
            host = request.headers.get("Host") or ""
            origin = request.headers.get("Origin")
        except LookupError:  # given twice
            return _plain(HTTPStatus.BAD_REQUEST)
        resource = self._door.resource(request.path)
        if resource is None or not self._door.knows_host(host):
            return _plain(HTTPStatus.FORBIDDEN)
        if getattr(request, "method", "GET") != "GET":
            return _plain(HTTPStatus.METHOD_NOT_ALLOWED)
        if resource == _SOCKET:
            if not same_origin(origin, host):
                return _plain(HTTPStatus.FORBIDDEN)
            if len(self._pages) >= MAX_PAGES:
                return _plain(HTTPStatus.SERVICE_UNAVAILABLE)
            return None
        if resource == _MODEL:
            return _response(HTTPStatus.OK, "model/gltf-binary", self._anatomy.glb)
        if resource in self._static:
            kind, body = self._static[resource]
            return _response(HTTPStatus.OK, kind, body)
        return _plain(HTTPStatus.NOT_FOUND)

    # WebSocket --------------------------------------------------------------------------------------

    async def _serve_page(self, connection: ServerConnection) -> None:
        self._waiting.remove(connection)
        if len(self._pages) >= MAX_PAGES:  # several came in at once
            await connection.close(1013)
            return
        connection.transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES
        )
        page = Page(connection)
        page.say("hello", self._hello().text())
        page.say("state", self._state(page))
        self._pages.add(page)
        self._sequence = 0  # whoever is new sees the newest pose at once
        sending = asyncio.create_task(page.send_for_ever())
        try:
            await self._listen_to(page)
        except ConnectionClosed:
            pass
        finally:
            self._pages.discard(page)
            sending.cancel()
            with suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    async def _listen_to(self, page: Page) -> None:
        """Ends when the page is gone, or is none of ours."""
        second, heard = 0, 0
        async for message in page.connection:
            now_s = time.monotonic()
            second, heard = (second, heard + 1) if int(now_s) == second else (int(now_s), 1)
            if heard > MESSAGES_A_SECOND or not isinstance(message, str):
                await page.connection.close(1008)
                return
            try:
                understood = from_page(message)
            except NotUnderstood as reason:
                page.say("refused", refused_text(str(reason)))
                continue
            if isinstance(understood, Seen):
                page.has_seen(understood.number)
            else:
                self._pass_on(understood, page)

    def _pass_on(self, wish: Wish, page: Page) -> None:
        if self._control_socket is None or self._control is None:
            page.say("refused", refused_text("this run takes no wishes"))
            return
        try:
            self._control_socket.sendto(wish.datagram, self._control)
        except OSError as reason:
            page.say("refused", refused_text(f"it could not be passed on ({reason.strerror})"))
        else:
            page.say("told", told_text(wish))

    # The beats --------------------------------------------------------------------------------------

    async def _show(self) -> None:
        """The newest pose to everybody, at a steady rate."""
        due_s = time.monotonic()
        while True:
            due_s = max(due_s + 1.0 / RATE_HZ, time.monotonic())
            await asyncio.sleep(due_s - time.monotonic())
            newest = self._feed.newest() if self._pages else None
            if newest is None or newest[0] == self._sequence:
                continue
            self._sequence, pose = newest
            if not pose.has_shape:
                continue
            self._number += 1
            message = pose_message(
                pose, self._number, self._sequence, self._anatomy.number, time.perf_counter_ns(), self._vertices(pose)
            )  # fmt: skip
            for page in self._pages:
                page.show(self._number, message)

    def _vertices(self, pose: TrackedPose) -> np.ndarray | None:
        """(V, 3) mm where `model.glb` is not this pose's speaker, or has become so only now."""
        now_s = time.monotonic()
        if self._speaker is None or not np.array_equal(self._speaker, pose.speaker_weights):
            self._speaker, self._speaker_since_s = pose.speaker_weights, now_s
        if not self._anatomy.fits(pose.speaker_weights):
            if self._making is None and now_s - self._speaker_since_s > SETTLED_S:
                self._making = asyncio.create_task(self._follow(pose.speaker_weights))
        elif self._making is None and now_s > self._overlap_until_s:
            return None
        return self._anatomy.vertices(pose.speaker_weights, pose.weights)

    async def _follow(self, speaker_weights: np.ndarray) -> None:
        await asyncio.to_thread(self._anatomy.follow, speaker_weights)
        self._overlap_until_s = time.monotonic() + OVERLAP_S
        for page in self._pages:
            page.say("model", model_text(self._anatomy.number))
        self._making = None

    async def _tell(self) -> None:
        """What the run says of itself, once a second."""
        while True:
            for page in self._pages:
                page.say("state", self._state(page))
            await asyncio.sleep(STATE_PERIOD_S)

    async def _watch(self) -> None:
        """Closes what has stalled; ends with the run."""
        while not self._feed.over:
            now_s = time.monotonic()
            for page in self._pages:
                if page.stalled(now_s):
                    page.connection.transport.abort()
            await asyncio.sleep(OVER_PERIOD_S)

    def _state(self, page: Page) -> str:
        return state_text(self._feed.numbers, len(self._pages), page.missed, page.round_trip_ms)

    def _hello(self) -> Hello:
        about, anatomy = self._feed.about, self._anatomy
        return Hello(
            run=self._run_name,
            title=about.title,
            model_name=anatomy.model.name,
            model_number=anatomy.number,
            vertex_count=anatomy.model.vertex_count,
            mean=anatomy.model.pose.mean,
            sigma=anatomy.model.pose.sigma,
            low=anatomy.rebased.low,
            high=anatomy.rebased.high,
            contour=anatomy.contour,
            palate=anatomy.palate,
            roles=about.roles,
            correspondences=about.correspondences,
            rate_hz=about.rate_hz,
            control=self._control is not None,
        )


def _read_static() -> dict[str, tuple[str, bytes]]:
    """The page's own files: path -> kind and content."""
    folder = files(__package__)
    return {path: (kind, (folder / name).read_bytes()) for path, (name, kind) in _STATIC.items()}


def _plain(status: HTTPStatus) -> Response:
    return _response(status, "text/plain; charset=utf-8", f"{status.phrase}\n".encode())


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = {**page_headers(kind, len(body)), "Connection": "close"}
    return Response(status.value, status.phrase, Headers(headers), body)
