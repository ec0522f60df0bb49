"""The viewer's style and program, and a page that is nothing but a viewer."""

import html
import json
from functools import cache
from pathlib import Path
from typing import Any

_ASSETS = Path(__file__).parent / "assets"
# in the order in which one needs the other; together they are one function, and `RendraViewer` is all that leaves it
_SOURCES = (
    "algebra.js",
    "geometry.js",
    "shaders.js",
    "view.js",
    "drawing.js",
    "gestures.js",
    "panel.js",
    "viewer.js",
)


@cache
def viewer_assets() -> tuple[str, str]:
    """The text of the style sheet and of the program, for a `<style>` and a `<script>` of the same page.

    The program defines `RendraViewer.mount(element, payload, options)` and no other name. Neither text holds "</".
    Options, each of which may be left out: `yaw` and `pitch` of the first view in degrees; `background`, "light",
    "white", "grey" or "dark"; `controls`, false for none. The element takes its height from the page's own style.
    """
    parts = [(_ASSETS / name).read_text(encoding="utf-8") for name in _SOURCES]
    program = '(function () {\n"use strict";\n' + "\n".join(parts) + "\n})();\n"
    return (_ASSETS / "viewer.css").read_text(encoding="utf-8"), program


def payload_json(payload: dict[str, Any]) -> str:
    """JSON that may stand inside a `<script>`: no name in it can end the element or open a comment."""
    text = json.dumps(payload, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def viewer_page(title: str, payload: dict[str, Any]) -> str:
    """One self-contained HTML page that the viewer fills.

    Args:
        title: of the window.
        payload: from `scene_payload`.
    """
    style, program = viewer_assets()
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{html.escape(title)}</title>
<style>
html, body {{ height: 100%; margin: 0; overflow: hidden; }}
#scene {{ height: 100%; }}
{style}</style>
</head>
<body>
<div id="scene"></div>
<noscript>This page draws with JavaScript, which is switched off here.</noscript>
<script type="application/json" id="payload">{payload_json(payload)}</script>
<script>
{program}const payload = JSON.parse(document.getElementById("payload").textContent);
RendraViewer.mount(document.getElementById("scene"), payload);
</script>
</body>
</html>
"""
