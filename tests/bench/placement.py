"""How often calibrate places a speaker of the model to 0.3 mm and 0.5 degree, with everything at once.

    python tests/bench/placement.py --seeds 10

Each seed is one case of `everything_at_once` in tests/test_calibration.py: a speaker of the model of parametric speakers, eight
seconds with a moving head, a mirrored and turned file, a bite plate, a slipping reference, 5 % dropouts and 0.3 mm of
noise; once with four tongue coils and once with three. Printed for each number of coils: how many cases are within the
bounds, the worst and the root mean square of the errors, and how many are more than three stated standard deviations away.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from test_calibration import FOUR_COILS, everything_at_once

BOUNDS = {"y and z": (0.3, "mm"), "turn": (0.5, "degrees")}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--seeds", type=int, default=10, help="cases for each number of coils: seeds 0, 1, ..."
    )
    chosen = parser.parse_args()
    for coils in (4, 3):
        errors = []
        for seed in range(chosen.seeds):
            errors.append(everything_at_once(seed, dict(list(FOUR_COILS.items())[:coils])))
            print(
                f"{coils} coils, seed {seed}: {errors[-1][0]:.2f} mm, {errors[-1][1]:.2f} degrees, "
                f"{errors[-1][2]:.1f} standard deviations",
                flush=True,
            )
        told, deviations = np.array(errors)[:, :2], np.array(errors)[:, 2]
        within = int((told < [bound for bound, _ in BOUNDS.values()]).all(axis=1).sum())
        print(f"{coils} coils: {within} of {len(told)} within 0.3 mm and 0.5 degree")
        for (name, (_, unit)), column in zip(BOUNDS.items(), told.T, strict=True):
            print(f"  {name}: worst {column.max():.2f}, rms {np.sqrt(np.mean(column**2)):.2f} {unit}")
        print(f"  more than 3 stated standard deviations away: {int((deviations > 3.0).sum())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
