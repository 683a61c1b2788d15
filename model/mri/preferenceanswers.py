"""Who judged what: the order in which each participant sees a test, and their choices on disk.

Every participant has one file below TEST/answers, JSON lines that are only ever appended to, each on the disk before
the next one is waited for. The first names the participant and the partition, every other one is a choice; of several
about the same slice the last one counts:

    {"test": "1f0c...", "participant": "Anna", "partition": 2}
    {"item": 17, "speaker": "Speaker02", "phone": "i", "left": "final", "chosen": "final", "time": "2026-01-31T12:00:00Z"}

What is cut off, because the computer went off while it was written, is passed over and counted.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import InputError
from .preference import ANSWERS, METHODS, PreferenceTest

SIDES = ("left", "right")
MAX_NAME = 60
MAX_PARTICIPANTS = 1000
MAX_FILE_BYTES = 5_000_000
"""Of one participant's answers: every slice may be judged anew a hundred times."""


@dataclass(frozen=True)
class Shown:
    """A slice as a participant sees it: which item of the test, and the method whose contour is on the left."""

    item: int
    left: str

    def method(self, side: str) -> str:
        """The method whose contour is on a side."""
        return self.left if side == SIDES[0] else METHODS[1 - METHODS.index(self.left)]

    def side(self, method: str) -> str:
        """The side of a method's contour."""
        return SIDES[0] if method == self.left else SIDES[1]


@dataclass(frozen=True)
class Sitting:
    """One participant's part: shown, in order, and chosen: place in that order -> method. damaged: lines of the
    file that could not be read."""

    participant: str
    partition: int
    shown: tuple[Shown, ...]
    chosen: Mapping[int, str] = field(default_factory=dict)
    damaged: int = 0


def same_name(name: str) -> str:
    """A participant's name as it is compared: case and spaces do not matter.

    Raises InputError for an empty one, one that is too long, and one with control characters.
    """
    tidy = " ".join(unicodedata.normalize("NFC", name).split())
    if not 1 <= len(tidy) <= MAX_NAME or not tidy.isprintable():
        raise InputError(f"a participant's name has 1 to {MAX_NAME} letters.")
    return tidy.casefold()


def shown_to(test: PreferenceTest, participant: str, partition: int) -> tuple[Shown, ...]:
    """The partition in this participant's own random order, always the same; each method is on the left as often."""
    digest = hashlib.sha256(f"{test.fingerprint} {partition} {same_name(participant)}".encode()).digest()
    random = np.random.default_rng(list(digest))
    items = random.permutation(test.partition(partition))
    sides = random.permutation(np.arange(len(items)) + random.integers(2)) % 2
    return tuple(Shown(int(item), METHODS[side]) for item, side in zip(items, sides, strict=True))


def all_sittings(test: PreferenceTest) -> list[Sitting]:
    """Everybody's, in the order of the files' names. Raises InputError where a file belongs to another test."""
    files = sorted((test.folder / ANSWERS).glob("*.jsonl"))
    found = [_read(test, path) for path in files[:MAX_PARTICIPANTS]]
    return [sitting for sitting in found if sitting is not None]


def known_sitting(test: PreferenceTest, participant: str) -> Sitting | None:
    """Where this participant stopped; None for somebody new. Raises InputError for what cannot be a name."""
    path = _file(test, participant)
    return _read(test, path) if path.is_file() else None


def begun_sitting(
    test: PreferenceTest, participant: str, partition: int | None, random: np.random.Generator
) -> Sitting:
    """Where this participant stopped; a new one gets the partition that is named, else one of those that fewest have.

    Raises InputError for a name that cannot be one, for another partition than the participant had before, and where
    too many take part.
    """
    sitting = known_sitting(test, participant)
    if sitting is not None:
        if partition not in (None, sitting.partition):
            raise InputError(
                f"{sitting.participant} has begun with partition {sitting.partition} and cannot go on with {partition}."
            )
        return sitting
    others = all_sittings(test)
    if len(others) >= MAX_PARTICIPANTS:
        raise InputError(
            f"{test.folder}: there are {len(others)} participants already; more are not kept apart."
        )
    if partition is None:
        taken = Counter(sitting.partition for sitting in others)
        numbers = range(1, test.partitions + 1)
        fewest = min(taken[number] for number in numbers)
        partition = int(random.choice([number for number in numbers if taken[number] == fewest]))
    name = " ".join(participant.split())
    sitting = Sitting(name, partition, shown_to(test, name, partition))
    path = _file(test, name)
    path.parent.mkdir(exist_ok=True)
    _append(path, {"test": test.fingerprint, "participant": name, "partition": partition})
    return sitting


