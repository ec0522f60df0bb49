"""Pictures of textures: the map with its coordinates or its UV islands, and the atlas face by face.

Pixel (0, 0) of a map is its top left corner; v = 1 is its first row.
"""

import math
from typing import Any

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV


def texturesuv_image_matplotlib(
    texture: TexturesUV,
    *,
    texture_index: int = 0,
    radius: float = 1,
    color: Any = (1.0, 0.0, 0.0),
    subsample: int | None = 10000,
    origin: str = "upper",
) -> None:
    """Show the map of one mesh in the current matplotlib axes, with a circle at each of its coordinates.

    Coordinates that no face uses are drawn too.

    Args:
        texture: of a batch.
        texture_index: which mesh.
        radius: of the circles, in pixels of the map.
        color: of the circles, as matplotlib understands it.
        subsample: draw about as many coordinates, evenly chosen; None for all.
        origin: "upper" or "lower", where the first row goes, as in `imshow`.

    Raises:
        ImportError: matplotlib is missing.
        ValueError: no such mesh, a mesh with several maps, or a map with neither 1, 3 nor 4 channels.
    """
    try:
        import matplotlib.pyplot as plt
        from matplotlib.patches import Circle
    except ImportError as error:
        raise ImportError(
            "texturesuv_image_matplotlib needs matplotlib: pip install matplotlib; texturesuv_image_PIL does without"
        ) from error
    image, centers = _map_image(texture, texture_index), _centers(texture, texture_index, subsample)
    axes = plt.gca()
    axes.imshow(image, origin=origin)
    for x, y in centers:
        axes.add_patch(Circle((x, y), radius, color=color))


def texturesuv_image_PIL(
    texture: TexturesUV,
    *,
    texture_index: int = 0,
    radius: float = 1,
    color: Any = "red",
    subsample: int | None = 10000,
) -> Image.Image:
    """The map of one mesh, with a dot at each of its coordinates.

    Coordinates that no face uses are drawn too.

    Args:
        texture: of a batch.
        texture_index: which mesh.
        radius: of the dots, in pixels.
        color: of the dots, as PIL understands it.
        subsample: draw about as many coordinates, evenly chosen; None for all.

    Returns:
        An RGB image of the size of the map.

    Raises:
        ValueError: no such mesh, a mesh with several maps, or a map with neither 1, 3 nor 4 channels.
    """
    image = _map_image(texture, texture_index)
    draw = ImageDraw.Draw(image)
    for x, y in _centers(texture, texture_index, subsample):
        draw.ellipse([(x - radius, y - radius), (x + radius, y + radius)], fill=color)
        draw.point((round(x), round(y)), fill=color)  # an ellipse without extent leaves nothing
    return image


def texturesuv_islands_image(
    texture: TexturesUV,
    *,
    texture_index: int = 0,
    size: int | None = None,
    color: Any = "red",
    inner_color: Any = "#9a9a9a",
    width: int = 1,
) -> Image.Image:
    """The map of one mesh with its UV islands: the triangles that faces cut out of it, and the islands' borders.

    Beside PyTorch3D's API.

    Args:
        texture: of a batch.
        texture_index: which mesh.
        size: longer side of the picture in pixels; None for that of the map.
        color: of the borders, edges with a triangle on one side only; as PIL understands it.
        inner_color: of all other edges; None leaves them away.
        width: of the borders' lines in pixels.

    Returns:
        An RGB image. What lies outside the map is cut.

    Raises:
        ValueError: no such mesh, a mesh with several maps, or a map with neither 1, 3 nor 4 channels.
    """
    image = _map_image(texture, texture_index)
    original = torch.tensor(image.size)
    if size is not None:
        scale = size / max(image.size)
        image = image.resize([max(1, round(side * scale)) for side in image.size], Image.Resampling.LANCZOS)
    uvs = texture.verts_uvs_list()[texture_index].detach().cpu()
    places = texture._sampling().texels(uvs, int(original[1]), int(original[0]))
    places = (places + 0.5) * torch.tensor(image.size) / original - 0.5
    edges, is_border = _uv_edges(texture.faces_uvs_list()[texture_index].cpu())
    draw = ImageDraw.Draw(image)
    for chosen, ink, thick in ((~is_border, inner_color, 1), (is_border, color, width)):
        ends = places[edges[chosen]].flatten(1)
        for line in ends[ends.isfinite().all(1)].tolist() if ink is not None else ():
            draw.line(line, fill=ink, width=thick)
    return image


