"""Avatar shapes: each rises when the tongue moves in its sense, by hand or by the model, and its opposite falls."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parametric import parametric_model
from scipy.spatial import cKDTree

from tonguetrack import InputError
from tonguetrack.model.multilinear import SurfaceMarks
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.session import load_session, parse_session, session_toml, with_shape_ranges
from tonguetrack.tracker.streams.landmarks import STATIONS, landmark_vertices
from tonguetrack.tracker.streams.shapes import (
    AXES,
    LEAST,
    SHAPES,
    ShapeMeter,
    axes_of,
    default_ranges,
    shape_names,
    speaker_ranges,
)

MODEL = bundled_model()
NEUTRAL = MODEL.mean_vertices()
LANDMARKS = landmark_vertices(MODEL)
OPPOSITES = [
    ("tip_forward", "tip_back"),
    ("tip_up", "tip_down"),
    ("tip_left", "tip_right"),
    ("curl_up", "bend_down"),
    ("body_up", "body_down"),
    ("body_front", "body_back"),
    ("body_left", "body_right"),
    ("wide", "narrow"),
    ("long", "short"),
    ("groove", "ridge"),
    ("arched", "flat"),
    ("twist_left", "twist_right"),
    ("lean_left", "lean_right"),
]
LEFT_AND_RIGHT = [pair for pair in OPPOSITES if "left" in pair[0]]


def axes(vertices, landmarks=LANDMARKS):
    """The measured quantities of a whole mesh (V, 3), by name."""
    return dict(zip([axis.name for axis in AXES], axes_of(vertices[landmarks].tolist()), strict=True))


def raw(vertices):
    """The shapes of a whole mesh against the neutral one, before any range, by name; `out` is no difference."""
    now, before = axes(vertices), axes(NEUTRAL) | {"out": 0.0}
    return {shape.name: shape.sign * (now[shape.axis] - before[shape.axis]) for shape in SHAPES}


def front(vertices, width=6.0):
    """(V,) 1 at the tip, 0 behind the blade, smooth between."""
    return 1 / (1 + np.exp((vertices[:, 1] - 13.0) / width * 4))


def moved(shift, share):
    return NEUTRAL + np.asarray(shift, dtype=float) * share[:, None]


def turned(vertices, axis, degrees, about):
    """Turned about an axis (0 x, 1 y, 2 z) through a point, counter-clockwise seen from the axis' end."""
    angle = np.radians(degrees)
    one, other = [(1, 2), (2, 0), (0, 1)][axis]
    rotation = np.eye(3)
    rotation[[one, one, other, other], [one, other, one, other]] = (
        np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle),
    )  # fmt: skip
    return (vertices - about) @ rotation.T + about


# Each shape by hand: a deformation of the whole mesh that grows with `size`, 0 = neutral --------------

WHOLE = np.ones(len(NEUTRAL))
FRONT = front(NEUTRAL)
BEHIND = 1 - front(NEUTRAL, 3.0)
SIDEWAYS = np.abs(NEUTRAL[:, 0]) / 13.0
BODY = NEUTRAL[LANDMARKS[3]]
BLADE = NEUTRAL[LANDMARKS[1]]


def tip_segment_turned(degrees):
    """What lies before the blade turns about the blade's lateral axis; positive = up."""
    share = (NEUTRAL[:, 1] < BLADE[1])[:, None]
    return np.where(share, turned(NEUTRAL, 0, -degrees, BLADE), NEUTRAL)


def front_turned(degrees):
    """The front turns about the line from body to tip; positive = left edge down."""
    share = (NEUTRAL[:, 1] < 0.5 * (BLADE[1] + BODY[1]))[:, None]
    return np.where(share, turned(NEUTRAL, 1, degrees, BLADE), NEUTRAL)


def sides_turned(degrees):
    """What lies outside the points halfway to the edges turns up about lines from front to back."""
    halfway = 6.8
    result = NEUTRAL.copy()
    for sign in (1, -1):
        outside = sign * NEUTRAL[:, 0] > halfway
        about = NEUTRAL * [0, 1, 1] + [sign * halfway, 0, 0]
        about[:, 2] = NEUTRAL[
            :, 2
        ]  # every vertex about a line at its own height: only the way outwards turns
        result[outside] = turned(NEUTRAL[outside], 1, -sign * degrees, about[outside])
    return result


