"""From millimetres to pixels: the orbiting camera, the flat view, and where everything has its place in a picture.

Pixels count from the upper left corner, x to the right, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..pose import FloatArray
from .look import Look
from .scene import Moment, Scene

FIELD_DEG = 28.0
"""The angle that the camera sees along the shorter side of its panel."""
NEAREST_MM, FARTHEST_MM = 20.0, 2000.0
STEEPEST_DEG = 89.0
NARROW = 0.75
"""In a picture higher than this share of its width, words are no larger than in one that is as high as that."""


@dataclass
class View:
    """How one looks at a scene, and what is shown beside it.

    yaw_deg: 0 = from the front, 90 = from the speaker's left; pitch_deg: 0 = level, 90 = from above;
    distance_mm: from the camera to `centre` (3,), mm in the model frame.
    colour_by: "tissue", "palate" (distance to it) or "uncertainty".
    trail_s: so far back the coils' trails reach; 0 = none. ghost: a pose to compare with, or None.
    lines: status text, from top to bottom.
    """

    yaw_deg: float
    pitch_deg: float
    distance_mm: float
    centre: tuple[float, float, float]
    colour_by: str = "tissue"
    trail_s: float = 0.5
    ghost: Moment | None = None
    lines: tuple[str, ...] = ()

    def orbit(self, yaw_deg: float, pitch_deg: float) -> None:
        """Turns the camera round the centre by so much."""
        self.yaw_deg = (self.yaw_deg + yaw_deg + 180.0) % 360.0 - 180.0
        self.pitch_deg = float(np.clip(self.pitch_deg + pitch_deg, -STEEPEST_DEG, STEEPEST_DEG))

    def zoom(self, factor: float) -> None:
        """Brings the camera nearer: a factor of 2 halves the distance."""
        self.distance_mm = float(np.clip(self.distance_mm / factor, NEAREST_MM, FARTHEST_MM))


def home_view(scene: Scene) -> View:
    """From the left, the front and above, near enough that the tongue fills its panel."""
    low, high = scene.extent
    distance = 0.40 * np.linalg.norm(high - low) / np.sin(np.radians(FIELD_DEG / 2))
    centre = 0.5 * (low + high)
    return View(52.0, 24.0, float(distance), (float(centre[0]), float(centre[1]), float(centre[2])))


class Area(NamedTuple):
    """A rectangle of pixels: its upper left corner and its size."""

    x: int
    y: int
    width: int
    height: int

    def holds(self, x: float, y: float) -> bool:
        return self.x <= x < self.x + self.width and self.y <= y < self.y + self.height


@dataclass(frozen=True)
class Layout:
    """solid: the view in three dimensions; flat: the mid-sagittal view; bars: the weights; font_px: the text."""

    solid: Area
    flat: Area
    bars: Area
    font_px: int
    margin: int


def layout_of(size: tuple[int, int], look: Look) -> Layout:
    """The places in a picture of this size (width, height)."""
    width, height = size
    font_px = round(min(height, NARROW * width) * look.font_share)
    font = int(np.clip(font_px, look.smallest_font_px, look.largest_font_px))
    margin = max(6, round(0.6 * font))
    column = round(0.46 * width)
    bars_height = max(round(0.24 * height), 7 * font)
    left = width - column
    flat_height = height - bars_height - 2 * margin
    return Layout(
        Area(0, 0, left, height),
        Area(left, margin, column - margin, flat_height),
        Area(left, margin + flat_height, column - margin, bars_height),
        font,
        margin,
    )


@dataclass(frozen=True)
class Projection:
    """Where points come to lie in one area of a picture.

    matrix: (4, 4) from mm, homogeneous, to the area's clip coordinates as OpenGL has them.
    """

    matrix: FloatArray
    area: Area

    @cached_property
    def _to_pixels(self) -> FloatArray:
        """(4, 4) from homogeneous mm to homogeneous pixels and depth."""
        x, y, width, height = self.area
        place = np.eye(4)
        place[0, 0], place[0, 3] = 0.5 * width, x + 0.5 * width
        place[1, 1], place[1, 3] = -0.5 * height, y + 0.5 * height
        return np.ascontiguousarray((place @ self.matrix).T)

    def pixels(self, points: FloatArray) -> FloatArray:
        """(n, 3) from points (n, 3) mm: x, y in pixels of the whole picture, and depth from -1 (near) to 1;
        NaN behind the camera."""
        placed = points @ self._to_pixels[:3] + self._to_pixels[3]
        depth = placed[:, 3:]
        depth[depth <= 1e-6] = np.nan
        return np.asarray(placed[:, :3] / depth)

    def pixels_per_mm(self, points: FloatArray) -> FloatArray:
        """(n,) how large a millimetre looks at points (n, 3)."""
        depth = points @ self.matrix[3, :3] + self.matrix[3, 3]
        return np.asarray(
            0.5 * self.area.height * np.linalg.norm(self.matrix[1, :3]) / np.maximum(depth, 1e-6)
        )


def camera_axes(view: View) -> FloatArray:
    """(3, 3): the camera's right, up and backwards (towards the viewer), in the model frame."""
    yaw, pitch = math.radians(view.yaw_deg), math.radians(view.pitch_deg)
    across, along = (math.cos(yaw), math.sin(yaw)), (math.sin(yaw), -math.cos(yaw))
    level, steep = math.cos(pitch), math.sin(pitch)
    return np.array(
        [
            [*across, 0.0],
            [-along[0] * steep, -along[1] * steep, level],
            [along[0] * level, along[1] * level, steep],
        ]
    )


def solid_projection(view: View, area: Area) -> Projection:
    """The orbiting camera's perspective."""
    axes = camera_axes(view)
    eye = np.asarray(view.centre) + view.distance_mm * axes[2]
    near, far = 0.05 * view.distance_mm, 3.0 * view.distance_mm + 200.0
    scale = min(area.width, area.height) / np.tan(np.radians(FIELD_DEG / 2))
    perspective = np.zeros((4, 4))
    perspective[0, 0], perspective[1, 1] = scale / area.width, scale / area.height
    perspective[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    perspective[3, 2] = -1.0
    placed = np.eye(4)
    placed[:3, :3] = axes
    placed[:3, 3] = -axes @ eye
    return Projection(perspective @ placed, area)


def flat_projection(scene: Scene, area: Area, margin_px: float) -> Projection:
    """The mid-sagittal plane, front to the left, a millimetre as long upwards as sideways.

    margin_px: that stays free on every side of where tongue and palate can be.
    """
    low, high = scene.extent[:, 1:]
    room = np.maximum([area.width - 2 * margin_px, area.height - 2 * margin_px], 1.0)
    per_mm = float((room / np.maximum(high - low, 1.0)).min())
    centre = 0.5 * (low + high)
    matrix = np.zeros((4, 4))
    matrix[0, 1], matrix[1, 2] = 2 * per_mm / area.width, 2 * per_mm / area.height
    matrix[:2, 3] = -matrix[0, 1] * centre[0], -matrix[1, 2] * centre[1]
    matrix[3, 3] = 1.0
    return Projection(matrix, area)
