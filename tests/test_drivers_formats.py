"""The formats of which there is no real file at hand, as golden bytes; and damage to all of them."""

import io
import json
import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from tonguetrack import InputError
from tonguetrack.drivers.files.authors import authors_bytes
from tonguetrack.drivers.files.common import Options
from tonguetrack.drivers.files.npz import npz_bytes
from tonguetrack.drivers.files.recognise import parse
from tonguetrack.drivers.files.tabular import table_bytes
from tonguetrack.drivers.frames import FrameOfReference, Recording

FRAMES = 6


def carstens_values(channels, dead=()):
    """(frames, channels, 7): positions that tell frame and channel apart, phi 90, theta 30, rms, spare."""
    values = np.zeros((FRAMES, channels, 7))
    for k in range(channels):
        values[:, k, :3] = [10 + k, -20 - k, 5 * k + 1]
        values[:, k, 0] += 0.5 * np.arange(FRAMES)
        values[:, k, 3:6] = [90, 30, 1.5 + k]
    values[:, list(dead)] = 0
    return values


def ag50x(version="V003", header_bytes=128, filler=b"\0", more="", channels=3, dead=(2,), tail=b""):
    header = f"AG50xDATA_{version}\n{header_bytes:08d}\nNumberOfChannels={channels}\nSamplingFrequencyHz=250\n{more}"
    filled = header.encode().ljust(header_bytes, b"\0")
    if filler != b"\0":
        filled = filled[: header_bytes - len(filler)] + filler
    return filled + carstens_values(channels, dead).astype("<f4").tobytes() + tail


def ag50x_short_header():
    """V002 as old software wrote it: 70 bytes, ending in NUL and Ctrl-Z."""
    text = b"AG50xDATA_V002\n00000070\nNumberOfChannels=3\nSamplingFrequencyHz=200"
    return text.ljust(68, b"\0")[:68] + b"\0\x1a" + carstens_values(3).astype("<f4").tobytes()


def ag500(layout):
    values = carstens_values(12, dead=(11,))
    if layout == "vector":
        values[:, :11, 3:6] = [0.6, 0.0, -0.8]
        values[:, :11, 6] = 1.25
    return values.astype("<f4").tobytes()


def carstens_text(header=True, end="\n", replace_cell=None):
    values = carstens_values(2)
    lines = ["\t".join(f"{v:.2f}" for v in frame.ravel()) for frame in values]
    if replace_cell is not None:
        cells = lines[1].split("\t")
        cells[7:14] = [replace_cell] * 7
        lines[1] = "\t".join(cells)
    fields = ("X", "Y", "Z", "phi", "theta", "RMS", "Extra")
    names = "\t".join(f"Ch{k}_{f}" for k in (1, 2) for f in fields)
    return (end.join([names, *lines] if header else lines) + end).encode()


def wave_v1(drop_trailing=False):
    group = "X[mm]\tY[mm]\tZ[mm]\tQ0\tQx\tQy\tQz"
    header = "AudioTime[s]\tMeasId\tWavId" + "".join(
        f"\tSensor {n} Id\tSensor {n} Status\t{group}" for n in (1, 3, 4)
    )
    lines = [header]
    for i in range(FRAMES):
        first = f"0.000000\t55.000000\t{i}.5\t-2.0\t-100.0\t0.5\t0.5\t0.5\t0.5"
        second = (
            f"2.000000\t{'183' if i == 2 else '55'}.000000\t1.0\t2.0\t3.0\t0.707106781\t0.707106781\t0.0\t0.0"
        )
        blank = "" if drop_trailing else "\t\t\t\t\t\t\t"
        lines.append(
            f"{i * 0.01:.6f}\t{i}.000000\t{220 * i}.000000\t{first}\t{second}\t3.000000\t55.000000{blank}"
        )
    return ("\n".join(lines) + "\n").encode()


