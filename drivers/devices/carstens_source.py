"""A Carstens AG500 or AG501 as a source: cs5recorder over TCP, asked for one block after the other."""

from __future__ import annotations

import time

from ... import InputError
from ..frames import CoilFrame, FrameOfReference, NoteKind, SourceNote
from ..sources import SourceAddress
from .carstens_live import (
    COUNTER_MASK,
    LARGEST_BLOCK,
    LAYOUTS,
    BadReply,
    Block,
    Layout,
    coil_names,
    layout_of_size,
    layout_words,
    parse_block,
    parse_reply,
)
from .link import Link, LinkLost, connect_tcp
from .source import DeviceSource

WELCOME_S = 3.0
REPLY_S = 0.2
MOST_TRIES = 10
FIRST_REPLY_S, FIRST_TRIES = 1.0, 3
"""Before the size is known, two late replies in one would be taken for one that is twice as long."""
QUIET_S = 0.2
"""A reply of unknown size is whole when nothing follows for this long."""
USUAL_HZ, POLL_HZ = 250.0, 500.0
"""An AG501's usual rate; it is asked twice as often, or samples would be missed where the two rhythms meet."""
MOST_SAMPLES_A_SECOND = 2000.0
"""The fastest articulograph takes 1250; a counter that runs faster is damaged, or was set anew."""
CREDIBLE_JUMP, LATE_SAMPLES = 500, 50
EXPERIMENTAL = (
    "written from public client code and never tried against the hardware, so check what it delivers"
)


class CarstensConversation:
    """One connection, from the welcome to `exit`.

    A block that is the last one over again is not delivered, for the device is asked more often than it
    measures. `device_time_s` is the sample counter over `rate_hz` where the user states that, else the time of
    arrival since `start_ns`: the device has no clock that it tells.
    """

    def __init__(self, link: Link, layout: Layout, poll_hz: float, rate_hz: float, start_ns: int) -> None:
        self.coils = coil_names(layout)
        self.rate_hz = min(rate_hz or USUAL_HZ, poll_hz)
        self.frame = FrameOfReference()
        self.unasked = False
        self._link = link
        self._layout = layout
        self._sample_hz = rate_hz
        self._start_ns = start_ns
        self._period_s = 1.0 / poll_hz
        self._next_s = time.perf_counter()
        self._asked_s: float | None = None  # when the reply that is waited for was asked for
        self._tries = 0
        self._unanswered = 0
        self._buffer = bytearray()
        self._last_data = b""
        self._last: tuple[int, float] | None = None  # counter and arrival (s) of the last credible block
        self._doubted: int | None = None
        self._recording: bool | None = None
        self._newest, self._time_s = 0, 0.0  # counter and device time of the last frame
        self._pending: CoilFrame | None = None  # follows the notes
        self._notes = [self._note(NoteKind.INFO, f"Carstens {layout.name}: {EXPERIMENTAL}")]

    def receive(self, timeout_s: float) -> CoilFrame | SourceNote | None:
        end_s = time.perf_counter() + timeout_s
        while True:
            if self._notes:
                return self._notes.pop(0)
            if self._pending is not None:
                frame, self._pending = self._pending, None
                return frame
            if len(self._buffer) >= self._layout.size:
                self._take()
                continue
            now_s = time.perf_counter()
            if self._asked_s is None and now_s >= self._next_s:
                self._ask(now_s)
            until_s = self._next_s if self._asked_s is None else self._asked_s + REPLY_S
            # Read before judging: a reader that was kept busy finds its reply, however late it looks.
            data = self._link.receive(max(0.0, min(until_s, end_s) - now_s))
            if data and not self._unanswered:
                raise LinkLost(f"{self._link.address} sends more than was asked for")
            self._buffer += data
            now_s = time.perf_counter()
            if not data and self._asked_s is not None and now_s >= until_s:
                self._ask_again(now_s)
            elif not data and now_s >= end_s:
                return None

    def goodbye(self) -> None:
        try:
            self._link.send(b"exit\n")
            self._link.receive(REPLY_S)
        except LinkLost:
            pass
        self._link.close()

    def _ask(self, now_s: float) -> None:
        self._link.send(b"data\n")
        self._asked_s = now_s
        self._tries = 1
        self._unanswered += 1
        # The next request keeps to the rhythm, or begins a new one where it comes too late for that.
        self._next_s = max(self._next_s + self._period_s, now_s)

    def _ask_again(self, now_s: float) -> None:
        if self._tries >= MOST_TRIES:
            raise LinkLost(f"{self._link.address} did not answer {MOST_TRIES} times")
        self._tries += 1
        self._asked_s = now_s
        if not self._buffer:  # else the rest of the block may still come
            self._link.send(b"data\n")
            self._unanswered += 1

    def _take(self) -> None:
        """Makes what is to be said of the first block in the buffer: notes, and a frame unless it is left out."""
        arrival_ns = time.perf_counter_ns()
        data = bytes(self._buffer[: self._layout.size])
        del self._buffer[: self._layout.size]
        self._asked_s = None
        self._unanswered -= 1
        if len(self._buffer) > self._unanswered * self._layout.size:
            raise LinkLost(f"{self._link.address} sends more than was asked for")
        if data == self._last_data:
            return
        self._last_data = data
        block = parse_block(data, self._layout)
        if not self._credible(block.counter, arrival_ns * 1e-9):
            self._notes.append(self._note(NoteKind.BAD_DATA, "a block with an impossible sample counter", 1))
            return
        self._pending = self._frame(block, arrival_ns)
        if self._recording is not None and block.recording != self._recording:
            what = f"began to record sweep {block.sweep}" if block.recording else "stopped recording"
            self._notes.append(self._note(NoteKind.INFO, f"the device {what}"))
        self._recording = block.recording

    def _credible(self, counter: int, arrival_s: float) -> bool:
        """Whether the counter may have come this far. One that may not is believed when the next confirms it:
        blocks have no check sum, and a single damaged counter would tell of a gap that never was."""
        if self._last is not None:
            before, before_s = self._last
            most = CREDIBLE_JUMP + MOST_SAMPLES_A_SECOND * (arrival_s - before_s)
            if not _near(before, counter, most):
                if self._doubted is None or not _near(self._doubted, counter, most):
                    self._doubted = counter
                    return False
                self._notes.append(self._note(NoteKind.CLOCK_RESET, "the device counts from elsewhere"))
        self._doubted = None
        self._last = (counter, arrival_s)
        return True

    def _frame(self, block: Block, arrival_ns: int) -> CoilFrame:
        if self._sample_hz:
            time_s = block.counter / self._sample_hz
        elif 0 < (self._newest - block.counter) & COUNTER_MASK < LATE_SAMPLES:
            time_s = self._time_s  # a late one was not measured after the newest
        else:
            time_s = (arrival_ns - self._start_ns) * 1e-9
        self._newest, self._time_s = block.counter, time_s
        return CoilFrame(block.positions, time_s, block.counter, arrival_ns, block.quaternions, block.rms)

    def _note(self, kind: NoteKind, text: str, count: int = 0) -> SourceNote:
        return SourceNote(kind, text, time.perf_counter_ns(), count)


