"""A take opened again: finished, cut at any byte, damaged, with its journal; and made whole."""

import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers import CoilFrame, FrameOfReference, ReplaySource, open_recording
from tonguetrack.drivers.xdf import boundary, file_header, read_xdf, samples, stream_footer, text_samples
from tonguetrack.tracker.pose import CoilState, PoseStatus, TrackedPose
from tonguetrack.tracker.takes.headers import header_bytes, info_from_streams, missing_headers
from tonguetrack.tracker.takes.layout import STREAM_IDS, TakeInfo
from tonguetrack.tracker.takes.reading import read_take
from tonguetrack.tracker.takes.recorder import TakeRecorder
from tonguetrack.tracker.takes.recovering import recover

BRISK = settings(deadline=None, suppress_health_check=list(HealthCheck), database=None)
NUMBERS = ("raw", "prepared", "pose")
ARRAYS = ("stamps", "raw", "prepared", "pose")


def take_info(quaternions=True, rms=True, status=True, rate_hz=400.0, coils=("tip", "Zunge 2", "ref")):
    return TakeInfo(
        source="rtc3d://lab:3030",
        coils=coils,
        rate_hz=rate_hz,
        frame=FrameOfReference("left", "back", "up", "the field generator's, <not> the head's"),
        quaternions=quaternions,
        rms=rms,
        status=status,
        roles=("tongue_tip", "tongue_dorsum"),
        vertices=(12, 40),
        model_name="a & b",
        model_fingerprint="0123456789abcdef",
        pose_mean=np.array([0.1, -0.2, 1 / 3]),
        pose_sigma=np.array([1.0, 2.0, 0.3]),
        speaker_size=2,
        session_toml='[coils]\ntip = "tongue_tip"\n"Zunge 2" = "tongue_dorsum"\n\n[speaker]\nweights = [1.0, 1.0]\n',
        started="2026-11-22T09:00:00+01:00",
        version="0.3.0",
    )


INFO = take_info()


def rows_of(info, count, seed=1):
    """count rows of the take, 2.5 ms apart, with a NaN here and there."""
    random = np.random.default_rng(seed)
    rows = np.zeros(count, info.row_dtype())
    rows["sequence"] = np.arange(1, count + 1)
    rows["arrival_ns"] = 5_000_000_000 + 2_500_000 * np.arange(count)
    for name in NUMBERS:
        rows[name] = random.normal(size=rows[name].shape)
    rows["raw"][:, 0] = 100.0 + np.arange(count) / 400
    rows["raw"][:, 1] = 7 + np.arange(count)
    rows["raw"][3 % count, 2:5] = np.nan
    if info.status:
        rows["raw"][:, -len(info.coils) :] = [0, 49, 0xFFFFFFFF]
    rows["pose"][:, 0] = PoseStatus.OK
    rows["pose"][:, 1] = 1.0
    rows["pose"][:, -2:] = CoilState.TRUSTED
    return rows


def stamps_of(rows):
    return rows["arrival_ns"] * 1e-9


def numbers_of(rows):
    return [samples(STREAM_IDS[name], stamps_of(rows), rows[name]) for name in NUMBERS]


def parts_of(info, rows, marks=(), each=10, finished=True):
    """The chunks of a take as the recorder writes them, with a boundary behind every third flush."""
    parts = [file_header({}), header_bytes(info)]
    for begin in range(0, len(rows), each):
        parts += numbers_of(rows[begin : begin + each])
        if begin // each % 3 == 2:
            parts.append(boundary())
    if marks:
        parts.append(text_samples(4, [at for at, _ in marks], [text for _, text in marks]))
    if finished:
        first, last = stamps_of(rows)[[0, -1]] if len(rows) else (0.0, 0.0)
        parts += [stream_footer(STREAM_IDS[name], first, last, len(rows)) for name in NUMBERS]
        parts.append(
            stream_footer(4, marks[0][0] if marks else 0.0, marks[-1][0] if marks else 0.0, len(marks))
        )
    return parts


def written(path, parts):
    path.write_bytes(b"".join(parts))
    return path


def assert_frames(take, rows):
    assert take.stamps.tobytes() == stamps_of(rows).tobytes()
    for name in NUMBERS:
        assert getattr(take, name).tobytes() == np.ascontiguousarray(rows[name]).tobytes(), name


