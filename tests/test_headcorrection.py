"""The head's motion from reference coils: exact without noise, steady when references fail, honest about it."""

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.drivers import open_recording
from tonguetrack.tracker.headcorrection import (
    OFF_LINE_MM,
    TOLERANCE_MM,
    HeadCorrector,
    HeadReference,
    HeadStatus,
    ReferenceState,
    correct,
    follow_head,
    head_from_toml,
    head_motion,
    head_toml,
    rest_reference,
)
from tonguetrack.tracker.simulation import HEAD_COILS, Simulation, simulate

RATE_HZ = 250.0
ROLES = tuple(HEAD_COILS)
THREE = ROLES[:3]
AT_REST = np.array(list(HEAD_COILS.values()))
OK, MISSING, SLIPPED = ReferenceState.OK, ReferenceState.MISSING, ReferenceState.SLIPPED


def wandering(frames: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A head that nods and turns by some 10 degrees and drifts by some cm: rotations, translations."""
    random = np.random.default_rng(seed)
    times = np.arange(frames)[:, None] / RATE_HZ
    turns = 10 * np.sin(times * random.uniform(1, 3, 3) + random.uniform(0, 6, 3))
    ways = [40.0, -25.0, 110.0] + 20 * np.sin(times * random.uniform(1, 3, 3) + random.uniform(0, 6, 3))
    return Rotation.from_euler("xyz", turns, degrees=True).as_matrix(), ways


def moved(points: np.ndarray, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """points (k, 3), or (frames, k, 3), on the moving head: (frames, k, 3)."""
    points = np.broadcast_to(points, (len(rotations), *points.shape[-2:]))
    return np.einsum("tab,tkb->tka", rotations, points) + translations[:, None]


def reference(roles: tuple[str, ...] = ROLES) -> HeadReference:
    return HeadReference(roles, AT_REST[: len(roles)], "test")


def apart_degrees(rotations: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees((Rotation.from_matrix(rotations).inv() * Rotation.from_matrix(truth)).magnitude())


# Exactness -------------------------------------------------------------------------------------------


def shapes(least: int = 3) -> st.SearchStrategy[np.ndarray]:
    """Reference coils of any shape that is not nearly a line."""
    place = st.tuples(*[st.floats(-150, 150)] * 3)
    return st.lists(place, min_size=least, max_size=6).map(np.array).filter(spans_a_plane)


def spans_a_plane(points: np.ndarray) -> bool:
    try:
        HeadReference(tuple("abcdef"[: len(points)]), points, "test")
    except InputError:
        return False
    return True


@given(shapes(), st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_any_rigid_motion_of_any_shape_is_found_exactly(shape, seed):
    random = np.random.default_rng(seed)
    rotations = Rotation.random(5, random_state=random).as_matrix()
    translations = random.uniform(-300, 300, (5, 3))
    motion = head_motion(
        moved(shape, rotations, translations), HeadReference(tuple("abcdef"[: len(shape)]), shape, "test")
    )
    on_the_tongue = random.uniform(-100, 100, (7, 3))
    back = correct(moved(on_the_tongue, rotations, translations), motion)
    np.testing.assert_allclose(back, np.broadcast_to(on_the_tongue, back.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(motion.rotations), 1.0, atol=1e-12)
    assert (motion.statuses == HeadStatus.OK).all()
    assert motion.residuals_mm.max() < 1e-9


@given(shapes(), st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_the_motion_of_noisy_references_is_the_best_one_of_all(shape, seed):
    """Against scipy's own fit. With equal weights: the noise is small beside the tolerance, so all weigh the same."""
    random = np.random.default_rng(seed)
    now = shape + random.normal(scale=1e-3, size=shape.shape)
    motion = head_motion(now[None], HeadReference(tuple("abcdef"[: len(shape)]), shape, "test"))
    best, _ = Rotation.align_vectors(now - now.mean(axis=0), shape - shape.mean(axis=0))
    assert apart_degrees(motion.rotations[0], best.as_matrix()) < 1e-6
    np.testing.assert_allclose(
        shape.mean(axis=0) @ motion.rotations[0].T + motion.translations[0], now.mean(axis=0), atol=1e-5
    )


def test_a_real_sweep_moved_by_a_known_motion_comes_back(reference_data):
    """The sweep's first two coils are head references; two more coils are held still to serve as such."""
    path = reference_data / "recordings" / "ag501_reidy" / "0021.pos"
    sweep = open_recording(path).positions[:, :8]
    held = np.broadcast_to(sweep[0, [0, 1, 5, 7]], (len(sweep), 4, 3))
    rotations, translations = wandering(len(sweep))
    motion = head_motion(
        moved(held, rotations, translations), HeadReference(ROLES, held[0].copy(), "frame 0")
    )
    np.testing.assert_allclose(correct(moved(sweep, rotations, translations), motion), sweep, atol=1e-6)


def test_a_real_sweep_is_the_same_however_the_head_moved(reference_data):
    """With the references' own noise, too: what is left of it does not depend on the motion."""
    path = reference_data / "recordings" / "rticulate_ag500" / "0025.pos"
    sweep = open_recording(path).positions
    used = [0, 5, 8, 3]
    at_rest = rest_reference(sweep[:, used], ROLES, "the sweep")
    rotations, translations = wandering(len(sweep))
    elsewhere = moved(sweep, rotations, translations)
    still = correct(sweep, head_motion(sweep[:, used], at_rest))
    np.testing.assert_allclose(correct(elsewhere, head_motion(elsewhere[:, used], at_rest)), still, atol=1e-6)
    assert np.abs(still - sweep).max() < 1.0


def test_frame_by_frame_and_over_a_recording_it_is_the_same_to_the_bit():
    recording, _ = simulated(seconds=4, dropouts=0.1)
    now = recording.positions.copy()
    now[300:500, 1] += [6.0, 4.0, 3.0]
    motion = head_motion(now, reference())
    corrector = HeadCorrector(reference())
    references, *_, live, states = corrector.arrays
    for repeat in range(2):
        for frame in range(len(now)):
            references[:] = now[frame]
            status = follow_head(*corrector.arrays)
            np.testing.assert_array_equal(live[:3], motion.rotations[frame])
            np.testing.assert_array_equal(live[3], motion.translations[frame])
            np.testing.assert_array_equal(live[4, 1], motion.residuals_mm[frame])
            np.testing.assert_array_equal(states, motion.states[frame])
            assert status == motion.statuses[frame]
        corrector.reset()
    assert len(np.unique(motion.statuses)) > 1


# References that fail --------------------------------------------------------------------------------


@cache
def simulated(seconds: float = 6.0, noise_mm: float = 0.3, dropouts: float = 0.0, roles=ROLES):
    return simulate(
        Simulation(("ə", "i"), roles, seconds=seconds, noise_mm=noise_mm, dropouts=dropouts, head_motion=True)
    )


def errors(motion, truth) -> tuple[np.ndarray, np.ndarray]:
    """Degrees, and mm at a tongue's place, by frame."""
    tongue = np.broadcast_to([0.0, 30.0, 0.0], (len(motion.rotations), 1, 3))
    true = moved(tongue, truth.head_rotation, truth.head_translation_mm)
    found = moved(tongue, motion.rotations, motion.translations)
    return apart_degrees(motion.rotations, truth.head_rotation), np.linalg.norm(found - true, axis=2)[:, 0]


def test_noise_of_the_references_moves_the_tongue_by_no_more_than_itself():
    recording, truth = simulated()
    motion = head_motion(recording.positions, reference())
    degrees, mm = errors(motion, truth)
    assert (motion.states == OK).all()
    assert np.sqrt(np.mean(degrees**2)) < 0.4
    assert np.sqrt(np.mean(mm**2)) < 0.4


@pytest.mark.parametrize("roles", [ROLES, THREE])
def test_dropouts_of_single_references_do_not_jerk_the_head(roles):
    recording, truth = simulated(dropouts=0.05, roles=roles)
    motion = head_motion(recording.positions, reference(roles))
    degrees, mm = errors(motion, truth)
    np.testing.assert_array_equal(motion.states == MISSING, ~recording.valid())
    seen = motion.statuses != HeadStatus.LOST
    assert seen[20:].all()
    if roles == ROLES:
        assert np.isin(motion.statuses[seen & (recording.valid().sum(axis=1) >= 3)], [HeadStatus.OK]).all()
    assert np.quantile(degrees[seen], 0.99) < 2.0
    assert np.quantile(mm[seen], 0.99) < 1.5


@given(st.integers(0, 3), st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda way: np.linalg.norm(way) > 0.1))
@settings(max_examples=60, deadline=None)
def test_of_four_references_one_that_slips_anywhere_is_flagged_left_out_and_taken_back(coil, way):
    recording, truth = simulated()
    begin, end, back = 600, 850, 850 + int(0.25 * RATE_HZ)
    slip = 8.0 * np.array(way) / np.linalg.norm(way)
    now = recording.positions.copy()
    now[begin:end, coil] += truth.head_rotation[begin:end] @ slip
    motion = head_motion(now, reference())
    assert (motion.states[:, [i for i in range(4) if i != coil]] == OK).all()
    assert (motion.states[:begin, coil] == OK).all()
    assert (motion.states[begin:end, coil] == SLIPPED).all()
    assert (motion.states[end : end + int(0.19 * RATE_HZ), coil] == SLIPPED).all()
    assert (motion.states[back:, coil] == OK).all()
    assert (motion.statuses == HeadStatus.OK).all()
    degrees, mm = errors(motion, truth)
    assert degrees.max() < 2.5
    assert mm.max() < 2.5


