"""The vertices of mesh files as point clouds, and clouds as meshes without faces."""

from typing import Any

import torch

from rendra.common.datatypes import Device
from rendra.io._source import FileLike, PathManager
from rendra.io.pluggable_formats import (
    MeshFormatInterpreter,
    PointcloudFormatInterpreter,
    endswith,
    single_cloud,
)
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures import Meshes, Pointclouds


def cloud_of_verts(mesh: Meshes) -> Pointclouds:
    """The vertices of a batch of meshes with their normals, if there are any, and vertex colours as features."""
    colors = mesh.textures.verts_features_list() if isinstance(mesh.textures, TexturesVertex) else None
    normals = mesh.verts_normals_list() if mesh.has_verts_normals() else None
    return Pointclouds(mesh.verts_list(), normals=normals, features=colors)


class MeshFileAsCloud(PointcloudFormatInterpreter):
    """A mesh format for clouds: its vertices, normals and vertex colours.

    Args:
        mesh_format: reads and writes the files.
        suffixes: of its files that may hold vertices without faces.
    """

    def __init__(self, mesh_format: MeshFormatInterpreter, suffixes: tuple[str, ...]) -> None:
        self._mesh_format = mesh_format
        self.known_suffixes = suffixes

    def read(
        self, path: FileLike, device: Device, path_manager: PathManager | None, **kwargs: Any
    ) -> Pointclouds | None:
        """Read the vertices, their normals where the file's format keeps them, and their colours as features."""
        if not endswith(path, self.known_suffixes):
            return None
        mesh = self._mesh_format.read(path, True, device, path_manager, **kwargs)
        return None if mesh is None else cloud_of_verts(mesh)

    def save(
        self, data: Pointclouds, path: FileLike, path_manager: PathManager | None, binary: bool | None, **kwargs: Any
    ) -> bool:
        """Write the points as vertices, their normals, and their features if they are three, as colours."""
        if not endswith(path, self.known_suffixes):
            return False
        points, normals, features = single_cloud(data).get_cloud(0)
        mesh = Meshes(
            [points],
            [torch.zeros(0, 3, dtype=torch.int64, device=points.device)],
            None if features is None else TexturesVertex([features]),
            verts_normals=None if normals is None else [normals],
        )
        return self._mesh_format.save(mesh, path, path_manager, binary, **kwargs)
