"""Materials of OBJ files: colours, texture images, and the per-face texture atlas made from them.

Letters: F faces, R side of one face's square of texels. Colours are RGB in [0, 1] as the file has them. Texture
coordinates (u, v) have their origin at the bottom left of the image, whose corner texels' centres are (0, 0) and
(1, 1).
"""

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.common.datatypes import Device
from rendra.io._images import decode_image
from rendra.io._source import FileLike, PathManager, Source, neighbour, read_neighbour, read_source
from rendra.io.errors import MeshFormatError

MaterialProperties: TypeAlias = dict[str, dict[str, Tensor]]
TextureImages: TypeAlias = dict[str, Tensor]

_COLORS = {"Ka": "ambient_color", "Kd": "diffuse_color", "Ks": "specular_color"}
_LARGEST_ATLAS = 1 << 32  # bytes
# How many values each option of a map statement takes, at most; -o, -s and -t may have fewer numbers.
_MAP_OPTIONS = {
    b"-blendu": 1, b"-blendv": 1, b"-boost": 1, b"-bm": 1, b"-cc": 1, b"-clamp": 1, b"-imfchan": 1,
    b"-mm": 2, b"-o": 3, b"-s": 3, b"-t": 3, b"-texres": 1, b"-type": 1, b"-colorspace": 1,
}  # fmt: skip
_VECTOR_OPTIONS = (b"-o", b"-s", b"-t", b"-mm")


def load_mtl(
    f: FileLike,
    *,
    material_names: Sequence[str],
    data_dir: str,
    device: Device = "cpu",
    path_manager: PathManager | None = None,
    allow_outside: bool = False,
) -> tuple[MaterialProperties, TextureImages]:
    """Read a material library.

    Read are newmtl, Ka, Kd, Ks (RGB; one number means grey), Ns and map_Kd. Everything else is passed over,
    spectral and XYZ colours too. A texture that is missing, or a name that is not defined, is a warning.

    Args:
        f: path or open handle of the .mtl file.
        material_names: materials whose textures are wanted, in the order wanted.
        data_dir: folder in which texture files are looked for.
        device: where the tensors go.
        path_manager: interprets paths where given.
        allow_outside: let texture paths leave `data_dir`.

    Returns:
        For every material of the file its properties, as far as given: ambient_color, diffuse_color and
        specular_color (3,), shininess (1,). For the wanted materials that have one, the texture (H, W, 3).

    Raises:
        MeshFormatError: malformed statement, broken image, or a texture path that leaves the folder.
    """
    library = read_source(f, path_manager)
    return read_materials([library], material_names, data_dir, device, path_manager, allow_outside)


def read_materials(
    libraries: Sequence[Source],
    material_names: Sequence[str],
    data_dir: str,
    device: Device,
    path_manager: PathManager | None,
    allow_outside: bool,
) -> tuple[MaterialProperties, TextureImages]:
    """Read several material libraries as `load_mtl` reads one; a material defined twice is what the last one says."""
    properties: MaterialProperties = {}
    maps: dict[str, _Map] = {}
    for library in libraries:
        more_properties, more_maps = _parse_mtl(library, device)
        for name in more_properties:
            maps.pop(name, None)
        properties.update(more_properties)
        maps.update(more_maps)
    images: TextureImages = {}
    for name in material_names:
        if name not in properties:
            among = ", ".join(library.name for library in libraries)
            warnings.warn(f"Material {name!r} is used, but {among} does not define it", stacklevel=4)
        elif name in maps:
            image = _read_texture(maps[name], data_dir, path_manager, allow_outside)
            if image is not None:
                images[name] = image.to(device)
    return properties, images


@dataclass(frozen=True)
class _Map:
    """A texture file as a library names it."""

    library: str
    line: int
    written: str


def _read_texture(
    texture: _Map, data_dir: str, path_manager: PathManager | None, allow_outside: bool
) -> Tensor | None:
    path = neighbour(
        data_dir,
        texture.written,
        file=texture.library,
        line=texture.line,
        path_manager=path_manager,
        allow_outside=allow_outside,
    )
    data = read_neighbour(path, path_manager)
    if data is None:
        warnings.warn(f"Texture file does not exist: {path}", stacklevel=5)
        return None
    return decode_image(data, path)


