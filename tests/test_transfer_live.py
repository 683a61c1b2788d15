"""Motion transfer while it is tracked: whatever draws shows another speaker's anatomy, and what is recorded does not."""

import http.client
import re
import subprocess
import sys

import numpy as np
import pytest
from streaming import context, info, model, pose, receiver, waiting
from strict_more import Receiver

from tonguetrack import InputError
from tonguetrack.model.rebasing import Rebased
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.cli.live import speakers
from tonguetrack.tracker.gltf import glb
from tonguetrack.tracker.palate import curve_palate
from tonguetrack.tracker.session import parse_session, session_toml
from tonguetrack.tracker.streams.feed import FeedAbout, FeedReader, FeedSink
from tonguetrack.tracker.streams.oscquery import OscQueryWorker
from tonguetrack.tracker.streams.transferred import TransferredSink
from tonguetrack.tracker.takes.reading import read_take
from tonguetrack.tracker.transfer import OtherSpeaker, session_of

RUN = (
    sys.executable,
    "-c",
    "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))",
)


def other_weights():
    return model().speaker.mean + 0.8 * model().speaker.sigma


def flag():
    return f"--speaker={','.join(map(repr, other_weights().tolist()))}"


def test_what_draws_is_fed_the_other_anatomy_without_the_first_ones_coils(tmp_path):
    feed = FeedSink(tmp_path, FeedAbout("bundled", "", (), (), 4, 5))
    sink = TransferredSink(feed, other_weights())
    tracked = pose(7, speaker_fixed=False)
    sink.start(info(fixed=False))
    sink.send(tracked)
    with FeedReader(tmp_path) as reader:
        _, shown = reader.newest()
    sink.close()
    np.testing.assert_array_equal(shown.weights, tracked.weights)
    np.testing.assert_array_equal(shown.normalised, tracked.normalised)
    np.testing.assert_array_equal(shown.speaker_weights, other_weights())
    assert not shown.speaker_fixed and shown.coils.shape == (0, 3) and np.isnan(shown.residual_mm)
    assert (shown.frame_number, shown.device_time_s) == (7, tracked.device_time_s)
    np.testing.assert_array_equal(tracked.speaker_weights, model().speaker.mean)  # as it was
    assert (sink.sent, sink.dropped, sink.destination) == (1, 0, "feed")


def test_the_other_speakers_session_comes_back_with_weights_and_palate():
    palate = curve_palate(np.array([[0.0, 4.0, 6.5], [0.0, 8.0, 9.1], [0.0, 30.0, 12.0]]), "a trace")
    told = session_toml(session_of(OtherSpeaker(other_weights(), palate, "")))
    session = parse_session(told, "here")
    np.testing.assert_array_equal(session.speaker_weights, other_weights())
    np.testing.assert_array_equal(session.palate.points_mm, palate.points_mm)


def test_the_model_that_oscquery_gives_is_the_other_speakers():
    def given(**more):
        worker = OscQueryWorker("127.0.0.1:0", context(None, **more))
        worker.begin(info())
        worker.work(pose())
        body = worker.answer("/model.glb", "127.0.0.1")[2]
        worker.end()
        return body

    assert given(shown_speaker=other_weights()) != given()
    worker = OscQueryWorker("127.0.0.1:0", context(None))
    worker.begin(info())
    worker.work(pose(speaker_weights=other_weights()))
    assert worker.answer("/model.glb", "127.0.0.1")[2] == given(shown_speaker=other_weights())
    worker.end()


def test_a_live_run_streams_the_other_mesh_and_records_its_own_speaker(tmp_path):
    with receiver() as (opened, place):
        command = ["live", "simulate:?seconds=2", "--seconds", "1", "--record", str(tmp_path / "take.xdf")]
        command += [
            "--control",
            "127.0.0.1:0",
            "--to",
            f"osc://{place}?rate=20&send=mesh",
            "--speaker",
            "joint",
            flag(),
        ]
        done = subprocess.run([*RUN, *command], capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr
        datagrams = waiting(opened)
    found = Receiver(model().vertex_count)
    for datagram in datagrams:
        if b"/tongue/mesh" in datagram:
            found.receive(datagram)
    assert found.vertices is not None
    # Whatever the pose: its differences from the other speaker's mean tongue are made of that speaker's directions.
    speaker = model().for_speaker(other_weights())
    away = (found.vertices - speaker.vertices(np.zeros(model().pose.size))).ravel()
    directions = np.array(
        [(speaker.vertices(unit) - speaker.vertices(0 * unit)).ravel() for unit in np.eye(model().pose.size)]
    )
    solved, *_ = np.linalg.lstsq(directions.T, away, rcond=None)
    assert np.abs(directions.T @ solved - away).max() < 0.01
    take = read_take(tmp_path / "take.xdf").poses()
    assert not np.allclose(take.speaker_weights[-1], other_weights(), atol=0.05)


@pytest.fixture
def page():
    """The tongue that the page of a demo has: `/model.glb`, with these flags."""

    def fetched(*flags):
        run = subprocess.Popen(
            [*RUN, "demo", "--web", "127.0.0.1:0", "--seconds", "60", "--osc", "127.0.0.1:9", *flags],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            for line in run.stderr:
                if address := re.match(r"page: http://127\.0\.0\.1:(\d+)/", line):
                    connection = http.client.HTTPConnection("127.0.0.1", int(address[1]), timeout=30)
                    connection.request("GET", "/model.glb")
                    return connection.getresponse().read()
            raise AssertionError("no page")
        finally:
            run.terminate()
            run.communicate(timeout=60)

    return fetched


def test_the_page_draws_the_other_anatomy(page):
    mode = model().pose
    expected = glb(
        model().for_speaker(other_weights()), Rebased.of_range(mode.mean, mode.sigma, 5.0), model().name
    )
    assert page(flag()) == expected


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["demo", "--speaker", "0,0,0,0,0"], "add what shows it: --view, --web"),
        (["demo", "--web", "127.0.0.1:0", "--speaker", "1,2"], "--speaker 1,2: 2 weights"),
        (["demo", "--web", "127.0.0.1:0", "--speaker", "gone.toml"], "gone.toml"),
        (["live", "simulate:", "--speaker", "join"], "expected mean or joint"),
        (["live", "simulate:", "--speaker", "0,0,0,0,0"], "add what shows it: --view, --web"),
        (["live", "simulate:", "--speaker", "mean", "--speaker", "joint"], "give one of mean and joint"),
        (["track", "r.csv", "--speaker", "0,0,0,0,0"], "add --view"),
        (["track", "r.csv", "--view", "--speaker", "nan,0,0,0,0"], "all finite"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r.csv").write_text("")
    assert main(arguments) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


def test_how_the_speaker_is_estimated_and_who_is_shown_are_told_apart():
    assert speakers([]) == ("mean", None)
    assert speakers(["joint"]) == ("joint", None)
    assert speakers(["other.toml", "joint"]) == ("joint", "other.toml")
    assert speakers(["-0.1,2"]) == ("mean", "-0.1,2")
    with pytest.raises(InputError, match="one speaker to be shown"):
        speakers(["a.toml", "b.toml"])
