"""An Aurora, Polaris or Vega as a source of coil frames: handshake, polling, goodbye."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ... import InputError
from ..frames import CoilFrame, FrameOfReference, NoteKind, SourceNote
from ..sources import SourceAddress
from . import ndi, ndi_reader, ndi_tracking
from .link import Link, LinkLost, SerialLink, connect_tcp, open_serial
from .numberclock import NumberClock
from .source import DeviceSource

FIRST_BAUD = 9600
FASTEST_BAUDS = (921600, 230400, 115200)
BREAK_S = 0.3
RESET_TIMEOUT_S = 7.0
COMMAND_TIMEOUT_S = 2.0
SLOW_TIMEOUT_S = 5.0  # INIT, PINIT, TSTART
SEARCH_TIMEOUT_S = 0.5  # INIT at a speed that is only a guess
SPEED_PAUSE_S = 0.1
POLL_TIMEOUT_S = 1.0
QUIET_S = 0.25
"""A reply that has begun and does not go on for this long has lost some of its bytes."""
DAMAGED_QUIET_S = 0.05
"""The same for one that is known to be damaged."""
TRIES = 3
BAD_IN_A_ROW = 5
GOODBYE_TIMEOUT_S = 0.8
REPLY_OPTIONS = ndi_tracking.TRANSFORMS | ndi_tracking.OUT_OF_VOLUME_TOO
INFORMATION = ndi.PHINF_TOOL | ndi.PHINF_PART_NUMBER | ndi.PHINF_LOCATION
ALL_PORTS, FREE_PORTS, NEW_PORTS, INITIALISED_PORTS = "00", "01", "02", "03"
ROUNDS = 4
"""Initialising a tool with two coils makes a handle for the second: so often new ones are asked for."""
PAUSE_SHARE, LONGEST_PAUSE_S = 1.0 / 8.0, 0.02
RECENT_STEPS = 16
FRAME_OF_REFERENCE = FrameOfReference(origin="the field generator or camera")


def open_ndi(address: SourceAddress) -> DeviceSource:
    """`ndi:///dev/ttyUSB0`, `ndi+tcp://HOST:PORT`, `ndi+rfc2217://HOST:PORT`.

    Options: baud, reply (bx or tx), rate. Raises InputError for options that are not possible, and where no
    device answers.
    """
    prefers_bx = address.choice("reply", "bx", ("bx", "tx")) == "bx"
    rate_hz = address.number("rate", 0.0, 1e-3, 1e4)
    bauds = _bauds(address)

    def connect() -> NdiConversation:
        if address.kind.scheme == "ndi+tcp":
            return _begin(connect_tcp(address.host, address.port), lambda device: device.start(), prefers_bx)
        path = address.path
        if address.kind.scheme == "ndi+rfc2217":
            host = f"[{address.host}]" if ":" in address.host else address.host
            path = f"rfc2217://{host}:{address.port}"
        link = open_serial(path, FIRST_BAUD)
        line = SerialLine(link)
        return _begin(link, lambda device: device.start_serial(line, bauds), prefers_bx, line)

    return DeviceSource(connect, address.text, rate_hz)


def _bauds(address: SourceAddress) -> tuple[int, ...]:
    text = address.option("baud")
    if not text:
        return FASTEST_BAUDS
    if not text.isdigit() or int(text) not in ndi.BAUD_CODES:
        speeds = ", ".join(str(baud) for baud in sorted(ndi.BAUD_CODES))
        raise InputError(f"'{address.text}': baud={text}: expected one of {speeds}.")
    asked = int(text)
    return (asked, *(baud for baud in FASTEST_BAUDS if baud < asked))


def _begin(
    link: Link, start: Callable[[Device], None], prefers_bx: bool, line: SerialLine | None = None
) -> NdiConversation:
    """The whole handshake; a link that it fails on is closed."""
    device = Device(link)
    try:
        start(device)
        coils = device.enable_tools()
        device.ask("TSTART", timeout_s=SLOW_TIMEOUT_S)
        return NdiConversation(device, coils, prefers_bx, line)
    except BaseException as reason:
        link.close()
        if isinstance(reason, ndi.NdiError):
            raise LinkLost(f"{link.address}: the device refused: {reason}") from reason
        raise


@dataclass(frozen=True)
class Coil:
    """One handle that delivers positions. name: by its place, so that it is the same after a restart."""

    handle: int
    name: str


class SerialLine:
    """What only a serial line has: its speed and the break that resets the device. Raises LinkLost."""

    def __init__(self, link: SerialLink) -> None:
        self._link = link
        self.baud = FIRST_BAUD

    def set_baud(self, baud: int) -> None:
        self._do(lambda port: setattr(port, "baudrate", baud))
        self.baud = baud

    def send_break(self) -> None:
        # A pseudo-terminal carries no break: what stands behind one can only see that both buffers are emptied.
        self._do(lambda port: port.reset_output_buffer())
        self._do(lambda port: port.reset_input_buffer())
        with suppress(LinkLost):
            self._do(lambda port: setattr(port, "break_condition", True))
        time.sleep(BREAK_S)
        with suppress(LinkLost):
            self._do(lambda port: setattr(port, "break_condition", False))

    def _do(self, action: Callable) -> None:
        try:
            action(self._link.port)
        except Exception as reason:  # termios.error, which only some systems have, is no OSError
            raise LinkLost(f"{self._link.address}: {reason}") from reason


class Device:
    """Commands and their replies, one at a time; `notes` collects what people should know."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.reader = ndi_reader.ReplyReader()
        self.notes: list[str] = []

    def ask(self, name: str, arguments: str = "", timeout_s: float = COMMAND_TIMEOUT_S) -> str:
        """The reply's text. Raises ndi.NdiError where the device refuses, LinkLost where it does not answer.

        A command or reply that was damaged on the way is tried again.
        """
        for _ in range(TRIES):
            self._forget()
            self.link.send(ndi.command(name, arguments))
            reply = self._wait(timeout_s)
            if reply is None:
                raise LinkLost(f"{self.link.address} did not answer {name} within {timeout_s:g} s")
            if isinstance(reply, ndi_reader.Reply):
                try:
                    return ndi.parse_reply(reply.data)
                except ndi.NdiError as refusal:
                    if refusal.code != ndi.BAD_CRC:
                        raise
                except ndi.NdiDamaged:
                    pass
        raise LinkLost(f"{self.link.address}: what comes back for {name} is damaged, {TRIES} times")

    def next_text(self, timeout_s: float) -> str | None:
        """The next ASCII reply, of a refusal its words; None when none came in time."""
        deadline = time.perf_counter() + timeout_s
        while (left_s := deadline - time.perf_counter()) > 0:
            item = self._wait(left_s)
            if isinstance(item, ndi_reader.Reply) and not item.binary:
                try:
                    return ndi.parse_reply(item.data)
                except ndi.NdiError as refusal:
                    return str(refusal)
        return None

    def wait_for(self, text: str, timeout_s: float) -> bool:
        """Whether that reply came in time; others before it do not matter."""
        deadline = time.perf_counter() + timeout_s
        heard: str | None = ""
        while heard is not None and heard != text:
            heard = self.next_text(deadline - time.perf_counter())
        return heard == text

    def start(self) -> None:
        """INIT, where the speed is not in question; a device that is still tracking is stopped first."""
        self._initialise(SLOW_TIMEOUT_S)
        self._introduce()

    def start_serial(self, line: SerialLine, bauds: tuple[int, ...]) -> None:
        """Reset by a break, INIT, and the fastest of the speeds that works both ways."""
        self._reset(line)
        for baud in bauds:
            if baud == line.baud or self._change_speed(line, baud):
                break
        if line.baud != bauds[0]:
            self.notes.append(f"the line runs at {line.baud} baud; {bauds[0]} did not work")
        self._introduce()

    def enable_tools(self) -> tuple[Coil, ...]:
        """Frees handles that are left over, initialises and enables all tools. Raises LinkLost without any."""
        for port in self._ports(FREE_PORTS):
            self._try("PHF", f"{port.handle:02X}", f"handle {port.handle:02X} could not be freed")
        refused: set[int] = set()
        for _ in range(ROUNDS):
            new = [port.handle for port in self._ports(NEW_PORTS) if port.handle not in refused]
            if not new:
                break
            for handle in new:
                words = f"the tool at handle {handle:02X} could not be initialised and is left out"
                if not self._try("PINIT", f"{handle:02X}", words, SLOW_TIMEOUT_S):
                    refused.add(handle)
        coils = []
        for port in self._ports(INITIALISED_PORTS):
            handle = port.handle
            if handle in refused:
                continue
            information = self._information(handle)
            is_box = information.tool is not None and information.tool.tool_type == ndi.BUTTON_BOX
            words = f"the tool at handle {handle:02X} could not be enabled and is left out"
            if self._try("PENA", f"{handle:02X}{'B' if is_box else 'D'}", words) and not is_box:
                coils.append(Coil(handle, _coil_name(handle, information.location)))
        if not coils:
            why = "; ".join(self.notes) or "no port holds a tool"
            raise LinkLost(f"{self.link.address}: no tool delivers positions ({why}); plug in the coils")
        return _with_different_names(coils)

    def _reset(self, line: SerialLine) -> None:
        line.set_baud(FIRST_BAUD)
        self._forget()
        line.send_break()
        if self.wait_for(ndi.RESET_REPLY, RESET_TIMEOUT_S):
            time.sleep(SPEED_PAUSE_S)
            self._initialise(SLOW_TIMEOUT_S)
            return
        others = [baud for baud in (*FASTEST_BAUDS, *sorted(ndi.BAUD_CODES)) if baud != FIRST_BAUD]
        tried = list(dict.fromkeys([FIRST_BAUD, *others]))
        for baud in tried:
            with suppress(LinkLost):
                line.set_baud(baud)
                self._initialise(SEARCH_TIMEOUT_S)
                self.notes.append(f"the device did not answer a break but INIT at {baud} baud")
                return
        raise LinkLost(
            f"{self.link.address}: no answer to a break within {RESET_TIMEOUT_S:g} s, nor to INIT at "
            f"{', '.join(str(baud) for baud in tried)} baud"
        )

    def _initialise(self, timeout_s: float) -> None:
        try:
            self.ask("INIT", timeout_s=timeout_s)
        except ndi.NdiError:
            with suppress(ndi.NdiError):
                self.ask("TSTOP", timeout_s=SLOW_TIMEOUT_S)
            self.ask("INIT", timeout_s=SLOW_TIMEOUT_S)

    def _change_speed(self, line: SerialLine, baud: int) -> bool:
        """Whether both understand each other at the new speed; if not, the device refused it or was reset."""
        try:
            self.ask("COMM", ndi.comm_arguments(baud))
            time.sleep(SPEED_PAUSE_S)
            line.set_baud(baud)
            time.sleep(SPEED_PAUSE_S)
            self.ask("PHSR", ALL_PORTS, timeout_s=POLL_TIMEOUT_S)
        except ndi.NdiError:
            return line.baud == baud
        except LinkLost:
            self._reset(line)
            return False
        return True

    def _introduce(self) -> None:
        words = []
        with suppress(ndi.NdiError):
            version = ndi.parse_ver(self.ask("VER", "4"))
            words += [version[""], version.get("Freeze Tag", "")]
        with suppress(ndi.NdiError, ndi.NdiDamaged):
            words += ndi.parse_get(self.ask("GETINFO", "Features.Firmware.Version")).values()
        known = ", ".join(dict.fromkeys(word.strip() for word in words if word.strip()))
        self.notes.append(f"the device is: {known[:200] or 'unknown'}")

    def _ports(self, which: str) -> tuple[ndi.PortHandle, ...]:
        try:
            return ndi.parse_phsr(self.ask("PHSR", which))
        except ndi.NdiDamaged as reason:
            raise LinkLost(f"{self.link.address}: the reply to PHSR makes no sense: {reason}") from reason

    def _information(self, handle: int) -> ndi.PortInformation:
        """Everything, or the type alone where the device does not know the rest, or nothing."""
        for options in (INFORMATION, ndi.PHINF_TOOL):
            with suppress(ndi.NdiError, ndi.NdiDamaged):
                return ndi.parse_phinf(self.ask("PHINF", f"{handle:02X}{options:04X}"), options)
        return ndi.PortInformation()

    def _try(self, name: str, arguments: str, words: str, timeout_s: float = COMMAND_TIMEOUT_S) -> bool:
        try:
            self.ask(name, arguments, timeout_s)
        except ndi.NdiError as reason:
            self.notes.append(f"{words}: {reason}")
            return False
        return True

    def _wait(self, timeout_s: float) -> ndi_reader.Reply | ndi_reader.Damage | None:
        """The next reply or damaged piece; None when nothing, or only the beginning of something, came in time."""
        deadline = time.perf_counter() + timeout_s
        while (item := self.reader.next()) is None:
            now = time.perf_counter()
            wait_s = min(deadline - now, QUIET_S) if self.reader.pending else deadline - now
            data = self.link.receive(max(0.0, wait_s))
            if data:
                self.reader.feed(data)
            elif self.reader.pending:
                return ndi_reader.Damage(self.reader.clear())
            elif time.perf_counter() >= deadline:
                return None
        return item

    def _forget(self) -> None:
        """Leaves out what has come from before."""
        deadline = time.perf_counter() + QUIET_S
        while self.link.receive(0.0) and time.perf_counter() < deadline:
            pass
        self.reader.clear()


