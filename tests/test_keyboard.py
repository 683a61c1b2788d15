"""Keys of a terminal as wishes, and a terminal that is afterwards as it was, however the program ends."""

import os
import signal
import subprocess
import sys

import pytest

from tonguetrack.tracker.control import ControlQueue
from tonguetrack.tracker.keyboard import KeyMeanings, watched_keys

needs_a_pseudo_terminal = pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")


def pressed(keys, taking=None):
    queue = ControlQueue()
    meanings = KeyMeanings(queue, taking)
    for key in keys:
        meanings.press(key)
    found = []
    while (control := queue.take()) is not None:
        found.append((control.kind, control.text))
    return found


def test_markers_are_numbered():
    assert pressed(" mM") == [("mark", "mark 1"), ("mark", "mark 2"), ("mark", "mark 3")]


def test_t_starts_and_ends_takes_in_turn():
    assert [kind for kind, _ in pressed("tTt")] == ["take_start", "take_stop", "take_start"]


def test_t_asks_whether_a_take_is_being_written_where_that_is_known():
    assert [kind for kind, _ in pressed("tt", lambda: True)] == ["take_stop", "take_stop"]
    assert [kind for kind, _ in pressed("tt", lambda: False)] == ["take_start", "take_start"]


def test_f_fixes_the_speaker_q_quits_and_other_keys_do_nothing():
    assert pressed("fq") == [("fix_speaker", ""), ("quit", "")]
    assert pressed("abc1\n\t\x7f\x00ü") == []


def test_without_a_terminal_nothing_is_done():
    code = (
        "import signal, threading\n"
        "from tonguetrack.tracker.keyboard import watched_keys\n"
        "from tonguetrack.tracker.control import ControlQueue\n"
        "with watched_keys(ControlQueue()) as watched:\n"
        "    print(watched, threading.active_count(), signal.getsignal(signal.SIGTERM) == signal.SIG_DFL)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input="q", capture_output=True, text=True, timeout=30, check=True
    )
    assert done.stdout.split() == ["False", "1", "True"]


def test_a_closed_stdin_is_no_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    with watched_keys(ControlQueue()) as watched:
        assert not watched


# On a terminal ----------------------------------------------------------------------------------------

PROGRAM = """
import fcntl, os, sys, termios, time
from tonguetrack.tracker.control import ControlQueue
from tonguetrack.tracker.keyboard import watched_keys
if sys.argv[1] != "job":
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
queue = ControlQueue()
with watched_keys(queue) as watched:
    print("watched", watched, flush=True)
    end = time.monotonic() + 30
    while time.monotonic() < end:
        control = queue.take()
        if control is None:
            time.sleep(0.005)
            continue
        print(control.kind, control.text, flush=True)
        if control.kind == "quit":
            if sys.argv[1] == "raise":
                raise RuntimeError("on purpose")
            if sys.argv[1] == "exit":
                sys.exit(3)
            break
print("done", flush=True)
"""

# A shell as small as can be: it starts the program as a job in the foreground, takes the terminal back when it is
# suspended, and says what it finds.
SHELL = """
import fcntl, os, signal, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
def single_keys():
    return not termios.tcgetattr(0)[3] & termios.ICANON
child = os.fork()
if child == 0:
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    os.setpgid(0, 0)
    os.tcsetpgrp(0, os.getpgrp())
    signal.signal(signal.SIGTTOU, signal.SIG_DFL)
    os.execv(sys.executable, [sys.executable, "-c", sys.argv[1], "job"])
def wait():
    _, status = os.waitpid(child, os.WUNTRACED)
    os.tcsetpgrp(0, os.getpgrp())
    stopped = os.WIFSTOPPED(status)
    print("shell", "stopped" if stopped else "ended", "single keys" if single_keys() else "lines", flush=True)
    return stopped
while wait():
    os.tcsetpgrp(0, child)
    os.kill(child, signal.SIGCONT)
"""


HANGUP = """
import fcntl, signal, termios, threading, time
from tonguetrack.tracker.control import ControlQueue
from tonguetrack.tracker.keyboard import watched_keys
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGHUP, signal.SIG_IGN)
with watched_keys(ControlQueue()):
    print("watched", flush=True)
    end = time.monotonic() + 20
    while threading.active_count() > 1 and time.monotonic() < end:
        time.sleep(0.01)
    print("nobody reads keys" if threading.active_count() == 1 else threading.enumerate())
"""


