"""Batched 4x4 transforms of points and normals.

Row vectors: a point acts as [x, 1] M, so the translation is the last ROW of M, and `a.compose(b)` applies
first a, then b. N is the batch of transforms; a batch of 1 broadcasts. Where dtypes differ, the result of
composing has the wider one and transformed points keep their own.
"""

from __future__ import annotations

import copy as copying
import math
import os
import warnings
from typing import Any, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.common.datatypes import Device, get_device, make_device
from rendra.transforms.se3 import affine_matrix, se3_log_map

_Index: TypeAlias = int | list[int] | slice | Tensor
_SINGLE_THREADED_POINTS = 32768 // 4  # torch's grain size, over the four coordinates of a point


class Transform3d:
    """A batch of projective maps of space, identity by default.

    Args:
        dtype: of the identity; a given matrix brings its own.
        device: likewise.
        matrix: (N, 4, 4) or (4, 4), acting on row vectors.

    Raises:
        ValueError: if the matrix has another shape.
    """

    def __init__(
        self, dtype: torch.dtype = torch.float32, device: Device = "cpu", matrix: Tensor | None = None
    ) -> None:
        if matrix is None:
            matrix = torch.eye(4, dtype=dtype, device=device)
        elif matrix.dim() not in (2, 3):
            raise ValueError(f'"matrix" has to be a 2- or a 3-dimensional tensor; got shape {tuple(matrix.shape)}')
        elif matrix.shape[-2:] != (4, 4):
            raise ValueError(
                f'"matrix" has to be a tensor of shape (minibatch, 4, 4) or (4, 4); got {tuple(matrix.shape)}'
            )
        self._matrix = matrix if matrix.dim() == 3 else matrix[None]
        self._factors: tuple[Transform3d, ...] = ()  # what was composed: each may know a cheap inverse
        self.device = matrix.device
        self.dtype = matrix.dtype

    def __len__(self) -> int:
        """N."""
        return self._matrix.shape[0]

    def __getitem__(self, index: _Index) -> Transform3d:
        """The chosen transforms, as a batch even if it is one."""
        return Transform3d(matrix=self._matrix[[index] if isinstance(index, int) else index])

    def compose(self, *others: Transform3d) -> Transform3d:
        """What this transform and then each of `others` in turn do, as a new transform.

        Raises:
            ValueError: if something else than a transform is given, or batches are neither equal nor 1.
        """
        matrix = self._matrix
        for other in others:
            if not isinstance(other, Transform3d):
                raise ValueError(f"Only possible to compose Transform3d objects; got {type(other)}")
            matrix = _multiply(matrix, other._matrix)
        out = Transform3d(matrix=matrix)
        out._factors = tuple(factor for part in (self, *others) for factor in part._factors or (part,))
        return out

    def get_matrix(self) -> Tensor:
        """The matrices (N, 4, 4), acting on row vectors."""
        return self._matrix

    def get_se3_log(self, eps: float = 1e-4, cos_bound: float = 1e-4) -> Tensor:
        """Logarithms (N, 6) of these transforms, which must be rigid motions; see `se3_log_map`."""
        return se3_log_map(self._matrix, eps, cos_bound)

    def inverse(self, invert_composed: bool = False) -> Transform3d:
        """The inverse transform.

        Args:
            invert_composed: invert the product as a general matrix; by default each factor is inverted by
                itself, by its closed form where it has one (translation, scaling, rotation).

        Raises:
            RuntimeError: if a general matrix is singular.
        """
        if invert_composed:
            return Transform3d(matrix=torch.linalg.inv(self._matrix))
        return Transform3d(matrix=self._get_matrix_inverse())

    def _get_matrix_inverse(self) -> Tensor:
        """The inverse matrices (N, 4, 4)."""
        if not self._factors:
            return torch.linalg.inv(self._matrix)
        last, *others = reversed(self._factors)
        matrix = last._get_matrix_inverse()
        for factor in others:
            matrix = _multiply(matrix, factor._get_matrix_inverse())
        return matrix

    def stack(self, *others: Transform3d) -> Transform3d:
        """One batch of this transform's and the others' matrices, in order."""
        return Transform3d(matrix=torch.cat([t.get_matrix() for t in (self, *others)], dim=0))

    def transform_points(self, points: Tensor, eps: float | None = None) -> Tensor:
        """Points after the transform and the division by the homogeneous coordinate w.

        Args:
            points: (P, 3) or (N or 1, P, 3).
            eps: if given, abs(w) is clamped to at least this before dividing, its sign kept (0 counts as +).

        Returns:
            (N, P, 3); or (P, 3), if the points had that shape and N is 1.

        Raises:
            ValueError: if the points have another number of dimensions, or batches do not match.
        """
        batch = _as_batch(points, "points")
        matrix = self._matrix.to(points.dtype)
        _check_batches(batch, matrix)
        homogeneous = _times(batch, matrix)
        w = homogeneous[..., 3:]
        if eps is not None:
            w = torch.where(w < 0, w.clamp(max=-eps), w.clamp(min=eps))
        out = homogeneous[..., :3] / w
        return out[0] if points.dim() == 2 and out.shape[0] == 1 else out

    def transform_normals(self, normals: Tensor) -> Tensor:
        """Normals times the inverse transpose of the linear part; not normalised again.

        Args:
            normals: (P, 3) or (N or 1, P, 3).

        Returns:
            (N, P, 3); or (P, 3), if the normals had that shape and N is 1.

        Raises:
            ValueError: if the normals have another number of dimensions, or batches do not match.
            RuntimeError: if the linear part is singular.
        """
        batch = _as_batch(normals, "normals")
        linear = self._matrix[:, :3, :3].to(normals.dtype)
        _check_batches(batch, linear)
        out = batch @ torch.linalg.inv(linear).transpose(1, 2)
        return out[0] if normals.dim() == 2 and out.shape[0] == 1 else out

    def translate(self, x: Any, y: Any = None, z: Any = None) -> Transform3d:
        """What this transform and then `Translate` with these arguments do."""
        return self.compose(Translate(x, y, z, device=self.device, dtype=self.dtype))

    def scale(self, x: Any, y: Any = None, z: Any = None) -> Transform3d:
        """What this transform and then `Scale` with these arguments do."""
        return self.compose(Scale(x, y, z, device=self.device, dtype=self.dtype))

    def rotate(self, R: Tensor, orthogonal_tol: float = 1e-5) -> Transform3d:
        """What this transform and then `Rotate` with these arguments do."""
        return self.compose(Rotate(R, orthogonal_tol=orthogonal_tol, device=self.device, dtype=self.dtype))

    def rotate_axis_angle(self, angle: Any, axis: str = "X", degrees: bool = True) -> Transform3d:
        """What this transform and then `RotateAxisAngle` with these arguments do."""
        return self.compose(RotateAxisAngle(angle, axis, degrees, device=self.device, dtype=self.dtype))

    def clone(self) -> Transform3d:
        """A copy with tensors of its own; gradients flow through it."""
        return self._map(Tensor.clone)

    def to(self, device: Device, copy: bool = False, dtype: torch.dtype | None = None) -> Transform3d:
        """The transform on another device or in another dtype: itself if nothing changes and not `copy`."""
        target, kind = make_device(device), dtype or self.dtype
        if not copy and target == self.device and kind == self.dtype:
            return self
        return self._map(lambda matrix: matrix.to(device=target, dtype=kind, copy=copy))

    def cpu(self) -> Transform3d:
        """The transform on the CPU."""
        return self.to("cpu")

    def cuda(self) -> Transform3d:
        """The transform on the current CUDA device."""
        return self.to("cuda")

    def _map(self, change: Any) -> Transform3d:
        """A shallow copy of the same class with `change` applied to every matrix."""
        out = copying.copy(self)
        out._matrix = change(self._matrix)
        out._factors = tuple(factor._map(change) for factor in self._factors)
        out.device, out.dtype = out._matrix.device, out._matrix.dtype
        return out


