"""What `send=` adds to our OSC, held against docs/osc.md by a strict receiver."""

import numpy as np
import pytest
from streaming import PALATE, ROLES, context, info, model, nobody, pose, random_poses, receiver, waiting
from strict_more import MOST_BYTES, Receiver
from strict_osc import Refused

from tonguetrack import InputError
from tonguetrack.tracker.streams.addresses import EXTRA_ADDRESSES, find_address
from tonguetrack.tracker.streams.contact import ContactMeter
from tonguetrack.tracker.streams.monitor import decode
from tonguetrack.tracker.streams.osc_more import (
    FINEST_STEP_MM,
    WORDS,
    MoreDatagrams,
    OscMoreWorker,
    mesh_datagrams,
)
from tonguetrack.tracker.streams.shapes import ShapeMeter
from tonguetrack.tracker.streams.slot import SlotSink


def received(send, *poses, palate=PALATE, roles=ROLES, **more):
    datagrams = MoreDatagrams(context(palate, **more), send)
    datagrams.begin(info(roles))
    found = Receiver(model().vertex_count)
    for each in poses:
        for datagram in datagrams.of(each):
            found.receive(datagram)
    return found


def single(values):
    """As they are in 32-bit floats."""
    return np.float32(values).tolist()


# What is asked for, and nothing else ----------------------------------------------------------------


@pytest.mark.parametrize("word", WORDS)
def test_a_word_sends_its_addresses_alone(word):
    datagrams = MoreDatagrams(context(), [word])
    datagrams.begin(info())
    addresses = {address for datagram in datagrams.of(pose()) for address, _ in decode(datagram)}
    rows = {find_address(address).path for address in addresses} - {"/tongue/extra"}
    assert rows == {row.path for row in EXTRA_ADDRESSES if f"send={word}`" in row.when}


def test_the_words_together_send_the_whole_table():
    datagrams = MoreDatagrams(context(), WORDS)
    datagrams.begin(info())
    messages = [message for datagram in datagrams.of(pose()) for message in decode(datagram)]
    assert {find_address(address).path for address, _ in messages} == {row.path for row in EXTRA_ADDRESSES}
    assert all(find_address(address).fits(values) for address, values in messages)


@pytest.mark.parametrize("words", [WORDS, ("coils",), ("shapes", "contact")])
def test_whatever_is_sent_a_strict_receiver_takes_it(words):
    found = received(words, *random_poses(30))
    assert found.newest == 29 and len(found.poses) == 30


def test_an_unknown_word_is_refused_with_those_that_are_known():
    with pytest.raises(InputError, match="send=colis.*coils, shapes, unit, contact, mesh"):
        MoreDatagrams(context(), ["colis"])


# Which pose -----------------------------------------------------------------------------------------


def test_every_bundle_says_which_pose_it_is_of():
    found = received(WORDS, pose(1000), pose(1001))
    assert found.poses == {0: (1000, 0.0), 1: (1001, single(0.004))}


def test_frame_numbers_beyond_31_bits_begin_again_at_0():
    assert received(["coils"], pose(2**31 + 5, device_time_s=1.0)).poses == {0: (5, 0.0)}


# Coils ----------------------------------------------------------------------------------------------


def test_coils_are_in_millimetres_by_their_roles_and_the_missing_one_is_left_out():
    found = received(["coils"], pose())
    assert found.coils == {"tongue_tip": [0.0, 1.5, 3.25], "tongue_blade": [0.0, 12.0, 8.0]}


def test_what_osc_reserves_becomes_an_underscore():
    coils = np.arange(6.0).reshape(2, 3)
    found = received(["coils"], pose(coils=coils), roles=("tongue dorsum", "a/b#c*?[舌]{}"))
    assert set(found.coils) == {"tongue_dorsum", "a_b_c_____" + "__"}


def test_where_no_coil_is_there_nothing_is_sent():
    assert received(["coils"], pose(coils=np.full((3, 3), np.nan))).newest is None


# Shapes and re-based weights ------------------------------------------------------------------------


def test_shapes_are_those_of_the_meter_with_the_speakers_ranges():
    ranges = {"tip_up": (0.0, 3.0)}
    each = pose()
    meter = ShapeMeter(model(), ranges)
    expected = dict(zip(meter.names, meter.measure(each.speaker_weights, each.weights), strict=True))
    found = received(["shapes"], each, ranges=ranges).shapes
    assert {name: value for name, (value,) in found.items()} == {k: single(v) for k, v in expected.items()}


def test_re_based_weights_and_their_range_give_the_raw_weights_back():
    for each in random_poses(10):
        found = received(["unit"], each)
        low, high, unit = np.array(found.low), np.array(found.high), np.array(found.unit)
        np.testing.assert_allclose(low + unit * (high - low), each.weights, atol=1e-6)


def test_zero_and_one_are_three_sigma_from_the_mean_unless_the_session_knows_better():
    three = pose(sigmas=(-3.0, 3.0, 0.0, 6.0))
    np.testing.assert_allclose(received(["unit"], three).unit, [0.0, 1.0, 0.5, 1.5], atol=1e-6)
    own = {"pose_1": (-0.5, 0.25)}
    assert received(["unit"], three, ranges=own).low[1] == -0.5
    assert received(["unit"], three, ranges=own).high[1] == 0.25


