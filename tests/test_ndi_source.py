"""The NDI driver against a small scripted device: on a serial line in memory, on a pseudo-terminal, over TCP."""

import itertools
import os
import socket
import threading
import time

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers.devices import ndi, ndi_source, ndi_tracking
from tonguetrack.drivers.devices.link import LinkLost, SerialLink
from tonguetrack.drivers.devices.ndi_tracking import State, ToolState, TrackingReply
from tonguetrack.drivers.frames import CoilFrame, NoteKind
from tonguetrack.drivers.sources import open_device, parse_source

UNIT = (1.0, 0.0, 0.0, 0.0)
FAST_S = 0.15


def tool(handle, number, position=(1.0, 2.0, 3.0), state=State.VALID):
    if state is not State.VALID:
        return ToolState(handle, state, port_status=0x71, frame_number=number)
    return ToolState(handle, state, UNIT, position, 0.5, 0x31, number)


class Device:
    """Answers commands from a table; every poll takes the next of `measurements`, the last one again and again.

    answers: name or whole command -> text, bytes, or NdiError code; it stands before the table. baud: the only
    speed at which it hears. asked: all commands as "NAME:ARGUMENTS".
    """

    def __init__(self, handles=(0x0A, 0x0B), measurements=(), **answers):
        self.handles = handles
        self.measurements = list(measurements)
        self.answers = answers
        self.baud = 9600
        self.resets = 0
        self.asked = []
        self._line = b""

    def reset(self):
        self.resets += 1
        self.baud = 9600
        return ndi.reply("RESET")

    def hear(self, data):
        self._line += data
        out = b""
        while b"\r" in self._line:
            line, _, self._line = self._line.partition(b"\r")
            command = ndi.parse_command(line)
            assert command.crc_ok
            self.asked.append(f"{command.name}:{command.arguments}")
            out += self._answer(command)
        return out

    def _answer(self, command):
        name, arguments = command.name, command.arguments
        answer = self.answers.get(f"{name}:{arguments}", self.answers.get(name))
        if callable(answer):
            answer = answer()
        if answer is None:
            answer = getattr(self, f"_{name.lower()}", lambda _: "OKAY")(arguments)
        if isinstance(answer, int):
            return ndi.error_reply(answer)
        return answer if isinstance(answer, bytes) else ndi.reply(answer)

    def _phsr(self, which):
        status = {"01": (), "02": (), "03": self.handles, "00": self.handles}[which]
        return ndi.encode_phsr(tuple(ndi.PortHandle(handle, 0x1F) for handle in status))

    def _phinf(self, arguments):
        handle, options = divmod(int(arguments, 16), 0x10000)
        port, channel = divmod(handle - 0x0A, 2)
        place = ndi.PortLocation("A4-00001", "1", "0", f"{port + 1:02X}", f"{channel:02}")
        information = ndi.ToolInformation(self.tool_type(handle), "MAKER", "001", "12345678", 0x1F)
        return ndi.encode_phinf(ndi.PortInformation(information, "PART", place), options)

    def tool_type(self, handle):
        return 0x02

    def _ver(self, arguments):
        return "Aurora Control Firmware\nFreeze Tag: AURORA Rev 013\n"

    def _getinfo(self, arguments):
        return "Features.Firmware.Version=013\n"

    def _bx(self, arguments):
        return self._measured(lambda reply: ndi_tracking.encode_bx(reply, 0x0801))

    def _tx(self, arguments):
        return self._measured(lambda reply: ndi.reply(ndi_tracking.encode_tx(reply, 0x0801)))

    def _measured(self, encode):
        measurement = self.measurements.pop(0) if len(self.measurements) > 1 else self.measurements[0]
        return measurement if isinstance(measurement, bytes) else encode(TrackingReply(measurement))


