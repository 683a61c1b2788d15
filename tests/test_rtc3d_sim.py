"""The RTC3D driver against servers as they are in use, the simulator as strict as the device, and both together."""

import itertools
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers import Recording, write_recording
from tonguetrack.drivers.devices import rtc3d, rtc3d_source
from tonguetrack.drivers.devices.link import LinkLost, TcpLink, connect_tcp
from tonguetrack.drivers.devices.rtc3d import BIG, LITTLE, Component
from tonguetrack.drivers.devices.source import DeviceSource
from tonguetrack.drivers.frames import CoilFrame, NoteKind, SourceNote
from tonguetrack.drivers.simulators import rtc3d_sim
from tonguetrack.drivers.simulators.faults import FaultPlan, Misbehaviour, parse_faults
from tonguetrack.drivers.simulators.motion import SimulatedMotion
from tonguetrack.drivers.sources import open_device, parse_source

COILS = ("tip", "mid", "back")
RATE_HZ = 400.0


# Servers that are told what to answer


def text(words, kind=rtc3d.COMMAND, nul=False):
    return rtc3d.encode_text(kind, words, nul)


def frame(number, sensors=3, order=BIG, time_us=None, missing=(), zeros=False, kinds=(rtc3d.SIX_D,)):
    """A data packet whose sensor k lies at (number, k, 1)."""
    positions = np.array([[number, k, 1.0] for k in range(sensors)])
    positions[list(missing)] = np.nan
    turns = np.tile([0.6, 0.8, 0.0, 0.0], (sensors, 1))
    made = {
        rtc3d.SIX_D: rtc3d.six_d_items(positions, turns, zeros=zeros),
        rtc3d.THREE_D: rtc3d.three_d_items(positions, zeros=zeros),
        rtc3d.ANALOG: np.ones((4, 1), np.float32),
    }
    time_us = number * 2500 if time_us is None else time_us
    components = [Component(kind, number, time_us, made[kind]) for kind in kinds]
    return rtc3d.encode_packet(rtc3d.DATA, rtc3d.encode_frame(components, order))


NO_PARAMETERS = text("Error-no parameters", rtc3d.ERROR)


class ScriptedServer:
    """Answers every command with what `answer(command)` gives: bytes, or a list of bytes and pauses in s."""

    def __init__(self, answer):
        self.answer = answer
        self.commands = []
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.1)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    @property
    def uri(self):
        return f"rtc3d://127.0.0.1:{self._listener.getsockname()[1]}"

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *reason):
        self._over.set()
        self._thread.join(5.0)
        self._listener.close()

    def _serve(self):
        while not self._over.is_set():
            try:
                connected, _ = self._listener.accept()
            except TimeoutError:
                continue
            self.connections += 1
            with connected:
                try:
                    self._talk(connected)
                except OSError:
                    pass

    def _talk(self, connected):
        connected.settimeout(0.05)
        reader = rtc3d.PacketReader()
        while not self._over.is_set():
            try:
                data = connected.recv(4096)
            except TimeoutError:
                continue
            if not data:
                return
            reader.feed(data)
            while (packet := reader.next()) is not None:
                command = packet.body.decode("ascii")
                self.commands.append(command)
                answer = self.answer(command)
                for piece in [answer] if isinstance(answer, bytes) else answer or []:
                    if isinstance(piece, bytes):
                        connected.sendall(piece)
                    else:
                        self._over.wait(piece)
                if command == "Bye":
                    return


def polite(stream, ok=lambda command: text(f"OK-{command}")):
    """A script: OK to everything, no parameters, and `stream` after each StreamFrames that asks for some."""

    def answer(command):
        if command.startswith("SendParameters"):
            return ok(command) + NO_PARAMETERS
        if command.lower().startswith("streamframes") and "stop" not in command.lower():
            return [ok(command), *stream]
        return ok(command)

    return answer


def items_of(source, frames=None, until=None, seconds=5.0):
    """Items until so many frames came, or one of the notes; frames are copied."""
    timer = threading.Timer(seconds, source.stop)
    timer.start()
    out, count = [], 0
    try:
        for item in source:
            if isinstance(item, CoilFrame):
                count += 1
                turns = None if item.quaternions is None else item.quaternions.copy()
                item = CoilFrame(
                    item.positions.copy(), item.device_time_s, item.frame_number, item.arrival_ns, turns
                )
            out.append(item)
            if (frames is not None and count >= frames) or (until and _is(item, until)):
                return out
    finally:
        timer.cancel()
    raise AssertionError(f"not enough came: {[item for item in out if isinstance(item, SourceNote)][:20]}")


