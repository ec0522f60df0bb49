"""Poses and shapes from files or chance, and pictures of bodies: what each beta and each joint does.

Letters: J joints, V vertices, N betas.  Radians and metres; bodies at rest have y up and look along +z.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.body import SMPL
from rendra.body.restricted_pickle import PickleRefused, read_pickle
from rendra.renderer import TexturesVertex
from rendra.structures import Meshes
from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.errors import UserError
from rendra_lab.pictures import OrbitCamera, Studio
from rendra_lab.visualization import Picture, caption, tile, to_picture

SHEETS = ("betas", "joints")
BETA_STEPS = (-2.0, -1.0, 0.0, 1.0, 2.0)
JOINT_TURN = math.radians(40)
_CLAY = (0.80, 0.76, 0.72)
_HELD = (0.90, 0.36, 0.10)  # what a joint holds
_ARMS_DOWN = 1.0  # radians; so that bodies stand close together
_AZIMUTH, _ELEVATION = 25.0, 5.0  # degrees; of sheets
_MARGIN = 1.05  # about what a sheet shows
_MOST_BYTES = 2**24  # of a file of poses
_FIT_KEY = "center_px"  # which a file of fits has beside its poses


@dataclass(frozen=True)
class BodyNumbers:
    """One body: what a model makes its vertices of.

    Attributes:
        pose: (1, J, 3) rotation vectors.
        betas: (1, N).
    """

    pose: Tensor
    betas: Tensor

    def save(self, path: Path) -> Path:
        """As JSON, which `read_numbers` takes."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"pose": self.pose[0].tolist(), "betas": self.betas[0].tolist()}, indent=1) + "\n")
        return path


def rest_numbers(body: SMPL) -> BodyNumbers:
    """The mean body at rest."""
    like = body.v_template
    return BodyNumbers(like.new_zeros(1, body.num_joints, 3), like.new_zeros(1, body.num_betas))


def random_numbers(body: SMPL, seed: int, pose_spread: float = 0.2, beta_spread: float = 0.03) -> BodyNumbers:
    """A body as the script of SMPL draws one: the pose's numbers from [0, 0.2), then the shape's from [0, 0.03).

    With the same seed as `numpy.random.seed` there, the same body, but upright where that script turns it by pi.
    """
    stream = np.random.RandomState(seed)  # NumPy's old one, which that script uses
    pose = stream.rand(3 * body.num_joints) * pose_spread
    betas = stream.rand(body.num_betas) * beta_spread
    pose[0] = 0.0
    return BodyNumbers(_row(pose, body).reshape(1, -1, 3), _row(betas, body))


def read_numbers(body: SMPL, path: str | Path, index: int = 0, camera_axes: bool | None = None) -> BodyNumbers:
    """A pose, and betas where there are any, from `.json`, `.npz` or a pickle of arrays; nothing in it is executed.

    Args:
        body: that is posed.
        path: a dictionary with `pose`, (3 J,), (J, 3) or rows of such, radians; in JSON also {joint: [x, y, z]}, the
            others at rest. `betas` likewise, the mean shape without.
        index: of the row, where there are several.
        camera_axes: the first rotation turns into axes with y down and z forwards. None: so it does in the files of
            task=smplify, which say where the camera's centre is, and in no others.

    Raises:
        UserError: no such file, none of these, or numbers that do not fit the body; says which.
    """
    path = Path(path)
    content = _content(path)
    if "pose" not in content:
        raise UserError(f"{path} has no pose; it has: {', '.join(map(str, content)) or 'nothing'}")
    try:
        pose = _pick(_named_joints(body, content["pose"]), 3 * body.num_joints, index)
        betas = _pick(content.get("betas", []), None, index)
    except (ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path}: {error}") from error
    if len(betas) > body.num_betas:
        raise UserError(f"{path} has {len(betas)} betas, and the body {body.num_betas}")
    found = BodyNumbers(_row(pose, body).reshape(1, -1, 3), with_betas(body, betas.tolist()))
    return _upright(found) if (_FIT_KEY in content if camera_axes is None else camera_axes) else found


def with_betas(body: SMPL, betas: Sequence[float]) -> Tensor:
    """Betas (1, N), the others 0.

    Raises:
        UserError: more than the body has, or none that is a number.
    """
    values = np.asarray(list(betas), np.float64)
    if len(values) > body.num_betas or not np.isfinite(values).all():
        raise UserError(f"betas must be at most {body.num_betas} finite numbers, got {list(betas)}")
    return _row(np.pad(values, (0, body.num_betas - len(values))), body)


def painted(body: SMPL, numbers: BodyNumbers, joint: int | None = None) -> Meshes:
    """A posed body as of clay; what moves with a joint alone in orange."""
    verts = body(numbers.betas, numbers.pose).verts[0]
    clay, orange = verts.new_tensor(_CLAY), verts.new_tensor(_HELD)
    held = verts.new_zeros(len(verts)) if joint is None else body.weights[:, joint]
    return Meshes([verts], [body.faces], TexturesVertex([torch.lerp(clay, orange, held[:, None])]))


def beta_sheet(body: SMPL, studio: Studio, width: int = 150, height: int = 250) -> Picture:
    """A row for each of the first ten betas, which goes from -2 to 2; all at the same scale, on the same ground."""
    rest = rest_numbers(body)
    _lower_arms(body, rest.pose)
    rows = []
    for index in range(min(10, body.num_betas)):
        for step in BETA_STEPS:
            betas = rest.betas.clone()
            betas[0, index] = step
            rows.append((f"beta {index} = {step:+.0f}".replace("+0", "0"), painted(body, replace(rest, betas=betas))))
    return _sheet(_standing(rows), studio, (height, width), len(BETA_STEPS))


