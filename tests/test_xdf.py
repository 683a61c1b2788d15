"""XDF: what we write, what we read, what others write and read, and damage of every kind."""

import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers import find_recordings, open_recording
from tonguetrack.drivers.files.common import Options
from tonguetrack.drivers.files.recognise import parse
from tonguetrack.drivers.xdf import (
    BOUNDARY_UUID,
    FORMATS,
    boundary,
    clock_offset,
    file_header,
    map_file,
    read_xdf,
    samples,
    stream_footer,
    stream_header,
    text_samples,
)

BRISK = settings(deadline=None, suppress_health_check=list(HealthCheck), database=None)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
LABELS = [f"{coil}_{axis}" for coil in ("tip", "mid") for axis in "xyz"]


def header(stream_id=1, name="coils", labels=LABELS, unit="mm", type="MoCap", rate=100.0, **more):
    return stream_header(stream_id, name, type, labels, [unit] * len(labels), rate, "test", **more)


def marks_header(stream_id=2):
    return stream_header(stream_id, "marks", "Markers", ["mark"], [""], 0.0, "test", "string")


def ramp(count=7, channels=6, start=0.0):
    return start + np.arange(count) / 100.0, np.arange(count * channels, dtype=float).reshape(count, channels)


def small_file():
    """Two streams, three chunks of numbers, a boundary between each, texts, an offset, footers."""
    parts = [file_header({}), header(), marks_header()]
    for block in range(3):
        stamps, values = ramp(5, start=0.05 * block)
        parts += [samples(1, stamps, values + block), boundary()]
    parts += [text_samples(2, [0.01, 0.02], ["go", "ende ☺"]), clock_offset(1, 0.5, -0.25)]
    return parts + [stream_footer(1, 0.0, 0.14, 15), stream_footer(2, 0.01, 0.02, 2)]


def number(value, size):
    return bytes([size]) + value.to_bytes(size, "little")


def chunk(tag, content, size=4):
    return number(len(content) + 2, size) + struct.pack("<H", tag) + content


def their_header(stream_id, form, channels, rate=0.0, size=4):
    xml = (
        f"<?xml version='1.0'?><info><name>s{stream_id}</name><type>x</type><channel_count>{channels}</channel_count>"
        f"<nominal_srate>{rate}</nominal_srate><channel_format>{form}</channel_format><desc/></info>"
    )
    return chunk(2, struct.pack("<I", stream_id) + xml.encode(), size)


def pyxdf_reads(data, path):
    pyxdf = pytest.importorskip("pyxdf")
    path.write_bytes(data)
    streams, fields = pyxdf.load_xdf(str(path), synchronize_clocks=False, dejitter_timestamps=False)
    return {stream["info"]["stream_id"]: stream for stream in streams}, fields["info"]


# What we write --------------------------------------------------------------------------------------


def test_the_chunks_are_those_of_the_specification():
    assert boundary() == bytes.fromhex("04 12000000 0500 43a546dccbf5410fb30ed5467383cbe4")
    assert clock_offset(3, 1.0, -2.0) == bytes.fromhex(
        "04 16000000 0400 03000000 000000000000f03f 00000000000000c0"
    )
    assert samples(1, np.array([1.0]), np.array([[-2.0]])) == bytes.fromhex(
        "04 1c000000 0300 01000000 04 01000000 08 000000000000f03f 00000000000000c0"
    )
    assert text_samples(2, [1.0], ["hé"]) == bytes.fromhex(
        "04 1c000000 0300 02000000 04 01000000 08 000000000000f03f 04 03000000 68c3a9"
    )
    assert file_header({}).startswith(b"XDF:\x04")


