"""Writes the mesh of a finished run: `python scripts/export.py run=outputs/nerf/<time> [key=value ...]`.

run=FOLDER         of a run that fitted a radiance field or a volume
output=PATH        files are PATH.obj, ...; or one file: cow.glb (default: exports/mesh_<resolution> of the run)
resolution=256     voxels along the longest side of the scene
color=vertex       texture bakes an image; null leaves colours out
formats=[obj,ply,glb]
level=null         share of the light of a head-on ray that is stopped before the surface; null fits outlines
keep=0.01          smaller pieces, by share of the largest, are left out; 1 keeps the largest alone
smoothing=5        Taubin steps, for noisy fields
num_faces=null     at most so many; textured meshes get 20,000
texture_size=1024  texels along a side
weights=last       best, or a checkpoint file
device=cpu         or cuda
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_SETTINGS = ("resolution", "level", "color", "keep", "smoothing", "num_faces", "texture_size", "formats")
_PLACES: dict[str, Any] = {"run": None, "output": None, "weights": "last", "device": "cpu"}


def main() -> None:
    """Prints what was written; a mistake is one line on stderr and exit code 2."""
    words = sys.argv[1:]
    if not words or {"-h", "--help"} & set(words):
        print(__doc__)
        return

    from yaml import YAMLError

    from rendra_lab.errors import UserError

    try:
        _export(_read(words))
    except (UserError, FileNotFoundError, YAMLError, TypeError) as error:
        sys.stderr.write(f"export.py: {' '.join(str(error).split())}\n")
        sys.exit(2)


def _read(words: list[str]) -> dict[str, Any]:
    """The settings by name."""
    import difflib

    from omegaconf import OmegaConf

    from rendra_lab.errors import UserError

    known = [*_PLACES, *_SETTINGS]
    options = dict(_PLACES)
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise UserError(f"expected key=value, got {word}")
        if name not in known:
            meant = difflib.get_close_matches(name, known, 1)
            raise UserError(
                f"there is no setting {name!r}; {f'did you mean {meant[0]}?' if meant else ', '.join(known)}"
            )
        read = OmegaConf.create(f"v: {value}").v
        options[name] = list(read) if OmegaConf.is_list(read) else read
    if options["run"] is None:
        raise UserError("say run=FOLDER, the folder of a finished run")
    return options


def _export(options: Mapping[str, Any]) -> None:
    from rendra_lab.data.ray_views import SceneViews
    from rendra_lab.errors import UserError
    from rendra_lab.experiment import load_run
    from rendra_lab.mesh_export import FORMATS, SurfaceSettings, export_surface
    from rendra_lab.metrics import surface_chamfer_l1
    from rendra_lab.networks.radiance import RadianceScene
    from rendra_lab.report import short_path

    chosen = {name: options[name] for name in _SETTINGS if name in options}
    folder = Path(options["run"])
    stem = Path(options["output"] or folder / "exports" / f"mesh_{chosen.get('resolution', 256)}")
    if stem.suffix:
        if stem.suffix[1:].lower() not in FORMATS:
            raise UserError(f"output must end in .{', .'.join(FORMATS)}, or in nothing for all, got {stem}")
        chosen["formats"], stem = [stem.suffix[1:].lower()], stem.with_suffix("")
    settings = SurfaceSettings(**chosen)
    run = load_run(folder, str(options["weights"]))
    if not isinstance(run.task, RadianceScene):
        raise UserError(f"{folder} has no radiance field: its task is {type(run.task).__name__}")
    scene = run.data.scene if isinstance(run.data, SceneViews) else None
    written = export_surface(run.task.to(options["device"]), settings, stem, scene.up if scene else None)
    print(written)
    if not written.files:
        sys.exit(1)
    if scene is not None and scene.truth is not None:
        distance = surface_chamfer_l1(written.mesh, scene.truth.to(written.mesh.device))
        print(f"chamfer-L1 to the true mesh {float(distance):.4f} of its diagonal")
    print(short_path(stem.parent))


if __name__ == "__main__":
    main()
