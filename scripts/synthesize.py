"""Makes new views of a picture: `python scripts/synthesize.py run=outputs/synsin/<time> image=photo.jpg tz=0.1`."""

from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="../conf", config_name="synthesize")
def main(cfg: Any) -> None:
    """Print what was written; heavy imports wait until here, so that `--help` answers at once."""
    from omegaconf import OmegaConf

    from rendra_lab.errors import UserError
    from rendra_lab.experiment import load_run
    from rendra_lab.report import short_path
    from rendra_lab.tasks.synsin.new_views import Motion, new_views, pinhole, read_square, save_views
    from rendra_lab.tasks.synsin.pair_data import PairData
    from rendra_lab.tasks.synsin.task import SynSin
    from rendra_lab.visualization import can_write_mp4

    options: Any = OmegaConf.to_container(cfg, resolve=True)
    for name, what in (("run", "FOLDER, the folder of a finished run"), ("image", "FILE, a picture")):
        if options[name] is None:
            raise UserError(f"say {name}={what}")
    motion = Motion(**{name: float(options[name]) for name in ("theta", "phi", "tx", "ty", "tz")})
    folder, image = Path(options["run"]), Path(options["image"])
    run = load_run(folder, str(options["weights"]))
    if not isinstance(run.task, SynSin) or not isinstance(run.data, PairData):
        raise UserError(f"{folder} makes no new views: its task is {type(run.task).__name__}")
    if run.task.depth is None:
        raise UserError(f"{folder} was trained with true depth, which nobody knows of {image}")
    sample = run.data.splits.test[0]
    side = sample.input.shape[-1]
    known = options["fov_deg"] is None
    intrinsics = sample.intrinsics[0] if known else pinhole(side, float(options["fov_deg"]))
    output = Path(options["output"] or folder / "synthesis" / image.stem)
    views = new_views(run.task, read_square(image, side), intrinsics, motion, int(options["frames"]))
    endings = ("gif", "mp4") if can_write_mp4() else ("gif",)
    written = save_views(views, output, endings)
    print(f"{', '.join(path.name for path in written if path.parent == output)}")
    print(short_path(output))


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="synthesize")
