"""The session: everything known about one speaker's set-up, in a TOML file that a person can edit.

    model = "0123456789abcdef"        # fingerprint of the model that vertices and speaker belong to

    [coils]                           # file channel = role
    t_tip = "tongue_tip"

    [smoothing]                       # see `smoothing`
    preset = "carstens"               # or recorded.tongue = "butterworth 20 Hz order 5", live.tongue = "one-pole 20 Hz"

    [head]                            # where the reference coils are at rest, see `headcorrection`
    source = "rest 0:2 of sweep 12"
    [head.rest_mm]
    head_left = [71.2, 90.1, 30.8]

    [alignment]                       # model = rotation source + translation, then the projection
    axes = ["-y", "-x", "z"]          # or rotation = [[...], [...], [...]]
    translation_mm = [0.0, 0.0, 0.0]
    midsagittal = true
    source = "bite plane bp.pos, refined on 80 frames of sweep 12"

    [palate]                          # in the model's frame, see `palate`
    source = "palate sweep pal.pos"
    points_mm = [[0.0, 4.0, 6.5], [0.0, 8.0, 9.1]]

    [correspondences]                 # role = vertex
    tongue_tip = 2469

    [speaker]
    weights = [...]
    source = "mean of experiment 1 over sweep 12"

    [shapes]                          # avatar shape = what makes it 0 and what makes it 1
    tip_up = [0.4, 9.1]

    [energy]
    alpha = 1.0

Whatever is absent is estimated or has its default, and the tracker says which. A frame is smoothed, freed from
the head's motion, aligned, and projected, in this order.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import InputError
from .coilmap import checked_coil_map
from .headcorrection import HeadReference, head_from_toml, head_toml
from .palate import Palate, palate_from_toml, palate_toml
from .pose import FloatArray
from .smoothing import NO_SMOOTHING, Smoothing, smoothing_from_toml, smoothing_toml

MAX_SESSION_BYTES = 1024 * 1024
LARGEST_TERM = 1e12  # of the energy's weights: beyond, float64 loses the other terms
NO_SESSION = "no session file"
SHAPES_COMMENT = "avatar shape = what makes it 0 and what makes it 1: mm, degrees, or raw weight"
_ENDLESS_KEY = re.compile(r"^(?:[^.=\n]*\.){1000}", re.MULTILINE)
"""For a key of many parts tomllib's work grows with the square of their number."""


@dataclass(frozen=True)
class Alignment:
    """Rigid motion from the source's frame to the model frame: model = rotation @ source + translation.

    rotation: (3, 3), orthonormal; it mirrors where the source is left-handed, or where an axis of
    two-dimensional data, all zeros, is turned round; translation_mm: (3,). midsagittal: afterwards the
    lateral coordinate is set to 0, as the paper does with mid-sagittal coils. source: how it was found.
    """

    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    translation_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    midsagittal: bool = False
    source: str = ""

    @property
    def moves(self) -> bool:
        """Whether anything is turned or shifted, apart from the projection."""
        return not np.array_equal(self.rotation, np.eye(3)) or bool(self.translation_mm.any())

    @property
    def is_identity(self) -> bool:
        return not self.moves and not self.midsagittal

    def __str__(self) -> str:
        if self.is_identity:
            return "none: the recording is taken to be in the model's frame"
        parts = [f"rigid, translation {np.round(self.translation_mm, 2).tolist()} mm"] if self.moves else []
        return " and ".join(parts + (["projection into the mid-sagittal plane"] if self.midsagittal else []))


@dataclass(frozen=True)
class Energy:
    """The weights of the tracking energy (paper: alpha 1, beta = gamma = 5, box 5).

    alpha: data; beta_*: bias towards the mean weights; gamma_*: coherence with the previous frame,
    separately for speaker and pose; box: h, the widest allowed deviation in sigma.
    """

    alpha: float = 1.0
    beta_speaker: float = 5.0
    beta_pose: float = 5.0
    gamma_speaker: float = 5.0
    gamma_pose: float = 5.0
    box: float = 5.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            positive = name in ("alpha", "box")
            if not 0 <= value <= LARGEST_TERM or (positive and value == 0):
                least = "above 0" if positive else "0 or more"
                raise InputError(
                    f"[energy] {name} = {value}: expected a finite number, {least}, of at most {LARGEST_TERM:g}."
                )


