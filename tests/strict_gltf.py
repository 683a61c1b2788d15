"""A reader of binary glTF 2.0 as its specification describes it, which refuses what a lenient one would let pass.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html: chunks and their padding (section 4.4), alignment and bounds
of accessors (3.6.2), least and greatest of positions and key times, morph targets that fit their mesh (3.7.2),
animations with increasing times (3.11). Only what our files may hold is understood; everything else is refused.
"""

import json
import struct
from dataclasses import dataclass

import numpy as np
from strict_osc import Refused, insist

COMPONENTS = {5126: np.dtype("<f4"), 5125: np.dtype("<u4")}
WIDTHS = {"SCALAR": 1, "VEC3": 3}
TOP = {
    "asset", "scene", "scenes", "nodes", "meshes", "materials", "accessors", "bufferViews", "buffers", "animations",
}  # fmt: skip


@dataclass
class Channel:
    """times (keys,); values (keys, width); how: LINEAR or STEP."""

    times: np.ndarray
    values: np.ndarray
    how: str

    def at(self, time):
        if self.how == "STEP":
            return self.values[max(np.searchsorted(self.times, np.float32(time), side="right") - 1, 0)]
        return np.array([np.interp(time, self.times, column) for column in self.values.T.astype(np.float64)])


@dataclass
class Node:
    """One node with its mesh; channels by path: weights, translation, scale."""

    name: str
    mesh: dict
    mode: int
    positions: np.ndarray
    normals: np.ndarray | None
    faces: np.ndarray | None
    targets: list
    target_normals: list
    translation: np.ndarray
    scale: np.ndarray
    channels: dict

    def weights(self, time=None):
        if time is None or "weights" not in self.channels:
            return np.array(self.mesh.get("weights", []))
        return self.channels["weights"].at(time)

    def vertices(self, time=None):
        """(V, 3) as a viewer would show them, float64."""
        shown = self.positions.astype(np.float64)
        for weight, target in zip(self.weights(time), self.targets, strict=True):
            shown = shown + weight * target.astype(np.float64)
        return shown

    def place(self, time):
        channel = self.channels.get("translation")
        return self.translation if channel is None else channel.at(time)

    def size(self, time):
        channel = self.channels.get("scale")
        return self.scale if channel is None else channel.at(time)


def to_model_frame(points):
    """glTF's axes in metres (x, y up, z to the front) as mm in the model's: x, y to the back, z up."""
    x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    return 1000.0 * np.stack([x, -z, y], axis=-1)


def read_glb(data):
    """name -> Node, and the whole JSON."""
    content, buffer = _chunks(data)
    insist(set(content) <= TOP, f"unknown parts {set(content) - TOP}")
    insist(content["asset"]["version"] == "2.0", "another version")
    insist(content["buffers"] == [{"byteLength": len(buffer)}], "the buffer is not the binary chunk")
    arrays = [_array(content, buffer, number) for number in range(len(content["accessors"]))]
    used = set()

    def array(number, kind, bounded=False):
        used.add(number)
        accessor = content["accessors"][number]
        insist(accessor["type"] == kind, f"accessor {number} is {accessor['type']}, expected {kind}")
        insist(not bounded or "min" in accessor, f"accessor {number} has no bounds")
        return arrays[number]

    meshes = [_mesh(mesh, content, array) for mesh in content["meshes"]]
    roots = content["scenes"][content["scene"]]["nodes"]
    insist(sorted(roots) == list(range(len(content["nodes"]))), "a node is in no scene")
    nodes = [
        Node(
            node["name"],
            content["meshes"][node["mesh"]],
            *meshes[node["mesh"]],
            np.array(node.get("translation", (0.0, 0.0, 0.0))),
            np.array(node.get("scale", (1.0, 1.0, 1.0))),
            {},
        )
        for node in content["nodes"]
    ]
    for animation in content.get("animations", []):
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            node = nodes[channel["target"]["node"]]
            node.channels[channel["target"]["path"]] = _channel(channel, sampler, node, array)
    insist(used == set(range(len(arrays))), "an accessor is used by nothing")
    insist(len({node.name for node in nodes}) == len(nodes), "two nodes have one name")
    return {node.name: node for node in nodes}, content


