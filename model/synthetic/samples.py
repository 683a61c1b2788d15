"""The synthetic speakers as a sample database, in the layout of the published one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...atomic import write_atomically
from ..mesh import Mesh, mesh_bytes
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
    folder = Path(folder)
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    template = tongue_template()
    data = []
    for anatomy, shapes in zip(training_anatomies(), training_shapes(), strict=True):
        phonemes = []
        for phone, vertices in zip(PHONES, shapes, strict=True):
            path = f"meshes/{anatomy.name}_{FILE_NAMES[phone]}.ply"
            write_atomically(folder / path, mesh_bytes(Mesh(vertices, template.faces), ".ply"))
            phonemes.append({"prompt": phone, "path": path})
        data.append({"name": anatomy.name, "phonemes": phonemes})
    content = {
        "provenance": PROVENANCE,
        "meta": {"speakerAmount": len(data), "phonemeAmount": len(PHONES)},
        "data": data,
        "template": {
            "landmarks": template.landmarks,
            "regions": {name: list(vertices) for name, vertices in template.regions.items()},
            "midsagittal": list(template.midsagittal),
        },
    }
    # JSON is YAML too, and json writes it the same way everywhere.
    text = json.dumps(content, ensure_ascii=False, indent=1)
    write_atomically(folder / "samples.yaml", text.encode())
    return folder / "samples.yaml"
