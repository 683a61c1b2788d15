"""MATLAB 5 files as far as recordings need them: numbers, text, cells and structures.

Own reader of a small part of a published format rather than scipy's, because every length in the file is
checked here before it is believed; the tests hold the two against each other.
"""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np

from ... import InputError

HEADER_BYTES = 128
DEEPEST = 16
SMALLEST_LIMIT, LARGEST_RATIO = 1 << 26, 50

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR, _NUMERIC = 1, 2, 4, range(6, 16)

Value = Any
"""numpy array of numbers, str, list (cell, in column order), list of dicts (structure array), or None."""


def is_mat5(head: bytes) -> bool:
    return head[:7] == b"MATLAB " and head[126:128] in (b"IM", b"MI") and len(head) >= HEADER_BYTES


def read_variables(data: bytes, name: str) -> dict[str, Value]:
    """Variable name -> value. Kinds of array that recordings do not use are None.

    Raises InputError where a length in the file does not fit what encloses it.
    """
    if len(data) < HEADER_BYTES:
        raise InputError(f"{name}: {len(data)} bytes are less than the header of a MATLAB file (128).")
    reader = _Reader("<" if data[126:128] == b"IM" else ">", name)
    variables: dict[str, Value] = {}
    view = memoryview(data)[HEADER_BYTES:]
    while len(view) >= 8:
        kind, body, view = reader.element(view)
        if kind == _COMPRESSED:
            kind, body, _ = reader.element(memoryview(reader.inflate(body)))
        if kind == _MATRIX:
            variable, value = reader.matrix(body, 0)
            variables[variable] = value
    return variables


class _Reader:
    """The byte order and the file's name, which every step needs."""

    def __init__(self, order: str, name: str) -> None:
        self.order = order
        self.name = name

    def damaged(self, what: str) -> InputError:
        return InputError(f"{self.name}: the MATLAB file is damaged or cut short ({what}); copy it again.")

    def inflate(self, body: memoryview) -> bytes:
        limit = max(SMALLEST_LIMIT, LARGEST_RATIO * len(body))
        try:
            unpacker = zlib.decompressobj()
            content = unpacker.decompress(body, limit)
        except zlib.error as error:
            raise self.damaged("a compressed variable does not unpack") from error
        if unpacker.unconsumed_tail:
            raise self.damaged(f"a variable unpacks to more than {limit} bytes")
        return content

    def element(self, view: memoryview) -> tuple[int, memoryview, memoryview]:
        """(type, data, what follows) of the element at the start of `view`."""
        if len(view) < 8:
            raise self.damaged("an element is missing")
        first, size = (int(n) for n in np.frombuffer(view, self.order + "u4", 2))
        if first >> 16:
            kind, size, start, step = first & 0xFFFF, first >> 16, 4, 8
            if size > 4:
                raise self.damaged("a short element claims more than 4 bytes")
        else:
            kind, start = first, 8
            step = 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if start + size > len(view):
            raise self.damaged(f"an element claims {size} bytes, {len(view) - start} are left")
        return kind, view[start : start + size], view[min(step, len(view)) :]

    def numbers(self, kind: int, body: memoryview) -> np.ndarray[Any, Any]:
        code = _NUMBERS.get(kind)
        if code is None or len(body) % int(code[1]):
            raise self.damaged("numbers of an unknown type")
        return np.frombuffer(body, self.order + code)

    def matrix(self, body: memoryview, depth: int) -> tuple[str, Value]:
        """(name, value) of an array element."""
        if len(body) == 0:
            return "", np.empty((0, 0))
        if depth > DEEPEST:
            raise self.damaged("arrays are nested too deeply")
        kind, flags, rest = self.element(body)
        flag_words = self.numbers(kind, flags)
        kind, dims, rest = self.element(rest)
        shape = [int(n) for n in self.numbers(kind, dims)]
        _, label, rest = self.element(rest)
        if len(flag_words) < 1 or not 2 <= len(shape) <= 8 or min(shape) < 0:
            raise self.damaged("an array has no proper dimensions")
        variable, array_class, count = (
            bytes(label).decode("latin-1"),
            int(flag_words[0]) & 0xFF,
            math.prod(shape),
        )
        if array_class in _NUMERIC:
            kind, real, _ = self.element(rest)
            values = self.numbers(kind, real)
            if len(values) != count:
                raise self.damaged(f"{len(values)} numbers for dimensions {shape}")
            return variable, values.reshape(shape, order="F")
        if array_class == _CHAR:
            kind, text, _ = self.element(rest)
            encoding = _TEXTS.get(kind, "latin-1")
            if encoding == "utf-16":
                encoding = "utf-16-le" if self.order == "<" else "utf-16-be"
            return variable, bytes(text).decode(encoding, "replace")
        if array_class == _CELL:
            return variable, self.members(rest, count, depth)
        if array_class == _STRUCT:
            kind, width_bytes, rest = self.element(rest)
            _, names, rest = self.element(rest)
            width = int(self.numbers(kind, width_bytes)[:1].sum())
            if width < 1:
                raise self.damaged("field names have no length")
            fields = [
                bytes(names[k : k + width]).split(b"\0")[0].decode("latin-1")
                for k in range(0, len(names), width)
            ]
            values_flat = self.members(rest, count * len(fields), depth)
            rows = range(0, len(values_flat), max(len(fields), 1))
            return variable, [dict(zip(fields, values_flat[k:], strict=False)) for k in rows]
        return variable, None

    def members(self, rest: memoryview, count: int, depth: int) -> list[Value]:
        """The `count` arrays that follow one another in a cell or structure."""
        if count * 8 > len(rest):
            raise self.damaged(f"{count} members in {len(rest)} bytes")
        values = []
        for _ in range(count):
            kind, body, rest = self.element(rest)
            if kind != _MATRIX:
                raise self.damaged("a member is not an array")
            values.append(self.matrix(body, depth + 1)[1])
        return values
