"""What specificity and model fitting cost, each beside its plain form in the same run.

    python tests/bench/model_evaluation.py [SAMPLES.yaml]

Specificity: the nearest mesh by bounds against looking at every vertex of every mesh (NumPy, float32), as microseconds a
sample, and what the paper's 24 rows of 1,000,000 samples would take on two cores by that. Fitting: one registered mesh,
5 x 4 weights, after start-up. Without a database, on the synthetic speakers.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tonguetrack.model.build import load_training_shapes, model_from_shapes, read_sample_database
from tonguetrack.model.evaluation import SPEECH, with_unions
from tonguetrack.model.fitting import fit_shapes
from tonguetrack.model.specificity import specificity_rows
from tonguetrack.model.synthetic.samples import write_samples

SAMPLES, COMPARED, FITS = 20_000, 300, 30


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = sys.argv[1] if len(sys.argv) > 1 else write_samples(Path(folder))
        database = read_sample_database(path)
        shapes = load_training_shapes(database)
    region = with_unions(database.marks.regions).get(SPEECH, range(shapes.tensor.shape[2] // 3))
    rows = [
        *specificity_rows(shapes, "speaker", min(4, len(shapes.prompts)), region),
        *specificity_rows(shapes, "pose", min(5, len(shapes.speakers)), region),
    ]
    rows[0].errors(np.random.default_rng(0), 10)
    spent = 0.0
    for row in rows:
        start = time.process_time()
        for part in range(0, SAMPLES, 250):
            row.errors(np.random.default_rng(part), 250)
        spent += time.process_time() - start
    ours = spent / (SAMPLES * len(rows))
    print(f"specificity on {len(region)} vertices: {1e6 * ours:.1f} us of CPU a sample over {len(rows)} rows")
    print(f"  24 rows of 1,000,000 on two cores, by that: {24e6 * ours / 2 / 60:.1f} min")
    row = rows[-1]
    exact = row.errors(np.random.default_rng(1), COMPARED)
    shapes_made = row.shapes(np.random.default_rng(1), COMPARED)[0]
    start = time.process_time()
    brute = [np.sqrt(((one - row.nearest.meshes) ** 2).sum(axis=1)).mean(axis=1).min() for one in shapes_made]
    plain = (time.process_time() - start) / COMPARED
    off = np.abs(exact - brute).max()
    print(
        f"  every vertex of every mesh: {1e6 * plain:.0f} us, {plain / ours:.0f} x; largest difference {off:.1e} mm"
    )
    model = model_from_shapes(shapes, 5, 4)
    meshes = shapes.tensor.reshape(-1, model.vertex_count, 3)
    taken = []
    for mesh in meshes[: FITS + 1]:
        start = time.perf_counter()
        fit_shapes(model, mesh[None], 2.0)
        taken.append(1e3 * (time.perf_counter() - start))
    taken = taken[1:]  # the first loads what scipy needs
    print(
        f"fit of one registered mesh: median {np.median(taken):.1f} ms, slowest of {FITS} {max(taken):.1f} ms"
    )


if __name__ == "__main__":
    main()
