"""`tonguetrack live`: a device in, poses out, takes on the disk."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .demo import positive_seconds
from .names import BUNDLED
from .outputs import add_output_flags

if TYPE_CHECKING:
    from ...drivers.devices.authors_live import AuthorsLive
    from ...drivers.sources import Source
    from ...model.multilinear import TongueModel
    from ..control import ControlQueue
    from ..live import LiveRun
    from ..online import Tracker
    from ..session import Session
    from ..status import Summary
    from ..streams.sink import Sink
    from .outputs import Outputs

LISTEN_S = 3.0
"""So long a device is listened to where the session leaves coils or vertices open."""
FIX_AFTER_S = 5.0
ESTIMATORS = ("mean", "joint")


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `live`."""
    live = subparsers.add_parser(
        "live",
        help="track a device, or anything that stands in for one",
        description="Tracks a live source and streams the poses over OSC; records takes where asked. "
        "Ctrl-C stops the device and ends with a summary. `tonguetrack devices` lists the kinds of sources.",
    )
    live.add_argument(
        "source", metavar="SOURCE", help="rtc3d://HOST, ndi:///dev/ttyUSB0, replay:FILE, simulate:, ..."
    )
    live.add_argument("--session", metavar="FILE", help="the speaker's session file (TOML)")
    live.add_argument(
        "--model", default=BUNDLED, help="the tongue model (default: the bundled synthetic one)"
    )
    live.add_argument(
        "--coils", metavar="CHANNEL=ROLE,...", help="which channel is which coil, where names do not tell"
    )
    add_output_flags(live)
    live.add_argument("--record", metavar="TAKE.xdf",
                      help="record from the start; a folder instead: takes begin when asked for (key t, or OSC)")  # fmt: skip
    live.add_argument(
        "--seconds", type=positive_seconds, metavar="N", help="stop after N seconds of the device's time"
    )
    live.add_argument("--fix-speaker-after", type=positive_seconds, metavar="N", default=FIX_AFTER_S,
                      help="with no speaker in the session: fix it after N seconds of tracked speech (default %(default)g)")  # fmt: skip
    live.add_argument("--speaker", metavar="mean|joint|FILE|WEIGHTS", action="append", default=[],
                      help="how it is estimated: the mean of free solves as in the paper, or one for all frames, "
                      "estimated in the background (default mean); and, given again, on whose anatomy the tongue is shown: a "
                      "session file (.toml) with [speaker] weights, or raw weights, --speaker=0.1,-0.2,...")  # fmt: skip
    live.add_argument("--control", metavar="HOST:PORT",
                      help="where control messages over OSC are taken (default 127.0.0.1:9001)")  # fmt: skip
    live.add_argument("--calibrate", metavar="FOLDER",
                      help="first lead the speaker through rest, bite plane, palate sweep and vowels, as far as there "
                      "are coils for them; keep recordings, session and report there, and go on with that session")  # fmt: skip
    live.add_argument("--frame", metavar="'X Y Z'",
                      help='for --calibrate: where the device\'s axes grow, as in "front left up"')  # fmt: skip
    live.add_argument("--save-session", metavar="FILE",
                      help="at the end, write the session with everything that was estimated")  # fmt: skip
    live.add_argument("--json", action="store_true", help="print the summary as JSON")
    live.set_defaults(run=run_live_command)


def run_live_command(args: argparse.Namespace) -> int:
    """Set up, track until the end, print the summary. Exit code 1 where a take could not be recorded whole."""
    from pathlib import Path

    from ... import InputError
    from ..control import ControlQueue
    from ..guided import check_new_folder
    from ..online import compile_kernels
    from ..sources import open_source
    from ..takes.keeper import check_place, is_folder
    from .names import keep_apart, named_model, prepare_folder
    from .outputs import outputs_of
    from .track import read_session
    from .watching import announced_compilation

    model = named_model(args.model)
    estimator, shown_speaker = speakers(args.speaker)
    outputs = outputs_of(args, model, shown_speaker)
    session = read_session(args)
    for output in filter(None, (args.save_session, args.record)):
        keep_apart([Path(output)], [Path(args.model)])
        prepare_folder(Path(output))
    if args.save_session and Path(args.save_session).is_dir():
        raise InputError(f"--save-session {args.save_session}: this is a folder; name a file.")
    if args.frame and not args.calibrate:
        raise InputError("--frame goes with --calibrate; a session says it in its [alignment].")
    if args.calibrate:
        check_new_folder(Path(args.calibrate))
    if args.record:
        check_place(args.record)
        if is_folder(Path(args.record)):
            prepare_folder(Path(args.record) / "take.xdf")
    say(f"model: {model.name} [{model.fingerprint}]")
    with announced_compilation():
        compile_kernels(model)
    controls = ControlQueue()
    with ExitStack() as stack:
        control = serve_controls(args.control, controls, stack)
        say(f"opening {args.source}")
        job = Job(args, model, session, outputs, controls, control, estimator)
        return follow(job, open_source(args.source))


