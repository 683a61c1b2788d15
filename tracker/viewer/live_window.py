"""The window of a live run: a process of its own, which reads a feed and shows the newest pose.

    python -c "from tonguetrack.tracker.viewer.live_window import main; main()" FOLDER

It ends with the run that writes the feed, or when the user closes it. Exit code 2 and one sentence on stderr where it
cannot open.
"""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from ... import InputError
from ...model import load_model
from ...model.multilinear import TongueModel
from ..bundled import bundled_model
from ..control import Control, ControlQueue
from ..keyboard import KeyMeanings
from ..outside import GHOST_NAME
from ..pose import CoilState, PoseStatus
from ..posefiles import read_poses
from ..session import parse_session
from ..streams.control_osc import control_message
from ..streams.feed import FeedAbout, FeedReader
from ..streams.udp import UdpSender
from .playback import Ghost
from .scene import Moment, Scene, moment_of, moments_of, scene_of
from .window import Window

SILENT_S = 0.5
"""Without a new pose for longer, the window says so."""
TOLD_S = 2.0
"""So long it says what was asked of the run."""
KEYS = {"space": "marker", "t": "take", "f": "fix speaker"}
GHOST_KEYS = {"g": "ghost here"}


def show(folder: Path) -> None:
    """Shows the feed in `folder` until its run is over or the window is closed. Raises InputError where it cannot."""
    with FeedReader(folder) as feed:
        scene = scene_of_feed(feed.about)
        ghost = _ghost_in(folder)
        wishes = Wishes(feed)
        live = LiveView(feed, scene, wishes, ghost)
        keys = {**(KEYS if feed.about.control else {}), **GHOST_KEYS}
        with Window(scene, f"tonguetrack: {feed.about.title}", keys=keys, pressed=live.press) as window:
            while not window.closed and not feed.over:
                live.show(window)
                window.wait()


def scene_of_feed(about: FeedAbout) -> Scene:
    """Raises InputError where the feed's model or session cannot be read."""
    model = bundled_model() if about.model == "bundled" else load_model(about.model)
    session = parse_session(about.session, "the run's session")
    title = f"{about.title}, {model.name}"  # the model's name says where it is synthetic
    return scene_of(model, session, about.roles, about.correspondences, title)


def _ghost_in(folder: Path) -> Ghost | None:
    path = folder / GHOST_NAME
    return Ghost(moments_of(read_poses(path))) if path.exists() else None


class Wishes:
    """What the user wants of the run, sent there as OSC control; nothing where the run takes none.

    told: what was asked for last, for people; "" = nothing lately.
    """

    def __init__(self, feed: FeedReader) -> None:
        self._queue = ControlQueue()
        self._keys = KeyMeanings(self._queue, lambda: bool(feed.numbers.live.take_path))
        self._sender = UdpSender(feed.about.control) if feed.about.control else None
        self._told, self._told_s = "", 0.0

    def press(self, key: str) -> None:
        """A key, with the meaning that it has on the terminal."""
        self._keys.press(key)
        while wish := self._queue.take():
            if self._sender is not None and wish.kind != "quit":
                self._send(wish)

    def _send(self, wish: Control) -> None:
        assert self._sender is not None
        with suppress(OSError):
            self._sender.send(control_message(wish))
            self._told = wish.kind.replace("_", " ") + (f": {wish.text}" if wish.text else "")
            self._told_s = time.monotonic()

    @property
    def told(self) -> str:
        return f"asked for: {self._told}" if self._told and time.monotonic() < self._told_s + TOLD_S else ""


class LiveView:
    """The newest pose of a feed, and what is said about it."""

    def __init__(self, feed: FeedReader, scene: Scene, wishes: Wishes, ghost: Ghost | None) -> None:
        self._feed, self._wishes, self._ghost = feed, wishes, ghost
        self._frozen: Moment | None = None
        self._moment = resting(scene.model, len(scene.roles))
        self._seen = 0
        self._since_s = self._begin_s = time.monotonic()

    def press(self, key: str) -> None:
        """`g` keeps the present pose as a ghost, or lets go of it; everything else is for the run."""
        if key != "g":
            self._wishes.press(key)
        elif self._frozen is not None or self._ghost is not None:
            self._frozen = self._ghost = None
        elif self._seen:
            self._frozen = self._moment

    def show(self, window: Window) -> None:
        """One picture of the newest pose; the poses since the last picture are in the coils' trails."""
        now_s = time.monotonic()
        for sequence, pose in self._feed.since(self._seen):
            self._seen = sequence
            if not pose.has_shape:
                continue
            self._since_s, self._moment = now_s, moment_of(pose)
            window.remember(self._moment)
        view = window.view
        view.ghost = self._frozen if self._ghost is None else self._ghost.at(now_s - self._begin_s)
        view.lines = self._lines(now_s - self._since_s)
        window.show(self._moment)

    def _lines(self, silent_s: float) -> tuple[str, ...]:
        numbers = self._feed.numbers
        silence = f"no frames for {silent_s:.0f} s" if silent_s > SILENT_S else ""
        words = (silence, self._wishes.told, *numbers.troubles, numbers.text)
        return tuple(line for line in words if line)


def resting(model: TongueModel, coils: int) -> Moment:
    """What is shown before the first pose: the mean, and no coils."""
    return Moment(
        model.pose.mean,
        np.zeros(model.pose.size),
        model.speaker.mean,
        np.full((coils, 3), np.nan),
        np.full(coils, np.nan),
        np.full(coils, CoilState.MISSING),
        PoseStatus.LOST,
    )


def main() -> None:
    """The process."""
    if len(sys.argv) != 2:
        print("usage: FOLDER", file=sys.stderr)
        raise SystemExit(2)
    try:
        show(Path(sys.argv[1]))
    except InputError as reason:
        print(f"tonguetrack: {reason}", file=sys.stderr)
        raise SystemExit(2) from reason
