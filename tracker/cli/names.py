"""What several commands understand by a model's name and by an output's place."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel
    from ..pose import TrackedPoses
    from ..transfer import OtherSpeaker

BUNDLED = "bundled"


def named_model(name: str) -> TongueModel:
    """The bundled synthetic model, or the one in a file."""
    if name == BUNDLED:
        from ..bundled import bundled_model

        return bundled_model()
    from ...model.files import load_model

    return load_model(name)


def poses_and_model(path: str, model_name: str | None = None) -> tuple[TrackedPoses, TongueModel]:
    """Tracked poses and the model that they belong to: the one of this name, else the one that the file names."""
    from ..posefiles import read_poses

    given = named_model(model_name) if model_name else None
    poses = read_poses(path, given)
    model = given or _model_of(poses, path)
    check_model(poses, model, path)
    return poses, model


def check_model(poses: TrackedPoses, model: TongueModel, path: str) -> None:
    """Raises InputError where the poses of this file belong to another model."""
    if poses.model_fingerprint and poses.model_fingerprint != model.fingerprint:
        raise InputError(
            f"{path}: the poses were tracked with the model {poses.model_name} [{poses.model_fingerprint}], "
            f"but {model.name} is [{model.fingerprint}]; name the right one with --model."
        )


def _model_of(poses: TrackedPoses, path: str) -> TongueModel:
    if not poses.model_path:
        raise InputError(f"{path}: it does not say which model it belongs to; name it with --model.")
    if poses.model_path != BUNDLED and not Path(poses.model_path).is_file():
        raise InputError(f"{path}: its model {poses.model_path} is not there any more; name it with --model.")
    return named_model(poses.model_path)


def add_speaker_flag(parser: argparse.ArgumentParser) -> None:
    """For every command that makes a mesh of tracked poses; see `replayed`."""
    parser.add_argument(
        "--speaker",
        metavar="FILE|WEIGHTS",
        help="the same motion on another speaker's anatomy: a session file (.toml) with [speaker] weights, or the raw "
        "weights themselves, --speaker=0.1,-0.2,...",
    )


def replayed(
    poses: TrackedPoses, model: TongueModel, speaker: str | None
) -> tuple[TrackedPoses, OtherSpeaker | None]:
    """The poses as --speaker wants them, and that speaker; without it the poses themselves, and None."""
    if speaker is None:
        return poses, None
    from ..transfer import other_speaker, transferred

    other = other_speaker(speaker, model)
    return transferred(poses, other), other


def as_text(name: str) -> str:
    """A name from the command line as text that every file of ours can hold: bytes that are not UTF-8 become \\xff."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def keep_apart(outputs: Iterable[Path], sources: Iterable[Path]) -> None:
    """Refuses an output that is one of the files that are read, by whatever name."""
    read = {(found.st_dev, found.st_ino) for found in map(_found, sources) if found}
    for file in outputs:
        found = _found(file)
        if found and (found.st_dev, found.st_ino) in read:
            raise InputError(f"{file}: this file is read here and would be overwritten; choose another name.")


def _found(file: Path) -> os.stat_result | None:
    try:
        return file.stat()
    except (OSError, ValueError):
        return None


def each_once(recordings: Iterable[Path]) -> None:
    """Refuses a recording that is named twice, by whatever name: it would count twice."""
    for path, count in Counter(path.resolve() for path in recordings).items():
        if count > 1:
            raise InputError(f"{path}: this recording is named twice; name every recording once.")


def prepare_folder(file: Path) -> None:
    """Makes the folder of an output and checks that it can be written to, before the work is done."""
    if file.is_dir():
        raise InputError(f"{file}: this is a folder; give the name of a file to write.")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{file}: the folder {file.parent} cannot be made ({error.strerror}); choose another place."
        ) from error
    if not os.access(file.parent, os.W_OK):
        raise InputError(f"{file}: no permission to write in {file.parent}; choose another place.")


def add_recording_flags(parser: argparse.ArgumentParser) -> None:
    """What a person may have to say about a file that does not say it itself."""
    parser.add_argument("--rate", type=float, metavar="HZ", help="sampling rate, where the file states none")
    parser.add_argument("--unit", help="unit of positions, where the file states none: m dm cm mm 10um um")
    parser.add_argument("--layout", help="vector or angles (AG500 .pos without header); raw or filt (SSFF)")


def parsed_coils(text: str) -> dict[str, str]:
    """CHANNEL=ROLE,... as channel -> role, each once."""
    from ..coilmap import checked_coil_map

    coils: dict[str, str] = {}
    for pair in text.split(","):
        if not pair.strip():
            continue
        channel, _, role = (part.strip() for part in pair.partition("="))
        if not channel or not role:
            raise InputError(f"--coils {text}: expected CHANNEL=ROLE pairs with commas between them.")
        if channel in coils:
            raise InputError(
                f"--coils: the channel '{channel}' is named twice, as {coils[channel]} and as {role}; name it once."
            )
        coils[channel] = role
    checked_coil_map(coils, "--coils")
    return coils
