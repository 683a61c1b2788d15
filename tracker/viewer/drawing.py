"""One moment of a scene as a picture: the tongue in three dimensions, the mid-sagittal cut beside it, the weights below.

The tongue's shapes stay on the graphics card (`surface`); what is projected here, in numpy, are the few dozen points
of the cut, the palate, the coils and their trails. Needs a context of OpenGL 3.3, whoever made it.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..pose import CoilState, FloatArray
from .camera import (
    Area,
    Layout,
    Projection,
    View,
    camera_axes,
    flat_projection,
    home_view,
    layout_of,
    solid_projection,
)
from .look import Look
from .markings import Legend, Markings, Section, Trails
from .overlay import MarkDrawer, Taken, Typeface
from .scene import Moment, Scene, palate_distance, vertex_uncertainty, weights_covariance
from .shaders import (
    GHOST_FRAGMENT,
    GHOST_VERTEX,
    TONGUE_FRAGMENT,
    TONGUE_VERTEX,
)
from .surface import Surface, SurfacePrograms

if TYPE_CHECKING:
    import moderngl

__all__ = ["Renderer", "View", "home_view"]

FAR_FROM_PALATE_MM = 10.0  # from here on all distances look the same
UNCERTAIN_MM = 3.0  # likewise
LONGEST_TRAIL_S = 10.0
BROKEN_TRAIL_S = 0.25  # longer without a moment, and a trail does not bridge it
TRAIL_STEP_S = 0.02
GRAIN_PX = 128
HIDDEN = 0.3  # how much is seen of a mark behind the tongue


class Renderer:
    """Draws moments of one scene, in one size, into any framebuffer of its context that has a depth buffer."""

    def __init__(self, context: moderngl.Context, scene: Scene, size: tuple[int, int], look: Look) -> None:
        self.scene, self.look = scene, look
        self._context = context
        self._programs = SurfacePrograms(context, scene.model)
        followed = np.concatenate([scene.outline.vertices, np.asarray(scene.correspondences, dtype=np.intp)])
        self._tongue, self._ghost = (Surface(self._programs, followed) for _ in range(2))
        self._tongue_program = context.program(TONGUE_VERTEX, fragment_shader=TONGUE_FRAGMENT)
        self._ghost_program = context.program(GHOST_VERTEX, fragment_shader=GHOST_FRAGMENT)
        self._values = context.buffer(np.full(scene.model.vertex_count, -1.0, dtype="f4").tobytes())
        self._tongue_array = self._tongue.drawn_by(self._tongue_program, self._values)
        self._ghost_array = self._ghost.drawn_by(self._ghost_program, self._values)
        self._grain = context.texture((GRAIN_PX, GRAIN_PX), 2, grain().tobytes())
        self._drawer = MarkDrawer(context)
        self._past: deque[tuple[float, FloatArray]] = deque()
        self._coloured_by: object = None
        self._typeface: Typeface | None = None
        self._set_constants()
        self.resize(size)

    def resize(self, size: tuple[int, int]) -> None:
        """From now on pictures are this large (width, height)."""
        self.size = (max(1, size[0]), max(1, size[1]))
        self.layout: Layout = layout_of(self.size, self.look)
        if self._typeface is None or self._typeface.size_px != self.layout.font_px:
            if self._typeface is not None:
                self._typeface.release()
            self._typeface = Typeface(self._context, self.layout.font_px)
        self._markings = Markings(self.scene, self.look, self.layout, self._typeface)
        self._flat_projection = flat_projection(self.scene, self.layout.flat, 2.2 * self.layout.font_px)

    def remember(self, moment: Moment) -> None:
        """Lets the coils' trails pass here. `draw` does it itself; for a single picture of a later moment, the
        moments before it are handed over one by one."""
        past, now = self._past, moment.time_s
        if past and not past[-1][0] <= now <= past[-1][0] + BROKEN_TRAIL_S:
            past.clear()
        if not past or now >= past[-1][0] + TRAIL_STEP_S:
            past.append((now, np.array(moment.coils)))
        while past[0][0] < now - LONGEST_TRAIL_S:
            past.popleft()

    def draw(self, moment: Moment, view: View, framebuffer: moderngl.Framebuffer) -> None:
        """Draws the whole picture; the framebuffer is as large as `size` says."""
        self.remember(moment)
        self._tongue.show(moment)
        if view.ghost is not None:
            self._ghost.show(view.ghost)
        legend = self._colour(moment, view)
        solid = solid_projection(view, self.layout.solid)
        tongue = self._section(self._tongue)
        ghost = None if view.ghost is None else self._section(self._ghost)
        context = self._context
        self._draw_tongue(framebuffer, view, solid, legend is not None)
        # A software rasteriser starts when the target changes: now, while the marks are put together.
        self._programs.aside.clear()
        trails = self._trails(moment, view)
        in_space = self._markings.in_space(moment, solid, tongue, trails)
        in_plane = self._markings.in_plane(moment, self._flat_projection, tongue, ghost, trails)
        around = self._markings.around(moment, view, solid, self._flat_projection, legend)

        framebuffer.use()
        context.enable(context.BLEND)
        context.blend_func = context.SRC_ALPHA, context.ONE_MINUS_SRC_ALPHA
        self._limit(framebuffer, self.layout.solid)
        self._draw_marks(in_space.faint(HIDDEN))
        context.enable(context.DEPTH_TEST)
        self._draw_marks(in_space)
        context.disable(context.DEPTH_TEST)
        self._limit(framebuffer, self.layout.flat)
        self._draw_marks(in_plane)
        self._limit(framebuffer, None)
        self._draw_marks(around)
        framebuffer.depth_mask = True

    def _section(self, tongue: Surface) -> Section:
        points = tongue.followed()
        ends = len(self.scene.outline.vertices)
        return Section(self.scene.outline.points(points[:ends]), points[ends:])

    def _draw_tongue(
        self, framebuffer: moderngl.Framebuffer, view: View, solid: Projection, by_value: bool
    ) -> None:
        """The ground, the tongue, and the ghost over it."""
        context, area = self._context, self.layout.solid
        framebuffer.use()
        framebuffer.depth_mask = True
        self._limit(framebuffer, None)
        framebuffer.clear(*self.look.background, depth=1.0)
        self._limit(framebuffer, area)
        framebuffer.viewport = self._from_below(area)
        for program in (self._tongue_program, self._ghost_program):
            program["to_clip"] = tuple(solid.matrix.T.ravel())
            program["to_camera"] = tuple(camera_axes(view).T.ravel())
        self._tongue_program["by_value"] = int(by_value)
        self._grain.use(0)
        context.disable(context.BLEND | context.CULL_FACE)
        context.enable(context.DEPTH_TEST)
        self._tongue_array.render()
        framebuffer.depth_mask = False
        if view.ghost is not None:
            context.enable(context.BLEND | context.CULL_FACE)
            context.blend_func = context.SRC_ALPHA, context.ONE_MINUS_SRC_ALPHA
            self._ghost_array.render()
        context.disable(context.DEPTH_TEST | context.CULL_FACE)
        framebuffer.viewport = (0, 0, *self.size)

    def _draw_marks(self, marks: Taken) -> None:
        assert self._typeface is not None
        self._drawer.draw(marks, self.size, self._typeface.atlas)

    def _limit(self, framebuffer: moderngl.Framebuffer, area: Area | None) -> None:
        """Nothing is drawn outside the area; None = the whole picture."""
        framebuffer.viewport = (0, 0, *self.size)
        framebuffer.scissor = framebuffer.viewport if area is None else self._from_below(area)

    def _from_below(self, area: Area) -> tuple[int, int, int, int]:
        """The area as OpenGL counts: from the lower left corner."""
        return area.x, self.size[1] - area.y - area.height, area.width, area.height

    def _trails(self, moment: Moment, view: View) -> Trails | None:
        """Where the coils were within the view's time, the present place at the end; None = nowhere else."""
        kept = [(time, coils) for time, coils in self._past if time >= moment.time_s - view.trail_s]
        if view.trail_s <= 0 or len(kept) < 2 or not len(moment.coils):
            return None
        ages = (moment.time_s - np.array([time for time, _ in kept])) / view.trail_s
        return Trails(np.array([*(coils for _, coils in kept[:-1]), moment.coils]), ages)

    def _colour(self, moment: Moment, view: View) -> Legend | None:
        """Brings the vertices' values up to date; None = the tongue has its own colour."""
        look, tongue = self.look, self._tongue
        if view.colour_by == "palate" and self.scene.palate is not None:
            legend = Legend("to the palate", FAR_FROM_PALATE_MM, (look.near, look.far))
            key: object = (view.colour_by, moment.weights.tobytes(), moment.speaker_weights.tobytes())
            if key != self._coloured_by:
                self._write_values(palate_distance(tongue.vertices(), self.scene.palate), legend)
        elif view.colour_by == "uncertainty":
            legend = Legend("uncertain (1 sigma)", UNCERTAIN_MM, (look.far, look.near))
            seen = trusted_vertices(self.scene, moment)
            key = (view.colour_by, seen, moment.speaker_weights.tobytes())
            if key != self._coloured_by:
                covariance = weights_covariance(tongue.speaker, seen)
                self._write_values(vertex_uncertainty(tongue.speaker, covariance), legend)
        else:
            return None
        self._coloured_by = key
        return legend

    def _write_values(self, values_mm: FloatArray, legend: Legend) -> None:
        """values_mm: (V,), NaN = unknown."""
        shares = np.where(np.isnan(values_mm), -1.0, np.clip(values_mm / legend.most_mm, 0.0, 1.0))
        self._values.write(shares.astype("f4").tobytes())
        program = self._tongue_program
        program["near_colour"], program["far_colour"] = legend.colours

    def _set_constants(self) -> None:
        look = self.look
        tongue = self._tongue_program
        tongue["grain"] = 0
        tongue["tissue"], tongue["inside"] = look.tissue, look.inside
        tongue["unknown"] = look.unknown
        tongue["ambient"] = look.ambient
        lights = (look.key, look.fill)
        ways = [np.array(light.direction) / np.linalg.norm(light.direction) for light in lights]
        tongue["light_ways"] = [tuple(way) for way in ways]
        tongue["light_colours"] = [light.colour for light in lights]
        between = ways[0] + (0.0, 0.0, 1.0)
        tongue["between"] = tuple(between / np.linalg.norm(between))
        self._ghost_program["tint"] = look.ghost

    def release(self) -> None:
        """Gives everything on the graphics card back."""
        if self._typeface is not None:
            self._typeface.release()
        things = (
            self._drawer, self._tongue, self._ghost, self._tongue_array, self._ghost_array,
            self._values, self._grain, self._tongue_program,
            self._ghost_program, self._programs,
        )  # fmt: skip
        for thing in things:
            thing.release()


