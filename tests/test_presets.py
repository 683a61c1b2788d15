"""Presets: complete vocabularies, honest mixtures, files that are checked."""

import re
from pathlib import Path

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.session import parse_session
from tonguetrack.tracker.streams.presets import FORMAT, load_preset, parse_preset, preset_names
from tonguetrack.tracker.streams.shapes import AXES, SHAPES, ShapeMeter, shape_names

NAMES = shape_names(4)


def words(text):
    return set(text.split())


# The names that a tongue can mean, as the receivers publish them.
UNIFIED = words(
    "TongueOut TongueUp TongueDown TongueRight TongueLeft TongueRoll TongueBendDown TongueCurlUp TongueSquish "
    "TongueFlat TongueTwistRight TongueTwistLeft TongueX TongueY TongueArchY TongueShape"
)
A2F = words(
    "tongueTipUp tongueTipDown tongueTipLeft tongueTipRight tongueRollUp tongueRollDown tongueRollLeft "
    "tongueRollRight tongueUp tongueDown tongueLeft tongueRight tongueIn tongueStretch tongueWide tongueNarrow"
)
METAHUMAN = {
    f"CTRL_expressions_tongue{name}"
    for name in words(
        "Up Down Left Right In Out Wide Narrow Thin Thick Press Roll RollUp RollDown RollLeft RollRight TipUp TipDown "
        "TipLeft TipRight TwistLeft TwistRight BendUp BendDown"
    )
}
VOCABULARIES = {"unified": UNIFIED, "arkit": {"tongueOut"}, "a2f16": A2F, "metahuman24": METAHUMAN}


def mixed(preset, **shapes):
    mixer = load_preset(preset).mixer(NAMES)
    values = mixer([shapes.get(name, 0.0) for name in NAMES])
    return dict(zip(mixer.names, values, strict=True))


def test_the_package_brings_these():
    assert preset_names() == ("a2f16", "arkit", "metahuman24", "own", "unified")


@pytest.mark.parametrize("name", VOCABULARIES)
def test_every_name_of_a_vocabulary_is_driven_or_listed_as_not_driven(name):
    preset = load_preset(name)
    driven = {target.name for target in preset.targets}
    assert driven | set(preset.undriven) == VOCABULARIES[name]
    assert not driven & set(preset.undriven)
    assert all(len(reason) > 20 for reason in preset.undriven.values())
    assert preset.title and preset.source.startswith("https://")


@pytest.mark.parametrize("name", preset_names())
def test_every_shape_that_a_preset_needs_exists_and_nothing_leaves_its_range(name):
    mixer = load_preset(name).mixer(NAMES)
    random = np.random.default_rng(1)
    for shapes in (*random.uniform(size=(50, len(NAMES))), np.zeros(len(NAMES)), np.ones(len(NAMES))):
        values = mixer(shapes)
        assert np.isfinite(values).all() and (values >= mixer.low).all() and (values <= 1).all()


@pytest.mark.parametrize("name", VOCABULARIES)
def test_every_target_follows_some_shape(name):
    mixer = load_preset(name).mixer(NAMES)
    reached = np.array([mixer(row) for row in np.eye(len(NAMES))])
    assert (np.abs(reached).max(axis=0) >= 0.5).all()
    assert (np.abs(mixer(np.zeros(len(NAMES)))) == 0).all()


def test_our_own_preset_is_every_shape_as_it_is_whatever_the_number_of_directions():
    for names in (shape_names(1), NAMES, shape_names(20)):
        mixer = load_preset("own").mixer(names)
        values = np.linspace(0, 1, len(names))
        assert mixer.names == names
        np.testing.assert_array_equal(mixer(values), values)


def test_signed_axes_are_right_minus_left_up_minus_down_curl_minus_bend_flat_minus_squish():
    assert mixed("unified", tip_right=0.7)["TongueX"] == pytest.approx(0.7)
    assert mixed("unified", tip_left=0.7)["TongueX"] == pytest.approx(-0.7)
    assert mixed("unified", tip_up=0.2)["TongueY"] == pytest.approx(0.2)
    assert mixed("unified", tip_down=0.2)["TongueY"] == pytest.approx(-0.2)
    assert mixed("unified", curl_up=0.4)["TongueArchY"] == pytest.approx(0.4)
    assert mixed("unified", bend_down=0.4)["TongueArchY"] == pytest.approx(-0.4)
    assert mixed("unified", flat=0.9)["TongueShape"] == pytest.approx(0.9)
    squished = mixed("unified", narrow=1.0, arched=1.0)
    assert squished["TongueSquish"] == 1.0 and squished["TongueShape"] == -1.0


@pytest.mark.parametrize("name", VOCABULARIES)
def test_left_is_left_and_right_is_right(name):
    mixer = load_preset(name).mixer(NAMES)
    swapped = np.array(
        [
            NAMES.index(shape.replace("_left", "_#").replace("_right", "_left").replace("_#", "_right"))
            for shape in NAMES
        ]
    )
    shapes = np.random.default_rng(2).uniform(size=len(NAMES))
    one = dict(zip(mixer.names, mixer(shapes), strict=True))
    other = dict(zip(mixer.names, mixer(shapes[swapped]), strict=True))
    for target, value in one.items():
        twin = target.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
        assert other[twin] == pytest.approx(-value if target == "TongueX" else value)


def test_a_real_pose_goes_all_the_way_through():
    model = bundled_model()
    meter = ShapeMeter(model)
    mixer = load_preset("unified").mixer(meter.names)
    pose = dict(zip(model.pose.names, model.pose.training, strict=True))
    s, a = (
        dict(zip(mixer.names, mixer(meter.measure(model.speaker.mean, pose[phone])), strict=True))
        for phone in "sa"
    )
    assert s["TongueBendDown"] > 0 == a["TongueBendDown"]
    assert s["TongueY"] > 0 > a["TongueY"]


