"""Files that lie: each gives a typed error that names file, line, what was found and what was expected."""

import io
import os
import pickle
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from small_files import glb_asset, ply_asset, stl_asset

from rendra.io import IO, MeshFormatError, load_obj, load_ply

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"

MALFORMED_OBJ = [
    ("v 0 0\n", 1, "a vertex cannot have 2 numbers"),
    ("v 0 0 0 1 1\n", 1, "a vertex cannot have 5 numbers"),
    ("v\n", 1, "a vertex cannot have 0 numbers"),
    ("# ok\n\nv 1 2 x\n", 3, "cannot read 'x'; found 'v 1 2 x'; expected a number"),
    ("v 1 2 1.2.3\n", 1, "cannot read '1.2.3'"),
    ("v 1 2 0x10\n", 1, "cannot read '0x10'"),
    ("v 1 2 1_000\n", 1, "cannot read '1_000'"),
    ("v 1 2 -nan(ind)\n", 1, "not finite"),
    ("v 1,5 2 3\n", 1, "cannot read '1,5'"),
    (TRIANGLE + "v nan 0 0\n", 4, "not finite"),
    (TRIANGLE + "v 0 -inf 0\n", 4, "not finite"),
    (TRIANGLE + "v 0 1e39 0\n", 4, "not finite in single precision"),
    (TRIANGLE + "v 0 0 0 nan 0 0\n", 4, "not finite"),
    ("vt 1\n", 1, "a texture coordinate needs u v"),
    ("vt nan 0\n", 1, "not finite"),
    ("vn 0 1\n", 1, "a normal needs three numbers"),
    (TRIANGLE + "f 1 2\n", 4, "at least three corners"),
    (TRIANGLE + "f\n", 4, "at least three corners"),
    (
        TRIANGLE + "f 1 2 3\nf 1 2 4\n",
        5,
        "names vertex 4, but the file has 3; found 'f 1 2 4'; expected an index from 1 to 3",
    ),
    (TRIANGLE + "f 1 2 -4\n", 4, "names vertex -4"),
    ("v 0 0 0\nf 1 1 -2\nv 1 1 1\n", 2, "names vertex -2"),
    (TRIANGLE + "f 0 1 2\n", 4, "a face index is 0"),
    (TRIANGLE + "vt 0 0\nf 1/0 2/1 3/1\n", 5, "a face index is 0"),
    (TRIANGLE + "f 1.0 2 3\n", 4, "cannot read '1.0'"),
    (TRIANGLE + "f 1 2 three\n", 4, "cannot read 'three'"),
    (TRIANGLE + "f 1 2 3-1\n", 4, "cannot read '3-1'"),
    (TRIANGLE + "f 1 2 -\n", 4, "cannot read '-'"),
    (TRIANGLE + "f 1 2 -/1\n", 4, "cannot read '-/1'"),
    (TRIANGLE + "f 1 2 /3\n", 4, "cannot read '/3'"),
    (TRIANGLE + "f 1 2 99999999999999999999999\n", 4, "names vertex 99999999999999999999999,"),
    (TRIANGLE + "f 1 2 -99999999999999999999999\n", 4, "names vertex -99999999999999999999999,"),
    (
        TRIANGLE + "f 1/1 2/1 3/1\n",
        4,
        "names texture coordinate 1, but the file has 0; found 'f 1/1 2/1 3/1'; expected no",
    ),
    (TRIANGLE + "vn 0 0 1\nf 1//2 2//1 3//1\n", 5, "names normal 2"),
    (TRIANGLE + "f 1/1/1/1 2 3\n", 4, "more than three indices"),
    (TRIANGLE + "vt 0 0\nf 1/1 2 3/1\n", 5, "different forms"),
    (TRIANGLE + "vt 0 0\nvn 0 0 1\nf 1/1 2//1 3/1\n", 6, "different forms"),
    ("v 0 0 \\\n0\nv 1 0 0\nv \\\n0 1\n", 4, "a vertex cannot have 2 numbers"),
    ("v 0 0 0\r\nv 1 x 0\r\n", 2, "cannot read 'x'"),
    (TRIANGLE + "usemtl\n", 4, "usemtl without a name"),
    ("mtllib  # \t\n".replace("# ", ""), 1, "mtllib without a name"),
    ("<!DOCTYPE html>\n<html></html>\n", 1, "a statement unknown to OBJ; found '<!DOCTYPE html>'"),
    ("ply\nformat ascii 1.0\n", 1, "unknown to OBJ"),
    ("v 0 0 0\nv 0 \0 0\n", 2, "a NUL byte"),
    ("v 0 0 " + "9" * 100_000 + "\n", 1, "not finite"),
    ("v 0 0 " + "x" * 100_000 + "\n", 1, "cannot read 'xxxx"),
]


