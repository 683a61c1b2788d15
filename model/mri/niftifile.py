"""NIfTI volumes (.nii, .nii.gz): nibabel understands the header, the values are taken by their stated length."""

from __future__ import annotations

import gzip
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..mesh import FloatArray
from .reading import checked_shape, library, take_values

SUFFIXES = (".nii", ".nii.gz")
# NIfTI counts x to the right and y to the front.
FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
MM = {"unknown": 1.0, "meter": 1000.0, "mm": 1.0, "micron": 0.001}
MAX_EXTENSIONS = 16 * 1024 * 1024  # bytes between header and values


def read_nifti(path: Path) -> tuple[NDArray[Any], FloatArray]:
    """Values (i, j, k), scaled as the header says, and the (4, 4) matrix from voxel to mm in x left, y back, z up.

    Raises InputError (without the file's name) for what is no volume with a stated orientation.
    """
    nibabel = library("nibabel")
    with ExitStack() as files:
        stream: BinaryIO = files.enter_context(path.open("rb"))
        if path.name.lower().endswith(".gz"):
            stream = cast(BinaryIO, files.enter_context(gzip.GzipFile(fileobj=stream)))
        header = _header(nibabel, stream)
        shape = checked_shape(header.get_data_shape())
        dtype = header.get_data_dtype()
        if dtype.kind not in "iuf" or dtype.itemsize > 8:
            raise InputError(f"its values are of the type '{dtype}'; expected plain numbers.")
        if int(header["sform_code"]) == 0 and int(header["qform_code"]) == 0:
            raise InputError(
                "it states no orientation (sform and qform are not set), so that left and front are unknown; "
                "convert it again from the original scan."
            )
        values = take_values(stream, shape, dtype)
    to_world = FROM_RAS @ header.get_best_affine()
    to_world[:3] *= MM.get(header.get_xyzt_units()[0], 1.0)
    slope, intercept = header.get_slope_inter()
    if slope is not None and (slope, intercept) != (1.0, 0.0):
        values = values.astype(np.float32) * np.float32(slope) + np.float32(intercept)
    return values, to_world


def nifti_bytes(values: NDArray[Any], to_world: FloatArray, compress: bool) -> bytes:
    """The volume as the content of a NIfTI file; the same volume gives the same bytes."""
    nibabel = library("nibabel")
    image = nibabel.Nifti1Image(values, FROM_RAS @ to_world)
    image.set_qform(image.affine, code="scanner")
    image.set_sform(image.affine, code="scanner")
    image.header.set_xyzt_units("mm")
    content: bytes = image.to_bytes()
    return gzip.compress(content, 6, mtime=0) if compress else content


def _header(nibabel: Any, stream: BinaryIO) -> Any:
    """The header; the stream then stands at the first value."""
    start = stream.read(540)
    length = {int.from_bytes(start[:4], order) for order in ("little", "big")}
    kind, size = (nibabel.Nifti2Header, 540) if 540 in length else (nibabel.Nifti1Header, 348)
    if not length & {348, 540} or len(start) < size:
        raise InputError("it does not begin with a NIfTI header, or is cut short.")
    header = kind(start[:size])
    offset = int(header["vox_offset"])
    if bytes(header["magic"])[:3] not in (b"n+1", b"n+2"):
        raise InputError(
            "it is only the header of a volume, with the values in a second file; save it as one .nii file."
        )
    if not size <= offset <= MAX_EXTENSIONS:
        raise InputError(f"its header places the values at byte {offset}, which cannot be.")
    stream.seek(offset)
    return header
