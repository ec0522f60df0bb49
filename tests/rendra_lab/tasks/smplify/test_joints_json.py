"""`data=joints_json`: every layout and every kind of file, written here; what is refused, and how it is said."""

import inspect
import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from assertions import assert_close
from file_mutations import damaged, edits
from hypothesis import HealthCheck, given, settings
from omegaconf import OmegaConf
from PIL import Image
from small_files import image_bytes

from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.joint_layouts import LAYOUTS
from rendra_lab.tasks.smplify.joints_json import JointsJSON
from rendra_lab.tasks.smplify.lsp import LSP
from rendra_lab.tasks.smplify.picture_people import PicturePeople
from rendra_lab.tasks.smplify.records import LSP_JOINTS

SIZE = (120, 90)  # height, width
NECK, HEAD = LSP_JOINTS.index("neck"), LSP_JOINTS.index("head_top")
OF_COUNT = {25: "openpose_body25", 18: "openpose_coco18", 17: "coco17", 33: "mediapipe33", 14: "lsp14"}


def rows(layout: str, seed: int = 0) -> list[list[float]]:
    """A person: x, y, confidence."""
    draw = np.random.default_rng(seed)
    count = len(LAYOUTS[layout].joints)
    return np.concatenate([draw.uniform(5, 85, (count, 2)), draw.uniform(0.2, 1, (count, 1))], 1).tolist()


def flat(triples: list[list[float]]) -> list[float]:
    return [number for triple in triples for number in triple]


def openpose(*people: list[list[float]]) -> dict[str, object]:
    return {"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": flat(person)} for person in people]}


def pictures(layout: str, *people: list[list[float]], **fields: object) -> dict[str, object]:
    entry = {"file_name": "a.jpg", "height": SIZE[0], "width": SIZE[1], "people": [{"joints": p} for p in people]}
    return {"layout": layout, "pictures": [{**entry, **fields}]}


def coco(*keypoints: list[float], **fields: object) -> dict[str, object]:
    images = [{"id": 7, "file_name": "a.jpg", "height": SIZE[0], "width": SIZE[1]}]
    people = [{"id": i, "image_id": 7, "keypoints": k, "num_keypoints": 17} for i, k in enumerate(keypoints)]
    return {"images": images, "annotations": people, **fields}


def write(path: Path, tree: object) -> Path:
    path.write_text(json.dumps(tree))
    return path


def people(path: Path, **given: object) -> JointsJSON:
    data = JointsJSON(path, **given)
    data.setup("fit")
    return data


def refused(path: Path, tree: object, **given: object) -> str:
    with pytest.raises(UserError) as refusal:
        people(write(path, tree), **given)
    assert "\n" not in str(refusal.value)
    assert str(path) in str(refusal.value)
    return str(refusal.value).removeprefix(str(path))


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=list(LAYOUTS))
def test_tables_lead_from_each_joint_to_that_of_the_same_name(layout) -> None:
    assert len(layout.sources) == 14
    assert len(set(layout.joints)) == len(layout.joints)
    for name, source in zip(LSP_JOINTS, layout.sources, strict=True):
        named = [layout.joints[row] for row in source]
        if name in layout.joints:
            assert named == [name]
        elif name == "neck":
            assert named == ["left_shoulder", "right_shoulder"]
        else:
            assert (name, named) == ("head_top", [])


@pytest.mark.parametrize("layout", list(LAYOUTS))
@pytest.mark.parametrize("asked", ["auto", "named"])
def test_every_layout_gives_lsps_joints(
    tmp_path: Path, layout: str, asked: str, caplog: pytest.LogCaptureFixture
) -> None:
    person = rows(layout)
    tree = pictures(layout, person)
    del tree["layout"]  # known by the number of joints alone
    with caplog.at_level(logging.INFO):
        batch = people(write(tmp_path / "j.json", tree), layout="auto" if asked == "auto" else layout).people
    assert f"1 people of {layout}" in caplog.text
    names = LAYOUTS[layout].joints
    half = 0.0 if layout in ("mediapipe33", "lsp14") else 0.5
    for row, name in enumerate(LSP_JOINTS):
        if name in names:
            x, y, confidence = person[names.index(name)]
            assert_close(batch.joints_px[0, row], torch.tensor([x + half, y + half]))
            assert float(batch.confidence[0, row]) == pytest.approx(confidence)
    if "neck" not in names:
        left, right = (person[names.index(f"{side}_shoulder")] for side in ("left", "right"))
        middle = (np.array(left) + np.array(right))[:2] / 2 + half
        assert_close(batch.joints_px[0, NECK], torch.tensor(middle).float())
        assert float(batch.confidence[0, NECK]) == pytest.approx(min(left[2], right[2]))
    assert float(batch.confidence[0, HEAD]) == (pytest.approx(person[-1][2]) if layout == "lsp14" else 0.0)


