"""What the pictures are made of: scenes, moments, cuts and distances, and where points come to lie. No graphics."""

import dataclasses

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.tracker.bundled import bundled_model, bundled_recording
from tonguetrack.tracker.palate import curve_palate
from tonguetrack.tracker.pose import CoilState, PoseStatus, TrackedPose, TrackedPoses
from tonguetrack.tracker.session import Session
from tonguetrack.tracker.viewer.camera import Area, flat_projection, home_view, layout_of, solid_projection
from tonguetrack.tracker.viewer.look import DARK, LIGHT
from tonguetrack.tracker.viewer.markings import slabs
from tonguetrack.tracker.viewer.scene import (
    midsagittal_outline,
    moment_of,
    moments_of,
    palate_distance,
    scene_of,
    vertex_uncertainty,
    weights_covariance,
)
from tonguetrack.tracker.viewer.surface import ring_pairs

SIZES = [(640, 360), (800, 600), (1280, 720), (1920, 1080), (300, 900)]


@pytest.fixture(scope="module")
def model():
    return bundled_model()


@pytest.fixture(scope="module")
def scene(model):
    """The demo's, without its palate."""
    _, session = bundled_recording()
    roles, vertices = tuple(session.correspondences), tuple(session.correspondences.values())
    return scene_of(model, dataclasses.replace(session, palate=None), roles, vertices, "a demo")


# Scenes and moments ---------------------------------------------------------------------------------


def test_a_scene_has_the_sessions_palate_in_the_models_frame_and_the_coils_short_names(model):
    points = np.array([[1.0, 30.0, 12.0], [1.0, 10.0, 8.0], [1.0, 20.0, 13.0]])
    session = Session(palate=curve_palate(points, "a test"))
    scene = scene_of(model, session, ("tongue_tip", "tongue_left_side"), (955, 1886), "x")
    assert scene.palate.tolist() == [[0, 10, 8], [0, 20, 13], [0, 30, 12]]
    assert scene.names == ("tip", "left side")
    assert set(scene.contour) <= set(range(model.vertex_count))


def test_a_session_without_a_palate_makes_a_scene_without_one(scene):
    assert scene.palate is None


def test_a_vertex_that_the_model_does_not_have_is_refused_by_its_number(model):
    with pytest.raises(InputError, match=r"vertex 5000 does not exist: the model has vertices 0 to 3380\."):
        scene_of(model, Session(), ("tongue_tip",), (5000,), "x")
    with pytest.raises(InputError, match="2 coils were named, but 1 vertices"):
        scene_of(model, Session(), ("tongue_tip", "tongue_blade"), (5,), "x")


def test_a_scene_is_as_large_as_its_own_speakers_tongue(model, scene):
    speaker = model.speaker.mean * 3.0
    other = dataclasses.replace(scene, speaker_weights=speaker)
    low, high = other.extent
    vertices = model.vertices(speaker, model.pose.raw([2.0, 0, 0, 0]))
    assert (vertices >= low - 1e-9).all() and (vertices <= high + 1e-9).all()
    assert not np.allclose(other.extent, dataclasses.replace(scene, speaker_weights=None).extent, atol=1.0)
    with pytest.raises(InputError, match="2 speaker weights were given"):
        dataclasses.replace(scene, speaker_weights=np.ones(2))


def test_a_scene_of_nobody_in_particular_has_room_for_other_tongues_than_the_mean_ones(model, scene):
    low, high = dataclasses.replace(scene, speaker_weights=None).extent
    for direction, sigma in enumerate(model.speaker.sigma):
        speaker = model.speaker.mean.copy()
        speaker[direction] += sigma
        vertices = model.vertices(speaker, model.pose.raw([0, -2.0, 0, 0]))
        assert (vertices >= low - 1e-9).all() and (vertices <= high + 1e-9).all()


def test_a_moment_is_a_copy_that_the_next_frame_does_not_write_over():
    pose = TrackedPose(
        np.ones(4), np.full(4, 2.0), np.full(5, 3.0), np.full(2, 0.5), 0.5, 1.0, 2, PoseStatus.HELD, 7.25,
        coil_states=np.array([0, 3]), coils=np.full((2, 3), 9.0),
    )  # fmt: skip
    moment = moment_of(pose)
    for array in (pose.weights, pose.normalised, pose.speaker_weights, pose.residuals_mm, pose.coils):
        array[:] = -1
    pose.coil_states[:] = 5
    assert (
        (moment.weights == 1).all() and (moment.normalised == 2).all() and (moment.speaker_weights == 3).all()
    )
    assert (moment.coils == 9).all() and (moment.residuals_mm == 0.5).all()
    assert moment.coil_states.tolist() == [0, 3]
    assert (moment.status, moment.residual_mm, moment.time_s) == (PoseStatus.HELD, 0.5, 7.25)


