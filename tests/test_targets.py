"""Targets as a user names them: what each means, what is refused, and that what was named is what is sent."""

import socket
import time

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.cli.outputs import check_each_once
from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams.monitor import decode
from tonguetrack.tracker.streams.sink import LiveNumbers, StreamContext, StreamInfo
from tonguetrack.tracker.streams.targets import KINDS, open_target, parse_target

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def model():
    return bundled_model()


def info_of(model):
    return StreamInfo(
        model.name, model.fingerprint, model.vertex_count, model.pose.mean, model.pose.sigma, model.speaker.mean, True,
        ("tip", "dorsum"), 250.0,
    )  # fmt: skip


def pose_of(model, number=0):
    return TrackedPose(
        model.pose.mean + model.pose.sigma, np.ones(model.pose.size), model.speaker.mean.copy(), np.full(2, 0.5), 0.5,
        1.0, 2, PoseStatus.OK, number / 250.0, number, 0, 0, True, np.zeros(2, np.int64), np.full((2, 3), 1.5),
    )  # fmt: skip


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**20)
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(PATIENCE_S)
        yield opened


# What a target means ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "destination", "rate_hz"),
    [
        ("osc://127.0.0.1:9000", "127.0.0.1:9000", None),
        ("osc://127.0.0.1", "127.0.0.1:9000", None),
        ("OSC://127.0.0.1:7000?rate=30", "127.0.0.1:7000", 30.0),
        ("vmc:", "127.0.0.1:39540", 60.0),
        ("vmc://", "127.0.0.1:39540", 60.0),
        ("vmc://127.0.0.2", "127.0.0.2:39540", 60.0),
        ("vmc://127.0.0.1:39539/?rate=0", "127.0.0.1:39539", None),
        ("vrchat://127.0.0.1:9000", "127.0.0.1:9000", 60.0),
        (" vrchat: ", "127.0.0.1:9000", 60.0),
        ("json:", "127.0.0.1:1235", None),
        ("json://[::1]:99", "[::1]:99", None),
        ("json://[::1]", "[::1]:1235", None),
        ("oscquery:", "127.0.0.1:9002", 20.0),
    ],
)
def test_where_to_and_how_often(text, destination, rate_hz):
    target = parse_target(text)
    assert (target.destination, target.rate_hz) == (destination, rate_hz)
    assert target.kind.scheme == text.strip().partition(":")[0].lower()


def test_a_lab_stream_has_a_name_and_every_frame():
    target = parse_target("lsl:my%20tongue")
    assert (target.name, target.rate_hz) == ("my tongue", None)
    assert parse_target("lsl://tongue?rate=100").rate_hz == 100.0


def test_the_usual_vocabulary_of_each_receiver_and_another_one():
    assert parse_target("vmc:").preset == "arkit"
    assert parse_target("vrchat:").preset == "unified"
    assert parse_target("vmc:?preset=own").preset == "own"
    assert parse_target("osc:").preset == parse_target("json:").preset == ""


