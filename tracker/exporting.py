"""Tracked poses as files for other programs: an animated glTF, meshes frame by frame, a table, arrays.

A take's tongue is linear: base + K directions x K coefficients. With a fixed speaker the coefficients are the pose
weights. Where the speaker was free, v(s, p) is linear in the products s_i p_j, so those are the coefficients.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .. import InputError
from ..atomic import write_atomically
from ..model.mesh import MESH_SUFFIXES, FloatArray, Mesh, mesh_bytes
from ..model.midsagittal import midsagittal_vertices
from ..model.multilinear import SpeakerModel, TongueModel
from ..model.rebasing import Rebased
from .gltf import glb
from .palate import Palate
from .pose import PoseStatus, TrackedPoses

EXPORT_SUFFIXES = (".glb", *MESH_SUFFIXES, ".csv", ".npz")
_CHUNK_FRAMES = 64  # are in memory at a time as whole meshes


@dataclass(frozen=True)
class Motion:
    """speaker: base and K directions; weights: (frames, K); names: (K,) of the directions."""

    speaker: SpeakerModel
    weights: FloatArray
    names: tuple[str, ...]

    def points(self, vertices: Sequence[int]) -> FloatArray:
        """(frames, vertices, 3) mm of these vertices."""
        seen = self.speaker.at(vertices)
        return np.asarray((seen.base + self.weights @ seen.directions).reshape(len(self.weights), -1, 3))


def motion_of(model: TongueModel, poses: TrackedPoses, frames: Sequence[int]) -> Motion:
    """What the tongue does in these frames of a take, exactly, whether the speaker was fixed or free."""
    speakers, weights = poses.speaker_weights[frames], poses.weights[frames]
    if (speakers == speakers[0]).all():
        names = tuple(f"pose_{k}" for k in range(model.pose.size))
        return Motion(model.for_speaker(speakers[0]), weights, names)
    products = np.einsum("fs,fp->fsp", speakers, weights).reshape(len(weights), -1)
    mean = np.outer(model.speaker.mean, model.pose.mean).ravel()
    spread = np.hypot(
        np.outer(model.speaker.sigma, np.hypot(model.pose.mean, model.pose.sigma)),
        np.outer(model.speaker.mean, model.pose.sigma),
    ).ravel()  # of a product of two independent numbers
    directions = model.core.reshape(len(mean), -1)
    names = tuple(f"speaker_{s}_pose_{p}" for s in range(model.speaker.size) for p in range(model.pose.size))
    return Motion(SpeakerModel(model.origin, directions, model.faces, mean, spread), products, names)


def check_export_suffix(path: Path) -> None:
    """Raises InputError for a name that nothing here could write."""
    if path.suffix.lower() not in EXPORT_SUFFIXES:
        raise InputError(
            f"{path}: poses are exported as {', '.join(EXPORT_SUFFIXES)}; end the name in one of them."
        )


def motion_glb(
    model: TongueModel,
    poses: TrackedPoses,
    frames: Sequence[int],
    palate: Palate | None = None,
    coils: bool = False,
    sigmas: float | None = None,
) -> tuple[bytes, int]:
    """The take as an animated glTF, and how many of its frames leave 0..1.

    The raw weights that become 0 and 1 are the smallest and largest of the frames, or mean -+ `sigmas` sigma for a
    model that will be driven live as well; only then can a frame be outside, and a program that clamps shows it wrong.
    Raises InputError for coils where there are none.
    """
    motion = motion_of(model, poses, frames)
    if sigmas is None:
        rebased = Rebased.of_clip(motion.weights)
    else:
        rebased = Rebased.of_range(motion.speaker.mean, motion.speaker.sigma, sigmas)
    outside = (np.abs(rebased.to_unit(motion.weights) - 0.5) > 0.5 + 1e-9).any(axis=1)
    shown = (poses.roles, poses.coils[frames]) if coils else None
    if shown is not None and np.isnan(shown[1]).all():
        raise InputError("there is no coil in any of these poses, so none can be shown.")
    line = None if palate is None else palate.line
    clip = (poses.times_s[frames], motion.weights)
    content = glb(motion.speaker, rebased, model.name, clip, line, shown, motion.names)
    return content, int(outside.sum())


def numbered(target: Path, frame: int) -> Path:
    """tongue.ply -> tongue_000042.ply."""
    return target.with_name(f"{target.stem}_{frame:06d}{target.suffix}")


def frame_mesh(model: TongueModel, poses: TrackedPoses, frame: int) -> Mesh:
    """The whole tongue of one frame, mm in the model frame."""
    return Mesh(model.vertices(poses.speaker_weights[frame], poses.weights[frame]), model.faces)


def write_mesh_sequence(model: TongueModel, poses: TrackedPoses, frames: Sequence[int], target: Path) -> None:
    """One mesh a frame beside `target` (.ply or .obj), numbered by the frames."""
    for frame in frames:
        write_atomically(numbered(target, frame), mesh_bytes(frame_mesh(model, poses, frame), target.suffix))


def motion_csv(model: TongueModel, poses: TrackedPoses, frames: Sequence[int]) -> Iterator[str]:
    """A table with one row a frame: weights, the points of the tongue under the coils, the mid-sagittal contour.

    In parts, the first of which is the line of column names. Positions in mm in the model frame.
    """
    contour = midsagittal_vertices(model)
    motion = motion_of(model, poses, frames)
    size = poses.weights.shape[1]
    names = ["frame", "time_s", "status", *(f"pose_{k + 1}" for k in range(size))]
    names += [f"pose_{k + 1}_sigma" for k in range(size)]
    names += [f"{role}_surface_{axis}_mm" for role, _ in _coil_vertices(poses) for axis in "xyz"]
    names += [f"contour_{i + 1}_{axis}_mm" for i in range(len(contour)) for axis in "yz"]
    yield ",".join(names) + "\n"
    under = motion.points([vertex for _, vertex in _coil_vertices(poses)]).reshape(len(frames), -1)
    curve = motion.points(contour.tolist())[:, :, 1:].reshape(len(frames), -1)
    for row, frame in enumerate(frames):
        numbers = np.concatenate([poses.weights[frame], poses.normalised[frame]]).tolist()
        places = np.concatenate([under[row], curve[row]]).tolist()
        yield (
            ",".join(
                [
                    f"{frame}",
                    repr(float(poses.times_s[frame])),
                    PoseStatus(int(poses.statuses[frame])).name.lower(),
                    *map(repr, numbers),
                    *(f"{place:.5f}" for place in places),
                ]
            )
            + "\n"
        )


def _coil_vertices(poses: TrackedPoses) -> list[tuple[str, int]]:
    """Role and vertex of each coil; none where a file does not keep the vertices."""
    return list(zip(poses.roles, poses.correspondences, strict=False))


def write_motion_npz(model: TongueModel, poses: TrackedPoses, frames: Sequence[int], file: BinaryIO) -> None:
    """All vertices of all frames, (frames, V, 3) float32 mm, with what belongs to them, for `numpy.load`.

    Written piece by piece: a long take's vertices need not fit into memory. Nothing in it needs pickle.
    """
    motion = motion_of(model, poses, frames)
    arrays: dict[str, Any] = {
        "frames": np.asarray(frames, dtype=np.int64),
        "times_s": poses.times_s[frames],
        "statuses": poses.statuses[frames],
        "weights": poses.weights[frames],
        "normalised": poses.normalised[frames],
        "speaker_weights": poses.speaker_weights[frames],
        "faces": model.faces,
        "contour": midsagittal_vertices(model).astype(np.int32),
        "coils": poses.coils[frames],
        "roles": np.array(poses.roles, dtype=np.str_),
        "correspondences": np.array(poses.correspondences, dtype=np.int32),
    }
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)
        shape = (len(frames), model.vertex_count, 3)
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        with archive.open("vertices.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)
            for begin in range(0, len(frames), _CHUNK_FRAMES):
                part = motion.weights[begin : begin + _CHUNK_FRAMES] @ motion.speaker.directions
                member.write((motion.speaker.base + part).astype("<f4").tobytes())