def wave_v2(header=True, separators=True):
    space = "\t " if separators else ""
    head = "Wav Time" + f"\tSensor\tFrame\tState\tQ0\tQx\tQy\tQz\tTx\tTy\tTz{space}" * 3
    lines = [head] if header else []
    for i in range(FRAMES):
        state = "BAD_FIT" if i == 1 else "OK"
        one = f"\tPort 1\t{i}\tOK\t1.0\t0.0\t0.0\t0.0\t{i}.25\t-2.0\t3.0{space}"
        two = f"\tPort 2\t{i}\t{state}\t0.7\t0.1\t0.7\t0.0\t4.0\t5.0\t6.0{space}"
        lines.append(f"{i * 0.0025:.4f}{one}{two}" + "\t" * 10 + space)
    return ("\n".join(lines) + "\n").encode()


def est(kind="binary", order="01", breaks=True, aux=0, convention="mocha", times=None, flags=None, scale=1.0):
    if convention == "mocha":
        names = ["ui_x", "tt_x", "v_ x", "ui_y", "tt_y", "v_ y", "****", "****"]
        row = np.array([0.0, 1100.0, 6000.0, 0.0, -1200.0, -600.0, 7.0, 8.0])
    else:
        coils = ("T1", "T3", "upperlip")
        names = [f"{coil}_p{axis}" for coil in coils for axis in "xyz"] + ["T1_rms"]
        row = np.array([0.0, 1.5, -0.5, 0.1, 5.0, 0.0, 0.0, -1.0, 0.5, 9.0]) * scale
    header = [
        "EST_File Track",
        f"DataType {kind}",
        f"ByteOrder {order}",
        f"NumFrames {FRAMES}",
        f"NumChannels {len(names)}",
        *([f"NumAuxChannels {aux}"] if aux else []),
        "EqualSpace 0",
        f"BreaksPresent {'true' if breaks else 'false'}",
        "CommentChar ;",
        "",
        *(f"Channel_{k} {name}" for k, name in enumerate(names)),
        "EST_Header_End",
    ]
    table = np.tile(row, (FRAMES, 1)) + np.arange(FRAMES)[:, None] * 0.01 * scale
    stamps = np.arange(FRAMES) * 0.005 if times is None else np.asarray(times)
    present = np.ones(FRAMES) if flags is None else np.asarray(flags)
    parts = [stamps[:, None], *([present[:, None]] if breaks else []), table, np.full((FRAMES, aux), 3.0)]
    whole = np.concatenate(parts, axis=1)
    if kind == "binary":
        body = whole.astype("<f4" if order == "01" else ">f4").tobytes()
    else:
        body = "\n".join(" ".join(f"{v:.6f}" for v in line) for line in whole).encode() + b"\n"
    return ("\n".join(header) + "\n").encode() + body


def ssff(machine="IBM-PC", kind="FLOAT", extra_column=True, start=0.25):
    order, code = ("<" if machine == "IBM-PC" else ">"), {"FLOAT": "f4", "DOUBLE": "f8", "SHORT": "i2"}[kind]
    fields = [(f"tt_{name}{axis}", code) for name in ("pos", "ori") for axis in "xyz"]
    header = f"SSFF -- (c) SHLRC\nMachine {machine}\nRecord_Freq 200\nStart_Time {start}\n"
    header += "".join(f"Column {name}     {kind} 1\n" for name, _ in fields)
    if extra_column:
        header += "Column fm SHORT 4\n"
    header += "Original_Freq DOUBLE 24000.0\nComment CHAR made by hand\n-----------------\n"
    dtype = [(name, order + c) for name, c in fields] + ([("fm", order + "i2", (4,))] if extra_column else [])
    records = np.zeros(FRAMES, dtype)
    for value, (name, _) in zip((3, 14, -2, 0, 0, 1), fields, strict=True):
        records[name] = value
    records["tt_posx"] += np.arange(FRAMES).astype(order + code)
    return header.encode() + records.tobytes()


