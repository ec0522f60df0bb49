"""Pages in a headless Chromium, drawn in software: what they look like and what they say.

The browser is told what to do through two pipes (the DevTools protocol), and time is real: a page is photographed
when it has drawn its frames, however slow the machine.
"""

import base64
import fcntl
import io
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pytest
from PIL import Image

_FLAGS = (
    "--headless",
    "--remote-debugging-pipe",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
)
_WITH_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_WITHOUT_WEBGL = ("--disable-gpu", "--disable-3d-apis")
_DRIVER = "GL Driver Message"  # about the speed of reading a picture back: the screenshot's own
_SETTLED = """(async () => {
  const frames = async (count) => {
    for (let i = 0; i < count; i++) await new Promise((next) => requestAnimationFrame(next));
  };
  await frames(20);
  if (window.finished) await window.finished;
  await frames(3);
})()"""


def seen(
    page: str,
    folder: Path,
    size: tuple[int, int] = (800, 600),
    webgl: bool = True,
    fragment: str = "",
    most_seconds: float = 60.0,
) -> tuple[np.ndarray, list[str]]:
    """A screenshot (H, W, 3) in 0 to 255 of HTML text, and the lines of its console, uncaught errors among them.

    It is taken 20 frames after the page has loaded and, where the page sets `window.finished`, after that promise.
    Skips where there is no Chromium.

    Args:
        page: the HTML.
        folder: for the page, `page.png` and the browser's profile.
        size: width and height of the window.
        webgl: whether the browser has it.
        fragment: of the page's address, such as `#step=3`.
        most_seconds: how long all of it may take.
    """
    source = folder / "page.html"
    source.write_text(page, encoding="utf-8")
    with _Browser(folder / "profile", webgl, most_seconds) as browser:
        browser.ask("Page.enable")
        browser.ask("Runtime.enable")
        browser.ask("Log.enable")
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        browser.ask("Emulation.setDeviceMetricsOverride", **metrics)
        browser.ask("Page.navigate", url=source.as_uri() + fragment)
        browser.wait_for("Page.loadEventFired")
        browser.ask("Runtime.evaluate", expression=_SETTLED, awaitPromise=True)
        picture = base64.b64decode(browser.ask("Page.captureScreenshot")["data"])
    (folder / "page.png").write_bytes(picture)
    with Image.open(io.BytesIO(picture)) as image:
        return np.asarray(image.convert("RGB")).astype(int), browser.said


class _Browser:
    """A process with one empty page."""

    def __init__(self, profile: Path, webgl: bool, most_seconds: float) -> None:
        program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        if program is None:
            pytest.skip("no Chromium on this machine")
        self._deadline = time.monotonic() + most_seconds
        self.said: list[str] = []
        self._events: list[dict[str, Any]] = []
        self._unread, self._count, self._session = b"", 0, ""
        flags = (*_FLAGS, *(_WITH_WEBGL if webgl else _WITHOUT_WEBGL), f"--user-data-dir={profile}")
        theirs, self._to = (_high(end) for end in os.pipe())
        self._from, answers = (_high(end) for end in os.pipe())

        def arrange() -> None:
            os.dup2(theirs, 3)
            os.dup2(answers, 4)

        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(
            [program, *flags], stdin=quiet, stdout=quiet, stderr=quiet, preexec_fn=arrange, pass_fds=(3, 4)
        )
        os.close(theirs)
        os.close(answers)

    def __enter__(self) -> "_Browser":
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        os.close(self._to)
        os.close(self._from)
        self._process.kill()
        self._process.wait()

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a command; fails with what the browser says."""
        self._count += 1
        command: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            command["sessionId"] = self._session
        os.write(self._to, json.dumps(command).encode() + b"\0")
        while True:
            message = self._next()
            if message.get("id") == self._count:
                assert "error" not in message, message
                return message["result"]
            self._events.append(message)

    def wait_for(self, method: str) -> None:
        """Until the browser tells of it."""
        while not any(event.get("method") == method for event in self._events):
            self._events.append(self._next())

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._unread:
            left = self._deadline - time.monotonic()
            assert left > 0, f"the browser took too long; it said {self.said}"
            if select.select([self._from], [], [], left)[0]:
                part = os.read(self._from, 1 << 20)
                assert part, f"the browser ended; it said {self.said}"
                self._unread += part
        first, _, self._unread = self._unread.partition(b"\0")
        message: dict[str, Any] = json.loads(first)
        self._hear(message.get("method", ""), message.get("params", {}))
        return message

    def _hear(self, method: str, event: dict[str, Any]) -> None:
        line = ""
        if method == "Runtime.consoleAPICalled":
            line = " ".join(str(each.get("value", each.get("description"))) for each in event["args"])
        elif method == "Runtime.exceptionThrown":
            details = event["exceptionDetails"]
            line = f"{details['text']} {details.get('exception', {}).get('description', '')}"
        elif method == "Log.entryAdded":
            line = event["entry"]["text"]
        if line and _DRIVER not in line:
            self.said.append(line)


def _high(end: int) -> int:
    """The same end of a pipe under a number above those that the browser expects."""
    moved = fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10)
    os.close(end)
    return moved
