"""JSON files of joints that other programs write: OpenPose, COCO, MediaPipe, and our own lists of pictures.

What is recognised, by the keys of the file:

| file | by | third number of a joint |
|---|---|---|
| OpenPose, a file a picture | `people`, each with `pose_keypoints_2d` | confidence |
| COCO's annotations | `annotations` and `images` | flag: 0 not labelled, 1 labelled but hidden (0.5), 2 seen (1) |
| COCO's results | a list of objects with `image_id` and `keypoints` | confidence |
| MediaPipe | `landmarks` or `pose_landmarks` | visibility |
| pictures, as scripts/detect_joints.py writes them | `pictures`, each with `file_name` and `people` | confidence |

Joints are triples, one after the other or each a list, or objects with x, y and visibility (or score, confidence).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rendra_lab.data.json_fields import Fields, read_json_value
from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.joint_layouts import LAYOUTS, Joints, Layout

_MOST_FILES = 100_000
_SURE = ("visibility", "score", "confidence")
_EXPECTED = "OpenPose's people, COCO's annotations or results, MediaPipe's landmarks, or pictures"


@dataclass(frozen=True)
class FoundPerson:
    """A person of a JSON file, as it stands there.

    Attributes:
        where: file and person, for complaints.
        pictures: what the picture may be called, with its suffix or without.
        size: height and width of the picture, where the file says so.
        layout: the skeleton.
        numbers: (K, 3) x, y and confidence, not yet checked.
    """

    where: str
    pictures: tuple[str, ...]
    size: tuple[int, int] | None
    layout: Layout
    numbers: Joints


class JointFiles:
    """Reads people.

    Args:
        layout: a name of LAYOUTS; auto goes by what the file says, and by the number of joints.

    Raises:
        UserError: an unknown layout.
    """

    def __init__(self, layout: str = "auto") -> None:
        if layout != "auto" and layout not in LAYOUTS:
            raise UserError(f"data.layout is one of auto {' '.join(LAYOUTS)}; got {layout!r}")
        self.layout = layout
        self.left_out = 0  # people whom COCO's annotations give no joint

    def read(self, path: Path) -> list[FoundPerson]:
        """The people of a file, or of all .json files of a folder by name.

        Raises:
            UserError: no such file, another format, an unknown skeleton, or a picture that comes twice.
        """
        people: list[FoundPerson] = []
        owners: dict[str, Path] = {}
        for file in _files(path):
            found = list(self._people(file))
            for name in {person.pictures[0] for person in found}:
                if owners.setdefault(name, file) != file:
                    raise UserError(f"{file}: the picture {name!r} is in {owners[name]} too; expected each one once")
            people += found
        if not people:
            why = f": all {self.left_out} annotations have no labelled joint" if self.left_out else ""
            raise UserError(f"{path} holds no people{why}; expected one at least")
        return people

    def _people(self, file: Path) -> Iterator[FoundPerson]:
        tree = read_json_value(file)
        if isinstance(tree, list):
            return self._coco_results(tree, str(file))
        if not isinstance(tree, dict):
            raise UserError(f"{file} holds a {type(tree).__name__}; expected {_EXPECTED}")
        readers: dict[str, Callable[[Fields, Path], Iterator[FoundPerson]]] = {
            "pictures": self._pictures,
            "annotations": self._coco_annotations,
            "people": self._openpose,
            "landmarks": self._landmarks,
            "pose_landmarks": self._landmarks,
        }
        for key, reader in readers.items():
            if key in tree:
                return reader(Fields(tree, str(file)), file)
        held = ", ".join(map(repr, list(tree)[:8])) or "nothing"
        raise UserError(f"{file} holds {held}; expected {_EXPECTED}")

    def _openpose(self, fields: Fields, file: Path) -> Iterator[FoundPerson]:
        name = file.stem.removesuffix("_keypoints")
        for index, person in enumerate(_objects(fields, "people")):
            where = f"{file}, person {index}"
            key = next((key for key in ("pose_keypoints_2d", "pose_keypoints") if key in person), None)
            if key is None:
                raise UserError(f"{where}: 'pose_keypoints_2d' is missing; expected 25 or 18 triples of numbers")
            yield self._person(where, (name,), _size(fields), person[key])

    def _coco_annotations(self, fields: Fields, file: Path) -> Iterator[FoundPerson]:
        pictures: dict[Any, Fields] = {}
        for index, image in enumerate(_objects(fields, "images")):
            picture = Fields(image, f"{file}, image {index}")
            key = _id(picture, "id")
            if key in pictures:
                raise UserError(f"{picture.where}: the id {key!r} is there twice; expected each one once")
            pictures[key] = picture
        ids: set[Any] = set()
        for index, annotation in enumerate(_objects(fields, "annotations")):
            one = Fields(annotation, f"{file}, annotation {index}")
            _demand_new(one, ids)
            image_id = _id(one, "image_id")
            if image_id not in pictures:
                raise one.complaint("image_id", "the id of one of the images")
            if "keypoints" not in annotation:
                raise one.complaint("keypoints", "17 triples of numbers")
            picture = pictures[image_id]
            person = self._person(one.where, (picture.text("file_name"),), _size(picture), annotation["keypoints"])
            if person.numbers[:, 2].any():
                yield _with_flags(person)
            else:
                self.left_out += 1

    def _coco_results(self, tree: list[Any], file: str) -> Iterator[FoundPerson]:
        for index, result in enumerate(tree):
            where = f"{file}, result {index}"
            if not isinstance(result, dict):
                raise UserError(f"{where} is a {type(result).__name__}; expected an object with image_id, keypoints")
            one = Fields(result, where)
            key = _id(one, "image_id")
            if "keypoints" not in result:
                raise one.complaint("keypoints", "17 triples of numbers")
            names = (key,) if isinstance(key, str) else (f"{key:012d}", str(key))
            yield self._person(where, names, None, result["keypoints"])

    def _landmarks(self, fields: Fields, file: Path) -> Iterator[FoundPerson]:
        key = "landmarks" if "landmarks" in fields.tree else "pose_landmarks"
        value = fields.tree[key]
        if not isinstance(value, list):
            raise fields.complaint(key, "a list of landmarks")
        name = fields.text("file_name") if "file_name" in fields else file.stem
        several = bool(value) and isinstance(value[0], list) and bool(value[0]) and not _is_number(value[0][0])
        for index, one in enumerate(value if several else [value] if value else []):
            yield self._person(f"{file}, person {index}", (name,), _size(fields), one, _named(fields))

    def _pictures(self, fields: Fields, file: Path) -> Iterator[FoundPerson]:
        names: set[str] = set()
        for index, entry in enumerate(_objects(fields, "pictures")):
            picture = Fields(entry, f"{file}, picture {index}")
            name = picture.text("file_name")
            if name in names:
                raise UserError(f"{picture.where}: {name!r} is there twice; expected each picture once")
            names.add(name)
            for number, person in enumerate(_objects(picture, "people")):
                where = f"{file}, {name}, person {number}"
                if "joints" not in person:
                    raise Fields(person, where).complaint("joints", "triples of x, y and confidence")
                yield self._person(where, (name,), _size(picture), person["joints"], _named(fields))

    def _person(
        self,
        where: str,
        pictures: tuple[str, ...],
        size: tuple[int, int] | None,
        value: Any,
        named: str | None = None,
    ) -> FoundPerson:
        """A person of triples in any of their forms; `named` is the layout that the file says it has."""
        if named is not None and (named not in LAYOUTS or self.layout not in ("auto", named)):
            expected = f"data.layout={self.layout}" if named in LAYOUTS else f"one of {' '.join(LAYOUTS)}"
            raise UserError(f"{where}: the file's layout is {named!r}; expected {expected}")
        triples = _triples(value, where)
        layout = self._layout(len(triples), where, named)
        rows = [_triple(triple, f"{where}, {joint}") for triple, joint in zip(triples, layout.joints, strict=True)]
        return FoundPerson(where, pictures, size, layout, np.array(rows))

    def _layout(self, count: int, where: str, named: str | None) -> Layout:
        wanted = named or self.layout
        if wanted != "auto":
            layout = LAYOUTS[wanted]
            if count != len(layout.joints):
                raise UserError(f"{where}: it has {count} joints; {wanted} has {len(layout.joints)}")
            return layout
        for layout in LAYOUTS.values():
            if count == len(layout.joints):
                return layout
        known = ", ".join(f"{len(layout.joints)} ({layout.name})" for layout in LAYOUTS.values())
        raise UserError(f"{where}: it has {count} joints; expected one of {known}")


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = [file for file, _ in zip(path.glob("*.json"), range(_MOST_FILES + 1), strict=False)]
    if not files:
        raise UserError(f"there is no .json file in {path}")
    if len(files) > _MOST_FILES:
        raise UserError(f"{path} holds more than {_MOST_FILES:,} .json files; no more are read")
    return sorted(files)


def _objects(fields: Fields, key: str) -> list[dict[str, Any]]:
    """A list of objects, perhaps of none."""
    return [] if fields.tree.get(key) == [] else fields.objects(key)


def _id(fields: Fields, key: str) -> int | str:
    value = fields.tree.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, str)) or (isinstance(value, int) and value < 0):
        raise fields.complaint(key, "a number from 0, or a name")
    return value if isinstance(value, str) else min(value, 10**18)


def _demand_new(fields: Fields, known: set[Any]) -> None:
    if "id" not in fields:
        return
    key = _id(fields, "id")
    if key in known:
        raise UserError(f"{fields.where}: the id {key!r} is there twice; expected each one once")
    known.add(key)


def _size(fields: Fields) -> tuple[int, int] | None:
    if "width" not in fields and "height" not in fields:
        return None
    return fields.pixels("height"), fields.pixels("width")


def _named(fields: Fields) -> str | None:
    return fields.text("layout") if "layout" in fields else None


def _with_flags(person: FoundPerson) -> FoundPerson:
    """COCO's flags 0, 1 and 2 as confidences."""
    flags = person.numbers[:, 2]
    bad = np.flatnonzero(~np.isin(flags, (0, 1, 2)))
    if len(bad):
        joint = person.layout.joints[bad[0]]
        raise UserError(f"{person.where}, {joint}: the flag is {flags[bad[0]]:g}; expected 0, 1 or 2")
    numbers = person.numbers * [1.0, 1.0, 0.5]
    return FoundPerson(person.where, person.pictures, person.size, person.layout, numbers)


def _triples(value: Any, where: str) -> list[Any]:
    """What stands for each joint: a list of three numbers, or an object."""
    if not isinstance(value, list):
        raise UserError(f"{where}: its joints are a {type(value).__name__}; expected a list of triples")
    if not value or not _is_number(value[0]):
        return value
    if len(value) % 3:
        raise UserError(f"{where}: its joints are {len(value)} numbers; expected triples of x, y and confidence")
    return [value[at : at + 3] for at in range(0, len(value), 3)]


def _triple(value: Any, where: str) -> tuple[float, float, float]:
    if isinstance(value, dict):
        sure = next((key for key in _SURE if key in value), "visibility")
        value = [value[key] for key in ("x", "y", sure) if key in value]
    if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
        found = repr(value) if len(repr(value)) < 60 else f"{repr(value)[:57]}..."
        raise UserError(f"{where}: it is {found}; expected three numbers, x, y and confidence")
    try:
        return float(value[0]), float(value[1]), float(value[2])
    except OverflowError:
        raise UserError(f"{where}: it holds a number beyond all pictures; expected pixels") from None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
