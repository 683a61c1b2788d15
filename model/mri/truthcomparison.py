"""What a build found against the truth of a phantom: how far the surfaces are apart, and how well heads were followed.

Only a phantom's data set has a truth, in files beside it, which no step of the build reads.

Distances are exact, from a vertex to the nearest place on the other surface, and means are over area: a vertex counts
as the faces around it are large. Places where the true tongue lies against other soft tissue (BURIED) show no edge in
any scan; what is found there tells of the prior, not of the extraction, so that they are counted apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...parallel import Executor, Failed, Progress
from ..mesh import FloatArray, IndexArray, Mesh, vertex_normals
from ..procrustes import RigidMotion, rigid_motion
from ..surfacedistance import beyond_the_boundary, nearest_on, vertex_areas
from .bootstrapping import Cell
from .dataset import Dataset, Problem
from .matching import PAPER_PALATE, PAPER_TONGUE
from .phantom.articulation import CONTACT_PHONES
from .phantom.making import truth_path
from .phantom.surfaces import BURIED, CONTACT
from .phantom.truth import read_truth
from .results import BuildResult, ScanResult
from .settings import BuildSettings

HIGH = 0.95
TONGUE_MM, CONTACT_MM, MOTION_MM, TURN_DEG = 0.9, 1.2, 0.5, 0.5
"""What is aimed at with voxels of 1.2 mm."""


@dataclass(frozen=True)
class SurfaceError:
    """One extracted tongue, mm; nan where there is nothing to take the mean of.

    mean, high: from the true surface, BURIED parts left out, to the extracted one, the mean and the 95 % quantile.
    outwards: the same with a sign, above 0 where the extracted one lies outside of the true tongue. contact, buried:
    the mean over these parts of the true surface alone. back: from the extracted surface to the true one, without what
    lies beside its end (the true one has no underside of the tip) or nearest to BURIED parts.
    """

    mean: float
    high: float
    outwards: float
    contact: float
    buried: float
    back: float


@dataclass(frozen=True)
class ScanComparison:
    """initial, final: the tongue after the first matching, and after the last round. motion_mm: how far the palate's
    points are from where the head's true motion brings them, root mean square; turn_deg: by how much it is turned
    from there. Both are nan for the palate's own scan, from which it is brought nowhere."""

    initial: SurfaceError
    final: SurfaceError
    motion_mm: float
    turn_deg: float


@dataclass(frozen=True)
class Row:
    """A measure over all scans. initial: the mean after the first matching, nan where there is no such; final: the mean
    after the last round; worst: the largest of the latter; most: what the mean should be at most, None for no aim."""

    name: str
    unit: str
    initial: float
    final: float
    worst: float
    most: float | None


@dataclass(frozen=True)
class TruthComparison:
    """files: (speaker, phone) -> where its truth is; scans: the same -> its tongue against that; palates: speaker -> mean
    distance in mm from the true palate to the extracted one, in the scan that it was extracted from; problems: what
    could not be compared, and why."""

    files: Mapping[Cell, Path]
    scans: Mapping[Cell, ScanComparison]
    palates: Mapping[str, float]
    problems: tuple[Problem, ...] = ()

    def rows(self) -> list[Row]:
        """What the whole data set amounts to; each scan counts the same."""
        compared = list(self.scans.values())
        close = [one for (_, phone), one in self.scans.items() if phone in CONTACT_PHONES]
        phones = " ".join(CONTACT_PHONES)

        def tongue(
            name: str,
            measure: Callable[[SurfaceError], float],
            among: list[ScanComparison],
            most: float | None,
        ) -> Row:
            before = np.array([measure(one.initial) for one in among])
            after = np.array([measure(one.final) for one in among])
            return Row(name, "mm", _mean(before), _mean(after), _largest(after), most)

        def alone(name: str, unit: str, values: Iterable[float], most: float | None) -> Row:
            found = np.array(list(values))
            return Row(name, unit, float("nan"), _mean(found), _largest(found), most)

        return [
            tongue("true tongue to extracted", lambda one: one.mean, compared, TONGUE_MM),
            tongue("the same, 95 % of the surface", lambda one: one.high, compared, None),
            tongue("the same, outwards", lambda one: one.outwards, compared, None),
            tongue(f"contact with the palate, [{phones}]", lambda one: one.contact, close, CONTACT_MM),
            tongue("contact with the palate, all", lambda one: one.contact, compared, None),
            tongue("against other soft tissue", lambda one: one.buried, compared, None),
            tongue("extracted tongue to true", lambda one: one.back, compared, None),
            alone("palate, place in other scans", "mm", (one.motion_mm for one in compared), MOTION_MM),
            alone("palate, turn in other scans", "deg", (one.turn_deg for one in compared), TURN_DEG),
            alone("true palate to extracted", "mm", self.palates.values(), None),
        ]


