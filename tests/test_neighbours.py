"""Neighbours in the cloud of a scan: near, facing the same way, and what lies below first."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parametric import parametric_model

from tonguetrack import InputError
from tonguetrack.model.cloud import Cloud
from tonguetrack.model.fitting import fit_clouds
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.model.neighbours import NeighbourRule, SurfaceIndex

UP = np.array([0.0, 0.0, 1.0])


def sheet(height, normal=UP, step=0.9, half=12.0):
    """Points of a level plane with one normal."""
    ticks = np.arange(-half, half, step)
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return Cloud(points, np.tile(normal, (len(points), 1)))


def joined(*clouds):
    return Cloud(np.concatenate([c.points for c in clouds]), np.concatenate([c.normals for c in clouds]))


def unit(random, count):
    directions = random.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def by_the_rule_alone(vertex, normal, cloud, rule):
    """The index of the neighbour, or None, looking at every point."""
    away = cloud.points - vertex
    distance = np.linalg.norm(away, axis=1)
    fits = (distance <= rule.radius_mm) & (cloud.normals @ normal >= np.cos(np.radians(rule.angle_deg)))
    for side in (away @ normal <= 0.0, away @ normal > 0.0):
        candidates = np.flatnonzero(fits & side)
        if len(candidates):
            return candidates[np.argmin(distance[candidates])]
    return None


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 300),
    st.floats(0.3, 30.0),
    st.floats(5.0, 180.0),
    st.floats(0.5, 60.0),
)
def test_the_neighbour_is_the_one_that_looking_at_every_point_finds(seed, count, radius, angle, extent):
    random = np.random.default_rng(seed)
    cloud = Cloud(extent * random.normal(size=(count, 3)), unit(random, count))
    vertices, normals = 1.2 * extent * random.normal(size=(20, 3)), unit(random, 20)
    rule = NeighbourRule(radius, angle)
    found, valid = SurfaceIndex(cloud).nearest(vertices, normals, rule)
    for vertex, normal, index, there in zip(vertices, normals, found, valid, strict=True):
        expected = by_the_rule_alone(vertex, normal, cloud, rule)
        assert there == (expected is not None)
        assert index == (expected if there else 0)


def test_a_surface_below_is_taken_before_a_nearer_one_above():
    index = SurfaceIndex(joined(sheet(-2.5), sheet(0.5)))
    points, valid = index.neighbours(np.zeros((1, 3)), UP[None], NeighbourRule())
    assert valid.all() and points[0, 2] == -2.5


def test_with_nothing_below_the_nearest_above_is_taken():
    index = SurfaceIndex(joined(sheet(1.5), sheet(3.0)))
    points, valid = index.neighbours(np.zeros((1, 3)), UP[None], NeighbourRule())
    assert valid.all() and points[0, 2] == 1.5


def test_a_surface_that_faces_the_other_way_is_no_neighbour():
    index = SurfaceIndex(sheet(-1.0, -UP))
    _, valid = index.neighbours(np.zeros((1, 3)), UP[None], NeighbourRule())
    assert not valid.any()


def test_far_outside_of_the_cloud_there_are_no_neighbours_and_no_fault():
    index = SurfaceIndex(sheet(0.0))
    places = np.array([[1e9, 0.0, 0.0], [0.0, -1e300, 0.0], [0.0, 0.0, 4.01]])
    _, valid = index.neighbours(places, np.tile(UP, (3, 1)), NeighbourRule())
    assert not valid.any()


def test_a_cloud_spread_over_kilometres_is_searched_all_the_same():
    near, far = sheet(0.0), Cloud(np.array([[1e6, 1e6, 1e6]]), UP[None])
    index = SurfaceIndex(joined(near, far))
    points, valid = index.neighbours(np.array([[0.1, 0.2, 1.0], [1e6, 1e6, 1e6 + 1.0]]), np.tile(UP, (2, 1)),
                                     NeighbourRule())  # fmt: skip
    assert valid.all()
    assert points[0, 2] == 0.0 and points[1, 0] == 1e6


def test_a_vertex_is_sent_straight_onto_the_plane_of_its_neighbour():
    index = SurfaceIndex(sheet(-1.0))
    vertices = np.random.default_rng(1).uniform(-5.0, 5.0, (50, 3)) * [1.0, 1.0, 0.1]
    targets, valid = index.targets(vertices, np.tile(UP, (50, 1)), NeighbourRule())
    assert valid.all()
    np.testing.assert_allclose(targets, vertices * [1.0, 1.0, 0.0] - UP, atol=1e-12)


def test_what_cannot_be_searched_is_refused():
    with pytest.raises(InputError, match="no normals"):
        SurfaceIndex(Cloud(np.zeros((3, 3))))
    with pytest.raises(InputError, match="3 points have 2 normals"):
        SurfaceIndex(Cloud(np.zeros((3, 3)), np.ones((2, 3))))
    with pytest.raises(InputError, match="all of them numbers"):
        SurfaceIndex(Cloud(np.full((3, 3), np.nan), np.ones((3, 3))))
    with pytest.raises(InputError, match="three coordinates"):
        SurfaceIndex(Cloud(np.zeros((0, 3)), np.zeros((0, 3))))
    for radius, angle in ((0.0, 60.0), (4.0, 0.0), (np.nan, 60.0), (4.0, 181.0)):
        with pytest.raises(InputError, match="cannot be sought"):
            NeighbourRule(radius, angle)


# Fits of the model to such clouds -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def tongue():
    """The parametric model, a usual tongue of it, and that as a cloud with stray points 2.5 mm above its upper side."""
    model = parametric_model()
    random = np.random.default_rng(5)
    s, p = (
        mode.mean + 0.7 * mode.measured_sigma * random.normal(size=mode.size)
        for mode in (model.speaker, model.pose)
    )
    vertices = model.vertices(s, p)
    normals = vertex_normals(vertices, model.faces)
    upper = normals[:, 2] > 0.6
    points = np.concatenate([vertices, vertices[upper] + 2.5 * normals[upper]])
    return model, vertices, Cloud(points, np.concatenate([normals, normals[upper]]))


def error_mm(model, fit, vertices):
    """How far the fit is off across the surface."""
    normals = vertex_normals(vertices, model.faces)
    off = model.vertices(fit.speaker, fit.poses[0]) - vertices
    return float(np.abs(np.einsum("va,va->v", off, normals)).mean())


def test_a_fit_by_the_rule_is_not_held_up_by_points_above_the_surface(tongue):
    model, vertices, cloud = tongue
    nearest = error_mm(model, fit_clouds(model, [cloud], h=2.0), vertices)
    ruled = error_mm(model, fit_clouds(model, [cloud], h=2.0, rule=NeighbourRule()), vertices)
    assert ruled < 0.7 * nearest


def test_a_fit_that_starts_where_another_ended_stays_there_or_gets_nearer(tongue):
    model, _, cloud = tongue
    rule = NeighbourRule()
    first = fit_clouds(model, [cloud], h=2.0, iterations=3, rule=rule)
    second = fit_clouds(model, [cloud], h=2.0, iterations=3, rule=rule, start=first)
    whole = fit_clouds(model, [cloud], h=2.0, iterations=6, rule=rule)
    assert second.residual_mm[0] == pytest.approx(whole.residual_mm[0], rel=0.02)


def test_a_start_of_other_meshes_is_refused(tongue):
    model, _, cloud = tongue
    two = fit_clouds(model, [cloud, cloud], h=2.0, iterations=1)
    with pytest.raises(InputError, match="cannot be the start for 1 clouds"):
        fit_clouds(model, [cloud], h=2.0, start=two)


def test_a_rule_needs_normals(tongue):
    model, _, cloud = tongue
    with pytest.raises(InputError, match="no normals"):
        fit_clouds(model, [Cloud(cloud.points)], h=2.0, rule=NeighbourRule())
