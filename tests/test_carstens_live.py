"""Carstens' cs5recorder: blocks, text replies, the source, and the simulator in a process of its own.

No captured bytes are public. The golden blocks are written here with `struct`, field by field, from what
public clients read, and share no code with the driver.
"""

import itertools
import math
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, NoteKind, Recording, SourceNote
from tonguetrack.drivers.devices import carstens_source
from tonguetrack.drivers.devices.carstens_live import (
    LAYOUTS,
    LONGEST_LINE,
    MOST_LINES,
    BadBlock,
    BadReply,
    Block,
    Reply,
    build_block,
    coil_names,
    layout_named,
    layout_of_size,
    parse_block,
    parse_reply,
)
from tonguetrack.drivers.devices.carstens_source import CarstensConversation, open_carstens, shake_hands
from tonguetrack.drivers.devices.link import LinkLost
from tonguetrack.drivers.files.common import axes_from_angles, axes_from_quaternions
from tonguetrack.drivers.simulators.carstens_sim import run_carstens
from tonguetrack.drivers.simulators.faults import FaultPlan
from tonguetrack.drivers.simulators.motion import SimulatedMotion
from tonguetrack.drivers.sources import open_device, parse_source

SIZES = {"ag500": 960, "ag501-16": 1648, "ag501-16-head": 2096, "ag501": 2448, "ag501-head": 3120}
EMPTY = (0.0,) * 7


def golden(name, rows, word=0x8000_0102, sweep=7, pos_ok=0xFFFF_FFFF, head_rows=None):
    """A block as bytes. rows: of 7 numbers, the first channels; the rest are zeros."""
    channels, transmitters = (12, 6) if name == "ag500" else (16, 9) if "16" in name else (24, 9)
    data = struct.pack("<II", word, sweep) + bytes(2 * 4 * channels * transmitters)
    data += struct.pack("<fIIIIIIIII", 0.0, pos_ok, pos_ok, *[0] * 7)
    for block in [rows] + ([head_rows or rows] if "head" in name else []):
        data += b"".join(struct.pack("<7f", *row) for row in [*block, *[EMPTY] * (channels - len(block))])
    return data


# Blocks ---------------------------------------------------------------------------------------------


def test_the_table_has_the_five_sizes_that_clients_know_and_they_add_up():
    assert {layout.name: layout.size for layout in LAYOUTS} == SIZES
    for layout in LAYOUTS:
        rows = 7 * 4 * layout.channels * (2 if layout.head_corrected else 1)
        assert layout.size == 8 + 2 * 4 * layout.channels * layout.transmitters + 40 + rows
        assert layout_of_size(layout.size) is layout and layout_named(layout.name) is layout
    assert layout_of_size(961) is None and layout_named("ag502") is None


@pytest.mark.parametrize("name", SIZES)
def test_a_block_is_read_field_by_field(name):
    data = golden(name, [(1.5, -2.25, 3.0, 30.0, -45.0, 4.5, 0.0), (10.0, 0.0, 0.0, 0.0, 0.0, 1.0, 9.0)])
    assert len(data) == SIZES[name]
    block = parse_block(data, layout_named(name))
    assert (block.counter, block.recording, block.sweep) == (0x102, True, 7)
    np.testing.assert_array_equal(block.positions[:2], [[1.5, -2.25, 3.0], [10.0, 0.0, 0.0]])
    np.testing.assert_array_equal(block.rms[:2], [4.5, 1.0])
    assert np.isnan(block.positions[2:]).all() and np.isnan(block.rms[2:]).all()
    assert np.isnan(block.quaternions[2:]).all()


def test_the_counter_has_31_bits_beside_the_recording_bit():
    block = parse_block(golden("ag500", [], word=0x7FFF_FFFF), layout_named("ag500"))
    assert (block.counter, block.recording) == (0x7FFF_FFFF, False)


