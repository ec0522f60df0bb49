"""Render any mesh file to a picture, or a fitted scene to a film: `python scripts/render.py --help`."""

from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="../conf", config_name="render")
def main(cfg: Any) -> None:
    """Render what the configuration says; heavy imports wait until here, so that `--help` answers at once."""
    from hydra.core.hydra_config import HydraConfig

    folder = Path(HydraConfig.get().runtime.output_dir)
    note, output = _picture_of_mesh(cfg, folder) if cfg.run is None else _film_of_run(cfg, folder)
    print(f"{note}\n{output}")


def _picture_of_mesh(cfg: Any, folder: Path) -> tuple[str, Path]:
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    from rendra_lab import pictures
    from rendra_lab.errors import UserError
    from rendra_lab.targets import check_targets

    check_targets(OmegaConf.to_container(cfg, resolve=True))
    if (cfg.trajectory, cfg.what, cfg.elevation_deg) != ("auto", "rgb", None):
        raise UserError("trajectory, what and elevation_deg show a fitted scene: name its run with run=outputs/...")
    parts = {name: instantiate(cfg[name], _convert_="all") for name in ("camera", "light", "material", "shader")}
    side = 512 if cfg.size is None else cfg.size
    studio = pictures.Studio(
        camera=parts["camera"],
        light=parts["light"],
        material=parts["material"],
        shading=parts["shader"],
        size=(side if cfg.height is None else cfg.height, side if cfg.width is None else cfg.width),
        background=pictures.parse_color(cfg.background),
        antialias=cfg.antialias,
    )
    kind = pictures.kind_of_picture(cfg.gallery, cfg.turntable, cfg.transparent)
    output = Path(cfg.output) if cfg.output else folder / pictures.FILE_NAMES[kind]
    mesh = instantiate(cfg.mesh, device=cfg.device, _convert_="all")
    frames, fps = (36 if cfg.frames is None else cfg.frames), (18.0 if cfg.fps is None else cfg.fps)
    return pictures.draw(kind, studio, mesh, output, frames, fps), output


def _film_of_run(cfg: Any, folder: Path) -> tuple[str, Path]:
    from rendra_lab.errors import UserError
    from rendra_lab.experiment import load_run
    from rendra_lab.radiance_film import FilmOrder, render_run

    if cfg.gallery or cfg.turntable is not None or cfg.transparent:
        raise UserError("gallery, turntable and transparent are for meshes; a run takes trajectory, what and output")
    if (cfg.width is None) != (cfg.height is None):
        raise UserError("give both width and height, or size alone for the shorter side")
    order = FilmOrder(
        trajectory=str(cfg.trajectory),
        what=cfg.what,
        frames=cfg.frames,
        size=cfg.size if cfg.width is None else (cfg.height, cfg.width),
        elevation_deg=cfg.elevation_deg,
        fps=cfg.fps,
        output=Path(cfg.output) if cfg.output else folder,
    )
    run = load_run(cfg.run)
    return render_run(run.task.to(cfg.device), run.data, order)


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="render")
