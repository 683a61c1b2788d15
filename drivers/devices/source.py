"""Any live device as one stream of frames and notes that mends itself."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from ... import InputError
from ..frames import CoilFrame, FrameOfReference, NoteKind, SourceNote
from .clock import FrameClock, Verdict
from .link import LinkLost

TICK_S = 0.1
"""How long one wait lasts at most, and so how long `stop` takes to be noticed."""
IDLE_S = 5.0
"""A device that is connected but sends nothing for this long is connected to anew."""
CATCH_UP_S = 1.0
"""A device that sends as fast as it is read is not waited for any longer."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0
"""Pauses between attempts to connect: doubled each time up to the longest."""
PRACTICE_S = 0.0006
"""So long before a frame is due there is time to practise; practising takes a third of it."""
COLD_S = 0.002
"""After shorter waits a processor still has in its caches what a frame needs."""
LONGEST_WAIT_S = 0.1
"""Devices that are slower than this are not practised for: when their next frame comes cannot be told so well."""
ABANDON_S = 5.0
"""So long `close` waits for an attempt to connect that is under way."""


class Conversation(Protocol):
    """One connection to one device, from the finished handshake to the goodbye.

    coils, frame: what the device delivers. rate_hz: frames a second, as far as the device says so; 0.0 =
    it does not. unasked: whether frames come by themselves, and not as answers. `receive` is the only place that
    waits.
    """

    coils: tuple[str, ...]
    rate_hz: float
    frame: FrameOfReference
    unasked: bool

    def receive(self, timeout_s: float) -> CoilFrame | SourceNote | None:
        """The next frame, or something to say, or None when neither came in time.

        Raises LinkLost when nothing can come any more. Damaged pieces are left out and told in a
        BAD_DATA note; `arrival_ns` is taken when the frame's last byte was read.
        """

    def goodbye(self) -> None:
        """Stops the device as politely as it still can, and lets the link go. Never raises, ends within 2 s."""


Connect = Callable[[], Conversation]


