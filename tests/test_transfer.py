"""Motion transfer: one speaker's motion, another's mouth."""

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.pose import TrackedPoses
from tonguetrack.tracker.session import Session, session_toml
from tonguetrack.tracker.transfer import other_speaker, transferred

PALATE = """
[palate]
source = "a trace"
points_mm = [[0.0, 4.0, 6.5], [0.0, 8.0, 9.1], [0.0, 30.0, 12.0]]
"""


def poses_of(model, frames=30, seed=1):
    random = np.random.default_rng(seed)
    weights = model.pose.raw(random.normal(size=(frames, model.pose.size)))
    speaker = model.speaker.raw(random.normal(size=model.speaker.size))
    coils = np.array([model.vertices(speaker, row)[[3, 9]] for row in weights])
    return TrackedPoses(
        np.arange(frames) / 250.0,
        np.ones(frames, dtype=np.int64),
        weights,
        model.pose.normalised(weights),
        np.tile(speaker, (frames, 1)),
        np.ones(frames),
        np.full(frames, 0.3),
        np.full((frames, 2), 0.3),
        coils,
        coils.copy(),
        ("tongue_tip", "tongue_blade"),
        (3, 9),
        2,
        250.0,
        model_fingerprint=model.fingerprint,
    )


def another(model):
    return model.speaker.raw(np.random.default_rng(9).normal(size=model.speaker.size))


def test_the_other_speaker_does_what_the_first_one_did(small_model):
    poses = poses_of(small_model)
    weights = another(small_model)
    text = ",".join(map(repr, weights.tolist()))
    moved = transferred(poses, other_speaker(text, small_model))
    np.testing.assert_array_equal(moved.weights, poses.weights)
    np.testing.assert_array_equal(moved.times_s, poses.times_s)
    for frame in (0, 17):
        expected = small_model.for_speaker(weights).vertices(poses.weights[frame])
        found = small_model.vertices(moved.speaker_weights[frame], moved.weights[frame])
        np.testing.assert_allclose(found, expected, atol=1e-12)
        own = small_model.vertices(poses.speaker_weights[frame], poses.weights[frame])
        assert np.abs(found - own).max() > 0.5  # another anatomy indeed


def test_there_and_back_is_the_same_mesh(small_model):
    poses = poses_of(small_model)
    there = transferred(poses, other_speaker(",".join(map(repr, another(small_model).tolist())), small_model))
    own = ",".join(map(repr, poses.speaker_weights[0].tolist()))
    back = transferred(there, other_speaker(own, small_model))
    np.testing.assert_array_equal(back.speaker_weights, poses.speaker_weights)
    np.testing.assert_array_equal(back.weights, poses.weights)


def test_what_was_measured_on_the_first_speaker_does_not_go_with_it(small_model):
    poses = poses_of(small_model)
    moved = transferred(poses, other_speaker(",".join(["0"] * 5), small_model))
    for array in (moved.coils, moved.residuals_mm, moved.residual_mm, moved.energies):
        assert np.isnan(array).all()
    assert moved.coils.shape == poses.coils.shape and moved.vertices is None
    assert not np.isnan(poses.coils).any()  # the first ones are as they were


def test_a_free_speaker_becomes_the_other_one_in_every_frame(small_model):
    poses = poses_of(small_model)
    poses.speaker_weights[:] += np.random.default_rng(2).normal(size=poses.speaker_weights.shape)
    moved = transferred(poses, other_speaker(",".join(["0.25"] * 5), small_model))
    assert (moved.speaker_weights == 0.25).all() and moved.experiment == 2


def test_a_session_file_names_the_other_speaker_and_brings_that_speakers_palate(small_model, tmp_path):
    weights = another(small_model)
    session = Session(speaker_weights=weights, model_fingerprint=small_model.fingerprint)
    (tmp_path / "other.toml").write_text(session_toml(session) + PALATE)
    found = other_speaker(str(tmp_path / "other.toml"), small_model)
    np.testing.assert_array_equal(found.weights, weights)
    assert len(found.palate.points_mm) == 3
    assert "other.toml" in found.source


@pytest.mark.parametrize(
    "text, complaint",
    [
        ("1,2,3", "3 weights; the model random test model needs 5"),
        ("1,2,3,4,nan", "needs 5, all finite"),
        ("0,0,1e300,0,0", "weight 3 is .* sigma from the mean, which is no tongue"),
        ("1,2,x,4,5", "expected a session file ending in .toml, or raw speaker weights"),
        ("", "expected a session file ending in .toml"),
        ("speaker.txt", "expected a session file ending in .toml"),
        ("absent.toml", "absent.toml: there is no such session file"),
    ],
)
def test_what_is_no_speaker_is_refused_in_a_sentence(small_model, text, complaint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=complaint):
        other_speaker(text, small_model)


@pytest.mark.parametrize(
    "content, complaint",
    [
        ("", r"other.toml: it has no \[speaker\] weights"),
        ('model = "0123456789abcdef"\n[speaker]\nweights = [1, 2, 3, 4, 5]', r"belongs to the model \[0123"),
        ("[speaker]\nweights = [1, 2]", r"\[speaker\] weights: 2 weights"),
        ("[speaker]\nweights = 'abc'", "other.toml"),
    ],
)
def test_a_session_that_does_not_fit_is_refused(small_model, content, complaint, tmp_path):
    (tmp_path / "other.toml").write_text(content)
    with pytest.raises(InputError, match=complaint):
        other_speaker(str(tmp_path / "other.toml"), small_model)
