"""tonguetrack: electromagnetic articulography coils in, the whole moving tongue out.

The public names below are loaded when first used, so that importing the package stays instant.
"""

import os
from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# Python started in the checkout finds this folder before the installed package. There, the other
# folders of the package are neighbours of this one.
_HERE = os.path.dirname(os.path.abspath(__file__))
if not os.path.isdir(os.path.join(_HERE, "model")):
    __path__.append(os.path.dirname(_HERE))


class InputError(ValueError):
    """Something a user handed over cannot be used.

    The message is one sentence: which file or value, where in it, what was expected, what to do.
    Commands print it as it stands and leave with exit code 2.
    """


_HOME_OF = {
    "CoilFrame": "drivers",
    "Recording": "drivers",
    "open_recording": "drivers",
    "SpeakerModel": "model",
    "TongueModel": "model",
    "load_model": "model",
    "save_model": "model",
    "Session": "tracker",
    "TrackedPose": "tracker",
    "Tracker": "tracker",
    "load_session": "tracker",
    "track_recording": "tracker",
}

__all__ = [
    "CoilFrame",
    "InputError",
    "Recording",
    "Session",
    "SpeakerModel",
    "TongueModel",
    "TrackedPose",
    "Tracker",
    "__version__",
    "load_model",
    "load_session",
    "open_recording",
    "save_model",
    "track_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'tonguetrack' has no attribute '{name}'")
    return getattr(import_module(f".{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
