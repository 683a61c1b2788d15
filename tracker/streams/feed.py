"""The feed: every pose in a ring in a memory-mapped file, for processes of their own on the same computer.

The window and the page read it. They can neither wake nor hold up the tracker: they open the file for reading only,
and the tracker never looks whether anybody does. A folder holds two files.

`about.json`, written once: what a reader must know (`FeedAbout`), with "format" and "version".

`feed`, of a fixed size, little-endian:

    0      magic "TTFEED\\0\\0", then 7 uint32: version, K coefficients, m speaker weights, n coils, slots,
           bytes of a slot, bytes of the numbers
    64     uint64: the newest pose's sequence, 0 = none yet
    72     uint64: 1 = the writer has closed the feed
    128    the numbers: uint64 how often they were written, uint32 length, uint32 CRC-32, JSON
    ...    slots; the pose with the sequence s (from 1) is in slot s % slots:
           uint64 s; float64 device time (s), residual (mm), energy; int64 frame number, arrival and solved (ns);
           int32 status, valid coils, speaker fixed, 0; float64 weights (K), normalised (K), speaker weights (m),
           residuals (n, mm), coils (n, 3, mm, model frame); int64 coil states (n); uint32 CRC-32 of all of it, uint32 0

A reader copies a slot and believes it if sequence and CRC-32 fit: one that was written over meanwhile shows itself,
whatever order a processor gives the stores.
"""

from __future__ import annotations

import json
import mmap
import os
import struct
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from zlib import crc32

import numpy as np

from ... import InputError
from ...atomic import write_atomically
from ..pose import TrackedPose
from .sink import LiveNumbers, StreamInfo

ABOUT_NAME, FEED_NAME = "about.json", "feed"
FORMAT, VERSION = "tonguetrack feed", 1
SLOTS = 512
"""Two seconds of the fastest devices (250 Hz): a reader that looks less often misses poses."""
NUMBERS_PERIOD_S = 1.0
MAX_ABOUT_BYTES = 4 * 1024 * 1024
MAX_COEFFICIENTS, MAX_COILS = 4096, 1024
NUMBERS_BYTES = 65536
MAX_TEXT, MAX_TROUBLES = 500, 20
_MAGIC = b"TTFEED\0\0"
_HEADER = struct.Struct("<8s7I")
_NEWEST_AT, _CLOSED_AT, _NUMBERS_AT = 64, 72, 128
_NUMBERS_HEAD = struct.Struct("<QII")
_WORD = struct.Struct("<Q")
_HEAD = struct.Struct("<Q3d3q4i")
_TAIL = struct.Struct("<II")
_TRIES = 8


@dataclass(frozen=True)
class FeedAbout:
    """What a reader must know before the first pose.

    model: the model's file, absolute, or "bundled"; session: its TOML text, complete; roles, correspondences: of the
    tracked coils, in the order of the residuals; coefficients, speaker_weights: how many (K, m); control: HOST:PORT where
    control messages over OSC are taken, "" = nowhere; title: for people; rate_hz: nominal; pid: of the tracker's process.
    """

    model: str
    session: str
    roles: tuple[str, ...]
    correspondences: tuple[int, ...]
    coefficients: int
    speaker_weights: int
    control: str = ""
    title: str = ""
    rate_hz: float = 0.0
    pid: int = field(default_factory=os.getpid)


@dataclass(frozen=True)
class FeedNumbers:
    """What the run says of itself once a second. troubles: what is wrong, for people; text: the status line."""

    live: LiveNumbers = field(default_factory=LiveNumbers)
    troubles: tuple[str, ...] = ()
    text: str = ""


@dataclass(frozen=True)
class _Layout:
    """How many of what there are in a slot, and what follows from that."""

    coefficients: int
    speaker_weights: int
    coils: int
    slots: int = SLOTS

    @property
    def values(self) -> int:
        """float64 and int64 of a slot's arrays."""
        return 2 * self.coefficients + self.speaker_weights + 5 * self.coils

    @property
    def slot_bytes(self) -> int:
        return _HEAD.size + 8 * self.values + _TAIL.size

    @property
    def slots_at(self) -> int:
        return _NUMBERS_AT + NUMBERS_BYTES

    @property
    def file_bytes(self) -> int:
        return self.slots_at + self.slots * self.slot_bytes

    def header(self) -> bytes:
        return _HEADER.pack(
            _MAGIC, VERSION, self.coefficients, self.speaker_weights, self.coils, self.slots, self.slot_bytes, NUMBERS_BYTES
        )  # fmt: skip