def test_the_camera_of_an_unknown_photograph_sees_its_diagonal(tmp_path: Path) -> None:
    path = write(tmp_path / "j.json", pictures("lsp14", rows("lsp14")))
    batch = people(path).people
    assert batch.size_px.tolist() == [[120, 90]]
    assert batch.focal_px.tolist() == [150]
    assert batch.center_px.tolist() == [[45, 60]]
    assert people(path, focal_px=777.0).people.focal_px.tolist() == [777]


def test_openposes_folder_is_read_by_name_with_several_people_a_picture(tmp_path: Path) -> None:
    first, second, third = (rows("openpose_body25", seed) for seed in range(3))
    write(tmp_path / "b_keypoints.json", openpose(third))
    write(tmp_path / "a_keypoints.json", openpose(first, second))
    write(tmp_path / "empty_keypoints.json", openpose())
    (tmp_path / "images").mkdir()
    for name in ("a.png", "b.JPG"):
        (tmp_path / "images" / name).write_bytes(image_bytes("PNG", SIZE[::-1]))
    data = people(tmp_path, images=tmp_path / "images")
    assert [Path(name).name for name in data.people.pictures] == ["a.png", "a.png", "b.JPG"]
    wrists = [person[4][:2] for person in (first, second, third)]
    assert_close(data.people.joints_px[:, LSP_JOINTS.index("right_wrist")], torch.tensor(wrists) + 0.5)
    assert data.picture(2).shape == (*SIZE, 3)
    assert people(tmp_path, images=tmp_path / "images", first=1, count=1).people.pictures == data.people.pictures[1:2]


def test_cocos_flags_are_confidences_and_people_without_joints_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    person = rows("coco17")
    for row, triple in enumerate(person):
        triple[2] = row % 3
    with caplog.at_level(logging.INFO):
        batch = people(write(tmp_path / "j.json", coco(flat(person), [0] * 51))).people
    assert batch.pictures == ("a.jpg",)
    assert "1 annotations without a labelled joint are left out" in caplog.text
    assert batch.confidence[0, LSP_JOINTS.index("left_shoulder")] == 1  # row 5
    assert batch.confidence[0, LSP_JOINTS.index("left_elbow")] == 0.5  # row 7
    assert batch.confidence[0, LSP_JOINTS.index("right_shoulder")] == 0  # row 6
    assert batch.confidence[0, NECK] == 0


def test_cocos_results_find_their_pictures_by_number_and_by_name(tmp_path: Path) -> None:
    for name in ("000000000042.jpg", "9.png", "walk.jpg"):
        (tmp_path / name).write_bytes(image_bytes("PNG", SIZE[::-1]))
    tree = [
        {"image_id": key, "category_id": 1, "score": 2.5, "keypoints": flat(rows("coco17", seed))}
        for seed, key in enumerate((42, 9, "walk.jpg", 42))
    ]
    names = [Path(name).name for name in people(write(tmp_path / "r.json", tree)).people.pictures]
    assert names == ["000000000042.jpg", "9.png", "walk.jpg", "000000000042.jpg"]


