"""A take in a window: pause, scrub, speed, loop, frame by frame."""

from __future__ import annotations

import time

from .captions import figures
from .look import DARK, Look
from .playback import Ghost, Playback, moment_at
from .scene import Moments, Scene
from .window import Window

KEYS = {
    "space": "pause",
    "left, right": "frame",
    "up, down": "speed",
    "0-9": "place",
    "o": "loop",
    "g": "ghost here",
}


class Player:
    """What the keys do to a take that is shown in a window."""

    def __init__(self, scene: Scene, moments: Moments, ghost: Ghost | None = None) -> None:
        self.scene, self.moments, self.ghost = scene, moments, ghost
        self.playback = Playback(moments.times_s)

    def press(self, key: str) -> None:
        """A letter, or the name of another key; those without a meaning do nothing."""
        playback = self.playback
        match key:
            case " ":
                playback.toggle()
            case "left" | "right":
                playback.step(1 if key == "right" else -1)
            case "up" | "down":
                playback.faster(1 if key == "up" else -1)
            case "home" | "end":
                playback.seek(float(key == "end"))
            case "o":
                playback.looping = not playback.looping
            case "g":
                self.ghost = None if self.ghost else Ghost(self.moments, playback.time_s)
            case digit if digit in tuple("0123456789"):
                playback.seek(int(digit) / 10)

    @property
    def words(self) -> str:
        """Where it stands, in one line."""
        playback = self.playback
        words = [
            f"frame {playback.frame} of {len(self.moments)}",
            f"speed {playback.speed:g}" if playback.playing else "paused",
        ]
        return " | ".join([*words, *([] if playback.looping else ["once"])])

    def show(self, window: Window) -> None:
        """One picture."""
        moment = moment_at(self.moments, self.playback.time_s)
        view = window.view
        elapsed_s = self.playback.time_s - self.playback.begin_s
        view.ghost = None if self.ghost is None else self.ghost.at(elapsed_s)
        view.lines = (self.words, *figures(self.scene, moment))
        window.show(moment, self.playback.share)


def play(
    scene: Scene, moments: Moments, look: Look = DARK, colour_by: str = "tissue", ghost: Ghost | None = None
) -> None:
    """Shows a take until the window is closed. Raises InputError where no window can be opened."""
    player = Player(scene, moments, ghost)
    with Window(
        scene, f"tonguetrack: {scene.title}", look, KEYS, player.press, player.playback.seek
    ) as window:
        window.view.colour_by = colour_by
        then_s = time.perf_counter()
        while not window.closed:
            now_s = time.perf_counter()
            player.playback.advance(now_s - then_s)
            then_s = now_s
            player.show(window)
            window.wait()
