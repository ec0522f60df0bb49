"""What shapes are worth that no picture was looked at for: the mean shape of each class.

Voxels of a class are averaged over the training objects, and those that are filled most often are kept, as many as
an object of the class fills on average.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from rendra.ops import cubify
from rendra.structures import Meshes
from rendra_lab.settings import Positive
from rendra_lab.shape_records import ShapeBatch
from rendra_lab.tasks.voxmesh.task import whole_frustums


class MeanShapes:
    """The mean shapes of all classes of a training set, for pictures of objects that it does not have.

    A class that no training object was of has the mean of all objects.

    Args:
        batches: the training set; each object counts as often as it is shown.
        side: voxels along each side of the grids over frustums; those of the objects' axes are the data's.

    Raises:
        ValueError: no batch.
    """

    def __init__(self, batches: Iterable[ShapeBatch], side: Positive = 32) -> None:
        sums: dict[str, dict[int, list[Tensor]]] = {"own": {}, "seen": {}}
        for batch in batches:
            seen = whole_frustums(batch).voxels_of(batch.shapes, side)
            for label in batch.labels.unique().tolist():
                of_class = batch.labels == label
                for kind, voxels in (("own", batch.shapes.voxels), ("seen", seen)):
                    filled = voxels[of_class].double()
                    add = [filled.sum(0), torch.tensor(float(len(filled)))]
                    before = sums[kind].get(label)
                    sums[kind][label] = add if before is None else [a + b for a, b in zip(before, add, strict=True)]
        if not sums["own"]:
            raise ValueError("a mean shape needs at least one object to train on")
        self._own = _Means(sums["own"])
        self._seen = _Means(sums["seen"])

    def posed(self, batch: ShapeBatch) -> Meshes:
        """Each class's mean in the objects' own axes, put where the object truly is, turned and as large as it is.

        It is told more than a picture tells anybody: a bound from above of what knowing the class is worth.
        """
        mean = self._own.meshes(batch.labels.tolist()).to(batch.rgb.device)
        matrix = batch.shapes.voxels_to_camera
        verts = mean.verts_padded().to(matrix) @ matrix[:, :3, :3].mT + matrix[:, None, :3, 3]
        return mean.update_padded(verts)

    def unposed(self, batch: ShapeBatch) -> Meshes:
        """Each class's mean as the training cameras saw its objects, whichever way they were turned."""
        mean = self._seen.meshes(batch.labels.tolist()).to(batch.rgb.device)
        return mean.update_padded(whole_frustums(batch).to_camera(mean.verts_padded().to(batch.rgb)))


class _Means:
    """Meshes of mean voxels by class, in [-1, 1]^3."""

    def __init__(self, sums: dict[int, list[Tensor]]) -> None:
        every = [torch.stack(parts).sum(0) for parts in zip(*sums.values(), strict=True)]
        self._by_class = {label: _mesh(*parts) for label, parts in sums.items()}
        self._of_all = _mesh(every[0], every[1])

    def meshes(self, labels: list[int]) -> Meshes:
        """A batch of one mesh for each label."""
        chosen = [self._by_class.get(label, self._of_all) for label in labels]
        return Meshes([mesh.verts_packed() for mesh in chosen], [mesh.faces_packed() for mesh in chosen])


def _mesh(total: Tensor, count: Tensor) -> Meshes:
    """The voxels (V, V, V) that most of `count` objects fill, as many as they fill on average, and at least one."""
    mean = (total / count.to(total)).float().cpu()
    kept = max(int(mean.sum().round()), 1)
    least = mean.reshape(-1).sort(descending=True).values[kept - 1]
    return cubify(mean[None], float(least.clamp_min(1e-6)), align="corner")
