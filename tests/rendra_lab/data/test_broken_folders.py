"""Broken scenes are refused with the file, the place in it and the reason."""

import io
import json
import os
import struct

import numpy as np
import pytest
from PIL import Image
from scene_files import (
    SIZE,
    blender_folder,
    colmap_folder,
    llff_folder,
    llff_table,
    pixels,
    row,
    save,
    transforms_folder,
    write_json,
)

from rendra_lab.data import photographs
from rendra_lab.data.colmap import ColmapViews
from rendra_lab.data.json_fields import read_json
from rendra_lab.data.llff import LlffViews
from rendra_lab.data.nerf_blender import NerfBlenderViews
from rendra_lab.data.transforms import TransformsViews
from rendra_lab.errors import UserError


def put(*keys_and_value):
    """An edit of a JSON file: sets what lies under the keys."""
    *keys, last, value = keys_and_value

    def change(tree):
        for key in keys:
            tree = tree[key]
        tree[last] = value

    return change


def pose(change):
    matrix = np.eye(4)
    change(matrix)
    return matrix.tolist()


def scaled(matrix):
    matrix[:3, :3] *= 1.01


def mirrored(matrix):
    matrix[0, 0] = -1


FRAME = ("frames", 2)
BROKEN_JSON = {
    "no angle": (lambda tree: tree.pop("camera_angle_x"), r"train\.json: 'camera_angle_x' is missing"),
    "zero angle": (put("camera_angle_x", 0), "'camera_angle_x' is 0; expected an angle"),
    "text angle": (put("camera_angle_x", "0.7"), "'camera_angle_x' is '0.7'"),
    "true angle": (put("camera_angle_x", True), "'camera_angle_x' is True"),
    "huge angle": (put("camera_angle_x", 10**400), "expected a finite number"),
    "no frames": (lambda tree: tree.pop("frames"), "'frames' is missing"),
    "empty frames": (put("frames", []), "one at least"),
    "frames of numbers": (put("frames", [1]), "a list of objects"),
    "no file": (put(*FRAME, "file_path", "./train/r_77"), r"frame 2: there is no picture .*r_77"),
    "no path": (lambda tree: tree["frames"][2].pop("file_path"), "frame 2: 'file_path' is missing"),
    "path is a list": (put(*FRAME, "file_path", ["x"]), "frame 2: 'file_path'"),
    "path outside": (
        put(*FRAME, "file_path", "../../etc/passwd"),
        "frame 2: a file name leaves the folder.*allow_outside",
    ),
    "absolute path": (put(*FRAME, "file_path", "/etc/passwd"), "frame 2: a file name is absolute"),
    "url": (put(*FRAME, "file_path", "file:///etc/passwd"), "frame 2: a file name is a URL"),
    "nul": (put(*FRAME, "file_path", "a\0b"), "frame 2: a file name holds a NUL"),
    "path twice": (put(*FRAME, "file_path", "./train/r_1"), "frame 2: .* second time.*frame 1"),
    "no pose": (lambda tree: tree["frames"][2].pop("transform_matrix"), "frame 2: 'transform_matrix' is missing"),
    "flat pose": (put(*FRAME, "transform_matrix", [0] * 16), "frame 2: 'transform_matrix'.*4 x 4"),
    "text in pose": (put(*FRAME, "transform_matrix", 1, 1, "x"), "frame 2: 'transform_matrix' holds 'x'"),
    "NaN in pose": (put(*FRAME, "transform_matrix", 1, 3, float("nan")), "frame 2: 'transform_matrix' holds nan"),
    "infinity in pose": (put(*FRAME, "transform_matrix", 1, 3, float("inf")), "frame 2: .*holds inf"),
    "scaling pose": (put(*FRAME, "transform_matrix", pose(scaled)), "frame 2: the pose is no rotation.*1.01"),
    "zero pose": (put(*FRAME, "transform_matrix", [[0] * 4] * 4), "frame 2: the pose is no rotation"),
    "mirroring pose": (put(*FRAME, "transform_matrix", pose(mirrored)), "frame 2: the pose mirrors"),
    "projective pose": (put(*FRAME, "transform_matrix", 3, 0, 0.5), "frame 2: the pose must .*0 0 0 1"),
}


