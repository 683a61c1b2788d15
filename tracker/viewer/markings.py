"""What is written and drawn on and around the tongue: coils and their names, residuals, trails, palate, bars, text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..pose import CoilState, FloatArray, PoseStatus
from .camera import Layout, Projection, View
from .look import Colour, Look
from .overlay import Marks, Taken, Typeface
from .scene import COIL_WORDS, STATUS_WORDS, Moment, Scene

SIGMA_SHOWN = 4.0  # a bar's full height; what is beyond has its number
SIGMA_MARK = 3.0
SCALE_MM = 10.0
SLAB_PX = 6.0  # of one shade in the cut


@dataclass(frozen=True)
class Section:
    """outline: (s, 3) mm, the cut of a tongue; feet: (n, 3) mm, the vertices that the coils are held to."""

    outline: FloatArray
    feet: FloatArray


@dataclass(frozen=True)
class Trails:
    """coils: (t, n, 3) mm, the oldest first, the present at the end; ages: (t,) 1 = about to vanish, 0 = now."""

    coils: FloatArray
    ages: FloatArray


@dataclass(frozen=True)
class Legend:
    """What the vertices' colours stand for: from 0 mm, the first colour, to `most_mm` and beyond, the second."""

    words: str
    most_mm: float
    colours: tuple[Colour, Colour]


def slabs(polygon: FloatArray, highest_px: float) -> tuple[FloatArray, FloatArray]:
    """The inside of a closed polygon (s, 2) as trapezoids with level edges: upper and lower ones (n, 3), each left,
    right, height.

    A point is inside where a level line from it crosses the sides an odd number of times. Between two heights where
    the polygon has corners its sides are straight, so that the trapezoids fill it exactly; none is higher than asked.
    """
    first, second = polygon, np.roll(polygon, -1, axis=0)
    low, high = polygon[:, 1].min(), polygon[:, 1].max()
    heights = np.unique(np.concatenate([polygon[:, 1], np.arange(low, high, highest_px)]))
    middle = 0.5 * (heights[:-1] + heights[1:])
    slab, side = np.nonzero((first[:, 1] <= middle[:, None]) != (second[:, 1] <= middle[:, None]))
    (x, y), (to_x, to_y) = first[side].T, second[side].T
    slope = (to_x - x) / (to_y - y)
    order = np.lexsort((x + (middle[slab] - y) * slope, slab))
    slab, x, y, slope = slab[order], x[order], y[order], slope[order]
    edges = []
    for height in (heights[slab], heights[slab + 1]):
        at = x + (height - y) * slope
        edges.append(np.column_stack([at[::2], at[1::2], height[::2]]))
    return edges[0], edges[1]


