"""A rasterizer and a shader put together."""

from typing import Any

import torch
from torch import Tensor, nn

from rendra.common.datatypes import Device
from rendra.renderer.mesh.rasterizer import Fragments, MeshRasterizer
from rendra.renderer.mesh.shader import SoftSilhouetteShader
from rendra.structures.meshes import Meshes


class MeshRenderer(nn.Module):
    """Meshes to images: rasterize, then shade.

    With a `SoftSilhouetteShader` on a plain `MeshRasterizer` nobody needs fragments, and the silhouette is taken
    directly: exact for any number of faces behind a pixel, `faces_per_pixel` plays no part.
    """

    def __init__(self, rasterizer: nn.Module, shader: nn.Module) -> None:
        """Keep a rasterizer (meshes -> fragments) and a shader (fragments, meshes -> images)."""
        super().__init__()
        self.rasterizer = rasterizer
        self.shader = shader

    def to(self, device: Device) -> "MeshRenderer":  # type: ignore[override]
        """Move the parts."""
        self.rasterizer.to(device)
        self.shader.to(device)
        return self

    def forward(self, meshes_world: Meshes, **kwargs: Any) -> Tensor:
        """Render meshes in world coordinates.

        Args:
            meshes_world: batch of N.
            **kwargs: passed to both parts: cameras, R, T, lights, materials, blend_params, znear, zfar,
                raster_settings.

        Returns:
            (N, H, W, C), as the shader gives them.
        """
        if _is_plain_silhouette(self.rasterizer, self.shader, kwargs):
            return _silhouette_image(self.rasterizer, self.shader, meshes_world, kwargs)
        return self.shader(self.rasterizer(meshes_world, **kwargs), meshes_world, **kwargs)


class MeshRendererWithFragments(nn.Module):
    """As `MeshRenderer`, but hands out the fragments with the images."""

    def __init__(self, rasterizer: nn.Module, shader: nn.Module) -> None:
        """Keep a rasterizer (meshes -> fragments) and a shader (fragments, meshes -> images)."""
        super().__init__()
        self.rasterizer = rasterizer
        self.shader = shader

    def to(self, device: Device) -> "MeshRendererWithFragments":  # type: ignore[override]
        """Move the parts."""
        self.rasterizer.to(device)
        self.shader.to(device)
        return self

    def forward(self, meshes_world: Meshes, **kwargs: Any) -> tuple[Tensor, Fragments]:
        """Images (N, H, W, C) and their fragments; arguments as of `MeshRenderer`."""
        fragments = self.rasterizer(meshes_world, **kwargs)
        return self.shader(fragments, meshes_world, **kwargs), fragments


def _is_plain_silhouette(rasterizer: nn.Module, shader: nn.Module, kwargs: dict[str, Any]) -> bool:
    """Whether both parts are exactly ours: a subclass may read or change the fragments."""
    return (
        type(shader) is SoftSilhouetteShader
        and type(rasterizer) is MeshRasterizer
        and rasterizer.silhouette_matches_fragments(**kwargs)
    )


def _silhouette_image(rasterizer: Any, shader: Any, meshes_world: Meshes, kwargs: dict[str, Any]) -> Tensor:
    """Ones in the colours, the soft silhouette in channel 3."""
    blend_params = kwargs.get("blend_params", shader.blend_params)
    alpha = rasterizer.silhouette(meshes_world, blend_params.sigma, **kwargs)[..., None]
    return torch.cat((torch.ones_like(alpha).expand(*alpha.shape[:3], 3), alpha), dim=-1)
