"""A corpus: many recordings tracked into one folder, a file of poses each. What is there already is not made again.

Beside every file of poses, in the folder .corpus, stands what it was made from. Each recording keeps its own such stamp,
written after its poses, so that a run that ends early, on one machine or on several, goes on where it stopped.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .. import InputError, __version__
from ..atomic import write_atomically
from ..drivers import Recording, open_recording
from ..drivers.files import ssff
from ..drivers.files.recognise import read_head
from ..model import TongueModel, load_model
from .bundled import bundled_model
from .pose import PoseStatus, TrackedPoses
from .posefiles import write_poses
from .session import Session, session_toml
from .status import MISPLACED_MM
from .tracking import track_recording

STAMPS = ".corpus"
SUMMARY = "summary.csv"
LEFT_OUT = "left_out.csv"
SESSION_OF_A_FOLDER = "session.toml"
SESSION_OF_A_RECORDING = ".session.toml"  # after the recording's stem
MAX_STAMP_BYTES = 1_000_000
MISSING_SHARE = 0.1
"""A coil that is missing in more of the frames than this is a problem that the summary names."""
TRACKED, UNCHANGED, FAILED = "tracked", "unchanged", "failed"
COLUMNS = (
    "recording", "poses", "session", "state", "frames", "seconds", "real_time_factor", "median_residual_mm", "problems",
)  # fmt: skip


@dataclass(frozen=True)
class Way:
    """How all recordings are tracked.

    start, folder: absolute; where relative names of recordings start, and where poses and stamps go; model: a file, or
    "bundled"; fingerprint: that model's; experiments: 1, 2 or both; rate_hz, unit, layout: what files do not say
    themselves, as open_recording takes it; again: also what is unchanged.
    """

    start: Path
    folder: Path
    model: str
    fingerprint: str
    experiments: tuple[int, ...] = (2,)
    rate_hz: float | None = None
    unit: str | None = None
    layout: str | None = None
    again: bool = False


@dataclass(frozen=True)
class Task:
    """One recording. path: as it was named; poses: experiment -> file, below the folder of the way; session_file: "" =
    there is none, everything is estimated."""

    path: Path
    poses: dict[int, Path]
    session: Session
    session_file: str = ""


@dataclass(frozen=True)
class Row:
    """A recording in the summary.

    seconds: its duration; real_time_factor: time it took for each second of it (below 1: faster than it was spoken);
    median_residual_mm: over the tracked frames, of experiment 2 where there is one.
    """

    recording: str
    poses: tuple[str, ...]
    session: str
    state: str
    frames: int | None = None
    seconds: float | None = None
    real_time_factor: float | None = None
    median_residual_mm: float | None = None
    problems: tuple[str, ...] = ()


def session_beside(recording: Path, root: Path) -> Path | None:
    """The session file that belongs to a recording below the folder `root`; None where there is none.

    STEM.session.toml beside it, else the session.toml in its folder or the nearest folder above, up to `root`.
    """
    own = recording.with_name(recording.stem + SESSION_OF_A_RECORDING)
    if own.is_file():
        return own
    for folder in recording.parents:
        if (folder / SESSION_OF_A_FOLDER).is_file():
            return folder / SESSION_OF_A_FOLDER
        if folder == root:
            break
    return None


def track_task(way: Way, task: Task) -> Row:
    """Tracks one recording as `tonguetrack track` does and writes its poses; unless they are there and would be the same.

    Raises InputError where the recording cannot be read or tracked, or where its poses would replace another's.
    """
    path = way.start / task.path
    try:
        return _track(way, task, path)
    except InputError as reason:  # by the name that was given
        raise InputError(str(reason).replace(str(path), str(task.path))) from reason


def _track(way: Way, task: Task, path: Path) -> Row:
    begin = time.perf_counter()
    whole = str(path.resolve())
    outputs = {experiment: way.folder / name for experiment, name in task.poses.items()}
    stamped = stamp_of(way.folder, task)
    key = _key(way, task, path)
    stamp = _read_stamp(stamped)
    if stamp is not None and stamp["recording"] != whole and Path(stamp["recording"]).exists():
        raise InputError(
            f"{path}: its poses would replace those of {stamp['recording']}; choose another folder, or name the folder "
            "above both."
        )
    if not way.again and stamp is not None and (stamp["key"], stamp["poses"]) == (key, _digests(outputs)):
        return replace(
            _row(stamp["row"]), recording=str(task.path), session=task.session_file, state=UNCHANGED
        )

    model = _model(way.model, way.fingerprint)
    recording = open_recording(path, rate_hz=way.rate_hz, unit=way.unit, layout=way.layout)
    recording = replace(recording, source=str(task.path))
    run = track_recording(recording, model, task.session, way.experiments)
    found = [poses for poses in (run.experiment_1, run.experiment_2) if poses is not None]
    for poses in found:
        outputs[poses.experiment].parent.mkdir(parents=True, exist_ok=True)
        write_poses(replace(poses, model_path=way.model), model, outputs[poses.experiment])
    row = _judged(recording, found[-1], task, time.perf_counter() - begin)
    entry = {"recording": whole, "key": key, "poses": _digests(outputs), "row": asdict(row)}
    stamped.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(stamped, json.dumps(entry).encode())
    return row


def stamp_of(folder: Path, task: Task) -> Path:
    """What says, beside the poses in this folder, what they were made from."""
    first = next(iter(task.poses.values()))
    return folder / STAMPS / first.with_name(first.name + ".json")


def failed(task: Task, reason: str) -> Row:
    """The row of a recording that could not be tracked."""
    sentence = reason if str(task.path) in reason else f"{task.path}: {reason}"
    return Row(str(task.path), (), task.session_file, FAILED, problems=(sentence,))


def write_summary(rows: Iterable[Row], folder: Path) -> Path:
    """One line a recording, as CSV; an empty cell is a missing value. Returns the file."""
    lines: list[Sequence[object]] = [COLUMNS]
    for row in rows:
        values = [getattr(row, name) for name in COLUMNS]
        lines.append(tuple("; ".join(v) if isinstance(v, tuple) else "" if v is None else v for v in values))
    return write_atomically(folder / SUMMARY, _table(lines))


def write_left_out(left_out: Sequence[tuple[Path, str]], folder: Path) -> Path:
    """The files that are no recordings, each with the reason, as CSV. Returns the file."""
    return write_atomically(folder / LEFT_OUT, _table([("file", "reason"), *left_out]))


def _table(lines: Iterable[Sequence[object]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue().encode("utf-8", "backslashreplace")


def _judged(recording: Recording, poses: TrackedPoses, task: Task, took_s: float) -> Row:
    tracked = poses.tracked
    without_coils = poses.frame_count - int((poses.statuses == PoseStatus.OK).sum())
    problems = []
    if without_coils:
        problems.append(f"{without_coils} of {poses.frame_count} frames without any coil")
    for role, missing in zip(poses.roles, np.isnan(poses.coils[:, :, 0]).mean(axis=0), strict=True):
        if missing > MISSING_SHARE:
            problems.append(f"{role} is missing in {100 * missing:.0f} % of the frames")
    mean = float(poses.residual_mm[tracked].mean())
    if mean > MISPLACED_MM:
        problems.append(f"mean residual {mean:.1f} mm: the coils do not lie where the model's tongue is")
    return Row(
        str(task.path),
        tuple(str(file) for file in task.poses.values()),
        task.session_file,
        TRACKED,
        recording.frame_count,
        round(recording.duration_s, 3),
        round(took_s / recording.duration_s, 4) if recording.duration_s > 0 else None,
        round(float(np.median(poses.residual_mm[tracked])), 4),
        tuple(problems),
    )


@lru_cache(maxsize=1)
def _model(name: str, fingerprint: str) -> TongueModel:
    model = bundled_model() if name == "bundled" else load_model(name)
    if model.fingerprint != fingerprint:
        raise InputError(
            f"{name}: this model is [{model.fingerprint}] here, but [{fingerprint}] where the run was started."
        )
    return model


def _key(way: Way, task: Task, path: Path) -> str:
    """A digest of everything that the poses depend on: the recording's and the session's content, not their names."""
    stated = [__version__, way.fingerprint, way.experiments, way.rate_hz, way.unit, way.layout]
    digest = hashlib.sha256(repr(stated).encode())
    digest.update(session_toml(task.session).encode())
    for file in _files_of(path):
        digest.update(f"{file.name} {_digest(file)}".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _files_of(path: Path) -> list[Path]:
    """Every file that is read where this recording is opened: SSFF has one a coil."""
    if not ssff.is_ssff(read_head(path).data):
        return [path]
    same_stem = (file for file in path.parent.iterdir() if file.stem == path.stem and file.is_file())
    return sorted(file for file in same_stem if ssff.is_ssff(read_head(file).data))


def _digest(file: Path) -> str:
    try:
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error}).") from error


def _digests(outputs: dict[int, Path]) -> list[str] | None:
    """Of the files of poses; None where one is not there."""
    if not all(file.is_file() for file in outputs.values()):
        return None
    return [_digest(file) for file in outputs.values()]


def _read_stamp(path: Path) -> dict[str, Any] | None:
    """A damaged stamp is none: its recording is tracked again."""
    try:
        if path.stat().st_size > MAX_STAMP_BYTES:
            return None
        stamp = json.loads(path.read_bytes())
        _row(stamp["row"])
        return stamp if isinstance(stamp["recording"], str) and {"key", "poses"} <= set(stamp) else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _row(stored: dict[str, Any]) -> Row:
    row = Row(**stored)
    return replace(row, poses=tuple(row.poses), problems=tuple(row.problems))