def has_truth(dataset: Dataset) -> bool:
    """Whether there is a truth of any scan."""
    return any(truth_path(dataset, *cell).is_file() for cell in dataset.scans)


def compare(
    result: BuildResult, dataset: Dataset, executor: Executor, progress: Progress | None = None
) -> TruthComparison:
    """Every scan that has a tongue, against its truth; those without a readable truth are named in `problems`."""
    cases = {}
    for cell, scan in result.scans.items():
        own = result.scans.get((scan.speaker, dataset.palate_phone.get(scan.speaker, "")))
        own_truth = None if own is None else truth_path(dataset, own.speaker, own.phone)
        cases[cell] = _Case(scan, truth_path(dataset, *cell), own, own_truth)
    work = partial(_compared, result.tongue.mesh.faces, result.palate.mesh.faces)
    files, scans, palates, problems = {}, {}, {}, []
    for (cell, case), outcome in zip(
        cases.items(), executor.run(work, list(cases.values()), progress), strict=True
    ):
        speaker, phone = cell
        if isinstance(outcome, Failed):
            problems.append(Problem(speaker, phone, f"{speaker} [{phone}]: {outcome.reason}"))
            continue
        files[cell] = case.truth
        scans[cell], palate_mm = outcome
        if case.own is case.scan:
            palates[speaker] = palate_mm
    return TruthComparison(files, scans, palates, tuple(problems))


def surface_error(
    vertices: FloatArray, faces: IndexArray, truth: Mesh, kind: NDArray[np.uint8]
) -> SurfaceError:
    """vertices: (n, 3) mm, the extracted tongue; kind: of the vertices of the truth, as in `phantom.truth`."""
    found = Mesh(vertices, faces)
    area = vertex_areas(truth)
    there = nearest_on(found, truth.vertices)
    outwards = np.einsum(
        "na,na->n", there.place - truth.vertices, vertex_normals(truth.vertices, truth.faces)
    )
    seen = kind != BURIED
    back = nearest_on(truth, vertices)
    counted = ~beyond_the_boundary(truth, back) & seen[back.corner(truth)]
    return SurfaceError(
        _mean(there.distance_mm[seen], area[seen]),
        _quantile(there.distance_mm[seen], area[seen]),
        _mean(outwards[seen], area[seen]),
        _mean(there.distance_mm[kind == CONTACT], area[kind == CONTACT]),
        _mean(there.distance_mm[~seen], area[~seen]),
        _mean(back.distance_mm[counted], vertex_areas(found)[counted]),
    )


# What each step brings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ablation:
    """A build with something left out or different: name, for people; settings."""

    name: str
    settings: BuildSettings


def ablations(base: BuildSettings) -> list[Ablation]:
    """The base first, then what differs from it in one thing each, then the paper's own settings of the matching.

    Bootstrapping needs none: every comparison has the error before and after.
    """
    return [
        Ablation("everything", base),
        Ablation("without denoising", replace(base, denoise=False)),
        Ablation("without restoring contact", replace(base, restore_contact=False)),
        Ablation(
            "all of the palate put in (paper)",
            replace(base, contact=replace(base.contact, everywhere=True)),
        ),
        Ablation("the paper's matching", replace(base, tongue=PAPER_TONGUE, palate=PAPER_PALATE)),
    ]


