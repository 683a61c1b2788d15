"""The report of a build: every scan's slices with the contours found in them, what looks wrong first; and all numbers.

FOLDER/index.html    the page, which needs no script and nothing from elsewhere
FOLDER/pictures/     the slices of each scan
FOLDER/report.json   all numbers
FOLDER/scans.csv     a row a scan
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ... import InputError, __version__
from ...atomic import write_atomically
from ...parallel import Executor, Failed, Progress
from ..evaluation import compactness
from ..mesh import FloatArray, IndexArray, Mesh
from . import qualitypage
from .exporting import readable_names
from .phantom.truth import read_truth
from .reading import library
from .results import BuildResult, ScanResult
from .settings import as_table
from .slicesheet import Sheet, sheet_of
from .stages import scan_at
from .truthcomparison import ScanComparison, TruthComparison

PAGE, NUMBERS, TABLE, PICTURES = "index.html", "report.json", "scans.csv", "pictures"
BESIDE_MM = 9.0  # of the middle, the outer sagittal slices
ALONG_PALATE = (0.3, 0.7)  # of its middle line, from the front: the coronal slices
MARGIN_MM = 8.0  # around the surfaces


def write_report(
    folder: str | Path,
    result: BuildResult,
    executor: Executor,
    comparison: TruthComparison | None = None,
    ablations: Mapping[str, TruthComparison] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Writes the report into the folder, which is made; the path of the page.

    comparison: with the truth, where there is one; ablations: the same for other builds, by what was different. Scans
    are read and drawn by the executor, a few at a time. Raises InputError where a place cannot be written.
    """
    folder = Path(folder)
    require_drawing()
    try:
        (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: this folder cannot be made ({error.strerror or error}); choose another place."
        ) from error
    compared = {} if comparison is None else comparison.scans
    names = readable_names(result.scans)
    scans = result.suspicious_first()
    cases = [_case(result, scan, comparison) for scan in scans]
    blocks = []
    for scan, sheet in zip(scans, executor.run(_drawn, cases, progress), strict=True):
        cell = scan.speaker, scan.phone
        picture = f"{PICTURES}/{names[cell]}.jpg"
        if isinstance(sheet, Failed):
            shown = qualitypage.missing_sheet(sheet.reason)
        else:
            write_atomically(folder / picture, sheet.picture)
            shown = qualitypage.sheet(sheet, picture)
        blocks.append(qualitypage.scan_block(scan, moved_mm(scan), names[cell], shown, compared.get(cell)))
    ablations = ablations or {}
    numbers = json.dumps(as_json(result, comparison, ablations), indent=1, ensure_ascii=False)
    write_atomically(folder / NUMBERS, f"{numbers}\n".encode())
    write_atomically(folder / TABLE, as_csv(result, comparison).encode())
    page = qualitypage.page(result, names, comparison, ablations, blocks)
    return write_atomically(folder / PAGE, page.encode())


def require_drawing() -> None:
    """Raises InputError where pictures cannot be made; to be asked before the work is done."""
    library("PIL.Image")


def moved_mm(scan: ScanResult) -> float:
    """How far bootstrapping moved the vertices, on average."""
    return float(np.linalg.norm(scan.final - scan.initial, axis=1).mean())


# Numbers ---------------------------------------------------------------------------------------------


def as_json(
    result: BuildResult, comparison: TruthComparison | None, ablations: Mapping[str, TruthComparison]
) -> dict[str, Any]:
    """Everything, as plain values; null for what there is none of."""
    compared = {} if comparison is None else comparison.scans
    shapes = result.shapes
    content: dict[str, Any] = {
        "program": f"tonguetrack {__version__}",
        "source": str(result.source),
        "data": shapes.provenance.get("data", ""),
        "settings": as_table(result.settings),
        "seconds": {name: round(value, 2) for name, value in result.seconds.items()},
        "model": {
            "fingerprint": result.model.fingerprint,
            "speakers": list(shapes.speakers),
            "phones": list(shapes.prompts),
            "filled_cells": [list(cell) for cell in shapes.filled],
            "held_out_mm": dict(result.held_out_mm),
            "compactness": {mode: shares.tolist() for mode, shares in compactness(shapes).items()},
        },
        "problems": [asdict(problem) for problem in result.problems],
        "scans": [_scan_numbers(scan, compared.get(cell)) for cell, scan in _in_order(result)],
    }
    if comparison is not None:
        content["truth"] = {
            "measures": [asdict(row) for row in comparison.rows()],
            "palates_mm": dict(comparison.palates),
            "problems": [asdict(problem) for problem in comparison.problems],
        }
    if ablations:
        content["ablations"] = {
            name: [asdict(row) for row in found.rows()] for name, found in ablations.items()
        }
    cleaned: dict[str, Any] = _without_nan(content)
    return cleaned


