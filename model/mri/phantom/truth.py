"""What a phantom's scan really shows. The pipeline never reads it; only a comparison does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .... import InputError
from ....archive import read_arrays
from ....atomic import write_atomically
from ...mesh import Mesh

FloatArray = NDArray[np.float64]

LARGEST_BYTES = 100_000_000
_SHAPES: dict[str, tuple[str, int]] = {
    "tongue_vertices": ("f", 3),
    "tongue_faces": ("i", 3),
    "tongue_kind": ("u", 0),
    "palate_vertices": ("f", 3),
    "palate_faces": ("i", 3),
    "head_to_world": ("f", 4),
}


@dataclass(frozen=True)
class ScanTruth:
    """One scan's truth, in the scan's world, mm.

    tongue: the upper surface from tip to root and some millimetres of the sides, faces outward; kind: (n,) for
    each of its vertices `surfaces.BARE`, CONTACT (with the hard palate) or BURIED (in other soft tissue, where no
    scan shows an edge). palate: the hard palate between the gum lines, faces down, the same vertices in all scans
    of a speaker. head_to_world: (4, 4) rigid, the speaker's head frame -> world; between two scans f and g the
    head moved by g.head_to_world @ inv(f.head_to_world).
    """

    tongue: Mesh
    kind: NDArray[np.uint8]
    palate: Mesh
    head_to_world: FloatArray


def write_truth(truth: ScanTruth, path: Path) -> None:
    """Writes the truth as .npz; single precision for vertices (10 nm)."""

    def write(stream: BinaryIO) -> None:
        np.savez_compressed(
            stream,
            tongue_vertices=truth.tongue.vertices.astype(np.float32),
            tongue_faces=truth.tongue.faces,
            tongue_kind=truth.kind,
            palate_vertices=truth.palate.vertices.astype(np.float32),
            palate_faces=truth.palate.faces,
            head_to_world=truth.head_to_world,
        )

    write_atomically(path, write)


def read_truth(path: str | Path) -> ScanTruth:
    """Reads what `write_truth` wrote. Raises InputError for anything else."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such truth of a scan.")
    if path.stat().st_size > LARGEST_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for the truth of a scan.")
    try:
        arrays = read_arrays(path.read_bytes(), LARGEST_BYTES)
    except InputError as reason:
        raise InputError(f"{path}: {reason}") from reason
    for name, (kind, columns) in _SHAPES.items():
        array = arrays.get(name)
        if array is None or array.dtype.kind != kind or array.shape[1:] != ((columns,) if columns else ()):
            raise InputError(
                f"{path}: expected the array '{name}' of a phantom's truth; make the phantom again."
            )
    vertices = arrays["tongue_vertices"]
    for part in ("tongue", "palate"):
        faces, count = arrays[f"{part}_faces"], len(arrays[f"{part}_vertices"])
        if not len(faces) or faces.min() < 0 or faces.max() >= count:
            raise InputError(f"{path}: the faces of the {part} name vertices that are not there.")
    if len(arrays["tongue_kind"]) != len(vertices) or arrays["head_to_world"].shape != (4, 4):
        raise InputError(f"{path}: the arrays of this truth do not belong together; make the phantom again.")
    return ScanTruth(
        Mesh(vertices.astype(np.float64), arrays["tongue_faces"].astype(np.int32)),
        arrays["tongue_kind"].astype(np.uint8),
        Mesh(arrays["palate_vertices"].astype(np.float64), arrays["palate_faces"].astype(np.int32)),
        arrays["head_to_world"],
    )
