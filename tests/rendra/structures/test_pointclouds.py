"""Laws of batches of point clouds: their three forms agree, and what is made from them keeps every row."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra.structures import Pointclouds, join_pointclouds_as_batch, join_pointclouds_as_scene

SIZES = [[5], [4, 7, 1], [3, 0, 6, 0], [4, 4], [0, 0], []]
FIELDS = ("points", "normals", "features")


def random_clouds(sizes: list[int], channels: int = 4, dtype: torch.dtype = torch.float32) -> Pointclouds:
    points, normals, features = ([torch.randn(n, c, dtype=dtype) for n in sizes] for c in (3, 3, channels))
    return Pointclouds(points, normals, features)


@pytest.fixture(params=SIZES, ids=str)
def clouds(request: pytest.FixtureRequest) -> Pointclouds:
    return random_clouds(request.param)


def lists(clouds: Pointclouds) -> list[list[Tensor]]:
    """Points, normals and features of each cloud."""
    return [getattr(clouds, f"{field}_list")() or [] for field in FIELDS]


def assert_same_clouds(actual: Pointclouds, expected: list[list[Tensor]]) -> None:
    for own, rows in zip(lists(actual), expected, strict=True):
        assert len(own) == len(rows)
        assert all(map(torch.equal, own, rows))


def test_forms_agree(clouds: Pointclouds) -> None:
    counts = clouds.num_points_per_cloud()
    for field, items in zip(FIELDS, lists(clouds), strict=True):
        packed, padded = getattr(clouds, f"{field}_packed")(), getattr(clouds, f"{field}_padded")()
        if len(clouds) == 0 and field != "points":
            assert packed is padded is None
            continue
        assert [len(item) for item in items] == counts.tolist()
        width = packed.shape[1]
        assert torch.equal(torch.cat([torch.zeros(0, width), *items]), packed)
        assert padded.shape == (len(clouds), max(counts.tolist(), default=0), width)
        assert torch.equal(padded.reshape(-1, width)[clouds.padded_to_packed_idx()], packed)
        assert padded.abs().sum().item() == pytest.approx(packed.abs().sum().item())  # the rest is 0


def test_index_tensors_agree(clouds: Pointclouds) -> None:
    counts = clouds.num_points_per_cloud()
    assert torch.equal(clouds.packed_to_cloud_idx(), torch.arange(len(clouds)).repeat_interleave(counts))
    assert torch.equal(clouds.cloud_to_packed_first_idx(), counts.cumsum(0) - counts)
    assert torch.equal(clouds.valid, counts > 0)
    assert clouds.isempty() == (clouds.points_packed().numel() == 0)
    assert clouds.equisized == (len(set(counts.tolist())) == 1)


def test_padded_construction_keeps_every_row() -> None:
    points, normals, features = torch.randn(2, 5, 3), torch.randn(2, 5, 3), torch.randint(0, 255, (2, 5, 1))
    clouds = Pointclouds(points, normals, features)
    assert_same_clouds(clouds, [list(points), list(normals), list(features)])
    assert clouds.equisized
    assert clouds.features_packed().dtype == torch.int64


def test_padded_attributes_of_listed_points_lose_their_padding() -> None:
    points, features = [torch.randn(2, 3), torch.randn(4, 3)], torch.randn(2, 4, 6)
    clouds = Pointclouds(points, features=features)
    assert torch.equal(clouds.features_packed(), torch.cat([features[0, :2], features[1]]))
    assert clouds.features_padded()[0, 2:].abs().max() == 0
    assert clouds.normals_list() is clouds.normals_packed() is clouds.normals_padded() is None


def test_a_cloud_without_points_needs_no_attributes() -> None:
    clouds = Pointclouds(
        [torch.zeros(0, 3), torch.ones(2, 3)], [None, torch.ones(2, 3)], [torch.zeros(0), torch.ones(2, 5)]
    )
    assert clouds.normals_list()[0].shape == (0, 3)
    assert clouds.features_list()[0].shape == (0, 5)
    assert Pointclouds([torch.zeros(0)], [None]).normals_list() is None


PICKS = [
    (0, [0]), (-1, [3]), (slice(1, None), [1, 2, 3]), (slice(None, None, -1), [3, 2, 1, 0]), ([2, 0, 2], [2, 0, 2]),
    (torch.tensor([1, 3]), [1, 3]), (torch.tensor([True, False, True, False]), [0, 2]), ([], []),
]  # fmt: skip


@pytest.mark.parametrize(("index", "picked"), PICKS, ids=str)
@pytest.mark.parametrize("sizes", [[3, 0, 6, 2], [4, 4, 4, 4]], ids=str)
def test_indexing_picks_clouds(sizes: list[int], index, picked: list[int]) -> None:
    clouds = random_clouds(sizes)
    assert_same_clouds(clouds[index], [[rows[i] for i in picked] for rows in lists(clouds)])


@pytest.mark.parametrize("index", [4, [0, -5], torch.tensor([0.5]), torch.tensor([True]), "0"], ids=str)
def test_indices_that_pick_nothing_are_refused(index) -> None:
    with pytest.raises(IndexError):
        random_clouds([3, 0, 6, 2])[index]


def test_batches_joined_and_split_are_the_same(clouds: Pointclouds) -> None:
    joined = join_pointclouds_as_batch([clouds, clouds])
    assert_same_clouds(joined, [2 * rows for rows in lists(clouds)])
    for part in joined.split([len(clouds), len(clouds)]):
        assert_same_clouds(part, lists(clouds))


def test_a_scene_is_one_cloud_of_all_points(clouds: Pointclouds) -> None:
    for scene, times in ((join_pointclouds_as_scene(clouds), 1), (join_pointclouds_as_scene([clouds, clouds]), 2)):
        assert len(scene) == 1
        assert torch.equal(scene.points_packed(), clouds.points_packed().repeat(times, 1))
        assert scene.num_points_per_cloud().tolist() == [times * len(clouds.points_packed())]


def test_joins_ignore_what_a_batch_without_points_lacks() -> None:
    filled, hollow = random_clouds([2, 3]), Pointclouds([torch.zeros(0, 3)])
    joined = join_pointclouds_as_batch([hollow, filled])
    assert joined.num_points_per_cloud().tolist() == [0, 2, 3]
    assert torch.equal(joined.normals_packed(), filled.normals_packed())
    assert len(join_pointclouds_as_batch([hollow, Pointclouds([]), random_clouds([0, 0])])) == 3


def test_clouds_repeat_one_by_one(clouds: Pointclouds) -> None:
    assert_same_clouds(clouds.extend(3), [[row for row in rows for _ in range(3)] for rows in lists(clouds)])


def test_copies_share_nothing_and_detached_ones_no_graph() -> None:
    points = torch.randn(5, 3, requires_grad=True)
    clouds = Pointclouds([points], [torch.randn(5, 3)])
    copy, detached = clouds.clone(), clouds.detach()
    copy.normals_packed().zero_()
    assert clouds.normals_packed().abs().min() > 0
    copy.points_packed().sum().backward()
    assert_close(points.grad, torch.ones(5, 3))
    assert not detached.points_packed().requires_grad
    assert clouds.to("cpu") is clouds
    assert clouds.to("cpu", copy=True) is not clouds


def test_offsets_and_scales_move_points_only(clouds: Pointclouds) -> None:
    points, normals = clouds.points_packed(), clouds.normals_packed()
    offsets, scales = torch.randn_like(points), torch.rand(len(clouds))
    moved = clouds.offset(offsets).scale(scales)
    expected = (points + offsets) * scales[clouds.packed_to_cloud_idx(), None]
    assert_close(moved.points_packed(), expected)
    assert_close(clouds.points_packed(), points, atol=0)
    assert moved.normals_packed() is normals or torch.equal(moved.normals_packed(), normals)
    clouds.points_padded()
    assert clouds.offset_(offsets).scale_(scales) is clouds
    assert_close(clouds.points_packed(), expected)
    assert_close(clouds.points_padded().reshape(-1, 3)[clouds.padded_to_packed_idx()], expected)
    assert_close(clouds.offset(torch.ones(3)).scale(2).points_packed(), 2 * (expected + 1))


def test_bounding_boxes_hold_their_points_tightly() -> None:
    clouds = random_clouds([7, 0, 3])
    low, high = clouds.get_bounding_boxes().unbind(2)
    for i in (0, 2):
        assert_close(low[i], clouds.points_list()[i].amin(0), atol=0)
        assert_close(high[i], clouds.points_list()[i].amax(0), atol=0)
    boxes = torch.stack([low, high], 1)
    boxes[1] = 0
    assert clouds.inside_box(boxes).all()
    assert not clouds.inside_box(torch.tensor([[9.0, 9, 9], [10, 10, 10]])).any()
    half = clouds.inside_box(torch.tensor([[0.0, -9, -9], [9, 9, 9]]))
    assert torch.equal(half, clouds.points_packed()[:, 0] >= 0)


def test_updated_clouds_keep_their_sizes_and_ignore_the_padding() -> None:
    clouds = random_clouds([2, 4])
    news = [torch.randn(2, 4, c) for c in (3, 3, 4)]
    updated = clouds.update_padded(*news)
    assert_same_clouds(updated, [[new[0, :2], new[1]] for new in news])
    kept = clouds.update_padded(news[0])
    assert torch.equal(kept.normals_packed(), clouds.normals_packed())
    assert torch.equal(kept.features_packed(), clouds.features_packed())


def test_subsamples_are_parts_of_their_clouds() -> None:
    clouds = random_clouds([6, 0, 9, 3])
    assert clouds.subsample(9) is clouds
    small = clouds.subsample([4, 1, 5, 3])
    assert small.num_points_per_cloud().tolist() == [4, 0, 5, 3]
    assert torch.equal(small.points_list()[3], clouds.points_list()[3])
    for i in (0, 2):
        same = (small.points_list()[i][:, None] == clouds.points_list()[i]).all(2)
        assert same.sum(1).tolist() == [1] * len(small.points_list()[i])
        assert same.sum(0).max() == 1
        rows = same.int().argmax(1)
        assert torch.equal(clouds.features_list()[i][rows], small.features_list()[i])
    assert clouds.subsample(0).isempty()


def test_gradients_reach_every_form() -> None:
    points = [torch.randn(3, 3, requires_grad=True), torch.randn(2, 3, requires_grad=True)]
    clouds = Pointclouds(points)
    for form in (
        clouds.points_packed,
        clouds.points_padded,
        clouds[[1, 0]].points_packed,
        clouds.extend(2).points_padded,
    ):
        (first,) = torch.autograd.grad(form().square().sum(), points[0])
        assert (first != 0).all()


def test_clouds_stay_on_their_device(far) -> None:  # noqa: F811
    clouds = random_clouds([4, 2, 0]).to(far)
    derived = [
        clouds.points_padded(), clouds.normals_padded(), clouds.features_packed(), clouds.num_points_per_cloud(),
        clouds.packed_to_cloud_idx(), clouds.padded_to_packed_idx(), clouds.get_bounding_boxes(), clouds.valid,
        clouds.inside_box(torch.tensor([[0.0, 0, 0], [1, 1, 1]], device=far)), clouds.subsample(2).points_packed(),
        clouds[[2, 0]].points_padded(), clouds.extend(2).points_packed(), clouds.scale(2.0).points_packed(),
        clouds.offset(torch.ones(6, 3, device=far)).points_padded(),
        clouds.update_padded(torch.ones(3, 4, 3, device=far)).points_packed(),
        join_pointclouds_as_scene([clouds, clouds]).features_packed(),
    ]  # fmt: skip
    assert all(isinstance(tensor, Far) for tensor in derived)


CLOUD = torch.zeros(2, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3,), "either a list or a tensor"),
        ((torch.zeros(2, 3),), r"shape \(N, P, 3\), got \(2, 3\)"),
        (([torch.zeros(2, 4)],), r"points\[0\] \(2, 4\)"),
        (([CLOUD, None],), r"points\[1\] must be a tensor"),
        (([CLOUD], [CLOUD, CLOUD]), "normals must have the same length, got 1 and 2"),
        (([CLOUD], [torch.zeros(3, 3)]), r"normals\[0\] has mismatched .* 2 points, 3 rows"),
        (([CLOUD], [torch.zeros(2, 4)]), "3-dimensional, got 4"),
        (([CLOUD], None, [torch.zeros(2)]), r"features\[0\] must be of shape \(P, C\)"),
        (([CLOUD], None, [None]), r"features\[0\] must be of shape"),
        (([CLOUD, CLOUD], None, [CLOUD, torch.zeros(2, 4)]), r"same number of channels, got \[3, 4\]"),
        (([CLOUD], None, torch.zeros(1, 3, 3)), r"N and P, \(1, 2\); got \(1, 3, 3\)"),
        (([CLOUD], None, 7), "features must be either a list or a tensor"),
    ],
)
def test_what_does_not_fit_is_named(arguments, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Pointclouds(*arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.get_cloud(2), r"range \[0, 2\), got 2"),
        (lambda c: c.get_cloud("a"), "must be an integer"),
        (lambda c: c.split([1]), "sum to the 2 clouds"),
        (lambda c: c.split([1.0, 1.0]), "list of integers"),
        (lambda c: c.extend(0), "N must be an integer > 0"),
        (lambda c: c.offset(torch.zeros(2, 3)), r"\(all_p, 3\) = \(5, 3\) or \(3,\), got \(2, 3\)"),
        (lambda c: c.scale(torch.ones(3)), r"shape \(2,\), got \(3,\)"),
        (lambda c: c.inside_box(torch.zeros(3, 2)), r"\(2, 3\) or \(N, 2, 3\), got \(3, 2\)"),
        (lambda c: c.inside_box(torch.zeros(3, 2, 3)), "batch of 2 clouds: got 3 boxes"),
        (lambda c: c.inside_box(torch.tensor([[1.0, 0, 0], [0, 1, 1]])), "min values larger"),
        (lambda c: c.update_padded(torch.zeros(2, 2, 3)), r"\(2, 3, 3\); got \(2, 2, 3\)"),
        (lambda c: c.update_padded(torch.zeros(2, 3, 3), None, torch.zeros(2, 3, 5)), "same dimension, 4; got 5"),
        (lambda c: c.subsample([1]), "wrong number of max_points"),
        (lambda c: c.subsample(-1), "must not be negative"),
        (lambda c: join_pointclouds_as_batch(c), "Wrong first argument"),
        (lambda c: join_pointclouds_as_batch([c, 3]), "Wrong first argument"),
        (lambda c: join_pointclouds_as_batch([c, Pointclouds([CLOUD])]), "all have normals or not"),
        (
            lambda c: join_pointclouds_as_batch([c, random_clouds([2], channels=2)]),
            r"features channels, got \[2, 4\]",
        ),
    ],
)
def test_wrong_calls_are_answered(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(random_clouds([2, 3]))


def test_one_cloud_comes_with_what_it_has() -> None:
    clouds = random_clouds([2, 3])
    points, normals, features = clouds.get_cloud(1)
    assert_same_clouds(Pointclouds([points], [normals], [features]), [[rows[1]] for rows in lists(clouds)])
    assert Pointclouds([CLOUD]).get_cloud(0)[1:] == (None, None)
