"""Mode products and the HOSVD over speaker and pose modes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack.model.tensor import cumulative_compactness, hosvd, mode_product, unfold

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 12))


def random_tensor(shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


@given(SIZES, st.integers(0, 2), st.integers(1, 5))
def test_a_mode_product_multiplies_every_fibre_of_that_mode(shape, mode, rows):
    tensor = random_tensor(shape)
    matrix = random_tensor((rows, shape[mode]), seed=1)
    product = mode_product(tensor, matrix, mode)
    np.testing.assert_allclose(unfold(product, mode), matrix @ unfold(tensor, mode), atol=1e-12)


@given(SIZES)
def test_products_along_different_modes_commute(shape):
    tensor = random_tensor(shape)
    first, second = random_tensor((3, shape[0]), 1), random_tensor((2, shape[1]), 2)
    np.testing.assert_allclose(
        mode_product(mode_product(tensor, first, 0), second, 1),
        mode_product(mode_product(tensor, second, 1), first, 0),
        atol=1e-12,
    )


@given(SIZES)
@settings(max_examples=50)
def test_an_untruncated_hosvd_gives_the_tensor_back(shape):
    tensor = random_tensor(shape)
    parts = hosvd(tensor)
    rebuilt = mode_product(mode_product(parts.core, parts.speaker_factors, 0), parts.pose_factors, 1)
    np.testing.assert_allclose(rebuilt, tensor, atol=1e-10)


def test_factors_are_orthonormal_and_the_core_is_all_orthogonal():
    parts = hosvd(random_tensor((7, 5, 40)))
    np.testing.assert_allclose(parts.speaker_factors.T @ parts.speaker_factors, np.eye(7), atol=1e-12)
    np.testing.assert_allclose(parts.pose_factors.T @ parts.pose_factors, np.eye(5), atol=1e-12)
    for mode, spectrum in ((0, parts.speaker_spectrum), (1, parts.pose_spectrum)):
        gram = unfold(parts.core, mode) @ unfold(parts.core, mode).T
        np.testing.assert_allclose(gram, np.diag(spectrum), atol=1e-9)


def test_truncation_keeps_the_leading_components_and_the_whole_spectrum():
    parts = hosvd(random_tensor((7, 5, 40)))
    small = parts.truncated(3, 2)
    np.testing.assert_array_equal(small.core, parts.core[:3, :2])
    assert small.speaker_factors.shape == (7, 3)
    assert len(small.speaker_spectrum) == 7


def test_the_error_of_truncation_is_bounded_by_the_discarded_eigenvalues():
    tensor = random_tensor((7, 5, 40))
    parts = hosvd(tensor)
    small = parts.truncated(4, 3)
    rebuilt = mode_product(mode_product(small.core, small.speaker_factors, 0), small.pose_factors, 1)
    discarded = parts.speaker_spectrum[4:].sum() + parts.pose_spectrum[3:].sum()
    assert np.sum((tensor - rebuilt) ** 2) <= discarded + 1e-9


def test_signs_are_fixed_so_that_the_same_shapes_give_the_same_model():
    parts = hosvd(random_tensor((6, 4, 30)))
    for factors in (parts.speaker_factors, parts.pose_factors):
        largest = np.argmax(np.abs(factors), axis=0)
        assert (factors[largest, np.arange(factors.shape[1])] > 0).all()


def test_compactness_grows_to_one():
    share = cumulative_compactness(hosvd(random_tensor((6, 4, 30))).speaker_spectrum)
    assert (np.diff(share) >= -1e-12).all()
    assert share[-1] == pytest.approx(1.0)
