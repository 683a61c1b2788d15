"""Frame in, pose out, and onwards: the runtime. Uses drivers and model."""

from importlib import import_module
from typing import Any

if __name__ != "tonguetrack.tracker":
    raise ImportError("import tonguetrack.tracker (the checkout's folder is mapped below that name)")

from .kernelcache import ensure_a_writable_cache

ensure_a_writable_cache()

# Loaded when first used: the command line lives below this package and must answer --help at once.
_HOME_OF = {
    "Tracker": "online",
    "PoseStatus": "pose",
    "TrackedPose": "pose",
    "TrackedPoses": "pose",
    "Session": "session",
    "load_session": "session",
    "Setup": "setup",
    "complete_setup": "setup",
    "TrackingRun": "tracking",
    "track_recording": "tracking",
}

__all__ = list(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'tonguetrack.tracker' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME_OF[name]}", __name__), name)
