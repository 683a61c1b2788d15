"""demo, monitor and bench as a user meets them: real processes, real sockets, Ctrl-C, exit codes."""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tonguetrack import InputError
from tonguetrack.drivers import write_recording
from tonguetrack.model import save_model
from tonguetrack.tracker import bundled
from tonguetrack.tracker.bench import made_up_recording
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.session import session_toml
from tonguetrack.tracker.setup import complete_setup

# The command line with another recording and another model in the place of the bundled ones.
WITH_FILES = """
import sys
from pathlib import Path
from tonguetrack.drivers import open_recording
from tonguetrack.model import load_model
from tonguetrack.tracker import bundled
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.session import load_session
folder = Path(sys.argv[1])
bundled.bundled_model = lambda: load_model(folder / "model.npz")
bundled.bundled_recording = lambda: (open_recording(folder / "demo.csv"), load_session(folder / "demo.toml"))
sys.exit(main(sys.argv[2:]))
"""
ROLES = ("tongue_tip", "tongue_blade", "tongue_dorsum")


@pytest.fixture(scope="module")
def folder(small_model, tmp_path_factory):
    """A model, two seconds of recording and its session, like those that are bundled."""
    folder = tmp_path_factory.mktemp("bundled")
    recording, setup = made_up_recording(small_model, 500, 250.0)
    recording = replace(
        recording, coils=ROLES, positions=np.ascontiguousarray(recording.positions[:, : len(ROLES)])
    )
    session = replace(
        setup.session,
        coils={role: role for role in ROLES},
        correspondences=dict(zip(ROLES, setup.vertices, strict=False)),
    )
    named = replace(small_model, provenance={"name": "a synthetic test model"})
    save_model(named, folder / "model.npz")
    write_recording(recording, folder / "demo.csv")
    (folder / "demo.toml").write_text(session_toml(complete_setup(recording, named, session).session))
    return folder


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**20)
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(30.0)
        yield opened


def address_of(opened):
    return f"127.0.0.1:{opened.getsockname()[1]}"


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def demo(folder, *arguments):
    return started("-c", WITH_FILES, str(folder), "demo", *arguments)


def ended(process, seconds=60):
    """Exit code, stdout, stderr."""
    try:
        out, err = process.communicate(timeout=seconds)
    finally:
        process.kill()
    return process.returncode, out, err


# demo -----------------------------------------------------------------------------------------------


def test_the_demo_streams_its_recording_once_and_ends_with_a_summary(folder, receiver):
    code, out, err = ended(demo(folder, "--fast", "--osc", address_of(receiver)))
    assert code == 0, err
    assert "synthetic" in err.splitlines()[0]
    assert "frames           500 in" in out
    assert f"500 to osc {address_of(receiver)}, 0 dropped" in out
    assert receiver.recv(2048).startswith(b"#bundle\0")


def test_the_demos_summary_as_json(folder, receiver):
    code, out, err = ended(demo(folder, "--json", "--fast", "--seconds", "5", "--osc", address_of(receiver)))
    summary = json.loads(out)
    assert code == 0, err
    assert summary["frames"] == 1250  # two and a half times through
    assert summary["model"] == "a synthetic test model"
    assert summary["speaker_fixed"]
    assert summary["coils"] == dict.fromkeys(ROLES, 1.0)
    assert summary["lateness_ms"] is None
    assert set(summary["arrival_to_sent_ms"]) == {"p50", "p99", "max", "count"}


def test_the_demo_needs_no_receiver(folder):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        address = address_of(gone)
    code, out, err = ended(demo(folder, "--json", "--seconds", "0.4", "--osc", address))
    assert code == 0, err
    assert json.loads(out)["sinks"] == [{"destination": f"osc {address}", "sent": 100, "dropped": 0}]
    assert json.loads(out)["lateness_ms"]["count"] == 100


