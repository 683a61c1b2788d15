"""The receiver for Blender: it understands what is sent, damaged datagrams included; in a real Blender it follows.

Blender is the package bpy, which is not part of any extra: where it is not installed, only what needs no Blender runs.
"""

import importlib.util
import json
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from tonguetrack.model.rebasing import Rebased
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.gltf import glb
from tonguetrack.tracker.pose import TrackedPose
from tonguetrack.tracker.streams.osc import OscSink
from tonguetrack.tracker.streams.sink import StreamInfo

SCRIPT = Path(__file__).resolve().parents[1] / "docs" / "receivers" / "blender" / "tongue_osc.py"
LOW, HIGH = [-1.0, 0.0, 2.0, 5.0], [1.0, 4.0, 3.0, 5.0]


@pytest.fixture
def script(monkeypatch):
    """The receiver, imported as if there were a Blender; what needs one cannot be called."""
    blender = ModuleType("bpy")
    blender.types = SimpleNamespace(Operator=object, Panel=object)
    monkeypatch.setitem(sys.modules, "bpy", blender)
    spec = importlib.util.spec_from_file_location("tongue_osc", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Mesh(dict):
    """A mesh with custom properties and four shape keys, as far as the receiver looks at it."""

    def __init__(self):
        super().__init__(weights_low=LOW, weights_high=HIGH)
        keys = [SimpleNamespace(value=0.0, name=name) for name in ("Basis", "a", "b", "c", "d")]
        self.shape_keys = SimpleNamespace(key_blocks=keys)


@pytest.fixture
def receiver(script):
    made = script.Receiver(SimpleNamespace(data=Mesh(), type="MESH"), 0)
    yield made
    made.close()


def values(receiver):
    return [key.value for key in receiver.tongue.data.shape_keys.key_blocks[1:]]


def stream_to(port, size=4):
    """Our own sender, started."""
    sink = OscSink(f"127.0.0.1:{port}")
    sink.start(
        StreamInfo(
            "a model", "f", 60, np.zeros(size), np.ones(size), np.ones(3), True, ("tongue_tip",), 250.0
        )
    )
    return sink


def pose(weights):
    weights = np.array(weights, dtype=np.float64)
    return TrackedPose(weights, weights, np.zeros(3), np.zeros(1))


def raw(receiver, *packets):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for packet in packets:
            sender.sendto(packet, receiver.socket.getsockname())


def text(words):
    return words.encode() + b"\0" * (4 - len(words) % 4)


def pose_message(*weights):
    return text("/tongue/pose") + text("," + "f" * len(weights)) + struct.pack(f">{len(weights)}f", *weights)


# Without Blender ------------------------------------------------------------------------------------


def test_the_keys_follow_our_stream_re_based_and_only_the_newest_pose_counts(receiver):
    sink = stream_to(receiver.socket.getsockname()[1])
    for weights in ([9, 9, 9, 9], [0.0, 1.0, 2.75, 5.0]):
        sink.send(pose(weights))
    sink.close()
    assert receiver.poll()
    assert values(receiver) == [0.5, 0.25, 0.75, 0.0]  # the last one never moves: low = high
    assert receiver.said == "following"


def test_nothing_new_changes_nothing(receiver):
    assert receiver.poll() and values(receiver) == [0, 0, 0, 0]
    assert receiver.said == "waiting for poses"


def test_poses_of_another_model_are_left_alone_and_said(receiver):
    sink = stream_to(receiver.socket.getsockname()[1], size=3)
    sink.send(pose([1, 2, 3]))
    sink.close()
    assert receiver.poll() and values(receiver) == [0, 0, 0, 0]
    assert receiver.said == "poses have 3 weights, this tongue has 4: another model"


def test_weights_that_are_no_numbers_move_nothing(receiver):
    raw(receiver, pose_message(0.0, float("nan"), 0.0, 0.0))
    assert receiver.poll() and values(receiver) == [0, 0, 0, 0]


def test_damaged_and_foreign_datagrams_are_harmless_and_the_next_pose_counts(receiver):
    whole = b"#bundle\0" + struct.pack(">QI", 1, len(pose_message(0, 0, 2, 5))) + pose_message(0, 0, 2, 5)
    random = np.random.default_rng(0)
    raw(
        receiver,
        b"", b"\0", b"#bundle\0", b"#bundle\0" + b"\xff" * 40, b"#bundle\0" + struct.pack(">Qi", 1, 0) * 3,
        text("/tongue/pose"), text("/tongue/pose") + text(",ffff"), text("/tongue/pose") + text(",b") + b"\x7f" * 4,
        *(whole[:size] for size in range(len(whole))),
        *(random.integers(0, 256, 60, dtype=np.uint8).tobytes() for _ in range(50)),
    )  # fmt: skip
    assert receiver.poll() and values(receiver) == [0, 0, 0, 0]
    raw(receiver, whole)
    assert receiver.poll() and values(receiver) == [0.5, 0, 0, 0]


def test_bundles_in_bundles_in_bundles_end_somewhere(script):
    packet = pose_message(1, 2, 3, 4)
    for _ in range(200):
        packet = b"#bundle\0" + struct.pack(">QI", 1, len(packet)) + packet
    assert script.messages(packet) == []


def test_a_tongue_that_was_deleted_ends_it(receiver):
    receiver.tongue = SimpleNamespace()
    assert receiver.poll() is False


def test_a_tongue_is_what_tonguetrack_exported(script):
    assert script.is_tongue(SimpleNamespace(type="MESH", data=Mesh()))
    foreign = Mesh()
    del foreign["weights_low"]
    assert not script.is_tongue(SimpleNamespace(type="MESH", data=foreign))
    assert not script.is_tongue(SimpleNamespace(type="LIGHT")) and not script.is_tongue(None)


# In Blender -----------------------------------------------------------------------------------------

IN_BLENDER = """
import importlib.util, json, sys
import bpy, numpy as np
glb, script, truth = sys.argv[1:4]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 24
bpy.ops.import_scene.gltf(filepath=glb)
tongue = [thing for thing in bpy.data.objects if thing.type == "MESH" and thing.data.shape_keys][0]
keys = tongue.data.shape_keys.key_blocks

def shown():
    posed = tongue.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    flat = np.empty(3 * len(posed.vertices), np.float32)
    posed.vertices.foreach_get("co", flat)
    world = np.array(tongue.matrix_world)
    return 1000 * (flat.reshape(-1, 3).astype(float) @ world[:3, :3].T + world[:3, 3])

def said(**facts):
    print("FACTS", json.dumps(facts), flush=True)

with np.load(truth) as known:
    times, vertices = known["times_s"], known["vertices"]
worst = 0.0
for time, expected in zip(times, vertices):
    at = time * 24
    bpy.context.scene.frame_set(int(at), subframe=at - int(at))
    worst = max(worst, np.abs(shown() - expected).max())
said(worst_mm=float(worst), limits=[[key.slider_min, key.slider_max] for key in keys], names=[k.name for k in keys])

spec = importlib.util.spec_from_file_location("tongue_osc", script)
receiving = importlib.util.module_from_spec(spec)
spec.loader.exec_module(receiving)
receiving.register()
assert receiving.is_tongue(tongue)
receiver = receiving.start(tongue, 0)
said(port=receiver.socket.getsockname()[1])
sys.stdin.readline()
assert receiver.poll()
np.save(truth + ".npy", shown())
assert receiver.poll(keyframe=10)  # nothing new
said(followed=True)
sys.stdin.readline()
assert receiver.poll(keyframe=12)
curves = tongue.data.shape_keys.animation_data.action
said(said=receiver.said, keyed=[list(map(float, curves.frame_range)), [key.value for key in keys[1:]]])
receiving.unregister()
"""


@pytest.fixture
def blender(tmp_path):
    """A real Blender with a clip of the bundled model, its range five sigma; the clip's times and true vertices."""
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("Blender is not installed as a Python package (pip install bpy)")
    model = bundled_model()
    speaker = model.for_speaker(model.speaker.mean)
    phase = np.linspace(0, 5, 25)[:, None] * [1.0, 1.7, 2.3, 3.1]
    weights = model.pose.raw(4.5 * np.sin(phase))
    times = np.arange(25) / 24.0  # so that Blender's frames fall on ours
    rebased = Rebased.of_range(speaker.mean, speaker.sigma, 5)
    (tmp_path / "t.glb").write_bytes(glb(speaker, rebased, model.name, (times, weights)))
    np.savez(tmp_path / "t.npz", times_s=times, vertices=[speaker.vertices(row) for row in weights])
    command = [sys.executable, "-c", IN_BLENDER, tmp_path / "t.glb", SCRIPT, tmp_path / "t.npz"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        bound = threading.Timer(60, running.kill)  # whatever a Blender may wait for
        bound.start()
        yield SimpleNamespace(running=running, speaker=speaker, model=model, live=tmp_path / "t.npz.npy")
        bound.cancel()
        running.kill()


def facts(running):
    for line in running.stdout:
        if line.startswith("FACTS "):
            return json.loads(line.removeprefix("FACTS "))
    pytest.fail("Blender ended before it said anything")


def tell(running):
    running.stdin.write("\n")
    running.stdin.flush()


def test_blender_shows_the_exported_frames_and_follows_a_stream(blender):
    running, model = blender.running, blender.model
    imported = facts(running)
    assert imported["worst_mm"] < 5e-5
    assert imported["names"] == ["Basis", "pose_0", "pose_1", "pose_2", "pose_3"]
    assert imported["limits"][1:] == [[0.0, 1.0]] * 4  # which is why weights are re-based

    sink = stream_to(facts(running)["port"])
    weights = model.pose.raw([2.0, -3.5, 1.0, 4.0])
    sink.send(pose(weights))
    tell(running)
    assert facts(running)["followed"]
    sink.send(pose(model.pose.mean))
    tell(running)
    last = facts(running)
    sink.close()
    assert last["said"] == "following"
    assert last["keyed"][0] == [12.0, 12.0]
    np.testing.assert_allclose(last["keyed"][1], 0.5, atol=1e-6)
    assert running.wait(timeout=30) == 0
    np.testing.assert_allclose(np.load(blender.live), blender.speaker.vertices(weights), atol=5e-5)
