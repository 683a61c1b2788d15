"""Triangle meshes and their files (PLY, OBJ). Vertex order is identity here: it is never changed."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import InputError

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int32]

MESH_SUFFIXES = (".ply", ".obj")


@dataclass(frozen=True, slots=True)
class Mesh:
    """vertices: (n, 3) float64, mm; faces: (f, 3) int32 vertex indices."""

    vertices: FloatArray
    faces: IndexArray


def read_mesh(path: str | Path) -> Mesh:
    """Reads a triangle mesh with its vertices in the file's order.

    Raises InputError for a missing, foreign, damaged or non-triangular file.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: expected a mesh file ending in .ply or .obj.")
    if not path.is_file():
        raise InputError(f"{path}: there is no such mesh file.")
    import trimesh  # 0.7 s: only when a mesh is really read

    try:
        loaded: Any = trimesh.load(
            path, process=False, maintain_order=True, force="mesh", skip_materials=True
        )
        vertices = np.ascontiguousarray(loaded.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(loaded.faces, dtype=np.int32)
    except Exception as reason:  # the parser raises whatever a damaged file makes it stumble over
        raise InputError(f"{path}: this is not a readable triangle mesh ({_first_line(reason)}).") from reason
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or len(vertices) == 0:
        raise InputError(f"{path}: expected vertices with three coordinates and triangles, found none.")
    if not np.isfinite(vertices).all():
        raise InputError(
            f"{path}: vertex {int(np.argmin(np.isfinite(vertices).all(axis=1)))} is not a number."
        )
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise InputError(
            f"{path}: a face names vertex {wrong}, but there are {len(vertices)} vertices, from 0."
        )
    return Mesh(vertices, faces)


def mesh_bytes(mesh: Mesh, suffix: str) -> bytes:
    """The mesh as the content of a file of that suffix (.ply: binary float32; .obj: text, 6 decimals)."""
    import trimesh

    body: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if suffix.lower() == ".ply":
        return bytes(body.export(file_type="ply", encoding="binary", vertex_normal=False))
    if suffix.lower() == ".obj":
        text = body.export(file_type="obj", digits=6, include_normals=False, header=None)
        return str(text).encode()
    raise InputError(f"meshes are written as .ply or .obj, not as '{suffix}'.")


def vertex_normals(vertices: FloatArray, faces: IndexArray) -> FloatArray:
    """(n, 3) unit normals, area-weighted over the adjacent faces; zero for a vertex without a face."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))


def vertex_distances(shapes: FloatArray, truth: FloatArray) -> FloatArray:
    """(T, V) mm between the corresponding vertices of shapes and truth, both (T, k)."""
    return np.asarray(np.linalg.norm((shapes - truth).reshape(len(shapes), -1, 3), axis=2))


def _first_line(reason: BaseException) -> str:
    lines = io.StringIO(str(reason)).readline().strip()
    return f"{type(reason).__name__}: {lines}"[:120]
