"""Edge-enhancing diffusion: what it must keep, what it may not do whatever the step, and that it works in mm."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.model.mri.diffusion import (
    _advance,
    _diffusion_tensor,
    _largest_eigenpair,
    _mixed_flux,
    _repeat_edges,
    denoise,
    largest_stable_step_mm2,
    steepest_edge,
)

SPACING = (1.1875, 1.1875, 1.2)
shapes = st.tuples(*[st.integers(1, 7)] * 3)
spacings = st.tuples(*[st.floats(0.3, 3.0)] * 3)
seeds = st.integers(0, 2**32 - 1)


def noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 255, size=shape)


def places(shape: tuple[int, ...], spacing: tuple[float, ...]) -> np.ndarray:
    """(i, j, k, 3) mm of the voxels of a grid about the origin."""
    axes = [(np.arange(n) - (n - 1) / 2) * h for n, h in zip(shape, spacing, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def soft(signed_mm: np.ndarray) -> np.ndarray:
    """Air of 30, tissue of 170 where the signed distance is negative, and about a voxel of transition."""
    return 30.0 + 140.0 / (1.0 + np.exp(signed_mm / 0.35))


# What is kept ---------------------------------------------------------------------------------------


@given(shapes, spacings, st.floats(0, 255), st.floats(0.01, 20))
@settings(max_examples=30, deadline=None)
def test_a_constant_volume_stays_what_it_is(shape, spacing, grey, step):
    after = denoise(np.full(shape, grey), spacing, steps=3, step=step)
    np.testing.assert_allclose(after, np.float32(grey), rtol=1e-6, atol=1e-6)


@given(shapes, spacings, seeds, st.floats(0.01, 20), st.floats(0.001, 1))
@settings(max_examples=60, deadline=None)
def test_the_mean_is_kept_and_the_variance_never_grows_however_long_the_step(
    shape, spacing, seed, step, contrast
):
    before = noise(shape, seed).astype(np.float32)
    for _ in range(4):
        after = denoise(before, spacing, steps=1, step=step, contrast=contrast)
        assert after.mean(dtype=np.float64) == pytest.approx(before.mean(dtype=np.float64), rel=1e-5)
        assert after.std(dtype=np.float64) <= before.std(dtype=np.float64) * (1 + 1e-5) + 1e-4
        before = after


def test_no_steps_leave_the_volume_alone_and_the_input_is_never_changed():
    before = noise((5, 6, 7)).astype(np.float32)
    kept = before.copy()
    np.testing.assert_array_equal(denoise(before, SPACING, steps=0), kept)
    denoise(before, SPACING, steps=2)
    np.testing.assert_array_equal(before, kept)


def test_the_type_of_the_numbers_does_not_matter():
    grey = noise((8, 9, 10)).astype(np.uint8)
    results = [denoise(grey.astype(kind), SPACING, steps=3) for kind in (np.uint8, np.float32, np.float64)]
    assert all(result.dtype == np.float32 for result in results)
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


# The scheme -----------------------------------------------------------------------------------------


def random_tensors(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """(i, j, k, 3, 3) I - c v v^T with 0 <= c <= 1, as the diffusion has them, but in every direction."""
    random = np.random.default_rng(seed)
    v = random.normal(size=(*shape, 3))
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    c = random.choice([0.0, 0.5, 1.0], size=shape)
    return np.eye(3) - c[..., None, None] * v[..., :, None] * v[..., None, :]


def padded(tensors: np.ndarray) -> np.ndarray:
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    parts = np.stack([tensors[..., a, b] for a, b in pairs]).astype(np.float32)
    return np.ascontiguousarray(np.pad(parts, [(0, 0), (1, 1), (1, 1), (1, 1)]))


def energy(u: np.ndarray, tensors: np.ndarray, spacing: tuple[float, ...]) -> float:
    """As the module's docstring has it, word by word."""
    differences = []
    for axis, h in enumerate(spacing):
        forward = np.diff(u, axis=axis, append=np.take(u, [-1], axis)) / h
        backward = np.diff(u, axis=axis, prepend=np.take(u, [0], axis)) / h
        differences.append((forward, backward))
    total = 0.0
    for choice in itertools.product((0, 1), repeat=3):
        d = np.stack([differences[axis][side] for axis, side in enumerate(choice)], axis=-1)
        total += float(np.einsum("...a,...ab,...b", d, tensors, d).sum())
    return total / 8 / 2


