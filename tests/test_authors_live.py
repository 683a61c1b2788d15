"""The authors' live protocol with us as the server, and the faults of theirs that ours must not have."""

import json
import math
import socket
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, NoteKind
from tonguetrack.drivers.devices.authors_live import (
    LARGEST_DATAGRAM,
    BadRequest,
    Fit,
    FixSpeaker,
    Reset,
    SetSettings,
    SetVertices,
    open_authors_live,
    parse_request,
)
from tonguetrack.drivers.sources import parse_source

# Datagrams ------------------------------------------------------------------------------------------


def test_a_fit_is_read():
    fit = parse_request(b'{"id": "FIT", "timeStamp": 12.5, "points": [1, 2.5, -3, 4e0, 5, 6]}')
    assert isinstance(fit, Fit) and fit.time_s == 12.5
    np.testing.assert_array_equal(fit.points, [[1.0, 2.5, -3.0], [4.0, 5.0, 6.0]])


@pytest.mark.parametrize(
    ("datagram", "expected"),
    [
        (b'{"id": "SET_MODEL_INDICES", "indices": [2469, 885, 1912]}', SetVertices((885, 1912, 2469))),
        (
            b'{"id":"SET_SETTINGS","speakerSmoothnessTerm":5,"phonemeSmoothnessTerm":2.5,"priorSize":1}',
            SetSettings((5.0, 2.5, 1.0)),
        ),
        (b'{"id": "FIX_SPEAKER"}', FixSpeaker()),
        (b'{"id": "RESET", "why": ["other keys", {"are": "ignored"}]}\n', Reset()),
    ],
)
def test_the_other_requests_are_read(datagram, expected):
    assert parse_request(datagram) == expected


def test_settings_that_are_not_there_are_nan():
    found = parse_request(b'{"id": "SET_SETTINGS", "priorSize": 2}')
    assert [math.isnan(value) for value in found.values] == [True, True, False]


@pytest.mark.parametrize("missing", [b"NaN", b"null"])
def test_a_point_with_a_coordinate_that_is_nan_or_null_is_missing_as_a_whole(missing):
    fit = parse_request(b'{"id": "FIT", "timeStamp": 0, "points": [1, %s, 3, 4, 5, 6]}' % missing)
    assert np.isnan(fit.points).tolist() == [[True] * 3, [False] * 3]


BAD = [
    b"",
    b"\x00",
    b"\xff\xfe\x00",
    b"not json",
    b"[1, 2]",
    b"7",
    b'{"points": [1, 2, 3]}',
    b'{"id": null}',
    b'{"id": ["FIT"]}',
    b'{"id": "fit", "timeStamp": 0, "points": [1, 2, 3]}',
    b'{"id": "FIT "}',
    b'{"id": "\\ud800"}',
    b'{"id": "FIT", "points": [1, 2, 3]}',
    b'{"id": "FIT", "timeStamp": "0", "points": [1, 2, 3]}',
    b'{"id": "FIT", "timeStamp": NaN, "points": [1, 2, 3]}',
    b'{"id": "FIT", "timeStamp": true, "points": [1, 2, 3]}',
    b'{"id": "FIT", "timeStamp": 0}',
    b'{"id": "FIT", "timeStamp": 0, "points": []}',
    b'{"id": "FIT", "timeStamp": 0, "points": [1, 2]}',
    b'{"id": "FIT", "timeStamp": 0, "points": [1, 2, "3"]}',
    b'{"id": "FIT", "timeStamp": 0, "points": [1, 2, Infinity]}',
    b'{"id": "FIT", "timeStamp": 0, "points": [1, 2, 1e999]}',
    b'{"id": "FIT", "timeStamp": 0, "points": [[1, 2, 3]]}',
    b'{"id": "FIT", "timeStamp": 0, "points": [1, 2, %s]}' % (b"9" * 400),
    b'{"id": "FIT", "timeStamp": 0, "points": [1, 2, %s]}' % (b"9" * 5000),
    b'{"id": "FIT", "timeStamp": 0, "points": {"x": 1}}',
    b'{"id": "SET_MODEL_INDICES"}',
    b'{"id": "SET_MODEL_INDICES", "indices": []}',
    b'{"id": "SET_MODEL_INDICES", "indices": [1.5]}',
    b'{"id": "SET_MODEL_INDICES", "indices": [true]}',
    b'{"id": "SET_MODEL_INDICES", "indices": [-1]}',
    b'{"id": "SET_MODEL_INDICES", "indices": [1, 1]}',
    b'{"id": "SET_MODEL_INDICES", "indices": [1%s]}' % (b"0" * 30),
    b'{"id": "SET_SETTINGS", "priorSize": null}',
    b'{"id": "SET_SETTINGS", "priorSize": -1}',
    b'{"id": "SET_SETTINGS", "speakerSmoothnessTerm": Infinity}',
    b"[" * 8000,
    b'{"id": ' + b"[" * 900 + b"]" * 900 + b"}",
    b'{"id": "RESET", "a": "%s"}' % (b"a" * LARGEST_DATAGRAM),
]


