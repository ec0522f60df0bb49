"""Pictures for people: captioned sheets, GIF and MP4 files, and the sRGB transfer function.

An image is a tensor (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), or a batch (B, H, W, C) of such, with sRGB
values in [0, 1]; alpha is not premultiplied. A picture is a uint8 array (H, W, 3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

Picture = np.ndarray  # uint8, (H, W, 3)

_PAPER = 255
_INK = (40, 40, 40)
_GAP_PX = 6
_VIRIDIS = ("440154", "472d7b", "3b528b", "2c728e", "21908c", "27ad81", "5dc863", "aadc32", "fde725")


def linear_to_srgb(linear: Tensor) -> Tensor:
    """Light in [0, 1] to display values in [0, 1], any shape. Source: IEC 61966-2-1."""
    safe = linear.clamp_min(0.0031308)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * safe ** (1 / 2.4) - 0.055)


def srgb_to_linear(srgb: Tensor) -> Tensor:
    """Display values in [0, 1] to light in [0, 1], any shape. Source: IEC 61966-2-1."""
    safe = srgb.clamp_min(0.04045)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((safe + 0.055) / 1.055) ** 2.4)


def to_picture(image: Tensor) -> Picture:
    """An image as uint8 (H, W, 3): grey is repeated, alpha is laid over white, a batch becomes a grid.

    Values outside [0, 1] are cut, NaN becomes magenta. Raises ValueError for other shapes.
    """
    image = image.detach().to("cpu", torch.float32)
    if image.ndim == 4:
        return tile([to_picture(single) for single in image])
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[-1] not in (1, 3, 4):
        raise ValueError(f"an image is (H, W), (H, W, 1|3|4) or (B, H, W, C), got {tuple(image.shape)}")
    broken = image.isnan().any(-1)
    image = image.nan_to_num(0.0).clamp(0, 1)
    if image.shape[-1] == 4:
        image = image[..., :3] * image[..., 3:] + (1 - image[..., 3:])
    image = image.expand(*image.shape[:2], 3).clone()
    image[broken] = torch.tensor([1.0, 0.0, 1.0])
    return (image * 255).round().to(torch.uint8).numpy()


def tile(pictures: Sequence[Picture], columns: int | None = None) -> Picture:
    """Pictures in rows, a white gap between them; about square unless the number of columns is given.

    Raises ValueError for an empty sequence.
    """
    if not pictures:
        raise ValueError("a sheet needs at least one picture")
    columns = columns or math.ceil(math.sqrt(len(pictures)))
    rows = [pictures[start : start + columns] for start in range(0, len(pictures), columns)]
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    sheet_shape = (_extent(len(rows), height), _extent(min(columns, len(pictures)), width), 3)
    sheet = np.full(sheet_shape, _PAPER, np.uint8)
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            top, left = y * (height + _GAP_PX), x * (width + _GAP_PX)
            sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return sheet


def caption(picture: Picture, text: str) -> Picture:
    """The picture with a line of text above it, cut where the picture ends."""
    font = _font()
    height, width = picture.shape[:2]
    line = font.getbbox("Ag")[3] + 4
    page = Image.new("RGB", (width, height + line), (_PAPER,) * 3)
    ImageDraw.Draw(page).text((2, 1), text, fill=_INK, font=font)
    page.paste(Image.fromarray(picture), (0, line))
    return np.asarray(page)


def side_by_side(images: Mapping[str, Tensor], height_px: int | None = None) -> Picture:
    """Captioned images in one row, scaled to a common height (the tallest one's unless given)."""
    pictures = {name: to_picture(image) for name, image in images.items()}
    return captioned_row(pictures, height_px)


def captioned_row(pictures: Mapping[str, Picture], height_px: int | None = None) -> Picture:
    """`side_by_side` for pictures that are made already."""
    if not pictures:
        raise ValueError("a row needs at least one picture")
    height = height_px or max(picture.shape[0] for picture in pictures.values())
    row = [caption(resize(picture, height), name) for name, picture in pictures.items()]
    return _hstack(row)


def story(chapters: Sequence[tuple[str, Mapping[str, Picture]]], height_px: int = 192) -> Picture:
    """How pictures came about: first those that never change, then one row for each other, chapter by chapter.

    Args:
        chapters: title and pictures by name, the same names in each.
        height_px: of a picture.

    Raises:
        ValueError: no chapters.
    """
    if not chapters:
        raise ValueError("a story needs at least one chapter")
    first = chapters[0][1]
    constant = [name for name in first if all(np.array_equal(first[name], other[name]) for _, other in chapters)]
    rows = [[caption(resize(first[name], height_px), name) for name in constant]]
    rows += [
        [caption(resize(pictures[name], height_px), f"{title}: {name}") for title, pictures in chapters]
        for name in first
        if name not in constant
    ]
    return tile([_hstack(row) for row in rows if row], columns=1)


def resize(picture: Picture, height_px: int) -> Picture:
    """The picture at another height; the width follows."""
    height, width = picture.shape[:2]
    if height == height_px:
        return picture
    size = (max(1, round(width * height_px / height)), height_px)
    method = Image.Resampling.LANCZOS if height_px < height else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(picture).resize(size, method))


