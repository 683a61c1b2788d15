"""What the monitor says of what arrives, and that nothing that arrives can hurt it."""

import json
import random
import struct

import numpy as np
import pytest
from pythonosc.osc_message_builder import OscMessageBuilder

from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams import monitor as module
from tonguetrack.tracker.streams import vocabularies
from tonguetrack.tracker.streams.monitor import Monitor, Stream, decode
from tonguetrack.tracker.streams.osc import FrameBundle, info_datagrams
from tonguetrack.tracker.streams.presets import load_preset
from tonguetrack.tracker.streams.sink import StreamInfo
from tonguetrack.tracker.streams.vocabularies import preset_vocabularies

HERE = ("127.0.0.1", 50000)
MS = 1_000_000


def frame(number, latency_ms=0.25, size=4):
    pose = TrackedPose(
        np.arange(size) * 0.5, np.zeros(size), np.zeros(5), np.zeros(3), 0.5, 1.0, 3, PoseStatus.OK
    )
    bundle = FrameBundle(size)
    bundle.write(pose, number, number / 250.0, latency_ms)
    return bytes(bundle.datagram)


def about():
    return info_datagrams(
        StreamInfo("a synthetic model", "f", 60, np.zeros(4), np.ones(4), np.ones(5), True, ("tip",), 250.0)
    )[0]


def message(path, *values):
    builder = OscMessageBuilder(path)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


def heard(datagrams, sender=HERE, told=None):
    monitor = Monitor(tell=(lambda sentence: None) if told is None else told.append)
    for k, datagram in enumerate(datagrams):
        monitor.receive(datagram, sender, k * 4 * MS)
    json.dumps(monitor.as_dict(), allow_nan=False)
    assert str(monitor)
    return monitor


def stream_of(numbers):
    stream = Stream()
    for number in numbers:
        stream.add(number)
    return stream


# What arrives ---------------------------------------------------------------------------------------


def test_a_whole_stream_has_its_rate_and_no_gap():
    result = heard([about(), *map(frame, range(250))]).as_dict()
    assert result["malformed"] == 0
    assert result["unknown"] == {}
    (stream,) = result["streams"]
    assert (stream["sender"], stream["frames"], stream["lost"]) == ("127.0.0.1:50000", 250, 0)
    assert stream["info"]["model name"] == "a synthetic model"
    assert result["addresses"]["/tongue/frame"]["rate_hz"] == pytest.approx(250.0)
    assert result["addresses"]["/tongue/pose"]["last"] == [0.0, 0.5, 1.0, 1.5]
    assert result["latency_ms"]["p50"] == pytest.approx(0.25)
    assert all(seen["misfits"] == 0 for seen in result["addresses"].values())


def test_missing_numbers_are_lost_frames():
    stream = stream_of([0, 1, 2, 5, 6, 9])
    assert (stream.frames, stream.lost, stream.late) == (6, 4, 0)
    assert stream.lost_percent == pytest.approx(40.0)


def test_an_overtaken_frame_is_late_and_not_lost():
    stream = stream_of([0, 1, 3, 2, 4])
    assert (stream.lost, stream.late, stream.starts) == (0, 1, 1)


def test_a_frame_that_comes_twice_is_repeated():
    stream = stream_of([0, 1, 1, 2])
    assert (stream.lost, stream.late, stream.repeated) == (0, 0, 1)


def test_a_stream_that_was_joined_later_has_lost_nothing():
    assert stream_of([5000, 5001, 5002]).lost == 0


@pytest.mark.parametrize("numbers", [[7, 8, 0, 1], [5000, 5001, 3000, 3001], [2**31 - 1, 0, 1]])
def test_a_number_that_falls_far_back_or_to_zero_starts_a_stream(numbers):
    stream = stream_of(numbers)
    assert (stream.starts, stream.lost, stream.late, stream.repeated) == (2, 0, 0, 0)


def test_two_senders_are_two_streams():
    monitor = Monitor()
    for number in range(10):
        monitor.receive(frame(number), ("127.0.0.1", 1), number)
        monitor.receive(frame(number + 100), ("::1", 2), number)
    streams = monitor.as_dict()["streams"]
    assert [(stream["sender"], stream["frames"], stream["lost"]) for stream in streams] == [
        ("127.0.0.1:1", 10, 0), ("[::1]:2", 10, 0),
    ]  # fmt: skip


