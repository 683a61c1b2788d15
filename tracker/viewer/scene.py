"""What is to be seen, as numbers: the speaker's set-up once, and one moment of it for every picture.

Nothing here draws. The windows, the films and the offscreen pictures are made of a `Scene` and `Moment`s; all
positions are in mm in the model frame (x lateral, y front to back, z up), the mid-sagittal plane is x = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import overload

import numpy as np
from numpy.typing import NDArray

from ... import InputError
from ...model.mesh import IndexArray
from ...model.midsagittal import midsagittal_vertices
from ...model.multilinear import SpeakerModel, TongueModel
from ..pose import CoilState, FloatArray, PoseStatus, TrackedPose, TrackedPoses
from ..session import Session

LEAST_NOISE_MM = 0.5
"""A coil is never believed better than this: what articulographs reach in a mouth."""
STATUS_WORDS = {
    PoseStatus.LOST: "lost",
    PoseStatus.OK: "tracked",
    PoseStatus.HELD: "held: no coils in this frame",
    PoseStatus.RELAXING: "relaxing: no coils",
}
COIL_WORDS = {
    CoilState.WILD: "wild",
    CoilState.MISFIT: "misfit",
    CoilState.STUCK: "stuck",
    CoilState.RETURNING: "returning",
}


@dataclass(frozen=True)
class Outline:
    """The cut of a mesh with the mid-sagittal plane, a line whose points lie on edges of the mesh.

    edges: (s, 2) the vertices of the edge that each point lies on; shares: (s,) how far along it, 0 to 1. A point
    moves with its edge: it is (1 - share) first + share second in every pose.
    """

    edges: IndexArray
    shares: FloatArray

    @cached_property
    def vertices(self) -> NDArray[np.intp]:
        """(2 s,) all vertices of `points`, first ends before second ends."""
        return np.asarray(self.edges.T.ravel(), dtype=np.intp)

    def points(self, ends: FloatArray) -> FloatArray:
        """(s, 3) from the positions (2 s, 3) of `vertices`."""
        first, second = np.split(ends, 2)
        return np.asarray(first + self.shares[:, None] * (second - first))


@dataclass(frozen=True)
class Scene:
    """Everything that does not change while poses come and go.

    contour: (c,) vertices of the upper surface in the mid-sagittal plane, tip to root.
    roles, correspondences: the tracked coils, and the vertex that each is held to.
    palate: (p, 3) mm, front to back, or None; title: what this is, for people; speaker_weights: (m,) of the speaker
    who is to fit into the picture, None = not known.
    """

    model: TongueModel
    contour: NDArray[np.intp]
    roles: tuple[str, ...]
    correspondences: tuple[int, ...]
    palate: FloatArray | None
    title: str
    speaker_weights: FloatArray | None = None

    def __post_init__(self) -> None:
        if len(self.roles) != len(self.correspondences):
            raise InputError(f"{len(self.roles)} coils were named, but {len(self.correspondences)} vertices.")
        wrong = [vertex for vertex in self.correspondences if not 0 <= vertex < self.model.vertex_count]
        if wrong:
            raise InputError(
                f"vertex {wrong[0]} does not exist: the model has vertices 0 to {self.model.vertex_count - 1}."
            )
        if self.speaker_weights is not None and self.speaker_weights.shape != (self.model.speaker.size,):
            raise InputError(
                f"{self.speaker_weights.size} speaker weights were given, but the model '{self.model.name}' has "
                f"{self.model.speaker.size}."
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The coils' names as they stand in a picture: "tip" for the role tongue_tip."""
        return tuple(role.removeprefix("tongue_").replace("_", " ") for role in self.roles)

    @cached_property
    def outline(self) -> Outline:
        return midsagittal_outline(self.model.mean_vertices(), self.model.faces, self.contour)

    @cached_property
    def extent(self) -> FloatArray:
        """(2, 3) mm, lowest and highest corner: where the speaker's tongue can be, and the palate.

        Two sigma of each pose direction; where the speaker is not known, also one of each speaker direction.
        """
        stated, some = self.speaker_weights, self.model.speaker
        speakers = [stated] if stated is not None else [some.mean, *_aside(some.mean, some.sigma)]
        shapes = []
        for speaker in map(self.model.for_speaker, speakers):
            poses = [speaker.mean, *_aside(speaker.mean, 2.0 * speaker.sigma)]
            shapes += [speaker.vertices(weights) for weights in poses]
        points = np.concatenate(shapes if self.palate is None else [*shapes, self.palate])
        return np.array([points.min(axis=0), points.max(axis=0)])


