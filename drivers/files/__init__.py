"""Recordings on disk: one function opens any of them, one finds them, one writes them."""

from .folders import Found, find_recordings
from .recognise import open_recording
from .writing import write_recording

__all__ = ["Found", "find_recordings", "open_recording", "write_recording"]
