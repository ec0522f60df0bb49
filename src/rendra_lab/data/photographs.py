"""Photographs from files that others made: their sizes first, then their pixels, decoded side by side.

Pixels are taken as they stand in the file: EXIF data that would turn a picture are not followed, since the camera
that belongs to it was found for the picture as stored. Whatever is wrong with a file is a UserError that names it.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from rendra.renderer.camera_conversions import cameras_from_opengl
from rendra_lab.data.posed_images import NUM_DISTORTION, PosedImages
from rendra_lab.errors import UserError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm")
_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM", "TGA", "GIF")  # rasters only: EPS runs a program
_MOST_PIXELS = 8192 * 8192
_MOST_BYTES = 8 << 30
_ORIENTATION = 0x0112
_LARGEST = 1e18  # number of a camera: float32 holds its square too
_RIGID = 1e-3  # how far R^T R may be from the identity


@dataclass(frozen=True)
class Photograph:
    """A picture that is yet to be read, and the camera that took it; fields as in PosedImages."""

    path: Path
    where: str  # the file and the frame of it that name this picture, for complaints
    size: tuple[int, int]  # height, width, of the file
    intrinsics: tuple[float, float, float, float]
    R: Tensor  # (3, 3) float64
    T: Tensor  # (3,) float64
    distortion: tuple[float, ...] = (0.0,) * NUM_DISTORTION
    fisheye: bool = False
    mask: Path | None = None  # bright where the scene is; takes the place of alpha


def image_size(path: Path, where: str) -> tuple[int, int]:
    """Height and width of a picture, without reading its pixels.

    Raises:
        UserError: no file, no picture, or one of more than 8192 x 8192 pixels.
    """
    if not path.is_file():
        raise UserError(f"{where}: there is no file {path}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow's own, laxer limit
            with Image.open(path, formats=_FORMATS) as image:
                width, height = image.size
    except Exception as error:  # decoders raise what they like: OSError, SyntaxError, struct.error, KeyError
        raise _unreadable(path, where, error) from error
    if width * height > _MOST_PIXELS:
        raise UserError(f"{where}: {path} has {width} x {height} pixels; at most {_MOST_PIXELS:,} are read")
    return height, width


def demand_size(path: Path, where: str, found: tuple[int, int], expected: tuple[int, int], slack: float = 0) -> None:
    """Refuse a picture of another size (H, W) than its camera has, by more than `slack` pixels."""
    if all(abs(f - e) <= slack for f, e in zip(found, expected, strict=True)):
        return
    turned = ""
    if all(abs(f - e) <= slack for f, e in zip(found[::-1], expected, strict=True)) and _is_turned(path):
        turned = "; its EXIF data turn it, which cameras do not know of: store it turned"
    raise UserError(
        f"{where}: {path} is {found[1]} x {found[0]} pixels large, its camera {expected[1]} x {expected[0]}{turned}"
    )


def poses_from_opengl(camera_to_world: Tensor, where: Sequence[str]) -> tuple[Tensor, Tensor]:
    """R (N, 3, 3) and T (N, 3) as this library has them, of OpenGL's poses (N, 4, 4), all float64.

    Raises:
        UserError: a pose that is not finite or no rigid motion; `where` says which one it is.
    """
    demand_rotations(camera_to_world[:, :3, :3], where)
    bad = ~(camera_to_world.isfinite().flatten(1).all(1))
    bad |= (camera_to_world[:, 3] - camera_to_world.new_tensor([0, 0, 0, 1])).abs().amax(1) > _RIGID
    if bool(bad.any()):
        index = int(bad.nonzero()[0])
        raise UserError(
            f"{where[index]}: the pose must be finite and end in 0 0 0 1: {camera_to_world[index].tolist()}"
        )
    cameras = cameras_from_opengl(camera_to_world, (1, 1), focal_length_px=1.0, in_ndc=False)
    return cameras.R, cameras.T


def demand_rotations(matrices: Tensor, where: Sequence[str]) -> None:
    """Refuse (N, 3, 3) that scale, shear, mirror or are not finite; `where` says which one it is."""
    off = (matrices.mT @ matrices - torch.eye(3, dtype=matrices.dtype)).abs().flatten(1).amax(1)
    x, y, z = matrices.nan_to_num().unbind(1)
    mirrors = (torch.linalg.cross(x, y) * z).sum(1) < 0
    bad = ~(off <= _RIGID) | mirrors
    if not bool(bad.any()):
        return
    index = int(bad.nonzero()[0])
    if not bool(matrices[index].isfinite().all()):
        why = "holds numbers that are not finite"
    elif mirrors[index]:
        why = "mirrors: its axes are left-handed"
    else:
        lengths = " ".join(f"{length:.4g}" for length in matrices[index].norm(dim=0).tolist())
        why = (
            f"is no rotation: R^T R is {float(off[index]):.2g} from the identity, its columns have lengths {lengths}"
        )
    raise UserError(f"{where[index]}: the pose {why}")


def read_photographs(photographs: Sequence[Photograph], shrink: int = 1) -> PosedImages:
    """All pictures, in one tensor that is written once.

    Args:
        photographs: in the order of the result.
        shrink: pixels a side of which each pixel of the result is the mean, weighted by alpha. Rows and columns that
            are left over at the lower right are dropped.

    Raises:
        UserError: a picture that cannot be read, more than 8 GiB of pixels, or a camera of absurd numbers.
    """
    for photograph in photographs:
        _demand_float32(photograph)
    sizes = torch.tensor([p.size for p in photographs], dtype=torch.int64).reshape(-1, 2) // shrink
    for photograph, size in zip(photographs, sizes.tolist(), strict=True):
        if min(size) < 1:
            raise UserError(f"{photograph.where}: nothing is left of {photograph.path} with data.shrink={shrink}")
    bounds = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.prod(1).cumsum(0)]).tolist()
    if 4 * bounds[-1] > _MOST_BYTES:
        raise UserError(
            f"{len(photographs)} pictures take {4 * bounds[-1] / 2**30:.1f} GiB, and at most {_MOST_BYTES >> 30} are "
            "read: give data.shrink=2 or more"
        )
    pixels = torch.empty(bounds[-1], 4, dtype=torch.uint8)

    def fill(index: int) -> bool:
        rgba, has_alpha = _read(photographs[index])
        height, width = sizes[index].tolist()
        small = _shrunk(rgba, shrink) if shrink > 1 else rgba
        pixels[bounds[index] : bounds[index + 1]].view(height, width, 4).copy_(torch.from_numpy(small))
        return has_alpha

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about odd metadata
        with ThreadPoolExecutor(max_workers=min(8, 1 + (os.cpu_count() or 1))) as pool:
            alphas = list(pool.map(fill, range(len(photographs))))
    return _posed(photographs, pixels, sizes, shrink, any(alphas))


def _demand_float32(photograph: Photograph) -> None:
    """Refuse cameras whose numbers float32 cannot hold, or not their squares."""
    camera = {
        "intrinsics": photograph.intrinsics,
        "distortion": photograph.distortion,
        "pose": (*photograph.R.flatten().tolist(), *photograph.T.tolist()),
    }
    for name, numbers in camera.items():
        absurd = [number for number in numbers if not abs(number) < _LARGEST]
        if name == "intrinsics":
            absurd += [focal for focal in numbers[:2] if not focal > 1 / _LARGEST]
        if absurd:
            raise UserError(
                f"{photograph.where}: numbers of the camera's {name} do not fit into 32 bits: {absurd[0]:g}"
            )


def _posed(
    photographs: Sequence[Photograph], pixels: Tensor, sizes: Tensor, shrink: int, has_alpha: bool
) -> PosedImages:
    count = len(photographs)
    if count == 0:
        return PosedImages.gather([], [], torch.zeros(0, 4), torch.zeros(0, 3, 3), torch.zeros(0, 3))
    return PosedImages(
        labels=tuple(p.path.name for p in photographs),
        pixels=pixels,
        sizes=sizes,
        intrinsics=torch.tensor([p.intrinsics for p in photographs], dtype=torch.float64).div(shrink).float(),
        distortion=torch.tensor([p.distortion for p in photographs]).reshape(count, NUM_DISTORTION),
        fisheye=torch.tensor([p.fisheye for p in photographs], dtype=torch.bool),
        R=torch.stack([p.R for p in photographs]).float(),
        T=torch.stack([p.T for p in photographs]).float(),
        has_alpha=has_alpha,
    )


def _read(photograph: Photograph) -> tuple[npt.NDArray[np.uint8], bool]:
    """RGBA (H, W, 4), and whether its alpha means anything."""
    image = decode(photograph.path, photograph.where)
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    rgba = np.array(image.convert("RGBA"))
    demand_size(photograph.path, photograph.where, rgba.shape[:2], photograph.size)
    if photograph.mask is None:
        return rgba, has_alpha
    image_size(photograph.mask, f"{photograph.where}, mask")
    mask = np.asarray(decode(photograph.mask, f"{photograph.where}, mask").convert("L"))
    demand_size(photograph.mask, f"{photograph.where}, mask", mask.shape[:2], photograph.size)
    rgba[..., 3] = np.minimum(rgba[..., 3], mask)
    return rgba, True


def decode(path: Path, where: str) -> Image.Image:
    """A picture of 8 bits a channel, or a palette, as it stands in the file; the first one of several.

    Raises:
        UserError: no picture that can be read to its end, or one of floating-point numbers.
    """
    try:
        with Image.open(path, formats=_FORMATS) as image:
            image.load()
    except Exception as error:  # decoders raise what they like: OSError, SyntaxError, struct.error, KeyError
        raise _unreadable(path, where, error) from error
    if image.mode == "F":
        raise UserError(f"{where}: {path} holds floating-point numbers; expected 8 or 16 bits a channel")
    if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clip
        levels = (np.asarray(image, np.float32) / 257).round().clip(0, 255)
        return Image.fromarray(levels.astype(np.uint8))
    return image


def _shrunk(rgba: npt.NDArray[np.uint8], factor: int) -> npt.NDArray[np.uint8]:
    """Means of blocks; colours weigh as much as they cover."""
    height, width = rgba.shape[0] // factor, rgba.shape[1] // factor
    blocks = rgba[: height * factor, : width * factor].reshape(height, factor, width, factor, 4)
    alpha = blocks[..., 3:].astype(np.float32)
    covered = alpha.sum((1, 3))
    colours = (blocks[..., :3] * alpha).sum((1, 3)) / np.maximum(covered, 1)
    means = np.concatenate([colours, covered / factor**2], axis=-1)
    return means.round().astype(np.uint8)


def _is_turned(path: Path) -> bool:
    try:
        with Image.open(path, formats=_FORMATS) as image:
            return image.getexif().get(_ORIENTATION, 1) != 1
    except Exception:  # whatever the decoder says, it says nothing about turning
        return False


def _unreadable(path: Path, where: str, error: Exception) -> UserError:
    return UserError(f"{where}: {path} is not a picture that can be read: {error}")
