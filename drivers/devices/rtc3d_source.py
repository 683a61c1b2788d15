"""`rtc3d://HOST:PORT`: frames of an NDI Wave, WaveFront or First Principles, and of whatever speaks like one.

Nothing is taken for granted that servers in use are known to do otherwise: answers may come twice, late or
not at all, with any text; the byte order may be another than the one agreed on.
"""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from ... import InputError
from ..frames import CoilFrame, FrameOfReference, NoteKind, SourceNote
from ..sources import SourceAddress
from . import rtc3d
from .link import Link, LinkLost, connect_tcp
from .rtc3d_decode import decode_into
from .source import DeviceSource

REPLY_S = 1.0  # for one answer in the handshake; who is silent for longer is taken as he is
FIRST_FRAME_S = 2.0  # for a first frame after each way of asking for frames
GOODBYE_S = 0.3
STREAMS = ("6D", "All", "3D")
FRAME = FrameOfReference(origin="the field generator, or the reference sensor if one was active")
MOST_TOLD = 16  # different errors of one connection


def open_rtc3d(address: SourceAddress) -> DeviceSource:
    """Connects and waits for the first frame. Raises InputError.

    Options: order (big, little) to ask for; coils: how many sensors, else as many as the first frame has;
    rate: frames a second.
    """
    order = {"big": rtc3d.BIG, "little": rtc3d.LITTLE}[address.choice("order", "big", ("big", "little"))]
    sensors = address.number("coils", 0, 1, rtc3d.MOST_SENSORS)
    if sensors != int(sensors):
        raise InputError(f"'{address.text}': coils={address.option('coils')}: expected a whole number.")
    rate_hz = address.number("rate", 0.0, 0.1, 1e5)

    def connect() -> Rtc3dConversation:
        link = connect_tcp(address.host, address.port)
        try:
            return Rtc3dConversation(link, order, int(sensors))
        except BaseException:
            link.close()
            raise

    return DeviceSource(connect, address.text, rate_hz)


