"""The page's server as a real process: what it serves, to whom, and that nobody can spoil it for others."""

import http.client
import json
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import feeding
import numpy as np
import pytest
from strict_page import decoded
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tonguetrack.tracker.cli import main
from tonguetrack.tracker.streams.feed import FeedNumbers
from tonguetrack.tracker.streams.page.protocol import WINDOW
from tonguetrack.tracker.streams.sink import LiveNumbers

WAIT_S = 20.0
PAGE = Path(__file__).resolve().parents[1] / "tracker" / "streams" / "page"
OWN_FILES = ("index.html", "page.css", "page.js", "stream.js", "tongue.js", "solid.js", "section.js")


@pytest.fixture(scope="module")
def control():
    """Where a run would listen for wishes."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(WAIT_S)
        yield listener


@pytest.fixture(scope="module")
def feed(tmp_path_factory, control):
    port = control.getsockname()[1]
    with feeding.Feeder(tmp_path_factory.mktemp("feed"), f"127.0.0.1:{port}", palate=True) as feeder:
        yield feeder


@pytest.fixture(scope="module")
def server(feed):
    with feeding.Served(feed.folder) as served:
        yield served
        assert served.process.poll() is None, "the server did not survive its clients"
        assert served.end() == ""  # and strangers filled nobody's terminal


class Client:
    """A page as far as the server can tell. It tells what it has seen, as long as `honest`."""

    def __init__(self, served, path: str = "socket", honest: bool = True, **options) -> None:
        address = served.url.replace("http:", "ws:").replace("//0.0.0.0", "//127.0.0.1") + path
        self._stack = ExitStack()
        self.socket = self._stack.enter_context(
            connect(
                address, compression=None, open_timeout=WAIT_S, close_timeout=0.2, max_size=2**22, **options
            )
        )
        self.honest = honest

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()

    def next(self, kind: str) -> dict:
        """The next text of this type, or the next "pose"."""
        until_s = time.monotonic() + WAIT_S
        while time.monotonic() < until_s:
            message = self.socket.recv(timeout=WAIT_S)
            if isinstance(message, bytes):
                pose = decoded(message)
                if self.honest:
                    self.say(seen=pose["number"])
                if kind == "pose":
                    return pose
            elif json.loads(message)["type"] == kind:
                return json.loads(message)
        raise AssertionError(f"no {kind}")

    def pose_after(self, sequence: int) -> dict:
        while (pose := self.next("pose"))["sequence"] <= sequence:
            pass
        return pose

    def say(self, **content) -> None:
        self.socket.send(json.dumps(content))

    def closed_with(self) -> int:
        """The code with which the server closes."""
        try:
            until_s = time.monotonic() + WAIT_S
            while time.monotonic() < until_s:
                self.socket.recv(timeout=WAIT_S)
        except ConnectionClosed as closed:
            return closed.rcvd.code if closed.rcvd else 1006
        raise AssertionError("still open")


def get(served, path: str, method: str = "GET", **headers) -> tuple[int, dict, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=WAIT_S)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return found


def goes_on(served) -> None:
    """A page that is opened now is served, and its poses move on."""
    with Client(served) as client:
        first = client.next("pose")["sequence"]
        assert client.pose_after(first + 20)["sequence"] > first + 20


# What is served -------------------------------------------------------------------------------------


def test_the_page_and_all_its_parts_come_from_this_server(server):
    status, headers, body = get(server, "/")
    assert status == 200 and headers["Content-Type"].startswith("text/html")
    assert set(re.findall(r'(?:src|href)="([^"]+)"', body.decode())) == {"data:,", "page.css", "page.js"}
    for name in (*OWN_FILES[1:], "three.bundle.js", "three.license.txt"):
        status, headers, body = get(server, f"/{name}")
        assert status == 200 and body == (PAGE / name).read_bytes()
        assert "javascript" in headers["Content-Type"] or not name.endswith(".js")
        assert (
            headers["X-Content-Type-Options"] == "nosniff"
            and "default-src 'self'" in headers["Content-Security-Policy"]
        )


def test_every_module_that_the_page_imports_is_served(server):
    for name in OWN_FILES:
        for imported in re.findall(r'from "\./([\w.]+)"', (PAGE / name).read_text()):
            assert get(server, f"/{imported}")[0] == 200


def test_the_bundle_exports_what_the_page_imports():
    """three.bundle.js is three.entry.js with everything in it: one names what the other holds."""
    entry = (PAGE / "three.entry.js").read_text()
    exported = set(re.findall(r"\w+", " ".join(re.findall(r"export \{(.*?)\}", entry, re.DOTALL))))
    bundled = re.findall(r"export\{([^}]*)\};?\s*$", (PAGE / "three.bundle.js").read_text())[0]
    assert {part.split(" as ")[-1] for part in bundled.split(",")} == exported
    imported = set()
    for name in OWN_FILES[2:]:
        for names in re.findall(
            r"import \{([^}]*)\} from \"\./three\.bundle\.js\"", (PAGE / name).read_text()
        ):
            imported |= set(re.findall(r"\w+", names))
    assert imported == exported
    assert "MIT License" in (PAGE / "three.license.txt").read_text()


def test_nothing_that_we_wrote_asks_for_anything_from_elsewhere():
    for name in OWN_FILES:
        assert not re.search(r"(?<!xmlns=.)https?://|//cdn|@import", (PAGE / name).read_text()), name


def test_the_model_is_a_binary_gltf_of_the_length_that_it_states(server):
    status, headers, body = get(server, "/model.glb?1")
    assert status == 200 and headers["Content-Type"] == "model/gltf-binary"
    assert body[:4] == b"glTF" and int.from_bytes(body[8:12], "little") == len(body)


@pytest.mark.parametrize(
    "path", ["/nothing", "/../server.py", "/server.py", "/%2e%2e/protocol.py", "//page.js", "/page.js/"]
)
def test_nothing_else_is_served(server, path):
    assert get(server, path)[0] in (403, 404)


@pytest.mark.parametrize("method", ["POST", "PUT", "HEAD", "OPTIONS", "DELETE"])
def test_nothing_can_be_put_there(server, method):
    with suppress(http.client.HTTPException, ConnectionError):  # older versions of websockets hang up
        assert get(server, "/", method)[0] >= 400
    goes_on(server)


def test_a_page_is_told_what_it_must_know_and_then_shown_the_pose(server, feed):
    feed.show([0.5, -1.0, 0.25, 2.0], offset_mm=1.5)
    with Client(server) as client:
        hello = client.next("hello")
        pose = client.pose_after(client.next("pose")["sequence"] + 3)
    mode = feed.model.pose
    np.testing.assert_allclose(hello["coefficients"]["mean"], mode.mean)
    np.testing.assert_allclose(hello["coefficients"]["high"], mode.mean + 5 * mode.sigma)
    assert [coil["role"] for coil in hello["coils"]] == list(feed.roles)
    assert [coil["vertex"] for coil in hello["coils"]] == list(feed.vertices)
    assert hello["title"] == "a test" and "synthetic" in hello["model"]["name"] and len(hello["palate"]) == 9
    np.testing.assert_allclose(pose["weights"], feed.pose.weights, rtol=1e-6)
    np.testing.assert_allclose(pose["coils"], feed.pose.coils, rtol=1e-5)
    assert pose["vertices"] is None and pose["fixed"] and 0 < pose["age_ms"]


def test_a_pose_whose_weights_are_no_numbers_never_reaches_a_page(server, feed):
    feed.show([0.5, 0.0, 0.0, 0.0])
    with Client(server) as client:
        client.next("pose")
        feed.show([np.nan, 0.0, 0.0, 0.0])
        time.sleep(0.3)
        feed.show([1.0, 0.0, 0.0, 0.0])
        while True:
            pose = client.next("pose")
            assert np.isfinite(pose["weights"]).all()
            if np.allclose(pose["weights"], feed.pose.weights, rtol=1e-6):
                break


def test_the_state_tells_what_the_run_says_of_itself(server, feed):
    feed.numbers = FeedNumbers(
        LiveNumbers((1.0, 2.0), (0.1, 0.2), (0.0, 0.1), "/x/take-007.xdf", 250, ""), ("no tip",)
    )
    try:
        with Client(server) as client:
            for _ in range(5):
                state = client.next("state")
                if state["take"]["name"]:
                    break
        assert state["take"] == {"name": "take-007.xdf", "frames": 250, "failure": ""}
        assert state["troubles"] == ["no tip"] and state["latency"]["host_to_solved"] == [0.1, 0.2]
    finally:
        feed.numbers = FeedNumbers()


def test_wishes_arrive_as_the_control_messages_of_the_osc_page(server, control):
    with Client(server) as client:
        for wish, path, words in [
            ({"do": "take", "on": True, "name": "aka 3"}, b"/tongue/control/take", b",ss"),
            ({"do": "take", "on": False}, b"/tongue/control/take", b",s\0"),
            ({"do": "mark", "text": "here"}, b"/tongue/control/marker", b",s\0"),
            ({"do": "speaker", "fix": True}, b"/tongue/control/speaker", b",s\0"),
        ]:
            client.say(**wish)
            datagram = control.recv(2048)
            assert datagram.startswith(path + b"\0") and words in datagram
            assert client.next("told")["what"] == wish["do"]


def test_what_is_no_wish_is_refused_and_passed_on_to_nobody(server, control):
    with Client(server) as client:
        for nonsense in ('{"do": "quit"}', '{"do": "take", "on": true, "name": "../x"}', "no json", "[]"):
            client.socket.send(nonsense)
            assert client.next("refused")["why"]
        client.say(do="mark", text="after the nonsense")
        assert b"after the nonsense" in control.recv(2048)


def test_another_speaker_comes_as_vertices_until_there_is_a_model_of_it(server, feed):
    other = feed.speaker_weights + 0.05
    try:
        with Client(server) as client:
            number = client.next("pose")["model"]
            before = get(server, "/model.glb")[2]
            feed.show([1, 0, 0, 0], speaker_weights=other, fixed=False)
            while (pose := client.next("pose"))["vertices"] is None:
                pass
            expected = feed.model.vertices(other, feed.pose.weights)
            assert not pose["fixed"] and np.abs(pose["vertices"] - expected).max() < 0.002
            assert client.next("model")["number"] == number + 1
            assert get(server, "/model.glb")[2] != before
            while (pose := client.next("pose"))["vertices"] is not None:
                pass
            assert pose["model"] == number + 1
    finally:
        feed.show([0, 0, 0, 0])


# Who is served --------------------------------------------------------------------------------------


def test_a_page_of_somebody_elses_cannot_open_the_socket(server):
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{server.port + 1}"):
        with pytest.raises(InvalidStatus) as refused:
            Client(server, origin=origin)
        assert refused.value.response.status_code == 403
    with Client(server, origin=f"http://127.0.0.1:{server.port}") as client:
        assert client.next("hello")


def test_a_foreign_name_that_leads_to_this_computer_is_not_answered(server):
    for path in ("/", "/model.glb", "/socket"):
        assert get(server, path, Host=f"evil.example:{server.port}")[0] == 403
    assert get(server, "/", Host=f"localhost:{server.port}")[0] == 200


def test_opened_to_a_network_everything_needs_the_token(feed):
    with feeding.Served(feed.folder, "0.0.0.0:0") as served:
        token = served.url.rstrip("/").rpartition("/")[2]
        assert len(token) >= 20 and "0.0.0.0" not in served.url
        for path in (
            "/",
            "/page.js",
            "/model.glb",
            "/socket",
            f"/{token[:-1]}x/",
            f"/{'x' * len(token)}/page.js",
        ):
            assert get(served, path)[0] == 403
        for path in ("", "page.js", "model.glb"):
            assert get(served, f"/{token}/{path}")[0] == 200
        here = f"ws://127.0.0.1:{served.port}"
        with pytest.raises(InvalidStatus), connect(f"{here}/socket"):
            pass
        with pytest.raises(InvalidStatus), connect(f"{here}/{token}/socket", origin="http://evil.example"):
            pass
        with connect(f"{here}/{token}/socket", origin=f"http://127.0.0.1:{served.port}") as client:
            assert json.loads(client.recv(timeout=WAIT_S))["type"] == "hello"


def test_of_a_hundred_pages_32_are_served_and_a_place_that_gets_free_is_taken(server):
    with ExitStack() as stack:
        served, refused = [], []
        for _ in range(100):
            try:
                served.append(stack.enter_context(Client(server)))
            except InvalidStatus as status:
                refused.append(status.response.status_code)
        assert len(served) == 32 and refused == [503] * 68
        first = served[0].next("pose")["sequence"]
        assert served[0].pose_after(first + 20)
        served[-1].socket.close()
        until_s = time.monotonic() + WAIT_S
        while True:
            try:
                stack.enter_context(Client(server)).next("pose")
                break
            except InvalidStatus:
                assert time.monotonic() < until_s
                time.sleep(0.05)


# Hostile clients ------------------------------------------------------------------------------------


def opened(served, receive_bytes: int | None = None) -> socket.socket:
    """A raw connection whose WebSocket handshake is done."""
    plain = socket.socket()
    if receive_bytes:
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_bytes)
    plain.settimeout(WAIT_S)
    plain.connect(("127.0.0.1", served.port))
    plain.sendall(
        f"GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    assert plain.recv(12) == b"HTTP/1.1 101"
    return plain


def closed_by_peer(plain: socket.socket) -> bool:
    """Whether it ends within the time of a stall, and some more."""
    with plain, suppress(ConnectionError):
        while plain.recv(65536):
            pass
    return True


def test_a_page_that_tells_nothing_gets_a_second_of_poses_and_then_the_newest(server):
    with Client(server, honest=False) as client:
        poses = [client.next("pose") for _ in range(WINDOW)]
        sequence = poses[-1]["sequence"]
        with Client(server) as other:
            other.pose_after(sequence + 100)
            client.say(seen=poses[-1]["number"])
            assert client.next("pose")["sequence"] >= sequence + 100


def test_clients_that_stall_are_closed_and_hold_up_nobody(server, feed):
    """All at once: one that never reads, one that reads and never answers, one whose request never ends."""
    feed.show(
        [0, 0, 0, 0], speaker_weights=feed.speaker_weights
    )  # vertices would only fill the buffers sooner
    with ExitStack() as stack:
        deaf = opened(server, receive_bytes=4096)
        mute = opened(server)
        slow = socket.create_connection(("127.0.0.1", server.port), WAIT_S)
        slow.sendall(b"GET / HTTP/1.1\r\nHost: ")
        loading = socket.create_connection(("127.0.0.1", server.port), WAIT_S)
        loading.sendall(f"GET /three.bundle.js HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode())
        stack.callback(loading.close)
        goes_on(server)
        started_s = time.monotonic()
        with Client(server) as witness:
            while witness.next("state")["pages"] != 1:  # all but the witness are gone
                assert time.monotonic() - started_s < WAIT_S
        for plain in (deaf, mute, slow):
            assert closed_by_peer(plain)


def test_a_hundred_requests_that_never_end_keep_no_page_from_loading(server):
    with ExitStack() as stack:
        for _ in range(100):
            plain = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), WAIT_S))
            with suppress(ConnectionError):
                plain.sendall(b"GET /")
        assert get(server, "/")[0] == 200
        goes_on(server)


@pytest.mark.parametrize("seed", range(4))
def test_garbage_in_place_of_a_request_or_of_frames_ends_that_connection_alone(server, seed):
    random = np.random.default_rng(seed)
    with Client(server) as witness:
        first = witness.next("pose")["sequence"]
        plain = socket.create_connection(("127.0.0.1", server.port), WAIT_S)
        plain.sendall(random.bytes(3000) + b"\r\n\r\n")
        assert closed_by_peer(plain)
        plain = opened(server)
        with suppress(ConnectionError):
            plain.sendall(b"\xff" + random.bytes(3000))  # reserved bits: no frame begins so
        assert closed_by_peer(plain)
        assert witness.pose_after(first + 5)
    goes_on(server)


def test_a_frame_that_claims_to_be_huge_is_refused_before_it_has_come(server):
    plain = opened(server)
    plain.sendall(b"\x81\xff" + (2**62).to_bytes(8, "big") + b"mask")
    assert closed_by_peer(plain)
    goes_on(server)


def test_a_message_of_more_than_1_kilobyte_closes_the_connection(server):
    with Client(server) as client:
        client.socket.send("x" * 1025)
        assert client.closed_with() == 1009


def test_bytes_in_place_of_text_close_the_connection(server):
    with Client(server) as client:
        client.socket.send(b"\0\1\2")
        assert client.closed_with() == 1008


def test_a_flood_of_messages_closes_the_connection(server):
    with Client(server) as client:
        with suppress(ConnectionClosed):
            for _ in range(2000):
                client.socket.send('{"seen": 1}')
        assert client.closed_with() == 1008
    goes_on(server)


def test_clients_that_vanish_in_the_middle_of_everything_leave_no_trace(server):
    for _ in range(20):
        plain = opened(server)
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # a reset, not a farewell
        plain.close()
    with Client(server) as witness:
        started_s = time.monotonic()
        while witness.next("state")["pages"] != 1:
            assert time.monotonic() - started_s < WAIT_S


# Beginning and end ----------------------------------------------------------------------------------


def run_server(*arguments: str, before: str = "") -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", before + feeding.SERVER, *arguments],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_a_port_that_is_taken_is_one_sentence_and_exit_code_2(server, feed):
    done = run_server(str(feed.folder), f"127.0.0.1:{server.port}")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "port is in use" in done.stderr and "--web" in done.stderr


def test_a_folder_without_a_feed_is_one_sentence_and_exit_code_2(tmp_path):
    done = run_server(str(tmp_path), "127.0.0.1:0")
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "no feed" in done.stderr


def test_without_websockets_the_extra_is_named(feed):
    done = run_server(
        str(feed.folder), "127.0.0.1:0", before="import sys; sys.modules['websockets'] = None; "
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "tonguetrack[web]" in done.stderr


def test_without_websockets_a_run_says_so_before_it_begins(capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["live", "gone:", "--web", "127.0.0.1:0"]) == 2
    assert (
        capsys.readouterr().err
        == "tonguetrack: the page needs the extra 'web': pip install 'tonguetrack[web]'.\n"
    )


def test_at_the_end_of_the_run_the_pages_are_told_and_the_server_ends(tmp_path):
    with feeding.Feeder(tmp_path / "feed") as feeder, feeding.Served(feeder.folder) as served:
        with Client(served) as client:
            assert client.next("hello")["control"] is False
            client.say(do="mark", text="x")
            assert "no wishes" in client.next("refused")["why"]
            dawdler = socket.create_connection(
                ("127.0.0.1", served.port), WAIT_S
            )  # does not hold it up either
            threading.Thread(target=feeder.close).start()
            assert client.next("over")
        assert served.process.wait(WAIT_S) == 0
        dawdler.close()
        assert served.process.stderr.read() == ""