def assert_same_frames(take, other):
    for name in ARRAYS:
        assert getattr(take, name).tobytes() == getattr(other, name).tobytes(), name


# Headers --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "info",
    [
        INFO,
        take_info(False, False, False, 0.0),
        take_info(True, False, True, coils=("a\nb", "ü\x00", "<&>")),
    ],
)
def test_everything_about_a_take_comes_back_from_its_headers(info):
    streams = read_xdf(file_header({}) + header_bytes(info), "t").streams
    back = info_from_streams(streams)
    for field in TakeInfo.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(back, field), getattr(info, field), err_msg=field)
    assert [(stream.name, stream.stream_id) for stream in streams] == list(STREAM_IDS.items())
    assert streams[1].labels == info.prepared_labels and streams[2].labels == info.pose_labels
    assert streams[0].units[2] == "mm" and streams[0].channels[2].type == "PositionX"


def test_another_file_is_not_taken_for_a_take(tmp_path):
    path = written(tmp_path / "a.xdf", [file_header({})])
    with pytest.raises(InputError, match="not a take"):
        read_take(path)
    path.write_bytes(b"time_s,a_x\n")
    with pytest.raises(InputError, match="not a take"):
        read_take(path)
    with pytest.raises(InputError, match="no such file"):
        read_take(tmp_path / "b.xdf")
    narrow = take_info(status=False)
    mixed = header_bytes(INFO).replace(b"[true, true, true]", b"[true, true, null]")
    path = written(path, [file_header({}), mixed])
    with pytest.raises(InputError, match=f"expected {len(narrow.raw_labels)} of double64"):
        read_take(path)
    later = header_bytes(INFO).replace(b"<tonguetrack_take>1<", b"<tonguetrack_take>2<")
    with pytest.raises(InputError, match="version '2'"):
        read_take(written(path, [file_header({}), later]))
    broken = header_bytes(INFO).replace(b"[12, 40]", b"[12, 'a]")
    with pytest.raises(InputError, match="description is damaged"):
        read_take(written(path, [file_header({}), broken]))


# A finished take ------------------------------------------------------------------------------------


def test_a_finished_take_has_every_bit(tmp_path):
    rows = rows_of(INFO, 95)
    take = read_take(written(tmp_path / "a.xdf", parts_of(INFO, rows)))
    assert take.complete and take.state == "complete" and take.damage is None
    assert_frames(take, rows)
    assert take.frame_count == 95 and take.duration_s == pytest.approx(94 * 0.0025)
    assert take.times_s[0] == 0.0


def test_another_program_reads_the_take(tmp_path):
    pyxdf = pytest.importorskip("pyxdf")
    rows = rows_of(INFO, 25)
    path = written(tmp_path / "a.xdf", parts_of(INFO, rows, [(5.01, "session: a = 1\nb = 2")]))
    streams, _ = pyxdf.load_xdf(str(path), synchronize_clocks=False, dejitter_timestamps=False)
    by_name = {stream["info"]["name"][0]: stream for stream in streams}
    for name in NUMBERS:
        np.testing.assert_array_equal(by_name[name]["time_series"], rows[name])
        np.testing.assert_array_equal(by_name[name]["time_stamps"], stamps_of(rows))
    assert by_name["markers"]["time_series"] == [["session: a = 1\nb = 2"]]
    assert by_name["raw"]["info"]["desc"][0]["session"] == [INFO.session_toml]


def test_the_recording_in_a_take_is_what_the_device_sent(tmp_path):
    rows = rows_of(INFO, 40)
    path = written(tmp_path / "a.xdf", parts_of(INFO, rows))
    for recording in (open_recording(path), read_take(path).recording()):
        assert recording.coils == INFO.coils and recording.frame == INFO.frame and recording.rate_hz == 400.0
        assert recording.positions.tobytes() == rows["raw"][:, 2:11].tobytes()
        assert recording.quaternions.tobytes() == rows["raw"][:, 11:23].tobytes()
        assert recording.rms.tobytes() == rows["raw"][:, 23:26].tobytes()
        assert recording.status.dtype == np.uint32
        assert recording.status[5].tolist() == [0, 49, 0xFFFFFFFF]
        assert recording.device_times_s.tobytes() == rows["raw"][:, 0].tobytes()
        assert recording.frame_numbers.tolist() == list(range(7, 47))
        device = rows["raw"][:, 0]
        assert recording.times_s.tobytes() == (device - device[0]).tobytes()
        assert not recording.valid()[3, 0]
    bare = take_info(False, False, False)
    rows = rows_of(bare, 5)
    recording = open_recording(written(path, parts_of(bare, rows)))
    assert recording.quaternions is None and recording.rms is None and recording.status is None
    assert recording.positions.tobytes() == rows["raw"][:, 2:].tobytes()


