"""What a build found, scan by scan; and the index of it, from which it is put together again.

WORK/results.json names what was read and the keys of what was made of it (see `caching`); all else is computed from
that: where the heads were, the complete shapes, the model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import InputError
from ...atomic import write_atomically
from ..build import TrainingShapes
from ..cloud import Cloud
from ..mesh import FloatArray
from ..multilinear import TongueModel
from ..procrustes import RigidMotion, upright
from . import stages, templates
from .bootstrapping import Cell, complete_shapes, head_motions, model_of
from .caching import KEY_LENGTH, Cache
from .dataset import Dataset, Landmarks, Problem, Region, ScanEntry
from .settings import BuildSettings, as_table, settings_digest, settings_of
from .templates import Template

INDEX = "results.json"
FORMAT = "tonguetrack mri build 1"
LARGEST_INDEX = 50_000_000
OFTEN = 2.0  # times its median over all scans: what a measure may be without suspicion
FAULT = 5.0  # the suspicion of what is certainly wrong
FLIPPED_FACE = 0.5  # one or two are a matter of looks
_NOTES = (
    "Its points are {value:.2f} mm away on average, much for this data set.",
    "{value:.0%} of its vertices have no point nearby, many for this data set.",
    "Bootstrapping moved it by {value:.1f} mm on average, much for this data set.",
)
MOST_FLIPPED = 0.002  # of the faces; with more, the mesh is no surface that a model should learn from


@dataclass(frozen=True)
class ScanResult:
    """What was made of one scan. Vertices are mm in the scan's own world: x left, y back, z up.

    entry: its file and what a person marked. cloud_key: of its surface points, contact restored (`stored_cloud`).
    palate: (p, 3) the speaker's palate, brought here; alignment_score: mean correlation of its profiles, up to 1.
    motion: from the scan's world to the head frame, which all scans share.
    initial: (n, 3) the tongue after the first template matching; final: (n, 3) after the last round.
    residual_mm: mean distance of the vertices to the points that they were matched to, and valid: the share of
        vertices that had one; of the first matching, then of each round.
    flipped: faces that the final mesh has turned over. used: whether it is part of the model.
    notes: what a person should know, in sentences; suspicion: from 0, the larger the more worth a look.
    """

    speaker: str
    phone: str
    entry: ScanEntry
    cloud_key: str
    palate: FloatArray
    alignment_score: float
    motion: RigidMotion
    initial: FloatArray
    final: FloatArray
    residual_mm: tuple[float, ...]
    valid: tuple[float, ...]
    flipped: int
    used: bool
    notes: tuple[str, ...]
    suspicion: float


@dataclass(frozen=True)
class BuildResult:
    """source: the data set's file. tongue, palate: the templates, whose faces all meshes have. scans: (speaker, phone)
    -> result, for every scan of which a tongue was made. problems: what was left out, and why. shapes: the tongues in
    the head frame, missing cells filled. seconds: step -> wall time in the run that wrote this, hardly any where the
    result was kept. held_out_mm: way of completing -> mean error in cells that it was not shown; empty where there
    are too few."""

    source: Path
    settings: BuildSettings
    tongue: Template
    palate: Template
    scans: Mapping[Cell, ScanResult]
    problems: tuple[Problem, ...]
    shapes: TrainingShapes
    model: TongueModel
    seconds: Mapping[str, float]
    held_out_mm: Mapping[str, float]

    def suspicious_first(self) -> list[ScanResult]:
        return sorted(self.scans.values(), key=lambda scan: -scan.suspicion)


@dataclass(frozen=True)
class Index:
    """What has been made, by the keys of the results; a step that was not taken has left its part empty.

    dataset: what is left of it, and what was left out. digests: (speaker, phone) -> of the scan's file. surfaces,
    aligned, clouds: (speaker, phone) -> key; palates: speaker -> key; tongues: (speaker, phone) -> keys of the first
    matching and of each round. used: whose tongue is part of the model. held_out: key of the errors of completing.
    seconds: stage -> wall time.
    """

    dataset: Dataset
    settings: BuildSettings
    digests: Mapping[Cell, str] = field(default_factory=dict)
    surfaces: Mapping[Cell, str] = field(default_factory=dict)
    palates: Mapping[str, str] = field(default_factory=dict)
    aligned: Mapping[Cell, str] = field(default_factory=dict)
    clouds: Mapping[Cell, str] = field(default_factory=dict)
    tongues: Mapping[Cell, tuple[str, ...]] = field(default_factory=dict)
    used: tuple[Cell, ...] = ()
    held_out: str | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)


def stored_cloud(work: str | Path, result: ScanResult) -> Cloud:
    """The surface points that the tongue was matched to, mm in the scan's world."""
    return stages.cloud_of(Cache(Path(work)).load(result.cloud_key))


