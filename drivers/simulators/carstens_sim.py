"""cs5recorder of a Carstens AG500 or AG501 that is not there: text commands, and a block for every `data`."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ... import InputError
from ..devices.carstens_live import LAYOUTS, Block, Layout, build_block, layout_named
from .faults import FaultPlan, Misbehaviour
from .motion import DeviceClock, SimulatedMotion

LONGEST_COMMAND = 256
LIVE_RMS = 2.0
SEND_TIMEOUT_S = 2.0
_TICK_S = 0.02


@dataclass
class _Client:
    """One connection. started_s: when it first asked for data, from which its faults are timed."""

    connection: socket.socket
    misbehaviour: Misbehaviour
    buffer: bytearray = field(default_factory=bytearray)
    started_s: float | None = None
    newest: int = 0
    waiting: deque[bytes] = field(default_factory=lambda: deque(maxlen=4))
    last: bytes = b""

    @property
    def time_s(self) -> float:
        return 0.0 if self.started_s is None else time.perf_counter() - self.started_s


class _Recorder:
    """The device: what it measures, and whether it records."""

    def __init__(self, motion: SimulatedMotion, layout: Layout) -> None:
        self.motion = motion
        self.layout = layout
        self.clock = DeviceClock(motion.rate_hz)
        self.recording = False
        self.prepared = False
        self.sweep = 0

    def block(self, counter: int, positions: np.ndarray, quaternions: np.ndarray) -> bytes:
        rms = np.where(np.isnan(positions[:, 0]), np.nan, LIVE_RMS)
        block = Block(counter, self.recording, self.sweep, positions, quaternions, rms)
        return build_block(block, self.layout)

    def toggle(self, on: bool) -> None:
        self.sweep += on and not self.recording
        self.recording = on
        self.prepared = False

    def answer(self, command: str) -> str | None:
        """The text for a command; None = it is none. `data` and `exit` are not among them."""
        if command == "sprepare":
            self.prepared = not self.recording
            return f"200 Ok\n{'rsPrepared' if self.prepared else 'rsOff'}\n.\n"
        if command == "sstart":
            if not self.prepared:
                return "503 Not prepared\n"
            self.toggle(True)
            return "200 Ok\n"
        if command == "sstop":
            if not self.recording:
                return "503 Not recording\n"
            self.toggle(False)
            return "200 Ok\n"
        if command == "simplestart":
            self.toggle(not self.recording)
            return "200 Ok\n"
        return None


def run_carstens(
    motion: SimulatedMotion,
    plan: FaultPlan,
    *,
    host: str,
    port: int,
    announce: Callable[[str], None],
    layout: str = "ag501",
    seconds: float | None = None,
) -> None:
    """Serves until `seconds` have passed, or for ever. announce: is told the address as a source's URI.

    Strict: commands are lower-case words ended by LF, everything else is answered with 5xx. The first block
    of each connection is nothing but zeros, as that of real devices often is. Dropped samples leave the
    counter behind, which then skips; doubled ones repeat it; while stalled, requests are not answered.
    The device measures all the time, whether it is asked or not. Faults are timed from a connection's first
    `data`. Raises InputError where the layout is unknown or too small, or the port is taken.
    """
    row = layout_named(layout)
    if row is None:
        names = ", ".join(known.name for known in LAYOUTS)
        raise InputError(f"the layout '{layout}' is unknown; cs5recorder's are {names}.")
    if len(motion.coils) > row.channels:
        raise InputError(
            f"{len(motion.coils)} coils do not fit into the {row.channels} channels of {layout}; choose another."
        )
    recorder = _Recorder(motion, row)
    clients: dict[socket.socket, _Client] = {}
    end_s = time.perf_counter() + (float("inf") if seconds is None else seconds)
    with _listening(host, port) as listener:
        place = listener.getsockname()[:2]
        shown = f"[{place[0]}]" if ":" in place[0] else place[0]
        announce(f"carstens://{shown}:{place[1]}?layout={layout}")
        try:
            while time.perf_counter() < end_s:
                ready, _, _ = select.select([listener, *clients], [], [], _TICK_S)
                if listener in ready:
                    _welcome(listener, clients, plan)
                for client in list(clients.values()):
                    served = client.connection not in ready or _serve(client, recorder)
                    if not served or client.misbehaviour.cut(client.time_s):
                        clients.pop(client.connection).connection.close()
        finally:
            for connection in clients:
                connection.close()


def _listening(host: str, port: int) -> socket.socket:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except (OSError, UnicodeError, OverflowError) as reason:
        raise InputError(
            f"{host}:{port} cannot be listened on ({getattr(reason, 'strerror', None) or reason}); choose another port."
        ) from reason


def _welcome(listener: socket.socket, clients: dict[socket.socket, _Client], plan: FaultPlan) -> None:
    connection, _ = listener.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.settimeout(SEND_TIMEOUT_S)
    client = _Client(connection, Misbehaviour(plan))
    if _sent(client, b"200 Welcome\n"):
        clients[connection] = client
    else:
        connection.close()


def _serve(client: _Client, recorder: _Recorder) -> bool:
    """Reads what has arrived and answers it. False ends the connection."""
    try:
        received = client.connection.recv(4096)
    except OSError:
        return False
    client.buffer += received
    while (end := client.buffer.find(b"\n")) >= 0:
        command = bytes(client.buffer[:end]).decode("latin-1")
        del client.buffer[: end + 1]
        if not _obey(client, recorder, command):
            return False
    if len(client.buffer) > LONGEST_COMMAND:
        _sent(client, b"500 Line too long\n")
        return False
    return bool(received)


def _obey(client: _Client, recorder: _Recorder, command: str) -> bool:
    if command == "data":
        return _send_block(client, recorder)
    if command == "exit":
        _sent(client, b"200 Bye\n")
        return False
    return _sent(client, (recorder.answer(command) or "500 Unknown command\n").encode())


def _send_block(client: _Client, recorder: _Recorder) -> bool:
    if client.started_s is None:
        client.started_s = time.perf_counter()
        client.last = bytes(recorder.layout.size)
        return _sent(client, client.last)
    time_s = client.time_s
    newest = recorder.clock.latest()
    if client.misbehaviour.stalled(time_s):
        return True
    if newest != client.newest:
        client.newest = newest
        for frame in client.misbehaviour.frames(recorder.motion.frame(newest), time_s):
            counter = round(frame.time_us / recorder.motion.period_us)
            client.waiting.append(recorder.block(counter, frame.positions, frame.quaternions))
    if client.waiting:
        client.last = client.waiting.popleft()
    return _sent(client, client.misbehaviour.packet(client.last, time_s))


def _sent(client: _Client, data: bytes) -> bool:
    try:
        client.connection.sendall(data)
    except OSError:
        return False
    return True
