"""Finds the joints of a person in photographs: `python scripts/detect_joints.py PHOTO ... --output joints.json`.

An optional tool with an environment of its own (tools/detect_joints/requirements.txt): MediaPipe finds the most
prominent person of each photograph. The file holds its 33 landmarks in pixels and the size of each picture;
`python train.py task=smplify data=joints_json data.path=joints.json` fits a body to them.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

INSTALL = (
    "MediaPipe is not installed here. In an environment of its own: python3.11 -m venv .detector && "
    ".detector/bin/pip install --no-deps -r tools/detect_joints/requirements.txt && "
    ".detector/bin/python scripts/detect_joints.py ..."
)
_LANDMARKS = 33


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints what was found; a mistake is one line on stderr and exit code 2."""
    options = _parser().parse_args(arguments)
    output = Path(options.output)
    if output.exists() and not options.force:
        _stop(f"{output} exists; --force replaces it")
    photos = [Path(photo) for photo in options.photos]
    names = [photo.name for photo in photos]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        _stop(f"{twice} is given twice; every photograph needs a name of its own")
    os.environ.setdefault("GLOG_minloglevel", "2")  # MediaPipe's own log would come between the lines
    detect = _detector(options.min_confidence)
    pictures = [picture for photo in photos for picture in _found(photo, detect)]
    if not pictures:
        _stop(f"nobody was found in {', '.join(names)}; nothing is written")
    tree = {"layout": "mediapipe33", "made_by": "mediapipe 0.10.21", "pictures": pictures}
    output.parent.mkdir(parents=True, exist_ok=True)
    partial = output.with_name(f".{output.name}.partial")
    partial.write_text(json.dumps(tree, indent=1) + "\n")
    partial.replace(output)
    print(f"{output}: {len(pictures)} of {len(photos)} photographs. To fit a body:")
    folders = {photo.resolve().parent for photo in photos}
    beside = "" if folders == {output.resolve().parent} else f" data.images={photos[0].parent}"
    print(f"python train.py task=smplify data=joints_json data.path={output}{beside}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="detect_joints.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", nargs="+", help="photographs, in one folder: fitting looks for them by name")
    parser.add_argument("--output", default="joints.json", help="file to write (joints.json)")
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    parser.add_argument("--min-confidence", type=float, default=0.5, help="that somebody is there, 0 to 1 (0.5)")
    return parser


def _detector(min_confidence: float) -> Any:
    """A function from pixels (H, W, 3) to 33 rows of shares of the picture and visibility, or None."""
    if not 0 <= min_confidence <= 1:
        _stop(f"--min-confidence lies between 0 and 1, got {min_confidence:g}")
    try:
        pose = importlib.import_module("mediapipe.python.solutions.pose")
    except ImportError as error:
        _stop(INSTALL if error.name == "mediapipe" else f"{INSTALL} ({error})")
    detector = pose.Pose(static_image_mode=True, model_complexity=1, min_detection_confidence=min_confidence)

    def detect(pixels: Any) -> list[tuple[float, float, float]] | None:
        found = detector.process(pixels).pose_landmarks
        if found is None:
            return None
        return [(float(mark.x), float(mark.y), float(mark.visibility)) for mark in found.landmark]

    return detect


def _found(photo: Path, detect: Any) -> Iterator[dict[str, Any]]:
    """The entry of a photograph; none where nobody is."""
    pixels = _pixels(photo)
    marks = detect(pixels)
    if marks is None:
        print(f"{photo}: nobody found")
        return
    assert len(marks) == _LANDMARKS
    height, width = pixels.shape[:2]
    seen = sum(visibility >= 0.5 for *_, visibility in marks)
    print(f"{photo}: a person, {seen} of {_LANDMARKS} landmarks visible")
    joints = [[round(x * width, 2), round(y * height, 2), round(visibility, 4)] for x, y, visibility in marks]
    yield {"file_name": photo.name, "width": width, "height": height, "people": [{"joints": joints}]}


def _pixels(photo: Path) -> Any:
    """Colours (H, W, 3) uint8 as people look at them: EXIF data that turn the photograph are followed."""
    import numpy as np
    from PIL import Image, ImageOps

    if not photo.is_file():
        _stop(f"there is no file {photo}")
    try:
        with Image.open(photo) as image:
            return np.ascontiguousarray(ImageOps.exif_transpose(image).convert("RGB"))
    except Exception as error:  # decoders raise what they like
        _stop(f"{photo} is not a picture that can be read: {error}")


def _stop(message: str) -> Any:
    sys.stderr.write(f"detect_joints.py: {' '.join(message.split())}\n")
    raise SystemExit(2)


if __name__ == "__main__":
    main()
