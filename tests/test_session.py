"""The session file, the coil map, and how both meet a recording."""

import itertools

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers.frames import FrameOfReference, Recording
from tonguetrack.tracker.coilmap import guess_coil_map
from tonguetrack.tracker.session import Alignment, Energy, Session, axis_mapping, load_session, session_toml
from tonguetrack.tracker.setup import complete_setup, suggested_axes

FULL = """
model = "0123456789abcdef"
[coils]
T1 = "tongue_tip"
T3 = "tongue_dorsum"
nose = "head_nose"
[alignment]
axes = ["y", "-x", "z"]
translation_mm = [1, 2.5, -3]
midsagittal = true
[correspondences]
tongue_tip = 3
tongue_dorsum = 12
[speaker]
weights = [0.1, 0.2, 0.3, 0.4, 0.5]
source = "by hand"
[energy]
beta_pose = 1
box = 2
"""


def recording_of(coils, positions, **more):
    positions = np.asarray(positions, dtype=float)
    return Recording(
        tuple(coils), positions, np.arange(len(positions)) / 100.0, 100.0, "test", source="take", **more
    )


@pytest.fixture()
def tongue(small_model):
    """A recording whose coils lie on the model's mean shape, in the order dorsum, tip, nose."""
    shape = small_model.mean_vertices()
    frame = np.stack([shape[12], shape[3], [0.0, -20.0, 60.0]])
    return recording_of(["T3", "T1", "nose"], np.repeat(frame[None], 30, axis=0))


def write(tmp_path, text):
    (tmp_path / "s.toml").write_text(text, encoding="utf-8")
    return tmp_path / "s.toml"


def test_a_speaker_beyond_the_box_is_warned_of(tongue, small_model):
    mean, sigma = small_model.speaker.mean, small_model.speaker.sigma
    for away, warned in ((4.9, False), (40.0, True)):
        weights = mean + np.eye(small_model.speaker.size)[1] * away * sigma
        session = Session(speaker_weights=weights, model_fingerprint=small_model.fingerprint, source="s.toml")
        told = [one for one in complete_setup(tongue, small_model, session).decisions if "warning" in one]
        assert len(told) == warned
    assert "weight 2 of the session's [speaker] is 40.0 sigma" in told[0] and "box of 5" in told[0]