def texture_atlas_image(
    texture: TexturesAtlas, *, texture_index: int = 0, columns: int | None = None, texel_px: int | None = None
) -> Image.Image:
    """The atlas of one mesh: the (R, R) texels of every face as a square, in the order of the faces.

    Beside PyTorch3D's API. Square (row, column) shows face row * columns + column; squares without a face are white.

    Args:
        texture: of a batch.
        texture_index: which mesh.
        columns: squares in a row; None makes the picture about square.
        texel_px: pixels along one side of a texel; None chooses it so that the picture is some 512 pixels wide.

    Returns:
        An RGB image.

    Raises:
        ValueError: no such mesh, or colours with neither 1, 3 nor 4 channels.
    """
    if not isinstance(texture, TexturesAtlas):
        raise ValueError(f"texture must be a TexturesAtlas, got {type(texture).__name__}")
    _check_index(texture, texture_index)
    atlas = _as_rgb(texture.atlas_list()[texture_index])  # (F, R, R, 3)
    num_faces, R = atlas.shape[:2]
    columns = columns or max(1, math.ceil(math.sqrt(num_faces)))
    rows = max(1, math.ceil(num_faces / columns))
    squares = atlas.new_full((rows * columns, R, R, 3), 255)
    squares[:num_faces] = atlas
    sheet = squares.view(rows, columns, R, R, 3).transpose(1, 2).reshape(rows * R, columns * R, 3)
    scale = texel_px or max(1, 512 // (columns * R))
    return Image.fromarray(sheet.repeat_interleave(scale, 0).repeat_interleave(scale, 1).numpy())


def _check_index(texture: TexturesUV | TexturesAtlas, index: int) -> None:
    if not 0 <= index < len(texture):
        raise ValueError(f"texture_index must lie in [0, {len(texture)}), got {index!r}")


def _as_rgb(colors: Tensor) -> Tensor:
    """Colours (..., 1|3|4) in [0, 1] as bytes (..., 3) on the CPU; alpha is dropped."""
    if colors.shape[-1] not in (1, 3, 4):
        raise ValueError(f"only colours of 1, 3 or 4 channels can be shown, got {colors.shape[-1]}")
    colors = colors.detach().cpu().float().nan_to_num(0.0).clamp(0, 1)[..., :3]
    return colors.expand(*colors.shape[:-1], 3).mul(255).round().to(torch.uint8)


def _map_image(texture: TexturesUV, index: int) -> Image.Image:
    if not isinstance(texture, TexturesUV):
        raise ValueError(f"texture must be a TexturesUV, got {type(texture).__name__}")
    _check_index(texture, index)
    if texture.multi_map:
        raise ValueError("this texture has several maps for one mesh; only a single one can be shown")
    return Image.fromarray(_as_rgb(texture.maps_list()[index]).contiguous().numpy())


def _centers(texture: TexturesUV, index: int, subsample: int | None) -> list[list[float]]:
    """Where coordinates lie on the map, (x, y) in pixels; at most `subsample` of them."""
    centers = texture.centers_for_image(index=index).detach().cpu()
    if subsample is not None and len(centers) > subsample:
        centers = centers[torch.linspace(0, len(centers) - 1, subsample).round().long()]
    return centers[centers.isfinite().all(1)].tolist()


def _uv_edges(faces_uvs: Tensor) -> tuple[Tensor, Tensor]:
    """Each edge between texture coordinates once (E, 2), and whether only one triangle has it (E,)."""
    faces = faces_uvs[(faces_uvs >= 0).all(1)]
    sides = faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2).sort(dim=1).values
    edges, counts = torch.unique(sides, dim=0, return_counts=True)
    return edges, counts == 1