@pytest.mark.parametrize("name", BROKEN_JSON)
def test_a_broken_transforms_train_json(tmp_path, name):
    change, message = BROKEN_JSON[name]
    file = blender_folder(tmp_path) / "transforms_train.json"
    tree = json.loads(file.read_text())
    change(tree)
    write_json(file, tree)
    with pytest.raises(UserError, match=message):
        NerfBlenderViews(tmp_path).load()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "is no JSON"),
        (b"{", "is no JSON"),
        (b"\xff\xfe\x00", "is no JSON"),
        (b"[1, 2]", "holds a list"),
        (b"[" * 200_000, "is nested too deeply"),
        (b'{"a":' * 200_000, "is nested too deeply"),
        (b'{"a": 1' + b"0" * 10_000 + b"}", "is no JSON"),
    ],
)
def test_json_that_is_none(tmp_path, text, message):
    file = tmp_path / "transforms_train.json"
    file.write_bytes(text)
    with pytest.raises(UserError, match=rf"transforms_train\.json {message}"):
        NerfBlenderViews(tmp_path).load()


def test_json_without_end(tmp_path):
    file = tmp_path / "a.json"
    with file.open("wb") as handle:
        handle.truncate(65 << 20)  # a hole: no disk is filled
    with pytest.raises(UserError, match="at most"):
        read_json(file)
    with pytest.raises(UserError, match="no file"):
        read_json(tmp_path)


def png_header(width, height):
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header + b"\0" * 4


def encoded(picture, kind="PNG", **options):
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, kind, **options)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is not a picture that can be read"),
        (b"GIF89a nonsense", "is not a picture that can be read"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n", "is not a picture that can be read"),
        (encoded(pixels(0, (40, 40)))[:-900], "is not a picture that can be read"),
        (encoded(pixels(0, (400, 400), 3), "JPEG")[:20000], "is not a picture that can be read"),
        (png_header(100_000, 100_000), "is not a picture that can be read|at most"),
        (png_header(9000, 9000), "at most|is not a picture that can be read"),
    ],
)
def test_pictures_that_cannot_be_read(tmp_path, data, message):
    path = blender_folder(tmp_path) / "train" / "r_2.png"
    path.write_bytes(data)
    with pytest.raises(UserError, match=rf"transforms_train\.json, frame 2: .*r_2\.png.*({message})"):
        NerfBlenderViews(tmp_path).load()


def test_floating_point_pictures_and_folders_of_that_name(tmp_path):
    path = blender_folder(tmp_path) / "train" / "r_2.png"
    Image.fromarray(np.zeros(SIZE, np.float32)).save(path, "TIFF")
    with pytest.raises(UserError, match=r"frame 2: .*floating-point"):
        NerfBlenderViews(tmp_path).load()
    path.unlink()
    path.mkdir()
    with pytest.raises(UserError, match="frame 2: there is no picture"):
        NerfBlenderViews(tmp_path).load()


def test_too_many_pixels_say_what_helps(tmp_path, monkeypatch):
    monkeypatch.setattr(photographs, "_MOST_BYTES", 4 * 48 * 3)
    with pytest.raises(UserError, match=r"4 pictures take .*data\.shrink"):
        NerfBlenderViews(blender_folder(tmp_path)).load()
    monkeypatch.setattr(photographs, "_MOST_PIXELS", 47)
    with pytest.raises(UserError, match="8 x 6 pixels; at most 47"):
        NerfBlenderViews(tmp_path).load()
    monkeypatch.undo()
    with pytest.raises(UserError, match=r"nothing is left of .*data\.shrink=7"):
        NerfBlenderViews(tmp_path, shrink=7).load()