def test_a_preset_may_be_a_file_of_ones_own(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(
        f'format = "{FORMAT}"\n[targets]\nMyTongue = {{ tip_up = 2.0, out = -1 }}\n', encoding="utf-8"
    )
    preset = load_preset(str(file))
    assert preset.name == "mine"
    mixer = preset.mixer(NAMES)
    assert mixer([1.0 if name == "out" else 0.0 for name in NAMES]) == [0.0]
    assert mixer([0.3 if name == "tip_up" else 0.0 for name in NAMES]) == [0.6]


HEAD = f'format = "{FORMAT}"\n'


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[targets", "not readable TOML"),
        ("a = " + "[" * 50_000, "not readable TOML|too long"),
        ("a" + ".b" * 5000 + " = 1", "too long"),
        ('[targets]\na = "out"', "not a preset: expected the line format"),
        (HEAD + "targetz = 1", "the key 'targetz' is unknown; expected every_shape, format"),
        (HEAD, "either every_shape = true or some"),
        (HEAD + 'every_shape = true\n[targets]\na = "out"', "either every_shape = true or some"),
        (HEAD + 'every_shape = "yes"', "expected true or false"),
        (HEAD + "targets = 3", r"'targets' should be a table, \[targets\]"),
        (HEAD + "title = 3\nevery_shape = true", "title = 3: expected text"),
        (HEAD + "[targets]\na = 3", "a = 3: expected the name of a shape"),
        (HEAD + "[targets]\na = {}", "expected the name of a shape"),
        (HEAD + '[targets]\na = { out = "1" }', "a, out = '1': expected a weight"),
        (HEAD + "[targets]\na = { out = 0 }", "expected a weight, not 0"),
        (HEAD + "[targets]\na = { out = nan }", "expected a weight"),
        (HEAD + "[targets]\na = { out = 1e300 }", "expected a weight"),
        (HEAD + "[targets]\na = { out = true }", "expected a weight"),
        (HEAD + '[targets]\na = "out"\n[signed]\na = "out"', "'a' is given twice"),
        (HEAD + '[targets]\na = "out"\n[undriven]\na = "no"', "'a' is given twice"),
        (HEAD + '[targets]\n"" = "out"', "is empty"),
        (HEAD + '[targets]\n"a\\u0000b" = "out"', "printable"),
        (HEAD + f'[targets]\n{"a" * 101} = "out"', "100 printable"),
        (
            HEAD + "[targets]\n" + "".join(f'a{k} = "out"\n' for k in range(501)),
            "501 names; expected 500 at most",
        ),
    ],
)
def test_a_file_that_is_no_preset_is_refused_in_one_sentence(text, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        parse_preset(text, "mine")
    assert len(str(caught.value)) < 400 or "TOML" in str(caught.value)


def test_a_shape_that_does_not_exist_is_named_with_those_that_do():
    preset = parse_preset(HEAD + '[targets]\nJaw = "jaw_open"', "mine")
    with pytest.raises(InputError, match="preset mine: Jaw is made of the shape 'jaw_open'.*tip_forward"):
        preset.mixer(NAMES)


def test_an_unknown_preset_and_a_missing_or_damaged_file_are_named(tmp_path):
    with pytest.raises(
        InputError, match="there is no such preset; expected a2f16, arkit, metahuman24, own, unified"
    ):
        load_preset("vrm")
    with pytest.raises(InputError, match="there is no such preset file"):
        load_preset(str(tmp_path / "none.toml"))
    with pytest.raises(InputError, match="there is no such preset"):
        load_preset("../presets/own")
    file = tmp_path / "x.toml"
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="x.toml: this is not readable TOML"):
        load_preset(str(file))
    file.write_bytes(b"#" * 300_000)
    with pytest.raises(InputError, match="300000 bytes are too many"):
        load_preset(str(file))


def test_every_shape_is_used_by_some_preset_or_is_ours_alone():
    used = {
        shape for name in VOCABULARIES for target in load_preset(name).targets for shape, _ in target.terms
    }
    assert {shape.name for shape in SHAPES} - used == {
        "tip_forward",
        "body_front",
        "short",
        "groove",
        "ridge",
    }


# The page about them ----------------------------------------------------------------------------------

PAGE = Path(__file__).parents[1] / "docs" / "shapes.md"


def test_the_page_has_a_row_for_every_shape_and_for_every_name_of_a_preset():
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    units = {axis.name: axis for axis in AXES}
    for shape in SHAPES:
        axis = units[shape.axis]
        assert (
            f"| `{shape.name}` | {axis.unit} | {'yes' if axis.rigid else ''} | {shape.meaning} |" in rows
        ), shape
    for name in VOCABULARIES:
        preset = load_preset(name)
        for target in preset.targets:
            found = [row for row in rows if row.startswith(f"| `{target.name}` |")]
            assert len(found) == 1, target.name
            assert re.findall(r"`([a-z_]+)`", found[0].split("|")[2]) == [shape for shape, _ in target.terms]
            assert ("-1..1" in found[0]) == (target.low < 0)
        for missing, reason in preset.undriven.items():
            assert f"| `{missing}` | not sent: {reason} | |" in rows


def test_the_pages_examples_are_a_session_and_a_preset():
    ranges, preset = re.findall(
        r"^```toml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    ShapeMeter(bundled_model(), parse_session(ranges, "page").shape_ranges)
    parse_preset(preset, "page").mixer(NAMES)
