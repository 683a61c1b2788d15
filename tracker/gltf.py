"""A speaker's tongue as glTF 2.0 in one binary file (GLB): a mesh, a morph target for each direction, an animation.

Source: Khronos, glTF 2.0 Specification (sections 3.6 buffers and accessors, 3.7 geometry and morph targets, 3.11
animations, 4 GLB). Lengths are in metres, y is up and the front faces +z: (x, y, z) mm of the model frame is
(x, z, -y) / 1000 here. Weights are re-based, so that programs that clamp them to 0..1 show the right mesh; the range of
raw weights that 0..1 stands for is in the mesh's extras, `weights_low` and `weights_high`, one for each target.

Positions are exact within float32. Normals are not linear in the weights; the file's are right where all weights are
one half, and nearly so elsewhere. Programs that compute their own (Blender does) need none.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .. import InputError, __version__
from ..model.mesh import FloatArray, IndexArray
from ..model.multilinear import SpeakerModel
from ..model.rebasing import Rebased

COIL_RADIUS_MM = 1.5
_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963  # what a buffer view is for
_LINE_STRIP = 3
_KINDS = {1: "SCALAR", 3: "VEC3"}
_LARGEST_FILE = 2**32 - 1  # its length is an unsigned 32-bit number

Clip = tuple[FloatArray, FloatArray]
"""times_s (frames,), increasing; weights (frames, K), raw."""
Coils = tuple[Sequence[str], FloatArray]
"""names (n); positions (frames, n, 3) mm in the model frame, NaN = missing; the frames are those of the clip."""


def glb(
    speaker: SpeakerModel,
    rebased: Rebased,
    name: str,
    clip: Clip | None = None,
    palate: FloatArray | None = None,
    coils: Coils | None = None,
    directions: Sequence[str] = (),
) -> bytes:
    """The content of a .glb file.

    rebased: the raw weights that become 0 and 1. clip: what the tongue does, as an animation from 0 s on; without one
    the tongue rests at the speaker's mean weights. palate: (p, 3) mm, a line. coils: balls that move with the clip and
    vanish where a coil is missing; one that is never there is left out. directions: the K names of the targets, else
    pose_0, pose_1, ...
    Raises InputError for a clip whose times do not increase, and for a model without faces.
    """
    if not len(speaker.faces):
        raise InputError(f"{name}: a model without faces cannot become a glTF mesh.")
    if coils is not None and (clip is None or len(coils[1]) != len(clip[0])):
        raise InputError("coils need a clip with the same frames.")
    file = _File()
    unit = rebased.to_unit(speaker.mean if clip is None else clip[1])
    names = directions or [f"pose_{k}" for k in range(len(speaker.directions))]
    tongue = _tongue(file, speaker, rebased, name, names, np.atleast_2d(unit)[0])
    file.nodes.append({"name": name, "mesh": tongue})
    if palate is not None:
        file.nodes.append({"name": "palate", "mesh": _line(file, palate)})
    if clip is not None:
        times = _seconds(file, clip[0])
        file.animate(0, "weights", times, file.accessor(unit.reshape(-1, 1)))
        if coils is not None:
            _animate_coils(file, coils, clip[0], times)
    return file.bytes()


def to_scene(points: FloatArray) -> FloatArray:
    """Positions or directions (..., 3) in mm of the model frame, in metres of glTF's axes."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1).astype(np.float64) / 1000.0


@dataclass(frozen=True)
class _Surface:
    """color: red, green, blue, opacity, linear, 0..1; roughness: 0 a mirror, 1 chalk."""

    name: str
    color: tuple[float, float, float, float]
    roughness: float


_TISSUE = _Surface("tissue", (0.72, 0.28, 0.27, 1.0), 0.45)
_BONE = _Surface("palate", (0.85, 0.8, 0.65, 1.0), 0.9)
_METAL = _Surface("coil", (0.95, 0.75, 0.2, 1.0), 0.35)


