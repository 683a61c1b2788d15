"""A surface as points, with normals where they are known: what a scan or a foreign mesh gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .mesh import FloatArray


@dataclass(frozen=True)
class Cloud:
    """A surface that is not registered to the model, in the model's frame, mm.

    points: (n, 3); normals: (n, 3) unit, outwards, or None where they are not known; landmarks: vertex of the
    model -> (3,) where it is.
    """

    points: FloatArray
    normals: FloatArray | None = None
    landmarks: Mapping[int, FloatArray] = field(default_factory=dict)
