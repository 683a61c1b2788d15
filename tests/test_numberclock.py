"""The time that a device's frame counter is given: what it converges to, and what it withstands."""

import numpy as np
import pytest

from tonguetrack.drivers.devices.numberclock import NumberClock

RATE_HZ, STEP = 40.0, 8  # an Aurora: 40 frames a second, its counter runs eight times as fast
SHORTEST_DELAY_S = 0.003


def arrivals(seconds, seed=1, jitter_s=0.004, rate_hz=RATE_HZ):
    """Numbers, true times and arrival times (ns) of a stream whose delays are never below the shortest."""
    random = np.random.default_rng(seed)
    index = np.arange(int(seconds * rate_hz))
    true_s = 1000.0 + index / rate_hz
    delay_s = SHORTEST_DELAY_S + random.exponential(jitter_s, len(index))
    return index * STEP + 4000, true_s, np.round((true_s + delay_s) * 1e9).astype(np.int64)


def times_of(clock, numbers, arrival_ns):
    return np.array([clock.time_s(int(n), int(ns)) for n, ns in zip(numbers, arrival_ns, strict=True)])


def test_it_finds_the_rate_of_the_counter():
    clock = NumberClock()
    numbers, _, arrival_ns = arrivals(30)
    times_of(clock, numbers, arrival_ns)
    assert clock.counts_per_s == pytest.approx(320.0, rel=1e-4)


def test_it_converges_to_the_measurement_plus_the_shortest_delay():
    numbers, true_s, arrival_ns = arrivals(60)
    times = times_of(NumberClock(), numbers, arrival_ns)
    settled = times[-800:] - true_s[-800:]
    assert abs(settled - SHORTEST_DELAY_S).max() < 0.001
    assert settled.std() < 0.1 * np.std(arrival_ns[-800:] * 1e-9 - true_s[-800:])


def test_the_rate_of_the_devices_own_quartz_is_followed():
    numbers, _, arrival_ns = arrivals(60, rate_hz=RATE_HZ * (1 + 1e-3))
    clock = NumberClock()
    times_of(clock, numbers, arrival_ns)
    assert clock.counts_per_s == pytest.approx(320.32, rel=5e-5)


def test_within_a_section_equal_counts_take_equal_times():
    numbers, _, arrival_ns = arrivals(20)
    steps = np.diff(times_of(NumberClock(), numbers, arrival_ns))[100:]
    assert len(np.unique(np.round(steps, 9))) <= 20
    assert abs(steps - 0.025).max() < 0.011 * 0.025


@pytest.mark.parametrize("seed", range(5))
def test_times_never_go_back(seed):
    random = np.random.default_rng(seed)
    numbers, _, arrival_ns = arrivals(20, seed)
    kept = random.random(len(numbers)) > 0.2
    numbers = numbers + np.where(np.arange(len(numbers)) > 300, random.integers(-2000, 2000), 0)
    times = times_of(NumberClock(), numbers[kept], np.maximum.accumulate(arrival_ns)[kept])
    assert (np.diff(times) >= 0).all()


def test_a_gap_in_the_numbers_is_a_gap_in_time():
    numbers, _, arrival_ns = arrivals(20)
    kept = (np.arange(len(numbers)) < 400) | (np.arange(len(numbers)) >= 440)
    times = times_of(NumberClock(), numbers[kept], arrival_ns[kept])
    assert times[400] - times[399] == pytest.approx(41 / RATE_HZ, rel=0.011)


def test_one_frame_that_is_held_up_changes_nothing():
    numbers, _, arrival_ns = arrivals(20)
    held_up = arrival_ns.copy()
    held_up[500] += 20_000_000
    assert times_of(NumberClock(), numbers, held_up).tolist() == pytest.approx(
        times_of(NumberClock(), numbers, arrival_ns).tolist(), abs=1e-6
    )


@pytest.mark.parametrize("jump", [-4000, -200, 60, 3200, 1_000_000])
def test_a_counter_that_jumps_is_taken_up_where_the_host_is(jump):
    numbers, true_s, arrival_ns = arrivals(20)
    numbers = numbers + np.where(np.arange(len(numbers)) >= 400, jump, 0)
    clock = NumberClock()
    times = times_of(clock, numbers, arrival_ns)
    assert abs(times[400:] - true_s[400:]).max() < 0.05
    assert clock.counts_per_s == pytest.approx(320.0, rel=0.01)


def test_the_same_number_has_the_same_time():
    clock = NumberClock()
    assert clock.time_s(8, 5_000_000_000) == clock.time_s(8, 5_100_000_000) == 5.0