def _is(item, kind):
    return isinstance(item, SourceNote) and item.kind is kind


def frames_of(items):
    return [item for item in items if isinstance(item, CoilFrame)]


def notes_of(items, kind):
    return [item for item in items if _is(item, kind)]


def play(script, frames, options=""):
    with ScriptedServer(script) as server, open_device(parse_source(server.uri + options)) as source:
        return source.coils, items_of(source, frames), server


@pytest.fixture
def hurried(monkeypatch):
    """Servers that do not answer are waited for less long."""
    monkeypatch.setattr(rtc3d_source, "REPLY_S", 0.1)
    monkeypatch.setattr(rtc3d_source, "FIRST_FRAME_S", 0.2)


def test_the_driver_greets_asks_for_frames_and_says_goodbye():
    with ScriptedServer(polite([frame(1)])) as server:
        with open_device(parse_source(server.uri)) as source:
            items_of(source, 1)
        deadline = time.perf_counter() + 2.0
        while "Bye" not in server.commands and time.perf_counter() < deadline:
            time.sleep(0.01)
    assert server.commands[:2] == ["Version 1.0", "SetByteOrder BigEndian"]
    assert server.commands[2:] == ["SendParameters All", "StreamFrames AllFrames 6D", "StreamFrames Stop", "Bye"]  # fmt: skip


def test_sensors_are_named_as_in_the_recordings_of_the_wave():
    coils, items, _ = play(polite([frame(7, sensors=2, missing=[1])]), 1)
    assert coils == ("Sensor 1", "Sensor 2")
    (got,) = frames_of(items)
    assert (got.frame_number, got.device_time_s) == (7, 7 * 0.0025)
    np.testing.assert_array_equal(got.positions, [[7, 0, 1], [np.nan] * 3])
    np.testing.assert_allclose(got.quaternions[0], [0.6, 0.8, 0, 0], atol=1e-7)


def test_every_ok_may_come_twice():
    twice = polite([frame(k) for k in range(1, 6)], ok=lambda c: text(f"OK-{c}") * 2)
    _, items, _ = play(twice, 5)
    assert [got.frame_number for got in frames_of(items)] == [1, 2, 3, 4, 5]


def test_oks_may_come_late_between_frames_and_say_anything(hurried):
    late = [text("whatever") + b"".join(frame(k) + text("OK?") for k in range(1, 6))]
    _, items, _ = play(lambda command: late if "AllFrames" in command else b"", 5)
    assert [got.frame_number for got in frames_of(items)] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("nul", [False, True])
def test_both_nul_dialects_are_understood(nul):
    script = polite([frame(1)], ok=lambda c: text(f"OK-{c}", nul=nul))
    _, items, server = play(script, 1)
    assert len(frames_of(items)) == 1
    assert not any("\0" in command for command in server.commands)


def test_frame_numbers_that_never_move_are_no_duplicates():
    stream = [frame(0, time_us=k * 10_000) for k in range(20)]
    _, items, _ = play(polite(stream), 20)
    assert [round(got.device_time_s * 100) for got in frames_of(items)] == list(range(20))
    assert not notes_of(items, NoteKind.GAP)


def test_missing_sensors_may_be_zeros():
    _, items, _ = play(polite([frame(1, missing=[1], zeros=True)]), 1)
    positions = frames_of(items)[0].positions
    np.testing.assert_array_equal(np.isnan(positions).all(axis=1), [False, True, False])


def test_time_that_jumps_back_is_told_and_tracking_goes_on():
    times = [*range(0, 1_000_000, 10_000), *range(50_000, 100_000, 10_000)]
    _, items, _ = play(polite([frame(0, time_us=t) for t in times]), len(times))
    assert len(notes_of(items, NoteKind.CLOCK_RESET)) == 1
    assert [round(got.device_time_s * 1e6) for got in frames_of(items)] == times


def test_other_components_than_those_asked_for_are_stepped_over():
    stream = [frame(k, kinds=(rtc3d.ANALOG, rtc3d.THREE_D, rtc3d.SIX_D)) for k in range(1, 4)]
    _, items, _ = play(polite(stream), 3)
    assert frames_of(items)[2].quaternions is not None


