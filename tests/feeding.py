"""A feed as a run would write it, and the page's server on it, for the tests of the page."""

import os
import queue
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.palate import curve_palate
from tonguetrack.tracker.pose import TrackedPose
from tonguetrack.tracker.session import session_toml
from tonguetrack.tracker.streams.feed import FeedAbout, FeedNumbers, FeedSink
from tonguetrack.tracker.streams.sink import StreamInfo

PERIOD_S = 0.01
START_S = 60.0
SERVER = "from tonguetrack.tracker.streams.page.server import main; main()"


class Feeder:
    """Writes one pose again and again, a hundred times a second, until closed; `show` makes it another one.

    palate: whether the session has one. control: HOST:PORT that the feed names. numbers: what the run says of itself.
    """

    def __init__(self, folder: Path, control: str = "", palate: bool = False, title: str = "a test") -> None:
        self.model = model = bundled_model()
        _, session = bundled_recording()
        self.speaker_weights = session.speaker_weights
        self.roles = tuple(session.correspondences)
        self.vertices = tuple(session.correspondences.values())
        if palate:
            y = np.arange(5.0, 50.0, 5.0)
            points = np.column_stack([np.zeros_like(y), y, 30.0 - 0.01 * (y - 25.0) ** 2])
            session = replace(session, palate=curve_palate(points, "made for a test"))
        about = FeedAbout(
            "bundled", session_toml(session), self.roles, self.vertices, 4, 5, control, title, 1 / PERIOD_S
        )
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.sink = FeedSink(folder, about)
        self.numbers = FeedNumbers()
        self.sink.numbers = lambda: self.numbers
        mode = model.pose
        self.sink.start(
            StreamInfo(
                model.name, model.fingerprint, model.vertex_count, mode.mean, mode.sigma, self.speaker_weights,
                True, self.roles, 1 / PERIOD_S,
            )
        )  # fmt: skip
        self.show([0, 0, 0, 0])
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()

    def show(self, normalised, speaker_weights=None, fixed=True, offset_mm=0.0, states=(0, 0, 0)) -> None:
        """The pose from now on, in sigma; the coils sit so far above their vertices."""
        weights = self.model.pose.raw(normalised)
        speaker = np.array(self.speaker_weights if speaker_weights is None else speaker_weights)
        coils = self.model.vertices(speaker, weights)[list(self.vertices)] + [0.0, 0.0, offset_mm]
        self.pose = TrackedPose(
            weights,
            np.array(normalised, dtype=float),
            speaker,
            np.full(len(self.roles), abs(offset_mm)),
            abs(offset_mm),
            0.0,
            len(self.roles),
            1,
            speaker_fixed=fixed,
            coil_states=np.array(states),
            coils=coils,
        )

    def contour(self) -> np.ndarray:
        """(c, 3) mm: where the mid-sagittal line of the present pose is."""
        from tonguetrack.model.midsagittal import midsagittal_vertices

        mesh = self.model.vertices(self.pose.speaker_weights, self.pose.weights)
        return mesh[midsagittal_vertices(self.model)]

    def _feed(self) -> None:
        while not self._over.wait(PERIOD_S):
            pose = self.pose
            pose.device_time_s += PERIOD_S
            pose.arrival_ns = time.perf_counter_ns() - 500_000
            pose.solved_ns = time.perf_counter_ns()
            self.sink.send(pose)

    def close(self) -> None:
        """The end of the run."""
        self._over.set()
        self._thread.join(5)
        self.sink.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


class Served:
    """The page's server as a process; url: what it said."""

    def __init__(self, folder: Path, address: str = "127.0.0.1:0") -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVER, str(folder), address],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=lambda: lines.put(self.process.stdout.readline()), daemon=True).start()
        line = lines.get(timeout=START_S)
        assert line.startswith("page http://"), line + self.process.stderr.read()
        self.url = line.split()[1]
        self.port = int(self.url.split(":")[2].split("/")[0])

    def end(self, hard: bool = False) -> str:
        """Ends it, however; what it wrote to stderr."""
        (self.process.kill if hard else self.process.terminate)()
        return self.process.communicate(timeout=20)[1]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.end(hard=True)
