"""Whether this machine is fit for live tracking, and what to do where it is not. Nothing is changed or opened."""

from __future__ import annotations

import ctypes.util
import errno
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from .. import __version__

State = Literal["ok", "note", "problem"]

OLDEST_PYTHON = (3, 11)
REQUIRED = (
    "numpy",
    "scipy",
    "numba",
    "python-osc",
    "pyserial",
    "pyyaml",
    "tomlkit",
    "trimesh",
    "rich",
    "joblib",
)
EXTRAS = {
    "lab": (("pylsl", "pyxdf"), "Lab Streaming Layer, reading XDF files of others"),
    "plot": (("matplotlib",), "pictures"),
}
SLEEPS, SLEEP_S = 100, 1e-3
LATE_SLEEP_S = 2e-3
COARSE_CLOCK_S = 1e-5
FEW_CPUS = 2
SMALL_BUFFER_BYTES = 1 << 20
LITTLE_SPACE_BYTES, NO_SPACE_BYTES = 5_000_000_000, 200_000_000
LOOPBACK = "127.0.0.1"
STREAM_PORT, CONTROL_PORT = 9000, 9001
"""Of the OSC stream's receiver, and of our own ear for control."""


@dataclass(frozen=True)
class Finding:
    """One row: what was looked at, what was found, and what to do about it ("" = nothing)."""

    what: str
    state: State
    found: str
    advice: str = ""


@dataclass(frozen=True)
class SerialPort:
    """One serial port. may_open: whether this user may read and write it; advice: what to do if not."""

    device: str
    description: str
    usb: bool
    may_open: bool
    advice: str = ""


def examine() -> list[Finding]:
    """All rows, in about two seconds. Never raises: what cannot be found out is a note."""
    findings: list[Finding] = []
    for check in CHECKS:
        try:
            findings += check()
        except Exception as reason:  # noqa: BLE001 - a check that fails must not hide the others
            name = check.__name__.removeprefix("_").replace("_", " ")
            findings.append(
                Finding(name, "note", f"this could not be found out ({type(reason).__name__}: {reason})")
            )
    return findings


def serial_ports() -> list[SerialPort]:
    """The serial ports of this machine, by name. None of them is opened: that could reset a device."""
    from serial.tools.list_ports import comports

    return [
        _serial_port(port.device, _described(port.description), port.vid is not None)
        for port in sorted(comports())
    ]


def missing_packages(extra: str) -> list[str]:
    """What an optional part of the installation lacks."""
    return [name for name in EXTRAS[extra][0] if importlib.util.find_spec(name) is None]


def install_advice(extra: str) -> str:
    """The command that adds an optional part."""
    return f"in the project's folder: {Path(sys.executable).name} -m pip install '.[{extra}]'"


# The checks -------------------------------------------------------------------------------------------


def _python() -> Iterator[Finding]:
    version = platform.python_version()
    found = f"{version} on {platform.system()} {platform.machine()}; tonguetrack {__version__}"
    if sys.version_info >= OLDEST_PYTHON:
        yield Finding("Python", "ok", found)
    else:
        yield Finding("Python", "problem", found, "install Python 3.11 or newer")


def _packages() -> Iterator[Finding]:
    there, missing = [], []
    for name in REQUIRED:
        try:
            there.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        lacking = "missing: " + ", ".join(missing)
        yield Finding("packages", "problem", lacking, f"{Path(sys.executable).name} -m pip install .")
    else:
        yield Finding("packages", "ok", ", ".join(there))


def _solver() -> Iterator[Finding]:
    from . import kernelcache

    try:
        import numba
    except (
        ImportError,
        AttributeError,
        OSError,
    ) as reason:  # numba refuses versions of numpy that it does not know
        yield Finding("solver", "problem", f"numba does not load: {reason}", "pip install --upgrade numba")
        return
    folder = kernelcache.cache_folder()
    missing = () if folder is None else kernelcache.modules_to_compile(folder)
    if folder is None or not kernelcache.cache_lasts():
        yield Finding(
            "solver",
            "note",
            f"numba {numba.__version__}; no folder to keep compiled code in, so every start compiles for some seconds",
            f"name a folder that can be written to in {kernelcache.VARIABLE}",
        )
    elif "tracker.kernels" in missing:
        yield Finding("solver", "ok", f"the first start compiles for some seconds and keeps it in {folder}")
    else:
        later = ", ".join(kernelcache.KERNEL_MODULES[name] for name in missing)
        compiled = f"compiled and kept in {folder}"
        yield Finding("solver", "ok", f"{compiled}; at its first use, too: {later}" if later else compiled)


