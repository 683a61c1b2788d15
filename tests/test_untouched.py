"""Receivers that stall, are absent or hostile leave tracking untouched.

The same run at 250 Hz, alone and with them, in turns on the same machine: what a frame takes from its arrival until
every sink has it is compared with itself. The bounds are wide, for machines that have other things to do; a loop that
waits for a receiver breaks them by far, as the last test shows.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from tonguetrack.drivers import ReplaySource
from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.live import run_live, stream_info
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.session import session_toml
from tonguetrack.tracker.setup import complete_setup
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.streams.feed import FeedAbout, FeedNumbers, FeedSink
from tonguetrack.tracker.streams.sink import StreamContext
from tonguetrack.tracker.streams.slot import SlotSink
from tonguetrack.tracker.streams.targets import open_target, parse_target

RATE_HZ = 250.0
FRAMES = 200
WORST_RATIO = {50: 20.0, 90: 100.0}
"""Percentile -> how many times its value alone it may be in bad company."""
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def demo():
    """The bundled recording, model and set-up: streams with avatar shapes need a model of a tongue."""
    model = bundled_model()
    recording, session = bundled_recording()
    return recording, model, complete_setup(recording, model, session)


def histogram(demo, sinks=()):
    """From arrival to sent, ns, of one run in real time; every frame must have been tracked."""
    recording, model, setup = demo
    tracker = Tracker(model, setup, RATE_HZ)
    status = LiveStatus(setup.roles, sinks)
    source = ReplaySource(recording, speed=1.0)
    summary = run_live(
        source, tracker, stream_info(model, setup, RATE_HZ), sinks, status, seconds=FRAMES / RATE_HZ
    )
    assert summary.frames == FRAMES and summary.gaps == 0
    return status.arrival_to_sent_ns


def ratios(demo, sinks):
    """Percentile -> company against alone, before or after, whichever was slower."""
    before = histogram(demo)
    company = histogram(demo, sinks)
    after = histogram(demo)
    return {
        percent: company.percentile(percent) / max(before.percentile(percent), after.percentile(percent))
        for percent in WORST_RATIO
    }


def assert_untouched(found):
    assert all(found[percent] <= worst for percent, worst in WORST_RATIO.items()), found


# The bad company --------------------------------------------------------------------------------------


def closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        return gone.getsockname()[1]


@contextmanager
def deaf_port():
    """A receiver that never reads: its buffer is full after some frames."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        deaf.bind(("127.0.0.1", 0))
        yield deaf.getsockname()[1]


class BadWorker:
    """A worker that hangs until it is let go, naps, or fails."""

    def __init__(self, how):
        self.destination = how
        self.let_go = threading.Event()

    def begin(self, info):
        pass

    def work(self, pose):
        if self.destination == "hangs":
            self.let_go.wait(PATIENCE_S)
        elif self.destination == "naps":
            time.sleep(0.15)
        else:
            raise OSError("no route")

    def end(self):
        pass


@contextmanager
def feed_of(demo, folder):
    _, model, setup = demo
    sizes = model.pose.size, model.speaker.size
    about = FeedAbout("bundled", session_toml(setup.session), setup.roles, setup.vertices, *sizes)
    sink = FeedSink(folder, about)
    sink.numbers = FeedNumbers
    try:
        yield sink
    finally:
        sink.close()


READER = """
import sys
from tonguetrack.tracker.streams.feed import FeedReader
feed = FeedReader(sys.argv[1])
print("reading", flush=True)
while True:
    feed.since(0)
"""


@contextmanager
def process(code, *arguments):
    started = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        assert started.stdout.readline()
        yield started
    finally:
        started.kill()
        started.wait()
        started.stdout.close()


# The comparison ---------------------------------------------------------------------------------------


