"""Frames that a number alone decides, and a process whose children record them until they are killed.

    python tests/recorder_child.py

reads lines `TAKE FIFO RATE_HZ DISK` and forks a child for each, without answering. The child writes its process
number and then the sequence of every `put` that returned to the FIFO, each as 8 bytes. RATE_HZ 0: without
pauses. DISK `stuck`: nothing behind the headers is ever written; `slow`: each write takes 0.2 s; else `good`.

The tests load the first half of this file as a module.
"""

import os
import signal
import struct
import sys
import time

import numpy as np

from tonguetrack.drivers.frames import CoilFrame, FrameOfReference
from tonguetrack.tracker.pose import TrackedPose
from tonguetrack.tracker.takes.layout import TakeInfo
from tonguetrack.tracker.takes.recorder import TakeRecorder

COILS, ROLES, POSE, SPEAKER = 16, 3, 4, 10
MARK_EVERY = 25
PATTERN = np.random.default_rng(5).normal(size=400)


def take_info(rate_hz: float = 400.0, parts: bool = True) -> TakeInfo:
    """parts: whether the device has quaternions, fit errors and status words."""
    return TakeInfo(
        source="simulate:?coils=16",
        coils=tuple(f"coil_{i + 1}" for i in range(COILS)),
        rate_hz=rate_hz,
        frame=FrameOfReference(),
        quaternions=parts,
        rms=parts,
        status=parts,
        roles=("tongue_tip", "tongue_blade", "tongue_dorsum"),
        vertices=(10, 20, 30),
        model_name="no model",
        model_fingerprint="0" * 8,
        pose_mean=np.zeros(POSE),
        pose_sigma=np.ones(POSE),
        speaker_size=SPEAKER,
        session_toml="[session]\n",
        started="2025-06-01T12:00:00+02:00",
        version="1",
    )


def numbers(sequence: int, begin: int, *shape: int) -> np.ndarray:
    """Numbers that belong to the frame; some are missing, some have every bit set that a double has."""
    values = PATTERN[begin : begin + int(np.prod(shape))] * sequence / 3.0
    values[sequence % len(values)] = np.nan
    return values.reshape(shape)


def coil_frame(sequence: int, parts: bool = True) -> CoilFrame:
    return CoilFrame(
        numbers(sequence, 0, COILS, 3),
        sequence / 7.0,
        8 * sequence,
        1_000_000 * sequence + sequence % 977,
        numbers(sequence, 60, COILS, 4) if parts else None,
        numbers(sequence, 150, COILS) if parts else None,
        np.full(COILS, sequence % 2**32, np.uint32) if parts else None,
    )


def prepared_coils(sequence: int) -> np.ndarray:
    return numbers(sequence, 200, ROLES, 3)


def tracked_pose(sequence: int) -> TrackedPose:
    return TrackedPose(
        weights=numbers(sequence, 230, POSE),
        normalised=np.zeros(POSE),
        speaker_weights=numbers(sequence, 240, SPEAKER),
        residuals_mm=numbers(sequence, 260, ROLES),
        residual_mm=sequence / 11.0,
        energy=float("nan") if sequence % 5 == 0 else sequence / 13.0,
        valid_coils=sequence % 4,
        status=sequence % 3,
        arrival_ns=1_000_000 * sequence,
        solved_ns=1_000_000 * sequence + 123_456,
        speaker_fixed=sequence % 2 == 0,
        coil_states=np.arange(ROLES) + sequence % 3,
    )


def channels(sequence: int, parts: bool = True) -> dict[str, np.ndarray]:
    """What a take's sample of each stream has to hold, put together by another way than the recorder's."""
    frame, pose = coil_frame(sequence, parts), tracked_pose(sequence)
    raw = [[frame.device_time_s, frame.frame_number], frame.positions.ravel()]
    if parts:
        raw += [frame.quaternions.ravel(), frame.rms, frame.status]
    head = [
        pose.status, pose.speaker_fixed, pose.valid_coils, pose.energy, pose.residual_mm, 123_456 * 1e-9
    ]  # fmt: skip
    return {
        "raw": np.concatenate(raw),
        "prepared": prepared_coils(sequence).ravel(),
        "pose": np.concatenate(
            [head, pose.weights, pose.speaker_weights, pose.residuals_mm, pose.coil_states]
        ),
    }


def put(recorder: TakeRecorder, sequence: int, parts: bool = True) -> None:
    recorder.put(coil_frame(sequence, parts), prepared_coils(sequence), tracked_pose(sequence))


# The process ----------------------------------------------------------------------------------------


def record_until_killed(take: str, fifo: str, rate_hz: float, disk: str) -> None:
    report = os.open(fifo, os.O_WRONLY)
    os.write(report, struct.pack("<q", os.getpid()))
    opened = False

    def write(handle: int, data: memoryview) -> int:
        if opened and disk != "good":
            time.sleep(0.2 if disk == "slow" else 60.0)
        return os.write(handle, data)

    recorder = TakeRecorder(take_info(rate_hz / 4 or 1000.0), take, write)  # a smaller journal than usual
    recorder.open()
    opened = True
    sequence, begin_s = 0, time.perf_counter()
    while True:
        sequence += 1
        if sequence % MARK_EVERY == 0:
            recorder.mark(f"before {sequence}", 1_000_000 * sequence)
        put(recorder, sequence)
        os.write(report, struct.pack("<q", sequence))
        if rate_hz:
            time.sleep(max(0.0, begin_s + sequence / rate_hz - time.perf_counter()))


def main() -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the children
    for line in sys.stdin:
        take, fifo, rate_hz, disk = line.split("\t")
        if os.fork() == 0:
            try:
                record_until_killed(take, fifo, float(rate_hz), disk.strip())
            finally:
                os._exit(1)


if __name__ == "__main__":
    main()
