"""The first seconds of a live source as a recording, so that what a session leaves open can be estimated."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from .. import InputError
from ..drivers.frames import CoilFrame, Recording, SourceNote
from ..drivers.replay import ReplaySource
from ..drivers.sources import Source
from .session import Session

MAX_FRAMES = 20_000
RATE_S = 0.1
UNKNOWN_RATE_HZ = 100.0
PATIENCE_S = 15.0
"""Without a single frame for this long nothing is going to come."""


def recording_for_setup(
    source: Source, session: Session, seconds: float, told: Callable[[SourceNote], None] = lambda note: None
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


def gather(
    source: Source, seconds: float, told: Callable[[SourceNote], None] = lambda note: None
) -> Recording:
    """Reads frames for `seconds` of the source's time, at least one. Notes on the way go to `told`.

    Raises InputError where no frame comes within PATIENCE_S, or the source ends before the first one.
    """
    positions: list[np.ndarray] = []
    times: list[float] = []
    since = time.perf_counter()
    for item in source:
        if not isinstance(item, CoilFrame):
            told(item)
            if not positions and time.perf_counter() - since > PATIENCE_S:
                raise InputError(
                    f"{source.address}: connected, but no frame came within {PATIENCE_S:.0f} s; is it measuring?"
                )
            continue
        if times and item.device_time_s <= times[-1]:
            positions.clear()  # the device's clock began anew, or it has none: only order is left
            times.clear()
        positions.append(np.array(item.positions))
        times.append(item.device_time_s)
        if times[-1] - times[0] >= seconds or time.perf_counter() - since > 4 * seconds + 1:
            break
        if len(times) >= MAX_FRAMES:
            break
    if not times:
        raise InputError(f"{source.address}: the source ended before its first frame.")
    span_s = times[-1] - times[0]
    rate_hz = source.rate_hz or ((len(times) - 1) / span_s if span_s > 0 else 0.0)
    return _recording(source, np.stack(positions), np.asarray(times) - times[0], rate_hz or UNKNOWN_RATE_HZ)


def _recording(source: Source, positions: np.ndarray, times_s: np.ndarray, rate_hz: float) -> Recording:
    return Recording(
        coils=source.coils,
        positions=positions,
        times_s=times_s,
        rate_hz=rate_hz,
        format="live",
        frame=source.frame,
        source=source.address,
    )
