"""Presets: which parameters of an avatar are made of which shapes (`streams/shapes.py`), as data files.

    format = "tonguetrack preset 1"
    title = "for people"
    source = "where the names are published"

    [targets]                                        # clamped to 0..1
    TongueOut = "out"
    TongueSquish = { narrow = 0.5, arched = 0.5 }    # a weighted sum

    [signed]                                         # clamped to -1..1
    TongueX = { tip_right = 1, tip_left = -1 }

    [undriven]                                       # names of the vocabulary that nothing is sent for, and why
    tonguePress = "..."

Instead of [targets] and [signed], `every_shape = true` sends every shape of the model under its own name.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .... import InputError
from ...pose import FloatArray

FORMAT = "tonguetrack preset 1"
MAX_BYTES = 256 * 1024
MOST_TARGETS = 500
LONGEST_NAME = 100
LARGEST_WEIGHT = 100.0
_KEYS = {"format", "title", "source", "every_shape", "targets", "signed", "undriven"}


@dataclass(frozen=True)
class Target:
    """One parameter: the sum of weight x shape, clamped to low..1. terms: (shape, weight); low: 0 or -1."""

    name: str
    terms: tuple[tuple[str, float], ...]
    low: float = 0.0


@dataclass(frozen=True)
class Preset:
    """A vocabulary. undriven: name -> why nothing is sent for it; every_shape: the targets are the model's shapes."""

    name: str
    title: str
    source: str
    targets: tuple[Target, ...]
    undriven: Mapping[str, str] = field(default_factory=dict)
    every_shape: bool = False

    def mixer(self, shapes: Sequence[str]) -> Mixer:
        """What turns these shapes (`ShapeMeter.names`) into targets. InputError for a shape that is not among them."""
        targets = tuple(Target(name, ((name, 1.0),)) for name in shapes) if self.every_shape else self.targets
        weights = np.zeros((len(targets), len(shapes)))
        columns = {name: column for column, name in enumerate(shapes)}
        for row, target in enumerate(targets):
            for shape, weight in target.terms:
                if shape not in columns:
                    raise InputError(
                        f"preset {self.name}: {target.name} is made of the shape '{shape}', which this model does not "
                        f"have; expected some of {', '.join(shapes)}."
                    )
                weights[row, columns[shape]] += weight
        return Mixer(
            tuple(target.name for target in targets), weights, np.array([target.low for target in targets])
        )


@dataclass(frozen=True)
class Mixer:
    """names: (targets,); weights: (targets, shapes); low: (targets,) 0 or -1."""

    names: tuple[str, ...]
    weights: FloatArray
    low: FloatArray

    def __call__(self, shapes: ArrayLike) -> FloatArray:
        """(targets,) of shapes (shapes,) in 0..1."""
        return np.asarray(np.minimum(np.maximum(self.weights @ np.asarray(shapes), self.low), 1.0))


def preset_names() -> tuple[str, ...]:
    """The presets that come with the package."""
    return tuple(
        sorted(
            entry.name.removesuffix(".toml")
            for entry in files(__name__).iterdir()
            if entry.name.endswith(".toml")
        )
    )


def load_preset(name: str) -> Preset:
    """A preset of the package by its name, or a file whose name ends in .toml. InputError names what is wrong."""
    if name.endswith(".toml"):
        path = Path(name)
        if not path.is_file():
            raise InputError(f"{name}: there is no such preset file.")
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{name}: {path.stat().st_size} bytes are too many for a preset.")
        content, label = path.read_bytes(), path.stem
    else:
        if name not in preset_names():
            raise InputError(
                f"preset '{name}': there is no such preset; expected {', '.join(preset_names())}, or a file that ends "
                "in .toml."
            )
        content, label = files(__name__).joinpath(f"{name}.toml").read_bytes(), name
    try:
        return parse_preset(content.decode(), label)
    except UnicodeDecodeError as reason:
        raise InputError(f"{name}: this is not readable TOML ({reason}).") from reason
    except InputError as reason:
        raise InputError(f"{name}: {reason}") from reason


def parse_preset(text: str, name: str) -> Preset:
    """A preset from the text of a file. InputError says which key is at fault."""
    if len(text) > MAX_BYTES or any(line.count(".") > MAX_BYTES // 256 for line in text.splitlines()):
        raise InputError("this is too long to be a preset, or a line of it is.")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as reason:
        raise InputError(f"this is not readable TOML ({reason}).") from reason
    if content.get("format") != FORMAT:
        raise InputError(f'this is not a preset: expected the line format = "{FORMAT}".')
    for key in content:
        if key not in _KEYS:
            raise InputError(f"the key '{key}' is unknown; expected {', '.join(sorted(_KEYS))}.")
    every_shape = content.get("every_shape", False)
    if not isinstance(every_shape, bool):
        raise InputError(f"every_shape = {every_shape!r}: expected true or false.")
    tables = {key: _table(content, key) for key in ("targets", "signed", "undriven")}
    if every_shape == bool(tables["targets"] or tables["signed"]):
        raise InputError("expected either every_shape = true or some [targets] or [signed].")
    named = [name for table in tables.values() for name in table]
    for wrong in named:
        if not (0 < len(wrong) <= LONGEST_NAME and wrong.isprintable()) or named.count(wrong) > 1:
            raise InputError(
                f"the name {wrong[:LONGEST_NAME]!r} is given twice, is empty, or is not {LONGEST_NAME} printable "
                "characters at most."
            )
    targets = [_target(key, value, 0.0) for key, value in tables["targets"].items()]
    targets += [_target(key, value, -1.0) for key, value in tables["signed"].items()]
    return Preset(
        name,
        _text(content.get("title", ""), "title"),
        _text(content.get("source", ""), "source"),
        tuple(targets),
        {key: _text(value, f"[undriven] {key}") for key, value in tables["undriven"].items()},
        every_shape,
    )


def _target(name: str, value: Any, low: float) -> Target:
    terms = {value: 1.0} if isinstance(value, str) else value
    if not isinstance(terms, dict) or not terms:
        raise InputError(f"{name} = {value!r}: expected the name of a shape, or {{ shape = weight, ... }}.")
    for shape, weight in terms.items():
        number = isinstance(weight, int | float) and not isinstance(weight, bool)
        if not (number and abs(weight) <= LARGEST_WEIGHT and weight != 0):
            raise InputError(
                f"{name}, {shape} = {weight!r}: expected a weight, not 0, between -{LARGEST_WEIGHT:g} and "
                f"{LARGEST_WEIGHT:g}."
            )
    return Target(name, tuple((shape, float(weight)) for shape, weight in terms.items()), low)


def _table(content: Mapping[str, Any], key: str) -> dict[str, Any]:
    table = content.get(key, {})
    if not isinstance(table, dict):
        raise InputError(f"'{key}' should be a table, [{key}].")
    if len(table) > MOST_TARGETS:
        raise InputError(f"[{key}] has {len(table)} names; expected {MOST_TARGETS} at most.")
    return table


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{where} = {value!r}: expected text in quotes.")
    return value