def _aside(mean: FloatArray, reach: FloatArray) -> list[FloatArray]:
    """The mean (K,), with each coefficient in turn less and more by its reach (K,)."""
    steps = np.diag(reach)
    return [mean + step for step in (*-steps, *steps)]


@dataclass
class Moment:
    """One instant, complete: what a picture is made of besides the scene.

    weights, normalised: (K,) raw, and in sigma; speaker_weights: (m,) raw; coils: (n, 3) mm, NaN = missing;
    residuals_mm: (n,), NaN = missing; coil_states: (n,) `CoilState`; status: a `PoseStatus`;
    residual_mm: mean of the trusted coils, NaN without any; time_s: of the source.
    """

    weights: FloatArray
    normalised: FloatArray
    speaker_weights: FloatArray
    coils: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    residuals_mm: FloatArray = field(default_factory=lambda: np.zeros(0))
    coil_states: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    status: int = PoseStatus.OK
    residual_mm: float = float("nan")
    time_s: float = 0.0


def scene_of(
    model: TongueModel, session: Session, roles: Sequence[str], correspondences: Sequence[int], title: str
) -> Scene:
    """The scene of a session. Raises InputError where a vertex or the speaker is none of the model's."""
    palate = None if session.palate is None else session.palate.line
    contour = midsagittal_vertices(model)
    return Scene(model, contour, tuple(roles), tuple(correspondences), palate, title, session.speaker_weights)


def moment_of(pose: TrackedPose) -> Moment:
    """A copy of the pose, which nothing writes over."""
    return Moment(
        pose.weights.copy(),
        pose.normalised.copy(),
        pose.speaker_weights.copy(),
        pose.coils.copy(),
        pose.residuals_mm.copy(),
        pose.coil_states.copy(),
        int(pose.status),
        float(pose.residual_mm),
        float(pose.device_time_s),
    )


class Moments(Sequence[Moment]):
    """A whole take's moments, each made when it is asked for."""

    def __init__(self, poses: TrackedPoses) -> None:
        self.times_s = poses.times_s
        self._poses = poses

    @cached_property
    def step_s(self) -> float:
        """s from one frame to the next, as most of them are; 0 where there is one only."""
        return float(np.median(np.diff(self.times_s))) if len(self) > 1 else 0.0

    def __len__(self) -> int:
        return self._poses.frame_count

    @overload
    def __getitem__(self, index: int) -> Moment: ...
    @overload
    def __getitem__(self, index: slice) -> list[Moment]: ...
    def __getitem__(self, index: int | slice) -> Moment | list[Moment]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        poses = self._poses
        missing = np.isnan(poses.coils[index]).any(axis=-1)
        known = CoilState.TRUSTED if poses.coil_states is None else poses.coil_states[index]
        return Moment(
            poses.weights[index],
            poses.normalised[index],
            poses.speaker_weights[index],
            poses.coils[index],
            poses.residuals_mm[index],
            np.where(missing, CoilState.MISSING, known),
            int(poses.statuses[index]),
            float(poses.residual_mm[index]),
            float(poses.times_s[index]),
        )


def moments_of(poses: TrackedPoses) -> Moments:
    """The moments of a file's poses; where it does not keep which coils were trusted, those present count as trusted."""
    return Moments(poses)