@pytest.mark.parametrize("datagram", BAD, ids=lambda datagram: repr(datagram[:40]))
def test_everything_else_is_a_bad_request_in_printable_words(datagram):
    with pytest.raises(BadRequest) as caught:
        parse_request(datagram)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 120


JSONLIKE = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)
REQUESTLIKE = st.fixed_dictionaries(
    {"id": st.sampled_from(["FIT", "SET_MODEL_INDICES", "SET_SETTINGS", "FIX_SPEAKER", "RESET"]) | JSONLIKE},
    optional={
        "timeStamp": st.floats() | JSONLIKE,
        "points": st.lists(st.floats() | st.none(), max_size=9) | JSONLIKE,
        "indices": st.lists(st.integers(-1, 4000), max_size=6) | JSONLIKE,
        "priorSize": st.floats() | JSONLIKE,
    },
)


@settings(max_examples=400, deadline=None)
@given(REQUESTLIKE.map(lambda content: json.dumps(content).encode()) | st.binary(max_size=200), st.data())
@example(b'{"id": "FIT", "timeStamp": 1, "points": [1, 2, 3]}', None)
def test_arbitrary_datagrams_are_requests_or_bad_requests(datagram, data):
    if data is not None and datagram and data.draw(st.booleans()):
        place = data.draw(st.integers(0, len(datagram) - 1))
        datagram = datagram[:place] + data.draw(st.binary(max_size=3)) + datagram[place + 1 :]
    try:
        request = parse_request(datagram)
    except BadRequest:
        return
    if isinstance(request, Fit):
        assert math.isfinite(request.time_s) and request.points.shape[1] == 3
        assert not np.isinf(request.points).any()
    elif isinstance(request, SetVertices):
        assert list(request.vertices) == sorted(set(request.vertices)) and request.vertices[0] >= 0


# The source -----------------------------------------------------------------------------------------


class Client:
    """One that knows nothing of our code."""

    def __init__(self, source):
        host, _, port = source.address.removeprefix("udp-json://").rpartition(":")
        self.place = (host, int(port))
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def say(self, text):
        self.socket.sendto(text.encode(), self.place)

    def ask(self, identity, **more):
        self.say(json.dumps({"id": identity, **more}))

    def fit(self, time_s, *points):
        self.ask("FIT", timeStamp=time_s, points=[float(c) for point in points for c in point])


@pytest.fixture
def served(request):
    """A source on a free port, and a client of it."""

    def make(options="", ready=True):
        address = replace(parse_source("udp-json://127.0.0.1" + options), port=0)
        source = open_authors_live(address)
        client = Client(source)
        request.addfinalizer(source.close)
        request.addfinalizer(client.socket.close)
        if ready:
            client.ask("SET_MODEL_INDICES", indices=[30, 10])
            assert source.wait_until_ready(timeout_s=10.0)
        return source, client

    return make


def next_of(source, silences=100):
    """The next item that is not silence."""
    for item in source:
        if isinstance(item, CoilFrame) or item.kind is not NoteKind.SILENT:
            return item
        silences -= 1
        assert silences, "nothing came"


P, Q = (1, 2, 3), (4, 5, 6)


