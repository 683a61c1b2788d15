"""What can be asked of a running session: the queue to the loop, and OSC as one way into it."""

import socket
import subprocess
import sys
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from tonguetrack import InputError
from tonguetrack.tracker.control import MAX_WAITING, Control, ControlQueue
from tonguetrack.tracker.streams.addresses import CONTROL_FORMS, MAX_CONTROL_TEXT
from tonguetrack.tracker.streams.control_osc import MAX_TOLD, OscControl, control_of
from tonguetrack.tracker.streams.monitor import decode

NOW_NS = 77


def everything(queue):
    found = []
    while (control := queue.take()) is not None:
        found.append(control)
    return found


# The queue --------------------------------------------------------------------------------------------


def test_wishes_are_taken_in_the_order_in_which_they_were_put():
    queue = ControlQueue()
    wishes = [Control("mark", str(k), k) for k in range(5)]
    for wish in wishes:
        queue.put(wish)
    assert everything(queue) == wishes
    assert queue.take() is None


def test_a_full_queue_drops_the_oldest_and_counts():
    queue = ControlQueue()
    for k in range(MAX_WAITING + 3):
        queue.put(Control("mark", str(k)))
    assert [control.text for control in everything(queue)] == [str(k + 3) for k in range(MAX_WAITING)]
    assert queue.dropped == 3


def test_what_many_threads_put_is_taken_or_counted():
    queue = ControlQueue()
    threads = [
        threading.Thread(target=lambda: [queue.put(Control("mark")) for _ in range(1000)]) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    taken = 0
    while any(thread.is_alive() for thread in threads):
        taken += queue.take() is not None
    assert taken + len(everything(queue)) + queue.dropped == 4000


# What a message asks for ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "values", "kind", "text"),
    [
        ("/tongue/control/take", [1], "take_start", ""),
        ("/tongue/control/take", [0], "take_stop", ""),
        ("/tongue/control/take", ["start"], "take_start", ""),
        ("/tongue/control/take", ["stop"], "take_stop", ""),
        ("/tongue/control/take", [1, "vowels 2"], "take_start", "vowels 2"),
        ("/tongue/control/take", ["start", "s01_a.b"], "take_start", "s01_a.b"),
        ("/tongue/control/take", ["stop", "s01"], "take_stop", ""),
        ("/tongue/control/marker", ["sentence 4"], "mark", "sentence 4"),
        ("/marker", ["sentence 5"], "mark", "sentence 5"),
        ("/tongue/control/speaker", ["fix"], "fix_speaker", ""),
        ("/tongue/control/speaker", ["free"], "free_speaker", ""),
    ],
)
def test_every_form_of_the_table_is_obeyed(path, values, kind, text):
    assert control_of(path, values, NOW_NS) == Control(kind, text, NOW_NS)
    tags = "," + "".join("i" if isinstance(value, int) else "s" for value in values)
    assert (path, tags) in {(form.path, form.type_tags) for form in CONTROL_FORMS}


@pytest.mark.parametrize(
    ("path", "values"),
    [
        ("/tongue/control/take", []),
        ("/tongue/control/take", [2]),
        ("/tongue/control/take", [-1]),
        ("/tongue/control/take", [1.0]),
        ("/tongue/control/take", [True]),
        ("/tongue/control/take", [None]),
        ("/tongue/control/take", [b"start"]),
        ("/tongue/control/take", [[1]]),
        ("/tongue/control/take", ["go"]),
        ("/tongue/control/take", ["Start"]),
        ("/tongue/control/take", [1, 2]),
        ("/tongue/control/take", [1, "a", "b"]),
        ("/tongue/control/speaker", []),
        ("/tongue/control/speaker", ["fixed"]),
        ("/tongue/control/speaker", [1]),
        ("/tongue/control/marker", []),
        ("/tongue/control/marker", [1]),
        ("/tongue/control/marker", [""]),
        ("/tongue/control/marker", ["a", "b"]),
        ("/tongue/control", ["start"]),
        ("/tongue/control/quit", [1]),
        ("/tongue/frame", [1, 0.5, 1]),
        ("/markers", ["a"]),
        ("/marker/", ["a"]),
    ],
)
def test_whatever_is_not_in_the_table_asks_for_nothing(path, values):
    assert control_of(path, values, NOW_NS) is None


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../take", "a/b", "a\\b", "/tmp/x", "C:x", ".hidden", "end.", "end ", "nul\0", "a\n"]
)  # fmt: skip
def test_a_takes_name_can_lead_to_no_other_folder(name):
    assert control_of("/tongue/control/take", [1, name], NOW_NS) is None


def test_a_take_may_be_named_in_any_letters():
    assert control_of("/tongue/control/take", [1, "Müller 2"], NOW_NS) == Control(
        "take_start", "Müller 2", NOW_NS
    )


def test_texts_are_bounded_and_printable():
    assert control_of("/marker", ["x" * MAX_CONTROL_TEXT], NOW_NS) is not None
    assert control_of("/marker", ["x" * (MAX_CONTROL_TEXT + 1)], NOW_NS) is None
    assert control_of("/marker", ["\x1b[2J"], NOW_NS) is None
    assert control_of("/tongue/control/take", [1, "x" * (MAX_CONTROL_TEXT + 1)], NOW_NS) is None


# OSC --------------------------------------------------------------------------------------------------


def message(path, *values):
    builder = OscMessageBuilder(path)
    for value in values:
        builder.add_arg(value)
    return builder.build()


