"""A calibration to look at: views before and after the fit, the palate over the contours, coils on the mesh, residuals.

Pictures need the extra `plot`. All positions are mm in the model's frame (x left, y back, z up); the front is on the left.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import InputError, __version__
from ..atomic import write_atomically
from ..model.midsagittal import midsagittal_vertices
from ..model.multilinear import TongueModel
from .calibration import EXPERIMENTS, PALATE_ALLOWED_MM, Calibration, Figures, contours
from .palate import Palate
from .pose import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURES = {
    "views.png": "Tongue coils before the fit to the model (as axes, landmarks or bite plane have them) and after it, from "
    "the left side and from the front; the line is the model's mid-sagittal contour: before, of its mean speaker, after, "
    "of this one, both in the mean pose. The palate bounds what is tracked; the mean pose may well cross it.",
    "contours.png": "Tracked contours (experiment 2) with the coils and, where there is one, the palate, which none should "
    "cross.",
    "correspondences.png": "Where the coils sit on the mesh of this speaker in the mean pose; crosses: the middle of each "
    "coil's samples.",
    "residuals.png": "Residuals of the tracked recordings over time, and per coil. The dotted lines are the paper's "
    "thresholds, 1.25 mm for experiment 1 and 1.5 mm for experiment 2.",
}
REPORT_FILES = ("report.md", *PICTURES)
MOST_POINTS = 1500  # of one cloud
MOST_CONTOURS = 120
LEAST_WIDTH_MM = 24.0  # of a view from the front
LIMITS_MM = (1.25, 1.5)  # the paper's, of experiments 1 and 2
LEAST_SHOWN_MM, SHOWN_PERCENT = (
    3.0,
    99.5,
)  # of the residuals' axis; a few lost samples would press all others to the left
COLOURS = ("#c23b22", "#2e7d32", "#1f5fa8", "#8e5bb5", "#b8860b", "#00838f")


def require_plotting() -> None:
    """Raises InputError where pictures cannot be drawn; to be asked before the work is done."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError(
            "--report: its pictures need matplotlib, which is not installed; install it with "
            "pip install 'tonguetrack[plot]', or leave --report out."
        ) from None


def write_report(calibration: Calibration, model: TongueModel, folder: Path) -> list[Path]:
    """Writes the REPORT_FILES into the folder; returns where they are."""
    drawn = (
        draw_views(calibration, model),
        draw_contours(calibration, model),
        draw_correspondences(calibration, model),
        draw_residuals(calibration),
    )
    written = [write_atomically(folder / "report.md", report_text(calibration, model).encode())]
    for name, figure in zip(PICTURES, drawn, strict=True):
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=130)
        written.append(write_atomically(folder / name, picture.getvalue()))
    return written


def report_text(calibration: Calibration, model: TongueModel) -> str:
    """The page: a table of figures, every decision, the pictures."""
    table_head = (
        "| | frames | residual mean | median | below 1.25 mm | below 1.5 mm | within 3 sigma | more than "
        f"{PALATE_ALLOWED_MM:g} mm above the palate |"
    )
    lines = [
        "# Calibration",
        "",
        f"Model {model.name} [{model.fingerprint}], tonguetrack {__version__}. Recordings: "
        + ", ".join(run[1].recording for run in calibration.poses),
        "",
        table_head,
        "|---|---|---|---|---|---|---|---|",
    ]
    for which in EXPERIMENTS:
        lines.append(_row(f"experiment {which}, before the fit", calibration.before[which]))
        lines.append(_row(f"experiment {which}, with the session", calibration.after[which]))
    lines += [
        "",
        "## Decisions",
        "",
        *(f"- {decision}" for decision in calibration.decisions),
        "",
        "## Pictures",
    ]
    for name, caption in PICTURES.items():
        lines += ["", f"![{name.partition('.')[0]}]({name})", "", caption]
    return "\n".join(lines) + "\n"


def _row(name: str, figures: Figures) -> str:
    above = "-" if np.isnan(figures.above_palate) else f"{100 * figures.above_palate:.1f} %"
    return (
        f"| {name} | {figures.frames} | {figures.residual_mean_mm:.2f} mm | {figures.residual_median_mm:.2f} mm | "
        f"{100 * figures.below_1_25_mm:.0f} % | {100 * figures.below_1_5_mm:.0f} % | "
        f"{100 * figures.within_3_sigma:.1f} % | {above} |"
    )