def one_step(u: np.ndarray, tensors: np.ndarray, spacing: tuple[float, ...], step: float) -> np.ndarray:
    diffusion = padded(tensors)
    before = np.pad(u.astype(np.float32), 1, mode="edge")
    after, mixed = np.empty_like(before), np.zeros((3, *before.shape), np.float32)
    inverse = (1 / np.array(spacing)).astype(np.float32)
    _mixed_flux(before, diffusion, inverse, mixed)
    _advance(before, diffusion, mixed, inverse, np.float32(step), after)
    return after[1:-1, 1:-1, 1:-1].astype(np.float64)


@given(shapes, spacings, seeds)
@settings(max_examples=30, deadline=None)
def test_a_step_is_the_steepest_descent_of_the_stated_energy(shape, spacing, seed):
    random = np.random.default_rng(seed)
    u, direction = random.normal(size=shape), random.normal(size=shape)
    tensors = random_tensors(shape, seed)
    slope = (energy(u + direction, tensors, spacing) - energy(u - direction, tensors, spacing)) / 2
    step = largest_stable_step_mm2(spacing)
    change = (one_step(u, tensors, spacing, step) - u.astype(np.float32)) / step
    assert -np.sum(change * direction) == pytest.approx(slope, rel=1e-3, abs=1e-3 * np.sum(np.abs(change)))


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), SPACING, (0.4, 1.0, 3.0)])
def test_up_to_the_stated_step_no_volume_grows_and_beyond_it_one_does(spacing):
    """The roughest volume, a three-dimensional chessboard, is where the limit comes from."""
    chessboard = np.where(np.indices((16, 16, 16)).sum(axis=0) % 2, 1.0, -1.0)
    limit = largest_stable_step_mm2(spacing)
    free = np.broadcast_to(np.eye(3), (16, 16, 16, 3, 3))
    grown = [
        np.linalg.norm(one_step(chessboard, free, spacing, factor * limit)) / np.linalg.norm(chessboard)
        for factor in (1.0, 1.3)
    ]
    assert grown[0] <= 1.0 < grown[1]
    for seed in range(20):
        u = np.random.default_rng(seed).normal(size=(6, 6, 6)) if seed else chessboard[:6, :6, :6]
        tensors = random_tensors((6, 6, 6), seed)
        for _ in range(30):
            after = one_step(u, tensors, spacing, limit)
            assert np.linalg.norm(after) <= np.linalg.norm(u) * (1 + 1e-6)
            u = after


def test_without_edges_noise_spreads_by_two_t_along_every_axis_in_mm_squared():
    """The second moment of a point under the heat equation; the differences keep it to the last digit."""
    spacing = (0.8, 1.2, 2.0)
    shape = (41, 31, 21)
    u = np.zeros(shape)
    u[20, 15, 10] = 100.0
    after = denoise(u, spacing, steps=10, step=0.2, contrast=100.0).astype(np.float64)
    moments = (after[..., None] * places(shape, spacing) ** 2).sum(axis=(0, 1, 2)) / after.sum()
    np.testing.assert_allclose(moments, 2 * 10 * 0.2, rtol=1e-3)