@pytest.mark.parametrize(("option", "sent"), [("", LITTLE), ("?order=little", BIG)])
def test_a_byte_order_other_than_agreed_on_is_told_and_understood(option, sent):
    _, items, server = play(polite([frame(k, order=sent) for k in range(1, 4)]), 3, option)
    assert [got.positions[0, 0] for got in frames_of(items)] == [1, 2, 3]
    assert any("although" in note.text for note in notes_of(items, NoteKind.INFO))
    assert f"SetByteOrder {'LittleEndian' if option else 'BigEndian'}" in server.commands


def test_no_data_is_told_once_and_silence_after_it_leads_to_a_new_connection():
    end = text("No more frames left in mocap file", rtc3d.NO_DATA)
    with ScriptedServer(polite([frame(1), frame(2), end * 3])) as server:
        host, port = server.uri[8:].split(":")

        def connect():
            return rtc3d_source.Rtc3dConversation(connect_tcp(host, int(port)))

        with DeviceSource(connect, server.uri, idle_s=0.2) as source:
            items = items_of(source, until=NoteKind.CONNECTED)
            again = items_of(source, 2)
    assert sum("no data" in note.text for note in notes_of(items, NoteKind.INFO)) == 1
    kinds = [item.kind for item in items if isinstance(item, SourceNote)]
    assert kinds.index(NoteKind.SILENT) < kinds.index(NoteKind.DISCONNECTED)
    assert len(frames_of(again)) == 2
    assert server.connections == 2


def test_a_server_that_begins_anywhere_in_its_recording_is_fine():
    _, items, _ = play(polite([frame(k) for k in range(4711, 4714)]), 3)
    assert [got.frame_number for got in frames_of(items)] == [4711, 4712, 4713]


def test_a_server_that_accepts_but_serves_somebody_else_is_refused_in_a_sentence(hurried):
    with (
        ScriptedServer(lambda command: b"") as server,
        pytest.raises(InputError, match="no frame with sensors"),
    ):
        open_device(parse_source(server.uri))


def test_nobody_there_is_a_sentence():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(InputError, match=f"127.0.0.1:{port}.*is the device on"):
        open_device(parse_source(f"rtc3d://127.0.0.1:{port}"))


def test_errors_are_tolerated_and_each_told_once(hurried):
    error = text("Error-unknown command", rtc3d.ERROR)
    _, items, _ = play(lambda c: [frame(1), error, error, frame(2)] if "AllFrames" in c else error, 2)
    assert sum("unknown command" in note.text for note in notes_of(items, NoteKind.INFO)) == 1


def test_who_has_no_6d_is_asked_for_everything_and_then_for_markers():
    def script(command):
        if command.endswith("AllFrames 3D"):
            return b"".join(frame(k, kinds=(rtc3d.THREE_D,)) for k in (1, 2))
        return text("no data", rtc3d.NO_DATA) if "StreamFrames" in command else polite([])(command)

    coils, items, server = play(script, 2)
    assert server.commands.index("StreamFrames AllFrames All") < server.commands.index(
        "StreamFrames AllFrames 3D"
    )
    assert len(coils) == 3
    assert [got.quaternions for got in frames_of(items)] == [None, None]
    assert [got.positions[0, 0] for got in frames_of(items)] == [1, 2]


def test_fewer_sensors_than_at_first_are_missing_and_more_are_left_out_with_a_word():
    stream = [frame(1, 3), frame(2, 2), frame(3, 5), frame(4, 5), frame(5, 3)]
    coils, items, _ = play(polite(stream), 5)
    assert len(coils) == 3
    assert [np.isfinite(got.positions[:, 0]).sum() for got in frames_of(items)] == [3, 2, 3, 3, 3]
    assert len([note for note in notes_of(items, NoteKind.INFO) if "5 sensors" in note.text]) == 1


def test_the_user_may_say_how_many_sensors_there_are():
    coils, items, _ = play(polite([frame(1, 3), frame(2, 16)]), 2, "?coils=16&rate=400")
    assert len(coils) == 16
    assert [np.isfinite(got.positions[:, 0]).sum() for got in frames_of(items)] == [3, 16]


@pytest.mark.parametrize("options", ["?coils=0", "?coils=2.5", "?coils=x", "?order=middle", "?rate=-1"])
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(InputError, match=options[1:].partition("=")[0]):
        open_device(parse_source(f"rtc3d://127.0.0.1:1{options}"))