def test_angles_become_the_quaternion_that_turns_z_onto_the_coils_axis():
    angles = [(0.0, 90.0), (0.0, -90.0), (0.0, 0.0), (90.0, 0.0), (-120.0, 35.0), (180.0, -89.0)]
    rows = [(1.0, 2.0, 3.0, phi, theta, 1.0, 0.0) for phi, theta in angles]
    quaternions = parse_block(golden("ag500", rows), layout_named("ag500")).quaternions[: len(rows)]
    expected = axes_from_angles(*np.array(angles).T)
    np.testing.assert_allclose(axes_from_quaternions(quaternions), expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0)
    assert (quaternions[:, 3] == 0).all()


def test_the_head_corrected_block_is_the_one_used():
    data = golden(
        "ag501-head", [(1, 1, 1, 0, 0, 1, 0)], head_rows=[(2, 2, 2, 0, 0, 1, 0), (3, 3, 3, 0, 0, 1, 0)]
    )
    np.testing.assert_array_equal(parse_block(data, layout_named("ag501-head")).positions[:2, 0], [2.0, 3.0])


GOOD = (1.0, 2.0, 3.0, 10.0, 20.0, 1.0, 0.0)


@pytest.mark.parametrize(
    "row",
    [
        EMPTY,
        (math.nan, *GOOD[1:]),
        (math.inf, *GOOD[1:]),
        (1e30, *GOOD[1:]),
        (*GOOD[:5], 30.5, 0.0),
        (*GOOD[:5], math.nan, 0.0),
        (*GOOD[:5], -1.0, 0.0),
    ],
)
def test_a_row_without_a_believable_measurement_is_missing(row):
    block = parse_block(golden("ag501", [GOOD, row]), layout_named("ag501"))
    assert np.isfinite(block.positions[0]).all()
    assert np.isnan(block.positions[1]).all() and np.isnan(block.quaternions[1]).all()
    assert np.isnan(block.rms[1])


@pytest.mark.parametrize("angle", [math.nan, -math.inf, 1e9])
def test_absurd_angles_cost_the_orientation_alone(angle):
    block = parse_block(golden("ag501", [(1.0, 2.0, 3.0, angle, 0.0, 1.0, 0.0)]), layout_named("ag501"))
    np.testing.assert_array_equal(block.positions[0], [1.0, 2.0, 3.0])
    assert np.isnan(block.quaternions[0]).all()


def test_a_clear_pos_ok_bit_is_missing_on_an_ag501_and_not_known_on_an_ag500():
    rows = [GOOD, GOOD, GOOD]
    modern = parse_block(golden("ag501", rows, pos_ok=0b101), layout_named("ag501"))
    assert np.isnan(modern.positions[:3, 0]).tolist() == [False, True, False]
    old = parse_block(golden("ag500", rows, pos_ok=0), layout_named("ag500"))
    assert np.isfinite(old.positions[:3]).all()


