"""Any source by its URI: those that the drivers know, and the synthetic speaker."""

from __future__ import annotations

from dataclasses import replace

from .. import InputError
from ..drivers.replay import ReplaySource
from ..drivers.sources import Source, SourceAddress, open_device, parse_source

PHONES = ("ə", "i", "ə", "ɑ", "ə", "u", "ə", "s", "a", "ʃ", "i", "ɔ", "ə")


def open_source(text: str) -> Source:
    """Opens a source, see `drivers.sources.KINDS`. Raises InputError where it cannot be had."""
    address = parse_source(text)
    return _synthetic(address) if address.kind.scheme == "simulate" else open_device(address)


def _synthetic(address: SourceAddress) -> Source:
    """`simulate:?coils=...`: a synthetic speaker who says the same again and again."""
    from .simulation import Simulation, simulate

    if address.path:
        raise InputError(f"'{address.text}': only options may follow simulate:, as in simulate:?noise=0.5.")
    coils = address.option("coils", "tongue_tip,tongue_blade,tongue_dorsum")
    recording, _ = simulate(
        Simulation(
            phones=PHONES,
            coils=tuple(role for role in coils.split(",") if role),
            speaker=int(address.number("speaker", 1, 0, 10**6)),
            seconds=address.number("seconds", 20.0, 0.1, 3600.0),
            rate_hz=address.number("rate", 250.0, 1.0, 5000.0),
            noise_mm=address.number("noise", 0.3, 0.0, 100.0),
            dropouts=address.number("dropouts", 0.0, 0.0, 0.95),
            head_motion=address.choice("head_motion", "0", ("0", "1")) == "1",
        )
    )
    return ReplaySource(replace(recording, source=address.text), loop=True, address=address.text)
