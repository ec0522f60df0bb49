"""A textured mesh as a camera sees it: its soft silhouette and its colours, differentiable in the pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from rendra.renderer import (
    BlendParams,
    FoVPerspectiveCameras,
    HardPhongShader,
    MeshRasterizer,
    MeshRenderer,
    PointLights,
    RasterizationSettings,
    SoftPhongShader,
    SoftSilhouetteShader,
    opencv_from_cameras,
    opengl_from_cameras,
)
from rendra.structures import Meshes
from rendra_lab.settings import Positive, Size

_NEGLIGIBLE = 1e-4  # coverage at which a face stops reaching outwards


class MeshView(nn.Module):
    """Renders one mesh from any number of poses.

    Args:
        mesh: a batch of one, with a texture.
        image_size: height and width, or the side of a square, in pixels.
        fov_deg: field of view of the short side.
        sigma: width of the silhouette's edge, squared NDC (the book: 1e-4).
        layers: faces blended in a pixel's colour. 1 takes the nearest face, hard-edged: colours then move the
            pose through the texture alone, and the silhouette moves the outline. More blend softly, as the book.
        lights: of rendra.renderer; None is one point light at (2, 2, -2).
        background: colour behind the mesh, sRGB in [0, 1].
    """

    def __init__(
        self,
        mesh: Meshes,
        image_size: int | Sequence[int] = 256,
        fov_deg: float = 60.0,
        sigma: Size = 1e-4,
        layers: Positive = 1,
        lights: Any = None,
        background: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> None:
        super().__init__()
        if len(mesh) != 1:
            raise ValueError(f"a MeshView shows one mesh, got a batch of {len(mesh)}")
        if not 0 < fov_deg < 180:
            raise ValueError(f"fov_deg must lie between 0 and 180 degrees, got {fov_deg!r}")
        self.mesh = mesh
        self.image_size = _height_width(image_size)
        self.fov_deg = fov_deg
        self.sigma = sigma
        self.layers = layers
        self.lights = PointLights(location=((2.0, 2.0, -2.0),)) if lights is None else lights
        self.background = tuple(background)

    def forward(
        self, R: Tensor, T: Tensor, image_size: tuple[int, int] | None = None, sigma: float | None = None
    ) -> tuple[Tensor, Tensor]:
        """Silhouettes (B, H, W) and colours (B, H, W, 3), both in [0, 1], from the poses R (B, 3, 3), T (B, 3).

        `image_size` and `sigma` replace the view's own, for coarse-to-fine fits.
        """
        self._follow(R.device)
        size, sigma = image_size or self.image_size, sigma or self.sigma
        cameras = self.cameras(R, T)
        meshes = self.mesh.extend(len(R)) if len(R) > 1 else self.mesh
        blend = BlendParams(sigma=sigma, gamma=1e-4, background_color=self.background)
        reach = math.log(1 / _NEGLIGIBLE - 1) * sigma
        outline = MeshRenderer(
            MeshRasterizer(cameras, RasterizationSettings(size, blur_radius=reach)), SoftSilhouetteShader(blend)
        )
        soft = self.layers > 1
        settings = RasterizationSettings(size, reach if soft else 0.0, faces_per_pixel=self.layers)
        shader = (SoftPhongShader if soft else HardPhongShader)(
            device=R.device, cameras=cameras, lights=self.lights, blend_params=blend
        )
        colours = MeshRenderer(MeshRasterizer(cameras, settings), shader)
        return outline(meshes)[..., 3], colours(meshes)[..., :3]

    def cameras(self, R: Tensor, T: Tensor) -> FoVPerspectiveCameras:
        """The cameras of poses R (B, 3, 3), T (B, 3) with this view's intrinsics."""
        return FoVPerspectiveCameras(R=R, T=T, fov=self.fov_deg, aspect_ratio=1.0, device=R.device)

    def describe_camera(self, R: Tensor, T: Tensor) -> dict[str, Any]:
        """One camera R (3, 3), T (3,), as lists: in this library's conventions, OpenCV's and OpenGL's (Blender's)."""
        cameras, size = self.cameras(R[None], T[None]), torch.tensor([self.image_size])
        opencv, opengl = opencv_from_cameras(cameras, size), opengl_from_cameras(cameras, size)
        return {
            "image_size_hw_px": list(self.image_size),
            "fov_deg": self.fov_deg,
            "rendra": {"R": R.tolist(), "T": T.tolist()},
            "opencv": {
                "R": opencv.R[0].tolist(),
                "tvec": opencv.tvec[0].tolist(),
                "K": opencv.camera_matrix[0].tolist(),
            },
            "opengl": {"camera_to_world": opengl.camera_to_world[0].tolist()},
        }

    def _follow(self, device: torch.device) -> None:
        # the lights are a submodule and may have moved with the task, without the mesh
        self.mesh, self.lights = self.mesh.to(device), self.lights.to(device)


def _height_width(image_size: int | Sequence[int]) -> tuple[int, int]:
    sides = [image_size] * 2 if isinstance(image_size, int) else list(image_size)
    if len(sides) != 2 or not all(isinstance(side, int) and side > 0 for side in sides):
        raise ValueError(f"image_size must be one side or [height,width] in whole pixels, got {image_size!r}")
    return sides[0], sides[1]
