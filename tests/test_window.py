"""The window as a specification, on a display of its own: it opens, the tongue moves, keys and mouse do what they say."""

import ctypes.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from displays import absent, require_xvfb
from feeding import Feeder
from PIL import Image
from test_film import made_poses

from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.control import ControlQueue
from tonguetrack.tracker.posefiles import write_poses
from tonguetrack.tracker.streams.control_osc import OscControl, control_message, control_of
from tonguetrack.tracker.streams.feed import FeedReader
from tonguetrack.tracker.streams.monitor import decode
from tonguetrack.tracker.viewer.live_window import LiveView, Wishes, scene_of_feed
from tonguetrack.tracker.viewer.look import DARK, LIGHT

CHILD = Path(__file__).with_name("window_child.py")
NOWHERE = {"DISPLAY": "", "WAYLAND_DISPLAY": "", "XDG_RUNTIME_DIR": ""}
PATIENCE_S = 60.0


def on_a_display(folder, what, *more):
    """What the child saw there."""
    require_xvfb()
    command = [
        "xvfb-run",
        "-a",
        f"--server-num={200 + os.getpid() % 30_000}",  # two workers that both begin to search at 99 take the same one
        "-s",
        "-screen 0 1280x800x24",
        sys.executable,
        str(CHILD),
        what,
        str(folder),
        *more,
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "saw.json").read_text())


def near(pixel, colour):
    return np.abs(np.array(pixel) - np.round(255 * np.array(colour))).max() <= 3


def test_keys_and_mouse_do_what_the_window_says(tmp_path):
    if ctypes.util.find_library("Xtst") is None:
        absent("the X server's test extension is missing (Debian: apt install libxtst6)")
    saw = on_a_display(tmp_path, "keys")
    assert saw["steady"] == 0.0
    assert near(saw["time_bar"][0], DARK.bar) and near(saw["time_bar"][1], DARK.line)
    assert saw["after l"] > 0.7, "light instead of dark"
    assert saw["pressed"] == ["z", " "], "the others have a meaning of the window's own"
    yaw, pitch, changed = saw["turned"]
    home_yaw, home_pitch, home_mm = saw["reset"]
    assert (yaw - home_yaw, pitch - home_pitch) == pytest.approx((-40.0, -8.0))
    assert changed > 0.02
    assert saw["zoomed"] == pytest.approx(home_mm / 1.12)
    assert saw["still"] == [home_yaw, home_pitch], "who draws the time does not turn the tongue"
    assert saw["scrubbed"][0] == pytest.approx(0.5, abs=0.01)
    assert saw["scrubbed"][-1] == pytest.approx(0.75, abs=0.01)
    assert saw["hz"] < 75, "no more pictures than a screen shows"
    assert saw["closed"] == [False, True]


def tissue(picture):
    """How many pixels look like the tongue."""
    red, green, blue = (picture[..., part].astype(int) for part in range(3))
    return ((red > 90) & (red > 1.3 * green) & (red > 1.2 * blue)).sum()


def test_demo_with_a_window_shows_a_tongue_that_moves(tmp_path):
    saw = on_a_display(tmp_path, "run", "demo", "--view", "--osc", "127.0.0.1:9")
    assert saw["opened"], saw["told"]
    assert saw["moved_s"] is not None, saw["told"]
    assert "no window" not in saw["told"]
    assert tissue(np.asarray(Image.open(tmp_path / "screen.png"))) > 40_000


def test_a_take_is_played_in_a_window(tmp_path):
    write_poses(made_poses(), bundled_model(), tmp_path / "poses.csv")
    saw = on_a_display(tmp_path, "run", "view", "poses.csv", "--light", "--ghost", "poses.csv@0")
    assert saw["opened"], saw["told"]
    assert saw["moved_s"] is not None
    picture = np.asarray(Image.open(tmp_path / "screen.png"))
    assert tissue(picture) > 40_000
    assert near(picture[600, 5], LIGHT.background)


# Without a display ----------------------------------------------------------------------------------


def run_nowhere(folder, *arguments):
    code = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True, text=True, timeout=PATIENCE_S, cwd=folder, env={**os.environ, **NOWHERE}, check=False,
    )  # fmt: skip


def test_without_a_display_view_is_one_sentence(tmp_path):
    write_poses(made_poses(), bundled_model(), tmp_path / "poses.csv")
    done = run_nowhere(tmp_path, "view", "poses.csv")
    assert done.returncode == 2
    assert done.stderr.startswith("tonguetrack: a window needs a display, and none could be opened (")
    assert done.stderr.count("\n") == 1


