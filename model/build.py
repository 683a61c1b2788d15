"""A multilinear model from a database of registered meshes (paper, section "Multilinear tongue model")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import InputError, __version__
from .mesh import FloatArray, IndexArray, Mesh, read_mesh
from .multilinear import Mode, SurfaceMarks, TongueModel
from .tensor import Hosvd, hosvd

MAX_DATABASE_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True)
class SampleDatabase:
    """Which mesh file holds which speaker's which phone.

    paths: speaker -> prompt -> mesh file; a prompt that a speaker lacks is a missing cell.
    """

    speakers: tuple[str, ...]
    prompts: tuple[str, ...]
    paths: Mapping[str, Mapping[str, Path]]
    marks: SurfaceMarks = field(default_factory=SurfaceMarks)
    provenance: str = ""
    source: str = ""


@dataclass(frozen=True)
class TrainingShapes:
    """tensor: (speakers, prompts, k) mm, complete; filled: the cells that were averaged, not measured."""

    tensor: FloatArray
    faces: IndexArray
    speakers: tuple[str, ...]
    prompts: tuple[str, ...]
    filled: tuple[tuple[str, str], ...] = ()
    marks: SurfaceMarks = field(default_factory=SurfaceMarks)
    provenance: Mapping[str, str] = field(default_factory=dict)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(speakers, prompts): which cells are meshes, not averages."""
        measured = np.ones(self.tensor.shape[:2], dtype=bool)
        for speaker, prompt in self.filled:
            measured[self.speakers.index(speaker), self.prompts.index(prompt)] = False
        return measured

    @property
    def source(self) -> str:
        """What to call these shapes in a message."""
        return self.provenance.get("source", "the training shapes")


def read_sample_database(path: str | Path) -> SampleDatabase:
    """Reads the published sample database: meta {speakerAmount, phonemeAmount}, data [{name, phonemes}].

    Ours may add `template` (landmarks, regions, midsagittal) and `provenance`. Mesh paths are
    relative to the database. Raises InputError with the entry at fault.
    """
    path = Path(path)
    content = _load_yaml(path)
    try:
        entries = content["data"]
        speaker_amount = int(content["meta"]["speakerAmount"])
        prompt_amount = int(content["meta"]["phonemeAmount"])
        listed = [
            (str(e["name"]), [(str(p["prompt"]), p.get("path")) for p in e["phonemes"]]) for e in entries
        ]
    except (KeyError, TypeError, ValueError, AttributeError) as reason:
        raise InputError(
            f"{path}: this is not a sample database; expected meta {{speakerAmount, phonemeAmount}} and "
            f"data [{{name, phonemes: [{{prompt, path}}]}}] ({type(reason).__name__}: {reason})."
        ) from reason
    paths: dict[str, dict[str, Path]] = {}
    seen_with: dict[str, list[str]] = {}
    for speaker, phones in listed:
        if speaker in paths:
            raise InputError(f"{path}: the speaker '{speaker}' is listed twice.")
        paths[speaker] = {}
        for prompt, mesh_path in phones:
            if prompt in paths[speaker]:
                raise InputError(f"{path}: speaker '{speaker}' lists the prompt '{prompt}' twice.")
            seen_with.setdefault(prompt, []).append(speaker)
            if mesh_path is not None:
                paths[speaker][prompt] = path.parent / str(mesh_path)
    if len(paths) != speaker_amount:
        raise InputError(
            f"{path}: meta says {speaker_amount} speakers, but data lists {len(paths)}; make them agree."
        )
    if len(seen_with) > prompt_amount:
        rarest = min(seen_with, key=lambda prompt: len(seen_with[prompt]))
        known = ", ".join(prompt for prompt in seen_with if prompt != rarest)
        raise InputError(
            f"{path}: unknown prompt '{rarest}' of speaker '{seen_with[rarest][0]}': meta says {prompt_amount} "
            f"prompts, but data lists {len(seen_with)}. The others are: {known}."
        )
    if len(seen_with) < prompt_amount:
        raise InputError(
            f"{path}: meta says {prompt_amount} prompts, but data lists only {len(seen_with)}: "
            f"{', '.join(seen_with)}."
        )
    return SampleDatabase(
        tuple(paths),
        tuple(seen_with),
        paths,
        _read_marks(content.get("template"), path),
        str(content.get("provenance", "")),
        str(path),
    )


def load_training_shapes(database: SampleDatabase) -> TrainingShapes:
    """Reads all meshes, checks that they share one face list, and fills missing cells by averaging."""
    meshes: dict[tuple[str, str], Mesh] = {}
    first: tuple[Path, Mesh] | None = None
    for speaker in database.speakers:
        for prompt, path in database.paths[speaker].items():
            try:
                mesh = read_mesh(path)
            except InputError as reason:
                raise InputError(
                    f"{reason} (speaker '{speaker}', prompt '{prompt}' of {database.source})"
                ) from None
            if first is None:
                first = (path, mesh)
            _check_same_faces(path, mesh, *first)
            meshes[speaker, prompt] = mesh
    if first is None:
        raise InputError(f"{database.source}: the database names no mesh at all.")
    shape = (len(database.speakers), len(database.prompts), first[1].vertices.size)
    tensor = np.full(shape, np.nan)
    for (speaker, prompt), mesh in meshes.items():
        cell = database.speakers.index(speaker), database.prompts.index(prompt)
        tensor[cell] = mesh.vertices.ravel()
    _check_marks(database.marks, len(first[1].vertices), database.source)
    complete, missing = fill_missing_by_averaging(tensor)
    filled = tuple((database.speakers[i], database.prompts[j]) for i, j in missing)
    return TrainingShapes(
        complete,
        first[1].faces,
        database.speakers,
        database.prompts,
        filled,
        database.marks,
        {"source": database.source, "data": database.provenance},
    )