class FeedSink:
    """Writes every pose into the ring: a copy of some hundred bytes, no system call, whoever reads or does not.

    folder: exists and belongs to this user alone; both files are in it when the constructor returns. numbers: asked
    once a second, in a thread of the sink's own, for what the run says of itself; None = nothing. Raises InputError
    where the files cannot be made.
    """

    def __init__(self, folder: Path, about: FeedAbout, destination: str = "feed") -> None:
        self.destination = destination
        self.numbers: Callable[[], FeedNumbers] | None = None
        self.sent = 0
        self.dropped = 0
        self._layout = layout = _Layout(about.coefficients, about.speaker_weights, len(about.roles))
        self._map = _new_map(folder / FEED_NAME, layout)
        self._places = [layout.slots_at + slot * layout.slot_bytes for slot in range(layout.slots)]
        self._numbers_written = 0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        content = {"format": FORMAT, "version": VERSION, **asdict(about)}
        # Last, and in one step: who finds it finds the feed as well.
        write_atomically(folder / ABOUT_NAME, json.dumps(content, indent=1).encode())

    def start(self, info: StreamInfo) -> None:
        layout = self._layout
        sizes = (len(info.mean), len(info.speaker_weights), len(info.roles))
        if sizes != (layout.coefficients, layout.speaker_weights, layout.coils):
            raise ValueError(f"a feed made for {layout} was started with {sizes}")
        self._thread = threading.Thread(target=self._keep_telling, name="feed numbers", daemon=True)
        self._thread.start()

    def change(self, info: StreamInfo) -> None:
        """Nothing to tell: every pose says who the speaker is and whether that is fixed."""

    def send(self, pose: TrackedPose) -> None:
        sequence = self.sent + 1
        filled = b"".join(
            (
                _HEAD.pack(
                    sequence,
                    pose.device_time_s,
                    pose.residual_mm,
                    pose.energy,
                    pose.frame_number,
                    pose.arrival_ns,
                    pose.solved_ns,
                    pose.status,
                    pose.valid_coils,
                    pose.speaker_fixed,
                    0,
                ),
                pose.weights.tobytes(),
                pose.normalised.tobytes(),
                pose.speaker_weights.tobytes(),
                pose.residuals_mm.tobytes(),
                pose.coils.tobytes(),
                pose.coil_states.tobytes(),
            )
        )
        place = self._places[sequence % SLOTS]
        end = place + len(filled)
        self._map[place:end] = filled
        _TAIL.pack_into(self._map, end, crc32(filled), 0)
        _WORD.pack_into(self._map, _NEWEST_AT, sequence)
        self.sent = sequence

    def close(self) -> None:
        """Tells the readers that it is over. They may go on reading what is there. May be called again."""
        if self._map.closed:
            return
        self._over.set()
        if self._thread is not None:
            self._thread.join()
        _WORD.pack_into(self._map, _CLOSED_AT, 1)
        self._map.close()

    def _keep_telling(self) -> None:
        while self.numbers is not None:
            self._tell(self.numbers())
            if self._over.wait(NUMBERS_PERIOD_S):
                break

    def _tell(self, told: FeedNumbers) -> None:
        content = asdict(told)
        content["live"]["take_path"] = told.live.take_path[-MAX_TEXT:]
        content["live"]["take_failure"] = told.live.take_failure[:MAX_TEXT]
        content["troubles"] = [trouble[:MAX_TEXT] for trouble in told.troubles[:MAX_TROUBLES]]
        content["text"] = told.text[:MAX_TEXT]
        # At most 6 bytes a letter: what has been cut fits in any case. A file's name may hold what is no UTF-8.
        encoded = json.dumps(content, ensure_ascii=False).encode("utf-8", "replace")
        self._numbers_written += 1
        place = _NUMBERS_AT + _NUMBERS_HEAD.size
        self._map[place : place + len(encoded)] = encoded
        _NUMBERS_HEAD.pack_into(self._map, _NUMBERS_AT, self._numbers_written, len(encoded), crc32(encoded))