@given(seeds, st.floats(-3, 3))
@settings(max_examples=60, deadline=None)
def test_the_largest_eigenpair_is_numpys(seed, power):
    factor = np.random.default_rng(seed).normal(size=(3, 3))
    matrix = factor @ factor.T * 10**power
    value, *vector = _largest_eigenpair(*matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    values, vectors = np.linalg.eigh(matrix)
    assert value == pytest.approx(values[2], rel=1e-9)
    if values[1] < 0.99 * values[2]:
        assert abs(vectors[:, 2] @ vector) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    "matrix", [np.zeros((3, 3)), np.eye(3), np.diag([2.0, 2, 1]), np.ones((3, 3)) + 3 * np.eye(3)]
)
def test_where_no_direction_is_singled_out_none_is_invented(matrix):
    value, *vector = _largest_eigenpair(*matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    assert value == pytest.approx(np.linalg.eigvalsh(matrix)[2])
    ambiguous = np.ptp(np.linalg.eigvalsh(matrix)[1:]) < 1e-9
    assert np.linalg.norm(vector) == pytest.approx(0.0 if ambiguous else 1.0)


@pytest.mark.parametrize(("sigma_mm", "rho_mm"), [(1.0, 1.0), (1.0, 0.0), (2.0, 1.5)])
def test_contrast_is_measured_against_a_sharp_edge_from_black_to_white(sigma_mm, rho_mm):
    from scipy.ndimage import gaussian_filter1d

    fine = 0.02
    edge = np.where(np.arange(2000) < 1000, 255.0, 0.0)
    slope = np.gradient(gaussian_filter1d(edge, sigma_mm / fine), fine)
    measured = np.sqrt(gaussian_filter1d(slope**2, rho_mm / fine).max() if rho_mm else (slope**2).max())
    assert steepest_edge(sigma_mm, rho_mm) == pytest.approx(measured, rel=1e-3)


def test_across_an_edge_the_diffusivity_is_weickerts_and_along_it_one():
    contrast = 25.5
    for gradient in (1.0, 20.0, 25.5, 40.0, 200.0):
        normal = np.array([2.0, -1.0, 2.0]) / 3
        tensor = gradient**2 * np.outer(normal, normal)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        diffusion = np.zeros((6, 3, 3, 3), np.float32)
        _diffusion_tensor(tensor.reshape(6, 1, 1, 1).astype(np.float32), contrast**2, diffusion)
        xx, yy, zz, xy, xz, yz = diffusion[:, 1, 1, 1]
        found = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        across = 1 - np.exp(-3.31488 / (gradient / contrast) ** 8)
        np.testing.assert_allclose(found @ normal, across * normal, atol=1e-5)
        np.testing.assert_allclose(found @ [1, 2, 0], [1, 2, 0], atol=1e-5)


# What it is for -------------------------------------------------------------------------------------


def noisy_step() -> tuple[np.ndarray, np.ndarray]:
    """An oblique edge with 10 grey values of noise; (i, j, k) values and signed distances, mm."""
    where = places((40, 40, 24), SPACING)
    distance = where @ (np.array([2.0, 1.0, 2.0]) / 3)
    return soft(distance) + np.random.default_rng(5).normal(scale=10, size=distance.shape), distance


def test_noise_goes_and_the_edge_stays_where_a_gaussian_takes_both():
    from scipy.ndimage import gaussian_filter

    before, distance = noisy_step()
    after = denoise(before, SPACING)
    flat = (np.abs(distance) > 6) & (np.abs(distance) < 12)
    inner = tuple(slice(5, -5) for _ in range(3))

    def left(values: np.ndarray) -> float:
        return float((values - soft(distance))[inner][flat[inner]].std())

    def width_mm(values: np.ndarray) -> float:
        """From a tenth to nine tenths of the edge."""
        order = np.argsort(distance[inner].ravel())
        profile = np.convolve(values[inner].ravel()[order], np.ones(101) / 101, "valid")
        along = distance[inner].ravel()[order][50:-50]
        return float(np.ptp(along[(profile > 44) & (profile < 156)]))

    assert left(before) > 9 and left(after) < 1.5
    blurred = gaussian_filter(
        before, np.sqrt(2 * 20 * 0.12) / np.array(SPACING)
    )  # the same time without edges
    assert width_mm(after) < 1.3 * width_mm(soft(distance)) + 0.5
    assert width_mm(after) < 0.7 * width_mm(blurred)


def test_a_cleft_of_three_millimetres_between_tongue_and_palate_stays_open():
    distance = 1.5 - np.abs(places((40, 40, 24), SPACING) @ (np.array([2.0, 1.0, 2.0]) / 3))
    noisy = soft(distance) + np.random.default_rng(6).normal(scale=10, size=distance.shape)
    after = denoise(noisy, SPACING)[5:-5, 5:-5, 5:-5]
    inside = distance[5:-5, 5:-5, 5:-5]
    assert (after[inside > 0.7] < 90).all() and (after[inside < -0.7] > 110).all()


def test_below_the_contrast_a_step_is_smoothed_away():
    distance = places((24, 24, 24), SPACING)[..., 0]
    faint, strong = 100 + 0.05 * (soft(distance) - 100), soft(distance)
    slopes = [
        float(np.abs(np.diff(denoise(values, SPACING), axis=0)).max() / np.abs(np.diff(values, axis=0)).max())
        for values in (faint, strong)
    ]
    assert slopes[0] < 0.6 and slopes[1] > 0.8


# In mm ----------------------------------------------------------------------------------------------


def test_the_48_ways_to_store_a_volume_give_the_same_picture():
    values = noise((9, 11, 13), 6)
    values[3:, 4:, 5:] += 120
    spacing = np.array([0.8, 1.1, 1.6])
    plain = denoise(values, spacing, steps=5)
    for order in itertools.permutations(range(3)):
        for flips in itertools.product((1, -1), repeat=3):
            turned = values.transpose(order)[:: flips[0], :: flips[1], :: flips[2]]
            back = denoise(turned, spacing[list(order)], steps=5)[:: flips[0], :: flips[1], :: flips[2]]
            np.testing.assert_allclose(back.transpose(np.argsort(order)), plain, atol=2e-2)


def profile_at(normal: np.ndarray, spacing: tuple[float, ...], at_mm: np.ndarray) -> np.ndarray:
    """The profile of a denoised edge with this normal, at signed distances, mm."""
    shape = tuple(int(30 / h) for h in spacing)
    distance = places(shape, spacing) @ (normal / np.linalg.norm(normal))
    after = denoise(soft(distance), spacing)
    near = (np.abs(places(shape, spacing)) < 9).all(axis=-1)
    order = np.argsort(distance[near])
    return np.interp(at_mm, distance[near][order], after[near][order])


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), SPACING, (0.8, 1.2, 1.6)])
def test_an_edge_looks_the_same_in_every_direction_of_the_grid(spacing):
    at_mm = np.linspace(-4, 4, 33)
    truth = soft(at_mm)
    for normal in ([1, 0, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1], [3, 1, 2], [1, -2, 2]):
        profile = profile_at(np.array(normal, dtype=np.float64), spacing, at_mm)
        assert np.abs(profile - truth).mean() < 8.0, normal  # of 140; three times that without edges
        np.testing.assert_allclose(profile[[0, -1]], truth[[0, -1]], atol=3.0)