def trusted_vertices(scene: Scene, moment: Moment) -> tuple[int, ...]:
    """The vertices whose coils had a part in the pose."""
    coils = zip(scene.correspondences, moment.coils, moment.coil_states, strict=False)
    return tuple(v for v, place, state in coils if state == CoilState.TRUSTED and np.isfinite(place).all())


def grain() -> NDArray[np.uint8]:
    """(n, n, 2) the surface's unevenness, repeating in both directions: its brightness, as bumps and blotches make it,
    and how much of the gloss it throws back; 128 = as if it were even."""
    random = np.random.default_rng(1)
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(GRAIN_PX) * GRAIN_PX] * 2))

    def noise(around: float) -> FloatArray:
        spectrum = np.fft.fft2(random.normal(size=(GRAIN_PX, GRAIN_PX)))
        heights = np.fft.ifft2(spectrum * np.exp(-(((frequency - around) / (0.5 * around)) ** 2))).real
        return np.asarray(heights / heights.std())

    bumps, blotches = noise(22.0), noise(5.0)
    slope = bumps - np.roll(bumps, (1, 1), axis=(0, 1))  # towards the light
    brightness = 1.0 + 0.06 * slope / slope.std() + 0.05 * blotches
    gloss = 1.0 + 0.28 * slope / slope.std()
    return np.clip(128 * np.stack([brightness, gloss], axis=-1), 0, 255).astype(np.uint8)