def txy():
    values = np.tile(np.arange(16) * 1000.0 - 8000, (FRAMES, 1))
    values[:2, 4:6] = 1_000_000
    lines = ["\t".join([str(i * 6866), *(f"{v:.0f}" for v in row)]) for i, row in enumerate(values)]
    return ("\n".join(lines) + "\n").encode()


def mview(width=3, compressed=False, nan=False):
    signal = np.arange(FRAMES * width, dtype=np.float32).reshape(FRAMES, width)
    if nan:
        signal[1, 0] = np.nan
    fields = ["NAME", "SRATE", "SIGNAL", "SENTENCE"]
    channels = np.zeros((1, 3), dtype=[(field, object) for field in fields])
    channels[0, 0] = ("AUDIO", 16000, np.zeros((40, 1)), "Hello there.")
    channels[0, 1] = ("TT", 200, signal, "")
    channels[0, 2] = ("TB", 200, signal + 100, "")
    out = io.BytesIO()
    savemat(out, {"take_1": channels}, do_compression=compressed)
    return out.getvalue()


def a_recording(seed=1, rms=True):
    generator = np.random.default_rng(seed)
    positions = generator.normal(0, 30, (FRAMES, 3, 3))
    positions[2, 1] = np.nan
    positions[:, 2] = np.nan
    quaternions = generator.normal(size=(FRAMES, 3, 4))
    return Recording(
        coils=("tip", "blade", 'odd, "name"'), positions=positions, times_s=0.1 + np.arange(FRAMES) / 300,
        rate_hz=300.0, format="made", frame=FrameOfReference("left", "back", "up", "somewhere"),
        orientations=positions / 40, quaternions=quaternions, rms=np.abs(positions[:, :, 0]) if rms else None,
        notes=("One.", "Two."), extra={"key": "value"},
    )  # fmt: skip


def golden():
    """Name of a format's variant -> (bytes, name of the file, options)."""
    said = Options(rate_hz=200.0)
    return {
        "ag50x V003": (ag50x(), "a.pos", Options()),
        "ag50x V002": (ag50x_short_header(), "a.pos", Options()),
        "ag500 angles": (ag500("angles"), "a.pos", Options()),
        "ag500 vector": (ag500("vector"), "a.pos", Options()),
        "carstens txt": (carstens_text(), "a.txt", said),
        "carstens txt headerless": (carstens_text(header=False), "a.txt", said),
        "wave v1": (wave_v1(), "a.tsv", Options()),
        "wave v2": (wave_v2(), "a.tsv", Options()),
        "wave v2 headerless": (wave_v2(header=False, separators=False), "a.tsv", Options()),
        "est binary": (est(), "a.ema", Options()),
        "est ascii": (est("ascii"), "a.ema", Options()),
        "est mngu0": (est(convention="mngu0"), "a.ema", Options()),
        "ssff": (ssff(), "a.tt", Options()),
        "xrmb": (txy(), "a.txy", Options()),
        "mview": (mview(), "a.mat", Options()),
        "mview compressed": (mview(compressed=True), "a.mat", Options()),
        "csv": (table_bytes(a_recording()), "a.csv", Options()),
        "json": (authors_bytes(a_recording()), "a.json", Options()),
        "npz": (npz_bytes(a_recording()), "a.npz", Options()),
        "foreign csv": (b"time_s,tt_x[mm],tt_y[mm],tt_z[mm]\n0,1,2,3\n0.01,1,2,3\n", "a.csv", Options()),
    }  # fmt: skip


GOLDEN = golden()


@pytest.mark.parametrize("which", GOLDEN)
def test_every_golden_file_opens_without_a_warning(which):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = parse(*GOLDEN[which])
    assert recording.frame_count >= 2
    assert (np.diff(recording.times_s) > 0).all()
    assert recording.positions.dtype == np.float64
    assert recording.format


