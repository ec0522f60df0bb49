"""Pages in a headless Chromium, drawn in software: what they look like and what they say."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-logging=stderr",
    "--force-device-scale-factor=1",
    "--hide-scrollbars",
)
_WITH_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_WITHOUT_WEBGL = ("--disable-gpu", "--disable-3d-apis")
_DRIVER = "GL Driver Message"  # about the speed of reading a picture back: the screenshot's own


def seen(
    page: str,
    folder: Path,
    size: tuple[int, int] = (800, 600),
    budget_ms: int = 8000,
    webgl: bool = True,
    fragment: str = "",
) -> tuple[np.ndarray, list[str]]:
    """A screenshot (H, W, 3) in 0 to 255 of HTML text, and the lines of its console.

    Skips where there is no Chromium.

    Args:
        page: the HTML.
        folder: for the page, the picture and the browser's profile.
        size: width and height of the window.
        budget_ms: how long the page lives, in its own clock.
        webgl: whether the browser has it.
        fragment: of the page's address, such as `#step=3`.
    """
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    source, picture = folder / "page.html", folder / "page.png"
    source.write_text(page, encoding="utf-8")
    window = f"--window-size={size[0]},{size[1]}"
    own = (window, f"--virtual-time-budget={budget_ms}", f"--user-data-dir={folder / 'profile'}")
    command = [
        browser,
        *_FLAGS,
        *own,
        *(_WITH_WEBGL if webgl else _WITHOUT_WEBGL),
        f"--screenshot={picture}",
        source.as_uri() + fragment,
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    said = re.findall(r":CONSOLE:\d+\] \"(.*)\", source: ", done.stderr)
    assert picture.is_file(), done.stderr[-2000:]
    with Image.open(picture) as image:
        return np.asarray(image.convert("RGB")).astype(int), [line for line in said if _DRIVER not in line]
