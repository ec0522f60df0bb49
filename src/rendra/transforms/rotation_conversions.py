"""Rotations as matrices, quaternions, axis-angle vectors, Euler angles and six numbers, and back.

Matrices act on COLUMN vectors, x' = R x, as in the literature; `Rotate` and the cameras act on row vectors
and take the transpose. Quaternions have their real part first. Angles are radians. Every function takes any
number of leading batch dimensions, none included. Gradients are finite at the identity and at a half turn.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.transforms.math import sine_ratio, versine_ratio

_AXES = ("X", "Y", "Z")


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), of any length but 0."""
    w, v = quaternions[..., :1], quaternions[..., 1:]
    scale = 2.0 / quaternions.square().sum(-1, keepdim=True)
    cosine = 1.0 - scale * v.square().sum(-1, keepdim=True)
    scaled = scale * v
    return _scalar_plus_hat(cosine, w * scaled) + scaled[..., :, None] * v[..., None, :]


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Unit quaternions (..., 4) with real part >= 0 of rotation matrices (..., 3, 3).

    A rotation matrix gives 4 q qᵀ linearly (Shepperd 1978); the row of its largest diagonal element, which is
    at least 1, is divided by twice that element's root, so nothing is ever divided by a small number.

    Raises:
        ValueError: if the last two dimensions are not (3, 3).
    """
    _check_matrix(matrix)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    x_w, y_w, z_w = m21 - m12, m02 - m20, m10 - m01
    x_y, x_z, y_z = m10 + m01, m02 + m20, m12 + m21
    diagonal = (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22)
    rows = (
        (diagonal[0], x_w, y_w, z_w),
        (x_w, diagonal[1], x_y, x_z),
        (y_w, x_y, diagonal[2], y_z),
        (z_w, x_z, y_z, diagonal[3]),
    )
    outer = torch.stack([entry for row in rows for entry in row], dim=-1).unflatten(-1, (4, 4))
    best = torch.stack(diagonal, dim=-1).argmax(-1)[..., None]
    row = outer.gather(-2, best[..., None].expand(*best.shape, 4)).squeeze(-2)
    return standardize_quaternion(row / (2.0 * row.gather(-1, best).sqrt()))


def standardize_quaternion(quaternions: Tensor) -> Tensor:
    """The one of q and -q (..., 4) whose real part is not negative: the same rotation."""
    return torch.where(quaternions[..., :1] < 0, -quaternions, quaternions)


def quaternion_raw_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product (..., 4) of quaternions (..., 4), broadcast; neither normalised nor standardised."""
    a, b = torch.broadcast_tensors(a, b)
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat((real, aw * bv + bw * av + torch.linalg.cross(av, bv)), dim=-1)


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """The rotation `b` followed by `a`, as a quaternion (..., 4) with real part >= 0."""
    return standardize_quaternion(quaternion_raw_multiply(a, b))


def quaternion_invert(quaternion: Tensor) -> Tensor:
    """The conjugate (..., 4): the inverse rotation of a unit quaternion (..., 4)."""
    return torch.cat((quaternion[..., :1], -quaternion[..., 1:]), dim=-1)


def quaternion_apply(quaternion: Tensor, point: Tensor) -> Tensor:
    """Points (..., 3) turned by quaternions (..., 4), broadcast: the vector part of q p q*.

    A quaternion of length s also scales by s².

    Raises:
        ValueError: if the points do not have three coordinates.
    """
    if point.shape[-1] != 3:
        raise ValueError(f"Points are not in 3D: expected shape (..., 3); got {tuple(point.shape)}")
    w, v = quaternion[..., :1], quaternion[..., 1:]
    v, p = torch.broadcast_tensors(v, point)
    scale = w.square() - v.square().sum(-1, keepdim=True)
    along = 2.0 * (v * p).sum(-1, keepdim=True)
    return scale * p + along * v + 2.0 * w * torch.linalg.cross(v, p)