def poses(frames=4):
    count = np.arange(frames, dtype=float)
    coils = np.tile(count[:, None, None], (1, 2, 3))
    coils[1, 0] = np.nan
    return TrackedPoses(
        0.1 * count, np.full(frames, 1), np.tile(count[:, None], (1, 3)), np.tile(-count[:, None], (1, 3)),
        np.ones((frames, 5)), count, count / 10, np.tile(count[:, None], (1, 2)), coils, None, ("a", "b"), (1, 2), 2, 10.0,
    )  # fmt: skip


def test_the_moments_of_a_take_are_its_frames_in_order():
    moments = moments_of(poses())
    assert len(moments) == 4
    assert [moment.time_s for moment in moments] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert (moments[2].weights == 2).all() and (moments[2].normalised == -2).all()
    assert moments[-1].residual_mm == pytest.approx(0.3)
    assert [moment.time_s for moment in moments[1:3]] == pytest.approx([0.1, 0.2])
    with pytest.raises(IndexError):
        moments[4]


def test_a_coil_that_a_file_does_not_have_is_missing_and_the_others_count():
    moments = moments_of(poses())
    assert moments[1].coil_states.tolist() == [CoilState.MISSING, CoilState.TRUSTED]
    assert moments[0].coil_states.tolist() == [CoilState.TRUSTED, CoilState.TRUSTED]


def test_a_coil_that_did_not_count_in_a_take_does_not_count_when_it_is_played():
    states = np.zeros((4, 2), np.int64)
    states[1] = [CoilState.WILD, CoilState.MISFIT]
    moments = moments_of(dataclasses.replace(poses(), coil_states=states))
    assert moments[1].coil_states.tolist() == [CoilState.MISSING, CoilState.MISFIT]
    assert moments[0].coil_states.tolist() == [CoilState.TRUSTED, CoilState.TRUSTED]


# The cut --------------------------------------------------------------------------------------------


def test_the_cut_lies_in_the_plane_and_holds_the_upper_contour(model, scene):
    vertices = model.mean_vertices()
    points = scene.outline.points(vertices[scene.outline.vertices])
    assert np.abs(points[:, 0]).max() < 1e-9
    apart = np.linalg.norm(vertices[scene.contour][:, None] - points[None], axis=2).min(axis=1)
    assert apart.max() < 0.5  # the model's mid-sagittal vertices need not lie in the plane to the last digit


def test_the_cut_moves_with_the_edges_of_the_mesh(model, scene):
    outline = scene.outline
    vertices = model.vertices(model.speaker.mean, model.pose.raw([1.0, -2.0, 0.5, 1.0]))
    first, second = vertices[outline.edges[:, 0]], vertices[outline.edges[:, 1]]
    expected = (1 - outline.shares[:, None]) * first + outline.shares[:, None] * second
    assert np.allclose(outline.points(vertices[outline.vertices]), expected, atol=1e-12)


