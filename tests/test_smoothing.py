"""Smoothing: what each filter does to frequencies, lines, gaps and time; how filters are written and chosen."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.tracker import filters
from tonguetrack.tracker.filterwords import Filter, parse_filter
from tonguetrack.tracker.smoothing import (
    NO_SMOOTHING,
    PRESETS,
    CausalSmoother,
    Smoothing,
    smooth,
    smoothing_from_toml,
    smoothing_toml,
)

RATE_HZ = 250.0
RECORDED = (
    "butterworth 20 Hz order 5",
    "butterworth 10 Hz order 2",
    "butterworth 62.5 Hz order 1",
    "fir 40-50 Hz",
    "fir 5-15 Hz",
    "gaussian 8 ms",
    "median 5 frames",
)
LIVE = ("one-pole 20 Hz", "one-euro 2 Hz beta 0.01", "one-euro 10 Hz beta 0.2 speed 5 Hz", "fir 40-50 Hz")


def smoothed(track: np.ndarray, text: str, rate_hz: float = RATE_HZ) -> np.ndarray:
    """One coil's track (frames, 3)."""
    return smooth(track[:, None], rate_hz, [parse_filter(text)])[:, 0]


def live(track: np.ndarray, text: str, step_s: float = 1 / RATE_HZ, rate_hz: float = RATE_HZ) -> np.ndarray:
    """One coil's track (frames, 3), frame by frame."""
    smoother = CausalSmoother([parse_filter(text)], rate_hz)
    out = np.empty((len(track), 1, 3))
    for frame, raw in zip(out, track, strict=True):
        smoother.step(raw[None].copy(), step_s, frame)
    return out[:, 0]


def sine(hz: float, frames: int) -> np.ndarray:
    """(frames, 3): 1, 2 and -1 mm of a sine of this frequency."""
    return np.sin(2 * np.pi * hz * np.arange(frames) / RATE_HZ)[:, None] * [1.0, 2.0, -1.0]


