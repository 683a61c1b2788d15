"""XDF 1.0, the labs' format for streams recorded together: bytes from values, and values from bytes.

After the magic `XDF:` a file is a row of chunks, so that it can be written by appending alone: a file header,
one header a stream, then samples, clock offsets and boundaries in any order, and one footer a stream. All
numbers are little-endian. Source: the specification of XDF 1.0 (github.com/sccn/xdf, wiki "Specifications")
and, for channels of motion capture, its page "MoCap Meta Data".
"""

from __future__ import annotations

import mmap
import os
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from .frames import FloatArray

MAGIC = b"XDF:"
BOUNDARY_UUID = bytes.fromhex("43a546dccbf5410fb30ed5467383cbe4")
FILE_HEADER, STREAM_HEADER, SAMPLES, CLOCK_OFFSET, BOUNDARY, STREAM_FOOTER = range(1, 7)

FORMATS = {
    "float32": "<f4", "double64": "<f8", "int8": "<i1", "int16": "<i2", "int32": "<i4", "int64": "<i8",
}  # fmt: skip
STRING = "string"

MAX_XML_BYTES = 16 * 1024**2
MAX_CHANNELS = 1 << 20
MAX_DAMAGES = 100  # are told one by one
RUN_SAMPLES = 4096  # of equal layout are looked for at a time

_BOUNDARY_PATTERN = re.compile(re.escape(BOUNDARY_UUID), re.DOTALL)
_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_MOCAP_TYPES = {
    "x": "PositionX", "y": "PositionY", "z": "PositionZ",
    "qw": "OrientationA", "qx": "OrientationB", "qy": "OrientationC", "qz": "OrientationD",
}  # fmt: skip

Buffer = bytes | bytearray | memoryview | mmap.mmap


# Writing --------------------------------------------------------------------------------------------


def file_header(extra: Mapping[str, str]) -> bytes:
    """What a file begins with: the magic and the file's header. extra: further fields, as text."""
    fields = {"version": "1.0", "datetime": datetime.now().astimezone().isoformat(), **extra}
    return MAGIC + _xml_chunk(FILE_HEADER, None, _elements(fields))


def stream_header(
    stream_id: int,
    name: str,
    type: str,
    channel_labels: Sequence[str],
    channel_units: Sequence[str],
    rate_hz: float,
    source_id: str,
    channel_format: str = "double64",
    description: Mapping[str, str] | None = None,
) -> bytes:
    """The header chunk of a stream; it stands before the stream's first samples.

    rate_hz: nominal, 0.0 = irregular. channel_format: double64 or string. description: further text, by names
    that XML allows. A MoCap stream's channels NAME_x, NAME_y, NAME_z (position) and NAME_qw to NAME_qz
    (quaternion) get the marker NAME and the type of the convention. Characters that XML has no way to hold
    become U+FFFD. Raises ValueError where labels and units differ in number.
    """
    channels = "".join(
        f"<channel>{_elements(_channel(label, unit, type == 'MoCap'))}</channel>"
        for label, unit in zip(channel_labels, channel_units, strict=True)
    )
    fields = {
        "name": name,
        "type": type,
        "channel_count": str(len(channel_labels)),
        "channel_format": channel_format,
        "nominal_srate": repr(float(rate_hz)),
        "source_id": source_id,
    }
    desc = f"<desc><channels>{channels}</channels>{_elements(description or {})}</desc>"
    return _xml_chunk(STREAM_HEADER, stream_id, _elements(fields) + desc)


def samples(stream_id: int, stamps: FloatArray, values: FloatArray) -> bytes:
    """One chunk of numbers: stamps (n,) s, values (n, channels); every sample carries its own stamp."""
    count, channels = values.shape
    packed = np.empty(count, _stamped("<f8", channels))
    packed["bytes"] = 8
    packed["stamp"] = stamps
    packed["values"] = values
    return _chunk(SAMPLES, struct.pack("<IBI", stream_id, 4, count) + packed.tobytes())


def text_samples(stream_id: int, stamps: Sequence[float] | FloatArray, texts: Sequence[str]) -> bytes:
    """One chunk of a string stream with one channel: a stamp, s, and a text a sample."""
    parts = [struct.pack("<IBI", stream_id, 4, len(texts))]
    for stamp, text in zip(stamps, texts, strict=True):
        coded = text.encode("utf-8", "replace")
        parts.append(struct.pack("<BdBI", 8, stamp, 4, len(coded)) + coded)
    return _chunk(SAMPLES, b"".join(parts))


