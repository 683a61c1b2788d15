"""An evaluation for people and programs: a text table, JSON, CSV, and two pictures (extra `plot`)."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import InputError, __version__
from ..atomic import write_atomically
from .evaluation import ESTIMATORS, LOWER_BRACKET, UPPER_BRACKET, Evaluation
from .pose import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REPORT_FILES = (
    *("evaluation.json", "evaluation.csv", "evaluation.txt"),
    *("estimators.png", "estimators.svg", "phones.png", "phones.svg"),
)
MOST_COLUMNS = 3  # panels side by side


def text_table(evaluation: Evaluation) -> str:
    """Means over the speakers and, behind +-, their deviation over the speakers, in mm; one row an estimator."""
    width = max(map(len, evaluation.errors))
    cells = [max(len(part), len("0.00 +- 0.00")) for part in evaluation.parts]
    head = [part.rjust(cell) for part, cell in zip(evaluation.parts, cells, strict=True)]
    lines = ["  ".join(["estimator".ljust(width), *head])]
    for name in evaluation.errors:
        deviations = evaluation.per_speaker(name).std(axis=0)
        figures = [
            f"{mean:.2f} +- {deviation:.2f}".rjust(cell)
            for mean, deviation, cell in zip(evaluation.mean(name), deviations, cells, strict=True)
        ]
        lines.append("  ".join([name.ljust(width), *figures]))
    return "\n".join(lines)


def describe_plan(evaluation: Evaluation, source: str) -> str:
    """What was done, in one sentence."""
    plan = evaluation.plan
    also = ", the tested phone left out, too" if plan.leave_phone_out else ""
    return (
        f"{source}: {len(evaluation.speakers)} speakers left out one by one{also}; {plan.speaker_modes} x "
        f"{plan.pose_modes} weights; coils at {', '.join(map(str, plan.coils))} with {plan.noise_mm:g} mm noise (seed "
        f"{plan.seed}); mean distance to the true vertices in mm, +- over the speakers"
    )


def as_json(evaluation: Evaluation, source: str) -> dict[str, Any]:
    """Everything but the single cells, as plain values."""
    parts = evaluation.parts

    def named(values: FloatArray) -> dict[str, float]:
        return {part: round(float(value), 6) for part, value in zip(parts, values, strict=True)}

    return {
        "program": f"tonguetrack {__version__}",
        "samples": source,
        "plan": asdict(evaluation.plan),
        "unit": "mm, mean distance between corresponding vertices",
        "estimators": {
            name: {
                "about": " ".join((ESTIMATORS[name].__doc__ or "").split()),
                "mean": named(evaluation.mean(name)),
                "deviation_over_speakers": named(evaluation.per_speaker(name).std(axis=0)),
                "per_speaker": {
                    speaker: named(values)
                    for speaker, values in zip(evaluation.speakers, evaluation.per_speaker(name), strict=True)
                },
                "per_phone": {
                    phone: named(values)
                    for phone, values in zip(evaluation.prompts, evaluation.per_phone(name), strict=True)
                },
            }
            for name in evaluation.errors
        },
    }


def as_csv(evaluation: Evaluation) -> str:
    """One row for every estimator, speaker, phone and part that was measured."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["estimator", "speaker", "phone", "part", "error_mm"])
    for name, errors in evaluation.errors.items():
        for cell in np.argwhere(~np.isnan(errors)):
            speaker, phone, part = (int(index) for index in cell)
            rows.writerow(
                [
                    name,
                    evaluation.speakers[speaker],
                    evaluation.prompts[phone],
                    evaluation.parts[part],
                    f"{errors[speaker, phone, part]:.6f}",
                ]
            )
    return out.getvalue()


