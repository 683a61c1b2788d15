"""The window and the page beside the tracker: started, ended, and whatever becomes of them, tracking goes on."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest

from tonguetrack import InputError
from tonguetrack.tracker import outside
from tonguetrack.tracker.cli import main
from tonguetrack.tracker.outside import Beside
from tonguetrack.tracker.streams import feedfolder
from tonguetrack.tracker.streams.feed import FeedAbout, FeedSink, process_lives
from tonguetrack.tracker.streams.feedfolder import feed_folder

PATIENCE_S = 60.0
SESSION = str(Path(__file__).resolve().parents[1] / "recordings" / "demo.session.toml")
COMMAND = ("-c", "import sys; from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))")

# Stands in for the window or the page's server: `main` of a module that Python finds.
SHOWING = """
import sys, time
def main():
{body}
"""


class Ended:
    """What `Beside` calls: keeps the complaints."""

    def __init__(self):
        self.complaints = []
        self.event = threading.Event()

    def __call__(self, complaint):
        self.complaints.append(complaint)
        self.event.set()


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Makes a module whose main() has this body; gives its name."""

    def make(*lines):
        (tmp_path / "stands_in.py").write_text(
            SHOWING.format(body="\n".join(f"    {line}" for line in lines))
        )
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        return "stands_in"

    return make


def test_the_first_line_with_the_word_is_what_is_waited_for(module):
    name = module(
        "print('hello', flush=True)", "print('page http://here/', sys.argv[1:], flush=True)", "time.sleep(60)"
    )
    with Beside("the page", name, ["a", "b"], Ended()) as beside:
        assert beside.line_with("page ", PATIENCE_S) == "http://here/ ['a', 'b']"
        assert process_lives(beside.pid)
    assert not process_lives(beside.pid)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (["sys.exit(0)"], "the page ended at once."),
        (["sys.exit(3)"], "the page ended with exit code 3."),
        (["print('one', file=sys.stderr)", "sys.exit('tonguetrack: no port.')"], "no port."),
        (["import no_such_module"], "ModuleNotFoundError: No module named 'no_such_module'"),
        (["sys.stderr.write('x' * 10**6)", "sys.exit(1)"], "x" * (10**6 % 4096)),
    ],
)
def test_one_that_ends_before_it_is_there_is_an_error_in_its_own_words(module, lines, complaint):
    with Beside("the page", module(*lines), [], Ended()) as beside, pytest.raises(InputError) as refusal:
        beside.line_with("page ", PATIENCE_S)
    assert str(refusal.value) == complaint


def test_one_that_says_nothing_is_not_waited_for_for_ever(module):
    late = "the page did not start within 0.1 seconds"
    with (
        Beside("the page", module("time.sleep(60)"), [], Ended()) as beside,
        pytest.raises(InputError, match=late),
    ):
        beside.line_with("page ", 0.1)


def test_it_is_told_once_when_one_ends_by_itself_and_why(module):
    ended = Ended()
    with Beside("the window", module("sys.exit('no display')"), [], ended):
        assert ended.event.wait(PATIENCE_S)
    assert ended.complaints == ["no display"]


def test_one_that_ends_as_it_should_has_no_complaint(module):
    ended = Ended()
    with Beside("the window", module("print('bye', file=sys.stderr)"), [], ended):
        assert ended.event.wait(PATIENCE_S)
    assert ended.complaints == [""]


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_one_that_will_not_end_is_ended(module, monkeypatch):
    monkeypatch.setattr(outside, "CLOSE_S", 0.2)
    ended = Ended()
    deaf = module(
        "import signal",
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)",
        "print('page', flush=True)",
        "time.sleep(60)",
    )
    with Beside("the window", deaf, [], ended) as beside:
        beside.line_with("page", PATIENCE_S)
    assert not process_lives(beside.pid)
    assert ended.complaints == [], "it was we who ended it"


@pytest.mark.skipif(os.name != "posix", reason="sessions of processes")
def test_ctrl_c_on_the_terminal_is_not_for_it(module):
    with Beside("the window", module("print('page', flush=True)", "time.sleep(60)"), [], Ended()) as beside:
        beside.line_with("page", PATIENCE_S)
        assert os.getsid(beside.pid) != os.getsid(0)


def test_a_file_of_the_users_with_the_name_of_a_library_is_not_loaded(module, tmp_path, monkeypatch):
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "queue.py").write_text("raise SystemExit('the wrong one')")
    monkeypatch.chdir(folder)
    with Beside(
        "the page", module("import queue", "print('page', queue.Queue, flush=True)"), [], Ended()
    ) as beside:
        assert "queue.Queue" in beside.line_with("page", PATIENCE_S)