class Port:
    """A serial line in memory, as pyserial shows it: what comes at another speed than the device's is lost."""

    write_timeout = None

    def __init__(self, device):
        self.device = device
        self.baudrate = 9600
        self.closed = False
        self._waiting = b""
        self._break = False

    @property
    def break_condition(self):
        return self._break

    @break_condition.setter
    def break_condition(self, on):
        if self._break and not on and self.device.answers.get("BREAK") != b"":
            self._waiting += b"\x00" + self.device.reset()
        self._break = on

    def reset_input_buffer(self):
        self._waiting = b""

    def reset_output_buffer(self):
        pass

    @property
    def in_waiting(self):
        return len(self._waiting)

    def write(self, data):
        baud = self.device.baud
        if baud == self.baudrate:
            self._waiting += self.device.hear(data)

    def read(self, size):
        if not self._waiting:
            time.sleep(0.001)
        data, self._waiting = self._waiting[:size], self._waiting[size:]
        return data

    def close(self):
        self.closed = True


@pytest.fixture(autouse=True)
def short_waits(monkeypatch):
    """As long as a device in memory needs."""
    for name in (
        "RESET_TIMEOUT_S",
        "COMMAND_TIMEOUT_S",
        "SLOW_TIMEOUT_S",
        "POLL_TIMEOUT_S",
        "SEARCH_TIMEOUT_S",
    ):
        monkeypatch.setattr(ndi_source, name, FAST_S)
    monkeypatch.setattr(ndi_source, "BREAK_S", 0.0)
    monkeypatch.setattr(ndi_source, "SPEED_PAUSE_S", 0.0)
    monkeypatch.setattr(ndi_source, "QUIET_S", 0.05)
    monkeypatch.setattr(ndi_source, "DAMAGED_QUIET_S", 0.02)


@pytest.fixture
def serial(monkeypatch):
    """Opens a source on a scripted device; `opened` has the ports, one for every connection."""

    class Opener:
        opened = ()

        def __call__(self, device, options=""):
            def open_port(path, baud):
                self.opened.append(Port(device))
                return SerialLink(self.opened[-1], path)

            self.opened = []
            monkeypatch.setattr(ndi_source, "open_serial", open_port)
            return open_device(parse_source(f"ndi:///dev/scripted{options}"))

    return Opener()


def items_of(source, frames):
    """Everything up to that many frames; frames as (number, positions, status), copied."""
    found, seen = [], 0
    ends_s = time.perf_counter() + 20
    for item in source:
        if isinstance(item, CoilFrame):
            seen += 1
            found.append((item.frame_number, item.positions.copy(), item.status.copy()))
        elif item.kind is not NoteKind.SILENT:
            found.append(item)
        assert time.perf_counter() < ends_s
        if seen == frames:
            return found
    return found


def frames_of(items):
    return [item for item in items if isinstance(item, tuple)]


def texts_of(items, kind):
    return [item.text for item in items if not isinstance(item, tuple) and item.kind is kind]


def moving(*numbers, handles=(0x0A, 0x0B)):
    return [tuple(tool(handle, number) for handle in handles) for number in numbers]


# --- the handshake ------------------------------------------------------------------------------------------


def test_the_handshake_on_a_serial_line(serial):
    device = Device(measurements=moving(8, 16))
    device.answers["COMM:60000"] = lambda: setattr(device, "baud", 921600)
    with serial(device) as source:
        assert source.coils == ("port 1", "port 1b")
        assert serial.opened[0].baudrate == 921600
        items_of(source, 1)
    asked = [name for name in device.asked if not name.startswith("BX")]
    assert asked == [
        "INIT:", "COMM:60000", "PHSR:00", "VER:4", "GETINFO:Features.Firmware.Version", "PHSR:01", "PHSR:02",
        "PHSR:03", "PHINF:0A0025", "PENA:0AD", "PHINF:0B0025", "PENA:0BD", "TSTART:", "TSTOP:", "COMM:00000",
    ]  # fmt: skip
    assert device.resets == 1
    assert serial.opened[0].closed


