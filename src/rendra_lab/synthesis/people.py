"""Generated people before a camera: bodies of all shapes in natural poses, clothed, lit, in front of backgrounds.

World: OpenCV's camera axes, x right, y down, z forward, metres; the camera stands at the origin. Pixels: x right,
y down, the middle of the first pixel at 0.5. Letters: N people, J joints, C betas, V vertices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.body import SMPL, SMPL_JOINTS
from rendra.renderer import (
    BlendParams,
    HardPhongShader,
    MeshRasterizer,
    MeshRenderer,
    PerspectiveCameras,
    PointLights,
    RasterizationSettings,
    TexturesVertex,
)
from rendra.structures import Meshes
from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.synthesis.backgrounds import draw_background
from rendra_lab.synthesis.poses import FAMILY_NAMES, draw_poses

LARGEST_BETA = 2.5
_ROUNDS = 60  # at most, of moving bodies until they fill their share of the picture
_AT_ONCE = 64  # bodies that are posed together
_SAMPLES = 2  # of a pixel along each side
_FILLS = (0.6, 0.86)  # share of the picture's height or width, whichever is filled more
_MARGIN = 0.05  # of the picture, free at each side
_FOCAL = (1.1, 5.0)  # in heights of the picture: fields of view of 49 to 11 degrees


@dataclass(frozen=True)
class Crowd:
    """N people, one in each picture.

    Attributes:
        pose: (N, J, 3) rotation vectors, the first one into the camera's axes.
        betas: (N, C).
        translation: (N, 3).
        joints: (N, J, 3).
        verts: (N, V, 3).
        focal_px: (N,).
        center_px: (N, 2) principal points, x and y.
        size: height and width of all pictures, pixels.
        doing: what each does, of FAMILY_NAMES.
    """

    pose: Tensor
    betas: Tensor
    translation: Tensor
    joints: Tensor
    verts: Tensor
    focal_px: Tensor
    center_px: Tensor
    size: tuple[int, int]
    doing: tuple[str, ...]


@torch.no_grad()
def draw_crowd(body: SMPL, count: int, size: tuple[int, int], seed: int = 0) -> Crowd:
    """People of all shapes, seen from all sides, wholly in their pictures; the same for the same arguments.

    Args:
        body: of 24 joints in SMPL's order.
        count: N.
        size: height and width of the pictures, pixels.
        seed: of all choices.

    Raises:
        ValueError: a body with other joints.
    """
    if tuple(body.joint_names) != SMPL_JOINTS:
        raise ValueError(f"people are made of a body with SMPL's 24 joints, got one of {body.num_joints}")
    generator = torch.Generator().manual_seed(seed + 7919)
    poses = draw_poses(count, seed)
    pose = poses.joints.clone()
    pose[:, 0] = matrix_to_axis_angle(_views(count, generator) @ poses.trunk)
    betas = torch.randn(count, body.num_betas, generator=generator).clamp(-LARGEST_BETA, LARGEST_BETA)
    low, high = math.log(_FOCAL[0]), math.log(_FOCAL[1])
    focal_px = size[0] * (low + (high - low) * torch.rand(count, generator=generator)).exp()
    center_px = (torch.tensor([size[1], size[0]]) / 2).expand(count, 2)
    joints, verts = _posed(body, betas, pose)
    translation = _framed(verts, focal_px, size, generator)
    joints, verts = joints + translation[:, None], verts + translation[:, None]
    doing = tuple(FAMILY_NAMES[kind] for kind in poses.family.tolist())
    return Crowd(pose, betas, translation, joints, verts, focal_px, center_px, size, doing)


def _views(count: int, generator: torch.Generator) -> Tensor:
    """Rotations (N, 3, 3) from y up into the camera's axes: of any heading, more often towards the camera."""
    side = 2 * math.pi * torch.rand(count, generator=generator)
    facing = 0.8 * torch.randn(count, generator=generator)
    heading = torch.where(torch.rand(count, generator=generator) < 0.4, facing, side)
    down = math.radians(4) + math.radians(8) * torch.randn(count, generator=generator)
    tilt = math.radians(3) * torch.randn(count, generator=generator)
    x, y, z = torch.eye(3)
    over = axis_angle_to_matrix(math.pi * x)
    camera = axis_angle_to_matrix(tilt[:, None] * z) @ axis_angle_to_matrix(down[:, None] * x)
    return camera @ over @ axis_angle_to_matrix(heading[:, None] * y)


