"""`scripts/detect_joints.py`: what it writes is what `data=joints_json` reads; MediaPipe itself is stood in for."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from small_files import image_bytes

from rendra_lab.tasks.smplify.joints_json import JointsJSON
from rendra_lab.tasks.smplify.records import LSP_JOINTS

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("detect_joints", ROOT / "scripts" / "detect_joints.py")
program = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(program)

MARKS = np.random.default_rng(1).uniform(0.2, 0.9, (33, 3))


class _Pose:
    """Finds the same person in every photograph that is not black."""

    def __init__(self, **settings: object) -> None:
        assert settings == {"static_image_mode": True, "model_complexity": 1, "min_detection_confidence": 0.5}

    def process(self, pixels: np.ndarray) -> SimpleNamespace:
        assert pixels.dtype == np.uint8
        assert pixels.flags.c_contiguous
        marks = [SimpleNamespace(x=x, y=y, visibility=v) for x, y, v in MARKS]
        return SimpleNamespace(pose_landmarks=SimpleNamespace(landmark=marks) if pixels.any() else None)


@pytest.fixture
def detector(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder with photographs, and something in MediaPipe's place."""
    module = ModuleType("mediapipe.python.solutions.pose")
    module.Pose = _Pose
    for name in ("mediapipe", "mediapipe.python", "mediapipe.python.solutions"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "a.jpg").write_bytes(image_bytes("JPEG", (120, 90), exif=exif.tobytes()))
    Image.new("RGB", (40, 30)).save(tmp_path / "black.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        program.main(arguments)
    assert end.value.code == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    return message


def test_what_it_finds_is_read_back_upright(detector: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program.main(["a.jpg", "black.png", "--output", "out/joints.json"])
    said = capsys.readouterr().out
    assert "black.png: nobody found" in said
    assert "data=joints_json data.path=out/joints.json data.images=." in said
    data = JointsJSON(detector / "out" / "joints.json", images=detector)
    data.setup("fit")
    assert data.people.size_px.tolist() == [[120, 90]]
    ankle = data.people.joints_px[0, LSP_JOINTS.index("right_ankle")]
    assert ankle.tolist() == pytest.approx([MARKS[28, 0] * 90, MARKS[28, 1] * 120], abs=0.01)
    assert data.picture(0).shape == (120, 90, 3)


def test_a_file_is_replaced_only_on_demand(detector: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (detector / "joints.json").write_text("mine")
    assert "joints.json exists; --force replaces it" in refusal(capsys, "a.jpg")
    program.main(["a.jpg", "--force"])
    tree = json.loads((detector / "joints.json").read_text())
    assert tree["layout"] == "mediapipe33"
    assert [path.name for path in detector.glob(".*")] == []


def test_mistakes_are_one_line(detector: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no file away.jpg" in refusal(capsys, "away.jpg")
    assert "nobody was found in black.png; nothing is written" in refusal(capsys, "black.png")
    assert "a.jpg is given twice" in refusal(capsys, "a.jpg", "./a.jpg")
    assert "--min-confidence lies between 0 and 1, got 2" in refusal(capsys, "a.jpg", "--min-confidence", "2")
    (detector / "broken.jpg").write_bytes(b"\xff\xd8")
    assert "broken.jpg is not a picture that can be read" in refusal(capsys, "broken.jpg")
    assert not (detector / "joints.json").exists()


def test_without_mediapipe_it_says_how_to_install_it(
    detector: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mediapipe.python.solutions.pose", None)
    message = refusal(capsys, "a.jpg")
    assert "MediaPipe is not installed here" in message
    assert "pip install --no-deps -r tools/detect_joints/requirements.txt" in message
    assert (ROOT / "tools" / "detect_joints" / "requirements.txt").is_file()
