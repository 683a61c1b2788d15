"""Where a slice cuts a surface: lines to be drawn over the slice's picture."""

from __future__ import annotations

import numpy as np

from ..mesh import FloatArray, Mesh
from .slicepicture import PLANES


def contour(mesh: Mesh, plane: str, at_mm: float) -> list[FloatArray]:
    """The lines in which a plane of `slicepicture` (at_mm along the axis across it) cuts a surface.

    Each is (k, 2) mm, to the right and upwards in the plane's picture, its points in order along the surface; a closed
    one ends where it began. Empty where the surface does not reach the plane. The mesh is in the scan's world.
    """
    across, right, up = PLANES[plane]
    heights = mesh.vertices[:, across] - at_mm
    above = heights >= 0  # a vertex in the plane counts as above, so that every cut is of two edges
    corners = above[mesh.faces].sum(axis=1)
    cut = mesh.faces[(corners > 0) & (corners < 3)].astype(np.int64)
    if not len(cut):
        return []
    # A cut face has one corner on the one side, and two on the other; the two edges at that corner are cut.
    sides = above[cut]
    single = np.argmax(sides == (sides.sum(axis=1, keepdims=True) == 1), axis=1)
    own = cut[np.arange(len(cut)), single]
    edges = np.stack(
        [np.stack([own, cut[np.arange(len(cut)), (single + k) % 3]], axis=1) for k in (1, 2)], axis=1
    )
    unique, ends = np.unique(np.sort(edges.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    low, high = heights[unique[:, 0]], heights[unique[:, 1]]
    share = (low / (low - high))[:, None]
    points = mesh.vertices[unique][..., [right, up]]
    places = (1 - share) * points[:, 0] + share * points[:, 1]
    return [places[line] for line in _joined(ends.reshape(-1, 2).tolist())]


def _joined(pieces: list[list[int]]) -> list[list[int]]:
    """Pieces of two ends each as lines, open ones first. Where more than two pieces meet, which no sound surface has,
    lines end."""
    at: dict[int, list[list[int]]] = {}
    for piece in pieces:
        for end in piece:
            at.setdefault(end, []).append(piece)
    passed_through = {end for end, found in at.items() if len(found) == 2}

    def taken(end: int) -> list[int] | None:
        if not at[end]:
            return None
        piece = at[end].pop()
        at[piece[0] if piece[1] == end else piece[1]].remove(piece)
        return piece

    lines = []
    for start in [*(at.keys() - passed_through), *at]:
        while (found := taken(start)) is not None:
            line = [start]
            while found is not None:
                first, second = found
                line.append(second if first == line[-1] else first)
                found = taken(line[-1]) if line[-1] in passed_through else None
            lines.append(line)
    return lines