class Markings:
    """Makes the rows of marks of one picture after the other, in one layout."""

    def __init__(self, scene: Scene, look: Look, layout: Layout, typeface: Typeface) -> None:
        self._scene, self._look, self._layout, self._typeface = scene, look, layout, typeface
        self._stroke = max(1.0, layout.font_px / 9)
        self._marks = Marks(typeface)
        self._always: Taken | None = None

    def in_space(
        self, moment: Moment, projection: Projection, tongue: Section, trails: Trails | None
    ) -> Taken:
        """On the tongue in three dimensions, with depths."""
        if self._scene.palate is not None:
            points = projection.pixels(self._scene.palate)
            self._marks.polyline(points, 2 * self._stroke, self._look.palate)
        self._coils(moment, projection, tongue.feet, trails)
        return self._marks.taken()

    def in_plane(
        self,
        moment: Moment,
        projection: Projection,
        tongue: Section,
        ghost: Section | None,
        trails: Trails | None,
    ) -> Taken:
        """On the mid-sagittal cut."""
        look, stroke = self._look, self._stroke
        outline = projection.pixels(tongue.outline)
        self._fill(outline)
        if self._scene.palate is not None:
            self._marks.polyline(projection.pixels(self._scene.palate), 2 * stroke, look.palate)
        if ghost is not None:
            self._marks.polyline(projection.pixels(ghost.outline), 1.6 * stroke, look.ghost, 0.9)
        self._marks.polyline(outline[[-1, 0]], stroke, look.contour, 0.35)  # where the mesh is open
        self._marks.polyline(outline, 2 * stroke, look.contour)
        self._coils(moment, projection, tongue.feet, trails)
        return self._marks.taken()

    def _fill(self, outline: FloatArray) -> None:
        """The cut's inside, paler above; closed by a straight line where the mesh is open."""
        area = self._layout.flat
        upper, lower = slabs(outline[:, :2], SLAB_PX)
        shade = 1.06 - 0.34 * (upper[:, 2] - area.y) / area.height
        self._marks.slabs(upper, lower, np.clip(np.outer(shade, self._look.flat), 0.0, 1.0))

    def around(
        self, moment: Moment, view: View, solid: Projection, flat: Projection, legend: Legend | None
    ) -> Taken:
        """Words, numbers and bars, on top of everything."""
        if self._always is None:
            self._directions(flat)
            self._scale_of_bars()
            self._always = self._marks.taken()
        self._marks.again(self._always)
        for projection in (solid, flat):
            self._names(moment, projection)
        self._status(moment, view)
        if legend is not None:
            self._legend(legend)
        self._bars(moment)
        return self._marks.taken()

    def _coils(self, moment: Moment, projection: Projection, feet: FloatArray, trails: Trails | None) -> None:
        if not len(moment.coils):
            return
        marks, look = self._marks, self._look
        coils = projection.pixels(moment.coils)
        colours = np.array([self._colour(coil, moment) for coil in range(len(coils))])
        if trails is not None:
            times = len(trails.ages) - 1
            places = projection.pixels(trails.coils.reshape(-1, 3))
            fading = np.repeat(0.75 * (1.0 - trails.ages[1:]), len(coils))
            width = 1.2 * self._stroke
            marks.lines(
                places[: -len(coils)], places[len(coils) :], width, np.tile(colours, (times, 1)), fading
            )
        marks.lines(coils, projection.pixels(feet), 1.2 * self._stroke, look.text)
        marks.balls(coils, self._radii(moment, projection), colours)

    def _radii(self, moment: Moment, projection: Projection) -> FloatArray:
        """(n,) of the balls, pixels."""
        return np.maximum(3.0, self._look.ball_mm * projection.pixels_per_mm(moment.coils))

    def _colour(self, coil: int, moment: Moment) -> Colour:
        if moment.coil_states[coil] not in (CoilState.TRUSTED, CoilState.MISSING):
            return self._look.warning
        return self._look.coils[coil % len(self._look.coils)]

    def _names(self, moment: Moment, projection: Projection) -> None:
        """Beside the coils, inside the area, none on top of another."""
        if not len(moment.coils):
            return
        area, typeface = projection.area, self._typeface
        places = projection.pixels(moment.coils)
        sizes = self._radii(moment, projection)
        taken: list[tuple[float, float, float]] = []
        for coil in np.argsort(places[:, 1]).tolist():  # from above; NaN at the end
            x, y = places[coil, :2].tolist()
            if not area.holds(x, y):
                continue
            state = COIL_WORDS.get(CoilState(int(moment.coil_states[coil])))
            name = self._scene.names[coil] + (f" ({state})" if state else "")
            width = typeface.width(name)
            left = x + sizes[coil] + 4
            if left + width > area.x + area.width - 2:
                left = x - sizes[coil] - 4 - width
            left = max(left, area.x + 2.0)
            top = float(np.clip(y - typeface.line_px, area.y, area.y + area.height - typeface.line_px))
            for other_left, other_right, bottom in taken:
                if left < other_right and other_left < left + width and top < bottom:
                    top = bottom
            taken.append((left, left + width, top + typeface.line_px))
            self._backed(left, top, name, self._look.warning if state else self._look.text, self._look.panel)

    def _backed(self, x: float, y: float, text: str, colour: Colour, ground: Colour) -> None:
        """Text on a ground of its own, readable on the tongue as well."""
        width, height = self._typeface.width(text), self._typeface.line_px
        self._marks.bar(x - 3, y - 1, x + width + 3, y + height - 1, ground, 0.62)
        self._marks.text(x, y, text, colour)

    def _status(self, moment: Moment, view: View) -> None:
        look, typeface, area = self._look, self._typeface, self._layout.solid
        margin = self._layout.margin
        width = area.width - 2 * margin
        missing = [
            name for name, coil in zip(self._scene.names, moment.coils, strict=False) if np.isnan(coil).any()
        ]
        words = [f"{moment.time_s:.2f} s", STATUS_WORDS[PoseStatus(moment.status)]]
        if np.isfinite(moment.residual_mm):
            words.append(f"residual {moment.residual_mm:.2f} mm")
        ok = moment.status == PoseStatus.OK
        texts = [(self._scene.title, look.text), (" | ".join(words), look.faint_text if ok else look.warning)]
        if missing:
            texts.append((f"missing: {', '.join(missing)}", look.warning))
        texts += [(line, look.faint_text) for line in view.lines]
        rows = [(row, colour) for text, colour in texts for row in typeface.wrapped(text, width)]
        room = (area.height - 2 * margin) // typeface.line_px
        if len(rows) > room:
            rows = [*rows[: room - 1], (f"... {len(rows) - room + 1} more lines", look.faint_text)]
        for number, (row, colour) in enumerate(rows):
            self._backed(margin, margin + number * typeface.line_px, row, colour, look.background)

    def _legend(self, legend: Legend) -> None:
        look, typeface, marks, area = self._look, self._typeface, self._marks, self._layout.solid
        margin, steps = self._layout.margin, 24
        bottom = area.y + area.height - margin
        low, high = "0", f"{legend.most_mm:.0f} mm {legend.words}"
        marks.text(margin, bottom - typeface.line_px, low, look.text)
        left = margin + typeface.width(low) + 5
        right = left + min(0.25 * area.width, area.width - left - typeface.width(high) - margin)
        shares = np.linspace(0.0, 1.0, steps)[:, None]
        colours = (1 - shares) * legend.colours[0] + shares * legend.colours[1]
        edges = left + (right - left) * np.arange(steps + 1) / steps
        for step, colour in enumerate(colours):
            marks.bar(edges[step], bottom - typeface.line_px + 2, edges[step + 1], bottom - 3, colour)
        marks.text(right + 5, bottom - typeface.line_px, high, look.text)

    def _directions(self, flat: Projection) -> None:
        look, typeface, marks, area = self._look, self._typeface, self._marks, self._layout.flat
        bottom = area.y + area.height - typeface.line_px - 2
        marks.text(area.x + 6, bottom, "front", look.faint_text)
        back = "back"
        marks.text(area.x + area.width - 6 - typeface.width(back), bottom, back, look.faint_text)
        length = SCALE_MM * float(flat.pixels_per_mm(np.zeros((1, 3)))[0])
        words = f"{SCALE_MM:.0f} mm"
        left = area.x + 0.5 * (area.width - length)
        y = area.y + area.height - 5.0
        ends = np.array([[left, y, -1.0], [left + length, y, -1.0]])
        tick = np.array([0.0, 4.0, 0.0])
        marks.lines(ends[:1], ends[1:], 2.0, look.text)
        marks.lines(ends - tick, ends + tick, 1.0, look.text)
        marks.text(left + 0.5 * (length - typeface.width(words)), y - typeface.line_px - 3, words, look.text)

    @property
    def _bar_places(self) -> tuple[float, float, float, float]:
        """Left, right, the middle's height, and pixels per sigma."""
        area, typeface = self._layout.bars, self._typeface
        left = area.x + 12 + typeface.width("+3")
        top, bottom = area.y + typeface.line_px + 6.0, area.y + area.height - typeface.line_px
        return left, area.x + area.width - 6.0, 0.5 * (top + bottom), 0.5 * (bottom - top) / SIGMA_SHOWN

    def _scale_of_bars(self) -> None:
        look, typeface, marks, area = self._look, self._typeface, self._marks, self._layout.bars
        left, right, middle, per_sigma = self._bar_places
        marks.text(area.x + 6, area.y + 2, "pose weights in sigma", look.faint_text)
        for sigma in (SIGMA_MARK, 0.0, -SIGMA_MARK):
            y = middle - sigma * per_sigma
            words = f"{sigma:+.0f}" if sigma else "0"
            marks.text(left - 6 - typeface.width(words), y - 0.6 * typeface.size_px, words, look.faint_text)
            marks.polyline(np.array([[left, y, -1.0], [right, y, -1.0]]), 1.0, look.line)
        count = self._scene.model.pose.size
        step = (right - left) / count
        every = int(np.ceil(1.5 * typeface.width(str(count)) / step))
        for number in range(0, count, every):
            name = str(number + 1)
            x = left + (number + 0.5) * step - 0.5 * typeface.width(name)
            marks.text(x, area.y + area.height - typeface.line_px, name, look.faint_text)

    def _bars(self, moment: Moment) -> None:
        look, typeface, marks = self._look, self._typeface, self._marks
        left, right, middle, per_sigma = self._bar_places
        step = (right - left) / max(len(moment.normalised), 1)
        half = min(0.32 * step, 1.6 * typeface.size_px)
        reach = SIGMA_SHOWN * per_sigma
        for number, sigma in enumerate(moment.normalised.tolist()):
            x = left + (number + 0.5) * step
            end = middle - min(max(sigma * per_sigma, -reach), reach)
            colour = look.warning if abs(sigma) > SIGMA_MARK else look.bar
            marks.bar(x - half, min(middle, end), x + half, max(middle, end), colour)
            value = f"{sigma:+.1f}"
            if (width := typeface.width(value)) < 0.96 * step:
                y = (
                    max(end, middle - reach + 4) - typeface.line_px
                    if sigma >= 0
                    else min(end, middle + reach - 12)
                )
                marks.text(x - 0.5 * width, y, value, look.text)