def open_carstens(address: SourceAddress) -> DeviceSource:
    """`carstens://HOST[:30303]?layout=...&poll=...&rate=...`.

    poll: requests a second; rate: samples a second of the device, which gives frames a device time (see
    `CarstensConversation`). Raises InputError where nobody answers, or the blocks are of no known size.
    """
    names = tuple(layout.name for layout in LAYOUTS)
    asked = address.choice("layout", "", ("", *names))
    poll_hz = address.number("poll", POLL_HZ, 20.0, 2000.0)
    rate_hz = address.number("rate", 0.0, 1.0, MOST_SAMPLES_A_SECOND)
    start_ns = time.perf_counter_ns()

    def connect() -> CarstensConversation:
        link = connect_tcp(address.host, address.port)
        try:
            return CarstensConversation(link, shake_hands(link, asked), poll_hz, rate_hz, start_ns)
        except BaseException:
            link.close()
            raise

    return DeviceSource(connect, address.text)


def shake_hands(link: Link, asked: str) -> Layout:
    """Waits for the welcome and measures the blocks. Raises LinkLost, and InputError for what is no cs5recorder."""
    greeting = bytearray()
    deadline_s = time.perf_counter() + WELCOME_S
    try:
        while (found := parse_reply(bytes(greeting))) is None:
            left_s = deadline_s - time.perf_counter()
            if left_s <= 0:
                raise LinkLost(f"{link.address} sent no welcome within {WELCOME_S:g} s")
            greeting += link.receive(left_s)
    except BadReply as reason:
        raise InputError(f"{link.address} is not cs5recorder: {reason}.") from reason
    welcome, length = found
    if welcome.code // 100 != 2:
        raise InputError(f"{link.address} refuses: {welcome.code} {welcome.text[-1][:80]}.")
    _measured(link, bytes(greeting[length:]))  # the first block is often nothing but zeros
    data = _measured(link)
    layout = layout_of_size(len(data))
    if layout is None or (asked and layout.name != asked):
        if data[:3].isdigit():
            words = data[:80].decode("latin-1").strip()
            raise InputError(f"{link.address} answers 'data' with '{words}'; does the device measure?")
        raise InputError(
            f"{link.address} sends blocks of {len(data)} bytes"
            + (f", which is not layout={asked}" if asked else ", which is no layout that is known here")
            + f"; the layouts are {layout_words()}."
        )
    return layout


def _measured(link: Link, before: bytes = b"") -> bytes:
    """The answer to one `data`, read until the device is quiet. Raises LinkLost where none comes."""
    data = bytearray(before)
    for _ in range(FIRST_TRIES):
        link.send(b"data\n")
        chunk = link.receive(FIRST_REPLY_S)
        while chunk:
            data += chunk
            if len(data) > 2 * LARGEST_BLOCK:
                raise InputError(f"{link.address} does not stop sending; is it cs5recorder?")
            chunk = link.receive(QUIET_S)
        if data:
            return bytes(data)
    raise LinkLost(f"{link.address} does not answer 'data'")


def _near(before: int, counter: int, most: float) -> bool:
    """Whether a counter of 31 bits has gone on by at most that much, or back by a few late samples."""
    ahead = (counter - before) & COUNTER_MASK
    return ahead <= most or COUNTER_MASK - ahead < LATE_SAMPLES
