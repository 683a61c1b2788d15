"""`tonguetrack devices`: what can be tracked from."""

import json
import subprocess
import sys

import pytest

from tonguetrack.drivers.sources import KINDS, parse_source
from tonguetrack.tracker import doctor
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.doctor import SerialPort

USB = SerialPort("/dev/ttyUSB7", "NDI Aurora", True, False, "sudo usermod -aG dialout me")


@pytest.fixture
def printed(monkeypatch, capsys):
    def run(*arguments, ports=(USB,)):
        monkeypatch.setattr(doctor, "serial_ports", lambda: list(ports))
        assert main(["devices", *arguments]) == 0
        return capsys.readouterr().out

    return run


def test_every_kind_is_listed_with_its_form_and_options(printed):
    lines = printed().splitlines()
    for kind in KINDS:
        assert f"{kind.forms}  {kind.words}" in lines
        for name, words in kind.options.items():
            assert f"    ?{name}=  {words}" in lines


def test_the_same_as_json(printed):
    listed = json.loads(printed("--json"))
    assert [row["scheme"] for row in listed["sources"]] == [kind.scheme for kind in KINDS]
    carstens = next(row for row in listed["sources"] if row["scheme"] == "carstens")
    assert carstens["experimental"] is True
    assert carstens["port"] == 30303
    assert listed["serial_ports"] == [
        {"device": "/dev/ttyUSB7", "description": "NDI Aurora", "usb": True, "may_open": False,
         "advice": "sudo usermod -aG dialout me"}
    ]  # fmt: skip


def test_what_was_never_tried_with_the_device_says_so(printed):
    after = printed().split("carstens://", 1)[1].splitlines()[1]
    assert "EXPERIMENTAL" in after
    assert printed().count("EXPERIMENTAL") == sum(kind.experimental for kind in KINDS)


def test_a_kind_whose_optional_part_is_missing_says_how_to_get_it(printed, monkeypatch):
    monkeypatch.setattr(doctor, "missing_packages", lambda extra: ["pylsl"])
    assert "needs the optional part lab; in the project's folder: " in printed()
    monkeypatch.setattr(doctor, "missing_packages", lambda extra: [])
    assert "needs the optional part" not in printed()


def test_serial_ports_come_with_what_to_do(printed):
    lines = printed().splitlines()
    assert "    /dev/ttyUSB7  NDI Aurora; may NOT be opened" in lines
    assert "        -> sudo usermod -aG dialout me" in lines
    assert "serial ports: none" in printed(ports=())


def test_the_forms_that_are_listed_are_addresses():
    for kind in KINDS:
        written = (
            kind.forms.replace("[HOST]", "").replace("[:", ":").replace("]", "").replace(":PORT", ":5000")
        )
        assert parse_source(written).kind is kind


def test_the_real_ports_can_be_listed():
    code = "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(['devices', '--json']))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert isinstance(json.loads(done.stdout)["serial_ports"], list)


@pytest.mark.parametrize("name", ["devices", "doctor"])
def test_help_comes_without_loading_the_work(name):
    code = (
        "import sys\nfrom tonguetrack.tracker.cli import main\n"
        f"try: main(['{name}', '--help'])\nexcept SystemExit: pass\n"
        "print([name for name in ('numpy', 'numba', 'serial', 'tonguetrack.tracker.doctor') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert "--json" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"
