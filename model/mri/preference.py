"""The preference test: which of two contours people prefer in a slice (paper, "Evaluation of the mesh extraction process").

Every scan gives a sagittal slice with nothing on it, and two contours of the tongue in it: after the first template
matching and after bootstrapping. The scans are divided at random into partitions of about the same size; a participant
judges one partition. What was made stands in one folder:

    test.json          what is shown, and what the two contours are
    pictures/0001.png  the plain slices
    answers/*.jsonl    what every participant chose (see `preferenceanswers`)
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import InputError, __version__
from ...atomic import write_atomically
from ..mesh import FloatArray, Mesh
from .contours import contour
from .dataset import Problem
from .reading import library
from .results import BuildResult
from .scan import Scan
from .slicepicture import magnified, slice_values
from .stages import scan_at

INITIAL, FINAL = "initial", "final"
METHODS = (INITIAL, FINAL)
"""After the first template matching, and after bootstrapping."""

TEST_FILE, PICTURES, ANSWERS = "test.json", "pictures", "answers"
PICTURE_NAME = rf"{PICTURES}/\d{{4}}\.png"
FORMAT, VERSION = "tonguetrack preference test", 1
PARTITIONS = 4
MARGIN_MM = 16.0  # around the contours
PIXEL_MM = 0.2  # of the pictures; voxels are interpolated
DIGITS = 2  # of a mm, in contours
MAX_TEST_BYTES = 100_000_000
MAX_ITEMS = 5000
MAX_PICTURE_BYTES = 20_000_000

Contour = tuple[FloatArray, ...]


@dataclass(frozen=True)
class Case:
    """One scan to be judged. initial, final: the tongue after both methods, mm in the scan's world; middle_mm: where
    the head's mid-sagittal plane cuts the scan's x axis, told from neither of them."""

    speaker: str
    phone: str
    scan: Scan
    initial: Mesh
    final: Mesh
    middle_mm: float


@dataclass(frozen=True)
class Item:
    """One slice that is judged.

    at_mm: its place in the scan, x; partition: from 1; picture: its file, relative to the test's folder;
    width_mm, height_mm: how much the picture shows. initial, final: the lines of each contour, (k, 2) mm to the right
    and downwards from the picture's upper left corner.
    """

    speaker: str
    phone: str
    at_mm: float
    partition: int
    picture: str
    width_mm: float
    height_mm: float
    initial: Contour
    final: Contour


@dataclass(frozen=True)
class PreferenceTest:
    """source, provenance: the data set's name and where its scans come from. fingerprint: changes with everything in
    `test.json`; answers name it."""

    folder: Path
    source: str
    provenance: str
    seed: int
    partitions: int
    items: tuple[Item, ...]
    fingerprint: str

    @property
    def synthetic(self) -> bool:
        """Whether nobody was ever scanned."""
        return self.provenance.startswith("synthetic")

    def partition(self, number: int) -> list[int]:
        """The items of a partition, from 1. Raises InputError where there is no such partition."""
        if not 1 <= number <= self.partitions:
            raise InputError(
                f"{self.folder}: there is no partition {number}; there are 1 to {self.partitions}."
            )
        return [index for index, item in enumerate(self.items) if item.partition == number]


def cases_of(result: BuildResult) -> Iterator[tuple[str, str, Case | InputError]]:
    """Speaker, phone, and what there is to judge, for every scan of a build that has a tongue; or why it cannot be.

    Scans are read one after the other, as they are asked for. Raises InputError where nothing was bootstrapped.
    """
    if all(np.array_equal(scan.initial, scan.final) for scan in result.scans.values()):
        raise InputError(
            f"{result.source}: no mesh differs before and after bootstrapping, so that there is nothing to prefer; "
            "build with one round of it or more."
        )
    faces, middle = result.tongue.mesh.faces, list(result.palate.marks.midsagittal)
    for (speaker, phone), found in result.scans.items():
        try:
            case: Case | InputError = Case(
                speaker,
                phone,
                scan_at(found.entry.path, found.entry.region),
                Mesh(found.initial, faces),
                Mesh(found.final, faces),
                float(found.palate[middle, 0].mean()),
            )
        except InputError as reason:
            case = reason
        yield speaker, phone, case


def make_test(
    cases: Iterable[tuple[str, str, Case | InputError]],
    folder: str | Path,
    source: str,
    provenance: str,
    partitions: int = PARTITIONS,
    offsets_mm: Sequence[float] = (0.0,),
    seed: int = 0,
) -> tuple[PreferenceTest, tuple[Problem, ...]]:
    """Writes the test into an absent or empty folder; returns it, and which scans were left out, and why.

    offsets_mm: the slices of every scan, to the left of the mid-sagittal plane; those of one scan are in one
    partition. Raises InputError for a folder that holds something, for fewer scans than partitions, and where
    nothing can be shown.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: a test is made in a new or empty folder; name another one.")
    library("PIL.Image")
    drawn: list[list[tuple[Item, bytes]]] = []
    problems = []
    for speaker, phone, case in cases:
        try:
            if isinstance(case, InputError):
                raise case
            drawn.append([_drawn(case, case.middle_mm + offset) for offset in offsets_mm])
        except InputError as reason:
            problems.append(Problem(speaker, phone, f"{speaker} [{phone}]: {reason}"))
    if not 1 <= partitions <= len(drawn):
        said = f" ({problems[0].sentence})" if problems else ""
        raise InputError(
            f"{source}: {len(drawn)} scans can be shown, which cannot be divided into {partitions} partitions{said}."
        )
    if len(drawn) * len(offsets_mm) > MAX_ITEMS:
        raise InputError(f"{source}: more than {MAX_ITEMS} slices; name fewer with --slices.")
    places = np.random.default_rng([seed, len(drawn)]).permutation(np.arange(len(drawn)) % partitions) + 1
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    items: list[Item] = []
    for slices, place in zip(drawn, places, strict=True):
        for item, picture in slices:
            name = f"{PICTURES}/{len(items) + 1:04d}.png"
            write_atomically(folder / name, picture)
            items.append(replace(item, partition=int(place), picture=name))
    write_atomically(folder / TEST_FILE, _as_json(items, source, provenance, partitions, seed))
    return load_test(folder), tuple(problems)


