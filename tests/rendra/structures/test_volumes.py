"""Laws of batches of voxel grids: sizes, places, and what is made from them."""

import pytest
import torch
import torch.nn.functional as F
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.structures import VolumeLocator, Volumes

SIZES = [[(3, 4, 5)], [(2, 2, 2), (2, 2, 2)], [(3, 4, 5), (5, 1, 2), (4, 4, 4)]]


def random_volumes(sizes: list[tuple[int, int, int]], channels: int = 3, **kwargs) -> Volumes:
    return Volumes([torch.rand(1, *size) for size in sizes], [torch.rand(channels, *s) for s in sizes], **kwargs)


@pytest.fixture(params=SIZES, ids=str)
def sizes(request: pytest.FixtureRequest) -> list[tuple[int, int, int]]:
    return request.param


def test_the_corner_of_a_volume_lies_where_pytorch3d_puts_it() -> None:
    volumes = Volumes(torch.zeros(1, 1, 3, 4, 5), voxel_size=0.1, volume_translation=(1.0, 0.0, 0.0))
    assert_close(volumes.local_to_world_coords(torch.ones(1, 3)), [[-0.8, 0.15, 0.1]])
    corners = volumes.get_coord_grid()[0, [0, -1], [0, -1], [0, -1]]
    assert_close(corners, [[-1.2, -0.15, -0.1], [-0.8, 0.15, 0.1]])


@pytest.mark.parametrize("align_corners", [True, False])
def test_world_and_back(sizes, align_corners: bool) -> None:
    edges, offsets = torch.rand(len(sizes), 3) + 0.1, torch.randn(len(sizes), 3)
    volumes = random_volumes(sizes, voxel_size=edges, volume_translation=offsets, align_corners=align_corners)
    for shape in ((3,), (7, 3), (2, 0, 3), (2, 5, 3)):
        points = torch.randn(len(sizes), *shape)
        world = volumes.local_to_world_coords(points)
        assert world.shape == points.shape
        assert_close(volumes.world_to_local_coords(world), points, atol=1e-4)
    there, back = volumes.get_local_to_world_coords_transform(), volumes.get_world_to_local_coords_transform()
    assert_close(there.compose(back).get_matrix(), torch.eye(4).expand(len(sizes), 4, 4))
    assert_close(volumes.local_to_world_coords(torch.zeros(len(sizes), 3)), -offsets)


def test_neighbouring_voxels_are_a_voxel_size_apart(sizes) -> None:
    edges = torch.tensor([0.1, 0.2, 0.4])
    grid = random_volumes(sizes, voxel_size=edges).get_coord_grid()
    assert_close(grid.diff(dim=3)[..., 0], torch.full_like(grid.diff(dim=3)[..., 0], 0.1))
    assert_close(grid.diff(dim=2)[..., 1], torch.full_like(grid.diff(dim=2)[..., 1], 0.2))
    assert_close(grid.diff(dim=1)[..., 2], torch.full_like(grid.diff(dim=1)[..., 2], 0.4))
    for each, (depth, height, width) in zip(grid, sizes, strict=True):
        assert_close(each[:depth, :height, :width].flatten(0, 2).mean(0), torch.zeros(3), atol=1e-6)


