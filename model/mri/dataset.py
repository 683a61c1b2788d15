"""A data set of MRI scans: who was scanned holding which phone, and what a person marked on the scans.

One readable TOML file names everything; landmarks stand in small CSV files beside it. Positions are mm in the
scan's own world, x to the left, y back, z up: the patient coordinates of DICOM ("LPS").

    provenance = "where the scans come from, in a sentence"
    phones = ["i", "a"]

    [settings]                          # left to the pipeline; without it, the paper's

    [[speakers]]
    name = "Speaker01"
    palate = "a"                        # the phone whose scan shows the hard palate
    palate_landmarks = "landmarks/Speaker01_palate.csv"

    [[speakers.scans]]
    phone = "a"
    file = "scans/Speaker01_a.nii.gz"   # a volume, or the folder of a DICOM series
    landmarks = "landmarks/Speaker01_a.csv"
    region = [[-26, -10, -60], [26, 80, 35]]   # may be absent: two corners, mm

A phone that a speaker does not list is a missing cell, and no fault. What concerns one scan alone (its file is
not there, its landmarks cannot be read) leaves that scan out and says so in `Dataset.problems`; only a file
that cannot be understood as a whole raises InputError.
"""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import InputError

FloatArray = NDArray[np.float64]
Landmarks = Mapping[str, FloatArray]
LARGEST_FILE = 10_000_000
LANDMARK_HEADER = ("name", "x_mm", "y_mm", "z_mm")
_DATASET_KEYS = ("provenance", "phones", "settings", "speakers")
_SPEAKER_KEYS = ("name", "palate", "palate_landmarks", "scans")
_SCAN_KEYS = ("phone", "file", "landmarks", "region")


@dataclass(frozen=True)
class Region:
    """A box, edges parallel to the world's axes: low_mm and high_mm are opposite corners, (3,) mm."""

    low_mm: FloatArray
    high_mm: FloatArray


@dataclass(frozen=True)
class ScanEntry:
    """One scan. tongue_landmarks and palate_landmarks: name -> (3,) mm; the latter are there (not None) on the
    one scan of a speaker that shows the hard palate. region: what to crop to, None for everything."""

    path: Path
    tongue_landmarks: Landmarks
    palate_landmarks: Landmarks | None = None
    region: Region | None = None


@dataclass(frozen=True)
class Problem:
    """Why something was left out, in a sentence that names it. phone: None where it is the whole speaker."""

    speaker: str
    phone: str | None
    sentence: str


@dataclass(frozen=True)
class Dataset:
    """scans: (speaker, phone) -> entry, for what is there and usable; speakers: those with a usable palate scan,
    in the file's order; palate_phone: speaker -> the phone of that scan; settings: the file's table as it
    stands; problems: everything that was left out, and why."""

    source: Path
    provenance: str
    speakers: tuple[str, ...]
    phones: tuple[str, ...]
    scans: Mapping[tuple[str, str], ScanEntry]
    palate_phone: Mapping[str, str]
    settings: Mapping[str, Any] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()

    def missing(self) -> tuple[tuple[str, str], ...]:
        """Cells (speaker, phone) without a usable scan, of the speakers that are left."""
        cells = ((speaker, phone) for speaker in self.speakers for phone in self.phones)
        return tuple(cell for cell in cells if cell not in self.scans)

    def without(self, problems: Iterable[Problem]) -> Dataset:
        """The data set that is left when what the problems name is taken out.

        A speaker whose palate scan goes, goes with all scans: nothing else tells head from tongue movement.
        """
        found = list(problems)
        gone = {(problem.speaker, problem.phone) for problem in found}
        for speaker in self.speakers:
            phone = self.palate_phone[speaker]
            if (speaker, phone) in gone and (speaker, None) not in gone:
                gone.add((speaker, None))
                found.append(Problem(speaker, None, _no_palate(speaker)))
        return replace(
            self,
            speakers=tuple(name for name in self.speakers if (name, None) not in gone),
            scans={
                key: entry
                for key, entry in self.scans.items()
                if key not in gone and (key[0], None) not in gone
            },
            palate_phone={
                name: phone for name, phone in self.palate_phone.items() if (name, None) not in gone
            },
            problems=(*self.problems, *found),
        )

    def requiring_landmarks(self, tongue: Collection[str], palate: Collection[str]) -> Dataset:
        """Without the scans that lack one of these landmarks (`palate` on the palate scans only)."""
        problems = []
        for (speaker, phone), entry in self.scans.items():
            lacking = [name for name in tongue if name not in entry.tongue_landmarks]
            if entry.palate_landmarks is not None:
                lacking += [name for name in palate if name not in entry.palate_landmarks]
            if lacking:
                sentence = (
                    f"{entry.path}: the scan of {speaker} holding [{phone}] has no landmark "
                    f"{', '.join(lacking)}; mark it, or take the scan out of {self.source.name}."
                )
                problems.append(Problem(speaker, phone, sentence))
        return self.without(problems) if problems else self


