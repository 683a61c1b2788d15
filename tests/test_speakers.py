"""The three ways to a speaker's anatomy: known speakers come back, the uncertainty means something, one command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from parametric import parametric_model

from tonguetrack import InputError
from tonguetrack.drivers import FrameOfReference, Recording, open_recording, write_recording
from tonguetrack.model.build import load_training_shapes, model_from_shapes, read_sample_database
from tonguetrack.model.mesh import Mesh, mesh_bytes
from tonguetrack.tracker import complete_setup, load_session
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.session import Energy, Session
from tonguetrack.tracker.speakers import (
    JOINT,
    MEAN,
    MESH,
    SpeakerResult,
    compare_speakers,
    differences,
    effective_frames,
    first_speech,
    mesh_speaker,
    speaker_results,
)

RATE_HZ = 200.0
ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum")
SESSION = Session(energy=Energy(beta_speaker=0.01, beta_pose=0.01, gamma_speaker=0.0, gamma_pose=0.0))


@pytest.fixture(scope="module")
def tongues():
    return parametric_model()


def speech(model, seed, seconds=2.0, noise_mm=0.1, spread=0.6):
    """A recording of a known speaker of the model, who moves smoothly, with all that is true of it."""
    random = np.random.default_rng(seed)
    s = model.speaker.mean + spread * model.speaker.measured_sigma * random.normal(size=model.speaker.size)
    times = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    waves = [
        np.sin(
            2 * np.pi * random.uniform(1.0, 4.0, model.pose.size) * times[:, None] + random.uniform(0, 6, 4)
        )
        for _ in range(2)
    ]
    poses = model.pose.mean + model.pose.measured_sigma * (waves[0] + waves[1])
    vertices = tuple(model.marks.midsagittal[place] for place in (6, 20, 34))
    at_coils = model.at(vertices)
    coils = np.array([at_coils.vertices(s, pose) for pose in poses])
    coils += random.normal(scale=noise_mm, size=coils.shape)
    recording = Recording(
        coils=ROLES,
        positions=coils,
        times_s=times,
        rate_hz=RATE_HZ,
        format="test",
        frame=FrameOfReference("left", "back", "up", "upper incisors, the model's"),
    )
    session = replace(SESSION, correspondences=dict(zip(ROLES, vertices, strict=True)))
    return recording, complete_setup(recording, model, session), s, poses


def meshes_of(model, s, poses):
    return [Mesh(model.vertices(s, pose), model.faces) for pose in poses]


# Known speakers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_known_speaker_is_recovered_within_a_third_of_a_sigma_where_he_is_observable(tongues, seed):
    """From three coils by the joint estimate, and from meshes: in the weights that each says it is sure of."""
    recording, setup, s, poses = speech(tongues, seed, seconds=4.0)
    results = speaker_results(recording, tongues, setup, meshes_of(tongues, s, poses[::200]))
    for way in (JOINT, MESH):
        off = np.abs(results[way].weights - s) / tongues.speaker.sigma
        observable = results[way].sigma < 0.1
        assert observable.sum() >= 3
        assert off[observable].max() < 0.3, way


def test_one_second_of_speech_is_enough_and_is_said_to_be_less_sure(tongues):
    recording, setup, s, _ = speech(tongues, seed=4, seconds=6.0)
    short, whole = (speaker_results(recording, tongues, setup, seconds=n) for n in (1.0, None))
    assert short[MEAN].samples == short[JOINT].samples == RATE_HZ
    assert whole[JOINT].samples == recording.frame_count
    for way in (MEAN, JOINT):
        assert short[way].sigma.mean() > whole[way].sigma.mean()
        assert f"{RATE_HZ:.0f} frames" in short[way].sentence and " to " in short[way].sentence
    off = np.abs(short[JOINT].weights - s) / tongues.speaker.sigma
    assert np.median(off) < 0.3


def test_meshes_of_the_speaker_are_worth_more_than_coils(tongues):
    recording, setup, s, poses = speech(tongues, seed=5)
    comparison = compare_speakers(recording, tongues, setup, meshes_of(tongues, s, poses[::150]))
    mean_tongue = (tongues.vertices(s, poses.mean(axis=0))).reshape(-1, 3)
    off = {
        way: np.linalg.norm(tracked.mean_tongue - mean_tongue, axis=1).mean()
        for way, tracked in comparison.tracked.items()
    }
    assert off[MESH] == min(off.values()) and off[MESH] < 0.5
    assert comparison.tracked[MESH].residual_mm < 0.5 and comparison.tracked[MESH].good > 0.95
    assert comparison.results[MESH].residual_mm < 1e-6


def test_distances_are_between_the_mean_tongues_of_one_recording(tongues):
    recording, setup, s, poses = speech(tongues, seed=6)
    comparison = compare_speakers(recording, tongues, setup, meshes_of(tongues, s, poses[:1]))
    assert set(comparison.distances_mm) == {(MEAN, JOINT), (MEAN, MESH), (JOINT, MESH)}
    one, other = (comparison.tracked[way].mean_tongue for way in (MEAN, JOINT))
    expected = np.linalg.norm(one - other, axis=1).mean()
    assert comparison.distances_mm[MEAN, JOINT] == pytest.approx(expected)


def test_a_mesh_with_vertices_of_its_own_is_fitted_by_its_surface(tongues):
    """The same surface, its vertices in another order, which no fit vertex by vertex could use."""
    s, _ = (mode.mean for mode in (tongues.speaker, tongues.pose))
    (mesh,) = meshes_of(tongues, s, [tongues.pose.raw([0.5, -0.5, 0.5, 0.0])])
    order = np.random.default_rng(2).permutation(len(mesh.vertices))
    place = np.argsort(order)
    shuffled = Mesh(mesh.vertices[order], place[mesh.faces].astype(np.int32))
    registered, surface = (mesh_speaker(tongues, [one], 2.0) for one in (mesh, shuffled))
    assert "registered mesh" in registered.sentence and "surface" in surface.sentence
    assert surface.residual_mm < 0.6  # of edges of about 1 mm


# Uncertainty ------------------------------------------------------------------------------------------


def test_frames_without_memory_all_count_and_frames_with_memory_count_less():
    random = np.random.default_rng(3)
    frames, memory = 20000, 0.9
    white = random.normal(size=(frames, 3))
    slow = np.zeros_like(white)
    for frame in range(1, frames):
        slow[frame] = memory * slow[frame - 1] + white[frame]
    np.testing.assert_allclose(effective_frames(white), frames, rtol=0.1)
    # An autoregressive series of first order is worth (1 - a)/(1 + a) of its length.
    np.testing.assert_allclose(effective_frames(slow), frames * (1 - memory) / (1 + memory), rtol=0.25)
    slow[random.random(frames) < 0.3] = np.nan
    kept = np.isfinite(slow[:, 0]).mean()
    gaps = effective_frames(slow)
    assert (gaps < 1.3 * frames * (1 - memory) / (1 + memory)).all()
    assert (gaps > 0.5 * kept * frames * (1 - memory) / (1 + memory)).all()


def test_copying_every_frame_makes_no_estimate_surer():
    slow = np.cumsum(np.random.default_rng(1).normal(size=(500, 2)), axis=0)
    slow -= np.linspace(0, 1, 500)[:, None] * slow[-1]
    once, ten_times = effective_frames(slow), effective_frames(slow.repeat(10, axis=0))
    np.testing.assert_allclose(ten_times, once, rtol=0.2)


def test_a_series_is_worth_at_least_one_frame_and_at_most_all():
    assert effective_frames(np.linspace(0, 1, 50)[:, None]) < 10
    assert effective_frames(np.array([[1.0]])) == 1.0
    alternating = np.tile([1.0, -1.0], 50)[:, None]
    assert effective_frames(alternating) <= 100.0
    assert effective_frames(np.ones((10, 1))) >= 1.0


def test_what_differs_is_what_lies_outside_both_uncertainties(tongues):
    sigma = tongues.speaker.sigma
    base = SpeakerResult(tongues.speaker.mean, np.full(5, 0.1), 10, 0.0, "")
    moved = replace(base, weights=tongues.speaker.mean + sigma * [0.0, 0.2, 0.4, -0.4, 0.4])
    unsure = replace(moved, sigma=np.array([0.1, 0.1, 0.1, 0.1, np.inf]))
    (third, fourth) = differences(tongues, {"one": base, "other": unsure})
    assert (third.one, third.other, third.weight) == ("one", "other", 3)
    assert third.difference == pytest.approx(-0.4) and fourth.difference == pytest.approx(0.4)
    assert third.error == pytest.approx(np.hypot(0.1, 0.1))


def test_a_speech_that_never_moves_says_nothing_of_how_sure_it_is(tongues):
    """One frame: the mean has no standard error, three coils do not contradict nine weights."""
    recording, setup, _, _ = speech(tongues, seed=7)
    alone = replace(recording, positions=recording.positions[:1], times_s=recording.times_s[:1])
    results = speaker_results(alone, tongues, setup)
    assert np.isinf(results[MEAN].sigma).all() and np.isinf(results[JOINT].sigma).all()


# Time -------------------------------------------------------------------------------------------------


def test_the_seconds_begin_where_the_tongue_begins_to_move():
    still, moving = np.zeros(300), np.cumsum(np.full(500, 0.5))
    y = np.concatenate([still, moving])
    coils = np.zeros((800, 2, 3))
    coils[:, :, 1] = y[:, None]
    coils += np.random.default_rng(0).normal(scale=0.01, size=coils.shape)
    coils[310:320, 0] = np.nan
    used = first_speech(coils, RATE_HZ, 1.0)
    assert 290 <= used.start <= 301 and used.stop - used.start == 200
    assert first_speech(coils, RATE_HZ, 100.0).stop == 800


def test_a_recording_that_stands_still_begins_at_its_beginning():
    assert first_speech(np.ones((50, 1, 3)), RATE_HZ, 0.1) == slice(0, 20)
    assert first_speech(np.ones((1, 1, 3)), RATE_HZ, 1.0) == slice(0, 1)


# Refusals ---------------------------------------------------------------------------------------------


def test_what_cannot_be_used_is_refused_with_a_reason(tongues):
    recording, setup, s, poses = speech(tongues, seed=8)
    for seconds in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="above 0"):
            speaker_results(recording, tongues, setup, seconds=seconds)
    silent = replace(recording, positions=np.full_like(recording.positions, np.nan))
    with pytest.raises(InputError, match="none of the tracked coils"):
        speaker_results(silent, tongues, setup)
    (mesh,) = meshes_of(tongues, s, poses[:1])
    with pytest.raises(InputError, match="model's frame"):
        mesh_speaker(tongues, [Mesh(mesh.vertices + 60.0, mesh.faces)], 5.0)
    with pytest.raises(InputError, match="model's frame"):
        mesh_speaker(tongues, [Mesh(mesh.vertices[:, [1, 0, 2]] + 60.0, mesh.faces[:-1])], 5.0)


# The command ------------------------------------------------------------------------------------------


@pytest.fixture
def desk(tongues, tmp_path):
    """A recording, its session, and three meshes of the speaker, as files."""
    from tonguetrack.tracker.session import session_toml

    recording, setup, s, poses = speech(tongues, seed=9)
    write_recording(recording, tmp_path / "take.csv")
    (tmp_path / "lab.toml").write_text(session_toml(setup.session), encoding="utf-8")
    for number, mesh in enumerate(meshes_of(tongues, s, poses[:300:100])):
        (tmp_path / f"mesh{number}.ply").write_bytes(mesh_bytes(mesh, ".ply"))
    return tmp_path


def asked(desk, *more):
    meshes = [str(path) for path in sorted(desk.glob("mesh*.ply"))]
    return ["anatomy", str(desk / "take.csv"), "--session", str(desk / "lab.toml"), "--mesh", *meshes, *more]


def test_the_command_prints_the_three_ways_side_by_side(desk, capsys):
    assert main(asked(desk)) == 0
    printed = capsys.readouterr().out
    rows = {line.split()[0]: line for line in printed.splitlines()[1:] if "+-" in line}
    assert all(rows[way].count("+-") == 5 for way in (MEAN, JOINT, MESH))
    assert "3 registered meshes" in printed and "% of the frames below 1.5 mm" in printed
    assert "mean tongues" in printed and "apart (whole mesh)" in printed


def test_the_command_gives_the_same_as_json(desk, capsys):
    speakers = bundled_model().speaker
    assert main(asked(desk, "--json", "--seconds", "1")) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report["ways"]) == [MEAN, JOINT, MESH]
    for found in report["ways"].values():
        np.testing.assert_allclose(found["normalised"], speakers.normalised(found["weights"]))
    assert report["ways"][JOINT]["samples"] == RATE_HZ
    assert len(report["mean_tongue_distances_mm"]) == 3


@pytest.mark.parametrize("way", [MEAN, JOINT, MESH])
def test_the_chosen_speaker_goes_into_the_session_and_nothing_else_changes(desk, capsys, way):
    saved = desk / "new" / "saved.toml"
    assert main(asked(desk, "--json", "--save-session", str(saved), "--use", way)) == 0
    report = json.loads(capsys.readouterr().out)
    before, after = load_session(desk / "lab.toml"), load_session(saved)
    np.testing.assert_array_equal(after.speaker_weights, report["ways"][way]["weights"])
    assert after.speaker_source == report["ways"][way]["source"]
    assert after.correspondences == before.correspondences and after.energy == before.energy


def test_a_recording_that_is_not_where_the_model_is_gets_a_warning_and_a_remedy(desk, capsys):
    take = open_recording(desk / "take.csv")
    astray = replace(take, positions=take.positions + [0.0, 0.0, 300.0])
    write_recording(astray, desk / "astray.csv")
    assert main(["anatomy", str(desk / "astray.csv"), "--session", str(desk / "lab.toml")]) == 0
    said = capsys.readouterr().err
    assert "the weights mean nothing; 'tonguetrack calibrate'" in said
    assert main(["anatomy", str(desk / "take.csv"), "--session", str(desk / "lab.toml")]) == 0
    said = capsys.readouterr().err
    assert "warning" not in said and "to keep one of them: --save-session FILE --use WAY" in said


def test_flags_that_do_not_belong_together_are_refused(desk, capsys):
    take = ["anatomy", str(desk / "take.csv")]
    for flags, words in (
        (["--use", "mean"], "belong together"),
        (["--save-session", str(desk / "x.toml")], "belong together"),
        (["--save-session", str(desk / "x.toml"), "--use", "mesh"], "--mesh FILE"),
        (["--mesh", str(desk / "none.ply")], "no such mesh file"),
        (["--save-session", str(desk / "take.csv"), "--use", "mean"], "would be overwritten"),
        (["--save-session", str(desk), "--use", "mean"], "this is a folder"),
    ):
        assert main([*take, *flags]) == 2
        assert words in capsys.readouterr().err
    assert not (desk / "x.toml").exists()


# Real tongues -----------------------------------------------------------------------------------------


def test_of_a_real_speaker_left_out_meshes_and_coils_tell_a_similar_tongue(reference_data):
    """Coils placed on the meshes of a speaker whom the model does not know, one frame a phone."""
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    training = replace(shapes, tensor=shapes.tensor[1:], speakers=shapes.speakers[1:], filled=())
    model = model_from_shapes(training, 5, 4)
    truth = shapes.tensor[0].reshape(len(shapes.prompts), -1, 3)
    vertices = (2465, 1912, 1250)
    recording = Recording(
        coils=ROLES,
        positions=np.ascontiguousarray(truth[:, vertices]),
        times_s=np.arange(len(truth)) / RATE_HZ,
        rate_hz=RATE_HZ,
        format="test",
        frame=FrameOfReference("left", "back", "up", "the model's"),
    )
    energy = Energy(gamma_speaker=0.0, gamma_pose=0.0)
    session = Session(energy=energy, correspondences=dict(zip(ROLES, vertices, strict=True)))
    setup = complete_setup(recording, model, session)
    comparison = compare_speakers(recording, model, setup, [Mesh(mesh, model.faces) for mesh in truth])
    mean_shape = np.linalg.norm(truth.mean(axis=0) - model.origin.reshape(-1, 3), axis=1).mean()
    for tracked in comparison.tracked.values():
        off = np.linalg.norm(tracked.mean_tongue - truth.mean(axis=0), axis=1).mean()
        assert off < 0.6 * mean_shape
    assert max(comparison.distances_mm.values()) < mean_shape


def test_a_real_recording_gets_a_speaker_from_one_second(reference_data):
    folder = reference_data / "recordings" / "emu_webapp" / "ssff"
    recording = open_recording(next(iter(sorted(folder.glob("*.t_tip")))))
    model = bundled_model()
    setup = complete_setup(recording, model, Session())
    results = speaker_results(recording, model, setup, seconds=1.0)
    for found in results.values():
        assert np.isfinite(found.weights).all() and (found.sigma > 0).all()
        assert np.abs(model.speaker.normalised(found.weights)).max() <= setup.session.energy.box + 1e-9
