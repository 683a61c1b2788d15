"""What a take holds and how it fared, as plain numbers and text."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ... import InputError
from ..pose import CoilState, FloatArray, PoseStatus
from .layout import MARKERS, POSE_HEAD
from .reading import NUMBERS, Take, read_take

PAUSE_S = 0.1
"""Frames that come farther apart are a gap."""
PAUSE_PERIODS = 4.0
"""For slow devices: a gap is at least so many frames."""


def row_of(take: Take) -> dict[str, Any]:
    """One line of `take list`."""
    info = take.info
    return {
        "file": str(take.path),
        "started": info.started,
        "duration_s": take.duration_s,
        "frames": take.frame_count,
        "coils": len(info.coils),
        "tracked_coils": list(info.roles),
        "model": info.model_name,
        "state": take.state,
        "damage": take.damage,
        "journal": take.journal_note or None,
    }


def takes_in(folder: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """`row_of` every .xdf file below a folder, by path; of a file that is no take its path and the reason."""
    root = Path(folder)
    if not root.is_dir():
        raise InputError(f"{root}: there is no such folder.")
    rows = []
    for path in sorted(path for path in root.rglob("*") if path.suffix.lower() == ".xdf" and path.is_file()):
        try:
            rows.append(row_of(read_take(path)))
        except InputError as reason:
            rows.append({"file": str(path), "state": "no take", "damage": str(reason)})
    return rows


def summary_of(take: Take) -> dict[str, Any]:
    """Everything `take info` says; None where there is no number."""
    info = take.info
    return {
        **row_of(take),
        "source": info.source,
        "version": info.version,
        "rate_hz": info.rate_hz or None,
        "arrivals_hz": _mean_rate(take.stamps),
        "frame_of_reference": str(info.frame),
        "coil_names": list(info.coils),
        "model_fingerprint": info.model_fingerprint,
        "correspondences": dict(zip(info.roles, info.vertices, strict=True)),
        "streams": [_stream(take, name) for name in (*NUMBERS, MARKERS)],
        "gaps": _gaps(take),
        "statuses": _shares(take.pose[:, POSE_HEAD.index("status")], PoseStatus),
        "coil_states": {
            role: _shares(states, CoilState)
            for role, states in zip(info.roles, take.coil_states().T, strict=True)
        },
        "markers": [
            {"time_s": mark.time_s, "frame": mark.row, "kind": mark.word or "user", "text": mark.content}
            for mark in take.markers
        ],
        "session": info.session_toml,
    }


def _stream(take: Take, name: str) -> dict[str, Any]:
    stream = take.file.named(name)
    if stream is None:
        return {"name": name, "channels": 0, "samples": 0, "from_journal": 0, "ended": False}
    more = take.from_journal(name) if name in NUMBERS else None
    return {
        "name": name,
        "channels": stream.channel_count,
        "samples": stream.count,
        "from_journal": 0 if more is None else len(more),
        "ended": stream.footer is not None,
    }


def _mean_rate(stamps: FloatArray) -> float | None:
    span_s = float(stamps[-1] - stamps[0]) if len(stamps) > 1 else 0.0
    return (len(stamps) - 1) / span_s if span_s > 0 else None


def _gaps(take: Take) -> dict[str, Any]:
    """Pauses between arrivals: how many, the longest, and how long they are together."""
    steps = np.diff(take.stamps)
    least_s = max(PAUSE_S, PAUSE_PERIODS / take.info.rate_hz if take.info.rate_hz else 0.0)
    pauses = steps[steps > least_s]
    return {
        "count": len(pauses),
        "longest_s": float(pauses.max()) if len(pauses) else 0.0,
        "together_s": float(pauses.sum()),
    }


def _shares(values: FloatArray, words: type[PoseStatus | CoilState]) -> Mapping[str, float]:
    """Word -> share of the frames, where there is any; "not in the file" for frames without."""
    if not len(values):
        return {}
    counts = {word.name.lower(): int(np.count_nonzero(values == word)) for word in words}
    counts["not in the file"] = len(values) - sum(counts.values())
    return {word: count / len(values) for word, count in counts.items() if count}
