"""What a person is told where a serial port cannot be opened."""

from __future__ import annotations

import errno

import pytest
import serial

from tonguetrack.drivers.devices.link import LinkLost, open_serial


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (serial.SerialException(errno.ENOENT, "could not open port COM9"), "there is no such serial port"),
        (
            serial.SerialException(errno.EACCES, "could not open port X"),
            "`tonguetrack doctor` says how to get it",
        ),
        (serial.SerialException(errno.EISDIR, "could not open port X"), "this is no serial port"),
        (
            serial.SerialException("Could not configure port: (25, 'Inappropriate ioctl')"),
            "this is no serial port",
        ),
        (serial.SerialException(errno.EAGAIN, "Could not exclusively lock port X"), "another program has"),
        (serial.SerialException("Remote does not seem to support RFC2217"), "no serial port server"),
        (ValueError("what nobody foresaw"), "what nobody foresaw"),
    ],
)
def test_why_a_port_cannot_be_opened_is_said_in_plain_words(raised, words, monkeypatch):
    def refuse(*args, **kwargs):
        raise raised

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(LinkLost, match="^X: .*" + words):
        open_serial("X")


@pytest.mark.parametrize(
    ("name", "words"),
    [("nothing", "no such serial port"), (".", "no serial port"), ("file", "no serial port")],
)
def test_a_path_that_is_no_port_is_told_so(name, words, tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(LinkLost, match=words):
        open_serial(str(tmp_path / name))
