"""From coils on a bite plate to the occlusal frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.drivers import FrameOfReference, open_recording
from tonguetrack.tracker.coilmap import ROLES
from tonguetrack.tracker.occlusal import BITE_ROLES, check_same_head, occlusal_frame
from tonguetrack.tracker.sagittal import handedness

UNKNOWN = FrameOfReference()
NORMPOS = FrameOfReference("front", "left", "up")
PLATE = {  # mm in the occlusal frame: x left, y back, z up
    "bite_front": (0.0, 0.0, 0.0),
    "bite_left": (22.0, 38.0, 0.0),
    "bite_right": (-22.0, 38.0, 0.0),
    "bite_back": (0.0, 38.0, 0.0),
}
HEAD = {"head_nose": (0.0, -14.0, 48.0), "head_left": (66.0, 88.0, 34.0), "head_right": (-66.0, 88.0, 34.0)}
THREE = ("bite_front", "bite_left", "bite_right")


def still(places: dict, roles, rotation=None, shift=(0.0, 0.0, 0.0), frames=300, noise=0.0, seed=1) -> dict:
    """role -> (frames, 3): coils at rest in a file whose frame is rotation @ occlusal + shift."""
    random = np.random.default_rng(seed)
    rotation = np.eye(3) if rotation is None else rotation
    return {
        role: np.asarray(places[role]) @ rotation.T + np.asarray(shift) + random.normal(scale=noise, size=(frames, 3))
        if noise
        else np.tile(np.asarray(places[role]) @ rotation.T + np.asarray(shift), (frames, 1))
        for role in roles
    }  # fmt: skip


def to_occlusal(found, point) -> np.ndarray:
    return found.rotation @ np.asarray(point) + found.translation


def test_every_role_on_the_plate_is_a_role_of_the_coil_map():
    assert set(BITE_ROLES) <= set(ROLES)


@settings(max_examples=40, deadline=None)
@given(
    roles=st.sampled_from([THREE, ("bite_front", "bite_back"), (*THREE, "bite_back")]),
    angles=st.tuples(*[st.floats(-180, 180)] * 3),
    shift=st.tuples(*[st.floats(-300, 300)] * 3),
)
def test_the_occlusal_frame_is_found_exactly_however_the_head_lies(roles, angles, shift):
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    found = occlusal_frame(
        still(PLATE, roles, turn, shift), UNKNOWN, "bp.pos", still(HEAD, HEAD, turn, shift)
    )
    assert np.allclose(found.rotation, turn.T, atol=1e-9)
    for point in [*PLATE.values(), *HEAD.values()]:
        assert np.allclose(to_occlusal(found, turn @ point + shift), point, atol=1e-9)
    assert handedness(found.rotation) == "right-handed"


def test_the_median_over_the_file_withstands_noise_outliers_gaps_and_the_plate_being_put_in():
    turn = Rotation.from_euler("zyx", [8, 3, -12], degrees=True).as_matrix()
    bite = still(PLATE, THREE, turn, (5.0, 60.0, -20.0), frames=1000, noise=0.3)
    random = np.random.default_rng(8)
    for path in bite.values():
        path[:200] += np.linspace(60.0, 0.0, 200)[:, None] * [0.0, -1.0, 0.3]  # being put in, as one plate
        path[random.random(1000) < 0.03] += random.normal(scale=40.0, size=3)
        path[random.random(1000) < 0.05] = np.nan
    found = occlusal_frame(bite, UNKNOWN, "bp.pos")
    moved = Rotation.from_matrix(found.rotation @ turn).magnitude()
    assert np.rad2deg(moved) < 0.3
    assert np.linalg.norm(to_occlusal(found, turn @ [0, 0, 0] + [5.0, 60.0, -20.0])) < 0.1


def test_the_numbers_are_those_of_the_plate():
    found = occlusal_frame(still(PLATE, PLATE), FrameOfReference("left", "back", "up"), "bp.pos")
    assert found.numbers["left_to_right_mm"] == pytest.approx(44.0)
    assert found.numbers["front_to_back_mm"] == pytest.approx(38.0)
    assert found.numbers["against_the_stated_axes_deg"] == pytest.approx(0.0, abs=1e-6)
    assert found.numbers["fourth_coil_off_the_plane_mm"] == pytest.approx(0.0, abs=1e-9)
    assert "bp.pos" in str(found) and "right-handed" in str(found)


def test_stated_left_handed_axes_give_a_mirroring_frame_and_it_is_told():
    mirror = np.diag([-1.0, 1.0, 1.0])
    found = occlusal_frame(
        still(PLATE, THREE, mirror),
        FrameOfReference("right", "back", "up"),
        "bp.pos",
        still(HEAD, HEAD, mirror),
    )
    assert np.allclose(found.rotation, mirror)
    assert "left-handed" in str(found)


def test_left_handed_axes_that_nobody_stated_are_noticed_by_the_nose():
    mirror = np.diag([-1.0, 1.0, 1.0])
    nose = still(HEAD, ["head_nose"], mirror)
    with pytest.raises(InputError, match=r"bp\.pos: head_nose is 48 mm below the bite plane; .* left-handed"):
        occlusal_frame(still(PLATE, THREE, mirror), UNKNOWN, "bp.pos", nose)


def test_unstated_axes_are_told():
    assert any("not stated" in note for note in occlusal_frame(still(PLATE, THREE), UNKNOWN, "bp.pos").notes)


def test_two_coils_take_left_from_whoever_knows_it():
    two = still(PLATE, ("bite_front", "bite_back"))
    for found in (
        occlusal_frame(two, UNKNOWN, "bp.pos", still(HEAD, HEAD)),
        occlusal_frame(two, UNKNOWN, "bp.pos", left=np.array([1.0, 0.1, 0.0])),
    ):
        assert np.allclose(found.rotation, np.eye(3), atol=1e-9)
    with pytest.raises(InputError, match=r"bp\.pos: bite_front and bite_back lie on one line"):
        occlusal_frame(two, UNKNOWN, "bp.pos")


# What cannot be -------------------------------------------------------------------------------------


def refused(words: str, bite, frame=UNKNOWN, head=None) -> None:
    with pytest.raises(InputError, match=words):
        occlusal_frame(bite, frame, "bp.pos", head)


def test_collinear_coils_are_no_plane():
    line = {**PLATE, "bite_front": (0.0, 36.0, 0.0)}
    refused(r"bp\.pos: the coils bite_front, bite_left and bite_right lie on one line", still(line, THREE))


def test_coils_that_move_against_each_other_are_on_no_plate():
    bite = still(PLATE, THREE, noise=0.2)
    bite["bite_left"][:, 0] += 6.0 * np.sin(np.linspace(0, 40, 300))
    refused(r"bp\.pos: bite_.* move against each other", bite)


def test_a_plate_that_was_not_held_still_is_refused():
    bite = still(PLATE, THREE)
    for path in bite.values():
        path += np.linspace(-40, 40, 300)[:, None] * [0.0, 1.0, 0.0]
    refused(r"bp\.pos: the bite plate stays within 3 mm of one place in only", bite)


def test_a_plate_far_from_this_head_belongs_to_someone_else():
    refused(
        r"bp\.pos: bite_front and head_\w+ are \d+\.\d mm apart, which in one head is between",
        still(PLATE, THREE, shift=(0.0, -400.0, 0.0)),
        head=still(HEAD, HEAD),
    )


def test_a_plate_of_impossible_size_is_in_other_units():
    metres = {role: np.asarray(place) * 0.1 for role, place in PLATE.items()}
    refused(r"bp\.pos: bite_left and bite_right are 4\.4 mm apart", still(metres, THREE))


def test_exchanged_sides_are_noticed_by_the_ears():
    bite = still(PLATE, THREE)
    bite["bite_left"], bite["bite_right"] = bite["bite_right"], bite["bite_left"]
    refused(r"bp\.pos: the bite plate's left does not agree with head_left", bite, head=still(HEAD, HEAD))


def test_exchanged_sides_are_noticed_by_the_stated_axes():
    bite = still(PLATE, THREE)
    bite["bite_left"], bite["bite_right"] = bite["bite_right"], bite["bite_left"]
    refused(r"bp\.pos: the bite plate is turned 180 degrees", bite, FrameOfReference("left", "back", "up"))


def test_axes_of_another_recording_are_noticed():
    refused(r"bp\.pos: the bite plate is turned 90 degrees against the axes", still(PLATE, THREE), NORMPOS)


def test_a_side_coil_named_as_the_front_one_is_noticed_by_the_head():
    mixed = {
        "bite_front": PLATE["bite_left"],
        "bite_left": PLATE["bite_front"],
        "bite_right": PLATE["bite_right"],
    }
    refused(r"bp\.pos: .* head_left and head_right", still(mixed, THREE), head=still(HEAD, HEAD))


def test_a_plate_askew_is_refused():
    bent = {**PLATE, "bite_left": (20.0, 10.0, 0.0), "bite_right": (-20.0, 60.0, 0.0)}
    refused(r"bp\.pos: bite_left to bite_right runs 51 degrees off a right angle", still(bent, THREE))


@pytest.mark.parametrize(
    "roles", [("bite_front",), ("bite_front", "bite_left"), ("bite_left", "bite_right"), ()]
)
def test_too_few_coils_are_asked_for(roles):
    refused(r"bp\.pos: a bite plane from .*; needed are bite_front with", still(PLATE, roles))


def test_a_role_that_is_not_on_a_plate_is_refused():
    refused("'jaw' is no role on a bite plate", {**still(PLATE, THREE), "jaw": np.zeros((300, 3))})


def test_coils_that_are_never_there_together_are_refused():
    bite = still(PLATE, THREE)
    bite["bite_left"][:150] = np.nan
    bite["bite_front"][150:] = np.nan
    refused("never there in the same frame", bite)


# The same head --------------------------------------------------------------------------------------


def test_references_of_one_head_agree_whatever_its_place():
    turn = Rotation.from_euler("xyz", [40, -20, 10], degrees=True).as_matrix()
    rest = {role: np.asarray(place) for role, place in HEAD.items()}
    moved = still(HEAD, HEAD, turn, (3.0, 2.0, 100.0), noise=0.3)
    assert check_same_head(moved, rest, "bp.pos", "speech.pos") < 0.3


def test_references_of_another_head_are_refused():
    rest = {role: np.asarray(place) for role, place in HEAD.items()}
    other = {role: 1.08 * np.asarray(place) for role, place in HEAD.items()}
    with pytest.raises(
        InputError, match=r"bp\.pos: head_\w+ and head_\w+ are .* in speech\.pos; .* different speakers"
    ):
        check_same_head(still(other, other), rest, "bp.pos", "speech.pos")


def references(reference_data, file: str, channels: dict, rate: float | None = None) -> dict:
    recording = open_recording(reference_data / "recordings" / file, rate_hz=rate)
    return {role: recording.positions[:, recording.coils.index(name)] for name, role in channels.items()}


TARDIS = {"Ch12": "head_left", "Ch13": "head_right", "Ch14": "head_nose"}


def test_two_real_files_of_one_speaker_are_of_one_head_and_those_of_two_are_not(reference_data):
    sweep = references(reference_data, "tardis/ema_palate/sf2_palate.txt", TARDIS, 250)
    speech = references(reference_data, "tardis/ema_original/sf2_0005.txt", TARDIS, 250)
    rest = {role: np.median(path, axis=0) for role, path in speech.items()}
    assert check_same_head(sweep, rest, "palate", "speech") < 1.0
    other = references(reference_data, "ag501_reidy/0021.pos", {"Ch1": "head_left", "Ch2": "head_right"})
    with pytest.raises(InputError, match="different speakers"):
        check_same_head(other, rest, "0021.pos", "sf2_0005.txt")


def test_tongue_coils_taken_for_a_bite_plate_are_refused(reference_data):
    names = {"TT": "bite_front", "JAWL": "bite_left", "TR": "bite_right"}
    bite = references(reference_data, "hprc/F01_B01_S01_R01_N.mat", names)
    refused("move against each other", bite, NORMPOS)