def test_a_ball_on_an_anisotropic_grid_comes_out_as_on_an_isotropic_one():
    def denoised(spacing: tuple[float, float, float], told: tuple[float, float, float]) -> np.ndarray:
        shape = tuple(round(32 / h) + 1 for h in spacing)
        distance = np.linalg.norm(places(shape, spacing), axis=-1) - 9.0
        return denoise(100 + 70 * np.tanh(-distance / 1.5), told)

    fine = denoised((1.0, 1.0, 1.0), (1.0, 1.0, 1.0))[:, :, ::2]
    coarse = denoised((1.0, 1.0, 2.0), (1.0, 1.0, 2.0))
    as_if_cubes = denoised((1.0, 1.0, 2.0), (1.0, 1.0, 1.0))
    assert fine.shape == coarse.shape

    def apart(other: np.ndarray) -> float:
        return float(np.sqrt(np.mean((other - fine) ** 2)))

    assert apart(coarse) < 1.5
    assert apart(coarse) < 0.5 * apart(as_if_cubes)


# Settings -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"steps": -1}, "in -1 steps"),
        ({"step": 0.0}, r"step of 0\.0 mm\^2"),
        ({"step": float("nan")}, "step of nan"),
        ({"contrast": 0.0}, r"contrast of 0\.0"),
        ({"sigma_mm": 0.0}, r"smoothing by 0\.0 and 1\.0 mm"),
        ({"rho_mm": float("inf")}, "smoothing by 1.0 and inf mm"),
    ],
)
def test_settings_out_of_range_are_refused(wrong, match):
    with pytest.raises(InputError, match=match):
        denoise(noise((3, 3, 3)), SPACING, **wrong)


def test_repeated_edges_let_nothing_flow_out():
    volume = np.zeros((5, 5, 5), np.float32)
    volume[1:-1, 1:-1, 1:-1] = noise((3, 3, 3))
    inner = volume[1:-1, 1:-1, 1:-1].copy()
    _repeat_edges(volume)
    np.testing.assert_array_equal(volume, np.pad(inner, 1, mode="edge"))
