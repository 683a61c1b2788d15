"""tonguetrack calibrate: from recordings, a bite plane and a palate to a session file, with reasons and a report."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from .names import (
    BUNDLED,
    add_recording_flags,
    each_once,
    keep_apart,
    named_model,
    parsed_coils,
    prepare_folder,
)

if TYPE_CHECKING:
    from ...drivers.frames import Recording
    from ..smoothing import Smoothing

WORKING = "fitting place, vertices and anatomy; this takes some seconds, the first time on this machine up to a minute ..."


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    calibrate = commands.add_parser(
        "calibrate",
        help="place a speaker in the model: head, bite plane, palate, coils, anatomy -> session file",
    )
    calibrate.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="speech of one session; the more varied the better"
    )
    calibrate.add_argument(
        "--model", default=BUNDLED, help="the tongue model (default: the bundled synthetic one)"
    )
    calibrate.add_argument(
        "--bite-plane", metavar="FILE", help="a recording in which the speaker bites on a plate with coils"
    )
    calibrate.add_argument("--palate", metavar="FILE", help="a recording of a swept probe, or a trace")
    rest = calibrate.add_mutually_exclusive_group()
    rest.add_argument(
        "--rest",
        metavar="START:END",
        help="seconds of the first recording in which the head rests (default: all)",
    )
    rest.add_argument("--rest-file", metavar="FILE", help="a recording in which the head rests")
    calibrate.add_argument("--coils", metavar="CHANNEL=ROLE,...",
                           help="which channel is which coil, where names do not tell; of all files")  # fmt: skip
    calibrate.add_argument(
        "--frame",
        metavar="'X Y Z'",
        help='where the axes grow, as in "front left up", where files do not state it',
    )
    calibrate.add_argument(
        "--smoothing",
        metavar="PRESET",
        default="none",
        help="carstens, tardis, haskins, ema2wav, mocha, or none (default)",
    )
    calibrate.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="the session file (TOML) to be written"
    )
    calibrate.add_argument("--report", metavar="FOLDER", help="write report.md and its pictures there")
    calibrate.add_argument("--json", action="store_true", help="decisions and numbers as JSON on stdout")
    add_recording_flags(calibrate)
    calibrate.set_defaults(run=run_calibrate)


def run_calibrate(args: argparse.Namespace) -> int:
    from ...atomic import write_atomically
    from ..calibration import Sources, calibrate
    from ..palate import axes_from_words
    from ..session import session_toml

    target = Path(args.output)
    read = [*args.recordings, args.bite_plane, args.palate, args.rest_file, args.model]
    outputs = [target]
    if args.report:
        from ..calibrationreport import REPORT_FILES, require_plotting

        require_plotting()
        pages = [Path(args.report) / name for name in REPORT_FILES]
        if target.resolve() in [path.resolve() for path in (Path(args.report), *pages)]:
            raise InputError(
                f"-o {target}: the report of --report {args.report} goes there; choose another name."
            )
        outputs += pages
    keep_apart(outputs, [Path(name) for name in read if name])
    each_once(map(Path, args.recordings))
    for file in outputs:
        prepare_folder(file)
    coils = parsed_coils(args.coils) if args.coils else None
    frame = axes_from_words(args.frame) if args.frame else None
    smoothing = named_smoothing(args.smoothing)
    rest_s = parsed_interval(args.rest) if args.rest else None
    model = named_model(args.model)
    print(f"model: {model.name} [{model.fingerprint}]", file=sys.stderr)
    recordings = [_opened(name, args) for name in args.recordings]
    sources = Sources(
        rest_s,
        _opened(args.rest_file, args) if args.rest_file else None,
        _opened(args.bite_plane, args) if args.bite_plane else None,
        Path(args.palate) if args.palate else None,
    )
    for recording in recordings:
        print(
            f"{recording.source}: {recording.format}, {recording.frame_count} frames, {recording.rate_hz:g} Hz",
            file=sys.stderr,
        )
    print(WORKING, file=sys.stderr)
    found = calibrate(recordings, model, sources, coils, frame, smoothing)
    for decision in found.decisions:
        print(f"  {decision}", file=sys.stderr)
    write_atomically(target, session_toml(found.session).encode())
    print(f"  written: {target}", file=sys.stderr)
    if args.report:
        from ..calibrationreport import write_report

        for file in write_report(found, model, Path(args.report)):
            print(f"  written: {file}", file=sys.stderr)
    print(f"  {next_step(args)}", file=sys.stderr)
    if args.json:
        print(json.dumps({"model": model.name, "model_fingerprint": model.fingerprint, **found.as_dict()}))
    return 0


def next_step(args: argparse.Namespace) -> str:
    """What to look at, and the command that uses the session."""
    import shlex

    stated = {
        "--model": None if args.model == BUNDLED else args.model,
        "--rate": args.rate and f"{args.rate:g}",
    }
    stated |= {"--unit": args.unit, "--layout": args.layout, "--session": args.output, "--out": "poses.csv"}
    flags = [word for flag, value in stated.items() if value is not None for word in (flag, str(value))]
    track = shlex.join(["tonguetrack", "track", args.recordings[0], *flags])
    if args.report:
        return f"next: look at {Path(args.report) / 'report.md'} and its pictures; then {track}"
    return f"next: {track} (with --report FOLDER, calibrate draws what it found)"


def parsed_interval(text: str) -> tuple[float, float]:
    """START:END in seconds."""
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*:\s*(\d+\.?\d*|\.\d+)\s*", text)
    if match is None:
        raise InputError(f"--rest {text}: expected START:END in seconds, as in 0:2.")
    return float(match[1]), float(match[2])


def named_smoothing(name: str) -> Smoothing:
    """A preset by its name, or none."""
    from ..smoothing import NO_SMOOTHING, PRESETS, smoothing_from_toml

    if name == "none":
        return NO_SMOOTHING
    if name not in PRESETS:
        raise InputError(
            f"--smoothing {name}: there is no such preset; choose from none, {', '.join(PRESETS)}."
        )
    return smoothing_from_toml({"preset": name})


def _opened(name: str, args: argparse.Namespace) -> Recording:
    from ...drivers import open_recording

    recording = open_recording(name, rate_hz=args.rate, unit=args.unit, layout=args.layout)
    if recording.frame_count == 0:
        raise InputError(f"{recording.source}: the recording has no frames.")
    return recording
