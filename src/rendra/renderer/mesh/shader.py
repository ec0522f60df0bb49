"""Fragments to images: what is lit, how, and how layers become one colour.

Shaders compute on covered pixels only. These are gathered into an image one row high and as wide as the number of
pixels that any face covers; textures, shading and blending see nothing else, and the result is written back
over the background.

Notation: N images, H x W pixels, K layers, P covered pixels of the fullest image, C channels.
"""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from rendra.common.datatypes import Device
from rendra.renderer.batching import Compaction, ragged
from rendra.renderer.blending import (
    BlendParams,
    background_color,
    hard_rgb_blend,
    sigmoid_alpha_blend,
    softmax_depth_blend,
    softmax_rgb_blend,
)
from rendra.renderer.camera_base import cameras_for_call
from rendra.renderer.lighting import PointLights
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.rasterizer import Fragments
from rendra.renderer.mesh.shading import (
    flat_shading,
    gouraud_shading,
    phong_shading,
    phong_shading_with_points,
)
from rendra.renderer.splatter_blend import SplatterBlender
from rendra.structures.meshes import Meshes


class ShaderBase(nn.Module):
    """What shaders share: cameras, lights, materials and blending, any of which a call may replace by keyword."""

    def __init__(
        self,
        device: Device = "cpu",
        cameras: Any = None,
        lights: Any = None,
        materials: Materials | None = None,
        blend_params: BlendParams | None = None,
    ) -> None:
        """Keep the parts; None stands for one default light, material and blending.

        Args:
            device: where default lights and materials are made.
            cameras: those of the rasteriser; None where each call brings its own.
            lights: PointLights, DirectionalLights, AmbientLights or what has their methods.
            materials: of the surfaces.
            blend_params: sigma, gamma and background.
        """
        super().__init__()
        self.lights = PointLights(device=device) if lights is None else lights
        self.materials = Materials(device=device) if materials is None else materials
        self.cameras = cameras
        self.blend_params = BlendParams() if blend_params is None else blend_params

    def to(self, device: Device) -> "ShaderBase":  # type: ignore[override]
        """Move cameras, lights and materials."""
        if self.cameras is not None:
            self.cameras = self.cameras.to(device)
        self.materials = self.materials.to(device)
        self.lights = self.lights.to(device)
        return self

    def _get_cameras(self, **kwargs: Any) -> Any:
        return cameras_for_call(self.cameras, kwargs, type(self).__name__)

    def _scene(self, kwargs: dict[str, Any]) -> dict[str, Any]:
        """Lights, cameras and materials of one call."""
        return {
            "lights": kwargs.get("lights", self.lights),
            "cameras": self._get_cameras(**kwargs),
            "materials": kwargs.get("materials", self.materials),
        }

    def _blending(self, kwargs: dict[str, Any]) -> BlendParams:
        return kwargs.get("blend_params", self.blend_params)


class HardPhongShader(ShaderBase):
    """Phong lighting of the nearest face, hard edges. Call: (fragments, meshes, **kwargs) -> (N, H, W, C + 1)."""

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Shade; cameras, lights, materials and blend_params may be replaced by keyword.

        Raises:
            ValueError: no cameras, or meshes without textures.
        """
        scene = self._scene(kwargs)
        color = _textured(phong_shading, meshes, scene)
        return _nearest_face_image(fragments, color, self._blending(kwargs))


class SoftPhongShader(ShaderBase):
    """Phong lighting of all layers, blended by softmax. Call: (fragments, meshes, **kwargs) -> (N, H, W, C + 1)."""

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Shade; cameras, lights, materials, blend_params, znear and zfar may be replaced by keyword.

        Raises:
            ValueError: no cameras, or meshes without textures.
        """
        scene = self._scene(kwargs)
        color = _textured(phong_shading, meshes, scene)
        return _softmax_image(fragments, color, self._blending(kwargs), *_planes(scene["cameras"], kwargs))


class HardGouraudShader(ShaderBase):
    """Vertices lit and interpolated, the nearest face, hard edges; needs TexturesVertex.

    Call: (fragments, meshes, **kwargs) -> (N, H, W, C + 1).
    """

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Shade; cameras, lights, materials and blend_params may be replaced by keyword.

        Raises:
            ValueError: no cameras, or textures other than TexturesVertex.
        """
        scene = self._scene(kwargs)
        return _nearest_face_image(
            fragments, lambda seen: gouraud_shading(meshes, seen, **scene), self._blending(kwargs)
        )


class SoftGouraudShader(ShaderBase):
    """Vertices lit and interpolated, layers blended by softmax; needs TexturesVertex.

    Call: (fragments, meshes, **kwargs) -> (N, H, W, C + 1).
    """

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Shade; cameras, lights, materials, blend_params, znear and zfar may be replaced by keyword.

        Raises:
            ValueError: no cameras, or textures other than TexturesVertex.
        """
        scene = self._scene(kwargs)
        return _softmax_image(
            fragments,
            lambda seen: gouraud_shading(meshes, seen, **scene),
            self._blending(kwargs),
            *_planes(scene["cameras"], kwargs),
        )