class Translate(Transform3d):
    """Translation by (x, y, z).

    Args:
        x: (N, 3) with y and z left out, or a number or (N,) or (1,) tensor like y and z.
        y: see x.
        z: see x.
        dtype: of the matrix; by default that of the tensors given, else float32.
        device: by default where the tensors given lie, else the CPU.

    Raises:
        ValueError: if the shapes do not fit this.
    """

    def __init__(
        self,
        x: Any,
        y: Any = None,
        z: Any = None,
        dtype: torch.dtype | None = None,
        device: Device | None = None,
    ) -> None:
        xyz = _parse_xyz(x, y, z, dtype, device, "Translate")
        linear = torch.eye(3, dtype=xyz.dtype, device=xyz.device).expand(len(xyz), 3, 3)
        super().__init__(matrix=affine_matrix(linear, xyz))

    def _get_matrix_inverse(self) -> Tensor:
        return affine_matrix(self._matrix[:, :3, :3], -self._matrix[:, 3, :3])


class Scale(Transform3d):
    """Scaling of the axes by (x, y, z), or of all three by x if y and z are left out.

    Args:
        x: (N, 3) with y and z left out, or a number or (N,) or (1,) tensor.
        y: a number or (N,) or (1,) tensor, or None.
        z: likewise.
        dtype: of the matrix; by default that of the tensors given, else float32.
        device: by default where the tensors given lie, else the CPU.

    Raises:
        ValueError: if the shapes do not fit this.
    """

    def __init__(
        self,
        x: Any,
        y: Any = None,
        z: Any = None,
        dtype: torch.dtype | None = None,
        device: Device | None = None,
    ) -> None:
        single = y is None and z is None and not (isinstance(x, Tensor) and x.dim() == 2)
        xyz = _parse_xyz(x, x if single else y, x if single else z, dtype, device, "Scale")
        super().__init__(matrix=torch.diag_embed(F.pad(xyz, (0, 1), value=1.0)))

    def _get_matrix_inverse(self) -> Tensor:
        return torch.diag_embed(self._matrix.diagonal(dim1=1, dim2=2).reciprocal())