def load_result(work: str | Path) -> BuildResult:
    """What the last build in this work folder found.

    Raises InputError where there is none that came to its end, or its results are gone.
    """
    return assembled(Path(work), read_index(work))


def assembled(work: str | Path, index: Index) -> BuildResult:
    """The result that an index tells of. Raises InputError where it did not come to its end, or results are gone."""
    if not index.used:
        raise InputError(
            f"{work}: no build came to its end here; run 'tonguetrack mri build' with this work folder."
        )
    cache = Cache(Path(work))
    tongue, palate = templates.tongue(), templates.palate()
    matches = {cell: [cache.load(key) for key in index.tongues[cell]] for cell in _cells(index)}
    aligned = {cell: cache.load(index.aligned[cell]) for cell in matches}
    motions = upright_motions(index, cache)
    shapes = shapes_of(index, tongues_in_head(index, cache, motions))
    scans = {}
    for cell, found in matches.items():
        scans[cell] = ScanResult(
            *cell,
            index.dataset.scans[cell],
            index.clouds[cell],
            aligned[cell]["palate"],
            float(aligned[cell]["score"]),
            motions[cell],
            found[0]["vertices"],
            found[-1]["vertices"],
            tuple(float(one["residual_mm"]) for one in found),
            tuple(float(one["valid"]) for one in found),
            int(found[-1]["flipped"]),
            cell in index.used,
            (),
            0.0,
        )
    weights = index.settings.model
    return BuildResult(
        index.dataset.source,
        index.settings,
        tongue,
        palate,
        judged(scans, {cell: bytes(aligned[cell]["reason"]).decode() for cell in scans}),
        index.dataset.problems,
        shapes,
        model_of(shapes, weights.speaker_modes, weights.pose_modes),
        index.seconds,
        {} if index.held_out is None else held_out_of(cache.load(index.held_out)),
    )


def motions_of(index: Index, cache: Cache) -> dict[Cell, RigidMotion]:
    """From the world of each aligned scan to the head frame."""
    own = {speaker: cache.load(index.palates[speaker])["vertices"] for speaker in index.dataset.speakers}
    in_scans = {cell: cache.load(index.aligned[cell])["palate"] for cell in index.dataset.scans}
    return head_motions(own, in_scans, templates.palate())


def upright_motions(index: Index, cache: Cache) -> dict[Cell, RigidMotion]:
    """The same, to the frame of the finished model: the mean of all tongues lies evenly about its plane x = 0.

    The palates alone say where the heads are; which way a head looks they say less well, for they are nearly round.
    """
    motions = motions_of(index, cache)
    mean = np.mean(list(tongues_in_head(index, cache, motions).values()), axis=0)
    turn = upright(mean, templates.tongue().mirror)
    return {cell: turn.after(motion) for cell, motion in motions.items()}


