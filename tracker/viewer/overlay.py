"""Letters, lines, balls and bars on top of the picture, gathered as rows of numbers and drawn in one go."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ... import InputError
from ..pose import FloatArray
from .look import Colour
from .shaders import (
    BALL_FRAGMENT,
    BALL_VERTEX,
    BAR_FRAGMENT,
    BAR_VERTEX,
    LETTER_FRAGMENT,
    LETTER_VERTEX,
    LINE_FRAGMENT,
    LINE_VERTEX,
)

if TYPE_CHECKING:
    import moderngl

BAR, LINE, BALL, LETTER = range(4)
"""The kinds of marks, in the order in which they are drawn."""
COLUMNS = 15
"""ends (4), depths (2), thickness, colour (4), corners in the atlas (4) or, of a bar, its lower ends (2)."""
ENDS, DEPTHS, COLOUR, CORNERS = slice(0, 4), slice(4, 6), slice(7, 10), slice(11, 15)
THICKNESS, ALPHA = 6, 10
ATLAS_PX = 512
NEAREST_DEPTH = -1.0


class Typeface:
    """One font in one size, its letters put into an atlas when they are first used."""

    def __init__(self, context: moderngl.Context, size_px: int) -> None:
        try:
            from PIL import ImageFont
        except ImportError as reason:
            raise InputError(
                "drawing needs the extra 'viewer': pip install 'tonguetrack[viewer]'."
            ) from reason
        self._font: Any = ImageFont.load_default(size_px)
        self.size_px = size_px
        self.line_px = round(1.35 * size_px)
        self.atlas = context.texture((ATLAS_PX, ATLAS_PX), 1, bytes(ATLAS_PX * ATLAS_PX), alignment=1)
        self.atlas.filter = context.NEAREST, context.NEAREST  # a letter's pixels lie on the picture's
        self._row_px = round(1.5 * size_px)
        self._free = (1, 1)
        self._letters: dict[str, tuple[float, ...]] = {}
        # Most words stand in every picture again.
        self.row = lru_cache(maxsize=512)(self._row)
        self.width = lru_cache(maxsize=512)(self._width)

    def _width(self, text: str) -> float:
        """How many pixels wide the text is."""
        return float(sum(self._letter(letter)[0] for letter in plain_letters(text)))

    def wrapped(self, text: str, width_px: float) -> list[str]:
        """The text in lines of at most this width, broken between words where that is possible."""
        lines: list[str] = []
        line = ""
        for word in text.split():
            joined = f"{line} {word}" if line else word
            if self.width(joined) <= width_px:
                line = joined
                continue
            if line:
                lines.append(line)
            while self.width(word) > width_px and len(word) > 1:
                fits = next(
                    n for n in range(len(word) - 1, 0, -1) if n == 1 or self.width(word[:n]) <= width_px
                )
                lines.append(word[:fits])
                word = word[fits:]
            line = word
        return [*lines, line] if line else lines

    def _row(self, text: str) -> NDArray[np.float32]:
        """(n, COLUMNS) the text's letters in black, its upper left corner at 0, 0."""
        letters = np.array([self._letter(letter) for letter in plain_letters(text)]).reshape(-1, 6)
        rows = np.zeros((len(letters), COLUMNS), dtype=np.float32)
        rows[:, 0] = np.rint(np.cumsum(letters[:, 0]) - letters[:, 0])
        rows[:, 2] = rows[:, 0] + letters[:, 1]
        rows[:, 3] = self._row_px
        rows[:, DEPTHS] = NEAREST_DEPTH
        rows[:, ALPHA] = 1.0
        rows[:, CORNERS] = letters[:, 2:]
        return rows

    def _letter(self, letter: str) -> tuple[float, ...]:
        """Advance and width in pixels, and the corners in the atlas."""
        if letter not in self._letters:
            self._letters[letter] = self._drawn(letter)
        return self._letters[letter]

    def _drawn(self, letter: str) -> tuple[float, ...]:
        from PIL import Image, ImageDraw

        advance = float(self._font.getlength(letter))
        width = int(np.ceil(advance)) + 2
        x, y = self._free
        if x + width > ATLAS_PX:
            x, y = 1, y + self._row_px + 1
        if y + self._row_px > ATLAS_PX:
            return self._letter("?")  # the atlas is full: far more letters than any alphabet has
        image = Image.new("L", (width, self._row_px))
        ImageDraw.Draw(image).text((1, 1), letter, font=self._font, fill=255)
        self.atlas.write(image.tobytes(), viewport=(x, y, width, self._row_px), alignment=1)
        self._free = (x + width + 1, y)
        corners = np.array([x, y, x + width, y + self._row_px]) / ATLAS_PX
        return (advance, float(width), *corners.tolist())

    def release(self) -> None:
        self.atlas.release()