@dataclass
class _File:
    """The parts of a file, as they come together: arrays in one buffer, and what refers to them."""

    buffer: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    materials: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    nodes: list[dict[str, Any]] = field(default_factory=list)
    samplers: list[dict[str, Any]] = field(default_factory=list)
    channels: list[dict[str, Any]] = field(default_factory=list)

    def accessor(self, rows: Any, purpose: int | None = None, bounds: bool = False) -> int:
        """The number of a new accessor for rows (count, 1 or 3): indices as uint32, everything else as float32."""
        array = np.asarray(rows, dtype="<u4" if purpose == _INDICES else "<f4")
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": array.nbytes}
        if purpose is not None:
            view["target"] = purpose
        self.buffer += array.tobytes()  # every array has a multiple of 4 bytes, so all of them are aligned
        self.views.append(view)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _UINT if purpose == _INDICES else _FLOAT,
            "count": len(array),
            "type": _KINDS[array.shape[1]],
        }
        if bounds:
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def material(self, surface: _Surface) -> int:
        shine = {
            "baseColorFactor": list(surface.color),
            "metallicFactor": 0.0,
            "roughnessFactor": surface.roughness,
        }
        self.materials.append({"name": surface.name, "pbrMetallicRoughness": shine, "doubleSided": True})
        return len(self.materials) - 1

    def mesh(self, name: str, primitive: dict[str, Any], **more: Any) -> int:
        self.meshes.append({"name": name, "primitives": [primitive], **more})
        return len(self.meshes) - 1

    def animate(self, node: int, path: str, times: int, values: int, how: str = "LINEAR") -> None:
        self.samplers.append({"input": times, "output": values, "interpolation": how})
        self.channels.append(
            {"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}},
        )

    def bytes(self) -> bytes:
        content: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"tonguetrack {__version__}"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(self.nodes)))}],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.buffer)}],
        }
        if self.channels:
            content["animations"] = [{"name": "clip", "samplers": self.samplers, "channels": self.channels}]
        text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + len(self.buffer)
        if length > _LARGEST_FILE:
            raise InputError(f"{length} bytes are too many for one .glb file; export fewer frames.")
        head = struct.pack("<IIIII", _MAGIC, _VERSION, length, len(text), _JSON)
        return head + text + struct.pack("<II", len(self.buffer), _BIN) + bytes(self.buffer)


def _tongue(
    file: _File,
    speaker: SpeakerModel,
    rebased: Rebased,
    name: str,
    directions: Sequence[str],
    rest: FloatArray,
) -> int:
    """rest: (K,) re-based weights of the tongue where no animation is played."""
    base = to_scene(rebased.base(speaker).reshape(-1, 3))
    targets = to_scene(rebased.directions(speaker).reshape(len(speaker.directions), -1, 3))
    normal, turns = _linear_normals(base, targets, speaker.faces)
    primitive = {
        "attributes": {
            "POSITION": file.accessor(base, _VERTICES, bounds=True),
            "NORMAL": file.accessor(normal, _VERTICES),
        },
        "indices": file.accessor(speaker.faces.reshape(-1, 1), _INDICES),
        "material": file.material(_TISSUE),
        "targets": [
            {
                "POSITION": file.accessor(target, _VERTICES, bounds=True),
                "NORMAL": file.accessor(turn, _VERTICES),
            }
            for target, turn in zip(targets, turns, strict=True)
        ],
    }
    extras = {
        "targetNames": list(directions),
        "weights_low": rebased.low.tolist(),
        "weights_high": rebased.high.tolist(),
    }
    return file.mesh(name, primitive, weights=np.clip(rest, 0.0, 1.0).tolist(), extras=extras)


