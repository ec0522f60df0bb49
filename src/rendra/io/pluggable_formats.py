"""What a file format must offer to be registered with `IO`."""

import os
from collections.abc import Sequence
from typing import Any

from rendra.common.datatypes import Device
from rendra.io._source import FileLike, PathManager
from rendra.structures import Meshes, Pointclouds


def endswith(path: object, suffixes: Sequence[str]) -> bool:
    """Whether `path` is a path with one of the suffixes, upper or lower case; False for anything but a path."""
    if not isinstance(path, str | os.PathLike):
        return False
    return str(os.fspath(path)).lower().endswith(tuple(suffix.lower() for suffix in suffixes))


class MeshFormatInterpreter:
    """One mesh format. Subclass it and hand an instance to `IO.register_meshes_format`."""

    def read(
        self, path: FileLike, include_textures: bool, device: Device, path_manager: PathManager | None, **kwargs: Any
    ) -> Meshes | None:
        """Read a mesh, or return None where `path` is not of this format.

        Args:
            path: path or open handle.
            include_textures: whether to read textures too.
            device: where the tensors go.
            path_manager: interprets paths where given.
            kwargs: options of the format; unknown ones are ignored.
        """
        raise NotImplementedError

    def save(
        self, data: Meshes, path: FileLike, path_manager: PathManager | None, binary: bool | None, **kwargs: Any
    ) -> bool:
        """Write a mesh and return True, or return False where `path` is not of this format.

        Args:
            data: a batch of one mesh.
            path: path or open handle.
            path_manager: interprets paths where given.
            binary: the caller's wish, None for the format's own choice.
            kwargs: options of the format, `include_textures` among them; unknown ones are ignored.
        """
        raise NotImplementedError


class PointcloudFormatInterpreter:
    """One point cloud format. Subclass it and hand an instance to `IO.register_pointcloud_format`."""

    def read(
        self, path: FileLike, device: Device, path_manager: PathManager | None, **kwargs: Any
    ) -> Pointclouds | None:
        """Read a point cloud, or return None where `path` is not of this format; arguments as for meshes."""
        raise NotImplementedError

    def save(
        self, data: Pointclouds, path: FileLike, path_manager: PathManager | None, binary: bool | None, **kwargs: Any
    ) -> bool:
        """Write a point cloud and return True, or return False where `path` is not of this format."""
        raise NotImplementedError


def single_mesh(data: Meshes) -> Meshes:
    """The batch itself, if it holds one mesh.

    Raises:
        ValueError: it holds none or several, which no file format here can.
    """
    if len(data) != 1:
        raise ValueError(
            f"a file holds one mesh, but the batch has {len(data)}: save data[i] one by one, "
            "or join them with join_meshes_as_scene"
        )
    return data


def single_cloud(data: Pointclouds) -> Pointclouds:
    """The batch itself, if it holds one cloud.

    Raises:
        ValueError: it holds none or several, which no file format here can.
    """
    if len(data) != 1:
        raise ValueError(
            f"a file holds one point cloud, but the batch has {len(data)}: save data[i] one by one, "
            "or join them with join_pointclouds_as_scene"
        )
    return data
