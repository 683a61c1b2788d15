"""Control over OSC: datagrams in, wishes of a user out. What is listened to is in `addresses.CONTROL_FORMS`."""

from __future__ import annotations

import logging
import re
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from pythonosc.osc_message_builder import OscMessageBuilder

from ..control import Control, ControlKind, ControlQueue
from .addresses import (
    CONTROL_MARKERS,
    CONTROL_SPEAKER,
    CONTROL_TAKE,
    DEFAULT_CONTROL_PORT,
    MAX_CONTROL_TEXT,
    MAX_DATAGRAM_BYTES,
)
from .monitor import decode
from .osc import listening_socket

DEFAULT_CONTROL = f"127.0.0.1:{DEFAULT_CONTROL_PORT}"
MAX_TOLD = 20
TICK_S = 0.2
"""How long `close` may have to wait for the thread."""

# A name becomes part of a file's name: nothing that leads to another folder, nothing hidden.
_PLAIN_NAME = re.compile(r"\w([\w .-]*[\w-])?")
_TAKE: dict[int | str, ControlKind] = {
    1: "take_start",
    0: "take_stop",
    "start": "take_start",
    "stop": "take_stop",
}
_SPEAKER: dict[str, ControlKind] = {"fix": "fix_speaker", "free": "free_speaker"}


def control_of(path: str, values: list[object], time_ns: int) -> Control | None:
    """What one message asks for; None where it is none of `CONTROL_FORMS`."""
    if any(isinstance(v, str) and not (len(v) <= MAX_CONTROL_TEXT and v.isprintable()) for v in values):
        return None
    match values:
        case [str() as text] if path in CONTROL_MARKERS and text:
            return Control("mark", text, time_ns)
        case [str() as word] if path == CONTROL_SPEAKER and word in _SPEAKER:
            return Control(_SPEAKER[word], "", time_ns)
        case [(int() | str()) as wish, *rest] if (
            path == CONTROL_TAKE and type(wish) is not bool and wish in _TAKE
        ):
            return _take(_TAKE[wish], rest, time_ns)
    return None


def _take(kind: ControlKind, rest: list[object], time_ns: int) -> Control | None:
    match rest:
        case []:
            return Control(kind, "", time_ns)
        case [str() as name] if _PLAIN_NAME.fullmatch(name):
            return Control(kind, name if kind == "take_start" else "", time_ns)
    return None


def control_message(control: Control) -> bytes:
    """The datagram that asks for it. Raises ValueError for a text that `control_of` would not take, and for "quit",
    which is asked for elsewhere."""
    match control.kind:
        case "mark":
            path, values = CONTROL_MARKERS[0], [control.text]
        case "take_start":
            path, values = CONTROL_TAKE, ["start", control.text] if control.text else ["start"]
        case "take_stop":
            path, values = CONTROL_TAKE, ["stop"]
        case "fix_speaker" | "free_speaker":
            path, values = CONTROL_SPEAKER, [control.kind.removesuffix("_speaker")]
        case other:
            raise ValueError(f"no message asks for {other}")
    if control_of(path, list(values), control.time_ns) is None:
        raise ValueError(f"'{control.text[:MAX_CONTROL_TEXT]}' would not be obeyed")
    builder = OscMessageBuilder(path)
    for value in values:
        builder.add_arg(value, "s")
    return bytes(builder.build().dgram)


class OscControl:
    """Listens for control messages in a thread of its own, until closed.

        with OscControl("127.0.0.1:9001", queue) as control: ...

    address: HOST:PORT; port 0 is any free one, and `address` then says which. Raises InputError where it cannot
    listen there. accepted, refused: messages that were obeyed, and messages or datagrams that were not
    understood. Nothing is ever answered; what was meant for us and not understood goes to `said`, the first
    `MAX_TOLD` times.
    """

    def __init__(
        self, address: str, queue: ControlQueue, said: Callable[[str], None] = lambda text: None
    ) -> None:
        self._said = said
        self._told = 0
        self.accepted = 0
        self.refused = 0
        self._queue = queue
        self._socket = listening_socket(address, "--control")
        self._socket.settimeout(TICK_S)
        self.address = f"{address.rpartition(':')[0]}:{self._socket.getsockname()[1]}"
        self._over = threading.Event()
        if not logging.getLogger().handlers:  # python-osc logs what is counted here
            logging.getLogger().addHandler(logging.NullHandler())
        self._thread = threading.Thread(target=self._listen, name="OSC control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread, then frees the port."""
        self._over.set()
        self._thread.join(timeout=5 * TICK_S)
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _listen(self) -> None:
        while not self._over.is_set():
            try:
                # One byte more than is taken apart, so that a longer datagram shows itself.
                datagram = self._socket.recv(MAX_DATAGRAM_BYTES + 1)
            except TimeoutError:
                continue
            except OSError:  # Windows tells of a longer datagram, or of a peer that is gone, in this way
                self.refused += 1
                self._over.wait(0.001)
                continue
            self._receive(datagram, time.perf_counter_ns())

    def _receive(self, datagram: bytes, time_ns: int) -> None:
        messages = decode(datagram) if len(datagram) <= MAX_DATAGRAM_BYTES else None
        if messages is None:
            self.refused += 1
            return
        for path, values in messages:
            control = control_of(path, values, time_ns)
            if control is None:
                self.refused += 1
                self._tell(path, values)
            else:
                self.accepted += 1
                self._queue.put(control)

    def _tell(self, path: str, values: list[object]) -> None:
        if path not in (CONTROL_TAKE, CONTROL_SPEAKER, *CONTROL_MARKERS) or self._told >= MAX_TOLD:
            return
        self._told += 1
        shown = ascii(values)
        shown = shown if len(shown) <= 60 else f"{shown[:60]}..."
        self._said(
            f"ignored over OSC: {path} {shown}; `tonguetrack monitor --addresses` lists what is understood"
        )