@pytest.mark.parametrize(("text", "line", "message"), MALFORMED_OBJ)
def test_malformed_obj(text, line, message):
    source = io.StringIO(text)
    source.name = "bad.obj"
    with pytest.raises(MeshFormatError) as caught:
        load_obj(source)
    assert str(caught.value).startswith(f"bad.obj, line {line}: ")
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400
    assert caught.value.line == line
    assert isinstance(caught.value, ValueError)


TRIANGLE_BYTES = TRIANGLE.encode()

ODD_BUT_READ = {
    "control characters are blanks": b"v 0\x1f0\x0b0\nv\x011 0 0\nv 0 1\x0c0\nf 1\x7f\n".replace(
        b"\x7f", b"\x02 2 3"
    ),
    "names in Latin-1": b"# caf\xe9\ng \xff\n" + TRIANGLE_BYTES + b"o \xe4\nf 1 2 3\n",
    "a continued line, then nothing": TRIANGLE_BYTES + b"f 1 2 3 \\\n",
    "the end of file of DOS": TRIANGLE_BYTES + b"f 1 2 3\n\x1a",
    "line ends of all three kinds but the last": TRIANGLE_BYTES.replace(b"\n", b"\r\n", 1) + b"f 1 2 3\n\r\n",
    "numbers in every spelling": b"v +0 -0.e0 .0E+00\nv 1. 0 0\nv 0 1e0 1e-400\nf +1 02 0003\n",
    "statements of other programs": TRIANGLE_BYTES + b"f 1 2 3\nvendor_data 7 x\nvt2 1\nfo 1 2 3\n",
}


@pytest.mark.parametrize("name", ODD_BUT_READ)
def test_odd_but_read(name):
    verts, faces, _ = load_obj(io.BytesIO(ODD_BUT_READ[name]))
    assert verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.verts_idx.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("data", "line", "message"),
    [
        (TRIANGLE.encode("utf-16"), 1, "a NUL byte"),
        (b"\xff\xfe" + TRIANGLE.encode("utf-16-le"), 1, "a NUL byte"),
        (TRIANGLE.encode("utf-16-be"), 1, "a NUL byte"),
        ("v 0 0 \u0661\n".encode(), 1, "cannot read '\u0661'"),
        (TRIANGLE_BYTES + b"f 1 2 3 \\", 4, "cannot read"),
        (b"v 0 0 \xff\n", 1, "cannot read '\ufffd'"),
        (b"v 0 0 \xc2\xa01\n", 1, "cannot read"),
        (TRIANGLE_BYTES + b"f 1 2 \xef\xbb\xbf3\n", 4, "cannot read"),
        (TRIANGLE_BYTES + b"v 0 0 0\rv 1 0 0\n", 4, "cannot read 'v'"),
        (TRIANGLE_BYTES + b"f 1 2\x1f\n", 4, "at least three corners"),
        (TRIANGLE_BYTES + b"f 1\x1f2 x\n", 4, "cannot read 'x'"),
        (b"\x89PNG\r\n\x1a\nIHDR", 1, "unknown to OBJ"),
    ],
)
def test_bytes_that_are_no_text(data, line, message):
    with pytest.raises(MeshFormatError) as caught:
        load_obj(io.BytesIO(data))
    assert message in str(caught.value)
    assert caught.value.line == line


XYZ = "property float x\nproperty float y\nproperty float z\n"
FACE = "property list uchar int vertex_indices\n"
HEAD = "ply\nformat ascii 1.0\n"
ONE = (
    HEAD + f"element vertex 3\n{XYZ}element face 1\n{FACE}end_header\n0 0 0\n1 0 0\n0 1 0\n"
)  # the face is on line 13

