"""Posed images written as folders of the formats that other projects read.

nerf_blender: NeRF's synthetic scenes, transforms_{train,val,test}.json. transforms: nerfstudio's and instant-ngp's
transforms.json. colmap: a sparse model as text and binary. llff: poses_bounds.npy of forward-facing captures.
"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from rendra_lab.data.colmap_folders import write_model
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import Scene
from rendra_lab.errors import UserError

_OURS = {"images", "sparse", "train", "val", "test", "poses_bounds.npy", "transforms.json"}
_OURS |= {f"transforms_{split}.json" for split in ("train", "val", "test")}
_Z_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]], dtype=torch.float64)  # row vectors: +Y becomes +Z


def write_scene(scene: Scene, folder: str | Path, format: str, overwrite: bool = False) -> Path:
    """Write all images of a scene and their cameras; the folder appears when it is complete.

    Blender's worlds and nerfstudio's have +Z up: there a scene with +Y up is turned. The other formats keep its axes,
    and have no division into training, validation and test images.

    Args:
        scene: what to write; `truth` gives colmap its points and llff its depths, where it is known.
        folder: made, with its parents.
        format: nerf_blender, transforms, colmap or llff.
        overwrite: replace a folder that holds such a scene.

    Returns:
        The folder.

    Raises:
        UserError: an unknown format, a folder that is not empty, or cameras that the format cannot hold.
    """
    check_output(folder, format, overwrite)
    folder = Path(folder).absolute()
    with folder_in_making(folder) as partial:
        _WRITERS[format](scene, partial)
    return folder


@contextlib.contextmanager
def folder_in_making(folder: Path) -> Iterator[Path]:
    """A hidden new folder beside `folder`, to be filled within the block; then it takes the name.

    What stood there before is replaced whole. Where the block fails, it stays, and nothing else is left.

    Args:
        folder: absolute; its parents are made.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        partial.mkdir()
        yield partial
        _put_in_place(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def check_output(folder: str | Path, format: str, overwrite: bool = False) -> None:
    """Refuse what `write_scene` would refuse, before anything is rendered; arguments are its own.

    Raises:
        UserError: an unknown format, or a folder that is not empty.
    """
    if format not in _WRITERS:
        raise UserError(f"format must be one of {', '.join(_WRITERS)}, got {format!r}")
    check_folder(Path(folder), _OURS, "no scene has", overwrite)


def check_folder(folder: Path, ours: Collection[str], foreign_words: str, overwrite: bool) -> None:
    """Refuse to write into a folder that holds anything, or, to overwrite it, anything that is not ours.

    Args:
        folder: that may not be there yet.
        ours: names of the files and folders that are written.
        foreign_words: what is said of another one after "which".
        overwrite: whether ours may go.

    Raises:
        UserError: so, or the folder is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"output={folder} is a file; a folder is written")
    present = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    if present and not overwrite:
        raise UserError(f"output={folder} is not empty: choose another folder, or overwrite=true")
    foreign = [name for name in present if name not in ours]
    if foreign:
        raise UserError(f"output={folder} holds {foreign[0]!r}, which {foreign_words}: it is not overwritten")


def camera_to_world(images: PosedImages) -> Tensor:
    """OpenGL's poses, as Blender has them: (N, 4, 4) float64 for column vectors; x right, y up, z backwards."""
    flip = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64, device=images.R.device)
    matrices = torch.eye(4, dtype=torch.float64, device=images.R.device).repeat(len(images), 1, 1)
    matrices[:, :3, :3] = images.R.double() * flip
    matrices[:, :3, 3] = images.positions.double()
    return matrices


def _put_in_place(partial: Path, folder: Path) -> None:
    """Rename, with what was there before aside until then."""
    if not folder.exists():
        partial.rename(folder)
        return
    old = partial.with_suffix(".old")
    folder.rename(old)
    try:
        partial.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    shutil.rmtree(old)


def _write_nerf_blender(scene: Scene, folder: Path) -> None:
    for name, images in _splits(scene).items():
        _demand_plain(images, "nerf_blender")
        poses = _z_up(scene, camera_to_world(images)).tolist()
        frames = [{"file_path": f"./{name}/r_{index}", "transform_matrix": pose} for index, pose in enumerate(poses)]
        angle = 2 * math.atan(float(images.sizes[0, 1]) / (2 * float(images.intrinsics[0, 0])))
        _write_json(folder / f"transforms_{name}.json", {"camera_angle_x": angle, "frames": frames})
        (folder / name).mkdir()
        for index in range(len(images)):
            _save_png(images, index, folder / name / f"r_{index}.png")


def _write_transforms(scene: Scene, folder: Path) -> None:
    splits = _splits(scene)
    lenses = [lens for images in splits.values() for lens in _lenses(images)]
    shared = {key: value for key, value in lenses[0].items() if all(lens.get(key) == value for lens in lenses)}
    if "camera_model" not in shared:
        raise UserError("format=transforms has one camera model, but some of the lenses are fisheye lenses")
    frames: list[dict[str, Any]] = []
    files: dict[str, list[str]] = {}
    (folder / "images").mkdir()
    for name, images in splits.items():
        poses = _z_up(scene, camera_to_world(images)).tolist()
        files[f"{name}_filenames"] = [f"images/{name}_{index:04d}.png" for index in range(len(images))]
        for index, file in enumerate(files[f"{name}_filenames"]):
            _save_png(images, index, folder / file)
            own = {key: value for key, value in lenses[len(frames)].items() if key not in shared}
            frames.append({"file_path": file, **own, "transform_matrix": poses[index]})
    _write_json(folder / "transforms.json", {**shared, "frames": frames, **files})


