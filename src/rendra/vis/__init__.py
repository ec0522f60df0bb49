"""Looking at scenes and textures: interactive 3-D figures (plotly) and pictures of texture maps."""

from rendra.vis.plotly_vis import AxisArgs, Lighting, get_camera_wireframe, plot_batch_individually, plot_scene
from rendra.vis.texture_vis import (
    texture_atlas_image,
    texturesuv_image_matplotlib,
    texturesuv_image_PIL,
    texturesuv_islands_image,
)

__all__ = [
    "AxisArgs",
    "Lighting",
    "get_camera_wireframe",
    "plot_batch_individually",
    "plot_scene",
    "texture_atlas_image",
    "texturesuv_image_PIL",
    "texturesuv_image_matplotlib",
    "texturesuv_islands_image",
]
