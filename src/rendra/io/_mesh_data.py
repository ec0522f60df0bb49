"""What a file of vertices, polygons and colours says, before it becomes a batch of meshes."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.io._bulk_text import Positions
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesBase, TexturesVertex
from rendra.structures import Meshes

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class MeshData:
    """One mesh, polygons already cut into triangles; None where the file says nothing.

    Attributes:
        verts: (V, 3).
        faces: (F, 3) indices from 0; none in a file without faces.
        normals: (V, 3), of the vertices.
        verts_colors: (V, 3); integer colours scaled to [0, 1], others as they are.
        faces_colors: (F, 3) likewise; white for a face without.
    """

    verts: Floats
    faces: Positions
    normals: Floats | None
    verts_colors: Floats | None
    faces_colors: Floats | None

    def meshes(self, include_textures: bool, device: Device) -> Meshes:
        """A batch of one: vertex colours as `TexturesVertex`, face colours alone as `TexturesAtlas` of one texel."""

        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device)

        textures: TexturesBase | None = None
        if include_textures and self.verts_colors is not None:
            textures = TexturesVertex(verts_features=[tensor(self.verts_colors)])
        elif include_textures and self.faces_colors is not None:
            textures = TexturesAtlas(atlas=[tensor(self.faces_colors)[:, None, None]])
        normals = None if self.normals is None else [tensor(self.normals)]
        return Meshes([tensor(self.verts)], [tensor(self.faces)], textures, verts_normals=normals)
