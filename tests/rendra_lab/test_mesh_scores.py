"""Scores of meshes: closed forms, what must not change them, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from far_device import Far, far  # noqa: F401
from lightning.pytorch import LightningModule, Trainer
from torch.utils.data import DataLoader

from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes, join_meshes_as_batch
from rendra.utils import ico_sphere
from rendra_lab import mesh_scores
from rendra_lab.errors import UserError
from rendra_lab.mesh_scores import PROTOCOLS, mesh_measure, mesh_term, score_surfaces, scores_of, true_meshes
from rendra_lab.shape_records import Shapes
from rendra_lab.terms import MetricTerm

NOTHING = Meshes([torch.zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.int64)])


def square(z: float = 0.0, side: float = 1.0, flipped: bool = False) -> Meshes:
    verts = torch.tensor([[0.0, 0, z], [side, 0, z], [side, side, z], [0, side, z]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return Meshes([verts], [faces.flip(1) if flipped else faces])


def shapes_of(meshes: Meshes) -> Shapes:
    points, normals = sample_points_from_meshes(meshes, 8, return_normals=True)
    count = len(meshes)
    grids = torch.zeros(count, 2, 2, 2, dtype=torch.bool)
    frames = torch.eye(4).repeat(count, 1, 1)
    return Shapes(points, normals, grids, frames, tuple(meshes.verts_list()), tuple(meshes.faces_list()))


def test_a_square_beside_its_twin_is_off_by_their_distance_alone() -> None:
    # the true side is scaled from 1 to 10: a gap of 0.035 becomes 0.35; 10,000 samples are spread to about 0.05
    scores = score_surfaces(square(z=0.035), square())
    noise = 2 / (math.pi * 100)  # mean squared distance to the nearest of 100 samples a unit of area, both ways
    assert scores.chamfer.item() == pytest.approx(2 * 0.35**2 + noise, rel=0.03)
    assert scores.normal.item() == pytest.approx(1.0)
    assert scores.f1[0, :3].tolist() == [0, 0, 0]
    assert scores.f1[0, 4].item() == pytest.approx(100, abs=0.1)


def test_a_part_is_precise_and_recalls_its_share() -> None:
    scores = score_surfaces(square(side=0.5), square())
    near = (5 + 0.3) ** 2 / 100  # of the true points lie within 0.3 of the quarter
    assert scores.precision[0, 2].item() == pytest.approx(100, abs=0.2)
    assert scores.recall[0, 2].item() == pytest.approx(100 * near, abs=1.5)
    precision, recall = scores.precision[0], scores.recall[0]
    torch.testing.assert_close(scores.f1[0], 2 * precision * recall / (precision + recall))


def test_inside_out_surfaces_show_in_the_signed_normal_alone() -> None:
    right, wrong = (score_surfaces(square(flipped=flipped), square()) for flipped in (False, True))
    assert wrong.signed_normal.item() == pytest.approx(-right.signed_normal.item()) == pytest.approx(-1.0)
    assert wrong.normal.item() == pytest.approx(1.0)
    torch.testing.assert_close(wrong.f1, right.f1, atol=1.0, rtol=0)


def test_scaled_scores_know_no_unit_and_those_of_p2m_do() -> None:
    predicted, truth = ico_sphere(2), ico_sphere(2).scale_verts(1.2)
    metres, millimetres = (
        score_surfaces(predicted.scale_verts(scale), truth.scale_verts(scale)) for scale in (1.0, 1000.0)
    )
    torch.testing.assert_close(millimetres.chamfer, metres.chamfer, rtol=1e-4, atol=0)
    raw = score_surfaces(predicted, truth, PROTOCOLS["p2m"])
    side = float((truth.verts_packed().amax(0) - truth.verts_packed().amin(0)).max())
    torch.testing.assert_close(raw.chamfer, metres.chamfer * (0.57 * side / 10) ** 2, rtol=1e-4, atol=0)
    assert raw.f1.shape == (1, 2)


def test_a_mesh_scores_the_same_alone_and_in_company() -> None:
    pairs = [(square(0.02), square()), (ico_sphere(2), ico_sphere(3)), (ico_sphere(1), square())]
    together = score_surfaces(*(join_meshes_as_batch(list(meshes)) for meshes in zip(*pairs, strict=True)))
    for index, (predicted, truth) in enumerate(pairs):
        assert score_surfaces(predicted, truth).chamfer.item() == together.chamfer[index].item()


def test_double_precision_and_an_empty_batch_are_fine() -> None:
    single, double = (
        score_surfaces(
            *(Meshes([m.verts_packed().to(kind)], [m.faces_packed()]) for m in (square(0.01), square())), samples=500
        )
        for kind in (torch.float32, torch.float64)
    )
    assert double.chamfer.dtype == torch.float64
    torch.testing.assert_close(double.chamfer.float(), single.chamfer, rtol=0.2, atol=0)
    nothing = Meshes([], [])
    assert score_surfaces(nothing, nothing).f1.shape == (0, 5)


def test_a_mesh_without_faces_counts_as_a_ball() -> None:
    truth = ico_sphere(3)
    empty, ball = score_surfaces(NOTHING, truth), score_surfaces(ico_sphere(3), truth)
    assert empty.chamfer.item() == ball.chamfer.item()


def test_truth_must_be_there() -> None:
    with pytest.raises(ValueError, match="true mesh 0 of 1 has no faces"):
        score_surfaces(square(), NOTHING)
    with pytest.raises(ValueError, match="got 1 for 2"):
        score_surfaces(join_meshes_as_batch([square(), square()]), square())
    point = Meshes([torch.zeros(3, 3)], [torch.tensor([[0, 1, 2]])])
    with pytest.raises(ValueError, match="no extent"):
        score_surfaces(square(), point)


def test_terms_share_their_work_and_take_the_stage_that_they_name(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    real = mesh_scores.score_surfaces
    monkeypatch.setattr(mesh_scores, "score_surfaces", lambda *asked: calls.append(asked) or real(*asked))
    shapes = shapes_of(join_meshes_as_batch([square(), ico_sphere(2)]))
    rough = join_meshes_as_batch([square(0.05), ico_sphere(1)])
    fine = true_meshes(shapes)
    values = {
        (stage, measure): mesh_measure(
            [rough, fine], shapes, measure=measure, column=column, stage=stage, samples=900
        )
        for stage in (0, -1)
        for measure, column in (("chamfer", None), ("f1", 2))
    }
    assert len(calls) == 2
    assert bool((values[0, "chamfer"].value > values[-1, "chamfer"].value).all())
    assert bool((values[0, "f1"].value < values[-1, "f1"].value).all())
    assert bool(values[0, "f1"].counted.all())


def test_nobody_is_given_the_scores_of_meshes_that_are_gone() -> None:
    shapes = shapes_of(square())
    first = scores_of(square(0.01), shapes, "scaled", 500).chamfer.item()
    assert scores_of(square(0.3), shapes, "scaled", 500).chamfer.item() > 2 * first


class _Guesser(LightningModule):
    """Logs one metric of a fixed prediction."""

    def __init__(self, term: MetricTerm, guess: Meshes) -> None:
        super().__init__()
        self.term, self.guess = term, guess

    def test_step(self, batch: Shapes, batch_idx: int) -> None:
        self.log("f1", self.term({"meshes": self.guess}, {"shapes": batch}), on_epoch=True, batch_size=1)


def test_a_term_averages_over_the_objects_of_a_test() -> None:
    truths = [shapes_of(square()), shapes_of(square(0.02))]
    task = _Guesser(mesh_term("f1", 0.1), square())
    silent = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = Trainer(accelerator="cpu", enable_checkpointing=False, **silent)
    loader = DataLoader(truths, batch_size=None)
    trainer.test(task, loader, verbose=False)
    alone = [float(score_surfaces(square(), true_meshes(truth)).f1[0, 0]) for truth in truths]
    assert float(trainer.callback_metrics["f1"]) == pytest.approx(sum(alone) / 2, rel=1e-5)


def test_thresholds_are_those_of_the_protocol() -> None:
    with pytest.raises(UserError, match=r"f1 by the protocol scaled has the thresholds 0\.1, 0\.2.* got 0\.25"):
        mesh_term("f1", 0.25)
    with pytest.raises(UserError, match=r"chamfer has no threshold, got 0\.1"):
        mesh_term("chamfer", 0.1)


def test_scores_stay_on_the_device_of_the_meshes(far: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    generator = torch.Generator()  # the device that stands in has none of its own
    monkeypatch.setattr(torch, "Generator", lambda device: generator)
    predicted, truth = (
        Meshes([m.verts_packed().to(far)], [m.faces_packed().to(far)]) for m in (square(0.02), square())
    )
    scores = score_surfaces(predicted, truth, samples=60)
    assert isinstance(scores.f1, Far)
    empty = Meshes([torch.zeros(0, 3).to(far)], [torch.zeros(0, 3, dtype=torch.int64).to(far)])
    assert isinstance(score_surfaces(empty, truth, samples=60).chamfer, Far)
