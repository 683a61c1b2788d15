"""The simulated NDI device by itself: what it accepts, what it refuses, and what it reports."""

from __future__ import annotations

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack.drivers.devices.ndi import NdiError, command, parse_reply
from tonguetrack.drivers.devices.ndi_reader import Reply as WholeReply
from tonguetrack.drivers.devices.ndi_reader import ReplyReader
from tonguetrack.drivers.devices.ndi_tracking import State, TrackingReply, parse_bx, parse_tx
from tonguetrack.drivers.frames import Recording
from tonguetrack.drivers.simulators.faults import parse_faults
from tonguetrack.drivers.simulators.motion import SimulatedMotion
from tonguetrack.drivers.simulators.ndi_device import MAX_COMMAND, NdiDevice, without_roll

COILS = ("tip", "blade", "dorsum")
FRAMES = 80
SEVEN_FRAMES_S = 7.5 / 40


def recording(positions: np.ndarray | None = None, quaternions: np.ndarray | None = None) -> Recording:
    if positions is None:
        positions = np.arange(FRAMES * 3 * 3, dtype=float).reshape(FRAMES, 3, 3) / 8 - 30
    times = np.arange(len(positions)) / 40.0
    return Recording(COILS, positions, times, 40.0, "test", quaternions=quaternions)


class Client:
    """Talks to a device whose clock stands still unless it is put on."""

    def __init__(self, faults: str = "", model: str = "aurora", **options) -> None:
        self.time_s = 100.0
        source = options.pop("recording", None) or recording()
        motion = SimulatedMotion(source, options.pop("rate_hz", None))
        plan = parse_faults(faults, COILS)
        self.device = NdiDevice(motion, plan, model, now=lambda: self.time_s, **options)

    def raw(self, data: bytes) -> bytes:
        return b"".join(answer.data for answer in self.device.feed(data))

    def ask(self, name: str, arguments: str = "") -> str:
        """The text of the reply; raises NdiError."""
        return parse_reply(self.raw(command(name, arguments)))

    def refused(self, name: str, arguments: str = "") -> int:
        with pytest.raises(NdiError) as refusal:
            self.ask(name, arguments)
        return refusal.value.code

    def enable(self) -> None:
        self.ask("INIT")
        for handle in [text[:2] for text in self.unready()]:
            self.ask("PINIT", handle)
        for handle in ("0A", "0B", "0C"):
            self.ask("PENA", handle + "D")

    def unready(self) -> list[str]:
        text = self.ask("PHSR", "02")
        return [text[place : place + 5] for place in range(2, len(text), 5)]

    def track(self, wait_s: float = SEVEN_FRAMES_S) -> None:
        self.enable()
        self.ask("TSTART")
        self.time_s += wait_s

    def bx(self, options: int = 0x0801) -> TrackingReply:
        return parse_bx(self.raw(command("BX", f"{options:04X}")), options)

    def tx(self, options: int = 0x0801) -> TrackingReply:
        return parse_tx(self.ask("TX", f"{options:04X}"), options)


# --- the line -------------------------------------------------------------------------------------------------


def test_the_published_bytes_of_a_beginning_are_understood_and_answered() -> None:
    device = Client().device
    assert [answer.data for answer in device.feed(b"INIT:E3A5\r")] == [b"OKAYA896\r"]
    assert [answer.data for answer in device.feed(b"PHSR:01E03E\r")] == [b"001414\r"]
    assert [answer.data for answer in device.feed(b"COMM:500000048\r")] == [b"OKAYA896\r"]


def test_a_break_starts_the_device_anew_at_9600_baud_and_is_told_after_a_while() -> None:
    client = Client(reset_s=1.25)
    client.track()
    client.ask("TSTOP")
    client.ask("COMM", "50000")
    answer = client.device.reset()
    assert (answer.data, answer.baud, answer.wait_s) == (b"RESETBE6F\r", 9600, 1.25)
    assert client.device.baud == 9600
    assert client.refused("PHSR", "00") == 0x10


def test_comm_is_answered_at_the_old_speed_and_the_device_listens_at_the_new_one() -> None:
    client = Client()
    for code, baud in (("5", 115200), ("A", 230400), ("a", 230400), ("6", 921600), ("0", 9600)):
        before = client.device.baud
        (answer,) = client.device.feed(command("COMM", code + "0000"))
        assert (answer.data, answer.baud, client.device.baud) == (b"OKAYA896\r", before, baud)


