"""The command line: help, one-line answers to mistakes, sweeps with their table."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
Train = Callable[..., tuple[int, str, str]]


def test_help_lists_the_groups_without_loading_torch() -> None:
    probe = "import runpy, sys, atexit; atexit.register(lambda: print('TORCH', 'torch' in sys.modules)); "
    probe += "sys.argv = ['train.py', '--help']; runpy.run_path('train.py', run_name='__main__')"
    answer = subprocess.run(
        [sys.executable, "-c", probe], cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=True
    )
    assert "TORCH False" in answer.stdout
    for line in ("loss:", "optimizer: adam, adamw", "task:", "trainer:", "debug: anomaly, fast", "== Examples =="):
        assert line in answer.stdout


@pytest.mark.parametrize(
    ("argument", "answer"),
    [
        ("optimzer.lr=1", "there is no setting 'optimzer.lr'; did you mean optimizer.lr?"),
        ("trainer.max_step=1", "there is no setting 'trainer.max_step'; did you mean trainer.max_steps?"),
        ("lr=1", "there is no setting 'lr'; did you mean optimizer.lr?"),
        ("optimizer=adm", "there is no optimizer 'adm'; did you mean adam"),
        ("loss=[silhuette]", "there is no loss 'silhuette'; did you mean silhouette?"),
        ("experiment=nonsense", "there is no experiment 'nonsense'; "),
        ("debug=fsat", "there is no debug 'fsat'; did you mean fast?"),
        ("optimizer.lr=1,2", "Ambiguous value for argument 'optimizer.lr=1,2'"),
        ("+optimizer.weight_decays=1", "optimizer.weight_decays: Adam takes no 'weight_decays'; did you mean"),
        ("seed=many", "seed must be a whole number, got 'many'"),
        ("loss.texture.prediction=rbg", "LossTerm 'texture': the prediction (ToyPrediction) has no field 'rbg'"),
        ("data=???", "data"),
        ("data._target_=os.system", "data: a configuration may not call 'os.system'"),
        ("ckpt_path=nowhere", "ckpt_path: there is neither a checkpoint nor a run folder at nowhere"),
        ("ckpt_path=last", "there is no checkpoint under outputs/toy; start without ckpt_path"),
        ("loss.texture.weight=${nothing}", "Interpolation key 'nothing' not found"),
        ("trainer.max_steps=many", "trainer.max_steps must be a whole number, got 'many'"),
        ("optimizer.lr=much", "optimizer.lr must be a number, got 'much'"),
    ],
)
def test_mistakes_are_answered_in_one_line(argument: str, answer: str, train: Train) -> None:
    code, _, err = train(argument)
    assert code == 2
    assert err.startswith("train.py: ")
    assert answer in err
    assert err.count("\n") == 1


def test_files_that_are_malformed_or_missing_are_mistakes(program: Train, tmp_path: Path) -> None:
    (tmp_path / "bad.obj").write_text("v 0 0\n")
    (tmp_path / "a.doc").write_text("v 0 0 0\n")
    for value, answer in (
        ("bad.obj", "bad.obj, line 1: "),
        ("none.obj", "data.path: there is no file"),
        ("a.doc", "data.path: No mesh or point cloud interpreter found to read"),
    ):
        code, _, err = program("train.py", "task=mesh_fit", f"data.path={tmp_path / value}")
        assert code == 2
        assert answer in err
        assert err.count("\n") == 1


def test_a_cloud_cannot_be_localized(program: Train, tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    code, _, err = program("train.py", "task=localize", f"data.paths=[{tmp_path / 'a.xyz'}]")
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith("train.py: data.paths: No mesh interpreter found to read")


@pytest.mark.parametrize(
    "setting", ["data.displacement=[1.0,2.0,1e30]", "module.start=[nan,0.0,0.0]", "module.start=[0.0]"]
)
def test_a_displacement_is_three_numbers(setting: str, program: Train) -> None:
    code, _, err = program("train.py", "task=localize", setting)
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"train.py: {setting.partition('=')[0]} must be ")


@pytest.mark.parametrize(
    ("argument", "answer"),
    [
        ("data.name=dog", "there is no mesh 'dog'; there are cow, ico_sphere, torus, cube, or give a path"),
        ("data.scan_points=many", "data.scan_points must be a whole number, got 'many'"),
        ("data.noise=-1.0", "data.noise must lie between 0 and 1e+06, got -1.0"),
        ("module.samples=0", "module.samples must be at least 1, or null, got 0"),
        ("surface.levels=[12]", "module.surface: surface.levels must be at most 7, got [12]"),
    ],
)
def test_settings_of_a_task_are_mistakes_in_its_words(argument: str, answer: str, program: Train) -> None:
    code, _, err = program("train.py", "task=mesh_fit", argument)
    assert code == 2
    assert err.startswith(f"train.py: {answer}")
    assert err.count("\n") == 1


def test_a_bug_shows_its_traceback(train: Train, tmp_path: Path) -> None:
    code, _, err = train("+module.fail_at=2")
    assert code == 1
    assert "Traceback" in err
    assert "the toy broke as told" in err
    (log,) = tmp_path.rglob("train.log")
    assert "the toy broke as told" in log.read_text()


def test_a_run_may_leave_out_the_metric_that_its_task_optimises(train: Train) -> None:
    code, _, _ = train("metric=[]", "debug=fast")
    assert code == 0
    code, _, err = train("metric=[]", "debug=fast", "optimized_metric=test/psnr")
    assert code == 2
    assert "this run has no 'test/psnr'" in err


def test_two_runs_of_one_moment_have_two_folders(train: Train, tmp_path: Path) -> None:
    for _ in range(2):
        assert train("debug=fast", "callbacks=[timer]")[0] == 0
    assert len(list((tmp_path / "outputs" / "toy").iterdir())) == 2


def test_a_sweep_ends_with_its_table(train: Train, tmp_path: Path) -> None:
    code, out, _ = train("-m", "optimizer.lr=0.001,0.1", "+note=../a/b.png", "debug=fast")
    assert code == 0
    (sweep,) = (tmp_path / "outputs" / "toy").iterdir()
    jobs = sorted(path.name for path in sweep.iterdir() if path.is_dir() and path.name != ".claims")
    assert jobs == ["0_note=..-a-b.png-optimizer.lr=0.001", "1_note=..-a-b.png-optimizer.lr=0.1"]
    assert all(list((sweep / job).glob("events.out.tfevents.*")) for job in jobs)
    runs = json.loads((sweep / "summary.json").read_text())["runs"]
    assert [run["settings"]["optimizer.lr"] for run in runs] == ["0.1", "0.001"]  # best psnr first
    assert [run["status"] for run in runs] == ["ok", "ok"]
    markdown = (sweep / "summary.md").read_text().splitlines()
    assert markdown[0] == "| job | optimizer.lr | test/psnr | test/iou | seconds | status |"
    assert markdown[2].startswith("| 1 | 0.1 | ")
    assert (sweep / "summary.csv").read_text().splitlines()[0] == "job,optimizer.lr,test/psnr,test/iou,seconds,status"
    assert "2 runs, best test/psnr first" in out
    assert f"tensorboard --logdir outputs/toy/{sweep.name}\n" in out


def test_a_failed_job_is_in_the_table_and_in_the_exit_code(train: Train, tmp_path: Path) -> None:
    code, out, err = train("-m", "+module.fail_at=1,null", "debug=fast")
    assert code == 1
    assert "job 0 failed: RuntimeError: the toy broke as told" in out
    assert "Traceback" not in err
    (summary,) = tmp_path.rglob("summary.json")
    assert [run["status"] for run in json.loads(summary.read_text())["runs"]] == ["ok", "failed"]


def test_a_sweep_that_cannot_begin_says_why(train: Train) -> None:
    code, out, err = train("-m", "optimizer.rate=1,2")
    assert code == 2
    assert "there is no setting 'optimizer.rate'" in err
    assert "runs" not in out


@pytest.mark.slow
def test_a_killed_run_goes_on(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "tests"), "RENDRA_LAB_PACKAGES": "rendra_lab_toy"}
    search = f"hydra.searchpath=[file://{Path(__file__).parent / 'conf'}]"
    command = [
        sys.executable,
        str(REPOSITORY / "train.py"),
        "task=toy",
        search,
        "callbacks.checkpoint.every_n_train_steps=50",
    ]
    killed = subprocess.Popen([*command, "trainer.max_steps=1000000"], cwd=tmp_path, env=environment)
    for _ in range(600):
        if list(tmp_path.rglob("last.ckpt")):
            break
        with_timeout(killed)
    killed.kill()
    killed.wait()
    more = subprocess.run(
        [*command, "trainer.max_steps=3000", "ckpt_path=last"], cwd=tmp_path, env=environment, check=True, timeout=120
    )
    assert more.returncode == 0
    (record,) = [json.loads(path.read_text()) for path in tmp_path.rglob("metrics.json")]
    assert record["steps"] == 3000
    assert record["resumed_from"].endswith("last.ckpt")


def with_timeout(process: subprocess.Popen) -> None:
    try:
        process.wait(timeout=0.1)
    except subprocess.TimeoutExpired:
        return
    raise AssertionError("the run ended before it was killed")


@pytest.mark.slow
def test_a_distributed_sweep_has_one_folder_and_survives_a_failure(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "tests"), "RENDRA_LAB_PACKAGES": "rendra_lab_toy"}
    search = f"hydra.searchpath=[file://{Path(__file__).parent / 'conf'}]"
    command = [sys.executable, str(REPOSITORY / "train.py"), "-m", "task=toy", search, "trainer=ddp"]
    command += ["trainer.accelerator=cpu", "debug=fast", "+module.fail_at=2,null"]
    with (tmp_path / "said").open("w") as said:
        answer = subprocess.run(
            command, cwd=tmp_path, env=environment, stdout=said, stderr=said, timeout=180, check=False
        )
    assert answer.returncode == 1
    (sweep,) = (tmp_path / "outputs" / "toy").iterdir()
    runs = json.loads((sweep / "summary.json").read_text())["runs"]
    assert [run["status"] for run in runs] == ["ok", "failed"]


def test_a_finished_run_is_scored_and_shown_again_by_a_script(train: Train, program: Train, tmp_path: Path) -> None:
    table = "+callbacks.report={_target_:rendra_lab.callbacks.BatchReport,table:'${run_dir}/exports/batches.csv'}"
    assert train("debug=fast", table)[0] == 0
    (folder,) = (tmp_path / "outputs" / "toy").iterdir()
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    code, out, _ = program("scripts/evaluate.py", str(folder), "--json")
    assert code == 0
    fitted = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert json.loads(out)["test/psnr"] == fitted["test/psnr"]
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    code, out, _ = program("scripts/evaluate.py", str(folder), "--output")
    assert code == 0
    assert out.rstrip().endswith("evaluation")
    written = folder / "evaluation" / "exports" / "batches.csv"
    assert written.read_text() == (folder / "exports" / "batches.csv").read_text()
    assert set(folder.rglob("*")) == {*before, *written.parents[:2], written}
    code, _, err = program("scripts/evaluate.py", str(folder), "data.sise=3")
    assert code == 2
    assert "data.sise: ToyData takes no 'sise'" in err
    code, _, err = program("scripts/evaluate.py", str(folder), "--output", "data.size_px=8")
    assert code == 2
    assert "--output takes a folder or stands last, got data.size_px=8" in err
