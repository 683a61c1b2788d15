"""Template matching: the surface that is there is found, smoothly, wherever the head lies; the rest is left alone."""

from dataclasses import replace

import numpy as np
import pytest
from phantoms import shared_phantom
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tonguetrack import InputError
from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mesh import Mesh, mesh_bytes, read_mesh, vertex_normals
from tonguetrack.model.mri import bending
from tonguetrack.model.mri.cloudfile import cloud_bytes
from tonguetrack.model.mri.dataset import landmarks_csv, load_dataset
from tonguetrack.model.mri.diffusion import denoise
from tonguetrack.model.mri.matching import (
    PALATE,
    PAPER_PALATE,
    PAPER_TONGUE,
    TONGUE,
    MatchSettings,
    flipped_faces,
    match,
)
from tonguetrack.model.mri.phantom.surfaces import BARE, BURIED
from tonguetrack.model.mri.phantom.truth import read_truth
from tonguetrack.model.mri.scan import read_scan
from tonguetrack.model.mri.surface import surface_points
from tonguetrack.model.mri.templates import palate, placed, tongue
from tonguetrack.model.neighbours import NeighbourRule, SurfaceIndex
from tonguetrack.model.synthetic import Anatomy, tongue_surface
from tonguetrack.model.synthetic.articulation import PHONES
from tonguetrack.tracker.cli import main

FACES = tongue().mesh.faces


def points_on(vertices, faces, count, seed=0):
    """A cloud of so many points, spread evenly over a mesh."""
    random = np.random.default_rng(seed)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1)
    pick = random.choice(len(faces), count, p=area / area.sum())
    u, v = np.sort(random.random((2, count)), axis=0)
    shares = np.stack([u, v - u, 1.0 - v], axis=1)
    points = np.einsum("pc,pcx->px", shares, vertices[faces[pick]])
    normals = np.einsum("pc,pcx->px", shares, vertex_normals(vertices, faces)[faces[pick]])
    return Cloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def surface_distance(points, vertices, faces):
    """(n,) mm from points to a mesh, by a dense sample of it: too large by 0.05 mm at most."""
    return cKDTree(points_on(vertices, faces, 400_000).points).query(points)[0]


# The kernels ----------------------------------------------------------------------------------------------


@pytest.fixture
def bent():
    """A tongue at rest, the same in another articulation, and its edges."""
    edges = bending.edges_of(FACES, len(tongue().mesh.vertices))
    return tongue().mesh.vertices, tongue_surface(Anatomy("somebody"), PHONES["i"]), edges


def test_edges_join_every_vertex_to_those_it_shares_a_face_with(bent):
    edges = bent[2]
    for vertex in (0, 24, 1592, 3380):
        expected = set(FACES[(FACES == vertex).any(axis=1)].ravel().tolist()) - {vertex}
        assert set(edges.others[edges.starts[vertex] : edges.starts[vertex + 1]].tolist()) == expected


def test_rotations_are_those_of_least_squares_and_never_reflections(bent):
    rest, current, edges = bent
    rotations = bending.no_rotations(len(rest))
    bending.turn(rotations, rest, current, edges.starts, edges.others)
    for vertex in range(0, len(rest), 131):
        ring = edges.others[edges.starts[vertex] : edges.starts[vertex + 1]]
        expected, _ = Rotation.align_vectors(current[ring] - current[vertex], rest[ring] - rest[vertex])
        np.testing.assert_allclose(rotations[vertex], expected.as_matrix(), atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)