def test_a_command_may_have_a_space_and_no_crc_or_hexadecimal_digits_in_lower_case() -> None:
    client = Client()
    assert client.raw(b"INIT \r") == b"OKAYA896\r"
    assert client.raw(b"PINIT 0a\r") == b"OKAYA896\r"
    assert client.ask("PENA", "0ad") == "OKAY"
    assert client.raw(b"TSTART 80\r") == b"OKAYA896\r"


@given(st.lists(st.integers(0, 60), max_size=6))
@settings(max_examples=50, deadline=None)
def test_commands_may_come_in_any_pieces(cuts: list[int]) -> None:
    talk = command("INIT") + command("PINIT", "0A") + command("PHSR", "03") + command("NONSENSE")
    whole = Client().raw(talk)
    client, pieces = Client(), b""
    places = [0, *sorted(cuts), len(talk)]
    for start, end in pairwise(places):
        pieces += client.raw(talk[start:end])
    assert pieces == whole
    assert whole.startswith(b"OKAYA896\rOKAYA896\r020A01F0B01F3465\rERROR01")


def test_a_command_without_end_is_dropped_and_refused_and_the_next_one_is_answered() -> None:
    client = Client()
    for _ in range(1000):
        assert client.raw(b"X" * 1000) == b""
    assert len(client.device._line) == MAX_COMMAND
    answers = client.device.feed(b"\rINIT:E3A5\r")
    with pytest.raises(NdiError, match="ERROR02"):
        parse_reply(answers[0].data)
    assert answers[1].data == b"OKAYA896\r"


@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from([
    b"INIT \r", b"TSTART \r", b"TSTOP \r", b"PINIT 0A\r", b"PENA 0AD\r", b"TX \r", b"BX 1801\r", b"PHRQ **************\r",
    b"PHF 0A\r", b"PHINF 0A007F\r", b"GET *\r", b"COMM 50000\r", b"RESET \r", b"GX \r", b"PVWR 0A\r", b"LED 0A1B\r",
]))), st.booleans())  # fmt: skip
@settings(max_examples=300, deadline=None)
def test_whatever_comes_the_device_gives_whole_replies_only(pieces: list[bytes], tracking: bool) -> None:
    client = Client(model="polaris")
    if tracking:
        client.track()
    reader = ReplyReader()
    for piece in pieces:
        for answer in client.device.feed(piece):
            reader.feed(answer.data)
            assert isinstance(reader.next(), WholeReply)
            assert reader.next() is None


# --- what it refuses ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"FOO:\r", 0x04),
        (b"FOO \r", 0x01),
        (b"\r", 0x01),
        (b"init \r", 0x01),
        (b"\xff\x80\r", 0x01),
        (b"INIT:E3A6\r", 0x04),
        (b"INIT:\r", 0x04),
        (b"INIT 1\r", 0x07),
    ],
)
def test_a_line_that_is_no_command_is_refused(data: bytes, code: int) -> None:
    with pytest.raises(NdiError) as refusal:
        parse_reply(Client().raw(data))
    assert refusal.value.code == code


@pytest.mark.parametrize(
    ("name", "arguments", "code"),
    [
        ("NONSENSE", "", 0x01),
        ("COMM", "90000", 0x07),
        ("COMM", "5000", 0x07),
        ("COMM", "50300", 0x07),
        ("PHSR", "05", 0x07),
        ("BEEP", "0", 0x07),
        ("VER", "9", 0x07),
        ("PHINF", "0A0100", 0x07),
        ("PHINF", "0A1", 0x07),
        ("PHINF", "XX0001", 0x07),
        ("PHINF", "010001", 0x08),
        ("PHINF", "0D0001", 0x2B),
        ("PINIT", "00", 0x08),
        ("PINIT", "0D", 0x2B),
        ("PENA", "0AX", 0x07),
        ("PENA", "0CD", 0x0E),
        ("PDIS", "0C", 0x0E),
        ("PDIS", "0A", 0x0F),
        ("PHF", "FF", 0x08),
        ("PHRQ", "", 0x07),
        ("PVWR", "0A0000", 0x07),
        ("PVWR", "0A0020" + 128 * "0", 0x23),
        ("PVWR", "0A0400" + 128 * "0", 0x23),
        ("LED", "0A4B", 0x0A),
        ("LED", "0A1X", 0x0B),
        ("LED", "0C1B", 0x0E),
        ("LED", "0A1B", 0x0F),
        ("TSTART", "1", 0x07),
        ("TX", "0001", 0x0C),
        ("BX", "0001", 0x0C),
        ("GX", "", 0x0C),
        ("TSTOP", "", 0x0C),
        ("GET", "No.Such.Name", 0x07),
    ],
)
def test_a_command_is_refused_with_the_error_of_its_kind(name: str, arguments: str, code: int) -> None:
    """The device is initialised, handles 0A and 0B are as well, 0C is not, and nothing is enabled."""
    client = Client()
    client.ask("INIT")
    client.ask("PINIT", "0A")
    assert client.refused(name, arguments) == code