class HardFlatShader(ShaderBase):
    """Each face lit once, the nearest one, hard edges. Call: (fragments, meshes, **kwargs) -> (N, H, W, C + 1)."""

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Shade; cameras, lights, materials and blend_params may be replaced by keyword.

        Raises:
            ValueError: no cameras, or meshes without textures.
        """
        scene = self._scene(kwargs)
        color = _textured(flat_shading, meshes, scene)
        return _nearest_face_image(fragments, color, self._blending(kwargs))


class SoftSilhouetteShader(nn.Module):
    """Soft coverage in channel 3, ones in the colours. Call: (fragments, meshes, **kwargs) -> (N, H, W, 4).

    `MeshRenderer` does not ask it for fragments: it takes the exact silhouette over all faces instead.
    """

    def __init__(self, blend_params: BlendParams | None = None) -> None:
        """Keep blend_params, of which sigma is used; None for the defaults."""
        super().__init__()
        self.blend_params = BlendParams() if blend_params is None else blend_params

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Blend the layers of fragments; blend_params may be replaced by keyword."""
        white = torch.ones_like(fragments.bary_coords[..., :1, :])
        return sigmoid_alpha_blend(white, fragments, kwargs.get("blend_params", self.blend_params))


class SplatterPhongShader(ShaderBase):
    """Phong lighting of K layers, then splatted over neighbouring pixels: gradients at edges without blur_radius.

    Cole et al., "Differentiable surface rendering via non-differentiable sampling", ICCV 2021. Use
    blur_radius 0 and a few faces_per_pixel. sigma of the blending is here the standard deviation of a splat in
    pixels, normally 0.5. Call: (fragments, meshes, **kwargs) -> (N, H, W, 4).
    """

    def __init__(self, **kwargs: Any) -> None:
        """Take the arguments of `ShaderBase`; blending defaults to a sigma of 0.5 pixels."""
        kwargs["blend_params"] = kwargs.get("blend_params") or BlendParams(sigma=0.5)
        super().__init__(**kwargs)
        self.splatter_blender: SplatterBlender | None = None

    def to(self, device: Device) -> "SplatterPhongShader":  # type: ignore[override]
        """Move cameras, lights, materials and the blender."""
        super().to(device)
        if self.splatter_blender is not None:
            self.splatter_blender = self.splatter_blender.to(device)
        return self

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Shade and splat; cameras, lights, materials and blend_params may be replaced by keyword.

        Raises:
            ValueError: no cameras, or meshes without textures.
        """
        scene = self._scene(kwargs)
        blend_params = self._blending(kwargs)
        self.check_blend_params(blend_params)
        samples = fragments.detach()  # fixed on the surface: they move with it, not with the pixel grid
        texels = meshes.sample_textures(samples)
        colors, points = phong_shading_with_points(meshes, samples, texels=texels, **scene)
        blender = self._blender_for(samples.pix_to_face)
        return blender(colors, points, scene["cameras"], samples.pix_to_face < 0, blend_params)

    def _blender_for(self, pix_to_face: Tensor) -> SplatterBlender:
        """The blender of the last call, or a new one where size or device have changed."""
        n, h, w, k = pix_to_face.shape
        kept = self.splatter_blender
        if kept is None or kept.input_shape != (n, h, w, k) or kept.pixel_centres.device != pix_to_face.device:
            self.splatter_blender = kept = SplatterBlender((n, h, w, k), pix_to_face.device)
        return kept

    @staticmethod
    def check_blend_params(blend_params: BlendParams) -> None:
        """Warn of a sigma that was hardly meant in pixels."""
        if blend_params.sigma != 0.5:
            warnings.warn(
                f"SplatterPhongShader received sigma={blend_params.sigma}. sigma is the standard deviation of a "
                "splat in pixels and normally 0.5",
                stacklevel=3,
            )


class HardDepthShader(ShaderBase):
    """View depth of the nearest face, zfar elsewhere. Call: (fragments, meshes, **kwargs) -> (N, H, W, 1)."""

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Read the depth; cameras and zfar may be replaced by keyword.

        Raises:
            ValueError: no cameras.
        """
        depth = fragments.zbuf[..., :1]
        _, zfar = _planes(self._get_cameras(**kwargs), kwargs)
        far = torch.as_tensor(zfar, dtype=depth.dtype, device=depth.device).reshape(-1, 1, 1, 1)
        return torch.where(fragments.pix_to_face[..., :1] < 0, far, depth)


