"""Every real recording opens, and what is known about it holds."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from tonguetrack import InputError
from tonguetrack.drivers import find_recordings, open_recording


@pytest.fixture
def recordings(reference_data: Path) -> Path:
    return reference_data / "recordings"


def mean(recording, coil):
    return np.nanmean(recording.positions[:, recording.coils.index(coil)], axis=0)


def live(recording):
    return [c for c, some in zip(recording.coils, recording.valid().any(axis=0), strict=True) if some]


def test_an_ag501_sweep_opens_with_its_header(recordings):
    sweep = open_recording(recordings / "ag501_reidy/0021.pos")
    assert sweep.format == "Carstens AG50x .pos V003"
    assert (sweep.frame_count, sweep.rate_hz, len(sweep.coils)) == (5021, 250.0, 16)
    assert live(sweep) == [f"Ch{k}" for k in range(1, 9)]
    assert (sweep.frame.x, sweep.frame.y, sweep.frame.z) == ("front", "left", "up")
    assert sweep.extra["normpos.FIR_kaiserd_P_5_15_60_250"] == "1,2"
    assert any("Ch9, Ch10" in note for note in sweep.notes)
    assert np.isnan(sweep.rms[:, 8:]).all() and (sweep.rms[:, :8] >= 0).all()


def test_an_ag501_sweep_equals_its_text_export(recordings):
    binary = open_recording(recordings / "ag501_reidy/0021.pos")
    text = open_recording(recordings / "ag501_reidy/0021.txt", rate_hz=250)
    assert text.format == "Carstens .txt export without header"
    assert text.coils == binary.coils
    np.testing.assert_array_equal(text.valid(), binary.valid())
    assert np.nanmax(np.abs(text.positions - binary.positions)) <= 0.005
    assert np.nanmax(np.abs(text.rms - binary.rms)) <= 0.005
    assert np.nanmax(np.abs(text.orientations - binary.orientations)) < np.deg2rad(0.005) * 2
    np.testing.assert_array_equal(text.times_s, binary.times_s)


def test_orientations_are_unit_vectors_wherever_a_coil_is(recordings):
    for file, rate in [
        ("ag501_reidy/0021.pos", None),
        ("rticulate_ag500/0025.pos", None),
        ("emu_webapp/ssff/0020.t_tip", None),
        ("tardis/ema_original/sf2_0005.txt", 250),
        ("tardis/ema_ssff/sf2_0005.TT", None),
        ("ndi_wave_ematoblender/Example3.tsv", None),
    ]:
        recording = open_recording(recordings / file, rate_hz=rate)
        length = np.linalg.norm(recording.orientations[recording.valid()], axis=1)
        np.testing.assert_allclose(length, 1.0, atol=1e-9)


def test_a_text_export_asks_for_its_rate(recordings):
    with pytest.raises(InputError, match="--rate"):
        open_recording(recordings / "tardis/ema_original/sf2_0005.txt")


def test_a_text_export_with_header_has_ten_live_coils_of_sixteen(recordings):
    sweep = open_recording(recordings / "tardis/ema_original/sf2_0005.txt", rate_hz=250)
    assert sweep.format == "Carstens .txt export with header"
    assert (sweep.frame_count, len(sweep.coils)) == (703, 16)
    assert live(sweep) == ["Ch1", "Ch2", "Ch3", "Ch4", "Ch5", "Ch6", "Ch7", "Ch12", "Ch13", "Ch14"]
    assert mean(sweep, "Ch1")[0] > mean(sweep, "Ch2")[0] > mean(sweep, "Ch3")[0]  # TT, TB, TD: x to the front
    assert mean(sweep, "Ch12")[1] > 60 > -60 > mean(sweep, "Ch13")[1]  # mastoids: y to the left


def test_the_palate_sweep_has_five_live_coils(recordings):
    sweep = open_recording(recordings / "tardis/ema_palate/sf2_palate.txt", rate_hz=250)
    assert live(sweep) == ["Ch5", "Ch12", "Ch13", "Ch14", "Ch15"]
    assert sweep.frame_count == 2862


def test_ssff_made_from_a_text_export_holds_the_same_positions(recordings):
    text = open_recording(recordings / "tardis/ema_original/sf2_0005.txt", rate_hz=250)
    ssff = open_recording(recordings / "tardis/ema_ssff/sf2_0005.TT")
    assert ssff.coils == ("LL", "LT", "TB", "TD", "TT", "UL", "UT")
    for coil, channel in {"TT": "Ch1", "TB": "Ch2", "TD": "Ch3"}.items():
        difference = ssff.positions[:, ssff.coils.index(coil)] - text.positions[:, text.coils.index(channel)]
        assert np.abs(difference).max() < 0.01
    assert any(".PAL" in note and "left out" in note for note in ssff.notes)
    assert any("raw" in note for note in ssff.notes)


def test_filtered_columns_can_be_asked_for(recordings):
    raw = open_recording(recordings / "tardis/ema_ssff/sf2_0005.TT")
    filtered = open_recording(recordings / "tardis/ema_ssff/sf2_0005.TT", layout="filt")
    assert filtered.coils == raw.coils
    difference = np.median(np.abs(filtered.positions - raw.positions), axis=0)
    assert 0 < difference.max() < 1.0


def test_an_ssff_file_of_another_length_is_a_recording_of_its_own(recordings):
    palate = open_recording(recordings / "tardis/ema_ssff/sf2_0005.PAL")
    assert palate.coils == ("PAL",)
    assert palate.frame_count == 2862


def test_the_emu_demo_is_one_recording_of_six_coils(recordings):
    demo = open_recording(recordings / "emu_webapp/ssff/0020.t_tip")
    assert demo.coils == ("jaw", "lower_lip", "t_back", "t_mid", "t_tip", "upper_lip")
    assert (demo.frame_count, demo.rate_hz, demo.duration_s) == (800, 200.0, 4.0)
    assert (demo.frame.x, demo.frame.y, demo.frame.z) == ("left", "back", "up")
    assert (
        mean(demo, "upper_lip")[1] < mean(demo, "t_tip")[1] < mean(demo, "t_mid")[1] < mean(demo, "t_back")[1]
    )
    assert np.isnan(demo.positions[760:]).all() and demo.valid()[:760].all()  # the end is zeros in the files
    assert any("240 sample(s) at exactly 0 0 0" in note for note in demo.notes)
    same = open_recording(recordings / "emu_webapp/ssff/0020.jaw")
    np.testing.assert_array_equal(same.positions, demo.positions)


def test_the_authors_json_of_the_emu_demo_holds_the_same_coils(reference_data):
    demo = open_recording(reference_data / "recordings/emu_webapp/ssff/0020.t_tip")
    theirs = open_recording(reference_data / "authors-format/emu_webapp_0020_three_coils.json")
    assert theirs.coils == ("t_tip", "t_mid", "t_back")
    for k, coil in enumerate(theirs.coils):
        np.testing.assert_array_equal(
            theirs.positions[:, k, 1:], demo.positions[:, demo.coils.index(coil), 1:]
        )


def test_the_authors_synthetic_recording_opens(reference_data):
    synthetic = open_recording(reference_data / "authors-format/synthetic_ema.json")
    assert synthetic.coils == ("TongueDorsum", "TongueBlade", "TongueTip")
    assert (synthetic.frame_count, synthetic.rate_hz) == (3000, 250.0)
    assert synthetic.times_s[0] == 0.004
    assert synthetic.frame.x == "unknown"


def test_a_headerless_ag500_sweep_with_unit_vectors(recordings):
    sweep = open_recording(recordings / "rticulate_ag500/0025.pos")
    assert sweep.format == "Carstens AG500 .pos, unit vectors"
    assert (sweep.frame_count, sweep.rate_hz, len(sweep.coils)) == (20, 200.0, 12)
    assert any("200 Hz" in note for note in sweep.notes)
    right_ear, left_ear = mean(sweep, "Ch1"), mean(sweep, "Ch2")
    assert right_ear[0] < -50 < 50 < left_ear[0]
    assert mean(sweep, "Ch5")[1] < mean(sweep, "Ch4")[1] < mean(sweep, "Ch3")[1]  # tip, mid, back
    assert 0 < sweep.rms.min() < sweep.rms.max() < 12


def test_the_hprc_recording_equals_what_scipy_reads(recordings):
    path = recordings / "hprc/F01_B01_S01_R01_N.mat"
    recording = open_recording(path)
    assert recording.coils == ("TR", "TB", "TT", "UL", "LL", "ML", "JAW", "JAWL")
    assert (recording.frame_count, recording.rate_hz) == (262, 100.0)
    assert recording.orientations is None
    assert recording.extra["SENTENCE"].startswith("The birch canoe")
    channels = {str(c["NAME"][0]): c["SIGNAL"] for c in loadmat(path)["F01_B01_S01_R01_N"][0]}
    for k, coil in enumerate(recording.coils):
        np.testing.assert_array_equal(recording.positions[:, k], channels[coil][:, :3])
    assert mean(recording, "TT")[0] > mean(recording, "TB")[0] > mean(recording, "TR")[0]


def test_blank_wave_sensors_are_missing_whatever_their_status(recordings):
    wave = open_recording(recordings / "ndi_wave_ematoblender/Example3.tsv")
    assert wave.format == "NDI Wave .tsv v1"
    assert (wave.frame_count, wave.rate_hz) == (100, 100.0)
    assert wave.coils == ("Sensor 1", *(f"Sensor {k}" for k in range(3, 17)))
    assert live(wave) == ["Sensor 1", *(f"Sensor {k}" for k in (9, 10, 11, 14, 15, 16))]
    assert any("200 sample(s) have status 55" in note for note in wave.notes)
    assert any("Sensor 9, Sensor 10" in note and "Five degrees" in note for note in wave.notes)
    assert np.isnan(wave.quaternions[~wave.valid()]).all()
    assert wave.frame.x == "unknown"


def test_headerless_mocha_opens_by_its_convention(recordings):
    mocha = open_recording(recordings / "mocha/fsew0_001.ema")
    assert mocha.coils == ("ui", "li", "ul", "ll", "tt", "tb", "td", "v", "bn")
    assert (mocha.frame_count, mocha.rate_hz) == (966, 500.0)
    assert (mocha.frame.x, mocha.frame.y, mocha.frame.z) == ("absent", "back", "up")
    assert (mocha.positions[:, :, 0] == 0).all()
    assert any("MOCHA" in note for note in mocha.notes) and any("unit" in note for note in mocha.notes)
    back = [mean(mocha, coil)[1] for coil in ("ul", "tt", "tb", "td", "v")]
    assert back == sorted(back)
    assert np.abs(mean(mocha, "ui")).max() < 0.1
    assert 50 < mean(mocha, "bn")[2] < 65
    palate = np.loadtxt(recordings / "mocha/fsew0_pal.dat")
    assert palate[:, 0].min() < back[1] < back[3] < palate[:, 0].max()


def test_tongue_coils_move_as_fast_as_tongues_do(recordings):
    for file, coil in [("emu_webapp/ssff/0020.t_tip", "t_tip"), ("hprc/F01_B01_S01_R01_N.mat", "TT")]:
        recording = open_recording(recordings / file)
        path = recording.positions[:, recording.coils.index(coil)]
        speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * recording.rate_hz
        assert 100 < np.nanmax(speed) < 600


def test_a_folder_lists_its_recordings_and_says_why_the_rest_is_none(recordings):
    found = find_recordings(recordings)
    names = [(item.path.name, item.format) for item in found if item.is_recording]
    assert names == [
        ("0021.pos", "Carstens AG50x .pos"),
        ("0021.txt", "Carstens .txt export"),
        ("0020.jaw", "SSFF"),
        ("F01_B01_S01_R01_N.mat", "Haskins MVIEW .mat"),
        ("fsew0_001.ema", "MOCHA ASCII without header"),
        ("Example3.tsv", "NDI Wave .tsv v1"),
        ("0025.pos", "Carstens AG500 .pos"),
        ("sf2_0005.txt", "Carstens .txt export"),
        ("sf2_palate.txt", "Carstens .txt export"),
        ("sf2_0005.LL", "SSFF"),
        ("sf2_0005.PAL", "SSFF"),
    ]
    reasons = {item.path.name: item.left_out for item in found if not item.is_recording}
    assert "WAV" in reasons["0020.wav"]
    assert "palate" in reasons["fsew0_pal.dat"]
    assert "without coil positions" in reasons["0020.fms"]
    assert "labels" in reasons["fsew0_001.lab"]
    assert {"LICENSE", "ema_DBconfig.json", "ptask_sensors_147_1.csv", "DESCRIPTION"} <= set(reasons)
    whole = [file for item in found for file in item.files]
    assert len(whole) == len(set(whole))
    assert set(whole) == {path for path in recordings.rglob("*") if path.is_file()}


def test_models_meshes_and_device_logs_are_not_recordings(reference_data):
    with pytest.raises(InputError, match="tonguetrack model info"):
        open_recording(reference_data / "authors-format/synthetic_model.yaml")
    with pytest.raises(InputError, match="PLY mesh"):
        open_recording(reference_data / "mri-shape-framework/palate_template.ply")
    assert not any(item.is_recording for item in find_recordings(reference_data / "device-logs"))


def test_a_track_without_coils_is_refused_in_plain_words(reference_data):
    with pytest.raises(InputError, match="SSFF without coil positions"):
        open_recording(reference_data / "recordings" / "emu_webapp" / "ssff" / "0020.fms")
