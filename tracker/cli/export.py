"""`tonguetrack export`: tracked poses as an animated glTF, meshes, a table or arrays, for other programs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from .names import add_speaker_flag, keep_apart, prepare_folder, replayed
from .showing import poses_to_show

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel
    from ..palate import Palate
    from ..pose import TrackedPoses


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `export`."""
    export = commands.add_parser(
        "export",
        help="tracked poses for other programs: glTF, PLY, OBJ, CSV, NPZ",
        description="The ending of the output says what is written. .glb: an animated glTF for Blender, Unity, Unreal, "
        "three.js; .ply, .obj: one mesh a frame, tongue_000000.ply and so on; .csv: weights, the points under the "
        "coils and the mid-sagittal contour; .npz: all vertices of all frames.",
    )
    export.add_argument(
        "poses", metavar="POSES", help="what 'track --out' or 'take export --what poses' wrote"
    )
    export.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="tongue.glb, .ply, .obj, .csv or .npz"
    )
    export.add_argument(
        "--every", type=int, default=1, metavar="K", help="every K-th frame (default: every frame)"
    )
    export.add_argument(
        "--session", metavar="FILE", help="glb: the palate of this session, as a line; a take has its own"
    )
    export.add_argument("--coils", action="store_true", help="glb: the coils too, as balls")
    export.add_argument("--sigmas", type=float, metavar="N",
                        help="glb: 0 and 1 are mean -+ N sigma, for a model that is also driven live (5: all that is "
                        "ever tracked); without it, the least and greatest of this take")  # fmt: skip
    add_speaker_flag(export)
    export.add_argument("--model", help="the model, where it is not where the poses say")
    export.set_defaults(run=run_export)


def run_export(args: argparse.Namespace) -> int:
    from ..exporting import check_export_suffix
    from .ending import unwound

    target = Path(args.output)
    check_export_suffix(target)
    _check_flags(args, target.suffix.lower())
    poses, model, session = poses_to_show(args.poses, args.model)
    poses, other = replayed(poses, model, args.speaker)
    if other is not None:
        palate = other.palate
    else:
        palate = _palate_of(args.session) if args.session else session.palate
    keep_apart([target], [Path(args.poses), Path(args.model or poses.model_path)])
    prepare_folder(target)
    frames = range(0, poses.frame_count, args.every)
    with unwound():
        _write(args, target, poses, model, frames, palate)
    what = f"{len(frames)} meshes beside {target}" if _is_mesh(target) else str(target)
    whose = f", on {other.source}" if other is not None else ""
    print(f"written: {what} ({model.name}, {len(frames)} frames{whose})", file=sys.stderr)
    return 0


def _check_flags(args: argparse.Namespace, suffix: str) -> None:
    if args.every < 1:
        raise InputError(f"--every {args.every}: expected 1 or more.")
    if args.sigmas is not None and not 0 < args.sigmas <= 1000:
        raise InputError(f"--sigmas {args.sigmas:g}: expected a number above 0, such as 5.")
    for flag in ("session", "coils", "sigmas"):
        if getattr(args, flag) and suffix != ".glb":
            raise InputError(f"--{flag} belongs to a .glb file; {args.output} is none.")
    if args.speaker and args.session:
        raise InputError(
            "--session names the palate of the speaker who was tracked; with --speaker the palate comes from that "
            "speaker's session."
        )
    if args.speaker and args.coils:
        raise InputError(
            "--coils were measured on the speaker who was tracked; leave them out with --speaker."
        )


def _palate_of(session_path: str) -> Palate:
    from ..session import load_session

    palate = load_session(session_path).palate
    if palate is None:
        raise InputError(
            f"{session_path}: it has no [palate]; leave --session out, or see docs/calibration.md."
        )
    return palate


def _is_mesh(target: Path) -> bool:
    from ...model.mesh import MESH_SUFFIXES

    return target.suffix.lower() in MESH_SUFFIXES


def _write(
    args: argparse.Namespace,
    target: Path,
    poses: TrackedPoses,
    model: TongueModel,
    frames: range,
    palate: Palate | None,
) -> None:
    from ...atomic import write_atomically
    from ..exporting import motion_csv, motion_glb, write_mesh_sequence, write_motion_npz

    match target.suffix.lower():
        case ".glb":
            content, outside = motion_glb(model, poses, frames, palate, args.coils, args.sigmas)
            write_atomically(target, content)
            if outside:
                print(
                    f"note: {outside} of {len(frames)} frames leave the {args.sigmas:g} sigma that 0 and 1 stand for; "
                    "programs that clamp weights, such as Blender, show them wrong",
                    file=sys.stderr,
                )
        case ".csv":
            rows = motion_csv(model, poses, frames)
            write_atomically(target, lambda file: file.writelines(row.encode() for row in rows))
        case ".npz":
            write_atomically(target, lambda file: write_motion_npz(model, poses, frames, file))
        case _:
            write_mesh_sequence(model, poses, frames, target)