@pytest.mark.parametrize("align_corners", [True, False])
def test_local_coordinates_are_those_of_grid_sample(sizes, align_corners: bool) -> None:
    volumes = random_volumes(sizes, align_corners=align_corners)
    grid = volumes.get_coord_grid(world_coordinates=False)
    assert grid.shape == (*volumes.densities().shape[:1], *volumes.densities().shape[2:], 3)
    for own, places, (depth, height, width) in zip(volumes.features_list(), grid, sizes, strict=True):
        inside = places[None, :depth, :height, :width]
        assert_close(F.grid_sample(own[None], inside, align_corners=align_corners)[0], own)
        assert (places[depth:] > 1).any(-1).all()  # the padding
        assert (inside.abs() <= 1).all()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (0.5, [[0.5] * 3] * 2),
        ((0.1, 0.2, 0.3), [[0.1, 0.2, 0.3]] * 2),
        (torch.tensor(0.5), [[0.5] * 3] * 2),
        (torch.tensor([0.5]), [[0.5] * 3] * 2),
        (torch.tensor([0.1, 0.2, 0.3]), [[0.1, 0.2, 0.3]] * 2),
        (torch.tensor([[0.1], [0.2]]), [[0.1] * 3, [0.2] * 3]),
        (torch.tensor([[0.1, 0.2, 0.3], [1, 2, 3]]), [[0.1, 0.2, 0.3], [1, 2, 3]]),
    ],
    ids=str,
)
def test_numbers_for_axes_and_volumes(given, expected) -> None:
    grids = torch.zeros(2, 1, 3, 3, 3)
    ones = torch.ones(2, 3)
    assert_close(Volumes(grids, voxel_size=given).local_to_world_coords(ones), expected)
    moved = Volumes(grids, volume_translation=given).local_to_world_coords(ones)
    assert_close(1 - moved, expected)


def test_lists_and_padding_agree(sizes) -> None:
    densities, features = [torch.rand(2, *s) for s in sizes], [torch.rand(3, *s) for s in sizes]
    volumes = Volumes(densities, features)
    assert all(map(torch.equal, volumes.densities_list(), densities))
    assert all(map(torch.equal, volumes.features_list(), features))
    assert volumes.densities().shape[2:] == tuple(max(s[d] for s in sizes) for d in range(3))
    assert volumes.densities().sum().item() == pytest.approx(sum(d.sum().item() for d in densities), rel=1e-5)
    assert volumes.get_grid_sizes().tolist() == [list(s) for s in sizes]
    assert len(volumes) == len(sizes)


def test_padded_input_is_kept_as_it_is() -> None:
    one = torch.rand(1, 4, 4, 4, requires_grad=True)
    volumes = Volumes(one[None].expand(5, 1, 4, 4, 4))
    assert volumes.densities().data_ptr() == one.data_ptr()
    assert volumes.features() is volumes.features_list() is None
    volumes.densities().sum().backward()
    assert_close(one.grad, torch.full_like(one, 5))


PICKS = [
    (0, [0]), (-1, [2]), (slice(1, None), [1, 2]), ([2, 0, 2], [2, 0, 2]), ((1, 0), [1, 0]), ([], []),
    (torch.tensor([0, 2]), [0, 2]), (torch.tensor([False, True, True]), [1, 2]),
]  # fmt: skip


@pytest.mark.parametrize(("index", "picked"), PICKS, ids=str)
def test_indexing_picks_volumes_and_their_places(index, picked: list[int]) -> None:
    volumes = random_volumes(SIZES[2], voxel_size=torch.rand(3, 3) + 0.1, volume_translation=torch.rand(3, 3))
    chosen = volumes[index]
    assert len(chosen) == len(chosen.locator) == len(picked)
    assert torch.equal(chosen.densities(), volumes.densities()[picked])
    assert torch.equal(chosen.features(), volumes.features()[picked])
    assert torch.equal(chosen.get_grid_sizes(), volumes.get_grid_sizes()[picked])
    assert_close(chosen.get_coord_grid(), volumes.get_coord_grid()[picked])
    expected = [volumes.features_list()[i] for i in picked]
    assert all(map(torch.equal, chosen.features_list(), expected))


@pytest.mark.parametrize("index", [3, [0, -4], torch.tensor([0.5]), torch.tensor([True]), "0"], ids=str)
def test_indices_that_pick_nothing_are_refused(index) -> None:
    with pytest.raises(IndexError):
        random_volumes(SIZES[2])[index]


