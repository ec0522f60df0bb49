"""What stands between a command line and Hydra: mistakes are answered in one line, with what was meant."""

from __future__ import annotations

import atexit
import contextlib
import difflib
import gc
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException, InstantiationException, MissingConfigException, OverrideParseException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from rendra_lab import run_names, signals  # noqa: F401 - run_names is asked by name, in conf/hydra
from rendra_lab.errors import UserError
from rendra_lab.origins import trusted_folders, watch_origins
from rendra_lab.sweep import conclude_sweep

_EXIT_MISTAKE = 2  # the command or the configuration cannot be
_EXIT_FAILURE = 1  # the run failed
_MISTAKES = (HydraException, OmegaConfBaseException, UserError, YAMLError)
_WORDED = (*_MISTAKES, ValueError, OSError)  # exceptions that say what is wrong to someone without the source


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
    atexit.register(gc.freeze)  # or the interpreter's last collection walks all that was imported, for a second
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra hands its exceptions over instead of printing them
    FailureKeeper.active = True
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # torch's native code warns of what is as it should be
    config_dir = Path(script).resolve().parent / config_path
    try:
        with signals.listening():
            check_command_line()
            watch_origins(config_dir)
            main()
        if FailureKeeper.failure is not None:
            raise FailureKeeper.failure
    except signals.Interrupted as stop:  # before the run, or between the runs of a sweep
        _end_interrupted(script, stop)
    except BrokenPipeError:  # the reader of the output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_EXIT_FAILURE)
    except Exception as error:
        if wish := signals.behind(error):
            _end_interrupted(script, wish)
        if conclude_sweep() is not None and not verbose:
            sys.exit(_EXIT_FAILURE)  # the table has said it
        clear = isinstance(error, _MISTAKES) and not isinstance(error, InstantiationException)
        mistyped = None if verbose or clear else mistyped_value(config_dir, config_name)
        if verbose or not (mistyped or isinstance(error, _WORDED)):
            raise
        message = mistyped or explain(error, config_dir, config_name)
        sys.stderr.write(f"{Path(script).name}: {message}\n")
        before_the_run = FailureKeeper.failure is None
        sys.exit(_EXIT_MISTAKE if before_the_run or mistyped or _is_mistake(error) else _EXIT_FAILURE)
    except BaseException:  # an interrupted sweep has its table too
        conclude_sweep()
        raise
    if conclude_sweep() is False:
        sys.exit(_EXIT_FAILURE)