def gain(text: str, hz: float) -> float:
    """How much of a sine is left in the middle of two seconds of it."""
    frames = 4 * int(RATE_HZ)
    middle = slice(frames // 4, 3 * frames // 4)
    before, after = sine(hz, frames)[middle], smoothed(sine(hz, frames), text)[middle]
    # The share in phase; nothing may be left out of phase.
    share = np.vdot(before, after) / np.vdot(before, before)
    np.testing.assert_allclose(after, share * before, atol=2e-3)
    return float(share)


# Frequencies ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("hz", [3.0, 10.0, 20.0, 30.0, 60.0])
@pytest.mark.parametrize("order", [2, 5])
def test_a_butterworth_both_ways_has_the_squared_response_of_the_theory(hz, order):
    # The bilinear transform maps frequencies by the tangent.
    warped = math.tan(math.pi * hz / RATE_HZ) / math.tan(math.pi * 20.0 / RATE_HZ)
    expected = 1.0 / (1.0 + warped ** (2 * order))
    assert gain(f"butterworth 20 Hz order {order}", hz) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("hz", [3.0, 10.0, 20.0, 30.0])
def test_a_gaussian_has_the_response_of_a_gaussian(hz):
    expected = math.exp(-2.0 * (math.pi * hz * 0.008) ** 2)
    assert gain("gaussian 8 ms", hz) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(("low", "high"), [(5, 15), (40, 50)])
@pytest.mark.parametrize("rate_hz", [200.0, 250.0, 400.0])
def test_a_fir_keeps_its_pass_band_and_is_60_db_down_from_its_stop_frequency_on(low, high, rate_hz):
    taps = filters.fir_taps(low, high, rate_hz)
    hz = np.linspace(0.0, rate_hz / 2.0, 2000)
    response = np.abs(np.exp(-2j * np.pi * np.outer(hz, np.arange(len(taps))) / rate_hz) @ taps)
    assert np.abs(response[hz <= low] - 1.0).max() < 2.1e-3  # 0.02 dB
    assert response[hz >= high].max() < 1.1e-3


@pytest.mark.parametrize("hz", [2.0, 10.0, 20.0, 50.0])
def test_the_one_pole_filter_has_the_response_of_one_pole(hz):
    pole = math.exp(-2 * math.pi * 20.0 / RATE_HZ)
    turn = 2 * math.pi * hz / RATE_HZ
    expected = (1 - pole) / abs(1 - pole * complex(math.cos(turn), -math.sin(turn)))
    settled = live(sine(hz, 1000), "one-pole 20 Hz")[500:]
    assert np.sqrt(2.0) * settled[:, 0].std() == pytest.approx(expected, rel=1e-3)


def test_a_one_pole_filter_is_3_db_down_near_its_cut_off():
    settled = live(sine(20.0, 1000), "one-pole 20 Hz")[500:]
    assert np.sqrt(2.0) * settled[:, 0].std() == pytest.approx(np.sqrt(0.5), abs=0.02)


def test_a_median_takes_single_outliers_away_and_leaves_a_step_where_it_is():
    track = np.zeros((60, 3))
    track[30:] = [1.0, -2.0, 3.0]
    spiked = track.copy()
    spiked[[10, 20, 50], [0, 1, 2]] = 40.0
    np.testing.assert_array_equal(smoothed(spiked, "median 5 frames"), track)


# What must not change -------------------------------------------------------------------------------


@pytest.mark.parametrize("text", RECORDED)
@pytest.mark.parametrize("frames", [1, 2, 3, 4, 7, 30, 400])
def test_constants_and_straight_lines_pass_a_recorded_filter_unchanged(text, frames):
    line = np.arange(frames)[:, None] * [0.3, -0.02, 0.0] + [100.0, -20.0, 7.5]
    np.testing.assert_allclose(smoothed(line, text), line, rtol=0, atol=1e-11)


@pytest.mark.parametrize("text", RECORDED)
def test_a_symmetric_pulse_stays_symmetric_where_it_was(text):
    frames = np.arange(-150, 151)
    pulse = np.maximum(0.0, 1.0 - np.abs(frames) / 12.0)[:, None] * [1.0, -3.0, 8.0]
    after = smoothed(pulse, text)
    np.testing.assert_allclose(after, after[::-1], rtol=0, atol=1e-7)
    np.testing.assert_array_equal(np.abs(after[150]), np.abs(after).max(axis=0))


@pytest.mark.parametrize("text", RECORDED)
def test_a_recording_turned_round_in_time_gives_the_result_turned_round(text):
    walk = np.random.default_rng(3).normal(size=(300, 3)).cumsum(axis=0)
    np.testing.assert_allclose(smoothed(walk[::-1], text)[::-1], smoothed(walk, text), rtol=0, atol=1e-6)


@pytest.mark.parametrize("text", RECORDED)
def test_the_recording_itself_is_not_touched(text):
    raw = np.random.default_rng(4).normal(size=(50, 1, 3))
    raw.flags.writeable = False
    before = raw.copy()
    after = smooth(raw, RATE_HZ, [parse_filter(text)])
    np.testing.assert_array_equal(raw, before)
    assert not np.array_equal(after, raw)


def test_each_coil_has_its_own_filter_and_none_leaves_it_as_it_is():
    raw = np.random.default_rng(5).normal(size=(80, 4, 3))
    chosen = [None, parse_filter("median 5 frames"), parse_filter("none"), parse_filter("gaussian 8 ms")]
    after = smooth(raw, RATE_HZ, chosen)
    np.testing.assert_array_equal(after[:, [0, 2]], raw[:, [0, 2]])
    np.testing.assert_array_equal(after[:, 1], smoothed(raw[:, 1], "median 5 frames"))
    np.testing.assert_array_equal(after[:, 3], smoothed(raw[:, 3], "gaussian 8 ms"))


# Gaps -----------------------------------------------------------------------------------------------

damage = st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -2e9])


@st.composite
def tracks_with_gaps(draw) -> np.ndarray:
    """(frames, 3): a random walk in which single coordinates are missing or damaged."""
    frames = draw(st.integers(0, 120))
    seed = draw(st.integers(0, 2**32 - 1))
    track = np.random.default_rng(seed).normal(size=(frames, 3)).cumsum(axis=0)
    for frame in draw(st.lists(st.integers(0, max(frames - 1, 0)), max_size=30)):
        if frames:
            track[frame, draw(st.integers(0, 2))] = draw(damage)
    return track


@pytest.mark.parametrize("text", RECORDED)
@given(track=tracks_with_gaps())
@settings(max_examples=40, deadline=None)
def test_missing_stays_missing_and_each_run_in_between_is_filtered_by_itself(text, track):
    after = smoothed(track, text)
    present = (np.abs(track) < 1e9).all(axis=1)
    np.testing.assert_array_equal(after[~present], track[~present])
    assert np.isfinite(after[present]).all()
    edges = np.flatnonzero(np.diff(np.r_[False, present, False]))
    for first, end in edges.reshape(-1, 2):
        np.testing.assert_array_equal(after[first:end], smoothed(track[first:end], text))


