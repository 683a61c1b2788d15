"""Whole recordings through both experiments, and the live tracker beside them."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.optimize import minimize

from tonguetrack import InputError
from tonguetrack.drivers import open_recording
from tonguetrack.drivers.frames import CoilFrame, Recording
from tonguetrack.model.build import load_training_shapes, model_from_shapes, read_sample_database
from tonguetrack.model.files import load_model
from tonguetrack.tracker.online import Tracker
from tonguetrack.tracker.pose import PoseStatus
from tonguetrack.tracker.posefiles import write_poses
from tonguetrack.tracker.session import Alignment, Session
from tonguetrack.tracker.tracking import track_recording

VERTICES = {"tongue_tip": 3, "tongue_blade": 9, "tongue_dorsum": 15}


@pytest.fixture(scope="module")
def take(small_model):
    random = np.random.default_rng(0)
    swing = np.sin(np.linspace(0, 9, 200))[:, None] * random.uniform(0.3, 1, 4)
    s = small_model.speaker.raw(random.uniform(-0.5, 0.5, 5))
    shapes = [small_model.vertices(s, small_model.pose.raw(x))[list(VERTICES.values())] for x in swing]
    positions = np.array(shapes) + random.normal(scale=0.2, size=(200, 3, 3))
    positions[50:60, 2] = np.nan
    positions[100:104] = np.nan
    return Recording(("TT", "TB", "TD"), positions, np.arange(200) / 250, 250.0, "test", source="take 1")


@pytest.fixture(scope="module")
def run(small_model, take):
    return track_recording(take, small_model, Session(correspondences=VERTICES))


def test_the_speaker_is_the_mean_of_experiment_1_over_tracked_frames(run):
    tracked = run.experiment_1.statuses == PoseStatus.OK
    np.testing.assert_allclose(
        run.setup.session.speaker_weights, run.experiment_1.speaker_weights[tracked].mean(axis=0), atol=1e-14
    )
    np.testing.assert_array_equal(run.experiment_2.speaker_weights[7], run.setup.session.speaker_weights)


def test_residuals_are_the_distances_between_coils_and_their_vertices(run, small_model):
    for poses in (run.experiment_1, run.experiment_2):
        for t in (0, 55, 150):
            vertices = small_model.vertices(poses.speaker_weights[t], poses.weights[t])[
                list(poses.correspondences)
            ]
            np.testing.assert_allclose(poses.vertices[t], vertices, atol=1e-9)
            distances = np.linalg.norm(vertices - poses.coils[t], axis=1)
            np.testing.assert_allclose(poses.residuals_mm[t], distances, atol=1e-9)
            assert poses.residual_mm[t] == pytest.approx(np.nanmean(distances))


def test_the_reported_energy_is_the_published_one_in_both_experiments(run, small_model):
    for poses in (run.experiment_1, run.experiment_2):
        for t in (1, 55, 150):
            s, p = poses.speaker_weights, poses.weights
            expected = np.nanmean(poses.residuals_mm[t] ** 2)
            expected += 5 * np.sum((s[t] - small_model.speaker.mean) ** 2)
            expected += 5 * np.sum((p[t] - small_model.pose.mean) ** 2)
            expected += 5 * np.sum((s[t] - s[t - 1]) ** 2) + 5 * np.sum((p[t] - p[t - 1]) ** 2)
            assert poses.energies[t] == pytest.approx(expected, rel=1e-9)


def test_frames_without_coils_are_held_and_nothing_is_nan(run):
    for poses in (run.experiment_1, run.experiment_2):
        assert (poses.statuses[100:104] == PoseStatus.HELD).all()
        assert (poses.weights[100:104] == poses.weights[99]).all()
        assert np.isfinite(poses.weights).all()
        assert np.isnan(poses.residual_mm[100:104]).all()
        assert np.isnan(poses.residuals_mm[50:60, 2]).all()


@pytest.mark.parametrize("fixed", [True, False])
def test_the_live_tracker_gives_the_recordings_poses_bit_for_bit(run, take, small_model, fixed):
    setup = run.setup
    if not fixed:
        setup = dataclasses.replace(setup, session=dataclasses.replace(setup.session, speaker_weights=None))
    expected = run.experiment_2 if fixed else run.experiment_1
    tracker = Tracker(small_model, setup)
    tracker.warm_up()
    for t in range(take.frame_count):
        pose = tracker.step(CoilFrame(take.positions[t], float(take.times_s[t]), t, 0))
        np.testing.assert_array_equal(pose.weights, expected.weights[t])
        np.testing.assert_array_equal(pose.speaker_weights, expected.speaker_weights[t])
        np.testing.assert_allclose(pose.normalised, expected.normalised[t], atol=1e-12)
        assert pose.status == expected.statuses[t]
        np.testing.assert_array_equal(pose.energy, expected.energies[t])
        assert pose.valid_coils == np.isfinite(take.positions[t, :, 0]).sum()


def test_a_known_speaker_skips_experiment_1(run, take, small_model):
    again = track_recording(take, small_model, run.setup.session, experiments=(2,))
    assert again.experiment_1 is None
    np.testing.assert_array_equal(again.experiment_2.weights, run.experiment_2.weights)


def test_a_rotated_take_with_its_alignment_gives_the_same_poses(run, take, small_model):
    angle = 0.7
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    shift = np.array([3.0, -20.0, 8.0])
    moved = dataclasses.replace(take, positions=(take.positions - shift) @ rotation)
    session = dataclasses.replace(run.setup.session, alignment=Alignment(rotation, shift))
    again = track_recording(moved, small_model, session, experiments=(2,))
    np.testing.assert_allclose(again.experiment_2.weights, run.experiment_2.weights, atol=1e-9)


@pytest.mark.parametrize("speaker", [None, np.full(5, 0.1)])
def test_a_take_whose_tongue_coils_are_all_dead_is_refused(take, small_model, speaker):
    dead = dataclasses.replace(take, positions=np.full_like(take.positions, np.nan))
    coils = {"TT": "tongue_tip", "TB": "tongue_blade", "TD": "tongue_dorsum"}
    with pytest.raises(InputError, match="none of the tracked coils .* has a position in any frame"):
        track_recording(
            dead, small_model, Session(coils=coils, correspondences=VERTICES, speaker_weights=speaker), (2,)
        )


# The reference recordings ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def papers_model(reference_data):
    database = read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    return model_from_shapes(load_training_shapes(database), 5, 4)


def test_on_the_real_recording_experiment_1_does_no_worse_than_the_authors_program(
    reference_data, papers_model
):
    """Theirs: mean 1.39 mm, 44 % of frames below 1.25 mm, at these vertices, unaligned, x set to 0."""
    recording = open_recording(reference_data / "recordings" / "emu_webapp")
    session = Session(
        alignment=Alignment(midsagittal=True),
        correspondences={"tongue_tip": 2469, "tongue_blade": 1912, "tongue_dorsum": 885},
    )
    run = track_recording(recording, papers_model, session)
    first = run.experiment_1
    tracked = first.tracked
    assert first.residual_mm[tracked].mean() <= 1.39
    assert (first.residual_mm[tracked] < 1.25).mean() >= 0.44
    speakers = papers_model.speaker.normalised(first.speaker_weights)
    for normalised in (speakers, first.normalised, run.experiment_2.normalised):
        assert np.abs(normalised).max() <= 5 + 1e-9


def test_the_same_recording_in_the_authors_own_file_does_no_worse_either(reference_data, papers_model):
    """That file keeps the zero padding at its end as positions when nobody says that zero means missing."""
    recording = open_recording(reference_data / "authors-format" / "emu_webapp_0020_three_coils.json")
    vertices = {"tongue_tip": 2469, "tongue_blade": 1912, "tongue_dorsum": 885}
    first = track_recording(recording, papers_model, Session(correspondences=vertices)).experiment_1
    assert np.nanmean(first.residual_mm) <= 1.39
    assert (first.residual_mm < 1.25).mean() >= 0.44


AUTHORS_CASES = [
    ("synthetic_ema.json", {"TongueTip": ("tongue_tip", 2550), "TongueBlade": ("tongue_blade", 2309),
                            "TongueDorsum": ("tongue_dorsum", 1327)}),
    ("emu_webapp_0020_three_coils.json", {"t_tip": ("tongue_tip", 2550), "t_mid": ("tongue_blade", 2309),
                                          "t_back": ("tongue_dorsum", 1327)}),
]  # fmt: skip


def tracked_authors_data(reference_data, file, coils):
    folder = reference_data / "authors-format"
    model = load_model(folder / "synthetic_model.yaml")
    recording = open_recording(folder / file)
    session = Session(
        coils={channel: role for channel, (role, _) in coils.items()},
        correspondences={role: vertex for role, vertex in coils.values()},
    )
    return model, recording, track_recording(recording, model, session)


@pytest.mark.parametrize(("file", "coils"), AUTHORS_CASES)
def test_every_frame_is_at_or_below_a_tight_minimiser_of_the_published_energy(reference_data, file, coils):
    """The minimiser starts from the same previous frame; relative 1e-6, both experiments."""
    model, _, run = tracked_authors_data(reference_data, file, coils)
    core = model.at(run.setup.vertices).core
    origin = model.at(run.setup.vertices).origin
    mean = np.r_[model.speaker.mean, model.pose.mean]
    sigma = np.r_[model.speaker.sigma, model.pose.sigma]
    bounds = list(zip(mean - 5 * sigma, mean + 5 * sigma, strict=True))

    def energy(x, q, previous, gamma, rows):
        s, p = x[:5], x[5:]
        js = np.tensordot(p, core[:, :, rows], axes=(0, 1))
        jp = np.tensordot(s, core[:, :, rows], axes=1)
        r = origin[rows] + p @ jp - q
        a = 3 / len(q)
        value = a * r @ r + 5 * np.sum((x - mean) ** 2) + gamma * np.sum((x - previous) ** 2)
        gradient = 2 * a * np.r_[js @ r, jp @ r] + 10 * (x - mean) + 2 * gamma * (x - previous)
        return value, gradient

    for poses in (run.experiment_1, run.experiment_2):
        weights = np.column_stack([poses.speaker_weights, poses.weights])
        free = slice(0, 9) if poses.experiment == 1 else slice(5, 9)
        worst = 0.0
        for t in range(poses.frame_count):
            present = ~np.isnan(poses.coils[t, :, 0])
            if not present.any():
                continue
            rows = np.repeat(present, 3)
            previous = (
                weights[t - 1] if t else weights[0] * (poses.experiment == 2) + mean * (poses.experiment == 1)
            )
            gamma = 5.0 if t else 0.0
            q = poses.coils[t][present].ravel()

            def reduced(x, at, free, q, previous, gamma, rows):
                full = at.copy()
                full[free] = x
                value, gradient = energy(full, q, previous, gamma, rows)
                return value, gradient[free]

            reference = minimize(
                reduced, previous[free], args=(weights[t], free, q, previous, gamma, rows), jac=True, method="L-BFGS-B", bounds=bounds[free],
                options={"ftol": 1e-15, "gtol": 1e-9, "maxiter": 1000, "maxfun": 5000, "maxcor": 20},
            )  # fmt: skip
            worst = max(worst, poses.energies[t] / reference.fun - 1)
        assert worst <= 1e-6, f"experiment {poses.experiment}"


@pytest.mark.parametrize(("file", "coils"), AUTHORS_CASES)
def test_a_whole_run_on_the_authors_data_is_written_in_the_authors_json(
    reference_data, tmp_path, file, coils
):
    model, recording, run = tracked_authors_data(reference_data, file, coils)
    for poses in (run.experiment_1, run.experiment_2):
        write_poses(poses, model, tmp_path / "poses.json")
        frames = json.loads((tmp_path / "poses.json").read_text())
        assert len(frames) == recording.frame_count
        np.testing.assert_array_equal([frame["phonemeWeights"] for frame in frames], poses.weights)
        np.testing.assert_array_equal([frame["speakerWeights"] for frame in frames], poses.speaker_weights)
        np.testing.assert_array_equal([frame["timeStamp"] for frame in frames], recording.times_s)
