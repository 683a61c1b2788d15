"""The README and the pages in docs: every command in them runs somewhere, every link leads somewhere.

`README` and `DOCS` below say how each command is run. A command that is not listed fails the test, and so
does a line here that no page contains any more.
"""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import zipfile
from dataclasses import fields
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
SAMPLES = (
    "recordings/demo.csv",
    "recordings/demo.palate.csv",
    "recordings/demo.session.toml",
    "model/data/default.npz",
)

BY_CI = "by .ci/run, word for word"
HERE = "here, in a folder of its own, in the order of the page"
WITH_REFERENCE = "here, where the reference data are"
ELSEWHERE = "by another test: "

WAVE = ".venv/bin/tonguetrack live rtc3d://192.168.0.10"
FIRST_TAKE = ".venv/bin/tonguetrack live simulate: --seconds 5 --record first.xdf"
SIMULATED = ".venv/bin/tonguetrack simulate device "
TRACK_DEMO = ".venv/bin/tonguetrack track recordings/demo.csv --session recordings/demo.session.toml"
RENDER_DEMO = ".venv/bin/tonguetrack render demo.poses.csv --session recordings/demo.session.toml"
DEMO = ".venv/bin/tonguetrack demo --seconds 5 --to "
WITHOUT_END = ELSEWHERE + "test_window.py and test_page_browser.py, and .ci/run for some seconds"
BY_PREFERENCE = ELSEWHERE + "test_mri_preference.py and test_preference_page.py"
HEADS = ".venv/bin/tonguetrack mri phantom heads --speakers 1 --seed 7"
BY_MODEL_TESTS = ELSEWHERE + "test_model_evaluation.py, with fewer samples"
BY_CORPUS_TESTS = ELSEWHERE + "test_corpus.py, with dask's own local cluster"
BY_FAULTS = ELSEWHERE + "test_cli_live_devices.py and the simulators' own tests: it runs until it is ended"

README = {
    "sudo apt-get install -y python3-venv": BY_CI,
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/tonguetrack demo": BY_CI,
    "python3 -m venv .venv && .venv/bin/pip install -e '.[dev]' && .venv/bin/pytest -n 2": BY_CI,
    ".venv/bin/tonguetrack monitor --seconds 20": ELSEWHERE + "test_the_demo_arrives_at_the_monitor",
    "python3 -m venv .venv && .venv/bin/pip install .": BY_CI,
    ".venv/bin/tonguetrack model build PATH/sampleDatabase.yaml -o ultrax.npz": WITH_REFERENCE,
    ".venv/bin/tonguetrack track PATH/emu_webapp --model ultrax.npz --out poses.csv": WITH_REFERENCE,
    ".venv/bin/tonguetrack info recordings/demo.csv": HERE,
    ".venv/bin/tonguetrack track recordings/demo.csv --out poses.csv --save-session session.toml": HERE,
    ".venv/bin/tonguetrack track recordings/demo.csv --session session.toml --out poses.npz": HERE,
    ".venv/bin/tonguetrack mesh poses.csv --frame 100 -o tongue.ply": HERE,
    ".venv/bin/tonguetrack track recordings/demo.csv --session session.toml --osc 127.0.0.1:9000 --realtime": HERE,
    ".venv/bin/tonguetrack convert recordings/demo.csv demo.json": HERE,
    ".venv/bin/tonguetrack simulate recording simulated.csv --seconds 4": HERE,
    ".venv/bin/tonguetrack calibrate recordings/demo.csv -o placed.toml": HERE,
    ".venv/bin/tonguetrack track recordings/demo.csv --session placed.toml --out placed.csv": HERE,
    ".venv/bin/tonguetrack doctor": ELSEWHERE + "test_doctor.py, where what is found may be anything",
    ".venv/bin/tonguetrack devices": HERE,
    WAVE
    + ' --coils "Sensor 1=tongue_tip,Sensor 2=tongue_blade,Sensor 3=tongue_dorsum" --save-session session.toml': (
        ELSEWHERE + "test_the_readmes_two_commands_for_a_wave"
    ),
    WAVE + " --session session.toml --record take.xdf": ELSEWHERE
    + "test_the_readmes_two_commands_for_a_wave",
    FIRST_TAKE: HERE,
    ".venv/bin/tonguetrack take info first.xdf --check": HERE,
    ".venv/bin/tonguetrack bench": ELSEWHERE + "test_bench.py, with smaller numbers",
    ".venv/bin/pip install '.[viewer,web,video]'": BY_CI,
    "sudo apt-get install -y libegl1 libgl1 libgl1-mesa-dri xvfb xauth chromium": BY_CI,
    ".venv/bin/tonguetrack demo --view": WITHOUT_END,
    ".venv/bin/tonguetrack demo --web": WITHOUT_END,
    TRACK_DEMO + " --out demo.poses.csv": HERE,
    RENDER_DEMO + " --seconds 2.4:6 --size 896x504 --fps 15 -o tongue.webp": HERE,
    RENDER_DEMO + " --frame 300 -o tongue.png": HERE,
    ".venv/bin/tonguetrack export poses.csv -o tongue.glb": HERE,
    (
        ".venv/bin/tonguetrack demo --seconds 5 --to 'vmc://127.0.0.1:39540?preset=unified' "
        "--to 'osc://127.0.0.1:9000?send=shapes'"
    ): HERE,
}

