"""What a build would have found in a data set whose every surface is known: made directly, without any of its steps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tonguetrack.model.build import TrainingShapes, model_from_shapes
from tonguetrack.model.mesh import Mesh
from tonguetrack.model.mri.dataset import Dataset, Problem, ScanEntry
from tonguetrack.model.mri.phantom.making import truth_path
from tonguetrack.model.mri.phantom.surfaces import BURIED, CONTACT
from tonguetrack.model.mri.phantom.truth import ScanTruth, write_truth
from tonguetrack.model.mri.results import BuildResult, ScanResult
from tonguetrack.model.mri.scan import scan_of, write_nifti
from tonguetrack.model.mri.settings import BuildSettings
from tonguetrack.model.mri.templates import Template
from tonguetrack.model.multilinear import SurfaceMarks
from tonguetrack.model.procrustes import RigidMotion

SPEAKERS, PHONES = ("Speaker01", 'Speaker <b>&"02'), ("i", "a")
PALATE_PHONE = "a"
CELLS = (("Speaker01", "i"), ("Speaker01", "a"), (SPEAKERS[1], "a"))
ROWS, COLUMNS = 21, 15
INITIAL_MM, FINAL_MM = 0.8, 0.25  # above the true tongue
PALATE_OFF_MM, PALATE_OFF_DEG = 0.3, 0.4  # in the scans it was brought to
VOXEL_MM = 1.5
SENTENCE = f"{SPEAKERS[1]} [i]: the file is cut short."


def grid_mesh(z) -> Mesh:
    """z(x, y) over x -16 .. 16 and y 5 .. 50 mm, facing up; rows to the back, columns to the left."""
    x, y = np.meshgrid(np.linspace(-16.0, 16.0, COLUMNS), np.linspace(5.0, 50.0, ROWS))
    grid = np.arange(ROWS * COLUMNS, dtype=np.int32).reshape(ROWS, COLUMNS)
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Mesh(np.stack([x, y, z(x, y)], axis=-1).reshape(-1, 3), faces)


def tongue_height(x, y):
    return 10.0 - (x / 16.0) ** 2 * 4.0 - ((y - 28.0) / 22.0) ** 2 * 8.0


TONGUE = grid_mesh(tongue_height)
_ROOF = grid_mesh(lambda x, y: 16.0 - (x / 16.0) ** 2 * 5.0 + 0.0 * y)
PALATE = Mesh(_ROOF.vertices, _ROOF.faces[:, ::-1].copy())
MIDDLE = tuple(range(COLUMNS // 2, ROWS * COLUMNS, COLUMNS))


@dataclass(frozen=True)
class Made:
    result: BuildResult
    dataset: Dataset


def made_build(folder: Path) -> Made:
    """Scans and truths are written into the folder. Every tongue was found FINAL_MM too high, and every palate that was
    brought to another scan PALATE_OFF_MM too far to the left, turned by PALATE_OFF_DEG."""
    entries, scans = {}, {}
    for name in ("scans", "truth"):
        (folder / name).mkdir(parents=True)
    for number, cell in enumerate(CELLS):
        path = folder / "scans" / f"{number}.nii.gz"
        entries[cell] = ScanEntry(path, {}, {} if cell[1] == PALATE_PHONE else None)
    dataset = Dataset(
        folder / "dataset.toml", "synthetic: domes", SPEAKERS, PHONES, entries, dict.fromkeys(SPEAKERS, PALATE_PHONE)
    )  # fmt: skip
    kind = np.zeros(len(TONGUE.vertices), dtype=np.uint8)
    kind[: 3 * COLUMNS] = CONTACT
    kind[-3 * COLUMNS :] = BURIED
    for number, (cell, entry) in enumerate(entries.items()):
        head = RigidMotion(Rotation.from_rotvec([0.02 * number, 0.01, -0.01 * number]).as_matrix(), np.array([1.0, 2.0, 3.0]) * number)  # fmt: skip
        write_nifti(_scan(head), entry.path)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = head.rotation, head.shift
        truth = ScanTruth(
            Mesh(head.apply(TONGUE.vertices), TONGUE.faces),
            kind if cell[1] == "i" else np.where(kind == CONTACT, 0, kind).astype(np.uint8),
            Mesh(head.apply(PALATE.vertices), PALATE.faces),
            matrix,
        )
        write_truth(truth, truth_path(dataset, *cell))
        palate = PALATE.vertices
        if cell[1] != PALATE_PHONE:
            middle = palate.mean(axis=0)
            turned = Rotation.from_rotvec([np.radians(PALATE_OFF_DEG), 0.0, 0.0]).apply(palate - middle)
            palate = turned + middle + [PALATE_OFF_MM, 0.0, 0.0]
        scans[cell] = ScanResult(
            *cell, entry, "", head.apply(palate), 0.9, _inverse(head),
            head.apply(TONGUE.vertices + [0.0, 0.0, INITIAL_MM]), head.apply(TONGUE.vertices + [0.0, 0.0, FINAL_MM]),
            (0.5, 0.4, 0.2 + number / 10.0), (0.8, 0.9, 0.95), number, True,
            ("Its points are <far> away.",) if number else (), float(number),
        )  # fmt: skip
    shapes = np.array(
        [[(TONGUE.vertices + [speaker, phone, speaker * phone]).ravel() for phone in (0, 1)] for speaker in (0, 1)]
    )  # fmt: skip
    training = TrainingShapes(
        shapes, TONGUE.faces, SPEAKERS, PHONES, ((SPEAKERS[1], "i"),), provenance={"data": dataset.provenance}
    )  # fmt: skip
    result = BuildResult(
        dataset.source, BuildSettings(), _template("tongue", TONGUE), _template("palate", PALATE), scans,
        (Problem(SPEAKERS[1], "i", SENTENCE),), training, model_from_shapes(training, 2, 2), {"scans": 1.5, "tongues": 2.0},
        {"averaging": 2.5, "low rank": 1.25},
    )  # fmt: skip
    return Made(result, dataset)


def _scan(head: RigidMotion):
    """Bright below the tongue, and above the palate; dark in between."""
    low, size = np.array([-24.0, -2.0, -12.0]), (32, 40, 30)
    to_world = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    to_world[:3, 3] = head.apply((low + 22.0)[None])[0] - 22.0
    places = np.indices(size).reshape(3, -1).T * VOXEL_MM + to_world[:3, 3]
    x, y, z = _inverse(head).apply(places).T
    # A voxel's share of tissue, as a scanner sees it.
    below = np.clip((tongue_height(x, y) - z) / VOXEL_MM + 0.5, 0.0, 1.0)
    above = np.clip((z - 16.0 + (x / 16.0) ** 2 * 5.0) / VOXEL_MM + 0.5, 0.0, 1.0)
    return scan_of((200.0 * np.maximum(below, above)).astype(np.float32).reshape(size), to_world, "dome")


def _inverse(motion: RigidMotion) -> RigidMotion:
    return RigidMotion(motion.rotation.T, -motion.rotation.T @ motion.shift)


def _template(name: str, mesh: Mesh) -> Template:
    mirror = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)[:, ::-1].ravel()
    return Template(name, mesh, {}, SurfaceMarks(midsagittal=MIDDLE), mirror)
