"""Third-order tensors: unfolding, mode products, and the HOSVD over the first two modes.

The third mode (the vertex coordinates) is never decomposed (paper, section "Model construction").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def unfold(tensor: FloatArray, mode: int) -> FloatArray:
    """The mode-`mode` unfolding: (size of that mode, product of the others)."""
    return np.moveaxis(tensor, mode, 0).reshape(tensor.shape[mode], -1)


def mode_product(tensor: FloatArray, matrix: FloatArray, mode: int) -> FloatArray:
    """tensor x_mode matrix: every mode-`mode` fibre is multiplied by matrix (rows, size of that mode)."""
    return np.moveaxis(np.tensordot(matrix, tensor, axes=(1, mode)), 0, mode)


@dataclass(frozen=True, slots=True)
class Hosvd:
    """A = core x1 speaker_factors x2 pose_factors, exactly when nothing is truncated.

    core: (m, n, k); speaker_factors: (speakers, m); pose_factors: (poses, n), orthonormal columns.
    speaker_spectrum: (speakers,), pose_spectrum: (poses,): all eigenvalues of A_(mode) A_(mode)^T in
    descending order, kept whole under truncation because compactness is read from them.
    """

    core: FloatArray
    speaker_factors: FloatArray
    pose_factors: FloatArray
    speaker_spectrum: FloatArray
    pose_spectrum: FloatArray

    def truncated(self, speaker_modes: int, pose_modes: int) -> Hosvd:
        """Keeps the leading components of both modes."""
        return Hosvd(
            np.ascontiguousarray(self.core[:speaker_modes, :pose_modes]),
            self.speaker_factors[:, :speaker_modes].copy(),
            self.pose_factors[:, :pose_modes].copy(),
            self.speaker_spectrum,
            self.pose_spectrum,
        )


def hosvd(tensor: FloatArray) -> Hosvd:
    """Higher-order SVD of a (speakers, poses, k) tensor over its first two modes."""
    speaker_factors, speaker_spectrum = _left_singular_vectors(unfold(tensor, 0))
    pose_factors, pose_spectrum = _left_singular_vectors(unfold(tensor, 1))
    core = mode_product(mode_product(tensor, speaker_factors.T, 0), pose_factors.T, 1)
    return Hosvd(core, speaker_factors, pose_factors, speaker_spectrum, pose_spectrum)


def cumulative_compactness(spectrum: FloatArray) -> FloatArray:
    """Share of the variance that the first 1, 2, ... components carry; the last entry is 1."""
    return np.cumsum(spectrum) / np.sum(spectrum)


def _left_singular_vectors(unfolded: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Columns by descending eigenvalue of the Gram matrix, each signed so that its largest entry is positive.

    The Gram matrix of a mode is tiny (11 x 11, 13 x 13) and its eigenvectors are the left singular
    vectors; the fixed sign makes a model file reproducible.
    """
    eigenvalues, vectors = np.linalg.eigh(unfolded @ unfolded.T)
    vectors = vectors[:, ::-1]
    largest = np.argmax(np.abs(vectors), axis=0)
    signs = np.sign(vectors[largest, np.arange(vectors.shape[1])])
    return vectors * signs, np.maximum(eigenvalues[::-1], 0.0)
