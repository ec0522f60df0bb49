"""A procedural textured cow, the default mesh of the project.

Blended signed distances give its shape, marching cubes and edge collapse its triangles, charts along the
coordinate axes its texture coordinates, and a colour function of the surface point its texture. The cow
stands upright (y up), looks towards -z and is centred on the origin, like the cow that PyTorch3D's tutorials
use, so the same cameras see both.
"""

import torch

from rendra.renderer.mesh.textures import TexturesUV
from rendra.structures.meshes import Meshes
from rendra_lab.synthesis.cow_anatomy import CowParameters
from rendra_lab.synthesis.cow_arrays import TexturedMesh, build_cow
from rendra_lab.synthesis.cow_coat import BREEDS, CoatParameters

__all__ = ["BREEDS", "CoatParameters", "CowParameters", "TexturedMesh", "as_meshes", "build_cow", "make_cow"]


def make_cow(
    seed: int = 0,
    texture_size: int = 512,
    num_faces: int = 9600,
    size: float = 1.8,
    build: CowParameters | None = None,
    coat: CoatParameters | None = None,
    device: torch.device | str = "cpu",
) -> Meshes:
    """A batch of one cow with `TexturesUV` on `device`; the other arguments are those of `build_cow`."""
    return as_meshes(build_cow(seed, texture_size, num_faces, size, build, coat), device)


def as_meshes(cow: TexturedMesh, device: torch.device | str = "cpu") -> Meshes:
    """A batch of one textured mesh with `TexturesUV` on `device`."""
    verts, faces, uvs, faces_uvs, image = (
        torch.from_numpy(array).to(device)
        for array in (cow.verts, cow.faces, cow.verts_uvs, cow.faces_uvs, cow.texture)
    )
    textures = TexturesUV(maps=image[None], faces_uvs=[faces_uvs], verts_uvs=[uvs])
    return Meshes(verts=[verts], faces=[faces], textures=textures)
