"""Makes a step again that was not finite: `python scripts/replay_step.py outputs/<task>/<time>/nan/step_000123`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main() -> None:
    """Builds the run anew, makes the one step from its kept state, says what is not finite; writes nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of the kept step")
    options = parser.parse_args()

    from rendra_lab.errors import UserError
    from rendra_lab.replay import replay

    try:
        found = replay(options.folder)
    except (UserError, FileNotFoundError) as error:
        sys.stderr.write(f"replay_step.py: {error}\n")
        sys.exit(2)
    print(found or "this time everything is finite")
    sys.exit(0 if found is None else 1)


if __name__ == "__main__":
    main()
