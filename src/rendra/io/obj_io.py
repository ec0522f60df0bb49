"""Wavefront OBJ files with their materials.

Letters: V verts, F faces (triangles), U texture coordinates, M normals. The frame is the file's; texture
coordinates have their origin at the bottom left. What is not finite in single precision is an error, not data.
"""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.io._images import encode_image, image_suffix
from rendra.io._obj_text import MOST_LIBRARIES, ObjData, parse_obj
from rendra.io._rows import check_decimals, float_rows, format_rows, int_rows, number_format
from rendra.io._source import (
    FileLike,
    PathManager,
    Source,
    is_path,
    neighbour,
    path_text,
    read_neighbour,
    read_source,
    write_sink,
)
from rendra.io.errors import MeshFormatError
from rendra.io.mtl_io import MaterialProperties, TextureImages, make_mesh_texture_atlas, read_materials
from rendra.io.pluggable_formats import MeshFormatInterpreter, endswith, single_mesh
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesBase, TexturesUV, TexturesVertex
from rendra.structures import Meshes, join_meshes_as_batch


class Faces(NamedTuple):
    """Indices of the triangles, counted from 0; -1 where the file gives none.

    Attributes:
        verts_idx: (F, 3) into the vertices.
        normals_idx: (F, 3) into `Properties.normals`.
        textures_idx: (F, 3) into `Properties.verts_uvs`.
        materials_idx: (F,) into the materials, in the order in which the file first uses them.
    """

    verts_idx: Tensor
    normals_idx: Tensor
    textures_idx: Tensor
    materials_idx: Tensor


class Properties(NamedTuple):
    """What an OBJ file says beyond its shape; None where it says nothing, or was not asked.

    Attributes:
        normals: (M, 3), as written.
        verts_uvs: (U, 2).
        material_colors: for each material a dict with what it has of ambient_color, diffuse_color,
            specular_color (3,) and shininess (1,).
        texture_images: for each used material that has one, (H, W, 3) RGB in [0, 1].
        texture_atlas: (F, R, R, 3).
    """

    normals: Tensor | None
    verts_uvs: Tensor | None
    material_colors: MaterialProperties | None
    texture_images: TextureImages | None
    texture_atlas: Tensor | None


def load_obj(
    f: FileLike,
    load_textures: bool = True,
    create_texture_atlas: bool = False,
    texture_atlas_size: int = 4,
    texture_wrap: str | None = "repeat",
    device: Device = "cpu",
    path_manager: PathManager | None = None,
    *,
    allow_outside: bool = False,
) -> tuple[Tensor, Faces, Properties]:
    """Read a mesh, and its materials and textures, from an OBJ file.

    Polygons become fans of triangles. Negative indices count from the end of what stands above them. A missing
    material library or texture is a warning.

    Args:
        f: path, or open handle in text or binary mode; companions of a nameless handle are looked for in the
            working directory.
        load_textures: read the material library and its images.
        create_texture_atlas: paint a texel square for every face.
        texture_atlas_size: R, texels on a side of that square.
        texture_wrap: "repeat", "clamp" or None, see `make_mesh_texture_atlas`.
        device: where the tensors go.
        path_manager: interprets paths where given.
        allow_outside: let material and texture paths leave the file's folder.

    Returns:
        (V, 3) float32 vertices, `Faces`, `Properties`.

    Raises:
        MeshFormatError: the file, its materials or its images are malformed, or name a file that is refused.
        OSError: the path cannot be opened.
    """
    options = _ReadOptions(
        load_textures, create_texture_atlas, texture_atlas_size, texture_wrap, device, path_manager, allow_outside
    )
    return _read(f, options)[:3]


@dataclass(frozen=True)
class _ReadOptions:
    """Arguments of `load_obj` behind the file."""

    load_textures: bool
    create_texture_atlas: bool
    texture_atlas_size: int
    texture_wrap: str | None
    device: Device
    path_manager: PathManager | None
    allow_outside: bool


