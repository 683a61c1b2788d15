"""How far the found vertices lie from the true ones, on real speakers whom the model has never seen.

    python tests/bench/held_out_correspondences.py PATH/sampleDatabase.yaml

Leaves one speaker out at a time; coils are three mid-sagittal vertices of that speaker's 13 true meshes with
0.3 mm of noise. Prints the mean distance on the surface from the true vertex to the one that was found: from
one frame, as in the paper, and from all frames together, as `tonguetrack track` does.
"""

import sys

import numpy as np

from tonguetrack.model.build import (
    TrainingShapes,
    load_training_shapes,
    model_from_shapes,
    read_sample_database,
)
from tonguetrack.tracker.correspondences import estimate_correspondences, typical_frame
from tonguetrack.tracker.session import Energy

ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum")
TRUE_VERTICES = [2465, 1912, 1250]  # of the Ultrax meshes


def main(database: str) -> None:
    shapes = load_training_shapes(read_sample_database(database))
    speakers = len(shapes.speakers)
    errors: dict[str, list[np.ndarray]] = {"one frame": [], "all frames": []}
    for held_out in range(speakers):
        keep = [i for i in range(speakers) if i != held_out]
        names = tuple(shapes.speakers[i] for i in keep)
        model = model_from_shapes(
            TrainingShapes(shapes.tensor[keep], shapes.faces, names, shapes.prompts), 5, 4
        )
        meshes = shapes.tensor[held_out].reshape(len(shapes.prompts), -1, 3)
        noise = np.random.default_rng(held_out).normal(0, 0.3, (len(meshes), 3, 3))
        coils = meshes[:, TRUE_VERTICES] + noise
        for name, frames in (("one frame", coils[[typical_frame(coils)]]), ("all frames", coils)):
            found = estimate_correspondences(model, frames, ROLES, Energy())
            apart = meshes[0, TRUE_VERTICES] - meshes[0, list(found.vertices)]
            errors[name].append(np.linalg.norm(apart, axis=1))
    for name, values in errors.items():
        by_coil = ", ".join(
            f"{role} {value:.1f}" for role, value in zip(ROLES, np.mean(values, axis=0), strict=True)
        )
        print(f"{name:10}  mean {np.mean(values):.2f} mm ({by_coil})")


if __name__ == "__main__":
    main(sys.argv[1])
