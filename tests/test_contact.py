"""Gaps between tongue and palate: distances, signs, places, regions."""

import numpy as np
import pytest

from tonguetrack.model.mri.phantom.anatomy import PALATE_END_MM, ROOF_START_MM, STEP_MM, Anatomy, roof_of
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.streams.contact import REGIONS, ContactMeter, gaps_below, segments_of
from tonguetrack.tracker.streams.landmarks import contour_with_parts

MODEL = bundled_model()
MEAN = MODEL.speaker.mean, MODEL.pose.mean
CONTOUR = MODEL.mean_vertices()[contour_with_parts(MODEL)[0]]


def flat_palate(height, front=-20.0, back=80.0, points=50):
    y = np.linspace(front, back, points)
    return np.column_stack([np.zeros(points), y, np.full(points, height)])


def hard_palate(points):
    """Of the phantom's reference speaker."""
    roof = roof_of(Anatomy("reference"))
    y = np.linspace(ROOF_START_MM, PALATE_END_MM, points)
    return np.column_stack([0 * y, y, np.interp(y, STEP_MM * np.arange(len(roof)), roof)])


def test_below_a_flat_palate_the_gap_is_the_distance_to_the_highest_point():
    highest = CONTOUR[CONTOUR[:, 2].argmax()]
    found = ContactMeter(MODEL, flat_palate(highest[2] + 4.0)).measure(*MEAN)
    assert found.gap_mm == pytest.approx(4.0)
    np.testing.assert_allclose(found.point, highest)


def test_a_tongue_above_the_palate_has_a_negative_gap():
    highest = CONTOUR[:, 2].max()
    assert ContactMeter(MODEL, flat_palate(highest - 1.5)).measure(*MEAN).gap_mm == pytest.approx(-1.5)


def test_the_gap_is_at_right_angles_to_a_slope_not_straight_up():
    slope = np.column_stack([np.zeros(2), [-30.0, 100.0], [-30.0, 100.0]])  # z = y
    gaps = gaps_below(np.array([[10.0, 0.0], [0.0, 10.0]]), segments_of(slope))
    np.testing.assert_allclose(gaps, [10 / np.sqrt(2), -10 / np.sqrt(2)])


def test_in_front_of_and_behind_the_trace_nothing_is_said():
    short = segments_of(flat_palate(5.0, 10.0, 20.0))
    gaps = gaps_below(np.array([[9.0, 0.0], [10.5, 0.0], [19.5, 0.0], [21.0, 0.0]]), short)
    np.testing.assert_array_equal(np.isnan(gaps), [True, False, False, True])


def test_each_region_has_the_smallest_gap_of_its_own_part_of_the_contour():
    palate = flat_palate(10.0)
    found = ContactMeter(MODEL, palate).measure(*MEAN)
    contour, parts = contour_with_parts(MODEL)
    heights = MODEL.mean_vertices()[contour, 2]
    begin = 0.0
    for end, gap in zip(REGIONS.values(), found.regions, strict=True):
        inside = (parts > begin) & (parts <= end) | ((parts == 0) & (begin == 0))
        assert gap == pytest.approx(10.0 - heights[inside].max())
        begin = end
    assert found.gap_mm == pytest.approx(np.nanmin(found.regions))


def test_a_palate_that_reaches_over_a_part_only_says_nothing_of_the_rest():
    found = ContactMeter(MODEL, flat_palate(10.0, 8.0, 16.0)).measure(*MEAN)
    assert np.isfinite(found.regions[:2]).all() and np.isnan(found.regions[3:]).all()
    nowhere = ContactMeter(MODEL, flat_palate(10.0, 200.0, 250.0)).measure(*MEAN)
    assert np.isnan(nowhere.gap_mm) and np.isnan(nowhere.point).all() and np.isnan(nowhere.regions).all()


def test_the_gap_falls_one_for_one_as_the_palate_comes_down():
    gaps = [ContactMeter(MODEL, flat_palate(height)).measure(*MEAN).gap_mm for height in (12.0, 9.0, 6.0)]
    np.testing.assert_allclose(np.diff(gaps), -3.0)


def test_a_dense_sweep_gives_what_a_sparse_trace_gives():
    sparse, dense = (ContactMeter(MODEL, hard_palate(points)) for points in (60, 6000))
    for pose in MODEL.pose.training:
        one, other = (meter.measure(MODEL.speaker.mean, pose) for meter in (sparse, dense))
        assert one.gap_mm == pytest.approx(other.gap_mm, abs=0.05)


def test_the_synthetic_speakers_narrow_where_phonetics_says():
    meter = ContactMeter(MODEL, hard_palate(100))
    regions = {
        phone: meter.regions[int(np.nanargmin(meter.measure(MODEL.speaker.mean, pose).regions))]
        for phone, pose in zip(MODEL.pose.names, MODEL.pose.training, strict=True)
    }
    assert regions["s"] in ("tip", "blade") and regions["ʃ"] in ("tip", "blade")
    assert regions["u"] in ("body", "back") and regions["o"] in ("body", "back")


def test_a_new_speaker_is_noticed():
    meter = ContactMeter(MODEL, flat_palate(12.0))
    for speaker in (*MODEL.speaker.training[:3], MODEL.speaker.mean):
        fresh = ContactMeter(MODEL, flat_palate(12.0))
        assert (
            meter.measure(speaker, MODEL.pose.mean).gap_mm == fresh.measure(speaker, MODEL.pose.mean).gap_mm
        )