def _read(f: FileLike, options: _ReadOptions) -> tuple[Tensor, Faces, Properties, Tensor | None]:
    """What `load_obj` returns, and (V, 3) vertex colours where the file has them."""
    source = read_source(f, options.path_manager)
    data = parse_obj(source)
    material_colors, images = _read_materials(source, data, options)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(options.device)

    faces = Faces(*map(tensor, (data.faces, data.faces_normals, data.faces_uvs, data.faces_materials)))
    verts, normals, uvs = tensor(data.verts), tensor(data.normals), tensor(data.uvs)
    atlas = None
    if options.create_texture_atlas and options.load_textures:
        atlas = _paint_atlas(data, faces, uvs, material_colors or {}, images or {}, options)
    properties = Properties(
        normals=normals if len(normals) else None,
        verts_uvs=uvs if len(uvs) else None,
        material_colors=material_colors,
        texture_images=images,
        texture_atlas=atlas,
    )
    return verts, faces, properties, None if data.colors is None else tensor(data.colors)


def _read_materials(
    source: Source, data: ObjData, options: _ReadOptions
) -> tuple[MaterialProperties | None, TextureImages | None]:
    """Properties and images of the materials; None where they are not wanted, not used or not there."""
    if not options.load_textures or not data.material_names:
        return None, None
    if not data.libraries:
        warnings.warn(f"No mtl file provided: {source.name} uses materials, but has no mtllib", stacklevel=4)
        return None, None
    libraries = [
        library for line, written in data.libraries for library in _find_libraries(source, line, written, options)
    ]
    if not libraries:
        return None, None
    return read_materials(
        libraries, data.material_names, source.folder, options.device, options.path_manager, options.allow_outside
    )


def _find_libraries(source: Source, line: int, written: str, options: _ReadOptions) -> list[Source]:
    """The files that one mtllib statement names: one whose name may hold spaces, else several."""
    locate = partial(
        neighbour,
        source.folder,
        file=source.name,
        line=line,
        path_manager=options.path_manager,
        allow_outside=options.allow_outside,
    )
    words = written.split()
    if len(words) > MOST_LIBRARIES:
        raise MeshFormatError(
            "too many material libraries", source.name, line, written, f"at most {MOST_LIBRARIES:,}"
        )
    for names in ([written], words):
        paths = [locate(name) for name in names]
        contents = [(path, read_neighbour(path, options.path_manager)) for path in paths]
        found = [Source(path, content, source.folder) for path, content in contents if content is not None]
        if found:
            return found
    warnings.warn(f"Mtl file does not exist: {os.path.join(source.folder, written)}", stacklevel=6)
    return []


def _paint_atlas(
    data: ObjData,
    faces: Faces,
    uvs: Tensor,
    colors: MaterialProperties,
    images: TextureImages,
    options: _ReadOptions,
) -> Tensor:
    """(F, R, R, 3); a face without texture coordinates takes its material's diffuse colour instead of its image."""
    names = np.array([*data.material_names, ""], dtype=object)[data.faces_materials].tolist()
    corners = uvs[faces.textures_idx.clamp(min=0)] if len(uvs) else uvs.new_zeros(len(names), 3, 2)
    atlas = make_mesh_texture_atlas(colors, images, names, corners, options.texture_atlas_size, options.texture_wrap)
    bare = (faces.textures_idx < 0).any(dim=1)
    for number, name in enumerate(data.material_names):
        if name in images:
            diffuse = colors[name].get("diffuse_color", torch.ones(3))
            atlas[bare & (faces.materials_idx == number)] = diffuse.to(atlas)
    return atlas


