"""`tonguetrack monitor`: listens on a UDP port and says what arrives."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

from .demo import positive_seconds

if TYPE_CHECKING:
    import socket

    from ..streams.monitor import Monitor

RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
REPORT_PERIOD_S = 1.0


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `monitor`."""
    monitor = subparsers.add_parser(
        "monitor",
        help="listen for OSC and print what arrives: rates, gaps, unknown addresses and names",
        description="Listens for OSC, VMC or VRChat parameters and prints what arrives. Ctrl-C ends it with the summary "
        "and exit code 0.",
    )
    monitor.add_argument(
        "--listen", metavar="HOST:PORT", default="127.0.0.1:9000", help="where to listen (%(default)s)"
    )
    monitor.add_argument("--seconds", type=positive_seconds, metavar="N", help="stop after N seconds")
    monitor.add_argument("--json", action="store_true", help="print the summary as JSON")
    monitor.add_argument(
        "--addresses", action="store_true", help="print what is sent where (docs/osc.md), and end"
    )
    monitor.add_argument(
        "--protocols",
        action="store_true",
        help="print all protocols that poses leave by (docs/protocols.md), and end",
    )
    monitor.set_defaults(run=run_monitor)


def run_monitor(args: argparse.Namespace) -> int:
    """Listen until stopped, then print the summary."""
    if args.addresses:
        from ..streams.addresses import protocol_page

        print(protocol_page(), end="")
        return 0
    if args.protocols:
        from ..streams.protocols import protocols_page

        print(protocols_page(), end="")
        return 0
    import logging
    import socket

    from ..streams.monitor import Monitor
    from ..streams.osc import listening_socket
    from ..streams.vocabularies import preset_vocabularies

    logging.getLogger().addHandler(logging.NullHandler())  # python-osc logs what we count
    receiver = listening_socket(args.listen, "--listen")
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    monitor = Monitor(tell=_say, vocabularies=preset_vocabularies())
    _say(f"listening on {args.listen.rpartition(':')[0]}:{receiver.getsockname()[1]}; Ctrl-C ends")
    try:
        _listen(receiver, monitor, args.seconds)
    except KeyboardInterrupt:
        pass
    finally:
        receiver.close()
    print(json.dumps(monitor.as_dict(), indent=2, allow_nan=False) if args.json else monitor, flush=True)
    return 0


def _listen(receiver: socket.socket, monitor: Monitor, seconds: float | None) -> None:
    import time

    from ..streams.monitor import MAX_BYTES

    start = time.perf_counter()
    end = start + (float("inf") if seconds is None else seconds)
    report, so_far = start + REPORT_PERIOD_S, (0, 0, 0)
    while (now := time.perf_counter()) < end:
        if now >= report:
            so_far = _report(monitor, *so_far)
            report += REPORT_PERIOD_S * (1 + int((now - report) / REPORT_PERIOD_S))
        receiver.settimeout(max(1e-3, min(end, report) - now))
        try:
            # One byte more than is taken apart, so that a longer datagram shows itself.
            datagram, sender = receiver.recvfrom(MAX_BYTES + 1)
        except OSError:  # the time is over, or an earlier answer of ours could not be delivered
            continue
        monitor.receive(datagram, (sender[0], sender[1]), time.perf_counter_ns())


def _report(
    monitor: Monitor, frames_before: int, misfits_before: int, datagrams_before: int
) -> tuple[int, int, int]:
    """One line a second while anything arrives. Returns the frames, the misfits and the datagrams so far."""
    from ..pose import PoseStatus

    frames = sum(stream.frames for stream in monitor.streams.values())
    misfits = sum(seen.misfits for seen in monitor.seen.values())
    so_far = frames, misfits, monitor.datagrams
    if frames == frames_before:
        if monitor.datagrams > datagrams_before:
            _say(f"{monitor.datagrams - datagrams_before} datagrams/s")
        return so_far
    others = f", {misfits - misfits_before} messages with other arguments" if misfits > misfits_before else ""
    newest, quality, sigma = (
        seen.fitting if (seen := monitor.seen.get(path)) else []
        for path in ("/tongue/frame", "/tongue/quality", "/tongue/sigma")
    )
    if not (newest and quality and sigma):
        _say(f"{frames - frames_before} frames/s{others}")
        return so_far
    lost = sum(stream.lost for stream in monitor.streams.values())
    number, _, state = newest
    residual, coils, latency = quality
    known = [int(status) for status in PoseStatus]
    name = PoseStatus(state).name.lower() if state in known else state
    weights = " ".join(f"{weight:+.2f}" for weight in sigma[:8])
    _say(
        f"{frames - frames_before} frames/s  frame {number} {name}  sigma {weights}  "
        f"residual {residual:.2f} mm  coils {coils}  latency {latency:.2f} ms  lost {lost}{others}"
    )
    return so_far


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
