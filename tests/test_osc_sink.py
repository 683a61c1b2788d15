"""Sending: nobody's absence, slowness or refusal reaches the loop; an outside python-osc peer understands."""

import errno
import json
import socket
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from pythonosc.osc_packet import OscPacket

from tonguetrack import InputError
from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams import osc
from tonguetrack.tracker.streams.osc import OscSink
from tonguetrack.tracker.streams.sink import LiveNumbers, StreamInfo

SIZE = 4


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(5.0)
        yield opened


def address_of(opened):
    return f"127.0.0.1:{opened.getsockname()[1]}"


def info(fixed=True):
    return StreamInfo(
        "a synthetic model", "f", 60, np.zeros(SIZE), np.ones(SIZE), np.ones(3), fixed, ("tip",), 250.0
    )


def pose(**changes):
    values = {
        "weights": np.arange(SIZE) * 0.5, "normalised": np.arange(SIZE) * 0.25, "speaker_weights": np.zeros(3),
        "residuals_mm": np.zeros(1), "residual_mm": 0.5, "valid_coils": 1, "status": PoseStatus.OK,
    }  # fmt: skip
    return TrackedPose(**(values | changes))


def messages(datagram):
    return {timed.message.address: timed.message.params for timed in OscPacket(datagram).messages}


def frames_of(datagrams):
    return [found["/tongue/frame"] for found in map(messages, datagrams) if "/tongue/frame" in found]


def waiting(opened):
    """All datagrams that are there now."""
    opened.setblocking(False)
    found = []
    while True:
        try:
            found.append(opened.recv(2048))
        except BlockingIOError:
            return found


@pytest.fixture
def clock(monkeypatch):
    """The sink's clock, to be set by the test."""
    fake = SimpleNamespace(now_ns=5_000_000_000)
    monkeypatch.setattr(osc, "time", SimpleNamespace(perf_counter_ns=lambda: fake.now_ns))
    return fake


@pytest.fixture
def sink_to(request):
    def make(destination, about=None):
        sink = OscSink(destination)
        request.addfinalizer(sink.close)
        sink.start(about or info())
        return sink

    return make


def test_the_info_comes_before_the_first_frame(receiver, sink_to):
    sink_to(address_of(receiver)).send(pose())
    first, second = receiver.recv(2048), receiver.recv(2048)
    assert messages(first)["/tongue/info"][0] == "tonguetrack"
    assert "/tongue/frame" in messages(second)


def test_time_counts_from_the_streams_first_frame_and_sequence_from_zero(receiver, sink_to):
    sink = sink_to(address_of(receiver))
    for time_s in (1000.0, 1000.25, 1002.0):
        sink.send(pose(device_time_s=time_s))
    assert frames_of(waiting(receiver)) == [[0, 0.0, 1], [1, 0.25, 1], [2, 2.0, 1]]


def test_the_latency_on_the_wire_is_from_arrival_to_writing(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver))
    sink.send(pose(arrival_ns=clock.now_ns - 1_500_000))
    assert messages(waiting(receiver)[-1])["/tongue/quality"] == [0.5, 1, 1.5]


def test_the_info_is_repeated_every_second(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver))
    for _ in range(30):  # three seconds at 10 Hz
        clock.now_ns += 100_000_000
        sink.send(pose())
    kinds = ["info" if "/tongue/info" in messages(datagram) else "frame" for datagram in waiting(receiver)]
    assert kinds == ["info"] + (["frame"] * 10 + ["info"]) * 3


def test_the_speaker_in_the_info_is_the_latest_while_it_is_free(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver), info(fixed=False))
    clock.now_ns += 1_000_000_000
    sink.send(pose(speaker_weights=np.array([0.5, -0.25, 2.0])))
    about = [messages(datagram) for datagram in waiting(receiver)]
    assert about[0]["/tongue/speaker"] == [1.0, 1.0, 1.0]
    assert about[-1]["/tongue/speaker"] == [0.5, -0.25, 2.0]
    assert about[-1]["/tongue/info"][6] == "free"
    assert about[0].keys() == about[-1].keys()


