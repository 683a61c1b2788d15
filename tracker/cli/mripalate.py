"""tonguetrack mri align, restore: the hard palate brought to another scan, and put into its cloud, run alone."""

from __future__ import annotations

import argparse
import sys

from .scansteps import SCAN_HELP

PALATE_HELP = (
    "the palate's mesh (.ply or .obj), faces down into the mouth, as 'mri match --template palate' writes it"
)


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register both below `tonguetrack mri`."""
    align = verbs.add_parser(
        "align",
        help="a palate brought from one scan of a speaker to another one",
        description="A rigid motion, for which what lies above the palate looks alike in both scans.",
    )
    align.add_argument("palate", metavar="PALATE", help=PALATE_HELP)
    align.add_argument("--from", dest="own", required=True, metavar="SCAN", help=f"its own scan: {SCAN_HELP}")
    align.add_argument(
        "--to", dest="other", required=True, metavar="SCAN", help="another scan of the speaker"
    )
    align.add_argument(
        "-o", "--output", required=True, metavar="MOVED", help="the palate in the other scan (.ply or .obj)"
    )
    align.set_defaults(run=run_align)

    restore = verbs.add_parser(
        "restore",
        help="surface points, with the palate where the tongue touches it",
        description="Points behind the palate are taken out; where no air is below it, the palate is put in.",
    )
    restore.add_argument("cloud", metavar="CLOUD.ply", help="points with normals, as 'mri cloud' writes them")
    restore.add_argument("--palate", required=True, metavar="PALATE", help=f"in the same scan: {PALATE_HELP}")
    restore.add_argument(
        "--everywhere", action="store_true", help="put in all of the palate, as the paper does"
    )
    restore.add_argument("-o", "--output", required=True, metavar="OUT.ply", help="the points, mm")
    restore.set_defaults(run=run_restore)


def run_align(args: argparse.Namespace) -> int:
    from pathlib import Path

    import numpy as np

    from ... import InputError
    from ...atomic import write_atomically
    from ...model.mesh import MESH_SUFFIXES, Mesh, mesh_bytes, read_mesh, vertex_normals
    from ...model.mri.palatealignment import align_palate
    from ...model.mri.scan import read_scan
    from .names import keep_apart, prepare_folder

    output = Path(args.output)
    if output.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(
            f"{output}: meshes are written as {' or '.join(MESH_SUFFIXES)}; end the name in one."
        )
    prepare_folder(output)
    keep_apart([output], [Path(name) for name in (args.palate, args.own, args.other)])
    palate = read_mesh(args.palate)
    own, other = (read_scan(name).quantised() for name in (args.own, args.other))
    found = align_palate(palate.vertices, vertex_normals(palate.vertices, palate.faces), own, other)
    moved = found.motion.apply(palate.vertices)
    write_atomically(output, mesh_bytes(Mesh(moved, palate.faces), output.suffix))
    way_mm = np.sqrt(np.mean(np.sum((moved - palate.vertices) ** 2, axis=1)))
    turn_deg = np.degrees(np.arccos(np.clip((np.trace(found.motion.rotation) - 1.0) / 2.0, -1.0, 1.0)))
    print(
        f"{args.output}: moved by {way_mm:.2f} mm and {turn_deg:.2f} degrees; the profiles correlate by "
        f"{found.score:.3f}, before by {found.start_score:.3f}",
        file=sys.stderr,
    )
    if found.uncertain:
        print(f"{args.output}: this is uncertain: {found.reason}.", file=sys.stderr)
    return 0


def run_restore(args: argparse.Namespace) -> int:
    from pathlib import Path

    from ... import InputError
    from ...atomic import write_atomically
    from ...model.mesh import read_mesh
    from ...model.mri.cloudfile import cloud_bytes, read_cloud
    from ...model.mri.contact import ContactSettings, restore_contact
    from .names import keep_apart, prepare_folder

    prepare_folder(Path(args.output))
    keep_apart([Path(args.output)], [Path(args.cloud), Path(args.palate)])
    cloud = read_cloud(args.cloud)
    try:
        found = restore_contact(cloud, read_mesh(args.palate), ContactSettings(everywhere=args.everywhere))
    except InputError as reason:
        raise InputError(f"{args.cloud}: {reason}") from reason
    write_atomically(args.output, cloud_bytes(found))
    print(f"{args.output}: {len(found.points)} points, of {len(cloud.points)}", file=sys.stderr)
    return 0
