"""Finds objects in a photograph: `python scripts/detect.py run=outputs/mesh_rcnn/<time> image=photo.jpg`."""

from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="../conf", config_name="detect")
def main(cfg: Any) -> None:
    """Print what was found; heavy imports wait until here, so that `--help` answers at once."""
    from omegaconf import OmegaConf

    from rendra_lab.data.photo_data import PhotoData
    from rendra_lab.detection.photo_search import Search, find_objects, habits_of, save_objects
    from rendra_lab.errors import UserError
    from rendra_lab.experiment import load_run
    from rendra_lab.report import short_path

    options: Any = OmegaConf.to_container(cfg, resolve=True)
    for name, what in (("run", "FOLDER, the folder of a finished run"), ("image", "FILE, a photograph")):
        if options[name] is None:
            raise UserError(f"say {name}={what}")
    names = ("side_px", "focal_px", "depth", "least_score", "only_highest")
    search = Search(**{name: options[name] for name in names})
    folder, image = Path(options["run"]), Path(options["image"])
    run = load_run(folder, str(options["weights"]))
    if not isinstance(run.data, PhotoData):
        raise UserError(f"{folder} detects nothing: its task is {type(run.task).__name__}")
    found = find_objects(run.task, image, habits_of(run.data), search)
    output = Path(options["output"] or folder / "detections" / image.stem)
    save_objects(found, output)
    if not found.names:
        less = "" if found.surest is None else f"; the surest of what is less sure has {found.surest:.2f}"
        print(f"nothing is found in {image.name} with a score of {search.least_score:g} or more{less}")
    for title, box in zip(found.titles(), found.detections.boxes.tolist(), strict=True):
        print(f"{title}  at {', '.join(f'{edge:.0f}' for edge in box)}")
    print(short_path(output))


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="detect")
