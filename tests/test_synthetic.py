"""The synthetic tongue: a well-formed template, plausible mouths, phones where a phonetician expects them."""

import numpy as np
import pytest

from tonguetrack.model.mesh import vertex_normals
from tonguetrack.model.synthetic import (
    PHONES,
    Articulation,
    articulation_for,
    blend,
    random_anatomy,
    random_habits,
    tongue_surface,
    tongue_template,
    training_anatomies,
)
from tonguetrack.model.synthetic.samples import training_shapes, write_samples
from tonguetrack.model.synthetic.surface import enclosed_volume
from tonguetrack.model.tensor import cumulative_compactness, hosvd, mode_product

TEMPLATE = tongue_template()
ANATOMIES = training_anatomies()
PHONE_NAMES = list(PHONES)


@pytest.fixture(scope="module")
def shapes():
    """(11, 13, n, 3) mm."""
    return training_shapes()


@pytest.fixture(scope="module")
def reference_shape():
    return tongue_surface(ANATOMIES[2], Articulation(jaw_deg=4.0))


def of(shapes, phone):
    return shapes[:, PHONE_NAMES.index(phone)]


def edges():
    pairs = np.concatenate([TEMPLATE.faces[:, [0, 1]], TEMPLATE.faces[:, [1, 2]], TEMPLATE.faces[:, [2, 0]]])
    return pairs, np.unique(np.sort(pairs, axis=1), axis=0)


def contour(shapes):
    """(..., points, 2) y, z of the mid-sagittal upper surface, tip to root."""
    return shapes[..., list(TEMPLATE.midsagittal), :][..., 1:]


def highest(shapes):
    """(...,) y and z of the highest point of the contour."""
    line = contour(shapes)
    top = np.argmax(line[..., 1], axis=-1)
    return np.take_along_axis(line, top[..., None, None], axis=-2)[..., 0, :]


# The template --------------------------------------------------------------------------------------


def test_about_three_thousand_vertices_with_edges_below_two_millimetres(reference_shape):
    assert 2800 <= TEMPLATE.vertex_count <= 3400
    _, unique = edges()
    length = np.linalg.norm(reference_shape[unique[:, 0]] - reference_shape[unique[:, 1]], axis=1)
    assert length.mean() < 2.0
    assert length.max() < 4.5


def test_the_mesh_is_one_sheet_with_one_rim():
    pairs, unique = edges()
    assert len(np.unique(pairs, axis=0)) == len(pairs)  # every directed edge once: consistent winding
    uses = len(pairs) - len(unique)  # edges with two faces
    rim = len(unique) - uses
    assert TEMPLATE.vertex_count - len(unique) + len(TEMPLATE.faces) == 1  # a disk
    assert rim == 2 * (len(TEMPLATE.s) + len(TEMPLATE.theta) - 2)


def test_the_topology_is_its_own_mirror_image():
    mirror = TEMPLATE.mirror
    np.testing.assert_array_equal(mirror[mirror], np.arange(TEMPLATE.vertex_count))
    mirrored = {tuple(sorted(mirror[face])) for face in TEMPLATE.faces}
    assert mirrored == {tuple(sorted(face)) for face in TEMPLATE.faces}


def test_a_symmetric_articulation_gives_a_symmetric_surface(reference_shape):
    np.testing.assert_allclose(reference_shape[TEMPLATE.mirror] * [-1, 1, 1], reference_shape, atol=1e-9)
    np.testing.assert_allclose(reference_shape[list(TEMPLATE.midsagittal), 0], 0, atol=1e-9)


def test_faces_look_outwards(reference_shape):
    normals = vertex_normals(reference_shape, TEMPLATE.faces)
    assert normals[TEMPLATE.landmarks["SurfaceCenter"], 2] > 0.9
    assert normals[TEMPLATE.landmarks["Airway"], 1] > 0.9
    assert normals[TEMPLATE.landmarks["Tip"], 1] < -0.5
    assert enclosed_volume(reference_shape) > 0


def test_landmarks_regions_and_midline_are_where_their_names_say(reference_shape):
    assert {"Tip", "SurfaceCenter", "BackCenter", "Airway", "FrontBaseCenter"} <= set(TEMPLATE.landmarks)
    y = reference_shape[:, 1]
    assert y[TEMPLATE.landmarks["Tip"]] == pytest.approx(y.min(), abs=0.5)
    order = [np.mean(y[list(TEMPLATE.regions[name])]) for name in ("tip", "blade", "back", "dorsum")]
    assert order == sorted(order)
    assert np.abs(reference_shape[list(TEMPLATE.regions["lateral"]), 0]).min() > 7
    named = [set(TEMPLATE.regions[name]) for name in ("tip", "blade", "back", "dorsum", "lateral")]
    assert set().union(*named) == set(TEMPLATE.regions["combined"])
    assert sum(map(len, named)) == len(TEMPLATE.regions["combined"])
    assert TEMPLATE.midsagittal[0] == TEMPLATE.landmarks["Tip"]
    steps = np.diff(reference_shape[list(TEMPLATE.midsagittal)], axis=0)
    assert np.linalg.norm(steps, axis=1).max() < 3


