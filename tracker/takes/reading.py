"""A take opened again, whatever became of it: finished, cut off, damaged, with or without its journal."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ...drivers.files.recognise import read_head
from ...drivers.files.xdf import TakeHead, is_xdf, take_recording, take_times
from ...drivers.frames import CoilFrame, Recording
from ...drivers.xdf import XdfFile, XdfStream, map_file, read_xdf
from ..pose import CoilState, FloatArray, PoseStatus, TrackedPoses
from ..setup import MODEL_FRAME
from .headers import info_from_streams
from .journal import Rows, journal_path, read_journal, read_journal_marks
from .layout import (
    MARKER_WORDS,
    MARKERS,
    POSE,
    POSE_HEAD,
    PREPARED,
    RAW,
    SESSION_MARK,
    TakeInfo,
    session_frame,
)
from .marklog import Mark

NUMBERS = (RAW, PREPARED, POSE)
NS = 1e-9
LARGEST_STAMP_S = 1e10


@dataclass(frozen=True)
class Marker:
    """time_s: since the take's first frame. row: of the first frame that came at that time or later."""

    time_s: float
    row: int
    text: str

    @property
    def word(self) -> str:
        """What the program wrote it for, one of `layout.MARKER_WORDS`; "" = it is the user's."""
        word, colon, _ = self.text.partition(":")
        return word if colon and word in MARKER_WORDS else ""

    @property
    def content(self) -> str:
        """The text behind the word."""
        return self.text[len(self.word) + 1 :].lstrip(" ") if self.word else self.text


@dataclass(frozen=True)
class _Index:
    """Which frame each row of a stream is.

    rows: (rows,) indices of frames, their number for a row that belongs to none; None = the rows are the frames.
    """

    stamps: FloatArray
    rows: Mapping[str, NDArray[np.int64] | None]


