"""The serial traffic of real NDI devices, as IGSTK's project recorded it: every record is understood.

A line is `time : (INFO) n. command|receive[length] text`, with `\\xHH` for what is not printable.
"""

import re
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from tonguetrack.drivers.devices import ndi, ndi_reader, ndi_tracking
from tonguetrack.drivers.devices.ndi_tracking import State

LINE = re.compile(r"[\d.]+\s+:\s+\(INFO\) \d+\. (command|receive)\[(\d+)\] (.*)")
AURORA = ("aurora_stream_09_28_2005", "aurora_stream_11_04_2005", "aurora_stream_11_05_2005")
POLARIS = "polaris_stream_08_31_2005_NDICommandInterpreter"
DAMAGED = "polaris_stream_NDICommandInterpreterStress"
RECORDS = dict(zip(AURORA, (181, 182, 96), strict=True))


@dataclass(frozen=True)
class Exchange:
    """A command and its reply; a device that was reset says so without being asked."""

    command: bytes
    reply: bytes


def exchanges_of(reference_data, name):
    folder = reference_data / "device-logs"
    found, command, header = [], b"", b""
    for line in (folder / f"{name}.txt").read_text(encoding="latin-1").splitlines():
        match = LINE.match(line)
        if match is None:
            continue
        direction, size, text = match.groups()
        data = re.sub(
            rb"\\x([0-9A-F]{2})", lambda part: bytes([int(part[1], 16)]), text.encode("latin-1")
        ).replace(b"\\\\", b"\\")
        assert len(data) == int(size)
        if direction == "command":
            command = data
        elif data[:2] == ndi_tracking.BX_START:
            header = data  # the body was received by itself
        else:
            found.append(Exchange(command, header + data))
            command = header = b""
    return found


def answer_of(reply):
    """The text of an ASCII reply; an error is an answer too."""
    try:
        return ndi.parse_reply(reply)
    except ndi.NdiError as refusal:
        return str(refusal)


def options_of(exchange):
    return int(ndi.parse_command(exchange.command).arguments, 16)


def tracking_of(exchange):
    if exchange.reply[:2] == ndi_tracking.BX_START:
        return ndi_tracking.parse_bx(exchange.reply, options_of(exchange))
    return ndi_tracking.parse_tx(ndi.parse_reply(exchange.reply), options_of(exchange))


def named(exchanges, *names):
    return [e for e in exchanges if e.command and e.reply and ndi.parse_command(e.command).name in names]


@pytest.mark.parametrize("name", AURORA)
def test_every_record_of_the_aurora_has_a_good_crc(reference_data, name):
    exchanges = exchanges_of(reference_data, name)
    commands = [e.command for e in exchanges if e.command]
    replies = [e.reply for e in exchanges if e.reply]
    assert all(ndi.parse_command(command).crc_ok for command in commands)
    assert all(answer_of(reply) for reply in replies)
    assert len(commands) + len(replies) == RECORDS[name]


def test_every_record_of_the_polaris_has_good_crcs_and_lengths(reference_data):
    exchanges = exchanges_of(reference_data, POLARIS)
    assert all(ndi.parse_command(e.command).crc_ok for e in exchanges if e.command)
    binary = [e for e in exchanges if e.reply[:2] == ndi_tracking.BX_START]
    assert len(binary) == 151
    assert Counter(map(options_of, binary)) == {0x0001: 50, 0x1000: 50, 0x0005: 50, 0x0003: 1}
    assert all(answer_of(e.reply) for e in exchanges if e.reply[:2] != ndi_tracking.BX_START)


@pytest.mark.parametrize("name", [*AURORA, POLARIS])
def test_every_tracking_reply_is_understood_and_written_back_byte_for_byte(reference_data, name):
    replies = named(exchanges_of(reference_data, name), "TX", "BX")
    assert replies
    for exchange in replies:
        tracking, options = tracking_of(exchange), options_of(exchange)
        if exchange.reply[:2] == ndi_tracking.BX_START:
            assert ndi_tracking.encode_bx(tracking, options) == exchange.reply
        else:
            assert ndi.reply(ndi_tracking.encode_tx(tracking, options)) == exchange.reply


