"""What the page and its server say to each other: golden bytes, and a decoder written from the description alone."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strict_page import decoded

from tonguetrack import InputError
from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams.feed import FeedNumbers
from tonguetrack.tracker.streams.page import protocol
from tonguetrack.tracker.streams.page.protocol import NotUnderstood, Seen, from_page
from tonguetrack.tracker.streams.page.visitors import Door, door_at, reachable_address, same_origin
from tonguetrack.tracker.streams.sink import LiveNumbers


def pose(k: int = 4, n: int = 3) -> TrackedPose:
    return TrackedPose(
        np.arange(k) * 0.25,
        np.zeros(k),
        np.zeros(2),
        np.arange(n) + 0.5,
        residual_mm=1.5,
        status=PoseStatus.HELD,
        device_time_s=2.5,
        arrival_ns=1_000_000_000,
        solved_ns=1_000_500_000,
        speaker_fixed=True,
        coil_states=np.arange(n),
        coils=np.arange(3.0 * n).reshape(n, 3),
    )


# Poses ----------------------------------------------------------------------------------------------


def test_a_pose_message_is_these_bytes():
    small = pose(k=1, n=1)
    message = protocol.pose_message(small, 7, 8, 9, 1_004_000_000)
    assert message.hex() == (
        "54545047" "01020100" "01000100" "07000000" "08000000" "09000000" "00000000" "00000000"
        "0000000000000440" "365eba490c02f03f" "0000003f" "00008040" "0000c03f" "00000000"
        "00000000" "00000000" "0000803f" "00000040" "0000003f" "00000000"
    )  # fmt: skip


def test_a_pose_message_says_everything_of_a_pose():
    said = decoded(protocol.pose_message(pose(), 70_000, 80_000, 3, 1_004_000_000))
    assert (said["status"], said["fixed"], said["number"], said["sequence"], said["model"]) == (
        2,
        True,
        70_000,
        80_000,
        3,
    )
    assert said["time_s"] == 2.5 and said["solved_s"] == pytest.approx(1.0005)
    assert said["solve_ms"] == pytest.approx(0.5) and said["age_ms"] == pytest.approx(4.0)
    np.testing.assert_array_equal(said["weights"], [0, 0.25, 0.5, 0.75])
    np.testing.assert_array_equal(said["coils"], np.arange(9.0).reshape(3, 3))
    np.testing.assert_array_equal(said["residuals"], [0.5, 1.5, 2.5])
    assert said["states"] == (0, 1, 2) and said["residual_mm"] == 1.5 and said["vertices"] is None


def test_a_missing_coil_is_nan_in_the_message_and_nothing_else_is():
    missing = pose()
    missing.coils[1], missing.residuals_mm[1] = np.nan, np.nan
    said = decoded(protocol.pose_message(missing, 1, 1, 1, 0))
    assert np.isnan(said["coils"]).sum() == 3 and np.isnan(said["residuals"]).sum() == 1


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 40), st.integers(0, 12), st.integers(0, 60), st.floats(0.1, 500))
def test_messages_of_any_size_are_read_back(k, n, vertices, reach):
    mesh = np.random.default_rng(vertices).uniform(-reach, reach, (vertices, 3)) if vertices else None
    said = decoded(protocol.pose_message(pose(k, n), 1, 2, 3, 0, mesh))
    assert len(said["weights"]) == k and len(said["coils"]) == n
    if vertices:
        assert np.abs(said["vertices"] - mesh).max() <= max(reach, 1.0) / 32767


def test_vertices_within_80_mm_are_exact_to_a_few_micrometres():
    mesh = np.random.default_rng(1).uniform(-80, 80, (3000, 3))
    assert np.abs(decoded(protocol.pose_message(pose(), 1, 1, 1, 0, mesh))["vertices"] - mesh).max() < 0.0013


def test_numbers_begin_again_instead_of_failing():
    assert decoded(protocol.pose_message(pose(), 2**32 + 5, 2**33 + 6, 1, 0))["number"] == 5


# Texts ----------------------------------------------------------------------------------------------


def test_the_state_names_the_take_by_its_file_alone_and_has_no_nan():
    numbers = FeedNumbers(
        LiveNumbers((0.5, float("nan")), (0.1, 0.2), (None, None), "/somewhere/private/take-003.xdf", 12, ""),
        ("a coil is missing",),
        "fine",
    )
    said = json.loads(protocol.state_text(numbers, 2, 3, 1.23456))
    assert said["type"] == "state" and said["take"] == {"name": "take-003.xdf", "frames": 12, "failure": ""}
    assert said["latency"]["device_to_host"] == [0.5, None] and said["latency"]["solved_to_sent"] == [
        None,
        None,
    ]
    assert said["troubles"] == ["a coil is missing"] and said["round_trip_ms"] == 1.2346


# Wishes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("said", "datagram"),
    [
        ({"do": "take", "on": True}, b"/tongue/control/take\0\0\0\0,s\0\0start\0\0\0"),
        ({"do": "take", "on": True, "name": ""}, b"/tongue/control/take\0\0\0\0,s\0\0start\0\0\0"),
        (
            {"do": "take", "on": True, "name": "aka 3"},
            b"/tongue/control/take\0\0\0\0,ss\0start\0\0\0aka 3\0\0\0",
        ),
        ({"do": "take", "on": False}, b"/tongue/control/take\0\0\0\0,s\0\0stop\0\0\0\0"),
        ({"do": "mark", "text": "here"}, b"/tongue/control/marker\0\0,s\0\0here\0\0\0\0"),
        ({"do": "speaker", "fix": True}, b"/tongue/control/speaker\0,s\0\0fix\0"),
        ({"do": "speaker", "fix": False}, b"/tongue/control/speaker\0,s\0\0free\0\0\0\0"),
    ],
)
def test_a_wish_becomes_the_control_message_of_the_osc_page(said, datagram):
    assert from_page(json.dumps(said)).datagram == datagram


def test_a_page_says_which_pose_it_has_seen():
    assert from_page('{"seen": 17}') == Seen(17)


@pytest.mark.parametrize(
    "text",
    [
        "", "null", "[]", "17", '"take"', "{", "{}", "[" * 900, '{"seen": -1}', '{"seen": true}', '{"seen": 1.0}',
        '{"seen": 4294967296}', '{"seen": 1, "do": "mark", "text": "x"}', '{"do": "quit"}', '{"do": "take"}',
        '{"do": "take", "on": 1}', '{"do": "take", "on": "start"}', '{"do": "take", "on": true, "path": "/x"}',
        '{"do": "take", "on": true, "name": "../../x"}', '{"do": "take", "on": true, "name": 3}',
        '{"do": "take", "on": true, "name": ".hidden"}', '{"do": "mark", "text": ""}', '{"do": "mark"}',
        '{"do": "mark", "text": "two\\nlines"}', '{"do": "mark", "text": "' + "x" * 201 + '"}',
        '{"do": "mark", "text": "\\ud800"}', '{"do": "speaker", "fix": "yes"}', '{"do": "mark", "text": 1e999}',
        '{"seen": ' + "9" * 500 + "}", '{"do": "mark", "text": "x"}' + " " * 1024,
    ],
)  # fmt: skip
def test_whatever_else_a_page_says_is_not_understood(text):
    with pytest.raises(NotUnderstood):
        from_page(text)


@settings(deadline=None, max_examples=300)
@given(st.one_of(st.text(max_size=300), st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=9) | st.floats(),
    lambda part: st.lists(part, max_size=3)
    | st.dictionaries(st.sampled_from(["do", "seen", "on", "fix", "text", "name"]), part, max_size=4),
).map(json.dumps)))  # fmt: skip
def test_no_text_does_more_than_be_refused(text):
    try:
        understood = from_page(text)
    except NotUnderstood:
        return
    assert isinstance(understood, Seen) or len(understood.datagram) < 1400


# Visitors -------------------------------------------------------------------------------------------


def test_a_page_for_this_computer_alone_needs_no_token():
    for address in ("127.0.0.1:8080", "localhost:0", "[::1]:8080", "127.3.2.1:5"):
        door = door_at(address)
        assert door.token == "" and door.resource("/page.js?x=1") == "page.js" and door.resource("/") == ""


def test_a_page_for_a_network_has_a_token_that_is_another_one_each_time():
    first, second = door_at("0.0.0.0:8080"), door_at("0.0.0.0:8080")
    assert len(first.token) >= 20 and first.token != second.token
    assert first.resource(f"/{first.token}/page.js") == "page.js"
    for path in ("/", "/page.js", f"/{second.token}/page.js", f"/{first.token}", f"/{first.token[:-1]}/", "", "/ü/",
                 f"//{first.token}/page.js", f"http://x/{first.token}/"):  # fmt: skip
        assert first.resource(path) is None
    assert first.url(8080).endswith(f":8080/{first.token}/") and "0.0.0.0" not in first.url(8080)


def test_a_name_that_leads_here_without_being_ours_is_not_answered():
    door = Door("127.0.0.1", "127.0.0.1", 8080, "")
    for host in ("127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080"):
        assert door.knows_host(host)
    for host in (
        "evil.example:8080",
        "127.0.0.1.evil.example",
        "",
        "localhost.evil.example",
        "192.168.0.7",
        "[x",
    ):
        assert not door.knows_host(host)


def test_only_a_page_that_was_loaded_from_here_may_open_the_socket():
    assert same_origin(None, "127.0.0.1:1") and same_origin("http://127.0.0.1:1", "127.0.0.1:1")
    for origin in ("http://127.0.0.1:2", "http://evil.example", "null", "", "file://", "http://127.0.0.1:1/"):
        assert not same_origin(origin, "127.0.0.1:1")


@pytest.mark.parametrize(
    "address", ["8080", "127.0.0.1", "127.0.0.1:99999", "nowhere.invalid:80", "::1:80", ":80"]
)
def test_what_is_no_address_is_said_in_one_sentence(address):
    with pytest.raises(InputError):
        door_at(address)


def test_the_address_that_is_told_is_one_that_others_can_use():
    assert reachable_address("192.0.2.7") == "192.0.2.7"
    assert reachable_address("0.0.0.0") not in ("0.0.0.0", "")