def test_of_three_references_it_is_the_one_whose_distances_changed_while_the_others_did_not():
    recording, truth = simulated(roles=THREE)
    begin, end = 600, 850
    now = recording.positions.copy()
    now[begin:end, 0] += truth.head_rotation[begin:end] @ [0.0, -8.0, 0.0]  # the nose, away from both ears
    motion = head_motion(now, reference(THREE))
    assert (motion.states[:, 1:] == OK).all()
    assert (motion.states[begin:end, 0] == SLIPPED).all()
    assert (motion.statuses[begin:end] == HeadStatus.TWO_LEFT).all()
    assert (motion.statuses[end + int(0.3 * RATE_HZ) :] == HeadStatus.OK).all()
    assert (motion.states[end + int(0.3 * RATE_HZ) :, 0] == OK).all()


def test_where_one_distance_of_three_changes_the_last_motion_tells_which_reference_slipped():
    """The nose slips across its distance to the left ear, so that to the right ear alone changes."""
    frames = 500
    rotations, translations = wandering(frames)
    at_rest = AT_REST[:3]
    now = moved(at_rest, rotations, translations)
    to_left = at_rest[1] - at_rest[0]
    to_right = at_rest[2] - at_rest[0]
    across = to_right - to_left * (to_right @ to_left) / (to_left @ to_left)
    slip = -8.0 * across / np.linalg.norm(across)
    now[200:, 0] += rotations[200:] @ slip
    changes = [abs(np.linalg.norm(at_rest[0] + slip - at_rest[i]) - np.linalg.norm(at_rest[0] - at_rest[i])) for i in (1, 2)]  # fmt: skip
    assert changes[0] < 0.5 * TOLERANCE_MM and changes[1] > TOLERANCE_MM
    motion = head_motion(now, reference(THREE))
    assert (motion.states[200:] == [SLIPPED, OK, OK]).all()


