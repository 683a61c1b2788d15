"""What the doctor finds, on machines of all kinds, and that it never fails itself."""

import collections
import errno
import json
import os
import re
import socket
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from tonguetrack.tracker import doctor, kernelcache
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.doctor import Finding, examine
from tonguetrack.tracker.streams.control_osc import DEFAULT_CONTROL
from tonguetrack.tracker.streams.osc import DEFAULT_DESTINATION

PROJECT = tomllib.loads((Path(__file__).resolve().parents[1] / "pyproject.toml").read_text())["project"]


def found_by(check, what=""):
    """The only row of a check, or the one whose name begins with `what`."""
    rows = [row for row in check() if row.what.startswith(what)]
    assert len(rows) == 1, rows
    return rows[0]


def names_of(requirements):
    return tuple(re.match(r"[A-Za-z0-9-]+", requirement).group().lower() for requirement in requirements)


def with_checks(monkeypatch, *checks):
    monkeypatch.setattr(doctor, "CHECKS", checks)


# The command ------------------------------------------------------------------------------------------


def test_the_doctor_runs_as_installed_and_every_row_is_whole():
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main())"]
        + ["doctor", "--json"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    rows = json.loads(done.stdout)
    assert done.returncode == any(row["state"] == "problem" for row in rows)
    assert done.stderr == ""
    assert {"Python", "packages", "solver", "clock", "sleep", "CPUs", "OpenGL", "space for takes"} <= {
        row["what"] for row in rows
    }
    for row in rows:
        assert row["state"] in ("ok", "note", "problem")
        assert row["found"]
        assert "could not be found out" not in row["found"]
        assert row["advice"] or row["state"] != "problem"


def test_a_problem_is_exit_code_1_and_a_note_is_not(monkeypatch, capsys):
    with_checks(monkeypatch, lambda: [Finding("a", "ok", "fine"), Finding("bb", "note", "hm", "do this")])
    assert main(["doctor"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "ok       a   fine",
        "note     bb  hm",
        "             -> do this",
        "no problems, 1 note",
    ]
    with_checks(monkeypatch, lambda: [Finding("a", "problem", "broken", "mend it")])
    assert main(["doctor", "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == [
        {"what": "a", "state": "problem", "found": "broken", "advice": "mend it"}
    ]


def test_a_check_that_fails_is_a_note_and_hides_no_other(monkeypatch):
    def _broken_check():
        yield Finding("first half", "ok", "fine")
        raise RuntimeError("on purpose")

    with_checks(monkeypatch, _broken_check, lambda: [Finding("other", "ok", "fine")])
    assert examine() == [
        Finding("first half", "ok", "fine"),
        Finding("broken check", "note", "this could not be found out (RuntimeError: on purpose)"),
        Finding("other", "ok", "fine"),
    ]


def test_the_doctor_asks_for_what_the_package_asks_for():
    assert names_of(PROJECT["dependencies"]) == doctor.REQUIRED
    for extra, (names, _) in doctor.EXTRAS.items():
        assert names_of(PROJECT["optional-dependencies"][extra]) == names


def test_the_doctor_looks_at_the_ports_that_are_used():
    assert DEFAULT_DESTINATION == f"127.0.0.1:{doctor.STREAM_PORT}"
    assert DEFAULT_CONTROL == f"127.0.0.1:{doctor.CONTROL_PORT}"


# Python, packages, solver -----------------------------------------------------------------------------


def test_an_old_python_is_a_problem(monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 10, 0))
    assert found_by(doctor._python).state == "problem"


def test_a_missing_package_is_a_problem_that_is_named(monkeypatch):
    monkeypatch.setattr(doctor, "REQUIRED", ("numpy", "no-such-package"))
    row = found_by(doctor._packages)
    assert (row.state, row.found) == ("problem", "missing: no-such-package")


def test_a_numba_that_does_not_load_is_a_problem(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    assert found_by(doctor._solver).state == "problem"


def test_the_cache_is_ready_when_it_holds_kernels_of_the_present_source(tmp_path, monkeypatch):
    monkeypatch.setenv(kernelcache.VARIABLE, str(tmp_path))
    assert "the first start compiles" in found_by(doctor._solver).found
    index = tmp_path / "tracker_0123" / "kernels.solve-1.py311.nbi"
    index.parent.mkdir()
    index.touch()
    os.utime(index, (1, 1))  # compiled long before the source was last changed
    assert "the first start compiles" in found_by(doctor._solver).found
    index.touch()
    later = ", ".join(what for name, what in kernelcache.KERNEL_MODULES.items() if name != "tracker.kernels")
    assert (
        found_by(doctor._solver).found == f"compiled and kept in {tmp_path}; at its first use, too: {later}"
    )
    for name in kernelcache.KERNEL_MODULES:
        folder, module = name.split(".")[-2:]
        (tmp_path / f"{folder}_0123").mkdir(exist_ok=True)
        (tmp_path / f"{folder}_0123" / f"{module}.some-1.py311.nbi").touch()
    assert found_by(doctor._solver) == Finding("solver", "ok", f"compiled and kept in {tmp_path}")


def test_a_cache_that_cannot_be_kept_is_a_note_with_the_way_out(monkeypatch):
    monkeypatch.delenv(kernelcache.VARIABLE, raising=False)
    monkeypatch.setattr(kernelcache, "_can_be_made", lambda folder: False)
    row = found_by(doctor._solver)
    assert row.state == "note"
    assert "NUMBA_CACHE_DIR" in row.advice


# Clock and processors ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("late_ms", "state"), [(0.1, "ok"), (5.0, "note")])
def test_late_wake_ups_are_a_note(monkeypatch, late_ms, state):
    clock = SimpleNamespace(now_s=0.0)

    def sleep(seconds):
        clock.now_s += seconds + late_ms * 1e-3

    monkeypatch.setattr(
        doctor,
        "time",
        SimpleNamespace(
            sleep=sleep,
            perf_counter=lambda: clock.now_s,
            get_clock_info=lambda name: SimpleNamespace(resolution=1e-9),
        ),
    )
    row = found_by(doctor._clock, "sleep")
    assert row.state == state
    assert f"p50 {late_ms:.2f} ms, p99 {late_ms:.2f} ms" in row.found


def test_a_single_processor_is_a_note(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    assert found_by(doctor._processors).state == "note"


# Ports ------------------------------------------------------------------------------------------------


@pytest.fixture(params=[socket.SOCK_DGRAM, socket.SOCK_STREAM])
def taken(request):
    with socket.socket(socket.AF_INET, request.param) as opened:
        opened.bind(("127.0.0.1", 0))
        if request.param == socket.SOCK_STREAM:
            opened.listen()
        yield request.param, opened.getsockname()[1]


def test_a_taken_port_has_a_holder_and_a_free_one_has_none(taken):
    kind, port = taken
    holder = doctor._holder(kind, port)
    if sys.platform == "linux":
        assert holder.endswith(f"(process {os.getpid()})")
    else:
        assert holder
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        free = probe.getsockname()[1]
    assert doctor._holder(kind, free) is None


def test_a_port_that_this_user_may_not_have_says_so(monkeypatch):
    class Forbidden(socket.socket):
        def bind(self, place):
            raise OSError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket, "socket", Forbidden)
    assert "cannot be used (Permission denied)" in doctor._holder(socket.SOCK_DGRAM, 9001)


def test_a_taken_port_of_ours_is_a_note_and_one_where_others_listen_is_as_it_should_be(monkeypatch):
    monkeypatch.setattr(doctor, "_holder", lambda kind, port: "blender (process 7)")
    assert found_by(doctor._ports, "UDP 9001") == Finding(
        "UDP 9001 (OSC control)", "note", "taken by blender (process 7)", "end it, or give another --control"
    )
    assert found_by(doctor._ports, "UDP 1234").state == "note"
    assert found_by(doctor._ports, "UDP 9000").found == "blender (process 7) receives on this machine"
    assert found_by(doctor._ports, "TCP 3030 ").state == "ok"


# Serial ports -----------------------------------------------------------------------------------------


@pytest.fixture
def plugged_in(monkeypatch):
    """Serial ports that this user may not open."""
    from serial.tools import list_ports
    from serial.tools.list_ports_common import ListPortInfo

    def plug(device, description, vid):
        port = ListPortInfo(device)
        port.description, port.vid = description, vid
        monkeypatch.setattr(list_ports, "comports", lambda: [port])
        monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)

    return plug


@pytest.mark.skipif(os.name != "posix", reason="permissions of device files")
def test_a_usb_port_without_permission_is_a_problem_with_the_devices_own_group(plugged_in, monkeypatch):
    import grp

    Group = collections.namedtuple("Group", "gr_name gr_gid gr_mem")
    monkeypatch.setattr(grp, "getgrgid", lambda number: Group("dialout", 20, []))
    plugged_in(os.devnull, "NDI Aurora\x1b[2J", 0x1234)
    row = found_by(doctor._serial_ports_found)
    assert row.state == "problem"
    assert row.found == "NDI Aurora[2J; may not be opened"
    assert re.fullmatch(r"sudo usermod -aG dialout \S+, then log out and in again", row.advice)


@pytest.mark.skipif(os.name != "posix", reason="permissions of device files")
def test_a_new_member_of_the_group_is_told_to_log_in_again(plugged_in, monkeypatch):
    import grp
    import pwd

    Group = collections.namedtuple("Group", "gr_name gr_gid gr_mem")
    user = pwd.getpwuid(os.getuid()).pw_name
    monkeypatch.setattr(grp, "getgrgid", lambda number: Group("dialout", 999_999, [user]))
    plugged_in(os.devnull, "n/a", 0x1234)
    assert "log out and in again: you have become a member" in found_by(doctor._serial_ports_found).advice


@pytest.mark.skipif(os.name != "posix", reason="permissions of device files")
def test_a_port_on_the_main_board_without_permission_is_a_note(plugged_in):
    plugged_in("/dev/no-such-port", None, None)
    row = found_by(doctor._serial_ports_found)
    assert (row.state, row.found) == ("note", "no description; may not be opened")
    assert row.advice.endswith("the right to read and write /dev/no-such-port")


# The rest ---------------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="the system brings OpenGL")
def test_missing_graphics_are_a_note_with_the_package_and_what_it_is_for(monkeypatch):
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: None)
    row = found_by(doctor._graphics)
    assert row.state == "note"
    assert row.advice == (
        "for the viewer, which is not part of this version: sudo apt-get install libegl1 libgl1"
    )


@pytest.mark.parametrize(
    ("free", "state"), [(100e9, "ok"), (1e9, "note"), (1e6, "problem")]
)  # fmt: skip
def test_a_disk_that_fills_up_is_told(monkeypatch, free, state):
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda place: SimpleNamespace(free=int(free)))
    assert found_by(doctor._space).state == state


def test_a_missing_optional_part_comes_with_its_command(monkeypatch):
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    row = found_by(doctor._optional_parts, "optional part lab")
    assert row.state == "note"
    assert row.found.startswith("without pylsl, pyxdf")
    assert row.advice.endswith("-m pip install '.[lab]'")