def load_objs_as_meshes(
    files: Sequence[FileLike],
    device: Device | None = None,
    load_textures: bool = True,
    create_texture_atlas: bool = False,
    texture_atlas_size: int = 4,
    texture_wrap: str | None = "repeat",
    path_manager: PathManager | None = None,
    *,
    allow_outside: bool = False,
) -> Meshes:
    """Read OBJ files into one batch of meshes.

    Textures are `TexturesAtlas` where one is asked for; else `TexturesUV` with the first texture image, where
    there are an image and texture coordinates; else, if all files have vertex colours, `TexturesVertex`.

    Args:
        files: paths or open handles.
        device: where the tensors go; the CPU if None.
        load_textures, create_texture_atlas, texture_atlas_size, texture_wrap, path_manager, allow_outside: see
            `load_obj`.

    Raises:
        MeshFormatError, OSError: as `load_obj`.
        ValueError: no file, or some files have textures of a kind that others lack.
    """
    if isinstance(files, str | os.PathLike):
        raise TypeError(f"files is one path; expected a list of paths, such as [{os.fspath(files)!r}]")
    if not files:
        raise ValueError("files is empty; expected at least one path")
    options = _ReadOptions(
        load_textures,
        create_texture_atlas,
        texture_atlas_size,
        texture_wrap,
        "cpu" if device is None else device,
        path_manager,
        allow_outside,
    )
    return _read_meshes(files, options)


def _read_meshes(files: Sequence[FileLike], options: _ReadOptions) -> Meshes:
    meshes, colors = [], []
    for f in files:
        verts, faces, properties, verts_colors = _read(f, options)
        textures = _textures(faces, properties) if options.load_textures else None
        meshes.append(Meshes(verts=[verts], faces=[faces.verts_idx], textures=textures))
        colors.append(verts_colors if textures is None and options.load_textures else None)
    present = [each for each in colors if each is not None]
    if len(present) == len(meshes):
        for mesh, verts_colors in zip(meshes, present, strict=True):
            mesh.textures = TexturesVertex(verts_features=[verts_colors])
    return meshes[0] if len(meshes) == 1 else join_meshes_as_batch(meshes)


def _textures(faces: Faces, properties: Properties) -> TexturesBase | None:
    """An atlas where there is one, else the first image where faces have texture coordinates, else nothing."""
    if properties.texture_atlas is not None:
        return TexturesAtlas(atlas=[properties.texture_atlas])
    images, uvs = properties.texture_images, properties.verts_uvs
    if not images or uvs is None:
        return None
    name, image = next(iter(images.items()))
    if len(images) > 1:
        warnings.warn(
            f"The mesh has {len(images)} texture images, and only that of {name!r} is used; "
            "create_texture_atlas=True takes them all",
            stacklevel=5,
        )
    if bool((faces.textures_idx < 0).any()):
        warnings.warn("Some faces have no texture coordinates; they take the colour at the first one", stacklevel=5)
    return TexturesUV(maps=image[None], faces_uvs=[faces.textures_idx.clamp(min=0)], verts_uvs=[uvs])


