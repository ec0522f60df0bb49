"""One view of a known mesh: rendered from a camera that we know, or a user's photograph."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.data.repeated import Repeated
from rendra_lab.errors import UserError
from rendra_lab.networks.camera_pose import camera_centre
from rendra_lab.networks.mesh_view import MeshView
from rendra_lab.records import TensorRecord

log = logging.getLogger(__name__)

_HARD_EDGE = 1e-9  # squared NDC: a small fraction of a pixel


@dataclass(frozen=True)
class ViewBatch(TensorRecord):
    """What cameras saw, and where they stood (x_view = x_world @ R + T); R and T are NaN where that is unknown."""

    rgb: Float[Tensor, "B H W 3"]  # sRGB in [0, 1], the scene's background where nothing is
    silhouette: Float[Tensor, "B H W"]  # coverage by the mesh, in [0, 1]
    R: Float[Tensor, "B 3 3"]
    T: Float[Tensor, "B 3"]
    frame: Float[Tensor, " B"]  # number in its sequence

    @property
    def position(self) -> Tensor:
        """Where the cameras stood in the world: (B, 3)."""
        return camera_centre(self.R, self.T)

    def select(self, index: int) -> ViewBatch:
        """One view, as a batch of one."""
        return self._map(lambda value: value[index : index + 1], lambda value: isinstance(value, Tensor))

    def resized(self, size: tuple[int, int]) -> ViewBatch:
        """The same views at (H, W) pixels, each the mean of what it covers."""
        rgb, silhouette = shrink(self.rgb, self.silhouette, size)
        return ViewBatch(rgb, silhouette, self.R, self.T, self.frame)


def shrink(rgb: Tensor, silhouette: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Colours (B, H, W, 3) and silhouettes (B, H, W) at a smaller size, each pixel the mean of what it covers."""
    images = torch.cat([rgb, silhouette[..., None]], dim=-1).movedim(-1, 1)
    images = F.interpolate(images, size, mode="area").movedim(1, -1)
    return images[..., :3], images[..., 3]


@torch.no_grad()
def render_views(scene: MeshView, R: Tensor, T: Tensor) -> ViewBatch:
    """What the scene shows to cameras R (B, 3, 3), T (B, 3); the silhouette is the exact coverage."""
    # a soft edge is fatter than the mesh, since every face near it adds its own: here the edge is hard
    views = [scene(R[i : i + 1], T[i : i + 1], sigma=_HARD_EDGE) for i in range(len(R))]
    silhouettes = torch.cat([(silhouette > 0.5).float() for silhouette, _ in views])
    return ViewBatch(torch.cat([rgb for _, rgb in views]), silhouettes, R, T, torch.arange(len(R)).float())


def check_visible(silhouettes: Tensor, scene: MeshView, view: str) -> None:
    """Refuse views that hold nothing of the mesh, and warn of those that hold nothing else.

    Args:
        silhouettes: (B, H, W), coverage in [0, 1].
        scene: whose mesh it is.
        view: what to call the views: "the target (data.distance=3.0)".

    Raises:
        UserError: a view is empty.
    """
    covered = silhouettes.detach().flatten(1)
    if not bool((covered.amax(1) > 0.5).all()):
        raise UserError(f"nothing of the mesh is seen in {view}: {_whereabouts(scene)}")
    if bool((covered.mean(1) > 0.995).any()):
        log.warning("the mesh fills %s, so that it has no outline to fit: %s", view, _whereabouts(scene))


def _whereabouts(scene: MeshView) -> str:
    verts = scene.mesh.verts_packed()
    low, high = (" ".join(f"{x:.4g}" for x in corner.tolist()) for corner in (verts.amin(0), verts.amax(0)))
    return (
        f"the camera looks at the origin, and the mesh reaches from ({low}) to ({high}); mesh.normalize=extent moves "
        "it to the origin and makes it 2 units large, mesh.normalize=center only moves it"
    )


