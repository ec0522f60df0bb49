"""Generated people, whose bodies are known: joints as a detector would give them, and pictures to look at."""

from __future__ import annotations

import hashlib
import json
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from rendra.body import SMPL
from rendra_lab.data.kept_tensors import code_versions, kept_or_made
from rendra_lab.data.scene_folders import check_folder
from rendra_lab.errors import UserError
from rendra_lab.settings import Fraction, Positive, check_numbers
from rendra_lab.synthesis.people import Crowd, Painter, draw_crowd
from rendra_lab.tasks.smplify.markers import MarkerSet
from rendra_lab.tasks.smplify.people_data import PeopleData, Picture
from rendra_lab.tasks.smplify.records import LSP_JOINTS, BodyTruth, PeopleBatch, joint_weights
from rendra_lab.tasks.smplify.task import picture_markers, project

_EDITION = "1"  # of the pictures; another one makes all cached ones anew
_SWAPS = (("knee", "ankle"), ("elbow", "wrist"))  # what detectors mistake for that of the other side, together
_UNEVEN = 0.5  # how much some joints are harder to find than others
_OURS = {"images", "people.json", "est_joints.npz"}


class GeneratedPeople(PeopleData):
    """Bodies of all shapes in natural poses, one in each picture, and where a detector found their joints.

    Args:
        body: of SMPL's 24 joints; its own vertices are the truth.
        count: people.
        image_size: side of square pictures, or [height, width], pixels.
        noise_px: standard deviation of a joint's x and of its y; some joints have more than others, and those get
            little confidence.
        missing: share of the joints that were not found: confidence 0.
        swapped: how often the lower arms, and the lower legs, are taken for those of the other side.
        seed: of everything.
        cache: folder of painted pictures; null paints them every time.
        steps: optimisation steps an epoch.

    Raises:
        UserError: an impossible setting.
    """

    crowd: Crowd

    def __init__(
        self,
        body: SMPL,
        count: int = 200,
        image_size: int | Sequence[int] = 256,
        noise_px: float = 3.0,
        missing: float = 0.1,
        swapped: float = 0.02,
        seed: int = 0,
        cache: str | Path | None = None,
        steps: int = 10_000,
    ) -> None:
        super().__init__(steps)
        check_numbers("data", Positive, count=count)
        check_numbers("data", Fraction, missing=missing, swapped=swapped)
        if not 0 <= noise_px < 1e6:
            raise UserError(f"data.noise_px must be at least 0, got {noise_px}")
        size = [image_size] * 2 if isinstance(image_size, int) else list(image_size)
        if len(size) != 2 or not all(isinstance(side, int) and 16 <= side <= 8192 for side in size):
            raise UserError(
                f"data.image_size must be one side or [height,width], 16 to 8192 pixels, got {image_size!r}"
            )
        self.body, self.count, self.size = body, count, (size[0], size[1])
        self.noise_px, self.missing, self.swapped = noise_px, missing, swapped
        self.seed = seed
        self.cache = None if cache is None else Path(cache)

    def load(self) -> PeopleBatch:
        """Everyone."""
        try:
            self.crowd = crowd = draw_crowd(self.body, self.count, self.size, self.seed)
        except ValueError as error:
            raise UserError(f"body: {error}") from error
        markers = MarkerSet(self.body, picture_markers(self.body))
        points = markers(torch.cat([crowd.pose.flatten(1), crowd.betas, crowd.translation], dim=1)).points
        clean_px = project(points, crowd.focal_px, crowd.center_px)
        generator = torch.Generator().manual_seed(self.seed + 104_729)
        joints_px, confidence = detected(clean_px, self.noise_px, self.missing, self.swapped, generator)
        self.painter = Painter(self.body)
        self.fingerprint = self._fingerprint()
        return PeopleBatch(
            joints_px=joints_px,
            confidence=confidence,
            size_px=torch.tensor(self.size).float().expand(self.count, 2).clone(),
            focal_px=crowd.focal_px,
            center_px=crowd.center_px.clone(),
            weight=joint_weights(self.count, hips_and_neck=1.0),  # the body's own joints
            pictures=tuple(f"person_{index:04d}" for index in range(self.count)),
            truth=BodyTruth(
                crowd.pose.flatten(1), crowd.betas, crowd.translation, crowd.joints, crowd.verts, clean_px
            ),
        )

    def load_picture(self, index: int) -> Picture:
        """A person in front of a background, painted now or taken from the cache."""
        if self.cache is None:
            return self.painter.paint(self.crowd, index, self.seed)
        path = self.cache / f"people_{self.fingerprint}_{index:05d}.safetensors"
        return kept_or_made(path, "picture", lambda: {"rgb": self._painted(index)})["rgb"].numpy()

    def write(self, folder: str | Path, overwrite: bool = False) -> Path:
        """Everyone as a folder, which appears when it is complete.

        images/im0001.png ... hold the pictures, est_joints.npz what was detected, as `data=lsp` reads it, and
        people.json that too, as `data=joints_json` reads it, with the truth and the cameras.

        Returns:
            The folder.

        Raises:
            UserError: it is there already, and something else than such a folder or not to be replaced.
        """
        folder = Path(folder).absolute()
        check_folder(folder, _OURS, "is none of these files", overwrite)
        self.setup("fit")
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}.partial")
        try:
            (partial / "images").mkdir(parents=True)
            self._write(partial)
            if folder.exists():
                shutil.rmtree(folder)
            partial.rename(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        return folder

    def _write(self, folder: Path) -> None:
        people = self.people
        names = [f"im{index + 1:04d}.png" for index in range(self.count)]
        for index, name in enumerate(names):
            Image.fromarray(self.load_picture(index)).save(folder / "images" / name)
        found = torch.cat([people.joints_px, people.confidence[..., None]], dim=2)  # (N, K, 3)
        np.savez(folder / "est_joints.npz", est_joints=found.permute(2, 1, 0).numpy())
        persons = [self._as_json(index, f"images/{name}", found[index]) for index, name in enumerate(names)]
        content = {"layout": "lsp14", "units": "pixels, metres, radians", "pictures": persons}
        (folder / "people.json").write_text(json.dumps(content, indent=1) + "\n")

    def _as_json(self, index: int, picture: str, found: Tensor) -> dict[str, Any]:
        people, truth = self.people, self.people.truth
        assert truth is not None
        known = {name: getattr(truth, name)[index].tolist() for name in ("pose", "betas", "translation", "clean_px")}
        return {
            "file_name": picture,
            "height": self.size[0],
            "width": self.size[1],
            "people": [{"joints": found.tolist()}],  # x, y, confidence
            "focal_px": float(people.focal_px[index]),
            "center_px": people.center_px[index].tolist(),
            "doing": self.crowd.doing[index],
            "truth": known | {"joints": truth.joints[index].tolist()},
        }

    def _painted(self, index: int) -> Tensor:
        return torch.from_numpy(self.painter.paint(self.crowd, index, self.seed))

    def _fingerprint(self) -> str:
        """24 hexadecimal digits that stand for everything that determines the pictures."""
        digest = hashlib.sha256()
        digest.update(repr((_EDITION, *code_versions(), self.size, self.seed)).encode())
        tensors = (*self.body.buffers(), self.crowd.verts, self.crowd.focal_px)
        for tensor in tensors:
            digest.update(repr(tuple(tensor.shape)).encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:24]


def detected(
    clean_px: Tensor, noise_px: float, missing: float, swapped: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """What a detector of joints makes of LSP's joints.

    Args:
        clean_px: (N, 14, 2) where they are.
        noise_px: standard deviation of x and y, over all joints.
        missing: share that is not found.
        swapped: share of the lower arms, and of the lower legs, that change sides.
        generator: makes all choices.

    Returns:
        Joints (N, 14, 2), and confidences (N, 14) in [0, 1]: 1 where noise_px is 0, less where noise is more than
        usual and where sides were mistaken, 0 where nothing was found, at (0, 0).
    """
    joints_px, count = clean_px.clone(), len(clean_px)
    effort = (_UNEVEN * torch.randn(clean_px.shape[:2], generator=generator) - _UNEVEN**2).exp()  # of mean square 1
    confidence = (-0.25 * effort.square()).exp() if noise_px > 0 else torch.ones_like(effort)
    for parts in _SWAPS:
        wrong = torch.rand(count, generator=generator) < swapped
        one, other = ([LSP_JOINTS.index(f"{side}_{part}") for part in parts] for side in ("left", "right"))
        both, crossed = [*one, *other], [*other, *one]
        joints_px[:, both] = torch.where(wrong[:, None, None], clean_px[:, crossed], joints_px[:, both])
        confidence[:, both] *= torch.where(wrong, 0.7, 1.0)[:, None]
    noise = torch.randn(clean_px.shape, generator=generator)
    joints_px += noise_px * effort[..., None] * noise
    lost = torch.rand(confidence.shape, generator=generator) < missing
    return joints_px.masked_fill(lost[..., None], 0), confidence.masked_fill(lost, 0)
