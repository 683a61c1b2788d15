"""Point clouds with normals as PLY files, which mesh viewers open."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ... import InputError
from ..cloud import Cloud

PLACE, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
MAX_BYTES = 1024 * 1024 * 1024
MAX_HEADER = 64 * 1024
END = b"end_header\n"


def cloud_bytes(cloud: Cloud) -> bytes:
    """Points, and normals where there are some, as a binary PLY file of float32, mm."""
    columns = [cloud.points] if cloud.normals is None else [cloud.points, cloud.normals]
    names = PLACE if cloud.normals is None else PLACE + NORMAL
    header = ["ply", "format binary_little_endian 1.0", "comment mm", f"element vertex {len(cloud.points)}"]
    header += [f"property float {name}" for name in names]
    return "\n".join(header).encode() + b"\n" + END + np.hstack(columns).astype("<f4").tobytes()


def read_cloud(path: str | Path) -> Cloud:
    """The vertices of a PLY file, with their normals where it has some; faces are passed over.

    Raises InputError for a missing, foreign or damaged file.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such point cloud.")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a point cloud.")
    content = path.read_bytes()
    start = content[:MAX_HEADER].replace(b"\r\n", b"\n")
    if not start.startswith(b"ply\n") or END not in start:
        raise InputError(f"{path}: this is not a PLY file; expected a point cloud in one.")
    crlf = content[:5] == b"ply\r\n"
    end = content.index(b"end_header") + len(END) + crlf
    order, count, properties = _vertices(start[: start.index(END)].decode("ascii", "replace"), path)
    if order:
        row = np.dtype([(name, order + code) for name, code in properties])
        if len(content) - end < count * row.itemsize:
            raise InputError(f"{path}: the file is cut short: {count} points should be in it.")
        table = np.frombuffer(content, row, count, end)
        columns = {name: table[name].astype(np.float64) for name, _ in properties}
    else:
        lines = content[end:].splitlines()[:count]
        try:
            numbers = np.array([line.split() for line in lines], dtype=np.float64)
        except ValueError:
            numbers = np.empty((0, 0))
        if numbers.shape != (count, len(properties)):
            raise InputError(f"{path}: expected {count} lines with {len(properties)} numbers each.")
        columns = {name: numbers[:, index] for index, (name, _) in enumerate(properties)}
    if not all(name in columns for name in PLACE) or not count:
        raise InputError(f"{path}: expected points with x, y and z, found none.")
    points = np.stack([columns[name] for name in PLACE], axis=1)
    has_normals = all(name in columns for name in NORMAL)
    normals = np.stack([columns[name] for name in NORMAL], axis=1) if has_normals else None
    if not np.isfinite(points).all() or (normals is not None and not np.isfinite(normals).all()):
        raise InputError(f"{path}: a point or a normal is not a number.")
    return Cloud(points, normals)


def _vertices(header: str, path: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """Order of bytes ('' for text), number of vertices, (name, type) of each of their properties."""
    order, count = "", 0
    properties: list[tuple[str, str]] = []
    element = None
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == ["format"]:
            order = ORDERS.get(words[1] if len(words) > 1 else "", "")
        elif words[:1] == ["element"] and len(words) == 3:
            if element is None and (words[1] != "vertex" or not words[2].isdecimal()):
                raise InputError(f"{path}: expected the vertices first in the PLY file.")
            count = int(words[2]) if element is None else count
            element = words[1]
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES or words[2] in dict(properties):
                raise InputError(f"{path}: the vertices' property '{' '.join(words[1:])}' cannot be read.")
            properties.append((words[2], TYPES[words[1]]))
    return order, count, properties