# Carstens -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["V001", "V002", "V003"])
def test_ag50x_versions_share_one_layout(version):
    recording = parse(ag50x(version), "a.pos")
    assert recording.format == f"Carstens AG50x .pos {version}"
    assert recording.coils == ("Ch1", "Ch2", "Ch3")
    np.testing.assert_array_equal(recording.positions[3, :2], [[11.5, -20, 1], [12.5, -21, 6]])
    np.testing.assert_allclose(recording.times_s, np.arange(FRAMES) / 250)
    assert recording.rms[0, 1] == 2.5


def test_a_header_of_70_bytes_ending_in_control_z_is_read_to_its_declared_size():
    recording = parse(ag50x_short_header(), "a.pos")
    assert (recording.format, recording.rate_hz) == ("Carstens AG50x .pos V002", 200.0)
    assert recording.positions[0, 0].tolist() == [10, -20, 1]


def test_an_unused_socket_stays_as_a_coil_without_data():
    recording = parse(ag50x(), "a.pos")
    for array in (recording.positions, recording.orientations, recording.rms):
        assert np.isnan(array[:, 2]).all()
    assert any("Ch1, Ch2; never any data: Ch3" in note for note in recording.notes)


def test_phi_and_theta_become_the_unit_vector_of_azimuth_and_elevation():
    axis = parse(ag50x(), "a.pos").orientations[0, 0]
    np.testing.assert_allclose(axis, [0, np.cos(np.pi / 6), 0.5], atol=1e-9)


def test_normpos_lines_mean_that_the_head_is_corrected():
    assert parse(ag50x(), "a.pos").frame.x == "unknown"
    corrected = parse(ag50x(more="normpos.FIR_5_15=1,2\n"), "a.pos")
    assert (corrected.frame.x, corrected.frame.y) == ("front", "left")
    assert corrected.extra["normpos.FIR_5_15"] == "1,2"


def test_a_pos_file_cut_within_a_frame_is_refused_and_opens_at_the_size_that_is_named():
    cut = ag50x(tail=b"\1" * 13)
    with pytest.raises(InputError, match=rf"{FRAMES} whole frames .* cut it to {len(cut) - 13} bytes"):
        parse(cut, "a.pos")
    assert parse(cut[:-13], "a.pos").frame_count == FRAMES


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (ag50x()[:100], "header claims 128 bytes, the file has only 100"),
        (ag50x()[:140], "less than one frame"),
        (ag50x(version="V004"), "V001, V002 and V003"),
        (ag50x().replace(b"Channels=3", b"Channels=x"), "NumberOfChannels"),
        (ag50x().replace(b"Channels=3", b"Channels=999999"), "NumberOfChannels"),
        (ag50x().replace(b"SamplingFrequencyHz=250", b"SamplingFrequencyHz=0  "), "--rate"),
        (ag50x().replace(b"SamplingFrequencyHz=250", b"SamplingFrequencyNo=250"), "--rate"),
        (ag50x().replace(b"00000128", b"99999999"), "99999999"),
    ],
)
def test_a_damaged_ag50x_header_is_one_sentence(data, words):
    with pytest.raises(InputError, match=words) as raised:
        parse(data, "a.pos")
    assert str(raised.value).startswith("a.pos: ")
    assert "\n" not in str(raised.value)


def test_ag500_layouts_are_told_from_the_numbers():
    angles, vectors = parse(ag500("angles"), "a.pos"), parse(ag500("vector"), "a.pos")
    assert (angles.format, vectors.format) == (
        "Carstens AG500 .pos, angles",
        "Carstens AG500 .pos, unit vectors",
    )
    np.testing.assert_allclose(angles.orientations[0, 0], [0, np.cos(np.pi / 6), 0.5], atol=1e-7)
    np.testing.assert_allclose(vectors.orientations[0, 0], [0.6, 0, -0.8], atol=1e-7)
    assert (angles.rms[0, 0], vectors.rms[0, 0]) == (1.5, 1.25)
    for recording in (angles, vectors):
        assert recording.rate_hz == 200.0
        assert any("200 Hz" in note for note in recording.notes)
        assert np.isnan(recording.positions[:, 11]).all()
    assert (vectors.frame.x, angles.frame.x) == ("left", "unknown")


