"""Pictures and animations inside a page, within its size."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import dataclass, field
from pathlib import Path

from rendra_lab.html_report.markup import Markup, tag

_TYPES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".webp": "image/webp",
    ".gif": "image/gif",
    ".mp4": "video/mp4",
    ".webm": "video/webm",
}
_STILLS = (".png", ".jpg", ".jpeg", ".webp")
_MOVING = (".gif", ".mp4", ".webm")
_LARGE = 400_000  # bytes; a picture beyond is encoded anew
_WIDEST = 1600  # pixels
_NUMBERED = re.compile(r"^(step|val|test)_(\d+)$")


@dataclass
class Room:
    """What is left of a page's size, and what it left out."""

    left: int  # bytes
    notes: list[str] = field(default_factory=list)

    def take(self, size: int, name: str) -> bool:
        """Whether so many bytes still fit; what does not is noted."""
        if size > self.left:
            self.notes.append(f"{name} ({size / 1e6:.1f} MB) did not fit.")
            return False
        self.left -= size
        return True


@dataclass(frozen=True)
class Frame:
    """A file and what it shows."""

    path: Path
    caption: str
    step: int | None = None


@dataclass
class Reel:
    """Pictures that belong together, in their order."""

    identity: str
    title: str
    frames: list[Frame]


def find_pictures(folder: Path, last_step: int | None) -> list[Reel]:
    """The pictures of a run: single ones first, then fit, validation and test as reels."""
    reels: dict[str, Reel] = {
        "step": Reel("fit", "Fit", []),
        "val": Reel("val", "Validation, first batch", []),
        "test": Reel("test", "Test", []),
    }
    single = []
    for path in sorted((folder / "images").glob("*")):
        match = _NUMBERED.match(path.stem)
        if path.suffix.lower() not in _STILLS:
            continue
        if match:
            number, kind = int(match[2]), match[1]
            caption = f"view {match[2]}" if kind == "test" else f"step {number}"
            reels[kind].frames.append(Frame(path, caption, None if kind == "test" else number))
        elif path.stem == "final":
            reels["step"].frames.append(Frame(path, "end of the fit", last_step))
        else:
            single.append(path)
    reels["step"].frames.sort(key=lambda frame: (frame.path.stem == "final", frame.step or 0))
    single += [path for path in sorted((folder / "exports").glob("*")) if path.suffix.lower() in _STILLS]
    alone = [Reel(path.stem, path.stem.replace("_", " "), [Frame(path, path.stem)]) for path in single]
    return [reel for reel in (*alone, *reels.values()) if reel.frames]


def find_animations(folder: Path) -> list[Frame]:
    """GIF and MP4 files of a run."""
    found = [path for part in ("exports", "images") for path in sorted((folder / part).glob("*"))]
    return [Frame(path, path.stem.replace("_", " ")) for path in found if path.suffix.lower() in _MOVING]


def reel_figures(reel: Reel, room: Room, share: int) -> Markup:
    """The frames of a reel as figures, thinned out evenly to its share of bytes; the script adds the slider."""
    kept = _thinned(reel, room, share)
    figures = [figure for frame in kept if (figure := still_figure(frame, room, reel.title)) is not None]
    if not figures:
        return Markup()
    return tag("div", *figures, class_="reel", data_reel=reel.identity)


def still_figure(frame: Frame, room: Room, title: str) -> Markup | None:
    """One picture with its caption; None where it cannot be read or does not fit."""
    try:
        address = _still_address(frame.path)
    except (OSError, ValueError) as error:
        room.notes.append(f"{frame.path.name} cannot be read ({type(error).__name__}).")
        return None
    if not room.take(len(address), frame.path.name):
        return None
    words = frame.caption if frame.caption.startswith(title) else f"{title}: {frame.caption}"
    picture = tag("img", src=address, alt=words, decoding="async")
    return tag("figure", picture, tag("figcaption", frame.caption), data_step=frame.step)


def animation_figure(frame: Frame, room: Room) -> Markup | None:
    """A moving picture with its caption; None where it does not fit."""
    try:
        address = _address(frame.path.read_bytes(), _TYPES[frame.path.suffix.lower()])
    except OSError as error:
        room.notes.append(f"{frame.path.name} cannot be read ({type(error).__name__}).")
        return None
    if not room.take(len(address), frame.path.name):
        return None
    if frame.path.suffix.lower() == ".gif":
        shown = tag("img", src=address, alt=f"animation: {frame.caption}")
    else:
        shown = tag("video", src=address, controls=True, loop=True, muted=True, autoplay=True, playsinline=True)
    return tag("figure", shown, tag("figcaption", frame.caption))


def _thinned(reel: Reel, room: Room, share: int) -> list[Frame]:
    sizes = [min(_size(frame.path), _LARGE) * 4 // 3 + 200 for frame in reel.frames]
    most = len(sizes)
    while most > 1 and sum(sizes) * most // len(sizes) > share:
        most -= 1
    if most < len(sizes):
        room.notes.append(f"{reel.title}: {len(sizes) - most} of {len(sizes)} pictures were left out for size.")
    if most == 1:
        return reel.frames[-1:]
    return [reel.frames[round(index * (len(sizes) - 1) / (most - 1))] for index in range(most)]


def _size(path: Path) -> int:
    return path.stat().st_size


def _still_address(path: Path) -> str:
    if _size(path) <= _LARGE:
        return _address(path.read_bytes(), _TYPES[path.suffix.lower()])
    from PIL import Image

    with Image.open(path) as image:
        pixels = image.convert("RGBA")
    pixels.thumbnail((_WIDEST, 4 * _WIDEST))
    white = Image.new("RGBA", pixels.size, "white")
    encoded = io.BytesIO()
    Image.alpha_composite(white, pixels).convert("RGB").save(encoded, "JPEG", quality=88)
    return _address(encoded.getvalue(), "image/jpeg")


def _address(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