class Listening:
    """A control port, its queue, and a client that waits until the port has dealt with what it sent."""

    def __init__(self):
        self.queue = ControlQueue()
        self.control = OscControl("127.0.0.1:0", self.queue)
        host, port = self.control.address.rsplit(":", 1)
        self.place = (host, int(port))
        self.client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, *datagrams):
        """Sends them and returns what was asked for by then."""
        dealt_with = self.control.accepted + self.control.refused
        for datagram in datagrams:
            self.client.sendto(datagram, self.place)
        deadline = time.monotonic() + 20.0
        while self.control.accepted + self.control.refused == dealt_with and time.monotonic() < deadline:
            time.sleep(0.002)
        return everything(self.queue)


@pytest.fixture
def listening():
    opened = Listening()
    with opened.control, opened.client:
        yield opened


def test_a_datagram_becomes_a_wish_with_the_time_of_its_arrival(listening):
    before_ns = time.perf_counter_ns()
    (wish,) = listening.send(message("/tongue/control/take", "start", "vowels").dgram)
    assert (wish.kind, wish.text) == ("take_start", "vowels")
    assert before_ns < wish.time_ns < time.perf_counter_ns()
    assert (listening.control.accepted, listening.control.refused) == (1, 0)


def test_what_was_meant_for_us_and_not_understood_is_told_a_few_times_in_plain_letters():
    told = []
    with OscControl("127.0.0.1:0", ControlQueue(), told.append) as control:
        control._receive(message("/tongue/control/take", 1, "M/\u00fcller").dgram, 0)
        control._receive(message("/nothing/of/ours", 1).dgram, 0)
        assert len(told) == 1 and "/tongue/control/take [1, 'M/\\xfcller']" in told[0] and told[0].isascii()
        for _ in range(2 * MAX_TOLD):
            control._receive(message("/marker", 7).dgram, 0)
    assert len(told) == MAX_TOLD
    assert control.refused == 2 + 2 * MAX_TOLD


def test_a_bundle_is_obeyed_message_by_message(listening):
    bundle = OscBundleBuilder(IMMEDIATELY)
    for content in (message("/marker", "a"), message("/nonsense"), message("/marker", "b")):
        bundle.add_content(content)
    listening.send(bundle.build().dgram)
    listening.send(b"the last one")
    assert (listening.control.accepted, listening.control.refused) == (2, 2)


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"no OSC",
        b"x" * 5000,
        message("/marker", "y" * 1396).dgram,
        message("/unknown", 1).dgram,
        message("/marker", 1).dgram,
        b"#bundle\0" + bytes(8) + b"\xff\xff\xff\xfc",
        b"/tongue/control/take\0\0\0\0,[i]\0\0\0\0\0\0\0\1",
        b"/marker\0,s\0\0\xff\xfe\0\0",
    ],
)
def test_what_is_not_understood_is_counted_never_answered_and_changes_nothing(listening, datagram):
    assert listening.send(datagram) == []
    assert listening.control.refused >= 1
    assert listening.send(message("/marker", "still here").dgram)[0].text == "still here"
    listening.client.setblocking(False)
    with pytest.raises(BlockingIOError):
        listening.client.recv(100)


SEEDS = [
    message("/tongue/control/take", 1, "name").dgram,
    message("/marker", "text").dgram,
    message("/tongue/control/speaker", "free").dgram,
]


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from(SEEDS),
    st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=6),
    st.integers(0, 60) | st.none(),
)
def test_damaged_datagrams_are_wishes_of_the_table_or_nothing(seed, changes, length):
    damaged = bytearray(seed)
    for at, byte in changes:
        damaged[at % len(damaged)] = byte
    for path, values in decode(bytes(damaged[:length])) or []:
        wish = control_of(path, values, NOW_NS)
        if wish is None:
            continue
        assert wish.kind in ("take_start", "take_stop", "mark", "fix_speaker", "free_speaker")
        assert wish.text.isprintable() and len(wish.text) <= MAX_CONTROL_TEXT


def test_it_listens_on_loopback_and_frees_its_port():
    queue = ControlQueue()
    control = OscControl("127.0.0.1:0", queue)
    assert control._socket.getsockname()[0] == "127.0.0.1"
    address = control.address
    control.close()
    assert not control._thread.is_alive()
    OscControl(address, queue).close()


def test_a_taken_port_is_an_input_error_that_names_it(listening):
    with pytest.raises(InputError, match=rf"{listening.control.address}: the port is in use .* --control"):
        OscControl(listening.control.address, ControlQueue())


def test_an_address_of_another_machine_is_an_input_error():
    with pytest.raises(InputError, match=r"192\.0\.2\.1:9001: cannot listen there"):
        OscControl("192.0.2.1:9001", ControlQueue())


@pytest.mark.parametrize("address", ["", "9001", "localhost", "127.0.0.1:65536", "::1:9001"])
def test_what_is_no_address_is_an_input_error(address):
    with pytest.raises(InputError):
        OscControl(address, ControlQueue())


def test_a_python_osc_client_in_another_process_controls_a_session(listening):
    code = (
        "import sys; from pythonosc.udp_client import SimpleUDPClient\n"
        "client = SimpleUDPClient('127.0.0.1', int(sys.argv[1]))\n"
        "client.send_message('/tongue/control/take', [1, 'from outside'])\n"
    )
    subprocess.run([sys.executable, "-c", code, str(listening.place[1])], check=True, timeout=30)
    deadline = time.monotonic() + 20.0
    while listening.control.accepted == 0 and time.monotonic() < deadline:
        time.sleep(0.002)
    assert [(wish.kind, wish.text) for wish in everything(listening.queue)] == [
        ("take_start", "from outside")
    ]
