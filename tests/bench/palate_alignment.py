"""How near palates and their alignments come to the truth of a phantom data set.

    python tests/bench/palate_alignment.py DATASET.toml [--speakers N]

The palates are extracted as `mri build` does it (one round of bootstrapping), then brought to every other scan of their
speaker. Palates: mean distance of the true vertices to the extracted ones' faces, sampled finely, mm. Alignments: root of
the mean square over the palate's vertices, mm, and degrees, against the head's true motion; first without any
alignment, then by denoised scans, then as it is done; with the time of each on this machine.
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tonguetrack.model.mesh import vertex_normals
from tonguetrack.model.mri.dataset import Dataset, load_dataset
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.matching import PALATE, match
from tonguetrack.model.mri.palatealignment import STILL, align_palate
from tonguetrack.model.mri.palates import (
    PalatePriorSettings,
    first_match,
    palate_model,
    palate_surface,
    start_of,
)
from tonguetrack.model.mri.phantom.making import truth_path
from tonguetrack.model.mri.phantom.truth import ScanTruth, read_truth
from tonguetrack.model.mri.scan import Scan, read_scan
from tonguetrack.model.mri.templates import palate
from tonguetrack.model.neighbours import SurfaceIndex
from tonguetrack.model.procrustes import RigidMotion

FloatArray = NDArray[np.float64]
FINER = 5


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset")
    parser.add_argument("--speakers", type=int, default=None)
    args = parser.parse_args()
    dataset = load_dataset(args.dataset)
    speakers = dataset.speakers[: args.speakers]
    palates = extracted(dataset, speakers)
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for speaker in speakers:
        phone = dataset.palate_phone[speaker]
        before = truth(dataset, speaker, phone)
        own = read_scan(dataset.scans[speaker, phone].path).quantised()
        own_smooth = smooth(own)
        vertices = palates[speaker]
        normals = vertex_normals(vertices, palate().mesh.faces)
        for other in (p for s, p in dataset.scans if s == speaker and p != phone):
            true = head_motion(before, truth(dataset, speaker, other))
            scan = read_scan(dataset.scans[speaker, other].path).quantised()
            scan_smooth = smooth(scan)
            rows.setdefault("not aligned", []).append((*errors(STILL, true, vertices), 0.0))
            for name, pair in (("denoised", (own_smooth, scan_smooth)), ("as built", (own, scan))):
                start_s = time.perf_counter()
                found = align_palate(vertices, normals, *pair)
                taken_s = time.perf_counter() - start_s
                rows.setdefault(name, []).append((*errors(found.motion, true, vertices), taken_s))
    print(
        f"{'alignment':12} {'scans':>5} {'mean mm':>8} {'worst':>6} {'mean deg':>9} {'worst':>6} {'median s':>9}"
    )
    for name, found_rows in rows.items():
        table = np.array(found_rows)
        (mm, deg, _), (most_mm, most_deg, _) = table.mean(axis=0), table.max(axis=0)
        print(
            f"{name:12} {len(table):5} {mm:8.3f} {most_mm:6.3f} {deg:9.3f} {most_deg:6.3f} {np.median(table[:, 2]):9.2f}"
        )


def extracted(dataset: Dataset, speakers: tuple[str, ...]) -> dict[str, FloatArray]:
    template, prior = palate(), PalatePriorSettings()
    marks = {
        name: dataset.scans[name, dataset.palate_phone[name]].palate_landmarks or {} for name in speakers
    }
    indices = {}
    for name in speakers:
        scan = read_scan(dataset.scans[name, dataset.palate_phone[name]].path).quantised()
        indices[name] = SurfaceIndex(palate_surface(smooth(scan), marks[name], template))
    found = {
        name: first_match(index, marks[name], template, PALATE).vertices for name, index in indices.items()
    }
    print(f"palates at first: {distance(dataset, found):.3f} mm")
    for _ in range(prior.rounds if len(found) > 1 else 0):
        model = palate_model(found, template)
        starts = {
            name: start_of(model, found[name], index, marks[name], template, PALATE.rule, prior)
            for name, index in indices.items()
        }
        found = {
            name: match(starts[name], template, index, marks[name], PALATE).vertices
            for name, index in indices.items()
        }
        print(f"after a round: {distance(dataset, found):.3f} mm")
    return found


def distance(dataset: Dataset, palates: dict[str, FloatArray]) -> float:
    """Mean over speakers, mm."""
    picks = [(i, j, FINER - i - j) for i in range(FINER + 1) for j in range(FINER + 1 - i)]
    shares = np.array(picks) / FINER
    means = []
    for name, vertices in palates.items():
        dense = np.einsum("sc,fca->fsa", shares, vertices[palate().mesh.faces]).reshape(-1, 3)
        true = truth(dataset, name, dataset.palate_phone[name]).palate.vertices
        means.append(cKDTree(dense).query(true)[0].mean())
    return float(np.mean(means))


def smooth(scan: Scan) -> Scan:
    return scan.holding(denoise(scan.values, scan.spacing_mm))


def truth(dataset: Dataset, speaker: str, phone: str) -> ScanTruth:
    return read_truth(truth_path(dataset, speaker, phone))


def head_motion(before: ScanTruth, after: ScanTruth) -> RigidMotion:
    moved = after.head_to_world @ np.linalg.inv(before.head_to_world)
    return RigidMotion(moved[:3, :3], moved[:3, 3])


def errors(found: RigidMotion, true: RigidMotion, places: FloatArray) -> tuple[float, float]:
    apart = found.apply(places) - true.apply(places)
    cosine = (np.trace(found.rotation @ true.rotation.T) - 1.0) / 2.0
    return float(np.sqrt((apart**2).sum(axis=1).mean())), float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


if __name__ == "__main__":
    main()
