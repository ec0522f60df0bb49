"""Writes the mesh of a finished run: `python scripts/export.py run=outputs/nerf/<time> [key=value ...]`."""

import sys
from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="../conf", config_name="export")
def main(cfg: Any) -> None:
    """Print what was written; heavy imports wait until here, so that `--help` answers at once."""
    from omegaconf import OmegaConf

    from rendra_lab.data.ray_views import SceneViews
    from rendra_lab.errors import UserError
    from rendra_lab.experiment import load_run
    from rendra_lab.mesh_export import SurfaceSettings, export_surface
    from rendra_lab.metrics import surface_chamfer_l1
    from rendra_lab.networks.radiance import RadianceScene
    from rendra_lab.report import short_path
    from rendra_lab.settings import check_value, hints_of

    options: Any = OmegaConf.to_container(cfg, resolve=True)
    if options["run"] is None:
        raise UserError("say run=FOLDER, the folder of a finished run")
    for name, hint in hints_of(SurfaceSettings).items():
        if name in options:
            check_value(options[name], hint, name)
    folder, output = Path(options.pop("run")), options.pop("output")
    weights, device = str(options.pop("weights")), options.pop("device")
    stem, formats = _destination(Path(output or folder / "exports" / f"mesh_{cfg.resolution}"), options["formats"])
    settings = SurfaceSettings(**{**options, "formats": formats})
    run = load_run(folder, weights)
    if not isinstance(run.task, RadianceScene):
        raise UserError(f"{folder} has no radiance field: its task is {type(run.task).__name__}")
    scene = run.data.scene if isinstance(run.data, SceneViews) else None
    written = export_surface(run.task.to(device), settings, stem, scene.up if scene else None)
    print(written)
    if not written.files:
        sys.exit(1)
    if scene is not None and scene.truth is not None:
        distance = surface_chamfer_l1(written.mesh, scene.truth.to(written.mesh.device))
        print(f"chamfer-L1 to the true mesh {float(distance):.4f} of its diagonal")
    print(short_path(stem.parent))


def _destination(path: Path, formats: list[str]) -> tuple[Path, list[str]]:
    """The path without its ending, and the formats: the ending's alone where there is one."""
    from rendra_lab.errors import UserError
    from rendra_lab.mesh_export import FORMATS

    if not path.suffix:
        return path, formats
    ending = path.suffix[1:].lower()
    if ending not in FORMATS:
        raise UserError(f"output must end in .{', .'.join(FORMATS)}, or in nothing for all, got {path}")
    return path.with_suffix(""), [ending]


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="export")
