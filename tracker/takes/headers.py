"""The headers of a take's four streams, as bytes and back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ... import InputError
from ...drivers.files.xdf import TAKE_MARK, TAKE_VERSION
from ...drivers.frames import FrameOfReference
from ...drivers.xdf import XdfStream, stream_header
from .layout import MARKERS, POSE, PREPARED, RAW, STREAM_IDS, STREAM_TYPES, TakeInfo

_UNITS = {"device_time_s": "s", "solved_after_s": "s", "residual_mm": "mm"}


def header_bytes(info: TakeInfo) -> bytes:
    """The four stream headers, one after the other, as they follow the file's header.

    The header of `raw` describes the whole take, so that it alone tells what a file is.
    """
    return missing_headers(info, ())


def info_from_streams(streams: Sequence[XdfStream]) -> TakeInfo:
    """What `header_bytes` wrote. Raises InputError, without the file's name, for anything else."""
    by_name = {stream.name: stream for stream in reversed(streams)}  # of two with one name the first
    raw = by_name.get(RAW)
    if raw is None or TAKE_MARK not in raw.description:
        raise InputError(
            "this XDF file is not a take of tonguetrack; `tonguetrack info` reads it if it has coils."
        )
    words = raw.description
    if words[TAKE_MARK] != TAKE_VERSION:
        raise InputError(f"the take has version {words[TAKE_MARK]!r}; this tonguetrack reads {TAKE_VERSION}.")
    try:
        info = _info_from(words, raw)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as reason:
        raise InputError(
            f"the take's description is damaged ({type(reason).__name__}: {str(reason)[:80]})."
        ) from reason
    expected = {RAW: info.raw_labels, PREPARED: info.prepared_labels, POSE: info.pose_labels}
    for name, labels in expected.items():
        stream = by_name.get(name)
        if stream and (stream.channel_count, stream.channel_format) != (len(labels), "double64"):
            raise InputError(
                f"the stream '{name}' has {stream.channel_count} channels of {stream.channel_format}, expected "
                f"{len(labels)} of double64."
            )
    if len(info.vertices) != len(info.roles) or len(info.pose_sigma) != len(info.pose_mean):
        raise InputError(
            "the take's description is damaged (roles and vertices, or means and sigmas, differ in number)."
        )
    return info


def missing_headers(info: TakeInfo, present: Sequence[str]) -> bytes:
    """The headers of the streams whose names are not `present`."""
    return b"".join(_header(info, name) for name in STREAM_IDS if name not in present)


def _header(info: TakeInfo, name: str) -> bytes:
    labels = {
        RAW: info.raw_labels,
        PREPARED: info.prepared_labels,
        POSE: info.pose_labels,
        MARKERS: ("marker",),
    }
    return stream_header(
        STREAM_IDS[name],
        name,
        STREAM_TYPES[name],
        labels[name],
        [_unit(label) for label in labels[name]],
        0.0 if name == MARKERS else info.rate_hz,
        info.source,
        "string" if name == MARKERS else "double64",
        _description(info) if name == RAW else {},
    )


def _description(info: TakeInfo) -> dict[str, str]:
    return {
        TAKE_MARK: TAKE_VERSION,
        "version": info.version,
        "started": info.started,
        "source": info.source,
        "coils": json.dumps(info.coils),
        "frame": json.dumps([info.frame.x, info.frame.y, info.frame.z, info.frame.origin]),
        "parts": json.dumps([info.quaternions, info.rms, info.status]),
        "roles": json.dumps(info.roles),
        "vertices": json.dumps([int(vertex) for vertex in info.vertices]),
        "model_name": info.model_name,
        "model_fingerprint": info.model_fingerprint,
        "pose_mean": json.dumps(info.pose_mean.tolist()),
        "pose_sigma": json.dumps(info.pose_sigma.tolist()),
        "speaker_size": str(info.speaker_size),
        "session": info.session_toml,
    }


def _info_from(words: Any, raw: XdfStream) -> TakeInfo:
    quaternions, rms, status = (bool(part) for part in json.loads(words["parts"]))
    return TakeInfo(
        source=words["source"],
        coils=_texts(words["coils"]),
        rate_hz=raw.rate_hz,
        frame=FrameOfReference(*_texts(words["frame"])),
        quaternions=quaternions,
        rms=rms,
        status=status,
        roles=_texts(words["roles"]),
        vertices=tuple(_small(vertex, 10**9) for vertex in json.loads(words["vertices"])),
        model_name=words["model_name"],
        model_fingerprint=words["model_fingerprint"],
        pose_mean=_numbers(words["pose_mean"]),
        pose_sigma=_numbers(words["pose_sigma"]),
        speaker_size=_small(words["speaker_size"]),
        session_toml=words["session"],
        started=words["started"],
        version=words["version"],
    )


def _texts(text: str) -> tuple[str, ...]:
    values = json.loads(text)
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise ValueError("expected a list of names")
    return tuple(values)


def _numbers(text: str) -> np.ndarray:
    values = np.array(json.loads(text), dtype=np.float64)
    if values.ndim != 1:
        raise ValueError("expected a list of numbers")
    return values


def _small(text: str | int, most: int = 10_000) -> int:
    value = int(text)
    if not 0 <= value <= most:
        raise ValueError(f"{str(value)[:20]} where a number up to {most} is expected")
    return value


def _unit(label: str) -> str:
    if label in _UNITS:
        return _UNITS[label]
    return "mm" if label.endswith(("_x", "_y", "_z", "_residual_mm")) else ""