def test_the_feeds_folder_is_private_and_gone_afterwards():
    with feed_folder() as folder:
        assert folder.stat().st_mode & 0o777 == 0o700
        (folder / "feed").write_bytes(b"x")
    assert not folder.exists()


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_what_a_killed_run_left_behind_is_cleared_away_by_the_next_and_nothing_else_is(tmp_path, monkeypatch):
    monkeypatch.setattr(feedfolder, "MEMORY_FOLDER", tmp_path)
    code = (
        "import os, signal; from pathlib import Path; from tonguetrack.tracker.streams import feedfolder; "
        "from tonguetrack.tracker.streams.feed import FeedAbout, FeedSink; "
        f"feedfolder.MEMORY_FOLDER = Path({str(tmp_path)!r}); keeper = feedfolder.feed_folder(); folder = keeper.__enter__(); "
        "FeedSink(folder, FeedAbout('bundled', '', ('a',), (1,), 4, 5)); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], timeout=PATIENCE_S, check=False)
    [left_behind] = tmp_path.iterdir()
    (left_behind / "ghost.npz").write_bytes(b"x")
    (tmp_path / "tonguetrack-notes").mkdir()
    (tmp_path / "tonguetrack-notes" / "of mine.txt").write_text("keep me")
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(left_behind, elsewhere)
    (tmp_path / "tonguetrack-link").symlink_to(elsewhere)
    with feed_folder() as ours:
        feed = FeedSink(ours, FeedAbout("bundled", "", ("a",), (1,), 4, 5))
        with feed_folder() as second:
            assert ours.exists() and second.exists(), "a run that lasts is left alone"
        assert not left_behind.exists()
        assert (tmp_path / "tonguetrack-notes" / "of mine.txt").exists()
        assert (elsewhere / "feed").exists()
        feed.close()


# As a user meets it ---------------------------------------------------------------------------------------


def started(*arguments, **environment):
    return subprocess.Popen(
        [sys.executable, *COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )


def closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        return gone.getsockname()[1]


def test_a_page_whose_port_is_taken_is_one_sentence_and_exit_code_2(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert main(["demo", "--web", address]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"tonguetrack: {address}: ") and "--web" in told and told.count("\n") == 1


@pytest.mark.parametrize("command", [("demo",), ("live", "simulate:?seconds=2", "--session", SESSION)])
def test_the_page_is_there_while_the_run_lasts_and_ends_with_it(command):
    pytest.importorskip("websockets")
    run = started(*command, "--web", "127.0.0.1:0", "--json", "--osc", f"127.0.0.1:{closed_port()}")
    try:
        for line in run.stderr:
            if line.startswith("page: "):
                url = line.removeprefix("page: ").strip()
                break
        else:
            pytest.fail("no page was announced")
        with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
            assert b"<html" in answer.read()
        time.sleep(0.3)
        run.send_signal(signal.SIGINT)
        out, err = run.communicate(timeout=PATIENCE_S)
    finally:
        run.kill()
    assert run.returncode == 0, err
    summary = json.loads(out)
    assert [sink["destination"].split()[0] for sink in summary["sinks"]] == ["osc", "page"]
    assert summary["sinks"][1]["sent"] == summary["frames"] > 0
    with pytest.raises(OSError):
        urllib.request.urlopen(url, timeout=5.0)


def test_a_window_that_cannot_open_is_one_sentence_and_tracking_goes_on():
    nowhere = {"DISPLAY": "", "WAYLAND_DISPLAY": "", "XDG_RUNTIME_DIR": ""}
    run = started(
        "demo", "--view", "--seconds", "4", "--json", "--osc", f"127.0.0.1:{closed_port()}", **nowhere
    )
    out, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, err
    assert json.loads(out)["frames"] == 1000
    assert len([line for line in err.splitlines() if line.startswith("no window: ")]) == 1
    assert "Traceback" not in err


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL")
def test_a_tracker_that_was_killed_takes_the_page_with_it():
    pytest.importorskip("websockets")
    run = started("demo", "--web", "127.0.0.1:0", "--osc", f"127.0.0.1:{closed_port()}")
    try:
        url = next(line for line in run.stderr if line.startswith("page: ")).removeprefix("page: ").strip()
    finally:
        run.kill()
        run.communicate(timeout=PATIENCE_S)
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        try:
            urllib.request.urlopen(url, timeout=5.0).close()
        except OSError:
            return
        time.sleep(0.1)
    pytest.fail("the page outlived the tracker")


def test_a_reader_of_the_demos_feed_sees_the_tongue_move(tmp_path, monkeypatch):
    """The feed of a real run, read as the window and the page read it."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    stand_in = (
        "import sys; from tonguetrack.tracker import outside; outside.WINDOW = 'reading_window'; "
        "from tonguetrack.tracker.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    (tmp_path / "reading_window.py").write_text(
        "import json, sys, time\n"
        "from tonguetrack.tracker.streams.feed import FeedReader\n"
        "def main():\n"
        "    with FeedReader(sys.argv[1]) as feed:\n"
        "        seen, over = [], False\n"
        "        while not over:\n"
        "            over = feed.over\n"
        "            seen += [list(pose.weights) for _, pose in feed.since(len(seen))]\n"
        "            time.sleep(0.02)\n"
        f"    open({str(tmp_path / 'seen.json')!r}, 'w').write(json.dumps([seen, feed.about.title, feed.about.model]))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    done = subprocess.run(
        [sys.executable, "-c", stand_in, "demo", "--view", "--seconds", "3", "--osc", f"127.0.0.1:{closed_port()}"],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    seen, title, model = json.loads((tmp_path / "seen.json").read_text())
    assert len(seen) == 750 and len({tuple(weights) for weights in seen}) > 700
    assert (title, model) == ("synthetic demo", "bundled")