@pytest.mark.skipif(os.name != "posix", reason="SIGINT to another process")
def test_ctrl_c_ends_the_demo_with_its_summary(folder, receiver):
    process = demo(folder, "--json", "--seconds", "1000", "--osc", address_of(receiver))
    while b"/tongue/frame" not in receiver.recv(2048):
        pass
    process.send_signal(signal.SIGINT)
    code, out, err = ended(process)
    assert code == 0, err
    assert 0 < json.loads(out)["frames"] < 250_000
    assert "Traceback" not in err


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_on_a_terminal_the_status_is_one_line_that_is_cleared(folder, receiver):
    import pty

    ours, theirs = pty.openpty()
    command = [
        sys.executable,
        "-c",
        WITH_FILES,
        str(folder),
        "demo",
        "--seconds",
        "1.5",
        "--osc",
        address_of(receiver),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=theirs, text=True)
    os.close(theirs)
    seen = b""
    try:
        while True:
            piece = os.read(ours, 4096)
            if not piece:
                break
            seen += piece
    except OSError:  # the other end is closed
        pass
    finally:
        os.close(ours)
    code, out, _ = ended(process)
    assert code == 0
    assert "frames           375" in out
    lines = seen.decode().split("\r")
    shown = [line for line in lines if " Hz " in line]
    assert shown
    assert all("3/3 coils" in line and "0 dropped" in line and " mm " in line for line in shown)
    assert max(map(len, shown)) < 80
    assert "\n" not in "".join(shown)
    assert lines[-1] == ""


def test_the_bundled_recording_session_and_model_belong_together_and_say_synthetic():
    model = bundled.bundled_model()
    recording, session = bundled.bundled_recording()
    setup = complete_setup(recording, model, session)
    assert "synthetic" in model.name
    assert session.model_fingerprint == model.fingerprint
    assert session.speaker_weights is not None, "the demo compiles the fixed-speaker solver only"
    assert not any("estimated" in decision for decision in setup.decisions)


def test_the_demo_runs_as_installed(receiver):
    command = ("-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))")
    code, out, err = ended(started(*command, "demo", "--fast", "--json", "--osc", address_of(receiver)))
    assert code == 0, err
    summary = json.loads(out)
    assert "synthetic" in summary["model"]
    assert summary["status_shares"]["ok"] == 1.0
    assert summary["residual_mm"]["median"] < 2.0
    assert summary["gaps"] == 0


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "soon"])
def test_seconds_are_a_positive_number(text, capsys):
    with pytest.raises(SystemExit) as end:
        main(["demo", "--seconds", text])
    assert end.value.code == 2
    assert "should be a number of seconds above 0" in capsys.readouterr().err


def test_a_wrong_destination_is_one_sentence_and_exit_code_2(capsys):
    assert main(["demo", "--osc", "nonsense"]) == 2
    assert capsys.readouterr().err == ("tonguetrack: 'nonsense': expected HOST:PORT, as in 127.0.0.1:9000.\n")


def test_a_missing_bundled_file_is_an_input_error(monkeypatch):
    monkeypatch.setattr(bundled, "MODEL", ("tonguetrack.model.data", "no_such_model.npz"))
    with pytest.raises(InputError, match="no_such_model.npz"):
        bundled.bundled_model()


# monitor --------------------------------------------------------------------------------------------


def free_address():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return address_of(probe)


def test_the_monitor_shows_what_the_demo_sends(folder):
    address = free_address()
    listening = started(
        "-c", WITH_FILES, str(folder), "monitor", "--listen", address, "--json", "--seconds", "600"
    )
    assert "listening" in listening.stderr.readline()
    assert ended(demo(folder, "--seconds", "0.8", "--osc", address))[0] == 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        host, port = address.split(":")
        stranger.sendto(b"/stranger\0\0\0,\0\0\0", (host, int(port)))
        stranger.sendto(b"garbage", (host, int(port)))
        stranger.sendto(b"x" * 60_000, (host, int(port)))
        stranger.sendto(b"/last\0\0\0,\0\0\0", (host, int(port)))
    said = []
    while "/last" not in "".join(said):
        said.append(listening.stderr.readline())
    listening.send_signal(signal.SIGINT)
    code, out, err = ended(listening)
    assert code == 0, err
    heard = json.loads(out)
    (stream,) = heard["streams"]
    assert (stream["frames"], stream["lost"], stream["starts"]) == (200, 0, 1)
    assert stream["info"]["model name"] == "a synthetic test model"
    assert heard["unknown"] == {"/last": 1, "/stranger": 1}
    assert heard["malformed"] == 2
    assert "unknown address /stranger" in "".join(said)


