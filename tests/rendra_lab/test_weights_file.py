"""Weights alone: what comes back is what went in, and what is damaged is told."""

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from rendra_lab.checkpoint_archive import FORMAT, CheckpointError
from rendra_lab.weights_file import read_weights_file, write_weights_file

METADATA = {"format": FORMAT, "task": "pose", "module": "here.Pose", "config": {"seed": 0}}


def test_all_kinds_come_back(tmp_path: Path) -> None:
    shared = torch.arange(12.0).reshape(3, 4)
    kinds = (torch.float64, torch.bfloat16, torch.int64, torch.bool, torch.complex64)
    weights = {str(kind): torch.ones(3, dtype=kind) for kind in kinds}
    weights |= {"scalar": torch.tensor(2.0), "empty": torch.zeros(0, 3), "tied": shared, "again": shared.T}
    path = tmp_path / "weights.safetensors"
    write_weights_file(path, weights, METADATA)
    back, module = read_weights_file(path)
    assert module == "here.Pose"
    assert back.keys() == weights.keys()
    for name, tensor in weights.items():
        assert back[name].dtype == tensor.dtype
        assert torch.equal(back[name], tensor)
    with safe_open(path, framework="pt") as file:
        assert '"task": "pose"' in file.metadata()["rendra_lab"]
    assert list(tmp_path.iterdir()) == [path]


def test_those_of_other_programs_are_read(tmp_path: Path) -> None:
    save_file({"a": torch.ones(2)}, tmp_path / "theirs.safetensors")
    weights, module = read_weights_file(tmp_path / "theirs.safetensors")
    assert torch.equal(weights["a"], torch.ones(2))
    assert module is None


def test_damage_is_told(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    write_weights_file(path, {"a": torch.arange(100.0)}, METADATA)
    content = path.read_bytes()
    for share in (0, 0.01, 0.5, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(CheckpointError, match=r"weights.safetensors is damaged: "):
            read_weights_file(path)
    for place in (-1, -200, 0, 7, 20):
        damaged = bytearray(content)
        damaged[place] ^= 0x20
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=r"weights.safetensors is damaged: "):
            read_weights_file(path)


def test_a_format_from_the_future_is_told(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    with pytest.raises(CheckpointError, match=f"has format {FORMAT + 1}, newer than"):
        write_weights_file(path, {"a": torch.ones(1)}, {**METADATA, "format": FORMAT + 1})
    assert not list(tmp_path.iterdir())
