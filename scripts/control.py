"""Controls what a generator makes: `python scripts/control.py run=outputs/giraffe/<time> program=rotation_object`."""

from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded

ZOO = Path(__file__).resolve().parents[1] / "zoo"


@hydra.main(version_base="1.3", config_path="../conf", config_name="control")
def main(cfg: Any) -> None:
    """Print what was written; heavy imports wait until here, so that `--help` answers at once."""
    from dataclasses import fields

    from omegaconf import OmegaConf

    from rendra_lab.errors import UserError
    from rendra_lab.report import short_path
    from rendra_lab.settings import Size, check_value, hints_of
    from rendra_lab.tasks.giraffe.control import play, programs_named
    from rendra_lab.tasks.giraffe.programs import Order
    from rendra_lab.visualization import can_write_mp4

    options: Any = OmegaConf.to_container(cfg, resolve=True)
    if (options["run"] is None) == (options["zoo"] is None):
        raise UserError("say run=FOLDER, the folder of a run of task=giraffe, or zoo=NAME, one of those kept in zoo/")
    for name, hint in {**hints_of(Order), "fps": Size}.items():
        if name in options:
            check_value(options[name], hint, name)
    programs = programs_named(str(options["program"]))
    order = Order(**{field.name: options[field.name] for field in fields(Order)})
    maker = _generator(options["run"], str(options["weights"]), str(options["zoo"]))
    place = Path("outputs", "zoo", str(options["zoo"])) if options["run"] is None else Path(options["run"])
    output = Path(options["output"] or place / "rendering")
    endings = ("gif", "mp4") if can_write_mp4() else ("gif",)
    for program in programs:
        written = play(maker.to(options["device"]), program, order, output / program, endings, options["fps"])
        print(f"{program}: {', '.join(path.name for path in written)}")
    print(short_path(output))


def _generator(run: str | None, weights: str, kept: str) -> Any:
    """The averaged generator of a run, whose data are not made again, or one of the zoo."""
    from rendra_lab import zoo
    from rendra_lab.errors import UserError
    from rendra_lab.tasks.giraffe.generator import Generator

    part = zoo.load(kept, ZOO) if run is None else zoo.part_of_run(Path(run), "averaged", "module.generator", weights)
    if not isinstance(part, Generator):
        raise UserError(f"{run or kept} has no generator of scenes, but a {type(part).__name__}")
    return part


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="control")
