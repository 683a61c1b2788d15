"""Our .npz of a recording: every array as it is, no pickle, every length checked before it is read."""

from __future__ import annotations

import io
import json
import math
import zipfile
from typing import Any

import numpy as np

from ... import InputError
from ..frames import Recording
from .common import Options, check_rate
from .tabular import frame_from_text

VERSION = 1
MARK = "tonguetrack_recording"
LARGEST_RATIO = 1100


def is_npz(head: bytes) -> bool:
    return head.startswith(b"PK\x03\x04")


def npz_bytes(recording: Recording) -> bytes:
    """The recording as .npz: positions, times_s and what else it has, and its words as one JSON text."""
    words = {
        "version": VERSION, "coils": list(recording.coils), "rate_hz": recording.rate_hz, "unit": "mm",
        "format": recording.format, "frame": str(recording.frame), "notes": list(recording.notes),
        "extra": dict(recording.extra),
    }  # fmt: skip
    arrays = {"positions": recording.positions, "times_s": recording.times_s}
    optional = {
        "orientations": recording.orientations,
        "quaternions": recording.quaternions,
        "rms": recording.rms,
    }
    arrays |= {key: array for key, array in optional.items() if array is not None}
    out = io.BytesIO()
    text = np.frombuffer(json.dumps(words).encode(), np.uint8)
    np.savez(out, allow_pickle=False, **{MARK: text}, **arrays)
    return out.getvalue()


def parse_npz(data: bytes, name: str, options: Options) -> Recording:
    """A recording written by `npz_bytes`."""
    arrays = _arrays(data, name)
    if MARK not in arrays:
        raise InputError(
            f"{name}: this .npz holds {', '.join(list(arrays)[:6]) or 'nothing'} and is not a recording; if it is a "
            "tongue model, use `tonguetrack model info`."
        )
    try:
        words: Any = json.loads(arrays[MARK].tobytes())
        if words["version"] != VERSION:
            raise InputError(f"{name}: this recording has version {words['version']!r}; {VERSION} is known.")
        positions, times = arrays["positions"], arrays["times_s"]
        if positions.ndim != 3 or times.ndim != 1 or not (np.diff(times) > 0).all() or not len(times):
            raise InputError(f"{name}: positions or times_s do not have the shape of a recording.")
        others = {key: arrays.get(key) for key in ("orientations", "quaternions", "rms")}
        held = (positions, times, *(a for a in others.values() if a is not None))
        if any(array.dtype != np.float64 for array in held) or not np.isfinite(times).all():
            raise InputError(f"{name}: positions or times_s are not numbers; the file is damaged.")
        return Recording(
            coils=tuple(str(coil) for coil in words["coils"]), positions=positions, times_s=times,
            rate_hz=check_rate(float(words["rate_hz"]), name), format="tonguetrack .npz 1",
            frame=frame_from_text(str(words["frame"]), name), source=name,
            notes=tuple(str(note) for note in words["notes"]),
            extra={str(key): str(value) for key, value in words["extra"].items()}, **others,
        )  # fmt: skip
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{name}: the recording's description is damaged ({error}); write it again."
        ) from error


def _arrays(data: bytes, name: str) -> dict[str, np.ndarray[Any, Any]]:
    """Member name -> array; shape, type and size of each agree before anything is allocated."""
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for member in archive.infolist():
                key = member.filename.removesuffix(".npy")
                if member.file_size > LARGEST_RATIO * max(member.compress_size, 1) or (
                    member.compress_size > len(data)
                ):
                    raise InputError(
                        f"{name}: the member {key!r} claims an impossible size; the file is damaged."
                    )
                if key == member.filename or len(arrays) >= 64:
                    continue
                if MARK + ".npy" not in archive.namelist():
                    arrays[key] = np.empty(0)
                    continue
                arrays[key] = _array(archive.read(member), key, name)
    except InputError:
        raise
    except Exception as error:  # zipfile and the .npy header raise a dozen kinds on damaged bytes
        raise InputError(f"{name}: the .npz archive is damaged or cut short; copy it again.") from error
    return arrays


def _array(content: bytes, key: str, name: str) -> np.ndarray[Any, Any]:
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = (
        np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    )
    shape, fortran, dtype = read_header(stream)
    size = math.prod(shape) * dtype.itemsize
    if dtype.kind not in "fiu" or size != len(content) - stream.tell():
        raise InputError(f"{name}: the array {key!r} is not of plain numbers of its stated size.")
    return (
        np.frombuffer(content, dtype, offset=stream.tell())
        .reshape(shape, order="F" if fortran else "C")
        .copy()
    )