def palate_distance(vertices: FloatArray, palate: FloatArray | None) -> FloatArray:
    """(V,) mm by which vertices (V, 3) lie below the palate (p, 3), straight upwards; negative above it.

    NaN where there is no palate. The curve is mid-sagittal: at the sides, where a palate is lower, it says too much.
    """
    if palate is None:
        return np.full(len(vertices), np.nan)
    height = np.interp(vertices[:, 1], palate[:, 1], palate[:, 2], left=np.nan, right=np.nan)
    return np.asarray(height - vertices[:, 2])


def weights_covariance(
    speaker: SpeakerModel, coils: Sequence[int], noise_mm: float = LEAST_NOISE_MM
) -> FloatArray:
    """(K, K) of the coefficients once coils at these vertices were seen: a Gaussian posterior.

    The prior is the model's own sigma, the noise `noise_mm` per coordinate. Without coils it is the prior.
    """
    directions = speaker.at(coils).directions  # (K, 3 n)
    information = np.diag(speaker.sigma**-2.0) + directions @ directions.T / noise_mm**2
    return np.asarray(np.linalg.inv(information))


def vertex_uncertainty(speaker: SpeakerModel, covariance: FloatArray) -> FloatArray:
    """(V,) mm: one standard deviation of each vertex in all three directions together, the root of the trace of its
    covariance, when the coefficients have this one (K, K)."""
    roots = np.linalg.cholesky(covariance).T @ speaker.directions  # (K, 3 V)
    return np.asarray(np.sqrt((roots**2).reshape(len(roots), -1, 3).sum(axis=(0, 2))))


def midsagittal_outline(vertices: FloatArray, faces: IndexArray, contour: NDArray[np.intp]) -> Outline:
    """The longest line in which the plane x = 0 cuts a mesh (V, 3), (f, 3).

    A mesh that the plane does not cut has the contour (c,), vertices tip to root, instead.
    """
    beyond = vertices[:, 0] >= 0  # a vertex in the plane counts as beyond it, so that every cut crosses edges
    segments: list[tuple[tuple[int, int], tuple[int, int]]] = []
    mixed = beyond[faces].any(axis=1) & ~beyond[faces].all(axis=1)
    for face in faces[mixed].tolist():
        pairs = ((face[0], face[1]), (face[1], face[2]), (face[2], face[0]))
        crossed = [(min(a, b), max(a, b)) for a, b in pairs if beyond[a] != beyond[b]]
        segments.append((crossed[0], crossed[1]))
    if not segments:
        return Outline(np.column_stack([contour, contour]).astype(np.int32), np.zeros(len(contour)))
    lines = [np.array(line) for line in _joined(segments)]
    outlines = [_without_repeats(line, vertices) for line in lines]
    return max(outlines, key=lambda outline: _length(outline.points(vertices[outline.vertices])))


def _joined(segments: list[tuple[tuple[int, int], tuple[int, int]]]) -> list[list[tuple[int, int]]]:
    """Segments joined at their common ends, as lines of ends."""
    at: dict[tuple[int, int], list[int]] = {}
    for number, segment in enumerate(segments):
        for end in segment:
            at.setdefault(end, []).append(number)
    left = set(range(len(segments)))
    lines = []
    loose_ends = [end for end, numbers in at.items() if len(numbers) == 1]
    for start in [*loose_ends, *at]:  # open lines from their ends, then closed ones from anywhere
        line = [start]
        while onwards := [number for number in at[line[-1]] if number in left]:
            left.discard(onwards[0])
            first, second = segments[onwards[0]]
            line.append(second if first == line[-1] else first)
        if len(line) > 1:
            lines.append(line)
    return lines


def _without_repeats(edges: NDArray[np.int64], vertices: FloatArray) -> Outline:
    """Edges (s, 2) as an outline; where several meet in one vertex of the plane, that vertex once."""
    first, second = vertices[edges[:, 0], 0], vertices[edges[:, 1], 0]
    outline = Outline(edges.astype(np.int32), first / (first - second))
    points = outline.points(vertices[outline.vertices])
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    kept = np.concatenate([[True], moved])
    return Outline(outline.edges[kept], outline.shares[kept])


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