def write_report(evaluation: Evaluation, source: str, folder: Path) -> list[Path]:
    """Writes the REPORT_FILES into the folder; returns where they are."""
    text = f"{describe_plan(evaluation, source)}\n\n{text_table(evaluation)}\n"
    numbers = json.dumps(as_json(evaluation, source), ensure_ascii=False, indent=1, allow_nan=False)
    contents = [numbers.encode(), as_csv(evaluation).encode(), text.encode()]
    for figure in (draw_estimators(evaluation), draw_phones(evaluation)):
        for kind in ("png", "svg"):
            picture = io.BytesIO()
            figure.savefig(picture, format=kind, dpi=130)
            contents.append(picture.getvalue())
    return [
        write_atomically(folder / name, content) for name, content in zip(REPORT_FILES, contents, strict=True)
    ]


def require_plotting() -> None:
    """Raises InputError where pictures cannot be drawn; to be asked before the work is done."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError(
            "-o: the report's pictures need matplotlib, which is not installed; install it with "
            "pip install 'tonguetrack[plot]', or leave -o out to see the table alone."
        ) from None


def draw_estimators(evaluation: Evaluation) -> Figure:
    """One panel a part, one row an estimator: every speaker a dot, the mean a bar."""
    names = list(evaluation.errors)
    figure, panels = _panels(evaluation, 0.34 * len(names) + 0.9)
    rows = np.arange(len(names))
    for part, (panel, title) in enumerate(zip(panels, evaluation.parts, strict=True)):
        for row, name in enumerate(names):
            values = evaluation.per_speaker(name)[:, part]
            panel.barh(row, values.mean(), height=0.7, color="#c9d8e8")
            panel.plot(values, np.full(len(values), row), ".", color="#20456b", alpha=0.6, markersize=5)
        panel.set_title(title)
        panel.set_xlabel("mean distance to the truth, mm")
    panels[0].set_yticks(rows, names)
    panels[0].invert_yaxis()
    panels[0].set_xlim(left=0)
    figure.suptitle(f"Bars: mean over {len(evaluation.speakers)} speakers left out; dots: each speaker")
    return figure


def draw_phones(evaluation: Evaluation) -> Figure:
    """One panel a part, phones from left to right, one line an estimator: means over the speakers."""
    from matplotlib.ticker import LogLocator, NullLocator

    styles = {UPPER_BRACKET: ("black", ":"), LOWER_BRACKET: ("black", "--")}
    figure, panels = _panels(evaluation, 3.0)
    for part, (panel, title) in enumerate(zip(panels, evaluation.parts, strict=True)):
        for name in evaluation.errors:
            colour, line = styles.get(name, (None, "-"))
            panel.plot(
                evaluation.prompts,
                evaluation.per_phone(name)[:, part],
                marker=".",
                color=colour,
                linestyle=line,
                label=name,
            )
        panel.set_title(title)
        panel.set_xlabel("phone")
        panel.grid(axis="y", color="0.9")
    for panel in panels[:: _columns(evaluation)]:
        panel.set_ylabel("mean distance to the truth, mm")
    panels[0].set_yscale("log")  # the mean shape is so far off that it would press all others into one line
    panels[0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panels[0].yaxis.set_major_formatter("{x:g}")
    panels[0].yaxis.set_minor_locator(NullLocator())
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _panels(evaluation: Evaluation, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a panel for each part, all with the same axes, each `height` inches high."""
    from matplotlib.figure import Figure

    columns = _columns(evaluation)
    rows = math.ceil(len(evaluation.parts) / columns)
    figure = Figure(figsize=(1.5 + 3.6 * columns, 1.0 + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel().tolist()
    for panel in panels[len(evaluation.parts) :]:
        panel.set_visible(False)
    for panel in panels:
        panel.tick_params(labelbottom=True)  # there may be nothing below
    return figure, panels[: len(evaluation.parts)]


def _columns(evaluation: Evaluation) -> int:
    rows = math.ceil(len(evaluation.parts) / MOST_COLUMNS)
    return math.ceil(len(evaluation.parts) / rows)
