"""Recordings of a synthetic speaker outside the training set, with everything that is true about them.

The speakers are of the family of the MRI phantom that the bundled model was built from (`model.mri.phantom`), whose head
frame is the model's frame.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .. import InputError, __version__
from ..atomic import write_atomically
from ..drivers import FrameOfReference, Recording, write_recording
from ..model.mri.phantom.anatomy import Anatomy
from ..model.mri.phantom.articulation import PHONES
from ..model.mri.phantom.unseen import SHIPPED, unseen_speaker
from .pose import FloatArray

# Places of coils: mm behind the tip along the middle of the neutral tongue, and share of the way to its left edge.
TONGUE_COILS = {
    "tongue_tip": (8.0, 0.0),
    "tongue_blade": (25.0, 0.0),
    "tongue_dorsum": (45.0, 0.0),
    "tongue_back": (56.0, 0.0),
    "tongue_left": (25.0, 0.6),
    "tongue_right": (25.0, -0.6),
}
# Reference coils on the head, which no articulation moves: (x, y, z) mm in the model frame.
HEAD_COILS = {
    "head_nose": (0.0, -14.0, 48.0),
    "head_left": (66.0, 88.0, 34.0),
    "head_right": (-66.0, 88.0, 34.0),
    "head_upper_incisor": (0.0, -2.0, 4.0),
}
CONTOUR_RATE_HZ = 25.0
TRANSITION_SHARE = 0.7  # of a phone's time is movement, the rest is held
DROPOUT_S = 0.04
RECORDED_DECIMALS = 3  # a micrometre: far below any articulograph's resolution


@dataclass(frozen=True)
class Simulation:
    """What to simulate. phones: the sequence, repeated until `seconds` (None: once); coils: roles.

    speaker: its number among the unseen ones; noise_mm: standard deviation per coordinate;
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

    @property
    def ships(self) -> bool:
        """Whether the speaker comes with the package; any other is computed, in some seconds."""
        return self.speaker in SHIPPED


@dataclass(frozen=True)
class Truth:
    """What is true of a simulated recording, in mm and the model frame.

    places: where each tongue coil sits, by role: mm behind the tip along the middle of the neutral tongue, and share
    of the way from the middle to the left edge; positions: (frames, coils, 3) without noise, dropouts or head motion;
    head_rotation (frames, 3, 3), head_translation_mm (frames, 3): recorded = rotation @ position + translation;
    phone_times_s: (phones + 1,) where each phone begins; phones: their names; contour_times_s (c,), contours
    (c, points, 3): the tongue's middle from tip to vallecula, the same flesh throughout; palate: (n, 3) the middle of
    the hard palate from front to back.
    """

    places: dict[str, tuple[float, float]]
    positions: FloatArray
    head_rotation: FloatArray
    head_translation_mm: FloatArray
    phone_times_s: FloatArray
    phones: tuple[str, ...]
    contour_times_s: FloatArray
    contours: FloatArray
    palate: FloatArray
    anatomy: Anatomy


def simulate(simulation: Simulation) -> tuple[Recording, Truth]:
    """The recording, in the model frame apart from head motion, and its truth. Deterministic."""
    speaker = unseen_speaker(simulation.speaker, simulation.phones)
    phones, starts = phone_sequence(simulation)
    times = frame_times(simulation)
    places = {role: TONGUE_COILS[role] for role in simulation.coils if role in TONGUE_COILS}
    resting = {
        phone: np.array(
            [
                speaker.at(phone, *places[role]) if role in places else HEAD_COILS[role]
                for role in simulation.coils
            ]
        )
        for phone in simulation.phones
    }
    positions = _moved([resting[phone] for phone in phones], times, simulation.phone_s)
    contour_times = np.arange(0.0, times[-1], 1.0 / CONTOUR_RATE_HZ)
    middles = {phone: speaker.middle(phone) for phone in simulation.phones}
    contours = _moved([middles[phone] for phone in phones], contour_times, simulation.phone_s)
    recording, rotation, translation = recorded(simulation, positions, speaker.anatomy.name)
    return recording, Truth(
        places, positions, rotation, translation, starts, phones, contour_times, contours, speaker.palate(),
        speaker.anatomy,
    )  # fmt: skip


def frame_times(simulation: Simulation) -> FloatArray:
    """(frames,) s."""
    count = max(2, round(simulation.length_s * simulation.rate_hz))
    return np.asarray(np.arange(count) / simulation.rate_hz)


