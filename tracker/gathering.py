"""The first seconds of a live source as a recording, so that what a session leaves open can be estimated."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from .. import InputError
from ..drivers.frames import CoilFrame, NoteKind, Recording
from ..drivers.replay import ReplaySource
from ..drivers.sources import Source
from .session import Session

MAX_FRAMES = 20_000
RATE_S = 0.1
UNKNOWN_RATE_HZ = 100.0
SHORTEST_STEP_S, LONGEST_STEP_S = 1e-6, 1.0
PATIENCE_S = 15.0
"""Without a single frame for this long nothing is going to come."""


def recording_for_setup(
    source: Source, session: Session, seconds: float, told: Callable[[str], None] = lambda text: None
) -> Recording:
    """What `complete_setup` needs to know of a source: as little as the session leaves open.

    Nothing is read where the session states the coils and their vertices and the rate is known; a replay's
    recording is at hand; a device is listened to for `seconds`, or for some frames where only its rate is missing.
    """
    if isinstance(source, ReplaySource):
        return source.recording
    tongue = [role for role in session.coils.values() if role.startswith("tongue_")]
    stated = bool(tongue) and all(role in session.correspondences for role in tongue)
    if stated and source.rate_hz:
        nothing = np.full((1, len(source.coils), 3), np.nan)
        return _recording(source, nothing, np.zeros(1), source.rate_hz)
    return gather(source, RATE_S if stated else seconds, told)


def gather(source: Source, seconds: float, told: Callable[[str], None] = lambda text: None) -> Recording:
    """Reads frames for `seconds` of the source's time, at least one, or four times as long and a second more of this host's.

    What the source says on the way goes to `told`, apart from its silence. Where the device's clock stands still
    or jumps, the frames' arrival tells the time.
    Raises InputError where no frame comes within PATIENCE_S, or the source ends before the first one.
    """
    positions: list[np.ndarray] = []
    turns: list[np.ndarray] = []
    times: list[float] = []
    last: CoilFrame | None = None
    since = time.perf_counter()
    for item in source:
        waited_s = time.perf_counter() - since
        if isinstance(item, CoilFrame):
            times.append(times[-1] + _step_s(last, item) if last is not None else 0.0)
            positions.append(np.array(item.positions))
            if item.quaternions is not None:
                turns.append(np.array(item.quaternions))
            last = item
            if times[-1] >= seconds or len(times) >= MAX_FRAMES:
                break
        elif item.kind is not NoteKind.SILENT:
            told(item.text)
        if times and waited_s > 4 * seconds + 1:
            break
        if not times and waited_s > PATIENCE_S:
            raise InputError(
                f"{source.address}: connected, but no frame came within {PATIENCE_S:.0f} s; is it measuring?"
            )
    if not times:
        raise InputError(f"{source.address}: the source ended before its first frame.")
    rate_hz = source.rate_hz or ((len(times) - 1) / times[-1] if times[-1] > 0 else UNKNOWN_RATE_HZ)
    quaternions = np.stack(turns) if len(turns) == len(times) else None
    return _recording(source, np.stack(positions), np.asarray(times), rate_hz, quaternions)


def _step_s(last: CoilFrame, frame: CoilFrame) -> float:
    """Time from one frame to the next, above 0."""
    step_s = frame.device_time_s - last.device_time_s
    if 0.0 < step_s <= LONGEST_STEP_S:
        return step_s
    return max((frame.arrival_ns - last.arrival_ns) * 1e-9, SHORTEST_STEP_S)


def _recording(
    source: Source,
    positions: np.ndarray,
    times_s: np.ndarray,
    rate_hz: float,
    quaternions: np.ndarray | None = None,
) -> Recording:
    return Recording(
        coils=source.coils,
        positions=positions,
        times_s=times_s,
        rate_hz=rate_hz,
        format="live",
        frame=source.frame,
        quaternions=quaternions,
        source=source.address,
    )