def test_a_speed_that_the_device_refuses_is_left_for_the_next(serial):
    device = Device(measurements=moving(8, 16))
    device.answers |= {"COMM:60000": 0x07, "COMM:A0000": 0x07}
    device.answers["COMM:50000"] = lambda: setattr(device, "baud", 115200)
    with serial(device) as source:
        items = items_of(source, 1)
    assert serial.opened[0].baudrate == 115200
    assert "the line runs at 115200 baud; 921600 did not work" in texts_of(items, NoteKind.INFO)


def test_a_speed_that_fails_on_the_way_is_given_up_by_a_reset(serial):
    device = Device(measurements=moving(8, 16))
    device.answers["COMM:60000"] = lambda: setattr(device, "baud", 1)  # not a word comes back at 921600
    device.answers["COMM:A0000"] = lambda: setattr(device, "baud", 230400)
    with serial(device) as source:
        assert len(frames_of(items_of(source, 1))) == 1
    assert (serial.opened[0].baudrate, device.resets) == (230400, 2)


def test_the_speed_that_was_asked_for_is_taken(serial):
    device = Device(measurements=moving(8, 16))
    device.answers["COMM:50000"] = lambda: setattr(device, "baud", 115200)
    with serial(device, "?baud=115200") as source:
        items_of(source, 1)
    assert [name for name in device.asked if name.startswith("COMM")] == ["COMM:50000", "COMM:00000"]


def test_at_9600_baud_there_is_nothing_to_negotiate(serial):
    device = Device(measurements=moving(8, 16))
    with serial(device, "?baud=9600") as source:
        items_of(source, 1)
    assert not any(name.startswith("COMM") for name in device.asked)


def test_a_device_that_does_not_answer_a_break_is_looked_for_at_all_speeds(serial):
    device = Device(measurements=moving(8, 16), BREAK=b"")
    device.baud = 115200
    with serial(device, "?baud=115200") as source:
        items = items_of(source, 1)
    assert "the device did not answer a break but INIT at 115200 baud" in texts_of(items, NoteKind.INFO)


def test_where_nobody_answers_the_sentence_says_what_was_tried(serial):
    device = Device(BREAK=b"")
    device.baud = 1
    with pytest.raises(
        InputError, match=r"no answer to a break within .* nor to INIT at 9600, 921600, .*baud"
    ):
        serial(device)
    assert serial.opened[0].closed


def test_a_speed_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="baud=9601: expected one of 9600, 14400"):
        open_device(parse_source("ndi:///dev/ttyUSB0?baud=9601"))


def test_a_port_that_does_not_exist_is_named():
    with pytest.raises(InputError, match="/dev/no-such-port"):
        open_device(parse_source("ndi:///dev/no-such-port"))


def test_a_damaged_reply_in_the_handshake_is_asked_for_again(serial):
    device = Device(measurements=moving(8, 16))
    replies = iter([b"OKAYA897\r", b"OK", ndi.error_reply(0x04)])
    device.answers["TSTART"] = lambda: next(replies, "OKAY")
    with pytest.raises(InputError, match="what comes back for TSTART is damaged, 3 times"):
        serial(device, "?baud=9600")
    replies = iter([b"OKAYA897\r", b"OK"])
    with serial(device, "?baud=9600") as source:
        assert len(frames_of(items_of(source, 1))) == 1


def test_a_device_that_refuses_to_track_is_quoted(serial):
    with pytest.raises(InputError, match="the device refused: ERROR12: tracking could not be started"):
        serial(Device(TSTART=0x12))


def test_a_device_that_is_still_tracking_is_stopped_before_it_is_initialised(serial):
    device = Device(measurements=moving(8, 16))
    replies = iter([ndi.error_reply(0x0C)])
    device.answers["INIT"] = lambda: next(replies, "OKAY")
    with serial(device, "?baud=9600") as source:
        items_of(source, 1)
    assert device.asked[:3] == ["INIT:", "TSTOP:", "INIT:"]


# --- tools --------------------------------------------------------------------------------------------------


