"""Procrustes alignment of palates, and tongues that follow them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.model.procrustes import RigidMotion, carried_over, procrustes, rigid_motion, upright


def palate(seed: int = 0) -> np.ndarray:
    """A vault of 40 points, mm."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(-15, 15, 40), random.uniform(0, 30, 40)
    return np.column_stack([x, y, 12 - 0.05 * x**2 - 0.01 * (y - 15) ** 2])


def somewhere(seed: int) -> RigidMotion:
    random = np.random.default_rng(seed)
    return RigidMotion(Rotation.random(random_state=seed).as_matrix(), random.normal(scale=50, size=3))


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_a_rigid_motion_is_recovered(seed):
    motion, points = somewhere(seed), palate(seed)
    found = rigid_motion(points, motion.apply(points))
    np.testing.assert_allclose(found.rotation, motion.rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, motion.shift, atol=1e-7)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_two_motions_after_each_other_are_one(seed):
    first, second, points = somewhere(seed), somewhere(seed + 1), palate()
    np.testing.assert_allclose(
        second.after(first).apply(points), second.apply(first.apply(points)), atol=1e-9
    )


def test_a_mirror_image_is_turned_never_mirrored():
    points = palate() * [1, 1, 3]
    points[:, 0] += 0.2 * points[:, 1]
    found = rigid_motion(points, points * [-1, 1, 1])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_copies_of_one_palate_coincide_wherever_their_heads_were():
    shapes = np.array([somewhere(seed).apply(palate()) for seed in range(6)])
    found = procrustes(shapes, palate())
    np.testing.assert_allclose(found.shapes, np.broadcast_to(palate(), shapes.shape), atol=1e-8)


def test_sizes_are_kept():
    sizes = np.array([0.8, 1.0, 1.3])
    found = procrustes(np.array([size * palate() for size in sizes]), palate())
    extents = [np.linalg.norm(shape - shape.mean(axis=0)) for shape in found.shapes]
    np.testing.assert_allclose(np.array(extents) / extents[1], sizes)


@pytest.fixture()
def speakers():
    """Five palates that differ, in heads that differ."""
    random = np.random.default_rng(1)
    own = palate() + random.normal(scale=1.0, size=(5, 40, 3))
    return own, np.array([somewhere(seed).apply(shape) for seed, shape in enumerate(own)])


def test_no_single_motion_brings_a_palate_nearer_to_the_mean(speakers):
    found = procrustes(speakers[1], palate(), iterations=200)
    np.testing.assert_allclose(found.shapes.mean(axis=0), found.mean, atol=1e-6)
    for shape in found.shapes:
        best = rigid_motion(shape, found.mean)
        np.testing.assert_allclose(best.apply(shape), shape, atol=1e-9)


def test_where_the_heads_were_does_not_matter(speakers):
    one, other = (procrustes(shapes, palate(), iterations=200) for shapes in speakers)
    np.testing.assert_allclose(one.shapes, other.shapes, atol=1e-5)


def test_the_mean_lies_in_the_frame_that_was_asked_for(speakers):
    moved = somewhere(99)
    one, other = procrustes(speakers[1], palate()), procrustes(speakers[1], moved.apply(palate()))
    np.testing.assert_allclose(moved.apply(one.shapes), other.shapes, atol=1e-6)
    np.testing.assert_allclose(rigid_motion(one.mean, palate()).rotation, np.eye(3), atol=1e-9)


def test_tongues_follow_their_palates_and_keep_what_they_do(speakers):
    """Scans of two speakers with moved heads: afterwards a tongue stands to its palate as before, and speakers agree."""
    own, shapes = speakers
    aligned = procrustes(shapes, palate())
    tongues = np.random.default_rng(2).normal(scale=20, size=(5, 30, 3))
    owners = [0, 0, 3]
    heads = [somewhere(50 + scan) for scan in range(3)]
    found = carried_over(
        np.array([head.apply(own[i]) for head, i in zip(heads, owners, strict=True)]), owners, aligned.shapes
    )
    moved = [
        motion.apply(head.apply(tongues[i])) for motion, head, i in zip(found, heads, owners, strict=True)
    ]
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-8)  # one tongue in two scans
    for place, owner in zip(moved, owners, strict=True):
        before = np.linalg.norm(tongues[owner][:, None] - own[owner], axis=2)
        after = np.linalg.norm(place[:, None] - aligned.shapes[owner], axis=2)
        np.testing.assert_allclose(after, before, atol=1e-7)


def test_what_does_not_tell_how_it_is_turned_is_refused():
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    broken = np.where(np.arange(40)[:, None] == 7, np.nan, palate())
    for shapes, words in (
        (line[None], "a point or a line"),
        (np.ones((1, 5, 3)), "a point or a line"),
        (broken[None], "shape 1 has points that are not numbers"),
        (np.zeros((0, 5, 3)), "cannot be aligned"),
    ):
        with pytest.raises(InputError, match=words):
            procrustes(shapes, line)
    with pytest.raises(InputError, match="they must correspond"):
        procrustes(palate()[None], palate()[:-1])
    with pytest.raises(InputError, match="the source has 40, the target 39"):
        rigid_motion(palate(), palate()[:-1])


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_a_shape_that_is_alike_on_both_sides_is_laid_upright(seed):
    half = palate(seed)
    shape, mirror = np.vstack([half, half * (-1, 1, 1)]), np.roll(np.arange(80), 40)
    random = np.random.default_rng(seed)
    lying = RigidMotion(
        Rotation.from_rotvec(random.normal(scale=0.3, size=3)).as_matrix(), random.normal(size=3)
    )
    moved = lying.apply(shape)
    found = upright(moved, mirror)
    laid = found.apply(moved)
    np.testing.assert_allclose(laid[mirror], laid * (-1, 1, 1), atol=1e-9)
    # What is upright already stays where it is.
    again = upright(laid, mirror)
    np.testing.assert_allclose(again.apply(laid), laid, atol=1e-9)