# Speakers and phones -------------------------------------------------------------------------------


def test_there_are_the_papers_phones_and_as_many_speakers(shapes):
    assert set(PHONE_NAMES) == set("ieɛaɑʌɔouʉəsʃ")
    assert shapes.shape == (11, 13, TEMPLATE.vertex_count, 3)
    assert len({anatomy.name for anatomy in ANATOMIES}) == 11


def test_the_tongue_never_goes_through_the_palate(shapes):
    upper = list(TEMPLATE.regions["combined"])
    for anatomy, spoken in zip(ANATOMIES, shapes, strict=True):
        points = spoken[:, upper]
        under = (points[..., 1] > 3) & (points[..., 1] < 55)
        room = anatomy.palate_z(points[..., 0], points[..., 1]) - points[..., 2]
        assert room[under].min() > -0.05


@pytest.mark.parametrize("phone", ["i", "s", "ʃ"])
def test_front_phones_are_braced_against_the_sides_of_the_palate(shapes, phone):
    for anatomy, spoken in zip(ANATOMIES, of(shapes, phone), strict=True):
        points = spoken[list(TEMPLATE.regions["combined"])]
        beside = (np.abs(points[:, 0]) > 9) & (points[:, 1] > 8) & (points[:, 1] < 55)
        room = (anatomy.palate_z(points[:, 0], points[:, 1]) - points[:, 2])[beside]
        assert np.sort(room)[:10].mean() < 1.0


@pytest.mark.parametrize("phone", ["ɑ", "a", "ʌ"])
def test_low_vowels_touch_nothing(shapes, phone):
    for anatomy, spoken in zip(ANATOMIES, of(shapes, phone), strict=True):
        line = spoken[list(TEMPLATE.midsagittal)]
        under = line[:, 1] < 55
        assert (anatomy.palate_z(line[under, 0], line[under, 1]) - line[under, 2]).min() > 2


def groove_depth(spoken):
    """(speakers,) mm: how far the midline lies below the flanks, at most, on blade and front dorsum."""
    grid = spoken.reshape(len(spoken), len(TEMPLATE.s), len(TEMPLATE.theta), 3)
    behind_tip = TEMPLATE.s - TEMPLATE.tip_s
    rows = (behind_tip > 6) & (behind_tip < 34)
    middle = len(TEMPLATE.theta) // 2
    flank = np.abs(np.abs(TEMPLATE.theta) - 30) < 10
    depth = grid[:, rows][:, :, flank, 2].mean(axis=2) - grid[:, rows, middle, 2]
    return depth.max(axis=1)


def test_sibilants_have_a_midline_groove_that_vowels_have_not(shapes):
    grooved = np.minimum(groove_depth(of(shapes, "s")), groove_depth(of(shapes, "ʃ")))
    assert grooved.min() > 1.0
    for vowel in ("u", "ɑ", "ə"):
        assert (grooved > groove_depth(of(shapes, vowel)) + 0.5).all()


def test_the_vowel_space_is_the_phoneticians(shapes):
    """Height: i above e above ɛ above a; u above o above ɔ. Place: i in front of ʉ in front of u, o and ɑ."""
    top = {phone: highest(of(shapes, phone)) for phone in PHONE_NAMES}
    for higher, lower in (("i", "ɛ"), ("e", "a"), ("ʉ", "ə"), ("u", "ɔ"), ("o", "ɑ"), ("ə", "ɑ")):
        assert (top[higher][:, 1] > top[lower][:, 1]).all(), (higher, lower)
    for higher, lower in (("i", "e"), ("e", "ɛ"), ("ɛ", "a"), ("u", "o"), ("o", "ɔ")):
        assert np.mean(top[higher][:, 1] - top[lower][:, 1]) > 0.5, (higher, lower)
    for front, back in (("i", "u"), ("i", "ɑ"), ("e", "o"), ("ʉ", "ɔ")):
        assert (top[front][:, 0] < top[back][:, 0] - 3).all(), (front, back)


def test_the_root_is_drawn_back_in_low_back_vowels_and_forward_in_high_front_ones(shapes):
    root = TEMPLATE.landmarks["Airway"]
    assert (of(shapes, "ɑ")[:, root, 1] > of(shapes, "i")[:, root, 1] + 5).all()


def test_sibilants_raise_the_tip_to_the_ridge(shapes):
    blade = list(TEMPLATE.regions["tip"] + TEMPLATE.regions["blade"])
    for sibilant in ("s", "ʃ"):
        raised = of(shapes, sibilant)[:, blade, 2].max(axis=1)
        assert (raised > of(shapes, "ə")[:, blade, 2].max(axis=1) + 2).all()


def test_the_tongue_keeps_its_volume_within_a_tenth_or_so(shapes):
    for spoken in shapes:
        volume = np.array([enclosed_volume(vertices) for vertices in spoken])
        assert 40_000 < volume.mean() < 110_000  # mm^3 of the modelled part
        assert np.abs(volume / volume.mean() - 1).max() < 0.12


