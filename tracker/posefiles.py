"""Poses as files: CSV and NPZ (everything), and the JSON list that the authors' tracker writes.

The authors' layout, one map a frame: energy, error (mean distance, mm), timeStamp (s), source (the
model's points) and target (the coils) as lists of {x, y, z}, speakerWeights, phonemeWeights, and
speakerVariations, phonemeVariations = (weight - mean) * sqrt(training entries). A missing coil is left
out of both lists; a frame without any has empty lists and zeros for energy and error, as JSON has no NaN.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from .. import InputError
from ..archive import read_arrays
from ..atomic import write_atomically
from ..model.multilinear import TongueModel
from .pose import FloatArray, PoseStatus, TrackedPoses

POSE_SUFFIXES = (".csv", ".json", ".npz")
FORMAT_NAME = "tonguetrack poses"
FORMAT_VERSION = 1
MAX_POSE_BYTES = 4 * 1024**3
_HEADER_FIELDS = ("model_path", "model_fingerprint", "model_name", "recording", "rate_hz", "experiment")


def check_pose_suffix(path: str | Path) -> None:
    """Raises InputError for a name that `write_poses` could not write."""
    if Path(path).suffix.lower() not in POSE_SUFFIXES:
        raise InputError(
            f"{path}: poses are written as {', '.join(POSE_SUFFIXES)}; end the name in one of them."
        )


def write_poses(poses: TrackedPoses, model: TongueModel, path: str | Path) -> None:
    """Writes poses to the format that the suffix names; the file appears whole or not at all."""
    check_pose_suffix(path)
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        content = _csv_text(poses).encode()
    elif suffix == ".json":
        content = authors_json(poses, model).encode()
    else:
        content = _npz_bytes(poses)
    write_atomically(path, content)


def read_poses(path: str | Path, model: TongueModel | None = None) -> TrackedPoses:
    """Reads what `write_poses` wrote. The authors' JSON keeps no means, so it takes the model's.

    Raises InputError for a missing, foreign or damaged file.
    """
    path = Path(path)
    check_pose_suffix(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such poses file.")
    if path.stat().st_size > MAX_POSE_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a poses file.")
    suffix = path.suffix.lower()
    try:
        if suffix == ".csv":
            return _from_csv(path.read_text(encoding="utf-8"))
        if suffix == ".npz":
            return _from_npz(path.read_bytes())
        return _from_authors_json(json.loads(path.read_text(encoding="utf-8")), model)
    except InputError as reason:
        raise InputError(f"{path}: {reason}") from reason
    except Exception as reason:  # whatever a damaged file makes the parsers stumble over
        raise InputError(
            f"{path}: this is not a readable poses file ({type(reason).__name__}: {str(reason)[:100]})."
        ) from reason


# The authors' JSON ----------------------------------------------------------------------------------


def authors_json(poses: TrackedPoses, model: TongueModel) -> str:
    """The poses as the list that the authors' offline tracker writes."""
    speaker_variations = model.speaker.normalised(poses.speaker_weights)
    frames = []
    for t in range(poses.frame_count):
        present = ~np.isnan(poses.coils[t, :, 0])
        fitted = poses.vertices[t][present] if poses.vertices is not None else np.zeros((0, 3))
        frames.append(
            {
                "energy": _or_zero(poses.energies[t]),
                "error": _or_zero(poses.residual_mm[t]),
                "timeStamp": float(poses.times_s[t]),
                "source": [dict(zip("xyz", point)) for point in fitted.tolist()],
                "target": [dict(zip("xyz", point)) for point in poses.coils[t][present].tolist()],
                "speakerWeights": poses.speaker_weights[t].tolist(),
                "speakerVariations": speaker_variations[t].tolist(),
                "phonemeWeights": poses.weights[t].tolist(),
                "phonemeVariations": poses.normalised[t].tolist(),
            }
        )
    return json.dumps(frames, allow_nan=False) + "\n"


def _or_zero(value: float) -> float:
    return float(value) if np.isfinite(value) else 0.0