def _posed(body: SMPL, betas: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Joints and vertices about the origin."""
    joints, verts = (
        betas.new_zeros(len(betas), body.num_joints, 3),
        betas.new_zeros(len(betas), *body.v_template.shape),
    )
    for first in range(0, len(betas), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        posed = body(betas[some], pose[some])
        joints[some], verts[some] = posed.joints, posed.verts
    return joints, verts


def _framed(verts: Tensor, focal_px: Tensor, size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """Translations (N, 3) that put bodies wholly into their pictures, each at a place and of a size of its own."""
    whole = torch.tensor([size[1], size[0]], dtype=verts.dtype)
    fills = _FILLS[0] + (_FILLS[1] - _FILLS[0]) * torch.rand(len(verts), 1, generator=generator)
    place = 2 * torch.rand(len(verts), 2, generator=generator) - 1
    middle = (verts.amax(1) + verts.amin(1)) / 2
    deep = (verts - middle[:, None])[..., 2].amin(1)
    depth = focal_px * (verts.amax(1) - verts.amin(1))[:, :2].amax(1) / (fills[:, 0] * whole.min())
    move = torch.cat([-middle[:, :2], (depth - middle[:, 2])[:, None]], dim=1)
    for _ in range(_ROUNDS):
        least, most = _extent(verts + move[:, None], focal_px)
        scale = ((most - least) / (fills * whole)).amax(1)
        depth = torch.maximum(depth * scale, 0.4 - deep)
        spare = (whole * (1 - 2 * _MARGIN) - (most - least)).clamp_min(0)
        off = (place * spare - (least + most)) / 2
        shift = off / focal_px[:, None] * depth[:, None]
        move = torch.cat([move[:, :2] + shift, (depth - middle[:, 2])[:, None]], dim=1)
        if bool(((scale - 1).abs() < 1e-3).all() & (off.abs() < 0.1).all()):
            break
    return move


def _extent(verts: Tensor, focal_px: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the greatest pixels (N, 2) from the principal point."""
    flat = focal_px[:, None, None] * verts[..., :2] / verts[..., 2:].clamp_min(0.1)
    return flat.amin(1), flat.amax(1)


class Painter:
    """Pictures of people.

    Args:
        body: whose vertices the people have.
    """

    def __init__(self, body: SMPL) -> None:
        self.faces = body.faces
        self.wardrobe = Wardrobe(body)

    @torch.no_grad()
    def paint(self, crowd: Crowd, index: int, seed: int = 0) -> npt.NDArray[np.uint8]:
        """The picture (H, W, 3), sRGB, of one of the crowd; seed and index choose clothes, light and background."""
        generator = torch.Generator().manual_seed(1_000_003 * (seed + 1) + index)
        colors = self.wardrobe.dress(generator)
        background = draw_background(crowd.size, generator)
        verts = crowd.verts[index]
        textures = TexturesVertex([colors.to(verts)])
        mesh = Meshes([verts], [self.faces.to(verts.device)], textures)
        seen = self._renderer(crowd, index, generator)(mesh).movedim(-1, 1)
        color, alpha = F.avg_pool2d(seen, _SAMPLES)[0].movedim(0, -1).cpu().split([3, 1], dim=-1)
        picture = color + (1 - alpha) * background  # colour is that of the covered samples over black
        picture = picture + 0.01 * torch.randn(picture.shape, generator=generator)
        return (picture.clamp(0, 1) * 255).round().to(torch.uint8).numpy()

    def _renderer(self, crowd: Crowd, index: int, generator: torch.Generator) -> MeshRenderer:
        device = crowd.verts.device
        height, width = (side * _SAMPLES for side in crowd.size)
        cameras = PerspectiveCameras(
            focal_length=crowd.focal_px[index : index + 1] * _SAMPLES,
            principal_point=crowd.center_px[index : index + 1] * _SAMPLES,
            R=torch.diag(torch.tensor([-1.0, -1.0, 1.0]))[None],
            image_size=((height, width),),
            in_ndc=False,
            device=device,
        )
        settings = RasterizationSettings(image_size=(height, width))
        shader = HardPhongShader(
            device=device,
            cameras=cameras,
            lights=_lights(crowd.translation[index], generator).to(device),
            blend_params=BlendParams(background_color=(0.0, 0.0, 0.0)),
        )
        return MeshRenderer(MeshRasterizer(cameras, settings), shader)


def _lights(place: Tensor, generator: torch.Generator) -> PointLights:
    """One lamp before and above a person, and light from everywhere."""
    x, up, bright = torch.rand(3, generator=generator).tolist()
    location = place.cpu() + torch.tensor([6 * x - 3, -1.0 - 3 * up, -3.0])
    ambient = 0.4 + 0.15 * bright
    return PointLights(
        ambient_color=((ambient,) * 3,),
        diffuse_color=((0.95 - ambient,) * 3,),
        specular_color=((0.05,) * 3,),
        location=location[None],
    )


class Wardrobe:
    """Which vertices clothes cover, and colours for them.

    Args:
        body: of 24 joints in SMPL's order.
    """

    _SHIRT = ("spine1", "spine2", "spine3", "left_collar", "right_collar", "left_shoulder", "right_shoulder")
    _SKINS = ((0.94, 0.78, 0.69), (0.87, 0.67, 0.53), (0.72, 0.5, 0.37), (0.5, 0.33, 0.24), (0.33, 0.22, 0.17))
    _HAIRS = ((0.09, 0.07, 0.06), (0.25, 0.15, 0.09), (0.5, 0.33, 0.16), (0.8, 0.68, 0.42), (0.6, 0.6, 0.6))

    def __init__(self, body: SMPL) -> None:
        bone = body.weights.cpu().argmax(1)
        verts = body.v_template.cpu()
        self.count = len(verts)

        def of(*names: str) -> Tensor:
            return torch.isin(bone, torch.tensor([SMPL_JOINTS.index(name) for name in names]))

        self.shirt = of(*self._SHIRT)
        self.sleeves = of("left_elbow", "right_elbow")
        self.shorts = of("pelvis", "left_hip", "right_hip")
        self.legs = of("left_knee", "right_knee")
        self.shoes = of("left_ankle", "right_ankle", "left_foot", "right_foot")
        head = of("head")
        least, most = verts[head].amin(0), verts[head].amax(0)
        along = (verts - least) / (most - least)  # 0 to 1 over the head
        self.hair = head & ((along[:, 1] > 0.82) | ((along[:, 2] < 0.55) & (along[:, 1] > 0.35)))

    def dress(self, generator: torch.Generator) -> Tensor:
        """Colours (V, 3) of one person."""
        skin, hair, long_sleeves, long_legs = torch.rand(4, generator=generator).tolist()
        shirt, trousers, shoes = torch.rand(3, 3, generator=generator).unbind()
        colors = torch.tensor(_pick(self._SKINS, skin)).repeat(self.count, 1)
        colors[self.shirt | (self.sleeves & (long_sleeves < 0.5))] = 0.1 + 0.85 * shirt
        colors[self.shorts | (self.legs & (long_legs < 0.6))] = 0.05 + 0.6 * trousers
        colors[self.shoes] = 0.1 + 0.8 * shoes
        colors[self.hair] = torch.tensor(_pick(self._HAIRS, hair))
        return colors


def _pick(colors: tuple[tuple[float, float, float], ...], share: float) -> tuple[float, float, float]:
    return colors[min(int(share * len(colors)), len(colors) - 1)]
