"""Rendra: differentiable rendering for PyTorch, with PyTorch3D's public API and nothing to compile.

Dimension letters, the same everywhere:
    B batch (N in signatures that PyTorch3D fixed), V verts, F faces, P points, R rays, S samples along a ray,
    K layers of a pixel, H W image height and width, J joints.

Frames: world and view are right-handed; view space has +X left, +Y up, +Z into the scene. Points are row
vectors, x_view = x_world @ R + T. NDC keeps those axes and puts the short side of the image in [-1, 1].
"""

__version__ = "0.1.0"