@pytest.mark.parametrize("name", SIZES)
def test_what_the_simulator_builds_reads_as_it_was(name):
    layout = layout_named(name)
    random = np.random.default_rng(1)
    quaternions = random.normal(size=(5, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    positions = random.normal(scale=50.0, size=(5, 3)).astype("f4").astype(float)
    positions[3] = quaternions[3] = np.nan
    rms = np.array([1.0, 2.0, 3.0, np.nan, 4.0])
    data = build_block(Block(1234, True, 5, positions, quaternions, rms), layout)
    block = parse_block(data, layout)
    assert (block.counter, block.recording, block.sweep) == (1234, True, 5)
    np.testing.assert_array_equal(block.positions[:5], positions)
    np.testing.assert_array_equal(block.rms[:5], rms)
    np.testing.assert_allclose(
        axes_from_quaternions(block.quaternions[:5]), axes_from_quaternions(quaternions), atol=1e-4
    )
    assert np.isnan(block.positions[5:]).all()


def test_channels_are_called_as_in_recordings():
    assert coil_names(layout_named("ag500")) == tuple(f"Ch{k}" for k in range(1, 13))


@pytest.mark.parametrize("size", [0, 1, 959, 961, 3120])
def test_another_length_is_a_bad_block(size):
    with pytest.raises(BadBlock, match=f"{size} bytes"):
        parse_block(bytes(size), layout_named("ag500"))


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(LAYOUTS), st.data())
def test_arbitrary_blocks_give_finite_numbers_or_nan(layout, data):
    seed = data.draw(st.binary(max_size=64))
    raw = bytearray(build_block(_block(3), layout))
    for _ in range(data.draw(st.integers(0, 30))):
        raw[data.draw(st.integers(0, layout.size - 1))] = data.draw(st.integers(0, 255))
    raw[8 : 8 + len(seed)] = seed
    raw[-len(seed) - 1 : -1] = seed
    block = parse_block(bytes(raw[: layout.size].ljust(layout.size, b"\xff")), layout)
    for array in (block.positions, block.quaternions, block.rms):
        assert not np.isinf(array).any()
    there = np.isfinite(block.positions)
    assert (there.all(axis=1) == there.any(axis=1)).all()
    assert (np.abs(block.positions[there]) <= 1000.0).all()
    assert 0 <= block.counter < 2**31


def _block(coils):
    return Block(1, False, 1, np.ones((coils, 3)), np.tile([1.0, 0, 0, 0], (coils, 1)), np.ones(coils))


# Text replies ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "payload", "expected", "length"),
    [
        (b"200 Welcome\n", False, Reply(200, ("Welcome",)), 12),
        (b"200 Welcome\r\nrest", False, Reply(200, ("Welcome",)), 13),
        (b"200\n", False, Reply(200, ("",)), 4),
        (b"214-one\n214-two\n214 three\n", False, Reply(214, ("one", "two", "three")), 26),
        (b"200 Ok\nrsPrepared\n.\n200 ", True, Reply(200, ("Ok",), ("rsPrepared",)), 20),
        (b"200 Ok\n.\n", True, Reply(200, ("Ok",)), 9),
    ],
)
def test_replies(data, payload, expected, length):
    assert parse_reply(data, payload) == (expected, length)


@pytest.mark.parametrize(
    ("data", "payload"),
    [(b"", False), (b"20", False), (b"200 Ok", False), (b"200-a\n", False), (b"200 Ok\nrsOff\n", True)],
)
def test_an_unfinished_reply_is_waited_for(data, payload):
    assert parse_reply(data, payload) is None


@pytest.mark.parametrize(
    "data",
    [
        b"HTTP/1.1 400 Bad Request\n",
        b"\n",
        b"20\n",
        b"200:Ok\n",
        b"200-a\n500 b\n",
        "\u0662\u0660\u0660 Ok\n".encode(),
        b"2" * LONGEST_LINE,
        b"200-more\n" * MOST_LINES,
    ],
)
def test_anything_else_is_a_bad_reply(data):
    with pytest.raises(BadReply):
        parse_reply(data)


def test_a_payload_without_end_is_bounded():
    with pytest.raises(BadReply, match="lines"):
        parse_reply(b"200 Ok\n" + b"x\n" * MOST_LINES, payload=True)


REPLYLIKE = st.lists(
    st.sampled_from([b"200", b" ", b"-", b"\n", b"\r\n", b".", b"Ok", b"\x00", b"\xff", b"x" * 300])
)


@settings(max_examples=300, deadline=None)
@given(REPLYLIKE.map(b"".join), st.booleans())
def test_arbitrary_text_is_a_reply_or_unfinished_or_bad(data, payload):
    try:
        found = parse_reply(data, payload)
    except BadReply:
        return
    if found is not None:
        reply, length = found
        assert 0 < length <= len(data) and 0 <= reply.code <= 999


# The source against a scripted device -----------------------------------------------------------------