def test_handles_that_are_left_over_are_freed_and_new_ones_initialised(serial):
    device = Device(measurements=moving(8, 16))
    device.answers["PHSR:01"] = ndi.encode_phsr((ndi.PortHandle(0x05, 0x00),))
    new = iter([(0x0A,), (0x0B,)])  # the second coil of a tool appears with the first
    device.answers["PHSR:02"] = lambda: ndi.encode_phsr(tuple(ndi.PortHandle(h, 0x01) for h in next(new, ())))
    with serial(device, "?baud=9600"):
        pass
    steps = [name for name in device.asked if name.startswith(("PHF", "PINIT"))]
    assert steps == ["PHF:05", "PINIT:0A", "PINIT:0B"]


def test_a_tool_that_cannot_be_initialised_is_told_and_left_out(serial):
    device = Device(measurements=moving(8, 16))
    handles = ndi.encode_phsr((ndi.PortHandle(0x0A, 0x01),))
    device.answers |= {"PHSR:02": handles, "PINIT:0A": 0x13}
    with serial(device, "?baud=9600") as source:
        items = items_of(source, 1)
    assert source.coils == ("port 1b",)
    assert device.asked.count("PINIT:0A") == 1
    assert any("handle 0A could not be initialised" in text for text in texts_of(items, NoteKind.INFO))


def test_a_device_without_tools_says_so(serial):
    with pytest.raises(InputError, match=r"no tool delivers positions \(.*\); plug in the coils"):
        serial(Device(handles=()))


def test_a_button_box_is_no_coil(serial):
    device = Device(measurements=moving(8, 16))
    device.tool_type = lambda handle: ndi.BUTTON_BOX if handle == 0x0B else 0x02
    with serial(device, "?baud=9600") as source:
        assert source.coils == ("port 1",)
        ((_, positions, _),) = frames_of(items_of(source, 1))
    assert positions.shape == (1, 3)
    assert "PENA:0BB" in device.asked


def test_coils_are_named_by_handle_where_the_place_is_not_known(serial):
    with serial(Device(measurements=moving(8, 16), PHINF=0x07), "?baud=9600") as source:
        assert source.coils == ("handle 0A", "handle 0B")


def test_tools_that_share_a_port_have_different_names(serial):
    device = Device(measurements=moving(8, 16))
    device.answers["PHINF:0B0025"] = device._phinf("0A0025")
    with serial(device, "?baud=9600") as source:
        assert source.coils == ("port 1 (handle 0A)", "port 1 (handle 0B)")


# --- frames -------------------------------------------------------------------------------------------------


def test_a_frame_holds_what_the_device_measured(serial):
    measured = (tool(0x0B, 8, (4.0, 5.0, 6.0)), tool(0x0A, 8, (0.1, -200.25, 3e-3)), tool(0x33, 900))
    with serial(Device(measurements=[measured]), "?baud=9600") as source:
        frame = next(item for item in source if isinstance(item, CoilFrame))
        expected = [np.float32([0.1, -200.25, 3e-3]), [4.0, 5.0, 6.0]]
        np.testing.assert_array_equal(frame.positions, np.array(expected, dtype=float))
        np.testing.assert_array_equal(frame.quaternions, [UNIT, UNIT])
        assert frame.rms.tolist() == [0.5, 0.5]
        assert frame.status.tolist() == [0x31, 0x31]
        assert frame.frame_number == 8
        assert 0 <= time.perf_counter_ns() - frame.arrival_ns < 20e9
        assert frame.device_time_s == pytest.approx(frame.arrival_ns * 1e-9)


@pytest.mark.parametrize("reply", ["bx", "tx"])
def test_coils_without_a_position_are_nan_and_keep_their_status(serial, reply):
    measured = (tool(0x0A, 8, state=State.MISSING), tool(0x0B, 8))
    with serial(Device(measurements=[measured]), f"?baud=9600&reply={reply}") as source:
        ((_, positions, status),) = frames_of(items_of(source, 1))
    assert np.isnan(positions[0]).all()
    assert positions[1].tolist() == [1.0, 2.0, 3.0]
    assert status.tolist() == [0x71, 0x31]