def save_obj(
    f: FileLike,
    verts: Tensor,
    faces: Tensor,
    decimal_places: int | None = None,
    path_manager: PathManager | None = None,
    *,
    normals: Tensor | None = None,
    faces_normals_idx: Tensor | None = None,
    verts_uvs: Tensor | None = None,
    faces_uvs: Tensor | None = None,
    texture_map: Tensor | None = None,
    verts_colors: Tensor | None = None,
    image_format: str = "png",
    image_quality: int | None = None,
) -> None:
    """Write a mesh to an OBJ file, with a .mtl file and an image of the same name beside it if it has a texture.

    Each file is written in full before it takes the place of an older one; the OBJ comes last.

    Args:
        f: path, or an open handle if there is no texture.
        verts: (V, 3), or empty.
        faces: (F, 3) indices into `verts`, or empty.
        decimal_places: digits behind the point; 6 if None.
        path_manager: interprets paths where given; then files are not replaced atomically.
        normals: (M, 3).
        faces_normals_idx: (F, 3) indices into `normals`; `faces` if None and there is one normal a vertex.
        verts_uvs: (U, 2), origin bottom left; given together with `faces_uvs`.
        faces_uvs: (F, 3) indices into `verts_uvs`.
        texture_map: (H, W, 3) RGB in [0, 1], clamped; needs the two above.
        verts_colors: (V, 3) RGB behind each position, an extension that most programs read.
        image_format: "png" or "jpeg".
        image_quality: JPEG's, from 1 to 95; None for Pillow's choice.

    Raises:
        ValueError: a shape does not fit, an index points nowhere, a coordinate is not finite.
        OSError: a file cannot be written; what stood there before is untouched.
    """
    check_decimals(decimal_places)
    text = _Text(verts, faces, decimal_places)
    if verts_colors is not None:
        text.add_colors(verts_colors)
    if (verts_uvs is None) != (faces_uvs is None):
        raise ValueError("verts_uvs and faces_uvs go together; only one of them was given")
    if verts_uvs is not None and faces_uvs is not None:
        text.add_uvs(verts_uvs, faces_uvs)
    if normals is not None:
        text.add_normals(normals, faces_normals_idx)
    elif faces_normals_idx is not None:
        raise ValueError("faces_normals_idx was given without normals")
    head = b""
    if texture_map is not None:
        if verts_uvs is None:
            raise ValueError("texture_map was given without verts_uvs and faces_uvs")
        head = _save_material(f, texture_map, image_format, image_quality, path_manager)
    write_sink(f, head + text.render(), path_manager)


def _save_material(
    f: FileLike, texture_map: Tensor, image_format: str, quality: int | None, path_manager: PathManager | None
) -> bytes:
    """Write image and material library; return the lines with which the OBJ file refers to them."""
    if texture_map.dim() != 3 or texture_map.shape[2] != 3:
        raise ValueError(f"'texture_map' should be of shape (H, W, 3); got {tuple(texture_map.shape)}")
    if not is_path(f):
        raise ValueError("a texture needs files beside the OBJ file: f must be a path, not an open handle")
    base, _ = os.path.splitext(path_text(f))  # type: ignore[arg-type]
    name = os.path.basename(base)
    suffix = image_suffix(image_format)
    write_sink(f"{base}.{suffix}", encode_image(texture_map, image_format, quality), path_manager)
    library = f"newmtl mesh\nmap_Kd {name}.{suffix}\n"
    write_sink(f"{base}.mtl", library.encode(), path_manager)
    return f"mtllib {name}.mtl\nusemtl mesh\n\n".encode()


class _Text:
    """The text of an OBJ file, gathered section by section.

    Args:
        verts: (V, 3).
        faces: (F, 3).
        decimal_places: digits behind the point; 6 if None.
    """

    def __init__(self, verts: Tensor, faces: Tensor, decimal_places: int | None) -> None:
        self._number = number_format(decimal_places)
        self._verts = float_rows(verts, 3, "verts", "num_verts")
        self._faces = int_rows(faces, len(self._verts), "faces", "num_faces")
        self._uvs: tuple[np.ndarray, np.ndarray] | None = None
        self._normals: tuple[np.ndarray, np.ndarray] | None = None

    def add_colors(self, colors: Tensor) -> None:
        """Take (V, 3) colours."""
        rows = float_rows(colors, 3, "verts_colors", "num_verts")
        self._verts = np.concatenate([self._verts, _as_many(rows, len(self._verts), "verts_colors", "verts")], axis=1)

    def add_uvs(self, uvs: Tensor, faces_uvs: Tensor) -> None:
        """Take (U, 2) texture coordinates and (F, 3) their indices."""
        rows = float_rows(uvs, 2, "verts_uvs", "num_verts")
        index = int_rows(faces_uvs, len(rows), "faces_uvs", "num_faces")
        self._uvs = rows, _as_many(index, len(self._faces), "faces_uvs", "faces")

    def add_normals(self, normals: Tensor, faces_normals: Tensor | None) -> None:
        """Take (M, 3) normals and (F, 3) their indices, which may be those of the vertices."""
        rows = float_rows(normals, 3, "normals", "num_normals")
        if faces_normals is None:
            _as_many(rows, len(self._verts), "normals (without faces_normals_idx)", "verts")
            self._normals = rows, self._faces
            return
        index = int_rows(faces_normals, len(rows), "faces_normals_idx", "num_faces")
        self._normals = rows, _as_many(index, len(self._faces), "faces_normals_idx", "faces")

    def render(self) -> bytes:
        """All sections as text."""
        sections = [self._floats("v", self._verts)]
        corners, corner = [self._faces], "%d"
        if self._uvs is not None:
            sections.append(self._floats("vt", self._uvs[0]))
            corners.append(self._uvs[1])
            corner += "/%d"
        if self._normals is not None:
            sections.append(self._floats("vn", self._normals[0]))
            corners.append(self._normals[1])
            corner += "/%d" if self._uvs is not None else "//%d"
        indices = np.stack(corners, axis=-1).reshape(len(self._faces), 3 * len(corners)) + 1
        sections.append(format_rows(f"f {corner} {corner} {corner}\n", indices))
        return b"".join(sections)

    def _floats(self, keyword: str, rows: np.ndarray) -> bytes:
        return format_rows(f"{keyword} {' '.join([self._number] * rows.shape[1])}\n", rows)


