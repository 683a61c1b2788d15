"""The generated page of all protocols, that what is sent is what stands on it, and the receivers of the docs."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from streaming import context, info, nobody, pose, receiver, waiting

from tonguetrack.tracker.cli import main
from tonguetrack.tracker.streams.addresses import ADDRESSES, EXTRA_ADDRESSES, SHAPE
from tonguetrack.tracker.streams.avatar import avatar_values
from tonguetrack.tracker.streams.lsl import coil_channels, pose_channels
from tonguetrack.tracker.streams.monitor import decode
from tonguetrack.tracker.streams.osc import OscSink
from tonguetrack.tracker.streams.osc_more import WORDS, OscMoreWorker
from tonguetrack.tracker.streams.presets import load_preset, preset_names
from tonguetrack.tracker.streams.protocols import known_address, protocols_page
from tonguetrack.tracker.streams.targets import KINDS
from tonguetrack.tracker.streams.vmc import VMC_ADDRESSES, VMC_VALUE, VmcWorker
from tonguetrack.tracker.streams.vrchat import VRCHAT_ADDRESSES, VrchatWorker, parameter_prefixes

DOCS = Path(__file__).resolve().parents[1] / "docs"


def test_the_page_in_the_docs_is_the_one_that_the_code_makes():
    assert (DOCS / "protocols.md").read_text() == protocols_page(), (
        "run: tonguetrack monitor --protocols > docs/protocols.md"
    )


@pytest.mark.parametrize(("flag", "name"), [("--protocols", "protocols.md"), ("--addresses", "osc.md")])
def test_the_command_prints_the_pages(flag, name, capsys):
    assert main(["monitor", flag]) == 0
    assert capsys.readouterr().out == (DOCS / name).read_text()


def test_the_page_names_every_target_address_name_and_channel():
    page = protocols_page()
    for kind in KINDS:
        assert f"| `{kind.form}` |" in page
        for option in kind.options:
            assert f"\n| `{option}` |" in page
    for row in (*ADDRESSES, *EXTRA_ADDRESSES, *VMC_ADDRESSES, *VRCHAT_ADDRESSES):
        assert f"| `{row.path}` | `{row.type_tags}` |" in page
    for preset in map(load_preset, preset_names()):
        assert f"### `{preset.name}`" in page
        for name in [*(target.name for target in preset.targets), *preset.undriven]:
            assert f"| `{name}` |" in page
    for channel in (*coil_channels(("ROLE",)), *pose_channels(2, 1)):
        assert f"| {channel.label} | {channel.type} | {channel.unit} |" in page


def test_every_table_of_the_page_has_as_many_cells_in_every_row():
    lines = protocols_page().splitlines()
    for above, line in pairwise(lines):
        if above.startswith("|") and line.startswith("|"):
            assert above.count("|") == line.count("|"), line


@pytest.mark.parametrize(
    "open_worker",
    [
        lambda place: VmcWorker(place, avatar_values("metahuman24", context(), signed=False)),
        lambda place: VrchatWorker(
            place, avatar_values("unified", context(), signed=True), parameter_prefixes("unified")
        ),
        lambda place: OscMoreWorker(place, context(), WORDS),
    ],
)
def test_every_message_that_is_sent_fits_a_row_of_the_page(open_worker):
    with receiver() as (opened, place):
        worker = open_worker(place)
        worker.begin(info())
        worker.work(pose())
        datagrams = waiting(opened)
        worker.end()
    assert datagrams
    for datagram in datagrams:
        for path, values in decode(datagram):
            row = known_address(path)
            assert row is not None and row.fits(values), path
            for argument, value in zip(row.arguments, values, strict=False):
                assert argument.limits is None or argument.limits[0] <= value <= argument.limits[1]


# The receivers of the docs --------------------------------------------------------------------------


def test_the_python_receiver_of_the_docs_prints_what_is_sent():
    place = nobody()
    program = [sys.executable, str(DOCS / "receivers" / "receive.py"), place.rpartition(":")[2]]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as receiving:
        try:
            assert receiving.stdout.readline() == "listening\n"
            sink = OscSink(place)
            sink.start(info())
            sink.send(pose())
            words = receiving.stdout.readline().split()
            assert words[:3] == ["/tongue/info", "tonguetrack", "1"]
            address, *numbers = receiving.stdout.readline().split()
            sink.close()
        finally:
            receiving.kill()
    assert address == "/tongue/sigma"
    assert [float(number) for number in numbers] == [0.5, -1.0, 1.5, 0.25]


def test_the_unity_receiver_of_the_docs_listens_to_addresses_that_are_sent():
    text = (DOCS / "receivers" / "TongueReceiver.cs").read_text()
    assert f'"{SHAPE.path.replace("<name>", "")}"' in text
    assert f'"{VMC_VALUE.path}"' in text
