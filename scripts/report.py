"""Makes report.html of a run or a sweep anew: `python scripts/report.py run=outputs/nerf/<time>`.

run=FOLDER     of a run or a sweep; for a sweep the page compares its runs, and jobs without a report get theirs
max_mb=25      upper limit of the page; what does not fit is named on it
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> None:
    """Writes the page and prints its path; a mistake is one line on stderr and exit code 2."""
    words = sys.argv[1:]
    if not words or {"-h", "--help"} & set(words):
        print(__doc__.strip())
        return
    from rendra_lab.errors import UserError

    try:
        print(_write(words))
    except (UserError, OSError) as error:
        sys.stderr.write(f"report.py: {error}\n")
        sys.exit(2)


def _write(words: list[str]) -> Path:
    from rendra_lab.errors import UserError
    from rendra_lab.html_report import write_run_report, write_sweep_report

    options = {"max_mb": "25"}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key not in ("run", "max_mb"):
            raise UserError(f"expected run=FOLDER or max_mb=NUMBER, got {word!r}")
        options[key] = value
    if not options.get("run"):
        raise UserError("say run=FOLDER, the folder of a run or a sweep")
    folder = Path(options["run"])
    try:
        max_mb = float(options["max_mb"])
    except ValueError:
        raise UserError(f"max_mb must be a number, got {options['max_mb']!r}") from None
    if not max_mb >= 1:
        raise UserError(f"max_mb must be at least 1, got {options['max_mb']}")
    is_sweep = not (folder / ".hydra").is_dir() and any(folder.glob("*/.hydra"))
    return write_sweep_report(folder, max_mb) if is_sweep else write_run_report(folder, max_mb)


if __name__ == "__main__":
    main()
