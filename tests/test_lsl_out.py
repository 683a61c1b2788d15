"""Outlets of the Lab Streaming Layer, heard by an inlet in another process.

The library reads its settings once a process, so both ends run in processes of their own, which see nothing but this
machine and the session of their test. What a MoCap stream must say of itself is from
https://github.com/sccn/xdf/wiki/MoCap-Meta-Data.
"""

import json
import os
import subprocess
import sys
import uuid

import numpy as np
import pytest
from streaming import ROLES, model, pose

from tonguetrack import InputError
from tonguetrack.drivers.devices.lsl_source import Channel, map_channels
from tonguetrack.tracker.streams.lsl import LslWorker, coil_channels, pose_channels

PATIENCE_S = 20.0

OUTLET = """
import json, sys, time
import pylsl
from streaming import info, pose
from tonguetrack.tracker.streams.lsl import LslWorker
name, paced = json.loads(sys.argv[1])
worker = LslWorker(name, paced)
worker.begin(info())
print("ready", flush=True)
for line in sys.stdin:
    wish = json.loads(line)
    if wish == "consumers":
        print(worker._coils.wait_for_consumers(20.0) and worker._pose.wait_for_consumers(20.0), flush=True)
    elif wish == "fixed":
        before = worker._coils
        worker.begin(info(fixed=False))
        print(worker._coils is before, flush=True)
    elif wish == "other coils":
        worker.begin(info(roles=("a", "b")))
        print("begun", flush=True)
    else:
        age_s, number = wish
        before_s = pylsl.local_clock() - age_s
        worker.work(pose(number, arrival_ns=time.perf_counter_ns() - int(age_s * 1e9)))
        print(json.dumps([before_s, pylsl.local_clock() - age_s]), flush=True)
worker.end()
"""

INLET = """
import json, sys
import pylsl
found = []
for name in json.loads(sys.argv[1]):
    streams = pylsl.resolve_byprop("name", name, 1, 20.0)
    assert len(streams) == 1, name
    inlet = pylsl.StreamInlet(streams[0], recover=False)
    about = inlet.info(timeout=10.0)
    print(json.dumps({
        "xml": about.as_xml(), "name": about.name(), "type": about.type(), "rate": about.nominal_srate(),
        "count": about.channel_count(), "format": about.channel_format(), "source_id": about.source_id(),
    }), flush=True)
    inlet.open_stream(timeout=10.0)
    found.append(inlet)
for line in sys.stdin:
    samples = []
    for inlet in found:
        sample, stamp = inlet.pull_sample(timeout=10.0)
        samples.append([None if sample is None else [None if v != v else v for v in sample], stamp])
    print(json.dumps(samples), flush=True)
"""


