"""A server of RTC3D 1.0 that plays a recording: as strict as an NDI Wave, to as many clients as come.

It says nothing first, refuses what it does not know, answers each command with one OK and then what was asked
for, and sends its frames at the pace of its own clock whether anybody keeps up or not.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from ... import InputError
from ..devices import rtc3d
from ..devices.rtc3d import Component, Rtc3dError
from .faults import FaultPlan, Misbehaviour
from .motion import DeviceClock, DeviceFrame, SimulatedMotion

TICK_S = 0.1
STALL_TICK_S = 0.005
DROP_AFTER_S = 2.0  # a client that has taken nothing for so long, though something waits for it
FULL_BYTES = (
    1 << 18
)  # no frames are made for a client for which so much is waiting, beside the system's buffer
FRAMES_A_TURN = 64  # then the others have their turn
MOST_CLIENTS = 64
LONGEST_COMMAND = 1024
MISSING = {"ff": False, "zeros": True}
# What a Wave has; it knows the other words, but has no such data.
COMPONENTS = {
    "all": (rtc3d.SIX_D,), "6d": (rtc3d.SIX_D,), "3d": (rtc3d.THREE_D,), "analog": (), "force": (), "events": (),
}  # fmt: skip


@dataclass(frozen=True)
class Streaming:
    """What a client asked for. kinds: of components; every: of how many frames it gets one."""

    kinds: tuple[int, ...]
    every: int


class Client:
    """One connection: what it asked for, and the bytes that wait for it."""

    def __init__(self, connected: socket.socket, plan: FaultPlan) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, FULL_BYTES)
        self.socket = connected
        self.reader = rtc3d.PacketReader()
        self.order = rtc3d.BIG
        self.faults = Misbehaviour(plan)
        self.streaming: Streaming | None = None
        self.next_number = 0
        self.began = 0  # the number of the first frame it was ever sent; faults are timed from there
        self.leaving = False  # as soon as everything that waits is sent
        self._waiting = bytearray()
        self._moved_s = time.perf_counter()

    @property
    def waiting_bytes(self) -> int:
        return len(self._waiting)

    def put(self, data: bytes) -> None:
        if not self._waiting:
            self._moved_s = time.perf_counter()
        self._waiting += data

    def flush(self) -> None:
        """Sends what the connection takes. Raises OSError when it is broken or has been stuck for too long."""
        while self._waiting:
            try:
                sent = self.socket.send(self._waiting)
            except BlockingIOError:
                break
            del self._waiting[:sent]
            self._moved_s = time.perf_counter()
        if self._waiting and time.perf_counter() - self._moved_s > DROP_AFTER_S:
            raise TimeoutError("it takes no bytes")


class Device:
    """The device behind all connections: its clock, its measurements, its answers."""

    def __init__(self, motion: SimulatedMotion, nul: bool, zeros: bool) -> None:
        self.motion = motion
        self.clock = DeviceClock(motion.rate_hz)
        self._nul = nul
        self._zeros = zeros

    def body(self, frame: DeviceFrame, kinds: tuple[int, ...], order: str) -> bytes:
        components = []
        for kind in kinds:
            if kind == rtc3d.SIX_D:
                items = rtc3d.six_d_items(frame.positions, frame.quaternions, zeros=self._zeros)
            else:
                items = rtc3d.three_d_items(frame.positions, zeros=self._zeros)
            components.append(Component(kind, frame.number, frame.time_us, items))
        return rtc3d.encode_frame(components, order)

    def text(self, kind: int, words: str) -> bytes:
        return rtc3d.encode_text(kind, words, self._nul)

    def obey(self, client: Client, body: bytes) -> None:
        """One command. Raises Rtc3dError, whose text is the answer, where it is none."""
        if len(body) > LONGEST_COMMAND:
            raise Rtc3dError(f"a command has at most {LONGEST_COMMAND} bytes")
        if body.endswith(b"\0"):
            if not self._nul:
                raise Rtc3dError("a command does not end in NUL here")
            body = body[:-1]
        try:
            command = body.decode("ascii")
        except UnicodeDecodeError:
            raise Rtc3dError("a command is ASCII") from None
        name, *arguments = command.lower().split() or [""]
        match name, arguments:
            case "version", ["1.0"]:
                client.put(self._ok(command))
            case "setbyteorder", ["bigendian" | "littleendian" as order]:
                client.order = rtc3d.BIG if order == "bigendian" else rtc3d.LITTLE
                client.put(self._ok(command))
            case "sendparameters", words if all(word in COMPONENTS or word == "general" for word in words):
                client.put(self._ok(command))
                xml = rtc3d.parameters_xml(self.motion.rate_hz, self.motion.coils)
                client.put(self.text(rtc3d.XML, xml))
            case "sendcurrentframe", words:
                kinds = _kinds(words)
                client.put(self._ok(command))
                client.put(self._current(client, kinds))
            case "streamframes", ["stop"]:
                client.streaming = None
                client.put(self._ok(command))
            case "streamframes", [pace, *words]:
                self._stream(client, pace, _kinds(words), command)
            case "bye", []:
                client.put(self._ok(command))
                client.streaming = None
                client.leaving = True
            case _:
                raise Rtc3dError(f"unknown command: {command[:80]}")

    def send_due(self, client: Client) -> None:
        """Puts the frames that are due, as badly as was asked for. Raises OSError to cut the connection."""
        if client.streaming is None:
            return
        latest, rate_hz = self.clock.latest(), self.clock.rate_hz
        now_s = self._streamed_s(client)
        if client.faults.cut(now_s):
            raise ConnectionError("as asked by --faults")
        if client.faults.stalled(now_s):
            return
        turn = 0
        while client.next_number <= latest and turn < FRAMES_A_TURN and client.waiting_bytes < FULL_BYTES:
            time_s = (client.next_number - client.began) / rate_hz
            for frame in client.faults.frames(self.motion.frame(client.next_number), time_s):
                body = self.body(frame, client.streaming.kinds, client.order)
                client.put(client.faults.packet(rtc3d.encode_packet(rtc3d.DATA, body), time_s))
            client.next_number += client.streaming.every
            turn += 1

    def due_s(self, client: Client) -> float:
        """When there is something to do for the client, on `time.perf_counter`."""
        if client.streaming is None or client.waiting_bytes >= FULL_BYTES:
            return float("inf")
        if client.faults.stalled(self._streamed_s(client)):
            return time.perf_counter() + STALL_TICK_S
        return self.clock.due_s(client.next_number)

    def _streamed_s(self, client: Client) -> float:
        """Seconds since the first frame that the client was sent was measured."""
        return time.perf_counter() - self.clock.due_s(client.began)

    def _current(self, client: Client, kinds: tuple[int, ...]) -> bytes:
        if not kinds:
            return self.text(rtc3d.NO_DATA, "No data")
        body = self.body(self.motion.frame(self.clock.latest()), kinds, client.order)
        return rtc3d.encode_packet(rtc3d.DATA, body)

    def _stream(self, client: Client, pace: str, kinds: tuple[int, ...], command: str) -> None:
        word, _, value = pace.partition(":")
        if word == "allframes" and not value:
            every = 1
        elif word == "frequency":
            every = max(1, round(self.clock.rate_hz / _whole(value)))
        elif word == "frequencydivisor":
            every = _whole(value)
        else:
            raise Rtc3dError(f"{pace[:40]}: expected AllFrames, Frequency:n, FrequencyDivisor:n or Stop")
        client.put(self._ok(command))
        if not kinds:
            client.streaming = None
            client.put(self.text(rtc3d.NO_DATA, "No data"))
            return
        client.streaming = Streaming(kinds, every)
        client.next_number = self.clock.latest() + 1
        client.began = client.began or client.next_number

    def _ok(self, command: str) -> bytes:
        return self.text(rtc3d.COMMAND, f"OK-{command}")


def run_rtc3d(
    motion: SimulatedMotion,
    plan: FaultPlan,
    *,
    host: str,
    port: int,
    announce: Callable[[str], None],
    nul: bool = False,
    seconds: float | None = None,
    missing: str = "ff",
) -> None:
    """Serves until interrupted, or for `seconds`. Raises InputError where it cannot listen.

    port: 0 = any that is free. announce: told the source's URI as soon as clients may come. nul: the other
    dialect, in which every text ends in NUL; without it, commands that do are refused. missing: "ff" as a
    Wave encodes missing coils, or "zeros".
    """
    listener = _listen(host, port)
    device = Device(motion, nul, MISSING[missing])
    clients: list[Client] = []
    end_s = time.perf_counter() + (seconds if seconds is not None else float("inf"))
    try:
        bound = listener.getsockname()
        announce(f"rtc3d://[{host}]:{bound[1]}" if ":" in host else f"rtc3d://{host}:{bound[1]}")
        while (now_s := time.perf_counter()) < end_s:
            next_s = min([now_s + TICK_S, end_s, *(device.due_s(client) for client in clients)])
            readable, _, _ = select.select(
                [listener, *(client.socket for client in clients)],
                [client.socket for client in clients if client.waiting_bytes],
                [],
                max(0.0, next_s - now_s),
            )
            if listener in readable:
                _welcome(listener, clients, plan)
            for client in list(clients):
                try:
                    if client.socket in readable:
                        _listen_to(device, client)
                    device.send_due(client)
                    client.flush()
                    if client.leaving and not client.waiting_bytes:
                        raise ConnectionError("said goodbye")
                except OSError:
                    client.socket.close()
                    clients.remove(client)
    except KeyboardInterrupt:
        pass
    finally:
        for client in clients:
            with suppress(OSError):
                client.put(device.text(rtc3d.COMMAND, "bye"))
                client.flush()
            client.socket.close()
        listener.close()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=8)
    except (OSError, OverflowError, UnicodeError) as reason:
        why = getattr(reason, "strerror", None) or reason
        raise InputError(f"cannot listen on {host}:{port} ({why}); choose another --port.") from reason


def _welcome(listener: socket.socket, clients: list[Client], plan: FaultPlan) -> None:
    with suppress(OSError):
        connected, _ = listener.accept()
        if len(clients) < MOST_CLIENTS:
            clients.append(Client(connected, plan))
        else:
            connected.close()


def _listen_to(device: Device, client: Client) -> None:
    """Reads and obeys. Raises OSError where the client is gone or does not speak RTC3D."""
    try:
        data = client.socket.recv(4096)
    except BlockingIOError:
        return
    if not data:
        raise ConnectionError("it hung up")
    try:
        client.reader.feed(data)
        while not client.leaving and (packet := client.reader.next()) is not None:
            if client.waiting_bytes > FULL_BYTES + rtc3d.LARGEST_PACKET:
                raise ConnectionError("it asks and does not listen")
            if packet.kind != rtc3d.COMMAND:
                client.put(
                    device.text(rtc3d.ERROR, f"Error-clients send packets of kind 1, not {packet.kind}")
                )
                continue
            try:
                device.obey(client, packet.body)
            except Rtc3dError as reason:
                client.put(device.text(rtc3d.ERROR, f"Error-{reason}"))
    except Rtc3dError as reason:
        raise ConnectionError(str(reason)) from reason


def _kinds(words: list[str]) -> tuple[int, ...]:
    """The components asked for; all where none is named."""
    kinds: list[int] = []
    for word in words or ["all"]:
        if word not in COMPONENTS:
            raise Rtc3dError(f"unknown component: {word[:40]}")
        kinds += [kind for kind in COMPONENTS[word] if kind not in kinds]
    return tuple(kinds)


def _whole(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text[:9]) <= 100_000):
        raise Rtc3dError(f"'{text[:40]}' should be a whole number from 1")
    return int(text[:9])
