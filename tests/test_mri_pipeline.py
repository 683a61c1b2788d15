"""From scans to a model: what is found is the truth, what fails is named, and nothing is done twice."""

from __future__ import annotations

import gzip
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from phantoms import copied, shared_phantom
from scipy.spatial import cKDTree

from tonguetrack import InputError, load_model
from tonguetrack.model.build import read_sample_database
from tonguetrack.model.mesh import read_mesh
from tonguetrack.model.mri.caching import Cache
from tonguetrack.model.mri.cloudfile import read_cloud
from tonguetrack.model.mri.dataset import load_dataset
from tonguetrack.model.mri.phantom.making import truth_path
from tonguetrack.model.mri.phantom.surfaces import BURIED
from tonguetrack.model.mri.phantom.truth import read_truth
from tonguetrack.model.mri.pipeline import build
from tonguetrack.model.mri.results import assembled, load_result, read_index, stored_cloud, write_index
from tonguetrack.model.mri.settings import BuildSettings
from tonguetrack.parallel import local
from tonguetrack.tracker.cli import main

QUICK = replace(BuildSettings(), rounds=1)


@pytest.fixture(scope="session")
def phantom(tmp_path_factory) -> Path:
    return shared_phantom(tmp_path_factory)


@pytest.fixture(scope="module")
def work(phantom, tmp_path_factory) -> Path:
    """The work folder of a whole build with one round."""
    work = tmp_path_factory.mktemp("work")
    with local(1) as executor:
        write_index(work, build(load_dataset(phantom), QUICK, work, executor))
    return work


class Counting:
    """An executor that notes which steps are really taken: the name of each, once for every result."""

    def __init__(self) -> None:
        self.taken: list[str] = []

    def run(self, function, items, progress=None):
        (_, step) = function.args
        self.taken += [step.name] * len(items)
        with local(1) as executor:
            yield from executor.run(function, items, progress)


def built(dataset, settings, work, until="tongues"):
    """(index, the steps taken)"""
    counting = Counting()
    return build(dataset, settings, work, counting, until=until), counting.taken


# What is found --------------------------------------------------------------------------------------


def test_the_extracted_tongues_are_the_true_ones(phantom, work):
    """Far looser than what is reached, which the report of a whole set tells; but no wrong tongue would pass."""
    dataset = load_dataset(phantom)
    result = load_result(work)
    assert set(result.scans) == set(dataset.scans) and all(scan.used for scan in result.scans.values())
    for cell, scan in result.scans.items():
        truth = read_truth(truth_path(dataset, *cell))
        seen = truth.tongue.vertices[truth.kind != BURIED]
        assert cKDTree(scan.final).query(seen)[0].mean() < 1.5
        assert scan.flipped == 0


def test_palates_are_brought_to_where_the_head_is_in_each_scan(phantom, work):
    dataset, result = load_dataset(phantom), load_result(work)
    for (speaker, phone), scan in result.scans.items():
        own = dataset.palate_phone[speaker]
        here, there = (read_truth(truth_path(dataset, speaker, name)).head_to_world for name in (phone, own))
        moved = here @ np.linalg.inv(there)
        expected = result.scans[speaker, own].palate @ moved[:3, :3].T + moved[:3, 3]
        assert np.sqrt(np.mean(np.sum((scan.palate - expected) ** 2, axis=1))) < 0.5


def test_in_the_head_frame_the_palates_of_all_scans_of_a_speaker_are_one(work):
    result = load_result(work)
    for speaker in ("Speaker01", "Speaker02"):
        heads = [scan.motion.apply(scan.palate) for scan in result.scans.values() if scan.speaker == speaker]
        np.testing.assert_allclose(heads, np.broadcast_to(heads[0], np.shape(heads)), atol=1e-6)


