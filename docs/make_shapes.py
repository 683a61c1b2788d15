"""Draws docs/shapes.png: where the avatar shapes are measured, and what they say of thirteen phones.

Needs the extra `plot`. Look at the picture whenever the shapes or the bundled model change.
"""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.streams.landmarks import STATIONS, contour_with_parts, landmark_vertices
from tonguetrack.tracker.streams.shapes import SHAPES, ShapeMeter, speaker_ranges

TARGET = Path(__file__).parent / "shapes.png"
BLUE, GREY = "#1f5fa8", "#9a9a9a"


def main() -> None:
    model = bundled_model()
    figure = plt.figure(figsize=(13, 7.4))
    grid = figure.add_gridspec(2, 2, width_ratios=[1.15, 1.6], wspace=0.28, hspace=0.3)
    vertices, landmarks = model.mean_vertices(), landmark_vertices(model)
    contour = vertices[contour_with_parts(model)[0]]
    points = vertices[landmarks]
    names = ["tip", *STATIONS]

    side = figure.add_subplot(grid[0, 0])
    side.plot(contour[:, 1], contour[:, 2], color=GREY)
    for name, point in zip(names, points, strict=False):
        side.plot(point[1], point[2], "o", color=BLUE)
        offset = (-6, -13) if name == "tip" else (0, 7)
        side.annotate(name, point[1:], xytext=offset, textcoords="offset points", ha="center")
    side.set(title="from the side, front to the left (mm)", aspect="equal", xlim=(2, 66), ylim=(-32, 12))

    top = figure.add_subplot(grid[1, 0])
    facing = vertices[:, 2] > -12
    top.plot(vertices[facing, 1], vertices[facing, 0], ".", color="#e2e2e2", markersize=2)
    middles, rest = points[: len(names)], points[len(names) :].reshape(4, -1, 3)
    top.plot(middles[:, 1], middles[:, 0], "o", color=BLUE)
    for row, marker in zip(rest, "ssDD", strict=True):
        top.plot(row[:, 1], row[:, 0], marker, color=BLUE, markersize=5)
    for middle, sides in zip(middles[1:], rest.transpose(1, 0, 2), strict=False):
        across = np.array([sides[3], sides[1], middle, sides[0], sides[2]])
        top.plot(across[:, 1], across[:, 0], color=BLUE, linewidth=0.8)
    top.annotate("edge", rest[2, 1, 1::-1], xytext=(0, -14), textcoords="offset points", ha="center")
    top.annotate("halfway", rest[0, 0, 1::-1], xytext=(-7, -4), textcoords="offset points", ha="right")
    top.set(title="from above, the speaker's left below", aspect="equal", xlim=(2, 66), ylim=(20, -20))

    speakers = np.tile(model.speaker.mean, (5 * len(model.pose.training), 1))
    ranges = speaker_ranges(model, speakers, np.tile(model.pose.training, (5, 1)))
    meter = ShapeMeter(model, ranges)
    shown = [
        column
        for column, shape in enumerate(SHAPES)
        if not shape.axis.endswith(" x") and shape.axis not in ("twist", "lean", "out")
    ]
    values = np.array([meter.measure(model.speaker.mean, pose)[shown] for pose in model.pose.training])
    table = figure.add_subplot(grid[:, 1])
    table.imshow(values.T, cmap="Blues", vmin=0, vmax=1.1, aspect="auto")
    table.set_xticks(range(len(model.pose.names)), model.pose.names, fontsize=12)
    table.set_yticks(range(len(shown)), [SHAPES[column].name for column in shown])
    for column, row in np.ndindex(values.shape):
        if values[column, row] >= 0.05:
            dark = values[column, row] > 0.6
            text = f"{values[column, row]:.1f}".lstrip("0")
            table.text(column, row, text, ha="center", va="center", fontsize=9, color="w" if dark else "k")
    table.set_title("the mean synthetic speaker's phones, with this speaker's ranges")
    table.tick_params(length=0)

    figure.suptitle("Avatar shapes of the bundled synthetic tongue (not anatomy)")
    figure.savefig(TARGET, dpi=75, bbox_inches="tight")
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