def test_absent_and_deaf_receivers_of_every_protocol_leave_tracking_untouched(demo):
    with ExitStack() as stack:
        deaf = stack.enter_context(deaf_port())
        context = StreamContext(demo[1])
        targets = [
            f"{kind}://127.0.0.1:{port}?rate=0"
            for port in (closed_port(), deaf)
            for kind in ("osc", "vmc", "vrchat", "json")
        ]
        targets.append(f"osc://127.0.0.1:{deaf}?rate=60&filter=1,0.5&send=coils,shapes,mesh")
        targets.append("osc://192.0.2.1:9000")  # an address that nobody has (RFC 5737)
        sinks = [sink for target in targets for sink in open_target(parse_target(target), context)]
        for sink in sinks:
            stack.callback(sink.close)
        assert_untouched(ratios(demo, sinks))
        assert all(sink.sent + sink.dropped > 0 for sink in sinks)


def test_workers_that_hang_nap_or_fail_leave_tracking_untouched(demo):
    workers = [BadWorker(how) for how in ("hangs", "naps", "fails")]
    sinks = [SlotSink(worker) for worker in workers]
    assert_untouched(ratios(demo, sinks))
    for worker, sink in zip(workers, sinks, strict=True):
        worker.let_go.set()
        sink.close()
        assert sink.dropped > 0


@pytest.mark.skipif(os.name != "posix", reason="SIGSTOP")
def test_readers_of_the_feed_that_stop_or_never_rest_leave_tracking_untouched(demo, tmp_path):
    with ExitStack() as stack:
        feed = stack.enter_context(feed_of(demo, tmp_path))
        stopped = stack.enter_context(process(READER, str(tmp_path)))
        stopped.send_signal(signal.SIGSTOP)
        stack.enter_context(process(READER, str(tmp_path)))
        assert_untouched(ratios(demo, [feed]))
        assert (feed.sent, feed.dropped) == (FRAMES, 0)


HOSTILE = """
import os, select, socket, sys, time
port = int(sys.argv[1])
UPGRADE = (
    "GET /socket HTTP/1.1\\r\\nHost: 127.0.0.1:%d\\r\\nOrigin: http://127.0.0.1:%d\\r\\nUpgrade: websocket\\r\\n"
    "Connection: Upgrade\\r\\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\\r\\nSec-WebSocket-Version: 13\\r\\n\\r\\n"
    % (port, port)
).encode()
OPENINGS = (UPGRADE, UPGRADE, b"GET / HTTP/1.1\\r\\nHost: ", b"\\0" * 500)  # two never read, one dawdles, one babbles


def opened(number):
    made = socket.create_connection(("127.0.0.1", port))
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    made.sendall(OPENINGS[number % 4])
    made.setblocking(False)
    return made


clients = [opened(number) for number in range(100)]
print("there", flush=True)
while True:
    for number in range(1, 100, 2):  # garbage to open WebSockets; whoever was thrown out comes again
        try:
            clients[number].send(os.urandom(60))
        except BlockingIOError:
            pass
        except OSError:
            clients[number].close()
            clients[number] = opened(number)
    time.sleep(0.05)
"""


def test_a_hundred_hostile_clients_of_the_page_leave_tracking_untouched(demo, tmp_path):
    pytest.importorskip("websockets")
    from tonguetrack.tracker.outside import start_page

    ends = []
    with ExitStack() as stack:
        feed = stack.enter_context(feed_of(demo, tmp_path))
        page, url = start_page(tmp_path, "127.0.0.1:0", ends.append)
        stack.callback(page.close)
        stack.callback(feed.close)  # before the page is waited for, which goes by it
        stack.enter_context(process(HOSTILE, url.rstrip("/").rpartition(":")[2]))
        assert_untouched(ratios(demo, [feed]))
        assert (feed.sent, feed.dropped) == (FRAMES, 0)
        assert ends == [], "the page's server did not survive"


class Blocking:
    """What a sink must never be: it waits for its receiver in the loop's thread."""

    destination, sent, dropped = "a slow receiver", 0, 0

    def start(self, info):
        pass

    change = start

    def send(self, pose):
        if pose.frame_number % 3:
            time.sleep(0.05)

    def close(self):
        pass


def test_the_comparison_finds_a_loop_that_waits_for_a_receiver(demo):
    found = ratios(demo, [Blocking()])
    with pytest.raises(AssertionError):
        assert_untouched(found)
    assert np.isfinite(list(found.values())).all()
