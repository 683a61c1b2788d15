"""The OSC datagrams, held against OSC 1.0 by a strict decoder written here, and against python-osc."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_packet import OscPacket

from tonguetrack import InputError
from tonguetrack.tracker.pose import CoilState, PoseStatus, TrackedPose
from tonguetrack.tracker.streams.addresses import (
    ADDRESSES,
    CONTROL_FORMS,
    MAX_DATAGRAM_BYTES,
    find_address,
    protocol_page,
)
from tonguetrack.tracker.streams.osc import (
    CoilStatesDatagram,
    FrameBundle,
    info_datagrams,
    numbers_datagram,
    parse_destination,
)
from tonguetrack.tracker.streams.sink import LiveNumbers, StreamInfo

IMMEDIATELY = 1


def strict_string(data, at):
    """An OSC string: ASCII, a zero, zeros to the next multiple of four."""
    end = data.index(b"\0", at)
    following = end + 1 + -(end + 1) % 4
    assert following <= len(data), "the padding is missing"
    assert set(data[end:following]) == {0}, "the padding is not zero"
    return data[at:end].decode("ascii"), following


def strict_message(data):
    assert len(data) % 4 == 0
    address, at = strict_string(data, 0)
    assert address.startswith("/")
    assert not set(address) & set(" #*,?[]{}"), "reserved characters"
    tags, at = strict_string(data, at)
    assert tags.startswith(",")
    values = []
    for tag in tags[1:]:
        if tag == "s":
            value, at = strict_string(data, at)
        else:
            (value,) = struct.unpack_from({"i": ">i", "f": ">f"}[tag], data, at)
            at += 4
        values.append(value)
    assert at == len(data), "bytes are left over"
    return address, tags, values


def strict_bundle(data):
    """[(address, type tags, values)] of a bundle without bundles in it."""
    data = bytes(data)
    assert data[:8] == b"#bundle\0"
    assert struct.unpack_from(">Q", data, 8) == (IMMEDIATELY,)
    messages, at = [], 16
    while at < len(data):
        (size,) = struct.unpack_from(">i", data, at)
        assert size > 0
        assert at + 4 + size <= len(data)
        messages.append(strict_message(data[at + 4 : at + 4 + size]))
        at += 4 + size
    assert at == len(data)
    return messages


def pose_of(weights, normalised=None, residual_mm=0.5, valid_coils=3, status=PoseStatus.OK):
    weights = np.asarray(weights, dtype=np.float64)
    normalised = weights * 2 if normalised is None else np.asarray(normalised, dtype=np.float64)
    return TrackedPose(weights, normalised, np.zeros(5), np.zeros(3), residual_mm, 1.0, valid_coils, status)


def written(pose, sequence=0, time_s=0.0, latency_ms=0.0):
    bundle = FrameBundle(len(pose.weights))
    bundle.write(pose, sequence, time_s, latency_ms)
    return bytes(bundle.datagram)


def by_address(messages):
    return {address: values for address, _, values in messages}


def single(values):
    """As they are in 32-bit floats."""
    return np.float32(values).tolist()


@pytest.mark.parametrize("size", range(1, 41))
def test_every_number_arrives_whatever_k_is(size):
    random = np.random.default_rng(size)
    pose = pose_of(random.normal(size=size), random.normal(size=size), 1.25, 2)
    data = written(pose, 77, 12.5, 0.25)
    assert len(data) <= MAX_DATAGRAM_BYTES
    messages = by_address(strict_bundle(data))
    assert messages.pop("/tongue/frame") == [77, 12.5, PoseStatus.OK]
    assert messages.pop("/tongue/pose") == single(pose.weights)
    assert messages.pop("/tongue/sigma") == single(pose.normalised)
    assert messages.pop("/tongue/quality") == [1.25, 2, 0.25]
    if messages:
        for k in range(size):
            assert messages.pop(f"/tongue/pose/{k}") == single(pose.weights[k : k + 1])
            assert messages.pop(f"/tongue/sigma/{k}") == single(pose.normalised[k : k + 1])
        assert not messages
    assert FrameBundle(size).has_scalars == (size <= 18)


@pytest.mark.parametrize("size", [1, 4, 18, 19, 40])
def test_python_osc_reads_what_the_strict_decoder_reads(size):
    data = written(pose_of(np.linspace(-1, 1, size)), 5, 0.02, 0.1)
    theirs = [(timed.message.address, timed.message.params) for timed in OscPacket(data).messages]
    assert theirs == [(address, values) for address, _, values in strict_bundle(data)]
    assert OscBundle(data).timestamp == 0  # python-osc's word for immediately


def test_the_bundle_of_one_frame_is_these_bytes():
    pose = pose_of([0.5], [-2.0], residual_mm=1.5, valid_coils=3, status=PoseStatus.HELD)
    golden = (
        b"#bundle\0" + bytes([0, 0, 0, 0, 0, 0, 0, 1]),
        bytes([0, 0, 0, 36]) + b"/tongue/frame\0\0\0" + b",ifi\0\0\0\0",
        bytes([0, 0, 1, 2]) + bytes([0x3E, 0x80, 0, 0]) + bytes([0, 0, 0, 2]),
        bytes([0, 0, 0, 24]) + b"/tongue/pose\0\0\0\0" + b",f\0\0" + bytes([0x3F, 0, 0, 0]),
        bytes([0, 0, 0, 24]) + b"/tongue/sigma\0\0\0" + b",f\0\0" + bytes([0xC0, 0, 0, 0]),
        bytes([0, 0, 0, 24]) + b"/tongue/pose/0\0\0" + b",f\0\0" + bytes([0x3F, 0, 0, 0]),
        bytes([0, 0, 0, 24]) + b"/tongue/sigma/0\0" + b",f\0\0" + bytes([0xC0, 0, 0, 0]),
        bytes([0, 0, 0, 36]) + b"/tongue/quality\0" + b",fif\0\0\0\0",
        bytes([0x3F, 0xC0, 0, 0]) + bytes([0, 0, 0, 3]) + bytes([0x3F, 0, 0, 0]),
    )
    assert written(pose, sequence=258, time_s=0.25, latency_ms=0.5) == b"".join(golden)


def test_a_frame_replaces_every_number_of_the_one_before():
    bundle = FrameBundle(3)
    bundle.write(pose_of([9.0, 9.0, 9.0], residual_mm=9.0, valid_coils=9), 9, 9.0, 9.0)
    pose = pose_of([1.0, 2.0, 3.0], residual_mm=4.0, valid_coils=1)
    bundle.write(pose, 1, 2.0, 3.0)
    assert bytes(bundle.datagram) == written(pose, 1, 2.0, 3.0)


def test_without_a_coil_the_residual_is_minus_one_and_nothing_is_nan():
    pose = pose_of([0.0, 0.0], residual_mm=float("nan"), valid_coils=0, status=PoseStatus.LOST)
    messages = by_address(strict_bundle(written(pose)))
    assert messages["/tongue/quality"] == [-1.0, 0, 0.0]
    assert messages["/tongue/frame"][2] == 0
    assert not any(np.isnan(value) for values in messages.values() for value in values)


def test_the_sequence_number_begins_again_after_the_largest_int32():
    pose = pose_of([0.0])
    assert by_address(strict_bundle(written(pose, 2**31 - 1)))["/tongue/frame"][0] == 2**31 - 1
    assert by_address(strict_bundle(written(pose, 2**31)))["/tongue/frame"][0] == 0


def test_too_many_coefficients_for_a_datagram_are_refused_in_words():
    assert len(FrameBundle(126).datagram) <= MAX_DATAGRAM_BYTES
    with pytest.raises(InputError, match=r"127 coefficients need \d+ bytes"):
        FrameBundle(127)


# Info -----------------------------------------------------------------------------------------------


def info_of(size=4, speakers=5, name="a synthetic model", roles=("tongue_tip", "tongue_dorsum"), fixed=True):
    return StreamInfo(
        name, "0123456789abcdef", 3100, np.arange(size) * 0.5, np.full(size, 0.25),
        np.arange(speakers) * 0.125, fixed, roles, 250.0,
    )  # fmt: skip


def test_the_info_says_what_is_streamed():
    (datagram,) = info_datagrams(info_of())
    assert by_address(strict_bundle(datagram)) == {
        "/tongue/info": [
            "tonguetrack", 1, "a synthetic model", "0123456789abcdef", 3100, 4, "fixed", 250.0,
        ],
        "/tongue/coils": ["tongue_tip", "tongue_dorsum"],
        "/tongue/speaker": [0.0, 0.125, 0.25, 0.375, 0.5],
        "/tongue/mean": [0.0, 0.5, 1.0, 1.5],
        "/tongue/spread": [0.25] * 4,
    }  # fmt: skip


def test_sigma_is_pose_minus_mean_over_spread_for_a_receiver_too(small_model):
    weights = small_model.pose.mean + 0.3 * small_model.pose.sigma
    frame = by_address(strict_bundle(written(pose_of(weights, small_model.pose.normalised(weights)))))
    info = StreamInfo(
        "m", "f", 60, small_model.pose.mean, small_model.pose.sigma, small_model.speaker.mean, True, (), 250.0
    )
    about = by_address(strict_bundle(info_datagrams(info)[0]))
    rebuilt = (np.array(frame["/tongue/pose"]) - about["/tongue/mean"]) / about["/tongue/spread"]
    np.testing.assert_allclose(frame["/tongue/sigma"], rebuilt, atol=1e-5)


@pytest.mark.parametrize(("size", "speakers", "coils"), [(126, 5, 3), (4, 270, 3), (126, 270, 24)])
def test_much_info_is_spread_over_several_datagrams(size, speakers, coils):
    roles = tuple(f"a_role_with_a_long_name_{k}" for k in range(coils))
    datagrams = info_datagrams(info_of(size, speakers, roles=roles))
    assert all(len(datagram) <= MAX_DATAGRAM_BYTES for datagram in datagrams)
    messages = by_address([message for datagram in datagrams for message in strict_bundle(datagram)])
    assert len(messages["/tongue/speaker"]) == speakers
    assert len(messages["/tongue/mean"]) == len(messages["/tongue/spread"]) == size
    assert messages["/tongue/coils"] == list(roles)


def test_info_that_fits_no_datagram_is_refused_in_words():
    with pytest.raises(InputError, match="/tongue/speaker needs"):
        info_datagrams(info_of(speakers=400))


@pytest.mark.parametrize("name", ["Zunge für alle", "long " * 200, "zero\0inside", ""])
def test_any_model_name_becomes_a_short_ascii_string(name):
    (datagram,) = info_datagrams(info_of(name=name))
    assert len(by_address(strict_bundle(datagram))["/tongue/info"][2]) <= 120


def test_an_estimator_without_a_speaker_sends_none():
    (datagram,) = info_datagrams(info_of(speakers=0, roles=()))
    messages = by_address(strict_bundle(datagram))
    assert messages["/tongue/speaker"] == messages["/tongue/coils"] == []


# The state of a live run ----------------------------------------------------------------------------


def test_the_numbers_of_a_run_are_latencies_and_the_take():
    numbers = LiveNumbers((0.5, 2.0), (0.125, 0.25), (0.0625, 1.0), "takes/one.xdf", 4711, "the disk is full")
    assert by_address(strict_bundle(numbers_datagram(numbers))) == {
        "/tongue/latency": [0.5, 2.0, 0.125, 0.25, 0.0625, 1.0],
        "/tongue/take": ["takes/one.xdf", 4711, "the disk is full"],
    }


def test_what_is_unknown_is_minus_one_and_no_take_is_an_empty_text():
    assert by_address(strict_bundle(numbers_datagram(LiveNumbers()))) == {
        "/tongue/latency": [-1.0] * 6,
        "/tongue/take": ["", 0, ""],
    }


def test_a_long_path_keeps_its_end_and_a_long_failure_its_beginning():
    numbers = LiveNumbers(take_path="/much/" * 99 + "take.xdf", take_failure="no space " * 99)
    datagram = numbers_datagram(numbers)
    path, _, failure = by_address(strict_bundle(datagram))["/tongue/take"]
    assert len(datagram) <= MAX_DATAGRAM_BYTES
    assert path.startswith("...") and path.endswith("/take.xdf") and len(path) == 120
    assert failure.startswith("no space") and failure.endswith("...") and len(failure) == 120


def test_frames_beyond_an_int32_stay_at_the_largest():
    datagram = numbers_datagram(LiveNumbers(take_frames=2**40))
    assert by_address(strict_bundle(datagram))["/tongue/take"][1] == 2**31 - 1


def test_coil_states_are_written_in_place_and_only_when_they_changed():
    datagram = CoilStatesDatagram(3)
    assert datagram.write(np.array([0, 0, 0]))
    assert not datagram.write(np.array([0, 0, 0]))
    assert datagram.write(np.array([0, CoilState.WILD, CoilState.RETURNING]))
    assert strict_bundle(datagram.datagram) == [("/tongue/coilstates", ",iii", [0, 2, 5])]


def test_no_coils_have_no_states():
    assert strict_bundle(CoilStatesDatagram(0).datagram) == [("/tongue/coilstates", ",", [])]


def test_more_coils_than_a_datagram_bears_are_refused_in_words():
    with pytest.raises(InputError, match="states of 400 coils need"):
        CoilStatesDatagram(400)


# The table ------------------------------------------------------------------------------------------


def test_everything_that_is_sent_is_in_the_table_with_its_types_and_the_table_has_nothing_else():
    messages = strict_bundle(written(pose_of([0.0] * 12))) + strict_bundle(info_datagrams(info_of())[0])
    messages += strict_bundle(CoilStatesDatagram(2).datagram) + strict_bundle(numbers_datagram(LiveNumbers()))
    used = set()
    for address, tags, values in messages:
        row = find_address(address)
        assert row is not None, address
        assert row.fits(values)
        letters = "".join(argument.tag for argument in row.arguments)
        repeats = bool(row.arguments[-1].count)
        assert tags == "," + (
            letters[:-1] + letters[-1] * (len(values) - len(letters) + 1) if repeats else letters
        )
        used.add(row.path)
    assert used == {row.path for row in ADDRESSES}


def test_the_documentation_is_the_one_that_the_code_makes():
    page = Path(__file__).resolve().parents[1] / "docs" / "osc.md"
    assert page.read_text() == protocol_page(), "run: tonguetrack monitor --addresses > docs/osc.md"


def test_the_documentation_names_every_status():
    for status in PoseStatus:
        assert f"| {int(status)} | {status.name.lower()}" in protocol_page()
    for state in CoilState:
        assert f"| {int(state)} | {state.name.lower()}" in protocol_page()


def test_the_documentation_has_every_form_of_control_and_how_to_open_it_safely():
    page = protocol_page()
    for form in CONTROL_FORMS:
        assert f"| `{form.path}` | `{form.type_tags}` |" in page
    assert "127.0.0.1:9001" in page
    assert "lets anyone there start and\nstop takes" in page


def test_what_a_stream_sends_and_what_a_session_obeys_are_different_addresses():
    assert not any(find_address(form.path) for form in CONTROL_FORMS)


# Destinations ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:9000", ("127.0.0.1", 9000)),
        ("studio-pc:57120", ("studio-pc", 57120)),
        ("[::1]:9000", ("::1", 9000)),
        ("[fe80::1%eth0]:1", ("fe80::1%eth0", 1)),
    ],
)
def test_destinations_are_host_and_port(text, expected):
    assert parse_destination(text) == expected


@pytest.mark.parametrize(
    "text",
    ["", "9000", "localhost", ":9000", "localhost:", "localhost:0", "localhost:65536", "localhost:nine",
     "::1:9000", "[::1]", "osc://localhost:9000", "a b:9000", "localhost:-1", "localhost:٣"],
)  # fmt: skip
def test_what_is_no_destination_is_refused_by_its_name(text):
    with pytest.raises(InputError) as refusal:
        parse_destination(text)
    assert f"'{text}'" in str(refusal.value)