class Scripted:
    """A server that greets, and answers the n-th `data` with what a function of n gives."""

    def __init__(self, answer, greeting=b"200 Welcome\n"):
        self.answer, self.greeting = answer, greeting
        self.commands = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.settimeout(10)
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    @property
    def address(self):
        return f"carstens://127.0.0.1:{self.listener.getsockname()[1]}"

    def serve(self):
        try:
            while True:
                connection, _ = self.listener.accept()
                with connection, connection.makefile("rb") as lines:
                    connection.sendall(self.greeting)
                    asked = 0
                    for line in lines:
                        self.commands.append(line)
                        if line == b"data\n":
                            connection.sendall(self.answer(asked))
                            asked += 1
                        elif line == b"exit\n":
                            break
        except OSError:
            pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.listener.close()


def moving(name, jump=0, at=None):
    def answer(n):
        number = n + (jump if at is not None and n >= at else 0)
        return bytes(SIZES[name]) if n == 0 else golden(name, [(float(n), 2, 3, 0, 0, 1, 0)], word=number)

    return answer


@pytest.fixture(autouse=True)
def a_quick_handshake(monkeypatch):
    monkeypatch.setattr(carstens_source, "QUIET_S", 0.03)


def items(source, count):
    return list(itertools.islice(source, count))


def frames(found):
    return [item for item in found if isinstance(item, CoilFrame)]


def notes(found, kind):
    return [item for item in found if not isinstance(item, CoilFrame) and item.kind is kind]


@pytest.mark.parametrize("name", SIZES)
def test_the_layout_is_told_by_the_size_of_a_block(name):
    with Scripted(moving(name)) as device, open_device(parse_source(device.address)) as source:
        assert source.coils == coil_names(layout_named(name))
        found = frames(items(source, 4))
        assert [frame.frame_number for frame in found] == [2, 3, 4]
        assert [frame.positions[0, 0] for frame in found] == [2.0, 3.0, 4.0]
    assert device.commands[:2] == [b"data\n", b"data\n"]


def test_the_first_note_says_that_the_driver_never_met_the_hardware():
    with Scripted(moving("ag501")) as device, open_carstens(parse_source(device.address)) as source:
        first = next(source)
    assert first.kind is NoteKind.INFO
    assert "never tried against the hardware" in first.text and "ag501" in first.text


def test_a_run_that_begins_after_a_long_preparation_is_told_what_was_said_on_connecting():
    with Scripted(moving("ag500")) as device, open_carstens(parse_source(device.address)) as source:
        source.catch_up()
        assert "never tried" in notes(items(source, 2), NoteKind.INFO)[0].text


def test_the_device_is_told_goodbye():
    with Scripted(moving("ag500")) as device:
        open_carstens(parse_source(device.address)).close()
        for _ in range(200):
            if device.commands[-1] == b"exit\n":
                break
            time.sleep(0.01)
        assert device.commands[-1] == b"exit\n"


def test_an_unknown_size_is_said_with_the_layouts():
    with (
        Scripted(lambda n: bytes(1000)) as device,
        pytest.raises(InputError, match=r"1000 bytes.*ag500 \(960 bytes\)"),
    ):
        open_carstens(parse_source(device.address))


def test_another_size_than_that_of_the_stated_layout_is_refused():
    with Scripted(moving("ag501")) as device, pytest.raises(InputError, match=r"2448 bytes.*layout=ag500"):
        open_carstens(parse_source(device.address + "?layout=ag500"))


def test_text_in_the_place_of_a_block_is_shown():
    with Scripted(lambda n: b"503 not measuring\n") as device, pytest.raises(InputError, match="503 not"):
        open_carstens(parse_source(device.address))


def test_a_server_of_another_kind_is_named_so():
    greeting = b"SSH-2.0-OpenSSH_9.2\r\n"
    with (
        Scripted(lambda n: b"", greeting) as device,
        pytest.raises(InputError, match="not cs5recorder"),
    ):
        open_carstens(parse_source(device.address))