def test_a_filter_and_what_else_is_sent():
    target = parse_target("osc://127.0.0.1:9000?filter=1.5,0.25&send=coils,mesh,coils")
    assert target.one_euro == (1.5, 0.25)
    assert target.send == ("coils", "mesh")
    assert parse_target("osc:").one_euro is None and parse_target("osc:").send == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "this is no target; expected one of osc://HOST:PORT, vmc://"),
        ("127.0.0.1:9000", "this is no target"),
        ("vmc", "this is no target"),
        ("ftp://127.0.0.1:21", "this is no target"),
        ("osc:" + "/" * 5000, "this is no target"),
        ("osc://a\nb:9", "this is no target"),
        ("osc:127.0.0.1:9000", "expected osc://HOST:PORT"),
        ("osc://127.0.0.1:0", "the port '0'"),
        ("osc://127.0.0.1:99999", "the port '99999'"),
        ("osc://127.0.0.1:9000/more", "the port '9000/more'"),
        ("osc://::1:9000", "stands in brackets"),
        ("osc://no such host:9000", "expected HOST:PORT"),
        ("osc://nobody.invalid:9000", "'nobody.invalid' is not known"),
        ("lsl:", "expected a name for the stream"),
        ("lsl:%00", "expected a name for the stream"),
        ("lsl:" + "x" * 101, "expected a name for the stream"),
        ("vmc:?rate", "after the ? stand options"),
        ("vmc:?rate=30&rate=40", "stands there twice"),
        ("vmc:?speed=30", "vmc has no option 'speed'; expected rate, filter, preset"),
        ("json:?preset=arkit", "json has no option 'preset'"),
        ("lsl:x?filter=1,1", "lsl has no option 'filter'"),
        ("oscquery:?rate=1", "oscquery has no option 'rate'; it has none"),
        ("vmc:?" + "&".join(f"o{k}=1" for k in range(50)), "after the ? stand options"),
        ("vmc:?rate=-1", "rate=-1"),
        ("vmc:?rate=nan", "rate=nan"),
        ("vmc:?rate=1e9", "rate=1e9"),
        ("vmc:?filter=1", "filter=1: expected two numbers"),
        ("vmc:?filter=0,1", "filter=0,1: "),
        ("vmc:?filter=nan,1", "filter=nan,1: "),
        ("vmc:?filter=1,inf", "filter=1,inf: "),
        ("vmc:?preset=nothing", "there is no such preset"),
        ("vmc:?preset=nothing.toml", "there is no such preset file"),
        ("osc:?send=smell", "send=smell is not known; expected some of coils"),
    ],
)
def test_what_is_no_target_is_refused_in_one_sentence(text, words):
    with pytest.raises(InputError) as refusal:
        parse_target(text)
    assert words in str(refusal.value)
    assert str(refusal.value).endswith(".") and "\n" not in str(refusal.value)


def test_the_command_refuses_a_wrong_target_before_anything_is_compiled(capsys):
    assert main(["demo", "--to", "vmc://127.0.0.1:1?rate=often"]) == 2
    told = capsys.readouterr().err
    assert (
        told.startswith("tonguetrack: 'vmc://127.0.0.1:1?rate=often': rate=often should be")
        and told.count("\n") == 1
    )


# What is sent -------------------------------------------------------------------------------------------


def received(model, receiver, scheme, query="", poses=1, **context):
    """The first datagram for a pose through an open target."""
    target = parse_target(f"{scheme}://127.0.0.1:{receiver.getsockname()[1]}{query}")
    sinks = open_target(target, StreamContext(model, **context), LiveNumbers)
    try:
        for sink in sinks:
            sink.start(info_of(model))
        for number in range(poses):
            for sink in sinks:
                sink.send(pose_of(model, number))
        return receiver.recv(4096), sinks
    finally:
        for sink in sinks:
            sink.close()


def test_our_own_osc_starts_with_its_info_and_sends_in_the_loops_thread(model, receiver):
    datagram, (sink,) = received(model, receiver, "osc")
    assert "/tongue/info" in dict(decode(datagram))
    assert dict(decode(receiver.recv(4096)))["/tongue/frame"] == [0, 0.0, 1]
    assert (sink.sent, sink.dropped) == (1, 0)


def test_our_own_osc_at_a_rate_counts_what_it_sends_without_gaps(model, receiver):
    target = parse_target(f"osc://127.0.0.1:{receiver.getsockname()[1]}?rate=40")
    (sink,) = open_target(target, StreamContext(model), LiveNumbers)
    sink.start(info_of(model))
    begin_s, number = time.perf_counter(), 0
    while time.perf_counter() - begin_s < 0.5:
        sink.send(pose_of(model, number))
        number += 1
        time.sleep(0.004)
    sink.close()
    took_s = time.perf_counter() - begin_s
    frames = []
    while len(frames) < sink.sent:
        frames += [values[0] for path, values in decode(receiver.recv(4096)) if path == "/tongue/frame"]
    assert frames == list(range(sink.sent))
    assert 2 <= sink.sent <= 40 * took_s + 2 < number


