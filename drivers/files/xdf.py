"""Coils out of XDF: our own takes, and other people's files with one stream of positions.

A take that was cut off, by a crash or because it is still being written, opens up to its last whole chunk
with a note. Other formats refuse a truncated file, for there the loss would be a surprise; a take is made to
be read in that state, and its frames before the cut are as good as ever.

Other people's streams are told by their channels: types PositionX, PositionY, PositionZ (XDF wiki, page "MoCap
Meta Data") with a marker, or labels NAME_x, NAME_y, NAME_z. Stamps stay in the sender's clock.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ... import InputError
from ..frames import FloatArray, FrameOfReference, Recording
from ..xdf import MAGIC, STRING, Buffer, Channel, XdfFile, XdfStream, read_xdf
from .common import UNITS_MM, Options, check_rate, clean, coverage_notes, even_times, frame_times

TAKE_MARK, TAKE_VERSION = "tonguetrack_take", "1"
RAW = "raw"
LARGEST_STATUS = 0xFFFFFFFF
CLOCKS_APART_S, CLOCKS_APART = 1.0, 0.01
"""So much a device's clock and the host's may differ over a take, with its share of the take's length."""
LONGEST_TAKE_S = 1e7
"""A time stamp farther from the first one is damaged."""
_EXACT = 2.0**53  # whole numbers up to here are the same as float64

_UNIT_WORDS = {
    **{word: "m" for word in ("m", "meter", "meters", "metre", "metres")},
    **{word: "dm" for word in ("dm", "decimeter", "decimeters", "decimetre", "decimetres")},
    **{word: "cm" for word in ("cm", "centimeter", "centimeters", "centimetre", "centimetres")},
    **{word: "mm" for word in ("mm", "millimeter", "millimeters", "millimetre", "millimetres")},
    **{word: "um" for word in ("um", "µm", "μm", "micrometer", "micrometers", "micrometre", "micrometres")},
}
_POSITION_LABEL = re.compile(r"(.+?)[ ._-]?(?:pos(?:ition)?)?[ ._-]?([xyzXYZ])", re.DOTALL)


def is_xdf(head: bytes) -> bool:
    return head.startswith(MAGIC)


def parse_xdf(data: Buffer, name: str, options: Options) -> Recording:
    """The `raw` stream of a take, or the one stream of positions of another file.

    `options.layout` names the stream where several have positions. Raises InputError that lists the streams
    where none or several have.
    """
    file = read_xdf(data, name)
    raw = next((s for s in file.streams if s.name == RAW and TAKE_MARK in s.description), None)
    if raw is not None and options.layout in (None, RAW):
        return _from_take(raw, file, name, options)
    return _from_stream(*_chosen(file, name, options.layout), file, name, options)


# Our takes ------------------------------------------------------------------------------------------


def _from_take(raw: XdfStream, file: XdfFile, name: str, options: Options) -> Recording:
    if raw.description[TAKE_MARK] != TAKE_VERSION:
        raise InputError(
            f"{name}: the take has version {raw.description[TAKE_MARK][:20]!r}; {TAKE_VERSION} is known."
        )
    if options.unit not in (None, "mm"):
        raise InputError(f"{name}: a take's positions are in mm, so --unit {options.unit} cannot hold.")
    try:
        coils, frame = json.loads(raw.description["coils"]), json.loads(raw.description["frame"])
        parts = [bool(part) for part in json.loads(raw.description["parts"])]
    except (KeyError, ValueError, TypeError, RecursionError) as reason:
        raise InputError(f"{name}: the take's description is damaged ({str(reason)[:80]}).") from reason
    if not _are_texts(coils) or not _are_texts(frame) or len(frame) != 4 or len(parts) != 3:
        raise InputError(f"{name}: the take's description is damaged.")
    head = TakeHead(tuple(coils), FrameOfReference(*frame), (parts[0], parts[1], parts[2]), raw.rate_hz)
    if sum(head.widths) != raw.channel_count or raw.channel_format != "double64":
        raise InputError(
            f"{name}: the stream 'raw' has {raw.channel_count} channels of {raw.channel_format}, expected "
            f"{sum(head.widths)} of double64."
        )
    if raw.count == 0:
        raise InputError(f"{name}: the take has no frames{f' ({file.damage})' if file.damage else ''}.")
    notes = []
    if file.damage:
        notes.append(f"Damaged or unfinished: {file.damage}; `tonguetrack take recover` repairs it.")
    elif raw.footer is None:
        notes.append("The take was not finished; every frame in the file was read.")
    recording = take_recording(head, raw.stamps, raw.columns, name, options.rate_hz)
    extra = {key: raw.description.get(key, "") for key in ("started", "source", "model_name", "version")}
    return replace(recording, notes=(*notes, *recording.notes), extra={k: v for k, v in extra.items() if v})


