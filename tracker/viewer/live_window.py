"""The window of a live run: a process of its own, which reads a feed and shows the newest pose.

    python -c "from tonguetrack.tracker.viewer.live_window import main; main()" FOLDER

It ends with the run that writes the feed, or when the user closes it. Exit code 2 and one sentence on stderr where it
cannot open.
"""

from __future__ import annotations

import socket
import sys
import time
from pathlib import Path

import numpy as np

from ... import InputError
from ...model import load_model
from ...model.multilinear import TongueModel
from ..bundled import bundled_model
from ..control import Control, ControlQueue
from ..keyboard import KeyMeanings
from ..pose import CoilState, PoseStatus
from ..session import parse_session
from ..streams.feed import FeedAbout, FeedReader
from .scene import Moment, Scene, moment_of, scene_of
from .window import Window

SILENT_S = 0.5
"""Without a new pose for longer, the window says so."""
KEYS = {"space": "marker", "t": "take", "f": "fix speaker", "g": "ghost"}


def show(folder: Path) -> None:
    """Shows the feed in `folder` until its run is over or the window is closed. Raises InputError where it cannot."""
    with FeedReader(folder) as feed:
        scene = scene_of_feed(feed.about)
        with Window(scene, f"tonguetrack: {feed.about.title}") as window:
            _follow(feed, window)


def scene_of_feed(about: FeedAbout) -> Scene:
    """Raises InputError where the feed's model or session cannot be read."""
    model = bundled_model() if about.model == "bundled" else load_model(about.model)
    session = parse_session(about.session, "the run's session")
    return scene_of(model, session, about.roles, about.correspondences, about.title)


def _follow(feed: FeedReader, window: Window) -> None:
    moment, seen, since_s = resting(window.scene.model, len(feed.about.roles)), 0, time.monotonic()
    while not window.closed and not feed.over:
        newest = feed.newest()
        if newest is not None and newest[0] != seen:
            seen, since_s, moment = newest[0], time.monotonic(), moment_of(newest[1])
        window.view.lines = _lines(feed, time.monotonic() - since_s)
        window.show(moment)
        window.wait()


def _lines(feed: FeedReader, silent_s: float) -> tuple[str, ...]:
    numbers = feed.numbers
    silence = [f"no frames for {silent_s:.0f} s"] if silent_s > SILENT_S else []
    return (*silence, *numbers.troubles, numbers.text)


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