def test_the_tracking_replies_hold_what_was_in_front_of_the_devices(reference_data):
    transforms, positionless = 0, 0
    for name in (*AURORA, POLARIS):
        for exchange in named(exchanges_of(reference_data, name), "TX", "BX"):
            if not options_of(exchange) & ndi_tracking.TRANSFORMS:
                continue
            for tool in tracking_of(exchange).tools:
                if tool.state is not State.VALID:
                    positionless += 1
                    continue
                transforms += 1
                assert np.linalg.norm(tool.quaternion) == pytest.approx(1.0, abs=1e-3)
                assert 10.0 < np.linalg.norm(tool.position) < 3000.0
    assert transforms > 100
    assert positionless > 100


def test_the_auroras_counter_grows_by_multiples_of_eight_from_reply_to_reply(reference_data):
    for name in AURORA:
        newest = [
            max(tool.frame_number for tool in tracking_of(exchange).tools)
            for exchange in named(exchanges_of(reference_data, name), "TX")
        ]
        steps = [after - before for before, after in pairwise(newest) if after > before]
        assert steps
        assert all(step % 8 == 0 for step in steps)


@pytest.mark.parametrize("name", [*AURORA, POLARIS, DAMAGED])
def test_what_the_ports_hold_is_understood(reference_data, name):
    exchanges = exchanges_of(reference_data, name)
    for exchange in named(exchanges, "PHSR"):
        text = ndi.parse_reply(exchange.reply)
        assert ndi.encode_phsr(ndi.parse_phsr(text)) == text
    for exchange in named(exchanges, "PHINF"):
        arguments = ndi.parse_command(exchange.command).arguments
        options = int(arguments, 16) & 0xFFFF
        information = ndi.parse_phinf(ndi.parse_reply(exchange.reply), options)
        if options & ndi.PHINF_LOCATION and information.location is not None:
            assert information.location.device in ("A3-00117", "A3-00142", "P4-00148", "P4-04529")
    for exchange in named(exchanges, "VER"):
        assert " Rev " in ndi.parse_ver(ndi.parse_reply(exchange.reply))["Freeze Tag"]


def test_a_port_that_is_empty_says_so(reference_data):
    replies = [e.reply for e in exchanges_of(reference_data, DAMAGED) if b"UNOCCUPIED" in e.reply]
    assert ndi.parse_phinf(ndi.parse_reply(replies[0]), 0x002D) == ndi.PortInformation()


@pytest.mark.parametrize("name", [*AURORA, POLARIS])
@pytest.mark.parametrize("seed", range(3))
def test_a_reader_finds_every_reply_in_pieces_of_any_size(reference_data, name, seed):
    replies = [e.reply for e in exchanges_of(reference_data, name) if e.reply]
    assert list(read_in_pieces(b"".join(replies), seed)) == replies


@pytest.mark.parametrize("seed", range(3))
def test_of_the_damaged_log_every_good_reply_is_found_and_the_damage_told(reference_data, seed):
    replies = [e.reply for e in exchanges_of(reference_data, DAMAGED) if e.reply]
    bad = [reply for reply in replies if not is_good(reply)]
    assert len(bad) == 4
    # The last of the four lacks nothing but its carriage return, and runs into the next reply.
    assert is_good(bad[3] + b"\r")
    expected = [reply + b"\r" if reply == bad[3] else reply for reply in replies if reply not in bad[:3]]
    items = list(read_in_pieces(b"".join(replies), seed, keep_damage=True))
    assert [item for item in items if isinstance(item, bytes)] == expected
    assert [item for item in items if isinstance(item, int)] == [len(reply) for reply in bad[:3]]


def test_the_good_tracking_replies_of_the_damaged_log_are_understood(reference_data):
    replies = [e for e in named(exchanges_of(reference_data, DAMAGED), "TX", "BX") if is_good(e.reply)]
    for exchange in replies:
        assert [tool.handle for tool in tracking_of(exchange).tools] == [1, 2, 3]
    assert len(replies) == 147


def is_good(reply):
    try:
        return bool(answer_of(reply))
    except ndi.NdiDamaged:
        return False


def read_in_pieces(stream, seed, keep_damage=False):
    """The replies, and where asked the sizes of the damaged pieces, of a stream in pieces of 1 to 99 bytes."""
    random = np.random.default_rng(seed)
    reader, start = ndi_reader.ReplyReader(), 0
    while start < len(stream):
        size = int(random.integers(1, 100))
        reader.feed(stream[start : start + size])
        start += size
        while (item := reader.next()) is not None:
            if isinstance(item, ndi_reader.Reply):
                yield item.data
            elif keep_damage:
                yield item.size
            else:
                pytest.fail(f"{item.size} damaged bytes")
    assert not reader.pending
