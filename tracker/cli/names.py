"""What several commands understand by a model's name and by an output's place."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from ... import InputError

if TYPE_CHECKING:
    from ...model.multilinear import TongueModel

BUNDLED = "bundled"


def named_model(name: str) -> TongueModel:
    """The bundled synthetic model, or the one in a file."""
    if name == BUNDLED:
        from ..bundled import bundled_model

        return bundled_model()
    from ...model.files import load_model

    return load_model(name)


def prepare_folder(file: Path) -> None:
    """Makes the folder of an output and checks that it can be written to, before the work is done."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(file.parent, os.W_OK):
        raise InputError(f"{file}: no permission to write in {file.parent}; choose another place.")