def test_what_else_is_asked_for_comes_beside_the_stream(model, receiver):
    _, sinks = received(model, receiver, "osc", "?send=coils")
    assert len(sinks) == 2
    paths = set()
    while "/tongue/coil/dorsum" not in paths:
        paths |= {path for path, _ in decode(receiver.recv(4096))}
    assert {"/tongue/info", "/tongue/frame", "/tongue/coil/tip"} <= paths | {"/tongue/info"}


@pytest.mark.parametrize(
    ("scheme", "query", "expected"),
    [
        ("vmc", "", b"/VMC/Ext/Blend/Val"),
        ("vmc", "?preset=a2f16", b"tongueTipUp"),
        ("vrchat", "", b"/avatar/parameters/v2/TongueOut"),
        ("json", "", b'"phonemeWeights"'),
    ],
)
def test_each_protocol_is_spoken_to_its_target(model, receiver, scheme, query, expected):
    datagram, (sink,) = received(model, receiver, scheme, query)
    assert expected in datagram
    assert sink.destination.startswith(f"{scheme} 127.0.0.1:")


def test_the_filter_is_in_the_stream_and_nowhere_else(model, receiver):
    import json

    target = parse_target(f"json://127.0.0.1:{receiver.getsockname()[1]}?filter=1,0")
    (sink,) = open_target(target, StreamContext(model))
    sink.start(info_of(model))
    rest, jump = pose_of(model, 0), pose_of(model, 1)
    rest.normalised[:] = 0.0
    sent = []
    for pose in (rest, jump):
        kept = pose.copy()
        sink.send(pose)
        sent.append(json.loads(receiver.recv(4096))["phonemeWeights"])
        np.testing.assert_array_equal(pose.weights, kept.weights)
    sink.close()
    moved = (np.array(sent[1]) - model.pose.mean) / model.pose.sigma
    assert (0.0 < moved).all() and (moved < 0.1).all(), "a jump of one sigma in 4 ms is held back by 1 Hz"


def test_every_kind_says_what_it_is():
    assert len({kind.scheme for kind in KINDS}) == len(KINDS)
    for kind in KINDS:
        assert kind.form.startswith(f"{kind.scheme}:") and kind.words
        assert all(words for words in kind.options.values())


@pytest.mark.parametrize(
    "flags",
    [
        ["--to", "vmc://127.0.0.1", "--to", "vmc://127.0.0.1:39540?rate=30"],
        ["--to", "lsl:tongue", "--to", "lsl:tongue"],
        ["--to", "osc://127.0.0.1:9000?send=mesh", "--osc", "127.0.0.1:9000"],
        ["--osc", "127.0.0.1:9000", "--osc", "127.0.0.1:9000"],
    ],
)
def test_a_target_that_is_named_twice_is_refused(flags, capsys):
    assert main(["demo", "--seconds", "1", *flags]) == 2
    told = capsys.readouterr().err
    assert "is named twice" in told and told.count("\n") == 1


def test_two_presets_may_go_to_one_avatar():
    check_each_once(
        (), [parse_target("vmc://127.0.0.1?preset=arkit"), parse_target("vmc://127.0.0.1?preset=unified")]
    )


def test_a_page_that_ends_with_the_run_is_no_news_and_one_that_fails_is(model, monkeypatch, capsys):
    class Started:
        def __init__(self, folder, address, ended):
            self.ended = ended

        def close(self):
            self.ended("")

    started = []

    def start_page(folder, address, ended):
        started.append(Started(folder, address, ended))
        return started[0], "http://127.0.0.1/"

    monkeypatch.setattr("tonguetrack.tracker.outside.start_page", start_page)
    assert main(["demo", "--seconds", "0.1", "--fast", "--web", "127.0.0.1:0"]) == 0
    assert "the page has ended" not in capsys.readouterr().err
    started[0].ended("it broke")
    assert "the page has ended: it broke" in capsys.readouterr().err
