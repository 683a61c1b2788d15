"""What recordings a folder holds, and what else lies there and why it is not one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ... import InputError
from . import ssff
from .recognise import read_head, read_whole, recognise


@dataclass(frozen=True, slots=True)
class Found:
    """One recording, or one file left out.

    path: what to hand to open_recording. files: every file that belongs to it (SSFF: one a coil).
    format: in words, "" if left out. left_out: the reason, "" if it is a recording.
    """

    path: Path
    files: tuple[Path, ...]
    format: str = ""
    left_out: str = ""

    @property
    def is_recording(self) -> bool:
        return not self.left_out


def find_recordings(path: str | os.PathLike[str]) -> list[Found]:
    """Everything below a folder (or the one file), sorted by path; hidden files and folders are passed over.

    Only the beginning of a file is read, except SSFF, whose files are grouped by stem, rate and length.
    A recording that is found may still need --rate or --unit to open. Raises InputError if there is
    nothing at `path`, or only an empty folder.
    """
    root = Path(path)
    if not os.path.isdir(root):
        read_head(root)
    files = sorted(_files(root)) if os.path.isdir(root) else [root]
    if not files:
        raise InputError(f"{root}: the folder is empty.")
    found: list[Found] = []
    groups: dict[tuple[Path, str, float, float, int], list[Path]] = {}
    for file in files:
        try:
            form = recognise(read_head(file), str(file))
            if form.words == "SSFF":
                track = ssff.parse_track(read_whole(file), str(file))
                if not ssff.holds_coils(track):
                    raise InputError(f"{file}: SSFF without coil positions (formants, pitch?).")
                key = (file.parent, file.stem, track.rate_hz, track.start_s, track.frames)
                groups.setdefault(key, []).append(file)
                continue
            if form.suffixes == (".mat",) and "palate" in file.stem.lower():
                raise InputError(f"{file}: a palate trace, by its name.")
        except InputError as error:
            found.append(Found(file, (file,), left_out=str(error).removeprefix(f"{file}: ")))
        else:
            found.append(Found(file, (file,), format=form.words))
    found += [Found(members[0], tuple(members), format="SSFF") for members in groups.values()]
    return sorted(found, key=lambda item: item.path)


def _files(root: Path) -> Iterator[Path]:
    """Regular files below a folder; links to folders are not followed."""
    for folder, subfolders, names in os.walk(root):
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
        yield from (Path(folder, name) for name in names if not name.startswith("."))
