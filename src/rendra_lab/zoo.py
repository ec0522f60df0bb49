"""Trained networks that are kept beside the code, so that what is shown with them works at once.

A folder of the zoo holds `weights.safetensors`, the weights of one part of a task; `part.yaml`, the configuration
that builds that part; and `card.md`: data, command, time, scores. Nothing of it can run code: weights are numbers,
and what the configuration calls is checked as that of any run.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn
from yaml import YAMLError

from rendra_lab.checkpoint_archive import FORMAT
from rendra_lab.checkpoints import check_module, must_fit, read_weights
from rendra_lab.errors import UserError
from rendra_lab.report import format_number, markdown_table, shown_metrics, write_text
from rendra_lab.targets import check_targets
from rendra_lab.weights_file import read_weights_file, write_weights_file

MOST_MB = 4.0
"""Of the weights of one network, in MB of 10^6 bytes: a repository is no place for more."""

_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")
_OF_ONE_MACHINE = ("hydra.", "output_root", "run_dir", "ckpt_path", "threads")  # settings that no card repeats


def names(zoo: Path) -> list[str]:
    """What is kept in a folder; nothing where there is none."""
    return sorted(path.parent.name for path in zoo.glob("*/part.yaml"))


def load(name: str, zoo: Path) -> nn.Module:
    """A kept network with its weights, ready to be used.

    Args:
        name: of its folder.
        zoo: the folder of all.

    Raises:
        UserError: there is none of that name, or it is damaged.
    """
    known = names(zoo)
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(known) or 'none'}"
        raise UserError(f"the zoo keeps no {name!r}; {hint}")
    folder = zoo / name
    try:
        tree = OmegaConf.to_container(OmegaConf.load(folder / "part.yaml"))
    except YAMLError as error:
        raise UserError(f"{folder / 'part.yaml'} is damaged: {' '.join(str(error).split())}") from error
    if not isinstance(tree, dict) or not isinstance(tree.get("part"), dict):
        raise UserError(f"{folder / 'part.yaml'} is damaged: it does not say how the part is built")
    weights, owner = read_weights_file(folder / "weights.safetensors")
    check_module(folder / "weights.safetensors", owner, tree["part"].get("_target_"))
    return _built(tree["part"], weights, str(folder))


def keep(
    run: Path, name: str, zoo: Path, part: str = "averaged", key: str = "module.generator", weights: str = "last"
) -> Path:
    """Takes a part of what a run trained into the zoo.

    Args:
        run: folder of a finished run.
        name: of the new folder: small letters, digits, underscores.
        zoo: the folder of all.
        part: the task's attribute whose weights are kept.
        key: of the configuration that builds such a part.
        weights: last, best, or a checkpoint file.

    Returns:
        The new folder.

    Raises:
        UserError: a name that cannot be or is taken, a folder without a finished run, no such part, too many weights.
    """
    if not _NAME.fullmatch(name):
        raise UserError(f"a name in the zoo has small letters, digits and underscores, got {name!r}")
    folder = zoo / name
    if folder.exists():
        raise UserError(f"the zoo keeps a {name} already: remove {folder} first")
    tree, network = _part(run, part, key, weights)
    record, own = _record(run), network.state_dict()
    size = sum(each.numel() * each.element_size() for each in own.values()) / 1e6
    if size > MOST_MB:
        raise UserError(
            f"{part} of {run} has {size:.1f} MB of weights; the zoo keeps up to {MOST_MB:g} MB of a network"
        )
    metadata = {"format": FORMAT, "task": record.get("task"), "module": tree["_target_"], "part": part}
    write_weights_file(folder / "weights.safetensors", own, metadata)
    write_text(folder / "card.md", card(name, record, _choices(run), sum(each.numel() for each in own.values())))
    write_text(folder / "part.yaml", OmegaConf.to_yaml(OmegaConf.create({"task": record.get("task"), "part": tree})))
    return folder


def part_of_run(run: Path, part: str, key: str, weights: str = "last") -> nn.Module:
    """A part of what a run trained, ready to be used; the rest of it, and its data, are not made again.

    Args:
        run: folder of the run.
        part, key, weights: as of `keep`.

    Raises:
        UserError: a folder without a run, no such part or weights.
    """
    return _part(run, part, key, weights)[1]


def card(name: str, record: Mapping[str, Any], choices: Mapping[str, Any], parameters: int) -> str:
    """What there is to know of a kept network, in Markdown.

    Args:
        name: in the zoo.
        record: what the run wrote into metrics.json.
        choices: of the groups of its configuration: data, network, ...
        parameters: numbers that were kept.
    """
    overrides = [item for item in record.get("overrides", []) if not item.lstrip("+~").startswith(_OF_ONE_MACHINE)]
    seconds = record.get("seconds", {})
    facts = {
        "data": choices.get("data"),
        "network": choices.get("network"),
        "parameters": f"{parameters:,}",
        "command": f"`{' '.join(['python train.py', *overrides])}`",
        "seed": record.get("seed"),
        "steps": record.get("steps"),
        "time": f"{seconds.get('fit', seconds.get('total', 0.0)) / 60:.1f} min on {record.get('device') or 'cpu'}",
        "code": record.get("git_commit"),
    }
    lines = [f"- {title}: {fact}" for title, fact in facts.items() if fact is not None]
    scores = [["score", "value"], *([each, format_number(value)] for each, value in _scores(record).items())]
    table = markdown_table(scores) if len(scores) > 1 else ["The run ended before it was tested."]
    return "\n".join([f"# {name}", "", *lines, "", *table]) + "\n"


def _scores(record: Mapping[str, Any]) -> dict[str, float]:
    return {name: value for name, value in shown_metrics(record.get("metrics", {})).items() if value is not None}


def _part(run: Path, part: str, key: str, weights: str) -> tuple[dict[str, Any], nn.Module]:
    """The configuration of a part, and the part."""
    source = run / ".hydra" / "config.yaml"
    if not source.is_file():
        raise UserError(f"{run} is not the folder of a run: it has no .hydra/config.yaml")
    cfg = OmegaConf.load(source)
    assert isinstance(cfg, DictConfig)
    cfg.run_dir = str(run)
    node = OmegaConf.select(cfg, key)
    if not isinstance(node, DictConfig) or "_target_" not in node:
        task = str(OmegaConf.select(cfg, "module._target_")).rpartition(".")[2]
        raise UserError(f"{run} has no {part}: its task is {task}, whose configuration builds nothing at {key}")
    tree = OmegaConf.to_container(node, resolve=True)
    assert isinstance(tree, dict)
    every = read_weights(run, weights, OmegaConf.select(cfg, "module._target_"))
    own = {place.removeprefix(f"{part}."): each for place, each in every.items() if place.startswith(f"{part}.")}
    if not own:
        parts = ", ".join(sorted({place.partition(".")[0] for place in every}))
        raise UserError(f"{run} has no part {part} with weights; it has: {parts}")
    return {str(name): each for name, each in tree.items()}, _built(tree, own, f"{part} of {run}")


def _built(tree: Any, weights: Mapping[str, Tensor], source: str) -> nn.Module:
    """The part that a configuration describes, with weights, for use and not for training."""
    check_targets({"part": tree})
    part = instantiate(tree, _convert_="all")
    if not isinstance(part, nn.Module):
        raise UserError(f"{source} is no network, but a {type(part).__name__}")
    with must_fit(source):
        part.load_state_dict(dict(weights))
    return part.eval().requires_grad_(False)


def _record(run: Path) -> dict[str, Any]:
    try:
        record = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{run} says nothing of its end: metrics.json: {error}") from error
    if not isinstance(record, dict):
        raise UserError(f"{run / 'metrics.json'} is damaged: it holds no mapping")
    return record


def _choices(run: Path) -> dict[str, Any]:
    """What the run chose of each group; nothing where it was not started by Hydra."""
    source = run / ".hydra" / "hydra.yaml"
    if not source.is_file():
        return {}
    chosen = OmegaConf.to_container(OmegaConf.load(source), resolve=False)
    hydra = chosen.get("hydra", {}) if isinstance(chosen, dict) else {}
    return dict(hydra.get("runtime", {}).get("choices", {}))
