"""The model fitted to meshes and clouds: known speakers come back, and nothing lower is to be found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from tonguetrack import InputError
from tonguetrack.model.build import load_training_shapes, model_from_shapes, read_sample_database
from tonguetrack.model.cloud import Cloud
from tonguetrack.model.fitting import fit_clouds, fit_points, fit_shapes
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.tracker.bundled import bundled_model


@pytest.fixture(scope="module")
def tongues():
    return bundled_model()


def somebody(model, meshes, seed, spread=1.0):
    """A speaker and poses as usual as those in training: weights, and meshes (T, V, 3)."""
    random = np.random.default_rng(seed)
    s, poses = (
        mode.mean + spread * mode.measured_sigma * random.normal(size=(count, mode.size))
        for mode, count in ((model.speaker, 1), (model.pose, meshes))
    )
    return s[0], poses, np.array([model.vertices(s[0], p) for p in poses])


def squares(model, vertices, h):
    """The energy and its gradient over (s, p_1 .. p_T), its bounds, from the formula alone."""
    meshes, m, n = len(vertices), model.speaker.size, model.pose.size
    targets = vertices.reshape(meshes, -1)

    def value_and_gradient(x):
        s, poses = x[:m], x[m:].reshape(meshes, n)
        residual = model.origin + np.einsum("l,tk,lkr->tr", s, poses, model.core) - targets
        by_speaker = np.einsum("tr,tk,lkr->l", residual, poses, model.core)
        by_pose = np.einsum("tr,l,lkr->tk", residual, s, model.core)
        share = 1.0 / model.vertex_count
        return share * np.sum(residual**2), 2 * share * np.concatenate([by_speaker, by_pose.ravel()])

    mean = np.concatenate([model.speaker.mean, np.tile(model.pose.mean, meshes)])
    reach = np.concatenate([model.speaker.measured_sigma, np.tile(model.pose.measured_sigma, meshes)])
    return value_and_gradient, mean - h * reach, mean + h * reach


@pytest.mark.parametrize("meshes", [1, 3, 13])
def test_meshes_of_the_model_itself_are_met_exactly(tongues, meshes):
    for seed in range(3):
        _, _, vertices = somebody(tongues, meshes, seed)
        fit = fit_shapes(tongues, vertices, h=5.0)
        assert fit.converged
        assert fit.residual_mm.max() < 1e-6
        assert (fit.used == 1.0).all()


@pytest.mark.parametrize("meshes", [1, 3, 13])
def test_the_speaker_of_such_meshes_is_recovered_within_a_third_of_a_sigma(tongues, meshes):
    """Of the scale, which they do not tell, by the training speakers'; for speakers who are not too unusual."""
    for seed in range(5):
        s, poses, vertices = somebody(tongues, meshes, seed, spread=0.6)
        fit = fit_shapes(tongues, vertices, h=5.0)
        assert np.abs(fit.speaker - s).max() < 0.3 * tongues.speaker.sigma[0]
        assert np.abs(fit.poses - poses).max() < 0.35 * tongues.pose.sigma[0]


def test_what_no_mesh_tells_is_the_scale_alone(tongues):
    """The ratios of the speaker's weights come out exactly; their size is that of the training speakers."""
    s, _, vertices = somebody(tongues, 4, seed=11)
    found = fit_shapes(tongues, vertices, h=5.0).speaker
    np.testing.assert_allclose(found / np.linalg.norm(found), s / np.linalg.norm(s), atol=1e-6)


def test_all_meshes_share_one_speaker_and_have_a_pose_each(tongues):
    s, _, vertices = somebody(tongues, 5, seed=3)
    fit = fit_shapes(tongues, vertices, h=5.0)
    assert fit.speaker.shape == s.shape and fit.poses.shape == (5, tongues.pose.size)
    shapes = [tongues.vertices(fit.speaker, pose) for pose in fit.poses]
    np.testing.assert_allclose(shapes, vertices, atol=1e-5)


