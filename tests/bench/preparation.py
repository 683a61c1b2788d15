"""What preparing one live frame costs: five coils, four references of the head, the preset `carstens`.

    python tests/bench/preparation.py [--frames N]

Beside it, in turns and in the same run, the obvious way in numpy: boolean masks, the head's motion by
`scipy.spatial.transform.Rotation.align_vectors`, a recursive filter on whole arrays. It trusts every reference.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from tonguetrack.tracker.headcorrection import HeadReference
from tonguetrack.tracker.preparation import Preparation
from tonguetrack.tracker.session import Alignment
from tonguetrack.tracker.smoothing import NO_SMOOTHING, PRESETS

RATE_HZ = 250.0
TURNS = 10
ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum", "tongue_left", "jaw")
HEAD_ROLES = ("head_nose", "head_left", "head_right", "head_top")
REST = np.array([[0.0, -90.0, 40.0], [70.0, 10.0, 30.0], [-70.0, 10.0, 30.0], [0.0, -40.0, 110.0]])
ALIGNMENT = Alignment(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([1.0, 2.0, 3.0]), True)
PICKED, REFERENCES = np.arange(5), np.arange(5, 9)
ONE_POLE_HZ = np.array([80.0] * 5 + [20.0] * 4)


def some_frames(count: int) -> np.ndarray:
    """(count, 9, 3) mm: a head that turns, a tongue that moves, noise."""
    random = np.random.default_rng(1)
    times = np.arange(count) / RATE_HZ
    coils = random.normal(scale=10.0, size=(5, 3)) + 5.0 * np.sin(20.0 * times)[:, None, None]
    still = np.concatenate([coils, np.broadcast_to(REST, (count, 4, 3))], axis=1)
    turns = Rotation.from_rotvec(0.1 * np.sin(times)[:, None] * [0.3, 0.5, 0.8]).as_matrix()
    return np.einsum("tab,tcb->tca", turns, still) + random.normal(scale=0.1, size=still.shape)


def ours(head: bool, smoothing: bool) -> Callable[[np.ndarray], np.ndarray]:
    preparation = Preparation(
        PICKED,
        ALIGNMENT,
        ROLES,
        HeadReference(HEAD_ROLES, REST, "bench") if head else None,
        REFERENCES if head else None,
        PRESETS["carstens"][0] if smoothing else NO_SMOOTHING,
        RATE_HZ,
    )
    return lambda raw: preparation.frame(raw, 1.0 / RATE_HZ)


def obvious(head: bool, smoothing: bool) -> Callable[[np.ndarray], np.ndarray]:
    weights = -np.expm1(-2.0 * np.pi * ONE_POLE_HZ / RATE_HZ)[:, None]
    smooth = np.full((9, 3), np.nan)

    def frame(raw: np.ndarray) -> np.ndarray:
        nonlocal smooth
        used = raw
        if smoothing:
            smooth = np.where(np.isnan(smooth), raw, smooth + weights * (raw - smooth))
            used = smooth
        coils = used[PICKED]
        if head:
            now = used[REFERENCES]
            turn = Rotation.align_vectors(now - now.mean(axis=0), REST - REST.mean(axis=0))[0].as_matrix()
            coils = (coils - now.mean(axis=0)) @ turn + REST.mean(axis=0)
        placed = coils @ ALIGNMENT.rotation.T + ALIGNMENT.translation_mm
        placed[:, 0] = 0.0
        placed[~np.isfinite(coils).all(axis=1)] = np.nan
        return placed

    return frame


def measured(frames: np.ndarray, prepare: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(frames,) us"""
    times = np.empty(len(frames))
    clock = time.perf_counter_ns
    for index, raw in enumerate(frames):
        start = clock()
        prepare(raw)
        times[index] = (clock() - start) / 1000.0
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description="What preparing one live frame costs.")
    parser.add_argument("--frames", type=int, default=2000, help="in each of the ten turns")
    frames = some_frames(parser.parse_args().frames)
    print(f"{'us a frame':28}{'median':>8}{'p99':>8}{'numpy':>8}{'ratio':>7}")
    for name, head, smoothing in (
        ("pick and align", False, False),
        ("with head", True, False),
        ("with smoothing", False, True),
        ("with head and smoothing", True, True),
    ):
        ways = (ours(head, smoothing), obvious(head, smoothing))
        # Unless both do the same, the comparison is none; the first compiles or loads.
        for raw in frames[:100]:
            apart = np.abs(ways[0](raw) - ways[1](raw)).max()
            assert apart < 0.1, f"{name}: {apart:.2g} mm apart"
        turns = [[measured(frames, way) for way in ways] for _ in range(TURNS)]
        own, other = (np.concatenate(times) for times in zip(*turns, strict=True))
        median, plain = np.median(own), np.median(other)
        print(
            f"{name:28}{median:8.1f}{np.percentile(own, 99):8.1f}{plain:8.1f}{plain / median:7.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
