"""tonguetrack mri denoise, segment, cloud, slice: each step from a scan to its surface points, run alone."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...model.mri.scan import Scan

SCAN_HELP = "a volume (.nii, .nii.gz, .nrrd, .nhdr), or the folder of a DICOM series"


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the steps below `tonguetrack mri`."""
    denoise = verbs.add_parser(
        "denoise",
        help="crop a scan, quantise it to 8 bit, and take its noise out",
        description="Edge-enhancing diffusion (Weickert 1998) of the scan in 8-bit grey values.",
    )
    _add_scan(denoise, "OUT.nii.gz", "the denoised volume (.nii or .nii.gz)")
    _add_region(denoise)
    denoise.add_argument("--steps", type=int, default=20, metavar="N", help="diffusion steps (default 20)")
    denoise.add_argument(
        "--step", type=float, default=0.12, metavar="MM2", help="time of each, mm^2 (default 0.12)"
    )
    denoise.add_argument(
        "--contrast",
        type=float,
        default=0.1,
        metavar="C",
        help="gradient that is an edge, as a share of that between black and white (default 0.1)",
    )
    denoise.add_argument(
        "--sigma", type=float, default=1.0, metavar="MM", help="smoothing before gradients (default 1)"
    )
    denoise.add_argument(
        "--rho", type=float, default=1.0, metavar="MM", help="averaging of their directions (default 1)"
    )
    denoise.set_defaults(run=run_denoise)

    segment = verbs.add_parser("segment", help="tissue (1) and the rest (0) of a denoised scan")
    _add_scan(segment, "OUT.nii.gz", "the partition (.nii or .nii.gz)")
    _add_threshold(segment)
    segment.set_defaults(run=run_segment)

    cloud = verbs.add_parser("cloud", help="the tissue's surface in a denoised scan, as points with normals")
    _add_scan(cloud, "OUT.ply", "the points, mm, in the scan's world: x left, y back, z up")
    _add_threshold(cloud)
    cloud.add_argument(
        "--voxels", action="store_true", help="the paper's rule: whole voxels (default: where values cross)"
    )
    cloud.set_defaults(run=run_cloud)

    picture = verbs.add_parser("slice", help="a picture of one slice, with the surface points in it")
    _add_scan(picture, "OUT.png", "the picture")
    picture.add_argument(
        "--plane", choices=("sagittal", "coronal", "axial"), default="sagittal", help="default: sagittal"
    )
    picture.add_argument(
        "--at", type=float, metavar="MM", help="where, along the axis across it (default: the middle)"
    )
    picture.add_argument("--cloud", metavar="CLOUD.ply", help="points to draw, as 'mri cloud' writes them")
    picture.set_defaults(run=run_slice)


def run_denoise(args: argparse.Namespace) -> int:
    import time

    from ...model.mri.diffusion import denoise
    from ...model.mri.scan import write_nifti

    scan = _scan(args)
    if args.region is not None:
        scan = scan.cropped(args.region[:3], args.region[3:])
    elif args.voxels is not None:
        scan = scan.cropped_voxels(args.voxels[:3], args.voxels[3:])
    scan = scan.quantised()
    start_s = time.perf_counter()
    values = denoise(scan.values, scan.spacing_mm, args.steps, args.step, args.contrast, args.sigma, args.rho)
    taken_s = time.perf_counter() - start_s
    write_nifti(scan.holding(values), args.output)
    print(f"{args.output}: {_size(scan)}, {args.steps} steps in {taken_s:.1f} s", file=sys.stderr)
    return 0


def run_segment(args: argparse.Namespace) -> int:
    import numpy as np

    from ...model.mri.scan import write_nifti

    scan = _scan(args)
    threshold = _threshold(args, scan)
    tissue = scan.values > threshold
    write_nifti(scan.holding(tissue.astype(np.uint8)), args.output)
    print(
        f"{args.output}: {100 * tissue.mean():.1f} % of {_size(scan)} are tissue, brighter than {threshold:.4g}",
        file=sys.stderr,
    )
    return 0


def run_cloud(args: argparse.Namespace) -> int:
    from ...atomic import write_atomically
    from ...model.mri.cloudfile import cloud_bytes
    from ...model.mri.surface import surface_points, voxel_surface

    scan = _scan(args)
    threshold = _threshold(args, scan)
    found = (voxel_surface if args.voxels else surface_points)(scan, threshold)
    write_atomically(args.output, cloud_bytes(found))
    print(f"{args.output}: {len(found.points)} points at the threshold {threshold:.4g}", file=sys.stderr)
    return 0


def run_slice(args: argparse.Namespace) -> int:
    from ...atomic import write_atomically
    from ...model.mri.cloudfile import read_cloud
    from ...model.mri.slicepicture import PLANES, middle_mm, slice_png

    scan = _scan(args)
    at_mm = float(middle_mm(scan)[PLANES[args.plane][0]]) if args.at is None else args.at
    picture = slice_png(scan, args.plane, at_mm, None if args.cloud is None else read_cloud(args.cloud))
    write_atomically(args.output, picture)
    return 0


def _add_scan(parser: argparse.ArgumentParser, output: str, meaning: str) -> None:
    parser.add_argument("scan", metavar="SCAN", help=SCAN_HELP)
    parser.add_argument("-o", "--output", required=True, metavar=output, help=meaning)


def _add_region(parser: argparse.ArgumentParser) -> None:
    region = parser.add_mutually_exclusive_group()
    region.add_argument(
        "--region",
        nargs=6,
        type=float,
        metavar=("X", "Y", "Z", "X2", "Y2", "Z2"),
        help="only this box, two corners in mm: x left, y back, z up, in the scan's world",
    )
    region.add_argument(
        "--voxels",
        nargs=6,
        type=int,
        metavar=("I", "J", "K", "I2", "J2", "K2"),
        help="only these voxels, as stored: from the first three up to, but without, the others",
    )


def _add_threshold(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--threshold", type=float, metavar="VALUE", help="tissue is brighter (default: by Otsu's method)"
    )


def _scan(args: argparse.Namespace) -> Scan:
    """The scan, after a look at where the output shall go."""
    from pathlib import Path

    from ...model.mri.scan import read_scan
    from .names import keep_apart, prepare_folder

    prepare_folder(Path(args.output))
    sources = [Path(args.scan), *([Path(args.cloud)] if getattr(args, "cloud", None) else [])]
    keep_apart([Path(args.output)], sources)
    return read_scan(args.scan)


def _threshold(args: argparse.Namespace, scan: Scan) -> float:
    from ...model.mri.surface import threshold_of

    return threshold_of(scan) if args.threshold is None else float(args.threshold)


def _size(scan: Scan) -> str:
    shape, spacing = (
        " x ".join(f"{value:.4g}" for value in row) for row in (scan.values.shape, scan.spacing_mm)
    )
    return f"{shape} voxels of {spacing} mm"