def test_a_coil_that_is_unplugged_is_told_once_and_nan(serial):
    gone = [(tool(0x0A, n), ToolState(0x0B, State.UNOCCUPIED)) for n in (16, 24)]
    device = Device(measurements=[*moving(8), *gone, *moving(32, 40)])
    with serial(device, "?baud=9600&reply=tx") as source:
        items = items_of(source, 5)
    frames = frames_of(items)
    assert [np.isnan(positions[1]).all() for _, positions, _ in frames] == [False, True, True, False, False]
    told = texts_of(items, NoteKind.INFO)
    assert told[-2:] == ["port 1b was unplugged or disabled", "port 1b is enabled again"]


def test_the_same_measurement_is_delivered_once(serial):
    device = Device(measurements=moving(8, 8, 16, 16, 16, 24))
    with serial(device, "?baud=9600") as source:
        assert [number for number, _, _ in frames_of(items_of(source, 3))] == [8, 16, 24]


def test_nothing_is_delivered_before_something_was_measured(serial):
    nothing = (tool(0x0A, 0, state=State.MISSING), tool(0x0B, 0, state=State.MISSING))
    with serial(Device(measurements=[nothing, nothing, *moving(8)]), "?baud=9600") as source:
        assert [number for number, _, _ in frames_of(items_of(source, 1))] == [8]


def test_a_coil_may_lag_by_one_step_but_not_by_more(serial):
    start = moving(8, 16, 24)
    late = [(tool(0x0A, n), tool(0x0B, 24)) for n in (32, 40, 48)]
    with serial(Device(measurements=[*start, *late]), "?baud=9600") as source:
        frames = frames_of(items_of(source, 6))
    assert [np.isnan(positions[1]).all() for _, positions, _ in frames] == [False] * 4 + [True] * 2


def test_handles_that_are_measured_in_turns_are_not_stale(serial):
    turns = [(tool(0x0A, n - n % 3), tool(0x0B, n - (n + 1) % 3)) for n in range(30, 60) if n % 3 != 1]
    with serial(Device(measurements=turns), "?baud=9600") as source:
        frames = frames_of(items_of(source, 12))
    assert not any(np.isnan(positions).any() for _, positions, _ in frames[4:])


def test_arrays_are_made_once(serial):
    with serial(Device(measurements=moving(8, 16, 24)), "?baud=9600") as source:
        frames = list(itertools.islice((item for item in source if isinstance(item, CoilFrame)), 3))
    assert len({id(frame.positions) for frame in frames}) == 1
    assert len({id(frame.quaternions) for frame in frames}) == 1


def test_a_count_that_falls_back_is_told(serial):
    device = Device(measurements=moving(*range(1000, 1200, 8), *range(80, 160, 8)))
    with serial(device, "?baud=9600") as source:
        items = items_of(source, 30)
    assert texts_of(items, NoteKind.CLOCK_RESET) == ["the device's clock jumped"]
    assert [number for number, _, _ in frames_of(items)][24:27] == [1192, 80, 88]


# --- trouble ------------------------------------------------------------------------------------------------


def test_a_device_that_does_not_know_bx_is_asked_by_tx(serial):
    with serial(Device(measurements=moving(8, 16), BX=0x01), "?baud=9600") as source:
        items = items_of(source, 2)
    assert [number for number, _, _ in frames_of(items)] == [8, 16]
    assert any("does not know BX" in text for text in texts_of(items, NoteKind.INFO))


def damaged_bx(number, place=30):
    data = bytearray(ndi_tracking.encode_bx(TrackingReply(moving(number)[0]), 0x0801))
    data[place] ^= 0x55
    return bytes(data)


@pytest.mark.parametrize("place", [0, 2, 30, -1])
def test_a_damaged_reply_is_told_and_the_next_one_taken(serial, place):
    device = Device(measurements=[*moving(8), damaged_bx(16, place), *moving(24)])
    with serial(device, "?baud=9600") as source:
        items = items_of(source, 2)
    assert [number for number, _, _ in frames_of(items)] == [8, 24]
    assert texts_of(items, NoteKind.BAD_DATA)


