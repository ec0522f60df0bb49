"""Textures: sampling against closed forms, and joined, extended or picked textures against what they came from."""

from dataclasses import dataclass

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra.renderer.mesh.textures import TexturesAtlas, TexturesBase, TexturesUV, TexturesVertex
from rendra.structures import Meshes, join_meshes_as_batch, join_meshes_as_scene

VERTS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [1, 4, 2]])


@dataclass
class Slots:
    """What sampling reads of fragments."""

    pix_to_face: Tensor
    bary_coords: Tensor


def random_slots(faces_per_mesh: list[int], size: int = 6, layers: int = 3) -> Slots:
    """About a third of the slots filled; image n shows faces of mesh n."""
    pix_to_face = torch.full((len(faces_per_mesh), size, size, layers), -1)
    first = 0
    for own, count in zip(pix_to_face, faces_per_mesh, strict=True):
        if count:
            filled = torch.rand(own.shape) < 0.3
            own[filled] = first + torch.randint(0, count, (int(filled.sum()),))
        first += count
    bary = torch.rand(*pix_to_face.shape, 3)
    bary = bary / bary.sum(-1, keepdim=True)
    bary[pix_to_face < 0] = torch.nan  # what an empty slot holds must not matter
    return Slots(pix_to_face, bary)


def two_meshes(textures: TexturesBase | None = None) -> Meshes:
    return Meshes([VERTS, VERTS[:4]], [FACES, FACES[:2]], textures)


def uv_textures(**options: object) -> TexturesUV:
    maps = [torch.rand(5, 7, 3), torch.rand(4, 2, 3)]
    uvs = [torch.rand(6, 2), torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])]
    return TexturesUV(maps, [torch.randint(0, 6, (3, 3)), FACES[:2]], uvs, **options)


def some_textures(kind: str) -> TexturesBase:
    if kind == "vertex":
        return TexturesVertex([torch.rand(5, 2), torch.rand(4, 2)])
    if kind == "atlas":
        return TexturesAtlas([torch.rand(3, 4, 4, 2), torch.rand(2, 4, 4, 2)])
    if kind == "multi":
        maps = [torch.rand(2, 3, 3, 3), torch.rand(4, 5, 2, 3)]
        ids = [torch.tensor([0, 1, 0]), torch.tensor([3, 1])]
        return TexturesUV(maps, [FACES, FACES[:2]], [torch.rand(5, 2), torch.rand(4, 2)], maps_ids=ids)
    return uv_textures()


KINDS = ["vertex", "atlas", "uv", "multi"]


@pytest.mark.parametrize("kind", KINDS)
def test_empty_slots_are_zero_and_filled_ones_are_not(kind: str) -> None:
    slots = random_slots([3, 2])
    texels = two_meshes(some_textures(kind)).sample_textures(slots)
    assert texels.shape[:-1] == slots.pix_to_face.shape
    assert_finite(texels)
    assert torch.equal((texels != 0).any(-1), slots.pix_to_face >= 0)


@pytest.mark.parametrize("kind", KINDS)
def test_corners_read_what_faces_verts_textures_says(kind: str) -> None:
    meshes = two_meshes(some_textures(kind))
    corners = meshes.textures.faces_verts_textures_packed(meshes.faces_packed())
    # one pixel for each face of the batch, one layer for each of its corners
    for mesh, faces in ((0, [0, 1, 2]), (1, [3, 4])):
        pix_to_face = torch.full((2, 3, 1, 3), -1)
        pix_to_face[mesh, : len(faces), 0] = torch.tensor(faces)[:, None]
        slots = Slots(pix_to_face, torch.eye(3).expand(2, 3, 1, 3, 3))
        texels = meshes.sample_textures(slots)
        assert_close(texels[mesh, : len(faces), 0], corners[faces])