@pytest.mark.parametrize("end", [text("bye"), struct.pack(">II", 60_000, 3), struct.pack(">II", 12, 9), b""])
def test_a_goodbye_or_nonsense_ends_the_connection_and_another_is_made(end):
    served = itertools.count()

    def script(command):
        if "AllFrames" not in command:
            return polite([])(command)
        # The first time it ends badly; where there is nothing to say, the damage is a frame cut short.
        return [frame(1) + (end or frame(2)[:40] + frame(3)[:60] * 2)] if next(served) == 0 else [frame(1)]

    with ScriptedServer(script) as server, open_device(parse_source(server.uri)) as source:
        items = items_of(source, until=NoteKind.CONNECTED)
        assert notes_of(items, NoteKind.DISCONNECTED)
        assert items_of(source, 1)
    assert server.connections == 2


def test_a_damaged_frame_is_left_out_and_counted():
    damaged = bytearray(frame(2))
    damaged[12:16] = b"\xff\xff\xff\x00"
    _, items, _ = play(polite([frame(1), bytes(damaged), frame(3)]), 2)
    assert [note.count for note in notes_of(items, NoteKind.BAD_DATA)] == [1]
    assert [got.frame_number for got in frames_of(items)] == [1, 3]


def test_parameters_that_are_stated_are_told_and_give_the_rate():
    xml = text(rtc3d.parameters_xml(400.0, ["jaw", "", "tip"]), rtc3d.XML)

    def script(command):
        return [text("OK"), xml] if command.startswith("SendP") else polite([frame(1)])(command)

    with ScriptedServer(script) as server, open_device(parse_source(server.uri)) as source:
        assert source.rate_hz == 400.0
        assert "jaw, (nothing), tip" in items_of(source, 1)[0].text


def test_nothing_is_read_while_whole_packets_are_waiting_and_frames_are_decoded_when_asked_for():
    class CountingLink(TcpLink):
        reads = 0

        def receive(self, timeout_s):
            type(self).reads += 1
            return super().receive(timeout_s)

    stream = b"".join(frame(k) for k in range(1, 101))
    with ScriptedServer(polite([stream])) as server:
        host, port = server.uri[8:].split(":")
        link = CountingLink(socket.create_connection((host, int(port))), "test")
        conversation = rtc3d_source.Rtc3dConversation(link)
        time.sleep(0.05)
        while not isinstance(conversation.receive(1.0), CoilFrame):
            pass
        reads = CountingLink.reads
        held = conversation.receive(1.0)
        assert held.positions[0, 0] == 2
        third = conversation.receive(1.0)
        assert held.positions is third.positions  # the arrays are used again
        assert held.positions[0, 0] == 3
        for _ in range(97):
            conversation.receive(1.0)
        assert CountingLink.reads - reads <= 2
        conversation.goodbye()


def test_parameters_without_names_are_not_told():
    xml = text(rtc3d.parameters_xml(100.0, ["", ""]), rtc3d.XML)

    def script(command):
        return [text("OK"), xml] if command.startswith("SendP") else polite([frame(1)])(command)

    with ScriptedServer(script) as server, open_device(parse_source(server.uri)) as source:
        assert len(items_of(source, 1)) == 1
        assert source.rate_hz == 100.0


class Bytes:
    """A link on which these pieces arrive, and then nothing for ever: it is lost."""

    address = "test"

    def __init__(self, pieces):
        self.pieces = iter(pieces)

    def send(self, data):
        pass

    def receive(self, timeout_s):
        try:
            return next(self.pieces)
        except StopIteration:
            raise LinkLost("the end") from None

    def close(self):
        pass


CONVERSED = text("OK") * 2 + text(rtc3d.parameters_xml(400.0, ["a"]), rtc3d.XML) + text("OK")
CONVERSED += b"".join(frame(k, missing=[1]) for k in range(1, 8)) + text("nothing", rtc3d.NO_DATA)


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, len(CONVERSED) - 1), st.integers(1, 255)), max_size=4),
    st.integers(1, 400),
    st.integers(0, len(CONVERSED)),
)
def test_whatever_a_server_sends_is_frames_notes_or_a_lost_link(damages, step, end):
    stream = bytearray(CONVERSED)
    for place, damage in damages:
        stream[place] ^= damage
    stream = bytes(stream[:end])
    pieces = [stream[start : start + step] for start in range(0, len(stream), step)]
    with pytest.raises(LinkLost):
        conversation = rtc3d_source.Rtc3dConversation(Bytes(pieces))
        for _ in range(1000):
            item = conversation.receive(1.0)
            assert isinstance(item, CoilFrame | SourceNote)
            assert not isinstance(item, CoilFrame) or len(item.positions) == len(conversation.coils)


