"""What an installation holds: built, unpacked and installed for real, without touching the checkout.

Nothing is downloaded: the build runs with this environment's setuptools, and the fresh environments borrow
this one's libraries. `.ci/run` installs with everything downloaded.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import tonguetrack

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS: dict[str, str] = PYPROJECT["tool"]["setuptools"]["package-dir"]
VERSION = tonguetrack.__version__


def run(*command: object, cwd: Path, **environment: str) -> str:
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP_"))}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd, env={**clean, **environment}, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
    return done.stdout


def copied_tree(target: Path) -> Path:
    """The checkout's files as they are now, without what building and running leave behind."""
    left_behind = shutil.ignore_patterns("__pycache__", ".*", "*.egg-info", "build", "dist")
    shutil.copytree(ROOT, target, ignore=left_behind)
    return target


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with an sdist, the wheel made from it, and in `direct/` the wheel made from the tree itself."""
    pytest.importorskip("build", reason="building needs the extra 'dev'")
    folder = tmp_path_factory.mktemp("built")
    tree = copied_tree(folder / "tree")
    build = [sys.executable, "-m", "build", "--no-isolation"]
    run(*build, "--outdir", folder / "dist", tree, cwd=folder)
    shutil.rmtree(tree / "build", ignore_errors=True)  # setuptools would take what is left there along
    run(*build, "--wheel", "--outdir", folder / "dist" / "direct", tree, cwd=folder)
    return folder / "dist"


def wheel_of(folder: Path) -> Path:
    (wheel,) = folder.glob("*.whl")
    return wheel


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}


def fresh_environment(folder: Path) -> Path:
    """A new virtual environment that finds this one's libraries, but not this one's tonguetrack."""
    venv.create(folder, with_pip=False)
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    libraries = folder / "libraries"
    libraries.mkdir()
    for place in {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}:
        for entry in Path(place).iterdir():
            if "tonguetrack" not in entry.name.lower() and entry.suffix != ".pth":
                (libraries / entry.name).symlink_to(entry)
    Path(site, "libraries.pth").write_text(f"{libraries}\n", encoding="utf-8")
    return python


def pip(python: Path, *arguments: object, cwd: Path) -> None:
    run(sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check", "install", "--quiet",
        "--no-deps", "--no-index", *arguments, cwd=cwd)  # fmt: skip


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """The python of an environment in which the wheel is installed normally."""
    folder = tmp_path_factory.mktemp("installed")
    python = fresh_environment(folder / "venv")
    pip(python, wheel_of(built), cwd=folder)
    return python


# The wheel ------------------------------------------------------------------------------------------


def test_the_wheel_holds_our_package_and_nothing_beside_it(built):
    names = set(contents(wheel_of(built)))
    tops = {name.split("/")[0] for name in names}
    assert tops == {"tonguetrack", f"tonguetrack-{VERSION}.dist-info"}
    assert not [name for name in names if name.endswith((".pyc", ".nbi", ".nbc", ".orig", "~"))]


PACKAGES_WITH_DATA = (
    "tonguetrack.model.data",
    "tonguetrack.recordings",
    "tonguetrack.tracker.preferencepage",
    "tonguetrack.tracker.streams.page",
    "tonguetrack.tracker.streams.presets",
)


def test_the_wheel_holds_every_module_and_data_file_of_the_tree(built):
    expected = {"tonguetrack/py.typed"}
    for package, folder in FOLDERS.items():
        place = package.replace(".", "/")
        data = package in PACKAGES_WITH_DATA
        expected |= {
            f"{place}/{file.name}"
            for file in (ROOT / folder).iterdir()
            if file.is_file() and not file.name.startswith(".") and (data or file.suffix == ".py")
        }
    names = {name for name in contents(wheel_of(built)) if name.startswith("tonguetrack/")}
    assert names == expected
    assert {
        "tonguetrack/model/data/default.npz",
        "tonguetrack/recordings/demo.csv",
        "tonguetrack/tracker/streams/page/three.bundle.js",
        "tonguetrack/tracker/streams/presets/arkit.toml",
    } <= names


def test_the_wheel_is_small(built):
    assert wheel_of(built).stat().st_size < 5_000_000


def test_the_metadata_name_licence_command_and_python(built):
    files = contents(wheel_of(built))
    information = f"tonguetrack-{VERSION}.dist-info"
    assert files[f"{information}/licenses/LICENSE"] == (ROOT / "LICENSE").read_bytes()
    metadata = Parser().parsestr(files[f"{information}/METADATA"].decode())
    assert metadata["Version"] == VERSION
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata.get_payload().startswith("# tonguetrack")
    entry_points = files[f"{information}/entry_points.txt"].decode()
    assert "tonguetrack = tonguetrack.tracker.cli:main" in entry_points


def test_an_sdist_gives_the_same_wheel_as_the_tree(built):
    through_sdist, direct = contents(wheel_of(built)), contents(wheel_of(built / "direct"))
    assert through_sdist.keys() == direct.keys()
    for name, content in direct.items():
        assert through_sdist[name] == content, name


def test_the_sdist_holds_licence_and_readme(built):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {
        "LICENSE",
        "README.md",
        "pyproject.toml",
        "recordings/demo.csv",
        "model/data/default.npz",
    } <= names


def test_versions_agree():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"[{VERSION}]" in changelog or f"To become {VERSION}" in changelog


# Installed ------------------------------------------------------------------------------------------


def test_the_installed_command_answers(installed, tmp_path):
    command = installed.parent / "tonguetrack"
    assert run(command, "--version", cwd=tmp_path) == f"tonguetrack {VERSION}\n"
    assert run(installed, "-c", "import tonguetrack; print(tonguetrack.__file__)", cwd=tmp_path).startswith(
        str(installed.parents[1])
    )


def test_the_installed_package_adds_no_generic_names(installed, tmp_path):
    for name in ("model", "drivers", "tracker", "recordings"):
        found = run(
            installed, "-c", f"import importlib.util as u; print(u.find_spec('{name}'))", cwd=tmp_path
        )
        assert found == "None\n", name


def test_the_installed_package_finds_its_bundled_files(installed, tmp_path):
    script = (
        "from tonguetrack.tracker.bundled import bundled_model, bundled_recording\n"
        "recording, session = bundled_recording()\n"
        "print(recording.frame_count > 0, session.model_fingerprint == bundled_model().fingerprint)\n"
    )
    assert run(installed, "-c", script, cwd=tmp_path) == "True True\n"


def test_recordings_open_in_spawned_processes(installed, tmp_path):
    """Spawned workers import everything anew, by name: nothing may depend on how the parent was started."""
    (tmp_path / "many.py").write_text(
        "import multiprocessing, sys\n"
        "from tonguetrack import open_recording\n"
        "if __name__ == '__main__':\n"
        "    with multiprocessing.get_context('spawn').Pool(2) as pool:\n"
        "        recordings = pool.map(open_recording, [sys.argv[1]] * 2)\n"
        "    print([recording.frame_count for recording in recordings])\n",
        encoding="utf-8",
    )
    printed = run(installed, "many.py", ROOT / "recordings" / "demo.csv", cwd=tmp_path)
    first, second = printed.strip("[]\n").split(", ")
    assert first == second and int(first) > 0


def test_an_editable_installation_sees_the_tree_and_its_new_files(built, tmp_path):
    tree = copied_tree(tmp_path / "tree")
    python = fresh_environment(tmp_path / "venv")
    pip(python, "--no-build-isolation", "--editable", tree, cwd=tmp_path)
    where = "import tonguetrack.model.mesh as m; print(m.__file__)"
    assert run(python, "-c", where, cwd=tmp_path).strip() == str(tree / "model" / "mesh.py")
    (tree / "tracker" / "brand_new.py").write_text("ANSWER = 42\n", encoding="utf-8")
    script = "from tonguetrack.tracker.brand_new import ANSWER; print(ANSWER)"
    assert run(python, "-c", script, cwd=tmp_path) == "42\n"
    assert run(python.parent / "tonguetrack", "--version", cwd=tmp_path) == f"tonguetrack {VERSION}\n"
