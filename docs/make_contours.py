"""Draws docs/synthetic-contours.png: what the bundled model makes of its training speakers' phones, mid-sagittal.

Needs the extra `plot`. Look at the picture whenever the bundled model changes.
"""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from tonguetrack.model.mri.phantom.anatomy import PALATE_END_MM, ROOF_START_MM, STEP_MM, roof_of
from tonguetrack.model.mri.phantom.making import phantom_speaker
from tonguetrack.tracker.bundled import bundled_model

TARGET = Path(__file__).parent / "synthetic-contours.png"


def main() -> None:
    model = bundled_model()
    midline = list(model.marks.midsagittal)
    seed = int(model.provenance["data"].rpartition(", seed ")[2])
    figure, axes = plt.subplots(3, 4, figsize=(13, 9), sharex=True, sharey=True)
    colours = plt.get_cmap("tab20").colors
    for axis, number in zip(axes.flat, range(1, model.speaker.entries + 1), strict=False):
        anatomy = phantom_speaker(seed, number).anatomy
        roof = roof_of(anatomy)
        y = STEP_MM * np.arange(len(roof))
        hard = (y >= ROOF_START_MM) & (y <= PALATE_END_MM)
        axis.plot(anatomy.size * y[hard], anatomy.size * roof[hard], "k", linewidth=1.5)
        speaker = model.for_speaker(model.speaker.training[number - 1])
        for phone, pose, colour in zip(model.pose.names, model.pose.training, colours, strict=False):
            contour = speaker.vertices(pose)[midline]
            axis.plot(*contour[:, 1:].T, color=colour, linewidth=0.9, label=phone)
        axis.set_title(anatomy.name, fontsize=9)
        axis.set_aspect("equal")
    handles, names = axes.flat[0].get_legend_handles_labels()
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(handles, names, ncol=3, loc="center", frameon=False)
    figure.suptitle(
        "The bundled synthetic model (not anatomy): its training speakers' 13 phones, their palates in black; "
        "mm, front to the left"
    )
    figure.tight_layout()
    figure.savefig(TARGET, dpi=58)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