@pytest.mark.parametrize("flood", [text("OK"), text("Error-x", rtc3d.ERROR), rtc3d.encode_packet(rtc3d.DATA, bytes(4))])  # fmt: skip
def test_a_flood_of_what_is_no_frame_ends_the_handshake_and_every_wait(hurried, flood):
    with pytest.raises(LinkLost, match="no frame with sensors"):
        rtc3d_source.Rtc3dConversation(Bytes(itertools.repeat(flood * 10)))
    answers = itertools.chain([CONVERSED], itertools.repeat(flood * 10))
    conversation = rtc3d_source.Rtc3dConversation(Bytes(answers))
    items = [conversation.receive(0.01) for _ in range(15)]
    assert items[-1] is None and len(conversation._notes) <= 1


# The simulator, spoken to by hand


def recording(frames=400, coils=COILS, rate=RATE_HZ):
    positions = np.zeros((frames, len(coils), 3))
    positions[:, :, 0] = np.arange(len(coils)) * 10.0
    positions[:, :, 1] = 5.0 * np.sin(np.arange(frames) / 30.0)[:, None]
    return Recording(tuple(coils), positions, np.arange(frames) / rate, rate, "made")


MAIN = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    return write_recording(recording(), tmp_path_factory.mktemp("rtc3d") / "played.csv")


@contextmanager
def simulator(played, *options):
    """A simulator as its own process; gives its URI and, after the block, that it ended well."""
    command = [
        sys.executable,
        "-c",
        MAIN,
        "simulate",
        "device",
        "rtc3d",
        "--from",
        str(played),
        "--port",
        "0",
    ]
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        uri = process.stdout.readline().strip()
        if not uri:
            raise AssertionError(process.stderr.read())
        yield uri
        if "--seconds" not in options:
            process.terminate()
        _, errors = process.communicate(timeout=10)
        assert process.returncode == 0, errors
        assert "Traceback" not in errors
    finally:
        process.kill()
        process.communicate()


class Hand:
    """Speaks to a server packet by packet."""

    def __init__(self, uri):
        host, _, port = uri.removeprefix("rtc3d://").rpartition(":")
        self.socket = socket.create_connection((host, int(port)), 5.0)
        self.socket.settimeout(5.0)
        self._reader = rtc3d.PacketReader()

    def __enter__(self):
        return self

    def __exit__(self, *reason):
        self.socket.close()

    def say(self, command, nul=False):
        self.socket.sendall(text(command, nul=nul))

    def hear(self):
        while (packet := self._reader.next()) is None:
            data = self.socket.recv(65536)
            if not data:
                return None
            self._reader.feed(data)
        return packet

    def ask(self, command, nul=False):
        self.say(command, nul)
        return self.hear()

    def numbers(self, count):
        """Frame numbers of the next data packets."""
        out = []
        while len(out) < count:
            packet = self.hear()
            if packet.kind == rtc3d.DATA:
                out.append(rtc3d.decode_frame(packet.body, BIG)[0].number)
        return out


@pytest.fixture(scope="module")
def quiet_device(played):
    with simulator(played) as uri:
        yield uri


def test_the_simulator_says_nothing_first_and_answers_each_command_once(quiet_device):
    with Hand(quiet_device) as hand:
        hand.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            hand.hear()
        hand.socket.settimeout(5.0)
        assert hand.ask("Version 1.0").kind == rtc3d.COMMAND
        assert hand.ask("VERSION 1.0").kind == rtc3d.COMMAND  # commands are case-insensitive
        assert hand.ask("SendParameters All").kind == rtc3d.COMMAND
        xml = hand.hear()
        assert xml.kind == rtc3d.XML
        assert rtc3d.parse_parameters(xml.body) == rtc3d.Parameters(RATE_HZ, COILS)
        assert hand.ask("Bye").kind == rtc3d.COMMAND
        assert hand.hear() is None


