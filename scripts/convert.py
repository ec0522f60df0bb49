"""Converts meshes and point clouds between OBJ, PLY, GLB/glTF, OFF, STL and XYZ: `python scripts/convert.py IN OUT`.

The suffixes say what is read and written. Textures and colours are kept where OUT can hold them; what it cannot is
named in a warning. IN is never changed, and OUT is replaced only with --force.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints what was written; a mistake is one line on stderr and exit code 2."""
    options = _parser().parse_args(arguments)

    from rendra.io.conversion import Conversion, convert

    binary = {(True, False): False, (False, True): True}.get((options.ascii, options.binary))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            conversion = Conversion(
                up=options.up,
                center=options.center,
                scale=options.scale,
                fit=options.fit,
                sample=options.sample,
                vertices=options.vertices,
                seed=options.seed,
                textures=not options.no_textures,
                binary=binary,
                decimals=options.decimals,
                overwrite=options.force,
            )
            done = convert(options.input, options.output, conversion)
        except FileExistsError as error:
            hint = "; --force replaces it" if str(error).endswith("exists") else ""
            _stop(f"{error}{hint}")
        except (ValueError, OSError) as error:
            _stop(str(error))
    for warning in dict.fromkeys(_one_line(str(each.message)) for each in caught):
        sys.stderr.write(f"convert.py: warning: {warning}\n")
    size = (
        f"{done.num_verts:,} vertices, {done.num_faces:,} faces" if done.num_faces else f"{done.num_verts:,} points"
    )
    print(f"{done.path}: {size}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="convert.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("input", help="file to read: .obj .ply .glb .gltf .off .stl .xyz")
    parser.add_argument("output", help="file to write, of any of these kinds")
    parser.add_argument("--force", action="store_true", help="replace an output that exists")
    cloud = parser.add_argument_group("from a mesh to points").add_mutually_exclusive_group()
    cloud.add_argument("--sample", type=int, metavar="N", help="N points spread evenly over the surface")
    cloud.add_argument("--vertices", action="store_true", help="the vertices (always so for .xyz)")
    parser.add_argument("--seed", type=int, default=0, help="of --sample (0)")
    parser.add_argument("--up", choices=("z-to-y", "y-to-z"), help="turn the axis that points up, without mirroring")
    parser.add_argument("--center", action="store_true", help="move the middle of the bounding box to the origin")
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument("--scale", type=float, metavar="X", help="multiply coordinates; 0.001 from mm to m")
    scale.add_argument("--fit", type=float, metavar="X", help="make X the longest side of the bounding box")
    encoding = parser.add_mutually_exclusive_group()
    encoding.add_argument("--ascii", action="store_true", help="text, where the format has both (.ply .stl)")
    encoding.add_argument("--binary", action="store_true", help="binary, where the format has both")
    parser.add_argument("--decimals", type=int, metavar="N", help="digits behind the point, in text")
    parser.add_argument("--no-textures", action="store_true", help="leave out colours and images")
    return parser


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _stop(message: str) -> None:
    sys.stderr.write(f"convert.py: {_one_line(message)}\n")
    sys.exit(2)


if __name__ == "__main__":
    main()
