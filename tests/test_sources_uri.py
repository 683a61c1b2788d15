"""Sources by their address: every form, every wrong form in a sentence, and nothing else whatever is typed."""

import importlib
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.drivers.files.writing import write_recording
from tonguetrack.drivers.frames import Recording
from tonguetrack.drivers.sources import (
    KINDS,
    MAX_ADDRESS_LENGTH,
    open_device,
    open_replay,
    parse_source,
)

# What is an address -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "scheme", "host", "port", "path", "options"),
    [
        ("rtc3d://host", "rtc3d", "host", 3030, "", {}),
        ("rtc3d://host/", "rtc3d", "host", 3030, "", {}),
        ("RTC3D://192.168.1.5:4000", "rtc3d", "192.168.1.5", 4000, "", {}),
        ("rtc3d://[::1]", "rtc3d", "::1", 3030, "", {}),
        ("rtc3d://[fe80::1%eth0]:4000/", "rtc3d", "fe80::1%eth0", 4000, "", {}),
        (
            "rtc3d://host:3030?order=little&coils=16",
            "rtc3d", "host", 3030, "", {"order": "little", "coils": "16"},
        ),
        ("ndi:///dev/ttyUSB0?baud=921600", "ndi", "", 0, "/dev/ttyUSB0", {"baud": "921600"}),
        ("ndi://COM3", "ndi", "", 0, "COM3", {}),
        ("ndi:///dev/my%20port", "ndi", "", 0, "/dev/my port", {}),
        ("ndi+tcp://vega", "ndi+tcp", "vega", 8765, "", {}),
        ("ndi+tcp://vega:1?reply=tx", "ndi+tcp", "vega", 1, "", {"reply": "tx"}),
        ("ndi+rfc2217://server:65535", "ndi+rfc2217", "server", 65535, "", {}),
        ("carstens://ag501?layout=ag501", "carstens", "ag501", 30303, "", {"layout": "ag501"}),
        ("udp-json://", "udp-json", "", 1234, "", {}),
        ("udp-json://:5000", "udp-json", "", 5000, "", {}),
        ("udp-json://0.0.0.0", "udp-json", "0.0.0.0", 1234, "", {}),
        ("lsl:NDI Wave", "lsl", "", 0, "NDI Wave", {}),
        ("lsl:a/b:c?unit=m", "lsl", "", 0, "a/b:c", {"unit": "m"}),
        ("replay:take.xdf", "replay", "", 0, "take.xdf", {}),
        ("replay:C:\\takes\\one.xdf?speed=max", "replay", "", 0, "C:\\takes\\one.xdf", {"speed": "max"}),
        ("replay:/a/100%/Zunge ü.csv?loop=1", "replay", "", 0, "/a/100%/Zunge ü.csv", {"loop": "1"}),
        ("replay:what?.csv?speed=2", "replay", "", 0, "what?.csv", {"speed": "2"}),
        ("simulate:", "simulate", "", 0, "", {}),
        ("simulate:?coils=tongue_tip,tongue_dorsum&rate=400", "simulate", "", 0, "",
         {"coils": "tongue_tip,tongue_dorsum", "rate": "400"}),
        ("simulate:?", "simulate", "", 0, "", {}),
        ("rtc3d://host?coils=", "rtc3d", "host", 3030, "", {"coils": ""}),
    ],
)  # fmt: skip
def test_an_address_comes_apart(text, scheme, host, port, path, options):
    address = parse_source(text)
    assert address.kind.scheme == scheme
    assert (address.host, address.port, address.path, dict(address.options)) == (host, port, path, options)
    assert address.text == text


def test_every_form_of_the_table_is_understood_with_every_option_of_its_row():
    for kind in KINDS:
        form = kind.forms.replace("[HOST]", "").replace("[:", ":").replace("]", "").replace(":PORT", ":5000")
        query = "&".join(f"{name}=1" for name in kind.options)
        address = parse_source(f"{form}?{query}")
        assert address.kind is kind
        assert dict(address.options) == dict.fromkeys(kind.options, "1")