DEFORMATIONS = {
    "tip_forward": lambda size: moved([0, -size, 0], FRONT),
    "tip_up": lambda size: moved([0, 0, size], FRONT),
    "tip_left": lambda size: moved([size, 0, 0], FRONT),
    "curl_up": lambda size: tip_segment_turned(3 * size),
    "body_up": lambda size: moved([0, 0, size], BEHIND),
    "body_front": lambda size: moved([0, -size, 0], BEHIND),
    "body_left": lambda size: moved([size, 0, 0], BEHIND),
    "wide": lambda size: NEUTRAL * [1 + 0.03 * size, 1, 1],
    "long": lambda size: NEUTRAL * [1, 1 + 0.03 * size, 1],
    "groove": lambda size: moved([0, 0, -0.3 * size], np.exp(-((NEUTRAL[:, 0] / 4) ** 2))),
    "arched": lambda size: moved([0, 0, 0.5 * size], np.clip(1 - SIDEWAYS, -1, 1)),
    "twist_left": lambda size: front_turned(2 * size),
    "lean_left": lambda size: turned(NEUTRAL, 1, 2 * size, BODY),
}
SIZES = np.array([-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize(("shape", "opposite"), OPPOSITES)
def test_a_shape_rises_with_its_motion_and_its_opposite_falls(shape, opposite):
    measured = [raw(DEFORMATIONS[shape](size)) for size in SIZES]
    rising = np.array([values[shape] for values in measured])
    assert (np.diff(rising) > 0).all(), rising
    assert rising[-1] > 0.25 * LEAST["mm"] and rising[0] < -0.25 * LEAST["mm"]
    assert rising[4] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose([values[opposite] for values in measured], -rising, atol=1e-9)


def test_every_shape_with_an_opposite_and_the_other_two_are_tested():
    named = {name for pair in OPPOSITES for name in pair} | {"roll", "out"}
    assert named == {shape.name for shape in SHAPES}


def test_the_size_is_in_millimetres_and_degrees():
    assert raw(moved([0, 0, 3.0], WHOLE))["tip_up"] == pytest.approx(3.0)
    assert raw(moved([0, 0, 3.0], WHOLE))["body_up"] == pytest.approx(3.0)
    assert raw(moved([0, -2.5, 0], WHOLE))["tip_forward"] == pytest.approx(2.5)
    assert raw(NEUTRAL * [1.1, 1, 1])["wide"] == pytest.approx(0.1 * axes(NEUTRAL)["width"], rel=0.01)
    assert raw(tip_segment_turned(12.0))["curl_up"] == pytest.approx(12.0, abs=0.1)
    assert raw(turned(NEUTRAL, 1, 10.0, BODY))["lean_left"] == pytest.approx(10.0, abs=0.1)


def test_roll_rises_as_both_sides_turn_up_and_not_as_they_turn_down():
    measured = np.array([raw(sides_turned(degrees))["roll"] for degrees in (-20, -10, 0, 10, 20)])
    assert (np.diff(measured) > 5).all()
    assert measured[2] == pytest.approx(0, abs=1e-9)


def test_out_is_how_far_the_tip_is_before_the_incisors_whatever_is_neutral():
    for ahead in (-3.0, 0.0, 2.0, 7.0):
        shift = -(NEUTRAL[LANDMARKS[0], 1] + ahead)
        assert raw(moved([0, shift, 0], WHOLE))["out"] == pytest.approx(ahead)


def test_at_the_neutral_tongue_every_shape_is_0_and_every_direction_one_half():
    meter = ShapeMeter(MODEL)
    for speaker in (MODEL.speaker.mean, *MODEL.speaker.training):
        values = dict(zip(meter.names, meter.measure(speaker, MODEL.pose.mean), strict=True))
        for shape in SHAPES:
            # Of a speaker with a long tongue the tip may well reach the teeth.
            assert values[shape.name] == pytest.approx(0, abs=1e-9) or shape.name == "out"
        for k in range(MODEL.pose.size):
            assert values[f"pose_{k}"] == pytest.approx(0.5)


# Left and right, turned and shifted -------------------------------------------------------------------


def mirror_partners(vertices):
    """(V,) for each vertex the one at its mirror image: a symmetrical mesh has one for each."""
    partners = cKDTree(vertices).query(vertices * [-1, 1, 1])[1]
    assert (partners[partners] == np.arange(len(partners))).all()
    return partners


def test_a_mirrored_tongue_has_left_and_right_swapped_exactly_and_nothing_else():
    model = parametric_model()
    neutral, landmarks = model.mean_vertices(), landmark_vertices(model)
    partners = mirror_partners(neutral)
    random = np.random.default_rng(3)
    for _ in range(20):
        bent = neutral + sum(
            random.normal(size=3) * np.exp(-((neutral - random.uniform([-15, 5, -10], [15, 60, 5])) ** 2).sum(1) / 300)[:, None] * 4
            for _ in range(5)
        )  # fmt: skip
        mirrored = (bent * [-1, 1, 1])[partners]
        one, other = axes(bent, landmarks), axes(mirrored, landmarks)
        for name in one:
            sign = -1 if name in ("tip x", "body x", "lean", "twist") else 1
            assert other[name] == pytest.approx(sign * one[name], abs=1e-9), name
        assert abs(one["twist"]) > 0 and abs(one["tip x"]) > 0
    swapped = {shape.axis for shape in SHAPES if "left" in shape.name}
    assert swapped == {"tip x", "body x", "lean", "twist"}


@given(
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    st.floats(-3, 3),
    st.lists(st.floats(-50, 50), min_size=3, max_size=3),
)
@settings(max_examples=60, deadline=None)
def test_what_is_called_rigid_does_not_change_when_the_whole_tongue_turns_and_shifts(axis, angle, shift):
    axis = np.array(axis) + [0, 0, 1.5]
    a, b, c = axis / np.linalg.norm(axis)
    hat = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    rotation = np.eye(3) + np.sin(angle) * hat + (1 - np.cos(angle)) * hat @ hat
    bent = DEFORMATIONS["groove"](2.0) + front_turned(5.0) - NEUTRAL
    before, after = axes(bent), axes(bent @ rotation.T + shift)
    for one in AXES:
        if one.rigid:
            assert after[one.name] == pytest.approx(before[one.name], abs=1e-8), one.name


def test_what_is_not_called_rigid_is_a_place_or_an_angle_in_the_heads_frame():
    shifted = axes(NEUTRAL + [1.0, -2.0, 3.0])
    before = axes(NEUTRAL)
    changes = {name: shifted[name] - before[name] for name in before}
    expected = {"tip x": 1, "tip y": 2, "tip z": 3, "body x": 1, "body y": 2, "body z": 3, "out": 2}
    for name, change in changes.items():
        assert change == pytest.approx(expected.get(name, 0.0), abs=1e-9), name
    assert {axis.name for axis in AXES if not axis.rigid} == {*expected, "lean"}


# The meter --------------------------------------------------------------------------------------------

METER = ShapeMeter(MODEL)
WEIGHTS = st.lists(st.floats(-5, 5), min_size=4, max_size=4)


@given(WEIGHTS, st.lists(st.floats(-3, 3), min_size=5, max_size=5))
@settings(max_examples=200, deadline=None)
def test_no_value_ever_leaves_0_to_1_or_is_nan(pose, speaker):
    values = METER.measure(MODEL.speaker.raw(speaker), MODEL.pose.raw(pose))
    assert values.shape == (len(METER.names),)
    assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1


def test_landmarks_on_top_of_each_other_make_no_nan():
    assert np.isfinite(axes_of([[0.0, 0.0, 0.0]] * len(LANDMARKS))).all()


def test_the_meter_sees_what_the_mesh_shows():
    meter = ShapeMeter(MODEL)
    for speaker, pose in zip(MODEL.speaker.training, MODEL.pose.training):
        before = axes(MODEL.vertices(speaker, MODEL.pose.mean)) | {"out": 0.0}
        now = axes(MODEL.vertices(speaker, pose))
        expected = [shape.sign * (now[shape.axis] - before[shape.axis]) for shape in SHAPES]
        np.testing.assert_allclose(meter.raw(speaker, pose), [*expected, *pose], atol=1e-9)


def test_a_new_speaker_is_noticed_and_the_old_one_comes_back_the_same():
    meter = ShapeMeter(MODEL)
    first, second = MODEL.speaker.training[:2]
    pose = MODEL.pose.training[0]
    before = meter.measure(first, pose)
    assert not np.array_equal(meter.measure(second, pose), before)
    np.testing.assert_array_equal(meter.measure(first, pose), before)
    expected = meter.measure(second, pose)
    free, fresh = first.copy(), ShapeMeter(MODEL)
    fresh.measure(free, pose)
    free[:] = second  # the tracker writes over one array
    np.testing.assert_array_equal(fresh.measure(free, pose), expected)


def test_consonants_and_vowels_of_the_synthetic_speakers_show_what_phonetics_says():
    meter = ShapeMeter(MODEL)
    of = {
        phone: dict(zip(meter.names, meter.raw(MODEL.speaker.mean, pose), strict=True))
        for phone, pose in zip(MODEL.pose.names, MODEL.pose.training, strict=True)
    }
    assert of["i"]["body_up"] > 0 > of["a"]["body_up"]
    assert of["i"]["body_front"] > 0 > of["u"]["body_front"]
    assert of["s"]["groove"] == max(found["groove"] for found in of.values()) or of["ʃ"]["groove"] > 0
    assert of["s"]["tip_up"] > 0 > of["ɑ"]["tip_up"]
    assert of["ɔ"]["tip_back"] > 2


def test_without_a_speakers_ranges_1_is_the_strongest_within_three_sigma():
    meter = ShapeMeter(MODEL)
    random = np.random.default_rng(4)
    box = random.choice([-3.0, 3.0], size=(200, 4))
    values = np.array([meter.raw(MODEL.speaker.mean, MODEL.pose.raw(corner)) for corner in box])
    for column, shape in enumerate(SHAPES):
        low, high = meter.ranges[shape.name]
        unit = next(axis.unit for axis in AXES if axis.name == shape.axis)
        assert low == 0.0
        if shape.axis in ("tip x", "tip y", "tip z", "body x", "body y", "body z"):  # linear: exact
            assert high == pytest.approx(max(values[:, column].max(), LEAST[unit]))
        else:
            assert high >= LEAST[unit]


def test_what_a_model_cannot_do_stays_near_0():
    """The synthetic speakers speak nearly symmetrically: their tip hardly goes to a side."""
    meter = ShapeMeter(MODEL)
    column = meter.names.index("tip_left")
    for pose in MODEL.pose.training:
        assert meter.measure(MODEL.speaker.mean, pose)[column] < 0.35


def test_the_pose_directions_are_rebased_between_their_published_ranges():
    meter = ShapeMeter(MODEL, {"pose_1": (-0.5, 1.5)})
    pose = MODEL.pose.training[3]
    first = len(SHAPES)
    np.testing.assert_allclose(meter.measure(MODEL.speaker.mean, pose)[first:], meter.rebased.to_unit(pose))
    assert (meter.rebased.low[1], meter.rebased.high[1]) == (-0.5, 1.5)
    assert meter.names[first:] == ("pose_0", "pose_1", "pose_2", "pose_3")


@pytest.mark.parametrize("directions", [1, 3])
def test_a_model_may_have_any_number_of_directions(directions):
    model = MODEL.truncated(2, directions)
    meter = ShapeMeter(model)
    assert len(meter.measure(model.speaker.mean, model.pose.mean)) == len(SHAPES) + directions
    assert meter.names == shape_names(directions)


def test_a_range_stretches_and_shifts_its_shape_alone():
    plain, ranged = ShapeMeter(MODEL), ShapeMeter(MODEL, {"tip_up": (1.0, 3.0)})
    pose = MODEL.pose.raw([0.4, 0, 0.3, 0.2])
    column = plain.names.index("tip_up")
    before, after = (meter.measure(MODEL.speaker.mean, pose) for meter in (plain, ranged))
    height = plain.raw(MODEL.speaker.mean, pose)[column]
    assert after[column] == pytest.approx(np.clip((height - 1) / 2, 0, 1))
    np.testing.assert_array_equal(np.delete(before, column), np.delete(after, column))


@pytest.mark.parametrize(
    ("ranges", "sentence"),
    [
        (
            {"tip_upp": (0.0, 1.0)},
            r"\[shapes\] tip_upp: there is no such shape; expected some of tip_forward",
        ),
        ({"pose_4": (0.0, 1.0)}, r"pose_4: there is no such shape"),
        ({"tip_up": (1.0, 1.0)}, r"tip_up = \[1, 1\]: expected the value for 0 and a larger one for 1"),
        ({"tip_up": (0.0, float("nan"))}, "expected the value for 0"),
    ],
)
def test_a_range_that_is_none_is_named(ranges, sentence):
    with pytest.raises(InputError, match=sentence):
        ShapeMeter(MODEL, ranges)


# Landmarks --------------------------------------------------------------------------------------------


def test_landmarks_are_found_without_marks_where_the_marks_have_them():
    bare = replace(MODEL, marks=SurfaceMarks())
    found, marked = NEUTRAL[landmark_vertices(bare)], NEUTRAL[LANDMARKS]
    assert np.linalg.norm(found - marked, axis=1).max() < 5.0
    assert LANDMARKS[0] == MODEL.marks.landmarks["Tip"]


def test_landmarks_lie_where_their_names_say():
    tip, *middles = NEUTRAL[LANDMARKS[: 1 + len(STATIONS)]]
    assert (np.diff([tip[1], *(point[1] for point in middles)]) > 3).all()  # from front to back
    np.testing.assert_allclose([point[0] for point in middles], 0, atol=0.5)
    left_half, right_half, left_edge, right_edge = NEUTRAL[LANDMARKS[1 + len(STATIONS) :]].reshape(4, 3, 3)
    assert (right_edge[:, 0] < right_half[:, 0]).all() and (right_half[:, 0] < -3).all()
    assert (left_edge[:, 0] > left_half[:, 0]).all() and (left_half[:, 0] > 3).all()
    np.testing.assert_allclose(left_edge * [-1, 1, 1], right_edge, atol=0.3)


def test_a_model_without_sides_is_refused_with_its_name(small_model):
    middle = replace(small_model.at(range(20)), marks=SurfaceMarks(midsagittal=tuple(range(20))))
    with pytest.raises(InputError, match="'random test model' has no surface to the left of its vertex"):
        ShapeMeter(middle)
    short = replace(small_model, marks=SurfaceMarks(midsagittal=(0, 1, 2)))
    with pytest.raises(InputError, match="3 mid-sagittal vertices: too few"):
        ShapeMeter(short)


def test_any_model_with_sides_can_be_measured(small_model):
    meter = ShapeMeter(small_model)
    for pose in small_model.pose.training:
        assert np.isfinite(meter.measure(small_model.speaker.mean, pose)).all()


# A speaker's ranges -----------------------------------------------------------------------------------


def speech(frames=400, scale=0.7, seed=9):
    """Raw weights (frames, K) of a speaker who uses part of the box, not around its middle."""
    random = np.random.default_rng(seed)
    return MODEL.pose.raw(random.normal(size=(frames, 4)) * scale + [0.5, 0, -0.4, 0.2])


def own_ranges(weights):
    return speaker_ranges(MODEL, np.tile(MODEL.speaker.mean, (len(weights), 1)), weights)


def test_with_a_speakers_ranges_half_the_frames_show_one_of_two_opposites_and_few_reach_1():
    weights = speech()
    meter = ShapeMeter(MODEL, own_ranges(weights))
    values = np.array([meter.measure(MODEL.speaker.mean, pose) for pose in weights])
    for shape in ("tip_up", "tip_down", "tip_forward", "body_up", "curl_up"):
        column = values[:, meter.names.index(shape)]
        assert 0.4 < (column > 0).mean() < 0.6
        assert 0.005 < (column == 1).mean() < 0.04
    up, down = values[:, meter.names.index("tip_up")], values[:, meter.names.index("tip_down")]
    assert (np.minimum(up, down) < 1e-3).all()


def test_a_few_wrong_frames_do_not_set_the_scale():
    weights = speech()
    wild = np.concatenate([weights, np.tile(MODEL.pose.raw([5.0, 5, 5, 5]), (3, 1))])
    before, after = own_ranges(weights), own_ranges(wild)
    for shape in SHAPES:
        assert after[shape.name][1] == pytest.approx(before[shape.name][1], rel=0.15, abs=0.3)


def test_no_pose_of_the_calibration_is_cut_off_in_the_pose_directions():
    weights = speech()
    meter = ShapeMeter(MODEL, own_ranges(weights))
    unit = np.array([meter.measure(MODEL.speaker.mean, pose) for pose in weights])[:, len(SHAPES) :]
    np.testing.assert_allclose(meter.rebased.to_raw(unit), weights, atol=1e-12)


def test_every_frame_is_measured_against_its_own_speaker():
    weights = speech(60)
    changing = np.tile(MODEL.speaker.training, (6, 1))[:60]
    assert speaker_ranges(MODEL, changing, weights)["tip_up"] != own_ranges(weights)["tip_up"]


def test_no_range_is_narrower_than_noise_and_a_still_weight_keeps_its_default():
    still = np.tile(MODEL.pose.mean, (60, 1))
    ranges = own_ranges(still)
    defaults = default_ranges(MODEL)
    for shape in SHAPES:
        unit = next(axis.unit for axis in AXES if axis.name == shape.axis)
        assert ranges[shape.name][1] - ranges[shape.name][0] >= LEAST[unit] - 1e-3
    assert ranges["pose_2"] == defaults["pose_2"]
    assert ranges["out"] == defaults["out"]  # a tongue that stayed inside says nothing of how far it can go


def test_too_few_frames_are_no_calibration():
    with pytest.raises(InputError, match="49 tracked frames are too few"):
        own_ranges(speech(49))


# In the session, and as a command ---------------------------------------------------------------------


def test_ranges_in_a_session_are_read_back_the_same():
    ranges = own_ranges(speech())
    session = parse_session("[shapes]\n", "s.toml")
    assert session.shape_ranges == {}
    text = session_toml(replace(session, shape_ranges=ranges))
    assert parse_session(text, "s.toml").shape_ranges == ranges
    assert "tip_up = [" in text
    ShapeMeter(MODEL, parse_session(text, "s.toml").shape_ranges)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("tip_up = 3", r"s.toml: \[shapes\] tip_up: expected finite numbers in the shape \(2,\)"),
        ("tip_up = [0, 1, 2]", "expected finite numbers in the shape"),
        ("tip_up = [0, nan]", "expected finite numbers"),
        ('tip_up = ["a", "b"]', "expected numbers only"),
        ("tip_up = [2, 2]", r"tip_up = \[2, 2\]: expected the value for 0 and a larger one for 1"),
    ],
)
def test_a_wrong_range_in_a_session_is_named(line, sentence):
    with pytest.raises(InputError, match=sentence):
        parse_session(f"[shapes]\n{line}\n", "s.toml")


