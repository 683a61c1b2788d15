"""The numbers that stand in a picture besides its bars."""

from __future__ import annotations

from math import isnan

from .scene import Moment, Scene


def figures(scene: Scene, moment: Moment) -> tuple[str, ...]:
    """Where the coils are (x, y, z in mm, model frame), and the weights in sigma, a line each."""
    lines = []
    for name, place, residual in zip(
        scene.names, moment.coils.tolist(), moment.residuals_mm.tolist(), strict=False
    ):
        if not isnan(place[0]):
            where = ", ".join(f"{axis} {round(number, 1) + 0.0}" for axis, number in zip("xyz", place))
            off = "" if isnan(residual) else f", residual {residual:.2f}"
            lines.append(f"{name}: {where} mm{off}")
    weights = ", ".join(f"{weight:+.2f}" for weight in moment.normalised.tolist())
    return (*lines, f"weights: {weights} sigma")
