"""`tonguetrack demo`: the bundled recording, tracked and streamed as if a device were sending it."""

from __future__ import annotations

import argparse
import json
import sys


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `demo`."""
    demo = subparsers.add_parser(
        "demo",
        help="replay the bundled sample recording, track it, stream it over OSC",
        description="Replays the bundled synthetic recording in real time through the bundled synthetic model and "
        "streams the poses over OSC. Ctrl-C ends it with the summary and exit code 0.",
    )
    demo.add_argument(
        "--osc", metavar="HOST:PORT", default="127.0.0.1:9000", help="where to send (%(default)s)"
    )
    demo.add_argument(
        "--seconds",
        type=positive_seconds,
        metavar="N",
        help="stop after N seconds of the recording, repeating it if need be (default: once)",
    )
    demo.add_argument("--fast", action="store_true", help="do not wait between frames")
    demo.add_argument("--json", action="store_true", help="print the summary as JSON")
    demo.set_defaults(run=run_demo)


def positive_seconds(text: str) -> float:
    """An argparse type: a finite number above 0."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0.0 < seconds < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' should be a number of seconds above 0")
    return seconds


def run_demo(args: argparse.Namespace) -> int:
    """Stream the bundled recording and print the summary."""
    from ..bundled import bundled_model, bundled_recording
    from ..live import stream_recording
    from ..online import Tracker
    from ..setup import complete_setup
    from ..streams.osc import resolve
    from .watching import announced_compilation, watched

    resolve(args.osc)
    model = bundled_model()
    recording, session = bundled_recording()
    setup = complete_setup(recording, model, session)
    speaker = "free" if setup.session.speaker_weights is None else "fixed"
    print(
        f"demo: synthetic recording, {recording.duration_s:.1f} s at {recording.rate_hz:g} Hz, coils "
        f"{', '.join(setup.roles)}; synthetic model '{model.name}', speaker {speaker}; OSC to {args.osc}",
        file=sys.stderr,
        flush=True,
    )
    with announced_compilation():
        Tracker(model, setup).warm_up()
    summary = stream_recording(
        recording, model, setup, args.osc, realtime=not args.fast, seconds=args.seconds, watch=watched
    )
    print(json.dumps(summary.as_dict(), indent=2, allow_nan=False) if args.json else summary)
    return 0