def test_a_server_that_refuses_is_quoted():
    greeting = b"421 Too many users\n"
    with Scripted(lambda n: b"", greeting) as device, pytest.raises(InputError, match="421 Too many users"):
        open_carstens(parse_source(device.address))


def test_nobody_at_the_address_is_an_input_error():
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    with pytest.raises(InputError, match=f"127.0.0.1:{port}"):
        open_carstens(parse_source(f"carstens://127.0.0.1:{port}"))


@pytest.mark.parametrize("options", ["layout=ag502", "poll=0", "poll=x", "rate=-1"])
def test_wrong_options_are_refused_before_anything_is_connected(options):
    with pytest.raises(InputError, match=re.escape(options)):
        open_carstens(parse_source(f"carstens://127.0.0.1:9?{options}"))


def test_the_stated_rate_makes_the_device_time():
    with (
        Scripted(moving("ag500")) as device,
        open_carstens(parse_source(device.address + "?rate=200&poll=400")) as source,
    ):
        assert source.rate_hz == 200.0
        found = frames(items(source, 3))
    assert [frame.device_time_s for frame in found] == [frame.frame_number / 200.0 for frame in found]


def test_without_a_rate_the_device_time_is_that_of_arrival():
    with Scripted(moving("ag500")) as device, open_carstens(parse_source(device.address)) as source:
        assert source.rate_hz == 250.0
        found = frames(items(source, 4))
    for before, after in itertools.pairwise(found):
        passed_s = (after.arrival_ns - before.arrival_ns) * 1e-9
        assert after.device_time_s - before.device_time_s == pytest.approx(passed_s, abs=1e-6)