def draw_views(calibration: Calibration, model: TongueModel) -> Figure:
    """Two rows (before and after the fit), two columns (from the side, from the front)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 8.4), layout="constrained")
    # The same axes in both rows, so that the eye sees what the fit does.
    panels = figure.subplots(2, 2, sharex="col", sharey=True)
    fit, alignment = calibration.registration, calibration.session.alignment
    placed = calibration.coils_mm @ calibration.base_rotation.T + calibration.base_translation_mm
    aligned = calibration.coils_mm @ alignment.rotation.T + alignment.translation_mm
    palate = calibration.session.palate
    before = None if palate is None else (palate.points_mm - fit.translation_mm) @ fit.rotation
    weights = calibration.session.speaker_weights
    assert weights is not None
    contour = [int(vertex) for vertex in midsagittal_vertices(model)]
    at = model.at(contour)
    shapes = [at.vertices(speaker, model.pose.mean) for speaker in (model.speaker.mean, weights)]
    states = (
        ("before the fit", placed, before, shapes[0]),
        ("after the fit", aligned, None if palate is None else palate.points_mm, shapes[1]),
    )
    for row, (name, coils, above, shape) in zip(panels, states, strict=True):
        for panel, axis, side in zip(row, (1, 0), ("from the side", "from the front"), strict=True):
            _clouds(panel, coils, calibration.roles, axis)
            # From the front, the contour is the plane that it lies in: the mesh zigzags about it.
            across = shape[:, 1] if axis == 1 else np.zeros(len(shape))
            panel.plot(across, shape[:, 2], color="black", label="model")
            if above is not None:
                panel.plot(above[:, axis], above[:, 2], color="0.45", linewidth=2.5, label="palate")
            panel.set_title(f"{name}, {side}")
            panel.set_xlabel(("x (left), mm", "y (back), mm")[axis])
            panel.tick_params(labelbottom=True)
            panel.set_aspect("equal")
            panel.grid(color="0.92")
        row[0].set_ylabel("z (up), mm")
    # Coils in one plane are a line from the front, which needs some room to its sides.
    left, right = panels[0, 1].get_xlim()
    room = max(0.0, LEAST_WIDTH_MM - (right - left)) / 2
    panels[0, 1].set_xlim(left - room, right + room)
    panels[0, 0].get_gridspec().set_width_ratios([np.ptp(panel.get_xlim()) for panel in panels[0]])
    _legend_below(figure, panels[0, 0], columns=5)
    return figure


def draw_contours(calibration: Calibration, model: TongueModel) -> Figure:
    """Contours of experiment 2, spread through the recordings, under the palate."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6), layout="constrained")
    panel = figure.subplots()
    shapes = np.concatenate([contours(run[2], model) for run in calibration.poses])
    for index, contour in enumerate(_evenly(shapes, MOST_CONTOURS)):
        label = None if index else "tracked contour"
        panel.plot(contour[:, 1], contour[:, 2], color="#e59866", alpha=0.35, linewidth=0.7, label=label)
    aligned = np.concatenate([run[2].coils for run in calibration.poses])
    _clouds(panel, aligned, calibration.roles, 1)
    palate = calibration.session.palate
    title = "tracked contours; no palate"
    if palate is not None:
        panel.plot(*palate.curve, color="black", linewidth=2.5, label="palate")
        title = _palate_title(calibration, palate)
    panel.set_title(title)
    _side_view(panel)
    _legend_below(figure, panel, columns=5)
    return figure


def _palate_title(calibration: Calibration, palate: Palate) -> str:
    figures = calibration.after[2]
    span = float(np.ptp(palate.curve[0]))
    return (
        f"experiment 2 under a palate of {span:.0f} mm: {100 * figures.above_palate:.1f} % of the frames more than "
        f"{PALATE_ALLOWED_MM:g} mm above it,\n99 % stay below {figures.highest_mm:+.1f} mm"
    )


