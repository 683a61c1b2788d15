"""The takes of one run: begun and ended from anywhere, without the loop ever waiting for the disk."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ... import InputError
from ...drivers.frames import CoilFrame
from .layout import TakeInfo
from .recorder import TakeRecorder

SUFFIX = ".xdf"


@dataclass(frozen=True)
class KeptTake:
    """One finished take, for the summary. failure: "" or why it ends early; not_recorded: frames after that."""

    path: str
    frames: int
    failure: str
    not_recorded: int


class TakeKeeper:
    """Where takes go, and the one that is being recorded.

    place: a file `take.xdf`: the first take; further ones are take-2.xdf, take-3.xdf, ... A folder: take-001.xdf,
    take-002.xdf, ...; names that are asked for are used as they are. No file is ever overwritten.
    describe: what a take's header says, from one of the source's frames; asked when a take begins.

    `recorder` is what the loop reads at every frame: None between takes.
    """

    def __init__(self, place: str | Path, describe: Callable[[CoilFrame], TakeInfo]) -> None:
        self.recorder: TakeRecorder | None = None
        self.finished: list[KeptTake] = []
        self.refusal = ""
        self._place = Path(place)
        self._describe = describe
        self._frame: CoilFrame | None = None
        self._busy = threading.Lock()
        self._threads: list[threading.Thread] = []

    def first_frame(self, frame: CoilFrame) -> None:
        """Called with the run's first frame: its kind is that of all others. Begins the take that a file was named for."""
        self._frame = frame
        if not is_folder(self._place):
            self.start_now()

    def start_now(self, name: str = "") -> None:
        """Begins a take; returns when its file exists. Raises InputError where it cannot."""
        with self._busy:
            if self.recorder is not None:
                raise InputError(f"{self.recorder.path} is being recorded already; stop it first.")
            if self._frame is None:
                raise InputError("no take can begin before the source's first frame.")
            recorder = TakeRecorder(self._describe(self._frame), self._next_path(name))
            recorder.open()
            self.recorder = recorder

    def stop_now(self) -> None:
        """Ends the take; returns when it is whole on disk. Nothing happens where there is none."""
        with self._busy:
            recorder, self.recorder = self.recorder, None
            if recorder is None:
                return
            recorder.close()
            self.finished.append(
                KeptTake(str(recorder.path), recorder.frames, recorder.failure or "", recorder.not_recorded)
            )

    def start(self, name: str = "") -> None:
        """As `start_now`, but returns at once; a refusal is in `refusal`."""
        self._in_background(lambda: self.start_now(name))

    def stop(self) -> None:
        """As `stop_now`, but returns at once."""
        self._in_background(self.stop_now)

    def close(self) -> None:
        """Ends everything and waits for it."""
        self.wait()
        self.stop_now()

    def wait(self) -> None:
        """Returns when everything that was asked for so far has been done."""
        for thread in self._threads:
            thread.join()

    def _in_background(self, work: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                work()
            except (InputError, OSError) as reason:
                self.refusal = str(reason)

        thread = threading.Thread(target=guarded, name="take", daemon=True)
        self._threads = [other for other in self._threads if other.is_alive()] + [thread]
        thread.start()

    def _next_path(self, name: str) -> Path:
        folder = self._place if is_folder(self._place) else self._place.parent
        folder.mkdir(parents=True, exist_ok=True)
        if name:
            plain = re.sub(r"[^\w.+-]+", "_", name).strip("._") or "take"
            return _unused(folder / plain.removesuffix(SUFFIX))
        if is_folder(self._place):
            number = 1
            while (folder / f"take-{number:03d}{SUFFIX}").exists():
                number += 1
            return folder / f"take-{number:03d}{SUFFIX}"
        if not self.finished and not self._place.exists():
            return self._place
        return _unused(self._place.with_suffix(""))


def check_place(place: str | Path) -> None:
    """Raises InputError where the first take's file exists already, or what should be a folder is a file or named so."""
    place = Path(place)
    if is_folder(place):
        if place.exists() and not place.is_dir():
            raise InputError(
                f"{place}: this is a file; name a folder for takes, or a new file that ends in .xdf."
            )
        if not place.exists() and re.fullmatch(r"\.[A-Za-z]\w{1,4}", place.suffix):
            raise InputError(
                f"{place}: a take's name ends in .xdf; for a folder of takes choose a name without an ending."
            )
    elif place.exists():
        raise InputError(
            f"{place}: this take exists already; choose another name, takes are never overwritten."
        )


def is_folder(place: Path) -> bool:
    """Whether `--record` names a folder for many takes rather than the file of the first."""
    return place.suffix.lower() != SUFFIX


def _unused(stem: Path) -> Path:
    path, number = stem.with_name(stem.name + SUFFIX), 2
    while path.exists():
        path = stem.with_name(f"{stem.name}-{number}{SUFFIX}")
        number += 1
    return path