@pytest.mark.parametrize("text", RECORDED)
@given(track=tracks_with_gaps())
@settings(max_examples=40, deadline=None)
def test_a_smoothed_run_stays_near_its_samples(text, track):
    """No ringing beyond the run's own size: what is continued at the ends is bounded, however short the run."""
    after = smoothed(track, text)
    present = (np.abs(track) < 1e9).all(axis=1)
    edges = np.flatnonzero(np.diff(np.r_[False, present, False]))
    for first, end in edges.reshape(-1, 2):
        size = np.ptp(track[first:end], axis=0)
        assert (after[first:end] <= track[first:end].max(axis=0) + size + 1e-9).all()
        assert (after[first:end] >= track[first:end].min(axis=0) - size - 1e-9).all()


@pytest.mark.parametrize("text", LIVE)
@given(track=tracks_with_gaps())
@settings(max_examples=40, deadline=None)
def test_live_a_coil_that_was_missing_starts_anew(text, track):
    after = live(track, text)
    present = (np.abs(track) < 1e9).all(axis=1)
    np.testing.assert_array_equal(after[~present], track[~present])
    edges = np.flatnonzero(np.diff(np.r_[False, present, False]))
    for first, end in edges.reshape(-1, 2):
        np.testing.assert_array_equal(after[first], track[first])
        np.testing.assert_array_equal(after[first:end], live(track[first:end], text))


# Live filters ---------------------------------------------------------------------------------------


def slow_one_pole(track: np.ndarray, steps: np.ndarray, cutoff_hz: float) -> np.ndarray:
    out = [track[0]]
    for raw, step_s in zip(track[1:], steps[1:], strict=True):
        out.append(out[-1] + (1.0 - math.exp(-2.0 * math.pi * cutoff_hz * step_s)) * (raw - out[-1]))
    return np.array(out)


def slow_one_euro(track: np.ndarray, steps: np.ndarray, least: float, beta: float, speed_hz: float):
    def share(cutoff_hz: float, step_s: float) -> float:
        return 1.0 / (1.0 + (1.0 / (2.0 * math.pi * cutoff_hz)) / step_s)

    out, velocity = [track[0]], np.zeros(3)
    for before, raw, step_s in zip(track[:-1], track[1:], steps[1:], strict=True):
        velocity = velocity + share(speed_hz, step_s) * ((raw - before) / step_s - velocity)
        cutoff_hz = least + beta * math.sqrt(sum(velocity**2))
        out.append(out[-1] + share(cutoff_hz, step_s) * (raw - out[-1]))
    return np.array(out)


def slow_fir(track: np.ndarray, taps: np.ndarray) -> np.ndarray:
    before = np.vstack([np.repeat(track[:1], len(taps) - 1, axis=0), track])
    return np.array([taps @ before[i : i + len(taps)] for i in range(len(track))])


def test_live_filters_equal_a_slow_reference_with_unequal_time_steps():
    random = np.random.default_rng(8)
    track = random.normal(size=(400, 5, 3)).cumsum(axis=0)
    steps = random.uniform(0.001, 0.02, 400)
    texts = [
        "one-pole 20 Hz",
        "one-euro 2 Hz beta 0.01",
        "one-euro 5 Hz beta 0.3 speed 8 Hz",
        "fir 40-50 Hz",
        "fir 5-30 Hz",
    ]
    smoother = CausalSmoother([parse_filter(text) for text in texts], RATE_HZ)
    out = np.empty_like(track)
    for raw, step_s, frame in zip(track, steps, out, strict=True):
        smoother.step(raw.copy(), step_s, frame)
    references = [
        slow_one_pole(track[:, 0], steps, 20.0),
        slow_one_euro(track[:, 1], steps, 2.0, 0.01, 1.0),
        slow_one_euro(track[:, 2], steps, 5.0, 0.3, 8.0),
        slow_fir(track[:, 3], filters.fir_taps(40.0, 50.0, RATE_HZ)),
        slow_fir(track[:, 4], filters.fir_taps(5.0, 30.0, RATE_HZ)),
    ]
    for coil, expected in enumerate(references):
        np.testing.assert_allclose(out[:, coil], expected, rtol=0, atol=1e-12)


