"""Write posed images, pairs of them, or people, in a common format: `python scripts/generate_data.py --help`."""

from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="../conf", config_name="generate_data")
def main(cfg: Any) -> None:
    """Write what the configuration says; heavy imports wait until here, so that `--help` answers at once."""
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    from rendra_lab.data.scene_folders import check_output, write_scene
    from rendra_lab.targets import check_targets
    from rendra_lab.tasks.synsin.pair_data import PairData
    from rendra_lab.tasks.synsin.pair_folder_writers import write_pairs

    check_targets(OmegaConf.to_container(cfg, resolve=True))
    data = instantiate(cfg.data, _convert_="all")
    if hasattr(data, "write"):  # it knows how: people have a layout of their own
        print(data.write(cfg.output, cfg.overwrite))
        return
    if isinstance(data, PairData):
        print(write_pairs(data, cfg.output, cfg.format, cfg.overwrite))
        return
    target = (cfg.output, cfg.format, cfg.overwrite)
    check_output(*target)
    scene = data.load()
    folder = write_scene(scene, *target)
    print(f"{len(scene.train)} training, {len(scene.val)} validation and {len(scene.test)} test views\n{folder}")


if __name__ == "__main__":
    guarded(main, __file__, config_path="../conf", config_name="generate_data")