class SoftDepthShader(ShaderBase):
    """View depth blended over layers as softmax colours are. Call: (fragments, meshes, **kwargs) -> (N, H, W, 1)."""

    def forward(self, fragments: Fragments, meshes: Meshes, **kwargs: Any) -> Tensor:
        """Blend the depth; cameras, blend_params, znear and zfar may be replaced by keyword.

        Raises:
            ValueError: no cameras.
        """
        planes = _planes(self._get_cameras(**kwargs), kwargs)
        return softmax_depth_blend(fragments, self._blending(kwargs), *planes)


def _planes(cameras: Any, kwargs: dict[str, Any]) -> tuple[float | Tensor, float | Tensor]:
    """The planes znear and zfar: by keyword, else of the cameras, else 1 and 100."""
    return (
        kwargs.get("znear", getattr(cameras, "znear", 1.0)),
        kwargs.get("zfar", getattr(cameras, "zfar", 100.0)),
    )


def _textured(shading: Callable[..., Tensor], meshes: Meshes, scene: dict[str, Any]) -> Callable[[Fragments], Tensor]:
    """The colours of fragments: their texels, lit by `shading`."""
    return lambda seen: shading(meshes, seen, texels=meshes.sample_textures(seen), **scene)


def _nearest_face_image(
    fragments: Fragments, color: Callable[[Fragments], Tensor], blend_params: BlendParams
) -> Tensor:
    """Hard blend of the first layer, coloured at covered pixels only."""
    nearest = _each(fragments, lambda x: x[:, :, :, :1])
    return _on_covered_pixels(nearest, lambda seen: hard_rgb_blend(color(seen), seen, blend_params), blend_params)


def _softmax_image(
    fragments: Fragments,
    color: Callable[[Fragments], Tensor],
    blend_params: BlendParams,
    znear: float | Tensor,
    zfar: float | Tensor,
) -> Tensor:
    """Softmax blend of all layers, coloured at filled slots only."""

    def blend(seen: Fragments) -> Tensor:
        slots = _Gathered(seen.pix_to_face.flatten(1) >= 0)
        filled = _each(seen, lambda x: slots.gather(x.flatten(1, 3), -1)[:, None, :, None])
        colors = slots.scatter(color(filled)[:, 0, :, 0])
        colors = colors.view(*seen.pix_to_face.shape, colors.shape[-1])
        return softmax_rgb_blend(colors, seen, blend_params, znear, zfar)

    return _on_covered_pixels(fragments, blend, blend_params)


def _on_covered_pixels(
    fragments: Fragments, render: Callable[[Fragments], Tensor], blend_params: BlendParams
) -> Tensor:
    """Run `render` on the covered pixels, fragments (N, 1, P, K); write its (N, 1, P, C + 1) over the background."""
    height, width = fragments.pix_to_face.shape[1:3]
    pixels = _Gathered((fragments.pix_to_face.amax(-1) >= 0).flatten(1))
    seen = _each(fragments, lambda x: pixels.gather(x.flatten(1, 2), -1)[:, None])
    result = render(_drop_empty_layers(seen))[:, 0]
    background = background_color(blend_params, result[..., :-1])
    image = pixels.scatter(result, torch.cat((background, background.new_zeros(1))))
    return image.view(len(image), height, width, image.shape[-1])


def _drop_empty_layers(fragments: Fragments) -> Fragments:
    """Without the layers that no pixel fills, but for the first."""
    used = (fragments.pix_to_face >= 0).flatten(0, 2).any(0).nonzero()
    depth = int(used[-1]) + 1 if len(used) else 1
    if depth >= fragments.pix_to_face.shape[-1]:
        return fragments
    return _each(fragments, lambda x: x[:, :, :, :depth])


def _each(fragments: Fragments, change: Callable[[Tensor], Tensor]) -> Fragments:
    """The fragments with every tensor changed alike."""
    return Fragments(
        change(fragments.pix_to_face),
        change(fragments.zbuf),
        change(fragments.bary_coords),
        change(fragments.dists),
    )


class _Gathered:
    """Marked entries of an (N, L) batch as (N, P), padded at the end of each row."""

    def __init__(self, mask: Tensor) -> None:
        self._marked = Compaction(mask)
        self._rows = ragged(self._marked.counts)

    def gather(self, values: Tensor, fill: float) -> Tensor:
        """(N, L, ...) to (N, P, ...), `fill` in the padding."""
        return self._rows.put(self._marked.take(values), fill)

    def scatter(self, values: Tensor, fill: Tensor | float = 0.0) -> Tensor:
        """(N, P, ...) to (N, L, ...), `fill` elsewhere."""
        return self._marked.put(self._rows.take(values), fill)