def _end_interrupted(script: str, stop: signals.Interrupted) -> NoReturn:
    conclude_sweep()
    if os.environ.get("LOCAL_RANK", "0") == "0":
        sys.stderr.write(f"{Path(script).name}: {stop}\n")
    sys.exit(stop.code)


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

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process that a launcher starts, and that unpickles this, watches its configurations too."""
        return _keeper_elsewhere, (trusted_folders(),)


def _keeper_elsewhere(folders: list[Path]) -> FailureKeeper:
    watch_origins(*folders)
    return FailureKeeper()


def check_command_line() -> None:
    """Refuses flags that do not exist, and the one that reads a pickle; UserError."""
    parser = get_args_parser()
    parser.error = _refuse_flag  # type: ignore[method-assign,assignment]
    if parser.parse_args().experimental_rerun is not None:
        raise UserError("--experimental-rerun reads a pickle, which could run anything; use ckpt_path=... to go on")


def _refuse_flag(message: str) -> NoReturn:
    late = [item for item in sys.argv[2:] if item in ("-m", "--multirun")]
    hint = f"{late[0]} stands before all settings" if late else "settings are key=value; see --help"
    raise UserError(f"{message}; {hint}")


def _is_mistake(error: Exception) -> bool:
    """Whether a run failed over what it was given: a setting, or a file that is malformed or not there."""
    from rendra.io.errors import MeshFormatError  # brings torch along, which a run has loaded already

    return isinstance(error, (*_MISTAKES, MeshFormatError, FileNotFoundError))


def explain(error: Exception, config_dir: Path, config_name: str) -> str:
    """One line about what went wrong, with the nearest thing that exists."""
    absent = re.search(r"Could not (?:find|load) '([^']+)/([^'/]+)'", str(error))
    if isinstance(error, MissingConfigException) and absent:
        options = known_options(absent[1], config_dir, config_name)
        return f"there is no {absent[1]} {absent[2]!r}; {_nearest(absent[2], options)}"
    unknown = re.search(r"Could not (?:override|delete from config\.) '([^'@]+)(?:@[^']*)?'", str(error))
    if unknown:
        return _explain_key(unknown[1], config_dir, config_name)
    present = re.search(r"An item is already at '([^']+)'", str(error))
    if present:
        return f"there is a setting {present[1]} already: {present[1]}=... without the + in front"
    missing = re.search(r"Missing mandatory value: (\S+)", str(error))
    if missing:
        key = getattr(error, "full_key", None) or missing[1]
        return f"{key} needs a value: {key}=..."
    return _explain_argument(error, config_dir) or _plain(error)


def _explain_argument(error: Exception, config_dir: Path) -> str | None:
    """One line about an argument that Hydra cannot read or that gives a group no choice; None for other mistakes."""
    if isinstance(error, OverrideParseException):
        if "=" not in str(error.override):
            return f"cannot read {error.override!r}: settings are key=value; see --help"
        return f"cannot read {error.override!r}: brackets and quotes come in pairs, as in 'key=[1,2]' 'key=\"a b\"'"
    if "Config group override must be" in str(error):
        for item in sys.argv[1:]:
            name, _, choice = item.partition("=")
            if name and (config_dir / name).is_dir() and (choice == "null" or choice.isdigit()):
                return f"{name} must be one of its choices, got {choice}; see --help"
    return None


def mistyped_value(config_dir: Path, config_name: str) -> str | None:
    """One line about a word on the command line that stands for a number; None where there is no such word."""
    from hydra import compose

    chosen = [item for item in sys.argv[1:] if _chooses_group(item, config_dir)]
    with _hydra(config_dir), contextlib.suppress(HydraException, OmegaConfBaseException, ValueError):
        usual = compose(config_name, overrides=[*_search_path(), *chosen])
        given = compose(config_name, overrides=[item for item in sys.argv[1:] if not item.startswith("-")])
        for key in (item.partition("=")[0] for item in sys.argv[1:] if item not in chosen and "=" in item):
            number, word = OmegaConf.select(usual, key), OmegaConf.select(given, key)
            if isinstance(number, int | float) and isinstance(word, str):
                return f"{key} must be {'true or false' if isinstance(number, bool) else 'a number'}, got {word!r}"
    return None


def known_keys(config_dir: Path, config_name: str) -> list[str]:
    """Every dotted key of the configuration that the command line chooses groups for, and every group."""
    from hydra import compose

    chosen = [item for item in sys.argv[1:] if _chooses_group(item, config_dir)]
    groups = [str(path.relative_to(config_dir)) for path in config_dir.rglob("*") if path.is_dir()]
    with _hydra(config_dir):
        for overrides in ([*_search_path(), *chosen], _search_path()):
            with contextlib.suppress(HydraException):
                return list(dict.fromkeys([*_dotted(compose(config_name, overrides=overrides)), *groups]))
    return groups


def known_options(group: str, config_dir: Path, config_name: str) -> list[str]:
    """The choices of a group, wherever Hydra looks for them."""
    with _hydra(config_dir) as loader, contextlib.suppress(HydraException):
        options = loader.get_group_options(group, config_name=config_name, overrides=_search_path())
        return [str(option) for option in options]
    return []


@contextlib.contextmanager
def _hydra(config_dir: Path) -> Iterator[Any]:
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    with initialize_config_dir(str(config_dir), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def _search_path() -> list[str]:
    return [item for item in sys.argv[1:] if item.startswith("hydra.searchpath=")]


def _explain_key(key: str, config_dir: Path, config_name: str) -> str:
    keys = known_keys(config_dir, config_name)
    tails = [known for known in keys if known.rsplit(".", 1)[-1] == key]
    parent, _, name = key.rpartition(".")
    obvious = tails or difflib.get_close_matches(key, keys, 1, cutoff=0.85)
    if not obvious and name in _parameters_of_key(parent, config_dir, config_name):
        return f"{key} is not in the configuration, but what {parent} names takes it: +{key}=..."
    return f"there is no setting {key!r}; {_nearest(key, keys, tails)}"


def _parameters_of_key(parent: str, config_dir: Path, config_name: str) -> list[str]:
    """What the target under a dotted key takes; nothing where there is none. Its module is imported."""
    from hydra import compose

    chosen = [item for item in sys.argv[1:] if _chooses_group(item, config_dir)]
    with _hydra(config_dir), contextlib.suppress(HydraException, OmegaConfBaseException):
        target = OmegaConf.select(compose(config_name, overrides=[*_search_path(), *chosen]), f"{parent}._target_")
        if isinstance(target, str):
            from rendra_lab.targets import parameters_of_path

            return parameters_of_path(target)
    return []


def _nearest(word: str, known: list[str], preferred: list[str] | None = None) -> str:
    near = preferred or difflib.get_close_matches(word, known, 3, cutoff=0.6)
    if near:
        clear = difflib.SequenceMatcher(None, word, near[0]).ratio() > 0.85
        return f"did you mean {' or '.join(near[: 1 if clear else 3])}?"
    if len(known) <= 30:
        return f"there are: {', '.join(sorted(known)) or 'none'}"
    return "see --help for what there is"


def _chooses_group(override: str, config_dir: Path) -> bool:
    name, _, choice = override.partition("=")
    single = bool(choice) and ("," not in choice or choice.startswith("["))
    return single and (config_dir / name).is_dir()


def _dotted(cfg: DictConfig) -> Iterator[str]:
    tree = OmegaConf.to_container(cfg, resolve=False)
    stack: list[tuple[str, Any]] = [("", tree)]
    while stack:
        prefix, node = stack.pop()
        for name, value in node.items():
            key = f"{prefix}.{name}" if prefix else str(name)
            if not key.endswith("_"):
                yield key
            if isinstance(value, dict):
                stack.append((key, value))


def _plain(error: Exception) -> str:
    if isinstance(error, InstantiationException):
        place = re.search(r"full_key: (\S+)", str(error))
        cause = error.__cause__ if error.__cause__ is not None else error
        words, key = " ".join(str(cause).split()), place[1] if place else "configuration"
        if words.startswith(f"{key}."):
            return words
        return f"{key}.{words}" if _begins_with_parameter(words, str(error)) else f"{key}: {words}"
    if isinstance(error, OmegaConfBaseException):
        asked = [item.partition("=")[0] for item in sys.argv[1:] if "${" in item]
        key = getattr(error, "full_key", None) or (asked[0] if asked else "configuration")
        return f"{key}: {str(error).splitlines()[0]}"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if isinstance(error, HydraException) and lines else " ".join(lines) or type(error).__name__


def _begins_with_parameter(words: str, error: str) -> bool:
    """Whether a complaint begins with the name of what the target of an InstantiationException takes."""
    from rendra_lab.targets import parameters_of_path

    target = re.search(r"[Ee]rror in call to target '([\w.]+)'", error)
    return target is not None and words.partition(" ")[0] in parameters_of_path(target[1])
