"""Where a run's poses go, as a user names it: --osc, --to, --view and --web."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from .names import BUNDLED
from .showing import add_ghost_flag

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel
    from ..online import Tracker
    from ..status import LiveStatus
    from ..streams.feed import FeedNumbers, FeedSink
    from ..streams.sink import LiveNumbers, Sink
    from ..streams.targets import Target
    from ..transfer import OtherSpeaker

DEFAULT_OSC = "127.0.0.1:9000"
DEFAULT_PAGE = "127.0.0.1:8080"


def add_output_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--osc", metavar="HOST:PORT", action="append",
                        help=f"send our own OSC there; may be given several times (default {DEFAULT_OSC}, unless "
                        "--to says otherwise)")  # fmt: skip
    parser.add_argument("--to", metavar="TARGET", action="append", default=[],
                        help="stream there as well: osc://HOST:PORT, vmc://HOST, vrchat://HOST, json://HOST, lsl:NAME, "
                        "oscquery://HOST, most with ?rate=HZ and more, see docs/streams.md; may be given several times")  # fmt: skip
    parser.add_argument("--view", action="store_true", help="show the tongue in a window (extra 'viewer')")
    add_ghost_flag(parser)
    parser.add_argument("--web", metavar="HOST:PORT", nargs="?", const=DEFAULT_PAGE,
                        help=f"show the tongue on a page for browsers (default {DEFAULT_PAGE}; extra 'web')")  # fmt: skip


@dataclass(frozen=True)
class Outputs:
    """What a user asked for, checked. page: HOST:PORT, "" = none; ghost: FILE[@SECONDS] for the window, "" = none;
    other: the speaker on whose anatomy meshes are made, None = on that of the one who is tracked."""

    osc: tuple[str, ...]
    targets: tuple[Target, ...]
    view: bool
    page: str
    ghost: str = ""
    other: OtherSpeaker | None = None

    @property
    def shown(self) -> bool:
        return self.view or bool(self.page)


def outputs_of(args: argparse.Namespace, model: TongueModel, speaker: str | None) -> Outputs:
    """speaker: what --speaker says of the anatomy that is shown, None = nothing.

    Raises InputError where a destination is none, its host is unknown, the page's port is taken, or the speaker is none
    of the model's.
    """
    from ... import InputError
    from ..streams.osc import resolve
    from ..streams.targets import parse_target

    targets = tuple(parse_target(text) for text in args.to)
    osc = tuple(args.osc or ([] if targets else [DEFAULT_OSC]))
    for destination in osc:
        resolve(destination)
    check_each_once(osc, targets)
    if args.web:
        check_page(args.web)
    if args.ghost and not args.view:
        raise InputError("--ghost is shown in the window: add --view.")
    outputs = Outputs(osc, targets, args.view, args.web or "", args.ghost or "")
    if speaker is None:
        return outputs
    from ..transfer import other_speaker

    other = other_speaker(speaker, model)
    if not outputs.shown and not any(makes_a_mesh(target) for target in targets):
        raise InputError(
            "--speaker says on whose anatomy the tongue is shown; add what shows it: --view, --web, or --to with "
            "osc://HOST:PORT?send=mesh or oscquery://HOST."
        )
    return replace(outputs, other=other)


def check_each_once(osc: Sequence[str], targets: Sequence[Target]) -> None:
    """Raises InputError where one place would get the same twice: a receiver would take it for one confused stream."""
    from ... import InputError
    from ..streams.osc import parse_destination

    named = [("osc", *parse_destination(text), "", "") for text in osc]
    named += [(each.kind.scheme, each.host, each.port, each.name, each.preset) for each in targets]
    for place in named:
        if named.count(place) > 1:
            scheme, host, port, name, _ = place
            raise InputError(
                f"{scheme} to {name or f'{host}:{port}'} is named twice; name each target once, with all its options."
            )


def makes_a_mesh(target: Target) -> bool:
    return target.kind.scheme == "oscquery" or "mesh" in target.send


def check_page(address: str) -> None:
    """Raises InputError where a server could not listen there, or the extra is missing: better now than after minutes of
    calibration."""
    import socket
    from importlib.util import find_spec

    from ... import InputError
    from ..streams.osc import resolve

    if find_spec("websockets") is None:
        raise InputError("the page needs the extra 'web': pip install 'tonguetrack[web]'.")
    family, place = resolve(address, lowest_port=0)
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        try:
            probe.bind(place)
            probe.listen(1)
        except OSError as reason:
            raise InputError(
                f"{address}: the page cannot be served there ({reason.strerror}); give another --web."
            ) from reason


class OpenOutputs:
    """The open ways out of one run.

    status: what receivers that are told of the run are told, once it is known.
    """

    def __init__(self) -> None:
        self.sinks: list[Sink] = []
        self.status: LiveStatus | None = None
        self._frames, self._then_s = 0, time.perf_counter()

    def numbers(self) -> LiveNumbers:
        from ..streams.sink import LiveNumbers

        return LiveNumbers() if self.status is None else self.status.numbers

    def feed_numbers(self) -> FeedNumbers:
        """The same, what is wrong, and the status line with the rate since the last call."""
        from ..streams.feed import FeedNumbers
        from .watching import status_text

        status, now_s = self.status, time.perf_counter()
        if status is None:
            return FeedNumbers()
        rate_hz = (status.frames - self._frames) / max(now_s - self._then_s, 1e-3)
        self._frames, self._then_s = status.frames, now_s
        return FeedNumbers(status.numbers, tuple(status.troubles), status_text(status, rate_hz))


def open_outputs(
    outputs: Outputs,
    tracker: Tracker,
    stack: ExitStack,
    *,
    model_name: str = BUNDLED,
    control: str = "",
    title: str = "",
    window_closed: Callable[[], None] = lambda: None,
) -> OpenOutputs:
    """Opens them all, to be closed by the stack. model_name: a file or "bundled"; control: where control messages are
    taken, "" = nowhere; title: for people; window_closed: called in a thread when a user closes the window.

    Raises InputError where the page cannot be served, or the ghost is of another model; a window that cannot open is a sentence on stderr.
    """
    from ..streams.osc import OscSink
    from ..streams.sink import StreamContext
    from ..streams.targets import open_target
    from ..streams.transferred import TransferredSink
    from .watching import say_above

    opened = OpenOutputs()
    for destination in outputs.osc:
        osc = OscSink(destination)
        osc.numbers = opened.numbers
        stack.callback(osc.close)
        opened.sinks.append(osc)
    if outputs.targets:
        session = tracker.setup.session
        palate = None if session.palate is None else session.palate.points_mm
        context = StreamContext(tracker.model, palate, session.shape_ranges, control=control)
        if (other := outputs.other) is not None:
            shown_palate = None if other.palate is None else other.palate.points_mm
            context = replace(context, shown_speaker=other.weights, shown_palate=shown_palate)
        for target in outputs.targets:
            for sink in open_target(target, context, opened.numbers, say_above):
                stack.callback(sink.close)
                opened.sinks.append(sink)
    if outputs.shown:
        feed = _show(outputs, tracker, stack, model_name, control, title, window_closed)
        feed.numbers = opened.feed_numbers
        opened.sinks.append(feed if outputs.other is None else TransferredSink(feed, outputs.other.weights))
    return opened


def _show(
    outputs: Outputs,
    tracker: Tracker,
    stack: ExitStack,
    model_name: str,
    control: str,
    title: str,
    window_closed: Callable[[], None],
) -> FeedSink:
    """The feed, and the processes that show it."""
    from ..outside import GHOST_NAME, start_page, start_window
    from ..posefiles import write_poses
    from ..session import session_toml
    from ..streams.feed import FeedAbout, FeedSink
    from ..streams.feedfolder import feed_folder
    from ..transfer import session_of, transferred
    from .showing import read_ghost
    from .watching import say_above

    model, setup, other = tracker.model, tracker.setup, outputs.other
    session, roles, vertices = setup.session, setup.roles, setup.vertices
    if other is not None:  # with that speaker's palate, and without coils, which are in another mouth
        session, roles, vertices = session_of(other), (), ()
    about = FeedAbout(
        model=model_name if model_name == BUNDLED else str(Path(model_name).resolve()),
        session=session_toml(session),
        roles=roles,
        correspondences=vertices,
        coefficients=model.pose.size,
        speaker_weights=model.speaker.size,
        control=control,
        title=title,
        rate_hz=tracker.rate_hz,
    )
    folder = stack.enter_context(feed_folder())
    shown = [name for name, wanted in (("window", outputs.view), ("page", outputs.page)) if wanted]
    feed = FeedSink(folder, about, " and ".join(shown))
    stack.callback(feed.close)

    def window_ended(complaint: str) -> None:
        if complaint:
            say_above(f"no window: {complaint}")
        else:
            window_closed()

    def page_ended(complaint: str) -> None:
        if complaint:  # without one it has ended with the run, as it should
            say_above(f"the page has ended: {complaint}")

    if outputs.page:
        page, url = start_page(folder, outputs.page, page_ended)
        stack.callback(page.close)
        say_above(f"page: {url}")
    if outputs.ghost:
        ghost = read_ghost(outputs.ghost, model)
        write_poses(ghost if other is None else transferred(ghost, other), model, folder / GHOST_NAME)
    if outputs.view:
        stack.callback(start_window(folder, window_ended).close)
    stack.callback(feed.close)  # before the processes are waited for, which go by it
    return feed


def destinations(sinks: Sequence[Sink]) -> str:
    """Where poses go, for people."""
    return ", ".join(sink.destination for sink in sinks)