def test_positions_are_those_of_least_energy_for_the_rotations(bent):
    """Against the same sums, written out and solved by a general solver."""
    from scipy.sparse import coo_array, csc_array, diags_array
    from scipy.sparse.linalg import spsolve

    rest, current, edges = bent
    random = np.random.default_rng(1)
    weights = random.random(len(rest)) * (random.random(len(rest)) < 0.5) / len(rest)
    targets = current + random.normal(size=current.shape)
    rotations = bending.no_rotations(len(rest))
    bending.turn(rotations, rest, current, edges.starts, edges.others)
    stiffness = 2.0 / len(rest)
    found = rest.copy()
    bending.move(found, rotations, rest, edges.starts, edges.others, weights, targets, stiffness)

    first = np.repeat(np.arange(len(rest)), np.diff(edges.starts))
    second = edges.others
    rows = np.arange(len(first))
    ones = np.ones(len(first))
    difference = csc_array(coo_array((ones, (rows, first)), (len(first), len(rest)))) - csc_array(
        coo_array((ones, (rows, second)), (len(first), len(rest)))
    )
    turned = np.einsum("eab,eb->ea", rotations[first], rest[first] - rest[second])
    system = csc_array(diags_array(weights) + stiffness * (difference.T @ difference))
    expected = spsolve(system, weights[:, None] * targets + stiffness * (difference.T @ turned))
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_neither_step_ever_raises_the_energy(bent):
    rest, current, edges = bent
    weights, stiffness = np.full(len(rest), 1.0 / len(rest)), 5.0 / len(rest)
    targets = current
    found, rotations = rest.copy(), bending.no_rotations(len(rest))

    def energy():
        bent_by = bending.bent(found, rotations, rest, edges.starts, edges.others)
        return weights @ np.sum((found - targets) ** 2, axis=1) + stiffness * bent_by

    at_first = last = energy()
    for _ in range(10):
        bending.turn(rotations, rest, found, edges.starts, edges.others)
        turned = energy()
        bending.move(found, rotations, rest, edges.starts, edges.others, weights, targets, stiffness)
        assert energy() <= turned + 1e-9 <= last + 2e-9
        last = energy()
    assert last < 0.2 * at_first


def test_a_rigid_motion_bends_nothing_and_averaging_keeps_it(bent):
    rest, _, edges = bent
    turn = Rotation.from_rotvec([0.3, -2.0, 0.9])
    moved = turn.apply(rest) + [10.0, -20.0, 30.0]
    rotations = bending.no_rotations(len(rest))
    bending.turn(rotations, rest, moved, edges.starts, edges.others)
    assert bending.bent(moved, rotations, rest, edges.starts, edges.others) < 1e-6
    again = bending.averaged(moved, rotations, rest, edges.starts, edges.others)
    np.testing.assert_allclose(again, moved, atol=1e-4)


# Surfaces that are known ------------------------------------------------------------------------------------


def case(phone="e", anatomy=None):
    """(what is sought (n, 3), its landmarks) of a speaker of the template's own family."""
    vertices = tongue_surface(anatomy or Anatomy("somebody", size=1.05, thickness=1.08), PHONES[phone])
    return vertices, {name: vertices[vertex] for name, vertex in tongue().landmarks.items()}


def test_a_tongue_of_another_speaker_and_phone_is_found_to_some_tenths_of_a_millimetre():
    vertices, landmarks = case()
    cloud = points_on(vertices, FACES, 20_000)
    start = placed(tongue(), landmarks)
    seen = vertices[list(tongue().marks.regions["combined"])]
    before = surface_distance(seen, start, FACES).mean()
    found = match(start, tongue(), SurfaceIndex(cloud), landmarks, TONGUE)
    after = surface_distance(seen, found.vertices, FACES)
    assert after.mean() < 0.15 < before / 5
    assert found.flipped == 0 and found.valid > 0.95
    assert found.residual_mm < 0.15


def test_the_inputs_stay_as_they_were():
    vertices, landmarks = case()
    cloud = points_on(vertices, FACES, 5_000)
    start = placed(tongue(), landmarks)
    kept = start.copy(), cloud.points.copy(), cloud.normals.copy(), tongue().mesh.vertices.copy()
    match(start, tongue(), SurfaceIndex(cloud), landmarks, replace(TONGUE, energies=3))
    for now, then in zip((start, cloud.points, cloud.normals, tongue().mesh.vertices), kept, strict=True):
        np.testing.assert_array_equal(now, then)


def test_a_head_that_lies_elsewhere_has_the_same_tongue_there():
    vertices, landmarks = case()
    cloud = points_on(vertices, FACES, 10_000)
    settings = replace(TONGUE, energies=15)
    here = match(placed(tongue(), landmarks), tongue(), SurfaceIndex(cloud), landmarks, settings)
    turn, shift = Rotation.from_rotvec([0.4, 0.2, -1.1]), np.array([80.0, -30.0, 200.0])
    moved = Cloud(turn.apply(cloud.points) + shift, turn.apply(cloud.normals))
    marks = {name: turn.apply(place) + shift for name, place in landmarks.items()}
    there = match(placed(tongue(), marks), tongue(), SurfaceIndex(moved), marks, settings)
    apart = np.linalg.norm(there.vertices - turn.apply(here.vertices) - shift, axis=1)
    assert apart.mean() < 0.01 and apart.max() < 0.2  # as far as the systems are solved
    assert there.valid == pytest.approx(here.valid, abs=1e-3)


