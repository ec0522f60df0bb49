"""Pixels and their rays: what a radiance field is trained on and judged by.

Letters: K rays of a pixel; "pixels" are R chosen ones in training, and (1, H, W) where a whole view is shown.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.nn import functional as F

from rendra.structures import Meshes
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.repeated import StepByStep
from rendra_lab.data.shares import Share
from rendra_lab.errors import UserError
from rendra_lab.records import TensorRecord
from rendra_lab.settings import Count, Fraction, Positive, Range, check_numbers

RayWarp = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Takes rays, origins (Q, 3) and unit directions (Q, 3), to those of a bent space: the same shapes and lengths."""

_FOCUS_MARGIN_PX = 3
_Side = Annotated[float, Range(0, 1, closed=False)]  # a part of the side of an image
BACKGROUNDS = {"white": 1.0, "black": 0.0, "random": None}


@dataclass(frozen=True)
class RayBatch(TensorRecord):
    """What pixels show, and the rays that see it."""

    rgb: Float[Tensor, "*pixels 3"]  # sRGB in [0, 1], laid over the background
    mask: Float[Tensor, "*pixels"]  # coverage in [0, 1]; 1 in images without alpha
    cut_out: Float[Tensor, "*pixels"]  # 1 in images with alpha, whose mask means something; else 0
    background: Float[Tensor, "*pixels 3"]  # what is behind everything, sRGB in [0, 1]
    origins: Float[Tensor, "*pixels K 3"]  # in the world
    directions: Float[Tensor, "*pixels K 3"]  # of length 1
    nearest: Float[Tensor, "*pixels K"]  # distance along the ray at which the scene begins
    farthest: Float[Tensor, "*pixels K"]  # and ends; not beyond `nearest` where the ray misses it


@dataclass(frozen=True)
class Scene:
    """Posed images of one scene, divided, and where the scene lies."""

    train: PosedImages
    val: PosedImages
    test: PosedImages
    box: Float[Tensor, "2 3"]  # lowest and highest corner of what may hold anything, in the world
    depth_range: tuple[float, float] | None = None  # distances along a ray to look between; None: all of the box
    truth: Meshes | None = None  # the scene itself, where it is known
    up: tuple[float, float, float] | None = None  # the upward direction, where it is known
    warp: RayWarp | None = None  # to the space in which box and depth_range are given; None: the world


