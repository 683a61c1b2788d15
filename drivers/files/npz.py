"""Our .npz of a recording: every array as it is, no pickle, every length checked before it is used."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np

from ... import InputError
from ...archive import read_arrays
from ..frames import Recording
from .common import Options, check_rate
from .tabular import frame_from_text

VERSION = 1
MARK = "tonguetrack_recording"
MAX_BYTES = 4 * 1024**3


def is_npz(head: bytes) -> bool:
    """Whether an archive begins with our mark, as `npz_bytes` writes it; models and poses are .npz too."""
    return head.startswith(b"PK\x03\x04") and head[30:].startswith(f"{MARK}.npy".encode())


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
    try:
        arrays = read_arrays(data, MAX_BYTES)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
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
