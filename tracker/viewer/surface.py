"""A tongue on the graphics card: its shapes go up once for a speaker, afterwards only the weights of each pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...model.mesh import IndexArray
from ...model.multilinear import SpeakerModel, TongueModel
from ..pose import FloatArray
from .scene import Moment
from .shaders import NORMALS_VERTEX, POSITIONS_VERTEX, TEXTURE_WIDTH

if TYPE_CHECKING:
    import moderngl

GRAIN_MM = 24.0  # so far apart the grain of the surface repeats
RADIUS_MM = 28.0  # of a tongue, roughly


class SurfacePrograms:
    """What all surfaces of one model share: programmes, faces, and which faces surround each vertex."""

    def __init__(self, context: moderngl.Context, model: TongueModel) -> None:
        self.context = context
        self.model = model
        self.rows = -(-model.vertex_count // TEXTURE_WIDTH)
        self.positions = context.program(POSITIONS_VERTEX, varyings=("position",))
        self.normals = context.program(NORMALS_VERTEX, varyings=("normal",))
        self.aside = context.simple_framebuffer((1, 1))
        """OpenGL runs no programme while there is nothing that could be drawn into."""
        pairs = ring_pairs(model.faces, model.vertex_count)
        self.ring = context.texture(
            (TEXTURE_WIDTH, self.rows * len(pairs)), 2, self.layers(pairs, fill=-1).tobytes(), dtype="i4"
        )
        self.faces = context.buffer(np.ascontiguousarray(model.faces, dtype="i4").tobytes())
        self.skin = context.buffer(unrolled(model.mean_vertices()).astype("f4").tobytes())
        for program in (self.positions, self.normals):
            program["rows"] = self.rows
        self.positions["shapes"], self.positions["weights"] = 0, 1
        self.normals["positions"], self.normals["ring"] = 0, 1

    def layers(self, values: NDArray[np.generic], fill: float = 0) -> NDArray[np.generic]:
        """(n * rows, width, c) as it lies in a texture, from values (n, V, c)."""
        count, vertices, parts = values.shape
        spread = np.full((count, self.rows * TEXTURE_WIDTH, parts), fill, dtype=values.dtype)
        spread[:, :vertices] = values
        return spread.reshape(count * self.rows, TEXTURE_WIDTH, parts)

    def release(self) -> None:
        for thing in (self.aside, self.positions, self.normals, self.ring, self.faces, self.skin):
            thing.release()


class Surface:
    """One tongue: positions and normals, (V, 4) float32 in buffers, made there from the weights of a moment."""

    def __init__(self, programs: SurfacePrograms, followed: NDArray[np.intp]) -> None:
        """followed: vertices whose positions are wanted here as well."""
        context = programs.context
        self._followed_vertices = followed
        self._room = TEXTURE_WIDTH * programs.rows
        self.positions, self.normals = (context.buffer(reserve=16 * self._room) for _ in range(2))
        self._neighbours = context.texture((TEXTURE_WIDTH, programs.rows), 4, dtype="f4")
        self._passes = [
            context.vertex_array(program, []) for program in (programs.positions, programs.normals)
        ]
        self._programs = programs
        model = programs.model
        shapes = 1 + model.pose.size
        self._shapes = context.texture((TEXTURE_WIDTH, programs.rows * shapes), 4, dtype="f4")
        self._weights = context.texture((model.pose.size, 1), 1, dtype="f4", alignment=1)
        for texture in (self._neighbours, self._shapes, self._weights):
            texture.filter = (context.NEAREST, context.NEAREST)
        self._shown = np.zeros(0)
        self._change_speaker(model.for_speaker(model.speaker.mean))

    def show(self, moment: Moment) -> None:
        """Brings the tongue into the moment's pose."""
        if not np.array_equal(moment.speaker_weights, self.speaker.speaker_weights):
            self._change_speaker(self._programs.model.for_speaker(moment.speaker_weights))
        if np.array_equal(moment.weights, self._shown):
            return
        points = self._programs.context.POINTS
        self._programs.aside.use()
        positions, normals = self._passes
        self._weights.write(np.asarray(moment.weights, dtype="f4").tobytes())
        self._shapes.use(0)
        self._weights.use(1)
        positions.transform(self.positions, mode=points, vertices=self._room)
        self._neighbours.write(self.positions)
        self._neighbours.use(0)
        self._programs.ring.use(1)
        normals.transform(self.normals, mode=points, vertices=self._room)
        self._shown = np.array(moment.weights)

    def vertices(self) -> FloatArray:
        """(V, 3) mm, computed here, not read back."""
        return self.speaker.vertices(self._shown)

    def followed(self) -> FloatArray:
        """(f, 3) mm, of the followed vertices alone."""
        return self._followed_model.vertices(self._shown)

    def _change_speaker(self, speaker: SpeakerModel) -> None:
        shapes = np.concatenate([speaker.base[None], speaker.directions])
        corners = shapes.reshape(len(shapes), -1, 3).astype("f4")
        self._shapes.write(self._programs.layers(np.pad(corners, ((0, 0), (0, 0), (0, 1)))).tobytes())
        self.speaker = speaker
        self._followed_model = speaker.at(self._followed_vertices.tolist())
        self._shown = np.zeros(0)

    def drawn_by(self, program: moderngl.Program, values: moderngl.Buffer) -> moderngl.VertexArray:
        """The faces for a programme that takes any of a vertex's position, normal, place in the grain, and value."""
        parts = [
            (buffer, kind, name)
            for buffer, kind, name in (
                (self.positions, "4f", "in_position"),
                (self.normals, "4f", "in_normal"),
                (self._programs.skin, "2f", "in_skin"),
                (values, "1f", "in_value"),
            )
            if name in program
        ]
        faces = self._programs.faces
        return self._programs.context.vertex_array(program, parts, index_buffer=faces, index_element_size=4)

    def release(self) -> None:
        for vertex_array in self._passes:
            vertex_array.release()
        for texture in (self._neighbours, self._shapes, self._weights):
            texture.release()
        for buffer in (self.positions, self.normals):
            buffer.release()


def unrolled(vertices: FloatArray) -> FloatArray:
    """(V, 2) where each vertex (V, 3) lies in the grain, which repeats every 1: the surface seen from its middle, laid
    flat by Lambert's projection, which keeps areas; it tears only below, where a tongue is open."""
    away = vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    flat = away[:, :2] * np.sqrt(2.0 / np.maximum(1.0 + away[:, 2:], 1e-3))
    return np.asarray(flat * RADIUS_MM / GRAIN_MM)


def ring_pairs(faces: IndexArray, vertex_count: int) -> NDArray[np.int32]:
    """(r, V, 2) the two other corners of each face at each vertex, in the face's order, -1 = it has no more.

    faces: (f, 3); r: the most faces that meet in one vertex, at least 1.
    """
    corners = faces.ravel()
    others = np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=-1).reshape(-1, 2)
    order = np.argsort(corners, kind="stable")
    counts = np.bincount(corners, minlength=vertex_count)
    place = np.arange(len(corners)) - np.repeat(np.cumsum(counts) - counts, counts)
    pairs = np.full((max(1, int(counts.max(initial=0))), vertex_count, 2), -1, dtype=np.int32)
    pairs[place, corners[order]] = others[order]
    return pairs
