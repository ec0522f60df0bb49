"""Tiny folders of posed photographs, written here field by field: no code of ours."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SIZE = (6, 8)  # height, width
FOCAL = 9.0


def ring(count: int, distance: float = 4.0) -> np.ndarray:
    """OpenGL's poses (N, 4, 4) of cameras around the world's z axis, a little above, that look at the origin."""
    poses = []
    for angle in np.arange(count) * 2 * np.pi / count:
        position = distance * np.array([np.cos(angle), np.sin(angle), 0.4])
        back = position / np.linalg.norm(position)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        poses.append(pose)
    return np.array(poses)


def row(count: int, spread: float = 0.1) -> np.ndarray:
    """OpenGL's poses of cameras side by side that look along -z, each a little turned."""
    poses = []
    for x in np.linspace(-1, 1, count):
        c, s = np.cos(spread * x), np.sin(spread * x)
        pose = np.eye(4)
        pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        pose[:3, 3] = [x, 0.3 * x * x, 0.05 * x]
        poses.append(pose)
    return np.array(poses)


def pixels(index: int, size: tuple[int, int] = SIZE, channels: int = 4) -> np.ndarray:
    """A picture that is unlike the others: (H, W, channels) uint8."""
    rng = np.random.default_rng(index)
    rgba = rng.integers(0, 256, (*size, 4), dtype=np.uint8)
    rgba[..., 3] = 0
    rgba[1:-1, 2:-2, 3] = 255
    return rgba[..., :channels]


def save(path: Path, picture: np.ndarray, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, **options)


def write_json(path: Path, tree: Any) -> None:
    path.write_text(json.dumps(tree))


def blender_folder(folder: Path, counts: dict[str, int] | None = None) -> Path:
    counts = {"train": 4, "val": 2, "test": 3} if counts is None else counts
    angle = 2 * np.arctan(SIZE[1] / (2 * FOCAL))
    first = 0
    for split, count in counts.items():
        frames = []
        for index, pose in enumerate(ring(sum(counts.values()))[first : first + count]):
            save(folder / split / f"r_{index}.png", pixels(first + index))
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose.tolist()})
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
        first += count
    return folder


def transforms_folder(folder: Path, count: int = 9, **fields: Any) -> Path:
    frames = []
    for index, pose in enumerate(ring(count)):
        save(folder / "images" / f"{index:03d}.png", pixels(index))
        frames.append({"file_path": f"images/{index:03d}.png", "transform_matrix": pose.tolist()})
    camera = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 4.5, "cy": 2.5, "w": SIZE[1], "h": SIZE[0]}
    write_json(folder / "transforms.json", {**camera, **fields, "frames": frames})
    return folder


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """w x y z of a rotation, by the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    k = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [0, e - a - i, f + h, c - g],
            [0, 0, i - a - e, d - b],
            [0] * 3 + [a + e + i],
        ]
    )
    k = (k + np.triu(k, 1).T) / 3
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def colmap_folder(
    folder: Path, binary: bool, count: int = 9, model: tuple[int, str, tuple[float, ...]] | None = None
) -> Path:
    number, name, params = model or (1, "PINHOLE", (FOCAL, 10.0, 4.5, 2.5))
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    height, width = SIZE
    images = []
    for index, pose in enumerate(ring(count)):
        save(folder / "images" / f"{index} view.png", pixels(index, channels=3))
        rotation = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3].T
        images.append((*quaternion(rotation), *(-rotation @ pose[:3, 3])))
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    if binary:
        parts = [struct.pack("<QiiQQ", 1, 7, number, width, height), struct.pack(f"<{len(params)}d", *params)]
        (sparse / "cameras.bin").write_bytes(b"".join(parts))
        parts = [struct.pack("<Q", count)]
        for index, pose in enumerate(images):
            seen = struct.pack("<Qddq", 1, 1.0, 2.0, 3)
            parts.append(struct.pack("<i7di", index + 1, *pose, 7) + f"{index} view.png".encode() + b"\0" + seen)
        (sparse / "images.bin").write_bytes(b"".join(parts))
        parts = [struct.pack("<Q", len(points))]
        parts += [struct.pack("<Q3d3BdQii", i, *xyz, 1, 2, 3, 0.5, 1, 1, 0) for i, xyz in enumerate(points)]
        (sparse / "points3D.bin").write_bytes(b"".join(parts))
        return folder
    text = " ".join(map(str, params))
    (sparse / "cameras.txt").write_text(f"# a comment\n7 {name} {width} {height} {text}\n")
    lines = [f"{i + 1} {' '.join(map(str, pose))} 7 {i} view.png\n\n" for i, pose in enumerate(images)]
    (sparse / "images.txt").write_text("# a comment\n" + "".join(lines))
    rows = [f"{i} {' '.join(map(str, xyz))} 1 2 3 0.5 1 0\n" for i, xyz in enumerate(points)]
    (sparse / "points3D.txt").write_text("".join(rows))
    return folder


def llff_table(poses: np.ndarray, near: float = 2.0, far: float = 8.0) -> np.ndarray:
    """poses_bounds (N, 17)."""
    right, up, back, position = np.moveaxis(poses[:, :3], 2, 0)
    hwf = np.tile([*map(float, SIZE), FOCAL], (len(poses), 1))
    matrices = np.stack([-up, right, back, position, hwf], axis=2)
    return np.concatenate([matrices.reshape(-1, 15), np.tile([near, far], (len(poses), 1))], axis=1)


def llff_folder(folder: Path, poses: np.ndarray | None = None) -> Path:
    table = llff_table(row(9) if poses is None else poses)
    for index in range(len(table)):
        save(folder / "images" / f"{index:03d}.png", pixels(index, channels=3))
    np.save(folder / "poses_bounds.npy", table)
    return folder