def test_other_values_in_the_same_places() -> None:
    volumes = random_volumes(SIZES[2], voxel_size=0.3)
    densities = torch.rand_like(volumes.densities())
    changed = volumes.update_padded(densities, volumes.features()[:, :2])
    assert changed.densities() is densities
    assert changed.features().shape[1] == 2
    assert torch.equal(changed.get_coord_grid(), volumes.get_coord_grid())
    assert [tuple(d.shape[1:]) for d in changed.densities_list()] == SIZES[2]
    assert volumes.update_padded(densities).features() is None


def test_clones_have_memory_of_their_own() -> None:
    edges = torch.rand(1, 3, requires_grad=True)
    volumes = Volumes(torch.rand(1, 1, 2, 3, 4, requires_grad=True), torch.rand(1, 2, 2, 3, 4), voxel_size=edges)
    copy = volumes.clone()
    for before, after in zip(tensors(volumes), tensors(copy), strict=True):
        assert torch.equal(before, after)
        assert before.data_ptr() != after.data_ptr()
    assert copy.densities().requires_grad
    assert copy.get_coord_grid().requires_grad
    assert volumes.to("cpu") is volumes
    assert volumes.to("cpu", copy=True).densities().data_ptr() != volumes.densities().data_ptr()


def tensors(volumes: Volumes) -> list[torch.Tensor]:
    return [volumes.densities(), volumes.features(), volumes.get_grid_sizes()]