def sphere(shift):
    """An octahedron split twice: 66 vertices, closed."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    return np.array(ball.vertices) + [shift, 0, 0], np.array(ball.faces, dtype=np.int32)


def test_a_plane_that_meets_no_vertex_cuts_a_ball_in_a_closed_line():
    vertices, faces = sphere(0.137)
    outline = midsagittal_outline(vertices, faces, np.array([0, 1]))
    points = outline.points(vertices[outline.vertices])
    assert np.abs(points[:, 0]).max() < 1e-12
    assert ((outline.shares > 0) & (outline.shares < 1)).all()
    radii = np.linalg.norm(points[:, 1:], axis=1)
    assert 9.3 < radii.min() and radii.max() < 10.0
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert gaps.sum() + np.linalg.norm(points[0] - points[-1]) == pytest.approx(2 * np.pi * 10, rel=0.05)


def test_a_mesh_beside_the_plane_has_its_contour_instead():
    vertices, faces = sphere(50.0)
    outline = midsagittal_outline(vertices, faces, np.array([3, 1, 2]))
    assert np.array_equal(outline.points(vertices[outline.vertices]), vertices[[3, 1, 2]])


def test_of_several_pieces_of_a_cut_the_longest_counts():
    large, faces = sphere(0.137)
    small = 0.2 * large + [0.05, 0, 40]
    both = np.concatenate([small, large])
    outline = midsagittal_outline(
        both, np.concatenate([faces, faces + len(small)]).astype(np.int32), np.array([0])
    )
    assert outline.edges.min() >= len(small)


# Distances and uncertainty --------------------------------------------------------------------------


def test_the_distance_to_the_palate_is_measured_straight_upwards():
    palate = np.array([[0.0, 10.0, 5.0], [0.0, 20.0, 15.0]])
    vertices = np.array([[3.0, 15.0, 4.0], [0.0, 12.0, 9.0], [0.0, 5.0, 0.0], [0.0, 21.0, 0.0]])
    assert palate_distance(vertices, palate)[:2].tolist() == pytest.approx([6.0, -2.0])
    assert np.isnan(palate_distance(vertices, palate)[2:]).all()
    assert np.isnan(palate_distance(vertices, None)).all()


def test_the_weights_covariance_is_the_gaussian_posterior(model):
    """The gain form of the same posterior, which inverts another matrix."""
    speaker = model.for_speaker(model.speaker.mean)
    coils, noise = (955, 1347), 0.7
    prior, seen = np.diag(speaker.sigma**2), speaker.at(coils).directions.T
    gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + noise**2 * np.eye(6))
    assert np.allclose(weights_covariance(speaker, coils, noise), prior - gain @ seen @ prior, atol=1e-12)
    assert np.allclose(weights_covariance(speaker, ()), prior)


def test_a_vertex_is_as_uncertain_as_its_covariance_says(model):
    speaker = model.for_speaker(model.speaker.mean)
    covariance = weights_covariance(speaker, (955,))
    uncertain = vertex_uncertainty(speaker, covariance)
    assert uncertain.shape == (model.vertex_count,)
    for vertex in (0, 955, 3000):
        directions = speaker.at((vertex,)).directions
        assert uncertain[vertex] == pytest.approx(np.sqrt(np.trace(directions.T @ covariance @ directions)))


def test_no_vertex_becomes_less_certain_by_another_coil(model):
    speaker = model.for_speaker(model.speaker.mean)
    none, one, two = (
        vertex_uncertainty(speaker, weights_covariance(speaker, c)) for c in ((), (955,), (955, 1886))
    )
    assert (one <= none + 1e-9).all() and (two <= one + 1e-9).all()
    assert two.mean() < 0.7 * one.mean() < 0.7 * none.mean()


def test_the_rings_corners_give_the_areas_normals(model):
    vertices = model.mean_vertices()
    pairs = ring_pairs(model.faces, model.vertex_count)
    there = pairs[..., :1] >= 0
    crossed = np.cross(vertices[pairs[..., 0]] - vertices, vertices[pairs[..., 1]] - vertices)
    sums = np.where(there, crossed, 0.0).sum(axis=0)
    normals = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    assert np.allclose(normals, vertex_normals(vertices, model.faces), atol=1e-9)


# Places ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("look", [DARK, LIGHT])
def test_the_three_areas_lie_side_by_side_inside_the_picture(size, look):
    layout = layout_of(size, look)
    areas = (layout.solid, layout.flat, layout.bars)
    for area in areas:
        assert area.x >= 0 and area.y >= 0 and area.width > 50 and area.height > 50
        assert area.x + area.width <= size[0] and area.y + area.height <= size[1]
    assert layout.solid.x + layout.solid.width <= layout.flat.x
    assert layout.flat.y + layout.flat.height <= layout.bars.y


@pytest.mark.parametrize("size", SIZES)
def test_the_flat_view_has_the_front_left_equal_scales_and_room_for_every_pose(scene, size):
    area = layout_of(size, DARK).flat
    projection = flat_projection(scene, area, 10)
    corner, back, up = projection.pixels(np.array([[7.0, 20, 0], [0, 30, 0], [0, 20, 10]]))
    assert back[0] > corner[0] and up[1] < corner[1]
    assert back[0] - corner[0] == pytest.approx(corner[1] - up[1])
    assert projection.pixels_per_mm(np.zeros((1, 3)))[0] == pytest.approx((back[0] - corner[0]) / 10)
    inside = projection.pixels(scene.extent)
    assert (inside[:, 0] >= area.x + 9.9).all() and (inside[:, 0] <= area.x + area.width - 9.9).all()
    assert (inside[:, 1] >= area.y + 9.9).all() and (inside[:, 1] <= area.y + area.height - 9.9).all()


@pytest.mark.parametrize("size", SIZES)
def test_the_home_view_has_the_speakers_tongue_inside_its_area(scene, model, size):
    area = layout_of(size, DARK).solid
    vertices = model.vertices(scene.speaker_weights, model.pose.mean)
    pixels = solid_projection(home_view(scene), area).pixels(vertices)
    assert all(area.holds(x, y) for x, y in pixels[:, :2])
    assert (np.abs(pixels[:, 2]) < 1).all()


@pytest.mark.parametrize(
    ("yaw", "pitch", "right", "up"),
    [(0, 0, "x", "z"), (90, 0, "y", "z"), (-90, 0, "-y", "z"), (0, 89.999, "x", "y"), (180, 0, "-x", "z")],
)
def test_the_camera_stands_where_the_view_says(scene, yaw, pitch, right, up):
    """From the front the speaker's left is on the right; from the left the front is on the left, as in the flat view."""
    view = dataclasses.replace(home_view(scene), yaw_deg=yaw, pitch_deg=pitch)
    axes = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1], "-x": [-1, 0, 0], "-y": [0, -1, 0]}
    centre = np.array(view.centre)
    points = centre + np.array([[0, 0, 0], axes[right], axes[up]])
    here, to_right, to_up = solid_projection(view, Area(10, 20, 300, 200)).pixels(points)
    assert here[:2] == pytest.approx([160, 120])
    assert to_right[0] > here[0] + 0.5 and to_right[1] == pytest.approx(here[1], abs=0.01)
    assert to_up[1] < here[1] - 0.5 and to_up[0] == pytest.approx(here[0], abs=0.01)


