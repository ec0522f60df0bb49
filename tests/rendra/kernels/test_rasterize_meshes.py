"""The rasteriser's two twins against closed forms, finite differences and each other."""

import pytest
import torch
from assertions import assert_close, assert_finite
from scenes import BLUR, packed, soup, with_monsters

from rendra.kernels.rasterize_meshes import numba_cpu, rasterize_meshes, reference


def draw(
    faces,
    counts=None,
    size=(24, 24),
    blur=0.0,
    layers=1,
    perspective=True,
    clip=None,
    cull=False,
    neighbor=None,
):
    counts = counts or (len(faces),)
    clip = blur > 0 if clip is None else clip
    return rasterize_meshes(faces, *packed(*counts), neighbor, size, blur, layers, perspective, clip, cull)


def draw_reference(faces, counts=None, size=(24, 24), blur=0.0, layers=1, perspective=True, clip=None, cull=False,
                   neighbor=None):  # fmt: skip
    counts = counts or (len(faces),)
    clip = blur > 0 if clip is None else clip
    return reference.rasterize_meshes(faces, *packed(*counts), neighbor, size, blur, layers, perspective, clip, cull)


def assert_twins_agree(faces, **settings):
    fast, slow = draw(faces, **settings), draw_reference(faces, **settings)
    torch.testing.assert_close(fast[0], slow[0], atol=0, rtol=0)
    torch.testing.assert_close(fast[1], slow[1], atol=1e-6, rtol=0)
    torch.testing.assert_close(fast[2], slow[2], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(fast[3], slow[3], atol=1e-8, rtol=1e-5)
    return fast


def test_published_example():
    """Anchor of facts/methods.md 6.11."""
    face = torch.tensor([[[0.9, 0.9, 1.0], [0.5, 0.9, 2.0], [0.9, 0.5, 3.0]]])
    for draw_it in (draw, draw_reference):
        pix_to_face, zbuf, bary, dists = draw_it(face, size=(4, 8))
        assert (pix_to_face >= 0).nonzero().tolist() == [[0, 0, 2, 0]]
        assert_close(bary[0, 0, 2, 0], [0.4444, 0.3333, 0.2222], atol=5e-5)
        assert_close(zbuf[0, 0, 2, 0], 1.7778, atol=5e-5)
        assert_close(dists[0, 0, 2, 0], -0.0050, atol=5e-5)


@pytest.mark.parametrize("size", [(24, 24), (17, 31), (31, 17), (1, 1), (1, 40), (9, 8)])
@pytest.mark.parametrize(("blur", "layers"), [(0.0, 1), (0.0, 4), (BLUR, 1), (0.02, 6)])
def test_twins_agree_on_awkward_sizes(size, blur, layers):
    assert_twins_agree(with_monsters(soup(60)), size=size, blur=blur, layers=layers)


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("clip", [True, False])
@pytest.mark.parametrize("cull", [True, False])
def test_twins_agree_on_every_flag(perspective, clip, cull):
    assert_twins_agree(soup(50, seed=1), blur=0.01, layers=5, perspective=perspective, clip=clip, cull=cull)


def test_twins_agree_on_a_ragged_batch():
    faces = soup(40, seed=2)
    pix_to_face = assert_twins_agree(faces, counts=(13, 0, 27), layers=3, blur=0.005)[0]
    assert (pix_to_face[1] == -1).all()
    assert set(pix_to_face[0].unique().tolist()) <= set(range(-1, 13))
    assert set(pix_to_face[2].unique().tolist()) <= {-1, *range(13, 40)}


def test_no_faces_and_no_images():
    assert (draw(torch.zeros(0, 3, 3), counts=(0,), layers=2, blur=0.1)[0] == -1).all()
    none = torch.zeros(0, dtype=torch.int64)
    outputs = rasterize_meshes(torch.zeros(0, 3, 3), none, none, None, (5, 7), 0.0, 2, True, False, False)
    assert [tuple(o.shape) for o in outputs] == [(0, 5, 7, 2), (0, 5, 7, 2), (0, 5, 7, 2, 3), (0, 5, 7, 2)]


@pytest.mark.parametrize(("blur", "layers"), [(0.0, 1), (0.01, 7)])
def test_every_output_element_is_written(blur, layers):
    faces, size = soup(30), (13, 22)
    shape = (2, *size, layers)
    outputs = (
        torch.full(shape, -7),
        torch.full(shape, float("nan")),
        torch.full((*shape, 3), float("nan")),
        torch.full(shape, float("nan")),
    )
    first, num = packed(10, 20)
    neighbor = torch.full((30,), -1)
    numba_cpu.forward(
        faces.numpy(), first.numpy(), num.numpy(), neighbor.numpy(), size, blur, layers, (True, True, False),
        tuple(o.numpy() for o in outputs),
    )  # fmt: skip
    assert (outputs[0] >= -1).all()
    for output in outputs[1:]:
        assert_finite(output)


def test_ties_go_to_the_lower_index_and_order_is_by_depth():
    one = torch.tensor([[[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]]])
    near = one - torch.tensor([0.0, 0.0, 1.0])
    faces = torch.cat([one, one, near, one])
    for draw_it in (draw, draw_reference):
        assert draw_it(faces, size=(3, 3), layers=4)[0][0, 1, 1].tolist() == [2, 0, 1, 3]
        assert draw_it(faces[[0, 1, 3]], size=(3, 3))[0][0, 1, 1].tolist() == [0]


def test_image_does_not_depend_on_the_number_of_layers():
    """With enough layers for every pixel, more layers add padding only."""
    few, many = draw(soup(12), blur=0.01, layers=12), draw(soup(12), blur=0.01, layers=40)
    assert (many[0][..., 12:] == -1).all()
    for a, b in zip(few, many, strict=True):
        assert torch.equal(a, b[:, :, :, :12])


def test_faces_may_come_in_any_order():
    faces, order = soup(40, seed=3), torch.randperm(40)
    plain, shuffled = draw(faces, layers=5, blur=0.004), draw(faces[order], layers=5, blur=0.004)
    back = torch.where(shuffled[0] >= 0, order[shuffled[0].clamp(min=0)], -1)
    assert torch.equal(back, plain[0])
    assert torch.equal(shuffled[1], plain[1])


def test_results_do_not_depend_on_threads():
    faces = soup(80, seed=4)
    threads = torch.get_num_threads()
    results = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        leaf = faces.clone().requires_grad_()
        outputs = draw(leaf, layers=6, blur=0.01, size=(50, 40))
        (outputs[1].sum() + outputs[2].square().sum() + outputs[3].sum()).backward()
        results.append((*outputs, leaf.grad))
    torch.set_num_threads(threads)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_a_sphere_of_faces_covers_a_disc():
    """Coverage of a regular 64-gon of radius 0.8 is its area."""
    angle = torch.linspace(0, 2 * torch.pi, 65) + 0.01  # no edge runs through pixel centres
    rim = torch.stack([angle.cos() * 0.8, angle.sin() * 0.8, torch.ones(65)], dim=-1)
    faces = torch.stack([torch.tensor([0.0, 0.0, 1.0]).expand(64, 3), rim[:-1], rim[1:]], dim=1)
    covered = (draw(faces.contiguous(), size=(200, 200))[0] >= 0).float().mean() * 4
    assert_close(covered, 32 * torch.sin(torch.tensor(2 * torch.pi / 64)) * 0.64, rtol=5e-3)


def test_depth_of_a_slanted_plane_is_perspective_correct():
    """On the plane z = 2 + x_world, seen by x_ndc = x / z: z = 2 / (1 - x_ndc)."""
    world = torch.tensor([[-1.0, -3.0, 1.0], [2.0, -3.0, 4.0], [0.5, 6.0, 2.5]])
    face = torch.cat([world[:, :2] / world[:, 2:], world[:, 2:]], dim=-1)[None]
    pix_to_face, zbuf, _, _ = draw(face, size=(32, 32))
    x = torch.arange(31, -32, -2) / 32
    expected = (2 / (1 - x)).expand(32, 32)
    hit = pix_to_face[0, :, :, 0] >= 0
    assert hit.sum() > 200
    assert_close(zbuf[0, :, :, 0][hit], expected[hit], atol=1e-5)


def test_the_clipped_halves_of_a_face_count_once():
    whole = torch.tensor([[-0.6, -0.6, 2.0], [0.6, -0.6, 2.0], [0.6, 0.6, 2.0], [-0.6, 0.6, 2.0]])
    halves = torch.stack([whole[[0, 1, 2]], whole[[0, 2, 3]]])
    neighbor = torch.tensor([1, 0])
    fast = assert_twins_agree(halves, neighbor=neighbor, blur=0.02, layers=3)
    assert (fast[0][..., 0] >= 0).sum() > 100
    assert (fast[0][..., 1] == -1).all()
    assert (draw(halves, blur=0.02, layers=3)[0][..., 1] >= 0).any()


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("clip", [True, False])
def test_gradients_agree_with_the_reference_in_float64(perspective, clip):
    faces = soup(30, seed=5)
    settings = {"layers": 4, "blur": 0.01, "size": (20, 28), "perspective": perspective, "clip": clip}
    single, double = faces.clone().requires_grad_(), faces.double().requires_grad_()
    fast, slow = draw(single, **settings), draw(double, **settings)
    same = (fast[0] == slow[0]) & ((fast[3] - slow[3]).abs() < 1e-5)
    assert (~same).sum() <= 2  # a counted allowance: pixels on an edge or on the blur radius
    same &= (slow[2].abs() < 50).all(-1)  # unclipped coordinates grow without bound towards a face's horizon
    for i in (1, 2, 3):
        weight = torch.randn_like(fast[i]) * (same if i != 2 else same[..., None])
        a, b = (
            torch.autograd.grad((out[i] * weight.to(out[i].dtype)).sum(), leaf, retain_graph=True)[0]
            for out, leaf in ((fast, single), (slow, double))
        )
        assert b.abs().max() > 0
        assert (a - b).norm() <= 1e-4 * b.norm(), i


def test_reference_gradients_are_finite_differences():
    faces = soup(6, seed=6).double().requires_grad_()

    def report(v):
        return rasterize_meshes(v, *packed(6), None, (6, 7), 0.01, 3, True, True, False)[1:]

    assert torch.autograd.gradcheck(report, (faces,), eps=1e-7, atol=1e-4, rtol=1e-3)


def test_gradients_of_monsters_are_finite():
    leaf = with_monsters(soup(20)).requires_grad_()
    outputs = draw(leaf, layers=5, blur=0.01)
    torch.autograd.backward(outputs[1:], [torch.ones_like(o) for o in outputs[1:]])
    assert_finite(leaf.grad)


def test_the_operator_is_well_registered():
    first, num = packed(8)
    arguments = (soup(8).requires_grad_(), first, num, None, 6, 5, 0.01, 2, True, True, False)
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.rendra.rasterize_meshes.default, arguments, test_utils=checks)


