"""What all readers of volumes share: libraries that may be absent, and lengths that are checked before use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import import_module
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ... import InputError

MAX_VOXELS = 2**27  # 512 x 512 x 512; a scan of a vocal tract has half a million to twenty million


def library(module: str, extra: str = "mri") -> Any:
    """The module of an optional library. Raises InputError that names the extra where it is not installed."""
    try:
        return import_module(module)
    except ImportError as reason:
        raise InputError(
            f"'{module}' is not installed: this needs the extra '{extra}': pip install 'tonguetrack[{extra}]'."
        ) from reason


def checked_shape(sizes: Sequence[int]) -> tuple[int, int, int]:
    """The three lengths of a volume, of what a header states. Axes of length 1 behind the third are dropped.

    Raises InputError (without the file's name) where it is no volume, or one too large to be read.
    """
    shape = [int(size) for size in sizes]
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    stated = " x ".join(map(str, shape))
    if len(shape) != 3 or min(shape) < 2:
        raise InputError(f"it holds {stated or 'no'} values; expected one volume, with two voxels or more along each of "
                         "three axes.")  # fmt: skip
    if math.prod(shape) > MAX_VOXELS:
        raise InputError(f"its header promises {stated} voxels; more than {MAX_VOXELS} are not read.")
    return shape[0], shape[1], shape[2]


def take_values(stream: BinaryIO, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The volume that begins where the stream stands, its first axis the fastest, as (i, j, k).

    Never reads more than one byte beyond. Raises InputError (without the file's name) where the stream ends before.
    """
    expected = math.prod(shape) * dtype.itemsize
    content = stream.read(expected)
    if len(content) < expected:
        raise InputError(f"the file is cut short: {len(content)} of {expected} bytes of values are there.")
    stream.read(1)  # behind the last value of a packed file, its checksum is compared
    return np.frombuffer(content, dtype).reshape(shape, order="F")