@pytest.mark.parametrize(
    "text",
    [
        "",
        '[coils]\nT1 = "tongue_tip"',
        "shapes.tip_up = [1, 2]\n[energy]\nalpha = 2.0 # kept\n",
        "shapes = { tip_up = [1, 2] }\n",
        "[shapes]\ntip_down = [0, 1]\n[energy]\nalpha = 2.0 # kept\n",
        "[energy]\r\nalpha = 2.0 # kept\r\n",
    ],
)
def test_however_a_session_is_written_its_ranges_are_replaced_and_the_rest_is_kept(text):
    ranges = {"tip_up": (0.5, 2.0), "pose_0": (-0.123456789, 1e-7)}
    written = with_shape_ranges(text, ranges)
    again = parse_session(written, "s.toml")
    assert again.shape_ranges == ranges
    assert again.energy == parse_session(text, "s.toml").energy
    assert again.coils == parse_session(text, "s.toml").coils
    assert ("# kept" in text) == ("# kept" in written)
    assert with_shape_ranges(written, ranges) == written


ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    """The demo's recording, tracked."""
    folder = tmp_path_factory.mktemp("shapes")
    demo, session = ROOT / "recordings" / "demo.csv", ROOT / "recordings" / "demo.session.toml"
    assert main(["track", str(demo), "--session", str(session), "--out", str(folder / "poses.npz")]) == 0
    return folder / "poses.npz"