def test_vertex_features_are_interpolated_linearly() -> None:
    weights = torch.randn(3, 4)
    meshes = two_meshes(TexturesVertex([VERTS @ weights, VERTS[:4] @ weights]))
    slots = random_slots([3, 2])
    filled = slots.pix_to_face >= 0
    corners = meshes.verts_packed()[meshes.faces_packed()][slots.pix_to_face[filled]]
    points = (corners * slots.bary_coords[filled][..., None]).sum(1)
    assert_close(meshes.sample_textures(slots)[filled], points @ weights)


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("order", [[0, 1], [1, 0]], ids=["in order", "shuffled"])
def test_a_map_that_is_linear_in_its_coordinates_is_read_exactly(align_corners: bool, order: list[int]) -> None:
    def ramp(height: int, width: int) -> Tensor:
        """The coordinates (u, v) of every texel: v grows upwards."""
        if align_corners:
            u, v = torch.linspace(0, 1, width), torch.linspace(1, 0, height)
        else:
            u, v = (torch.arange(width) + 0.5) / width, 1 - (torch.arange(height) + 0.5) / height
        return torch.stack([u.expand(height, width), v[:, None].expand(height, width)], dim=-1)

    uvs = [0.25 + 0.5 * torch.rand(5, 2), 0.25 + 0.5 * torch.rand(4, 2)]
    textures = TexturesUV([ramp(9, 12), ramp(6, 5)], [FACES, FACES[:2]], uvs, align_corners=align_corners)
    slots = random_slots([3, 2])
    slots = Slots(slots.pix_to_face[order], slots.bary_coords[order])  # hits need not be sorted by mesh
    filled = slots.pix_to_face >= 0
    corners = torch.cat([uvs[0][FACES], uvs[1][FACES[:2]]])[slots.pix_to_face[filled]]
    expected = (corners * slots.bary_coords[filled][..., None]).sum(1)
    assert_close(textures.sample_textures(slots)[filled], expected)


def test_row_zero_of_a_map_is_its_top() -> None:
    image = torch.tensor([[[1.0], [2.0]], [[3.0], [4.0]]])
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    textures = TexturesUV(image[None], FACES[None, :2], uvs[None])
    corners = textures.faces_verts_textures_packed()[..., 0]
    assert_close(corners, [[3.0, 4, 2], [3, 2, 1]])
    assert_close(textures.centers_for_image(0), [[0.0, 1], [1, 1], [1, 0], [0, 0]])


def test_every_map_of_a_mesh_is_found() -> None:
    maps = torch.arange(6.0).view(2, 3, 1, 1, 1).expand(2, 3, 2, 2, 1)
    ids = torch.tensor([[2, 0, 1], [1, 1, 0]])
    textures = TexturesUV(maps, FACES.expand(2, -1, -1), torch.rand(2, 5, 2), maps_ids=ids)
    pix_to_face = torch.arange(6).view(2, 1, 3, 1)
    slots = Slots(pix_to_face, torch.full((2, 1, 3, 1, 3), 1 / 3))
    assert_close(textures.sample_textures(slots).flatten(), [2.0, 0, 1, 4, 4, 3])
    assert torch.equal(textures.maps_ids_padded(), ids)
    assert textures.maps_padded() is maps
    for refused in (textures.join_scene, lambda: textures.centers_for_image(0)):
        with pytest.raises(NotImplementedError, match="maps_ids"):
            refused()


def test_the_triangles_of_an_atlas() -> None:
    size = 3
    atlas = torch.arange(9.0).view(1, 1, size, size, 1)
    textures = TexturesAtlas(atlas)
    centers, expected = [], []
    for j in range(size):
        for i in range(size - j):
            centers.append(((i + 1 / 3) / size, (j + 1 / 3) / size))
            expected.append(atlas[0, 0, j, i, 0])
            if i + j < size - 1:
                centers.append(((i + 2 / 3) / size, (j + 2 / 3) / size))
                expected.append(atlas[0, 0, size - 1 - j, size - 1 - i, 0])
    w = torch.tensor(centers)
    bary = torch.cat([w, 1 - w.sum(1, keepdim=True)], dim=1).view(1, 1, 9, 1, 3)
    texels = textures.sample_textures(Slots(torch.zeros(1, 1, 9, 1, dtype=torch.int64), bary))
    assert sorted(expected) == list(range(9))  # each texel once
    assert_close(texels.flatten(), torch.stack(expected))
    outside = torch.tensor([[1.5, -0.25, -0.25], [-0.5, 1.5, 0.0], [-0.2, -0.2, 1.4]]).view(1, 1, 3, 1, 3)
    texels = textures.sample_textures(Slots(torch.zeros(1, 1, 3, 1, dtype=torch.int64), outside))
    assert_close(texels.flatten(), textures.faces_verts_textures_packed().flatten())


@pytest.mark.parametrize("kind", ["vertex", "uv", "multi"])
def test_derivatives(kind: str) -> None:
    torch.manual_seed(3)
    textures = some_textures(kind)._apply(lambda t: t.double() if t.is_floating_point() else t)
    slots = random_slots([3, 2], size=2)
    filled = slots.pix_to_face >= 0
    bary = slots.bary_coords[filled].double().requires_grad_()
    if kind == "vertex":
        parts = [p.requires_grad_() for p in textures.verts_features_list()]
    else:
        parts = [p.requires_grad_() for p in (*textures.maps_list(), *textures.verts_uvs_list())]

    def sampled(bary: Tensor, *parts: Tensor) -> Tensor:
        dense = torch.zeros(*slots.pix_to_face.shape, 3, dtype=torch.float64)
        fragments = Slots(slots.pix_to_face, dense.index_put((filled,), bary))
        if kind == "vertex":
            return two_meshes(TexturesVertex(list(parts))).sample_textures(fragments)
        ids = textures.maps_ids_list()
        new = TexturesUV(list(parts[:2]), textures.faces_uvs_list(), list(parts[2:]), maps_ids=ids)
        return new.sample_textures(fragments)

    assert torch.autograd.gradcheck(sampled, (bary, *parts))


