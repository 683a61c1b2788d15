"""The multilinear tongue model v(s, p) = mean + core x1 s x2 p, and one speaker's linear part of it.

Both are immutable values. Shapes: m speaker weights, n pose weights, V vertices, k = 3 V coordinates
(x0 y0 z0 x1 ...), all positions in mm in the model frame: x lateral, y front to back, z up, the
mid-sagittal plane at x = 0. (Paper, sections "Model construction" and "Model fitting".)
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import InputError
from .mesh import FloatArray, IndexArray, Mesh
from .tensor import mode_product


@dataclass(frozen=True)
class Mode:
    """The weights of one mode (speaker or pose) of a model.

    mean: (w,) the mean row of the training weights.
    entries: how many training speakers (or poses) the model was built from.
    training: (entries, w) the rows of U, or None where the file does not keep them.
    spectrum: (entries,) all eigenvalues of the mode's Gram matrix, descending, or None likewise.
    names: the training entries' names (speakers or prompts), empty where unknown.
    """

    mean: FloatArray
    entries: int
    training: FloatArray | None = None
    spectrum: FloatArray | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("mean", "training", "spectrum"):
            _freeze(self, name)
        if self.mean.ndim != 1 or not 1 <= len(self.mean) <= self.entries:
            raise InputError(
                f"a mode has {self.mean.size} weights for {self.entries} training entries; "
                "expected at least one and at most as many as entries."
            )
        if self.training is not None and self.training.shape != (self.entries, len(self.mean)):
            raise InputError(
                f"a mode's training weights have shape {self.training.shape}, "
                f"expected ({self.entries}, {len(self.mean)})."
            )
        if self.spectrum is not None and self.spectrum.shape != (self.entries,):
            raise InputError(
                f"a mode's spectrum has shape {self.spectrum.shape}, expected ({self.entries},)."
            )
        if self.names and len(self.names) != self.entries:
            raise InputError(f"a mode has {len(self.names)} names for {self.entries} training entries.")

    @property
    def size(self) -> int:
        return len(self.mean)

    @property
    def sigma(self) -> FloatArray:
        """(w,) 1/sqrt(entries) for every weight: the deviation as the authors' software publishes it."""
        return np.full(self.size, 1.0 / np.sqrt(self.entries))

    @property
    def measured_sigma(self) -> FloatArray | None:
        """(w,) the real deviation of each weight over the training entries; None without training weights."""
        return None if self.training is None else self.training.std(axis=0)

    def normalised(self, weights: ArrayLike) -> FloatArray:
        """Raw weights (..., w) in units of sigma from the mean: x stands for mean + x sigma."""
        return np.asarray((np.asarray(weights, dtype=np.float64) - self.mean) / self.sigma)

    def raw(self, normalised: ArrayLike) -> FloatArray:
        """The inverse of `normalised`."""
        return np.asarray(self.mean + np.asarray(normalised, dtype=np.float64) * self.sigma)

    def truncated(self, size: int) -> Mode:
        training = None if self.training is None else self.training[:, :size]
        return replace(self, mean=self.mean[:size], training=training)


@dataclass(frozen=True)
class SurfaceMarks:
    """What is known about single vertices of the template; every part may be empty.

    landmarks: name -> vertex; regions: name -> vertices (tip, blade, back, dorsum, lateral, ...);
    midsagittal: vertices of the upper surface in the mid-sagittal plane, ordered from tip to root.
    """

    landmarks: Mapping[str, int] = field(default_factory=dict)
    regions: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    midsagittal: tuple[int, ...] = ()


@dataclass(frozen=True)
class SpeakerModel:
    """One speaker: linear. vertices = base + coefficients @ directions.

    base: (k,) mm; directions: (K, k) mm per unit weight; faces: (f, 3); mean, sigma: (K,) of the
    coefficients; speaker_weights: the raw speaker weights that were fixed, empty for other estimators.
    """

    base: FloatArray
    directions: FloatArray
    faces: IndexArray
    mean: FloatArray
    sigma: FloatArray
    speaker_weights: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name in ("base", "directions", "faces", "mean", "sigma", "speaker_weights"):
            _freeze(self, name)

    @property
    def vertex_count(self) -> int:
        return len(self.base) // 3

    def vertices(self, coefficients: ArrayLike) -> FloatArray:
        """(V, 3) mm for coefficients (K,)."""
        return np.asarray((self.base + np.asarray(coefficients) @ self.directions).reshape(-1, 3))

    def mesh(self, coefficients: ArrayLike) -> Mesh:
        return Mesh(self.vertices(coefficients), self.faces)

    def at(self, vertices: Sequence[int]) -> SpeakerModel:
        """The same model seen only at these vertices, in this order; it has no faces."""
        rows = _coordinate_rows(vertices, self.vertex_count)
        return replace(
            self, base=self.base[rows], directions=self.directions[:, rows], faces=np.zeros((0, 3), np.int32)
        )


