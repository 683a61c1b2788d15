"""What a file is, by its content; its name only helps to say that the two disagree."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ... import InputError
from ..frames import Recording
from ..xdf import Buffer, map_file
from . import authors, carstens, est, matlab, mview, npz, ssff, tabular, wave, xdf, xrmb
from .common import UNITS_MM, Options, check_rate, even_times

HEAD_BYTES = 1 << 16
NOTHING_SAID = Options()


@dataclass(frozen=True)
class Head:
    """The first bytes of a file, and as text lines if they are text."""

    data: bytes
    size: int

    @cached_property
    def text(self) -> str:
        """The head as text; empty if it has NUL bytes, which text has not."""
        if b"\0" in self.data:
            return ""
        return self.data.decode("utf-8-sig", "replace")

    @cached_property
    def lines(self) -> list[str]:
        """Whole lines of the head."""
        lines = self.text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        return lines[:-1] if (self.size > len(self.data) and len(lines) > 1) or not lines[-1] else lines


@dataclass(frozen=True)
class Format:
    """One readable format: how it is recognised and read, and what the user may say about it.

    unit: the unit the format fixes, or None if a file must state it. layouts: words for --layout, None = names
    that are in the file. mapped: large files are mapped, not read at once.
    """

    words: str
    suffixes: tuple[str, ...]
    fits: Callable[[Head], bool]
    parse: Callable[[Any, str, Options], Recording]
    unit: str | None = "mm"
    layouts: tuple[str, ...] | None = ()
    mapped: bool = False


def _parse_one_ssff(data: bytes, name: str, options: Options) -> Recording:
    suffix = Path(name).suffix.removeprefix(".") or Path(name).name
    return ssff.parse_group({suffix: ssff.parse_track(data, name)}, name, options)


# The order matters: what announces itself comes first, what is told by its numbers last.
FORMATS: tuple[Format, ...] = (
    Format("Carstens AG50x .pos", (".pos",), lambda h: carstens.is_ag50x(h.data), carstens.parse_ag50x),
    Format("EST_Track", (".ema", ".track"), lambda h: est.is_est(h.data), est.parse_est, unit=None),
    Format("SSFF", (), lambda h: ssff.is_ssff(h.data), _parse_one_ssff, layouts=("raw", "filt")),
    Format("Haskins MVIEW .mat", (".mat",), lambda h: matlab.is_mat5(h.data), mview.parse_mview),
    Format("XDF", (".xdf",), lambda h: xdf.is_xdf(h.data), xdf.parse_xdf, unit=None, layouts=None, mapped=True),
    Format("tonguetrack .npz", (".npz",), lambda h: npz.is_npz(h.data), npz.parse_npz),
    Format("tonguetrack CSV", (".csv",), lambda h: tabular.is_ours(h.text), tabular.parse_table),
    Format("authors' EMA JSON", (".json",), lambda h: authors.is_authors(h.text), authors.parse_authors),
    Format("NDI Wave .tsv v1", (".tsv", ".txt"), lambda h: wave.is_v1(h.lines), wave.parse_v1),
    Format("NDI Wave .tsv v2", (".tsv", ".txt"), lambda h: wave.is_v2(h.lines), wave.parse_v2),
    Format(
        "Carstens .txt export",
        (".txt", ".csv", ".tsv"),
        lambda h: carstens.is_text_with_header(h.lines),
        carstens.parse_text,
    ),
    Format(
        "CSV table", (".csv", ".tsv", ".txt"), lambda h: tabular.is_foreign_table(h.lines), tabular.parse_table,
        unit=None,
    ),
    Format(
        "MOCHA ASCII without header",
        (".ema", ".txt"),
        lambda h: est.is_headerless_mocha(h.lines),
        est.parse_headerless_mocha,
        unit=None,
    ),
    Format("X-ray microbeam .txy", (".txy", ".txt"), lambda h: xrmb.is_txy(h.lines), xrmb.parse_txy),
    Format(
        "Carstens .txt export",
        (".txt", ".csv", ".tsv"),
        lambda h: carstens.is_text_without_header(h.lines),
        carstens.parse_text,
    ),
    Format(
        "Carstens AG500 .pos",
        (".pos",),
        lambda h: carstens.is_ag500(h.data),
        carstens.parse_ag500,
        layouts=("vector", "angles"),
    ),
)  # fmt: skip

# Beginnings of files that people keep next to recordings, and what to say about them.
_OTHERS: tuple[tuple[bytes, str], ...] = (
    (b"# tonguetrack poses", "what `tonguetrack track` wrote, poses and not a recording"),
    (b"RIFF", "a WAV sound, not a record of coils"),
    (b"fLaC", "a FLAC sound, not a record of coils"),
    (b"NIST_1A", "a NIST sound, not a record of coils"),
    (b"ply\n", "a PLY mesh, not a record of coils"),
    (b"ply\r\n", "a PLY mesh, not a record of coils"),
    (b"\x89HDF", "HDF5 (MATLAB -v7.3?); in MATLAB save it again with -v7"),
    (b"\x89PNG", "a picture, not a record of coils"),
    (b"\xff\xd8\xff", "a picture, not a record of coils"),
    (b"%PDF", "a PDF document, not a record of coils"),
    (b"\x1f\x8b", "a gzip archive; unpack it first"),
    (
        b"PK\x03\x04",
        "a .npz or other zip archive without a recording; a tongue model is for `tonguetrack model info`",
    ),
)


def read_head(path: Path) -> Head:
    """The beginning of a file. Raises InputError if there is no such regular file or it cannot be read."""
    try:
        if not path.exists():
            raise InputError(f"{path}: there is no such file or folder.")
        if not path.is_file():
            raise InputError(f"{path}: this is not a regular file.")
        with path.open("rb") as file:
            return Head(file.read(HEAD_BYTES), os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error


def recognise(head: Head, name: str) -> Format:
    """The format whose content this is; InputError says what it is instead, if that can be told."""
    if head.size == 0:
        raise InputError(f"{name}: the file is empty.")
    if not head.data.startswith(tuple(start for start, _ in _OTHERS)) or npz.is_npz(head.data):
        for form in FORMATS:
            if form.fits(head):
                return form
    raise InputError(f"{name}: {_what_else(head, name)}.")


def _what_else(head: Head, name: str) -> str:
    for start, what in _OTHERS:
        if head.data.startswith(start):
            return f"this is {what}"
    if not head.text:
        return (
            "a binary file of no known format (known: AG50x and AG500 .pos, EST_Track, SSFF, MVIEW .mat, XDF, .npz); "
            f"its content decides, whatever its name ends in ({Path(name).suffix or 'nothing'})"
        )
    if "CoreTensor" in head.text or '"ShapeSpace"' in head.text or "TruncatedSpeakerMode" in head.text:
        return "this is a tongue model, not a recording; use `tonguetrack model info`"
    if "speakerAmount" in head.text:
        return "this is a sample database of meshes, not a recording; use `tonguetrack model build`"
    if head.text.lstrip().startswith(("{", "[")):
        return 'JSON without "channels", so not the authors\' EMA format'
    cells = head.lines[0].replace(",", " ").split() if head.lines else []
    if 2 <= len(cells) <= 3 and all(_is_number(cell) for cell in cells):
        return f"text with {len(cells)} numbers a line, a trace (palate?) rather than frames of coils"
    return (
        "text, but not one of the known recordings (labels, licence, notes or a table without coil columns)"
    )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def parse(data: bytes, name: str, options: Options = NOTHING_SAID) -> Recording:
    """A recording from the bytes of one file. Raises InputError and nothing else."""
    form = recognise(Head(data[:HEAD_BYTES], len(data)), name)
    return _finish(form, form.parse(data, name, _checked(form, name, options)), name, options)


def open_recording(
    path: str | os.PathLike[str],
    *,
    rate_hz: float | None = None,
    unit: str | None = None,
    layout: str | None = None,
) -> Recording:
    """Open a recording of any known format, told by its content.

    path: a file, or a folder that holds exactly one recording. SSFF files with the same stem in the same
    folder are one recording; any of them opens it.
    rate_hz: the sampling rate where the file does not state it, or instead of the one it states.
    unit: of positions (m, dm, cm, mm, 10um = 0.01 mm, um), where the format leaves it open.
    layout: "vector" or "angles" for a headerless AG500 .pos, "raw" or "filt" columns for SSFF, the name of a
    stream for XDF.
    Returns positions in mm in the file's own axes, NaN where a sample is missing; `notes` say what was
    assumed. Raises InputError, one sentence, naming the flag to pass where the file is ambiguous.
    """
    path = Path(path)
    if os.path.isdir(path):  # unlike Path.is_dir, quiet about impossible names
        path = _only_recording(path)
    options = Options(rate_hz, unit, layout)
    name = _as_text(path)
    form = recognise(read_head(path), name)
    asked = _checked(form, name, options)
    if form.words == "SSFF":
        tracks = {_as_text(suffix): track for suffix, track in read_ssff_group(path).items()}
        recording = ssff.parse_group(tracks, name, asked)
    else:
        recording = form.parse(_map_whole(path) if form.mapped else read_whole(path), name, asked)
    return _finish(form, recording, name, options)


def _as_text(name: str | os.PathLike[str]) -> str:
    """A file's name as text that every file of ours can hold: bytes that are not UTF-8 become \\xff."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def read_whole(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error