@pytest.mark.parametrize("name", ["PHSR", "PINIT", "PENA", "TSTART", "PHINF", "PHRQ"])
def test_before_init_nothing_can_be_set_up(name: str) -> None:
    assert Client().refused(name, "0A") == 0x10


def test_before_init_the_device_says_who_it_is_and_takes_another_speed() -> None:
    client = Client()
    assert "Freeze Tag: AURORA Rev 013\n" in client.ask("VER", "4")
    assert client.ask("GETINFO", "Features.Firmware.Version").startswith("Features.Firmware.Version=")
    assert client.ask("APIREV").startswith("D.")
    assert client.ask("ECHO", "Testing!") == "Testing!"
    assert client.ask("BEEP", "2") == "1"
    assert client.ask("COMM", "50000") == "OKAY"
    assert client.refused("TX") == 0x0C


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("COMM", "50000"), ("PINIT", "0A"), ("PENA", "0AD"), ("PDIS", "0A"), ("PHF", "0A"), ("TSTART", "")],
)
def test_while_it_tracks_nothing_can_be_set_up(name: str, arguments: str) -> None:
    client = Client()
    client.track()
    assert client.refused(name, arguments) == 0x0C
    assert client.ask("PHSR", "04") == "030A03F0B03F0C03F"
    client.ask("TSTOP")
    assert client.ask(name, arguments) == "OKAY"


@pytest.mark.parametrize("options", ["1", "00001", "0000", "0010", "WXYZ"])
def test_reply_options_that_do_not_exist_are_refused(options: str) -> None:
    client = Client()
    client.track()
    assert client.refused("TX", options) == 0x07
    assert client.refused("BX", options) == 0x07


# --- ports ----------------------------------------------------------------------------------------------------


def test_the_second_sensor_of_a_dual_tool_appears_when_the_first_is_initialised() -> None:
    client = Client()
    client.ask("INIT")
    assert client.ask("PHSR", "00") == client.ask("PHSR", "02") == "020A0010C001"
    client.ask("PINIT", "0A")
    assert client.ask("PHSR", "02") == "010C001"
    assert client.ask("PHSR", "03") == "020A01F0B01F"
    client.ask("PINIT", "0C")
    assert client.ask("PHSR", "03") == "030A01F0B01F0C01F"
    client.ask("PENA", "0BD")
    assert client.ask("PHSR", "04") == "010B03F"
    client.ask("PDIS", "0B")
    assert client.ask("PHSR", "04") == "00"
    client.ask("PHF", "0B")
    assert client.ask("PHSR", "00") == "020A01F0C01F"
    client.ask("INIT")
    assert client.ask("PHSR", "00") == "020A0010C001"


@pytest.mark.parametrize(
    ("option", "width"),
    [(0x01, 33), (0x02, 8), (0x04, 20), (0x08, 2), (0x10, 2), (0x20, 14), (0x40, 2), (0x25, 67), (0x7F, 81)],
)
def test_each_field_of_phinf_has_its_published_width(option: int, width: int) -> None:
    client = Client()
    client.ask("INIT")
    client.ask("PINIT", "0A")
    assert len(client.ask("PHINF", f"0A{option:04X}")) == width
    assert len(client.ask("PHINF", f"0C{option:04X}")) == width