def test_a_reply_that_breaks_off_is_told_and_the_next_one_taken(serial):
    whole = ndi_tracking.encode_bx(TrackingReply(moving(16)[0]), 0x0801)
    with serial(Device(measurements=[*moving(8), whole[:50], *moving(24)]), "?baud=9600") as source:
        items = items_of(source, 2)
    assert [number for number, _, _ in frames_of(items)] == [8, 24]
    assert texts_of(items, NoteKind.BAD_DATA) == ["50 bytes that are no whole reply"]


def test_five_bad_replies_in_a_row_end_the_connection(serial):
    device = Device(measurements=[*moving(8), *[damaged_bx(16)] * 5, *moving(24, 32)])
    with serial(device, "?baud=9600") as source:
        items = items_of(source, 2)
    assert any("5 replies in a row are bad" in text for text in texts_of(items, NoteKind.DISCONNECTED))
    assert len(texts_of(items, NoteKind.BAD_DATA)) == 4
    assert len(texts_of(items, NoteKind.CONNECTED)) == 1
    assert [number for number, _, _ in frames_of(items)] == [8, 24]


@pytest.mark.parametrize(
    ("reply", "words"),
    [(ndi.error_reply(0x0C), "is not tracking any more"), (ndi.reply("RESET"), "was reset")],
)
def test_a_device_that_stopped_tracking_is_started_again(serial, reply, words):
    with serial(Device(measurements=[*moving(8), reply, *moving(16)]), "?baud=9600") as source:
        items = items_of(source, 2)
    assert any(words in text for text in texts_of(items, NoteKind.DISCONNECTED))
    assert [number for number, _, _ in frames_of(items)] == [8, 16]


def test_a_poll_that_is_not_answered_is_sent_again(serial):
    device = Device(measurements=[*moving(8), b"", *moving(16)])
    with serial(device, "?baud=9600") as source:
        items = items_of(source, 2)
    assert [number for number, _, _ in frames_of(items)] == [8, 16]


def test_an_answer_that_came_late_does_not_put_all_later_ones_off_by_one(serial):
    two = b"".join(ndi_tracking.encode_bx(TrackingReply(m), 0x0801) for m in moving(16, 24))
    device = Device(measurements=[*moving(8), b"", two, *moving(32, 40)])
    with serial(device, "?baud=9600") as source:
        numbers = [number for number, _, _ in frames_of(items_of(source, 5))]
        assert numbers == [8, 16, 24, 32, 40]
        assert serial.opened[0].in_waiting == 0


def test_a_device_whose_count_stands_still_does_not_hold_up_stop(serial):
    with serial(Device(measurements=moving(8)), "?baud=9600") as source:
        items_of(source, 1)
        source.stop()
        assert list(source) == []


def test_goodbye_ends_soon_where_the_device_is_mute(serial):
    device = Device(measurements=moving(8, 16))
    source = serial(device, "?baud=9600")
    items_of(source, 1)
    device.baud = 1
    before = time.perf_counter()
    source.close()
    assert time.perf_counter() - before < 2.0
    assert serial.opened[0].closed


def test_a_new_bit_of_the_system_status_is_told_once(serial):
    bad = [ndi_tracking.encode_bx(TrackingReply(m, system_status=0x0012), 0x0801) for m in moving(16, 24)]
    with serial(Device(measurements=[*moving(8), *bad, *moving(32, 40)]), "?baud=9600") as source:
        items = items_of(source, 5)
    told = [text for text in texts_of(items, NoteKind.INFO) if "system status" in text]
    assert told == ["the device's system status: too much interference, hardware failure"]


def test_a_port_that_is_pulled_out_is_told(serial, monkeypatch):
    device = Device(measurements=moving(8, 16))
    with serial(device, "?baud=9600") as source:
        items_of(source, 1)

        def fail(_):
            raise OSError("Input/output error")

        monkeypatch.setattr(serial.opened[0], "read", fail)
        items = items_of(source, 1)
    assert texts_of(items, NoteKind.DISCONNECTED) == ["/dev/scripted: Input/output error"]


