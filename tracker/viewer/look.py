"""Colours, sizes and lights: the only place where a picture's taste is written down."""

from __future__ import annotations

from dataclasses import dataclass

Colour = tuple[float, float, float]
"""Red, green and blue as a screen has them, 0 to 1."""


def colour(hexadecimal: str) -> Colour:
    """ "e0a030" as a colour."""
    red, green, blue = bytes.fromhex(hexadecimal)
    return red / 255, green / 255, blue / 255


@dataclass(frozen=True)
class Light:
    """direction: towards the light, as the camera sees it (right, up, towards the viewer); colour: its strength."""

    direction: tuple[float, float, float]
    colour: Colour


NEAR = colour("d62f3a")
"""A vertex at the palate, or one that is hardly known."""
FAR = colour("3d6fd6")
UNKNOWN = colour("8a8a8a")
KEY = Light((-0.45, 0.75, 0.65), (1.0, 0.96, 0.9))
FILL = Light((0.8, 0.1, 0.45), (0.34, 0.38, 0.46))


@dataclass(frozen=True)
class Look:
    """background: behind everything; panel: behind words on the tongue; tissue, inside: of the mesh from
    outside and from inside; flat: of the cut in the flat view; coils: one after the other, again from the first when
    there are more; warning: a coil that does not count."""

    background: Colour
    panel: Colour
    line: Colour
    text: Colour
    faint_text: Colour
    warning: Colour
    tissue: Colour
    inside: Colour
    flat: Colour
    contour: Colour
    palate: Colour
    ghost: Colour
    bar: Colour
    coils: tuple[Colour, ...]
    near: Colour = NEAR
    far: Colour = FAR
    unknown: Colour = UNKNOWN
    key: Light = KEY
    fill: Light = FILL
    ambient: Colour = (0.20, 0.19, 0.21)
    ball_mm: float = 1.6
    font_share: float = 1 / 42  # of the picture's height
    smallest_font_px: int = 12
    largest_font_px: int = 24


# Okabe and Ito's palette, which people with any colour vision can tell apart, lightened or darkened for the ground.
DARK = Look(
    background=colour("1d2127"),
    panel=colour("191c21"),
    line=colour("4a515c"),
    text=colour("eceff3"),
    faint_text=colour("a9b1bd"),
    warning=colour("ffb020"),
    tissue=colour("cf7a76"),
    inside=colour("8c4448"),
    flat=colour("a85a59"),
    contour=colour("ffc2b8"),
    palate=colour("e8dcc0"),
    ghost=colour("7fd4ff"),
    bar=colour("ef8f86"),
    coils=tuple(map(colour, ("f5d547", "4fc3f7", "5fd38d", "ff9e57", "d6a3ff", "ffffff"))),
)
LIGHT = Look(
    background=colour("f1f3f6"),
    panel=colour("ffffff"),
    line=colour("aab1bc"),
    text=colour("16191e"),
    faint_text=colour("525a66"),
    warning=colour("a34a05"),
    tissue=colour("d0716d"),
    inside=colour("93464a"),
    flat=colour("e9a9a3"),
    contour=colour("8f2f30"),
    palate=colour("6b5a30"),
    ghost=colour("0b6fa8"),
    bar=colour("c2514c"),
    coils=tuple(map(colour, ("c79a00", "0b72b5", "138a55", "d1590a", "8a3fc4", "16191e"))),
)
