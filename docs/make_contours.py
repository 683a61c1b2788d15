"""Draws docs/synthetic-contours.png: every phone of every synthetic training speaker, mid-sagittal.

Needs the extra `plot`. Look at the picture whenever the synthetic speakers change.
"""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from tonguetrack.model.synthetic import PHONES, tongue_template, training_anatomies
from tonguetrack.model.synthetic.samples import training_shapes

TARGET = Path(__file__).parent / "synthetic-contours.png"


def main() -> None:
    template = tongue_template()
    row = len(template.theta)
    midline = np.arange(len(template.s)) * row + row // 2
    figure, axes = plt.subplots(3, 4, figsize=(13, 9), sharex=True, sharey=True)
    colours = plt.get_cmap("tab20").colors
    for axis, anatomy, shapes in zip(axes.flat, training_anatomies(), training_shapes(), strict=False):
        y = np.linspace(-3, 62 * anatomy.size, 120)
        axis.plot(y, anatomy.palate_z(np.zeros_like(y), y), "k", linewidth=1.5)
        for phone, vertices, colour in zip(PHONES, shapes, colours, strict=False):
            axis.plot(*vertices[midline, 1:].T, color=colour, linewidth=0.9, label=phone)
        axis.set_title(anatomy.name, fontsize=9)
        axis.set_aspect("equal")
    handles, names = axes.flat[0].get_legend_handles_labels()
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(handles, names, ncol=3, loc="center", frameon=False)
    figure.suptitle(
        "Synthetic speakers (not anatomy): 13 phones each, palate in black; mm, front to the left"
    )
    figure.tight_layout()
    figure.savefig(TARGET, dpi=58)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
