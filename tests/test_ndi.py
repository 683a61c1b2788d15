"""NDI's combined API: commands, replies and tracking data as the devices write them."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack.drivers.devices import ndi, ndi_reader, ndi_tracking
from tonguetrack.drivers.devices.ndi_tracking import Markers, State, ToolState, TrackingReply

TWO_MISSING = bytes.fromhex("c4a5170022e302010231000000000000000202310000000000000000" + "00b137")
ONE_VALID = bytes.fromhex(
    "c4a537003b230201023100000028010000" + "02017f280f3f80121d3f201dc63ea280cd3e"
    "1c78b1c2d8d42443c87f09c5c55f0a3d310000002a010000000007a1"
)

# --- CRC and commands ---------------------------------------------------------------------------------------

KNOWN_CRCS = {
    "INIT:": "E3A5",
    "OKAY": "A896",
    "RESET": "BE6F",
    "VER:0": "65EE",
    "PHSR:00": "20FF",
    "PHSR:01": "E03E",
    "PHSR:02": "E17E",
    "PHSR:03": "21BF",
    "PHSR:04": "E3FE",
    "TSTART:": "5423",
    "TSTOP:": "2C14",
    "TX:0001": "031A",
    "TX:0801": "C19B",
    "BX:0001": "C26D",
    "BX:0801": "00EC",
    "COMM:50000": "0048",
    "COMM:00000": "0084",
    "PINIT:0A": "D5EB",
    "PENA:0AD": "AD1E",
    "GETINFO:Features.Firmware.Version": "0492",
    "GX:": "C60B",
    "Info.Timeout.PINIT=5\n": "96A7",
    "Testing!": "A81C",
    "010A001": "C1B5",
    "00": "1414",
    "040A0010B0010C0010D001": "ECFB",
}


@pytest.mark.parametrize(("text", "crc"), KNOWN_CRCS.items())
def test_the_crc_is_that_of_the_devices(text, crc):
    assert f"{ndi.crc16(text.encode()):04X}" == crc


@given(st.binary(max_size=200), st.binary(max_size=200))
@settings(max_examples=100)
def test_the_crc_of_two_pieces_goes_on_where_the_first_ended(first, second):
    assert ndi.crc16(second, ndi.crc16(first)) == ndi.crc16(first + second)


def test_a_command_has_a_colon_its_crc_and_a_carriage_return():
    assert ndi.command("INIT") == b"INIT:E3A5\r"
    assert ndi.command("PENA", "0AD") == b"PENA:0ADAD1E\r"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (b"PINIT:0AD5EB\r", ndi.Command("PINIT", "0A")),
        (b"PINIT:0AD5EB", ndi.Command("PINIT", "0A")),
        (b"PINIT:0Ad5eb\r", ndi.Command("PINIT", "0A")),
        (b"PINIT:0A0000\r", ndi.Command("PINIT", "0A", crc_ok=False)),
        (b"PINIT:0A\r", ndi.Command("PINIT", "0A", crc_ok=False)),
        (b"INIT \r", ndi.Command("INIT", "")),
        (b"TSTART 80\r", ndi.Command("TSTART", "80")),
        (b"pinit:0a\r", None),
        (b"INIT\r", None),
        (b":E3A5\r", None),
        (b"\xc4\xa5\r", None),
        (b"\r", None),
    ],
)
def test_commands_come_with_a_crc_after_a_colon_or_without_one_after_a_space(line, expected):
    if expected is None:
        with pytest.raises(ndi.NdiDamaged):
            ndi.parse_command(line)
    else:
        assert ndi.parse_command(line) == expected


def test_hexadecimal_arguments_may_be_lower_case():
    assert ndi.parse_command(ndi.command("PINIT", "0a")) == ndi.Command("PINIT", "0a")


@given(
    st.from_regex(r"[A-Z][A-Z0-9]{1,11}", fullmatch=True), st.text("0123456789ABCDEFabcdef.* =:", max_size=80)
)
@settings(max_examples=200)
def test_every_command_comes_back_as_it_was(name, arguments):
    assert ndi.parse_command(ndi.command(name, arguments)) == ndi.Command(name, arguments)


@pytest.mark.parametrize(
    ("baud", "arguments"), [(9600, "00000"), (115200, "50000"), (921600, "60000"), (230400, "A0000")]
)
def test_comm_asks_for_eight_data_bits_without_handshake(baud, arguments):
    assert ndi.comm_arguments(baud) == arguments


# --- ASCII replies ------------------------------------------------------------------------------------------


def test_a_reply_has_its_crc_and_a_carriage_return():
    assert ndi.reply("OKAY") == b"OKAYA896\r"
    assert ndi.parse_reply(b"RESETBE6F\r") == "RESET"


@pytest.mark.parametrize(
    "data", [b"", b"\r", b"OKAY\r", b"OKAYA896", b"OKAYA897\r", b"OKAZA896\r", b"\xffOKAYA896\r"]
)
def test_a_damaged_reply_is_refused(data):
    with pytest.raises(ndi.NdiDamaged):
        ndi.parse_reply(data)


def test_an_error_says_what_its_number_means():
    with pytest.raises(ndi.NdiError, match="ERROR0C: the command does not fit the mode") as caught:
        ndi.parse_reply(ndi.error_reply(0x0C))
    assert caught.value.code == 0x0C
    with pytest.raises(ndi.NdiError, match="ERRORF7: no meaning is known"):
        ndi.parse_reply(ndi.error_reply(0xF7))


def test_a_status_can_be_read():
    assert ndi_tracking.status_words(0x00000171, ndi_tracking.PORT_STATUS) == (
        "occupied, initialised, enabled, out of volume, sensor broken"
    )
    assert ndi_tracking.status_words(0, ndi_tracking.SYSTEM_STATUS) == ""


def test_a_list_of_handles_comes_with_their_status():
    handles = ndi.parse_phsr("030A01F0B01F0C001")
    assert handles == (ndi.PortHandle(10, 0x1F), ndi.PortHandle(11, 0x1F), ndi.PortHandle(12, 1))
    assert ndi.encode_phsr(handles) == "030A01F0B01F0C001"
    assert ndi.parse_phsr("00") == ()


def test_phinf_tells_tool_part_number_and_place():
    text = "02000000Traxtal Tech0003411680B3FOMPR001-1005        A3-00117100200"
    information = ndi.parse_phinf(text, 0x0025)
    assert information.tool == ndi.ToolInformation(0x02, "Traxtal Tech", "000", "3411680B", 0x3F)
    assert information.part_number == "OMPR001-1005"
    assert information.location == ndi.PortLocation("A3-00117", "1", "0", "02", "00")
    assert ndi.encode_phinf(information, 0x0025) == text


def test_phinf_leaves_out_fields_that_are_not_used():
    text = "02000000UNKNOWN     00032BBC007111000000             01P4-00148010A00"
    assert ndi.parse_phinf(text, 0x002D).location == ndi.PortLocation("P4-00148", "0", "1", "0A", "00")


def test_ver_gives_its_lines_by_name():
    text = "Polaris Control Firmware\nNDI S/N: P4-00148\nFreeze Tag: POLARIS Rev 020\n(C) Northern Digital Inc.\n"
    values = ndi.parse_ver(text)
    assert values[""] == "Polaris Control Firmware"
    assert values["Freeze Tag"] == "POLARIS Rev 020"


def test_get_gives_its_lines_by_name():
    assert ndi.parse_get("Info.Timeout.PINIT=5\n") == {"Info.Timeout.PINIT": "5"}
    with pytest.raises(ndi.NdiDamaged):
        ndi.parse_get("no equals sign\n")


# --- TX -----------------------------------------------------------------------------------------------------


def test_tx_gives_transform_status_and_frame():
    text = "010A+08157-00068+05783+00000-004931+005713-015905+000000000003F00000018\n0030"
    reply = ndi_tracking.parse_tx(text, ndi_tracking.TRANSFORMS)
    (tool,) = reply.tools
    assert (tool.handle, tool.state, tool.port_status, tool.frame_number) == (0x0A, State.VALID, 0x3F, 0x18)
    assert tool.quaternion == pytest.approx((0.8157, -0.0068, 0.5783, 0.0))
    assert tool.position == pytest.approx((-49.31, 57.13, -159.05))
    assert tool.error == 0.0
    assert reply.system_status == 0x30
    assert ndi_tracking.encode_tx(reply, ndi_tracking.TRANSFORMS) == text


def test_tx_names_the_handles_without_a_position():
    text = "030AMISSING0000007F000001DB\n0BDISABLED\n0CUNOCCUPIED\n0000"
    reply = ndi_tracking.parse_tx(text, ndi_tracking.TRANSFORMS)
    assert [tool.state for tool in reply.tools] == [State.MISSING, State.DISABLED, State.UNOCCUPIED]
    assert [tool.frame_number for tool in reply.tools] == [0x1DB, 0, 0]
    assert all(math.isnan(value) for tool in reply.tools for value in (*tool.position, *tool.quaternion))
    assert ndi_tracking.encode_tx(reply, ndi_tracking.TRANSFORMS) == text


def test_a_disabled_handle_may_have_a_status_and_a_frame():
    (tool,) = ndi_tracking.parse_tx("010ADISABLED0000001100000020\n0000", ndi_tracking.TRANSFORMS).tools
    assert (tool.state, tool.port_status, tool.frame_number) == (State.DISABLED, 0x11, 0x20)


def test_tx_gives_tool_and_marker_information():
    text = (
        "0201MISSING000000310000040D0200000000000000000000\n"
        "02+05036+04469+04825+05601-005056+010437-202772+00180000000310000040C0000000000030000300003\n0000"
    )
    options = ndi_tracking.TRANSFORMS | ndi_tracking.TOOL_INFORMATION
    reply = ndi_tracking.parse_tx(text, options)
    assert [tool.tool_information for tool in reply.tools] == [2, 0]
    assert reply.tools[1].marker_information.hex() == "00000000030000300003"
    assert ndi_tracking.encode_tx(reply, options) == text


def test_tx_gives_a_tools_stray_marker():
    text = (
        "0301MISSING000000310000028A00\n"
        "02+01695-04062+07168+05406-004642+030104-165882+00741000000310000028801-004642+030104-165882\n"
        "03DISABLED\n00C0"
    )
    options = ndi_tracking.TRANSFORMS | ndi_tracking.SINGLE_STRAY
    reply = ndi_tracking.parse_tx(text, options)
    assert reply.tools[0].stray is None
    assert reply.tools[1].stray == pytest.approx((-46.42, 301.04, -1658.82))
    assert ndi_tracking.encode_tx(reply, options) == text


def test_tx_gives_stray_markers_after_the_bare_handles():
    text = "0201\n02\n030+015360+030698-223261+015173+022199-225596+007159+026725-2274150000"
    reply = ndi_tracking.parse_tx(text, ndi_tracking.PASSIVE_STRAYS)
    assert len(reply.strays.points) == 3
    assert reply.strays.points[2] == pytest.approx((71.59, 267.25, -2274.15))
    assert ndi_tracking.encode_tx(reply, ndi_tracking.PASSIVE_STRAYS) == text


def test_what_a_field_cannot_hold_is_held_at_its_limit():
    tool = ToolState(1, State.VALID, (1.0, 0.0, 0.0, 0.0), (12345.678, -99999.0, 0.0), 12.5)
    text = ndi_tracking.encode_tx(TrackingReply((tool,)), ndi_tracking.TRANSFORMS)
    assert "+999999-999999+000000+99999" in text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "01",
        "010A",
        "010AMISSING\n0000",
        "010AMISSING0000007F000001DB0000",
        "010AMISSING0000007F000001DB\n00000",
        "020AMISSING0000007F000001DB\n0000",
        "010A 08157-00068+05783+00000-004931+005713-015905+000000000003F00000018\n0000",
        "010A+08157-00068+05783+00000-004931+005713-015905+00000000000+F00000018\n0000",
    ],
)
def test_tx_of_another_form_is_refused(text):
    with pytest.raises(ndi.NdiDamaged):
        ndi_tracking.parse_tx(text, ndi_tracking.TRANSFORMS)


# --- BX -----------------------------------------------------------------------------------------------------


def test_bx_of_two_missing_tools_of_a_real_polaris():
    reply = ndi_tracking.parse_bx(TWO_MISSING, ndi_tracking.TRANSFORMS)
    assert [(t.handle, t.state, t.port_status, t.frame_number) for t in reply.tools] == [
        (1, State.MISSING, 0x31, 0),
        (2, State.MISSING, 0x31, 0),
    ]
    assert ndi_tracking.encode_bx(reply, ndi_tracking.TRANSFORMS) == TWO_MISSING


def test_bx_of_a_seen_and_a_missing_tool_of_a_real_polaris():
    reply = ndi_tracking.parse_bx(ONE_VALID, ndi_tracking.TRANSFORMS)
    missing, valid = reply.tools
    assert (missing.state, missing.frame_number, valid.state, valid.frame_number) == (
        State.MISSING, 296, State.VALID, 298,
    )  # fmt: skip
    assert valid.quaternion == pytest.approx((0.5592, 0.6136, 0.3869, 0.4014), abs=1e-4)
    assert valid.position == pytest.approx((-88.73, 164.83, -2199.99), abs=0.01)
    assert valid.error == pytest.approx(0.0338, abs=1e-4)
    assert ndi_tracking.encode_bx(reply, ndi_tracking.TRANSFORMS) == ONE_VALID


def test_bx_holds_positions_to_single_precision():
    position = (12.3456789, -98.7654321, 0.1)
    data = ndi_tracking.encode_bx(
        TrackingReply((ToolState(9, State.VALID, (1.0, 0, 0, 0), position, 0.0),)), 1
    )
    assert ndi_tracking.parse_bx(data, 1).tools[0].position == tuple(np.float32(position).tolist())


@pytest.mark.parametrize("place", range(len(ONE_VALID)))
def test_a_changed_bit_anywhere_is_noticed(place):
    damaged = bytearray(ONE_VALID)
    damaged[place] ^= 0x10
    with pytest.raises(ndi.NdiDamaged):
        ndi_tracking.parse_bx(bytes(damaged), ndi_tracking.TRANSFORMS)


@pytest.mark.parametrize("size", range(len(ONE_VALID)))
def test_a_reply_that_was_cut_is_noticed(size):
    with pytest.raises(ndi.NdiDamaged):
        ndi_tracking.parse_bx(ONE_VALID[:size], ndi_tracking.TRANSFORMS)


def test_a_reply_to_other_options_is_noticed():
    with pytest.raises(ndi.NdiDamaged):
        ndi_tracking.parse_bx(ONE_VALID, ndi_tracking.TRANSFORMS | ndi_tracking.TOOL_INFORMATION)


_coordinates = st.floats(-9000, 9000, width=32)
_points = st.tuples(_coordinates, _coordinates, _coordinates)


@st.composite
def _markers(draw):
    points = tuple(draw(st.lists(_points, max_size=9)))
    return Markers(points, draw(st.integers(0, 2 ** len(points) - 1)))


@st.composite
def _tools(draw, options):
    state = draw(st.sampled_from([State.VALID, State.MISSING, State.DISABLED]))
    handle = draw(st.integers(0, 255))
    if state is State.DISABLED:
        return ToolState(handle, state)
    values = {}
    if options & ndi_tracking.TRANSFORMS:
        values = {
            "port_status": draw(st.integers(0, 2**32 - 1)),
            "frame_number": draw(st.integers(0, 2**32 - 1)),
        }
        if state is State.VALID:
            unit = st.floats(-1, 1, width=32)
            values |= {
                "quaternion": draw(st.tuples(unit, unit, unit, unit)),
                "position": draw(_points),
                "error": draw(st.floats(0, 9, width=32)),
            }
    if options & ndi_tracking.TOOL_INFORMATION:
        values["tool_information"] = draw(st.integers(0, 255))
        values["marker_information"] = draw(st.binary(min_size=10, max_size=10))
    if options & ndi_tracking.SINGLE_STRAY:
        values["stray"] = draw(st.none() | _points)
    if options & ndi_tracking.TOOL_MARKERS:
        values["markers"] = draw(_markers())
    return ToolState(handle, state, **values)


@st.composite
def _replies(draw):
    options = draw(st.sets(st.sampled_from([0x0001, 0x0002, 0x0004, 0x0008, 0x0800, 0x1000]))) or {1}
    options = sum(options)
    tools = tuple(draw(st.lists(_tools(options), max_size=6)))
    strays = draw(_markers()) if options & ndi_tracking.PASSIVE_STRAYS else Markers()
    return options, TrackingReply(tools, draw(st.integers(0, 0xFFFF)), strays)


def _same(one, other):
    return repr(one) == repr(other)  # NaN is NaN here


@given(_replies())
@settings(max_examples=200)
def test_bx_comes_back_as_it_was_with_all_options(case):
    options, reply = case
    assert _same(ndi_tracking.parse_bx(ndi_tracking.encode_bx(reply, options), options), reply)


@given(_replies())
@settings(max_examples=200)
def test_tx_comes_back_to_its_own_precision_with_all_options(case):
    options, reply = case
    text = ndi_tracking.encode_tx(reply, options)
    again = ndi_tracking.parse_tx(text, options)
    assert ndi_tracking.encode_tx(again, options) == text
    for sent, got in zip(reply.tools, again.tools, strict=True):
        assert (sent.handle, sent.port_status, sent.frame_number) == (
            got.handle,
            got.port_status,
            got.frame_number,
        )
        if options & ndi_tracking.TRANSFORMS:
            assert sent.state is got.state
            np.testing.assert_allclose(got.position, sent.position, atol=0.00501)
            np.testing.assert_allclose(got.quaternion, sent.quaternion, atol=0.0000501)


# --- replies out of a stream --------------------------------------------------------------------------------


def read_all(data, cuts=()):
    """Everything that a reader finds in the bytes, fed in the pieces between the cuts."""
    reader, items, start = ndi_reader.ReplyReader(), [], 0
    for cut in [*sorted(cuts), len(data)]:
        reader.feed(data[start:cut])
        start = cut
        while (item := reader.next()) is not None:
            items.append(item)
    return items, reader.clear()


def good(items):
    return [item.data for item in items if isinstance(item, ndi_reader.Reply)]


def damaged_bytes(items):
    return sum(item.size for item in items if isinstance(item, ndi_reader.Damage))


TEXT = ndi.reply("OKAY")
ERROR = ndi.error_reply(0x0C)


def test_replies_of_both_kinds_follow_each_other():
    items, left = read_all(TEXT + ONE_VALID + ERROR + TWO_MISSING)
    assert good(items) == [TEXT, ONE_VALID, ERROR, TWO_MISSING]
    assert (damaged_bytes(items), left) == (0, 0)
    assert [item.binary for item in items] == [False, True, False, True]


@given(
    st.lists(st.sampled_from([TEXT, ERROR, ONE_VALID, TWO_MISSING, ndi.reply("a\nb\n")]), max_size=8),
    st.data(),
)
@settings(max_examples=100)
def test_the_pieces_in_which_bytes_come_do_not_matter(records, data):
    stream = b"".join(records)
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=12))
    items, left = read_all(stream, cuts)
    assert good(items) == records
    assert left == 0


@pytest.mark.parametrize("place", range(len(ONE_VALID)))
def test_after_a_lost_byte_the_next_reply_is_found(place):
    damaged = ONE_VALID[:place] + ONE_VALID[place + 1 :]
    items, _ = read_all(damaged + TWO_MISSING * 3)
    assert good(items) == [TWO_MISSING] * 3
    assert damaged_bytes(items) == len(damaged)


@pytest.mark.parametrize("place", range(len(ONE_VALID)))
@pytest.mark.parametrize("value", [0x00, 0x0D, 0x20, 0xA5, 0xC4, 0xFF])
def test_after_a_changed_byte_the_next_replies_are_found(place, value):
    damaged = bytearray(ONE_VALID)
    if damaged[place] == value:
        damaged[place] ^= 0xFF
    else:
        damaged[place] = value
    items, _ = read_all(bytes(damaged) + TWO_MISSING + TEXT)
    assert good(items) == [TWO_MISSING, TEXT]
    assert damaged_bytes(items) == len(ONE_VALID)


def test_a_lost_carriage_return_costs_no_reply():
    items, _ = read_all(TEXT[:-1] + ERROR + TEXT)
    assert good(items) == [TEXT, ERROR, TEXT]


def test_rubbish_before_a_reply_is_left_out():
    items, _ = read_all(b"\x00\xfe~~" + TEXT + b"abc" + ERROR)
    assert good(items) == [TEXT, ERROR]
    assert damaged_bytes(items) == 7


def test_an_error_may_come_in_the_place_of_a_binary_reply():
    items, _ = read_all(ONE_VALID[:20] + ERROR)
    assert good(items) == []  # the header promises more: only silence can tell
    items, _ = read_all(ONE_VALID[:20] + ERROR + TWO_MISSING + TWO_MISSING)
    assert good(items) == [ERROR, TWO_MISSING, TWO_MISSING]


@given(st.binary(max_size=600), st.lists(st.integers(0, 600), max_size=5))
@settings(max_examples=300)
def test_any_bytes_are_taken_and_accounted_for(data, cuts):
    items, left = read_all(data, [cut for cut in cuts if cut <= len(data)])
    assert sum(map(len, good(items))) + damaged_bytes(items) + left == len(data)


@given(st.lists(st.sampled_from([TEXT, ONE_VALID, TWO_MISSING]), min_size=1, max_size=5), st.data())
@settings(max_examples=200)
def test_damage_never_hides_what_comes_much_later(records, data):
    stream = bytearray(b"".join(records))
    for _ in range(data.draw(st.integers(1, 3))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    # 0xFFFF is the longest that a header can promise; a damaged header fails its own CRC.
    items, _ = read_all(bytes(stream) + TWO_MISSING * 4 + TEXT)
    assert good(items)[-1] == TEXT


def test_a_reader_holds_a_bounded_number_of_bytes():
    reader = ndi_reader.ReplyReader()
    for _ in range(200):
        reader.feed(b"text without an end " * 100)
        while reader.next() is not None:
            pass
    assert reader.clear() <= ndi_reader.MAX_BUFFER
    with pytest.raises(ndi.NdiDamaged):
        reader.feed(bytes(ndi_reader.MAX_BUFFER + 1))
    assert not reader.pending


def test_headers_that_promise_much_are_not_checked_again_and_again():
    header = ndi_tracking.BX_START + struct.pack("<H", 0x4000)
    header += struct.pack("<H", ndi.crc16(header)) + b"\x01\x02"
    items, _ = read_all(header * 10_000 + bytes(0x8000) + TEXT)
    assert good(items) == [TEXT]


@given(st.binary(max_size=300))
@settings(max_examples=300)
def test_parsers_refuse_bytes_with_their_own_exceptions_only(data):
    for parse in (ndi.parse_command, ndi.parse_reply, lambda d: ndi_tracking.parse_bx(d, 0x180F)):
        try:
            parse(data)
        except (ndi.NdiDamaged, ndi.NdiError):
            pass


@given(st.text("0123456789ABCDEF+-\nMISNGDBLEUOCP", max_size=200), st.integers(0, 0x1FFF))
@settings(max_examples=300)
def test_text_parsers_refuse_text_with_their_own_exceptions_only(text, options):
    for parse in (
        lambda t: ndi_tracking.parse_tx(t, options),
        lambda t: ndi.parse_phinf(t, options),
        ndi.parse_phsr,
        ndi.parse_ver,
        ndi.parse_get,
    ):
        try:
            parse(text)
        except ndi.NdiDamaged:
            pass


@given(st.binary(max_size=200), st.integers(0, 0x1FFF))
@settings(max_examples=300)
def test_a_body_with_right_crcs_may_hold_anything(body, options):
    header = ndi_tracking.BX_START + struct.pack("<H", len(body))
    data = header + struct.pack("<H", ndi.crc16(header)) + body + struct.pack("<H", ndi.crc16(body))
    try:
        ndi_tracking.parse_bx(data, options)
    except ndi.NdiDamaged:
        pass


def test_a_reply_of_the_right_length_with_a_wrong_crc_is_told_without_waiting_for_more():
    for place in range(6, len(ONE_VALID)):
        damaged = bytearray(ONE_VALID)
        damaged[place] = 0x0D if damaged[place] != 0x0D else 0x0A
        reader = ndi_reader.ReplyReader()
        reader.feed(bytes(damaged))
        assert reader.next() == ndi_reader.Damage(len(ONE_VALID))
        assert not reader.pending