def fill_missing_by_averaging(tensor: FloatArray) -> tuple[FloatArray, list[tuple[int, int]]]:
    """Fills absent cells of a (speakers, poses, k) tensor, marked by NaN, as the paper does.

    A cell becomes the average of the speaker's own mean shape and of the pose's mean shape over the
    other speakers, both over measured shapes only. Raises InputError where one of them does not exist.
    """
    present = np.asarray(~np.isnan(tensor).any(axis=2))  # (speakers, poses)
    complete = tensor.copy()
    missing = [(int(i), int(j)) for i, j in np.argwhere(~present)]
    for speaker, pose in missing:
        if not present[speaker].any() or not present[:, pose].any():
            what = f"speaker {speaker}" if not present[speaker].any() else f"pose {pose}"
            raise InputError(
                f"{what} (counted from 0) has no mesh at all, so nothing can be averaged for it."
            )
        own = tensor[speaker, present[speaker]].mean(axis=0)
        others = tensor[present[:, pose], pose].mean(axis=0)
        complete[speaker, pose] = 0.5 * (own + others)
    return complete, missing


def model_from_shapes(
    shapes: TrainingShapes, speaker_modes: int, pose_modes: int, provenance: Mapping[str, str] | None = None
) -> TongueModel:
    """Centres on the mean of all shapes, decomposes, truncates."""
    speakers, poses, _ = shapes.tensor.shape
    for wanted, most, name in ((speaker_modes, speakers, "speaker"), (pose_modes, poses, "pose")):
        if not 1 <= wanted <= most:
            raise InputError(
                f"--{name}-modes {wanted}: expected a number from 1 to {most}, the training {name}s."
            )
    origin = shapes.tensor.mean(axis=(0, 1))
    parts = hosvd(shapes.tensor - origin).truncated(speaker_modes, pose_modes)
    history = {
        "builder": f"tonguetrack {__version__}",
        **shapes.provenance,
        **({"filled": ", ".join(f"{s} {p}" for s, p in shapes.filled)} if shapes.filled else {}),
        **(provenance or {}),
    }
    return _model_of(parts, origin, shapes, {k: v for k, v in history.items() if v})


def _model_of(
    parts: Hosvd, origin: FloatArray, shapes: TrainingShapes, provenance: Mapping[str, str]
) -> TongueModel:
    def mode(factors: FloatArray, spectrum: FloatArray, names: tuple[str, ...]) -> Mode:
        return Mode(factors.mean(axis=0), len(factors), factors, spectrum, names)

    return TongueModel(
        parts.core,
        origin,
        shapes.faces,
        mode(parts.speaker_factors, parts.speaker_spectrum, shapes.speakers),
        mode(parts.pose_factors, parts.pose_spectrum, shapes.prompts),
        shapes.marks,
        provenance,
    )


def _check_same_faces(path: Path, mesh: Mesh, first_path: Path, first: Mesh) -> None:
    if len(mesh.vertices) != len(first.vertices) or not np.array_equal(mesh.faces, first.faces):
        raise InputError(
            f"{path}: its face list ({len(mesh.vertices)} vertices, {len(mesh.faces)} faces) is not that of "
            f"{first_path.name} ({len(first.vertices)} vertices, {len(first.faces)} faces); all meshes of a "
            "database must be registered to one template."
        )


def _check_marks(marks: SurfaceMarks, vertex_count: int, source: str) -> None:
    named = {"template/midsagittal": marks.midsagittal}
    named.update({f"template/landmarks/{name}": (vertex,) for name, vertex in marks.landmarks.items()})
    named.update({f"template/regions/{name}": vertices for name, vertices in marks.regions.items()})
    for where, vertices in named.items():
        for vertex in vertices:
            if not 0 <= vertex < vertex_count:
                raise InputError(
                    f"{source}: {where} names vertex {vertex}; the meshes have vertices 0 to {vertex_count - 1}."
                )


def _read_marks(template: Any, path: Path) -> SurfaceMarks:
    if template is None:
        return SurfaceMarks()
    try:
        return SurfaceMarks(
            {str(name): int(vertex) for name, vertex in template.get("landmarks", {}).items()},
            {str(name): tuple(map(int, members)) for name, members in template.get("regions", {}).items()},
            tuple(map(int, template.get("midsagittal", ()))),
        )
    except (AttributeError, TypeError, ValueError) as reason:
        raise InputError(
            f"{path}: 'template' must hold landmarks {{name: vertex}}, regions {{name: [vertices]}} and "
            f"midsagittal [vertices] ({reason})."
        ) from reason


def _load_yaml(path: Path) -> Any:
    from .files import load_yaml_text  # the one place that knows which YAML loader is safe and fast

    if not path.is_file():
        raise InputError(f"{path}: there is no such sample database.")
    if path.stat().st_size > MAX_DATABASE_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a sample database.")
    content = load_yaml_text(path.read_bytes(), str(path))
    if not isinstance(content, dict):
        raise InputError(
            f"{path}: this is not a sample database; expected a YAML map with 'meta' and 'data'."
        )
    return content
