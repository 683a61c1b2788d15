"""Where coil frames come from: files, devices, simulators. Knows nothing of tongues."""

if __name__ != "tonguetrack.drivers":
    raise ImportError("import tonguetrack.drivers (the checkout's folder is mapped below that name)")

from .files import find_recordings, open_recording, write_recording
from .frames import CoilFrame, FrameOfReference, NoteKind, Recording, SourceNote
from .replay import ReplaySource

__all__ = [
    "CoilFrame",
    "FrameOfReference",
    "NoteKind",
    "Recording",
    "ReplaySource",
    "SourceNote",
    "find_recordings",
    "open_recording",
    "write_recording",
]