def axis_angle_to_matrix(axis_angle: Tensor, fast: bool = False) -> Tensor:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3): axis times angle (Rodrigues' formula).

    `fast` is PyTorch3D's choice between two formulas; there is one here, exact and fast, and it is ignored.
    """
    squared = axis_angle.square().sum(-1, keepdim=True)
    versine = versine_ratio(squared)
    scaled = versine * axis_angle
    spin = _scalar_plus_hat(1.0 - versine * squared, sine_ratio(squared) * axis_angle)
    return spin + scaled[..., :, None] * axis_angle[..., None, :]


def matrix_to_axis_angle(matrix: Tensor, fast: bool = False) -> Tensor:
    """Rotation vectors (..., 3), of length in [0, pi], of rotation matrices (..., 3, 3).

    Taken through the quaternion, which is well conditioned at every angle; at a half turn the axis is right
    up to its sign, which is then arbitrary. `fast` is ignored, as in `axis_angle_to_matrix`.

    Raises:
        ValueError: if the last two dimensions are not (3, 3).
    """
    return quaternion_to_axis_angle(matrix_to_quaternion(matrix))


def axis_angle_to_quaternion(axis_angle: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of rotation vectors (..., 3); real part: cosine of half the angle."""
    quarter = 0.25 * axis_angle.square().sum(-1, keepdim=True)  # (theta/2)²
    imaginary = 0.5 * sine_ratio(quarter) * axis_angle
    # cos(h) = 1 - 2 sin²(h/2) = 1 - h² versine_ratio(h²): smooth in h², where sqrt is not
    return torch.cat((1.0 - quarter * versine_ratio(quarter), imaginary), dim=-1)


def quaternion_to_axis_angle(quaternions: Tensor) -> Tensor:
    """Rotation vectors (..., 3), of length in [0, 2 pi), of quaternions (..., 4) of any non-zero length.

    Within 0.2 degrees of a full turn (q near -1) the short way round is returned, where the axis still
    exists.
    """
    w, v = quaternions[..., :1], quaternions[..., 1:]
    squared = v.square().sum(-1, keepdim=True)
    near = squared < 1e-6 * w.square()
    sine = torch.where(near, 1.0, squared).sqrt()
    far = 2.0 * torch.atan2(sine, w) / sine
    cosine = torch.where(near, w, 1.0)
    slope = torch.where(near, squared, 0.0) / cosine.square()
    return v * torch.where(near, 2.0 / cosine * (1.0 + slope * (-1 / 3 + slope / 5)), far)


def euler_angles_to_matrix(euler_angles: Tensor, convention: str) -> Tensor:
    """Rotation matrices (..., 3, 3) of Euler angles (..., 3) in radians.

    Args:
        euler_angles: one angle for each letter of `convention`.
        convention: three of "X", "Y", "Z", no two neighbours alike; "XYZ" means R = Rx(a) Ry(b) Rz(c).

    Raises:
        ValueError: for a wrong shape or convention.
    """
    if euler_angles.dim() == 0 or euler_angles.shape[-1] != 3:
        raise ValueError(f"Invalid input euler angles: expected (..., 3); got {tuple(euler_angles.shape)}")
    axes = _parse_convention(convention)
    first, second, third = (
        _axis_rotation(axis, angle) for axis, angle in zip(axes, euler_angles.unbind(-1), strict=True)
    )
    return first @ second @ third


def matrix_to_euler_angles(matrix: Tensor, convention: str) -> Tensor:
    """Euler angles (..., 3) in radians of rotation matrices (..., 3, 3), by `euler_angles_to_matrix`'s rule.

    The middle angle lies in [-pi/2, pi/2] for three different letters, in [0, pi] for two, the others in
    [-pi, pi]. In gimbal lock the last angle is set to 0, so that the angles still rebuild the matrix.

    Raises:
        ValueError: for a wrong shape or convention.
    """
    i, j, last = _parse_convention(convention)
    _check_matrix(matrix)
    k = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0  # the letters run in cyclic order, or against it
    if last == i:
        a, b = matrix[..., i, j], sign * matrix[..., i, k]
        c, d = matrix[..., j, i], -sign * matrix[..., k, i]
    else:
        a, b = -sign * matrix[..., i, j], matrix[..., i, i]
        c, d = -sign * matrix[..., j, k], matrix[..., k, k]
    squared = a.square() + b.square()
    locked = squared < (16.0 * torch.finfo(matrix.dtype).eps) ** 2
    length = torch.where(locked, 0.0, torch.where(locked, 1.0, squared).sqrt())
    middle = torch.atan2(length, matrix[..., i, i]) if last == i else torch.atan2(sign * matrix[..., i, k], length)
    first = torch.atan2(torch.where(locked, sign * matrix[..., k, j], c), torch.where(locked, matrix[..., j, j], d))
    third = torch.atan2(torch.where(locked, 0.0, a), torch.where(locked, 1.0, b))
    return torch.stack((first, middle, third), dim=-1)


def random_quaternions(n: int, dtype: torch.dtype | None = None, device: Device | None = None) -> Tensor:
    """`n` unit quaternions (n, 4) with real part >= 0, uniform over all rotations."""
    return standardize_quaternion(F.normalize(torch.randn((n, 4), dtype=dtype, device=device), dim=-1))


def random_rotations(n: int, dtype: torch.dtype | None = None, device: Device | None = None) -> Tensor:
    """`n` rotation matrices (n, 3, 3), uniform over all rotations."""
    return quaternion_to_matrix(random_quaternions(n, dtype=dtype, device=device))


def random_rotation(dtype: torch.dtype | None = None, device: Device | None = None) -> Tensor:
    """One rotation matrix (3, 3), uniform over all rotations."""
    return random_rotations(1, dtype, device)[0]


def rotation_6d_to_matrix(d6: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of six numbers (..., 6): their two 3-vectors, Gram-Schmidt, as first
    ROWS.

    Zhou et al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019, section B.
    """
    x = F.normalize(d6[..., :3], dim=-1)
    second = d6[..., 3:]
    y = F.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack((x, y, torch.linalg.cross(x, y)), dim=-2)


def matrix_to_rotation_6d(matrix: Tensor) -> Tensor:
    """The first two rows (..., 6) of matrices (..., 3, 3), as a copy; see `rotation_6d_to_matrix`."""
    return matrix[..., :2, :].clone().flatten(-2)


def _check_matrix(matrix: Tensor) -> None:
    """Raises ValueError unless the last two dimensions are (3, 3)."""
    if matrix.shape[-2:] != (3, 3):
        raise ValueError(f"Invalid rotation matrix shape: expected (..., 3, 3); got {tuple(matrix.shape)}")


def _scalar_plus_hat(scalar: Tensor, vector: Tensor) -> Tensor:
    """Matrices scalar * I + hat(vector) (..., 3, 3) of (..., 1) and (..., 3), in one stack."""
    s = scalar[..., 0]
    x, y, z = vector.unbind(-1)
    return torch.stack((s, -z, y, z, s, -x, -y, x, s), dim=-1).unflatten(-1, (3, 3))


def _axis_rotation(axis: int, angle: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) about coordinate axis 0, 1 or 2 by angles (...)."""
    c, s = angle.cos(), angle.sin()
    one, zero = torch.ones_like(angle), torch.zeros_like(angle)
    entries = (
        (one, zero, zero, zero, c, -s, zero, s, c),
        (c, zero, s, zero, one, zero, -s, zero, c),
        (c, -s, zero, s, c, zero, zero, zero, one),
    )
    return torch.stack(entries[axis], dim=-1).unflatten(-1, (3, 3))


def _parse_convention(convention: str) -> tuple[int, int, int]:
    """Axis numbers of an Euler convention; ValueError if it is none."""
    if len(convention) != 3:
        raise ValueError(f"Convention must have 3 letters; got {convention!r}")
    for letter in convention:
        if letter not in _AXES:
            raise ValueError(f"Invalid letter {letter!r} in convention string {convention!r}; known: X, Y, Z")
    if convention[1] in (convention[0], convention[2]):
        raise ValueError(f"Invalid convention {convention!r}: neighbouring letters must differ")
    first, second, third = (_AXES.index(letter) for letter in convention)
    return first, second, third
