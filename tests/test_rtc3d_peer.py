"""RTC3D against software that nobody here wrote: the server and the client of the public project ematoblender.

Both run as processes of their own, from the checkout that TONGUETRACK_EMATOBLENDER names
(https://github.com/m2ci-msp/ematoblender, GPL-3; nothing of it is part of this project).
"""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tonguetrack.drivers import Recording, open_recording, write_recording
from tonguetrack.drivers.frames import CoilFrame, NoteKind, SourceNote
from tonguetrack.drivers.sources import open_device, parse_source

NAMED = os.environ.get("TONGUETRACK_EMATOBLENDER", "")
pytestmark = pytest.mark.skipif(
    not NAMED, reason="TONGUETRACK_EMATOBLENDER does not name a checkout of m2ci-msp/ematoblender"
)

# What its modules expect of their surroundings: Blender's mathutils (imported, not used here), a clock that
# newer Pythons lack, and one class under the two names that it has had. Its files are left as they are.
SURROUNDINGS = """
import sys, time, types
sys.modules.setdefault("mathutils", types.ModuleType("mathutils"))
time.clock = getattr(time, "clock", time.perf_counter)
import ematoblender.scripts.ema_io.rtc3d_parser as parser
for name, other in (("BasicProtocol", "RTC3DPacketParser"), ("RTC3DPacketParser", "BasicProtocol")):
    if not hasattr(parser, name):
        setattr(parser, name, getattr(parser, other))
import ematoblender.scripts.ema_io.client_server_comms as comms
comms.RTC3DPacketParser = parser.RTC3DPacketParser
import ematoblender.scripts.ema_shared.properties as properties
properties.waveserver_host, properties.waveserver_port = sys.argv[1], int(sys.argv[2])
"""
SERVER = (
    SURROUNDINGS
    + """
import ematoblender.scripts.ema_io.ema_staticserver.rtserver as rtserver
thread, server = rtserver.initialise_server(datafile=sys.argv[3], loop=sys.argv[4] == "loop")
thread.start()
print("listening", file=sys.stderr, flush=True)
thread.join(60)
"""
)
CLIENT = (
    SURROUNDINGS
    + """
import json
import ematoblender.scripts.ema_io.ema_gameserver.rtclient as rtclient
connection, replies = rtclient.init_connection(retain_last=10000)
said = rtclient.test_communication(connection, replies)
parameters = rtclient.get_parameters(connection, replies)
one = rtclient.get_one_df(connection, replies)
rtclient.start_streaming(connection, replies)
time.sleep(2.0)
frames = [
    (c.frame_number, c.timestamp, [[repr(x) for x in coil.abs_loc] for coil in c.coils])
    for c in (frame.components[0] for frame in list(rtclient.stop_streaming(connection, replies)))
]
print(json.dumps({"said": said, "parameters": parameters, "one": len(one.components[0].coils), "frames": frames}),
      file=sys.stderr, flush=True)
connection.s.close()
"""
)


def outside(script, *arguments):
    """A process with that project on its path. It prints every packet to its standard output, which nobody reads."""
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": NAMED},
    )


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return str(taken.getsockname()[1])


@pytest.fixture
def their_server(reference_data, tmp_path):
    """Their server on the first rows of a recording of theirs; calling it gives its URI and that recording."""
    source = reference_data / "recordings" / "ndi_wave_ematoblender" / "Example3.tsv"
    processes = []

    def start(loop, rows=150):
        lines = source.read_text().splitlines(keepends=True)
        short = tmp_path / "short.tsv"
        short.write_text("".join(lines[: rows + 1]))
        port = free_port()
        process = outside(SERVER, "127.0.0.1", port, str(short), "loop" if loop else "once")
        processes.append(process)
        while (line := process.stderr.readline()) and "listening" not in line:
            pass
        assert line, "their server did not start"
        return f"rtc3d://127.0.0.1:{port}", open_recording(short)

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def items_until(source, enough, seconds=15.0):
    items, end_s = [], time.perf_counter() + seconds
    for item in source:
        if isinstance(item, CoilFrame):
            item = CoilFrame(item.positions.copy(), item.device_time_s, item.frame_number, item.arrival_ns)
        items.append(item)
        if enough(items):
            return items
        assert time.perf_counter() < end_s, [i for i in items if isinstance(i, SourceNote)]
    return items


def frames_of(items):
    return [item for item in items if isinstance(item, CoilFrame)]


def test_the_driver_streams_from_their_server_and_gets_the_recording(their_server):
    uri, take = their_server(loop=True)
    with open_device(parse_source(uri)) as source:
        items = items_until(source, lambda items: len(frames_of(items)) >= 250)
    frames, kinds = frames_of(items), {item.kind for item in items if isinstance(item, SourceNote)}
    assert len(source.coils) == len(take.coils)
    assert {frame.frame_number for frame in frames} == {0}
    assert NoteKind.CLOCK_RESET in kinds  # it plays over and over, and its time jumps back
    times = np.round(take.times_s, 6)
    whole = matched = 0
    for frame in frames:
        row = int(np.argmin(np.abs(times - frame.device_time_s)))
        if abs(times[row] - frame.device_time_s) > 1e-4:
            continue
        matched += 1
        present = np.isfinite(frame.positions).all(axis=1)
        expected = take.positions[row]
        there = present & np.isfinite(expected).all(axis=1)
        np.testing.assert_allclose(frame.positions[there], expected[there], atol=1e-3)
        whole += int(there.sum())
    assert matched > 200 and whole > 1000


def test_the_driver_understands_the_end_of_their_recording(their_server):
    uri, _ = their_server(loop=False, rows=60)
    with open_device(parse_source(uri)) as source:
        items = items_until(
            source, lambda items: isinstance(items[-1], SourceNote) and "no data" in items[-1].text
        )
    assert len(frames_of(items)) > 50


@pytest.mark.parametrize("missing", ["ff", "zeros"])
def test_their_client_streams_from_the_simulator(tmp_path, missing):
    positions = np.zeros((400, 3, 3))
    positions[:, :, 0] = [10.0, 20.0, 30.0]
    take = Recording(("tip", "mid", "back"), positions, np.arange(400) / 400.0, 400.0, "made")
    played = write_recording(take, Path(tmp_path) / "played.csv")
    main = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"
    simulator = subprocess.Popen(
        [sys.executable, "-c", main, "simulate", "device", "rtc3d", "--from", str(played), "--port", "0",
         "--missing", missing, "--faults", "dead=mid"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    client = None
    try:
        port = simulator.stdout.readline().strip().rpartition(":")[2]
        client = outside(CLIENT, "127.0.0.1", port)
        _, said = client.communicate(timeout=20)
        heard = json.loads(said.splitlines()[-1])
    finally:
        for process in (simulator, client):
            if process is not None:
                process.kill()
                process.communicate()
    assert "1.0" in heard["said"]
    assert "<Label>tip</Label>" in heard["parameters"]
    assert heard["one"] == 3
    numbers = [number for number, _, _ in heard["frames"]]
    assert len(numbers) > 100
    assert set(np.diff(numbers)) == {4}  # it asks for 100 of 400 frames a second
    for number, time_us, coils in heard["frames"]:
        assert time_us == number * 2500
        assert [coils[0][0], coils[2][0]] == ["10.0", "30.0"]
        assert coils[1] == (["nan"] * 3 if missing == "ff" else ["0.0"] * 3)
