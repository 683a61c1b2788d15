"""A DICOM series: a folder with one file a slice. Its coordinates are ours: x left, y back, z up, mm."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..mesh import FloatArray
from .reading import checked_shape, library

MAX_FILES = 4096
MAX_FILE_BYTES = 64 * 1024 * 1024
DEFLATED = "1.2.840.10008.1.2.1.99"
SAME_DIRECTION = 1e-4  # of a unit vector
EVEN_GAP = 0.02  # of the distance between slices


@dataclass(frozen=True)
class _Slice:
    """place: (3,) mm of the first pixel; directions: (6,) along a row, along a column; spacing_mm: (2,) between
    rows, between columns; data: everything else, as pydicom has it."""

    file: str
    place: FloatArray
    directions: FloatArray
    spacing_mm: FloatArray
    data: Any

    @property
    def size(self) -> tuple[int, int]:
        """Columns, rows."""
        return int(self.data.Columns), int(self.data.Rows)


def read_dicom_series(folder: Path) -> tuple[NDArray[Any], FloatArray]:
    """Values (columns, rows, slices), rescaled as the files say, and the (4, 4) matrix from voxel to mm.

    Files of the folder that are not DICOM are passed over. Raises InputError (with the name of a file where one is
    to blame) for more than one series, missing or double slices, and what else is no volume.
    """
    pydicom = library("pydicom")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pydicom, on spellings of the standard
        slices = [_slice(pydicom, file) for file in _dicom_files(folder)]
        if not slices:
            raise InputError("the folder holds no DICOM files; expected one for every slice of a series.")
        _check_one_series(slices)
        return _volume(slices)


def _dicom_files(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.iterdir() if file.is_file())
    if len(files) > MAX_FILES:
        raise InputError(f"the folder holds {len(files)} files, which are too many for one series.")
    found = []
    for file in files:
        with file.open("rb") as stream:
            if stream.read(132)[128:] == b"DICM" and file.name.upper() != "DICOMDIR":
                found.append(file)
    return found


def _slice(pydicom: Any, file: Path) -> _Slice:
    if file.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{file.name} has {file.stat().st_size} bytes, which are too many for one slice.")
    try:
        if pydicom.filereader.read_file_meta_info(file).get("TransferSyntaxUID") == DEFLATED:
            raise InputError(f"{file.name} is deflated; export the series without compression.")
        data = pydicom.dcmread(file)
        found = _Slice(
            file.name,
            _numbers(data, "ImagePositionPatient", 3),
            _numbers(data, "ImageOrientationPatient", 6),
            _numbers(data, "PixelSpacing", 2),
            data,
        )
        columns, rows = found.size
        frames, colours = int(data.get("NumberOfFrames") or 1), int(data.get("SamplesPerPixel", 1))
    except InputError:
        raise
    except Exception as reason:  # pydicom raises whatever a damaged file makes it stumble over
        said = " ".join(str(reason).split())[:160]
        raise InputError(
            f"{file.name} is no readable slice of a volume ({type(reason).__name__}: {said})."
        ) from reason
    if (frames, colours) != (1, 1):
        raise InputError(
            f"{file.name} holds several frames or colours; export the series with one grey slice a file, or convert "
            "it to NIfTI."
        )
    if min(found.spacing_mm) <= 0:
        raise InputError(f"{file.name} states pixels of {found.spacing_mm[0]} x {found.spacing_mm[1]} mm.")
    checked_shape((columns, rows, 2))
    return found


def _numbers(found: Any, name: str, count: int) -> FloatArray:
    values = np.array([float(value) for value in found[name].value])
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{name} is not {count} numbers")
    return values


def _check_one_series(slices: Sequence[_Slice]) -> None:
    kinds: dict[str, str] = {}
    for found in slices:
        series = str(found.data.get("SeriesInstanceUID", ""))
        kinds.setdefault(series, str(found.data.get("SeriesDescription", "")))
    if len(kinds) > 1:
        names = ", ".join(repr(name) for name in list(kinds.values())[:5])
        raise InputError(f"the folder mixes {len(kinds)} series ({names}); give each a folder of its own.")
    first = slices[0]
    for found in slices[1:]:
        if (
            found.size != first.size
            or np.abs(found.directions - first.directions).max() > SAME_DIRECTION
            or not np.allclose(found.spacing_mm, first.spacing_mm, rtol=1e-3)
        ):
            raise InputError(f"{found.file} has another size, direction or pixel spacing than {first.file}.")


def _volume(slices: Sequence[_Slice]) -> tuple[NDArray[Any], FloatArray]:
    along_row, along_column = slices[0].directions[:3], slices[0].directions[3:]
    between_rows, between_columns = slices[0].spacing_mm
    normal = np.cross(along_row, along_column)
    slices = sorted(slices, key=lambda found: float(found.place @ normal))
    shape = checked_shape((*slices[0].size, len(slices)))
    places = np.array([found.place for found in slices])
    heights = places @ normal
    gaps = np.diff(heights)
    usual = float(np.median(gaps))
    pixel = min(between_rows, between_columns)
    for before, gap, after in zip(slices[:-1], gaps, slices[1:], strict=True):
        if gap < EVEN_GAP * pixel:
            raise InputError(
                f"{before.file} and {after.file} are slices at the same place; expected every slice once."
            )
        if abs(gap - usual) > EVEN_GAP * usual:
            raise InputError(
                f"between {before.file} and {after.file} lie {gap:.2f} mm, elsewhere {usual:.2f} mm; slices are missing, "
                "or not evenly spaced."
            )
    aside = places - places[0] - np.outer(heights - heights[0], normal)
    if np.abs(aside).max() > EVEN_GAP * pixel:
        raise InputError(
            "its slices are shifted against each other (a tilted gantry); expected a straight stack."
        )
    to_world = np.eye(4)
    to_world[:3, 0] = along_row * between_columns
    to_world[:3, 1] = along_column * between_rows
    to_world[:3, 2] = (places[-1] - places[0]) / (len(slices) - 1)
    to_world[:3, 3] = places[0]
    values = np.empty(shape, dtype=np.float32)
    for index, found in enumerate(slices):
        values[:, :, index] = _pixels(found)
    return values, to_world


def _pixels(found: _Slice) -> NDArray[np.float32]:
    """(columns, rows), rescaled."""
    try:
        pixels = found.data.pixel_array
        slope = float(found.data.get("RescaleSlope", 1.0))
        intercept = float(found.data.get("RescaleIntercept", 0.0))
    except Exception as reason:  # decoders raise whatever damaged or foreign pixels make them stumble over
        said = " ".join(str(reason).split())[:160]
        raise InputError(
            f"the pixels of {found.file} cannot be read ({type(reason).__name__}: {said})."
        ) from reason
    columns, rows = found.size
    if pixels.shape != (rows, columns):
        raise InputError(f"{found.file} holds {pixels.shape} pixels, but its header says {rows} x {columns}.")
    return np.asarray(pixels.T, dtype=np.float32) * np.float32(slope) + np.float32(intercept)