DOCS = {
    (
        '.venv/bin/tonguetrack live ndi+rfc2217://127.0.0.1:8765 --coils "port 1=tongue_tip,port 1b=tongue_blade,'
        'port 2=tongue_dorsum"'
    ): ELSEWHERE + "test_the_docs_commands_for_simulated_devices",
    (
        '.venv/bin/tonguetrack live "carstens://127.0.0.1:30303?layout=ag501" --coils '
        "Ch1=tongue_tip,Ch2=tongue_blade,Ch3=tongue_dorsum"
    ): ELSEWHERE + "test_the_docs_commands_for_simulated_devices",
    FIRST_TAKE: HERE,
    ".venv/bin/tonguetrack doctor": ELSEWHERE + "test_doctor.py, where what is found may be anything",
    ".venv/bin/tonguetrack devices": HERE,
    HEADS: HERE,
    ".venv/bin/tonguetrack mri build heads/dataset.toml -o heads.npz --report report": ELSEWHERE
    + "test_mri_pipeline.py, with another set",
    ".venv/bin/tonguetrack mri build --print-settings": HERE,
    ".venv/bin/tonguetrack mri denoise heads/scans/Speaker01_a.nii.gz -o smooth.nii.gz": HERE,
    ".venv/bin/tonguetrack mri segment smooth.nii.gz -o tissue.nii.gz": HERE,
    ".venv/bin/tonguetrack mri cloud smooth.nii.gz -o surface.ply": HERE,
    ".venv/bin/tonguetrack mri slice smooth.nii.gz -o slice.png --at 2.2 --cloud surface.ply": HERE,
    (
        ".venv/bin/tonguetrack mri match heads/scans/Speaker01_a.nii.gz --template tongue "
        "--landmarks heads/landmarks/Speaker01_a.csv -o tongue-a.ply"
    ): HERE,
    (
        ".venv/bin/tonguetrack mri match heads/scans/Speaker01_a.nii.gz --template palate "
        "--landmarks heads/landmarks/Speaker01_palate.csv -o palate.ply"
    ): HERE,
    (
        ".venv/bin/tonguetrack mri align palate.ply --from heads/scans/Speaker01_a.nii.gz "
        "--to heads/scans/Speaker01_i.nii.gz -o palate-i.ply"
    ): HERE,
    ".venv/bin/tonguetrack mri denoise heads/scans/Speaker01_i.nii.gz -o smooth-i.nii.gz": HERE,
    ".venv/bin/tonguetrack mri cloud smooth-i.nii.gz -o surface-i.ply": HERE,
    ".venv/bin/tonguetrack mri restore surface-i.ply --palate palate-i.ply -o restored-i.ply": HERE,
    (
        ".venv/bin/tonguetrack mri match restored-i.ply --template tongue "
        "--landmarks heads/landmarks/Speaker01_i.csv -o tongue-i.ply"
    ): HERE,
    ".venv/bin/tonguetrack mri preference make model.work -o test --partitions 2": BY_PREFERENCE,
    ".venv/bin/tonguetrack mri preference serve test": BY_PREFERENCE,
    ".venv/bin/tonguetrack mri preference tally test -o tally": BY_PREFERENCE,
    ".venv/bin/tonguetrack model evaluate speakers/samples.yaml -o report": BY_MODEL_TESTS,
    (
        ".venv/bin/tonguetrack model evaluate PATH/sampleDatabase.yaml --specificity --samples 20000 "
        "--region-file combined=PATH/combined.json -o report"
    ): BY_MODEL_TESTS,
    ".venv/bin/tonguetrack model fit ultrax.npz tongue.ply -o fitted.ply": ELSEWHERE
    + "test_cli_model_fit.py",
    ".venv/bin/pip install '.[viewer]'": BY_CI,
    ".venv/bin/pip install '.[web]'": BY_CI,
    ".venv/bin/python tests/bench/rendering.py": "by hand, where nothing else runs",
    ".venv/bin/tonguetrack demo --view": WITHOUT_END,
    ".venv/bin/tonguetrack view poses.csv": ELSEWHERE + "test_window.py, on a display of its own",
    ".venv/bin/tonguetrack render poses.csv --frame 700 -o tongue.png": HERE,
    ".venv/bin/tonguetrack render poses.csv --size 640x360 --fps 25 -o film.mp4": HERE,
    ".venv/bin/tonguetrack demo --web --seconds 60": WITHOUT_END,
    ".venv/bin/tonguetrack demo --web --speaker=0.3,-0.1,0.2,0.1,0.2": WITHOUT_END,
    ".venv/bin/tonguetrack live simulate: --web --record takes": WITHOUT_END,
    ".venv/bin/tonguetrack live simulate: --web 0.0.0.0:8080": WITHOUT_END,
    DEMO
    + "osc://127.0.0.1:57120 --to 'vrchat://127.0.0.1?filter=1.5,0.5' --to 'vmc://127.0.0.1?preset=unified&rate=30'": HERE,
    ".venv/bin/tonguetrack monitor --listen 127.0.0.1:39540 --seconds 5": HERE,
    DEMO + "lsl:tongue": ELSEWHERE + "test_lsl_out.py, where a second program hears it",
    DEMO + "'osc://127.0.0.1:9000?rate=60&send=shapes,coils,unit,mesh'": HERE,
    DEMO + "oscquery://127.0.0.1": HERE,
    ".venv/bin/tonguetrack shapes poses.csv --session session.toml": HERE,
    TRACK_DEMO + " --out poses.csv": HERE,
    ".venv/bin/tonguetrack export poses.csv -o tongue.glb": HERE,
    ".venv/bin/tonguetrack export poses.csv -o meshes/tongue.ply --every 50": HERE,
    ".venv/bin/tonguetrack export poses.csv -o other.glb --speaker=0.3,-0.1,0.2,0.1,0.2": HERE,
    ".venv/bin/tonguetrack mesh poses.csv --frame 100 -o other.ply --speaker recordings/demo.session.toml": HERE,
    ".venv/bin/tonguetrack demo": BY_CI,
    SIMULATED + "rtc3d --synthetic --sensors 16 --rate 400": BY_FAULTS,
    SIMULATED + "ndi --from recordings/demo.csv --pty": BY_FAULTS,
    SIMULATED + "ndi --from recordings/demo.csv --rfc2217": BY_FAULTS,
    SIMULATED + "carstens --from recordings/demo.csv --layout ag501": BY_FAULTS,
    SIMULATED
    + 'rtc3d --synthetic --faults "drop=0.01,dead=tongue_tip@3-5,stall=1@8,disconnect@12"': BY_FAULTS,
    ".venv/bin/tonguetrack take list .": HERE,
    ".venv/bin/tonguetrack take info first.xdf --check": HERE,
    ".venv/bin/tonguetrack take export first.xdf -o first.csv": HERE,
    ".venv/bin/tonguetrack take export first.xdf --what poses -o poses.csv": HERE,
    ".venv/bin/tonguetrack take export first.xdf --what session -o first.toml": HERE,
    '.venv/bin/tonguetrack live "replay:first.xdf?speed=max" --session first.toml': HERE,
    ".venv/bin/tonguetrack take recover first.xdf -o whole.xdf": ELSEWHERE
    + "test_cli_take.py: a whole take is refused",
    "TONGUETRACK_FUZZ=nightly .venv/bin/pytest tests/test_fuzz.py": "by hand, before a release",
    ".venv/bin/tonguetrack info recordings/demo.csv": HERE,
    ".venv/bin/tonguetrack track recordings/demo.csv --out poses.csv --save-session session.toml": HERE,
    ".venv/bin/tonguetrack mesh poses.csv --frame 100 -o tongue.ply": HERE,
    ".venv/bin/tonguetrack mesh poses.csv --every 50 -o tongue.ply": HERE,
    ".venv/bin/tonguetrack evaluate-tracking SAMPLES.yaml --coils 2465,1912,1250 -o report/": (
        ELSEWHERE + "test_evaluation.py, on synthetic and on real meshes"
    ),
    (
        ".venv/bin/tonguetrack evaluate-tracking speakers/samples.yaml --coils 906,1347,1935 "
        "--regions tip,blade,back,combined"
    ): HERE,
    ".venv/bin/tonguetrack experiment recordings/demo.csv -o report/": HERE,
    ".venv/bin/tonguetrack experiment recordings/demo.csv --features 200 --anatomy joint -o report/": HERE,
    ".venv/bin/tonguetrack anatomy recordings/demo.csv --session session.toml": HERE,
    ".venv/bin/tonguetrack anatomy recordings/demo.csv --session session.toml --seconds 1"
    " --save-session speaker.toml --use joint": HERE,
    ".venv/bin/tonguetrack anatomy recordings/demo.csv --session session.toml"
    " --mesh tongue_000500.ply tongue_001500.ply tongue_002500.ply": HERE,
    ".venv/bin/tonguetrack track recordings --out-folder poses": HERE,
    ".venv/bin/tonguetrack track corpus --out-folder poses --scheduler tcp://192.168.0.7:8786": BY_CORPUS_TESTS,
    ".venv/bin/dask scheduler": BY_CORPUS_TESTS,
    ".venv/bin/dask worker tcp://192.168.0.7:8786 --nworkers auto --nthreads 1": BY_CORPUS_TESTS,
    ".venv/bin/tonguetrack convert recordings/demo.csv demo.npz": HERE,
    ".venv/bin/tonguetrack simulate recording hello.csv --speaker 3 --palate hello.palate.csv": HERE,
    ".venv/bin/tonguetrack track recordings/demo.csv --palate recordings/demo.palate.csv --save-session session.toml": HERE,
    ".venv/bin/tonguetrack simulate recording visit.csv --seconds 4 --head-motion --dropouts 0.05 "
    "--coils tongue_tip,tongue_blade,tongue_dorsum,head_nose,head_left,head_right,head_upper_incisor": HERE,
    ".venv/bin/tonguetrack calibrate visit.csv --rest 0:1 --smoothing carstens -o speaker.toml --report calibration": HERE,
    ".venv/bin/tonguetrack track visit.csv --session speaker.toml --out visit.poses.csv": HERE,
    ".venv/bin/tonguetrack model build PATH/sampleDatabase.yaml -o ultrax.npz": WITH_REFERENCE,
    ".venv/bin/tonguetrack model info bundled": HERE,
    ".venv/bin/tonguetrack model convert ultrax.npz ultrax.yaml": WITH_REFERENCE,
    ".venv/bin/tonguetrack model synthetic speakers": HERE,
    ".venv/bin/tonguetrack model build speakers/samples.yaml -o synthetic.npz --speaker-modes 4 --pose-modes 3": HERE,
    "python3 -m venv .venv && .venv/bin/pip install -e '.[dev]' && .venv/bin/pytest -n 2": BY_CI,
    ".venv/bin/ruff check . && .venv/bin/ruff format --check .": BY_CI,
    ".venv/bin/pip install '.[dev]' && cd docs && ../.venv/bin/mypy -p tonguetrack --config-file ../pyproject.toml": BY_CI,
}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def commands(*pages: Path) -> list[str]:
    lines = [line.strip() for page in pages for block in blocks(page, "sh") for line in block.splitlines()]
    return [line for line in lines if line]


