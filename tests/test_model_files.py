"""Model files: our .npz, the published YAML and JSON, and what is not a model."""

import base64
import dataclasses
import json
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.model.files import load_model, model_bytes, save_model


def test_our_file_keeps_everything(small_model, tmp_path):
    save_model(small_model, tmp_path / "m.npz")
    again = load_model(tmp_path / "m.npz")
    for name in ("core", "origin", "faces"):
        np.testing.assert_array_equal(getattr(again, name), getattr(small_model, name))
    for mode in ("speaker", "pose"):
        for name in ("mean", "training", "spectrum", "names", "entries"):
            np.testing.assert_array_equal(
                getattr(getattr(again, mode), name), getattr(getattr(small_model, mode), name)
            )
    assert again.marks == small_model.marks
    assert again.provenance == small_model.provenance
    assert again.fingerprint == small_model.fingerprint


def test_the_file_states_both_sigmas(small_model, tmp_path):
    save_model(small_model, tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as stored:
        np.testing.assert_allclose(stored["pose_sigma"], 1 / np.sqrt(13))
        np.testing.assert_array_equal(stored["pose_measured_sigma"], small_model.pose.measured_sigma)


@pytest.mark.parametrize("suffix", [".npz", ".yaml", ".json"])
def test_the_same_model_gives_the_same_bytes(small_model, suffix):
    assert model_bytes(small_model, suffix) == model_bytes(small_model, suffix)


@pytest.mark.parametrize("chain", [".npz .yaml .npz", ".yaml .json .yaml", ".json .npz .json"])
def test_conversion_there_and_back_is_exact_to_the_last_bit(small_model, tmp_path, chain):
    model = small_model
    for number, suffix in enumerate(chain.split()):
        path = tmp_path / f"{number}{suffix}"
        save_model(model, path)
        model = load_model(path)
    assert model.fingerprint == small_model.fingerprint
    np.testing.assert_array_equal(model.core, small_model.core)
    np.testing.assert_array_equal(model.speaker.mean, small_model.speaker.mean)


@pytest.mark.parametrize("suffix", [".npz", ".yaml", ".json"])
@pytest.mark.parametrize("scale", [1.0, 1e-300, 1e12])
def test_subnormal_huge_and_negative_zero_keep_their_bits(small_model, tmp_path, suffix, scale):
    core, origin = small_model.core * scale, np.array(small_model.origin)
    core[0, 0, :4] = [5e-324, -0.0, -2.2e-308, 1e-5 * scale]
    origin[:5] = [1e-5, -0.0, 5e-324, 1e22, 3.0]
    odd = dataclasses.replace(small_model, core=core, origin=origin)
    save_model(odd, tmp_path / f"m{suffix}")
    again = load_model(tmp_path / f"m{suffix}")
    assert again.core.tobytes() == core.tobytes()
    assert again.origin.tobytes() == origin.tobytes()


def test_a_yaml_as_others_write_it_is_read(small_model, tmp_path):
    """Another key order, block lists, whole numbers, exponents without a dot, a wrapped base64 string."""
    content = json.loads(model_bytes(small_model, ".json"))
    encoded = base64.encodebytes(small_model.core.tobytes()).decode()
    lines = ["ShapeSpace:", "  Faces:"]
    lines += [f"    - [{a}, {b}, {c}]" for a, b, c in content["ShapeSpace"]["Faces"]]
    lines += [
        "  Origin:",
        *(f"    - {value}" for value in ["1e-05", "-3", "2E+2", *content["ShapeSpace"]["Origin"][3:]]),
    ]
    lines += ["CoreTensor: |", *(f"  {line}" for line in encoded.split()), "MeanWeights:"]
    lines += [f"  {name}: {values}" for name, values in reversed(content["MeanWeights"].items())]
    lines += ["Dimensions:", *(f"  {name}: {size}" for name, size in reversed(content["Dimensions"].items()))]
    (tmp_path / "m.yaml").write_text("\n".join(lines) + "\n")
    again = load_model(tmp_path / "m.yaml")
    np.testing.assert_array_equal(again.core, small_model.core)
    np.testing.assert_array_equal(again.speaker.mean, small_model.speaker.mean)
    np.testing.assert_array_equal(again.origin, [1e-5, -3.0, 200.0, *small_model.origin[3:]])


@pytest.mark.parametrize(
    ("face", "sentence"),
    [
        ([0, 1, 1.5], "should hold vertex numbers"),
        ([0, 1, 2**32], "should hold vertex numbers"),
        ([0, 1, -1], "names vertex -1, but the model has 60 vertices, from 0"),
        ([0, 1, 60], "names vertex 60"),
    ],
)
def test_a_face_of_what_is_no_vertex_is_refused(small_model, tmp_path, face, sentence):
    content = json.loads(model_bytes(small_model, ".json"))
    content["ShapeSpace"]["Faces"][3] = face
    (tmp_path / "m.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=sentence):
        load_model(tmp_path / "m.json")


def test_the_published_layout_is_speaker_major(small_model):
    content = json.loads(model_bytes(small_model, ".json"))
    size = content["Dimensions"]
    assert size == {
        "OriginalSpeakerMode": 11,
        "OriginalPhonemeMode": 13,
        "TruncatedSpeakerMode": 5,
        "TruncatedPhonemeMode": 4,
        "VertexMode": 180,
    }
    i, j, k = 3, 2, 17
    assert content["CoreTensor"][i * 4 * 180 + j * 180 + k] == small_model.core[i, j, k]


def test_a_core_of_big_endian_doubles_is_read(small_model, tmp_path):
    text = model_bytes(small_model, ".yaml").decode()
    start = text.index('"') + 1
    swapped = base64.b64encode(small_model.core.astype(">f8").tobytes()).decode()
    (tmp_path / "big.yaml").write_text(text[:start] + swapped + text[text.index('"', start) :])
    np.testing.assert_array_equal(load_model(tmp_path / "big.yaml").core, small_model.core)


def test_the_authors_model_file_opens(reference_data, tmp_path):
    model = load_model(reference_data / "authors-format" / "synthetic_model.yaml")
    assert model.core.shape == (5, 4, 9300)
    assert len(model.faces) == 6102
    assert (model.speaker.entries, model.pose.entries) == (11, 13)
    save_model(model, tmp_path / "again.yaml")
    assert load_model(tmp_path / "again.yaml").fingerprint == model.fingerprint


def test_the_authors_yaml_is_written_back_number_for_number(reference_data, tmp_path):
    import yaml

    source = reference_data / "authors-format" / "synthetic_model.yaml"
    save_model(load_model(source), tmp_path / "again.yaml")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    assert yaml.load(source.read_bytes(), loader) == yaml.load((tmp_path / "again.yaml").read_bytes(), loader)


def test_no_pickle_is_ever_opened(tmp_path):
    np.savez(tmp_path / "evil.npz", header=np.array([object()], dtype=object))
    with pytest.raises(InputError, match="not of plain numbers"):
        load_model(tmp_path / "evil.npz")


def test_a_zip_that_unpacks_without_end_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("tonguetrack.model.files.MAX_MODEL_BYTES", 100_000)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("header.npy", b"\0" * 1_000_000)
    with pytest.raises(InputError, match="would unpack to 1000000 bytes"):
        load_model(tmp_path / "bomb.npz")


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("absent.npz", None, "there is no such model file"),
        ("model.txt", b"x", "a model file ends in one of"),
        ("empty.npz", b"", "damaged or cut short"),
        ("text.npz", b"hello", "damaged or cut short"),
        ("list.json", b"[1, 2]", "not a published tongue model"),
        ("cut.json", b'{"CoreTensor": [1,', "not a readable tongue model"),
        ("bad.yaml", b"a: [1, 2", "not readable YAML at line"),
        ("deep.yaml", b"[" * 200_000, "nested more than 100 levels deep"),
        ("deep.json", b"[" * 200_000, "not a readable tongue model"),
        ("other.yaml", b"meta: 1", "not a published tongue model"),
    ],
)
def test_what_is_not_a_model_gets_one_sentence(tmp_path, name, content, sentence):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=sentence) as caught:
        load_model(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["VertexMode", "TruncatedPhonemeMode"])
def test_dimensions_that_contradict_the_core_are_refused(small_model, tmp_path, key):
    content = json.loads(model_bytes(small_model, ".json"))
    content["Dimensions"][key] += 1
    (tmp_path / "m.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="CoreTensor holds 3600 numbers, but Dimensions say"):
        load_model(tmp_path / "m.json")


@pytest.mark.parametrize("suffix", [".npz", ".yaml", ".json"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_model_file_opens_or_says_so(small_model, tmp_path, suffix, data):
    whole = bytearray(model_bytes(small_model, suffix))
    cut = data.draw(st.integers(0, len(whole)))
    damaged = whole[:cut] if data.draw(st.booleans()) else whole
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(bytes(damaged))
    try:
        load_model(path)
    except InputError as reason:
        assert str(path) in str(reason)
