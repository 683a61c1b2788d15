"""The synthetic speakers as a sample database, in the layout of the published one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..mesh import Mesh
from ..multilinear import SurfaceMarks
from ..sampledatabase import write_sample_database
from .anatomy import training_anatomies
from .articulation import PHONES, articulation_for, random_habits
from .surface import tongue_surface
from .template import tongue_template

PROVENANCE = "synthetic: parametric speakers of tonguetrack's own making, not measured from anybody"
# File names stay plain; the prompts themselves are IPA.
FILE_NAMES = {
    "i": "i", "e": "e", "ɛ": "open-e", "a": "a", "ɑ": "back-a", "ʌ": "wedge", "ɔ": "open-o", "o": "o", "u": "u",
    "ʉ": "barred-u", "ə": "schwa", "s": "s", "ʃ": "esh",
}  # fmt: skip


def training_shapes() -> NDArray[np.float64]:
    """(11, 13, n, 3) mm: every training speaker's every phone."""
    return np.array(
        [
            [
                tongue_surface(anatomy, articulation_for(anatomy, phone, random_habits(number)))
                for phone in PHONES
            ]
            for number, anatomy in enumerate(training_anatomies(), start=1)
        ]
    )


def write_samples(folder: str | Path) -> Path:
    """Writes the meshes and samples.yaml, whose path is returned; the same bytes every time."""
    template = tongue_template()
    people = [anatomy.name for anatomy in training_anatomies()]
    meshes = {
        (name, phone): Mesh(vertices, template.faces)
        for name, shapes in zip(people, training_shapes(), strict=True)
        for phone, vertices in zip(PHONES, shapes, strict=True)
    }
    names = {(name, phone): f"{name}_{FILE_NAMES[phone]}" for name, phone in meshes}
    marks = SurfaceMarks(template.landmarks, template.regions, template.midsagittal)
    return write_sample_database(Path(folder), PROVENANCE, people, tuple(PHONES), meshes, names, marks)