@pytest.mark.parametrize(
    "command",
    ["", "Hello", "Version 2.0", "Version", "SetByteOrder MiddleEndian", "SetByteOrder", "SendCurrentFrame 7D",
     "StreamFrames", "StreamFrames Often", "StreamFrames Frequency:0", "StreamFrames Frequency:x",
     "StreamFrames AllFrames 7D", "StreamFrames AllFrames:2", "StreamFrames Stop now", "SendParameters 8D", "Bye bye",
     "Recording Start", "x" * 2000],
)  # fmt: skip
def test_the_simulator_refuses_what_it_does_not_know(quiet_device, command):
    with Hand(quiet_device) as hand:
        answer = hand.ask(command)
        assert answer.kind == rtc3d.ERROR
        assert rtc3d.text_of(answer.body).startswith("Error-")
        assert hand.ask("Version 1.0").kind == rtc3d.COMMAND  # and listens on


def test_one_frame_comes_when_asked_for_in_the_byte_order_agreed_on(quiet_device):
    with Hand(quiet_device) as hand:
        for words, order in (("BigEndian", BIG), ("LittleEndian", LITTLE)):
            assert hand.ask(f"SetByteOrder {words}").kind == rtc3d.COMMAND
            assert hand.ask("SendCurrentFrame 3D 6D").kind == rtc3d.COMMAND
            components = rtc3d.decode_frame(hand.hear().body, order)
            assert [c.kind for c in components] == [rtc3d.THREE_D, rtc3d.SIX_D]
            assert components[0].time_us == components[0].number * 2500
        hand.ask("SendCurrentFrame Analog")
        assert hand.hear().kind == rtc3d.NO_DATA


@pytest.mark.parametrize(
    ("pace", "step"), [("AllFrames", 1), ("Frequency:50", 8), ("Frequency:1000", 1), ("FrequencyDivisor:3", 3)]
)  # fmt: skip
def test_frames_come_as_often_as_asked_for_until_stopped(quiet_device, pace, step):
    with Hand(quiet_device) as hand:
        assert hand.ask(f"StreamFrames {pace}").kind == rtc3d.COMMAND
        assert np.unique(np.diff(hand.numbers(6))) == [step]
        hand.say("StreamFrames Stop")
        while hand.hear().kind != rtc3d.COMMAND:
            pass
        hand.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            hand.hear()


def test_what_is_no_packet_ends_the_connection_and_the_server_goes_on(quiet_device):
    with Hand(quiet_device) as hand, Hand(quiet_device) as other:
        hand.socket.sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert hand.hear() is None
        assert other.ask("Version 1.0").kind == rtc3d.COMMAND
        other.socket.sendall(rtc3d.encode_packet(rtc3d.DATA, b"x"))
        assert other.hear().kind == rtc3d.ERROR


def test_the_nul_dialect_is_the_servers_choice(played, quiet_device):
    with Hand(quiet_device) as hand:
        answer = hand.ask("Version 1.0", nul=True)
        assert answer.kind == rtc3d.ERROR and b"NUL" in answer.body
    with simulator(played, "--nul") as uri, Hand(uri) as hand:
        assert hand.ask("Version 1.0", nul=True).body.endswith(b"\0")
        assert hand.ask("Version 1.0").body.endswith(b"\0")
        hand.ask("StreamFrames AllFrames")
        hand.numbers(1)


def test_the_simulator_says_bye_when_it_ends(played):
    with simulator(played, "--seconds", "0.4") as uri, Hand(uri) as hand:
        assert rtc3d.text_of(hand.hear().body) == "bye"
        assert hand.hear() is None


@contextmanager
def served(motion):
    """A simulator within this process; ends with the block."""
    found = []
    ready = threading.Event()

    def announce(uri):
        found.append(uri)
        ready.set()

    arguments = {"host": "127.0.0.1", "port": 0, "announce": announce, "seconds": 4.0}
    thread = threading.Thread(
        target=rtc3d_sim.run_rtc3d, args=(motion, FaultPlan()), kwargs=arguments, daemon=True
    )
    thread.start()
    assert ready.wait(5.0)
    yield found[0]


def test_a_client_that_does_not_read_is_dropped_and_slows_nobody(monkeypatch):
    monkeypatch.setattr(rtc3d_sim, "DROP_AFTER_S", 0.2)
    names = [f"coil {k}" for k in range(200)]
    motion = SimulatedMotion(recording(coils=names, rate=400.0))
    with served(motion) as uri, Hand(uri) as deaf, Hand(uri) as reader:
        deaf.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.say("StreamFrames AllFrames")
        reader.say("StreamFrames AllFrames")
        numbers = reader.numbers(600)
        assert numbers == list(range(numbers[0], numbers[0] + 600))
        with pytest.raises(OSError):  # broken pipe or reset, as the system likes
            for _ in range(200):
                deaf.say("Version 1.0")
                time.sleep(0.005)


