"""Draws docs/phantom.png: four scans of phantom speakers, alone and with the true surfaces over them.

Needs the extras `mri` and `plot`. Look at the picture whenever the phantom changes.
"""

from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from tonguetrack.model.mesh import Mesh
from tonguetrack.model.mri.phantom.making import PhantomScan, phantom_scan, phantom_speaker
from tonguetrack.model.mri.phantom.surfaces import CONTACT

TARGET = Path(__file__).parent / "phantom.png"
SHOWN = ((1, "i"), (2, "s"), (3, "ɑ"), (5, "u"))
PALATE, TONGUE, TOUCHING = "#ffd400", "#ff3b30", "#34ff59"


def main() -> None:
    figure, axes = plt.subplots(len(SHOWN), 4, figsize=(11, 12.4), width_ratios=(1, 1, 0.55, 0.55))
    for row, (number, phone) in zip(axes, SHOWN, strict=True):
        made = phantom_scan(0, phantom_speaker(0, number), phone)
        voxels = made.scan.voxels(made.truth.tongue.vertices)
        middle = round(float(np.median(voxels[:, 2])))
        # Across the contact, or where the oral part of the tongue is half over.
        touched = voxels[made.truth.kind == CONTACT]
        across = round(float(np.median(touched[:, 0]) if len(touched) else np.quantile(voxels[:, 0], 0.4)))
        for axis, along, place, truth in (
            (row[0], 2, middle, False),
            (row[1], 2, middle, True),
            (row[2], 0, across, False),
            (row[3], 0, across, True),
        ):
            draw(axis, made, along, place, truth)
        row[0].set_ylabel(f"speaker {number}, [{phone}]")
    figure.suptitle(
        "Phantom scans (not anatomy): middle sagittal and one coronal slice, without and with the truth"
    )
    figure.tight_layout()
    figure.savefig(TARGET, dpi=62)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


def draw(axis: Axes, made: PhantomScan, along: int, place: int, truth: bool) -> None:
    """One slice, front to the left in sagittal ones; where asked, what it cuts of the true surfaces."""
    values = made.scan.values
    picture = values[:, :, place].T if along == 2 else values[place]
    white = float(np.quantile(values, 0.995))
    axis.imshow(picture, origin="lower", cmap="gray", vmin=0, vmax=white, aspect="auto")
    axis.set_box_aspect(picture.shape[0] / (picture.shape[1] * (1.2 / 1.1875 if along == 0 else 1.0)))
    axis.set_xticks([])
    axis.set_yticks([])
    if not truth:
        return
    for mesh, touching in ((made.truth.palate, None), (made.truth.tongue, made.truth.kind == CONTACT)):
        cut = crossings(Mesh(made.scan.voxels(mesh.vertices), mesh.faces), along, place + 0.01)
        flat = cut[0][:, [0, 1] if along == 2 else [2, 1]]
        colour = [PALATE if touching is None else TOUCHING if touching[v] else TONGUE for v in cut[1]]
        axis.scatter(*flat.T, s=0.8, c=colour)


def crossings(mesh: Mesh, along: int, place: float) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """(n, 3) where edges cross a plane, and (n,) a vertex of each of them."""
    edges = np.vstack([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    off = mesh.vertices[:, along] - place
    start, end = edges[off[edges[:, 0]] * off[edges[:, 1]] < 0].T
    share = off[start] / (off[start] - off[end])
    return mesh.vertices[start] + share[:, None] * (mesh.vertices[end] - mesh.vertices[start]), start


if __name__ == "__main__":
    main()
