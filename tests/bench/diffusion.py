"""What denoising a scan costs: 100 x 100 x 44 voxels, 20 steps, on one core.

    python tests/bench/diffusion.py [--shape 100 100 44] [--steps 20] [--turns 3]

Beside it, in turns and in the same run, the same scheme in plain numpy (`numpy.linalg.eigh` for the edges,
`scipy.ndimage` for the Gaussians), whose result is compared, too.
"""

import argparse
import time

import numpy as np
from scipy.ndimage import gaussian_filter

from tonguetrack.model.mri.diffusion import (
    FLUX_CONSTANT,
    TRUNCATE,
    denoise,
    largest_stable_step_mm2,
    steepest_edge,
)

SPACING = np.array([1.1875, 1.1875, 1.2])
STEP, CONTRAST, SIGMA_MM, RHO_MM = 0.12, 0.1, 1.0, 1.0


def some_scan(shape: tuple[int, int, int]) -> np.ndarray:
    """Two lobes of tissue with a cleft between them, partial volume, Rician noise, 8 bit."""
    random = np.random.default_rng(1)
    axes = [(np.arange(n) - (n - 1) / 2) * h for n, h in zip(shape, SPACING, strict=True)]
    where = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    lobes = [np.linalg.norm((where - [0, side, 0]) / [1.2, 0.9, 0.7], axis=-1) - 24 for side in (-24, 26)]
    tissue = 20 + 160 / (1 + np.exp(np.minimum(*lobes) / 0.4))
    noisy = np.hypot(tissue + random.normal(scale=12, size=shape), random.normal(scale=12, size=shape))
    return np.clip(noisy, 0, 255).astype(np.uint8)


def plain(values: np.ndarray, steps: int) -> np.ndarray:
    """The module's docstring, in whole arrays."""
    u = values.astype(np.float32)
    squared_contrast = (CONTRAST * steepest_edge(SIGMA_MM, RHO_MM)) ** 2
    for _ in range(steps):
        smooth = gaussian_filter(
            u, SIGMA_MM / SPACING, radius=[int(np.ceil(TRUNCATE * SIGMA_MM / h)) for h in SPACING]
        )
        padded = np.pad(smooth, 1, mode="edge")
        gradient = np.stack(
            [(after - before) / (2 * h) for (before, after), h in zip(sides(padded), SPACING, strict=True)]
        )
        tensor = np.empty((*u.shape, 3, 3), np.float32)
        for a in range(3):
            for b in range(a, 3):
                radius = [int(np.ceil(TRUNCATE * RHO_MM / h)) for h in SPACING]
                tensor[..., a, b] = gaussian_filter(
                    gradient[a] * gradient[b], RHO_MM / SPACING, radius=radius
                )
                tensor[..., b, a] = tensor[..., a, b]
        strengths, vectors = np.linalg.eigh(tensor)
        strength, v = np.maximum(strengths[..., 2], 1e-9) / squared_contrast, vectors[..., 2]
        lost = np.exp(-FLUX_CONSTANT / strength**4)
        diffusion = np.eye(3, dtype=np.float32) - lost[..., None, None] * v[..., :, None] * v[..., None, :]
        u = u + STEP * divergence(u, diffusion)
    return u


def sides(padded: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each axis, every voxel's previous and next one."""
    inner = [slice(1, -1)] * 3
    pairs = []
    for axis in range(3):
        before, after = inner.copy(), inner.copy()
        before[axis], after[axis] = slice(None, -2), slice(2, None)
        pairs.append((padded[tuple(before)], padded[tuple(after)]))
    return pairs


def divergence(u: np.ndarray, diffusion: np.ndarray) -> np.ndarray:
    central = [
        (after - before) / (2 * h)
        for (before, after), h in zip(sides(np.pad(u, 1, mode="edge")), SPACING, strict=True)
    ]
    total = np.zeros_like(u)
    for axis, h in enumerate(SPACING):
        mixed = sum(diffusion[..., axis, other] * central[other] for other in range(3) if other != axis)
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        low, high = tuple(low), tuple(high)
        along = diffusion[..., axis, axis]
        flow = (along[low] + along[high]) / 2 * (u[high] - u[low]) / h + (mixed[low] + mixed[high]) / 2
        total[low] += flow / h
        total[high] -= flow / h
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shape", nargs=3, type=int, default=(100, 100, 44))
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--turns", type=int, default=3)
    args = parser.parse_args()
    assert largest_stable_step_mm2(SPACING) > STEP
    values = some_scan(tuple(args.shape))
    start = time.perf_counter()
    denoise(values[:8, :8, :8], SPACING, steps=1)
    print(f"compiling or loading: {time.perf_counter() - start:.1f} s")
    kinds = {
        "ours": lambda: denoise(values, SPACING, steps=args.steps),
        "numpy": lambda: plain(values, args.steps),
    }
    results, walls, cores = {}, {name: [] for name in kinds}, {name: [] for name in kinds}
    for _ in range(args.turns):
        for name, work in kinds.items():
            wall, core = time.perf_counter(), time.process_time()
            results[name] = work()
            walls[name].append(time.perf_counter() - wall)
            cores[name].append(time.process_time() - core)
    shape = " x ".join(map(str, args.shape))
    print(f"{shape} voxels, {args.steps} steps, best of {args.turns}:")
    for name in kinds:
        print(f"  {name:6} {min(walls[name]):7.2f} s, {min(cores[name]):7.2f} s of processor time")
    print(f"  ratio  {min(cores['numpy']) / min(cores['ours']):7.1f}")
    apart = np.abs(results["ours"] - results["numpy"])
    print(f"  apart: mean {apart.mean():.2g}, largest {apart.max():.2g} grey values")


if __name__ == "__main__":
    main()
