"""Recordings of a synthetic speaker outside the training set, with everything that is true about them."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .. import InputError, __version__
from ..atomic import write_atomically
from ..drivers import FrameOfReference, Recording, write_recording
from ..model.synthetic import (
    PHONES,
    Anatomy,
    Articulation,
    Habits,
    articulation_for,
    blend,
    random_anatomy,
    random_habits,
    tongue_surface,
    tongue_template,
)
from .pose import FloatArray

# Places of coils: mm behind the tip along the tongue's midline, and across it in degrees of the template.
TONGUE_COILS = {
    "tongue_tip": (8.0, 0.0),
    "tongue_blade": (25.0, 0.0),
    "tongue_dorsum": (45.0, 0.0),
    "tongue_back": (56.0, 0.0),
    "tongue_left": (25.0, 35.0),
    "tongue_right": (25.0, -35.0),
}
# Reference coils on the head, which no articulation moves: (x, y, z) mm in the model frame.
HEAD_COILS = {
    "head_nose": (0.0, -14.0, 48.0),
    "head_left": (66.0, 88.0, 34.0),
    "head_right": (-66.0, 88.0, 34.0),
    "head_upper_incisor": (0.0, -2.0, 4.0),
}
CONTROL_RATE_HZ = 100.0
CONTOUR_RATE_HZ = 25.0
TRANSITION_SHARE = 0.7  # of a phone's time is movement, the rest is held
DROPOUT_S = 0.04
RECORDED_DECIMALS = 3  # a micrometre: far below any articulograph's resolution
PALATE_FROM_MM = 2.0  # behind the incisors: nearer, a probe coil has no room
PALATE_STEP_MM = 1.0
UNSEEN_SPEAKER_OFFSET = 1000  # seeds below this belong to the training speakers' habits


@dataclass(frozen=True)
class Simulation:
    """What to simulate. phones: the sequence, repeated until `seconds` (None: once); coils: roles.

    speaker: seed of the anatomy and its habits; noise_mm: standard deviation per coordinate;
    dropouts: share of each coil's samples that are missing, in runs of about 40 ms.
    """

    phones: tuple[str, ...]
    coils: tuple[str, ...] = ("tongue_tip", "tongue_blade", "tongue_dorsum")
    speaker: int = 1
    seconds: float | None = None
    phone_s: float = 0.2
    rate_hz: float = 250.0
    noise_mm: float = 0.3
    dropouts: float = 0.0
    head_motion: bool = False
    seed: int = 1

    def __post_init__(self) -> None:
        for phone in self.phones:
            if phone not in PHONES:
                raise InputError(
                    f"the phone '{phone}' is unknown; the synthetic speakers know {' '.join(PHONES)}."
                )
        known = [*TONGUE_COILS, *HEAD_COILS]
        for role in self.coils:
            if role not in known:
                raise InputError(f"the coil '{role}' is unknown; coils can sit at {', '.join(known)}.")
        if not self.phones or not self.coils or len(set(self.coils)) < len(self.coils):
            raise InputError("a simulation needs at least one phone, and at least one coil, each coil once.")
        ranges = {
            "rate": (self.rate_hz, 1.0, 5000.0),
            "phone-seconds": (self.phone_s, 0.02, 60.0),
            "seconds": (self.length_s, 0.05, 36000.0),
            "noise": (self.noise_mm, 0.0, 100.0),
            "dropouts": (self.dropouts, 0.0, 0.95),
            "speaker": (self.speaker, 0, 10**6),
            "seed": (self.seed, 0, 10**9),
        }
        for name, (value, low, high) in ranges.items():
            if not low <= value <= high:
                raise InputError(f"--{name} {value:g}: expected {low:g} to {high:g}.")

    @property
    def length_s(self) -> float:
        return self.seconds if self.seconds is not None else self.phone_s * len(self.phones)


@dataclass(frozen=True)
class Truth:
    """What is true of a simulated recording, in mm and the model frame.

    vertices: each tongue coil's vertex of the synthetic template, by role; positions: (frames, coils, 3)
    without noise, dropouts or head motion; head_rotation (frames, 3, 3), head_translation_mm (frames, 3):
    recorded = rotation @ position + translation; phone_times_s: (phones + 1,) where each phone begins;
    phones: their names; contour_times_s (c,), contours (c, points, 3): the mid-sagittal upper surface.
    """

    vertices: dict[str, int]
    positions: FloatArray
    head_rotation: FloatArray
    head_translation_mm: FloatArray
    phone_times_s: FloatArray
    phones: tuple[str, ...]
    contour_times_s: FloatArray
    contours: FloatArray
    anatomy: Anatomy
    habits: Habits


def simulate(simulation: Simulation) -> tuple[Recording, Truth]:
    """The recording, in the model frame apart from head motion, and its truth. Deterministic."""
    from scipy.interpolate import CubicSpline

    anatomy, habits = unseen_speaker(simulation.speaker)
    count = max(2, round(simulation.length_s * simulation.rate_hz))
    times = np.arange(count) / simulation.rate_hz
    phones, starts = _phone_sequence(simulation)
    vertices = {role: coil_vertex(role) for role in simulation.coils if role in TONGUE_COILS}

    # The surface is evaluated at the control rate; speech moves slowly enough for splines between.
    control = np.arange(0.0, times[-1] + 2.0 / CONTROL_RATE_HZ, 1.0 / CONTROL_RATE_HZ)
    targets = [articulation_for(anatomy, phone, habits) for phone in phones]
    # Of each shape only the coils' and, now and then, the contour's points are kept: an hour has 360,000.
    midsagittal = list(tongue_template().midsagittal)
    every = max(1, round(CONTROL_RATE_HZ / CONTOUR_RATE_HZ))
    sampled = np.empty((len(control), len(vertices), 3))
    contours = np.empty((len(control[::every]), len(midsagittal), 3))
    for index, t in enumerate(control):
        shape = tongue_surface(anatomy, _articulation_at(t, targets, simulation.phone_s))
        sampled[index] = shape[list(vertices.values())]
        if index % every == 0:
            contours[index // every] = shape[midsagittal]
    moving = CubicSpline(control, sampled.reshape(len(control), -1))(times).reshape(count, -1, 3)

    positions = np.empty((count, len(simulation.coils), 3))
    order = list(vertices)
    for index, role in enumerate(simulation.coils):
        positions[:, index] = moving[:, order.index(role)] if role in vertices else HEAD_COILS[role]
    random = np.random.default_rng([simulation.seed, 5])
    rotation, translation = _head_motion(times, simulation.head_motion, random)
    recorded = np.einsum("tab,tcb->tca", rotation, positions) + translation[:, None, :]
    recorded += random.normal(scale=simulation.noise_mm, size=recorded.shape) if simulation.noise_mm else 0.0
    recorded = np.round(recorded, RECORDED_DECIMALS)
    recorded[_dropouts(simulation, count, random)] = np.nan

    truth = Truth(
        vertices, positions, rotation, translation, starts, phones, control[::every],
        contours, anatomy, habits,
    )  # fmt: skip
    moved = "after head motion" if simulation.head_motion else "the model's"
    recording = Recording(
        coils=simulation.coils,
        positions=recorded,
        times_s=times,
        rate_hz=simulation.rate_hz,
        format="simulated",
        frame=FrameOfReference("left", "back", "up", f"upper incisors, {moved}"),
        notes=(f"Synthetic: speaker {anatomy.name}, outside the training set of the bundled model.",),
        extra={"simulation": json.dumps(asdict(simulation), ensure_ascii=False), "made_by": f"tonguetrack {__version__}"},
    )  # fmt: skip
    return recording, truth


def unseen_speaker(seed: int) -> tuple[Anatomy, Habits]:
    """A synthetic speaker who is not in the training set of the bundled model."""
    return random_anatomy(seed), random_habits(UNSEEN_SPEAKER_OFFSET + seed)


def coil_vertex(role: str) -> int:
    """The template's vertex under a tongue coil."""
    template = tongue_template()
    distance, angle = TONGUE_COILS[role]
    row = int(np.argmin(np.abs(template.s - template.tip_s - distance)))
    column = int(np.argmin(np.abs(template.theta - angle)))
    return row * len(template.theta) + column


