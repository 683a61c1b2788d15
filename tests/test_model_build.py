"""Models from sample databases of registered meshes."""

import numpy as np
import pytest
import yaml

from tonguetrack import InputError
from tonguetrack.model.build import (
    fill_missing_by_averaging,
    load_training_shapes,
    model_from_shapes,
    read_sample_database,
)
from tonguetrack.model.mesh import Mesh, mesh_bytes, read_mesh
from tonguetrack.model.tensor import cumulative_compactness

PAPER_SPEAKERS = [.5424, .7734, .8361, .8863, .9177, .9416, .9609, .9751, .9853, .9931, 1]  # fmt: skip
PAPER_POSES = [.4931, .7903, .8771, .9185, .9420, .9591, .9715, .9808, .9875, .9923, .9960, .9983, 1]  # fmt: skip
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


@pytest.fixture()
def database(tmp_path):
    """3 speakers x 2 prompts of tetrahedra-sized meshes, as a dictionary that a test may spoil, and a writer."""
    random = np.random.default_rng(0)
    content = {"meta": {"speakerAmount": 3, "phonemeAmount": 2}, "data": []}
    for speaker in ("A", "B", "C"):
        phones = []
        for prompt in ("i", "u"):
            path = f"{speaker}_{prompt}.ply"
            (tmp_path / path).write_bytes(mesh_bytes(Mesh(random.normal(size=(4, 3)) * 10, FACES), ".ply"))
            phones.append({"prompt": prompt, "path": path})
        content["data"].append({"name": speaker, "phonemes": phones})

    def write():
        (tmp_path / "samples.yaml").write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
        return tmp_path / "samples.yaml"

    return content, write


def test_the_papers_meshes_give_the_papers_compactness(reference_data):
    shapes = load_training_shapes(
        read_sample_database(reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml")
    )
    model = model_from_shapes(shapes, 5, 4)
    np.testing.assert_allclose(cumulative_compactness(model.speaker.spectrum), PAPER_SPEAKERS, atol=5e-5)
    np.testing.assert_allclose(cumulative_compactness(model.pose.spectrum), PAPER_POSES, atol=5e-5)
    assert model.core.shape == (5, 4, 9300)
    assert shapes.filled == ()
    # One component per mode is nearly constant over the training set: it carries the mean.
    assert model.speaker.measured_sigma.min() < 0.3 * model.speaker.sigma[0]


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_meshes_are_written_and_read_in_their_own_order(tmp_path, suffix):
    vertices = np.random.default_rng(1).normal(size=(50, 3)) * 30
    vertices[10] = vertices[20]  # a reader that merges equal vertices would lose one
    faces = np.array([[0, 10, 20], [49, 3, 7], [5, 6, 7]], dtype=np.int32)
    (tmp_path / f"mesh{suffix}").write_bytes(mesh_bytes(Mesh(vertices, faces), suffix))
    mesh = read_mesh(tmp_path / f"mesh{suffix}")
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, faces)


def test_a_full_model_reproduces_every_training_mesh(database):
    _, write = database
    shapes = load_training_shapes(read_sample_database(write()))
    model = model_from_shapes(shapes, 3, 2)
    for i, s in enumerate(model.speaker.training):
        for j, p in enumerate(model.pose.training):
            np.testing.assert_allclose(model.vertices(s, p).ravel(), shapes.tensor[i, j], atol=1e-9)
    assert model.speaker.names == ("A", "B", "C")
    assert model.pose.names == ("i", "u")


def test_a_missing_cell_is_the_average_of_its_speakers_and_its_poses_means():
    tensor = np.random.default_rng(2).normal(size=(3, 4, 5))
    whole = tensor.copy()
    tensor[1, 2] = np.nan
    complete, missing = fill_missing_by_averaging(tensor)
    assert missing == [(1, 2)]
    own = whole[1, [0, 1, 3]].mean(axis=0)
    others = whole[[0, 2], 2].mean(axis=0)
    np.testing.assert_allclose(complete[1, 2], (own + others) / 2)
    complete[1, 2] = whole[1, 2]
    np.testing.assert_array_equal(complete, whole)


def test_filled_cells_never_feed_one_another():
    tensor = np.random.default_rng(3).normal(size=(3, 3, 2))
    tensor[0, 0] = tensor[0, 1] = np.nan
    complete, _ = fill_missing_by_averaging(tensor)
    np.testing.assert_allclose(complete[0, 1], (tensor[0, 2] + tensor[1:, 1].mean(axis=0)) / 2)