def test_the_model_is_that_of_the_tongues_in_the_head_frame(work):
    result = load_result(work)
    assert result.model.speaker.names == ("Speaker01", "Speaker02")
    assert result.model.pose.names == ("i", "a", "ɑ")
    # Two speakers and three phones: so many weights are all there are, and the model is exact.
    for row, speaker in enumerate(result.shapes.speakers):
        for column, phone in enumerate(result.shapes.prompts):
            weights = result.model.speaker.training[row], result.model.pose.training[column]
            scan = result.scans[speaker, phone]
            np.testing.assert_allclose(
                result.model.vertices(*weights), scan.motion.apply(scan.final), atol=1e-6
            )


def test_every_scan_tells_of_its_first_matching_and_of_each_round(work):
    for scan in load_result(work).scans.values():
        assert len(scan.residual_mm) == len(scan.valid) == 1 + QUICK.rounds
        assert all(0.0 < residual < 3.0 for residual in scan.residual_mm)
        assert np.abs(scan.final - scan.initial).max() > 0.01


# Nothing twice --------------------------------------------------------------------------------------


def test_a_second_build_takes_no_step_and_finds_the_same(phantom, work):
    index, taken = built(load_dataset(phantom), QUICK, work)
    assert taken == []
    again, before = assembled(work, index), load_result(work)
    np.testing.assert_array_equal(again.shapes.tensor, before.shapes.tensor)
    assert again.model.fingerprint == before.model.fingerprint


def test_another_matching_of_the_tongue_redoes_only_what_depends_on_it(phantom, work, tmp_path):
    changed = replace(QUICK, tongue=replace(QUICK.tongue, energies=QUICK.tongue.energies - 1), rounds=0)
    _, taken = built(load_dataset(phantom), changed, work)
    assert sorted(set(taken)) == ["held out", "matched"] and taken.count("matched") == 6


def test_a_new_landmark_on_one_scan_redoes_only_that_scan(phantom, work):
    dataset = load_dataset(phantom)
    cell = "Speaker02", "i"
    entry = dataset.scans[cell]
    moved = {**entry.tongue_landmarks, "Tip": entry.tongue_landmarks["Tip"] + 0.5}
    changed = replace(dataset, scans={**dataset.scans, cell: replace(entry, tongue_landmarks=moved)})
    _, taken = built(changed, QUICK, work, until="matched")
    assert taken == ["matched"]


def test_a_renamed_scan_is_not_made_again(phantom, work, tmp_path):
    dataset = load_dataset(copied(phantom, tmp_path / "moved"))
    _, taken = built(dataset, QUICK, work)
    assert taken == []


def test_the_steps_can_be_taken_one_after_the_other(phantom, work, tmp_path):
    """Each finds what the last one left, and only adds its own."""
    index, _ = built(load_dataset(phantom), QUICK, work, until="clouds")
    assert index.clouds and not index.tongues and not index.used
    with pytest.raises(InputError, match="no build came to its end"):
        assembled(work, index)
    write_index(tmp_path, index)
    assert read_index(tmp_path).clouds == index.clouds


def test_people_can_be_asked_which_of_its_contours_they_prefer(work, tmp_path, capsys):
    """`mri preference make`: every scan with the contours before and after bootstrapping, near the true middle."""
    from tonguetrack.model.mri.preference import load_test

    arguments = ["-o", str(tmp_path / "test"), "--partitions", "2"]
    assert main(["mri", "preference", "make", str(work), *arguments]) == 0
    assert "6 slices in 2 partitions" in capsys.readouterr().err
    test, result = load_test(tmp_path / "test"), load_result(work)
    assert test.synthetic and [(item.speaker, item.phone) for item in test.items] == list(result.scans)
    for item in test.items:
        scan = result.scans[item.speaker, item.phone]
        tip = scan.final[result.tongue.landmarks["Tip"], 0]
        assert abs(item.at_mm - tip) < 4.0
        for mesh, lines in ((scan.initial, item.initial), (scan.final, item.final)):
            near = mesh[np.abs(mesh[:, 0] - item.at_mm) < 1.5]
            along = np.vstack(lines)
            assert np.ptp(along[:, 1]) == pytest.approx(np.ptp(near[:, 2]), abs=1.5)
            assert np.ptp(along[:, 0]) == pytest.approx(np.ptp(near[:, 1]), abs=1.5)
