"""What tests/test_window.py runs on a display of its own: python window_child.py WHAT FOLDER.

It opens real windows, presses keys, moves the mouse through the X server's test extension, looks at the screen, and
writes what it saw to FOLDER/saw.json.
"""

import ctypes
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import ImageGrab

PATIENCE_S = 40.0


def screen() -> np.ndarray:
    """(h, w, 3) what is on the display."""
    return np.asarray(ImageGrab.grab(xdisplay="").convert("RGB")).astype(int)


def moved(one: np.ndarray, other: np.ndarray) -> float:
    """Share of pixels that differ."""
    return float((np.abs(one - other).max(axis=-1) > 24).mean())


class Mouse:
    """A real pointer, as far as programs can tell."""

    def __init__(self) -> None:
        self.x11, self.test = (ctypes.CDLL(name) for name in ("libX11.so.6", "libXtst.so.6"))
        self.x11.XOpenDisplay.restype = ctypes.c_void_p
        self.display = ctypes.c_void_p(self.x11.XOpenDisplay(None))

    def go(self, x: int, y: int) -> None:
        self.test.XTestFakeMotionEvent(self.display, -1, x, y, ctypes.c_ulong(0))
        self.x11.XSync(self.display, 0)

    def press(self, down: bool, button: int = 1) -> None:
        self.test.XTestFakeButtonEvent(self.display, button, int(down), ctypes.c_ulong(0))
        self.x11.XSync(self.display, 0)


def opened(folder: Path) -> dict[str, object]:
    """A window of a still pose: keys and the mouse."""
    from tonguetrack.tracker.bundled import bundled_model, bundled_recording
    from tonguetrack.tracker.viewer.live_window import resting
    from tonguetrack.tracker.viewer.scene import scene_of
    from tonguetrack.tracker.viewer.window import Window

    model = bundled_model()
    scene = scene_of(model, bundled_recording()[1], (), (), "a test")
    pressed: list[str] = []
    scrubbed: list[float] = []
    saw: dict[str, object] = {"pressed": pressed, "scrubbed": scrubbed}
    with Window(
        scene, "a test", keys={"z": "test"}, pressed=pressed.append, scrubbed=scrubbed.append, size=(800, 600)
    ) as window:
        moment = resting(model, 0)
        mouse = Mouse()

        def shown(pictures: int = 4) -> np.ndarray:
            for _ in range(pictures):
                window.show(moment, 0.25)
                window.wait()
            return screen()[:600, :800]

        first = shown()
        saw["steady"] = moved(first, shown())
        saw["time_bar"] = [first[598, 100].tolist(), first[598, 700].tolist()]
        for key in ("l", "c", "h", "x", "z", " "):
            window.press(key)
            saw[f"after {key}"] = moved(first, shown())
        for key in ("l", "h"):
            window.press(key)
        while window.view.colour_by != "tissue":
            window.press("c")
        mouse.go(200, 400)
        shown(2)
        mouse.press(True)
        shown(2)
        mouse.go(300, 380)
        shown(2)
        mouse.press(False)
        saw["turned"] = [window.view.yaw_deg, window.view.pitch_deg, moved(first, shown())]
        mouse.press(True, 4)
        mouse.press(False, 4)
        shown(2)
        saw["zoomed"] = window.view.distance_mm
        window.press("r")
        saw["reset"] = [window.view.yaw_deg, window.view.pitch_deg, window.view.distance_mm]
        mouse.go(400, 595)
        shown(2)
        mouse.press(True)
        shown(2)
        mouse.go(600, 300)
        shown(2)
        mouse.press(False)
        mouse.go(10, 595)
        shown(2)
        saw["still"] = [window.view.yaw_deg, window.view.pitch_deg]
        begin_s = time.perf_counter()
        shown(30)
        saw["hz"] = 30 / (time.perf_counter() - begin_s)
        saw["closed"] = [window.closed]
        window.press("q")
        saw["closed"] = [*saw["closed"], window.closed]  # type: ignore[misc]
    return saw


def running(folder: Path, *command: str) -> dict[str, object]:
    """A command with a window, until that has opened and its tongue has moved; then the screen is kept."""
    begin_s = time.monotonic()
    run = subprocess.Popen(
        [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))",
         *command],
        cwd=folder, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        opened_s = moved_s = None
        first = before = screen()
        while time.monotonic() < begin_s + PATIENCE_S and run.poll() is None and moved_s is None:
            time.sleep(0.1)
            now = screen()
            if opened_s is None and moved(before, now) > 0.2:
                opened_s, first = time.monotonic(), now
            elif opened_s is not None and moved(first[120:], now[120:]) > 0.01:
                moved_s = time.monotonic()
        ImageGrab.grab(xdisplay="").save(folder / "screen.png")
    finally:
        run.terminate()
        _, told = run.communicate(timeout=30)
    return {"opened": opened_s is not None, "moved_s": None if None in (opened_s, moved_s) else moved_s - opened_s, "told": told}  # type: ignore[operator]  # fmt: skip


if __name__ == "__main__":
    what, place = sys.argv[1], Path(sys.argv[2])
    found = opened(place) if what == "keys" else running(place, *sys.argv[3:])
    (place / "saw.json").write_text(json.dumps(found))
