"""tonguetrack mri match: the tongue or the palate found in one scan, run alone."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...model.cloud import Cloud
    from ...model.mesh import FloatArray
    from ...model.mri.dataset import Landmarks
    from ...model.mri.templates import Template

CLOUD_SUFFIX = ".ply"


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the matching below `tonguetrack mri`."""
    match = verbs.add_parser(
        "match",
        help="the mesh of a tongue or a palate, bent onto the surface in a scan",
        description="Template matching. A scan is quantised, denoised and segmented first; a cloud is taken as it is.",
    )
    match.add_argument(
        "source",
        metavar="SCAN_OR_CLOUD",
        help="a volume (.nii, .nii.gz, .nrrd, .nhdr), the folder of a DICOM series, or points with normals (.ply)",
    )
    match.add_argument("--template", choices=("tongue", "palate"), required=True, help="what is sought")
    match.add_argument(
        "--landmarks",
        required=True,
        metavar="FILE.csv",
        help="where a person marked it: name, x_mm, y_mm, z_mm",
    )
    match.add_argument(
        "--start",
        metavar="MESH",
        help="the template's mesh to begin with, in the scan's world (default: the template, placed by the landmarks)",
    )
    match.add_argument("-o", "--output", required=True, metavar="OUT.ply", help="the mesh (.ply or .obj)")
    match.set_defaults(run=run_match)


def run_match(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ... import InputError
    from ...atomic import write_atomically
    from ...model.mesh import MESH_SUFFIXES, Mesh, mesh_bytes
    from ...model.mri.dataset import read_landmarks
    from ...model.mri.matching import PALATE, TONGUE, match
    from ...model.mri.templates import template_named
    from ...model.neighbours import SurfaceIndex
    from .names import keep_apart, prepare_folder

    output = Path(args.output)
    if output.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(
            f"{output}: meshes are written as {' or '.join(MESH_SUFFIXES)}; end the name in one."
        )
    prepare_folder(output)
    keep_apart([output], [Path(name) for name in (args.source, args.landmarks, args.start) if name])
    template = template_named(args.template)
    landmarks = read_landmarks(Path(args.landmarks))
    start = _start(args, template, landmarks)
    cloud = _cloud(args.source, template, landmarks)
    try:
        settings = TONGUE if args.template == "tongue" else PALATE
        found = match(start, template, SurfaceIndex(cloud), landmarks, settings)
    except InputError as reason:
        raise InputError(f"{args.source}: {reason}") from reason
    write_atomically(output, mesh_bytes(Mesh(found.vertices, template.mesh.faces), output.suffix))
    print(
        f"{args.output}: {100 * found.valid:.0f} % of the {args.template}'s vertices have a surface beside them, "
        f"{found.residual_mm:.2f} mm away on average; {found.flipped} faces are flipped",
        file=sys.stderr,
    )
    return 0


def _start(args: argparse.Namespace, template: Template, landmarks: Landmarks) -> FloatArray:
    """(n, 3) mm: the given mesh, or the template where the landmarks put it."""
    from ... import InputError
    from ...model.mesh import read_mesh
    from ...model.mri.templates import landmark_vertices, placed

    try:
        landmark_vertices(template, landmarks)
        if args.start is None:
            return placed(template, landmarks)
    except InputError as reason:
        raise InputError(f"{args.landmarks}: {reason}") from reason
    mesh = read_mesh(args.start)
    if len(mesh.vertices) != len(template.mesh.vertices):
        raise InputError(
            f"{args.start}: {len(mesh.vertices)} vertices are not those of the {template.name} template, which has "
            f"{len(template.mesh.vertices)}; a start is a mesh that 'mri match' or 'mri build' has written."
        )
    return mesh.vertices


def _cloud(source: str, template: Template, landmarks: Landmarks) -> Cloud:
    """The points of a file of them, or of the surface in a scan, for the palate with a threshold of its own."""
    if source.lower().endswith(CLOUD_SUFFIX):
        from ...model.mri.cloudfile import read_cloud

        return read_cloud(source)
    from ...model.mri.diffusion import denoise
    from ...model.mri.palates import palate_surface
    from ...model.mri.scan import read_scan
    from ...model.mri.surface import surface_points

    scan = read_scan(source).quantised()
    smooth = scan.holding(denoise(scan.values, scan.spacing_mm))
    return (
        palate_surface(smooth, landmarks, template) if template.name == "palate" else surface_points(smooth)
    )