def test_a_replayed_take_gives_the_device_times_and_numbers_of_then(tmp_path):
    rows = rows_of(INFO, 12)
    rows["raw"][6:, 0] = 3.0  # the device's clock jumped back
    path = written(tmp_path / "a.xdf", parts_of(INFO, rows))
    with ReplaySource(open_recording(path), speed=None) as source:
        played = list(source)
    for frame, again, row in zip(played, read_take(path).frames(), rows, strict=True):
        for one in (frame, again):
            assert one.device_time_s == row["raw"][0] and one.frame_number == row["raw"][1]
            assert one.positions.tobytes() == row["raw"][2:11].tobytes()
            assert one.quaternions.tobytes() == row["raw"][11:23].tobytes()
        assert again.arrival_ns == row["arrival_ns"]


def test_frames_that_arrived_together_have_the_devices_times_or_else_times_just_after_each_other(tmp_path):
    rows = rows_of(INFO, 10)
    rows["arrival_ns"][4:7] = rows["arrival_ns"][3]
    path = written(tmp_path / "device.xdf", parts_of(INFO, rows))
    np.testing.assert_array_equal(open_recording(path).times_s, rows["raw"][:, 0] - rows["raw"][0, 0])
    rows["raw"][:, 0] = 1.0  # a device without a clock
    path = written(tmp_path / "a.xdf", parts_of(INFO, rows))
    recording = open_recording(path)
    assert (np.diff(recording.times_s) > 0).all()
    assert recording.times_s[6] == pytest.approx(recording.times_s[3])
    assert any(note.startswith("3 frame(s) arrived together") for note in recording.notes)
    assert_frames(read_take(path), rows)


def test_without_a_stated_rate_the_arrivals_tell_it_or_the_user(tmp_path):
    info = take_info(rate_hz=0.0)
    path = written(tmp_path / "a.xdf", parts_of(info, rows_of(info, 11)))
    assert open_recording(path).rate_hz == pytest.approx(400.0)
    assert open_recording(path, rate_hz=250.0).rate_hz == 250.0
    path = written(tmp_path / "b.xdf", parts_of(info, rows_of(info, 1)))
    with pytest.raises(InputError, match="--rate"):
        open_recording(path)
    with pytest.raises(InputError, match="--unit cm cannot hold"):
        open_recording(path, unit="cm")


def test_poses_of_a_take_are_those_that_were_recorded(tmp_path):
    rows = rows_of(INFO, 30)
    rows["pose"][10, 0] = PoseStatus.HELD
    poses = read_take(written(tmp_path / "a.xdf", parts_of(INFO, rows))).poses()
    assert poses.statuses[9:12].tolist() == [PoseStatus.OK, PoseStatus.HELD, PoseStatus.OK]
    np.testing.assert_array_equal(poses.weights, rows["pose"][:, 6:9])
    np.testing.assert_array_equal(poses.speaker_weights, rows["pose"][:, 9:11])
    np.testing.assert_array_equal(poses.residuals_mm, rows["pose"][:, 11:13])
    np.testing.assert_array_equal(poses.energies, rows["pose"][:, 3])
    np.testing.assert_array_equal(poses.coils, rows["prepared"].reshape(30, 2, 3))
    np.testing.assert_allclose(poses.normalised * INFO.pose_sigma + INFO.pose_mean, poses.weights)
    assert poses.experiment == 2 and poses.correspondences == (12, 40)
    rows["pose"][0, 1] = 0.0
    assert read_take(written(tmp_path / "b.xdf", parts_of(INFO, rows))).poses().experiment == 1