def test_no_weight_leaves_the_box_and_nothing_lower_is_found_in_it(small_model):
    """Noisy meshes of unusual speakers in boxes from narrow to wide, against L-BFGS-B from the fit and the mean."""
    random = np.random.default_rng(5)
    at_bounds = 0
    for case in range(25):
        meshes, h = int(random.integers(1, 5)), float(random.choice([0.5, 1.0, 2.0, 5.0]))
        _, _, vertices = somebody(small_model, meshes, seed=case, spread=1.5)
        vertices += random.normal(size=vertices.shape)
        fit = fit_shapes(small_model, vertices, h)
        function, low, high = squares(small_model, vertices, h)
        ours = np.concatenate([fit.speaker, fit.poses.ravel()])
        assert (ours >= low - 1e-12).all() and (ours <= high + 1e-12).all()
        at_bounds += bool(((ours <= low + 1e-9) | (ours >= high - 1e-9)).any())
        value, _ = function(ours)
        settings = {"ftol": 1e-15, "gtol": 1e-9, "maxiter": 3000, "maxfun": 30000}
        for start in (ours, (low + high) / 2):
            other = minimize(
                function, start, jac=True, method="L-BFGS-B", bounds=list(zip(low, high, strict=True)), options=settings
            )  # fmt: skip
            assert value <= other.fun * (1 + 1e-5)
    assert at_bounds > 8


def test_the_same_shapes_by_other_weights_give_the_same_fit(tongues):
    """v(c s, p/c) = v(s, p): what comes out depends on the shapes alone."""
    s, poses, vertices = somebody(tongues, 3, seed=8)
    scaled = np.array([tongues.vertices(1.2 * s, p / 1.2) for p in poses])
    one, other = fit_shapes(tongues, vertices, 5.0), fit_shapes(tongues, scaled, 5.0)
    np.testing.assert_allclose(one.speaker, other.speaker, atol=1e-6)


def test_a_model_without_training_weights_is_fitted_within_its_sigma(small_model):
    without = replace(
        small_model,
        speaker=replace(small_model.speaker, training=None),
        pose=replace(small_model.pose, training=None),
    )
    _, _, vertices = somebody(small_model, 3, seed=2, spread=3.0)
    fit = fit_shapes(without, vertices, h=1.0)
    assert np.abs(without.speaker.normalised(fit.speaker)).max() <= 1.0 + 1e-9
    assert np.abs(without.pose.normalised(fit.poses)).max() <= 1.0 + 1e-9


def test_errors_are_as_large_as_the_fit_says(small_model):
    """Independent noise on every vertex: the squared errors, in units of the covariance, are mostly about one. (The
    scale has a skew distribution, whose tails are longer than any covariance says.)"""
    squared = []
    for seed in range(40):
        s, _, vertices = somebody(small_model, 4, seed)
        vertices += np.random.default_rng(1000 + seed).normal(size=vertices.shape)
        fit = fit_shapes(small_model, vertices, h=5.0)
        off = fit.speaker - s
        squared.append(off @ np.linalg.solve(fit.covariance, off) / len(s))
        np.testing.assert_allclose(
            fit.sigma, np.sqrt(np.diag(fit.covariance)) / small_model.speaker.sigma, rtol=1e-12
        )
    assert 0.4 < np.median(squared) < 2.0


def test_more_meshes_and_less_noise_make_it_surer(small_model):
    def sigma(meshes, noise_mm):
        _, _, vertices = somebody(small_model, meshes, seed=4)
        noise = np.random.default_rng(1).normal(size=vertices.shape)
        return fit_shapes(small_model, vertices + noise_mm * noise, 5.0).sigma.mean()

    assert sigma(12, 1.0) < sigma(3, 1.0) < sigma(3, 4.0)


# Clouds -----------------------------------------------------------------------------------------------