def _clock() -> Iterator[Finding]:
    resolution_s = time.get_clock_info("perf_counter").resolution
    if resolution_s <= COARSE_CLOCK_S:
        yield Finding("clock", "ok", f"resolution {resolution_s * 1e6:g} us")
    else:
        yield Finding(
            "clock", "note", f"resolution {resolution_s * 1e6:g} us: latencies are no finer than this"
        )
    late_s = []
    for _ in range(SLEEPS):
        start_s = time.perf_counter()
        time.sleep(SLEEP_S)
        late_s.append(time.perf_counter() - start_s - SLEEP_S)
    late_s.sort()
    p50_s, p99_s = late_s[SLEEPS // 2], late_s[SLEEPS * 99 // 100]
    found = f"{SLEEP_S * 1e3:g} ms of sleep end late by p50 {p50_s * 1e3:.2f} ms, p99 {p99_s * 1e3:.2f} ms"
    if p99_s > LATE_SLEEP_S:
        advice = (
            "end other busy programs and switch power saving off; simulators and replays will be unsteady"
        )
        yield Finding("sleep", "note", found, advice)
    else:
        yield Finding("sleep", "ok", found)


def _processors() -> Iterator[Finding]:
    count = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    if count < FEW_CPUS:
        yield Finding(
            "CPUs", "note", f"{count}: tracking shares it with everything else", "give it a second one"
        )
    else:
        yield Finding("CPUs", "ok", str(count))


def _ports() -> Iterator[Finding]:
    from ..drivers.sources import KINDS

    holder = _holder(socket.SOCK_DGRAM, STREAM_PORT)
    found = f"{holder} receives on this machine" if holder else "free: nobody receives on this machine yet"
    yield Finding(f"UDP {STREAM_PORT} (OSC stream)", "ok", found)
    ours = "another --control"
    yield _port_of_ours(f"UDP {CONTROL_PORT} (OSC control)", CONTROL_PORT, ours)
    for kind in KINDS:
        if kind.scheme.startswith("udp"):
            yield _port_of_ours(f"UDP {kind.port} ({kind.scheme})", kind.port, f"{kind.scheme}://:PORT")
        elif kind.port:
            holder = _holder(socket.SOCK_STREAM, kind.port)
            found = f"{holder} listens on this machine" if holder else "no device's program on this machine"
            yield Finding(f"TCP {kind.port} ({kind.scheme})", "ok", found)


def _port_of_ours(what: str, port: int, instead: str) -> Finding:
    holder = _holder(socket.SOCK_DGRAM, port)
    if holder is None:
        return Finding(what, "ok", "free")
    return Finding(what, "note", f"taken by {holder}", f"end it, or give {instead}")


def _serial_ports_found() -> Iterator[Finding]:
    ports = serial_ports()
    if not ports:
        yield Finding("serial ports", "ok", "none", "plug the device in, if it has a serial or USB cable")
    for port in ports:
        if port.may_open:
            yield Finding(f"serial port {port.device}", "ok", f"{port.description}; may be opened")
        else:
            # Ports on the main board are there on many machines, with nothing plugged in.
            state: State = "problem" if port.usb else "note"
            found = f"{port.description}; may not be opened"
            yield Finding(f"serial port {port.device}", state, found, port.advice)


def _graphics() -> Iterator[Finding]:
    if sys.platform in ("win32", "darwin"):
        names: tuple[str, ...] = ("opengl32",) if sys.platform == "win32" else ("OpenGL",)
        has_display = "display by the system"
    else:
        names = ("EGL", "GL")
        display = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
        has_display = f"display {display}" if display else "no display"
    missing = [name for name in names if ctypes.util.find_library(name) is None]
    there = [f"lib{name}" for name in names if name not in missing]
    found = "; ".join([", ".join(there) or "no OpenGL", has_display])
    packages = {"EGL": "libegl1", "GL": "libgl1"}
    debian = " ".join(packages[name] for name in missing if name in packages)
    advice = "for the viewer, which is not part of this version: " + (
        f"sudo apt-get install {debian}" if debian else "install the graphics driver"
    )
    yield Finding("OpenGL", "note" if missing else "ok", found, advice if missing else "")


def _receive_buffer() -> Iterator[Finding]:
    if sys.platform != "linux":
        return
    largest = int(Path("/proc/sys/net/core/rmem_max").read_text())
    default = int(Path("/proc/sys/net/core/rmem_default").read_text())
    found = f"{default // 1024} KiB, at most {largest // 1024} KiB on request"
    if largest < SMALL_BUFFER_BYTES:
        advice = "for receivers that pause: sudo sysctl -w net.core.rmem_max=4194304"
        yield Finding("UDP receive buffer", "note", found, advice)
    else:
        yield Finding("UDP receive buffer", "ok", found)


def _space() -> Iterator[Finding]:
    what = "space for takes"
    free = shutil.disk_usage(".").free
    found = f"{free / 1e9:.1f} GB free in {Path.cwd()}"
    if not os.access(".", os.W_OK):
        yield Finding(what, "problem", f"{Path.cwd()} cannot be written to", "record into another folder")
    elif free < NO_SPACE_BYTES:
        yield Finding(what, "problem", found, "make room, or record into another folder")
    elif free < LITTLE_SPACE_BYTES:
        yield Finding(what, "note", found, "an hour of many coils at a high rate may need 10 GB")
    else:
        yield Finding(what, "ok", found)


def _optional_parts() -> Iterator[Finding]:
    for extra, (names, words) in EXTRAS.items():
        missing = missing_packages(extra)
        if missing:
            found = f"without {', '.join(missing)} ({words})"
            yield Finding(f"optional part {extra}", "note", found, install_advice(extra))
        else:
            versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
            yield Finding(f"optional part {extra}", "ok", versions)


CHECKS: tuple[Callable[[], Iterable[Finding]], ...] = (
    _python,
    _packages,
    _solver,
    _clock,
    _processors,
    _ports,
    _serial_ports_found,
    _graphics,
    _receive_buffer,
    _space,
    _optional_parts,
)


# Serial ports -----------------------------------------------------------------------------------------


def _described(text: str | None) -> str:
    """What the plugged-in device says of itself, without anything that a terminal would obey."""
    plain = "".join(c for c in text or "" if c.isprintable())[:80]
    return plain if plain not in ("", "n/a") else "no description"


def _serial_port(device: str, description: str, usb: bool) -> SerialPort:
    if sys.platform == "win32" or os.access(device, os.R_OK | os.W_OK):
        return SerialPort(device, description, usb, True)
    return SerialPort(device, description, usb, False, _serial_advice(device))


def _serial_advice(device: str) -> str:
    if sys.platform != "win32":
        import grp
        import pwd

        with suppress(OSError, KeyError):
            group = grp.getgrgid(os.stat(device).st_gid)
            user = pwd.getpwuid(os.getuid()).pw_name
            if user in group.gr_mem and group.gr_gid not in os.getgroups():
                return f"log out and in again: you have become a member of the group {group.gr_name} since"
            if group.gr_gid != 0:
                return f"sudo usermod -aG {group.gr_name} {user}, then log out and in again"
    return f"ask whoever looks after this machine for the right to read and write {device}"


# Ports ------------------------------------------------------------------------------------------------


def _holder(kind: socket.SocketKind, port: int) -> str | None:
    """Who has a port of this machine, in words; None = it is free."""
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM and sys.platform != "win32":
            # Connections that have just ended do not count.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as reason:
            if reason.errno != errno.EADDRINUSE:
                return f"nobody, but it cannot be used ({reason.strerror})"
            return _process_at(kind, port) or "a program"
    return None


def _process_at(kind: socket.SocketKind, port: int) -> str | None:
    """The process that has a port, as far as Linux lets this user see it."""
    table = "udp" if kind == socket.SOCK_DGRAM else "tcp"
    links = set()
    for name in (table, table + "6"):
        with suppress(OSError):
            for line in Path("/proc/net", name).read_text().splitlines()[1:]:
                words = line.split()
                if len(words) > 9 and words[1].rpartition(":")[2] == f"{port:04X}":
                    links.add(f"socket:[{words[9]}]")
    if not links:
        return None
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # somebody else's, or gone
            for descriptor in (process / "fd").iterdir():
                if os.readlink(descriptor) in links:
                    name = (process / "comm").read_text().strip()
                    return f"{name} (process {process.name})"
    return None
