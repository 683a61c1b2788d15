"""From labels to a volume as a scanner delivers it: partial volume, blur, uneven coil, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .anatomy import Head
from .tissue import SIGNALS, Pose, label_grid, mean_signal

FloatArray = NDArray[np.float64]

WHITE = 900.0  # scanner's units of a signal of 1


@dataclass(frozen=True)
class Imaging:
    """noise: standard deviation of each of the two channels, as a share of a full signal (tongue 0.62);
    blur_voxels: of the point spread; texture: relative spread of the signal within a tissue; bias: relative
    size of the coil's unevenness over the volume."""

    noise: float = 0.045
    blur_voxels: float = 0.45
    texture: float = 0.05
    bias: float = 0.25


def labels_and_signal(
    shape: tuple[int, int, int], to_head: FloatArray, head: Head, pose: Pose
) -> tuple[NDArray[np.uint8], FloatArray]:
    """Label at every voxel's centre, and the mean signal over every voxel.

    to_head: (3, 4) voxel index -> place in the head frame at reference size.
    """
    labels = label_grid(shape, to_head, head, pose)
    return labels, mean_signal(labels, to_head, head, pose, SIGNALS)


def acquired(
    signal: FloatArray,
    to_head: FloatArray,
    imaging: Imaging,
    tissue: np.random.Generator,
    coil: np.random.Generator,
) -> NDArray[np.float32]:
    """The magnitude image, whole numbers: texture (fixed to the head), blur, coil, Rician noise.

    tissue: the same random state for all scans of a speaker; coil: another for every scan.
    """
    from scipy.ndimage import gaussian_filter

    shape = signal.shape
    places = _places(shape, to_head)
    uneven = 1.0 + imaging.texture * _waves(places, tissue, count=14, shortest_mm=5.0, longest_mm=20.0)
    seen = gaussian_filter(signal * uneven, imaging.blur_voxels)
    seen *= np.exp(imaging.bias * _waves(places, coil, count=3, shortest_mm=160.0, longest_mm=320.0))
    noise = imaging.noise * coil.standard_normal((2, *shape))
    magnitude = WHITE * np.hypot(seen + noise[0], noise[1])
    return np.rint(magnitude).astype(np.float32)


def _places(shape: tuple[int, ...], to_head: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    i, j, k = (np.arange(n, dtype=np.float64) for n in shape)
    x, y, z = (
        row[0] * i[:, None, None] + row[1] * j[None, :, None] + row[2] * k[None, None, :] + row[3]
        for row in to_head
    )
    return x, y, z


def _waves(
    places: tuple[FloatArray, FloatArray, FloatArray],
    random: np.random.Generator,
    count: int,
    shortest_mm: float,
    longest_mm: float,
) -> FloatArray:
    """A smooth random field of mean 0 and standard deviation 1: plane waves in random directions."""
    total = np.zeros(places[0].shape)
    for _ in range(count):
        direction = random.normal(size=3)
        direction *= 2.0 * np.pi / (random.uniform(shortest_mm, longest_mm) * np.linalg.norm(direction))
        phase = random.uniform(0.0, 2.0 * np.pi)
        total += np.sin(
            direction[0] * places[0] + direction[1] * places[1] + direction[2] * places[2] + phase
        )
    return total * np.sqrt(2.0 / count)