def as_csv(result: BuildResult, comparison: TruthComparison | None) -> str:
    """A row a scan, what looks wrong first; a field is empty where there is no such number."""
    compared = {} if comparison is None else comparison.scans
    table = []
    for cell, scan in _in_order(result):
        numbers = _scan_numbers(scan, compared.get(cell))
        truth = numbers.pop("truth")
        for name in ("residual_mm", "valid"):
            series = numbers.pop(name)
            numbers |= {f"first_{name}": series[0], f"last_{name}": series[-1]}
        numbers["notes"] = " ".join(numbers["notes"])
        for when in ("initial", "final"):
            numbers |= {f"truth_{when}_{name}_mm": value for name, value in truth.get(when, {}).items()}
        numbers |= {f"truth_{name}": truth[name] for name in ("motion_mm", "turn_deg") if truth}
        table.append(numbers)
    columns = max(table, key=len, default={})
    out = io.StringIO()
    rows = csv.DictWriter(out, list(columns), lineterminator="\n")
    rows.writeheader()
    for numbers in table:
        rows.writerow({name: _field(value) for name, value in numbers.items()})
    return out.getvalue()


def _in_order(result: BuildResult) -> list[tuple[tuple[str, str], ScanResult]]:
    return [((scan.speaker, scan.phone), scan) for scan in result.suspicious_first()]


def _scan_numbers(scan: ScanResult, compared: ScanComparison | None) -> dict[str, Any]:
    return {
        "speaker": scan.speaker,
        "phone": scan.phone,
        "file": str(scan.entry.path),
        "used": scan.used,
        "suspicion": scan.suspicion,
        "residual_mm": list(scan.residual_mm),
        "valid": list(scan.valid),
        "moved_mm": moved_mm(scan),
        "flipped": scan.flipped,
        "alignment_score": scan.alignment_score,
        "truth": {} if compared is None else asdict(compared),
        "notes": list(scan.notes),
    }


def _field(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return f"{value:.4f}" if math.isfinite(value) else ""
    return value


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


# Pictures --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Case:
    """One scan to be drawn. middle: the vertices of the palate's middle line, front to back; truth: its file."""

    scan: ScanResult
    tongue: IndexArray
    palate: IndexArray
    middle: tuple[int, ...]
    truth: Path | None


def _case(result: BuildResult, scan: ScanResult, comparison: TruthComparison | None) -> _Case:
    truth = None if comparison is None else comparison.files.get((scan.speaker, scan.phone))
    middle = result.palate.marks.midsagittal
    return _Case(scan, result.tongue.mesh.faces, result.palate.mesh.faces, middle, truth)


def _drawn(case: _Case) -> Sheet:
    found = case.scan
    surfaces = {
        "initial": Mesh(found.initial, case.tongue),
        "final": Mesh(found.final, case.tongue),
        "palate": Mesh(found.palate, case.palate),
    }
    shown = np.vstack([mesh.vertices for mesh in surfaces.values()])
    if case.truth is not None:
        surfaces["truth"] = read_truth(case.truth).tongue
    scan = scan_at(found.entry.path, found.entry.region)
    places = slices(found.palate[list(case.middle)])
    return sheet_of(scan, surfaces, shown.min(axis=0) - MARGIN_MM, shown.max(axis=0) + MARGIN_MM, places)


def slices(middle: FloatArray) -> list[tuple[str, float]]:
    """Plane and place of the slices that are shown, of the middle line (n, 3) mm of the palate, front to back."""
    x = float(middle[:, 0].mean())
    sagittal = [("sagittal", x + offset) for offset in (-BESIDE_MM, 0.0, BESIDE_MM)]
    front, back = middle[[0, -1], 1]
    return sagittal + [("coronal", float(front + share * (back - front))) for share in ALONG_PALATE]