@dataclass(frozen=True)
class Job:
    """What a person asked for, read and checked. control: where control messages are taken, "" = nowhere; estimator: of
    `ESTIMATORS`."""

    args: argparse.Namespace
    model: TongueModel
    session: Session
    outputs: Outputs
    controls: ControlQueue
    control: str
    estimator: str


def speakers(texts: Sequence[str]) -> tuple[str, str | None]:
    """The estimator of the speaker, and on whose anatomy the tongue is shown, of all that was said with --speaker."""
    from ... import InputError

    estimators = [text for text in texts if text in ESTIMATORS]
    shown = [text for text in texts if text not in ESTIMATORS]
    if len(estimators) > 1 or len(shown) > 1:
        raise InputError(
            f"--speaker {' and '.join(estimators if len(estimators) > 1 else shown)}: give one of {' and '.join(ESTIMATORS)}, "
            "and one speaker to be shown."
        )
    if shown and not shown[0].lower().endswith(".toml") and not any(map(str.isdigit, shown[0])):
        raise InputError(
            f"--speaker {shown[0]}: expected mean or joint, how the speaker is estimated; or on whose anatomy the tongue is "
            "shown: a session file ending in .toml, or raw speaker weights with commas between them."
        )
    return estimators[0] if estimators else "mean", shown[0] if shown else None


def follow(job: Job, source: Source) -> int:
    """Runs on an open source, and closes it whatever happens; the command's exit code."""
    from ... import InputError
    from .watching import stopped_by_signals

    try:
        with stopped_by_signals(source) as stopped:
            try:
                summary = run_source(job, source)
            except InputError:  # a source that was stopped tells too little to begin with
                if not stopped.is_set():
                    raise
                summary = None
    finally:
        source.close()
    if summary is None:
        say("stopped before anything was tracked.")
        return 0
    show(job.args, summary)
    return 1 if any(take.failure for take in summary.takes) else 0


def show(args: argparse.Namespace, summary: Summary) -> None:
    """The summary, for people or scripts."""
    print(json.dumps(summary.as_dict(), indent=2, allow_nan=False) if args.json else summary)


def run_source(job: Job, source: Source) -> Summary | None:
    """One run; where clients drive the source, one after the other until it is stopped."""
    from pathlib import Path

    from ...drivers.devices.authors_live import AuthorsLive
    from ..gathering import recording_for_setup
    from ..online import Tracker
    from ..setup import complete_setup

    if isinstance(source, AuthorsLive):
        return serve_clients(job, source)
    session = job.session
    if job.args.calibrate:
        from .guiding import guided_session

        session = guided_session(source, job.model, session, Path(job.args.calibrate), job.args.frame)
    recording = recording_for_setup(source, session, LISTEN_S, say)
    setup = complete_setup(recording, job.model, session)
    for decision in setup.decisions:
        say(decision)
    fix_after_s = job.args.fix_speaker_after if job.estimator == "mean" else None
    rate_hz = source.rate_hz or recording.rate_hz
    tracker = Tracker(job.model, setup, rate_hz, watchful=True, fix_after_s=fix_after_s)
    return run_once(job, source, tracker)


def serve_clients(job: Job, source: AuthorsLive) -> Summary | None:
    """A run for each set of vertices that clients of the authors' server name, until the source is stopped."""
    from ... import InputError
    from ..online import Tracker
    from ..served import next_vertices, setup_for_points
    from ..session import NO_SESSION

    summary = None
    session = job.session if job.session.source != NO_SESSION else None
    say(f"{source.address}: waiting for a client to name its vertices")
    while source.wait_until_ready():
        try:
            setup = setup_for_points(job.model, source.coils, source.vertices, session)
        except InputError as reason:  # one client's mistake is not the end for the others
            say(str(reason))
            next_vertices(source)
            continue
        summary = run_once(job, source, Tracker(job.model, setup, source.rate_hz))
        if source.vertices == setup.vertices:
            break
    return summary


