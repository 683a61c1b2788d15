"""Edge-enhancing diffusion of a volume (Weickert 1998; paper, "Extracting surface information from MRI").

    du/dt = div( D grad u ),   D = I + (g(m) - 1) v v^T

m and v are the largest eigenvalue and its eigenvector of the structure tensor K_rho * (grad u_sigma grad u_sigma^T),
u_sigma = K_sigma * u: the squared gradient across the nearest edge, and the direction across it. In the two directions
along the edge the diffusivity is 1; across, it is Weickert's g(m) = 1 - exp(-3.31488 / (m / contrast^2)^4), which is 1
in flat regions and 0 at strong edges, so that noise at an edge goes along it and the edge stays.

Everything is in mm: gradients, both Gaussians, and the diffusion itself, so that a grid with other distances along
another axis gives the same picture. Time is in mm^2; without edges, time t smooths like a Gaussian of sqrt(2 t) mm.

**Stable by construction.** With f_i and b_i the differences of u to the next and the previous voxel along axis i,
over the spacing h_i (0 at the border, where there is none), the scheme is the steepest descent of

    E(u) = 1/2 sum over voxels, mean over the 8 choices of d_i in {f_i, b_i}, of  d^T D d

0 <= D <= I, hence 0 <= E(u) <= 1/2 sum_voxels sum_i (f_i^2 + b_i^2) / 2, and no difference along axis i has a norm
above 2 / h_i: the symmetric matrix A of the scheme lies between 0 and 4 sum_i 1 / h_i^2. Explicit steps of at most
half the inverse of that sum, 1 / (2 sum_i 1 / h_i^2), therefore never increase |u|, whatever D is; a step asked for
above the limit is made in several. A has zero row and column sums: constants stay, and so does the mean. The
extrema may be exceeded a little at edges oblique to the grid, which no such stencil of 19 voxels avoids.

Kernels take float32 C-contiguous volumes; padded ones have one more voxel on each side of (i, j, k).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ... import InputError

FloatVolume = NDArray[np.float32]
Taps = tuple[tuple[FloatVolume, NDArray[np.int64]], ...]

STEPS = 20
STEP_MM2 = 0.12
CONTRAST = 0.1
SIGMA_MM = 1.0
RHO_MM = 1.0
GREY_RANGE = 255.0

FLUX_CONSTANT = 3.31488  # makes the flux g(s^2) s fall from s = contrast on
NO_EDGE = 0.5  # of contrast^2: below, g differs from 1 by less than 1e-20
TRUNCATE = 3.0  # Gaussians end at this many sigma


def largest_stable_step_mm2(spacing_mm: ArrayLike) -> float:
    """The longest explicit step that cannot increase the volume's norm, on a grid with these (3,) distances."""
    return float(0.5 / np.sum(1.0 / np.asarray(spacing_mm, dtype=np.float64) ** 2))


def steepest_edge(sigma_mm: float, rho_mm: float) -> float:
    """The largest gradient that the structure tensor can show, grey values per mm: that at a sharp, flat edge from
    black to white. Smoothing by sigma gives it the slope 255 / (sqrt(2 pi) sigma); averaging the square of that
    Gaussian slope by rho takes another factor."""
    averaged = (sigma_mm**2 / (sigma_mm**2 + 2.0 * rho_mm**2)) ** 0.25
    return GREY_RANGE / (math.sqrt(2.0 * math.pi) * sigma_mm) * averaged


