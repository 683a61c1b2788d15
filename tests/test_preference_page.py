"""The preference test's page: what its server tells to whom, that choices outlive it, and the page in a real Chromium."""

import http.client
import json
import os
import queue
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from browser import Browser
from displays import require_chromium
from preferring import small_test

from tonguetrack import InputError
from tonguetrack.model.mri.preference import FINAL, INITIAL, load_test, picture_bytes
from tonguetrack.model.mri.preferenceanswers import all_sittings, known_sitting
from tonguetrack.model.mri.preferencetally import tally
from tonguetrack.tracker.preferenceserver import MAX_BODY_BYTES, MAX_CONNECTIONS, PreferenceServer

pytest.importorskip("PIL.Image")
WAIT_S = 20.0
PAGE = Path(__file__).resolve().parents[1] / "tracker" / "preferencepage"
JSON = {"Content-Type": "application/json"}
CONTOUR = (0xFF, 0xB5, 0x2E)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Five or six slices in each of two partitions."""
    return small_test(tmp_path_factory.mktemp("preference") / "test")


@pytest.fixture
def test(made, tmp_path):
    shutil.copytree(made.folder, tmp_path / "test")
    return load_test(tmp_path / "test")


@contextmanager
def served(test, address="127.0.0.1:0", **options):
    with PreferenceServer(test, address, **options) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join(WAIT_S)


@pytest.fixture
def server(test):
    with served(test) as server:
        yield server


def request(server, method, path, body=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=WAIT_S)
    connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return found


def get(server, path, **headers):
    return request(server, "GET", server.door.prefix + path, **headers)


def post(server, path, content, **headers):
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    return request(server, "POST", server.door.prefix + path, body, **{**JSON, **headers})


def begin(server, name="Anna"):
    status, _, body = post(server, "begin", {"participant": name})
    assert status == 200, body
    return json.loads(body)


def item(server, place, name="Anna"):
    status, _, body = get(server, f"item?participant={name}&place={place}")
    assert status == 200, body
    return json.loads(body)


def choose(server, place, side, name="Anna"):
    return post(server, "choose", {"participant": name, "place": place, "side": side})


def extent(lines):
    """mm across a contour; the final ball is 18 mm wide, the initial one 22."""
    return float(np.ptp(np.vstack([np.array(line) for line in lines]), axis=0)[0])


# What is served -------------------------------------------------------------------------------------


def test_the_page_and_all_its_parts_come_from_this_server(server):
    status, headers, body = get(server, "")
    assert status == 200 and headers["Content-Type"].startswith("text/html")
    assert set(re.findall(r'(?:src|href)="([^"]+)"', body.decode())) == {"data:,", "page.css", "page.js"}
    for name in ("page.css", "page.js"):
        status, headers, body = get(server, name)
        assert status == 200 and body == (PAGE / name).read_bytes()
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        assert not re.search(rb"https?://|@import", body)


@pytest.mark.parametrize(
    "path", ["nothing", "test.json", "../test.json", "%2e%2e/test.json", "pictures/0001.png", "answers/"]
)
def test_nothing_else_is_served(server, path):
    assert get(server, path)[0] == 404


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "HEAD", "PATCH"])
def test_other_methods_are_refused(server, method):
    assert request(server, method, "/")[0] == 501


def test_every_slice_comes_with_both_contours_and_the_side_that_is_chosen_is_kept(server, test):
    told = begin(server)
    assert told["participant"] == "Anna" and told["choices"] == [None] * len(
        test.partition(told["partition"])
    )
    sitting = known_sitting(test, "Anna")
    for place, shown in enumerate(sitting.shown):
        found = item(server, place)
        widths = {side: extent(found[side]) for side in ("left", "right")}
        assert widths[shown.side(FINAL)] == pytest.approx(18, abs=0.2)
        assert widths[shown.side(INITIAL)] == pytest.approx(22, abs=0.2)
        _, headers, body = get(server, f"picture?participant=Anna&place={place}")
        assert headers["Content-Type"] == "image/png" and body == picture_bytes(test, test.items[shown.item])
        narrow = min(widths, key=widths.get)
        assert json.loads(choose(server, place, narrow)[2]) == {"answered": place + 1}
    assert set(known_sitting(test, "Anna").chosen.values()) == {FINAL}
    assert tally(test).overall.share == 1.0


def test_what_a_page_is_told_never_says_which_method_is_which(server, test):
    everything = [get(server, "about"), post(server, "begin", {"participant": "Anna"})]
    for place in range(len(known_sitting(test, "Anna").shown)):
        everything += [get(server, f"{what}?participant=Anna&place={place}") for what in ("item", "picture")]
        everything.append(choose(server, place, "left"))
    for status, headers, body in everything:
        assert status == 200
        said = (json.dumps(headers).encode() + body).lower()
        assert not re.search(rb"initial|final|bootstrap|method|speaker0|\.png", said), said[:300]
    left = {shown.left for shown in known_sitting(test, "Anna").shown}
    assert left == {INITIAL, FINAL}


def test_a_choice_can_be_changed_and_the_last_one_counts(server, test):
    begin(server)
    for side in ("left", "right", "left", "right"):
        assert choose(server, 2, side)[0] == 200
    assert begin(server)["choices"][2] == "right"
    sitting = known_sitting(test, "Anna")
    assert sitting.chosen == {2: sitting.shown[2].method("right")}


def test_several_participants_do_not_disturb_each_other(server, test):
    names = [f"P{n}" for n in range(8)]

    def judge(name):
        for place in range(len(begin(server, name)["choices"])):
            assert choose(server, place, "left", name)[0] == 200

    threads = [threading.Thread(target=judge, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    sittings = all_sittings(test)
    assert [sitting.participant for sitting in sittings] == names
    assert all(len(sitting.chosen) == len(sitting.shown) for sitting in sittings)
    assert sorted(sitting.partition for sitting in sittings) == [1] * 4 + [2] * 4


def test_the_partition_and_the_participant_can_be_fixed(test):
    with served(test, partition=2) as server:
        assert begin(server, "Anna")["partition"] == begin(server, "Bert")["partition"] == 2
    with served(test, participant="Carla") as server:
        assert json.loads(get(server, "about")[2])["participant"] == "Carla"
        assert begin(server, "carla")["participant"] == "Carla"
        assert post(server, "begin", {"participant": "Dora"})[0] == 403
        assert choose(server, 0, "left", "Anna")[0] == 403
    assert {sitting.participant for sitting in all_sittings(test)} == {"Anna", "Bert", "Carla"}


def test_a_partition_that_another_participant_cannot_have_is_told(test):
    with served(test, partition=1) as server:
        begin(server)
    with (
        pytest.raises(InputError, match="Anna has begun with partition 1"),
        served(test, partition=2, participant="Anna"),
    ):
        pass


def test_an_address_that_is_taken_is_one_sentence(server, test):
    with pytest.raises(InputError, match="in use by another program.*--host"):
        PreferenceServer(test, f"127.0.0.1:{server.server_address[1]}")


# Who is served --------------------------------------------------------------------------------------


def test_pages_of_somebody_elses_are_not_answered(server, test):
    own = f"http://127.0.0.1:{server.server_address[1]}"
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        assert post(server, "begin", {"participant": "Anna"}, Origin=origin)[0] == 403
        assert get(server, "about", Origin=origin)[0] == 403
    for name in ("evil.example", f"evil.example:{server.server_address[1]}"):
        assert get(server, "", Host=name)[0] == 403
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
        assert request(server, "POST", "/begin", b'{"participant": "Anna"}', Content_Type=kind)[0] == 415
    assert post(server, "begin", {"participant": "Bert"}, Origin=own)[0] == 200


def test_opened_to_a_network_everything_needs_the_token(test):
    with served(test, "0.0.0.0:0") as server:
        token = server.url.rstrip("/").rpartition("/")[2]
        assert len(token) >= 20 and "0.0.0.0" not in server.url
        body = b'{"participant": "Eve"}'
        for prefix in ("/", f"/{token[:-1]}x/", f"/{'x' * len(token)}/"):
            assert request(server, "GET", prefix)[0] == request(server, "GET", prefix + "about")[0] == 403
            assert request(server, "POST", prefix + "begin", body, **JSON)[0] == 403
        assert not all_sittings(test)
        assert get(server, "page.js")[0] == 200 and begin(server)["participant"] == "Anna"


# Hostile clients ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "content", "status"),
    [
        ("begin", b"", 400),
        ("begin", b"\xff\xfe", 400),
        ("begin", b"[" * 2000, 400),
        ("begin", [], 400),
        ("begin", {"participant": 7}, 400),
        ("begin", {"participant": ""}, 409),
        ("begin", {"participant": "x" * 100}, 409),
        ("begin", b"x" * (MAX_BODY_BYTES + 1), 413),
        ("choose", {"participant": "Anna", "place": 0}, 400),
        ("choose", {"participant": "Anna", "place": "0", "side": "left"}, 400),
        ("choose", {"participant": "Anna", "place": True, "side": "left"}, 400),
        ("choose", {"participant": "Anna", "place": 0, "side": "final"}, 400),
        ("choose", {"participant": "Anna", "place": 99, "side": "left"}, 404),
        ("choose", {"participant": "Anna", "place": -1, "side": "left"}, 404),
        ("choose", {"participant": "Nobody", "place": 0, "side": "left"}, 404),
        ("item", {"participant": "Anna"}, 404),
    ],
)
def test_what_is_no_choice_is_refused_and_changes_nothing(server, test, path, content, status):
    begin(server)
    before = known_sitting(test, "Anna")
    assert post(server, path, content)[0] == status
    assert all_sittings(test) == [before]
    assert choose(server, 0, "left")[0] == 200


@pytest.mark.parametrize("place", ["", "-1", "99", "1e3", "9" * 5000, "²"])
def test_places_that_are_not_there_are_refused(server, place):
    begin(server)
    for what in ("item", "picture"):
        assert get(server, f"{what}?{urlencode({'participant': 'Anna', 'place': place})}")[0] in (400, 404)
    assert get(server, "item?" + "&".join(["participant=Anna"] * 500))[0] == 400


def test_a_body_that_never_comes_and_one_of_stated_gigabytes_hold_nobody_up(server):
    port = server.server_address[1]
    head = f"POST /begin HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Type: application/json\r\n"
    with ExitStack() as stack:
        for length in ("100", "9999999999999", "-5", "x"):
            client = stack.enter_context(socket.create_connection(("127.0.0.1", port), WAIT_S))
            client.sendall(f"{head}Content-Length: {length}\r\n\r\n".encode())
            if length != "100":
                assert re.match(rb"HTTP/1.. 41[13] ", client.recv(100))
        assert begin(server)["participant"] == "Anna"


def test_a_hundred_connections_that_dawdle_keep_nobody_out(server):
    with ExitStack() as stack:
        idle = [
            stack.enter_context(socket.create_connection(("127.0.0.1", server.server_address[1]), WAIT_S))
            for _ in range(100)
        ]
        assert begin(server)["participant"] == "Anna"
        idle[0].settimeout(WAIT_S)
        assert idle[0].recv(10) == b""  # the oldest made way
        until_s = time.monotonic() + WAIT_S
        while threading.active_count() > MAX_CONNECTIONS + 20:
            assert time.monotonic() < until_s
            time.sleep(0.02)


def test_random_bytes_do_not_end_it(server, capfd):
    random = np.random.default_rng(11)
    for _ in range(30):
        with socket.create_connection(("127.0.0.1", server.server_address[1]), WAIT_S) as client:
            client.sendall(random.bytes(int(random.integers(1, 3000))) + b"\r\n\r\n")
    assert begin(server)["participant"] == "Anna"
    assert capfd.readouterr().err == ""


# The command ----------------------------------------------------------------------------------------


class Command:
    """`tonguetrack mri preference serve` as a process; url: what it said."""

    def __init__(self, folder, *options):
        self.process = subprocess.Popen(
            [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())",
             "mri", "preference", "serve", str(folder), "--host", "127.0.0.1:0", *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        lines = queue.SimpleQueue()
        threading.Thread(target=lambda: lines.put(self.process.stdout.readline()), daemon=True).start()
        line = lines.get(timeout=60)
        assert line.startswith("page: http://127.0.0.1:"), line + self.process.stderr.read()
        self.server_address = ("127.0.0.1", int(line.split(":")[3].strip("/\n")))
        self.door = type("Door", (), {"prefix": "/"})

    def end(self, signal_name):
        """Its exit code and what it said on stderr."""
        import signal

        self.process.send_signal(getattr(signal, signal_name))
        said = self.process.communicate(timeout=WAIT_S)[1]
        return self.process.returncode, said


def test_killed_in_the_middle_it_has_lost_nothing_and_goes_on_where_it_stopped(test):
    command = Command(test.folder, "--participant", "Anna")
    begin(command)
    for place in range(3):
        assert choose(command, place, "left")[0] == 200
    command.end("SIGKILL")
    assert len(known_sitting(test, "Anna").chosen) == 3
    again = Command(test.folder)
    assert begin(again)["choices"][:4] == ["left", "left", "left", None]
    assert choose(again, 3, "right")[0] == 200
    code, said = again.end("SIGINT")
    assert code == 0 and "  Anna: 4 of " in said and "Traceback" not in said
    assert len(known_sitting(test, "Anna").chosen) == 4


# The page -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser():
    with Browser(require_chromium()) as opened:
        yield opened


@pytest.fixture
def tab(browser, server):
    with browser.open(server.url, 1200, 640) as opened:
        opened.wait("document.querySelector('#name') && !document.querySelector('#welcome').hidden")
        yield opened
        assert opened.complaints == []


READY = "!document.querySelector('#judging').hidden && !document.querySelector('.waiting')"


def started(tab, name="Anna"):
    tab.type("#name", name)
    tab.click("#begin button")
    tab.wait(READY)


def press(tab, key):
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)


def at_slice(tab, number):
    tab.wait(f"document.querySelector('#count').innerText.includes('slice {number} of') && {READY}")


def contour_mask(tab, place):
    """(h, w) bool: where the line is drawn."""
    return np.abs(tab.picture(place).astype(int) - CONTOUR).max(axis=2) < 30


def test_the_page_asks_for_a_name_and_shows_the_plain_slice_between_the_two(tab):
    assert "nobody was scanned" in tab.text("#welcome")  # for the balls are synthetic
    assert not tab.run("document.querySelector('.synthetic').hidden")
    started(tab)
    assert tab.text("h1:not([hidden])") and "Which contour follows the tongue's surface better?" in tab.text(
        "#judging"
    )
    places = {
        name: tab.run(f"document.querySelector('#{name}').getBoundingClientRect().x")
        for name in ("left", "plain", "right")
    }
    assert places["left"] < places["plain"] < places["right"]
    assert not contour_mask(tab, "#plain").any()
    widths = sorted(np.ptp(np.argwhere(contour_mask(tab, side))[:, 1]) for side in ("#left", "#right"))
    assert widths[1] / widths[0] == pytest.approx(11 / 9, abs=0.03)  # circles of 11 and 9 mm
    plain = tab.picture("#plain svg").astype(int)
    for side in ("#left", "#right"):
        other = tab.picture(f"{side} svg").astype(int)
        same = (
            np.abs(plain[: len(other), : other.shape[1]] - other[: len(plain), : plain.shape[1]]).max(axis=2)
            < 40
        )
        assert same.mean() > 0.9  # the same slice below the line


def test_the_contour_of_the_true_size_lies_on_the_edge_of_the_ball(tab, test):
    started(tab)
    sitting = known_sitting(test, "Anna")
    side = sitting.shown[0].side(FINAL)
    bright = tab.picture("#plain svg").astype(int).min(axis=2) > 110
    picture = tab.picture(f"#{side} svg").astype(int)
    line = np.argwhere(np.abs(picture - CONTOUR).max(axis=2) < 40)
    near = np.array([bright[max(y - 8, 0) : y + 9, max(x - 8, 0) : x + 9].mean() for y, x in line])
    assert 0.2 < np.median(near) < 0.8  # half within, half without
    assert ((near > 0.02) & (near < 0.98)).mean() > 0.97


def test_arrow_keys_choose_and_the_end_is_told(tab, test):
    started(tab)
    total = len(known_sitting(test, "Anna").shown)
    for place in range(total):
        at_slice(tab, place + 1)
        assert tab.run("document.querySelector('#progress').value") == place
        press(tab, "ArrowLeft" if place % 2 else "ArrowRight")
    tab.wait("!document.querySelector('#done').hidden")
    assert f"all {total} slices" in tab.text("#done")
    sitting = known_sitting(test, "Anna")
    chosen = [sitting.shown[place].side(method) for place, method in sorted(sitting.chosen.items())]
    assert chosen == ["left" if place % 2 else "right" for place in range(total)]


def test_clicks_choose_backspace_goes_back_and_enter_keeps_the_choice(tab, test):
    started(tab)
    tab.click("#left")
    at_slice(tab, 2)
    press(tab, "Enter")  # nothing is chosen here yet
    press(tab, "Backspace")
    at_slice(tab, 1)
    assert tab.run("document.querySelector('#left').getAttribute('aria-pressed')") == "true"
    press(tab, "Enter")
    at_slice(tab, 2)
    tab.click("#back")
    at_slice(tab, 1)
    tab.click("#right")
    at_slice(tab, 2)
    sitting = known_sitting(test, "Anna")
    assert sitting.chosen == {0: sitting.shown[0].method("right")}


def test_space_hides_the_contours_as_long_as_it_is_held(tab):
    started(tab)
    before = contour_mask(tab, "#left").sum()
    tab.call("Input.dispatchKeyEvent", type="keyDown", key=" ", code="Space")
    assert not contour_mask(tab, "#left").any() and not contour_mask(tab, "#right").any() and before > 200
    tab.call("Input.dispatchKeyEvent", type="keyUp", key=" ", code="Space")
    assert contour_mask(tab, "#left").sum() == before


def test_the_wheel_shows_the_same_part_of_all_three_slices_closer(tab):
    started(tab)

    def views():
        return {
            tuple(float(number) for number in box.split())
            for box in tab.run(
                "[...document.querySelectorAll('svg')].map(svg => svg.getAttribute('viewBox'))"
            )
        }

    (whole,) = views()
    x, y = tab.run(
        "(b => [b.x + b.width / 4, b.y + b.height / 2])(document.querySelector('#right svg').getBoundingClientRect())"
    )
    for delta, count in ((-100, 3), (100, 9)):
        for _ in range(count):
            tab.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=delta)
        tab.run("new Promise(done => setTimeout(done, 200))")
        (view,) = views()
        if delta < 0:
            assert view[2] < 0.7 * whole[2] and view[3] / view[2] == pytest.approx(whole[3] / whole[2])
            # What is below the pointer, a quarter from the left, stays there.
            assert view[0] + view[2] / 4 == pytest.approx(whole[2] / 4, abs=0.3)
    assert view == pytest.approx(whole)


def test_a_reloaded_page_goes_on_where_it_was(tab):
    started(tab, "Zoë")
    press(tab, "ArrowLeft")
    at_slice(tab, 2)
    tab.call("Page.reload")
    time.sleep(0.2)
    tab.wait("document.querySelector('#count')?.innerText.startsWith('Zoë: slice 2 of')")


def test_a_choice_that_cannot_be_kept_is_told_and_the_page_stays(browser, test):
    with served(test) as server, browser.open(server.url, 1200, 640) as tab:
        tab.wait("document.querySelector('#name') && !document.querySelector('#welcome').hidden")
        started(tab)
        (path,) = (test.folder / "answers").iterdir()
        shutil.move(test.folder / "answers", test.folder / "gone")
        press(tab, "ArrowLeft")
        tab.wait("!document.querySelector('#trouble').hidden")
        assert "slice 1 of" in tab.text("#count")
        shutil.move(test.folder / "gone", test.folder / "answers")
        press(tab, "ArrowLeft")
        at_slice(tab, 2)
        assert tab.run("document.querySelector('#trouble').hidden")
        server.shutdown()
        server.server_close()
        press(tab, "ArrowLeft")
        tab.wait("!document.querySelector('#trouble').hidden")
        assert "does not answer" in tab.text("#trouble") and "slice 2 of" in tab.text("#count")
    assert len(known_sitting(test, "Anna").chosen) == 1 and path.is_file()


@pytest.mark.parametrize(("width", "height"), [(1600, 900), (700, 1000), (900, 400), (1180, 820)])
def test_all_three_slices_fit_every_screen(tab, width, height):
    started(tab)
    tab.size(width, height)
    tab.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")
    for name in ("left", "plain", "right", "back", "next"):
        x, y, right, bottom = tab.run(
            f"(b => [b.left, b.top, b.right, b.bottom])(document.querySelector('#{name}').getBoundingClientRect())"
        )
        assert x >= 0 and y >= 0 and right <= width and bottom <= height, name
    sizes = [
        tab.run(f"(b => [b.width, b.height])(document.querySelector('#{name} svg').getBoundingClientRect())")
        for name in ("left", "plain", "right")
    ]
    assert min(min(size) for size in sizes) > 120 and np.ptp(sizes, axis=0).max() < 10