@lru_cache(maxsize=1024)
def plain_letters(text: str) -> str:
    """The text in the letters that Pillow's own font has: accents taken off, anything else as a question mark."""
    bare = unicodedata.normalize("NFKD", text)
    letters = (letter for letter in bare if not unicodedata.combining(letter))
    return "".join(letter if " " <= letter <= "~" else "?" for letter in letters)


@dataclass(frozen=True)
class Taken:
    """Marks of each kind, (n, COLUMNS) each, in the order of the kinds."""

    kinds: tuple[NDArray[np.float32], ...]

    def faint(self, share: float) -> Taken:
        """The same, seen only by so much."""
        weaker = np.ones(COLUMNS, dtype=np.float32)
        weaker[ALPHA] = share
        return Taken(tuple(rows * weaker for rows in self.kinds))


class Marks:
    """A list of marks; of one kind, the later are on top. Positions are pixels from the upper left, with a depth where
    it matters. What is not a finite number is not drawn."""

    def __init__(self, typeface: Typeface) -> None:
        self.typeface = typeface
        self._parts: tuple[list[NDArray[np.float32]], ...] = ([], [], [], [])

    def again(self, marks: Taken) -> None:
        """Marks that were made before."""
        for parts, rows in zip(self._parts, marks.kinds, strict=True):
            parts.append(rows)

    def lines(
        self,
        first: FloatArray,
        second: FloatArray,
        thickness: float,
        colours: ArrayLike,
        alphas: ArrayLike = 1.0,
    ) -> None:
        """Straight lines from points (n, 3) to points (n, 3): x, y, depth.

        colours: (3,) or (n, 3); alphas: one, or (n,).
        """
        rows = np.zeros((len(first), COLUMNS), dtype=np.float32)
        rows[:, 0:2], rows[:, 2:4] = first[:, :2], second[:, :2]
        rows[:, 4], rows[:, 5] = first[:, 2], second[:, 2]
        rows[:, THICKNESS] = thickness
        rows[:, COLOUR] = colours
        rows[:, ALPHA] = alphas
        self._parts[LINE].append(rows)

    def polyline(self, points: FloatArray, thickness: float, colour: Colour, alpha: float = 1.0) -> None:
        """A line through points (n, 3)."""
        self.lines(points[:-1], points[1:], thickness, colour, alpha)

    def balls(self, places: FloatArray, radii: FloatArray, colours: FloatArray) -> None:
        """At places (n, 3): x, y, depth; radii (n,) pixels, colours (n, 3)."""
        rows = np.zeros((len(places), COLUMNS), dtype=np.float32)
        rows[:, 0:2] = places[:, :2]
        rows[:, DEPTHS] = places[:, 2:]
        rows[:, THICKNESS] = radii
        rows[:, COLOUR], rows[:, ALPHA] = colours, 1.0
        self._parts[BALL].append(rows)

    def slabs(self, upper: FloatArray, lower: FloatArray, colours: ArrayLike) -> None:
        """Trapezoids between level edges, upper (n, 3) and lower (n, 3): left, right, height; colours (n, 3)."""
        rows = np.zeros((len(upper), COLUMNS), dtype=np.float32)
        rows[:, 0], rows[:, 2], rows[:, 1] = upper.T
        rows[:, 11], rows[:, 12], rows[:, 3] = lower.T
        rows[:, DEPTHS] = NEAREST_DEPTH
        rows[:, COLOUR], rows[:, ALPHA] = colours, 1.0
        self._parts[BAR].append(rows)

    def bar(
        self, left: float, top: float, right: float, bottom: float, colour: ArrayLike, alpha: float = 1.0
    ) -> None:
        """One filled rectangle."""
        row = np.zeros((1, COLUMNS), dtype=np.float32)
        row[0, ENDS] = left, top, right, bottom
        row[0, 11:13] = left, right
        row[0, DEPTHS] = NEAREST_DEPTH
        row[0, COLOUR], row[0, ALPHA] = colour, alpha
        self._parts[BAR].append(row)

    def text(self, x: float, y: float, text: str, colour: Colour) -> None:
        """One line; x, y: the upper left corner."""
        move = np.zeros(COLUMNS, dtype=np.float32)
        move[0] = move[2] = round(x)
        move[1] = move[3] = round(y)
        move[COLOUR] = colour
        self._parts[LETTER].append(self.typeface.row(text) + move)

    def taken(self) -> Taken:
        """Everything gathered so far, which is forgotten."""
        nothing = np.zeros((0, COLUMNS), dtype=np.float32)
        kinds = [np.concatenate([nothing, *parts]) for parts in self._parts]
        self._parts = ([], [], [], [])
        return Taken(tuple(rows[np.isfinite(rows.sum(axis=1))] for rows in kinds))