def doc_pages() -> list[Path]:
    return [page for page in PAGES if page.parent.name == "docs"]


# Completeness ---------------------------------------------------------------------------------------


def test_every_command_of_the_readme_is_run_somewhere():
    assert set(commands(ROOT / "README.md")) == set(README)


def test_every_command_of_the_docs_is_run_somewhere():
    assert set(commands(*doc_pages())) == set(DOCS)


def test_what_ci_runs_it_takes_from_the_readme():
    """The two main commands are not copied into .ci/run: it reads them."""
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for name in (". && .venv/bin/tonguetrack demo", "pytest -n 2", "pip install '.[viewer"):
        assert f"readme_command '{name}'" in script or f'readme_command "{name}"' in script
    for name in ("python3-venv", "xvfb"):
        assert f"install_packages '{name}'" in script


def test_the_flags_that_pages_name_exist():
    known = subprocess.run(
        [tool(), "--help"], capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "200"}
    ).stdout
    helps = [known]
    for command in (
        "demo",
        "track",
        "anatomy",
        "experiment",
        "mesh",
        "info",
        "convert",
        "monitor",
        "bench",
        "model build",
        "model evaluate",
        "model fit",
        "mri build",
        "mri phantom",
        "mri denoise",
        "mri segment",
        "mri cloud",
        "mri slice",
        "mri match",
        "mri align",
        "mri restore",
        "mri preference make",
        "mri preference serve",
        "mri preference tally",
        "simulate recording",
        "simulate device",
        "live",
        "take info",
        "take export",
        "calibrate",
        "evaluate-tracking",
        "export",
        "view",
        "render",
        "shapes",
    ):
        done = subprocess.run(
            [tool(), *command.split(), "--help"], capture_output=True, text=True, check=True
        )
        helps.append(done.stdout)
    for page in PAGES:
        text = re.sub(
            r"```(?:sh|python|toml|yaml)\n.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL
        )
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", text):
            assert any(flag in text for text in helps), f"{page.name} names {flag}"


