"""The recorder of a take: every frame goes to the disk, and the loop never waits for it.

    loop's thread      put: one row into the journal, memory that outlives the process
    writer's thread    every 0.1 s: the journal's new rows at the end of the take, a chunk a stream
    flusher's thread   every 0.25 s: the take's new bytes from the system's memory to the disk

A killed process loses no frame: each is in the take or in the journal beside it. A power cut takes what was not
flushed, at most 0.5 s as long as one flush lasts less than 0.15 s; `seconds_behind` tells how much it would be.
A disk that is slow to flush holds up neither of the two other threads. One that takes nothing at all for
longer than the journal lasts (20 s) makes further frames wait in memory, where a kill would lose them.

Marks wake the writer's thread and stand in the journal until then. A kill can lose one only if it is longer than
256 KiB, or if that much came while the disk took nothing.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ... import InputError
from ...drivers.frames import CoilFrame
from ...drivers.xdf import boundary, file_header, samples, stream_footer, text_samples
from ..pose import FloatArray, TrackedPose
from .appending import AppendedFile, Sync, Write, flush_folder, flush_to_disk, is_gone, words_for
from .headers import header_bytes
from .journal import Journal, Rows, Words, journal_path, slot_dtype
from .layout import MARKERS, POSE, PREPARED, RAW, STREAM_IDS, TakeInfo
from .marklog import Mark
from .rows import Row

WRITE_EVERY_S = 0.1
FLUSH_EVERY_S = 0.25
BOUNDARY_EVERY_S = 10.0
NUMBERS = (RAW, PREPARED, POSE)
ROWS_A_CHUNK, ROWS_IN_A_HURRY = 48, 512
"""At most. The writer leaves the interpreter to the loop after each chunk: making a small one takes 0.05 ms, a
large one 1 ms, which is only worth it once more rows than that are waiting."""
JOURNAL_S = 20.0
JOURNAL_BYTES = 64 << 20  # at most
JOURNAL_ROWS = 1024  # at least
UNKNOWN_RATE_HZ = 1250.0
CLOSE_PATIENCE_S = 30.0
"""How long `close` waits for a disk that takes nothing."""
PUT_PATIENCE_S = 1.0
"""How long the end of a take waits for a `put` that began before it."""
_NS = 1e-9


@dataclass(frozen=True)
class TakeSummary:
    """What became of a take.

    frames: that are in the file, or after a failure in the file and the journal together; marks: in the file.
    not_recorded: frames that came after a failure or after the end. failure: None = the file is whole.
    journal: the file that still holds the last frames after a failure, else None.
    """

    path: Path
    frames: int
    marks: int
    bytes_written: int
    not_recorded: int
    failure: str | None
    journal: Path | None


class TakeRecorder:
    """Records one take into a new file.

        recorder = TakeRecorder(info, "take.xdf")
        recorder.open()
        recorder.put(frame, coils, pose)   # for every frame
        recorder.close()

    info: what its header says. failure: one sentence as soon as nothing more can be recorded; None = all is well.
    write, sync: how bytes reach the file and the disk, see `appending.AppendedFile`.
    """

    def __init__(
        self,
        info: TakeInfo,
        path: str | os.PathLike[str],
        write: Write = os.write,
        sync: Sync = flush_to_disk,
    ) -> None:
        self.path = Path(path)
        self.failure: str | None = None
        self.bytes_written = 0
        self.info = info
        self._write = write
        self._sync = sync
        self._row = Row(info)
        self._accepting = False
        self._refused = 0
        self._putting = False
        # Each of these has one thread that writes it: the loop's, the writer's, the flusher's.
        self._sequence = 0
        self._written, self._written_ns = 0, 0
        self._flushed, self._flushed_ns = 0, 0
        self._overflow: deque[Words] = deque()
        self._marking = threading.Lock()
        self._waiting_marks: deque[Mark] = deque()
        self._marks_taken = 0
        self._first_s = 0.0
        self._mark_span_s = (0.0, 0.0)
        self._marks = 0
        self._boundary_at_s = 0.0
        self._closing = False
        self._wake = threading.Event()
        self._flusher_ends = threading.Event()
        self._file: AppendedFile
        self._journal: Journal
        self._writer = threading.Thread(target=self._write_all, name="take writer", daemon=True)
        self._flusher = threading.Thread(target=self._flush_all, name="take flusher", daemon=True)

    @property
    def frames(self) -> int:
        """Frames handed over so far that are in the file, the journal or the queue."""
        return self._sequence - self._lost

    @property
    def not_recorded(self) -> int:
        """Frames that came after a failure or after the end, and those that a failure found in the queue."""
        return self._refused + self._lost

    @property
    def backlog(self) -> int:
        """Frames handed over that are not in the file yet; after a failure those that the journal holds."""
        return self._sequence - self._written - self._lost

    @property
    def seconds_behind(self) -> float:
        """How much of the take, by the frames' arrival, a power cut would take away now."""
        if self._flushed >= self._sequence:
            return 0.0
        return max(0.0, (int(self._row.slot[0]) - self._flushed_ns) * _NS)

    @property
    def _lost(self) -> int:
        return len(self._overflow) if self.failure is not None else 0

    def open(self) -> None:
        """Creates the take and its journal. Raises InputError where one exists already or cannot be made."""
        header = file_header({"datetime": self.info.started}) + header_bytes(self.info)
        try:
            self._file = AppendedFile(self.path, self._write, self._sync)
        except FileNotFoundError as reason:
            raise InputError(
                f"{self.path}: the folder {self.path.parent} does not exist; create it or choose another."
            ) from reason
        except OSError as reason:
            raise InputError(f"{self.path}: cannot record here, {words_for(reason)}.") from reason
        journal = journal_path(self.path)
        try:
            self._append(header)
            self._file.flush()
            self._journal = Journal.create(journal, self.info.row_dtype(), journal_rows(self.info), header)
            flush_folder(self.path.parent)
        except OSError as reason:
            self._file.close()
            with suppress(OSError):
                self.path.unlink(missing_ok=True)
            if isinstance(reason, FileExistsError):
                raise InputError(
                    f"{journal}: the journal of an earlier take of this name is still there; choose another "
                    "name, or move it away."
                ) from reason
            raise InputError(f"{self.path}: cannot record here, {words_for(reason)}.") from reason
        self._flushed_ns = time.perf_counter_ns()
        self._boundary_at_s = time.monotonic() + BOUNDARY_EVERY_S
        self._accepting = True
        self._writer.start()
        self._flusher.start()

    def put(self, frame: CoilFrame, coils: FloatArray, pose: TrackedPose) -> None:
        """Hands over one frame. For the loop's thread alone; copies everything, waits for nothing.

        coils: (n, 3) the prepared coils, mm in the model frame, in the order of the roles.
        """
        self._putting = True
        if self._accepting:
            sequence = self._sequence + 1
            row = self._row
            row.fill(sequence, frame, coils, pose)
            if sequence - self._written > self._journal.capacity:
                self._overflow.append(row.slot.copy())
            else:
                self._journal.store(sequence, row.slot)
            self._sequence = sequence
        else:
            self._refused += 1
        self._putting = False

    def mark(self, text: str, time_ns: int) -> None:
        """Puts a text into the take. time_ns: `time.perf_counter_ns()`. From any thread."""
        with self._marking:
            if not self._accepting:
                return
            self._marks_taken += 1
            mark = Mark(self._marks_taken, time_ns * _NS, text)
            self._journal.marks.store(mark, self._marks)
            self._waiting_marks.append(mark)
        self._wake.set()

    def close(self) -> TakeSummary:
        """Ends the take; returns when it is whole on disk, or has failed. Again: the same summary.

        The journal is removed once the take needs it no more.
        """
        with self._marking:
            self._accepting = False
        self._closing = True
        self._wake.set()
        if self._writer.ident is not None:
            self._await_writer()
        journal = journal_path(self.path)
        return TakeSummary(
            self.path,
            self.frames,
            self._marks,
            self.bytes_written,
            self.not_recorded,
            self.failure,
            journal if journal.exists() else None,
        )

    def _await_writer(self) -> None:
        progress, since_s = -1, time.monotonic()
        while self._writer.is_alive():
            if self.bytes_written != progress:
                progress, since_s = self.bytes_written, time.monotonic()
            elif time.monotonic() - since_s > CLOSE_PATIENCE_S:
                self._fail(f"the disk has not answered for {CLOSE_PATIENCE_S:.0f} s")
                return
            self._writer.join(0.1)

    def _fail_for(self, reason: OSError) -> None:
        self._fail(words_for(reason), lost=is_gone(reason))

    def _fail(self, why: str, lost: bool = False) -> None:
        """lost: nothing is left that could be recovered."""
        self._accepting = False
        kept = (
            ""
            if lost
            else "what was written stays readable, `tonguetrack take recover` adds the last frames, and "
        )
        if self.failure is None:
            self.failure = f"{self.path}: {why}, so recording ended after {self._sequence} frames; {kept}tracking goes on."

    # The writer's thread ----------------------------------------------------------------------------

    def _write_all(self) -> None:
        whole = False
        try:
            while not self._closing and self.failure is None:
                self._wake.wait(WRITE_EVERY_S)
                self._wake.clear()
                self._drain()
            if self.failure is None:
                self._finish()
            whole = True
        except OSError as reason:
            self._fail_for(reason)
        finally:
            if not whole:  # tracking goes on whatever it was, and the user hears of it
                self._fail("the writer met an error of its own")
            self._flusher_ends.set()
            self._flusher.join()
            self._file.close()
            if self.failure is not None:
                with suppress(OSError):
                    self._journal.flush()
            self._journal.release()

    def _drain(self) -> None:
        """Appends all that was handed over before the call."""
        last = self._sequence
        if self._waiting_marks:
            self._write_marks()
        while self._written < last and self.failure is None:
            waiting = last - self._written
            most = ROWS_IN_A_HURRY if waiting > ROWS_IN_A_HURRY else ROWS_A_CHUNK
            self._write_rows(self._next_rows(min(last, self._written + most)))

    def _next_rows(self, last: int) -> Rows:
        """The next rows up to `last` or fewer, from the journal or, where they did not fit there, the queue."""
        first = self._written + 1
        overflow = self._overflow
        next_queued = int(overflow[0][-2]) if overflow else last + 1
        if next_queued > first:
            return self._journal.rows(first, min(last, next_queued - 1))
        taken: list[Words] = []
        while len(taken) < min(len(overflow), last - first + 1):
            slot = overflow[len(taken)]  # stays there until it is written: a failure has to count it
            if slot[-2] != first + len(taken):
                break
            taken.append(slot)
        return np.stack(taken).view(slot_dtype(self.info.row_dtype()))[:, 0]["row"]

    def _write_rows(self, rows: Rows) -> None:
        stamps_s = rows["arrival_ns"] * _NS
        self._append(b"".join(samples(STREAM_IDS[name], stamps_s, rows[name]) for name in NUMBERS))
        if self._written == 0:
            self._first_s = float(stamps_s[0])
        last, last_ns = int(rows["sequence"][-1]), int(rows["arrival_ns"][-1])
        while self._overflow and self._overflow[0][-2] <= last:
            self._overflow.popleft()
        self._written = last  # from here on the loop may write over the rows
        self._written_ns = last_ns

    def _write_marks(self) -> None:
        marks: list[Mark] = []
        while self._waiting_marks:
            marks.append(self._waiting_marks.popleft())
        stamps_s = [mark.stamp_s for mark in marks]
        self._append(text_samples(STREAM_IDS[MARKERS], stamps_s, [mark.text for mark in marks]))
        first_s = self._mark_span_s[0] if self._marks else stamps_s[0]
        self._mark_span_s = (first_s, stamps_s[-1])
        self._marks += len(marks)

    def _append(self, chunks: bytes) -> None:
        if time.monotonic() >= self._boundary_at_s > 0.0:
            chunks = boundary() + chunks
            self._boundary_at_s = time.monotonic() + BOUNDARY_EVERY_S
        self._file.append(chunks)
        self.bytes_written = self._file.size

    def _finish(self) -> None:
        end_s = time.monotonic() + PUT_PATIENCE_S
        while self._putting and time.monotonic() < end_s:
            time.sleep(0.001)
        self._drain()
        if self.failure is not None:
            return
        span_s = (self._first_s, self._written_ns * _NS)
        footers = [stream_footer(STREAM_IDS[name], *span_s, self._written) for name in NUMBERS]
        footers.append(stream_footer(STREAM_IDS[MARKERS], *self._mark_span_s, self._marks))
        self._append(b"".join(footers))
        self._file.flush()
        self._flushed = self._written
        if self.failure is None:
            self._journal.remove()

    # The flusher's thread ---------------------------------------------------------------------------

    def _flush_all(self) -> None:
        due_s, flushed = time.monotonic(), (0, self.bytes_written)
        while not self._flusher_ends.wait(max(0.0, due_s - time.monotonic())) and self.failure is None:
            due_s = time.monotonic() + FLUSH_EVERY_S
            arrival_ns = self._written_ns
            reached = (self._written, self.bytes_written)
            if reached == flushed:
                continue
            try:
                self._file.flush()
            except OSError as reason:
                self._fail_for(reason)
                return
            flushed = reached
            self._flushed = reached[0]
            self._flushed_ns = max(arrival_ns, self._flushed_ns)


def journal_rows(info: TakeInfo) -> int:
    """How many rows the journal of a take holds."""
    wanted = int((info.rate_hz or UNKNOWN_RATE_HZ) * JOURNAL_S)
    return max(JOURNAL_ROWS, min(wanted, JOURNAL_BYTES // slot_dtype(info.row_dtype()).itemsize))
