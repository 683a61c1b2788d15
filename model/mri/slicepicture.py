"""A slice of a scan as a picture, in mm, with the surface points near it: to look at what each step did."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ..cloud import Cloud
from ..mesh import FloatArray
from .reading import library
from .scan import Scan

# Plane -> the axis across it, the axis to the right and the axis upwards in the picture.
PLANES = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}
AXIS_NAMES = ("x, to the left, mm", "y, back, mm", "z, up, mm")
MOST_PIXELS = 4000  # along one axis
TICK_MM = 1.5  # how long a normal is drawn
QUANTILES = (0.01, 0.99)  # of what a magnified part shows: black and white


def middle_mm(scan: Scan) -> FloatArray:
    """(3,) the centre of the scan."""
    return scan.points([(np.array(scan.values.shape) - 1) / 2])[0]


def slice_values(
    scan: Scan, plane: str, at_mm: float
) -> tuple[FloatArray, tuple[float, float, float, float]]:
    """Values (up, right) in a plane of the world, NaN outside of the scan, and the edges left, right, low, high, mm.

    The pixels are as large as the shortest distance between voxels. Raises InputError where plane and scan do not meet.
    """
    across, right, up = PLANES[plane]
    corners = scan.points(np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(scan.values.shape) - 1))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not low[across] <= at_mm <= high[across]:
        raise InputError(
            f"{scan.name}: a {plane} slice at {at_mm:g} mm is not in this scan, which reaches from {low[across]:.1f} to "
            f"{high[across]:.1f} mm."
        )
    pixel = float(scan.spacing_mm.min())
    steps = [np.arange(low[axis], high[axis] + pixel / 2, pixel) for axis in (right, up)]
    if max(map(len, steps)) > MOST_PIXELS:
        raise InputError(f"{scan.name}: the slice is too large for a picture; crop the scan.")
    points = np.empty((len(steps[1]), len(steps[0]), 3))
    points[..., across] = at_mm
    points[..., right], points[..., up] = np.meshgrid(*steps)
    places = scan.voxels(points.reshape(-1, 3))
    inside = ((places >= -0.5) & (places <= np.array(scan.values.shape) - 0.5)).all(axis=1)
    values = np.where(inside, scan.at(points.reshape(-1, 3)), np.nan).reshape(points.shape[:2])
    half = pixel / 2
    return values, (steps[0][0] - half, steps[0][-1] + half, steps[1][0] - half, steps[1][-1] + half)


def magnified(
    values: FloatArray,
    edges: tuple[float, float, float, float],
    low: FloatArray,
    high: FloatArray,
    pixel_mm: float,
) -> NDArray[np.uint8]:
    """(down, right) the part between two corners (right, up), mm, of what `slice_values` gives.

    Pixels have about the given size; voxels are interpolated. It is as bright as it can be: a bright spot elsewhere in
    the scan shall not make it dark.
    """
    from scipy.ndimage import map_coordinates

    pixel = (edges[1] - edges[0]) / values.shape[1]
    count = np.maximum(np.round((high - low) / pixel_mm).astype(int), 1)
    right, up = (
        (
            low[axis]
            + (np.arange(count[axis]) + 0.5) / count[axis] * (high[axis] - low[axis])
            - edges[2 * axis]
        )
        / pixel
        - 0.5
        for axis in (0, 1)
    )
    grid = np.meshgrid(up[::-1], right, indexing="ij")
    pixels = map_coordinates(np.nan_to_num(values), grid, order=3, mode="nearest")
    black, white = np.quantile(pixels, QUANTILES)
    return np.clip(np.rint((pixels - black) * (255.0 / max(white - black, 1.0))), 0, 255).astype(np.uint8)


def slice_png(scan: Scan, plane: str, at_mm: float, cloud: Cloud | None = None) -> bytes:
    """The slice as a PNG picture; with a cloud, its points up to half a voxel beside the plane, and their normals."""
    figures = library("matplotlib.figure")
    across, right, up = PLANES[plane]
    values, edges = slice_values(scan, plane, at_mm)
    width, height = edges[1] - edges[0], edges[3] - edges[2]
    inches = 7.0 / max(width, height)
    figure = figures.Figure(
        figsize=(width * inches + 1.0, height * inches + 0.9), layout="constrained", dpi=130
    )
    axes = figure.add_subplot()
    axes.imshow(values, cmap="gray", origin="lower", extent=edges, interpolation="nearest")
    if cloud is not None:
        near = np.abs(cloud.points[:, across] - at_mm) <= 0.51 * scan.spacing_mm.max()
        points = cloud.points[near][:, [right, up]]
        if cloud.normals is not None:
            ends = points + TICK_MM * cloud.normals[near][:, [right, up]]
            lines = library("matplotlib.collections").LineCollection(
                np.stack([points, ends], axis=1), colors="tab:orange", linewidths=0.6
            )
            axes.add_collection(lines)
        axes.plot(*points.T, ".", color="tab:red", markersize=2.5)
    axes.set(xlim=edges[:2], ylim=edges[2:], xlabel=AXIS_NAMES[right], ylabel=AXIS_NAMES[up])
    if plane == "axial":
        axes.invert_yaxis()  # the front on top
    axes.set_aspect("equal")
    axes.set_title(f"{plane}, at {'xyz'[across]} = {at_mm:g} mm", fontsize=10)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