def test_the_live_fir_is_the_recorded_one_late_by_the_stated_delay():
    walk = np.random.default_rng(9).normal(size=(500, 3)).cumsum(axis=0)
    late = round(CausalSmoother([parse_filter("fir 40-50 Hz")], RATE_HZ).delays_s[0] * RATE_HZ)
    assert late == len(filters.fir_taps(40.0, 50.0, RATE_HZ)) // 2
    inside = slice(late, -late)  # the ends know nothing of the samples beyond
    np.testing.assert_allclose(
        live(walk, "fir 40-50 Hz")[2 * late :], smoothed(walk, "fir 40-50 Hz")[inside], rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("text", ["one-pole 20 Hz", "one-pole 5 Hz", "fir 40-50 Hz", "one-euro 3 Hz beta 0"])
def test_slow_motion_comes_out_of_a_live_filter_late_by_the_stated_delay(text):
    velocity = np.array([20.0, -3.0, 0.5])  # mm/s
    line = np.arange(1000)[:, None] / RATE_HZ * velocity
    delay_s = CausalSmoother([parse_filter(text)], RATE_HZ).delays_s[0]
    np.testing.assert_allclose((line - live(line, text))[-1], delay_s * velocity, rtol=1e-9, atol=1e-10)


def test_the_faster_a_coil_the_less_the_one_euro_filter_is_late():
    velocity = np.array([60.0, 0.0, 80.0])  # 100 mm/s
    line = np.arange(2000)[:, None] / RATE_HZ * velocity
    lag_s = (line - live(line, "one-euro 2 Hz beta 0.1"))[-1, 0] / velocity[0]
    assert lag_s == pytest.approx(1.0 / (2.0 * math.pi * (2.0 + 0.1 * 100.0)), rel=1e-6)


def test_the_one_euro_filter_does_not_care_how_the_axes_lie():
    walk = np.random.default_rng(10).normal(size=(200, 3)).cumsum(axis=0)
    turn, _ = np.linalg.qr(np.random.default_rng(11).normal(size=(3, 3)))
    text = "one-euro 2 Hz beta 0.1"
    np.testing.assert_allclose(live(walk @ turn.T, text), live(walk, text) @ turn.T, rtol=0, atol=1e-11)


@pytest.mark.parametrize("text", LIVE)
def test_a_coil_that_stands_still_stays_where_it_is(text):
    still = np.tile([12.3, -45.6, 7.0], (300, 1))
    np.testing.assert_allclose(live(still, text), still, rtol=0, atol=1e-12)


@pytest.mark.parametrize("text", LIVE)
def test_after_reset_it_is_as_if_no_frame_had_come(text):
    walk = np.random.default_rng(12).normal(size=(150, 1, 3)).cumsum(axis=0)
    smoother = CausalSmoother([parse_filter(text)], RATE_HZ)
    first, second = np.empty_like(walk), np.empty_like(walk)
    for out in (first, second):
        smoother.reset()
        for raw, frame in zip(walk, out, strict=True):
            smoother.step(raw.copy(), 0.004, frame)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("text", LIVE)
@given(
    steps=st.lists(st.one_of(st.floats(), st.sampled_from([5e-324, 1e-9, 1e300])), min_size=1, max_size=30),
    far=st.sampled_from([1.0, 1e9]),
)
@settings(max_examples=50, deadline=None)
def test_whatever_the_clock_says_the_result_lies_among_the_samples(text, steps, far):
    smoother = CausalSmoother([parse_filter(text)], RATE_HZ)
    out = np.empty((1, 3))
    for count, step_s in enumerate(steps):
        smoother.step(np.full((1, 3), far * (-1.0) ** count), step_s, out)
        assert (np.abs(out) <= 1.5 * far).all()


@pytest.mark.parametrize("text", LIVE)
@pytest.mark.parametrize("step_s", [0.0, -1.0, 1e-9, math.nan])
def test_a_step_that_is_no_time_counts_as_the_nominal_one(text, step_s):
    walk = np.random.default_rng(13).normal(size=(50, 3)).cumsum(axis=0)
    np.testing.assert_array_equal(live(walk, text, step_s), live(walk, text, 1 / RATE_HZ))


@pytest.mark.parametrize("text", LIVE)
def test_a_frame_may_be_smoothed_in_place(text):
    walk = np.random.default_rng(14).normal(size=(50, 3)).cumsum(axis=0)
    smoother = CausalSmoother([parse_filter(text)], RATE_HZ)
    frame = np.empty((1, 3))
    for raw, expected in zip(walk, live(walk, text), strict=True):
        frame[0] = raw
        smoother.step(frame, 1 / RATE_HZ, frame)
        np.testing.assert_array_equal(frame[0], expected)


def test_live_coils_without_a_filter_are_passed_on_at_once():
    smoother = CausalSmoother([None, parse_filter("none")], 0.0)  # needs no rate either
    raw = np.array([[1.0, 2.0, 3.0], [math.nan, 0.0, 0.0]])
    out = np.empty((2, 3))
    for _ in range(3):
        raw += 1.0
        smoother.step(raw, 0.0, out)
        np.testing.assert_array_equal(out, raw)
    assert smoother.delays_s.tolist() == [0.0, 0.0]


# Words ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", sorted({*RECORDED, *LIVE, "none"}))
def test_a_filter_is_written_as_it_is_read(text):
    assert str(parse_filter(text)) == text


def test_spaces_and_capitals_do_not_matter():
    assert parse_filter(" Butterworth 20Hz  order 5") == Filter("butterworth", (20.0, 5.0))
    assert parse_filter("FIR 40 - 50 hz") == Filter("fir", (40.0, 50.0))


@given(
    st.one_of(
        st.builds(
            lambda a, b: Filter("butterworth", (a, float(b))), st.floats(0.1, 1000), st.integers(1, 10)
        ),
        st.builds(lambda a: Filter("gaussian", (a,)), st.floats(0.1, 1000)),
        st.builds(lambda a: Filter("median", (2.0 * a + 1,)), st.integers(1, 50)),
        st.builds(lambda a, b: Filter("fir", (a, a + b)), st.floats(0, 400), st.floats(1.001, 500)),
        st.builds(
            lambda *values: Filter("one-euro", values),
            st.floats(0.01, 1000),
            st.floats(0, 100),
            st.floats(0.01, 1000),
        ),
    )
)
def test_every_filter_is_given_back_by_its_own_text(chosen):
    assert parse_filter(str(chosen)) == chosen


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("butterwort 20 Hz", "no filter; for recordings there are"),
        ("", "no filter"),
        ("one-pole -3 Hz", "no filter"),
        ("one-pole nan Hz", "no filter"),
        ("median 4 frames", "the length is 4, expected an odd number from 3 to 101"),
        ("butterworth 20 Hz order 2.5", "the order is 2.5, expected a whole number from 1 to 10"),
        ("butterworth 0 Hz order 5", "the cut-off is 0, expected a number from 0.1 to 1000"),
        ("one-euro 2 Hz beta 1e999", "beta is inf"),
        ("fir 50-40 Hz", "at least 1 Hz above"),
    ],
)
def test_a_bad_text_is_refused_in_one_sentence(text, complaint):
    with pytest.raises(InputError, match=complaint) as caught:
        parse_filter(text)
    assert str(caught.value).count(". ") == 0 and str(caught.value).endswith(".")


