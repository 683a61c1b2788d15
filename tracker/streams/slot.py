"""A sink behind a slot: what may wait works in a thread of its own and always gets the newest pose."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Protocol

from ..pose import TrackedPose
from .sink import StreamInfo

CLOSE_S = 2.0
"""So long `close` waits for a worker that is at work; one that hangs for longer is left behind."""
LONGEST_NAP_S = 0.1
"""A worker looks at least this often whether it is over."""
AGAIN_S = 1.0
"""So long after `begin` failed it is tried again."""


class Worker(Protocol):
    """What stands behind a slot. It may wait, fail and be slow. All but the destination is called in its own thread."""

    @property
    def destination(self) -> str:
        """Where it sends to, for people."""

    def begin(self, info: StreamInfo) -> None:
        """Before the first pose, and again whenever the info is another one."""

    def work(self, pose: TrackedPose) -> None:
        """Hands on one pose, which stays as it is until `work` returns. OSError = it could not be handed on."""

    def end(self) -> None:
        """After the last pose."""


class SlotSink:
    """The sink that the loop sees: `send` copies the pose into the slot and never waits.

    rate_hz: poses a second at most; the worker then looks by its own clock and the loop wakes nobody. None = every
    pose, as long as the worker is fast enough. `dropped` counts the poses that the worker could not hand on and
    those that a newer one replaced because it did not come in time; poses that are left out for the sake of the
    rate are no loss. `failure` says why it last failed, "" = it did not, or has recovered.
    said: called once for each new failure, in the worker's thread. waiting: so many poses may wait at a time; 1 for what
    is looked at, more for what is recorded, where frames that come in a burst are no reason for a loss.
    """

    def __init__(
        self,
        worker: Worker,
        rate_hz: float | None = None,
        said: Callable[[str], None] = lambda text: None,
        waiting: int = 1,
    ) -> None:
        self._worker = worker
        self._waiting = waiting
        self._said = said
        self._period_s = None if rate_hz is None else 1.0 / rate_hz
        self.sent = 0
        self.dropped = 0
        self.failure = ""
        # One pose is being worked on, one is being written, the others wait. Each is in one deque or in one
        # thread's hands; taking from a deque and adding to it are atomic, so that the loop needs no lock.
        self._free: deque[TrackedPose] = deque()
        self._newest: deque[TrackedPose] = deque()
        self._info: StreamInfo | None = None  # the newest
        self._wake = threading.Event()
        self._over = False
        self._due_s = 0.0  # when the worker will look next
        self._thread: threading.Thread | None = None

    @property
    def destination(self) -> str:
        return self._worker.destination

    def start(self, info: StreamInfo) -> None:
        self._info = info
        self._over = False
        self._thread = threading.Thread(target=self._run, name=f"to {self.destination}", daemon=True)
        self._thread.start()

    def change(self, info: StreamInfo) -> None:
        self._info = info
        self._wake.set()

    def send(self, pose: TrackedPose) -> None:
        """In the loop's thread: a copy and two operations on deques."""
        try:
            kept = self._free.popleft()
            kept.take(pose)
        except IndexError:  # the first poses of a run
            kept = pose.copy()
        if len(self._newest) >= self._waiting:
            try:
                self._free.append(self._newest.popleft())
            except IndexError:  # the worker has just taken it
                pass
            else:
                if self._period_s is None or time.perf_counter() > self._due_s + self._period_s:
                    self.dropped += 1
        self._newest.append(kept)
        if self._period_s is None and not self._wake.is_set():
            self._wake.set()

    def close(self) -> None:
        """Lets the worker hand on the last pose, and waits for it, but not for ever."""
        self._over = True
        self._wake.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        told: StreamInfo | None = None
        begun, again_s = False, 0.0
        self._due_s = time.perf_counter()
        while True:
            over = self._over
            info = self._info
            if info is not None and info is not told and time.perf_counter() >= again_s:
                begun = self._try(partial(self._worker.begin, info))
                if begun:
                    told = info
                else:
                    again_s = time.perf_counter() + AGAIN_S
            if begun:
                for _ in range(self._waiting):
                    self._work()
            if over:
                break
            self._rest()
        if begun:
            self._try(self._worker.end)

    def _work(self) -> None:
        try:
            pose = self._newest.popleft()
        except IndexError:
            return
        if self._try(partial(self._worker.work, pose)):
            self.sent += 1
            self.failure = ""
        else:
            self.dropped += 1
        self._free.append(pose)

    def _rest(self) -> None:
        if self._period_s is None:
            self._wake.wait(LONGEST_NAP_S)
            self._wake.clear()
            return
        # By the clock and not by naps, so that the rate is the one that was asked for.
        now_s = time.perf_counter()
        self._due_s = max(self._due_s + self._period_s, now_s)
        while not self._over and (left_s := self._due_s - time.perf_counter()) > 0:
            self._wake.wait(min(left_s, LONGEST_NAP_S))
            self._wake.clear()

    def _try(self, action: Callable[[], None]) -> bool:
        """Whatever a peer does must not end the thread: its stream goes on when it recovers."""
        try:
            action()
        except Exception as reason:  # noqa: BLE001
            failure = f"{self.destination}: {reason or type(reason).__name__}"
            if failure != self.failure:
                self.failure = failure
                self._said(failure)
            return False
        return True