@settings(BRISK, max_examples=60)
@given(
    st.lists(st.tuples(FINITE, st.floats(), st.floats()), max_size=20),
    st.lists(st.tuples(FINITE, st.text(st.characters(exclude_categories=["Cs"]), max_size=12)), max_size=5),
    st.floats(0, 1e4),
)
def test_numbers_and_texts_come_back_bit_for_bit(rows, texts, rate):
    table = np.array(rows).reshape(-1, 3)
    data = b"".join(
        [
            file_header({}),
            stream_header(7, "n", "x", ["a", "b"], ["mm", ""], rate, "src"),
            marks_header(),
            samples(7, table[:, 0], table[:, 1:]),
            text_samples(2, [stamp for stamp, _ in texts], [text for _, text in texts]),
            stream_footer(7, 0.0, 1.0, len(rows)),
        ]
    )
    file = read_xdf(data, "f")
    numbers, marks = file.streams
    assert file.damage is None and file.whole_bytes == len(data) == file.size
    assert numbers.stamps.tobytes() == table[:, 0].tobytes()
    assert numbers.values.tobytes() == np.ascontiguousarray(table[:, 1:]).tobytes()
    assert numbers.rate_hz == rate and numbers.footer.count == len(rows) and marks.footer is None
    assert [text for (text,) in marks.texts] == [text for _, text in texts]
    assert marks.stamps.tolist() == [stamp for stamp, _ in texts]


@settings(BRISK, max_examples=150)
@given(st.text(max_size=30), st.text(st.characters(categories=["L", "N", "P", "Z", "S"]), min_size=1))
def test_any_text_in_a_header_comes_back_and_what_xml_cannot_hold_is_replaced(description, label):
    data = file_header({"note": description}) + header(labels=[label], description={"session": description})
    file = read_xdf(data, "f")
    held = "".join(
        c if c in "\t\n\r" or " " <= c <= "\ud7ff" or "\ue000" <= c <= "\ufffd" or c > "\uffff" else "\ufffd"
        for c in description
    )
    assert file.damage is None
    assert file.streams[0].description == {"session": held}
    assert file.fields["note"] == held
    assert file.streams[0].labels == (label.strip(),)


def test_channels_of_motion_capture_are_described_as_the_convention_says():
    labels = ["time_s", "tip_x", "tip_y", "tip_z", "tip_qw", "tip_qx", "tip_qy", "tip_qz", "tip_rms"]
    stream = read_xdf(file_header({}) + header(labels=labels), "f").streams[0]
    assert [channel.type for channel in stream.channels] == [
        "", "PositionX", "PositionY", "PositionZ",
        "OrientationA", "OrientationB", "OrientationC", "OrientationD", "",
    ]  # fmt: skip
    assert {channel.marker for channel in stream.channels[1:8]} == {"tip"}


def test_another_program_reads_all_that_we_write(tmp_path):
    streams, fields = pyxdf_reads(b"".join(small_file()), tmp_path / "a.xdf")
    assert fields["version"] == ["1.0"] and "T" in fields["datetime"][0]
    coils, marks = streams[1], streams[2]
    expected = np.concatenate([ramp(5)[1] + block for block in range(3)])
    np.testing.assert_array_equal(coils["time_series"], expected)
    np.testing.assert_array_equal(
        coils["time_stamps"], np.concatenate([ramp(5, start=0.05 * b)[0] for b in range(3)])
    )
    channels = coils["info"]["desc"][0]["channels"][0]["channel"]
    assert [channel["label"][0] for channel in channels] == LABELS
    assert channels[0] == {"label": ["tip_x"], "marker": ["tip"], "type": ["PositionX"], "unit": ["mm"]}
    assert marks["time_series"] == [["go"], ["ende ☺"]]
    assert coils["footer"]["info"]["sample_count"] == ["15"] and coils["clock_values"] == [-0.25]


