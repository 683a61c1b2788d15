"""The whole mesh from the coils by a linear Gaussian posterior: a constant matrix, without weights in between.

The training shapes, all speakers and poses in one pool, are taken for samples of one normal distribution N(mean, C)
of mesh coordinates, and a coil's position for its vertex with independent noise. What is known of the mesh once the
coils q are seen is then normal as well, with the mean

    mean + C_vq (C_qq + noise^2 I)^-1 (q - mean_q)

C_vq: the covariance of all coordinates with those at the coils, C_qq: of the latter among themselves. The matrix
depends on where the coils sit and on the noise, not on where they are: a frame costs one product. Nothing is
truncated, so that everything that ever moved together with a coil in the training shapes helps; but one speaker's
frames do not know that they share an anatomy. (Conditional normal distribution; kriging, Gaussian process regression
with the shapes' own covariance as the kernel.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import InputError
from .pose import FloatArray


@dataclass(frozen=True)
class LinearPosterior:
    """What n coils say about k = 3 V mesh coordinates. mm, in the frame of the training shapes.

    mean: (k,); mean_at_coils: (3n,) the same at the coils' vertices; cross: (k, 3n) C_vq; at_coils: (3n, 3n) C_qq
    with the noise's variance on its diagonal.
    """

    mean: FloatArray
    mean_at_coils: FloatArray
    cross: FloatArray
    at_coils: FloatArray

    def gain(self, present: NDArray[np.intp]) -> FloatArray:
        """(k, 3p) mm per mm: how these coils (p,), by their numbers from 0, move the mesh."""
        rows = (present[:, None] * 3 + np.arange(3)).ravel()
        return np.asarray(np.linalg.solve(self.at_coils[np.ix_(rows, rows)], self.cross[:, rows].T).T)

    def shapes(self, coils: FloatArray) -> FloatArray:
        """(T, k) mm: the posterior mean for each frame of coils (T, n, 3). A missing coil (NaN) says nothing; a frame
        without any is the mean shape."""
        found = np.tile(self.mean, (len(coils), 1))
        seen = ~np.isnan(coils).any(axis=2)
        offsets = coils - self.mean_at_coils.reshape(-1, 3)
        for pattern in np.unique(seen, axis=0):
            frames = np.flatnonzero((seen == pattern).all(axis=1))
            present = np.flatnonzero(pattern)
            if len(present):
                found[frames] += (
                    offsets[np.ix_(frames, present)].reshape(len(frames), -1) @ self.gain(present).T
                )
        return found


def posterior_from_shapes(shapes: FloatArray, vertices: Sequence[int], noise_mm: float) -> LinearPosterior:
    """The posterior for coils at these vertices, from training shapes (N, k).

    noise_mm: the standard deviation of each coordinate of a coil about its vertex. Besides the articulograph's noise it
    stands for everything that the training shapes do not know. Raises InputError for less than two shapes, and for
    noise that is not above 0: more coils than shapes would leave nothing to invert.
    """
    if len(shapes) < 2:
        raise InputError(f"a covariance needs at least two training shapes, not {len(shapes)}.")
    if not 0 < noise_mm < np.inf:
        raise InputError(f"the noise of the coils is {noise_mm:g} mm; the posterior needs a number above 0.")
    mean = shapes.mean(axis=0)
    deviations = shapes - mean
    rows = (np.asarray(vertices, dtype=np.intp)[:, None] * 3 + np.arange(3)).ravel()
    cross = deviations.T @ deviations[:, rows] / (len(shapes) - 1)
    return LinearPosterior(mean, mean[rows], cross, cross[rows] + noise_mm**2 * np.eye(len(rows)))