def test_both_sensors_of_a_dual_tool_have_one_serial_number_and_two_channels() -> None:
    client = Client()
    client.ask("INIT")
    assert client.ask("PHINF", "0A0021") == "00000000            0000000000001A4-SIM01100100"
    client.ask("PINIT", "0A")
    first, second = client.ask("PHINF", "0A0021"), client.ask("PHINF", "0B0021")
    assert first[23:31] == second[23:31] != "00000000"
    assert (first[31:33], first[33:]) == ("1F", "A4-SIM01100100")
    assert (second[31:33], second[33:]) == ("1F", "A4-SIM01100101")


def test_a_polaris_has_one_handle_a_tool_and_a_serial_number_each() -> None:
    client = Client(model="polaris")
    client.ask("INIT")
    assert client.ask("PHSR", "02") == "030A0010B0010C001"
    for handle in ("0A", "0B", "0C"):
        client.ask("PINIT", handle)
    assert len({client.ask("PHINF", f"{handle}0001")[23:31] for handle in ("0A", "0B", "0C")}) == 3


def test_a_tool_loaded_by_hand_needs_its_whole_memory_and_is_never_seen() -> None:
    client = Client(model="polaris")
    client.enable()
    handle = client.ask("PHRQ", "*********1****")
    assert handle == "0D"
    assert client.refused("PINIT", handle) == 0x2C
    for address in range(0, 0x400, 0x40):
        assert client.ask("PVWR", f"{handle}{address:04X}" + "0F" * 64) == "OKAY"
        if address < 0x3C0:
            assert client.refused("PINIT", handle) == 0x13
    client.ask("PINIT", handle)
    client.ask("PENA", handle + "D")
    client.ask("TSTART")
    client.time_s += 1
    *seen, unseen = client.bx().tools
    assert all(tool.state is State.VALID for tool in seen)
    assert (unseen.handle, unseen.state) == (0x0D, State.MISSING)


# --- measurements ---------------------------------------------------------------------------------------------


def test_a_tx_reply_has_the_published_form() -> None:
    positions = np.tile([[-49.31, 57.13, -159.05], [np.nan] * 3, [0.0, 1000.0, 0.004]], (4, 1, 1))
    quaternions = np.tile([0.8157, -0.0068, 0.5784, 0.0], (4, 3, 1))
    client = Client(recording=recording(positions, quaternions))
    client.track(wait_s=3.5 / 40)
    client.ask("TSTOP")
    client.ask("PDIS", "0B")
    client.ask("TSTART")
    client.time_s += 1 / 30
    assert client.ask("TX", "0801") == (
        "030A+08157-00068+05784+00000-004931+005713-015905+000000000003F00000020\n"
        "0BDISABLED\n"
        "0C+08157-00068+05784+00000+000000+100000+000000+000000000007F00000020\n0000"
    )
    assert client.ask("TX", "0001").split("\n")[2] == "0CMISSING0000007F00000020"
    assert client.ask("TX") == client.ask("TX", "0001")


def test_a_bx_reply_has_the_published_form() -> None:
    positions = np.tile([[1.5, -2.25, 3.0], [np.nan] * 3, [4.0, 5.0, 6.0]], (4, 1, 1))
    client = Client(recording=recording(positions))
    client.track(wait_s=1.5 / 40)
    client.ask("TSTOP")
    client.ask("PDIS", "0C")
    client.ask("TSTART")
    client.time_s += 1 / 30
    data = client.raw(command("BX", "0801"))
    half = np.float32(np.sqrt(0.5))
    body = (
        bytes([3, 0x0A, 1])
        + struct.pack("<8f2I", half, half, 0, 0, 1.5, -2.25, 3.0, 0.0, 0x3F, 16)
        + bytes([0x0B, 2])
        + struct.pack("<2I", 0x7F, 16)
        + bytes([0x0C, 4])
        + bytes(2)
    )
    assert data[:2] == b"\xc4\xa5"
    assert data[2:4] == struct.pack("<H", len(body))
    assert data[6:-2] == body


