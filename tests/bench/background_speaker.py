"""What estimating the speaker in the background costs the loop: the same paced run with and without it, in turns.

    python tests/bench/background_speaker.py [--rate 400] [--window 5] [--turns 12] [--seconds 5]

Frames of five coils are replayed at their pace, tracked and sent over OSC on loopback. "beside" also hands every frame
to a BackgroundSpeaker, within the time that is measured. Prints, for all turns of each kind together: from a frame's
arrival until it was sent, and by how much frames were handed over late, which is where a thread that holds the
interpreter's lock would show; then how often and how fast the speaker was estimated.
"""

import argparse
import socket
import time
from typing import ClassVar

import numpy as np

from tonguetrack.drivers.replay import ReplaySource
from tonguetrack.model import TongueModel
from tonguetrack.tracker import background
from tonguetrack.tracker.anatomy import SpeakerEstimate, SpeakerEstimator
from tonguetrack.tracker.background import BackgroundSpeaker
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.latency import NS_PER_MS, latency_histogram, percentiles_text
from tonguetrack.tracker.live import run_live, stream_info
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.pose import FloatArray, TrackedPose
from tonguetrack.tracker.session import Energy
from tonguetrack.tracker.setup import Setup
from tonguetrack.tracker.status import LiveStatus
from tonguetrack.tracker.streams.osc import OscSink
from tonguetrack.tracker.streams.sink import Sink, StreamInfo


class Listener:
    """A sink that hands the frames' coils on to the background."""

    destination = "the background"
    dropped = 0

    def __init__(self, tracker: Tracker, speaker: BackgroundSpeaker) -> None:
        self._tracker = tracker
        self._speaker = speaker
        self.sent = 0

    def start(self, info: StreamInfo) -> None: ...

    def change(self, info: StreamInfo) -> None: ...

    def send(self, pose: TrackedPose) -> None:
        self._speaker.add(self._tracker.coils)
        self.sent += 1

    def close(self) -> None: ...


class TimedEstimator(SpeakerEstimator):
    """Notes how long each estimate took, in ms."""

    took_ms: ClassVar[list[float]] = []

    def estimate(
        self, coils: FloatArray, start: FloatArray | None = None, robust: bool = True
    ) -> SpeakerEstimate | None:
        before = time.perf_counter()
        found = super().estimate(coils, start, robust)
        self.took_ms.append(1e3 * (time.perf_counter() - before))
        return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rate", type=float, default=400.0)
    parser.add_argument("--window", type=float, default=5.0)
    parser.add_argument("--turns", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=5.0)
    args = parser.parse_args()
    background.SpeakerEstimator = TimedEstimator  # type: ignore[misc]
    model = bundled_model()
    recording, setup = made_up_recording(model, round(args.seconds * args.rate), args.rate)
    at_coils = model.at(setup.vertices)
    speaker = BackgroundSpeaker(at_coils, Energy(), args.window, args.rate)
    speaker.warm_up()
    for frame in recording.positions[: round(args.window * args.rate)]:
        speaker.add(np.ascontiguousarray(frame))  # so that the first turn has a full window already
    sent = {"alone": latency_histogram(), "beside": latency_histogram()}
    late = {"alone": latency_histogram(), "beside": latency_histogram()}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        for turn in range(args.turns):
            kind = "beside" if turn % 2 else "alone"
            source = ReplaySource(recording)
            status = one_turn(
                source, model, setup, receiver.getsockname()[1], speaker if kind == "beside" else None
            )
            sent[kind].merge(status.arrival_to_sent_ns)
            for lateness in source.lateness_ns[source.lateness_ns >= 0].tolist():
                late[kind].add(lateness)
    speaker.close()
    for name, histograms in (("arrival to sent", sent), ("handed over late", late)):
        for kind, histogram in histograms.items():
            print(f"{name:16}  {kind:6}  {percentiles_text(histogram.as_dict(NS_PER_MS), 'ms')}")
    took = np.array(TimedEstimator.took_ms)
    print(f"{len(took)} estimates of {speaker.latest.frames if speaker.latest else 0} frames: "
          f"median {np.median(took):.1f} ms, longest {took.max():.1f} ms")  # fmt: skip


def one_turn(
    source: ReplaySource, model: TongueModel, setup: Setup, port: int, speaker: BackgroundSpeaker | None
) -> LiveStatus:
    tracker = Tracker(model, setup, source.rate_hz)
    osc = OscSink(f"127.0.0.1:{port}")
    sinks: list[Sink] = [osc, Listener(tracker, speaker)] if speaker else [osc]
    info = stream_info(model, setup, source.rate_hz)
    status = LiveStatus(info.roles, sinks)
    try:
        run_live(source, tracker, info, sinks, status)
    finally:
        osc.close()
    return status


if __name__ == "__main__":
    main()
