"""An evaluation for people and programs: text, JSON, CSV, and the paper's two figures (extra `plot`)."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import InputError, __version__
from ..atomic import write_atomically
from .curves import Curve
from .evaluation import (
    COMPACTNESS,
    GENERALISATION,
    MODES,
    PHONES,
    SPECIFICITY,
    SPEECH,
    UNIONS,
    Evaluation,
)
from .generalisation import SPEAKER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NUMBER_FILES = ("evaluation.json", "evaluation.csv", "evaluation.txt")
PICTURES = ("measures", "phones")
REPORT_FILES = (*NUMBER_FILES, *(f"{name}.{kind}" for name in PICTURES for kind in ("png", "svg")))
"""What a report can hold; a picture of what was not measured is not made."""
MEAN, RIBBON = "#b3202a", "#9db8d9"
PANELS_A_ROW = 5


def text_tables(evaluation: Evaluation) -> str:
    """Every curve as rows of numbers."""
    parts = [
        (f"compactness, {mode} mode: share of the variance", {"": shares}, 4)
        for mode, shares in evaluation.compactness.items()
    ]
    for heading, curve in _curves(evaluation):
        rows = {"mean": curve.mean_mm, "deviation": curve.deviation_mm}
        parts.append((heading, rows, 3))
    lines = []
    for heading, rows, digits in parts:
        count = len(next(iter(rows.values())))
        numbers = "".join(f"{component:{digits + 4}d}" for component in range(1, count + 1))
        lines += [heading, f"  {'components':10}{numbers}"]
        lines += [
            f"  {name:10}" + "".join(f"{value:{digits + 4}.{digits}f}" for value in values)
            for name, values in rows.items()
        ]
    return "\n".join(lines)


def describe(evaluation: Evaluation) -> str:
    """What was measured on, in one sentence or two."""
    shapes, settings = evaluation.shapes, evaluation.settings
    text = (
        f"{shapes.source}: {len(shapes.speakers)} speakers x {len(shapes.prompts)} phones; where the other mode is "
        f"varied, {settings.speaker_modes} speaker or {settings.pose_modes} pose components"
    )
    if GENERALISATION in settings.measures:
        text += f"; fits in a box of {settings.h:g} sigma"
    if evaluation.specificity or evaluation.phones:
        text += f"; {settings.samples} samples a row (seed {settings.seed})"
    if evaluation.shapes.filled:
        text += f". {len(shapes.filled)} cells were filled by averaging; none of them counts as a real mesh"
    return text + "."


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """Everything, as plain values."""
    shapes, settings = evaluation.shapes, evaluation.settings

    def curves(found: Mapping[str, Curve]) -> dict[str, Any]:
        return {name: _plain(curve) for name, curve in found.items()}

    content: dict[str, Any] = {
        "program": f"tonguetrack {__version__}",
        "samples": shapes.source,
        "speakers": list(shapes.speakers),
        "prompts": list(shapes.prompts),
        "filled_cells": [list(cell) for cell in shapes.filled],
        "settings": {
            "speaker_modes": settings.speaker_modes,
            "pose_modes": settings.pose_modes,
            "h": settings.h,
            "samples": settings.samples,
            "seed": settings.seed,
        },
        "unit": "mm, mean distance between corresponding vertices",
        "vertices_of_regions": dict(evaluation.vertices),
    }
    if evaluation.compactness:
        content[COMPACTNESS] = {mode: shares.tolist() for mode, shares in evaluation.compactness.items()}
    if evaluation.generalisation:
        content[GENERALISATION] = curves(evaluation.generalisation)
    if evaluation.specificity:
        content[SPECIFICITY] = {"region": evaluation.region, **curves(evaluation.specificity)}
    if evaluation.phones:
        content[PHONES] = {
            prompt: {"region": evaluation.regions[prompt], **_plain(curve)}
            for prompt, curve in evaluation.phones.items()
        }
    return content


def as_csv(evaluation: Evaluation) -> str:
    """One row for every number of components of everything that was measured; shares for compactness, else mm."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["measure", "of", "region", "components", "value", "deviation", "standard_error", "count"])
    for mode, shares in evaluation.compactness.items():
        for component, share in enumerate(shares, 1):
            rows.writerow([COMPACTNESS, mode, "", component, f"{share:.6f}", "", "", ""])
    groups: tuple[tuple[str, Mapping[str, Curve], Mapping[str, str]], ...] = (
        (GENERALISATION, evaluation.generalisation, {}),
        (SPECIFICITY, evaluation.specificity, dict.fromkeys(MODES, evaluation.region)),
        (PHONES, evaluation.phones, evaluation.regions),
    )
    for measure, curves, regions in groups:
        for name, curve in curves.items():
            columns = (curve.mean_mm, curve.deviation_mm, curve.standard_error_mm)
            for row, values in enumerate(zip(*columns, strict=True)):
                figures = [f"{value:.6f}" for value in values]
                rows.writerow([measure, name, regions.get(name, ""), row + 1, *figures, curve.counts[row]])
    return out.getvalue()


def write_report(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Writes those of the REPORT_FILES that there is something for into the folder; returns where they are."""
    text = f"{describe(evaluation)}\n\n{text_tables(evaluation)}\n"
    numbers = json.dumps(as_json(evaluation), ensure_ascii=False, indent=1, allow_nan=False)
    contents = (numbers.encode(), as_csv(evaluation).encode(), text.encode())
    written = [
        write_atomically(folder / name, content) for name, content in zip(NUMBER_FILES, contents, strict=True)
    ]
    for name, figure in _figures(evaluation):
        for kind in ("png", "svg"):
            picture = io.BytesIO()
            figure.savefig(picture, format=kind, dpi=130)
            written.append(write_atomically(folder / f"{name}.{kind}", picture.getvalue()))
    return written


def require_plotting() -> None:
    """Raises InputError where pictures cannot be drawn; to be asked before the work is done."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError(
            "-o: the report's pictures need matplotlib, which is not installed; install it with "
            "pip install 'tonguetrack[plot]', or leave -o out to see the numbers alone."
        ) from None