def test_poses_of_a_take_know_which_coils_counted(tmp_path):
    rows = rows_of(INFO, 6)
    rows["pose"][2, -2:] = [CoilState.MISFIT, CoilState.WILD]
    rows["pose"][3, -1] = 77.5  # damage
    rows["pose"][4, 0] = np.nan  # no pose
    rows["pose"][5, -1] = CoilState.RETURNING
    states = read_take(written(tmp_path / "a.xdf", parts_of(INFO, rows))).poses().coil_states
    assert states.tolist() == [
        [0, 0],
        [0, 0],
        [CoilState.MISFIT, CoilState.WILD],
        [0, 0],
        [0, CoilState.RETURNING],
    ]


def test_frames_whose_weights_are_damaged_are_no_poses(tmp_path):
    rows = rows_of(INFO, 6)
    rows["pose"][2, 7] = np.nan
    rows["pose"][4, 9] = np.inf
    poses = read_take(written(tmp_path / "a.xdf", parts_of(INFO, rows))).poses()
    np.testing.assert_array_equal(poses.weights, rows["pose"][[0, 1, 3, 5], 6:9])


def test_markers_know_the_frame_from_which_they_hold(tmp_path):
    rows = rows_of(INFO, 30)
    at = stamps_of(rows)
    marks = [
        (at[20] - 1e-9, "session: [energy]\nalpha = 2.0\n"),
        (at[5], "a word: now"),
        (at[-1] + 9, "source: gap: 3 frames"),
    ]
    take = read_take(written(tmp_path / "a.xdf", parts_of(INFO, rows, marks)))
    assert [(mark.row, mark.word) for mark in take.markers] == [(5, ""), (20, "session"), (30, "source")]
    assert take.markers[0].content == "a word: now"
    assert take.markers[2].content == "gap: 3 frames"
    assert take.markers[0].time_s == pytest.approx(5 * 0.0025)
    assert take.sessions == ((0, INFO.session_toml), (20, "[energy]\nalpha = 2.0\n"))


def test_a_marker_whose_time_is_damaged_is_not_lost(tmp_path):
    rows = rows_of(INFO, 10)
    for time_s in (np.nan, np.inf):
        take = read_take(written(tmp_path / "a.xdf", parts_of(INFO, rows, [(time_s, "now"), (5.01, "then")])))
        assert [(mark.time_s, mark.text) for mark in take.markers] == [
            (0.0, "now"),
            (pytest.approx(0.01), "then"),
        ]


# Cut off and damaged --------------------------------------------------------------------------------


def test_cut_at_any_byte_a_take_opens_up_to_its_last_whole_chunk(tmp_path):
    info = take_info(False, False, False, coils=("a",))
    rows = rows_of(info, 4)
    parts = parts_of(info, rows, [(5.0, "mark")], each=2)
    whole = b"".join(parts)
    ends = np.cumsum([len(part) for part in parts])
    path = tmp_path / "a.xdf"
    first = ends[0] + len(missing_headers(info, NUMBERS[1:] + ("markers",)))
    for cut in [*range(first, ends[1], 29), *range(ends[1], len(whole))]:
        path.write_bytes(whole[:cut])
        take = read_take(path)
        counts = [2 * int(np.count_nonzero(ends[2 + k : 8 : 3] <= cut)) for k in range(3)]
        assert take.frame_count == counts[0]
        for name, count in zip(NUMBERS, counts, strict=True):
            values = getattr(take, name)
            assert values[:count].tobytes() == np.ascontiguousarray(rows[name][:count]).tobytes()
            assert np.isnan(values[count:]).all()
        assert not take.complete and take.state == "unfinished"
        if counts[0] and cut % 50 == 0:
            assert open_recording(path).frame_count == counts[0]


def test_a_cut_take_says_so_in_the_recordings_notes(tmp_path):
    parts = parts_of(INFO, rows_of(INFO, 40), finished=False)
    path = written(tmp_path / "a.xdf", parts)
    assert any("was not finished" in note for note in open_recording(path).notes)
    path.write_bytes(b"".join(parts)[:-1])
    assert any("cut off at byte" in note for note in open_recording(path).notes)
    written(path, parts[:2])
    with pytest.raises(InputError, match="no frames"):
        open_recording(path)
    with pytest.raises(InputError, match="no frames"):
        read_take(path).poses()