def test_every_opener_of_the_table_exists():
    for kind in KINDS:
        if kind.opener:
            module, _, function = kind.opener.partition(":")
            assert callable(getattr(importlib.import_module(f"tonguetrack.drivers.{module}"), function))


# What is none -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is not a source; sources are rtc3d://HOST"),
        ("take.xdf", "is not a source"),
        ("rtc3d", "is not a source"),
        ("osc://host:9000", "is not a source"),
        (":", "is not a source"),
        ("rtc3d:host", "expected rtc3d://HOST"),
        ("rtc3d:/host", "expected rtc3d://HOST"),
        ("rtc3d://", "the host is missing"),
        ("rtc3d://:3030", "the host is missing"),
        ("rtc3d://[]:3030", "the host is missing"),
        ("rtc3d://host:", "the port is missing"),
        ("ndi+rfc2217://host", "the port is missing, as in ndi\\+rfc2217://HOST:PORT"),
        ("rtc3d://host:0", "the port '0' should be a number from 1 to 65535"),
        ("rtc3d://host:65536", "the port '65536'"),
        ("rtc3d://host:-1", "the port '-1'"),
        ("rtc3d://host:3030x", "the port '3030x'"),
        ("rtc3d://host:٣", "the port '٣'"),
        ("rtc3d://host:" + "9" * 4000, "the port '999"),
        ("rtc3d://::1:3030", "an IPv6 address stands in brackets"),
        ("rtc3d://[::1", "brackets"),
        ("rtc3d://[::1]]", "is not a host"),
        ("rtc3d://ho st", "'ho st' is not a host"),
        ("rtc3d://me@host", "is not a host"),
        ("rtc3d://host/path", "is not a host"),
        ("rtc3d://host?baud=1", "the option 'baud' is unknown; rtc3d takes order, coils, rate"),
        ("rtc3d://host?coils=1&coil=2", "the option 'coil' is unknown"),
        ("rtc3d://host?little", "the option 'little' is unknown"),
        ("rtc3d://host?&", "'&' should be options, as in \\?order="),
        ("ndi://", "the serial port is missing"),
        ("ndi:/dev/ttyUSB0", "expected ndi:///dev/ttyUSB0"),
        ("ndi:///dev/tty%00", "no such name"),
        ("replay:", "a name is missing, as in replay:FILE"),
        ("lsl:?unit=m", "a name is missing"),
        ("replay:a\nb", "one printable line"),
        ("replay:\x1b[2J", "one printable line"),
        ("replay:" + "x" * MAX_ADDRESS_LENGTH, "at most 4096 characters"),
    ],
)
def test_what_is_no_address_is_refused_in_a_sentence(text, reason):
    with pytest.raises(InputError, match=reason):
        parse_source(text)


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("COM3", "ndi://COM3"),
        ("/dev/ttyUSB0", "ndi:///dev/ttyUSB0"),
        ("C:\\Users\\Anna\\take.xdf", "replay:C:\\Users\\Anna\\take.xdf"),
        (__file__, f"replay:{__file__}"),
    ],
)
def test_a_port_or_a_file_without_its_kind_is_told_with_it(text, meant):
    with pytest.raises(InputError, match=re.escape(f"is not a source; did you mean {meant}?")):
        parse_source(text)
    assert parse_source(meant).path


def test_a_replay_that_needs_to_be_told_more_is_told_how_in_an_address(tmp_path):
    (tmp_path / "a.csv").write_text("tip_x,tip_y,tip_z\n" + "1,2,3\n" * 20, encoding="utf-8")
    with pytest.raises(InputError, match=r"--rate.*In a source's address this is \?rate=\.\.\."):
        open_device(parse_source(f"replay:{tmp_path / 'a.csv'}?unit=mm"))
    assert open_device(parse_source(f"replay:{tmp_path / 'a.csv'}?rate=200&unit=mm")).rate_hz == 200.0


