"""Pictures of fitted people: joints given and projected, the body over the picture, and the body from other sides.

World: OpenCV's camera axes, x right, y down, z forward, metres; the camera stands at the origin.
Pixels: x right, y down, the middle of the first pixel at 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer import (
    BlendParams,
    DirectionalLights,
    HardPhongShader,
    MeshRasterizer,
    MeshRenderer,
    PerspectiveCameras,
    RasterizationSettings,
    TexturesVertex,
)
from rendra.structures import Meshes
from rendra.transforms import axis_angle_to_matrix
from rendra_lab.tasks.smplify.records import LSP_JOINTS, FitPrediction, PeopleBatch
from rendra_lab.visualization import Picture, captioned_row, to_picture

_LIMBS = (
    ("right_ankle", "right_knee"), ("right_knee", "right_hip"), ("right_hip", "left_hip"),
    ("left_hip", "left_knee"), ("left_knee", "left_ankle"), ("right_hip", "right_shoulder"),
    ("left_hip", "left_shoulder"), ("right_wrist", "right_elbow"), ("right_elbow", "right_shoulder"),
    ("left_wrist", "left_elbow"), ("left_elbow", "left_shoulder"), ("right_shoulder", "neck"),
    ("left_shoulder", "neck"), ("neck", "head_top"),
)  # fmt: skip
_EDGES = tuple((LSP_JOINTS.index(a), LSP_JOINTS.index(b)) for a, b in _LIMBS)
_GIVEN, _PROJECTED, _LINK = (30, 190, 60), (225, 45, 40), (255, 255, 255)
_SKIN = (0.60, 0.76, 0.90)
_AROUND = 1.35  # of the box about the joints: heads, feet and hands reach beyond
_FAR = 20.0  # metres, from where bodies are seen from other sides: nearly parallel rays
_FINER = 2  # samples of a pixel along each side


@dataclass(frozen=True)
class Frame:
    """The square about a person, in pixels of the picture."""

    left: int
    top: int
    side: int

    @classmethod
    def about(cls, batch: PeopleBatch, person: int) -> Frame:
        """A third larger than the box about the joints that were found."""
        joints = batch.joints_px[person][batch.confidence[person] > 0]
        low, high = joints.amin(0), joints.amax(0)
        side = max(16.0, _AROUND * float((high - low).amax()))
        left, top = ((low + high - side) / 2).tolist()
        return cls(round(left), round(top), math.ceil(side))

    def cut(self, picture: Picture | None, size: int) -> Picture:
        """What of a picture lies in it, at size x size pixels; white where there is none."""
        page = Image.new("RGB", (self.side, self.side), (255,) * 3)
        if picture is not None:
            page.paste(Image.fromarray(picture), (-self.left, -self.top))
        return np.asarray(page.resize((size, size), Image.Resampling.LANCZOS))

    def places(self, pixels: Tensor, size: int) -> Tensor:
        """Where pixels (..., 2) of the picture lie in it."""
        return (pixels - pixels.new_tensor([self.left, self.top])) * (size / self.side)


class Portraits:
    """Draws people and the bodies fitted to them.

    Args:
        faces: (F, 3) of the body.
        size: pixels of a side of each picture.
        azimuths: degrees by which bodies are turned for the pictures from other sides, to the left as they stand.
    """

    def __init__(self, faces: Tensor, size: int = 256, azimuths: tuple[float, ...] = (90.0, 180.0)) -> None:
        self.faces = faces
        self.size = size
        self.azimuths = azimuths

    @torch.no_grad()
    def draw(self, prediction: FitPrediction, batch: PeopleBatch, person: int) -> dict[str, Picture]:
        """All pictures of one person, by caption."""
        frame = Frame.about(batch, person)
        picture = None if batch.picture_of is None else batch.picture_of(person)
        return {
            "given green, fitted red": self.joints(prediction, batch, person, frame.cut(picture, _FINER * self.size)),
            "fit": self.overlay(prediction, batch, person, frame.cut(picture, self.size)),
            **{f"{azimuth:g} degrees": self.turned(prediction, person, azimuth) for azimuth in self.azimuths},
        }

    def row(self, prediction: FitPrediction, batch: PeopleBatch, person: int) -> Picture:
        """The same side by side, with captions."""
        return captioned_row(self.draw(prediction, batch, person))

    def joints(self, prediction: FitPrediction, batch: PeopleBatch, person: int, paper: Picture) -> Picture:
        """Skeletons over a picture of twice the size: as given, where found, and as projected; links between."""
        frame = Frame.about(batch, person)
        given = frame.places(batch.joints_px[person].cpu(), len(paper)).tolist()
        fitted = frame.places(prediction.joints_px[person].cpu(), len(paper)).tolist()
        found = (batch.confidence[person] > 0).tolist()
        page = Image.fromarray(paper)
        pen, width = ImageDraw.Draw(page), max(2, len(paper) // 120)
        for a, b, known in zip(given, fitted, found, strict=True):
            if known:
                pen.line([*a, *b], fill=_LINK, width=width)
        for places, color, there in ((given, _GIVEN, found), (fitted, _PROJECTED, [True] * len(fitted))):
            for a, b in _EDGES:
                if there[a] and there[b]:
                    pen.line([*places[a], *places[b]], fill=color, width=width)
            for (x, y), known in zip(places, there, strict=True):
                if known:
                    pen.ellipse([x - 2 * width, y - 2 * width, x + 2 * width, y + 2 * width], fill=color)
        return np.asarray(page.resize((self.size, self.size), Image.Resampling.LANCZOS))

    def overlay(self, prediction: FitPrediction, batch: PeopleBatch, person: int, paper: Picture) -> Picture:
        """The body, as the camera sees it, over a picture."""
        assert prediction.verts is not None
        frame = Frame.about(batch, person)
        scale = self.size / frame.side
        centre = frame.places(batch.center_px[person], self.size)
        seen = self._render(prediction.verts[person], scale * batch.focal_px[person], centre)
        behind = torch.from_numpy(paper.copy()).to(seen) / 255
        return to_picture(seen[..., :3] + (1 - seen[..., 3:]) * behind)  # colours stand over black

    def turned(self, prediction: FitPrediction, person: int, azimuth: float) -> Picture:
        """The body, turned about the vertical axis of the picture, wholly in sight over white."""
        assert prediction.verts is not None
        verts = prediction.verts[person]
        turn = axis_angle_to_matrix(verts.new_tensor([0.0, -math.radians(azimuth), 0.0]))
        arms = (verts - (verts.amax(0) + verts.amin(0)) / 2) @ turn.T
        reach = arms.abs().amax().clamp_min(1e-3)
        focal = self.size / (2.1 * reach) * _FAR
        centre = verts.new_full((2,), self.size / 2)
        seen = self._render(arms + verts.new_tensor([0.0, 0.0, _FAR]), focal, centre)
        return to_picture(seen[..., :3] + 1 - seen[..., 3:])

    def _render(self, verts: Tensor, focal: Tensor, centre: Tensor) -> Tensor:
        """Colours over black, and the share of each pixel that is covered: (size, size, 4)."""
        side = _FINER * self.size
        cameras = PerspectiveCameras(
            focal_length=_FINER * focal[None],
            principal_point=_FINER * centre[None],
            R=torch.diag(verts.new_tensor([-1.0, -1.0, 1.0]))[None],
            image_size=((side, side),),
            in_ndc=False,
            device=verts.device,
        )
        lights = DirectionalLights(
            ambient_color=((0.45,) * 3,),
            diffuse_color=((0.55,) * 3,),
            specular_color=((0.05,) * 3,),
            direction=((-0.4, -0.8, -1.0),),  # above and left of the viewer
            device=verts.device,
        )
        shader = HardPhongShader(
            device=verts.device,
            cameras=cameras,
            lights=lights,
            blend_params=BlendParams(background_color=(0.0, 0.0, 0.0)),
        )
        textures = TexturesVertex([verts.new_tensor(_SKIN).expand(len(verts), 3)])
        mesh = Meshes([verts], [self.faces.to(verts.device)], textures)
        raw = MeshRenderer(MeshRasterizer(cameras, RasterizationSettings(image_size=side)), shader)(mesh)
        return F.avg_pool2d(raw.clamp(0, 1).movedim(-1, 1), _FINER)[0].movedim(0, -1).cpu()


def sheet_of(rows: list[dict[str, Picture]]) -> dict[str, Tensor]:
    """Pictures of several people, by caption: (B, H, W, 3) in [0, 1] each."""
    return {name: torch.stack([torch.from_numpy(row[name] / np.float32(255)) for row in rows]) for name in rows[0]}
