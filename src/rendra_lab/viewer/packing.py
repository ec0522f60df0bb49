"""Arrays and images as text for JSON.

An array is {"type", "shape", "data"}: little-endian, row by row, in base64. Quantised positions also have "low" and
"step" of every column: a number is low + step * count.
"""

import base64
import io
from typing import Any

import numpy as np
from PIL import Image

_TYPES = {np.dtype(code): name for code, name in (("<f4", "f32"), ("<u4", "u32"), ("<u2", "u16"), ("u1", "u8"))}
_QUANTISED_BEYOND = 50_000  # points; a step is 1/65535 of a side of the bounding box, under a pixel of any screen
_LARGEST_SIDE = 4096  # texels; what every WebGL 2 device of today takes
_PNG_UP_TO = 512 * 512  # texels; JPEG beyond


def packed_array(array: np.ndarray) -> dict[str, Any]:
    """A float32, uint32, uint16 or uint8 array."""
    array = np.ascontiguousarray(array)
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    data = base64.b64encode(little.tobytes()).decode("ascii")
    return {"type": _TYPES[little.dtype], "shape": list(array.shape), "data": data}


def packed_positions(points: np.ndarray) -> dict[str, Any]:
    """(P, 3) finite float32; in 16 bits where there are many."""
    if len(points) <= _QUANTISED_BEYOND:
        return packed_array(points.astype(np.float32))
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    step = (high - low) / 65535.0
    counts = np.round((points - low) / np.where(step > 0.0, step, 1.0))
    packed = packed_array(counts.clip(0, 65535).astype(np.uint16))
    return {**packed, "low": low.tolist(), "step": step.tolist()}


def packed_indices(indices: np.ndarray, count: int) -> dict[str, Any]:
    """Integers in [0, count), in 16 bits where they fit."""
    return packed_array(indices.astype(np.uint16 if count <= 65536 else np.uint32))


def packed_colors(colors: np.ndarray) -> dict[str, Any]:
    """(P, 3) RGB in [0, 1], cut off outside, in 8 bits; what is not a number is black."""
    return packed_array(_as_bytes(colors))


def packed_normals(normals: np.ndarray) -> dict[str, Any]:
    """(P, 3) directions of any length, in two 16-bit numbers each; no direction is kept as (0, 0).

    An octahedron is unfolded onto a square: Cigolle et al., "A Survey of Efficient Representations for Independent
    Unit Vectors", JCGT 3(2), 2014, Sec. 3.2. The error is below 0.005 degrees.
    """
    sizes = np.abs(normals).sum(axis=1, keepdims=True)
    known = np.isfinite(sizes) & (sizes > 0.0)
    n = np.where(known, normals, 0.0) / np.where(known, sizes, 1.0)
    folded = (1.0 - np.abs(n[:, [1, 0]])) * np.where(n[:, :2] < 0.0, -1.0, 1.0)
    square = np.where(n[:, 2:] < 0.0, folded, n[:, :2])
    # 1 to 65535 with 0 at 32768; (0, 0) of all numbers stays free
    counts = np.round(square * 32767.0) + 32768.0
    return packed_array(np.where(known, counts, 0.0).astype(np.uint16))


def packed_image(image: np.ndarray) -> tuple[str, tuple[int, int]]:
    """An RGB image (H, W, 3) in [0, 1] as a data URI, and its (width, height) there: large ones shrink.

    Small ones are kept to the bit in PNG, the others in JPEG.
    """
    picture = Image.fromarray(_as_bytes(image))
    picture.thumbnail((_LARGEST_SIDE, _LARGEST_SIDE))
    buffer = io.BytesIO()
    kind = "png" if picture.width * picture.height <= _PNG_UP_TO else "jpeg"
    picture.save(buffer, kind, **({"quality": 92, "subsampling": 0} if kind == "jpeg" else {}))
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f"data:image/{kind};base64,{data}", picture.size


def _as_bytes(colors: np.ndarray) -> np.ndarray:
    return np.round(np.nan_to_num(colors, nan=0.0).clip(0.0, 1.0) * 255.0).astype(np.uint8)