@pytest.mark.parametrize("roles", [ROLES, THREE])
def test_a_reference_that_dies_is_done_without(roles):
    recording, truth = simulated(roles=roles)
    now = recording.positions.copy()
    now[750:, 2] = np.nan
    motion = head_motion(now, reference(roles))
    degrees, mm = errors(motion, truth)
    assert (motion.states[750:, 2] == MISSING).all()
    if roles == ROLES:
        assert (motion.statuses == HeadStatus.OK).all()
        assert mm.max() < 2.0
    else:
        assert (motion.statuses[750:] == HeadStatus.TWO_LEFT).all()
        # What is lost is the rotation about one axis: at most what the head turns, 6 degrees either way.
        assert degrees[750:].max() < 13.0


def test_two_references_carry_the_motion_apart_from_the_turn_about_their_axis():
    frames = 400
    rotations, translations = wandering(frames)
    now = moved(AT_REST[:3], rotations, translations)
    now[200:, 0] = np.nan
    motion = head_motion(now, reference(THREE))
    assert (motion.statuses[200:] == HeadStatus.TWO_LEFT).all()
    ears = correct(now, motion)[:, 1:]
    np.testing.assert_allclose(ears, np.broadcast_to(AT_REST[1:3], ears.shape), atol=1e-9)
    np.testing.assert_allclose(motion.rotations @ motion.rotations.swapaxes(1, 2), np.broadcast_to(np.eye(3), (frames, 3, 3)), atol=1e-12)  # fmt: skip
    # A head that turns across that axis alone is followed exactly.
    across = Rotation.from_rotvec(
        np.radians(np.linspace(0, 20, frames))[:, None] * [0.0, 0.0, 1.0]
    ).as_matrix()
    now = moved(AT_REST[:3], across, translations)
    now[200:, 0] = np.nan
    motion = head_motion(now, reference(THREE))
    assert apart_degrees(motion.rotations, across).max() < 1e-6


