"""model fit: a registered mesh, another mesh, a point cloud; landmarks, the box, and what is refused."""

import json

import numpy as np
import pytest

from tonguetrack.model.cloud import Cloud
from tonguetrack.model.mesh import Mesh, mesh_bytes, read_mesh, vertex_normals
from tonguetrack.model.mri.cloudfile import cloud_bytes
from tonguetrack.tracker.bundled import bundled_model
from tonguetrack.tracker.cli import main

MODEL = bundled_model()


def somebody(seed=1):
    """Weights of a usual speaker and pose, and their mesh."""
    random = np.random.default_rng(seed)
    s, p = (
        mode.mean + 0.5 * mode.measured_sigma * random.normal(size=mode.size)
        for mode in (MODEL.speaker, MODEL.pose)
    )
    return Mesh(MODEL.vertices(s, p), MODEL.faces)


def write_mesh(path, mesh):
    path.write_bytes(mesh_bytes(mesh, path.suffix))
    return str(path)


def fitted(capsys, *arguments):
    assert main(["model", "fit", "bundled", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_a_mesh_of_the_models_own_vertices_is_met_vertex_by_vertex(tmp_path, capsys, suffix):
    mesh = somebody()
    found = fitted(
        capsys, write_mesh(tmp_path / f"mesh{suffix}", mesh), "--box", "5", "-o", tmp_path / "out.ply"
    )
    assert found["fitted"] == "vertex by vertex" and found["share_of_vertices"] == 1.0
    assert found["residual_mm"] < 1e-4 and found["converged"]
    written = read_mesh(tmp_path / "out.ply")
    np.testing.assert_allclose(written.vertices, mesh.vertices, atol=1e-3)
    np.testing.assert_array_equal(written.faces, MODEL.faces)
    shape = MODEL.vertices(found["speaker"]["weights"], found["pose"]["weights"])
    np.testing.assert_allclose(shape, mesh.vertices, atol=1e-3)
    np.testing.assert_allclose(
        MODEL.speaker.raw(found["speaker"]["normalised"]), found["speaker"]["weights"], atol=1e-12
    )


def thinned(mesh):
    """Every other point, in another order, with its normal."""
    order = np.random.default_rng(0).permutation(len(mesh.vertices))[::2]
    return Cloud(mesh.vertices[order], vertex_normals(mesh.vertices, mesh.faces)[order])


def apart(found, mesh):
    shape = MODEL.vertices(found["speaker"]["weights"], found["pose"]["weights"])
    return np.linalg.norm(shape - mesh.vertices, axis=1).mean()


def test_a_cloud_is_fitted_to_its_nearest_points_and_landmarks_bring_it_nearer(tmp_path, capsys):
    mesh = somebody(4)
    (tmp_path / "cloud.ply").write_bytes(cloud_bytes(thinned(mesh)))
    names = MODEL.marks.landmarks
    rows = [f"{name},{','.join(map(str, mesh.vertices[vertex]))}" for name, vertex in names.items()]
    more = [f"{v},{','.join(map(str, mesh.vertices[v]))}" for v in MODEL.marks.midsagittal[::8]]
    (tmp_path / "marks.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows, *more]) + "\n")
    blind = fitted(capsys, tmp_path / "cloud.ply")
    led = fitted(capsys, tmp_path / "cloud.ply", "--landmarks", tmp_path / "marks.csv")
    before = np.linalg.norm(MODEL.mean_vertices() - mesh.vertices, axis=1).mean()
    assert blind["fitted"] == "nearest points" and blind["share_of_vertices"] > 0.8
    assert apart(blind, mesh) < 0.6 * before
    assert apart(led, mesh) < apart(blind, mesh)


def test_a_mesh_with_other_faces_is_a_surface(tmp_path, capsys):
    mesh = somebody()
    turned = Mesh(mesh.vertices, np.roll(mesh.faces, 1, axis=0))
    found = fitted(capsys, write_mesh(tmp_path / "other.ply", turned))
    assert found["fitted"] == "nearest points"


def test_no_weight_leaves_the_box_and_those_at_it_are_marked(tmp_path, capsys):
    path = write_mesh(tmp_path / "mesh.ply", somebody())
    found = fitted(capsys, path, "--box", "0.1")
    for mode, name in ((MODEL.speaker, "speaker"), (MODEL.pose, "pose")):
        off = np.abs(np.array(found[name]["weights"]) - mode.mean)
        assert (off <= 0.1 * mode.measured_sigma + 1e-12).all()
        np.testing.assert_array_equal(
            found[name]["at_the_box"], off >= 0.1 * mode.measured_sigma * (1 - 1e-6)
        )
    assert any(found["speaker"]["at_the_box"])
    assert main(["model", "fit", "bundled", path, "--box", "0.1"]) == 0
    shown = capsys.readouterr().out
    assert "* held by the box of 0.1 deviations" in shown and MODEL.fingerprint in shown


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere.ply"], "nowhere.ply: there is no such mesh file"),
        (["{mesh}", "--landmarks", "{marks}"], "every one of which is known; leave the landmarks out"),
        (["{cloud}", "--landmarks", "{marks}"], "has no landmark 'Uvula'; its landmarks are"),
        (["{mesh}", "-o", "out.stl"], "out.stl: a mesh is written as .ply or .obj"),
        (["{mesh}", "-o", "{mesh}"], "this file is read here and would be overwritten"),
        (["{mesh}", "--box", "0"], "leaves no shape to fit"),
        (["{far}"], "bring it into the model's frame first"),
        (["{broken}"], "broken.ply: the file is cut short"),
    ],
)
def test_a_mistake_gets_one_sentence_and_exit_code_two(tmp_path, capsys, arguments, sentence):
    mesh = somebody()
    places = {name: str(tmp_path / f"{name}.ply") for name in ("mesh", "cloud", "far", "broken")}
    places["marks"] = str(tmp_path / "marks.csv")
    write_mesh(tmp_path / "mesh.ply", mesh)
    write_mesh(tmp_path / "far.ply", Mesh(mesh.vertices + 200.0, mesh.faces))
    whole = cloud_bytes(thinned(mesh))
    (tmp_path / "cloud.ply").write_bytes(whole)
    (tmp_path / "broken.ply").write_bytes(whole[:-100])
    (tmp_path / "marks.csv").write_text("name,x_mm,y_mm,z_mm\nUvula,1,2,3\n")
    assert main(["model", "fit", "bundled", *(part.format(**places) for part in arguments)]) == 2
    told = capsys.readouterr().err
    assert sentence in told and "Traceback" not in told and told.count("\n") == 1
