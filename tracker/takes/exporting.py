"""What of a take goes into other files."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ... import InputError
from ...atomic import write_atomically
from ...drivers.files.writing import WRITERS, write_recording
from ...model.multilinear import TongueModel
from ..pose import FloatArray, TrackedPoses
from ..posefiles import POSE_SUFFIXES, write_poses
from .reading import Take

SUFFIXES = {
    "recording": tuple(WRITERS),
    "prepared": tuple(WRITERS),
    "poses": POSE_SUFFIXES,
    "session": (".toml",),
    "markers": (".csv",),
}
"""What can be exported -> the endings of names that it can be written to."""


def check_export(what: str, output: Path) -> None:
    """Raises InputError for a name whose ending does not fit."""
    if output.suffix.lower() not in SUFFIXES[what]:
        raise InputError(
            f"{output}: {what} of a take can be written as {', '.join(SUFFIXES[what])}; end the name in one of "
            "them, or choose something else with --what."
        )


def export(take: Take, what: str, output: Path, model: Callable[[], TongueModel], model_path: str) -> str:
    """Writes one of SUFFIXES; a sentence that says what was written.

    model, model_path: gives the model that the take belongs to, and where it is; asked for poses only. Where it
    is another one, poses are written without its place, or not at all as .json.
    Raises InputError where the take has none of it, or `output` cannot be written.
    """
    check_export(what, output)
    if what == "poses":
        return _poses(take, output, model(), model_path)
    if what == "session":
        row, text = take.sessions[-1]
        write_atomically(output, text.encode())
        return f"{output}: the session that holds {f'from frame {row} on' if row else 'for the whole take'}"
    if what == "markers":
        write_atomically(output, markers_csv(take).encode())
        return f"{output}: {len(take.markers)} markers"
    recording = take.recording() if what == "recording" else take.prepared_recording()
    write_recording(recording, output)
    return f"{output}: {recording.frame_count} frames of {len(recording.coils)} coils, mm ({recording.frame})"


def markers_csv(take: Take) -> str:
    """time_s since the first frame, frame (from 0) that comes next, kind (user or the program's word), text."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["time_s", "frame", "kind", "text"])
    for mark in take.markers:
        writer.writerow([repr(mark.time_s), mark.row, mark.word or "user", mark.content])
    return out.getvalue()


def _poses(take: Take, output: Path, model: TongueModel, model_path: str) -> str:
    info, fingerprint = take.info, take.info.model_fingerprint
    matches = (
        model.fingerprint == fingerprint
        and (len(info.pose_mean), info.speaker_size) == (model.pose.size, model.speaker.size)
        and all(0 <= vertex < model.vertex_count for vertex in info.vertices)
    )
    if output.suffix.lower() == ".json" and not matches:
        raise InputError(
            f"{take.path}: its poses belong to the model '{info.model_name}' [{fingerprint}], not to "
            f"'{model.name}' [{model.fingerprint}]; name that one with --model."
        )
    poses = replace(take.poses(), model_path=model_path if matches else "")
    if matches:
        poses = replace(poses, vertices=_fitted(poses, model))
    write_poses(poses, model, output)
    return f"{output}: {poses.frame_count} poses of {len(poses.roles)} coils"


def _fitted(poses: TrackedPoses, model: TongueModel) -> FloatArray:
    """(frames, n, 3) the model's points that the coils were fitted to, mm; a take does not keep them."""
    points = model.at(poses.correspondences)
    flat = points.origin + np.einsum(
        "tl,tk,lkr->tr", poses.speaker_weights, poses.weights, points.core, optimize=True
    )
    return flat.reshape(poses.frame_count, -1, 3)
