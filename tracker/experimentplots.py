"""The paper's two figures of the experiments: cumulative error, and violins of the weights (extra `plot`)."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import InputError
from .experiments import THRESHOLDS_MM, Experiments, frame_errors, pooled, solved_weights
from .pose import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURE_FILES = ("errors.png", "errors.svg", "weights.png", "weights.svg")
COLOURS = ("#20456b", "#c8641e")
"""Of experiments 1 and 2."""
SHOWN_SHARE = 99.5
"""Percent of the frames that the error's axis reaches; a few lost ones would press all others to the left."""
MOST_DRAWN = 4000
"""Values in a violin: the density of more looks the same and takes long."""


def require_plotting() -> None:
    """Raises InputError where pictures cannot be drawn; to be asked before the work is done."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError(
            "experiment: the report's pictures need matplotlib, which is not installed; install it with "
            "pip install 'tonguetrack[plot]'."
        ) from None


def pictures(experiments: Experiments) -> Iterator[tuple[str, bytes]]:
    """PICTURE_FILES, each with its content."""
    for name, figure in (("errors", draw_errors(experiments)), ("weights", draw_weights(experiments))):
        for kind in ("png", "svg"):
            content = io.BytesIO()
            figure.savefig(content, format=kind, dpi=130)
            yield f"{name}.{kind}", content.getvalue()


def draw_errors(experiments: Experiments) -> Figure:
    """The share of frames whose error is at most so large, for both experiments; thin: single recordings."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    largest = 2.0 * THRESHOLDS_MM[-1]
    for number, (takes, colour) in enumerate(zip(pooled(experiments), COLOURS, strict=True), 1):
        if len(takes) > 1:
            for poses in takes:
                _draw_cumulative(axes, frame_errors([poses]), colour, linewidth=0.6, alpha=0.5)
        errors = frame_errors(takes)
        _draw_cumulative(axes, errors, colour, linewidth=2.0, label=f"experiment {number}")
        largest = max(largest, float(np.percentile(errors, SHOWN_SHARE)))
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    for limit, side in zip(THRESHOLDS_MM, ("right", "left"), strict=True):
        axes.axvline(limit, color="0.5", linestyle=":", linewidth=1.0)
        axes.annotate(f" {limit:g} mm ", (limit, 0.03), rotation=90, ha=side, va="bottom", size=8, bbox=box)
    axes.set(xlim=(0.0, 1.02 * largest), ylim=(0.0, 1.0))
    axes.set(xlabel="mean distance of coils and vertices, mm", ylabel="frames with at most this error")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(color="0.92")
    axes.legend(loc="lower right", frameon=False)
    axes.set_title(_title("Cumulative error", experiments), size=9)
    return figure


def _draw_cumulative(axes: Axes, errors: FloatArray, colour: str, **style: Any) -> None:
    """A step at each error; beyond the largest it stays at 1."""
    ordered = np.concatenate([[0.0], np.sort(errors), [1e6]])
    shares = np.concatenate([[0.0], np.arange(1, len(errors) + 1) / len(errors), [1.0]])
    axes.step(ordered, shares, where="post", color=colour, **style)


def draw_weights(experiments: Experiments) -> Figure:
    """One row an experiment, anatomy on the left and pose on the right; the anatomy that is kept is one line."""
    from matplotlib.figure import Figure

    model = experiments.model
    fixed = model.speaker.normalised(experiments.anatomy.weights)
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    panels = figure.subplots(
        2, 2, sharey=True, squeeze=False, width_ratios=(model.speaker.size, model.pose.size)
    )
    for row, (takes, colour) in enumerate(zip(pooled(experiments), COLOURS, strict=True)):
        weights = solved_weights(takes, model)
        for panel, mode in zip(panels[row], ("speaker", "pose"), strict=True):
            columns = [values for name, values in weights.items() if name.startswith(mode)]
            if columns:
                _draw_violins(panel, columns, colour)
            else:
                panel.hlines(fixed, *_about(len(fixed), 0.3), color=colour, linewidth=2.0)
            count = len(columns) or len(fixed)
            panel.set_xticks(np.arange(1, count + 1))
            panel.set_xlim(0.4, count + 0.6)
            panel.axhline(0.0, color="0.7", linewidth=0.8, zorder=0)
            panel.grid(axis="y", color="0.92")
            panel.set_axisbelow(True)
            kept = "" if columns else ", kept in all frames"
            panel.set_title(
                f"experiment {row + 1}: {'anatomy' if mode == 'speaker' else 'pose'}{kept}", size=9
            )
        panels[row, 0].set_ylabel("normalised weight, sigma")
    for panel in panels[-1]:
        panel.set_xlabel("weight")
    figure.suptitle(_title("Distribution of the weights", experiments), size=9)
    return figure


def _draw_violins(panel: Axes, columns: list[FloatArray], colour: str) -> None:
    """Density of each column; a long line at the mean, short ones at the quartiles."""
    thinned = [column[:: max(1, len(column) // MOST_DRAWN)] for column in columns]
    # All alike, to rounding, have no density: their mean is drawn alone.
    spread = [(place, column) for place, column in enumerate(thinned, 1) if np.ptp(column) > 1e-9]
    if spread:
        places, drawn = zip(*spread, strict=True)
        bodies: Any = panel.violinplot(drawn, places, widths=0.8, showextrema=False)["bodies"]
        for body in bodies:
            body.set(facecolor=colour, edgecolor=colour, alpha=0.35)
    panel.hlines([column.mean() for column in columns], *_about(len(columns), 0.3), color=colour, linewidth=2)
    for quartile in (25, 75):
        levels = [np.percentile(column, quartile) for column in columns]
        panel.hlines(levels, *_about(len(columns), 0.15), color=colour, linewidth=1.2)


def _about(count: int, half_width: float) -> tuple[FloatArray, FloatArray]:
    """Where lines about 1, 2, ... count begin and end."""
    places = np.arange(1.0, count + 1)
    return places - half_width, places + half_width


def _title(subject: str, experiments: Experiments) -> str:
    takes = experiments.takes
    what = takes[0].name if len(takes) == 1 else f"{len(takes)} recordings"
    model = experiments.model
    made_up = model.provenance.get("data", "").startswith("synthetic") and "synthetic" not in model.name
    return f"{subject}, {what}; model {model.name}{' (synthetic)' if made_up else ''}"