def test_an_ag500_layout_and_rate_can_be_said():
    recording = parse(ag500("vector"), "a.pos", Options(rate_hz=250.0, layout="angles"))
    assert recording.format.endswith("angles")
    assert recording.rate_hz == 250.0


def test_headerless_ag500_data_cut_within_a_frame_is_refused():
    with pytest.raises(InputError, match="3 of 336 bytes.; it is truncated"):
        parse(ag500("angles") + b"\0\0\0", "a.pos")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("header", [True, False])
def test_carstens_text_with_and_without_header(header, end):
    recording = parse(carstens_text(header, end), "a.txt", Options(rate_hz=250.0))
    assert recording.coils == ("Ch1", "Ch2")
    assert recording.frame_count == FRAMES
    np.testing.assert_allclose(recording.positions[2, 1], [12, -21, 6])
    assert recording.format.endswith("with header" if header else "without header")


@pytest.mark.parametrize("word", ["NA", "", "NaN"])
def test_na_in_carstens_text_is_missing(word):
    recording = parse(carstens_text(replace_cell=word), "a.txt", Options(rate_hz=250.0))
    assert recording.valid()[:, 1].tolist() == [True, False, True, True, True, True]


def test_carstens_text_names_the_line_that_is_wrong():
    lines = carstens_text().split(b"\n")
    lines[3] = lines[3].replace(b"12.00", b"12,00", 1)
    with pytest.raises(InputError, match="line 4, column"):
        parse(b"\n".join(lines), "a.txt", Options(rate_hz=250.0))
    with pytest.raises(InputError, match="line 3 has 3 columns, expected 14"):
        parse(b"\n".join([*lines[:2], b"1\t2\t3", *lines[2:3]]), "a.txt", Options(rate_hz=250.0))


def test_an_unfinished_last_line_is_refused_with_what_to_do():
    with pytest.raises(InputError, match="truncated, so copy it again, or remove that line to read the rest"):
        parse(carstens_text()[:-30], "a.txt", Options(rate_hz=250.0))


# Wave -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drop_trailing", [False, True])
def test_wave_v1_columns_are_found_by_place_and_blank_is_missing(drop_trailing):
    recording = parse(wave_v1(drop_trailing), "a.tsv")
    assert recording.coils == ("Sensor 1", "Sensor 3", "Sensor 4")
    assert recording.positions[4, 0].tolist() == [4.5, -2, -100]
    assert recording.valid()[:, 1].tolist() == [True, True, False, True, True, True]
    assert not recording.valid()[:, 2].any()
    assert any("status 183" in note for note in recording.notes)
    assert recording.rate_hz == 100.0