@dataclass(frozen=True)
class Take:
    """One take. Its arrays have one row a frame, NaN where a stream lacks what another one has.

    That happens only where the file was cut between two streams, or is damaged; elsewhere every frame is whole.
    journal, journal_marks: what the journal beside the take holds, None and none without one; journal_note: what
    the file lacked of it, or why it was not used, "" = nothing.
    Arrays are read from the file when they are asked for.
    """

    path: Path
    info: TakeInfo
    file: XdfFile
    journal: Rows | None = None
    journal_marks: tuple[Mark, ...] = ()
    journal_note: str = ""

    # What state it is in ------------------------------------------------------------------------------

    @property
    def damage(self) -> str | None:
        """What is wrong with the file, in one sentence; None = nothing was found. Being unfinished is no damage."""
        return self.file.damage

    @property
    def complete(self) -> bool:
        """Whether the take was ended as it should be and nothing is missing."""
        streams = self.file.streams
        named = {stream.name for stream in streams if stream.footer is not None}
        return self.damage is None and named >= {RAW, PREPARED, POSE, MARKERS}

    @property
    def state(self) -> str:
        """In one word: complete, unfinished (no end was written, or only part of one), damaged."""
        if self.complete:
            return "complete"
        return "damaged" if self.damage and not self.only_cut_off else "unfinished"

    @property
    def only_cut_off(self) -> bool:
        """Whether the file is whole up to where it ends."""
        return self.file.only_cut_off

    def from_journal(self, name: str) -> Rows | None:
        """The rows that the journal has and a stream of the file has not; None = none."""
        if self.journal is None or len(self.journal) == 0:
            return None
        stream = self.file.named(name)
        if stream is None or stream.count == 0:
            return self.journal
        if self.only_cut_off:  # frame i is sample i
            missing = self.journal[self.journal["sequence"] > stream.count]
        else:
            missing = self.journal[self.journal["arrival_ns"] * NS > stream.stamps.max()]
        return missing if len(missing) else None

    def marks_from_journal(self) -> list[Mark]:
        """The marks that the journal has and the file has not."""
        stream = self.file.named(MARKERS)
        if stream is None:
            return list(self.journal_marks)
        if self.only_cut_off:  # mark i is sample i
            return [mark for mark in self.journal_marks if mark.number > stream.count]
        there = set(stream.stamps.tolist())
        return [mark for mark in self.journal_marks if mark.stamp_s not in there]

    # Frames -------------------------------------------------------------------------------------------

    @property
    def stamps(self) -> FloatArray:
        """(frames,) when each frame arrived, s in the recording host's `time.perf_counter`."""
        return self._index.stamps

    @property
    def times_s(self) -> FloatArray:
        """(frames,) s since the first frame."""
        return self.stamps - self.stamps[0] if len(self.stamps) else self.stamps

    @property
    def device_times(self) -> FloatArray:
        """(frames,) the device's own clock, s."""
        return self._columns(RAW, range(1))[:, 0]

    @property
    def frame_count(self) -> int:
        return len(self.stamps)

    @property
    def duration_s(self) -> float:
        """From the first frame's arrival to the last one's."""
        return float(self.stamps[-1] - self.stamps[0]) if len(self.stamps) else 0.0

    @cached_property
    def raw(self) -> FloatArray:
        """(frames, channels) in the order of `info.raw_labels`."""
        return self._columns(RAW, range(len(self.info.raw_labels)))

    @cached_property
    def prepared(self) -> FloatArray:
        """(frames, channels) in the order of `info.prepared_labels`."""
        return self._columns(PREPARED, range(len(self.info.prepared_labels)))

    @cached_property
    def pose(self) -> FloatArray:
        """(frames, channels) in the order of `info.pose_labels`; the status of a frame without pose is NaN."""
        return self._columns(POSE, range(len(self.info.pose_labels)))

    @cached_property
    def markers(self) -> tuple[Marker, ...]:
        """By time; one whose time is damaged stands at the beginning."""
        stream = self.file.named(MARKERS)
        texts = [text[0] for text in stream.texts] if stream else []
        texts += [mark.text for mark in self.marks_from_journal()]
        at = self.stream_stamps(MARKERS)[: len(texts)]
        if not texts:
            return ()
        possible = at[_possible(at)]
        start_s = [*self.stamps[:1], *possible[:1], 0.0][0]
        at = np.where(_possible(at), at, start_s)
        rows = np.searchsorted(self.stamps, at).tolist()
        found = zip((at - start_s).tolist(), rows, texts, strict=True)
        return tuple(sorted((Marker(*mark) for mark in found), key=lambda mark: mark.time_s))

    @property
    def sessions(self) -> tuple[tuple[int, str], ...]:
        """(row from which it holds, session as TOML), the take's own first."""
        marks = [mark for mark in self.markers if mark.word == SESSION_MARK]
        changes = [(session_frame(mark.content, mark.row), mark.content) for mark in marks]
        return ((0, self.info.session_toml), *changes)

    def frames(self) -> Iterator[CoilFrame]:
        """The device's frames in the order in which they arrived, as the tracker got them."""
        recording = self.recording()
        assert recording.device_times_s is not None and recording.frame_numbers is not None
        device_times, numbers = recording.device_times_s.tolist(), recording.frame_numbers.tolist()
        arrivals = np.rint(self.stamps / NS).astype(np.int64).tolist()
        for row, positions in enumerate(recording.positions):
            yield CoilFrame(
                positions,
                device_times[row],
                numbers[row],
                arrivals[row],
                None if recording.quaternions is None else recording.quaternions[row],
                None if recording.rms is None else recording.rms[row],
                None if recording.status is None else recording.status[row],
            )

    def recording(self) -> Recording:
        """What the device sent. Raises InputError where there are no frames."""
        self._check_frames()
        info = self.info
        head = TakeHead(info.coils, info.frame, (info.quaternions, info.rms, info.status), info.rate_hz)
        recording = take_recording(
            head, self.stamps, lambda columns: self._columns(RAW, columns), str(self.path)
        )
        notes = [sentence for sentence in (self.damage, self.journal_note) if sentence]
        return replace(recording, notes=(*notes, *recording.notes))

    def prepared_recording(self) -> Recording:
        """The tracked coils in the model's frame."""
        self._check_frames()
        times, rate_hz, notes = take_times(self.stamps, self.device_times, self.info.rate_hz, str(self.path))
        return Recording(
            coils=self.info.roles,
            positions=self.prepared.reshape(self.frame_count, -1, 3),
            times_s=times,
            rate_hz=rate_hz,
            format="prepared coils of a tonguetrack take",
            frame=MODEL_FRAME,
            source=str(self.path),
            notes=tuple(notes),
        )

    def poses(self) -> TrackedPoses:
        """What the tracker made of the frames, without those whose poses are lost or damaged beyond use.

        Raises InputError where there are none.
        """
        self._check_frames()
        info, pose = self.info, self.pose
        status = pose[:, POSE_HEAD.index("status")]
        first, last = len(POSE_HEAD), len(POSE_HEAD) + len(info.pose_mean) + info.speaker_size
        shaped = np.isfinite(pose[:, first:last]).all(axis=1)
        there = np.isin(status, [int(known) for known in PoseStatus]) & shaped
        if not there.any():
            raise InputError(f"{self.path}: the take has no poses.")
        times, rate_hz, _ = take_times(self.stamps, self.device_times, info.rate_hz, str(self.path))
        widths = [len(POSE_HEAD), len(info.pose_mean), info.speaker_size, len(info.roles)]
        head, weights, speakers, residuals, _ = np.split(pose[there], np.cumsum(widths), axis=1)
        values = dict(zip(POSE_HEAD, head.T, strict=True))
        with np.errstate(all="ignore"):  # damage makes any number of a weight
            normalised = (weights - info.pose_mean) / info.pose_sigma
        return TrackedPoses(
            times_s=times[there],
            statuses=values["status"].astype(np.int64),
            weights=weights,
            normalised=normalised,
            speaker_weights=speakers,
            energies=values["energy"],
            residual_mm=values["residual_mm"],
            residuals_mm=residuals,
            coils=self.prepared[there].reshape(int(there.sum()), -1, 3),
            vertices=None,
            roles=info.roles,
            correspondences=info.vertices,
            experiment=2 if bool(values["speaker_fixed"].all()) else 1,
            rate_hz=rate_hz,
            model_fingerprint=info.model_fingerprint,
            model_name=info.model_name,
            recording=str(self.path),
            coil_states=_states(self.coil_states()[there]),
        )

    def coil_states(self) -> FloatArray:
        """(frames, roles): `CoilState` numbers, NaN where a frame's pose is lost."""
        return self.pose[:, len(self.info.pose_labels) - len(self.info.roles) :]

    def _check_frames(self) -> None:
        if self.frame_count == 0:
            why = f" ({self.damage})" if self.damage else ""
            raise InputError(f"{self.path}: the take has no frames{why}.")

    # From streams and journal to frames ---------------------------------------------------------------

    @cached_property
    def _index(self) -> _Index:
        stamps = {name: self.stream_stamps(name) for name in NUMBERS}
        longest = max(stamps.values(), key=len)
        if _possible(longest).all() and all(np.array_equal(values, longest) for values in stamps.values()):
            return _Index(longest, dict.fromkeys(NUMBERS))
        keys = {name: _keys(values) for name, values in stamps.items()}
        together, first = np.unique(np.concatenate(list(keys.values())), return_index=True)
        whole = np.concatenate(list(stamps.values()))[first]
        possible = _possible(together)
        together, whole = together[possible], whole[possible]
        rows = {name: np.searchsorted(together, values) for name, values in keys.items()}
        for name, values in keys.items():
            rows[name][~_possible(values)] = len(whole)
        return _Index(whole, rows)

    def stream_stamps(self, name: str) -> FloatArray:
        """(rows,) s, of one of the four streams: the file's and then the journal's."""
        stream = self.file.named(name)
        stamps = stream.stamps if stream else np.empty(0)
        if name == MARKERS:
            return np.concatenate([stamps, [mark.stamp_s for mark in self.marks_from_journal()]])
        more = self.from_journal(name)
        return stamps if more is None else np.concatenate([stamps, more["arrival_ns"] * NS])

    def _columns(self, name: str, columns: range) -> FloatArray:
        """(frames, len(columns)) of a stream."""
        stream = self.file.named(name)
        values = stream.columns(columns) if stream else np.empty((0, len(columns)))
        more = self.from_journal(name)
        if more is not None:
            values = np.concatenate([values, more[name][:, columns.start : columns.stop]])
        rows = self._index.rows[name]
        if rows is None:
            return values
        out = np.full((self.frame_count, len(columns)), np.nan)
        known = rows < self.frame_count
        out[rows[known]] = values[known]
        return out