def denoise(
    values: NDArray[np.generic],
    spacing_mm: ArrayLike,
    steps: int = STEPS,
    step: float = STEP_MM2,
    contrast: float = CONTRAST,
    sigma_mm: float = SIGMA_MM,
    rho_mm: float = RHO_MM,
) -> FloatVolume:
    """The volume (i, j, k) without its noise, on the same scale.

    values: on the 8-bit grey scale, 0 to 255 (`Scan.quantised`). spacing_mm: (3,) between voxels along i, j, k.
    steps: how often the edges are found anew; step: time between, mm^2, of any length.
    contrast: the gradient from which on something is an edge, as a share of `steepest_edge`, which is 77 grey values
    per mm with the usual sigma and rho. With 0.1, a step between air and tissue of half the range is five times
    above; from 0.2 on, narrow air spaces between tissues begin to close.
    sigma_mm: smoothing before gradients are taken; rho_mm: over what neighbourhood their direction is averaged; 0
    for none. Raises InputError for settings that are out of range.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    if values.ndim != 3 or spacing.shape != (3,):
        raise ValueError(
            f"expected a volume and three distances, not shapes {values.shape} and {spacing.shape}"
        )
    _check(spacing, steps, step, contrast, sigma_mm, rho_mm)
    inner = math.ceil(step / largest_stable_step_mm2(spacing) - 1e-9)
    shape = values.shape
    u = np.pad(np.ascontiguousarray(values, dtype=np.float32), 1, mode="edge")
    after = np.empty_like(u)
    within, across_edges = _taps(shape, spacing, sigma_mm), _taps(shape, spacing, rho_mm)
    smooth, scratch = np.empty(shape, np.float32), np.empty(shape, np.float32)
    tensor = np.empty((6, *shape), np.float32)
    diffusion = np.zeros((6, *u.shape), np.float32)
    mixed = np.zeros((3, *u.shape), np.float32)
    inverse = (1.0 / spacing).astype(np.float32)
    squared_contrast = (contrast * steepest_edge(sigma_mm, rho_mm)) ** 2
    for _ in range(steps):
        np.copyto(smooth, u[1:-1, 1:-1, 1:-1])
        _smooth(smooth, scratch, within)
        _outer_products(smooth, inverse, tensor)
        for component in tensor:
            _smooth(component, scratch, across_edges)
        _diffusion_tensor(tensor, squared_contrast, diffusion)
        for _ in range(inner):
            _mixed_flux(u, diffusion, inverse, mixed)
            _advance(u, diffusion, mixed, inverse, np.float32(step / inner), after)
            _repeat_edges(after)
            u, after = after, u
    return np.ascontiguousarray(u[1:-1, 1:-1, 1:-1])


def _check(
    spacing: NDArray[np.float64], steps: int, step: float, contrast: float, sigma_mm: float, rho_mm: float
) -> None:
    if not (np.isfinite(spacing).all() and (spacing > 0).all()):
        raise ValueError(f"distances between voxels of {spacing.tolist()} mm")
    if not 0 <= steps <= 10_000:
        raise InputError(f"diffusion in {steps} steps is out of range; expected 0 to 10000.")
    if not 0 < step <= 100:
        raise InputError(
            f"a diffusion step of {step} mm^2 is out of range; expected more than 0, and 100 at most."
        )
    if not 0 < contrast <= 1000:
        raise InputError(f"a contrast of {contrast} is out of range; expected more than 0, and 1000 at most.")
    if not (0 < sigma_mm <= 50 and 0 <= rho_mm <= 50):
        raise InputError(
            f"smoothing by {sigma_mm} and {rho_mm} mm is out of range; expected up to 50 mm, the first above 0."
        )


def _taps(shape: tuple[int, ...], spacing: NDArray[np.float64], sigma_mm: float) -> Taps:
    """A Gaussian along each axis: its (2 r + 1,) weights, and for places -r to n + r - 1 the voxel that stands
    there when the volume is mirrored at its borders."""
    taps = []
    for length, distance in zip(shape, spacing, strict=True):
        radius = math.ceil(TRUNCATE * sigma_mm / distance)
        places = np.arange(-radius, radius + 1) * distance
        weights = np.exp(-0.5 * (places / max(sigma_mm, 1e-9)) ** 2)
        mirrored = np.arange(-radius, length + radius) % (2 * length)
        mirrored = np.where(mirrored < length, mirrored, 2 * length - 1 - mirrored)
        taps.append(((weights / weights.sum()).astype(np.float32), mirrored.astype(np.int64)))
    return tuple(taps)


def _smooth(volume: FloatVolume, scratch: FloatVolume, taps: Taps) -> None:
    """Convolves in place with a separable kernel."""
    first, second, third = volume.shape
    _along_middle(
        volume.reshape(1, first, second * third), *taps[0], scratch.reshape(1, first, second * third)
    )
    _along_middle(scratch, *taps[1], volume)
    _along_last(volume, *taps[2])


def _repeat_edges(padded: FloatVolume) -> None:
    """Values beyond the border are those at the border: no difference, no flow across."""
    for axis in range(3):
        turned = np.moveaxis(padded, axis, 0)
        turned[0], turned[-1] = turned[1], turned[-2]


@njit(cache=True, fastmath={"contract"})
def _along_middle(
    source: FloatVolume, weights: FloatVolume, mirrored: NDArray[np.int64], out: FloatVolume
) -> None:
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            line = out[i, j]
            line[:] = 0.0
            for tap in range(weights.shape[0]):
                weight, other = weights[tap], source[i, mirrored[j + tap]]
                for k in range(line.shape[0]):
                    line[k] += weight * other[k]


@njit(cache=True, fastmath={"contract"})
def _along_last(volume: FloatVolume, weights: FloatVolume, mirrored: NDArray[np.int64]) -> None:
    length = volume.shape[2]
    longer = np.empty(mirrored.shape[0], np.float32)
    for i in range(volume.shape[0]):
        for j in range(volume.shape[1]):
            line = volume[i, j]
            for m in range(longer.shape[0]):
                longer[m] = line[mirrored[m]]
            line[:] = 0.0
            for tap in range(weights.shape[0]):
                weight, shifted = weights[tap], longer[tap : tap + length]
                for k in range(length):
                    line[k] += weight * shifted[k]


@njit(cache=True, fastmath={"contract"})
def _outer_products(u: FloatVolume, inverse: FloatVolume, tensor: FloatVolume) -> None:
    """tensor (6, i, j, k): xx, yy, zz, xy, xz, yz of the gradient by central differences, one-sided at the border
    as if the next voxel had the same value."""
    last_i, last_j, last_k = u.shape[0] - 1, u.shape[1] - 1, u.shape[2] - 1
    half = np.float32(0.5) * inverse
    gradient = np.empty((3, last_k + 1), np.float32)
    for i in range(last_i + 1):
        before_i, after_i = u[max(i - 1, 0)], u[min(i + 1, last_i)]
        for j in range(last_j + 1):
            back_i, ahead_i = before_i[j], after_i[j]
            back_j, ahead_j = u[i, max(j - 1, 0)], u[i, min(j + 1, last_j)]
            line = u[i, j]
            x, y, z = gradient[0], gradient[1], gradient[2]
            for k in range(last_k + 1):
                x[k] = (ahead_i[k] - back_i[k]) * half[0]
                y[k] = (ahead_j[k] - back_j[k]) * half[1]
            for k in range(1, last_k):
                z[k] = (line[k + 1] - line[k - 1]) * half[2]
            z[0] = (line[min(1, last_k)] - line[0]) * half[2]
            z[last_k] = (line[last_k] - line[max(last_k - 1, 0)]) * half[2]
            for k in range(last_k + 1):
                tensor[0, i, j, k] = x[k] * x[k]
                tensor[1, i, j, k] = y[k] * y[k]
                tensor[2, i, j, k] = z[k] * z[k]
                tensor[3, i, j, k] = x[k] * y[k]
                tensor[4, i, j, k] = x[k] * z[k]
                tensor[5, i, j, k] = y[k] * z[k]


@njit(cache=True)
def _diffusion_tensor(tensor: FloatVolume, squared_contrast: float, diffusion: FloatVolume) -> None:
    """D of the structure tensor (6, i, j, k), as (6, padded), both in the order xx, yy, zz, xy, xz, yz."""
    for i in range(tensor.shape[1]):
        for j in range(tensor.shape[2]):
            for k in range(tensor.shape[3]):
                xx, yy, zz = tensor[0, i, j, k], tensor[1, i, j, k], tensor[2, i, j, k]
                lost, x, y, z = 0.0, 0.0, 0.0, 0.0
                if xx + yy + zz > NO_EDGE * squared_contrast:
                    largest, x, y, z = _largest_eigenpair(
                        xx, yy, zz, tensor[3, i, j, k], tensor[4, i, j, k], tensor[5, i, j, k]
                    )
                    strength = largest / squared_contrast
                    lost = math.exp(-FLUX_CONSTANT / strength**4)
                diffusion[0, i + 1, j + 1, k + 1] = 1.0 - lost * x * x
                diffusion[1, i + 1, j + 1, k + 1] = 1.0 - lost * y * y
                diffusion[2, i + 1, j + 1, k + 1] = 1.0 - lost * z * z
                diffusion[3, i + 1, j + 1, k + 1] = -lost * x * y
                diffusion[4, i + 1, j + 1, k + 1] = -lost * x * z
                diffusion[5, i + 1, j + 1, k + 1] = -lost * y * z


@njit(cache=True)
def _largest_eigenpair(
    xx: float, yy: float, zz: float, xy: float, xz: float, yz: float
) -> tuple[float, float, float, float]:
    """The largest eigenvalue of a symmetric 3 x 3 matrix, and its unit eigenvector; a zero vector where two
    eigenvalues are largest, and no direction is singled out."""
    mean = (float(xx) + float(yy) + float(zz)) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread <= 1e-7 * mean:
        return mean, 0.0, 0.0, 0.0
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = min(max(determinant / (2.0 * spread**3), -1.0), 1.0)
    above = 2.0 * spread * math.cos(math.acos(cosine) / 3.0)
    a, b, c = a - above, b - above, c - above
    # The rows (a, xy, xz), (xy, b, yz), (xz, yz, c) are orthogonal to the eigenvector.
    best, x, y, z = 0.0, 0.0, 0.0, 0.0
    for first, second, third in (
        (xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy),
        (xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz),
        (b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz),
    ):
        squared = first * first + second * second + third * third
        if squared > best:
            best, x, y, z = squared, first, second, third
    length = math.sqrt(best)
    if length <= 1e-7 * spread * spread:
        return mean + above, 0.0, 0.0, 0.0
    return mean + above, x / length, y / length, z / length


@njit(cache=True, fastmath={"contract"})
def _mixed_flux(u: FloatVolume, diffusion: FloatVolume, inverse: FloatVolume, mixed: FloatVolume) -> None:
    """mixed (3, padded): what the central differences along the two other axes contribute to D grad u.

    Beyond the border it is the negative, so that nothing flows across.
    """
    xy, xz, yz = diffusion[3], diffusion[4], diffusion[5]
    half = np.float32(0.5) * inverse
    half_x, half_y, half_z = half[0], half[1], half[2]
    last_i, last_j, last_k = u.shape[0] - 1, u.shape[1] - 1, u.shape[2] - 1
    for i in range(1, last_i):
        for j in range(1, last_j):
            for k in range(1, last_k):
                x = (u[i + 1, j, k] - u[i - 1, j, k]) * half_x
                y = (u[i, j + 1, k] - u[i, j - 1, k]) * half_y
                z = (u[i, j, k + 1] - u[i, j, k - 1]) * half_z
                mixed[0, i, j, k] = xy[i, j, k] * y + xz[i, j, k] * z
                mixed[1, i, j, k] = xy[i, j, k] * x + yz[i, j, k] * z
                mixed[2, i, j, k] = xz[i, j, k] * x + yz[i, j, k] * y
    mixed[0, 0], mixed[0, last_i] = -mixed[0, 1], -mixed[0, last_i - 1]
    mixed[1, :, 0], mixed[1, :, last_j] = -mixed[1, :, 1], -mixed[1, :, last_j - 1]
    mixed[2, :, :, 0], mixed[2, :, :, last_k] = -mixed[2, :, :, 1], -mixed[2, :, :, last_k - 1]


@njit(cache=True, fastmath={"contract"})
def _advance(
    u: FloatVolume,
    diffusion: FloatVolume,
    mixed: FloatVolume,
    inverse: FloatVolume,
    step: np.float32,
    after: FloatVolume,
) -> None:
    """One explicit step: the flow through each of a voxel's six faces is the mean of what both sides see."""
    xx, yy, zz = diffusion[0], diffusion[1], diffusion[2]
    flux_x, flux_y, flux_z = mixed[0], mixed[1], mixed[2]
    along_x, along_y, along_z = inverse[0], inverse[1], inverse[2]
    factor = np.float32(0.5) * step
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            for k in range(1, u.shape[2] - 1):
                here = u[i, j, k]
                x = (xx[i, j, k] + xx[i + 1, j, k]) * (u[i + 1, j, k] - here)
                x -= (xx[i - 1, j, k] + xx[i, j, k]) * (here - u[i - 1, j, k])
                y = (yy[i, j, k] + yy[i, j + 1, k]) * (u[i, j + 1, k] - here)
                y -= (yy[i, j - 1, k] + yy[i, j, k]) * (here - u[i, j - 1, k])
                z = (zz[i, j, k] + zz[i, j, k + 1]) * (u[i, j, k + 1] - here)
                z -= (zz[i, j, k - 1] + zz[i, j, k]) * (here - u[i, j, k - 1])
                x = (x * along_x + flux_x[i + 1, j, k] - flux_x[i - 1, j, k]) * along_x
                y = (y * along_y + flux_y[i, j + 1, k] - flux_y[i, j - 1, k]) * along_y
                z = (z * along_z + flux_z[i, j, k + 1] - flux_z[i, j, k - 1]) * along_z
                after[i, j, k] = here + factor * (x + y + z)