class Terminal:
    """A pseudo-terminal, and a program whose stdin and controlling terminal it is."""

    def __init__(self, program, *arguments):
        import pty

        self.keys, self.theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, *arguments],
            stdin=self.theirs,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            text=True,
        )

    def press(self, keys):
        os.write(self.keys, keys)

    def line(self):
        return self.process.stdout.readline().strip()

    def settings(self):
        import termios

        return termios.tcgetattr(self.theirs)

    def is_in_lines(self):
        import termios

        return bool(self.settings()[3] & termios.ICANON and self.settings()[3] & termios.ECHO)

    def ended(self):
        """Exit code and what else it printed, on stdout and stderr."""
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err

    def hang_up(self):
        os.close(self.keys)
        self.keys = None

    def close(self):
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()
        if self.keys is not None:
            os.close(self.keys)
        os.close(self.theirs)


@pytest.fixture
def terminal(request):
    def make(program, *arguments):
        opened = Terminal(program, *arguments)
        request.addfinalizer(opened.close)
        return opened

    return make


@needs_a_pseudo_terminal
def test_keys_arrive_without_return_and_the_terminal_is_as_before(terminal):
    opened = terminal(PROGRAM, "quit")
    before = opened.settings()
    assert opened.line() == "watched True"
    assert not opened.is_in_lines()
    for key, said in (
        (b" ", "mark mark 1"),
        (b"m", "mark mark 2"),
        (b"t", "take_start"),
        (b"f", "fix_speaker"),
    ):
        opened.press(key)
        assert opened.line() == said
    opened.press(b"q")
    assert opened.ended() == (0, "quit \ndone\n", "")
    assert opened.settings() == before


@needs_a_pseudo_terminal
def test_arrow_and_function_keys_are_not_taken_for_letters(terminal):
    opened = terminal(PROGRAM, "quit")
    opened.line()
    opened.press(b"\x1b[A\x1bOm\x1bm\x1b[15~t\x1b[1;5m")
    opened.press(b"q")
    assert opened.ended()[1] == "take_start \nquit \ndone\n"


@needs_a_pseudo_terminal
@pytest.mark.parametrize(("how", "code"), [("raise", 1), ("exit", 3)])
def test_the_terminal_is_as_before_when_the_program_fails(terminal, how, code):
    opened = terminal(PROGRAM, how)
    before = opened.settings()
    opened.line()
    opened.press(b"q")
    assert opened.ended()[0] == code
    assert opened.settings() == before


@needs_a_pseudo_terminal
@pytest.mark.parametrize("number", ["SIGTERM", "SIGINT", "SIGQUIT"])
def test_the_terminal_is_as_before_when_a_signal_ends_the_program(terminal, number):
    opened = terminal("import resource; resource.setrlimit(resource.RLIMIT_CORE, (0, 0))" + PROGRAM, "quit")
    before = opened.settings()
    assert opened.line() == "watched True"
    opened.process.send_signal(getattr(signal, number))
    code, out, _ = opened.ended()
    assert code == -getattr(signal, number)
    assert "done" not in out
    assert opened.settings() == before


@needs_a_pseudo_terminal
def test_ctrl_c_is_still_a_signal(terminal):
    opened = terminal(PROGRAM, "quit")
    opened.line()
    opened.press(b"\x03")
    code, _, err = opened.ended()
    assert code == -signal.SIGINT
    assert "KeyboardInterrupt" in err


@needs_a_pseudo_terminal
def test_ctrl_z_gives_the_terminal_back_and_fg_takes_it_again(terminal):
    opened = terminal(SHELL, PROGRAM)
    assert opened.line() == "watched True"
    for _ in range(2):
        opened.press(b"\x1a")
        assert opened.line() == "shell stopped lines"
        opened.press(b"m")
        assert opened.line().startswith("mark mark")
    opened.press(b"q")
    assert opened.line() == "quit"
    assert opened.line() == "done"
    assert opened.line() == "shell ended lines"


@needs_a_pseudo_terminal
def test_a_terminal_that_goes_away_ends_only_the_watching(terminal):
    opened = terminal(HANGUP)
    assert opened.line() == "watched"
    opened.hang_up()
    assert opened.ended() == (0, "nobody reads keys\n", "")