def test_starts_and_info_and_strangers_are_told_once():
    told = []
    heard([about(), frame(0), about(), frame(1), message("/other", 1), message("/other", 2)], told=told)
    assert len(told) == 3
    assert "synthetic" in told[0]
    assert "starts, at frame 0" in told[1]
    assert "unknown address /other" in told[2]


def test_unknown_addresses_are_named_and_counted():
    monitor = heard(
        [message("/stranger", 1), message("/tongue/posse", 1.0), message("/tongue/pose/x", 1.0)] * 2
    )
    assert monitor.as_dict()["unknown"] == {"/stranger": 2, "/tongue/pose/x": 2, "/tongue/posse": 2}
    assert "/tongue/posse: 2" in str(monitor)


@pytest.mark.parametrize(
    "datagram",
    [message("/tongue/frame", 1), message("/tongue/frame", 1.0, 2.0, 3), message("/tongue/pose", "text"),
     message("/tongue/quality", 0.5, 3, 0.1, 7), message("/tongue/info", "tonguetrack")],
)  # fmt: skip
def test_other_arguments_than_the_tables_are_counted_apart(datagram):
    monitor = heard([datagram] * 3)
    (seen,) = monitor.as_dict()["addresses"].values()
    assert (seen["count"], seen["misfits"]) == (3, 3)
    assert not monitor.streams


# What a live run says of itself ---------------------------------------------------------------------


def test_coil_states_are_told_by_role_when_they_change():
    told = []
    states = [message("/tongue/coilstates", state) for state in (0, 2, 2, 0, 77)]
    monitor = heard([about(), *states], told=told)
    assert [sentence for sentence in told if "coils " in sentence] == [
        "127.0.0.1:50000: coils 1 of 1 trusted",
        "127.0.0.1:50000: coils 0 of 1 trusted, tip wild",
        "127.0.0.1:50000: coils 1 of 1 trusted",
        "127.0.0.1:50000: coils 0 of 1 trusted, tip 77",
    ]
    assert "said       coils 0 of 1 trusted, tip 77" in str(monitor)


def test_coils_whose_roles_are_not_known_are_numbered():
    told = []
    heard([message("/tongue/coilstates", 0, 1, 0)], told=told)
    assert "coils 2 of 3 trusted, 2 missing" in told[0]


def test_a_take_is_told_when_it_starts_fails_or_ends_and_not_at_every_second():
    told = []
    takes = [("", 0, ""), ("a.xdf", 1, ""), ("a.xdf", 2, ""), ("a.xdf", 2, "the disk is full"), ("", 0, "")]
    heard([message("/tongue/take", *values) for values in takes], told=told)
    assert [sentence.partition(": ")[2] for sentence in told] == [
        "no take", "take a.xdf", "take a.xdf, FAILED: the disk is full", "no take"
    ]  # fmt: skip


def test_the_stages_of_the_latency_are_shown_with_what_is_unknown_left_open():
    stages = [-1.0, -1.0, 0.125, 0.25, 0.5, float("nan")]
    monitor = heard([frame(0), message("/tongue/latency", *stages)])
    assert "device to host -/-, host to solved 0.12/0.25, solved to sent 0.50/- ms" in str(monitor)
    assert monitor.as_dict()["addresses"]["/tongue/latency"]["misfits"] == 0


# What should not arrive -----------------------------------------------------------------------------

HEADER = b"#bundle\0" + bytes(7) + b"\1"


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"\0",
        b"hello, this is no OSC",
        b"#bundle\0",
        HEADER + b"\0\0",
        HEADER + struct.pack(">i", -4),  # python-osc 1.10 would read this one for ever
        HEADER + struct.pack(">i", 0),
        HEADER + struct.pack(">i", 2**31 - 1),
        HEADER + struct.pack(">i", 8) + b"/a\0\0",
        HEADER + struct.pack(">i", 4) + b"abcd",
        b"/no/zero",
        b"/a\0\0,i\0\0",
        b"/a\0\0,s\0\0abcd",
        b"/a\0\0,[[[[[\0\0",
        b"/a\0\0,b\0\0" + struct.pack(">i", -1),
        b"/a\0\0,t\0\0" + b"\xff" * 8,
        b"/\xff\xfe\0,\0\0\0",
        bytes(8196),
        b"/a\0\0,b\0\0" + struct.pack(">i", 9000) + bytes(9000),
    ],
)
def test_what_is_not_osc_is_counted_and_nothing_else(datagram):
    monitor = heard([datagram])
    assert monitor.datagrams == 1
    assert not monitor.streams
    assert not monitor.seen