def test_the_command_writes_a_speakers_ranges_into_the_session_and_leaves_the_rest(poses, tmp_path, capsys):
    session = tmp_path / "s.toml"
    text = (ROOT / "recordings" / "demo.session.toml").read_text(encoding="utf-8")
    session.write_text(text + "\n# said by hand\n", encoding="utf-8")
    assert main(["shapes", str(poses), "--session", str(session)]) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in shape_names(4))
    written = session.read_text(encoding="utf-8")
    assert "# said by hand" in written and "channel = role" in written
    first = load_session(session)
    meter = ShapeMeter(MODEL, first.shape_ranges)
    assert meter.ranges == first.shape_ranges
    assert first.shape_ranges != default_ranges(MODEL)
    assert main(["shapes", str(poses), "--session", str(session), "--json"]) == 0
    assert session.read_text(encoding="utf-8") == written  # the same poses, the same ranges, one table
    report = json.loads(capsys.readouterr().out)
    assert {name: tuple(pair) for name, pair in report["ranges"].items()} == first.shape_ranges


def test_the_command_refuses_poses_and_sessions_that_do_not_belong_together(poses, tmp_path, capsys):
    session = tmp_path / "s.toml"
    session.write_text('model = "0123456789abcdef"\n', encoding="utf-8")
    assert main(["shapes", str(poses), "--session", str(session)]) == 2
    assert "it belongs to the model [0123456789abcdef]" in capsys.readouterr().err
    assert main(["shapes", str(poses), "--session", str(tmp_path / "none.toml")]) == 2
    assert "there is no such session file" in capsys.readouterr().err
    assert main(["shapes", str(tmp_path / "none.csv")]) == 2
    assert "there is no such poses file" in capsys.readouterr().err