def test_wave_quaternions_are_kept_and_turn_the_sensors_z_axis():
    recording = parse(wave_v1(), "a.tsv")
    assert recording.quaternions[0, 0].tolist() == [0.5, 0.5, 0.5, 0.5]
    np.testing.assert_allclose(recording.orientations[0, 0], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(recording.orientations[0, 1], [0, -1, 0], atol=1e-8)
    assert any("Five degrees of freedom" in note and "Sensor 3" in note for note in recording.notes)


@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize("separators", [True, False])
def test_wave_v2_with_and_without_header_and_separator_columns(header, separators):
    recording = parse(wave_v2(header, separators), "a.tsv")
    assert recording.format == "NDI Wave .tsv v2"
    assert recording.coils == ("Port 1", "Port 2", "Sensor 3")
    assert recording.rate_hz == 400.0
    assert recording.positions[5, 0].tolist() == [5.25, -2, 3]
    assert recording.quaternions[0, 0].tolist() == [1, 0, 0, 0]
    assert recording.valid()[:, 1].tolist() == [True, False, True, True, True, True]
    assert not recording.valid()[:, 2].any()
    assert any("BAD_FIT" in note for note in recording.notes)


# EST_Track ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["binary", "ascii"])
@pytest.mark.parametrize("order", ["01", "10"])
@pytest.mark.parametrize("breaks", [True, False])
@pytest.mark.parametrize("aux", [0, 2])
def test_est_tracks_of_every_kind_hold_the_same(kind, order, breaks, aux):
    recording = parse(est(kind, order, breaks, aux), "a.ema")
    assert recording.coils == ("ui", "tt", "v")
    assert recording.rate_hz == 200.0
    np.testing.assert_allclose(recording.positions[0], [[0, 0, 0], [0, 11, -12], [0, 60, -6]], atol=1e-5)
    assert (recording.frame.x, recording.frame.y, recording.frame.z) == ("absent", "back", "up")
    assert any("10um" in note for note in recording.notes)


def test_the_size_of_the_rows_decides_about_the_flag_column():
    recording = parse(est(breaks=True).replace(b"BreaksPresent true", b"BreaksPresent false"), "a.ema")
    np.testing.assert_allclose(recording.positions[0, 1], [0, 11, -12], atol=1e-5)
    assert any("BreaksPresent says false" in note for note in recording.notes)


def test_breaks_are_missing():
    recording = parse(est(flags=[1, 1, 0, 1, 1, 1]), "a.ema")
    assert recording.valid().all(axis=1).tolist() == [True, True, False, True, True, True]


def test_time_stamps_with_too_few_digits_are_counted_from_the_usual_rate():
    recording = parse(est("ascii", times=[0, 0, 0, 0.01, 0.01, 0.01]), "a.ema")
    assert recording.rate_hz == 500.0
    np.testing.assert_allclose(recording.times_s, np.arange(FRAMES) / 500)
    assert any("do not increase" in note and "500 Hz" in note for note in recording.notes)
    asked = parse(est("ascii", times=np.zeros(FRAMES)), "a.ema", Options(rate_hz=250.0))
    assert asked.rate_hz == 250.0


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "cm"), (10.0, "mm")])
def test_mngu0_takes_the_one_unit_that_fits_a_head_and_says_so(scale, unit):
    recording = parse(est(convention="mngu0", scale=scale), "a.ema")
    assert recording.coils == ("T1", "T3", "upperlip")
    np.testing.assert_allclose(recording.positions[0, 1], [1, 50, 0], atol=1e-5)
    assert any(f"{unit} was taken" in note and "not verified" in note for note in recording.notes)
    assert (recording.frame.x, recording.frame.y, recording.frame.z) == ("left", "back", "up")


def test_an_implausible_unit_asks():
    data = est(convention="mngu0", scale=1e-4)
    with pytest.raises(InputError, match="--unit"):
        parse(data, "a.ema")
    np.testing.assert_allclose(parse(data, "a.ema", Options(unit="m")).positions[0, 1, 1], 0.5, rtol=1e-5)


def test_a_truncated_est_track_says_what_is_missing():
    with pytest.raises(InputError, match="bytes follow the header, expected"):
        parse(est()[:-5], "a.ema")
    with pytest.raises(InputError, match="EST_Header_End"):
        parse(est()[:200], "a.ema")
    with pytest.raises(InputError, match="NumFrames"):
        parse(est().replace(b"NumFrames 6", b"NumFrames 99999999999"), "a.ema")


# SSFF, XRMB, MVIEW ----------------------------------------------------------------------------------


@pytest.mark.parametrize("machine", ["IBM-PC", "SPARC"])
@pytest.mark.parametrize("kind", ["FLOAT", "DOUBLE", "SHORT"])
def test_ssff_of_both_byte_orders_and_several_types(machine, kind):
    recording = parse(ssff(machine, kind), "0001.tip")
    assert recording.coils == ("tip",)
    assert recording.positions[2, 0].tolist() == [5, 14, -2]
    assert recording.orientations[0, 0].tolist() == [0, 0, 1]
    np.testing.assert_allclose(recording.times_s, 0.25 + np.arange(FRAMES) / 200)


