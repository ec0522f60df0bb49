"""Generated places written as folders of real data sets, which `kitti` and `realestate` read.

A place becomes a sequence, or a film, of all of its views. Pairs of the test are listed in test_pairs.txt.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from rendra_lab.data.scene_folders import check_folder, folder_in_making
from rendra_lab.errors import UserError
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.tasks.synsin import kitti, realestate
from rendra_lab.tasks.synsin.generated_pairs import ViewPairs
from rendra_lab.tasks.synsin.pair_data import PairData

Places = Mapping[str, Sequence[PosedViews]]
"""Of train, val and test."""

_OURS = {"sequences", "poses", "train", "test", "frames", kitti.DIVISION_FILE, kitti.LIST_FILE}
_FRAME_US = 100_000  # microseconds from frame to frame
_SAME_PX = 1e-4  # that intrinsics of one sequence may differ by


def write_pairs(data: PairData, folder: str | Path, format: str, overwrite: bool = False) -> Path:
    """Write all pictures of generated places and their cameras; the folder appears when it is complete.

    Args:
        data: generated pairs, which are rendered now where no cache has them.
        folder: made, with its parents.
        format: kitti or realestate10k. KITTI's has one camera a sequence; RealEstate10K's texts of validation places
            lie among those of training.
        overwrite: replace a folder that was so written.

    Returns:
        The folder.

    Raises:
        UserError: an unknown format, a folder that is not empty, pairs that are no generated ones, or cameras that
            the format cannot hold.
    """
    if format not in FORMATS:
        raise UserError(f"format must be one of {', '.join(FORMATS)} for pairs of pictures, got {format!r}")
    folder = Path(folder).absolute()
    check_folder(folder, _OURS, "no folder of pairs has", overwrite)
    data.setup("fit")
    places = {split: _places(getattr(data.splits, split)) for split in ("train", "val", "test")}
    with folder_in_making(folder) as partial:
        FORMATS[format](places, partial)
    return folder


def _places(pairs: object) -> Sequence[PosedViews]:
    if not isinstance(pairs, ViewPairs):
        raise UserError(
            "data must be generated pairs, such as street_pairs or room_pairs: others lie in folders already"
        )
    return pairs.places


def _write_kitti(places: Places, folder: Path) -> None:
    """Camera 2 stands where camera 0 does, and the first view is the world."""
    (folder / "poses").mkdir()
    division: dict[str, list[str]] = {split: [] for split in places}
    for number, (split, views) in enumerate(_each(places)):
        name = f"{number:02d}"
        division[split].append(name)
        sequence = folder / "sequences" / name
        _save_pictures(views, sequence / "image_2", [f"{frame:06d}" for frame in range(len(views.rgb))])
        matrix = np.hstack([_one_camera(views), np.zeros((3, 1))])
        matrix[:2, 2] -= kitti.FIRST_PIXEL
        (sequence / "calib.txt").write_text(f"P2: {_spaced(matrix)}\n", encoding="utf-8")
        world_to_camera = views.world_to_camera.double().numpy()
        camera_to_world = world_to_camera[0] @ np.linalg.inv(world_to_camera)
        _write_lines(folder / "poses" / f"{name}.txt", (_spaced(pose[:3]) for pose in camera_to_world))
    (folder / kitti.DIVISION_FILE).write_text(json.dumps(division, indent=2) + "\n", encoding="utf-8")
    if division["test"]:
        _write_lines(folder / kitti.LIST_FILE, (f"{name}_000000 {name}_000001" for name in division["test"]))


def _write_realestate10k(places: Places, folder: Path) -> None:
    rows: list[str] = []
    for number, (split, views) in enumerate(_each(places)):
        part, name = ("test" if split == "test" else "train"), f"place{number:06d}"
        times = [str(frame * _FRAME_US) for frame in range(len(views.rgb))]
        _save_pictures(views, folder / "frames" / part / name, times)
        height, width = views.rgb.shape[2:]
        cameras = views.intrinsics.double().numpy()[:, [0, 1, 0, 1], [0, 1, 2, 2]] / [width, height, width, height]
        poses = views.world_to_camera.double().numpy()[:, :3].reshape(-1, 12)
        lines = [f"{time} {_spaced(c)} 0 0 {_spaced(p)}" for time, c, p in zip(times, cameras, poses, strict=True)]
        (folder / part).mkdir(exist_ok=True)
        _write_lines(folder / part / f"{name}.txt", [f"generated:{name}", *lines])
        if split == "test":
            camera = _spaced(realestate.LIST_SIDE * cameras[0])
            rows.append(f"{name} {times[0]} {times[1]} {camera} {_spaced(poses[0])} {_spaced(poses[1])}")
    if rows:
        _write_lines(folder / realestate.LIST_FILE, rows)


FORMATS: dict[str, Callable[[Places, Path], None]] = {"kitti": _write_kitti, "realestate10k": _write_realestate10k}


def _each(places: Places) -> Iterable[tuple[str, PosedViews]]:
    return ((split, views) for split, several in places.items() for views in several)


def _one_camera(views: PosedViews) -> npt.NDArray[np.float64]:
    """The intrinsics (3, 3) that all views have.

    Raises:
        UserError: they differ.
    """
    several: npt.NDArray[np.float64] = views.intrinsics.double().numpy()
    if np.abs(several - several[0]).max() > _SAME_PX:
        raise UserError("format=kitti has one camera for all frames of a sequence; choose format=realestate10k")
    return several[0]


def _save_pictures(views: PosedViews, folder: Path, names: Sequence[str]) -> None:
    folder.mkdir(parents=True)
    for rgb, name in zip(views.rgb, names, strict=True):
        Image.fromarray(rgb.permute(1, 2, 0).contiguous().numpy()).save(folder / f"{name}.png")


def _spaced(numbers: npt.NDArray[np.float64]) -> str:
    return " ".join(repr(float(number)) for number in numbers.ravel())


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
