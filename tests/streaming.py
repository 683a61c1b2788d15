"""What the tests of the streams have in common: the bundled model's poses, and a receiver on this computer."""

import contextlib
import socket
from functools import cache

import numpy as np

from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.pose import PoseStatus, TrackedPose
from tonguetrack.tracker.streams.sink import StreamContext, StreamInfo

ROLES = ("tongue_tip", "tongue_blade", "tongue dorsum")
PATIENCE_S = 10.0
PALATE = np.stack(
    [np.zeros(40), np.linspace(-3.0, 60.0, 40), 14.0 - np.linspace(-1.0, 1.0, 40) ** 2 * 6.0], axis=1
)


@cache
def model():
    return bundled_model()


def context(palate=PALATE, **more):
    return StreamContext(model(), palate, **more)


def info(roles=ROLES, rate_hz=250.0, fixed=True):
    mode = model().pose
    return StreamInfo(
        model().name, model().fingerprint, model().vertex_count, mode.mean, mode.sigma, model().speaker.mean, fixed,
        roles, rate_hz,
    )  # fmt: skip


def pose(number=0, sigmas=(0.5, -1.0, 1.5, 0.25), status=PoseStatus.OK, **changes):
    """A pose at these standard deviations; the third coil is missing."""
    normalised = np.asarray(sigmas, dtype=np.float64)
    coils = np.array([[0.0, 1.5, 3.25], [0.0, 12.0, 8.0], [np.nan] * 3])
    values = {
        "weights": model().pose.raw(normalised), "normalised": normalised,
        "speaker_weights": np.array(model().speaker.mean), "residuals_mm": np.array([0.25, 0.75, np.nan]),
        "residual_mm": 0.5, "energy": 1.0, "valid_coils": 2, "status": int(status),
        "device_time_s": 100.0 + number / 250.0, "frame_number": number, "coils": coils,
        "coil_states": np.array([0, 0, 1]),
    }  # fmt: skip
    return TrackedPose(**(values | changes))


def random_poses(count, seed=7):
    random = np.random.default_rng(seed)
    return [pose(k, random.normal(scale=2.0, size=model().pose.size)) for k in range(count)]


@contextlib.contextmanager
def receiver():
    """A UDP socket on a free port of this computer, and HOST:PORT."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 * 1024 * 1024)
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(PATIENCE_S)
        yield opened, f"127.0.0.1:{opened.getsockname()[1]}"


def waiting(opened):
    """All datagrams that have arrived."""
    opened.setblocking(False)
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(opened.recv(65536))
    opened.settimeout(PATIENCE_S)
    return found


def nobody():
    """HOST:PORT where nothing listens."""
    with receiver() as (_, place):
        return place
