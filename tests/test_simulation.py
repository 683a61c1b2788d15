"""Simulated recordings: their truth, their noise, their gaps, and what the tracker makes of them."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tonguetrack import InputError
from tonguetrack.drivers import open_recording
from tonguetrack.model.mri.phantom.unseen import SHIPPED, computed_speaker, unseen_speaker
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.session import Session
from tonguetrack.tracker.simulation import TONGUE_COILS, Simulation, simulate, write_simulation
from tonguetrack.tracker.tracking import track_recording

PHONES = ("ə", "i", "ɑ", "s")


def test_the_same_simulation_gives_the_same_recording():
    first, second = simulate(Simulation(PHONES)), simulate(Simulation(PHONES))
    np.testing.assert_array_equal(first[0].positions, second[0].positions)
    assert first[1].anatomy == second[1].anatomy
    other, _ = simulate(Simulation(PHONES, seed=2))
    assert not np.array_equal(other.positions, first[0].positions)


def test_the_noise_is_what_was_asked_for_and_the_truth_is_without():
    recording, truth = simulate(Simulation(PHONES, seconds=4, noise_mm=0.5))
    error = recording.positions - truth.positions
    assert error.std() == pytest.approx(0.5, rel=0.05)
    assert abs(error.mean()) < 0.02
    quiet, same = simulate(Simulation(PHONES, seconds=4, noise_mm=0.0))
    np.testing.assert_allclose(quiet.positions, same.positions, atol=6e-4)


def test_coils_move_smoothly_at_the_speed_of_speech():
    _, truth = simulate(Simulation(PHONES, seconds=3))
    speed = np.linalg.norm(np.diff(truth.positions, axis=0), axis=2) * 250
    assert 50 < speed.max() < 600  # mm/s
    assert np.linalg.norm(np.diff(truth.positions, n=2, axis=0), axis=2).max() < 1.0


def test_dropouts_have_the_share_that_was_asked_for_and_come_in_runs():
    recording, _ = simulate(Simulation(PHONES, seconds=60, rate_hz=100, dropouts=0.1))
    missing = ~recording.valid()
    assert missing.mean() == pytest.approx(0.1, abs=0.03)
    runs = np.diff(np.flatnonzero(np.diff(missing[:, 0].astype(int)) != 0))[::2]
    assert runs.mean() > 2


def test_head_motion_is_rigid_and_its_inverse_is_the_truth():
    coils = ("tongue_tip", "head_nose", "head_left", "head_right")
    recording, truth = simulate(Simulation(PHONES, coils, noise_mm=0.0, head_motion=True, seconds=3))
    assert np.ptp(recording.positions[:, 1], axis=0).max() > 3
    back = np.einsum(
        "tba,tcb->tca", truth.head_rotation, recording.positions - truth.head_translation_mm[:, None]
    )
    np.testing.assert_allclose(back, truth.positions, atol=2e-3)


def test_the_file_and_its_truth_lie_side_by_side(tmp_path):
    path, truth_path = write_simulation(Simulation(PHONES), tmp_path / "take.csv")
    recording = open_recording(path)
    assert recording.coils == ("tongue_tip", "tongue_blade", "tongue_dorsum")
    assert str(recording.frame.y) == "back"
    with np.load(truth_path) as truth:
        words = json.loads(truth["words"].tobytes())
        assert words["phones"] == list(PHONES)
        assert truth["positions"].shape == recording.positions.shape
        assert truth["contours"].shape[0] == len(truth["contour_times_s"])
        assert words["places"]["tongue_tip"] == list(TONGUE_COILS["tongue_tip"])
        assert truth["palate"].shape[1] == 3


def test_a_coil_sits_where_it_is_said_to_and_keeps_to_its_flesh():
    """Between two tongues of one volume the middle stretches: no coil slides along it."""
    speaker = unseen_speaker(1)
    _, truth = simulate(Simulation(PHONES, (*TONGUE_COILS, "head_nose"), noise_mm=0.0))
    assert truth.places == TONGUE_COILS
    for phone, starts in zip(PHONES, truth.phone_times_s[1:], strict=False):
        end = round(starts * 250) - 1  # held
        line = speaker.middle(phone)
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        for coil, (role, (behind_tip_mm, across)) in enumerate(TONGUE_COILS.items()):
            place = truth.positions[end, coil]
            if across:
                assert np.sign(place[0]) == np.sign(across) and 6.0 < abs(place[0]) < 14.0
                continue
            nearest = np.argmin(np.linalg.norm(line - place, axis=1))
            assert np.linalg.norm(line[nearest] - place) < 1.5
            assert way[nearest] / way[-1] == pytest.approx(behind_tip_mm / speaker.rest_mm, abs=0.02)


def test_the_contour_of_the_truth_passes_through_the_coils_in_the_middle():
    _, truth = simulate(Simulation(PHONES, seconds=2, noise_mm=0.0))
    for contour, t in zip(truth.contours, truth.contour_times_s, strict=True):
        for coil in truth.positions[round(t * 250)]:
            along = np.linspace(0, len(contour) - 1, 2000)
            line = np.column_stack([np.interp(along, range(len(contour)), column) for column in contour.T])
            assert np.linalg.norm(line - coil, axis=1).min() < 0.1


def test_the_contour_stays_below_the_palate_and_comes_near_it_in_s_and_i():
    _, truth = simulate(Simulation(("s", "a", "i"), speaker=2, seconds=0.6))
    below = [
        np.interp(contour[:, 1], *truth.palate[:, 1:].T, left=np.nan, right=np.nan) - contour[:, 2]
        for contour in truth.contours
    ]
    gap = np.nanmin(below, axis=1)
    assert gap.min() > 0.5
    s, a, i = (gap[round((start + 0.16) * 25)] for start in (0.0, 0.2, 0.4))
    assert s < 3.0 and i < 5.0 and a > 9.0


def test_any_speaker_can_be_simulated_and_each_is_another():
    speaker = max(SHIPPED) + 1
    _, first = simulate(Simulation(("ə",), speaker=speaker))
    assert first.anatomy.name == f"Unseen{speaker:02d}"
    others = [unseen_speaker(number).anatomy for number in SHIPPED]
    assert len({first.anatomy.palate_mm, *(anatomy.palate_mm for anatomy in others)}) == 1 + len(SHIPPED)
    made = computed_speaker(speaker, ("ə",))
    np.testing.assert_allclose(first.contours[-1], made.middle("ə"), atol=1e-9)


def test_the_tracker_finds_the_unseen_speakers_tongue_within_a_millimetre_and_a_half():
    """Over the whole mid-sagittal contour, not only where the coils sit; the mean shape is far worse."""
    recording, truth = simulate(Simulation(PHONES, speaker=2, seconds=4))
    model = bundled_model()
    poses = track_recording(recording, model, Session()).experiment_2
    at = np.searchsorted(poses.times_s, truth.contour_times_s[:-1])
    midline = list(model.marks.midsagittal)

    def error(weights, speaker, contour):
        return cKDTree(model.vertices(speaker, weights)[midline]).query(contour)[0].mean()

    tracked, mean_shape = [], []
    for frame, contour in zip(at, truth.contours, strict=False):
        tracked.append(error(poses.weights[frame], poses.speaker_weights[frame], contour))
        mean_shape.append(error(model.pose.mean, model.speaker.mean, contour))
    assert np.mean(tracked) < 1.5
    assert np.mean(tracked) < 0.4 * np.mean(mean_shape)
    assert poses.residual_mm.mean() < 1.0


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"phones": ("x",)}, "the phone 'x' is unknown; the synthetic speakers know i e"),
        ({"phones": ()}, "at least one phone"),
        ({"coils": ("tongue_top",)}, "the coil 'tongue_top' is unknown; coils can sit at tongue_tip"),
        ({"coils": ("tongue_tip", "tongue_tip")}, "each coil once"),
        ({"rate_hz": 0.0}, "--rate 0: expected 1 to 5000"),
        ({"dropouts": 1.0}, "--dropouts 1: expected 0 to 0.95"),
        ({"noise_mm": float("nan")}, "--noise nan: expected 0 to 100"),
        ({"seconds": 1e9}, "--seconds 1e"),
    ],
)
def test_impossible_simulations_are_refused(changes, sentence):
    with pytest.raises(InputError, match=sentence):
        Simulation(**{"phones": PHONES, **changes})
