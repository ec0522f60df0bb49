"""What of solids that overlap can be seen from anywhere: their outer surface, points on it, and the cells they fill.

Furniture is put together of solids that stand in and on each other. Faces within other solids belong to no shape that
anybody could rebuild, and so do those in slits as between books: they are left out.

Letters: V vertices, F faces, P points, S cells along each side.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.shape_records import Shapes
from rendra_lab.voxelization import voxels_of, windings_at

_SLIT = 4e-3  # of half of the longest side: a surface so near before another solid is hidden by it
_CUTS = 2  # of faces that are hidden in part
_ROUNDS = 30  # at most, of drawing points


@dataclass(frozen=True)
class SolidShape(TensorRecord):
    """One object in the cube [-1, 1]^3, which its longest side fills."""

    points: Float[Tensor, "P 3"]  # uniform on its outer surface
    normals: Float[Tensor, "P 3"]  # of them, outwards, of length 1
    voxels: Bool[Tensor, "S S S"]  # [z, y, x], filled where it is
    verts: Float[Tensor, "V 3"]  # of its outer surface
    faces: Int[Tensor, "F 3"]
    cube_to_own: Float[Tensor, "4 4"]  # columns: the cube to the axes that its vertices came in

    def seen(self, own_to_camera: Float[Tensor, "4 4"]) -> Shapes:
        """The object alone before a camera.

        Args:
            own_to_camera: columns; turns, moves and perhaps scales all axes alike.
        """
        matrix = (own_to_camera.double() @ self.cube_to_own.double()).to(self.points)
        turn = torch.nn.functional.normalize(matrix[:3, :3], dim=0)
        return Shapes(
            points=_moved(self.points, matrix)[None],
            normals=(self.normals @ turn.T)[None],
            voxels=self.voxels[None],
            voxels_to_camera=matrix[None],
            verts=(_moved(self.verts, matrix),),
            faces=(self.faces,),
        )


def shape_of(
    verts: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    side: int,
    count: int,
    generator: torch.Generator | None = None,
) -> SolidShape:
    """The shape of closed solids, which may overlap and touch.

    Args:
        verts: in any axes and units.
        faces: counter-clockwise seen from outside.
        side: S.
        count: P.
        generator: draws the points; None: torch's global stream.

    Raises:
        ValueError: no faces, or what `voxels_of` refuses.
    """
    if not len(faces):
        raise ValueError(f"a shape has at least one face, got {len(verts)} vertices and none")
    used = verts[faces.unique()].double()
    low, high = used.amin(0), used.amax(0)
    matrix = torch.eye(4, dtype=torch.float64, device=verts.device)
    matrix[:3, :3] *= float((high - low).amax()) / 2
    matrix[:3, 3] = (low + high) / 2
    inner = ((verts.double() - matrix[:3, 3]) / matrix[0, 0]).to(verts)
    outer, shown = _outer_surface(inner, faces)
    points, normals = _points_on(outer, shown, (inner, faces), count, generator)
    return SolidShape(points, normals, voxels_of(inner, faces, side), outer, shown, matrix.to(verts))


def is_hidden(
    points: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    verts: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    slit: float,
) -> Bool[Tensor, " P"]:
    """Whether something solid lies right before points of a surface.

    Args:
        points: on the surface.
        normals: of them, outwards, of length 1.
        verts, faces: all solids.
        slit: how far before the points one looks.
    """
    return windings_at(points + slit * normals, verts, faces) != 0


def _outer_surface(verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices and faces of what is not hidden; faces hidden in part are cut in four, and at last kept by half."""
    corners, kept = verts[faces], []
    for cut in range(_CUTS + 1):
        shown = _shown_share(corners, (verts, faces))
        kept.append(corners[shown > (0.5 if cut == _CUTS else 0.999)])
        corners = _quarters(corners[(shown > 0.001) & (shown < 0.999)])
    outer = torch.cat(kept).reshape(-1, 3)
    if not len(outer):
        return verts, faces
    outer, rows = outer.unique(dim=0, return_inverse=True)
    return outer, rows.reshape(-1, 3)


def _shown_share(corners: Tensor, solids: tuple[Tensor, Tensor]) -> Tensor:
    """The share of ten places of a face (F, 3, 3) that is not hidden: (F,)."""
    steps = [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]
    weights = (corners.new_tensor(steps) + 1 / 3) / 4
    places = weights @ corners
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1, eps=1e-20)[:, None].expand_as(places)
    hidden = is_hidden(places.reshape(-1, 3), normals.reshape(-1, 3), *solids, _SLIT)
    return 1 - hidden.reshape(-1, len(steps)).to(corners).mean(1)


def _quarters(corners: Tensor) -> Tensor:
    """Each face (F, 3, 3) cut at the middles of its edges: (4 F, 3, 3)."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return torch.cat([torch.stack(part, 1) for part in parts])


def _points_on(
    verts: Tensor, faces: Tensor, solids: tuple[Tensor, Tensor], count: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Points (P, 3) and normals of a surface that solids do not hide; any, where they hide nearly all of it."""
    mesh = Meshes([verts], [faces])
    kept: list[tuple[Tensor, Tensor]] = []
    found = 0
    for _ in range(_ROUNDS):
        points, normals = (
            drawn[0] for drawn in sample_points_from_meshes(mesh, count, return_normals=True, generator=generator)
        )
        shown = ~is_hidden(points, normals, *solids, _SLIT)
        kept.append((points[shown], normals[shown]))
        found += int(shown.sum())
        if found >= count:
            break
    else:
        kept.append((points, normals))
    points, normals = (torch.cat(parts)[:count] for parts in zip(*kept, strict=True))
    return points, normals


def _moved(points: Tensor, matrix: Tensor) -> Tensor:
    return points @ matrix[:3, :3].T + matrix[:3, 3]