def tongues_in_head(
    index: Index, cache: Cache, motions: Mapping[Cell, RigidMotion]
) -> dict[Cell, FloatArray]:
    """The last meshes, of those that are part of the model: (n, 3) mm in the head frame, where the motions lead."""
    return {cell: motions[cell].apply(cache.load(index.tongues[cell][-1])["vertices"]) for cell in index.used}


def shapes_of(index: Index, tongues: Mapping[Cell, FloatArray]) -> TrainingShapes:
    """The tongues, (speaker, phone) -> (n, 3) mm in the head frame, with the cells filled that are missing among
    their speakers and phones."""
    speakers = [name for name in index.dataset.speakers if any(name == cell[0] for cell in tongues)]
    phones = [name for name in index.dataset.phones if any(name == cell[1] for cell in tongues)]
    provenance = {
        "source": index.dataset.source.name,
        "data": index.dataset.provenance,
        "settings": settings_digest(index.settings),
    }
    return complete_shapes(
        tongues, speakers, phones, templates.tongue(), index.settings.completion, provenance
    )


def _cells(index: Index) -> list[Cell]:
    """Of which a tongue was made, in the order of the data set."""
    return [cell for cell in index.dataset.scans if cell in index.tongues]


def held_out_of(arrays: Mapping[str, Any]) -> dict[str, float]:
    """Way of completing -> mean error, mm."""
    return {name.replace("_", " "): float(errors.mean()) for name, errors in arrays.items()}


# What looks wrong --------------------------------------------------------------------------------------


def is_sound(flipped: int, faces: int) -> bool:
    """Whether so few of the faces are flipped that a model may learn from the mesh."""
    return flipped <= MOST_FLIPPED * faces


def judged(scans: Mapping[Cell, ScanResult], doubts: Mapping[Cell, str]) -> dict[Cell, ScanResult]:
    """The results with their notes and suspicion.

    Suspicion is the sum of: the residual, the share of vertices without a point, the way from the first matching to the
    last, each in units of its median over all scans, beyond twice that; 5 for a doubtful alignment of the palate; and half
    for each flipped face, 5 at most. doubts: why an alignment is uncertain, or "".
    """
    measures = {
        cell: (
            scan.residual_mm[-1],
            1.0 - scan.valid[-1],
            float(np.linalg.norm(scan.final - scan.initial, axis=1).mean()),
        )
        for cell, scan in scans.items()
    }
    usual = np.maximum(np.median(list(measures.values()), axis=0), 1e-9)
    judged = {}
    for cell, scan in scans.items():
        beyond = np.maximum(np.array(measures[cell]) / usual - OFTEN, 0.0)
        notes = [
            sentence.format(value=value)
            for sentence, value, much in zip(_NOTES, measures[cell], beyond, strict=True)
            if much > 0.0
        ]
        suspicion = float(beyond.sum()) + min(FAULT, FLIPPED_FACE * scan.flipped)
        if scan.flipped:
            notes.append(f"{scan.flipped} {'face is' if scan.flipped == 1 else 'faces are'} turned over.")
        if not scan.used:
            notes.append("This mesh is not part of the model.")
        if doubts[cell]:
            notes.append(f"The palate's place in this scan is uncertain: {doubts[cell]}.")
            suspicion += FAULT
        judged[cell] = replace(scan, notes=tuple(notes), suspicion=suspicion)
    return judged


# The file ----------------------------------------------------------------------------------------------