def test_left_and_right_are_treated_alike():
    vertices, landmarks = case("s", Anatomy("somebody", width=1.1))
    cloud = points_on(vertices, FACES, 10_000)
    mirrored = Cloud(cloud.points * [-1, 1, 1], cloud.normals * [-1, 1, 1])
    swapped = {
        name.replace("Left", "#").replace("Right", "Left").replace("#", "Right"): place * [-1, 1, 1]
        for name, place in landmarks.items()
    }
    settings = replace(TONGUE, energies=15)
    one = match(placed(tongue(), landmarks), tongue(), SurfaceIndex(cloud), landmarks, settings)
    other = match(placed(tongue(), swapped), tongue(), SurfaceIndex(mirrored), swapped, settings)
    apart = np.linalg.norm(other.vertices[tongue().mirror] * [-1, 1, 1] - one.vertices, axis=1)
    assert apart.mean() < 0.02


def test_points_of_something_else_above_the_tongue_do_not_hold_it_up():
    vertices, landmarks = case("a")
    cloud = points_on(vertices, FACES, 15_000)
    above = cloud.normals[:, 2] > 0.7
    strays = cloud.points[above] + 3.0 * cloud.normals[above]
    both = Cloud(
        np.concatenate([cloud.points, strays]), np.concatenate([cloud.normals, cloud.normals[above]])
    )
    start = placed(tongue(), landmarks) + [0.0, 0.0, 2.0]  # nearer to the strays than to the tongue
    found = match(start, tongue(), SurfaceIndex(both), landmarks, TONGUE)
    upper = vertex_normals(vertices, FACES)[:, 2] > 0.7
    assert surface_distance(vertices[upper], found.vertices, FACES).mean() < 0.2


def test_where_nothing_is_seen_the_surface_goes_along_with_the_rest():
    """A hole of 20 mm in the middle of the back is bridged: no dent, no bulge, no fold."""
    vertices, landmarks = case()
    cloud = points_on(vertices, FACES, 20_000)
    middle = landmarks["SurfaceCenter"]
    kept = np.linalg.norm(cloud.points - middle, axis=1) > 10.0
    found = match(
        placed(tongue(), landmarks), tongue(), SurfaceIndex(Cloud(cloud.points[kept], cloud.normals[kept])),
        {name: place for name, place in landmarks.items() if name != "SurfaceCenter"}, TONGUE,
    )  # fmt: skip
    hole = np.linalg.norm(vertices - middle, axis=1) < 10.0
    assert surface_distance(vertices[hole], found.vertices, FACES).max() < 1.5
    assert found.flipped == 0


def test_a_landmark_is_kept_as_far_as_its_last_weight_says():
    vertices, landmarks = case()
    index = SurfaceIndex(points_on(vertices, FACES, 10_000))
    off = {**landmarks, "SurfaceCenter": landmarks["SurfaceCenter"] + [0.0, 0.0, 4.0]}
    start = placed(tongue(), off)
    missed = {}
    for weight in (0.0, 10.0):
        settings = replace(TONGUE, least_landmarks=weight, smooth_afterwards=False)
        found = match(start, tongue(), index, off, settings).vertices
        missed[weight] = np.linalg.norm(found[tongue().landmarks["SurfaceCenter"]] - off["SurfaceCenter"])
    assert missed[10.0] < 0.2
    assert missed[0.0] > 1.0


def test_averaging_afterwards_takes_the_spike_off_a_misplaced_landmark():
    vertices, landmarks = case()
    index = SurfaceIndex(points_on(vertices, FACES, 10_000))
    off = {**landmarks, "SurfaceCenter": landmarks["SurfaceCenter"] + [0.0, 0.0, 3.0]}
    start = placed(tongue(), off)
    height = {}
    for smooth in (False, True):
        settings = replace(TONGUE, least_landmarks=10.0, smooth_afterwards=smooth)
        height[smooth] = match(start, tongue(), index, off, settings).vertices[
            tongue().landmarks["SurfaceCenter"], 2
        ]
    assert height[True] < height[False] - 0.5


def test_a_stiffer_matching_bends_less():
    vertices, landmarks = case("i")
    index = SurfaceIndex(points_on(vertices, FACES, 10_000))
    start = placed(tongue(), landmarks)
    edges = bending.edges_of(FACES, len(start))
    bends = []
    for smoothness in (0.5, 5.0, 100.0):
        found = match(start, tongue(), index, {}, MatchSettings(100.0, smoothness)).vertices
        rotations = bending.no_rotations(len(start))
        bending.turn(rotations, start, found, edges.starts, edges.others)
        bends.append(bending.bent(found, rotations, start, edges.starts, edges.others))
    assert bends[0] > 1.5 * bends[1] > 1.5 * bends[2]