# Links ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_internal_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings]
            assert anchor in slugs, f"{page.name} links to {target}"


def test_every_page_can_be_reached_from_the_readme():
    reached, todo = set(), [ROOT / "README.md"]
    while todo:
        page = todo.pop()
        reached.add(page)
        for target in re.findall(r"\]\(([^)#\s]+\.md)", page.read_text(encoding="utf-8")):
            file = (page.parent / target).resolve() if "://" not in target else page
            if file not in reached:
                todo.append(file)
    assert {page for page in PAGES if page.name != "CHANGELOG.md"} <= reached


def test_files_that_pages_name_exist():
    for page in PAGES:
        for name in re.findall(
            r"`((?:tests|docs|drivers|model|tracker|recordings)/[\w./]+)`", page.read_text("utf-8")
        ):
            assert (ROOT / name).exists(), f"{page.name} names {name}"


# Commands -------------------------------------------------------------------------------------------


def tool() -> str:
    """The installed command, as the README's .venv/bin/tonguetrack."""
    return str(Path(sys.executable).parent / "tonguetrack")


@pytest.fixture
def newcomer(tmp_path):
    """A folder in which the README's commands can be typed: .venv, and the checkout's sample files."""
    missing = [name for name in SAMPLES if not (ROOT / name).is_file()]
    assert not missing, f"the checkout lacks {', '.join(missing)}"
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "tonguetrack").symlink_to(tool())
    for name in SAMPLES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


