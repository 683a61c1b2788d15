"""Streams of the Lab Streaming Layer as a source: the meaning of channels, and real streams on this machine.

The library reads its settings once a process, so both ends of each stream run in processes of their own,
which see nothing but this machine and the session of their test.
"""

import json
import os
import subprocess
import sys
import uuid
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers.devices import lsl_source
from tonguetrack.drivers.devices.link import LinkLost
from tonguetrack.drivers.devices.lsl_source import Channel, LslConversation, map_channels, open_lsl
from tonguetrack.drivers.sources import parse_source

# Channels -------------------------------------------------------------------------------------------


def mocap(marker, unit="meters", parts=("PositionX", "PositionY", "PositionZ"), group=""):
    return [Channel(f"{marker}_{part}", marker, group, part, unit) for part in parts]


ORIENTATION = tuple(f"Orientation{part}" for part in "ABCD")


def plain(name, unit=""):
    return [Channel(f"{name}_{axis}", unit=unit) for axis in "xyz"]


def test_markers_of_a_mocap_stream_are_coils_in_millimetres():
    channels = [*mocap("tip"), *mocap("mid"), Channel("c", "mid", "", "Confidence", "normalized")]
    found = map_channels(channels, "", "s")
    assert found.coils == ("tip", "mid")
    frame = found.frame([0.001, 0.002, 0.003, 0.01, 0.02, 0.03, 1.0], 5.0, 1, 7)
    np.testing.assert_allclose(frame.positions, [[1, 2, 3], [10, 20, 30]])
    assert frame.quaternions is None
    assert (frame.device_time_s, frame.frame_number, frame.arrival_ns) == (5.0, 1, 7)


def test_channels_may_stand_in_any_order():
    channels = [*mocap("tip", "mm"), *mocap("mid", "mm")]
    order = [5, 0, 3, 2, 4, 1]
    frame = map_channels([channels[k] for k in order], "", "s").frame(order, 0.0, 1, 0)
    assert sorted(frame.positions.tolist()) == [[0, 1, 2], [3, 4, 5]]


def test_orientations_are_quaternions_with_the_real_part_first():
    channels = [*mocap("tip", "mm", parts=(*ORIENTATION[::-1], "PositionX", "PositionY", "PositionZ"))]
    channels += mocap("mid", "mm")
    frame = map_channels(channels, "", "s").frame([0.4, 0.3, 0.2, 0.1, 1, 2, 3, 4, 5, 6], 0.0, 1, 0)
    np.testing.assert_array_equal(frame.quaternions, [[0.1, 0.2, 0.3, 0.4], [np.nan] * 4])
    np.testing.assert_array_equal(frame.positions, [[1, 2, 3], [4, 5, 6]])


def test_a_quaternion_without_length_is_missing():
    channels = mocap("tip", "mm", parts=("PositionX", "PositionY", "PositionZ", *ORIENTATION))
    frame = map_channels(channels, "", "s").frame([1, 2, 3, 0, 0, 0, 0], 0.0, 1, 0)
    assert np.isnan(frame.quaternions).all() and np.isfinite(frame.positions).all()


@pytest.mark.parametrize("hole", [np.nan, np.inf, -np.inf])
def test_a_coil_with_a_coordinate_that_is_not_finite_is_missing_as_a_whole(hole):
    frame = map_channels([*plain("tip", "mm"), *plain("mid", "mm")], "", "s").frame(
        [1, hole, 3, 4, 5, 6], 0.0, 1, 0
    )
    np.testing.assert_array_equal(frame.positions, [[np.nan] * 3, [4, 5, 6]])


def test_labels_with_axes_are_coils_of_a_plain_stream():
    channels = [Channel("time"), *plain("tongue_tip", "mm"), Channel("audio_level"), *plain("jaw", "mm")]
    found = map_channels(channels, "", "s")
    assert found.coils == ("tongue_tip", "jaw")
    np.testing.assert_array_equal(found.positions, [[1, 2, 3], [5, 6, 7]])


def test_capitals_do_not_matter_in_types_axes_and_units():
    channels = [Channel("a_X", unit="MM"), Channel("a_Y", unit=" mm"), Channel("a_Z", unit="millimeters")]
    channels += [Channel("l", "b", "", kind, "Meters") for kind in ("POSITIONX", "positiony", "PositionZ")]
    found = map_channels(channels, "", "s")
    assert found.coils == ("a", "b")
    assert found.scale_mm.tolist() == [[1.0], [1000.0]]


