"""Every pose as the JSON of the authors' server, read as its clients read it."""

import json

import numpy as np
import pytest
from streaming import info, nobody, pose, random_poses, receiver, waiting

from tonguetrack import InputError
from tonguetrack.tracker.streams.json_out import JsonWorker
from tonguetrack.tracker.streams.slot import SlotSink

MOST_BYTES = 8192  # what the authors' programs read at once


def strict_answer(datagram):
    """One map with exactly these keys, lists of finite numbers and a number; a line end behind it."""
    assert len(datagram) <= MOST_BYTES and datagram.endswith(b"\n") and datagram.count(b"\n") == 1

    def no_constant(text):
        raise AssertionError(f"{text} is no JSON")

    def no_pair_twice(pairs):
        assert len({key for key, _ in pairs}) == len(pairs)
        return dict(pairs)

    found = json.loads(datagram.decode("ascii"), parse_constant=no_constant, object_pairs_hook=no_pair_twice)
    assert set(found) == {"phonemeWeights", "speakerWeights", "timeStamp"}
    for key in ("phonemeWeights", "speakerWeights"):
        assert isinstance(found[key], list) and all(type(value) is float for value in found[key])
    assert type(found["timeStamp"]) is float
    return found


def sent(opened, worker, *poses):
    worker.begin(info())
    for each in poses:
        worker.work(each)
    return waiting(opened)


def test_a_pose_is_one_datagram_with_raw_weights_to_the_last_bit():
    poses = random_poses(5)
    with receiver() as (opened, place):
        found = [strict_answer(datagram) for datagram in sent(opened, JsonWorker(place), *poses)]
    assert [each["phonemeWeights"] for each in found] == [each.weights.tolist() for each in poses]
    assert [each["speakerWeights"] for each in found] == [each.speaker_weights.tolist() for each in poses]
    assert [each["timeStamp"] for each in found] == [each.device_time_s for each in poses]


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_json_cannot_say_is_a_loss_and_is_never_sent(wrong):
    with receiver() as (opened, place):
        sink = SlotSink(JsonWorker(place))
        sink.start(info())
        sink.send(pose(device_time_s=wrong))
        sink.close()
        assert (sink.sent, sink.dropped) == (0, 1) and sink.failure.startswith(f"json {place}: ")
        assert waiting(opened) == []


def test_an_absent_receiver_changes_nothing():
    worker = JsonWorker(nobody())
    for number in range(100):
        worker.work(pose(number))
    worker.end()


def test_a_wrong_destination_is_an_input_error():
    with pytest.raises(InputError, match="HOST:PORT"):
        JsonWorker("nowhere")