def test_one_reference_carries_the_translation_and_none_holds_the_motion():
    rotations, translations = wandering(300)
    now = moved(AT_REST, rotations, translations)
    now[100:, 1:] = np.nan
    now[200:, 0] = np.nan
    motion = head_motion(now, reference())
    assert (motion.statuses[:100] == HeadStatus.OK).all()
    assert (motion.statuses[100:200] == HeadStatus.ONE_LEFT).all()
    assert (motion.statuses[200:] == HeadStatus.HELD).all()
    np.testing.assert_array_equal(motion.rotations[100:], np.broadcast_to(motion.rotations[99], (200, 3, 3)))
    nose = correct(now, motion)[100:200, 0]
    np.testing.assert_allclose(nose, np.broadcast_to(AT_REST[0], nose.shape), atol=1e-9)
    np.testing.assert_array_equal(
        motion.translations[200:], np.broadcast_to(motion.translations[199], (100, 3))
    )
    assert np.isnan(motion.residuals_mm[200:]).all()


def test_before_the_rotation_was_ever_determined_the_motion_is_not_known():
    rotations, translations = wandering(60)
    now = moved(AT_REST, rotations, translations)
    now[:30, 2:] = np.nan
    motion = head_motion(now, reference())
    assert (motion.statuses[:30] == HeadStatus.LOST).all()
    assert np.isnan(correct(now, motion)[:30]).all()
    assert (motion.statuses[30:] == HeadStatus.OK).all()


def test_an_outlier_costs_its_own_frame_and_no_more():
    recording, truth = simulated(seconds=2)
    now = recording.positions.copy()
    now[100:400:50, 3] += [0.0, -200.0, 300.0]
    motion = head_motion(now, reference())
    assert (motion.states[100:400:50, 3] == SLIPPED).all()
    assert np.count_nonzero(motion.states) == 6
    assert errors(motion, truth)[1].max() < 2.0


def test_a_slow_slip_does_not_jerk_the_head():
    """The upper incisor's coil creeps off by 12 mm: where it is left out the tongue steps by less than 1 mm."""
    frames = 1000
    now = np.broadcast_to(AT_REST, (frames, 4, 3)).copy()
    now[:, 3, 2] -= 12.0 * np.clip(np.arange(frames) / 500 - 0.2, 0, 1)
    motion = head_motion(now, reference())
    assert (motion.states[-1] == [OK, OK, OK, SLIPPED]).all()
    tongue = moved(np.array([[0.0, 30.0, 0.0]]), motion.rotations, motion.translations)
    assert np.linalg.norm(np.diff(tongue, axis=0), axis=2).max() < 1.0
    np.testing.assert_allclose(tongue[-1], [[0.0, 30.0, 0.0]], atol=1e-9)


