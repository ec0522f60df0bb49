"""Scores a finished run anew: `python scripts/evaluate.py outputs/pose/<time> [key=value ...] [--output]`."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from pathlib import Path


def main() -> None:
    """Rebuilds the run, tests it, prints the metrics; writes nothing unless it is told where."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", help="of the run")
    parser.add_argument("--weights", default="last", help="last (default), best, or a checkpoint file")
    parser.add_argument("--json", action="store_true", help="print the metrics as JSON")
    parser.add_argument(
        "--output",
        nargs="?",
        const="",
        metavar="FOLDER",
        help="write the pictures and tables of a test too, as the run did; without FOLDER to evaluation/ of the run",
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="other values of the configuration")
    options = parser.parse_args()

    from omegaconf import OmegaConf
    from rich.console import Console
    from rich.table import Table

    from rendra_lab.errors import UserError
    from rendra_lab.experiment import evaluate, load_run
    from rendra_lab.report import format_number, short_path

    values = [item.split("=", 1) for item in options.overrides]
    if any(len(pair) != 2 for pair in values):
        parser.error(f"expected key=value, got {' '.join(options.overrides)}")
    if "=" in (options.output or ""):
        parser.error(f"--output takes a folder or stands last, got {options.output}")
    try:
        changes = {key: OmegaConf.create(f"v: {value}").v for key, value in values}
        output = Path(options.folder, "evaluation") if options.output == "" else options.output
        with contextlib.redirect_stdout(sys.stderr if options.json else sys.stdout):
            metrics = evaluate(load_run(options.folder, options.weights, changes, reports=output))
    except (UserError, FileNotFoundError) as error:
        sys.stderr.write(f"evaluate.py: {error}\n")
        sys.exit(2)
    if options.json:
        print(json.dumps(metrics))
        return
    table = Table("metric", "value", title=options.folder)
    for name, value in metrics.items():
        table.add_row(name, format_number(value))
    Console().print(table)
    if output is not None:
        print(f"results   {short_path(Path(output))}")


if __name__ == "__main__":
    main()
