"""Reading .npz archives that may be damaged or hostile: no pickle, every length checked before it is used."""

from __future__ import annotations

import io
import math
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import InputError

MAX_MEMBERS = 64
# Deflate cannot compress better than this; a member that claims to has a forged size.
LARGEST_RATIO = 1100


def read_arrays(data: bytes, max_bytes: int) -> dict[str, NDArray[Any]]:
    """Member name -> array of plain numbers. Shape, type and size of each agree before it is allocated.

    Raises InputError (without the file's name, which the caller knows) for anything else.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            unpacked = sum(member.file_size for member in members)
            if len(members) > MAX_MEMBERS or unpacked > max_bytes:
                raise InputError(
                    f"the .npz archive would unpack to {unpacked} bytes in {len(members)} arrays, which is too much."
                )
            for member in members:
                if member.file_size > LARGEST_RATIO * max(member.compress_size, 1):
                    raise InputError(
                        f"the array '{member.filename}' claims an impossible size; the file is damaged."
                    )
            return {
                member.filename.removesuffix(".npy"): _array(archive.read(member), member.filename)
                for member in members
            }
    except InputError:
        raise
    except Exception as reason:  # zipfile, zlib and the array header raise a dozen kinds on damaged bytes
        raise InputError("the .npz archive is damaged or cut short; copy it again.") from reason


def _array(content: bytes, name: str) -> NDArray[Any]:
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = (
        np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    )
    shape, fortran, dtype = read_header(stream)
    size = math.prod(shape) * dtype.itemsize
    if dtype.kind not in "fiu" or size != len(content) - stream.tell():
        raise InputError(f"the array '{name}' is not of plain numbers of its stated size.")
    flat = np.frombuffer(content, dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy()