def test_one_message_with_other_arguments_does_not_hide_the_stream(capsys):
    from tonguetrack.tracker.cli.monitor import _report
    from tonguetrack.tracker.streams.monitor import Monitor

    class Heard(Monitor):
        def hear(self, path, *values):
            self._message(path, list(values), ("127.0.0.1", 5), 0)

        def frame(self, number):
            self.hear("/tongue/frame", number, 0.1, 1)
            self.hear("/tongue/sigma", 0.5)
            self.hear("/tongue/quality", 0.8, 3, 0.1)

    monitor = Heard()
    monitor.frame(0)
    monitor.hear("/tongue/frame", 7)
    so_far = _report(monitor, 0, 0, 0)
    assert "frame 0 ok  sigma +0.50" in (told := capsys.readouterr().err)
    assert "1 messages with other arguments" in told
    monitor.frame(1)
    _report(monitor, *so_far)
    assert "frame 1 ok" in (told := capsys.readouterr().err)
    assert "other arguments" not in told


def test_a_taken_port_is_one_sentence_and_exit_code_2(receiver, capsys):
    assert main(["monitor", "--listen", address_of(receiver)]) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert "the port is in use by another program" in printed.err
    assert printed.out == ""


def test_an_address_of_another_machine_cannot_be_listened_on(capsys):
    assert main(["monitor", "--listen", "192.0.2.1:9000"]) == 2
    assert "cannot listen there" in capsys.readouterr().err


def test_the_monitor_ends_after_its_seconds_and_says_that_nothing_came(capsys):
    assert main(["monitor", "--listen", free_address(), "--seconds", "0.1"]) == 0
    assert capsys.readouterr().out.startswith("datagrams  0 (0 bytes), 0 not OSC")


def test_the_monitor_prints_the_address_table(capsys):
    assert main(["monitor", "--addresses"]) == 0
    assert "| `/tongue/pose` | `,f*K` |" in capsys.readouterr().out


# All ------------------------------------------------------------------------------------------------


def test_the_commands_load_nothing_heavy_before_they_run():
    code = (
        "import sys, tonguetrack.tracker.cli as cli; cli.build_parser().format_help();"
        "print([name for name in ('numpy', 'numba', 'scipy', 'pythonosc') if name in sys.modules])"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "[]\n"
    )


@pytest.mark.parametrize("name", ["demo", "monitor", "bench"])
def test_each_command_explains_itself(name, capsys):
    with pytest.raises(SystemExit) as end:
        main([name, "--help"])
    assert end.value.code == 0
    assert "--json" in capsys.readouterr().out


def test_bench_takes_a_model_and_prints_json(folder, monkeypatch, capsys):
    from tonguetrack.tracker import bench as module

    monkeypatch.setattr(module, "bench", lambda model, path: {"model": model.name, "path": path.name})
    assert main(["bench", "--model", str(folder / "model.npz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"model": "a synthetic test model", "path": "model.npz"}


def test_parsers_of_the_three_commands_stand_alone():
    from tonguetrack.tracker.cli import bench, demo, monitor

    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(required=True)
    for family in (demo, monitor, bench):
        family.add_commands(commands)
    assert parser.parse_args(["demo", "--fast"]).fast
    assert parser.parse_args(["monitor"]).listen == "127.0.0.1:9000"
    assert parser.parse_args(["bench"]).model is None
