"""How near template matching comes to the true tongues of phantom scans, and how long it takes: our settings, the
paper's, and trimesh's `nricp_sumner` from the same start on the same points.

    python tests/bench/template_matching.py FOLDER/dataset.toml --scans 6

Contact is restored with the true palate, so that matching alone is measured. `nricp_sumner` tells points of the tongue
from others by their distance only; in a second row it is given the tongue's own points alone, picked by the truth.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mri.contact import restore_contact
from tonguetrack.model.mri.dataset import ScanEntry, load_dataset
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.matching import PAPER_TONGUE, TONGUE, MatchSettings, flipped_faces, match
from tonguetrack.model.mri.phantom.truth import ScanTruth, read_truth
from tonguetrack.model.mri.scan import read_scan
from tonguetrack.model.mri.surface import surface_points
from tonguetrack.model.mri.templates import landmark_vertices, placed, tongue
from tonguetrack.model.mri.truthcomparison import surface_error
from tonguetrack.model.neighbours import SurfaceIndex

OWN_MM = 1.5  # a point of the cloud so near to the true tongue is the tongue's own
REACH_MM = 4.0


def prepared(entry: ScanEntry) -> tuple[Cloud, ScanTruth]:
    scan = read_scan(entry.path)
    if entry.region is not None:
        scan = scan.cropped(entry.region.low_mm, entry.region.high_mm)
    scan = scan.quantised()
    truth = read_truth(entry.path.parents[1] / "truth" / entry.path.name.replace(".nii.gz", ".npz"))
    cloud = surface_points(scan.holding(denoise(scan.values, scan.spacing_mm)))
    return restore_contact(cloud, truth.palate), truth


def by_series(entry: ScanEntry, cloud: Cloud, settings: MatchSettings) -> np.ndarray:
    start = placed(tongue(), entry.tongue_landmarks)
    return match(start, tongue(), SurfaceIndex(cloud), entry.tongue_landmarks, settings).vertices


def by_trimesh(entry: ScanEntry, points: np.ndarray) -> np.ndarray:
    start = trimesh.Trimesh(placed(tongue(), entry.tongue_landmarks), tongue().mesh.faces, process=False)
    marked = landmark_vertices(tongue(), entry.tongue_landmarks)
    return trimesh.registration.nricp_sumner(
        start,
        trimesh.Trimesh(points, np.empty((0, 3), dtype=int), process=False),
        source_landmarks=np.array(list(marked)),
        target_positions=np.array(list(marked.values())),
        distance_threshold=REACH_MM / start.scale,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--scans", type=int, default=6, help="spread evenly over the data set")
    args = parser.parse_args()
    dataset = load_dataset(args.dataset)
    keys = list(dataset.scans)
    picked = [keys[i] for i in np.linspace(0, len(keys) - 1, args.scans).round().astype(int)]
    rows: dict[str, list[list[float]]] = {}
    for number, key in enumerate([picked[0], *picked]):  # the first one compiles, and is not counted
        entry = dataset.scans[key]
        cloud, truth = prepared(entry)
        own = cKDTree(truth.tongue.vertices).query(cloud.points)[0] < OWN_MM
        ways = {
            "placed by landmarks": lambda e=entry: placed(tongue(), e.tongue_landmarks),
            "ours": lambda e=entry, c=cloud: by_series(e, c, TONGUE),
            "the paper's settings": lambda e=entry, c=cloud: by_series(e, c, PAPER_TONGUE),
            "nricp_sumner": lambda e=entry, c=cloud: by_trimesh(e, c.points),
            "nricp_sumner, own points": lambda e=entry, c=cloud, o=own: by_trimesh(e, c.points[o]),
        }
        for name, way in ways.items():
            begin = time.perf_counter()
            vertices = np.asarray(way())
            taken_s = time.perf_counter() - begin
            error = surface_error(vertices, tongue().mesh.faces, truth.tongue, truth.kind)
            flipped = flipped_faces(vertices, tongue().mesh.faces)
            if number:
                rows.setdefault(name, []).append(
                    [error.mean, error.high, error.contact, error.buried, error.back, flipped, taken_s]
                )
    print(f"{args.scans} scans: {', '.join(f'{speaker} [{phone}]' for speaker, phone in picked)}")
    print(
        f"{'':26}{'mm':>7}{'95 %':>7}{'contact':>9}{'buried':>8}{'back':>7}{'folds':>7}{'s':>8}{'times ours':>12}"
    )
    ours_s = np.mean([row[-1] for row in rows["ours"]])
    for name, values in rows.items():
        mean, high, contact, buried, back, folds, seconds = np.nanmean(values, axis=0)
        print(
            f"{name:26}{mean:7.2f}{high:7.2f}{contact:9.2f}{buried:8.2f}{back:7.2f}{folds:7.1f}{seconds:8.2f}"
            f"{seconds / ours_s:12.1f}"
        )


if __name__ == "__main__":
    main()
