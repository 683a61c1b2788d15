"""Draws docs/matching.png: the templates with their landmarks, and what matching makes of the tongue's in two phantom scans.

Needs the extras `mri` and `plot`. Look at the picture whenever matching or the phantom changes.
"""

from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D

from tonguetrack.model.mesh import Mesh, vertex_normals
from tonguetrack.model.mri.contact import restore_contact
from tonguetrack.model.mri.contours import contour
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.matching import TONGUE, match
from tonguetrack.model.mri.phantom.making import PhantomScan, phantom_scan, phantom_speaker
from tonguetrack.model.mri.scan import Scan
from tonguetrack.model.mri.surface import surface_points
from tonguetrack.model.mri.templates import Template, palate, placed, tongue
from tonguetrack.model.neighbours import SurfaceIndex

TARGET = Path(__file__).parent / "matching.png"
SHOWN = ((1, "i"), (2, "ɔ"))
TRUE, START, FOUND = "#ff3b30", "#53a7ff", "#ffe14d"
RIGHT_UP = {"sagittal": (1, 2), "coronal": (0, 2)}


def main() -> None:
    figure = plt.figure(figsize=(12, 8.4))
    for row, (template, up, around) in enumerate(((tongue(), 22.0, 10.0), (palate(), -52.0, -75.0))):
        solid = figure.add_axes((-0.03, 0.52 - 0.48 * row, 0.3, 0.44), projection="3d", computed_zorder=False)
        draw_template(solid, template, up, around)
    for row, (number, phone) in enumerate(SHOWN):
        made = phantom_scan(0, phantom_speaker(0, number), phone)
        scan = made.scan.quantised()
        smooth = scan.holding(denoise(scan.values, scan.spacing_mm))
        cloud = restore_contact(surface_points(smooth), made.truth.palate)
        start = placed(tongue(), made.tongue_landmarks)
        found = match(start, tongue(), SurfaceIndex(cloud), made.tongue_landmarks, TONGUE).vertices
        middle = np.median(made.truth.tongue.vertices, axis=0)
        for column, (plane, at_mm) in enumerate((("sagittal", middle[0]), ("coronal", middle[1] - 4.0))):
            axis = figure.add_axes((0.31 + 0.37 * column, 0.5 - 0.48 * row, 0.355 - 0.06 * column, 0.46))
            draw_slice(axis, made, smooth, plane, at_mm, start, found)
            axis.set_title(f"speaker {number}, [{phone}], {plane}", fontsize=9, pad=3)
    handles = [plt.Line2D([], [], color=color) for color in (START, FOUND, TRUE)]
    figure.legend(
        handles, ["the template, placed by landmarks", "matched", "the truth"], loc="lower center", ncols=3,
        frameon=False, fontsize=9, bbox_to_anchor=(0.64, -0.008),
    )  # fmt: skip
    figure.savefig(TARGET, dpi=80)
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


def draw_template(axis: Axes3D, template: Template, up_deg: float, around_deg: float) -> None:
    """Landmarks that the surface hides are hollow."""
    vertices = template.mesh.vertices
    color = "#d98a86" if template.name == "tongue" else "#e9d9a8"
    axis.plot_trisurf(
        *vertices.T, triangles=template.mesh.faces, color=color, edgecolor="#00000028", linewidth=0.2
    )
    up, around = np.radians([up_deg, around_deg])
    eye = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    facing = vertex_normals(vertices, template.mesh.faces) @ eye > 0
    for name, vertex in template.landmarks.items():
        fill = "#c00000" if facing[vertex] else "none"
        axis.scatter(
            *vertices[vertex], facecolor=fill, edgecolor="#c00000", s=16, depthshade=False, zorder=10
        )
        axis.text(*(vertices[vertex] + 1.2 * eye), f"  {name}", fontsize=6.5, zorder=20)
    axis.view_init(up_deg, around_deg)
    axis.set_box_aspect(np.ptp(vertices, axis=0), zoom=1.12)
    axis.set_axis_off()
    axis.set_title(f"the {template.name}'s template, {len(vertices)} vertices", fontsize=9, y=0.98)


def draw_slice(
    axis: Axes, made: PhantomScan, scan: Scan, plane: str, at_mm: float, start: np.ndarray, found: np.ndarray
) -> None:
    right, up = RIGHT_UP[plane]
    low, high = start.min(axis=0) - 13.0, start.max(axis=0) + 13.0
    a, b = np.arange(low[right], high[right], 0.4), np.arange(low[up], high[up], 0.4)
    places = np.full((len(b), len(a), 3), at_mm)
    places[..., right], places[..., up] = np.meshgrid(a, b)
    picture = scan.at(places.reshape(-1, 3)).reshape(len(b), len(a))
    axis.imshow(picture, origin="lower", cmap="gray", extent=(a[0], a[-1], b[0], b[-1]))
    for mesh, color in (
        (Mesh(start, tongue().mesh.faces), START),
        (made.truth.tongue, TRUE),
        (Mesh(found, tongue().mesh.faces), FOUND),
    ):
        for line in contour(mesh, plane, at_mm):
            axis.plot(*line.T, color=color, linewidth=1.4)
    for place in made.tongue_landmarks.values():
        if abs(place[3 - right - up] - at_mm) < 4.0:
            axis.plot(place[right], place[up], "x", color="white", markersize=6)
    axis.set_xticks([])
    axis.set_yticks([])


if __name__ == "__main__":
    main()
