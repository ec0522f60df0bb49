"""Pose a body and draw it, and what each of its numbers does: `python scripts/render_body.py --help`."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded

FORMATS = ("obj", "glb", "ply")


@hydra.main(version_base="1.3", config_path="../conf", config_name="render_body")
def main(cfg: Any) -> None:
    """Write what the configuration says; heavy imports wait until here, so that `--help` answers at once."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.utils import instantiate

    from rendra_lab import pictures
    from rendra_lab.body_pictures import painted, sheets_of
    from rendra_lab.errors import UserError

    folder = Path(cfg.output) if cfg.output else Path(HydraConfig.get().runtime.output_dir)
    if folder.suffix and not folder.is_dir():
        raise UserError(f"output is a folder for picture, numbers and meshes; {folder} looks like a file")
    kind, sheets = pictures.kind_of_picture(False, cfg.turntable, False), list(sheets_of(cfg.sheet))
    if unknown := sorted(set(map(str, cfg.meshes)) - set(FORMATS)):
        raise UserError(f"meshes must be some of {', '.join(FORMATS)}, got {', '.join(unknown)}")
    studio = pictures.Studio(
        **{name: instantiate(cfg[name], _convert_="all") for name in ("camera", "light", "material")},
        shading=instantiate(cfg.shader, _convert_="all"),
        size=(cfg.size, cfg.size),
        background=pictures.parse_color(cfg.background),
        antialias=cfg.antialias,
    )
    body = instantiate(cfg.body, _convert_="all").to(cfg.device)
    numbers = _numbers(cfg, body)
    mesh = painted(body, numbers)
    print(pictures.draw("picture", studio, mesh, folder / "body.png"))
    print(folder / "body.png", numbers.save(folder / "body.json"), *_save_meshes(mesh, folder, cfg.meshes), sep="\n")
    if kind != "picture":
        film = folder / f"turntable.{kind}"
        print(pictures.draw(kind, studio, mesh, film, cfg.frames, cfg.fps), film, sep="\n")
    for path in _save_sheets(body, studio, folder, sheets):
        print(path)


def _numbers(cfg: Any, body: Any) -> Any:
    from rendra_lab import body_pictures

    if cfg.posture == "random":
        numbers = body_pictures.random_numbers(body, cfg.seed, cfg.pose_spread, cfg.beta_spread)
    elif cfg.posture == "rest":
        numbers = body_pictures.rest_numbers(body)
    else:
        numbers = body_pictures.read_numbers(body, cfg.posture, cfg.index, cfg.camera_axes)
    return numbers if cfg.betas is None else replace(numbers, betas=body_pictures.with_betas(body, cfg.betas))


def _save_meshes(mesh: Any, folder: Path, formats: Any) -> Iterator[Path]:
    from rendra.io import IO

    for ending in formats:
        path = folder / f"body.{ending}"
        IO().save_mesh(mesh.cpu(), path)
        yield path


def _save_sheets(body: Any, studio: Any, folder: Path, sheets: list[str]) -> Iterator[Path]:
    from rendra_lab.body_pictures import beta_sheet, joint_sheet
    from rendra_lab.visualization import save_picture

    for name in sheets:
        sheet = beta_sheet(body, studio) if name == "betas" else joint_sheet(body, studio)
        yield save_picture(folder / f"sheet_{name}.png", sheet)


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="render_body")
