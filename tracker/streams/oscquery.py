"""OSCQuery: the tree of all OSC addresses, with their newest values, over HTTP.

Source: the OSCQuery proposal, third revision (https://github.com/Vidvox/OSCQueryProposal). A GET for an address gives the
node as JSON, with all nodes below it; `?ATTRIBUTE` only that one; `?HOST_INFO` who is asked and where OSC is taken.
ACCESS is 1 for what is sent (it can be read here), 2 for what a running session obeys, 0 for what is sent and not kept.
The model itself is at `/model.glb`: glTF, re-based to 0..1 (`model.rebasing`), for whoever draws it.

The values are decoded from the very datagrams that the OSC streams consist of, when somebody asks.
"""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any
from urllib.parse import unquote

import numpy as np

from ... import InputError
from ..pose import FloatArray, TrackedPose
from .addresses import (
    ADDRESSES,
    COIL,
    CONTACT,
    CONTROL_FORMS,
    EXTRA_ADDRESSES,
    GAP,
    NO_LATENCY,
    SHAPE,
    Address,
    Argument,
)
from .announcing import EVERYWHERE, OWN_NAME, Announcement
from .contact import REGIONS
from .hosts import is_loopback, names_this_computer
from .monitor import decode
from .osc import CoilStatesDatagram, FrameBundle, info_datagrams, numbers_datagram, parse_destination, resolve
from .osc_more import MoreDatagrams
from .packing import SEQUENCE_MASK
from .shapes import rebased_pose, shape_names
from .sink import LiveNumbers, StreamContext, StreamInfo

DEFAULT_ADDRESS = "127.0.0.1:9002"
MODEL_PATH = "/model.glb"
EXTENSIONS = ("ACCESS", "DESCRIPTION", "RANGE", "TYPE", "UNIT", "VALUE")
"""The attributes beyond those that every server has."""
ATTRIBUTES = ("FULL_PATH", "CONTENTS", *EXTENSIONS)
UNITS = {"mm": "distance.mm", "s": "time.second", "ms": "time.ms", "Hz": "time.hz"}
"""By the names of the proposal."""
NOT_KEPT, READ_ONLY, WRITE_ONLY = 0, 1, 2
MOST_CLIENTS = 8
CLIENT_S = 5.0
"""A client that is silent for longer is left."""
REST_S = 0.02
"""Between two requests: however many come, the tracker beside them keeps its computer."""
LONGEST_REQUEST_S = 10.0
GLB_PERIOD_S = 1.0
"""While the speaker is free, `/model.glb` is made anew at most this often."""

Node = dict[str, Any]


