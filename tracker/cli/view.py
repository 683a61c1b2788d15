"""`tonguetrack view` and `tonguetrack render`: tracked poses in a window, as a film, as pictures."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from .names import keep_apart, prepare_folder
from .showing import add_show_flags, shown, with_progress

if TYPE_CHECKING:
    from ..viewer.film import Shot

SIZE = "1280x720"
FPS = 60.0


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `view` and `render`."""
    view = commands.add_parser(
        "view",
        help="show tracked poses or a take in a window",
        description="Plays poses or a take in a window, in three dimensions and in the mid-sagittal plane; its keys stand "
        "in the window. Needs the extra 'viewer'.",
    )
    add_show_flags(view)
    view.set_defaults(run=run_view)

    render = commands.add_parser(
        "render",
        help="tracked poses or a take as a film or pictures",
        description="Draws poses or a take without a window. .mp4: a film (extra 'video'; without it, numbered pictures); "
        ".webp, .gif: a picture that moves; .png: numbered pictures, or with --frame one; a folder: pictures in it. "
        "Needs the extra 'viewer'.",
    )
    add_show_flags(render)
    render.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="film.mp4, tongue.png or a folder"
    )
    render.add_argument(
        "--audio", metavar="FILE", help="the sound, whose beginning is second 0 of the poses' time"
    )
    render.add_argument("--size", default=SIZE, metavar="WxH", help=f"pixels (default {SIZE})")
    render.add_argument(
        "--fps", type=float, default=FPS, metavar="N", help=f"pictures a second (default {FPS:g})"
    )
    render.add_argument("--frame", type=int, metavar="N", help="one picture, of this frame, counted from 0")
    render.add_argument("--seconds", metavar="A:B", help="only from second A to second B of the poses' time")
    render.set_defaults(run=run_render)


def run_view(args: argparse.Namespace) -> int:
    from ..viewer.player import play

    what = shown(args)
    play(what.scene, what.moments, what.look, what.colour_by, what.ghost)
    return 0


def run_render(args: argparse.Namespace) -> int:
    from .ending import unwound

    with unwound():
        return _render(args)


def _render(args: argparse.Namespace) -> int:
    from ..viewer.film import (
        Shot,
        can_film,
        check_animation,
        write_animation,
        write_film,
        write_pictures,
        write_still,
    )

    target, kind = _target(args)
    size, part_s = _size(args.size), _part(args.seconds)
    what = shown(args)
    shot = Shot(what.scene, what.moments, what.look, what.colour_by, what.ghost, size, args.fps, part_s)
    keep_apart([target], [Path(args.file)])
    prepare_folder(target)
    if args.frame is not None:
        write_still(shot.still(args.frame), target)
        print(f"written: {target} ({_what(shot)})", file=sys.stderr)
        return 0
    if kind == ".mp4" and not can_film():
        print(_without_video(args, target, shot), file=sys.stderr)
        target, kind = target.with_suffix(".png"), ".png"
    if kind == ".mp4":
        audio = Path(args.audio) if args.audio else None
        write_film(with_progress(shot), target, shot.fps, shot.begin_s, shot.size, audio)
    elif kind != ".png":
        check_animation(shot)
        write_animation(with_progress(shot), target, shot.fps)
    if kind != ".png":
        print(f"written: {target} ({_what(shot)}, {shot.picture_count} pictures)", file=sys.stderr)
    else:
        write_pictures(with_progress(shot), target)
        print(f"written: {shot.picture_count} pictures beside {target} ({_what(shot)})", file=sys.stderr)
    return 0


def _target(args: argparse.Namespace) -> tuple[Path, str]:
    """The output's name, and what it is by its suffix. Raises InputError for what nothing here could write."""
    target = Path(args.output)
    if args.output.endswith(("/", os.sep)) or target.is_dir():
        target = target / "tongue.png"
    suffix = target.suffix.lower()
    if suffix not in (".mp4", ".webp", ".gif", ".png"):
        raise InputError(
            f"{target}: films are written as .mp4, .webp or .gif, pictures as .png; end the name in one of them, or in / "
            "for a folder."
        )
    if args.frame is not None and suffix != ".png":
        raise InputError(f"--frame makes one picture; end {target} in .png.")
    if args.frame is not None and args.seconds:
        raise InputError("--frame makes one picture, --seconds many; give one of them.")
    if args.audio and suffix != ".mp4":
        raise InputError(f"--audio belongs to a film; end {target} in .mp4.")
    return target, suffix


def _part(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        begin_s, end_s = (float(part) for part in text.split(":"))
    except ValueError:
        raise InputError(f"--seconds {text}: expected a first and a last second, such as 2.5:6.") from None
    return begin_s, end_s


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = text.lower().split("x")
        return int(width), int(height)
    except ValueError:
        raise InputError(f"--size {text}: expected a width and a height in pixels, such as {SIZE}.") from None


def _what(shot: Shot) -> str:
    return f"{shot.scene.title}, {shot.size[0]}x{shot.size[1]}"


def _without_video(args: argparse.Namespace, target: Path, shot: Shot) -> str:
    """What becomes of a film that cannot be made here, and how one makes it of the pictures."""
    sound = f" -ss {shot.begin_s:g} -i {args.audio} -shortest" if args.audio else ""
    return (
        "a film needs the extra 'video': pip install 'tonguetrack[video]'. Pictures are written instead; ffmpeg makes a "
        f"film of them: ffmpeg -framerate {shot.fps:g} -i {target.with_suffix('')}_%06d.png{sound} "
        f"-pix_fmt yuv420p {target}"
    )