class Rotate(Transform3d):
    """Rotation of row vectors, x R.

    Args:
        R: (3, 3) or (N, 3, 3), orthogonal: its transpose serves as its inverse.
        dtype: of the matrix, R's by default.
        device: R's by default.
        orthogonal_tol: how far R Rᵀ may be from the identity before a warning. The check waits for the GPU,
            so it runs only where the environment sets RENDRA_CHECK_ROTATION_MATRICES=1.

    Raises:
        ValueError: if R has another shape.
    """

    def __init__(
        self,
        R: Tensor,
        dtype: torch.dtype | None = None,
        device: Device | None = None,
        orthogonal_tol: float = 1e-5,
    ) -> None:
        if R.shape[-2:] != (3, 3) or R.dim() not in (2, 3):
            raise ValueError(f"R must have shape (3, 3) or (N, 3, 3); got {tuple(R.shape)}")
        R = R.reshape(-1, 3, 3).to(device=get_device(R, device), dtype=dtype or R.dtype)
        if os.environ.get("RENDRA_CHECK_ROTATION_MATRICES", "0") == "1":
            _warn_unless_rotation(R, orthogonal_tol)
        super().__init__(matrix=affine_matrix(R, R.new_zeros(1, 3).expand(len(R), 3)))

    def _get_matrix_inverse(self) -> Tensor:
        return self._matrix.transpose(1, 2)


class RotateAxisAngle(Rotate):
    """Rotation about a coordinate axis; for positive angles counter-clockwise as seen from its tip.

    Args:
        angle: a number, (N,) tensor, or array.
        axis: "X", "Y" or "Z", in either case.
        degrees: the angle's unit; False means radians.
        dtype: of the matrix; by default that of a floating-point tensor given, else float32.
        device: by default where the angle lies, else the CPU.

    Raises:
        ValueError: for another axis, or an angle with more than one dimension.
    """

    def __init__(
        self,
        angle: Any,
        axis: str = "X",
        degrees: bool = True,
        dtype: torch.dtype | None = None,
        device: Device | None = None,
    ) -> None:
        axis = axis.upper()
        if axis not in ("X", "Y", "Z"):
            raise ValueError(f"Expected axis to be one of ['X', 'Y', 'Z']; got {axis!r}")
        if dtype is None:
            dtype = angle.dtype if isinstance(angle, Tensor) and angle.is_floating_point() else torch.float32
        angles = torch.as_tensor(angle, dtype=dtype, device=get_device(angle, device))
        if angles.dim() > 1:
            raise ValueError(f"Expected angle to be a number or of shape (N,); got {tuple(angles.shape)}")
        angles = angles.reshape(-1) * (math.pi / 180.0 if degrees else 1.0)
        super().__init__(_row_rotation("XYZ".index(axis), angles))


class Rigid(Transform3d):
    """Rotation, then translation: x R + T in one matrix, inverted in closed form. Not in PyTorch3D.

    Args:
        R: (N, 3, 3), orthogonal; not checked.
        T: (N, 3), on the same device; a batch of 1 broadcasts.
    """

    def __init__(self, R: Tensor, T: Tensor) -> None:
        super().__init__(matrix=affine_matrix(R, T))

    def _get_matrix_inverse(self) -> Tensor:
        back = self._matrix[:, :3, :3].transpose(1, 2)
        return affine_matrix(back, -(self._matrix[:, 3:, :3] @ back)[:, 0])


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    """The product (N, 4, 4) in the wider dtype, a batch of 1 broadcast."""
    if a.dtype != b.dtype:
        dtype = torch.promote_types(a.dtype, b.dtype)
        a, b = a.to(dtype), b.to(dtype)
    _check_batches(a, b)
    return a @ b