def test_everything_a_session_states_is_read(tmp_path):
    session = load_session(write(tmp_path, FULL))
    assert session.coils == {"T1": "tongue_tip", "T3": "tongue_dorsum", "nose": "head_nose"}
    np.testing.assert_array_equal(session.alignment.rotation, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(session.alignment.translation_mm, [1, 2.5, -3])
    assert session.alignment.midsagittal
    assert session.correspondences == {"tongue_tip": 3, "tongue_dorsum": 12}
    np.testing.assert_array_equal(session.speaker_weights, [0.1, 0.2, 0.3, 0.4, 0.5])
    assert session.energy == Energy(beta_pose=1.0, box=2.0)


def test_what_is_written_is_read_back_unchanged(tmp_path):
    session = load_session(write(tmp_path, FULL))
    again = load_session(write(tmp_path, session_toml(session)))
    for name in ("coils", "correspondences", "energy", "speaker_source", "model_fingerprint"):
        assert getattr(again, name) == getattr(session, name)
    np.testing.assert_array_equal(again.alignment.rotation, session.alignment.rotation)
    np.testing.assert_array_equal(again.speaker_weights, session.speaker_weights)


def test_odd_channel_names_survive_the_file(tmp_path):
    odd = [
        "a.b",
        'say "tip"',
        "Zunge ə",
        " led by a space",
        "it's",
        "#1",
        "[x]",
        "a = b",
        "tab\there",
        "\\",
        "\u2028",
        "",
    ]
    roles = ["tongue_tip", *(f"tongue_own_{number}" for number in range(1, len(odd)))]
    session = Session(coils=dict(zip(odd, roles, strict=True)), speaker_source='of "x"\nand ə')
    again = load_session(write(tmp_path, session_toml(session)))
    assert again.coils == session.coils
    assert list(again.coils) == odd
    assert again.speaker_weights is None
    assert again.alignment.is_identity


def test_an_empty_session_states_nothing(tmp_path):
    session = load_session(write(tmp_path, ""))
    assert not session.coils
    assert session.alignment.is_identity
    assert session.energy == Energy(1, 5, 5, 5, 5, 5)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[coil]", "the table or key 'coil' is unknown; expected alignment, coils"),
        ("[coils]\nT1 = 3", r"\[coils\] T1 = 3: expected text"),
        ('[coils]\nT1 = "tip"', "channel 'T1' has the role 'tip', which is none of tongue_tip"),
        ('[coils]\na = "tongue_tip"\nb = "tongue_tip"', "the role 'tongue_tip' is given to 'a' and to 'b'"),
        ('[coils]\na = "jaw"', "no channel has a tongue role"),
        ("[alignment]\nscale = 2", r"\[alignment\] has the unknown key 'scale'"),
        ('[alignment]\naxes = ["x", "x", "z"]', "expected three of x, y, z, each once"),
        ('[alignment]\naxes = ["--x", "y", "z"]', "expected three of x, y, z"),
        ("[alignment]\nrotation = [[2,0,0],[0,1,0],[0,0,1]]", "rotation is not orthonormal"),
        ("[alignment]\nrotation = [[1,0],[0,1]]", "expected finite numbers in the shape"),
        (
            '[alignment]\naxes = ["x","y","z"]\nrotation = [[1,0,0],[0,1,0],[0,0,1]]',
            "both 'axes' and 'rotation'",
        ),
        ("[alignment]\nmidsagittal = 1", "midsagittal = 1: expected true or false"),
        ("[correspondences]\ntongue_tip = 1.5", "expected a whole number, the index of a vertex"),
        ("[speaker]\nweights = ['a']", "expected numbers only"),
        ("[speaker]\nweights = [nan]", "expected finite numbers"),
        ("[energy]\nbeta = 3", r"\[energy\] has the unknown key 'beta'; expected alpha, beta_pose"),
        ("[speaker]\nweights = []", "expected finite numbers in one list"),
        ("[speaker]\nweights = [[0.1]]", "expected finite numbers in one list"),
        ("[speaker]\nweights = ['0.1']", "expected numbers only"),
        ("[speaker]\nweights = [true]", "expected numbers only"),
        (f"[speaker]\nweights = [{10**400}]", "expected numbers only"),
        ("[speaker]\nsource = 3", r"\[speaker\] source = 3: expected text"),
        (f"[energy]\nalpha = {10**400}", r"\[energy\] alpha: the number is too large"),
        ("[energy]\nalpha = 1e300", "expected a finite number, above 0, of at most 1e[+]12"),
        ("[energy]\nbox = 0", r"\[energy\] box = 0.0: expected a finite number, above 0"),
        ("[energy]\ngamma_pose = -1", "expected a finite number, 0 or more"),
        ("[energy]\nalpha = inf", "expected a finite number"),
        ("coils = 3", r"'coils' should be a table, \[coils\]"),
        ("[coils", "not readable TOML"),
        ("a = " + "[" * 50_000, "nested too deeply"),
    ],
)
def test_a_wrong_session_is_named_with_its_table_and_key(tmp_path, text, sentence):
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=sentence) as caught:
        load_session(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_an_alignment_moves_raw_coils_to_the_model_frame(small_model, tongue):
    from tonguetrack.tracker.preparation import Preparation

    angle = 0.3
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    preparation = Preparation(
        np.array([1, 0]), Alignment(rotation, np.array([1.0, 2.0, 3.0]), midsagittal=True)
    )
    moved = preparation.all_frames(tongue.positions)
    expected = tongue.positions[:, [1, 0]] @ rotation.T + [1, 2, 3]
    expected[..., 0] = 0
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    np.testing.assert_array_equal(preparation.frame(tongue.positions[5]), moved[5])


def test_a_coil_with_one_unusable_coordinate_is_missing_as_a_whole(tongue):
    from tonguetrack.tracker.preparation import Preparation

    raw = tongue.positions[:3].copy()
    raw[0, 1, 2] = np.nan
    raw[1, 1, 0] = np.inf
    prepared = Preparation(np.array([1, 0]), Alignment()).all_frames(raw)
    assert np.isnan(prepared[0, 0]).all()
    assert np.isnan(prepared[1, 0]).all()
    assert np.isfinite(prepared[2]).all()


def test_names_of_the_field_become_roles_and_distance_decides_what_tb_means():
    """TB is the body in one laboratory and the back in another; the coil further from the tip is the dorsum."""
    for behind, between in (("TB", "TD"), ("TD", "TB")):
        places = {"TT": [0, 5.0, 0], between: [0, 20.0, 5], behind: [0, 35.0, 3], "UL": [0, -5.0, 5]}
        take = recording_of(places, [list(places.values())])
        roles = guess_coil_map(take.coils, take.positions, "take").roles
        assert roles == {
            "TT": "tongue_tip",
            between: "tongue_blade",
            behind: "tongue_dorsum",
            "UL": "upper_lip",
        }


def test_tr_is_the_right_side_beside_tl_and_the_root_without():
    take = recording_of(["TT", "TB", "TR"], [[[0, 5.0, 0], [0, 20.0, 5], [0, 35.0, 3]]])
    assert guess_coil_map(take.coils, take.positions, "take").roles["TR"] == "tongue_dorsum"
    take = recording_of(["TT", "TB", "TR", "TL"], [[[0, 5.0, 0], [0, 20.0, 5], [-9, 20.0, 3], [9, 20.0, 3]]])
    roles = guess_coil_map(take.coils, take.positions, "take").roles
    assert roles == {"TT": "tongue_tip", "TB": "tongue_dorsum", "TL": "tongue_left", "TR": "tongue_right"}


def test_a_channel_without_data_gets_no_role():
    positions = np.array([[[0, 5.0, 0], [np.nan] * 3, [0, 30.0, 3]]])
    take = recording_of(["TT", "TB", "TD"], positions)
    assert guess_coil_map(take.coils, take.positions, "take").roles == {
        "TT": "tongue_tip",
        "TD": "tongue_dorsum",
    }


def test_names_that_say_nothing_are_asked_for():
    take = recording_of(["Ch1", "Ch2"], np.zeros((1, 2, 3)))
    with pytest.raises(
        InputError, match=r"names of the channels that have data \(Ch1, Ch2\) .* name them with --coils"
    ):
        guess_coil_map(take.coils, take.positions, "take")


def test_a_stated_session_is_followed_to_the_letter(tmp_path, small_model, tongue):
    text = FULL.replace('axes = ["y", "-x", "z"]', 'axes = ["x", "y", "z"]')
    session = load_session(write(tmp_path, text.replace("0123456789abcdef", small_model.fingerprint)))
    setup = complete_setup(tongue, small_model, session)
    assert setup.channels == ("T1", "T3")
    assert setup.roles == ("tongue_tip", "tongue_dorsum")
    assert setup.vertices == (3, 12)
    np.testing.assert_array_equal(setup.session.speaker_weights, [0.1, 0.2, 0.3, 0.4, 0.5])


def test_vertices_of_another_model_are_pointed_out_and_its_speaker_is_refused(small_model, tongue):
    """Vertices may still be right on a model of the same meshes; weights mean another anatomy."""
    vertices = {"tongue_tip": 3, "tongue_dorsum": 12}
    session = Session(correspondences=vertices, model_fingerprint="0123456789abcdef")
    told = complete_setup(tongue, small_model, session).decisions
    assert any("vertices were chosen on the model 0123456789abcdef" in decision for decision in told)
    session = Session(speaker_weights=np.zeros(5), model_fingerprint="0123456789abcdef")
    with pytest.raises(InputError, match="weights belong to the model 0123456789abcdef, not to"):
        complete_setup(tongue, small_model, session)


def test_coils_far_from_the_model_are_pointed_out(small_model, tongue):
    far = recording_of(tongue.coils, tongue.positions + 1000.0)
    told = " ".join(complete_setup(far, small_model, Session()).decisions)
    assert (
        "mm away from the model even at its best vertex; the recording is hardly in the model's frame" in told
    )
    assert "away from the model" not in " ".join(complete_setup(tongue, small_model, Session()).decisions)


def test_what_is_absent_is_estimated_and_said(small_model, tongue):
    setup = complete_setup(tongue, small_model, Session())
    told = " ".join(setup.decisions)
    for part in (
        "coils (channel names",
        "alignment (default): none",
        "correspondences (estimated): tongue_tip =",
    ):
        assert part in told
    assert setup.session.model_fingerprint == small_model.fingerprint
    assert set(setup.session.correspondences) == {"tongue_tip", "tongue_dorsum"}


def test_one_correspondence_may_be_fixed_by_hand_and_the_rest_estimated(small_model, tongue):
    setup = complete_setup(tongue, small_model, Session(correspondences={"tongue_tip": 7}))
    assert setup.vertices[setup.roles.index("tongue_tip")] == 7
    assert any("correspondences (session): tongue_tip = vertex 7" in decision for decision in setup.decisions)


@pytest.mark.parametrize(
    ("session", "sentence"),
    [
        (
            Session(coils={"T9": "tongue_tip"}),
            "names the channel 'T9', which take does not have; its channels are T3",
        ),
        (Session(speaker_weights=np.zeros(3)), "has 3 weights, but the model .* has 5 speaker modes"),
        (
            Session(correspondences={"tongue_tip": 60, "tongue_dorsum": 1}),
            "tongue_tip = 60, but the model .* 0 to 59",
        ),
        (
            Session(correspondences={"tongue_back": 1}),
            "names the role 'tongue_back', but the tracked coils are",
        ),
    ],
)
def test_a_session_that_contradicts_recording_or_model_is_refused(small_model, tongue, session, sentence):
    with pytest.raises(InputError, match=sentence):
        complete_setup(tongue, small_model, session)


@pytest.mark.parametrize(
    ("frame", "axes"),
    [
        (("front", "left", "up"), ("y", "-x", "z")),
        (("left", "back", "up"), ("x", "y", "z")),
        (("absent", "front", "up"), ("x", "-y", "z")),
        (("back", "up", "absent"), ("z", "x", "y")),
        (("unknown", "unknown", "unknown"), None),
    ],
)
def test_a_known_frame_suggests_its_axes(frame, axes):
    assert suggested_axes(FrameOfReference(*frame)) == axes


@pytest.mark.parametrize("frame", list(itertools.permutations(("left/right", "front/back", "up/down"))))
def test_a_right_handed_frame_is_turned_never_mirrored(frame):
    direction = {"left": [1, 0, 0], "back": [0, 1, 0], "up": [0, 0, 1]}
    direction |= {"right": [-1, 0, 0], "front": [0, -1, 0], "down": [0, 0, -1]}
    for axes in itertools.product(*(pair.split("/") for pair in frame)):
        in_model = np.array([direction[axis] for axis in axes]).T
        found = axis_mapping(suggested_axes(FrameOfReference(*axes)))
        np.testing.assert_array_equal(found, in_model)
        assert np.linalg.det(found) == pytest.approx(np.linalg.det(in_model))


def test_a_session_that_only_projects_still_gets_the_hint(small_model, tongue):
    foreign = recording_of(tongue.coils, tongue.positions, frame=FrameOfReference("front", "left", "up"))
    setup = complete_setup(foreign, small_model, Session(alignment=Alignment(midsagittal=True)))
    assert any("[alignment] needs axes" in decision for decision in setup.decisions)


def test_a_foreign_frame_is_hinted_at_but_never_turned_unasked(small_model, tongue):
    foreign = recording_of(tongue.coils, tongue.positions, frame=FrameOfReference("front", "left", "up"))
    setup = complete_setup(foreign, small_model, Session())
    assert setup.session.alignment.is_identity
    assert any('[alignment] needs axes = ["y", "-x", "z"]' in decision for decision in setup.decisions)