def test_markers_of_the_same_name_are_told_apart_by_their_objects():
    channels = [*mocap("1", group="tongue"), *mocap("1", group="head"), *mocap("2", group="head")]
    assert map_channels(channels, "", "s").coils == ("tongue 1", "head 1", "2")


def test_a_marker_without_a_name_is_called_after_its_object_or_label():
    assert map_channels(mocap("", group="jaw"), "", "s").coils == ("jaw",)
    channels = [Channel(f"lip_{axis}", type=f"Position{axis}", unit="m") for axis in "XYZ"]
    assert map_channels(channels, "", "s").coils == ("lip",)


@pytest.mark.parametrize(("stated", "factor"), [("mm", 1.0), ("m", 1000.0)])
@pytest.mark.parametrize("unit", ["", "furlongs"])
def test_the_stated_unit_holds_where_the_stream_says_none_that_is_known(stated, factor, unit):
    assert map_channels(plain("tip", unit), stated, "s").scale_mm.tolist() == [[factor]]


def test_the_streams_own_unit_comes_first():
    assert map_channels(plain("tip", "m"), "mm", "s").scale_mm.tolist() == [[1000.0]]


@pytest.mark.parametrize(("unit", "said"), [("", "nothing"), ("furlongs", "furlongs")])
def test_an_unknown_unit_is_asked_for(unit, said):
    with pytest.raises(InputError, match=rf"'s' says of its unit: {said}; .*\?unit=mm"):
        map_channels(plain("tip", unit), "", "s")


def test_axes_in_different_units_are_not_believed():
    channels = [Channel("a_x", unit="m"), Channel("a_y", unit="mm"), Channel("a_z", unit="m")]
    with pytest.raises(InputError, match="unit"):
        map_channels(channels, "", "s")


@pytest.mark.parametrize(
    "channels",
    [
        [],
        [Channel()] * 3,
        plain("tip", "mm")[:2],
        mocap("tip", parts=("PositionX", "PositionY")),
        [Channel(label) for label in ("x", "y", "z")],
        mocap("tip", parts=ORIENTATION),
    ],
)
def test_a_stream_without_whole_coils_is_refused_with_its_labels(channels):
    with pytest.raises(InputError, match="no coil among its channels.*NAME_x"):
        map_channels(channels, "mm", "s")


def test_a_coil_that_is_there_twice_is_refused():
    with pytest.raises(InputError, match="'tip' twice"):
        map_channels([*plain("tip"), *plain("tip")], "mm", "s")


TEXTS = st.sampled_from(
    ["", "tip", "a_x", "a_y", "a_z", "PositionX", "PositionY", "PositionZ", "m", "mm", "_"]
)
CHANNELS = st.lists(st.builds(Channel, TEXTS, TEXTS, TEXTS, TEXTS, TEXTS), max_size=12)


@settings(max_examples=300, deadline=None)
@given(CHANNELS, st.sampled_from(["", "m", "mm"]), st.data())
def test_whatever_a_stream_says_of_its_channels_it_is_a_map_or_an_input_error(channels, unit, data):
    try:
        found = map_channels(channels, unit, "s")
    except InputError:
        return
    floats = st.lists(st.floats(), min_size=len(channels), max_size=len(channels))
    frame = found.frame(data.draw(floats), 0.0, 1, 0)
    assert frame.positions.shape == (len(found.coils), 3) and found.coils


# The library ----------------------------------------------------------------------------------------


def test_without_pylsl_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylsl", None)  # as if it could not be imported
    with pytest.raises(InputError, match=r"pip install 'tonguetrack\[lab\]'"):
        open_lsl(parse_source("lsl:Coils"))


@pytest.mark.parametrize("address", ["lsl:Coils?unit=cm", "lsl:Coils?timeout=0", "lsl:the 'tongue'"])
def test_what_cannot_be_looked_for_is_an_input_error(address, monkeypatch):
    monkeypatch.setattr(lsl_source, "_pylsl", lambda: None)
    with pytest.raises(InputError):
        open_lsl(parse_source(address))


class FakeInlet:
    """Holds no sample; remembers how long it was waited for."""

    def __init__(self, failure=None):
        self.failure = failure
        self.waits = []

    def pull_sample(self, timeout):
        self.waits.append(timeout)
        if self.failure:
            raise self.failure
        return None, None