def load_dataset(path: str | Path) -> Dataset:
    """Reads the file and its landmarks; volumes are only looked for.

    Raises InputError where the file as a whole cannot be used.
    """
    path = Path(path)
    table = _load_toml(path)
    _check_keys(table, _DATASET_KEYS, str(path))
    phones = _strings(table.get("phones"), f"{path}: 'phones'")
    provenance = table.get("provenance", "")
    settings = table.get("settings", {})
    if not isinstance(provenance, str) or not isinstance(settings, dict):
        raise InputError(f"{path}: expected a sentence under 'provenance' and a table under 'settings'.")
    speakers: list[str] = []
    scans: dict[tuple[str, str], ScanEntry] = {}
    palate_phone: dict[str, str] = {}
    problems: list[Problem] = []
    for row in _tables(table.get("speakers"), f"{path}: 'speakers'"):
        _check_keys(row, _SPEAKER_KEYS, f"{path}: a speaker")
        name = _string(row.get("name"), f"{path}: a speaker's 'name'")
        where = f"{path}: speaker '{name}'"
        if name in speakers:
            raise InputError(f"{where} is listed twice.")
        speakers.append(name)
        palate_phone[name] = palate = _string(row.get("palate", ""), f"{where}, 'palate'", may_be_empty=True)
        marks = _string(row.get("palate_landmarks", ""), f"{where}, 'palate_landmarks'", may_be_empty=True)
        listed = set()
        for scan in _tables(row.get("scans", []), f"{where}, 'scans'"):
            _check_keys(scan, _SCAN_KEYS, f"{where}, a scan")
            phone = _string(scan.get("phone"), f"{where}, a scan's 'phone'")
            if phone not in phones:
                raise InputError(f"{where} has a scan of '{phone}', but 'phones' lists {', '.join(phones)}.")
            if phone in listed:
                raise InputError(f"{where} lists the phone '{phone}' twice.")
            listed.add(phone)
            here = f"{where}, '{phone}'"
            file = _string(scan.get("file"), f"{here}, 'file'")
            landmarks = _string(scan.get("landmarks"), f"{here}, 'landmarks'")
            region = _region(scan["region"], f"{here}, 'region'") if "region" in scan else None
            try:
                scans[name, phone] = _entry(
                    path.parent, file, landmarks, marks if phone == palate else None, region, where
                )
            except InputError as reason:
                problems.append(Problem(name, phone, f"{name} [{phone}]: {reason}"))
    left_out = {(problem.speaker, problem.phone) for problem in problems}
    for name in speakers:
        if (name, palate_phone[name]) not in scans and (name, palate_phone[name]) not in left_out:
            problems.append(Problem(name, None, _no_palate(name)))
    whole = Dataset(path, provenance, tuple(speakers), phones, scans, palate_phone, settings)
    return whole.without(problems)


def dataset_toml(dataset: Dataset, landmark_files: Mapping[tuple[str, str], tuple[str, str | None]]) -> str:
    """The data set as the text of a file that `load_dataset` reads back.

    landmark_files: (speaker, phone) -> names of the tongue's and, on the palate scan, the palate's landmark file.
    Paths become relative to the data set's folder where they are below it. Problems are not written.
    """
    import tomlkit

    folder = dataset.source.parent
    document = tomlkit.document()
    document["provenance"] = dataset.provenance
    document["phones"] = list(dataset.phones)
    if dataset.settings:
        document["settings"] = dict(dataset.settings)
    speakers = tomlkit.aot()
    for name in dataset.speakers:
        row = tomlkit.table()
        palate = dataset.palate_phone[name]
        row["name"] = name
        row["palate"] = palate
        row["palate_landmarks"] = landmark_files[name, palate][1]
        scans = tomlkit.aot()
        for phone in dataset.phones:
            entry = dataset.scans.get((name, phone))
            if entry is None:
                continue
            scan = tomlkit.table()
            inside = entry.path.is_relative_to(folder)
            scan["phone"] = phone
            scan["file"] = (entry.path.relative_to(folder) if inside else entry.path).as_posix()
            scan["landmarks"] = landmark_files[name, phone][0]
            if entry.region is not None:
                scan["region"] = [entry.region.low_mm.tolist(), entry.region.high_mm.tolist()]
            scans.append(scan)
        row["scans"] = scans
        speakers.append(row)
    document["speakers"] = speakers
    return tomlkit.dumps(document)


