"""What a configuration may call: public classes and harmless functions of the allowed packages, nothing else."""

from typing import Any

import pytest

from rendra_lab.errors import UserError
from rendra_lab.targets import check_targets


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "builtins.exec",
        "subprocess.run",
        "shutil.rmtree",
        "pathlib.Path",
        "importlib.import_module",
        "functools.partial",
        "hydra.utils.get_method",
        "hydra.utils.instantiate",
        "logging.os.system",
        "rendra_lab.experiment.subprocess.run",
        "rendra_lab.experiment.run",
        "rendra_lab.experiment.load_run",
        "rendra_lab.front_door.guarded",
        "rendra_lab.report.sys.modules",
        "rendra_lab.report.write_json",
        "rendra_lab.report.__builtins__",
        "rendra_lab.report.__loader__.set_data",
        "rendra_lab.visualization.save_picture",
        "rendra_lab.callbacks.Path",
        "rendra_lab.callbacks.ImageLogger.__init__",
        "rendra_lab.callbacks.ImageLogger.on_train_end",
        "rendra.io.save_obj",
        "torch.load",
        "torch.save",
        "torch.hub.load",
        "torch.utils.cpp_extension.load",
        "torch.nn.modules.module.torch.load",
        "torch.nn.modules.module.functools.partial",
        "torch.nn.Module.load_state_dict",
        "torch.nn.utils.parametrize.register_parametrization",
        "lightning.pytorch.trainer.trainer.os.system",
        "lightning.pytorch.callbacks.model_checkpoint.shutil.rmtree",
        "lightning.pytorch.Trainer.save_checkpoint",
        "torchmetrics.utilities.data.torch.load",
    ],
)
@pytest.mark.parametrize("how", [{}, {"_partial_": True}, {"_args_": ["touch marker"]}])
def test_what_runs_code_or_writes_files_is_refused(target: str, how: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"data\.inner: a configuration may not call"):
        check_targets({"data": {"inner": {"_target_": target, **how}}})
    with pytest.raises(UserError, match=r"data\.inner\[0\]: a configuration may not call"):
        check_targets({"data": {"inner": [{"_target_": target, **how}]}})


@pytest.mark.parametrize("target", [3, None, ["os.system"], {"_target_": "os.system"}])
def test_a_target_is_a_name(target: Any) -> None:
    with pytest.raises(UserError, match=r"data\._target_ must be the dotted name of a class or function"):
        check_targets({"data": {"_target_": target}})


def test_an_argument_may_not_smuggle_a_target() -> None:
    smuggled = {"_target_": "torch.nn.Sequential", "_args_": [{"_target_": "os.system", "_args_": ["true"]}]}
    with pytest.raises(UserError, match=r"data\._args_\[0\]: a configuration may not call 'os.system'"):
        check_targets({"data": smuggled})


@pytest.mark.parametrize(
    "target",
    [
        "torch.nn.Identity",
        "torch.nn.functional.mse_loss",
        "torch.optim.Adam",
        "rendra.loss.mesh_edge_loss",
        "rendra_lab.losses.chamfer",
        "rendra_lab.data.meshes.load_mesh",
        "lightning.pytorch.callbacks.ModelCheckpoint",
        "torchmetrics.functional.mean_squared_error",
    ],
)
def test_parts_of_a_run_are_allowed(target: str) -> None:
    check_targets({"data": {"_target_": target, "_partial_": True}})


def test_plugins_are_trusted_by_whoever_runs_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RENDRA_LAB_PACKAGES", "")
    with pytest.raises(UserError, match=r"may not call 'rendra_lab_toy\.ToyData'"):
        check_targets({"data": {"_target_": "rendra_lab_toy.ToyData"}})
    monkeypatch.setenv("RENDRA_LAB_PACKAGES", "other, rendra_lab_toy")
    check_targets({"data": {"_target_": "rendra_lab_toy.ToyData"}})


def test_the_names_of_base_classes_are_known() -> None:
    toy = {"_target_": "rendra_lab_toy.ToyTask", "optimiser": None}
    with pytest.raises(
        UserError, match=r"module\.optimiser: ToyTask takes no 'optimiser'; did you mean 'optimizer'\?"
    ):
        check_targets({"module": toy})
