"""What is in a mesh or point cloud file, in numbers and pictures: `python scripts/inspect.py FILE`.

Prints counts, bounds, materials, components, holes and faults, and last a one-line verdict. Draws a sheet of views,
of texture maps and of each kind of fault in red: FILE_inspected.png in the folder where you are.
"""

from __future__ import annotations

import os
import sys

if __name__ == "inspect":
    # Any script in this folder that needs Python's module of this name finds this file first: hand that module over.
    from importlib.machinery import PathFinder
    from importlib.util import module_from_spec

    spec = PathFinder.find_spec("inspect", [os.path.dirname(os.__file__)])
    assert spec is not None
    assert spec.loader is not None
    sys.modules["inspect"] = module_from_spec(spec)
    spec.loader.exec_module(sys.modules["inspect"])

import argparse
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the report; a file that cannot be read is one line on stderr and exit code 2."""
    options = _parser().parse_args(arguments)
    from rendra_lab.mesh_asset import read_asset
    from rendra_lab.mesh_report import as_json, as_text, report_on
    from rendra_lab.mesh_sheet import NothingToSeeError, draw_sheet
    from rendra_lab.visualization import save_picture

    remarks = []
    try:
        asset = read_asset(options.file)
        report, findings = report_on(asset)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(as_json(report))
            remarks.append(f"wrote {options.json}")
        if not options.no_picture:
            output = options.output or Path(f"{options.file.stem}_inspected.png")
            remarks.append(f"wrote {save_picture(output, draw_sheet(asset, findings, options.size))}")
    except NothingToSeeError as error:
        remarks.append(f"no picture: {error}")
    except (ValueError, OSError) as error:
        sys.stderr.write(f"inspect.py: {' '.join(str(error).split())}\n")
        sys.exit(2)
    text, _, verdict = as_text(report).rpartition("\n")
    print(text, *(f"  {remark}" for remark in remarks), verdict, sep="\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="inspect.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="file to read: .obj .ply .glb .gltf .off .stl .xyz")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too")
    parser.add_argument("--output", type=Path, metavar="PNG", help="where the sheet goes")
    parser.add_argument("--no-picture", action="store_true", help="numbers only")
    parser.add_argument("--size", type=int, default=320, metavar="PX", help="of one picture (default: 320)")
    return parser


if __name__ == "__main__":
    main()