MALFORMED_PLY = [
    ("", 1, "ends within its header"),
    ("v 0 0 0\n", 1, "no PLY file; found 'v 0 0 0'"),
    ("ply\n", 1, "ends within its header"),
    ("ply\nformat ascii 2.0\n", 2, "unknown format"),
    ("ply\nformat text 1.0\n", 2, "unknown format"),
    ("ply\nend_header\n", 2, "no format line"),
    (HEAD + "format ascii 1.0\n", 3, "second format line"),
    (HEAD + "hello\n", 3, "unknown header statement; found 'hello'"),
    (HEAD + "element vertex\n", 3, "bad element"),
    (HEAD + "element vertex -3\n", 3, "bad element"),
    (HEAD + "element vertex 1e9\n", 3, "bad element"),
    (HEAD + "element vertex " + "9" * 5000 + "\n", 3, "bad element"),
    (HEAD + "element a 1\nproperty int x\nelement a 1\n", 5, "declared twice"),
    (HEAD + "property float x\n", 3, "before any element"),
    (HEAD + "element vertex 1\nproperty quaternion x\n", 4, "bad property"),
    (HEAD + "element vertex 1\nproperty list float int x\n", 4, "no integer"),
    (HEAD + "element vertex 1\nproperty float x\nproperty float x\n", 5, "declared twice"),
    (HEAD + "element vertex 5\nend_header\n", 3, "no property"),
    (HEAD + "end_header\n", None, "no vertex element"),
    (HEAD + "element vertex 1\nproperty float x\nend_header\n1\n", 3, "lack x, y or z"),
    (
        HEAD + f"element vertex 3\n{XYZ}end_header\n0 0 0\n",
        3,
        "shorter than its header says; found '1 lines'; expected 3",
    ),
    (HEAD + f"element vertex 1\n{XYZ}end_header\n0 0\n", 8, "the line ends before 'z' does"),
    (HEAD + f"element vertex 1\n{XYZ}end_header\n0 0 0 0\n", 8, "more values than 'vertex' has properties"),
    (HEAD + f"element vertex 1\n{XYZ}end_header\n\n\n0 0 y\n", 10, "cannot read 'y'"),
    (HEAD + f"element vertex 1\n{XYZ}end_header\n0 nan 0\n", 8, "vertex 0: a coordinate that is not finite"),
    (ONE + "3 0 1 3\n", 13, "face 0: no such vertex; found '3'; expected an index from 0 to 2"),
    (ONE + "3 0 1 -1\n", 13, "no such vertex"),
    (ONE + "3 0 1\n", 13, "the line ends before 'vertex_indices' does"),
    (ONE + "3 0 1 2 2\n", 13, "more values"),
    (ONE + "2 0 1\n", 13, "at least three corners"),
    (ONE + "0\n", 13, "at least three corners"),
    (ONE + "3 0 1 1.5\n", 13, "bad value for 'vertex_indices'"),
    (
        ONE + "256 0 1 1\n",
        13,
        "bad value for 'vertex_indices'; found '256 0 1 1'; expected a whole number from 0 to 255",
    ),
    (ONE + "3 0 1 nan\n", 13, "bad value"),
    (ONE.replace("uchar int", "char int") + "-1\n", 13, "negative length"),
    (ONE.replace("vertex_indices", "corners") + "3 0 1 2\n", 7, "lack their vertex indices"),
    (ONE.replace("uchar int", "uchar float") + "3 0 1 2\n", 7, "lack their vertex indices"),
    (ONE.replace("element face", "element tristrips") + "3 0 1 2\n", 7, "triangle strips are not supported"),
    ("ply\nformat binary_little_endian 1.0\n" + f"element vertex 1\n{XYZ}end_header\n01234567890", 3, "11 bytes"),
]


@pytest.mark.parametrize(("text", "line", "message"), MALFORMED_PLY)
def test_malformed_ply(text, line, message):
    source = io.StringIO(text)
    source.name = "bad.ply"
    with pytest.raises(MeshFormatError) as caught:
        load_ply(source)
    assert str(caught.value).startswith("bad.ply" + (f", line {line}: " if line else ": "))
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(3, 0, 1, 2), (3, 0, 1)], "face 1 of 2 has a negative length, or runs past the end of the file"),
        ([(3, 0, 1, 2), (2_000_000_000, 0)], "face 1 of 2 .*'a list of 2000000000'"),
        ([(2_000_000_000, 0), (3, 0, 1, 2)], "face 0 of 2 .*'a list of 2000000000'"),
        ([(-1, 5), (3, 0, 1, 2)], "face 0 of 2 .*'a list of -1'"),
        ([(4, 0, 1, 2, 0), (3, 0, 1, 3)], "face 1: no such vertex; found '3'"),
        ([(3, 0, 1, 2), (2, 0, 1)], "face 1: a face needs at least three corners"),
    ],
)
def test_malformed_binary_faces(order, rows, message):
    name = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{name}_endian 1.0\nelement vertex 3\n{XYZ}element face 2\n"
    body = struct.pack(f"{order}9f", *range(9))
    body += b"".join(struct.pack(f"{order}{len(row)}i", *row) for row in rows)
    data = (head + "property list int int vertex_index\nend_header\n").encode() + body
    with pytest.raises(MeshFormatError, match=message):
        load_ply(io.BytesIO(data))


