"""A whole phantom data set: scans, landmarks, the file that lists them, and the truth beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .... import InputError, __version__
from ....atomic import write_atomically
from ...mesh import Mesh
from ...synthetic.samples import FILE_NAMES
from ..dataset import Dataset, ScanEntry, dataset_toml, landmarks_csv
from ..scan import Scan, scan_of, write_nifti
from .anatomy import HINGE, Anatomy, head_of, random_anatomy
from .articulation import PALATE_PHONES, PHONES, speakers_articulation
from .landmarks import palate_landmarks, placed, tongue_landmarks
from .render import Imaging, acquired, labels_and_signal
from .surfaces import palate_surface, tongue_surface
from .tissue import Pose
from .tongue import Tongue, tongue_of
from .truth import ScanTruth, write_truth

FloatArray = NDArray[np.float64]

SHAPE = (100, 100, 44)
SPACING_MM = (1.1875, 1.1875, 1.2)
CENTRE_MM = (0.0, 35.0, -11.0)  # of the field of view, head frame of the reference speaker
MISSING_SHARE = 0.04
TURN_DEG = (0.9, 0.5, 0.6)  # standard deviation of the head's turn between scans: nod, shake, tilt
SHIFT_MM = (0.6, 1.0, 1.0)
LARGEST = 2.0  # standard deviations
PROVENANCE = "synthetic: phantom vocal tracts of tonguetrack's own making, not measured from anybody"
# What random numbers are drawn for: each purpose its own stream, so that no change of one disturbs another.
_ANATOMY, _HABITS, _TAKE, _POSITION, _TISSUE, _COIL, _HAND, _MISSING = range(8)
# The FOV's axes: slices run from right to left, in them the first index runs back, the second up.
_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class PhantomScan:
    """One scan, its truth, and the landmarks a person placed on it (world, mm). pose: what the kernels drew."""

    scan: Scan
    truth: ScanTruth
    tongue_landmarks: dict[str, FloatArray]
    palate_landmarks: dict[str, FloatArray]
    pose: Pose


@dataclass(frozen=True)
class PhantomSpeaker:
    """palate_phone: the phone whose scan is marked as the one that shows the palate."""

    number: int
    anatomy: Anatomy
    palate_phone: str


def phantom_speaker(seed: int, number: int) -> PhantomSpeaker:
    """The speaker of that number, from 1, of the phantom with that seed."""
    random = _random(seed, _ANATOMY, number)
    anatomy = random_anatomy(f"Speaker{number:02d}", random)
    return PhantomSpeaker(number, anatomy, PALATE_PHONES[int(random.integers(len(PALATE_PHONES)))])


def speakers_tongue(seed: int, speaker: PhantomSpeaker, phone: str) -> Tongue:
    """The tongue of a speaker who holds a phone; the same for the same numbers."""
    number, place = speaker.number, PHONES.index(phone)
    articulation = speakers_articulation(
        phone, _random(seed, _HABITS, number), _random(seed, _TAKE, number, place)
    )
    return tongue_of(speaker.anatomy, head_of(speaker.anatomy), articulation)


def phantom_scan(
    seed: int, speaker: PhantomSpeaker, phone: str, imaging: Imaging | None = None
) -> PhantomScan:
    """The scan of a speaker who holds a phone; the same for the same numbers."""
    number, place = speaker.number, PHONES.index(phone)
    head = head_of(speaker.anatomy)
    size = speaker.anatomy.size
    tongue = speakers_tongue(seed, speaker, phone)
    to_world = _grid(seed, number)
    head_to_world = _head_position(seed, number, place, size)
    to_head = (np.linalg.inv(head_to_world) @ to_world)[:3] / size
    signal = labels_and_signal(SHAPE, to_head, head, tongue.pose)[1]
    values = acquired(
        signal,
        to_head,
        imaging or Imaging(),
        _random(seed, _TISSUE, number),
        _random(seed, _COIL, number, place),
    )
    surface = tongue_surface(tongue, head)
    palate = palate_surface(head)

    def moved(places: FloatArray) -> FloatArray:
        return np.asarray(size * places @ head_to_world[:3, :3].T + head_to_world[:3, 3])

    def marked(
        true: dict[str, tuple[FloatArray, FloatArray]], hand: np.random.Generator
    ) -> dict[str, FloatArray]:
        world = {
            name: (moved(point), head_to_world[:3, :3] @ normal) for name, (point, normal) in true.items()
        }
        return placed(world, to_world, hand)

    hand = _random(seed, _HAND, number, place)
    return PhantomScan(
        scan_of(values, to_world, f"{speaker.anatomy.name} [{phone}]"),
        ScanTruth(
            Mesh(moved(surface.mesh.vertices), surface.mesh.faces),
            surface.kind,
            Mesh(moved(palate.vertices), palate.faces),
            head_to_world,
        ),
        marked(tongue_landmarks(surface, tongue.base), hand),
        marked(palate_landmarks(palate), hand),
        tongue.pose,
    )


def missing_cells(
    seed: int, speakers: Sequence[PhantomSpeaker], phones: Sequence[str]
) -> set[tuple[int, str]]:
    """(speaker number, phone) of the scans that were never made: a few, none of them a palate scan, and of every
    phone at least half of the speakers remain."""
    random = _random(seed, _MISSING)
    cells = [
        (speaker.number, phone) for speaker in speakers for phone in phones if phone != speaker.palate_phone
    ]
    gone: set[tuple[int, str]] = set()
    for choice in random.permutation(len(cells)):
        if len(gone) >= round(MISSING_SHARE * len(speakers) * len(phones)):
            break
        number, phone = cells[int(choice)]
        if sum(lost == phone for _, lost in gone) + 1 <= len(speakers) // 2:
            gone.add((number, phone))
    return gone


def make_phantom(
    folder: str | Path,
    speakers: int,
    seed: int,
    phones: Sequence[str] = PHONES,
    progress: Callable[[Sequence[tuple[PhantomSpeaker, str]]], Iterable[tuple[PhantomSpeaker, str]]] = iter,
) -> Path:
    """Writes dataset.toml, scans/, landmarks/ and truth/ into the folder; the path of the former is returned.

    phones: some of PHONES, among them PALATE_PHONES. progress: hands on the scans to be made one after the other.
    The same arguments give the same bytes. Raises InputError for a number of speakers below 1 and for a folder
    that holds something already.
    """
    folder = Path(folder)
    if speakers < 1 or speakers > 999:
        raise InputError(f"expected 1 to 999 speakers, not {speakers}.")
    if seed < 0:
        raise InputError(f"the seed {seed} is negative; choose 0 or more.")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected an absent or empty folder, so that nothing is overwritten.")
    for name in ("scans", "landmarks", "truth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    people = [phantom_speaker(seed, number) for number in range(1, speakers + 1)]
    gone = missing_cells(seed, people, phones)
    cells = [(person, phone) for person in people for phone in phones if (person.number, phone) not in gone]
    entries = {}
    files: dict[tuple[str, str], tuple[str, str | None]] = {}
    for person, phone in progress(cells):
        name = person.anatomy.name
        stem = f"{name}_{FILE_NAMES[phone]}"
        made = phantom_scan(seed, person, phone)
        write_nifti(made.scan, folder / "scans" / f"{stem}.nii.gz")
        write_truth(made.truth, folder / "truth" / f"{stem}.npz")
        write_atomically(folder / "landmarks" / f"{stem}.csv", landmarks_csv(made.tongue_landmarks).encode())
        palate = None
        palate_file = None
        if phone == person.palate_phone:
            palate = made.palate_landmarks
            palate_file = f"landmarks/{name}_palate.csv"
            write_atomically(folder / palate_file, landmarks_csv(palate).encode())
        entries[name, phone] = ScanEntry(folder / "scans" / f"{stem}.nii.gz", made.tongue_landmarks, palate)
        files[name, phone] = (f"landmarks/{stem}.csv", palate_file)
    dataset = Dataset(
        folder / "dataset.toml",
        f"{PROVENANCE}; tonguetrack {__version__}, seed {seed}",
        tuple(person.anatomy.name for person in people),
        tuple(phones),
        entries,
        {person.anatomy.name: person.palate_phone for person in people},
    )
    return write_atomically(dataset.source, dataset_toml(dataset, files).encode())


def truth_path(dataset: Dataset, speaker: str, phone: str) -> Path:
    """Where the truth of a phantom's scan lies, which `truth.read_truth` reads."""
    scan = dataset.scans[speaker, phone].path
    return dataset.source.parent / "truth" / f"{scan.name.removesuffix('.nii.gz')}.npz"


