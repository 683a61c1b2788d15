"""Every setting of `tonguetrack mri build`; the paper's, where nothing better was measured.

A table of TOML holds those that differ, in the data set's [settings] or in a file of its own:

    rounds = 3
    [tongue]
    least_smoothness = 4.0
    [tongue.rule]
    radius_mm = 5.0

`settings_toml` writes all of them with what they mean. A step's settings are declared beside the step.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from ... import InputError
from . import diffusion
from .contact import ContactSettings
from .matching import PALATE, TONGUE, MatchSettings
from .palatealignment import ProfileSettings
from .palates import PalatePriorSettings

LARGEST_FILE = 1_000_000
COMPLETIONS = ("averaging", "low rank")


@dataclass(frozen=True)
class DenoisingSettings:
    """See `diffusion.denoise`. The paper names the method, not its values."""

    steps: int = diffusion.STEPS
    step_mm2: float = diffusion.STEP_MM2
    contrast: float = diffusion.CONTRAST
    sigma_mm: float = diffusion.SIGMA_MM
    rho_mm: float = diffusion.RHO_MM


@dataclass(frozen=True)
class TonguePriorSettings:
    """The fit of the multilinear model in a round. speaker_modes, pose_modes: so many weights, at most. With 10 and 12
    the model also knows what is wrong with single meshes and hands it on: from round to round more faces are folded
    (on the paper's phantom set 225 after five rounds, against 8 with 5 and 4).

    h: the paper's box of 0.5 sigma, sigma being what the authors' software takes for it, holds a phone's weights away from
    where that phone is: on phantoms a round then ends 0.02 mm farther from the truth than it began (where the palate is
    touched 0.5 mm), with 2 sigma 0.08 (0.12) mm nearer.
    """

    h: float = 2.0
    energies: int = 10
    speaker_modes: int = 5
    pose_modes: int = 4


@dataclass(frozen=True)
class ModelSettings:
    """Of the model that is written. So many weights; fewer where there are fewer speakers or phones."""

    speaker_modes: int = 5
    pose_modes: int = 4


@dataclass(frozen=True)
class BuildSettings:
    """denoise, restore_contact: whether the step is taken; rounds: of bootstrapping, 0 for none; completion: how
    missing cells are filled."""

    denoise: bool = True
    restore_contact: bool = True
    rounds: int = 5
    completion: str = "low rank"
    denoising: DenoisingSettings = field(default_factory=DenoisingSettings)
    palate: MatchSettings = PALATE
    palate_prior: PalatePriorSettings = field(default_factory=PalatePriorSettings)
    alignment: ProfileSettings = field(default_factory=ProfileSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    tongue: MatchSettings = TONGUE
    tongue_prior: TonguePriorSettings = field(default_factory=TonguePriorSettings)
    model: ModelSettings = field(default_factory=ModelSettings)


@dataclass(frozen=True)
class _About:
    """What a setting means, and from where to where it makes sense."""

    meaning: str
    least: float = 0.0
    most: float = 1e6


_SECTIONS = {
    "": "Steps that can be left out, and how often tongues are matched again.",
    "denoising": "Edge-enhancing diffusion of each scan (the paper names the method, not its values).",
    "palate": "Template matching of the hard palate.",
    "palate_prior": "The PCA model of the palates, a start for matching them again.",
    "alignment": "The palate brought to the speaker's other scans.",
    "contact": "The palate in place of the tongue's surface where they touch.",
    "tongue": "Template matching of the tongue.",
    "tongue_prior": "The multilinear model of the tongues, a start for matching them again.",
    "model": "The model that is written.",
}
_ABOUT = {
    "denoise": _About("whether scans are denoised"),
    "restore_contact": _About("whether the palate is put in where the tongue touches it"),
    "rounds": _About("of bootstrapping; 0 for none (paper: 5)", 0, 100),
    "palate_prior.rounds": _About("of bootstrapping; 0 for none (paper: 1)", 0, 100),
    "completion": _About(f"of missing cells: {' or '.join(COMPLETIONS)} (paper: averaging)"),
    "denoising.steps": _About("diffusion steps", 0, 10_000),
    "denoising.step_mm2": _About("time of each, mm^2", 1e-6, 100.0),
    "denoising.contrast": _About(
        "the gradient from which on something is an edge, as a share of the steepest", 1e-6, 1000.0
    ),
    "denoising.sigma_mm": _About("smoothing before gradients are taken", 1e-3, 50.0),
    "denoising.rho_mm": _About("averaging of their directions", 0.0, 50.0),
    "palate_prior.h": _About(
        "half the width of the box around the mean weights, in sigma (paper: 1)", 1e-3, 100.0
    ),
    "tongue_prior.h": _About(
        "half the width of the box around the mean weights, in sigma (paper: 0.5)", 1e-3, 100.0
    ),
    "palate_prior.energies": _About("fits, each with new neighbours (paper: 10)", 1, 1000),
    "tongue_prior.energies": _About("fits, each with new neighbours (paper: 10)", 1, 1000),
    "speaker_modes": _About("speaker weights, at most (paper: 5 in its model)", 1, 1000),
    "pose_modes": _About("pose weights, at most (paper: 4 in its model)", 1, 1000),
    "smoothness": _About("weight of equal motions of neighbours, first energy (paper: 10)"),
    "least_smoothness": _About("the same, last energy (paper: 6)"),
    "landmarks": _About("weight of the landmarks, first energy (paper: 10)"),
    "tongue.least_landmarks": _About("the same, last energy (paper: 0)"),
    "palate.least_landmarks": _About("the same, last energy (paper: 10)"),
    "energies": _About("in the series, each with new neighbours (paper: 40)", 1, 1000),
    "rule.radius_mm": _About("how far away a neighbour may be, first energy (paper: 4)", 1e-3, 1000.0),
    "rule.angle_deg": _About("how far its normal may be turned away (paper: 60)", 1e-3, 180.0),
    "last_rule.radius_mm": _About("how far away a neighbour may be, last energy (paper: 4)", 1e-3, 1000.0),
    "last_rule.angle_deg": _About("how far its normal may be turned away (paper: 60)", 1e-3, 180.0),
    "seen.radius_mm": _About("how near a point has to be that shows the palate", 1e-3, 1000.0),
    "seen.angle_deg": _About("how far its normal may be turned away", 1e-3, 180.0),
    "smooth_afterwards": _About(
        "whether motions are averaged with their neighbours' at the end (paper: true)"
    ),
    "length": _About("samples in a profile (paper: 15)", 3, 200),
    "distance_mm": _About("between the samples of a profile (paper: 1)", 0.01, 10.0),
    "first": _About("where a profile begins, in samples from the surface into the tissue", -200, 200),
    "smoothing_mm": _About("of the scans, level by level", 0.0, 20.0),
    "shifts_mm": _About("starts that are tried, along each axis", -100.0, 100.0),
    "nods_deg": _About("starts that are tried, turned about the axis from ear to ear", -90.0, 90.0),
    "followed": _About("how many of these are optimised", 1, 1000),
    "least_score": _About("a lower mean correlation is called uncertain", -1.0, 1.0),
    "margin_mm": _About("points further behind the palate are taken out", 0.0, 100.0),
    "everywhere": _About("all of the palate is put in (paper), not only what the points do not show"),
}


def load_settings(path: str | Path, base: BuildSettings | None = None) -> BuildSettings:
    """The base (by default every default) with what the TOML file says. Raises InputError with the key at fault."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file of settings.")
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for settings.")
    try:
        table = tomllib.loads(path.read_bytes().decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as reason:
        raise InputError(f"{path}: this is not a readable TOML file ({reason}).") from reason
    return settings_of(table, str(path), base)


def settings_of(table: Mapping[str, Any], where: str, base: BuildSettings | None = None) -> BuildSettings:
    """The base with what the table says. where: what to call the table in a sentence.

    Raises InputError for a key that is not known, and a value of another type or out of range.
    """
    return _changed(base or BuildSettings(), table, "", where)


def settings_toml(settings: BuildSettings) -> str:
    """All settings with what they mean; `settings_of` reads them back."""
    return "\n".join(_lines(settings, "")) + "\n"


def settings_digest(settings: BuildSettings) -> str:
    """16 hexadecimal digits that name exactly these values."""
    return hashlib.sha256(json.dumps(as_table(settings), sort_keys=True).encode()).hexdigest()[:16]


def as_table(settings: Any) -> dict[str, Any]:
    """The same as plain tables, which JSON can hold."""
    return {
        one.name: as_table(value)
        if is_dataclass(value)
        else list(value)
        if isinstance(value, tuple)
        else value
        for one in fields(settings)
        for value in (getattr(settings, one.name),)
    }


def _changed(settings: Any, table: Mapping[str, Any], path: str, where: str) -> Any:
    known = {one.name: getattr(settings, one.name) for one in fields(settings)}
    changes = {}
    for name, value in table.items():
        here = f"{path}.{name}" if path else name
        if name not in known:
            inside = f"[{path}]" if path else "the settings"
            raise InputError(f"{where}: '{name}' is not known in {inside}; known are {', '.join(known)}.")
        if is_dataclass(known[name]):
            if not isinstance(value, Mapping):
                raise InputError(f"{where}: expected a table [{here}], not {value!r}.")
            changes[name] = _changed(known[name], value, here, where)
        else:
            changes[name] = _value(known[name], value, here, where)
    return replace(settings, **changes)


def _value(default: Any, value: Any, path: str, where: str) -> Any:
    """The value in the type of the default, within its range."""
    about = _about(path)
    if isinstance(default, tuple):
        if not isinstance(value, list) or not 1 <= len(value) <= 100:
            raise InputError(f"{where}: {path} should be a list of numbers, not {value!r}.")
        return tuple(_value(0.0, one, path, where) for one in value)
    if isinstance(default, bool | str):
        if type(value) is not type(default):
            kind = "true or false" if isinstance(default, bool) else "a text"
            raise InputError(f"{where}: {path} should be {kind}, not {value!r}.")
        if path == "completion" and value not in COMPLETIONS:
            raise InputError(
                f"{where}: the completion '{value}' is not known; known are {', '.join(COMPLETIONS)}."
            )
        return value
    whole = isinstance(default, int)
    if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
        raise InputError(f"{where}: {path} should be a {'whole ' if whole else ''}number, not {value!r}.")
    if not (math.isfinite(value) and about.least <= value <= about.most):
        raise InputError(
            f"{where}: {path} = {value} is out of range; expected {about.least:g} to {about.most:g}."
        )
    return value if whole else float(value)


def _about(path: str) -> _About:
    """By the whole path, or its end: steps share the names of what they have in common."""
    parts = path.split(".")
    ends = (".".join(parts[first:]) for first in range(len(parts)))
    return next((_ABOUT[end] for end in ends if end in _ABOUT), _About(""))


def _lines(settings: Any, path: str) -> list[str]:
    nested = []
    lines = [f"[{path}]"] if path else []
    if path in _SECTIONS:
        lines.insert(0, f"# {_SECTIONS[path]}")
    for one in fields(settings):
        value = getattr(settings, one.name)
        here = f"{path}.{one.name}" if path else one.name
        if is_dataclass(value):
            nested += ["", *_lines(value, here)]
        else:
            lines.append(f"{one.name} = {_toml(value)}  # {_about(here).meaning}")
    return lines + nested


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return f"[{', '.join(map(repr, value))}]" if isinstance(value, tuple) else repr(value)
