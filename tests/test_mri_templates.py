"""The templates: mirror images of themselves, facing out of the tissue, placed by landmarks."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.model.mesh import vertex_normals
from tonguetrack.model.mri.templates import TEMPLATES, palate, placed, template_named, tongue
from tonguetrack.model.synthetic import tongue_template

TONGUE_LANDMARKS = {
    "Tip", "SurfaceCenter", "BackCenter", "Airway", "FrontBaseCenter", "LeftLateral", "RightLateral",
}  # fmt: skip
PALATE_LANDMARKS = {
    "IncisorCenter", "RidgeCenter", "VaultCenter", "BackCenter", "LeftFront", "RightFront", "LeftMolar",
    "RightMolar", "LeftBack", "RightBack",
}  # fmt: skip

both = pytest.mark.parametrize("template", [tongue(), palate()], ids=lambda template: template.name)


@both
def test_a_template_is_its_own_mirror_image_with_the_same_faces(template):
    vertices, faces = template.mesh.vertices, template.mesh.faces
    np.testing.assert_array_equal(vertices[template.mirror], vertices * [-1, 1, 1])
    np.testing.assert_array_equal(template.mirror[template.mirror], np.arange(len(vertices)))
    # The mirror image of a face runs the other way round.
    there = {tuple(np.roll(face, -int(np.argmin(face)))) for face in faces}
    mirrored = {tuple(np.roll(face, -int(np.argmin(face)))) for face in template.mirror[faces][:, ::-1]}
    assert mirrored == there


@both
def test_a_template_is_one_sheet_without_holes_or_folds(template):
    vertices, faces = template.mesh.vertices, template.mesh.faces
    directed = Counter(
        (int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)
    )
    assert max(directed.values()) == 1
    rim = [edge for edge in directed if edge[::-1] not in directed]
    assert len({a for a, _ in rim}) == len(rim)
    edges = (len(directed) + len(rim)) / 2
    assert len(vertices) - edges + len(faces) == 1  # Euler's number of a disc
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    around = vertex_normals(vertices, faces)[faces].mean(axis=1)
    assert (np.einsum("fa,fa->f", np.cross(b - a, c - a), around) > 0).all()


@both
def test_the_named_vertices_of_a_side_mirror_each_other_and_the_others_are_in_the_middle(template):
    for name, vertex in template.landmarks.items():
        other = name.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
        assert template.mirror[vertex] == template.landmarks[other]
        assert (template.mesh.vertices[vertex, 0] > 0) == name.startswith("Left")
    assert (template.mesh.vertices[list(template.marks.midsagittal), 0] == 0).all()
    assert template.marks.landmarks == template.landmarks


def test_the_tongue_has_the_vertices_of_the_models_and_faces_outwards():
    template, known = tongue(), tongue_template()
    np.testing.assert_array_equal(template.mesh.faces, known.faces)
    assert set(template.landmarks) == TONGUE_LANDMARKS
    normals = vertex_normals(template.mesh.vertices, template.mesh.faces)
    assert normals[template.landmarks["SurfaceCenter"], 2] > 0.9
    assert normals[template.landmarks["Airway"], 1] > 0.8
    assert normals[template.landmarks["LeftLateral"], 0] > 0.4


def test_the_palate_is_of_the_papers_size_and_faces_down_into_the_mouth():
    template = palate()
    vertices, faces = template.mesh.vertices, template.mesh.faces
    assert set(template.landmarks) == PALATE_LANDMARKS
    assert 900 < len(vertices) < 1100
    lengths = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2)
    assert lengths.mean() == pytest.approx(1.5, abs=0.2)
    assert 1.0 < lengths.min() and lengths.max() < 2.6
    assert (vertex_normals(vertices, faces)[:, 2] < 0).all()


turns = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
shifts = st.tuples(*[st.floats(-200.0, 200.0)] * 3)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(sorted(TEMPLATES)), turns, shifts, st.floats(0.7, 1.4))
def test_landmarks_of_a_moved_and_scaled_template_tell_where_all_of_it_is(name, turn, shift, scale):
    template = template_named(name)
    moved = scale * Rotation.from_rotvec(turn).apply(template.mesh.vertices) + shift
    landmarks = {key: moved[vertex] for key, vertex in template.landmarks.items()}
    np.testing.assert_allclose(placed(template, landmarks), moved, atol=1e-9)


def test_landmarks_that_are_off_are_met_as_well_as_turning_moving_and_scaling_can():
    template = tongue()
    random = np.random.default_rng(3)
    names = list(template.landmarks)
    at = [template.landmarks[name] for name in names]
    wanted = template.mesh.vertices[at] + 2.0 * random.normal(size=(len(at), 3))

    def misfit(vertices):
        return np.sum((vertices[at] - wanted) ** 2)

    found = placed(template, dict(zip(names, wanted, strict=True)))
    least = misfit(found)
    centre = found[at].mean(axis=0)
    for _ in range(200):
        nudge = Rotation.from_rotvec(0.02 * random.normal(size=3))
        scale = 1.0 + 0.02 * random.normal()
        other = scale * nudge.apply(found - centre) + centre + 0.1 * random.normal(size=3)
        assert misfit(other) >= least


def test_what_does_not_place_a_template_is_refused():
    template = palate()
    places = {name: template.mesh.vertices[vertex] for name, vertex in template.landmarks.items()}
    with pytest.raises(InputError, match="no landmark 'Tip'; it knows IncisorCenter"):
        placed(template, {**places, "Tip": np.zeros(3)})
    with pytest.raises(InputError, match="needs 3 landmarks or more to be placed, found 2"):
        placed(template, {name: places[name] for name in ("VaultCenter", "LeftFront")})
    with pytest.raises(InputError, match="line"):
        placed(template, {name: i * np.ones(3) for i, name in enumerate(places)})
    with pytest.raises(InputError, match="'LeftBack' needs three coordinates"):
        placed(template, {**places, "LeftBack": np.array([0.0, np.nan, 0.0])})
    with pytest.raises(InputError, match="no template 'jaw'; there are tongue, palate"):
        template_named("jaw")
