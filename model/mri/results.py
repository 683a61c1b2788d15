"""What a build found, scan by scan; and the index of it in the work folder, from which it is put together again.

WORK/results.json names what was read and the keys of what was made of it (see `caching`); everything else is computed
from that: where the heads were, the complete shapes, the model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import InputError
from ...atomic import write_atomically
from ..build import TrainingShapes
from ..fitting import Cloud
from ..mesh import FloatArray
from ..multilinear import TongueModel
from ..procrustes import RigidMotion
from .caching import Cache
from .dataset import Problem, ScanEntry

if TYPE_CHECKING:
    from .settings import BuildSettings
    from .templates import Template

INDEX = "results.json"


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
    scans: Mapping[tuple[str, str], ScanResult]
    problems: tuple[Problem, ...]
    shapes: TrainingShapes
    model: TongueModel
    seconds: Mapping[str, float]
    held_out_mm: Mapping[str, float]

    def suspicious_first(self) -> list[ScanResult]:
        return sorted(self.scans.values(), key=lambda scan: -scan.suspicion)


def stored_cloud(work: Path, result: ScanResult) -> Cloud:
    """The surface points that the tongue was matched to, mm in the scan's world."""
    arrays = Cache(work).load(result.cloud_key)
    return Cloud(arrays["points"].astype(np.float64), arrays["normals"].astype(np.float64))


def load_result(work: str | Path) -> BuildResult:
    """What the last build in this work folder found.

    Raises InputError where there is none that came to its end, or its results are gone.
    """
    raise NotImplementedError