def conversation(inlet):
    return LslConversation(inlet, map_channels(plain("tip", "mm"), "", "s"), 0.0, count(1), "")


def test_the_library_waits_no_longer_than_it_is_told():
    inlet = FakeInlet()
    assert conversation(inlet).receive(0.1) is None
    assert inlet.waits == [0.1]


def test_an_error_of_the_library_is_a_lost_link():
    with pytest.raises(LinkLost, match="gone"):
        conversation(FakeInlet(RuntimeError("the stream has been lost."))).receive(0.1)


def test_several_streams_of_one_name_are_refused():
    found = [
        SimpleNamespace(uid=lambda k=k: k, type=lambda: "MoCap", hostname=lambda k=k: f"host{k}")
        for k in (1, 2)
    ]
    library = SimpleNamespace(resolve_byprop=lambda *_: found)
    with (
        pytest.MonkeyPatch.context() as patch,
        pytest.raises(
            InputError, match=r"several LSL streams are called 'Coils' \(MoCap on host1, MoCap on host2\)"
        ),
    ):
        patch.setattr(lsl_source, "_pylsl", lambda: library)
        open_lsl(parse_source("lsl:Coils"))


# Real streams ---------------------------------------------------------------------------------------

OUTLET = """
import json, sys
import pylsl
about = json.loads(sys.argv[1])
info = pylsl.StreamInfo(about["name"], about["type"], len(about["channels"]), about["rate"],
                        about["format"], about["source_id"])
channels = info.desc().append_child("channels")
for entry in about["channels"]:
    node = channels.append_child("channel")
    for key, value in entry.items():
        node.append_child_value(key, value)
outlet = pylsl.StreamOutlet(info)
print("ready", flush=True)
for line in sys.stdin:
    what = json.loads(line)
    if what == "consumers":
        outlet.wait_for_consumers(20.0)
        print("there", flush=True)
    else:
        outlet.push_sample(what["sample"], what["stamp"])
"""

LISTENER = """
import json, sys
import numpy as np
from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame
from tonguetrack.drivers.sources import open_device, parse_source
def plain(array):
    return None if array is None else [[None if v != v else v for v in row] for row in array.tolist()]
try:
    source = open_device(parse_source(sys.argv[1]))
except InputError as reason:
    print(json.dumps({"refused": str(reason)}), flush=True)
    sys.exit()
print(json.dumps({"coils": source.coils, "rate": source.rate_hz}), flush=True)
with source:
    for item in source:
        if isinstance(item, CoilFrame):
            said = {"positions": plain(item.positions), "quaternions": plain(item.quaternions),
                    "time": item.device_time_s, "number": item.frame_number, "arrival": item.arrival_ns}
        else:
            said = {"note": item.kind.value, "text": item.text, "arrival": item.arrival_ns}
        print(json.dumps(said), flush=True)
"""


class Process:
    """A script in another process, spoken with in lines of JSON."""

    def __init__(self, script, argument, environment):
        self.process = subprocess.Popen(
            [sys.executable, "-c", script, argument], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, env=environment,
        )  # fmt: skip

    def say(self, what):
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def line(self):
        return self.process.stdout.readline().strip()

    def next(self, *notes):
        """The next frame, or note of one of these kinds."""
        for _ in range(300):
            said = json.loads(self.line())
            if "note" not in said or said["note"] in notes:
                return said
        raise AssertionError("neither a frame nor the note came")

    def end(self):
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def lab(tmp_path, request):
    """Starts outlets and listeners that find each other and nobody else."""
    try:
        import pylsl  # noqa: F401
    except (ImportError, RuntimeError):
        pytest.skip("needs the extra 'lab'")
    settings_file = tmp_path / "lsl_api.cfg"
    settings_file.write_text(
        f"[multicast]\nResolveScope = machine\n[lab]\nSessionID = {uuid.uuid4().hex}\n[log]\nlevel = -2\n"
    )
    environment = {**os.environ, "LSLAPICFG": str(settings_file)}

    class Lab:
        def outlet(self, channels, name="Coils", source_id="", rate=250.0, form="double64"):
            about = {
                "name": name, "type": "MoCap", "rate": rate, "format": form, "source_id": source_id,
                "channels": channels,
            }  # fmt: skip
            outlet = self.start(OUTLET, json.dumps(about))
            assert outlet.line() == "ready"
            return outlet

        def listener(self, address):
            listener = self.start(LISTENER, address)
            return listener, json.loads(listener.line())

        def start(self, script, argument):
            process = Process(script, argument, environment)
            request.addfinalizer(process.end)
            return process

    return Lab()