@given(st.text(max_size=40))
def test_any_text_is_a_filter_or_refused(text):
    try:
        assert parse_filter(str(parse_filter(text))) == parse_filter(text)
    except InputError:
        pass


# Which coil has which filter ------------------------------------------------------------------------


def test_the_most_special_key_wins():
    texts = {
        "all": "gaussian 1 ms",
        "tongue": "gaussian 2 ms",
        "tongue_tip": "gaussian 3 ms",
        "references": "none",
        "jaw_and_lips": "gaussian 4 ms",
    }
    smoothing = Smoothing({key: parse_filter(text) for key, text in texts.items()})
    chosen = {
        role: str(smoothing.of(role, live=False))
        for role in ("tongue_tip", "tongue_root_2", "jaw", "mouth_left", "head_nose", "palate_probe")
    }
    assert chosen == {
        "tongue_tip": "gaussian 3 ms",
        "tongue_root_2": "gaussian 2 ms",
        "jaw": "gaussian 4 ms",
        "mouth_left": "gaussian 4 ms",
        "head_nose": "None",
        "palate_probe": "gaussian 1 ms",
    }
    assert smoothing.of("tongue_tip", live=True) is None


def test_without_a_statement_nothing_is_smoothed():
    assert NO_SMOOTHING.of("tongue_tip", live=False) is None
    assert smoothing_from_toml({}) == NO_SMOOTHING
    assert smoothing_toml(NO_SMOOTHING) == {}