class Rtc3dConversation:
    """One connection to one server. Raises LinkLost where no frame comes.

    order: byte order to ask for; sensors: how many, 0 = as many as the first frame has. The coils are
    `Sensor 1` and so on, as in the recordings of the Wave. Every frame has the same arrays.
    """

    def __init__(self, link: Link, order: str = rtc3d.BIG, sensors: int = 0) -> None:
        self.frame = FRAME
        self.rate_hz = 0.0
        self.unasked = True
        self._link = link
        self._order = order
        self._reader = rtc3d.PacketReader()
        self._notes: deque[SourceNote] = deque()
        self._told: set[str] = set()
        self._no_data = False
        self._arrival_ns = time.perf_counter_ns()
        self._kind = rtc3d.SIX_D
        self._first: rtc3d.Packet | None = None
        self._greet()
        count = self._begin()
        if self._kind == rtc3d.THREE_D:
            self._note(NoteKind.INFO, f"{link.address} sends markers: positions without orientations")
        self.coils = tuple(f"Sensor {k + 1}" for k in range(sensors or count))
        six_d = self._kind == rtc3d.SIX_D
        self._positions = np.full((len(self.coils), 3), np.nan)
        self._quaternions = np.full((len(self.coils), 4), np.nan) if six_d else None
        self._rms = np.full(len(self.coils), np.nan) if six_d else None

    def receive(self, timeout_s: float) -> CoilFrame | SourceNote | None:
        deadline_s = time.perf_counter() + timeout_s
        while True:
            if self._notes:
                return self._notes.popleft()
            packet, self._first = self._first, None
            if packet is None:
                packet = self._packet(deadline_s)
            if packet is None:
                return None
            if packet.kind == rtc3d.DATA:
                item = self._coil_frame(packet.body)
                if item is not None:
                    return item
            else:
                self._hear(packet)
            if not self._notes and time.perf_counter() > deadline_s:
                return None

    def goodbye(self) -> None:
        try:
            self._link.send(
                rtc3d.encode_text(rtc3d.COMMAND, "StreamFrames Stop")
                + rtc3d.encode_text(rtc3d.COMMAND, "Bye")
            )
            # A connection that is closed over unread bytes is reset, and the goodbye may be lost with it.
            deadline_s = time.perf_counter() + GOODBYE_S
            while (left_s := deadline_s - time.perf_counter()) > 0:
                self._link.receive(left_s)
        except LinkLost:
            pass
        self._link.close()

    # The handshake

    def _greet(self) -> None:
        self._ask("Version 1.0")
        self._ask(f"SetByteOrder {rtc3d.ORDER_WORDS[self._order]}")
        answer = self._ask("SendParameters All", (rtc3d.ERROR, rtc3d.XML))
        if answer is None or answer.kind != rtc3d.XML:
            return
        try:
            parameters = rtc3d.parse_parameters(answer.body)
        except rtc3d.Rtc3dError:
            return  # nobody needs them
        self.rate_hz = parameters.rate_hz
        if any(parameters.names):
            names = ", ".join(name or "(nothing)" for name in parameters.names)
            self._note(NoteKind.INFO, f"{self._link.address} calls its sensors {names}")

    def _begin(self) -> int:
        """Has frames sent, and returns how many sensors the first one has."""
        for words in STREAMS:
            self._send(f"StreamFrames AllFrames {words}")
            deadline_s = time.perf_counter() + FIRST_FRAME_S
            while (packet := self._answer(deadline_s)) is not None:
                if packet.kind in (rtc3d.ERROR, rtc3d.NO_DATA):
                    break
                if packet.kind == rtc3d.DATA:
                    count = self._recognise(packet.body)
                    if count:
                        self._first = packet
                        return count
        said = f" (it says: {self._notes[-1].text})" if self._notes else ""
        raise LinkLost(f"{self._link.address} answers, but sends no frame with sensors{said}")

    def _recognise(self, body: bytes) -> int:
        """Byte order and kind of the first good frame; the number of its items, 0 = it is none."""
        order = rtc3d.order_of(body, self._order)
        if order is None:
            return 0
        counts = {head.kind: head.count for head in reversed(list(rtc3d.component_heads(body, order)))}
        for kind in (rtc3d.SIX_D, rtc3d.THREE_D):
            if 0 < counts.get(kind, 0) <= rtc3d.MOST_SENSORS:
                if order != self._order:
                    words, other = rtc3d.ORDER_WORDS[order], rtc3d.ORDER_WORDS[self._order]
                    self._note(
                        NoteKind.INFO,
                        f"{self._link.address} sends {words} although it was asked for {other}",
                    )
                self._order, self._kind = order, kind
                return counts[kind]
        return 0

    def _ask(self, words: str, kinds: tuple[int, ...] = (rtc3d.ERROR, rtc3d.COMMAND)) -> rtc3d.Packet | None:
        """Sends a command and waits for an answer of one of the kinds; frames that come meanwhile are stale."""
        self._send(words)
        deadline_s = time.perf_counter() + REPLY_S
        while (packet := self._answer(deadline_s)) is not None:
            if packet.kind in kinds:
                return packet
        return None

    def _answer(self, deadline_s: float) -> rtc3d.Packet | None:
        """The next packet, heard; None after the deadline, however much comes."""
        packet = self._packet(deadline_s) if time.perf_counter() < deadline_s else None
        if packet is not None:
            self._hear(packet)
        return packet

    # Packets

    def _send(self, words: str) -> None:
        # Without NUL: a real WaveFront was seen to lose step with clients that send one.
        self._link.send(rtc3d.encode_text(rtc3d.COMMAND, words))

    def _packet(self, deadline_s: float) -> rtc3d.Packet | None:
        """The next packet; nothing is read while whole ones are waiting. None when none came in time."""
        try:
            while (packet := self._reader.next()) is None:
                left_s = deadline_s - time.perf_counter()
                data = self._link.receive(max(0.0, left_s))
                if data:
                    self._arrival_ns = time.perf_counter_ns()
                    self._reader.feed(data)
                elif left_s <= 0:
                    return None
        except rtc3d.Rtc3dError as reason:
            raise LinkLost(f"{self._link.address} sends what is not RTC3D: {reason}") from reason
        return packet

    def _hear(self, packet: rtc3d.Packet) -> None:
        """Whatever is said beside the frames."""
        if packet.kind == rtc3d.COMMAND:
            if rtc3d.text_of(packet.body).lower() == "bye":
                raise LinkLost(f"{self._link.address} said goodbye")
        elif packet.kind == rtc3d.ERROR:
            text = _printable(packet.body)
            if text not in self._told and len(self._told) < MOST_TOLD:
                self._told.add(text)
                self._note(NoteKind.INFO, f"{self._link.address} answers: {text}")
        elif packet.kind == rtc3d.NO_DATA and not self._no_data:
            self._no_data = True
            self._note(NoteKind.INFO, f"{self._link.address} has no data: {_printable(packet.body)}")

    def _coil_frame(self, body: bytes) -> CoilFrame | None:
        try:
            head = decode_into(body, self._order, self._kind, self._positions, self._quaternions, self._rms)
        except rtc3d.Rtc3dError as reason:
            self._note(NoteKind.BAD_DATA, f"a damaged frame was left out: {reason}", 1)
            return None
        if head is None:
            return None
        self._no_data = False
        if head.count > len(self.coils) and "more sensors" not in self._told:
            self._told.add("more sensors")
            self._note(
                NoteKind.INFO,
                f"{self._link.address} has {head.count} sensors; all after number {len(self.coils)} are left "
                "out, start again to have them",
            )
        return CoilFrame(
            self._positions,
            head.time_us / 1e6,
            head.number,
            self._arrival_ns,
            self._quaternions,
            self._rms,
        )

    def _note(self, kind: NoteKind, text: str, count: int = 0) -> None:
        self._notes.append(SourceNote(kind, text, time.perf_counter_ns(), count))


def _printable(body: bytes) -> str:
    text = "".join(letter if letter.isprintable() else " " for letter in rtc3d.text_of(body))
    return text[:200] or "(nothing)"
