"""Draws docs/palate.png: a phantom speaker's palate where it is seen, where it is touched, and what that restores.

Needs the extras `mri` and `plot`. Look at the picture whenever the palate's steps or the phantom change.
"""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mesh import FloatArray, Mesh, vertex_normals
from tonguetrack.model.mri.contact import restore_contact
from tonguetrack.model.mri.contours import contour
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.matching import PALATE
from tonguetrack.model.mri.palatealignment import align_palate
from tonguetrack.model.mri.palates import first_match, palate_surface
from tonguetrack.model.mri.phantom.making import PhantomScan, phantom_scan, phantom_speaker
from tonguetrack.model.mri.scan import Scan
from tonguetrack.model.mri.slicepicture import PLANES, slice_values
from tonguetrack.model.mri.surface import surface_points
from tonguetrack.model.mri.templates import palate
from tonguetrack.model.neighbours import SurfaceIndex

TARGET = Path(__file__).parent / "palate.png"
SPEAKER, PHONE = 2, "e"
FOUND, BEFORE, POINTS, PUT_IN = "#ffd400", "#ff5a4d", "#4db8ff", "#34ff59"
AROUND_MM = {"sagittal": ((-12, 12), (-23, 14)), "coronal": ((-4, 4), (-23, 14))}


def main() -> None:
    seen, touched = (phantom_scan(0, phantom_speaker(0, SPEAKER), phone) for phone in ("a", PHONE))
    template = palate()
    surface = palate_surface(denoised(seen), seen.palate_landmarks, template)
    own = first_match(SurfaceIndex(surface), seen.palate_landmarks, template, PALATE).vertices
    faces = template.mesh.faces
    scans = seen.scan.quantised(), touched.scan.quantised()
    moved = align_palate(own, vertex_normals(own, faces), *scans).motion.apply(own)
    cloud = surface_points(denoised(touched))
    restored = restore_contact(cloud, Mesh(moved, faces))
    figure, axes = plt.subplots(2, 4, figsize=(13.5, 6.3), layout="constrained")
    for row, plane in zip(axes, ("sagittal", "coronal"), strict=True):
        across = PLANES[plane][0]
        for axis, scan, vertices in zip(
            row, (scans[0], *3 * [scans[1]]), (own, moved, moved, moved), strict=True
        ):
            show(axis, scan, plane, vertices)
        for axis, vertices, colour in (
            (row[0], own, FOUND),
            (row[1], own, BEFORE),
            (row[1], moved, FOUND),
        ):
            at_mm = np.median((own if axis is row[0] else moved)[:, across])
            for line in contour(Mesh(vertices, faces), plane, float(at_mm)):
                axis.plot(*line.T, color=colour, linewidth=1.6)
        draw_points(row[2], cloud, plane, moved, POINTS)
        for part, colour in zip(old_and_new(restored, cloud), (POINTS, PUT_IN), strict=True):
            draw_points(row[3], part, plane, moved, colour)
    titles = (
        "[a]: the palate is seen and matched",
        f"[{PHONE}]: the same, not moved (red) and aligned",
        f"[{PHONE}]: surface points, a hole at the contact",
        "behind it taken out, the palate put in (green)",
    )
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    axes[0, 0].set_ylabel("sagittal")
    axes[1, 0].set_ylabel("coronal")
    figure.savefig(TARGET, dpi=85)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


def denoised(made: PhantomScan) -> Scan:
    scan = made.scan.quantised()
    return scan.holding(denoise(scan.values, scan.spacing_mm))


def old_and_new(restored: Cloud, cloud: Cloud) -> tuple[Cloud, Cloud]:
    """What was in the cloud before, and what was put in."""
    assert restored.normals is not None
    old = np.isin(restored.points[:, 0], cloud.points[:, 0])
    before, new = (Cloud(restored.points[part], restored.normals[part]) for part in (old, ~old))
    return before, new


def show(axis: Axes, scan: Scan, plane: str, vertices: FloatArray) -> None:
    """The slice through the palate's middle, and only what is around it."""
    across, right, up = PLANES[plane]
    values, edges = slice_values(scan, plane, float(np.median(vertices[:, across])))
    axis.imshow(values, cmap="gray", origin="lower", extent=edges, vmin=0, vmax=200)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    (left, far), (down, top) = AROUND_MM[plane]
    axis.set_xlim(low[right] + left, high[right] + far)
    axis.set_ylim(low[up] + down, high[up] + top)
    axis.set_xticks([])
    axis.set_yticks([])


def draw_points(axis: Axes, cloud: Cloud, plane: str, vertices: FloatArray, colour: str) -> None:
    across, right, up = PLANES[plane]
    assert cloud.normals is not None
    near = np.abs(cloud.points[:, across] - np.median(vertices[:, across])) < 0.7
    places, normals = cloud.points[near][:, [right, up]], cloud.normals[near][:, [right, up]]
    axis.quiver(*places.T, *normals.T, color=colour, angles="xy", scale_units="xy", scale=0.6, width=0.004)


if __name__ == "__main__":
    main()