# --- other ways in ------------------------------------------------------------------------------------------


def serve_tcp(device, connections=1):
    """The scripted device on an ephemeral port; gives the port."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(10)

    def serve():
        with listener:
            for _ in range(connections):
                connection, _ = listener.accept()
                with connection:
                    connection.settimeout(10)
                    while data := connection.recv(4096):
                        connection.sendall(device.hear(data))

    threading.Thread(target=serve, daemon=True).start()
    return listener.getsockname()[1]


def test_over_tcp_there_is_no_break_and_no_speed():
    device = Device(measurements=moving(8, 16))
    with open_device(parse_source(f"ndi+tcp://127.0.0.1:{serve_tcp(device)}")) as source:
        assert [number for number, _, _ in frames_of(items_of(source, 2))] == [8, 16]
    assert device.asked[0] == "INIT:"
    assert device.asked[-1] == "TSTOP:"
    assert device.resets == 0
    assert not any(name.startswith("COMM") for name in device.asked)


def test_over_tcp_a_port_without_a_device_is_told():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(InputError, match=f"127.0.0.1:{port}.*is the device on"):
        open_device(parse_source(f"ndi+tcp://127.0.0.1:{port}"))


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals")
def test_on_a_pseudo_terminal_that_knows_no_break():
    import tty

    master, slave = os.openpty()
    tty.setraw(slave)
    device = Device(measurements=moving(8, 16))

    def serve():
        try:
            while data := os.read(master, 4096):
                os.write(master, device.hear(data))
        except OSError:
            pass

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    with open_device(parse_source(f"ndi://{os.ttyname(slave)}?baud=9600")) as source:
        items = items_of(source, 2)
    assert [number for number, _, _ in frames_of(items)] == [8, 16]
    assert "the device did not answer a break but INIT at 9600 baud" in texts_of(items, NoteKind.INFO)
    os.close(slave)
    server.join(5)
    os.close(master)


def test_a_line_that_cannot_change_its_speed_is_a_lost_link():
    class Stubborn(Port):
        @property
        def baudrate(self):
            return 9600

        @baudrate.setter
        def baudrate(self, baud):
            raise ValueError("not this speed")

    port = Port(Device())
    line = ndi_source.SerialLine(SerialLink(port, "scripted"))
    port.__class__ = Stubborn
    with pytest.raises(LinkLost, match="scripted: not this speed"):
        line.set_baud(115200)


def test_whatever_comes_in_the_place_of_replies_no_wrong_frame_comes_out(serial, monkeypatch):
    for name, seconds in (("QUIET_S", 0.004), ("DAMAGED_QUIET_S", 0.002), ("POLL_TIMEOUT_S", 0.01)):
        monkeypatch.setattr(ndi_source, name, seconds)
    random = np.random.default_rng(3)
    measurements = []
    for number in range(8, 8 * 151, 8):
        good = ndi_tracking.encode_bx(TrackingReply(moving(number)[0]), 0x0801)
        kind = random.integers(6)
        if kind == 0:
            good = random.bytes(int(random.integers(200)))
        elif kind == 1:
            good = good[: random.integers(len(good))]
        elif kind == 2:
            place = int(random.integers(len(good)))
            good = good[:place] + random.bytes(int(random.integers(1, 9))) + good[place + 1 :]
        measurements.append(good)
    device = Device(measurements=[*measurements, *moving(8 * 151, 8 * 152)])
    with serial(device, "?baud=9600") as source:
        source._idle_s = 20.0
        monkeypatch.setattr(source, "_pause_s", 0.0)
        frames, ends_s = [], time.perf_counter() + 20
        for item in source:
            if isinstance(item, CoilFrame):
                frames.append(item.frame_number)
                assert item.frame_number % 8 == 0
                assert item.positions.tolist() == [[1.0, 2.0, 3.0]] * 2
                if item.frame_number == 8 * 152:
                    break
            assert time.perf_counter() < ends_s
    assert len(frames) > 60