def joint_sheet(body: SMPL, studio: Studio, size: int = 160) -> Picture:
    """For each joint, two in a row, turns by 40 degrees and back about its three axes; orange is what it holds."""
    tiles = []
    for index, name in enumerate(body.joint_names):
        for axis in range(3):
            for sign in (1, -1):
                numbers = rest_numbers(body)
                numbers.pose[0, index, axis] = sign * JOINT_TURN
                tiles.append((f"{name} {'+' if sign > 0 else '-'}{'xyz'[axis]}", painted(body, numbers, index)))
    return _sheet(tiles, studio, (size, size), 12)


def _sheet(tiles: Sequence[tuple[str, Meshes]], studio: Studio, size: tuple[int, int], columns: int) -> Picture:
    """All by one camera, which stands far away and sees all of the largest."""
    right = torch.tensor([math.cos(math.radians(_AZIMUTH)), 0.0, -math.sin(math.radians(_AZIMUTH))])
    up = torch.tensor([0.0, 1.0, 0.0])
    axes = torch.stack([right, up], dim=1).to(tiles[0][1].verts_packed())  # (3, 2)
    seen = torch.stack([torch.stack((mesh.verts_packed() @ axes).aminmax(dim=0)) for _, mesh in tiles])  # (n, 2, 2)
    low, high = seen[:, 0].amin(0), seen[:, 1].amax(0)
    half_width, half_height = ((high - low) / 2).tolist()
    scale = _MARGIN * max(half_height / size[0], half_width / size[1])  # metres a half pixel
    dist = 10 * (half_height + half_width)
    camera = OrbitCamera(
        dist=dist,
        elev=_ELEVATION,
        azim=_AZIMUTH,
        at=(axes @ (low + high) / 2).tolist(),
        fov=2 * math.degrees(math.atan(scale * min(size) / dist)),
    )
    studio = replace(studio, camera=camera, size=size)
    return tile([caption(to_picture(studio.render(mesh)[..., :3]), words) for words, mesh in tiles], columns)


def _standing(tiles: Sequence[tuple[str, Meshes]]) -> list[tuple[str, Meshes]]:
    """Moved up or down until the lowest point of each is at 0."""
    moved = []
    for words, mesh in tiles:
        down = mesh.verts_packed()[:, 1].amin() * mesh.verts_packed().new_tensor([0.0, -1.0, 0.0])
        moved.append((words, mesh.offset_verts(down)))
    return moved


def _lower_arms(body: SMPL, pose: Tensor) -> None:
    """In place; of a body without SMPL's shoulders nothing."""
    for name, sign in (("left_shoulder", -1), ("right_shoulder", 1)):
        if name in body.joint_names:
            pose[0, body.joint_index(name), 2] = sign * _ARMS_DOWN


def _upright(numbers: BodyNumbers) -> BodyNumbers:
    half_turn = numbers.pose.new_tensor([[torch.pi, 0.0, 0.0]])
    first = axis_angle_to_matrix(half_turn) @ axis_angle_to_matrix(numbers.pose[:, 0])
    pose = torch.cat([matrix_to_axis_angle(first)[:, None], numbers.pose[:, 1:]], dim=1)
    return replace(numbers, pose=pose)


def _row(values: np.ndarray, body: SMPL) -> Tensor:
    return torch.from_numpy(values.copy()).to(body.v_template)[None]


def _named_joints(body: SMPL, pose: Any) -> Any:
    """A pose of named joints as one of all."""
    if not isinstance(pose, Mapping):
        return pose
    full = np.zeros((body.num_joints, 3))
    for name, turn in pose.items():
        full[body.joint_index(str(name))] = turn
    return full


def _pick(values: Any, size: int | None, index: int) -> np.ndarray:
    """One row (size,) of numbers in any of the shapes that files have."""
    array = np.asarray(values, np.float64)
    if array.ndim > 1 and not (size is not None and array.size == size):
        if not 0 <= index < len(array):
            raise ValueError(f"index must be 0 to {len(array) - 1}, got {index}")
        array = array[index]
    array = array.reshape(-1)
    if size is not None and len(array) != size:
        raise ValueError(f"a pose of this body has {size} numbers, got {len(array)}")
    if not np.isfinite(array).all():
        raise ValueError("numbers that are not finite")
    return array


def _content(path: Path) -> Mapping[Any, Any]:
    if not path.is_file():
        raise UserError(f"there is no file {path}; posture is random, rest, or a .json, .npz or .pkl file")
    if path.stat().st_size > _MOST_BYTES:
        raise UserError(f"{path} has {path.stat().st_size:,} bytes; files of poses have at most {_MOST_BYTES:,}")
    try:
        content = _parse(path)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, PickleRefused, RecursionError) as error:
        words = " ".join(str(error).split())
        raise UserError(words if str(path) in words else f"{path} cannot be read: {words}") from error
    if not isinstance(content, Mapping):
        raise UserError(f"{path} holds a {type(content).__name__}, not a dictionary with a pose")
    return content


def _parse(path: Path) -> Any:
    if path.suffix == ".json":
        return json.loads(path.read_text("utf-8"))
    if path.suffix == ".pkl":
        return read_pickle(path)
    if path.suffix != ".npz":
        raise UserError(f"{path} is no .json, .npz or .pkl file")
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > _MOST_BYTES:
            raise UserError(f"{path} claims more than {_MOST_BYTES:,} bytes of numbers")
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in content.files if name in ("pose", "betas", _FIT_KEY)}


def sheets_of(choice: str | None) -> Iterator[str]:
    """Which of SHEETS a setting asks for; UserError where it is none."""
    if choice not in (None, "all", *SHEETS):
        raise UserError(f"sheet must be null, all, {' or '.join(SHEETS)}, got {choice!r}")
    return (name for name in SHEETS if choice in ("all", name))
