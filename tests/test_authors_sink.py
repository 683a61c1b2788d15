"""Answers for clients of the authors' live server."""

import errno
import json
import socket

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams.authors import DEFAULT_DESTINATION, AuthorsSink, answer


def pose(**changes):
    values = {
        "weights": np.array([0.5, -0.25]), "normalised": np.zeros(2), "speaker_weights": np.array([0.125]),
        "residuals_mm": np.zeros(1), "status": PoseStatus.OK, "device_time_s": 12.25,
    }  # fmt: skip
    return TrackedPose(**(values | changes))


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(5.0)
        yield opened


@pytest.fixture
def sink_to(request):
    def make(place):
        sink = AuthorsSink(place if isinstance(place, str) else f"127.0.0.1:{place.getsockname()[1]}")
        request.addfinalizer(sink.close)
        return sink

    return make


def test_an_answer_is_one_json_map_and_a_line_end():
    expected = b'{"phonemeWeights": [0.5, -0.25], "speakerWeights": [0.125], "timeStamp": 12.25}\n'
    assert answer(pose()) == expected


def test_numbers_arrive_to_the_last_bit():
    weights = np.random.default_rng(1).normal(size=4)
    found = json.loads(answer(pose(weights=weights, device_time_s=1e9 + 1 / 3)))
    assert found["phonemeWeights"] == weights.tolist() and found["timeStamp"] == 1e9 + 1 / 3


def test_every_pose_is_one_datagram(receiver, sink_to):
    sink = sink_to(receiver)
    for time_s in (1.0, 2.0, 3.0):
        sink.send(pose(device_time_s=time_s))
    assert [json.loads(receiver.recv(8192))["timeStamp"] for _ in range(3)] == [1.0, 2.0, 3.0]
    assert (sink.sent, sink.dropped) == (3, 0)


def test_an_absent_receiver_changes_nothing(sink_to):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        sink = sink_to(gone)
    for _ in range(100):
        sink.send(pose())
    assert (sink.sent, sink.dropped) == (100, 0)


@pytest.mark.parametrize("code", [errno.EAGAIN, errno.ENOBUFS, errno.ECONNREFUSED, errno.ENETUNREACH])
def test_what_the_system_refuses_is_dropped(sink_to, code):
    class Refusing:
        def sendto(self, data, peer):
            raise OSError(code, "refused by a test")

        def close(self):
            pass

    sink = sink_to("127.0.0.1:9")
    sink.close()
    sink._socket = Refusing()
    sink.send(pose())
    assert (sink.sent, sink.dropped) == (0, 1)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_json_cannot_say_is_dropped_and_never_sent(receiver, sink_to, wrong):
    sink = sink_to(receiver)
    sink.send(pose(weights=np.array([wrong, 0.0])))
    sink.send(pose(device_time_s=7.0))
    assert (sink.sent, sink.dropped) == (1, 1)
    assert json.loads(receiver.recv(8192))["timeStamp"] == 7.0


def test_the_socket_neither_blocks_nor_is_connected(sink_to):
    sink = sink_to(DEFAULT_DESTINATION)
    assert sink.destination == "udp-json 127.0.0.1:1235"
    assert sink._socket.gettimeout() == 0.0
    with pytest.raises(OSError):
        sink._socket.getpeername()


def test_a_wrong_destination_is_an_input_error():
    with pytest.raises(InputError, match="HOST:PORT"):
        AuthorsSink("nowhere")