class AddressSpace:
    """Every address of a run and its newest value. Not for several threads at once."""

    def __init__(self, context: StreamContext, info: StreamInfo) -> None:
        self._more = _everything_but_the_mesh(context)
        self._more.begin(info)
        self._frame = FrameBundle(len(info.mean))
        self._states = CoilStatesDatagram(len(info.roles))
        self._values: dict[str, list[object]] = {}
        self._keep(info_datagrams(info))
        self._start_s: float | None = None
        sizes = {"K": len(info.mean), "m": len(info.speaker_weights), "n": len(info.roles), "": 1}
        names = {COIL: info.roles, SHAPE: shape_names(len(info.mean)), GAP: tuple(REGIONS)}
        self._nodes: dict[str, Node] = {}
        for row in (*ADDRESSES, *EXTRA_ADDRESSES):
            if row in names:
                paths = [row.named(name) for name in names[row]]
            else:
                paths = [row.at(k) for k in range(sizes["K"])] if "<k>" in row.path else [row.path]
            self._nodes |= {path: _sent_node(path, row, sizes) for path in paths}
        # What is missing in a pose has no value then.
        self._fleeting = [row.named(name) for row in (COIL, GAP) for name in names[row]] + [CONTACT.path]
        for path in dict.fromkeys(form.path for form in CONTROL_FORMS):
            self._nodes[path] = _control_node(path)

    def tree(self, pose: TrackedPose | None, sequence: int, numbers: LiveNumbers | None) -> Node:
        """The root node. pose: the newest, the `sequence`-th from 0, None before the first."""
        if pose is not None:
            self._take(pose, sequence)
        if numbers is not None:
            self._keep([numbers_datagram(numbers)])
        root: Node = {"FULL_PATH": "/", "ACCESS": NOT_KEPT, "DESCRIPTION": "tonguetrack", "CONTENTS": {}}
        for path, described in self._nodes.items():
            node = dict(described)
            if path in self._values:
                node["VALUE"] = self._values[path]
            elif node["ACCESS"] == READ_ONLY:
                node["ACCESS"] = NOT_KEPT
            _put(root, path, node)
        return root

    def _take(self, pose: TrackedPose, sequence: int) -> None:
        if self._start_s is None:
            self._start_s = pose.device_time_s
        self._frame.write(pose, sequence, pose.device_time_s - self._start_s, NO_LATENCY)
        self._keep([bytes(self._frame.datagram)])
        if len(pose.coil_states) == self._states.coils > 0:
            self._states.write(pose.coil_states)
            self._keep([bytes(self._states.datagram)])
        for path in self._fleeting:
            self._values.pop(path, None)
        self._keep(self._more.of(pose))

    def _keep(self, datagrams: Iterable[bytes]) -> None:
        for datagram in datagrams:
            for path, values in decode(datagram) or ():
                finite = [None if isinstance(v, float) and not math.isfinite(v) else v for v in values]
                self._values[path] = finite


def _everything_but_the_mesh(context: StreamContext) -> MoreDatagrams:
    """All that can be sent for this model and palate."""
    words = ["coils", "shapes", "unit"] + (["contact"] if context.palate is not None else [])
    try:
        return MoreDatagrams(context, words)
    except InputError:  # a model on which no shape can be measured
        return MoreDatagrams(context, ["coils"])


def find_node(root: Node, path: str) -> Node | None:
    """The node of an address, None where there is none."""
    node = root
    for part in path.strip("/").split("/") if path.strip("/") else ():
        found = node.get("CONTENTS", {}).get(part)
        if found is None:
            return None
        node = found
    return node


def _put(root: Node, path: str, node: Node) -> None:
    """Hangs a node into the tree, below containers that are made where they are missing."""
    *folders, leaf = path.strip("/").split("/")
    place = root
    for depth, folder in enumerate(folders):
        container = {"FULL_PATH": "/" + "/".join(folders[: depth + 1]), "ACCESS": NOT_KEPT}
        place = place.setdefault("CONTENTS", {}).setdefault(folder, container)
    contents = place.setdefault("CONTENTS", {})
    contents[leaf] = {
        **node,
        **{key: value for key, value in contents.get(leaf, {}).items() if key == "CONTENTS"},
    }


def _sent_node(path: str, row: Address, sizes: Mapping[str, int]) -> Node:
    arguments = [argument for argument in row.arguments for _ in range(sizes[argument.count])]
    return _node(path, f"{row.meaning} Sent: {row.when}.", arguments, READ_ONLY)


def _control_node(path: str) -> Node:
    """OSCQuery knows one form of an address: the first. The others are in the description."""
    forms = [form for form in CONTROL_FORMS if form.path == path]
    words = "; ".join(
        f"{form.type_tags} ({', '.join(map(str, form.arguments))}): {form.does}" for form in forms
    )
    return _node(path, words, list(forms[0].arguments), WRITE_ONLY)


def _node(path: str, description: str, arguments: list[Argument], access: int) -> Node:
    node: Node = {
        "FULL_PATH": path,
        "DESCRIPTION": description,
        "TYPE": "".join(argument.tag for argument in arguments),
        "ACCESS": access,
    }
    if any(argument.limits for argument in arguments):
        node["RANGE"] = [
            {"MIN": argument.limits[0], "MAX": argument.limits[1]} if argument.limits else None
            for argument in arguments
        ]
    if any(argument.unit in UNITS for argument in arguments):
        node["UNIT"] = [UNITS.get(argument.unit) for argument in arguments]
    return node


