"""From raw frames to coils in the model frame: live what a recording gives, to the bit."""

import sys
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.tracker.filterwords import parse_filter
from tonguetrack.tracker.headcorrection import HeadReference, ReferenceState, correct, head_motion
from tonguetrack.tracker.preparation import Preparation
from tonguetrack.tracker.session import Alignment
from tonguetrack.tracker.simulation import HEAD_COILS, Simulation, simulate
from tonguetrack.tracker.smoothing import CausalSmoother, Smoothing

RATE_HZ = 250.0
HEAD = tuple(HEAD_COILS)
CHANNELS = (*HEAD, "tongue_tip", "tongue_blade", "tongue_back", "tongue_dorsum")
TRACKED = ("tongue_dorsum", "tongue_blade", "tongue_tip")
REST = np.array(list(HEAD_COILS.values()))
ALIGNMENT = Alignment(
    Rotation.from_euler("xyz", [5, 10, 15], degrees=True).as_matrix(), np.array([1.0, 2.0, 3.0])
)
PROJECTED = Alignment(ALIGNMENT.rotation, ALIGNMENT.translation_mm, midsagittal=True)
PICKED = np.array([CHANNELS.index(role) for role in TRACKED])
REFERENCES = np.arange(len(HEAD))


@cache
def moving_head() -> np.ndarray:
    """(500, channels, 3) mm with dropouts, a reference that slips, an outlier and a moment without any reference."""
    recording, _ = simulate(Simulation(("ə", "i"), CHANNELS, seconds=2, dropouts=0.05, head_motion=True))
    raw = recording.positions.copy()
    raw[100:200, 1] += [6.0, 4.0, 3.0]
    raw[250, 2] *= 3.0
    raw[300:310, : len(HEAD)] = np.nan
    raw[320, -1, 2] = np.inf
    raw.setflags(write=False)
    return raw


def prepared(
    alignment: Alignment = PROJECTED, head: HeadReference | None = None, smoothing: Smoothing | None = None
) -> Preparation:
    return Preparation(
        PICKED,
        alignment,
        TRACKED,
        head,
        None if head is None else REFERENCES,
        smoothing or Smoothing(),
        RATE_HZ,
    )


def at_rest(orientation: np.ndarray | None = None) -> HeadReference:
    return HeadReference(HEAD, REST, "test", orientation)


@pytest.mark.parametrize("head", [None, at_rest()], ids=["no head", "head"])
@pytest.mark.parametrize("alignment", [ALIGNMENT, PROJECTED], ids=["3-D", "mid-sagittal"])
def test_frame_by_frame_and_over_a_recording_it_is_the_same_to_the_bit(alignment, head):
    raw = moving_head()
    live = prepared(alignment, head)
    recorded = prepared(alignment, head).all_frames(raw, RATE_HZ)
    np.testing.assert_array_equal([live.frame(frame).copy() for frame in raw], recorded)
    # After a reset it is as if no frame had ever come.
    live.reset()
    np.testing.assert_array_equal([live.frame(frame).copy() for frame in raw[:50]], recorded[:50])


def test_what_comes_out_is_the_still_head_turned_and_moved_into_the_model_frame():
    raw = moving_head()
    still = correct(raw, head_motion(raw[:, REFERENCES], at_rest(), RATE_HZ))[:, PICKED]
    still[~np.isfinite(still).all(axis=2)] = np.nan
    expected = still @ ALIGNMENT.rotation.T + ALIGNMENT.translation_mm
    np.testing.assert_allclose(prepared(ALIGNMENT, at_rest()).all_frames(raw, RATE_HZ), expected, atol=1e-9)


def test_live_the_coils_and_the_references_are_smoothed_before_the_head_is_taken_out():
    raw = moving_head()
    chosen = Smoothing(
        live={
            "tongue": parse_filter("one-pole 30 Hz"),
            "tongue_tip": parse_filter("fir 40-50 Hz"),
            "references": parse_filter("one-euro 2 Hz beta 0.01"),
        }
    )
    filters = [chosen.of(role, live=True) for role in CHANNELS]
    smoother = CausalSmoother(filters, RATE_HZ)
    smooth = np.empty((len(raw), len(filters), 3))
    for frame, out in zip(raw, smooth, strict=True):
        smoother.step(frame.copy(), 0.004, out)
    expected = prepared(head=at_rest()).all_frames(smooth, RATE_HZ)
    preparation = prepared(head=at_rest(), smoothing=chosen)
    np.testing.assert_array_equal([preparation.frame(frame, 0.004).copy() for frame in raw], expected)


def test_an_orientation_that_does_not_come_is_not_taken_from_an_earlier_frame():
    """One 6-D reference: with its orientation the head's turn is known, without it is the last one."""
    orientation = np.full((len(HEAD), 4), np.nan)
    orientation[0] = [1.0, 0.0, 0.0, 0.0]
    raw = np.full((8, 3), np.nan)
    raw[0], raw[PICKED] = REST[0], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]
    turned = np.full((8, 4), np.nan)
    turned[0] = Rotation.from_euler("z", 90, degrees=True).as_quat()[[3, 0, 1, 2]]
    preparation = prepared(Alignment(), at_rest(orientation))
    assert np.isnan(preparation.frame(raw)).all()
    first = preparation.frame(raw, 0.0, turned).copy()
    np.testing.assert_allclose(
        first - REST[0], (raw[PICKED] - REST[0])[:, [1, 0, 2]] * [1, -1, 1], atol=1e-12
    )
    assert preparation.head_states["head_nose"] == ReferenceState.OK
    np.testing.assert_allclose(preparation.frame(raw), first, atol=1e-12)  # the last turn
    preparation.reset()
    assert np.isnan(preparation.frame(raw)).all()


def test_any_kind_of_array_is_prepared_alike():
    raw = moving_head()[:20]
    wide = np.concatenate([raw, raw], axis=1)  # a source with more channels than are wanted
    usual = prepared(head=at_rest())
    expected = [usual.frame(frame.copy()).copy() for frame in raw]
    for kind in (raw, wide, wide[:, :8], np.asfortranarray(raw), raw.astype(">f8")):
        preparation = prepared(head=at_rest())
        np.testing.assert_array_equal([preparation.frame(frame).copy() for frame in kind], expected)


def test_a_frame_of_too_few_coils_is_refused():
    with pytest.raises(InputError, match="a frame has 7 coils, but channel 8 is to be tracked"):
        prepared().frame(np.zeros((7, 3)))


def test_no_memory_is_taken_frame_by_frame():
    raw = moving_head()
    preparation = prepared(head=at_rest(), smoothing=Smoothing(preset="carstens"))
    for frame in raw:
        preparation.frame(frame, 0.004)
    before = sys.getallocatedblocks()
    for frame in raw:
        preparation.frame(frame, 0.004)
    assert sys.getallocatedblocks() - before < 50