@pytest.mark.parametrize("in_shares", [True, False])
@pytest.mark.parametrize("several", [True, False])
def test_mediapipes_landmarks_are_pixels_or_shares_of_the_picture(
    tmp_path: Path, in_shares: bool, several: bool
) -> None:
    person = rows("mediapipe33")
    width, height = (90, 120) if in_shares else (1, 1)
    marks = [{"x": x / width, "y": y / height, "z": -0.1, "visibility": v} for x, y, v in person]
    marks[32]["x"], marks[32]["visibility"] = 7.5, 0.01  # a toe that was never seen
    tree = {"pose_landmarks": [marks, marks] if several else marks}
    batch = people(write(tmp_path / "j.json", tree), size=[120, 90]).people
    assert len(batch.joints_px) == 1 + several
    assert_close(batch.joints_px[-1, LSP_JOINTS.index("left_ankle")], torch.tensor(person[27][:2]))


def test_joints_of_little_confidence_are_not_found(tmp_path: Path) -> None:
    person = rows("lsp14")
    person[4] = [1e9, float("inf"), 0.09]
    person[5] = [20, 30, 7.0]
    path = write(tmp_path / "j.json", pictures("lsp14", person))
    batch = people(path).people
    assert batch.confidence[0, 4] == 0
    assert bool(batch.joints_px.isfinite().all())
    assert batch.confidence[0, 5] == 1
    assert "left_knee" in refused(path, pictures("lsp14", person), least_confidence=0.0)


def test_a_photograph_that_exif_data_turn_is_taken_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "a.jpg").write_bytes(image_bytes("JPEG", (120, 90), exif=exif.tobytes()))
    data = people(write(tmp_path / "j.json", pictures("lsp14", rows("lsp14"))))
    assert data.people.size_px.tolist() == [[120, 90]]
    upright = np.asarray(Image.open(tmp_path / "a.jpg").convert("RGB").transpose(Image.Transpose.ROTATE_270))
    assert np.array_equal(data.picture(0), upright)


def _changed(row: int, column: int, value: object) -> list[list[object]]:
    person = rows("lsp14")
    person[row][column] = value
    return person


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (pictures("lsp14", _changed(4, 0, float("nan"))), "a.jpg, person 0, left_knee: it is found with confidence"),
        (pictures("lsp14", rows("lsp14"), _changed(0, 1, float("inf"))), "person 1, right_ankle: it is found with"),
        (pictures("lsp14", _changed(13, 2, -0.25)), "head_top: the confidence is -0.25; expected a number from 0"),
        (pictures("lsp14", _changed(2, 2, float("nan"))), "right_hip: the confidence is nan"),
        (pictures("lsp14", _changed(2, 0, "left")), "right_hip: it is ['left', "),
        (pictures("lsp14", _changed(2, 0, None)), "expected three numbers, x, y and confidence"),
        (pictures("lsp14", _changed(2, 0, 10**400)), "right_hip: it holds a number beyond all pictures"),
        (pictures("lsp14", _changed(3, 0, -91.0)), "left_hip: it is at (-91, "),
        (pictures("lsp14", _changed(3, 1, 241.0)), "far outside its picture; expected x from -90 to 180 and y from"),
        (pictures("lsp14", [[3, 4, 0.0]] * 14), "person 0: all joints are missing; expected one at least"),
        (pictures("lsp14", [[3, 4, 0.5]] * 13), "it has 13 joints; lsp14 has 14"),
        (pictures("mpii16", rows("lsp14")), "the file's layout is 'mpii16'; expected one of openpose_body25"),
        (pictures("lsp14", rows("lsp14"), file_name=""), "picture 0: 'file_name' is ''; expected a text"),
        (pictures("lsp14", rows("lsp14"), file_name="../a.jpg"), "lies outside"),
        (pictures("lsp14", rows("lsp14"), height=None), "'height' is missing; expected"),
        (pictures("lsp14", rows("lsp14"), width=0), "'width' is 0; expected a number above zero"),
        (pictures("lsp14", rows("lsp14"), people=[{}]), "person 0: 'joints' is missing"),
        (pictures("lsp14", rows("lsp14"), people=3), "'people' is 3; expected a list of objects"),
        (pictures("lsp14"), "holds no people; expected one at least"),
        ({"pictures": []}, "holds no people"),
        ({"pictures": 2 * pictures("lsp14", rows("lsp14"))["pictures"]}, "'a.jpg' is there twice"),
        ({"pictures": [{"file_name": "a", "people": [{"joints": [[1, 2, 1]] * 15}]}]}, "it has 15 joints; expected"),
        (openpose(), "holds no people"),
        (openpose(rows("lsp14")[:13]), "person 0: it has 13 joints; expected one of 25 (openpose_body25), 18"),
        ({"people": [{"face": []}]}, "person 0: 'pose_keypoints_2d' is missing"),
        ({"people": [{"pose_keypoints_2d": [1, 2, 3, 4]}]}, "are 4 numbers; expected triples"),
        ({"people": [{"pose_keypoints_2d": None}]}, "its joints are a NoneType; expected a list of triples"),
        (openpose(rows("openpose_body25")), "how large is the picture 'j'? It is not beside the file"),
        (coco([0] * 51), "holds no people: all 1 annotations have no labelled joint"),
        (coco([3] * 51), "annotation 0, nose: the flag is 3; expected 0, 1 or 2"),
        (coco([1] * 51, images=[]), "annotation 0: 'image_id' is 7; expected the id of one of the images"),
        (coco([1] * 51, images=2 * coco()["images"]), "image 1: the id 7 is there twice"),
        (coco(annotations=2 * coco([1] * 51)["annotations"]), "annotation 1: the id 0 is there twice"),
        (coco(annotations=[{"image_id": 7}]), "annotation 0: 'keypoints' is missing"),
        ({"annotations": coco([1] * 51)["annotations"], "images": 3}, "'images' is 3; expected a list of objects"),
        ([], "holds no people"),
        ([3], "result 0 is a int; expected an object with image_id"),
        ([{"image_id": 1.5, "keypoints": []}], "result 0: 'image_id' is 1.5; expected a number from 0, or a name"),
        ([{"image_id": 1}], "result 0: 'keypoints' is missing"),
        ({"pose_landmarks": 3}, "'pose_landmarks' is 3; expected a list of landmarks"),
        ({"landmarks": [{"x": 0.5, "y": 0.5}] * 33}, "person 0, nose: it is [0.5, 0.5]; expected three numbers"),
        ({"landmarks": []}, "holds no people"),
        ({"keypoints": [1]}, "holds 'keypoints'; expected OpenPose's people, COCO's"),
        ({}, "holds nothing; expected OpenPose's people"),
        (3, "holds a int; expected OpenPose's people"),
    ],
)
def test_what_cannot_be_is_refused_by_name(tmp_path: Path, tree: object, message: str) -> None:
    assert message in refused(tmp_path / "j.json", tree)


