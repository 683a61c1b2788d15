"""VRChat: what an avatar with VRCFaceTracking's parameters makes of the datagrams."""

import numpy as np
import pytest
from streaming import context, info, model, pose, random_poses, receiver, waiting
from strict_osc import Refused
from strict_vrchat import MOST_BYTES, SIGNED, TONGUE, Avatar

from tonguetrack import InputError
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.streams.avatar import avatar_values
from tonguetrack.tracker.streams.presets import load_preset
from tonguetrack.tracker.streams.vrchat import DEFAULT_DESTINATION, VrchatWorker, parameter_prefixes

TONGUE_X_BUNDLE = bytes.fromhex(
    "23 62 75 6e 64 6c 65 00  00 00 00 00 00 00 00 01"
    "00 00 00 2c  2f 61 76 61 74 61 72 2f 70 61 72 61 6d 65 74 65 72 73 2f"  # /avatar/parameters/
    "4c 69 70 54 72 61 63 6b 69 6e 67 41 63 74 69 76 65 00 00 00 00  2c 54 00 00"  # LipTrackingActive ,T
    "00 00 00 30  2f 61 76 61 74 61 72 2f 70 61 72 61 6d 65 74 65 72 73 2f"
    "45 78 70 72 65 73 73 69 6f 6e 54 72 61 63 6b 69 6e 67 41 63 74 69 76 65 00  2c 54 00 00"
    "00 00 00 28  2f 61 76 61 74 61 72 2f 70 61 72 61 6d 65 74 65 72 73 2f"
    "76 32 2f 54 6f 6e 67 75 65 58 00 00 00  2c 66 00 00  bf 00 00 00"  # v2/TongueX -0.5
)


class One:
    preset = "one"
    names = ("TongueX",)

    def values(self, pose):
        return np.array([-0.5])


def sent(worker, opened, each):
    worker.begin(info())
    worker.work(each)
    return waiting(opened)


def test_a_parameter_byte_for_byte():
    with receiver() as (opened, place):
        assert sent(VrchatWorker(place, One(), ("v2/",)), opened, pose()) == [TONGUE_X_BUNDLE]


def test_every_unified_parameter_arrives_under_both_prefixes_and_within_its_range():
    values = avatar_values("unified", context(), signed=True)
    assert set(values.names) == set(TONGUE)
    with receiver() as (opened, place):
        worker = VrchatWorker(place, values, parameter_prefixes("unified"))
        for each in random_poses(20):
            avatar = Avatar()
            datagrams = sent(worker, opened, each)
            for datagram in datagrams:
                assert len(datagram) <= min(MOST_BYTES, 1400)
                avatar.receive(datagram)
            assert set(avatar.floats) == avatar.names
            for name, value in zip(values.names, values.values(each), strict=True):
                assert avatar.floats[f"v2/{name}"] == avatar.floats[f"FT/v2/{name}"] == np.float32(value)


def test_an_axis_is_the_difference_of_its_ends():
    values = avatar_values("unified", context(), signed=True)
    for each in random_poses(50):
        found = dict(zip(values.names, values.values(each), strict=True))
        assert found["TongueX"] == pytest.approx(found["TongueRight"] - found["TongueLeft"])
        assert found["TongueY"] == pytest.approx(found["TongueUp"] - found["TongueDown"])
        assert found["TongueArchY"] == pytest.approx(found["TongueCurlUp"] - found["TongueBendDown"])
        assert found["TongueShape"] == pytest.approx(found["TongueFlat"] - found["TongueSquish"])
    assert {target.name for target in load_preset("unified").targets if target.low < 0} == set(SIGNED)


@pytest.mark.parametrize("status", list(PoseStatus))
def test_tracking_is_active_unless_nothing_is_tracked(status):
    avatar = Avatar(["v2/TongueX"])
    with receiver() as (opened, place):
        for datagram in sent(VrchatWorker(place, One(), ("v2/",)), opened, pose(status=status)):
            avatar.receive(datagram)
    active = status != PoseStatus.LOST
    assert avatar.states == {"LipTrackingActive": active, "ExpressionTrackingActive": active}


def test_weights_that_are_no_numbers_leave_the_avatar_to_itself():
    values = avatar_values("unified", context(), signed=True)
    avatar = Avatar()
    with receiver() as (opened, place):
        worker = VrchatWorker(place, values, parameter_prefixes("unified"))
        for datagram in sent(worker, opened, pose()):
            avatar.receive(datagram)
        before = dict(avatar.floats)
        for datagram in sent(worker, opened, pose(1, sigmas=(np.nan, 0.0, 0.0, 0.0))):
            avatar.receive(datagram)
    assert avatar.floats == before and all(map(np.isfinite, before.values()))
    assert avatar.states == {"LipTrackingActive": False, "ExpressionTrackingActive": False}


def test_other_presets_stand_under_their_own_names():
    assert parameter_prefixes("own") == ("",)
    values = avatar_values("own", context(), signed=True)
    avatar = Avatar(values.names)
    with receiver() as (opened, place):
        for datagram in sent(VrchatWorker(place, values, parameter_prefixes("own")), opened, pose()):
            avatar.receive(datagram)
    assert f"pose_{model().pose.size - 1}" in avatar.floats


@pytest.mark.parametrize("name", ["Tongue Out", "Tongue#1", "舌", "a,b", "{a}", "what?"])
def test_a_name_that_cannot_stand_in_an_address_is_refused(name):
    values = One()
    values.names = (name,)
    with pytest.raises(InputError, match=r"preset one: the name .* cannot stand in an OSC address"):
        VrchatWorker(DEFAULT_DESTINATION, values, ("",))


def test_the_strict_avatar_refuses_what_vrchat_would_not_take():
    for wrong in (
        TONGUE_X_BUNDLE.replace(b",f\0\0", b",s\0\0"),
        TONGUE_X_BUNDLE.replace(b"TongueX", b"Tonguex"),
        TONGUE_X_BUNDLE.replace(b",T\0\0", b",i\0\0", 1),
        TONGUE_X_BUNDLE.replace(bytes.fromhex("bf000000"), bytes.fromhex("c0000000")),
    ):
        with pytest.raises(Refused):
            Avatar().receive(wrong)
