"""Which filter smooths which coil: settings by role, the field's usual ones as presets, and the smoothing itself.

Recordings are smoothed with filters that shift nothing in time, live frames with causal ones, whose delay is
stated (`CausalSmoother.delays_s`). Raw data are never changed; every function gives a new array. How a filter is
written is in `filterwords`, its mathematics in `filters`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from .. import InputError
from . import filters as mathematics
from .coilmap import ROLES, TONGUE_PREFIX
from .filterwords import Filter, check_use, parse_filter
from .kernels import FARTHEST_MM
from .pose import FloatArray

GROUPS = ("tongue", "jaw_and_lips", "references", "all")
# Live, a one-pole filter of about twice the cut-off: the lag of the same one on a moving tongue is larger than the
# noise that it takes away. References move slowly, but late ones displace all other coils when the head turns.
_PRESETS: dict[str, tuple[dict[str, str], dict[str, str], str]] = {
    "carstens": (
        {"all": "fir 40-50 Hz", "references": "fir 5-15 Hz"},
        {"all": "one-pole 80 Hz", "references": "one-pole 20 Hz"},
        "what the Carstens AG501's own NormPos does: 40-50 Hz for articulators, 5-15 Hz for the references",
    ),
    "tardis": (
        {"all": "butterworth 20 Hz order 5"},
        {"all": "one-pole 40 Hz"},
        "AG501 recordings prepared in R, as with the package tardis",
    ),
    "haskins": (
        {"all": "butterworth 20 Hz order 5"},
        {"all": "one-pole 40 Hz"},
        "Haskins recordings (HPRC) in studies of articulatory inversion; the order is ours",
    ),
    "ema2wav": (
        {"all": "butterworth 25 Hz order 4"},
        {"all": "one-pole 50 Hz"},
        "the example settings of ema2wav",
    ),
    "mocha": (
        {"all": "butterworth 10 Hz order 5"},
        {"all": "one-pole 20 Hz"},
        "MOCHA, mngu0 and USC recordings in studies of articulatory inversion; the order is ours",
    ),
}


def _group_of(role: str) -> str:
    if role.startswith(TONGUE_PREFIX):
        return "tongue"
    if role.startswith("head_"):
        return "references"
    return "jaw_and_lips" if role in ("jaw", "upper_lip", "lower_lip", "mouth_left", "mouth_right") else "all"


@dataclass(frozen=True)
class Smoothing:
    """recorded, live: role or one of GROUPS -> filter, for whole recordings and for live frames.

    The most special key wins: the role, then its group, then "all". preset: a name of PRESETS whose keys are taken
    over where the same key is not stated here. Raises InputError for keys and presets that do not exist, and for
    filters that do not fit the use.
    """

    recorded: Mapping[str, Filter] = field(default_factory=dict)
    live: Mapping[str, Filter] = field(default_factory=dict)
    preset: str = ""

    def __post_init__(self) -> None:
        for use, stated in (("recorded", self.recorded), ("live", self.live)):
            for key, chosen in stated.items():
                if key not in GROUPS and key not in ROLES and not key.startswith(TONGUE_PREFIX):
                    raise InputError(
                        f"[smoothing] {use}.{key}: '{key}' is neither a role nor one of the groups "
                        f"{', '.join(GROUPS)}; the roles are {', '.join(ROLES)}."
                    )
                check_use(chosen, use == "live", f"[smoothing] {use}.{key}: ")
        if self.preset:
            recorded, live = _preset(self.preset)
            object.__setattr__(self, "recorded", {**recorded, **self.recorded})
            object.__setattr__(self, "live", {**live, **self.live})

    def of(self, role: str, live: bool) -> Filter | None:
        """The filter of a coil with this role; None = it stays as it is."""
        stated = self.live if live else self.recorded
        for key in (role, _group_of(role), "all"):
            if key in stated:
                return None if stated[key].kind == "none" else stated[key]
        return None


def _preset(name: str) -> tuple[dict[str, Filter], dict[str, Filter]]:
    if name not in _PRESETS:
        raise InputError(f"[smoothing] preset = '{name}': expected one of {', '.join(_PRESETS)}.")
    recorded, live, _ = _PRESETS[name]
    return (
        {key: parse_filter(text) for key, text in recorded.items()},
        {key: parse_filter(text) for key, text in live.items()},
    )


NO_SMOOTHING = Smoothing()
PRESETS: Mapping[str, tuple[Smoothing, str]] = {
    name: (Smoothing(preset=name), usual) for name, (_, _, usual) in _PRESETS.items()
}
"""name -> the smoothing, and where it is usual."""


def smoothing_from_toml(table: Mapping[str, Any]) -> Smoothing:
    """The session's table [smoothing]: preset = "...", recorded.ROLE = "...", live.ROLE = "...".

    Raises InputError that names the key at fault.
    """
    for key in table:
        if key not in ("preset", "recorded", "live"):
            raise InputError(f"[smoothing] has the unknown key '{key}'; expected live, preset, recorded.")
    preset = table.get("preset", "")
    if not isinstance(preset, str):
        raise InputError(
            f"[smoothing] preset = {preset!r}: expected one of {', '.join(_PRESETS)}, in quotes."
        )
    return Smoothing(_filters_from(table, "recorded"), _filters_from(table, "live"), preset)


def _filters_from(table: Mapping[str, Any], use: str) -> dict[str, Filter]:
    stated = table.get(use, {})
    if not isinstance(stated, Mapping):
        raise InputError(f'[smoothing] {use}: expected keys below it, as in {use}.all = "none".')
    chosen = {}
    for key, text in stated.items():
        if not isinstance(text, str):
            raise InputError(f"[smoothing] {use}.{key} = {text!r}: expected a filter in quotes.")
        try:
            chosen[key] = parse_filter(text)
        except InputError as reason:
            raise InputError(f"[smoothing] {use}.{key}: {reason}") from reason
    return chosen


def smoothing_toml(smoothing: Smoothing) -> dict[str, Any]:
    """The table that `smoothing_from_toml` reads back; what the preset says by itself is left to its name."""
    table: dict[str, Any] = {}
    preset_recorded: Mapping[str, Filter] = {}
    preset_live: Mapping[str, Filter] = {}
    if smoothing.preset:
        table["preset"] = smoothing.preset
        preset_recorded, preset_live = _preset(smoothing.preset)
    for use, stated, known in (
        ("recorded", smoothing.recorded, preset_recorded),
        ("live", smoothing.live, preset_live),
    ):
        own = {key: str(chosen) for key, chosen in stated.items() if known.get(key) != chosen}
        if own:
            table[use] = own
    return table


# Smoothing itself -----------------------------------------------------------------------------------


def _check_rate(chosen: Filter, rate_hz: float) -> None:
    """Raises InputError where the filter cannot be made for frames at this rate."""
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise InputError(
            f"the filter '{chosen}' needs the frame rate, which is not known (it is {rate_hz:g} Hz)."
        )
    highest_hz = {"butterworth": 0, "fir": 1}.get(chosen.kind)
    if highest_hz is not None and not chosen.values[highest_hz] < rate_hz / 2.0:
        raise InputError(
            f"the filter '{chosen}' needs more than {2.0 * chosen.values[highest_hz]:g} frames a second, but there "
            f"are {rate_hz:g}; choose a lower frequency, or none."
        )


def smooth(positions: FloatArray, rate_hz: float, filters: Sequence[Filter | None]) -> FloatArray:
    """A recording (frames, coils, 3), mm, smoothed without delay; filters: one for each coil, None = as it is.

    A coil is missing in a frame where a coordinate is not a number, or beyond FARTHEST_MM; that stays as it is. Each
    run of frames in between is filtered by itself. Raises InputError for live filters and for rates that a filter
    cannot work at.
    """
    result = np.array(positions, dtype=np.float64)
    for coil, chosen in enumerate(filters):
        if chosen is None or chosen.kind == "none":
            continue
        check_use(chosen, live=False)
        smoothed = _zero_phase(chosen, rate_hz)
        track = result[:, coil]
        with np.errstate(invalid="ignore"):
            present = np.asarray((np.abs(track) <= FARTHEST_MM).all(axis=1))
        for run in mathematics.runs_of(present):
            track[run] = smoothed(track[run])
    return result


def _zero_phase(chosen: Filter, rate_hz: float) -> Callable[[FloatArray], FloatArray]:
    """What smooths one run (frames, 3)."""
    values = chosen.values
    if chosen.kind == "median":
        return partial(mathematics.running_median, frames=int(values[0]))
    _check_rate(chosen, rate_hz)
    if chosen.kind == "butterworth":
        sections, settled = mathematics.butterworth(values[0], int(values[1]), rate_hz)
        return partial(mathematics.zero_phase_sections, sections=sections, settled=settled)
    if chosen.kind == "fir":
        taps = mathematics.fir_taps(values[0], values[1], rate_hz)
    else:
        taps = mathematics.gaussian_taps(values[0] / 1000.0 * rate_hz)
    return partial(mathematics.zero_phase_taps, taps=taps)


class CausalSmoother:
    """Live frames of n coils, one after the other, each coil with its filter (None = as it is).

    rate_hz: the nominal frame rate. delays_s: (n,) how late slow motion comes out at that rate, s; of the one-euro
    filter its longest delay. Raises InputError for filters that are not causal and for rates that one cannot work at.
    """

    def __init__(self, filters: Sequence[Filter | None], rate_hz: float) -> None:
        n = len(filters)
        self._nominal_s = 0.0
        self._kinds = np.full(n, mathematics.UNFILTERED, np.int64)
        self._settings = np.zeros((n, 3))
        self._lengths = np.zeros(n, np.int64)
        self.delays_s: FloatArray = np.zeros(n)
        designs: dict[int, FloatArray] = {}
        for coil, chosen in enumerate(filters):
            if chosen is None or chosen.kind == "none":
                continue
            check_use(chosen, live=True)
            _check_rate(chosen, rate_hz)
            self._nominal_s = 1.0 / rate_hz
            if chosen.kind == "fir":
                self._kinds[coil] = mathematics.FIR
                designs[coil] = mathematics.fir_taps(chosen.values[0], chosen.values[1], rate_hz)
                self._lengths[coil] = len(designs[coil])
                self.delays_s[coil] = (len(designs[coil]) - 1) / 2 / rate_hz
            elif chosen.kind == "one-pole":
                self._kinds[coil] = mathematics.ONE_POLE
                self._settings[coil, 0] = chosen.values[0]
                self.delays_s[coil] = mathematics.one_pole_delay_s(chosen.values[0], rate_hz)
            else:
                self._kinds[coil] = mathematics.ONE_EURO
                self._settings[coil] = chosen.values
                self.delays_s[coil] = mathematics.one_euro_delay_s(chosen.values[0])
        longest = max(map(len, designs.values()), default=0)
        self._taps = np.zeros((n, longest))
        for coil, taps in designs.items():
            self._taps[coil, : len(taps)] = taps
        self._past = np.zeros((n, longest, 3))
        self._memory = np.zeros((n, mathematics.MEMORY_COLUMNS))

    def step(self, raw: FloatArray, step_s: float, out: FloatArray) -> None:
        """Smooths raw (n, 3), mm, NaN = missing, into out (n, 3), which may be raw itself. Nothing is allocated.

        step_s: time since the frame before, s; below filters.SHORTEST_STEP_S (a device without a clock, a stamp that
        comes twice) the nominal one is taken. Both arrays are writable float64 in C order. A missing coil stays
        missing and starts anew when it comes back. FIR filters count frames, not seconds: after a gap, `reset`.
        """
        mathematics.smooth_frame(
            raw,
            step_s if step_s >= mathematics.SHORTEST_STEP_S else self._nominal_s,
            self._kinds,
            self._settings,
            self._taps,
            self._lengths,
            self._memory,
            self._past,
            out,
        )

    def reset(self) -> None:
        """As if no frame had ever come."""
        self._memory[:] = 0.0