def _write_colmap(scene: Scene, folder: Path) -> None:
    images = _all_images(scene)
    names = _save_all(images, folder / "images")
    write_model(folder / "sparse" / "0", images, names, scene.truth)


def _write_llff(scene: Scene, folder: Path) -> None:
    images = _all_images(scene)
    _demand_plain(images, "llff")
    _save_all(images, folder / "images", background=255)
    right, up, back = camera_to_world(images)[:, :3, :3].unbind(2)
    hwf = torch.cat([images.sizes, images.intrinsics[:, :1]], dim=1).double()
    poses = torch.stack([-up, right, back, images.positions.double(), hwf], dim=2)  # (N, 3, 5)
    table = torch.cat([poses.flatten(1), _depths(scene, images)], dim=1)
    np.save(folder / "poses_bounds.npy", table.numpy())


_WRITERS: dict[str, Callable[[Scene, Path], None]] = {
    "nerf_blender": _write_nerf_blender,
    "transforms": _write_transforms,
    "colmap": _write_colmap,
    "llff": _write_llff,
}


def _splits(scene: Scene) -> dict[str, PosedImages]:
    splits = {"train": scene.train, "val": scene.val, "test": scene.test}
    return {name: images for name, images in splits.items() if len(images)}


def _all_images(scene: Scene) -> PosedImages:
    parts = list(_splits(scene).values())
    return PosedImages(
        labels=tuple(label for part in parts for label in part.labels),
        pixels=torch.cat([part.pixels for part in parts]),
        sizes=torch.cat([part.sizes for part in parts]),
        intrinsics=torch.cat([part.intrinsics for part in parts]),
        distortion=torch.cat([part.distortion for part in parts]),
        fisheye=torch.cat([part.fisheye for part in parts]),
        R=torch.cat([part.R for part in parts]),
        T=torch.cat([part.T for part in parts]),
        has_alpha=any(part.has_alpha for part in parts),
    )


def _z_up(scene: Scene, poses: Tensor) -> Tensor:
    """Poses (N, 4, 4) in a world whose +Z is up, where the scene's up is +Y."""
    if scene.up != (0.0, 1.0, 0.0):
        return poses
    turn = torch.eye(4, dtype=poses.dtype)
    turn[:3, :3] = _Z_UP.T
    return turn @ poses


def _demand_plain(images: PosedImages, format: str) -> None:
    """Refuse cameras that are not one lens without distortion, its axis in the middle of images of one size."""
    width, height = images.sizes[:, 1], images.sizes[:, 0]
    fx, fy, cx, cy = images.intrinsics.unbind(1)
    complaints = {
        "images of several sizes": bool((images.sizes != images.sizes[0]).any()),
        "lenses with distortion": bool(images.distortion.any()) or bool(images.fisheye.any()),
        "several focal lengths": not torch.allclose(fx, fx[0], rtol=1e-5) or not torch.allclose(fy, fx, rtol=1e-5),
        "principal points off the middle": not torch.allclose(
            torch.stack([cx, cy]), torch.stack([width, height]) / 2, rtol=0, atol=1e-3
        ),
    }
    found = [complaint for complaint, is_so in complaints.items() if is_so]
    if found:
        raise UserError(f"format={format} cannot hold {' and '.join(found)}: choose format=transforms or colmap")


def _lenses(images: PosedImages) -> list[dict[str, Any]]:
    """The intrinsics of each image as nerfstudio calls them."""
    if bool(images.distortion[:, 5:].any()):
        raise UserError("format=transforms cannot hold a lens with k4, k5 or k6: choose format=colmap")
    lenses = []
    for size, pinhole, lens, fisheye in zip(
        images.sizes.tolist(),
        images.intrinsics.tolist(),
        images.distortion.tolist(),
        images.fisheye.tolist(),
        strict=True,
    ):
        numbers = dict(zip(("fl_x", "fl_y", "cx", "cy"), pinhole, strict=True))
        order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        numbers |= dict(zip(order, lens, strict=False))
        model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
        lenses.append({"camera_model": model, "w": size[1], "h": size[0], **numbers})
    return lenses


def _depths(scene: Scene, images: PosedImages) -> Tensor:
    """The nearest and the farthest depth (N, 2) of what each camera sees: of the truth, or else of the box."""
    if scene.truth is not None:
        points = scene.truth.verts_packed().detach().cpu()
    else:
        points = torch.cartesian_prod(*scene.box.cpu().unbind(1))
    depths = torch.stack([points @ R[:, 2] + T[2] for R, T in zip(images.R, images.T, strict=True)]).double()
    return torch.stack([depths.amin(1).clamp_min(1e-3), depths.amax(1).clamp_min(2e-3)], dim=1)


def _save_all(images: PosedImages, folder: Path, background: int | None = None) -> list[str]:
    """Write every image as `view_0000.png` and so on; returns the names."""
    folder.mkdir()
    names = [f"view_{index:04d}.png" for index in range(len(images))]
    for index, name in enumerate(names):
        _save_png(images, index, folder / name, background)
    return names


def _save_png(images: PosedImages, index: int, path: Path, background: int | None = None) -> None:
    """RGBA where alpha means anything, else RGB; `background` lays it over a grey."""
    first, last = images.first_pixel[index : index + 2].tolist()
    rgba = images.pixels[first:last].reshape(*images.sizes[index].tolist(), 4).cpu()
    if background is not None:
        alpha = rgba[..., 3:] / 255
        rgba = (rgba * alpha + background * (1 - alpha)).round().to(torch.uint8)
    transparent = images.has_alpha and background is None
    Image.fromarray(rgba[..., : 4 if transparent else 3].contiguous().numpy()).save(path)


def _write_json(path: Path, tree: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")