def test_a_repeated_sample_is_delivered_once():
    with (
        Scripted(lambda n: moving("ag500")(n // 3 + 1)) as device,
        open_carstens(parse_source(device.address)) as source,
    ):
        found = frames(items(source, 5))
        assert source.duplicates == 0
    numbers = [frame.frame_number for frame in found]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_a_counter_that_stands_still_does_not_stop_what_moves():
    answer = lambda n: golden("ag500", [(float(n), 2, 3, 0, 0, 1, 0)], word=0)
    with Scripted(answer) as device, open_carstens(parse_source(device.address)) as source:
        found = frames(items(source, 4))
    assert [frame.positions[0, 0] for frame in found] == [2.0, 3.0, 4.0]


def test_a_single_impossible_counter_is_left_out_and_said():
    def answer(n):
        return moving("ag500")(n) if n != 6 else golden("ag500", [GOOD], word=0x4000_0006)

    with Scripted(answer) as device, open_carstens(parse_source(device.address)) as source:
        found = items(source, 10)
    assert len(notes(found, NoteKind.BAD_DATA)) == 1
    assert 6 not in [frame.frame_number for frame in frames(found)]
    assert max(frame.frame_number for frame in frames(found)) < 20
    assert not notes(found, NoteKind.CLOCK_RESET)


@pytest.mark.parametrize("jump", [100_000, 0x7000_0000])
def test_a_counter_that_goes_on_from_elsewhere_is_a_clock_reset_not_a_gap(jump):
    with (
        Scripted(moving("ag500", jump, at=6)) as device,
        open_carstens(parse_source(device.address)) as source,
    ):
        found = items(source, 12)
    assert len(notes(found, NoteKind.CLOCK_RESET)) == 1
    assert max(frame.frame_number for frame in frames(found)) > jump
    assert sum(note.count for note in notes(found, NoteKind.GAP)) <= 1


def test_the_beginning_and_the_end_of_a_recording_are_told():
    answer = lambda n: golden(
        "ag500", [(n, 2, 3, 0, 0, 1, 0)], word=n | (0x8000_0000 if 4 <= n < 6 else 0), sweep=12
    )
    with Scripted(answer) as device, open_carstens(parse_source(device.address)) as source:
        said = [note.text for note in notes(items(source, 8), NoteKind.INFO)[1:]]
    assert said == ["the device began to record sweep 12", "the device stopped recording"]


def test_a_device_that_sends_more_than_it_was_asked_for_is_connected_to_anew():
    def answer(n):
        return moving("ag500")(n) + (bytes(7) if n == 4 else b"")

    with Scripted(answer) as device, open_carstens(parse_source(device.address)) as source:
        found = items(source, 12)
    assert "more than" in notes(found, NoteKind.DISCONNECTED)[0].text
    assert notes(found, NoteKind.CONNECTED)


class FakeLink:
    """Gives pieces of bytes as they are, one a wait; at their end the connection closes."""

    address = "nowhere:30303"

    def __init__(self, pieces):
        self.pieces = list(pieces)

    def send(self, data):
        pass

    def receive(self, timeout_s):
        if not self.pieces:
            raise LinkLost("closed")
        return self.pieces.pop(0)

    def close(self):
        pass


def test_a_reader_that_was_kept_busy_finds_its_reply_and_does_not_ask_again(monkeypatch):
    asked = []
    monkeypatch.setattr(FakeLink, "send", lambda link, data: asked.append(data))
    clock = SimpleNamespace(now_s=0.0)
    fake = SimpleNamespace(perf_counter=lambda: clock.now_s, perf_counter_ns=lambda: int(clock.now_s * 1e9))
    monkeypatch.setattr(carstens_source, "time", fake)
    link = FakeLink([b"", golden("ag500", [GOOD], word=1)])
    conversation = CarstensConversation(link, layout_named("ag500"), 500.0, 0.0, 0)
    assert conversation.receive(0.0).kind is NoteKind.INFO
    assert conversation.receive(0.0) is None
    clock.now_s = 10.0
    assert conversation.receive(0.0).frame_number == 1
    assert asked == [b"data\n"]


PIECES = st.lists(
    st.binary(max_size=40)
    | st.integers(0, 50).map(lambda n: golden("ag500", [GOOD], word=n))
    | st.integers(1, 959).map(lambda n: golden("ag500", [GOOD])[:n]),
    max_size=12,
)


@settings(max_examples=200, deadline=None)
@given(PIECES)
def test_whatever_arrives_in_whatever_pieces_ends_in_a_lost_link_at_worst(pieces):
    link = FakeLink(pieces)
    conversation = CarstensConversation(link, layout_named("ag500"), 2000.0, 0.0, 0)
    with pytest.raises(LinkLost):
        for _ in range(1000):
            item = conversation.receive(0.001)
            assert item is None or isinstance(item, CoilFrame | SourceNote)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.binary(max_size=60) | st.sampled_from([b"200 Welcome\n", b"200-", bytes(960)]), max_size=8)
)
def test_whatever_answers_the_handshake_it_is_a_device_or_refused(pieces):
    try:
        assert shake_hands(FakeLink(pieces), "") in LAYOUTS
    except (InputError, LinkLost):
        pass


# The simulator, in a process of its own ---------------------------------------------------------------

SIMULATOR = """
import sys
import numpy as np
from tonguetrack.drivers import Recording
from tonguetrack.drivers.simulators.carstens_sim import run_carstens
from tonguetrack.drivers.simulators.faults import parse_faults
from tonguetrack.drivers.simulators.motion import SimulatedMotion
faults, layout, rate = sys.argv[1], sys.argv[2], float(sys.argv[3])
time = np.arange(1000) / rate
positions = np.stack([np.outer(np.ones(2), np.sin(time + k)).T * 10 + k for k in range(3)], axis=2)
recording = Recording(("tip", "mid"), positions, time, rate, "made")
motion = SimulatedMotion(recording)
run_carstens(motion, parse_faults(faults, recording.coils), host="127.0.0.1", port=0, layout=layout,
             announce=lambda text: print(text, flush=True), seconds=60.0)
"""


