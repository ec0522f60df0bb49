"""`IO`: any mesh or point cloud file, by its suffix."""

from collections import deque
from collections.abc import Iterable
from typing import Any

from rendra.common.datatypes import Device
from rendra.io._mesh_as_cloud import MeshFileAsCloud, cloud_of_verts
from rendra.io._source import FileLike, PathManager
from rendra.io.experimental_gltf_io import MeshGlbFormat
from rendra.io.obj_io import MeshObjFormat
from rendra.io.off_io import MeshOffFormat
from rendra.io.pluggable_formats import MeshFormatInterpreter, PointcloudFormatInterpreter
from rendra.io.ply_io import MeshPlyFormat, PointcloudPlyFormat
from rendra.io.stl_io import MeshStlFormat
from rendra.io.xyz_io import PointcloudXyzFormat
from rendra.structures import Meshes, Pointclouds


class IO:
    """Reads and writes meshes and point clouds in every registered format.

    The format registered last is asked first.

    Args:
        include_default_formats: register OBJ, OFF, PLY, STL and glTF for meshes; PLY, XYZ, and the vertices of OBJ,
            OFF and glTF, for clouds.
        path_manager: interprets all paths, as `iopath.common.file_io.PathManager` does; None for plain files.

    Attributes:
        path_manager: as given.
        mesh_interpreters, pointcloud_interpreters: the registered formats, in the order of asking.
    """

    def __init__(self, include_default_formats: bool = True, path_manager: PathManager | None = None) -> None:
        self.path_manager = path_manager
        self.mesh_interpreters: deque[MeshFormatInterpreter] = deque()
        self.pointcloud_interpreters: deque[PointcloudFormatInterpreter] = deque()
        if include_default_formats:
            self.register_default_formats()

    def register_default_formats(self) -> None:
        """Register the formats that come with this package."""
        for mesh_format in (MeshGlbFormat(), MeshStlFormat(), MeshOffFormat(), MeshObjFormat(), MeshPlyFormat()):
            self.register_meshes_format(mesh_format)
        for cloud_format in (
            MeshFileAsCloud(MeshGlbFormat(), (".glb", ".gltf")),
            MeshFileAsCloud(MeshOffFormat(), (".off",)),
            MeshFileAsCloud(MeshObjFormat(), (".obj",)),
            PointcloudXyzFormat(),
            PointcloudPlyFormat(),
        ):
            self.register_pointcloud_format(cloud_format)

    def register_meshes_format(self, interpreter: MeshFormatInterpreter) -> None:
        """Add a mesh format, to be asked before all others.

        Raises:
            ValueError: it is no MeshFormatInterpreter.
        """
        if not isinstance(interpreter, MeshFormatInterpreter):
            raise ValueError(
                f"Invalid interpreter: expected a MeshFormatInterpreter, got {type(interpreter).__name__}"
            )
        self.mesh_interpreters.appendleft(interpreter)

    def register_pointcloud_format(self, interpreter: PointcloudFormatInterpreter) -> None:
        """Add a point cloud format, to be asked before all others.

        Raises:
            ValueError: it is no PointcloudFormatInterpreter.
        """
        if not isinstance(interpreter, PointcloudFormatInterpreter):
            raise ValueError(
                f"Invalid interpreter: expected a PointcloudFormatInterpreter, got {type(interpreter).__name__}"
            )
        self.pointcloud_interpreters.appendleft(interpreter)

    def load_mesh(
        self, path: FileLike, include_textures: bool = True, device: Device = "cpu", **kwargs: Any
    ) -> Meshes:
        """Read a mesh file into a batch of one.

        Args:
            path: path; an open handle only with formats that look at the content instead of the suffix.
            include_textures: read textures too.
            device: where the tensors go.
            kwargs: options of the format, such as `create_texture_atlas` for OBJ.

        Raises:
            ValueError: no registered format reads this file.
            MeshFormatError: the file is malformed.
        """
        mesh = self._read_mesh(path, include_textures, device, **kwargs)
        if mesh is None:
            raise ValueError(f"No mesh interpreter found to read {path}.{_known(self.mesh_interpreters)}")
        return mesh

    def _read_mesh(self, path: FileLike, include_textures: bool, device: Device, **kwargs: Any) -> Meshes | None:
        for interpreter in self.mesh_interpreters:
            mesh = interpreter.read(
                path, include_textures=include_textures, device=device, path_manager=self.path_manager, **kwargs
            )
            if mesh is not None:
                return mesh
        return None

    def save_mesh(
        self,
        data: Meshes,
        path: FileLike,
        binary: bool | None = None,
        include_textures: bool = True,
        **kwargs: Any,
    ) -> None:
        """Write a batch of one mesh.

        Args:
            data: the mesh.
            path: its suffix chooses the format.
            binary: binary or text, where the format has both; None for its own choice.
            include_textures: write textures and colours too, where the format can.
            kwargs: options of the format, such as `decimal_places` or PLY's `colors_as_uint8`.

        Raises:
            ValueError: no registered format writes this file, or the batch has not exactly one mesh.
        """
        if not isinstance(data, Meshes):
            raise ValueError(f"save_mesh() expects a Meshes object, got {type(data).__name__}")
        for interpreter in self.mesh_interpreters:
            if interpreter.save(
                data,
                path,
                path_manager=self.path_manager,
                binary=binary,
                include_textures=include_textures,
                **kwargs,
            ):
                return
        raise ValueError(f"No mesh interpreter found to write to {path}.{_known(self.mesh_interpreters)}")

    def load_pointcloud(self, path: FileLike, device: Device = "cpu", **kwargs: Any) -> Pointclouds:
        """Read a point cloud file, or the vertices of a mesh file, into a batch of one.

        Args:
            path: its suffix chooses the format.
            device: where the tensors go.
            kwargs: options of the format, such as `columns` for XYZ.

        Returns:
            The points, with normals where the file has them, and with its colours in [0, 1] as features.

        Raises:
            ValueError: no registered format reads this file.
            MeshFormatError: the file is malformed.
        """
        cloud = self._read_cloud(path, device, **kwargs)
        if cloud is None:
            known = _known(self.pointcloud_interpreters)
            raise ValueError(f"No point cloud interpreter found to read {path}.{known}")
        return cloud

    def _read_cloud(self, path: FileLike, device: Device, **kwargs: Any) -> Pointclouds | None:
        for interpreter in self.pointcloud_interpreters:
            cloud = interpreter.read(path, device=device, path_manager=self.path_manager, **kwargs)
            if cloud is not None:
                return cloud
        return None

    def load_geometry(
        self, path: FileLike, include_textures: bool = True, device: Device = "cpu", **kwargs: Any
    ) -> Meshes | Pointclouds:
        """Read whatever a file holds into a batch of one: a mesh, or a cloud where there are no faces.

        Args:
            path: its suffix chooses the format.
            include_textures: read the textures of a mesh, the features of a cloud.
            device: where the tensors go.
            kwargs: options of the format.

        Raises:
            ValueError: no registered format reads this file.
            MeshFormatError: the file is malformed.
        """
        mesh = self._read_mesh(path, include_textures, device, **kwargs)
        if mesh is not None:
            return cloud_of_verts(mesh) if mesh.isempty() else mesh
        cloud = self._read_cloud(path, device, **kwargs)
        if cloud is None:
            known = _known([*self.mesh_interpreters, *self.pointcloud_interpreters])
            raise ValueError(f"No mesh or point cloud interpreter found to read {path}.{known}")
        return cloud if include_textures else Pointclouds(cloud.points_list(), normals=cloud.normals_list())

    def save_pointcloud(self, data: Pointclouds, path: FileLike, binary: bool | None = None, **kwargs: Any) -> None:
        """Write a batch of one point cloud.

        Args:
            data: the cloud; features of three channels are written as colours.
            path: its suffix chooses the format.
            binary: binary or text, where the format has both; None for its own choice.
            kwargs: options of the format, such as `decimal_places` or PLY's `colors_as_uint8`.

        Raises:
            ValueError: no registered format writes this file, or the batch has not exactly one cloud.
        """
        if not isinstance(data, Pointclouds):
            raise ValueError(f"save_pointcloud() expects a Pointclouds object, got {type(data).__name__}")
        for interpreter in self.pointcloud_interpreters:
            if interpreter.save(data, path, path_manager=self.path_manager, binary=binary, **kwargs):
                return
        raise ValueError(
            f"No point cloud interpreter found to write to {path}.{_known(self.pointcloud_interpreters)}"
        )


def _known(interpreters: Iterable[Any]) -> str:
    """The suffixes that would have worked."""
    suffixes = {suffix for each in interpreters for suffix in getattr(each, "known_suffixes", ())}
    return f" Registered: {', '.join(sorted(suffixes))}." if suffixes else " No format is registered."