def _map_whole(path: Path) -> Buffer:
    try:
        return map_file(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from error


def read_ssff_group(path: Path) -> dict[str, ssff.Track]:
    """Suffix -> track of every SSFF file with the stem of `path`, that one first.

    A sibling that is damaged raises InputError: a coil must not vanish silently.
    """
    tracks = {path.suffix.removeprefix("."): ssff.parse_track(read_whole(path), str(path))}
    try:
        neighbours = sorted(path.parent.iterdir())
    except OSError as error:
        raise InputError(f"{path.parent}: cannot be listed ({error.strerror or error}).") from error
    for other in neighbours:
        sibling = other.stem == path.stem and other.name != path.name and other.is_file()
        if sibling and ssff.is_ssff(read_head(other).data):
            tracks[other.suffix.removeprefix(".")] = ssff.parse_track(read_whole(other), str(other))
    return tracks


def _only_recording(folder: Path) -> Path:
    from .folders import find_recordings

    found = [item for item in find_recordings(folder) if item.is_recording]
    if len(found) == 1:
        return found[0].path
    if not found:
        raise InputError(
            f"{folder}: no recording in this folder; `tonguetrack info` on it says what there is."
        )
    names = ", ".join(str(item.path.relative_to(folder)) for item in found[:6])
    more = f" and {len(found) - 6} more" if len(found) > 6 else ""
    raise InputError(f"{folder}: {len(found)} recordings in this folder ({names}{more}); name one.")


def _checked(form: Format, name: str, options: Options) -> Options:
    if options.rate_hz is not None:
        check_rate(options.rate_hz, name)
    if options.unit is not None and options.unit not in UNITS_MM:
        raise InputError(
            f"{name}: the unit {options.unit!r} is not known; choose from {', '.join(UNITS_MM)}."
        )
    if form.unit is not None and options.unit not in (None, form.unit):
        raise InputError(
            f"{name}: {form.words} states its positions in {form.unit}, so --unit {options.unit} cannot hold; "
            "leave it out."
        )
    if options.layout is not None and form.layouts is not None and options.layout not in form.layouts:
        choice = f"choose from {', '.join(form.layouts)}" if form.layouts else "leave it out"
        raise InputError(f"{name}: {form.words} has no layout {options.layout!r}; {choice}.")
    return options


def _finish(form: Format, recording: Recording, name: str, options: Options) -> Recording:
    """The user's rate instead of the file's, and a note where name and content disagree."""
    notes = list(recording.notes)
    changes: Mapping[str, object] = {}
    if options.rate_hz is not None and abs(options.rate_hz - recording.rate_hz) > 1e-9 * options.rate_hz:
        notes.append(f"The file says {recording.rate_hz:g} Hz; --rate {options.rate_hz:g} was used instead.")
        start = float(recording.times_s[0])
        times = even_times(recording.frame_count, options.rate_hz, start)
        changes = {"rate_hz": float(options.rate_hz), "times_s": times}
    suffix = Path(name).suffix.lower()
    if form.suffixes and suffix and suffix not in form.suffixes:
        notes.append(f"The name ends in {suffix}, the content is {form.words}; the content decides.")
    if not changes and len(notes) == len(recording.notes):
        return recording
    return replace(recording, notes=tuple(notes), **changes)  # type: ignore[arg-type]