@pytest.fixture
def simulated(request):
    """Starts a simulator with faults and gives its address."""

    def start(faults="", layout="ag501", rate=250.0):
        process = subprocess.Popen(
            [sys.executable, "-c", SIMULATOR, faults, layout, str(rate)], stdout=subprocess.PIPE, text=True
        )

        def end():
            process.kill()
            process.wait()
            process.stdout.close()

        request.addfinalizer(end)
        return process.stdout.readline().strip()

    return start


def until(source, enough, seconds=20.0):
    """Items up to the one for which `enough(all of them)` holds."""
    found = []
    end = time.perf_counter() + seconds
    for item in source:
        found.append(item)
        if enough(found):
            return found
        assert time.perf_counter() < end, f"still not there after {seconds} s: {found[-5:]}"
    return found


def count_of(kind):
    return lambda found: notes(found, kind)


def expected_positions(frame, rate=250.0):
    time_s = ((frame.frame_number - 1) % 1000) / rate
    return np.array([[10 * np.sin(time_s + k) + k for k in range(3)]] * 2)


@pytest.mark.parametrize("layout", ["ag500", "ag501-16", "ag501-head"])
def test_the_simulator_streams_its_motion_in_a_layout(simulated, layout):
    address = simulated(layout=layout)
    assert re.fullmatch(rf"carstens://127\.0\.0\.1:\d+\?layout={layout}", address)
    with open_carstens(parse_source(address)) as source:
        found = frames(until(source, lambda found: len(frames(found)) >= 20))
    for frame in found:
        np.testing.assert_allclose(frame.positions[:2], expected_positions(frame), atol=1e-4)
        assert np.isnan(frame.positions[2:]).all()
    numbers = [frame.frame_number for frame in found]
    assert numbers == sorted(set(numbers))


def test_samples_of_a_faster_device_are_skipped_without_an_error(simulated):
    with open_carstens(parse_source(simulated(rate=1250.0) + "&rate=1250")) as source:
        found = frames(until(source, lambda found: len(frames(found)) >= 30))
    assert found[-1].frame_number - found[0].frame_number >= 60


def test_dropped_samples_are_a_gap(simulated):
    with open_carstens(parse_source(simulated("drop=0.3"))) as source:
        found = until(source, lambda found: len(frames(found)) >= 100)
    assert sum(note.count for note in notes(found, NoteKind.GAP)) > 10


@pytest.mark.parametrize("fault", ["duplicate=0.3", "reorder=0.3"])
def test_doubled_and_reordered_samples_are_delivered_once_and_in_order(simulated, fault):
    with open_carstens(parse_source(simulated(fault))) as source:
        found = frames(until(source, lambda found: len(frames(found)) >= 60))
    numbers = [frame.frame_number for frame in found]
    assert numbers == sorted(set(numbers))


def test_damaged_bytes_never_end_the_stream(simulated):
    with open_carstens(parse_source(simulated("corrupt=0.5"))) as source:
        found = until(source, lambda found: len(frames(found)) >= 150)
    assert not notes(found, NoteKind.DISCONNECTED)
    assert all(not np.isinf(frame.positions).any() for frame in frames(found))


def test_a_stall_is_silence_and_goes_on_by_itself(simulated):
    with open_carstens(parse_source(simulated("stall=0.8@0.4"))) as source:
        found = until(
            source, lambda found: notes(found, NoteKind.SILENT) and isinstance(found[-1], CoilFrame)
        )
    assert not notes(found, NoteKind.DISCONNECTED)


def test_a_device_that_does_not_answer_ten_times_is_lost_and_found_again(simulated):
    with open_carstens(parse_source(simulated("stall=60@0.4"))) as source:
        found = until(source, count_of(NoteKind.CONNECTED))
    assert "did not answer 10 times" in notes(found, NoteKind.DISCONNECTED)[0].text


def test_a_cut_connection_is_mended(simulated):
    with open_carstens(parse_source(simulated("disconnect@0.4"))) as source:
        until(source, count_of(NoteKind.DISCONNECTED))
        until(source, count_of(NoteKind.CONNECTED))
        assert frames(until(source, lambda found: len(frames(found)) >= 5))
        assert source.reconnections == 1


