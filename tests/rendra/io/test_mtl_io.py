"""Material libraries, texture images and the atlas made from them."""

import io
import struct
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image

from rendra.io import MeshFormatError
from rendra.io import _images as images
from rendra.io.mtl_io import load_mtl, make_material_atlas, make_mesh_texture_atlas
from rendra.renderer.mesh.textures import TexturesAtlas


def load(text: str, folder: object = ".", names: tuple[str, ...] = ()) -> tuple:
    return load_mtl(io.StringIO(text), material_names=names, data_dir=str(folder))


def test_properties_of_materials():
    text = (
        "# head\nnewmtl one thing\n Ka 1 .5 0 # warm\nKd\t0.25\nKs spectral a.rfl\nNs 32\nillum 2\nd 1\nnewmtl two\n"
    )
    properties, textures = load(text)
    assert list(properties) == ["one thing", "two"]
    assert properties["two"] == {}
    assert set(properties["one thing"]) == {"ambient_color", "diffuse_color", "shininess"}
    assert_close(properties["one thing"]["ambient_color"], [1.0, 0.5, 0.0])
    assert_close(properties["one thing"]["diffuse_color"], [0.25] * 3)
    assert properties["one thing"]["shininess"].shape == (1,)
    assert textures == {}


@pytest.mark.parametrize(
    "written",
    ["a b.png", "./a b.png", "-clamp on a b.png", "-s 1 1 1 -o 0.5 a b.png", "-mm 0 1 -bm 2 a b.png", "x/../a b.png"],
)
def test_names_of_textures(tmp_path, written):
    (tmp_path / "x").mkdir()
    Image.new("RGB", (2, 3), (255, 0, 0)).save(tmp_path / "a b.png")
    _, textures = load(f"newmtl m\nmap_Kd {written}\n", tmp_path, ("m",))
    assert_close(textures["m"], torch.tensor([1.0, 0.0, 0.0]).expand(3, 2, 3))


def test_only_wanted_textures_are_read_in_the_order_wanted(tmp_path):
    Image.new("RGB", (1, 1)).save(tmp_path / "i.png")
    text = "newmtl a\nmap_Kd i.png\nnewmtl b\nmap_Kd i.png\nnewmtl c\nmap_Kd lost.png\n"
    assert list(load(text, tmp_path, ("b", "a"))[1]) == ["b", "a"]


# Images