def load_test(folder: str | Path) -> PreferenceTest:
    """Reads a test that `make_test` made. Raises InputError for anything else, and for a picture that is not there."""
    folder = Path(folder)
    path = folder / TEST_FILE
    if not path.is_file():
        raise InputError(
            f"{path}: there is no preference test; make one with 'tonguetrack mri preference make'."
        )
    if path.stat().st_size > MAX_TEST_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a preference test.")
    content = path.read_bytes()
    try:
        table = json.loads(content)
        if table["format"] != FORMAT or table["version"] != VERSION:
            raise ValueError("another format")
        partitions = _whole(table["partitions"], 1, MAX_ITEMS)
        items = tuple(_item(row, partitions) for row in table["items"])
        if not 0 < len(items) <= MAX_ITEMS:
            raise ValueError("no items")
        test = PreferenceTest(
            folder,
            _text(table["source"]),
            _text(table["provenance"]),
            _whole(table["seed"], 0, 2**63),
            partitions,
            items,
            hashlib.sha256(content).hexdigest()[:16],
        )
    except (ValueError, KeyError, TypeError, RecursionError) as reason:
        raise InputError(
            f"{path}: this is not a preference test of ours ({reason}); make it again."
        ) from reason
    for item in items:
        if not (folder / item.picture).is_file():
            raise InputError(
                f"{folder / item.picture}: this picture of the test is not there; make the test again."
            )
    return test


def picture_bytes(test: PreferenceTest, item: Item) -> bytes:
    """The plain slice as PNG."""
    path = test.folder / item.picture
    with open(path, "rb") as stream:
        content = stream.read(MAX_PICTURE_BYTES + 1)
    if len(content) > MAX_PICTURE_BYTES:
        raise InputError(
            f"{path}: more than {MAX_PICTURE_BYTES} bytes are too many for a picture of a slice."
        )
    return content