def test_a_jump_in_the_devices_count_is_told(simulated):
    with open_carstens(parse_source(simulated("jump=30@0.4"))) as source:
        found = until(
            source, lambda found: notes(found, NoteKind.CLOCK_RESET) and len(frames(found[-3:])) == 3
        )
    steps = np.diff([frame.frame_number for frame in frames(found)])
    assert (steps > 7000).sum() == 1


def test_a_dead_coil_is_missing_and_a_noisy_one_is_noisy(simulated):
    with open_carstens(parse_source(simulated("dead=tip,noisy=mid:5"))) as source:
        found = frames(until(source, lambda found: len(frames(found)) >= 40))
    assert all(np.isnan(frame.positions[0]).all() for frame in found)
    errors = [frame.positions[1] - expected_positions(frame)[1] for frame in found]
    assert 3.0 < np.std(errors) < 7.0


class Telnet:
    """A client that knows nothing of our code."""

    def __init__(self, address):
        host, port = re.match(r"carstens://([^:]+):(\d+)", address).groups()
        self.socket = socket.create_connection((host, int(port)), timeout=5)
        self.file = self.socket.makefile("rb")
        assert self.file.readline() == b"200 Welcome\n"

    def say(self, text):
        self.socket.sendall(text.encode())
        return self.file.readline().decode()

    def data(self, size):
        self.socket.sendall(b"data\n")
        return self.file.read(size)

    def next_sample(self, size):
        """Asked for until it is another one than the first that comes."""
        first = sample = self.data(size)
        while sample == first:
            sample = self.data(size)
        return sample


def test_the_simulator_is_as_strict_as_the_device(simulated):
    device = Telnet(simulated(layout="ag500"))
    assert device.data(960) == bytes(960)
    assert device.say("DATA\n").startswith("5")
    assert device.say("data \n").startswith("5")
    assert device.say("sstart\n").startswith("5")
    assert device.say("sstop\n").startswith("5")
    assert device.say("sprepare\n") == "200 Ok\n"
    assert [device.file.readline() for _ in range(2)] == [b"rsPrepared\n", b".\n"]
    assert device.say("sstart\n") == "200 Ok\n"
    word, sweep = struct.unpack_from("<II", device.next_sample(960))
    assert (word >> 31, sweep) == (1, 1)
    assert device.say("sstop\n") == "200 Ok\n"
    assert struct.unpack_from("<I", device.next_sample(960))[0] >> 31 == 0
    assert device.say("simplestart\n") == "200 Ok\n"
    assert struct.unpack_from("<II", device.next_sample(960))[1] == 2
    assert device.say("exit\n").startswith("200")
    assert device.file.read() == b""


def test_a_command_without_end_is_refused(simulated):
    device = Telnet(simulated())
    assert device.say("x" * 300).startswith("500")
    assert device.file.read() == b""


def motion(coils):
    names = tuple(f"c{k}" for k in range(coils))
    return SimulatedMotion(Recording(names, np.zeros((2, coils, 3)), np.arange(2) / 250.0, 250.0, "made"))


def test_what_cannot_be_simulated_is_an_input_error():
    never = pytest.fail
    with pytest.raises(InputError, match="'ag502' is unknown"):
        run_carstens(motion(1), FaultPlan(), host="127.0.0.1", port=0, announce=never, layout="ag502")
    with pytest.raises(InputError, match="13 coils do not fit"):
        run_carstens(motion(13), FaultPlan(), host="127.0.0.1", port=0, announce=never, layout="ag500")
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(InputError, match="another port"):
        run_carstens(
            motion(1), FaultPlan(), host="127.0.0.1", port=taken.getsockname()[1], announce=never, seconds=1.0
        )


def test_the_simulator_ends_when_its_time_is_over():
    told = []
    run_carstens(motion(1), FaultPlan(), host="127.0.0.1", port=0, announce=told.append, seconds=0.05)
    assert len(told) == 1
