"""What a depth camera sees of a few known meshes, displaced and disturbed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from torch import Tensor

from rendra.io.errors import MeshFormatError
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes, join_meshes_as_batch
from rendra_lab.data.meshes import load_mesh
from rendra_lab.data.repeated import StepByStep
from rendra_lab.errors import UserError
from rendra_lab.records import TensorRecord
from rendra_lab.tasks.localize.solids import SOLIDS, subdivided

_FARTHEST = 1e15  # single precision squares it


@dataclass(frozen=True)
class SightBatch(TensorRecord):
    """One look at N meshes of different sizes, in the units of their files."""

    points: Float[Tensor, "N S 3"]  # drawn anew from the surfaces of `seen` at every look
    displacement: Float[Tensor, "1 3"]  # the truth, one for all meshes
    known: Meshes  # as they are without a displacement
    seen: Meshes  # displaced, every vertex disturbed
    titles: list[str]  # of the meshes


class Looks(StepByStep[SightBatch]):
    """Yields look after look, with new points in each.

    A look's points depend on its number alone, so that a resumed fit sees what an uninterrupted one would.

    Args:
        look: makes the look of a number.
        count: looks an epoch.
    """

    def __init__(self, look: Callable[[int], SightBatch], count: int = 1) -> None:
        self.look = look
        self.count = count

    def __len__(self) -> int:
        return self.count

    def batch_of(self, step: int) -> SightBatch:
        """The look of a step."""
        return self.look(step)


class SeenSolids(LightningDataModule):
    """A few meshes, seen by a depth camera that was displaced against them.

    Args:
        paths: files of meshes, of any format that `rendra.io.IO` reads; None takes a cube, an octahedron and a
            dodecahedron whose corners lie sqrt(3) from the origin.
        displacement: of what is seen, in the units of the meshes.
        noise_variance: of every coordinate of every vertex that is seen, in squared units.
        measurements: vertices that each mesh has at least when they are disturbed; triangles are cut into four until
            there are so many. The more, the better the noise cancels.
        samples: points S drawn from each mesh at every look.
        seed: of the noise and of the points.
        steps: looks an epoch.

    Raises:
        UserError: an impossible setting or a missing file. A malformed file raises MeshFormatError.
    """

    known: Meshes

    def __init__(
        self,
        paths: Sequence[str | Path] | None = None,
        displacement: Sequence[float] = (3.0, 4.0, 5.0),
        noise_variance: float = 0.1,
        measurements: int = 1000,
        samples: int = 5000,
        seed: int = 0,
        steps: int = 100_000,
    ) -> None:
        super().__init__()
        _check_settings(displacement, noise_variance, measurements, samples)
        if isinstance(paths, (str, Path)) or (paths is not None and not paths):
            raise UserError(f"data.paths must be a list of files such as [a.obj,b.ply], or null, got {paths!r}")
        self.paths = None if paths is None else [Path(path) for path in paths]
        self.displacement = torch.tensor([[float(each) for each in displacement]])
        self.noise_variance = noise_variance
        self.measurements = measurements
        self.samples = samples
        self.seed = seed
        self.steps = steps

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: reads and displaces the meshes, once."""
        if hasattr(self, "known"):
            return
        if self.paths is None:
            self.titles, meshes = list(SOLIDS), [make() for make in SOLIDS.values()]
        else:
            self.titles, meshes = _distinct([path.stem for path in self.paths]), [_read(path) for path in self.paths]
        self.known = join_meshes_as_batch(
            [subdivided(mesh, self.measurements) for mesh in meshes], include_textures=False
        )
        verts = self.known.verts_packed()
        noise = torch.randn(verts.shape, generator=torch.Generator().manual_seed(self.seed))
        self.seen = self.known.offset_verts(math.sqrt(self.noise_variance) * noise + self.displacement)

    def look(self, number: int) -> SightBatch:
        """What is seen at a look; its number draws the points."""
        generator = torch.Generator().manual_seed((self.seed + 1) * 1_000_003 + number)
        points = sample_points_from_meshes(self.seen, self.samples, generator=generator)
        return SightBatch(points, self.displacement, self.known, self.seen, self.titles)

    def train_dataloader(self) -> Looks:
        """`steps` looks."""
        return Looks(self.look, self.steps)

    def test_dataloader(self) -> Looks:
        """One look."""
        return Looks(self.look)


def _check_settings(displacement: Sequence[float], noise_variance: float, measurements: int, samples: int) -> None:
    numbers = all(isinstance(each, int | float) for each in displacement)
    if len(displacement) != 3 or not numbers or not all(abs(each) <= _FARTHEST for each in displacement):
        raise UserError(f"data.displacement must be three numbers such as [3,4,5], got {list(displacement)}")
    for key, value, least, most in (
        ("noise_variance", noise_variance, 0, 1e12),
        ("measurements", measurements, 0, 1_000_000),
        ("samples", samples, 1, 1_000_000),
    ):
        if not least <= value <= most:
            raise UserError(f"data.{key} must lie between {least} and {most:.0e}, got {value}")


def _read(path: Path) -> Meshes:
    try:
        return load_mesh(path=path)
    except MeshFormatError:
        raise
    except (FileNotFoundError, ValueError) as error:  # ValueError: no format has its suffix, or it holds no faces
        raise UserError(f"data.paths: {error}") from error


def _distinct(stems: list[str]) -> list[str]:
    """Names of files, numbered where two are the same."""
    return [stem if stems.count(stem) == 1 else f"{stem}_{number}" for number, stem in enumerate(stems)]