BROKEN_TRANSFORMS = {
    "zero focal": (put("fl_x", 0), "frame 0: 'fl_x' is 0; expected a number above zero"),
    "no focal": (lambda tree: (tree.pop("fl_x"), tree.pop("fl_y")), "frame 0: 'fl_x' is missing"),
    "wrong size": (put("w", 9), r"frame 0: .*000\.png is 8 x 6 pixels large, its camera 9 x 6"),
    "wrong size of a frame": (put(*FRAME, "h", 60), "frame 2: .*8 x 6 pixels large, its camera 8 x 60"),
    "half a pixel": (put("w", 8.5), "frame 0: 'w' is 8.5; expected a whole number"),
    "unknown camera": (put("camera_model", "EQUIRECTANGULAR"), "'EQUIRECTANGULAR'; expected one of SIMPLE_PINHOLE"),
    "camera is a number": (put("camera_model", 5), "'camera_model' is 5"),
    "lens of a pinhole": (lambda tree: tree.update(camera_model="PINHOLE", k1=0.1), "'k1' is 0.1.*PINHOLE"),
    "eighth power": (put("k4", 0.1), "'k4' is 0.1, which camera model OPENCV"),
    "tangential fisheye": (lambda tree: tree.update(is_fisheye=True, p1=0.1), "'p1' is 0.1.*FISHEYE"),
    "fisheye is a text": (put("is_fisheye", "no"), "'is_fisheye' is 'no'"),
    "focal beyond float32": (put("fl_x", 1e39), r"frame \d: .*intrinsics.* do not fit into 32 bits: 1e\+39"),
    "focal below float32": (put("fl_x", 1e-60), r"frame \d: .*intrinsics.* do not fit into 32 bits: 1e-60"),
    "lens beyond float32": (put("k1", -1e300), r"frame \d: .*distortion.* do not fit into 32 bits: -1e\+300"),
    "far away": (
        lambda tree: tree["frames"][2]["transform_matrix"][0].__setitem__(3, 1e40),
        r"frame 2: .*pose.* do not fit into 32 bits",
    ),
    "NaN lens": (put("k1", float("nan")), "'k1' is nan"),
    "applied transform": (put("applied_transform", [1, 2]), "'applied_transform'"),
    "mask missing": (put(*FRAME, "mask_path", "m.png"), r"frame 2, mask: there is no file .*m\.png"),
    "mask outside": (put(*FRAME, "mask_path", "../m.png"), "frame 2: a file name leaves the folder"),
    "mask of another size": (put(*FRAME, "mask_path", "small.png"), r"frame 2, mask: .*small\.png is 4 x 4 pixels"),
    "split of nobody": (put("train_filenames", ["a.png"]), r"'train_filenames' names 'a.png', which no frame has"),
    "train alone": (put("train_filenames", ["images/001.png"]), "needs val_filenames or test_filenames"),
    "split is a text": (put("test_filenames", "images/001.png"), "'test_filenames' is"),
    "train and test": (
        lambda tree: tree.update(train_filenames=["images/001.png"], test_filenames=["images/001.png"]),
        r"001\.png is in train_filenames and in test_filenames",
    ),
}


@pytest.mark.parametrize("name", BROKEN_TRANSFORMS)
def test_a_broken_transforms_json(tmp_path, name):
    change, message = BROKEN_TRANSFORMS[name]
    file = transforms_folder(tmp_path) / "transforms.json"
    save(tmp_path / "small.png", np.zeros((4, 4), np.uint8))
    tree = json.loads(file.read_text())
    change(tree)
    write_json(file, tree)
    with pytest.raises(UserError, match=message):
        TransformsViews(tmp_path).load()


