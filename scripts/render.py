"""Render any mesh file to a picture: `python scripts/render.py --help`."""

from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="../conf", config_name="render")
def main(cfg: Any) -> None:
    """Render what the configuration says; heavy imports wait until here, so that `--help` answers at once."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate

    from rendra_lab import pictures

    parts = {name: instantiate(cfg[name], _convert_="all") for name in ("camera", "light", "material", "shader")}
    studio = pictures.Studio(
        camera=parts["camera"],
        light=parts["light"],
        material=parts["material"],
        shading=parts["shader"],
        size=tuple(cfg.size if side is None else side for side in (cfg.height, cfg.width)),
        background=pictures.parse_color(cfg.background),
        antialias=cfg.antialias,
    )
    kind = pictures.kind_of_picture(cfg.gallery, cfg.turntable, cfg.transparent)
    folder = Path(HydraConfig.get().runtime.output_dir)
    output = Path(cfg.output) if cfg.output else folder / pictures.FILE_NAMES[kind]
    mesh = instantiate(cfg.mesh, device=cfg.device, _convert_="all")
    note = pictures.draw(kind, studio, mesh, output, cfg.frames, cfg.fps)
    print(f"{note}\n{output}")


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="render")