BINARY_ASSETS = [
    ply_asset("binary_little_endian"), ply_asset("binary_big_endian"), ply_asset("binary_big_endian", False),
    stl_asset(binary=True), glb_asset(textured=True), glb_asset(textured=False),
]  # fmt: skip


@pytest.mark.parametrize("asset", BINARY_ASSETS, ids=lambda asset: asset.name)
def test_no_binary_file_can_be_cut_short(asset, tmp_path):
    path, whole = tmp_path / asset.name, asset.files[asset.name]
    load = IO().load_pointcloud if "cloud" in asset.name else IO().load_mesh
    path.write_bytes(whole)
    load(path)
    for length in [*range(0, len(whole), 1 + len(whole) // 200), *range(len(whole) - 9, len(whole))]:
        path.write_bytes(whole[:length])
        with pytest.raises(MeshFormatError, match=asset.name):
            load(path)


@pytest.mark.parametrize("claims", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("is_", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_body_of_another_encoding_than_the_header_says(claims, is_):
    data = ply_asset(is_).files["mesh.ply"].replace(is_.encode(), claims.encode(), 1)
    if claims == is_:
        assert len(load_ply(io.BytesIO(data))[1]) == 4
        return
    with pytest.raises(MeshFormatError):
        load_ply(io.BytesIO(data))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    "lie",
    [
        f"element vertex 1000000000\n{XYZ}",
        f"element vertex 0\n{XYZ}element face 1000000000\n{FACE}",
        f"element vertex 0\n{XYZ}element noise 999999999999999999\nproperty char x\n",
    ],
)
def test_a_lying_header_allocates_nothing(encoding, lie):
    data = f"ply\nformat {encoding} 1.0\n{lie}end_header\n".encode() + b"1 2 3\n" * 100
    tracemalloc.start()
    try:
        with pytest.raises(MeshFormatError, match="short"):
            load_ply(io.BytesIO(data))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2_000_000


def test_binary_behind_a_text_handle(tmp_path):
    path = tmp_path / "mesh.ply"
    path.write_bytes(
        f"ply\nformat binary_big_endian 1.0\nelement vertex 1\n{XYZ}end_header\n".encode() + b"\xff" * 12
    )
    with path.open(encoding="utf-8") as handle, pytest.raises(MeshFormatError, match="a handle opened with 'rb'"):
        load_ply(handle)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("Kd 1 1 1\n", 1, "a property before any material"),
        ("newmtl\n", 1, "newmtl without a name"),
        ("newmtl a\nKd 1 1\n", 2, "bad material value; found '1 1'; expected 1 or 3 finite numbers"),
        ("newmtl a\nKa 1 x 1\n", 2, "bad material value"),
        ("newmtl a\nKs 1 nan 1\n", 2, "bad material value"),
        ("newmtl a\nNs\n", 2, "expected 1 finite number"),
        ("newmtl a\nmap_Kd\n", 2, "without a file name"),
        ("newmtl a\nmap_Kd -bm 1\n", 2, "without a file name"),
        ("newmtl a\nmap_Kd broken.png\n", None, "cannot decode the image"),
    ],
)
def test_malformed_mtl(tmp_path, text, line, message):
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "m.mtl").write_text(text)
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl a\n")
    with pytest.raises(MeshFormatError) as caught:
        load_obj(tmp_path / "m.obj")
    name = "m.mtl" if line else "broken.png"
    assert str(caught.value).startswith(str(tmp_path / name) + (f", line {line}: " if line else ": "))
    assert message in str(caught.value)