def test_phones_move_the_tongue_by_millimetres_not_by_centimetres(shapes):
    apart = np.linalg.norm(shapes - shapes.mean(axis=1, keepdims=True), axis=-1)
    assert 2.5 < apart.mean() < 8
    assert apart.max() < 30


def test_speakers_differ_and_the_set_is_not_exactly_multilinear(shapes):
    tensor = shapes.reshape(11, 13, -1) - shapes.reshape(11, 13, -1).mean(axis=(0, 1))
    parts = hosvd(tensor)
    assert cumulative_compactness(parts.speaker_spectrum)[4] < 0.97
    assert cumulative_compactness(parts.pose_spectrum)[3] < 0.96
    kept = parts.truncated(5, 4)
    rebuilt = mode_product(mode_product(kept.core, kept.speaker_factors, 0), kept.pose_factors, 1)
    error = np.linalg.norm((tensor - rebuilt).reshape(11, 13, -1, 3), axis=-1).mean()
    assert 0.8 < error < 2.5


def test_no_spikes_and_no_folded_contours(shapes):
    """Edges stay short, and the mid-sagittal contour never crosses itself."""
    pairs, _ = edges()
    assert np.linalg.norm(shapes[:, :, pairs[:, 0]] - shapes[:, :, pairs[:, 1]], axis=-1).max() < 5
    whole = np.arange(len(TEMPLATE.s)) * len(TEMPLATE.theta) + len(TEMPLATE.theta) // 2
    lines = shapes[:, :, whole, 1:].reshape(-1, len(whole), 2)
    for line in lines:
        assert not crosses_itself(line)


def sharpest_crease_deg(spoken):
    """(...,) the largest angle between the normals of two neighbouring triangles: 180 is a fold."""
    faces = TEMPLATE.faces
    pairs, _ = edges()
    owner = np.tile(np.arange(len(faces)), 3)
    ends = np.sort(pairs, axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = (ends[order[1:]] == ends[order[:-1]]).all(axis=1)
    one, other = owner[order[1:]][same], owner[order[:-1]][same]
    a, b, c = (spoken[..., faces[:, corner], :] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.degrees(np.arccos((normals[..., one, :] * normals[..., other, :]).sum(axis=-1).min(axis=-1)))


def test_the_surface_is_nowhere_folded(shapes):
    """Not among the training speakers, and not among those whom the simulator draws."""
    assert sharpest_crease_deg(shapes.reshape(-1, TEMPLATE.vertex_count, 3)).max() < 80
    for seed in range(1000, 1010):
        anatomy, habits = random_anatomy(seed), random_habits(seed)
        spoken = np.array([tongue_surface(anatomy, articulation_for(anatomy, p, habits)) for p in PHONES])
        assert sharpest_crease_deg(spoken).max() < 110, seed


def crosses_itself(line):
    def side(a, b, c):
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
            c[..., 0] - a[..., 0]
        )

    start, end = line[:-1, None], line[1:, None]
    other_start, other_end = line[None, :-1], line[None, 1:]
    apart = side(start, end, other_start) * side(start, end, other_end) < 0
    apart &= side(other_start, other_end, start) * side(other_start, other_end, end) < 0
    return bool(np.triu(apart, 2).any())


def test_the_same_speaker_says_the_same_thing_twice():
    anatomy = random_anatomy(5)
    assert anatomy == random_anatomy(5) != random_anatomy(6)
    first = articulation_for(anatomy, "ʃ", random_habits(5))
    assert first == articulation_for(anatomy, "ʃ", random_habits(5))
    np.testing.assert_array_equal(tongue_surface(anatomy, first), tongue_surface(anatomy, first))


def test_movements_between_phones_are_smooth():
    anatomy, habits = random_anatomy(1), random_habits(1)
    for a, b in (("i", "ɑ"), ("s", "u"), ("ə", "ʃ")):
        first, second = (articulation_for(anatomy, phone, habits) for phone in (a, b))
        path = np.array([tongue_surface(anatomy, blend(first, second, t)) for t in np.linspace(0, 1, 41)])
        step = np.linalg.norm(np.diff(path, axis=0), axis=-1).max(axis=1)
        assert step.max() < 4 * step.mean()
        np.testing.assert_allclose(path[0], tongue_surface(anatomy, first))
        np.testing.assert_allclose(path[-1], tongue_surface(anatomy, second))


def test_the_sample_database_is_written_the_same_way_every_time(tmp_path):
    first, second = write_samples(tmp_path / "a"), write_samples(tmp_path / "b")
    assert first.read_bytes() == second.read_bytes()
    meshes = sorted((tmp_path / "a" / "meshes").iterdir())
    assert len(meshes) == 143
    for mesh in meshes[::20]:
        assert mesh.read_bytes() == (tmp_path / "b" / "meshes" / mesh.name).read_bytes()
    assert "synthetic" in first.read_text(encoding="utf-8").splitlines()[1]