def _linear_normals(
    base: FloatArray, targets: FloatArray, faces: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Normals (V, 3) of the base, of length 1, and what each target (K, V, 3) adds to them.

    A vertex's area-weighted normal, before it is given the length 1, is quadratic in the weights. Its value and its
    slopes in the middle of 0..1 are kept: there the sum has exactly the right direction.
    """
    middle = base + 0.5 * targets.sum(axis=0)
    slopes = np.array(
        [_area_normals(middle + t / 2, faces) - _area_normals(middle - t / 2, faces) for t in targets]
    )
    normals = _area_normals(middle, faces) - 0.5 * slopes.sum(axis=0)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    loose = length[:, 0] == 0  # a vertex without a face, or folded: any direction of length 1 will do
    normals[loose], slopes[:, loose], length[loose] = (0.0, 1.0, 0.0), 0.0, 1.0
    return normals / length, slopes / length


def _area_normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """(V, 3) sums of the normals of each vertex's faces, twice their areas long."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    sums = [np.bincount(faces.ravel(), np.repeat(across[:, axis], 3), len(vertices)) for axis in range(3)]
    return np.column_stack(sums)


def _line(file: _File, points: FloatArray) -> int:
    place = file.accessor(to_scene(points), _VERTICES, bounds=True)
    primitive = {
        "attributes": {"POSITION": place},
        "mode": _LINE_STRIP,
        "material": file.material(_BONE),
    }
    return file.mesh("palate", primitive)


def _seconds(file: _File, times_s: FloatArray) -> int:
    """The accessor of key times (keys,), which start at 0 where the clip does."""
    since = (times_s - times_s[0]).astype(np.float32)
    late = np.flatnonzero(~(np.diff(since) > 0))
    if len(late):
        raise InputError(
            f"frame {late[0] + 1} at {times_s[late[0] + 1]:.6f} s does not come after the one before it at "
            f"{times_s[late[0]]:.6f} s, within what glTF can tell apart; an animation needs increasing times."
        )
    return file.accessor(since.reshape(-1, 1), bounds=True)


def _animate_coils(file: _File, coils: Coils, times_s: FloatArray, times: int) -> None:
    """times: the accessor of all frames' times."""
    names, positions = coils
    there = np.asarray(np.isfinite(positions).all(axis=2))  # (frames, n)
    ball = _ball(file) if there.any() else None
    since = times_s - times_s[0]
    for index, name in enumerate(names):
        shown = there[:, index]
        if not shown.any():
            continue
        places = to_scene(positions[shown, index])
        keys = (
            times
            if shown.all()
            else file.accessor(since[shown].astype(np.float32).reshape(-1, 1), bounds=True)
        )
        node: dict[str, Any] = {"name": name, "mesh": ball, "translation": places[0].tolist()}
        file.nodes.append(node)
        number = len(file.nodes) - 1
        file.animate(number, "translation", keys, file.accessor(places))
        if not shown.all():
            changes = np.flatnonzero(np.diff(shown, prepend=not shown[0]))
            sizes = np.repeat(shown[changes, None].astype(np.float64), 3, axis=1)
            node["scale"] = sizes[0].tolist()
            turned = file.accessor(since[changes].astype(np.float32).reshape(-1, 1), bounds=True)
            file.animate(number, "scale", turned, file.accessor(sizes), "STEP")


def _ball(file: _File) -> int:
    """A small sphere round the origin, for all coils."""
    from scipy.spatial import ConvexHull

    count = 80
    up = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)  # the golden angle spreads points evenly
    around = np.sqrt(1 - up**2)
    points = np.column_stack([around * np.cos(angle), up, around * np.sin(angle)])
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    primitive = {
        "attributes": {
            "POSITION": file.accessor(points * (COIL_RADIUS_MM / 1000), _VERTICES, bounds=True),
            "NORMAL": file.accessor(points, _VERTICES),
        },
        "indices": file.accessor(faces.reshape(-1, 1), _INDICES),
        "material": file.material(_METAL),
    }
    return file.mesh("coil", primitive)
