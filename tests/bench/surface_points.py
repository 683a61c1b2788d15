"""How near surface points come to surfaces that are known: the paper's voxels against the crossings of the values.

    python tests/bench/surface_points.py [--noise GREY] [--contrast C ...] [--steps N]

Tissue of 160 in air of 20, partial volume, Rician noise, voxels of 1.1875 x 1.1875 x 1.2 mm: balls, an oblique plane, and
a cleft of 3 mm between two tissues, as between tongue and palate. For each contrast of the diffusion, both kinds of
points: mean distance and bias (outwards positive), mm; mean angle of the normals, degrees; how many points.
"""

import argparse
from collections.abc import Callable

import numpy as np

from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.scan import Scan, scan_of
from tonguetrack.model.mri.surface import surface_points, voxel_surface

SHAPE, SPACING = (44, 44, 40), np.array([1.1875, 1.1875, 1.2])
CENTRE = np.array([0.3, 0.2, -0.4])
UNIT = np.array([0.3, 0.5, 0.81]) / np.linalg.norm([0.3, 0.5, 0.81])
DARK, BRIGHT, LEVEL = 20.0, 160.0, 90.0
Function = Callable[[np.ndarray], np.ndarray]


def ball(radius: float) -> tuple[Function, Function]:
    return (
        lambda p: np.linalg.norm(p - CENTRE, axis=-1) - radius,
        lambda p: (p - CENTRE) / np.linalg.norm(p - CENTRE, axis=-1, keepdims=True),
    )


SURFACES: dict[str, tuple[Function, Function]] = {
    "ball of 6 mm": ball(6.0),
    "ball of 18 mm": ball(18.0),
    "oblique plane": (lambda p: p @ UNIT - 0.37, lambda p: np.broadcast_to(UNIT, p.shape)),
    "cleft of 3 mm": (
        lambda p: 1.5 - np.abs(p @ UNIT - 0.2),
        lambda p: -np.sign(p @ UNIT - 0.2)[..., None] * UNIT,
    ),
}


def imaged(signed: Function, noise: float) -> Scan:
    matrix = np.diag([*SPACING, 1.0])
    matrix[:3, 3] = -SPACING * (np.array(SHAPE) - 1) / 2
    voxels = np.indices(SHAPE).reshape(3, -1).T
    share = np.zeros(len(voxels))
    for part in (np.indices((4, 4, 4)).reshape(3, -1).T - 1.5) / 4:
        share += signed((voxels + part) * SPACING + matrix[:3, 3]) < 0
    values = (DARK + (BRIGHT - DARK) * share / 64).reshape(SHAPE)
    random = np.random.default_rng(1)
    noisy = np.hypot(values + noise * random.normal(size=SHAPE), noise * random.normal(size=SHAPE))
    return scan_of(np.clip(noisy, 0, 255), matrix, "bench")


def row(cloud: Cloud, scan: Scan, signed: Function, direction: Function) -> str:
    voxels = scan.voxels(cloud.points)
    inner = ((voxels > 4) & (voxels < np.array(SHAPE) - 5)).all(axis=1)
    if not inner.any() or cloud.normals is None:
        return "no points"
    points = cloud.points[inner]
    away = signed(points)
    cosines = np.clip((cloud.normals[inner] * direction(points)).sum(axis=1), -1, 1)
    angle = np.degrees(np.arccos(cosines)).mean()
    return f"{np.abs(away).mean():5.2f} mm, bias {away.mean():+5.2f} mm, {angle:4.1f} degrees, {len(points)} points"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--noise", type=float, default=12.0)
    parser.add_argument("--contrast", type=float, nargs="+", default=[0.05, 0.1, 0.2, 0.4])
    parser.add_argument("--steps", type=int, default=20)
    args = parser.parse_args()
    for name, (signed, direction) in SURFACES.items():
        scan = imaged(signed, args.noise)
        smoothed = {"not denoised": scan}
        for contrast in args.contrast:
            values = denoise(scan.values, SPACING, steps=args.steps, contrast=contrast)
            smoothed[f"contrast {contrast:g}"] = scan.holding(values)
        print(f"{name}, noise {args.noise:g} of {BRIGHT - DARK:g} grey values")
        for label, smooth in smoothed.items():
            for kind, points in (("voxels", voxel_surface), ("crossings", surface_points)):
                print(f"  {label:14} {kind:10} {row(points(smooth, LEVEL), scan, signed, direction)}")


if __name__ == "__main__":
    main()
