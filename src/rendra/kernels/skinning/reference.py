"""Linear blend skinning, the specification: plain torch, any device, any float type, slow.

    x'_v = sum_k w_vk (R_j x_v + s_j),   j = joints[v, k]

(Loper et al., "SMPL", 2015, Eq. 2 and 3), a vertex after the other of some bodies at a time; each such block is
computed again in the backward pass where there are several, so that memory stays bounded.
"""

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

_NUMBERS_AT_ONCE = 2**24


def skin(verts: Tensor, moves: Tensor, joints: Tensor, weights: Tensor) -> Tensor:
    """Vertices (B, V, 3) moved; `joints` and `weights` are (V, K), `moves` (B, J, 3, 4)."""
    dense = weights.new_zeros(len(weights), moves.shape[1]).scatter_add(1, joints.long(), weights)
    return skin_dense(verts, moves, dense)


def skin_dense(verts: Tensor, moves: Tensor, weights: Tensor) -> Tensor:
    """The same with the weights (V, J) of all joints, and a gradient of them too."""
    bodies = max(1, _NUMBERS_AT_ONCE // max(1, 12 * len(weights)))
    if len(verts) <= bodies:
        return _block(verts, moves, weights)
    blocks = zip(verts.split(bodies), moves.split(bodies), strict=True)
    return torch.cat([checkpoint(_block, *block, weights, use_reentrant=False) for block in blocks])


def _block(verts: Tensor, moves: Tensor, weights: Tensor) -> Tensor:
    """Some bodies; rows of the blended transforms times x, y, z, 1."""
    blended = (weights @ moves.flatten(2)).unflatten(-1, (3, 4))  # (b, V, 3, 4)
    return (blended[..., :3] * verts[..., None, :]).sum(-1) + blended[..., 3]
