"""Who may import whom, what the package consists of, and what starting the command line costs.

The source is parsed, not imported: what a function imports when it is called counts as much as what
stands at the top of a file.
"""

import ast
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGE_FOLDERS: dict[str, str] = PYPROJECT["tool"]["setuptools"]["package-dir"]
ROOMS = ("drivers", "model", "tracker", "recordings", "tonguetrack")


@dataclass(frozen=True)
class Import:
    """module: the dotted name that is imported; line: where; at_start: not inside a function or TYPE_CHECKING."""

    module: str
    line: int
    at_start: bool


@dataclass(frozen=True)
class Source:
    """One module of ours: its dotted name, its file, and everything of ours that it imports."""

    name: str
    path: Path
    tree: ast.Module
    imports: tuple[Import, ...]
    absolute: tuple[Import, ...]


def sources() -> dict[str, Source]:
    files = {}
    for package, folder in PACKAGE_FOLDERS.items():
        for path in sorted((ROOT / folder).glob("*.py")):
            files[package if path.stem == "__init__" else f"{package}.{path.stem}"] = path
    return {name: read_source(name, path, set(files)) for name, path in files.items()}


def read_source(name: str, path: Path, known: set[str]) -> Source:
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    ours: list[Import] = []
    absolute: list[Import] = []
    late = {id(node) for node in late_nodes(tree)}
    for node in ast.walk(tree):
        at_start = id(node) not in late
        if isinstance(node, ast.Import):
            for alias in node.names:
                absolute.append(Import(alias.name, node.lineno, at_start))
        elif isinstance(node, ast.ImportFrom) and not node.level:
            absolute.append(Import(node.module or "", node.lineno, at_start))
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1] + ([node.module] if node.module else []))
            for alias in node.names:
                child = f"{base}.{alias.name}"
                ours.append(Import(child if child in known else base, node.lineno, at_start))
    return Source(name, path, tree, tuple(ours), tuple(absolute))


def late_nodes(tree: ast.Module):
    """Everything inside a function, and what only a type checker sees."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from ast.walk(node)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            for statement in node.body:
                yield from ast.walk(statement)


SOURCES = sources()


def within(module: str, *packages: str) -> bool:
    return any(module == package or module.startswith(package + ".") for package in packages)


def offences(rows: list[str]) -> None:
    assert not rows, "\n" + "\n".join(rows)


# Who may import whom --------------------------------------------------------------------------------

ROOT_MODULES = ("tonguetrack", "tonguetrack.atomic", "tonguetrack.archive", "tonguetrack.parallel")
CORE = tuple(
    name
    for name in SOURCES
    if within(name, "tonguetrack.tracker")
    and not within(
        name,
        "tonguetrack.tracker.cli",
        "tonguetrack.tracker.streams",
        "tonguetrack.tracker.viewer",
        "tonguetrack.tracker.preferenceserver",
    )
)


def test_the_sources_were_found():
    assert {"tonguetrack.drivers.frames", "tonguetrack.model.build", "tonguetrack.tracker.kernels"} <= set(
        SOURCES
    )


@pytest.mark.parametrize("room", ["drivers", "model"])
def test_drivers_and_model_know_of_nothing_else_of_ours(room):
    offences(
        [
            f"{source.path}:{found.line} imports {found.module}"
            for source in SOURCES.values()
            if within(source.name, f"tonguetrack.{room}")
            for found in source.imports
            if not within(found.module, f"tonguetrack.{room}") and found.module not in ROOT_MODULES
        ]
    )


def test_the_root_package_imports_no_room_by_statement():
    offences(
        [
            f"{source.path}:{found.line} imports {found.module}"
            for name, source in SOURCES.items()
            if name in ROOT_MODULES
            for found in source.imports
            if found.module not in ROOT_MODULES
        ]
    )


def test_the_trackers_core_never_imports_the_command_line():
    offences(
        [
            f"{source.path}:{found.line} imports {found.module}"
            for source in SOURCES.values()
            if not within(source.name, "tonguetrack.tracker.cli")
            for found in source.imports
            if within(found.module, "tonguetrack.tracker.cli")
        ]
    )


def test_streams_know_models_and_poses_but_not_how_poses_are_made():
    """The page's server runs in a process of its own, where it has to load the model and the session itself."""
    allowed = ["tonguetrack.model"]
    allowed += [f"tonguetrack.tracker.{name}" for name in ("pose", "latency", "control", "streams", "gltf")]
    for_the_page = [f"tonguetrack.tracker.{name}" for name in ("bundled", "session")]
    offences(
        [
            f"{source.path}:{found.line} imports {found.module}"
            for source in SOURCES.values()
            if within(source.name, "tonguetrack.tracker.streams")
            for found in source.imports
            if not within(found.module, *allowed) and found.module not in ROOT_MODULES
            if not (within(source.name, "tonguetrack.tracker.streams.page") and found.module in for_the_page)
        ]
    )


