"""Directions of a file's axes, and the mid-sagittal plane that coils show."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.drivers import FrameOfReference, open_recording
from tonguetrack.tracker.sagittal import directions, handedness, mid_sagittal_plane

MODEL = FrameOfReference("left", "back", "up")
LEFT = np.array([1.0, 0.0, 0.0])


def speech(frames: int = 400, seed: int = 1) -> np.ndarray:
    """(frames, 3, 3) three tongue coils that move in the plane x = 0, mm, model directions."""
    random = np.random.default_rng(seed)
    t = np.linspace(0.0, 6.0, frames)
    coils = np.zeros((frames, 3, 3))
    for coil, middle in enumerate([(14.0, -9.0), (32.0, -2.0), (50.0, -6.0)]):
        phase = random.uniform(0.0, 6.0, 4)
        coils[:, coil, 1] = middle[0] + 3.0 * np.sin(4 * t + phase[0]) + 1.5 * np.sin(9 * t + phase[1])
        coils[:, coil, 2] = middle[1] + 5.0 * np.sin(5 * t + phase[2]) + 2.0 * np.sin(11 * t + phase[3])
    return coils


def angle_deg(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


# Directions -----------------------------------------------------------------------------------------


def test_axes_as_the_models_are_taken_as_they_are():
    assert np.array_equal(directions(MODEL, "a file"), np.eye(3))


def test_the_axes_of_a_head_corrected_articulograph_are_turned_to_the_models():
    turned = directions(FrameOfReference("front", "left", "up"), "a file")
    front, left, up = np.eye(3)
    assert np.array_equal(turned @ left, [1, 0, 0])
    assert np.array_equal(turned @ front, [0, -1, 0])
    assert np.array_equal(turned @ up, [0, 0, 1])
    assert handedness(turned) == "right-handed"


def test_left_handed_axes_are_recognised():
    assert handedness(directions(FrameOfReference("right", "back", "up"), "a file")) == "left-handed"


def test_the_axis_that_two_dimensional_data_lack_stands_for_the_missing_direction():
    turned = directions(FrameOfReference("front", "up", "absent"), "a file")
    assert np.array_equal(turned @ [3.0, 5.0, 0.0], [0.0, -3.0, 5.0])


@pytest.mark.parametrize(
    "frame",
    [FrameOfReference(), FrameOfReference("left", "unknown", "up"), FrameOfReference("left", "right", "up")],
)
def test_axes_that_leave_a_direction_open_are_asked_for(frame):
    with pytest.raises(InputError, match=r"sweep\.pos: its axes are .* leaves open where .* is"):
        directions(frame, "sweep.pos")


# The plane ------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    yaw=st.floats(-20, 20), roll=st.floats(-20, 20), pitch=st.floats(-40, 40),
    shift=st.tuples(*[st.floats(-60, 60)] * 3),
)  # fmt: skip
def test_a_tilted_head_is_found_exactly_without_noise(yaw, roll, pitch, shift):
    turn = Rotation.from_euler("zyx", [yaw, roll, pitch], degrees=True).as_matrix()
    plane = mid_sagittal_plane(speech() @ turn.T + np.array(shift), LEFT, "speech")
    assert angle_deg(plane.normal, turn @ LEFT) < 1e-4
    assert plane.spread_mm < 1e-6 and np.abs(plane.offsets_mm).max() < 1e-6
    assert plane.tilt_deg == pytest.approx(angle_deg(turn @ LEFT, LEFT), abs=1e-4)
    rotation, translation = plane.levelling(np.eye(3))
    levelled = (speech() @ turn.T + np.array(shift)) @ rotation.T + translation
    assert np.abs(levelled[..., 0]).max() < 1e-5
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert translation[1] == translation[2] == 0.0


def test_noise_and_outliers_hardly_turn_the_plane():
    random = np.random.default_rng(3)
    coils = speech() + random.normal(scale=0.3, size=(400, 3, 3))
    coils[random.random((400, 3)) < 0.03] += [15.0, 0.0, 10.0]
    coils[random.random((400, 3)) < 0.05] = np.nan
    plane = mid_sagittal_plane(coils, LEFT, "speech")
    assert angle_deg(plane.normal, LEFT) < 0.5
    assert plane.spread_mm == pytest.approx(0.3, abs=0.05)
    assert plane.unsure_deg < 2.0


def test_a_coil_that_sits_beside_the_middle_is_told_and_makes_the_plane_unsure():
    straight = mid_sagittal_plane(speech(), LEFT, "speech")
    beside = speech()
    beside[:, 2, 0] += 4.0
    plane = mid_sagittal_plane(beside, LEFT, "speech")
    assert plane.unsure_deg > straight.unsure_deg + 3.0
    assert plane.unsure_deg > 0.5 * angle_deg(plane.normal, LEFT)


def test_the_normal_points_to_the_left_that_was_stated():
    plane = mid_sagittal_plane(speech(), -LEFT, "speech")
    assert plane.normal @ -LEFT == pytest.approx(1.0)


def test_a_coil_without_data_takes_no_part():
    coils = speech()
    coils[:, 1] = np.nan
    plane = mid_sagittal_plane(coils, LEFT, "speech")
    assert np.isnan(plane.offsets_mm[1]) and angle_deg(plane.normal, LEFT) < 1e-4


def test_levelling_ends_in_the_models_directions_whatever_the_source():
    frame = FrameOfReference("front", "left", "up")
    to_model = directions(frame, "speech")
    turn = Rotation.from_euler("z", 8, degrees=True).as_matrix()
    source = speech() @ turn.T @ to_model  # as the file has it
    plane = mid_sagittal_plane(source, to_model[0], "speech")
    rotation, translation = plane.levelling(to_model)
    levelled = source @ rotation.T + translation
    assert np.abs(levelled[..., 0]).max() < 1e-6
    assert np.abs(np.diff(levelled.mean(axis=0)[:, 1])).min() > 10.0  # still front to back
    assert handedness(rotation) == "right-handed"


def test_coils_on_a_line_tell_no_plane():
    line = np.zeros((200, 3, 3))
    line[..., 1] = np.array([10.0, 30.0, 50.0]) + np.random.default_rng(1).normal(size=(200, 3))
    line += np.random.default_rng(2).normal(scale=0.3, size=line.shape)
    with pytest.raises(
        InputError, match=r"held\.pos: .* of a straight line .* do not tell how the plane lies"
    ):
        mid_sagittal_plane(line, LEFT, "held.pos")


def test_a_plane_that_contradicts_the_stated_axes_is_refused():
    with pytest.raises(
        InputError, match=r"speech\.pos: the plane .* turned 90 degrees against the stated axes"
    ):
        mid_sagittal_plane(speech(), np.array([0.0, 1.0, 0.0]), "speech.pos")


def test_too_few_samples_are_refused():
    with pytest.raises(InputError, match="fewer than three samples"):
        mid_sagittal_plane(np.full((10, 2, 3), np.nan), LEFT, "speech")


@pytest.mark.parametrize(
    ("file", "rate", "tongue"),
    [
        ("tardis/ema_original/sf2_0005.txt", 250, ("Ch1", "Ch2", "Ch3")),
        ("hprc/F01_B01_S01_R01_N.mat", None, ("TT", "TB", "TR")),
        ("ag501_reidy/0021.pos", None, ("Ch3", "Ch4", "Ch5")),
        ("emu_webapp/ssff/0020.t_tip", None, ("t_tip", "t_mid", "t_back")),
    ],
)
def test_real_tongue_coils_lie_in_a_plane_near_the_stated_one(reference_data, file, rate, tongue):
    recording = open_recording(reference_data / "recordings" / file, rate_hz=rate)
    picked = [recording.coils.index(name) for name in tongue]
    to_model = directions(recording.frame, file)
    plane = mid_sagittal_plane(recording.positions[:, picked], to_model[0], file)
    assert plane.tilt_deg < 12.0
    assert plane.spread_mm < 1.2
    assert plane.unsure_deg < 12.0
