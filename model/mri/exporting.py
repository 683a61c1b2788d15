"""What a build has made, as files that people and other programs open: clouds and meshes under readable names.

SPEAKER_PHONE.points.ply   the surface points of a scan, contact restored, mm in the world of the scan
SPEAKER_PHONE.palate.ply   the speaker's palate in that scan
SPEAKER_PHONE.first.ply    the tongue after the first matching
SPEAKER_PHONE.tongue.ply   the tongue after the last round
samples.yaml, meshes/      the tongues in the frame that all heads share, which `model evaluate` reads
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

from ... import InputError
from ...atomic import write_atomically
from ..mesh import FloatArray, IndexArray, Mesh, mesh_bytes
from ..sampledatabase import write_sample_database
from ..synthetic.samples import FILE_NAMES
from . import stages, templates
from .bootstrapping import Cell
from .caching import Cache
from .cloudfile import cloud_bytes
from .results import Index, shapes_of, tongues_in_head, upright_motions


def export(work: str | Path, index: Index, folder: str | Path) -> None:
    """Writes what there is of the index into the folder, which is made.

    Raises InputError where a place cannot be written, or results are gone.
    """
    folder, cache = Path(folder), Cache(Path(work))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: this folder cannot be made ({error.strerror or error}); choose another place."
        ) from error
    names = readable_names(index.dataset.scans)
    tongue, palate = templates.tongue().mesh.faces, templates.palate().mesh.faces

    def write(cell: Cell, kind: str, content: bytes) -> None:
        write_atomically(folder / f"{names[cell]}.{kind}.ply", content)

    def write_mesh(cell: Cell, kind: str, vertices: FloatArray, faces: IndexArray) -> None:
        write(cell, kind, mesh_bytes(Mesh(vertices, faces), ".ply"))

    for cell in index.dataset.scans:
        key = index.clouds.get(cell) or index.surfaces.get(cell)
        if key is not None:
            write(cell, "points", cloud_bytes(stages.cloud_of(cache.load(key))))
        if cell in index.aligned:
            write_mesh(cell, "palate", cache.load(index.aligned[cell])["palate"], palate)
        if cell in index.tongues:
            write_mesh(cell, "first", cache.load(index.tongues[cell][0])["vertices"], tongue)
            write_mesh(cell, "tongue", cache.load(index.tongues[cell][-1])["vertices"], tongue)
    if index.used:
        heads = tongues_in_head(index, cache, upright_motions(index, cache))
        shapes = shapes_of(index, heads)
        meshes = {cell: Mesh(vertices, tongue) for cell, vertices in heads.items()}
        write_sample_database(
            folder, index.dataset.provenance, shapes.speakers, shapes.prompts, meshes, names, shapes.marks
        )


def readable_names(cells: Collection[Cell]) -> dict[Cell, str]:
    """A file name without ending for each (speaker, phone), plain and different from all others."""
    names: dict[Cell, str] = {}
    for speaker, phone in cells:
        plain = re.sub(r"[^\w.-]", "_", f"{speaker}_{FILE_NAMES.get(phone, phone)}")[:80]
        name, number = plain, 1
        while name.lower() in {taken.lower() for taken in names.values()}:
            number += 1
            name = f"{plain}_{number}"
        names[speaker, phone] = name
    return names