def test_without_a_display_track_has_tracked_and_says_so(tmp_path):
    recording = Path(__file__).resolve().parents[1] / "recordings" / "demo.csv"
    session = recording.with_name("demo.session.toml")
    done = run_nowhere(
        tmp_path, "track", str(recording), "--session", str(session), "--view", "--out", "poses.csv"
    )
    assert done.returncode == 0
    assert "no window: a window needs a display" in done.stderr and "Traceback" not in done.stderr
    assert (tmp_path / "poses.csv").exists()


@pytest.mark.parametrize("missing", ["glfw", "moderngl"])
def test_without_the_extra_it_is_named(tmp_path, monkeypatch, capsys, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    write_poses(made_poses(), bundled_model(), tmp_path / "poses.csv")
    assert main(["view", str(tmp_path / "poses.csv")]) == 2
    assert "pip install 'tonguetrack[viewer]'" in capsys.readouterr().err


def test_a_ghost_without_a_window_is_refused(capsys):
    assert main(["demo", "--ghost", "poses.csv"]) == 2
    assert "add --view" in capsys.readouterr().err


# The live window, without its window ----------------------------------------------------------------


class Screen:
    """Stands in for a window: keeps what it was told to show."""

    def __init__(self):
        from types import SimpleNamespace

        self.view = SimpleNamespace(ghost=None, lines=())
        self.remembered = []
        self.moment = None

    def remember(self, moment):
        self.remembered.append(moment)

    def show(self, moment):
        self.moment = moment


def until(condition):
    end_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_the_newest_pose_is_shown_and_g_keeps_it_as_a_ghost(tmp_path):
    with Feeder(tmp_path / "feed") as feeder, FeedReader(tmp_path / "feed") as feed:
        screen, scene = Screen(), scene_of_feed(feed.about)
        view = LiveView(feed, scene, Wishes(feed), None)

        def sees(normalised):
            feeder.show(normalised)

            def seen():
                view.show(screen)
                return np.allclose(screen.moment.normalised, normalised) and len(screen.remembered) > 0

            until(seen)

        sees([1.0, 0, 0, 0])
        view.press("g")
        sees([0, 2.0, 0, 0])
        assert screen.view.ghost.normalised == pytest.approx([1.0, 0, 0, 0])
        view.press("g")
        view.show(screen)
        assert screen.view.ghost is None


def test_a_pose_whose_weights_are_no_numbers_is_not_shown(tmp_path):
    with Feeder(tmp_path / "feed") as feeder, FeedReader(tmp_path / "feed") as feed:
        screen = Screen()
        view = LiveView(feed, scene_of_feed(feed.about), Wishes(feed), None)
        until(feed.newest)
        view.show(screen)
        feeder.show([np.nan, 0, 0, 0])
        until(lambda: np.isnan(feed.newest()[1].weights).any())
        view.show(screen)
        assert np.isfinite(screen.moment.weights).all()
        assert all(np.isfinite(moment.weights).all() for moment in screen.remembered)


def test_a_feed_that_falls_silent_is_said_to_be(tmp_path):
    feeder = Feeder(tmp_path / "feed")
    with FeedReader(tmp_path / "feed") as feed:
        screen = Screen()
        view = LiveView(feed, scene_of_feed(feed.about), Wishes(feed), None)
        until(lambda: view.show(screen) or screen.remembered)
        feeder.close()
        until(lambda: view.show(screen) or any("no frames for" in line for line in screen.view.lines))


def test_keys_reach_the_run_as_wishes(tmp_path):
    queue = ControlQueue()
    with (
        OscControl("127.0.0.1:0", queue) as control,
        Feeder(tmp_path / "feed", control=control.address),
        FeedReader(tmp_path / "feed") as feed,
    ):
        wishes = Wishes(feed)
        heard = []
        for key in ("t", "m", " ", "f", "q", "?"):
            wishes.press(key)
        until(lambda: (heard.append(wish) if (wish := queue.take()) else None) or len(heard) >= 4)
        assert control.refused == 0
    assert sorted((wish.kind, wish.text) for wish in heard) == [
        ("fix_speaker", ""), ("mark", "mark 1"), ("mark", "mark 2"), ("take_start", ""),
    ]  # fmt: skip


def test_every_wish_but_the_end_has_a_message_that_is_understood():
    from tonguetrack.tracker.control import Control

    for wish in [
        Control("take_start"), Control("take_start", "aka 3"), Control("take_stop"), Control("mark", "here"),
        Control("fix_speaker"), Control("free_speaker"),
    ]:  # fmt: skip
        [(path, values)] = decode(control_message(wish))
        assert control_of(path, values, 0) == wish
