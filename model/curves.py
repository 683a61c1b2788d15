"""What an evaluation measures over the number of components, and how its parts run on the local cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from .mesh import FloatArray

Task = TypeVar("Task")
Result = TypeVar("Result")
Progress = Callable[[Iterable[Any], str, int], Iterable[Any]]
"""Hands on results as they come, and may show, under a heading, how many of so many there are."""


@dataclass(frozen=True)
class Curve:
    """Distances in mm for 1, 2, ... components of a mode, all arrays (components,).

    mean_mm, deviation_mm: over everything that was measured with so many components; counts: how much that was.
    """

    mean_mm: FloatArray
    deviation_mm: FloatArray
    counts: NDArray[np.intp]

    @property
    def standard_error_mm(self) -> FloatArray:
        """How far the mean is off by chance where the measurements are independent samples."""
        return np.asarray(self.deviation_mm / np.sqrt(self.counts))


def silent(results: Iterable[Any], heading: str, count: int) -> Iterable[Any]:
    """The progress that shows nothing."""
    return results


def run_all(
    work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int, progress: Progress, heading: str
) -> list[Result]:
    """work(task) for every task, in their order, in so many processes (-1: one for each core)."""
    from joblib import Parallel, delayed  # type: ignore[import-untyped]

    if jobs == 0 or jobs < -1:
        raise InputError(
            f"{jobs} processes cannot do anything; expected 1 or more, or -1 for one on each core."
        )
    results = Parallel(n_jobs=jobs, return_as="generator")(delayed(work)(task) for task in tasks)
    return list(progress(results, heading, len(tasks)))
