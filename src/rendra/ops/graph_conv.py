"""Convolution on the graph of a mesh: vertices and the edges between them."""

import torch
from torch import Tensor, nn

from rendra.structures.sparse_matrix import SparseMatrix


class GraphConv(nn.Module):
    """y_i = W0 x_i + b0 + sum over neighbours j of (W1 x_j + b1): Gkioxari et al., "Mesh R-CNN", ICCV 2019.

    Attributes:
        w0: the linear layer of the vertex itself.
        w1: the linear layer of its neighbours; its bias counts once for each of them.
        input_dim, output_dim, directed: as given.
    """

    def __init__(self, input_dim: int, output_dim: int, init: str = "normal", directed: bool = False) -> None:
        """Make both layers.

        Args:
            input_dim: number of features of a vertex.
            output_dim: number of features that come out.
            init: "normal" draws weights from N(0, 0.01^2) and sets biases to 0; "zero" sets all to 0.
            directed: whether an edge (i, j) makes only j a neighbour of i, not i one of j.

        Raises:
            ValueError: another `init`.
        """
        super().__init__()
        if init not in ("normal", "zero"):
            raise ValueError(f'Invalid GraphConv initialization "{init}": expected "normal" or "zero"')
        self.input_dim = input_dim
        self.output_dim = output_dim
        self.directed = directed
        self.w0 = nn.Linear(input_dim, output_dim)
        self.w1 = nn.Linear(input_dim, output_dim)
        for layer in (self.w0, self.w1):
            nn.init.normal_(layer.weight, std=0.01) if init == "normal" else nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, verts: Tensor, edges: Tensor) -> Tensor:
        """Features of the vertices from those of their neighbours.

        Args:
            verts: (V, input_dim) features of all vertices of a batch.
            edges: (E, 2) int64, as `Meshes.edges_packed()`.

        Returns:
            (V, output_dim).

        Raises:
            ValueError: different devices, or another shape.
        """
        if verts.device != edges.device:
            raise ValueError(
                f"verts and edges tensors must be on the same device; got {verts.device} and {edges.device}"
            )
        return self.w0(verts) + gather_scatter(self.w1(verts), edges, self.directed)

    def over(self, verts: Tensor, neighbours: SparseMatrix) -> Tensor:
        """The same as `forward`, for those who convolve often on one graph and have its matrix.

        Args:
            verts: (V, input_dim).
            neighbours: (V, V), such as `meshes.topology.neighbours(verts.dtype)`.
        """
        return self.w0(verts) + neighbours @ self.w1(verts)

    def extra_repr(self) -> str:
        """What the printed module says of itself."""
        return f"{self.input_dim} -> {self.output_dim}, directed={self.directed}"


def gather_scatter(input: Tensor, edges: Tensor, directed: bool = False) -> Tensor:
    """Sum of the neighbours' rows at every vertex; the same on any number of threads.

    Args:
        input: (V, D) rows of the vertices.
        edges: (E, 2) int64; a repeated edge counts repeatedly.
        directed: whether an edge (i, j) adds row j to i only, not row i to j as well.

    Returns:
        (V, D). Differentiable with respect to `input`.

    Raises:
        ValueError: another shape.
    """
    if input.ndim != 2:
        raise ValueError(f"input can only have 2 dimensions, (V, D); got {tuple(input.shape)}")
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise ValueError(f"edges must be of shape (num_edges, 2), got {tuple(edges.shape)}")
    rows, columns = edges.unbind(1) if directed else torch.cat([edges, edges.flip(1)]).unbind(1)
    ones = torch.ones_like(rows, dtype=input.dtype)
    return SparseMatrix(rows, columns, ones, (len(input), len(input)), symmetric=not directed) @ input