def test_noise_at_rest_widens_the_tolerance():
    noisy = HeadReference(ROLES, AT_REST, "test", noise_mm=1.5)
    assert noisy.tolerance_mm == 7.5
    assert reference().tolerance_mm == TOLERANCE_MM
    now = np.broadcast_to(AT_REST, (50, 4, 3)).copy()
    now[:, 3, 2] -= 6.0
    assert (head_motion(now, noisy).states == OK).all()
    assert (head_motion(now, reference()).states[:, 3] == SLIPPED).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_whatever_comes_the_motion_is_rigid_or_not_known(seed):
    random = np.random.default_rng(seed)
    count = int(random.integers(3, 7))
    shape = random.uniform(-80, 80, (count, 3))
    assume(spans_a_plane(shape))
    now = shape + random.choice([0.0, 1.0, 30.0, 1e8], (80, count, 1)) * random.normal(size=(80, count, 3))
    now[random.random((80, count)) < 0.3] = np.nan
    now[random.random((80, count)) < 0.05] = np.inf
    if random.random() < 0.3:
        now[:, 0] = now[:, 1]
    motion = head_motion(now, HeadReference(tuple("abcdef"[:count]), shape, "test", noise_mm=1.0))
    known = motion.statuses != HeadStatus.LOST
    identity = np.broadcast_to(np.eye(3), (80, 3, 3))[known]
    turned = motion.rotations[known]
    np.testing.assert_allclose(turned @ turned.swapaxes(1, 2), identity, atol=1e-9)
    assert np.isfinite(motion.translations[known]).all()
    assert np.isnan(motion.rotations[~known]).all()
    counted = (motion.states == OK).sum(axis=1)
    np.testing.assert_array_equal(np.isnan(motion.residuals_mm), (counted == 0) | ~known)


# 6-D references --------------------------------------------------------------------------------------


def as_quaternions(rotations: Rotation) -> np.ndarray:
    return rotations.as_quat()[..., [3, 0, 1, 2]]


def one_6d_coil(seed: int, frames: int):
    """A coil mounted anyhow at any place: its place, its mounting, and its quaternions (frames, 1, 4) on a moving head."""
    random = np.random.default_rng(seed)
    rotations, translations = wandering(frames, seed)
    mounting = Rotation.random(random_state=random)
    turned = as_quaternions(Rotation.from_matrix(rotations) * mounting)
    signs = random.choice([-1.0, 1.0], (frames, 1))  # q and -q are the same orientation
    return random.uniform(-100, 100, (1, 3)), mounting, (turned * signs)[:, None], rotations, translations


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_one_6d_reference_gives_the_motion_by_itself(seed):
    place, mounting, turned, rotations, translations = one_6d_coil(seed, 20)
    at_rest = HeadReference(("head_nose",), place, "test", as_quaternions(mounting)[None])
    motion = head_motion(moved(place, rotations, translations), at_rest, quaternions=turned)
    np.testing.assert_allclose(motion.rotations, rotations, atol=1e-9)
    np.testing.assert_allclose(motion.translations, translations, atol=1e-9)
    assert (motion.statuses == HeadStatus.OK).all()


def test_a_6d_reference_that_loses_its_orientation_keeps_the_translation():
    place, mounting, turned, rotations, translations = one_6d_coil(5, 100)
    at_rest = HeadReference(("head_nose",), place, "test", as_quaternions(mounting)[None])
    turned[50:] = np.nan
    turned[80:] = 0.0  # what some devices send for missing
    now = moved(place, rotations, translations)
    motion = head_motion(now, at_rest, quaternions=turned)
    assert (motion.statuses == [HeadStatus.OK] * 50 + [HeadStatus.ONE_LEFT] * 50).all()
    np.testing.assert_allclose(correct(now, motion), np.broadcast_to(place, now.shape), atol=1e-9)


def test_a_6d_reference_among_three_steps_in_when_the_others_fail():
    rotations, translations = wandering(100)
    now = moved(AT_REST[:3], rotations, translations)
    now[50:, 1:] = np.nan
    orientation = np.full((3, 4), np.nan)
    orientation[0] = [1.0, 0.0, 0.0, 0.0]
    turned = np.full((100, 3, 4), np.nan)
    turned[:, 0] = as_quaternions(Rotation.from_matrix(rotations))
    motion = head_motion(now, HeadReference(THREE, AT_REST[:3], "test", orientation), quaternions=turned)
    assert (motion.statuses == HeadStatus.OK).all()
    np.testing.assert_allclose(motion.rotations, rotations, atol=1e-9)


def test_the_6d_sensor_of_a_real_sweep_turns_as_the_points_on_the_head_do(reference_data):
    """Sensor 1 of a Wave is six-dimensional; it and four more sit on the head, which turns by 5 degrees meanwhile."""
    sweep = open_recording(reference_data / "recordings" / "ndi_wave_ematoblender" / "Example3.tsv")
    head = [sweep.coils.index(f"Sensor {number}") for number in (1, 9, 14, 15, 16)]
    roles = tuple(f"head_{index}" for index in head)
    points = head_motion(
        sweep.positions[:, head], rest_reference(sweep.positions[:20, head], roles, "points")
    )
    one, turned = sweep.positions[:, head[:1]], sweep.quaternions[:, head[:1]]
    sensor = head_motion(one, rest_reference(one[:20], roles[:1], "6-D", turned[:20]), quaternions=turned)
    end = slice(-4, None)  # when the head turns; single frames of the points are off by 2 degrees
    assert apart_degrees(points.rotations[end], np.broadcast_to(np.eye(3), (4, 3, 3))).min() > 3.0
    assert np.median(apart_degrees(sensor.rotations[end], points.rotations[end])) < 0.8


