"""The page in a real Chromium: it draws, it follows, and its controls do what they say."""

import json
import os
import signal
import socket
import time

import feeding
import numpy as np
import pytest
from browser import Browser
from displays import require_chromium
from websockets.sync.client import connect

from tonguetrack.tracker.streams.feed import FeedNumbers
from tonguetrack.tracker.streams.sink import LiveNumbers

WAIT_S = 60.0
SIZE = (900, 620)
COIL_COLOURS = ((0xE6, 0x9F, 0x00), (0x56, 0xB4, 0xE9), (0x00, 0x9E, 0x73))
TISSUE, GHOST = (0xC4, 0x60, 0x6A), (0x4A, 0x74, 0xB8)  # of the light page
REST, RAISED = [0, 0, 0, 0], [2, -2, 1, 1]


@pytest.fixture(scope="module")
def browser():
    with Browser(require_chromium()) as opened:
        yield opened


@pytest.fixture(scope="module")
def control():
    """Where a run would listen for wishes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(WAIT_S)
        yield listener


@pytest.fixture(scope="module")
def feed(browser, tmp_path_factory, control):
    port = control.getsockname()[1]
    with feeding.Feeder(tmp_path_factory.mktemp("feed"), f"127.0.0.1:{port}", title="a test") as feeder:
        yield feeder


@pytest.fixture(scope="module")
def server(feed):
    with feeding.Served(feed.folder) as served:
        yield served


@pytest.fixture(scope="module")
def tab(browser, server):
    """One page for all tests, for a software rasteriser takes seconds for the first picture."""
    with browser.open(server.url, *SIZE) as opened:
        opened.prefer("light")
        yield opened
        assert opened.complaints == []


@pytest.fixture(autouse=True)
def at_rest(feed, tab):
    """Every test begins with the tongue at rest, in the tab that is in front: others are not drawn."""
    tab.call("Page.bringToFront")
    feed.show(REST)
    wait_for_pose(tab, REST)


def values(tab) -> list[float]:
    """The weights in sigma, as the page writes them."""
    texts = tab.run("[...document.querySelectorAll('#bars .value')].map(e => e.textContent)")
    return [float(text.replace("\u2212", "-")) for text in texts if text != "\u2013"]


def wait_for_pose(tab, wanted) -> None:
    until_s = time.monotonic() + WAIT_S
    while not (len(found := values(tab)) == len(wanted) and np.abs(np.subtract(found, wanted)).max() < 0.006):
        assert time.monotonic() < until_s, (found, wanted, tab.complaints)
        time.sleep(0.05)
    tab.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")


def near(picture, colour, tolerance: int = 24):
    """(h, w) bool: pixels of about this colour."""
    return np.abs(picture.astype(int) - colour).max(axis=2) <= tolerance


def centre(mask) -> np.ndarray:
    """(2,) x to the right and y upwards, in pixels."""
    rows, columns = np.nonzero(mask)
    assert len(rows) > 10
    return np.array([columns.mean(), -rows.mean()])


def fleshy(picture):
    """(h, w) bool: pixels that are clearly more red than anything else."""
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    return (red - green > 30) & (red - blue > 20)


# It draws, it follows -------------------------------------------------------------------------------


def test_the_page_shows_a_tongue_in_both_views(tab):
    solid, section = tab.picture("#solid"), tab.picture("#section")
    assert 0.08 < fleshy(solid).mean() < 0.7
    flesh = np.argwhere(fleshy(solid)).mean(axis=0) / solid.shape[:2]
    assert np.abs(flesh - 0.5).max() < 0.2  # in the middle of its view
    assert solid[fleshy(solid)].std(axis=0).max() > 8  # lit, not flat
    assert near(section, TISSUE).sum() > 300
    for colour in COIL_COLOURS:
        assert near(section, colour).sum() > 40


def upper_side(line, column):
    """How high a line (n, 2) lies at most in a column that it crosses, once or more often."""
    (x, y), (to_x, to_y) = line[:-1].T, line[1:].T
    crossed = (np.minimum(x, to_x) <= column) & (column <= np.maximum(x, to_x)) & (x != to_x)
    return (y + (to_y - y) * (column - x) / np.where(crossed, to_x - x, 1.0))[crossed].max()


def test_the_contour_is_where_the_model_says_in_every_pose(tab, feed):
    """Scale and place of the 2-D view are taken from the coils, which sit on known points."""

    def seen_and_expected():
        picture = tab.picture("#section")
        dots = np.array([centre(near(picture, colour, 12)) for colour in COIL_COLOURS])
        line = near(picture, TISSUE, 12)
        columns = np.flatnonzero(line.any(axis=0))
        tops = (
            -np.array([np.flatnonzero(line[:, column])[0] for column in columns]) - 2.0
        )  # half of its thickness
        return dots, columns, tops, feed.pose.coils[:, 1:], feed.contour()[:, 1:]

    for pose in (REST, RAISED, [-1, 1, -1, 1]):
        feed.show(pose)
        wait_for_pose(tab, pose)
        dots, columns, tops, coils, contour = seen_and_expected()
        scale = np.linalg.norm(dots[2] - dots[0]) / np.linalg.norm(coils[2] - coils[0])
        origin = (dots - scale * coils).mean(axis=0)
        drawn = scale * contour + origin
        highest = np.argmax(drawn[:, 1])
        behind = drawn[highest, 0] + np.arange(-10, 11)
        expected = np.array([upper_side(drawn, column) for column in behind])
        found = np.interp(behind, columns, tops)
        assert np.median(np.abs(found - expected)) / scale < 0.8  # mm


def test_another_pose_is_another_picture_in_both_views(tab, feed):
    before = tab.picture("#solid"), tab.picture("#section")
    feed.show(RAISED)
    wait_for_pose(tab, RAISED)
    after = tab.picture("#solid"), tab.picture("#section")
    # Of the silhouettes, for coils and names move as well.
    assert (fleshy(before[0]) ^ fleshy(after[0])).mean() > 0.05
    assert (near(before[1], TISSUE) & near(after[1], TISSUE)).sum() < 0.5 * near(before[1], TISSUE).sum()
    feed.show(REST)
    wait_for_pose(tab, REST)
    again = tab.picture("#solid")
    assert (np.abs(before[0].astype(int) - again).max(axis=2) > 30).mean() < 0.002  # and back to the first


def test_numbers_coils_and_states_are_those_of_the_pose(tab, feed):
    feed.show(REST, offset_mm=2.5, states=(0, 3, 1))
    tab.wait("document.querySelector('#coils').innerText.includes('missing')")
    rows = tab.run(
        "[...document.querySelectorAll('#coils tr')].map(r => [...r.cells].slice(1).map(c => c.innerText))"
    )
    assert rows == [
        ["tongue tip", "ok", "2.50"],
        ["tongue blade", "misfit", "2.50"],
        ["tongue dorsum", "missing", "2.50"],
    ]
    assert tab.text("#residual") == "2.50 mm" and tab.text("#status") == "tracking"
    assert "synthetic" in tab.text("#model") and tab.text("#title") == "a test"


def test_a_coil_away_from_the_tongue_is_drawn_away_with_its_distance(tab, feed):
    feed.show(REST, offset_mm=8)
    tab.wait("document.querySelector('#residual').innerText == '8.00 mm'")
    wait_for_pose(tab, REST)
    picture = tab.picture("#section")
    line, dot = near(picture, TISSUE, 12), centre(near(picture, COIL_COLOURS[2], 12))
    # Beside the stick of the residual, which covers the line where it ends on it.
    beside = np.flatnonzero(line[:, round(dot[0]) - 8 : round(dot[0]) + 9].any(axis=1))
    assert -dot[1] < beside[0] - 15  # above the line


def test_a_free_speaker_is_drawn_from_vertices(tab, feed):
    rest = tab.picture("#solid")
    # The second weight: the first one carries the mean, and moves hardly anything.
    stout = feed.model.speaker.raw(feed.model.speaker.normalised(feed.speaker_weights) + [0, 2, 0, 0, 0])
    try:
        feed.show(REST, speaker_weights=stout, fixed=False)
        tab.wait("document.querySelector('#speaker').innerText.includes('estimated')")
        time.sleep(0.5)
        free = tab.picture("#solid")
        assert (np.abs(rest.astype(int) - free).max(axis=2) > 30).mean() > 0.01
        feed.show(REST, speaker_weights=stout, fixed=True)
        tab.wait("document.querySelector('#speaker').innerText.includes('fixed')")
        fetched = "performance.getEntriesByType('resource').filter(e => e.name.includes('model.glb')).length"
        tab.wait(f"{fetched} >= 2")
        time.sleep(2)  # by now no vertices come any more
        fixed = tab.picture("#solid")
        assert (np.abs(fixed.astype(int) - free).max(axis=2) > 40).mean() < 0.01
    finally:
        feed.show(REST)


# Its controls do what they say ----------------------------------------------------------------------


def test_a_view_whose_size_is_not_known_yet_draws_nothing_and_breaks_nothing(tab):
    """As in a tab in the background, where a picture may come before the first layout."""
    assert (
        tab.run("""import(new URL("section.js", document.baseURI)).then(({ Section }) => {
        const view = new Section(document.createElement("div"));
        const points = [[0, 0, 0], [0, 10, 10], [0, 20, 5]];
        view.prepare({ palate: null }, [], []);
        view.theme(getComputedStyle(document.documentElement));
        view.frame({ points: () => points }, [], [0], [1]);
        view.show({ coils: [] }, points, [], []);
        view.draw();
        return "drawn";
    })""")
        == "drawn"
    )


def test_the_extra_delay_stands_in_one_line(tab):
    tab.type("#delay", 2000)
    one_line = "parseFloat(getComputedStyle(document.querySelector('#delay-shown')).fontSize) * 2"
    assert tab.run(f"document.querySelector('#delay-shown').getBoundingClientRect().height < {one_line}")
    tab.type("#delay", 0)


def test_take_marker_and_speaker_reach_the_run(tab, feed, control):
    tab.type("#take-name", "aka 3")
    tab.click("#take-button")
    assert control.recv(2048) == b"/tongue/control/take\0\0\0\0,ss\0start\0\0\0aka 3\0\0\0"
    feed.numbers = FeedNumbers(LiveNumbers(take_path="/x/aka 3.xdf", take_frames=99))
    tab.wait("document.querySelector('#take-button').innerText == 'Stop'")
    assert "aka 3.xdf" in tab.text("#recording") and "99 frames" in tab.text("#take")
    tab.type("#mark-text", "here it is")
    tab.click("#mark-form button")
    assert control.recv(2048).startswith(b"/tongue/control/marker\0\0,s\0\0here it is\0")
    tab.click("#take-button")
    assert control.recv(2048) == b"/tongue/control/take\0\0\0\0,s\0\0stop\0\0\0\0"
    tab.click("#speaker-button")
    assert control.recv(2048) == b"/tongue/control/speaker\0,s\0\0free\0\0\0\0"
    feed.numbers = FeedNumbers()
    tab.wait("document.querySelector('#take-button').innerText == 'Start'")


def test_what_is_wrong_with_the_run_stands_on_the_page(tab, feed):
    feed.numbers = FeedNumbers(troubles=("<b>the tip</b> is missing",))
    tab.wait(
        "document.querySelector('#trouble').innerText == '<b>the tip</b> is missing'"
    )  # as text, never as HTML
    feed.numbers = FeedNumbers()
    tab.wait("document.querySelector('#trouble').hidden")


def lag_ms(tab, feed, pose) -> float:
    """From a pose's arrival in the browser to its numbers on the page, by the browser's own clock."""
    tab.run(
        """window.changed = new Promise(done => {
          const place = document.querySelector('#bars .value'), before = place.textContent;
          const watch = new MutationObserver(() => place.textContent !== before && done(performance.now()));
          watch.observe(place, {childList: true, characterData: true, subtree: true});
        }); 1"""
    )
    sent_ms = tab.run("performance.now()")
    feed.show(pose)
    return tab.run("window.changed") - sent_ms


def test_the_extra_delay_holds_the_picture_back_by_as_much(tab, feed):
    tab.type("#delay", 1500)
    assert tab.text("#delay-shown") == "1500 ms"
    assert lag_ms(tab, feed, RAISED) > 1450
    tab.type("#delay", 0)
    wait_for_pose(tab, RAISED)
    assert lag_ms(tab, feed, REST) < 1450


def test_the_ghost_is_the_pose_of_the_moment_in_which_it_was_kept(tab, feed):
    plain = tab.picture("#section"), tab.picture("#solid")
    feed.show(RAISED)
    wait_for_pose(tab, RAISED)
    tab.click("#ghost")
    feed.show(REST)
    wait_for_pose(tab, REST)
    ghost = near(tab.picture("#section"), GHOST)
    assert ghost.sum() > 150 and near(plain[0], GHOST).sum() < 20
    veiled = tab.picture("#solid")
    assert (np.abs(veiled.astype(int) - plain[1]).max(axis=2) > 12).mean() > 0.01
    feed.show([-1, 1, 0, 0])
    wait_for_pose(tab, [-1, 1, 0, 0])
    moved = near(tab.picture("#section"), GHOST)
    assert (ghost & moved).sum() > 0.6 * min(ghost.sum(), moved.sum())  # it stays, whatever the tongue does
    tab.click("#ghost")
    feed.show(REST)
    wait_for_pose(tab, REST)
    assert near(tab.picture("#section"), GHOST).sum() < 20


def test_the_tongue_can_be_turned_and_set_back(tab):
    before = tab.picture("#solid").astype(int)
    x, y = tab.run(
        "(b => [b.x + b.width / 2, b.y + b.height / 2])(document.querySelector('#solid').getBoundingClientRect())"
    )
    for kind, dx in (("mousePressed", 0), ("mouseMoved", 60), ("mouseMoved", 120), ("mouseReleased", 120)):
        tab.call("Input.dispatchMouseEvent", type=kind, x=x + dx, y=y, button="left", buttons=1, clickCount=1)
    time.sleep(0.5)
    turned = tab.picture("#solid").astype(int)
    assert (np.abs(turned - before).max(axis=2) > 30).mean() > 0.02
    tab.click("#reset")
    time.sleep(0.5)
    assert (np.abs(tab.picture("#solid").astype(int) - before).max(axis=2) > 30).mean() < 0.01


def test_it_is_readable_on_dark_and_on_light(tab):
    def contrast(picture):
        brightness = picture.astype(float).mean(axis=2)
        return np.median(brightness), np.abs(brightness - np.median(brightness)).max()

    light, reach = contrast(tab.picture("header"))
    assert light > 200 and reach > 150
    tab.prefer("dark")
    try:
        time.sleep(0.5)
        dark, reach = contrast(tab.picture("header"))
        assert dark < 70 and reach > 150
        assert np.median(tab.picture("#section")) < 70 and np.median(tab.picture("#solid")[:10]) < 70
        assert fleshy(tab.picture("#solid")).mean() > 0.08
    finally:
        tab.prefer("light")
        time.sleep(0.5)


@pytest.mark.parametrize("size", [(1440, 900), (820, 1180), (1180, 820), (390, 844)])
def test_on_every_screen_both_views_are_there_and_nothing_runs_out_of_it(tab, size):
    tab.size(*size)
    try:
        tab.wait("document.querySelector('#solid canvas').width > 0")
        places = tab.run(
            "['#solid', '#section', '#bars', '#coils', '#timing', '#controls'].map(p => "
            "(b => [b.left, b.top, b.right, b.bottom])(document.querySelector(p).getBoundingClientRect()))"
        )
        for left, top, right, bottom in places:
            assert 0 <= left < right <= size[0] and bottom - top > 30
        assert all(right - left > 150 and bottom - top > 150 for left, top, right, bottom in places[:2])
        assert tab.run("document.documentElement.scrollWidth") <= size[0]
    finally:
        tab.size(*SIZE)


# What goes wrong ------------------------------------------------------------------------------------


def test_a_tab_that_stalls_disturbs_nobody_and_shows_the_newest_pose_afterwards(browser, tab, server, feed):
    stopped = browser.renderers()
    assert stopped
    for renderer in stopped:
        os.kill(renderer, signal.SIGSTOP)
    try:
        with connect(server.url.replace("http", "ws") + "socket", compression=None) as witness:
            numbers = []
            while len(numbers) < 150:  # more than a page may fall behind
                message = witness.recv(timeout=WAIT_S)
                if isinstance(message, bytes):
                    numbers.append(int.from_bytes(message[12:16], "little"))
                    witness.send(json.dumps({"seen": numbers[-1]}))
        assert numbers == sorted(numbers) and server.process.poll() is None
        feed.show(RAISED)
    finally:
        for renderer in stopped:
            os.kill(renderer, signal.SIGCONT)
    wait_for_pose(tab, RAISED)


def test_a_browser_that_vanishes_leaves_the_server_to_the_others(browser, feed):
    with feeding.Served(feed.folder) as served:
        with connect(served.url.replace("http", "ws") + "socket", compression=None) as witness:

            def pages() -> int:
                while True:
                    message = witness.recv(timeout=WAIT_S)
                    if isinstance(message, bytes):
                        witness.send(json.dumps({"seen": int.from_bytes(message[12:16], "little")}))
                    elif json.loads(message)["type"] == "state":
                        return json.loads(message)["pages"]

            with Browser(require_chromium()) as other:
                other.open(served.url, *SIZE)
                until_s = time.monotonic() + WAIT_S
                while pages() != 2:
                    assert time.monotonic() < until_s
            while pages() != 1:  # the context's end killed it
                assert time.monotonic() < until_s + WAIT_S
        assert served.process.poll() is None


def test_it_connects_again_by_itself_after_the_server_was_restarted(browser, feed):
    first = feeding.Served(feed.folder)
    with browser.open(first.url, *SIZE) as tab:
        wait_for_pose(tab, REST)
        first.end(hard=True)
        tab.wait("document.querySelector('#connection').innerText == 'reconnecting'", WAIT_S)
        feed.show(RAISED)
        with feeding.Served(feed.folder, f"127.0.0.1:{first.port}"):
            tab.wait("document.querySelector('#connection').innerText == 'connected'", WAIT_S)
            wait_for_pose(tab, RAISED)
            assert fleshy(tab.picture("#solid")).mean() > 0.05


def test_the_end_of_the_run_is_told_and_the_next_run_is_shown_at_the_same_address(browser, tmp_path):
    with (
        feeding.Feeder(tmp_path / "first", title="the first") as first,
        feeding.Served(first.folder) as served,
        browser.open(served.url, *SIZE) as tab,
    ):
        wait_for_pose(tab, REST)
        first.close()
        assert served.process.wait(WAIT_S) == 0
        tab.wait("document.querySelector('#connection').innerText == 'run has ended'")
        with feeding.Feeder(tmp_path / "second", title="the second") as second:
            second.show(RAISED)
            with feeding.Served(second.folder, f"127.0.0.1:{served.port}"):
                tab.wait("document.querySelector('#title').innerText == 'the second'", WAIT_S)
                wait_for_pose(tab, RAISED)