@pytest.fixture(scope="module")
def heads(tmp_path_factory):
    """The phantom scans of the pages, made once by the command that the pages have: it takes half a minute."""
    folder = tmp_path_factory.mktemp("phantom")
    typed(HEADS.replace(".venv/bin/tonguetrack", tool()), folder)
    return folder / "heads"


def typed(command: str, folder: Path) -> subprocess.CompletedProcess:
    done = subprocess.run(
        ["bash", "-c", command], cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


def run_here(page: Path, table: dict[str, str], folder: Path) -> None:
    for command in commands(page):
        if table[command] == HERE and not (command == HEADS and (folder / "heads").is_dir()):
            # Real time is for people; the frames are the same without waiting.
            typed(command.replace(" --realtime", ""), folder)


def run_page(page: Path, folder: Path) -> None:
    """A page of docs, beginning without the takes and meshes of the page before: none is ever overwritten."""
    for take in folder.glob("*.xdf"):
        take.unlink()
    shutil.rmtree(folder / "speakers", ignore_errors=True)
    run_here(page, DOCS, folder)


def test_the_readmes_commands_run_one_after_the_other(newcomer):
    run_here(ROOT / "README.md", README, newcomer)
    for name in ("poses.csv", "session.toml", "poses.npz", "tongue.ply", "demo.json", "simulated.csv"):
        assert (newcomer / name).stat().st_size > 100, name
    documented = (ROOT / "docs" / "tracking.md").read_text(encoding="utf-8")
    header = next(line for line in (newcomer / "poses.csv").read_text().splitlines() if line[0] != "#")
    for column in header.split(","):
        general = re.sub(r"tongue_(tip|blade|dorsum)", "ROLE", column)
        general = re.sub(r"^(pose|speaker)_\d+", r"\1_1", general)
        assert f"`{general}`" in documented, column
    with zipfile.ZipFile(newcomer / "poses.npz") as archive:
        for name in archive.namelist():
            assert f"`{name.removesuffix('.npy')}`" in documented, name
    (program,) = blocks(ROOT / "README.md", "python")
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=newcomer, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"\(\d+, \d+\) [\d.]+\n", done.stdout)


