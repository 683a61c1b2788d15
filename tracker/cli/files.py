"""`tonguetrack info` and `tonguetrack convert`: what a recording is, and the same in another format."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .names import add_recording_flags, keep_apart

if TYPE_CHECKING:
    from ...drivers import Recording
    from ...drivers.files import Found


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `info` and `convert`."""
    info = subparsers.add_parser("info", help="what a recording, or a folder of recordings, holds")
    info.add_argument("file", help="a recording of any known format, or a folder")
    info.add_argument("--json", action="store_true", help="the same as JSON, for scripts")
    add_recording_flags(info)
    info.set_defaults(run=run_info)

    convert = subparsers.add_parser("convert", help="write a recording as .csv, .json or .npz")
    convert.add_argument("input", help="a recording of any known format")
    convert.add_argument("output", help="the file to write: .csv, .json (the authors' EMA format) or .npz")
    add_recording_flags(convert)
    convert.set_defaults(run=run_convert)


def _open(path: str, args: argparse.Namespace) -> Recording:
    from ...drivers import open_recording

    return open_recording(path, rate_hz=args.rate, unit=args.unit, layout=args.layout)


def run_info(args: argparse.Namespace) -> int:
    """Print what is known about a file or folder."""
    import json

    if os.path.isdir(args.file):
        from ...drivers import find_recordings

        found = find_recordings(args.file)
        print(json.dumps(folder_summary(found), indent=2) if args.json else folder_text(args.file, found))
        return 0
    summary = recording_summary(_open(args.file, args))
    print(json.dumps(summary, indent=2, allow_nan=False) if args.json else recording_text(summary))
    return 0


def run_convert(args: argparse.Namespace) -> int:
    """Write the input as the output's suffix says."""
    from ...drivers import write_recording
    from ...drivers.files.writing import check_target

    check_target(args.output)
    keep_apart([Path(args.output)], [Path(args.input)])
    recording = _open(args.input, args)
    write_recording(recording, args.output)
    print(
        f"{args.output}: {recording.frame_count} frames of {len(recording.coils)} coils, mm ({recording.frame})"
    )
    if Path(args.output).suffix.lower() == ".json":
        print(_lost_in_json(recording))
    return 0


def _lost_in_json(recording: Recording) -> str:
    lost = ["axes", "notes"]
    if recording.orientations is not None:
        lost.append("orientations")
    missing = int((~recording.valid()).sum())
    held = f"; {missing} missing sample(s) hold the last known position with RMS -1" if missing else ""
    return f"The authors' format has no place for {', '.join(lost)}{held}."


def recording_summary(recording: Recording) -> dict[str, Any]:
    """Everything `info` says, as plain numbers and text; None where there is no number."""
    import numpy as np

    valid = recording.valid()
    coils = []
    for k, name in enumerate(recording.coils):
        points = recording.positions[valid[:, k], k]
        low, high = (
            (points.min(axis=0).tolist(), points.max(axis=0).tolist()) if len(points) else (None, None)
        )
        fit = recording.rms[:, k] if recording.rms is not None else np.empty(0)
        fit = fit[np.isfinite(fit)]
        coils.append(
            {
                "name": name,
                "valid_share": float(valid[:, k].mean()) if len(valid) else 0.0,
                "low_mm": low,
                "high_mm": high,
                "median_rms": float(np.median(fit)) if len(fit) else None,
            }
        )
    return {
        "file": recording.source,
        "format": recording.format,
        "frame_of_reference": {
            "x": recording.frame.x,
            "y": recording.frame.y,
            "z": recording.frame.z,
            "origin": recording.frame.origin,
        },
        "frames": recording.frame_count,
        "rate_hz": recording.rate_hz,
        "duration_s": recording.duration_s,
        "orientations": recording.orientations is not None,
        "quaternions": recording.quaternions is not None,
        "coils": coils,
        "notes": list(recording.notes),
        "extra": dict(recording.extra),
    }


def recording_text(summary: dict[str, Any]) -> str:
    """The summary for people: a few lines, a table of coils, the notes."""
    axes = summary["frame_of_reference"]
    kept = [word for word in ("orientations", "quaternions") if summary[word]]
    lines = [
        f"{summary['file']}",
        f"  format    {summary['format']}",
        f"  axes      x {axes['x']}, y {axes['y']}, z {axes['z']}; origin {axes['origin']}",
        f"  frames    {summary['frames']} at {summary['rate_hz']:g} Hz, {summary['duration_s']:.3f} s",
        f"  coils     {len(summary['coils'])}{', with ' + ' and '.join(kept) if kept else ''}",
        "",
    ]
    width = max(4, *(len(coil["name"]) for coil in summary["coils"]))
    lines.append(f"  {'coil':<{width}}  valid  {'x mm':>16}  {'y mm':>16}  {'z mm':>16}  median rms")
    for coil in summary["coils"]:
        row = f"  {coil['name']:<{width}}  {100 * coil['valid_share']:4.0f}%"
        if coil["low_mm"] is None:
            lines.append(f"{row}  no data")
            continue
        spans = zip(coil["low_mm"], coil["high_mm"], strict=True)
        row += "".join(f"  {f'{low:.1f} .. {high:.1f}':>16}" for low, high in spans)
        lines.append(row if coil["median_rms"] is None else f"{row}  {coil['median_rms']:10.2f}")
    if summary["notes"]:
        lines += ["", *(f"  - {note}" for note in summary["notes"])]
    return "\n".join(lines)


def folder_summary(found: list[Found]) -> dict[str, Any]:
    """Recordings and files left out, as JSON."""
    return {
        "recordings": [
            {"path": str(item.path), "format": item.format, "files": [str(file) for file in item.files]}
            for item in found
            if item.is_recording
        ],
        "left_out": [
            {"path": str(item.path), "reason": item.left_out} for item in found if not item.is_recording
        ],
    }


def folder_text(root: str, found: list[Found]) -> str:
    """Recordings first, then what was left out and why."""
    recordings = [item for item in found if item.is_recording]
    others = [item for item in found if not item.is_recording]
    lines = [f"{root}: {len(recordings)} recording(s), {len(others)} other file(s)"]
    for item in recordings:
        suffixes = " ".join(file.suffix for file in item.files)
        several = f" ({len(item.files)} files: {suffixes})" if len(item.files) > 1 else ""
        lines.append(f"  {item.path.relative_to(root)}: {item.format}{several}")
    if others:
        lines.append("left out:")
        lines += [f"  {item.path.relative_to(root)}: {item.left_out}" for item in others]
    return "\n".join(lines)
