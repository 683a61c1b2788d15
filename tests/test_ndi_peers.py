"""The simulated NDI device as a process, driven by software that nobody here wrote: `ndicapi` (the C client of
the Plus toolkit, imported as `ndicapy`), scikit-surgerynditracker, and plain pyserial."""

from __future__ import annotations

import importlib.util
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers.devices.ndi import command, parse_reply
from tonguetrack.drivers.devices.ndi_tracking import parse_bx
from tonguetrack.drivers.frames import Recording
from tonguetrack.drivers.simulators.faults import FaultPlan
from tonguetrack.drivers.simulators.motion import SimulatedMotion
from tonguetrack.drivers.simulators.ndi_sim import run_ndi

RECORDING = str(Path(__file__).resolve().parents[1] / "recordings" / "demo.csv")
FRAMES = 400
WAIT_S = 30.0


def position(frame: int, coil: int) -> list[float]:
    """Where the simulated coil is in frame 1, 2, ...; coil 2 is missing in every frame."""
    if coil == 2:
        return [float("nan")] * 3
    index = (frame - 1) % FRAMES
    return [index / 4 - 50, 10.0 * coil, -index / 8 - 0.5]


DEVICE = """
import json, sys
import numpy as np
from tonguetrack.drivers.frames import Recording
from tonguetrack.drivers.simulators.faults import parse_faults
from tonguetrack.drivers.simulators.motion import SimulatedMotion
from tonguetrack.drivers.simulators.ndi_sim import run_ndi

options = json.loads(sys.argv[1])
positions = np.array(json.load(sys.stdin), dtype=float)
coils = tuple(f"coil{n}" for n in range(positions.shape[1]))
recording = Recording(coils, positions, np.arange(len(positions)) / 40.0, 40.0, "test")
run_ndi(
    SimulatedMotion(recording), parse_faults(options.pop("faults", ""), coils), host="127.0.0.1", port=0,
    announce=lambda uri: print(uri, flush=True), seconds=60.0,
    log=lambda data: print(data.decode("latin-1"), file=sys.stderr, end="", flush=True), **options,
)
"""