@pytest.mark.parametrize("options", [0x0001, 0x0801, 0x0803, 0x0805, 0x1809, 0x180F])
@pytest.mark.parametrize("model", ["aurora", "polaris"])
def test_tx_and_bx_agree_with_each_other_and_with_the_motion(options: int, model: str) -> None:
    positions = np.random.default_rng(4).normal(scale=60.0, size=(FRAMES, 3, 3)).round(2)
    positions[:, 1] = np.nan
    step = {"aurora": 8, "polaris": 1}[model]
    client = Client(model=model, recording=recording(positions))
    client.track(wait_s=0.5 / 40)
    for number in range(1, 30):
        client.time_s += 1 / 40
        text, binary = client.tx(options), client.bx(options)
        assert [tool.state for tool in text.tools] == [tool.state for tool in binary.tools]
        for index, (one, other) in enumerate(zip(text.tools, binary.tools, strict=True)):
            assert (one.handle, one.port_status, one.frame_number) == (
                other.handle,
                other.port_status,
                other.frame_number,
            )
            if one.state is State.VALID:
                assert one.frame_number == number * step
                np.testing.assert_allclose(one.position, positions[number - 1, index], atol=1e-6)
                np.testing.assert_allclose(other.position, positions[number - 1, index], atol=1e-4)
                np.testing.assert_allclose(one.quaternion, other.quaternion, atol=6e-5)


def test_before_the_first_measurement_a_tool_is_missing_with_frame_zero() -> None:
    client = Client()
    client.track(wait_s=0.0)
    assert [(tool.state, tool.port_status, tool.frame_number) for tool in client.bx().tools] == 3 * [
        (State.MISSING, 0x3F, 0)
    ]


