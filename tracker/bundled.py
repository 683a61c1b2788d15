"""The sample recording and the model that come with the package. Both are synthetic, and say so."""

from __future__ import annotations

from contextlib import AbstractContextManager
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from pathlib import Path

from .. import InputError
from ..drivers import Recording, open_recording
from ..model import TongueModel, load_model
from .session import Session, load_session

MODEL = ("tonguetrack.model.data", "default.npz")
RECORDING = ("tonguetrack.recordings", "demo.csv")
SESSION = ("tonguetrack.recordings", "demo.session.toml")


def bundled_model() -> TongueModel:
    """The default model, made by this project's own pipeline from scans of a phantom: not anatomy."""
    with bundled_model_path() as path:
        return load_model(path)


def bundled_model_path() -> AbstractContextManager[Path]:
    """The default model as a file, for as long as the context lasts."""
    return as_file(_resource(*MODEL))


def bundled_recording() -> tuple[Recording, Session]:
    """The demo's recording and its complete session: coils, vertices on the bundled model, speaker."""
    with as_file(_resource(*RECORDING)) as path:
        recording = open_recording(path)
    with as_file(_resource(*SESSION)) as path:
        session = load_session(path)
    return recording, session


def _resource(package: str, name: str) -> Traversable:
    found = files(package) / name
    if not found.is_file():
        raise InputError(
            f"{name}: this installation has no such file in {package}; install tonguetrack again."
        )
    return found