def test_a_sink_can_start_again_as_a_new_stream(receiver, sink_to):
    sink = sink_to(address_of(receiver))
    sink.send(pose(device_time_s=7.0))
    sink.start(info())
    sink.send(pose(device_time_s=9.0))
    assert frames_of(waiting(receiver)) == [[0, 0.0, 1], [0, 0.0, 1]]


def test_the_info_changes_while_the_stream_goes_on(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver), info(fixed=False))
    sink.send(pose(device_time_s=7.0))
    sink.change(info(fixed=True))
    clock.now_ns += 1_000_000_000
    sink.send(pose(device_time_s=8.0, speaker_weights=np.full(3, 9.0)))
    sent = waiting(receiver)
    about = [found for found in map(messages, sent) if "/tongue/info" in found]
    assert frames_of(sent) == [[0, 0.0, 1], [1, 1.0, 1]]
    assert [found["/tongue/info"][6] for found in about] == ["free", "fixed", "fixed"]
    assert about[-1]["/tongue/speaker"] == [1.0, 1.0, 1.0], "a fixed speaker's weights are those of the info"


# The state of a live run ------------------------------------------------------------------------------


def states(*numbers):
    return pose(coil_states=np.array(numbers, np.int64))


def kinds_of(datagrams):
    """One word a datagram, and what it says of the coils."""
    named = {"/tongue/info": "info", "/tongue/frame": "frame", "/tongue/take": "numbers"}
    found = []
    for datagram in map(messages, datagrams):
        found += [word for path, word in named.items() if path in datagram]
        found += [datagram[path] for path in datagram if path == "/tongue/coilstates"]
    return found


def test_coil_states_are_sent_with_the_frame_in_which_they_change(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver))
    for state in (0, 0, 2, 2, 0):
        clock.now_ns += 4_000_000
        sink.send(states(state))
    assert kinds_of(waiting(receiver)) == (
        ["info", "frame", [0], "frame", "frame", [2], "frame", "frame", [0]]
    )


def test_coil_states_are_repeated_every_second(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver))
    for _ in range(20):
        clock.now_ns += 100_000_000
        sink.send(states(1))
    assert kinds_of(waiting(receiver)).count([1]) == 3


def test_without_watched_coils_nothing_is_said_of_their_states(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver))
    clock.now_ns += 1_000_000_000
    sink.send(pose())
    assert kinds_of(waiting(receiver)) == ["info", "frame", "info"]


def test_a_new_stream_says_the_states_again(receiver, sink_to):
    sink = sink_to(address_of(receiver))
    sink.send(states(0))
    sink.start(info())
    sink.send(states(0))
    assert kinds_of(waiting(receiver)).count([0]) == 2


def test_the_numbers_of_the_run_are_asked_for_once_a_second(receiver, sink_to, clock):
    sink = sink_to(address_of(receiver))
    asked = []

    def numbers():
        asked.append(clock.now_ns)
        return LiveNumbers((0.5, 1.0), (0.25, 0.5), (None, None), "one.xdf", 100 * len(asked))

    sink.numbers = numbers
    for _ in range(30):
        clock.now_ns += 100_000_000
        sink.send(pose())
    found = [about for about in map(messages, waiting(receiver)) if "/tongue/take" in about]
    assert len(asked) == 3
    assert [about["/tongue/take"] for about in found] == [["one.xdf", 100 * k, ""] for k in (1, 2, 3)]
    assert found[0]["/tongue/latency"] == [0.5, 1.0, 0.25, 0.5, -1.0, -1.0]


# Peers that are not as one would wish -----------------------------------------------------------------


def test_an_absent_receiver_changes_nothing(sink_to):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        address = address_of(gone)
    sink = sink_to(address)
    for _ in range(500):
        sink.send(pose())
    assert (sink.sent, sink.dropped) == (500, 0)


def test_a_receiver_that_leaves_and_comes_back_gets_the_newest_frames(sink_to):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
        first.bind(("127.0.0.1", 0))
        address, place = address_of(first), first.getsockname()
        sink = sink_to(address)
        sink.send(pose())
    for _ in range(10):
        sink.send(pose())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
        second.bind(place)
        sink.send(pose())
        assert frames_of(waiting(second)) == [[11, 0.0, 1]]