@pytest.mark.parametrize("how", ["left out", "null"])
def test_a_prompt_that_a_speaker_lacks_is_filled_and_said(database, how):
    content, write = database
    if how == "null":
        content["data"][1]["phonemes"][0]["path"] = None
    else:
        del content["data"][1]["phonemes"][0]
    shapes = load_training_shapes(read_sample_database(write()))
    assert shapes.filled == (("B", "i"),)
    assert "filled" in model_from_shapes(shapes, 2, 2).provenance


def test_a_speaker_without_any_mesh_cannot_be_averaged():
    tensor = np.zeros((2, 2, 3))
    tensor[1] = np.nan
    with pytest.raises(InputError, match="speaker 1 .* has no mesh at all"):
        fill_missing_by_averaging(tensor)


def test_marks_and_provenance_of_the_database_reach_the_model(database):
    content, write = database
    content["template"] = {"landmarks": {"Tip": 3}, "regions": {"tip": [2, 3]}, "midsagittal": [3, 0]}
    content["provenance"] = "synthetic: a test"
    model = model_from_shapes(load_training_shapes(read_sample_database(write())), 2, 2, {"name": "test"})
    assert model.marks.landmarks == {"Tip": 3}
    assert model.marks.midsagittal == (3, 0)
    assert model.provenance["data"] == "synthetic: a test"
    assert model.name == "test"


def spoil(content, what):
    match what:
        case "speaker twice":
            content["data"][1]["name"] = "A"
        case "prompt twice":
            content["data"][1]["phonemes"][1]["prompt"] = "i"
        case "unknown prompt":
            content["data"][2]["phonemes"][0]["prompt"] = "ii"
        case "speaker amount":
            content["meta"]["speakerAmount"] = 4
        case "prompt amount":
            content["meta"]["phonemeAmount"] = 3
        case "missing file":
            content["data"][1]["phonemes"][0]["path"] = "nowhere.ply"
        case "no data":
            del content["data"]
        case "mark outside":
            content["template"] = {"landmarks": {"Tip": 4}}
        case "mark nonsense":
            content["template"] = {"midsagittal": ["tip"]}


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ("speaker twice", "the speaker 'A' is listed twice"),
        ("prompt twice", "speaker 'B' lists the prompt 'i' twice"),
        ("unknown prompt", "unknown prompt 'ii' of speaker 'C'"),
        ("speaker amount", "meta says 4 speakers, but data lists 3"),
        ("prompt amount", "meta says 3 prompts, but data lists only 2: i, u"),
        ("missing file", r"nowhere.ply: there is no such mesh file. \(speaker 'B', prompt 'i'"),
        ("no data", "this is not a sample database"),
        ("mark outside", "template/landmarks/Tip names vertex 4; the meshes have vertices 0 to 3"),
        ("mark nonsense", "'template' must hold landmarks"),
    ],
)
def test_a_database_that_contradicts_itself_gets_one_sentence(database, what, sentence):
    content, write = database
    spoil(content, what)
    with pytest.raises(InputError, match=sentence) as caught:
        load_training_shapes(read_sample_database(write()))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("other", ["faces", "vertices"])
def test_a_mesh_with_another_face_list_is_named(database, tmp_path, other):
    _, write = database
    vertices = np.zeros((5 if other == "vertices" else 4, 3))
    faces = FACES[::-1] if other == "faces" else FACES
    (tmp_path / "C_u.ply").write_bytes(
        mesh_bytes(Mesh(vertices + np.arange(len(vertices))[:, None], faces), ".ply")
    )
    with pytest.raises(InputError, match=r"C_u.ply: its face list .* is not that of A_i.ply"):
        load_training_shapes(read_sample_database(write()))


@pytest.mark.parametrize("content", [b"", b"ply\nformat ascii 1.0\n", b"\x00\x01\x02", b"hello"])
def test_a_damaged_mesh_gets_one_sentence(tmp_path, content):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"bad.ply: ") as caught:
        read_mesh(tmp_path / "bad.ply")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("speakers", "poses"), [(0, 2), (4, 2), (2, 3)])
def test_impossible_numbers_of_modes_are_refused(database, speakers, poses):
    _, write = database
    shapes = load_training_shapes(read_sample_database(write()))
    with pytest.raises(InputError, match=r"-modes \d: expected a number from 1 to"):
        model_from_shapes(shapes, speakers, poses)
