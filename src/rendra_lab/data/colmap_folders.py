"""A sparse model of COLMAP, written as text and as binary.

Source: COLMAP's documentation, "Output Format". Its pixels are `posed_images`' own; x_camera = R x_world + t for
column vectors, with x to the right and y down. Numbers are little-endian, ids begin at 1.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rendra.ops import sample_points_from_meshes
from rendra.renderer import MeshRasterizer, PerspectiveCameras, RasterizationSettings
from rendra.structures import Meshes
from rendra.transforms import matrix_to_quaternion
from rendra_lab.data.posed_images import PosedImages, distorted
from rendra_lab.records import TensorRecord

_MODEL_IDS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
_NUM_POINTS = 2000  # sampled; those that fewer than two images see are left out
_OCCLUSION = 0.01  # how far behind the surface a point may seem to lie, in parts of its depth


@dataclass(frozen=True)
class _Camera:
    """One lens, shared by the images that have it."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _Points(TensorRecord):
    """P points of the surface and where the N images show them."""

    xyz: Float[Tensor, "P 3"]
    rgb: UInt8[Tensor, "P 3"]
    seen: Bool[Tensor, "N P"]
    xy: Float[Tensor, "N P 2"]


@dataclass(frozen=True)
class _View:
    """One image: its pose, its lens, and the points that it shows."""

    qvec: list[float]  # w x y z
    tvec: list[float]
    camera: int
    name: str
    xy: list[list[float]]
    points: list[int]


def write_model(folder: Path, images: PosedImages, names: Sequence[str], truth: Meshes | None) -> None:
    """Write cameras, images and points3D, each as .txt and as .bin, to a new folder.

    Args:
        folder: made, with its parents.
        images: the cameras.
        names: of the image files.
        truth: where the points come from; None writes none.
    """
    points = _no_points(len(images)) if truth is None else _seen_points(truth, images)
    lenses = [_camera(images, index) for index in range(len(images))]
    cameras = list(dict.fromkeys(lenses))
    flip = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
    qvec = matrix_to_quaternion((images.R.double().cpu() * flip).transpose(1, 2)).tolist()
    tvec = (images.T.double().cpu() * flip).tolist()
    views = [
        _View(
            qvec[index],
            tvec[index],
            cameras.index(lenses[index]) + 1,
            names[index],
            points.xy[index][points.seen[index]].tolist(),
            (points.seen[index].nonzero()[:, 0] + 1).tolist(),
        )
        for index in range(len(images))
    ]
    folder.mkdir(parents=True)
    _write_text(folder, cameras, views, points)
    (folder / "cameras.bin").write_bytes(_cameras_bytes(cameras))
    (folder / "images.bin").write_bytes(_images_bytes(views))
    (folder / "points3D.bin").write_bytes(_points_bytes(points))


def _camera(images: PosedImages, index: int) -> _Camera:
    height, width = images.sizes[index].tolist()
    pinhole, lens = images.intrinsics[index].tolist(), images.distortion[index].tolist()
    if bool(images.fisheye[index]):
        return _Camera("OPENCV_FISHEYE", width, height, (*pinhole, *lens[:4]))
    if not any(lens):
        return _Camera("PINHOLE", width, height, tuple(pinhole))
    full = any(lens[4:])
    return _Camera("FULL_OPENCV" if full else "OPENCV", width, height, (*pinhole, *lens[: 8 if full else 4]))


def _write_text(folder: Path, cameras: list[_Camera], views: list[_View], points: _Points) -> None:
    lenses = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lenses += [f"{i} {c.model} {c.width} {c.height} {_spaced(c.params)}" for i, c in enumerate(cameras, 1)]
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, view in enumerate(views, 1):
        lines.append(f"{number} {_spaced(view.qvec)} {_spaced(view.tvec)} {view.camera} {view.name}")
        lines.append(" ".join(f"{_spaced(xy)} {point}" for xy, point in zip(view.xy, view.points, strict=True)))
    rows = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    tracks = _tracks(points)
    for number, (xyz, rgb) in enumerate(zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)):
        track = " ".join(f"{image} {place}" for image, place in tracks[number])
        rows.append(f"{number + 1} {_spaced(xyz)} {_spaced(rgb)} 0 {track}")
    for name, text in (("cameras", lenses), ("images", lines), ("points3D", rows)):
        (folder / f"{name}.txt").write_text("\n".join(text) + "\n", encoding="utf-8")


