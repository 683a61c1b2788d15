"""Log-scale histograms: percentiles of any number of values in constant memory."""

import numpy as np
import pytest

from tonguetrack.tracker.latency import LogHistogram, latency_histogram, percentiles_text


def filled(values, low=1e2, high=1e10):
    histogram = LogHistogram(low, high)
    for value in values:
        histogram.add(value)
    return histogram


def test_percentiles_are_right_to_one_percent():
    values = np.random.default_rng(1).lognormal(11.0, 1.5, 20_000)
    histogram = filled(values.tolist())
    for percent in (1.0, 50.0, 90.0, 99.0, 99.9):
        assert histogram.percentile(percent) == pytest.approx(np.percentile(values, percent), rel=0.015)


def test_count_mean_and_maximum_are_exact():
    values = [150, 4_000, 77_000_001]
    histogram = filled(values)
    assert (histogram.count, histogram.mean, histogram.maximum) == (3, sum(values) / 3, 77_000_001)


def test_percentiles_never_leave_the_range_of_the_values():
    histogram = filled([1234])
    assert histogram.percentile(0.0) == histogram.percentile(50.0) == histogram.percentile(100.0) == 1234


@pytest.mark.parametrize("value", [0, -5, 1, 99.999, 1e10, 1e18, 10**30])
def test_values_outside_the_bins_are_counted_all_the_same(value):
    histogram = filled([value])
    assert histogram.count == 1
    assert histogram.counts().sum() == 1


def test_every_value_between_the_ends_has_a_bin():
    histogram = latency_histogram()
    edges = np.geomspace(histogram.low, histogram.high, 5000)
    for value in (*edges, *np.nextafter(edges, 0), *np.nextafter(edges, np.inf)):
        histogram.add(float(value))
    assert histogram.counts().sum() == histogram.count == 15_000


def test_an_empty_histogram_has_no_percentiles():
    assert latency_histogram().as_dict(1e3) == {"p50": None, "p99": None, "max": None, "count": 0}
    assert latency_histogram().mean is None


def test_merging_is_the_same_as_adding_everything_to_one():
    random = np.random.default_rng(2)
    first, second = random.lognormal(10, 1, 500).tolist(), random.lognormal(13, 1, 700).tolist()
    merged, one = filled(first), filled(first + second)
    merged.merge(filled(second))
    np.testing.assert_array_equal(merged.counts(), one.counts())
    assert merged.as_dict() == one.as_dict()
    assert merged.mean == pytest.approx(one.mean)


def test_histograms_of_other_bins_do_not_merge():
    with pytest.raises(ValueError, match="do not fit"):
        filled([500]).merge(LogHistogram(1.0, 10.0))


def test_as_dict_is_in_multiples_of_the_unit():
    assert filled([2_000_000]).as_dict(1e6) == {"p50": 2.0, "p99": 2.0, "max": 2.0, "count": 1}


def test_percentiles_read_without_powers_of_ten():
    assert percentiles_text({"p50": 78.31, "p99": 134.2, "max": 8750.4, "count": 9}, "us") == (
        "p50 78.3 us  p99 134 us  max 8750 us"
    )
    assert percentiles_text(latency_histogram().as_dict(), "us") == "-"
