"""Model files: our .npz (versioned, no pickle) and the published YAML and JSON, both ways.

The published layout (the authors' model builder): Dimensions, CoreTensor (entry (i, j, k) at
i * poses * k + j * k + k; in YAML base64 of IEEE doubles), MeanWeights, ShapeSpace {Origin, Faces}.
It keeps neither training weights nor names nor provenance; our file keeps everything.
"""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import InputError
from ..archive import read_arrays
from ..atomic import write_atomically
from .mesh import FloatArray
from .multilinear import Mode, SurfaceMarks, TongueModel

FORMAT_NAME = "tonguetrack model"
FORMAT_VERSION = 1
MODEL_SUFFIXES = (".npz", ".yaml", ".yml", ".json")

# A full model of the paper's size (11 x 13 x 9300 doubles) has 10.6 MB; text needs a few times that.
MAX_MODEL_BYTES = 1024 * 1024 * 1024
MAX_NESTING = 100


def load_model(path: str | Path) -> TongueModel:
    """Loads a model from .npz, .yaml/.yml or .json.

    Raises InputError for a missing, damaged, oversized or foreign file.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: this is a folder; a model is one file ({', '.join(MODEL_SUFFIXES)}).")
    if not path.is_file():
        raise InputError(f"{path}: there is no such model file.")
    if path.suffix.lower() not in MODEL_SUFFIXES:
        raise InputError(f"{path}: a model file ends in one of {', '.join(MODEL_SUFFIXES)}.")
    if path.stat().st_size > MAX_MODEL_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a model.")
    data = path.read_bytes()
    try:
        if path.suffix.lower() == ".npz":
            return _model_from_npz(data)
        text = data.decode()
        content = json.loads(text) if path.suffix.lower() == ".json" else load_yaml_text(data, str(path))
        return _model_from_published(content, path.name)
    except InputError as reason:
        message = str(reason)
        raise InputError(message if message.startswith(str(path)) else f"{path}: {message}") from reason
    except Exception as reason:  # whatever a damaged file makes the parsers and the checks stumble over
        raise InputError(
            f"{path}: this is not a readable tongue model ({type(reason).__name__}: {_short(reason)})."
        ) from reason


def check_model_suffix(path: str | Path) -> None:
    """Raises InputError for a name that `save_model` could not write."""
    if Path(path).suffix.lower() not in MODEL_SUFFIXES:
        raise InputError(
            f"{path}: a model is saved as one of {', '.join(MODEL_SUFFIXES)}; end the name in one."
        )


def save_model(model: TongueModel, path: str | Path) -> None:
    """Saves to the format that the suffix names; the file appears whole or not at all."""
    check_model_suffix(path)
    write_atomically(path, model_bytes(model, Path(path).suffix))


def model_bytes(model: TongueModel, suffix: str) -> bytes:
    """The model as the content of a file of that suffix; the same model gives the same bytes."""
    if suffix.lower() == ".npz":
        return _npz_bytes(model)
    if suffix.lower() == ".json":
        return (json.dumps(_published_map(model, model.core.ravel().tolist())) + "\n").encode()
    if suffix.lower() in (".yaml", ".yml"):
        return _yaml_bytes(model)
    raise InputError(f"a model is saved as one of {', '.join(MODEL_SUFFIXES)}, not as '{suffix}'.")


def load_yaml_text(data: bytes, name: str) -> Any:
    """Parses YAML with the safe loader (the fast one where libyaml is present)."""
    import yaml

    # libyaml recurses without a limit of its own and would take the process down with it.
    brackets = np.frombuffer(data, dtype=np.uint8)
    opening = np.isin(brackets, np.frombuffer(b"[{", dtype=np.uint8)).astype(np.int64)
    closing = np.isin(brackets, np.frombuffer(b"]}", dtype=np.uint8)).astype(np.int64)
    if data and int(np.cumsum(opening - closing).max()) > MAX_NESTING:
        raise InputError(
            f"{name}: this is nested more than {MAX_NESTING} levels deep, which no tongue model is."
        )
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return yaml.load(data, Loader=loader)
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as reason:
        mark = getattr(reason, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark is not None else ""
        raise InputError(f"{name}: this is not readable YAML{where} ({_short(reason)}).") from reason


# Our own file ---------------------------------------------------------------------------------------


def _npz_bytes(model: TongueModel) -> bytes:
    header = {
        "format": FORMAT_NAME,
        "version": FORMAT_VERSION,
        "speaker": {"entries": model.speaker.entries, "names": list(model.speaker.names)},
        "pose": {"entries": model.pose.entries, "names": list(model.pose.names)},
        "landmarks": dict(model.marks.landmarks),
        "regions": {name: list(vertices) for name, vertices in model.marks.regions.items()},
        "midsagittal": list(model.marks.midsagittal),
        "provenance": dict(model.provenance),
    }
    arrays: dict[str, NDArray[Any]] = {
        "header": np.frombuffer(json.dumps(header, ensure_ascii=False).encode(), dtype=np.uint8),
        "core": model.core,
        "origin": model.origin,
        "faces": model.faces,
    }
    for name, mode in (("speaker", model.speaker), ("pose", model.pose)):
        arrays[f"{name}_mean"] = mode.mean
        arrays[f"{name}_sigma"] = mode.sigma
        if mode.measured_sigma is not None and mode.training is not None:
            arrays[f"{name}_measured_sigma"] = mode.measured_sigma
            arrays[f"{name}_training"] = mode.training
        if mode.spectrum is not None:
            arrays[f"{name}_spectrum"] = mode.spectrum
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def _model_from_npz(data: bytes) -> TongueModel:
    arrays = read_arrays(data, MAX_MODEL_BYTES)
    if "header" not in arrays:
        raise InputError("this .npz is not a tongue model (it has no 'header'); make one with 'model build'.")
    header = json.loads(arrays["header"].tobytes().decode())
    if header.get("format") != FORMAT_NAME:
        raise InputError(f"this .npz holds '{header.get('format')}', not a '{FORMAT_NAME}'.")
    if header.get("version") != FORMAT_VERSION:
        raise InputError(
            f"the model file has version {header.get('version')}; this tonguetrack reads version "
            f"{FORMAT_VERSION}."
        )

    def numbers(name: str, dimensions: int) -> FloatArray:
        array = arrays[name]
        if array.ndim != dimensions or array.dtype.kind not in "fiu":
            raise InputError(f"'{name}' should be a {dimensions}-dimensional array of numbers.")
        return np.asarray(array, dtype=np.float64)

    def optional(name: str, dimensions: int) -> FloatArray | None:
        return numbers(name, dimensions) if name in arrays else None

    def mode(name: str) -> Mode:
        return Mode(
            numbers(f"{name}_mean", 1),
            int(header[name]["entries"]),
            optional(f"{name}_training", 2),
            optional(f"{name}_spectrum", 1),
            tuple(map(str, header[name]["names"])),
        )

    marks = SurfaceMarks(
        {str(k): int(v) for k, v in header["landmarks"].items()},
        {str(k): tuple(map(int, v)) for k, v in header["regions"].items()},
        tuple(map(int, header["midsagittal"])),
    )
    provenance = {str(k): str(v) for k, v in header["provenance"].items()}
    faces = _indices(numbers("faces", 2), "faces")
    model = TongueModel(
        numbers("core", 3), numbers("origin", 1), faces, mode("speaker"), mode("pose"), marks, provenance
    )
    return _checked(model)


# The published layout -------------------------------------------------------------------------------


def _published_map(model: TongueModel, core: Any) -> dict[str, Any]:
    return {
        "Dimensions": {
            "OriginalSpeakerMode": model.speaker.entries,
            "OriginalPhonemeMode": model.pose.entries,
            "TruncatedSpeakerMode": model.speaker.size,
            "TruncatedPhonemeMode": model.pose.size,
            "VertexMode": model.origin.size,
        },
        "CoreTensor": core,
        "MeanWeights": {
            "SpeakerMode": model.speaker.mean.tolist(),
            "PhonemeMode": model.pose.mean.tolist(),
        },
        "ShapeSpace": {"Origin": model.origin.tolist(), "Faces": model.faces.tolist()},
    }


def _yaml_bytes(model: TongueModel) -> bytes:
    """The published YAML. Flow lists of plain doubles are both YAML and JSON, so JSON spells them."""
    encoded = base64.b64encode(model.core.astype("<f8").tobytes()).decode()
    content = _published_map(model, None)
    lines = ["Dimensions:"]
    lines += [f"  {name}: {size}" for name, size in content["Dimensions"].items()]
    lines += [f'CoreTensor: !!binary "{encoded}"']
    for section in ("MeanWeights", "ShapeSpace"):
        lines += [f"{section}:"]
        lines += [f"  {name}: {json.dumps(values)}" for name, values in content[section].items()]
    return ("\n".join(lines) + "\n").encode()


def _model_from_published(content: Any, name: str) -> TongueModel:
    if not isinstance(content, dict) or "CoreTensor" not in content:
        raise InputError(
            "this is not a published tongue model; expected the keys Dimensions, CoreTensor, MeanWeights, ShapeSpace."
        )
    sizes = {key: int(value) for key, value in content["Dimensions"].items()}
    shape = (sizes["TruncatedSpeakerMode"], sizes["TruncatedPhonemeMode"], sizes["VertexMode"])
    core = _core_values(content["CoreTensor"])
    if min(shape) < 1 or core.size != shape[0] * shape[1] * shape[2]:
        raise InputError(
            f"CoreTensor holds {core.size} numbers, but Dimensions say {shape[0]} x {shape[1]} x {shape[2]}."
        )
    means = content["MeanWeights"]
    model = TongueModel(
        core.reshape(shape),
        _numbers(content["ShapeSpace"]["Origin"], "ShapeSpace/Origin"),
        _indices(_numbers(content["ShapeSpace"]["Faces"], "ShapeSpace/Faces"), "ShapeSpace/Faces").reshape(
            -1, 3
        ),
        Mode(_numbers(means["SpeakerMode"], "MeanWeights/SpeakerMode"), sizes["OriginalSpeakerMode"]),
        Mode(_numbers(means["PhonemeMode"], "MeanWeights/PhonemeMode"), sizes["OriginalPhonemeMode"]),
        provenance={"name": name, "source": f"published model file {name}"},
    )
    return _checked(model)


def _core_values(stored: Any) -> FloatArray:
    if not isinstance(stored, (bytes, str)):
        return _numbers(stored, "CoreTensor").ravel()
    raw = stored if isinstance(stored, bytes) else base64.b64decode("".join(stored.split()), validate=True)
    if len(raw) % 8:
        raise InputError(f"CoreTensor holds {len(raw)} bytes, which is no whole number of 8-byte doubles.")
    # "Native order of the writer" is little-endian on every machine in use; a file from the other
    # kind shows itself by values no tongue can have.
    little, big = (np.frombuffer(raw, dtype=order).astype(np.float64) for order in ("<f8", ">f8"))
    return big if _plausible(big) and not _plausible(little) else little


def _plausible(core: FloatArray) -> bool:
    return bool(np.isfinite(core).all() and core.size and 1e-6 < np.abs(core).max() < 1e6)


def _indices(values: FloatArray, where: str) -> NDArray[np.int32]:
    if not (
        np.isfinite(values).all() and (values == np.rint(values)).all() and (np.abs(values) < 2**31).all()
    ):
        raise InputError(f"{where} should hold vertex numbers: whole, and none too large.")
    return values.astype(np.int32)


def _numbers(values: ArrayLike, where: str) -> FloatArray:
    try:
        # PyYAML leaves '1e-05' (no dot) a string; float() takes it.
        return np.asarray(np.array(values, dtype=object).astype(np.float64))
    except (ValueError, TypeError) as reason:
        raise InputError(f"{where} should hold numbers only ({_short(reason)}).") from reason


def _checked(model: TongueModel) -> TongueModel:
    for name in ("core", "origin"):
        if not np.isfinite(getattr(model, name)).all():
            raise InputError(f"the model's {name} holds values that are not finite numbers.")
    for mode in (model.speaker, model.pose):
        for array in (mode.mean, mode.training, mode.spectrum):
            if array is not None and not np.isfinite(array).all():
                raise InputError("the model's weights hold values that are not finite numbers.")
    if model.faces.ndim != 2 or model.faces.shape[1:] != (3,):
        raise InputError(f"the model's faces have shape {model.faces.shape}, expected (faces, 3).")
    marks = [*model.marks.midsagittal, *model.marks.landmarks.values()]
    for vertices in model.marks.regions.values():
        marks.extend(vertices)
    used = np.concatenate([model.faces.ravel(), np.asarray(marks, dtype=np.int64)])
    if used.size and (used.min() < 0 or used.max() >= model.vertex_count):
        wrong = used.min() if used.min() < 0 else used.max()
        raise InputError(
            f"a face or a mark names vertex {wrong}, but the model has {model.vertex_count} vertices, from 0."
        )
    return model


def _short(reason: BaseException) -> str:
    lines = str(reason).strip().splitlines()
    return lines[0][:120] if lines else "no details"
