"""A headless Chromium, driven over the Chrome DevTools Protocol (https://chromedevtools.github.io/devtools-protocol/)."""

import base64
import io
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

FLAGS = (
    "--headless=new",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-default-apps",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-extensions",
    "--mute-audio",
    "--disable-features=Translate,OptimizationHints,MediaRouter",
    "--remote-debugging-port=0",
)
START_S, ANSWER_S = 30.0, 30.0


class Browser:
    """One Chromium with a fresh profile; ended, with all its processes, at the end of the context."""

    def __init__(self, program: str) -> None:
        self.profile = Path(tempfile.mkdtemp(prefix="tonguetrack-chromium-"))
        self._log = open(self.profile / "log", "wb")  # noqa: SIM115
        self.process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={self.profile}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=self._log, start_new_session=True,
        )  # fmt: skip
        self.port = self._wait_for_port()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait(10)
        self._log.close()
        shutil.rmtree(self.profile, ignore_errors=True)

    def _wait_for_port(self) -> int:
        until_s = time.monotonic() + START_S
        while time.monotonic() < until_s:
            found = re.search(
                rb"DevTools listening on ws://127\.0\.0\.1:(\d+)/", (self.profile / "log").read_bytes()
            )
            if found:
                return int(found.group(1))
            assert self.process.poll() is None, (self.profile / "log").read_text(errors="replace")
            time.sleep(0.05)
        raise AssertionError("Chromium did not start: " + (self.profile / "log").read_text(errors="replace"))

    def open(self, url: str, width: int = 1000, height: int = 700) -> "Tab":
        """A tab of its own."""
        import urllib.request

        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=ANSWER_S) as answer:
            target = json.loads(answer.read())
        return Tab(target["webSocketDebuggerUrl"], url, width, height)

    def renderers(self) -> list[int]:
        """The processes that run pages."""
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                command = (folder / "cmdline").read_bytes()
            except OSError:
                continue
            if b"--type=renderer" in command and str(self.profile).encode() in command:
                found.append(int(folder.name))
        return found


class Tab:
    """One page. complaints: what it wrote to its console as warnings and errors, and exceptions nobody caught."""

    def __init__(self, debugger: str, url: str, width: int, height: int) -> None:
        from websockets.sync.client import connect

        self._stack = ExitStack()
        self._socket = self._stack.enter_context(
            connect(debugger, max_size=64_000_000, open_timeout=ANSWER_S)
        )
        self._numbers = itertools.count(1)
        self.complaints: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.size(width, height)
        self.call("Page.navigate", url=url)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.call("Page.close")
        self._stack.close()

    def call(self, method: str, **parameters):
        """One command and its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=ANSWER_S))
            self._note(message)
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return message["result"]

    def _note(self, message) -> None:
        parameters = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(parameters["exceptionDetails"])[:500])
            case "Runtime.consoleAPICalled" if parameters["type"] in ("error", "warning", "assert"):
                self.complaints.append(json.dumps(parameters["args"])[:500])
            case "Log.entryAdded" if parameters["entry"]["level"] == "error":
                self.complaints.append(json.dumps(parameters["entry"])[:500])

    def size(self, width: int, height: int, scale: float = 1) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=False,
        )

    def prefer(self, scheme: str) -> None:
        """light or dark."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def run(self, script: str):
        """The value of an expression; promises are waited for."""
        done = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait(self, script: str, seconds: float = 15.0):
        """The value of an expression as soon as it is true."""
        until_s = time.monotonic() + seconds
        while not (value := self.run(script)):
            if time.monotonic() > until_s:
                raise AssertionError(f"not within {seconds} s: {script}\n{self.complaints}")
            time.sleep(0.05)
        return value

    def text(self, place: str) -> str:
        return self.run(f"document.querySelector({place!r}).innerText")

    def click(self, place: str) -> None:
        self.run(f"document.querySelector({place!r}).click()")

    def type(self, place: str, value) -> None:
        self.run(
            f"(e => {{ e.value = {json.dumps(value)}; e.dispatchEvent(new Event('input', {{bubbles: true}})) }})"
            f"(document.querySelector({place!r}))"
        )

    def picture(self, place: str | None = None) -> np.ndarray:
        """(h, w, 3) uint8 of the page, or of one element."""
        from PIL import Image

        options = {}
        if place:
            box = self.run(
                f"(b => [b.x, b.y, b.width, b.height])(document.querySelector({place!r}).getBoundingClientRect())"
            )
            options["clip"] = dict(zip(("x", "y", "width", "height"), box), scale=1)
        data = self.call("Page.captureScreenshot", format="png", **options)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))