# The rest interval -----------------------------------------------------------------------------------


def at_rest_with(noise_mm: float = 0.3, frames: int = 500, seed: int = 1) -> np.ndarray:
    """Two seconds of a head that is still."""
    return AT_REST + np.random.default_rng(seed).normal(scale=noise_mm, size=(frames, 4, 3))


def test_the_rest_reference_is_where_the_coils_are_while_the_head_is_still():
    found = rest_reference(at_rest_with(), ROLES, "rest 0:2")
    np.testing.assert_allclose(found.positions_mm, AT_REST, atol=0.1)
    assert found.noise_mm == pytest.approx(0.3 * np.sqrt(2), rel=0.1)
    assert found.roles == ROLES and found.source == "rest 0:2" and found.orientation is None


def test_outliers_gaps_and_a_slip_within_the_rest_interval_do_no_harm():
    rest = at_rest_with()
    rest[100:220, 3] += [0.0, 0.0, -8.0]
    rest[::9, 1] += [90.0, 0.0, 0.0]
    rest[300:330, 2] = np.nan
    found = rest_reference(rest, ROLES, "rest")
    np.testing.assert_allclose(found.positions_mm, AT_REST, atol=0.15)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_the_rest_reference_of_any_data_is_whole_or_refused(seed):
    random = np.random.default_rng(seed)
    rest = at_rest_with(0.3, int(random.integers(1, 40)), seed)
    rest += random.choice([0.0, 0.0, 0.0, 3.0, 30.0], rest.shape[:2])[:, :, None] * random.normal(
        size=rest.shape
    )
    rest[random.random(rest.shape[:2]) < 0.2] = np.nan
    try:
        found = rest_reference(rest, ROLES, "rest")
    except InputError:
        return
    assert np.isfinite(found.positions_mm).all()
    assert head_motion(found.positions_mm[None], found).statuses == HeadStatus.OK


def test_the_shape_at_rest_is_exact_although_the_head_moves():
    rotations, translations = wandering(300)
    found = rest_reference(moved(AT_REST, rotations, translations), ROLES, "rest")
    apart = np.linalg.norm(found.positions_mm[:, None] - found.positions_mm, axis=2)
    np.testing.assert_allclose(apart, np.linalg.norm(AT_REST[:, None] - AT_REST, axis=2), atol=1e-9)
    assert np.linalg.norm(found.positions_mm.mean(axis=0) - np.median(moved(AT_REST, rotations, translations).mean(axis=1), axis=0)) < 1.0  # fmt: skip


def test_a_6d_reference_at_rest_and_its_motion_agree():
    place, _, turned, rotations, translations = one_6d_coil(8, 200)
    now = moved(place, rotations, translations)
    found = rest_reference(now, ("head_nose",), "rest", turned)
    motion = head_motion(now, found, quaternions=turned)
    on_the_tongue = moved(np.array([[0.0, 30.0, 0.0]]), rotations, translations)
    still = correct(on_the_tongue, motion)
    np.testing.assert_allclose(still, np.broadcast_to(still[0], still.shape), atol=1e-9)
    np.testing.assert_allclose(motion.residuals_mm, 0.0, atol=1e-9)


def test_two_references_are_too_few_and_the_sentence_says_what_to_do():
    with pytest.raises(
        InputError, match=r"rest 0:2.*needs three reference coils.*there are 2 \(head_nose, head_left\)"
    ):
        rest_reference(at_rest_with()[:, :2], ROLES[:2], "rest 0:2")