def _as_many(rows: np.ndarray, count: int, name: str, other: str) -> np.ndarray:
    if len(rows) != count:
        raise ValueError(f"{name} has {len(rows)} rows, but {other} has {count}")
    return rows


class MeshObjFormat(MeshFormatInterpreter):
    """OBJ files for `IO`."""

    def __init__(self) -> None:
        self.known_suffixes = (".obj",)

    def read(
        self,
        path: FileLike,
        include_textures: bool,
        device: Device,
        path_manager: PathManager | None,
        create_texture_atlas: bool = False,
        texture_atlas_size: int = 4,
        texture_wrap: str | None = "repeat",
        allow_outside: bool = False,
        **kwargs: Any,
    ) -> Meshes | None:
        """Read an OBJ file as `load_objs_as_meshes` does; None for any other suffix."""
        if not endswith(path, self.known_suffixes):
            return None
        return load_objs_as_meshes(
            [path],
            device,
            include_textures,
            create_texture_atlas,
            texture_atlas_size,
            texture_wrap,
            path_manager,
            allow_outside=allow_outside,
        )

    def save(
        self,
        data: Meshes,
        path: FileLike,
        path_manager: PathManager | None,
        binary: bool | None,
        decimal_places: int | None = None,
        include_textures: bool = True,
        **kwargs: Any,
    ) -> bool:
        """Write one mesh, its normals if it `has_verts_normals`, its UV texture or vertex colours.

        Raises:
            ValueError: `binary` is True, or the batch has not exactly one mesh.
        """
        if not endswith(path, self.known_suffixes):
            return False
        if binary:
            raise ValueError("OBJ is a text format: binary must be False or None")
        verts, faces = single_mesh(data).get_mesh_verts_faces(0)
        normals = data.verts_normals_list()[0] if data.has_verts_normals() else None
        extras = _texture_arguments(data.textures) if include_textures else {}
        save_obj(path, verts, faces, decimal_places, path_manager, normals=normals, **extras)
        return True


def _texture_arguments(textures: TexturesBase | None) -> dict[str, Any]:
    """What `save_obj` takes of a texture."""
    if isinstance(textures, TexturesUV):
        return {
            "texture_map": textures.maps_padded()[0],
            "verts_uvs": textures.verts_uvs_list()[0],
            "faces_uvs": textures.faces_uvs_list()[0],
        }
    if isinstance(textures, TexturesVertex) and textures.verts_features_list()[0].shape[-1] == 3:
        return {"verts_colors": textures.verts_features_list()[0]}
    if textures is not None:
        warnings.warn(f"OBJ files cannot hold this {type(textures).__name__}; it is not saved", stacklevel=5)
    return {}
