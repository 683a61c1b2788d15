"""OSCQuery: the tree as the proposal describes it, whoever asks, and a discovery by a second mDNS client.

https://github.com/Vidvox/OSCQueryProposal, third revision. `strict_node` refuses a node that is not what stands there.
"""

import contextlib
import dataclasses
import http.client
import json
import socket
import struct
import sys
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from streaming import PALATE, ROLES, context, info, model, pose, random_poses

from tonguetrack import InputError
from tonguetrack.tracker.streams import oscquery
from tonguetrack.tracker.streams.addresses import ADDRESSES, CONTROL_FORMS, EXTRA_ADDRESSES
from tonguetrack.tracker.streams.announcing import OWN_NAME
from tonguetrack.tracker.streams.oscquery import MOST_CLIENTS, AddressSpace, OscQueryWorker, find_node
from tonguetrack.tracker.streams.shapes import ShapeMeter
from tonguetrack.tracker.streams.sink import LiveNumbers
from tonguetrack.tracker.streams.slot import SlotSink

PATIENCE_S = 20.0
ATTRIBUTES = {"FULL_PATH", "CONTENTS", "DESCRIPTION", "TYPE", "ACCESS", "VALUE", "RANGE", "UNIT"}
OF_TYPE = {"i": int, "f": (int, float), "s": str}