@dataclass(frozen=True)
class TongueModel:
    """The multilinear model of all speakers and poses.

    core: (m, n, k) mm; origin: (k,) mm, the mean of all training shapes; faces: (f, 3).
    provenance: where the model came from, as text, for people ("name", "source", "command", ...).
    """

    core: FloatArray
    origin: FloatArray
    faces: IndexArray
    speaker: Mode
    pose: Mode
    marks: SurfaceMarks = SurfaceMarks()
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("core", "origin", "faces"):
            _freeze(self, name)
        expected = (self.speaker.size, self.pose.size, self.origin.size)
        if self.core.shape != expected or self.origin.size % 3:
            raise InputError(
                f"a model's core has shape {self.core.shape}, expected {expected} "
                "(speaker weights, pose weights, vertex coordinates)."
            )

    @property
    def vertex_count(self) -> int:
        return self.origin.size // 3

    @property
    def name(self) -> str:
        return self.provenance.get("name", "unnamed model")

    @cached_property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that name these very numbers; poses refer to their model by it."""
        digest = hashlib.sha256()
        for array in (self.core, self.origin, self.speaker.mean, self.pose.mean, self.faces):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(f"{self.speaker.entries} {self.pose.entries}".encode())
        return digest.hexdigest()[:16]

    def vertices(self, speaker_weights: ArrayLike, pose_weights: ArrayLike) -> FloatArray:
        """(V, 3) mm for raw weights (m,) and (n,)."""
        directions = np.tensordot(np.asarray(speaker_weights, dtype=np.float64), self.core, axes=1)
        return np.asarray((self.origin + np.asarray(pose_weights) @ directions).reshape(-1, 3))

    def mean_vertices(self) -> FloatArray:
        """(V, 3) mm: the shape at the mean weights of both modes."""
        return self.vertices(self.speaker.mean, self.pose.mean)

    def for_speaker(self, speaker_weights: ArrayLike) -> SpeakerModel:
        """The linear model that is left when the speaker weights (m,) are fixed."""
        weights = np.asarray(speaker_weights, dtype=np.float64)
        if weights.shape != (self.speaker.size,):
            raise InputError(
                f"{weights.size} speaker weights were given, but the model '{self.name}' has {self.speaker.size}."
            )
        directions = mode_product(self.core, weights[None, :], 0)[0]
        return SpeakerModel(self.origin, directions, self.faces, self.pose.mean, self.pose.sigma, weights)

    def at(self, vertices: Sequence[int]) -> TongueModel:
        """The same model seen only at these vertices, in this order; it has no faces and no marks."""
        rows = _coordinate_rows(vertices, self.vertex_count)
        return replace(
            self,
            core=self.core[:, :, rows],
            origin=self.origin[rows],
            faces=np.zeros((0, 3), np.int32),
            marks=SurfaceMarks(),
        )

    def truncated(self, speaker_modes: int, pose_modes: int) -> TongueModel:
        """Keeps the leading weights of both modes."""
        for wanted, mode, name in ((speaker_modes, self.speaker, "speaker"), (pose_modes, self.pose, "pose")):
            if not 1 <= wanted <= mode.size:
                raise InputError(
                    f"{wanted} {name} modes were asked for; the model '{self.name}' has {mode.size}."
                )
        return replace(
            self,
            core=self.core[:speaker_modes, :pose_modes],
            speaker=self.speaker.truncated(speaker_modes),
            pose=self.pose.truncated(pose_modes),
        )


def _coordinate_rows(vertices: Sequence[int], vertex_count: int) -> NDArray[np.intp]:
    indices = np.asarray(vertices, dtype=np.intp)
    if indices.size and (indices.min() < 0 or indices.max() >= vertex_count):
        wrong = int(indices.max() if indices.max() >= vertex_count else indices.min())
        raise InputError(f"vertex {wrong} does not exist; the model has vertices 0 to {vertex_count - 1}.")
    return np.asarray((indices[:, None] * 3 + np.arange(3)).ravel())


def _freeze(owner: object, name: str) -> None:
    """Makes an array field contiguous and read-only, so that a model can be shared without copies."""
    array = getattr(owner, name)
    if array is None:
        return
    dtype = np.int32 if name == "faces" else np.float64
    frozen = np.ascontiguousarray(array, dtype=dtype)
    if frozen is array and array.flags.writeable or frozen.base is not None:
        frozen = frozen.copy()
    frozen.setflags(write=False)
    object.__setattr__(owner, name, frozen)
