"""Meshes of different sizes in one batch: `python scripts/tour/batches.py [FILE.obj ...]`.

The same vertices come in three forms. A list has one tensor a mesh. Padded, all are in one tensor, the shorter ones
filled up: what a loss over a batch wants. Packed, all rows stand in one tensor without gaps: what work on single
vertices wants.
"""

import sys

import torch

from rendra.io import load_objs_as_meshes
from rendra.loss import chamfer_distance
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes, Pointclouds, join_meshes_as_batch
from rendra.utils import ico_sphere


def triangle() -> Meshes:
    """One face."""
    verts = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return Meshes(verts=[verts], faces=[torch.tensor([[0, 1, 2]])])


def main(*files: str) -> None:
    """Looks at the user's OBJ files, or at a triangle and two spheres."""
    meshes = [load_objs_as_meshes([file]) for file in files] or [triangle(), ico_sphere(0), ico_sphere(1)]
    batch = join_meshes_as_batch(meshes, include_textures=False)
    print(f"a batch of {len(batch)}, equally large: {batch.equisized}")
    print("list:  ", [tuple(verts.shape) for verts in batch.verts_list()])
    print("padded:", tuple(batch.verts_padded().shape), "filled up with", float(batch.verts_padded()[0, -1].sum()))
    print("padded faces:", tuple(batch.faces_padded().shape), "filled up with", int(batch.faces_padded()[0, -1, 0]))
    print("packed:", tuple(batch.verts_packed().shape))

    # where a packed row belongs, and where each mesh begins
    print("vertices of each mesh:", batch.num_verts_per_mesh().tolist())
    print("first packed row of each:", batch.mesh_to_verts_packed_first_idx().tolist())
    print("mesh of each of the first rows:", batch.verts_packed_to_mesh_idx()[:5].tolist())
    faces = batch.faces_packed()[batch.mesh_to_faces_packed_first_idx()]
    print("first face of each, packed (its indices count through the batch):", faces.tolist())

    # one mesh of the batch, and the batch moved: the topology is shared
    print("the last one alone:", tuple(batch[-1].verts_padded().shape))
    moved = batch.offset_verts(torch.tensor([0.0, 0.0, 1.0]))
    print("moved by one along z:", (moved.verts_packed() - batch.verts_packed()).mean(0).tolist())

    # points sampled from each: as many of the small mesh as of the large one
    points, normals = sample_points_from_meshes(batch, 500, return_normals=True)
    print("samples:", tuple(points.shape), "normals:", tuple(normals.shape))

    # clouds of different sizes; the rows that fill up do not count in the loss
    clouds = Pointclouds(points=batch.verts_list())
    shifted = clouds.offset(torch.tensor([0.0, 0.0, 0.01]))
    losses, _ = chamfer_distance(clouds, shifted, batch_reduction=None)
    print("chamfer distance of each from itself, moved by 0.01:", [round(float(loss), 6) for loss in losses])


if __name__ == "__main__":
    main(*sys.argv[1:])
