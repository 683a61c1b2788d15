"""Recordings of the parametric speakers of model/synthetic, and the model built from them.

Their truth is exact to the vertex: a coil sits at a vertex of the very template that the model has. What was measured
about calibration and alignment was measured with them; the bundled model and its recordings are of another family, whose
surfaces come from volumes.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from tonguetrack.drivers import Recording
from tonguetrack.model import TongueModel
from tonguetrack.model.build import TrainingShapes, model_from_shapes
from tonguetrack.model.multilinear import SurfaceMarks
from tonguetrack.model.synthetic import (
    PHONES,
    Anatomy,
    articulation_for,
    blend,
    random_anatomy,
    random_habits,
    tongue_surface,
    tongue_template,
    training_anatomies,
)
from tonguetrack.model.synthetic.samples import PROVENANCE, training_shapes
from tonguetrack.tracker.simulation import (
    HEAD_COILS,
    Simulation,
    frame_times,
    minimum_jerk,
    phone_sequence,
    recorded,
)

# mm behind the tip along the template's middle, and across it in the template's degrees.
TONGUE_COILS = {
    "tongue_tip": (8.0, 0.0),
    "tongue_blade": (25.0, 0.0),
    "tongue_dorsum": (45.0, 0.0),
    "tongue_back": (56.0, 0.0),
    "tongue_left": (25.0, 35.0),
    "tongue_right": (25.0, -35.0),
}
CONTROL_RATE_HZ = 100.0
UNSEEN_SPEAKER_OFFSET = 1000  # seeds below this belong to the training speakers' habits


@cache
def parametric_model() -> TongueModel:
    """Of 11 speakers and 13 phones, 5 speaker and 4 pose weights."""
    template = tongue_template()
    shapes = training_shapes()
    return model_from_shapes(
        TrainingShapes(
            shapes.reshape(*shapes.shape[:2], -1),
            template.faces,
            tuple(anatomy.name for anatomy in training_anatomies()),
            tuple(PHONES),
            marks=SurfaceMarks(template.landmarks, template.regions, template.midsagittal),
            provenance={"data": PROVENANCE},
        ),
        5,
        4,
        {"name": "parametric synthetic tongue"},
    )


@dataclass(frozen=True)
class ParametricTruth:
    """As `tonguetrack.tracker.simulation.Truth`; vertices: each tongue coil's vertex of the template, by role."""

    vertices: dict[str, int]
    positions: np.ndarray
    head_rotation: np.ndarray
    head_translation_mm: np.ndarray
    anatomy: Anatomy


def simulate_parametric(simulation: Simulation) -> tuple[Recording, ParametricTruth]:
    """A recording of a parametric speaker outside the training set, and its truth. Deterministic."""
    from scipy.interpolate import CubicSpline

    anatomy = random_anatomy(simulation.speaker)
    habits = random_habits(UNSEEN_SPEAKER_OFFSET + simulation.speaker)
    times = frame_times(simulation)
    phones, _ = phone_sequence(simulation)
    vertices = {role: coil_vertex(role) for role in simulation.coils if role in TONGUE_COILS}

    # The surface is evaluated at the control rate; speech moves slowly enough for splines between.
    control = np.arange(0.0, times[-1] + 2.0 / CONTROL_RATE_HZ, 1.0 / CONTROL_RATE_HZ)
    targets = {phone: articulation_for(anatomy, phone, habits) for phone in simulation.phones}
    sampled = np.empty((len(control), len(vertices), 3))
    index, share = minimum_jerk(control, simulation.phone_s, len(phones))
    for row, (now, t) in enumerate(zip(index, share, strict=True)):
        articulation = blend(targets[phones[max(now - 1, 0)]], targets[phones[now]], t)
        sampled[row] = tongue_surface(anatomy, articulation)[list(vertices.values())]
    moving = CubicSpline(control, sampled.reshape(len(control), -1))(times).reshape(len(times), -1, 3)
    order = list(vertices)
    positions = np.empty((len(times), len(simulation.coils), 3))
    for index, role in enumerate(simulation.coils):
        positions[:, index] = moving[:, order.index(role)] if role in vertices else HEAD_COILS[role]
    recording, rotation, translation = recorded(simulation, positions, anatomy.name)
    return recording, ParametricTruth(vertices, positions, rotation, translation, anatomy)


def coil_vertex(role: str) -> int:
    """The template's vertex under a tongue coil."""
    template = tongue_template()
    distance, angle = TONGUE_COILS[role]
    row = int(np.argmin(np.abs(template.s - template.tip_s - distance)))
    column = int(np.argmin(np.abs(template.theta - angle)))
    return row * len(template.theta) + column