@contextlib.contextmanager
def served(place="127.0.0.1:0", announced=False, **more):
    """A worker that serves, and its URL. announced: by mDNS, which takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        if not announced:
            patch.setattr(oscquery, "Announcement", lambda *_: None)
        worker = OscQueryWorker(place, context(control="127.0.0.1:9001", **more))
        worker.begin(info())
        try:
            yield worker, f"http://{worker.address}"
        finally:
            worker.end()


def get(url, **headers):
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, answer.headers.get("Content-Type"), answer.read()
    except urllib.error.HTTPError as refused:
        return refused.code, refused.headers.get("Content-Type"), refused.read()


def got(url):
    status, kind, body = get(url)
    assert (status, kind) == (200, "application/json")
    return json.loads(body)


def strict_node(node, path):
    """Checks a node and all below it; returns the methods by their paths."""
    assert set(node) <= ATTRIBUTES, set(node) - ATTRIBUTES
    assert node["FULL_PATH"] == path
    assert node["ACCESS"] in (0, 1, 2, 3)
    found = {}
    if "TYPE" in node:
        assert not set(node["TYPE"]) - set("ifsb")
        assert node["DESCRIPTION"]
        found[path] = node
        count = len(node["TYPE"])
        if "VALUE" in node:
            assert node["ACCESS"] & 1 and len(node["VALUE"]) == count
            for tag, value in zip(node["TYPE"], node["VALUE"], strict=True):
                assert isinstance(value, OF_TYPE[tag]) and not isinstance(value, bool)
        else:
            assert not node["ACCESS"] & 1
        for limits, value in zip(node.get("RANGE", []), node.get("VALUE", []), strict=False):
            assert limits is None or set(limits) <= {"MIN", "MAX", "VALS"}
            assert limits is None or limits["MIN"] <= value <= limits["MAX"]
        assert len(node.get("RANGE", "x" * count)) == len(node.get("UNIT", "x" * count)) == count
    else:
        assert node["ACCESS"] == 0 and node["CONTENTS"]
    for name, child in node.get("CONTENTS", {}).items():
        assert name and "/" not in name
        found |= strict_node(child, f"{path.rstrip('/')}/{name}")
    return found


def single(values):
    return np.float32(values).tolist()


# The tree -------------------------------------------------------------------------------------------


def test_the_whole_tree_has_every_address_of_the_tables():
    with served() as (worker, url):
        worker.work(pose())
        methods = strict_node(got(f"{url}/"), "/")
    names = ShapeMeter(model()).names
    expected = {row.path for row in (*ADDRESSES, *EXTRA_ADDRESSES) if "<" not in row.path}
    expected |= {f"/tongue/{kind}/{k}" for kind in ("pose", "sigma") for k in range(model().pose.size)}
    expected |= {f"/tongue/coil/{role.replace(' ', '_')}" for role in ROLES}
    expected |= {f"/tongue/shape/{name}" for name in names}
    expected |= {f"/tongue/gap/{region}" for region in ("tip", "blade", "front", "body", "back")}
    expected |= {form.path for form in CONTROL_FORMS}
    assert set(methods) == expected


def test_values_are_those_of_the_newest_pose():
    with served() as (worker, url):
        for each in (*random_poses(3), pose(3)):
            worker.work(each)
        newest = pose(3)
        assert got(f"{url}/tongue/pose?VALUE") == {"VALUE": single(newest.weights)}
        assert got(f"{url}/tongue/sigma/2?VALUE") == {"VALUE": single(newest.normalised[2:3])}
        assert got(f"{url}/tongue/frame?VALUE") == {"VALUE": [3, 0.0, 1]}
        assert got(f"{url}/tongue/coil/tongue_blade?VALUE") == {"VALUE": [0.0, 12.0, 8.0]}
        assert got(f"{url}/tongue/coilstates?VALUE") == {"VALUE": [0, 0, 1]}
        assert got(f"{url}/tongue/info")["VALUE"][2] == model().name


def test_a_part_of_the_tree_and_a_single_attribute_can_be_asked_for():
    with served() as (worker, url):
        worker.work(pose())
        methods = strict_node(got(f"{url}/tongue/coil"), "/tongue/coil")
        assert set(methods) == {
            "/tongue/coil/tongue_tip",
            "/tongue/coil/tongue_blade",
            "/tongue/coil/tongue_dorsum",
        }
        assert got(f"{url}/tongue/coil/tongue_tip?UNIT") == {"UNIT": ["distance.mm"] * 3}
        assert got(f"{url}/tongue/frame?TYPE") == {"TYPE": "ifi"}
        assert got(f"{url}/tongue/frame?RANGE") == {"RANGE": [None, None, {"MIN": 0, "MAX": 3}]}
        assert got(f"{url}/tongue/shape/tip_up?RANGE") == {"RANGE": [{"MIN": 0.0, "MAX": 1.0}]}


def test_what_is_not_there_is_told_by_the_status():
    with served() as (worker, url):
        worker.work(pose())
        assert get(f"{url}/nothing")[0] == 404
        assert get(f"{url}/tongue/pose/99")[0] == 404
        assert get(f"{url}/tongue/coil?VALUE")[0] == 204
        assert get(f"{url}/tongue/mesh?VALUE")[0] == 204
        assert get(f"{url}/tongue/pose?COLOUR")[0] == 400


def test_a_missing_coil_has_no_value_and_a_value_when_it_is_back():
    with served() as (worker, url):
        worker.work(pose(0, coils=np.zeros((3, 3))))
        assert got(f"{url}/tongue/coil/tongue_dorsum")["ACCESS"] == 1
        worker.work(pose(1))
        gone = got(f"{url}/tongue/coil/tongue_dorsum")
        assert gone["ACCESS"] == 0 and "VALUE" not in gone


def test_before_the_first_pose_the_tree_is_there_without_its_values():
    with served() as (_, url):
        methods = strict_node(got(f"{url}/"), "/")
    assert "VALUE" not in methods["/tongue/pose"] and methods["/tongue/pose"]["ACCESS"] == 0
    assert methods["/tongue/info"]["VALUE"][0] == "tonguetrack"


def test_control_messages_are_to_be_written_and_their_other_forms_are_described():
    with served() as (_, url):
        take = got(f"{url}/tongue/control/take")
    assert (take["ACCESS"], take["TYPE"]) == (2, "i")
    for form in CONTROL_FORMS:
        if form.path == "/tongue/control/take":
            assert f"{form.type_tags} (" in take["DESCRIPTION"] and form.does in take["DESCRIPTION"]


def test_what_the_run_says_of_itself_is_there_too():
    numbers = LiveNumbers((0.1, 0.2), (0.3, 0.4), (0.5, 0.6), "take.xdf", 7)
    tree = AddressSpace(context(), info()).tree(pose(), 0, numbers)
    assert find_node(tree, "/tongue/take")["VALUE"] == ["take.xdf", 7, ""]
    assert find_node(tree, "/tongue/latency")["VALUE"] == single([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])


def test_a_model_without_shapes_and_a_session_without_a_palate_still_have_a_tree(monkeypatch):
    def refuses(*_):
        raise InputError("no landmarks")

    monkeypatch.setattr("tonguetrack.tracker.streams.osc_more.ShapeMeter", refuses)
    space = AddressSpace(context(None), info())
    methods = strict_node(space.tree(pose(), 0, None), "/")
    assert "VALUE" in methods["/tongue/coil/tongue_tip"]
    assert "VALUE" not in methods["/tongue/shape/tip_up"] and "VALUE" not in methods["/tongue/contact"]


def test_a_number_that_is_none_is_null_and_never_breaks_the_json():
    with served() as (worker, url):
        worker.work(pose(residual_mm=float("inf")))
        assert got(f"{url}/tongue/quality?VALUE")["VALUE"][0] is None


def test_host_info_says_who_answers_and_where_osc_is_taken():
    with served() as (_, url):
        about = got(f"{url}/?HOST_INFO")
        assert about == got(f"{url}/tongue/pose?HOST_INFO")
    assert about["NAME"] == "tonguetrack"
    assert (about["OSC_IP"], about["OSC_PORT"], about["OSC_TRANSPORT"]) == ("127.0.0.1", 9001, "UDP")
    assert set(about["EXTENSIONS"]) <= ATTRIBUTES and all(about["EXTENSIONS"].values())


def test_the_model_is_there_as_gltf():
    with served() as (worker, url):
        worker.work(pose())
        status, kind, body = get(f"{url}/model.glb")
        again = get(f"{url}/model.glb")[2]
    assert (status, kind) == (200, "model/gltf-binary")
    magic, version, length = struct.unpack_from("<4sII", body)
    assert (magic, version, length) == (b"glTF", 2, len(body))
    assert again == body


def test_a_model_that_cannot_be_drawn_is_not_found_and_the_reason_is_told(monkeypatch):
    bare = dataclasses.replace(model(), faces=np.zeros((0, 3), np.int32))
    monkeypatch.setattr(oscquery, "Announcement", lambda *_: None)
    worker = OscQueryWorker("127.0.0.1:0", dataclasses.replace(context(), model=bare))
    worker.begin(info())
    status, _, reason = get(f"http://{worker.address}/model.glb")
    worker.end()
    assert status == 404 and b"without faces" in reason


def test_a_change_of_the_speaker_reaches_the_tree():
    with served() as (worker, url):
        assert got(f"{url}/tongue/info?VALUE")["VALUE"][6] == "fixed"
        worker.begin(info(fixed=False))
        assert got(f"{url}/tongue/info?VALUE")["VALUE"][6] == "free"


# Hostile clients ------------------------------------------------------------------------------------


def connected(worker):
    host, port = worker.address.rsplit(":", 1)
    return socket.create_connection((host, int(port)), timeout=PATIENCE_S)


@pytest.mark.parametrize(
    "garbage",
    [b"", b"\0" * 4000, b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\nx",
     b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n",
     b"GET /%00%ff/../../etc/passwd HTTP/1.1\r\n\r\n", b"GET http://[ HTTP/1.1\r\n\r\n", b"\xff\xfe GET / \r\n\r\n"],
)  # fmt: skip
def test_garbage_is_refused_and_the_next_client_is_answered(garbage):
    with served() as (worker, url):
        with connected(worker) as rude:
            rude.sendall(garbage)
            rude.shutdown(socket.SHUT_WR)
            answer = b""
            with contextlib.suppress(OSError):
                while part := rude.recv(65536):
                    answer += part
        assert not answer.startswith((b"HTTP/1.0 200", b"HTTP/1.1 200"))
        assert got(f"{url}/tongue/pose")["TYPE"] == "f" * model().pose.size


def test_clients_that_say_nothing_are_left_and_do_not_keep_others_out(monkeypatch):
    monkeypatch.setattr(oscquery._Handler, "timeout", 0.2)
    with served() as (worker, url), contextlib.ExitStack() as stack:
        for _ in range(3 * MOST_CLIENTS):
            with contextlib.suppress(OSError):
                stack.enter_context(connected(worker))
        end_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                assert got(f"{url}/tongue/pose")["FULL_PATH"] == "/tongue/pose"
                break
            except (OSError, http.client.HTTPException):  # all places are taken
                assert time.monotonic() < end_s
                time.sleep(0.05)


def test_a_client_that_dribbles_is_left_in_the_end(monkeypatch):
    monkeypatch.setattr(oscquery, "LONGEST_REQUEST_S", 0.3)
    with served() as (worker, _), connected(worker) as slow:
        slow.settimeout(0.05)
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            try:
                slow.sendall(b"G")
                if slow.recv(1) == b"":
                    break
            except TimeoutError:
                continue
            except OSError:
                break
        else:
            raise AssertionError("it was waited for")


@pytest.mark.parametrize(
    ("host", "status"),
    [("localhost:1", 200), ("127.0.0.1", 200), ("[::1]:80", 200), ("OWN:9", 200), ("own", 200),
     ("evil.example", 403), ("evil.local", 403), ("evil.example:80", 403), ("10.0.0.1", 403), ("", 403)],
)  # fmt: skip
def test_a_page_of_a_foreign_site_is_not_answered(host, status):
    host = host.replace("OWN", OWN_NAME).replace("own", OWN_NAME.rstrip("."))
    with served() as (worker, _):
        assert get(f"http://{worker.address}/tongue/pose", Host=host)[0] == status


def test_only_reading_is_possible():
    with served() as (worker, _):
        for method in ("POST", "PUT", "DELETE", "OPTIONS"):
            connection = http.client.HTTPConnection(worker.address, timeout=PATIENCE_S)
            connection.request(method, "/tongue/pose")
            assert connection.getresponse().status == 501
            connection.close()
        connection = http.client.HTTPConnection(worker.address, timeout=PATIENCE_S)
        connection.request("HEAD", "/tongue/pose")
        answer = connection.getresponse()
        assert answer.status == 200 and int(answer.headers["Content-Length"]) > 0 and answer.read() == b""
        connection.close()


def test_many_askers_at_once_all_get_whole_answers_or_none():
    with served() as (worker, url):
        worker.work(pose())
        bodies, lost = [], []

        def ask():
            for _ in range(5):
                try:
                    bodies.append(json.loads(get(f"{url}/")[2]))
                except (OSError, http.client.HTTPException) as reason:
                    lost.append(reason)

        threads = [threading.Thread(target=ask) for _ in range(6)]
        for thread in threads:
            thread.start()
        for number in range(50):
            worker.work(pose(number))
        for thread in threads:
            thread.join(PATIENCE_S)
        assert bodies and all(body["FULL_PATH"] == "/" for body in bodies)
        assert len(bodies) + len(lost) == 30


# Where it listens -----------------------------------------------------------------------------------


def test_a_taken_port_is_an_input_error():
    with served() as (worker, _), pytest.raises(InputError, match="cannot listen there.*port 0 is any"):
        OscQueryWorker(worker.address, context())


def test_the_port_is_free_afterwards():
    with served() as (worker, _):
        pass
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", int(worker.address.rsplit(":", 1)[1])))


def test_behind_a_slot_it_begins_serves_and_ends(monkeypatch):
    monkeypatch.setattr(oscquery, "Announcement", lambda *_: None)
    worker = OscQueryWorker("127.0.0.1:0", context())
    sink = SlotSink(worker, 50.0)
    sink.start(info())
    sink.send(pose(4))
    end_s = time.monotonic() + PATIENCE_S
    while sink.sent == 0 and time.monotonic() < end_s:
        time.sleep(0.01)
    assert got(f"http://{worker.address}/tongue/pose?VALUE") == {"VALUE": single(pose(4).weights)}
    about = got(f"http://{worker.address}/?HOST_INFO")
    assert "OSC_PORT" not in about  # nobody takes control messages
    sink.close()
    assert sink.failure == ""


# Discovery ------------------------------------------------------------------------------------------


def test_a_second_mdns_client_on_this_computer_finds_both_services():
    zeroconf = pytest.importorskip("zeroconf", reason="needs the extra 'discovery'")
    with served(announced=True) as (worker, _):
        assert worker.announcement.announced.wait(PATIENCE_S)
        port = int(worker.address.rsplit(":", 1)[1])
        with zeroconf.Zeroconf(interfaces=["127.0.0.1"]) as other:
            assert ("127.0.0.1", port) in found_services(zeroconf, other, "_oscjson._tcp.local.", port)
            assert ("127.0.0.1", 9001) in found_services(zeroconf, other, "_osc._udp.local.", 9001)


def found_services(zeroconf, network, kind, port):
    """(address, port) of what calls itself tonguetrack, until the one with this port is among them."""
    found = []

    def change(zeroconf, service_type, name, state_change):
        if name.startswith("tonguetrack") and "Added" in str(state_change):
            names.append(name)

    names = []
    browser = zeroconf.ServiceBrowser(network, kind, handlers=[change])
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s and port not in [each for _, each in found]:
        while names:
            service = network.get_service_info(kind, names.pop(), timeout=3000)
            if service is not None:
                found += [(address, service.port) for address in service.parsed_addresses()]
        time.sleep(0.05)
    browser.cancel()
    return found


def test_without_zeroconf_it_serves_and_says_why_nobody_finds_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "zeroconf", None)  # as if it could not be imported
    said = []
    worker = OscQueryWorker("127.0.0.1:0", context(), said=said.append)
    worker.begin(info())
    assert got(f"http://{worker.address}/tongue/pose")["TYPE"] == "f" * model().pose.size
    worker.end()
    assert said == [
        "OSCQuery is not announced: that needs the extra 'discovery': pip install 'tonguetrack[discovery]'"
    ]


def test_palates_of_the_session_are_used():
    tree = AddressSpace(context(PALATE), info()).tree(pose(), 0, None)
    assert find_node(tree, "/tongue/contact")["ACCESS"] == 1
