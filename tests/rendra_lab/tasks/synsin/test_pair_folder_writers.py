"""What our writers write of generated places, our readers read: the same pictures, intrinsics and motions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pair_files import kitti_folder, realestate_folder
from scene_files import transforms_folder

from rendra.transforms import so3_exp_map
from rendra_lab.errors import UserError
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.targets import check_targets
from rendra_lab.tasks.synsin import pair_folder_writers
from rendra_lab.tasks.synsin.generated_pairs import GeneratedPairs
from rendra_lab.tasks.synsin.kitti import KittiPairs
from rendra_lab.tasks.synsin.pair_data import PairData
from rendra_lab.tasks.synsin.pair_folder_writers import write_pairs
from rendra_lab.tasks.synsin.realestate import RealEstate10K
from rendra_lab.tasks.synsin.records import PairBatch

SIZE = [10, 14]


class Noise:
    """Places of noise, seen by cameras of every kind."""

    def __init__(self, zooms: bool = False) -> None:
        self.zooms = zooms

    def settings(self) -> tuple[object, ...]:
        return (1, self.zooms)

    def views(self, seed: int, count: int, size: tuple[int, int]) -> PosedViews:
        generator = torch.Generator().manual_seed(seed % 2**31)
        rgb = torch.randint(256, (count, 3, *size), generator=generator, dtype=torch.uint8)
        world_to_camera = torch.eye(4).repeat(count, 1, 1)
        world_to_camera[:, :3, :3] = so3_exp_map(torch.randn(count, 3, generator=generator))
        world_to_camera[:, :3, 3] = 3 * torch.randn(count, 3, generator=generator)
        intrinsics = torch.tensor([[11.3, 0, 6.8], [0, 9.1, 5.3], [0, 0, 1]]).repeat(count, 1, 1)
        if self.zooms:
            intrinsics[:, 0, 0] += torch.arange(count)
        return PosedViews(rgb, torch.ones(count, 1, *size), intrinsics, world_to_camera)


def generated(zooms: bool = False, counts: tuple[int, int, int] = (3, 2, 2)) -> GeneratedPairs:
    return GeneratedPairs(Noise(zooms), image_size=SIZE, counts=counts, views_per_scene=3)


def same(one: PairBatch, other: PairBatch) -> None:
    for name in ("input", "target", "intrinsics", "target_intrinsics", "input_to_target"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=0, atol=1e-5)


def read(folder: Path, format: str) -> PairData:
    kind: Any = {"kitti": KittiPairs, "realestate10k": RealEstate10K}[format]
    data = kind(folder, image_size=SIZE, batch_size=2)
    data.setup("fit")
    return data


@pytest.mark.parametrize("format", ["kitti", "realestate10k"])
def test_pairs_come_back(tmp_path: Path, format: str) -> None:
    data = generated()
    folder = write_pairs(data, tmp_path / "made", format)
    back = read(folder, format)
    assert len(back.splits.test) == 2
    for index in range(2):
        same(back.splits.test[index], data.splits.test[index])
    originals = [pair for split in ("train", "val") for pair in (all_pairs(getattr(data.splits, split)))]
    for split in (back.splits.train, back.splits.val):
        for index in range(len(split)):
            torch.manual_seed(index)
            pair = split[index]
            original = [one for one in originals if torch.equal(one.input, pair.input)]
            original = [one for one in original if torch.equal(one.target, pair.target)]
            assert len(original) == 1
            same(pair, original[0])


def all_pairs(pairs: Any) -> list[PairBatch]:
    """Both ways."""
    pairs.pairs = [(i, j) for i in range(len(pairs.places[0].rgb)) for j in range(len(pairs.places[0].rgb)) if i != j]
    return [pairs[index] for index in range(len(pairs))]


def test_several_cameras_of_a_place(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"format=kitti has one camera for all frames.*choose format=realestate10k"):
        write_pairs(generated(zooms=True), tmp_path / "made", "kitti")
    assert not any(tmp_path.iterdir())
    data = generated(zooms=True)
    back = read(write_pairs(data, tmp_path / "made", "realestate10k"), "realestate10k")
    # a list has one camera for both; texts have one for each frame
    assert float(back.splits.val[0].intrinsics[0, 0, 0]) != float(back.splits.val[0].target_intrinsics[0, 0, 0])


def test_no_test_places_no_list(tmp_path: Path) -> None:
    for format in ("kitti", "realestate10k"):
        assert not (write_pairs(generated(counts=(2, 1, 0)), tmp_path / format, format) / "test_pairs.txt").exists()


def test_a_folder_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kitti_folder(tmp_path / "mine")
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="is not empty: choose another folder, or overwrite=true"):
        write_pairs(generated(), tmp_path / "mine", "kitti")
    with pytest.raises(UserError, match=r"'thesis.tex', which no folder of pairs has"):
        write_pairs(generated(), tmp_path / "mine", "kitti", overwrite=True)
    (tmp_path / "mine" / "thesis.tex").unlink()
    write_pairs(generated(), tmp_path / "mine", "realestate10k", overwrite=True)
    assert not (tmp_path / "mine" / "poses").exists()

    def fails(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(pair_folder_writers, "_write_lines", fails)
    with pytest.raises(OSError, match="no space left"):
        write_pairs(generated(), tmp_path / "other", "kitti")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_what_cannot_be_is_said(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match="format must be one of kitti, realestate10k for pairs of pictures, got 'llff'"
    ):
        write_pairs(generated(), tmp_path / "made", "llff")
    with pytest.raises(UserError, match="data must be generated pairs"):
        write_pairs(KittiPairs(kitti_folder(tmp_path / "kitti")), tmp_path / "made", "realestate10k")


@pytest.mark.parametrize("name", ["kitti", "realestate10k", "image_pairs"])
def test_configurations_read_folders(tmp_path: Path, name: str, compose: Callable[..., Any]) -> None:
    makers = {"kitti": kitti_folder, "realestate10k": realestate_folder, "image_pairs": transforms_folder}
    path = makers[name](tmp_path / "folder")
    tree = OmegaConf.to_container(
        compose(tmp_path / "a" / "b", f"data={name}", f"data.path={path}").data, resolve=True
    )
    check_targets(tree, "data")
    data = instantiate(tree, _convert_="all")
    data.setup("fit")
    assert data.splits.test[0].input.shape == (1, 3, 128, 128)


def test_the_program_says_which_formats_are_for_pairs(
    program: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    folder = kitti_folder(tmp_path / "kitti")
    code, _, err = program("scripts/generate_data.py", "data=kitti", f"data.path={folder}", "output=made")
    assert code == 2
    assert "format must be one of kitti, realestate10k for pairs of pictures, got 'nerf_blender'" in err
