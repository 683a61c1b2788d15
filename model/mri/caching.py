"""Results kept by what they were made from, so that a change redoes only what depends on it.

A step is a function from arguments to named arrays. The key of a result is a digest of the step's name and version and
of all arguments: settings by their values, arrays and files by their content, results of earlier steps by their keys.
Results are plain .npz files below WORK/cache, written whole or not at all, with a digest of their content at the end:
one that was damaged is not found, and made again. Nothing is ever taken out; delete the folder to start anew.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import InputError, __version__
from ...archive import read_arrays
from ...atomic import write_atomically
from ...parallel import Executor, Failed, Progress

Arrays = Mapping[str, NDArray[Any]]
LARGEST_BYTES = 1_000_000_000
PIECE = 1 << 20
_DIGEST_BYTES = hashlib.sha256().digest_size
KEY_LENGTH = 2 * _DIGEST_BYTES  # hexadecimal digits


@dataclass(frozen=True)
class Step:
    """function: the arguments of one result -> its arrays, of plain numbers; module level, so that it can be sent to
    another process. version: another number whenever the same arguments shall give something else."""

    name: str
    version: int
    function: Callable[..., Arrays]


@dataclass(frozen=True)
class Stored:
    """The result of an earlier step, as an argument: its arrays are read where they are used."""

    key: str


@dataclass(frozen=True)
class Source:
    """A file of the user's, or the folder of a series, as an argument; only its content counts, not its name."""

    path: Path
    digest: str


def source(path: Path) -> Source:
    """Reads all of it once. Raises InputError where it cannot be read."""
    digest = hashlib.sha256()
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    try:
        for file in files:
            if path.is_dir():
                digest.update(f"{file.relative_to(path).as_posix()}\0{file.stat().st_size}\0".encode())
            with file.open("rb") as stream:
                while piece := stream.read(PIECE):
                    digest.update(piece)
    except OSError as reason:
        raise InputError(f"{path}: cannot be read ({reason.strerror or reason}).") from reason
    return Source(path, digest.hexdigest())


def key_of(step: Step, arguments: Sequence[Any]) -> str:
    """KEY_LENGTH hexadecimal digits."""
    digest = hashlib.sha256()
    for part in _parts((step.name, step.version, __version__, tuple(arguments))):
        digest.update(part)
    return digest.hexdigest()


@dataclass(frozen=True)
class Cache:
    """folder: WORK; every process that works on it has to see it under this name."""

    folder: Path

    def path(self, key: str) -> Path:
        return self.folder / "cache" / key[:2] / f"{key}.npz"

    def holds(self, key: str) -> bool:
        """Whether the result is there, whole."""
        return self._content(key) is not None

    def load(self, key: str) -> dict[str, NDArray[Any]]:
        """Raises InputError where the result is not there, or damaged."""
        content = self._content(key)
        if content is None:
            raise InputError(f"{self.path(key)}: this result is absent or damaged; run the command again.")
        return read_arrays(content, LARGEST_BYTES)

    def store(self, key: str, arrays: Arrays) -> None:
        packed = io.BytesIO()
        np.savez(packed, **arrays)  # type: ignore[arg-type]  # numpy's stub takes the names for its own flags
        path = self.path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, _sealed(packed.getvalue()))

    def _content(self, key: str) -> bytes | None:
        try:
            return _unsealed(self.path(key).read_bytes())
        except OSError:
            return None


def run_step(
    cache: Cache,
    step: Step,
    rows: Sequence[Sequence[Any]],
    executor: Executor,
    progress: Progress | None = None,
) -> list[Stored | Failed]:
    """One result for each row of arguments, made where it is not kept already; where it failed, why.

    progress: told how many of the rows are done, and how many there are.
    """
    keys = [key_of(step, row) for row in rows]
    missing = {key: row for key, row in zip(keys, rows, strict=True) if not cache.holds(key)}
    kept = len(keys) - sum(key in missing for key in keys)

    def told(done: int, _: int) -> None:
        if progress is not None:
            progress(kept + done, len(keys))

    outcomes = executor.run(partial(_make, cache, step), list(missing.items()), told)
    failed = {
        key: outcome for key, outcome in zip(missing, outcomes, strict=True) if isinstance(outcome, Failed)
    }
    return [failed.get(key) or Stored(key) for key in keys]


def _make(cache: Cache, step: Step, item: tuple[str, Sequence[Any]]) -> None:
    key, row = item
    cache.store(key, step.function(*(_resolved(cache, argument) for argument in row)))


def _resolved(cache: Cache, argument: Any) -> Any:
    if isinstance(argument, Stored):
        return cache.load(argument.key)
    if isinstance(argument, tuple) and any(isinstance(part, Stored) for part in argument):
        return tuple(_resolved(cache, part) for part in argument)
    return argument


def _sealed(archive: bytes) -> bytes:
    """The .npz archive with the digest of its content as its comment, which is the last thing in it."""
    size = _DIGEST_BYTES.to_bytes(2, "little")
    return archive[:-2] + size + hashlib.sha256(archive).digest()


def _unsealed(content: bytes) -> bytes | None:
    """The archive without its comment; None where that is not its digest."""
    archive = content[: -_DIGEST_BYTES - 2] + b"\0\0"
    return archive if _sealed(archive) == content else None


def _parts(value: Any) -> Iterator[bytes]:
    """The value as bytes, with the kind and the length of everything in it, so that different values never agree."""
    if isinstance(value, Source):
        yield b"file " + value.digest.encode()
    elif is_dataclass(value) and not isinstance(value, type):
        yield f"{type(value).__name__} {len(fields(value))};".encode()
        for field in fields(value):
            yield f"{field.name}=".encode()
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        yield f"array {value.dtype.str} {value.shape};".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Mapping):
        yield f"map {len(value)};".encode()
        for name in sorted(value):
            yield from _parts(name)
            yield from _parts(value[name])
    elif isinstance(value, tuple | list):
        yield f"list {len(value)};".encode()
        for part in value:
            yield from _parts(part)
    elif isinstance(value, str | bytes | bool | int | float) or value is None:
        text = value if isinstance(value, bytes) else repr(value).encode()
        yield f"{type(value).__name__} {len(text)};".encode() + text
    else:
        raise TypeError(f"a {type(value).__name__} cannot be part of a key")
