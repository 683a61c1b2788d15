"""The nearest mesh: what the bounds spare is never the nearest."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack.model.nearest import NearestMesh, vertex_groups
from tonguetrack.model.synthetic import PHONES
from tonguetrack.model.synthetic.samples import training_shapes


def brute_force(samples, meshes):
    """(b,) float64: the mean distance of all vertices (b, V, 3) to every mesh, and the least of them."""
    apart = np.linalg.norm(samples[:, None] - meshes[None], axis=3)
    return apart.mean(axis=2).min(axis=1)


def errors(nearest, samples):
    apart = samples.transpose(0, 2, 1)
    single = (np.ascontiguousarray(part, dtype=np.float32) for part in (apart, apart @ nearest.grouping))
    return nearest.errors(*single)


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 40),
    vertices=st.integers(1, 60),
    groups=st.integers(1, 70),
    scale=st.sampled_from([1e-3, 1.0, 10.0]),
    rough=st.floats(0.0, 3.0),
)
@settings(max_examples=150, deadline=None)
def test_it_is_the_least_distance_to_any_mesh_whatever_the_groups(
    seed, count, vertices, groups, scale, rough
):
    """Smooth meshes, where bounds are tight, and rough ones, where they say nothing."""
    random = np.random.default_rng(seed)
    places = random.normal(scale=20, size=(vertices, 3))
    waves = np.cos(places @ random.normal(scale=0.05, size=(3, 6)))
    meshes = np.einsum("vw,twa->tva", waves, random.normal(size=(count, 6, 3)))
    samples = np.einsum("vw,twa->tva", waves, random.normal(size=(8, 6, 3)))
    meshes = scale * (meshes + rough * random.normal(size=meshes.shape))
    samples = scale * (samples + rough * random.normal(size=samples.shape))
    samples[0] = meshes[-1]
    found = errors(NearestMesh.among(meshes, places, groups), samples)
    np.testing.assert_allclose(found, brute_force(samples, meshes), atol=2e-5)


def test_on_tongues_it_equals_looking_at_every_vertex_of_every_mesh():
    shapes = training_shapes()
    meshes = shapes.reshape(-1, *shapes.shape[2:])[:, ::7]
    middle = meshes.mean(axis=0)
    random = np.random.default_rng(0)
    mixed = np.einsum("st,tva->sva", random.normal(scale=0.3, size=(400, len(meshes))), meshes - middle)
    found = errors(NearestMesh.among(meshes - middle, middle), mixed)
    np.testing.assert_allclose(found, brute_force(mixed, meshes - middle), atol=2e-5)
    assert len(meshes) == 11 * len(PHONES) and np.ptp(found) > 1.0


@pytest.mark.parametrize(("vertices", "groups"), [(1, 4), (5, 5), (60, 7), (100, 16)])
def test_groups_hold_every_vertex_once_and_are_of_almost_one_size(vertices, groups):
    places = np.random.default_rng(1).normal(size=(vertices, 3))
    parts = vertex_groups(places, groups)
    assert len(parts) == min(vertices, groups)
    assert sorted(np.concatenate(parts)) == list(range(vertices))
    assert max(map(len, parts)) <= 2 * min(map(len, parts)) + 1
