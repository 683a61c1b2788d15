"""Named values that arrive, held against the vocabularies of the presets: a name that nobody knows is silent otherwise."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any

MAX_NAMES = 512
_DIRECTION = re.compile(r"pose_[0-9]{1,3}")
"""The shapes that are a model's own directions: as many as it has."""


@dataclass(frozen=True)
class Vocabulary:
    """names: blend shapes that avatars of this kind have; axes: names with two ends, which not every protocol sends."""

    names: frozenset[str]
    axes: frozenset[str] = frozenset()


class NamedValues:
    """What arrived by name. counts: how often; last: the newest value; beyond: values of further names.

    Memory is bounded, whatever is sent.
    """

    def __init__(self, vocabularies: Mapping[str, Vocabulary]) -> None:
        self._vocabularies = vocabularies
        self.counts: dict[str, int] = {}
        self.last: dict[str, float] = {}
        self.beyond = 0

    def add(self, name: str, value: float) -> str:
        """Counts one value; what is to be said of its name, "" unless it is new and in no vocabulary."""
        is_new = name not in self.counts
        if is_new and len(self.counts) == MAX_NAMES:
            self.beyond += 1
            return ""
        self.counts[name] = self.counts.get(name, 0) + 1
        self.last[name] = value
        return self._stranger(name) if is_new else ""

    @property
    def unknown(self) -> list[str]:
        """Names in no vocabulary."""
        return [name for name in self.counts if self._stranger(name)]

    @property
    def preset(self) -> str:
        """The preset with the largest share of its names among those that arrived, "" = none has any."""
        shares = {
            preset: len(self.counts.keys() & each.names) / len(each.names)
            for preset, each in self._vocabularies.items()
        }
        best = max(shares, key=lambda preset: shares[preset], default="")
        return best if best and shares[best] > 0 else ""

    @property
    def missing(self) -> list[str]:
        """The names of `preset` that did not arrive."""
        names = self._vocabularies[self.preset].names if self.preset else frozenset()
        return sorted(names - self.counts.keys())

    def as_dict(self) -> dict[str, Any]:
        return {
            "preset": self.preset,
            "missing": self.missing,
            "unknown": self.unknown,
            "counts": dict(sorted(self.counts.items())),
            "last": {name: value if isfinite(value) else None for name, value in sorted(self.last.items())},
            "beyond": self.beyond,
        }

    def lines(self) -> list[str]:
        """For people; none where nothing arrived by name."""
        if not self.counts:
            return []
        preset, missing, unknown = self.preset, self.missing, self.unknown
        found = f"preset {preset}: " + (f"missing {', '.join(missing)}" if missing else "all of its names")
        lines = [f"names      {len(self.counts)}; {found if preset else 'of no preset'}"]
        if unknown:
            lines.append(f"names      unknown: {', '.join(unknown)}")
        lines += [f"{name}  {count}  {self.last[name]:.3f}" for name, count in sorted(self.counts.items())]
        return lines

    def _stranger(self, name: str) -> str:
        if _DIRECTION.fullmatch(name) or any(
            name in each.names or name in each.axes for each in self._vocabularies.values()
        ):
            return ""
        for preset, each in self._vocabularies.items():
            for known in each.names | each.axes:
                if known.lower() == name.lower():
                    return f"the name {name} is in no preset; is {known} of the preset {preset} meant? Capitals count"
        return f"the name {name} is in no preset"


def preset_vocabularies() -> dict[str, Vocabulary]:
    """Those of the presets that come with the package."""
    from .presets import load_preset, preset_names
    from .shapes import shape_names

    found = {}
    for preset in map(load_preset, preset_names()):
        targets = preset.targets
        names = shape_names(0) if preset.every_shape else tuple(t.name for t in targets if t.low >= 0)
        found[preset.name] = Vocabulary(frozenset(names), frozenset(t.name for t in targets if t.low < 0))
    return found
