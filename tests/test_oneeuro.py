"""The one-euro filter: the published equations, and what users expect of it."""

import math

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.streams.oneeuro import LONGEST_STEP_S, OneEuro


def published(values, times, min_cutoff, beta, d_cutoff):
    """Algorithm 1 of Casiez, Roussel and Vogel (CHI 2012), for one signal, written out plainly."""

    def alpha(cutoff, step):
        tau = 1.0 / (2.0 * math.pi * cutoff)
        return 1.0 / (1.0 + tau / step)

    smooth, speed, out = values[0], 0.0, [values[0]]
    for before, value, step in zip(values[:-1], values[1:], np.diff(times)):
        a = alpha(d_cutoff, step)
        speed = a * (value - before) / step + (1 - a) * speed
        a = alpha(min_cutoff + beta * abs(speed), step)
        smooth = a * value + (1 - a) * smooth
        out.append(smooth)
    return out


def filtered(one_euro, values, times):
    return np.array([one_euro(row, time) for row, time in zip(values, times)])


def noisy(frames=300, numbers=3, seed=2):
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.002, 0.02, frames))
    return random.normal(size=(frames, numbers)).cumsum(axis=0) * 0.1, times


@pytest.mark.parametrize(("cutoff", "beta", "d_cutoff"), [(1.0, 0.0, 1.0), (2.0, 0.5, 1.0), (0.3, 5.0, 4.0)])
def test_it_is_the_published_filter_for_each_number_by_itself_with_unequal_steps(cutoff, beta, d_cutoff):
    values, times = noisy()
    out = filtered(OneEuro(cutoff, beta, d_cutoff), values, times)
    for column in range(3):
        np.testing.assert_allclose(
            out[:, column], published(values[:, column], times, cutoff, beta, d_cutoff), atol=1e-12
        )


def test_off_is_the_identity_to_the_last_bit():
    values, times = noisy()
    values[5, 1] = np.nan
    one_euro = OneEuro()
    assert one_euro.off and not OneEuro(1.0).off
    np.testing.assert_array_equal(filtered(one_euro, values, times), values)


def test_at_rest_noise_gets_smaller_and_in_motion_the_lag_does():
    random = np.random.default_rng(0)
    times = np.arange(400) / 100.0
    rest = filtered(OneEuro(1.0, 2.0), random.normal(scale=0.01, size=(400, 1)), times)
    assert rest[100:].std() < 0.5 * 0.01
    ramp = (2.0 * times)[:, None]
    lag_slow, lag_fast = (
        (ramp - filtered(OneEuro(1.0, beta), ramp, times))[-1, 0] / 2.0 for beta in (0.0, 5.0)
    )
    assert lag_slow == pytest.approx(1 / (2 * math.pi), rel=0.02)  # seconds: 1 / (2 pi cut-off)
    assert lag_fast < 0.15 * lag_slow


def test_small_motions_pass_too_there_is_no_dead_zone():
    one_euro = OneEuro(1.0)
    one_euro([0.0], 0.0)
    assert 0 < one_euro([1e-9], 0.01)[0] < 1e-9


def test_a_constant_stays_exactly_what_it_is():
    times = np.arange(50) / 60
    assert (filtered(OneEuro(0.5, 1.0), np.full((50, 2), 0.3), times) == 0.3).all()


@pytest.mark.parametrize("later", [-0.5, LONGEST_STEP_S * 1.01, math.nan])
def test_after_a_pause_or_a_clock_that_ran_backwards_it_starts_anew(later):
    one_euro = OneEuro(0.5)
    one_euro([0.0], 10.0)
    one_euro([0.1], 10.01)
    assert one_euro([5.0], 10.01 + later)[0] == 5.0


def test_time_zero_is_a_time_like_any_other_and_the_same_time_twice_gives_the_same_answer():
    one_euro = OneEuro(0.5)
    assert one_euro([1.0], 0.0)[0] == 1.0
    assert one_euro([9.0], 0.0)[0] == 1.0
    assert 1.0 < one_euro([2.0], 0.01)[0] < 2.0


def test_another_number_of_values_starts_anew_and_so_does_forgetting():
    one_euro = OneEuro(0.5)
    one_euro([0.0, 0.0], 0.0)
    np.testing.assert_array_equal(one_euro([1.0, 2.0, 3.0], 0.01), [1, 2, 3])
    one_euro.forget()
    np.testing.assert_array_equal(one_euro([5.0, 5.0, 5.0], 0.02), [5, 5, 5])


def test_a_missing_number_is_missing_and_its_neighbours_go_on():
    values, times = noisy(50, 2)
    gap = values.copy()
    gap[20:23, 0] = np.nan
    out = filtered(OneEuro(1.0, 0.5), gap, times)
    assert np.isnan(out[20:23, 0]).all() and np.isfinite(out[23:, 0]).all()
    assert out[23, 0] == gap[23, 0]
    np.testing.assert_array_equal(out[:, 1], filtered(OneEuro(1.0, 0.5), values, times)[:, 1])


def test_neither_the_input_nor_an_earlier_answer_is_written_over():
    one_euro = OneEuro(0.5)
    value = np.array([1.0])
    first = one_euro(value, 0.0)
    second = one_euro(np.array([2.0]), 0.01)
    value[0] = first[0] = 99.0
    third = one_euro(np.array([2.0]), 0.02)
    assert second[0] < third[0] < 2.0


@pytest.mark.parametrize(
    "arguments",
    [(0.0,), (-1.0,), (math.nan,), (1.0, -0.1), (1.0, math.inf), (1.0, 0.0, 0.0), (1.0, 0.0, math.inf)],
)
def test_settings_outside_their_range_are_refused(arguments):
    with pytest.raises(InputError, match="one-euro filter"):
        OneEuro(*arguments)