def write_simulation(simulation: Simulation, path: str | Path) -> tuple[Path, Path]:
    """Writes the recording and NAME.truth.npz beside it; returns both paths."""
    path = Path(path)
    recording, truth = simulate(simulation)
    words = {
        "vertices": truth.vertices,
        "phones": list(truth.phones),
        "anatomy": asdict(truth.anatomy),
        "habits": asdict(truth.habits),
        "simulation": asdict(simulation),
        "model_frame": "x left, y back, z up; mm; mid-sagittal plane x = 0",
    }
    arrays = {
        name: getattr(truth, name).astype(np.float32)
        for name in (
            "positions", "head_rotation", "head_translation_mm", "phone_times_s", "contour_times_s", "contours",
        )
    }  # fmt: skip
    if not simulation.head_motion:
        del arrays["head_rotation"], arrays["head_translation_mm"]
    stream = io.BytesIO()
    text = json.dumps(words, ensure_ascii=False).encode()
    np.savez_compressed(stream, words=np.frombuffer(text, dtype=np.uint8), **arrays)
    write_recording(recording, path)
    write_atomically(truth_path(path), stream.getvalue())
    return path, truth_path(path)


def truth_path(path: str | Path) -> Path:
    """Where the truth of the recording at `path` is written."""
    return Path(path).with_name(f"{Path(path).stem}.truth.npz")


