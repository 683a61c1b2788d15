"""The prompts of `tonguetrack live --calibrate`."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError
from .calibrate import WORKING

if TYPE_CHECKING:
    from ...drivers.frames import FrameOfReference
    from ...drivers.sources import Source
    from ...model.multilinear import TongueModel
    from ..calibration import Calibration
    from ..guided import Part
    from ..session import Session

COUNTDOWN_S = 3
LOOK_S = 1.0


def guided_session(
    source: Source, model: TongueModel, session: Session, folder: Path, frame_words: str | None
) -> Session:
    """Leads the speaker through the parts, calibrates, writes session and report into the folder."""
    from ...atomic import write_atomically
    from ...drivers import open_recording
    from ..calibration import Sources, calibrate
    from ..coilmap import guess_coil_map
    from ..gathering import gather
    from ..guided import parts_for, record_parts
    from ..palate import axes_from_words
    from ..session import load_session, session_toml

    frame = axes_from_words(frame_words) if frame_words else None
    roles = session.coils
    if not roles:
        seen = gather(source, LOOK_S, say)
        roles = guess_coil_map(seen.coils, seen.positions, seen.source).roles
    parts = parts_for(roles.values())
    check_axes(source, parts, frame)
    say(f"to be recorded: {', '.join(part.name.replace('_', ' ') for part in parts)}")
    files = record_parts(source, parts, folder, ready, say)
    say(WORKING)
    try:
        found = calibrate(
            [open_recording(files["speech"])],
            model,
            Sources(
                rest=open_recording(files["rest"]) if "rest" in files else None,
                bite_plane=open_recording(files["bite_plane"]) if "bite_plane" in files else None,
                palate=files.get("palate"),
            ),
            dict(roles),
            frame,
            session.smoothing,
        )
    except InputError as reason:
        raise InputError(
            f"{reason} What was recorded is kept in {folder}; 'tonguetrack calibrate {files['speech']}' with the other "
            "parts tries again without the speaker."
        ) from reason
    for decision in found.decisions:
        say(f"  {decision}")
    path = folder / "session.toml"
    write_atomically(path, session_toml(found.session).encode())
    say(f"written: {path}")
    write_pictures(found, model, folder)
    return load_session(path)


def check_axes(source: Source, parts: Sequence[Part], frame: FrameOfReference | None) -> None:
    """Raises InputError where nothing is going to say how the axes lie, before the speaker has done anything."""
    from ..guided import BITE_PLANE

    known = "unknown" not in (source.frame.x, source.frame.y, source.frame.z)
    if frame is None and not known and BITE_PLANE not in parts:
        raise InputError(
            f"{source.address}: it does not state how its axes lie to the head, and no coils are on a bite plate; say "
            'where x, y and z grow, as in --frame "front left up".'
        )


def write_pictures(found: Calibration, model: TongueModel, folder: Path) -> None:
    """The report, where pictures can be drawn; a session without them is as good."""
    from ..calibrationreport import require_plotting, write_report

    try:
        require_plotting()
    except InputError as reason:
        say(f"no report: {reason}")
        return
    for file in write_report(found, model, folder):
        say(f"written: {file}")


def ready(part: Part) -> bool:
    """Shows what is to be done; returns when Enter was pressed, or after a countdown where there is no terminal."""
    say(f"\n{part.name.replace('_', ' ').upper()}: {part.words} ({part.seconds:g} s)")
    if os.name == "posix" and sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty():
        say("press Enter to begin")
        return bool(sys.stdin.readline())
    for left in range(COUNTDOWN_S, 0, -1):
        say(f"{left} ...")
        time.sleep(1.0)
    say("now")
    return True


def say(text: str) -> None:
    """A line for people."""
    print(text, file=sys.stderr, flush=True)