@pytest.mark.filterwarnings("ignore")  # of torch.compile itself
def test_the_operator_compiles():
    first, num = packed(8)

    def loss(faces):
        outputs = torch.ops.rendra.rasterize_meshes(faces, first, num, None, 6, 5, 0.01, 2, True, True, False)
        return outputs[1].sum() + outputs[3].square().sum()

    eager, compiled = soup(8).requires_grad_(), soup(8).requires_grad_()
    loss(eager).backward()
    torch.compile(loss, backend="aot_eager")(compiled).backward()
    assert_close(compiled.grad, eager.grad)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"face_verts": torch.zeros(4, 3)}, r"face_verts must be floats of shape \(F, 3, 3\)"),
        ({"image_size": (0, 4)}, "image_size must be"),
        ({"faces_per_pixel": 0}, "faces_per_pixel must be at least 1"),
        ({"blur_radius": -1.0}, "blur_radius must be zero or positive"),
        ({"blur_radius": float("nan")}, "blur_radius must be zero or positive"),
        ({"num_faces_per_mesh": torch.tensor([9])}, "leaves the 4 faces"),
        ({"mesh_to_face_first_idx": torch.tensor([0.0])}, "must be int64"),
        ({"clipped_faces_neighbor_idx": torch.tensor([-1])}, r"must have shape \(4,\)"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {
        "face_verts": soup(4), "mesh_to_face_first_idx": torch.tensor([0]), "num_faces_per_mesh": torch.tensor([4]),
        "clipped_faces_neighbor_idx": None, "image_size": (4, 4), "blur_radius": 0.0, "faces_per_pixel": 1,
        "perspective_correct": True, "clip_barycentric_coords": False, "cull_backfaces": False,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        rasterize_meshes(**{**arguments, **change})


@pytest.mark.gpu
def test_cuda_takes_the_reference():
    faces = soup(40)
    first, num = packed(40)
    cuda = rasterize_meshes(faces.cuda(), first.cuda(), num.cuda(), None, (32, 24), 0.01, 4, True, True, False)
    cpu = draw(faces, size=(32, 24), blur=0.01, layers=4)
    assert (cuda[0].cpu() != cpu[0]).sum() <= 4