def described(marker, unit, parts=("PositionX", "PositionY", "PositionZ")):
    return [{"label": f"{marker} {part}", "marker": marker, "type": part, "unit": unit} for part in parts]


SIX = [*described("tip", "meters"), *described("mid", "meters")]


def test_a_mocap_stream_of_another_process_arrives_exactly(lab):
    outlet = lab.outlet([*SIX, *described("tip", "", ORIENTATION)], rate=200.0)
    listener, opened = lab.listener("lsl:Coils")
    assert opened == {"coils": ["tip", "mid"], "rate": 200.0}
    outlet.say("consumers")
    assert outlet.line() == "there"
    numbers = [k / 8 for k in range(10)]
    for k in range(3):
        outlet.say({"sample": numbers, "stamp": 1000.0 + k / 200})
    # Samples that were sent before the connection stood are not promised.
    frames = [listener.next() for _ in range(3)]
    assert [frame["time"] for frame in frames] == [1000.0, 1000.005, 1000.01]  # raw, not this host's clock
    assert [frame["number"] for frame in frames] == [1, 2, 3]
    assert frames[0]["positions"] == [[0.0, 125.0, 250.0], [375.0, 500.0, 625.0]]
    assert frames[0]["quaternions"] == [[0.75, 0.875, 1.0, 1.125], [None] * 4]


def test_the_clocks_difference_is_told_once_and_not_applied(lab):
    lab.outlet(SIX)
    listener, _ = lab.listener("lsl:Coils")
    said = [json.loads(listener.line()) for _ in range(4)]
    told = [item for item in said if item["note"] == "info"]
    assert len(told) == 1 and "sender's clock" in told[0]["text"]
    assert [item["note"] for item in said[1:]] == ["silent"] * 3


def test_missing_coils_arrive_as_missing_and_a_plain_stream_needs_its_unit(lab):
    labels = [{"label": f"tip_{axis}"} for axis in "xyz"] + [{"label": "level"}]
    outlet = lab.outlet(labels, name="My stream", rate=0.0, form="float32")
    _, refused = lab.listener("lsl:My stream")
    assert "?unit=mm" in refused["refused"]
    listener, opened = lab.listener("lsl:My%20stream?unit=mm")
    assert opened == {"coils": ["tip"], "rate": 0.0}
    outlet.say("consumers")
    assert outlet.line() == "there"
    outlet.say({"sample": [1.0, float("nan"), 3.0, 0.5], "stamp": 1.0})
    outlet.say({"sample": [1.0, 2.0, 3.0, 0.5], "stamp": 2.0})
    assert [listener.next()["positions"] for _ in range(2)] == [[[None] * 3], [[1.0, 2.0, 3.0]]]


@pytest.mark.parametrize("source_id", ["", "articulograph-1"])
def test_a_stream_that_dies_is_told_and_found_again(lab, source_id):
    first = lab.outlet(SIX, source_id=source_id)
    listener, _ = lab.listener("lsl:Coils")
    first.say("consumers")
    assert first.line() == "there"
    first.say({"sample": [0.0] * 6, "stamp": 1.0})
    assert listener.next()["number"] == 1
    first.process.kill()
    assert "gone" in listener.next("disconnected")["text"]
    second = lab.outlet(SIX, source_id=source_id)
    assert listener.next("connected")["note"] == "connected"
    second.say("consumers")
    assert second.line() == "there"
    second.say({"sample": [0.001] * 6, "stamp": 2.0})
    frame = listener.next()
    assert (frame["number"], frame["time"], frame["positions"][0]) == (2, 2.0, [1.0, 1.0, 1.0])


def test_a_stream_that_is_not_there_is_an_input_error_in_bounded_time(lab):
    _, refused = lab.listener("lsl:Nobody?timeout=0.3")
    assert "no LSL stream is called 'Nobody'" in refused["refused"]


def test_a_stream_of_text_is_refused(lab):
    lab.outlet([{"label": "marks"}], form="string")
    _, refused = lab.listener("lsl:Coils")
    assert "not of coils" in refused["refused"]
