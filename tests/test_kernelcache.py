"""Where compiled kernels are, which modules have some, and where they go when nothing is writable."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tonguetrack.tracker import kernelcache

ROOT = Path(__file__).parent.parent
ASK = """
import os, sys
from pathlib import Path
package, home = Path(sys.argv[1]), Path(sys.argv[2])
from tonguetrack.tracker import kernelcache
os.environ.pop("NUMBA_CACHE_DIR", None)
os.environ["XDG_CACHE_HOME"] = str(home / "cache")
kernelcache._PACKAGE = package
may = os.access
os.access = lambda path, mode: not str(path).startswith((sys.argv[3], str(package))) and may(path, mode)
kernelcache.ensure_a_writable_cache()
print(os.environ.get("NUMBA_CACHE_DIR"), kernelcache.cache_lasts())
"""


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="the home folder's cache is elsewhere")
def test_a_folder_of_its_own_only_where_neither_package_nor_home_can_be_written(tmp_path):
    (tmp_path / "package").mkdir()
    (tmp_path / "home").mkdir()

    def asked(locked: Path) -> list[str]:
        arguments = [sys.executable, "-c", ASK, tmp_path / "package", tmp_path / "home", locked]
        return subprocess.run(
            [str(part) for part in arguments], capture_output=True, text=True, check=True
        ).stdout.split()

    assert asked(tmp_path / "nothing") == ["None", "True"]
    folder, lasts = asked(tmp_path)
    assert lasts == "False"
    assert Path(folder).name.startswith("tonguetrack-")
    assert not Path(folder).exists()  # it went with its process


def test_a_folder_that_was_named_is_left_alone(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/named")
    monkeypatch.setattr(kernelcache, "_can_be_made", lambda folder: False)
    kernelcache.ensure_a_writable_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == "/named"


def test_every_module_that_compiles_is_known():
    compiling = set()
    for path in (path for room in ("model", "drivers", "tracker") for path in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            decorators = node.decorator_list if isinstance(node, ast.FunctionDef) else []
            if any(re.search("jit|vectorize|cfunc", ast.unparse(decorator)) for decorator in decorators):
                compiling.add(path.relative_to(ROOT).with_suffix("").as_posix().replace("/", "."))
    assert compiling == set(kernelcache.KERNEL_MODULES)


COMPILE = """
from tonguetrack.tracker import filters, kernelcache
folder = kernelcache.cache_folder()
print(kernelcache.compilations(), "tracker.filters" in kernelcache.modules_to_compile(folder))
filters._weight_of_newest(2.0, 0.004)
print(kernelcache.compilations(), "tracker.filters" in kernelcache.modules_to_compile(folder))
"""


def test_what_had_to_be_compiled_is_counted_and_found_by_the_next_start(tmp_path):
    def told() -> list[str]:
        environment = {**os.environ, kernelcache.VARIABLE: str(tmp_path)}
        command = [sys.executable, "-c", COMPILE]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, env=environment
        ).stdout.splitlines()

    assert told() == ["0 True", "1 False"]
    assert told() == ["0 False", "0 False"]