def read_landmarks(path: Path) -> dict[str, FloatArray]:
    """Name -> (3,) mm from a CSV file with the columns name, x_mm, y_mm, z_mm. Raises InputError with the line."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such landmark file.")
    try:
        rows = list(csv.reader(io.StringIO(_bounded_bytes(path).decode())))
    except (UnicodeDecodeError, csv.Error) as reason:
        raise InputError(f"{path}: this is not a CSV file of landmarks ({reason}).") from reason
    if not rows or tuple(cell.strip() for cell in rows[0]) != LANDMARK_HEADER:
        raise InputError(f"{path}: expected the first line '{','.join(LANDMARK_HEADER)}'.")
    landmarks: dict[str, FloatArray] = {}
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        name, *cells = (cell.strip() for cell in row)
        try:
            place = np.array([float(cell) for cell in cells])
        except ValueError:
            place = np.array([np.nan])
        if place.shape != (3,) or not np.isfinite(place).all() or not name:
            raise InputError(f"{path}, line {number}: expected a name and three numbers in mm.")
        if name in landmarks:
            raise InputError(f"{path}, line {number}: the landmark '{name}' is there twice.")
        landmarks[name] = place
    return landmarks


def landmarks_csv(landmarks: Landmarks) -> str:
    """The text that `read_landmarks` reads back, to a hundredth of a millimetre."""
    rows = [",".join(LANDMARK_HEADER)]
    rows += [f"{name},{place[0]:.2f},{place[1]:.2f},{place[2]:.2f}" for name, place in landmarks.items()]
    return "\n".join(rows) + "\n"


def _entry(
    folder: Path, file: str, landmarks: str, palate_landmarks: str | None, region: Region | None, where: str
) -> ScanEntry:
    path = folder / file
    if not path.exists():
        raise InputError(f"{path}: there is no such scan.")
    palate = None
    if palate_landmarks is not None:
        if not palate_landmarks:
            raise InputError(f"{where} names no 'palate_landmarks' for the palate scan.")
        palate = read_landmarks(folder / palate_landmarks)
    return ScanEntry(path, read_landmarks(folder / landmarks), palate, region)


def _no_palate(speaker: str) -> str:
    return (
        f"{speaker}: there is no usable scan with a visible palate ('palate' in the data set), so that all scans "
        f"of this speaker are left out."
    )


def _load_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such data set; name its TOML file.")
    try:
        return tomllib.loads(_bounded_bytes(path).decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as reason:
        raise InputError(f"{path}: this is not a readable TOML file ({reason}).") from reason


def _bounded_bytes(path: Path) -> bytes:
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for this kind of file.")
    return path.read_bytes()


def _check_keys(table: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in known:
            raise InputError(f"{where}: the key '{key}' is not known; known are {', '.join(known)}.")


def _tables(value: Any, where: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
        raise InputError(f"{where}: expected a list of tables ([[...]]).")
    return value


def _strings(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or len(set(map(str, value))) < len(value):
        raise InputError(f"{where}: expected a list of names, each once.")
    return tuple(_string(item, where) for item in value)


def _string(value: Any, where: str, may_be_empty: bool = False) -> str:
    if not isinstance(value, str) or "\0" in value or not (value or may_be_empty):
        raise InputError(f"{where}: expected a text, found {value!r}.")
    return value


def _region(value: Any, where: str) -> Region:
    try:
        corners = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise InputError(f"{where}: expected two corners [[x, y, z], [x, y, z]] in mm, the lower one first.")
    return Region(corners[0], corners[1])
