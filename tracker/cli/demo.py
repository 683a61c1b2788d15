"""`tonguetrack demo`: the bundled recording, tracked and streamed as if a device were sending it."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import ExitStack

from .names import add_speaker_flag
from .outputs import add_output_flags


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `demo`."""
    demo = subparsers.add_parser(
        "demo",
        help="replay the bundled sample recording, track it, show and stream it",
        description="Replays the bundled synthetic recording in real time through the bundled synthetic model, streams the "
        "poses and shows them where asked. Ctrl-C ends it with the summary and exit code 0.",
    )
    add_output_flags(demo)
    add_speaker_flag(demo)
    demo.add_argument(
        "--seconds",
        type=positive_seconds,
        metavar="N",
        help="stop after N seconds of the recording, repeating it if need be (default: once; while it is shown, until "
        "Ctrl-C or until the window is closed)",
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
    from ...drivers.replay import ReplaySource
    from ..bundled import bundled_model, bundled_recording
    from ..live import run_live, stream_info
    from ..online import Tracker
    from ..setup import complete_setup
    from ..status import LiveStatus
    from .outputs import destinations, open_outputs, outputs_of
    from .watching import announced_compilation, watched

    model = bundled_model()
    outputs = outputs_of(args, model, args.speaker)
    recording, session = bundled_recording()
    setup = complete_setup(recording, model, session)
    speaker = "free" if setup.session.speaker_weights is None else "fixed"
    tracker = Tracker(model, setup, recording.rate_hz)
    with announced_compilation():
        tracker.warm_up()
    seconds = float("inf") if outputs.shown and args.seconds is None else args.seconds
    source = ReplaySource(recording, speed=None if args.fast else 1.0, loop=seconds is not None)
    info = stream_info(model, setup, source.rate_hz)
    with ExitStack() as stack:
        opened = open_outputs(outputs, tracker, stack, title="synthetic demo", window_closed=source.stop)
        print(
            f"demo: synthetic recording, {recording.duration_s:.1f} s at {recording.rate_hz:g} Hz, coils "
            f"{', '.join(setup.roles)}; synthetic model '{model.name}', speaker {speaker}; to "
            f"{destinations(opened.sinks)}",
            file=sys.stderr,
            flush=True,
        )
        status = LiveStatus(setup.roles, opened.sinks)
        opened.status = status
        with watched(source, status):
            summary = run_live(source, tracker, info, opened.sinks, status, seconds)
    print(json.dumps(summary.as_dict(), indent=2, allow_nan=False) if args.json else summary)
    return 0