def palate_trace(simulation: Simulation) -> FloatArray:
    """(n, 3) mm on this speaker's hard palate, in its middle, from front to back: where a probe would be swept.

    In the axes of the recording; where the head moves these are no axes of the mouth, so that raises InputError.
    """
    if simulation.head_motion:
        raise InputError(
            "--palate: a trace has one place, but with --head-motion the mouth moves in the recording's axes; leave one "
            "of the two out."
        )
    anatomy, _ = unseen_speaker(simulation.speaker)
    back = np.arange(PALATE_FROM_MM, anatomy.hard_palate_mm, PALATE_STEP_MM)
    middle = np.zeros(len(back))
    return np.column_stack([middle, back, anatomy.palate_z(middle, back)])


def write_palate(points_mm: FloatArray, path: str | Path) -> None:
    """Writes points (n, 3) mm as `palate.read_palate` reads a trace: three numbers a line, and nothing else."""
    lines = [",".join(f"{value:.{RECORDED_DECIMALS}f}" for value in point) for point in points_mm]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _phone_sequence(simulation: Simulation) -> tuple[tuple[str, ...], FloatArray]:
    count = max(1, int(np.ceil(simulation.length_s / simulation.phone_s - 1e-9)))
    phones = tuple(simulation.phones[index % len(simulation.phones)] for index in range(count))
    return phones, np.asarray(np.arange(count + 1) * simulation.phone_s, dtype=np.float64)


def _articulation_at(time_s: float, targets: list[Articulation], phone_s: float) -> Articulation:
    """Minimum-jerk movement into each phone's target, which is then held."""
    index = min(int(time_s / phone_s), len(targets) - 1)
    if index == 0:
        return targets[0]
    progress = min((time_s - index * phone_s) / (TRANSITION_SHARE * phone_s), 1.0)
    smooth = progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)
    return blend(targets[index - 1], targets[index], smooth)


def _head_motion(
    times: FloatArray, moving: bool, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """A head that nods, turns and drifts by some degrees and millimetres about the model's origin."""
    rotation = np.broadcast_to(np.eye(3), (len(times), 3, 3)).copy()
    translation = np.zeros((len(times), 3))
    if not moving:
        return rotation, translation
    from scipy.spatial.transform import Rotation

    frequency = random.uniform(0.15, 0.6, (2, 3))
    phase = random.uniform(0.0, 2.0 * np.pi, (2, 3))
    angles = np.array([6.0, 2.0, 5.0]) * np.sin(2 * np.pi * frequency[0] * times[:, None] + phase[0])
    translation = np.array([6.0, 8.0, 5.0]) * np.sin(2 * np.pi * frequency[1] * times[:, None] + phase[1])
    return np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix()), translation


def _dropouts(simulation: Simulation, count: int, random: np.random.Generator) -> np.ndarray:
    """(frames, coils) True where a sample is missing: runs whose lengths and gaps give the wanted share."""
    missing = np.zeros((count, len(simulation.coils)), dtype=bool)
    if simulation.dropouts == 0.0:
        return missing
    run = max(1.0, DROPOUT_S * simulation.rate_hz)
    gap = run * (1.0 - simulation.dropouts) / simulation.dropouts
    for coil in range(missing.shape[1]):
        frame = random.exponential(gap)
        while frame < count:
            length = 1 + random.geometric(1.0 / run)
            missing[int(frame) : int(frame + length), coil] = True
            frame += length + random.exponential(gap)
    return missing