def test_behind_damage_frames_are_put_together_by_their_stamps(tmp_path):
    rows = rows_of(INFO, 90)
    parts = parts_of(INFO, rows)
    parts[3] = parts[3][:16] + b"\xff" + parts[3][17:]  # the first ten rows of `prepared`
    parts[5] = b"\7" + parts[5][1:]  # `raw` of the next ten, and all up to the boundary
    take = read_take(written(tmp_path / "a.xdf", parts))
    assert take.state == "damaged" and take.damage.count("is damaged") == 2
    assert take.frame_count == 70
    assert np.isnan(take.prepared[:10]).all()
    for name in NUMBERS:
        assert getattr(take, name)[10:].tobytes() == np.ascontiguousarray(rows[name][30:]).tobytes()
    assert take.raw[:10].tobytes() == np.ascontiguousarray(rows["raw"][:10]).tobytes()
    assert take.pose[:10].tobytes() == np.ascontiguousarray(rows["pose"][:10]).tobytes()
    assert take.poses().frame_count == 70


PLACES = st.integers(0, 2**31)


@settings(BRISK, max_examples=400)
@given(st.lists(st.tuples(PLACES, st.integers(0, 255)), min_size=1, max_size=4))
def test_any_changed_bytes_open_or_are_an_input_error(tmp_path_factory, changes):
    info = take_info(coils=("a",), status=False)
    data = bytearray(b"".join(parts_of(info, rows_of(info, 30), [(5.0, "mark")])))
    for place, value in changes:
        data[place % len(data)] = value
    path = tmp_path_factory.getbasetemp() / "fuzzed.xdf"
    path.write_bytes(data)
    try:
        take = read_take(path)
        take.recording()
        take.poses()
    except InputError as reason:
        assert str(reason).startswith(str(path))
        return
    assert len(take.raw) == len(take.prepared) == len(take.pose) == take.frame_count
    assert (np.diff(take.recording().times_s) > 0).all()


# The journal, and recovering ------------------------------------------------------------------------


class Recorded:
    """A take as it stands on disk at two moments: while it is recorded, and when it is finished."""

    def __init__(self, folder):
        self.finished = folder / "finished.xdf"
        self.killed = folder / "killed.xdf"
        recorder = TakeRecorder(INFO, self.finished)
        recorder.open()
        random = np.random.default_rng(5)
        for number in range(400):
            pose = TrackedPose(
                random.normal(size=3), np.zeros(3), np.ones(2), random.normal(size=2), 1.0, 2.0, 2, 1,
                coil_states=np.zeros(2, np.int64),
            )  # fmt: skip
            frame = CoilFrame(
                random.normal(size=(3, 3)), number / 400, number, time.perf_counter_ns(),
                random.normal(size=(3, 4)), random.normal(size=3), np.arange(3, dtype=np.uint32),
            )  # fmt: skip
            recorder.put(frame, random.normal(size=(2, 3)), pose)
            if number in (200, 390):
                recorder.mark(f"mark {number}", time.perf_counter_ns())
            if number in (100, 250):
                while recorder.backlog:  # so that a part is in the file, and a part only in the journal
                    time.sleep(0.005)
        beside = self.finished.with_name("finished.xdf.journal")
        self.killed.write_bytes(self.finished.read_bytes())
        self.killed.with_name("killed.xdf.journal").write_bytes(beside.read_bytes())
        assert recorder.close().failure is None

    def killed_copy(self, folder, cut=None):
        path = folder / "take.xdf"
        path.write_bytes(self.killed.read_bytes()[:cut])
        path.with_name("take.xdf.journal").write_bytes(
            self.killed.with_name("killed.xdf.journal").read_bytes()
        )
        return path


MARKS = [(201, "mark 200"), (391, "mark 390")]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return Recorded(tmp_path_factory.mktemp("recorded"))


def test_the_recorders_take_is_complete(recorded):
    take = read_take(recorded.finished)
    assert take.complete and take.frame_count == 400 and take.journal_note == ""
    assert [(mark.row, mark.text) for mark in take.markers] == MARKS
    assert take.recording().frame_numbers.tolist() == list(range(400))


def test_the_journal_beside_a_killed_take_gives_its_last_frames(recorded, tmp_path):
    path = recorded.killed_copy(tmp_path)
    take = read_take(path)
    assert take.state == "unfinished" and "from the journal" in take.journal_note
    assert_same_frames(take, read_take(recorded.finished))
    assert [(mark.row, mark.text) for mark in take.markers] == MARKS
    assert open_recording(path).frame_count < 400