def test_folded_faces_are_counted():
    vertices = tongue().mesh.vertices
    assert flipped_faces(vertices, FACES) == 0
    folded = vertices.copy()
    inside, across = 1592, 1594  # two columns apart on the back
    folded[inside] += 2.0 * (vertices[across] - vertices[inside])
    assert flipped_faces(folded, FACES) > 0


def test_the_papers_values_are_kept_beside_ours():
    assert (PAPER_TONGUE.smoothness, PAPER_TONGUE.least_smoothness) == (10.0, 6.0)
    assert (PAPER_TONGUE.landmarks, PAPER_TONGUE.least_landmarks) == (10.0, 0.0)
    assert (PAPER_PALATE.landmarks, PAPER_PALATE.least_landmarks) == (10.0, 10.0)
    for settings in (PAPER_TONGUE, PAPER_PALATE):
        assert settings.energies == 40 and settings.smooth_afterwards
        assert settings.rule == settings.last_rule == NeighbourRule(4.0, 60.0)


def test_what_cannot_be_matched_is_refused():
    vertices, landmarks = case()
    index = SurfaceIndex(points_on(vertices, FACES, 2_000))
    start = placed(tongue(), landmarks)
    with pytest.raises(InputError, match="3381 vertices of its template"):
        match(start[:-1], tongue(), index, landmarks, TONGUE)
    with pytest.raises(InputError, match="all of them numbers"):
        match(np.full_like(start, np.nan), tongue(), index, landmarks, TONGUE)
    with pytest.raises(InputError, match="no landmark 'VaultCenter'"):
        match(start, tongue(), index, {"VaultCenter": np.zeros(3)}, TONGUE)
    with pytest.raises(InputError, match="no point of the cloud lies within 4 mm of the tongue"):
        match(start + 500.0, tongue(), index, {}, TONGUE)
    with pytest.raises(InputError, match="one energy or more"):
        match(start, tongue(), index, landmarks, replace(TONGUE, energies=0))


# Phantom scans, whose truth is known --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """(speaker, phone) -> entry of the data set, cloud, truth."""
    dataset = load_dataset(shared_phantom(tmp_path_factory))
    found = {}
    for key, entry in dataset.scans.items():
        scan = read_scan(entry.path).quantised()
        cloud = surface_points(scan.holding(denoise(scan.values, scan.spacing_mm)))
        truth = dataset.source.parent / "truth" / entry.path.name.replace(".nii.gz", ".npz")
        found[key] = entry, cloud, read_truth(truth)
    return found


@pytest.fixture(scope="module")
def misses(scans):
    """Settings -> what came out, and the truth's mean distance to it where it is seen and where it is not, mm; of every
    scan of one speaker, contact with the palate unrestored."""
    rows = {}
    for (speaker, _), (entry, cloud, truth) in scans.items():
        if speaker != "Speaker01":
            continue
        index, start = SurfaceIndex(cloud), placed(tongue(), entry.tongue_landmarks)
        for name, settings in (("ours", TONGUE), ("paper", PAPER_TONGUE)):
            found = match(start, tongue(), index, entry.tongue_landmarks, settings)
            apart = surface_distance(truth.tongue.vertices[::3], found.vertices, FACES)
            kinds = truth.kind[::3]
            rows.setdefault(name, []).append(
                (found, apart[kinds == BARE].mean(), apart[kinds == BURIED].mean())
            )
    return rows


def test_tongues_in_scans_are_found_well_within_a_voxel(misses):
    """Where air, teeth or bone shows their surface."""
    assert len(misses["ours"]) == 3
    for found, seen, _ in misses["ours"]:
        assert seen < 0.6
        assert found.flipped <= 3


def test_our_settings_are_nearer_to_the_truth_than_the_papers_above_all_where_nothing_is_seen(misses):
    seen, unseen = np.mean([row[1:] for row in misses["ours"]], axis=0)
    papers_seen, papers_unseen = np.mean([row[1:] for row in misses["paper"]], axis=0)
    assert seen < papers_seen
    assert unseen < 0.9 * papers_unseen