def test_another_layout_than_asked_for_is_refused(tmp_path: Path) -> None:
    message = refused(tmp_path / "j.json", pictures("lsp14", rows("lsp14")), layout="coco17")
    assert "the file's layout is 'lsp14'; expected data.layout=coco17" in message
    message = refused(tmp_path / "j.json", openpose(rows("openpose_coco18")), layout="openpose_body25")
    assert "person 0: it has 18 joints; openpose_body25 has 25" in message


def test_a_picture_of_another_size_or_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(image_bytes("JPEG", (64, 48)))
    tree = pictures("lsp14", rows("lsp14"))
    assert "is said to be 90 x 120 pixels large, but" in refused(tmp_path / "j.json", tree)
    (tmp_path / "other").mkdir()
    assert "there is no picture 'a.jpg' in" in refused(tmp_path / "j.json", tree, images=tmp_path / "other")
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff")
    assert "a.jpg is not a picture that can be read" in refused(tmp_path / "j.json", tree)


def test_a_picture_in_two_files_is_refused(tmp_path: Path) -> None:
    for name in ("a.json", "b.json"):
        write(tmp_path / name, pictures("lsp14", rows("lsp14")))
    with pytest.raises(UserError, match=r"b.json: the picture 'a.jpg' is in .*a.json too"):
        people(tmp_path)