def _cameras_bytes(cameras: list[_Camera]) -> bytes:
    parts = [struct.pack("<Q", len(cameras))]
    for number, camera in enumerate(cameras, 1):
        parts.append(struct.pack("<iiQQ", number, _MODEL_IDS[camera.model], camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    return b"".join(parts)


def _images_bytes(views: list[_View]) -> bytes:
    parts = [struct.pack("<Q", len(views))]
    for number, view in enumerate(views, 1):
        parts.append(struct.pack("<i7di", number, *view.qvec, *view.tvec, view.camera))
        parts.append(view.name.encode() + b"\0" + struct.pack("<Q", len(view.points)))
        parts += [struct.pack("<ddq", *xy, point) for xy, point in zip(view.xy, view.points, strict=True)]
    return b"".join(parts)


def _points_bytes(points: _Points) -> bytes:
    parts, tracks = [struct.pack("<Q", len(points.xyz))], _tracks(points)
    for number, (xyz, rgb) in enumerate(zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)):
        parts.append(struct.pack("<Q3d3BdQ", number + 1, *xyz, *rgb, 0.0, len(tracks[number])))
        parts += [struct.pack("<ii", image, place) for image, place in tracks[number]]
    return b"".join(parts)


def _tracks(points: _Points) -> list[list[tuple[int, int]]]:
    """For each point the images that show it, and its place among what each shows."""
    tracks: list[list[tuple[int, int]]] = [[] for _ in points.xyz]
    places = (points.seen.cumsum(1) - 1).tolist()
    for image, point in points.seen.nonzero().tolist():
        tracks[point].append((image + 1, places[image][point]))
    return tracks


def _no_points(num_images: int) -> _Points:
    return _Points(
        torch.zeros(0, 3),
        torch.zeros(0, 3, dtype=torch.uint8),
        torch.zeros(num_images, 0, dtype=torch.bool),
        torch.zeros(num_images, 0, 2),
    )


@torch.no_grad()
def _seen_points(truth: Meshes, images: PosedImages) -> _Points:
    """Points sampled from the surface, the same ones every time, that two images or more show."""
    truth = truth.to("cpu")
    generator = torch.Generator().manual_seed(0)
    samples = sample_points_from_meshes(truth, _NUM_POINTS, True, True, generator=generator)
    xyz, normals, rgb = (part[0] for part in samples)
    rgb = rgb.clamp(0, 1).mul(255).round().to(torch.uint8)
    looks = [_look(truth, images, index, xyz, normals) for index in range(len(images))]
    seen, xy = torch.stack([seen for seen, _ in looks]), torch.stack([xy for _, xy in looks])
    kept = seen.sum(0) >= 2
    return _Points(xyz[kept], rgb[kept], seen[:, kept], xy[:, kept])


def _look(truth: Meshes, images: PosedImages, index: int, xyz: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Whether an image shows each of the points (P,) of a surface, and where (P, 2)."""
    height, width = images.sizes[index].tolist()
    intrinsics = images.intrinsics[index]
    in_view = xyz @ images.R[index] + images.T[index]
    depth = in_view[:, 2].clamp_min(1e-6)
    slope = -in_view[:, :2] / depth[:, None]
    lens, fisheye = images.distortion[index].expand(len(xyz), -1), images.fisheye[index].expand(len(xyz))
    straight = slope * intrinsics[:2] + intrinsics[2:]
    xy = distorted(slope, lens, fisheye) * intrinsics[:2] + intrinsics[2:]
    size = xy.new_tensor([width, height])
    inside = (in_view[:, 2] > 1e-6) & ((xy >= 0) & (xy < size) & (straight >= 0) & (straight < size)).all(1)
    column, row = straight.minimum(size - 1).clamp_min(0).long().unbind(1)
    nearest = _depth_map(truth, images, index)[row, column]
    faces_us = ((images.positions[index] - xyz) * normals).sum(1) > 0
    return inside & faces_us & (nearest > 0) & (depth < nearest * (1 + _OCCLUSION)), xy


def _depth_map(truth: Meshes, images: PosedImages, index: int) -> Tensor:
    """Depth (H, W) of the surface without distortion; -1 where nothing is."""
    height, width = images.sizes[index].tolist()
    cameras = PerspectiveCameras(
        focal_length=images.intrinsics[index : index + 1, :2],
        principal_point=images.intrinsics[index : index + 1, 2:],
        R=images.R[index : index + 1],
        T=images.T[index : index + 1],
        in_ndc=False,
        image_size=[(height, width)],
    )
    return MeshRasterizer(cameras, RasterizationSettings((height, width)))(truth).zbuf[0, ..., 0]


def _spaced(numbers: Sequence[float]) -> str:
    return " ".join(f"{number!r}" for number in numbers)
