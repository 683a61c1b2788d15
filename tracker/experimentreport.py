"""The experiments in words and tables: text, JSON, CSV, and the page report.md that shows the pictures."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from .. import __version__
from ..model.multilinear import TongueModel
from .experiments import Anatomy, Experiments, Spread, Statistics, pooled, statistics_of
from .status import MISPLACED_MM

TABLE_FILES = ("statistics.json", "statistics.csv", "report.md")
ALL = "all"
"""How the recordings together are called, where there are several."""

Pair = tuple[Statistics, Statistics]
"""Experiment 1 and 2 over the same frames."""


def all_statistics(experiments: Experiments) -> dict[str, Pair]:
    """Recording's name -> its statistics; where there are several, ALL together at the end."""
    model = experiments.model
    found = {
        take.name: (statistics_of([take.experiment_1], model), statistics_of([take.experiment_2], model))
        for take in experiments.takes
    }
    if len(found) > 1:
        first, second = pooled(experiments)
        found[ALL] = (statistics_of(first, model), statistics_of(second, model))
    return found


def describe_model(model: TongueModel) -> str:
    """Name, fingerprint and, where it is known, what the model was made from (of the bundled one: synthetic)."""
    data = model.provenance.get("data", "")
    return f"{model.name} [{model.fingerprint}]" + (f", {data}" if data else "")


def describe_anatomy(anatomy: Anatomy, model: TongueModel) -> str:
    """Where experiment 2's speaker comes from, and its weights in sigma."""
    weights = model.speaker.normalised(anatomy.weights)
    if anatomy.sigma is None:
        shown = ", ".join(f"{weight:+.2f}" for weight in weights)
    else:
        pairs = zip(weights, anatomy.sigma, strict=True)
        shown = ", ".join(f"{weight:+.2f} +- {sigma:.2f}" for weight, sigma in pairs)
    noise = " (+- from the noise alone)" if anatomy.sigma is not None else ""
    return f"{anatomy.source}; in sigma {shown}{noise}"


def warnings(experiments: Experiments, statistics: dict[str, Pair]) -> list[str]:
    """What makes the numbers worthless: a recording that is not where the model is, an anatomy that nobody has."""
    told = [
        f"warning: {name} is on average {first.error_mm.mean:.1f} mm off even with anatomy and pose free: it is not in "
        "the model's frame, and its weights mean nothing; 'tonguetrack calibrate' finds its place (see [alignment] in "
        "docs/session.md)"
        for name, (first, _) in statistics.items()
        if first.error_mm.mean > MISPLACED_MM and name != ALL
    ]
    box = experiments.session.energy.box
    farthest = float(np.abs(experiments.model.speaker.normalised(experiments.anatomy.weights)).max())
    if farthest > box + 1e-6:
        told.append(
            f"warning: the anatomy of experiment 2 lies {farthest:.3g} sigma from the mean, beyond the box of {box:g}: it "
            "is nobody's, however small the errors at the coils; leave [speaker] out of the session, and it is estimated"
        )
    return told


# Tables for people ----------------------------------------------------------------------------------


