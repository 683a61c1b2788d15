"""NRRD volumes (.nrrd, or .nhdr with the values beside it): pynrrd understands the header, the values are taken
by their stated length."""

from __future__ import annotations

import bz2
import gzip
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..mesh import FloatArray
from .reading import checked_shape, library, take_values

SUFFIXES = (".nrrd", ".nhdr")
# What one step along each axis of a space is in ours: x left, y back, z up.
SPACES = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
}
SHORT_SPACES = {"".join(word[0] for word in name.split("-")): name for name in SPACES}
TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "f4": ("float",),
    "f8": ("double",),
}
ENCODINGS = ("raw", "gzip", "gz", "bzip2", "bz2")
MAX_HEADER = 1024 * 1024
MAX_SKIP = 16 * 1024 * 1024


def read_nrrd(path: Path) -> tuple[NDArray[Any], FloatArray]:
    """Values (i, j, k) and the (4, 4) matrix from voxel to mm in x left, y back, z up.

    Raises InputError (without the file's name) for what is no volume with a stated orientation.
    """
    nrrd = library("nrrd")
    with ExitStack() as files:
        stream: BinaryIO = files.enter_context(path.open("rb"))
        start = stream.read(MAX_HEADER)
        lines, separator = _header_lines(start)
        header = nrrd.read_header(lines)
        shape = checked_shape([int(size) for size in np.atleast_1d(header.get("sizes", []))])
        dtype = _dtype(header)
        to_world = _to_world(header)
        beside = _either(header, "data file", None)
        if beside is not None:
            stream = files.enter_context(_beside(path, str(beside)).open("rb"))
        else:
            if not separator:
                raise InputError("the blank line between its header and its values is missing.")
            stream.seek(separator)
        return _values(stream, header, shape, dtype, files), to_world


def _header_lines(start: bytes) -> tuple[list[str], int]:
    """The header's lines, and where the values begin: behind the first blank line, 0 where there is none."""
    if not start.startswith(b"NRRD"):
        raise InputError("it does not begin with a NRRD header.")
    lines: list[str] = []
    at = 0
    while at < len(start):
        end = start.find(b"\n", at)
        end = len(start) if end < 0 else end
        line = start[at:end].rstrip(b"\r")
        at = end + 1
        if not line:
            return lines, at
        lines.append(line.decode("ascii", "replace"))
    if len(start) == MAX_HEADER:
        raise InputError(f"its header does not end within {MAX_HEADER} bytes.")
    return lines, 0


def _values(
    stream: BinaryIO, header: Mapping[str, Any], shape: tuple[int, int, int], dtype: np.dtype[Any], files: ExitStack
) -> NDArray[Any]:  # fmt: skip
    encoding = str(header.get("encoding", "")).lower()
    if encoding not in ENCODINGS:
        raise InputError(f"its values are encoded as '{encoding}'; known are {', '.join(ENCODINGS)}.")
    lines, skipped = int(_either(header, "line skip", 0)), int(_either(header, "byte skip", 0))
    if not 0 <= lines <= 1000 or not -1 <= skipped <= MAX_SKIP or (skipped < 0 and encoding != "raw"):
        raise InputError(f"its header says to skip {lines} lines and {skipped} bytes, which cannot be.")
    for _ in range(lines):
        stream.readline(MAX_SKIP)
    if encoding in ("gzip", "gz"):
        stream = cast(BinaryIO, files.enter_context(gzip.GzipFile(fileobj=stream)))
    elif encoding in ("bzip2", "bz2"):
        stream = cast(BinaryIO, files.enter_context(bz2.BZ2File(stream)))
    if skipped < 0:  # "the values are the end of the file"
        end = stream.seek(0, 2)
        stream.seek(max(end - int(np.prod(shape)) * dtype.itemsize, 0))
    else:
        stream.read(skipped)
    return take_values(stream, shape, dtype)


def _dtype(header: Mapping[str, Any]) -> np.dtype[Any]:
    stated = str(header.get("type", "")).lower()
    code = next((code for code, names in TYPES.items() if stated in names), None)
    if code is None:
        raise InputError(f"its values are of the type '{stated}'; expected plain numbers.")
    order = {"little": "<", "big": ">"}.get(str(header.get("endian", "")).lower())
    if order is None and code[1] != "1":
        raise InputError("its header lacks 'endian', the order of bytes.")
    return np.dtype((order or "|") + code)


def _to_world(header: Mapping[str, Any]) -> FloatArray:
    space = str(header.get("space", "")).lower()
    signs = SPACES.get(SHORT_SPACES.get(space, space))
    if signs is None:
        raise InputError(
            f"it states {f'the space {space!r}' if space else 'no space'}, so that left and front are unknown; known "
            f"are {', '.join(SPACES)}."
        )
    units = {str(unit).strip('"') for unit in np.atleast_1d(header.get("space units", ["mm"]))}
    if units != {"mm"}:
        raise InputError(f"its space is measured in {', '.join(sorted(units))}; expected mm.")
    to_world = np.eye(4)
    steps = np.asarray(header.get("space directions", np.empty(0)), dtype=np.float64)
    if steps.shape[:1] > (3,):  # axes of length 1 behind the third
        steps = steps[:3]
    if steps.shape != (3, 3):
        raise InputError("its header lacks 'space directions' for three axes.")
    to_world[:3, :3] = steps.T
    to_world[:3, 3] = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    return np.asarray(np.diag([*signs, 1.0]) @ to_world)


def _either(header: Mapping[str, Any], name: str, default: Any) -> Any:
    """A field that may be written with or without its blank."""
    return header.get(name, header.get(name.replace(" ", ""), default))


def _beside(path: Path, name: str) -> Path:
    file = path.parent / name
    if not file.is_file():
        raise InputError(f"its values should be in the one file '{name}', which is not there.")
    return file
