"""What a user may ask of a running session, whoever carries the wish: a key, an OSC message, a signal."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

MAX_WAITING = 64

ControlKind = Literal["take_start", "take_stop", "mark", "fix_speaker", "free_speaker", "quit"]


@dataclass(frozen=True, slots=True)
class Control:
    """One wish.

    text: of "mark" the marker, of "take_start" the take's name ("" = none was given); printable, in one line.
    time_ns: when it was asked, `time.perf_counter_ns()`.
    """

    kind: ControlKind
    text: str = ""
    time_ns: int = 0


class ControlQueue:
    """Wishes on their way to the loop. Any thread or signal handler puts; one thread takes.

    dropped: how many were thrown away because `MAX_WAITING` newer ones came before they were taken.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[Control] = deque()
        # Reentrant, because a signal handler may interrupt a `put` of the same thread.
        self._lock = threading.RLock()

    def put(self, control: Control) -> None:
        """Adds one; in a full queue it takes the place of the oldest."""
        with self._lock:
            if len(self._waiting) >= MAX_WAITING:
                with suppress(IndexError):  # all of them were taken just now
                    self._waiting.popleft()
                    self.dropped += 1
            self._waiting.append(control)

    def take(self) -> Control | None:
        """The oldest, or None. Without a lock: cheap enough for every frame."""
        waiting = self._waiting
        return waiting.popleft() if waiting else None
