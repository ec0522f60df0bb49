"""What a run was told: its settings that differ from the defaults of its task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_ABSENT = object()


@dataclass
class Settings:
    """The configuration of a run beside the defaults of its task; rows are (key, default, value)."""

    command_words: list[str] = field(default_factory=list)  # overrides, as typed
    choices: list[tuple[str, str, str]] = field(default_factory=list)  # groups
    told: list[tuple[str, str, str]] = field(default_factory=list)  # keys that the command named
    implied: list[tuple[str, str, str]] = field(default_factory=list)  # keys that follow from the choices
    note: str | None = None  # why there is no comparison
    text: str = ""  # the whole configuration


def read_settings(folder: Path) -> Settings:
    """Compares `.hydra/config.yaml` of a run with what its task is without overrides.

    Both are compared as they are written, before interpolation: a changed seed is one row, not one a part that
    takes it. Where the configurations are not at hand any more, `note` says so.
    """
    source = folder / ".hydra" / "config.yaml"
    if not source.is_file():
        return Settings(note="The configuration of this run was not kept.")
    settings = Settings(text=source.read_text(encoding="utf-8", errors="replace"))
    try:
        known = _read_yaml(folder / ".hydra" / "hydra.yaml")["hydra"]
        settings.command_words = [str(word) for word in known["overrides"]["task"]]
        default, default_choices = _defaults(known)
        _compare(settings, source, known["runtime"]["choices"], default, default_choices)
    except Exception as error:  # foreign files and another version's configurations: whatever they hold
        reason = " ".join(str(error).split())[:200]
        settings.note = (
            f"The defaults of this task cannot be composed here any more ({type(error).__name__}: {reason})."
        )
    return settings


def _compare(
    settings: Settings,
    source: Path,
    choices: Mapping[str, Any],
    default: Mapping[str, Any],
    default_choices: Mapping[str, Any],
) -> None:
    from omegaconf import OmegaConf

    names = [name for name in {**default_choices, **choices} if not name.startswith("hydra")]
    settings.choices = _differences(
        {name: default_choices.get(name) for name in names}, {name: choices.get(name) for name in names}
    )
    given = OmegaConf.to_container(OmegaConf.load(source), resolve=False)
    named = [word.partition("=")[0].lstrip("+~").partition("@")[0] for word in settings.command_words]
    for row in _differences(dict(_leaves(default)), dict(_leaves(given))):
        direct = any(row[0] == key or row[0].startswith(f"{key}.") for key in named)
        chosen = any(key == name for key in named for name in choices if row[0].split(".")[0] == name)
        (settings.told if direct and not chosen else settings.implied).append(row)


def _defaults(known: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The composed configuration of a run's task alone, and its choices of groups; Hydra is left as it was."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from omegaconf import OmegaConf

    words = [word for word in known["overrides"]["hydra"] if word.startswith("hydra.searchpath=")]
    task = known["runtime"]["choices"].get("task")
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(_config_folder(known)), version_base="1.3"):
            chosen = [] if task is None else [f"task={task}"]
            composed = compose(known["job"]["config_name"], [*words, *chosen], return_hydra_config=True)
        tree = OmegaConf.to_container(composed, resolve=False)
    finally:
        GlobalHydra.instance().hydra = running
    assert isinstance(tree, dict)
    return {str(key): value for key, value in tree.items() if key != "hydra"}, tree["hydra"]["runtime"]["choices"]


def _config_folder(known: Mapping[str, Any]) -> Path:
    """Where the run had its configurations from; else those of this checkout."""
    for source in known["runtime"]["config_sources"]:
        if source["provider"] == "main" and Path(source["path"]).is_dir():
            return Path(source["path"])
    return Path(__file__).parents[3] / "conf"


def _read_yaml(path: Path) -> Any:
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    return yaml.load(path.read_text(encoding="utf-8"), Loader=loader)


def _leaves(tree: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys of values; lists and empty groups are values."""
    if isinstance(tree, dict) and (tree or not key):
        for name, value in tree.items():
            yield from _leaves(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, tree


def _differences(default: Mapping[str, Any], given: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    return [
        (key, _shown(default.get(key, _ABSENT)), _shown(given.get(key, _ABSENT)))
        for key in {**default, **given}
        if default.get(key, _ABSENT) != given.get(key, _ABSENT) and key != "run_dir"
    ]


def _shown(value: Any) -> str:
    if value is _ABSENT:
        return "(absent)"
    if isinstance(value, bool):
        return str(value).lower()
    return "null" if value is None else str(value)