@dataclass(frozen=True)
class TakeHead:
    """What the channels of a take's `raw` stream are.

    parts: whether there are quaternions, rms and status. rate_hz: nominal, 0.0 = unknown.
    """

    coils: tuple[str, ...]
    frame: FrameOfReference
    parts: tuple[bool, bool, bool]
    rate_hz: float

    @property
    def widths(self) -> list[int]:
        """Channels of device time and number, positions, and each part that is there."""
        coils = len(self.coils)
        return [2, 3 * coils, *(w * coils for w, there in zip((4, 1, 1), self.parts, strict=True) if there)]


def take_recording(
    head: TakeHead,
    stamps: FloatArray,
    columns: Callable[[range], FloatArray],
    name: str,
    asked_hz: float | None = None,
) -> Recording:
    """The recording in a take's `raw` stream, bit for bit.

    stamps: (frames,) arrivals, s. columns: gives (frames, len(range)) of the stream. asked_hz: the user's --rate.
    Raises InputError where neither the device, nor the stamps, nor the user tell the rate.
    """
    begins = np.cumsum([0, *head.widths]).tolist()
    frames, coils = len(stamps), len(head.coils)
    clock, places, *rest = (columns(range(begin, end)) for begin, end in pairwise(begins))
    positions = places.reshape(frames, coils, 3)
    times, rate_hz, notes = take_times(stamps, clock[:, 0], head.rate_hz, name, asked_hz)
    return Recording(
        coils=head.coils,
        positions=positions,
        times_s=times,
        rate_hz=rate_hz,
        format=f"tonguetrack take {TAKE_VERSION} (XDF)",
        frame=head.frame,
        quaternions=rest.pop(0).reshape(frames, coils, 4) if head.parts[0] else None,
        rms=rest.pop(0) if head.parts[1] else None,
        source=name,
        notes=(*notes, *coverage_notes(head.coils, positions)),
        device_times_s=np.ascontiguousarray(clock[:, 0]),
        frame_numbers=_whole_numbers(clock[:, 1]),
        status=_words(rest.pop(0)) if head.parts[2] else None,
    )


def _are_texts(values: object) -> bool:
    return isinstance(values, list) and all(isinstance(value, str) for value in values)


def _words(values: FloatArray) -> np.ndarray:
    return np.where((values >= 0) & (values <= LARGEST_STATUS), values, 0).astype(np.uint32)


def _whole_numbers(values: FloatArray) -> np.ndarray:
    return np.where(np.abs(values) <= _EXACT, values, -1).astype(np.int64)


def take_times(
    stamps: FloatArray, device_times: FloatArray, nominal_hz: float, name: str, asked_hz: float | None = None
) -> tuple[FloatArray, float, list[str]]:
    """Of a take's frames: s since the first one, strictly increasing, the rate in Hz, and notes.

    stamps: (frames,) arrivals, s; device_times: (frames,) the device's own clock, s, which is taken where it
    always goes on and agrees with the arrivals: frames arrive in bursts, but are not measured so.
    nominal_hz: 0.0 = unknown; asked_hz: the user's --rate. Raises InputError where nothing tells the rate.
    """
    usual_hz = asked_hz or nominal_hz
    if usual_hz and _goes_on_with(device_times, stamps):
        return device_times - device_times[0], check_rate(usual_hz, name), []
    with np.errstate(all="ignore"):
        times = stamps - stamps[0]
    if not (np.abs(times) < LONGEST_TAKE_S).all():
        if not usual_hz:
            raise InputError(f"{name}: the time stamps are damaged; pass the sampling rate with --rate.")
        note = f"Time stamps are damaged; times were counted from {usual_hz:g} Hz."
        return even_times(len(stamps), check_rate(usual_hz, name)), usual_hz, [note]
    notes = []
    moved = int(np.count_nonzero(np.diff(times) <= 0))
    if moved:
        times = _increasing(times)
        notes.append(
            f"{moved} frame(s) arrived together with the one before; their times were put just after."
        )
    if not usual_hz:
        if len(times) < 2:
            raise InputError(f"{name}: one frame tells no sampling rate; pass it with --rate.")
        # Frames arrive in bursts, so that the median step says less than the mean.
        usual_hz = (len(times) - 1) / float(times[-1])
        notes.append(f"The device stated no sampling rate; {usual_hz:.4g} Hz is the mean of the arrivals.")
    return times, check_rate(usual_hz, name), notes


def _goes_on_with(device_times: FloatArray, stamps: FloatArray) -> bool:
    """Whether the device's clock increases from frame to frame and covers the same time as the arrivals."""
    if len(stamps) < 2:
        return False
    with np.errstate(all="ignore"):
        steps, span_s = np.diff(device_times), float(stamps[-1] - stamps[0])
        apart_s = abs(float(device_times[-1] - device_times[0]) - span_s)
        together = span_s < LONGEST_TAKE_S and apart_s <= CLOCKS_APART_S + CLOCKS_APART * span_s
        return bool(together and (steps > 0).all())


def _increasing(times: FloatArray) -> FloatArray:
    """The same times, each at least one step of float64 after the one before."""
    out = times.tolist()
    last = -np.inf
    for row, time in enumerate(out):
        if time <= last:
            out[row] = time = float(np.nextafter(last, np.inf))
        last = time
    return np.array(out)


