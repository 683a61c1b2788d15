"""What a person sees of a live run: the compilation notice, the status line, and Ctrl-C as a clean end."""

from __future__ import annotations

import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from ..kernelcache import cache_lasts, compilations
from ..latency import NS_PER_MS, NS_PER_US, LogHistogram
from ..live import FrameSource
from ..pose import PoseStatus
from ..status import LiveStatus

TERMINAL_PERIOD_S = 0.2
PLAIN_PERIOD_S = 5.0
COMPILING_AFTER_S = 1.0
LEGEND = "rate, status, residual, coils valid, frames dropped, solve p50/p99, arrival to sent p50/p99:"


@contextmanager
def announced_compilation() -> Iterator[None]:
    """Says on stderr when the kernels are being compiled, and how long that took; silent when they only load."""

    def announce() -> None:
        _say(
            "preparing the solver; the first time on this machine it is compiled, which takes up to half a minute ..."
        )

    before, start = compilations(), time.perf_counter()
    notice = threading.Timer(COMPILING_AFTER_S, announce)
    notice.daemon = True
    notice.start()
    try:
        yield
    finally:
        notice.cancel()
    if compilations() > before:
        lasts = (
            "the next start finds it ready."
            if cache_lasts()
            else "it cannot be kept here; name a folder that can be written to with NUMBA_CACHE_DIR."
        )
        _say(f"the solver was compiled in {time.perf_counter() - start:.1f} s; {lasts}")


@contextmanager
def watched(source: FrameSource, status: LiveStatus) -> Iterator[None]:
    """A status line on stderr and a clean end at Ctrl-C, for as long as a run lasts."""
    with stopped_by_signals(source), status_line(status):
        yield


@contextmanager
def stopped_by_signals(source: FrameSource) -> Iterator[threading.Event]:
    """The first Ctrl-C, request to terminate, or end of the terminal stops the source, so that the run ends as at its last frame;
    a second one interrupts. The event is set once that has happened."""
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # not under nohup
        before[signal.SIGHUP] = signal.SIG_DFL

    def stop(number: int, frame: FrameType | None) -> None:
        restore()
        stopped.set()
        source.stop()

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    for number in before:
        signal.signal(number, stop)
    try:
        yield stopped
    finally:
        restore()


@contextmanager
def status_line(status: LiveStatus) -> Iterator[None]:
    """Shows the status on stderr from a thread of its own: in place on a terminal, else a line now and then."""
    over = threading.Event()
    thread = threading.Thread(target=_show, args=(status, over), name="status line", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(timeout=1.0)  # a terminal that was stopped must not keep the summary waiting


def _show(status: LiveStatus, over: threading.Event) -> None:
    terminal = sys.stderr.isatty()
    frames, then = status.frames, time.perf_counter()
    try:
        if terminal:
            _say(LEGEND)
        while not over.wait(TERMINAL_PERIOD_S if terminal else PLAIN_PERIOD_S):
            if status.frames == 0:
                continue
            now = time.perf_counter()
            line = status_text(status, (status.frames - frames) / (now - then))
            frames, then = status.frames, now
            if terminal:
                width = shutil.get_terminal_size().columns - 1
                sys.stderr.write(f"\r{whole_parts(line, width):<{width}}")
                sys.stderr.flush()
            else:
                _say(line)
        if terminal:
            sys.stderr.write(_blank_line())
            sys.stderr.flush()
    except (OSError, ValueError):  # nobody reads stderr any more
        return


def status_text(status: LiveStatus, rate_hz: float) -> str:
    """One line as `LEGEND` says; what is wrong comes first, then how many frames the take has."""
    state = PoseStatus(status.status).name.lower()
    residual = f"{status.residual_mm:.2f}" if status.valid_coils else "-"
    troubles = status.troubles
    wrong = f"[{', '.join(troubles)}] " if troubles else ""
    return (
        f"{wrong}{_take_text(status)}{rate_hz:.0f} Hz {state}  {residual} mm  "
        f"{status.valid_coils}/{len(status.coils_missing)} coils  {status.dropped} dropped  "
        f"solve {_pair(status.solve_ns, NS_PER_US, 0)} us  "
        f"sent {_pair(status.arrival_to_sent_ns, NS_PER_MS, 2)} ms"
    )


def whole_parts(line: str, width: int) -> str:
    """As many of the parts between double spaces as fit: half a number would be another one."""
    if len(line) <= width:
        return line
    end = line.rfind("  ", 0, width + 2)
    return line[: end if end > 0 else width]


def _take_text(status: LiveStatus) -> str:
    return f"rec {status.take_frames}  " if status.take_path and not status.take_failure else ""


def say_above(text: str) -> None:
    """A line for a person, in the place of the status line, which comes again below it.

    That nobody reads stderr any more ends no run.
    """
    with suppress(OSError, ValueError):
        _say((_blank_line() if sys.stderr.isatty() else "") + text)


def _blank_line() -> str:
    return "\r" + " " * (shutil.get_terminal_size().columns - 1) + "\r"


def _pair(histogram: LogHistogram, unit: float, digits: int) -> str:
    values = (histogram.percentile(50.0), histogram.percentile(99.0))
    return "/".join("-" if value is None else f"{value / unit:.{digits}f}" for value in values)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
