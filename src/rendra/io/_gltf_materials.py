"""The base colour of glTF materials.

Colours are the file's numbers: nothing is converted between linear light and sRGB. Opacity is dropped.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from torch import Tensor

from rendra.io._gltf_asset import Asset
from rendra.io._gltf_json import Item
from rendra.io._images import MAX_TEXTURE_PIXELS, decode_image

REPEAT, CLAMP, MIRROR, NEAREST = 10497, 33071, 33648, 9728


@dataclass(frozen=True)
class Texture:
    """How a material reads an image.

    Attributes:
        image: its index.
        coordinates: which TEXCOORD_n of the primitive it takes.
        moved: (2, 3) affine map of the file's texture coordinates (KHR_texture_transform); None for none.
        wraps: what lies beyond the image in u and in v, the constants of glTF's samplers.
        nearest: whether texels are not interpolated.
    """

    image: int
    coordinates: int
    moved: npt.NDArray[np.float64] | None
    wraps: tuple[int, int]
    nearest: bool


@dataclass(frozen=True)
class Material:
    """What a material says of the base colour.

    Attributes:
        factor: (r, g, b), by which texture and vertex colours are multiplied; None where the file has none.
        texture: None where it has none.
    """

    factor: tuple[float, float, float] | None
    texture: Texture | None


def read_material(asset: Asset, index: int) -> Material:
    """One material; that of KHR_materials_pbrSpecularGlossiness where there is no other.

    Raises:
        MeshFormatError: a field of another type, or a reference to nothing.
    """
    item = asset.materials[index]
    base, names = item.item("pbrMetallicRoughness"), ("baseColorFactor", "baseColorTexture")
    if base is None:
        base, names = item.extension("KHR_materials_pbrSpecularGlossiness"), ("diffuseFactor", "diffuseTexture")
    if base is None:
        return Material(None, None)
    factor = None
    if names[0] in base:
        red, green, blue, _ = base.numbers(names[0], [1.0] * 4).tolist()
        factor = (red, green, blue)
    info = base.item(names[1])
    return Material(factor, None if info is None else _read_texture(asset, info))


def _read_texture(asset: Asset, info: Item) -> Texture | None:
    number = info.index("index", len(asset.textures), "textures")
    if number is None:
        info.fail("index", "is missing")
    texture = asset.textures[number]
    webp = texture.extension("EXT_texture_webp")
    image = (webp or texture).index("source", len(asset.images), "images")
    if image is None:
        image = texture.index("source", len(asset.images), "images")
    if image is None:
        return None  # glTF leaves it to extensions; a texture without a picture is white
    sampler_number = texture.index("sampler", len(asset.samplers), "samplers")
    sampler = Item({}, "", info.file) if sampler_number is None else asset.samplers[sampler_number]
    moved = info.extension("KHR_texture_transform")
    coordinates = info.integer("texCoord", 0)
    if moved is not None:
        coordinates = moved.integer("texCoord", coordinates)
    return Texture(
        image,
        coordinates,
        None if moved is None else _affine(moved),
        (_wrap(sampler, "wrapS"), _wrap(sampler, "wrapT")),
        sampler.integer("magFilter", 9729) == NEAREST,
    )


def _wrap(sampler: Item, key: str) -> int:
    value = sampler.integer(key, REPEAT)
    if value not in (REPEAT, CLAMP, MIRROR):
        sampler.fail(key, "unknown wrapping", value, f"{REPEAT}, {CLAMP} or {MIRROR}")
    return value


def _affine(item: Item) -> npt.NDArray[np.float64]:
    """(2, 3) of scaling, then turning counter-clockwise as seen (v runs down), then shifting."""
    angle = item.number("rotation", 0.0)
    scale, offset = item.numbers("scale", [1.0, 1.0]), item.numbers("offset", [0.0, 0.0])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.concatenate([turn * scale, offset[:, None]], axis=1)


class Pictures:
    """The decoded images of an asset, each (H, W, 3) float32 in [0, 1], decoded when first asked for."""

    def __init__(self, asset: Asset) -> None:
        self._asset = asset
        self._decoded: dict[int, Tensor | None] = {}
        self._pixels = 0

    def __getitem__(self, index: int) -> Tensor | None:
        """One image; None where its file does not exist.

        Raises:
            MeshFormatError: broken, or more pixels than one texture may have, all images taken together.
        """
        if index not in self._decoded:
            found = self._asset.image(index)
            self._decoded[index] = None if found is None else decode_image(*found)
            self._count(index, self._decoded[index])
        return self._decoded[index]

    def _count(self, index: int, image: Tensor | None) -> None:
        self._pixels += 0 if image is None else image.shape[0] * image.shape[1]
        if self._pixels > MAX_TEXTURE_PIXELS:
            limit = f"at most {MAX_TEXTURE_PIXELS:,} pixels"
            self._asset.images[index].fail(None, "the images together are too large", f"{self._pixels:,}", limit)