def _times(points: Tensor, matrix: Tensor) -> Tensor:
    """The rows [x, y, z, 1] M (N, P, 4) of points (N, P, 3) and matrices (N, 4, 4), a batch of 1 broadcast.

    Below torch's threshold for threads in elementwise operations, these beat a matrix product, which takes
    threads at any size and then waits milliseconds for them wherever another process holds the cores.
    """
    if points.shape[1] * max(len(points), len(matrix)) > _SINGLE_THREADED_POINTS:
        return matrix[:, 3:] + points @ matrix[:, :3]
    x, y, z = points.split(1, dim=-1)
    out = torch.addcmul(matrix[:, 3:], z, matrix[:, 2:3])
    return torch.addcmul(torch.addcmul(out, y, matrix[:, 1:2]), x, matrix[:, :1])


def _check_batches(a: Tensor, b: Tensor) -> None:
    """Raises ValueError unless the batch sizes are equal or one of them is 1."""
    if a.shape[0] != b.shape[0] and 1 not in (a.shape[0], b.shape[0]):
        raise ValueError(f"Expected batch dim for bmm to be equal or 1; got {tuple(a.shape)}, {tuple(b.shape)}")


def _as_batch(vectors: Tensor, name: str) -> Tensor:
    """(P, 3) or (N, P, 3) as (N, P, 3)."""
    if vectors.dim() not in (2, 3) or vectors.shape[-1] != 3:
        raise ValueError(
            f"Expected {name} to have dim = 2 or dim = 3 and 3 coordinates: got shape {tuple(vectors.shape)}"
        )
    return vectors if vectors.dim() == 3 else vectors[None]


def _parse_xyz(x: Any, y: Any, z: Any, dtype: torch.dtype | None, device: Device | None, name: str) -> Tensor:
    """The three coordinates of `Translate` or `Scale` as (N, 3)."""
    tensors = [c for c in (x, y, z) if isinstance(c, Tensor)]
    target = get_device(tensors[0] if tensors else None, device)
    kind = dtype or (tensors[0].dtype if tensors else torch.float32)
    if y is None and z is None and isinstance(x, Tensor) and x.dim() == 2:
        if x.shape[1] != 3:
            raise ValueError(f"Expected tensor of shape (N, 3); got {tuple(x.shape)} (in {name})")
        return x.to(device=target, dtype=kind)
    if y is None or z is None:
        got = [type(c).__name__ for c in (x, y, z)]
        raise ValueError(f"Expected x, y and z, or one tensor of shape (N, 3); got {got} (in {name})")
    columns = [torch.as_tensor(c, dtype=kind, device=target) for c in (x, y, z)]
    shapes = [tuple(c.shape) for c in columns]
    if any(len(shape) > 1 for shape in shapes) or len({c.numel() for c in columns} - {1}) > 1:
        raise ValueError(f"Expected x, y and z to be numbers or of shape (N,) or (1,); got {shapes} (in {name})")
    return torch.stack(torch.broadcast_tensors(*(c.reshape(-1) for c in columns)), dim=-1)


def _row_rotation(axis: int, angles: Tensor) -> Tensor:
    """Rotations (N, 3, 3) of row vectors about coordinate axis 0, 1 or 2 by angles (N,)."""
    c, s = angles.cos(), angles.sin()
    one, zero = torch.ones_like(angles), torch.zeros_like(angles)
    entries = (
        (one, zero, zero, zero, c, s, zero, -s, c),
        (c, zero, -s, zero, one, zero, s, zero, c),
        (c, s, zero, -s, c, zero, zero, zero, one),
    )
    return torch.stack(entries[axis], dim=-1).unflatten(-1, (3, 3))


def _warn_unless_rotation(R: Tensor, tolerance: float) -> None:
    """A warning if a matrix of (N, 3, 3) is not orthogonal with determinant 1 within `tolerance`."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    orthogonal = ((R @ R.transpose(1, 2) - eye).abs() <= tolerance).all()
    proper = ((torch.linalg.det(R) - 1.0).abs() <= tolerance).all()
    if not (orthogonal and proper):
        warnings.warn("R is not a valid rotation matrix", stacklevel=3)
