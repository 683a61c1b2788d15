"""glTF files hold the same tongue, to 1e-5 mm; an outside validator, and outside readers, find nothing wrong."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from strict_gltf import read_glb, to_model_frame

from tonguetrack import InputError
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.model.multilinear import SpeakerModel
from tonguetrack.model.rebasing import Rebased
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.gltf import glb, to_scene

NAME = "a tongue"
PALATE = np.array([[0.0, 5.0, 8.0], [0.0, 20.0, 18.0], [0.0, 40.0, 15.0]])


@pytest.fixture(scope="module")
def speaker():
    model = bundled_model()
    return model.for_speaker(model.speaker.mean + 0.5 * model.speaker.sigma)


@pytest.fixture(scope="module")
def clip(speaker):
    """Half a second at 250 Hz that begins at 7.5 s and reaches +-3 sigma."""
    times = 7.5 + np.arange(125) / 250.0
    phase = np.linspace(0, 6, 125)[:, None] * [1.0, 1.7, 2.3, 3.1] + [0.0, 1.0, 2.0, 3.0]
    return times, speaker.mean + 3 * np.sin(phase) * speaker.sigma


@pytest.fixture(scope="module")
def coils(speaker, clip):
    """Three coils on the tongue: one always there, one gone for a while at the start and in the middle, one never."""
    positions = np.array([speaker.vertices(weights)[[10, 500, 900]] for weights in clip[1]])
    positions[:20, 1] = np.nan
    positions[60:70, 1] = np.nan
    positions[:, 2] = np.nan
    return ("tongue_tip", "tongue_blade", "tongue_dorsum"), positions


@pytest.fixture(scope="module")
def whole(speaker, clip, coils):
    """A file with everything that one can hold."""
    return glb(speaker, Rebased.of_clip(clip[1]), NAME, clip, PALATE, coils)


def linear(directions, seed=3):
    """A random linear model of any number of directions: a strip of 10 triangles."""
    random = np.random.default_rng(seed)
    faces = np.array([[i, i + 1, i + 2] if i % 2 else [i, i + 2, i + 1] for i in range(10)], dtype=np.int32)
    return SpeakerModel(
        random.normal(size=36) * 20,
        random.normal(size=(directions, 36)) * 5,
        faces,
        random.normal(size=directions),
        random.uniform(0.1, 1, directions),
    )


# The same tongue ------------------------------------------------------------------------------------


@pytest.mark.parametrize("ranges", ["of the clip", "five sigma"])
def test_every_frame_comes_back_from_the_file_to_a_hundred_thousandth_of_a_millimetre(speaker, clip, ranges):
    clips_own, wide = Rebased.of_clip(clip[1]), Rebased.of_range(speaker.mean, speaker.sigma, 5)
    nodes, _ = read_glb(glb(speaker, clips_own if ranges == "of the clip" else wide, NAME, clip))
    keys = nodes[NAME].channels["weights"].times
    np.testing.assert_allclose(keys, clip[0] - clip[0][0], atol=1e-7)
    worst = 0.0
    for key, weights in zip(keys, clip[1], strict=True):
        worst = max(
            worst, np.abs(to_model_frame(nodes[NAME].vertices(key)) - speaker.vertices(weights)).max()
        )
    assert 0 < worst < 1e-5
    np.testing.assert_array_equal(nodes[NAME].faces, speaker.faces)


def test_no_weight_of_a_clip_leaves_0_to_1_so_a_program_that_clamps_shows_the_same(clip, whole):
    nodes, _ = read_glb(whole)
    values = nodes[NAME].channels["weights"].values
    assert values.min() == 0 and values.max() == 1
    assert values.shape == clip[1].shape


@pytest.mark.parametrize("directions", [1, 3, 11])
def test_any_number_of_directions_makes_as_many_targets(directions):
    speaker = linear(directions)
    rebased = Rebased.of_range(speaker.mean, speaker.sigma, 5)
    nodes, content = read_glb(glb(speaker, rebased, NAME))
    assert len(nodes[NAME].targets) == directions
    assert content["meshes"][0]["extras"]["targetNames"] == [f"pose_{k}" for k in range(directions)]
    found = to_model_frame(nodes[NAME].vertices())
    np.testing.assert_allclose(found, speaker.vertices(speaker.mean), atol=1e-5)


def test_the_extras_say_which_raw_weights_0_and_1_are(speaker):
    rebased = Rebased.of_range(speaker.mean, speaker.sigma, 5)
    nodes, _ = read_glb(glb(speaker, rebased, NAME))
    extras = nodes[NAME].mesh["extras"]
    weights = speaker.mean + speaker.sigma * [1.0, -2.0, 0.5, 3.0]
    low, high = np.array(extras["weights_low"]), np.array(extras["weights_high"])
    unit = (weights - low) / (high - low)
    shown = nodes[NAME].positions + np.tensordot(unit, np.array(nodes[NAME].targets, dtype=np.float64), 1)
    np.testing.assert_allclose(to_model_frame(shown), speaker.vertices(weights), atol=1e-5)


def test_the_front_of_the_tongue_faces_plus_z_its_back_is_up_and_its_left_is_plus_x():
    np.testing.assert_allclose(to_scene(np.array([1.0, 2.0, 3.0])), [0.001, 0.003, -0.002])


def test_without_a_clip_the_tongue_rests_at_the_mean_and_nothing_moves(speaker):
    nodes, content = read_glb(glb(speaker, Rebased.of_range(speaker.mean, speaker.sigma), NAME))
    assert "animations" not in content
    np.testing.assert_allclose(nodes[NAME].weights(), 0.5)
    np.testing.assert_allclose(
        to_model_frame(nodes[NAME].vertices()), speaker.vertices(speaker.mean), atol=1e-5
    )


def test_a_direction_that_never_moves_and_a_clip_of_one_frame_are_files_as_well(speaker):
    weights = np.array([speaker.mean + speaker.sigma])
    nodes, _ = read_glb(glb(speaker, Rebased.of_clip(weights), NAME, (np.array([3.0]), weights)))
    found = to_model_frame(nodes[NAME].vertices(0.0))
    np.testing.assert_allclose(found, speaker.vertices(weights[0]), atol=1e-5)


def test_the_normals_are_right_in_the_middle_of_the_range_and_nearly_so_within_one_sigma(speaker):
    nodes, _ = read_glb(glb(speaker, Rebased.of_range(speaker.mean, speaker.sigma), NAME))
    node = nodes[NAME]

    def astray(unit):
        """Angles in degrees between the file's normals and the surface's own."""
        shown = node.normals + np.tensordot(unit, np.array(node.target_normals), 1)
        shown = shown / np.linalg.norm(shown, axis=1, keepdims=True)
        at = node.positions + np.tensordot(unit, np.array(node.targets), 1)
        own = vertex_normals(at.astype(np.float64), speaker.faces)
        return np.degrees(np.arccos(np.clip((shown * own).sum(axis=1), -1, 1)))

    assert astray(np.full(4, 0.5)).max() < 0.05
    within_one_sigma = 0.5 + np.random.default_rng(0).uniform(-1, 1, (20, 4)) / 6
    assert max(np.median(astray(unit)) for unit in within_one_sigma) < 3


# What stands beside it ------------------------------------------------------------------------------


def test_the_palate_is_a_line_through_its_points(whole):
    nodes, _ = read_glb(whole)
    assert nodes["palate"].mode == 3
    np.testing.assert_allclose(to_model_frame(nodes["palate"].vertices()), PALATE, atol=1e-5)


def test_coils_are_where_they_were_and_vanish_where_they_were_missing(whole, clip, coils):
    nodes, _ = read_glb(whole)
    names, positions = coils
    assert "tongue_dorsum" not in nodes  # never there
    for index, name in enumerate(names[:2]):
        for frame, time in enumerate(clip[0] - clip[0][0]):
            missing = np.isnan(positions[frame, index, 0])
            assert nodes[name].size(time).tolist() == [0.0 if missing else 1.0] * 3
            if not missing:
                place = to_model_frame(nodes[name].place(time))
                np.testing.assert_allclose(place, positions[frame, index], atol=1e-5)


def test_a_coil_is_a_ball_whose_faces_look_outwards(whole):
    nodes, _ = read_glb(whole)
    ball = nodes["tongue_tip"]
    np.testing.assert_allclose(np.linalg.norm(ball.positions, axis=1), 0.0015, rtol=1e-5)
    a, b, c = (ball.positions[ball.faces[:, corner]] for corner in range(3))
    assert ((np.cross(b - a, c - a) * (a + b + c)).sum(axis=1) > 0).all()
    assert len(ball.faces) == 2 * len(ball.positions) - 4  # closed


# What is refused ------------------------------------------------------------------------------------


def test_times_that_do_not_increase_are_refused_with_the_frame(speaker, clip):
    times = clip[0].copy()
    times[40] = times[39]
    with pytest.raises(InputError, match="frame 40 at 7.656000 s does not come after"):
        glb(speaker, Rebased.of_clip(clip[1]), NAME, (times, clip[1]))


def test_a_model_without_faces_is_refused(speaker):
    with pytest.raises(InputError, match="without faces"):
        glb(speaker.at([1, 2, 3]), Rebased.of_range(speaker.mean, speaker.sigma), NAME)


def test_coils_of_other_frames_than_the_clip_are_refused(speaker, clip, coils):
    with pytest.raises(InputError, match="same frames"):
        glb(speaker, Rebased.of_clip(clip[1]), NAME, clip, None, (coils[0], coils[1][:-1]))


# Outside readers ------------------------------------------------------------------------------------

VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
const files = process.argv.slice(2);
Promise.all(files.map((name) => validator.validateBytes(new Uint8Array(fs.readFileSync(name)), {maxIssues: 20})))
  .then((reports) => console.log(JSON.stringify(reports.map((report) => report.issues))));
"""


