"""VMC: what a strict Performer makes of the datagrams."""

import numpy as np
import pytest
from streaming import context, info, model, nobody, pose, random_poses, receiver, waiting
from strict_osc import Refused
from strict_vmc import MOST_BYTES, Performer

from tonguetrack import InputError
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.streams.avatar import AvatarValues, avatar_values
from tonguetrack.tracker.streams.presets import Preset, Target, load_preset, preset_names
from tonguetrack.tracker.streams.shapes import ShapeMeter
from tonguetrack.tracker.streams.slot import SlotSink
from tonguetrack.tracker.streams.vmc import DEFAULT_DESTINATION, VmcWorker

ARKIT_BUNDLE = bytes.fromhex(
    "23 62 75 6e 64 6c 65 00  00 00 00 00 00 00 00 01"  # "#bundle", immediately
    "00 00 00 24  2f 56 4d 43 2f 45 78 74 2f 4f 4b 00"  # 36 bytes: /VMC/Ext/OK
    "2c 69 69 69 69 00 00 00"  # ,iiii
    "00 00 00 01  00 00 00 03  00 00 00 00  00 00 00 01"  # loaded, calibrated, normal, tracking
    "00 00 00 14  2f 56 4d 43 2f 45 78 74 2f 54 00 00"  # 20 bytes: /VMC/Ext/T
    "2c 66 00 00  3e 80 00 00"  # ,f 0.25
    "00 00 00 28  2f 56 4d 43 2f 45 78 74 2f 42 6c 65 6e 64 2f 56 61 6c 00 00"  # 40: /VMC/Ext/Blend/Val
    "2c 73 66 00  74 6f 6e 67 75 65 4f 75 74 00 00 00  3f 00 00 00"  # ,sf tongueOut 0.5
    "00 00 00 1c  2f 56 4d 43 2f 45 78 74 2f 42 6c 65 6e 64 2f 41 70 70 6c 79 00 00 00 00"  # 28: .../Apply
    "2c 00 00 00"
)


class Fixed:
    """Values that do not depend on the pose."""

    preset = "fixed"

    def __init__(self, **values):
        self.names = tuple(values)
        self.numbers = np.array(list(values.values()))

    def values(self, pose):
        return self.numbers


def sent(worker, opened, *poses):
    worker.begin(info())
    for each in poses:
        worker.work(each)
    return waiting(opened)


def test_a_pose_is_one_bundle_byte_for_byte():
    with receiver() as (opened, place):
        first, second = sent(
            VmcWorker(place, Fixed(tongueOut=0.5)), opened, pose(0), pose(63, device_time_s=100.25)
        )
    assert second == ARKIT_BUNDLE
    assert first == ARKIT_BUNDLE.replace(bytes.fromhex("3e800000"), bytes(4))


@pytest.mark.parametrize("preset", preset_names())
def test_every_preset_shows_on_a_strict_avatar(preset):
    values = avatar_values(preset, context(), signed=False)
    poses = random_poses(20)
    performer = Performer(values.names)
    with receiver() as (opened, place):
        worker = VmcWorker(place, values)
        for each in poses:
            for datagram in sent(worker, opened, each):
                assert len(datagram) <= MOST_BYTES
                performer.receive(datagram)
            meter = ShapeMeter(model())
            mixer = load_preset(preset).mixer(meter.names)
            expected = dict(
                zip(mixer.names, mixer(meter.measure(each.speaker_weights, each.weights)), strict=True)
            )
            assert performer.shown == {name: np.float32(expected[name]) for name in values.names}
    assert performer.applied == len(poses)
    assert (performer.loaded, performer.calibration, performer.tracking) == (1, 3, 1)
    assert performer.time_s == pytest.approx(19 / 250)


def test_weights_that_are_no_numbers_leave_the_avatar_as_it_was_and_say_that_tracking_is_bad():
    values = avatar_values("unified", context(), signed=False)
    performer = Performer(values.names)
    with receiver() as (opened, place):
        worker = VmcWorker(place, values)
        for each in (pose(), pose(1, sigmas=(np.nan,) * 4), pose(2, speaker_weights=np.full(5, np.inf))):
            for datagram in sent(worker, opened, each):
                performer.receive(datagram)
            if each.frame_number == 0:
                before = dict(performer.shown)
                assert performer.tracking == 1
            else:
                assert performer.shown == before and performer.tracking == 0
    assert all(np.isfinite(value) for value in before.values()) and max(before.values()) > 0


