"""Settings of `mri build`: all of them are said, read back, and refused where they make no sense."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import is_dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tonguetrack import InputError
from tonguetrack.model.mri.settings import (
    BuildSettings,
    as_table,
    load_settings,
    settings_of,
    settings_toml,
)
from tonguetrack.tracker.cli import main


def values(table, path=()):
    for name, value in table.items():
        if isinstance(value, dict):
            yield from values(value, (*path, name))
        else:
            yield (*path, name), value


def nested(path, value):
    return {path[0]: nested(path[1:], value)} if path else value


EVERY = list(values(as_table(BuildSettings())))


def test_what_is_printed_is_read_back():
    assert settings_of(tomllib.loads(settings_toml(BuildSettings())), "text") == BuildSettings()


def test_json_holds_them_all():
    assert settings_of(json.loads(json.dumps(as_table(BuildSettings()))), "text") == BuildSettings()


def test_every_setting_is_printed_with_what_it_means():
    lines = [line for line in settings_toml(BuildSettings()).splitlines() if line and line[0] not in "#["]
    assert len(lines) == len(EVERY)
    for line in lines:
        assert line.partition("  # ")[2], line


@pytest.mark.parametrize("path, value", EVERY, ids=[".".join(path) for path, _ in EVERY])
def test_every_setting_keeps_its_type_and_range(path, value):
    assert settings_of(nested(path, value), "text") == BuildSettings()
    wrong = {"a": 1}
    far = -1e12 if type(value) is float else -(10**12)
    if type(value) in (bool, str):
        refused = [wrong, "no such word", 1]
    else:
        refused = [wrong, "text", True, [far] if isinstance(value, list) else far]
        refused += [] if isinstance(value, list) else [float("nan"), float("inf")]
    for bad in refused:
        with pytest.raises(InputError, match=path[-1]):
            settings_of(nested(path, bad), "text")


def test_only_what_is_said_differs(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text("rounds = 2\n[tongue.rule]\nradius_mm = 5\n")
    changed = load_settings(path)
    assert changed.rounds == 2 and changed.tongue.rule.radius_mm == 5.0
    assert changed.tongue.rule.angle_deg == BuildSettings().tongue.rule.angle_deg
    assert changed.palate == BuildSettings().palate


def test_the_docs_example_is_understood_and_its_table_of_defaults_is_right():
    text = (Path(__file__).resolve().parents[1] / "docs" / "mri-build.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    assert settings_of(tomllib.loads(example), "text") != BuildSettings()
    rows = dict(re.findall(r"^\| `(\w+\.?\w*)` \| [^|]* \| ([^|]*) \|", text, re.MULTILINE))
    usual = BuildSettings()
    assert float(rows["tongue_prior.h"]) == usual.tongue_prior.h
    assert rows["completion"] == usual.completion
    assert rows["contact.everywhere"] == str(usual.contact.everywhere).lower()
    matching = f"{usual.tongue.smoothness:g} to {usual.tongue.least_smoothness:g} and "
    matching += f"{usual.palate.smoothness:g} to {usual.palate.least_smoothness:g}, "
    matching += f"{usual.tongue.rule.radius_mm:g} to {usual.tongue.last_rule.radius_mm:g} mm"
    assert f"| {matching} |" in text


@pytest.mark.parametrize(
    "text, said",
    [
        ("round = 2", "'round' is not known"),
        ("[tongue]\nstiff = 2", r"not known in \[tongue\]"),
        ("tongue = 2", r"table \[tongue\]"),
        ('completion = "magic"', "magic"),
        ("rounds = 1\nrounds = 2", "TOML"),
    ],
)
def test_what_cannot_be_understood_is_named(tmp_path, text, said):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        load_settings(path)
    assert str(path) in str(caught.value)


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
                    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from([
                        "rounds", "tongue", "rule", "radius_mm", "alignment", "shifts_mm", "completion"]), inner)))  # fmt: skip
def test_any_table_is_settings_or_a_sentence(table):
    try:
        assert is_dataclass(settings_of(table if isinstance(table, dict) else {"rounds": table}, "text"))
    except InputError as reason:
        assert str(reason).startswith("text: ")


def test_the_command_prints_those_that_a_build_would_use(tmp_path, capsys):
    path = tmp_path / "s.toml"
    path.write_text("rounds = 2\n")
    assert main(["mri", "build", "--print-settings", "--settings", str(path), "--pose-modes", "3"]) == 0
    printed = tomllib.loads(capsys.readouterr().out)
    assert printed["rounds"] == 2 and printed["model"]["pose_modes"] == 3