def test_references_on_one_line_are_refused():
    line = np.linspace([-60.0, 80.0, 30.0], [70.0, 90.0, 30.0], 3) + [
        [0, 0, 0],
        [0, OFF_LINE_MM - 1.0, 0],
        [0, 0, 0],
    ]
    with pytest.raises(InputError, match="lie on one line to within 10 mm"):
        rest_reference(np.broadcast_to(line, (50, 3, 3)), THREE, "rest")
    with pytest.raises(InputError, match="lie on one line"):
        HeadReference(THREE, np.zeros((3, 3)), "test")


def test_a_reference_that_is_never_there_is_named():
    rest = at_rest_with()
    rest[:, 2] = np.nan
    with pytest.raises(InputError, match="rest: the reference coil head_right is never there"):
        rest_reference(rest, ROLES, "rest")


def test_references_that_are_never_there_together_are_refused_with_their_shares():
    rest = at_rest_with()
    rest[:100, 2] = np.nan
    rest[100:, 3] = np.nan
    with pytest.raises(
        InputError, match="never there together .*head_right in 80 %, head_upper_incisor in 20 %"
    ):
        rest_reference(rest, ROLES, "rest")


def test_references_that_move_against_each_other_are_refused():
    rest = at_rest_with()
    rest[:, [0, 3]] += (
        10.0 * np.sin(np.arange(500) / 20)[:, None, None] * [[[0.0, 1.0, 0.0], [0.0, -1.0, 1.0]]]
    )
    with pytest.raises(InputError, match="move against each other"):
        rest_reference(rest, ROLES, "rest")


# The session's table ---------------------------------------------------------------------------------


def test_what_is_written_is_read_back_unchanged():
    import tomllib

    import tomlkit

    plain = rest_reference(at_rest_with(), ROLES, "rest 0:2 of sweep 12")
    _, mounting, *_ = one_6d_coil(3, 2)
    orientation = np.full((4, 4), np.nan)
    orientation[1] = as_quaternions(mounting)
    for written in (plain, HeadReference(ROLES, AT_REST, "a 6-D one among them", orientation)):
        read = head_from_toml(tomllib.loads(tomlkit.dumps({"head": head_toml(written)}))["head"])
        assert (read.roles, read.source, read.noise_mm) == (written.roles, written.source, written.noise_mm)
        np.testing.assert_array_equal(read.positions_mm, written.positions_mm)
        if written.orientation is None:
            assert read.orientation is None
        else:
            np.testing.assert_array_equal(read.orientation, written.orientation)


GOOD = {role: row.tolist() for role, row in zip(ROLES, AT_REST, strict=True)}


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"rest": GOOD}, r"\[head\] has the unknown key 'rest'; expected source, noise_mm, rest_mm, orientation"),
        ({"source": "x"}, r"needs a table \[head.rest_mm\] of the form role"),
        ({"rest_mm": {}}, r"needs a table \[head.rest_mm\]"),
        ({"rest_mm": [1.0]}, r"needs a table \[head.rest_mm\]"),
        ({"rest_mm": {**GOOD, "head_nose": [1.0, 2.0]}}, r"\[head.rest_mm\] head_nose: expected a list of 3 numbers"),
        ({"rest_mm": {**GOOD, "head_nose": [1.0, 2.0, float("nan")]}}, "head_nose: expected a list of 3 numbers"),
        ({"rest_mm": {**GOOD, "head_nose": [1.0, 2.0, True]}}, "head_nose: expected a list of 3 numbers"),
        ({"rest_mm": {**GOOD, "head_nose": [1.0, 2.0, 10**400]}}, "head_nose: expected a list of 3 numbers"),
        ({"rest_mm": GOOD, "source": 3}, r"\[head\] source = 3: expected text in quotes"),
        ({"rest_mm": GOOD, "noise_mm": -1.0}, r"noise_mm = -1.0: expected a number"),
        ({"rest_mm": GOOD, "noise_mm": float("nan")}, "noise_mm = nan: expected a number"),
        ({"rest_mm": GOOD, "orientation": {"jaw": [1, 0, 0, 0]}}, "names jaw, which has no position"),
        ({"rest_mm": GOOD, "orientation": {"head_nose": [0, 0, 0, 0]}}, "head_nose is zero"),
        ({"rest_mm": {"head_nose": [0, 0, 0], "head_left": [1, 2, 3]}}, "needs three reference coils"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_with_the_key_at_fault(table, complaint):
    with pytest.raises(InputError, match=complaint):
        head_from_toml(table)
