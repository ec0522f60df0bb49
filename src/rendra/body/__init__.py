"""Bodies that a few numbers shape and pose: linear blend skinning, SMPL-family models, and a free one built in."""

from rendra.body.files import BodyFormatError, read_free_parts, read_parts, write_parts
from rendra.body.skinning import PosedSkeleton, linear_blend_skinning, pose_skeleton, pose_to_matrices
from rendra.body.smpl import SMPL, SMPL_JOINTS, SMPL_PARENTS, Body, BodyParts

__all__ = [
    "SMPL",
    "SMPL_JOINTS",
    "SMPL_PARENTS",
    "Body",
    "BodyFormatError",
    "BodyParts",
    "PosedSkeleton",
    "linear_blend_skinning",
    "pose_skeleton",
    "pose_to_matrices",
    "read_free_parts",
    "read_parts",
    "write_parts",
]