def clock_offset(stream_id: int, collected_s: float, offset_s: float) -> bytes:
    """What is added to the stream's stamps around `collected_s` to get the recorder's time."""
    return _chunk(CLOCK_OFFSET, struct.pack("<Idd", stream_id, collected_s, offset_s))


def boundary() -> bytes:
    """Where a reader finds back into a damaged file."""
    return _chunk(BOUNDARY, BOUNDARY_UUID)


def stream_footer(stream_id: int, first: float, last: float, count: int) -> bytes:
    """The last chunk of a stream: its first and last stamp, s, and how many samples it has."""
    fields = {
        "first_timestamp": repr(float(first)),
        "last_timestamp": repr(float(last)),
        "sample_count": str(count),
    }
    return _xml_chunk(STREAM_FOOTER, stream_id, _elements(fields))


def _chunk(tag: int, content: bytes) -> bytes:
    return struct.pack("<BIH", 4, len(content) + 2, tag) + content


def _xml_chunk(tag: int, stream_id: int | None, elements: str) -> bytes:
    whose = b"" if stream_id is None else struct.pack("<I", stream_id)
    return _chunk(tag, whose + f'<?xml version="1.0"?><info>{elements}</info>'.encode())


def _elements(fields: Mapping[str, str]) -> str:
    return "".join(f"<{name}>{_escaped(text)}</{name}>" for name, text in fields.items())


def _escaped(text: str) -> str:
    """A carriage return is written as a reference, as XML would read it as a line feed."""
    text = _NOT_IN_XML.sub("\ufffd", text)
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("\r", "&#13;")


def _channel(label: str, unit: str, mocap: bool) -> dict[str, str]:
    marker, _, part = label.rpartition("_")
    if mocap and marker and part in _MOCAP_TYPES:
        return {"label": label, "marker": marker, "type": _MOCAP_TYPES[part], "unit": unit}
    return {"label": label, "unit": unit}


def _stamped(form: str, channels: int) -> np.dtype[Any]:
    """One sample that carries its stamp."""
    return np.dtype([("bytes", "u1"), ("stamp", "<f8"), ("values", form, (channels,))])


# Reading --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Channel:
    """What a stream says of one channel; "" = nothing. type, marker: see the page "MoCap Meta Data"."""

    label: str = ""
    unit: str = ""
    type: str = ""
    marker: str = ""


@dataclass(frozen=True)
class Footer:
    """first, last: stamps, s; count: of samples; None = the footer does not say."""

    first: float | None
    last: float | None
    count: int | None


@dataclass
class XdfStream:
    """One stream of a file.

    fields: the header's own fields as text (name, type, source_id, ...). channels: one for each, or none where
    the header does not describe exactly `channel_count` of them. description: what else the header describes.
    texts: a string stream's samples, one tuple of `channel_count` texts each. footer: None = none was written.
    clock_offsets: (collected, offset) in s; they are not applied to the stamps.
    """

    stream_id: int
    fields: Mapping[str, str]
    channel_format: str
    channel_count: int
    rate_hz: float
    channels: tuple[Channel, ...] = ()
    description: Mapping[str, str] = field(default_factory=dict)
    texts: list[tuple[str, ...]] = field(default_factory=list)
    footer: Footer | None = None
    clock_offsets: list[tuple[float, float]] = field(default_factory=list)
    blocks: list[tuple[FloatArray, NDArray[Any]]] = field(default_factory=list, repr=False)
    """Of each chunk its stamps (n,) and values (n, channels) as they are in the file; no values for texts."""

    @property
    def name(self) -> str:
        return self.fields.get("name", "")

    @property
    def type(self) -> str:
        return self.fields.get("type", "")

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(channel.label for channel in self.channels)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(channel.unit for channel in self.channels)

    @property
    def count(self) -> int:
        """How many samples were read."""
        return sum(len(stamps) for stamps, _ in self.blocks)

    @cached_property
    def stamps(self) -> FloatArray:
        """(n,) s, in the sender's clock, in the order of the file."""
        out = np.empty(self.count)
        np.concatenate([np.empty(0), *(stamps for stamps, _ in self.blocks)], out=out)
        return out

    @cached_property
    def values(self) -> FloatArray:
        """(n, channels) float64; (n, 0) for texts."""
        return self.columns(range(self.channel_count if self.channel_format != STRING else 0))

    def columns(self, wanted: Sequence[int]) -> FloatArray:
        """(n, len(wanted)) float64: some channels of all samples, copied out of the file."""
        out = np.empty((self.count, len(wanted)))
        if not wanted:
            return out
        picked: Any = list(wanted)
        if picked == list(range(picked[0], picked[-1] + 1)):
            picked = slice(picked[0], picked[-1] + 1)
        row = 0
        for stamps, values in self.blocks:
            out[row : row + len(stamps)] = values[:, picked]
            row += len(stamps)
        return out