def test_palates_in_scans_are_found_within_a_voxel(scans):
    shown = [found for found in scans.values() if found[0].palate_landmarks is not None]
    assert len(shown) == 2
    for entry, cloud, truth in shown:
        start = placed(palate(), entry.palate_landmarks)
        found = match(start, palate(), SurfaceIndex(cloud), entry.palate_landmarks, PALATE)
        apart = surface_distance(truth.palate.vertices, found.vertices, palate().mesh.faces)
        assert apart.mean() < 1.0
        assert found.flipped == 0


# The command ------------------------------------------------------------------------------------------------


def test_the_command_matches_a_scan_and_its_cloud_alike(scans, tmp_path, capsys):
    entry, cloud, truth = next(iter(scans.values()))
    (tmp_path / "marks.csv").write_text(landmarks_csv(entry.tongue_landmarks))
    (tmp_path / "cloud.ply").write_bytes(cloud_bytes(cloud))
    meshes = []
    for source in (entry.path, tmp_path / "cloud.ply"):
        given = ["--template", "tongue", "--landmarks", tmp_path / "marks.csv", "-o", tmp_path / "out.ply"]
        assert main(["mri", "match", *map(str, [source, *given])]) == 0
        said = capsys.readouterr().err
        assert "0 faces are flipped" in said and "% of the tongue's vertices" in said
        meshes.append(read_mesh(tmp_path / "out.ply"))
    np.testing.assert_array_equal(meshes[0].faces, FACES)
    np.testing.assert_allclose(meshes[1].vertices, meshes[0].vertices, atol=0.02)
    shown = truth.tongue.vertices[truth.kind == BARE]
    assert surface_distance(shown, meshes[0].vertices, FACES).mean() < 0.6


def test_the_command_begins_with_a_mesh_where_one_is_given(tmp_path, capsys):
    vertices, landmarks = case()
    files = {name: tmp_path / name for name in ("cloud.ply", "marks.csv", "start.ply", "out.ply")}
    files["cloud.ply"].write_bytes(cloud_bytes(points_on(vertices, FACES, 5_000)))
    # Marks that would lead elsewhere; their weight goes to 0 as the series goes on.
    files["marks.csv"].write_text(landmarks_csv({"Tip": landmarks["Tip"]}))
    files["start.ply"].write_bytes(mesh_bytes(Mesh(vertices, FACES), ".ply"))
    arguments = ["mri", "match", str(files["cloud.ply"]), "--template", "tongue", "--landmarks"]
    arguments += [str(files["marks.csv"]), "-o", str(files["out.ply"])]
    assert main([*arguments]) == 2
    assert "3 landmarks or more" in capsys.readouterr().err
    assert main([*arguments, "--start", str(files["start.ply"])]) == 0
    apart = np.linalg.norm(read_mesh(files["out.ply"]).vertices - vertices, axis=1)
    assert apart.mean() < 0.3


def test_the_command_refuses_in_one_sentence_what_it_cannot_use(tmp_path, capsys):
    vertices, landmarks = case()
    cloud, marks, other = tmp_path / "cloud.ply", tmp_path / "marks.csv", tmp_path / "other.ply"
    cloud.write_bytes(cloud_bytes(points_on(vertices, FACES, 5_000)))
    marks.write_text(landmarks_csv(landmarks))
    other.write_bytes(mesh_bytes(palate().mesh, ".ply"))
    bare = tmp_path / "bare.ply"
    bare.write_bytes(cloud_bytes(Cloud(vertices)))
    away = tmp_path / "away.csv"
    away.write_text(landmarks_csv({name: place + 900.0 for name, place in landmarks.items()}))
    out = str(tmp_path / "out.ply")
    for source, template, named, start, target, sentence in (
        (cloud, "palate", marks, None, out, "marks.csv: the palate has no landmark 'Tip'"),
        (cloud, "tongue", marks, other, out, "other.ply: 1014 vertices are not those of the tongue template"),
        (cloud, "tongue", marks, None, str(tmp_path / "out.stl"), "written as .ply or .obj"),
        (cloud, "tongue", marks, None, str(cloud), "would be overwritten"),
        (bare, "tongue", marks, None, out, "bare.ply: the point cloud has no normals"),
        (tmp_path / "none.nii", "tongue", marks, None, out, "there is no such scan"),
    ):
        arguments = [source, "--template", template, "--landmarks", named, "-o", target]
        arguments += [] if start is None else ["--start", start]
        assert main(["mri", "match", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert sentence in said and len(said.splitlines()) == 1
    assert not (tmp_path / "out.ply").exists()