# What others write ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", sorted(FORMATS))
@pytest.mark.parametrize("size", [1, 4, 8])
@pytest.mark.parametrize("stamped", ["all", "none", "first", "odd"])
def test_every_channel_format_length_and_layout_of_stamps_reads_as_elsewhere(form, size, stamped, tmp_path):
    values = np.array([[1, -2, 3], [4, 5, -6], [7, 8, 9], [10, 11, 127]]).astype(FORMATS[form])
    data = file_header({}) + their_header(5, form, 3, 50.0)
    for block in range(2):
        rows = b""
        for row, numbers in enumerate(values):
            has = {"all": True, "none": False, "first": row == 0, "odd": row % 2 == 1}[stamped]
            rows += (
                b"\x08" + struct.pack("<d", 3.0 + block + 0.02 * row) if has else b"\0"
            ) + numbers.tobytes()
        data += chunk(3, struct.pack("<I", 5) + number(len(values), size) + rows, size)
    stream = read_xdf(data, "f").streams[0]
    theirs = pyxdf_reads(data, tmp_path / "a.xdf")[0][5]
    np.testing.assert_array_equal(stream.values, np.concatenate([values, values]).astype(float))
    np.testing.assert_array_equal(stream.values, theirs["time_series"])
    np.testing.assert_array_equal(stream.stamps, theirs["time_stamps"])


def test_texts_of_several_channels_without_stamps_read_as_elsewhere(tmp_path):
    rows = b"\x08" + struct.pack("<d", 2.0)
    rows += number(2, 1) + b"ab" + number(0, 4) + b"\0" + number(1, 8) + b"c" + number(3, 1) + "é!".encode()
    data = file_header({}) + their_header(9, "string", 2, 4.0)
    data += chunk(3, struct.pack("<I", 9) + number(2, 1) + rows)
    stream = read_xdf(data, "f").streams[0]
    assert stream.texts == [("ab", ""), ("c", "é!")]
    assert stream.stamps.tolist() == [2.0, 2.25]
    theirs = pyxdf_reads(data, tmp_path / "a.xdf")[0][9]
    assert [tuple(row) for row in theirs["time_series"]] == stream.texts


def test_many_samples_of_changing_layout_are_read_in_order():
    values = np.arange(20_000, dtype="<i2")
    rows = [
        (b"\x08" + struct.pack("<d", i / 10) if i % 5000 < 3 else b"\0") + value.tobytes()
        for i, value in enumerate(values)
    ]
    data = file_header({}) + their_header(1, "int16", 1, 10.0)
    data += chunk(3, struct.pack("<I", 1) + number(len(values), 4) + b"".join(rows))
    stream = read_xdf(data, "f").streams[0]
    np.testing.assert_array_equal(stream.values[:, 0], values)
    np.testing.assert_allclose(stream.stamps, np.arange(20_000) / 10)


def test_chunks_of_a_later_version_are_passed_over():
    parts = small_file()
    file = read_xdf(b"".join(parts[:3]) + chunk(7, b"news") + b"".join(parts[3:]), "f")
    assert file.damage is None and file.streams[0].count == 15


def test_columns_are_picked_in_any_order():
    stream = read_xdf(b"".join(small_file()), "f").streams[0]
    for wanted in ([5, 0, 3], [2, 3, 4], [4], []):
        np.testing.assert_array_equal(stream.columns(wanted), stream.values[:, wanted])


# Damage ---------------------------------------------------------------------------------------------


def test_cut_at_any_byte_everything_up_to_the_last_whole_chunk_is_read():
    parts = small_file()
    ends = np.cumsum([len(part) for part in parts])
    file_header_end = ends[0]
    whole = b"".join(parts)
    for cut in range(4, len(whole) + 1):
        file = read_xdf(whole[:cut], "f")
        there = [part for part, end in zip(parts, ends, strict=True) if end <= cut]
        assert file.whole_bytes == (sum(map(len, there)) if cut >= file_header_end else 4)
        chunks_of_numbers = sum(part in (parts[3], parts[5], parts[7]) for part in there)
        assert sum(stream.count for stream in file.streams if stream.name == "coils") == 5 * chunks_of_numbers
        assert sum(len(stream.texts) for stream in file.streams) == 2 * (parts[9] in there)
        assert file.only_cut_off
        if file.whole_bytes == cut:
            assert file.damage is None
        else:
            assert f"cut off at byte {file.whole_bytes} of {cut}" in file.damage