def run_once(job: Job, source: Source, tracker: Tracker) -> Summary:
    """Tracks with everything around it: sinks, takes, keys, the status line."""
    from pathlib import Path

    from ... import InputError
    from ...drivers.devices.authors_live import AuthorsLive
    from ...drivers.devices.source import DeviceSource
    from ..keyboard import KEYS, watched_keys
    from ..live import LiveRun, stream_info
    from ..served import obey_client
    from ..status import LiveStatus
    from ..streams.addresses import CONTROL_TAKE
    from ..takes.describing import take_info
    from ..takes.keeper import TakeKeeper, is_folder
    from .outputs import destinations, open_outputs
    from .watching import announced_compilation, say_above, status_line

    with announced_compilation():
        tracker.warm_up()
    args = job.args
    with ExitStack() as stack:
        opened = open_outputs(
            job.outputs, tracker, stack, model_name=args.model, control=job.control, title=source.address
        )
        sinks = [*opened.sinks, *answers_to(source, stack)]
        if isinstance(source, DeviceSource):
            source.catch_up()
        status = LiveStatus(tracker.setup.roles, sinks)
        opened.status = status
        keeper = None
        if args.record:
            keeper = TakeKeeper(
                args.record,
                lambda frame: take_info(source, frame, tracker.model, tracker.setup, tracker.rate_hz),
            )
            if is_folder(Path(args.record)):
                say(f"takes go to {args.record}, when asked for: key t or {CONTROL_TAKE} over OSC")
        recording = lambda: keeper is not None and keeper.recorder is not None
        if stack.enter_context(watched_keys(job.controls, recording)):
            say(f"keys: {KEYS}; Ctrl-C ends")
        run = LiveRun(
            source,
            tracker,
            stream_info(tracker.model, tracker.setup, tracker.rate_hz),
            status,
            sinks,
            keeper,
            job.controls,
            fix_after_s=args.fix_speaker_after,
            seconds=args.seconds,
            said=say_above,
            handles=obey_client if isinstance(source, AuthorsLive) else None,
        )
        if job.estimator == "joint" and tracker.setup.session.speaker_weights is None:
            estimate_beside(run, stack)
        say(f"tracking {', '.join(tracker.setup.roles)} to {destinations(sinks)}")
        with status_line(status):
            summary = run.run()
    if args.save_session:
        try:
            save_session(args.save_session, tracker)
        except InputError:  # the folder is gone or full meanwhile: the run itself is not lost with it
            show(args, summary)
            raise
    return summary


def answers_to(source: Source, stack: ExitStack) -> list[Sink]:
    """Where clients of the authors' server drive the source, they are answered."""
    from ...drivers.devices.authors_live import AuthorsLive
    from ..streams.authors import AuthorsSink

    if not isinstance(source, AuthorsLive):
        return []
    sink = AuthorsSink(source.reply)
    stack.callback(sink.close)
    return [sink]


def serve_controls(address: str | None, controls: ControlQueue, stack: ExitStack) -> str:
    """Listens for control messages; where, "" = nowhere. That the usual port is taken stops no run, unless it was
    asked for."""
    from ... import InputError
    from ..streams.control_osc import DEFAULT_CONTROL, OscControl
    from .watching import say_above

    try:
        control = stack.enter_context(OscControl(address or DEFAULT_CONTROL, controls, say_above))
    except InputError as reason:
        if address:
            raise
        say(f"no control over OSC: {reason}")
        return ""
    say(f"control over OSC at {control.address}")
    return control.address


def estimate_beside(run: LiveRun, stack: ExitStack) -> None:
    """Lets a thread estimate the speaker from the last seconds while the loop runs."""
    from ..background import BackgroundSpeaker

    setup = run.tracker.setup
    run.background = BackgroundSpeaker(
        run.tracker.model.at(setup.vertices),
        setup.session.energy,
        run.fix_after_s,
        1.0 / run.tracker.period_s,
    )
    stack.callback(run.background.close)
    run.background.warm_up()


def save_session(path: str, tracker: Tracker) -> None:
    """What was estimated in the run, to be edited and used again."""
    from ...atomic import write_atomically
    from ..session import session_toml

    write_atomically(path, session_toml(tracker.setup.session).encode())
    say(f"written: {path}")


def say(text: str) -> None:
    """A line for people."""
    print(text, file=sys.stderr, flush=True)
