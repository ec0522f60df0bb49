"""A gradient through a picture: `python scripts/tour/gradients.py [FILE.obj]`.

The silhouette of a mesh is rendered with soft edges, so that every pixel near an outline depends smoothly on where
the mesh is. Backpropagation then says how to move it to make the picture look like another one; a few steps do so.
The numbers are checked against finite differences: the picture is differentiated, not guessed at.
"""

import math
import sys

import torch

from rendra.io import load_objs_as_meshes
from rendra.renderer import (
    BlendParams,
    FoVPerspectiveCameras,
    MeshRasterizer,
    MeshRenderer,
    RasterizationSettings,
    SoftSilhouetteShader,
    look_at_view_transform,
)
from rendra.structures import Meshes
from rendra.utils import ico_sphere

SIGMA = 1e-3  # width of an edge, in squared NDC


def main(file: str | None = None) -> None:
    """Moves the user's OBJ file, or a sphere, in front of a camera."""
    mesh = ico_sphere(2) if file is None else load_objs_as_meshes([file])
    mesh = centred(mesh)
    R, T = look_at_view_transform(dist=4.0, elev=0.0, azim=0.0)
    edge = math.log(1 / 1e-4 - 1) * SIGMA  # as far as a face reaches: where its sigmoid has fallen to 1e-4
    renderer = MeshRenderer(
        MeshRasterizer(FoVPerspectiveCameras(R=R, T=T), RasterizationSettings(image_size=64, blur_radius=edge)),
        SoftSilhouetteShader(BlendParams(sigma=SIGMA)),
    )

    def silhouette(offset: torch.Tensor) -> torch.Tensor:
        return renderer(mesh.offset_verts(offset))[0, ..., 3]  # (H, W) in [0, 1]

    target = silhouette(torch.tensor([0.3, -0.2, 0.0])).detach()

    def loss(offset: torch.Tensor) -> torch.Tensor:
        return (silhouette(offset) - target).square().mean()

    offset = torch.zeros(3, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(offset), offset)
    h = 1e-2
    differences = [float(loss(h * axis) - loss(-h * axis)) / (2 * h) for axis in torch.eye(3)]
    print("gradient:          ", [f"{float(each):+.4f}" for each in gradient])
    print("finite differences:", [f"{each:+.4f}" for each in differences])

    optimizer = torch.optim.Adam([offset], lr=0.02)
    for step in range(61):
        optimizer.zero_grad()
        value = loss(offset)
        if step % 15 == 0:
            print(
                f"step {step:2d}: loss {float(value.detach()):.5f}, offset {[round(x, 3) for x in offset.tolist()]}"
            )
        value.backward()
        optimizer.step()
    print(f"found ({offset[0]:.2f}, {offset[1]:.2f}) across the picture, true (0.30, -0.20)")


def centred(mesh: Meshes) -> Meshes:
    """The mesh about the origin, its farthest vertex at distance 1."""
    verts = mesh.verts_packed() - mesh.verts_packed().mean(0)
    return mesh.update_padded((verts / verts.norm(dim=1).amax())[None])


if __name__ == "__main__":
    main(*sys.argv[1:2])