def test_bundles_in_bundles_are_followed_only_so_far():
    inner = message("/tongue/pose", 1.0)
    nested = inner
    for _ in range(300):
        nested = HEADER + struct.pack(">i", len(nested)) + nested
        if len(nested) < 200:
            assert decode(nested) in (None, [("/tongue/pose", [1.0])])
    assert decode(HEADER + struct.pack(">i", len(inner)) + inner) == [("/tongue/pose", [1.0])]
    assert decode(nested) is None


def test_random_damage_to_real_datagrams_never_raises():
    dice = random.Random(3)
    state = (
        message("/tongue/coilstates", 0, 1),
        message("/tongue/take", "a", 1, ""),
        message("/tongue/latency", *[0.5] * 6),
    )
    seeds = [frame(7), about(), *state, message("/x", "text", 1, 2**40, 1.5, b"blob", True, None, [1, 2])]
    monitor = Monitor()
    for k in range(20_000):
        damaged = bytearray(dice.choice(seeds))
        for _ in range(dice.choice((1, 2, 8))):
            damaged[dice.randrange(len(damaged))] = dice.choice((0, 1, 4, 127, 128, 255, *b"/[]tbmrifsTN"))
        cut = dice.randrange(len(damaged)) if dice.random() < 0.2 else len(damaged)
        monitor.receive(bytes(damaged[:cut]), ("127.0.0.1", dice.randrange(100)), k)
    json.dumps(monitor.as_dict(), allow_nan=False)
    assert str(monitor)
    assert len(monitor.streams) <= module.MAX_SENDERS
    assert len(monitor.unknown) <= module.MAX_UNKNOWN
    assert monitor.datagrams == 20_000


def test_memory_and_notices_stay_bounded_whatever_is_sent():
    told = []
    monitor = Monitor(tell=told.append)
    for k in range(3000):
        monitor.receive(message(f"/strange/{k}", 1), ("127.0.0.1", k), k)
        monitor.receive(frame((k * 7919) % 2**20), ("127.0.0.1", k % 40), k)
    assert len(monitor.unknown) == module.MAX_UNKNOWN
    assert monitor.unknown_beyond == 3000 - module.MAX_UNKNOWN
    assert len(monitor.streams) == module.MAX_SENDERS
    assert max(len(stream.missing) for stream in monitor.streams.values()) <= module.MAX_REMEMBERED_GAPS
    assert len(told) <= module.MAX_NOTICES


def test_foreign_text_cannot_command_the_terminal():
    told = []
    monitor = heard(
        [message("/\x1b[2J\x07evil\nline" + "x" * 500, 1), message("/tongue/coils", "\x1b]0;title\x07")],
        told=told,
    )
    for text in (*told, str(monitor)):
        assert "\x1b" not in text
        assert "\x07" not in text
    assert max(map(len, monitor.unknown)) <= 83


def test_numbers_that_are_none_are_shown_as_such():
    monitor = heard([message("/tongue/quality", float("nan"), 3, float("inf"))])
    assert monitor.as_dict()["addresses"]["/tongue/quality"]["last"] == [None, 3, None]
    assert monitor.latency_ns.count == 0


# Names ----------------------------------------------------------------------------------------------


def named(*messages_of):
    """A monitor that knows the presets, after these messages; and what it told."""
    told = []
    monitor = Monitor(told.append, preset_vocabularies())
    for k, datagram in enumerate(messages_of):
        monitor.receive(datagram, HERE, k * MS)
    json.dumps(monitor.as_dict(), allow_nan=False)
    return monitor, told


def blend(name, value=0.5):
    return message("/VMC/Ext/Blend/Val", name, value)


