"""RTC3D: what its bytes mean, in both byte orders, and that damaged ones do no harm."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack.drivers.devices import rtc3d
from tonguetrack.drivers.devices.rtc3d import BIG, LITTLE, Component, PacketReader, Rtc3dError
from tonguetrack.drivers.devices.rtc3d_decode import decode_into

ORDERS = (BIG, LITTLE)
# The head of a data frame of a real Wave: 1 component, 536 bytes, 6D, frame 25865, 16 tools.
WAVE_HEAD = bytes.fromhex("00000001 00000218 00000004 00006509 0000000003daabe4 00000010")
MISSING_TOOL = b"\xff" * 32


def wave_body(tools):
    return WAVE_HEAD + b"".join(tools)


def tool(*values):
    return struct.pack(">8f", *values)


def frame_arrays(coils):
    return np.empty((coils, 3)), np.empty((coils, 4)), np.empty(coils)


def six_d(positions, number=7, time_us=17500, order=BIG, zeros=False):
    positions = np.asarray(positions, dtype=float)
    quaternions = np.tile([0.6, 0.8, 0.0, 0.0], (len(positions), 1))
    items = rtc3d.six_d_items(positions, quaternions, zeros=zeros)
    return rtc3d.encode_frame([Component(rtc3d.SIX_D, number, time_us, items)], order)


# Packets


def test_the_size_counts_the_head_and_is_big_endian():
    assert rtc3d.encode_text(rtc3d.COMMAND, "Bye") == b"\x00\x00\x00\x0b\x00\x00\x00\x01Bye"
    assert rtc3d.encode_text(rtc3d.COMMAND, "Bye", nul=True) == b"\x00\x00\x00\x0c\x00\x00\x00\x01Bye\x00"


def test_packets_come_out_whole_however_the_bytes_are_cut():
    packets = [(1, b"OK"), (3, six_d([[1, 2, 3]])), (4, b""), (0, b"Error-x\0")]
    stream = b"".join(rtc3d.encode_packet(kind, body) for kind, body in packets)
    for step in (1, 3, 8, 9, len(stream)):
        reader, seen = PacketReader(), []
        for start in range(0, len(stream), step):
            reader.feed(stream[start : start + step])
            while (packet := reader.next()) is not None:
                seen.append((packet.kind, packet.body))
        assert seen == packets
        assert reader.held_bytes == 0


@pytest.mark.parametrize("size", [0, 7, 50_001, 2**32 - 1])
def test_a_size_that_no_packet_has_is_an_error(size):
    reader = PacketReader()
    reader.feed(struct.pack(">II", size, 1))
    with pytest.raises(Rtc3dError, match=f"{size} bytes"):
        reader.next()


def test_a_kind_that_no_packet_has_is_an_error():
    reader = PacketReader()
    reader.feed(struct.pack(">II", 12, 6))
    with pytest.raises(Rtc3dError, match="kind 6"):
        reader.next()


def test_the_reader_holds_no_more_than_a_packet_and_a_read():
    reader = PacketReader()
    reader.feed(rtc3d.encode_packet(4, b"") * 8192)
    with pytest.raises(Rtc3dError, match="waiting"):
        reader.feed(b"x")
    taken = 0
    while reader.next() is not None:
        taken += 1
    assert taken == 8192
    reader.feed(b"\0\0")
    assert reader.held_bytes == 2


def test_the_longest_packet_is_read_and_a_longer_one_not_made():
    longest = rtc3d.encode_packet(3, bytes(rtc3d.LARGEST_PACKET - 8))
    reader = PacketReader()
    reader.feed(longest)
    assert len(reader.next().body) == rtc3d.LARGEST_PACKET - 8
    with pytest.raises(Rtc3dError, match="too long"):
        rtc3d.encode_packet(3, bytes(rtc3d.LARGEST_PACKET - 7))


@pytest.mark.parametrize("body", [b"OK-Version 1.0", b"OK-Version 1.0\0", b" OK-Version 1.0 \0\0"])
def test_text_is_the_same_in_both_dialects(body):
    assert rtc3d.text_of(body) == "OK-Version 1.0"


# Data frames


def test_the_head_of_a_real_wave_frame_is_understood():
    tools = [tool(0.6, 0.8, 0, 0, 1, 2, 3, 0)] * 4
    body = wave_body([*tools, MISSING_TOOL, *[tool(0.6, 0.8, 0, 0, 4, 5, 6, 0.25)] * 11])
    assert len(body) + 8 == 548
    positions, quaternions, rms = frame_arrays(16)
    head = decode_into(body, BIG, rtc3d.SIX_D, positions, quaternions, rms)
    assert (head.number, head.time_us, head.count) == (25865, 64_662_500, 16)
    assert head.time_us == head.number * 2500
    np.testing.assert_allclose(positions[3], [1, 2, 3])
    np.testing.assert_allclose(positions[15], [4, 5, 6])
    np.testing.assert_allclose(quaternions[0], [0.6, 0.8, 0, 0], atol=1e-7)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(positions).any(axis=1)), [4])
    assert np.isnan(quaternions[4]).all() and np.isnan(rms[4])
    assert rms[15] == 0.25


@pytest.mark.parametrize("order", ORDERS)
def test_every_component_survives_a_round_trip(order):
    random = np.random.default_rng(1)
    events = np.zeros(2, rtc3d.EVENTS[BIG])
    events["id"], events["time_us"], events["parameters"] = [7, 8], [2**40, 1], [[1, 2, 3], [4, 5, 6]]
    components = [
        Component(kind, 2**32 - 1, 2**63, random.normal(size=(3, len(fields))).astype(np.float32))
        for kind, fields in rtc3d.FIELDS.items()
    ] + [Component(rtc3d.EVENT, 1, 2, events)]
    decoded = rtc3d.decode_frame(rtc3d.encode_frame(components, order), order)
    assert [(c.kind, c.number, c.time_us) for c in decoded] == [
        (c.kind, c.number, c.time_us) for c in components
    ]
    for before, after in zip(components, decoded, strict=True):
        np.testing.assert_array_equal(before.items, after.items)


@pytest.mark.parametrize("order", ORDERS)
def test_missing_coils_are_ff_bytes_or_zeros_and_read_as_nan_either_way(order):
    positions = [[1, 2, 3], [np.nan] * 3, [0, 0, 0]]
    for zeros, bytes_of_one in ((False, MISSING_TOOL), (True, bytes(32))):
        body = six_d(positions, order=order, zeros=zeros)
        assert body[28 + 32 : 28 + 64] == bytes_of_one
        read, quaternions, rms = frame_arrays(3)
        decode_into(body, order, rtc3d.SIX_D, read, quaternions, rms)
        np.testing.assert_array_equal(read, positions)  # a coil at the origin that is turned is there
        assert np.isnan(quaternions[1]).all() and np.isnan(rms[1])
        assert np.isfinite(quaternions[[0, 2]]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1.1e6, -3e38])
@pytest.mark.parametrize("place", range(7))
def test_a_tool_with_an_impossible_number_is_missing_as_a_whole(value, place):
    values = [0.6, 0.8, 0, 0, 1, 2, 3, 0]
    values[place] = value
    good = tool(0.6, 0.8, 0, 0, 4, 5, 6, 0)
    body = struct.pack(">IIIIQI", 1, 24 + 64, 4, 1, 2500, 2) + tool(*values) + good
    positions, quaternions, rms = frame_arrays(2)
    decode_into(body, BIG, rtc3d.SIX_D, positions, quaternions, rms)
    assert np.isnan(positions[0]).all() and np.isnan(quaternions[0]).all() and np.isnan(rms[0])
    np.testing.assert_array_equal(positions[1], [4, 5, 6])


def test_a_fit_error_that_is_no_number_leaves_the_position_alone():
    body = struct.pack(">IIIIQI", 1, 24 + 32, 4, 1, 2500, 1) + tool(0.6, 0.8, 0, 0, 1, 2, 3, np.inf)
    positions, quaternions, rms = frame_arrays(1)
    decode_into(body, BIG, rtc3d.SIX_D, positions, quaternions, rms)
    assert np.isnan(rms[0])
    np.testing.assert_array_equal(positions[0], [1, 2, 3])


@pytest.mark.parametrize("order", ORDERS)
def test_markers_have_positions_only_and_are_missing_by_nan_zeros_or_reliability(order):
    made = rtc3d.three_d_items(np.array([[1, 2, 3], [np.nan] * 3, [4, 5, 6]]))
    assert made[1, 3] == 999.0
    items = np.vstack([made, [[7, 8, 9, 999.0], [0, 0, 0, 0], [1, 1, 1, np.nan], [2, 2, 2, 0.5]]])
    body = rtc3d.encode_frame([Component(rtc3d.THREE_D, 1, 1, items.astype(np.float32))], order)
    positions = np.empty((7, 3))
    assert decode_into(body, order, rtc3d.SIX_D, positions) is None
    decode_into(body, order, rtc3d.THREE_D, positions)
    np.testing.assert_array_equal(np.isnan(positions).any(axis=1), [0, 1, 0, 1, 1, 1, 0])
    np.testing.assert_array_equal(positions[[0, 2, 6]], [[1, 2, 3], [4, 5, 6], [2, 2, 2]])


def test_fewer_items_than_coils_are_missing_coils_and_more_are_left_out():
    positions, quaternions, rms = frame_arrays(3)
    head = decode_into(six_d([[1, 2, 3]]), BIG, rtc3d.SIX_D, positions, quaternions, rms)
    assert head.count == 1
    assert np.isnan(positions[1:]).all() and np.isnan(quaternions[1:]).all() and np.isnan(rms[1:]).all()
    head = decode_into(six_d([[k, k, k] for k in range(5)]), BIG, rtc3d.SIX_D, positions)
    assert head.count == 5
    np.testing.assert_array_equal(positions, [[0, 0, 0], [1, 1, 1], [2, 2, 2]])


@pytest.mark.parametrize("order", ORDERS)
def test_components_of_unknown_kinds_are_stepped_over_by_their_size(order):
    known = six_d([[1, 2, 3]], order=order)[4:]
    for rest in (b"", b"abcd" * 5):
        unknown = struct.pack(order + "IIIQ", 20 + len(rest), 77, 1, 2) + rest
        body = struct.pack(order + "I", 2) + unknown + known
        positions = np.empty((1, 3))
        assert decode_into(body, order, rtc3d.SIX_D, positions).number == 7
        assert [c.kind for c in rtc3d.decode_frame(body, order)] == [rtc3d.SIX_D]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("expected", ORDERS)
def test_the_byte_order_shows_in_the_sizes(order, expected):
    body = six_d(np.ones((16, 3)), order=order)
    assert rtc3d.order_of(body, expected) == order


def test_a_frame_without_components_has_no_byte_order():
    assert rtc3d.order_of(bytes(4)) is None
    assert rtc3d.order_of(b"") is None


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"", "0 bytes"),
        (b"\0\0\0", "3 bytes"),
        (struct.pack(">I", 2**32 - 1), "components"),
        (struct.pack(">III", 1, 19, 4) + bytes(30), "component of 19"),
        (struct.pack(">III", 1, 600, 4) + bytes(30), "component of 600"),
        (struct.pack(">IIIIQ", 1, 20, 4, 1, 2), "component of 20"),
        (struct.pack(">IIIIQI", 1, 24, 4, 1, 2, 1), "1 items"),
        (struct.pack(">IIIIQI", 1, 24, 4, 1, 2, 2**32 - 1), "items"),
        (struct.pack(">IIIIQI", 1, 24, 4, 1, 2, 0) + b"x", "follow"),
        (struct.pack(">IIIIQI", 2, 24, 4, 1, 2, 0) + bytes(16), "ends within"),
    ],
)
def test_sizes_and_counts_that_do_not_fit_are_an_error(body, words):
    with pytest.raises(Rtc3dError, match=words):
        decode_into(body, BIG, rtc3d.SIX_D, np.empty((1, 3)))
    with pytest.raises(Rtc3dError, match=words):
        rtc3d.decode_frame(body, BIG)


@settings(max_examples=300, deadline=None)
@given(
    st.binary(min_size=0, max_size=40),
    st.integers(0, 150),
    st.integers(0, 150),
    st.sampled_from(ORDERS),
)
def test_damaged_frames_raise_nothing_but_the_error_and_leave_no_nonsense(damage, at, end, order):
    body = bytearray(six_d([[1, 2, 3], [np.nan] * 3, [4, 5, 6]], order=order))
    body[at : at + len(damage)] = damage
    body = bytes(body[: max(end, 30)])
    positions, quaternions, rms = frame_arrays(3)
    try:
        head = decode_into(body, order, rtc3d.SIX_D, positions, quaternions, rms)
        rtc3d.decode_frame(body, order)
    except Rtc3dError:
        return
    if head is not None:
        assert (np.isnan(positions) | (np.abs(positions) <= rtc3d.FARTHEST)).all()
        assert (np.isnan(positions).all(axis=1) == np.isnan(positions).any(axis=1)).all()
        assert not np.isinf(quaternions).any() and not np.isinf(rms).any()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(max_size=200), max_size=20))
def test_any_bytes_are_packets_or_the_error_and_the_reader_stays_small(chunks):
    reader = PacketReader()
    try:
        for chunk in chunks:
            reader.feed(chunk)
            while (packet := reader.next()) is not None:
                assert 0 <= packet.kind <= rtc3d.C3D
            assert reader.held_bytes <= rtc3d.LARGEST_PACKET
    except Rtc3dError:
        pass


# Parameters


def test_parameters_say_rate_number_and_names():
    text = rtc3d.parameters_xml(400.0, ["Sensor 1", "a<b&c"])
    assert rtc3d.parse_parameters(text.encode() + b"\0") == rtc3d.Parameters(400.0, ("Sensor 1", "a<b&c"))


@pytest.mark.parametrize(
    ("text", "parameters"),
    [
        ("<x/>", rtc3d.Parameters()),
        ("<P><Frequency>100</Frequency></P>", rtc3d.Parameters(100.0)),
        ("<P><Frequency>fast</Frequency></P>", rtc3d.Parameters()),
        ("<P><Frequency>-1</Frequency><Frequency/></P>", rtc3d.Parameters()),
        ("<P xmlns='urn:x'><The_3D><Frequency>60.5</Frequency><Marker/></The_3D></P>", rtc3d.Parameters(60.5, ("",))),
        (("<P><The_3D><Marker><Label>m</Label></Marker></The_3D><!-- two --><The_6D><Tools><Tool><Label> a\n1 </Label>"
          "<Markers><Marker/></Markers></Tool><Tool id='2'/></Tools></The_6D></P>"), rtc3d.Parameters(0.0, ("a1", ""))),
        ("<?xml version='1.0' encoding='UTF-16'?><P><Tools>1e99</Tools></P>", rtc3d.Parameters()),
    ],
)  # fmt: skip
def test_parameters_may_lack_anything(text, parameters):
    assert rtc3d.parse_parameters(text.encode()) == parameters


@pytest.mark.parametrize(
    "body", [b"", b"<P>", b"\xff\xfe<", b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", b"<a>&b;</a>", bytes(60_000)]
)  # fmt: skip
def test_parameters_that_are_no_plain_xml_are_refused(body):
    with pytest.raises(Rtc3dError, match="parameters"):
        rtc3d.parse_parameters(body)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 200))
def test_damaged_parameters_raise_nothing_but_the_error(damage, at):
    text = bytearray(rtc3d.parameters_xml(400.0, ["a", "b"]).encode())
    text[at : at + len(damage)] = damage
    try:
        parameters = rtc3d.parse_parameters(bytes(text))
    except Rtc3dError:
        return
    assert all(name.isprintable() and len(name) <= rtc3d.LONGEST_NAME for name in parameters.names)
