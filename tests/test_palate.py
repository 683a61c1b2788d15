"""The palate curve: from a sweep, from a trace, from a model; and what contradicts it."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.drivers import FrameOfReference, open_recording
from tonguetrack.model.midsagittal import midsagittal_vertices
from tonguetrack.model.mri.phantom.anatomy import STEP_MM, roof_of
from tonguetrack.model.mri.phantom.making import phantom_speaker
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.palate import (
    Palate,
    axes_from_words,
    check_above_tongue,
    model_palate,
    palate_from_sweep,
    palate_from_toml,
    palate_toml,
    read_palate,
)
from tonguetrack.tracker.sagittal import directions

MODEL = FrameOfReference("left", "back", "up")
NORMPOS = FrameOfReference("front", "left", "up")
RATE_HZ = 250


def true_height(y):
    """A palate: ridge at the front, vault at 30, soft palate behind, mm."""
    return (
        -4.0
        + 15.0 / (1.0 + np.exp(-(np.asarray(y) - 12.0) / 4.0))
        - 0.006 * np.maximum(np.asarray(y) - 30.0, 0) ** 2
    )


def sweep(noise=0.0, frames=3000, off_palate=0.0, seed=1):
    """(frames, 3) a probe from back to front and again to the back, mm, model axes; off the palate for a share."""
    random = np.random.default_rng(seed)
    y = 26.0 + 22.0 * np.cos(np.linspace(0.0, 2.0 * np.pi, frames))
    path = np.column_stack([0.03 * (y - 26.0), y, true_height(y)])
    if off_palate:
        # Loses touch again and again, for a tenth of a second or so, by up to 8 mm.
        drop = np.convolve(random.random(frames) < off_palate / 30, np.ones(30), "same") > 0
        path[drop, 2] -= np.abs(random.normal(scale=5.0, size=drop.sum())).clip(0.5, 8.0)
    return path + random.normal(scale=noise, size=path.shape)


def error_mm(palate: Palate) -> np.ndarray:
    y = palate.points_mm[:, 1]
    return palate.height(y) - true_height(y)


# The curve ------------------------------------------------------------------------------------------

ARCH = Palate(np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 8.0], [0.0, 30.0, 4.0]]), "an arch")


def test_height_is_interpolated_between_the_points_and_unknown_outside():
    assert ARCH.height(np.array([0.0, 5.0, 20.0, 30.0])) == pytest.approx([0.0, 4.0, 6.0, 4.0])
    assert np.isnan(ARCH.height(np.array([-0.1, 30.1, np.nan]))).all()


def test_above_is_signed_and_keeps_the_shape_of_the_points():
    points = np.array([[[0.0, 5.0, 6.0], [3.0, 20.0, 1.0]], [[0.0, 50.0, 0.0], [np.nan] * 3]])
    above = ARCH.above(points)
    assert above.shape == (2, 2)
    assert above[0] == pytest.approx([2.0, -5.0]) and np.isnan(above[1]).all()
    frame_by_frame = [ARCH.above(frame) for frame in points]
    assert np.array_equal(above, np.stack(frame_by_frame), equal_nan=True)


@settings(max_examples=30, deadline=None)
@given(
    angles=st.tuples(st.floats(-15, 15), st.floats(-15, 15), st.floats(-15, 15)),
    shift=st.tuples(*[st.floats(-80, 80)] * 3),
)
def test_a_palate_moves_as_the_coils_do(angles, shift):
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    moved = ARCH.transformed(turn, np.array(shift))
    assert np.allclose(moved.points_mm, ARCH.points_mm @ turn.T + shift)
    assert moved.source == ARCH.source
    back = moved.transformed(turn.T, -turn.T @ shift)
    assert np.allclose(back.points_mm, ARCH.points_mm)


def test_a_palate_in_other_axes_comes_into_the_models_by_the_coils_own_motion():
    to_model = directions(NORMPOS, "a file")
    source = Palate((ARCH.points_mm @ to_model), "in the file's axes", NORMPOS)
    points = np.array([[0.0, 5.0, 6.0], [3.0, 20.0, 1.0]])
    assert source.above(points @ to_model) == pytest.approx(ARCH.above(points))
    assert source.height(5.0) == ARCH.height(5.0)  # so far back, whatever the axes
    assert np.allclose(source.transformed(to_model, np.zeros(3)).points_mm, ARCH.points_mm)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((0, 3)), "2 to 10000 points"),
        (np.zeros((1, 3)), "2 to 10000 points"),
        (np.zeros((3, 2)), "2 to 10000 points"),
        (np.array([[0, 0, 0], [0, 1, np.nan]]), "not a finite number"),
        (np.array([[0, 2, 0], [0, 1, 0.0]]), "from front to back"),
    ],
)
def test_what_is_no_curve_is_refused(points, words):
    with pytest.raises(InputError, match=words):
        Palate(points, "a file")


# A sweep --------------------------------------------------------------------------------------------


def test_a_clean_sweep_gives_the_palate():
    palate = palate_from_sweep(sweep(), MODEL, "pal.pos")
    assert np.abs(error_mm(palate)).max() < 0.25
    assert np.ptp(palate.points_mm[:, 1]) > 42.0
    assert palate.lateral_mm == pytest.approx(1.3, abs=0.2)


def test_a_noisy_sweep_gives_the_middle_of_the_noise_not_its_top():
    errors = error_mm(palate_from_sweep(sweep(noise=0.3), MODEL, "pal.pos"))
    assert abs(errors.mean()) < 0.1
    assert np.abs(errors).max() < 0.5


def test_a_probe_that_is_on_the_palate_only_part_of_the_time_gives_the_same_palate():
    errors = error_mm(palate_from_sweep(sweep(noise=0.2, off_palate=0.6), MODEL, "pal.pos"))
    assert np.sqrt(np.mean(errors**2)) < 0.3
    assert np.abs(errors).max() < 1.0


def test_single_outliers_above_and_below_and_gaps_change_nothing_much():
    probe = sweep(noise=0.2)
    random = np.random.default_rng(4)
    probe[random.random(len(probe)) < 0.02, 2] += 12.0
    probe[random.random(len(probe)) < 0.02] += random.normal(scale=30.0, size=3)
    probe[random.random(len(probe)) < 0.1] = np.nan
    palate = palate_from_sweep(probe, MODEL, "pal.pos")
    inside = (palate.points_mm[:, 1] > 5.0) & (palate.points_mm[:, 1] < 47.0)
    assert np.abs(error_mm(palate)[inside]).max() < 0.6


def test_a_slow_and_a_fast_sweep_give_the_same_palate():
    for frames in (600, 12_000):
        assert (
            np.abs(error_mm(palate_from_sweep(sweep(noise=0.2, frames=frames), MODEL, "pal.pos"))).max() < 0.6
        )


def test_a_sweep_in_other_axes_gives_its_palate_in_those_axes():
    to_model = directions(NORMPOS, "pal.pos")
    palate = palate_from_sweep(sweep() @ to_model, NORMPOS, "pal.pos")
    assert palate.frame == NORMPOS
    assert np.abs(error_mm(palate.transformed(to_model, np.zeros(3)))).max() < 0.25


def test_a_sweep_whose_axes_nobody_states_is_not_guessed():
    with pytest.raises(InputError, match=r"pal\.pos: its axes are x unknown.* state all three"):
        palate_from_sweep(sweep(), FrameOfReference(), "pal.pos")


def test_a_probe_that_rests_is_no_sweep():
    with pytest.raises(InputError, match=r"pal\.pos: the probe moves only 0\.0 mm front to back"):
        palate_from_sweep(np.zeros((500, 3)), MODEL, "pal.pos")
    with pytest.raises(InputError, match="moves only 0.0 mm"):
        palate_from_sweep(np.full((500, 3), np.nan), MODEL, "pal.pos")


def test_a_probe_that_flies_past_is_no_sweep():
    with pytest.raises(InputError, match=r"pal\.pos: the probe stays long enough .* sweep more slowly"):
        palate_from_sweep(sweep(frames=40), MODEL, "pal.pos")


# The palate and the tongue --------------------------------------------------------------------------


def tongue_below(gap_mm: float, frames=500) -> np.ndarray:
    """(frames, 3, 3) tongue coils that rise to `gap_mm` below the true palate, mm, model axes."""
    random = np.random.default_rng(2)
    y = np.array([12.0, 26.0, 40.0]) + random.uniform(-4.0, 4.0, (frames, 3))
    z = true_height(y) - gap_mm - 12.0 * random.random((frames, 3)) ** 2
    return np.stack([np.zeros_like(y), y, z], axis=2)


def test_a_tongue_below_its_palate_is_as_it_should_be():
    palate = palate_from_sweep(sweep(noise=0.2), MODEL, "pal.pos", tongue_below(1.5))
    assert check_above_tongue(palate, tongue_below(1.5), "speech.pos") == pytest.approx(-1.5, abs=0.5)


def test_the_clearance_is_the_same_in_other_axes():
    to_model = directions(NORMPOS, "a file")
    palate = palate_from_sweep(sweep(), MODEL, "pal.pos")
    other = Palate(palate.points_mm @ to_model, "pal.pos", NORMPOS)
    here = check_above_tongue(palate, tongue_below(2.0), "speech.pos")
    assert check_above_tongue(other, tongue_below(2.0) @ to_model, "speech.pos") == pytest.approx(here)


def test_a_palate_below_the_tongue_is_refused():
    with pytest.raises(
        InputError, match=r"pal\.pos: this palate is below the tongue: \d+ % of the tongue samples of"
    ):
        palate_from_sweep(sweep() - [0.0, 0.0, 25.0], MODEL, "pal.pos", tongue_below(1.5))


def test_a_palate_far_above_the_tongue_is_refused():
    palate = palate_from_sweep(sweep(), MODEL, "pal.pos")
    with pytest.raises(
        InputError, match=r"pal\.pos: the tongue coils of speech\.pos never come within 6\d mm"
    ):
        check_above_tongue(palate, tongue_below(60.0), "speech.pos")


def test_a_palate_that_is_nowhere_over_the_tongue_is_refused():
    palate = palate_from_sweep(sweep(), MODEL, "pal.pos")
    with pytest.raises(
        InputError, match=r"pal\.pos: no tongue coil of speech\.pos is ever below this palate"
    ):
        check_above_tongue(palate, tongue_below(1.0) + [0.0, 90.0, 0.0], "speech.pos")


# Files ----------------------------------------------------------------------------------------------


def test_a_trace_is_asked_for_its_unit_and_axes(tmp_path):
    path = tmp_path / "pal.dat"
    path.write_text("0 -3\n10 4\n30 9\n50 5\n")
    with pytest.raises(InputError, match=r"pal\.dat: a trace of 2 columns .* pass its unit and axes"):
        read_palate(path)
    with pytest.raises(InputError, match="pass its unit "):
        read_palate(path, axes_from_words("back up"))
    with pytest.raises(InputError, match="pass its axes "):
        read_palate(path, unit="mm")
    with pytest.raises(InputError, match="the unit 'furlong' is not known"):
        read_palate(path, axes_from_words("back up"), "furlong")


def test_a_trace_is_read_with_the_unit_and_axes_that_were_stated(tmp_path):
    path = tmp_path / "pal.txt"
    path.write_text("-5.0,0.1,0.5\n-3.0,0.2,0.9\n0.0,0.3,-0.3\n")
    palate = read_palate(path, axes_from_words("front left up"), "cm")
    in_model = palate.transformed(directions(palate.frame, "pal"), np.zeros(3))
    assert in_model.points_mm == pytest.approx(np.array([[3, 0, -3], [2, 30, 9], [1, 50, 5.0]]))


def test_a_trace_in_the_wrong_unit_is_noticed(tmp_path):
    path = tmp_path / "pal.dat"
    path.write_text("0 -3\n10 4\n30 9\n50 5\n")
    with pytest.raises(
        InputError, match=r"in um the trace extends 0\.05 mm front to back, a palate 15 to 120 mm"
    ):
        read_palate(path, axes_from_words("back up"), "um")


def test_a_text_of_all_the_samples_of_a_probe_is_taken_as_a_sweep(tmp_path):
    np.savetxt(tmp_path / "pal.txt", sweep(noise=0.2, off_palate=0.5), fmt="%.3f")
    palate = read_palate(tmp_path / "pal.txt", MODEL, "mm")
    assert len(palate.points_mm) < 60
    assert np.abs(error_mm(palate)).max() < 1.0


def test_axes_must_be_as_many_as_columns(tmp_path):
    path = tmp_path / "pal.dat"
    path.write_text("0 -3\n30 9\n50 5\n")
    with pytest.raises(InputError, match="the trace has 2 columns, but the axes .* are 3"):
        read_palate(path, MODEL, "mm")


@pytest.mark.parametrize("text", ["", "up", "left back up down", "left right up", "vorn oben"])
def test_axes_that_say_nothing_clear_are_refused(text):
    with pytest.raises(InputError, match="axes"):
        axes_from_words(text)


def write_carstens(path, coils) -> None:
    """coils (frames, n, 3) as a Carstens .txt export."""
    fields = ("X", "Y", "Z", "phi", "theta", "RMS", "Extra")
    header = "\t".join(f"Ch{k + 1}_{field}" for k in range(coils.shape[1]) for field in fields)
    full = np.concatenate([coils, np.ones((*coils.shape[:2], 3)), np.zeros((*coils.shape[:2], 1))], axis=2)
    np.savetxt(path, full.reshape(len(coils), -1), fmt="%.2f", delimiter="\t", header=header, comments="")


def test_the_channel_that_moves_along_a_palate_is_the_probe(tmp_path):
    to_model = directions(NORMPOS, "pal")
    swept = sweep() @ to_model
    fixed = np.tile([5.0, 60.0, 40.0], (len(swept), 1))
    write_carstens(tmp_path / "pal.txt", np.stack([fixed, swept], axis=1))
    palate = read_palate(tmp_path / "pal.txt")
    assert "channel Ch2" in palate.source
    assert np.abs(error_mm(palate.transformed(to_model, np.zeros(3)))).max() < 0.25


def test_two_channels_that_move_are_not_guessed_between(tmp_path):
    swept = sweep() @ directions(NORMPOS, "pal")
    write_carstens(tmp_path / "pal.txt", np.stack([swept, swept - [0, 0, 9.0]], axis=1))
    with pytest.raises(InputError, match=r"several coils move along it \(Ch1, Ch2\); name the channel"):
        read_palate(tmp_path / "pal.txt")
    assert "channel Ch1" in read_palate(tmp_path / "pal.txt", channel="Ch1").source
    with pytest.raises(
        InputError, match="there is no channel 'Ch7' for the palate probe; there are Ch1, Ch2"
    ):
        read_palate(tmp_path / "pal.txt", channel="Ch7")


def test_tongue_coils_in_the_file_of_the_sweep_must_be_below_it(tmp_path):
    to_model = directions(NORMPOS, "pal")
    tongue = np.concatenate([tongue_below(2.0)] * 6) @ to_model
    dead = np.full((3000, 1, 3), np.nan)
    swept = sweep()[:, None] @ to_model
    write_carstens(tmp_path / "pal.txt", np.concatenate([tongue, swept, dead], axis=1))
    assert "channel Ch4" in read_palate(tmp_path / "pal.txt", tongue=("Ch1", "Ch2", "Ch3")).source
    assert "channel Ch4" in read_palate(tmp_path / "pal.txt", channel="Ch4", tongue=("Ch5", "TT")).source
    low = np.concatenate([tongue, swept - [0.0, 0.0, 25.0]], axis=1)
    write_carstens(tmp_path / "low.txt", low)
    with pytest.raises(InputError, match=r"low\.txt, channel Ch4: this palate is below the tongue"):
        read_palate(tmp_path / "low.txt", tongue=("Ch1", "Ch2", "Ch3"))


def test_a_file_in_which_nothing_moves_has_no_probe(tmp_path):
    write_carstens(tmp_path / "pal.txt", np.ones((100, 2, 3)))
    with pytest.raises(InputError, match="no coil moves as far; name the channel"):
        read_palate(tmp_path / "pal.txt")


def test_a_file_that_is_neither_trace_nor_recording_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("the palate was swept twice\n")
    with pytest.raises(InputError, match=r"notes\.txt"):
        read_palate(tmp_path / "notes.txt", MODEL, "mm")
    with pytest.raises(InputError, match="no such file"):
        read_palate(tmp_path / "none.txt")


NUMBERS = st.lists(
    st.lists(
        st.sampled_from(["0", "-3.5", "40", "1e3", "1e308", "e", "--1", ".", "nan", ""]),
        min_size=1,
        max_size=4,
    ),
    max_size=12,
).map(lambda rows: "\n".join(" ".join(row) for row in rows).encode())


@settings(max_examples=150, deadline=None)
@given(content=st.one_of(st.binary(max_size=80), NUMBERS), unit=st.sampled_from([None, "mm", "um"]))
def test_whatever_a_file_holds_it_is_a_palate_or_refused_in_a_sentence(tmp_path_factory, content, unit):
    path = tmp_path_factory.getbasetemp() / "anything.dat"
    path.write_bytes(content)
    try:
        palate = read_palate(path, axes_from_words("back up"), unit)
    except InputError as refusal:
        assert "anything.dat" in str(refusal)
    else:
        assert np.isfinite(palate.points_mm).all()


# Real files -----------------------------------------------------------------------------------------


def test_the_real_sweep_is_above_the_tongue_of_its_speaker(reference_data):
    folder = reference_data / "recordings" / "tardis"
    palate = read_palate(folder / "ema_palate" / "sf2_palate.txt")
    assert "channel Ch15" in palate.source and (palate.frame.x, palate.frame.y, palate.frame.z) == (
        "front",
        "left",
        "up",
    )
    speech = open_recording(folder / "ema_original" / "sf2_0005.txt", rate_hz=RATE_HZ)
    tongue = speech.positions[:, [speech.coils.index(name) for name in ("Ch1", "Ch2", "Ch3")]]
    assert -4.0 < check_above_tongue(palate, tongue, "sf2_0005") < 0.0
    probe = open_recording(folder / "ema_palate" / "sf2_palate.txt", rate_hz=RATE_HZ)
    to_model = directions(palate.frame, "sf2")
    off = palate.transformed(to_model, np.zeros(3)).above(probe.positions[:, 14] @ to_model.T)
    assert np.nanmax(np.abs(off)) < 1.0 and np.nanmedian(np.abs(off)) < 0.1


def test_the_real_trace_beside_the_speech_is_that_sweep_and_takes_its_axes(reference_data):
    folder = reference_data / "recordings" / "tardis"
    with pytest.raises(InputError, match="the file does not state its axes"):
        read_palate(folder / "ema_ssff" / "sf2_0005.PAL")
    frame = open_recording(folder / "ema_ssff" / "sf2_0005.TT").frame
    beside = read_palate(folder / "ema_ssff" / "sf2_0005.PAL", frame)
    swept = read_palate(folder / "ema_palate" / "sf2_palate.txt")
    assert np.allclose(beside.points_mm, swept.points_mm, atol=1e-4)


def test_the_real_two_dimensional_trace_is_in_mm_and_above_the_tongue(reference_data):
    folder = reference_data / "recordings" / "mocha"
    speech = open_recording(folder / "fsew0_001.ema")
    with pytest.raises(InputError, match="check the unit"):
        read_palate(folder / "fsew0_pal.dat", speech.frame, "10um")  # the coils' own unit
    palate = read_palate(folder / "fsew0_pal.dat", speech.frame, "mm")
    tongue = speech.positions[:, [speech.coils.index(name) for name in ("tt", "tb", "td")]]
    assert -5.0 < check_above_tongue(palate, tongue, "fsew0_001") < 0.0


def test_the_palate_of_one_real_speaker_is_refused_for_another(reference_data):
    folder = reference_data / "recordings"
    palate = read_palate(folder / "tardis" / "ema_palate" / "sf2_palate.txt")
    other = open_recording(folder / "hprc" / "F01_B01_S01_R01_N.mat")
    tongue = other.positions[:, [other.coils.index(name) for name in ("TT", "TB", "TR")]]
    with pytest.raises(InputError, match="no tongue coil of F01"):
        check_above_tongue(palate, tongue, "F01")


# A model --------------------------------------------------------------------------------------------


def test_a_models_palate_is_above_its_mean_tongue_and_below_the_true_palate_of_its_speakers():
    model = bundled_model()
    palate = model_palate(model)
    contour = midsagittal_vertices(model)
    mean = palate.above(model.mean_vertices()[contour])
    assert np.nanmax(mean) < 0.0
    y, z = palate.curve
    roofs = []
    for number in range(1, model.speaker.entries + 1):
        anatomy = phantom_speaker(0, number).anatomy
        roof = anatomy.size * roof_of(anatomy)
        roofs.append(np.interp(y, anatomy.size * STEP_MM * np.arange(len(roof)), roof))
    true = np.mean(roofs, axis=0)
    vault = (y > 8.0) & (y < 44.0)
    assert vault.sum() > 30
    assert ((true - z)[vault] > 0.0).all() and (true - z)[vault].max() < 8.0


def test_no_pose_of_the_average_speaker_rises_above_the_models_palate():
    model = bundled_model()
    palate, speaker, contour = (
        model_palate(model),
        model.for_speaker(model.speaker.mean),
        midsagittal_vertices(model),
    )
    above = np.array([palate.above(speaker.vertices(pose)[contour]) for pose in model.pose.training])
    # The curve is smoothed, and some pose touches it.
    assert -0.3 < np.nanmax(above) < 0.6


def test_a_model_that_is_no_tongue_has_no_palate():
    model = bundled_model()
    in_metres = replace(model, core=model.core / 1000.0, origin=model.origin / 1000.0)
    with pytest.raises(InputError, match="no model of a tongue in mm"):
        model_palate(in_metres)


def test_a_model_without_training_poses_has_a_palate_too():
    model = bundled_model()
    bare = replace(model, pose=replace(model.pose, training=None))
    with_poses, without = model_palate(model), model_palate(bare)
    y = np.arange(15.0, 45.0)
    assert np.abs(with_poses.height(y) - without.height(y)).max() < 6.0


# A session ------------------------------------------------------------------------------------------


def test_a_session_gives_the_palate_back_unchanged():
    palate = palate_from_sweep(sweep(noise=0.2), MODEL, "sweep of pal.pos").transformed(np.eye(3), np.ones(3))
    again = palate_from_toml(tomllib.loads(tomlkit.dumps(palate_toml(palate))))
    assert np.array_equal(again.points_mm, palate.points_mm) and again.source == palate.source


def test_only_a_palate_in_the_models_frame_goes_into_a_session():
    with pytest.raises(InputError, match="move it into the model's frame first"):
        palate_toml(Palate(ARCH.points_mm @ directions(NORMPOS, "f"), "f", NORMPOS))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"points_mm": [[0, 0, 0], [0, 1, 0]], "unit": "mm"}, "unknown key 'unit'"),
        ({"source": 3, "points_mm": [[0, 0, 0], [0, 1, 0]]}, "source = 3: expected text"),
        ({}, "expected a list of points"),
        ({"points_mm": [[0, 0], [0, 1]]}, "expected a list of points"),
        ({"points_mm": [[0, 0, True], [0, 1, 0]]}, "expected a list of points"),
        ({"points_mm": [[0, 0, "1"], [0, 1, 0]]}, "expected a list of points"),
        ({"points_mm": []}, "2 to 10000 points"),
        ({"points_mm": [[0, 1, 0], [0, 0, 0]]}, "from front to back"),
        ({"points_mm": [[0, 0, 0], [0, 10**400, 0]]}, "points_mm"),
        ({"points_mm": [[0, 0, 0], [0, float("inf"), 0]]}, "not a finite number"),
    ],
)
def test_a_damaged_palate_in_a_session_is_refused_by_name(table, words):
    with pytest.raises(InputError, match=words) as refusal:
        palate_from_toml(table)
    assert "[palate]" in str(refusal.value)