def damaged_from(parts, which, offset, value):
    """The file with one byte of one part changed, and where that part begins."""
    begin = sum(map(len, parts[:which]))
    data = bytearray(b"".join(parts))
    data[begin + offset] = value
    return bytes(data), begin


def test_a_chunk_with_damaged_content_is_left_out():
    parts = small_file()
    data, begin = damaged_from(parts, 5, 16, 99)  # how many bytes the first stamp has
    file = read_xdf(data, "f")
    np.testing.assert_array_equal(file.streams[0].values, np.concatenate([ramp(5)[1], ramp(5)[1] + 2]))
    after = begin + len(parts[5])
    assert file.spans == [(4, begin), (after, len(data))]
    assert f"byte {begin} is damaged" in file.damage and f"read on from {after}" in file.damage
    assert "has 10 of 15 samples" in file.damage
    assert not file.only_cut_off


@pytest.mark.parametrize(("offset", "value"), [(0, 3), (1, 0x11), (2, 0xFF), (4, 0xFF)])
def test_behind_a_chunk_with_a_damaged_length_reading_goes_on_at_the_next_boundary(offset, value):
    parts = small_file()
    data, begin = damaged_from(parts, 5, offset, value)
    file = read_xdf(data, "f")
    np.testing.assert_array_equal(file.streams[0].values, np.concatenate([ramp(5)[1], ramp(5)[1] + 2]))
    after = begin + len(parts[5]) + len(boundary())
    assert file.spans == [(4, begin), (after, len(data))]
    assert f"read on from {after}" in file.damage


def test_garbage_at_the_end_costs_nothing_before_it():
    data = b"".join(small_file())
    file = read_xdf(data + b"\7garbage", "f")
    assert file.streams[0].count == 15 and file.whole_bytes == len(data)
    assert "the rest is lost" in file.damage and file.only_cut_off


def test_samples_of_a_stream_whose_header_is_lost_are_told_and_the_rest_is_read():
    parts = small_file()
    file = read_xdf(parts[0] + b"".join(parts[2:]), "f")
    assert [stream.name for stream in file.streams] == ["marks"]
    assert "stream 1, which has no header" in file.damage
    twice = read_xdf(b"".join(parts[:2]) + header(name="other") + b"".join(parts[2:]), "f")
    assert [stream.name for stream in twice.streams] == ["coils", "marks"]
    assert "second header of stream 1" in twice.damage


BOMB = b"<!DOCTYPE a [<!ENTITY b 'bbbbbbbb'><!ENTITY c '&b;&b;&b;&b;'>]><info><name>&c;</name></info>"


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (struct.pack("<I", 3) + BOMB, "document type"),
        (struct.pack("<I", 3) + b"<info><name>", "cannot be read"),
        (struct.pack("<I", 3) + b"<info></info>", "channel format ''"),
        (struct.pack("<I", 3) + BOMB.decode().encode("utf-16"), "cannot be read"),
        (b"ab", "without its stream"),
    ],
)
def test_a_header_that_is_none_is_damage_and_not_an_exception(content, why):
    file = read_xdf(file_header({}) + chunk(2, content) + boundary() + header(), "f")
    assert why in file.damage
    assert [stream.name for stream in file.streams] == ["coils"]


def test_comments_and_plain_sections_in_a_header_are_xml_like_any_other():
    xml = b"<info><!-- made by hand --><name><![CDATA[a<b]]></name><channel_count>1</channel_count>"
    xml += b"<channel_format>int8</channel_format></info>"
    file = read_xdf(file_header({}) + chunk(2, struct.pack("<I", 3) + xml), "f")
    assert file.damage is None and file.streams[0].name == "a<b"