class Process:
    """A script in another process, spoken with in lines of JSON."""

    def __init__(self, script, argument, environment):
        self.process = subprocess.Popen(
            [sys.executable, "-c", script, json.dumps(argument)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            text=True, env=environment, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def ask(self, what):
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()
        return self.line()

    def line(self):
        return self.process.stdout.readline().strip()

    def end(self):
        if self.process.returncode is not None:
            return
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def lab(tmp_path, request):
    """Starts an outlet, and an inlet that finds nobody else."""
    try:
        import pylsl  # noqa: F401
    except (ImportError, RuntimeError):
        pytest.skip("needs the extra 'lab'")
    settings_file = tmp_path / "lsl_api.cfg"
    settings_file.write_text(
        f"[multicast]\nResolveScope = machine\n[lab]\nSessionID = {uuid.uuid4().hex}\n[log]\nlevel = -2\n"
    )
    beside = os.pathsep.join(filter(None, [os.path.dirname(__file__), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "LSLAPICFG": str(settings_file), "PYTHONPATH": beside}

    def start(script, argument):
        process = Process(script, argument, environment)
        request.addfinalizer(process.end)
        return process

    class Lab:
        def outlet(self, name="tongue", paced=False):
            outlet = start(OUTLET, [name, paced])
            assert outlet.line() == "ready"
            return outlet

        def inlet(self, name="tongue"):
            inlet = start(INLET, [name, f"{name} pose"])
            return inlet, [json.loads(inlet.line()) for _ in range(2)]

        def both(self, name="tongue", paced=False):
            outlet = self.outlet(name, paced)
            inlet, abouts = self.inlet(name)
            assert outlet.ask("consumers") == "True"
            return outlet, inlet, abouts

    return Lab()


def described(about):
    """The meta-data as a tree, and the channels as dicts."""
    from xml.etree import ElementTree

    tree = ElementTree.fromstring(about["xml"]).find("desc")
    channels = [
        {entry.tag: entry.text for entry in channel} for channel in tree.find("channels").findall("channel")
    ]
    return tree, channels


def test_the_coils_are_a_mocap_stream_that_says_all_of_itself_in_metres(lab):
    _, _, (coils, _) = lab.both()
    tree, channels = described(coils)
    assert (coils["name"], coils["type"], coils["rate"], coils["count"]) == ("tongue", "MoCap", 250.0, 9)
    assert coils["source_id"].startswith("tonguetrack/") and coils["source_id"].endswith("/tongue")
    assert len(channels) == coils["count"]
    for role, axes in zip(ROLES, np.array(channels).reshape(-1, 3), strict=True):
        for axis, channel in zip("XYZ", axes, strict=True):
            assert channel == {
                "label": f"{role}_{axis.lower()}", "marker": role, "object": "tongue", "type": f"Position{axis}",
                "unit": "meters",
            }  # fmt: skip
    assert tree.findtext("acquisition/manufacturer") == "tonguetrack"
    assert tree.findtext("acquisition/model") == model().name
    assert tree.findtext("setup/objects/object/label") == "tongue"
    assert [marker.findtext("label") for marker in tree.findall("setup/markers/marker")] == list(ROLES)


def test_the_pose_is_a_stream_beside_it(lab):
    _, _, (_, beside) = lab.both()
    _, channels = described(beside)
    assert (beside["name"], beside["type"], beside["rate"]) == ("tongue pose", "Misc", 250.0)
    assert beside["source_id"].endswith("/tongue pose")
    count, speaker = model().pose.size, model().speaker.size
    assert [channel["label"] for channel in channels] == [
        *(f"weight_{k}" for k in range(count)), *(f"sigma_{k}" for k in range(count)),
        *(f"speaker_{k}" for k in range(speaker)), "residual", "valid_coils", "status",
    ]  # fmt: skip
    assert all(channel["type"] and channel["unit"] for channel in channels)


def test_samples_arrive_exactly_with_the_frames_arrival_as_the_stamp_of_both(lab):
    outlet, inlet, _ = lab.both()
    for number, age_s in enumerate((0.0, 0.25, 0.5)):
        earliest, latest = json.loads(outlet.ask([age_s, number]))
        (coils, coils_stamp), (weights, pose_stamp) = json.loads(inlet.ask("next"))
        each = pose(number)
        assert coils == [None if np.isnan(value) else value for value in (each.coils.ravel() * 1e-3).tolist()]
        numbers = np.concatenate([each.weights, each.normalised, each.speaker_weights]).tolist()
        assert weights == [*numbers, 0.5, 2.0, 1.0]
        assert coils_stamp == pose_stamp
        assert earliest - 1e-6 <= coils_stamp <= latest + 1e-6


def test_at_a_rate_of_its_own_a_stream_is_announced_as_irregular(lab):
    _, _, abouts = lab.both("other name", paced=True)
    assert [about["rate"] for about in abouts] == [0.0, 0.0]


def test_source_ids_stay_the_same_from_run_to_run(lab):
    outlet, inlet, before = lab.both()
    outlet.end()
    inlet.end()
    _, _, after = lab.both()
    assert [about["source_id"] for about in after] == [about["source_id"] for about in before]
    assert before[0]["source_id"] != before[1]["source_id"]


def test_other_coils_are_other_outlets(lab):
    outlet = lab.outlet()
    assert outlet.ask("other coils") == "begun"
    _, (coils, _) = lab.inlet()
    assert [channel["marker"] for channel in described(coils)[1]][::3] == ["a", "b"]


def test_another_speaker_leaves_the_outlets_as_they_are(lab):
    outlet, inlet, _ = lab.both()
    assert outlet.ask("fixed") == "True"
    outlet.ask([0.0, 5])
    (coils, _), _ = json.loads(inlet.ask("next"))
    assert len(coils) == 9


# Without a network ----------------------------------------------------------------------------------


def test_our_own_source_understands_what_our_outlet_says():
    found = map_channels(
        [Channel(c.label, c.marker, c.object, c.type, c.unit) for c in coil_channels(ROLES)], "", "s"
    )
    assert found.coils == ROLES
    frame = found.frame([0.001 * k for k in range(9)], 0.0, 1, 0)
    np.testing.assert_allclose(frame.positions, np.arange(9.0).reshape(3, 3))


def test_channels_follow_the_coils_and_the_models_size():
    assert len(coil_channels(("a", "b"))) == 6
    assert len(pose_channels(7, 3)) == 7 + 7 + 3 + 3
    labels = [channel.label for channel in pose_channels(7, 3)]
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("name", ["", "it's", 'a "b"', "a\nb", "x" * 101])
def test_a_name_that_cannot_be_looked_for_is_refused(name):
    with pytest.raises(InputError, match="expected a name of at most 100 characters"):
        LslWorker(name, paced=False)


def test_without_pylsl_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylsl", None)  # as if it could not be imported
    with pytest.raises(InputError, match=r"pip install 'tonguetrack\[lab\]'"):
        LslWorker("tongue", paced=False)