def encoded(image: Image.Image, kind: str = "PNG", **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def test_modes_of_images():
    grey16 = np.array([[0, 13107], [65535, 32768]], dtype=np.uint16)
    decoded = images.decode_image(encoded(Image.fromarray(grey16)), "x")
    assert_close(decoded, torch.tensor(grey16 / 65535.0)[..., None].expand(2, 2, 3))
    palette = Image.new("P", (1, 1), 1)
    palette.putpalette([0, 0, 0, 51, 102, 255])
    for data in (encoded(palette), encoded(palette, transparency=1)):
        assert_close(images.decode_image(data, "x")[0, 0], [0.2, 0.4, 1.0])
    for mode, color in (("RGBA", (51, 102, 255, 10)), ("RGB", (51, 102, 255))):
        assert_close(images.decode_image(encoded(Image.new(mode, (1, 1), color)), "x")[0, 0], [0.2, 0.4, 1.0])
    for mode, color in (("L", 51), ("LA", (51, 9)), ("1", 0)):
        value = 0.2 if mode != "1" else 0.0
        assert_close(images.decode_image(encoded(Image.new(mode, (1, 1), color)), "x")[0, 0], [value] * 3)
    real = images.decode_image(encoded(Image.fromarray(np.array([[0.25, 7.0]], dtype=np.float32)), "TIFF"), "x")
    assert_close(real[0, :, 0], [0.25, 1.0])


def test_exif_turns_an_image_upright():
    image = Image.new("RGB", (3, 1))
    exif = image.getexif()
    exif[0x0112] = 6  # to be turned by 90 degrees
    assert images.decode_image(encoded(image, "PNG", exif=exif.tobytes()), "x").shape == (3, 1, 3)


def png_of_size(width: int, height: int) -> bytes:
    """A PNG that claims a size and holds nothing of it."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cannot decode the image"),
        (b"no image at all", "cannot decode the image"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "cannot decode the image"),
        (png_of_size(4, 4), "cannot decode the image"),
        (png_of_size(10_000, 9_000), "the image is too large; found '10000 x 9000'; expected at most 67,108,864"),
        (png_of_size(60_000, 60_000), "the image is too large"),
    ],
)
def test_bad_images(data, message):
    with pytest.raises(MeshFormatError, match=rf"^paint\.png: .*{message}"):
        images.decode_image(data, "paint.png")


def test_what_is_no_image_is_said_in_words_of_the_user():
    with pytest.raises(MeshFormatError) as caught:
        images.decode_image(b"print('hello')", "paint.png")
    assert "BytesIO" not in str(caught.value)
    assert "PNG, JPEG" in str(caught.value)


def test_truncated_images():
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8))
    for kind in ("PNG", "JPEG", "TIFF", "WEBP"):
        data = encoded(noise, kind)
        with pytest.raises(MeshFormatError, match="cannot decode the image"):
            images.decode_image(data[: len(data) // 2], "half")


# The atlas


def test_atlas_texels_are_where_the_texture_class_looks_for_them():
    size = 5
    uvs = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    u, v = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="xy")
    image = torch.stack([u, v.flip(0), torch.zeros_like(u)], dim=-1)  # colour = (u, v, 0), rows downwards
    atlas = make_material_atlas(image, uvs, size)
    assert atlas.shape == (1, size, size, 3)
    bary = torch.distributions.Dirichlet(torch.ones(3)).sample((500,))
    fragments = SimpleNamespace(
        pix_to_face=torch.zeros(1, 500, 1, 1, dtype=torch.int64), bary_coords=bary.reshape(1, 500, 1, 1, 3)
    )
    seen = TexturesAtlas([atlas]).sample_textures(fragments)[0, :, 0, 0, :2]
    assert ((seen - bary[:, 1:]).abs() <= 2 / 3 / size + 1e-5).all()
    assert_close((seen - bary[:, 1:]).mean(0), [0.0, 0.0], atol=0.02)


def test_atlas_of_one_texel_is_the_centroid():
    image = torch.rand(7, 5, 3)
    uvs = torch.rand(3, 3, 2)
    u, v = uvs.mean(1).unbind(-1)
    grid = torch.stack([2 * u - 1, 1 - 2 * v], -1)[None, :, None]
    expected = torch.nn.functional.grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=True)
    assert_close(make_material_atlas(image, uvs, 1).reshape(3, 3), expected[0, :, :, 0].T)


@pytest.mark.parametrize("shift", [1.0, -3.0])
def test_wrapping_repeats_or_clamps(shift):
    image = torch.rand(8, 8, 3)
    inner = 0.1 + 0.8 * torch.rand(4, 3, 2)
    home = make_material_atlas(image, inner, 3, texture_wrap="repeat")
    assert_close(make_material_atlas(image, inner + shift, 3, texture_wrap="repeat"), home, atol=1e-4)
    corner = image[0, -1] if shift > 0 else image[-1, 0]
    for wrap in ("clamp", None):
        assert_close(make_material_atlas(image, inner + shift, 3, texture_wrap=wrap), corner.expand(4, 3, 3, 3))


def test_mesh_atlas_falls_back_to_colours():
    uvs = torch.rand(3, 3, 2)
    colors = {"plain": {"diffuse_color": torch.tensor([0.1, 0.2, 0.3])}, "image": {}}
    textures = {"image": torch.full((2, 2, 3), 0.7)}
    names = np.array(["image", "plain", ""], dtype=object)
    atlas = make_mesh_texture_atlas(colors, textures, names, uvs, 2, "repeat")
    assert_close(atlas[:, 0, 0], [[0.7] * 3, [0.1, 0.2, 0.3], [1.0] * 3])
    assert make_mesh_texture_atlas({}, {}, [], torch.zeros(0, 3, 2), 2, None).shape == (0, 2, 2, 3)


@pytest.mark.parametrize(
    ("size", "wrap", "message"),
    [(0, None, "texture_size is 0"), (4, "mirror", "texture_wrap is 'mirror'"), (100_000, None, "reduce it")],
)
def test_bad_atlas_arguments(size, wrap, message):
    with pytest.raises(ValueError, match=message):
        make_mesh_texture_atlas({}, {}, [""], torch.zeros(1, 3, 2), size, wrap)
