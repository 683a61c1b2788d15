"""What handing a frame to the recorder costs the loop, beside the obvious way to do it.

    python tests/bench/recorder.py [--folder FOLDER] [--seconds N]

The obvious way (`bytes + queue`) makes one bytes object of the frame and appends it to a queue; it loses what a
killed process had in there. Both are timed in turns, in the same run, with the recorder's threads at work.
Then frames come at 1250 Hz, by which time a sleeping loop has lost its caches: again both ways, and with a disk
that is slow on purpose, flushes of 2 s, writes of 1 s.
"""

import argparse
import os
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tonguetrack.drivers.frames import CoilFrame, FrameOfReference
from tonguetrack.tracker.pose import TrackedPose
from tonguetrack.tracker.takes.appending import Sync, Write, flush_to_disk
from tonguetrack.tracker.takes.layout import TakeInfo
from tonguetrack.tracker.takes.recorder import TakeRecorder

ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum")
TURNS, FRAMES_A_TURN = 40, 500


def take_info(sensors: int, rate_hz: float) -> TakeInfo:
    return TakeInfo(
        "bench:", tuple(f"sensor_{i + 1}" for i in range(sensors)), rate_hz, FrameOfReference(), True, True, True,
        ROLES, (1, 2, 3), "none", "none", np.zeros(4), np.ones(4), 10, "", "", "",
    )  # fmt: skip


def some_frames(sensors: int) -> list[CoilFrame]:
    random = np.random.default_rng(1)
    return [
        CoilFrame(
            random.normal(size=(sensors, 3)), i * 0.0025, i, time.perf_counter_ns(),
            random.normal(size=(sensors, 4)), random.random(sensors), np.zeros(sensors, np.uint32),
        )
        for i in range(64)
    ]  # fmt: skip


def some_pose() -> TrackedPose:
    return TrackedPose(
        np.zeros(4), np.zeros(4), np.zeros(10), np.zeros(3), 0.5, 1.0, 3, 1, coil_states=np.zeros(3, np.int64)
    )


def obvious_way(coils: np.ndarray, pose: TrackedPose) -> Callable[[CoilFrame], None]:
    queue: deque[bytes] = deque(maxlen=1000)

    def append(frame: CoilFrame) -> None:
        head = np.array([frame.device_time_s, frame.frame_number, pose.status, pose.energy, pose.residual_mm])
        assert frame.quaternions is not None and frame.rms is not None and frame.status is not None
        queue.append(
            head.tobytes() + frame.positions.tobytes() + frame.quaternions.tobytes() + frame.rms.tobytes()
            + frame.status.tobytes() + coils.tobytes() + pose.weights.tobytes() + pose.speaker_weights.tobytes()
            + pose.residuals_mm.tobytes() + pose.coil_states.tobytes()
        )  # fmt: skip

    return append


def cost_of_put(sensors: int, folder: Path) -> str:
    frames, coils, pose = some_frames(sensors), np.zeros((3, 3)), some_pose()
    recorder = TakeRecorder(take_info(sensors, 1250.0), folder / f"{sensors}.xdf")
    recorder.open()
    obvious = obvious_way(coils, pose)
    times: dict[str, list[int]] = {"put": [], "bytes + queue": []}
    for _ in range(TURNS):
        for name, ways in (
            ("put", lambda frame: recorder.put(frame, coils, pose)),
            ("bytes + queue", obvious),
        ):
            times[name] += timed(ways, frames, FRAMES_A_TURN, 0.0)
        time.sleep(0.02)
    recorder.close()
    return f"{sensors} sensors: " + "; ".join(f"{name} {percentiles(ns)}" for name, ns in times.items())


def on_a_slow_disk(words: str, write: Write, sync: Sync, folder: Path, seconds: float) -> str:
    frames, coils, pose = some_frames(24), np.zeros((3, 3)), some_pose()
    recorder = TakeRecorder(take_info(24, 1250.0), folder / f"{words}.xdf", write, sync)
    recorder.open()
    ns = timed(lambda frame: recorder.put(frame, coils, pose), frames, int(1250 * seconds), 1 / 1250)
    waiting, behind_s = recorder.backlog, recorder.seconds_behind
    begin_s = time.perf_counter()
    summary = recorder.close()
    return (
        f"{words}, 24 sensors, 1250 Hz: put {percentiles(ns)}; at the end {waiting} rows were waiting, a power "
        f"cut would have taken {behind_s:.2f} s; close took {time.perf_counter() - begin_s:.1f} s, "
        f"{summary.frames} of {len(ns)} frames recorded"
    )


def timed(
    work: Callable[[CoilFrame], None], frames: list[CoilFrame], count: int, period_s: float
) -> list[int]:
    """ns that each call took."""
    ns = []
    due_s = time.perf_counter()
    for i in range(count):
        if period_s:
            due_s += period_s
            time.sleep(max(0.0, due_s - time.perf_counter()))
        frame = replace(frames[i % len(frames)], arrival_ns=time.perf_counter_ns())
        before = time.perf_counter_ns()
        work(frame)
        ns.append(time.perf_counter_ns() - before)
    return ns


def percentiles(ns: list[int]) -> str:
    p50, p99, p999 = np.percentile(ns, [50, 99, 99.9]) / 1000
    return f"p50 {p50:.1f} us, p99 {p99:.1f} us, p99.9 {p999:.0f} us, max {max(ns) / 1000:.0f} us"


def slow_write(handle: int, data: memoryview) -> int:
    time.sleep(1.0)
    return os.write(handle, data)


def slow_sync(handle: int) -> None:
    time.sleep(2.0)
    flush_to_disk(handle)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--folder", help="on the disk to try (default: the system's folder for temporary files)"
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="of each slow disk")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        for sensors in (16, 24):
            print(cost_of_put(sensors, folder))
        paced = timed(obvious_way(np.zeros((3, 3)), some_pose()), some_frames(24), 3000, 1 / 1250)
        print(f"bytes + queue, 24 sensors, 1250 Hz: {percentiles(paced)}")
        print(on_a_slow_disk("a good disk", os.write, flush_to_disk, folder, arguments.seconds))
        print(on_a_slow_disk("flushes of 2 s", os.write, slow_sync, folder, arguments.seconds))
        print(on_a_slow_disk("writes of 1 s", slow_write, flush_to_disk, folder, arguments.seconds))


if __name__ == "__main__":
    main()