class FeedReader:
    """Reads a feed while it is written, from any process; nothing it does reaches the writer.

        with FeedReader(folder) as feed:
            newest = feed.newest()

    Raises InputError where the folder holds no feed, or one that is damaged or of another version.
    """

    def __init__(self, folder: str | Path) -> None:
        folder = Path(folder)
        self.about = _read_about(folder / ABOUT_NAME)
        self._layout = layout = _layout_of(self.about, folder)
        self._map = _opened_map(folder / FEED_NAME, layout)
        k, m, n = layout.coefficients, layout.speaker_weights, layout.coils
        self._ends = np.cumsum([k, k, m, n, 3 * n]).tolist()
        self._numbers = FeedNumbers()
        self._numbers_seen = 0
        self._is_child = os.getppid() == self.about.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._map.close()

    def newest(self) -> tuple[int, TrackedPose] | None:
        """The newest pose, a copy, and its sequence: 1 for the first of the run. None where there is none yet."""
        for _ in range(_TRIES):
            sequence = self._newest_sequence()
            if not sequence:
                return None
            if (pose := self._pose(sequence)) is not None:
                return sequence, pose
        return None

    def since(self, sequence: int) -> list[tuple[int, TrackedPose]]:
        """All poses after that one, oldest first, as far as the ring still has them."""
        newest = self._newest_sequence()
        first = max(sequence, newest - self._layout.slots, 0) + 1
        found = ((number, self._pose(number)) for number in range(first, newest + 1))
        return [(number, pose) for number, pose in found if pose is not None]

    @property
    def numbers(self) -> FeedNumbers:
        """What the run said of itself last; empty before it first did."""
        count, length, checksum = _NUMBERS_HEAD.unpack_from(self._map, _NUMBERS_AT)
        if count != self._numbers_seen and length <= NUMBERS_BYTES - _NUMBERS_HEAD.size:
            place = _NUMBERS_AT + _NUMBERS_HEAD.size
            encoded = self._map[place : place + length]
            if crc32(encoded) == checksum:
                self._numbers_seen = count
                self._numbers = _numbers_from(encoded)
        return self._numbers

    @property
    def over(self) -> bool:
        """Whether no more poses will come: the writer has closed the feed, or its process is gone."""
        if _WORD.unpack_from(self._map, _CLOSED_AT)[0] or not process_lives(self.about.pid):
            return True
        # A number is taken until somebody has waited for a dead process, and can be given to another one afterwards;
        # but its children have another parent at once.
        return self._is_child and os.getppid() != self.about.pid

    def _newest_sequence(self) -> int:
        return int(_WORD.unpack_from(self._map, _NEWEST_AT)[0])

    def _pose(self, sequence: int) -> TrackedPose | None:
        """None where the slot holds another pose by now, or is being written."""
        layout = self._layout
        place = layout.slots_at + sequence % layout.slots * layout.slot_bytes
        slot = self._map[place : place + layout.slot_bytes]
        checksum, _ = _TAIL.unpack_from(slot, layout.slot_bytes - _TAIL.size)
        filled = slot[: -_TAIL.size]
        head = _HEAD.unpack_from(filled)
        if head[0] != sequence or crc32(filled) != checksum:
            return None
        floats = np.frombuffer(filled, "<f8", self._ends[-1], _HEAD.size).copy()
        weights, normalised, speaker, residuals, coils = np.split(floats, self._ends[:-1])
        states = np.frombuffer(filled, "<i8", layout.coils, _HEAD.size + 8 * self._ends[-1]).copy()
        _, time_s, residual_mm, energy, number, arrival_ns, solved_ns, status, valid, fixed, _ = head
        return TrackedPose(
            weights, normalised, speaker, residuals, residual_mm, energy, valid, status, time_s, number,
            arrival_ns, solved_ns, bool(fixed), states, coils.reshape(-1, 3),
        )  # fmt: skip