def test_python_started_in_the_checkout_finds_the_whole_package(tmp_path):
    shutil.copytree(ROOT / "tonguetrack", tmp_path / "tonguetrack")
    for folder in ("model", "drivers", "tracker", "recordings"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    program = (
        "import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'ditable' not in repr(f)]; import tonguetrack; "
        "print(tonguetrack.load_model.__module__, tonguetrack.__file__)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["tonguetrack.model.files", str(tmp_path / "tonguetrack" / "__init__.py")]


def test_the_docs_commands_run(newcomer, heads):
    (newcomer / "heads").symlink_to(heads)
    for page in doc_pages():
        if any(DOCS[command] == HERE for command in commands(page)):
            if page.name == "tracking.md":
                typed(f"{tool()} track recordings/demo.csv --out poses.csv", newcomer)
            run_page(page, newcomer)


def test_the_docs_programs_run(newcomer, heads):
    (newcomer / "heads").symlink_to(heads)
    typed(f"{tool()} model synthetic speakers", newcomer)
    typed(f"{tool()} track recordings/demo.csv --save-session session.toml", newcomer)
    shutil.copy(newcomer / "model/data/default.npz", newcomer / "ultrax.npz")
    for page in doc_pages():
        for program in blocks(page, "python"):
            if "serve_forever" in program or "heads.work" in program:  # test_mri_pipeline.py runs the latter
                continue
            if "model.at([0" in program:  # the bundled model may have another number of speaker weights
                program = re.sub(r"\[0\.5, .*?\]", "[0.5] + [0] * (model.speaker.size - 1)", program)
                program = re.sub(r"raw\(\[1, .*?\]", "raw([1] + [0] * (model.pose.size - 1)", program)
            done = subprocess.run(
                [sys.executable, "-c", program], cwd=newcomer, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{page.name}\n{program}\n{done.stderr}"


def test_the_docs_session_is_a_session(tmp_path):
    from tonguetrack.tracker import load_session
    from tonguetrack.tracker.coilmap import ROLES
    from tonguetrack.tracker.session import Energy

    (example,) = blocks(ROOT / "docs" / "session.md", "toml")
    (tmp_path / "example.toml").write_text(example, encoding="utf-8")
    session = load_session(tmp_path / "example.toml")
    assert session.speaker_weights is not None and session.alignment.midsagittal
    text = (ROOT / "docs" / "session.md").read_text(encoding="utf-8")
    rows = "".join(re.findall(r"^\| .*\n", text, re.MULTILINE))
    for energy in fields(Energy):
        assert f"`{energy.name}`" in rows and getattr(session.energy, energy.name) == energy.default
    assert [role for role in ROLES if f"`{role}`" not in text] == []


def test_the_docs_table_of_axes_is_what_the_tracker_suggests():
    from tonguetrack.drivers.files import carstens, est, mview, xrmb
    from tonguetrack.tracker.session import axis_mapping
    from tonguetrack.tracker.setup import suggested_axes

    text = (ROOT / "docs" / "session.md").read_text(encoding="utf-8")
    frames = {
        "AG501 `.pos` after normpos": carstens.NORMPOS_FRAME,
        "AG500 `.pos` with unit vectors": carstens.VECTOR_FRAME,
        "MVIEW `.mat`, three-dimensional": mview.FRAME_3D,
        "MVIEW `.mat`, two-dimensional": mview.FRAME_2D,
        "X-ray microbeam `.txy`": xrmb.FRAME,
        "MOCHA `.ema`": est.MOCHA_FRAME,
    }
    for words, frame in frames.items():
        (row,) = re.findall(rf"^\| {re.escape(words)} .*\| (.*) \|$", text, re.MULTILINE)
        suggested = suggested_axes(frame)
        assert suggested is not None
        if (axis_mapping(suggested) == axis_mapping(("x", "y", "z"))).all():
            assert row == "none needed", words
        else:
            assert row == f"`{json.dumps(suggested)}`", words


def test_every_format_that_is_read_has_a_row_in_the_docs():
    from tonguetrack.drivers.files.recognise import FORMATS

    text = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    words = {
        "authors' EMA JSON": "EMA JSON of the authors' programs",
        "tonguetrack CSV": "our CSV",
        "tonguetrack .npz": "our `.npz`",
        "CSV table": "another program's CSV",
        "Carstens AG50x .pos": "Carstens AG501 (AG50x) `.pos`",
        "NDI Wave .tsv v1": "NDI Wave `.tsv`, both layouts",
        "NDI Wave .tsv v2": "NDI Wave `.tsv`, both layouts",
    }
    for form in FORMATS:
        named = words.get(form.words, re.sub(r"(\.\w+)", r"`\1`", form.words))
        assert f"| {named}" in text, form.words


def test_the_demo_arrives_at_the_monitor(newcomer):
    """The README's monitor, for a shorter time and on a free port, while the demo runs at full speed."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    monitor = subprocess.Popen(
        [tool(), "monitor", "--listen", f"127.0.0.1:{port}", "--seconds", "20", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert monitor.stderr is not None and monitor.stdout is not None
    limit = threading.Timer(60, monitor.kill)
    limit.start()
    try:
        assert "listening" in monitor.stderr.readline()
        typed(f"{tool()} demo --osc 127.0.0.1:{port} --seconds 2", newcomer)
        monitor.send_signal(2)  # Ctrl-C: the monitor ends with its summary
        printed = monitor.stdout.read()
        assert monitor.wait(30) == 0
    finally:
        limit.cancel()
        monitor.kill()
        monitor.stderr.close()
        monitor.stdout.close()
    assert '"/tongue/pose"' in printed


def test_the_readmes_two_commands_for_a_wave(newcomer):
    """Against a simulated Wave, for some seconds."""
    wave = subprocess.Popen(
        [tool(), "simulate", "device", "rtc3d", "--from", "recordings/demo.csv", "--port", "0"],
        cwd=newcomer, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        assert wave.stdout is not None
        address = wave.stdout.readline().strip()
        both = [command for command in README if command.startswith(WAVE)]
        for command, seconds in zip(both, ("3 --fix-speaker-after 1", "1"), strict=True):
            typed(command.replace("rtc3d://192.168.0.10", address) + f" --seconds {seconds}", newcomer)
    finally:
        wave.terminate()
        wave.communicate(timeout=20)
    assert "[speaker]" in (newcomer / "session.toml").read_text()
    typed(f"{tool()} take info take.xdf --check", newcomer)


@pytest.mark.parametrize(
    ("device", "words", "usual"),
    [
        ("ndi --from recordings/demo.csv --rfc2217", "ndi+rfc2217", "ndi+rfc2217://127.0.0.1:8765"),
        (
            "carstens --from recordings/demo.csv --layout ag501",
            "carstens",
            "carstens://127.0.0.1:30303?layout=ag501",
        ),
    ],
)
def test_the_docs_commands_for_simulated_devices(newcomer, device, words, usual):
    """On a free port, for a second."""
    (command,) = [
        command for command in DOCS if command.startswith(".venv/bin/tonguetrack live") and words in command
    ]
    with subprocess.Popen(
        [tool(), "simulate", "device", *device.split(), "--port", "0"],
        cwd=newcomer, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    ) as simulator:  # fmt: skip
        try:
            assert simulator.stdout is not None
            address = simulator.stdout.readline().strip()
            assert usual in command
            typed(command.replace(usual, address) + " --seconds 1", newcomer)
        finally:
            simulator.terminate()


def test_the_docs_quote_what_model_info_prints(tmp_path):
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "tonguetrack").symlink_to(tool())
    page = (ROOT / "docs" / "model.md").read_text(encoding="utf-8")
    printed = typed(".venv/bin/tonguetrack model info bundled", tmp_path).stdout.splitlines()
    assert printed[0] in page
    for line in printed:
        if line.strip().startswith("compactness"):
            assert line.strip() in page


def test_three_commands_track_a_real_recording_with_real_tongues(reference_data, tmp_path):
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "tonguetrack").symlink_to(tool())
    places = {"PATH/sampleDatabase.yaml": reference_data / "ultrax-tongue-meshes" / "sampleDatabase.yaml",
              "PATH/emu_webapp": reference_data / "recordings" / "emu_webapp"}  # fmt: skip
    everything = [*commands(ROOT / "README.md"), *commands(*doc_pages())]
    chosen = [c for c in dict.fromkeys(everything) if {**README, **DOCS}[c] == WITH_REFERENCE]
    assert len(chosen) == 3
    for command in chosen:
        real = command
        for placeholder, place in places.items():
            real = real.replace(placeholder, f"'{place}'")
        assert "PATH" not in real
        typed(real, tmp_path)
    rows = [line for line in (tmp_path / "poses.csv").read_text().splitlines() if not line.startswith("#")]
    assert len(rows) == 1 + 800
    header = rows[0].split(",")
    assert {"pose_4", "speaker_5", "residual_mm", "tongue_tip_z_mm"} <= set(header)
    residual = [row.split(",")[header.index("residual_mm")] for row in rows[1:]]
    tracked = [float(cell) for cell in residual if cell]
    assert len(tracked) == 760 and sum(tracked) / len(tracked) < 2.5
    assert (tmp_path / "ultrax.yaml").is_file()
