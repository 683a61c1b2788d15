"""A whole run with many targets at once, in a process of its own, each heard by the strict receiver of its protocol."""

import json
import subprocess
import sys
from contextlib import ExitStack

import pytest
from streaming import model, receiver, waiting
from strict_more import Receiver
from strict_vmc import Performer
from strict_vrchat import Avatar

from tonguetrack.tracker.streams.monitor import decode
from tonguetrack.tracker.streams.presets import load_preset

SECONDS = 3
RATE_HZ = 250


@pytest.fixture(scope="module")
def run():
    """The datagrams of each target, and the summary."""
    with ExitStack() as stack:
        places = {
            name: stack.enter_context(receiver()) for name in ("osc", "vmc", "vrchat", "json", "slow", "more")
        }
        where = {name: place for name, (_, place) in places.items()}
        targets = [
            f"osc://{where['osc']}",
            f"vmc://{where['vmc']}?preset=metahuman24&rate=50",
            f"vrchat://{where['vrchat']}?rate=25&filter=1.5,0.5",
            f"json://{where['json']}",
            f"osc://{where['slow']}?rate=20",
            f"osc://{where['more']}?rate=20&send=coils,shapes,unit,mesh",
        ]
        script = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", script, "demo", "--seconds", str(SECONDS), "--json"]
        command += [word for target in targets for word in ("--to", target)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr
        yield {name: waiting(opened) for name, (opened, _) in places.items()}, json.loads(done.stdout)


def test_every_target_is_told_of_in_the_summary(run):
    _, summary = run
    sent = [(sink["destination"].split()[0], sink["sent"]) for sink in summary["sinks"]]
    assert [kind for kind, _ in sent] == ["osc", "vmc", "vrchat", "json", "osc", "osc", "osc"]
    assert sent[0] == ("osc", SECONDS * RATE_HZ)


def test_each_target_has_a_rate_of_its_own(run):
    _, summary = run
    rates = {"vmc": 50, "vrchat": 25}
    for sink in summary["sinks"]:
        rate = rates.get(sink["destination"].split()[0])
        if rate is not None:
            assert 1 <= sink["sent"] <= rate * SECONDS + rate


def test_our_osc_has_every_frame(run):
    heard, _ = run
    numbers = [
        values[0] for datagram in heard["osc"] for path, values in decode(datagram) if path == "/tongue/frame"
    ]
    assert numbers == list(range(SECONDS * RATE_HZ))


def test_our_osc_at_a_rate_numbers_what_it_sends(run):
    heard, _ = run
    numbers = [
        values[0]
        for datagram in heard["slow"]
        for path, values in decode(datagram)
        if path == "/tongue/frame"
    ]
    assert numbers == list(range(len(numbers))) and 1 <= len(numbers) <= 20 * SECONDS + 20


def test_a_strict_avatar_follows(run):
    heard, _ = run
    performer = Performer(target.name for target in load_preset("metahuman24").targets)
    seen = set()
    for datagram in heard["vmc"]:
        performer.receive(datagram)
        seen.add(performer.shown.get("CTRL_expressions_tongueTipDown"))
    assert performer.applied >= 1 and set(performer.shown) == performer.names
    assert len(seen) > 5


def test_a_strict_avatar_in_vrchat_follows(run):
    heard, _ = run
    avatar = Avatar()
    for datagram in heard["vrchat"]:
        avatar.receive(datagram)
    assert set(avatar.floats) == avatar.names and avatar.states["LipTrackingActive"] is True


def test_the_authors_clients_get_every_pose_in_order(run):
    heard, summary = run
    stamps = [json.loads(datagram)["timeStamp"] for datagram in heard["json"]]
    (sink,) = [sink for sink in summary["sinks"] if sink["destination"].startswith("json")]
    assert stamps == sorted(set(stamps))
    # The newest pose is handed on when the stream is closed, after the summary was made.
    assert 0 <= len(stamps) - sink["sent"] <= 2


def test_what_was_asked_for_beside_our_osc_arrives_too(run):
    heard, _ = run
    found = Receiver(model().vertex_count)
    extra = [
        datagram for datagram in heard["more"] if b"/tongue/extra" in datagram or b"/tongue/mesh" in datagram
    ]
    for datagram in extra:
        found.receive(datagram)
    assert set(found.coils) == {"tongue_tip", "tongue_blade", "tongue_dorsum"}
    assert found.shapes and len(found.unit) == model().pose.size
    assert abs(found.vertices).max() < 200.0  # whole, and in millimetres
