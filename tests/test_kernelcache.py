"""Where compiled kernels go when nothing is writable."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tonguetrack.tracker import kernelcache

ASK = """
import os, sys
from pathlib import Path
package, home = Path(sys.argv[1]), Path(sys.argv[2])
from tonguetrack.tracker import kernelcache
os.environ.pop("NUMBA_CACHE_DIR", None)
os.environ["XDG_CACHE_HOME"] = str(home / "cache")
kernelcache.__file__ = str(package / "kernelcache.py")
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