def test_what_is_behind_the_camera_has_no_place(scene):
    view = dataclasses.replace(home_view(scene), yaw_deg=0, pitch_deg=0)
    behind = np.array(view.centre) - [0, 2 * view.distance_mm, 0]
    assert np.isnan(solid_projection(view, Area(0, 0, 100, 100)).pixels(behind[None])).all()


def test_orbiting_goes_round_and_zooming_and_pitching_have_limits(scene):
    view = home_view(scene)
    view.yaw_deg = 170
    view.orbit(20, 500)
    assert (view.yaw_deg, view.pitch_deg) == (-170, 89)
    distance = view.distance_mm
    view.zoom(2)
    assert view.distance_mm == pytest.approx(distance / 2)
    view.zoom(1e9)
    nearest = view.distance_mm
    view.zoom(1e-9)
    assert 0 < nearest < view.distance_mm < np.inf


# The filled cut -------------------------------------------------------------------------------------


def areas(upper, lower):
    """Of trapezoids."""
    return 0.5 * ((upper[:, 1] - upper[:, 0]) + (lower[:, 1] - lower[:, 0])) * (lower[:, 2] - upper[:, 2])


def test_the_slabs_of_a_polygon_add_up_to_its_area_exactly():
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False) + 0.01
    star = (60 + 25 * np.cos(5 * angle))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]) + 100
    x, y = star.T
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    upper, lower = slabs(star, 6.0)
    assert (upper[:, 1] >= upper[:, 0] - 1e-9).all() and (lower[:, 1] >= lower[:, 0] - 1e-9).all()
    assert (lower[:, 2] - upper[:, 2]).max() <= 6.0 + 1e-9
    assert areas(upper, lower).sum() == pytest.approx(area, rel=1e-9)


def test_a_hollow_is_left_out():
    u = np.array([[0, 0], [10, 0], [10, 20], [20, 20], [20, 0], [30, 0], [30, 30], [0, 30]], dtype=float)
    upper, lower = slabs(u, 100.0)
    assert upper.tolist() == [[0, 10, 0], [20, 30, 0], [0, 30, 20]]
    assert lower.tolist() == [[0, 10, 20], [20, 30, 20], [0, 30, 30]]