@dataclass
class XdfFile:
    """A file as far as it is whole.

    fields: of the file's header. spans: (begin, end) of the stretches of whole chunks, the first from the first
    chunk on. headers_end: where the headers at the beginning end. footers: (begin, end) of each footer's chunk.
    damages: sentences without the file's name.
    """

    streams: list[XdfStream]
    fields: Mapping[str, str]
    size: int
    spans: list[tuple[int, int]]
    headers_end: int
    footers: list[tuple[int, int]]
    damages: list[str]

    @property
    def whole_bytes(self) -> int:
        """The end of the last whole chunk."""
        return self.spans[-1][1]

    @property
    def damage(self) -> str | None:
        """What is wrong with the file, in one sentence; None = nothing was found."""
        if not self.damages:
            return None
        more = f"; and {len(self.damages) - 3} more" if len(self.damages) > 3 else ""
        return "; ".join(self.damages[:3]) + more

    @property
    def only_cut_off(self) -> bool:
        """Whether the file is whole up to where it ends, so that sample i of a stream is the i-th that was written."""
        return len(self.spans) == 1 and len(self.damages) <= (1 if self.whole_bytes < self.size else 0)

    def named(self, name: str) -> XdfStream | None:
        """The first stream of a name."""
        return next((stream for stream in self.streams if stream.name == name), None)


def map_file(path: str | os.PathLike[str]) -> Buffer:
    """The bytes of a file without reading them at once; they stay mapped as long as anything refers to them.

    Raises OSError where the file cannot be read.
    """
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            return b""
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def read_xdf(data: Buffer, name: str) -> XdfFile:
    """All streams of a file, up to its last whole chunk.

    Where a chunk is damaged, reading goes on behind it, or behind the next boundary if its length is damaged.
    Streams keep views of `data`; numbers are copied when they are asked for. Raises InputError where the file
    does not begin as XDF does; whatever else is wrong is in `damage`.
    """
    view = memoryview(data)
    if bytes(view[:4]) != MAGIC:
        raise InputError(f"{name}: this is not XDF, which begins with 'XDF:'.")
    return _Reader(view).read()


class _Damaged(ValueError):
    """A chunk that is not what it should be."""


class _CutOff(_Damaged):
    """A chunk that is longer than what is left of the file."""


@dataclass
class _State:
    """What is kept of a stream while its samples are read."""

    stream: XdfStream
    form: str
    stamped: np.dtype[Any] | None
    last_s: float = 0.0


