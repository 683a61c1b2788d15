"""Poses as files: CSV and NPZ (everything), and the JSON list that the authors' tracker writes.

The authors' layout, one map a frame: energy, error (mean distance, mm), timeStamp (s), source (the
model's points) and target (the coils) as lists of {x, y, z}, speakerWeights, phonemeWeights, and
speakerVariations, phonemeVariations = (weight - mean) * sqrt(training entries). A missing coil is left
out of both lists; a frame without any has empty lists and zeros for energy and error, as JSON has no NaN.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from ..archive import read_arrays
from ..atomic import write_atomically
from ..model.multilinear import TongueModel
from .pose import FloatArray, PoseStatus, TrackedPoses

POSE_SUFFIXES = (".csv", ".json", ".npz")
FORMAT_NAME = "tonguetrack poses"
FORMAT_VERSION = 1
MAX_POSE_BYTES = 4 * 1024**3
CHUNK_FRAMES = 4096  # are turned into text, or back, at a time
_HEADER_FIELDS = ("model_path", "model_fingerprint", "model_name", "recording", "rate_hz", "experiment")


def check_pose_suffix(path: str | Path) -> None:
    """Raises InputError for a name that `write_poses` could not write."""
    if Path(path).suffix.lower() not in POSE_SUFFIXES:
        from_take = "; `tonguetrack take export --what poses` gets them out of a take"
        raise InputError(
            f"{path}: poses are written as {', '.join(POSE_SUFFIXES)}; end the name in one of them"
            f"{from_take if Path(path).suffix.lower() == '.xdf' else ''}."
        )


def write_poses(poses: TrackedPoses, model: TongueModel, path: str | Path) -> None:
    """Writes poses to the format that the suffix names; the file appears whole or not at all."""
    check_pose_suffix(path)
    suffix = Path(path).suffix.lower()

    def write(file: BinaryIO) -> None:
        if suffix == ".npz":
            _write_npz(poses, file)
            return
        parts = _csv_parts(poses) if suffix == ".csv" else _authors_json_parts(poses, model)
        file.writelines(text.encode() for text in parts)

    write_atomically(path, write)


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
            with path.open(encoding="utf-8", newline="") as file:
                return _with_shapes(_from_csv(file))
        if suffix == ".npz":
            return _with_shapes(_from_npz(path.read_bytes()))
        return _with_shapes(_from_authors_json(json.loads(path.read_text(encoding="utf-8")), model))
    except InputError as reason:
        raise InputError(f"{path}: {reason}") from reason
    except Exception as reason:  # whatever a damaged file makes the parsers stumble over
        raise InputError(
            f"{path}: this is not a readable poses file ({type(reason).__name__}: {str(reason)[:100]})."
        ) from reason


def _with_shapes(poses: TrackedPoses) -> TrackedPoses:
    """The poses; raises InputError where a frame's weights are no numbers, of which no tongue can be made."""
    wrong = np.flatnonzero(~poses.have_shape)
    if len(wrong):
        raise InputError(f"frame {wrong[0]} has weights that are no numbers; the file is damaged.")
    return poses


# The authors' JSON ----------------------------------------------------------------------------------


