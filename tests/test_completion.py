"""Missing cells: what each way of filling them is exact for, and that the report of their errors is honest."""

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.model.build import load_training_shapes, read_sample_database
from tonguetrack.model.completion import (
    fill_missing_additively,
    fill_missing_by_low_rank,
    held_out_errors,
)
from tonguetrack.model.tensor import unfold


def additive(seed=0, speakers=7, poses=8, k=30):
    random = np.random.default_rng(seed)
    return (
        20 * random.normal(size=k)
        + 5 * random.normal(size=(speakers, 1, k))
        + 8 * random.normal(size=(1, poses, k))
    )


def with_interaction(seed=0):
    """Additive, and one way in which speakers differ in how they differ between poses."""
    tensor = additive(seed)
    random = np.random.default_rng(100 + seed)
    parts = random.normal(size=7), random.normal(size=8), random.normal(size=30)
    return tensor + 3 * np.einsum("i,j,k->ijk", *parts)


def without(tensor, count, seed=0):
    """The tensor with so many absent cells, none of which empties a row or a column."""
    random = np.random.default_rng(seed)
    while True:
        absent = np.zeros(tensor.shape[:2], dtype=bool)
        absent.flat[random.choice(absent.size, count, replace=False)] = True
        if not absent.all(axis=0).any() and not absent.all(axis=1).any():
            return np.where(absent[..., None], np.nan, tensor), absent


def nuclear_norms(tensor):
    return sum(np.linalg.svd(unfold(tensor, mode), compute_uv=False).sum() / 2 for mode in (0, 1))


@pytest.mark.parametrize("fill", [fill_missing_additively, lambda t: fill_missing_by_low_rank(t).tensor])
def test_additive_shapes_come_back_exactly_and_measured_cells_are_never_touched(fill):
    whole = additive()
    spoiled, absent = without(whole, 12)
    found = fill(spoiled)
    np.testing.assert_allclose(found, whole, atol=1e-6)
    np.testing.assert_array_equal(found[~absent], whole[~absent])


def test_low_rank_finds_what_speakers_and_poses_have_in_common_and_the_additive_fit_cannot():
    better = []
    for seed in range(4):
        whole = with_interaction(seed)
        spoiled, absent = without(whole, 8, seed)
        ways = fill_missing_additively(spoiled), fill_missing_by_low_rank(spoiled).tensor
        additive_error, low_rank_error = (np.linalg.norm((found - whole)[absent]) for found in ways)
        better.append(low_rank_error / additive_error)
    assert np.mean(better) < 0.8


def test_low_rank_ends_at_the_least_sum_of_nuclear_norms_of_what_the_additive_fit_leaves():
    """No change of an absent cell lowers it: of a convex function, no other tensor does."""
    spoiled, absent = without(with_interaction(3), 10, 3)
    completion = fill_missing_by_low_rank(spoiled)
    assert completion.settled
    left = completion.tensor - additive_part(spoiled)
    least = nuclear_norms(left)
    random = np.random.default_rng(0)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(20):
            change = random.normal(size=left.shape) * absent[..., None]
            assert nuclear_norms(left + size * change) > least - 1e-6 * least
    assert nuclear_norms(np.where(absent[..., None], 0.0, left)) >= least * (1 - 1e-6)


def additive_part(spoiled):
    """The additive fit of the measured cells, everywhere, by least squares of its own."""
    present = ~np.isnan(spoiled).any(axis=2)
    rows = np.argwhere(present)
    design = np.concatenate([np.eye(7)[rows[:, 0]], np.eye(8)[rows[:, 1]]], axis=1)
    effects = np.linalg.lstsq(design, spoiled[present], rcond=None)[0]
    return effects[:7, None] + effects[None, 7:]


def test_a_complete_tensor_stays_as_it_is():
    whole = with_interaction()
    completion = fill_missing_by_low_rank(whole)
    np.testing.assert_array_equal(completion.tensor, whole)
    assert completion.missing == () and completion.settled


def test_the_missing_cells_are_named():
    spoiled, absent = without(additive(), 3)
    assert set(fill_missing_by_low_rank(spoiled).missing) == {tuple(cell) for cell in np.argwhere(absent)}


def test_every_measured_cell_is_held_out_once_and_its_error_is_that_of_a_fill_without_it():
    whole = with_interaction(1)
    spoiled, absent = without(whole, 5, 1)
    report = held_out_errors(spoiled)
    assert sorted(map(tuple, report.cells)) == sorted(map(tuple, np.argwhere(~absent)))
    assert list(report.errors_mm) == ["averaging", "additive", "low rank"]
    assert report.means_mm["additive"] == pytest.approx(report.errors_mm["additive"].mean())
    exact = held_out_errors(without(additive(), 4)[0])
    assert exact.means_mm["additive"] < 1e-9 and exact.means_mm["low rank"] < 1e-6
    assert exact.means_mm["averaging"] > 1.0


def test_what_is_held_out_is_not_known_to_the_fill():
    """A cell that is far off is far from what is filled in for it."""
    whole = additive(2)
    whole[2, 3] += 1000.0
    report = held_out_errors(whole)
    there = (report.cells == (2, 3)).all(axis=1)
    for errors in report.errors_mm.values():
        assert errors[there] > 1000.0


def test_a_speaker_or_a_pose_without_any_mesh_is_named():
    for axis, words in ((0, "speaker 2 .* has no mesh at all"), (1, "pose 2 .* has no mesh at all")):
        spoiled = additive()
        spoiled[(slice(None),) * axis + (2,)] = np.nan
        for fill in (fill_missing_additively, fill_missing_by_low_rank, held_out_errors):
            with pytest.raises(InputError, match=words):
                fill(spoiled)


def test_too_few_meshes_to_hold_any_out_are_refused():
    lonely = np.full((3, 3, 6), np.nan)
    lonely[[0, 1, 2], [0, 1, 2]] = 1.0
    with pytest.raises(InputError, match="nothing can be held out"):
        held_out_errors(lonely)


def test_on_the_papers_meshes_low_rank_is_nearest_then_additive_then_averaging(reference_data):
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    means = held_out_errors(shapes.tensor).means_mm
    assert means["low rank"] < means["additive"] < means["averaging"]