def choose(test: PreferenceTest, sitting: Sitting, place: int, side: str, time: str) -> Sitting:
    """The sitting with the choice of a side at a place of its order, which is on the disk when this returns.

    time: when, as it is written. Raises InputError where the answers cannot be kept.
    """
    shown = sitting.shown[place]
    item, method = test.items[shown.item], shown.method(side)
    line = {
        "item": shown.item,
        "speaker": item.speaker,
        "phone": item.phone,
        "left": shown.left,
        "chosen": method,
        "time": time,
    }
    _append(_file(test, sitting.participant), line)
    return replace(sitting, chosen={**sitting.chosen, place: method})


def _file(test: PreferenceTest, participant: str) -> Path:
    """A name that every file system takes; the digest keeps apart what looks alike in plain letters."""
    name = same_name(participant)
    plain = re.sub(r"[^a-z0-9]+", "-", name)[:30].strip("-") or "participant"
    return test.folder / ANSWERS / f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}.jsonl"


def _append(path: Path, line: Mapping[str, Any]) -> None:
    """Adds a line; it begins a new one even if the last one was cut off."""
    try:
        with open(path, "a+b") as stream:
            if stream.tell() > MAX_FILE_BYTES:
                raise InputError(f"{path}: there are more choices than anybody makes; look into this file.")
            torn = False
            if stream.tell():
                stream.seek(-1, os.SEEK_END)
                torn = stream.read(1) != b"\n"
            stream.write(b"\n" * torn + json.dumps(line, ensure_ascii=False).encode() + b"\n")
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as reason:
        raise InputError(f"{path}: the answer cannot be kept ({reason.strerror or reason}).") from reason


def _read(test: PreferenceTest, path: Path) -> Sitting | None:
    """None where not even the participant's name was written to the end."""
    if path.stat().st_size > 2 * MAX_FILE_BYTES:
        raise InputError(
            f"{path}: {path.stat().st_size} bytes are too many for the answers of one participant."
        )
    sitting: Sitting | None = None
    places: dict[int, int] = {}  # item -> place in this participant's order
    chosen: dict[int, str] = {}
    damaged = 0
    for line in path.read_bytes().split(b"\n"):
        if not line.strip():
            continue
        row = _row(line)
        if row is None or ("item" in row and (sitting is None or row["item"] not in places)):
            damaged += 1
        elif "item" in row:
            chosen[places[row["item"]]] = row["chosen"]
        elif row["test"] != test.fingerprint:
            raise InputError(
                f"{path}: these answers belong to another test than {test.folder}; move them away."
            )
        elif sitting is None:
            try:
                shown = shown_to(test, row["participant"], row["partition"])
            except InputError as reason:
                raise InputError(f"{path}: {reason}") from reason
            sitting = Sitting(row["participant"], row["partition"], shown)
            places = {seen.item: place for place, seen in enumerate(shown)}
    return None if sitting is None else replace(sitting, chosen=chosen, damaged=damaged)


def _row(line: bytes) -> dict[str, Any] | None:
    """A line of either kind, its values of the right types; None for anything else."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict):
        return None
    if "item" in row:
        whole = type(row["item"]) is int and row.get("chosen") in METHODS
    else:
        whole = (
            isinstance(row.get("test"), str)
            and isinstance(row.get("participant"), str)
            and type(row.get("partition")) is int
        )
    return row if whole else None