@pytest.mark.parametrize(("model", "step", "rate_hz"), [("aurora", 8, 40.0), ("polaris", 1, 60.0)])
def test_the_frame_counter_has_the_step_of_the_model_and_the_rate_of_the_motion(
    model: str, step: int, rate_hz: float
) -> None:
    client = Client(model=model, rate_hz=rate_hz)
    client.track(wait_s=0.75 / rate_hz)
    numbers = []
    for _ in range(20):
        client.time_s += 0.5 / rate_hz
        numbers.append(client.bx().tools[0].frame_number)
    assert numbers == [step * (count // 2) for count in range(2, 22)]


def test_the_count_goes_on_after_tstop_and_begins_anew_with_option_80_and_init() -> None:
    client = Client()
    client.track()
    assert client.bx().tools[0].frame_number == 7 * 8
    client.ask("TSTOP")
    client.time_s += 10
    client.ask("TSTART")
    client.time_s += 1.5 / 40
    assert client.bx().tools[0].frame_number == 8 * 8
    client.ask("TSTOP")
    client.ask("TSTART", "80")
    client.time_s += 1.5 / 40
    assert client.bx().tools[0].frame_number == 8
    client.track()
    assert client.bx().tools[0].frame_number == 7 * 8


def test_a_tool_out_of_volume_is_missing_unless_it_is_asked_for() -> None:
    positions = np.tile([[10.0, 0, 0], [0, 99.0, 0], [0, 0, -101.0]], (4, 1, 1))
    client = Client(recording=recording(positions), volume_mm=100.0)
    client.track()
    assert [tool.state for tool in client.bx(0x0001).tools] == [State.VALID, State.VALID, State.MISSING]
    asked = client.bx(0x0801).tools
    assert [tool.state for tool in asked] == 3 * [State.VALID]
    assert [tool.port_status for tool in asked] == [0x3F, 0x3F, 0x7F]


def test_a_missing_tool_of_a_polaris_has_an_older_frame_number_than_the_others() -> None:
    client = Client(faults="dead=blade", model="polaris")
    client.track()
    assert [tool.frame_number for tool in client.bx().tools] == [7, 5, 7]


def test_gx_reports_three_ports_and_their_status_without_frame_numbers() -> None:
    positions = np.tile([[1.0, 2.0, 3.0], [np.nan] * 3, [0.0, 0.0, 0.0]], (4, 1, 1))
    client = Client(recording=recording(positions))
    client.track()
    client.ask("TSTOP")
    client.ask("PDIS", "0C")
    client.ask("TSTART")
    client.time_s += 0.1
    transform = "+07071+07071+00000+00000+000100+000200+000300+00000"
    assert client.ask("GX") == f"{transform}\nMISSING\nDISABLED\n001F7F3F"


angle = st.floats(-1, 1)


@given(angle, angle, angle, angle)
@settings(max_examples=200, deadline=None)
def test_five_degrees_of_freedom_keep_the_direction_of_the_coils_axis(
    w: float, x: float, y: float, z: float
) -> None:
    size = np.sqrt(w * w + x * x + y * y + z * z)
    if size < 1e-3:
        return
    w, x, y, z = w / size, x / size, y / size, z / size
    a, b, c, d = without_roll(w, x, y, z)
    assert d == 0.0
    np.testing.assert_allclose(a * a + b * b + c * c, 1.0)

    def axis(w: float, x: float, y: float, z: float) -> list[float]:
        return [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z]

    np.testing.assert_allclose(axis(a, b, c, d), axis(w, x, y, z), atol=1e-9)


# --- faults ---------------------------------------------------------------------------------------------------


def test_a_dead_coil_is_missing_and_a_noisy_one_wanders() -> None:
    client = Client("dead=tip@1-2,noisy=dorsum:5")
    client.track()
    states, errors = [], []
    for _ in range(120):
        client.time_s += 1 / 40
        tools = client.bx().tools
        states.append(tools[0].state)
        index = (tools[2].frame_number // 8 - 1) % FRAMES
        errors.append(np.subtract(tools[2].position, recording().positions[index, 2]))
    assert states.count(State.MISSING) == 40
    assert states[0] is states[-1] is State.VALID
    assert 4.0 < np.std(errors) < 6.0


def test_dropped_measurements_are_never_reported() -> None:
    client = Client("drop=0.3,seed=3")
    client.track()
    numbers = set()
    for _ in range(400):
        client.time_s += 0.5 / 40
        numbers.add(client.bx().tools[0].frame_number // 8)
    missing = set(range(min(numbers), max(numbers))) - numbers
    assert 40 <= len(missing) <= 80


def test_reordered_measurements_go_back_once() -> None:
    client = Client("reorder=0.2")
    client.track()
    steps, last = [], 0
    for _ in range(400):
        client.time_s += 0.25 / 40
        number = client.bx().tools[0].frame_number // 8
        steps.append(number - last)
        last = number
    assert steps.count(-1) > 5
    assert min(steps) == -1


def test_a_jump_shifts_the_frame_counter_by_the_time() -> None:
    client = Client("jump=10@1")
    client.track()
    before = client.bx().tools[0].frame_number
    client.time_s += 1
    assert client.bx().tools[0].frame_number == before + 8 * 40 * 11


def test_a_stalled_device_answers_nothing_and_goes_on_afterwards() -> None:
    client = Client("stall=2@1")
    client.track(wait_s=0.9)
    assert client.bx().tools[0].frame_number == 36 * 8
    client.time_s += 0.2
    assert client.raw(command("BX", "0801")) == b""
    assert client.raw(command("TSTOP")) == b""
    client.time_s += 2
    assert client.bx().tools[0].frame_number == 124 * 8


def test_replies_are_damaged_only_while_the_fault_lasts() -> None:
    client = Client("corrupt=1@1-2")
    client.track(wait_s=0.5)
    good = client.raw(command("TX", "0801"))
    client.time_s += 1.0
    bad = client.raw(command("TX", "0801"))
    assert len(good) == len(bad)
    with pytest.raises(ValueError):
        parse_reply(bad)
    client.time_s += 1.0
    parse_reply(client.raw(command("TX", "0801")))


def test_the_connection_is_cut_once_and_a_failed_device_hears_only_init() -> None:
    client = Client("disconnect@1")
    client.track(wait_s=0.9)
    assert not client.device.cut()
    client.time_s += 0.2
    assert client.device.cut()
    assert not client.device.cut()
    client.device.fail()
    assert client.raw(command("TX", "0801") + b"NONSENSE\r" + command("VER", "0")) == b""
    assert client.ask("INIT") == "OKAY"
    assert client.ask("PHSR", "02") == "020A0010C001"


def test_on_request_answers_take_as_long_as_a_real_auroras() -> None:
    device = Client(realistic=True).device
    waits = {
        line: device.feed(line)[0].wait_s
        for line in (b"INIT \r", b"PINIT 0A\r", b"PENA 0AD\r", b"TSTART \r", b"TX \r", b"TSTOP \r")
    }
    assert waits == {
        b"INIT \r": 0.032,
        b"PINIT 0A\r": 2.5,
        b"PENA 0AD\r": 0.021,
        b"TSTART \r": 1.6,
        b"TX \r": 0.016,
        b"TSTOP \r": 0.332,
    }
    assert device.reset().wait_s == 1.3
