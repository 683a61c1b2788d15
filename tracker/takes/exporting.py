"""What of a take goes into other files."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path

from ... import InputError
from ...atomic import write_atomically
from ...drivers.files.writing import WRITERS, write_recording
from ...model.multilinear import TongueModel
from ..posefiles import POSE_SUFFIXES, check_pose_suffix, write_poses
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
            f"{output}: the {what} of a take can be written as {', '.join(SUFFIXES[what])}; end the name in one of "
            "them, or choose something else with --what."
        )


def export(take: Take, what: str, output: Path, model: Callable[[], TongueModel]) -> str:
    """Writes one of SUFFIXES; a sentence that says what was written.

    model: gives the model that the take belongs to; asked for poses only.
    Raises InputError where the take has none of it, or `output` cannot be written.
    """
    check_export(what, output)
    if what == "poses":
        return _poses(take, output, model())
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


def _poses(take: Take, output: Path, model: TongueModel) -> str:
    check_pose_suffix(output)
    fingerprint = take.info.model_fingerprint
    if output.suffix.lower() == ".json" and model.fingerprint != fingerprint:
        raise InputError(
            f"{take.path}: its poses belong to the model '{take.info.model_name}' [{fingerprint}], not to "
            f"'{model.name}' [{model.fingerprint}]; name that one with --model."
        )
    poses = take.poses()
    write_poses(poses, model, output)
    return f"{output}: {poses.frame_count} poses of {len(poses.roles)} coils"