def phone_sequence(simulation: Simulation) -> tuple[tuple[str, ...], FloatArray]:
    """The phones as they follow each other, and (phones + 1,) s where they begin."""
    count = max(1, int(np.ceil(simulation.length_s / simulation.phone_s - 1e-9)))
    phones = tuple(simulation.phones[index % len(simulation.phones)] for index in range(count))
    return phones, np.asarray(np.arange(count + 1) * simulation.phone_s, dtype=np.float64)


def minimum_jerk(
    times_s: FloatArray, phone_s: float, phone_count: int
) -> tuple[NDArray[np.intp], FloatArray]:
    """(n,) the phone at each time, and how far (0 to 1) the way there from the phone before has been gone: a
    minimum-jerk movement into each phone's target, which is then held."""
    index = np.minimum((times_s / phone_s).astype(np.intp), phone_count - 1)
    progress = ((times_s - index * phone_s) / (TRANSITION_SHARE * phone_s)).clip(0.0, 1.0)
    smooth = progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)
    return index, np.where(index == 0, 1.0, smooth)


def recorded(
    simulation: Simulation, positions: FloatArray, speaker: str
) -> tuple[Recording, FloatArray, FloatArray]:
    """What an articulograph makes of true positions (frames, coils, 3), by head motion, noise, dropouts and rounding;
    and the head's rotation (frames, 3, 3) and translation (frames, 3)."""
    times = frame_times(simulation)
    random = np.random.default_rng([simulation.seed, 5])
    rotation, translation = _head_motion(times, simulation.head_motion, random)
    measured = np.einsum("tab,tcb->tca", rotation, positions) + translation[:, None, :]
    measured += random.normal(scale=simulation.noise_mm, size=measured.shape) if simulation.noise_mm else 0.0
    measured = np.round(measured, RECORDED_DECIMALS)
    measured[_dropouts(simulation, len(times), random)] = np.nan
    moved = "after head motion" if simulation.head_motion else "the model's"
    recording = Recording(
        coils=simulation.coils,
        positions=measured,
        times_s=times,
        rate_hz=simulation.rate_hz,
        format="simulated",
        frame=FrameOfReference("left", "back", "up", f"upper incisors, {moved}"),
        notes=(f"Synthetic: speaker {speaker}, outside the training set of the bundled model.",),
        extra={"simulation": json.dumps(asdict(simulation), ensure_ascii=False), "made_by": f"tonguetrack {__version__}"},
    )  # fmt: skip
    return recording, rotation, translation


def write_simulation(simulation: Simulation, path: str | Path) -> tuple[Path, Path]:
    """Writes the recording and NAME.truth.npz beside it; returns both paths."""
    path = Path(path)
    recording, truth = simulate(simulation)
    words = {
        "places": truth.places,
        "phones": list(truth.phones),
        "anatomy": asdict(truth.anatomy),
        "simulation": asdict(simulation),
        "model_frame": "x left, y back, z up; mm; mid-sagittal plane x = 0",
    }
    arrays = {
        name: getattr(truth, name)
        for name in (
            "positions", "head_rotation", "head_translation_mm", "phone_times_s", "contour_times_s", "contours",
            "palate",
        )
    }  # fmt: skip
    if not simulation.head_motion:
        del arrays["head_rotation"], arrays["head_translation_mm"]
    stream = io.BytesIO()
    text = json.dumps(words, ensure_ascii=False).encode()
    np.savez_compressed(stream, words=np.frombuffer(text, dtype=np.uint8),
                        **{name: array.astype(np.float32) for name, array in arrays.items()})  # fmt: skip
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
    return unseen_speaker(simulation.speaker, ()).palate()


def write_palate(points_mm: FloatArray, path: str | Path) -> None:
    """Writes points (n, 3) mm as `palate.read_palate` reads a trace: three numbers a line, and nothing else."""
    lines = [",".join(f"{value:.{RECORDED_DECIMALS}f}" for value in point) for point in points_mm]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _moved(targets: Sequence[FloatArray], times_s: FloatArray, phone_s: float) -> FloatArray:
    """(n, ...) from each phone's target to the next."""
    index, share = minimum_jerk(times_s, phone_s, len(targets))
    stacked = np.array(targets)
    before, now = stacked[np.maximum(index - 1, 0)], stacked[index]
    return np.asarray(before + share.reshape(-1, *(1,) * (stacked.ndim - 1)) * (now - before))


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