def test_places_are_differentiable() -> None:
    grids = torch.zeros(2, 1, 2, 3, 1, dtype=torch.float64)
    edges, offsets = (torch.rand(2, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    points = torch.rand(2, 2, 3, dtype=torch.float64, requires_grad=True)

    def placed(edges, offsets, points):
        volumes = Volumes(grids, voxel_size=edges, volume_translation=offsets)
        return volumes.get_coord_grid(), volumes.world_to_local_coords(points)

    assert torch.autograd.gradcheck(placed, (edges, offsets, points))


def test_double_precision_is_kept() -> None:
    volumes = Volumes(torch.zeros(1, 1, 3, 3, 3, dtype=torch.float64), voxel_size=0.1)
    assert volumes.get_coord_grid().dtype == torch.float64
    assert volumes.get_coord_grid()[0, 2, 2, 2, 0].item() == 0.1
    assert Volumes(torch.zeros(1, 1, 3, 3, 3, dtype=torch.uint8)).get_coord_grid().dtype == torch.float32


def test_no_volumes_and_no_voxels() -> None:
    none = Volumes(torch.zeros(0, 1, 3, 4, 5), torch.zeros(0, 2, 3, 4, 5))
    assert none.get_coord_grid().shape == (0, 3, 4, 5, 3)
    assert none.densities_list() == none.features_list() == []
    assert none.world_to_local_coords(torch.zeros(0, 7, 3)).shape == (0, 7, 3)
    hollow = Volumes([torch.zeros(1, 0, 0, 0), torch.zeros(1, 2, 2, 2)])
    assert hollow.densities_list()[0].shape == (1, 0, 0, 0)
    assert hollow.get_coord_grid().isfinite().all()


def test_an_axis_of_one_voxel_can_be_inverted() -> None:
    volumes = Volumes(torch.zeros(1, 1, 1, 1, 1), voxel_size=0.5, volume_translation=(1.0, 2.0, 3.0))
    assert_close(volumes.get_coord_grid().flatten(), [-1, -2, -3])
    assert_close(volumes.world_to_local_coords(torch.tensor([[-1.0, -2, -3]])), [[0, 0, 0]])


@pytest.mark.parametrize(
    "grid_sizes",
    [(3, 4, 5), [3, 4, 5], [(3, 4, 5)] * 2, torch.tensor([3, 4, 5]), torch.tensor([[3, 4, 5]] * 2),
     [torch.tensor([3, 4, 5])] * 2],
    ids=str,
)  # fmt: skip
def test_a_locator_needs_no_volumes(grid_sizes) -> None:
    locator = VolumeLocator(2, grid_sizes, torch.device("cpu"), voxel_size=0.2, volume_translation=(0.0, 1.0, 0.0))
    volumes = Volumes(torch.zeros(2, 1, 3, 4, 5), voxel_size=0.2, volume_translation=(0.0, 1.0, 0.0))
    assert torch.equal(locator.get_coord_grid(), volumes.get_coord_grid())
    assert torch.equal(locator.get_grid_sizes(), volumes.get_grid_sizes())
    assert torch.equal(locator[[1]].clone().get_coord_grid(), volumes[1].get_coord_grid())


def test_volumes_stay_on_their_device(far) -> None:  # noqa: F811
    volumes = random_volumes(SIZES[2], voxel_size=torch.rand(3, 3) + 0.1).to(far)
    derived = [
        volumes.densities(), volumes.features_list()[1], volumes.get_grid_sizes(), volumes.get_coord_grid(),
        volumes[[2, 0]].get_coord_grid(False), volumes[1:].features(), volumes.clone().get_coord_grid(),
        volumes.world_to_local_coords(torch.rand(3, 5, 3, device=far)),
        volumes.update_padded(volumes.densities() + 1).densities(),
        Volumes([torch.rand(1, 2, 2, 2, device=far)], voxel_size=(0.1, 0.2, 0.3)).get_coord_grid(),
        VolumeLocator(1, (2, 3, 4), far).get_coord_grid(),
    ]  # fmt: skip
    assert all(isinstance(tensor, Far) for tensor in derived)
    assert volumes.device == volumes.locator.device == far


GRID = torch.zeros(2, 1, 3, 3, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((GRID[0],), r"densities must have shape \(N, C, D, H, W\), got \(1, 3, 3, 3\)"),
        (([],), "at least one tensor .* got an empty list"),
        (("grid",), "got <class 'str'>"),
        (([GRID[0], GRID],), r"densities\[1\] must have shape \(C, D, H, W\), got \(2, 1, 3, 3, 3\)"),
        (([GRID[0], GRID[:, 0]],), r"same number of channels, got \[1, 2\]"),
        ((GRID, GRID[:1]), "the densities' batch size, 2; got 1"),
        ((GRID, GRID[:, :, 1:]), r"the densities' sizes .* grid 0 \(3, 3, 3\), got \(2, 3, 3\)"),
        ((GRID, None, 0.0), "voxel_size must be finite and not 0, got 0.0"),
        ((GRID, None, (1.0, 2.0)), r"voxel_size must be .* got shape \(2,\)"),
        ((GRID, None, torch.ones(3, 3)), r"\(2, 1\) or \(2, 3\); got shape \(3, 3\)"),
        ((GRID, None, "big"), "voxel_size must be a number, three numbers or a tensor; got 'big'"),
        ((GRID, None, 1.0, (0.0, float("nan"), 0.0)), "volume_translation must be finite"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Volumes(*arguments)


def test_wrong_updates_points_and_sizes_are_named() -> None:
    volumes = Volumes(GRID)
    with pytest.raises(ValueError, match=r"new_densities must have shape \(2, C, 3, 3, 3\), got \(1, 1, 3, 3, 3\)"):
        volumes.update_padded(GRID[:1])
    with pytest.raises(ValueError, match="new_features must have shape"):
        volumes.update_padded(GRID, GRID[..., 1:])
    with pytest.raises(ValueError, match=r"points must have shape \(2, ..., 3\), got \(5, 3\)"):
        volumes.local_to_world_coords(torch.zeros(5, 3))
    for wrong in ((3, 4), [(3, 4, 5)], (3, 4, -5), torch.zeros(2, 2, dtype=torch.int64), (3.0, 4.0, 5.0)):
        with pytest.raises(ValueError, match="grid"):
            VolumeLocator(2, wrong, "cpu")
