"""A calibration at the start of a live session: what the speaker is asked to do, and what is made of it.

Every part is written to disk as soon as it was recorded, so that nothing has to be asked twice, and so that
`tonguetrack calibrate` can do it again from the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from .. import InputError
from ..drivers import write_recording
from ..drivers.devices.source import DeviceSource
from ..drivers.frames import Recording
from ..drivers.sources import Source
from .coilmap import TONGUE_PREFIX
from .gathering import gather


@dataclass(frozen=True)
class Part:
    """name: of its file; words: what the speaker is asked to do; seconds: how long that is recorded."""

    name: str
    words: str
    seconds: float


REST = Part("rest", "hold the head still, lips closed, look straight ahead", 3.0)
BITE_PLANE = Part("bite_plane", "bite on the plate with the coils and hold the head still", 4.0)
PALATE = Part(
    "palate",
    "draw the probe slowly along the middle of the palate, from behind the teeth backwards, and again",
    10.0,
)
SPEECH = Part(
    "speech",
    "say slowly, twice: ah - ee - oo - ae - oh; then ata, ala, aka, asa, asha, and a sentence of your own",
    15.0,
)


def parts_for(roles: Iterable[str]) -> tuple[Part, ...]:
    """What can be asked for with coils of these roles; speech always."""
    roles = set(roles)
    if not any(role.startswith(TONGUE_PREFIX) for role in roles):
        raise InputError("no coil is on the tongue; name them with --coils or in the session's [coils].")
    parts = []
    if sum(role.startswith("head_") for role in roles) >= 3:
        parts.append(REST)
    if "bite_front" in roles and len(roles & {"bite_left", "bite_right", "bite_back"}) >= 1:
        parts.append(BITE_PLANE)
    if "palate_probe" in roles:
        parts.append(PALATE)
    return (*parts, SPEECH)


def record_parts(
    source: Source,
    parts: Iterable[Part],
    folder: Path,
    ask: Callable[[Part], bool],
    told: Callable[[str], None],
) -> dict[str, Path]:
    """Records one part after the other; name -> file.

    ask: shows what is to be done and returns when the speaker is ready; False ends it. Raises InputError where the
    source ends, something is in the folder already, or it was ended.
    """
    files = {part.name: folder / f"{part.name}.npz" for part in parts}
    check_new_folder(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: this folder cannot be made ({error.strerror}); name another with --calibrate."
        ) from error
    for part in parts:
        if not ask(part):
            raise InputError("the calibration was ended before its last part.")
        if isinstance(source, DeviceSource):
            source.catch_up()
        try:
            recording = gather(source, part.seconds, told)
        except InputError as reason:
            raise InputError(f"calibration, {part.name.replace('_', ' ')}: {reason}") from reason
        write_recording(named(recording, part), files[part.name])
        told(
            f"{part.name}: {recording.frame_count} frames, {recording.duration_s:.1f} of {part.seconds:g} s, in "
            f"{files[part.name]}"
        )
    return files


def check_new_folder(folder: Path) -> None:
    """Raises InputError where the folder holds something: a calibration is never written over another."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: this is there already; name a new folder with --calibrate.")


def named(recording: Recording, part: Part) -> Recording:
    """The recording with a source of its own, so that sentences say which part they are about."""
    return replace(recording, source=f"{recording.source}, {part.name}")
