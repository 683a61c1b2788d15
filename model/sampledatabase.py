"""Writing a sample database: registered meshes, and the file that says whose what each one is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..atomic import write_atomically
from .mesh import Mesh, mesh_bytes
from .multilinear import SurfaceMarks


def write_sample_database(
    folder: Path,
    provenance: str,
    speakers: Sequence[str],
    prompts: Sequence[str],
    meshes: Mapping[tuple[str, str], Mesh],
    file_names: Mapping[tuple[str, str], str],
    marks: SurfaceMarks,
) -> Path:
    """Writes samples.yaml, whose path is returned, and meshes/; `build.read_sample_database` reads them back. The same
    meshes give the same bytes.

    meshes: (speaker, prompt) -> mesh, mm in a frame common to all; a cell may be missing. file_names: likewise, without
    ending. marks: of their common template. Raises InputError where a place cannot be written.
    """
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    data = []
    for speaker in speakers:
        phonemes = []
        for prompt in prompts:
            row = {"prompt": prompt}
            if (speaker, prompt) in meshes:
                row["path"] = f"meshes/{file_names[speaker, prompt]}.ply"
                write_atomically(folder / row["path"], mesh_bytes(meshes[speaker, prompt], ".ply"))
            phonemes.append(row)
        data.append({"name": speaker, "phonemes": phonemes})
    content = {
        "provenance": provenance,
        "meta": {"speakerAmount": len(data), "phonemeAmount": len(prompts)},
        "data": data,
        "template": {
            "landmarks": dict(marks.landmarks),
            "regions": {name: list(vertices) for name, vertices in marks.regions.items()},
            "midsagittal": list(marks.midsagittal),
        },
    }
    # JSON is YAML too, and json writes it the same way everywhere.
    text = json.dumps(content, ensure_ascii=False, indent=1)
    return write_atomically(folder / "samples.yaml", text.encode())