# Both together, and everything that can go wrong


@pytest.mark.parametrize("options", [(), ("--nul",), ("--missing", "zeros")])
@pytest.mark.parametrize("order", ["big", "little"])
def test_the_driver_gets_what_the_simulator_plays(played, options, order):
    take = recording()
    with (
        simulator(played, *options, "--faults", "dead=mid") as uri,
        open_device(parse_source(f"{uri}?order={order}")) as source,
    ):
        assert source.rate_hz == RATE_HZ
        got = frames_of(items_of(source, 30))
    for item in got:
        assert item.device_time_s == pytest.approx(item.frame_number / RATE_HZ)
        expected = take.positions[(item.frame_number - 1) % take.frame_count].copy()
        expected[1] = np.nan
        np.testing.assert_allclose(item.positions, expected, atol=1e-5)
        assert np.isnan(item.quaternions[1]).all() and np.isfinite(item.quaternions[[0, 2]]).all()
    assert np.unique(np.diff([item.frame_number for item in got])) == [1]


def numbers_and_gaps(items):
    """Numbers of all frames after the first that something was told about, and what gaps were told in all."""
    numbers = [item.frame_number for item in frames_of(items)]
    return numbers, sum(note.count for note in notes_of(items, NoteKind.GAP))


def test_dropped_frames_are_counted_as_gaps(played):
    with simulator(played, "--faults", "drop=0.2@0.1") as uri, open_device(parse_source(uri)) as source:
        numbers, missing = numbers_and_gaps(items_of(source, 200))
    assert missing == numbers[-1] - numbers[0] + 1 - len(numbers)
    assert missing > 10


def test_frames_that_come_twice_are_delivered_once(played):
    with simulator(played, "--faults", "duplicate=0.2@0.01") as uri, open_device(parse_source(uri)) as source:
        numbers, missing = numbers_and_gaps(items_of(source, 200))
        assert source.duplicates > 10
    assert numbers == list(range(numbers[0], numbers[0] + 200))
    assert missing == 0


def test_frames_out_of_order_are_left_out_and_counted(played):
    with simulator(played, "--faults", "reorder=0.1@0.1") as uri, open_device(parse_source(uri)) as source:
        numbers, missing = numbers_and_gaps(items_of(source, 200))
        late = source.late
    assert (np.diff(numbers) > 0).all()
    assert late > 5
    assert missing in (late, late + 1)


def test_corrupt_bytes_never_end_the_stream(played):
    with simulator(played, "--faults", "corrupt=0.3") as uri, open_device(parse_source(uri)) as source:
        items = items_of(source, 150, seconds=15.0)
    assert any(_is(item, NoteKind.BAD_DATA) or _is(item, NoteKind.DISCONNECTED) for item in items)
    for item in frames_of(items):
        assert not (np.abs(item.positions) > rtc3d.FARTHEST).any()


def test_a_stall_is_told_and_the_burst_after_it_is_whole(played):
    with simulator(played, "--faults", "stall=0.5@0.2") as uri, open_device(parse_source(uri)) as source:
        items = items_of(source, 200)
    numbers, missing = numbers_and_gaps(items)
    assert notes_of(items, NoteKind.SILENT)
    assert missing == 0
    assert numbers == list(range(numbers[0], numbers[0] + 200))


def test_a_cut_connection_is_told_and_made_again(played):
    with simulator(played, "--faults", "disconnect@0.2") as uri, open_device(parse_source(uri)) as source:
        items = items_of(source, until=NoteKind.CONNECTED)
        items += items_of(source, 10)
        assert source.reconnections == 1
    kinds = [item.kind if isinstance(item, SourceNote) else None for item in items]
    gone, back = kinds.index(NoteKind.DISCONNECTED), kinds.index(NoteKind.CONNECTED)
    assert None in kinds[:gone] and None not in kinds[gone:back] and None in kinds[back:]


@pytest.mark.parametrize("seconds", [-100, 100])
def test_a_jump_in_time_is_told_and_no_frame_is_lost(played, seconds):
    with (
        simulator(played, "--faults", f"jump={seconds}@0.25") as uri,
        open_device(parse_source(uri)) as source,
    ):
        items = items_of(source, 150)
    numbers, missing = numbers_and_gaps(items)
    assert notes_of(items, NoteKind.CLOCK_RESET)
    assert numbers == list(range(numbers[0], numbers[0] + 150))
    assert missing == 0


