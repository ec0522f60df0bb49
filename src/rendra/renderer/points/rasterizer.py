"""Point clouds in the world, seen by cameras: to NDC, then to fragments."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor, nn

from rendra.common.datatypes import Device
from rendra.renderer.camera_base import cameras_for_call, ndc_and_view_depth
from rendra.renderer.points.rasterize_points import Radius, rasterize_points
from rendra.structures.pointclouds import Pointclouds


class PointFragments(NamedTuple):
    """What each pixel sees, K layers deep, nearest first; empty slots hold -1.

    idx: (N, H, W, K) int64, index of the packed point.
    zbuf: (N, H, W, K), view depth.
    dists: (N, H, W, K), squared NDC distance of the point from the pixel's centre.
    """

    idx: Tensor
    zbuf: Tensor
    dists: Tensor


@dataclass
class PointsRasterizationSettings:
    """How points are rasterised; see `rasterize_points`.

    image_size: side of a square image, or (H, W), in pixels.
    radius: of the discs, in NDC; one number, or one for each point.
    points_per_pixel: layers kept for each pixel, without limit.
    bin_size, max_points_per_bin: accepted for compatibility and ignored: nothing overflows here.
    """

    image_size: int | tuple[int, int] = 256
    radius: Radius = 0.01
    points_per_pixel: int = 8
    bin_size: int | None = None
    max_points_per_bin: int | None = None


class PointsRasterizer(nn.Module):
    """Cameras and settings that turn point clouds into fragments."""

    def __init__(self, cameras: Any = None, raster_settings: PointsRasterizationSettings | None = None) -> None:
        """Keep the parts.

        Args:
            cameras: of rendra.renderer.cameras, one for all clouds or one for each; None where each call brings its
                own.
            raster_settings: None for the defaults.
        """
        super().__init__()
        self.cameras = cameras
        self.raster_settings = PointsRasterizationSettings() if raster_settings is None else raster_settings

    def to(self, device: Device) -> "PointsRasterizer":  # type: ignore[override]
        """Move the cameras."""
        if self.cameras is not None:
            self.cameras = self.cameras.to(device)
        return self

    def transform(self, point_clouds: Pointclouds, **kwargs: Any) -> Pointclouds:
        """Bring clouds to NDC, with the view depth as z.

        Args:
            point_clouds: batch of N in world coordinates.
            **kwargs: `cameras`, `eps` of the division by depth, and whatever the cameras take (R, T, ...).

        Raises:
            ValueError: no cameras, or as many as fit neither one nor N.
        """
        cameras = cameras_for_call(self.cameras, kwargs, "PointsRasterizer")
        if len(cameras) not in (1, len(point_clouds)):
            raise ValueError(
                f"Wrong number ({len(cameras)}) of cameras for {len(point_clouds)} clouds: give one, or one each"
            )
        points_seen = ndc_and_view_depth(cameras, point_clouds.points_padded(), kwargs)
        return point_clouds.update_padded(points_seen)

    def forward(self, point_clouds: Pointclouds, **kwargs: Any) -> PointFragments:
        """Rasterise clouds in world coordinates.

        Args:
            point_clouds: batch of N.
            **kwargs: as of `transform`, and `raster_settings` to replace those of this rasterizer.
        """
        settings = kwargs.get("raster_settings", self.raster_settings)
        return PointFragments(
            *rasterize_points(
                self.transform(point_clouds, **kwargs),
                image_size=settings.image_size,
                radius=settings.radius,
                points_per_pixel=settings.points_per_pixel,
            )
        )