def test_blend_shapes_of_a_preset_are_all_there_or_the_missing_ones_are_named():
    names = [target.name for target in load_preset("a2f16").targets]
    monitor, told = named(*map(blend, names))
    assert (monitor.named.preset, monitor.named.missing, monitor.named.unknown) == ("a2f16", [], [])
    assert f"names      {len(names)}; preset a2f16: all of its names" in str(monitor)
    assert told == []
    monitor, _ = named(*map(blend, names[2:]))
    assert f"preset a2f16: missing {', '.join(sorted(names[:2]))}" in str(monitor)


def test_avatar_parameters_are_known_under_both_prefixes():
    paths = ["/avatar/parameters/v2/TongueOut", "/avatar/parameters/FT/v2/TongueX"]
    monitor, told = named(*(message(path, 0.25) for path in paths))
    assert monitor.as_dict()["names"]["counts"] == {"TongueOut": 1, "TongueX": 1}
    assert "TongueX  1  0.250" in str(monitor)
    assert monitor.unknown == {} and told == []


def test_a_name_in_no_preset_is_told_once_and_one_with_other_capitals_with_what_is_meant():
    monitor, told = named(*[blend("tongueout"), blend("Smile")] * 3)
    assert [sentence.partition(": ")[2] for sentence in told] == [
        "the name tongueout is in no preset; is tongueOut of the preset arkit meant? Capitals count",
        "the name Smile is in no preset",
    ]
    assert "names      unknown: tongueout, Smile" in str(monitor)


def test_the_models_own_directions_are_names_of_ours_however_many():
    monitor, told = named(blend("tip_up"), blend("pose_0"), blend("pose_12"))
    assert told == [] and monitor.named.preset == "own"


def test_every_address_of_vmc_and_vrchat_is_known_with_its_arguments():
    monitor, _ = named(
        message("/VMC/Ext/OK", 1, 3, 0, 1), message("/VMC/Ext/T", 0.5), blend("tongueOut"),
        message("/VMC/Ext/Blend/Apply"), message("/avatar/parameters/LipTrackingActive", True),
        message("/avatar/parameters/ExpressionTrackingActive", False), message("/avatar/parameters/v2/TongueX", -0.5),
    )  # fmt: skip
    addresses = monitor.as_dict()["addresses"]
    assert len(addresses) == 7 and not monitor.unknown
    assert all(seen["misfits"] == 0 for seen in addresses.values())
    monitor, _ = named(message("/avatar/parameters/LipTrackingActive", 1))
    assert monitor.seen["/avatar/parameters/LipTrackingActive"].misfits == 1


def test_what_is_sent_where_asked_for_is_known():
    blob = bytes(range(12))
    monitor, _ = named(
        message("/tongue/extra", 0, 1, 0.5), message("/tongue/coil/tongue_tip", 1.0, 2.0, 3.0),
        message("/tongue/shape/tip_up", 0.5), message("/tongue/mesh", 0, 0, 1, 0, 0.0025, blob),
    )  # fmt: skip
    assert not monitor.unknown
    assert all(seen.misfits == 0 for seen in monitor.seen.values())
    assert monitor.as_dict()["addresses"]["/tongue/mesh"]["last"][-1] == "12 bytes"


def test_names_and_the_addresses_that_hold_them_are_bounded():
    monitor, told = named(
        *(blend(f"name{k}") for k in range(2000)),
        *(message(f"/tongue/shape/name{k}", 0.5) for k in range(2000)),
        *(message(f"/avatar/parameters/other{k}", 0.5) for k in range(2000)),
    )
    assert len(monitor.seen) == module.MAX_SEEN and monitor.seen_beyond > 0
    assert len(monitor.named.counts) == vocabularies.MAX_NAMES
    assert len(told) <= module.MAX_NOTICES
    assert "further addresses: " in str(monitor)


def test_foreign_names_cannot_command_the_terminal():
    monitor, told = named(
        blend("\x1b[2Jevil" + "x" * 500), message("/VMC/Ext/Blend/Val", "nan", float("nan"))
    )
    assert all("\x1b" not in text for text in (*told, str(monitor)))
    assert monitor.as_dict()["names"]["last"]["nan"] is None