def text_table(statistics: dict[str, Pair]) -> str:
    """One row for each recording and experiment."""
    rows = [_SUMMARY_HEAD, *_summary_rows(statistics)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


_SUMMARY_HEAD = [
    *("recording", "experiment", "frames", "mean mm", "median mm", "< 1.25 mm", "< 1.5 mm"),
    *("within 2 sigma", "within 3 sigma"),
]


def _summary_rows(statistics: dict[str, Pair]) -> list[list[str]]:
    """One for each recording and experiment, in the columns of _SUMMARY_HEAD."""
    rows = []
    for name, pair in statistics.items():
        for number, figures in enumerate(pair, 1):
            error = figures.error_mm
            shares = [*figures.share_below_mm.values(), *figures.share_within_sigma.values()]
            numbers = [str(number), str(figures.frames_tracked), f"{error.mean:.2f}", f"{error.median:.2f}"]
            rows.append([name, *numbers, *(_percent(share) for share in shares)])
    return rows


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


def _weight_rows(weights: dict[str, Spread]) -> list[list[str]]:
    return [
        [
            name.replace("_", " "),
            f"{spread.mean:.2f}",
            f"{spread.standard_deviation:.2f}",
            f"{spread.minimum:.2f}",
            f"{spread.maximum:.2f}",
        ]
        for name, spread in weights.items()
    ]


def report_page(
    experiments: Experiments,
    statistics: dict[str, Pair],
    features: Sequence[str] = (),
    films: Sequence[str] = (),
) -> str:
    """The folder's page, Markdown. features, films: names of the files with feature vectors and of the films."""
    notes = [f"{take.name}: {note}" for take in experiments.takes for note in take.notes]
    blocks = [
        "# The two tracking experiments",
        _WHAT.format(version=__version__),
        _set_up(experiments),
        *warnings(experiments, statistics),
        *_error_section(experiments, statistics),
        *_weight_section(experiments, statistics),
    ]
    if features:
        blocks += ["## Feature vectors", _FEATURES + ", ".join(f"`{name}`" for name in features) + "."]
    if films:
        blocks += ["## Films", _FILMS + ", ".join(f"[{name}]({name})" for name in films) + "."]
    blocks += ["## How it was set up", "\n".join(f"- {found}" for found in [*experiments.decisions, *notes])]
    return "\n\n".join(blocks) + "\n"


_WHAT = (
    'Made by tonguetrack {version} after the paper\'s section "Experiments". Experiment 1 solves anatomy and pose in '
    "every frame; experiment 2 keeps one anatomy and solves the pose alone. The numbers are in `statistics.json` and "
    "`statistics.csv`, too, and the pictures as SVG."
)
_ERROR = (
    "The error of a frame is the mean distance of the coils that are there from their vertices. Frames without any "
    "coil do not count. The last two columns: frames in which all weights that the experiment solves for are so near "
    "to the mean of the training weights."
)
_WEIGHTS = (
    "x stands for the mean of the training weights plus x sigma. The violins show the density, the long line in each "
    "the mean, the short ones the interquartile range. "
)
_FILMS = "Each recording in both experiments, with the coils' positions and the normalised weights: "
_FEATURES = (
    "Pose weights of experiment 2, raw and normalised, with deltas and delta-deltas (regression over two frames to "
    "either side, per frame); nothing where nothing was tracked: "
)


def _set_up(experiments: Experiments) -> str:
    session, model = experiments.session, experiments.model
    stated = {
        "Model": describe_model(model),
        "Recordings": ", ".join(take.experiment_1.recording for take in experiments.takes),
        "Session": session.source,
        "Vertices of the coils": ", ".join(f"{role} {v}" for role, v in session.correspondences.items()),
        "Alignment": ", ".join(filter(None, [str(session.alignment), session.alignment.source])),
        "Anatomy of experiment 2": describe_anatomy(experiments.anatomy, model),
    }
    return "\n".join(f"- {name}: {value}" for name, value in stated.items())


def _together(experiments: Experiments) -> str:
    takes = experiments.takes
    return takes[0].name if len(takes) == 1 else f"all {len(takes)} recordings together"


def _error_section(experiments: Experiments, statistics: dict[str, Pair]) -> list[str]:
    pooled_pair = list(statistics.values())[-1]
    coils = [
        [role, *(f"{of.coils_mm[role].mean:.2f}" if role in of.coils_mm else "" for of in pooled_pair)]
        for role in experiments.takes[0].experiment_1.roles
    ]
    return [
        "## Error",
        _ERROR,
        _markdown_table(_SUMMARY_HEAD, _summary_rows(statistics)),
        "![Cumulative error of both experiments](errors.png)",
        f"Mean distance of each coil from its vertex in mm, {_together(experiments)}:",
        _markdown_table(["coil", "experiment 1", "experiment 2"], coils),
    ]


def _weight_section(experiments: Experiments, statistics: dict[str, Pair]) -> list[str]:
    pooled_pair = list(statistics.values())[-1]
    tables = [
        _markdown_table(
            [f"experiment {number}, sigma", "mean", "standard deviation", "minimum", "maximum"],
            _weight_rows(figures.weights),
        )
        for number, figures in enumerate(pooled_pair, 1)
    ]
    picture = "![Distribution of the normalised weights](weights.png)"
    return [
        "## Normalised weights",
        f"{_WEIGHTS}Here: {_together(experiments)}.",
        picture,
        *tables,
    ]


# Numbers for programs -------------------------------------------------------------------------------


def as_json(experiments: Experiments, statistics: dict[str, Pair]) -> dict[str, Any]:
    """All numbers as plain values."""
    model, session, anatomy = experiments.model, experiments.session, experiments.anatomy
    recordings = [
        {
            "name": take.name,
            "recording": take.experiment_1.recording,
            "rate_hz": take.experiment_1.rate_hz,
            **_pair_as_dict(statistics[take.name]),
        }
        for take in experiments.takes
    ]
    return {
        "program": f"tonguetrack {__version__}",
        "model": {
            "name": model.name,
            "fingerprint": model.fingerprint,
            "data": model.provenance.get("data", ""),
        },
        "session": session.source,
        "alignment": str(session.alignment),
        "correspondences": dict(session.correspondences),
        "anatomy": {
            "source": anatomy.source,
            "weights": anatomy.weights.tolist(),
            "normalised": model.speaker.normalised(anatomy.weights).tolist(),
            "uncertainty_sigma": _finite(anatomy.sigma.tolist()) if anatomy.sigma is not None else None,
        },
        "decisions": list(experiments.decisions),
        "recordings": recordings,
        "pooled": _pair_as_dict(list(statistics.values())[-1]),
    }


def _pair_as_dict(pair: Pair) -> dict[str, Any]:
    return {f"experiment_{number}": asdict(figures) for number, figures in enumerate(pair, 1)}


def _finite(values: Sequence[float]) -> list[float | None]:
    """JSON knows no infinity: where the coils determine nothing, there is no number."""
    return [value if abs(value) < float("inf") else None for value in values]


def json_text(experiments: Experiments, statistics: dict[str, Pair]) -> str:
    return json.dumps(as_json(experiments, statistics), ensure_ascii=False, indent=1, allow_nan=False) + "\n"


def as_csv(statistics: dict[str, Pair]) -> str:
    """One row for every number: recording, experiment, quantity, statistic, value, unit."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["recording", "experiment", "quantity", "statistic", "value", "unit"])
    for name, pair in statistics.items():
        for number, figures in enumerate(pair, 1):
            for quantity, statistic, value, unit in _quantities(figures):
                rows.writerow([name, number, quantity, statistic, f"{value:.9g}", unit])
    return out.getvalue()


def _quantities(figures: Statistics) -> Iterable[tuple[str, str, float, str]]:
    yield "frames", "count", figures.frames, "frames"
    yield "frames", "tracked", figures.frames_tracked, "frames"
    for limit, share in figures.share_below_mm.items():
        yield "error", f"share_below_{limit:g}_mm", share, "share of frames"
    for multiple, share in figures.share_within_sigma.items():
        yield "weights", f"share_within_{multiple}_sigma", share, "share of frames"
    measured = [("error", figures.error_mm, "mm")]
    measured += [(role, spread, "mm") for role, spread in figures.coils_mm.items()]
    measured += [(weight, spread, "sigma") for weight, spread in figures.weights.items()]
    for quantity, spread, unit in measured:
        for statistic, value in asdict(spread).items():
            yield quantity, statistic, value, unit