# No path leaves the folder


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A folder `asset` for OBJ files, and beside it what they must not reach."""
    (tmp_path / "asset").mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nKd 1 0 0\n")
    Image.new("RGB", (1, 1), (255, 0, 0)).save(tmp_path / "secret.png")
    return tmp_path


ESCAPES: list[tuple[str, Callable[[Path], str], str]] = [
    ("climbing", lambda folder: "../secret.{}", "leaves the folder"),
    ("climbing from below", lambda folder: "x/../../secret.{}", "leaves the folder"),
    ("Windows climbing", lambda folder: "..\\secret.{}", "leaves the folder"),
    ("absolute", lambda folder: f"{folder}/secret.{{}}", "is absolute"),
    ("drive", lambda folder: "C:\\secret.{}", "is absolute"),
    ("drive-relative", lambda folder: "C:secret.{}", "is absolute"),
    ("network", lambda folder: "\\\\server\\share\\secret.{}", "is absolute"),
    ("file url", lambda folder: f"file://{folder}/secret.{{}}", "is a URL"),
    ("web url", lambda folder: "https://example.org/secret.{}", "is a URL"),
    ("link", lambda folder: "link.{}", "through a link"),
    ("link to a folder", lambda folder: "up/secret.{}", "through a link"),
]


@pytest.mark.parametrize("kind", ["mtl", "png"])
@pytest.mark.parametrize(("name", "message"), [row[1:] for row in ESCAPES], ids=[row[0] for row in ESCAPES])
def test_no_path_leaves_the_folder(secret, kind, name, message):
    asset = secret / "asset"
    os.symlink(secret / f"secret.{kind}", asset / f"link.{kind}")
    os.symlink(secret, asset / "up")
    written = name(secret).format(kind)
    (asset / "inside.mtl").write_text(f"newmtl a\nmap_Kd {written}\n")
    library = written if kind == "mtl" else "inside.mtl"
    (asset / "m.obj").write_text(f"# trap\nmtllib {library}\nusemtl a\n")
    with pytest.raises(MeshFormatError, match=message) as caught:
        load_obj(asset / "m.obj")
    assert caught.value.line == 2
    assert caught.value.found == written
    with pytest.raises(MeshFormatError, match=message):
        IO().load_mesh(asset / "m.obj")


def test_the_caller_may_let_paths_out(secret):
    obj = secret / "asset" / "m.obj"
    obj.write_text("mtllib ../secret.mtl\nusemtl a\n")
    assert load_obj(obj, allow_outside=True)[2].material_colors["a"]["diffuse_color"].tolist() == [1, 0, 0]
    (secret / "asset" / "m.mtl").write_text(f"newmtl a\nmap_Kd {secret}/secret.png\n")
    obj.write_text("mtllib m.mtl\nusemtl a\n" + TRIANGLE + "vt 0 0\nf 1/1 2/1 3/1\n")
    mesh = IO().load_mesh(obj, allow_outside=True)
    assert mesh.textures.maps_padded().tolist() == [[[[1, 0, 0]]]]


def test_links_that_stay_inside_are_followed(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "real.mtl").write_text("newmtl a\nKd 0 1 0\n")
    os.symlink("deep/real.mtl", tmp_path / "m.mtl")
    os.symlink("circle.mtl", tmp_path / "circle.mtl")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl a\n")
    assert load_obj(tmp_path / "m.obj")[2].material_colors["a"]["diffuse_color"].tolist() == [0, 1, 0]
    (tmp_path / "m.obj").write_text("mtllib circle.mtl\nusemtl a\n")
    with pytest.warns(UserWarning, match="does not exist"):
        load_obj(tmp_path / "m.obj")


@pytest.mark.parametrize("content", ["newmtl a\n".encode("utf-16"), b"newmtl \xff\nmap_Kd \xff.png\n", b"\0\0\0\0"])
def test_libraries_that_are_no_text_define_nothing_that_is_used(tmp_path, content):
    (tmp_path / "m.mtl").write_bytes(content)
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl a\n")
    with pytest.warns(UserWarning, match="does not define it"):
        load_obj(tmp_path / "m.obj")


def test_a_colour_beyond_single_precision_is_refused(tmp_path):
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1e39 0 0\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl a\n")
    with pytest.raises(MeshFormatError, match="bad material value; found '1e39 0 0'"):
        load_obj(tmp_path / "m.obj")


def test_a_name_with_nul_is_refused(tmp_path):
    (tmp_path / "m.mtl").write_bytes(b"newmtl a\nmap_Kd x\0.png\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl a\n")
    with pytest.raises(MeshFormatError, match="NUL"):
        load_obj(tmp_path / "m.obj", allow_outside=True)


def test_folders_and_pipes_are_no_textures(tmp_path):
    (tmp_path / "folder.png").mkdir()
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nusemtl a\n")
    for name in ("folder.png", "pipe.png"):
        (tmp_path / "m.mtl").write_text(f"newmtl a\nmap_Kd {name}\n")
        with pytest.warns(UserWarning, match="does not exist"):
            load_obj(tmp_path / "m.obj")


def test_the_error_survives_a_worker_process():
    error = MeshFormatError("why", "f.obj", 3, "found" * 50, "more")
    copy = pickle.loads(pickle.dumps(error))
    assert str(copy) == str(error)
    assert (copy.why, copy.file, copy.line, copy.found, copy.expected) == ("why", "f.obj", 3, "found" * 50, "more")
    assert "..." in str(error)
    assert "\\x1b" in str(MeshFormatError("why", found="\x1b[31m"))
