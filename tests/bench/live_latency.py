"""Arrival to datagram, as the tracker says and as an outside receiver sees it; frames lost; memory over time.

    python tests/bench/live_latency.py [--sensors 16] [--rate 400] [--seconds 60] [--no-record]

Three processes: the RTC3D simulator, `tonguetrack live`, and this one, which receives the datagrams. The take
holds every frame's arrival on the clock that all processes of this machine share (`time.perf_counter_ns` is the
monotonic clock on Linux), so that the receiver's own stamps can be compared frame by frame.
"""

import argparse
import json
import re
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from tonguetrack.tracker.takes.reading import read_take

COILS = "Sensor 1=tongue_tip,Sensor 2=tongue_blade,Sensor 3=tongue_dorsum"
TONGUETRACK = [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())"]
WARM_UP_FRAMES = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sensors", type=int, default=16)
    parser.add_argument("--rate", type=float, default=400.0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--no-record", action="store_true", help="without a take; then only the tracker's own figures"
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        measure(args, Path(name))


def measure(args: argparse.Namespace, folder: Path) -> None:
    simulator = subprocess.Popen(
        [*TONGUETRACK, "simulate", "device", "rtc3d", "--synthetic", "--sensors", str(args.sensors),
         "--rate", str(args.rate), "--port", "0"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        assert simulator.stdout is not None
        address = simulator.stdout.readline().strip()
        session = folder / "session.toml"
        live(
            address,
            "--coils",
            COILS,
            "--seconds",
            "4",
            "--fix-speaker-after",
            "2",
            "--save-session",
            str(session),
        )
        receiver = Receiver()
        more = [] if args.no_record else ["--record", str(folder / "take.xdf")]
        summary, memory = live(
            address,
            "--session",
            str(session),
            "--seconds",
            str(args.seconds),
            "--osc",
            receiver.address,
            *more,
        )
        receiver.close()
        report(args, summary, memory, receiver, None if args.no_record else folder / "take.xdf")
    finally:
        simulator.terminate()
        simulator.wait()


def live(address: str, *options: str) -> tuple[dict, list[tuple[float, float]]]:
    """The summary, and (seconds since the start, resident MB) every second."""
    process = subprocess.Popen(
        [*TONGUETRACK, "live", address, "--json", *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    memory: list[tuple[float, float]] = []
    start = time.perf_counter()

    def watch() -> None:
        while process.poll() is None:
            try:
                status = Path(f"/proc/{process.pid}/status").read_text()
            except OSError:
                return
            if found := re.search(r"VmRSS:\s+(\d+) kB", status):
                memory.append((time.perf_counter() - start, int(found[1]) / 1024))
            time.sleep(1.0)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    out, err = process.communicate()
    if process.returncode:
        sys.exit(err)
    return json.loads(out), memory


class Receiver:
    """Stamps every frame's datagram as it comes; what the datagram says is looked at afterwards."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.5)
        self.address = f"127.0.0.1:{self._socket.getsockname()[1]}"
        self.stamps_ns: list[int] = []
        self.sequences: list[int] = []
        self._over = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        clock = time.perf_counter_ns
        while not self._over:
            try:
                datagram = self._socket.recv(2048)
            except TimeoutError:
                continue
            now_ns = clock()
            # The first message of a frame's bundle is /tongue/frame: sequence number, time, status.
            if datagram[20:33] == b"/tongue/frame":
                self.stamps_ns.append(now_ns)
                self.sequences.append(struct.unpack_from(">i", datagram, 20 + 16 + 8)[0])

    def close(self) -> None:
        self._over = True
        self._thread.join()
        self._socket.close()


def report(
    args: argparse.Namespace,
    summary: dict,
    memory: list[tuple[float, float]],
    receiver: Receiver,
    take: Path | None,
) -> None:
    print(
        f"{args.sensors} sensors at {args.rate:g} Hz for {args.seconds:g} s, {summary['frames']} frames tracked"
    )
    for name in ("host_to_solved_ms", "solved_to_sent_ms", "arrival_to_sent_ms"):
        print(f"  the tracker's own {name:20} {text(summary[name])}")
    if take is not None:
        found = read_take(take)
        arrivals = np.rint(found.stamps * 1e9).astype(np.int64)
        rows = np.array(receiver.sequences)
        seen_ms = (np.array(receiver.stamps_ns) - arrivals[rows])[WARM_UP_FRAMES:] * 1e-6
        p50, p99 = np.percentile(seen_ms, [50, 99])
        print(f"  outside: arrival to received    p50 {p50:.3f}  p99 {p99:.3f}  max {seen_ms.max():.3f} ms")
        numbers = np.diff(found.recording().frame_numbers)
        print(
            f"  device frames missing in the take: {int((numbers - 1).sum())}; rows {found.frame_count}, {found.state}"
        )
    print(f"  datagrams received: {len(receiver.sequences)} of {summary['sinks'][0]['sent']}")
    print(f"  the source says: {summary['gaps']} gaps, {summary['missing_frames']} frames missing")
    steady = [megabytes for seconds, megabytes in memory if seconds > 0.2 * memory[-1][0]]
    print(
        f"  resident memory after a fifth of the time {steady[0]:.1f} MB, at the end {steady[-1]:.1f} MB, most {max(steady):.1f} MB"
    )


def text(percentiles: dict) -> str:
    return "  ".join(f"{name} {percentiles[name]:.3f}" for name in ("p50", "p99", "max")) + " ms"


if __name__ == "__main__":
    main()