class MarkDrawer:
    """Draws rows of marks, one call for each kind."""

    def __init__(self, context: moderngl.Context) -> None:
        self._kinds = [
            MarkKind(context, vertex_shader, fragment_shader)
            for vertex_shader, fragment_shader in (
                (BAR_VERTEX, BAR_FRAGMENT),
                (LINE_VERTEX, LINE_FRAGMENT),
                (BALL_VERTEX, BALL_FRAGMENT),
                (LETTER_VERTEX, LETTER_FRAGMENT),
            )
        ]

    def draw(self, marks: Taken, size: tuple[int, int], atlas: moderngl.Texture) -> None:
        """size: of the picture, pixels."""
        atlas.use(0)
        for drawer, rows in zip(self._kinds, marks.kinds, strict=True):
            if len(rows):
                drawer.draw(rows, size)

    def release(self) -> None:
        for drawer in self._kinds:
            drawer.release()


class MarkKind:
    """The programme of one kind of marks, and a buffer that grows with their number."""

    def __init__(self, context: moderngl.Context, vertex_shader: str, fragment_shader: str) -> None:
        self._context = context
        self._program = context.program(vertex_shader, fragment_shader=fragment_shader)
        self._buffer: moderngl.Buffer | None = None
        self._array: moderngl.VertexArray | None = None
        self._room = 0

    def draw(self, rows: NDArray[np.float32], size: tuple[int, int]) -> None:
        if len(rows) > self._room:
            self._make_room(2 * len(rows))
        assert self._buffer is not None and self._array is not None
        self._buffer.write(rows.tobytes())
        self._program["size"] = size
        self._array.render(self._context.TRIANGLE_STRIP, vertices=4, instances=len(rows))

    def _make_room(self, rows: int) -> None:
        self._release_buffer()
        self._buffer = self._context.buffer(reserve=4 * COLUMNS * rows, dynamic=True)
        layout, names = [], []
        for name, part in (
            ("in_ends", 4),
            ("in_depths", 2),
            ("in_thickness", 1),
            ("in_colour", 4),
            ("in_letter", 4),
        ):
            used = name in self._program
            layout.append(f"{part}f" if used else f"{4 * part}x")
            names += [name] if used else []
        self._array = self._context.vertex_array(
            self._program, [(self._buffer, " ".join([*layout, "/i"]), *names)]
        )
        self._room = rows

    def _release_buffer(self) -> None:
        for thing in (self._array, self._buffer):
            if thing is not None:
                thing.release()

    def release(self) -> None:
        self._release_buffer()
        self._program.release()