class DeviceSource:
    """Frames and notes of a device. Reconnects by itself with growing pauses, and says so.

        with DeviceSource(connect, "rtc3d://host:3030") as source:
            for item in source: ...   # CoilFrame | SourceNote

    connect: makes a new conversation; raises LinkLost where the device does not answer, InputError where
    trying again cannot help. The constructor makes the first one: where that fails, it raises InputError.
    rate_hz: what the user or the device states, else learned from the frames; 0.0 until then.

    Frames that come twice or late are left out and counted (`duplicates`, `late`); a gap, a clock that
    jumps, a lost connection and every tick of silence are told in notes.

    practise: called once in the wait for a frame that is soon due, where frames come unasked. The processor turns to
    other things while a frame is waited for, and what it then has to fetch anew costs several times the frame's own
    work; whoever goes the way of a frame once without effect finds everything at hand when it comes.
    """

    def __init__(self, connect: Connect, address: str, rate_hz: float = 0.0, idle_s: float = IDLE_S) -> None:
        self.address = address
        self.duplicates = 0
        self.late = 0
        self.reconnections = 0
        self.practise: Callable[[], None] | None = None
        self._connect = connect
        self._stated_rate_hz = rate_hz
        self._idle_s = idle_s
        self._stopped = False
        self._clock = FrameClock()
        self._queue: deque[CoilFrame | SourceNote] = deque()
        try:
            conversation = connect()
        except LinkLost as reason:
            raise InputError(f"{reason}; is the device on, and is {address} its address?") from reason
        self._conversation: Conversation | None = conversation
        self.coils = conversation.coils
        self.frame = conversation.frame
        self._device_rate_hz = conversation.rate_hz
        self._heard_s = time.perf_counter()
        self._pause_s = FIRST_PAUSE_S
        self._try_at_s = 0.0
        self._attempt: _Attempt | None = None

    @property
    def rate_hz(self) -> float:
        """Frames a second; 0.0 while nobody knows."""
        if self._stated_rate_hz or self._device_rate_hz:
            return self._stated_rate_hz or self._device_rate_hz
        return 1.0 / self._clock.period_s if self._clock.period_s else 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def stop(self) -> None:
        """Ends the iteration within a tick. May be called from another thread or a signal handler."""
        self._stopped = True

    def close(self) -> None:
        """Stops the device and lets it go. Not for a signal handler: it may wait for the device."""
        self._stopped = True
        attempt, self._attempt = self._attempt, None
        if attempt is not None:
            attempt.abandon()
        conversation, self._conversation = self._conversation, None
        if conversation is not None:
            conversation.goodbye()

    def catch_up(self) -> None:
        """Leaves out frames that came while nobody read, so that the next one is fresh. Notes are kept."""
        deadline_s = time.perf_counter() + CATCH_UP_S
        self._queue.clear()
        try:
            while self._conversation is not None and time.perf_counter() < deadline_s:
                item = self._conversation.receive(0.0)
                if item is None:
                    break
                if isinstance(item, SourceNote):
                    self._queue.append(item)
                else:  # for the step and the period that it teaches
                    self._clock.judge(item.frame_number, item.device_time_s)
        except LinkLost as reason:
            self._queue.append(self._lose(str(reason)))
        self._clock.restart()
        self._heard_s = time.perf_counter()

    def __next__(self) -> CoilFrame | SourceNote:
        while not self._stopped:
            if self._queue:
                return self._queue.popleft()
            conversation = self._conversation
            if conversation is None:
                return self._reconnect()
            try:
                item = self._practised(conversation) or conversation.receive(TICK_S)
            except LinkLost as reason:
                return self._lose(str(reason))
            if item is None:
                silent_s = time.perf_counter() - self._heard_s
                if silent_s > self._idle_s:
                    return self._lose(f"{self.address} has sent nothing for {silent_s:.0f} s")
                return self._note(NoteKind.SILENT, f"{self.address} is silent")
            if isinstance(item, SourceNote):
                if item.kind is NoteKind.CLOCK_RESET:  # the conversation knows it: no gap is to be counted
                    self._clock.restart()
                return item
            self._heard_s = time.perf_counter()
            self._pause_s = FIRST_PAUSE_S
            verdict = self._clock.judge(item.frame_number, item.device_time_s)
            if verdict is Verdict.NEXT:
                return item
            if verdict is Verdict.DUPLICATE:
                self.duplicates += 1
            elif verdict is Verdict.LATE:
                self.late += 1
            else:
                # The frame's arrays stay as they are until the next `receive`.
                self._queue.append(item)
                if verdict is Verdict.GAP:
                    missing = self._clock.missing
                    text = "1 frame is missing" if missing == 1 else f"{missing} frames are missing"
                    return self._note(NoteKind.GAP, text, missing)
                return self._note(NoteKind.CLOCK_RESET, "the device's clock jumped")
        raise StopIteration

    def _practised(self, conversation: Conversation) -> CoilFrame | SourceNote | None:
        """What came before there was time to practise, or None."""
        period_s = self._clock.period_s
        if self.practise is None or not conversation.unasked or not COLD_S <= period_s <= LONGEST_WAIT_S:
            return None
        wait_s = self._heard_s + period_s - PRACTICE_S - time.perf_counter()
        if wait_s <= 0.0:
            return None
        item = conversation.receive(wait_s)
        if item is None:
            self.practise()
        return item

    def _lose(self, why: str) -> SourceNote:
        conversation, self._conversation = self._conversation, None
        if conversation is not None:
            conversation.goodbye()
        self._try_at_s = time.perf_counter() + self._pause_s
        return self._note(NoteKind.DISCONNECTED, why)

    def _reconnect(self) -> SourceNote:
        if self._attempt is None:
            wait_s = self._try_at_s - time.perf_counter()
            if wait_s > 0:
                time.sleep(min(wait_s, TICK_S))
                return self._note(NoteKind.SILENT, f"{self.address} is not connected")
            self._attempt = _Attempt(self._connect)
        if not self._attempt.done.wait(TICK_S):
            return self._note(NoteKind.SILENT, f"{self.address} is being connected")
        attempt, self._attempt = self._attempt, None
        try:
            conversation = attempt.result()
        except (LinkLost, InputError) as reason:
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self._try_at_s = time.perf_counter() + self._pause_s
            return self._note(NoteKind.SILENT, str(reason))
        if conversation.coils != self.coils:
            conversation.goodbye()
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
            self._try_at_s = time.perf_counter() + self._pause_s
            return self._note(
                NoteKind.INFO,
                f"{self.address} now has the coils {', '.join(conversation.coils)} instead of "
                f"{', '.join(self.coils)}; connect the same ones, or start again",
            )
        self._conversation = conversation
        self._clock.restart()
        self._heard_s = time.perf_counter()
        self.reconnections += 1
        return self._note(NoteKind.CONNECTED, f"{self.address} is connected again")

    def _note(self, kind: NoteKind, text: str, count: int = 0) -> SourceNote:
        return SourceNote(kind, text, time.perf_counter_ns(), count)


class _Attempt:
    """One attempt to connect, in a thread of its own: a device that does not answer costs seconds.

    done: set once `result` has something to give or to raise.
    """

    def __init__(self, connect: Connect) -> None:
        self.done = threading.Event()
        self._connect = connect
        self._ending = threading.Lock()
        self._abandoned = False
        self._conversation: Conversation | None = None
        self._reason: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="connecting", daemon=True)
        self._thread.start()

    def result(self) -> Conversation:
        """The conversation; raises what `connect` raised."""
        if self._conversation is None:
            assert self._reason is not None
            raise self._reason
        return self._conversation

    def abandon(self) -> None:
        """Lets the device go, now or when the attempt has ended; waits for that, but not for ever."""
        with self._ending:
            self._abandoned = True
            done = self.done.is_set()
        if not done:
            self._thread.join(ABANDON_S)
        elif self._conversation is not None:
            self._conversation.goodbye()

    def _run(self) -> None:
        try:
            self._conversation = self._connect()
        except BaseException as reason:  # noqa: BLE001 - raised again where the result is asked for
            self._reason = reason
        with self._ending:
            self.done.set()
            abandoned = self._abandoned
        if abandoned and self._conversation is not None:
            self._conversation.goodbye()