def test_huge_broken_and_missing_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "j.json"
    for content, message in (
        (b"{", "is no JSON"),
        (b"\xff\xfe", "is no JSON"),
        (b"[" * 100_000, "nested too deeply"),
    ):
        path.write_bytes(content)
        with pytest.raises(UserError, match=message):
            people(path)
    with path.open("wb") as file:
        file.truncate((64 << 20) + 1)
    with pytest.raises(UserError, match="bytes; at most 67,108,864 are read"):
        people(path)
    with pytest.raises(UserError, match="there is no file or folder"):
        people(tmp_path / "away.json")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"there is no \.json file in"):
        people(tmp_path / "empty")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"layout": "h36m"}, "data.layout is one of auto openpose_body25"),
        ({"size": [3]}, r"data.size must be \[height,width\] in whole pixels, got \[3\]"),
        ({"size": [3, 0]}, "data.size must be"),
        ({"least_confidence": 1.5}, "data.least_confidence must lie between 0 and 1"),
        ({"focal_px": float("nan")}, "data.focal_px must be a number of pixels above zero"),
        ({"first": 1}, "data.first=1, but .* holds 1 people"),
        ({"images": "nowhere"}, "there is no folder nowhere, which data.images names"),
    ],
)
def test_settings_that_cannot_be_are_refused(tmp_path: Path, given: dict[str, object], message: str) -> None:
    path = write(tmp_path / "j.json", pictures("lsp14", rows("lsp14")))
    with pytest.raises(UserError, match=message):
        people(path, **given)


BASES = [
    json.dumps(tree).encode()
    for tree in (
        pictures("lsp14", rows("lsp14")),
        openpose(rows("openpose_coco18")),
        coco([*flat(rows("coco17"))[:48], 1, 2, 2]),
        [{"image_id": 3, "keypoints": flat(rows("coco17"))}],
        {"landmarks": [{"x": 0.5, "y": 0.5, "visibility": 1}] * 33},
    )
]


@pytest.mark.parametrize("base", range(len(BASES)))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=edits)
def test_damaged_files_are_read_or_refused(tmp_path: Path, base: int, steps) -> None:
    path = tmp_path / "j.json"
    path.write_bytes(damaged(BASES[base], steps))
    try:
        batch = people(path, size=[120, 90]).people
    except UserError as error:
        said = str(error)
    else:
        said = ""
        assert bool(batch.joints_px.isfinite().all())
        assert bool((batch.confidence.amax(1) > 0).all())
    assert "\n" not in said


def test_the_astronauts_joints_lie_upon_her(tmp_path: Path) -> None:
    """What scripts/detect_joints.py wrote of scikit-image's photograph, NASA's and in the public domain."""
    from skimage import data as photographs

    Image.fromarray(photographs.astronaut()).save(tmp_path / "astronaut.png")
    (tmp_path / "j.json").write_bytes((Path(__file__).parent / "astronaut_joints.json").read_bytes())
    data = people(tmp_path / "j.json")
    batch = data.people
    assert data.picture(0).shape == (512, 512, 3)
    right, left = (LSP_JOINTS.index(f"{side}_shoulder") for side in ("right", "left"))
    assert batch.joints_px[0, right, 0] < 256 < batch.joints_px[0, left, 0]  # she looks at us
    assert bool((batch.confidence[0, [right, left, NECK]] > 0.99).all())
    assert not batch.confidence[0, [0, 1, 4, 5, HEAD]].any()  # knees, ankles: beyond the photograph


@pytest.mark.parametrize("of", [JointsJSON, LSP])
def test_configurations_say_the_defaults(of: type) -> None:
    module = of.__module__
    file = Path(__file__).parents[4] / "conf" / "data" / f"{module.rpartition('.')[2]}.yaml"
    settings = OmegaConf.to_container(OmegaConf.load(file).data)
    assert settings.pop("_target_") == f"{module}.{of.__name__}"
    takes = {**inspect.signature(PicturePeople).parameters, **inspect.signature(of).parameters}
    defaults = {name: each.default for name, each in takes.items() if name not in ("steps", "people")}
    defaults["path"] = "???"
    assert settings == defaults


@pytest.mark.parametrize("data", ["lsp", "joints_json"])
def test_people_of_files_are_not_asked_for_their_truth(data: str, compose, tmp_path: Path) -> None:
    cfg = compose(tmp_path / "smplify" / "run", "task=smplify", f"data={data}", "data.path=there")
    asked = [name for name, term in cfg.metric.items() if term is not None]
    assert "joints_percent" in asked
    assert not [name for name in asked if cfg.metric[name].target == "truth"]
    assert cfg.optimized_metric == "test/joints_percent"