def surface(vertices, faces):
    """The centres of all faces as points, and their normals: no point is a vertex."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    return corners.mean(axis=1)[length > 0], (normals / np.maximum(length, 1e-12)[:, None])[length > 0]


def test_a_mesh_with_other_vertices_is_fitted_to_a_fraction_of_its_edges(tongues):
    for seed in range(3):
        _, _, vertices = somebody(tongues, 1, seed, spread=0.5)
        points, normals = surface(vertices[0], tongues.faces)
        fit = fit_points(tongues, points, normals, h=2.0)
        shape = tongues.vertices(fit.speaker, fit.poses[0])
        before = np.linalg.norm(tongues.mean_vertices() - vertices[0], axis=1).mean()
        after = np.linalg.norm(shape - vertices[0], axis=1).mean()
        assert after < 0.7 * before
        assert fit.used[0] > 0.9 and fit.residual_mm[0] < 1.0


def test_the_order_of_the_points_is_of_no_meaning(tongues):
    _, _, vertices = somebody(tongues, 1, seed=1, spread=0.5)
    points, normals = surface(vertices[0], tongues.faces)
    order = np.random.default_rng(0).permutation(len(points))
    one = fit_points(tongues, points, normals, iterations=3)
    other = fit_points(tongues, points[order], normals[order], iterations=3)
    np.testing.assert_allclose(one.speaker, other.speaker, atol=1e-6)


def test_points_that_face_the_other_way_are_no_neighbours(tongues):
    """A second surface, 1 mm nearer to the mean shape than the tongue, but with its normals turned round."""
    mean = tongues.mean_vertices()
    normals = vertex_normals(mean, tongues.faces)
    true, wrong = mean + 2.0 * normals, mean + 1.0 * normals
    points = np.concatenate([true, wrong])
    facing = np.concatenate([normals, -normals])
    np.testing.assert_allclose(
        fit_points(tongues, points, facing, iterations=2).speaker,
        fit_points(tongues, true, normals, iterations=2).speaker,
        atol=1e-6,
    )
    blind = fit_points(tongues, points, iterations=2)
    assert np.abs(blind.speaker - fit_points(tongues, true, iterations=2).speaker).max() > 1e-3


def test_landmarks_draw_their_vertices_to_their_places(tongues):
    _, _, vertices = somebody(tongues, 1, seed=6)
    points, normals = surface(vertices[0], tongues.faces)
    marks = {vertex: vertices[0][vertex] for vertex in tongues.marks.midsagittal[::6]}

    def at_marks(fit):
        shape = tongues.vertices(fit.speaker, fit.poses[0])
        return np.mean([np.linalg.norm(shape[vertex] - place) for vertex, place in marks.items()])

    assert at_marks(fit_points(tongues, points, normals, marks)) < 0.5 * at_marks(
        fit_points(tongues, points, normals)
    )


def test_several_clouds_share_one_speaker(tongues):
    s, _, vertices = somebody(tongues, 4, seed=9, spread=0.5)
    clouds = [Cloud(*surface(mesh, tongues.faces)) for mesh in vertices]
    fit = fit_clouds(tongues, clouds, h=2.0)
    shapes = np.array([tongues.vertices(fit.speaker, pose) for pose in fit.poses])
    before = np.linalg.norm(tongues.mean_vertices() - vertices, axis=2).mean()
    assert np.linalg.norm(shapes - vertices, axis=2).mean() < 0.5 * before
    assert fit.speaker.shape == s.shape and fit.residual_mm.shape == (4,)


# Refusals ---------------------------------------------------------------------------------------------


def test_meshes_that_cannot_be_fitted_are_refused(small_model):
    whole = small_model.mean_vertices()[None]
    hole = whole.copy()
    hole[0, 3] = np.nan
    for vertices, words in (
        (whole[:0], "at least one"),
        (whole[:, :-1], "60 vertices"),
        (hole, "not a number"),
    ):
        with pytest.raises(InputError, match=words):
            fit_shapes(small_model, vertices, 5.0)
    with pytest.raises(InputError, match="above 0"):
        fit_shapes(small_model, whole, 0.0)


def test_clouds_that_cannot_be_fitted_are_refused(tongues):
    points = tongues.mean_vertices()
    for cloud, words in (
        (Cloud(points[:0]), "all of them numbers"),
        (Cloud(points[:, :2]), "three coordinates"),
        (Cloud(points * np.nan), "all of them numbers"),
        (Cloud(points, points[:5]), "5 normals"),
        (Cloud(points, None, {999999: np.zeros(3)}), "vertex 999999"),
        (Cloud(points + 100.0), "model's frame"),
        (Cloud(points / 1000.0), "in mm"),
    ):
        with pytest.raises(InputError, match=words):
            fit_clouds(tongues, [cloud], 2.0)
    with pytest.raises(InputError, match="at least one cloud"):
        fit_clouds(tongues, [], 2.0)


# Real meshes ------------------------------------------------------------------------------------------


def test_real_speakers_left_out_of_the_model_are_fitted_and_agree_with_themselves(reference_data):
    """One half of a speaker's phones against the other: nearer to each other than speakers are."""
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    for left_out in (0, 6):
        others = [i for i in range(len(shapes.speakers)) if i != left_out]
        training = replace(
            shapes,
            tensor=shapes.tensor[others],
            speakers=tuple(shapes.speakers[i] for i in others),
            filled=(),
        )
        model = model_from_shapes(training, 5, 4)
        meshes = shapes.tensor[left_out].reshape(len(shapes.prompts), -1, 3)
        fit = fit_shapes(model, meshes, 5.0)
        mean_shape = np.linalg.norm(meshes - model.origin.reshape(-1, 3), axis=2).mean()
        assert fit.converged and fit.residual_mm.mean() < 0.4 * mean_shape
        halves = [model.speaker.normalised(fit_shapes(model, meshes[i::2], 5.0).speaker) for i in (0, 1)]
        assert np.sqrt(np.mean((halves[0] - halves[1]) ** 2)) < 1.0
