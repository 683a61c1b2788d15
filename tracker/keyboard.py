"""Single keys of the terminal as wishes to a running session; the terminal is always left as it was found."""

from __future__ import annotations

import atexit
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from .control import Control, ControlQueue

KEYS = "space or m: marker, t: start or end a take, f: fix the speaker, q: quit"
TICK_S = 0.1
"""How long leaving may have to wait for the thread."""
MAX_BYTES = 64
# What arrow and function keys send (ECMA-48, section 5.4; ESC O as terminals of the VT100 kind have it).
_ESCAPE_SEQUENCE = re.compile(rb"\x1b(?:\[[0-?]*[ -/]*[@-~]|O.|.)?", re.DOTALL)


class KeyMeanings:
    """Keys in, wishes into the queue. taking: whether a take is being written; None = `t` starts and ends in turn."""

    def __init__(self, queue: ControlQueue, taking: Callable[[], bool] | None = None) -> None:
        self._queue = queue
        self._taking = taking
        self._started = False
        self._marks = 0

    def press(self, key: str) -> None:
        """One key; those without a meaning do nothing."""
        now_ns = time.perf_counter_ns()
        match key.lower():
            case " " | "m":
                self._marks += 1
                self._queue.put(Control("mark", f"mark {self._marks}", now_ns))
            case "t":
                started = self._started if self._taking is None else self._taking()
                self._started = not started
                self._queue.put(Control("take_stop" if started else "take_start", "", now_ns))
            case "f":
                self._queue.put(Control("fix_speaker", "", now_ns))
            case "q":
                self._queue.put(Control("quit", "", now_ns))


@contextmanager
def watched_keys(queue: ControlQueue, taking: Callable[[], bool] | None = None) -> Iterator[bool]:
    """Turns keys (see `KEYS`) into wishes for as long as it lasts. Gives whether there is a terminal to watch.

    taking: tells whether a take is being written, so that `t` starts or ends it; without it, `t` starts one
    first and then takes turns. Without a terminal on stdin nothing is done.
    Ctrl-C stays a signal. In the background, and while the program is suspended, nothing is read and the
    terminal belongs to the shell. To be entered in the main thread, without which signals are left alone.
    """
    terminal = sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()
    if not terminal:
        yield False
        return
    meanings, over = KeyMeanings(queue, taking), threading.Event()
    with _terminal_that_gives_single_keys() as is_ours:
        thread = threading.Thread(target=_watch, args=(meanings, is_ours, over), name="keys", daemon=True)
        thread.start()
        try:
            yield True
        finally:
            over.set()
            thread.join(timeout=5 * TICK_S)


if sys.platform == "win32":
    import msvcrt

    @contextmanager
    def _terminal_that_gives_single_keys() -> Iterator[Callable[[], bool]]:
        yield lambda: True

    def _watch(meanings: KeyMeanings, is_ours: Callable[[], bool], over: threading.Event) -> None:
        while not over.wait(TICK_S / 2):
            while msvcrt.kbhit():
                key = msvcrt.getwch()
                if key in "\0\xe0":  # an arrow or function key, told in the next one
                    msvcrt.getwch()
                else:
                    meanings.press(key)

else:
    import select
    import termios
    import tty

    @contextmanager
    def _terminal_that_gives_single_keys() -> Iterator[Callable[[], bool]]:
        """Gives a function that says whether the keys are for us now."""
        terminal = _Terminal(sys.stdin.fileno())
        atexit.register(terminal.restore)
        handlers = {
            signal.SIGTSTP: terminal.suspend,
            signal.SIGCONT: terminal.resume,
            signal.SIGTERM: terminal.end,
            signal.SIGQUIT: terminal.end,
        }
        # Signals that somebody handles or ignores already stay with them: who ends in another way comes
        # through the finally below.
        free = [number for number in handlers if signal.getsignal(number) == signal.SIG_DFL]
        if threading.current_thread() is not threading.main_thread():
            free = []
        try:
            for number in free:
                signal.signal(number, handlers[number])
            terminal.take()
            yield terminal.is_ours
        finally:
            for number in free:
                signal.signal(number, signal.SIG_DFL)
            terminal.restore()
            atexit.unregister(terminal.restore)

    def _watch(meanings: KeyMeanings, is_ours: Callable[[], bool], over: threading.Event) -> None:
        descriptor = sys.stdin.fileno()
        try:
            while not over.is_set():
                if not is_ours():
                    over.wait(TICK_S)
                    continue
                readable, _, _ = select.select([descriptor], [], [], TICK_S)
                if not readable or over.is_set() or not is_ours():
                    continue
                keys = os.read(descriptor, MAX_BYTES)
                if not keys:
                    return
                for key in _ESCAPE_SEQUENCE.sub(b"", keys).decode("ascii", "replace"):
                    meanings.press(key)
        except (OSError, ValueError):  # the terminal is gone
            return

    class _Terminal:
        """The settings of a terminal: ours while we are in the foreground, else as they were."""

        def __init__(self, descriptor: int) -> None:
            self._descriptor = descriptor
            self._found: list[Any] | None = None

        def is_ours(self) -> bool:
            """Whether we are in the foreground: in the background, reading or setting would suspend us.

            Raises OSError when the terminal is gone.
            """
            return self._found is not None and self._is_foreground()

        def take(self) -> None:
            """Keys come one by one and are not shown; Ctrl-C and Ctrl-Z stay signals."""
            with suppress(OSError, termios.error):
                if self._is_foreground():
                    self._found = self._found or termios.tcgetattr(self._descriptor)
                    tty.setcbreak(self._descriptor, termios.TCSANOW)

        def restore(self) -> None:
            """May be called twice."""
            found, self._found = self._found, None
            with suppress(OSError, termios.error):
                if found is not None and self._is_foreground():
                    termios.tcsetattr(self._descriptor, termios.TCSANOW, found)

        def suspend(self, number: int, frame: FrameType | None) -> None:
            """Ctrl-Z: the shell finds the terminal as it left it."""
            self.restore()
            ours = signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGTSTP)
            signal.signal(signal.SIGTSTP, ours)
            self.resume(number, frame)

        def resume(self, number: int, frame: FrameType | None) -> None:
            """After `fg`: whatever stopped us, the shell had the terminal meanwhile."""
            self.take()

        def end(self, number: int, frame: FrameType | None) -> None:
            """As without a handler, but for the terminal."""
            self.restore()
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

        def _is_foreground(self) -> bool:
            return os.tcgetpgrp(self._descriptor) == os.getpgrp()