def draw_correspondences(calibration: Calibration, model: TongueModel) -> Figure:
    """The mesh from the side, and from above where coils sit beside the middle: contour, and the coils' vertices."""
    from matplotlib.figure import Figure

    beside = not calibration.session.alignment.midsagittal
    figure = Figure(figsize=(9, 11 if beside else 7), layout="constrained")
    panels = figure.subplots(1 + beside, 1, squeeze=False)[:, 0]
    weights = calibration.session.speaker_weights
    assert weights is not None
    shape = model.vertices(weights, model.pose.mean)
    line = shape[midsagittal_vertices(model)]
    coils = np.concatenate([run[2].coils for run in calibration.poses])
    for panel, axes in zip(panels, ([1, 2], [1, 0])[: len(panels)], strict=True):
        panel.triplot(*shape[:, axes].T, model.faces, color="0.85", linewidth=0.3)
        panel.plot(*line[:, axes].T, color="black", linewidth=1)
        for index, role in enumerate(calibration.roles):
            vertex = calibration.session.correspondences[role]
            colour = COLOURS[index % len(COLOURS)]
            middle = np.nanmedian(coils[:, index], axis=0)[axes]
            there = shape[vertex, axes]
            label = f"{index + 1} {role}: vertex {vertex}"
            panel.plot(*there, "o", color=colour, markersize=9, label=label)
            panel.plot(*middle, "x", color=colour, markersize=8, markeredgewidth=2)
            panel.annotate(
                str(index + 1), tuple(there), xytext=(7, 7), textcoords="offset points", weight="bold"
            )
        panel.plot(
            [], [], "x", color="0.3", markersize=8, markeredgewidth=2, label="middle of a coil's samples"
        )
        _side_view(panel)
    if beside:
        panels[1].set_ylabel("x (left), mm")
    panels[0].set_title("correspondences on this speaker's mesh, mean pose")
    _legend_below(figure, panels[0], columns=2)
    return figure


def draw_residuals(calibration: Calibration) -> Figure:
    """Above: over time, recordings one after the other; below: the share of samples per coil up to each residual."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    over_time, *by_coil = figure.subplot_mosaic([["time", "time"], ["1", "2"]]).values()
    begin = 0.0
    for run in calibration.poses:
        for which, colour in zip(EXPERIMENTS, ("#1f5fa8", "#c23b22"), strict=True):
            poses = run[which]
            shown = np.where(poses.tracked, poses.residual_mm, np.nan)
            times = begin + poses.times_s - poses.times_s[0]
            label = f"experiment {which}" if begin == 0.0 else None
            over_time.plot(times, shown, color=colour, linewidth=0.7, label=label)
        begin += len(run[1].times_s) / run[1].rate_hz
        if run is not calibration.poses[-1]:
            over_time.axvline(begin, color="0.3", linewidth=0.8)
    for limit in LIMITS_MM:
        over_time.axhline(limit, color="0.5", linewidth=0.8, linestyle=":")
    several = ", recordings one after the other" if len(calibration.poses) > 1 else ""
    over_time.set_xlabel(f"time, s{several}")
    over_time.set_ylabel("mean residual of the coils, mm")
    over_time.set_xlim(0, begin)
    over_time.set_ylim(bottom=0)
    over_time.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    shown_mm = LEAST_SHOWN_MM
    for panel, which in zip(by_coil, EXPERIMENTS, strict=True):
        each = np.concatenate([run[which].residuals_mm[run[which].tracked] for run in calibration.poses])
        shown_mm = max(shown_mm, float(np.nanpercentile(each, SHOWN_PERCENT)))
        for index, role in enumerate(calibration.roles):
            sorted_mm = np.sort(each[np.isfinite(each[:, index]), index])
            share = 100.0 * np.arange(1, len(sorted_mm) + 1) / max(len(sorted_mm), 1)
            panel.plot(
                [0.0, *sorted_mm, 1e6], [0.0, *share, 100.0], color=COLOURS[index % len(COLOURS)], label=role
            )
        for limit in LIMITS_MM:
            panel.axvline(limit, color="0.5", linewidth=0.8, linestyle=":")
        panel.set_title(f"experiment {which}")
        panel.set_xlabel("residual of the coil, mm")
        panel.set_ylabel("samples below, %")
        panel.set_ylim(0, 100)
        panel.legend(frameon=False, loc="lower right")
    for panel in by_coil:
        panel.set_xlim(0, shown_mm)
    return figure


def _legend_below(figure: Figure, panel: Axes, columns: int) -> None:
    """The panel's legend under the figure, where it covers nothing."""
    from matplotlib.lines import Line2D

    handles, names = panel.get_legend_handles_labels()
    legend = figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D) and handle.get_marker() == ".":
            handle.set_markersize(12)


def _clouds(panel: Axes, coils: FloatArray, roles: Sequence[str], axis: int) -> None:
    shown = _evenly(coils, MOST_POINTS)
    for index, role in enumerate(roles):
        panel.plot(
            shown[:, index, axis], shown[:, index, 2], ".", color=COLOURS[index % len(COLOURS)], markersize=2.5,
            alpha=0.5, label=role,
        )  # fmt: skip


def _side_view(panel: Axes) -> None:
    panel.set_xlabel("y (back), mm")
    panel.set_ylabel("z (up), mm")
    panel.set_aspect("equal", adjustable="datalim")
    panel.grid(color="0.92")


def _evenly(frames: FloatArray, most: int) -> FloatArray:
    """At most so many frames, spread through all of them."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, most).astype(int))]