def test_many_names_go_in_several_bundles_and_only_the_last_applies():
    names = {f"CTRL_expressions_tongue_{k}": k / 100 for k in range(100)}
    performer = Performer(names)
    with receiver() as (opened, place):
        datagrams = sent(VmcWorker(place, Fixed(**names)), opened, pose())
    assert len(datagrams) > 1
    for datagram in datagrams[:-1]:
        performer.receive(datagram)
    assert performer.applied == 0 and not performer.shown
    performer.receive(datagrams[-1])
    assert performer.applied == 1
    assert performer.shown == {name: np.float32(value) for name, value in names.items()}


def test_axes_with_two_ends_are_left_out_for_blend_shapes_are_0_to_1():
    assert "TongueX" in avatar_values("unified", context(), signed=True).names
    assert "TongueX" not in avatar_values("unified", context(), signed=False).names
    assert "TongueLeft" in avatar_values("unified", context(), signed=False).names


def test_a_preset_of_axes_alone_is_no_use_and_says_so():
    only = Preset("axes", "", "", (Target("X", (("tip_up", 1.0),), -1.0),))
    with pytest.raises(InputError, match="axes: all its targets are signed"):
        AvatarValues(only, ShapeMeter(model()), signed=False)


def test_the_speakers_ranges_count():
    narrow = {"tip_up": (0.0, 0.5)}
    up = pose(sigmas=(3.0, 3.0, 3.0, 3.0))
    usual = avatar_values("own", context(), signed=False)
    scaled = avatar_values("own", context(ranges=narrow), signed=False)
    at = usual.names.index("tip_up")
    meter = ShapeMeter(model(), narrow)
    assert scaled.values(up)[at] == meter.measure(up.speaker_weights, up.weights)[at]
    assert ShapeMeter(model()).ranges["tip_up"] != meter.ranges["tip_up"]


@pytest.mark.parametrize(
    ("status", "tracking"),
    [(PoseStatus.OK, 1), (PoseStatus.HELD, 0), (PoseStatus.RELAXING, 0), (PoseStatus.LOST, 0)],
)
def test_only_a_pose_that_was_tracked_is_called_tracked(status, tracking):
    performer = Performer(["a"])
    with receiver() as (opened, place):
        for datagram in sent(VmcWorker(place, Fixed(a=1.0)), opened, pose(status=status)):
            performer.receive(datagram)
    assert performer.tracking == tracking


def test_names_beyond_ascii_go_as_utf_8():
    performer = Performer(["舌"])
    with receiver() as (opened, place):
        for datagram in sent(VmcWorker(place, Fixed(舌=0.25)), opened, pose()):
            performer.receive(datagram)
    assert performer.shown == {"舌": 0.25}


@pytest.mark.parametrize(
    ("names", "value"),
    [(["TongueOut"], 0.5), (["tongueOut"], 1.5), (["tongueOut"], -0.25), (["tongueOut"], np.nan)],
)
def test_the_strict_avatar_refuses_other_names_and_values(names, value):
    with receiver() as (opened, place):
        (datagram,) = sent(VmcWorker(place, Fixed(tongueOut=value)), opened, pose())
    with pytest.raises(Refused):
        Performer(names).receive(datagram)


def test_behind_a_slot_an_absent_receiver_changes_nothing():
    sink = SlotSink(VmcWorker(nobody(), Fixed(a=0.5)))
    sink.start(info())
    for number in range(50):
        sink.send(pose(number))
    sink.close()
    assert sink.sent >= 1 and sink.failure == ""


def test_it_speaks_to_the_performers_port_not_the_marionettes():
    assert DEFAULT_DESTINATION.endswith(":39540")
    assert VmcWorker("localhost:39540", Fixed(a=0.5)).destination == "vmc localhost:39540"
    with pytest.raises(InputError, match="HOST:PORT"):
        VmcWorker("nowhere", Fixed(a=0.5))