@pytest.fixture(scope="session")
def validator(tmp_path_factory):
    """A folder in which node finds Khronos' gltf-validator."""
    if shutil.which("npm") is None or shutil.which("node") is None:
        pytest.skip("npm is not installed: the Khronos validator of glTF files cannot run")
    folder = tmp_path_factory.mktemp("validator")
    (folder / "package.json").write_text('{"private": true}')
    (folder / "validate.js").write_text(VALIDATE)
    command = ["npm", "install", "--no-audit", "--no-fund", "--silent", "gltf-validator@2.0.0-dev.3.10"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip("npm could not fetch gltf-validator within 60 s: no network?")
    if done.returncode != 0:
        pytest.skip(f"npm could not install gltf-validator: {done.stderr.strip()[-200:]}")
    return folder


def issues(validator, files):
    for name, content in files.items():
        (validator / name).write_bytes(content)
    done = subprocess.run(
        ["node", "validate.js", *files], cwd=validator, capture_output=True, text=True, timeout=60, check=True
    )
    return json.loads(done.stdout)


def test_the_khronos_validator_has_nothing_to_say(validator, speaker, clip, whole):
    still = np.repeat(clip[1][:1], 5, axis=0)
    random = linear(7)
    files = {
        "whole.glb": whole,
        "model.glb": glb(speaker, Rebased.of_range(speaker.mean, speaker.sigma, 5), NAME),
        "still.glb": glb(speaker, Rebased.of_clip(still), NAME, (clip[0][:5], still), PALATE),
        "seven.glb": glb(random, Rebased.of_range(random.mean, random.sigma), "ʃ, a name beyond ASCII"),
    }
    for name, report in zip(files, issues(validator, files), strict=True):
        assert report["messages"] == [], name
        assert sum(report[kind] for kind in ("numErrors", "numWarnings", "numInfos", "numHints")) == 0


def test_the_validator_does_find_what_is_wrong(validator, whole):
    """So that an empty report means something."""
    broken = bytearray(whole)
    broken[-30000:-29000] = b"\xff" * 1000  # no numbers
    (report,) = issues(validator, {"broken.glb": bytes(broken)})
    assert report["numErrors"] > 0


def test_trimesh_reads_the_tongue_at_the_low_ends_of_its_weights(speaker, clip, whole, tmp_path):
    """It knows neither morph targets nor animations: all weights 0."""
    import trimesh

    (tmp_path / "tongue.glb").write_bytes(whole)
    scene = trimesh.load(tmp_path / "tongue.glb", process=False, maintain_order=True)
    low = clip[1].min(axis=0)
    tongue = scene.geometry[NAME]
    np.testing.assert_allclose(to_model_frame(tongue.vertices), speaker.vertices(low), atol=1e-5)
    np.testing.assert_array_equal(tongue.faces, speaker.faces)
