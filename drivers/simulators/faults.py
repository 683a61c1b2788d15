"""How a simulated device misbehaves on request, the same way every time.

    drop=0.01,duplicate=0.005,dead=tongue_tip@3-5,disconnect@8

A list of faults with commas between. After `=` how much, after `@` when, in seconds since streaming began:
`@3-5` from 3 to 5, `@3` from 3 on; without `@` always.

    drop=SHARE         that share of the frames is never sent
    duplicate=SHARE    that share is sent twice
    reorder=SHARE      that share changes places with the frame that follows
    corrupt=SHARE      in that share of the packets one byte is turned into another
    stall=SECONDS@T    from T on nothing is sent for that long; what was measured meanwhile comes in one burst,
                       or is lost where the device is polled
    disconnect@T       the connection is cut
    jump=SECONDS@T     from T on the device's time is off by that much
    dead=COIL          the coil is reported missing
    noisy=COIL:MM      the coil's position has noise of that standard deviation
    seed=N             another sequence of the same faults (default 1)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ... import InputError
from .motion import DeviceFrame

SHARES = ("drop", "duplicate", "reorder", "corrupt")
KINDS = (*SHARES, "stall", "disconnect", "jump", "dead", "noisy", "seed")
FOREVER_S = float("inf")


@dataclass(frozen=True)
class Fault:
    """kind: one of KINDS; amount: share, seconds or mm; coil: index; start_s, end_s: since streaming began."""

    kind: str
    amount: float = 0.0
    coil: int = -1
    start_s: float = 0.0
    end_s: float = FOREVER_S

    def active(self, time_s: float) -> bool:
        return self.start_s <= time_s < self.end_s


@dataclass(frozen=True)
class FaultPlan:
    """All faults that were asked for."""

    faults: tuple[Fault, ...] = ()
    seed: int = 1


def parse_faults(text: str, coils: Sequence[str]) -> FaultPlan:
    """Reads the list. Raises InputError that names the fault and what was expected."""
    faults, seed = [], 1
    for part in (piece.strip() for piece in text.split(",") if piece.strip()):
        what, at, when = part.partition("@")
        kind, equals, value = what.partition("=")
        if kind not in KINDS:
            raise InputError(f"--faults {part}: unknown; the faults are {', '.join(KINDS)}.")
        start_s, end_s = _times(part, when) if at else (0.0, FOREVER_S)
        if kind == "seed":
            seed = int(_amount(part, value, 0, 2**31))
        elif kind in SHARES:
            faults.append(Fault(kind, _amount(part, value, 0.0, 1.0), -1, start_s, end_s))
        elif kind == "dead":
            faults.append(Fault(kind, 0.0, _coil(part, value, coils), start_s, end_s))
        elif kind == "noisy":
            name, _, noise = value.rpartition(":")
            faults.append(
                Fault(kind, _amount(part, noise, 0.0, 1000.0), _coil(part, name, coils), start_s, end_s)
            )
        elif not at:
            raise InputError(
                f"--faults {part}: say when, in seconds, as in {kind}{'=1' if equals else ''}@5."
            )
        elif kind == "stall":
            seconds = _amount(part, value, 0.0, 3600.0)
            faults.append(Fault(kind, seconds, -1, start_s, start_s + seconds))
        elif kind == "jump":
            faults.append(Fault(kind, _amount(part, value, -1e6, 1e6), -1, start_s, end_s))
        else:
            faults.append(Fault(kind, 0.0, -1, start_s, end_s))
    return FaultPlan(tuple(faults), seed)


class Misbehaviour:
    """A plan at work on one connection's stream. time_s: seconds since streaming began."""

    def __init__(self, plan: FaultPlan) -> None:
        self._plan = plan
        self._random = np.random.default_rng(plan.seed)
        self._held: DeviceFrame | None = None
        self._cuts = [fault.start_s for fault in plan.faults if fault.kind == "disconnect"]

    def frames(self, frame: DeviceFrame, time_s: float) -> list[DeviceFrame]:
        """What is sent in the place of one measured frame; the frame's arrays may be changed."""
        self._spoil(frame, time_s)
        if self._strikes("drop", time_s):
            return []
        out = [frame, frame] if self._strikes("duplicate", time_s) else [frame]
        if self._held is not None:
            out.append(self._held)
            self._held = None
        elif self._strikes("reorder", time_s):
            self._held = out.pop()
        return out

    def packet(self, data: bytes, time_s: float) -> bytes:
        """The bytes as they arrive: now and then one of them is another."""
        if not data or not self._strikes("corrupt", time_s):
            return data
        damaged = bytearray(data)
        place = int(self._random.integers(len(damaged)))
        damaged[place] ^= int(self._random.integers(1, 256))
        return bytes(damaged)

    def stalled(self, time_s: float) -> bool:
        """Whether nothing may be sent now."""
        return any(fault.kind == "stall" and fault.active(time_s) for fault in self._plan.faults)

    def cut(self, time_s: float) -> bool:
        """Whether the connection is to be cut now; each `disconnect` says so once."""
        due = [start for start in self._cuts if start <= time_s]
        self._cuts = [start for start in self._cuts if start > time_s]
        return bool(due)

    def _spoil(self, frame: DeviceFrame, time_s: float) -> None:
        for fault in self._plan.faults:
            if not fault.active(time_s):
                continue
            if fault.kind == "dead":
                frame.positions[fault.coil] = np.nan
                frame.quaternions[fault.coil] = np.nan
            elif fault.kind == "noisy":
                frame.positions[fault.coil] += self._random.normal(scale=fault.amount, size=3)
            elif fault.kind == "jump":
                frame.time_us = max(0, frame.time_us + round(fault.amount * 1e6))

    def _strikes(self, kind: str, time_s: float) -> bool:
        return any(
            fault.kind == kind and fault.active(time_s) and self._random.random() < fault.amount
            for fault in self._plan.faults
        )


def _amount(part: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise InputError(f"--faults {part}: '{text}' should be a number from {low:g} to {high:g}.")
    return value


def _times(part: str, text: str) -> tuple[float, float]:
    start, dash, end = text.partition("-")
    start_s = _amount(part, start, 0.0, 1e6)
    end_s = _amount(part, end, start_s, 1e6) if dash else FOREVER_S
    return start_s, end_s


def _coil(part: str, name: str, coils: Sequence[str]) -> int:
    if name not in coils:
        raise InputError(f"--faults {part}: there is no coil '{name}'; the coils are {', '.join(coils)}.")
    return list(coils).index(name)