def test_a_truncated_ssff_file_says_so():
    with pytest.raises(InputError, match="not a whole record"):
        parse(ssff()[:-3], "0001.tip")
    with pytest.raises(InputError, match="Machine"):
        parse(ssff().replace(b"IBM-PC", b"VAX   "), "0001.tip")


def test_a_lost_pellet_is_missing_and_the_plane_is_laid_into_y_and_z():
    recording = parse(txy(), "a.txy")
    assert recording.coils == ("UL", "LL", "T1", "T2", "T3", "T4", "MNI", "MNM")
    assert recording.valid()[:, 2].tolist() == [False, False, True, True, True, True]
    assert recording.positions[2, 2].tolist() == [0, -4, -3]
    assert recording.rate_hz == pytest.approx(145.65, abs=0.01)
    assert (recording.frame.x, recording.frame.y) == ("absent", "front")


@pytest.mark.parametrize("compressed", [False, True])
def test_mview_reads_what_scipy_wrote(compressed):
    recording = parse(mview(6, compressed, nan=True), "a.mat")
    assert recording.coils == ("TT", "TB")
    assert recording.rate_hz == 200.0
    theirs = loadmat(io.BytesIO(mview(6, compressed, nan=True)))["take_1"][0, 2]["SIGNAL"]
    expected = np.where(np.arange(FRAMES)[:, None] == 1, np.nan, theirs[:, :3])
    np.testing.assert_array_equal(recording.positions[:, 1], expected)
    assert recording.extra["SENTENCE"] == "Hello there."
    assert any("AUDIO" in note for note in recording.notes)
    assert any("Columns 4 to 6" in note for note in recording.notes)


def test_mview_in_two_dimensions_is_laid_into_y_and_z():
    recording = parse(mview(2), "a.mat")
    assert recording.positions[1, 0].tolist() == [0, 2, 3]
    assert recording.frame.x == "absent"


def test_another_matlab_file_is_not_a_recording():
    out = io.BytesIO()
    savemat(out, {"palate": np.zeros((5, 2)), "words": np.array(["a", "b"], dtype=object)})
    with pytest.raises(InputError, match="palate"):
        parse(out.getvalue(), "a.mat")


# Tables and JSON ------------------------------------------------------------------------------------


def test_a_foreign_table_must_state_unit_and_rate():
    bare = b"tt_x,tt_y,tt_z\n1,2,3\n4,5,6\n"
    with pytest.raises(InputError, match="--unit"):
        parse(bare, "a.csv", Options(rate_hz=200.0))
    with pytest.raises(InputError, match="--rate"):
        parse(bare, "a.csv", Options(unit="cm"))
    recording = parse(bare, "a.csv", Options(unit="cm", rate_hz=200.0))
    assert recording.positions[1, 0].tolist() == [40, 50, 60]


def test_a_foreign_table_may_state_unit_and_time_in_its_column_names():
    recording = parse(b"t[ms];a_x (cm);a_y (cm);a_z (cm)\n0;1;2;3\n5;;5;6\n", "a.csv")
    assert recording.rate_hz == 200.0
    assert recording.positions[0, 0].tolist() == [10, 20, 30]
    assert np.isnan(recording.positions[1]).all()


def test_a_time_column_without_unit_is_not_guessed_when_seconds_are_implausible():
    table = b"time,a_x_mm,a_y_mm,a_z_mm\n0,1,2,3\n5,1,2,3\n"
    with pytest.raises(InputError, match="--rate"):
        parse(table, "a.csv")
    with pytest.raises(InputError, match="NAME_y"):
        parse(b"time_s,a_x_mm,a_y_mm\n0,1,2\n0.01,1,2\n", "a.csv")