def silhouette_overlay(fit: Tensor, target: Tensor) -> Tensor:
    """Two silhouettes (H, W) in one image (H, W, 3): grey where both are, blue the fit alone, orange the target."""
    fit, target = fit[..., None], target[..., None]
    blue, orange = fit.new_tensor([0.15, 0.45, 0.9]), fit.new_tensor([0.95, 0.55, 0.1])
    return 1 - fit * target * 0.35 - fit * (1 - target) * (1 - blue) - (1 - fit) * target * (1 - orange)


def viridis(value: Tensor) -> Tensor:
    """Colours (..., 3) for values (...) in [0, 1], dark violet to light yellow, evenly spaced to the eye.

    Nine of the map's colours, with straight lines between them. Source: van der Walt and Smith, 2015.
    """
    anchors = value.new_tensor([[int(color[at : at + 2], 16) / 255 for at in (0, 2, 4)] for color in _VIRIDIS])
    place = value.nan_to_num(0.0).clamp(0, 1) * (len(anchors) - 1)
    low = place.long().clamp(max=len(anchors) - 2)
    flat = low.reshape(-1)
    here, above = (anchors.index_select(0, index).reshape(*value.shape, 3) for index in (flat, flat + 1))
    return here.lerp(above, (place - low)[..., None])


def depth_limits(depth: Tensor, opacity: Tensor) -> tuple[float, float]:
    """The nearest and the farthest distance worth a colour: all but 1 % of what is seen, on both ends."""
    seen = depth[(opacity > 0.5) & depth.isfinite()]
    if not len(seen):
        return 0.0, 1.0
    ordered = seen.double().sort().values
    last = len(ordered) - 1
    near, far = float(ordered[round(0.01 * last)]), float(ordered[round(0.99 * last)])
    return near, max(far, near + 1e-6 * abs(near) + 1e-12)


def depth_image(depth: Tensor, opacity: Tensor, limits: tuple[float, float] | None = None) -> Tensor:
    """Distances (..., H, W) as colours (..., H, W, 3): near is yellow, far violet, white where nothing is.

    Args:
        depth: distances.
        opacity: in [0, 1]; how much of the colour stands before white.
        limits: the distances of the first and the last colour; None: `depth_limits` of this image.
    """
    near, far = depth_limits(depth, opacity) if limits is None else limits
    color = viridis((far - depth) / (far - near))
    cover = opacity.clamp(0, 1)[..., None]
    return color * cover + (1 - cover)