@pytest.mark.parametrize("channels", ["0", "-1", "99999999999", "1e3", "", "٣"])
def test_a_header_with_an_impossible_number_of_channels_is_damage(channels):
    file = read_xdf(file_header({}) + their_header(1, "int8", channels), "f")
    assert "channel count" in file.damage and not file.streams


def test_xml_nested_without_end_is_read_or_damage():
    deep = b"<info>" + b"<a>" * 300_000 + b"</a>" * 300_000 + b"</info>"
    file = read_xdf(file_header({}) + chunk(2, struct.pack("<I", 3) + deep) + boundary() + header(), "f")
    assert [stream.name for stream in file.streams] == ["coils"]


def test_what_is_not_xdf_is_an_input_error():
    for data in (b"", b"XDF", b"RIFF1234"):
        with pytest.raises(InputError, match="not XDF"):
            read_xdf(data, "f")


def test_hostile_lengths_allocate_nothing():
    head = file_header({}) + their_header(1, "int8", 1) + their_header(2, "double64", 1 << 20)
    head += their_header(3, "string", 1 << 20)
    tracemalloc.start()
    try:
        for stream in (1, 2, 3):
            for count in (5, 255, 1 << 20, (1 << 32) - 1, (1 << 64) - 1):
                for size in (1, 4, 8):
                    if count < 256**size:
                        content = struct.pack("<I", stream) + number(count, size) + bytes(3)
                        assert read_xdf(head + chunk(3, content), "f").damage
        for size, length in ((4, (1 << 32) - 1), (8, (1 << 64) - 1)):
            assert read_xdf(head + number(length, size) + b"\3\0", "f").damage
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def opens_or_says_why(data):
    file = read_xdf(data, "f")
    for stream in file.streams:
        assert stream.values.shape[0] == stream.stamps.shape[0] == stream.count
        assert len(stream.texts) in (0, stream.count)
    assert 4 <= file.whole_bytes <= len(data)
    assert all(4 <= begin <= end <= len(data) for begin, end in file.spans)
    try:
        recording = parse(data, "f.xdf", Options())
    except InputError as reason:
        assert str(reason).startswith("f.xdf: ")
        return
    assert recording.frame_count > 0
    assert (np.diff(recording.times_s) > 0).all()


PLACES = st.integers(0, 2**31)


@settings(BRISK, max_examples=700)
@given(st.lists(st.tuples(PLACES, st.integers(0, 255)), min_size=1, max_size=4))
def test_any_changed_bytes_are_read_as_far_as_they_go(changes):
    data = bytearray(b"".join(small_file()))
    for place, value in changes:
        data[4 + place % (len(data) - 4)] = value
    opens_or_says_why(bytes(data))


@settings(BRISK, max_examples=300)
@given(st.lists(st.tuples(PLACES, PLACES), min_size=1, max_size=3))
def test_any_pieces_taken_out_or_doubled_are_read_as_far_as_they_go(pieces):
    data = b"".join(small_file())
    for place, other in pieces:
        begin, end = 4 + place % (len(data) - 4), 4 + other % (len(data) - 4)
        data = data[:begin] + data[end:]
        if len(data) > 10_000:
            break
    opens_or_says_why(data)


@settings(BRISK, max_examples=200)
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_behind_the_magic_are_read_as_far_as_they_go(noise, with_streams):
    opens_or_says_why(
        (b"".join(small_file()[:3]) if with_streams else b"XDF:") + noise + BOUNDARY_UUID + noise
    )


# As a recording -------------------------------------------------------------------------------------


def foreign(labels=LABELS, unit="mm", type="MoCap", rate=100.0, name="coils", stream_id=1, values=None):
    stamps, ordinary = ramp(7, len(labels), start=50.0)
    head = header(stream_id, name, labels, unit, type, rate)
    return head + samples(stream_id, stamps, ordinary if values is None else values)