def test_a_receiver_that_never_reads_costs_no_waiting(receiver, sink_to):
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sink = sink_to(address_of(receiver))
    for _ in range(3000):
        sink.send(pose())
    assert sink.sent + sink.dropped == 3000
    assert len(waiting(receiver)) < 3000


@pytest.mark.parametrize(
    "code",
    [errno.EAGAIN, errno.ENOBUFS, errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EPERM],
)
def test_whatever_the_system_refuses_is_a_dropped_frame(sink_to, code):
    sink = sink_to("127.0.0.1:9")

    class Refusing:
        def sendto(self, data, peer):
            raise OSError(code, "refused by a test")

        def close(self):
            pass

    sink.close()
    sink._socket = Refusing()
    for state in range(3):
        sink.send(states(state))
    sink.start(info())
    sink.change(info())
    assert (sink.sent, sink.dropped) == (0, 3)


def test_a_dropped_frame_is_a_gap_for_the_receiver(receiver, sink_to):
    sink = sink_to(address_of(receiver))
    working = sink._socket
    sink.send(pose())
    sink._socket = SimpleNamespace(sendto=lambda data, peer: (_ for _ in ()).throw(BlockingIOError()))
    sink.send(pose())
    sink._socket = working
    sink.send(pose())
    assert [frame[0] for frame in frames_of(waiting(receiver))] == [0, 2]


def test_the_socket_neither_blocks_nor_is_connected(sink_to):
    sink = sink_to("127.0.0.1:9")
    assert sink._socket.gettimeout() == 0.0
    with pytest.raises(OSError):
        sink._socket.getpeername()


def test_localhost_means_ipv4_where_receivers_listen(receiver, sink_to):
    sink_to(f"localhost:{receiver.getsockname()[1]}")
    assert "/tongue/info" in messages(receiver.recv(2048))


def test_an_ipv6_receiver_is_reached():
    try:
        receiver = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
        receiver.bind(("::1", 0))
    except OSError:
        pytest.skip("no IPv6 on this machine")
    with receiver:
        receiver.settimeout(5.0)
        sink = OscSink(f"[::1]:{receiver.getsockname()[1]}")
        sink.start(info())
        assert "/tongue/info" in messages(receiver.recv(2048))
        sink.close()


def test_an_unknown_host_is_an_input_error():
    with pytest.raises(InputError, match=r"host 'no\.such\.host\.invalid' is not known"):
        OscSink("no.such.host.invalid:9000")


# An independent peer ----------------------------------------------------------------------------------

PEER = """
import json, sys
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer
seen = []
dispatcher = Dispatcher()
dispatcher.map("/tongue/*", lambda address, *values: seen.append([address, list(values)]))
server = BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher)
server.timeout = 20
print(server.server_address[1], flush=True)
while sum(address == "/tongue/quality" for address, _ in seen) < 5:
    server.handle_request()
server.server_close()
print(json.dumps(seen))
"""


def test_python_oscs_dispatcher_in_another_process_gets_every_message_at_once(sink_to):
    peer = subprocess.Popen([sys.executable, "-c", PEER], stdout=subprocess.PIPE, text=True)
    try:
        sink = sink_to(f"127.0.0.1:{int(peer.stdout.readline())}")
        for k in range(5):
            sink.send(pose(weights=np.full(SIZE, k / 2), device_time_s=k / 4))
        seen = json.loads(peer.communicate(timeout=30)[0])
    finally:
        peer.kill()
        peer.wait()
    assert [values for address, values in seen if address == "/tongue/frame"] == [
        [k, k / 4, 1] for k in range(5)
    ]
    assert [values for address, values in seen if address == "/tongue/pose/3"] == [[k / 2] for k in range(5)]
    assert [values for address, values in seen if address == "/tongue/pose"] == [
        [k / 2] * SIZE for k in range(5)
    ]
    assert ["/tongue/coils", ["tip"]] in seen
