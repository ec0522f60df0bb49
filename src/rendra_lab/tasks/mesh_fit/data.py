"""One point cloud: a file's, or one scanned from a mesh."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from torch import Tensor

from rendra.io import IO
from rendra.io.errors import MeshFormatError
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes, Pointclouds
from rendra_lab.data.meshes import load_mesh
from rendra_lab.data.repeated import Repeated
from rendra_lab.errors import UserError
from rendra_lab.mesh_quality import nearest_distances
from rendra_lab.records import TensorRecord

log = logging.getLogger(__name__)

_FEWEST = 4  # points that span a volume
_FARTHEST = 1e15  # of a coordinate: single precision squares it, and adds the squares of all points


@dataclass(frozen=True)
class CloudBatch(TensorRecord):
    """A cloud, moved so that its mean is the origin and scaled so that its largest coordinate is 1."""

    points: Float[Tensor, "1 P 3"]  # what is fitted
    scan: Float[Tensor, "1 N 3"]  # the whole cloud, of which `points` may be a part
    spacing: Float[Tensor, " 1"]  # median distance of a point of `points` from the nearest other
    centre: Float[Tensor, "1 3"]  # of the file's points, in the file's units
    scale: Float[Tensor, " 1"]  # the file's units in one of ours

    @staticmethod
    def of(scan: Tensor, most: int, generator: torch.Generator) -> CloudBatch:
        """The batch of a cloud (N, 3), of which at most `most` points, drawn at random, are fitted."""
        centre = scan.mean(0)
        scale = (scan - centre).abs().amax()
        scan = (scan - centre) / scale
        chosen = torch.randperm(len(scan), generator=generator)[:most].sort().values
        points = scan[chosen]
        spacing = nearest_distances(points).median()
        return CloudBatch(points[None], scan[None], spacing[None], centre[None], scale[None])

    def restored(self, mesh: Meshes) -> Meshes:
        """A mesh of the normalised frame at the file's place and in its units."""
        return mesh.update_padded(mesh.verts_padded() * self.scale + self.centre)


class ScannedCloud(LightningDataModule):
    """One cloud, again and again.

    Args:
        path: a cloud or a mesh, of any format that `rendra.io.IO` reads; None scans a mesh of our own.
        name: the mesh that is scanned without a path: cow, torus, ico_sphere, cube.
        scan_points: points scanned from the surface of a mesh.
        noise: standard deviation of the scan, as a share of the mesh's longest side.
        most: points that are fitted; of a larger cloud a random part is taken, and the rest only judges.
        seed: of the scan and of that part.
        steps: optimisation steps an epoch.

    Raises:
        UserError: a file that is missing or holds too few points. A malformed one raises MeshFormatError.
    """

    cloud: CloudBatch

    def __init__(
        self,
        path: str | Path | None = None,
        name: str = "cow",
        scan_points: int = 5000,
        noise: float = 0.002,
        most: int = 20_000,
        seed: int = 0,
        steps: int = 100_000,
    ) -> None:
        super().__init__()
        for key, value, least, largest in (
            ("scan_points", scan_points, _FEWEST, 10_000_000),
            ("most", most, _FEWEST, 10_000_000),
            ("noise", noise, 0, 1_000_000),
        ):
            if not least <= value <= largest:
                raise UserError(f"data.{key} must lie between {least} and {largest:.0e}, got {value}")
        self.path = None if path is None else Path(path)
        self.mesh_name = name
        self.scan_points = scan_points
        self.noise = noise
        self.most = most
        self.seed = seed
        self.steps = steps

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: reads the cloud, once."""
        if hasattr(self, "cloud"):
            return
        generator = torch.Generator().manual_seed(self.seed)
        if self.path is None:
            scan = self._scan(load_mesh(self.mesh_name), generator)
        else:
            scan = self._read(self.path, generator)
        _check(scan, self.path or self.mesh_name)
        self.cloud = CloudBatch.of(scan, self.most, generator)
        if len(scan) > self.most:
            log.info("%s points of %s are fitted (data.most); all of them judge", f"{self.most:,}", f"{len(scan):,}")

    def train_dataloader(self) -> Repeated[CloudBatch]:
        """The cloud, `steps` times."""
        return Repeated(self.cloud, self.steps)

    def test_dataloader(self) -> Repeated[CloudBatch]:
        """The cloud, once."""
        return Repeated(self.cloud)

    def _read(self, path: Path, generator: torch.Generator) -> Tensor:
        if not path.is_file():
            raise UserError(f"data.path: there is no file {path}")
        try:
            geometry = IO().load_geometry(path, include_textures=False)
        except MeshFormatError:
            raise
        except ValueError as error:  # no format has its suffix
            raise UserError(f"data.path: {error}") from error
        return geometry.points_packed() if isinstance(geometry, Pointclouds) else self._scan(geometry, generator)

    def _scan(self, mesh: Meshes, generator: torch.Generator) -> Tensor:
        """Points (scan_points, 3) on a mesh, with noise."""
        points = sample_points_from_meshes(mesh, self.scan_points, generator=generator)[0]
        extent = (mesh.verts_packed().amax(0) - mesh.verts_packed().amin(0)).amax()
        return points + self.noise * extent * torch.randn(points.shape, generator=generator)


def _check(scan: Tensor, origin: object) -> None:
    if not bool(scan.isfinite().all()):
        raise UserError(f"{origin}: point {int((~scan.isfinite()).any(1).nonzero()[0])} is not finite")
    if bool((scan.abs() > _FARTHEST).any()):
        farthest = float(scan.abs().amax())
        raise UserError(f"{origin}: a coordinate of {farthest:.1e}, expected at most {_FARTHEST:.0e}; scale the file")
    if len(scan) < _FEWEST or float((scan - scan.mean(0)).abs().amax()) == 0:
        raise UserError(f"{origin} holds {len(scan)} points, or all in one place: there is no surface to fit")
