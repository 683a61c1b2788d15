"""`tonguetrack take`: list, look at, mend and export what `live --record` recorded."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .names import BUNDLED, keep_apart, named_model, prepare_folder

WHAT = ("recording", "poses", "prepared", "session", "markers")


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `take`."""
    take = subparsers.add_parser("take", help="list, inspect, recover and export takes (XDF)")
    actions = take.add_subparsers(dest="action", metavar="ACTION", required=True)

    listing = actions.add_parser("list", help="every take below a folder")
    listing.add_argument("folder", nargs="?", default=".", help="default: the working folder")
    listing.add_argument("--json", action="store_true", help="the same as JSON, for scripts")
    listing.set_defaults(run=run_list)

    info = actions.add_parser("info", help="what a take holds, how the tracking went, whether it is whole")
    info.add_argument("file", help="a take")
    info.add_argument("--check", action="store_true",
                      help="track it once more and compare every bit; exit code 1 where one differs")  # fmt: skip
    info.add_argument(
        "--model", default=BUNDLED, help="the model of the take, for --check (default: the bundled one)"
    )
    info.add_argument("--json", action="store_true", help="the same as JSON, for scripts")
    info.set_defaults(run=run_info)

    recover = actions.add_parser("recover", help="a whole take from one that was cut off or damaged")
    recover.add_argument("file", help="the take; its journal is found beside it")
    recover.add_argument("-o", "--output", required=True, help="the new take; no file is ever overwritten")
    recover.set_defaults(run=run_recover)

    export = actions.add_parser("export", help="a take's recording, poses, session or markers as a file")
    export.add_argument("file", help="a take")
    export.add_argument(
        "-o", "--output", required=True, help=".csv, .npz or .json; .toml for a session, .csv for markers"
    )
    export.add_argument(
        "--what",
        choices=WHAT,
        default=WHAT[0],
        help="recording (default): the device's frames; prepared: the tracked coils in the model's frame",
    )
    export.add_argument(
        "--model",
        default=BUNDLED,
        help="the model of the take, for poses (default: the bundled one)",
    )
    export.set_defaults(run=run_export)


def run_list(args: argparse.Namespace) -> int:
    """One line a take."""
    import json

    from ..takes.summary import takes_in

    rows = takes_in(args.folder)
    print(json.dumps(rows, indent=2, allow_nan=False) if args.json else list_text(args.folder, rows))
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Everything about one take."""
    import json

    from ..takes.reading import read_take
    from ..takes.summary import summary_of

    take = read_take(args.file)
    summary = summary_of(take)
    if args.check:
        from ..takes.retrack import retrack

        summary["differing_frames"] = retrack(take, named_model(args.model)).differing.tolist()
    print(json.dumps(summary, indent=2, allow_nan=False) if args.json else info_text(summary))
    return 1 if summary.get("differing_frames") else 0


def run_recover(args: argparse.Namespace) -> int:
    """Write the mended take and say what was found."""
    from ..takes.recovering import recover

    prepare_folder(Path(args.output))
    for sentence in recover(args.file, args.output):
        print(sentence)
    print(f"{args.output}: written; {args.file} is as it was.")
    return 0


def run_export(args: argparse.Namespace) -> int:
    """Write one part of a take."""
    from ..takes.exporting import check_export, export
    from ..takes.reading import read_take

    output = Path(args.output)
    check_export(args.what, output)
    keep_apart([output], [Path(args.file)])
    prepare_folder(output)
    take = read_take(args.file)
    for sentence in (take.damage, take.journal_note):
        if sentence:
            print(f"note: {sentence}")
    place = BUNDLED if args.model == BUNDLED else str(Path(args.model).resolve())
    print(export(take, args.what, output, lambda: named_model(args.model), place))
    return 0


def list_text(folder: str, rows: list[dict[str, Any]]) -> str:
    """The takes as a table, then what else ends in .xdf."""
    takes = [row for row in rows if row["state"] != "no take"]
    lines = [f"{folder}: {len(takes)} take(s)"]
    width = max((len(row["file"]) for row in takes), default=0)
    for row in takes:
        lines.append(
            f"  {row['file']:<{width}}  {row['started'][:19]:<19}  {_clock(row['duration_s']):>8}  "
            f"{row['frames']:>8} frames  {len(row['tracked_coils'])} of {row['coils']} coils  {row['model']}  "
            f"{row['state']}"
        )
    lines += [f"  not a take: {row['damage']}" for row in rows if row["state"] == "no take"]
    return "\n".join(lines)


def info_text(summary: dict[str, Any]) -> str:
    """The summary for people."""
    stated = f"{summary['rate_hz']:g} Hz" if summary["rate_hz"] else "a rate that the device did not state"
    arrived = f", {summary['arrivals_hz']:.2f} Hz by the arrivals" if summary["arrivals_hz"] else ""
    gaps = summary["gaps"]
    lines = [
        f"{summary['file']}",
        f"  state     {summary['state']}",
        f"  started   {summary['started']}, tonguetrack {summary['version']}",
        f"  source    {summary['source']} ({summary['frame_of_reference']})",
        f"  frames    {summary['frames']} at {stated}{arrived}, {_clock(summary['duration_s'])}",
        f"  gaps      {gaps['count']}"
        + (f", the longest {gaps['longest_s']:.3f} s, together {gaps['together_s']:.3f} s" if gaps["count"] else ""),
        f"  coils     {', '.join(summary['coil_names'])}",
        f"  model     {summary['model']} [{summary['model_fingerprint']}]",
        f"  poses     {_percentages(summary['statuses'])}",
    ]  # fmt: skip
    for role, states in summary["coil_states"].items():
        vertex = summary["correspondences"][role]
        lines.append(f"    {role} (vertex {vertex}): {_percentages(states)}")
    lines.append("  streams")
    for stream in summary["streams"]:
        more = f", {stream['from_journal']} more in the journal" if stream["from_journal"] else ""
        end = "" if stream["ended"] else ", not ended"
        lines.append(
            f"    {stream['name']}: {stream['samples']} samples of {stream['channels']} channels{more}{end}"
        )
    if summary["markers"]:
        lines.append("  markers")
        for mark in summary["markers"]:
            kind = "" if mark["kind"] == "user" else f"{mark['kind']}: "
            text = mark["text"].splitlines()[0] if mark["text"].strip() else ""
            if mark["kind"] == "session":
                text = "changed (`take export --what session` writes the last one)"
            lines.append(f"    {mark['time_s']:9.3f} s  {kind}{text}")
    lines += [f"  - {sentence}" for sentence in (summary["damage"], summary["journal"]) if sentence]
    if "differing_frames" in summary:
        differing = summary["differing_frames"]
        lines.append(
            f"  tracked again: {len(differing)} of {summary['frames']} poses differ, the first in frame {differing[0]}"
            if differing
            else f"  tracked again: all {summary['frames']} poses come out the same, bit for bit"
        )
    return "\n".join(lines)


def _percentages(shares: dict[str, float]) -> str:
    return ", ".join(f"{word} {100 * share:.1f} %" for word, share in shares.items()) or "none"


def _clock(seconds: float) -> str:
    """1:02:03 or 2:03."""
    whole = round(seconds)
    minutes = f"{whole // 60 % 60}:{whole % 60:02d}"
    return f"{whole // 3600}:{minutes:>05}" if whole >= 3600 else minutes