def test_an_atlas_receives_gradients() -> None:
    atlas = torch.rand(1, 3, 2, 2, 3, requires_grad=True)
    slots = random_slots([3])
    TexturesAtlas(atlas).sample_textures(slots).sum().backward()
    assert atlas.grad.sum() == 3 * (slots.pix_to_face >= 0).sum()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("index", [1, [1, 0], slice(0, 1), torch.tensor([True, True])], ids=str)
def test_picked_meshes_keep_their_texture(kind: str, index: object) -> None:
    meshes = two_meshes(some_textures(kind))
    corners = meshes.textures.faces_verts_textures_packed(meshes.faces_packed()).split([3, 2])
    picked = meshes[index]
    chosen = torch.tensor([0, 1])[torch.tensor(index) if isinstance(index, list) else index].reshape(-1).tolist()
    assert_close(
        picked.textures.faces_verts_textures_packed(picked.faces_packed()), torch.cat([corners[i] for i in chosen])
    )


@pytest.mark.parametrize("kind", KINDS)
def test_extended_split_joined_and_cloned_textures_stay(kind: str) -> None:
    meshes = two_meshes(some_textures(kind))

    def corners(of: Meshes) -> Tensor:
        return of.textures.faces_verts_textures_packed(of.faces_packed())

    before = corners(meshes)
    assert_close(corners(meshes.extend(2)), torch.cat([before[:3]] * 2 + [before[3:]] * 2))
    assert_close(corners(join_meshes_as_batch(meshes.split([1, 1]))), before)
    assert_close(corners(meshes.clone()), before)
    assert_close(corners(meshes.detach()), before)
    parts = meshes.submeshes([[torch.tensor([2, 0])], [torch.tensor([1]), torch.tensor([0, 1])]])
    assert_close(corners(parts), before[[2, 0, 4, 3, 4]])


@pytest.mark.parametrize("kind", ["vertex", "atlas"])
def test_scenes_of_features_and_atlases_look_the_same(kind: str) -> None:
    meshes = two_meshes(some_textures(kind))
    slots = random_slots([5])
    scene = join_meshes_as_scene(meshes)
    filled = slots.pix_to_face >= 0
    flat = Slots(slots.pix_to_face[filled].view(1, 1, -1, 1), slots.bary_coords[filled].view(1, 1, -1, 1, 3))
    assert_close(scene.sample_textures(flat), meshes.sample_textures(flat))