def _coil_name(handle: int, location: ndi.PortLocation | None) -> str:
    port = "" if location is None else location.port.strip().lstrip("0")
    if location is None or not (port.isascii() and port.isalnum()):
        return f"handle {handle:02X}"
    channel = location.channel.strip()
    second = int(channel) if channel.isascii() and channel.isdigit() else 0
    return f"port {port}{chr(ord('a') + second) if 0 < second < 26 else ''}"


def _with_different_names(coils: list[Coil]) -> tuple[Coil, ...]:
    """Tools without a cable share their port: where names are equal, the handle tells them apart."""
    names = [coil.name for coil in coils]
    return tuple(
        Coil(coil.handle, f"{coil.name} (handle {coil.handle:02X})") if names.count(coil.name) > 1 else coil
        for coil in coils
    )


class NdiConversation:
    """A device that is tracking, asked for its newest measurement again and again.

    A frame is delivered when the newest frame number of all handles has moved. Every handle has its own: one
    that has not moved since the frame before, and lags the newest by more than the device's usual step, is
    NaN. Coils without a position (missing, disabled, unplugged) are NaN; `status` is the port status word, and
    `rms` the device's own error of fit. Quaternions are (q0, qx, qy, qz) as they come.
    """

    rate_hz = 0.0
    frame = FRAME_OF_REFERENCE
    unasked = False

    def __init__(
        self, device: Device, coils: tuple[Coil, ...], prefers_bx: bool, line: SerialLine | None
    ) -> None:
        self.coils = tuple(coil.name for coil in coils)
        self._device = device
        self._link = device.link
        self._reader = device.reader
        self._line = line
        self._index = {coil.handle: index for index, coil in enumerate(coils)}
        self._notes = deque(_info(text) for text in device.notes)
        self._clock = NumberClock()
        self._newest = -1
        self._steps: deque[int] = deque(maxlen=RECENT_STEPS)
        self._usual_step = 0
        self._numbers = np.full(len(coils), -1, np.int64)
        self._states = [ndi_tracking.State.VALID] * len(coils)
        self._positions = np.full((len(coils), 3), np.nan)
        self._quaternions = np.full((len(coils), 4), np.nan)
        self._rms = np.full(len(coils), np.nan)
        self._status = np.zeros(len(coils), np.uint32)
        self._poll_bx, self._poll_tx = (ndi.command(name, f"{REPLY_OPTIONS:04X}") for name in ("BX", "TX"))
        self._uses_bx = prefers_bx
        self._asked = False
        self._asked_s = self._heard_s = self._next_poll_s = 0.0
        self._arrival_ns = 0
        self._frame_s = 0.0
        self._period_s = 0.0
        self._bad = 0
        self._system_status = 0

    def receive(self, timeout_s: float) -> CoilFrame | SourceNote | None:
        """See `source.Conversation`."""
        deadline = time.perf_counter() + timeout_s
        while True:
            if self._notes:
                return self._notes.popleft()
            if not self._asked and not self._poll(deadline):
                return None
            item = self._reader.next()
            if isinstance(item, ndi_reader.Reply):
                self._asked = False
                frame = self._understand(item)
                if frame is not None:
                    return frame
            elif isinstance(item, ndi_reader.Damage):
                self._asked = False
                self._count_bad(f"{item.size} bytes that are no whole reply")
            elif not self._listen(deadline):
                return None

    def goodbye(self) -> None:
        """See `source.Conversation`."""
        with suppress(LinkLost):
            answers = self._tell("TSTOP")
            if answers and self._line is not None and self._line.baud != FIRST_BAUD:
                self._tell("COMM", ndi.comm_arguments(FIRST_BAUD))
        self._link.close()

    def _tell(self, name: str, arguments: str = "") -> bool:
        """Sends a last command; whether any answer came."""
        self._link.send(ndi.command(name, arguments))
        return self._device.next_text(GOODBYE_TIMEOUT_S) is not None

    def _poll(self, deadline: float) -> bool:
        """Asks for the newest measurement, unless an answer to an older question is on its way already."""
        wait_s = min(self._next_poll_s, deadline) - time.perf_counter()
        if wait_s > 0:
            time.sleep(wait_s)
        if time.perf_counter() >= deadline:
            return False
        self._feed(self._link.receive(0.0))
        if not self._reader.pending:
            self._link.send(self._poll_bx if self._uses_bx else self._poll_tx)
        self._asked = True
        self._asked_s = self._heard_s = time.perf_counter()
        return True

    def _listen(self, deadline: float) -> bool:
        """Takes in what comes; False when nothing came until the deadline."""
        now = time.perf_counter()
        ends_s = self._asked_s + POLL_TIMEOUT_S
        if self._reader.pending:
            ends_s = self._heard_s + (DAMAGED_QUIET_S if self._reader.damaged else QUIET_S)
        data = self._link.receive(max(0.0, min(deadline, ends_s) - now))
        if data:
            self._feed(data)
            return True
        now = time.perf_counter()
        if now >= ends_s:
            self._asked = False
            if self._reader.pending:
                self._count_bad(f"{self._reader.clear()} bytes that are no whole reply")
                return True
        return now < deadline

    def _feed(self, data: bytes) -> None:
        if data:
            self._arrival_ns = time.perf_counter_ns()
            self._heard_s = self._arrival_ns * 1e-9
            self._reader.feed(data)

    def _understand(self, reply: ndi_reader.Reply) -> CoilFrame | None:
        try:
            if reply.binary:
                tracking = ndi_tracking.parse_bx(reply.data, REPLY_OPTIONS)
            else:
                text = ndi.parse_reply(reply.data)
                if text == ndi.RESET_REPLY:
                    raise LinkLost(f"{self._link.address}: the device was reset")
                tracking = ndi_tracking.parse_tx(text, REPLY_OPTIONS)
        except ndi.NdiError as refusal:
            self._refused(refusal)
            return None
        except ndi.NdiDamaged as reason:
            self._count_bad(str(reason))
            return None
        self._bad = 0
        return self._take(tracking, self._arrival_ns)

    def _refused(self, refusal: ndi.NdiError) -> None:
        if refusal.code == ndi.WRONG_MODE:
            raise LinkLost(f"{self._link.address}: the device is not tracking any more ({refusal})")
        if refusal.code == ndi.UNKNOWN_COMMAND and self._uses_bx:
            self._uses_bx = False
            self._notes.append(_info("the device does not know BX; TX is used, with larger replies"))
            return
        self._count_bad(f"the device refused: {refusal}")

    def _count_bad(self, words: str) -> None:
        self._bad += 1
        if self._bad >= BAD_IN_A_ROW:
            raise LinkLost(f"{self._link.address}: {self._bad} replies in a row are bad, the last: {words}")
        self._notes.append(SourceNote(NoteKind.BAD_DATA, words, time.perf_counter_ns(), 1))

    def _take(self, tracking: ndi_tracking.TrackingReply, arrival_ns: int) -> CoilFrame | None:
        """The frame, or None where nothing new was measured; then the device is spared for a moment."""
        if tracking.system_status != self._system_status:
            words = ndi_tracking.status_words(
                tracking.system_status & ~self._system_status, ndi_tracking.SYSTEM_STATUS
            )
            self._system_status = tracking.system_status
            if words:
                self._notes.append(_info(f"the device's system status: {words}"))
        newest = -1
        for tool in tracking.tools:
            if tool.handle in self._index and tool.state in (
                ndi_tracking.State.VALID,
                ndi_tracking.State.MISSING,
            ):
                newest = max(newest, tool.frame_number)
        if newest <= 0 or self._newest - 2 * self._usual_step <= newest <= self._newest:
            pause_s = min(LONGEST_PAUSE_S, self._period_s * PAUSE_SHARE)
            self._next_poll_s = time.perf_counter() + pause_s
            return None
        self._learn(newest, arrival_ns * 1e-9)
        self._positions.fill(math.nan)
        self._quaternions.fill(math.nan)
        self._rms.fill(math.nan)
        self._status.fill(0)
        for tool in tracking.tools:
            index = self._index.get(tool.handle)
            if index is not None:
                self._fill(index, tool)
        return CoilFrame(
            self._positions,
            self._clock.time_s(newest, arrival_ns),
            newest,
            arrival_ns,
            self._quaternions,
            self._rms,
            self._status,
        )

    def _fill(self, index: int, tool: ndi_tracking.ToolState) -> None:
        if tool.state is not self._states[index]:
            self._tell_state(index, tool.state)
        self._status[index] = tool.port_status
        lags = self._newest - tool.frame_number
        stale = tool.frame_number == self._numbers[index] and lags > self._usual_step > 0
        self._numbers[index] = tool.frame_number
        values = (*tool.quaternion, *tool.position, tool.error)
        if tool.state is ndi_tracking.State.VALID and not stale and all(map(math.isfinite, values)):
            self._positions[index] = tool.position
            self._quaternions[index] = tool.quaternion
            self._rms[index] = tool.error

    def _tell_state(self, index: int, state: ndi_tracking.State) -> None:
        """A tool that is unplugged or plugged in again is worth a sentence; one that is missing is not."""
        gone = (ndi_tracking.State.DISABLED, ndi_tracking.State.UNOCCUPIED)
        if (state in gone) != (self._states[index] in gone):
            words = "was unplugged or disabled" if state in gone else "is enabled again"
            self._notes.append(_info(f"{self.coils[index]} {words}"))
        self._states[index] = state

    def _learn(self, newest: int, arrival_s: float) -> None:
        """The step that the newest number usually makes, the larger where two alternate, and the period."""
        if 0 <= self._newest < newest:
            self._steps.append(newest - self._newest)
            self._usual_step = sorted(self._steps)[len(self._steps) // 2]
            since_s = arrival_s - self._frame_s
            if since_s < POLL_TIMEOUT_S:
                self._period_s += ((since_s - self._period_s) / 8.0) if self._period_s else since_s
        self._newest = newest
        self._frame_s = arrival_s


def _info(text: str) -> SourceNote:
    return SourceNote(NoteKind.INFO, text, time.perf_counter_ns())