def read_take(path: str | os.PathLike[str]) -> Take:
    """Opens a take, and the journal beside it if there is one.

    Only headers and time stamps are looked at; the rest stays in the file until it is asked for. Raises
    InputError where there is no such file, or it is not a take.
    """
    path = Path(path)
    if not is_xdf(read_head(path).data):
        raise InputError(f"{path}: this is not a take, which is an XDF file.")
    try:
        data = map_file(path)
    except OSError as reason:
        raise InputError(f"{path}: cannot be read ({reason.strerror or reason}).") from reason
    file = read_xdf(data, str(path))
    try:
        info = info_from_streams(file.streams)
    except InputError as reason:
        damage = f" The file is damaged: {file.damage}." if file.damage else ""
        raise InputError(f"{path}: {reason}{damage}") from reason
    beside = journal_path(path)
    if not beside.exists():
        return Take(path, info, file)
    try:
        journal, marks = read_journal(beside, path), tuple(read_journal_marks(beside, path))
    except InputError as reason:
        return Take(path, info, file, journal_note=f"The journal beside the take was not used: {reason}")
    if journal.dtype != info.row_dtype():
        why = f"The journal beside the take was not used: {beside} has rows of other channels."
        return Take(path, info, file, journal_note=why)
    take = Take(path, info, file, journal, marks)
    extra = take.frame_count - stream_count(file.named(RAW))
    extra_marks = len(take.marks_from_journal())
    found = [f"{extra} frame(s)"] if extra > 0 else []
    found += [f"{extra_marks} mark(s)"] if extra_marks else []
    note = f"{' and '.join(found)} came from the journal beside the take." if found else ""
    return replace(take, journal_note=note)


def stream_count(stream: XdfStream | None) -> int:
    return 0 if stream is None else stream.count


def _states(numbers: FloatArray) -> NDArray[np.int64]:
    """The `CoilState` that the numbers stand for; damage makes any number of one, which then is trusted."""
    known = np.isin(numbers, [int(state) for state in CoilState])
    return np.where(known, numbers, CoilState.TRUSTED).astype(np.int64)


def _possible(stamps: FloatArray) -> NDArray[np.bool_]:
    """(rows,) whether it can be a time; damage makes any number of it."""
    return np.asarray(np.abs(stamps) < LARGEST_STAMP_S)


def _keys(stamps: FloatArray) -> FloatArray:
    """(rows,) different for frames that arrived at once, and the same in every stream."""
    begins = np.flatnonzero(np.diff(stamps, prepend=np.nan) != 0)
    before = np.repeat(begins, np.diff(begins, append=len(stamps)))
    return stamps + (np.arange(len(stamps)) - before) * np.spacing(stamps)