def test_a_turned_photograph_says_so(tmp_path):
    folder = transforms_folder(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    (folder / "images" / "004.png").write_bytes(encoded(pixels(4, (8, 6), 3), "JPEG", exif=exif))
    with pytest.raises(UserError, match=r"004\.png is 6 x 8 pixels large, its camera 8 x 6; its EXIF data turn it"):
        TransformsViews(folder).load()


def test_files_outside_are_read_only_if_one_says_so(tmp_path):
    folder = transforms_folder(tmp_path / "scene")
    (folder / "images").rename(tmp_path / "elsewhere")
    os.symlink(tmp_path / "elsewhere", folder / "images")
    with pytest.raises(UserError, match=r"leaves the folder through a link.*data\.allow_outside=true"):
        TransformsViews(folder).load()
    assert len(TransformsViews(folder, allow_outside=True).load().train) == 7


def test_too_few_photographs(tmp_path):
    with pytest.raises(UserError, match="one to test"):
        TransformsViews(transforms_folder(tmp_path, count=1)).load()
    with pytest.raises(UserError, match="is no folder"):
        TransformsViews(tmp_path / "nowhere").load()
    with pytest.raises(UserError, match=r"no file .*transforms_train\.json"):
        NerfBlenderViews(tmp_path).load()


def reword(file, old, new):
    file.write_text(file.read_text().replace(old, new, 1))


BROKEN_COLMAP = {
    "unknown model": (
        "cameras.txt",
        "PINHOLE",
        "FOV",
        "line 2: camera model FOV is not read; known are SIMPLE_PINHOLE",
    ),
    "too few parameters": ("cameras.txt", " 2.5", "", "line 2: camera model PINHOLE has 4 parameters, found 3"),
    "zero focal": ("cameras.txt", "10.0", "0.0", "line 2: focal length 0.0"),
    "NaN focal": ("cameras.txt", "10.0", "nan", "line 2: parameters that are not finite"),
    "text": ("cameras.txt", "10.0", "ten", "line 2: expected a number, found 'ten'"),
    "no size": ("cameras.txt", "8 6", "0 6", "line 2: a size of 0 x 6"),
    "other size": ("cameras.txt", "8 6", "16 12", r"0 view\.png is 8 x 6 pixels large, its camera 16 x 12"),
    "short camera": ("cameras.txt", "7 PINHOLE", "7\n7 PINHOLE", "line 2: expected CAMERA_ID"),
    "no camera": ("images.txt", " 7 3 view", " 9 3 view", r"line 8: image '3 view.png' has camera 9"),
    "name twice": ("images.txt", "7 3 view", "7 2 view", "'2 view.png' stands there a second time"),
    "name outside": ("images.txt", "0 view.png", "../0 view.png", "leaves the folder|no file"),
    "far outside": ("images.txt", "0 view.png", "../../../etc/passwd", "a file name leaves the folder"),
    "no picture": ("images.txt", "0 view.png", "44.png", r"there is no file .*44\.png"),
    "long quaternion": ("images.txt", "1 ", "1 5", "quaternion of '0 view.png' has length"),
    "short image": ("images.txt", " 7 0 view.png", "", "line 2: expected IMAGE_ID"),
    "points": ("points3D.txt", "0 ", "0 nan ", "line 1: coordinates that are not finite"),
    "short points": ("points3D.txt", "0 ", "0 1\n0 ", "line 1: expected POINT3D_ID"),
}


@pytest.mark.parametrize("name", BROKEN_COLMAP)
def test_broken_text_of_colmap(tmp_path, name):
    file, old, new, message = BROKEN_COLMAP[name]
    path = colmap_folder(tmp_path, binary=False) / "sparse" / "0" / file
    reword(path, old, new)
    with pytest.raises(UserError, match=message):
        ColmapViews(tmp_path).load()


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_models_that_end_too_early_or_declare_too_much(tmp_path, name):
    path = colmap_folder(tmp_path, binary=True) / "sparse" / "0" / f"{name}.bin"
    whole = path.read_bytes()
    for end in (*range(0, min(len(whole), 120), 7), len(whole) - 1):
        path.write_bytes(whole[:end])
        with pytest.raises(UserError, match=rf"{name}\.bin (ends within|declares)|{name}\.bin: the name"):
            ColmapViews(tmp_path).load()
    for count in (1 << 63, 1 << 40, 10_000):
        path.write_bytes(struct.pack("<Q", count) + whole[8:])
        with pytest.raises(UserError, match=rf"{name}\.bin declares {count:,} "):
            ColmapViews(tmp_path).load()


def test_a_binary_image_with_absurd_points_or_names(tmp_path):
    path = colmap_folder(tmp_path, binary=True) / "sparse" / "0" / "images.bin"
    whole = path.read_bytes()
    after_name = whole.index(b"view.png\0") + 9
    path.write_bytes(whole[:after_name] + struct.pack("<Q", 1 << 61) + whole[after_name + 8 :])
    with pytest.raises(UserError, match="points of image 1, but only"):
        ColmapViews(tmp_path).load()
    path.write_bytes(whole.replace(b"0 view", b"\xff\xfeview", 1))
    with pytest.raises(UserError, match="the name of image 1 is no UTF-8"):
        ColmapViews(tmp_path).load()
    path.unlink()
    with pytest.raises(UserError, match=r"no file .*images\.bin, and no images\.txt"):
        ColmapViews(tmp_path).load()


def test_a_folder_without_a_model_or_without_photographs(tmp_path):
    with pytest.raises(UserError, match=r"no cameras\.bin or cameras\.txt in"):
        ColmapViews(tmp_path).load()
    folder = colmap_folder(tmp_path, binary=True)
    (folder / "images").rename(folder / "pictures")
    with pytest.raises(UserError, match=r"no folder .*images"):
        ColmapViews(tmp_path).load()


def with_value(row_index, column, value):
    def change(table):
        table[row_index, column] = value
        return table

    return change


BROKEN_TABLES = {
    "columns": (lambda table: table[:, :14], "holds 9 x 14 numbers; expected N x 17"),
    "rows": (lambda table: table[:5], "5 poses, but .* has 9 pictures"),
    "no rows": (lambda table: table[:0], "holds 0 x 17"),
    "NaN": (with_value(3, 2, np.nan), "row 3: numbers that are not finite"),
    "focal": (with_value(3, 14, 0), "row 3: a height, width or focal length"),
    "bounds": (with_value(3, 15, 9), "row 3: depths that are not"),
    "negative bounds": (with_value(3, 15, -1), "row 3: depths that are not"),
    "scaling": (with_value(3, 0, -1.5), "row 3: the pose"),
    "mirroring": (
        lambda table: (
            table * np.where(np.arange(17) % 5 == 1, -1, 1) * (np.arange(17) < 15) + table * (np.arange(17) >= 15)
        ),
        "row 0: the pose mirrors",
    ),
    "size": (with_value(3, 9, 16), "row 3: .*8 x 6 pixels large, its camera 16 x 6"),
}


@pytest.mark.parametrize("name", BROKEN_TABLES)
def test_broken_tables_of_llff(tmp_path, name):
    change, message = BROKEN_TABLES[name]
    folder = llff_folder(tmp_path)
    np.save(folder / "poses_bounds.npy", change(llff_table(row(9))))
    with pytest.raises(UserError, match=rf"poses_bounds\.npy.*{message}"):
        LlffViews(folder).load()


def npy(shape, dtype, body=b""):
    header = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is no .npy file"),
        (b"PK\x03\x04", "is no .npy file"),
        (npy((9, 17), "|O", b"cos\nsystem\n"), "holds object; .*pickled objects are never read"),
        (npy((1 << 40, 17), "<f8"), "declares 1099511627776 x 17 of float64, but holds 0 bytes"),
        (npy((9, 17), "<f8", b"\0" * 100), "declares 9 x 17 of float64, but holds 100 bytes"),
        (npy((-9, -17), "<f8", b"\0" * 9 * 17 * 8), "declares -9 x -17"),
        (npy((9, 17), "<c16", b"\0" * 9 * 17 * 16), "holds complex128"),
        (npy("x" * 10, "<f8"), "is no .npy file"),
    ],
)
def test_broken_npy_files(tmp_path, data, message):
    (llff_folder(tmp_path) / "poses_bounds.npy").write_bytes(data)
    with pytest.raises(UserError, match=rf"poses_bounds\.npy {message}"):
        LlffViews(tmp_path).load()
