"""Meshes in the world, seen by cameras: to NDC, then to fragments."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from rendra.common.datatypes import Device
from rendra.renderer.camera_base import cameras_for_call, ndc_and_view_depth
from rendra.renderer.mesh.rasterize_meshes import rasterize_meshes, rasterize_silhouette
from rendra.structures.meshes import Meshes


@dataclass(frozen=True)
class Fragments:
    """What each pixel sees, K layers deep, nearest first; empty slots hold -1.

    pix_to_face: (N, H, W, K) int64, index of the packed face.
    zbuf: (N, H, W, K), view depth.
    bary_coords: (N, H, W, K, 3), where on the face.
    dists: (N, H, W, K), squared NDC distance to the nearest edge of the face, negative inside.
    """

    pix_to_face: Tensor
    zbuf: Tensor
    bary_coords: Tensor
    dists: Tensor

    def detach(self) -> "Fragments":
        """The same fragments without their history."""
        return Fragments(self.pix_to_face, self.zbuf.detach(), self.bary_coords.detach(), self.dists.detach())


@dataclass
class RasterizationSettings:
    """How meshes are rasterised; see `rasterize_meshes`.

    image_size: side of a square image, or (H, W), in pixels.
    blur_radius: squared NDC distance up to which a face reaches pixels outside it.
    faces_per_pixel: layers kept for each pixel, without limit.
    bin_size, max_faces_opengl, max_faces_per_bin: accepted for compatibility and ignored: nothing overflows here.
    perspective_correct: None follows the camera.
    clip_barycentric_coords: None clips where blur_radius > 0.
    cull_backfaces: leave out faces seen from behind.
    z_clip_value: view depth at which faces are cut; None takes half of a perspective camera's znear, and no
        clipping for other cameras.
    cull_to_frustum: drop faces outside the image first.
    """

    image_size: int | tuple[int, int] = 256
    blur_radius: float = 0.0
    faces_per_pixel: int = 1
    bin_size: int | None = None
    max_faces_opengl: int = 10_000_000
    max_faces_per_bin: int | None = None
    perspective_correct: bool | None = None
    clip_barycentric_coords: bool | None = None
    cull_backfaces: bool = False
    z_clip_value: float | None = None
    cull_to_frustum: bool = False


class MeshRasterizer(nn.Module):
    """Cameras and settings that turn meshes into fragments."""

    def __init__(self, cameras: Any = None, raster_settings: RasterizationSettings | None = None) -> None:
        """Keep the parts.

        Args:
            cameras: of rendra.renderer.cameras, one for all meshes or one for each; None where each call
                brings its own.
            raster_settings: None for the defaults.
        """
        super().__init__()
        self.cameras = cameras
        self.raster_settings = RasterizationSettings() if raster_settings is None else raster_settings

    def to(self, device: Device) -> "MeshRasterizer":  # type: ignore[override]
        """Move the cameras."""
        if self.cameras is not None:
            self.cameras = self.cameras.to(device)
        return self

    def transform(self, meshes_world: Meshes, **kwargs: Any) -> Meshes:
        """Bring meshes to NDC, with the view depth as z.

        Args:
            meshes_world: batch of N in world coordinates.
            **kwargs: `cameras`, `eps` of the division by depth, and whatever the cameras take (R, T, ...).

        Raises:
            ValueError: no cameras, or as many as fit neither one nor N.
        """
        cameras = cameras_for_call(self.cameras, kwargs, "MeshRasterizer")
        if len(cameras) not in (1, len(meshes_world)):
            raise ValueError(
                f"Wrong number ({len(cameras)}) of cameras for {len(meshes_world)} meshes: give one, or one each"
            )
        verts_seen = ndc_and_view_depth(cameras, meshes_world.verts_padded(), kwargs)
        return meshes_world.update_padded(new_verts_padded=verts_seen)

    def forward(self, meshes_world: Meshes, **kwargs: Any) -> Fragments:
        """Rasterise meshes in world coordinates.

        Args:
            meshes_world: batch of N.
            **kwargs: as of `transform`, and `raster_settings` to replace those of this rasterizer.
        """
        settings = kwargs.get("raster_settings", self.raster_settings)
        shared = self._shared_arguments(settings, kwargs)
        if (perspective_correct := settings.perspective_correct) is None:
            perspective_correct = shared["verts_divided_by_depth"]
        pix_to_face, zbuf, bary_coords, dists = rasterize_meshes(
            self.transform(meshes_world, **kwargs),
            faces_per_pixel=settings.faces_per_pixel,
            perspective_correct=perspective_correct,
            clip_barycentric_coords=_clips_barycentric(settings),
            **shared,
        )
        return Fragments(pix_to_face, zbuf, bary_coords, dists)

    def silhouette(self, meshes_world: Meshes, sigma: float, **kwargs: Any) -> Tensor:
        """Soft silhouette (N, H, W) by all faces, however many lie behind a pixel; no fragments are stored.

        Args:
            meshes_world: batch of N.
            sigma: width of the edge, in squared NDC.
            **kwargs: as of `forward`; faces_per_pixel of the settings plays no part.
        """
        settings = kwargs.get("raster_settings", self.raster_settings)
        return rasterize_silhouette(
            self.transform(meshes_world, **kwargs), sigma=sigma, **self._shared_arguments(settings, kwargs)
        )

    def silhouette_matches_fragments(self, **kwargs: Any) -> bool:
        """Whether `silhouette` is what blending all fragments of a call would give.

        It is but for unclipped barycentrics with blur, which drop faces by their extrapolated depth.
        """
        settings = kwargs.get("raster_settings", self.raster_settings)
        return settings.blur_radius == 0 or _clips_barycentric(settings)

    def _shared_arguments(self, settings: RasterizationSettings, kwargs: dict[str, Any]) -> dict[str, Any]:
        """Arguments of both ways to rasterise; what the settings leave open follows the camera."""
        cameras = cameras_for_call(self.cameras, kwargs, "MeshRasterizer")
        perspective = cameras.is_perspective()
        z_clip = settings.z_clip_value
        if z_clip is None and perspective:
            z_clip = _half_of_nearest(cameras.get_znear())
        return {
            "image_size": settings.image_size,
            "blur_radius": settings.blur_radius,
            "cull_backfaces": settings.cull_backfaces,
            "z_clip_value": z_clip,
            "cull_to_frustum": settings.cull_to_frustum,
            "verts_divided_by_depth": perspective,
        }


def _clips_barycentric(settings: RasterizationSettings) -> bool:
    if settings.clip_barycentric_coords is None:
        return settings.blur_radius > 0
    return settings.clip_barycentric_coords


def _half_of_nearest(znear: float | Tensor | None) -> float | None:
    """Half of the nearest near plane of a batch."""
    if isinstance(znear, Tensor):
        znear = znear.min().item()
    return None if znear is None else znear / 2
