"""A stream of the Lab Streaming Layer as a source of coils.

Channels are understood by their metadata: as the "MoCap" content type of XDF describes them (for every
channel `label`, `marker`, `object`, `type` such as PositionX or OrientationA, and `unit`), else by labels
NAME_x NAME_y NAME_z.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..frames import CoilFrame, FrameOfReference, NoteKind, SourceNote
from ..sources import SourceAddress
from .link import LinkLost
from .source import DeviceSource

FIND_S = 5.0
FIND_AGAIN_S = 0.5
"""So long a lost stream is looked for at a time, and `stop` is not noticed."""
ANSWER_S = 1.0
BUFFER_S = 60
MOST_CHANNELS = 4096
UNITS_MM = {
    "m": 1000.0, "meter": 1000.0, "meters": 1000.0, "metre": 1000.0, "metres": 1000.0,
    "mm": 1.0, "millimeter": 1.0, "millimeters": 1.0, "millimetre": 1.0, "millimetres": 1.0,
}  # fmt: skip
POSITIONS = ("positionx", "positiony", "positionz")
ORIENTATIONS = ("orientationa", "orientationb", "orientationc", "orientationd")  # A is the real part


@dataclass(frozen=True)
class Channel:
    """What a stream says of one channel; "" = nothing."""

    label: str = ""
    marker: str = ""
    object: str = ""
    type: str = ""
    unit: str = ""


@dataclass(frozen=True)
class ChannelMap:
    """Where the coils are among a sample's channels.

    positions: (coils, 3) and quaternions: (coils, 4) indices, -1 = not there; scale_mm: (coils, 1).
    """

    coils: tuple[str, ...]
    positions: NDArray[np.intp]
    quaternions: NDArray[np.intp]
    scale_mm: NDArray[np.float64]

    @property
    def oriented(self) -> bool:
        return bool((self.quaternions >= 0).all(axis=1).any())

    def frame(self, sample: Sequence[float], time_s: float, number: int, arrival_ns: int) -> CoilFrame:
        """A sample as a frame. What is not finite is missing, and so is a quaternion of length 0."""
        values = np.array([*sample, np.nan], np.float64)  # the last is where -1 points to
        values[~np.isfinite(values)] = np.nan
        positions = values[self.positions] * self.scale_mm
        positions[np.isnan(positions).any(axis=1)] = np.nan
        quaternions = None
        if self.oriented:
            quaternions = values[self.quaternions]
            with np.errstate(invalid="ignore"):
                length = np.linalg.norm(quaternions, axis=1)
            quaternions[~(length > 0)] = np.nan
        return CoilFrame(positions, time_s, number, arrival_ns, quaternions)


def map_channels(channels: Sequence[Channel], stated_unit: str, name: str) -> ChannelMap:
    """Finds the coils. stated_unit: "m" or "mm" where the stream does not say it, "" = not stated.

    Raises InputError that says what the channels are called where there is no coil among them, or asks for
    the unit.
    """
    parts: dict[tuple[str, str], dict[str, int]] = {}
    for index, channel in enumerate(channels):
        key, what = _place(channel)
        if what and parts.setdefault(key, {}).setdefault(what, index) != index:
            raise InputError(f"the stream '{name}' has {what} of '{key[1]}' twice; give its markers names.")
    whole = {key: found for key, found in parts.items() if all(part in found for part in POSITIONS)}
    if not whole:
        labels = ", ".join(channel.label or "?" for channel in channels[:12])
        raise InputError(
            f"the stream '{name}' has no coil among its channels ({labels}{', ...' if len(channels) > 12 else ''}); "
            "expected channels of type PositionX, PositionY, PositionZ for each marker, or labels NAME_x, "
            "NAME_y, NAME_z."
        )
    markers = [marker for _, marker in whole]
    coils = tuple(
        marker if markers.count(marker) == 1 else f"{group} {marker}".strip() for group, marker in whole
    )
    units = [{channels[found[part]].unit.strip().lower() for part in POSITIONS} for found in whole.values()]
    return ChannelMap(
        coils,
        np.array([[found[part] for part in POSITIONS] for found in whole.values()], np.intp),
        np.array([[found.get(part, -1) for part in ORIENTATIONS] for found in whole.values()], np.intp),
        np.array([[_scale_mm(unit, stated_unit, name)] for unit in units]),
    )


def _place(channel: Channel) -> tuple[tuple[str, str], str]:
    """((object, coil), what the channel is of it); what = "" for channels that are neither."""
    kind = channel.type.strip().lower()
    coil, _, axis = channel.label.strip().rpartition("_")
    if kind in POSITIONS or kind in ORIENTATIONS:
        marker = channel.marker.strip() or channel.object.strip() or coil
        return (channel.object.strip(), marker), kind
    if coil and not kind.startswith("orientation") and axis.lower() in ("x", "y", "z"):
        return ("", coil), f"position{axis.lower()}"
    return ("", ""), ""


def _scale_mm(units: set[str], stated_unit: str, name: str) -> float:
    known = {UNITS_MM[unit] for unit in units if unit in UNITS_MM}
    if len(known) == 1 and all(unit in UNITS_MM for unit in units):
        return known.pop()
    if stated_unit:
        return UNITS_MM[stated_unit]
    said = ", ".join(sorted(unit for unit in units if unit)) or "nothing"
    raise InputError(
        f"the stream '{name}' says of its unit: {said}; state whether it is metres or millimetres with "
        "?unit=m or ?unit=mm."
    )


class LslConversation:
    """One inlet. Stamps are the sender's clock as they came; what they would need is told once, not applied."""

    def __init__(
        self, inlet: Any, channels: ChannelMap, rate_hz: float, numbers: Iterator[int], note: str
    ) -> None:
        self.coils = channels.coils
        self.rate_hz = rate_hz
        self.frame = FrameOfReference()
        self.unasked = True
        self._inlet = inlet
        self._channels = channels
        self._note = note
        self._numbers = numbers

    def receive(self, timeout_s: float) -> CoilFrame | SourceNote | None:
        if self._note:
            note, self._note = self._note, ""
            return SourceNote(NoteKind.INFO, note, time.perf_counter_ns())
        try:
            sample, time_s = self._inlet.pull_sample(timeout=timeout_s)
        except RuntimeError as reason:  # the library's LostError, among others
            raise LinkLost(f"the stream is gone ({reason})") from reason
        arrival_ns = time.perf_counter_ns()
        if sample is None:
            return None
        return self._channels.frame(sample, time_s, next(self._numbers), arrival_ns)

    def goodbye(self) -> None:
        self._inlet.close_stream()