def test_another_programs_stream_of_positions_is_a_recording(tmp_path):
    path = tmp_path / "theirs.xdf"
    path.write_bytes(
        file_header({}) + foreign(["clock", *LABELS], "m") + marks_header() + text_samples(2, [1], ["a"])
    )
    recording = open_recording(path)
    assert recording.coils == ("tip", "mid")
    assert recording.positions[1].tolist() == [[8000, 9000, 10000], [11000, 12000, 13000]]
    np.testing.assert_allclose(recording.times_s, np.arange(7) / 100)
    assert recording.rate_hz == 100.0 and recording.format == "XDF, stream 'coils'"
    assert any("left out: marks" in note for note in recording.notes)
    assert [item.format for item in find_recordings(tmp_path)] == ["XDF"]


@pytest.mark.parametrize(
    ("labels", "type", "coils"),
    [
        (["a.X", "a.Y", "a.Z"], "x", ("a",)),
        (["tip pos x", "tip pos y", "tip pos z"], "x", ("tip",)),
        (["b_x", "b_y", "b_z", "c_x", "c_y"], "MoCap", ("b",)),
    ],
)
def test_coils_are_told_by_labels_and_types(labels, type, coils):
    recording = parse(file_header({}) + foreign(labels, type=type), "a.xdf")
    assert recording.coils == coils
    assert recording.positions[0, 0].tolist() == [0, 1, 2]


@pytest.mark.parametrize("unit", ["millimeters", "mm", "m", "meters", "cm", "µm"])
def test_units_are_taken_from_the_channels(unit):
    factor = {"m": 1000, "meters": 1000, "cm": 10, "µm": 0.001}.get(unit, 1)
    recording = parse(file_header({}) + foreign(unit=unit), "a.xdf")
    np.testing.assert_allclose(recording.positions[0, 1], np.array([3, 4, 5]) * factor)


def test_a_unit_that_is_not_known_or_not_stated_is_asked_for():
    for unit, said in (("", "without a unit"), ("parsec", "'parsec'")):
        with pytest.raises(InputError, match=f"{said}.*--unit"):
            parse(file_header({}) + foreign(unit=unit), "a.xdf")
        recording = parse(file_header({}) + foreign(unit=unit), "a.xdf", Options(unit="cm"))
        assert recording.positions[0, 0].tolist() == [0, 10, 20]
    overruled = parse(file_header({}) + foreign(unit="m"), "a.xdf", Options(unit="mm"))
    assert any("--unit mm was used" in note for note in overruled.notes)


def test_of_several_streams_the_user_names_one():
    data = file_header({}) + foreign() + foreign(name="robot", stream_id=4)
    with pytest.raises(
        InputError, match=r"2 streams have positions \(coils, robot\); name one with --layout"
    ):
        parse(data, "a.xdf")
    assert parse(data, "a.xdf", Options(layout="robot")).format == "XDF, stream 'robot'"
    with pytest.raises(InputError, match="no stream 'nose'"):
        parse(data, "a.xdf", Options(layout="nose"))


def test_a_file_without_positions_lists_its_streams():
    data = file_header({}) + foreign(["C3", "C4"], type="EEG", name="cap") + marks_header()
    with pytest.raises(InputError, match=r"'cap' \(EEG, 2 double64, 7 samples\), 'marks' \(Markers"):
        parse(data, "a.xdf")


def test_a_stream_without_rate_gets_that_of_its_stamps_and_an_empty_one_is_an_input_error():
    assert parse(file_header({}) + foreign(rate=0.0), "a.xdf").rate_hz == pytest.approx(100.0)
    with pytest.raises(InputError, match="no samples"):
        parse(file_header({}) + header(), "a.xdf")


def test_a_mapped_file_reads_as_its_bytes_do(tmp_path):
    path = tmp_path / "a.xdf"
    data = b"".join(small_file())
    path.write_bytes(data)
    mapped, read = read_xdf(map_file(path), "f"), read_xdf(data, "f")
    assert mapped.streams[0].values.tobytes() == read.streams[0].values.tobytes()
    (tmp_path / "empty.xdf").write_bytes(b"")
    assert map_file(tmp_path / "empty.xdf") == b""