def _authors_json_parts(poses: TrackedPoses, model: TongueModel) -> Iterator[str]:
    """The list that the authors' offline tracker writes, one frame after the other."""
    speaker_variations = model.speaker.normalised(poses.speaker_weights)
    for t in range(poses.frame_count):
        present = ~np.isnan(poses.coils[t, :, 0])
        fitted = poses.vertices[t][present] if poses.vertices is not None else np.zeros((0, 3))
        frame = {
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
        yield (", " if t else "[") + json.dumps(frame, allow_nan=False)
    yield "]\n"


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


def _csv_parts(poses: TrackedPoses) -> Iterator[str]:
    """Comment lines with what belongs to the whole take, then one row a frame; an empty cell = missing."""
    yield f"# {FORMAT_NAME} {FORMAT_VERSION}\n"
    for name in _HEADER_FIELDS:
        yield f"# {name}: {_one_line(str(getattr(poses, name)))}\n"
    pairs = (f"{role}={vertex}" for role, vertex in zip(poses.roles, poses.correspondences, strict=True))
    yield f"# correspondences: {' '.join(pairs)}\n"
    yield ",".join(["frame", "time_s", "status", *_column_names(poses)]) + "\n"
    words = {int(status): status.name.lower() for status in PoseStatus}
    for begin in range(0, poses.frame_count, CHUNK_FRAMES):
        part = slice(begin, begin + CHUNK_FRAMES)
        starts = zip(poses.times_s[part].tolist(), poses.statuses[part].tolist(), strict=True)
        lines = [
            f"{t},{time_s!r},{words[status]},{','.join(map(repr, row))}\n"
            for t, ((time_s, status), row) in enumerate(
                zip(starts, _columns(poses, part).tolist(), strict=True), begin
            )
        ]
        yield "".join(lines).replace(",nan", ",")


def _one_line(text: str) -> str:
    """The text itself, or a JSON string where it could not stand in one line of a file."""
    return text if text.isprintable() and not text.startswith('"') else json.dumps(text)


def _column_names(poses: TrackedPoses) -> list[str]:
    size, speakers = poses.weights.shape[1], poses.speaker_weights.shape[1]
    names = [f"pose_{k + 1}" for k in range(size)]
    names += [f"pose_{k + 1}_sigma" for k in range(size)]
    names += [f"speaker_{k + 1}" for k in range(speakers)]
    names += ["energy", "residual_mm"]
    names += [f"residual_mm_{role}" for role in poses.roles]
    return names + [f"{role}_{axis}_mm" for role in poses.roles for axis in "xyz"]


def _columns(poses: TrackedPoses, part: slice) -> FloatArray:
    """(frames of the part, columns), in the order of `_column_names`."""
    columns = [poses.weights, poses.normalised, poses.speaker_weights, poses.energies, poses.residual_mm]
    columns += [poses.residuals_mm, poses.coils.reshape(poses.frame_count, -1)]
    return np.column_stack([array[part] for array in columns])


def _from_csv(file: TextIO) -> TrackedPoses:
    first = file.readline()
    if not first.startswith(f"# {FORMAT_NAME} "):
        raise InputError(
            f"the first line should be '# {FORMAT_NAME} {FORMAT_VERSION}'; this is another kind of CSV."
        )
    _check_version(first.split()[-1])
    header: dict[str, str] = {}
    line = file.readline()
    while line.startswith("#"):
        name, _, text = line[2:].rstrip("\r\n").partition(": ")
        header[name] = json.loads(text) if text.startswith('"') else text
        line = file.readline()
    names = next(csv.reader([line]), [])
    statuses, table = _read_rows(file, len(names))
    column = {name: index for index, name in enumerate(names)}
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
        coils=table[:, [column[f"{r}_{axis}_mm"] for r in roles for axis in "xyz"]].reshape(
            len(table), -1, 3
        ),
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


def _read_rows(file: TextIO, width: int) -> tuple[NDArray[np.int64], FloatArray]:
    """statuses (frames,); table (frames, width), whose third column, the status, is NaN."""
    statuses: list[int] = []
    chunks: list[FloatArray] = []
    rows: list[list[float]] = []
    for row in csv.reader(file):
        if len(row) != width:
            raise InputError(
                f"frame {len(statuses)} has {len(row)} cells, expected {width}; is the file cut off?"
            )
        statuses.append(PoseStatus[row[2].upper()])
        row[2] = ""
        rows.append([float(cell) if cell else np.nan for cell in row])
        if len(rows) == CHUNK_FRAMES:
            chunks.append(np.array(rows))
            rows.clear()
    if not statuses:
        raise InputError("there are no frames in it.")
    if rows:
        chunks.append(np.array(rows))
    return np.array(statuses, dtype=np.int64), np.concatenate(chunks)


# NPZ ------------------------------------------------------------------------------------------------

_ARRAYS = (
    "times_s", "statuses", "weights", "normalised", "speaker_weights", "energies", "residual_mm",
    "residuals_mm", "coils", "vertices",
)  # fmt: skip


def _write_npz(poses: TrackedPoses, file: BinaryIO) -> None:
    header: dict[str, Any] = {"format": FORMAT_NAME, "version": FORMAT_VERSION}
    header.update({name: getattr(poses, name) for name in _HEADER_FIELDS})
    header.update(roles=list(poses.roles), correspondences=list(poses.correspondences))
    arrays = {name: getattr(poses, name) for name in _ARRAYS if getattr(poses, name) is not None}
    coded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez_compressed(file, header=coded, **arrays)


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