# Making ---------------------------------------------------------------------------------------------


def _drawn(case: Case, at_mm: float) -> tuple[Item, bytes]:
    """The item, still without partition and file, and its picture."""
    values, edges = slice_values(case.scan, "sagittal", at_mm)
    initial, final = (contour(mesh, "sagittal", at_mm) for mesh in (case.initial, case.final))
    for method, lines in zip(METHODS, (initial, final), strict=True):
        if not lines:
            raise InputError(f"the {method} mesh does not reach the sagittal slice at {at_mm:.1f} mm.")
    places = np.vstack([*initial, *final])
    # The same frame around both contours, so that it tells nothing about either.
    low = np.maximum(places.min(axis=0) - MARGIN_MM, [edges[0], edges[2]])
    high = np.minimum(places.max(axis=0) + MARGIN_MM, [edges[1], edges[3]])
    if not (high - low > MARGIN_MM).all():
        raise InputError(f"the contours in the sagittal slice at {at_mm:.1f} mm lie outside of the scan.")
    corner = np.array([low[0], high[1]])
    item = Item(
        case.speaker,
        case.phone,
        round(at_mm, DIGITS),
        0,
        "",
        float(high[0] - low[0]),
        float(high[1] - low[1]),
        tuple((line - corner) * [1.0, -1.0] for line in initial),
        tuple((line - corner) * [1.0, -1.0] for line in final),
    )
    return item, _png(magnified(values, edges, low, high, PIXEL_MM))


def _png(pixels: NDArray[np.uint8]) -> bytes:
    stream = io.BytesIO()
    library("PIL.Image").fromarray(pixels).save(stream, format="png")
    return stream.getvalue()


# The file -------------------------------------------------------------------------------------------


def _as_json(items: Sequence[Item], source: str, provenance: str, partitions: int, seed: int) -> bytes:
    def lines(found: Contour) -> list[Any]:
        return [np.round(line, DIGITS).tolist() for line in found]

    rows = [
        {
            "speaker": item.speaker,
            "phone": item.phone,
            "at_mm": item.at_mm,
            "partition": item.partition,
            "picture": item.picture,
            "size_mm": [round(item.width_mm, DIGITS), round(item.height_mm, DIGITS)],
            INITIAL: lines(item.initial),
            FINAL: lines(item.final),
        }
        for item in items
    ]
    content = {
        "format": FORMAT,
        "version": VERSION,
        "program": f"tonguetrack {__version__}",
        "source": source,
        "provenance": provenance,
        "seed": seed,
        "partitions": partitions,
        "items": rows,
    }
    return json.dumps(content, ensure_ascii=False).encode()


def _item(row: Any, partitions: int) -> Item:
    """Raises ValueError, KeyError or TypeError for what is no item."""
    picture = _text(row["picture"])
    if not re.fullmatch(PICTURE_NAME, picture):
        raise ValueError(f"the picture '{picture}'")
    width, height = (_number(value) for value in row["size_mm"])
    if width <= 0 or height <= 0:
        raise ValueError("a picture without extent")
    return Item(
        _text(row["speaker"]),
        _text(row["phone"]),
        _number(row["at_mm"]),
        _whole(row["partition"], 1, partitions),
        picture,
        width,
        height,
        _contour(row[INITIAL]),
        _contour(row[FINAL]),
    )


def _contour(rows: Any) -> Contour:
    lines = tuple(np.array(line, dtype=np.float64) for line in rows)
    if not lines or any(
        line.ndim != 2 or line.shape[1] != 2 or not np.isfinite(line).all() for line in lines
    ):
        raise ValueError("a contour that is none")
    return lines


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} instead of a text")
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} instead of a number")
    return float(value)


def _whole(value: Any, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise TypeError(f"{value!r} instead of a whole number from {low} to {high}")
    return value