class OscQueryWorker:
    """Serves the tree from threads of its own; a worker, so that it always has the newest pose.

    address: HOST:PORT to listen at, port 0 = any; `address` then says which. numbers: what the run says of itself.
    said: is called when it cannot be announced. Raises InputError where it cannot listen there.
    Only GET and HEAD; a few clients at a time, fifty answers a second at most. Bound to this computer, it answers no
    page of a foreign site: their Host is another name.
    """

    def __init__(
        self,
        address: str,
        context: StreamContext,
        numbers: Callable[[], LiveNumbers] | None = None,
        said: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._context = context
        self._control = context.control
        self._numbers = numbers
        self._said = said
        self._server = _Server(address, self.answer)
        host, _ = parse_destination(address, lowest_port=0)
        self.address = f"[{host}]:{self._server.port}" if ":" in host else f"{host}:{self._server.port}"
        self.destination = f"oscquery http://{self.address}/"
        self._thread: threading.Thread | None = None
        self.announcement: Announcement | None = None
        self._asking = threading.Lock()
        self._space: AddressSpace | None = None
        self._info: StreamInfo | None = None
        self._newest: tuple[int, TrackedPose] | None = None
        self._tree: tuple[tuple[int, TrackedPose] | None, Node] | None = None
        self._glb: tuple[float, FloatArray, bytes] | None = None

    def begin(self, info: StreamInfo) -> None:
        space = AddressSpace(self._context, info)
        with self._asking:
            self._space, self._info, self._tree = space, info, None
        if self._thread is None:
            self._thread = threading.Thread(target=self._server.serve, name="OSCQuery", daemon=True)
            self._thread.start()
            control_port = parse_destination(self._control)[1] if self._control else 0
            self.announcement = Announcement(
                self._context.name, self._server.host, self._server.port, control_port, self._said
            )

    def work(self, pose: TrackedPose) -> None:
        number = -1 if self._newest is None else self._newest[0]
        self._newest = (number + 1) & SEQUENCE_MASK, pose.copy()

    def end(self) -> None:
        if self.announcement is not None:
            self.announcement.close()
        self._server.close()

    def answer(self, target: str, own_host: str) -> tuple[HTTPStatus, str, bytes]:
        """Status, content type and body for a GET of `target`. own_host: the address at which the client came."""
        path, _, query = target.partition("?")
        path = unquote(path.partition("#")[0])
        if query == "HOST_INFO":
            return _json(self._host_info(own_host))
        if path == MODEL_PATH:
            try:
                return HTTPStatus.OK, "model/gltf-binary", self._model()
            except InputError as reason:  # a model without faces
                return HTTPStatus.NOT_FOUND, "text/plain", str(reason).encode()
        if query and query not in ATTRIBUTES:
            return HTTPStatus.BAD_REQUEST, "text/plain", f"there is no attribute '{query[:40]}'".encode()
        with self._asking:
            node = find_node(self._newest_tree(), path)
            if node is None:
                return HTTPStatus.NOT_FOUND, "text/plain", b"there is no such address"
            if query and query not in node:
                return HTTPStatus.NO_CONTENT, "", b""
            return _json({query: node[query]} if query else node)

    def _newest_tree(self) -> Node:
        """Made once for every pose: however many ask, that is as often as poses come."""
        newest = self._newest
        if self._tree is None or self._tree[0] is not newest:
            assert self._space is not None, "begin() comes before any answer"
            number, pose = newest or (0, None)
            numbers = self._numbers() if self._numbers is not None else None
            self._tree = newest, self._space.tree(pose, number, numbers)
        return self._tree[1]

    def _host_info(self, own_host: str) -> Node:
        about: Node = {
            "NAME": self._context.name,
            "EXTENSIONS": dict.fromkeys(EXTENSIONS, True),
            "OSC_TRANSPORT": "UDP",
        }
        if self._control:
            host, port = parse_destination(self._control)
            about |= {"OSC_IP": own_host if host in EVERYWHERE else host, "OSC_PORT": port}
        return about

    def _model(self) -> bytes:
        """The model of the speaker who is shown as GLB."""
        from ..gltf import glb

        with self._asking:
            assert self._info is not None, "begin() comes before any answer"
            info, newest = self._info, self._newest
            weights, palate = info.speaker_weights, self._context.palate
            if self._context.shown_speaker is not None:
                weights, palate = self._context.shown_speaker, self._context.shown_palate
            elif newest is not None and newest[1].has_shape:
                weights = newest[1].speaker_weights
            now_s = time.monotonic()
            if self._glb is None or (
                now_s - self._glb[0] > GLB_PERIOD_S and not np.array_equal(weights, self._glb[1])
            ):
                model = self._context.model
                rebased = rebased_pose(model.pose, self._context.ranges)
                made = glb(model.for_speaker(weights), rebased, model.name, palate=palate)
                self._glb = now_s, weights.copy(), made
            return self._glb[2]


def _json(content: Node) -> tuple[HTTPStatus, str, bytes]:
    return HTTPStatus.OK, "application/json", json.dumps(content, allow_nan=False).encode()


class _Server(ThreadingHTTPServer):
    """The HTTP server: bounded in clients, in requests a second, and in how long one of them may take."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 16

    def __init__(self, address: str, answer: Callable[[str, str], tuple[HTTPStatus, str, bytes]]) -> None:
        self.address_family, place = resolve(address, lowest_port=0)
        self.answer = answer
        self._places = threading.Semaphore(MOST_CLIENTS)
        self._since_s: dict[socket.socket, float] = {}
        self._serving = False
        try:
            super().__init__(place, _Handler)  # type: ignore[arg-type]
        except OSError as reason:
            raise InputError(
                f"oscquery {address}: cannot listen there ({reason.strerror}); give another HOST:PORT, port 0 is any."
            ) from reason
        self.host, self.port = str(self.server_address[0]), int(self.server_address[1])
        self._named = parse_destination(address, lowest_port=0)[0]

    def knows_host(self, header: str) -> bool:
        """Whether it may be answered: always, unless only this computer is meant to ask."""
        return not is_loopback(self.host) or names_this_computer(header, self._named, OWN_NAME)

    def serve(self) -> None:
        self._serving = True
        self.serve_forever(poll_interval=0.1)

    def close(self) -> None:
        """Ends `serve`, if it runs, and frees the port."""
        if self._serving:
            self.shutdown()
        self.server_close()

    def server_bind(self) -> None:
        """As of any TCP server: the name of this host, which http.server looks up here, may take seconds."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        self._since_s[request] = time.monotonic()
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._since_s.pop(request, None)
            self._places.release()

    def service_actions(self) -> None:
        """Between two requests: leaves clients that take too long, and rests."""
        oldest_s = time.monotonic() - LONGEST_REQUEST_S
        for request, since_s in list(self._since_s.items()):
            if since_s < oldest_s:
                try:
                    request.shutdown(socket.SHUT_RDWR)
                except OSError:  # it is gone already
                    pass
        time.sleep(REST_S)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no news."""


class _Handler(BaseHTTPRequestHandler):
    """One request, one answer, and the connection is closed."""

    timeout = CLIENT_S
    server_version = "tonguetrack"
    sys_version = ""
    server: _Server

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, with_body: bool) -> None:
        if not self.server.knows_host(self.headers.get("Host", "localhost")):
            status, kind, body = HTTPStatus.FORBIDDEN, "text/plain", b"this computer is not called that"
        else:
            status, kind, body = self.server.answer(self.path, str(self.connection.getsockname()[0]))
        self.send_response(status)
        if kind:
            self.send_header("Content-Type", kind)
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(body)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if with_body:
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: what is asked is nobody's business."""
