"""Draws docs/overview.png, the README's picture, from the bundled model and recording (needs the extra `plot`).

python docs/make_overview.py
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from tonguetrack import track_recording
from tonguetrack.tracker.bundled import bundled_model, bundled_recording

FRAME = 610
COIL, SKIN = "#d9480f", "#e8a89a"


def main() -> None:
    model = bundled_model()
    recording, session = bundled_recording()
    run = track_recording(recording, model, session)
    poses = run.experiment_2
    assert poses is not None
    coils = poses.coils[FRAME]
    mesh = run.speaker.mesh(poses.weights[FRAME])

    figure = plt.figure(figsize=(9.6, 3.0), dpi=100, layout="constrained")
    left, middle, right = (figure.add_subplot(1, 3, column) for column in (1, 2, 3))
    past = slice(FRAME - 40, FRAME + 1)
    for index, role in enumerate(poses.roles):
        left.plot(
            poses.coils[past, index, 1], poses.coils[past, index, 2], color=COIL, alpha=0.35, linewidth=1
        )
        left.annotate(role.removeprefix("tongue_"), coils[index, 1:], (6, -14), textcoords="offset points")
    left.scatter(coils[:, 1], coils[:, 2], color=COIL, zorder=3)
    left.set_title("coils in")

    weights = poses.normalised[FRAME]
    middle.barh(np.arange(len(weights)), weights, color="#5f6b7a")
    middle.axvline(0, color="black", linewidth=0.8)
    middle.set(title="a few weights (sigma)", xlim=(-3, 3), yticks=[], xticks=[-2, 0, 2])
    middle.invert_yaxis()

    triangles = mesh.vertices[mesh.faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    # Seen from the speaker's left, painted from the far side to the near one.
    light = np.clip(np.abs(normals @ np.array([0.75, -0.25, 0.61])), 0.15, 1.0)
    base = np.array(matplotlib.colors.to_rgb(SKIN))
    for face in np.argsort(triangles[:, :, 0].mean(axis=1)):
        right.fill(*triangles[face, :, 1:].T, color=base * (0.45 + 0.55 * light[face]), linewidth=0.3)
    right.scatter(coils[:, 1], coils[:, 2], color=COIL, zorder=3)
    right.set_title("the whole tongue out (synthetic)")

    low = mesh.vertices[:, 1:].min(axis=0) - 4
    high = mesh.vertices[:, 1:].max(axis=0) + 4
    for axes in (left, right):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
    figure.savefig(Path(__file__).parent / "overview.png", metadata={"Software": None})


if __name__ == "__main__":
    main()