def open_lsl(address: SourceAddress) -> DeviceSource:
    """`lsl:NAME?timeout=5&unit=m`. A stream that goes away is looked for by its name until it is back.

    Raises InputError where pylsl is not installed, no such stream is found in time, several are, or its
    channels are not coils. Time stamps are the sender's LSL clock, and frames are counted from 1 as they come.
    """
    pylsl = _pylsl()
    name = unquote(address.path)
    unit = address.choice("unit", "", ("", "m", "mm"))
    find_s = address.number("timeout", FIND_S, 0.1, 600.0)

    numbers = count(1)

    def connect() -> LslConversation:
        nonlocal find_s
        found, find_s = pylsl.resolve_byprop("name", name, 1, find_s), FIND_AGAIN_S
        return _conversation(pylsl, found, name, unit, numbers)

    if "'" in name:  # they end the name in the library's own query
        raise InputError(
            f"'{address.text}': a stream with a quotation mark in its name cannot be looked for."
        )
    return DeviceSource(connect, address.text)


def _pylsl() -> Any:
    try:
        import pylsl
    except (ImportError, OSError, RuntimeError) as reason:  # RuntimeError: without its own library
        raise InputError(
            "streams of the Lab Streaming Layer need pylsl; install it with pip install 'tonguetrack[lab]'."
        ) from reason
    return pylsl


def _conversation(
    pylsl: Any, found: list[Any], name: str, unit: str, numbers: Iterator[int]
) -> LslConversation:
    if not found:
        raise InputError(
            f"no LSL stream is called '{name}'; is it running, in this network, and does no firewall stand between?"
        )
    if len({stream.uid() for stream in found}) > 1:
        places = ", ".join(f"{stream.type()} on {stream.hostname()}" for stream in found)
        raise InputError(f"several LSL streams are called '{name}' ({places}); give them different names.")
    if found[0].channel_format() == pylsl.cf_string or found[0].channel_count() > MOST_CHANNELS:
        raise InputError(f"the LSL stream '{name}' is one of text or of too many channels, not of coils.")
    inlet = pylsl.StreamInlet(found[0], max_buflen=BUFFER_S, max_chunklen=1, recover=False)
    try:
        info = inlet.info(timeout=ANSWER_S)
        channels = map_channels(_channels(info), unit, name)
        inlet.open_stream(timeout=ANSWER_S)
        return LslConversation(inlet, channels, info.nominal_srate(), numbers, _clock_note(inlet))
    except RuntimeError as reason:
        raise LinkLost(f"the LSL stream '{name}' does not answer ({reason})") from reason


def _channels(info: Any) -> list[Channel]:
    """As many as the stream has; those that its description leaves out are without a label."""
    channels: list[Channel] = []
    node = info.desc().child("channels").child("channel")
    while not node.empty() and len(channels) < info.channel_count():
        channels.append(
            Channel(*(node.child_value(key) for key in ("label", "marker", "object", "type", "unit")))
        )
        node = node.next_sibling("channel")
    return channels + [Channel()] * (info.channel_count() - len(channels))


def _clock_note(inlet: Any) -> str:
    try:
        offset_ms = 1e3 * inlet.time_correction(timeout=ANSWER_S)
    except RuntimeError:
        return "time stamps are the sender's clock; how far it is from this host's is not known"
    return f"time stamps are the sender's clock; {offset_ms:+.3f} ms would make them this host's LSL clock"
