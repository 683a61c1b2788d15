"""Filters in words, as a session file and a command line name them.

    for recordings                                          for live frames
    butterworth 20 Hz order 5   forwards and backwards      one-pole 20 Hz
    fir 40-50 Hz                pass-stop, Kaiser, 60 dB    fir 40-50 Hz            the same, late by half its length
    gaussian 8 ms               standard deviation          one-euro 2 Hz beta 0.01
    median 5 frames                                         one-euro 2 Hz beta 0.01 speed 10 Hz
    none                                                    none

The one-euro filter (Casiez, Roussel and Vogel, CHI 2012) is a one-pole filter whose cut-off grows with the coil's
speed: cut-off = minimum + beta * |velocity|. Its four parameters: the frame rate, Hz, here the time since the frame
before; the minimum cut-off, 0.01 to 1000 Hz, lower = calmer at rest; beta, 0 to 100 per mm (Hz for each mm/s), higher
= less lag in motion; the cut-off of the velocity's own smoothing ("speed"), 0.01 to 1000 Hz, 1 where it is not stated,
as published. One speed and so one cut-off for each coil, not for each coordinate: turning the head does not change
what is smoothed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from .. import InputError

NARROWEST_FIR_HZ = 1.0
"""Between pass and stop: nearer together the filter would be longer than 4 s."""


@dataclass(frozen=True)
class _Value:
    """One number of a filter's text and what it may be."""

    name: str
    low: float
    high: float
    step: int = 0  # 1: whole numbers, 2: every second one from `low` on

    def allows(self, value: float) -> bool:
        return self.low <= value <= self.high and (not self.step or (value - self.low) % self.step == 0)

    def __str__(self) -> str:
        kind = ("a number", "a whole number", "an odd number")[self.step]
        return f"{kind} from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class _Kind:
    """text: how it is written, {} = a number; defaults: of the last numbers, which `short` leaves out."""

    text: str
    values: tuple[_Value, ...]
    recorded: bool = False
    live: bool = False
    short: str = ""
    defaults: tuple[float, ...] = ()


_KINDS = {
    "none": _Kind("none", (), recorded=True, live=True),
    "butterworth": _Kind(
        "butterworth {} Hz order {}",
        (_Value("the cut-off", 0.1, 1000.0), _Value("the order", 1, 10, step=1)),
        recorded=True,
    ),
    "fir": _Kind(
        "fir {}-{} Hz",
        (_Value("the pass frequency", 0.0, 1000.0), _Value("the stop frequency", 0.0, 1000.0)),
        recorded=True,
        live=True,
    ),
    "gaussian": _Kind("gaussian {} ms", (_Value("the width", 0.1, 1000.0),), recorded=True),
    "median": _Kind("median {} frames", (_Value("the length", 3, 101, step=2),), recorded=True),
    "one-pole": _Kind("one-pole {} Hz", (_Value("the cut-off", 0.1, 1000.0),), live=True),
    "one-euro": _Kind(
        "one-euro {} Hz beta {} speed {} Hz",
        (
            _Value("the minimum cut-off", 0.01, 1000.0),
            _Value("beta", 0.0, 100.0),
            _Value("the cut-off of the speed", 0.01, 1000.0),
        ),
        live=True,
        short="one-euro {} Hz beta {}",
        defaults=(1.0,),
    ),
}
_NUMBER = r"([0-9]+\.?[0-9]*(?:e[+-]?[0-9]+)?)"
FOR_RECORDINGS = "butterworth 20 Hz order 5, fir 40-50 Hz, gaussian 8 ms, median 5 frames, none"
FOR_LIVE = "one-pole 20 Hz, one-euro 2 Hz beta 0.01, fir 40-50 Hz, none"


@dataclass(frozen=True)
class Filter:
    """kind: the first word of its text; values: the numbers in it, in that order. Raises InputError for bad numbers."""

    kind: str
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for value, wanted in zip(self.values, _KINDS[self.kind].values, strict=True):
            if not wanted.allows(value):
                raise InputError(
                    f"the filter '{self}': {wanted.name} is {_digits(value)}, expected {wanted}."
                )
        if self.kind == "fir" and not self.values[1] - self.values[0] >= NARROWEST_FIR_HZ:
            raise InputError(
                f"the filter '{self}': the stop frequency has to be at least {NARROWEST_FIR_HZ:g} Hz above the pass "
                "frequency."
            )

    @property
    def for_recordings(self) -> bool:
        return _KINDS[self.kind].recorded

    @property
    def for_live(self) -> bool:
        return _KINDS[self.kind].live

    def __str__(self) -> str:
        kind = _KINDS[self.kind]
        is_short = bool(kind.short) and self.values[-len(kind.defaults) :] == kind.defaults
        return (kind.short if is_short else kind.text).format(*map(_digits, self.values))


def _digits(value: float) -> str:
    """The shortest digits that give the number back."""
    return repr(value).removesuffix(".0")


def parse_filter(text: str) -> Filter:
    """The filter that a text names; `str` of it gives the text back. Raises InputError that shows what there is."""
    for name, kind in _KINDS.items():
        for form in filter(None, (kind.text, kind.short)):
            words = re.escape(form).replace(r"\ ", r"\s*").replace(r"\-", r"\s*-\s*")
            pattern = words.replace(r"\{\}", _NUMBER)
            if found := re.fullmatch(pattern, text.strip(), re.IGNORECASE):
                numbers = tuple(map(float, found.groups()))
                return Filter(name, numbers + (kind.defaults if form == kind.short else ()))
    raise InputError(
        f"'{text[:80]}' is no filter; for recordings there are, for instance, {FOR_RECORDINGS}; for live frames "
        f"{FOR_LIVE}."
    )


def check_use(chosen: Filter, live: bool, where: str = "") -> None:
    """Raises InputError for a filter that waits for the future in a live run, or is late in a recording."""
    if live and not chosen.for_live:
        raise InputError(
            f"{where}the filter '{chosen}' needs the frames to come, which a live run does not have; expected one "
            f"like {FOR_LIVE}."
        )
    if not live and not chosen.for_recordings:
        raise InputError(
            f"{where}the filter '{chosen}' is for live frames and would make a recording late; expected one like "
            f"{FOR_RECORDINGS}."
        )
