"""glTF 2.0 files: .glb and .gltf.

Letters: V verts, F faces (triangles). The frame is the file's: right-handed, +Y up, metres. Texture coordinates,
whose origin is at the upper left there, are turned to the lower left, where this package has it: v becomes 1 - v. As
in OBJ files, 0 and 1 are taken for the centres of the outermost texels, where glTF means their outer edges.

What is written comes back to the bit. Two attributes of the file's vertices, which other programs pass over, help:
`_RENDRA_VERTEX`, where a vertex had to be written once for each of its texture coordinates, and `_RENDRA_V`, where
1 - v is not exact. They are ignored where they contradict the rest of the file.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.io._gltf_asset import Asset
from rendra.io._gltf_materials import Pictures
from rendra.io._gltf_paint import paint
from rendra.io._gltf_parts import Part, read_parts
from rendra.io._gltf_writer import render_glb, render_gltf
from rendra.io._source import FileLike, PathManager, read_source, write_sink
from rendra.io.pluggable_formats import MeshFormatInterpreter, endswith, single_mesh
from rendra.structures import Meshes


class MeshGlbFormat(MeshFormatInterpreter):
    """glTF files for `IO`: .glb in one piece, .gltf with the files that it names, or with all inside it.

    Read are the meshes of the default scene, moved to where its nodes put them and joined into one: triangles,
    strips and fans, points as vertices without faces; normals where all parts have them; of the materials the base
    colour, of vertices the first colour. Kept in mind are KHR_texture_transform, KHR_mesh_quantization and
    EXT_texture_webp. Not read are lines, lights, cameras, animations, and what else materials say.
    """

    def __init__(self) -> None:
        self.known_suffixes = (".glb", ".gltf")

    def read(
        self,
        path: FileLike,
        include_textures: bool,
        device: Device,
        path_manager: PathManager | None,
        allow_outside: bool = False,
        **kwargs: Any,
    ) -> Meshes | None:
        """Read a scene as one mesh; None for any other suffix.

        Colours alone become `TexturesVertex`, images `TexturesUV`; several images are packed into one. Numbers of
        colours are the file's, and opacity is dropped. A face that reads a repeated image beyond its border is
        moved back into it as a whole. A missing image is a warning.

        Args:
            path: whose suffix chooses this format.
            include_textures: read colours and images.
            device: where the tensors go.
            path_manager: interprets paths where given.
            allow_outside: let buffers and images lie outside of the file's folder.

        Raises:
            MeshFormatError: the file, a buffer or an image is malformed, compressed by Draco or meshopt, uses sparse
                accessors, or names a file that is refused.
            OSError: the path cannot be opened.
        """
        if not endswith(path, self.known_suffixes):
            return None
        source = read_source(path, path_manager)
        asset = Asset(source, path_manager, allow_outside)
        parts = read_parts(asset)
        textures = paint(parts, Pictures(asset), source.name) if include_textures and parts else None
        verts, faces, normals = _joined(parts)
        mesh = Meshes([verts], [faces], textures, verts_normals=None if normals is None else [normals])
        return mesh.to(device)

    def save(
        self,
        data: Meshes,
        path: FileLike,
        path_manager: PathManager | None,
        binary: bool | None,
        include_textures: bool = True,
        **kwargs: Any,
    ) -> bool:
        """Write one mesh, its normals if it `has_verts_normals`, its UV texture (as PNG) or vertex colours.

        All lies in the one file, also in a .gltf. The image has 8 bits a channel.

        Raises:
            ValueError: `binary` contradicts the suffix, the batch has not exactly one mesh, a number is not finite.
            OSError: the file cannot be written; what stood there before is untouched.
        """
        if not endswith(path, self.known_suffixes):
            return False
        is_glb = endswith(path, (".glb",))
        if binary is not None and binary != is_glb:
            raise ValueError(f"binary={binary}, but .glb is binary and .gltf is text: leave binary None")
        render = render_glb if is_glb else render_gltf
        write_sink(path, render(single_mesh(data), include_textures), path_manager)
        return True


def _joined(parts: list[Part]) -> tuple[Tensor, Tensor, Tensor | None]:
    """(V, 3) vertices, (F, 3) faces and, where all parts have them, (V, 3) normals."""
    if not parts:
        return torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), None
    starts = np.cumsum([0, *(len(part.verts) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    normals = [part.normals for part in parts if part.normals is not None]
    return (
        torch.from_numpy(np.concatenate([part.verts for part in parts])),
        torch.from_numpy(faces),
        torch.from_numpy(np.concatenate(normals)) if len(normals) == len(parts) else None,
    )
