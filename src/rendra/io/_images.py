"""Texture images: foreign files in, 8-bit files out."""

import io
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from rendra.io.errors import MeshFormatError

MAX_TEXTURE_PIXELS = 8192 * 8192  # 805 MB once it is float32 RGB
_PIXELS_AT_ONCE = 1 << 20
_FORMATS = ("PNG", "JPEG", "BMP", "TGA", "TIFF", "WEBP", "GIF", "PPM", "DDS")  # rasters only: EPS runs a program
_SUFFIX = {"png": "png", "jpeg": "jpg"}


def decode_image(data: bytes, name: str) -> Tensor:
    """Read an image as (H, W, 3) float32 RGB in [0, 1], turned upright where its EXIF data says so.

    Palettes are looked up, 16-bit grey keeps its 16 bits, opacity is dropped.

    Raises:
        MeshFormatError: no known raster image, truncated, broken, or more than MAX_TEXTURE_PIXELS pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow's own, laxer limit and of odd metadata
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                _demand_size(image, name)
                ImageOps.exif_transpose(image, in_place=True)
                pixels = _rgb(image)
    except MeshFormatError:
        raise
    except Image.DecompressionBombError as error:
        raise MeshFormatError("the image is too large", name, expected=_limit()) from error
    except UnidentifiedImageError as error:  # its own words name a buffer of ours
        raise MeshFormatError("cannot decode the image (unknown kind)", name, expected=", ".join(_FORMATS)) from error
    except Exception as error:  # decoders raise what they like: OSError, SyntaxError, struct.error, KeyError
        raise MeshFormatError(f"cannot decode the image ({error})", name, expected=", ".join(_FORMATS)) from error
    return torch.from_numpy(pixels)


def _limit() -> str:
    return f"at most {MAX_TEXTURE_PIXELS:,} pixels"


def _demand_size(image: Image.Image, name: str) -> None:
    width, height = image.size
    if width * height > MAX_TEXTURE_PIXELS:
        raise MeshFormatError("the image is too large", name, found=f"{width} x {height}", expected=_limit())


def _rgb(image: Image.Image) -> npt.NDArray[np.float32]:
    """(H, W, 3) in [0, 1], converted in strips: beside the result only the image itself takes memory."""
    pixels = np.empty((image.height, image.width, 3), dtype=np.float32)
    rows = max(1, _PIXELS_AT_ONCE // max(1, image.width))
    for top in range(0, image.height, rows):
        bottom = min(top + rows, image.height)
        strip = image.crop((0, top, image.width, bottom))
        strip.info = image.info  # a crop of a palette forgets which of its colours is transparent
        pixels[top:bottom] = _rgb_strip(strip)
    return pixels


def _rgb_strip(image: Image.Image) -> npt.NDArray[np.float32]:
    """(H, W, 3), or (H, W, 1) of grey."""
    if image.mode.startswith("I"):  # 16-bit grey, also where Pillow widened it to 32
        grey = np.asarray(image, dtype=np.float32) / 65535.0
    elif image.mode == "F":
        grey = np.nan_to_num(np.asarray(image, dtype=np.float32))
    else:
        flat = image.convert("RGBA") if "transparency" in image.info else image
        return np.asarray(flat.convert("RGB"), dtype=np.float32) / np.float32(255.0)
    return grey.clip(0.0, 1.0)[..., None]


def image_suffix(image_format: str) -> str:
    """File suffix of a format that textures can be written in.

    Raises:
        ValueError: neither "png" nor "jpeg".
    """
    if image_format not in _SUFFIX:
        raise ValueError(f"image_format is {image_format!r}; expected one of {sorted(_SUFFIX)}")
    return _SUFFIX[image_format]


def encode_image(pixels: Tensor, image_format: str, quality: int | None = None) -> bytes:
    """Write (H, W, 3) RGB in [0, 1] (clamped) as 8-bit PNG or JPEG; `quality`, 1 to 95, is JPEG's."""
    levels = (pixels.detach().cpu().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    options: dict[str, Any] = {"quality": quality} if quality is not None and image_format == "jpeg" else {}
    buffer = io.BytesIO()
    Image.fromarray(levels).save(buffer, format=image_format.upper(), **options)
    return buffer.getvalue()
