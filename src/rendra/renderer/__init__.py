"""Cameras, lights, textures, and the renderers that bring them together."""

from rendra.renderer.mesh import TexturesAtlas, TexturesBase, TexturesUV, TexturesVertex

__all__ = ["TexturesAtlas", "TexturesBase", "TexturesUV", "TexturesVertex"]