def test_a_coil_dies_and_comes_back(played):
    with simulator(played, "--faults", "dead=mid@0.1-0.3") as uri, open_device(parse_source(uri)) as source:
        got = frames_of(items_of(source, 150))
    dead = np.array([np.isnan(item.positions).all(axis=1) for item in got])
    assert not dead[:, [0, 2]].any()
    np.testing.assert_array_equal(np.flatnonzero(dead[:, 1]), np.arange(40, 120))


def test_a_coil_goes_wild(played):
    with simulator(played, "--faults", "noisy=mid:5") as uri, open_device(parse_source(uri)) as source:
        x = np.array([item.positions[:, 0] for item in frames_of(items_of(source, 100))])
    assert (x.std(axis=0) > 2.0).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["rtc3d"], "required"),
        (["toaster", "--synthetic"], "toaster"),
        (["rtc3d", "--synthetic", "--from", "x"], "not allowed"),
    ],
)
def test_a_command_line_that_is_incomplete_is_refused(options, words, capsys):
    from tonguetrack.tracker.cli import main

    with pytest.raises(SystemExit):
        main(["simulate", "device", *options])
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["rtc3d", "--pty"], "--pty is for"),
        (["rtc3d", "--layout", "ag501"], "--layout is for"),
        (["ndi", "--nul"], "--nul is for"),
        (["carstens", "--missing", "ff"], "--missing is for"),
        (["ndi", "--pty", "--rfc2217"], "choose one"),
        (["rtc3d", "--coils", "tongue_tip"], "--coils goes with --synthetic"),
        (["rtc3d", "--seed", "2"], "--seed goes with --synthetic"),
        (["rtc3d", "--rate", "0"], "--rate 0"),
        (["rtc3d", "--port", "70000"], "--port 70000"),
        (["rtc3d", "--sensors", "0"], "--sensors 0"),
        (["rtc3d", "--seconds", "-1"], "--seconds -1"),
        (["rtc3d", "--faults", "explode"], "explode"),
        (["rtc3d", "--faults", "dead=nose"], "tip, mid, back"),
    ],
)
def test_options_that_would_do_nothing_or_harm_are_refused(played, options, words, capsys):
    from tonguetrack.tracker.cli import main

    assert main(["simulate", "device", *options, "--from", str(played)]) == 2
    assert words in capsys.readouterr().err


def test_options_of_files_are_refused_for_a_synthetic_speaker(capsys):
    from tonguetrack.tracker.cli import main

    assert main(["simulate", "device", "rtc3d", "--synthetic", "--file-rate", "100"]) == 2
    assert "--file-rate goes with --from" in capsys.readouterr().err


def test_a_file_that_needs_to_be_told_more_is_told_how_here(tmp_path, capsys):
    from tonguetrack.tracker.cli import main

    (tmp_path / "a.csv").write_text("tip_x,tip_y,tip_z\n" + "1,2,3\n" * 20, encoding="utf-8")
    assert main(["simulate", "device", "rtc3d", "--from", str(tmp_path / "a.csv"), "--rate", "100"]) == 2
    assert "pass it with --file-unit" in capsys.readouterr().err


def test_a_port_that_is_taken_is_refused_in_a_sentence(played, capsys):
    from tonguetrack.tracker.cli import main

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["simulate", "device", "rtc3d", "--from", str(played), "--port", port]) == 2
    assert f"127.0.0.1:{port}" in capsys.readouterr().err


def test_a_synthetic_device_is_filled_up_to_the_number_of_sensors():
    command = [sys.executable, "-c", MAIN, "simulate", "device", "rtc3d", "--synthetic", "--sensors", "16",
               "--rate", "100", "--port", "0", "--seconds", "30"]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            with open_device(parse_source(process.stdout.readline().strip())) as source:
                got = frames_of(items_of(source, 3))
        finally:
            process.kill()
    assert len(source.coils) == 16
    assert np.isfinite(got[0].positions).all()
    assert len(np.unique(got[0].positions.round(3), axis=0)) == 16


def test_misbehaviour_of_one_connection_is_not_that_of_another():
    plan = parse_faults("disconnect@1", COILS)
    first, second = Misbehaviour(plan), Misbehaviour(plan)
    assert first.cut(2.0) and not first.cut(3.0)
    assert second.cut(2.0)