class SingleView(LightningDataModule, ABC):
    """One view, again and again; subclasses say where it comes from.

    Args:
        scene: the known mesh, its intrinsics and lights.
        steps: optimisation steps an epoch.
    """

    target: ViewBatch

    def __init__(self, scene: MeshView, steps: int = 10_000) -> None:
        super().__init__()
        self.scene = scene
        self.steps = steps

    @abstractmethod
    def observe(self) -> ViewBatch:
        """The view, a batch of one."""

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: makes the view, once."""
        if not hasattr(self, "target"):
            self.target = self.observe()

    def train_dataloader(self) -> Repeated[ViewBatch]:
        """The view, `steps` times."""
        return Repeated(self.target, self.steps)

    def test_dataloader(self) -> Repeated[ViewBatch]:
        """The view, once."""
        return Repeated(self.target)


class RenderedView(SingleView):
    """A view from a known camera that looks at the origin.

    Args:
        scene: the mesh to render.
        distance: of the camera from the origin, in world units.
        elevation_deg: angle above the horizontal plane.
        azimuth_deg: angle around +Y, from +Z.
        steps: optimisation steps an epoch.
    """

    def __init__(
        self,
        scene: MeshView,
        distance: float = 3.0,
        elevation_deg: float = 50.0,
        azimuth_deg: float = 0.0,
        steps: int = 10_000,
    ) -> None:
        super().__init__(scene, steps)
        self.R, self.T = look_at_view_transform(distance, elevation_deg, azimuth_deg)
        self._view = f"the target, seen from a distance of {distance:g} (data.distance)"

    def observe(self) -> ViewBatch:
        """The view, rendered; UserError where it shows nothing."""
        target = render_views(self.scene, self.R, self.T)
        check_visible(target.silhouette, self.scene, self._view)
        return target


class PhotoView(SingleView):
    """A photograph of the mesh: RGBA, or with a mask beside it.

    The photograph is fitted into the scene's image size, centred, with the scene's background around it; its
    principal point is taken to be its middle, and its field of view the scene's.

    Args:
        scene: the mesh that the photograph shows.
        image: the photograph, any format that Pillow reads; EXIF orientation is followed.
        mask: an image of the same size, bright where the mesh is; None takes the photograph's alpha.
        steps: optimisation steps an epoch.

    Raises:
        UserError: a file that is missing, broken or does not fit.
    """

    def __init__(
        self, scene: MeshView, image: str | Path, mask: str | Path | None = None, steps: int = 10_000
    ) -> None:
        super().__init__(scene, steps)
        self.photo, self.mask = read_photo(image, mask)

    def observe(self) -> ViewBatch:
        """The photograph, fitted into the scene's image size."""
        background = torch.tensor(self.scene.background)
        rgb = self.photo * self.mask[..., None] + background * (1 - self.mask[..., None])
        rgba = _fit_into(torch.cat([rgb, self.mask[..., None]], dim=-1), self.scene.image_size)
        rgb = rgba[..., :3] + background * (1 - rgba[..., 4:])  # outside the photograph
        return ViewBatch(
            rgb[None],
            rgba[None, ..., 3],
            torch.full((1, 3, 3), torch.nan),
            torch.full((1, 3), torch.nan),
            torch.zeros(1),
        )


def read_photo(image: str | Path, mask: str | Path | None = None) -> tuple[Tensor, Tensor]:
    """Colours (H, W, 3) and mask (H, W) of a photograph, in [0, 1]; UserError says what is wrong with a file."""
    picture = _open(image)
    if mask is None:
        if "A" not in picture.getbands() and "transparency" not in picture.info:
            raise UserError(f"{image} has no alpha channel: give a mask beside it with data.mask=FILE")
        coverage = picture.convert("RGBA").getchannel("A")
    else:
        coverage = _open(mask).convert("L")
        if coverage.size != picture.size:
            raise UserError(f"the mask {mask} is {coverage.size} pixels large, its image {image} {picture.size}")
    colours = np.asarray(picture.convert("RGBA").convert("RGB"), np.float32) / 255
    covered = np.asarray(coverage, np.float32) / 255
    if not covered.max() > 0.5:
        brightest = f"its brightest pixel is {round(255 * float(covered.max()))} of 255"
        raise UserError(f"the mask of {image} is empty, there is nothing to fit: {brightest}")
    return torch.from_numpy(colours), torch.from_numpy(covered)


def _open(path: str | Path) -> Image.Image:
    if not Path(path).is_file():
        raise UserError(f"there is no image {path}")
    try:
        with Image.open(path) as picture:
            picture.load()
            return _in_8_bits(ImageOps.exif_transpose(picture))
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError, SyntaxError) as error:
        raise UserError(f"{path} is not an image that can be read: {error}") from error


def _in_8_bits(picture: Image.Image) -> Image.Image:
    """A grey picture of 16 bits scaled to 8, which Pillow would clip; any other as it is."""
    if not picture.mode.startswith("I"):
        return picture
    return Image.fromarray((np.asarray(picture, np.float32) / 257).round().clip(0, 255).astype(np.uint8))


def _fit_into(rgba: Tensor, size: tuple[int, int]) -> Tensor:
    """The image (h, w, 4) scaled into (H, W), centred, with a fifth channel that is one where it lies."""
    height, width = size
    scale = min(height / rgba.shape[0], width / rgba.shape[1])
    inner = (max(1, round(rgba.shape[0] * scale)), max(1, round(rgba.shape[1] * scale)))
    layers = torch.cat([rgba, torch.ones_like(rgba[..., :1])], dim=-1).movedim(-1, 0)[None]
    layers = F.interpolate(layers, inner, mode="bilinear", antialias=True, align_corners=False)
    top, left = (height - inner[0]) // 2, (width - inner[1]) // 2
    padding = (left, width - inner[1] - left, top, height - inner[0] - top)
    return F.pad(layers, padding)[0].movedim(0, -1).clamp(0, 1)