class _Reader:
    def __init__(self, view: memoryview) -> None:
        self._view = view
        self._states: dict[int, _State] = {}
        self._fields: dict[str, str] = {}
        self._damages: list[str] = []
        self._headers_end = len(MAGIC)
        self._footers: list[tuple[int, int]] = []

    def read(self) -> XdfFile:
        position = begin = len(MAGIC)
        size = len(self._view)
        spans: list[tuple[int, int]] = []
        while position < size:
            try:
                start, end = self._bounds(position)
                tag = self._read_chunk(start, end, position)
            except _Damaged as reason:
                if position > begin or not spans:
                    spans.append((begin, position))
                after = self._next_whole(position)
                if after is None:
                    how = "the file is cut off" if isinstance(reason, _CutOff) else "the rest is lost"
                    self._tell(f"{how} at byte {position} of {size} ({reason})")
                    begin = position = size
                    break
                self._tell(f"the chunk at byte {position} is damaged ({reason}); read on from {after}")
                begin = position = after
            else:
                if tag <= STREAM_HEADER and position == self._headers_end:
                    self._headers_end = end
                elif tag == STREAM_FOOTER:
                    self._footers.append((position, end))
                position = end
        if position > begin or not spans:
            spans.append((begin, position))
        self._compare_with_footers()
        streams = [state.stream for state in self._states.values()]
        return XdfFile(streams, self._fields, size, spans, self._headers_end, self._footers, self._damages)

    def _next_whole(self, position: int) -> int | None:
        """Where to read on behind a damaged chunk: where its length says, if a chunk begins there, or else behind
        the next boundary. None = nowhere.
        """
        try:
            _, end = self._bounds(position)
            start, _ = self._bounds(end)
            if FILE_HEADER <= struct.unpack_from("<H", self._view, start)[0] <= STREAM_FOOTER:
                return end
        except _Damaged:
            pass
        found = _BOUNDARY_PATTERN.search(self._view, position)
        return None if found is None else found.end()

    def _tell(self, sentence: str) -> None:
        if len(self._damages) < MAX_DAMAGES:
            self._damages.append(sentence)

    def _compare_with_footers(self) -> None:
        for state in self._states.values():
            footer, stream = state.stream.footer, state.stream
            if footer and footer.count is not None and footer.count > stream.count:
                self._tell(f"the stream '{stream.name}' has {stream.count} of {footer.count} samples")

    def _number(self, position: int, end: int) -> tuple[int, int]:
        """A length of 1, 4 or 8 bytes, and where it ends."""
        if position >= end:
            raise _CutOff("a length is missing")
        form = {1: "<B", 4: "<I", 8: "<Q"}.get(self._view[position])
        if form is None:
            raise _Damaged(f"a length of {self._view[position]} bytes")
        after = position + 1 + self._view[position]
        if after > end:
            raise _CutOff("a length is cut off")
        return struct.unpack_from(form, self._view, position + 1)[0], after

    def _bounds(self, position: int) -> tuple[int, int]:
        """Where a chunk's tag begins and where the chunk ends."""
        size = len(self._view)
        length, start = self._number(position, size)
        if length < 2:
            raise _Damaged(f"a chunk of {length} bytes")
        if length > size - start:
            raise _CutOff(f"a chunk of {length} bytes, of which {size - start} are there")
        return start, start + length

    def _read_chunk(self, start: int, end: int, position: int) -> int:
        """Takes in what the chunk holds; its tag."""
        tag: int = struct.unpack_from("<H", self._view, start)[0]
        start += 2
        if tag == FILE_HEADER:
            self._fields.update(_leaves(self._xml(start, end)))
        elif tag == BOUNDARY:
            if bytes(self._view[start:end]) != BOUNDARY_UUID:
                raise _Damaged("a boundary with another mark")
        elif STREAM_HEADER <= tag <= STREAM_FOOTER:
            if end - start < 4:
                raise _Damaged("a chunk without its stream")
            stream_id = struct.unpack_from("<I", self._view, start)[0]
            start += 4
            state = self._states.get(stream_id)
            if tag == STREAM_HEADER:
                if state is not None:
                    self._tell(f"the chunk at byte {position} is a second header of stream {stream_id}")
                    return tag
                self._states[stream_id] = _new_state(stream_id, self._xml(start, end))
            elif state is None:
                self._tell(f"the chunk at byte {position} belongs to stream {stream_id}, which has no header")
            elif tag == SAMPLES:
                self._read_samples(state, start, end)
            elif tag == STREAM_FOOTER:
                state.stream.footer = _footer(_leaves(self._xml(start, end)))
            else:
                if end - start != 16:
                    raise _Damaged("a clock offset of another size")
                state.stream.clock_offsets.append(struct.unpack_from("<dd", self._view, start))
        # Other tags are of a later version; a reader of this one passes over them.
        return tag

    def _xml(self, start: int, end: int) -> ElementTree.Element:
        if end - start > MAX_XML_BYTES:
            raise _Damaged(f"{end - start} bytes of XML are too many")
        text = bytes(self._view[start:end]).decode("utf-8", "replace")
        if "<!DOCTYPE" in text:  # nothing else can declare entities
            raise _Damaged("XML with a document type")
        try:
            return ElementTree.fromstring(text)
        except (ElementTree.ParseError, ValueError) as reason:
            raise _Damaged(f"XML that cannot be read: {str(reason)[:80]}") from None

    def _read_samples(self, state: _State, start: int, end: int) -> None:
        count, start = self._number(start, end)
        if state.stamped is None:
            block = self._texts(state, count, start, end)
        else:
            block = self._numbers(state, state.stamped, count, start, end)
        if count:
            state.stream.blocks.append(block)
            state.last_s = float(block[0][-1])

    def _numbers(
        self, state: _State, stamped: np.dtype[Any], count: int, start: int, end: int
    ) -> tuple[FloatArray, NDArray[Any]]:
        if count * (stamped.itemsize - 8) > end - start:
            raise _Damaged(f"{count} samples in {end - start} bytes")
        if count * stamped.itemsize == end - start:
            packed = np.frombuffer(self._view, stamped, count, start)
            if (packed["bytes"] == 8).all():
                return packed["stamp"], packed["values"]
        return self._mixed_numbers(state, stamped, count, start, end)

    def _mixed_numbers(
        self, state: _State, stamped: np.dtype[Any], count: int, start: int, end: int
    ) -> tuple[FloatArray, NDArray[Any]]:
        """Samples with and without stamps; a missing one follows the last at the nominal rate."""
        bare = np.dtype([("bytes", "u1"), ("values", state.form, (state.stream.channel_count,))])
        period_s = 1.0 / state.stream.rate_hz if state.stream.rate_hz > 0 else 0.0
        stamps = np.empty(count)
        values = np.empty((count, state.stream.channel_count), state.form)
        row, last_s = 0, state.last_s
        while row < count:
            if start >= end:
                raise _Damaged(f"{row} of {count} samples")
            layout = {0: bare, 8: stamped}.get(self._view[start])
            if layout is None:
                raise _Damaged(f"a time stamp of {self._view[start]} bytes")
            room = min(count - row, RUN_SAMPLES, (end - start) // layout.itemsize)
            if room == 0:
                raise _Damaged(f"{row} of {count} samples")
            packed = np.frombuffer(self._view, layout, room, start)
            others = np.flatnonzero(packed["bytes"] != self._view[start])
            packed = packed[: others[0]] if len(others) else packed
            into = slice(row, row + len(packed))
            if layout is stamped:
                stamps[into] = packed["stamp"]
            else:
                stamps[into] = np.add.accumulate(np.append(last_s, np.full(len(packed), period_s)))[1:]
            values[into] = packed["values"]
            row += len(packed)
            start += len(packed) * layout.itemsize
            last_s = float(stamps[row - 1])
        if start != end:
            raise _Damaged(f"{end - start} bytes behind the samples")
        return stamps, values

    def _texts(self, state: _State, count: int, start: int, end: int) -> tuple[FloatArray, NDArray[Any]]:
        channels = state.stream.channel_count
        if count * (1 + 2 * channels) > end - start:
            raise _Damaged(f"{count} samples in {end - start} bytes")
        period_s = 1.0 / state.stream.rate_hz if state.stream.rate_hz > 0 else 0.0
        stamps = np.empty(count)
        texts: list[tuple[str, ...]] = []
        last_s = state.last_s
        for row in range(count):
            if start >= end or self._view[start] not in (0, 8) or end - start < 1 + self._view[start]:
                raise _Damaged(f"{row} of {count} samples")
            if self._view[start] == 8:
                last_s = struct.unpack_from("<d", self._view, start + 1)[0]
            else:
                last_s += period_s
            stamps[row] = last_s
            start += 1 + self._view[start]
            sample = []
            for _ in range(channels):
                length, start = self._number(start, end)
                if length > end - start:
                    raise _Damaged(f"a text of {length} bytes, of which {end - start} are there")
                sample.append(bytes(self._view[start : start + length]).decode("utf-8", "replace"))
                start += length
            texts.append(tuple(sample))
        if start != end:
            raise _Damaged(f"{end - start} bytes behind the samples")
        state.stream.texts += texts
        return stamps, np.empty((count, 0))


def _new_state(stream_id: int, info: ElementTree.Element) -> _State:
    fields = _leaves(info)
    form = fields.get("channel_format", "").strip()
    if form != STRING and form not in FORMATS:
        raise _Damaged(f"the channel format '{form[:20]}'")
    channels = _whole(fields.get("channel_count", ""))
    if channels is None or not 1 <= channels <= MAX_CHANNELS:
        raise _Damaged(f"the channel count '{fields.get('channel_count', '')[:20]}'")
    rate_hz = _real(fields.get("nominal_srate", ""))
    described = [Channel(*_texts_of(item)) for item in info.iterfind("desc/channels/channel")]
    desc = info.find("desc")
    stream = XdfStream(
        stream_id,
        fields,
        form,
        channels,
        rate_hz if rate_hz is not None and np.isfinite(rate_hz) and rate_hz > 0 else 0.0,
        tuple(described) if len(described) == channels else (),
        {} if desc is None else _leaves(desc),
    )
    if form == STRING:
        return _State(stream, form, None)
    return _State(stream, FORMATS[form], _stamped(FORMATS[form], channels))


def _texts_of(channel: ElementTree.Element) -> tuple[str, ...]:
    return tuple((channel.findtext(name) or "").strip() for name in ("label", "unit", "type", "marker"))


def _leaves(element: ElementTree.Element) -> dict[str, str]:
    """Name -> text of the children that have none of their own."""
    return {child.tag: child.text or "" for child in element if len(child) == 0}


def _footer(fields: Mapping[str, str]) -> Footer:
    first, last = _real(fields.get("first_timestamp", "")), _real(fields.get("last_timestamp", ""))
    return Footer(first, last, _whole(fields.get("sample_count", "")))


def _whole(text: str) -> int | None:
    return int(text) if re.fullmatch(r"\s*[0-9]{1,18}\s*", text, re.ASCII) else None


def _real(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