def within_box(origins: Tensor, directions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box, not behind their origins: distances (...), equal where they miss it."""
    tiny = torch.where(directions < 0, -1e-12, 1e-12).to(directions.dtype)
    inverse = 1 / torch.where(directions.abs() < 1e-12, tiny, directions)
    walls = (box[:, None] - origins.reshape(1, -1, 3)) * inverse.reshape(1, -1, 3)
    enter = walls.amin(0).amax(-1).clamp_min(0).reshape(origins.shape[:-1])
    leave = walls.amax(0).amin(-1).reshape(origins.shape[:-1])
    return enter, torch.maximum(enter, leave)


class RayCaster:
    """Makes ray batches of the pixels of posed images.

    Args:
        box: (2, 3), see `Scene`.
        depth_range: see `Scene`.
        background: white, black or random.
        side: rays of a pixel along each of its sides; K = side * side, spread evenly over its area.
        warp: see `Scene`.
    """

    def __init__(
        self,
        box: Tensor,
        depth_range: tuple[float, float] | None,
        background: str = "white",
        side: int = 1,
        warp: RayWarp | None = None,
    ) -> None:
        self.box = box
        self.warp = warp
        self.depth_range = depth_range
        self.background = background
        self.side = side

    def pixels(
        self,
        images: PosedImages,
        chosen: Tensor,
        generator: torch.Generator | None = None,
        jitter: bool = False,
        share: Share = Share(),  # noqa: B008 - frozen
    ) -> RayBatch:
        """Chosen pixels (R,), counted through all images.

        Args:
            images: to look at.
            chosen: (R,) int64.
            generator: of random backgrounds and jitter; None uses white instead of random backgrounds.
            jitter: move each ray to a random place of its part of the pixel.
            share: of the chosen pixels; whoever takes it, a pixel gets the same random numbers.
        """
        offsets = self._offsets(len(chosen), generator if jitter else None)[share.rows]
        behind = self._behind(len(chosen), generator)[share.rows]
        chosen = chosen[share.rows].contiguous()
        view = torch.searchsorted(images.first_pixel, chosen, right=True) - 1
        place = chosen - images.first_pixel[view]
        origins, directions = self._rays(images, view, place, offsets)
        rgba = images.pixels.index_select(0, chosen).float() / 255
        return self._batch(rgba, images.has_alpha, behind, origins, directions)

    def view(self, images: PosedImages, index: int) -> RayBatch:
        """All pixels of one image: (1, H, W)."""
        first, last = images.first_pixel[index : index + 2].tolist()
        return _as_view(self.pixels(images, torch.arange(first, last)), images, index)

    def blank_view(self, cameras: PosedImages, index: int) -> RayBatch:
        """All pixels of a camera that took no image, (1, H, W): nothing but background before its rays."""
        place = torch.arange(int(cameras.sizes[index].prod()))
        origins, directions = self._rays(
            cameras, torch.full_like(place, index), place, self._offsets(len(place), None)
        )
        flat = self._batch(torch.zeros(len(place), 4), True, self._behind(len(place), None), origins, directions)
        return _as_view(flat, cameras, index)

    def _rays(self, images: PosedImages, view: Tensor, place: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and directions (R * K, 3) through pixels, each counted row by row within its image."""
        width = images.sizes[view, 1]
        corner = torch.stack([place % width, place // width], dim=-1).float()
        xy = (corner[:, None] + offsets).reshape(-1, 2)
        rays = images.rays(view.repeat_interleave(self.side**2), xy)
        return rays if self.warp is None else self.warp(*rays)

    def _offsets(self, count: int, generator: torch.Generator | None) -> Tensor:
        """Where in its pixel each ray goes through: (count, K, 2)."""
        cells = torch.arange(self.side)
        grid = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1).reshape(1, -1, 2).float()
        if generator is None:
            return ((grid + 0.5) / self.side).expand(count, -1, -1)
        return (grid + torch.rand(count, self.side**2, 2, generator=generator)) / self.side

    def _behind(self, count: int, generator: torch.Generator | None) -> Tensor:
        value = BACKGROUNDS[self.background]
        if value is not None:
            return torch.full((count, 3), value)
        return torch.ones(count, 3) if generator is None else torch.rand(count, 3, generator=generator)

    def _batch(self, rgba: Tensor, has_alpha: bool, behind: Tensor, origins: Tensor, directions: Tensor) -> RayBatch:
        origins, directions = (rays.reshape(len(rgba), self.side**2, 3) for rays in (origins, directions))
        nearest, farthest = within_box(origins, directions, self.box)
        if self.depth_range is not None:
            nearest, farthest = nearest.clamp_min(self.depth_range[0]), farthest.clamp_max(self.depth_range[1])
        alpha = rgba[:, 3:]
        rgb = rgba[:, :3] * alpha + behind * (1 - alpha)
        farthest = torch.maximum(nearest, farthest)
        cut_out = torch.full_like(alpha[:, 0], float(has_alpha))
        return RayBatch(rgb, alpha[:, 0], cut_out, behind, origins, directions, nearest, farthest)


def _as_view(flat: RayBatch, images: PosedImages, index: int) -> RayBatch:
    """The pixels of one image (H * W, ...) as (1, H, W, ...)."""
    height, width = images.sizes[index].tolist()
    return flat._map(
        lambda value: value.reshape(1, height, width, *value.shape[1:]), lambda value: isinstance(value, Tensor)
    )


class RandomPixels(StepByStep[RayBatch]):
    """Endless random pixels of the training images, new ones in each epoch of `steps` batches.

    The random numbers of a step follow from seed and step alone, so a resumed run sees what it would have seen, and
    processes that divide a step see together what one alone would.
    """

    def __init__(
        self, casters: Callable[[int], RayCaster], images: PosedImages, rays: int, steps: int, seed: int, **how: Any
    ) -> None:
        self.casters, self.images = casters, images
        self.num_rays, self.steps, self.seed = rays, steps, seed
        self.views_per_step: int | None = how["views_per_step"]
        self.precrop: float = how["precrop"]
        self.precrop_steps: int = how["precrop_steps"]
        self.jitter: bool = how["jitter"]
        self.share: Share = how.get("share", Share())
        self.focus: float = how["focus"] if images.has_alpha and self.views_per_step is None else 0.0
        self._near = pixels_near_matter(images) if self.focus > 0 else torch.zeros(0, dtype=torch.int32)

    def __len__(self) -> int:
        return self.steps

    def batch_of(self, step: int) -> RayBatch:
        """The pixels of a step."""
        mixed = np.random.SeedSequence([self.seed, step]).generate_state(1)  # torch takes 32 bits of a seed alone
        generator = torch.Generator().manual_seed(int(mixed[0]))
        caster = self.casters(step)
        chosen = self._chosen(step, max(1, self.num_rays // caster.side**2), generator)
        return caster.pixels(self.images, chosen, generator, self.jitter, self.share)

    def _chosen(self, step: int, count: int, generator: torch.Generator) -> Tensor:
        views = torch.arange(len(self.images))
        if self.views_per_step is not None:
            views = torch.randperm(len(views), generator=generator)[: self.views_per_step]
        view = views[torch.randint(len(views), (count,), generator=generator)]
        share = self.precrop if step < self.precrop_steps else 1.0
        inside = (1 - share) / 2 + share * torch.rand(count, 2, generator=generator)
        size = self.images.sizes[view]
        row, column = (inside * size).long().minimum(size - 1).unbind(1)
        chosen = self.images.first_pixel[view] + row * size[:, 1] + column
        if step >= self.precrop_steps and len(self._near) > 0:
            focused = round(self.focus * count)
            chosen[:focused] = self._near[torch.randint(len(self._near), (focused,), generator=generator)].long()
        return chosen


def pixels_near_matter(images: PosedImages) -> Tensor:
    """Pixels (M,) int32, counted through all images, within `_FOCUS_MARGIN_PX` of one that is not transparent."""
    near = []
    for index, first in enumerate(images.first_pixel[:-1].tolist()):
        height, width = images.sizes[index].tolist()
        alpha = images.pixels[first : first + height * width, 3].reshape(1, 1, height, width) > 0
        reach = 2 * _FOCUS_MARGIN_PX + 1
        grown = F.max_pool2d(alpha.float(), reach, stride=1, padding=_FOCUS_MARGIN_PX)
        near.append((first + grown.flatten().nonzero()[:, 0]).int())
    return torch.cat(near) if near else torch.zeros(0, dtype=torch.int32)


class WholeViews:
    """Every pixel of every image, one image a batch; or of a share of the images."""

    def __init__(self, caster: RayCaster, images: PosedImages, share: Share = Share()) -> None:  # noqa: B008 - frozen
        self.caster, self.images = caster, images
        self.indices = range(len(images))[share.whole_if_few(len(images)).rows]

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[RayBatch]:
        for index in self.indices:
            yield self.caster.view(self.images, index)


class SceneViews(LightningDataModule, ABC):
    """Views of one scene; subclasses say where they come from.

    Several processes divide the pixels of a step and the views of a validation among them; each of them sees the
    whole test, whose numbers, pictures and order are therefore those of one process.

    Args:
        rays_per_step: rays of a training step, of all of its pixels.
        rays_per_pixel_side: rays of a pixel along each of its sides; a pixel's colour is the mean of its rays. Or
            pairs [step, side], each side from that step on; what is not trained on gets the last one.
        background: white, black or random, behind what images leave transparent.
        views_per_step: images that the pixels of a step come from; null takes all.
        precrop: share of the sides of an image, about its middle, that the first steps see.
        precrop_steps: how many steps those are.
        jitter: move rays at random within their part of the pixel in training.
        focus: share of the pixels of a step that show matter, or lie by it; the others come from anywhere. Means
            nothing where images have no alpha, or with `views_per_step`.
        seed: of the choice of pixels.
        steps: of an epoch.
    """

    def __init__(
        self,
        rays_per_step: Positive = 4096,
        rays_per_pixel_side: int | Sequence[Sequence[int]] = 1,
        background: str = "white",
        views_per_step: int | None = None,
        precrop: _Side = 1.0,
        precrop_steps: Count = 0,
        jitter: bool = False,
        focus: Fraction = 0.0,
        seed: int = 0,
        steps: int = 100_000,
    ) -> None:
        super().__init__()
        if background not in BACKGROUNDS:
            raise UserError(f"data.background must be one of {', '.join(BACKGROUNDS)}, got {background!r}")
        check_numbers("data", Positive, rays_per_step=rays_per_step, steps=steps)
        check_numbers("data", Positive | None, views_per_step=views_per_step)
        check_numbers("data", _Side, precrop=precrop)
        check_numbers("data", Fraction, focus=focus)
        self.rays_per_step = rays_per_step
        self.sides = _schedule(rays_per_pixel_side)
        self.background = background
        self.seed = seed
        self.steps = steps
        self.how = {
            "views_per_step": views_per_step,
            "precrop": precrop,
            "precrop_steps": precrop_steps,
            "jitter": jitter,
            "focus": focus,
        }

    is_divisible = True

    @abstractmethod
    def load(self) -> Scene:
        """The views; UserError names the file and what is wrong with it."""

    def setup(self, stage: str) -> None:
        """Lightning's hook, before the fit and again before the test: loads the views, once."""
        if not hasattr(self, "scene"):
            self.scene = self.load()

    @property
    def final_side(self) -> int:
        """Rays of a pixel along each of its sides, in the end."""
        return self.sides[-1][1]

    @property
    def test_labels(self) -> tuple[str, ...]:
        """What the test images are called, in the order of the test batches."""
        return self.scene.test.labels

    @property
    def caster(self) -> RayCaster:
        """Makes the rays of whole views."""
        return self._caster(self.final_side)

    def _caster(self, side: int) -> RayCaster:
        return RayCaster(self.scene.box, self.scene.depth_range, self.background, side, self.scene.warp)

    def train_dataloader(self) -> RandomPixels:
        """Random pixels of the training images."""

        def casters(step: int) -> RayCaster:
            return self._caster([side for begin, side in self.sides if begin <= step][-1])

        how = {**self.how, "share": Share.of(self)}
        return RandomPixels(casters, self.scene.train, self.rays_per_step, self.steps, self.seed, **how)

    def val_dataloader(self) -> WholeViews | Sequence[RayBatch]:
        """The validation images, one a batch."""
        return WholeViews(self.caster, self.scene.val, Share.of(self))

    def test_dataloader(self) -> WholeViews:
        """The test images, one a batch."""
        return WholeViews(self.caster, self.scene.test)


def _schedule(sides: int | Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Pairs (step, side), the first at step 0."""
    complaint = UserError(
        "data.rays_per_pixel_side is a whole number of at least 1, or pairs [step, side] of rising steps, the "
        f"first 0, got {sides!r}"
    )
    try:
        pairs = [(0, sides)] if isinstance(sides, int) else [(int(step), int(side)) for step, side in sides]
    except (TypeError, ValueError) as error:
        raise complaint from error
    steps = [step for step, _ in pairs]
    if not pairs or steps[0] != 0 or sorted(steps) != steps or min(side for _, side in pairs) < 1:
        raise complaint
    return pairs
