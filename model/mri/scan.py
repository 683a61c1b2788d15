"""An MRI scan: values on a grid, and where the grid lies. Reading, cropping, quantising, sampling, writing.

The world is the patient's, as DICOM has it: x to the left, y back, z up, mm. Readers bring every format there; the
grid itself stays as it was stored, in whatever order and direction its axes run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ... import InputError
from ...atomic import write_atomically
from ..mesh import FloatArray
from . import niftifile, nrrdfile
from .dicomseries import read_dicom_series

QUANTILES = (0.001, 0.999)  # of the values: black and white of the 8-bit picture
SHEAR = 1e-3  # largest cosine between two axes of a grid
PLAUSIBLE_MM = (0.02, 50.0)  # between voxels


@dataclass(frozen=True)
class Scan:
    """values: (i, j, k) float32 or uint8. spacing_mm: (3,) distance between voxels along i, j, k.
    to_world: (4, 4) from voxel index (centres are whole numbers) to mm, x left, y back, z up; its axes are
    orthogonal, so that it turns, mirrors and scales. name: what to call the scan in sentences."""

    values: NDArray[np.float32] | NDArray[np.uint8]
    spacing_mm: FloatArray
    to_world: FloatArray
    name: str

    def points(self, voxels: ArrayLike) -> FloatArray:
        """(n, 3) mm of voxel indices (n, 3), which need not be whole."""
        return np.asarray(voxels, dtype=np.float64) @ self.to_world[:3, :3].T + self.to_world[:3, 3]

    def voxels(self, points: ArrayLike) -> FloatArray:
        """(n, 3) voxel indices, not whole, of points (n, 3) mm."""
        shifted = np.asarray(points, dtype=np.float64) - self.to_world[:3, 3]
        return np.asarray(shifted @ np.linalg.inv(self.to_world[:3, :3]).T)

    def directions(self) -> FloatArray:
        """(3, 3) the unit vectors of i, j, k in the world, as columns."""
        return self.to_world[:3, :3] / self.spacing_mm

    def at(self, points: ArrayLike) -> FloatArray:
        """(n,) values at points (n, 3) mm, trilinear; outside of the grid, the value at its nearest edge."""
        from scipy.ndimage import map_coordinates

        sampled = map_coordinates(
            self.values, self.voxels(points).T, order=1, mode="nearest", output=np.float64
        )
        return np.asarray(sampled)

    def cropped(self, low_mm: ArrayLike, high_mm: ArrayLike) -> Scan:
        """The part of the grid that holds all voxels with centres in the box, whose edges follow the world's axes.

        low_mm, high_mm: (3,) opposite corners. On an oblique grid, some voxels outside of the box remain. Raises
        InputError where the box is none, or has hardly a voxel in common with the scan.
        """
        low, high = _corners(low_mm, high_mm, self.name)
        picks = np.indices((2, 2, 2)).reshape(3, -1).T
        corners = self.voxels(np.where(picks, high, low))
        slack = 1e-6  # a centre on the edge is inside
        first = np.ceil(corners.min(axis=0) - slack)
        behind = np.floor(corners.max(axis=0) + slack) + 1
        size = np.array(self.values.shape)
        return self.cropped_voxels(np.clip(first, 0, size), np.clip(behind, 0, size))

    def cropped_voxels(self, first: ArrayLike, behind: ArrayLike) -> Scan:
        """The voxels from `first` (3,) up to but without `behind` (3,), along i, j, k.

        Raises InputError where that is not inside of the scan, or less than two voxels wide.
        """
        low, high = _corners(first, behind, self.name)
        if (low < 0).any() or (high > self.values.shape).any() or (high - low < 2).any():
            raise InputError(
                f"{self.name}: the region of interest, voxels {low.tolist()} to {high.tolist()}, is not inside of the "
                f"scan's {' x '.join(map(str, self.values.shape))} voxels, or less than two voxels wide."
            )
        start, end = low.astype(int), high.astype(int)
        part: NDArray[Any] = self.values[tuple(slice(a, b) for a, b in zip(start, end, strict=True))]
        moved = self.to_world.copy()
        moved[:3, 3] = self.points(start[None])[0]
        return Scan(np.ascontiguousarray(part), self.spacing_mm, moved, self.name)

    def quantised(self) -> Scan:
        """The same with 8-bit values: 0 up to the 0.1 % quantile, 255 from the 99.9 % quantile, linear between.

        The quantiles, not the extremes, for a few bright voxels (fat, vessels, ghosts) would darken all others.
        Raises InputError where all values are the same.
        """
        black, white = np.quantile(self.values, QUANTILES)
        if not black < white:
            black, white = self.values.min(), self.values.max()
        if not black < white:
            raise InputError(
                f"{self.name}: all voxels have the same value; there is nothing to see in this scan."
            )
        scaled = np.clip((self.values - np.float32(black)) * np.float32(255.0 / (white - black)), 0.0, 255.0)
        return self.holding(np.rint(scaled).astype(np.uint8))

    def holding(self, values: NDArray[np.float32] | NDArray[np.uint8]) -> Scan:
        """Other values on the same grid."""
        if values.shape != self.values.shape:
            raise ValueError(f"{values.shape} values on a grid of {self.values.shape}")
        return Scan(values, self.spacing_mm, self.to_world, self.name)


def scan_of(values: NDArray[np.generic], to_world: FloatArray, name: str) -> Scan:
    """A scan of values (i, j, k) of any plain type. uint8 stays, all else becomes float32.

    Raises InputError for values that are no finite numbers, and for a grid that is sheared or not in mm.
    """
    kept = values if values.dtype == np.uint8 else values.astype(np.float32)
    bad = np.count_nonzero(~np.isfinite(kept))
    if bad:
        raise InputError(f"{name}: {bad} voxels are no finite numbers; expected a value in each.")
    if to_world.shape != (4, 4) or not np.isfinite(to_world).all():
        raise InputError(f"{name}: the place and direction of its axes are no numbers.")
    spacing = np.linalg.norm(to_world[:3, :3], axis=0)
    if (spacing < PLAUSIBLE_MM[0]).any() or (spacing > PLAUSIBLE_MM[1]).any():
        raise InputError(
            f"{name}: its voxels would be {' x '.join(f'{size:.3g}' for size in spacing)} mm large; expected "
            f"{PLAUSIBLE_MM[0]} to {PLAUSIBLE_MM[1]} mm."
        )
    cosines = (to_world[:3, :3] / spacing).T @ (to_world[:3, :3] / spacing) - np.eye(3)
    if np.abs(cosines).max() > SHEAR:
        raise InputError(
            f"{name}: the axes of its grid are not at right angles; resample it to a straight grid."
        )
    return Scan(np.ascontiguousarray(kept), spacing, to_world, name)


def read_scan(path: str | Path) -> Scan:
    """Reads NIfTI (.nii, .nii.gz), NRRD (.nrrd, .nhdr), or the folder of a DICOM series.

    Raises InputError, in one sentence, for what is missing, damaged, too large, or no volume with an orientation.
    """
    path = Path(path)
    name = path.name.lower()
    if not path.exists():
        raise InputError(f"{path}: there is no such scan.")
    reader: Callable[[Path], tuple[NDArray[Any], FloatArray]]
    if path.is_dir():
        reader = read_dicom_series
    elif name.endswith(niftifile.SUFFIXES):
        reader = niftifile.read_nifti
    elif name.endswith(nrrdfile.SUFFIXES):
        reader = nrrdfile.read_nrrd
    else:
        raise InputError(
            f"{path}: a scan is a file ending in {', '.join((*niftifile.SUFFIXES, *nrrdfile.SUFFIXES))}, or the folder "
            "of a DICOM series."
        )
    try:
        values, to_world = reader(path)
    except InputError as reason:
        raise InputError(f"{path}: {reason}") from reason
    except Exception as reason:  # whatever a damaged file makes the libraries stumble over
        said = " ".join(str(reason).split())[:160]
        raise InputError(
            f"{path}: this is not a readable scan ({type(reason).__name__}: {said})."
        ) from reason
    return scan_of(values, to_world, str(path))


def write_nifti(scan: Scan, path: str | Path) -> None:
    """Writes .nii or .nii.gz; the file appears whole or not at all, and `read_scan` gives the same scan back.

    Raises InputError for another ending, or a place that cannot be written.
    """
    path = Path(path)
    if not path.name.lower().endswith(niftifile.SUFFIXES):
        raise InputError(
            f"{path}: scans are written as {' or '.join(niftifile.SUFFIXES)}; end the name in one."
        )
    compress = path.name.lower().endswith(".gz")
    write_atomically(path, niftifile.nifti_bytes(scan.values, scan.to_world, compress))


def _corners(low: ArrayLike, high: ArrayLike, name: str) -> tuple[FloatArray, FloatArray]:
    corners = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if any(corner.shape != (3,) or not np.isfinite(corner).all() for corner in corners):
        raise InputError(f"{name}: the region of interest should be two corners with three numbers each.")
    return corners
