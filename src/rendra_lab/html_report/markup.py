"""Text into HTML: everything is escaped but what `tag` made, and a page runs no script but its own."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
from collections.abc import Iterable, Mapping
from importlib import resources
from string import Template
from typing import Any

_VOID = frozenset({"img", "input", "br"})


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, *children: Any, **attributes: Any) -> Markup:
    """One element; children that are not Markup are escaped.

    Attributes: `class_` is `class`, other underscores are hyphens; True stands alone, None and False are left out.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        label = key.rstrip("_").replace("_", "-")
        words.append(label if value is True else f'{label}="{html.escape(str(value))}"')
    opening = f"<{' '.join(words)}>"
    return Markup(opening if name in _VOID else f"{opening}{joined(children)}</{name}>")


def joined(children: Iterable[Any]) -> Markup:
    """Children one after the other; None is nothing."""
    return Markup("".join(_escaped(child) for child in children if child is not None))


def data_block(identity: str, content: Any) -> Markup:
    """Data for the page's script, in an element that browsers do not run and no text can close."""
    text = json.dumps(without_infinities(content), separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(f'<script type="application/json" id="{html.escape(identity)}">{text}</script>')


def without_infinities(value: Any) -> Any:
    """NaN and infinities as None, which JSON knows."""
    if isinstance(value, Mapping):
        return {str(key): without_infinities(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinities(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def section(identity: str, title: str, *children: Any) -> Markup:
    """A part of the page with its heading; nothing where there is nothing in it."""
    content = joined(children)
    if not content:
        return Markup()
    return tag("section", tag("h2", title), content, id=identity, data_title=title)


def table(head: Iterable[Any], rows: Iterable[Iterable[Any]], class_: str | None = None) -> Markup:
    """A table; cells that are `td` or `th` elements already stay as they are."""
    heading = tag("thead", tag("tr", *(_cell(cell, "th") for cell in head)))
    body = tag("tbody", *(tag("tr", *(_cell(cell, "td") for cell in row)) for row in rows))
    return tag("div", tag("table", heading, body, class_=class_), class_="scroll")


def page(title: str, heading: Markup, sections: Iterable[Markup], data: Any, assets: tuple[str, str]) -> str:
    """The whole file.

    Args:
        title: of the window.
        heading: what stands above the sections.
        sections: made by `section`; empty ones are left out.
        data: for `report.js`.
        assets: further CSS and JavaScript, trusted.
    """
    parts = [part for part in sections if part]
    script = _inline(assets[1] + "\n" + _package_text("report.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Template(_package_text("template.html")).substitute(
        title=html.escape(title),
        digest=digest,
        css=_package_text("report.css") + "\n" + assets[0],
        heading=heading,
        contents=joined(_contents(part) for part in parts),
        sections="\n".join(parts),
        data=data_block("report-data", data),
        script=script,
    )


def _contents(part: Markup) -> Markup:
    """The link to a section, from its own opening tag."""
    _, identity, _, title, _ = part.split('"', 4)
    return tag("a", Markup(title), href=f"#{html.unescape(identity)}")


def _escaped(child: Any) -> str:
    return child if isinstance(child, Markup) else html.escape(str(child))


def _cell(content: Any, name: str) -> Markup:
    ready = isinstance(content, Markup) and content.startswith(("<td", "<th"))
    return Markup(content) if ready else tag(name, content)


def _package_text(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _inline(script: str) -> str:
    """A script that may stand in a page: no text in it closes the element, and no carriage return its hash."""
    return script.replace("\r\n", "\n").replace("</script", "<\\/script").replace("<!--", "<\\!--")