def test_null_and_negative_rms_are_missing_in_the_authors_json():
    content = {
        "channels": {"tip": {"position": [1, 2, 3, None, 2, 3, 1, 2, 3], "RMS": [0, 0, -1]}},
        "timestamps": [0, 0.005, 0.01],
        "samplingFrequency": 200,
    }
    recording = parse(json.dumps(content).encode(), "a.json")
    assert recording.valid()[:, 0].tolist() == [True, False, False]
    assert recording.rms is None
    del content["channels"]["tip"]["position"][0]
    with pytest.raises(InputError, match="8 numbers, expected 9"):
        parse(json.dumps(content).encode(), "a.json")


def test_the_user_overrides_a_rate_and_cannot_contradict_a_unit():
    recording = parse(ag50x(), "a.pos", Options(rate_hz=500.0))
    assert recording.rate_hz == 500.0
    assert recording.times_s[1] == 0.002
    assert any("file says 250 Hz" in note for note in recording.notes)
    with pytest.raises(InputError, match="--unit cm cannot hold"):
        parse(ag50x(), "a.pos", Options(unit="cm"))
    with pytest.raises(InputError, match="furlong"):
        parse(ag50x(), "a.pos", Options(unit="furlong"))
    with pytest.raises(InputError, match="no layout"):
        parse(ag50x(), "a.pos", Options(layout="angles"))
    with pytest.raises(InputError, match="choose from vector, angles"):
        parse(ag500("angles"), "a.pos", Options(layout="raw"))
    with pytest.raises(InputError, match="--rate"):
        parse(ag50x(), "a.pos", Options(rate_hz=float("nan")))


# Damage ---------------------------------------------------------------------------------------------


def opens_or_says_why(data, name, options):
    try:
        recording = parse(data, name, options)
    except InputError as reason:
        assert str(reason).startswith(name)
        return
    assert recording.frame_count > 0
    assert np.isfinite(recording.times_s).all()
    assert (np.diff(recording.times_s) > 0).all()
    assert not np.isinf(recording.positions).any()
    assert np.isfinite(recording.rate_hz)


FUZZ = settings(deadline=2000, suppress_health_check=list(HealthCheck), database=None)
PLACES = st.integers(0, 2**31)  # taken modulo the length of the file
OVERWRITES = st.sampled_from(
    [
        b"\0\0\0\0",
        b"\xff\xff\xff\xff",
        b"\xff\xff\xff\x7f",
        struct.pack("<f", np.nan),
        b"9999",
        b"-1e9",
        b"\n",
        b"nan ",
    ]
)


@settings(FUZZ, max_examples=700)
@given(st.sampled_from(sorted(GOLDEN)), PLACES)
def test_any_truncation_opens_or_is_an_input_error(which, place):
    data, name, options = GOLDEN[which]
    opens_or_says_why(data[: place % len(data)], name, options)


@settings(FUZZ, max_examples=900)
@given(
    st.sampled_from(sorted(GOLDEN)),
    st.lists(st.tuples(PLACES, st.integers(0, 255)), min_size=1, max_size=4),
)
def test_any_changed_bytes_open_or_are_an_input_error(which, changes):
    data, name, options = GOLDEN[which]
    damaged = bytearray(data)
    for place, value in changes:
        damaged[place % len(data)] = value
    opens_or_says_why(bytes(damaged), name, options)


@settings(FUZZ, max_examples=400)
@given(st.sampled_from(sorted(GOLDEN)), PLACES, OVERWRITES)
def test_hostile_numbers_in_headers_open_or_are_an_input_error(which, place, word):
    data, name, options = GOLDEN[which]
    start = place % min(len(data), 1500)
    opens_or_says_why(data[:start] + word + data[start + len(word) :], name, options)


@pytest.mark.parametrize("which", sorted(GOLDEN))
def test_a_hostile_header_allocates_nothing_big(which):
    data, name, options = GOLDEN[which]
    tracemalloc.start()
    try:
        for start in range(0, min(len(data), 1200), 7):
            for word in (b"\xff\xff\xff\x7f", b"9999"):
                opens_or_says_why(data[:start] + word + data[start + len(word) :], name, options)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()
