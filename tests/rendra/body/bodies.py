"""Small made-up bodies, of any number of joints."""

import torch

from rendra.body import BodyParts
from rendra.body.smpl import SMPL_PARENTS


def parts(verts: int = 30, joints: int = 24, betas: int = 10, pose_blends: bool = True, seed: int = 0) -> BodyParts:
    """Random parts that fit each other, float64."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    parents = (*SMPL_PARENTS[:joints], *(max(0, joint - 3) for joint in range(24, joints)))
    weights = draw(verts, joints)
    held = weights.topk(min(4, joints), dim=1).indices
    weights = torch.zeros_like(weights).scatter(1, held, weights.gather(1, held))
    regressor = draw(joints, verts) * (draw(joints, verts) > 0.6)
    regressor[:, 0] += 0.1
    return BodyParts(
        v_template=draw(verts, 3) * 2 - 1,
        shapedirs=(draw(verts, 3, betas) - 0.5) * 0.1,
        faces=torch.randint(verts, (2 * verts, 3), generator=generator),
        J_regressor=regressor / regressor.sum(1, keepdim=True),
        weights=weights / weights.sum(1, keepdim=True),
        parents=parents,
        posedirs=(draw(verts, 3, 9 * (joints - 1)) - 0.5) * 0.01 if pose_blends else None,
    )
