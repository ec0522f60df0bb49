"""What a caller may hand to `Meshes`, checked once and brought into one form."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rendra.structures.ragged import Lengths, Ragged


def rows_from_lists(verts: Sequence[Tensor], faces: Sequence[Tensor]) -> tuple[Ragged, Ragged]:
    """
    Vertices and faces from N tensors (V_i, 3) and (F_i, 3); faces with a -1 are dropped.

    Raises:
        ValueError: lengths, shapes or devices do not fit together, or a face names no vertex.
    """
    if len(verts) != len(faces):
        raise ValueError(f"verts and faces must have one entry for each mesh, got {len(verts)} and {len(faces)}")
    vert_items = [_rows_of_three(v, f"verts[{i}]") for i, v in enumerate(verts)]
    face_items = [_rows_of_three(f, f"faces[{i}]").to(torch.int64) for i, f in enumerate(faces)]
    devices = {str(t.device) for t in [*vert_items, *face_items]}
    if len(devices) > 1:
        raise ValueError(f"All Verts and Faces tensors should be on same device, got {sorted(devices)}")
    face_items = [_checked_faces(f, len(v), i) for i, (v, f) in enumerate(zip(vert_items, face_items, strict=True))]
    like_verts = vert_items[0] if vert_items else torch.zeros(0, 3)
    like_faces = face_items[0] if face_items else torch.zeros(0, 3, dtype=torch.int64)
    return Ragged.from_list(vert_items, like_verts), Ragged.from_list(face_items, like_faces, pad_value=-1)


def _rows_of_three(rows: Tensor, name: str) -> Tensor:
    if not isinstance(rows, Tensor):
        raise ValueError(f"{name} must be a tensor of shape (n, 3), got {type(rows)}")
    if rows.numel() == 0:
        return rows.reshape(0, 3)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"{name} must have shape (n, 3), got {tuple(rows.shape)}")
    return rows


def _checked_faces(faces: Tensor, num_verts: int, mesh: int) -> Tensor:
    """The faces without rows of padding, all of whose vertices exist."""
    if faces.numel() == 0:
        return faces
    low, high = torch.stack(torch.aminmax(faces)).tolist()
    if low < -1 or high >= num_verts:
        raise ValueError(
            f"faces[{mesh}] refers to vertex {high if high >= num_verts else low}, but verts[{mesh}] has "
            f"{num_verts} vertices, numbered from 0 (-1 marks padding)"
        )
    return faces if low >= 0 else faces[(faces >= 0).all(1)]


def rows_from_padded(verts: Tensor, faces: Tensor) -> tuple[Ragged, Ragged]:
    """
    Vertices and faces from (N, V, 3) and (N, F, 3), the latter filled up with -1.

    Raises:
        ValueError: shapes or devices do not fit together, padding lies between faces, or a face names no
            vertex.
    """
    if verts.ndim != 3 or verts.shape[2] != 3 or faces.ndim != 3 or faces.shape[2] != 3:
        raise ValueError(
            "Verts and Faces tensors should have shape (N, V, 3) and (N, F, 3), "
            f"got {tuple(verts.shape)} and {tuple(faces.shape)}"
        )
    if len(verts) != len(faces):
        raise ValueError(f"verts and faces must have the same batch size, got {len(verts)} and {len(faces)}")
    if verts.device != faces.device:
        raise ValueError(
            f"All Verts and Faces tensors should be on same device, got {verts.device} and {faces.device}"
        )
    faces = faces.to(torch.int64)
    real = (faces > -1).all(2)
    if (real[:, 1:] & ~real[:, :-1]).any():
        raise ValueError("Padding of faces must be at the end")
    for i, own in enumerate(faces if faces.numel() and int(faces.max()) >= verts.shape[1] else []):
        _checked_faces(own, verts.shape[1], i)
    vert_lengths = Lengths([verts.shape[1]] * len(verts), verts.device)
    face_lengths = Lengths(real.sum(1).tolist(), faces.device, padded_size=faces.shape[1])
    return Ragged(vert_lengths, padded=verts), Ragged(face_lengths, padded=faces, pad_value=-1)


def normals_for(verts: Ragged, normals: Sequence[Tensor] | Tensor) -> Ragged:
    """
    Vertex normals given as a list or padded like the vertices.

    Raises:
        ValueError: not one row for each vertex.
    """
    lengths = verts.lengths
    if isinstance(normals, Tensor):
        if normals.shape != (len(lengths), lengths.padded_size, 3):
            raise ValueError(
                "verts_normals must have the shape of the padded vertices, "
                f"{(len(lengths), lengths.padded_size, 3)}; got {tuple(normals.shape)}"
            )
        return Ragged(lengths, padded=normals)
    if not isinstance(normals, (list, tuple)):
        raise ValueError(f"verts_normals must be a list or a tensor, got {type(normals)}")
    items = [_rows_of_three(n, f"verts_normals[{i}]") for i, n in enumerate(normals)]
    if [len(n) for n in items] != lengths.sizes:
        raise ValueError(
            f"verts_normals must have one row for each vertex, {lengths.sizes}; got {[len(n) for n in items]}"
        )
    return Ragged.from_list(items, verts.packed())