def write_index(work: str | Path, index: Index) -> Path:
    """Writes WORK/results.json; its path."""
    dataset = index.dataset
    rows = [
        {
            "speaker": cell[0],
            "phone": cell[1],
            "path": str(entry.path.absolute()),
            "tongue_landmarks": _places(entry.tongue_landmarks),
            "palate_landmarks": entry.palate_landmarks and _places(entry.palate_landmarks),
            "region": entry.region and [entry.region.low_mm.tolist(), entry.region.high_mm.tolist()],
            "digest": index.digests.get(cell),
            "surface": index.surfaces.get(cell),
            "aligned": index.aligned.get(cell),
            "cloud": index.clouds.get(cell),
            "tongues": index.tongues.get(cell, ()),
            "used": cell in index.used,
        }
        for cell, entry in dataset.scans.items()
    ]
    table = {
        "format": FORMAT,
        "source": str(dataset.source.absolute()),
        "provenance": dataset.provenance,
        "speakers": [{"name": name, "palate": dataset.palate_phone[name]} for name in dataset.speakers],
        "phones": dataset.phones,
        "settings": as_table(index.settings),
        "palates": {name: key for name, key in index.palates.items() if name in dataset.speakers},
        "scans": rows,
        "problems": [asdict(problem) for problem in dataset.problems],
        "held_out": index.held_out,
        "seconds": index.seconds,
    }
    return write_atomically(Path(work) / INDEX, json.dumps(table, ensure_ascii=False, indent=1).encode())


def read_index(work: str | Path) -> Index:
    """Raises InputError where there is none, or it is not one of ours."""
    path = Path(work) / INDEX
    if not path.is_file():
        raise InputError(f"{path}: there is no result of 'tonguetrack mri build' here; name its work folder.")
    if path.stat().st_size > LARGEST_INDEX:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for this file.")
    try:
        table = json.loads(path.read_bytes())
        if table["format"] != FORMAT:
            raise ValueError(f"its format is {table['format']!r}, not {FORMAT!r}")
        rows = {(str(row["speaker"]), str(row["phone"])): row for row in table["scans"]}
        palate_phone = {str(row["name"]): str(row["palate"]) for row in table["speakers"]}
        dataset = Dataset(
            Path(table["source"]),
            str(table["provenance"]),
            tuple(palate_phone),
            tuple(map(str, table["phones"])),
            {cell: _entry(row) for cell, row in rows.items()},
            palate_phone,
            {},
            tuple(Problem(**problem) for problem in table["problems"]),
        )
        return Index(
            dataset,
            settings_of(table["settings"], str(path)),
            _keys(rows, "digest"),
            _keys(rows, "surface"),
            {str(speaker): _key(key) for speaker, key in table["palates"].items()},
            _keys(rows, "aligned"),
            _keys(rows, "cloud"),
            {cell: tuple(map(_key, row["tongues"])) for cell, row in rows.items() if row["tongues"]},
            tuple(cell for cell, row in rows.items() if row["used"]),
            None if table["held_out"] is None else _key(table["held_out"]),
            {str(step): float(seconds) for step, seconds in table["seconds"].items()},
        )
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as reason:
        raise InputError(
            f"{path}: this is not a result of 'tonguetrack mri build' ({type(reason).__name__}: {reason}); run it again."
        ) from reason


def _places(landmarks: Landmarks) -> dict[str, list[float]]:
    return {name: place.tolist() for name, place in landmarks.items()}


def _entry(row: Mapping[str, Any]) -> ScanEntry:
    def places(table: Mapping[str, Any]) -> dict[str, FloatArray]:
        return {str(name): _corner(place) for name, place in table.items()}

    palate, region = row["palate_landmarks"], row["region"]
    return ScanEntry(
        Path(row["path"]),
        places(row["tongue_landmarks"]),
        None if palate is None else places(palate),
        None if region is None else Region(*map(_corner, region)),
    )


def _corner(place: Any) -> FloatArray:
    numbers = np.array(place, dtype=np.float64)
    if numbers.shape != (3,):
        raise ValueError(f"{place!r} is not a place")
    return numbers


def _keys(rows: Mapping[Cell, Mapping[str, Any]], name: str) -> dict[Cell, str]:
    return {cell: _key(row[name]) for cell, row in rows.items() if row[name] is not None}


def _key(text: Any) -> str:
    if not (isinstance(text, str) and len(text) == KEY_LENGTH and set(text) <= set("0123456789abcdef")):
        raise ValueError(f"{text!r} is not the key of a result")
    return text
