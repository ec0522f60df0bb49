"""Views of a mesh that this library renders itself: a scene whose truth is known."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra.structures import Meshes
from rendra_lab.data.camera_rigs import look_at_origin, rig
from rendra_lab.data.kept_tensors import code_versions, kept_or_made
from rendra_lab.data.mesh_photographs import MeshPhotographer, Shots
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import Scene, SceneViews
from rendra_lab.data.scene_box import estimate_box
from rendra_lab.errors import UserError

_EDITION = "2"  # of the pictures; another one makes all cached ones anew
_TEXTURE_PARTS = ("maps_padded", "faces_uvs_padded", "verts_uvs_padded", "verts_features_packed", "atlas_packed")
_TEXTURE_MODES = ("padding_mode", "sampling_mode", "align_corners")


class RenderedScene(SceneViews):
    """Photographs of a mesh by cameras about it that look at the origin.

    Args:
        mesh: a batch of one, with a texture.
        lights: of rendra.renderer; they stand still while the cameras move.
        image_size: side of square images, or [height, width], in pixels.
        views: sphere, ring or forward; see `camera_rigs.rig`.
        counts: training, validation and test views.
        distance: of the cameras from the origin.
        fov_deg: field of view of the short side.
        distortion: of the lens, in OpenCV's order k1 k2 p1 p2 k3 ...; null for none.
        antialias: samples of a pixel along each of its sides.
        cache: folder of rendered views; null renders them every time.
        views_seed: turns the cameras of a sphere.
        **rays: see SceneViews.
    """

    def __init__(
        self,
        mesh: Meshes,
        lights: Any,
        image_size: int | Sequence[int] = 128,
        views: str = "sphere",
        counts: Sequence[int] = (40, 4, 10),
        distance: float = 2.7,
        fov_deg: float = 60.0,
        distortion: Sequence[float] | None = None,
        antialias: int = 4,
        cache: str | Path | None = None,
        views_seed: int = 0,
        **rays: Any,
    ) -> None:
        super().__init__(**rays)
        if not callable(getattr(lights, "diffuse", None)):
            raise UserError(
                f"{type(lights).__name__} moves with the camera; these views need a light that stands still"
            )
        size = [image_size] * 2 if isinstance(image_size, int) else list(image_size)
        if len(size) != 2 or not all(isinstance(side, int) and 1 <= side <= 16384 for side in size):
            raise UserError(f"data.image_size must be one side or [height,width] in whole pixels, got {image_size!r}")
        if len(counts) != 3:
            raise UserError(f"data.counts are three: training, validation and test views; got {list(counts)}")
        self.mesh = mesh
        self.photographer = MeshPhotographer(mesh, lights, antialias)
        self.cache = None if cache is None else Path(cache)
        self.distance = distance
        positions = rig(views, (counts[0], counts[1], counts[2]), distance, views_seed)
        self.splits = {name: len(places) for name, places in zip(("train", "val", "test"), positions, strict=True)}
        labels = [f"{name}/{index:03d}" for name, count in self.splits.items() for index in range(count)]
        R, T = look_at_origin(torch.cat(positions))
        self.shots = Shots.alike(labels, R, T, (size[0], size[1]), fov_deg, distortion or ())

    def load(self) -> Scene:
        """All views, rendered or from the cache.

        Raises:
            UserError: nothing of the mesh is seen in one of them.
        """
        pixels = self._cached_or_taken()
        images = PosedImages(
            labels=self.shots.labels,
            pixels=pixels,
            sizes=self.shots.sizes,
            intrinsics=self.shots.intrinsics,
            distortion=self.shots.distortion,
            fisheye=torch.zeros(len(self.shots), dtype=torch.bool),
            R=self.shots.R,
            T=self.shots.T,
            has_alpha=True,
        )
        self._check_visible(images)
        first, second = self.splits["train"], self.splits["train"] + self.splits["val"]
        train = images.select(range(first))
        return Scene(
            train=train,
            val=images.select(range(first, second)),
            test=images.select(range(second, len(images))),
            box=estimate_box(train),
            truth=self.mesh,
            up=(0.0, 1.0, 0.0),
        )

    def _cached_or_taken(self) -> Tensor:
        """The pixels of all views: (P, 4) uint8."""
        if self.cache is None:
            return self._take()
        path = self.cache / f"views_{fingerprint(self.photographer, self.shots)}.safetensors"
        return kept_or_made(path, "views", lambda: {"pixels": self._take()})["pixels"]

    def _take(self) -> Tensor:
        return torch.cat([image.reshape(-1, 4) for image in self.photographer.take(self.shots)])

    def _check_visible(self, images: PosedImages) -> None:
        bounds = images.first_pixel.tolist()
        for label, first, last in zip(images.labels, bounds, bounds[1:], strict=False):
            if not bool(images.pixels[first:last, 3].any()):
                low, high = (
                    " ".join(f"{x:.4g}" for x in corner.tolist()) for corner in _bounds(self.mesh.verts_packed())
                )
                raise UserError(
                    f"nothing of the mesh is seen in view {label}: the cameras stand {self.distance:g} from the "
                    f"origin (data.distance) and look at it, and the mesh reaches from ({low}) to ({high}); "
                    "mesh.normalize=max_abs moves it to the origin and makes it 2 units large"
                )


def fingerprint(photographer: MeshPhotographer, shots: Shots) -> str:
    """24 hexadecimal digits that stand for everything that determines the pixels of photographs."""
    digest = hashlib.sha256()
    for part in _determinants(photographer, shots):
        if isinstance(part, Tensor):
            digest.update(f"{part.dtype}{tuple(part.shape)}".encode())
            digest.update(part.detach().cpu().contiguous().numpy().tobytes())
        else:
            digest.update(f"{part!r};".encode())
    return digest.hexdigest()[:24]


def _determinants(photographer: MeshPhotographer, shots: Shots) -> Iterator[Any]:
    mesh, lights, textures = photographer.mesh, photographer.lights, photographer.mesh.textures
    yield from (_EDITION, *code_versions(), str(mesh.device), photographer.antialias)
    yield from (mesh.verts_packed(), mesh.faces_packed(), type(textures).__name__)
    yield from (getattr(textures, name)() for name in _TEXTURE_PARTS if hasattr(textures, name))
    yield from (getattr(textures, name, None) for name in _TEXTURE_MODES)
    yield type(lights).__name__
    for name, value in sorted(vars(lights).items()):
        if isinstance(value, Tensor):
            yield from (name, value)
    yield from (shots.sizes, shots.intrinsics, shots.distortion, shots.R, shots.T)


def _bounds(verts: Tensor) -> tuple[Tensor, Tensor]:
    return verts.amin(0), verts.amax(0)