def _random(*numbers: int) -> np.random.Generator:
    return np.random.default_rng(list(numbers))


def _grid(seed: int, number: int) -> FloatArray:
    """(4, 4) voxel index -> world: the field of view as the operator set it for this speaker."""
    random = _random(seed, _POSITION, number)
    centre = random.uniform(-25.0, 25.0, size=3)  # of the field of view in the scanner
    to_world = np.eye(4)
    to_world[:3, :3] = _AXES * SPACING_MM
    to_world[:3, 3] = centre - to_world[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    return to_world


def _head_position(seed: int, number: int, place: int, size: float) -> FloatArray:
    """(4, 4) rigid, head frame (mm, true size) -> world: where the operator laid the head, and how it moved since."""
    grid = _grid(seed, number)
    centre = grid[:3, :3] @ ((np.array(SHAPE) - 1) / 2) + grid[:3, 3]
    laid = _random(seed, _POSITION, number, 0)
    moved = _random(seed, _POSITION, number, 1 + place)
    turn = np.array([3.0, 0.7, 0.7]) * _bounded(laid) + TURN_DEG * _bounded(moved)
    shift = np.array([0.5, 2.0, 2.0]) * _bounded(laid) + SHIFT_MM * _bounded(moved)
    pivot = size * np.array([0.0, *HINGE])
    rotation = _rotation(*np.radians(turn))
    to_world = np.eye(4)
    to_world[:3, :3] = rotation
    to_world[:3, 3] = pivot - rotation @ pivot + centre - size * np.array(CENTRE_MM) + shift
    return to_world


def _rotation(nod: float, shake: float, tilt: float) -> FloatArray:
    """(3, 3): about x, then z, then y."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xzy", [nod, shake, tilt]).as_matrix())


def _bounded(random: np.random.Generator) -> FloatArray:
    return np.asarray(random.normal(size=3).clip(-LARGEST, LARGEST))
