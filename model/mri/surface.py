"""From a denoised scan to a cloud of surface points with normals (paper, "Extracting surface information from MRI").

Otsu's threshold parts tissue (brighter) from air and bone (darker). A surface point is sought wherever a tissue voxel
has a neighbour across one of its six faces that is none. The paper takes the voxel itself; its error is up to
half a voxel, always inwards. `surface_points` places the point where the values cross the threshold instead.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ... import InputError
from ..cloud import Cloud
from ..mesh import FloatArray
from .scan import Scan

BINS = 256
# How far what the normals follow is smoothed, in units of the largest distance between voxels. Both were chosen on
# noisy balls and oblique planes, where less follows the noise and the grid, and more rounds off what is there.
NORMAL_SIGMA = 1.0
PARTITION_SIGMA = 1.25
LEAST_GRADIENT = 1e-9


def otsu(values: ArrayLike) -> float:
    """The threshold between dark and bright for which the variance between the two classes is largest (Otsu 1979).

    Found on a histogram of 256 bins over the values' range; bright is what lies above it. Raises InputError (without
    the scan's name) where all values are the same.
    """
    flat = np.asarray(values).ravel()
    counts, edges = np.histogram(flat, BINS)
    if not edges[0] < edges[-1] or counts[0] == flat.size or flat.min() == flat.max():
        raise InputError("all voxels have the same value; tissue cannot be told from air.")
    centres = (edges[:-1] + edges[1:]) / 2.0
    dark = np.cumsum(counts)[:-1].astype(np.float64)  # voxels up to and with each bin but the last
    bright = flat.size - dark
    dark_sum = np.cumsum(counts * centres)[:-1]
    bright_sum = float((counts * centres).sum()) - dark_sum
    between = dark * bright * (dark_sum / dark - bright_sum / bright) ** 2
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-12))  # several where bins between are empty
    return float((edges[best[0] + 1] + edges[best[-1] + 1]) / 2.0)


def threshold_of(scan: Scan) -> float:
    """Otsu's threshold of a denoised scan. Raises InputError where all voxels have the same value."""
    try:
        return otsu(scan.values)
    except InputError as reason:
        raise InputError(f"{scan.name}: {reason}") from reason


def surface_points(scan: Scan, threshold: float | None = None) -> Cloud:
    """The surface of the tissue in a denoised scan, mm, with normals that point out of it.

    One point on every line between two neighbouring voxels that the surface crosses: where the values, linear in
    between, equal the threshold (by default Otsu's). About twice as many as `voxel_surface` gives. Normals follow
    the gradient of the values, smoothed by a voxel. Raises InputError where there is no surface at all.
    """
    values = scan.values
    level = threshold_of(scan) if threshold is None else threshold
    tissue = values > level
    crossings = []
    for axis in range(3):
        before, behind = _neighbours(axis)
        places = np.nonzero(tissue[before] != tissue[behind])
        low = values[before][places].astype(np.float64)
        high = values[behind][places].astype(np.float64)
        voxels = np.stack(places, axis=1).astype(np.float64)
        voxels[:, axis] += (level - low) / (high - low)
        crossings.append(voxels)
    return _cloud(np.concatenate(crossings), values, NORMAL_SIGMA, scan)


def voxel_surface(scan: Scan, threshold: float | None = None) -> Cloud:
    """The paper's surface of the tissue in a denoised scan, mm: the tissue voxels with a neighbour that is none.

    Normals point out of the tissue and come from the partition, smoothed by a little more than a voxel. Voxels at the
    border of the scan count as having more of the same beyond. Raises InputError where there is no surface at all.
    """
    tissue = scan.values > (threshold_of(scan) if threshold is None else threshold)
    surface = np.zeros_like(tissue)
    for axis in range(3):
        before, behind = _neighbours(axis)
        differ = tissue[before] != tissue[behind]
        surface[before] |= differ
        surface[behind] |= differ
    voxels = np.argwhere(surface & tissue).astype(np.float64)
    return _cloud(voxels, tissue, PARTITION_SIGMA, scan)


def _neighbours(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """All voxels with a next one along the axis, and those next ones."""
    whole = [slice(None)] * 3
    before, behind = whole.copy(), whole.copy()
    before[axis], behind[axis] = slice(None, -1), slice(1, None)
    return tuple(before), tuple(behind)


def _cloud(voxels: FloatArray, brightness: NDArray[np.generic], sigma: float, scan: Scan) -> Cloud:
    """The cloud of points at voxel indices (n, 3), with normals down the smoothed gradient of the brightness."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    volume = brightness.astype(np.float32)
    widths = sigma * scan.spacing_mm.max() / scan.spacing_mm
    gradients = []
    for axis, distance in enumerate(scan.spacing_mm):
        order = [int(axis == other) for other in range(3)]
        slope = gaussian_filter(volume, widths, order=order, mode="nearest")
        gradients.append(map_coordinates(slope, voxels.T, order=1, mode="nearest") / distance)
    gradient = np.stack(gradients, axis=1).astype(np.float64)
    steepness = np.linalg.norm(gradient, axis=1)
    clear = steepness > LEAST_GRADIENT
    if not clear.any():
        raise InputError(
            f"{scan.name}: no surface between tissue and air was found; all of the scan is one of them."
        )
    normals = -(gradient[clear] / steepness[clear, None]) @ scan.directions().T
    return Cloud(scan.points(voxels[clear]), normals)
