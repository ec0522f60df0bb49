"""What stands between a command line and Hydra: mistakes are answered in one line, with what was meant."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException, InstantiationException, MissingConfigException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rendra_lab.errors import UserError
from rendra_lab.sweep import conclude_sweep

_EXIT_MISTAKE = 2  # the command or the configuration cannot be
_EXIT_FAILURE = 1  # the run failed


def guarded(main: Callable[[], Any], script: str, config_path: str, config_name: str) -> None:
    """Runs a `@hydra.main` function as a program.

    A mistake in the command or the configuration ends in one line on stderr that says what was probably
    meant, and exit code 2; a failed run in code 1. A sweep ends with its table, also after a failure.
    With HYDRA_FULL_ERROR=1 in the environment every traceback is shown.

    Args:
        main: the decorated function.
        script: `__file__` of the program.
        config_path: the folder of configurations, relative to the program.
        config_name: of the primary configuration.
    """
    verbose = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands its exceptions over instead of printing them
    FailureKeeper.active = True
    try:
        main()
        if FailureKeeper.failure is not None:
            raise FailureKeeper.failure
    except (HydraException, OmegaConfBaseException, ValueError, OSError) as error:
        conclude_sweep()
        if verbose:
            raise
        message = explain(error, Path(script).resolve().parent / config_path, config_name)
        sys.stderr.write(f"{Path(script).name}: {message}\n")
        sys.exit(_EXIT_MISTAKE if _is_mistake(error) else _EXIT_FAILURE)
    except BaseException:
        conclude_sweep()
        raise
    if not conclude_sweep():
        sys.exit(_EXIT_FAILURE)


class FailureKeeper(Callback):
    """Hydra's callback: keeps the exception of a single run for `guarded`, which words it better than Hydra."""

    active = False
    failure: Exception | None = None

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Takes the failure out of Hydra's hands; leaves those of a sweep alone."""
        single = not str(config.hydra.mode).endswith("MULTIRUN")
        if FailureKeeper.active and single and job_return.status is JobStatus.FAILED:
            FailureKeeper.failure = job_return._return_value
            job_return.return_value = None
            job_return.status = JobStatus.COMPLETED


def explain(error: Exception, config_dir: Path, config_name: str) -> str:
    """One line about what went wrong, with the nearest thing that exists."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options is not None:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return f"there is no {group} {name!r}; {_nearest(name, list(error.options))}"
    unknown = re.search(r"Could not override '([^'@]+)(?:@[^']*)?'", str(error))
    if unknown:
        return _explain_key(unknown[1], config_dir, config_name)
    missing = re.search(r"Missing mandatory value: (\S+)", str(error))
    if missing:
        return f"{missing[1]} needs a value: {missing[1]}=..."
    return _plain(error)


def known_keys(config_dir: Path, config_name: str) -> list[str]:
    """Every dotted key of the default configuration and every group."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    with initialize_config_dir(str(config_dir), version_base="1.3"):
        overrides = [item for item in sys.argv[1:] if _chooses_group(item, config_dir)]
        try:
            cfg = compose(config_name, overrides=overrides)
        except HydraException:
            cfg = compose(config_name)
    groups = [str(path.relative_to(config_dir)) for path in config_dir.rglob("*") if path.is_dir()]
    return list(dict.fromkeys([*_dotted(cfg), *groups]))


def _explain_key(key: str, config_dir: Path, config_name: str) -> str:
    keys = known_keys(config_dir, config_name)
    tails = [known for known in keys if known.rsplit(".", 1)[-1] == key]
    return f"there is no setting {key!r}; {_nearest(key, keys, tails)}"


def _nearest(word: str, known: list[str], preferred: list[str] | None = None) -> str:
    near = (preferred or [])[:3] or difflib.get_close_matches(word, known, 3, cutoff=0.6)
    if near:
        return f"did you mean {' or '.join(near)}?"
    if len(known) <= 30:
        return f"there are: {', '.join(sorted(known)) or 'none'}"
    return "see --help for what there is"


def _chooses_group(override: str, config_dir: Path) -> bool:
    name, _, choice = override.partition("=")
    return bool(choice) and "," not in choice and (config_dir / name).is_dir()


def _dotted(cfg: DictConfig) -> Iterator[str]:
    tree = OmegaConf.to_container(cfg, resolve=False)
    stack: list[tuple[str, Any]] = [("", tree)]
    while stack:
        prefix, node = stack.pop()
        for name, value in node.items():
            key = f"{prefix}.{name}" if prefix else str(name)
            yield key
            if isinstance(value, dict):
                stack.append((key, value))


def _plain(error: Exception) -> str:
    if isinstance(error, InstantiationException):
        place = re.search(r"full_key: (\S+)", str(error))
        cause = error.__cause__ if error.__cause__ is not None else error
        return f"{place[1] if place else 'configuration'}: {' '.join(str(cause).split())}"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if isinstance(error, HydraException) and lines else " ".join(lines) or type(error).__name__


def _is_mistake(error: Exception) -> bool:
    return isinstance(error, (HydraException, OmegaConfBaseException, UserError))
