"""Bodies of the SMPL family: a template, what shapes and poses change of it, and a skeleton that carries it.

Letters: B bodies, V vertices, F faces, J joints, N betas.  Units: metres and radians.  Axes at rest: y up, the body
looks along +z, its left arm along +x.
Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015; the same mechanism carries SMPL-H, SMPL-X and MANO.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.body.skinning import (
    check_parents,
    linear_blend_skinning,
    pose_features,
    pose_skeleton,
    pose_to_matrices,
)
from rendra.kernels.skinning import SkinWeights, skin_weights
from rendra.structures import Meshes

SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
SMPL_JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip

_WEIGHT_SLACK = 0.01  # of the sum of a vertex's weights, which files round


@dataclass(frozen=True)
class BodyParts:
    """What a body model consists of, as its files hold it.

    Attributes:
        v_template: (V, 3) the mean body at rest.
        shapedirs: (V, 3, N) what a beta of 1 adds.
        faces: (F, 3) int64.
        J_regressor: (J, V) joints at rest from vertices at rest; may be sparse.
        weights: (V, J) of linear blend skinning.
        parents: (J,) parent of each joint, -1 first.
        posedirs: (V, 3, 9 (J - 1)) what each element of R - I of the joints but the first adds; None: nothing.
        joint_names: (J,), empty where a file has none.
        head_top: index of the vertex at the top of the head; None: the highest one of the template.
    """

    v_template: Tensor
    shapedirs: Tensor
    faces: Tensor
    J_regressor: Tensor
    weights: Tensor
    parents: tuple[int, ...]
    posedirs: Tensor | None = None
    joint_names: tuple[str, ...] = ()
    head_top: int | None = None


class Body(NamedTuple):
    """Posed bodies.

    Attributes:
        verts: (B, V, 3).
        joints: (B, J, 3).
        rotations: (B, J, 3, 3) of each bone, from rest to the world.
    """

    verts: Tensor
    joints: Tensor
    rotations: Tensor


class SMPL(nn.Module):
    """The function M(beta, theta): shape and pose to vertices and joints. Differentiable, also at rest.

    Its numbers are float32 until `.double()`. None is part of its state: a model comes from its file, whose licence
    may forbid that checkpoints carry it about.

    Args:
        parts: of the model; checked.

    Raises:
        ValueError: parts that do not fit each other, or numbers that are not finite.
    """

    v_template: Tensor
    J_regressor: Tensor
    weights: Tensor
    faces: Tensor
    joint_template: Tensor
    joint_shapedirs: Tensor
    _blends: Tensor  # (N, or N + 9 (J - 1) with pose blend shapes; 3 V)
    _skin_joints: Tensor
    _skin_weights: Tensor

    def __init__(self, parts: BodyParts) -> None:
        super().__init__()
        check_parts(parts)
        self.parents = check_parents(parts.parents)
        self.joint_names = parts.joint_names or _names(len(self.parents))
        self.head_top = int(parts.v_template[:, 1].argmax()) if parts.head_top is None else parts.head_top
        self.num_betas = parts.shapedirs.shape[2]
        self.has_pose_blends = parts.posedirs is not None
        regressor = parts.J_regressor.to_dense() if parts.J_regressor.is_sparse else parts.J_regressor
        wide = regressor.double()  # joints are linear in betas: regressed once, not at every call
        directions = [each.flatten(0, 1) for each in (parts.shapedirs, parts.posedirs) if each is not None]
        sparse = skin_weights(parts.weights.float())
        for name, value in {
            "v_template": parts.v_template.float(),
            "J_regressor": regressor.float(),
            "weights": parts.weights.float(),
            "faces": parts.faces.long(),
            "joint_template": (wide @ parts.v_template.double()).float(),
            "joint_shapedirs": torch.einsum("jv,vcn->jcn", wide, parts.shapedirs.double()).float(),
            "_blends": torch.cat(directions, dim=1).float().T,
            "_skin_joints": sparse.joints,
            "_skin_weights": sparse.weights,
        }.items():
            self.register_buffer(name, value.contiguous(), persistent=False)

    @classmethod
    def load(cls, path: str | Path, num_betas: int | None = None) -> SMPL:
        """A registered model: SMPL, SMPL-H, SMPL-X, MANO ... as `.npz`, or as the authors' `.pkl`.

        Nothing in the file is executed; see `rendra.body.files.read_parts`.

        Args:
            path: of the file.
            num_betas: take the first ones; None takes all.

        Raises:
            FileNotFoundError: no such file.
            BodyFormatError: a file that holds no body, or more than arrays.
        """
        from rendra.body.files import read_parts

        return cls(read_parts(path, num_betas))

    @classmethod
    def free(cls, low: bool = False) -> SMPL:
        """The built-in body of 24 joints in SMPL's order and 10 betas, of variance 1 among adults; free to use.

        Args:
            low: 1,229 vertices instead of 13,718; the same shapes and joints.
        """
        from rendra.body.files import read_free_parts

        return cls(read_free_parts(low))

    @property
    def num_joints(self) -> int:
        """J."""
        return len(self.parents)

    @property
    def shapedirs(self) -> Tensor:
        """(V, 3, N) what a beta of 1 adds to the template."""
        return self._blends[: self.num_betas].T.unflatten(0, (-1, 3))

    @property
    def posedirs(self) -> Tensor | None:
        """(V, 3, 9 (J - 1)) what each element of R - I of the joints but the first adds; None: nothing."""
        return self._blends[self.num_betas :].T.unflatten(0, (-1, 3)) if self.has_pose_blends else None

    def forward(
        self, betas: Tensor | None = None, pose: Tensor | None = None, translation: Tensor | None = None
    ) -> Body:
        """Posed bodies.

        Args:
            betas: (B, n) shapes, n <= N, the others 0; None: the mean shape.
            pose: rotations of each joint against its parent, see `rendra.body.skinning.pose_to_matrices`; None: at
                rest.
            translation: (B, 3) added to all; None: none.

        Each may have B = 1 for all bodies.

        Raises:
            ValueError: shapes that do not fit the model or each other.
        """
        betas, rotations = self._inputs(betas, pose, translation)
        rest, rotations = _alike(self.rest_joints(betas), rotations)
        verts, _ = _alike(self.rest_verts(betas, rotations), rotations)
        skeleton = pose_skeleton(rotations, rest, self.parents)
        verts = linear_blend_skinning(verts, skeleton, rest, SkinWeights(self._skin_joints, self._skin_weights))
        joints, turned = skeleton.joints, skeleton.rotations
        if translation is not None:
            verts, joints = verts + translation[:, None], joints + translation[:, None]
            turned = turned.expand(len(verts), -1, -1, -1)
        return Body(verts, joints, turned)

    def rest_verts(self, betas: Tensor, rotations: Tensor | None = None) -> Tensor:
        """Vertices (B, V, 3) of shapes (B, n) before a skeleton carries them.

        Args:
            betas: the others are 0.
            rotations: (B, J, 3, 3) of each joint against its parent, whose pose blend shapes are added; None: at
                rest, where there are none.
        """
        template = self.v_template.flatten()
        if rotations is None or not self.has_pose_blends:
            return torch.addmm(template, betas, self._blends[: betas.shape[1]]).unflatten(1, (-1, 3))
        betas = F.pad(betas, (0, self.num_betas - betas.shape[1])).expand(len(rotations), -1)
        blended = torch.cat([betas, pose_features(rotations)], dim=1)
        return torch.addmm(template, blended, self._blends).unflatten(1, (-1, 3))

    def rest_joints(self, betas: Tensor) -> Tensor:
        """Joints (B, J, 3) of shapes (B, n) at rest."""
        return self.joint_template + torch.einsum("bn,jcn->bjc", betas, self.joint_shapedirs[..., : betas.shape[1]])

    def mesh(self, body: Body) -> Meshes:
        """The surfaces of posed bodies, a batch of B."""
        return Meshes(verts=list(body.verts), faces=[self.faces] * len(body.verts))

    def joint_index(self, name: str) -> int:
        """The place of a joint.

        Raises:
            ValueError: no joint of that name, which lists those there are.
        """
        if name not in self.joint_names:
            raise ValueError(f"this body has no joint {name!r}; it has: {', '.join(self.joint_names)}")
        return self.joint_names.index(name)

    def _inputs(self, betas: Tensor | None, pose: Tensor | None, translation: Tensor | None) -> tuple[Tensor, Tensor]:
        like = self.v_template
        for name, given in {"betas": betas, "pose": pose, "translation": translation}.items():
            if given is not None and (given.dtype, given.device) != (like.dtype, like.device):
                raise ValueError(
                    f"{name} must be {like.dtype} on {like.device}, as the body is, got {given.dtype} on "
                    f"{given.device}"
                )
        betas = like.new_zeros(1, self.num_betas) if betas is None else betas
        pose = like.new_zeros(1, self.num_joints, 3) if pose is None else pose
        if betas.ndim != 2 or betas.shape[1] > self.num_betas:
            raise ValueError(f"betas must be (B, n) with n at most {self.num_betas}, got {tuple(betas.shape)}")
        if translation is not None and (translation.ndim != 2 or translation.shape[1] != 3):
            raise ValueError(f"translation must be (B, 3), got {tuple(translation.shape)}")
        counts = {
            "betas": len(betas),
            "pose": len(pose),
            "translation": 1 if translation is None else len(translation),
        }
        if len(set(counts.values()) - {1}) > 1:
            raise ValueError(f"betas, pose and translation are of as many bodies, or of one; got {counts}")
        return betas, pose_to_matrices(pose, self.num_joints)


def _alike(points: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
    """Of as many bodies."""
    count = len(points) if len(rotations) == 1 else len(rotations)
    return points.expand(count, -1, -1), rotations.expand(count, -1, -1, -1)


def _names(count: int) -> tuple[str, ...]:
    return SMPL_JOINTS if count == len(SMPL_JOINTS) else tuple(f"joint_{index}" for index in range(count))


def check_parts(parts: BodyParts) -> None:
    """Whether parts fit each other.

    Raises:
        ValueError: which does not, and what was expected; or numbers that are not finite.
    """
    verts, joints = len(parts.v_template), len(parts.parents)
    if not verts or not joints:
        raise ValueError(f"a body has vertices and joints, got {verts} and {joints}")
    wanted: dict[str, tuple[Tensor, Sequence[int | None]]] = {
        "v_template": (parts.v_template, (verts, 3)),
        "shapedirs": (parts.shapedirs, (verts, 3, None)),
        "faces": (parts.faces, (None, 3)),
        "J_regressor": (parts.J_regressor, (joints, verts)),
        "weights": (parts.weights, (verts, joints)),
    }
    if parts.posedirs is not None:
        wanted["posedirs"] = (parts.posedirs, (verts, 3, 9 * (joints - 1)))
    for name, (value, shape) in wanted.items():
        _check_numbers(name, value, shape, f"for {verts} vertices and {joints} joints")
    if len(parts.faces) and not 0 <= int(parts.faces.min()) <= int(parts.faces.max()) < verts:
        raise ValueError(
            f"faces must name vertices 0 to {verts - 1}, got {int(parts.faces.min())} to {int(parts.faces.max())}"
        )
    sums = parts.weights.sum(1)
    if (sums - 1).abs().max() > _WEIGHT_SLACK:
        worst = int((sums - 1).abs().argmax())
        raise ValueError(
            f"weights of each vertex must have the sum 1; those of vertex {worst} have {sums[worst]:.4g}"
        )
    if parts.joint_names and len(parts.joint_names) != joints:
        raise ValueError(f"joint_names must be {joints}, got {len(parts.joint_names)}")
    if parts.head_top is not None and not 0 <= parts.head_top < verts:
        raise ValueError(f"head_top must be a vertex, 0 to {verts - 1}, got {parts.head_top}")


def _check_numbers(name: str, value: Tensor, shape: Sequence[int | None], of_what: str) -> None:
    if value.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True)):
        letters = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name} must be ({letters}) {of_what}, got {tuple(value.shape)}")
    dense = value.coalesce().values() if value.is_sparse else value
    if value.is_floating_point() and not bool(dense.isfinite().all()):
        raise ValueError(f"{name} holds numbers that are not finite")