# Other people's files -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Coil:
    """columns: of x, y, z."""

    name: str
    columns: tuple[int, int, int]


def _chosen(file: XdfFile, name: str, layout: str | None) -> tuple[XdfStream, list[_Coil]]:
    candidates = [(stream, coils) for stream in file.streams if (coils := _coils(stream))]
    listed = ", ".join(
        f"'{s.name}' ({s.type or 'no type'}, {s.channel_count} {s.channel_format}, {s.count} samples)"
        for s in file.streams[:12]
    )
    listed += f" and {len(file.streams) - 12} more" if len(file.streams) > 12 else ""
    damage = f" ({file.damage})" if file.damage else ""
    if layout is not None:
        candidates = [(stream, coils) for stream, coils in candidates if stream.name == layout]
    if not candidates and layout is not None:
        raise InputError(
            f"{name}: no stream '{layout}' with positions of coils; its streams: {listed}{damage}."
        )
    if not candidates:
        raise InputError(
            f"{name}: no stream has positions of coils (channels of type PositionX, PositionY, PositionZ or labels "
            f"NAME_x, NAME_y, NAME_z); its streams: {listed or 'none'}{damage}."
        )
    if len(candidates) > 1:
        names = sorted({stream.name for stream, _ in candidates})
        if len(names) < len(candidates):
            raise InputError(f"{name}: several streams with positions have one name ({', '.join(names)}).")
        raise InputError(
            f"{name}: {len(candidates)} streams have positions ({', '.join(names)}); name one with --layout."
        )
    return candidates[0]


def _coils(stream: XdfStream) -> list[_Coil]:
    """The coils whose three positions a stream has, in its order."""
    if stream.channel_format == STRING:
        return []
    found: dict[str, dict[str, int]] = {}
    for column, channel in enumerate(stream.channels):
        whose, axis = _position_of(channel)
        if axis:
            found.setdefault(whose, {}).setdefault(axis, column)
    return [_Coil(coil, (at["x"], at["y"], at["z"])) for coil, at in found.items() if len(at) == 3]


def _position_of(channel: Channel) -> tuple[str, str]:
    """Which coil's position a channel is, and on which axis; "" = none."""
    by_label = _POSITION_LABEL.fullmatch(channel.label)
    if channel.type.lower() in ("positionx", "positiony", "positionz"):
        axis = channel.type[-1].lower()
        whose = channel.marker or (by_label[1] if by_label and by_label[2].lower() == axis else channel.label)
        return whose, axis
    if channel.type or not by_label or channel.label[-2:-1] not in "_. -":
        return "", ""
    return by_label[1], by_label[2].lower()


def _from_stream(
    stream: XdfStream, coils: list[_Coil], file: XdfFile, name: str, options: Options
) -> Recording:
    if stream.count == 0:
        raise InputError(f"{name}: the stream '{stream.name}' has no samples.")
    unit, notes = _unit(stream, coils, name, options.unit)
    with np.errstate(all="ignore"):
        since_first = stream.stamps - stream.stamps[0]
    times, rate_hz, more = frame_times(since_first, name, options.rate_hz, stream.rate_hz or None)
    if stream.rate_hz and not options.rate_hz:
        rate_hz = check_rate(stream.rate_hz, name)
    columns = [column for coil in coils for column in coil.columns]
    values = stream.columns(columns).reshape(stream.count, -1, 3)
    with np.errstate(all="ignore"):  # damage makes any number of a position
        positions, cleaned = clean(values * UNITS_MM[unit])
    if file.damage:
        more.append(f"Damaged or unfinished: {file.damage}.")
    others = [s.name for s in file.streams if s is not stream]
    if others:
        more.append(f"Other streams, left out: {', '.join(others[:12])}.")
    names = [coil.name for coil in coils]
    return Recording(
        coils=tuple(names),
        positions=positions,
        times_s=times,
        rate_hz=rate_hz,
        format=f"XDF, stream '{stream.name}'",
        source=name,
        notes=(*notes, *more, *cleaned, *coverage_notes(names, positions)),
        extra={key: file.fields[key] for key in ("datetime",) if file.fields.get(key)},
    )


def _unit(stream: XdfStream, coils: list[_Coil], name: str, asked: str | None) -> tuple[str, list[str]]:
    words = sorted({stream.channels[column].unit for coil in coils for column in coil.columns})
    stated = {_UNIT_WORDS.get(word.lower()) for word in words}
    unit = stated.pop() if len(stated) == 1 else None
    if asked and unit and asked != unit:
        return asked, [f"The stream states its positions in {unit}; --unit {asked} was used instead."]
    if asked or unit:
        return asked or unit or "mm", []
    said = f"in {', '.join(map(repr, words[:4]))}" if any(words) else "without a unit"
    raise InputError(f"{name}: the stream '{stream.name}' has positions {said}; pass the unit with --unit.")