# Pictures ---------------------------------------------------------------------------------------------


def draw_measures(evaluation: Evaluation) -> Figure:
    """The paper's figure: pose mode above, speaker mode below; a column a measure; mean line, ribbon of one deviation."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    specificity = f"specificity, {evaluation.region}"
    columns: list[tuple[str, Mapping[str, Any]]] = [
        ("compactness", evaluation.compactness),
        ("generalisation", evaluation.generalisation),
        (specificity, evaluation.specificity),
    ]
    columns = [(title, found) for title, found in columns if found]
    figure = Figure(figsize=(0.6 + 3.2 * len(columns), 5.4), layout="constrained")
    panels = figure.subplots(2, len(columns), squeeze=False, sharey="col")
    for row, mode in enumerate(MODES):
        for column, (title, found) in enumerate(columns):
            panel = panels[row, column]
            if title == COMPACTNESS:
                panel.plot(np.arange(1, len(found[mode]) + 1), found[mode], ".-", color=MEAN)
                panel.yaxis.set_major_formatter(PercentFormatter(1.0))
                panel.set_ylabel("share of the variance", size=9)
            else:
                _draw_curve(panel, found[mode])
                panel.set_ylabel("mean vertex distance, mm", size=9)
            _number_components(panel, mode, len(evaluation.shapes.prompts))
            if row == 0:
                panel.set_title(title, size=10)
    for column, (title, _) in enumerate(columns):
        panels[0, column].set_ylim(bottom=None if title == COMPACTNESS else 0.0)
    figure.suptitle(_title(evaluation), size=9)
    return figure


def draw_phones(evaluation: Evaluation) -> Figure:
    """Specificity with each phone's pose over the speaker components, all panels on one scale."""
    from matplotlib.figure import Figure

    count = len(evaluation.phones)
    columns = min(count, PANELS_A_ROW)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(0.6 + 2.3 * columns, 0.8 + 1.9 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for panel in panels[count:]:
        panel.set_visible(False)
    for index, (prompt, curve) in enumerate(evaluation.phones.items()):
        panel = panels[index]
        _draw_curve(panel, curve)
        region = evaluation.regions[prompt]
        parts = region if region == SPEECH else " + ".join(UNIONS.get(region, (region,)))
        panel.set_title(f"[{prompt}]  {parts}", size=9)
        # Labels at the outer edge only, where nothing is below.
        _number_components(panel, SPEAKER if index + columns >= count else None, len(curve.counts))
        if index % columns == 0:
            panel.set_ylabel("mm", size=9)
    panels[0].set_ylim(bottom=0.0)
    figure.suptitle(f"Specificity of single phones, {_title(evaluation)}", size=9)
    return figure


def _draw_curve(panel: Axes, curve: Curve) -> None:
    components = np.arange(1, len(curve.counts) + 1)
    low, high = curve.mean_mm - curve.deviation_mm, curve.mean_mm + curve.deviation_mm
    panel.fill_between(components, np.maximum(low, 0.0), high, color=RIBBON, alpha=0.6, linewidth=0)
    panel.plot(components, curve.mean_mm, ".-", color=MEAN)


def _number_components(panel: Axes, mode: str | None, most: int) -> None:
    step = 1 if most <= 6 else 2
    panel.set_xticks(np.arange(1, most + 1, step))
    panel.set_xlim(0.5, most + 0.5)
    panel.grid(color="0.92")
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8)
    if mode:
        panel.set_xlabel(f"{mode} components", size=9)


def _title(evaluation: Evaluation) -> str:
    shapes = evaluation.shapes
    made_up = "; synthetic" if shapes.provenance.get("data", "").startswith("synthetic") else ""
    text = f"{shapes.source}\n{len(shapes.speakers)} speakers x {len(shapes.prompts)} phones{made_up}"
    if evaluation.generalisation or evaluation.specificity or evaluation.phones:
        text += "; mean and one standard deviation"
    return text


def _figures(evaluation: Evaluation) -> Iterator[tuple[str, Figure]]:
    if evaluation.compactness or evaluation.generalisation or evaluation.specificity:
        yield PICTURES[0], draw_measures(evaluation)
    if evaluation.phones:
        yield PICTURES[1], draw_phones(evaluation)


def _curves(evaluation: Evaluation) -> Iterator[tuple[str, Curve]]:
    for mode, curve in evaluation.generalisation.items():
        yield f"generalisation, {mode} mode, {_held(evaluation, mode)}: mm", curve
    for mode, curve in evaluation.specificity.items():
        yield f"specificity, {mode} mode, {_held(evaluation, mode)}, {evaluation.region}: mm", curve
    for prompt, curve in evaluation.phones.items():
        yield f"specificity of [{prompt}], speaker mode, {evaluation.regions[prompt]}: mm", curve


def _held(evaluation: Evaluation, mode: str) -> str:
    other = MODES[MODES.index(mode) - 1]
    return f"{evaluation.settings.held(mode)} {other} components"


def _plain(curve: Curve) -> dict[str, Any]:
    return {
        "components": list(range(1, len(curve.counts) + 1)),
        "mean_mm": np.round(curve.mean_mm, 6).tolist(),
        "deviation_mm": np.round(curve.deviation_mm, 6).tolist(),
        "standard_error_mm": np.round(curve.standard_error_mm, 6).tolist(),
        "count": curve.counts.tolist(),
    }
