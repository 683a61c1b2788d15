"""A whole take from one that was cut off or damaged, and its journal."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ... import InputError
from ...atomic import write_atomically
from ...drivers.xdf import MAGIC, Buffer, boundary, map_file, samples, stream_footer, text_samples
from .headers import missing_headers
from .layout import MARKERS, STREAM_IDS
from .reading import NS, NUMBERS, Take, read_take

ROWS_A_CHUNK = 4096


def recover(path: str | os.PathLike[str], output: str | os.PathLike[str]) -> tuple[str, ...]:
    """Writes a new, complete take from what is left of one; what was found, in sentences.

    Every whole chunk is copied as it is, the frames and marks that only the journal has follow, then the footers. The old
    file and its journal stay as they are. Raises InputError where `path` is not a take or has no frames, where
    nothing is wrong with it, and where `output` exists.
    """
    take, output = read_take(path), Path(output)
    if os.path.lexists(output):
        raise InputError(f"{output}: exists already and is never overwritten; choose another name.")
    if take.complete:
        raise InputError(f"{take.path}: this take is complete and undamaged; there is nothing to recover.")
    if take.frame_count == 0:
        found = f" ({take.damage})" if take.damage else ""
        more = f" {take.journal_note}" if take.journal_note else ""
        raise InputError(
            f"{take.path}: there is not one frame in this take{found}, so nothing to recover.{more}"
        )
    data = map_file(take.path)

    def write(file: BinaryIO) -> None:
        file.writelines(_pieces(take, data))

    write_atomically(output, write)
    return _sentences(take, read_take(output))


def _pieces(take: Take, data: Buffer) -> Iterator[bytes | memoryview]:
    """The new file, piece by piece."""
    file = take.file
    yield MAGIC
    yield from _without_footers(take, memoryview(data), len(MAGIC), file.headers_end)
    yield missing_headers(take.info, [stream.name for stream in file.streams])
    yield from _without_footers(take, memoryview(data), file.headers_end, file.whole_bytes)
    yield boundary()
    for name in NUMBERS:
        more = take.from_journal(name)
        if more is None:
            continue
        for begin in range(0, len(more), ROWS_A_CHUNK):
            rows = more[begin : begin + ROWS_A_CHUNK]
            yield samples(_stream_id(take, name), rows["arrival_ns"] * NS, rows[name])
    if marks := take.marks_from_journal():
        stamps_s, texts = [mark.stamp_s for mark in marks], [mark.text for mark in marks]
        yield text_samples(_stream_id(take, MARKERS), stamps_s, texts)
    for name in (*NUMBERS, MARKERS):
        stamps = take.stream_stamps(name)
        first, last = (float(stamps[0]), float(stamps[-1])) if len(stamps) else (0.0, 0.0)
        yield stream_footer(_stream_id(take, name), first, last, len(stamps))


def _without_footers(take: Take, data: memoryview, begin: int, end: int) -> Iterator[memoryview]:
    """The whole chunks from `begin` to `end`, except footers: their counts hold no longer."""
    cuts = sorted(take.file.footers)
    for span_begin, span_end in take.file.spans:
        at, stop = max(span_begin, begin), min(span_end, end)
        for cut_begin, cut_end in cuts:
            if at <= cut_begin < stop:
                yield data[at:cut_begin]
                at = cut_end
        if at < stop:
            yield data[at:stop]


def _stream_id(take: Take, name: str) -> int:
    stream = take.file.named(name)
    return STREAM_IDS[name] if stream is None else stream.stream_id


def _sentences(take: Take, recovered: Take) -> tuple[str, ...]:
    file = take.file
    lost = file.size - sum(end - begin for begin, end in file.spans) - len(MAGIC)
    found = [
        f"{recovered.frame_count} frames, {recovered.duration_s:.3f} s, {len(recovered.markers)} mark(s)."
    ]
    if take.damage:
        found.append(f"Found in the old file: {take.damage}.")
    else:
        found.append("The old file is whole as far as it goes, but was never ended.")
    if lost:
        found.append(f"{lost} bytes that belong to no whole chunk were left out.")
    if take.journal_note:
        found.append(take.journal_note)
    elif take.journal is None:
        found.append("There was no journal beside it.")
    else:
        found.append("The journal beside it had nothing more.")
    if recovered.damage:
        found.append(f"What could not be mended: {recovered.damage}.")
    return tuple(found)