def test_wherever_a_take_was_cut_its_journal_fills_the_streams_up_to_the_same_frame(recorded, tmp_path):
    size = recorded.killed.stat().st_size
    begin = read_xdf(recorded.killed.read_bytes(), "t").headers_end
    for cut in np.linspace(begin, size, 12).astype(int).tolist():
        take = read_take(recorded.killed_copy(tmp_path, cut))
        assert_same_frames(take, read_take(recorded.finished))
        assert [(mark.row, mark.text) for mark in take.markers] == MARKS


def test_a_journal_of_another_take_or_a_damaged_one_is_left_alone(recorded, tmp_path):
    path = written(tmp_path / "take.xdf", parts_of(INFO, rows_of(INFO, 10), finished=False))
    beside = tmp_path / "take.xdf.journal"
    beside.write_bytes(recorded.killed.with_name("killed.xdf.journal").read_bytes())
    take = read_take(path)
    assert take.frame_count == 10 and "another take" in take.journal_note
    beside.write_bytes(b"nonsense")
    assert "not the journal" in read_take(path).journal_note


def test_recovering_gives_the_take_that_would_have_been(recorded, tmp_path):
    path = recorded.killed_copy(tmp_path)
    before = path.read_bytes()
    said = recover(path, tmp_path / "new.xdf")
    new = read_take(tmp_path / "new.xdf")
    assert new.complete and new.markers == read_take(recorded.finished).markers
    assert_same_frames(new, read_take(recorded.finished))
    assert said[0].startswith("400 frames") and "2 mark(s)" in said[0]
    assert path.read_bytes() == before


def test_a_recovered_take_is_read_by_another_program(recorded, tmp_path):
    pyxdf = pytest.importorskip("pyxdf")
    recover(recorded.killed_copy(tmp_path, -5), tmp_path / "new.xdf")
    streams, _ = pyxdf.load_xdf(
        str(tmp_path / "new.xdf"), synchronize_clocks=False, dejitter_timestamps=False
    )
    assert [stream["footer"]["info"]["sample_count"] for stream in streams[:3]] == [["400"]] * 3
    np.testing.assert_array_equal(streams[0]["time_series"], read_take(recorded.finished).raw)


def test_recovering_keeps_everything_on_both_sides_of_the_damage(tmp_path):
    rows = rows_of(INFO, 90)
    parts = parts_of(INFO, rows, [(5.0, "mark")])
    broken = parts[3]
    parts[3] = broken[:16] + b"\xff" + broken[17:]
    path = written(tmp_path / "a.xdf", parts)
    said = recover(path, tmp_path / "new.xdf")
    new = read_take(tmp_path / "new.xdf")
    assert new.complete
    assert_same_frames(new, read_take(path))
    assert any("belong to no whole chunk" in sentence for sentence in said)
    assert any("no journal" in sentence for sentence in said)


def test_a_stream_whose_header_was_damaged_is_recovered_with_the_takes_own_description(tmp_path):
    rows = rows_of(INFO, 30)
    parts = parts_of(INFO, rows)
    only_raw = missing_headers(INFO, ("prepared", "pose", "markers"))
    path = written(tmp_path / "a.xdf", [parts[0], only_raw, *parts[2:]])
    assert "which has no header" in read_take(path).damage
    recover(path, tmp_path / "new.xdf")
    assert_frames(read_take(tmp_path / "new.xdf"), rows)


def test_recovering_refuses_what_is_whole_what_is_empty_and_what_would_be_lost(tmp_path):
    rows = rows_of(INFO, 10)
    whole = written(tmp_path / "whole.xdf", parts_of(INFO, rows))
    with pytest.raises(InputError, match="nothing to recover"):
        recover(whole, tmp_path / "new.xdf")
    part = written(tmp_path / "part.xdf", parts_of(INFO, rows, finished=False))
    for there in (whole, part):
        with pytest.raises(InputError, match="never overwritten"):
            recover(part, there)
    empty = written(tmp_path / "empty.xdf", parts_of(INFO, rows[:0], finished=False))
    with pytest.raises(InputError, match="not one frame"):
        recover(empty, tmp_path / "new.xdf")
    assert not (tmp_path / "new.xdf").exists()