def _chunks(data):
    insist(len(data) >= 20, "too short")
    magic, version, length = struct.unpack_from("<4sII", data)
    insist(magic == b"glTF" and version == 2 and length == len(data), "not the header of this file")
    size, kind = struct.unpack_from("<I4s", data, 12)
    insist(kind == b"JSON" and size % 4 == 0 and 20 + size + 8 <= len(data), "no JSON chunk")
    text = data[20 : 20 + size]
    insist(not text.endswith((b"\0", b"\n")), "JSON is padded with spaces")
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    insist(kind == b"BIN\0" and binary_size % 4 == 0, "no binary chunk")
    insist(20 + size + 8 + binary_size == len(data), "the chunks do not fill the file")

    def no_constant(name):
        raise Refused(f"JSON knows no {name}")

    return json.loads(text.decode("utf-8"), parse_constant=no_constant), data[20 + size + 8 :]


def _array(content, buffer, number):
    accessor = content["accessors"][number]
    view = content["bufferViews"][accessor["bufferView"]]
    dtype, width = COMPONENTS[accessor["componentType"]], WIDTHS[accessor["type"]]
    begin = view["byteOffset"] + accessor.get("byteOffset", 0)
    size = accessor["count"] * width * dtype.itemsize
    insist(accessor["count"] >= 1 and size <= view["byteLength"], f"accessor {number} leaves its view")
    insist(
        view["byteOffset"] + view["byteLength"] <= len(buffer) and begin % 4 == 0, "a view leaves the buffer"
    )
    array = np.frombuffer(buffer, dtype, accessor["count"] * width, begin).reshape(-1, width)
    insist(np.isfinite(array).all(), f"accessor {number} holds what is no number")
    for bound, found in (("min", array.min(axis=0)), ("max", array.max(axis=0))):
        insist(accessor.get(bound, found.tolist()) == found.tolist(), f"accessor {number}: wrong {bound}")
    return array


def _mesh(mesh, content, array):
    (primitive,) = mesh["primitives"]
    insist(0 <= primitive["material"] < len(content["materials"]), "no such material")
    attributes = primitive["attributes"]
    positions = array(attributes["POSITION"], "VEC3", bounded=True)
    normals = array(attributes["NORMAL"], "VEC3") if "NORMAL" in attributes else None
    if normals is not None:
        insist(np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5), "a normal is not of length 1")
    faces = None
    if "indices" in primitive:
        faces = array(primitive["indices"], "SCALAR").reshape(-1, 3)
        insist(faces.max() < len(positions), "a face names a vertex that is not there")
    targets = primitive.get("targets", [])
    moved = [array(target["POSITION"], "VEC3", bounded=True) for target in targets]
    turned = [array(target["NORMAL"], "VEC3") for target in targets]
    insist(all(len(target) == len(positions) for target in moved + turned), "a target of another size")
    insist(len(mesh.get("weights", [])) == len(targets), "not one weight for each target")
    return primitive.get("mode", 4), positions, normals, faces, moved, turned


def _channel(channel, sampler, node, array):
    path = channel["target"]["path"]
    insist(path not in node.channels, "two channels move one thing")
    times = array(sampler["input"], "SCALAR", bounded=True)[:, 0]
    insist(times[0] >= 0 and (np.diff(times) > 0).all(), "key times do not increase")
    values = array(sampler["output"], "SCALAR" if path == "weights" else "VEC3")
    width = len(node.targets) if path == "weights" else 3
    insist(values.size == len(times) * width, "not one value for each key")
    insist(sampler["interpolation"] in ("LINEAR", "STEP"), "an interpolation that is not understood")
    return Channel(times, values.reshape(len(times), width), sampler["interpolation"])