@pytest.mark.parametrize("sampling_mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("padding_mode", ["border", "zeros", "reflection"])
@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("spread", [1.0, 2.5], ids=["inside", "outside"])
def test_scenes_of_maps_look_the_same(
    sampling_mode: str, padding_mode: str, align_corners: bool, spread: float
) -> None:
    options = {"padding_mode": padding_mode, "align_corners": align_corners, "sampling_mode": sampling_mode}
    shared = torch.rand(3, 8, 2)
    maps = [torch.rand(5, 7, 2), torch.rand(1, 4, 2), shared, shared, torch.rand(6, 1, 2)]
    uvs = [(torch.rand(6, 2) - 0.5) * spread + 0.5 for _ in maps]
    uvs[0][:4] = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    textures = TexturesUV(maps, [torch.randint(0, 6, (4, 3)) for _ in maps], uvs, **options)
    slots = random_slots([4] * 5, size=20)
    filled = slots.pix_to_face >= 0
    flat = Slots(slots.pix_to_face[filled].view(1, 1, -1, 1), slots.bary_coords[filled].view(1, 1, -1, 1, 3))
    scene = textures.join_scene()
    assert len(scene) == 1
    assert scene.verts_uvs_padded().shape == (1, 30, 2)
    before, after = textures.sample_textures(flat), scene.sample_textures(flat)
    # rounding may turn a nearest texel where a point lies between two
    changed = ((before - after).abs() > 1e-4).any(-1).sum()
    assert changed <= (2 if sampling_mode == "nearest" else 0), f"{changed} of {before.shape[2]} points"


def test_a_map_used_twice_is_stored_once_and_receives_both_gradients() -> None:
    image = torch.rand(4, 4, 3, requires_grad=True)
    uvs = torch.rand(5, 2)
    scene = TexturesUV([image], [FACES], [uvs]).extend(6).join_scene()
    assert scene.maps_padded().shape == (1, 4, 4, 3)
    scene.faces_verts_textures_packed().sum().backward()
    assert image.grad.sum().item() == pytest.approx(6 * 9 * 3, rel=1e-4)


def test_scenes_refuse_coordinates_far_outside() -> None:
    textures = TexturesUV(torch.rand(2, 3, 3, 3), FACES.expand(2, -1, -1), torch.full((2, 5, 2), 4.0))
    with pytest.raises(ValueError, match=r"must lie in \[-2, 3\]"):
        textures.join_scene()
    with pytest.raises(ValueError, match="equal channels"):
        TexturesUV([torch.rand(2, 2, 3), torch.rand(2, 2, 4)], [FACES] * 2, [torch.rand(5, 2)] * 2).join_scene()


def test_maps_of_different_sizes_are_enlarged_when_padded() -> None:
    textures = uv_textures()
    padded = textures.maps_padded()
    assert padded.shape == (2, 5, 7, 3)
    assert_close(padded[0], textures.maps_list()[0], atol=0)
    assert_close(padded[1, [0, 0, -1, -1], [0, -1, 0, -1]], textures.maps_list()[1][[0, 0, -1, -1], [0, -1, 0, -1]])


def test_a_parameter_can_be_fitted_without_building_the_textures_again() -> None:
    image = torch.zeros(1, 4, 4, 3, requires_grad=True)
    meshes = Meshes([VERTS], [FACES], TexturesUV(image, FACES[None], torch.rand(1, 5, 2)))
    slots = random_slots([3])
    losses = []
    for _ in range(3):
        loss = ((meshes.extend(1).sample_textures(slots) - 1)[slots.pix_to_face >= 0] ** 2).mean()
        (gradient,) = torch.autograd.grad(loss, image)
        losses.append(loss.item())
        with torch.no_grad():
            image -= gradient
    assert losses[0] > losses[1] > losses[2]


def test_no_mesh_and_no_hit() -> None:
    nothing = Slots(torch.zeros(0, 2, 2, 1, dtype=torch.int64), torch.zeros(0, 2, 2, 1, 3))
    missed = Slots(torch.full((2, 2, 2, 1), -1), torch.zeros(2, 2, 2, 1, 3))
    for kind in KINDS:
        meshes = two_meshes(some_textures(kind))
        assert meshes[[]].sample_textures(nothing).shape[:-1] == (0, 2, 2, 1)
        assert (meshes.sample_textures(missed) == 0).all()
        assert meshes.textures[[]].isempty()
    assert len(uv_textures()[[]].join_scene()) == 1
    assert TexturesUV([], [], []).maps_padded().shape == (0, 0, 0, 3)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: TexturesVertex("x"), "verts_features must be a list of tensors"),
        (lambda: TexturesVertex(torch.rand(3, 2)), r"must be a tensor \(N, M, C\), got \(3, 2\)"),
        (lambda: TexturesVertex([torch.rand(3, 2), torch.rand(3, 4)]), "rows of one shape"),
        (lambda: TexturesAtlas(torch.rand(1, 2, 3, 4, 3)), "square maps"),
        (lambda: TexturesUV(torch.rand(1, 2, 2, 3), FACES[None], torch.rand(1, 2, 2)), "refers to row 4"),
        (lambda: TexturesUV(torch.rand(2, 2, 3), FACES[None], torch.rand(1, 5, 2)), "must be floating point"),
        (lambda: TexturesUV(torch.rand(2, 2, 2, 3), FACES[None], torch.rand(1, 5, 2)), "one entry for each mesh"),
        (lambda: TexturesUV([torch.ones(2, 2, 3).long()], [FACES], [torch.rand(5, 2)]), r"maps\[0\] must be"),
        (lambda: uv_textures(padding_mode="mirror"), "padding_mode must be"),
        (lambda: uv_textures(sampling_mode="cubic"), "sampling_mode must be"),
        (lambda: uv_textures().extend(0), "N must be an integer > 0"),
        (lambda: uv_textures().join_batch([uv_textures(align_corners=False)]), "same padding_mode"),
        (lambda: uv_textures().join_batch([TexturesVertex([VERTS])]), "must be of type TexturesUV"),
        (lambda: TexturesVertex([VERTS]).faces_verts_textures_packed(), "needs faces_packed"),
    ],
)
def test_wrong_input_is_named(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()
