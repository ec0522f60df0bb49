"""Which configuration files may tell Hydra itself what to do.

Hydra acts on its own nodes, such as `hydra.callbacks`, `hydra.job_logging` and `hydra.launcher`, before a program
sees its configuration: they call functions, set the environment and say where files go. The command line is its
user's own will, and conf/ is the program's. A file from anywhere else (--config-dir, --config-path,
hydra.searchpath) is a stranger's: it may describe a run, not command the machine.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from omegaconf import DictConfig, OmegaConf

from rendra_lab.errors import UserError

_OWN_SCHEMES = ("structured://", "pkg://hydra.", "pkg://hydra_plugins.")
_ALLOWED_BELOW_HYDRA = ("hydra.help", "hydra.sweeper.params")  # words, and what a search varies
_OF_THE_USER = ("output_root", "run_dir")  # where files go
_load = ConfigLoaderImpl._load_single_config
_trusted: set[Path] = set()


def watch_origins(*folders: Path) -> None:
    """From now on a file outside these folders that holds what only the command line may say is refused.

    The environment variable RENDRA_LAB_CONFIGS names further folders, separated by colons, whose files are trusted.
    Raises, when such a file is composed, UserError with the file's folder and the key.
    """
    _trusted.update(folder.resolve() for folder in folders)
    ConfigLoaderImpl._load_single_config = _load_and_check  # type: ignore[method-assign]


def trusted_folders() -> list[Path]:
    """Those that `watch_origins` was given."""
    return sorted(_trusted)


@functools.wraps(_load)
def _load_and_check(self: ConfigLoaderImpl, default: Any, repo: Any) -> Any:
    loaded = _load(self, default, repo)
    if not _is_trusted(str(loaded.path)) and isinstance(loaded.config, DictConfig):
        name = f"{str(loaded.path).removeprefix('file://')}/{default.config_path}.yaml"
        if ".." in Path(str(default.config_path)).parts:
            raise UserError(f"{name} lies outside its folder")
        tree = OmegaConf.to_container(loaded.config, resolve=False)
        assert isinstance(tree, Mapping)
        for key in _commands(tree):
            raise UserError(
                f"{name}: {key} may be set on the command line or in conf/, not by a file from elsewhere"
                " (RENDRA_LAB_CONFIGS names folders that you trust)"
            )
    return loaded


def _is_trusted(place: str) -> bool:
    if place.startswith(_OWN_SCHEMES):
        return True
    named = [Path(name) for name in os.environ.get("RENDRA_LAB_CONFIGS", "").split(os.pathsep) if name]
    folder = Path(place.removeprefix("file://"))
    return place.startswith("file://") and folder.resolve() in {*_trusted, *(name.resolve() for name in named)}


def _commands(tree: Mapping[Any, Any]) -> Iterator[str]:
    """The keys of a file that command the machine."""
    yield from (name for name in _OF_THE_USER if name in tree)
    yield from (key for key in _leaves(tree.get("hydra"), "hydra") if not _is_harmless(key))


def _is_harmless(key: str) -> bool:
    return any(key == allowed or key.startswith(f"{allowed}.") for allowed in _ALLOWED_BELOW_HYDRA)


def _leaves(node: Any, key: str) -> Iterator[str]:
    if isinstance(node, Mapping) and node:
        for name, value in node.items():
            yield from _leaves(value, f"{key}.{name}")
    elif node is not None:
        yield key