def test_the_viewer_knows_nothing_of_how_poses_are_made():
    solving = ("kernels", "solver", "online", "tracking", "live", "guard", "preparation", "setup", "cli")
    offences(
        [
            f"{source.path}:{found.line} imports {found.module}"
            for source in SOURCES.values()
            if within(source.name, "tonguetrack.tracker.viewer")
            for found in source.imports
            if within(found.module, *(f"tonguetrack.tracker.{name}" for name in solving))
        ]
    )


def test_only_the_live_loop_its_status_and_its_measurement_know_of_streams():
    """The tracker's results flow to the streams; nothing that computes them looks back."""
    loop = {f"tonguetrack.tracker.{name}" for name in ("live", "rehearsal", "status", "bench")}
    offences(
        [
            f"{SOURCES[name].path}:{found.line} imports {found.module}"
            for name in CORE
            if name not in loop
            for found in SOURCES[name].imports
            if within(
                found.module,
                "tonguetrack.tracker.streams",
                "tonguetrack.tracker.live",
                "tonguetrack.tracker.viewer",
            )
        ]
    )


def test_the_kernels_know_nothing_of_ours():
    assert SOURCES["tonguetrack.tracker.kernels"].imports == ()


def test_no_modules_import_each_other_in_a_circle():
    graph = {
        name: sorted({found.module for found in source.imports if found.at_start and found.module != name})
        for name, source in SOURCES.items()
    }
    finished: set[str] = set()

    def circle_from(name: str, way: list[str]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name in finished:
            return []
        for target in graph.get(name, ()):
            if found := circle_from(target, [*way, name]):
                return found
        finished.add(name)
        return []

    for name in graph:
        # A package's own parts import its root for InputError; the root names no part at module level.
        assert not (found := circle_from(name, [])), " -> ".join(found)


def test_imports_between_our_folders_are_relative():
    offences(
        [
            f"{source.path}:{found.line} imports {found.module}"
            for source in SOURCES.values()
            for found in source.absolute
            if found.module.split(".")[0] in ROOMS
        ]
    )


def test_commands_import_their_work_only_when_they_run():
    """The heavy libraries, and our modules that need them, come inside the handlers."""
    light = {"argparse", "collections", "contextlib", "dataclasses", "json", "os", "pathlib", "re", "shutil"}
    light |= {"__future__", "signal", "sys", "threading", "time", "types", "typing"}
    parser_modules = {
        f"tonguetrack.tracker.cli.{name}" for name in family_names(SOURCES["tonguetrack.tracker.cli"].tree)
    }
    offences(
        [
            f"{SOURCES[name].path}:{found.line} imports {found.module} before its command runs"
            for name in sorted(parser_modules & set(SOURCES))
            for found in SOURCES[name].absolute
            if found.at_start and found.module.split(".")[0] not in light
        ]
    )


def family_names(tree: ast.Module) -> set[str]:
    """The modules that build_parser takes commands from."""
    return {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.level == 1 and not node.module
        for alias in node.names
    }


# What the package consists of -----------------------------------------------------------------------


def test_every_package_on_disk_is_listed_and_every_listed_one_exists():
    """Automatic discovery does not work with mapped folders: one that is not listed would not be installed."""
    on_disk = {
        folder.relative_to(ROOT).as_posix()
        for room in ROOMS
        for folder in [ROOT / room, *(ROOT / room).rglob("*")]
        if folder.is_dir() and folder.name != "__pycache__" and any(folder.glob("*.py"))
    }
    assert set(PACKAGE_FOLDERS.values()) == on_disk
    assert sorted(PYPROJECT["tool"]["setuptools"]["packages"]) == sorted(PACKAGE_FOLDERS)
    for package, folder in PACKAGE_FOLDERS.items():
        expected = "tonguetrack" if folder == "tonguetrack" else "tonguetrack." + folder.replace("/", ".")
        assert package == expected
        assert (ROOT / folder / "__init__.py").is_file(), folder


def test_every_public_name_is_where_the_root_says():
    import tonguetrack

    assert set(tonguetrack._HOME_OF) | {"InputError", "__version__"} == set(tonguetrack.__all__)
    for name in tonguetrack.__all__:
        assert getattr(tonguetrack, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = tonguetrack.nothing


@pytest.mark.parametrize("room", ["drivers", "model", "tracker"])
def test_a_folder_imported_by_its_bare_name_says_what_to_import_instead(room):
    """From the checkout's root, `import model` would make a second copy of every module."""
    done = subprocess.run(
        [sys.executable, "-c", f"import {room}"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError") and f"import tonguetrack.{room}" in last


# What starting costs --------------------------------------------------------------------------------

HEAVY = ("numpy", "numba", "scipy", "trimesh", "rich", "yaml", "tomlkit", "pythonosc", "matplotlib")


@pytest.mark.parametrize(
    "arguments", [["--version"], ["--help"], ["track", "--help"], ["model", "build", "--help"]]
)
def test_help_and_version_load_no_heavy_library(arguments):
    script = (
        "import sys\n"
        "from tonguetrack.tracker.cli import main\n"
        f"try: main({arguments!r})\n"
        "except SystemExit as end: code = end.code\n"
        f"print('loaded:', [name for name in {HEAVY!r} if name in sys.modules], code, file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stderr.strip().splitlines()[-1] == "loaded: [] 0"
    assert done.stdout.strip()


# What must not be in the tree -----------------------------------------------------------------------


def test_nothing_is_unpickled_evaluated_or_handed_to_a_shell():
    found = []
    for source in SOURCES.values():
        for statement in source.absolute:
            if statement.module.split(".")[0] in ("pickle", "marshal", "shelve", "dill", "cloudpickle"):
                found.append(f"{source.path}:{statement.line} imports {statement.module}")
        for node in ast.walk(source.tree):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                if called in (
                    "eval",
                    "exec",
                    "compile",
                    "__import__",
                    "os.system",
                    "os.popen",
                    "yaml.unsafe_load",
                ):
                    found.append(f"{source.path}:{node.lineno} calls {called}")
                if called in ("np.load", "numpy.load"):
                    found.append(
                        f"{source.path}:{node.lineno} calls {called}; tonguetrack.archive checks lengths"
                    )
                for keyword in node.keywords:
                    if keyword.arg in ("shell", "allow_pickle") and ast.unparse(keyword.value) != "False":
                        found.append(f"{source.path}:{node.lineno} passes {keyword.arg}")
    offences(found)


def tracked_files() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode != 0:
        pytest.skip("this copy of the project is not a git checkout")
    return [ROOT / name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()]


def test_no_file_names_a_place_on_somebodys_machine():
    """An absolute path below a home folder, or beside this checkout, works on one machine only."""
    here = {ROOT.parts[1], Path.home().parts[1]} - {"tmp", "usr", "var"}
    places = "|".join([r"home/\w", "Users", *sorted(re.escape(name) + r"/[\w.]" for name in here)])
    pattern = re.compile(rf"(?<![\w./-])/(?:{places})")
    offences(
        [
            f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}"
            for path in tracked_files()
            if path.suffix in (".py", ".md", ".toml", ".yml", ".yaml", ".csv", ".json", "")
            and path.name != "LICENSE"
            for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
            if pattern.search(line)
        ]
    )


def test_the_checkout_is_small():
    """Sample data are kept small; the reference data and what is computed from them never come in."""
    sizes = {path.relative_to(ROOT).as_posix(): path.stat().st_size for path in tracked_files()}
    assert sum(sizes.values()) < 20_000_000, sorted(sizes.items(), key=lambda item: -item[1])[:5]
