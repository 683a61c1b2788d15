"""Where coil frames come from: files now, devices and simulators later. Knows nothing of tongues."""

if __name__ != "tonguetrack.drivers":
    raise ImportError("import tonguetrack.drivers (the checkout's folder is mapped below that name)")

from .files import find_recordings, open_recording, write_recording
from .frames import CoilFrame, FrameOfReference, Recording
from .replay import ReplaySource

__all__ = [
    "CoilFrame",
    "FrameOfReference",
    "Recording",
    "ReplaySource",
    "find_recordings",
    "open_recording",
    "write_recording",
]