def process_lives(pid: int) -> bool:
    """Whether there is a process of this number on this computer."""
    if sys.platform == "win32":  # there, signal 0 is not a question but Ctrl-C
        import ctypes

        kernel = ctypes.windll.kernel32
        handle = kernel.OpenProcess(0x0010_0000, False, pid)  # SYNCHRONIZE
        if not handle:
            return False
        running = kernel.WaitForSingleObject(handle, 0) == 0x102  # WAIT_TIMEOUT
        kernel.CloseHandle(handle)
        return bool(running)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def _new_map(path: Path, layout: _Layout) -> mmap.mmap:
    try:
        with open(path, "x+b") as file:
            # Written, not merely made longer: a full disk shows itself here and not as a crash at the first pose.
            file.write(layout.header().ljust(layout.file_bytes, b"\0"))
            file.flush()
            made = mmap.mmap(file.fileno(), layout.file_bytes)
        path.chmod(
            0o400
        )  # nobody writes there by mistake, or makes the file shorter, which would end the writer
    except OSError as reason:
        raise InputError(f"{path}: the feed cannot be made ({reason.strerror}).") from reason
    made[_HEADER.size :] = bytes(
        layout.file_bytes - _HEADER.size
    )  # every page is there before the first pose
    return made


def _opened_map(path: Path, layout: _Layout) -> mmap.mmap:
    try:
        with open(path, "rb") as file:
            found = os.fstat(file.fileno()).st_size
            if found != layout.file_bytes:
                raise InputError(
                    f"{path}: {found} bytes, expected {layout.file_bytes}; this is no feed or a damaged one."
                )
            opened = mmap.mmap(file.fileno(), layout.file_bytes, access=mmap.ACCESS_READ)
    except OSError as reason:
        raise InputError(f"{path}: there is no feed that can be read ({reason.strerror}).") from reason
    if opened[: _HEADER.size] != layout.header():
        opened.close()
        raise InputError(f"{path}: this is not the feed that {ABOUT_NAME} beside it describes.")
    return opened


def _layout_of(about: FeedAbout, folder: Path) -> _Layout:
    sizes = (about.coefficients, about.speaker_weights, len(about.roles))
    if not all(
        0 <= size <= most for size, most in zip(sizes, (MAX_COEFFICIENTS, MAX_COEFFICIENTS, MAX_COILS))
    ):
        raise InputError(
            f"{folder / ABOUT_NAME}: {sizes} coefficients, speaker weights and coils make no feed."
        )
    return _Layout(*sizes)


def _read_about(path: Path) -> FeedAbout:
    try:
        if path.stat().st_size > MAX_ABOUT_BYTES:
            raise InputError(f"{path}: this is too long to describe a feed.")
        content = json.loads(path.read_bytes())
    except OSError as reason:
        raise InputError(f"{path}: there is no feed ({reason.strerror}).") from reason
    except (ValueError, RecursionError) as reason:
        raise InputError(f"{path}: this does not describe a feed ({reason}).") from reason
    if not isinstance(content, dict) or content.pop("format", None) != FORMAT:
        raise InputError(f"{path}: this does not describe a feed.")
    if (version := content.pop("version", None)) != VERSION:
        raise InputError(
            f"{path}: a feed of version {version}, expected {VERSION}; use one tonguetrack for both."
        )
    try:
        return FeedAbout(
            _of(content, "model", str),
            _of(content, "session", str),
            tuple(_all_of(content, "roles", str)),
            tuple(_all_of(content, "correspondences", int)),
            _of(content, "coefficients", int),
            _of(content, "speaker_weights", int),
            _of(content, "control", str),
            _of(content, "title", str),
            float(_of(content, "rate_hz", (int, float))),
            _of(content, "pid", int),
        )
    except (KeyError, TypeError, OverflowError) as reason:
        raise InputError(f"{path}: this does not describe a feed ({reason}).") from reason


def _of(content: dict[str, Any], name: str, kind: type | tuple[type, ...]) -> Any:
    value = content[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise TypeError(f"'{name}' is {value!r:.40}")
    return value


def _all_of(content: dict[str, Any], name: str, kind: type) -> list[Any]:
    values = _of(content, name, list)
    if not all(isinstance(value, kind) and not isinstance(value, bool) for value in values):
        raise TypeError(f"'{name}' is {values!r:.40}")
    return list(values)


def _numbers_from(encoded: bytes) -> FeedNumbers:
    content = json.loads(encoded)
    live: dict[str, Any] = {
        name: tuple(v) if isinstance(v, list) else v for name, v in content["live"].items()
    }
    return FeedNumbers(LiveNumbers(**live), tuple(content["troubles"]), content["text"])