def test_the_range_is_told_at_the_start_and_not_with_every_pose():
    datagrams = MoreDatagrams(context(), ["unit"])
    datagrams.begin(info())
    told = [
        any(address == "/tongue/low" for datagram in datagrams.of(pose(k)) for address, _ in decode(datagram))
        for k in range(3)
    ]
    assert told == [True, False, False]
    datagrams.begin(info())
    assert any(b"/tongue/low" in datagram for datagram in datagrams.of(pose(3)))


# Contact --------------------------------------------------------------------------------------------


def test_contact_is_that_of_the_meter():
    meter = ContactMeter(model(), PALATE)
    for each in random_poses(20):
        expected = meter.measure(each.speaker_weights, each.weights)
        found = received(["contact"], each)
        if np.isnan(expected.gap_mm):
            assert found.contact is None
        else:
            assert found.contact == single([expected.gap_mm, *expected.point])
        whole = {
            name: [single(gap)]
            for name, gap in zip(meter.regions, expected.regions, strict=True)
            if np.isfinite(gap)
        }
        assert found.gaps == whole


def test_without_a_palate_contact_is_refused():
    with pytest.raises(InputError, match="no palate.*docs/session.md"):
        MoreDatagrams(context(None), ["contact"])


# The mesh -------------------------------------------------------------------------------------------


def test_the_mesh_arrives_whole_and_to_a_thousandth_of_a_millimetre():
    each = pose()
    found = received(["mesh"], each)
    expected = model().vertices(each.speaker_weights, each.weights)
    assert np.abs(found.vertices - expected).max() <= FINEST_STEP_MM / 2 + 1e-6
    ((_, chunks),) = {(0, count) for _, count in found.chunks}
    assert {chunk for chunk, _ in found.chunks} == set(range(chunks))


def test_the_mesh_follows_the_speaker():
    other = pose(speaker_weights=model().speaker.mean + 0.5 * model().speaker.sigma)
    found = received(["mesh"], pose(0), other)
    expected = model().vertices(other.speaker_weights, other.weights)
    assert np.abs(found.vertices - expected).max() < 0.002


def test_of_a_pose_whose_weights_are_no_numbers_only_the_coils_are_sent():
    datagrams = MoreDatagrams(context(), WORDS)
    datagrams.begin(info())
    list(datagrams.of(pose()))  # the ranges come with the first one
    messages = [message for datagram in datagrams.of(pose(1, (np.nan,) * 4)) for message in decode(datagram)]
    assert {find_address(address).path for address, _ in messages} == {"/tongue/extra", "/tongue/coil/<name>"}


def test_without_one_of_its_chunks_the_rest_of_the_mesh_is_right():
    each = pose()
    datagrams = MoreDatagrams(context(), ["mesh"])
    datagrams.begin(info())
    found = Receiver(model().vertex_count)
    for k, datagram in enumerate(datagrams.of(each)):
        if k != 3:
            found.receive(datagram)
    missing = np.isnan(found.vertices).any(axis=1)
    assert 0 < missing.sum() <= 216
    expected = model().vertices(each.speaker_weights, each.weights)
    assert np.abs((found.vertices - expected)[~missing]).max() < 0.002


@pytest.mark.parametrize("reach_mm", [1.0, 81.9, 82.0, 500.0, 1e5])
def test_a_mesh_far_from_the_origin_has_a_coarser_step_and_never_overflows(reach_mm):
    vertices = np.random.default_rng(3).uniform(-reach_mm, reach_mm, (500, 3))
    vertices[0] = reach_mm, -reach_mm, 0.0
    found = Receiver(len(vertices))
    for datagram in mesh_datagrams(vertices, 7):
        assert len(datagram) <= MOST_BYTES
        found.receive(datagram)
    step = max(FINEST_STEP_MM, reach_mm / 32767)
    assert np.abs(found.vertices - vertices).max() <= 0.51 * step * (1 + 1e-4)


@pytest.mark.parametrize("vertices", [1, 215, 216, 217, 432, 433])
def test_every_vertex_is_in_a_chunk_whatever_their_number(vertices):
    places = np.random.default_rng(vertices).normal(size=(vertices, 3))
    found = Receiver(vertices)
    for datagram in mesh_datagrams(places, 0):
        found.receive(datagram)
    assert np.isfinite(found.vertices).all()


def test_the_strict_receiver_refuses_a_blob_that_is_too_long_or_is_none():
    (good,) = mesh_datagrams(np.zeros((2, 3)), 0)
    Receiver(2).receive(good)
    for wrong in (good[:-4], good.replace(b",iiiifb", b",iiiffb"), good + bytes(4)):
        with pytest.raises(Refused):
            Receiver(2).receive(wrong)
    with pytest.raises(Refused, match="beyond the last"):
        Receiver(1).receive(good)


# Sent -----------------------------------------------------------------------------------------------


def test_it_comes_over_udp_from_a_port_of_its_own():
    with receiver() as (opened, place):
        worker = OscMoreWorker(place, context(), WORDS)
        worker.begin(info())
        worker.work(pose())
        found = Receiver(model().vertex_count)
        for datagram in waiting(opened):
            found.receive(datagram)
        worker.end()
    assert np.isfinite(found.vertices).all() and found.shapes and found.coils and found.unit and found.contact
    assert worker.destination == f"osc {place} (coils, shapes, unit, contact, mesh)"


def test_behind_a_slot_an_absent_receiver_changes_nothing():
    sink = SlotSink(OscMoreWorker(nobody(), context(), WORDS), 100.0)
    sink.start(info())
    for number in range(20):
        sink.send(pose(number))
    sink.close()
    assert sink.sent >= 1 and sink.failure == ""