def _parse_mtl(source: Source, device: Device) -> tuple[MaterialProperties, dict[str, _Map]]:
    """Properties and texture of each material."""
    properties: MaterialProperties = {}
    maps: dict[str, _Map] = {}
    current: str | None = None
    for line, word, rest in _statements(source.data):
        if word == b"newmtl":
            current = _name(rest, source, line)
            properties[current] = {}
            continue
        if word not in (b"Ka", b"Kd", b"Ks", b"Ns", b"map_Kd"):
            continue
        if current is None:
            raise MeshFormatError("a property before any material", source.name, line, word.decode(), "newmtl first")
        if word == b"map_Kd":
            maps[current] = _Map(source.name, line, _texture_name(rest, source, line))
        elif word == b"Ns":
            properties[current]["shininess"] = torch.tensor(_numbers(rest, (1,), source, line), device=device)
        elif not rest.startswith((b"spectral", b"xyz")):
            color = _numbers(rest, (1, 3), source, line)
            properties[current][_COLORS[word.decode()]] = torch.tensor((color * 3)[:3], device=device)
    return properties, maps


def _statements(data: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Line number, keyword and the rest of every statement."""
    for line, text in enumerate(re.split(rb"\r\n|\n|\r", data), start=1):
        words = text.split(maxsplit=1)
        if words and not words[0].startswith(b"#"):
            yield line, words[0], words[1].strip() if len(words) > 1 else b""


def _name(rest: bytes, source: Source, line: int) -> str:
    if not rest:
        raise MeshFormatError("newmtl without a name", source.name, line)
    return rest.decode("utf-8", "replace")


def _texture_name(rest: bytes, source: Source, line: int) -> str:
    """The file name of a map statement, which may hold spaces, without the options before it."""
    words, at = list(re.finditer(rb"\S+", rest)), 0
    while at < len(words) and words[at][0] in _MAP_OPTIONS:
        option = words[at][0]
        behind = min(at + 1 + _MAP_OPTIONS[option], len(words))
        at += 1
        while at < behind and (option not in _VECTOR_OPTIONS or _is_number(words[at][0])):
            at += 1
    if at == len(words):
        raise MeshFormatError("a texture map without a file name", source.name, line, expected="map_Kd <file>")
    return rest[words[at].start() :].decode("utf-8", "replace")


def _is_number(word: bytes) -> bool:
    return re.fullmatch(rb"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", word) is not None


def _numbers(rest: bytes, counts: tuple[int, ...], source: Source, line: int) -> list[float]:
    words = rest.partition(b"#")[0].split()
    values = [float(word) for word in words if _is_number(word)]
    if len(words) not in counts or len(values) != len(words) or not _fit_single(values):
        expected = " or ".join(map(str, counts)) + (" finite number" if counts == (1,) else " finite numbers")
        raise MeshFormatError("bad material value", source.name, line, rest.decode("utf-8", "replace"), expected)
    return values


def _fit_single(values: list[float]) -> bool:
    """Whether all are finite in single precision."""
    return all(abs(value) <= torch.finfo(torch.float32).max for value in values)


def make_mesh_texture_atlas(
    material_properties: MaterialProperties,
    texture_images: TextureImages,
    face_material_names: Sequence[str] | np.ndarray,
    faces_uvs: Tensor,
    texture_size: int,
    texture_wrap: str | None,
) -> Tensor:
    """Paint every face of a mesh onto its own square of texels.

    A face takes its material's image, else its material's diffuse colour, else white.

    Args:
        material_properties, texture_images: as `load_mtl` returns them.
        face_material_names: F names; an empty one means no material.
        faces_uvs: (F, 3, 2) texture coordinates of the corners.
        texture_size: R.
        texture_wrap: "repeat" tiles the plane with the image, "clamp" continues its border; None leaves the
            coordinates alone, and texels beyond the image take its border too.

    Returns:
        (F, R, R, 3), for `TexturesAtlas`.

    Raises:
        ValueError: unknown `texture_wrap`, R below 1, or an atlas of more than 4 GiB.
    """
    _check_atlas(len(faces_uvs), texture_size, texture_wrap)
    size = (len(faces_uvs), texture_size, texture_size, 3)
    atlas = torch.ones(size, dtype=torch.float32, device=faces_uvs.device)
    numbers = {name: number for number, name in enumerate(dict.fromkeys(face_material_names))}
    number_of_face = torch.tensor([numbers[name] for name in face_material_names], device=faces_uvs.device)
    for name, number in numbers.items():
        faces = torch.nonzero(number_of_face == number)[:, 0]
        if name in texture_images:
            image = texture_images[name].to(atlas)
            atlas[faces] = make_material_atlas(image, faces_uvs[faces], texture_size, texture_wrap=texture_wrap)
        elif "diffuse_color" in material_properties.get(name, {}):
            atlas[faces] = material_properties[name]["diffuse_color"].to(atlas)
    return atlas


def _check_atlas(num_faces: int, texture_size: int, texture_wrap: str | None) -> None:
    if texture_wrap not in ("repeat", "clamp", None):
        raise ValueError(f'texture_wrap is {texture_wrap!r}; expected "repeat", "clamp" or None')
    if texture_size < 1:
        raise ValueError(f"texture_size is {texture_size}; expected 1 or more texels")
    if (needed := 12 * num_faces * texture_size**2) > _LARGEST_ATLAS:
        raise ValueError(
            f"an atlas of {num_faces} faces x {texture_size}^2 texels takes {needed >> 20:,} MiB; reduce it"
        )


def make_material_atlas(
    image: Tensor, faces_verts_uvs: Tensor, texture_size: int, *, texture_wrap: str | None = None
) -> Tensor:
    """Sample one image at the texels of every face.

    A face's square holds its triangle twice over: texel (x, y) with x + y < R is the upright small triangle at
    barycentric ((x + 1/3)/R, (y + 1/3)/R); the others are the inverted ones, folded in from the far corner, at
    ((R - 1 - x + 2/3)/R, (R - 1 - y + 2/3)/R) (the layout of SoftRas, Liu et al., ICCV 2019). The image is
    interpolated bilinearly.

    Args:
        image: (H, W, 3).
        faces_verts_uvs: (F, 3, 2) texture coordinates of the corners.
        texture_size: R.
        texture_wrap: as in `make_mesh_texture_atlas`; each texel wraps by itself, so faces may cross the seam.

    Returns:
        (F, R, R, 3), rows first: y, then x.
    """
    _check_atlas(len(faces_verts_uvs), texture_size, texture_wrap)
    num_faces, channels = len(faces_verts_uvs), image.shape[-1]
    weights = _texel_barycentrics(texture_size).to(faces_verts_uvs)
    uvs = torch.einsum("tc,fcd->ftd", weights, faces_verts_uvs)  # (F, R * R, 2)
    if texture_wrap == "repeat":
        uvs = torch.where((uvs < 0) | (uvs > 1), uvs - uvs.floor(), uvs)
    grid = (2.0 * uvs - 1.0) * uvs.new_tensor([1.0, -1.0])  # image rows run downwards
    texels = F.grid_sample(
        image.permute(2, 0, 1)[None], grid[None].to(image), padding_mode="border", align_corners=True
    )  # (1, C, F, R * R)
    return texels[0].permute(1, 2, 0).reshape(num_faces, texture_size, texture_size, channels)


def _texel_barycentrics(texture_size: int) -> Tensor:
    """(R * R, 3) barycentric coordinates of the texels' centres; rows run over y, then x."""
    steps = torch.arange(texture_size, dtype=torch.float64)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    inverted = x + y >= texture_size
    far = texture_size - 1
    first = torch.where(inverted, far - x + 2 / 3, x + 1 / 3) / texture_size
    second = torch.where(inverted, far - y + 2 / 3, y + 1 / 3) / texture_size
    return torch.stack([first, second, 1.0 - first - second], dim=-1).reshape(-1, 3)