@dataclass(frozen=True)
class Session:
    """What a session file states; None or empty = not stated.

    coils: channel -> role; correspondences: role -> vertex; speaker_weights: (m,) raw; shape_ranges: avatar shape ->
    (value for 0, value for 1), as `streams/shapes.py` measures it, which alone knows the shapes' names.
    """

    coils: Mapping[str, str] = field(default_factory=dict)
    alignment: Alignment = field(default_factory=Alignment)
    correspondences: Mapping[str, int] = field(default_factory=dict)
    speaker_weights: FloatArray | None = None
    speaker_source: str = ""
    energy: Energy = Energy()
    model_fingerprint: str = ""
    source: str = NO_SESSION
    smoothing: Smoothing = NO_SMOOTHING
    head: HeadReference | None = None
    palate: Palate | None = None
    shape_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def load_session(path: str | Path) -> Session:
    """Reads a session file. Raises InputError that names the table and key at fault."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such session file.")
    if path.stat().st_size > MAX_SESSION_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes are too many for a session file.")
    try:
        text = path.read_bytes().decode()
    except UnicodeDecodeError as reason:
        raise InputError(f"{path}: this is not readable TOML ({reason}).") from reason
    return parse_session(text, str(path))


def parse_session(text: str, source: str) -> Session:
    """A session from the text of a file. Raises InputError that names `source`, the table and the key at fault."""
    if _ENDLESS_KEY.search(text):
        raise InputError(f"{source}: a line has 1000 dots before any '='; a session file has no such keys.")
    try:
        content = tomllib.loads(text)
    except RecursionError as reason:
        raise InputError(f"{source}: this is nested too deeply to be a session file.") from reason
    except ValueError as reason:  # numbers of thousands of digits are refused by Python itself
        raise InputError(f"{source}: this is not readable TOML ({reason}).") from reason
    try:
        return _session_from(content, source)
    except InputError as reason:
        raise InputError(f"{source}: {reason}") from reason


def session_toml(session: Session) -> str:
    """The session as the text of a file; `load_session` gives it back unchanged."""
    import tomlkit

    document = tomlkit.document()
    if session.model_fingerprint:
        document.add("model", tomlkit.item(session.model_fingerprint))
        document["model"].comment("the model that vertices and speaker belong to")
    _add_table(document, "coils", "file channel = role", dict(session.coils))
    if session.smoothing != NO_SMOOTHING:
        _add_table(document, "smoothing", "before anything else", smoothing_toml(session.smoothing))
    if session.head is not None:
        _add_table(
            document, "head", "the reference coils at rest, in the device's axes", head_toml(session.head)
        )
    alignment = session.alignment
    stated: dict[str, Any] = {
        "rotation": alignment.rotation.tolist(),
        "translation_mm": alignment.translation_mm.tolist(),
        "midsagittal": alignment.midsagittal,
    }
    if alignment.source:
        stated["source"] = alignment.source
    _add_table(document, "alignment", "model = rotation source + translation, then the projection", stated)
    if session.palate is not None:
        _add_table(document, "palate", "in the model's frame", palate_toml(session.palate))
    _add_table(document, "correspondences", "role = vertex", dict(session.correspondences))
    if session.speaker_weights is not None:
        speaker = {"weights": session.speaker_weights.tolist(), "source": session.speaker_source}
        _add_table(document, "speaker", "raw weights of the anatomy", speaker)
    if session.shape_ranges:
        ranges = {name: list(pair) for name, pair in session.shape_ranges.items()}
        _add_table(document, "shapes", SHAPES_COMMENT, ranges)
    energy = {name: getattr(session.energy, name) for name in Energy.__dataclass_fields__}
    _add_table(document, "energy", "weights of the terms; box in sigma", energy)
    return tomlkit.dumps(document)


def with_shape_ranges(text: str, ranges: Mapping[str, tuple[float, float]]) -> str:
    """The text of a session file with these ranges as its table [shapes]; everything else, comments too, as it was."""
    import tomlkit

    document = tomlkit.parse(text)
    table = tomlkit.table()
    table.comment(SHAPES_COMMENT)
    for name, pair in ranges.items():
        table.add(name, list(pair))
    document["shapes"] = table
    return tomlkit.dumps(document)


def _add_table(document: Any, name: str, comment: str, content: Mapping[str, Any]) -> None:
    import tomlkit

    table = tomlkit.table()
    table.comment(comment)
    for key, value in content.items():
        table.add(key, value)
    document.add(name, table)


def _session_from(content: Mapping[str, Any], source: str) -> Session:
    known = {
        "model",
        "coils",
        "smoothing",
        "head",
        "alignment",
        "palate",
        "correspondences",
        "speaker",
        "shapes",
        "energy",
    }
    for table in content:
        if table not in known:
            raise InputError(f"the table or key '{table}' is unknown; expected {', '.join(sorted(known))}.")
    coils = {str(k): _text(v, f"[coils] {k}") for k, v in _table(content, "coils").items()}
    if coils:
        checked_coil_map(coils, "[coils]")
    correspondences = {
        str(k): _integer(v, f"[correspondences] {k}") for k, v in _table(content, "correspondences").items()
    }
    speaker = _table(content, "speaker")
    _only(speaker, {"weights", "source"}, "speaker")
    weights = _numbers(speaker["weights"], None, "[speaker] weights") if "weights" in speaker else None
    energy = _table(content, "energy")
    _only(energy, set(Energy.__dataclass_fields__), "energy")
    return Session(
        coils,
        _alignment(_table(content, "alignment")),
        correspondences,
        weights,
        _text(speaker.get("source", ""), "[speaker] source"),
        Energy(**{name: _number(value, f"[energy] {name}") for name, value in energy.items()}),
        _text(content.get("model", ""), "model"),
        source,
        smoothing_from_toml(_table(content, "smoothing")) if "smoothing" in content else NO_SMOOTHING,
        head_from_toml(_table(content, "head")) if "head" in content else None,
        palate_from_toml(_table(content, "palate")) if "palate" in content else None,
        {str(name): _range(pair, f"[shapes] {name}") for name, pair in _table(content, "shapes").items()},
    )


def _range(pair: Any, where: str) -> tuple[float, float]:
    low, high = _numbers(pair, (2,), where).tolist()
    if low >= high:
        raise InputError(f"{where} = [{low:g}, {high:g}]: expected the value for 0 and a larger one for 1.")
    return low, high


def _alignment(table: Mapping[str, Any]) -> Alignment:
    _only(table, {"axes", "rotation", "translation_mm", "midsagittal", "source"}, "alignment")
    if "axes" in table and "rotation" in table:
        raise InputError("[alignment] has both 'axes' and 'rotation'; keep one of them.")
    rotation = np.eye(3)
    if "axes" in table:
        rotation = axis_mapping(table["axes"])
    elif "rotation" in table:
        rotation = _numbers(table["rotation"], (3, 3), "[alignment] rotation")
        small = (np.abs(rotation) < 2.0).all()  # else the products may overflow
        if not small or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise InputError(
                "[alignment] rotation is not orthonormal; scale and shear are not part of an alignment."
            )
    translation = _numbers(table.get("translation_mm", [0.0, 0.0, 0.0]), (3,), "[alignment] translation_mm")
    midsagittal = table.get("midsagittal", False)
    if not isinstance(midsagittal, bool):
        raise InputError(f"[alignment] midsagittal = {midsagittal!r}: expected true or false.")
    return Alignment(rotation, translation, midsagittal, _text(table.get("source", ""), "[alignment] source"))


def axis_mapping(axes: Any) -> FloatArray:
    """(3, 3) from three signed axis names: ["-y", "x", "z"] makes the model's x the source's -y."""
    names = [str(axis).strip().lower() for axis in axes] if isinstance(axes, (list, tuple)) else []
    plain = [name.lstrip("+-") for name in names]
    if sorted(plain) != ["x", "y", "z"] or any(len(name) - len(bare) > 1 for name, bare in zip(names, plain)):
        raise InputError(
            f"[alignment] axes = {axes!r}: expected three of x, y, z, each once, with a sign where the axis "
            'is turned round, as in ["y", "-x", "z"].'
        )
    matrix = np.zeros((3, 3))
    for row, (name, bare) in enumerate(zip(names, plain)):
        matrix[row, "xyz".index(bare)] = -1.0 if name.startswith("-") else 1.0
    return matrix


def _table(content: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = content.get(name, {})
    if not isinstance(table, dict):
        raise InputError(f"'{name}' should be a table, [{name}].")
    return table


def _only(table: Mapping[str, Any], known: set[str], name: str) -> None:
    for key in table:
        if key not in known:
            raise InputError(f"[{name}] has the unknown key '{key}'; expected {', '.join(sorted(known))}.")


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{where} = {value!r}: expected text in quotes.")
    return value


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where} = {value!r}: expected a number.")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{where}: the number is too large.") from None


def _integer(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"{where} = {value!r}: expected a whole number, the index of a vertex.")
    return value


def _numbers(values: Any, shape: tuple[int, ...] | None, where: str) -> FloatArray:
    """shape: the one it must have; None = a list of at least one."""
    try:
        listed = np.array(values)
    except ValueError as reason:  # rows of different lengths
        raise InputError(f"{where}: expected numbers only.") from reason
    if listed.dtype.kind not in "fiu" and listed.size:
        raise InputError(f"{where}: expected numbers only.")
    array = listed.astype(np.float64)
    fits = array.shape == shape if shape else array.ndim == 1 and array.size > 0
    if not np.isfinite(array).all() or not fits:
        wanted = f" in the shape {shape}" if shape else " in one list"
        raise InputError(f"{where}: expected finite numbers{wanted}.")
    return array