@pytest.mark.parametrize("name", ["carstens", "tardis", "haskins", "ema2wav", "mocha"])
def test_a_preset_has_a_filter_for_every_coil_recorded_and_live(name):
    smoothing, usual = PRESETS[name]
    assert usual
    for role in ("tongue_tip", "jaw", "head_left", "bite_front", "palate_probe"):
        recorded, live_one = smoothing.of(role, live=False), smoothing.of(role, live=True)
        assert recorded is not None and recorded.for_recordings
        assert live_one is not None and live_one.for_live
    assert smoothing_toml(smoothing) == {"preset": name}
    assert smoothing_from_toml({"preset": name}) == smoothing


def test_the_presets_are_the_fields_usual_values():
    assert str(PRESETS["carstens"][0].of("tongue_tip", live=False)) == "fir 40-50 Hz"
    assert str(PRESETS["carstens"][0].of("head_nose", live=False)) == "fir 5-15 Hz"
    assert str(PRESETS["tardis"][0].of("jaw", live=False)) == "butterworth 20 Hz order 5"
    assert str(PRESETS["ema2wav"][0].of("jaw", live=False)) == "butterworth 25 Hz order 4"


def test_the_live_filters_of_all_presets_are_late_by_a_few_frames_at_most():
    for smoothing, _ in PRESETS.values():
        for role in ("tongue_tip", "head_nose"):
            assert CausalSmoother([smoothing.of(role, live=True)], RATE_HZ).delays_s[0] < 0.01


def test_own_keys_are_put_over_the_presets():
    table = {"preset": "carstens", "recorded": {"references": "none"}, "live": {"tongue": "one-pole 15 Hz"}}
    smoothing = smoothing_from_toml(table)
    assert smoothing.of("head_nose", live=False) is None
    assert str(smoothing.of("tongue_tip", live=False)) == "fir 40-50 Hz"
    assert str(smoothing.of("tongue_tip", live=True)) == "one-pole 15 Hz"
    assert smoothing_toml(smoothing) == table


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"presets": "carstens"}, "unknown key 'presets'"),
        ({"preset": "carsten"}, "preset = 'carsten': expected one of carstens, tardis"),
        ({"preset": 3}, "preset = 3"),
        ({"recorded": "none"}, "recorded: expected keys below it"),
        ({"recorded": {"tongue": 20}}, "recorded.tongue = 20: expected a filter in quotes"),
        ({"recorded": {"toung": "none"}}, "recorded.toung: 'toung' is neither a role nor one of the groups"),
        ({"live": {"tongue": "fast"}}, "live.tongue: 'fast' is no filter"),
        ({"live": {"tongue": "median 5 frames"}}, "live.tongue: .* needs the frames to come"),
        ({"recorded": {"all": "one-pole 20 Hz"}}, "recorded.all: .* would make a recording late"),
    ],
)
def test_a_bad_table_is_refused_with_the_key_at_fault(table, complaint):
    with pytest.raises(InputError, match=complaint):
        smoothing_from_toml(table)


@pytest.mark.parametrize(
    ("text", "rate_hz", "complaint"),
    [
        ("butterworth 20 Hz order 5", 30.0, "needs more than 40 frames a second, but there are 30"),
        ("fir 40-50 Hz", 100.0, "needs more than 100 frames a second"),
        ("gaussian 8 ms", 0.0, "needs the frame rate"),
        ("gaussian 8 ms", math.nan, "needs the frame rate"),
        ("one-pole 20 Hz", 250.0, "is for live frames"),
    ],
)
def test_a_recording_that_a_filter_cannot_work_on_is_refused(text, rate_hz, complaint):
    with pytest.raises(InputError, match=complaint):
        smooth(np.zeros((10, 1, 3)), rate_hz, [parse_filter(text)])


@pytest.mark.parametrize(
    ("text", "rate_hz", "complaint"),
    [
        ("fir 40-50 Hz", 60.0, "needs more than 100 frames a second"),
        ("one-pole 20 Hz", 0.0, "needs the frame rate"),
        ("gaussian 8 ms", 250.0, "needs the frames to come"),
    ],
)
def test_a_live_run_that_a_filter_cannot_work_on_is_refused(text, rate_hz, complaint):
    with pytest.raises(InputError, match=complaint):
        CausalSmoother([parse_filter(text)], rate_hz)
