"""`tonguetrack devices`: the kinds of sources, and the serial ports that are there."""

from __future__ import annotations

import argparse
import json
from typing import Any


def add_commands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register `devices`."""
    devices = subparsers.add_parser(
        "devices",
        help="list what can be tracked from: kinds of sources with their options, and serial ports",
        description="Lists the kinds of sources, how their addresses are written, and the serial ports of this machine.",
    )
    devices.add_argument("--json", action="store_true", help="print the list as JSON")
    devices.set_defaults(run=run_devices)


def run_devices(args: argparse.Namespace) -> int:
    """Print both lists."""
    from dataclasses import asdict

    from ..doctor import serial_ports

    kinds, ports = _kinds(), serial_ports()
    if args.json:
        print(json.dumps({"sources": kinds, "serial_ports": [asdict(port) for port in ports]}, indent=2))
        return 0
    for kind in kinds:
        print(f"{kind['form']}  {kind['words']}")
        if kind["experimental"]:
            print("    EXPERIMENTAL: written from its description, never tried with the real device")
        if kind["install"]:
            print(f"    needs the optional part {kind['extra']}; {kind['install']}")
        for name, words in kind["options"].items():
            print(f"    ?{name}=  {words}")
    print()
    print("serial ports:" if ports else "serial ports: none")
    for port in ports:
        print(f"    {port.device}  {port.description}; {'may' if port.may_open else 'may NOT'} be opened")
        if port.advice:
            print(f"        -> {port.advice}")
    return 0


def _kinds() -> list[dict[str, Any]]:
    """The table of sources as plain values. install: what to do for a part that is missing, else empty."""
    from ...drivers.sources import KINDS
    from ..doctor import install_advice, missing_packages

    return [
        {
            "scheme": kind.scheme,
            "form": kind.forms,
            "words": kind.words,
            "options": dict(kind.options),
            "port": kind.port or None,
            "experimental": kind.experimental,
            "extra": kind.extra or None,
            "install": install_advice(kind.extra) if kind.extra and missing_packages(kind.extra) else "",
        }
        for kind in KINDS
    ]
