"""The way of a frame gone for practice: tracked by a twin, written into datagrams, sent to nobody."""

from __future__ import annotations

from collections.abc import Sequence

from ..drivers.frames import CoilFrame
from .online import Tracker
from .streams.osc import OscSink
from .streams.sink import Sink


class Rehearsal:
    """Called in the wait for a frame, it does with the last one what will be done with the next.

    A frame that comes after a rest of some milliseconds costs several times what it costs among others, because the
    processor has to fetch code and numbers anew; after a rehearsal it does not. The tracker itself is only looked
    at: its twin has a state of its own, one frame behind, so that poses and takes are what they are without.

    frame: the last one of the source, None before the first.
    """

    def __init__(self, tracker: Tracker, sinks: Sequence[Sink]) -> None:
        self.frame: CoilFrame | None = None
        self._tracker = tracker
        self._twin = tracker.twin()
        self._changes = tracker.changes
        self._sinks = [
            sink for sink in sinks if isinstance(sink, OscSink)
        ]  # the others are slots: nothing to warm

    def __call__(self) -> None:
        if self.frame is None:
            return
        if self._tracker.changes != self._changes:
            self._changes = self._tracker.changes
            self._twin.change(self._tracker.setup)
        pose = self._twin.step(self.frame)
        for sink in self._sinks:
            sink.rehearse(pose)