def test_it_is_open_at_once_and_ready_when_a_client_names_the_vertices(served):
    source, client = served(ready=False)
    assert not source.ready
    for name in ("coils", "vertices"):
        with pytest.raises(InputError, match=r"SET_MODEL_INDICES.*\?indices="):
            getattr(source, name)
    client.ask("SET_MODEL_INDICES", indices=[2469, 885, 1912])
    assert source.wait_until_ready(timeout_s=10.0)
    assert source.vertices == (885, 1912, 2469)
    assert source.coils == ("point 1", "point 2", "point 3")
    assert (source.frame.x, source.frame.y, source.frame.z) == ("left", "back", "up")
    assert (source.rate_hz, source.reply) == (0.0, "127.0.0.1:1235")


def test_waiting_ends_when_its_time_is_over_and_ticks_meanwhile(served):
    source, _ = served(ready=False)
    ticks = []
    assert not source.wait_until_ready(lambda: ticks.append(1), timeout_s=0.25)
    assert len(ticks) >= 2


def test_waiting_ends_when_it_is_stopped(served):
    source, _ = served(ready=False)
    assert not source.wait_until_ready(source.stop)
    assert list(source) == []


def test_what_arrives_before_the_indices_is_told_afterwards(served):
    source, client = served(ready=False)
    client.ask("SET_SETTINGS", priorSize=2)
    for time_s in range(3):
        client.fit(time_s, P, Q)
    client.ask("SET_MODEL_INDICES", indices=[1, 2])
    client.fit(9.0, P, Q)
    assert source.wait_until_ready(timeout_s=10.0)
    said, bad, frame = (next_of(source) for _ in range(3))
    assert said.command == "set_settings"
    assert (bad.kind, bad.count) == (NoteKind.BAD_DATA, 3) and "before SET_MODEL_INDICES" in bad.text
    assert frame.device_time_s == 9.0


def test_a_client_that_names_no_vertices_is_served_with_those_of_the_address(served):
    source, client = served("?indices=30,10,20&rate=250&reply=127.0.0.1:4000", ready=False)
    assert source.wait_until_ready(timeout_s=0.0)
    assert source.vertices == (10, 20, 30) and source.rate_hz == 250.0 and source.reply == "127.0.0.1:4000"
    client.fit(1.0, P, Q, P)
    assert next_of(source).positions.shape == (3, 3)


@pytest.mark.parametrize("indices", ["a", "1,,2", "1,1", "-1", "1.5", "\u0661", "9" * 12])
def test_wrong_indices_in_the_address_are_an_input_error(indices):
    with pytest.raises(InputError, match="indices="):
        open_authors_live(replace(parse_source(f"udp-json://?indices={indices}"), port=0))


def test_a_fit_is_a_frame_with_its_points_in_ascending_order_of_the_vertices(served):
    source, client = served()
    client.fit(12.5, P, Q)
    client.fit(12.75, Q, P)
    first, second = next_of(source), next_of(source)
    np.testing.assert_array_equal(first.positions, [P, Q])
    np.testing.assert_array_equal(second.positions, [Q, P])
    assert (first.device_time_s, second.device_time_s) == (12.5, 12.75)
    assert (first.frame_number, second.frame_number) == (1, 2)
    assert first.arrival_ns <= second.arrival_ns <= time.perf_counter_ns()
    assert first.quaternions is None and first.rms is None


def test_commands_are_notes_in_the_order_in_which_they_came(served):
    source, client = served()
    client.ask("SET_SETTINGS", speakerSmoothnessTerm=1, phonemeSmoothnessTerm=2, priorSize=3)
    client.fit(1.0, P, Q)
    client.ask("FIX_SPEAKER")
    client.ask("RESET")
    client.ask("SET_MODEL_INDICES", indices=[7, 5, 6])
    client.fit(2.0, P, Q, P)
    settings_, fit, fix, reset, vertices = (next_of(source) for _ in range(5))
    assert (settings_.kind, settings_.command) == (NoteKind.COMMAND, "set_settings")
    assert settings_.values == (1.0, 2.0, 3.0)
    assert fit.positions.shape == (2, 3)
    assert [(note.command, note.values) for note in (fix, reset)] == [("fix_speaker", ()), ("reset", ())]
    assert (vertices.command, vertices.values) == ("set_vertices", (5.0, 6.0, 7.0))
    assert source.vertices == (5, 6, 7) and len(source.coils) == 3
    assert next_of(source).positions.shape == (3, 3)