def normal_image(normals: Tensor) -> Tensor:
    """Normals (..., H, W, 3) as the usual colours (n + 1) / 2; white where they are zero."""
    return torch.where(normals.abs().amax(-1, keepdim=True) > 0, (normals + 1) / 2, 1)


def save_picture(path: str | Path, picture: Picture) -> Path:
    """Writes a PNG or JPEG, by the ending of the path; makes the folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)
    return path


def can_write_mp4() -> bool:
    """Whether the extra [view] is there."""
    return find_spec("av") is not None


def save_animation(path: str | Path, frames: Sequence[Picture], fps: float = 12.0, hold_s: float = 1.0) -> Path:
    """Writes a GIF, or an MP4 where the path ends so; the last frame stays for `hold_s` seconds.

    Raises ValueError for no frames or another ending, and ImportError for MP4 without the extra [view].
    """
    path = Path(path)
    if not frames:
        raise ValueError(f"an animation needs at least one frame: {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = _same_size(frames)
    if path.suffix == ".gif":
        _save_gif(path, frames, fps, hold_s)
    elif path.suffix == ".mp4":
        _save_mp4(path, [*frames, *[frames[-1]] * round(hold_s * fps)], fps)
    else:
        raise ValueError(f"an animation ends in .gif or .mp4, got {path}")
    return path


def _save_gif(path: Path, frames: Sequence[Picture], fps: float, hold_s: float) -> None:
    # one palette for all frames: no flicker, and a smaller file
    sample = Image.fromarray(np.concatenate(frames[:: max(1, len(frames) // 8)]))
    _, commonest = max(sample.getcolors(sample.width * sample.height))  # type: ignore[arg-type]
    palette = sample.quantize(254)
    pages = [_page(frame, palette, commonest) for frame in frames]
    ends = [round(100 * page / fps) for page in range(len(pages))]  # the format counts hundredths of a second
    durations = [10 * max(1, end - begin) for begin, end in pairwise(ends)] + [round(1000 * max(hold_s, 1 / fps))]
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=durations, loop=0, optimize=False)


def _page(frame: Picture, palette: Image.Image, exact: Any) -> Image.Image:
    """In the colours of a palette, and in one more that stays what it is, as a white background does."""
    page = Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
    colors = page.getpalette()
    assert colors is not None
    indices = np.array(page)
    indices[(frame == exact).all(axis=2)] = len(colors) // 3
    answer = Image.fromarray(indices)
    answer.putpalette([*colors, *exact])
    return answer


def _save_mp4(path: Path, frames: Sequence[Picture], fps: float) -> None:
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise ImportError("MP4 needs a video encoder: pip install -e '.[view]'; or choose .gif") from error
    import imageio.v3 as imageio

    height, width = (size - size % 2 for size in frames[0].shape[:2])  # the codec halves the colour planes
    stack = np.stack([frame[:height, :width] for frame in frames])
    imageio.imwrite(path, stack, plugin="pyav", codec="libx264", fps=round(fps))


def _same_size(frames: Sequence[Picture]) -> list[Picture]:
    height, width = (max(frame.shape[axis] for frame in frames) for axis in (0, 1))
    return [
        np.pad(
            frame,
            ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0)),
            constant_values=_PAPER,
        )
        for frame in frames
    ]


def _extent(count: int, size: int) -> int:
    return count * size + (count - 1) * _GAP_PX


def _hstack(pictures: Sequence[Picture]) -> Picture:
    height = max(picture.shape[0] for picture in pictures)
    width = sum(picture.shape[1] for picture in pictures) + _GAP_PX * (len(pictures) - 1)
    sheet = np.full((height, width, 3), _PAPER, np.uint8)
    left = 0
    for picture in pictures:
        sheet[: picture.shape[0], left : left + picture.shape[1]] = picture
        left += picture.shape[1] + _GAP_PX
    return sheet


@lru_cache
def _font() -> Any:
    return ImageFont.load_default(size=13)