PIECES = [kind.scheme for kind in KINDS] + [name for kind in KINDS for name in kind.options]
PIECES += [
    *":/?&=[]@%#+. ",
    "//",
    "://",
    "::1",
    "[::1]",
    "host",
    "3030",
    "65536",
    "%00",
    "%",
    "ü",
    "\ud800",
    "\0",
]


@settings(max_examples=1500, deadline=None)
@given(st.lists(st.sampled_from(PIECES) | st.text(max_size=3), max_size=12).map("".join))
def test_whatever_is_typed_is_an_address_or_an_input_error(text):
    check(text)


@settings(max_examples=500, deadline=None)
@given(
    st.sampled_from(KINDS), st.lists(st.sampled_from(PIECES) | st.text(max_size=3), max_size=8).map("".join)
)
def test_whatever_follows_a_scheme_is_an_address_or_an_input_error(kind, rest):
    check(f"{kind.scheme}:{rest}")
    check(f"{kind.scheme}://{rest}")


def check(text):
    try:
        address = parse_source(text)
    except InputError as reason:
        assert str(reason).endswith(".")
        return
    assert set(address.options) <= set(address.kind.options)
    assert address.path.isprintable()
    assert not set(address.host) & set(" /[]@")
    if address.kind.port or address.kind.scheme == "ndi+rfc2217":
        assert 1 <= address.port <= 65535
    else:
        assert address.port == 0


# Options ----------------------------------------------------------------------------------------------


def test_a_number_is_inside_its_limits_or_refused_by_name():
    address = parse_source("rtc3d://host?coils=16")
    assert address.number("coils", 0, 1, 64) == 16
    assert address.number("rate", 400.0, 1, 1000) == 400.0
    for text in ("0", "65", "-1", "nan", "inf", "many", "1e400", "0x10"):
        with pytest.raises(InputError, match=f"coils={text}: expected a number from 1 to 64"):
            parse_source(f"rtc3d://host?coils={text}").number("coils", 0, 1, 64)


def test_a_choice_is_one_of_its_words_or_refused_with_all_of_them():
    address = parse_source("rtc3d://host?order=LITTLE")
    assert address.choice("order", "big", ("big", "little")) == "little"
    assert address.choice("coils", "x", ("x", "y")) == "x"
    with pytest.raises(InputError, match="order=middle: expected big, little"):
        parse_source("rtc3d://host?order=middle").choice("order", "big", ("big", "little"))


# replay: ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "a recording.csv"
    positions = np.arange(4 * 2 * 3, dtype=np.float64).reshape(4, 2, 3)
    write_recording(Recording(("tip", "dorsum"), positions, np.arange(4) / 100.0, 100.0, "made up"), path)
    return path


def test_a_file_is_played_with_its_own_rate(file):
    with open_device(parse_source(f"replay:{file}")) as source:
        assert (source.speed, source.loop, source.rate_hz) == (1.0, False, pytest.approx(100.0))
        assert source.coils == ("tip", "dorsum")
        assert source.address == f"replay:{file}"


def test_speed_and_loop_are_those_of_the_address(file):
    fast = open_replay(parse_source(f"replay:{file}?speed=2&loop=1"))
    assert (fast.speed, fast.loop, fast.rate_hz) == (2.0, True, pytest.approx(200.0))
    fastest = open_replay(parse_source(f"replay:{file}?speed=max"))
    assert fastest.speed is None
    assert len(list(fastest)) == 4


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ("speed=0", "speed=0: expected a number from 0.001 to 1000"),
        ("speed=-1", "speed=-1"),
        ("speed=fast", "speed=fast"),
        ("speed=inf", "speed=inf"),
        ("loop=yes", "loop=yes: expected 0, 1"),
        ("loop", "loop=: expected 0, 1"),
        ("rate=0", "rate=0: expected a number"),
        ("unit=furlong", "furlong"),
    ],
)
def test_wrong_options_are_refused_in_a_sentence(file, options, reason):
    with pytest.raises(InputError, match=reason):
        open_replay(parse_source(f"replay:{file}?{options}"))


def test_a_file_that_is_not_there_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="nothing.csv"):
        open_replay(parse_source(f"replay:{tmp_path}/nothing.csv"))
