"""Rotations and rigid motions as numbers that can be optimised: `python scripts/tour/rotations.py`.

A rotation matrix has nine numbers and six constraints. Its logarithm has three numbers and none: the axis, as long as
the angle. `so3_exp_map` and `so3_log_map` go back and forth; `se3_...` do the same for rotations with a translation.
"""

import math

import torch

from rendra.transforms import (
    Transform3d,
    hat,
    hat_inv,
    se3_exp_map,
    se3_log_map,
    so3_exp_map,
    so3_log_map,
    so3_relative_angle,
    so3_rotation_angle,
)

LOG_ROTATIONS = torch.tensor([[0.0, 0.0, 0.5], [0.1, 0.0, 0.0], [0.3, 0.2, -0.1], [1.0, 1.0, 1.0]])


def main() -> None:
    """Walks from axis and angle to matrices and back, then to motions and chains of transforms."""
    skew = hat(LOG_ROTATIONS)  # hat(a) b = a x b
    print("hat of", rounded(LOG_ROTATIONS[2]), "is", rounded(skew[2]))
    print("hat_inv takes it back:", torch.equal(hat_inv(skew), LOG_ROTATIONS))

    R = so3_exp_map(LOG_ROTATIONS)  # for column vectors: R x
    print("exp of", rounded(LOG_ROTATIONS[0]), "is", rounded(R[0]))
    print("it is the matrix exponential of hat:", torch.allclose(R, torch.linalg.matrix_exp(skew), atol=1e-5))
    print("R R^T = 1:", torch.allclose(R @ R.transpose(1, 2), torch.eye(3).expand(4, 3, 3), atol=1e-5))
    print("log(exp(x)) = x:", torch.allclose(so3_log_map(R), LOG_ROTATIONS, atol=1e-5))
    print("angles:", rounded(so3_rotation_angle(R)), "= lengths:", rounded(LOG_ROTATIONS.norm(dim=1)))
    print("angle between the first two:", rounded(so3_relative_angle(R[:1], R[1:2])))

    motions = torch.cat([torch.tensor([[1.0, 2.0, 3.0]]).expand(4, 3), LOG_ROTATIONS], dim=1)  # translation first
    matrices = se3_exp_map(motions)  # (4, 4, 4) for row vectors: the translation is the last row
    print("exp of", rounded(motions[0]), "has the last row", rounded(matrices[0, 3]))
    print("its rotation is so3_exp_map's, transposed:", torch.allclose(matrices[:, :3, :3], R.transpose(1, 2)))
    print("se3 log(exp(x)) = x:", torch.allclose(se3_log_map(matrices), motions, atol=1e-4))

    # a chain is read from left to right, as it acts: first the shift, then the scale
    origin = torch.zeros(1, 3)
    print("shifted by 1, then doubled:", rounded(Transform3d().translate(1, 0, 0).scale(2).transform_points(origin)))
    print("doubled, then shifted by 1:", rounded(Transform3d().scale(2).translate(1, 0, 0).transform_points(origin)))
    chain = Transform3d().rotate_axis_angle(90, "Z").translate(0, 0, 4).compose(Transform3d(matrix=matrices[0]))
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    there = chain.transform_points(points)
    print("and back:", torch.allclose(chain.inverse().transform_points(there), points, atol=1e-5))

    # why the logarithm: plain gradient steps stay on rotations
    wanted, guess = so3_exp_map(torch.tensor([[0.0, 0.0, math.pi / 3]])), torch.zeros(1, 3, requires_grad=True)
    optimizer = torch.optim.SGD([guess], lr=0.2)
    for _ in range(40):
        optimizer.zero_grad()
        (so3_exp_map(guess) - wanted).square().sum().backward()
        optimizer.step()
    print("found by gradient descent:", rounded(guess.detach()[0]), "true:", [0, 0, round(math.pi / 3, 4)])


def rounded(values: torch.Tensor) -> list:
    """Numbers with four digits behind the point."""
    return values.double().mul(1e4).round().div(1e4).add(0.0).tolist()


if __name__ == "__main__":
    main()
