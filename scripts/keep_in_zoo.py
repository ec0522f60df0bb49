"""Keeps what a run trained beside the code: `python scripts/keep_in_zoo.py outputs/giraffe/<time> giraffe_cow`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ZOO = Path(__file__).resolve().parents[1] / "zoo"


def main() -> None:
    """Writes weights, configuration and card, and prints the card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("name", help="in the zoo, such as giraffe_cow")
    parser.add_argument("--weights", default="last", help="last (default), best, or a checkpoint file")
    parser.add_argument("--part", default="averaged", help="the task's part that is kept (default: averaged)")
    parser.add_argument("--key", default="module.generator", help="what builds it (default: module.generator)")
    parser.add_argument("--zoo", type=Path, default=ZOO, help="the folder of all (default: zoo/ beside the code)")
    options = parser.parse_args()

    from rendra_lab import zoo
    from rendra_lab.errors import UserError
    from rendra_lab.report import short_path

    try:
        folder = zoo.keep(options.run, options.name, options.zoo, options.part, options.key, options.weights)
    except (UserError, OSError) as error:
        sys.stderr.write(f"keep_in_zoo.py: {error}\n")
        sys.exit(2)
    print((folder / "card.md").read_text(encoding="utf-8"))
    print(short_path(folder))


if __name__ == "__main__":
    main()
