"""The one-euro filter in front of a stream's worker."""

import math

import numpy as np
from streaming import info, model, pose

from tonguetrack.tracker.streams.filtered import FilteredWorker
from tonguetrack.tracker.streams.oneeuro import OneEuro


class Keeper:
    """A worker that keeps what it gets."""

    destination = "keeper"

    def __init__(self):
        self.infos, self.poses, self.ended = [], [], False

    def begin(self, told):
        self.infos.append(told)

    def work(self, given):
        self.poses.append(given.copy())

    def end(self):
        self.ended = True


def filtered(poses, *settings):
    keeper = Keeper()
    worker = FilteredWorker(keeper, OneEuro(*settings))
    worker.begin(info())
    for each in poses:
        worker.work(each)
    worker.end()
    assert keeper.ended and keeper.infos and worker.destination == "keeper"
    return keeper.poses


def test_coefficients_are_filtered_in_sigma_and_the_raw_ones_follow():
    random = np.random.default_rng(1)
    poses = [pose(k, random.normal(size=4)) for k in range(50)]
    smooth = OneEuro(2.0, 0.1)
    expected = [smooth(each.normalised, each.device_time_s) for each in poses]
    for each, wanted in zip(filtered(poses, 2.0, 0.1), expected, strict=True):
        np.testing.assert_array_equal(each.normalised, wanted)
        np.testing.assert_allclose(each.weights, model().pose.raw(wanted), rtol=0, atol=1e-15)


def test_a_noise_becomes_small_and_a_step_arrives():
    random = np.random.default_rng(2)
    still = filtered([pose(k, random.normal(scale=0.3, size=4)) for k in range(500)], 1.0, 0.0)
    late = np.array([each.normalised for each in still[250:]])
    assert late.std() < 0.1
    step = filtered([pose(k, np.full(4, float(k > 100))) for k in range(600)], 1.0, 0.5)
    assert abs(step[-1].normalised - 1.0).max() < 0.01


def test_without_a_cut_off_what_goes_in_comes_out():
    poses = [pose(k, np.full(4, math.sin(k))) for k in range(20)]
    for each, calm in zip(poses, filtered(poses), strict=True):
        np.testing.assert_array_equal(calm.normalised, each.normalised)
        np.testing.assert_allclose(calm.weights, each.weights, rtol=0, atol=1e-15)


def test_what_was_measured_stays_as_it_is_and_so_does_the_pose_that_came_in():
    poses = [pose(k, np.full(4, float(k))) for k in range(5)]
    kept = [each.copy() for each in poses]
    for calm, given, before in zip(filtered(poses, 1.0, 0.0), poses, kept, strict=True):
        np.testing.assert_array_equal(given.weights, before.weights)
        np.testing.assert_array_equal(calm.coils, before.coils)
        np.testing.assert_array_equal(calm.residuals_mm, before.residuals_mm)
        assert (calm.frame_number, calm.status, calm.device_time_s) == (
            before.frame_number, before.status, before.device_time_s,
        )  # fmt: skip
