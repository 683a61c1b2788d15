"""What `view`, `render` and `track --view` have in common: a file to be shown, and how it is to look."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import InputError
from .names import BUNDLED, add_speaker_flag, check_model, named_model, poses_and_model, replayed

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel
    from ..pose import TrackedPoses
    from ..session import Session
    from ..viewer.film import Picture, Shot
    from ..viewer.look import Look
    from ..viewer.playback import Ghost
    from ..viewer.scene import Moments, Scene


def add_show_flags(parser: argparse.ArgumentParser) -> None:
    """FILE and everything that says how it looks."""
    parser.add_argument(
        "file", metavar="FILE", help="poses.csv, .npz, .json as 'track --out' wrote them, or a take.xdf"
    )
    parser.add_argument("--session", metavar="FILE", help="the palate of this session; a take has its own")
    add_ghost_flag(parser)
    parser.add_argument("--colour", choices=("tissue", "palate", "uncertainty"), default="tissue",
                        help="colour the tongue by its distance to the palate, or by how well it is known")  # fmt: skip
    look = parser.add_mutually_exclusive_group()
    look.add_argument("--light", action="store_true", help="on a light ground")
    look.add_argument("--dark", action="store_true", help="on a dark ground (default)")
    add_speaker_flag(parser)
    parser.add_argument("--model", help="the model, where it is not where the poses say")


def add_ghost_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--ghost", metavar="FILE[@SECONDS]",
                        help="a tongue to compare with: poses or a take, all of it or the pose at that time")  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """What was asked for, read and checked."""

    scene: Scene
    moments: Moments
    look: Look
    colour_by: str
    ghost: Ghost | None


def shown(args: argparse.Namespace) -> Shown:
    """Reads it all. Raises InputError where something is missing, foreign or damaged."""
    from ..session import load_session
    from ..transfer import session_of
    from ..viewer.look import DARK, LIGHT
    from ..viewer.playback import Ghost, check_times
    from ..viewer.scene import moments_of

    poses, model, session = poses_to_show(args.file, args.model)
    if args.session:
        session = load_session(args.session)
    poses, other = replayed(poses, model, args.speaker)
    if other is not None:
        session = session_of(other)
    check_times(poses.times_s, args.file)
    poses = with_coils(poses, session)
    scene = scene_to_show(poses, model, session, Path(args.file).stem)
    if args.colour == "palate" and scene.palate is None:
        raise InputError("--colour palate: no palate is known; name a session that has one with --session.")
    ghost = None if args.ghost is None else Ghost(moments_of(read_ghost(args.ghost, model, args.speaker)))
    return Shown(scene, moments_of(poses), LIGHT if args.light else DARK, args.colour, ghost)


def poses_to_show(path: str, model_name: str | None) -> tuple[TrackedPoses, TongueModel, Session]:
    """Poses from a file or a take, their model, and what is known of the session: of a take all, of a file nothing."""
    from ..session import Session, parse_session
    from ..takes.reading import read_take

    if Path(path).suffix.lower() != ".xdf":
        return *poses_and_model(path, model_name), Session()
    take = read_take(path)
    poses, model = take.poses(), named_model(model_name or BUNDLED)
    check_model(poses, model, path)
    _, session = take.sessions[-1]
    return poses, model, parse_session(session, path)


def with_coils(poses: TrackedPoses, session: Session) -> TrackedPoses:
    """Without coils where none was measured, or where nothing says to which vertices they belong."""
    import numpy as np

    vertices = poses.correspondences or tuple(session.correspondences.values())
    if len(vertices) == poses.coils.shape[1] and not np.isnan(poses.coils).all():
        named = tuple(session.correspondences) if not poses.correspondences else poses.roles
        return replace(poses, roles=named, correspondences=vertices)
    if not np.isnan(poses.coils).all():
        print(
            "the coils are not shown: the file does not say which vertices they sit on; a session does (--session).",
            file=sys.stderr,
        )
    frames = poses.frame_count
    return replace(
        poses,
        roles=(),
        correspondences=(),
        coils=np.zeros((frames, 0, 3)),
        residuals_mm=np.zeros((frames, 0)),
        coil_states=None,
    )


def scene_to_show(poses: TrackedPoses, model: TongueModel, session: Session, name: str) -> Scene:
    import numpy as np

    from ..viewer.scene import scene_of

    session = replace(session, speaker_weights=np.median(poses.speaker_weights, axis=0))
    # The model's name says where it is synthetic.
    return scene_of(model, session, poses.roles, poses.correspondences, f"{name}, {model.name}")


def read_ghost(text: str, model: TongueModel, speaker: str | None = None) -> TrackedPoses:
    """FILE[@SECONDS]: all poses, or the one at that time. Raises InputError where they are of another model, or the
    file does not reach that time."""
    from ..posefiles import read_poses
    from ..takes.reading import read_take
    from ..viewer.playback import check_times, frame_at

    path, at_s = _split(text)
    poses = read_take(path).poses() if Path(path).suffix.lower() == ".xdf" else read_poses(path, model)
    check_model(poses, model, path)
    poses, _ = replayed(poses, model, speaker)
    check_times(poses.times_s, path)
    begin_s, end_s = float(poses.times_s[0]), float(poses.times_s[-1])
    if at_s is None:
        return poses
    if not begin_s <= at_s <= end_s:
        raise InputError(f"--ghost {text}: {path} lasts from {begin_s:g} s to {end_s:g} s.")
    return _one_frame(poses, frame_at(poses.times_s, at_s))


def _one_frame(poses: TrackedPoses, frame: int) -> TrackedPoses:
    import numpy as np

    arrays = {field.name: getattr(poses, field.name) for field in fields(poses)}
    rows: dict[str, Any] = {
        name: values[frame : frame + 1] for name, values in arrays.items() if isinstance(values, np.ndarray)
    }
    return replace(poses, **rows)


def _split(text: str) -> tuple[str, float | None]:
    """A file may have an @ in its name: one that is there is meant."""
    path, at, seconds = text.rpartition("@")
    if not at or Path(text).exists():
        return text, None
    try:
        return path, float(seconds)
    except ValueError:
        return text, None


def with_progress(shot: Shot, title: str = "drawing") -> Iterable[Picture]:
    """The pictures, with a progress bar where there is a person to see it."""
    if not sys.stderr.isatty():
        return shot.pictures()
    from rich.console import Console
    from rich.progress import track as progress

    return progress(
        shot.pictures(), description=title, total=shot.picture_count, console=Console(stderr=True)
    )