class Simulator:
    """uri, and the place in it; `commands` ends the process and gives the names of what it was asked."""

    def __init__(self, process: subprocess.Popen[str], uri: str) -> None:
        self.process = process
        self.uri = uri
        self.place = uri.partition("://")[2]
        self._end: tuple[int, str] | None = None

    def stop(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        if self._end is None:
            self.process.send_signal(number)
            _, said = self.process.communicate(timeout=WAIT_S)
            self._end = self.process.returncode, said
        return self._end

    def commands(self) -> list[str]:
        lines = self.stop()[1].replace("\r", "\n").split("\n")
        return [line.replace(" ", ":").partition(":")[0] for line in lines if line]


@contextmanager
def simulator(transport: str, coils: int = 4, **options: Any) -> Iterator[Simulator]:
    if transport == "pty" and sys.platform != "linux":
        pytest.skip("what clients flush shows in a pseudo-terminal's packet mode on Linux")
    options = {"transport": transport, "reset_s": 0.02} | options
    process = subprocess.Popen(
        [sys.executable, "-c", DEVICE, json.dumps(options)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdin is not None and process.stdout is not None
        json.dump([[position(k, c) for c in range(coils)] for k in range(1, FRAMES + 1)], process.stdin)
        process.stdin.close()
        process.stdin = None
        assert select.select([process.stdout], [], [], WAIT_S)[0], "the simulator says nothing"
        running = Simulator(process, process.stdout.readline().strip())
        yield running
        running.stop()
    finally:
        process.kill()
        process.wait(WAIT_S)


def client(script: str, *arguments: str) -> Any:
    """Runs a client as a process of its own; what it prints last is JSON."""
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments],
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.strip().split("\n")[-1])


def needs(module: str) -> None:
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed; it is part of the extra `dev`")


def check_positions(found: dict[str, Any], atol: float) -> None:
    """found: handle -> [frame counter, transform of eight or "MISSING"]."""
    assert sorted(found) == ["10", "11", "12", "13"]
    for handle, (count, transform) in found.items():
        coil = int(handle) - 10
        assert count > 0
        assert count % 8 == 0
        if coil == 2:
            assert transform == "MISSING"
        else:
            np.testing.assert_allclose(transform[:4], [0.5**0.5, 0.5**0.5, 0, 0], atol=1e-4)
            np.testing.assert_allclose(transform[4:7], position(count // 8, coil), atol=atol)


# --- ndicapi --------------------------------------------------------------------------------------------------

NDICAPY = """
import json, sys, time
import ndicapy as ndi

kind, place = sys.argv[1:]
report = {}
if kind == "pty":
    report["probe"] = ndi.ndiProbe(place)
    device = ndi.ndiOpen(place)
else:
    host, _, port = place.rpartition(":")
    device = ndi.ndiOpenNetwork(host, int(port))

def ask(text):
    try:
        return ndi.ndiCommand(device, text)
    except UnicodeDecodeError:
        return ""  # it makes a str of BX replies too, but has parsed them before

if kind == "pty":
    report["reset"] = ndi.ndiRESET(device)
report["init"] = ask("INIT:")
if kind == "pty":
    report["comm"] = ask("COMM:50000")
report["ver"] = ask("VER:4")
report["beep"] = ask("BEEP:1")
waiting = []
while True:
    ask("PHSR:02")
    handles = [ndi.ndiGetPHSRHandle(device, i) for i in range(ndi.ndiGetPHSRNumberOfHandles(device))]
    if not handles:
        break
    waiting.append(handles)
    for handle in handles:
        ask("PINIT:%02X" % handle)
report["waiting"] = waiting
ask("PHSR:03")
handles = [ndi.ndiGetPHSRHandle(device, i) for i in range(ndi.ndiGetPHSRNumberOfHandles(device))]
for handle in handles:
    ask("PENA:%02XD" % handle)
report["phinf"] = {}
for handle in handles:
    report["phinf"][handle] = ask("PHINF:%02X0025" % handle)
report["tstart"] = ask("TSTART:")
time.sleep(0.1)
ask("TX:0001")
report["tx"] = {h: [ndi.ndiGetTXFrame(device, bytes([h])), ndi.ndiGetTXTransform(device, bytes([h]))] for h in handles}
ask("BX:0801")
report["bx"] = {h: [ndi.ndiGetBXFrame(device, bytes([h])), ndi.ndiGetBXTransform(device, bytes([h]))] for h in handles}
ask("GX:0001")
report["gx"] = [ndi.ndiGetGXTransform(device, b"%d" % n) for n in (1, 2, 3)]
try:
    ask("NONSENSE:")
except OSError as reason:
    report["error"] = [ndi.ndiGetError(device), str(reason)]
report["tstop"] = ask("TSTOP:")
try:
    ask("TX:0001")
except OSError as reason:
    report["wrong mode"] = ndi.ndiGetError(device)
if kind == "pty":
    report["reset again"] = ndi.ndiRESET(device)
    ndi.ndiClose(device)
else:
    ndi.ndiCloseNetwork(device)
print(json.dumps(report))
"""


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_the_c_client_of_the_plus_toolkit_goes_from_init_to_bx_and_reads_the_motion(kind: str) -> None:
    needs("ndicapy")
    with simulator(kind) as device:
        report = client(NDICAPY, kind, device.place)
        commands = device.commands()
    if kind == "pty":
        assert report["probe"] == 0
        assert report["reset"] == report["reset again"] == "RESET"
        assert report["comm"] == "OKAY"
    assert report["init"] == report["tstart"] == report["tstop"] == "OKAY"
    assert "Freeze Tag: AURORA" in report["ver"]
    assert report["beep"] == "1"
    assert report["waiting"] == [[0x0A, 0x0C]]
    serials = [text[23:31] for text in report["phinf"].values()]
    assert serials[0] == serials[1] != serials[2] == serials[3]
    assert [text[31:33] for text in report["phinf"].values()] == 4 * ["3F"]
    check_positions(report["tx"], atol=0.006)
    check_positions(report["bx"], atol=1e-4)
    assert report["gx"][2] == "MISSING"
    assert len(report["gx"][0]) == 8
    assert report["error"][0] == 0x01
    assert "Invalid command" in report["error"][1]
    assert report["wrong mode"] == 0x0C
    expected = {"INIT", "VER", "BEEP", "PHSR", "PINIT", "PENA", "PHINF", "TSTART", "TX", "BX", "GX", "TSTOP"}
    if kind == "pty":
        expected |= {"COMM", "GETINFO"}
    assert set(commands) == expected | {"NONSENSE"}


# --- scikit-surgerynditracker ---------------------------------------------------------------------------------

SURGERY = """
import json, sys
from sksurgerynditracker.nditracker import NDITracker

tracker = NDITracker({"tracker type": "aurora", "serial port": sys.argv[1], "use quaternions": True})
names = tracker.get_tool_descriptions()
tracker.start_tracking()
frames = []
while len(frames) < 3:
    handles, stamps, counts, poses, quality = tracker.get_frame()
    if counts[0] and (not frames or counts != frames[-1][1]):
        frames.append([handles, counts, [pose[0].tolist() for pose in poses], quality])
tracker.stop_tracking()
tracker.close()
print(json.dumps({"tools": names[0], "frames": frames}))
"""


def test_scikit_surgerynditracker_tracks_over_the_pseudo_terminal() -> None:
    needs("sksurgerynditracker")
    with simulator("pty", coils=2) as device:
        report = client(SURGERY, device.place)
        commands = device.commands()
    assert report["tools"] == [0x0A, 0x0B]
    for handles, counts, poses, _ in report["frames"]:
        assert handles == [0x0A, 0x0B]
        for coil, (count, pose) in enumerate(zip(counts, poses, strict=True)):
            np.testing.assert_allclose(pose[4:], position(count // 8, coil), atol=1e-4)
    assert commands.count("TSTART") == commands.count("TSTOP") == 1
    assert commands.count("BX") >= 3
    assert "TX" not in commands


SURGERY_POLARIS = """
import json, sys
from sksurgerynditracker.nditracker import NDITracker

tracker = NDITracker({"tracker type": "polaris", "serial port": sys.argv[1], "romfiles": [sys.argv[2]]})
tracker.start_tracking()
handles, stamps, counts, poses, quality = tracker.get_frame()
tracker.stop_tracking()
tracker.close()
print(json.dumps({"handles": handles, "quality": quality}))
"""


def test_scikit_surgerynditracker_loads_a_tool_that_is_never_seen(tmp_path: Path) -> None:
    needs("sksurgerynditracker")
    tool = tmp_path / "tool.rom"
    tool.write_bytes(bytes(752))
    with simulator("pty", coils=2, model="polaris") as device:
        report = client(SURGERY_POLARIS, device.place, str(tool))
        commands = device.commands()
    assert report["handles"] == [0x0A + 2]
    assert np.isnan(report["quality"]).all()
    assert commands.count("PVWR") == 16


# --- pyserial -------------------------------------------------------------------------------------------------


def exchange(port: Any, data: bytes, wait_s: float = 10.0) -> bytes:
    """Sends bytes and reads up to a carriage return."""
    port.write(data)
    port.timeout = wait_s
    return bytes(port.read_until(b"\r"))


def open_port(device: Simulator) -> Any:
    serial = pytest.importorskip("serial")
    url = f"rfc2217://{device.place}" if "rfc2217" in device.uri else device.place
    port = serial.serial_for_url(url, baudrate=9600, timeout=10.0)
    return port


@pytest.mark.parametrize("transport", ["pty", "rfc2217"])
def test_at_the_wrong_speed_nothing_is_understood_and_nothing_answered(transport: str) -> None:
    with simulator(transport) as device, open_port(device) as port:
        assert exchange(port, command("INIT")) == b"OKAYA896\r"
        assert exchange(port, command("COMM", "50000")) == b"OKAYA896\r"
        assert exchange(port, command("INIT"), 0.2) == b""
        port.baudrate = 57600
        assert exchange(port, command("INIT"), 0.2) == b""
        port.baudrate = 115200
        assert exchange(port, command("INIT")) == b"OKAYA896\r"
        assert device.commands() == ["INIT", "COMM", "INIT"]


@pytest.mark.parametrize("transport", ["pty", "rfc2217"])
def test_a_break_brings_the_device_back_to_9600_baud(transport: str) -> None:
    with simulator(transport) as device, open_port(device) as port:
        assert exchange(port, command("INIT") + command("COMM", "50000")) == b"OKAYA896\r"
        assert port.read_until(b"\r") == b"OKAYA896\r"
        port.baudrate = 9600
        port.reset_output_buffer()
        port.reset_input_buffer()
        port.break_condition = True
        port.break_condition = False
        assert port.read_until(b"\r") == b"RESETBE6F\r"
        assert parse_reply(exchange(port, command("INIT"))) == "OKAY"
        assert parse_reply(exchange(port, command("PHSR", "00"))) == "020A0010C001"


@pytest.mark.parametrize("transport", ["pty", "rfc2217"])
def test_binary_replies_cross_a_serial_line_whole(transport: str) -> None:
    with simulator(transport) as device, open_port(device) as port:
        exchange(port, command("INIT"))
        exchange(port, command("COMM", "60000"))
        port.baudrate = 921600
        for name, handles in (("PINIT", ("0A", "0C")), ("PENA", ("0AD", "0BD", "0CD", "0DD"))):
            for handle in handles:
                assert parse_reply(exchange(port, command(name, handle))) == "OKAY"
        assert parse_reply(exchange(port, command("TSTART"))) == "OKAY"
        numbers: set[int] = set()
        while len(numbers) < 5:
            port.write(command("BX", "0801"))
            head = port.read(6)
            reply = parse_bx(head + port.read(int.from_bytes(head[2:4], "little") + 2), 0x0801)
            for coil, tool in enumerate(reply.tools):
                if tool.frame_number and coil != 2:
                    numbers.add(tool.frame_number)
                    expected = position(tool.frame_number // 8, coil)
                    np.testing.assert_allclose(tool.position, expected, atol=1e-4)


def test_a_client_may_go_and_another_come_and_finds_the_device_as_it_was() -> None:
    with simulator("pty") as device:
        with open_port(device) as port:
            exchange(port, command("INIT"))
            exchange(port, command("PINIT", "0A"))
        with open_port(device) as port:
            assert parse_reply(exchange(port, command("PHSR", "03"))) == "020A01F0B01F"


def test_a_serial_device_that_fails_is_silent_until_it_is_initialised_again() -> None:
    with simulator("rfc2217", faults="disconnect@0.1") as device, open_port(device) as port:
        exchange(port, command("INIT"))
        exchange(port, command("TSTART"))
        while exchange(port, command("TX", "0801"), 0.3):
            pass
        assert exchange(port, command("VER", "0"), 0.2) == b""
        assert exchange(port, command("INIT")) == b"OKAYA896\r"


def test_clients_that_go_at_once_or_talk_nonsense_do_not_end_the_simulator() -> None:
    with simulator("rfc2217") as device:
        address = ("127.0.0.1", int(device.place.rpartition(":")[2]))
        for nonsense in (b"", b"\xff\xf0", b"\xff\xfa" + 5000 * b",", b"\xff\xfa,\x01\x00\xff\xf0"):
            with socket.create_connection(address, WAIT_S) as connection:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                connection.sendall(nonsense)
        with open_port(device) as port:
            assert exchange(port, command("INIT")) == b"OKAYA896\r"


def test_what_cannot_be_simulated_is_said_in_one_sentence() -> None:
    coils = tuple(f"coil{number}" for number in range(65))
    motion = SimulatedMotion(Recording(coils, np.zeros((1, 65, 3)), np.zeros(1), 40.0, "test"))
    few = SimulatedMotion(Recording(coils[:2], np.zeros((1, 2, 3)), np.zeros(1), 40.0, "test"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for asked, transport, words in (
            (motion, "tcp", "65 coils"),
            (few, "tcp", "choose another port"),
            (few, "usb", "tcp, pty, rfc2217"),
        ):
            with pytest.raises(InputError, match=words):
                run_ndi(
                    asked, FaultPlan(), transport=transport, host="127.0.0.1", port=port, announce=pytest.fail
                )


def test_the_command_line_starts_a_device_on_a_pseudo_terminal() -> None:
    if sys.platform != "linux":
        pytest.skip("pseudo-terminals are simulated ports on Linux alone")
    serial = pytest.importorskip("serial")
    program = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())"
    command_line = [sys.executable, "-c", program, "simulate", "device", "ndi", "--from", RECORDING, "--pty"]
    with subprocess.Popen(command_line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert select.select([process.stdout], [], [], WAIT_S)[0], "the command says nothing"
            uri = process.stdout.readline().strip()
            assert uri.startswith("ndi:///dev/")
            with serial.serial_for_url(uri.removeprefix("ndi://"), baudrate=9600, timeout=10.0) as port:
                assert exchange(port, command("INIT")) == b"OKAYA896\r"
                assert parse_reply(exchange(port, command("PHSR", "02"))) == "020A0010C001"
            process.terminate()
            assert process.wait(WAIT_S) == 0
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("transport", "number"), [("tcp", signal.SIGINT), ("pty", signal.SIGTERM), ("rfc2217", signal.SIGTERM)]
)
def test_a_signal_ends_the_simulator_cleanly(transport: str, number: int) -> None:
    with simulator(transport) as device:
        code, said = device.stop(number)
    assert (code, said) == (0, "")
    if transport == "pty":
        assert not os.path.exists(device.place)