def text_table(comparison: TruthComparison) -> str:
    """The rows, for a terminal."""
    lines = [f"{'against the truth':38}{'first':>8}{'last':>8}{'worst':>8}"]
    for row in comparison.rows():
        numbers = "".join(
            " " * 8 if math.isnan(value) else f"{value:8.2f}" for value in (row.initial, row.final, row.worst)
        )
        aim = "" if row.most is None else f"  (aim: {row.most:g})"
        lines.append(f"{row.name:38}{numbers} {row.unit}{aim}")
    return "\n".join(lines)


def ablation_table(found: Mapping[str, TruthComparison]) -> str:
    """A line for each build, for a terminal: mm, or degrees where it says so."""
    shown = ("first", "last", "contact", "place", "turn")
    lines = [f"{'mm to the true tongue, and palate':38}" + "".join(f"{name:>9}" for name in shown)]
    for name, comparison in found.items():
        lines.append(f"{name:38}" + "".join(f"{value:9.2f}" for value in in_short(comparison)))
    return "\n".join(lines)


def in_short(comparison: TruthComparison) -> tuple[float, float, float, float, float]:
    """The tongue before and after bootstrapping, in contact, mm; the palate's place, mm, and turn, degrees."""
    tongue, _, _, contact, _, _, _, place, turn, _ = comparison.rows()
    return tongue.initial, tongue.final, contact.final, place.final, turn.final


# One scan ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Case:
    """truth: its file. own: the scan of the same speaker that the palate was extracted from, None where it was lost, and
    its truth's file."""

    scan: ScanResult
    truth: Path
    own: ScanResult | None
    own_truth: Path | None


def _compared(tongue: IndexArray, palate: IndexArray, case: _Case) -> tuple[ScanComparison, float]:
    """And the palate's own error there."""
    scan, own = case.scan, case.own
    truth = read_truth(case.truth)
    motion = (float("nan"), float("nan"))
    if own is not None and case.own_truth is not None and case.own_truth != case.truth:
        before = read_truth(case.own_truth).head_to_world
        motion = motion_error(own.palate, scan.palate, truth.head_to_world @ np.linalg.inv(before))
    apart = nearest_on(Mesh(scan.palate, palate), truth.palate.vertices).distance_mm
    compared = ScanComparison(
        surface_error(scan.initial, tongue, truth.tongue, truth.kind),
        surface_error(scan.final, tongue, truth.tongue, truth.kind),
        *motion,
    )
    return compared, _mean(apart, vertex_areas(truth.palate))


def motion_error(start: FloatArray, end: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Root mean square distance in mm, and turn in degrees, of points that were moved from start to end, both (n, 3)
    mm, against where a true rigid motion (4, 4) moves them."""
    truly = RigidMotion(true[:3, :3], true[:3, 3])
    apart = end - truly.apply(start)
    turned = rigid_motion(start, end).rotation @ truly.rotation.T
    # By the sine: the cosine of a small angle is too near to 1.
    skew = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    angle = np.arctan2(np.linalg.norm(skew), np.trace(turned) - 1.0)
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1)))), float(np.degrees(angle))


def _mean(values: FloatArray, weights: FloatArray | None = None) -> float:
    """Of those that are numbers; nan where there are none."""
    there = np.isfinite(values)
    if not there.any():
        return float("nan")
    return float(np.average(values[there], weights=None if weights is None else weights[there]))


def _largest(values: FloatArray) -> float:
    there = values[np.isfinite(values)]
    return float(there[np.argmax(np.abs(there))]) if len(there) else float("nan")


def _quantile(values: FloatArray, weights: FloatArray) -> float:
    """What the share HIGH of the weights lies at or below."""
    if not len(values):
        return float("nan")
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(share, HIGH * share[-1])]])