def _from_authors_json(content: Any, model: TongueModel | None) -> TrackedPoses:
    if model is None:
        raise InputError("the authors' JSON does not say which model it belongs to; name it with --model.")
    if not isinstance(content, list) or not content:
        raise InputError("expected a list with one map a frame, as the authors' tracker writes it.")
    weights = np.array([frame["phonemeWeights"] for frame in content], dtype=np.float64)
    speakers = np.array([frame["speakerWeights"] for frame in content], dtype=np.float64)
    if weights.shape[1:] != (model.pose.size,) or speakers.shape[1:] != (model.speaker.size,):
        raise InputError(
            f"it has {speakers.shape[-1]} speaker and {weights.shape[-1]} pose weights a frame; the model "
            f"'{model.name}' has {model.speaker.size} and {model.pose.size}."
        )
    coils = max(len(frame["target"]) for frame in content)
    targets = np.full((len(content), coils, 3), np.nan)
    for row, frame in enumerate(content):
        if len(frame["target"]) == coils:
            targets[row] = [[point[axis] for axis in "xyz"] for point in frame["target"]]
    times = np.array([frame["timeStamp"] for frame in content], dtype=np.float64)
    steps = np.diff(times)
    return TrackedPoses(
        times_s=times,
        statuses=np.array(
            [PoseStatus.OK if f["target"] else PoseStatus.HELD for f in content], dtype=np.int64
        ),
        weights=weights,
        normalised=model.pose.normalised(weights),
        speaker_weights=speakers,
        energies=np.array([frame["energy"] for frame in content], dtype=np.float64),
        residual_mm=np.array([frame["error"] for frame in content], dtype=np.float64),
        residuals_mm=np.full((len(content), coils), np.nan),
        coils=targets,
        vertices=None,
        roles=tuple(f"coil_{index + 1}" for index in range(coils)),
        correspondences=(),
        experiment=2 if (speakers == speakers[0]).all() else 1,
        rate_hz=float(1.0 / np.median(steps)) if len(steps) and np.median(steps) > 0 else float("nan"),
        model_fingerprint=model.fingerprint,
        model_name=model.name,
    )


# CSV ------------------------------------------------------------------------------------------------


def _csv_text(poses: TrackedPoses) -> str:
    """Comment lines with what belongs to the whole take, then one row a frame; an empty cell = missing."""
    stream = io.StringIO()
    stream.write(f"# {FORMAT_NAME} {FORMAT_VERSION}\n")
    for name in _HEADER_FIELDS:
        stream.write(f"# {name}: {getattr(poses, name)}\n")
    pairs = (f"{role}={vertex}" for role, vertex in zip(poses.roles, poses.correspondences, strict=True))
    stream.write(f"# correspondences: {' '.join(pairs)}\n")
    columns, names = _columns(poses)
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["frame", "time_s", "status", *names])
    for t in range(poses.frame_count):
        cells = ["" if np.isnan(value) else repr(float(value)) for value in columns[t]]
        status = PoseStatus(int(poses.statuses[t])).name.lower()
        writer.writerow([t, repr(float(poses.times_s[t])), status, *cells])
    return stream.getvalue()


def _columns(poses: TrackedPoses) -> tuple[FloatArray, list[str]]:
    size, speakers = poses.weights.shape[1], poses.speaker_weights.shape[1]
    names = [f"pose_{k + 1}" for k in range(size)]
    names += [f"pose_{k + 1}_sigma" for k in range(size)]
    names += [f"speaker_{k + 1}" for k in range(speakers)]
    names += ["energy", "residual_mm"]
    names += [f"residual_mm_{role}" for role in poses.roles]
    names += [f"{role}_{axis}_mm" for role in poses.roles for axis in "xyz"]
    frames = poses.frame_count
    parts = [poses.weights, poses.normalised, poses.speaker_weights, poses.energies, poses.residual_mm]
    parts += [poses.residuals_mm, poses.coils.reshape(frames, -1)]
    return np.column_stack(parts), names


