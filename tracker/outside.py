"""Processes of our own beside the tracker: the window and the page's server.

They are processes and not threads, so that neither a graphics driver nor a browser can ever hold the tracker's
interpreter. Both read a feed (`streams/feed.py`) in a private folder (`streams/feedfolder.py`).
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from .. import InputError

WINDOW = "tonguetrack.tracker.viewer.live_window"
PAGE = "tonguetrack.tracker.streams.page.server"
GHOST_NAME = "ghost.npz"
"""In the feed's folder: poses that the window compares with, where there are any."""
PAGE_WORD = "page "
"""The line on the server's stdout that says it listens begins so; its address follows."""
START_S = 30.0
"""So long the page's server may take to listen; on a busy machine its imports take seconds."""
CLOSE_S = 3.0
"""So long a process may take to see that the feed is over, before it is ended."""
NICENESS = 5
"""The tracker goes before what shows it."""


class Beside:
    """A process that runs `main()` of one of our modules with these arguments, until closed.

    It is no part of our terminal's group: Ctrl-C is for the tracker, which then tells it through the feed. name: for
    people; ended: called once in a thread when it ends by itself, with its complaint: the last line that it wrote to stderr, or ""
    where it ended as it should.
    """

    def __init__(
        self, name: str, module: str, arguments: Sequence[str], ended: Callable[[str], None]
    ) -> None:
        self.name = name
        self._ended = ended
        self._closing = False
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._errors: deque[str] = deque(maxlen=20)
        environment = dict(os.environ)
        for library in ("OMP", "OPENBLAS", "MKL"):  # whose idle threads would spin on the tracker's core
            environment.setdefault(f"{library}_NUM_THREADS", "1")
        # -P: a file called queue.py in the user's folder is not Python's.
        command = [sys.executable, "-P", "-c", f"from {module} import main; main()", *arguments]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            env=environment,
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )
        with suppress(OSError, AttributeError):  # Windows has no such thing
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
        self._listening = threading.Thread(target=self._listen, name=f"{module} out", daemon=True)
        self._waiting = threading.Thread(target=self._wait, name=f"{module} end", daemon=True)
        self._listening.start()
        self._waiting.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def line_with(self, beginning: str, seconds: float) -> str:
        """What follows this beginning in the first line on stdout that has it.

        Raises InputError with the process's complaint where it ends before, or where it has not said so in time.
        """
        end_s = time.monotonic() + seconds
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, end_s - time.monotonic()))
            except queue.Empty:
                raise InputError(f"{self.name} did not start within {seconds:g} seconds.") from None
            if line is None:
                self._waiting.join()
                raise InputError(self._complaint() or f"{self.name} ended at once.")
            if line.startswith(beginning):
                return line[len(beginning) :].strip()

    def close(self) -> None:
        """Waits a little for it to end by itself, then ends it. `ended` is not called any more."""
        self._closing = True
        for end in (lambda: None, self._process.terminate, self._process.kill):
            end()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(CLOSE_S)
                break
        self._waiting.join(CLOSE_S)
        self._listening.join(CLOSE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _listen(self) -> None:
        for line in _lines_of(self._process.stdout):
            self._lines.put(line)
        self._lines.put(None)

    def _wait(self) -> None:
        self._errors.extend(_lines_of(self._process.stderr))
        self._process.wait()
        if not self._closing:
            self._ended(self._complaint())

    def _complaint(self) -> str:
        if self._process.returncode == 0:
            return ""
        said = [line for line in self._errors if line.strip()]
        last = said[-1].strip().removeprefix("tonguetrack: ") if said else ""
        return last or f"{self.name} ended with exit code {self._process.returncode}."


def start_window(folder: Path, ended: Callable[[str], None]) -> Beside:
    """The window on the feed in this folder. It may take a second to open, and nobody waits for it."""
    return Beside("the window", WINDOW, [str(folder)], ended)


def start_page(folder: Path, address: str, ended: Callable[[str], None]) -> tuple[Beside, str]:
    """The page's server on the feed in this folder, once it listens at HOST:PORT, and the page's address.

    Raises InputError where it cannot; `ended` hears of what happens later only.
    """
    listens = threading.Event()
    page = Beside(
        "the page's server",
        PAGE,
        [str(folder), address],
        lambda why: ended(why) if listens.is_set() else None,
    )
    try:
        url = page.line_with(PAGE_WORD, START_S)
    except BaseException:
        page.close()
        raise
    listens.set()
    return page, url


def _lines_of(stream: IO[str] | None) -> Iterator[str]:
    """Its lines, the first 4096 letters of each, until it ends or is closed."""
    assert stream is not None
    with suppress(OSError, ValueError):
        while line := stream.readline(4096):
            yield line.rstrip("\n")