def test_time_stamps_that_go_back_are_told_before_the_frame(served):
    source, client = served()
    for time_s in (5.0, 1.0, 2.0):
        client.fit(time_s, P, Q)
    first, note, second, third = (next_of(source) for _ in range(4))
    assert note.kind is NoteKind.CLOCK_RESET
    assert [frame.device_time_s for frame in (first, second, third)] == [5.0, 1.0, 2.0]


def test_silence_is_told_every_tick_and_stop_ends_it(served):
    source, _ = served()
    assert next(source).kind is NoteKind.SILENT
    threading.Timer(0.05, source.stop).start()
    assert all(item.kind is NoteKind.SILENT for item in source)


def test_a_closed_source_has_ended(served):
    source, _ = served()
    with source:
        pass
    assert list(source) == []


def test_it_listens_on_this_machine_alone_unless_told(served):
    source, _ = served(ready=False)
    assert source.address.startswith("udp-json://127.0.0.1:")
    assert parse_source("udp-json://").port == 1234


def test_a_port_that_is_taken_is_an_input_error(served):
    source, client = served(ready=False)
    with pytest.raises(InputError, match=f"port {client.place[1]}.*cannot be listened on"):
        open_authors_live(parse_source(source.address))


# Faults of the authors' server ------------------------------------------------------------------------


@pytest.mark.parametrize("datagram", BAD, ids=lambda datagram: repr(datagram[:40]))
def test_after_a_bad_datagram_the_next_is_served(served, datagram):
    source, client = served()
    client.socket.sendto(datagram, client.place)
    client.fit(1.0, P, Q)
    note, frame = next_of(source), next_of(source)
    assert (note.kind, note.count) == (NoteKind.BAD_DATA, 1)
    assert frame.device_time_s == 1.0


def test_a_fit_with_another_number_of_points_is_left_out(served):
    source, client = served()
    client.fit(1.0, P)
    client.fit(2.0, P, Q)
    note, frame = next_of(source), next_of(source)
    assert note.kind is NoteKind.BAD_DATA and "1 points for 2 vertices" in note.text
    assert (frame.device_time_s, frame.frame_number) == (2.0, 1)


def test_a_nan_coil_is_missing_and_the_others_are_there(served):
    source, client = served()
    client.say('{"id": "FIT", "timeStamp": 1, "points": [NaN, NaN, NaN, 4, 5, 6]}')
    np.testing.assert_array_equal(next_of(source).positions, [[np.nan] * 3, Q])


def test_no_frame_is_overwritten_however_slow_the_reader(served):
    """Theirs answered 68 of 200 that came at 250 Hz."""
    source, client = served()
    found = []
    for burst in range(10):
        for k in range(100):
            client.fit(burst * 100 + k, P, Q)
        found.append(next_of(source))  # one a burst; the rest waits
    found += [next_of(source) for _ in range(990)]
    assert [frame.device_time_s for frame in found] == list(range(1000))
    assert [frame.frame_number for frame in found] == list(range(1, 1001))


@pytest.mark.skipif(sys.platform != "linux", reason="no other system counts them")
def test_what_the_system_had_no_room_for_is_told(served):
    source, client = served()
    source._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    found = []
    for _ in range(2):
        for k in range(500):
            client.fit(k, P, Q)
        found += [next_of(source), next_of(source)]
    client.fit(1e6, P, Q)  # the loss is told with what comes after it
    while not (isinstance(found[-1], CoilFrame) and found[-1].device_time_s == 1e6):
        found.append(next_of(source))
    frames = [item for item in found if isinstance(item, CoilFrame)]
    lost = [item.count for item in found if not isinstance(item, CoilFrame) and item.kind is NoteKind.GAP]
    assert 0 < len(frames) < 1001 and len(frames) + sum(lost) == 1001


def test_waiting_costs_no_processor_time(served):
    """Theirs held a core. A quarter of it would still pass here, a busy loop not."""
    source, _ = served()
    begun, used = time.perf_counter(), time.process_time()
    for _ in range(5):
        assert next(source).kind is NoteKind.SILENT
    assert time.process_time() - used < 0.25 * (time.perf_counter() - begun)