def _from_csv(text: str) -> TrackedPoses:
    lines = text.splitlines()
    if not lines or not lines[0].startswith(f"# {FORMAT_NAME} "):
        raise InputError(
            f"the first line should be '# {FORMAT_NAME} {FORMAT_VERSION}'; this is another kind of CSV."
        )
    _check_version(lines[0].rsplit(" ", 1)[1])
    header = dict(line[2:].split(": ", 1) for line in lines[1:] if line.startswith("# ") and ": " in line)
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    if len(rows) < 2:
        raise InputError("there are no frames in it.")
    names, body = rows[0], rows[1:]
    for number, row in enumerate(body):
        if len(row) != len(names):
            raise InputError(
                f"frame {number} has {len(row)} cells, expected {len(names)}; is the file cut off?"
            )
    column = {name: index for index, name in enumerate(names)}
    table = np.array(
        [[float(cell) if cell else np.nan for cell in [*row[:2], *row[3:]]] for row in body], dtype=np.float64
    )
    table = np.insert(table, 2, 0.0, axis=1)
    statuses = np.array([PoseStatus[row[2].upper()] for row in body], dtype=np.int64)
    pairs = dict(pair.split("=") for pair in header.get("correspondences", "").split())
    roles = tuple(pairs)

    def numbered(pattern: str) -> FloatArray:
        found: list[int] = []
        while pattern.format(len(found) + 1) in column:
            found.append(column[pattern.format(len(found) + 1)])
        return table[:, found]

    return TrackedPoses(
        times_s=table[:, column["time_s"]],
        statuses=statuses,
        weights=numbered("pose_{}"),
        normalised=numbered("pose_{}_sigma"),
        speaker_weights=numbered("speaker_{}"),
        energies=table[:, column["energy"]],
        residual_mm=table[:, column["residual_mm"]],
        residuals_mm=table[:, [column[f"residual_mm_{role}"] for role in roles]],
        coils=table[:, [column[f"{r}_{axis}_mm"] for r in roles for axis in "xyz"]].reshape(len(body), -1, 3),
        vertices=None,
        roles=roles,
        correspondences=tuple(int(vertex) for vertex in pairs.values()),
        experiment=int(header["experiment"]),
        rate_hz=float(header["rate_hz"]),
        model_path=header.get("model_path", ""),
        model_fingerprint=header.get("model_fingerprint", ""),
        model_name=header.get("model_name", ""),
        recording=header.get("recording", ""),
    )


# NPZ ------------------------------------------------------------------------------------------------

_ARRAYS = (
    "times_s", "statuses", "weights", "normalised", "speaker_weights", "energies", "residual_mm",
    "residuals_mm", "coils", "vertices",
)  # fmt: skip


def _npz_bytes(poses: TrackedPoses) -> bytes:
    header: dict[str, Any] = {"format": FORMAT_NAME, "version": FORMAT_VERSION}
    header.update({name: getattr(poses, name) for name in _HEADER_FIELDS})
    header.update(roles=list(poses.roles), correspondences=list(poses.correspondences))
    arrays = {name: getattr(poses, name) for name in _ARRAYS if getattr(poses, name) is not None}
    stream = io.BytesIO()
    coded = np.frombuffer(json.dumps(header, ensure_ascii=False).encode(), dtype=np.uint8)
    np.savez_compressed(stream, header=coded, **arrays)
    return stream.getvalue()


def _from_npz(data: bytes) -> TrackedPoses:
    stored = read_arrays(data, MAX_POSE_BYTES)
    if "header" not in stored:
        raise InputError("this .npz does not hold poses (it has no 'header').")
    header = json.loads(stored["header"].tobytes().decode())
    if header.get("format") != FORMAT_NAME:
        raise InputError(f"this .npz holds '{header.get('format')}', not '{FORMAT_NAME}'.")
    _check_version(header["version"])
    arrays: dict[str, Any] = {name: stored.get(name) for name in _ARRAYS}
    frames = len(arrays["times_s"])
    for name, array in arrays.items():
        if array is not None and (len(array) != frames or array.dtype.kind not in "fi"):
            raise InputError(
                f"'{name}' has {len(array)} rows of {array.dtype}, expected {frames} rows of numbers."
            )
    fields: dict[str, Any] = {name: header[name] for name in _HEADER_FIELDS}
    return TrackedPoses(
        **arrays, **fields, roles=tuple(header["roles"]), correspondences=tuple(header["correspondences"])
    )


def _check_version(version: object) -> None:
    if str(version) != str(FORMAT_VERSION):
        raise InputError(f"the poses have format version {version}; this tonguetrack reads {FORMAT_VERSION}.")
